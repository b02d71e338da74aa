"""How far the colours of light are from those of a target, hue and chroma before lightness, and the gradient.

C = k Σ_λ P_λ M_λ                 linear sRGB of light in a bin (`lamp_to_linear_sRGB`), of the target at most 1
k                                 luminance of the target over that of the light: both are equally bright
(L, a, b) = N ∛(S C + ε)          Oklab (Ottosson 2020); ε bounds the gradient in the dark
L_c = mean ΔL² + 8 (Δa² + Δb²)    over the bins

One relief cannot give all wavelengths the light that they should have. Where their errors count alike, colours mix to
grey; here light is left out, or is brighter or darker than wanted, before it has another hue.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from ..array_types import Real
from ..optics.color import LMS_TO_OKLAB, SRGB_TO_LMS, SRGB_TO_XYZ, lamp_to_linear_sRGB

_WEIGHTS = np.array([1.0, 8.0, 8.0])  # of L, a and b
_DARK = 0.01  # ε
_LUMINANCE = SRGB_TO_XYZ[1]


@dataclass(frozen=True, eq=False)
class ColourDistance:
    """L_c of light.

    Attributes:
        matrix: M, (w, 3).
        target: C of the target, (bins, bins, 3).
    """

    matrix: Real
    target: Real

    @classmethod
    def of(cls, wanted: Real, wavelengths: Real) -> ColourDistance:
        """Return the distance from the wanted light, (w, bins, bins), of wavelengths in nm."""
        matrix = lamp_to_linear_sRGB(wavelengths)
        target = np.moveaxis(wanted, 0, -1) @ matrix
        return cls(matrix / target.max(), target / target.max())

    def __call__(self, light: Real) -> tuple[float, Real]:
        """Return L_c and ∂L_c/∂P at the light P, (w, bins, bins)."""
        seen = np.moveaxis(light, 0, -1) @ self.matrix
        bright = (seen @ _LUMINANCE).sum()
        k = (self.target @ _LUMINANCE).sum() / bright
        roots, found = self._roots(k * seen), self._roots(self.target)
        difference = (roots - found) @ LMS_TO_OKLAB.T
        value = float((_WEIGHTS * difference**2).sum() / (difference.size / 3))
        of_roots = (2 * _WEIGHTS * difference / (difference.size / 3)) @ LMS_TO_OKLAB
        is_bounded = roots**3 > 1.001 * _DARK / 2
        of_seen = np.where(is_bounded, of_roots / (3 * roots**2), 0.0) @ SRGB_TO_LMS
        of_seen = k * (of_seen - _LUMINANCE * ((of_seen * seen).sum() / bright))
        return value, np.moveaxis(of_seen @ self.matrix.T, -1, 0)

    @staticmethod
    def _roots(rgb: Real) -> Real:
        # Light outside of the gamut has negative components.
        return np.cbrt(np.maximum(rgb @ SRGB_TO_LMS.T, -_DARK / 2) + _DARK)
