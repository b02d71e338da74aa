"""Fourier transforms of the powers of a height field as textures (algorithm 4.1), and sums over their texels."""

from __future__ import annotations

from collections.abc import Callable

import drjit as dr
import mitsuba as mi
import numpy as np
import scipy.fft
from numpy.typing import NDArray
from scipy.special import gammaln

from ..bsdf.device_tables import PacketTable, opaque
from ..errors import RequestError
from ..surface.heightfield import HeightField
from .tristimulus import FIRST_WAVELENGTH

MAX_TEXTURE_KAPPA = 4e3 * np.pi / FIRST_WAVELENGTH  # rad/µm, at normal incidence
MAX_FREQUENCY = 2e3 / FIRST_WAVELENGTH  # cycles/µm, at grazing incidence


def terms_for(x: float, error: float) -> int:
    """Return the smallest N with x^N/N! ≤ `error`: Lagrange's remainder of e^{ix}, whose derivatives have modulus 1."""
    terms, remainder = 0, 1.0
    while remainder > error:
        terms += 1
        remainder *= x / terms
    return max(terms, 1)


def series_error(x: float, terms: int) -> float:
    """Estimate the error of N Taylor terms of e^{ix} in float32: remainder, and rounding of the largest term.

    The largest term is about e^x/√(2πx) (Stirling), while the sum has modulus one: in float32 a series from x = 14 on
    loses more than a per cent, whatever the number of terms.
    """
    remainder = np.exp(terms * np.log(x) - gammaln(terms + 1)) if x > 0 else 0.0
    largest = np.exp(x) / np.sqrt(2 * np.pi * max(x, 1 / (2 * np.pi)))
    return float(remainder + np.finfo(np.float32).eps / 2 * largest)


def taylor_transforms(
    height_field: HeightField,
    terms: int,
    *,
    origin_at_centre: bool,
    taper: NDArray[np.float64] | None = None,
    margin: int = 1,
) -> tuple[NDArray[np.complex64], float]:
    """Compute F{w tⁿ}(m), n < N, with t = h/H and h from the centre of the heights; |t| ≤ 1 bounds them by one.

    Args:
        height_field: the tile.
        terms: N.
        origin_at_centre: x = 0 at the centre of the tile instead of the first pixel, which affects the phase.
        taper: w, (N_y, N_x); default: one.
        margin: texels outside the frequencies that light reaches.

    Returns:
        The texels of the frequencies that light reaches, (n_y, n_x, N), with frequency zero at (n_y // 2, n_x // 2)
        (eq. 4.3); and H in µm.

    Raises:
        ValueError: if there are no terms.
    """
    if isinstance(terms, bool) or not isinstance(terms, int) or terms < 1:
        raise RequestError(f"terms: got {terms!r}, wanted a whole number ≥ 1")
    height = height_field.half_range
    t = height_field.centred / (height or 1.0)
    kept, phases = [], []
    for count, size in zip(height_field.shape, height_field.tile_size[::-1], strict=True):
        middle, reached = count // 2, int(np.ceil(MAX_FREQUENCY * size)) + margin
        first = max(middle - reached, 0)
        kept.append(slice(first, 2 * middle - first + 1 if first else count))
        order = np.arange(count)[kept[-1]] - middle
        phases.append(np.exp(1j * np.pi * order * (count - 1) / count))
    phase = np.outer(*phases) if origin_at_centre else 1.0
    power = np.ones(t.shape) if taper is None else taper
    texels = []
    for _ in range(terms):
        transform = scipy.fft.fftshift(scipy.fft.fft2(power, norm="forward"))[tuple(kept)]
        texels.append((transform * phase).astype(np.complex64))
        power = power * t
    return np.stack(texels, axis=-1), float(height)


class TaylorTextures:
    """The transforms F{tⁿ}(m), t = h/H, as textures. With κ in rad/µm,

        F_m(κ) = Σ_n (iκH)ⁿ/n! · F{tⁿ}(m),     n < N.

    Each term of each texel is one read of a complex number; the truncation error is at most (κH)^N/N!. The thesis
    transforms e^{ikwh}, kw = −κ, with the opposite sign in the exponent, which gives the complex conjugate of F_m and
    the same power.

    Attributes:
        columns, rows: the numbers of texels along x and y.
        terms: N.
        error: of the series at the largest κ (`series_error`).
    """

    def __init__(self, texels: NDArray[np.complex64], height: float) -> None:
        """Store the result of `taylor_transforms`."""
        self.rows, self.columns, self.terms = texels.shape
        self.error = series_error(MAX_TEXTURE_KAPPA * height, self.terms)
        self.height = opaque(height)
        self.table = PacketTable(np.stack([texels.real, texels.imag], axis=-1), width=2)

    @dr.syntax
    def amplitude(self, m_x: mi.Int32, m_y: mi.Int32, kappa: mi.Float, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Return real and imaginary part of F_m(κ); zero where the order lies outside the texture."""
        column, row = m_x + self.columns // 2, m_y + self.rows // 2
        inside = active & (column >= 0) & (column < self.columns) & (row >= 0) & (row < self.rows)
        first = mi.UInt32(dr.select(inside, (row * self.columns + column) * self.terms, 0))
        x = kappa * self.height
        re, im = mi.Float(0), mi.Float(0)
        # (ix)ⁿ/n!
        c_re, c_im = mi.Float(1), mi.Float(0)
        n = mi.UInt32(0)
        while n < self.terms:
            term = self.table(first + n, inside)
            re += c_re * term.x - c_im * term.y
            im += c_re * term.y + c_im * term.x
            n += 1
            step = x / mi.Float(n)
            c_re, c_im = -step * c_im, step * c_re
        return re, im

    @dr.syntax
    def over(
        self,
        first: tuple[mi.Int32, mi.Int32],
        size: tuple[int, int],
        kappa: mi.Float,
        weight: Callable[[mi.Int32, mi.Int32], mi.Float],
        active: mi.Bool,
    ) -> tuple[mi.Float, mi.Float]:
        """Return |Σ_m φ_m F_m(κ)|² and Σ_m φ_m² |F_m(κ)|² over a rectangle of texels.

        Args:
            first: the texel of lowest order along x and y.
            size: numbers of texels along x and y.
            kappa: κ in rad/µm.
            weight: φ of the orders (m_x, m_y).
            active: mask.
        """
        first_x, first_y = mi.Int32(first[0]), mi.Int32(first[1])
        columns, rows = size
        re, im, powers = mi.Float(0), mi.Float(0), mi.Float(0)
        index = mi.Int32(0)
        while index < columns * rows:
            m_x = first_x + index % columns
            m_y = first_y + index // columns
            part_re, part_im = self.amplitude(m_x, m_y, kappa, active)
            phi = weight(m_x, m_y)
            re += phi * part_re
            im += phi * part_im
            powers += dr.square(phi) * (dr.square(part_re) + dr.square(part_im))
            index += 1
        return dr.square(re) + dr.square(im), powers
