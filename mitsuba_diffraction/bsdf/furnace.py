"""The albedo of a perfect mirror with the relief of a surface, in a white furnace, from the BSDF's own terms.

With R = 1 and E = 1 the BSDF reflects

    a(ω_i, λ) = ∫ K G Γ S(q; κ) dq    over the q whose ω_o is above the surface (du dv = cos θ_o dω_o = λ² dq)

with the gain Γ of lobes at the horizon. For an interface between media, R(ω_i, λ) has the factor F, and T(ω_i, λ) is
the same integral over transmitted light, with 1 − F.

Resolved orders are summed. With Γ an order keeps its power wherever its centre propagates, so that it contributes
K G η_m (`Orders.order_power`). Where orders overlap, and for samples, the integral is the mean over as many q as
`SAMPLES`, drawn from the density of the BSDF.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from dataclasses import dataclass
from typing import cast

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..spectrum.power_spectrum import PowerSpectrum
from .geometry import Geometry, Incidence, Interface, WaveVector, cos_square
from .scattering import Orders, Scattering
from .tables import floats, larger, opaque

Real = NDArray[np.float64]

SAMPLES = 2048  # of q for one direction and wavelength; e of reflected light at an interface needs as many
MAX_E = 1.05
"""Maximum stored 1/a; e is one where the interpolated value exceeds one, so that its kink lies at a = 1."""


def small_kappas(spectrum: PowerSpectrum, eta: float) -> tuple[float, float]:
    """Return the two bounds whose minimum is κ₁, in rad/µm, below which c_m/κ² of transmitted light is extrapolated.

    The first is a quarter of the first interval of the table, where its error is as small as that of the linear
    extrapolation. The second, to be multiplied by the scale of the heights, is 0.8 of the minimum κ of undiffracted
    light at normal incidence. Wavelengths of the spectrum are those in the denser medium.
    """
    max_wavelength = spectrum.wavelengths[1] * 1e-3 * max(eta, 1)
    return spectrum.table.first_interval / 4, 1.6 * np.pi * abs(eta - 1) / max_wavelength


@dataclass(frozen=True, eq=False)
class Furnace:
    """White light on a surface.

    Attributes:
        scattering: S(q; κ).
        interface: the media next to the relief.
        height_scale: the factor of the heights.
    """

    scattering: Scattering
    interface: Interface
    height_scale: float = 1.0

    @classmethod
    def of(
        cls,
        scattering: Scattering,
        spectrum: PowerSpectrum,
        eta: float | None = None,
        height_scale: float = 1.0,
    ) -> Furnace:
        """Return the furnace of a spectrum; `eta` is n below relative to n above, if light is transmitted."""
        if eta is None:
            return cls(scattering, Interface(), height_scale)
        kappas = tuple(opaque(kappa) for kappa in small_kappas(spectrum, eta))
        return cls(scattering, Interface(eta=opaque(eta), kappas=kappas), height_scale)

    def albedo(self, directions: Real, wavelengths: Real) -> Real:
        """Compute a(ω, λ), or R and T of an interface.

        Args:
            directions: ω, (n, 3) unit vectors along the axes of the pattern; z < 0 below an interface.
            wavelengths: λ in the upper medium in µm, (n,).

        Returns:
            (1, n), or (2, n): R and T.
        """
        k_i, wavelength = self._incident(directions, wavelengths)
        total = self._sum_of_orders if self.scattering.resolved else self._mean_of_samples
        with dr.suspend_grad():
            totals = [total(k_i, wavelength, of) for of in ((True, False) if self.interface.transmits else (True,))]
            dr.eval(totals)
        return np.array(totals, np.float64)

    def order_powers(
        self, directions: Real, wavelengths: Real, orders: NDArray[np.int64], reflects: bool
    ) -> NDArray[np.float32]:
        """Compute the power of each resolved order that is reflected, or transmitted.

        Args:
            directions, wavelengths: as for `albedo`.
            orders: (m, 2), along x and y; an order diffracts ω to k_o,∥ = −k_i,∥ − λ m/T.
            reflects: whether light is reflected.

        Returns:
            (n, m); zero for orders that do not propagate.
        """
        count = len(orders)
        k_i, wavelength = self._incident(np.repeat(directions, count, 0), np.repeat(wavelengths, count))
        with dr.suspend_grad():
            m_x, m_y = (mi.Int32(floats(np.tile(of_axis, len(directions)))) for of_axis in orders.T)
            power = self._order_power(k_i, wavelength, m_x, m_y, reflects)
        return np.array(power).reshape(-1, count)

    def _incident(self, directions: Real, wavelengths: Real) -> tuple[WaveVector, mi.Float]:
        return self.interface.wave_vector(mi.Vector3f(*map(floats, directions.T))), floats(wavelengths)

    def _pair(
        self, k_i: WaveVector, change: mi.Vector2f, wavelength: mi.Float, reflects: bool
    ) -> tuple[Geometry, Incidence, mi.Bool]:
        """Return the pair of ω_i and the direction into which λq = `change` diffracts it, and whether it propagates."""
        k_o = self.interface.scattered(k_i, mi.Bool(reflects))
        square = dr.square(k_o.index) - dr.square(k_i.index) + cos_square(k_i, change)
        k_o = dataclasses.replace(k_o, tangent=k_o.tangent - change, square=larger(square, 0))
        scale = opaque(self.height_scale)
        geometry = Geometry.of(k_i, k_o, self.interface, scale, True)
        incidence = Incidence.of(k_i, k_o, self.interface, scale, geometry.kappa_sign).at(wavelength)
        return geometry, incidence, square > 0

    def _fresnel(self, geometry: Geometry, reflects: bool) -> mi.Float:
        """Return F of reflected light and 1 − F of transmitted light; 1 if none is transmitted."""
        if not self.interface.transmits:
            return mi.Float(1.0)
        reflected = mi.fresnel(geometry.cos_half(), self.interface.eta)[0]
        return reflected if reflects else 1 - reflected

    def _order_power(
        self, k_i: WaveVector, wavelength: mi.Float, m_x: mi.Int32, m_y: mi.Int32, reflects: bool
    ) -> mi.Float:
        orders = cast(Orders, self.scattering)
        change = orders.tangent(m_x, m_y, wavelength)
        geometry, incidence, propagates = self._pair(k_i, change, wavelength, reflects)
        power = orders.order_power(m_x, m_y, geometry, incidence, propagates)
        return dr.select(propagates, power * self._fresnel(geometry, reflects), 0)

    def _sum_of_orders(self, k_i: WaveVector, wavelength: mi.Float, reflects: bool) -> mi.Float:
        radius = self.interface.scattered(k_i, mi.Bool(reflects)).index
        # The rectangle of orders that may propagate; an evanescent order has no power.
        (first_x, columns), (first_y, rows) = (
            axis.orders_between((-radius - k) / wavelength, (radius - k) / wavelength)
            for axis, k in zip(cast(Orders, self.scattering).axes, k_i.tangent, strict=True)
        )

        def add(index: mi.Int32, total: mi.Float) -> tuple[mi.Int32, mi.Float]:
            row = index // columns
            m_x, m_y = first_x + index - row * columns, first_y + row
            return index + 1, total + self._order_power(k_i, wavelength, m_x, m_y, reflects)

        return _summed(add, columns * rows, dr.width(wavelength))

    def _mean_of_samples(self, k_i: WaveVector, wavelength: mi.Float, reflects: bool) -> mi.Float:
        k_o = self.interface.scattered(k_i, mi.Bool(reflects))
        drawn = Incidence.of(k_i, k_o, self.interface, opaque(self.height_scale)).at(wavelength)

        def add(index: mi.Int32, total: mi.Float) -> tuple[mi.Int32, mi.Float]:
            # In the unit cube, equidistant along one side and a golden-ratio sequence along the others (Roberts 2018).
            k = mi.Float(index)
            v = 0.5 + k * mi.Point2f(0.7548776662466927, 0.5698402909980532)
            q, _ = self.scattering.sample(drawn, (k + 0.5) / SAMPLES, v - dr.floor(v), mi.Bool(True))
            change = drawn.q_sign * wavelength * mi.Vector2f(q)
            geometry, incidence, propagates = self._pair(k_i, change, wavelength, reflects)
            power, density = self.scattering.evaluate(geometry, incidence, propagates)
            value = power * self._fresnel(geometry, reflects) / (geometry.factor * density)
            return index + 1, total + dr.select(propagates & (density > 0), value, 0)

        return _summed(add, mi.Int32(SAMPLES), dr.width(wavelength)) / SAMPLES


def bounds_of(albedo: Real, index: float | None) -> Real:
    """Return e from the albedo of the furnace.

    For reflected light alone e = 1/max(1, a). For an interface, transmitted light has priority over all reflected light
    except F₀, the reflectance of a plane at normal incidence, since scalar theory transmits even light that steep
    facets reflect totally:

        e_T = min(1, (1 − min(R, F₀))/T),    e_R = min(1, (1 − e_T T)/R),    e_R R + e_T T = min(1, R + T)

    Args:
        albedo: (1, n), or R and T (2, n).
        index: η; None for reflected light alone.

    Returns:
        Shape of `albedo`; for reflected light alone up to `MAX_E`.
    """
    if index is None:
        return np.minimum(1 / np.maximum(albedo, 1e-9), MAX_E)
    r, t = albedo
    # At most one: e_R is so steep at its kink that larger values would err by more between nodes.
    e_t = np.minimum(1, (1 - np.minimum(r, ((index - 1) / (index + 1)) ** 2)) / np.maximum(t, 1e-9))
    return np.stack([np.minimum(1, (1 - e_t * t) / np.maximum(r, 1e-9)), e_t])


def _summed(add: Callable[..., tuple[mi.Int32, mi.Float]], count: mi.Int32, width: int) -> mi.Float:
    """Return the sum of terms with index 0 to `count` − 1, of which `add` adds one."""
    start = dr.zeros(mi.Int32, width), dr.zeros(mi.Float, width)
    return dr.while_loop(start, lambda index, _: index < count, add)[1]
