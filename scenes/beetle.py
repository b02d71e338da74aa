"""A jewel beetle like Chrysochroa fulgidissima, as meshes and textures for beetle.xml: `python scenes/beetle.py`.

The head is at +x, the left side at +y, the ground at z = 0. Lengths are cm.

1. Shell: elytra and pronotum, swept along x, with a suture between the elytra, faint ribs along them and a groove
   before the pronotum. u runs from the tip of the elytra to the front of the pronotum, v from the right margin over
   the back to the left one.
2. Body: abdomen, head, legs and antennae, swept along curves; u and v are lengths in tiles of the punctures.
3. Textures: normals of punctures, periodic; the factor of the layers' thickness, larger in a stripe along each elytron
   and the pronotum; and the direction of the grooves, which varies from rib to rib.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

import numpy as np
from modelling import Array, command, noise, normals_from_slopes, smooth_step, write_numbers, write_sheets
from scipy.interpolate import CubicSpline, PchipInterpolator
from scipy.ndimage import gaussian_filter

Sheet = tuple[Array, Array, Array]

TIP, WAIST, FRONT = -2.05, 0.95, 1.66  # x of the tip of the elytra, of their base, and of the front of the pronotum
AXIS = 0.42  # height of the widest part above the ground
RIBS = 5  # on each elytron
TILE = 0.6  # of the punctures
STRIPE = 700 / 530  # thickness of the layers in the stripes, Stavenga et al. 2011
MARGIN = np.deg2rad(104)  # of the shell, from the back


def half_axes(x: Array) -> tuple[Array, Array]:
    """Return half the width and the height of the elytra above the axis."""
    knots = [TIP, -1.95, -1.7, -1.2, -0.6, 0.0, 0.45, 0.75, WAIST]
    width = PchipInterpolator(knots, [0.06, 0.17, 0.31, 0.52, 0.685, 0.73, 0.735, 0.735, 0.66])(x)
    height = PchipInterpolator(knots, [0.02, 0.09, 0.19, 0.34, 0.46, 0.51, 0.51, 0.49, 0.40])(x)
    return width, height


def pronotum_half_axes(x: Array) -> tuple[Array, Array]:
    """Return half the width and the height of the pronotum above the axis."""
    knots = [WAIST - 0.03, 0.99, 1.1, 1.35, 1.56, FRONT]
    width = PchipInterpolator(knots, [0.60, 0.675, 0.69, 0.62, 0.50, 0.40])(x)
    height = PchipInterpolator(knots, [0.34, 0.425, 0.45, 0.44, 0.38, 0.26])(x)
    return width, height


def arch(x: Array, angle: Array, width: Array, height: Array) -> Array:
    """Return a shell over the axis, (n_angle, n_x, 3), `angle` from the back towards the left."""
    sin, cos = np.sin(angle)[:, None], np.cos(angle)[:, None]
    y, z = (np.sign(f) * np.abs(f) ** 0.9 for f in (sin, cos))
    return np.stack([np.broadcast_to(x, (len(angle), len(x))), y * width, AXIS + z * height], -1)


def elytron(columns: int, side: int) -> Sheet:
    """Return the elytron of a side, 1 for the left: it is lowered at the suture and at both edges."""
    # Denser at the tip, where the outline is round.
    x = TIP + (WAIST - TIP) * np.linspace(0, 1, columns) ** 1.3
    t = np.linspace(0, 1, columns // 3)
    angle = MARGIN * t
    width, height = half_axes(x)
    points = arch(x, angle if side > 0 else -angle[::-1], width, height)
    t = (t if side > 0 else t[::-1])[:, None]
    rib = 0.5 - 0.5 * np.cos(2 * np.pi * RIBS * t)
    fade = smooth_step(x, WAIST, WAIST - 0.5) * smooth_step(x, TIP, TIP + 0.9) * smooth_step(t, 1.0, 0.85)
    relief = 0.007 * rib * fade - 0.03 * np.exp(-t / 0.03) - 0.02 * np.exp(-(((t - 0.9) / 0.02) ** 2))
    points[..., 2] += relief * np.cos(MARGIN * t)
    points[..., 1] += side * relief * np.sin(MARGIN * t)
    # The tips part.
    points[..., 1] += side * 0.045 * smooth_step(x, TIP + 0.35, TIP) + side * 0.004
    return points, (x - TIP) / (FRONT - TIP), 0.5 + side * 0.5 * t[:, 0]


def pronotum(columns: int) -> Sheet:
    """Return the pronotum, with a shallow furrow along its middle."""
    x = np.linspace(WAIST - 0.03, FRONT, columns // 3)
    angle = np.linspace(-MARGIN, MARGIN, columns // 3)
    points = arch(x, angle, *pronotum_half_axes(x))
    points[..., 2] -= 0.02 * np.exp(-((angle[:, None] / 0.12) ** 2)) * smooth_step(x, FRONT, FRONT - 0.3)
    return points, (x - TIP) / (FRONT - TIP), 0.5 + 0.5 * angle / MARGIN


def swept(path: Array, across: Array, upwards: Array | None = None, around: int = 24) -> Sheet:
    """Return a tube along a path (n, 3) with half axes `across` and `upwards`, (n,)."""
    upwards = across if upwards is None else upwards
    tangent = np.gradient(path, axis=0)
    tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
    side = np.cross(tangent, [0.0, 0.0, 1.0])
    side /= np.linalg.norm(side, axis=1, keepdims=True)
    up = np.cross(side, tangent)
    v = np.linspace(0, 1, around + 1)
    angle = 2 * np.pi * v[:, None, None]
    points = path + np.sin(angle) * across[:, None] * side - np.cos(angle) * upwards[:, None] * up
    length = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return points, length / TILE, v * round(2 * np.pi * float(across.max()) / TILE + 1)


def limb(start: Sequence[float], end: Sequence[float], radii: Sequence[float], count: int = 40) -> Sheet:
    """Return a straight tube with round ends, whose radius passes through `radii`."""
    s = 0.5 - 0.5 * np.cos(np.linspace(0, np.pi, count))
    radius = PchipInterpolator(np.linspace(0, 1, len(radii)), radii)(s)
    length = float(np.linalg.norm(np.subtract(end, start)))
    end_distance = np.minimum(s, 1 - s) * length
    round_end = np.sqrt(np.clip(1 - (1 - np.clip(end_distance / radius.min(), 0, 1)) ** 2, 1e-4, 1))
    return swept(np.outer(1 - s, start) + np.outer(s, end), radius * round_end)


def segmented(points: Sequence[Sequence[float]], segments: int, radii: tuple[float, float], taper: float) -> Sheet:
    """Return a tube along a spline through points, of segments that widen towards their ends by `taper`."""
    t = np.linspace(0, 1, 24 * segments + 1)
    path = CubicSpline(np.linspace(0, 1, len(points)), points)(t)
    within = (t * segments) % 1
    bead = (1 - taper + taper * within) * np.sqrt(np.clip(1 - np.maximum(within - 0.8, 0) ** 2 / 0.0425, 0.05, 1))
    radius = (radii[0] + (radii[1] - radii[0]) * t) * bead
    radius[[0, -1]] = 1e-4
    return swept(path, radius)


LEGS = [  # on the left: hip, knee, ankle and claw
    [(1.25, 0.36, 0.22), (1.62, 0.92, 0.52), (2.00, 1.20, 0.07), (2.30, 1.42, 0.035)],
    [(0.45, 0.48, 0.20), (0.62, 1.12, 0.52), (0.42, 1.62, 0.07), (0.36, 2.00, 0.035)],
    [(-0.1, 0.48, 0.20), (-0.52, 1.10, 0.48), (-1.16, 1.42, 0.07), (-1.50, 1.68, 0.035)],
]
GAIT = [(0.0, 0.16), (0.1, -0.12), (-0.06, 0.16)]  # by which ankles and claws of the left and right are shifted along x


def body() -> list[Sheet]:
    """Return abdomen, head, legs and antennae."""
    x = np.linspace(TIP + 0.05, FRONT, 80)
    width = np.where(x < WAIST, half_axes(x)[0], pronotum_half_axes(np.maximum(x, 0.99))[0])
    path = np.stack([x, 0 * x, AXIS + 0 * x], -1)
    sheets = [swept(path, 0.93 * width, 0.42 * width, 48)]
    x = np.linspace(FRONT - 0.15, 2.04, 60)
    knots = [FRONT - 0.15, 1.7, 1.85, 1.97, 2.02, 2.04]
    width = PchipInterpolator(knots, [0.40, 0.41, 0.38, 0.27, 0.15, 0.002])(x)
    height = PchipInterpolator(knots, [0.28, 0.30, 0.28, 0.20, 0.11, 0.002])(x)
    sheets.append(swept(np.stack([x, 0 * x, AXIS - 0.02 - 0.35 * (x - FRONT)], -1), width, height, 48))
    for joints, shifts in zip(LEGS, GAIT, strict=True):
        for side, shift in zip((1, -1), shifts, strict=True):
            steps = ([0, 0, 0], [shift / 2, 0, 0], [shift, 0, 0], [shift, 0, 0])
            hip, knee, ankle, claw = (np.array(j) * [1, side, 1] + s for j, s in zip(joints, steps, strict=True))
            sheets.append(limb(hip, knee, [0.07, 0.105, 0.095, 0.06]))
            sheets.append(limb(knee, ankle, [0.055, 0.042, 0.05]))
            middle = (ankle + claw) / 2 - [0, 0, 0.02]
            sheets.append(segmented([ankle, middle, claw], 5, (0.042, 0.03), 0.45))
    for side in (1, -1):
        curve = [(1.93, 0.17, 0.38), (2.13, 0.33, 0.52), (2.36, 0.58, 0.55), (2.52, 0.92, 0.46)]
        sheets.append(segmented(np.array(curve) * [1, side, 1] + [0.06 * (side < 0), 0, 0], 10, (0.034, 0.02), 0.6))
    return sheets


def eyes() -> list[Sheet]:
    """Return both eyes, ellipsoids at the sides of the head."""
    u, v = np.linspace(0, 1, 65), np.linspace(0, 1, 33)
    phi, theta = 2 * np.pi * u, np.pi * (1 - v[:, None])
    unit = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], -1)
    return [(unit * [0.12, 0.11, 0.19] + [1.80, 0.335 * side, AXIS], u, v) for side in (1, -1)]


def punctures(texels: int) -> Array:
    """Return the normals of a periodic tile of small pits, and of a fine unevenness."""
    rng = np.random.default_rng(5)
    pits = 26  # along each side, jittered
    grid = (np.stack(np.meshgrid(np.arange(pits), np.arange(pits)), -1) + rng.uniform(0, 0.9, (pits, pits, 2))) / pits
    column, row = (np.minimum((grid * texels).astype(int), texels - 1).reshape(-1, 2)).T
    impulses = np.zeros((texels, texels))
    np.add.at(impulses, (row, column), -rng.uniform(0.3, 1, row.size))
    sigma = 0.0045 * texels / TILE
    height = 0.0008 * 2 * np.pi * sigma**2 * gaussian_filter(impulses, sigma, mode="wrap")
    height += 0.00015 * noise(rng, (texels, texels), 1.9, 0.08)
    return normals_from_slopes(*(np.gradient(height, TILE / texels, axis=axis) for axis in (1, 0)))


def stripes(u: Array, v: Array) -> Array:
    """Return the factor of the thickness of the layers at (u, v)."""
    across = np.abs(2 * v - 1)
    centre = np.where(u < (WAIST - TIP) / (FRONT - TIP), 0.40, 0.42)
    half = 0.115 * (1 + 0.25 * np.sin(9 * u))
    stripe = smooth_step(np.abs(across - centre) - half, 0.05, -0.03) * smooth_step(u, 0.03, 0.12)
    return 1 + (STRIPE - 1) * stripe


def make(folder: Path, columns: int = 900) -> None:
    """Write beetle_shell.ply, beetle_body.ply, beetle_eyes.ply, beetle_punctures.exr, _layers.exr and _turn.exr.

    Args:
        folder: of the models.
        columns: quads along an elytron, texels of the punctures along each side, and texels of the others along u.
    """
    write_sheets(folder / "beetle_shell.ply", [elytron(columns, 1), elytron(columns, -1), pronotum(columns)])
    write_sheets(folder / "beetle_body.ply", body())
    write_sheets(folder / "beetle_eyes.ply", eyes())
    write_numbers(folder / "beetle_punctures.exr", punctures(columns))
    u, v = np.meshgrid((np.arange(columns) + 0.5) / columns, (np.arange(columns) + 0.5) / columns)
    rng = np.random.default_rng(8)
    layers = stripes(u, v) * (1 + 0.012 * noise(rng, u.shape, 1.6, 0.3))
    write_numbers(folder / "beetle_layers.exr", layers)
    rib = np.floor(np.abs(2 * v - 1) * RIBS).astype(int) + RIBS * (v > 0.5)
    turn = 6 * rng.standard_normal(2 * RIBS + 1)[rib] + 2 * noise(rng, u.shape, 1.8, 0.2)
    write_numbers(folder / "beetle_turn.exr", turn)


if __name__ == "__main__":
    command(make)
