"""R(λ, ω_i·h): the power reflectance of the material at the half vector."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError
from ..rigorous.materials import conductor
from ..settings import VISIBLE
from .base import nested_plugin
from .coat import MAX_INDEX, MIN_INDEX, Coat, absolute_index


class Material:
    """The reflectance of a material, from `__call__` or `powers`; by default it has no index and no parameters.

    Attributes:
        transparent: whether transmitted light is not absorbed.
        wavelengths: range in which the reflectance is known, nm.
        eta: relative index of refraction, a mi.Float; of a metal its real part, a mi.Texture; else None.
        outside: absolute index of the medium above, to which indices are relative.
        varies: whether the material varies over the surface.
    """

    transparent: bool = False
    wavelengths: tuple[float, float] = (0.0, np.inf)
    eta: Any = None
    outside: float = 1.0
    varies: bool = False

    def __call__(self, si: mi.SurfaceInteraction3f, cos_half: mi.Float, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Return R at the cosine ω_i·h, negative for light from below."""
        return self.powers(si, cos_half, active)[0]

    def powers(
        self, si: mi.SurfaceInteraction3f, cos_half: mi.Float, active: mi.Bool
    ) -> tuple[mi.UnpolarizedSpectrum, mi.UnpolarizedSpectrum]:
        """Return R, and T of a transparent material, at the cosine ω_i·h."""
        reflected = self(si, cos_half, active)
        return reflected, 1 - reflected

    def index(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> list[mi.Complex2f]:
        """Return n + ik of each wavelength."""
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


def reflectance_from(props: mi.Properties, coat: Coat | None) -> Material:
    """Return the material given by `int_ior`, `ext_ior` and `material`, relative to a coat if there is one.

    Raises:
        RequestError: if they contradict each other or are unknown.
    """
    if "material" not in props:
        outside = props.get("ext_ior", "air")
        return Dielectric(props.get("int_ior", 1.5), outside if coat is None else coat.index)
    if "int_ior" in props or ("ext_ior" in props and "coat_ior" not in props):
        raise RequestError(
            "material: a conductor or a perfect mirror takes no int_ior or ext_ior; give one or the other"
        )
    material = props["material"]
    if not isinstance(material, str):
        raise RequestError(f"material: got {material!r}, wanted the name of a conductor, such as 'Al', or 'none'")
    if material == "none":
        return PerfectMirror()
    # There is no coat if its index is that of the outside.
    outside = coat.index if coat is not None else absolute_index("ext_ior", props.get("ext_ior", 1.0))
    return Conductor(material, outside)


class PerfectMirror(Material):
    """R = 1."""

    def __init__(self, name: str = "none (R = 1)") -> None:
        self.name = name

    def __call__(self, si: mi.SurfaceInteraction3f, cos_half: mi.Float, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        return mi.UnpolarizedSpectrum(1.0)

    def __repr__(self) -> str:
        return self.name


class Dielectric(Material):
    """A dielectric of relative index η without absorption or dispersion, as Mitsuba's `dielectric`."""

    transparent = True

    def __init__(self, int_ior: float | str, ext_ior: float | str) -> None:
        self.outside = absolute_index("ext_ior", ext_ior)
        self.eta = mi.Float(absolute_index("int_ior", int_ior) / self.outside)
        self.update()

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

    def __call__(self, si: mi.SurfaceInteraction3f, cos_half: mi.Float, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        return mi.UnpolarizedSpectrum(mi.fresnel(cos_half, self.eta)[0])

    def index(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> list[mi.Complex2f]:
        return [mi.Complex2f(self.eta, 0)] * len(si.wavelengths)

    def planes(
        self, si: mi.SurfaceInteraction3f, cos_half: mi.Float, reflects: mi.Bool, active: mi.Bool
    ) -> list[mi.Matrix4f]:
        cos, eta = dr.abs(cos_half), dr.select(cos_half > 0, self.eta, dr.rcp(self.eta))
        reflection = mi.mueller.specular_reflection(cos, mi.Complex2f(eta, 0))
        return [dr.select(reflects, reflection, mi.mueller.specular_transmission(cos, eta))] * len(si.wavelengths)

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("eta", self.eta, mi.ParamFlags.Differentiable)

    def __repr__(self) -> str:
        return f"dielectric, eta = {self.eta}"


class Conductor(Material):
    """A metal of index η + ik, named as in Mitsuba's `conductor`; under a coat, relative to the index of the coat."""

    def __init__(self, material: str, outside: float) -> None:
        data = Path(str(mi.file_resolver().resolve("data/ior/Al.eta.spd"))).parent
        try:
            wavelengths, *index = conductor(material, data)
        except RequestError as error:
            raise RequestError(f"{error}; none is the perfect mirror, R = 1") from None
        # In visible light constant where the table ends.
        grid = np.arange(
            min(VISIBLE[0], np.ceil(wavelengths[0] * 1e3)), max(VISIBLE[1], np.floor(wavelengths[-1] * 1e3)) + 1
        )
        self.wavelengths = float(grid[0]), float(grid[-1])
        self.eta, self.k = (self._spectrum(grid, np.interp(grid * 1e-3, wavelengths, n) / outside) for n in index)
        self.material, self.outside = material, outside

    @staticmethod
    def _spectrum(grid: NDArray[np.float64], values: NDArray[np.float64]) -> mi.Texture:
        """Make a texture from the values at equidistant wavelengths in nm."""
        # A look-up in an irregular table is a search, which took half of the rendering time.
        text = ", ".join(repr(float(value)) for value in values)
        return nested_plugin("regular", wavelength_min=float(grid[0]), wavelength_max=float(grid[-1]), values=text)

    def __call__(self, si: mi.SurfaceInteraction3f, cos_half: mi.Float, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        return mi.UnpolarizedSpectrum([mi.fresnel_conductor(cos_half, n) for n in self.index(si, active)])

    def index(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> list[mi.Complex2f]:
        eta, k = self.eta.eval(si, active), self.k.eval(si, active)
        return [mi.Complex2f(*of_channel) for of_channel in zip(eta, k, strict=True)]

    def planes(
        self, si: mi.SurfaceInteraction3f, cos_half: mi.Float, reflects: mi.Bool, active: mi.Bool
    ) -> list[mi.Matrix4f]:
        return [mi.mueller.specular_reflection(cos_half, n) for n in self.index(si, active)]

    def traverse(self, callback: mi.TraversalCallback) -> None:
        callback.put("eta", self.eta, mi.ParamFlags.Differentiable)
        callback.put("k", self.k, mi.ParamFlags.Differentiable)

    def __repr__(self) -> str:
        return f"conductor, {self.material}"
