"""An anodised titanium plate, as textures for anodised.xml: `python scenes/anodised.py`.

The plate is covered by overlapping circles, each with grooves around its centre, as by a turning tool. The thickness of
the oxide increases with u, as with the voltage. Lengths are cm, thicknesses µm.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from modelling import Array, command, write_numbers

WIDTH, HEIGHT = 16.0, 7.0  # of the plate, as in anodised.xml
RADIUS, PITCH = 1.25, 1.6  # of the circles; of their centres
THICKNESS = (0.01, 0.25)


def orientation(x: Array, y: Array) -> Array:
    """Return the angle in degrees from x to the radius of the circle at each point, the last drawn."""
    angle = np.zeros_like(x)
    for row, centre_y in enumerate(np.arange(-HEIGHT / 2, HEIGHT / 2 + PITCH, PITCH * np.sqrt(3) / 2)):
        for centre_x in np.arange(-WIDTH / 2 - PITCH * (row % 2) / 2, WIDTH / 2 + PITCH, PITCH):
            inside = np.hypot(x - centre_x, y - centre_y) < RADIUS
            angle = np.where(inside, np.rad2deg(np.arctan2(y - centre_y, x - centre_x)), angle)
    return angle


def make(folder: Path, columns: int = 1600) -> None:
    """Write anodised_turn.exr, `columns` pixels wide, and anodised_oxide.exr."""
    rows = round(columns * HEIGHT / WIDTH)
    x = ((np.arange(columns) + 0.5) / columns - 0.5) * WIDTH
    y = ((np.arange(rows) + 0.5) / rows - 0.5) * HEIGHT
    write_numbers(folder / "anodised_turn.exr", orientation(*np.meshgrid(x, y)))
    write_numbers(folder / "anodised_oxide.exr", np.linspace(*THICKNESS, 256)[None])


if __name__ == "__main__":
    command(make)
