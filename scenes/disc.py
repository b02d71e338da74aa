"""A compact disc, as meshes for compact_disc.xml: `python scenes/disc.py`.

Rings of the dimensions of IEC 60908: hole 15 mm, metal from 46 to 117 mm, disc 120 mm across and 1.2 mm thick. u
increases from the centre outwards and v around it, so that the tracks are along v. The clear rings have the UVs of the
table below. Lengths are cm.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from modelling import Array, command, write_sheets

THICKNESS = 0.12
HOLE, METAL, RIM, EDGE = 0.75, 2.3, 5.85, 6.0
TABLE_ROTATION, TABLE_HALF_SIDE = np.deg2rad(68), 400  # as in compact_disc.xml and rainbow.xml


def ring(inner: tuple[float, float], outer: tuple[float, float], count: int) -> tuple[Array, Array, Array]:
    """Return the sheet between two circles, each given by (radius, height)."""
    u, v = np.linspace(0, 1, 3), np.linspace(0, 1, count + 1)
    radius, height = ((1 - u) * a + u * b for a, b in zip(inner, outer, strict=True))
    phi = 2 * np.pi * v[:, None]
    points = np.stack([radius * np.cos(phi), radius * np.sin(phi), height + 0 * phi], -1)
    return points, u, v


def uv_of_table(points: Array) -> Array:
    """Return the UVs (n, 2) of the table below points (n, 3)."""
    cosine, sine = np.cos(TABLE_ROTATION), np.sin(TABLE_ROTATION)
    x, y = points[:, 0], points[:, 1]
    return (np.stack([cosine * x + sine * y, cosine * y - sine * x], -1) / TABLE_HALF_SIDE + 1) / 2


def make(folder: Path, count: int = 1024) -> None:
    """Write disc_metal.ply and disc_clear.ply, circles of `count` corners."""
    top = THICKNESS
    write_sheets(folder / "disc_metal.ply", [ring((METAL, top), (RIM, top), count)])
    clear = [
        ring((HOLE, top), (1.68, top), count),
        # The raised ring that separates the discs of a stack.
        ring((1.68, top), (1.70, top + 0.03), count),
        ring((1.70, top + 0.03), (1.76, top + 0.03), count),
        ring((1.76, top + 0.03), (1.78, top), count),
        ring((1.78, top), (METAL, top), count),
        ring((RIM, top), (EDGE - 0.02, top), count),
        ring((EDGE - 0.02, top), (EDGE, top - 0.02), count),
        ring((EDGE, top - 0.02), (EDGE, 0.0), count),
        ring((HOLE, 0.0), (HOLE, top), count),
    ]
    write_sheets(folder / "disc_clear.ply", clear, uv_of_table)


if __name__ == "__main__":
    command(make)
