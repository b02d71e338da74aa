"""The precomputed power spectrum S(q; κ) of the phase e^{iκh} of a surface, and its file.

A grating spectrum as an OpenEXR file: float32, ZIP, one part, one pixel per diffraction order or node.

Channels are named after what they hold. Series: `B{t^003}` (taylor), `B{T_003}` (chebyshev), `B{mode 003}` (svd), the
terms B_n of S = Σ g_n(κ) B_n; "slices": `S(012.2)`, the coefficient of t² on interval 12 of κ. Rows
are orders m_y, columns m_x, from −M to M. Numbers in the header are double precision. `energy` is JSON: the table of
`energy/table.py`. `contentSha256` covers every byte of the file, so that a damaged one is
known as such.
"""

from __future__ import annotations

import hashlib
import json
import os
import threading
from collections.abc import Callable
from dataclasses import dataclass, field, fields
from functools import cached_property
from pathlib import Path
from typing import TypeVar

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..energy.table import EnergyTable
from ..errors import RequestError
from ..settings import lobe_reach, lobe_width, matching
from .exr import doubles, one_line, read, write
from .orders import LobeAxis, OrderGrid
from .spline_grid import SplineGrid
from .tables import Series, SeriesTable, SliceTable, chebyshev, taylor

# The part of the tolerance that is spent on the tails of the lobes.
TAIL_SHARE = 0.4

_computing = threading.Lock()


@dataclass(frozen=True, eq=False)
class GratingSpectrum:
    """S(q; κ): Σ_m η_m(κ) N(q − m/T; σ_q² I) of a tile, or, of a sample and where many lobes overlap, B-splines.

    Attributes:
        table: η_m(κ), or the coefficients of the splines, in one of the representations.
        grid: the diffraction orders m, or the nodes, that are kept.
        extent: "tile": the patch repeats for ever; "sample": it is a piece of a larger, irregular surface.
        pixel_size: (x, y) of the height field, µm.
        height_range: of the height field, µm.
        coherence_length: L_c in µm; it sets the width σ_q of each order. Of a sample: what the scan carries.
        wavelengths: (shortest, longest) in nm for which the table holds.
        tolerance: the bound that was asked for.
        error: what was measured: max over κ of ∫|S_approx − S_exact| dq over the frequencies that light can reach.
        source: where the heights came from.
        source_digest: SHA-256 of the height field.
        largest_angle: in degrees from the normal, of both directions, for which the table holds.
        dropped: the largest share of the power, over κ, in weak frequencies that were not kept; part of `error`.
        beyond: the largest share of the power, over κ, at frequencies that no pair of directions reaches, or that the
            pixels do not resolve.
        patches: of how many draws of an irregular surface it is the mean.
        scatter: of a sample, its `standard_error`; None of a tile.
        energy: the table that bounds the albedo, if it came with the file; else `energy_table` makes it.
    """

    table: SeriesTable | SliceTable
    grid: OrderGrid | SplineGrid
    extent: str
    pixel_size: tuple[float, float]
    height_range: float
    coherence_length: float
    wavelengths: tuple[float, float]
    tolerance: float
    error: float
    source: str
    source_digest: str = field(repr=False)
    largest_angle: float = 90.0
    dropped: float = 0.0
    beyond: float = 0.0
    patches: int = 1
    scatter: float | None = None
    energy: EnergyTable | None = field(default=None, repr=False)

    def __post_init__(self) -> None:
        if self.extent not in ("tile", "sample"):
            raise RequestError(f"extent: got {self.extent!r}, wanted 'tile' or 'sample'")
        if self.table.shape != self.grid.shape:
            raise RequestError(f"table: got {self.table.shape} nodes, wanted {self.grid.shape}")
        if not all(np.isfinite(p) and p > 0 for p in self.pixel_size):
            raise RequestError(f"pixel_size: got {self.pixel_size}, wanted two positive lengths in µm")
        if not (np.isfinite(self.height_range) and self.height_range >= 0):
            raise RequestError(f"height_range: got {self.height_range}, wanted a length ≥ 0 in µm")
        if not (0 < self.tolerance < 1 and self.error >= 0 and np.isfinite(self.error)):
            raise RequestError(f"tolerance, error: got {self.tolerance}, {self.error}, wanted shares of the power")
        if not (isinstance(self.source, str) and isinstance(self.source_digest, str)):
            raise RequestError(f"source: got {self.source!r}, {self.source_digest!r}, wanted texts")
        if not (0 <= self.dropped <= 1 and 0 <= self.beyond <= 1):
            raise RequestError(f"dropped, beyond: got {self.dropped}, {self.beyond}, wanted shares of the power")
        if not (isinstance(self.patches, int) and self.patches >= 1):
            raise RequestError(f"patches: got {self.patches!r}, wanted a whole number of at least 1")
        if (self.scatter is not None) != (self.extent == "sample") or not 0 <= (self.scatter or 0.0) < np.inf:
            raise RequestError(f"scatter: got {self.scatter} of a {self.extent}, wanted a number ≥ 0 of a sample only")
        check_wavelengths(self.wavelengths)
        check_angle(self.largest_angle)
        lobe_width(self.coherence_length)

    @property
    def representation(self) -> str:
        """How the powers are stored: "taylor", "chebyshev", "svd" or "slices"."""
        return self.table.representation

    @property
    def standard_error(self) -> float:
        """∫ of the standard error of Welch's estimate over q, at the worst κ: of one scan about the mean of many.

        A share of the reflected power, comparable to `error`; see `sample.standard_error`.

        Raises:
            RequestError: of a tile.
        """
        if self.scatter is None:
            raise RequestError(
                "standard_error: got a tile, wanted a sample: a patch that repeats for ever is known exactly"
            )
        return self.scatter

    @property
    def largest_kappa(self) -> float:
        """4π/λ_min in rad/µm: normal incidence and exit at the shortest wavelength."""
        return 4 * np.pi / (self.wavelengths[0] * 1e-3)

    @property
    def lobe_width(self) -> float:
        """σ_q in cycles/µm."""
        return lobe_width(self.coherence_length)

    @property
    def reach(self) -> float:
        """How far the lobe of an order is followed along each axis at least, in standard deviations σ_q."""
        return lobe_reach(TAIL_SHARE * self.tolerance)

    @property
    def lobes(self) -> tuple[LobeAxis, LobeAxis]:
        """Where the lobes of the orders end along x and y.

        Raises:
            RequestError: of a lattice of splines.
        """
        if not isinstance(self.grid, OrderGrid):
            raise RequestError("lobes: got a lattice of splines, wanted a grid of orders")
        return self.grid.lobes(self.lobe_width, self.reach)

    @property
    def neighbours(self) -> tuple[int, int]:
        """How many nodes along x and y contribute at one q, to the tolerance."""
        return (self.lobes[0].count, self.lobes[1].count) if isinstance(self.grid, OrderGrid) else (3, 3)

    @property
    def words_per_evaluation(self) -> int:
        """How many words of 32 bits of the table one evaluation of S reads."""
        return self.neighbours[0] * self.neighbours[1] * self.table.words_per_node

    @property
    def megabytes(self) -> float:
        """Size of the table in memory."""
        return self.table.nbytes / 1e6

    def powers(self, kappa: float) -> NDArray[np.float32]:
        """The share of the reflected power of each node, (2 M_y + 1, 2 M_x + 1), in float32 as a renderer computes it.

        Of orders, η_m(κ). Shares may be below zero: by the error, and as coefficients of splines.

        Raises:
            ValueError: if κ (rad/µm) is outside of what the table holds.
        """
        return self.table.powers(float(self._checked(np.asarray(kappa, np.float64))))

    def evaluate(self, q: ArrayLike, kappa: ArrayLike) -> NDArray[np.float64]:
        """S(q; κ) from the table.

        Args:
            q: (..., 2) cycles/µm, along x and y.
            kappa: (...) rad/µm, 0 ≤ κ ≤ `largest_kappa`.

        Returns:
            (...) µm².

        Raises:
            ValueError: if shapes do not match or κ is outside of what the table holds.
        """
        q, kappa = matching(q, kappa)
        self._checked(kappa)
        result = np.zeros(kappa.shape)
        grid = self.grid
        around = grid.around(q, self.lobe_width, self.reach) if isinstance(grid, OrderGrid) else grid.around(q)
        for row, column, weight in around:
            result += weight * self.table.powers_at(row, column, kappa)
        # Interpolation may dip below zero by its error.
        return np.maximum(result, 0)

    def _checked(self, kappa: NDArray[np.float64]) -> NDArray[np.float64]:
        if not (np.all(kappa >= 0) and np.all(kappa <= self.largest_kappa * (1 + 1e-6))):
            raise RequestError(
                f"kappa: got values from {np.min(kappa):.6g} to {np.max(kappa):.6g} rad/µm, wanted 0 to "
                f"{self.largest_kappa:.6g} (the spectrum was built for wavelengths from {self.wavelengths[0]:g} nm)"
            )
        return kappa

    def energy_table(self) -> EnergyTable:
        """Return what bounds the albedo by one; made at the first call unless it came with the file."""
        with _computing:
            return self._energy

    @cached_property
    def _energy(self) -> EnergyTable:
        return EnergyTable.of(self) if self.energy is None else self.energy

    @cached_property
    def digest(self) -> str:
        """SHA-256 of what a renderer needs of it: spectra that have one show the same."""
        content = hashlib.sha256()
        for f in fields(self):
            if f.name not in ("table", "energy", "source", "source_digest"):
                content.update(f"{f.name}={getattr(self, f.name)!r};".encode())
        for array in self.table.content():
            content.update(array.data)
        return content.hexdigest()

    def save(self, path: str | os.PathLike[str], recipe: str = "") -> None:
        """Write the spectrum as an OpenEXR file, whole or not at all; `recipe` is the digest of its `Recipe`.

        Raises:
            OSError: if the file cannot be written.
        """
        save(self, path, recipe)

    @classmethod
    def load(cls, path: str | os.PathLike[str], recipe: str | None = None) -> GratingSpectrum:
        """Read a spectrum that `save` wrote.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is not a spectrum, is damaged (be it by a single bit), is of a version or representation
                not known here, or was not built from that recipe.
        """
        return load(path, cls, recipe)


def check_wavelengths(wavelengths: tuple[float, float]) -> None:
    """Raises ValueError unless `wavelengths` is (shortest, longest) in nm."""
    try:
        shortest, longest = (float(w) for w in wavelengths)
    except (TypeError, ValueError):
        raise RequestError(f"wavelengths: got {wavelengths!r}, wanted (shortest, longest) in nm") from None
    if not (np.isfinite([shortest, longest]).all() and 50 <= shortest < longest):
        raise RequestError(f"wavelengths: got {wavelengths!r}, wanted (shortest, longest) in nm, at least 50 nm")


def check_angle(largest_angle: float) -> None:
    """Raises ValueError unless `largest_angle` is an angle from the normal in degrees."""
    if not 0 < largest_angle <= 90:
        raise RequestError(f"largest_angle: got {largest_angle!r}, wanted degrees from the normal, above 0, at most 90")


Spectrum = TypeVar("Spectrum")
FORMAT = "mitsuba_diffraction grating spectrum"
FORMAT_VERSION = 6


def save(spectrum: GratingSpectrum, path: str | os.PathLike[str], recipe: str = "") -> None:
    """Write `spectrum` to `path`, whole or not at all; `recipe` is the digest of that from which it was built.

    Raises:
        OSError: if the file cannot be written.
    """
    header = {
        "representation": spectrum.representation,
        "extent": spectrum.extent,
        "heightRange": doubles(spectrum.height_range),
        "pixelSize": doubles(*spectrum.pixel_size),
        **_grid_header(spectrum.grid),
        "coherenceLength": doubles(spectrum.coherence_length),
        "wavelengths": doubles(*spectrum.wavelengths),
        "tolerance": doubles(spectrum.tolerance),
        "error": doubles(spectrum.error),
        "largestAngle": doubles(spectrum.largest_angle),
        "dropped": doubles(spectrum.dropped),
        "beyond": doubles(spectrum.beyond),
        "patches": spectrum.patches,
        **({"standardError": doubles(spectrum.standard_error)} if spectrum.extent == "sample" else {}),
        "source": spectrum.source,
        "sourceSha256": spectrum.source_digest,
        "units": "lengths in micrometres, wavelengths in nanometres",
    }
    if isinstance(spectrum.table, SeriesTable) and spectrum.representation == "svd":
        # repr of a float is exact.
        header["modes"] = json.dumps(spectrum.table.series.modes.tolist())
    header["energy"] = json.dumps(spectrum.energy_table().as_plain())
    channels = _channels(spectrum.table)
    header["channelCount"] = len(channels)
    write(path, FORMAT, FORMAT_VERSION, header, channels, recipe)


def load(path: str | os.PathLike[str], construct: Callable[..., Spectrum], recipe: str | None = None) -> Spectrum:
    """Hand what `save` wrote to the constructor of a `GratingSpectrum`; errors as in `GratingSpectrum.load`."""
    path = Path(path)
    header, channels = read(path, FORMAT, FORMAT_VERSION, recipe)
    if header.get("representation") not in _REPRESENTATIONS:
        raise RequestError(
            f"{path}: got representation {header.get('representation')!r}, wanted one of {', '.join(_REPRESENTATIONS)}"
        )
    try:
        pixels = {name: channel.pixels for name, channel in channels.items()}
        if halves := [name for name, values in pixels.items() if values.dtype != np.float32]:
            raise RequestError(f"{halves[0]} is not of type float")
        wavelengths = _pair(header["wavelengths"])
        table = _table(header, pixels, 4 * np.pi / (wavelengths[0] * 1e-3))
        names = _channels(table).keys()
        if pixels.keys() != names or len(names) != header["channelCount"]:
            unknown = ", ".join(sorted(pixels.keys() - names)) or "none unknown"
            raise RequestError(
                f"got {len(pixels)} channels ({unknown}), wanted {header['channelCount']} of known names"
            )
        return construct(
            table=table,
            grid=_grid(header, table.shape),
            extent=header["extent"],
            pixel_size=_pair(header["pixelSize"]),
            height_range=_single(header["heightRange"]),
            coherence_length=_single(header["coherenceLength"]),
            wavelengths=wavelengths,
            tolerance=_single(header["tolerance"]),
            error=_single(header["error"]),
            source=header["source"],
            source_digest=header["sourceSha256"],
            largest_angle=_single(header["largestAngle"]),
            dropped=_single(header["dropped"]),
            beyond=_single(header["beyond"]),
            patches=header["patches"],
            scatter=_single(header["standardError"]) if header["extent"] == "sample" else None,
            energy=EnergyTable.from_plain(json.loads(header["energy"])),
        )
    except KeyError as error:
        raise RequestError(f"{path}: a damaged spectrum, {error} is missing") from None
    except (TypeError, ValueError, IndexError, AttributeError, OverflowError, MemoryError) as error:
        raise RequestError(f"{path}: a damaged spectrum ({one_line(error)})") from None


def _grid_header(grid: OrderGrid | SplineGrid) -> dict[str, np.ndarray]:
    if isinstance(grid, OrderGrid):
        return {"tileSize": doubles(*grid.tile_size)}
    return {"spacing": doubles(*grid.spacing), "limit": doubles(*grid.limit)}


def _grid(header: dict, shape: tuple[int, int]) -> OrderGrid | SplineGrid:
    largest = ((shape[1] - 1) // 2, (shape[0] - 1) // 2)
    if "tileSize" in header:
        return OrderGrid(_pair(header["tileSize"]), largest)
    return SplineGrid(_pair(header["spacing"]), largest, _pair(header["limit"]))


_TERM_NAMES = {
    "taylor": "B{{t^{:03d}}}",
    "chebyshev": "B{{T_{:03d}}}",
    "svd": "B{{mode {:03d}}}",
}
_REPRESENTATIONS = (*_TERM_NAMES, SliceTable.representation)


def _channels(table: SeriesTable | SliceTable) -> dict[str, np.ndarray]:
    if isinstance(table, SliceTable):
        return {f"S({k:03d}.{p})": table.values[k, p] for k, p in np.ndindex(table.intervals, table.terms)}
    return {_TERM_NAMES[table.representation].format(n): term for n, term in enumerate(table.terms)}


def _table(header: dict, pixels: dict[str, np.ndarray], largest_kappa: float) -> SeriesTable | SliceTable:
    kind, count = header["representation"], header["channelCount"]
    if kind == SliceTable.representation:
        powers = 4 if "S(000.3)" in pixels else 3
        values = [[pixels[f"S({k:03d}.{p})"] for p in range(powers)] for k in range(count // powers)]
        return SliceTable(largest_kappa, np.array(values, np.float32))
    terms = np.stack([pixels[_TERM_NAMES[kind].format(n)] for n in range(count)])
    if kind == "svd":
        series = Series(kind, largest_kappa, np.array(json.loads(header["modes"]), np.float64))
    else:
        series, _ = (taylor if kind == "taylor" else chebyshev)(largest_kappa, count)
    return SeriesTable(series, terms)


def _single(value: np.ndarray) -> float:
    if not isinstance(value, np.ndarray) or value.shape != (1,):
        raise RequestError(f"got {value!r}, wanted one double")
    return float(value[0])


def _pair(value: np.ndarray) -> tuple[float, float]:
    x, y = (float(v) for v in value)
    return x, y
