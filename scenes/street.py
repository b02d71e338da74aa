"""A street and a pair of paper glasses, as meshes for glasses.xml: `python scenes/street.py`.

Houses stand on both sides of a road along y and across its end; some of their windows are lit. The glasses are a card
with two openings, in the plane y = 0. Lengths are m.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from modelling import Array, Sheet, command, quad, write_sheets

FACE, DEPTH, END = 7.0, 8.0, 74.0  # |x| of the houses' faces; depth behind them; y of the house across the end
# Material, y of the last corner, heights of eaves and ridge: houses on the left and on the right, from y = 3 on.
LEFT = (
    ("plaster", 15, 7.6, 10.6),
    ("brick", 28, 9.4, 12.4),
    ("plaster", 37, 6.6, 10.2),
    ("brick", 55, 9.0, 12.0),
    ("plaster", END, 7.2, 10.4),
)
RIGHT = (
    ("brick", 13, 8.8, 11.4),
    ("plaster", 24, 6.6, 9.8),
    ("brick", 39, 9.6, 12.8),
    ("plaster", 52, 7.0, 10.4),
    ("brick", END, 8.4, 11.6),
)
KERB, KERB_HEIGHT = 4.2, 0.15  # |x|
FLOOR, SPACING, WINDOW = 3.0, 2.3, (0.5, 1.5)  # heights of floors; between windows; their half width and height
LIT = 0.3  # probability of a window
EYE, OPENING, CARD = 0.0265, (0.0232, 0.018), (0.0265, 0.0213)  # |x| of the centres; half widths and half heights


def along_street(start: tuple[float, float], end: tuple[float, float], y: tuple[float, float]) -> Sheet:
    """Return a plane along the street, from the line (x, z) of `start` to that of `end`."""
    return quad([(x, some_y, z) for x, z in (start, end) for some_y in y])


def gable(side: int, y: float, eaves: float, ridge: float) -> Sheet:
    """Return the wall between two houses."""
    x = side * np.array([FACE, FACE + DEPTH / 2, FACE + DEPTH])
    points = np.stack(np.broadcast_arrays(x, y, [[0.0] * 3, [eaves, ridge, eaves]]), -1)
    return points, np.array([0, 0.5, 1]), np.array([0.0, 1.0])


def window_places(first: float, last: float, eaves: float) -> list[tuple[float, float]]:
    """Return centres and sills of the windows of a wall."""
    count = int((last - first - 0.6) / SPACING)
    centres = (first + last) / 2 + SPACING * (np.arange(count) - (count - 1) / 2)
    return [(centre, sill) for sill in np.arange(1.0, eaves - WINDOW[1] - 0.3, FLOOR) for centre in centres]


def superellipse(half: tuple[float, float], power: float, count: int) -> Array:
    """Return points (count + 1, 2) of the closed curve |x/a|^p + |z/b|^p = 1."""
    phi = np.linspace(0, 2 * np.pi, count + 1)
    unit = np.stack([np.cos(phi), np.sin(phi)], -1)
    return np.array(half) * unit / (np.abs(unit) ** power).sum(-1, keepdims=True) ** (1 / power)


def card(centre: float, count: int = 256) -> Sheet:
    """Return the ring of card around an opening; two of them meet at the nose."""
    x, z = np.stack([superellipse(OPENING, 4, count), superellipse(CARD, 12, count)], 1).transpose(2, 0, 1)
    return np.stack([x + centre, 0 * x, z], -1), np.array([0.0, 1.0]), np.linspace(0, 1, count + 1)


def make(folder: Path) -> None:
    """Write street_plaster.ply, _brick, _stone, _roofs, _lit and _dark, and glasses.ply."""
    rng = np.random.default_rng(4)
    parts: dict[str, list[Sheet]] = {name: [] for name in ("plaster", "brick", "stone", "roofs", "lit", "dark")}

    def lit_or_dark() -> list[Sheet]:
        return parts["lit" if rng.random() < LIT else "dark"]

    half, height = WINDOW
    for side, houses in ((-1, LEFT), (1, RIGHT)):
        face, ridge_x, back = (side * (FACE + depth) for depth in (0, DEPTH / 2, DEPTH))
        first = 3.0
        for material, last, eaves, ridge in houses:
            y = (first, last)
            gables = [gable(side, end, eaves, ridge) for end in y]
            parts[material] += [along_street((face, 0), (face, eaves), y), *gables]
            parts["roofs"] += [along_street((x, eaves), (ridge_x, ridge), y) for x in (face, back)]
            for centre, sill in window_places(first, last, eaves):
                x = face - 0.02 * side
                lit_or_dark().append(
                    along_street((x, sill), (x, sill + height), (centre + side * half, centre - side * half))
                )
            first = last
        kerb = side * KERB
        parts["stone"].append(along_street((kerb, 0), (kerb, KERB_HEIGHT), (0, END)))
        parts["stone"].append(along_street((kerb, KERB_HEIGHT), (face, KERB_HEIGHT), (0, END)))
    parts["stone"] += [along_street((-0.07, 0.01), (0.07, 0.01), (y, y + 1.5)) for y in np.arange(2.0, END, 3.5)]
    ends, eaves = (-FACE - DEPTH, FACE + DEPTH), 7.4
    parts["plaster"].append(quad([(x, END, z) for z in (0, eaves) for x in ends]))
    parts["roofs"].append(quad([(x, END + dy, eaves + dy) for dy in (0, 4) for x in ends]))
    for centre, sill in window_places(-FACE, FACE, eaves):
        window = [(centre + s * half, END - 0.02, z) for z in (sill, sill + height) for s in (-1, 1)]
        lit_or_dark().append(quad(window))
    for name, sheets in parts.items():
        write_sheets(folder / f"street_{name}.ply", sheets)
    write_sheets(folder / "glasses.ply", [card(-EYE), card(EYE)])


if __name__ == "__main__":
    command(make)
