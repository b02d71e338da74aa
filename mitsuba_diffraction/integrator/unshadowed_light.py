"""A guess of the radiance that lights send to a point, without shadows.

    h(p, ω) = max(M(ω) + Σ_l L_l [the ray from p along ω meets the outline of lamp l], ε)

An outline covers the shape of a lamp: rectangles, disks and spheres are their own, other shapes are boxes along the
axes. L_l is the maximum of the radiance over the lamp. M, of an environment, is a map of maxima over cells and their
neighbours. Thus h is nowhere much below the radiance, whatever obstacles leave of it. Lamps without extent do not
count, as no ray meets them. All radiances are means over the wavelengths of visible light.

Of more than `MAX_OUTLINES` lamps, neighbours have a box and the maximum of their radiances in common.
"""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..bsdf.device_tables import integer_part, larger, limited, on_device, opaque, smaller
from ..bsdf.mitsuba_internals import DISK, RECTANGLE, SPHERE

MAX_OUTLINES = 12
MARGIN = 1.01  # of outlines, against rounding at their edges
MIN_RADIANCE = 1e-3  # ε, relative to the maximum of the lamps or to the mean of the environment
MAP_SIDE = 128  # cells along a side of the octahedral map of an environment
_PER_CELL = 4  # points along a side of a cell at which an environment is evaluated
_DRAWN = 2**16  # directions drawn from an environment: they find a sun between those points
_POINTS = 2**15  # at which the radiance of all lamps is evaluated
_WAVELENGTHS = (450.0, 530.0, 590.0, 650.0)  # nm
_BOX, _DISK, _SPHERE = range(3)
_EXACT = {RECTANGLE: _BOX, DISK: _DISK, SPHERE: _SPHERE}


class UnshadowedLight:
    """h of a scene, see above.

    Attributes:
        has_extent: whether there are lamps with an extent, or an environment; otherwise h is of no use.
        has_outlines: whether there are lamps with an extent.
        is_whole: whether there are no lamps without extent.
    """

    def __init__(self, scene: mi.Scene) -> None:
        # No ray meets the light of a surface that emits in one direction, `directionalarea`.
        delta = +mi.EmitterFlags.Delta
        lamps = [shape for shape in scene.shapes() if shape.is_emitter() and not shape.emitter().flags() & delta]
        radiance = _radiance(scene, lamps)
        environment = scene.environment()
        self.has_outlines, self.is_whole = bool(lamps), not any(e.flags() & delta for e in scene.emitters())
        self.has_extent = self.has_outlines or environment is not None
        groups = _groups(np.array([_bounds(shape) for shape in lamps]).reshape(-1, 2, 3))
        self._outlines = [_Outline([lamps[k] for k in group], radiance[group].max()) for group in groups]
        self._map = None if environment is None else _environment_map(environment)
        brightest = radiance.max(initial=0.0)
        if self._map is not None:
            brightest = max(brightest, float(dr.mean(self._map)[0]))
        self._min = opaque(MIN_RADIANCE * brightest if brightest > 0 else 1.0)

    def __call__(self, point: mi.Point3f, omega: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Return h(p, ω) > 0, in the unit of radiance."""
        result = mi.Float(0)
        if self._map is not None:
            is_uniform = dr.width(self._map) == 1
            result += self._map if is_uniform else dr.gather(mi.Float, self._map, _octahedral_cell(omega), active)
        # No loop: what depends on the point alone is then computed once for all directions.
        for outline in self._outlines:
            result += dr.select(outline.meets(point, omega), outline.radiance, 0)
        return larger(result, self._min)


class _Outline:
    """An outline around some lamps, and the maximum of their radiances.

    In its coordinates it is |x|, |y|, |z| ≤ 1, or x² + y² ≤ 1 and z = 0, or |x, y, z| ≤ 1. A rectangle has z = 0, too.

    Attributes:
        radiance: an opaque number.
    """

    def __init__(self, lamps: list[mi.Shape], radiance: float) -> None:
        self.radiance, self._is_flat = opaque(radiance), _is_flat(lamps)
        self._kind, centre, axes = _outline(lamps)
        to_lamp = np.linalg.inv(axes * MARGIN)
        self._rows = [[opaque(x) for x in row] for row in np.column_stack([to_lamp, -to_lamp @ centre])]

    def meets(self, point: mi.Point3f, omega: mi.Vector3f) -> mi.Bool:
        """Return whether the ray from p along ω meets the outline; a flat lamp only at its front, which emits."""
        o = mi.Vector3f([dr.fma(x, point.x, dr.fma(y, point.y, dr.fma(z, point.z, of))) for x, y, z, of in self._rows])
        d = mi.Vector3f([dr.fma(x, omega.x, dr.fma(y, omega.y, z * omega.z)) for x, y, z, _ in self._rows])
        if self._kind == _SPHERE:
            a, b, c = dr.squared_norm(d), dr.dot(o, d), dr.squared_norm(o) - 1
            return (c <= 0) | ((b < 0) & (b * b >= a * c))
        if self._is_flat:
            t = -o.z / d.z
            x, y = dr.fma(t, d.x, o.x), dr.fma(t, d.y, o.y)
            within = x * x + y * y <= 1 if self._kind == _DISK else larger(dr.abs(x), dr.abs(y)) <= 1
            return within & (o.z > 0) & (t > 0)
        inverse = dr.rcp(dr.select(dr.abs(d) > 1e-20, d, 1e-20))
        first, last = (-1 - o) * inverse, (1 - o) * inverse
        near, far = mi.Vector3f(*map(smaller, first, last)), mi.Vector3f(*map(larger, first, last))
        return smaller(smaller(far.x, far.y), far.z) >= larger(larger(near.x, near.y), larger(near.z, 0))


def _radiance(scene: mi.Scene, lamps: list[mi.Shape]) -> NDArray[np.float64]:
    """Return the maximum of the radiance of each lamp, a mean over wavelengths."""
    if not lamps:
        return np.zeros(0)
    emitters = scene.emitters()
    numbers = [next(k for k, emitter in enumerate(emitters) if emitter is shape.emitter()) for shape in lamps]
    side = max(4, int(np.sqrt(_POINTS / len(lamps))))
    index = dr.arange(mi.UInt32, len(lamps) * side**2)
    number = dr.gather(mi.UInt32, on_device(numbers, mi.UInt32), index // side**2)
    emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), number)
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(index))
    si.shape, si.wi, si.wavelengths = emitter.get_shape(), mi.Vector3f(0, 0, 1), _wavelengths()
    cell = index % side**2
    si.uv = (mi.Point2f(mi.Float(cell % side), mi.Float(cell // side)) + 0.5) / side
    value = np.array(_mean(emitter.eval(si))).reshape(len(lamps), -1).max(axis=1).astype(np.float64)
    # Of radiance that varies in a way not seen here.
    return np.where(value > 0, value, value.max(initial=0.0) or 1.0)


def _wavelengths() -> mi.Spectrum:
    return mi.Spectrum(_WAVELENGTHS[: dr.size_v(mi.Spectrum)])


def _mean(value: mi.Spectrum) -> mi.Float:
    return dr.mean(mi.unpolarized_spectrum(value))


def _bounds(shape: mi.Shape) -> list[mi.ScalarPoint3f]:
    box = shape.bbox()
    return [box.min, box.max]


def _groups(bounds: NDArray[np.float64]) -> list[list[int]]:
    """Divide lamps, (lamps, 2, 3), among at most `MAX_OUTLINES` groups of neighbours."""
    groups, middles = [list(range(len(bounds)))] if len(bounds) else [], bounds.mean(axis=1)
    while len(groups) < min(MAX_OUTLINES, len(bounds)):
        # The group with the largest distance between lamps is halved.
        group = groups.pop(int(np.argmax([np.ptp(middles[g], axis=0).max() if len(g) > 1 else -1 for g in groups])))
        along = middles[group, np.argmax(np.ptp(middles[group], axis=0))]
        order = np.array(group)[np.argsort(along, kind="stable")]
        groups += [order[: len(order) // 2].tolist(), order[len(order) // 2 :].tolist()]
    return groups


def _is_flat(lamps: list[mi.Shape]) -> bool:
    return len(lamps) == 1 and lamps[0].class_name() in (RECTANGLE, DISK)


def _outline(lamps: list[mi.Shape]) -> tuple[int, NDArray[np.float64], NDArray[np.float64]]:
    """Return the kind of an outline around some lamps, its centre, and its half axes as columns of a matrix."""
    if _is_flat(lamps):
        at = lamps[0].sample_position(0.0, mi.Point2f([0.5, 1, 0.5], [0.5, 0.5, 1]))
        centre, x, y = np.array(at.p).T.astype(np.float64)
        axes = np.column_stack([x - centre, y - centre, np.array(at.n).T[0]])
        return _EXACT[lamps[0].class_name()], centre, axes
    bounds = np.array([_bounds(shape) for shape in lamps], np.float64)
    low, high = bounds[:, 0].min(axis=0), bounds[:, 1].max(axis=0)
    half = (high - low) / 2
    kind = _EXACT.get(lamps[0].class_name(), _BOX) if len(lamps) == 1 else _BOX
    return kind, (low + high) / 2, np.diag(np.maximum(half, 1e-4 * half.max()))


def _octahedral_cell(omega: mi.Vector3f) -> mi.UInt32:
    """Return the index of the cell of a direction: the octahedron |x| + |y| + |z| = 1, its lower half folded out."""
    scale = dr.rcp(dr.abs(omega.x) + dr.abs(omega.y) + dr.abs(omega.z))
    x, y = omega.x * scale, omega.y * scale
    below = omega.z < 0
    u = dr.select(below, dr.mulsign(1 - dr.abs(y), x), x)
    v = dr.select(below, dr.mulsign(1 - dr.abs(x), y), y)
    column, row = (integer_part(limited(dr.fma(w, MAP_SIDE / 2, MAP_SIDE / 2), 0, MAP_SIDE - 0.5)) for w in (u, v))
    return row * MAP_SIDE + column


def _environment_map(environment: mi.Emitter) -> mi.Float:
    """Return the maxima of the radiance over the cells of the octahedral map and their neighbours, or one for all."""
    side = MAP_SIDE * _PER_CELL
    index = dr.arange(mi.UInt32, side**2)
    u, v = ((mi.Float(k) + 0.5) * (2 / side) - 1 for k in (index % side, index // side))
    z = 1 - dr.abs(u) - dr.abs(v)
    below = z < 0
    x = dr.select(below, dr.mulsign(1 - dr.abs(v), u), u)
    y = dr.select(below, dr.mulsign(1 - dr.abs(u), v), v)
    rng = mi.PCG32(size=_DRAWN)
    point = dr.zeros(mi.Interaction3f, _DRAWN)
    point.wavelengths = _wavelengths()
    drawn, _ = environment.sample_direction(point, mi.Point2f(rng.next_float32(), rng.next_float32()), True)
    maxima = dr.zeros(mi.Float, MAP_SIDE**2)
    for omega in (dr.normalize(mi.Vector3f(x, y, z)), drawn.d):
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(omega))
        si.wi, si.wavelengths = -omega, _wavelengths()
        dr.scatter_reduce(dr.ReduceOp.Max, maxima, _mean(environment.eval(si)), _octahedral_cell(omega))
    cells = _folded_out(np.array(maxima).reshape(MAP_SIDE, MAP_SIDE))
    around = [cells[j : j + MAP_SIDE, i : i + MAP_SIDE] for j in range(3) for i in range(3)]
    result = np.max(around, axis=0).ravel()
    return on_device(result) if np.ptp(result) > 1e-6 * result.max() else opaque(result.max())


def _folded_out(cells: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the map with the neighbours outside of its edges, which are cells of the same edge."""
    padded = np.pad(cells, 1)
    for edge, inner in (((0, slice(1, -1)), cells[0]), ((-1, slice(1, -1)), cells[-1])):
        padded[edge] = inner[::-1]
    padded[1:-1, 0], padded[1:-1, -1] = cells[::-1, 0], cells[::-1, -1]
    for j, i in ((0, 0), (0, -1), (-1, 0), (-1, -1)):
        padded[j, i] = cells[-1 - j, -1 - i]
    return padded
