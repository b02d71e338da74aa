"""The shapes of a scene that are gratings: telling them apart, and points on them."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ..bsdf.nesting import contains_grating, nested


class Gratings:
    """The shapes whose BSDF is or holds a `diffraction_grating` and on which points can be drawn by area.

    A shape counts as a whole, whichever component of its BSDF reflects: both sides of `twosided`, all of a blend, and
    the base. Instances and curves, on which Mitsuba draws no points, do not count.

    Attributes:
        shapes: of the scene.
        perturbed: whether the scene has a BSDF that turns the shading normal by itself, a normal or a bump map.
    """

    def __init__(self, scene: mi.Scene) -> None:
        surfaces = [(shape, shape.bsdf()) for shape in scene.shapes()]
        surfaces = [(shape, bsdf) for shape, bsdf in surfaces if bsdf is not None]
        self.perturbed = any(_perturbs(bsdf) for _, bsdf in surfaces)
        areas = [(shape, _area(shape)) for shape, bsdf in surfaces if contains_grating(bsdf)]
        areas = [(shape, area) for shape, area in areas if area > 0]
        self.shapes = [shape for shape, _ in areas]
        if not self.shapes:
            return
        self._choice = mi.DiscreteDistribution([area for _, area in areas])
        if dr.is_jit_v(mi.Float):
            numbers = [dr.reinterpret_array(mi.UInt32, mi.ShapePtr(shape))[0] for shape in self.shapes]
            self._size = dr.opaque(mi.UInt32, max(numbers) + 1)
            self._table = dr.zeros(mi.UInt32, max(numbers) + 1)
            dr.scatter(self._table, mi.UInt32(1), mi.UInt32(numbers))
            self._pointers = dr.reinterpret_array(mi.ShapePtr, mi.UInt32(numbers))
            dr.eval(self._table, self._pointers)

    def __contains__(self, shape: mi.Shape) -> bool:
        return any(shape is one for one in self.shapes)

    def hold(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Bool:
        """Whether a point lies on one of them."""
        if not dr.is_jit_v(mi.Float):
            return si.shape in self
        number = dr.reinterpret_array(mi.UInt32, si.shape)
        return dr.gather(mi.UInt32, self._table, number, active & (number < self._size)) == 1

    def sample(self, time: mi.Float, u: mi.Float, v: mi.Point2f) -> mi.PositionSample3f:
        """A point on them, uniform by area; `pdf` is the density in area."""
        index, share = self._choice.sample_pmf(u)
        if dr.is_jit_v(mi.Float):
            point = dr.gather(mi.ShapePtr, self._pointers, index).sample_position(time, v)
        else:
            point = self.shapes[index].sample_position(time, v)
        point.pdf *= share
        return point


def _area(shape: mi.Shape) -> float:
    """Zero where Mitsuba draws no points."""
    try:
        shape.sample_position(0.0, mi.Point2f(0.5))
        area = shape.surface_area()
    except RuntimeError as error:
        if "not implemented" not in str(error):
            raise
        return 0.0
    return float(area[0] if dr.is_jit_v(mi.Float) else area)


def _perturbs(bsdf: mi.BSDF) -> bool:
    return bsdf.class_name() in ("NormalMap", "BumpMap") or any(map(_perturbs, nested(bsdf)))
