"""A coiled snake, as meshes and textures: `python scenes/snake.py` for snake.xml, with `--small` for both coils.

1. Body: a chain of nodes along the body's centre, laid down in a coil with the head on top, and relaxed: it sinks,
   and nodes that are closer than their thickness push each other and the body around them apart. A spline through the
   nodes is swept by an ellipse that tapers.
2. Coordinates: u runs from the tail's tip to the snout and v around the body, from the belly over the back to the
   belly. u increases by ds/r, so that scales shrink with the body and keep their shape.
3. Textures over (u, v): normals of overlapping scales, the direction of the microstructure on each, and the pigment.

The microstructure runs along the body; on each scale it is rotated by some degrees. Lengths are cm.
"""

from __future__ import annotations

import sys
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path

import numpy as np
from modelling import (
    Array,
    command,
    noise,
    normals_from_slopes,
    smooth_step,
    write_colours,
    write_numbers,
    write_sheets,
)
from scipy.interpolate import CubicSpline
from scipy.ndimage import gaussian_filter1d

LENGTH = 155.0  # from the tail's tip to the snout
RADIUS = 1.6  # of the thickest part
NODE = 0.5  # distance of the nodes
STIFFNESS = 2.0  # length of the body that a push at one point moves
HEAD = 5.2  # length of head and neck together


def radius(s: Array) -> Array:
    """Return half the width of the body at s from the tail's tip, without the head."""
    tail = np.clip(s / (0.42 * LENGTH), 0, 1)
    front = smooth_step(s, 0.55 * LENGTH, LENGTH - HEAD)
    return RADIUS * (0.06 + 0.94 * np.sin(0.5 * np.pi * tail) ** 0.8) * (1 - 0.42 * front)


def half_axes(s: Array) -> tuple[Array, Array]:
    """Return half the width and half the height of the cross-section."""
    body = radius(s)
    # From the neck to the snout: jaws wider than the neck, then a wedge with a round end.
    x = np.clip((s - (LENGTH - HEAD)) / HEAD, 0, 1)
    knots = [0, 0.2, 0.42, 0.62, 0.8, 0.92, 0.975, 1]
    width = CubicSpline(knots, [1.0, 1.03, 1.27, 1.25, 0.95, 0.7, 0.45, 0.02], bc_type=((1, 0.0), (2, 0.0)))(x)
    height = CubicSpline(knots, [1.0, 0.94, 0.96, 0.92, 0.68, 0.46, 0.27, 0.02], bc_type=((1, -0.2), (2, 0.0)))(x)
    tip = np.sqrt(np.clip(s / 0.1, 0, 1))
    return 1.04 * body * width * tip, 0.95 * body * height * tip


# ---------------------------------------------------------------- the body's centre


def _laid_down() -> Array:
    """Return the nodes before relaxation, (n, 3): outer turn first, then inwards, up, and out over the coil."""
    # Angle in turns, distance from the axis, height of the body's centre above the ground.
    turn = [0.0, 0.5, 1.0, 1.5, 2.0, 2.4, 2.8, 3.05, 3.2, 3.3]
    distance = [10.6, 9.4, 8.7, 7.4, 5.5, 4.5, 4.7, 6.4, 9.0, 11.6]
    height = [0.2, 1.0, 1.5, 1.6, 1.9, 3.2, 4.6, 4.8, 4.6, 3.9]
    fine = np.linspace(turn[0], turn[-1], 4000)
    rho, z = CubicSpline(turn, distance)(fine), CubicSpline(turn, height)(fine)
    angle = 2 * np.pi * (fine + 0.45)
    return resampled(np.stack([rho * np.cos(angle), rho * np.sin(angle), z], -1), round(LENGTH / NODE) + 1)


def resampled(path: Array, count: int) -> Array:
    """Return `count` points at equal distances along a path, (count, 3)."""
    s = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    return CubicSpline(s, path)(np.linspace(0, s[-1], count))


@lru_cache(maxsize=1)
def centre_line(steps: int = 150) -> Array:
    """Return the nodes after relaxation, (n, 3)."""
    nodes = _laid_down()
    s = np.linspace(0, LENGTH, len(nodes))
    width, height = half_axes(s)
    thick = np.maximum(width, 0.15)
    min_distance = thick[:, None] + thick
    # Neighbours along the body always touch.
    separate = np.abs(s[:, None] - s) > 2.5 * min_distance
    for step in range(steps):
        offset = nodes[:, None] - nodes
        distance = np.linalg.norm(offset, axis=-1) + 1e-9
        push = np.where(separate, np.maximum(min_distance - distance, 0), 0) * 0.5
        move = (offset / distance[..., None] * push[..., None]).sum(1)
        move[:, 2] -= 0.02 * (step < 0.6 * steps)
        move[:, 2] += np.maximum(height - nodes[:, 2] - move[:, 2], 0)
        nodes = resampled(nodes + gaussian_filter1d(move, STIFFNESS / NODE, axis=0), len(nodes))
    return nodes


@dataclass(frozen=True)
class Sweep:
    """Cross-sections of the body, tail first.

    Attributes:
        s: distance from the tail's tip.
        centre, side, up: (n, 3), centre and directions of the axes of the ellipse.
        u: texture coordinate, 0 to 1.
        scale: du = ds/(scale · r).
    """

    s: Array
    centre: Array
    side: Array
    up: Array
    u: Array
    scale: float

    @classmethod
    def along(cls, count: int) -> Sweep:
        """Return `count` cross-sections, denser where the body is thin."""
        nodes = centre_line()
        chord = np.concatenate([[0], np.cumsum(np.linalg.norm(np.diff(nodes, axis=0), axis=1))])
        spline = CubicSpline(chord * LENGTH / chord[-1], nodes)
        fine = np.linspace(0, LENGTH, 20001)
        # The size of scales has a lower bound at tip and snout.
        size = np.maximum(radius(fine), 0.25)
        integral = np.concatenate([[0], np.cumsum((1 / size[1:] + 1 / size[:-1]) / 2) * (fine[1] - fine[0])])
        u = np.linspace(0, 1, count)
        s = np.interp(u * integral[-1], integral, fine)
        tangent = spline(s, 1)
        tangent /= np.linalg.norm(tangent, axis=1, keepdims=True)
        # The belly faces down everywhere.
        side = np.cross(tangent, [0.0, 0.0, 1.0])
        side /= np.linalg.norm(side, axis=1, keepdims=True)
        return cls(s, spline(s), side, np.cross(side, tangent), u, float(integral[-1]))

    def surface(self, v: Array) -> Array:
        """Return points on the skin, (n_v, n_u, 3); v = 0 and 1 at the belly, 1/2 at the back."""
        width, height = half_axes(self.s)
        angle = 2 * np.pi * v[:, None, None]
        # ∂u × ∂v points outwards.
        across = np.sin(angle) * (width[:, None] * self.side)
        upwards = -np.cos(angle) * (height[:, None] * self.up)
        return self.centre + across + upwards


def sphere(centre: Array, radius: float, count: int = 32) -> tuple[Array, Array, Array]:
    """Return a sphere as a sheet: points, u and v."""
    u, v = np.linspace(0, 1, 2 * count + 1), np.linspace(0, 1, count + 1)
    phi, theta = 2 * np.pi * u, np.pi * (1 - v[:, None])
    unit = [np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi]
    return centre + radius * np.stack(unit, -1), u, v


# ---------------------------------------------------------------- scales


@dataclass(frozen=True)
class Skin:
    """Parameters of the skin of a snake.

    Attributes:
        rows: of scales round the body, belly included.
        dome, tilt, roll: slopes of a scale: across, from its root to its tip, and at its edge.
        turn: standard deviation of the microstructure's direction from scale to scale, degrees.
        wobble: standard deviation of the slopes of whole scales.
    """

    rows: int
    dome: float
    tilt: float
    roll: float
    turn: float
    wobble: float


SKINS = {
    # Corn snakes have 27 rows of weakly keeled scales, sunbeam snakes 15 of smooth ones, and a belly of wide plates.
    "elaphe": Skin(rows=48, dome=0.16, tilt=0.05, roll=0.55, turn=5.0, wobble=0.02),
    "xenopeltis": Skin(rows=32, dome=0.10, tilt=0.03, roll=0.5, turn=4.0, wobble=0.012),
}
BELLY = 0.13  # half the fraction of the circumference covered by the plates of the belly
PITCH = 4.2  # of the scales of a row along the body, in distances of rows
ELONGATION = 1.33
ROUNDNESS = 6  # of the corners of scales: the order of a norm
HEAD_PLATES = 3.3  # cm from the snout, covered by plates instead of scales
MOUTH = 0.335  # from the back to the line of the mouth, as a fraction of the circumference


@dataclass(frozen=True)
class Texels:
    """Texture of the skin, (rows, columns): the position of each texel and the uppermost scale there.

    Attributes:
        s: distance from the tail's tip, cm.
        v: texture coordinate, 0 and 1 at the belly, 1/2 at the back.
        number: of the scale, the index into tables of random numbers.
        column: of the scale along the body, in pitches.
        back: |v − 1/2| of the centre of the scale: distance from the back.
        slope_u, slope_v: of the heights, towards the snout and around the body.
        edge: 0 on the scale, 1 on its edge.
    """

    s: Array
    v: Array
    number: Array
    column: Array
    back: Array
    slope_u: Array
    slope_v: Array
    edge: Array


def texels(sweep: Sweep, skin: Skin, columns: int) -> Texels:
    """Return the scales: staggered rows along the body."""
    rows = columns // 8
    u = np.float32((np.arange(columns) + 0.5) / columns)[None, :]
    v = np.float32((np.arange(rows) + 0.5) / rows)[:, None]
    # In widths of a scale, from the snout towards the tail, and from the belly around the body.
    x = (1 - u) * np.float32(sweep.scale * skin.rows / (2 * np.pi))
    y = v * skin.rows
    shape = np.broadcast_shapes(x.shape, y.shape)
    # Scales are the hexagons of a staggered lattice, the points nearest to its sites in lengths that are ELONGATION
    # times shorter along the body.
    nearest, row, column, da, db = (np.full(shape, value, np.float32) for value in (np.inf, 0, 0, 0, 0))
    for across in (-1, 0, 1):
        j = np.floor(y) + np.float32(across)
        stagger = np.float32(0.5) * (j % 2)
        i = np.round(x / PITCH - stagger)
        along = x - (i + stagger) * PITCH
        distance = np.hypot(along / ELONGATION, y - j - 0.5)
        closer = distance < nearest
        for field, value in ((nearest, distance), (row, j), (column, i + stagger), (da, along), (db, y - j - 0.5)):
            np.copyto(field, value, where=closer)
    number = np.floor(column) * 64 + row % skin.rows
    # The distance from the sides of the hexagon, 1 on them; its corners are round.
    slant = np.array([PITCH / 2 / ELONGATION**2, 1], np.float32) / ((PITCH / 2 / ELONGATION) ** 2 + 1) * 2
    sides = np.stack([np.abs(da) * slant[0] + np.abs(db) * slant[1], np.abs(db), np.abs(da) * np.float32(2 / PITCH)])
    sides = np.maximum(sides, 1e-6)
    edge = (sides**ROUNDNESS).sum(0) ** np.float32(1 / ROUNDNESS)
    weights = (sides / edge) ** (ROUNDNESS - 1)
    normal_x = np.sign(da) * (weights[0] * slant[0] + weights[2] * np.float32(2 / PITCH))
    normal_y = np.sign(db) * (weights[0] * slant[1] + weights[1])
    # The tip lies on the scales behind it: its edge is higher than those of the root.
    # The bottom of the groove is flat, so that slopes are continuous and filtered textures have smooth outlines.
    into_groove = np.sin(np.pi * np.clip((edge - 0.6) / 0.4, 0, 1)) ** 2
    roll = skin.roll * into_groove * (0.6 + 0.4 * da * np.float32(2 / PITCH))
    length = np.hypot(normal_x, normal_y)
    toward_tail = skin.tilt * (1 - smooth_step(edge, 0.6, 1.0)) - roll * normal_x / length
    slope_v = -skin.dome * db * (1 - smooth_step(edge, 0.6, 1.0)) - roll * normal_y / length
    # The belly: plates as wide as it is, one for each scale along the body.
    belly = np.abs(v - 0.5) > 0.5 - BELLY
    i = np.floor(x / PITCH)
    fraction = x / PITCH - i
    belly = np.broadcast_to(belly, shape)
    roll = skin.roll * smooth_step(fraction, 0.85, 1.0)
    toward_tail = np.where(belly, 0.02 - roll, toward_tail)
    slope_v = np.where(belly, 0, slope_v)
    edge = np.where(belly, fraction, edge)
    number = np.where(belly, i * 64 + 63, number)
    column = np.where(belly, i, column)
    back = np.where(belly, 0.5, np.abs((row + 0.5) / skin.rows - 0.5))
    s = np.interp(u, sweep.u, sweep.s)
    return _with_head_plates(
        Texels(s, v, number.astype(int), column, back, -toward_tail, slope_v, np.minimum(edge, 1)), sweep
    )


def _with_head_plates(skin: Texels, sweep: Sweep) -> Texels:
    """Replace the scales of the head by plates: the Voronoi regions of symmetric sites."""
    x, angle = LENGTH - skin.s, skin.v - 0.5
    head = np.flatnonzero(x[0] < HEAD_PLATES + 0.5)
    x = x[:, head]
    # cm from the snout, fraction of the circumference from the back.
    one_side = [(0.5, 0.07), (1.0, 0.08), (1.75, 0.2), (2.7, 0.085), (2.5, 0.21), (3.1, 0.22), (1.0, 0.2), (0.45, 0.2)]
    one_side += [(0.35 + 0.5 * i, 0.28) for i in range(7)] + [(0.3 + 0.5 * i, 0.39) for i in range(7)]
    sites = [(0.05, 0.0), (1.8, 0.0), *((p, sign * q) for p, q in one_side for sign in (-1, 1))]
    sites += [(3.6, q) for q in (-0.2, -0.12, -0.04, 0.04, 0.12, 0.2)]
    distance = np.stack([np.hypot(x - p, (angle - q) * 2 * np.pi * 0.95) for p, q in sites]).astype(np.float32)
    nearest = distance.argmin(0)
    first, second = np.partition(distance, 1, axis=0)[:2]
    edge = 1 - smooth_step(second - first, 0.0, 0.1)
    mouth = np.exp(-(((np.abs(angle) - MOUTH) / 0.012) ** 2)) * smooth_step(x, 3.0, 2.8)
    height = -0.02 * np.maximum(edge, 1.5 * mouth)
    pixel_u = np.gradient(skin.s[0])[head]
    pixel_v = 2 * np.pi * 0.9 / skin.v.size
    slope_u, slope_v = np.gradient(height, axis=1) / pixel_u, np.gradient(height, axis=0) / pixel_v
    weight = smooth_step(x, HEAD_PLATES + 0.3, HEAD_PLATES - 0.3)
    plate = np.broadcast_to(weight > 0.5, height.shape)

    def mixed(old: Array, new: Array) -> Array:
        result = np.array(old)
        result[:, head] = (1 - weight) * old[:, head] + weight * new
        return result

    number, back = np.array(skin.number), np.array(skin.back)
    number[:, head] = np.where(plate, 10**5 + nearest, number[:, head])
    back[:, head] = np.where(plate, np.broadcast_to(np.abs(angle), height.shape), back[:, head])
    return Texels(
        skin.s,
        skin.v,
        number,
        skin.column,
        back,
        mixed(skin.slope_u, np.clip(slope_u, -0.6, 0.6)),
        mixed(skin.slope_v, np.clip(slope_v, -0.6, 0.6)),
        mixed(skin.edge, np.maximum(edge, mouth)),
    )


def per_scale(skin: Texels, seed: int) -> Array:
    """Return a standard normal number for each scale, the same on all of its texels."""
    table = np.random.default_rng(seed).standard_normal(1 << 16)
    return table[(skin.number * 40503) % (1 << 16)]


# ---------------------------------------------------------------- pigment


def corn_snake(skin: Texels, rng: np.random.Generator) -> Array:
    """Return sRGB of Elaphe guttata: orange, with black-edged red saddles on the back and blotches on the flanks."""
    # Positions of saddles along the body, per scale, so that a blotch has the outline of scales.
    along = skin.column * PITCH / 13
    position = along + 0.06 * per_scale(skin, 7)[...] * 0.3
    back = skin.back + 0.012 * per_scale(skin, 8)
    saddle = np.hypot((position % 1 - 0.5) / 0.33, back / 0.155)
    flank = np.hypot(((position + 0.5) % 1 - 0.5) / 0.2, (back - 0.25) / 0.06)
    blotch = np.minimum(saddle, flank)
    colour = np.array([0.80, 0.47, 0.25]) - 0.22 * smooth_step(back, 0.08, 0.3)[..., None] * np.array([0.5, 0.1, -0.35])
    red, black = np.array([0.58, 0.17, 0.09]), np.array([0.16, 0.09, 0.07])
    for outer, inner, paint in ((1.16, 1.1, black), (0.86, 0.8, red)):
        weight = smooth_step(blotch, outer, inner)[..., None]
        colour = (1 - weight) * colour + weight * paint
    checker = (np.floor(skin.column) % 4 < 2) ^ (skin.v > 0.5)
    pale = np.where(checker[..., None], [0.22, 0.2, 0.19], [0.85, 0.8, 0.7])
    belly = (skin.back > 0.5 - BELLY - 0.001)[..., None] & (skin.s < LENGTH - HEAD_PLATES)[..., None]
    colour = np.where(belly, pale, colour)
    # A band from the eye to the corner of the mouth, and a pale lip below it.
    x = LENGTH - skin.s
    angle = np.abs(skin.v - 0.5)
    head = smooth_step(x, HEAD_PLATES + 0.1, HEAD_PLATES - 0.1)
    band = head * smooth_step(np.abs(angle - 0.235 - 0.02 * (x - 1.8)), 0.05, 0.035) * smooth_step(x, 1.3, 1.6)
    crown = head * smooth_step(np.abs(angle - 0.03 - 0.04 * np.abs(x - 1.5)), 0.035, 0.02) * smooth_step(x, 1.2, 1.5)
    lip = head * smooth_step(angle, 0.27, 0.3)
    for weight, paint in ((lip, [0.88, 0.72, 0.55]), (np.maximum(band, crown), [0.50, 0.15, 0.08])):
        colour = (1 - weight[..., None]) * colour + weight[..., None] * np.array(paint)
    return colour


def sunbeam_snake(skin: Texels, rng: np.random.Generator) -> Array:
    """Return sRGB of Xenopeltis unicolor: dark brown above, paler towards the belly, which is cream."""
    above = np.array([0.19, 0.15, 0.135])
    low = smooth_step(skin.back, 0.22, 0.36)[..., None]
    colour = (1 - low) * above + low * np.array([0.36, 0.29, 0.25])
    belly = (skin.back > 0.5 - BELLY - 0.001)[..., None]
    return np.where(belly, np.array([0.78, 0.73, 0.65]), colour)


PIGMENTS = {"elaphe": corn_snake, "xenopeltis": sunbeam_snake}


def pigment(name: str, skin: Texels) -> Array:
    """Return the colours of the pigment: scales differ slightly, and the skin between them is dark."""
    rng = np.random.default_rng(3)
    colour = PIGMENTS[name](skin, rng)
    shade = 1 + 0.06 * per_scale(skin, 9) + 0.03 * noise(rng, skin.edge.shape, 1.0, 0.1)
    shade *= 1 - 0.55 * smooth_step(skin.edge, 0.86, 1.0)
    return colour * np.clip(shade, 0, 1.3)[..., None]


def make(folder: Path, columns: int = 5120) -> None:
    """Write the meshes, and for each skin its textures, `columns` texels long.

    Files: snake.ply, snake_eyes.ply, and NAME_normals.exr, NAME_turn.exr, NAME_pigment.png for each skin.
    """
    sweep = body(folder / "snake.ply", max(columns // 2, 64), max(columns // 80, 16))
    eyes(folder / "snake_eyes.ply", sweep)
    for name in SKINS:
        texture = scales(folder, name, sweep, columns)
        write_colours(folder / f"{name}_pigment.png", pigment(name, texture)[::-1])


def small(folder: Path) -> None:
    """Write the files of xenopeltis.xml and elaphe.xml, with few triangles and texels: as `make`, without eyes.

    The pigment of Xenopeltis is one colour, in its scene.
    """
    sweep = body(folder / "snake.ply", 800, 28)
    for name in SKINS:
        texture = scales(folder, name, sweep, 2560)
        if name == "elaphe":
            write_colours(folder / "elaphe_pigment.png", pigment(name, texture)[::-2, ::2])


def body(path: Path, along: int, around: int) -> Sweep:
    """Write the mesh of the body, of `along` × `around` quads; return its cross-sections."""
    sweep = Sweep.along(along)
    v = np.linspace(0, 1, around + 1)
    write_sheets(path, [(sweep.surface(v), sweep.u, v)])
    return sweep


def scales(folder: Path, name: str, sweep: Sweep, columns: int) -> Texels:
    """Write the textures of a skin's normals and of the direction of its microstructure, degrees."""
    skin = SKINS[name]
    texture = texels(sweep, skin, columns)
    tilt = [skin.wobble * per_scale(texture, seed) for seed in (1, 2)]
    normals = normals_from_slopes(texture.slope_u + tilt[0], texture.slope_v + tilt[1])
    write_numbers(folder / f"{name}_normals.exr", normals)
    # Half as many texels do: the direction changes in the grooves between scales.
    write_numbers(folder / f"{name}_turn.exr", (skin.turn * per_scale(texture, 3))[::2, ::2])
    return texture


def eyes(path: Path, sweep: Sweep) -> None:
    """Write both eyes as one mesh."""
    index = int(np.searchsorted(sweep.s, LENGTH - 1.75))
    sheets = []
    for v in (0.5 - 0.235, 0.5 + 0.235):
        point = sweep.surface(np.array([v]))[0, index]
        inwards = sweep.centre[index] - point
        inwards /= np.linalg.norm(inwards)
        sheets.append(sphere(point + 0.1 * inwards, 0.24))
    write_sheets(path, sheets)


if __name__ == "__main__":
    if sys.argv[1:] == ["--small"]:
        command(small, Path(__file__).parent / "coil")
    else:
        command(make)
