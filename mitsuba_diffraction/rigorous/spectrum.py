"""Rigorous efficiencies of a grating as a table over direction and wavelength, and its file.

A rigorous spectrum as an OpenEXR file: float32, ZIP, one part.

Line r of the channel `eta` holds row r of the table (`Axes`), its nodes of F, X and Z one after the other; if the table
is polarised, `m(ij)` holds M_ij likewise. Numbers in the header are double precision.
"""

from __future__ import annotations

import hashlib
import os
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import RequestError
from ..settings import TRANSMISSIONS, lobe_cutoff, lobe_width
from ..spectrum.exr import doubles, one_line, read, write
from ..spectrum.grids import OrderGrid
from .efficiencies import ODD, REVERSED

Real = NDArray[np.float64]

FORMAT = "mitsuba_diffraction rigorous spectrum"
FORMAT_VERSION = 5

# Attributes, and their names in files.
_NUMBERS = {
    "ext_ior": "extIor",
    "coherence_length": "coherenceLength",
    "tolerance": "tolerance",
    "error": "error",
    "max_error": "worst",
    "max_error_near": "worstNear",
    "polarisation_error": "polarisationError",
}
_TEXTS = {"material": "material", "source": "source", "source_digest": "sourceDigest"}
_STEPS = ("stepsF", "stepsX", "stepsZ")


_MARGIN = 0.25
LARGEST_PERIOD = 10.0
"""In units of the shortest wavelength: the table grows with the cube of the period, the time to build it faster."""


@dataclass(frozen=True)
class Axes:
    """The coordinates of the table: such that η is smooth between whole numbers, and the same for reversed light.

    With ν = T/λ, directions enter by three numbers, symmetric under exchange of ω_i and ω_o but for the sign of c:

        k_y = (ω_o,y − ω_i,y) ν / 2,    γ² = ν² − k_y²,    c = (ω_o,x − ω_i,x) ν / 2.

    In units of 2π/T, γ is the wave number across the grooves, and γ'² = γ² + (n² − 1) ν² that below. Light of order m
    comes in with k_x = c + m/2 and leaves with c − m/2, n + α and n − m + α with a whole n and |α| ≤ 1/2. With
    α < 0 it is reversed, −c for c: a = |α| is left. Where an order passes off (Rayleigh anomaly) η has a square root,
    on either side: where γ or γ' is one of

        h₀ = a,  h₁ = 1 − a,  h₂ = 1 + a,  h₃ = 2 − a,  …,

    the |n + a| of n = 0, −1, 1, −2, … In cell j, from h_{j−1} to h_j, the first j of these propagate. Within it η is
    smooth in X, and with F instead of a also where cells end in a point,

        X / (1 − X) = √(t / (1 − t)),    t = (γ² − h_{j−1}²) / (h_j² − h_{j−1}²),    sin²(π F / 2) = 2 a,

    from 0 to 1, X steeper at its ends: light that grazes the surface above enters the denser medium within few degrees.
    Of γ' likewise sin²(π Z / 2) = t'. Cell 0 above, where light travels below only, begins at the least γ² that the
    shortest wavelength admits in the cell of γ', h'_{j−1}² − `top`. Without transmission (index 0) Z is the wavelength,
    from the shortest to the longest that γ admits (k_y² ≥ 0):

        λ = λ₀ + (λ₁ − λ₀) Z,    λ₀ = min(λ_min, T/γ),    λ₁ = min(λ_max, T/γ).

    A block of the table is a pair of cells of γ and γ'; it has a row for each pair of orders that come in and leave,
    those above before those below, and the nodes of a row are at equal steps of F, X and Z.

    Attributes:
        period: T in µm.
        wavelengths: (shortest, longest) in µm.
        steps: of F, X and Z.
        index: n of the medium below, relative to that above; 0 if Z is the wavelength.
        transmission: one of `TRANSMISSIONS`; a sheet has air below.
    """

    period: float
    wavelengths: tuple[float, float]
    steps: tuple[int, int, int]
    index: float = 0.0
    transmission: str = "none"

    @property
    def excess(self) -> float:
        """n² − 1, or 0."""
        return self.index**2 - 1 if self.index else 0.0

    @property
    def top(self) -> float:
        """The largest (n² − 1) ν², and a margin, so that a cell 0 in which there is light does not end in a point."""
        return self.excess * self.largest**2 + np.sign(self.excess) * _MARGIN

    @property
    def largest(self) -> float:
        """The largest ν."""
        return self.period / self.wavelengths[0]

    @property
    def max_order(self) -> int:
        """M, the largest order that any pair of directions reaches."""
        return int(np.ceil(2 * self.largest * (max(1.0, self.index) if self.transmission == "interface" else 1.0))) - 1

    def counts(self, cell: NDArray[np.int64] | int, inside: NDArray[np.int64] | int) -> tuple[Any, Any]:
        """Return how many orders leave above and below, from the cells of γ and γ'."""
        return cell, {"none": 0 * cell, "sheet": cell, "interface": inside}[self.transmission]

    @cached_property
    def blocks(self) -> dict[tuple[int, int], int]:
        """The cells of γ and γ' that light has → the first row of their block; γ' has cell 0 if Z is the wavelength."""
        # Between two of these a, edges of cells are monotonous.
        a = np.linspace(0, 0.5, 65)
        top = self.largest**2
        least = min(-self.excess * top, 0.0) if self.transmission == "interface" else 0.0
        cells = [self._edges(j, a, least) for j in range(int(2 * self.largest) + 3)]
        inner = cells
        if self.index:
            inner = [self._edges(j, a, -top) for j in range(int(2 * max(1, self.index) * self.largest) + 3)]
        found, row = {}, 0
        for j, (low, high) in enumerate(cells):
            if j == 0 and least == 0:
                continue
            ends = []
            for square in (low, np.minimum(high, top)):
                shortest = np.maximum((self.period / self.wavelengths[1]) ** 2, square)
                ends.append(square + np.sort([self.excess * shortest, np.full_like(square, self.excess * top)], axis=0))
            for k, (low_inside, high_inside) in enumerate(inner):
                there = (low < top) & (ends[0][0] < high_inside) & (ends[1][1] > low_inside)
                if (there if self.index else (low < top) & (k == 0)).any() and sum(self.counts(j, k)):
                    found[j, k] = row
                    row += sum(self.counts(j, k)) ** 2
        return found

    @staticmethod
    def _edges(cell: int, a: Real, least: float) -> tuple[Real, Real]:
        """Return bounds of γ² in a cell, from each a to the next."""
        low, high = edges_of(cell, a, least)
        return np.minimum(low[:-1], low[1:]), np.maximum(high[:-1], high[1:])

    @cached_property
    def starts(self) -> NDArray[np.int64]:
        """The first row of each block, [cell of γ, cell of γ'], −1 where there is none."""
        found = np.full(np.max(list(self.blocks), axis=0) + 1, -1)
        for cells, row in self.blocks.items():
            found[cells] = row
        return found

    @property
    def rows(self) -> int:
        """Pairs of orders in all blocks."""
        return max(row + sum(self.counts(*cells)) ** 2 for cells, row in self.blocks.items())

    @property
    def shape(self) -> tuple[int, int, int, int]:
        """Of the table: rows and nodes of F, X and Z."""
        f, x, z = self.steps
        return self.rows, f + 1, x + 1, z + 1

    def locate(
        self, m: NDArray[np.int64], c: Real, g: Real, wavelength: Real, sides: tuple[int, int]
    ) -> tuple[NDArray[np.bool_], NDArray[np.bool_], NDArray[np.int64], list[Real]]:
        """Return whether order m propagates, whether it is reversed light, its row, and F, X and Z; g = ±√|γ²|."""
        nu = self.period / wavelength
        square = g * np.abs(g)
        inside = square + self.excess * nu**2
        k_x = c + m / 2
        n = np.rint(k_x).astype(np.int64)
        back = k_x < n
        a = np.abs(k_x - n)
        cell, cell_inside = cell_of(square, a), cell_of(inside, a) if self.index else np.zeros_like(n)
        cells = [np.minimum(x, size - 1) for x, size in zip((cell, cell_inside), self.starts.shape, strict=True)]
        row, counts, channels = self.starts[tuple(cells)], self.counts(*cells), []
        there = (row >= 0) & (self.largest * (1 + 1e-9) >= nu) & (nu * (1 + 1e-9) >= self.period / self.wavelengths[1])
        for there_side, back_side, order in (
            (*sides, np.where(back, m - n, n)),
            (*sides[::-1], np.where(back, -n, n - m)),
        ):
            side = np.where(back, back_side, there_side)
            there &= rank(order) < np.where(side, counts[1], counts[0])
            channels.append(rank(order) + np.where(side, counts[0], 0))
        row = row + channels[0] * (counts[0] + counts[1]) + channels[1]
        low, low_inside = (edges_of(x, a, 0.0)[0] for x in (cell, cell_inside))
        t = share_of(square, *edges_of(cell, a, low_inside - self.top))
        places = [arc(2 * a), np.sqrt(t) / (np.sqrt(t) + np.sqrt(1 - t))]
        if self.index:
            places.append(arc(share_of(inside, *edges_of(cell_inside, a, low + self.top))))
        else:
            first, last = self.range(g)
            places.append(np.clip((wavelength - first) / np.maximum(last - first, 1e-9), 0, 1))
        return there, back, row, places

    def range(self, g: Real) -> tuple[Real, Real]:
        """Return λ₀ and λ₁ at γ = g, µm."""
        longest = self.period / np.maximum(g, 1e-12)
        return np.minimum(self.wavelengths[0], longest), np.minimum(self.wavelengths[1], longest)


def rank(n: NDArray[np.int64]) -> NDArray[np.int64]:
    """Return the place of n in 0, −1, 1, −2, …: j of h_j = |n + a|."""
    return np.where(n >= 0, 2 * n, -2 * n - 1)


def edges_of(cell: Any, a: Real, least: Any) -> tuple[Real, Real]:
    """Return h² at the beginning and at the end of a cell; cell 0 begins at `least`."""
    half = np.where(cell % 2, 0.5 - a, a)
    return np.where(cell > 0, (cell / 2 - half) ** 2, least), (cell / 2 + half) ** 2


def cell_of(square: Real, a: Real) -> NDArray[np.int64]:
    """Return in which cell γ² lies."""
    whole, part = np.divmod(np.sqrt(np.maximum(square, 0)), 1)
    return (2 * whole + (part >= a) + (part >= 1 - a)).astype(np.int64)


def share_of(square: Real, low: Real, high: Real) -> Real:
    """Return t of γ² in a cell."""
    share: Real = np.clip((square - low) / np.maximum(high - low, 1e-30), 0, 1)
    return share


def arc(share: Real) -> Real:
    """Return Z of t, or F of 2 a."""
    angle: Real = 2 / np.pi * np.arcsin(np.sqrt(share))
    return angle


def shares_at(steps: tuple[int, int, int]) -> tuple[Real, Real, Real]:
    """Return 2 a, t of γ² and t of γ'² at equal steps of F, X and Z."""
    f, x, z = (np.arange(count + 1) / count for count in steps)
    return np.sin(np.pi / 2 * f) ** 2, x**2 / (x**2 + (1 - x) ** 2), np.sin(np.pi / 2 * z) ** 2


@dataclass(frozen=True, eq=False)
class RigorousSpectrum:
    """η_m of unpolarised light as a table, and what else a BSDF needs: f = Σ_m η_m N(q − m/T; σ_q² I) n_o² / λ².

    Side 0 is above, side 1 below. With transmission "interface" the medium of `int_ior` is below; of a "sheet" it is
    air. The sides' light is one reciprocal set.

    Attributes:
        axes: of the table.
        values: η at the nodes, (rows, F, X, Z).
        mueller: M_ij there, (rows, F, X, Z, 4, 4), or None. Elements that are odd in k_y are divided by k_y/ν: all are
            smooth where k_y = 0.
        material: a conductor by Mitsuba's name, or "" for a dielectric.
        int_ior: n + ik if there is no material.
        coherence_length: L_c in µm; it sets the width σ_q of each order.
        tolerance: what was asked for.
        error: what was measured at directions (uniform over the hemisphere) and wavelengths that were not used to build
            the tables: the mean of Σ|Δη_m| / Σ η_m, the sum over all orders that leave, on either side; with
            transmission, light comes from either side.
        max_error: the largest of these, away from the lines of Rayleigh anomalies (P or R within 0.02 of an integer).
        max_error_near: the largest of these near such a line.
        harmonics: N of the solver.
        source: where the heights came from.
        source_digest: SHA-256 of the height field.
        ext_ior: index of the medium above relative to air; wavelengths are those in this medium.
        polarisation_error: of the matrices, as `error`: the mean of Σ_m max_ij |ΔM_ij| / Σ η_m; NaN if there are none.
    """

    axes: Axes
    values: NDArray[np.float32]
    mueller: NDArray[np.float32] | None
    material: str
    int_ior: complex
    coherence_length: float
    tolerance: float
    error: float
    max_error: float
    max_error_near: float
    harmonics: int
    source: str
    source_digest: str = field(repr=False)
    ext_ior: float = 1.0
    polarisation_error: float = float("nan")

    def __post_init__(self) -> None:
        if self.transmission not in TRANSMISSIONS:
            raise RequestError(f"transmission: got {self.transmission!r}, wanted one of {', '.join(TRANSMISSIONS)}")
        for name, wanted in (("values", self.axes.shape), ("mueller", (*self.axes.shape, 4, 4))):
            table = getattr(self, name)
            if table is not None and (table.shape != wanted or table.dtype != np.float32):
                raise RequestError(f"{name}: got {table.shape} of {table.dtype}, wanted {wanted} of float32")
        lobe_width(self.coherence_length)

    @property
    def transmission(self) -> str:
        """One of `TRANSMISSIONS`."""
        return self.axes.transmission

    @property
    def indices(self) -> tuple[float, float]:
        """Of the media of side 0 and side 1, relative to that of side 0."""
        return 1.0, self.int_ior.real if self.transmission == "interface" else 1.0

    # As a `GratingSpectrum` has them.
    extent = "tile"
    representation = "rigorous"
    largest_angle = 90.0

    @property
    def wavelengths(self) -> tuple[float, float]:
        """(shortest, longest) in nm."""
        shortest, longest = (1e3 * w for w in self.axes.wavelengths)
        return shortest, longest

    @property
    def grid(self) -> OrderGrid:
        """The orders m that any pair of directions reaches."""
        return OrderGrid((self.axes.period, self.axes.period), (self.axes.max_order, 0))

    @property
    def material_name(self) -> str:
        """As recipes and scenes give it."""
        medium = "" if self.ext_ior == 1 else f" below ext_ior {self.ext_ior:.6g}"
        if self.material:
            return f"material {self.material}{medium}"
        index = self.int_ior.real if np.imag(self.int_ior) == 0 else self.int_ior
        return f"int_ior {index:.6g}{medium}"

    @property
    def megabytes(self) -> float:
        """Size of the table in memory."""
        return (self.values.nbytes + (0 if self.mueller is None else self.mueller.nbytes)) / 1e6

    @property
    def lobe_width(self) -> float:
        """σ_q in cycles/µm."""
        return lobe_width(self.coherence_length)

    @property
    def cutoff_sigmas(self) -> float:
        """How far the lobe of an order is followed, in standard deviations σ_q: a tenth of the tolerance is beyond."""
        return lobe_cutoff(0.1 * self.tolerance)

    @cached_property
    def digest(self) -> str:
        """SHA-256 of what a renderer needs of it: spectra that have one show the same."""
        description = repr(
            (self.axes, self.material, self.int_ior, self.coherence_length, self.tolerance, self.ext_ior)
        )
        arrays = [a for a in (self.values, self.mueller) if a is not None]
        return hashlib.sha256(description.encode() + b"".join(a.tobytes() for a in arrays)).hexdigest()

    def evaluate(
        self,
        m: ArrayLike,
        c: ArrayLike,
        g: ArrayLike,
        wavelength: ArrayLike,
        sides: tuple[int, int] = (0, 0),
        mueller: bool = False,
    ) -> Real:
        """Return η_m of light from a side to a side, or its Mueller matrix, linear between the nodes.

        With n_i and n_o the `indices` of the sides of ω_i and ω_o, and ν = T/λ,

            c = (n_o ω_o,x − n_i ω_i,x) ν / 2,    k_y = (n_o ω_o,y − n_i ω_i,y) ν / 2,    g = ± √|ν² − k_y²|,

        g of the sign of ν² − k_y².

        Args:
            m: orders, broadcast against the others.
            c, g: as above.
            wavelength: µm, in the medium of side 0.
            sides: from which the light comes and to which it leaves, 0 above and 1 below.
            mueller: whether to return M_ij, (…, 4, 4), of light with k_y ≥ 0.

        Returns:
            η_m; 0 for an order that does not propagate, or that is beyond the wavelengths of the table.

        Raises:
            ValueError: if there is no such table.
        """
        if self.transmission == "none" and sides != (0, 0):
            raise RequestError(f"sides: got {sides!r} of a table with transmission none, wanted (0, 0)")
        if mueller and self.mueller is None:
            raise RequestError("mueller: got a table of unpolarised light, wanted one built with polarised=True")
        table: NDArray[np.float32] = self.mueller if mueller and self.mueller is not None else self.values
        m, c, g, wavelength = np.broadcast_arrays(np.asarray(m, np.int64), c, g, wavelength)
        there, back, row, places = self.axes.locate(m, c, g, wavelength, sides)
        row = np.where(there, row, 0)
        result = np.zeros((*m.shape, *table.shape[4:]))
        wide = (..., *[None] * (table.ndim - 4))
        nodes = [_split(x * steps, steps) for x, steps in zip(places, self.axes.steps, strict=True)]
        for corner in np.ndindex(2, 2, 2):
            place, weights = zip(
                *((low + up, f if up else 1 - f) for (low, f), up in zip(nodes, corner, strict=True)), strict=True
            )
            result += np.prod(weights, axis=0)[wide] * table[(row, *place)]
        if mueller:
            reversed_light = np.outer(REVERSED, REVERSED) * np.swapaxes(result, -1, -2)
            result = np.where(back[wide], reversed_light, result)
            across = np.sqrt(np.maximum(1 - g * np.abs(g) * (wavelength / self.axes.period) ** 2, 0))
            result *= np.where(ODD, across[wide], 1)
        return np.where(there[wide], result, 0)

    def efficiencies(
        self, direction: ArrayLike, wavelength: float, transmitted: bool = False
    ) -> tuple[NDArray[np.int64], Real]:
        """Return the orders that propagate, ascending, and η_m of unpolarised light, as `rigorous.efficiencies`.

        Args:
            direction: ω_i, (3,), to the light; from below if ω_i,z < 0.
            wavelength: µm, in the medium of side 0.
            transmitted: the orders that leave on the other side, instead of those reflected.
        """
        omega = np.asarray(direction, np.float64) / np.linalg.norm(direction)
        side = int(omega[2] < 0)
        to = 1 - side if transmitted else side
        nu = self.axes.period / wavelength
        alpha, k_y = -omega[:2] * self.indices[side] * nu
        square = nu**2 - k_y**2
        g_out = np.sqrt(max((self.indices[to] * nu) ** 2 - k_y**2, 0))
        m = np.arange(np.ceil(alpha - g_out), np.floor(alpha + g_out) + 1).astype(int)
        m = m[np.abs(alpha - m) < g_out]
        g = np.sign(square) * np.sqrt(abs(square))
        return m, self.evaluate(m, alpha - m / 2, g, wavelength, (side, to))

    def save(self, path: str | os.PathLike[str], recipe: str = "") -> None:
        """Write the spectrum as an OpenEXR file, whole or not at all; `recipe` is the digest of its `Recipe`.

        Raises:
            OSError: if the file cannot be written.
        """
        axes = self.axes
        index = complex(self.int_ior)
        arrays = {"eta": self.values.reshape(axes.rows, -1)}
        if self.mueller is not None:
            matrices = self.mueller.reshape(axes.rows, -1, 4, 4)
            arrays |= {_channel(i, j): np.ascontiguousarray(matrices[..., i, j]) for i, j in np.ndindex(4, 4)}
        header = {
            "period": doubles(axes.period),
            "wavelengths": doubles(*axes.wavelengths),
            **dict(zip(_STEPS, axes.steps, strict=True)),
            "index": doubles(axes.index),
            "harmonics": self.harmonics,
            "polarised": int(self.mueller is not None),
            "intIor": doubles(index.real, index.imag),
            **{key: doubles(getattr(self, name)) for name, key in _NUMBERS.items()},
            "transmission": self.transmission,
            **{key: getattr(self, name) for name, key in _TEXTS.items()},
            "units": "lengths and wavelengths in micrometres",
        }
        write(path, FORMAT, FORMAT_VERSION, header, arrays, recipe)

    @classmethod
    def load(cls, path: str | os.PathLike[str], recipe: str | None = None) -> RigorousSpectrum:
        """Read a spectrum that `save` wrote.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if the file is not a rigorous spectrum, is damaged, or was not built from that recipe.
        """
        path = Path(path)
        header, channels = read(path, FORMAT, FORMAT_VERSION, recipe)
        try:
            (period,), (shortest, longest), (index,) = header["period"], header["wavelengths"], header["index"]
            steps = tuple(header[name] for name in _STEPS)
            axes = Axes(float(period), (float(shortest), float(longest)), steps, float(index), header["transmission"])
            mueller = None
            if header["polarised"]:
                found = [channels[_channel(i, j)].pixels for i, j in np.ndindex(4, 4)]
                mueller = np.stack(found, axis=-1).reshape(*axes.shape, 4, 4)
            return cls(
                axes=axes,
                values=np.ascontiguousarray(channels["eta"].pixels.reshape(axes.shape)),
                mueller=mueller,
                int_ior=complex(*(float(x) for x in header["intIor"])),
                harmonics=header["harmonics"],
                **{name: header[key].item() for name, key in _NUMBERS.items()},
                **{name: header[key] for name, key in _TEXTS.items()},
            )
        except KeyError as error:
            raise RequestError(f"{path}: a damaged spectrum, {error} is missing") from None
        except (TypeError, ValueError, IndexError, AttributeError) as error:
            raise RequestError(f"{path}: a damaged spectrum ({one_line(error)})") from None


def _split(x: Real, steps: int) -> tuple[NDArray[np.int64], Real]:
    """Return the node below x, at most the last but one, and how far x is beyond it."""
    low = np.clip(np.floor(x).astype(np.int64), 0, steps - 1)
    return low, x - low


def _channel(i: int, j: int) -> str:
    return f"m({i}{j})"
