"""Errors of a spectrum relative to the float64 reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.special
from numpy.typing import NDArray

from ...array_types import Real
from ...bsdf.testing import direction
from ...optics.color import daylight, delta_E, radiance_to_XYZ
from ...precomputation.grating_spectrum import GratingSpectrum
from ...scalar_theory.reference import power_spectrum
from ...spectrum.grids import OrderGrid
from ...surface.heightfield import HeightField
from ..record import Record
from .cases import Case

_PATCHES = tuple(direction(np.array([30.0, -45.0, -15.0, -5.0, 10.0, 45.0, 60.0]), azimuth) for azimuth in (0.0, 90.0))
"""ω_i and six ω_o in each of the planes x and y: (7, 3)."""


def against_reference(height_field: HeightField, spectrum: GratingSpectrum) -> Record:
    """Compute ∫|ΔS| dq of the table, at three κ."""
    random = np.random.default_rng(5)
    errors = [
        l1_error(spectrum, height_field, kappa, 400, random) for kappa in random.uniform(0.2, 1, 3) * spectrum.max_kappa
    ]
    note = "∫|ΔS| dq, 400 frequencies at each of three κ"
    return Record.at_max_error(0.0, errors, spectrum.tolerance + spectrum.truncated_power, note)


def l1_error(
    spectrum: GratingSpectrum, height_field: HeightField, kappa: float, count: int, random: np.random.Generator
) -> float:
    """Estimate ∫|ΔS| dq at κ over the frequencies of propagating light, by importance sampling of S.

    Args:
        spectrum: of the surface.
        height_field: the surface.
        kappa: rad/µm.
        count: number of frequencies drawn.
        random: generator that draws them.
    """
    powers = spectrum.powers(kappa)
    q = _drawn(spectrum, np.maximum(powers, 0), count, random)
    max_frequency = 2 * np.sin(np.deg2rad(spectrum.largest_angle)) / (spectrum.wavelengths[0] * 1e-3)
    lines = isinstance(spectrum.grid, OrderGrid)
    margin = spectrum.cutoff_sigmas * spectrum.lobe_width if lines else 0.0
    q = q[np.hypot(*q.T) < max_frequency - margin]
    approximate = spectrum.evaluate(q, kappa)
    exact = power_spectrum(height_field, q, kappa, extent=spectrum.extent, coherence_length=spectrum.coherence_length)
    # q are drawn from S/∫S where S is positive; NaN is kept.
    drawn = ~(approximate <= 0)
    error = np.abs(approximate - exact)[drawn] / approximate[drawn]
    # Frequencies outside the cutoff of the lobes are not drawn.
    tail = 1 - np.prod([lobe.inside for lobe in spectrum.lobes]) if lines else 0.0
    return float(error.sum() / count * powers.sum(dtype=np.float64) + spectrum.truncated_power + tail)


def _drawn(
    spectrum: GratingSpectrum, powers: NDArray[np.float32], count: int, random: np.random.Generator
) -> NDArray[np.float64]:
    """Draw `count` frequencies q with the density S: a node, then an offset within its lobe or spline."""
    q_x, q_y = spectrum.grid.frequencies()
    total = np.cumsum(powers.ravel(), dtype=np.float64)
    # One random number in each of `count` equal steps: less noise than independent ones.
    cumulative = (np.arange(count) + random.random(count)) / count * total[-1]
    row, column = np.unravel_index(np.minimum(np.searchsorted(total, cumulative), total.size - 1), powers.shape)
    if isinstance(spectrum.grid, OrderGrid):
        # Gaussian offsets, truncated at the half widths of the lobes.
        inside = np.array([lobe.inside for lobe in spectrum.lobes])
        offset = spectrum.lobe_width * scipy.special.ndtri(0.5 + inside * (random.random((count, 2)) - 0.5))
    else:
        # A quadratic B-spline is the density of the sum of three uniform numbers.
        offset = random.uniform(-0.5, 0.5, (3, count, 2)).sum(axis=0) * spectrum.grid.spacing
    return np.stack([q_x[column], q_y[row]], axis=-1) + offset


@dataclass(frozen=True)
class Accuracy:
    """Errors of a spectrum.

    Attributes:
        l1: max over κ of ∫|ΔS| dq, a fraction of the reflected power.
        delta_e: (mean, maximum) CIEDE2000 of twelve patches of colour.
    """

    l1: float
    delta_e: tuple[float, float]


class Exact:
    """Reference of a case, computed once for all of its spectra."""

    def __init__(self, case: Case, wavelengths: tuple[float, float], kappas: int = 4, points: int = 2000) -> None:
        self._case, self._points = case, points
        self._kappas = np.random.default_rng(1).uniform(0.1, 1, kappas) * 4 * np.pi / (wavelengths[0] * 1e-3)
        self._wavelengths = np.arange(wavelengths[0], wavelengths[1] + 1, 10.0)
        wi, wo = patch_directions()
        both, um = (wi + wo)[:, None], self._wavelengths[:, None] * 1e-3
        self._q, self._kappa = -both[..., :2] / um, 2 * np.pi * both[..., 2] / um[:, 0]
        exact = power_spectrum(
            case.height_field, self._q, self._kappa, extent=case.extent, coherence_length=case.coherence_length
        )
        self.xyz = self._xyz(exact)
        """(12, 3) of the patches' S/λ² under D65; without K, G and R, which differ from patch to patch."""

    def _xyz(self, s: Real) -> Real:
        light = daylight(self._wavelengths) / (self._wavelengths * 1e-3) ** 2
        return radiance_to_XYZ(s * light, self._wavelengths)

    def accuracy(self, spectrum: GratingSpectrum) -> Accuracy:
        """Compute the errors of a spectrum of the same case."""
        field, random = self._case.height_field, np.random.default_rng(2)
        return Accuracy(
            l1=float(np.max([l1_error(spectrum, field, kappa, self._points, random) for kappa in self._kappas])),
            delta_e=self.delta_e(spectrum),
        )

    def delta_e(self, spectrum: GratingSpectrum) -> tuple[float, float]:
        """Return mean and maximum CIEDE2000 of the patches, for a spectrum of the same case."""
        return patch_difference(self.xyz, self._xyz(spectrum.evaluate(self._q, self._kappa)))


def patch_difference(exact: Real, approximate: Real) -> tuple[float, float]:
    """Return mean and maximum CIEDE2000 of XYZ (n, 3), exposed so that the brightest exact patch is a light grey."""
    difference = delta_E(*(xyz * 0.5 / exact[:, 1].max() for xyz in (exact, approximate)))
    return float(difference.mean()), float(difference.max())


def patch_directions() -> tuple[Real, Real]:
    """Return ω_i and ω_o of the patches, (12, 3) each."""
    return np.repeat([plane[0] for plane in _PATCHES], 6, axis=0), np.concatenate([plane[1:] for plane in _PATCHES])
