"""Wave vectors, pairs of them, and the incident light at one wavelength, with the formulas of `../optics/geometry.py`.

All lengths are in units that make the lateral scale of the relief one (`Scales` in `varying.py`).

A coat and the flat face of a sheet are plane layers. They keep the tangential component of k = n ω and change the
normal one, so that k next to the relief follows from k outside. κ has a sign: as S(q; −κ) = S(−q; κ), the tables for κ
≥ 0 are read at −q where κ < 0.

Separate orders: K and G are computed per order (`Geometry.order_squares_and_gain`). Continua: K and G are computed
once, from the two directions (`Geometry.continuum_factor`).

Where v_z → 0, which occurs in transmission, K diverges and S(q; κ) falls as κ². For |κ| < κ₁, v_z² in K is replaced by
v_z² at κ₁, and S by κ₁²/κ² S (`furnace.small_kappa`).
"""

from __future__ import annotations

import copy
import dataclasses
from collections.abc import Callable
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi

from ..optics import geometry
from .device_tables import integer_part, larger, limited, smaller
from .indices import Dispersion


# Not frozen: Dr.Jit rebuilds what enters a branch field by field.
@dataclass(eq=False)
class WaveVector:
    """k = n ω of a direction away from the relief, in units of 2π/λ, λ in the uppermost medium.

    Attributes:
        tangent: k_∥, outside and next to the relief.
        square: k_z² outside.
        index: n outside.
        inner_index: n next to the relief, which differs under a coat and inside of a sheet.
        sign: 1 above, −1 below.
    """

    tangent: mi.Vector2f
    square: mi.Float
    index: mi.Float
    inner_index: mi.Float
    sign: mi.Float

    def normal(self, square: mi.Float) -> mi.Float:
        """Return |k_z| next to the relief, from k_z² outside."""
        # Positive, as the root has no derivative at zero.
        return dr.sqrt(larger(square + (dr.square(self.inner_index) - dr.square(self.index)), 1e-12))

    @property
    def z(self) -> mi.Float:
        """k_z next to the relief, with its sign."""
        return self.sign * self.normal(self.square)

    def inner(self) -> mi.Vector3f:
        """Return the direction next to the relief, a unit vector."""
        return mi.Vector3f(*self.tangent, self.z) / self.inner_index


# Of reflected and of transmitted samples: with a tabulated transmitted fraction; with the transmitted fraction of a
# plane; in rigorous theory, which uses the fraction of a plane although fine gratings differ much from a plane.
MIN_TABULATED_PROBABILITY, MIN_PLANE_PROBABILITY, MIN_RIGOROUS_PROBABILITY = 0.05, 0.1, 0.2


class Interface:
    """The media above and below the relief.

    Attributes:
        coat_index: n of the medium next to the relief above, relative to the outside; one without a coat.
        eta: index below relative to the index above; one where no light is transmitted.
        transmits: whether there is a medium below.
        is_sheet: whether the lower medium is a film with a flat lower face, with the upper medium below it.
        rigorous: whether tables are of rigorous theory: these do not depend on the sign of κ, include the flat face of
            a sheet, and are less like a plane.
        kappa_has_sign: whether tables are read at −q where κ is negative.
        mirrors_q: whether −q is drawn where κ is assumed negative, which is the case where orders overlap.
        has_flat_face: whether there is a flat face that the tables do not include.
        kappas: the two bounds whose minimum is κ₁, in rad/µm for unscaled heights (`furnace.small_kappas`); None where
            κ₁ is zero, in reflection and for rigorous theory.
        transmitted_fraction: returns the transmitted fraction of power for a direction along the pattern's axes, where
            an `OrderSampler` draws orders. None for rigorous theory and where orders overlap: the fraction of a plane
            is used.
        disperses: whether the index of the coat or of the medium below varies with the wavelength. `coat_index` and
            `eta` are given for the middle of visible light; `at_wavelength` returns the indices at a wavelength.
    """

    def __init__(
        self,
        coat_index: mi.Float | float = 1.0,
        eta: mi.Float | None = None,
        is_sheet: bool = False,
        rigorous: bool = False,
        kappas: tuple[mi.Float, mi.Float] | None = None,
        transmitted_fraction: Callable[[mi.Vector3f], mi.Float] | None = None,
        dispersions: tuple[Dispersion | None, Dispersion | None] = (None, None),
    ) -> None:
        self.coat_index, self.transmits, self.is_sheet = mi.Float(coat_index), eta is not None, is_sheet
        self.rigorous, self.kappas, self.transmitted_fraction = rigorous, kappas, transmitted_fraction
        self.kappa_has_sign, self.has_flat_face = self.transmits and not rigorous, is_sheet and not rigorous
        self.mirrors_q = self.kappa_has_sign and transmitted_fraction is None
        # In reflection literals, so that Dr.Jit eliminates the terms of the medium below.
        self.eta = mi.Float(1.0) if eta is None else eta
        self._dispersions = dispersions
        self.disperses = any(dispersions)

    def at_wavelength(self, wavelength: mi.Float) -> Interface:
        """Return the interface with its indices at a wavelength in vacuum, nm."""
        if not self.disperses:
            return self
        result, (of_coat, below) = copy.copy(self), self._dispersions
        if of_coat is not None:
            result.coat_index = of_coat(wavelength).real
        if below is not None:
            result.eta = below(wavelength).real
        return result

    def min_kappa(self, height_scale: mi.Float) -> mi.Float:
        """Return κ₁ in rad/µm, at most the κ of the undiffracted order at all wavelengths."""
        if self.kappas is None:
            return mi.Float(0.0)
        first, undiffracted = self.kappas
        return smaller(first, undiffracted * dr.detach(height_scale))

    def is_incident(self, cos: mi.Float) -> mi.Bool:
        """Return whether light that is incident from a direction with this cosine is scattered."""
        return cos != 0 if self.transmits else cos > 0

    def wave_vector(self, omega: mi.Vector3f) -> WaveVector:
        """Return k of a direction ω."""
        above = omega.z > 0 if self.transmits else mi.Bool(True)
        index, inner_index, sign = self._medium(above)
        return WaveVector(mi.Vector2f(*omega.xy) * index, dr.square(omega.z * index), index, inner_index, sign)

    def _medium(self, above: mi.Bool) -> tuple[mi.Float, mi.Float, mi.Float]:
        """Return n outside, n next to the relief and the sign of the medium above or below."""
        outer = mi.Float(1.0) if self.is_sheet else dr.select(above, mi.Float(1), self.eta)
        return outer, dr.select(above, self.coat_index, self.eta), dr.select(above, mi.Float(1), -1)

    def scattered(self, k_i: WaveVector, reflects: mi.Bool) -> WaveVector:
        """Return k in the medium into which light of `k_i` is scattered: k_∥ of undiffracted light, k_z² of `k_i`."""
        return WaveVector(-k_i.tangent, k_i.square, *self._medium((k_i.sign > 0) == reflects))

    def transmission_probability(self, omega: mi.Vector3f) -> mi.Float:
        """Return the probability that a sample is transmitted, about the transmitted fraction of power.

        `omega` is along the pattern's axes.
        """
        if self.transmitted_fraction is not None:
            return limited(self.transmitted_fraction(omega), MIN_TABULATED_PROBABILITY, 1 - MIN_TABULATED_PROBABILITY)
        # In a sheet no transmitted light is totally reflected.
        reflected = mi.fresnel(dr.abs(omega.z) if self.is_sheet else omega.z, self.eta)[0]
        min_probability = MIN_RIGOROUS_PROBABILITY if self.rigorous else MIN_PLANE_PROBABILITY
        return limited(1 - reflected, min_probability, 1 - min_probability)

    def flat_face_transmittance(self, omega: mi.Vector3f) -> mi.Float:
        """Return the transmittance of the flat face of a sheet; one for directions above."""
        transmitted = 1 - mi.fresnel(dr.abs(omega.z), self.eta)[0]
        return dr.select(omega.z > 0, 1, transmitted)


@dataclass(eq=False)
class Geometry:
    """The quantities of a pair of directions. All angles are to the macroscopic normal, z.

    Attributes:
        incident, outgoing: k_i and k_o.
        reflects: whether both are above or both below.
        v_z: of v = k_i + k_o.
        kappa_sign: the sign of κ; one where tables do not depend on it.
        tangent: λq where κ > 0, else −λq, at which the table is read.
        height_scale: factor of the heights.
        shadowing: whether G is a factor.
        min_kappa: κ₁ in rad/µm.
    """

    incident: WaveVector
    outgoing: WaveVector
    reflects: mi.Bool
    v_z: mi.Float
    kappa_sign: mi.Float
    tangent: mi.Vector2f
    height_scale: mi.Float
    shadowing: bool
    min_kappa: mi.Float

    @classmethod
    def of(
        cls,
        k_i: WaveVector,
        k_o: WaveVector,
        interface: Interface,
        height_scale: mi.Float | float = 1.0,
        shadowing: bool = True,
    ) -> Geometry:
        """Return the geometry of two wave vectors of `interface`."""
        v_z, along = k_i.z + k_o.z, k_i.tangent + k_o.tangent
        kappa_sign = dr.select(v_z < 0, mi.Float(-1), 1) if interface.kappa_has_sign else mi.Float(1.0)
        height_scale = mi.Float(height_scale)
        return cls(
            incident=k_i,
            outgoing=k_o,
            reflects=k_i.sign == k_o.sign,
            v_z=v_z,
            kappa_sign=kappa_sign,
            tangent=-kappa_sign * along,
            height_scale=height_scale,
            shadowing=shadowing,
            min_kappa=interface.min_kappa(height_scale),
        )

    @property
    def factor(self) -> mi.Float:
        """n_o² |cos θ_o| outside. A density in q is λ²/(n_o² |cos θ_o|) times the density in solid angle."""
        return self.outgoing.index * dr.sqrt(self.outgoing.square)

    def kappa(self, frequency: mi.Float) -> mi.Float:
        """Return |κ| in rad/µm; `frequency` is 1/λ."""
        return dr.abs(self.v_z) * dr.two_pi * frequency * self.height_scale

    def small(self) -> tuple[mi.Float, mi.Bool]:
        """Return κ₁, and the pairs to which it applies, for `furnace.small_kappa`."""
        return self.min_kappa, ~self.reflects

    def cosines(self) -> tuple[mi.Float, mi.Float]:
        """Return |cos θ_i| and |cos θ_o| next to the relief."""
        return tuple(k.normal(k.square) / k.inner_index for k in (self.incident, self.outgoing))

    def cos_half(self) -> mi.Float:
        """Return the cosine of ω and h, negative from below as `mi.fresnel` expects.

        For reflected light ω = ω_i; for transmitted light ω is whichever direction lies above. A pair and its reverse
        then have the same R, even in rounding near R = 1.
        """
        k_i, k_o = self.incident, self.outgoing
        square = dr.squared_norm(self.tangent) + dr.square(self.v_z)
        index = dr.select(self.reflects | (k_i.sign > 0), k_i.inner_index, k_o.inner_index)
        cos = 0.5 * dr.abs(square + k_i.sign * self._excess) * dr.rsqrt(larger(square, 1e-12)) / index
        return dr.select(self.reflects, k_i.sign, 1) * smaller(cos, 1)

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
        squares, gain = self.order_squares_and_gain(self.kappa_sign * tangent, per_width)
        return self.k_g(*squares, dr.squared_norm(tangent), incidence) * gain * self.factor

    def order_kappa(self, tangent: mi.Vector2f, incidence: Incidence) -> tuple[mi.Float, mi.Bool]:
        """Return |κ| in rad/µm and where κ has another sign than κ of the two directions.

        κ is that of the two directions for reflected light, and that of the order for transmitted light: in
        transmission K grows as 1/v_z² and the power falls as κ², and both use the v_z of the order, so that these
        factors cancel.
        """
        (square_i, square_o), _ = self.order_squares_and_gain(self.kappa_sign * tangent, mi.Float(0))
        of_order = self.incident.sign * (self.incident.normal(square_i) - self.outgoing.normal(square_o))
        v_z = dr.select(self.reflects, self.v_z, of_order)
        has_other_sign = ~self.reflects & (of_order * self.kappa_sign < 0)
        return dr.abs(v_z) * dr.two_pi * incidence.frequency * self.height_scale, has_other_sign

    def continuum_factor(self, incidence: Incidence, per_width: mi.Float) -> mi.Float:
        """Return n_o² ((1 − b) K G + b Γ) |cos θ_o| of a continuum, for which no order is known.

        At grazing incidence the mirror order has nearly all of the power, and K diverges within its lobe. The fraction
        b of S is attributed to this order, with K G = 1 and its gain Γ. It is one for cos θ_i, cos θ_o ≤ 0.2 and
        |q| ≤ 4 σ_q, zero where one of the cosines is above 0.4 or |q| ≥ 5 σ_q, and zero for transmitted light. The rest
        has K and G of the pair of directions and no gain, as the power that lobes lose below the horizon is about that
        gained from evanescent orders.
        """
        square_i, square_o = self.incident.square, self.outgoing.square
        square = dr.squared_norm(self.tangent)
        mirror = limited((25 - square * dr.square(per_width)) / 9, 0, 1)
        mirror *= limited(2 - 5 * dr.sqrt(larger(larger(square_i, square_o), 1e-12)), 0, 1)
        _, gain = self.order_squares_and_gain(mi.Vector2f(0), per_width)
        of_pair = self.k_g(square_i, square_o, square, incidence)
        return dr.lerp(of_pair, gain, dr.select(self.reflects, mirror, 0)) * self.factor

    def order_squares_and_gain(
        self, change: mi.Vector2f, per_width: mi.Float
    ) -> tuple[tuple[mi.Float, mi.Float], mi.Float]:
        """Return k_z² of an order in both media, outside, for its K and G, and the gain Γ of its lobe.

        The lobe contains the pair of directions. The order diffracts ω_i into a direction near ω_o, and ω_o into one
        near ω_i. Each k_z² is the average of two values: one from the actual directions, one from the order's exact
        direction. They agree at the centre of the lobe. At grazing incidence K of the actual directions would diverge
        within the lobe; with the average, K G of the mirror order is one.

        The gain compensates the part of the lobe below the horizon, and is zero where the order does not propagate.
        With σ the width of the lobe in direction cosines, x = cos² θ/2σ is the distance from the horizon in standard
        deviations. Γ = g(x_i) g(x_o) (g: `geometry.horizon_gain`), x_i the minimum of x of ω_i and of the direction
        into which the order diffracts ω_i, x_o likewise. The gain is reciprocal, and every order that propagates has
        its full power.

        Args:
            change: λq of the order.
            per_width: 1/(λσ_q).
        """
        i, o = self.incident, self.outgoing
        index_difference = dr.square(o.index) - dr.square(i.index)
        order_o = index_difference + cos_square(i, change)
        order_i = cos_square(o, change) - index_difference
        x_i = 0.5 * per_width * smaller(i.square / i.index, order_o / o.index)
        x_o = 0.5 * per_width * smaller(o.square / o.index, order_i / i.index)
        gain = geometry.horizon_gain(x_i, dr.select) * geometry.horizon_gain(x_o, dr.select)
        gain = dr.select(smaller(order_i, order_o) > 0, gain, 0)
        return (0.5 * (i.square + order_i), 0.5 * (o.square + order_o)), gain

    def k_g(
        self, square_i: mi.Float, square_o: mi.Float, tangent_square: mi.Float, incidence: Incidence | None = None
    ) -> mi.Float:
        """Return K G from |v_∥|² and k_z² of both directions, outside; `incidence` is needed for transmitted light."""
        # At least 1e-6, so that K is finite where the heights are zero.
        min_v_z = 0 if incidence is None else larger(self.min_kappa * incidence.per_kappa, 1e-6)
        k_iz, k_oz = self.incident.normal(square_i), self.outgoing.normal(square_o)
        return geometry.k_g(k_iz, k_oz, tangent_square, self._excess, self.reflects, self.shadowing, min_v_z, dr.select)


def cos_square(k: WaveVector, change: mi.Vector2f) -> mi.Float:
    """Return k_z², outside, of the order at λq = `change` of incident light k, in the medium of k.

    It is negative where the order does not propagate. At grazing incidence n² − |k_∥ + λq|² would have large rounding
    errors.
    """
    return k.square - dr.dot(change, 2 * k.tangent + change)


@dataclass(eq=False)
class Incidence:
    """Incident light of one wavelength and direction, scattered into one of the media, for samplers.

    κ of reflected light is positive above and negative below. κ of transmitted light is assumed negative, as it is
    except for steeply diffracted light. Where κ is negative and orders overlap, −q is drawn.

    Attributes:
        tangent: k_i,∥, or its opposite where −q is drawn.
        wavelength: λ in µm.
        frequency: 1/λ.
        lobe_scale: factor of the widths of lobes.
        coat_index: see `Interface`.
        above: whether light is incident from above.
        reflects: whether reflected light is considered, else transmitted light.
        index: n_i outside.
        radius: n_o/λ outside; the q that propagate fill the disc of this radius around −k_i,∥/λ.
        q_sign: 1 or −1, the factor from the q at which the table is read to the q that is drawn.
        square: n_o² − |k_i,∥|².
        height_scale: factor of the heights.
        per_kappa: |v_z| for one rad/µm.
        near_undiffracted: the minimum of |v_z| for |k_oz| between 0.7 and 1 times the |k_oz| of the undiffracted order,
            and the reciprocal of the length of the interval of |v_z|.
        k_iz: |k_iz|.
        k_oz: |k_oz| at the horizon and along the normal, and the reciprocal of their difference.
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
    q_sign: mi.Float
    square: mi.Float
    height_scale: mi.Float
    per_kappa: mi.Float
    near_undiffracted: tuple[mi.Float, mi.Float]
    k_iz: mi.Float
    k_oz: tuple[mi.Float, mi.Float, mi.Float]

    def at_wavelength(self, wavelength: mi.Float, lobe_scale: mi.Float | float = 1.0) -> Incidence:
        """Return the incidence at another wavelength (µm) and with scaled lobes, from the incidence at 1 µm."""
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
        kappa_sign: mi.Float | float = 1.0,
    ) -> Incidence:
        """Return the incident light of k_i at a wavelength of 1 µm.

        It has no gradients: samples do not move with the parameters.

        Args:
            k_i: of the incident light.
            k_o: any wave vector in the medium into which light is scattered.
            interface: the media.
            height_scale: factor of the heights.
            kappa_sign: the sign of κ of a pair that is evaluated; one where a direction is drawn.
        """
        reflects = k_i.sign == k_o.sign
        assumed_sign = dr.select(reflects & (k_i.sign > 0), mi.Float(1), -1) if interface.mirrors_q else mi.Float(1.0)
        square = dr.square(k_o.index) - dr.square(k_i.index) + k_i.square
        snell = k_o.normal(larger(square, 0))
        undiffracted, steep = (dr.abs(k_i.z + k_o.sign * z) for z in (snell, 0.7 * snell))
        near_undiffracted = smaller(undiffracted, steep), dr.rcp(larger(dr.abs(undiffracted - steep), 1e-4))
        horizon, normal = k_o.normal(mi.Float(0)), k_o.inner_index
        incidence = cls(
            tangent=assumed_sign * k_i.tangent,
            wavelength=mi.Float(1.0),
            frequency=mi.Float(1.0),
            lobe_scale=mi.Float(1.0),
            coat_index=interface.coat_index,
            above=k_i.sign > 0,
            reflects=reflects,
            index=k_i.index,
            radius=k_o.index,
            q_sign=assumed_sign * kappa_sign,
            square=square,
            height_scale=mi.Float(height_scale),
            per_kappa=dr.rcp(larger(dr.two_pi * mi.Float(height_scale), 1e-30)),
            near_undiffracted=near_undiffracted,
            k_iz=dr.abs(k_i.z),
            k_oz=(horizon, normal, dr.rcp(larger(normal - horizon, 1e-3))),
        )
        return dr.detach(incidence)

    def fraction_below(self, kappa: mi.Float) -> mi.Float:
        """Return the assumed fraction of light with less than κ (rad/µm).

        Reflected light is distributed as by a diffuse surface. Half of the transmitted light is near the undiffracted
        order, half is uniform in k_oz.
        """
        v_z, (horizon, normal, per) = kappa * self.per_kappa, self.k_oz
        low, per_near = self.near_undiffracted
        near_undiffracted = limited((v_z - low) * per_near, 0, 1)
        reflected = limited((v_z - self.k_iz - horizon) * per, 0, 1)
        highest, lowest = smaller(self.k_iz + v_z, normal), larger(self.k_iz - v_z, horizon)
        any_k_oz = limited((highest - lowest) * per, 0, 1)
        return dr.select(self.reflects, dr.square(reflected), 0.5 * (near_undiffracted + any_k_oz))

    def propagates(self, tangent: mi.Vector2f) -> mi.Bool:
        """Return whether the order at λq propagates, with the sign of q that is drawn."""
        return self.square - dr.dot(tangent, 2 * self.tangent + tangent) > 0


def rotated(omega: mi.Vector3f, sin: mi.Float, cos: mi.Float) -> mi.Vector3f:
    """Return ω along the pattern's axes, from sine and cosine of the angle from the tangent to its x axis."""
    return mi.Vector3f(cos * omega.x + sin * omega.y, cos * omega.y - sin * omega.x, omega.z)


def on_square(omega: mi.Vector3f) -> tuple[mi.Float, mi.Float]:
    """Return column and row of ω on the square of `energy/table.py`, from 0 to 1, for ω above and below alike."""
    t = dr.sqrt(limited(1 - dr.sqrt(larger(1 - dr.abs(omega.z), 0)), 0, 1))
    along = (1 - t) / larger(dr.abs(omega.x) + dr.abs(omega.y), 1e-12)
    return tuple(0.5 * (1 + along * of) for of in (omega.x + omega.y, omega.x - omega.y))


def cell_of(x: mi.Float, count: mi.Float | int) -> tuple[mi.UInt32, mi.Float]:
    """Return the grid cell of x, 0 ≤ x ≤ count, and the coordinate in it; outside, the nearest."""
    x = limited(x, 0, count)
    cell = dr.minimum(integer_part(x), integer_part(count) - 1)
    return cell, x - mi.Float(mi.Int32(cell))
