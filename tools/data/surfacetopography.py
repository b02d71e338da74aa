"""Show what SurfaceTopography alone makes of the files for which there are work-arounds (tools/surfacetopography.md).

    python tools/data/surfacetopography.py [FOLDER]      writes the files to the folder, too

The files are those of the tests: 24 × 16 pixels of 0.25 × 0.40 µm, with heights from 0.1 to 0.9 µm; the .spm, 32 × 16
pixels of 6 × 3 µm.
"""

from __future__ import annotations

import io
import logging
import sys
import warnings
import zlib
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).parents[2] / "tests" / "surface"))
import foreign_scans as made


def uncompressed(data: bytes) -> bytes:
    """Return a Digital Surf file of one stream without compression."""
    return b"DIGITAL SURF" + data[12:512] + zlib.decompress(data[524:])


def part_of_a_scan(settings: dict, image: dict, columns: int, lines: int) -> bytes:
    """Return a Nanoscope file with an image of so many samples per line and lines."""
    return made.nanoscope(np.full((lines, columns), 0.1), settings, image)


WHOLE = {"Scan Size": "6000 nm", "Samps/line": 32, "Lines": 32, "Aspect Ratio": "1:1"}
STOPPED, HALF = ({"Aspect Ratio": ratio, "Scan Size": "6000 6000 nm"} for ratio in ("0.5", "2:1"))
FILES: dict[str, tuple[str, bytes]] = {
    "comment.tmd": ("tmd", made.tmd(b"")),
    "compressed.sur": ("sur", made.sur()),
    "arbitrary_units.sur": ("sur", uncompressed(made.sur(units=("µm", "µm", "a.u.") * 2))),
    "folder.x3p": ("x3p", made.x3p(as_text=False, folder="scan/")),
    "text.x3p": ("x3p", made.x3p()),
    "offset.x3p": ("x3p", made.x3p(as_text=False, offset="")),
    "date.x3p": ("x3p", made.x3p(as_text=False, date="yesterday")),
    "revision.x3p": ("x3p", made.x3p(as_text=False, revision="ISO5436 – 2000")),
    "two_dimensions.ibw": ("ibw", made.ibw()),
    "no_unit_of_heights.ibw": ("ibw", made.ibw(layers=1, units=(b"m", b""))),
    "stopped.spm": ("di", part_of_a_scan(WHOLE, STOPPED, 32, 16)),
    "two_to_one.spm": (
        "di",
        part_of_a_scan({**WHOLE, "Lines": 16}, HALF, 32, 16),
    ),
    "curves.jpk-qi-data": ("jpk", made.jpk(image="data-image.jpk-qi-image", curves=1000)),
    "stopped.jpk": ("jpk", made.jpk(lines=2 * made.ROWS)),
    "spacing.nms": ("nms", made.nms()),
    "integers.nms": ("nms", made.nms(first=1000, last=60000)),
}


def read(kind: str, data: bytes) -> str:
    """Return the size and the heights of the first channel that the library reads, or its error."""
    from SurfaceTopography.IO import lookup_reader_by_format

    try:
        channels = lookup_reader_by_format[kind](io.BytesIO(data)).channels
        channel = next((c for c in channels if c.dim == 2), None)
        if channel is None:
            return f"{len(channels)} channels, none of them an image"
        topography = channel.topography() if channel.unit is not None else channel.topography(unit="um")
        heights, size = np.ma.asarray(topography.heights(), float), topography.physical_sizes
    except Exception as error:
        return f"{type(error).__name__}: {' '.join(str(error).split())[:90]}"
    columns, rows = heights.shape
    return (
        f"{columns} × {rows} pixels, {size[0]:.4g} × {size[1]:.4g} {channel.unit}, heights {heights.min():.4g} to "
        f"{heights.max():.4g}, {np.ma.count_masked(heights)} missing"
    )


def main() -> None:
    """Print a line for each file."""
    logging.disable()
    warnings.simplefilter("ignore")
    for name, (kind, data) in FILES.items():
        if sys.argv[1:]:
            Path(sys.argv[1], name).write_bytes(data)
        print(f"{name:24} {len(data):6} bytes  {read(kind, data)}")


if __name__ == "__main__":
    main()
