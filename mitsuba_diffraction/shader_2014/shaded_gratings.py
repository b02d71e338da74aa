"""The gratings of a scene, and the shader in their place."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..bsdf.base import gratings_in, is_grating
from ..bsdf.directions import rotated
from ..bsdf.layers import Layers
from ..bsdf.mitsuba_internals import parts
from ..errors import RequestError
from ..precomputation.recipe import Recipe
from ..rigorous.rigorous_spectrum import RigorousSpectrum
from .shader import Shader, SpectralWeights

_MAX_MASKS = 16  # that a ray passes


def gratings_of(scene: mi.Scene) -> tuple[list[mi.BSDF], list[mi.BSDF]]:
    """Return all gratings of a scene, and the BSDFs of its shapes which they are or are nested in.

    Raises:
        ValueError: if a grating is of rigorous theory or has a lateral scale.
    """
    gratings: list[mi.BSDF] = []
    outer: list[mi.BSDF] = []
    for shape in scene.shapes():
        bsdf = shape.bsdf()
        if any(bsdf is other for other in outer) or not gratings_in(bsdf):
            continue
        outer.append(bsdf)
        inside = [bsdf]
        while inside:
            part = inside.pop()
            if not is_grating(part):
                inside += parts(part, mi.BSDF)
            elif all(part is not other for other in gratings):
                gratings.append(part)
    for bsdf in gratings:
        grating = bsdf.layers.grating
        if isinstance(grating.spectrum, RigorousSpectrum):
            raise RequestError("diffraction_shader: got a grating with theory=rigorous, wanted one of scalar theory")
        if grating.scales.lateral is not None:
            raise RequestError("diffraction_shader: got a grating with a lateral_scale, wanted one without")
    return gratings, outer


def recipe_of_layers(layers: Layers) -> Recipe:
    """Return the recipe of a grating, which has its heights.

    Raises:
        ValueError: for a saved spectrum, which does not contain heights.
    """
    recipe = layers.grating.recipe
    if recipe is None:
        raise RequestError(
            "diffraction_shader: it needs heights, which a saved spectrum does not contain; give the grating a "
            "recipe (filename=….toml) or a profile"
        )
    return recipe


@dataclass(eq=False)
class Shaded:
    """The layers of a grating for the shader.

    While the shader renders, it takes the place of the layers in their BSDF, so that Mitsuba's own BSDFs around it
    apply: `twosided`, normal and bump maps, masks, blends.

    Attributes:
        layers: of the `diffraction_grating`; the shader ignores a coat.
        shader: of its heights.
        weights: one table for each light.
        base_weight: constant weight of the base; None for the transmittance of the surface.
        scale: factor of the colours of the shader, before they are blended with the base.
        light: index of a light: its linear sRGB is added to the first three wavelengths of the base's value; None for
            the base alone.
    """

    layers: Layers
    shader: Shader
    weights: list[SpectralWeights]
    base_weight: float | None
    scale: mi.Float
    light: int | None = None

    def eval_pdf(
        self, ctx: mi.BSDFContext, si: mi.SurfaceInteraction3f, wo: mi.Vector3f, active: mi.Bool
    ) -> tuple[mi.Spectrum, mi.Float]:
        """Return what `Layers.eval_pdf` does, without density; ω_i is the direction to the viewer, ω_o to the light."""
        value, weight = mi.UnpolarizedSpectrum(0), mi.Float(1)
        grating, base = self.layers.grating, self.layers.base
        active = active & (mi.Frame3f.cos_theta(si.wi) > 0) & (mi.Frame3f.cos_theta(wo) > 0)
        if base is not None:
            value = mi.unpolarized_spectrum(base.bsdf.eval(mi.BSDFContext(), si, wo, active))
            if self.base_weight is None:
                for omega in (si.wi, wo):
                    value *= grating.transmittance(si, mi.Frame3f.cos_theta(omega), active)
            else:
                value, weight = self.base_weight * value, mi.Float(1 - self.base_weight)
        if self.light is not None:
            frame = grating.frame(si, active)
            rgb = self.shader.rgb(
                rotated(wo, *frame),
                rotated(si.wi, *frame),
                self.weights[self.light],
                active,
                grating.scales.height.value_at(si, active),
            )
            for channel in range(3):
                value[channel] += weight * self.scale * rgb[channel]
        return mi.depolarizer(dr.select(active, value, 0)), mi.Float(0)


@contextmanager
def in_place(gratings: list[mi.BSDF], shaded: list[Shaded]) -> Iterator[None]:
    """Put the shader in the place of the layers of gratings, within a `with` block."""
    try:
        for bsdf, layers in zip(gratings, shaded, strict=True):
            bsdf.layers = layers
        yield
    finally:
        for bsdf, layers in zip(gratings, shaded, strict=True):
            bsdf.layers = layers.layers


def sum_along(
    scene: mi.Scene,
    ray: mi.RayDifferential3f,
    active: mi.Bool,
    at_hit: Callable[[mi.SurfaceInteraction3f, mi.BSDFPtr, mi.Bool], tuple],
) -> tuple[tuple, mi.Bool]:
    """Sum what a ray shows: the first surface that it hits, and through masks the surfaces behind.

    Args:
        scene: the scene.
        ray: from the camera.
        active: mask.
        at_hit: returns arrays for a surface.

    Returns:
        The sums, and whether a surface was hit.
    """
    masked = any(
        shape.bsdf() is not None and mi.has_flag(shape.bsdf().flags(), mi.BSDFFlags.Null) for shape in scene.shapes()
    )
    si = scene.ray_intersect(ray, active)
    hit = active & si.is_valid()
    bsdf = si.bsdf(ray)
    sums = at_hit(si, bsdf, hit)
    if not masked:
        return sums, hit

    def behind(si: mi.SurfaceInteraction3f, bsdf: mi.BSDFPtr, active: mi.Bool) -> mi.Float:
        # Masks and blends with them are grey.
        return dr.select(active, mi.unpolarized_spectrum(bsdf.eval_null_transmission(si, active))[0], 0)

    def step(ray: mi.Ray3f, throughput: mi.Float, count: mi.UInt32, *sums: object) -> tuple[object, ...]:
        si = scene.ray_intersect(ray, throughput > 0)
        hit = (throughput > 0) & si.is_valid()
        bsdf = si.bsdf()
        added = (total + throughput * value for total, value in zip(sums, at_hit(si, bsdf, hit), strict=True))
        return si.spawn_ray(ray.d), throughput * behind(si, bsdf, hit), count + 1, *added

    state = dr.while_loop(
        (si.spawn_ray(ray.d), behind(si, bsdf, hit), mi.UInt32(0), *sums),
        lambda ray, throughput, count, *sums: (throughput > 0) & (count < _MAX_MASKS),
        step,
    )
    return state[3:], hit
