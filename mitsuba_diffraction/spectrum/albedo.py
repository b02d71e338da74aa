"""How much light a perfect mirror with this spectrum would reflect, and the factor that keeps it to what it receives.

With R = 1 the BRDF K·G·S(q; κ)/λ² has the albedo

    a(ω_i, λ) = ∫ K G S(q; κ) dq    over the q whose ω_o is above the surface (du dv = cos θ_o dω_o = λ² dq)

which exceeds one for some directions. The BSDF multiplies by

    E = min(e(ω_i, λ), e(ω_o, λ)),    e = min(1, (1 + SLACK)/a)

which is reciprocal, one where neither direction reflects more than it receives, and keeps every albedo to 1 + SLACK,
because E ≤ e(ω_i). An `EnergyTable` holds lower bounds of e, made at its
nodes and half-way between them, from a spectrum gathered in coarse cells: an albedo may exceed one by 0.007 more, as
measured over random directions with V-cavity shadowing; near the horizon without shadowing, where a is a hundred, by
more.

Directions are stored in angles about the pattern's y axis: with c = √(1 − ω_y²), the cosine of the latitude,

    x = ω_x/(c + ω_z) = tan(longitude/2),    y = ω_y/(1 + c) = tan(latitude/2),    both in [−1, 1]

so that directions near the horizon are as finely divided as others. The third coordinate is ν = 1/λ.
A grating of one row keeps ω_o,y = −ω_i,y. Then K and G depend on the longitudes alone, and λ enters everywhere as λ/c:
a is a function of x and ν = c/λ, and the table has one row in y.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, field

import numpy as np
from numpy.polynomial.chebyshev import chebvander
from numpy.typing import NDArray
from scipy import ndimage

from .grating_spectrum import GratingSpectrum

SLACK = 5e-4
"""What an albedo may exceed one by: half the error of a spectrum at its usual tolerance."""

CONICAL_SHAPE = (1, 129, 129)  # nodes in (y, ν, x)
GENERAL_SHAPE = (25, 13, 25)
NARROW = 0.01  # λσ_q of lobes so narrow that ω_o,y = −ω_i,y holds
FINE, COARSE = 0.15, 0.6  # cycles/µm, widths of the cells of q in which nodes are gathered; weak ones in the wider
WEAK = 2e-3  # the power under which a cell is weak
CHUNK = 1 << 16  # pairs (direction, q) that are computed at once, so that they stay in the cache
STRONG = 2e-2  # the power from which a cell is given back its lobe
# How many points stand for a lobe along each axis, and how far they are apart, in σ_q. Where light grazes, the horizon
# cuts through the lobe of the mirror direction, which is divided more finely.
LOBE, MIRROR_LOBE = (3, 1.3), (9, 0.6)


@dataclass(frozen=True, eq=False)
class GatheredSpectrum:
    """S(q; κ) gathered in few cells of the frequency plane.

    Attributes:
        q: float32 (n, 2), cycles/µm, the centres of power.
        widths: float32 (n,), cycles/µm.
        powers: p_j, float32 (n, K), at K equidistant κ from 0 to `largest_kappa`; linear between them.
        largest_kappa: rad/µm.
        wavelengths: (shortest, longest) in nm.
        conical: ω_o,y = −ω_i,y.
    """

    q: NDArray[np.float32] = field(repr=False)
    widths: NDArray[np.float32] = field(repr=False)
    powers: NDArray[np.float32] = field(repr=False)
    largest_kappa: float
    wavelengths: tuple[float, float]
    conical: bool

    @classmethod
    def of(cls, spectrum: GratingSpectrum) -> GatheredSpectrum:
        """Gather the nodes of `spectrum` in the cells of a grid, each cell at its centre of power."""
        q_x, q_y = spectrum.grid.frequencies()
        # A quadratic B-spline has the variance Δ²/4.
        sigma = spectrum.lobe_width if spectrum.extent == "tile" else max(spectrum.grid.spacing) / 2
        conical = spectrum.extent == "tile" and len(q_y) == 1 and sigma * spectrum.wavelengths[1] * 1e-3 <= NARROW
        narrow = sigma <= FINE / 3
        fine = FINE / 8 if conical else FINE if narrow else FINE / 2
        # Wide lobes are gathered point by point, narrow ones are put back where they matter.
        spread = 0.0 if narrow else sigma
        x, first_x = _cells(q_x, spread, fine)
        y, first_y = (m.T for m in _cells(q_y, spread, fine))

        # p_j(κ) is band-limited by the height range R: Chebyshev nodes enough for e^{iκR}.
        largest, radians = spectrum.largest_kappa, spectrum.largest_kappa * spectrum.height_range
        count = int(np.ceil(radians / 2)) + 12
        nodes = np.cos(np.pi * (np.arange(count) + 0.5) / count)
        gathered = np.empty((count, len(y), x.shape[1]), np.float32)
        total = np.zeros(spectrum.grid.shape, np.float32)
        for index, node in enumerate(nodes):
            powers = spectrum.powers((1 + node) / 2 * largest)
            gathered[index] = y @ powers @ x
            total += powers
        mean = y @ total @ x
        present = mean > count * 1e-9
        q = np.stack([y @ total @ first_x, first_y @ total @ x], -1)[present] / mean[present][:, None]

        # From the nodes to equidistant κ, 0.15 rad of the fastest oscillation apart.
        equidistant = np.linspace(-1, 1, int(np.ceil(radians / 0.15)) + 2)
        weights = 2 / count * chebvander(nodes, count - 1)
        weights[:, 0] /= 2
        powers = np.maximum(chebvander(equidistant, count - 1) @ weights.T @ gathered[:, present], 0).T
        widths = np.full(len(q), fine)
        cells = _merged(q, widths, powers, COARSE / 8 if conical else COARSE)
        if narrow:
            cells = _spread(*cells, sigma)
        q, widths, powers = (np.ascontiguousarray(x, np.float32) for x in cells)
        return cls(q, widths, powers, largest, spectrum.wavelengths, conical)

    def albedo(
        self, directions: NDArray[np.float64], wavelength: float, shadowing: bool = True, height_scale: float = 1.0
    ) -> NDArray[np.float32]:
        """a(ω, λ).

        Args:
            directions: ω, (n, 3) unit vectors above the surface, along the pattern's axes.
            wavelength: λ in µm; 4π · `height_scale`/λ at most `largest_kappa`.
            shadowing: G is the V-cavity's, else 1.
            height_scale: times the heights.

        Returns:
            (n,).
        """
        count = self.powers.shape[1]
        per_cosine = 2 * np.pi * height_scale / wavelength * (count - 1) / self.largest_kappa
        # Light reaches no further than |q| = 2/λ.
        reached = np.flatnonzero((self.q**2).sum(-1) * wavelength**2 < 4)
        u, v = (np.float32(wavelength) * self.q[reached]).T
        start = reached * count
        width = np.float32(wavelength) * self.widths[reached]
        flat = self.powers.ravel()
        result = np.empty(len(directions), np.float32)
        size = max(1, CHUNK // max(1, len(u)))
        for first in range(0, len(directions), size):
            s_x, s_y, cos_i = directions[first : first + size].astype(np.float32).T[:, :, None]
            sine_square = (u + s_x) ** 2 + (v + s_y) ** 2
            # The part of the cell above the horizon. The mean of its cosines at both edges is, near the horizon, the
            # harmonic mean over that part: K has 1/cos θ_o.
            square = 1 - sine_square
            above = np.minimum(np.maximum(square / (2 * width) + 0.5, 0), 1)
            inner, outer = np.maximum(square + width, 1e-8), np.maximum(square - width, 0)
            cos_o = np.minimum(0.5 * (np.sqrt(inner) + np.sqrt(outer)), 1)
            cos_i = np.maximum(cos_i, 1e-4)
            w = cos_i + cos_o
            d = 0.5 * (u**2 + v**2 + w**2)
            factor = d**2 / (cos_i * cos_o * w**2)
            if shadowing:
                factor *= np.minimum(1, 2 * w * np.minimum(cos_i, cos_o) / d)
            place = np.minimum(np.float32(per_cosine) * w, count - 1)
            cell = np.minimum(place.astype(np.int32), count - 2)
            place -= cell
            index = start + cell
            below = flat[index]
            power = below + place * (flat[index + 1] - below)
            result[first : first + size] = (above * factor * power).sum(-1)
        return result


@dataclass(frozen=True, eq=False)
class EnergyTable:
    """Lower bounds of e at nodes, linear between them in y, ν and x.

    Attributes:
        values: float32 (N_y, N_ν, N_x); y and x from −1 to 1, ν as in `range`.
        frequencies: (smallest, largest) ν in 1/µm.
        conical: ν = c/λ and N_y = 1; else ν = 1/λ.
    """

    values: NDArray[np.float32] = field(repr=False)
    frequencies: tuple[float, float]
    conical: bool

    @property
    def needed(self) -> bool:
        """Some direction would reflect more than it receives."""
        return bool((self.values < 1).any())


def energy_table(spectrum: GatheredSpectrum, shadowing: bool = True, height_scale: float = 1.0) -> EnergyTable:
    """e, bounded from below.

    It is computed at the nodes and half-way between them; where the line between nodes is above a value half-way, they
    are lowered.
    """
    shape = CONICAL_SHAPE if spectrum.conical else GENERAL_SHAPE
    shortest, longest = (w * 1e-3 for w in spectrum.wavelengths)
    frequencies = (0.0 if spectrum.conical else 1 / longest, 1 / shortest)
    rows, slices, columns = (2 * n - 1 for n in shape)
    x, y = np.linspace(-1, 1, columns)[None, :], np.linspace(-1, 1, rows)[:, None]
    a = np.ones((rows, slices, columns), np.float32)

    def compute(index: int) -> None:
        nu = frequencies[0] + (frequencies[1] - frequencies[0]) * index / (slices - 1)
        if not spectrum.conical:
            directions = directions_at(x, y).reshape(-1, 3)
            a[:, index] = spectrum.albedo(directions, 1 / nu, shadowing, height_scale).reshape(rows, columns)
        elif nu > 0:  # at ν = 0 all light goes to the mirror direction
            # λ/c is one number, but the lobes are λσ_q wide: take the largest.
            for wavelength in np.unique([shortest, min(longest, 1 / nu)]):
                c = wavelength * nu
                directions = directions_at(x, np.sqrt((1 - c) / (1 + c))).reshape(-1, 3)
                other = spectrum.albedo(directions, wavelength, shadowing, height_scale)
                np.maximum(a[0, index], other, out=a[0, index])

    with ThreadPoolExecutor() as threads:
        list(threads.map(compute, range(slices)))
    e = np.minimum(1, (1 + SLACK) / a)
    values = e[::2, ::2, ::2]
    # Twice: lowering a node lowers the lines to all its neighbours, and rounding must not lift them above.
    for _ in range(2):
        ratio = np.minimum(e / _halved(values), 1)
        values = values * ndimage.minimum_filter(ratio, 3, mode="nearest")[::2, ::2, ::2]
    return EnergyTable(np.ascontiguousarray(values, np.float32), frequencies, spectrum.conical)


def _halved(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """The values at nodes and, linear between them, half-way: n of an axis become 2n − 1."""
    for axis in range(values.ndim):
        values = np.moveaxis(values, axis, 0)
        result = np.repeat(values, 2, axis=0)[:-1]
        result[1::2] = 0.5 * (values[:-1] + values[1:])
        values = np.moveaxis(result, 0, axis)
    return values


def directions_at(x: NDArray[np.float64], y: NDArray[np.float64]) -> NDArray[np.float64]:
    """The unit vectors (..., 3) of the coordinates x and y, which broadcast."""
    x, y = np.broadcast_arrays(x, y)
    c = (1 - y**2) / (1 + y**2)
    return np.stack([c * 2 * x / (1 + x**2), 2 * y / (1 + y**2), c * (1 - x**2) / (1 + x**2)], -1)


def _cells(q: NDArray[np.float64], sigma: float, width: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """How nodes along one axis, each with its lobe, fall into cells.

    Args:
        q: (n,) cycles/µm.
        sigma: σ_q in cycles/µm.
        width: of a cell, cycles/µm.

    Returns:
        The share of each node in each cell, and the same times q; along x (n, cells), along y to be transposed.
    """
    offsets, weights = _lobe(*(MIRROR_LOBE if sigma else (1, 1.0)))
    points = q[:, None] + sigma * offsets
    cells = np.round(points / width).astype(np.int64)
    first = cells.min()
    share, moment = np.zeros((2, len(q), cells.max() - first + 1), np.float32)
    row = np.broadcast_to(np.arange(len(q))[:, None], cells.shape)
    np.add.at(share, (row, cells - first), np.broadcast_to(weights, cells.shape))
    np.add.at(moment, (row, cells - first), weights * points)
    return share, moment


def _spread(
    q: NDArray[np.float64], widths: NDArray[np.float64], powers: NDArray[np.float64], sigma: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Strong cells turned into lobes of the width `sigma` (cycles/µm); arguments and result as of `_merged`."""
    strong = powers.max(-1) >= STRONG
    mirror = strong & (np.abs(q).max(-1) <= FINE / 2)
    parts = [(q[~strong], widths[~strong], powers[~strong])]
    for chosen, (count, spacing) in ((strong & ~mirror, LOBE), (mirror, MIRROR_LOBE)):
        offsets, weights = _lobe(count, spacing)
        square = sigma * np.stack(np.meshgrid(offsets, offsets), -1).reshape(-1, 2)
        points = (q[chosen][:, None] + square).reshape(-1, 2)
        shares = powers[chosen][:, None] * np.outer(weights, weights).reshape(-1, 1)
        parts.append((points, np.full(len(points), spacing * sigma), shares.reshape(len(points), powers.shape[1])))
    return tuple(np.concatenate(x) for x in zip(*parts, strict=True))


def _lobe(count: int, spacing: float) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Points that stand for a Gaussian of unit width, and their weights."""
    offsets = spacing * (np.arange(count) - (count - 1) / 2)
    weights = np.exp(-(offsets**2) / 2)
    return offsets, weights / weights.sum()


def _merged(
    q: NDArray[np.float64], widths: NDArray[np.float64], powers: NDArray[np.float64], width: float
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """Gather weak cells in wider ones, each at its centre of power.

    Args:
        q: (n, 2) cycles/µm.
        widths: (n,) cycles/µm.
        powers: (n, K).
        width: of the wider cells, cycles/µm.

    Returns:
        The same for fewer cells.
    """
    weak = powers.max(-1) < WEAK
    if not weak.any():
        return q, widths, powers
    _, cell = np.unique(np.round(q[weak] / width), axis=0, return_inverse=True)
    cell = cell.ravel()
    merged = np.zeros((cell.max() + 1, powers.shape[1]))
    np.add.at(merged, cell, powers[weak])
    weight = powers[weak].sum(-1)
    moment = np.stack([np.bincount(cell, weight * q[weak, axis]) for axis in (0, 1)], -1)
    centre = moment / np.bincount(cell, weight)[:, None]
    return (
        np.concatenate([q[~weak], centre]),
        np.concatenate([widths[~weak], np.full(len(centre), width)]),
        np.concatenate([powers[~weak], merged]),
    )
