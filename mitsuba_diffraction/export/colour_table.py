"""The colour of a surface under an illuminant, by one look-up for each direction of light.

In scalar theory, next to the relief, with u = −(ω_i + ω_o)_∥ and w = n (cos θ_i + cos θ_o) inside a coat of index n,
q = u/λ, κ = 2π w/λ, and the half vector has cos θ_h = √(|u|² + w²)/2n. Therefore f/(K G T_i T_o) under an illuminant
E(λ) depends on u and w alone:

    C(u, w) = ∫ R(λ, θ_h) S(u/λ; 2π w/λ) λ⁻² (x̄, ȳ, z̄)(λ) E(λ) dλ,    ∫ ȳ E dλ = 1

Where lobes overlap, it is a table over u_x, u_y and w (`ColourTable`). The lobe of a separate order at q_m is a
Gaussian in ν = 1/λ,

    |u ν − q_m|² = |u|² (ν − c)² + d²,    c = u·q_m/|u|²,    d² = |q_m|² − c² |u|²,    s = σ_q/|u|,

so that its colour is that of a Gaussian of light about c, of width s, in a table over c and s (`OrderColours`), times
g = η_m R at c. In a wide lobe g varies. There it is interpolated between nodes ν_j with spacing d by Gaussians of width
p = d/1.7, which have a constant sum, and whose products with the lobe are Gaussians once more:

    g(ν) ≈ Σ_j (g_j − (p/d)² (g_{j−1} − 2g_j + g_{j+1})/2) e^{−(ν − ν_j)²/2p²} d/√(2π)p

exact to the third power of ν.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
import scipy.sparse
from numpy.typing import NDArray

from ..array_types import Real
from ..errors import RequestError
from ..optics.color import XYZ_to_linear_sRGB, auto_exposure, daylight, delta_E, into_gamut, matching_functions
from ..optics.geometry import fresnel
from ..optics.media import MediumBelow
from ..precomputation.grating_spectrum import GratingSpectrum
from ..spectrum.grids import OrderGrid, spline_weights

_SHORTEST, _LONGEST = 380.0, 740.0  # nm
_STEP = 4.0  # nm, of the integral in tables; its error is measured
_STRETCH = 0.1  # a of u = a sinh: below it u is sampled uniformly, above it in proportion to u
_SIZES = ((128, 8), (192, 8), (192, 10))  # nodes along u and along w
_FINER = 2  # steps of w between two nodes, to which they are fitted
_MIN_W = 0.15  # without a coat: both directions at 86° from the normal
_MAX_U = 2.0
MAX_MEAN_ERROR, MAX_95_ERROR, MAX_FLUX_ERROR = 0.5, 1.5, 0.03  # ΔE00, and of the sum
PAIRS = 4000  # of directions, between which and the integral the error is measured
_ANGLES, _MAX_VIEW = (0.0, 20.0, 40.0, 60.0), 80.0  # of these pairs, degrees
_MIN_POWER = 1e-4  # of an order at any κ
MAX_ORDERS = 256
_KAPPAS, _CENTRES, _WIDTHS, _COSINES = 65, 512, 12, 16
_LOW, _HIGH = 1e3 / _LONGEST, 1e3 / _SHORTEST  # ν, 1/µm
_NODES, _PER_SPACING = 8, 1 / 1.7  # ν_j, the first and the last next to visible light; p/d
_SPACING = (_HIGH - _LOW) / (_NODES - 2)
_MAX_SINGLE = 0.06  # s of a lobe in which g is taken at c, 1/µm
_CUTOFF = 4.0  # of lobes, and of their products with Gaussians of nodes, in standard deviations
_MAX_CENTRE, _WIDTH_RANGE = 4.0, (3e-3, _SPACING * _PER_SPACING)  # 1/µm


@dataclass(frozen=True, eq=False)
class Viewed:
    """A surface of scalar theory in its media, as a table of colours holds it.

    Attributes:
        spectrum: S(q; κ).
        below: the medium below.
        coat: index of a clear layer above relative to the outside; 1 of none.
        height_scale: factor of the heights.
    """

    spectrum: GratingSpectrum
    below: MediumBelow
    coat: float = 1.0
    height_scale: float = 1.0

    def powers(self, kappa: float) -> NDArray[np.float32]:
        """Return the power of each node at κ, rad/µm; that at the end of the spectrum outside."""
        return self.spectrum.powers(min(self.height_scale * kappa, self.spectrum.max_kappa))

    def reflectance(self, wavelength: float, u: Real, w: Real) -> Real:
        """Return R at the half vector; wavelength in µm, u (..., 2) and w (...)."""
        return self.reflected(wavelength, np.sqrt((u**2).sum(axis=-1) + w**2) / (2 * self.coat))

    def reflected(self, wavelength: float, cosine: Real) -> Real:
        """Return R at a cosine of θ_h."""
        s, p = fresnel(np.minimum(cosine, 1.0), self.below.index_at(wavelength) / self.coat)
        return (s + p) / 2

    def integrated(self, u: Real, w: Real) -> Real:
        """Return C by summation over the wavelength in steps of one nm, (n, 3); u (n, 2), w (n,)."""
        total = np.zeros((len(w), 3))
        for wavelength, colour in _light(1.0):
            kappa = np.minimum(self.height_scale * 2 * np.pi * w / wavelength, self.spectrum.max_kappa)
            value = self.spectrum.evaluate(u / wavelength, kappa) / wavelength**2 * self.reflectance(wavelength, u, w)
            total += value[:, None] * colour
        return total

    @property
    def range_w(self) -> tuple[float, float]:
        """The smallest and the largest w."""
        return max(_MIN_W, 2 * float(np.sqrt(self.coat**2 - 1))), 2 * self.coat

    @property
    def has_separate_orders(self) -> bool:
        """Whether at most one order contributes to a pair of directions and a wavelength."""
        return isinstance(self.spectrum.grid, OrderGrid) and self.spectrum.neighbours == (1, 1)

    def pairs(self) -> tuple[Real, Real]:
        """Return u (n, 2) and w (n,) of pairs of directions, always the same.

        Views are uniform over the hemisphere, or in the lobes of separate orders, drawn by their power.
        """
        rng = np.random.default_rng(0)
        theta, phi = np.deg2rad(rng.choice(_ANGLES, PAIRS)), rng.uniform(0, 2 * np.pi, (2, PAIRS))
        largest = np.sin(np.deg2rad(_MAX_VIEW))
        incident = np.sin(theta)[:, None] * np.stack([np.cos(phi[0]), np.sin(phi[0])], -1)
        if self.has_separate_orders:
            wavelength = rng.uniform(_SHORTEST, _LONGEST, PAIRS) * 1e-3
            q = np.stack(np.meshgrid(*self.spectrum.grid.frequencies()), -1).reshape(-1, 2)
            power = np.maximum(self.powers(2 * np.pi * self.range_w[1] / 0.55), 0).ravel()
            drawn = rng.choice(len(q), PAIRS, p=power / power.sum())
            offset = self.spectrum.lobe_width * rng.standard_normal((PAIRS, 2))
            outgoing = -incident - wavelength[:, None] * (q[drawn] + offset)
        else:
            sine = np.sqrt(1 - rng.uniform(np.sqrt(1 - largest**2), 1, PAIRS) ** 2)
            outgoing = sine[:, None] * np.stack([np.cos(phi[1]), np.sin(phi[1])], -1)
        seen = np.linalg.norm(outgoing, axis=-1) <= largest
        tangents = np.stack([incident[seen], outgoing[seen]])
        return -tangents.sum(axis=0), np.sqrt(self.coat**2 - (tangents**2).sum(axis=-1)).sum(axis=0)


@dataclass(frozen=True)
class ColourError:
    """ΔE00 of look-ups beside the integral, exposed like a picture (`auto_exposure`).

    Attributes:
        mean: of the pairs.
        percentile_95: of the pairs.
        maximum: of the pairs.
        flux: relative error of the sum of Y, of which a skin reflects the larger part in the mirror direction.
    """

    mean: float = np.nan
    percentile_95: float = np.nan
    maximum: float = np.nan
    flux: float = np.nan

    @classmethod
    def of(cls, found: Real, wanted: Real) -> ColourError:
        """Compare XYZ, (n, 3)."""
        exposure = auto_exposure(into_gamut(XYZ_to_linear_sRGB(wanted)))
        error = delta_E(exposure * found, exposure * wanted)
        flux = found[:, 1].sum() / wanted[:, 1].sum() - 1
        return cls(float(error.mean()), float(np.percentile(error, 95)), float(error.max()), float(flux))

    @property
    def is_small(self) -> bool:
        """Whether it is hardly visible."""
        of_colour = self.mean <= MAX_MEAN_ERROR and self.percentile_95 <= MAX_95_ERROR
        return of_colour and abs(self.flux) <= MAX_FLUX_ERROR

    def __str__(self) -> str:
        return (
            f"ΔE00 {self.mean:.2g} (mean), {self.percentile_95:.2g} (95 %), {self.maximum:.2g} (maximum), "
            f"flux {self.flux:+.1%}"
        )


@dataclass(frozen=True, eq=False)
class ColourTable:
    """C of overlapping orders and continua, trilinear over u_x, u_y and w.

    Nodes lie at u = a sinh(x asinh(u_max/a)), x from −1 to 1 in equal steps, and at equal steps of w.

    Attributes:
        values: XYZ with a shared exponent (`to_shared_exponents`), (nodes in w, in u_y, in u_x), uint32.
        stretch: a.
        range_w: the first and the last w.
        error: beside the integral.
    """

    values: NDArray[np.uint32]
    stretch: float
    range_w: tuple[float, float]
    error: ColourError = ColourError()

    def colour(self, u: Real, w: Real) -> Real:
        """Return C, (n, 3), of u (n, 2) and w (n,); that at the nearest node outside of the table."""
        x = np.arcsinh(u / self.stretch) / np.arcsinh(_MAX_U / self.stretch)
        first, last = self.range_w
        at = (*((x.T + 1) / 2), (w - first) / (last - first))
        return _interpolated(from_shared_exponents(self.values), *reversed(at))


@dataclass(frozen=True, eq=False)
class OrderColours:
    """C of separate orders, a look-up for each.

    Attributes:
        frequencies: q_m, cycles/µm, (n, 2).
        tile_size: T, µm, of which q_m is a multiple of 1/T.
        powers: η_m at equal steps of κ from 0 to `max_kappa`, (n, k).
        max_kappa: rad/µm, at the height scale of the table.
        lobe_width: σ_q, cycles/µm.
        light: ∫ R_0 (x̄, ȳ, z̄) E e^{−(ν − c)²/2s²} dν/s, R_0 the reflectance at cos θ_h = 1, over s in equal steps of
            its logarithm and over c from 0, (s, c, 3).
        reflectance: R/R_0 over ν of visible light and cos θ_h from 0 to 1, (cosines, ν).
        error: beside the integral.
    """

    frequencies: Real
    tile_size: tuple[float, float]
    powers: Real
    max_kappa: float
    lobe_width: float
    light: Real
    reflectance: Real
    coat: float
    error: ColourError = ColourError()

    def colour(self, u: Real, w: Real) -> Real:
        """Return C, (n, 3), of u (n, 2) and w (n,)."""
        total = np.zeros((len(w), 3))
        length = np.maximum(np.linalg.norm(u, axis=-1), 1e-6)
        s = self.lobe_width / length
        for q, eta in zip(self.frequencies, self.powers, strict=True):
            c = u @ q / length**2
            square = np.maximum(q @ q - (c * length) ** 2, 0) / self.lobe_width**2
            lobe = np.exp(-square / 2) / (2 * np.pi * self.lobe_width**2)
            near, is_wide = square < _CUTOFF**2, s > _MAX_SINGLE
            for rows, of in (near & ~is_wide & (c > 0) & (c < _MAX_CENTRE), self._narrow), (near & is_wide, self._wide):
                total[rows] += lobe[rows, None] * of(eta, c[rows], s[rows], u[rows], w[rows])
        return total

    def _narrow(self, eta: Real, c: Real, s: Real, u: Real, w: Real) -> Real:
        """Return the colour of an order whose factor is that in the middle of its lobe, (n, 3)."""
        return self._factor(eta, c, u, w)[:, None] * self._gaussian(c, s)

    def _wide(self, eta: Real, c: Real, s: Real, u: Real, w: Real) -> Real:
        """Return the colour of an order whose factor varies within its lobe, (n, 3)."""
        p, correction = _WIDTH_RANGE[1], _PER_SPACING**2 / 2
        both = s**2 + p**2
        total = light = np.zeros((len(c), 3))
        factor = np.zeros((len(c), 1))
        for nu in _LOW + _SPACING * (np.arange(_NODES) - 0.5):
            before, light_before = factor, light
            weight = np.exp(-((c - nu) ** 2) / (2 * both)) / (np.sqrt(2 * np.pi) * _PER_SPACING)
            weight *= np.abs(c - nu) <= _CUTOFF * np.sqrt(both)
            light = weight[:, None] * self._gaussian((c * p**2 + nu * s**2) / both, s * p / np.sqrt(both))
            factor = self._factor(eta, np.full(len(c), nu), u, w)[:, None]
            pairs = before * light + factor * light_before
            total = total + (1 + 2 * correction) * factor * light - correction * pairs
        return total

    def _factor(self, eta: Real, nu: Real, u: Real, w: Real) -> Real:
        """Return η R/R_0 at ν, that of the nearest visible light."""
        visible = np.clip(nu, _LOW, _HIGH)
        power = np.interp(2 * np.pi * w * visible / self.max_kappa, np.linspace(0, 1, len(eta)), eta)
        cosine = np.sqrt((u**2).sum(axis=-1) + w**2) / (2 * self.coat)
        return power * _interpolated(self.reflectance[..., None], cosine, (visible - _LOW) / (_HIGH - _LOW))[:, 0]

    def _gaussian(self, c: Real, s: Real) -> Real:
        """Return the colour of a Gaussian of light, (n, 3)."""
        narrow, wide = _WIDTH_RANGE
        return s[:, None] * _interpolated(self.light, np.log(s / narrow) / np.log(wide / narrow), c / _MAX_CENTRE)


def colours_of(viewed: Viewed) -> ColourTable | OrderColours:
    """Return the colours of a surface: the smallest table whose error is hardly visible, or the most exact one.

    Raises:
        ValueError: if more than `MAX_ORDERS` separate orders propagate.
    """
    u, w = viewed.pairs()
    wanted = viewed.integrated(u, w)
    if viewed.has_separate_orders:
        orders = _orders(viewed)
        return replace(orders, error=ColourError.of(orders.colour(u, w), wanted))
    found: list[ColourTable] = []
    for size, layers in _SIZES:
        table = _table(viewed, size, layers)
        found.append(replace(table, error=ColourError.of(table.colour(u, w), wanted)))
        best = min(found, key=lambda table: table.error.mean)
        if best.error.is_small:
            break
    return best


def _table(viewed: Viewed, size: int, layers: int) -> ColourTable:
    """Return a table with its nodes; on a lattice, S at u/λ is a product with a sparse matrix along each axis.

    Interpolation between values of a convex function is too bright in the mean. Along w, nodes are fitted to values in
    finer steps; along u, a node has its value less a twelfth of the second difference, the fit by least squares where
    that is constant.
    """
    u = _STRETCH * np.sinh(np.linspace(-1, 1, size) * np.arcsinh(_MAX_U / _STRETCH))
    plane = np.stack(np.meshgrid(u, u), -1)
    w = np.linspace(*viewed.range_w, _FINER * (layers - 1) + 1)
    values = np.zeros((len(w), size, size, 3), np.float32)
    for wavelength, colour in _light(_STEP):
        along_x, along_y = (_along(viewed.spectrum, axis, u / wavelength) for axis in (0, 1))
        for layer, w_of_layer in zip(values, w, strict=True):
            powers = viewed.powers(2 * np.pi * w_of_layer / wavelength)
            density = np.maximum((along_x @ np.ascontiguousarray((along_y @ powers).T)).T, 0)
            layer += (density * viewed.reflectance(wavelength, plane, w_of_layer) / wavelength**2)[..., None] * colour
    position = np.arange(len(w)) / _FINER
    hats = np.maximum(1 - np.abs(position[:, None] - np.arange(layers)), 0)
    fitted = np.tensordot(np.linalg.pinv(hats).astype(np.float32), values, 1)
    for axis in (1, 2):
        along = np.moveaxis(fitted, axis, 0)  # a view
        along[1:-1] -= (along[:-2] - 2 * along[1:-1] + along[2:]) / 12
    return ColourTable(to_shared_exponents(fitted), _STRETCH, viewed.range_w)


def _along(spectrum: GratingSpectrum, axis: int, q: Real) -> scipy.sparse.csr_matrix:
    """Return the weights of the nodes along an axis at q, (n, nodes), sparse."""
    grid, last = spectrum.grid, spectrum.grid.max_order[axis]
    if isinstance(grid, OrderGrid):
        lobe, size, width = spectrum.lobes[axis], grid.tile_size[axis], spectrum.lobe_width
        first = np.full(len(q), -last) if np.isinf(lobe.half_width) else np.ceil(q * size - lobe.count / 2)
        m = first[:, None].astype(np.int64) + np.arange(lobe.count)
        offset = q[:, None] - m / size
        weights = np.exp(-(offset**2) / (2 * width**2)) / (np.sqrt(2 * np.pi) * width * lobe.inside)
        weights *= np.abs(offset) <= lobe.half_width
    else:
        spacing = grid.spacing[axis]
        nearest = np.rint(q / spacing)
        m = nearest[:, None].astype(np.int64) + np.array([-1, 0, 1])
        weights = np.stack(spline_weights(q / spacing - nearest), -1) / spacing
        weights *= (np.abs(q) <= grid.limit[axis] * (1 + 1e-12))[:, None]
    kept = np.abs(m) <= last
    rows = np.broadcast_to(np.arange(len(q))[:, None], m.shape)
    return scipy.sparse.csr_matrix((weights[kept], (rows[kept], m[kept] + last)), (len(q), 2 * last + 1))


def _orders(viewed: Viewed) -> OrderColours:
    """Return the colours of separate orders."""
    spectrum, grid = viewed.spectrum, viewed.spectrum.grid
    assert isinstance(grid, OrderGrid)  # see `Viewed.has_separate_orders`
    max_kappa = 2 * np.pi * viewed.range_w[1] / (_SHORTEST * 1e-3)
    powers = np.stack([viewed.powers(kappa) for kappa in np.linspace(0, max_kappa, _KAPPAS)], -1)
    q = np.stack(np.meshgrid(*grid.frequencies()), -1)
    length = np.linalg.norm(q, axis=-1)
    kept = (powers.max(axis=-1) > _MIN_POWER) & (length <= _MAX_U / (_SHORTEST * 1e-3))
    if (count := int(kept.sum())) > MAX_ORDERS:
        wanted = f"wanted at most {MAX_ORDERS}; with a smaller coherence_length they overlap"
        raise RequestError(f"{spectrum.source}: got {count} separate orders, {wanted}")
    kept |= length == 0
    narrow, wide = _WIDTH_RANGE
    nu = np.linspace(_LOW, _HIGH, 1441)
    # E dλ = E dν/ν²; with λ⁻² of C, 1000 nm/µm are left.
    of_light = np.array([viewed.reflected(1 / n, np.ones(())) for n in nu])[:, None] * _per_nm(1e3 / nu) * 1e3
    c, s = np.linspace(0, _MAX_CENTRE, _CENTRES), np.geomspace(narrow, wide, _WIDTHS)
    light = np.stack([np.exp(-0.5 * ((nu - c[:, None]) / width) ** 2) @ of_light / width for width in s])
    cosines, some = np.linspace(0, 1, _COSINES), np.linspace(nu[0], nu[-1], _COSINES)
    reflectance = np.stack([viewed.reflected(1 / n, cosines) / viewed.reflected(1 / n, np.ones(())) for n in some], 1)
    return OrderColours(
        q[kept],
        grid.tile_size,
        powers[kept],
        max_kappa,
        spectrum.lobe_width,
        light * (nu[1] - nu[0]),
        reflectance,
        viewed.coat,
    )


def _per_nm(wavelengths: Real) -> Real:
    """Return (x̄, ȳ, z̄) E at wavelengths in nm, (n, 3), for daylight; ∫ ȳ E dλ = 1."""
    nm = np.arange(360.0, 831.0)
    return (
        matching_functions(wavelengths) * daylight(wavelengths)[:, None] / (matching_functions(nm)[:, 1] @ daylight(nm))
    )


def _light(step: float) -> Iterator[tuple[float, Real]]:
    """Yield wavelengths in µm, and (x̄, ȳ, z̄) E dλ, (3,), in steps of nm."""
    nm = np.arange(_SHORTEST + step / 2, _LONGEST, step)
    yield from zip((nm * 1e-3).tolist(), _per_nm(nm) * step, strict=True)


def _interpolated(values: Real, *at: Real) -> Real:
    """Return values (n_1, …, c) at coordinates from 0 to 1 along their axes, each (n,), linearly: (n, c)."""
    found: Real = np.zeros((len(at[0]), values.shape[-1]))
    positions = []
    for x, count in zip(at, values.shape[:-1], strict=True):
        scaled = np.clip(x, 0, 1) * (count - 1)
        node = np.minimum(scaled.astype(np.int64), count - 2)
        positions.append((node, scaled - node))
    for corner in np.ndindex(*(2,) * len(at)):
        nodes = tuple(node + step for (node, _), step in zip(positions, corner, strict=True))
        weights = [rest if step else 1 - rest for (_, rest), step in zip(positions, corner, strict=True)]
        found = found + np.prod(weights, axis=0)[:, None] * values[nodes]
    return found


def to_shared_exponents(values: NDArray[np.floating]) -> NDArray[np.uint32]:
    """Return three numbers ≥ 0, (..., 3), with nine bits each and a shared exponent, as textures RGB9_E5 of GPUs."""
    clipped = np.clip(values, 0, 65408.0)
    exponent = np.maximum(-16, np.floor(np.log2(np.maximum(clipped.max(axis=-1), 2.0**-20)))) + 1
    exponent += np.rint(clipped.max(axis=-1) / 2.0 ** (exponent - 9)) == 512
    mantissa = np.rint(clipped / 2.0 ** (exponent - 9)[..., None]).astype(np.uint32)
    red, green, blue = np.moveaxis(mantissa, -1, 0)
    return red | green << np.uint32(9) | blue << np.uint32(18) | (exponent + 15).astype(np.uint32) << np.uint32(27)


def from_shared_exponents(values: NDArray[np.uint32]) -> Real:
    """Return the numbers of `to_shared_exponents`, (..., 3)."""
    exponent = (values >> np.uint32(27)).astype(np.int64) - 15 - 9
    mantissa = np.stack([values >> np.uint32(shift) & np.uint32(511) for shift in (0, 9, 18)], -1)
    return mantissa * 2.0 ** exponent[..., None]
