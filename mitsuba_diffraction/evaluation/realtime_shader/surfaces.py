"""The gratings of a scene and their height fields."""

from __future__ import annotations

from dataclasses import dataclass

import mitsuba as mi

from ...bsdf.base import contains_grating, is_grating, nested
from ...bsdf.geometry import rotated
from ...bsdf.layers import Layers
from ...errors import RequestError
from ...rigorous.spectrum import RigorousSpectrum
from ...surface.heightfield import HeightField


@dataclass(frozen=True, eq=False)
class Surface:
    """One side of a grating in a scene.

    Attributes:
        bsdf: the BSDF of the shape, the grating or a `twosided` around it.
        layers: of the `diffraction_grating`; the shader ignores a coat.
        side: 1 for the front face, −1 for the back face.
    """

    bsdf: mi.BSDF
    layers: Layers
    side: int

    def is_of(self, bsdf: mi.BSDF) -> mi.Bool:
        """Return whether a point has the BSDF of this surface."""
        return bsdf == mi.BSDFPtr(self.bsdf)

    def contains(self, bsdf: mi.BSDF, wo: mi.Vector3f) -> mi.Bool:
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
        if is_grating(bsdf):
            found.append(Surface(bsdf, bsdf.layers, 1))
            continue
        parts = nested(bsdf)
        if bsdf.class_name() == "TwoSidedBRDF":
            sides = ((parts[0], 1), (parts[-1], -1))
            found += [Surface(bsdf, part.layers, side) for part, side in sides if is_grating(part)]
        elif any(map(contains_grating, parts)):
            raise RequestError(
                f"diffraction_shader: a diffraction_grating is nested in {bsdf.class_name()}, wanted on a shape or "
                "in twosided"
            )
    if any(isinstance(surface.layers.grating.spectrum, RigorousSpectrum) for surface in found):
        raise RequestError("diffraction_shader: got a grating with theory=rigorous, wanted one of scalar theory")
    return found


def heights_of(layers: Layers) -> tuple[HeightField, float]:
    """Return the height field and its coherence length in µm.

    Raises:
        ValueError: for a saved spectrum, which does not contain heights.
    """
    recipe = layers.grating.recipe
    if recipe is None:
        raise RequestError(
            "diffraction_shader: it needs heights, which a saved spectrum does not contain; give the grating a "
            "recipe (filename=….toml) or a profile"
        )
    return recipe.height_field(), float(recipe.settings.coherence_length)


def along_pattern(layers: Layers, si: mi.SurfaceInteraction3f, omega: mi.Vector3f, active: mi.Bool) -> mi.Vector3f:
    """Return a direction, given in the shading frame, in the frame of the pattern."""
    return rotated(omega, *layers.grating.frame(si, active))


def transmitted(
    layers: Layers, si: mi.SurfaceInteraction3f, cos_o: mi.Float, active: mi.Bool
) -> mi.UnpolarizedSpectrum:
    """Return (1 − R_i)(1 − R_o), the transmittance of the surface to the base and out again."""
    transmittance = layers.grating.transmittance
    return transmittance(si, mi.Frame3f.cos_theta(si.wi), active) * transmittance(si, cos_o, active)
