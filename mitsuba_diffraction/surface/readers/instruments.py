"""Instrument formats, read by SurfaceTopography (an optional extra).

The extension determines the reader: the library would otherwise also try general-purpose formats.
"""

from __future__ import annotations

import logging
import re
import warnings
from collections.abc import Iterator
from contextlib import contextmanager, nullcontext
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ...errors import RequestError
from ...files.reading import check_array
from . import hdf5, scan, workarounds
from .scan import EXTRA, Channel, Scan, choose_channel

# Formats that SurfaceTopography names by their extension, and others.
_NAMED_ALIKE = (
    "al3d bcr datx ezd frt ibw jpk lext mdt mi mnt nms oir opd opdx os3d plu plux poir sdf sur tmd x3p zmg zon"
)
_NAMED_OTHERWISE = (
    {".bcrf": "bcr", ".dat": "metropro", ".nid": "ezd", ".spm": "di"}
    | dict.fromkeys((".vk4", ".vk6", ".vk7"), "vk")
    | dict.fromkeys((".cur", ".stp", ".tom", ".top"), "wsxm")
    | dict.fromkeys((".jpk-qi-image", ".jpk-qi-data", ".jpk-force-map"), "jpk")
)
PRIVATE_TIFF = {50434: ".tiff of Park Systems", 32834: ".jpk"}
"""Tag of a TIFF whose picture is a preview → what stands for its extension: heights are in tags or on other pages."""
FORMATS = {f".{name}": name for name in _NAMED_ALIKE.split()} | _NAMED_OTHERWISE | {PRIVATE_TIFF[50434]: "ps"}
"""Extension → SurfaceTopography's name of the format, in addition to Nanoscope's numbers (.000, .001, …)."""

NAMES = (
    "Nanoscope .spm .000, Nanosurf .nid .ezd, Park .tiff, Igor .ibw, JPK .jpk .h5-jpk .jpk-qi-image .jpk-qi-data, "
    "NT-MDT .mdt, WSxM .stp .top, ISO 25178-71 .sdf, X3P .x3p, Digital Surf .sur, Zygo .dat .datx, Wyko .opd, "
    "Keyence .vk4, Sensofar .plu .plux, NanoFocus .nms, TrueMap .tmd and others"
)


def format_of(extension: str) -> str | None:
    """Return SurfaceTopography's name of the format for this extension (lower case), if it is an instrument format."""
    return "di" if re.fullmatch(r"\.\d{3}", extension) else FORMATS.get(extension)


def read_instrument(path: Path, unit: str | tuple[str, str] | None, channel: str | int | None, extension: str) -> Scan:
    """Read one channel of an instrument file of that extension; the top row of its image is row 0."""
    with warnings.catch_warnings(), _quiet():
        warnings.simplefilter("ignore")  # of the library, on optional dependencies and metadata
        try:
            from SurfaceTopography.IO import lookup_reader_by_format
        except ImportError as error:
            raise RequestError(f"an instrument's own format: wanted SurfaceTopography, {EXTRA} ({error})") from None
        name = format_of(extension) or ""
        library = lookup_reader_by_format[name]
        contents, doubts, has_unit_of_heights = workarounds.rewritten(path, name)
        try:
            with hdf5.opened(path) if name == "datx" else nullcontext():
                found = {c.index: c for c in library(contents).channels}
            chosen = choose_channel(
                [
                    Channel(number, c.name or "untitled", c.dim == 2 and c.data_kind.value == "height", c.dim == 1)
                    for number, c in found.items()
                ],
                channel,
            )
            source = found[chosen.number]
            check_array([int(n) for n in source.nb_grid_pts], path.stat().st_size)
            given, own = scan.pair(unit), source.unit or ""
            along = scan.scale(own, given[0], "its lengths")
            high = scan.scale_of_heights(own if has_unit_of_heights else "", unit)
            topography = source.topography() if source.unit is not None else source.topography(unit=given[0])
            heights: NDArray[np.float64] = np.ma.asarray(topography.heights(), np.float64).T
            size = topography.physical_sizes
        except RequestError:
            raise
        # Readers of binary files raise arbitrary exceptions; whether the file is damaged, nobody knows.
        except Exception as error:
            raise RequestError(
                f"not read as a file of {library.name()}: it is another one, incomplete, or of a kind that "
                "SurfaceTopography does not know; if the instrument's program opens it, export it as .gsf, .gwy or "
                f".sdf ({type(error).__name__}{f': {error}' if str(error) else ''})"
            ) from None
        if name == "nms":
            heights, factor = workarounds.nms(path, heights)
            along *= factor
    rows, columns = heights.shape
    doubt = doubts[chosen.number] if doubts else ""
    if not own and size == (columns, rows):
        size = None  # without a unit these are pixels
    if name == "jpk":
        x, y, doubt = workarounds.jpk(source.info["raw_metadata"], heights.shape)
        size = x * size[0], y * size[1]
    if name == "ibw" and size is not None:
        note = source.info.get("raw_metadata", {})
        doubt = workarounds.ibw(note, (along * size[0], along * size[1]), heights.shape)
    pixel_size = (size[0] * along / columns, size[1] * along / rows) if size is not None else None
    return Scan(heights * high, pixel_size, chosen.name, doubt)


@contextmanager
def _quiet() -> Iterator[None]:
    """Silence loggers: the library logs the whole content of a damaged file."""
    before = logging.root.manager.disable
    logging.disable()
    try:
        yield
    finally:
        logging.disable(before)
