"""How much light a perfect mirror with this spectrum would reflect, and the table of what bounds it by one.

With R = 1 the BRDF K·G·S(q; κ)/λ² has the albedo

    a(ω_i, λ) = ∫ K G S(q; κ) dq    over the q whose ω_o is above the surface (du dv = cos θ_o dω_o = λ² dq)

`energy_table` computes e = min(1, (1 + SLACK)/a) (`energy_table.py`): a node starts with e there, then e is computed
at a random place in each cell, and where the table is above it the corners of the cell are lowered. What remains above
one is found and lowered by `furnace.py`.

a is summed over cells in which the spectrum is gathered: the lobe of the mirror direction, which meets the horizon
together with ω, is integrated; the others are boxes, each represented by Gauss points in cos θ_o, on which K, G and κ
depend and which changes fast where the horizon cuts a box.
"""

from __future__ import annotations

import dataclasses
import functools
import itertools
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numpy as np
import scipy.sparse
from numpy.polynomial.legendre import leggauss
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage
from scipy.integrate import cumulative_trapezoid
from scipy.interpolate import CubicSpline
from scipy.special import ndtr

from .energy_table import EnergyTable, between, directions_at
from .orders import OrderGrid
from .spline_grid import spline_integral

if TYPE_CHECKING:
    from .grating_spectrum import GratingSpectrum

SLACK = 5e-4
"""What an albedo may exceed one by: half the error of a spectrum at its usual tolerance."""

# The table: nodes in (y, ν, x).
CONICAL_SHAPE = (1, 193, 193)
GENERAL_SHAPE = (33, 17, 33)
CONICAL_WAVELENGTHS = 2  # how many of the λ that share one ν = c/λ a node is computed for
ROUNDS = 6  # how often the table is lowered, at most
DEEP, PAIRS = 30, 7.5e6  # the largest κ times the height range in radians; pairs (place, cell of q)
# From one round to the next, so that the places of few rounds cover a cell evenly (Roberts 2018: powers of the root of
# x⁴ = x + 1).
STRIDE = np.array([0.8191725, 0.6710436, 0.5497005], np.float32)
MUCH = 0.05  # a node lowered by more than this has the cells around it examined again
LIKELY = 0.8  # a cell is examined if the albedo at a node nearby exceeds this

# The gathered spectrum: lengths in cycles/µm.
NARROW = 0.01  # λσ_q of lobes so narrow that ω_o,y = −ω_i,y holds
FINE = 0.08  # width of the cells of q in which nodes are gathered
WIDE = 0.3  # width in ω_o,t of the cells in which weak ones are gathered further
STEP = 1.25  # from one gathering to the next, in λ
KEPT = 60  # the strongest cells, which are not gathered further
STRONG, THIRD = 2e-2, 1.3  # the power from which a lobe is represented by three boxes; their width, in σ_q
SPLINE_STEP, LINEAR_STEP = 0.4, 0.1  # in radians of the fastest oscillation over κ
GAUSS = ((1 + leggauss(2)[0]) / 2).tolist(), (leggauss(2)[1] / 2).tolist()
FAR = 4  # half-widths of a box in cos² from the horizon, from where one point represents it
CHUNK = 1 << 17  # pairs (direction, q) that are computed at once, so that they stay in the cache


@dataclass(frozen=True, eq=False)
class Cells:
    """S(q; κ) gathered in few cells of the frequency plane, for a range of wavelengths.

    Attributes:
        longest: wavelength in µm.
        q: float32 (n, 2), cycles/µm, the centres of power.
        widths: float32 (n, 2), cycles/µm: the power of each cell is spread over a box.
        shifts: float32 (n,), cycles/µm, how far towards the horizon the box is from the centre.
        powers: p_j, float32 (n, K), at K equidistant κ from 0 to the largest; linear between them.
    """

    longest: float
    q: NDArray[np.float32]
    widths: NDArray[np.float32]
    shifts: NDArray[np.float32]
    powers: NDArray[np.float32]

    @functools.cached_property
    def integrals(self) -> NDArray[np.float32]:
        """∫p_j dκ from 0, in steps of κ, float32 (n, K)."""
        return cumulative_trapezoid(self.powers, initial=0, axis=1).astype(np.float32)


@dataclass(frozen=True, eq=False)
class GatheredSpectrum:
    """S(q; κ) gathered in few cells, whose widths are about the same in ω_o,t for every wavelength.

    Attributes:
        cells: for ranges of wavelengths that ascend.
        largest_kappa: rad/µm.
        wavelengths: (shortest, longest) in nm.
        conical: ω_o,y = −ω_i,y.
        mirror: the first cell is the lobe of the mirror direction, a Gaussian, and q = 0.
    """

    cells: tuple[Cells, ...] = field(repr=False)
    largest_kappa: float
    wavelengths: tuple[float, float]
    conical: bool
    mirror: bool

    @classmethod
    def of(cls, spectrum: GratingSpectrum) -> GatheredSpectrum:
        """Gather the nodes of `spectrum` in the cells of a grid, each cell at its centre of power."""
        sigma, lines = spectrum.lobe_width, isinstance(spectrum.grid, OrderGrid)
        conical = bool(lines and spectrum.grid.shape[0] == 1 and sigma * spectrum.wavelengths[1] * 1e-3 <= NARROW)
        # A cell holds the whole lobe of a node, or the parts of it that lie in the cell.
        narrow = sigma <= FINE / (3 if lines else 8)
        fine = FINE / 4 if conical else FINE
        # Light reaches no further than |q| = 2/λ.
        reach = 2e3 / spectrum.wavelengths[0] + fine
        limits = np.minimum(np.inf if lines else spectrum.grid.limit, 2 * (reach,))
        lobes = (
            [None, None]
            if narrow
            else 2 * [(ndtr, sigma)]
            if lines
            else [(spline_integral, d) for d in spectrum.grid.spacing]
        )
        x, y = (
            _shares(q, lobe, fine, limit)
            for q, lobe, limit in zip(spectrum.grid.frequencies(), lobes, limits, strict=True)
        )

        # p_j(κ) is band-limited by the height range R: first κ for a cubic spline, from there equidistant κ so near
        # that straight lines serve. Sums by sparse matrices: those of BLAS depend on the number of cores.
        largest, radians = spectrum.largest_kappa, spectrum.largest_kappa * spectrum.height_range
        kappas = np.linspace(0, largest, int(np.ceil(radians / SPLINE_STEP)) + 8)
        gathered = np.empty((len(kappas), y[0].shape[1], x[0].shape[1]), np.float32)
        total = np.zeros(spectrum.grid.shape, np.float64)
        for index, kappa in enumerate(kappas):
            powers = spectrum.powers(kappa).astype(np.float64)
            gathered[index] = _product(y[0], powers, x[0])
            total += powers
        moments = [_product(y[j], total, x[i]) for i, j in ((0, 0), (1, 0), (0, 1), (2, 0), (0, 2))]
        present = moments[0] > len(kappas) * 1e-9
        weight, *others = (moment[present][:, None] for moment in moments)
        q, square = np.hstack(others[:2]) / weight, np.hstack(others[2:]) / weight
        gathered = gathered[:, present].T
        equidistant = np.linspace(0, largest, int(np.ceil(radians / LINEAR_STEP)) + 2)
        # The lobes that lie in the cells as a whole.
        own = (sigma if lines else np.array(spectrum.grid.spacing) / 2) if narrow else 0.0
        mirror = np.abs(q).max(-1) <= fine / 2
        has_mirror = bool(narrow and mirror.any())

        def cells(shortest: float, longest: float, width: float) -> Cells:
            near = np.hypot(*q.T) < 2 / shortest + width
            parts = (q[near], square[near], gathered[near])
            centres, squares, powers = _merged(*parts, width, ~mirror[near] if has_mirror else None)
            powers = np.maximum(CubicSpline(kappas, powers, axis=1)(equidistant), 0)
            sigmas = np.sqrt(np.maximum(squares - centres**2, 0) + own**2)
            at_mirror = np.abs(centres).max(-1) <= fine / 2
            order = np.argsort(~at_mirror, kind="stable")
            if has_mirror:
                centres[at_mirror] = 0
            centres, sigmas, powers = centres[order], sigmas[order], powers[order]
            strong = (powers.max(-1) >= STRONG) & ~(has_mirror & at_mirror[order])
            # At the horizon strong lobes are represented by three boxes, others by one of the same deviation.
            parts = [(centres[~strong], np.sqrt(12) * sigmas[~strong], 0 * sigmas[~strong, 0], powers[~strong])]
            for offset, share in zip(*_lobe(3, THIRD), strict=True):
                s = sigmas[strong]
                parts.append((centres[strong], THIRD * s, offset * s.mean(-1), share * powers[strong]))
            return Cells(
                longest, *(np.ascontiguousarray(np.concatenate(p), np.float32) for p in zip(*parts, strict=True))
            )

        shortest, longest = (w * 1e-3 for w in spectrum.wavelengths)
        count = 1 if conical else int(np.ceil(np.log(longest / shortest) / np.log(STEP)))
        ends = shortest * (longest / shortest) ** (np.arange(count + 1) / count)
        levels = tuple(cells(start, end, WIDE / end) for start, end in itertools.pairwise(ends.tolist()))
        return cls(levels, largest, spectrum.wavelengths, conical, has_mirror)

    def albedo(
        self,
        directions: NDArray[np.float64],
        wavelengths: ArrayLike,
        shadowing: str = "v_cavity",
        height_scale: float = 1.0,
    ) -> NDArray[np.float32]:
        """a(ω, λ).

        Args:
            directions: ω, (n, 3) unit vectors above the surface, along the pattern's axes.
            wavelengths: λ in µm, (n,) or one for all; 4π · `height_scale`/λ at most `largest_kappa`.
            shadowing: G is that of a "v_cavity", or 1 ("none").
            height_scale: times the heights.

        Returns:
            (n,).
        """
        wavelengths = np.broadcast_to(wavelengths, len(directions))
        result = np.empty(len(directions), np.float32)

        def compute(level: Cells, some: NDArray[np.int64]) -> None:
            result[some] = self._albedo(level, directions[some], wavelengths[some], shadowing, height_scale)

        # Neighbours of one wavelength and one latitude reach about the same q.
        order = np.lexsort((directions[:, 0], directions[:, 1], wavelengths))
        level = np.searchsorted([cells.longest * (1 + 1e-6) for cells in self.cells[:-1]], wavelengths[order])
        parts = []
        for index, cells in enumerate(self.cells):
            some = order[level == index]
            parts += [
                (cells, part) for part in np.array_split(some, 1 + len(some) * len(cells.q) // CHUNK) if len(part)
            ]
        with ThreadPoolExecutor() as threads:
            list(threads.map(compute, *zip(*parts, strict=True)))
        return result

    def _albedo(
        self,
        cells: Cells,
        directions: NDArray[np.float64],
        wavelengths: NDArray[np.float64],
        shadowing: str,
        height_scale: float,
    ) -> NDArray[np.float32]:
        """`albedo` of a few directions at once."""
        s_x, s_y, cos_i = directions.astype(np.float32).T[:, :, None]
        cos_i = np.maximum(cos_i, 1e-4)
        # What some of them send above the horizon.
        middle = directions[:, :2].mean(0)
        spread = np.hypot(*(directions[:, :2] - middle).T).max()
        margin = np.hypot(*cells.widths.T) / 2 + np.abs(cells.shifts)
        least, most = wavelengths.min(), wavelengths.max()
        distance = np.hypot(*((least + most) / 2 * cells.q + middle).T)
        reach = 1 + spread + most * margin + (most - least) / 2 * np.hypot(*cells.q.T)
        reached = np.flatnonzero(distance < reach + 0.01)
        if self.mirror and (len(reached) == 0 or reached[0] != 0):
            reached = np.concatenate([[0], reached])
        wavelengths = wavelengths.astype(np.float32)[:, None]
        q_x, q_y = cells.q[reached].T
        widths, shifts = cells.widths[reached], cells.shifts[reached]
        outer = (wavelengths * q_x + s_x) ** 2 + (wavelengths * q_y + s_y) ** 2
        # Pairs (direction, cell) of which some part is above the horizon.
        above = outer < (1 + most.astype(np.float32) * (np.hypot(*widths.T) / 2 + np.abs(shifts))) ** 2
        if self.mirror:
            above[:, 0] = True
        i, j = np.nonzero(above)
        lengths, cos_i = wavelengths[i, 0], cos_i[i, 0]
        box = [lengths * x for x in (q_x[j], q_y[j], widths[j, 0], widths[j, 1], shifts[j])]
        pair, cos_o, half, share, factor = _points(s_x[i, 0], s_y[i, 0], cos_i, *box, shadowing)
        if self.mirror:
            at = np.flatnonzero(j[pair] == 0)
            factor[at] = share[at] * _mirror_lobe(
                cos_i[pair[at]], box[2][pair[at]] / np.float32(np.sqrt(12)), shadowing
            )
        # The mean of p_j(κ), κ = 2π w/λ, over the part of the box.
        count = cells.powers.shape[1]
        per_cosine = np.float32(2 * np.pi * height_scale * (count - 1) / self.largest_kappa) / lengths[pair]
        place, half = per_cosine * (cos_i[pair] + cos_o), np.maximum(per_cosine * half, 1)
        low, high = np.clip(place - half, 0, count - 1), np.clip(place + half, 0, count - 1)
        flat, first = cells.integrals.ravel(), (reached * count).astype(np.int32)[j[pair]]
        power = (_linear(flat, first, high, count) - _linear(flat, first, low, count)) / np.maximum(high - low, 0.5)
        return np.bincount(i[pair], factor * power, len(directions))


def energy_table(spectrum: GatheredSpectrum, shadowing: str = "v_cavity", height_scale: float = 1.0) -> EnergyTable:
    """e, to be lowered where the spectrum itself asks for it (`furnace.py`).

    Args:
        spectrum: gathered.
        shadowing: "v_cavity" or "none".
        height_scale: times the heights.
    """
    shape = CONICAL_SHAPE if spectrum.conical else GENERAL_SHAPE
    cells = tuple(max(n - 1, 1) for n in shape)
    shortest, longest = (w * 1e-3 for w in spectrum.wavelengths)
    frequencies = (0.0 if spectrum.conical else 1 / longest, 1 / shortest)
    table = EnergyTable(np.ones(shape, np.float32), frequencies, spectrum.conical, shadowing)

    def bound(places: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """a times what the table's value is multiplied by, and the largest value; places (row, slice, column), (n, 3).

        Of a table of one row 0 ≤ row ≤ 1 chooses λ.
        """
        y, t, s = places.T / np.array(cells)[:, None]
        nu = np.maximum(frequencies[0] + (frequencies[1] - frequencies[0]) * t, 1e-3)
        s, y, wavelengths = 2 * s - 1, 2 * y - 1, 1 / nu
        if spectrum.conical:
            # ν = c/λ is one number, but the lobes are λσ_q wide: any λ that has this ν.
            # The widest and the narrowest lobes, and some between.
            share = np.clip(0.5 + y, 0, 1)
            wavelengths = shortest + (np.minimum(longest, wavelengths) - shortest) * share
            y = np.sqrt(np.maximum(1 - wavelengths * nu, 0) / (1 + wavelengths * nu))
        directions = directions_at(s, y)
        directions[:, 2] = np.maximum(directions[:, 2], 1e-4)
        a = spectrum.albedo(directions, wavelengths, shadowing, height_scale) * table.horizon(directions[:, 2])
        return a, np.minimum(1, (1 + SLACK) / np.maximum(a, 1e-6)).astype(np.float32)

    nodes = np.indices(shape).reshape(3, -1).T
    rows = np.linspace(0, 1, CONICAL_WAVELENGTHS) if spectrum.conical else [0.0]
    at_nodes = [bound(nodes + np.array([row, 0, 0])) for row in rows]
    values = np.min([e for _, e in at_nodes], axis=0).reshape(shape)
    largest = np.max([a for a, _ in at_nodes], axis=0).reshape(shape)

    # The same places for every height scale, so that their tables can be subtracted.
    start = np.random.default_rng(0).random((*cells, 3), np.float32)
    # a has peaks between nodes, where an order emerges; of few orders of a deep surface even between nodes where it is
    # small. Places in all those cells, as many as are cheap.
    likely = (ndimage.maximum_filter(largest, 3) > LIKELY)[tuple(slice(n) for n in cells)]
    deep = spectrum.cells[0].powers.shape[1] * LINEAR_STEP > DEEP
    most = PAIRS / np.mean([len(level.q) for level in spectrum.cells])
    doubtful = np.ones_like(likely) if deep and likely.size <= most else likely
    thorough = int(min(most / max(doubtful.sum(), 1), ROUNDS))
    for index in range(ROUNDS):
        inside, first = ((start + index * STRIDE) % 1)[doubtful], np.argwhere(doubtful)
        drop = np.zeros(shape, np.float32)
        drop[tuple(first.T)] = np.maximum(between(values, first + inside) - bound(first + inside)[1], 0)
        # A node is a corner of the cells before and after it.
        values = np.maximum(values - ndimage.maximum_filter(drop, [min(n, 2) for n in shape], mode="constant"), 0)
        # Next time only about cells that had to be lowered much.
        if index + 1 >= thorough:
            doubtful = (ndimage.maximum_filter(drop, 3) > MUCH)[tuple(slice(n) for n in cells)]
    return dataclasses.replace(table, values=np.ascontiguousarray(values, np.float32))


def _linear(
    flat: NDArray[np.float32], first: NDArray[np.int32], place: NDArray[np.float32], count: int
) -> NDArray[np.float32]:
    """Rows of `count` numbers, one after the other in `flat`, at `place` in the rows that begin at `first`."""
    cell = np.minimum(place.astype(np.int32), count - 2)
    place = place - cell
    cell += first
    below = flat[cell]
    return below + place * (flat[cell + 1] - below)


def _points(
    s_x: NDArray[np.float32],
    s_y: NDArray[np.float32],
    cos_i: NDArray[np.float32],
    u: NDArray[np.float32],
    v: NDArray[np.float32],
    width_x: NDArray[np.float32],
    width_y: NDArray[np.float32],
    shift: NDArray[np.float32],
    shadowing: str,
) -> tuple[NDArray[np.int64], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """∫ K G over boxes in ω_o,t as sums over few cos θ_o: one, or two of Gauss and Legendre near the horizon.

    cos² θ_o is taken to be spread evenly over a box, and what is below the horizon is cut off.

    Args:
        s_x: of ω_i, (n,).
        s_y: of ω_i.
        cos_i: cos θ_i.
        u: of the centre of the box.
        v: of the centre.
        width_x: of the box.
        width_y: of the box.
        shift: of the box, outwards.
        shadowing: as in `GatheredSpectrum.albedo`.

    Returns:
        The index of the box, cos θ_o, half the part of cos θ_o and the share of the box that it represents, and the
        summand: each (points,).
    """
    o_x, o_y = u + s_x, v + s_y  # −ω_o,t
    outer = o_x**2 + o_y**2
    square_x, square_y = width_x**2, width_y**2
    # The deviation along the radius is that of the box.
    half = np.sqrt(square_x * o_x**2 + square_y * o_y**2 + (square_x + square_y) ** 2 / 64)
    middle = 1 - outer - 2 * shift - (square_x + square_y) / 12
    far = middle > FAR * half
    whole, cut = np.flatnonzero(far), np.flatnonzero(~far & (middle > -half))
    cosine = np.sqrt(middle[whole])
    lowest = np.sqrt(np.maximum(middle - half, 0)[cut])
    span = np.sqrt(np.minimum((middle + half)[cut], 1)) - np.minimum(lowest, 1)
    pair = np.concatenate([whole, cut, cut])
    cos_o = np.minimum(np.concatenate([cosine, *(lowest + x * span for x in GAUSS[0])]), 1)
    part = np.concatenate([half[whole] / (2 * cosine), *(w / 2 * span for w in GAUSS[1])])
    share = np.concatenate([np.ones_like(cosine), *(np.full_like(span, w) for w in GAUSS[1])])
    measure = np.concatenate([1 / cosine, *(w * span / half[cut] for w in GAUSS[1])])
    # Nearer to the horizon, or farther from it, along the radius.
    u, v, outer, cos_i = u[pair], v[pair], outer[pair], cos_i[pair]
    stretch = np.sqrt(1 - cos_o**2) / np.sqrt(np.maximum(outer, (square_x + square_y)[pair] / 32)) - 1
    tangent = u**2 + v**2 + stretch * (2 * (o_x[pair] * u + o_y[pair] * v) + stretch * outer)
    w = cos_i + cos_o
    d = 0.5 * (np.maximum(tangent, 0) + w**2)  # 1 + ω_i·ω_o
    factor = d**2 / (cos_i * w**2)  # K·cos θ_o
    if shadowing == "v_cavity":
        # G's part changes as fast as cos θ_i: its mean over the part of the box.
        shadowed = np.minimum(1, cos_o / cos_i) / w
        shadowed[len(whole) :] = _mean_shadowed(
            np.concatenate([lowest, lowest + span / 2]), np.tile(span / 2, 2), cos_i[len(whole) :]
        )
        factor = np.minimum(factor, 2 * d * shadowed)
    return pair, cos_o, part, share, measure * factor


def _mean_shadowed(
    lowest: NDArray[np.float32], span: NDArray[np.float32], cos_i: NDArray[np.float32]
) -> NDArray[np.float32]:
    """The mean of min(1, c/cos θ_i)/(cos θ_i + c) over lowest ≤ c ≤ lowest + span."""
    middle = (lowest + span / 2) / cos_i
    ends = [np.asarray(x / cos_i, np.float64) for x in (lowest, lowest + span)]
    below, above = (np.where(x < 1, x - np.log1p(x), 1 - 2 * np.log(2) + np.log1p(x)) for x in ends)
    narrow = span < 1e-3 * (lowest + cos_i)
    mean = (above - below) / np.where(narrow, 1, span)
    return np.where(narrow, np.minimum(1, middle) / (cos_i * (1 + middle)), mean).astype(np.float32)


def _mirror_lobe(cos_i: NDArray[np.float32], width: NDArray[np.float32], shadowing: str) -> NDArray[np.float32]:
    """∫ K G over the lobe of the mirror direction, a Gaussian of the standard deviation `width` in ω_o,t; (n,).

    From a table, linear in √cos θ_i and the width.
    """
    widths, cosines, table = _mirror_table(shadowing)
    place = (np.log(width / widths[0]) / np.log(widths[-1] / widths[0])) * (len(widths) - 1)
    return ndimage.map_coordinates(table, [place, np.sqrt(cos_i) * (len(cosines) - 1)], order=1, mode="nearest")


@functools.cache
def _mirror_table(
    shadowing: str,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """The table of `_mirror_lobe`: widths (n,), cosines (m,), and the integrals (n, m)."""
    widths = np.geomspace(2e-4, 0.05, 24, dtype=np.float32)
    cosines = np.maximum(np.linspace(0, 1, 97, dtype=np.float32) ** 2, 1e-4)
    offsets, weights = _lobe(15, 0.5)
    table = np.zeros((len(widths), len(cosines)), np.float32)
    sine = np.sqrt(1 - cosines**2)
    sine, cosine, width = (np.ravel(x) for x in np.broadcast_arrays(sine, cosines, widths[:, None]))
    for i, j in np.ndindex(len(offsets), (len(offsets) + 1) // 2):
        u, v, box = np.float32(offsets[i]) * width, np.float32(offsets[j]) * width, np.float32(0.5) * width
        pair, *_, factor = _points(-sine, 0 * sine, cosine, u, v, box, box, 0 * box, shadowing)
        twice = 1 if offsets[j] == 0 else 2
        share = np.bincount(pair, factor, len(sine)).reshape(table.shape)
        table += (twice * weights[i] * weights[j] * share).astype(np.float32)
    return widths, cosines, table


def _shares(
    q: NDArray[np.float64],
    lobe: tuple[Callable[[NDArray[np.float64]], NDArray[np.float64]], float] | None,
    width: float,
    limit: float,
) -> list[scipy.sparse.csr_array]:
    """How nodes along one axis, each with its lobe, fall into cells.

    Args:
        q: (n,) cycles/µm.
        lobe: its integral from −∞, and its width in cycles/µm; without it, a lobe lies in a cell as a whole.
        width: of a cell, cycles/µm.
        limit: |q| beyond which there is nothing.

    Returns:
        The share of each node in each cell, the same times q, and times q²: each (n, cells).
    """
    if lobe is None:
        cells = np.round(q / width).astype(np.int64)
        cells -= cells.min()
        row, shape = np.arange(len(q)), (len(q), cells.max() + 1)
        return [scipy.sparse.csr_array((q**power, (row, cells)), shape) for power in range(3)]
    integral, scale = lobe
    first, last = (int(np.round(end / width)) for end in (q.min() - 4 * scale, q.max() + 4 * scale))
    edges = np.clip((np.arange(first, last + 2) - 0.5) * width, -limit, limit)
    shares = np.diff(integral((edges - q[:, None]) / scale), axis=1)
    shares[shares < 1e-7] = 0
    centres, extents = (edges[1:] + edges[:-1]) / 2, np.diff(edges)
    moments = (1, centres, centres**2 + extents**2 / 12)
    return [scipy.sparse.csr_array(shares * moment) for moment in moments]


def _product(y: scipy.sparse.csr_array, powers: NDArray[np.float64], x: scipy.sparse.csr_array) -> NDArray[np.float64]:
    """Σ over the nodes, y (rows, n) and x (columns, m): (n, m)."""
    return (x.T @ (y.T @ powers).T).T


def _lobe(count: int, spacing: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points that stand for a Gaussian of unit width, and their weights."""
    offsets = spacing * (np.arange(count) - (count - 1) / 2)
    weights = np.exp(-(offsets**2) / 2)
    return offsets, weights / weights.sum()


def _merged(
    q: NDArray[np.float64],
    square: NDArray[np.float64],
    powers: NDArray[np.float64],
    width: float,
    mergeable: NDArray[np.bool_] | None,
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Gather weak cells in wider ones, each at its centre of power.

    Args:
        q: (n, 2) cycles/µm.
        square: the means of q_x² and q_y² in each cell, (n, 2).
        powers: (n, K).
        width: of the wider cells, cycles/µm.
        mergeable: which cells may be, (n,).

    Returns:
        The same for fewer cells.
    """
    strength = powers.max(-1)
    weak = np.ones(len(q), bool)
    weak[np.argsort(-strength, kind="stable")[:KEPT]] = False
    if mergeable is not None:
        weak &= mergeable
    if not weak.any():
        return q.copy(), square, powers
    _, cell = np.unique(np.round(q[weak] / width), axis=0, return_inverse=True)
    cell = cell.ravel()
    gather = scipy.sparse.csr_array((np.ones(len(cell)), (cell, np.arange(len(cell)))))
    weight = np.maximum(powers[weak].sum(-1, dtype=np.float64), 1e-30)[:, None]
    total = gather @ weight
    return (
        np.concatenate([q[~weak], gather @ (weight * q[weak]) / total]),
        np.concatenate([square[~weak], gather @ (weight * square[weak]) / total]),
        np.concatenate([powers[~weak], gather @ powers[weak]]),
    )
