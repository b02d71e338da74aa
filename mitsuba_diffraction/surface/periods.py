"""Periods, directions and bands of a height field, and their uncertainties, from its power spectrum.

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
from functools import cached_property

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage
from scipy.optimize import minimize
from scipy.special import chdtri

from ..errors import RequestError
from ..settings import Settings
from .heightfield import HeightField, harmonic_fill

Array = NDArray[np.float64]

_CORRELATED = 35 / 18
# Variance of the power of a single wave under a Hann window, bins²: its three bins hold 1/6, 2/3 and 1/6.
_BAND_LOBE = 1 / 3
_BAND_FALSE_ALARM = 1e-4  # probability that a bin of a band is mistaken for a single period
_NARROW = 1.25  # bins; a narrower peak is a single period that drifts
# Range of the fit: frequencies up to this factor from the peak, and radians from its direction.
_FREQUENCY_RATIO, _SECTOR = 1.6, np.pi / 4
_CENTRE_RATIO = 1.3  # factor by which the centre may differ from the peak; the width is at most a quarter of it

_FEWEST_PERIODS = 2.0  # fewest periods across a patch that determine their length
_LEAST_ANGLE = 15.0  # least angle between two waves, degrees; closer ones are one drifting period, or its harmonics
# Wave vectors closer than this share of the shorter one are one period that varies, and turns, over the patch.
_SAME = 0.5
_FALSE_ALARM = 1e-4  # probability of a false detection in noise
_DRIFT_FALSE_ALARM = 0.1  # probability that noise is mistaken for a drift of a period over the patch
_RING = 24  # fewest frequencies from which the lower quartile, i.e. the background, is estimated.
# Least fraction of the variance of a wave or a band, to exclude hum of the instrument and uneven background.
_LEAST_STRENGTH = 1e-2
_ROUNDING = 1e-20  # relative to the largest power: far below a wave of `_LEAST_STRENGTH`, far above rounding errors
_MOST_MAXIMA = 200  # local maxima considered
_LOBE = 3  # half width of a peak in bins: two owing to the window, more if the period drifts
_MOST_TIMES = 8  # that a tile is repeated along each axis
_MOST_PIXELS = 2**22


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
        """Return whether a wave vector, or its opposite, lies within three widths of the centre."""
        offset = np.array([np.hypot(*q) - self.centre[0], _axis_difference(np.arctan2(q[1], q[0]), self.centre[1])])
        return bool((np.abs(offset) <= 3 * self.width).all())


def _axis_difference(phi: Array, phi_0: float) -> Array:
    """Return φ − φ₀ of axes, in [−π/2, π/2)."""
    return (phi - phi_0 + np.pi / 2) % np.pi - np.pi / 2


@dataclass(frozen=True)
class Period:
    """A period of a height field, or the centre of a band of periods, with standard uncertainties.

    Attributes:
        period: µm, perpendicular to the lines.
        direction: degrees of the wave vector from +x towards +y, in (−90, 90].
        period_uncertainty: µm.
        direction_uncertainty: degrees.
        strength: fraction of the variance of the levelled heights in this wave, without harmonics, or in the whole
            band.
        width: standard deviation of the periods of a band about its centre, µm; 0 for a single period.
        direction_width: the same for their directions, degrees.
    """

    period: float
    direction: float
    period_uncertainty: float
    direction_uncertainty: float
    strength: float
    width: float = 0.0
    direction_width: float = 0.0

    @property
    def q(self) -> Array:
        """The wave vector, (2,), cycles/µm."""
        return _unit(np.deg2rad(self.direction)) / self.period

    @classmethod
    def of(cls, q: Array, spread: Array, strength: float) -> Period:
        """Make a period from a frequency (2,) in cycles/µm and its covariance (2, 2)."""
        length = float(np.hypot(*q))
        along, across = q / length, np.array([-q[1], q[0]]) / length
        return cls(
            period=1 / length,
            direction=_as_direction(np.arctan2(q[1], q[0])),
            period_uncertainty=float(np.sqrt(along @ spread @ along)) / length**2,
            direction_uncertainty=float(np.degrees(np.sqrt(across @ spread @ across) / length)),
            strength=strength,
        )


def find_periods(height_field: HeightField, count: int = 2, *, extent: str = "sample") -> tuple[Period, ...]:
    """Find the strongest periods of a height field.

    A wave is detected where the power of the levelled and windowed (Hann) heights exceeds the background by a factor
    that noise on an exactly known background would exceed in one of ten thousand height fields (with the background
    estimated as here, white noise did in one of 300). The background is the largest of three lower quartiles: over
    frequencies of similar magnitude, and along the row and the column of the frequency, because of the streaks of a
    scan. If a wave of two or three times the period is also significant, or stronger, it is the period, and the first
    wave its harmonic.

    The waves are then fitted jointly, together with a quadratic surface p: by weighted least squares for their complex
    amplitudes c, and by Gauss–Newton steps for their frequencies q,

        h(x) ≈ p(x) + Re Σ_k c_k e^{2πi q_k·x},    weights: the window

    With n(q) the power density of the residual around q and X the derivatives of the model, the covariance of the
    estimate is (XᴴWX)⁻¹ XᴴW²X (XᴴWX)⁻¹ n; for one wave in white noise without a window this is the Cramér–Rao bound
    (Rife and Boorstyn 1974, "Single-tone parameter estimation from discrete-time observations", IEEE Transactions
    on Information Theory 20(5), 591–598, equation 22), var q = 6 n/(π² |c|² T²) along a side of length T.

    If a period drifts over the patch, like the fingers of a skin, another part of the surface has another one. The
    uncertainty therefore includes the excess, where significant, of the scatter of fits to the halves of a line, or to
    the quarters of a patch, over that owing to the background (eight times that covariance for a half, sixteen times
    for a quarter). The parts of a patch that holds fewer than four periods overlap, so that each holds two.

    A peak broader than a bin of the spectrum is a band of periods: its centre, width and strength are fitted to all
    bins, and the scatter of the centre over the quarters is added in the same way. A wave and a band of the same pitch
    are one thing: the wave if it has twice the strength of the band, else the band.

    A tile is repeated until it holds several of its periods, which are orders of its lattice, and exact.

    Args:
        height_field: need not be levelled; missing pixels are filled first.
        count: largest number of periods.
        extent: "tile": the patch repeats for ever; "sample": it is a piece of a larger surface.

    Returns:
        Single periods, strongest first, then bands, strongest first, with directions at least 15° apart. Empty if none
        is significant (noise, a flat surface).

    Raises:
        ValueError: if count is not a positive integer, or the extent is unknown.
    """
    if isinstance(count, bool) or not isinstance(count, int | np.integer) or count < 1:
        raise RequestError(f"count: got {count!r}, wanted a positive integer")
    Settings(extent)
    if extent == "tile":
        return _periods_of_tile(height_field, count)
    heights = harmonic_fill(height_field.heights, height_field.pixel_size)
    spectrum = _Spectrum(heights, height_field.pixel_size)
    if not spectrum.scale > 1e-13 * np.abs(heights).max():  # flat up to rounding
        return ()
    waves, bands = spectrum.peaks(int(count))
    fitted = [*spectrum.fit(waves), *(spectrum.band(band) for band in bands if band.share >= _LEAST_STRENGTH)]
    found: list[Period] = []
    for period in sorted(fitted, key=lambda period: -period.strength * (2 if period.width else 1)):
        if not any(_same_wave(period.q, other.q) for other in found):
            found.append(period)
    return tuple(sorted(found, key=lambda period: (period.width > 0, -period.strength)))


def height_spectrum(height_field: HeightField, extent: str) -> tuple[Array, Array, float]:
    """Compute the power spectrum of the heights: of a tile as it is, of a sample levelled and under a Hann window.

    Returns:
        |q| in cycles/µm and the power |FFT|², both (N_y, N_x), and the r.m.s. height, µm. The power is zero where
        heights differ by rounding errors only.
    """
    if extent == "tile":
        heights = height_field.centred - height_field.centred.mean()
        q = [np.fft.fftfreq(n, p) for n, p in zip(heights.shape[::-1], height_field.pixel_size, strict=True)]
        power, scale = np.abs(np.fft.fft2(heights)) ** 2, float(heights.std())
        power[0, 0] = 0
    else:
        spectrum = _Spectrum(height_field.heights, height_field.pixel_size)
        q, power, scale = spectrum._q, spectrum._power, spectrum.scale
    if not scale > 1e-13 * np.abs(height_field.heights).max():
        power, scale = np.zeros_like(power), 0.0
    return np.hypot(*np.meshgrid(*q)), power, scale


class _Spectrum:
    """The power spectrum of heights levelled to second order, under a Hann window."""

    def __init__(self, heights: Array, pixel_size: tuple[float, float]) -> None:
        rows, columns = heights.shape
        self._pixel_size = pixel_size
        self._size = np.array([columns * pixel_size[0], rows * pixel_size[1]])
        self._x = (np.arange(columns) - (columns - 1) / 2) * pixel_size[0]
        self._y = (np.arange(rows) - (rows - 1) / 2) * pixel_size[1]
        self._heights = heights - heights.mean()
        flat = (np.ones(columns), np.ones(rows))
        surface = _LeastSquares(_polynomials(self._x, self._y, 2), flat)
        self._levelled = self._heights - surface.evaluate(surface.solve(self._heights))
        self.scale = float(self._levelled.std())
        weight = hann(heights.shape)
        self._weight = float(np.sum(weight**2))
        self._power = np.abs(np.fft.fft2(weight * self._levelled)) ** 2
        self._q = (np.fft.fftfreq(columns, pixel_size[0]), np.fft.fftfreq(rows, pixel_size[1]))

    def peaks(self, count: int) -> tuple[list[Array], list[Band]]:
        """Return the frequencies (cycles/µm) of the strongest significant peaks, and bands; none collinear."""
        waves: list[Array] = []
        bands: list[Band] = []

        def known(q: Array) -> bool:
            others = [*waves, *(band.centre[0] * _unit(band.centre[1]) for band in bands)]
            return any(_same_wave(q, other) for other in others) or any(band.holds(q) for band in bands)

        for row, column in self._candidates:
            q = self._frequency(row, column)
            if known(q):
                continue
            band = None if self._isolated(q) else self._fit_band(q)
            if band is not None and not band.sharp:
                bands.append(band)
            elif not known(q := self._fundamental(q)):
                waves.append(q)
            if len(waves) + sum(band.share >= _LEAST_STRENGTH for band in bands) == count:
                break
        return waves, bands

    def _isolated(self, q: Array) -> bool:
        """Return whether the lobe of a peak holds nearly all power within half an octave and 45°."""
        q_x, q_y = np.meshgrid(*self._q)
        octaves = np.abs(np.log2(np.maximum(np.hypot(q_x, q_y), 1e-300) / np.hypot(*q)))
        along, across = q_x * q[0] + q_y * q[1], q_y * q[0] - q_x * q[1]
        lobe = np.hypot((q_x - q[0]) * self._size[0], (q_y - q[1]) * self._size[1]) <= 2
        about = (octaves < 0.5) & (np.abs(across) < along) | lobe
        return bool(self._power[lobe].sum() > 0.8 * self._power[about].sum())

    def _frequency(self, row: int, column: int) -> Array:
        return np.array([self._q[0][column], self._q[1][row]])

    @cached_property
    def _usable(self) -> NDArray[np.bool_]:
        """Mask: one of q and −q, if the patch holds enough periods."""
        q_x, q_y = np.meshgrid(*self._q)
        waves = np.hypot(q_x * self._size[0], q_y * self._size[1])
        return ((q_x > 0) | ((q_x == 0) & (q_y > 0))) & (waves >= _FEWEST_PERIODS - 1e-9)

    @cached_property
    def _maxima(self) -> list[tuple[int, int]]:
        """Rows and columns of the local maxima of the power, strongest first."""
        maximum = self._usable & (self._power == ndimage.maximum_filter(self._power, 3, mode="wrap"))
        places = np.argwhere(maximum)[np.argsort(-self._power[maximum], kind="stable")][:_MOST_MAXIMA]
        return [(int(row), int(column)) for row, column in places]

    @cached_property
    def _candidates(self) -> list[tuple[int, int]]:
        """The local maxima significantly above the background."""
        power, usable = self._power, self._usable
        if not usable.any():
            return []
        # The power of noise is exponentially distributed; its mean is the lower quartile divided by ln 4/3.
        level = np.log(usable.sum() / _FALSE_ALARM) / np.log(4 / 3)
        background = self._rings
        # Around a noise-free wave there are only rounding errors.
        least = _ROUNDING * power[usable].max()
        return [p for p in self._maxima if power[p] > max(least, level * max(background[p], self._streak(*p)))]

    @cached_property
    def _rings(self) -> Array:
        """The lower quartile of the power over frequencies of similar magnitude, by power laws between rings."""
        usable, length = self._usable, np.hypot(*np.meshgrid(*self._q))
        lengths, powers = length[usable], self._power[usable]
        order = np.argsort(lengths, kind="stable")
        rings = max(1, len(order) // _RING)
        # Rings at least one bin wide, with enough frequencies in each.
        label = np.floor(lengths * self._size.max()).astype(int)[order]
        label = np.minimum(label - label[0], np.arange(len(order)) * rings // len(order))
        label = np.searchsorted(np.unique(label), label)
        counts = np.bincount(label)
        middle = np.exp(np.bincount(label, np.log(lengths[order])) / counts)
        quartiles = np.maximum(_quartiles(powers[order], counts), 1e-300)
        background = np.full(self._power.shape, np.inf)
        background[usable] = _power_law(lengths, middle, quartiles)
        return background

    def _streak(self, row: int, column: int) -> float:
        """Return the larger of the lower quartiles along the row and the column of a frequency, excluding its lobe."""
        quartiles = [0.0]
        for line, place in ((self._power[row], column), (self._power[:, column], row)):
            half = min(12, (len(line) - 1) // 2)
            if half > _LOBE + 3:
                away = np.r_[-half:-_LOBE, _LOBE + 1 : half + 1]
                quartiles.append(float(np.quantile(line[(place + away) % len(line)], 0.25)))
        return max(quartiles)

    def _fundamental(self, q: Array) -> Array:
        """Return the longest wave with q as third or second harmonic, if significant or as strong as q; else q."""
        column, row = (np.rint(q * self._size).astype(int)).tolist()
        power = self._power[row, column]
        for order in (3, 2):
            for row, column in self._maxima:
                other = self._frequency(row, column)
                if self._power[row, column] < power and (row, column) not in self._candidates:
                    continue
                for signed in (other, -other):
                    # A harmonic is known to half a bin, its fundamental to less than one.
                    if (np.abs((signed - q / order) * self._size) <= 1).all():
                        return signed
        return q

    def fit(self, waves: list[Array]) -> list[Period]:
        """Fit the waves by least squares, starting from the frequencies of their bins."""
        whole = _Waves(self._heights, self._x, self._y, degree=2)
        while waves:
            q = whole.frequencies(np.array(waves))
            # If it moves further from its peak, it is not a wave: half a period also fits a single bump.
            near = (np.abs((q - waves) * self._size) <= 1).all(axis=1)
            if near.all():
                break
            waves = [wave for wave, kept in zip(waves, near, strict=True) if kept]
        if not waves:
            return []
        amplitude, unit, density, variance = whole.amplitudes(q)
        strength = np.abs(amplitude) ** 2 / 2 / variance
        columns, rows = np.rint(q * self._size).astype(int).T
        background = self._rings[rows, columns] / np.log(4 / 3) / self._weight
        covariance = [
            density[k] * unit[k] + self._drift(q[k], min(density[k], background[k]) * unit[k]) for k in range(len(q))
        ]
        found = [Period.of(*wave) for wave in zip(q, covariance, np.minimum(strength, 1.0).tolist(), strict=True)]
        return [period for period in found if period.strength >= _LEAST_STRENGTH]

    def _fit_band(self, peak: Array) -> Band:
        """Fit the band about a peak, (2,) cycles/µm."""
        q_x, q_y = np.meshgrid(*self._q)
        rho_0, phi_0 = np.hypot(*peak), np.arctan2(peak[1], peak[0])
        rho, phi = np.hypot(q_x, q_y), _axis_difference(np.arctan2(q_y, q_x), phi_0)
        # The background is infinite at one of q and −q, or at both where it is unknown.
        background = np.minimum(self._rings, np.roll(self._rings[::-1, ::-1], (1, 1), (0, 1)))
        about = (
            (np.abs(phi) < _SECTOR)
            & (rho > rho_0 / _FREQUENCY_RATIO)
            & (rho < rho_0 * _FREQUENCY_RATIO)
            & np.isfinite(background)
        )
        about &= q_x * peak[0] + q_y * peak[1] > 0  # one of q and −q
        values, rho, phi = self._power[about], rho[about], phi[about]
        background = np.maximum(background[about], 1e-9 * values.max())
        long = np.array(self._power.shape[::-1]) > 1
        bin_width = 1 / self._size[long].min()

        def model(theta: Array) -> tuple[Array, Array, Array]:
            """Return the Gaussian, P, and ∂ln P/∂θ, for θ = (ln A, ρ₀, ln σ_ρ, φ₀, ln σ_φ, ln b)."""
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
            (rho_0 / _CENTRE_RATIO, rho_0 * _CENTRE_RATIO),
            (np.log(bin_width / 3), np.log(max(rho_0 / 4, bin_width))),
            (-_SECTOR, _SECTOR),
            (np.log(bin_width / rho_0 / 3), np.log(max(_SECTOR, bin_width / rho_0))),
            (np.log(1e-3), np.log(1e3)),
        ]
        # A broad band, unless a bin stands out of it: its noise may well be fitted by a narrow peak on much background.
        found = []
        for width in (0.15, 0.03):
            start = [np.log(values.max() / 3), rho_0, np.log(width * rho_0), 0.0, np.log(width), 0.0]
            start = np.clip(start, *np.array(bounds).T)
            found.append(minimize(cost, start, jac=True, method="L-BFGS-B", bounds=bounds, options={"maxiter": 100}))
            if (values <= np.log(len(values) / _BAND_FALSE_ALARM) * model(found[0].x)[1]).all():
                break
        theta = min(found, key=lambda result: result.fun).x
        gaussian, _, slopes = model(theta)
        covariance = _CORRELATED ** long.sum() * np.linalg.pinv(slopes @ slopes.T, rcond=1e-10, hermitian=True)
        width = np.exp(theta[[2, 4]])
        width = np.sqrt(np.maximum(width**2 - _BAND_LOBE * bin_width**2 / np.array([1, theta[1] ** 2]), 0))
        return Band(
            centre=np.array([theta[1], phi_0 + theta[3]]),
            width=width,
            covariance=covariance[np.ix_([1, 3], [1, 3])],
            share=float(min(2 * gaussian.sum() / self._power.sum(), 1.0)),
            sharp=bool(width[0] <= max(_NARROW * bin_width, 2 * np.sqrt(covariance[1, 1]))),
        )

    def band(self, band: Band) -> Period:
        """Return the period of a band; its uncertainty includes the excess scatter of the quarters."""
        length, phi = band.centre
        parts = (_Spectrum(self._heights[part], self._pixel_size) for part in self._parts())
        quarters = [part._fit_band(length * _unit(phi)) for part in parts]
        centres = np.array([quarter.centre for quarter in quarters])
        noise = np.mean([quarter.covariance for quarter in quarters], axis=0)
        spread = band.covariance + _excess_covariance(centres, noise)
        return Period(
            period=float(1 / length),
            direction=_as_direction(phi),
            period_uncertainty=float(np.sqrt(spread[0, 0]) / length**2),
            direction_uncertainty=float(np.degrees(np.sqrt(spread[1, 1]))),
            strength=band.share,
            width=float(band.width[0] / length**2),
            direction_width=float(np.degrees(band.width[1])),
        )

    def _drift(self, q: Array, noise: Array) -> Array:
        """Return the covariance of the frequency over the halves or quarters of the patch, in excess of noise."""
        share = float(np.clip(_FEWEST_PERIODS / np.hypot(*(q * self._size)), 0.5, 1))
        parts = self._parts(share)
        waves = [_Waves(self._levelled[r, c], self._x[c], self._y[r], degree=0) for r, c in parts]
        of_part = noise / share ** (2 + np.log2(len(parts)))
        return _excess_covariance(np.array([part.frequencies(q[None], 1e-3)[0] for part in waves]), of_part)

    def _parts(self, share: float = 0.5) -> list[tuple[slice, slice]]:
        """Return both ends of a line, or the corners of a patch, of this share of its length and width."""
        rows, columns = (
            [slice(0, int(share * n)), slice(n - int(share * n), n)] if n >= 16 else [slice(0, n)]
            for n in self._heights.shape
        )
        return [(r, c) for r in rows for c in columns]


class _Waves:
    """The model p(x) + Re Σ_k c_k e^{2πi q_k·x} of heights under a Hann window."""

    def __init__(self, heights: Array, x: NDArray, y: NDArray, degree: int) -> None:
        self._heights = heights
        self._x, self._y = x - x.mean(), y - y.mean()
        self._size = np.array([_length(x), _length(y)])
        self._window = (_hann(len(x)), _hann(len(y)))
        self._polynomials = _polynomials(self._x, self._y, degree)

    def frequencies(self, q: Array, bins: float = 1e-7) -> Array:
        """Find the best q, (k, 2), from these starting points, until a step is less than `bins`."""
        for _ in range(20):
            amplitude, slope = self._amplitudes(self._model(q).solve(self._heights))
            # c e^{2πi(q + δ)·x} ≈ (c + 2πi c δ·x) e^{2πi q·x}; without a wave, c = 0, q is unchanged.
            step = np.real(slope * np.conj(2j * np.pi * amplitude[:, None]))
            step /= np.maximum(np.abs(2 * np.pi * amplitude[:, None]) ** 2, 1e-300)
            step = np.clip(step, -0.5 / self._size, 0.5 / self._size)
            q = q + step
            if (np.abs(step * self._size) < bins).all():
                break
        return q

    def amplitudes(self, q: Array) -> tuple[NDArray, Array, Array, float]:
        """Return c (k,), the covariance of each q in noise of density 1 (k, 2, 2), its density there, var (h − p)."""
        model = self._model(q)
        coefficients = model.solve(self._heights)
        amplitude, _ = self._amplitudes(coefficients)
        density = self._density(self._heights - model.evaluate(coefficients), q)
        covariance = model.covariance()
        spread = []
        for k, c in enumerate(amplitude):
            # δ = Re(slope/(2πi c)): a real linear function of the coefficients of xe and ye.
            place = len(self._polynomials) + 6 * k
            gradient = np.zeros((2, len(covariance)), complex)
            for axis in range(2):
                gradient[axis, place + 1 + axis] = 1 / (4j * np.pi * c)
                gradient[axis, place + 4 + axis] = np.conj(1 / (4j * np.pi * c))
            spread.append(np.real(gradient @ covariance @ gradient.conj().T))
        surface = np.where(np.arange(len(coefficients)) < len(self._polynomials), coefficients, 0)
        return amplitude, np.array(spread), density, float((self._heights - model.evaluate(surface)).var())

    def _model(self, q: Array) -> _LeastSquares:
        """Return the polynomials, and for each wave e, xe, ye with e = e^{2πi q·x}/2, and their conjugates."""
        basis = list(self._polynomials)
        for wave in q:
            x, y = np.exp(2j * np.pi * wave[0] * self._x), np.exp(2j * np.pi * wave[1] * self._y)
            waves = [(x / 2, y), (self._x * x / 2, y), (x / 2, self._y * y)]
            basis += waves + [(u.conj(), v.conj()) for u, v in waves]
        return _LeastSquares(basis, self._window)

    def _amplitudes(self, coefficients: NDArray) -> tuple[NDArray, NDArray]:
        """Return c, (k,), and the coefficients of xe and ye, (k, 2)."""
        table = coefficients[len(self._polynomials) :].reshape(-1, 6)
        return table[:, 0], table[:, 1:3]

    def _density(self, residual: Array, q: Array) -> Array:
        """Return the variance per pixel of white noise with the power density of the residual around each q, (k,)."""
        weight = hann(residual.shape)
        power = np.abs(np.fft.fft2(weight * residual)) ** 2 / np.sum(weight**2)
        rows, columns = residual.shape
        bins_x, bins_y = np.meshgrid(np.fft.fftfreq(columns) * columns, np.fft.fftfreq(rows) * rows)
        densities = []
        for wave in q * self._size:
            away = np.hypot(bins_x - wave[0], bins_y - wave[1])
            near = away <= _LOBE
            # The fit reduces the residual close to the wave: the larger of two means.
            densities.append(max(power[near].mean(), power[near & (away > 1)].mean()))
        return np.array(densities)


class _LeastSquares:
    """Weighted least squares with separable functions f(x) g(y) and weights u(x) v(y): all sums are separable."""

    def __init__(self, basis: list[tuple[NDArray, NDArray]], window: tuple[NDArray, NDArray]) -> None:
        self._along_x = np.array([f for f, _ in basis])
        self._along_y = np.array([g for _, g in basis])
        self._window = window
        self._inverse = np.linalg.pinv(self._gram(1), rcond=1e-13, hermitian=True)

    def _gram(self, power: int) -> NDArray:
        u, v = (w**power for w in self._window)
        return ((self._along_x.conj() * u) @ self._along_x.T) * ((self._along_y.conj() * v) @ self._along_y.T)

    def solve(self, heights: Array) -> NDArray:
        """Solve for the coefficients."""
        u, v = self._window
        sums = np.einsum("ky,ky->k", self._along_y.conj() * v, (self._along_x.conj() * u) @ heights.T)
        return self._inverse @ sums

    def evaluate(self, coefficients: NDArray) -> Array:
        """Evaluate the model, (N_y, N_x)."""
        return np.real((self._along_y.T * coefficients) @ self._along_x)

    def covariance(self) -> NDArray:
        """Return the covariance of the coefficients for white noise of variance one."""
        return self._inverse @ self._gram(2) @ self._inverse


def _periods_of_tile(tile: HeightField, count: int) -> tuple[Period, ...]:
    # Of one period of a profile, harmonics stand out before the period does.
    for times in (_MOST_TIMES,) if 1 in tile.shape else (1, 2, 4, _MOST_TIMES):
        if found := find_periods(repeated(tile, times), count):
            return tuple(_on_lattice(period, tile) for period in found)
    return ()


def _on_lattice(period: Period, tile: HeightField) -> Period:
    """Round a period of a repeating tile to one of its orders, whose period is known exactly."""
    order = np.rint(period.q * tile.tile_size)
    if period.width or not order.any():
        return period
    return Period.of(order / tile.tile_size, np.zeros((2, 2)), period.strength)


def repeated(tile: HeightField, times: int = _MOST_TIMES) -> HeightField:
    """Repeat a tile so many times along each axis, or fewer times where that would be many pixels."""
    while tile.heights.size * times**2 > _MOST_PIXELS and times > 1:
        times //= 2
    return HeightField(np.tile(tile.heights, (times, times)), tile.pixel_size, tile.source)


def _excess_covariance(found: Array, noise: Array) -> Array:
    """Return the covariance of estimates (n, 2) from parts of a patch in excess of that by noise, if significant."""
    free = len(found) - 1
    if free == 0:
        return np.zeros((2, 2))
    scatter, axes = np.linalg.eigh(np.cov(found.T))
    expected = np.einsum("ik,ij,jk->k", axes, noise, axes)
    excess = np.where(scatter * free > chdtri(free, _DRIFT_FALSE_ALARM) * expected, scatter - expected, 0)
    return axes @ np.diag(np.maximum(excess, 0)) @ axes.T


def _unit(phi: float) -> Array:
    return np.array([np.cos(phi), np.sin(phi)])


def _as_direction(phi: float) -> float:
    """Return degrees in (−90, 90]; −90 up to rounding becomes 90."""
    degrees = float(np.degrees(phi))
    return min(float(degrees - 180 * np.ceil((degrees - 90) / 180 - 1e-12)), 90.0)


def _polynomials(x: NDArray, y: NDArray, degree: int) -> list[tuple[NDArray, NDArray]]:
    """Return 1, x, y, x², xy, y² … as pairs of factors in x and y, as far as the points determine them."""
    x, y = (v / max(np.abs(v).max(), 1e-300) for v in (x, y))
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i) if i < len(x) and j < len(y)]
    return [(x**i, y**j) for i, j in powers]


def _length(places: Array) -> float:
    """Return the length of a row of pixels from their positions; arbitrary for one pixel, which has no frequency."""
    return float(len(places) * (places[1] - places[0])) if len(places) > 1 else 1.0


def _hann(count: int) -> Array:
    """Return a Hann window without its zeros; one for a single pixel."""
    return np.sin(np.pi * (np.arange(count) + 0.5) / count) ** 2


def hann(shape: tuple[int, int]) -> Array:
    """Return the Hann window of a patch, (N_y, N_x)."""
    return np.outer(*map(_hann, shape))


def _quartiles(values: Array, counts: NDArray[np.intp]) -> Array:
    """Return the lower quartile of consecutive runs of values of these lengths."""
    label = np.repeat(np.arange(len(counts)), counts)
    ordered = values[np.lexsort((values, label))]
    return ordered[np.cumsum(counts) - counts + (counts - 1) // 4]


def _power_law(x: NDArray, points: NDArray, values: NDArray) -> Array:
    """Interpolate linearly between logarithms, extrapolated before the first point."""
    x, points, values = np.log(x), np.log(points), np.log(values)
    if len(points) > 1:
        slope = min((values[1] - values[0]) / (points[1] - points[0]), 0.0)
        points = np.concatenate([[x.min() - 1], points])
        values = np.concatenate([[values[0] + slope * (points[0] - points[1])], values])
    return np.exp(np.interp(x, points, values))


def _same_wave(one: Array, other: Array) -> bool:
    """Return whether two wave vectors belong to one period or its harmonics, irrespective of their sign."""
    angle = np.degrees(np.arctan2(abs(one[0] * other[1] - one[1] * other[0]), abs(one @ other)))
    distance = np.hypot(*(one - np.copysign(1, one @ other) * other))
    return bool(angle < _LEAST_ANGLE or distance < _SAME * min(np.hypot(*one), np.hypot(*other)))
