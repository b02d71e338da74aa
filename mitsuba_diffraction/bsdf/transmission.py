"""Light that passes a dielectric relief: pairs of directions on either side of it, and one direction with its sampler.

Media of index n_i, where ω_i lies, and n_o, both directions away from the surface, k = n ω their wave vectors in units
of 2π/λ and v = k_i + k_o:

    q = −v_∥/λ,    κ = 2π v_z/λ,    K = |k_i·v| |k_o·v| / (|k_i,z| |k_o,z| v_z²),    k_i·v = (|v|² + n_i² − n_o²)/2

holds for reflection (n_i = n_o: the K of `geometry.py`) and for transmission alike (cf. Walter et al. 2007). κ has a
sign: S(q; −κ) = S(−q; κ), so that tables for κ ≥ 0 serve, read at −q where κ < 0. Light passes only if
|v|² < |n_i² − n_o²|: beyond, no facet refracts ω_i into ω_o, and at the limit F = 1. Of transmitted light

    G = min(1, 2 cos θ_i/|ω_i·h|, 2 cos θ_o/|ω_o·h|)²

takes orders to zero as cos θ at the horizon, as rigorous ones go; the shadows of V-cavities, with h_z in them, would
take away light that is there where v_z is small.

Where v_z → 0 the factor K grows without bound and S(q; κ) falls as κ². For |κ| < κ₁ both are taken together: v_z² is
not less than that of κ₁, and the table gives κ₁²/κ² S (`orders.small_kappa`).

Of a sheet the lower face is flat, and outside of it there is the medium above once more: tangential components are
those outside, normal components those inside.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from .geometry import horizon_gain
from .tables import larger, limited, smaller


# Not frozen: Dr.Jit rebuilds what enters a branch field by field.
@dataclass(eq=False)
class Side:
    """A direction and the media on its side, indices relative to the medium above.

    Attributes:
        tangent: k_∥.
        square: k_z² outside.
        outside: n outside.
        inside: n next to the relief; they differ below a sheet.
        per_inside: 1/n there.
        excess: n² there less n² outside.
        sign: 1 above, −1 below.
    """

    tangent: mi.Vector2f
    square: mi.Float
    outside: mi.Float
    inside: mi.Float
    per_inside: mi.Float
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


# Of the samples, on either side: where the share is tabulated; where it is that of a plane; of rigorous theory, as fine
# gratings are far from a plane.
LEAST_TABULATED, LEAST_PLANE, LEAST_RIGOROUS = 0.05, 0.1, 0.2


class Interface:
    """The relief between two media, or on one face of a sheet.

    Attributes:
        eta: index below relative to that above.
        is_sheet: the medium above is below the sheet, too.
        kappas: a quarter of the table's first interval of κ, where its error weighs as little as that of the line, and
            the least κ of the undiffracted order of the heights as they are; rad/µm. None of rigorous theory, whose
            tables are read at q whatever the sign of κ, and hold the flat face of a sheet.
        share: of samples that pass, for a direction along the pattern's axes, where orders are drawn from an
            `OrderTable`; None of rigorous theory and where orders overlap, for which that of a plane serves.
    """

    def __init__(
        self,
        eta: mi.Float,
        is_sheet: bool,
        kappas: tuple[mi.Float, mi.Float] | None = None,
        share: Callable[[mi.Vector3f], mi.Float] | None = None,
    ) -> None:
        self.eta, self.is_sheet, self.kappas, self.share = eta, is_sheet, kappas, share
        self.per_eta, self.excess = dr.rcp(eta), dr.square(eta) - 1

    def least_kappa(self, height_scale: mi.Float) -> mi.Float | None:
        """Return κ₁ in rad/µm: of the undiffracted order κ is larger at all wavelengths; None of rigorous theory."""
        if self.kappas is None:
            return None
        first, undiffracted = self.kappas
        return smaller(first, undiffracted * dr.detach(height_scale))

    @property
    def mirrors(self) -> bool:
        """Whether −q is drawn where κ is taken for negative: where orders overlap."""
        return self.kappas is not None and self.share is None

    @property
    def has_flat_face(self) -> bool:
        """Whether there is a flat face beside the grating."""
        return self.is_sheet and self.kappas is not None

    def side(self, omega: mi.Vector3f) -> Side:
        """Return the side on which ω lies."""
        above = omega.z > 0
        outside = mi.Float(1.0) if self.is_sheet else dr.select(above, 1, self.eta)
        return self._side(above, mi.Vector2f(omega.x, omega.y) * outside, dr.square(omega.z * outside))

    def _side(self, above: mi.Bool, tangent: mi.Vector2f, square: mi.Float) -> Side:
        inside, per_inside = dr.select(above, 1, self.eta), dr.select(above, 1, self.per_eta)
        outside = mi.Float(1.0) if self.is_sheet else inside
        excess = dr.select(above, 0, self.excess) if self.is_sheet else mi.Float(0.0)
        return Side(tangent, square, outside, inside, per_inside, excess, dr.select(above, mi.Float(1), -1))

    def other(self, side: Side, reflects: mi.Bool) -> Side:
        """Return where light from `side` goes, without the direction."""
        return self._side((side.sign > 0) == reflects, -side.tangent, side.square)

    def transmitted(self, omega: mi.Vector3f) -> mi.Float:
        """Estimate which share of scattered light is transmitted, for samples; ω along the pattern's axes."""
        if self.share is not None:
            return limited(self.share(omega), LEAST_TABULATED, 1 - LEAST_TABULATED)
        # Inside of a sheet there is no total reflection.
        reflected = mi.fresnel(dr.abs(omega.z) if self.is_sheet else omega.z, self.eta)[0]
        least = LEAST_RIGOROUS if self.kappas is None else LEAST_PLANE
        return limited(1 - reflected, least, 1 - least)

    def flat(self, omega: mi.Vector3f) -> mi.Float:
        """Return the transmittance of the flat face of a sheet, one above."""
        through = 1 - mi.fresnel(dr.abs(omega.z), self.eta)[0]
        return dr.select(omega.z > 0, 1, through)


@dataclass(eq=False)
class Crossing:
    """A pair of directions on the same or on both sides; with the methods of `geometry.Geometry`.

    Attributes:
        i, o: the sides of ω_i and ω_o.
        reflects: whether both directions lie on one side.
        w: v_z.
        flip: the sign of κ, or one where it does not matter.
        tangent: λq where κ > 0, else −λq: where the table is read.
        outgoing: n_o² |cos θ_o| outside.
        height_scale: times the heights.
        shadowing: whether G is a factor.
        least_kappa: κ₁ in rad/µm, or None, as of `Interface`.
        lateral_scale: times the lengths along the surface.
    """

    i: Side
    o: Side
    reflects: mi.Bool
    w: mi.Float
    flip: mi.Float
    tangent: mi.Vector2f
    outgoing: mi.Float
    height_scale: mi.Float
    shadowing: bool
    least_kappa: mi.Float | None
    lateral_scale: mi.Float | float

    index = 1.0  # of the wavelengths that are handed to E, those above

    @classmethod
    def of(
        cls,
        i: Side,
        o: Side,
        height_scale: mi.Float,
        shadowing: bool,
        least_kappa: mi.Float | None,
        lateral_scale: mi.Float | float = 1.0,
    ) -> Crossing:
        """Return that of directions on two sides."""
        w, along = i.z + o.z, i.tangent + o.tangent
        flip = mi.Float(1.0) if least_kappa is None else dr.select(w < 0, mi.Float(-1), 1)
        values = i.sign == o.sign, w, flip, -flip * along, o.outside * dr.sqrt(o.square)
        return cls(i, o, *values, height_scale, shadowing, least_kappa, lateral_scale)

    def kappa(self, frequency: mi.Float) -> mi.Float:
        """Return |κ| in rad/µm; `frequency` is 1/λ above."""
        return dr.abs(self.w) * dr.two_pi * frequency * self.height_scale

    def small(self) -> tuple[mi.Float, mi.Bool]:
        """Return κ₁, and where the table is read with it."""
        return self.least_kappa, ~self.reflects if dr.is_jit_v(mi.Float) else not self.reflects

    def cosines(self) -> tuple[mi.Float, mi.Float]:
        """Return |cos θ_i| and |cos θ_o| next to the relief."""
        return tuple(side.normal(side.square) * side.per_inside for side in (self.i, self.o))

    def cos_half(self) -> mi.Float:
        """Return ω_i·h, negative from below, as `mi.fresnel` takes it."""
        square = dr.squared_norm(self.tangent) + dr.square(self.w)
        along = 0.5 * (square + dr.square(self.i.inside) - dr.square(self.o.inside))
        cos = dr.abs(along) * dr.rsqrt(larger(square, 1e-12)) * self.i.per_inside
        return self.i.sign * smaller(cos, 1)

    def inside(self) -> tuple[mi.Vector3f, mi.Vector3f]:
        """Return ω_i and ω_o next to the relief."""
        return tuple(mi.Vector3f(*side.tangent, side.z) * side.per_inside for side in (self.i, self.o))

    def order_factor(self, tangent: mi.Vector2f, incidence: CrossingIncidence, per_width: mi.Float) -> mi.Float:
        """Return n_o² K G |cos θ_o| of an order, times the gain of its lobe, as `Geometry.order_factor`.

        Args:
            tangent: λq of the order where κ > 0, else −λq.
            incidence: the wavelength.
            per_width: 1/σ_q.
        """
        squares, gain = self.of_order(self.flip * tangent, incidence.frequency * per_width)
        return self._k_g(*squares, dr.squared_norm(tangent), incidence) * gain * self.outgoing

    def order_kappa(self, tangent: mi.Vector2f, incidence: CrossingIncidence) -> mi.Float:
        """Return |κ| in rad/µm: the pair's of reflected light, and the order's, as K is, of light that passes.

        K grows as 1/v_z² and the power falls as κ²: both have the same v_z.
        """
        (square_i, square_o), _ = self.of_order(self.flip * tangent, incidence.frequency)
        v_z = dr.select(self.reflects, self.w, self.i.normal(square_i) - self.o.normal(square_o))
        return dr.abs(v_z) * dr.two_pi * incidence.frequency * self.height_scale

    def continuum_factor(self, incidence: CrossingIncidence, per_width: mi.Float) -> mi.Float:
        """Return n_o² K G |cos θ_o| and gain where orders overlap, as `Geometry.continuum_factor`."""
        square, per_width = dr.squared_norm(self.tangent), incidence.frequency * per_width
        mirror = limited((25 - square * dr.square(per_width)) / 9, 0, 1)
        most = larger(self.i.square, self.o.square)
        mirror *= dr.select(self.reflects, limited(2 - 5 * dr.sqrt(larger(most, 1e-12)), 0, 1), 0)
        _, gain = self.of_order(mi.Vector2f(0), per_width)
        of_pair = self._k_g(self.i.square, self.o.square, square, incidence)
        return dr.lerp(of_pair, gain, mirror) * self.outgoing

    def of_order(self, change: mi.Vector2f, per_width: mi.Float) -> tuple[tuple[mi.Float, mi.Float], mi.Float]:
        """Return k_z² of both sides in the middle of the lobe, and its gain, as `Geometry.of_order`.

        Args:
            change: λq of the order.
            per_width: 1/(λσ_q).
        """
        i, o = self.i, self.o
        between = dr.square(o.outside) - dr.square(i.outside)
        sent_o = between + i.square - dr.dot(change, 2 * i.tangent + change)
        sent_i = o.square - between - dr.dot(change, 2 * o.tangent + change)
        x_i = 0.5 * per_width * smaller(i.square / i.outside, sent_o / o.outside)
        x_o = 0.5 * per_width * smaller(o.square / o.outside, sent_i / i.outside)
        gain = dr.select(smaller(sent_i, sent_o) > 0, horizon_gain(x_i) * horizon_gain(x_o), 0)
        return (0.5 * (i.square + sent_i), 0.5 * (o.square + sent_o)), gain

    def _k_g(self, square_i: mi.Float, square_o: mi.Float, along: mi.Float, incidence: CrossingIncidence) -> mi.Float:
        """Return K G from k_z² of both sides outside, and |v_∥|²."""
        z_i, z_o = self.i.normal(square_i), self.o.normal(square_o)
        w = dr.abs(dr.select(self.reflects, z_i + z_o, z_i - z_o))
        between = dr.square(self.i.inside) - dr.square(self.o.inside)
        length = along + dr.square(w)
        along_i, along_o = 0.5 * dr.abs(length + between), 0.5 * dr.abs(length - between)
        product = along_i * along_o
        # Without heights there is no diffracted light, even where v_z = 0.
        least = larger(self.least_kappa * incidence.per_kappa, 1e-6)
        result = product * dr.rcp(z_i * z_o * dr.square(dr.select(self.reflects, w, larger(w, least))))
        if self.shadowing:
            # 2 h_z cos θ/|ω·h| of reflected light, (2 cos θ/|ω·h|)² of transmitted.
            ratio = 2 * smaller(z_i * along_o, z_o * along_i) * dr.rcp(larger(product, 1e-18))
            result *= smaller(1, ratio * dr.select(self.reflects, w, length * ratio))
        return dr.select(self.reflects | (length < dr.abs(between)), result, 0)


@dataclass(eq=False)
class CrossingIncidence:
    """One wavelength from one direction that is reflected or passes; with what samplers ask of `geometry.Incidence`.

    κ of reflected light is positive above and negative below; that of transmitted light is taken for negative, as it
    is of all but steeply diffracted light. Where it is negative and orders overlap, −q is drawn.

    Attributes:
        wi: k_i,∥, or its opposite where −q is drawn; |cos θ_i| outside.
        wavelength: λ above, µm.
        frequency: 1/λ above.
        lateral_scale: times the lengths along the surface.
        above: whether it comes from above.
        index: n_i outside.
        radius: n_o times that, to which |q| of the table extends around that of −k_i,∥ where light propagates.
        cosine: √(1 − |k_i,∥|²/(n_o R)²), R the largest of |k_i,∥|/n_o.
        mirrored: what takes the q that is read to the one that was drawn, 1 or −1.
        square: n_o² − |k_i,∥|².
        per_kappa: |v_z| for one rad/µm.
        near: the least |v_z| of light that leaves with 0.7 to 1 of the k_z of the undiffracted order, and what is 1
            over the range.
        come: |k_i,z|.
        leaves: |k_o,z| of light along the horizon and along the normal, and what is 1 over that range.
        reflects: whether it is reflected.
    """

    wi: mi.Vector3f
    wavelength: mi.Float
    frequency: mi.Float
    lateral_scale: mi.Float | float
    above: mi.Bool
    index: mi.Float
    radius: mi.Float
    cosine: mi.Float
    mirrored: mi.Float
    square: mi.Float
    per_kappa: mi.Float
    near: tuple[mi.Float, mi.Float]
    come: mi.Float
    leaves: tuple[mi.Float, mi.Float, mi.Float]
    reflects: mi.Bool

    @property
    def lateral_frequency(self) -> mi.Float:
        """q of the table per λq."""
        return self.frequency * self.lateral_scale

    def at(self, wavelength: mi.Float) -> CrossingIncidence:
        """Return that at another wavelength (µm), from that at 1 µm."""
        wavelength = dr.detach(wavelength)
        frequency = dr.rcp(wavelength)
        return dataclasses.replace(
            self,
            wavelength=wavelength,
            frequency=frequency,
            radius=self.radius * frequency,
            per_kappa=self.per_kappa * wavelength,
        )

    @classmethod
    def of(
        cls,
        i: Side,
        o: Side,
        interface: Interface,
        height_scale: mi.Float,
        flip: mi.Float | float = 1.0,
        lateral_scale: mi.Float | float = 1.0,
    ) -> CrossingIncidence:
        """Return that of light from the side `i` to the side `o`, at a wavelength of 1 µm.

        `flip` is the sign of κ of a pair that is evaluated; one where a direction is drawn.
        """
        reflects = i.sign == o.sign
        assumed = dr.select(reflects & (i.sign > 0), mi.Float(1), -1)
        if not interface.mirrors:
            assumed = mi.Float(1.0)
        square = dr.square(o.outside) - dr.square(i.outside) + i.square
        radius = o.outside
        max_index = mi.Float(1.0) if interface.is_sheet else larger(interface.eta, dr.rcp(interface.eta))
        across = dr.squared_norm(i.tangent) / dr.square(radius * max_index)
        snell = o.normal(larger(square, 0))
        undiffracted, steep = (dr.abs(i.z + o.sign * z) for z in (snell, 0.7 * snell))
        near = smaller(undiffracted, steep), dr.rcp(larger(dr.abs(undiffracted - steep), 1e-4))
        horizon, normal = o.normal(mi.Float(0)), o.inside
        per_v = larger(dr.two_pi * height_scale, 1e-30)
        values = (
            mi.Vector3f(assumed * i.tangent.x, assumed * i.tangent.y, dr.sqrt(i.square) / i.outside),
            mi.Float(1.0),
            mi.Float(1.0),
            lateral_scale,
            i.sign > 0,
            i.outside,
            radius * lateral_scale,
            dr.safe_sqrt(1 - across),
            assumed * flip,
            square,
            dr.rcp(per_v),
            near,
            dr.abs(i.z),
            (horizon, normal, dr.rcp(larger(normal - horizon, 1e-3))),
            reflects,
        )
        return cls(*(dr.detach(value) for value in values))

    def below(self, kappa: mi.Float) -> mi.Float:
        """Return the share of light with less than κ: half of it near the undiffracted order, half at any k_o,z."""
        v_z, (horizon, normal, per) = kappa * self.per_kappa, self.leaves
        low, per_near = self.near
        near = limited((v_z - low) * per_near, 0, 1)
        back = limited((v_z - self.come - horizon) * per, 0, 1)
        most, least = smaller(self.come + v_z, normal), larger(self.come - v_z, horizon)
        on = limited((most - least) * per, 0, 1)
        return dr.select(self.reflects, dr.square(back), 0.5 * (near + on))

    def propagates(self, tangent: mi.Vector2f) -> mi.Bool:
        """Return whether the order at λq, as it is drawn, propagates."""
        change = tangent.x * (2 * self.wi.x + tangent.x) + tangent.y * (2 * self.wi.y + tangent.y)
        return self.square - change > 0
