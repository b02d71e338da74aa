"""What a distribution over frequencies depends on: one wavelength, come in from one direction."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi


# Not frozen: Dr.Jit rebuilds what enters a branch field by field.
@dataclass(eq=False)
class Incidence:
    """One wavelength from one direction.

    Attributes:
        wi: ω_i along the axes of the pattern.
        frequency: 1/λ in cycles/µm.
        kappa_per_cosine: 2π/λ in rad/µm, times the scale of the heights.
    """

    wi: mi.Vector3f
    frequency: mi.Float
    kappa_per_cosine: mi.Float

    @classmethod
    def of(cls, wi: mi.Vector3f, frequency: mi.Float, height_scale: mi.Float) -> Incidence:
        """Without gradients: directions are drawn, and what is drawn does not follow the parameters."""
        kappa_per_cosine = dr.two_pi * frequency * height_scale
        return cls(*(dr.detach(value) for value in (wi, frequency, kappa_per_cosine)))
