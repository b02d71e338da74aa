"""One wavelength from one direction, and pairs of directions: Stam's factor K, V-cavity shadowing G, the gain."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..geometry import HORIZON_GAIN
from .coat import Coat
from .tables import larger, limited, smaller


# Not frozen: Dr.Jit rebuilds what enters a branch field by field.
@dataclass(eq=False)
class Incidence:
    """One wavelength from one direction.

    Attributes:
        wi: ω_i along the axes of the pattern, outside of a coat.
        wavelength: λ in µm, outside of a coat.
        frequency: 1/λ in cycles/µm, outside of a coat.
        lateral_scale: times the lengths along the surface.
        index: n of the coat relative to the outside; one without.
        least_kappa: κ of light that leaves along the horizon, rad/µm.
        kappa_span: by how much κ is larger for light that leaves along the normal, rad/µm.
    """

    wi: mi.Vector3f
    wavelength: mi.Float
    frequency: mi.Float
    lateral_scale: mi.Float | float
    index: mi.Float
    least_kappa: mi.Float
    kappa_span: mi.Float

    mirrored = 1  # q is drawn as it is read

    @property
    def lateral_frequency(self) -> mi.Float:
        """q of the table per λq."""
        return self.frequency * self.lateral_scale

    @property
    def radius(self) -> mi.Float:
        """To which |q| of the table extends around that of light along the normal where it propagates, cycles/µm."""
        return self.lateral_frequency

    @property
    def cosine(self) -> mi.Float:
        """cos θ_i."""
        return self.wi.z

    def below(self, kappa: mi.Float) -> mi.Float:
        """Return the share of light with less than κ (rad/µm), if it is reflected as by a diffuse surface."""
        return dr.square(limited((kappa - self.least_kappa) / self.kappa_span, 0, 1))

    def propagates(self, tangent: mi.Vector2f) -> mi.Bool:
        """Return whether the order at (u, v) = λq propagates."""
        return cos_square(self.wi, tangent) > 0

    def at(self, wavelength: mi.Float) -> Incidence:
        """Return that at another wavelength (µm), from that at 1 µm."""
        wavelength = dr.detach(wavelength)
        frequency = dr.rcp(wavelength)
        least, span = self.least_kappa * frequency, self.kappa_span * frequency
        return Incidence(self.wi, wavelength, frequency, self.lateral_scale, self.index, least, span)

    @classmethod
    def of(
        cls,
        wi: mi.Vector3f,
        height_scale: mi.Float,
        coat: Coat | None = None,
        lateral_scale: mi.Float | float = 1.0,
    ) -> Incidence:
        """Return that at a wavelength of 1 µm; under a coat, with what holds inside of it.

        κ = 2π (cos θ_i + cos θ_o)/λ times the scale of the heights. Without gradients: directions are drawn, and what
        is drawn does not follow the parameters.
        """
        kappa_per_cosine = mi.Float(dr.two_pi * height_scale)
        least, span = kappa_per_cosine * wi.z, kappa_per_cosine
        index = mi.Float(1.0) if coat is None else coat.eta
        if coat is not None:
            critical = dr.sqrt(1 - dr.rcp(dr.square(coat.eta)))
            kappa_per_cosine *= coat.relative
            least = kappa_per_cosine * (coat.refracted(wi).z + critical)
            span = kappa_per_cosine * (1 - critical)
        values = wi, mi.Float(1.0), mi.Float(1.0), lateral_scale, index, least, span
        return cls(*(dr.detach(value) for value in values))


# Not frozen: Dr.Jit rebuilds what enters a branch field by field.
@dataclass(eq=False)
class Geometry:
    """What a pair of directions fixes, whatever the surface. All angles are to the macroscopic normal, z.

    Attributes:
        wi: ω_i along the pattern's axes, outside of a coat.
        wo: ω_o, likewise.
        cos_i: cos θ_i, inside of a coat.
        cos_o: cos θ_o, likewise.
        index: n of the coat relative to the outside; one without.
        height_scale: times the heights.
        shadowing: whether G is a factor.
        lateral_scale: times the lengths along the surface.
    """

    wi: mi.Vector3f
    wo: mi.Vector3f
    cos_i: mi.Float
    cos_o: mi.Float
    index: mi.Float
    height_scale: mi.Float
    shadowing: bool
    lateral_scale: mi.Float | float

    @classmethod
    def of(
        cls,
        wi: mi.Vector3f,
        wo: mi.Vector3f,
        coat: Coat | None = None,
        height_scale: mi.Float | float = 1.0,
        shadowing: bool = True,
        lateral_scale: mi.Float | float = 1.0,
    ) -> Geometry:
        """Return that of ω_i and ω_o, along the pattern's axes and outside of the coat."""
        cosines = (omega.z if coat is None else coat.refracted(omega).z for omega in (wi, wo))
        index = mi.Float(1.0) if coat is None else coat.eta
        return cls(wi, wo, *cosines, index, mi.Float(height_scale), shadowing, lateral_scale)

    @property
    def tangent(self) -> mi.Vector2f:
        """(u, v) = −(ω_i + ω_o)_t = λq, outside of a coat."""
        return mi.Vector2f(-self.wi.x - self.wo.x, -self.wi.y - self.wo.y)

    @property
    def w(self) -> mi.Float:
        """−(cos θ_i + cos θ_o)."""
        return -self.cos_i - self.cos_o

    def inside(self) -> tuple[mi.Vector3f, mi.Vector3f]:
        """Return ω_i and ω_o inside of the coat."""
        pairs = (self.wi, self.cos_i), (self.wo, self.cos_o)
        return tuple(mi.Vector3f(omega.x / self.index, omega.y / self.index, cos) for omega, cos in pairs)

    def kappa(self, frequency: mi.Float) -> mi.Float:
        """Return κ = 2π n (cos θ_i + cos θ_o)/λ times the scale of the heights; `frequency` is 1/λ outside."""
        return -self.w * dr.two_pi * self.index * frequency * self.height_scale

    def cos_half(self) -> mi.Float:
        """Return ω_i·h = ω_o·h = √(D/2)."""
        return dr.sqrt(0.5 * _d(dr.squared_norm(self.tangent) / dr.square(self.index), self.cos_i + self.cos_o))

    def k_g(self) -> mi.Float:
        """Return K G of the pair of directions."""
        square = dr.squared_norm(self.tangent) / dr.square(self.index)
        return k_g(self.cos_i, self.cos_o, square, self.shadowing)

    def small(self) -> None:
        """Return None: κ of reflected light is never too small for a table."""

    def cosines(self) -> tuple[mi.Float, mi.Float]:
        """Return cos θ_i and cos θ_o, inside of a coat."""
        return self.cos_i, self.cos_o

    def order_factor(self, tangent: mi.Vector2f, incidence: Incidence, per_width: mi.Float) -> mi.Float:
        """Return K G cos θ_o of an order, times the gain of its lobe.

        Args:
            tangent: (u, v) = λq of the order.
            incidence: the wavelength.
            per_width: 1/σ_q.
        """
        cos_i, cos_o, gain = self.of_order(tangent, incidence.frequency * per_width)
        square = dr.squared_norm(tangent) / dr.square(self.index)
        return k_g(cos_i, cos_o, square, self.shadowing) * gain * self.cos_o

    def order_kappa(self, tangent: mi.Vector2f, incidence: Incidence) -> mi.Float:
        """Return κ in rad/µm of the pair, whatever the order."""
        return self.kappa(incidence.frequency)

    def continuum_factor(self, incidence: Incidence, per_width: mi.Float) -> mi.Float:
        """Return K G cos θ_o and gain where orders overlap, so that no single one is known.

        At grazing incidence the mirror order has nearly all of the power, and K grows without bound within its lobe.
        From cos θ = 0.2 down, and up to 4 σ_q from q = 0, S is taken for that of the mirror order, K G for one; from
        cos θ = 0.4 up, and from 5 σ_q on, K and G are those at q, and what lobes lose below the horizon they get from
        those beyond.
        """
        per_width = incidence.frequency * per_width
        mirror = limited((25 - dr.squared_norm(self.tangent) * dr.square(per_width)) / 9, 0, 1)
        mirror *= limited(2 - 5 * larger(self.wi.z, self.wo.z), 0, 1)
        *_, gain = self.of_order(mi.Vector2f(0), per_width)
        return dr.lerp(self.k_g(), gain, mirror) * self.cos_o

    def of_order(self, tangent: mi.Vector2f, per_width: mi.Float) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Return cos θ_i, cos θ_o and gain of the order that the pair sees in its lobe.

        The order sends ω_i near to ω_o, and ω_o near to ω_i: the cosines, inside of a coat, are the root mean squares
        of both, at the centre of the lobe those of the pair. Within the lobe K would vary with the directions, and grow
        without bound at grazing incidence; of the mirror order K G is one.

        The gain makes up for the part of the lobe below the horizon, and is zero where the order does not propagate.
        With σ the width of the lobe in direction cosines, x = cos² θ/2σ is the distance from the horizon in standard
        deviations. The gain is g(x_i) g(x_o), g as in `geometry.horizon_gain`, x_i the smaller one of ω_i and of the
        direction into which the order sends it, x_o likewise: it is reciprocal, and an order keeps its power from the
        direction on in which it emerges.

        Args:
            tangent: (u, v) = λq of the order.
            per_width: 1/σ = 1/(λσ_q).
        """
        sent = [cos_square(omega, tangent) for omega in (self.wi, self.wo)]
        come = [dr.square(omega.z) for omega in (self.wi, self.wo)]
        x_i, x_o = (0.5 * per_width * smaller(there, back) for there, back in zip(sent, come, strict=True))
        gain = dr.select(smaller(*sent) > 0, horizon_gain(x_i) * horizon_gain(x_o), 0)
        outside = 0.5 * (come[0] + sent[1]), 0.5 * (come[1] + sent[0])
        # Where the order does not propagate the root would have no derivative.
        per = dr.rcp(dr.square(self.index))
        return *(dr.sqrt(larger(dr.fma(x, per, 1 - per), 1e-12)) for x in outside), gain


def turned(omega: mi.Vector3f, sin: mi.Float, cos: mi.Float) -> mi.Vector3f:
    """Return ω along the pattern's axes, from sine and cosine of the angle from the tangent to its x axis."""
    return mi.Vector3f(cos * omega.x + sin * omega.y, cos * omega.y - sin * omega.x, omega.z)


def on_square(omega: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """Return column and row of ω on the square of `energy/table.py`, from 0 to 1, on whichever side it is."""
    t = dr.sqrt(limited(1 - dr.sqrt(larger(1 - dr.abs(omega.z), 0)), 0, 1))
    along = (1 - t) / larger(dr.abs(omega.x) + dr.abs(omega.y), 1e-12)
    return tuple(0.5 * (1 + along * of) for of in (omega.x + omega.y, omega.x - omega.y))


def cell_of(x: mi.Float, count: mi.Float | int) -> tuple[mi.UInt32, mi.Float]:
    """Return the cell of x, 0 ≤ x ≤ count, and the place in it; outside, the nearest."""
    x = limited(x, 0, count)
    cell = dr.minimum(mi.UInt32(x), mi.UInt32(count) - 1)
    return cell, x - mi.Float(cell)


def _d(square: mi.Float, w: mi.Float) -> mi.Float:
    """Return D = 1 + ω_i·ω_o = (u² + v² + w²)/2, from u² + v².

    As a sum of squares: 1 + ω_i·ω_o cancels where both directions are grazing.
    """
    return 0.5 * (square + dr.square(w))


def k_g(cos_i: mi.Float, cos_o: mi.Float, square: mi.Float, shadowing: bool) -> mi.Float:
    """Return K G.

    K = D²/(cos θ_i cos θ_o w²) (Stam 1999) and, with `shadowing`,
    G = min(1, 2(n·h)(n·ω_o)/(ω_o·h), 2(n·h)(n·ω_i)/(ω_o·h)) (Torrance and Sparrow 1967), where
    2(n·h)(n·ω)/(ω_o·h) = 2w cos θ/D, with w = cos θ_i + cos θ_o.

    Args:
        cos_i: cos θ_i.
        cos_o: cos θ_o.
        square: u² + v².
        shadowing: if false, K alone.
    """
    # The guards keep masked lanes finite.
    cos_i, cos_o = larger(cos_i, 1e-7), larger(cos_o, 1e-7)
    w, product = cos_i + cos_o, cos_i * cos_o
    d = _d(square, w)
    per = dr.rcp(product * w)
    # K = D/(cos θ_i cos θ_o w) · D/w and K G ≤ D/(cos θ_i cos θ_o w) · 2 min(cos θ_i, cos θ_o)
    ratio = d * product * per
    return d * per * (smaller(ratio, 2 * smaller(cos_i, cos_o)) if shadowing else ratio)


def cos_square(omega: mi.Vector3f, tangent: mi.Vector2f) -> mi.Float:
    """Return cos² θ of the direction into which the order at (u, v) = λq sends ω; negative where it does not propagate.

    From cos² θ of ω, which 1 − |ω_t + λq|² would lose to rounding at grazing incidence.
    """
    change = tangent.x * (2 * omega.x + tangent.x) + tangent.y * (2 * omega.y + tangent.y)
    return dr.square(omega.z) - change


def horizon_gain(x: mi.Float) -> mi.Float:
    """Return g(x) of `geometry.horizon_gain`."""
    t = larger(dr.fma(-0.25, x, 1), 0)
    result = mi.Float(HORIZON_GAIN[-1])
    for coefficient in HORIZON_GAIN[-2::-1]:
        result = dr.fma(result, t, coefficient)
    return dr.fma(dr.square(t), result, 1)
