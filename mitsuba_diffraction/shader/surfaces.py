"""The gratings of a scene and their height fields."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..bsdf.nesting import contains_grating, is_grating, nested
from ..coherence import SUN_COHERENCE_LENGTH
from ..errors import RequestError
from ..surface.heightfield import HeightField


@dataclass(frozen=True, eq=False)
class Surface:
    """One side of a grating in a scene.

    Attributes:
        bsdf: the BSDF of the shape, the grating or a `twosided` around it.
        grating: the `diffraction_grating`.
        side: 1 for the front, −1 for the back.
    """

    bsdf: mi.BSDF
    grating: mi.BSDF
    side: int

    def is_of(self, bsdf: mi.BSDF) -> mi.Bool:
        """Whether a point has the BSDF of this surface."""
        return bsdf == mi.BSDFPtr(self.bsdf) if dr.is_jit_v(mi.Float) else mi.Bool(bsdf is self.bsdf)

    def holds(self, bsdf: mi.BSDF, wo: mi.Vector3f) -> mi.Bool:
        """Whether a point with this BSDF, seen from ω_o, lies on this side of this surface."""
        return self.is_of(bsdf) & (self.side * wo.z > 0)


def surfaces_of(scene: mi.Scene) -> list[Surface]:
    """All gratings of a scene.

    Raises:
        ValueError: if a grating is nested in a BSDF other than `twosided`.
    """
    found: list[Surface] = []
    seen: list[mi.BSDF] = []
    for shape in scene.shapes():
        bsdf = shape.bsdf()
        if bsdf is None or any(bsdf is other for other in seen):
            continue
        seen.append(bsdf)
        if is_grating(bsdf):
            found.append(Surface(bsdf, bsdf, 1))
            continue
        parts = nested(bsdf)
        if bsdf.class_name() == "TwoSidedBRDF":
            sides = ((parts[0], 1), (parts[-1], -1))
            found += [Surface(bsdf, part, side) for part, side in sides if is_grating(part)]
        elif any(map(contains_grating, parts)):
            raise RequestError(
                f"diffraction_shader: a diffraction_grating stands inside {bsdf.class_name()}, wanted on a shape or "
                "inside twosided"
            )
    return found


def heights_of(grating: mi.BSDF) -> tuple[HeightField, float]:
    """The height field of a grating, of several patches the first, and its coherence length in µm.

    Raises:
        ValueError: if it was loaded from a spectrum file, which does not contain heights.
    """
    if grating.recipe is None:
        raise RequestError(
            "diffraction_shader: it needs heights, and a saved spectrum does not hold them; give the grating a "
            "recipe (filename=….toml) or a profile"
        )
    recipe = grating.recipe
    return recipe.height_field(), float(recipe.spectrum.get("coherence_length", SUN_COHERENCE_LENGTH))
