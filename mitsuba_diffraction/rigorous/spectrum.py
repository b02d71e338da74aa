"""Rigorous efficiencies of a grating as a table over direction and wavelength, and its file.

A rigorous spectrum as an OpenEXR file: float32, ZIP, one part.

Channel `eta(07)` holds plane 7 of each table (`Axes`), one below the other: the squares [P, R] of the orders −M … M
from top to bottom, each at the left; below them, if the table is polarised, the Mueller matrices of this plane, one
after the other. Numbers in the header are double precision.
"""

from __future__ import annotations

import dataclasses
import hashlib
import os
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import RequestError
from ..settings import TRANSMISSIONS, lobe_cutoff, lobe_width
from ..spectrum.exr import doubles, one_line, read, write
from ..spectrum.grids import OrderGrid
from .efficiencies import REVERSED

Real = NDArray[np.float64]

FORMAT = "mitsuba_diffraction rigorous spectrum"
FORMAT_VERSION = 3

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
_TEXTS = ("material", "transmission", "source", "source_digest")


WAYS = ((0, 0), (1, 1), (0, 1))
"""From which side to which the light of each of `RigorousSpectrum.tables` goes."""

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
        """Return by how much P and R of order m are less than D + g + k_x and D + g − k_x of the incident light."""
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
        """Return how many nodes order m has along P, and along R."""
        return self.units(m) * self.steps + 1

    def offset(self, m: int) -> int:
        """Return where the nodes of order m start in a plane: [P, R] of order −M first."""
        return sum(self.side(k) ** 2 for k in range(-self.max_order, m))

    def square(self, values: NDArray[np.float32], m: int) -> NDArray[np.float32]:
        """Return those of order m, (K, P, R), of `values` (K, nodes)."""
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
        return np.minimum(self.wavelengths[0], longest), np.minimum(self.wavelengths[1], longest)


@dataclass(frozen=True, eq=False)
class Table:
    """η_m of unpolarised light over `Axes`.

    Attributes:
        axes: what the table stands over.
        values: (K, nodes) float32, η at the nodes of `axes`; of order m, side² values from offset(m), [P, R].
        mueller: (K, nodes, 4, 4) float32, the Mueller matrices of the orders for k_y ≥ 0, between
            waves in (ê, k̂ × ê), ê the direction of ŷ − (ŷ·k̂)k̂; or None.
    """

    axes: Axes
    values: NDArray[np.float32] = field(repr=False)
    mueller: NDArray[np.float32] | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        wanted = self.axes.planes, self.axes.nodes
        if self.values.shape != wanted or self.values.dtype != np.float32:
            raise RequestError(f"values: got {self.values.shape} of {self.values.dtype}, wanted {wanted} of float32")
        if self.mueller is not None:
            matrices = (*wanted, 4, 4)
            if self.mueller.shape != matrices or self.mueller.dtype != np.float32:
                raise RequestError(f"mueller: got {self.mueller.shape}, wanted {matrices} of float32")

    def evaluate(self, m: ArrayLike, c: ArrayLike, g: ArrayLike, wavelength: ArrayLike, mueller: bool = False) -> Real:
        """Return η_m, or M_ij (…, 4, 4), at c, g and λ of `Axes`; other arguments as of `RigorousSpectrum.evaluate`."""
        table: NDArray[np.float32] = self.mueller if mueller and self.mueller is not None else self.values
        m, c, g, wavelength = np.broadcast_arrays(np.asarray(m, np.int64), c, g, wavelength)
        axes = self.axes
        p, r, there = axes.coordinates(m, c, g, wavelength)
        p, r, order = (np.where(there, v, 0) for v in (p, r, m))
        side = np.array([axes.side(k) for k in axes.orders])[order + axes.max_order]
        offset = np.array([axes.offset(k) for k in axes.orders])[order + axes.max_order]
        first, last = axes.range(g)
        z = np.clip((wavelength - first) / np.maximum(last - first, 1e-9), 0, 1) * (axes.planes - 1)
        result = np.zeros((*m.shape, *table.shape[2:]))
        wide = (..., *[None] * (table.ndim - 2))
        places = [_split(axes.position(p), side), _split(axes.position(r), side), _split(z, axes.planes)]
        for corner in np.ndindex(2, 2, 2):
            (i, j, k), weights = zip(
                *((low + up, f if up else 1 - f) for (low, f), up in zip(places, corner, strict=True)), strict=True
            )
            result += np.prod(weights, axis=0)[wide] * table[k, offset + i * side + j]
        return np.where(there[wide], result, 0)


@dataclass(frozen=True, eq=False)
class RigorousSpectrum:
    """η_m of unpolarised light as tables, and what else a BSDF needs: f = Σ_m η_m N(q − m/T; σ_q² I) n_o² / λ².

    Side 0 is above, side 1 below. With transmission "interface" the medium of `int_ior` is below; of a "sheet" it is
    air. The sides' light is one reciprocal set, of which `tables` holds three: what is reflected above, what is
    reflected below, and what crosses from above to below. Light that crosses from below is the reverse of the last.

    Attributes:
        tables: of reflected light alone, (above → above,); with transmission (above → above, below → below,
            above → below).
        transmission: one of `TRANSMISSIONS`.
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

    tables: tuple[Table, ...]
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
    transmission: str = "none"
    polarisation_error: float = float("nan")

    def __post_init__(self) -> None:
        if self.transmission not in TRANSMISSIONS:
            raise RequestError(f"transmission: got {self.transmission!r}, wanted one of {', '.join(TRANSMISSIONS)}")
        wanted = 1 if self.transmission == "none" else 3
        if len(self.tables) != wanted:
            raise RequestError(f"tables: got {len(self.tables)}, wanted {wanted} for transmission {self.transmission}")
        lobe_width(self.coherence_length)

    @property
    def axes(self) -> Axes:
        """Of the light that is reflected above."""
        return self.tables[0].axes

    @property
    def values(self) -> NDArray[np.float32]:
        """Of the light that is reflected above."""
        return self.tables[0].values

    @property
    def mueller(self) -> NDArray[np.float32] | None:
        """Of the light that is reflected above."""
        return self.tables[0].mueller

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
        """Size of the tables in memory."""
        arrays = [a for table in self.tables for a in (table.values, table.mueller) if a is not None]
        return sum(a.nbytes for a in arrays) / 1e6

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
        axes = [table.axes for table in self.tables]
        description = repr((axes, self.material, self.int_ior, self.coherence_length, self.tolerance, self.ext_ior))
        arrays = [a for table in self.tables for a in (table.values, table.mueller) if a is not None]
        return hashlib.sha256(
            (description + self.transmission).encode() + b"".join(a.tobytes() for a in arrays)
        ).hexdigest()

    def evaluate(
        self,
        m: ArrayLike,
        c: ArrayLike,
        g: ArrayLike,
        wavelength: ArrayLike,
        sides: tuple[int, int] = (0, 0),
        mueller: bool = False,
    ) -> Real:
        """Return η_m of light from a side to a side, from the tables, or its Mueller matrix, linear between the nodes.

        With n_i and n_o the `indices` of the sides of ω_i and ω_o, and ν = T/λ,

            c = (n_o ω_o,x − n_i ω_i,x) ν / 2,    k_y = (n_o ω_o,y − n_i ω_i,y) ν / 2,    g = ± √|ν² − k_y²|,

        g of the sign of ν² − k_y². Light that crosses upwards is evaluated as the reversed light, with −c.

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
        if len(self.tables) == 1 and sides != (0, 0):
            raise RequestError(f"sides: got {sides!r} of a table with transmission none, wanted (0, 0)")
        if mueller and self.mueller is None:
            raise RequestError("mueller: got a table of unpolarised light, wanted one built with polarised=True")
        table = self.tables[WAYS.index((min(sides), max(sides)))]
        upwards = sides == (1, 0)
        found = table.evaluate(m, np.negative(c) if upwards else c, g, wavelength, mueller)
        if mueller and upwards:
            found = np.outer(REVERSED, REVERSED) * np.swapaxes(found, -1, -2)
        return found

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
        axes, width = self.axes, max(table.axes.side(0) for table in self.tables)
        rows = []
        for table in self.tables:
            for m in table.axes.orders:
                square = table.axes.square(table.values, m)
                rows.append(np.pad(square, [(0, 0), (0, 0), (0, width - square.shape[2])]))
            if table.mueller is not None:
                matrices = table.mueller.reshape(axes.planes, -1)
                matrices = np.pad(matrices, [(0, 0), (0, -matrices.shape[1] % width)])
                rows.append(matrices.reshape(axes.planes, -1, width))
        sheet = np.concatenate(rows, axis=1)
        index = complex(self.int_ior)
        header = {
            "period": doubles(axes.period),
            "wavelengths": doubles(*axes.wavelengths),
            "steps": axes.steps,
            "planes": axes.planes,
            "harmonics": self.harmonics,
            "polarised": int(self.mueller is not None),
            "intIor": doubles(index.real, index.imag),
            **{key: doubles(getattr(self, name)) for name, key in _NUMBERS.items()},
            **{_camel(name): getattr(self, name) for name in _TEXTS},
            "units": "lengths and wavelengths in micrometres",
        }
        write(path, FORMAT, FORMAT_VERSION, header, {_channel(k): plane for k, plane in enumerate(sheet)}, recipe)

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
            (period,), (shortest, longest) = header["period"], header["wavelengths"]
            first = Axes(float(period), (float(shortest), float(longest)), header["steps"], header["planes"])
            index = complex(*(float(x) for x in header["intIor"]))
            sheet, top, tables = np.stack([channels[_channel(k)].pixels for k in range(first.planes)]), 0, []
            for axes in axes_of(first, header["transmission"], index.real):
                squares = []
                for m in axes.orders:
                    side = axes.side(m)
                    squares.append(sheet[:, top : top + side, :side].reshape(axes.planes, side**2))
                    top += side
                mueller = None
                if header["polarised"]:
                    count = 16 * axes.nodes
                    more = -(-count // sheet.shape[2])
                    flat = sheet[:, top : top + more].reshape(axes.planes, -1)[:, :count]
                    mueller = np.ascontiguousarray(flat.reshape(axes.planes, axes.nodes, 4, 4))
                    top += more
                tables.append(Table(axes, np.ascontiguousarray(np.concatenate(squares, axis=1)), mueller))
            return cls(
                tables=tuple(tables),
                int_ior=index,
                harmonics=header["harmonics"],
                **{name: header[key].item() for name, key in _NUMBERS.items()},
                **{name: header[_camel(name)] for name in _TEXTS},
            )
        except KeyError as error:
            raise RequestError(f"{path}: a damaged spectrum, {error} is missing") from None
        except (TypeError, ValueError, IndexError, AttributeError) as error:
            raise RequestError(f"{path}: a damaged spectrum ({one_line(error)})") from None


def _split(x: Real, count: NDArray[np.int64] | int) -> tuple[NDArray[np.int64], Real]:
    """Return the node below x, at most the last but one, and how far x is beyond it."""
    low = np.clip(np.floor(x).astype(np.int64), 0, np.maximum(np.asarray(count) - 2, 0))
    return low, x - low


def axes_of(axes: Axes, transmission: str, index: float) -> tuple[Axes, ...]:
    """Return those of `RigorousSpectrum.tables`, from those of the light that is reflected above."""
    index = index if transmission == "interface" else 1.0
    ways = WAYS[:1] if transmission == "none" else WAYS
    return tuple(dataclasses.replace(axes, index=index, way=way) for way in ways)


def _channel(plane: int) -> str:
    return f"eta({plane:02d})"


def _camel(name: str) -> str:
    first, *others = name.split("_")
    return first + "".join(word.capitalize() for word in others)
