"""The two theories of diffraction, and the interface of both: value, density, samples, R, polarisation."""

from __future__ import annotations

import contextlib
import functools
import logging
from collections.abc import Iterator
from typing import Protocol

import drjit as dr
import mitsuba as mi
import numpy as np

from ..energy.furnace import small_kappas
from ..errors import RequestError
from ..optics.film_stack import Stack
from ..optics.geometry import SHADOWING
from ..optics.media import SAME_INDEX, Media
from ..precomputation.grating_spectrum import GratingSpectrum
from ..precomputation.spectra import Spectrum
from ..rigorous.rigorous_spectrum import RigorousSpectrum
from ..settings import VISIBLE
from .coat import Coat
from .device_tables import opaque
from .directions import Geometry, Incidence, Interface, rotated
from .energy_factor import Coordinates, Energy
from .fresnel import Boundary, PerfectMirror
from .order_sampler import MAX_INDEX_CHANGE, OrderSampler
from .parameters import GratingRequest, check_rigorous
from .polarisation import Split, of_facets, of_orders
from .rigorous_orders import RigorousOrders
from .shared import SharedTables, shared

MAX_FILM_CHANGE = 5e-4  # µm, of a film, up to which a table is reused
_log = logging.getLogger(__name__)


_MAX_ERROR = 1.0  # of a spectrum, a fraction of the light; a black spectrum has this error
_shows_errors = False


@contextlib.contextmanager
def errors_shown() -> Iterator[None]:
    """Take spectra of any error, without a warning, inside a `with` block: for pictures that show what terms do."""
    global _shows_errors
    before, _shows_errors = _shows_errors, True
    try:
        yield
    finally:
        _shows_errors = before


@functools.cache
def _warn(source: str, warning: str) -> None:
    """Log a warning, once for each surface."""
    _log.warning("diffraction_grating, %s: %s", source, warning)


def _check_error(spectrum: GratingSpectrum) -> None:
    """Log the error of a series that has too few terms for its tolerance.

    Raises:
        RequestError: if it is as wrong as no light at all.
    """
    if not spectrum.excess or _shows_errors:
        return
    if spectrum.error >= _MAX_ERROR:
        raise RequestError(
            f"{spectrum.excess}; wanted more terms or terms=auto, heights_from=mean, chebyshev or slices; a tolerance "
            "above the error accepts it"
        )
    _warn(spectrum.source, spectrum.excess)


class Scattering(Protocol):
    """The powers of orders or of a continuum, and the density from which q is drawn.

    Attributes:
        resolved: whether orders do not overlap, so that most directions lie outside of all lobes.
    """

    resolved: bool

    def meets(self, q_x: mi.Float, q_y: mi.Float, scale: mi.Float) -> mi.Bool:
        """Return whether q (cycles/µm) lies in the lobe, scaled by `scale`, of an order; true where lobes overlap."""

    def power_and_density(self, geometry: Geometry, incidence: Incidence, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Return the power and the density of q, both in µm², for one wavelength of a pair of directions.

        The power is n_o² K G S |cos θ_o|, with the gain of lobes, or n_o² Σ_m η_m Γ N |cos θ_o| in rigorous theory.
        Where orders are resolved, q lies in the lobe of one for all `active` pairs.
        """

    def sample(self, incidence: Incidence, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> tuple[mi.Point2f, mi.Bool]:
        """Draw q in cycles/µm for one wavelength; return it and whether its order propagates.

        `u` chooses the order, or a bin of κ and q; `v` the position in its lobe or bin.
        """


class Theory(Protocol):
    """A theory of diffraction, the base class of both.

    Attributes:
        scattering: the powers, and their sampler.
        boundary: R and T of a plane.
        interface: the media above and below.
        media: those around the grating.
        shadowing: whether G is a factor.
        wavelengths: (shortest, longest) of the table, in air, nm.
        largest_angle: from the normal, of both directions, degrees.
        light: (shortest, longest) of the light that was taken by `cover`, in air, nm; None before there is a scene.
    """

    scattering: Scattering
    boundary: Boundary
    interface: Interface
    media: Media
    shadowing: bool
    wavelengths: tuple[float, float]
    largest_angle: float = 90.0
    light: tuple[float, float] | None = None

    def cover(self, wavelengths: tuple[float, float]) -> None:
        """Take the wavelengths of the light in a scene, (shortest, longest) in air, nm.

        Raises:
            RequestError: if the tables do not cover them.
        """

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Show the parameters of the theory and of its boundary; none by default."""
        return

    def parameters_changed(self, keys: list[str]) -> None:
        """Recompute what depends on the parameters `keys`; without keys, on any of them. Nothing by default."""
        return

    def coordinates(self, geometry: Geometry) -> tuple[Coordinates, Coordinates] | None:
        """Return the coordinates of both directions in the table of E, for all wavelengths; None without E."""
        return None

    def power_and_density(
        self, geometry: Geometry, incidence: Incidence, pair: tuple[Coordinates, Coordinates] | None, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float]:
        """Return f |cos θ_o| λ² without R, and the density of q, both in µm², for one wavelength.

        Args:
            geometry: of the pair of directions.
            incidence: the wavelength of the light from ω_i.
            pair: from `coordinates`.
            active: mask; where orders are resolved, q lies in the lobe of one.
        """

    def reflectance(self, si: mi.SurfaceInteraction3f, geometry: Geometry, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Return R at the half vector, or T of transmitted light; one where it is part of the efficiencies."""

    def split(
        self,
        value: mi.UnpolarizedSpectrum,
        si: mi.SurfaceInteraction3f,
        frame: tuple[mi.Float, mi.Float],
        active: mi.Bool,
    ) -> Split:
        """Return the Mueller matrix of the grating as a function of directions and axes, scaled to `value`."""


def _of_coat(coat: Coat | None) -> Interface:
    """Return the interface below a coat, if there is one, that transmits no light."""
    return Interface() if coat is None else Interface(coat.eta, dispersions=(coat.dispersion, None))


def theory_of(spectrum: Spectrum, request: GratingRequest) -> Theory:
    """Return the theory of a spectrum.

    Raises:
        RequestError: if a parameter does not match the spectrum.
    """
    if isinstance(spectrum, RigorousSpectrum):
        return RigorousTheory(spectrum, request)
    return ScalarTheory(spectrum, request)


class ScalarTheory(Theory):
    """f cos θ_o = R · K · G · S(q; κ)/λ² · E cos θ_o.

    Attributes:
        media: its index is the one for which the tables were made.
        scales: of heights and of lengths along the surface.
        energy: E, or None where it is one.
    """

    def __init__(self, spectrum: GratingSpectrum, request: GratingRequest) -> None:
        _check_error(spectrum)
        self.spectrum, self.media, self.scales = spectrum, request.media, request.scales
        self.coat = request.coat
        self.boundary, self.shadowing = request.boundary, request.shadowing
        self.conserve_energy, self.largest_angle = request.conserve_energy, spectrum.largest_angle
        self.update()

    def cover(self, wavelengths: tuple[float, float]) -> None:
        self.update(wavelengths)

    def update(self, light: tuple[float, float] | None = None) -> None:
        """Check the parameters that can change, and recompute what depends on them and on the light, if it is given.

        Raises:
            RequestError: if the spectrum does not cover the scales, or the wavelengths of the light.
        """
        light = light or self.light
        index, (first, last) = self.media.index, light or VISIBLE
        shortest = first / index
        # Without a scene nobody knows whether there is light at the wavelengths before the first of the spectrum.
        if (index > 1 or light) and shortest < self.spectrum.wavelengths[0] * (1 - 1e-6):
            name = self.media.index_name
            medium = {"int_ior": "the material", "coat_ior": "the coat", "ext_ior": "it"}[name]
            got, why = f"{name}: got {index:g}", f"; inside {medium} they are shorter"
            if index == 1:
                got, why = f"wavelengths: got light from {first:g} nm", ""
            raise RequestError(
                f"{got}, and a spectrum for wavelengths from {self.spectrum.wavelengths[0]:g} nm{why}: build it from "
                f"{shortest:.4g} nm"
            )
        # The longest wavelength grows as the index falls.
        self.spectrum = self.spectrum.up_to(last / index)
        self.tables = SharedTables.of(self.spectrum, self._stack())
        scales = self.scales
        scales.check(self.spectrum.wavelengths, shortest, self.tables.max_scale)
        self.energy: Energy | None = None
        if self.conserve_energy and self.shadowing:
            self.energy = self.tables.energy(scales)
        self.interface = self._interface()
        shortest, longest = self.spectrum.wavelengths
        self.wavelengths, self.light = (shortest * index, longest * index), light
        if light and self.spectrum.waves is not None:
            outside = self.media.outside if self.media.transmits else index
            error = self.spectrum.waves.error(light, outside, transparent=self.boundary.transparent)
            if error.warning:
                _warn(self.spectrum.source, error.warning)

    def _films_changed(self) -> bool:
        """Return whether films differ from the films of the tables by more than `MAX_FILM_CHANGE`."""
        stack, before = self._stack(), self.tables.stack
        if stack is None or before is None:
            return False
        return stack.max_difference(before) > MAX_FILM_CHANGE

    def _stack(self) -> Stack | None:
        """Return the media and the films for E and for samplers, if light is transmitted."""
        return self.boundary.stack(self.media.eta) if self.media.transmits else None

    def _interface(self) -> Interface:
        """Return the media above and below, and set the sampler of orders for the current scales and index."""
        is_sheet = self.media.transmission == "sheet"
        self.scattering = scattering = self.tables.scattering(self.scales, is_sheet, self.media.coat_index)
        if not self.media.transmits:
            return _of_coat(self.coat)
        kappas = tuple(opaque(kappa) for kappa in small_kappas(self.spectrum, self.media.eta, self.scales.laterals[0]))
        sampler = scattering.sampler
        fraction = sampler.transmitted_fraction if isinstance(sampler, OrderSampler) else None
        dispersions = None, self.boundary.dispersion
        return Interface(1.0, self.boundary.eta, is_sheet, False, kappas, fraction, dispersions)

    def parameters_changed(self, keys: list[str]) -> None:
        changed = [scale for scale in self.scales if not keys or scale.name in keys]
        for scale in changed:
            scale.read()
        self.boundary.update()
        other_index = False
        if self.media.transmits:
            # Tables are reused for nearly the same index, for the speed of scenes in which it varies smoothly.
            eta, before = float(np.max(dr.detach(self.boundary.eta))), self.media.eta
            if not 0 < eta < np.inf or abs(eta - 1) < SAME_INDEX:
                raise RequestError(
                    f"eta: got {eta:g}, wanted a positive relative index other than one, as light is transmitted"
                )
            other_index = abs(eta - before) > MAX_INDEX_CHANGE * abs(before - 1)
            if other_index:
                self.media = self.media.with_eta(eta)
        if changed or other_index or self._films_changed():
            self.update()
        else:
            self.interface = self._interface()

    def traverse(self, callback: mi.TraversalCallback) -> None:
        for scale in self.scales:
            scale.put(callback)
        self.boundary.traverse(callback)

    def coordinates(self, geometry: Geometry) -> tuple[Coordinates, Coordinates] | None:
        if self.energy is None:
            return None
        incident, outgoing = geometry.incident.inner(), geometry.outgoing.inner()
        return self.energy.coordinates(incident), self.energy.coordinates(outgoing)

    def power_and_density(
        self, geometry: Geometry, incidence: Incidence, pair: tuple[Coordinates, Coordinates] | None, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float]:
        power, density = self.scattering.power_and_density(geometry, incidence, active)
        if pair is not None and self.energy is not None:
            frequency = incidence.frequency * incidence.coat_index
            power *= self.energy.factor(pair, frequency, geometry.height_scale)
        return power, density

    def reflectance(self, si: mi.SurfaceInteraction3f, geometry: Geometry, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        return dr.select(geometry.reflects, *self.boundary.r_and_t(si, geometry.cos_half(), active))

    def split(
        self,
        value: mi.UnpolarizedSpectrum,
        si: mi.SurfaceInteraction3f,
        frame: tuple[mi.Float, mi.Float],
        active: mi.Bool,
    ) -> Split:
        def planes(cos_half: mi.Float, reflects: mi.Bool) -> list[mi.Matrix4f]:
            return self.boundary.planes(si, cos_half, reflects, active)

        return of_facets(value, planes, self.interface.eta)

    def __str__(self) -> str:
        energy = "conserved by itself" if self.conserve_energy else "not conserved"
        if self.energy is not None:
            energy = "bounds the albedo by about one"
        lines = {
            "reflectance": self.boundary,
            **{scale.name: scale for scale in self.scales},
            "shadowing": SHADOWING[0 if self.shadowing else 1],
            "energy": energy,
        }
        return "\n".join(f"{name} = {value}" for name, value in lines.items())


class RigorousTheory(Theory):
    """f cos θ_o = n_o² Σ_m η_m Γ N(q − m/T; σ_q² I)/λ² cos θ_o: the efficiencies η_m include R, K, G and E."""

    scattering: RigorousOrders
    shadowing = True  # has no effect: it is part of the efficiencies

    def __init__(self, spectrum: RigorousSpectrum, request: GratingRequest) -> None:
        check_rigorous(spectrum, request)
        self.media = media = request.media
        self.boundary = PerfectMirror(f"{spectrum.medium_text}, in the efficiencies")
        self.scattering = shared((mi.variant(), spectrum.digest), lambda: RigorousOrders(spectrum))
        if not media.transmits:
            self.interface = _of_coat(request.coat)
        else:
            index, is_sheet = opaque(spectrum.int_ior.real), media.transmission == "sheet"
            self.interface = Interface(1.0, index, is_sheet, rigorous=True)
        self.index = 1.0 if media.coat is None else media.index
        shortest, longest = spectrum.wavelengths
        self.wavelengths = shortest * self.index, longest * self.index

    def cover(self, wavelengths: tuple[float, float]) -> None:
        (first, last), (shortest, longest) = wavelengths, self.wavelengths
        if first < shortest * (1 - 1e-6) or last > longest * (1 + 1e-6):
            coated = f", those inside of the index {self.index:g}" if self.index > 1 else ""
            raise RequestError(
                f"wavelengths: got light of {first:g} to {last:g} nm and a rigorous spectrum of {shortest:g} to "
                f"{longest:g} nm: build it for wavelengths=({first / self.index:.7g}, {last / self.index:.7g}){coated}"
            )
        self.light = wavelengths

    def power_and_density(
        self, geometry: Geometry, incidence: Incidence, pair: tuple[Coordinates, Coordinates] | None, active: mi.Bool
    ) -> tuple[mi.Float, mi.Float]:
        return self.scattering.power_and_density(geometry, incidence, active)

    def reflectance(self, si: mi.SurfaceInteraction3f, geometry: Geometry, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        return mi.UnpolarizedSpectrum(1.0)

    def split(
        self,
        value: mi.UnpolarizedSpectrum,
        si: mi.SurfaceInteraction3f,
        frame: tuple[mi.Float, mi.Float],
        active: mi.Bool,
    ) -> Split:
        sin, cos = frame
        relative = 1e3 * self.media.coat_index

        def entries(channel: int, source: mi.Vector3f, exit_: mi.Vector3f) -> list[list[mi.Float]]:
            frequency = relative / si.wavelengths[channel]
            # Under a coat, directions and wavelength are measured inside of it.
            k_i, k_o = (self.interface.wave_vector(rotated(omega, sin, cos)) for omega in (source, exit_))
            return self.scattering.mueller(k_i, k_o, frequency, active)

        return of_orders(value, entries, mi.Vector3f(-sin, cos, 0))

    def __str__(self) -> str:
        return f"reflectance = {self.boundary}"
