"""The mesh of a coiled snake, from the scenes of the package, with fewer vertices and in whole numbers."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from .arrays import encoded

_PACKAGE = Path(__file__).parents[1]
_STEP = 1, 2  # around and along the body, of the vertices that are kept
_LEVELS = 65535


def coil() -> dict[str, Any] | None:
    """Return the vertices (rows, columns, 3), rows around the body and columns along it, as whole numbers; or None.

    None where the package is installed without its scenes. Positions are `origin` + `step` · integer; u of
    a column is its number times `step_of_u`, at most one.
    """
    roots = (_PACKAGE / "examples", _PACKAGE.parent)
    path = next((root / "scenes/coil/snake.ply" for root in roots if (root / "scenes/coil/snake.ply").is_file()), None)
    if path is None:
        return None
    content = path.read_bytes()
    head, _, body = content.partition(b"end_header\n")
    count = int(head.partition(b"element vertex ")[2].split()[0])
    vertices = np.frombuffer(body, "<f4", 8 * count).reshape(count, 8)
    columns = len(np.unique(vertices[:, 6]))
    grid = vertices.reshape(-1, columns, 8)
    keep = [np.unique(np.append(np.arange(0, n, step), n - 1)) for n, step in zip(grid.shape, _STEP, strict=False)]
    positions = grid[np.ix_(*keep)][..., :3].astype(np.float64)
    origin, step = positions.min((0, 1)), np.ptp(positions, axis=(0, 1)) / _LEVELS
    numbers = np.rint((positions - origin) / step).astype(np.uint16)
    return {
        "positions": encoded(numbers),
        "origin": origin.tolist(),
        "step": step.tolist(),
        "step_of_u": _STEP[1] / (columns - 1),
    }
