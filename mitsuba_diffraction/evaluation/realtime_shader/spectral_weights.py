"""Colour weights at run time: the contribution of each wavelength to XYZ."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike

from ...bsdf.tables import PacketTable
from .gain import PUBLISHED_R0
from .quirks import Quirks
from .tristimulus import LONGEST, SHORTEST, d65_weights, light_weights, wavelengths


class SpectralWeights:
    """A table of (X, Y, Z, R₀) with one entry per nm, read with linear interpolation (algorithm 4.3, line 5)."""

    def __init__(
        self,
        quirks: Quirks,
        peak: float,
        *,
        r_0: ArrayLike = PUBLISHED_R0,
        light: ArrayLike | None = None,
    ) -> None:
        """Build the table.

        For the irradiance E(λ) per nm and the relative radiance ρ(λ), the colour is ∫ ρ E (x̄, ȳ, z̄) dλ / ∫ȳ dλ.
        Absolute radiance has the additional factor R₀ S(0)/λ², where S(0) is the density of a flat surface at q = 0.

        Args:
            quirks: `fixed_index`, `d65_light` and `relative` apply.
            peak: S(0) of a flat surface, µm².
            r_0: power reflectance at normal incidence, one number or (401,) at `tristimulus.wavelengths`.
            light: spectrum of the light, (401,); default: D65 with Y = 1.
        """
        weights = d65_weights() if light is None else light_weights(light)
        self.luminance = 1.0 if light is None else float(np.trapezoid(weights[:, 1]))
        if quirks.d65_light:
            weights = d65_weights() * self.luminance
        r_0 = PUBLISHED_R0 if quirks.fixed_index else r_0
        r_0 = np.broadcast_to(np.asarray(r_0, np.float64), wavelengths().shape)
        if not quirks.relative:
            weights = weights * (r_0 * peak / (wavelengths() * 1e-3) ** 2)[:, None]
        self.table = PacketTable(np.concatenate([weights, r_0[:, None]], axis=1))

    def __call__(self, wavelength: mi.Float, active: mi.Bool) -> tuple[mi.Color3f, mi.Float]:
        """Return (X, Y, Z) per nm, and R₀, at a wavelength in nm; zero outside 380 to 780 nm."""
        active = active & (wavelength >= SHORTEST - 1e-3) & (wavelength <= LONGEST + 1e-3)
        value = interpolated(self.table, wavelength - SHORTEST, int(LONGEST - SHORTEST), active)
        return mi.Color3f(value.x, value.y, value.z), value.w


def interpolated(table: PacketTable, place: mi.Float, last: int, active: mi.Bool) -> mi.Vector4f:
    """Return packets 0 … `last` of a table, linear at `place`, constant beyond the ends, and zero if not `active`."""
    place = dr.clip(place, 0, last)
    index = mi.UInt32(dr.minimum(place, last - 1))
    below, above = table(index, active), table(index + 1, active)
    return below + (place - mi.Float(index)) * (above - below)
