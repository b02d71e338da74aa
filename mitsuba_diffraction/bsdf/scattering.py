"""What the spectra of a surface have in common at run time."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Protocol

import mitsuba as mi

from .geometry import Geometry, Incidence


class Scattering(Protocol):
    """The powers of orders or of a continuum, and the density from which q is drawn.

    Attributes:
        resolved: whether orders do not overlap, so that most directions lie outside of all lobes.
    """

    resolved: bool

    def meets(self, q_x: mi.Float, q_y: mi.Float, scale: mi.Float) -> mi.Bool:
        """Return whether q (cycles/µm) lies in the lobe, scaled by `scale`, of an order; true where lobes overlap."""

    def evaluate(self, geometry: Geometry, incidence: Incidence, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Return the power and the density of q, both in µm², for one wavelength of a pair of directions.

        The power is n_o² K G S |cos θ_o|, with the gain of lobes, or n_o² Σ_m η_m Γ N |cos θ_o| in rigorous theory.
        Where orders are resolved, q lies in the lobe of one.
        """

    def sample(self, incidence: Incidence, u: mi.Float, v: mi.Point2f, active: mi.Bool) -> tuple[mi.Point2f, mi.Bool]:
        """Draw q in cycles/µm for one wavelength; return it and whether its order propagates."""


class Axis(Protocol):
    """The orders along one axis."""

    def orders_between(self, low: mi.Float, high: mi.Float) -> tuple[mi.Int32, mi.Int32]:
        """Return the first order between two q (cycles/µm) and the number of them, at least one."""


class Orders(Scattering, Protocol):
    """Resolved orders."""

    @property
    def axes(self) -> Sequence[Axis]:
        """The orders along x and y."""

    def tangent(self, m_x: mi.Int32, m_y: mi.Int32, wavelength: mi.Float) -> mi.Vector2f:
        """Return λq of an order."""

    def order_power(
        self, m_x: mi.Int32, m_y: mi.Int32, geometry: Geometry, incidence: Incidence, active: mi.Bool
    ) -> mi.Float:
        """Return K G η_m of the order m that diffracts one of a pair of directions exactly into the other."""
