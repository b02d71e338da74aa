"""What a spectrum gets wrong, against the float64 reference."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from ..reference import power_spectrum
from ..spectrum import GratingSpectrum
from .cases import Case

_LIGHT = "D65"
# Six directions in each of the planes x and y; one incidence.
_INCIDENCE = np.deg2rad(30.0)
_EXITS = np.deg2rad([-45.0, -15.0, -5.0, 10.0, 45.0, 60.0])


@dataclass(frozen=True)
class Accuracy:
    """Errors of a spectrum.

    Attributes:
        l1: max over κ of ∫|ΔS| dq, a share of the reflected power.
        peak: largest relative error of S at peaks, at least a hundredth as strong as the strongest.
        delta_e: (mean, largest) CIEDE2000 of twelve patches of colour.
    """

    l1: float
    peak: float
    delta_e: tuple[float, float]


class Exact:
    """A case, and what of its reference serves every spectrum of it."""

    def __init__(self, case: Case, wavelengths: tuple[float, float], kappas: int = 4, points: int = 2000) -> None:
        self._case = case
        self._kappas = np.random.default_rng(1).uniform(0.1, 1, kappas) * 4 * np.pi / (wavelengths[0] * 1e-3)
        self._points = points
        nanometres = np.arange(wavelengths[0], wavelengths[1] + 1, 10.0)
        self._wavelengths = nanometres
        self._q, self._kappa, factor = _patches(nanometres * 1e-3)
        self._spectra = factor * self._power(self._q, self._kappa)
        self._factor = factor
        self._lab = None

    def _power(self, q: NDArray[np.float64], kappa: NDArray[np.float64]) -> NDArray[np.float64]:
        case = self._case
        return power_spectrum(case.height_field, q, kappa, extent=case.extent, coherence_length=case.coherence_length)

    def accuracy(self, spectrum: GratingSpectrum) -> Accuracy:
        """The errors of a spectrum of the same case."""
        l1 = peak = 0.0
        # What lies beyond the reach of the lobes is not drawn.
        tail = np.exp(-(spectrum.reach**2) / 2) if spectrum.extent == "tile" else 0.0
        random = np.random.default_rng(2)
        for kappa in self._kappas:
            shares = spectrum.powers(kappa)
            q = _drawn(spectrum, np.maximum(shares, 0), self._points, random)
            approximate = spectrum.evaluate(q, kappa)
            # q are drawn from S/∫S itself, as far as it is not negative anywhere.
            drawn = approximate > 0
            error = np.abs(approximate - self._power(q, kappa))[drawn] / approximate[drawn]
            l1 = max(l1, float(error.mean() * shares.sum(dtype=np.float64)) + spectrum.dropped + tail)
            peaks = _peaks(spectrum, shares)
            exact = self._power(peaks, kappa)
            strong = exact > 0.01 * exact.max()
            relative = np.abs(spectrum.evaluate(peaks, kappa)[strong] - exact[strong]) / exact[strong]
            peak = max(peak, float(relative.max()))
        return Accuracy(l1, peak, self._delta_e(self._factor * spectrum.evaluate(self._q, self._kappa)))

    def _delta_e(self, spectra: NDArray[np.float64]) -> tuple[float, float]:
        return delta_e(self.xyz(), self._xyz(spectra))

    def xyz(self) -> NDArray[np.float64]:
        """XYZ (12, 3) of the patches' S/λ² under the light; without K, G and R, which patches do not share."""
        return self._xyz(self._spectra)

    def _xyz(self, spectra: NDArray[np.float64]) -> NDArray[np.float64]:
        import colour

        from ..color import spectrum_to_XYZ

        light = colour.SDS_ILLUMINANTS[_LIGHT]
        return spectrum_to_XYZ(
            spectra * np.interp(self._wavelengths, light.wavelengths, light.values), self._wavelengths
        )


def delta_e(exact: NDArray[np.float64], approximate: NDArray[np.float64]) -> tuple[float, float]:
    """(mean, largest) CIEDE2000 of XYZ (n, 3), both exposed so that the brightest exact patch is a light grey."""
    from ..color import delta_E

    difference = delta_E(*(xyz * 0.5 / exact[:, 1].max() for xyz in (exact, approximate)))
    return float(difference.mean()), float(difference.max())


def patch_directions() -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """ω_i and ω_o of the patches, (12, 3) each."""
    wi, wo = np.zeros((2, 12, 3))
    for plane, patches in enumerate((slice(0, 6), slice(6, 12))):
        wi[patches, plane], wo[patches, plane] = np.sin(_INCIDENCE), np.sin(_EXITS)
        wi[patches, 2], wo[patches, 2] = np.cos(_INCIDENCE), np.cos(_EXITS)
    return wi, wo


def _patches(
    wavelengths: NDArray[np.float64],
) -> tuple[NDArray[np.float64], NDArray[np.float64], NDArray[np.float64]]:
    """q (12, n, 2), κ (12, n) and the factor 1/λ² (12, n) of light from one side, seen from twelve; λ (n,) in µm."""
    sines = -np.sin(_INCIDENCE) - np.sin(_EXITS)
    cosines = np.cos(_INCIDENCE) + np.cos(_EXITS)
    q = np.zeros((12, len(wavelengths), 2))
    q[:6, :, 0] = q[6:, :, 1] = sines[:, None] / wavelengths
    kappa = np.tile(2 * np.pi * cosines[:, None] / wavelengths, (2, 1))
    return q, kappa, np.broadcast_to(wavelengths**-2, kappa.shape)


def _drawn(
    spectrum: GratingSpectrum, shares: NDArray[np.float32], count: int, random: np.random.Generator
) -> NDArray[np.float64]:
    """`count` frequencies q with the density S: a node, and a place in its lobe or spline."""
    q_x, q_y = spectrum.grid.frequencies()
    total = np.cumsum(shares.ravel(), dtype=np.float64)
    # Evenly spread numbers in random order: less noise than independent ones.
    places = (np.arange(count) + random.random(count)) / count * total[-1]
    row, column = np.unravel_index(np.minimum(np.searchsorted(total, places), total.size - 1), shares.shape)
    if spectrum.extent == "tile":
        # The lobes end at their reach.
        inside = -np.expm1(-(spectrum.reach**2) / 2)
        radius = spectrum.lobe_width * np.sqrt(-2 * np.log1p(-inside * random.random(count)))
        angle = 2 * np.pi * random.random(count)
        offset = radius[:, None] * np.stack([np.cos(angle), np.sin(angle)], axis=-1)
    else:
        # A quadratic B-spline is the density of the sum of three uniform numbers.
        offset = random.uniform(-0.5, 0.5, (3, count, 2)).sum(axis=0) * spectrum.grid.spacing
    return np.stack([q_x[column], q_y[row]], axis=-1) + offset


def _peaks(spectrum: GratingSpectrum, shares: NDArray[np.float32], count: int = 200) -> NDArray[np.float64]:
    """The frequencies of the strongest nodes, (n, 2)."""
    q_x, q_y = spectrum.grid.frequencies()
    order = np.argsort(shares.ravel())[::-1][:count]
    row, column = np.unravel_index(order, shares.shape)
    return np.stack([q_x[column], q_y[row]], axis=-1)
