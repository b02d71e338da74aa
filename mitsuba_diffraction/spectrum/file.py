"""A grating spectrum as an OpenEXR file: float32, ZIP, one part, one pixel per diffraction order or node.

Channels are named after what they hold. Series: `B{t^003}` (taylor), `B{T_003}` (chebyshev), `B{mode 003}` (svd), the
terms B_n of S = Σ g_n(κ) B_n; "slices": `S(012.2)`, the coefficient of t² on interval 12 of κ. Rows
are orders m_y, columns m_x, from −M to M. Numbers in the header are double precision. `energy` is JSON: the table of
`energy/table.py`. `contentSha256` covers every byte of the file, so that a damaged one is
known as such.
"""

from __future__ import annotations

import json
import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from ..energy.table import EnergyTable
from ..errors import RequestError
from .expansions import Series, chebyshev, taylor
from .exr import doubles, one_line, read, write
from .orders import OrderGrid
from .series_table import SeriesTable
from .slice_table import SliceTable
from .spline_grid import SplineGrid

if TYPE_CHECKING:
    from .grating_spectrum import GratingSpectrum

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
    if spectrum.representation == "svd":
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
        terms = 4 if "S(000.3)" in pixels else 3
        values = [[pixels[f"S({k:03d}.{p})"] for p in range(terms)] for k in range(count // terms)]
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
