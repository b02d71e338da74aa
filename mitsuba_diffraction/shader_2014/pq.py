"""PQ: a finite number of tiles."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi

from ..errors import RequestError
from ..surface.heightfield import HeightField
from .quirks import Quirks
from .shader import Gain, TextureShader

_AT_INTEGER = 2.0**-13.5  # a quarter of √ε in float32


def tile_factor(x: mi.Float, count: int) -> mi.Float:
    """Compute D(x; N) = sin(πNx)/sin(πx), the sum of N unit phasors x periods apart, about their centre.

    N tiles of period T multiply the transform of one tile by D(qT; N), up to a phase. The quotient is 0/0 at integers;
    with k the integer nearest to x and r = x − k, exact in floating point,

        D(x; N) = (−1)^{k(N−1)} sin(πNr)/sin(πr) → (−1)^{k(N−1)} N   as r → 0.

    In double precision it is N `scipy.special.diric(2πx, N)`.
    """
    k = dr.round(x)
    r = x - k
    product = count * r
    rest = dr.fma(mi.Float(count), r, -product)  # rounding error of the product
    whole = dr.round(product)
    fraction = (product - whole) + rest
    at_integer = dr.abs(product) < _AT_INTEGER
    quotient = dr.sin(dr.pi * fraction) / dr.select(at_integer, 1, dr.sin(dr.pi * r))
    parity = mi.Int32(dr.abs(k)) * ((count - 1) % 2) + mi.Int32(dr.abs(whole))
    return dr.select(at_integer, mi.Float(count), quotient) * dr.select((parity & 1) == 0, mi.Float(1), mi.Float(-1))


def tile_sum(x: mi.Float, count: int) -> tuple[mi.Float, mi.Float]:
    """Return p + iq = Σ_{n<N} e^{−2πinx} = e^{−πi(N−1)x} D(x; N) (eq. 3.36, 3.45), stable where the thesis has 0/0."""
    k = dr.round(x)
    r = x - k
    # e^{−πi(N−1)k} = (−1)^{k(N−1)} cancels the same sign in D.
    parity = mi.Int32(dr.abs(k)) * ((count - 1) % 2)
    size = tile_factor(x, count) * dr.select((parity & 1) == 0, mi.Float(1), mi.Float(-1))
    sin, cos = dr.sincos(dr.pi * (count - 1) * r)
    return size * cos, -size * sin


def tiling_power(x: mi.Float, y: mi.Float, counts: tuple[int, int], wrong_product: bool) -> mi.Float:
    """Return p² + q² of (p₁ + iq₁)(p₂ + iq₂) over the squared number of tiles: one at integer x and y.

    Args:
        x: q_x T_x.
        y: q_y T_y.
        counts: numbers of tiles along x and y.
        wrong_product: q = p₁p₂ + q₁q₂, as in eq. 3.48, instead of p₁q₂ + q₁p₂.
    """
    if wrong_product:
        (p_1, q_1), (p_2, q_2) = tile_sum(x, counts[0]), tile_sum(y, counts[1])
        power = dr.square(p_1 * p_2 - q_1 * q_2) + dr.square(p_1 * p_2 + q_1 * q_2)
    else:
        power = dr.square(tile_factor(x, counts[0]) * tile_factor(y, counts[1]))
    return power / float(counts[0] * counts[1]) ** 2


INTERPOLATIONS = ("sinc", "linear")


class PQ(TextureShader):
    """The PQ factors (thesis of 2014, sections 3.2.1 and 3.2.2, algorithm 4.5; "P" and "Q" are tiles along x and y).

    The surface consists of P × Q tiles only. With A the transform of one tile, divided by its number of pixels,

        |P(q; κ)|² = |A(q; κ)|² · |Σ_{n<P} e^{−2πi n q_x T_x}|² |Σ_{n<Q} e^{−2πi n q_y T_y}|²/(PQ)²,

    one for a flat mirror. A is interpolated between texels: linearly (2 × 2 texels), or with the kernel

        D(t/N; N)/N = sin(πt)/(N sin(πt/N)),     t = q_j T_j − m_j,

    of a tile of N pixels, which is exact if summed over all texels and tends to sinc(t) for large N. The published
    neighbourhood is 3 × 3. The origin is the centre of the tile, so that the kernel is real. The amplitude is
    zero outside the Nyquist limit. The thesis sums n = 0 … N, i.e. N + 1 tiles (eq. 3.33).
    """

    own_quirks: ClassVar[tuple[str, ...]] = (*TextureShader.own_quirks, "wrong_product")
    brightness_unit = 0.5  # on a body; 0.2 on a map of the BRDF
    origin_at_centre = True
    published_terms = 39

    def __init__(
        self,
        height_field: HeightField,
        quirks: Quirks,
        *,
        tiles: tuple[int, int] | None = None,
        interpolation: str = "sinc",
        radius: int = 1,
        **settings: Any,
    ) -> None:
        """Set up the shader with the arguments of `TextureShader` and the arguments below.

        Args:
            tiles: (P, Q); default: as many as the coherence length covers.
            interpolation: "sinc" or "linear".
            radius: of the sinc kernel, in texels on each side.
        """
        if interpolation not in INTERPOLATIONS:
            raise RequestError(f"interpolation: got {interpolation!r}, wanted one of {', '.join(INTERPOLATIONS)}")
        self.radius, self._tiles, self.interpolation = radius, tiles, interpolation
        super().__init__(height_field, quirks, **settings)

    @property
    def tiles(self) -> tuple[int, int]:
        """(P, Q)."""
        x, y = (self.coherence_length / size for size in self.tile_size)
        return self._tiles or (max(1, round(x)), max(1, round(y)))

    @property
    def margin(self) -> int:
        return self.radius + 1

    @property
    def peak(self) -> float:
        """The area of the surface."""
        return self.tile_size[0] * self.tile_size[1] * self.tiles[0] * self.tiles[1]

    @property
    def texels_per_term(self) -> int:
        return (2 if self.interpolation == "linear" else 2 * self.radius + 1) ** 2

    def power(self, gain: Gain, wavelength: mi.Float, height_scale: mi.Float, active: mi.Bool) -> mi.Float:
        x, y = self.position(gain, wavelength)
        rows, columns = self._height_field.shape
        active = active & (dr.abs(x) <= columns / 2) & (dr.abs(y) <= rows / 2)
        if self.interpolation == "linear":
            first, size = [dr.floor(c) for c in (x, y)], (2, 2)
        else:
            anchor = dr.floor if self.quirks.floor_anchor else dr.round
            first, size = [anchor(c) - self.radius for c in (x, y)], (2 * self.radius + 1,) * 2
        corner = tuple(mi.Int32(dr.clip(c, -1e6, 1e6)) for c in first)
        kappa = -dr.two_pi * gain.w / wavelength * height_scale
        tile, _ = self.textures.over(corner, size, kappa, self._kernel(x, y), active)
        return dr.select(active, tile * tiling_power(x, y, self.tiles, self.quirks.wrong_product), 0)

    def _kernel(self, x: mi.Float, y: mi.Float) -> Callable[[mi.Int32, mi.Int32], mi.Float]:
        """Return the weight of texel m at the position (x, y)."""
        counts = self._height_field.shape[::-1]

        def linear(m_x: mi.Int32, m_y: mi.Int32) -> mi.Float:
            return dr.maximum(1 - dr.abs(mi.Float(m_x) - x), 0) * dr.maximum(1 - dr.abs(mi.Float(m_y) - y), 0)

        def sinc(m_x: mi.Int32, m_y: mi.Int32) -> mi.Float:
            value = mi.Float(1)
            for t, count in zip((x - mi.Float(m_x), y - mi.Float(m_y)), counts, strict=True):
                value *= tile_factor(t / count, count) / count
            return value

        return linear if self.interpolation == "linear" else sinc
