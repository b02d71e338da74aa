"""What a distribution over frequencies depends on: one wavelength, come in from one direction."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .coat import Coat


# Not frozen: Dr.Jit rebuilds what enters a branch field by field.
@dataclass(eq=False)
class Incidence:
    """One wavelength from one direction.

    Attributes:
        wi: ω_i along the axes of the pattern, outside of a coat.
        frequency: 1/λ in cycles/µm, outside of a coat.
        index: n of the coat relative to the outside; one without.
        least_kappa: κ of light that leaves along the horizon, rad/µm.
        kappa_span: by how much κ is larger for light that leaves along the normal, rad/µm.
    """

    wi: mi.Vector3f
    frequency: mi.Float
    index: mi.Float
    least_kappa: mi.Float
    kappa_span: mi.Float

    @classmethod
    def of(cls, wi: mi.Vector3f, frequency: mi.Float, height_scale: mi.Float, coat: Coat | None = None) -> Incidence:
        """κ = 2π (cos θ_i + cos θ_o)/λ times the scale of the heights; under a coat, with what holds inside of it.

        Without gradients: directions are drawn, and what is drawn does not follow the parameters.
        """
        kappa_per_cosine = dr.two_pi * frequency * height_scale
        least, span = kappa_per_cosine * wi.z, kappa_per_cosine
        index = mi.Float(1.0) if coat is None else coat.eta
        if coat is not None:
            critical = dr.sqrt(1 - dr.rcp(dr.square(coat.eta)))
            kappa_per_cosine *= coat.relative
            least = kappa_per_cosine * (coat.refracted(wi).z + critical)
            span = kappa_per_cosine * (1 - critical)
        return cls(*(dr.detach(value) for value in (wi, frequency, index, least, span)))
