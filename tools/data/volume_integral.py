"""Rigorous efficiencies of a dielectric relief in two dimensions, by a volume integral equation.

Coupled-wave analysis in two dimensions solves eigenproblems of twice as many unknowns as there are harmonics in each
layer, a time proportional to the sixth power of the period. Here the unknown is the field in the relief,

    E = E₀ + ∫ G (ε − 1) E dz,

E₀ and G being the field and the Green's tensor of the flat substrate alone. Both products are diagonal, G for each
lateral frequency and ε at each point, so that one iteration of GMRES takes a few FFTs (the generalized source method:
Shcherbakov and Tishchenko, J. Quant. Spectrosc. Radiat. Transf. 113, 158, 2012). In voxels that the surface cuts, ε is
a tensor: the mean of ε for fields along the surface, the harmonic mean for fields across it (Farjadpour et al., Opt.
Lett. 31, 2972, 2006), which leaves an error of second order.

Lengths are in µm; e^{i(k·r − ωt)}; z upwards, air above the relief, the substrate below z = 0, its lowest point.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.sparse.linalg import LinearOperator, gmres

Array = NDArray[np.float64]
Complex = NDArray[np.complexfloating]

_SUBPIXELS = 4  # along each edge of a voxel, over which ε is averaged
_RESTART, _MAX_RESTARTS = 20, 50  # of GMRES; without restarts it takes fewer iterations and twice the time
_LOSS = 1e-9  # of k₀², so that no frequency is exactly at the horizon


@dataclass(frozen=True)
class Orders:
    """Efficiencies of the orders that propagate.

    Attributes:
        reflected, transmitted: (m_x, m_y), (n, 2), each; k_o,∥ = −k_i,∥ − m λ/T as everywhere in this package.
            Reflected are those on the side of the light.
        eta, eta_transmitted: fraction of the incident power in each, (2, n): s- and p-polarised incident light, or
            those that were solved.
        iterations: of GMRES, the largest number of the polarisations.
    """

    reflected: NDArray[np.int64]
    eta: Array
    transmitted: NDArray[np.int64]
    eta_transmitted: Array
    iterations: int

    @property
    def lost(self) -> float:
        """|1 − R − T|, the largest of the polarisations."""
        return float(np.abs(1 - self.eta.sum(axis=1) - self.eta_transmitted.sum(axis=1)).max())


def resampled(heights: Array, count: tuple[int, int]) -> Array:
    """Return the trigonometric interpolation of one period at the middles of (rows, columns) pixels.

    The heights are at the middles of their pixels, too.
    """
    spectrum = scipy.fft.fft2(heights, norm="forward")
    for axis, (have, want) in enumerate(zip(heights.shape, count, strict=True)):
        m = scipy.fft.fftfreq(have, 1 / have)
        kept = 2 * np.abs(m) < min(have, want) if have > 1 else m == 0
        shift = np.exp(1j * np.pi * m * (1 / want - 1 / have)) * kept
        target = np.zeros([want if n == axis else size for n, size in enumerate(spectrum.shape)], complex)
        moved = np.moveaxis(target, axis, 0)
        moved[m[kept].astype(int)] = np.moveaxis(spectrum, axis, 0)[kept] * shift[kept].reshape(
            -1, *(1,) * (heights.ndim - 1)
        )
        spectrum = target
    return scipy.fft.ifft2(spectrum, norm="forward").real


def repeated(heights: Array, count: tuple[int, int]) -> Array:
    """Return each pixel several times, (rows, columns) in all, which are multiples of those given."""
    return np.kron(heights, np.ones([want // have for have, want in zip(heights.shape, count, strict=True)]))


def susceptibility(heights: Array, period: tuple[float, float], index: float, layers: int) -> tuple[Array, float]:
    """Return ε − 1, (6, layers, rows, columns), as xx, yy, zz, xy, xz, yz, and the thickness of a layer.

    Args:
        heights: (rows · s, columns · s) µm, s = `_SUBPIXELS`, at the middles of subpixels; s = 1 along an axis of one.
        period: along x and y, µm.
        index: n of the relief.
        layers: from the lowest to the highest point.
    """
    rows, columns = (max(1, size // _SUBPIXELS) for size in heights.shape)
    blocks = heights.reshape(rows, -1, columns, heights.shape[1] // columns)
    z = heights.min()
    thickness = (heights.max() - z) / layers
    fill = np.stack([np.clip((blocks - z) / thickness - layer, 0, 1).mean(axis=(1, 3)) for layer in range(layers)])
    pitch = np.divide(period, heights.shape[::-1])
    slope_y, slope_x = (
        (np.roll(heights, -1, axis) - np.roll(heights, 1, axis)).reshape(blocks.shape).mean(axis=(1, 3))
        / (2 * pitch[1 - axis])
        for axis in (0, 1)
    )
    n = np.stack([-slope_x, -slope_y, np.ones_like(slope_x)]) / np.sqrt(1 + slope_x**2 + slope_y**2)
    epsilon = index**2
    along, across = 1 + fill * (epsilon - 1), 1 / (1 + fill * (1 / epsilon - 1))
    pairs = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    return np.stack([(a == b) * (along - 1) + (across - along) * n[a] * n[b] for a, b in pairs]), float(thickness)


def solve(
    heights: Array,
    period: tuple[float, float],
    light: Array,
    wavelength: float,
    index: float,
    points: tuple[int, int],
    layers: int,
    tolerance: float = 1e-4,
    dtype: type = np.complex64,
    stepped: bool = False,
    polarisations: tuple[int, ...] = (0, 1),
) -> Orders:
    """Solve Maxwell's equations for one period of a relief.

    Args:
        heights: (rows, columns) µm, rows ↔ +y, at the middles of pixels.
        period: along x and y, µm.
        light: ω_i, (3,), towards the light, in air, or in the substrate if ω_i,z < 0.
        wavelength: in air, µm.
        index: n of the relief and the substrate.
        points: (rows, columns) of voxels in one period; 1 row for a profile along x.
        layers: of voxels.
        tolerance: of the residual of GMRES, relative to E₀.
        dtype: of the fields.
        stepped: whether pixels are flat, with vertical walls on the faces of voxels; otherwise the heights are
            interpolated.
        polarisations: of the incident light, 0 is s.
    """
    fine = tuple(1 if n == 1 else n * _SUBPIXELS for n in points)
    chi, thickness = susceptibility((repeated if stepped else resampled)(heights, fine), period, index, layers)
    chi = chi.astype(np.float32 if dtype is np.complex64 else np.float64)
    return _Period(chi, thickness, period, light, wavelength, index, tolerance, dtype).orders(polarisations)


def extrapolated(
    heights: Array,
    period: tuple[float, float],
    light: Array,
    wavelength: float,
    index: float,
    points: tuple[int, int],
    layers: int,
    **options: Any,
) -> Orders:
    """Solve with `points` and `layers`, and with one and a half times as many, and extrapolate to infinitely many.

    The error is proportional to the square of the size of the voxels (Richardson). For arguments and options see
    `solve`; numbers of points other than one, and of layers, are even.
    """
    finer = tuple(n if n == 1 else n * 3 // 2 for n in points)
    coarse = solve(heights, period, light, wavelength, index, points, layers, **options)
    fine = solve(heights, period, light, wavelength, index, finer, layers * 3 // 2, **options)
    values = []
    for name in ("reflected", "transmitted"):
        eta = "eta" if name == "reflected" else "eta_transmitted"
        of_coarse = {tuple(m): n for n, m in enumerate(getattr(coarse, name).tolist())}
        order = [of_coarse[tuple(m)] for m in getattr(fine, name).tolist()]
        old, new = getattr(coarse, eta)[:, order], getattr(fine, eta)
        values.append(new + (new - old) / (1.5**2 - 1))
    return Orders(fine.reflected, values[0], fine.transmitted, values[1], fine.iterations)


class _Period:
    """The integral equation of one period at one wavelength and direction."""

    def __init__(
        self,
        chi: Array,
        thickness: float,
        period: tuple[float, float],
        light: Array,
        wavelength: float,
        index: float,
        tolerance: float,
        dtype: type,
    ) -> None:
        self._chi, self._tolerance, self._dtype = chi, tolerance, dtype
        self._layers, rows, columns = chi.shape[1:]
        k0 = 2 * np.pi / wavelength
        self._m = np.stack(np.meshgrid(*(scipy.fft.fftfreq(n, 1 / n) for n in (columns, rows))), axis=-1)
        self._from_below = light[2] < 0
        tangent = -np.asarray(light[:2]) * (index if self._from_below else 1)
        k = k0 * (tangent + self._m * wavelength / np.asarray(period))
        square, epsilon = (k**2).sum(axis=-1), index**2
        self._gamma, self._below = (np.sqrt(k0**2 * (e + 1j * _LOSS) - square + 0j) for e in (1.0, epsilon))
        norm = np.sqrt(square)
        normal = norm < 1e-9 * k0  # s is along y
        safe = np.where(normal, 1, norm)
        self._e_x, self._e_y = np.where(normal, 1, k[..., 0] / safe), np.where(normal, 0, k[..., 1] / safe)
        self._k0, self._norm = k0, norm
        g, b = self._gamma, self._below
        # Of s and p, from above into the substrate; of p for E in air and √ε E below.
        s, p = 1 / (g + b), 1 / (epsilon * g + b)
        self._r, self._t = ((g - b) * s, (epsilon * g - b) * p), (2 * g * s, 2 * index * g * p)
        self._through = np.exp(1j * g * thickness * self._layers)
        a = 1j * g * thickness
        self._step = np.exp(a)
        factor = 1j * k0**2 / (2 * g) * thickness
        # Means over the layers of the source and of the field.
        self._far = factor * ((1 - self._step) / a) ** 2
        self._near = factor * 2 * (self._step - 1 - a) / a**2
        self._half = (self._step - 1) / a  # mean of e^{iγz} over a layer, from its lower face
        self._source = 1j * k0**2 / (2 * g) * thickness * self._half
        for name in ("_far", "_near", "_half", "_step", "_source"):
            setattr(self, name, getattr(self, name).astype(dtype))

    def _vectors(self, upwards: bool) -> tuple[tuple, tuple]:
        """Return the polarisation vectors s and p, each as (x, y, z), of waves that go up or down."""
        sign = -1 if upwards else 1
        g = sign * self._gamma / self._k0
        return (-self._e_y, self._e_x, 0 * self._e_x), (g * self._e_x, g * self._e_y, self._norm / self._k0 + 0 * g)

    def _scattered(self, polarisation: Complex) -> tuple[Complex, list[Complex], list[Complex]]:
        """Return the field of P = (ε − 1) E, both as Fourier coefficients (3, layers, rows, columns).

        Also the amplitudes of s and p of the waves down at z = 0 and up at the top of the relief.
        """
        field = np.zeros_like(polarisation)
        field[2] = -polarisation[2]
        at_0, at_top = [], []
        up_vectors, down_vectors = (
            [[part.astype(self._dtype) for part in vector] for vector in self._vectors(upwards)]
            for upwards in (True, False)
        )
        for up, down, r in zip(up_vectors, down_vectors, self._r, strict=True):
            rising, falling = _dot(up, polarisation), _dot(down, polarisation)
            free_0, free_top = np.zeros_like(self._step), np.zeros_like(self._step)
            for layer in range(self._layers):
                free_top = free_top * self._step + self._source * rising[layer]
                free_0 = free_0 * self._step + self._source * falling[-1 - layer]
            up_0 = r * free_0
            for vector, sources, wave, order in ((up, rising, up_0, 1), (down, falling, 0 * up_0, -1)):
                # Within its own layer, a source contributes half of the symmetric kernel to either direction.
                amplitude, running = 0.5 * self._near * sources, np.zeros_like(self._step)
                wave = wave.astype(self._dtype)
                for layer in range(self._layers)[::order]:
                    amplitude[layer] += running + wave * self._half
                    running = running * self._step + self._far * sources[layer]
                    wave = wave * self._step
                for part, direction in zip(field, vector, strict=True):
                    part += direction * amplitude
            at_0.append(free_0)
            at_top.append(free_top + self._through * up_0)
        return field, at_0, at_top

    def _polarised(self, field: Complex) -> Complex:
        """Return P = (ε − 1) E at the voxels."""
        xx, yy, zz, xy, xz, yz = self._chi
        x, y, z = field
        return np.stack([xx * x + xy * y + xz * z, xy * x + yy * y + yz * z, xz * x + yz * y + zz * z])

    def orders(self, polarisations: tuple[int, ...]) -> Orders:
        """Solve for each polarisation."""
        found = [self._solved(polarisation) for polarisation in polarisations]
        incident = (self._below if self._from_below else self._gamma)[0, 0].real

        def kept(gamma: Complex) -> NDArray[np.bool_]:
            return (gamma.real > 1e-3 * self._k0) & (np.abs(gamma.imag) < 1e-3 * self._k0)

        sides = []
        for side, gamma in enumerate((self._gamma, self._below)):
            propagates = kept(gamma)
            power = [sum(np.abs(a[propagates]) ** 2 for a in of_both[side]) for of_both in found]
            m = -np.rint(self._m[propagates]).astype(int)
            sides.append((m, np.array(power) * gamma.real[propagates] / incident))
        (reflected, eta), (transmitted, eta_t) = sides[::-1] if self._from_below else sides
        return Orders(reflected, eta, transmitted, eta_t, max(count for *_, count in found))

    def _solved(self, polarisation: int) -> tuple[list[Complex], list[Complex], int]:
        """Return the amplitudes of s and p, above and below, for one polarisation of incident light."""
        shape = 3, *self._chi.shape[1:]
        size = int(np.prod(shape))
        through, r = self._through[0, 0], self._r[polarisation][0, 0]
        # E₀: amplitudes of the wave up at z = 0 and of that down at the top of the relief.
        up_0, down_top = r * through, 1.0
        if self._from_below:
            up_0, down_top = (self._t[polarisation] * self._below / self._gamma)[0, 0], 0.0
        incident, layers = np.zeros(shape, complex), np.arange(self._layers)
        waves = complex(self._half[0, 0]) * complex(self._step[0, 0]) ** layers
        up, down = (np.array([part[0, 0] for part in self._vectors(way)[polarisation]]) for way in (True, False))
        incident[..., 0, 0] = up[:, None] * (up_0 * waves) + down[:, None] * (down_top * waves[::-1])

        def to_points(coefficients: Complex) -> Complex:
            return scipy.fft.ifft2(coefficients, norm="forward", overwrite_x=True)

        right = to_points(incident.astype(self._dtype))

        def product(flat: Complex) -> Complex:
            field = flat.reshape(shape).astype(self._dtype, copy=False)
            scattered = self._scattered(scipy.fft.fft2(self._polarised(field), norm="forward", overwrite_x=True))[0]
            return (field - to_points(scattered)).ravel()

        count = 0

        def counted(_: float) -> None:
            nonlocal count
            count += 1

        operator = LinearOperator((size, size), matvec=product, dtype=self._dtype)
        field, info = gmres(
            operator,
            right.ravel(),
            x0=right.ravel(),
            rtol=self._tolerance,
            restart=_RESTART,
            maxiter=_MAX_RESTARTS,
            callback=counted,
            callback_type="pr_norm",
        )
        if info:
            raise RuntimeError(f"GMRES: no convergence to {self._tolerance:g} in {count} iterations")
        coefficients = scipy.fft.fft2(self._polarised(field.reshape(shape).astype(self._dtype)), norm="forward")
        _, at_0, at_top = self._scattered(coefficients)
        at_0[polarisation][0, 0] += down_top * through
        at_top[polarisation][0, 0] += through * up_0
        below = [t * part for t, part in zip(self._t, at_0, strict=True)]
        below[polarisation][0, 0] -= r * self._from_below
        return at_top, below, count


def _dot(vector: tuple, field: Complex) -> Complex:
    return vector[0] * field[0] + vector[1] * field[1] + vector[2] * field[2]
