"""Bands of periods: broad peaks of the power spectrum, such as that of fingers without long-range order.

The expected power at the wave vector q = ρ (cos φ, sin φ) is modelled as a Gaussian above the background B:

    P(q) = A exp(−(ρ − ρ₀)²/2σ_ρ² − (φ − φ₀)²/2σ_φ²) + b B(q)

The power I of a single bin is exponentially distributed with mean P, so that the strongest bin of a band is a poor
estimate of its centre. All six parameters are therefore fitted to the bins around the peak by maximum likelihood,
minimising Σ ln P + I/P (Whittle 1953, "Estimation and information in stationary time series", Arkiv för Matematik 2,
423–434). The covariance is the inverse of the Fisher information Σ ∂ln P/∂θ_i ∂ln P/∂θ_j, times 35/18 for each axis, as
the powers of neighbouring bins under a Hann window are correlated by 4/9 and 1/36.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.optimize import minimize

Array = NDArray[np.float64]

_CORRELATED = 35 / 18
_LOBE = 1 / 3
"""Variance of the power of a single wave under a Hann window, bins²: its three bins hold 1/6, 2/3 and 1/6."""

_FALSE_ALARM = 1e-4
"""Probability that a bin of a band is mistaken for a single period."""

_NARROW = 1.25
"""Bins; a narrower peak is a single period that drifts."""

_REACH, _SECTOR = 1.6, np.pi / 4
"""Range of the fit: frequencies up to this factor from the peak, and radians from its direction."""

_SHIFT = 1.3
"""Factor by which the centre may differ from the peak; the width is at most a quarter of it."""


@dataclass(frozen=True)
class Band:
    """A broad peak.

    Attributes:
        centre: (ρ₀, φ₀), cycles/µm and radians.
        width: (σ_ρ, σ_φ), corrected for the window.
        covariance: of the centre, (2, 2).
        share: of the power of the spectrum.
        sharp: whether it is as narrow as a single period, or its centre is uncertain by more than half of its width.
    """

    centre: Array
    width: Array
    covariance: Array
    share: float
    sharp: bool

    def holds(self, q: Array) -> bool:
        """Whether a wave vector, or its opposite, lies within three widths of the centre."""
        apart = np.array([np.hypot(*q) - self.centre[0], _turned(np.arctan2(q[1], q[0]), self.centre[1])])
        return bool((np.abs(apart) <= 3 * self.width).all())


def fit_band(power: Array, background: Array, q: tuple[Array, Array], size: Array, peak: Array) -> Band:
    """The band about a peak.

    Args:
        power: |FFT|² of the heights under a Hann window, (N_y, N_x).
        background: B, (N_y, N_x); infinite at one or both of q and −q where it is unknown.
        q: frequencies along x, (N_x,), and along y, (N_y,), cycles/µm.
        size: of the patch along x and y, µm.
        peak: (2,) starting point, cycles/µm.
    """
    q_x, q_y = np.meshgrid(*q)
    rho_0, phi_0 = np.hypot(*peak), np.arctan2(peak[1], peak[0])
    rho, phi = np.hypot(q_x, q_y), np.arctan2(q_y, q_x)
    background = np.minimum(background, np.roll(background[::-1, ::-1], (1, 1), (0, 1)))
    phi = _turned(phi, phi_0)
    about = (np.abs(phi) < _SECTOR) & (rho > rho_0 / _REACH) & (rho < rho_0 * _REACH) & np.isfinite(background)
    about &= q_x * peak[0] + q_y * peak[1] > 0  # one of q and −q
    values, rho, phi = power[about], rho[about], phi[about]
    background = np.maximum(background[about], 1e-9 * values.max())
    long = np.array(power.shape[::-1]) > 1
    bin_width = 1 / size[long].min()

    def model(theta: Array) -> tuple[Array, Array, Array]:
        """The Gaussian, P, and ∂ln P/∂θ, for θ = (ln A, ρ₀, ln σ_ρ, φ₀, ln σ_φ, ln b)."""
        sigma_rho, sigma_phi = np.exp(theta[[2, 4]])
        s, t = (rho - theta[1]) / sigma_rho, (phi - theta[3]) / sigma_phi
        gaussian = np.exp(theta[0] - (s**2 + t**2) / 2)
        total = gaussian + np.exp(theta[5]) * background
        slopes = np.array([np.ones_like(s), s / sigma_rho, s**2, t / sigma_phi, t**2]) * gaussian / total
        return gaussian, total, np.vstack([slopes, 1 - gaussian / total])

    def cost(theta: Array) -> tuple[float, Array]:
        _, total, slopes = model(theta)
        return float(np.sum(np.log(total) + values / total)), slopes @ (1 - values / total)

    bounds = [
        (np.log(1e-6 * values.max()), np.log(10 * values.max())),
        (rho_0 / _SHIFT, rho_0 * _SHIFT),
        (np.log(bin_width / 3), np.log(max(rho_0 / 4, bin_width))),
        (-_SECTOR, _SECTOR),
        (np.log(bin_width / rho_0 / 3), np.log(max(_SECTOR, bin_width / rho_0))),
        (np.log(1e-3), np.log(1e3)),
    ]
    # A broad band, unless a bin stands out of it: its noise may well be fitted by a narrow peak on a high background.
    found = []
    for width in (0.15, 0.03):
        start = [np.log(values.max() / 3), rho_0, np.log(width * rho_0), 0.0, np.log(width), 0.0]
        start = np.clip(start, *np.array(bounds).T)
        found.append(minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 100}))
        if (values <= np.log(len(values) / _FALSE_ALARM) * model(found[0].x)[1]).all():
            break
    theta = min(found, key=lambda result: result.fun).x
    gaussian, _, slopes = model(theta)
    covariance = _CORRELATED ** long.sum() * np.linalg.pinv(slopes @ slopes.T, rcond=1e-10, hermitian=True)
    width = np.exp(theta[[2, 4]])
    width = np.sqrt(np.maximum(width**2 - _LOBE * bin_width**2 / np.array([1, theta[1] ** 2]), 0))
    return Band(
        centre=np.array([theta[1], phi_0 + theta[3]]),
        width=width,
        covariance=covariance[np.ix_([1, 3], [1, 3])],
        share=float(min(2 * gaussian.sum() / power.sum(), 1.0)),
        sharp=bool(width[0] <= max(_NARROW * bin_width, 2 * np.sqrt(covariance[1, 1]))),
    )


def _turned(phi: Array, phi_0: float) -> Array:
    """φ − φ₀ of axes, in [−π/2, π/2)."""
    return (phi - phi_0 + np.pi / 2) % np.pi - np.pi / 2
