"""Rigorous efficiencies of a grating as a table over direction and wavelength, and its file.

A rigorous spectrum as an OpenEXR file: float32, ZIP, one part.

Line r of the channel `eta` holds row r of the table (`Axes`), with its nodes of F, X and Z in C order; if the table is
polarised, `m(ij)` holds M_ij likewise. Numbers in the header are double precision.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any, cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..array_types import Real
from ..errors import RequestError, check_whole
from ..optics.media import MediumBelow
from ..optics.refractive_indices import MAX_INDEX
from ..settings import RigorousSettings, lobe_cutoff, lobe_width
from ..spectrum.exr import MALFORMED, doubles, one_line, read_channels, write_channels
from ..spectrum.grids import OrderGrid
from ..spectrum.power_spectrum import MAX_SOURCE
from .solver import ODD, REVERSED

RIGOROUS_FORMAT = "mitsuba_diffraction rigorous spectrum"
RIGOROUS_FORMAT_VERSION = 6

# Settings and attributes, and their names in files.
_SETTINGS = {"ext_ior": "extIor", "coherence_length": "coherenceLength", "tolerance": "tolerance"}
_NUMBERS = {
    "error": "error",
    "max_error": "worst",
    "max_error_near": "worstNear",
    "polarisation_error": "polarisationError",
}
_TEXTS = {"index_digest": "materialDigest", "source": "source", "source_digest": "sourceDigest"}
_STEPS = ("stepsF", "stepsX", "stepsZ")


_EXCESS_MARGIN = 0.25
_MAX_EXCESS = 0.05  # of efficiencies above one or below zero, by errors of the solver
MAX_PERIOD_IN_WAVELENGTHS = 10.0
"""In units of the shortest wavelength: the table grows with the cube of the period, the time to build it faster."""


@dataclass(frozen=True)
class Axes:
    """The coordinates of the table, in which η is piecewise smooth and the same for reversed light.

    With ν = T/λ, directions enter by three numbers, symmetric under exchange of ω_i and ω_o except for the sign of c:

        k_y = (ω_o,y − ω_i,y) ν / 2,    γ² = ν² − k_y²,    c = (ω_o,x − ω_i,x) ν / 2.

    In units of 2π/T, γ is the wave number across the grooves above the surface, and γ', with γ'² = γ² + (n² − 1) ν²,
    the wave number below. In order m, incident light with k_x = c + m/2 = n + α is diffracted to c − m/2 = n − m + α,
    with a whole number n and |α| ≤ 1/2. Where α < 0 the reversed light is looked up, whose c has the opposite sign:
    only a = |α| remains. η has a square-root singularity where an order is at its Rayleigh anomaly, above or below,
    that is, where γ or γ' is one of

        h₀ = a,  h₁ = 1 − a,  h₂ = 1 + a,  h₃ = 2 − a,  …,

    the |n + a| of n = 0, −1, 1, −2, … In interval j, from h_{j−1} to h_j, the first j of these orders propagate. Within
    it η is smooth in X, and, with F instead of a, also where an interval shrinks to a point,

        X / (1 − X) = √(t / (1 − t)),    t = (γ² − h_{j−1}²) / (h_j² − h_{j−1}²),    sin²(π F / 2) = 2 a,

    from 0 to 1. X resolves the ends of an interval best: light at grazing incidence above enters the denser medium
    within a few degrees. Likewise sin²(π Z / 2) = t' for γ'. Interval 0 of γ, where light propagates below only, begins
    at the smallest γ² that the shortest wavelength admits in the interval of γ', h'_{j−1}² − `excess_limit`. Without
    transmission (index 0) Z is the wavelength, from the shortest to the longest that γ admits (k_y² ≥ 0):

        λ = λ₀ + (λ₁ − λ₀) Z,    λ₀ = min(λ_min, T/γ),    λ₁ = min(λ_max, T/γ).

    A block of the table is a pair of intervals of γ and γ'. It has a row for each pair of an incident and an outgoing
    order, orders above before orders below. The nodes of a row are at equal steps of F, X and Z.

    Attributes:
        period: T in µm.
        wavelengths: (shortest, longest) in µm.
        steps: numbers of steps of F, X and Z.
        index: n of the medium below, relative to the medium above; 0 if Z is the wavelength.
        transmission: one of `TRANSMISSIONS`; a sheet has air below.
    """

    period: float
    wavelengths: tuple[float, float]
    steps: tuple[int, int, int]
    index: float = 0.0
    transmission: str = "none"

    def __post_init__(self) -> None:
        shortest, longest = self.wavelengths
        if not (
            0 < shortest < longest < np.inf and 0 < self.period <= MAX_PERIOD_IN_WAVELENGTHS * shortest * (1 + 1e-9)
        ):
            raise RequestError(
                f"period, wavelengths: got {self.period} and {self.wavelengths} µm, wanted a period of at most "
                f"{MAX_PERIOD_IN_WAVELENGTHS:g} wavelengths"
            )
        if not 0 <= self.index <= MAX_INDEX:
            raise RequestError(f"index: got {self.index}, wanted one from 0 to {MAX_INDEX:g}")
        for steps in self.steps:
            check_whole("steps", steps, 1)

    @property
    def excess(self) -> float:
        """n² − 1, or 0."""
        return self.index**2 - 1 if self.index else 0.0

    @property
    def excess_limit(self) -> float:
        """The largest (n² − 1) ν² plus a margin, so that an interval 0 that is used never shrinks to a point."""
        return self.excess * self.max_nu**2 + np.sign(self.excess) * _EXCESS_MARGIN

    @property
    def max_nu(self) -> float:
        """The largest ν."""
        return self.period / self.wavelengths[0]

    @property
    def max_order(self) -> int:
        """M, the largest order that any pair of directions reaches."""
        return int(np.ceil(2 * self.max_nu * (max(1.0, self.index) if self.transmission == "interface" else 1.0))) - 1

    def counts(self, above: NDArray[np.int64] | int, below: NDArray[np.int64] | int) -> tuple[Any, Any]:
        """Return the numbers of outgoing orders above and below, for the intervals of γ and γ'."""
        return above, {"none": 0 * above, "sheet": above, "interface": below}[self.transmission]

    @cached_property
    def blocks(self) -> dict[tuple[int, int], int]:
        """Pairs of intervals of γ and γ' that light can have → first row of their block.

        The interval of γ' is 0 if Z is the wavelength.
        """
        # Between two adjacent values of a the bounds of intervals are monotonic.
        a = np.linspace(0, 0.5, 65)
        max_square = self.max_nu**2
        min_square = min(-self.excess * max_square, 0.0) if self.transmission == "interface" else 0.0
        intervals = [self._bounds(j, a, min_square) for j in range(int(2 * self.max_nu) + 3)]
        intervals_below = intervals
        if self.index:
            count = int(2 * max(1, self.index) * self.max_nu) + 3
            intervals_below = [self._bounds(j, a, -max_square) for j in range(count)]
        found, row = {}, 0
        for j, (low, high) in enumerate(intervals):
            if j == 0 and min_square == 0:
                continue
            ends = []
            for square in (low, np.minimum(high, max_square)):
                min_nu2 = np.maximum((self.period / self.wavelengths[1]) ** 2, square)
                excesses = [self.excess * min_nu2, np.full_like(square, self.excess * max_square)]
                ends.append(square + np.sort(excesses, axis=0))
            for k, (low_below, high_below) in enumerate(intervals_below):
                meets = (low < max_square) & (ends[0][0] < high_below) & (ends[1][1] > low_below)
                if (meets if self.index else (low < max_square) & (k == 0)).any() and sum(self.counts(j, k)):
                    found[j, k] = row
                    row += sum(self.counts(j, k)) ** 2
        return found

    @staticmethod
    def _bounds(interval: int, a: Real, min_square: float) -> tuple[Real, Real]:
        """Return bounds of γ² in an interval, from each a to the next."""
        low, high = interval_bounds(interval, a, min_square)
        return np.minimum(low[:-1], low[1:]), np.maximum(high[:-1], high[1:])

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """The first row of each block, [interval of γ, interval of γ'], −1 where there is no block."""
        found = np.full(np.max(list(self.blocks), axis=0) + 1, -1)
        for intervals, row in self.blocks.items():
            found[intervals] = row
        return found

    @property
    def rows(self) -> int:
        """Number of pairs of orders in all blocks."""
        return max(row + sum(self.counts(*intervals)) ** 2 for intervals, row in self.blocks.items())

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Shape of the table: rows, and nodes of F, X and Z."""
        f, x, z = self.steps
        return self.rows, f + 1, x + 1, z + 1

    def locate(
        self, m: NDArray[np.int64], c: Real, g: Real, wavelength: Real, sides: tuple[int, int]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.int64], list[Real]]:
        """Return whether order m propagates, whether light is reversed, the row, and F, X and Z; g = ±√|γ²|."""
        nu = self.period / wavelength
        square = g * np.abs(g)
        square_below = square + self.excess * nu**2
        k_x = c + m / 2
        n = np.rint(k_x).astype(np.int64)
        is_reversed = k_x < n
        a = np.abs(k_x - n)
        above, below = interval_of(square, a), interval_of(square_below, a) if self.index else np.zeros_like(n)
        intervals = [np.minimum(x, size - 1) for x, size in zip((above, below), self.starts.shape, strict=True)]
        row, counts, channels = self.starts[tuple(intervals)], self.counts(*intervals), []
        in_range = (self.max_nu * (1 + 1e-9) >= nu) & (nu * (1 + 1e-9) >= self.period / self.wavelengths[1])
        propagates = (row >= 0) & in_range
        for forward_side, reverse_side, order in (
            (*sides, np.where(is_reversed, m - n, n)),
            (*sides[::-1], np.where(is_reversed, -n, n - m)),
        ):
            side = np.where(is_reversed, reverse_side, forward_side)
            propagates &= rank(order) < np.where(side, counts[1], counts[0])
            channels.append(rank(order) + np.where(side, counts[0], 0))
        row = row + channels[0] * (counts[0] + counts[1]) + channels[1]
        low, low_below = (interval_bounds(x, a, 0.0)[0] for x in (above, below))
        t = fraction_in(square, *interval_bounds(above, a, low_below - self.excess_limit))
        coordinates = [arcsine(2 * a), np.sqrt(t) / (np.sqrt(t) + np.sqrt(1 - t))]
        if self.index:
            bounds = interval_bounds(below, a, low + self.excess_limit)
            coordinates.append(arcsine(fraction_in(square_below, *bounds)))
        else:
            first, last = self.range(g)
            coordinates.append(np.clip((wavelength - first) / np.maximum(last - first, 1e-9), 0, 1))
        return propagates, is_reversed, row, coordinates

    def range(self, g: Real) -> tuple[Real, Real]:
        """Return λ₀ and λ₁ at γ = g, µm."""
        max_wavelength = self.period / np.maximum(g, 1e-12)
        return np.minimum(self.wavelengths[0], max_wavelength), np.minimum(self.wavelengths[1], max_wavelength)


def rank(n: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the index of n in 0, −1, 1, −2, …: j of h_j = |n + a|."""
    return np.where(n >= 0, 2 * n, -2 * n - 1)


def interval_bounds(interval: Any, a: Real, min_square: Any) -> tuple[Real, Real]:
    """Return h² at the beginning and at the end of an interval; interval 0 begins at `min_square`."""
    half = np.where(interval % 2, 0.5 - a, a)
    return np.where(interval > 0, (interval / 2 - half) ** 2, min_square), (interval / 2 + half) ** 2


def interval_of(square: Real, a: Real) -> NDArray[np.int64]:
    """Return the index of the interval of γ²."""
    whole, part = np.divmod(np.sqrt(np.maximum(square, 0)), 1)
    return (2 * whole + (part >= a) + (part >= 1 - a)).astype(np.int64)


def fraction_in(square: Real, low: Real, high: Real) -> Real:
    """Return t of γ² in an interval."""
    fraction: Real = np.clip((square - low) / np.maximum(high - low, 1e-30), 0, 1)
    return fraction


def arcsine(t: Real) -> Real:
    """Return Z of t, or F of 2 a."""
    angle: Real = 2 / np.pi * np.arcsin(np.sqrt(t))
    return angle


def fractions_at_nodes(steps: tuple[int, int, int]) -> tuple[Real, Real, Real]:
    """Return 2 a, t of γ² and t of γ'² at equal steps of F, X and Z."""
    f, x, z = (np.arange(count + 1) / count for count in steps)
    return np.sin(np.pi / 2 * f) ** 2, x**2 / (x**2 + (1 - x) ** 2), np.sin(np.pi / 2 * z) ** 2


@dataclass(frozen=True, eq=False)
class RigorousSpectrum:
    """Table of η_m for unpolarised light, and the parameters of f = Σ_m η_m N(q − m/T; σ_q² I) n_o² / λ².

    Side 0 is above, side 1 below. With transmission "interface" the medium of `int_ior` is below; with "sheet" it is
    air. Light from above and from below is reciprocal.

    Attributes:
        axes: coordinates of the table.
        values: η at the nodes, (rows, F, X, Z).
        mueller: M_ij at the nodes, (rows, F, X, Z, 4, 4), or None. Elements that are odd in k_y are divided by k_y/ν,
            so that all are smooth at k_y = 0.
        settings: the parameters it was built with. The tolerance is a number; a medium with a name is `material`, and a
            file is named without its folder.
        index_digest: SHA-256 of the index below; empty for an index that is a number.
        error: the mean of Σ|Δη_m| / Σ η_m, measured at directions (uniform over the hemisphere) and wavelengths that
            were not used to build the table. Sums are over all outgoing orders, above and below; with transmission,
            light is incident from above and from below.
        max_error: the largest of these, away from Rayleigh anomalies (P or R further than 0.02 from an integer).
        max_error_near: the largest of these near Rayleigh anomalies.
        harmonics: N of the solver.
        source: origin of the heights.
        source_digest: SHA-256 of the height field.
        polarisation_error: the mean of Σ_m max_ij |ΔM_ij| / Σ η_m, measured as `error`; NaN without matrices.
    """

    axes: Axes
    values: NDArray[np.float32] = field(repr=False)
    mueller: NDArray[np.float32] | None = field(repr=False)
    settings: RigorousSettings
    error: float
    max_error: float
    max_error_near: float
    harmonics: int
    source: str
    source_digest: str = field(repr=False)
    index_digest: str = field(default="", repr=False)
    polarisation_error: float = float("nan")

    def __post_init__(self) -> None:
        same = np.allclose(self.axes.wavelengths, np.multiply(self.settings.wavelengths, 1e-3), rtol=1e-9)
        if not (same and self.axes.transmission == self.settings.transmission):
            raise RequestError(f"axes: got {self.axes}, wanted the wavelengths and the transmission of {self.settings}")
        if self.settings.polarised != (self.mueller is not None):
            got = "none" if self.mueller is None else str(self.mueller.shape)
            raise RequestError(f"mueller: got {got}, wanted {'matrices' if self.settings.polarised else 'none'}")
        for name, wanted in (("values", self.axes.shape), ("mueller", (*self.axes.shape, 4, 4))):
            table = getattr(self, name)
            if table is not None and (table.shape != wanted or table.dtype != np.float32):
                raise RequestError(f"{name}: got {table.shape} of {table.dtype}, wanted {wanted} of float32")
            if table is not None and not np.isfinite(table).all():
                raise RequestError(f"{name}: got numbers that are not finite")
        if not (self.values.min() >= -_MAX_EXCESS and self.values.max() <= 1 + _MAX_EXCESS):
            got = f"{self.values.min():.3g} to {self.values.max():.3g}"
            raise RequestError(f"values: got efficiencies from {got}, wanted 0 to 1")
        check_whole("harmonics", self.harmonics, 0)
        if not (isinstance(self.source, str) and isinstance(self.source_digest, str)):
            raise RequestError(f"source: got {self.source!r}, {self.source_digest!r}, wanted texts")
        if len(self.source) > MAX_SOURCE:
            raise RequestError(f"source: got {len(self.source)} characters, wanted at most {MAX_SOURCE}")

    @property
    def transmission(self) -> str:
        """One of `TRANSMISSIONS`."""
        return self.settings.transmission

    @property
    def int_ior(self) -> complex:
        """n + ik below, relative to the medium above; 0 if there is a material."""
        return complex(cast(complex, self.settings.int_ior or 0))

    @property
    def coherence_length(self) -> float:
        """L_c in µm, which sets the width σ_q of each order."""
        return self.settings.coherence_length

    @property
    def tolerance(self) -> float:
        """The requested bound of `error`."""
        return cast(float, self.settings.tolerance)

    @property
    def indices(self) -> tuple[float, float]:
        """Indices of the media of side 0 and side 1, relative to side 0."""
        return 1.0, self.int_ior.real if self.transmission == "interface" else 1.0

    # As in `GratingSpectrum`.
    theory = representation = "rigorous"
    extent = "tile"

    @property
    def concerns(self) -> list[str]:
        """None; an error above the tolerance raises a warning when the table is built."""
        return []

    @property
    def summary(self) -> str:
        """The material and the error."""
        return f"{self.medium_text}, rigorous theory; mean error {self.error:.1e} (tolerance {self.tolerance:.3g})"

    @property
    def details(self) -> str:
        """The maximum errors."""
        return (
            f"maximum error {self.max_error:.1e} of the reflected light, {self.max_error_near:.1e} near a Rayleigh "
            "anomaly" + ("" if self.mueller is None else f"; Mueller matrices, mean {self.polarisation_error:.1e}")
        )

    @property
    def wavelengths(self) -> tuple[float, float]:
        """(shortest, longest) in nm, in the medium above."""
        return self.settings.wavelengths

    @property
    def grid(self) -> OrderGrid:
        """The orders m that any pair of directions reaches."""
        return OrderGrid((self.axes.period, self.axes.period), (self.axes.max_order, 0))

    @property
    def medium_text(self) -> str:
        """The medium below, and above, as recipes and scenes specify them."""
        above = self.settings.ext_ior
        medium = "" if above == 1 else f" below ext_ior {above:.6g}"
        if self.settings.material:
            return f"material {self.settings.material}{medium}"
        index = self.int_ior.real if np.imag(self.int_ior) == 0 else self.int_ior
        return f"int_ior {index:.6g}{medium}"

    def is_of(self, below: MediumBelow) -> bool:
        """Return whether the table is of this medium; a number is the index relative to the medium above."""
        if below.index is None:
            return False
        if below.index.is_constant:
            return abs(below.index.nominal - self.int_ior) < 1e-3 * abs(self.int_ior)
        return below.index.digest == self.index_digest

    @property
    def megabytes(self) -> float:
        """Size of the table in memory."""
        return (self.values.nbytes + (0 if self.mueller is None else self.mueller.nbytes)) / 1e6

    @property
    def lobe_width(self) -> float:
        """σ_q in cycles/µm."""
        return lobe_width(self.coherence_length)

    @property
    def cutoff_sigmas(self) -> float:
        """Truncation of the lobe of an order, in standard deviations σ_q; it changes S by a tenth of the tolerance."""
        return lobe_cutoff(0.1 * self.tolerance)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of everything that a renderer needs: spectra of equal digest render alike."""
        of = self.settings
        description = repr((self.axes, of.material, self.int_ior, of.coherence_length, of.tolerance, of.ext_ior))
        arrays = [a for a in (self.values, self.mueller) if a is not None]
        return hashlib.sha256(description.encode() + b"".join(a.tobytes() for a in arrays)).hexdigest()

    def evaluate(
        self,
        m: ArrayLike,
        c: ArrayLike,
        g: ArrayLike,
        wavelength: ArrayLike,
        sides: tuple[int, int] = (0, 0),
        mueller: bool = False,
    ) -> Real:
        """Return η_m of light from one side to a side, or its Mueller matrix, linear between the nodes.

        With n_i and n_o the `indices` of the sides of ω_i and ω_o, and ν = T/λ,

            c = (n_o ω_o,x − n_i ω_i,x) ν / 2,    k_y = (n_o ω_o,y − n_i ω_i,y) ν / 2,    g = ± √|ν² − k_y²|,

        where g has the sign of ν² − k_y².

        Args:
            m: the order, broadcast against c, g and the wavelength.
            c: as above.
            g: as above.
            wavelength: µm, in the medium of side 0.
            sides: of ω_i and of ω_o, 0 above and 1 below.
            mueller: whether to return M_ij, (…, 4, 4), for k_y ≥ 0.

        Returns:
            η_m; 0 for an order that does not propagate, or outside the wavelengths of the table.

        Raises:
            ValueError: if the spectrum has no table for these sides, or no Mueller matrices.
        """
        if self.transmission == "none" and sides != (0, 0):
            raise RequestError(f"sides: got {sides!r} of a table with transmission none, wanted (0, 0)")
        if mueller and self.mueller is None:
            raise RequestError("mueller: got a table of unpolarised light, wanted one built with polarised=True")
        table: NDArray[np.float32] = self.mueller if mueller and self.mueller is not None else self.values
        m, c, g, wavelength = np.broadcast_arrays(np.asarray(m, np.int64), c, g, wavelength)
        propagates, is_reversed, row, coordinates = self.axes.locate(m, c, g, wavelength, sides)
        row = np.where(propagates, row, 0)
        result = np.zeros((*m.shape, *table.shape[4:]))
        wide = (..., *[None] * (table.ndim - 4))
        nodes = [_split(x * steps, steps) for x, steps in zip(coordinates, self.axes.steps, strict=True)]
        for corner in np.ndindex(2, 2, 2):
            node, weights = zip(
                *((low + up, f if up else 1 - f) for (low, f), up in zip(nodes, corner, strict=True)), strict=True
            )
            result += np.prod(weights, axis=0)[wide] * table[(row, *node)]
        if mueller:
            reversed_light = np.outer(REVERSED, REVERSED) * np.swapaxes(result, -1, -2)
            result = np.where(is_reversed[wide], reversed_light, result)
            sine_y = np.sqrt(np.maximum(1 - g * np.abs(g) * (wavelength / self.axes.period) ** 2, 0))
            result *= np.where(ODD, sine_y[wide], 1)
        return np.where(propagates[wide], result, 0)

    def efficiencies(
        self, direction: ArrayLike, wavelength: float, transmitted: bool = False
    ) -> tuple[NDArray[np.int64], Real]:
        """Return the propagating orders, ascending, and η_m of unpolarised light, as `rigorous.efficiencies`.

        Args:
            direction: ω_i, (3,), to the light; light is incident from below if ω_i,z < 0.
            wavelength: µm, in the medium of side 0.
            transmitted: whether to return the transmitted orders instead of the reflected ones.
        """
        omega = np.asarray(direction, np.float64) / np.linalg.norm(direction)
        side_i = int(omega[2] < 0)
        side_o = 1 - side_i if transmitted else side_i
        nu = self.axes.period / wavelength
        alpha, k_y = -omega[:2] * self.indices[side_i] * nu
        square = nu**2 - k_y**2
        g_out = np.sqrt(max((self.indices[side_o] * nu) ** 2 - k_y**2, 0))
        m = np.arange(np.ceil(alpha - g_out), np.floor(alpha + g_out) + 1).astype(int)
        m = m[np.abs(alpha - m) < g_out]
        g = np.sign(square) * np.sqrt(abs(square))
        return m, self.evaluate(m, alpha - m / 2, g, wavelength, (side_i, side_o))

    def save(self, path: str | os.PathLike[str], recipe: str = "") -> None:
        """Write the spectrum as an OpenEXR file; argument and errors of `GratingSpectrum.save`."""
        axes = self.axes
        arrays = {"eta": self.values.reshape(axes.rows, -1)}
        if self.mueller is not None:
            matrices = self.mueller.reshape(axes.rows, -1, 4, 4)
            arrays |= {_channel(i, j): np.ascontiguousarray(matrices[..., i, j]) for i, j in np.ndindex(4, 4)}
        header = {
            "period": doubles(axes.period),
            "wavelengths": doubles(*self.wavelengths),
            **dict(zip(_STEPS, axes.steps, strict=True)),
            "index": doubles(axes.index),
            "harmonics": self.harmonics,
            "polarised": int(self.mueller is not None),
            "material": self.settings.material or "",
            "intIor": doubles(self.int_ior.real, self.int_ior.imag),
            **{key: doubles(getattr(self.settings, name)) for name, key in _SETTINGS.items()},
            **{key: doubles(getattr(self, name)) for name, key in _NUMBERS.items()},
            "transmission": self.transmission,
            **{key: getattr(self, name) for name, key in _TEXTS.items()},
            "units": "lengths in micrometres, wavelengths in nanometres",
        }
        write_channels(path, RIGOROUS_FORMAT, RIGOROUS_FORMAT_VERSION, header, arrays, recipe)

    @classmethod
    def load(cls, path: str | os.PathLike[str], recipe: str | None = None) -> RigorousSpectrum:
        """Read a spectrum that `save` wrote; arguments and errors of `GratingSpectrum.load`."""
        path = Path(path)
        header, channels = read_channels(path, RIGOROUS_FORMAT, RIGOROUS_FORMAT_VERSION, recipe)
        try:
            (period,), (shortest, longest), (index,) = header["period"], header["wavelengths"], header["index"]
            steps = tuple(header[name] for name in _STEPS)
            index_below = complex(*(float(x) for x in header["intIor"]))
            settings = RigorousSettings(
                wavelengths=(float(shortest), float(longest)),
                material=header["material"] or None,
                int_ior=None if header["material"] else index_below,
                polarised=bool(header["polarised"]),
                transmission=header["transmission"],
                **{name: header[key].item() for name, key in _SETTINGS.items()},
            )
            in_um = 1e-3 * settings.wavelengths[0], 1e-3 * settings.wavelengths[1]
            axes = Axes(float(period), in_um, steps, float(index), settings.transmission)
            mueller = None
            if settings.polarised:
                found = [channels[_channel(i, j)].pixels for i, j in np.ndindex(4, 4)]
                mueller = np.stack(found, axis=-1).reshape(*axes.shape, 4, 4)
            return cls(
                axes=axes,
                values=np.ascontiguousarray(channels["eta"].pixels.reshape(axes.shape)),
                mueller=mueller,
                settings=settings,
                harmonics=header["harmonics"],
                **{name: header[key].item() for name, key in _NUMBERS.items()},
                **{name: header[key] for name, key in _TEXTS.items()},
            )
        except KeyError as error:
            raise RequestError(f"{path}: a damaged spectrum, {error} is missing") from None
        except MALFORMED as error:
            raise RequestError(f"{path}: a damaged spectrum ({one_line(error)})") from None


def _split(x: Real, steps: int) -> tuple[NDArray[np.int64], Real]:
    """Return the node below x, at most the last but one, and the distance of x from it."""
    low = np.clip(np.floor(x).astype(np.int64), 0, steps - 1)
    return low, x - low


def _channel(i: int, j: int) -> str:
    return f"m({i}{j})"
