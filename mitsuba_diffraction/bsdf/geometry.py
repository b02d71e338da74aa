"""Directions in their media, pairs of them, and one direction at one wavelength; the formulas are in `geometry.py`.

All lengths are in units that make the lateral scale of the relief one (`Scales` in `parameters.py`).

A coat and the flat face of a sheet are plane layers: they keep the tangential component of k = n ω and change the
normal one, so that what holds next to the relief follows from what holds outside. κ has a sign:
S(q; −κ) = S(−q; κ), so that tables for κ ≥ 0 serve, read at −q where κ < 0.

Where v_z → 0, as it may for transmitted light, K grows without bound and S(q; κ) falls as κ². For |κ| < κ₁ both are
taken together: v_z² is not less than that of κ₁, and the table gives κ₁²/κ² S (`orders.small_kappa`).
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .. import geometry
from .tables import larger, limited, smaller


# Not frozen: Dr.Jit rebuilds what enters a branch field by field.
@dataclass(eq=False)
class WaveVector:
    """k = n ω of a direction away from the relief, in units of 2π/λ, λ in the medium above everything.

    Attributes:
        tangent: k_∥, outside and next to the relief.
        square: k_z² outside.
        index: n outside.
        inner_index: n next to the relief, which differs under a coat and inside of a sheet.
        per_inner_index: its reciprocal.
        excess: n² there less n² outside.
        sign: 1 above, −1 below.
    """

    tangent: mi.Vector2f
    square: mi.Float
    index: mi.Float
    inner_index: mi.Float
    per_inner_index: mi.Float
    excess: mi.Float
    sign: mi.Float

    def normal(self, square: mi.Float) -> mi.Float:
        """Return |k_z| next to the relief, from k_z² outside."""
        # Above zero, where the root has a derivative.
        return dr.sqrt(larger(square + self.excess, 1e-12))

    @property
    def z(self) -> mi.Float:
        """k_z next to the relief, with its sign."""
        return self.sign * self.normal(self.square)

    def inner(self) -> mi.Vector3f:
        """Return the direction next to the relief, a unit vector."""
        return mi.Vector3f(*self.tangent, self.z) * self.per_inner_index


# Smallest probabilities of samples on either side: where they are tabulated; where they are those of a plane; of
# rigorous theory, as fine gratings are far from a plane.
MIN_TABULATED, MIN_OF_PLANE, MIN_OF_RIGOROUS = 0.05, 0.1, 0.2


class Interface:
    """The media above and below the relief.

    Attributes:
        coat_index: n of the medium next to the relief above, relative to the outside; one without a coat.
        eta: index below relative to that above; None where no light is transmitted.
        transmits: whether there is a medium below.
        is_sheet: it is a film with a flat lower face, with the upper medium below it.
        kappas: a quarter of the table's first interval of κ, where its error weighs as little as that of the line, and
            the smallest κ of the undiffracted order of the heights as they are; rad/µm. None of rigorous theory, whose
            tables are read at q whatever the sign of κ, and hold the flat face of a sheet; and in reflection.
        fraction: of light that is transmitted, for a direction along the pattern's axes, where orders are drawn from an
            `OrderSampler`; None of rigorous theory and where orders overlap, for which that of a plane serves.
    """

    def __init__(
        self,
        coat_index: mi.Float | float = 1.0,
        eta: mi.Float | None = None,
        is_sheet: bool = False,
        kappas: tuple[mi.Float, mi.Float] | None = None,
        fraction: Callable[[mi.Vector3f], mi.Float] | None = None,
    ) -> None:
        self.coat_index, self.transmits, self.is_sheet = mi.Float(coat_index), eta is not None, is_sheet
        self.kappas, self.fraction = kappas, fraction
        # Literals, so that in reflection Dr.Jit leaves out what concerns the medium below.
        self.eta = mi.Float(1.0) if eta is None else eta
        self.per_eta, self.excess = dr.rcp(self.eta), dr.square(self.eta) - 1
        self._per_coat, self._coat_excess = dr.rcp(self.coat_index), dr.square(self.coat_index) - 1

    def min_kappa(self, height_scale: mi.Float) -> mi.Float:
        """Return κ₁ in rad/µm: of the undiffracted order κ is larger at all wavelengths; 0 if it does not matter."""
        if self.kappas is None:
            return mi.Float(0.0)
        first, undiffracted = self.kappas
        return smaller(first, undiffracted * dr.detach(height_scale))

    @property
    def kappa_has_sign(self) -> bool:
        """Whether tables are read at −q where κ is negative."""
        return self.kappas is not None

    @property
    def mirrors(self) -> bool:
        """Whether −q is drawn where κ is taken for negative: where orders overlap."""
        return self.kappa_has_sign and self.fraction is None

    @property
    def has_flat_face(self) -> bool:
        """Whether there is a flat face beside the grating."""
        return self.is_sheet and self.kappas is not None

    def is_incident(self, cos: mi.Float) -> mi.Bool:
        """Return whether light of a direction is scattered."""
        return cos != 0 if self.transmits else cos > 0

    def wave_vector(self, omega: mi.Vector3f) -> WaveVector:
        """Return k of ω, along the same axes."""
        above = omega.z > 0 if self.transmits else mi.Bool(True)
        index = self._outer_index(above)
        return self._wave_vector(above, mi.Vector2f(omega.x, omega.y) * index, dr.square(omega.z * index))

    def _outer_index(self, above: mi.Bool) -> mi.Float:
        return mi.Float(1.0) if self.is_sheet else dr.select(above, mi.Float(1), self.eta)

    def _wave_vector(self, above: mi.Bool, tangent: mi.Vector2f, square: mi.Float) -> WaveVector:
        of_medium = (self.coat_index, self.eta), (self._per_coat, self.per_eta)
        inner, per_inner = (dr.select(above, upper, lower) for upper, lower in of_medium)
        excess = dr.select(above, self._coat_excess, self.excess if self.is_sheet else 0)
        sign = dr.select(above, mi.Float(1), -1)
        return WaveVector(tangent, square, self._outer_index(above), inner, per_inner, excess, sign)

    def scattered(self, k_i: WaveVector, reflects: mi.Bool) -> WaveVector:
        """Return k of the medium into which light of `k_i` is scattered; its direction is that without a grating."""
        return self._wave_vector((k_i.sign > 0) == reflects, -k_i.tangent, k_i.square)

    def transmission_probability(self, omega: mi.Vector3f) -> mi.Float:
        """Return the probability of a transmitted sample, about the fraction of light; ω along the pattern's axes."""
        if self.fraction is not None:
            return limited(self.fraction(omega), MIN_TABULATED, 1 - MIN_TABULATED)
        # Inside of a sheet there is no total reflection.
        reflected = mi.fresnel(dr.abs(omega.z) if self.is_sheet else omega.z, self.eta)[0]
        least = MIN_OF_RIGOROUS if self.kappas is None else MIN_OF_PLANE
        return limited(1 - reflected, least, 1 - least)

    def flat(self, omega: mi.Vector3f) -> mi.Float:
        """Return the transmittance of the flat face of a sheet, one above."""
        through = 1 - mi.fresnel(dr.abs(omega.z), self.eta)[0]
        return dr.select(omega.z > 0, 1, through)


@dataclass(eq=False)
class Geometry:
    """What a pair of directions fixes, whatever the surface. All angles are to the macroscopic normal, z.

    Attributes:
        incident, outgoing: k_i and k_o.
        reflects: whether both lie on one side.
        v_z: of v = k_i + k_o.
        flip: the sign of κ; one where it does not matter.
        tangent: λq where κ > 0, else −λq: where the table is read.
        height_scale: times the heights.
        shadowing: whether G is a factor.
        min_kappa: κ₁ in rad/µm.
        coat_index: as of `Interface`.
    """

    incident: WaveVector
    outgoing: WaveVector
    reflects: mi.Bool
    v_z: mi.Float
    flip: mi.Float
    tangent: mi.Vector2f
    height_scale: mi.Float
    shadowing: bool
    min_kappa: mi.Float
    coat_index: mi.Float

    @classmethod
    def of(
        cls,
        k_i: WaveVector,
        k_o: WaveVector,
        interface: Interface,
        height_scale: mi.Float | float = 1.0,
        shadowing: bool = True,
    ) -> Geometry:
        """Return that of two wave vectors of `interface`."""
        v_z, along = k_i.z + k_o.z, k_i.tangent + k_o.tangent
        flip = dr.select(v_z < 0, mi.Float(-1), 1) if interface.kappa_has_sign else mi.Float(1.0)
        height_scale = mi.Float(height_scale)
        return cls(
            *(k_i, k_o, k_i.sign == k_o.sign, v_z, flip, -flip * along, height_scale, shadowing),
            *(interface.min_kappa(height_scale), interface.coat_index),
        )

    @property
    def factor(self) -> mi.Float:
        """n_o² |cos θ_o| outside: q has the density λ² per that in solid angle."""
        return self.outgoing.index * dr.sqrt(self.outgoing.square)

    def kappa(self, frequency: mi.Float) -> mi.Float:
        """Return |κ| in rad/µm; `frequency` is 1/λ."""
        return dr.abs(self.v_z) * dr.two_pi * frequency * self.height_scale

    def small(self) -> tuple[mi.Float, mi.Bool]:
        """Return κ₁, and where the table is read with it."""
        return self.min_kappa, ~self.reflects

    def cosines(self) -> tuple[mi.Float, mi.Float]:
        """Return |cos θ_i| and |cos θ_o| next to the relief."""
        return tuple(k.normal(k.square) * k.per_inner_index for k in (self.incident, self.outgoing))

    def cos_half(self) -> mi.Float:
        """Return ω_i·h, negative from below, as `mi.fresnel` takes it."""
        k_i = self.incident
        square = dr.squared_norm(self.tangent) + dr.square(self.v_z)
        cos = 0.5 * dr.abs(square + self._excess) * dr.rsqrt(larger(square, 1e-12)) * k_i.per_inner_index
        return k_i.sign * smaller(cos, 1)

    @property
    def _excess(self) -> mi.Float:
        """n_i² − n_o² next to the relief."""
        of_pair = dr.square(self.incident.inner_index) - dr.square(self.outgoing.inner_index)
        return dr.select(self.reflects, 0, of_pair)

    def order_factor(self, tangent: mi.Vector2f, incidence: Incidence, per_width: mi.Float) -> mi.Float:
        """Return n_o² K G |cos θ_o| of an order, times the gain Γ of its lobe.

        Args:
            tangent: λq of the order where κ > 0, else −λq.
            incidence: the wavelength.
            per_width: 1/(λσ_q).
        """
        squares, gain = self.of_order(self.flip * tangent, per_width)
        return self.k_g(*squares, dr.squared_norm(tangent), incidence) * gain * self.factor

    def order_kappa(self, tangent: mi.Vector2f, incidence: Incidence) -> mi.Float:
        """Return |κ| in rad/µm: of reflected light the pair's; of transmitted light the order's, as K is.

        K grows as 1/v_z² and the power falls as κ²: both have the same v_z.
        """
        (square_i, square_o), _ = self.of_order(self.flip * tangent, mi.Float(0))
        v_z = dr.select(self.reflects, self.v_z, self.incident.normal(square_i) - self.outgoing.normal(square_o))
        return dr.abs(v_z) * dr.two_pi * incidence.frequency * self.height_scale

    def continuum_factor(self, incidence: Incidence, per_width: mi.Float) -> mi.Float:
        """Return n_o² K G |cos θ_o| and gain where orders overlap, so that no single one is known.

        At grazing incidence the mirror order has nearly all of the power, and K grows without bound within its lobe.
        From cos θ = 0.2 down, and up to 4 σ_q from q = 0, S is taken for that of the mirror order, K G for one; from
        cos θ = 0.4 up, and from 5 σ_q on, K and G are those at q, and what lobes lose below the horizon they get from
        those outside.
        """
        square_i, square_o = self.incident.square, self.outgoing.square
        square = dr.squared_norm(self.tangent)
        mirror = limited((25 - square * dr.square(per_width)) / 9, 0, 1)
        mirror *= limited(2 - 5 * dr.sqrt(larger(larger(square_i, square_o), 1e-12)), 0, 1)
        _, gain = self.of_order(mi.Vector2f(0), per_width)
        of_pair = self.k_g(square_i, square_o, square, incidence)
        return dr.lerp(of_pair, gain, dr.select(self.reflects, mirror, 0)) * self.factor

    def of_order(self, change: mi.Vector2f, per_width: mi.Float) -> tuple[tuple[mi.Float, mi.Float], mi.Float]:
        """Return k_z² outside of both directions, and the gain, of the order that the pair sees in its lobe.

        The order sends ω_i near to ω_o, and ω_o near to ω_i: each k_z² is the mean of both, at the centre of the lobe
        that of the pair. Within the lobe K would vary with the directions, and grow without bound at grazing incidence;
        of the mirror order K G is one.

        The gain makes up for the part of the lobe below the horizon, and is zero where the order does not propagate.
        With σ the width of the lobe in direction cosines, x = cos² θ/2σ is the distance from the horizon in standard
        deviations. The gain is g(x_i) g(x_o), g as in `geometry.horizon_gain`, x_i the smaller one of ω_i and of the
        direction into which the order sends it, x_o likewise: it is reciprocal, and an order keeps its power from the
        direction on in which it emerges.

        Args:
            change: λq of the order.
            per_width: 1/(λσ_q).
        """
        i, o = self.incident, self.outgoing
        between = dr.square(o.index) - dr.square(i.index)
        sent_o = between + cos_square(i, change)
        sent_i = cos_square(o, change) - between
        x_i = 0.5 * per_width * smaller(i.square / i.index, sent_o / o.index)
        x_o = 0.5 * per_width * smaller(o.square / o.index, sent_i / i.index)
        gain = geometry.horizon_gain(x_i, dr.select) * geometry.horizon_gain(x_o, dr.select)
        gain = dr.select(smaller(sent_i, sent_o) > 0, gain, 0)
        return (0.5 * (i.square + sent_i), 0.5 * (o.square + sent_o)), gain

    def k_g(
        self, square_i: mi.Float, square_o: mi.Float, tangent_square: mi.Float, incidence: Incidence | None = None
    ) -> mi.Float:
        """Return K G from k_z² of both sides outside, and |v_∥|²; of transmitted light, at a wavelength."""
        # Without heights there is no diffracted light, even where v_z = 0.
        min_v_z = 0 if incidence is None else larger(self.min_kappa * incidence.per_kappa, 1e-6)
        k_iz, k_oz = self.incident.normal(square_i), self.outgoing.normal(square_o)
        return geometry.k_g(k_iz, k_oz, tangent_square, self._excess, self.reflects, self.shadowing, min_v_z, dr.select)


def cos_square(k: WaveVector, change: mi.Vector2f) -> mi.Float:
    """Return k_z² outside of the direction into which the order at λq = `change` sends k, in the same medium.

    Negative where it does not propagate. From k_z² of k, which n² − |k_∥ + λq|² would lose to rounding at grazing
    incidence.
    """
    return k.square - dr.dot(change, 2 * k.tangent + change)


@dataclass(eq=False)
class Incidence:
    """One wavelength from one direction, into one of the media; what samplers need of it.

    κ of reflected light is positive above and negative below; that of transmitted light is taken for negative, as it
    is of all but steeply diffracted light. Where it is negative and orders overlap, −q is drawn.

    Attributes:
        tangent: k_i,∥, or its opposite where −q is drawn.
        wavelength: λ in µm.
        frequency: 1/λ.
        lobe_scale: times the widths of lobes.
        coat_index: as of `Interface`.
        above: whether it is incident from above.
        reflects: whether it is reflected.
        index: n_i outside.
        radius: n_o/λ outside, to which |q| extends around that of −k_i,∥ where light propagates.
        cosine: √(1 − |k_i,∥|²/(n_o R)²), R the largest of |k_i,∥|/n_o.
        mirrored: what takes the q that is read to the one that was drawn, 1 or −1.
        square: n_o² − |k_i,∥|².
        height_scale: times the heights.
        per_kappa: |v_z| for one rad/µm.
        near: the smallest |v_z| of outgoing light with 0.7 to 1 of the k_z of the undiffracted order, and what is 1
            over the range.
        k_iz: |k_iz|.
        k_oz: |k_oz| of light along the horizon and along the normal, and what is 1 over that range.
    """

    tangent: mi.Vector2f
    wavelength: mi.Float
    frequency: mi.Float
    lobe_scale: mi.Float
    coat_index: mi.Float
    above: mi.Bool
    reflects: mi.Bool
    index: mi.Float
    radius: mi.Float
    cosine: mi.Float
    mirrored: mi.Float
    square: mi.Float
    height_scale: mi.Float
    per_kappa: mi.Float
    near: tuple[mi.Float, mi.Float]
    k_iz: mi.Float
    k_oz: tuple[mi.Float, mi.Float, mi.Float]

    def at(self, wavelength: mi.Float, lobe_scale: mi.Float | float = 1.0) -> Incidence:
        """Return that at another wavelength (µm) and with scaled lobes, from that at 1 µm."""
        frequency = dr.rcp(wavelength)
        return dataclasses.replace(
            self,
            wavelength=wavelength,
            frequency=frequency,
            lobe_scale=lobe_scale,
            radius=self.radius * frequency,
            per_kappa=self.per_kappa * wavelength,
        )

    @classmethod
    def of(
        cls,
        k_i: WaveVector,
        k_o: WaveVector,
        interface: Interface,
        height_scale: mi.Float | float = 1.0,
        flip: mi.Float | float = 1.0,
    ) -> Incidence:
        """Return that of k_i at a wavelength of 1 µm.

        Without gradients: what is drawn does not follow the parameters.

        Args:
            k_i: of the light.
            k_o: of the medium into which it is scattered, whatever its direction.
            interface: between the media.
            height_scale: times the heights.
            flip: the sign of κ of a pair that is evaluated; one where a direction is drawn.
        """
        reflects = k_i.sign == k_o.sign
        assumed = dr.select(reflects & (k_i.sign > 0), mi.Float(1), -1) if interface.mirrors else mi.Float(1.0)
        square = dr.square(k_o.index) - dr.square(k_i.index) + k_i.square
        max_ratio = mi.Float(1.0)
        if interface.transmits and not interface.is_sheet:
            max_ratio = larger(interface.eta, interface.per_eta)
        across = dr.squared_norm(k_i.tangent) / dr.square(k_o.index * max_ratio)
        snell = k_o.normal(larger(square, 0))
        undiffracted, steep = (dr.abs(k_i.z + k_o.sign * z) for z in (snell, 0.7 * snell))
        near = smaller(undiffracted, steep), dr.rcp(larger(dr.abs(undiffracted - steep), 1e-4))
        horizon, normal = k_o.normal(mi.Float(0)), k_o.inner_index
        values = (
            assumed * k_i.tangent,
            mi.Float(1.0),
            mi.Float(1.0),
            mi.Float(1.0),
            interface.coat_index,
            k_i.sign > 0,
            reflects,
            k_i.index,
            k_o.index,
            dr.safe_sqrt(1 - across),
            assumed * flip,
            square,
            mi.Float(height_scale),
            dr.rcp(larger(dr.two_pi * mi.Float(height_scale), 1e-30)),
            near,
            dr.abs(k_i.z),
            (horizon, normal, dr.rcp(larger(normal - horizon, 1e-3))),
        )
        return cls(*(dr.detach(value) for value in values))

    def below(self, kappa: mi.Float) -> mi.Float:
        """Return the fraction of light with less than κ (rad/µm).

        Reflected as by a diffuse surface; transmitted, half of it near the undiffracted order, half at any k_oz.
        """
        v_z, (horizon, normal, per) = kappa * self.per_kappa, self.k_oz
        low, per_near = self.near
        near = limited((v_z - low) * per_near, 0, 1)
        reflected = limited((v_z - self.k_iz - horizon) * per, 0, 1)
        highest, lowest = smaller(self.k_iz + v_z, normal), larger(self.k_iz - v_z, horizon)
        any_k_oz = limited((highest - lowest) * per, 0, 1)
        return dr.select(self.reflects, dr.square(reflected), 0.5 * (near + any_k_oz))

    def propagates(self, tangent: mi.Vector2f) -> mi.Bool:
        """Return whether the order at λq, as it is drawn, propagates."""
        return self.square - dr.dot(tangent, 2 * self.tangent + tangent) > 0


def turned(omega: mi.Vector3f, sin: mi.Float, cos: mi.Float) -> mi.Vector3f:
    """Return ω along the pattern's axes, from sine and cosine of the angle from the tangent to its x axis."""
    return mi.Vector3f(cos * omega.x + sin * omega.y, cos * omega.y - sin * omega.x, omega.z)


def on_square(omega: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """Return column and row of ω on the square of `energy/table.py`, from 0 to 1, on whichever side it is."""
    t = dr.sqrt(limited(1 - dr.sqrt(larger(1 - dr.abs(omega.z), 0)), 0, 1))
    along = (1 - t) / larger(dr.abs(omega.x) + dr.abs(omega.y), 1e-12)
    return tuple(0.5 * (1 + along * of) for of in (omega.x + omega.y, omega.x - omega.y))


def cell_of(x: mi.Float, count: mi.Float | int) -> tuple[mi.UInt32, mi.Float]:
    """Return the cell of x, 0 ≤ x ≤ count, and the coordinate in it; outside, the nearest."""
    x = limited(x, 0, count)
    cell = dr.minimum(mi.UInt32(x), mi.UInt32(count) - 1)
    return cell, x - mi.Float(cell)
