"""A grating and its material as they are exported, and all of its orders for light of one direction."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..array_types import Complex, Real
from ..errors import RequestError
from ..inspection.efficiency import checked_numbers, description
from ..inspection.order_solver import IncidentLight, OrderSolver, order_solver
from ..optics.geometry import Orders
from ..optics.media import Media, MediumBelow
from ..precomputation.requested_surface import RequestedSurface
from ..rigorous.coordinate_transformation import is_profile
from ..settings import THEORIES
from ..surface.heightfield import HeightField

_ALONG_NORMAL = 1e-9  # degrees: light along the normal keeps a plane of incidence, and with it s and p


@dataclass(frozen=True, eq=False)
class DiffractedSide:
    """The orders on one side of the grating.

    Attributes:
        side: "reflected" or "transmitted".
        orders: their efficiencies.
        directions: ω_o, (n, 3).
        amplitudes: (n, 2, 2), [order, polarisation of the order, of the light], s before p, of which |·|² is a fraction
            of the incident power; None in scalar theory.
    """

    side: str
    orders: Orders
    directions: Real
    amplitudes: Complex | None

    @property
    def m(self) -> NDArray[np.int64]:
        """The orders as (m_x, m_y), (n, 2)."""
        m = self.orders.m
        return m if m.ndim == 2 else np.stack([m, np.zeros_like(m)], axis=1)


@dataclass(frozen=True, eq=False)
class ExportedGrating:
    """A periodic surface, its material and the theory of its efficiencies.

    Attributes:
        height_field: one period.
        theory: "scalar" or "rigorous".
        below: the medium below it.
        shortest: µm, the shortest wavelength that is requested.

    Raises:
        ValueError: if the material or the theory is wrong, or more than 1000 orders propagate.
    """

    height_field: HeightField
    theory: str
    below: MediumBelow
    shortest: float

    def __post_init__(self) -> None:
        if self.theory not in THEORIES:
            raise RequestError(f"theory: got {self.theory!r}, wanted one of {', '.join(THEORIES)}")
        self.below.check_theory(self.theory)
        self.below.index_at(self.shortest)

    @classmethod
    def of_surface(cls, requested: RequestedSurface, shortest: float) -> ExportedGrating:
        """Return a requested grating; theory, material and int_ior may stand aside, in the place of its recipe's.

        Raises:
            ValueError: if the surface is not periodic, or as the class.
        """
        if requested.is_irregular:
            raise RequestError(
                f"{requested.title}: got an irregular surface, which has no orders, wanted a grating; the command "
                "`efficiency --csv` tabulates its peaks, and a file .osl or .npz holds its spectrum"
            )
        field = requested.period
        if is_profile(field):
            field = HeightField(field.heights[:1], field.pixel_size, field.source)
        return cls(field, requested.theory, requested.below, shortest)

    @property
    def description(self) -> str:
        """What it is, in one line."""
        return description(self.height_field.source, Media(self.below), 0.0, self.theory)

    @property
    def period(self) -> tuple[float, float]:
        """µm, along x and y; of a line grating the same along both."""
        x, y = self.height_field.tile_size
        return (x, x) if self.height_field.shape[0] == 1 else (x, y)

    @property
    def transmits(self) -> bool:
        """Whether light crosses the surface."""
        return self.below.transparent

    @cached_property
    def _solver(self) -> OrderSolver:
        shortest = self.shortest
        if (index := self.below.index) is not None and self.transmits:
            # The maximum of |q| is 2n/λ, of light reflected inside; linear in n, n/λ has it at a node.
            at = np.append(index.wavelengths[index.wavelengths > shortest], shortest)
            shortest = float(np.min(at / np.maximum(index(at).real, 1)))
        return order_solver(self.theory, self.height_field, shortest)

    def diffracted(self, light: IncidentLight) -> Iterator[DiffractedSide]:
        """Yield the reflected and, of a dielectric, the transmitted orders of light.

        Light along the normal is taken in the limit of its plane of incidence. In scalar theory, which can exceed it,
        the power of both sides is reduced to the incident power.
        """
        light = replace(light, angle=light.angle or _ALONG_NORMAL)
        found = {"reflected": self._solver.reflected(light)}
        if self.transmits:
            found["transmitted"] = self._solver.transmitted(light)
        total = max(1.0, sum(orders.unpolarised.sum() for orders in found.values()))
        pair = self._solver.amplitudes(light) or (None, None)
        for (side, orders), amplitudes in zip(found.items(), pair, strict=False):
            if self.theory == "scalar":
                orders = Orders(orders.m, orders.s / total, orders.p / total)
            yield DiffractedSide(side, orders, light.directions(orders, self.period, side == "reflected"), amplitudes)


def checked_ranges(wavelengths: ArrayLike, angles: ArrayLike, azimuths: ArrayLike) -> tuple[Real, Real, Real]:
    """Return wavelengths in nm, (w,), angles, (a,), and azimuths, (b,), if they are in range.

    Raises:
        ValueError: if one is not.
    """
    return (
        checked_numbers("wavelengths", wavelengths, "nm from 10 to 100000 (100 µm)", 9.999, 100_000.001),
        checked_numbers("angles", angles, "degrees above −90 and below 90", -90.0, 90.0),
        checked_numbers("azimuths", azimuths, "degrees from −360 to 360", -360.001, 360.001),
    )
