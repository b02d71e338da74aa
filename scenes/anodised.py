"""A watch with an anodised titanium dial, as meshes and textures for anodised.xml: `python scenes/anodised.py`.

The dial is covered by overlapping circles, each with grooves around its centre, as by a turning tool. The oxide gets
thinner from the centre to the rim, as with the voltage. Lengths are cm, thicknesses of the oxide µm; the dial is in the
plane z = 0, and twelve is along +y.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from modelling import Array, Sheet, command, quad, revolved, write_numbers, write_sheets

DIAL = 1.75  # radius
CIRCLE, PITCH = 0.27, 0.34  # radius of the circles; distance of their centres
THICKNESS = (0.2, 0.135)  # of the oxide in the centre and at the rim
# Radius and height of the case from the rim of the dial outwards.
CASE = ((1.74, 0), (1.76, 0.16), (1.84, 0.2), (2.02, 0.14), (2.1, 0.02), (2.12, -0.2), (2.1, -0.55), (1.9, -0.72))
# Degrees, length, half width and height.
HANDS = ((-56, 0.95, 0.055, 0.10), (48, 1.4, 0.04, 0.14), (182, 1.5, 0.012, 0.17))


def _texels(count: int) -> Array:
    return ((np.arange(count) + 0.5) / count - 0.5) * 2 * DIAL


def orientation(columns: int) -> Array:
    """Return the angle in degrees from x to the radius of the circle at each texel, the last drawn: a square."""
    texels = _texels(columns)
    angle = np.zeros((columns, columns))
    for row, centre_y in enumerate(np.arange(-DIAL, DIAL + PITCH, PITCH * np.sqrt(3) / 2)):
        for centre_x in np.arange(-DIAL - PITCH * (row % 2) / 2, DIAL + PITCH, PITCH):
            of_y, of_x = (slice(*np.searchsorted(texels, (c - CIRCLE, c + CIRCLE))) for c in (centre_y, centre_x))
            x, y = np.meshgrid(texels[of_x] - centre_x, texels[of_y] - centre_y)
            part = angle[of_y, of_x]
            part[:] = np.where(np.hypot(x, y) < CIRCLE, np.rad2deg(np.arctan2(y, x)), part)
    return angle


def smooth(profile: Array) -> Array:
    """Return a profile with rounded corners, by cutting these four times (Chaikin 1974)."""
    for _ in range(4):
        first, last = profile[:-1], profile[1:]
        inner = np.stack([0.75 * first + 0.25 * last, 0.25 * first + 0.75 * last], 1).reshape(-1, 2)
        profile = np.concatenate([profile[:1], inner[1:-1], profile[-1:]])
    return profile


def bar(degrees: float, start: float, end: float, half_width: float, bottom: float, top: float) -> list[Sheet]:
    """Return the top and the sides of a bar along a radius, clockwise from twelve."""
    phi = np.deg2rad(degrees)
    along, across = np.array([np.sin(phi), np.cos(phi)]), half_width * np.array([np.cos(phi), -np.sin(phi)])
    corners = [start * along + across, end * along + across, end * along - across, start * along - across]
    low, high = ([(x, y, z) for x, y in corners] for z in (bottom, top))
    sides = [quad((low[i], low[(i + 1) % 4], high[i], high[(i + 1) % 4])) for i in range(4)]
    return [quad((high[0], high[1], high[3], high[2])), *sides]


def strap(side: int, count: int = 60) -> Sheet:
    """Return one half of the strap, from the case to the ground and along it."""
    t = np.linspace(0, 1, count)[:, None]
    y, z = 1.9 + 8 * t, -0.62 + 0.24 * np.exp(-((5 * t) ** 2)) - 0.08 * t
    phi = np.linspace(0, 2 * np.pi, 65)
    x, height = 1.0 * np.sign(np.cos(phi)) * np.abs(np.cos(phi)) ** 0.2, 0.13 * np.sin(phi)
    points = np.stack([-side * x + 0 * t, side * (y + 0 * x), z + height], -1)
    return points, np.linspace(0, 1, 65), t[:, 0]


def uv_of_dial(points: Array) -> Array:
    """Return the UVs (n, 2) of the dial at points (n, 3)."""
    return points[:, :2] / (2 * DIAL) + 0.5


def make(folder: Path, columns: int = 1600) -> None:
    """Write watch_*.ply, anodised_turn.exr, `columns` pixels wide, and anodised_oxide.exr."""
    write_numbers(folder / "anodised_turn.exr", orientation(columns))
    radius = np.hypot(*np.meshgrid(_texels(256), _texels(256)))
    write_numbers(folder / "anodised_oxide.exr", np.interp(radius, [0, DIAL], THICKNESS))
    dial = revolved([(0.02, 0), (DIAL, 0)], 256)
    write_sheets(folder / "watch_dial.ply", [dial], uv_of_dial)
    write_sheets(folder / "watch_case.ply", [revolved(smooth(np.array(CASE)), 512)])
    bars = [sheet for hour in range(12) for sheet in bar(30 * hour, 1.3, 1.6, 0.035 + 0.03 * (hour % 3 == 0), 0, 0.06)]
    for degrees, length, half_width, height in HANDS:
        bars += bar(degrees, -0.3, length, half_width, height - 0.025, height)
    pivot = revolved([(0.001, 0.2), (0.07, 0.2), (0.09, 0.18), (0.09, 0)], 64)
    write_sheets(folder / "watch_hands.ply", [*bars, pivot])
    write_sheets(folder / "watch_strap.ply", [strap(-1), strap(1)])


if __name__ == "__main__":
    command(make)
