"""The gain factor of the shader: Fresnel, Stam's geometry factor, V-cavity shadowing (eq. 3.10)."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from ...bsdf.geometry import Geometry

PUBLISHED_R0 = 0.04  # an index of 1.5, close to that of snake skin


def schlick_falloff(cos_half: mi.Float) -> mi.Float:
    """Return (1 − ω_o·h)⁵ (Schlick 1994; eq. B.1): F = R₀ + (1 − R₀)(1 − ω_o·h)⁵."""
    away = 1 - cos_half
    return dr.square(dr.square(away)) * away


def fresnel_ratio(r_0: mi.Float, falloff: mi.Float, squared: bool) -> mi.Float:
    """Return F(ω_o·h)/F(1), or its square."""
    ratio = (r_0 + (1 - r_0) * falloff) / r_0
    return dr.square(ratio) if squared else ratio


class Gain:
    """C(ω_i, ω_o) without F and with shadowing: the factors independent of wavelength.

    Relative to a flat mirror at normal incidence,

        C = F(ω_i·h)/F(1) · (1 + ω_i·ω_o)²/((cos θ_i + cos θ_o)² cos θ_o),

    which is K cos θ_i of the BRDF (`bsdf/geometry.py`), and G = min(1, 2(n·h)(n·ω_o)/(ω_o·h), 2(n·h)(n·ω_i)/(ω_o·h))
    (Torrance and Sparrow 1967).

    Attributes:
        falloff: `schlick_falloff`.
        factor: K G cos θ_i; zero below the horizon.
        active: both directions are in the upper hemisphere.
    """

    def __init__(self, wi: mi.Vector3f, wo: mi.Vector3f, shadowing: bool, active: mi.Bool) -> None:
        # K and G are symmetric: exchanging the directions turns K G cos θ_o into K G cos θ_i.
        geometry = Geometry.of(wo, wi, shadowing=shadowing)
        self.active = active & geometry.reflects()
        self.falloff = schlick_falloff(geometry.cos_half())
        self.factor = dr.select(self.active, geometry.k_g() * geometry.cos_o, 0)
        (self.u, self.v), self.w = geometry.tangent, geometry.w
