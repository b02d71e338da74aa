"""The Fourier transforms of the powers of a height field, stored as textures (algorithm 4.1)."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ..errors import RequestError
from ..surface.heightfield import HeightField

PUBLISHED_TERMS = 37  # 81 wavelengths × 37 terms × 9 texels are the 27,000 reads of the published shader

ORIGINS = ("corner", "centre")


@dataclass(frozen=True, eq=False)
class TaylorTextures:
    """F{tⁿ}(m) with t = h/H, so that with κ in rad/µm

        F_m(κ) = Σ_n (iκH)ⁿ/n! · F{tⁿ}(m),     n < N.

    |t| ≤ 1 bounds the texels by one. The thesis transforms e^{ikwh}, kw = −κ, with the opposite sign in the exponent,
    which gives the complex conjugate of F_m and the same power.

    Attributes:
        texels: (N_y, N_x, N) complex64; frequency zero is at (N_y // 2, N_x // 2) (eq. 4.3).
        height: H in µm.
        tile_size: (T_x, T_y) in µm.
    """

    texels: NDArray[np.complex64]
    height: float
    tile_size: tuple[float, float]

    @classmethod
    def of(
        cls,
        height_field: HeightField,
        terms: int = PUBLISHED_TERMS,
        *,
        heights_from_zero: bool = False,
        origin: str = "corner",
    ) -> TaylorTextures:
        """Transforms a tile.

        Args:
            height_field: the tile.
            terms: N; the truncation error is at most (κH)^N/N!.
            heights_from_zero: measure heights from the lowest point (H is the full range) instead of the centre.
            origin: x = 0 at the first pixel or at the centre of the tile, which affects the phase of F_m.

        Raises:
            ValueError: if there are no terms or the origin is unknown.
        """
        if isinstance(terms, bool) or not isinstance(terms, int) or terms < 1:
            raise RequestError(f"terms: got {terms!r}, wanted a whole number ≥ 1")
        if origin not in ORIGINS:
            raise RequestError(f"origin: got {origin!r}, wanted one of {', '.join(ORIGINS)}")
        heights = height_field.heights - height_field.heights.min() if heights_from_zero else height_field.centred
        height = height_field.height_range if heights_from_zero else height_field.half_range
        t = heights / (height or 1.0)
        powers = t[None] ** np.arange(terms)[:, None, None]
        spectrum = scipy.fft.fftshift(scipy.fft.fft2(powers, norm="forward"), axes=(1, 2))
        if origin == "centre":
            for axis, count in zip((1, 2), height_field.shape, strict=True):
                order = np.arange(count) - count // 2
                phase = np.exp(1j * np.pi * order * (count - 1) / count)
                spectrum = spectrum * np.expand_dims(phase, [a for a in (0, 1, 2) if a != axis])
        texels = np.ascontiguousarray(np.moveaxis(spectrum, 0, -1), np.complex64)
        texels.setflags(write=False)
        return cls(texels, float(height), height_field.tile_size)

    @property
    def terms(self) -> int:
        """N."""
        return self.texels.shape[-1]

    @property
    def orders(self) -> tuple[int, int]:
        """(N_x, N_y), the numbers of texels along x and y."""
        return self.texels.shape[1], self.texels.shape[0]
