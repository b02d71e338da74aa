"""A sheet of holographic foil, as a mesh and a texture for foil.xml: `python scenes/foil.py`.

The sheet has been crumpled and laid flat again: folds in random directions, rounded, and both ends curl up. It is
embossed with shards (Voronoi regions of random sites), each with a grating of one of three pitches in a direction of
its own. Lengths are cm.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from modelling import Array, command, write_numbers, write_sheets
from scipy.ndimage import gaussian_filter
from scipy.spatial import cKDTree

WIDTH, HEIGHT = 30.0, 17.0
SHARDS = 330
PITCHES = (0.8, 1.0, 1.3)  # µm


def crumpled(rng: np.random.Generator, x: Array, y: Array) -> Array:
    """Return heights (n_y, n_x): sums of folds, each a zigzag across a bent line."""
    height = np.zeros((y.size, x.size))
    pixel = x[1] - x[0]
    for pitch in (9.0, 6.5, 5.0, 3.8, 2.9, 2.2, 1.7):
        angle = rng.uniform(0, np.pi)
        across = np.cos(angle) * x + np.sin(angle) * y[:, None]
        along = -np.sin(angle) * x + np.cos(angle) * y[:, None]
        bent = across + 0.12 * pitch * np.sin(2 * np.pi * (along / (2.3 * pitch) + rng.random()))
        zigzag = 2 * np.abs((bent / pitch + rng.random()) % 1 - 0.5)
        # Folds have a finite length.
        envelope = 0.5 + 0.5 * np.cos(2 * np.pi * (along / (4 * pitch) + rng.random()))
        height += 0.03 * pitch * zigzag * envelope
    return gaussian_filter(height, 0.12 / pixel)


def sheet(count: int) -> tuple[Array, Array, Array]:
    """Return points (n_v, n_u, 3), u and v."""
    u, v = np.linspace(0, 1, count + 1), np.linspace(0, 1, round(count * HEIGHT / WIDTH) + 1)
    x, y = (u - 0.5) * WIDTH, (v - 0.5) * HEIGHT
    height = crumpled(np.random.default_rng(5), x, y)
    # The ends curl up: the direction of the sheet is the integral of its curvature.
    curvature = 0.19 * np.clip((x - 6.5) / 2, 0, 1) + 0.14 * np.clip((-x - 8.5) / 2, 0, 1)
    direction = np.cumsum(curvature) * (x[1] - x[0])
    direction -= np.interp(0, x, direction)
    along, up = (np.cumsum(f(direction)) * (x[1] - x[0]) for f in (np.cos, np.sin))
    along, up = along - np.interp(0, x, along), up - np.interp(0, x, up)
    points = np.stack(
        [
            along - np.sin(direction) * height,
            np.broadcast_to(y[:, None], height.shape),
            up + np.cos(direction) * height,
        ],
        -1,
    )
    points[..., 2] -= points[..., 2].min()
    return points, u, v


def shards(rng: np.random.Generator, columns: int) -> tuple[Array, Array]:
    """Return directions of the grating in degrees and pitches in µm, (rows, columns) each, from the top."""
    rows = round(columns * HEIGHT / WIDTH)
    sites = rng.random((SHARDS, 2)) * (HEIGHT, WIDTH)
    y, x = (np.arange(n) + 0.5 for n in (rows, columns))
    position = np.stack(np.meshgrid(y * HEIGHT / rows, x * WIDTH / columns, indexing="ij"), -1)
    shard = cKDTree(sites).query(position)[1]
    return rng.uniform(0, 180, SHARDS)[shard], rng.choice(PITCHES, SHARDS)[shard]


def make(folder: Path, count: int = 900) -> None:
    """Write foil.ply, `count` quads long, foil_turn.exr and foil_pitch.exr."""
    write_sheets(folder / "foil.ply", [sheet(count)])
    for name, values in zip(("turn", "pitch"), shards(np.random.default_rng(6), 2 * count), strict=True):
        write_numbers(folder / f"foil_{name}.exr", values[::-1])


if __name__ == "__main__":
    command(make)
