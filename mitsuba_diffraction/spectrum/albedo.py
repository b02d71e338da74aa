"""How much light a perfect mirror with this spectrum would reflect, and the factor that keeps it to what it receives.

With R = 1 the BRDF K·G·S(q; κ)/λ² has the albedo

    a(ω_i, λ) = ∫ K G S(q; κ) dq    over the q whose ω_o is above the surface (du dv = cos θ_o dω_o = λ² dq)

which exceeds one for some directions. The BSDF multiplies by

    E = min(e(ω_i, λ), e(ω_o, λ)),    e = min(1, (1 + SLACK)/a)

which is reciprocal, one where neither direction reflects more than it receives, and keeps every albedo to 1 + SLACK,
because E ≤ e(ω_i). An `EnergyTable` holds e, bounded from below: a node starts with e there, then e is computed at
random places in the cells, and where the table is above it the corners of the cell are lowered. What is left is
measured at other random places, `EnergyTable.excess`; the albedo itself exceeds one by less, because light that makes
a high usually leaves near the horizon, where e(ω_o) is low.

a is summed over cells in which the spectrum is gathered: the lobe of the mirror direction, which meets the horizon
together with ω, is integrated; other cells are boxes that the horizon may cut.

Directions are stored in angles about the pattern's y axis: with c = √(1 − ω_y²), the cosine of the latitude,

    x = ω_x/(c + ω_z) = tan(longitude/2),    y = ω_y/(1 + c) = tan(latitude/2),    both in [−1, 1]

so that directions near the horizon are as finely divided as others. The third coordinate is ν = 1/λ.
A grating of one row keeps ω_o,y = −ω_i,y. Then K and G depend on the longitudes alone, and λ enters everywhere as λ/c:
a is a function of x and ν = c/λ, and the table has one row in y.
"""

from __future__ import annotations

import dataclasses
import functools
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import ArrayLike, NDArray
from scipy import ndimage

from .grating_spectrum import GratingSpectrum

SLACK = 5e-4
"""What an albedo may exceed one by: half the error of a spectrum at its usual tolerance."""

# The table: nodes in (y, ν, x).
CONICAL_SHAPE = (1, 193, 193)
GENERAL_SHAPE = (33, 17, 33)
ROUNDS = 4  # how often the table is lowered
CONICAL_PLACES, GENERAL_PLACES = 3, 2  # from how many places in each cell
CONICAL_WAVELENGTHS = 4  # how many of the λ that share one ν = c/λ a node is computed for
VARIED = 0.02  # after the first round only cells are looked at that were lowered, or about which e varies by as much
CHECKED = 10_000  # places at which the table is measured

# The gathered spectrum: lengths in cycles/µm.
NARROW = 0.01  # λσ_q of lobes so narrow that ω_o,y = −ω_i,y holds
FINE, COARSE = 0.15, 0.6  # widths of the cells of q in which nodes are gathered; weak ones in the wider
WEAK = 2e-3  # the power under which a cell is weak
STRONG, THIRD = 2e-2, 1.3  # the power from which a lobe is told by three boxes; their width, in σ_q
CHUNK = 1 << 16  # pairs (direction, q) that are computed at once, so that they stay in the cache


@dataclass(frozen=True, eq=False)
class GatheredSpectrum:
    """S(q; κ) gathered in few cells of the frequency plane.

    Attributes:
        q: float32 (n, 2), cycles/µm, the centres of power.
        widths: float32 (n,), cycles/µm: the power of each cell is spread over a box, which matters at the horizon.
        shifts: float32 (n,), cycles/µm, how far towards the horizon the box is from the centre.
        powers: p_j, float32 (n, K), at K equidistant κ from 0 to `largest_kappa`; linear between them.
        largest_kappa: rad/µm.
        wavelengths: (shortest, longest) in nm.
        conical: ω_o,y = −ω_i,y.
        mirror: the first cell is the lobe of the mirror direction, a Gaussian, and q = 0.
    """

    q: NDArray[np.float32] = field(repr=False)
    widths: NDArray[np.float32] = field(repr=False)
    shifts: NDArray[np.float32] = field(repr=False)
    powers: NDArray[np.float32] = field(repr=False)
    largest_kappa: float
    wavelengths: tuple[float, float]
    conical: bool
    mirror: bool

    @classmethod
    def of(cls, spectrum: GratingSpectrum) -> GatheredSpectrum:
        """Gather the nodes of `spectrum` in the cells of a grid, each cell at its centre of power."""
        q_x, q_y = spectrum.grid.frequencies()
        sigma = spectrum.lobe_width
        conical = spectrum.extent == "tile" and len(q_y) == 1 and sigma * spectrum.wavelengths[1] * 1e-3 <= NARROW
        # A cell holds the whole lobe: of a tile it comes with its order, of a sample to four σ_q.
        narrow = sigma <= FINE / (3 if spectrum.extent == "tile" else 8)
        fine = FINE / 8 if conical else FINE if narrow else FINE / 2
        # Wide lobes are gathered point by point; the nodes of a sample hold them already.
        spread = sigma if spectrum.extent == "tile" and not narrow else 0.0
        x, y = _cells(q_x, spread, fine), _cells(q_y, spread, fine)

        # p_j(κ) is band-limited by the height range R: Chebyshev nodes enough for e^{iκR}.
        largest, radians = spectrum.largest_kappa, spectrum.largest_kappa * spectrum.height_range
        count = int(np.ceil(radians / 2)) + 12
        nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
        gathered = np.empty((count, y[0].shape[1], x[0].shape[1]), np.float32)
        total = np.zeros(spectrum.grid.shape, np.float32)
        for index, node in enumerate(nodes):
            powers = spectrum.powers((1 + node) / 2 * largest)
            gathered[index] = y[0].T @ powers @ x[0]
            total += powers
        moments = {(i, j): y[j].T @ total @ x[i] for i, j in ((0, 0), (1, 0), (0, 1), (2, 0), (0, 2))}
        present = moments[0, 0] > count * 1e-9
        weight = moments[0, 0][present]
        q = np.stack([moments[1, 0][present], moments[0, 1][present]], -1) / weight[:, None]
        square = (moments[2, 0] + moments[0, 2])[present] / weight

        # From the nodes to equidistant κ, 0.15 rad of the fastest oscillation apart.
        equidistant = np.linspace(-1, 1, int(np.ceil(radians / 0.15)) + 2)
        weights = 2 / count * chebvander(nodes, count - 1)
        weights[:, 0] /= 2
        powers = np.maximum(chebvander(equidistant, count - 1) @ weights.T @ gathered[:, present], 0).T
        q, square, powers = _merged(q, square, powers, COARSE / 8 if conical else COARSE)
        own = max(spectrum.grid.spacing) / 2 if spectrum.extent == "sample" else sigma if narrow else fine / np.sqrt(12)
        sigmas = np.sqrt(np.maximum((square - (q**2).sum(-1)) / 2, 0) + own**2)
        mirror = np.abs(q).max(-1) <= fine / 2
        order = np.argsort(~mirror, kind="stable")
        q[mirror] = 0
        q, sigmas, powers = q[order], sigmas[order], powers[order]
        has_mirror = bool(narrow and mirror.any())
        # What strong lobes do at the horizon is told by three boxes, that of the others by one of the same deviation.
        strong = (powers.max(-1) >= STRONG) & ~(has_mirror & mirror[order])
        parts = [(q[~strong], np.sqrt(12) * sigmas[~strong], 0 * sigmas[~strong], powers[~strong])]
        for offset, weight in zip(*_lobe(3, THIRD), strict=True):
            parts.append((q[strong], THIRD * sigmas[strong], offset * sigmas[strong], weight * powers[strong]))
        cells = (np.ascontiguousarray(np.concatenate(x), np.float32) for x in zip(*parts, strict=True))
        return cls(*cells, largest, spectrum.wavelengths, conical, has_mirror)

    def albedo(
        self,
        directions: NDArray[np.float64],
        wavelengths: ArrayLike,
        shadowing: bool = True,
        height_scale: float = 1.0,
    ) -> NDArray[np.float32]:
        """a(ω, λ).

        Args:
            directions: ω, (n, 3) unit vectors above the surface, along the pattern's axes.
            wavelengths: λ in µm, (n,) or one for all; 4π · `height_scale`/λ at most `largest_kappa`.
            shadowing: G is the V-cavity's, else 1.
            height_scale: times the heights.

        Returns:
            (n,).
        """
        wavelengths = np.broadcast_to(wavelengths, len(directions))
        # Neighbours of one length reach about the same q.
        order = np.argsort(wavelengths, kind="stable")
        result = np.empty(len(directions), np.float32)

        def compute(some: NDArray[np.int64]) -> None:
            result[some] = self._albedo(directions[some], wavelengths[some], shadowing, height_scale)

        parts = np.array_split(order, 1 + len(order) * len(self.q) // CHUNK)
        with ThreadPoolExecutor() as threads:
            list(threads.map(compute, [part for part in parts if len(part)]))
        return result

    def _albedo(
        self, directions: NDArray[np.float64], wavelengths: NDArray[np.float64], shadowing: bool, height_scale: float
    ) -> NDArray[np.float32]:
        """`albedo` of a few directions at once."""
        s_x, s_y, cos_i = directions.astype(np.float32).T[:, :, None]
        wavelengths = wavelengths.astype(np.float32)[:, None]
        # Light reaches no further than |q| = 2/λ.
        reached = np.flatnonzero((self.q**2).sum(-1) * wavelengths.min() ** 2 < 4)
        u, v = wavelengths * self.q[reached, 0], wavelengths * self.q[reached, 1]
        width, shift = wavelengths * self.widths[reached], wavelengths * self.shifts[reached]
        # The part of each cell above the horizon, and its mean cosine.
        above, cos_o = _above(1 - (u + s_x) ** 2 - (v + s_y) ** 2 - 2 * shift, width)
        cos_i = np.maximum(cos_i, 1e-4)
        factor = above * _geometry(u**2 + v**2, cos_i, cos_o, shadowing)
        if self.mirror:
            factor[:, 0] = _mirror_lobe(cos_i[:, 0], width[:, 0] / np.sqrt(12), shadowing)
        w = cos_i + cos_o
        # p_j(κ), κ = 2π w/λ.
        count = self.powers.shape[1]
        per_cosine = np.float32(2 * np.pi * height_scale * (count - 1) / self.largest_kappa) / wavelengths
        place = np.minimum(per_cosine * w, count - 1)
        cell = np.minimum(place.astype(np.int32), count - 2)
        place -= cell
        cell += (reached * count).astype(np.int32)
        flat = self.powers.ravel()
        below = flat[cell]
        power = below + place * (flat[cell + 1] - below)
        return (factor * power).sum(-1)


@dataclass(frozen=True, eq=False)
class EnergyTable:
    """Lower bounds of e at nodes, linear between them in y, ν and x.

    Attributes:
        values: float32 (N_y, N_ν, N_x); y and x from −1 to 1, ν as in `frequencies`.
        frequencies: (smallest, largest) ν in 1/µm.
        conical: ν = c/λ and N_y = 1; else ν = 1/λ.
        excess: the largest e·a − 1 found, over random places that the table was not made from, with the rounding of
            `packed`.
        loss: (mean, largest) 1 − e over those of them with a ≤ 1: light that is lost to the table's resolution.
    """

    values: NDArray[np.float32] = field(repr=False)
    frequencies: tuple[float, float]
    conical: bool
    excess: float = 0.0
    loss: tuple[float, float] = (0.0, 0.0)

    @property
    def needed(self) -> bool:
        """Some direction would reflect more than it receives."""
        return bool((self.values < 1).any())

    def packed(self) -> tuple[NDArray[np.uint8], float, float]:
        """Bytes b and numbers (least, step) with `values` ≥ least + step · b, as the renderer holds them."""
        least = float(self.values.min())
        step = (1 - least) / 255 or 1.0
        # A value that is a whole number of steps stays one, and one stays one.
        return np.floor((self.values - least) / step + 1e-3).astype(np.uint8), least, step


def energy_table(spectrum: GatheredSpectrum, shadowing: bool = True, height_scale: float = 1.0) -> EnergyTable:
    """e, bounded from below, and how well.

    Args:
        spectrum: gathered.
        shadowing: G is the V-cavity's, else 1. Then a grows without bound towards the horizon, faster than the table
            can follow: of 42,000 pairs for each surface e·a was 1.7 at most (blaze 0.8 µm deep), the albedo of the
            pairs with the largest e·a 1.02 up to 89.5° and 1.05 beyond.
        height_scale: times the heights.
    """
    shape, count = (CONICAL_SHAPE, CONICAL_PLACES) if spectrum.conical else (GENERAL_SHAPE, GENERAL_PLACES)
    cells = tuple(max(n - 1, 1) for n in shape)
    shortest, longest = (w * 1e-3 for w in spectrum.wavelengths)
    frequencies = (0.0 if spectrum.conical else 1 / longest, 1 / shortest)

    def bound(places: NDArray[np.float64]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
        """a and e at places (row, slice, column), (n, 3); of a table of one row 0 ≤ row ≤ 1 chooses λ."""
        y, t, x = places.T / np.array(cells)[:, None]
        nu = np.maximum(frequencies[0] + (frequencies[1] - frequencies[0]) * t, 1e-3)
        x, y, wavelengths = 2 * x - 1, 2 * y - 1, 1 / nu
        if spectrum.conical:
            # ν = c/λ is one number, but the lobes are λσ_q wide: any λ that has this ν.
            # The widest and the narrowest lobes, and some between.
            share = np.clip(0.5 + y, 0, 1)
            wavelengths = shortest + (np.minimum(longest, wavelengths) - shortest) * share
            y = np.sqrt(np.maximum(1 - wavelengths * nu, 0) / (1 + wavelengths * nu))
        a = spectrum.albedo(directions_at(x, y), wavelengths, shadowing, height_scale)
        return a, np.minimum(1, (1 + SLACK) / a)

    nodes = np.indices(shape).reshape(3, -1).T
    rows = np.linspace(0, 1, CONICAL_WAVELENGTHS) if spectrum.conical else [0.0]
    values = np.min([bound(nodes + np.array([row, 0, 0]))[1] for row in rows], axis=0).reshape(shape)

    # The same places for every height scale, so that their tables can be subtracted.
    rng = np.random.default_rng(0)
    doubtful = np.ones(cells, bool)
    for _ in range(ROUNDS):
        inside = rng.random((count, *cells, 3), np.float32)[:, doubtful]
        first = np.argwhere(doubtful)
        above = np.max([_between(values, first + r) - bound(first + r)[1] for r in inside], axis=0)
        drop = np.zeros(shape, np.float32)
        drop[tuple(first.T)] = np.maximum(above, 0)
        # A node is a corner of the cells before and after it.
        values = np.maximum(values - ndimage.maximum_filter(drop, [min(n, 2) for n in shape], mode="constant"), 0)
        # Next time only cells that had to be lowered, or about which e varies.
        varied = ndimage.maximum_filter(values, 3) - ndimage.minimum_filter(values, 3) > VARIED
        doubtful = (ndimage.maximum_filter(drop > 0, 3) | varied)[tuple(slice(n) for n in cells)]

    table = EnergyTable(np.ascontiguousarray(values, np.float32), frequencies, spectrum.conical)
    steps, least, step = table.packed()
    places = rng.random((CHECKED, 3))
    # Every other one nearer to the horizon, x = ±1.
    places[::2, 2] = 0.5 * (1 + np.sin(np.pi * (places[::2, 2] - 0.5)))
    places *= cells
    e, a = _between(least + step * steps.astype(np.float32), places), bound(places)[0]
    lost = (1 - e)[a <= 1]
    loss = (float(lost.mean()), float(lost.max())) if len(lost) else (0.0, 0.0)
    return dataclasses.replace(table, excess=float((e * a).max() - 1), loss=loss)


def _between(values: NDArray[np.float32], places: NDArray[np.float64]) -> NDArray[np.float32]:
    """The table at places (row, slice, column), (n, 3), linear between nodes; beyond, the nearest."""
    return ndimage.map_coordinates(values, places.T, order=1, mode="nearest")


def directions_at(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """The unit vectors (..., 3) of the coordinates x and y, which broadcast."""
    x, y = np.broadcast_arrays(x, y)
    c = (1 - y**2) / (1 + y**2)
    return np.stack([c * 2 * x / (1 + x**2), 2 * y / (1 + y**2), c * (1 - x**2) / (1 + x**2)], -1)


def _above(square: NDArray[np.float32], width: NDArray[np.float32]) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """The part of a cell above the horizon, and the mean cosine there.

    Args:
        square: 1 − |ω_o,t|² of its centre.
        width: of the cell, in ω_o,t.
    """
    # The mean of the cosines at both edges is, near the horizon, the harmonic mean over the part: K has 1/cos θ_o.
    inner, outer = np.maximum(square + width, 1e-8), np.maximum(square - width, 0)
    return np.clip(square / (2 * width) + 0.5, 0, 1), np.minimum(0.5 * (np.sqrt(inner) + np.sqrt(outer)), 1)


def _geometry(
    tangent: NDArray[np.float32], cos_i: NDArray[np.float32], cos_o: NDArray[np.float32], shadowing: bool
) -> NDArray[np.float32]:
    """K·G, for u² + v² = `tangent`."""
    w = cos_i + cos_o
    d = 0.5 * (tangent + w**2)  # 1 + ω_i·ω_o
    factor = d**2 / (cos_i * cos_o * w**2)
    if shadowing:
        factor *= np.minimum(1, 2 * w * np.minimum(cos_i, cos_o) / d)
    return factor


def _mirror_lobe(cos_i: NDArray[np.float32], width: NDArray[np.float32], shadowing: bool) -> NDArray[np.float32]:
    """∫ K G over the lobe of the mirror direction, a Gaussian of the standard deviation `width` in ω_o,t; (n,).

    From a table, linear in √cos θ_i and the width.
    """
    widths, cosines, table = _mirror_table(shadowing)
    place = (np.log(width / widths[0]) / np.log(widths[-1] / widths[0])) * (len(widths) - 1)
    return ndimage.map_coordinates(table, [place, np.sqrt(cos_i) * (len(cosines) - 1)], order=1, mode="nearest")


@functools.cache
def _mirror_table(
    shadowing: bool,
) -> tuple[NDArray[np.float32], NDArray[np.float32], NDArray[np.float32]]:
    """The table of `_mirror_lobe`: widths (n,), cosines (m,), and the integrals (n, m)."""
    widths = np.geomspace(2e-4, 0.05, 24, dtype=np.float32)
    cosines = np.maximum(np.linspace(0, 1, 97, dtype=np.float32) ** 2, 1e-4)
    offsets, weights = _lobe(29, 0.25)
    table = np.zeros((len(widths), len(cosines)), np.float32)
    sine = np.sqrt(1 - cosines**2)
    for i, j in np.ndindex(len(offsets), (len(offsets) + 1) // 2):
        u, v = widths[:, None] * offsets[i], widths[:, None] * offsets[j]
        above, cos_o = _above(1 - (u - sine) ** 2 - v**2, 0.25 * widths[:, None])
        twice = 1 if offsets[j] == 0 else 2
        table += twice * weights[i] * weights[j] * above * _geometry(u**2 + v**2, cosines, cos_o, shadowing)
    return widths, cosines, table


def _cells(q: NDArray[np.float64], sigma: float, width: float) -> NDArray[np.float32]:
    """How nodes along one axis, each with its lobe, fall into cells.

    Args:
        q: (n,) cycles/µm.
        sigma: σ_q in cycles/µm.
        width: of a cell, cycles/µm.

    Returns:
        The share of each node in each cell, the same times q, and times q²: (3, n, cells).
    """
    offsets, weights = _lobe(7, 0.85) if sigma else (np.zeros(1), np.ones(1))
    points = q[:, None] + sigma * offsets
    cells = np.round(points / width).astype(np.int64)
    first = cells.min()
    result = np.zeros((3, len(q), cells.max() - first + 1), np.float32)
    row = np.broadcast_to(np.arange(len(q))[:, None], cells.shape)
    for power, moment in enumerate(result):
        np.add.at(moment, (row, cells - first), weights * points**power)
    return result


def _lobe(count: int, spacing: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points that stand for a Gaussian of unit width, and their weights."""
    offsets = spacing * (np.arange(count) - (count - 1) / 2)
    weights = np.exp(-(offsets**2) / 2)
    return offsets, weights / weights.sum()


def _merged(
    q: NDArray[np.float64], square: NDArray[np.float64], powers: NDArray[np.float64], width: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Gather weak cells in wider ones, each at its centre of power.

    Args:
        q: (n, 2) cycles/µm.
        square: the mean of |q|² in each cell, (n,).
        powers: (n, K).
        width: of the wider cells, cycles/µm.

    Returns:
        The same for fewer cells.
    """
    weak = powers.max(-1) < WEAK
    if not weak.any():
        return q, square, powers
    _, cell = np.unique(np.round(q[weak] / width), axis=0, return_inverse=True)
    cell = cell.ravel()
    merged = np.zeros((cell.max() + 1, powers.shape[1]))
    np.add.at(merged, cell, powers[weak])
    weight = powers[weak].sum(-1)
    total = np.bincount(cell, weight)
    x, y, both = (np.bincount(cell, weight * m) / total for m in (*q[weak].T, square[weak]))
    return (
        np.concatenate([q[~weak], np.stack([x, y], -1)]),
        np.concatenate([square[~weak], both]),
        np.concatenate([powers[~weak], merged]),
    )
