"""R(λ, ω_i·h): the power reflectance of the boundary between the media, at the half vector."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, TypeAlias

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError
from ..optics.film_stack import Stack
from ..optics.media import DEFAULT_INT_IOR, Media, MediumBelow
from ..optics.refractive_indices import MAX_INDEX, MIN_INDEX, KnownRange, RefractiveIndex, constant, index_of, is_file
from .coat import Coat
from .device_tables import opaque
from .indices import Dispersion, check_eta_and_k, index_from, nodes_of, range_of_texture
from .mitsuba_internals import nested_plugin

Cosines: TypeAlias = "mi.Float | mi.UnpolarizedSpectrum"


class Boundary:
    """The boundary to the medium below: R by `__call__`, R and T by `r_and_t`; by default without index and parameters.

    Indices are relative to that of the medium above in the middle of visible light, but for those that methods return,
    which are relative to it at each wavelength. `cos_half` may be one cosine for each wavelength.

    Attributes:
        transparent: whether the medium below does not absorb.
        eta: relative index of refraction in the middle of visible light, a mi.Float; None without an index.
        outside: absolute index of the medium above, to which indices are relative, in the middle of visible light.
        coat: this medium if it has dispersion; else None.
        varies: whether an index or a film varies over the surface.
        dispersion: the relative index of a transparent medium over the wavelength; None if it is constant.
    """

    transparent: bool = False
    eta: Any = None
    outside: float = 1.0
    coat: Coat | None = None
    varies: bool = False
    dispersion: Dispersion | None = None

    def __call__(self, si: mi.SurfaceInteraction3f, cos_half: Cosines, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Return R at the cosine ω_i·h, negative for light from below."""
        return self.r_and_t(si, cos_half, active)[0]

    def r_and_t(
        self, si: mi.SurfaceInteraction3f, cos_half: Cosines, active: mi.Bool
    ) -> tuple[mi.UnpolarizedSpectrum, mi.UnpolarizedSpectrum]:
        """Return R, and T into a transparent medium, at the cosine ω_i·h."""
        reflected = self(si, cos_half, active)
        return reflected, 1 - reflected

    def known_ranges(self) -> tuple[KnownRange, ...]:
        """Return where each index is known."""
        return ()

    def index(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> list[mi.Complex2f]:
        """Return n + ik of each wavelength."""
        raise NotImplementedError

    def above(self, si: mi.SurfaceInteraction3f) -> list[mi.Float | float]:
        """Return n of the medium above at each wavelength, relative to `outside`."""
        return [1.0 if self.coat is None else self.coat.per_nominal(wavelength) for wavelength in si.wavelengths]

    def stack(self, eta: float) -> Stack:
        """Return the transparent media for E and samplers; `eta` replaces a constant index."""
        raise NotImplementedError

    def planes(
        self, si: mi.SurfaceInteraction3f, cos_half: mi.Float, reflects: mi.Bool, active: mi.Bool
    ) -> list[mi.Matrix4f]:
        """Return the Mueller matrices of a plane between its s axes at each wavelength, up to a factor.

        A perfect mirror, which has no index, depolarises.
        """
        depolariser = mi.Matrix4f(0)
        depolariser[0, 0] = mi.Float(1.0)
        return [depolariser] * len(si.wavelengths)

    def update(self) -> None:
        """Recompute what depends on the parameters."""

    def traverse(self, callback: mi.TraversalCallback) -> None:
        """Show the parameters."""


def below_from(given: Mapping[str, Any]) -> MediumBelow:
    """Return the medium given by `int_ior`, `material`, or `eta` and `k` of a scene.

    Raises:
        RequestError: if they contradict each other or are unknown.
    """
    own = [name for name in ("eta", "k") if name in given]
    if "material" not in given and not own:
        return MediumBelow("int_ior", index_from("int_ior", given.get("int_ior", DEFAULT_INT_IOR)))
    named = own[0] if own else "material"
    if "int_ior" in given or ("ext_ior" in given and "coat_ior" not in given):
        raise RequestError(
            f"{named}: a conductor or a perfect mirror takes no int_ior or ext_ior; give one or the other"
        )
    if own:
        if "material" in given or own == ["k"]:
            raise RequestError(f"{named}: got {' and '.join(own)}, wanted eta and k, or material, one or the other")
        return MediumBelow("eta", None)
    material = given["material"]
    if not isinstance(material, str):
        raise RequestError(f"material: got {material!r}, wanted the name of a conductor, such as 'Al', or 'none'")
    return MediumBelow("material", None if material == "none" else conductor_from(material))


def boundary_from(media: Media, coat: Coat | None, eta_and_k: tuple[mi.Texture, mi.Texture] | None) -> Boundary:
    """Return the boundary to the medium below, which may be given by textures, relative to a coat if there is one."""
    below, above = media.below, None if coat is None or coat.dispersion is None else coat
    if below.parameter == "int_ior":
        assert below.index is not None
        return Dielectric(below.index, (media.coat or media.above).nominal.real, above)
    outside = media.outside if media.coat is None else media.coat.nominal.real
    if eta_and_k is not None:
        return SpectralConductor(*eta_and_k, outside, above)
    return PerfectMirror() if below.index is None else Conductor(below.index, outside, above)


def conductor_from(material: str) -> RefractiveIndex:
    """Return the index of the parameter `material`: the name of a conductor, or a file.

    Raises:
        RequestError: if there is none.
    """
    try:
        return index_of("material", str(mi.file_resolver().resolve(material)) if is_file(material) else material)
    except RequestError as error:
        raise RequestError(f"{error}; none is the perfect mirror, R = 1") from None


class PerfectMirror(Boundary):
    """R = 1."""

    def __init__(self, name: str = "none (R = 1)") -> None:
        self.name = name

    def __call__(self, si: mi.SurfaceInteraction3f, cos_half: Cosines, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        return mi.UnpolarizedSpectrum(1.0)

    def __repr__(self) -> str:
        return self.name


class Dielectric(Boundary):
    """A dielectric of relative index η without absorption, as Mitsuba's `dielectric`, or with dispersion."""

    transparent = True

    def __init__(self, medium: RefractiveIndex, outside: float, coat: Coat | None = None) -> None:
        self.medium, self.outside, self.coat = medium, outside, coat
        self.eta = mi.Float(medium.nominal.real / outside)
        if not medium.is_constant:
            self.dispersion = Dispersion([medium], outside)
        self.update()

    def known_ranges(self) -> tuple[KnownRange, ...]:
        return (self.medium.known_range("int_ior", clear=True),)

    def update(self) -> None:
        """Check the index and make it an opaque array: Dr.Jit would compile a literal into its kernels.

        Raises:
            RequestError: if it is none.
        """
        dr.make_opaque(self.eta)
        values = np.array(dr.detach(self.eta))
        if not ((values >= MIN_INDEX) & (values <= MAX_INDEX)).all():
            raise RequestError(
                f"eta: got {np.ravel(values)[0]:g}, wanted a positive relative index, {MIN_INDEX:g} to {MAX_INDEX:g}"
            )

    def _etas(self, si: mi.SurfaceInteraction3f) -> list[mi.Float]:
        etas = [self.eta if self.dispersion is None else self.dispersion(w).real for w in si.wavelengths]
        return etas if self.coat is None else [eta / above for eta, above in zip(etas, self.above(si), strict=True)]

    def __call__(self, si: mi.SurfaceInteraction3f, cos_half: Cosines, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        pairs = zip(mi.UnpolarizedSpectrum(cos_half), self._etas(si), strict=True)
        return mi.UnpolarizedSpectrum([mi.fresnel(cos, eta)[0] for cos, eta in pairs])

    def index(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> list[mi.Complex2f]:
        return [mi.Complex2f(eta, 0) for eta in self._etas(si)]

    def stack(self, eta: float) -> Stack:
        below = constant(eta * self.outside) if self.dispersion is None else self.medium
        return Stack(self.outside, below)

    def planes(
        self, si: mi.SurfaceInteraction3f, cos_half: mi.Float, reflects: mi.Bool, active: mi.Bool
    ) -> list[mi.Matrix4f]:
        found = []
        for index in self._etas(si):
            cos, eta = dr.abs(cos_half), dr.select(cos_half > 0, index, dr.rcp(index))
            reflection = mi.mueller.specular_reflection(cos, mi.Complex2f(eta, 0))
            found.append(dr.select(reflects, reflection, mi.mueller.specular_transmission(cos, eta)))
        return found

    def traverse(self, callback: mi.TraversalCallback) -> None:
        if self.dispersion is None:
            callback.put("eta", self.eta, mi.ParamFlags.Differentiable)

    def __repr__(self) -> str:
        return f"dielectric, eta = {self.eta}" if self.dispersion is None else f"dielectric, {self.medium}"


class SpectralConductor(Boundary):
    """A metal whose η + ik is given by two spectra, as in Mitsuba's `conductor`."""

    def __init__(self, eta: mi.Texture, k: mi.Texture, outside: float, coat: Coat | None = None) -> None:
        self.textures, self.outside, self.coat = (eta, k), outside, coat
        self._divisor = None if outside == 1 else opaque(outside)
        self.varies = eta.is_spatially_varying() or k.is_spatially_varying()
        self.update()

    def update(self) -> None:
        # Here, and not in `known`, which Dr.Jit calls while it records `eval`.
        eta, k = self.textures
        self._known = range_of_texture("eta", eta), range_of_texture("k", k)
        check_eta_and_k(eta, k, *self._known)

    def known_ranges(self) -> tuple[KnownRange, ...]:
        return self._known

    def __call__(self, si: mi.SurfaceInteraction3f, cos_half: Cosines, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        pairs = zip(mi.UnpolarizedSpectrum(cos_half), self.index(si, active), strict=True)
        return mi.UnpolarizedSpectrum([mi.fresnel_conductor(cos, n) for cos, n in pairs])

    def index(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> list[mi.Complex2f]:
        eta, k = (texture.eval(si, active) for texture in self.textures)
        if self._divisor is not None:
            eta, k = eta / self._divisor, k / self._divisor
        if self.coat is not None:
            above = mi.UnpolarizedSpectrum(self.above(si))
            eta, k = eta / above, k / above
        return [mi.Complex2f(*of_channel) for of_channel in zip(eta, k, strict=True)]

    def planes(
        self, si: mi.SurfaceInteraction3f, cos_half: mi.Float, reflects: mi.Bool, active: mi.Bool
    ) -> list[mi.Matrix4f]:
        return [mi.mueller.specular_reflection(cos_half, n) for n in self.index(si, active)]

    def traverse(self, callback: mi.TraversalCallback) -> None:
        for name, texture in zip(("eta", "k"), self.textures, strict=True):
            callback.put(name, texture, mi.ParamFlags.Differentiable)

    def __repr__(self) -> str:
        return "conductor, eta and k"


class Conductor(SpectralConductor):
    """A metal of index η + ik, named as in Mitsuba's `conductor` or from a file; under a coat, relative to it."""

    def __init__(self, medium: RefractiveIndex, outside: float, coat: Coat | None = None) -> None:
        grid = nodes_of(medium)
        values = medium(grid * 1e-3) / outside
        # A look-up in an irregular table is a search, which took half of the rendering time.
        of_n, of_k = (
            nested_plugin(
                "regular",
                wavelength_min=float(grid[0]),
                wavelength_max=float(grid[-1]),
                values=", ".join(repr(float(value)) for value in part),
            )
            if part.any()
            else nested_plugin("uniform", value=0.0)  # Mitsuba takes no table of zeros
            for part in (values.real, values.imag)
        )
        super().__init__(of_n, of_k, 1.0, coat)
        self.medium, self.outside = medium, outside

    def known_ranges(self) -> tuple[KnownRange, ...]:
        return (self.medium.known_range("material"),)

    def __repr__(self) -> str:
        return f"conductor, {self.medium}"
