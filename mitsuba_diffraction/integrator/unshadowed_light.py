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

from ..bsdf.device_tables import PacketTable, integer_part, larger, limited, opaque, smaller

MAX_OUTLINES = 12
MARGIN = 1.01  # of outlines, against rounding at their edges
MIN_RADIANCE = 1e-3  # ε, relative to the maximum of the lamps or to the mean of the environment
MAP_SIDE = 128  # cells along a side of the octahedral map of an environment
_PER_CELL = 4  # points along a side of a cell at which an environment is evaluated
_DRAWN = 2**16  # directions drawn from an environment: they find a sun between those points
_POINTS = 2**15  # at which the radiance of all lamps is evaluated
_WAVELENGTHS = (450.0, 530.0, 590.0, 650.0)  # nm
_BOX, _DISK, _SPHERE = range(3)
_EXACT = {"Rectangle": _BOX, "Disk": _DISK, "Sphere": _SPHERE}


class UnshadowedLight:
    """h of a scene, see above.

    Attributes:
        has_extent: whether there are lamps with an extent, or an environment; otherwise h is of no use.
    """

    def __init__(self, scene: mi.Scene) -> None:
        lamps = [shape for shape in scene.shapes() if shape.is_emitter()]
        radiance = _radiance(scene, lamps)
        environment = scene.environment()
        self.has_extent = bool(lamps) or environment is not None
        groups = _groups(np.array([_bounds(shape) for shape in lamps]).reshape(-1, 2, 3))
        records = [
            _record(
                _outline([lamps[k] for k in group]), radiance[group].max(), int(_is_flat([lamps[k] for k in group]))
            )
            for group in groups
        ]
        self._kinds = {int(record[13]) for record in records}
        self._count = dr.opaque(mi.UInt32, len(records))
        self._records = PacketTable(np.array(records or [[0.0] * 16], np.float32))
        self._map = None if environment is None else _environment_map(environment)
        brightest = radiance.max(initial=0.0)
        if self._map is not None:
            brightest = max(brightest, float(dr.mean(self._map)[0]))
        self._min = opaque(MIN_RADIANCE * brightest if brightest > 0 else 1.0)

    @dr.syntax
    def __call__(self, point: mi.Point3f, omega: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Return h(p, ω) > 0, in the unit of radiance."""
        result = mi.Float(0)
        if dr.hint(self._map is not None, mode="scalar"):
            result += dr.gather(mi.Float, self._map, _octahedral_cell(omega), active)
        if dr.hint(len(self._kinds) > 0, mode="scalar"):
            lamp = mi.UInt32(0)
            while lamp < self._count:
                result += self._of_outline(lamp, point, omega, active)
                lamp += 1
        return larger(result, self._min)

    def _of_outline(self, lamp: mi.UInt32, point: mi.Point3f, omega: mi.Vector3f, active: mi.Bool) -> mi.Float:
        """Return the radiance of a lamp whose outline the ray meets, else zero."""
        rows = [self._records(4 * lamp + k, active) for k in range(4)]
        # In the coordinates of the lamp its outline is |x|, |y|, |z| ≤ 1, or |x, y, z| ≤ 1; if flat, |z| ≤ 0.
        o = mi.Vector3f([dr.fma(r[0], point.x, dr.fma(r[1], point.y, dr.fma(r[2], point.z, r[3]))) for r in rows[:3]])
        d = mi.Vector3f([dr.fma(r[0], omega.x, dr.fma(r[1], omega.y, r[2] * omega.z)) for r in rows[:3]])
        radiance, kind, half_thickness = rows[3][0], rows[3][1], rows[3][2]
        meets = mi.Bool(False)
        if self._kinds & {_BOX, _DISK}:
            inverse = dr.rcp(dr.select(dr.abs(d) > 1e-20, d, 1e-20))
            half = mi.Vector3f(1, 1, half_thickness)
            first, last = (-half - o) * inverse, (half - o) * inverse
            near, far = mi.Vector3f(*map(smaller, first, last)), mi.Vector3f(*map(larger, first, last))
            within = smaller(smaller(far.x, far.y), far.z) >= larger(larger(near.x, near.y), larger(near.z, 0))
            # A flat lamp emits at its front only.
            in_front = (half_thickness > 0) | (o.z > 0)
            meets |= in_front & within & (kind == _BOX)
            if _DISK in self._kinds:
                x, y = dr.fma(far.z, d.x, o.x), dr.fma(far.z, d.y, o.y)
                meets |= in_front & (far.z > 0) & (x * x + y * y <= 1) & (kind == _DISK)
        if _SPHERE in self._kinds:
            a, b, c = dr.squared_norm(d), dr.dot(o, d), dr.squared_norm(o) - 1
            meets |= ((c <= 0) | ((b < 0) & (b * b >= a * c))) & (kind == _SPHERE)
        return dr.select(meets, radiance, 0)


def _radiance(scene: mi.Scene, lamps: list[mi.Shape]) -> NDArray[np.float64]:
    """Return the maximum of the radiance of each lamp, a mean over wavelengths."""
    if not lamps:
        return np.zeros(0)
    emitters = scene.emitters()
    numbers = [next(k for k, emitter in enumerate(emitters) if emitter is shape.emitter()) for shape in lamps]
    side = max(4, int(np.sqrt(_POINTS / len(lamps))))
    index = dr.arange(mi.UInt32, len(lamps) * side**2)
    emitter = dr.gather(mi.EmitterPtr, scene.emitters_dr(), dr.gather(mi.UInt32, mi.UInt32(numbers), index // side**2))
    si = dr.zeros(mi.SurfaceInteraction3f, dr.width(index))
    si.shape, si.wi, si.wavelengths = emitter.get_shape(), mi.Vector3f(0, 0, 1), _spectrum()
    cell = index % side**2
    si.uv = (mi.Point2f(mi.Float(cell % side), mi.Float(cell // side)) + 0.5) / side
    value = np.array(_mean(emitter.eval(si))).reshape(len(lamps), -1).max(axis=1).astype(np.float64)
    # Of radiance that varies in a way not seen here.
    return np.where(value > 0, value, value.max(initial=0.0) or 1.0)


def _spectrum() -> mi.Spectrum:
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
    return len(lamps) == 1 and lamps[0].class_name() in ("Rectangle", "Disk")


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


def _record(outline: tuple[int, NDArray[np.float64], NDArray[np.float64]], radiance: float, flat: int) -> list[float]:
    """Return the map to the coordinates of a lamp by rows, its radiance, its kind, and its half thickness there."""
    kind, centre, axes = outline
    to_lamp = np.linalg.inv(axes * MARGIN)
    rows = np.column_stack([to_lamp, -to_lamp @ centre])
    return [*rows.ravel(), radiance, kind, 1 - flat, 0]


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
    """Return the maxima of the radiance over the cells of the octahedral map and their neighbours."""
    side = MAP_SIDE * _PER_CELL
    index = dr.arange(mi.UInt32, side**2)
    u, v = ((mi.Float(k) + 0.5) * (2 / side) - 1 for k in (index % side, index // side))
    z = 1 - dr.abs(u) - dr.abs(v)
    below = z < 0
    x = dr.select(below, dr.mulsign(1 - dr.abs(v), u), u)
    y = dr.select(below, dr.mulsign(1 - dr.abs(u), v), v)
    rng = mi.PCG32(size=_DRAWN)
    point = dr.zeros(mi.Interaction3f, _DRAWN)
    point.wavelengths = _spectrum()
    drawn, _ = environment.sample_direction(point, mi.Point2f(rng.next_float32(), rng.next_float32()), True)
    maxima = dr.zeros(mi.Float, MAP_SIDE**2)
    for omega in (dr.normalize(mi.Vector3f(x, y, z)), drawn.d):
        si = dr.zeros(mi.SurfaceInteraction3f, dr.width(omega))
        si.wi, si.wavelengths = -omega, _spectrum()
        dr.scatter_reduce(dr.ReduceOp.Max, maxima, _mean(environment.eval(si)), _octahedral_cell(omega))
    cells = _folded_out(np.array(maxima).reshape(MAP_SIDE, MAP_SIDE))
    around = [cells[j : j + MAP_SIDE, i : i + MAP_SIDE] for j in range(3) for i in range(3)]
    return mi.Float(np.max(around, axis=0).ravel())


def _folded_out(cells: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the map with the neighbours outside of its edges, which are cells of the same edge."""
    padded = np.pad(cells, 1)
    for edge, inner in (((0, slice(1, -1)), cells[0]), ((-1, slice(1, -1)), cells[-1])):
        padded[edge] = inner[::-1]
    padded[1:-1, 0], padded[1:-1, -1] = cells[::-1, 0], cells[::-1, -1]
    for j, i in ((0, 0), (0, -1), (-1, 0), (-1, -1)):
        padded[j, i] = cells[-1 - j, -1 - i]
    return padded
