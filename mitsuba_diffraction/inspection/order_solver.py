"""The orders of a grating for light of one direction and wavelength, by either theory, on both sides of the surface."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Protocol

import numpy as np

from .. import rigorous
from ..array_types import Complex, Real
from ..errors import RequestError
from ..optics.geometry import Orders
from ..rigorous.coordinate_transformation import curve_of
from ..rigorous.solver import Efficiencies, sheet_orders
from ..scalar_theory.closed_form import (
    incident_direction,
    profile_powers,
    scalar_orders,
    tile_powers,
    transmitted_at,
)
from ..surface.heightfield import HeightField

_MAX_ORDERS = 1000  # in scalar theory, which evaluates all pairs of orders for E


@dataclass(frozen=True)
class IncidentLight:
    """Light that meets a grating with air above.

    Attributes:
        angle: of incidence, degrees, in the medium of the light.
        azimuth: of the plane of incidence, degrees from x, towards which the light travels.
        wavelength: µm, in vacuum.
        index: n + ik of the material below.
        from_below: whether the light travels upwards, inside the dielectric.
    """

    angle: float
    azimuth: float
    wavelength: float
    index: complex
    from_below: bool = False

    @property
    def direction(self) -> Real:
        """ω_i, (3,), to the light."""
        x, y, z = incident_direction(self.angle, self.azimuth)
        return np.array([x, y, -z if self.from_below else z])

    def media(self, reflected: bool) -> tuple[float, float]:
        """Return the indices of the media of the light and of its reflected or transmitted orders."""
        below = self.index.real
        here, there = (below, 1.0) if self.from_below else (1.0, below)
        return here, here if reflected else there

    def directions(self, orders: Orders, period: tuple[float, float], reflected: bool) -> Real:
        """Return ω_o of orders, (n, 3): n_o ω_o = −n_i ω_i − λ m/T along the surface."""
        n_i, n_o = self.media(reflected)
        m = orders.m if orders.m.ndim == 2 else np.stack([orders.m, np.zeros_like(orders.m)], axis=1)
        tangent = (-n_i * self.direction[:2] - self.wavelength * m / np.array(period)) / n_o
        z = np.sqrt(np.maximum(1 - (tangent**2).sum(axis=1), 0))
        return np.column_stack([tangent, -z if reflected == self.from_below else z])


class OrderSolver(Protocol):
    """The orders of one grating by one theory."""

    def reflected(self, light: IncidentLight) -> Orders:
        """Return the reflected orders."""

    def transmitted(self, light: IncidentLight) -> Orders:
        """Return the orders transmitted into the other medium."""

    def through_sheet(self, light: IncidentLight) -> Orders:
        """Return the orders transmitted by a film with a flat lower face; light from above."""

    def amplitudes(self, light: IncidentLight) -> tuple[Complex, Complex] | None:
        """Return those of the reflected and transmitted orders as in `rigorous.Efficiencies`, if the theory has any."""


class ScalarSolver:
    """R K G E η_m(κ_m) and K_t G_t (1 − F) E η_m(κ_m), in float64 without tables.

    Args:
        height_field: one period.
        shortest: µm; the largest |q| is 2/`shortest`.

    Raises:
        ValueError: if more than 1000 orders propagate.
    """

    def __init__(self, height_field: HeightField, shortest: float) -> None:
        x, y = height_field.tile_size
        profile = height_field.shape[0] == 1
        if (count := 2 * x / shortest if profile else np.pi * x * y / shortest**2) > _MAX_ORDERS:
            raise RequestError(
                f"height field: got about {count:.0f} orders of a tile of {x:.4g} × {y:.4g} µm at "
                f"{1e3 * shortest:g} nm, wanted at most {_MAX_ORDERS}: one period of a grating"
            )
        self._powers = profile_powers(height_field) if profile else tile_powers(height_field, shortest)
        self._period = x if profile else (x, y)

    def reflected(self, light: IncidentLight) -> Orders:
        """Return the reflected orders."""
        if not light.from_below:
            return scalar_orders(self._powers, self._period, light.wavelength, light.angle, light.index, light.azimuth)
        # Seen from below the heights are −h, and S(q; −κ) = S(−q; κ); lengths in the medium are n times as long.
        n = light.index.real
        return scalar_orders(
            lambda m, kappa: self._powers(-m, kappa),
            self._period,
            light.wavelength / n,
            light.angle,
            1 / n,
            light.azimuth,
        )

    def transmitted(self, light: IncidentLight, sheet: bool = False) -> Orders:
        """Return the orders transmitted into the other medium."""
        tangent = light.media(reflected=True)[0] * light.direction[:2]
        return transmitted_at(
            self._powers, self._period, light.wavelength, tangent, light.index.real, light.from_below, sheet
        )

    def through_sheet(self, light: IncidentLight) -> Orders:
        """Return the orders transmitted by a film with a flat lower face."""
        return self.transmitted(light, sheet=True)

    def amplitudes(self, light: IncidentLight) -> None:
        """Return nothing: scalar theory has powers alone."""


class RigorousSolver:
    """The orders of a profile by Maxwell's equations (`rigorous.efficiencies`).

    Args:
        height_field: one period, h(x).
    """

    def __init__(self, height_field: HeightField) -> None:
        self._height_field = height_field
        self._last: tuple[IncidentLight, Efficiencies] | None = None

    def _solved(self, light: IncidentLight) -> Efficiencies:
        if self._last is None or self._last[0] != light:
            found = rigorous.efficiencies(self._height_field, light.direction, light.wavelength, int_ior=light.index)
            self._last = light, found
        return self._last[1]

    def reflected(self, light: IncidentLight) -> Orders:
        """Return the reflected orders."""
        return self._solved(light).reflection

    def transmitted(self, light: IncidentLight) -> Orders:
        """Return the orders transmitted into the other medium."""
        return self._solved(light).transmission

    def through_sheet(self, light: IncidentLight) -> Orders:
        """Return the orders transmitted by a film with a flat lower face, with all internal reflections."""
        k_0 = self._height_field.tile_size[0] / light.wavelength
        harmonics = self._solved(light).harmonics
        return sheet_orders(curve_of(self._height_field), light.direction, k_0, light.index.real, harmonics)

    def amplitudes(self, light: IncidentLight) -> tuple[Complex, Complex]:
        """Return those of the reflected and of the transmitted orders."""
        found = self._solved(light)
        return found.amplitudes, found.transmitted_amplitudes


def order_solver(theory: str, height_field: HeightField, shortest: float) -> OrderSolver:
    """Return the solver of a theory; arguments and errors of `ScalarSolver`, and of rigorous theory none."""
    return ScalarSolver(height_field, shortest) if theory == "scalar" else RigorousSolver(height_field)
