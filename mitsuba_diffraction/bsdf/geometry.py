"""The geometry of Kirchhoff reflection: direction cosines, Stam's factor K, V-cavity shadowing G."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi

from .arithmetic import larger, smaller


class Geometry:
    """What a pair of directions fixes, whatever the surface. All angles are to the macroscopic normal, z.

    With (u, v, w) = −ω_i − ω_o and D = 1 + ω_i·ω_o = (u² + v² + w²)/2, the half vector h has

        ω_i·h = ω_o·h = √(D/2),    n·h = −w/√(2D)

    D is taken from the sum of squares: 1 + ω_i·ω_o cancels where both directions are grazing.
    """

    def __init__(self, wi: mi.Vector3f, wo: mi.Vector3f) -> None:
        self.cos_i = mi.Frame3f.cos_theta(wi)
        self.cos_o = mi.Frame3f.cos_theta(wo)
        self.u = -wi.x - wo.x
        self.v = -wi.y - wo.y
        self.w = -self.cos_i - self.cos_o
        self.d = 0.5 * (dr.square(self.u) + dr.square(self.v) + dr.square(self.w))

    def reflects(self) -> mi.Bool:
        """Both directions are above the surface."""
        return (self.cos_i > 0) & (self.cos_o > 0)

    def cos_half(self) -> mi.Float:
        """ω_i·h."""
        return dr.sqrt(0.5 * self.d)

    def factor(self, shadowing: bool) -> mi.Float:
        """K · G · cos θ_o.

        K = (1 + ω_i·ω_o)²/(cos θ_i cos θ_o w²) (Stam 1999) and, with `shadowing`,
        G = min(1, 2(n·h)(n·ω_o)/(ω_o·h), 2(n·h)(n·ω_i)/(ω_o·h)) (Torrance and Sparrow 1967), where
        2(n·h)(n·ω)/(ω_o·h) = −2w cos θ/D. Together they stay finite at grazing angles.
        """
        # cos θ_o cancels; the guard keeps masked lanes finite.
        k = dr.square(self.d) / (larger(self.cos_i, 1e-7) * dr.square(self.w))
        if not shadowing:
            return k
        return k * smaller(-2 * self.w * smaller(self.cos_i, self.cos_o) / self.d, 1)
