"""Figures: made without a window, and saved as small PNG files."""

from __future__ import annotations

import io
import os
from typing import TYPE_CHECKING

from ..files.outputs import png_text
from ..files.writing import whole_file

if TYPE_CHECKING:
    from matplotlib.figure import Figure


def figure(width: float, height: float) -> Figure:
    """Return an empty figure, size in inches, that is not shown in a window."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def png(drawn: Figure, dpi: float = 110) -> bytes:
    """Encode a figure as a PNG of a palette of 256 colours, half the size of a PNG of all colours; with the mark."""
    from PIL import Image

    whole, reduced = io.BytesIO(), io.BytesIO()
    drawn.savefig(whole, format="png", dpi=dpi)
    with Image.open(whole) as picture:
        picture = picture.convert("RGB")
        palette = picture.quantize(256, kmeans=2)
        # Pillow mixes colours only for a palette that it is given.
        mixed = picture.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG)
        mixed.save(reduced, format="png", optimize=True, pnginfo=png_text())
    return reduced.getvalue()


def save_png(drawn: Figure, path: str | os.PathLike[str]) -> None:
    """Write a figure as such a PNG, atomically."""
    with whole_file(path) as temporary:
        temporary.write_bytes(png(drawn))
