"""The gratings of a scene and their height fields."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import drjit as dr
import mitsuba as mi

from ...bsdf.base import Base, contains_grating, nested
from ...bsdf.coat import Coat
from ...errors import RequestError
from ...surface.heightfield import HeightField


@runtime_checkable
class ShadedGrating(Protocol):
    """The interface of a BSDF that the shader can shade as a grating.

    Attributes:
        height_scale: scales the heights.
        shadowing: "v_cavity" or "none".
        base: the BSDF below the surface.
        coat: the layer above it, ignored by the shader.
        rigorous: whether its efficiencies are those of rigorous theory.
        reflectance: R(si, cos θ, active) at the angle to the microfacet.
    """

    height_scale: mi.Float
    shadowing: str
    base: Base | None
    coat: Coat | None
    rigorous: bool
    reflectance: Callable[[mi.SurfaceInteraction3f, mi.Float, mi.Bool], mi.UnpolarizedSpectrum]

    def heights(self) -> tuple[HeightField, float]:
        """Return the height field and its coherence length in µm; raise ValueError where they are not known."""

    def along_pattern(self, si: mi.SurfaceInteraction3f, omega: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
        """Rotate a direction of the shading frame to the axes of the pattern."""

    def transmitted(self, si: mi.SurfaceInteraction3f, cos_o: mi.Float, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Return (1 − R_i)(1 − R_o), the share transmitted to the base and back."""


@dataclass(frozen=True, eq=False)
class Surface:
    """One side of a grating in a scene.

    Attributes:
        bsdf: the BSDF of the shape, the grating or a `twosided` around it.
        grating: the `diffraction_grating`.
        side: 1 for the front, −1 for the back.
    """

    bsdf: mi.BSDF
    grating: ShadedGrating
    side: int

    def is_of(self, bsdf: mi.BSDF) -> mi.Bool:
        """Return whether a point has the BSDF of this surface."""
        return bsdf == mi.BSDFPtr(self.bsdf) if dr.is_jit_v(mi.Float) else mi.Bool(bsdf is self.bsdf)

    def holds(self, bsdf: mi.BSDF, wo: mi.Vector3f) -> mi.Bool:
        """Return whether a point with this BSDF, seen from ω_o, lies on this side of this surface."""
        return self.is_of(bsdf) & (self.side * wo.z > 0)


def surfaces_of(scene: mi.Scene) -> list[Surface]:
    """Return all gratings of a scene.

    Raises:
        ValueError: if a grating is nested in a BSDF other than `twosided`, or is of rigorous theory.
    """
    found: list[Surface] = []
    seen: list[mi.BSDF] = []
    for shape in scene.shapes():
        bsdf = shape.bsdf()
        if bsdf is None or any(bsdf is other for other in seen):
            continue
        seen.append(bsdf)
        if isinstance(bsdf, ShadedGrating):
            found.append(Surface(bsdf, bsdf, 1))
            continue
        parts = nested(bsdf)
        if bsdf.class_name() == "TwoSidedBRDF":
            sides = ((parts[0], 1), (parts[-1], -1))
            found += [Surface(bsdf, part, side) for part, side in sides if isinstance(part, ShadedGrating)]
        elif any(map(contains_grating, parts)):
            raise RequestError(
                f"diffraction_shader: a diffraction_grating stands inside {bsdf.class_name()}, wanted on a shape or "
                "inside twosided"
            )
    if any(surface.grating.rigorous for surface in found):
        raise RequestError("diffraction_shader: got a grating with theory=rigorous, wanted one of scalar theory")
    return found
