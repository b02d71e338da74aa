"""A compact disc, as meshes for compact_disc.xml: `python scenes/disc.py`.

Rings of the dimensions of IEC 60908: hole 15 mm, metal from 46 to 117 mm, disc 120 mm across and 1.2 mm thick. u
increases from the centre outwards and v around it, so that the tracks are along v. The clear rings have the UVs of the
table below. Lengths are cm.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from modelling import Array, command, revolved, write_sheets

THICKNESS = 0.12
HOLE, METAL, RIM, EDGE = 0.75, 2.3, 5.85, 6.0
TABLE_ROTATION, TABLE_HALF_SIDE = np.deg2rad(68), 400  # as in compact_disc.xml and rainbow.xml


def uv_of_table(points: Array) -> Array:
    """Return the UVs (n, 2) of the table below points (n, 3)."""
    cosine, sine = np.cos(TABLE_ROTATION), np.sin(TABLE_ROTATION)
    x, y = points[:, 0], points[:, 1]
    return (np.stack([cosine * x + sine * y, cosine * y - sine * x], -1) / TABLE_HALF_SIDE + 1) / 2


def make(folder: Path, count: int = 1024) -> None:
    """Write disc_metal.ply and disc_clear.ply, circles of `count` corners."""
    top = THICKNESS
    write_sheets(folder / "disc_metal.ply", [revolved([(METAL, top), (RIM, top)], count)])
    clear = [
        revolved([(HOLE, top), (1.68, top)], count),
        # The raised ring that separates the discs of a stack.
        revolved([(1.68, top), (1.70, top + 0.03)], count),
        revolved([(1.70, top + 0.03), (1.76, top + 0.03)], count),
        revolved([(1.76, top + 0.03), (1.78, top)], count),
        revolved([(1.78, top), (METAL, top)], count),
        revolved([(RIM, top), (EDGE - 0.02, top)], count),
        revolved([(EDGE - 0.02, top), (EDGE, top - 0.02)], count),
        revolved([(EDGE, top - 0.02), (EDGE, 0.0)], count),
        revolved([(HOLE, 0.0), (HOLE, top)], count),
    ]
    write_sheets(folder / "disc_clear.ply", clear, uv_of_table)


if __name__ == "__main__":
    command(make)
