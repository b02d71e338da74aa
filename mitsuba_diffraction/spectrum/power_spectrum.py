"""The precomputed power spectrum S(q; κ) of the phase e^{iκh} of a surface."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, field, fields
from functools import cached_property
from typing import cast

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import RequestError, check_whole
from ..settings import ScalarSettings, lobe_width, matching
from .grids import LobeAxis, OrderGrid, SplineGrid
from .tables import AmplitudeTable, SliceTable

MAX_SOURCE = 2**13  # characters of the origin of the heights, which messages and pages quote
_MARGIN = 0.5  # of the sum of all powers: splines hold some at frequencies that no direction reaches
_CHECKED = 8  # pairs of κ at which the powers of a series are checked


@dataclass(frozen=True, eq=False)
class PowerSpectrum:
    """S(q; κ): Σ_m η_m(κ) N(q − m/T; σ_q² I) for a tile; B-splines for a sample, and where many lobes overlap.

    Attributes:
        table: η_m(κ), or the coefficients of the splines.
        grid: the diffraction orders m, or the nodes of the splines, that are kept.
        settings: the parameters it was built with. The coherence length of a sample is at most what the scan supports,
            and the tolerance is a number.
        pixel_size: (x, y) of the height field, µm.
        height_range: of the height field, µm.
        error: the maximum over several measured κ of ∫|S_approx − S_exact| dq over the frequencies that light can
            reach. Between them it may be larger, for means of few patches by up to two thirds.
        source: origin of the heights.
        source_digest: SHA-256 of the height field.
        truncated_power: the largest fraction of the power, over κ, at weak frequencies that are left out; part of
            `error`.
        unresolved_power: the largest fraction of the power, over κ, at frequencies that no pair of directions reaches,
            or that the pixels do not resolve.
        patches: number of random patches of an irregular surface that are averaged.
        standard_error: for a sample, the maximum over κ of ∫ dq of the standard error of Welch's estimate, a fraction
            of the reflected power, comparable to `error`; None for a tile, which is known exactly.
    """

    table: SliceTable | AmplitudeTable
    grid: OrderGrid | SplineGrid
    settings: ScalarSettings
    pixel_size: tuple[float, float]
    height_range: float
    error: float
    source: str
    source_digest: str = field(repr=False)
    truncated_power: float = 0.0
    unresolved_power: float = 0.0
    patches: int = 1
    standard_error: float | None = None

    def __post_init__(self) -> None:
        if self.table.shape != self.grid.shape:
            raise RequestError(f"table: got {self.table.shape} nodes, wanted {self.grid.shape}")
        if not all(np.isfinite(p) and p > 0 for p in self.pixel_size):
            raise RequestError(f"pixel_size: got {self.pixel_size}, wanted two positive lengths in µm")
        if not (np.isfinite(self.height_range) and self.height_range >= 0):
            raise RequestError(f"height_range: got {self.height_range}, wanted a length ≥ 0 in µm")
        if not 0 <= self.error < np.inf:
            raise RequestError(f"error: got {self.error}, wanted a fraction of the power")
        if not (isinstance(self.source, str) and isinstance(self.source_digest, str)):
            raise RequestError(f"source: got {self.source!r}, {self.source_digest!r}, wanted texts")
        if len(self.source) > MAX_SOURCE:
            raise RequestError(f"source: got {len(self.source)} characters, wanted at most {MAX_SOURCE}")
        if not (0 <= self.truncated_power <= 1 and 0 <= self.unresolved_power <= 1):
            got = f"{self.truncated_power}, {self.unresolved_power}"
            raise RequestError(f"truncated_power, unresolved_power: got {got}, wanted fractions of the power")
        check_whole("patches", self.patches, 1)
        found = self.standard_error
        if (found is not None) != (self.extent == "sample") or not 0 <= (found or 0.0) < np.inf:
            raise RequestError(f"standard_error: got {found} of a {self.extent}, wanted a number ≥ 0 of a sample only")

    @property
    def extent(self) -> str:
        """ "tile": the patch repeats periodically; "sample": it is a piece of a larger, irregular surface."""
        return self.settings.extent

    @property
    def coherence_length(self) -> float:
        """L_c in µm, which sets the width σ_q of each order."""
        return self.settings.coherence_length

    @property
    def wavelengths(self) -> tuple[float, float]:
        """(shortest, longest) in nm for which the table is valid."""
        return self.settings.wavelengths

    @property
    def largest_angle(self) -> float:
        """Degrees from the normal, of both directions, for which the table is valid."""
        return self.settings.largest_angle

    @property
    def tolerance(self) -> float:
        """The requested bound of the error."""
        return cast(float, self.settings.tolerance)

    @property
    def excess(self) -> str:
        """A sentence on the error of a series that has too few terms for its tolerance; else empty."""
        if self.settings.terms is None or self.error <= self.tolerance:
            return ""
        return (
            f"{self.representation}: {self.settings.terms} terms of heights from the {self.settings.heights_from}, of "
            f"a range of {self.height_range:.3g} µm, err by {self.error:.2g} of the power, more than the tolerance "
            f"{self.tolerance:.2g}"
        )

    @property
    def representation(self) -> str:
        """The storage of the powers: "slices", "taylor" or "chebyshev"."""
        return self.settings.representation

    @property
    def max_kappa(self) -> float:
        """4π/λ_min in rad/µm: normal incidence and exit at the shortest wavelength."""
        return 4 * np.pi / (self.wavelengths[0] * 1e-3)

    @property
    def lobe_width(self) -> float:
        """σ_q in cycles/µm."""
        return lobe_width(self.coherence_length)

    @property
    def cutoff_sigmas(self) -> float:
        """The smallest half width of a truncated lobe, in standard deviations σ_q."""
        return self.settings.lobe_cutoff

    @property
    def lobes(self) -> tuple[LobeAxis, LobeAxis]:
        """The truncation of the orders' lobes along x and y."""
        if not isinstance(self.grid, OrderGrid):
            raise RequestError("lobes: got a lattice of splines, wanted a grid of orders")
        return self.grid.lobes(self.lobe_width, self.cutoff_sigmas)

    @property
    def neighbours(self) -> tuple[int, int]:
        """The number of nodes along x and y that contribute at one q, to the tolerance."""
        return (self.lobes[0].count, self.lobes[1].count) if isinstance(self.grid, OrderGrid) else (3, 3)

    @property
    def megabytes(self) -> float:
        """Size of the table in memory."""
        return self.table.nbytes / 1e6

    def powers(self, kappa: float) -> NDArray[np.float32]:
        """Return the fraction of the reflected power of each node, (2 M_y + 1, 2 M_x + 1), in float32 as in rendering.

        For orders this is η_m(κ). Values may be negative, by the error, and as coefficients of splines.

        Raises:
            ValueError: if κ (rad/µm) is outside the range of the table.
        """
        return self.table.powers(float(self._checked(np.asarray(kappa, np.float64))))

    def check_powers(self) -> None:
        """Check the powers of a file: their sum is one but for the error and what was left out, and few are negative.

        Raises:
            RequestError: if they cannot be powers.
        """
        for kappa in np.linspace(0, self.max_kappa, 2 * getattr(self.table, "intervals", _CHECKED) + 1):
            powers = self.table.powers(kappa)
            total, negative = (float(part.sum(dtype=np.float64)) for part in (powers, np.minimum(powers, 0)))
            margin = _MARGIN + self.error
            if not (1 - margin - self.truncated_power - self.unresolved_power <= total <= 1 + margin >= 1 - negative):
                raise RequestError(
                    f"table: got powers of the sum {total:.3g}, of which {negative:.3g} are negative, at κ = "
                    f"{kappa:.3g} rad/µm; wanted fractions of the reflected power, of the sum 1"
                )

    def evaluate(self, q: ArrayLike, kappa: ArrayLike) -> NDArray[np.float64]:
        """Evaluate S(q; κ) from the table.

        Args:
            q: (..., 2) cycles/µm, along x and y.
            kappa: (...) rad/µm, 0 ≤ κ ≤ `max_kappa`.

        Returns:
            (...) µm².

        Raises:
            ValueError: if shapes do not match or κ is outside the range of the table.
        """
        q, kappa = matching(q, kappa)
        self._checked(kappa)
        result = np.zeros(kappa.shape)
        grid = self.grid
        around = grid.around(q, self.lobe_width, self.cutoff_sigmas) if isinstance(grid, OrderGrid) else grid.around(q)
        for row, column, weight in around:
            result += weight * self.table.powers_at(row, column, kappa)
        # Interpolation may be negative within its error.
        return np.maximum(result, 0)

    def _checked(self, kappa: NDArray[np.float64]) -> NDArray[np.float64]:
        if not (np.all(kappa >= 0) and np.all(kappa <= self.max_kappa * (1 + 1e-6))):
            raise RequestError(
                f"kappa: got values from {np.min(kappa):.6g} to {np.max(kappa):.6g} rad/µm, wanted 0 to "
                f"{self.max_kappa:.6g} (the spectrum was built for wavelengths from {self.wavelengths[0]:g} nm)"
            )
        return kappa

    @cached_property
    def digest(self) -> str:
        """SHA-256 of everything that a renderer needs: spectra of equal digest render alike."""
        content = hashlib.sha256()
        for f in fields(PowerSpectrum):
            if f.name not in ("table", "source", "source_digest"):
                content.update(f"{f.name}={getattr(self, f.name)!r};".encode())
        for array in self.table.content():
            content.update(array.data)
        return content.hexdigest()
