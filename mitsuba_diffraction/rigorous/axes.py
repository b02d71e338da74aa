"""The coordinates of the table of rigorous efficiencies."""

from __future__ import annotations

import dataclasses
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Real = NDArray[np.float64]

LARGEST_PERIOD = 10.0
"""In units of the shortest wavelength: the table grows with the cube of the period, the time to build it faster."""

STORED = 2
"""Steps to a unit to each that is solved, by cubic polynomials: linear look-ups need more nodes."""


@dataclass(frozen=True)
class Axes:
    """The coordinates of the table: such that η is smooth in them, and the same for light and for reversed light.

    With ν = T/λ, directions enter by three numbers, symmetric under exchange of ω_i and ω_o but for the sign of c:

        k_y = (ω_o,y − ω_i,y) ν / 2,    g = √(ν² − k_y²),    c = (ω_o,x − ω_i,x) ν / 2.

    In units of 2π/T, g is the wave number across the grooves; light of order m comes in with k_x = c + m/2 and leaves
    with c − m/2. Order n of the same light has its Rayleigh anomaly where |c + m/2 − n| = g, which is where

        P = g + c − |m|/2    or    R = g − c − |m|/2

    is an integer. Both are above zero if order m propagates; reversed light exchanges them, and η_m(P, R) = η_m(R, P)
    by reciprocity. Beside such a line η goes as a square root, so that along P and R the nodes lie at

        P = i + sin²(π f / 2 s),    f = 0 … s,    X = i s + f,

    s steps to each unit: η is smooth in X from one whole P to the next. The third coordinate is the wavelength, from
    the shortest to the longest that g admits (k_y² ≥ 0):

        λ = λ₀ + (λ₁ − λ₀) Z / (K − 1),    λ₀ = min(λ_min, T/g),    λ₁ = min(λ_max, T/g).

    Of an interface to a dielectric of index n (relative to the medium above), g and λ are those above for all light; g
    is signed, g = −√(k_y² − ν²) where no light travels above. Inside, g'² = g|g| + (n² − 1) ν². Light that enters comes
    in with k_x = c + m/2 again; its coordinates are those of the incident direction alone, the same for all m,

        P = g + c + m/2,    R = g − c − m/2.

    Light that is reflected inside has lines where an order becomes totally reflected, at the same whole numbers:

        P = D + g + c − |m|/2,    R = D + g − c − |m|/2,

    the whole number D large enough that both are above zero for all of it.

    Attributes:
        period: T in µm.
        wavelengths: (shortest, longest) in µm.
        steps: s.
        planes: K.
        index: n of the medium below, relative to that above.
        way: sides from which and to which the light goes, 0 above and 1 below.
    """

    period: float
    wavelengths: tuple[float, float]
    steps: int
    planes: int
    index: float = 1.0
    way: tuple[int, int] = (0, 0)

    @property
    def solved(self) -> Axes:
        """The coarser nodes at which η was solved."""
        return dataclasses.replace(self, steps=self.steps // STORED)

    @property
    def max_decay(self) -> float:
        """√(n² − 1), or 0: g > −√(n² − 1) ν."""
        return float(np.sqrt(max(self.index**2 - 1, 0.0)))

    @property
    def shift(self) -> int:
        """D, at least g' − g."""
        return (
            int(np.ceil(np.sqrt(2) * self.max_decay * self.period / self.wavelengths[0])) if self.way == (1, 1) else 0
        )

    @property
    def max_order(self) -> int:
        """M, the largest order that any pair of directions reaches."""
        return int(np.ceil(sum((1.0, self.index)[side] for side in self.way) * self.period / self.wavelengths[0])) - 1

    @property
    def orders(self) -> range:
        """−M … M."""
        return range(-self.max_order, self.max_order + 1)

    def least(self, m: NDArray[np.int64] | int) -> tuple[NDArray[np.int64] | int, NDArray[np.int64] | int]:
        """By how much P and R of order m are less than D + g + k_x and D + g − k_x of the incident light."""
        enters = self.way == (0, 1) and self.index != 1
        return (0 * m, 0 * m) if enters else (np.maximum(m, 0), np.maximum(-m, 0))

    def coordinates(
        self, m: NDArray[np.int64], c: Real, g: Real, wavelength: Real
    ) -> tuple[Real, Real, NDArray[np.bool_]]:
        """Return P and R, and whether order m propagates."""
        less = self.least(m)
        p, r = self.shift + g + c + m / 2 - less[0], self.shift + g - c - m / 2 - less[1]
        inside = g * np.abs(g) + (self.index**2 - 1) * (self.period / wavelength) ** 2
        there = (p > 0) & (r > 0) & (g <= self.period / self.wavelengths[0] * (1 + 1e-9))
        for side, k_x in zip(self.way, (c + m / 2, c - m / 2), strict=True):
            there &= k_x**2 < (inside if side else g * np.abs(g))
        return p, r, there

    def units(self, m: int) -> int:
        """Return how many units P and R of order m cover."""
        # The largest g + |k_x| of the incident light.
        longest = (1 + (1.0, self.index)[self.way[0]]) * self.period / self.wavelengths[0]
        return int(np.ceil(self.shift + longest - sum(self.least(m))))

    def side(self, m: int) -> int:
        """Nodes of order m along P, and along R."""
        return self.units(m) * self.steps + 1

    def offset(self, m: int) -> int:
        """Return where the nodes of order m start in a plane: [P, R] of order −M first."""
        return sum(self.side(k) ** 2 for k in range(-self.max_order, m))

    def square(self, values: NDArray[np.float32], m: int) -> NDArray[np.float32]:
        """Of `values` (K, nodes), those of order m: (K, P, R)."""
        side, start = self.side(m), self.offset(m)
        return values[:, start : start + side**2].reshape(-1, side, side)

    @property
    def nodes(self) -> int:
        """In a plane."""
        return self.offset(self.max_order + 1)

    def nodes_at(self, count: int) -> Real:
        """Return P at X = 0 … count − 1."""
        i, f = np.divmod(np.arange(count), self.steps)
        return i + np.sin(np.pi / 2 * f / self.steps) ** 2

    def position(self, p: Real) -> Real:
        """Return X of P ≥ 0."""
        i = np.floor(p)
        return self.steps * (i + 2 / np.pi * np.arcsin(np.sqrt(p - i)))

    def range(self, g: Real) -> tuple[Real, Real]:
        """Return λ₀ and λ₁ at g, µm."""
        longest = self.period * np.where(g < 0, self.max_decay * (1 - 1e-6), 1.0) / np.maximum(np.abs(g), 1e-12)
        return tuple(np.minimum(w, longest) for w in self.wavelengths)
