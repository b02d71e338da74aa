"""The linear RGB of the shader on a display, and spectra that represent the displayed colour."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np

from ...bsdf.tables import PacketTable
from .base import interpolated
from .tristimulus import EMISSION, primary_spectra


def with_power_gamma(rgb: mi.Color3f) -> mi.Color3f:
    """Return the linear sRGB that an sRGB display (IEC 61966-2-1) emits for linear RGB encoded by a power of 1/2.5."""
    encoded = dr.power(dr.maximum(rgb, 0), 1 / 2.5)
    return dr.select(encoded <= 0.04045, encoded / 12.92, dr.power((encoded + 0.055) / 1.055, 2.4))


class Emission:
    """A spectrum of given linear sRGB: Σ_c RGB_c b_c(λ), with b_c from `tristimulus.primary_spectra`."""

    def __init__(self) -> None:
        spectra = primary_spectra()
        self.table = PacketTable(np.concatenate([spectra, np.zeros((len(spectra), 1))], axis=1))

    def __call__(self, rgb: mi.Color3f, wavelengths: mi.UnpolarizedSpectrum, active: mi.Bool) -> mi.UnpolarizedSpectrum:
        """Evaluate the spectrum, per nm, at the wavelengths of a ray, in nm."""
        result = mi.UnpolarizedSpectrum(0)
        first, spacing = float(EMISSION[0]), float(EMISSION[1] - EMISSION[0])
        for channel in range(len(result)):
            b = interpolated(self.table, (wavelengths[channel] - first) / spacing, EMISSION.size - 1, active)
            result[channel] = rgb.x * b.x + rgb.y * b.y + rgb.z * b.z
        return result
