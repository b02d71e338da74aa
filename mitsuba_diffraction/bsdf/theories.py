"""What each theory adds to the powers of orders: parameters, material, the factors R and E, polarisation."""

from __future__ import annotations

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np

from ..energy.furnace import small_kappas
from ..errors import RequestError
from ..geometry import SHADOWING
from ..grating_spectrum import GratingSpectrum
from ..rigorous.spectrum import RigorousSpectrum
from ..settings import VISIBLE
from .coat import SAME_INDEX, Coat
from .geometry import Geometry, turned
from .media import Media
from .order_table import CHANGE
from .polarisation import Split, of_interface, of_orders, of_plane, unpolarised
from .reflectance import Conductor, PerfectMirror, reflectance_from
from .scales import Scales
from .shared import SharedTables
from .tables import opaque
from .transmission import Interface

_SCALAR_ONLY = {
    "height_scale": "build the spectrum of the other depth",
    "lateral_scale": "build the spectrum of the other period",
    "base": "what passes the surface is not computed; leave it out",
    "shadowing": "it is part of the efficiencies; leave it out",
    "fresnel": "it is part of the efficiencies; leave it out",
}


def settings_from(props: mi.Properties, coat: Coat | None) -> dict[str, str | float]:
    """`material` or `int_ior` as `precompute` takes them, by Mitsuba's names; an index relative to the outside.

    Raises:
        ValueError: if they are unknown, or the material is the perfect mirror.
    """
    found = reflectance_from(props, coat)
    if isinstance(found, Conductor):
        return {"material": found.material}
    if isinstance(found, PerfectMirror):
        raise RequestError("material: got 'none', wanted a real one for theory=rigorous, such as 'Al'")
    # As many digits as a float32 has.
    eta = float(np.max(found.eta)) * (1 if coat is None else coat.relative)
    return {"int_ior": float(f"{eta:.6g}")}


def settings_of_medium(media: Media) -> dict[str, str | float | bool]:
    """What `precompute` needs to know of the coat, of light that passes and of the variant."""
    medium = {} if media.coat is None else {"ext_ior": float(f"{media.coat.relative:.6g}")}
    if media.transmission != "none":
        medium["transmission"] = media.transmission
    return {**medium, "polarised": True} if mi.is_polarized else medium


class ScalarTheory:
    """f cos θ_o = R · K · G · S(q; κ)/λ² · E cos θ_o.

    Attributes:
        scattering: K G S cos θ_o and its sampler.
        material: R.
        media: about the grating, with an index that tables are for.
        scales: of heights and of lengths along the surface.
        shadowing: whether G is a factor.
        energy: E, or None where it is one.
        interface: the media on both sides where light passes, else None.
    """

    def __init__(self, props: mi.Properties, spectrum: GratingSpectrum, media: Media, scales: Scales) -> None:
        self.spectrum, self.media, self.scales = spectrum, media, scales
        self.material = reflectance_from(props, media.coat)
        if media.eta is not None and self.material.model == "schlick":
            raise RequestError("fresnel: got 'schlick' with a transmission, wanted 'exact'")
        shadowing = props.get("shadowing", SHADOWING[0])
        if shadowing not in SHADOWING:
            raise RequestError(f"shadowing: got {shadowing!r}, wanted one of {', '.join(SHADOWING)}")
        self.shadowing = shadowing == "v_cavity"
        self.conserve_energy = props.get("conserve_energy", True)
        if not isinstance(self.conserve_energy, bool):
            raise RequestError(f"conserve_energy: got {self.conserve_energy!r}, wanted true or false")
        self.tables = SharedTables.of(spectrum, media.eta)
        self.scattering = self.tables.scattering
        self.update()

    def update(self) -> None:
        """Check the parameters that can change, and recompute what depends on them.

        Raises:
            ValueError: if the spectrum does not cover the scales, or the wavelengths inside a coat.
        """
        shortest = VISIBLE[0] / self.media.index
        max_scale = shortest / self.spectrum.wavelengths[0]
        if self.media.index > 1 and max_scale < 1 - 1e-6:
            name, place = "int_ior", "the material"
            if self.media.eta is None:
                name, place = ("ext_ior", "it") if self.media.coat is None else ("coat_ior", "the coat")
            raise RequestError(
                f"{name}: got {self.media.index:g}, and a spectrum for wavelengths from "
                f"{self.spectrum.wavelengths[0]:g} nm; inside {place} they are shorter: build it from "
                f"{shortest:.4g} nm"
            )
        scales = self.scales
        scales.check(self.spectrum.wavelengths, self.media.index, getattr(self.scattering, "max_scale", None))
        self.energy = None
        if self.conserve_energy and self.shadowing:
            of_number = self.tables.energy
            self.energy = self.tables.scaled_energy(*scales.ratios()) if scales.vary else of_number(scales.height.value)
        self.interface = self._interface()

    def _interface(self) -> Interface | None:
        """Return the media on both sides, with orders drawn for the scales and the index as they are."""
        if self.media.eta is None:
            return None
        kappas = tuple(opaque(kappa) for kappa in small_kappas(self.spectrum, self.media.eta))
        is_sheet = self.media.transmission == "sheet"
        share, orders = None, self.tables.order_table(is_sheet, self.scales)
        if orders is not None:
            self.scattering, share = self.tables.scattering.drawn_from(orders), orders.transmitted
        return Interface(self.material.eta, is_sheet, kappas, share)

    def parameters_changed(self, keys: list[str]) -> None:
        """Recompute what depends on the parameters `keys`; on all of them if none is named."""
        changed = [scale for scale in self.scales if not keys or scale.name in keys]
        for scale in changed:
            scale.read()
        self.material.update()
        other_index = False
        if self.media.eta is not None:
            # Tables serve for nearly the same index, so that a scene in which it varies smoothly is not slowed down.
            eta, before = float(np.max(dr.detach(self.material.eta))), self.media.eta
            if not 0 < eta < np.inf or abs(eta - 1) < SAME_INDEX:
                raise RequestError(f"eta: got {eta:g}, wanted a positive relative index other than one: light passes")
            other_index = abs(eta - before) > CHANGE * abs(before - 1)
            if other_index:
                self.media = dataclasses.replace(self.media, eta=eta)
                self.tables = SharedTables.of(self.spectrum, eta)
                self.scattering = self.tables.scattering
        if changed or other_index:
            self.update()
        else:
            self.interface = self._interface()

    def traverse(self, callback: mi.TraversalCallback) -> None:
        for scale in self.scales:
            scale.put(callback)
        self.material.traverse(callback)

    def times_reflectance(
        self, value: mi.UnpolarizedSpectrum, si: mi.SurfaceInteraction3f, geometry: Geometry, active: mi.Bool
    ) -> mi.UnpolarizedSpectrum:
        """Return `value` times R."""
        reflected = self.material(si, geometry.cos_half(), active)
        if self.media.eta is not None:
            reflected = dr.select(geometry.reflects, reflected, 1 - reflected)
        return value * reflected

    def split(
        self,
        value: mi.UnpolarizedSpectrum,
        si: mi.SurfaceInteraction3f,
        frame: tuple[mi.Float, mi.Float],
        active: mi.Bool,
    ) -> Split:
        """Return how the grating splits `value` into s and p."""
        index = self.material.index(si, active)
        if index is None:
            return unpolarised(value)
        return of_plane(value, index) if self.media.eta is None else of_interface(value, self.material.eta)

    def __str__(self) -> str:
        lines = {
            "reflectance": self.material,
            **{scale.name: scale for scale in self.scales},
            "shadowing": SHADOWING[0 if self.shadowing else 1],
            "energy": self.energy or ("conserved by itself" if self.conserve_energy else "not conserved"),
        }
        return "\n".join(f"{name} = {value}" for name, value in lines.items())


class RigorousTheory:
    """f cos θ_o = Σ_m η_m N(q − m/T; σ_q² I)/λ² cos θ_o: R, K, G and E are in the efficiencies η_m.

    Attributes:
        scattering: Σ_m η_m N n_o² cos θ_o and its sampler.
        material: R = 1 beside the efficiencies.
        interface: the media on both sides where light passes, else None.
    """

    shadowing, energy = True, None  # of no effect: they are in the efficiencies

    def __init__(self, props: mi.Properties, spectrum: RigorousSpectrum, media: Media) -> None:
        self.media, coat = media, media.coat
        if media.outside > 1 and coat is None:
            raise RequestError(f"ext_ior: got {media.outside:g} with theory=rigorous, wanted air or a coat")
        check_transmission(spectrum.transmission, media)
        self.material = check_parameters(props, spectrum, coat)
        self.scattering = SharedTables.of(spectrum).scattering
        self.interface = None
        if media.eta is not None:
            self.interface = Interface(opaque(spectrum.int_ior.real), media.transmission == "sheet")

    def parameters_changed(self, keys: list[str]) -> None:
        """Do nothing: a table of efficiencies has no parameters."""

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Show no parameters."""

    def times_reflectance(
        self, value: mi.UnpolarizedSpectrum, si: mi.SurfaceInteraction3f, geometry: Geometry, active: mi.Bool
    ) -> mi.UnpolarizedSpectrum:
        """Return `value`."""
        return value

    def split(
        self,
        value: mi.UnpolarizedSpectrum,
        si: mi.SurfaceInteraction3f,
        frame: tuple[mi.Float, mi.Float],
        active: mi.Bool,
    ) -> Split:
        """Return how the grating splits `value` into s and p."""
        sin, cos = frame
        relative = 1e3 if self.media.coat is None else 1e3 * self.media.coat.relative

        def entries(channel: int, source: mi.Vector3f, exit_: mi.Vector3f) -> list[list[mi.Float]]:
            frequency = relative / si.wavelengths[channel]
            pair, above = [turned(omega, sin, cos) for omega in (source, exit_)], None
            if self.interface is not None:
                sides = [self.interface.side(omega) for omega in pair]
                pair, above = [side.tangent for side in sides], [side.sign > 0 for side in sides]
            return self.scattering.mueller(*pair, frequency, active, above)

        return of_orders(value, entries, mi.Vector3f(-sin, cos, 0))

    def __str__(self) -> str:
        return f"reflectance = {self.material}"


def check_transmission(of_spectrum: str, media: Media) -> None:
    """Refuse a rigorous spectrum of other light than the scene asks for.

    Raises:
        ValueError: if `transmission` of both differs.
    """
    if of_spectrum != media.transmission:
        raise RequestError(
            f"transmission: got {media.transmission!r}, but the rigorous spectrum is of transmission={of_spectrum}: "
            "say the same, or build the spectrum for it"
        )


def refuse_scalar_only(props: mi.Properties) -> None:
    """Refuse parameters that rigorous theory does not have.

    Raises:
        ValueError: if one is given.
    """
    for name, advice in _SCALAR_ONLY.items():
        if name in props:
            texture = isinstance(props[name], mi.Texture)
            got = "a BSDF" if name == "base" else "a texture" if texture else repr(props[name])
            raise RequestError(f"{name}: got {got}, wanted none with theory=rigorous: {advice}")


def check_parameters(props: mi.Properties, spectrum: RigorousSpectrum, coat: Coat | None) -> PerfectMirror:
    """Return R = 1 beside a rigorous spectrum, whose efficiencies are those of the material.

    Raises:
        ValueError: if it is of another material, medium or kind of light, or says something that rigorous theory does
            not have.
    """
    if mi.is_polarized and spectrum.mueller is None:
        raise RequestError(
            f"theory: got a rigorous spectrum of unpolarised light in the variant {mi.variant()}, wanted one that was "
            "built with polarised=True"
        )
    refuse_scalar_only(props)
    medium = 1.0 if coat is None else coat.relative
    if abs(spectrum.ext_ior - medium) > 1e-3 * medium:
        raise RequestError(
            f"coat_ior: got {'none' if coat is None else f'{coat.index:g}'}, but the rigorous spectrum is of a grating "
            f"below a medium of index {spectrum.ext_ior:g}: build it with ext_ior={medium:.4g}"
        )
    # Over a coat, ext_ior is what lies above it.
    if any(name in props for name in ("material", "int_ior", *(["ext_ior"] if coat is None else []))):
        wanted = settings_from(props, coat)
        if "material" in wanted:
            same = wanted["material"] == spectrum.material
        else:
            same = not spectrum.material and abs(wanted["int_ior"] - spectrum.int_ior) < 1e-3 * abs(spectrum.int_ior)
        if not same:
            got = " ".join(f"{name} {value}" for name, value in wanted.items())
            raise RequestError(
                f"material: got {got}, but the rigorous spectrum is of {spectrum.material_name}: "
                "leave it out, or build the spectrum for this material"
            )
    return PerfectMirror(f"{spectrum.material_name}, in the efficiencies")
