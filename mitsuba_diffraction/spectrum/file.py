"""A grating spectrum as an OpenEXR file: float32, ZIP, one part, one pixel per diffraction order.

Channels are named after what they hold. "taylor": `F{(h/H)^003}.re` and `.im`, the real and imaginary parts of the
Fourier coefficients of the third power of the centred, scaled heights. "slices": `eta(012.2)`, the order powers at the
third Chebyshev point of interval 12 of κ. Rows are orders m_y, columns m_x, from −M to M.
Numbers in the header are double precision.
"""

from __future__ import annotations

import contextlib
import io
import os
import sys
from collections.abc import Iterator
from pathlib import Path

import numpy as np
import OpenEXR

from ..expansions.taylor import TaylorSeries
from ..files import whole_file
from .grating_spectrum import GratingSpectrum
from .orders import OrderGrid
from .series_table import SeriesTable
from .slice_table import SliceTable

FORMAT = "mitsuba_diffraction grating spectrum"
FORMAT_VERSION = 1


@contextlib.contextmanager
def _silence() -> Iterator[None]:
    """Keep the library from giving its own account of a broken file, from Python and from C, before it raises."""
    sys.stderr.flush()
    kept, nowhere = os.dup(2), os.open(os.devnull, os.O_WRONLY)
    try:
        os.dup2(nowhere, 2)
        with contextlib.redirect_stdout(io.StringIO()):
            yield
    finally:
        os.dup2(kept, 2)
        os.close(kept)
        os.close(nowhere)


def _doubles(*values: float) -> np.ndarray:
    # A Python float would be written in single precision.
    return np.array(values, np.float64)


def save(spectrum: GratingSpectrum, path: str | os.PathLike[str]) -> None:
    """Write `spectrum` to `path`, whole or not at all.

    Raises:
        OSError: if the file cannot be written.
    """
    header = {
        "type": OpenEXR.scanlineimage,
        "compression": OpenEXR.ZIP_COMPRESSION,
        "format": FORMAT,
        "formatVersion": FORMAT_VERSION,
        "representation": spectrum.representation,
        "extent": spectrum.extent,
        "heightRange": _doubles(spectrum.height_range),
        "pixelSize": _doubles(*spectrum.pixel_size),
        "tileSize": _doubles(*spectrum.grid.tile_size),
        "coherenceLength": _doubles(spectrum.coherence_length),
        "wavelengths": _doubles(*spectrum.wavelengths),
        "tolerance": _doubles(spectrum.tolerance),
        "error": _doubles(spectrum.error),
        "source": spectrum.source,
        "sourceSha256": spectrum.source_digest,
        "units": "lengths in micrometres, wavelengths in nanometres",
    }
    channels = _CHANNELS[spectrum.representation](spectrum.table)
    header["channelCount"] = len(channels)
    with whole_file(path) as temporary:
        OpenEXR.File(header, channels).write(str(temporary))


def load(path: str | os.PathLike[str]) -> GratingSpectrum:
    """Read a spectrum that `save` wrote.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a spectrum, is damaged, or is of a version or representation not known here.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with _silence():
            file = OpenEXR.File(str(path), separate_channels=True)
            header, channels = file.header(), file.channels()
    except Exception as error:
        raise ValueError(f"{path}: not a readable OpenEXR file ({_one_line(error)})") from None
    if header.get("format") != FORMAT:
        raise ValueError(
            f"{path}: an OpenEXR file, but not a grating spectrum, which mitsuba-diffraction precompute writes"
        )
    if header.get("formatVersion") != FORMAT_VERSION:
        raise ValueError(
            f"{path}: got format version {header.get('formatVersion')}, wanted {FORMAT_VERSION}; "
            "build the spectrum again with this version of mitsuba_diffraction"
        )
    if header.get("representation") not in _TABLES:
        raise ValueError(
            f"{path}: got representation {header.get('representation')!r}, wanted one of {', '.join(_TABLES)}"
        )
    try:
        pixels = {name: channel.pixels for name, channel in channels.items()}
        if halves := [name for name, values in pixels.items() if values.dtype != np.float32]:
            raise ValueError(f"{halves[0]} is not of type float")
        height_range, wavelengths = _single(header["heightRange"]), _pair(header["wavelengths"])
        table = _TABLES[header["representation"]](pixels, height_range, 4 * np.pi / (wavelengths[0] * 1e-3))
        names = _CHANNELS[header["representation"]](table).keys()
        if pixels.keys() != names or len(names) != header["channelCount"]:
            unknown = ", ".join(sorted(pixels.keys() - names)) or "none unknown"
            raise ValueError(f"got {len(pixels)} channels ({unknown}), wanted {header['channelCount']} of known names")
        rows, columns = table.shape
        return GratingSpectrum(
            table=table,
            grid=OrderGrid(_pair(header["tileSize"]), ((columns - 1) // 2, (rows - 1) // 2)),
            pixel_size=_pair(header["pixelSize"]),
            height_range=height_range,
            coherence_length=_single(header["coherenceLength"]),
            wavelengths=wavelengths,
            tolerance=_single(header["tolerance"]),
            error=_single(header["error"]),
            source=header["source"],
            source_digest=header["sourceSha256"],
            extent=header["extent"],
        )
    except KeyError as error:
        raise ValueError(f"{path}: a damaged spectrum, {error} is missing") from None
    except (TypeError, ValueError, IndexError) as error:
        raise ValueError(f"{path}: a damaged spectrum ({_one_line(error)})") from None


def _series_channels(table: SeriesTable) -> dict[str, np.ndarray]:
    channels = {}
    for n, term in enumerate(table.coefficients):
        channels[f"F{{(h/H)^{n:03d}}}.re"] = np.ascontiguousarray(term.real)
        channels[f"F{{(h/H)^{n:03d}}}.im"] = np.ascontiguousarray(term.imag)
    return channels


def _series_table(pixels: dict[str, np.ndarray], height_range: float, largest_kappa: float) -> SeriesTable:
    terms = len(pixels) // 2
    names = [f"F{{(h/H)^{n:03d}}}" for n in range(terms)]
    coefficients = np.stack([pixels[name + ".re"] + 1j * pixels[name + ".im"] for name in names])
    return SeriesTable(TaylorSeries(height_range / 2, terms), coefficients.astype(np.complex64))


def _slice_channels(table: SliceTable) -> dict[str, np.ndarray]:
    return {
        f"eta({interval:03d}.{node})": table.values[interval, node]
        for interval in range(table.intervals)
        for node in range(4)
    }


def _slice_table(pixels: dict[str, np.ndarray], height_range: float, largest_kappa: float) -> SliceTable:
    intervals = len(pixels) // 4
    powers = [[pixels[f"eta({interval:03d}.{node})"] for node in range(4)] for interval in range(intervals)]
    return SliceTable(largest_kappa, np.array(powers, np.float32))


_CHANNELS = {TaylorSeries.NAME: _series_channels, SliceTable.representation: _slice_channels}
_TABLES = {TaylorSeries.NAME: _series_table, SliceTable.representation: _slice_table}


def _single(value: np.ndarray) -> float:
    if not isinstance(value, np.ndarray) or value.shape != (1,):
        raise ValueError(f"got {value!r}, wanted one double")
    return float(value[0])


def _pair(value: np.ndarray) -> tuple[float, float]:
    x, y = (float(v) for v in value)
    return x, y


def _one_line(error: Exception) -> str:
    return " ".join(str(error).split())
