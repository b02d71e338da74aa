"""FLSS: full lambda space sampling."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, ClassVar

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError
from ..surface.heightfield import HeightField
from .quirks import Quirks
from .shader import Gain, TextureShader

WINDOWS = ("texel", "4sigma")


class FLSS(TextureShader):
    """Full lambda space sampling (thesis of 2014, algorithm 4.3, after Stam 1999, "Diffraction Shaders").

    Samples 81 wavelengths, 380 to 780 nm. For each, the texels of the transform of the tile around the position
    c = (u T_x, v T_y)/λ (eq. 4.6) are weighted with a Gaussian window in amplitude (eq. 3.29, 3.30):

        P = Σ_m φ(m/T − q) F_m(κ),     φ(x) = e^{−|x|²/2σ_f²},     σ_f = 1/(2πσ_s),     σ_s = L_c/4.

    As published, the neighbourhood is one texel on each side. It truncates at most about e^{−(3/2)²/(σ_f T)²} of a
    line: 0.4 % for T = L_c, and a negligible part for much smaller tiles. For T > L_c orders overlap, and the complex
    sum represents a single point x₀ rather than the average. Corrected, it spans 4σ_f and truncates less than e^{−4}.

    Attributes:
        sigmas: σ along x and y, in cycles/µm: σ_f, or, of a tapered scan, the smaller ones of `taper.py`.
    """

    own_quirks: ClassVar[tuple[str, ...]] = (
        *TextureShader.own_quirks,
        *("complex_window_sum", "one_texel", "periodic_scan"),
    )
    published_terms = 37

    def __init__(
        self, height_field: HeightField, quirks: Quirks, *, window: str | None = None, **settings: Any
    ) -> None:
        """Set up the shader with the arguments of `TextureShader` and `window`.

        Args:
            window: "texel" or "4sigma", instead of the window of the quirk `one_texel`.
        """
        if window not in (None, *WINDOWS):
            raise RequestError(f"window: got {window!r}, wanted one of {', '.join(WINDOWS)}")
        self._window = window
        super().__init__(height_field, quirks, **settings)

    @property
    def tapers(self) -> bool:
        return self.extent == "sample" and not self.quirks.periodic_scan

    @property
    def radius(self) -> tuple[int, int]:
        """Texels on each side of the neighbourhood, along x and y."""
        if self._window == "texel" or (self._window is None and self.quirks.one_texel):
            return 1, 1
        return self._spanning

    @property
    def _spanning(self) -> tuple[int, int]:
        """Texels on each side that span 4σ, at least one."""
        x, y = (2 * sigma * size - 0.5 for sigma, size in zip(self.sigmas, self.tile_size, strict=True))
        return max(1, int(np.ceil(x))), max(1, int(np.ceil(y)))

    @property
    def margin(self) -> int:
        return max(self._spanning) + 1

    @property
    def texels_per_term(self) -> int:
        return int(np.prod([2 * radius + 1 for radius in self.radius]))

    @property
    def truncated_fraction(self) -> float:
        """The larger of e^{−(r + ½)²/(σ T)²} along x and y: bound of the truncated fraction of the power of a line."""
        axes = zip(self.radius, self.sigmas, self.tile_size, strict=True)
        return max(float(np.exp(-(((radius + 0.5) / (sigma * size)) ** 2))) for radius, sigma, size in axes)

    def power(self, gain: Gain, wavelength: mi.Float, height_scale: mi.Float, active: mi.Bool) -> mi.Float:
        x, y = self.position(gain, wavelength)
        return self.windowed(gain, x, y, wavelength, height_scale, self.window(x, y), active)

    def window(
        self, x: mi.Float, y: mi.Float, stretch_x: mi.Float = 1.0, stretch_y: mi.Float = 1.0
    ) -> Callable[[mi.Int32, mi.Int32], mi.Float]:
        """Return φ of the texels m, with distances along x and y scaled by the given factors."""
        # The height of a narrower window keeps the power of a flat mirror.
        height = self.sigma / float(np.sqrt(np.prod(self.sigmas)))
        scale_x, scale_y = (
            1 / (float(np.sqrt(2)) * sigma * size) for sigma, size in zip(self.sigmas, self.tile_size, strict=True)
        )

        def phi(m_x: mi.Int32, m_y: mi.Int32) -> mi.Float:
            d_x = (mi.Float(m_x) - x) * scale_x * stretch_x
            d_y = (mi.Float(m_y) - y) * scale_y * stretch_y
            return height * dr.exp(-dr.square(d_x) - dr.square(d_y))

        return phi

    def windowed(
        self,
        gain: Gain,
        x: mi.Float,
        y: mi.Float,
        wavelength: mi.Float,
        height_scale: mi.Float,
        window: Callable[[mi.Int32, mi.Int32], mi.Float],
        active: mi.Bool,
        radius: tuple[int, int] | None = None,
    ) -> mi.Float:
        """Return |Σ φ F|² or Σ φ² |F|² around the position (x, y)."""
        anchor = dr.floor if self.quirks.floor_anchor else dr.round
        # Clamping keeps the conversion in range; far outside the texture nothing is read.
        radius = self.radius if radius is None else radius
        first = tuple(mi.Int32(dr.clip(anchor(c), -1e6, 1e6)) - r for c, r in zip((x, y), radius, strict=True))
        kappa = -dr.two_pi * gain.w / wavelength * height_scale
        size = (2 * radius[0] + 1, 2 * radius[1] + 1)
        complex_sum, powers = self.textures.over(first, size, kappa, window, active)
        return complex_sum if self.quirks.complex_window_sum else powers
