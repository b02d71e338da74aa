"""The ground of the scenes, as textures for the scenes: `python scenes/ground.py`.

A slab of stone and a wooden table, made of periodic noise, so that they may be repeated. Lengths are cm.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from modelling import Array, command, noise, write_colours


def stone(rng: np.random.Generator, size: int) -> Array:
    """Return colours of a rough grey slab."""
    shape = (size, size)
    cloud, grain = noise(rng, shape, 1.5, 0.3), noise(rng, shape, 0.4)
    shade = 0.45 * (1 + 0.13 * cloud + 0.09 * grain)
    return shade[..., None] * (np.array([1.0, 0.95, 0.88]) + 0.03 * noise(rng, shape, 1.6, 0.2)[..., None])


def wood(rng: np.random.Generator, size: int) -> Array:
    """Return colours of boards along u: growth rings cut nearly along the trunk, and fibres."""
    shape = (size // 2, size)
    boards, per_board = 4, shape[0] // 4
    rows = []
    for _ in range(boards):
        # A lengthwise cut through the round rings of a trunk shows parabolas, with nearly straight lines beside them.
        across = np.linspace(-1, 1, per_board)[:, None] + rng.uniform(-0.5, 0.5)
        bend = noise(rng, shape, 2.0, 0.7)[:per_board]
        ring = 7 * np.hypot(across + 0.16 * bend, 0.35 + 0.1 * noise(rng, shape, 2.2, 1.0)[:per_board])
        rows.append(0.5 + 0.5 * np.cos(2 * np.pi * ring + 0.5 * np.sin(4 * np.pi * ring)) + rng.normal(0, 0.12))
    ring = np.concatenate(rows)
    # Fibres are long along the trunk.
    fibre = noise(rng, (shape[0], 64), 0.3).repeat(size // 64, 1)
    fibre = 0.5 * (fibre + np.roll(fibre, size // 128, 1)) + 0.7 * noise(rng, shape, 0.5)
    row = np.arange(shape[0]) % per_board
    gap = np.minimum(row, per_board - 1 - row)[:, None] < 2
    tone = np.clip(0.5 + 0.28 * (ring - 0.5) + 0.07 * fibre, 0, 1)[..., None]
    colour = (1 - tone) * np.array([0.33, 0.20, 0.12]) + tone * np.array([0.60, 0.41, 0.26])
    return np.where(gap[..., None], 0.25 * colour, colour)


def make(folder: Path, size: int = 2048) -> None:
    """Write stone.png and wood.png, `size` texels wide."""
    write_colours(folder / "stone.png", stone(np.random.default_rng(1), size))
    write_colours(folder / "wood.png", wood(np.random.default_rng(2), size))


if __name__ == "__main__":
    command(make)
