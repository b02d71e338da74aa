"""Meshes and textures of the scenes: functions that the scripts of this folder share.

Lengths are cm. A patch (u, v) → point becomes a mesh with normals and UVs; ∂u × ∂v must point outwards. All meshes
are swept or deformed sheets, given as arrays of points.
"""

from __future__ import annotations

import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image

from mitsuba_diffraction.files.writing import whole_file

import mitsuba as mi  # isort: skip  (after LLVM has been chosen)

Array = NDArray[np.float64]
Sheet = tuple[Array, Array, Array]  # points (n_v, n_u, 3), u (n_u,) and v (n_v,)

MODELS = Path(__file__).parent / "models"


def command(make: Callable[[Path], None], folder: Path = MODELS) -> None:
    """Write the files of one scene; print the folder and the time."""
    folder.mkdir(exist_ok=True)
    start = time.perf_counter()
    make(folder)
    print(f"{Path(sys.argv[0]).stem}: written to {folder}, {time.perf_counter() - start:.1f} s")


def write_sheets(path: Path, sheets: Sequence[Sheet], uv: Callable[[Array], Array] | None = None) -> None:
    """Write sheets as one mesh (.ply) with normals and UVs: two triangles for each quad of the grid.

    Args:
        path: of the mesh.
        sheets: where the first and the last row or column coincide, the surface is closed.
        uv: UVs (n, 2) of points (n, 3), instead of u and v.
    """
    vertices, normals, uvs, faces, count = [], [], [], [], 0
    for points, u, v in sheets:
        rows, columns = points.shape[:2]
        normal = np.cross(_difference(points, 1), _difference(points, 0))
        length = np.linalg.norm(normal, axis=-1, keepdims=True)
        normals.append(np.divide(normal, length, out=np.zeros_like(normal), where=length > 0).reshape(-1, 3))
        vertices.append(points.reshape(-1, 3))
        uvs.append(np.stack(np.meshgrid(u, v), -1).reshape(-1, 2) if uv is None else uv(vertices[-1]))
        corner = (np.arange(rows - 1)[:, None] * columns + np.arange(columns - 1)).ravel() + count
        faces += [corner, corner + 1, corner + columns + 1, corner, corner + columns + 1, corner + columns]
        count += rows * columns
    triangles = [np.stack(faces[i : i + 3], -1) for i in range(0, len(faces), 3)]
    mi.set_variant("scalar_rgb")
    triangle_count = sum(len(part) for part in triangles)
    mesh = mi.Mesh(path.stem, count, triangle_count, has_vertex_normals=True, has_vertex_texcoords=True)
    parameters = mi.traverse(mesh)
    parameters["vertex_positions"] = np.concatenate(vertices).ravel()
    parameters["vertex_normals"] = np.concatenate(normals).ravel()
    parameters["vertex_texcoords"] = np.concatenate(uvs).ravel()
    parameters["faces"] = np.concatenate(triangles).ravel()
    parameters.update()
    with whole_file(path) as temporary:
        mesh.write_ply(str(temporary))


def _difference(points: Array, axis: int) -> Array:
    """Return central differences; periodic ones if the first and the last row or column coincide."""
    first, last = points.take(0, axis), points.take(-1, axis)
    if np.allclose(first, last):
        inner = points.take(range(points.shape[axis] - 1), axis)
        difference = np.roll(inner, -1, axis) - np.roll(inner, 1, axis)
        return np.concatenate([difference, difference.take([0], axis)], axis)
    return np.gradient(points, axis=axis)


def quad(corners: Sequence[Sequence[float]]) -> Sheet:
    """Return a quadrilateral, its corners in the order of their (u, v): (0, 0), (1, 0), (0, 1), (1, 1)."""
    unit = np.array([0.0, 1.0])
    return np.reshape(np.asarray(corners, np.float64), (2, 2, 3)), unit, unit


def revolved(profile: Sequence[Sequence[float]] | Array, count: int) -> Sheet:
    """Return a surface of revolution about z: (radius, height) along u, from the inside outwards, `count` corners."""
    radius, height = np.transpose(profile)
    u, v = np.linspace(0, 1, len(radius)), np.linspace(0, 1, count + 1)
    phi = 2 * np.pi * v[:, None]
    return np.stack([radius * np.cos(phi), radius * np.sin(phi), height + 0 * phi], -1), u, v


def write_colours(path: Path, srgb: Array) -> None:
    """Write a texture of colours (.png): sRGB in [0, 1], (rows, columns, 3), from the top, v = 1.

    The first row of a file is at v = 0 in Mitsuba.
    """
    with whole_file(path) as temporary:
        Image.fromarray(np.round(255 * np.clip(srgb, 0, 1)).astype(np.uint8)[::-1]).save(temporary)


def write_numbers(path: Path, values: Array) -> None:
    """Write a texture of numbers (.exr, half): (rows, columns) or (rows, columns, 3), the first at v = 0.

    Eight bits are too few for normals: their steps of half a degree are as wide as the lobes of a grating.
    """
    with whole_file(path) as temporary:
        mi.Bitmap(np.ascontiguousarray(values).astype(np.float16)).write(str(temporary))


def normals_from_slopes(slope_u: Array, slope_v: Array) -> Array:
    """Return the texture of a normal map: (n + 1)/2 with n ∝ (−∂h/∂u, −∂h/∂v, 1), slopes per length along u and v."""
    normal = np.stack([-slope_u, -slope_v, np.ones_like(slope_u)], -1)
    return (normal / np.linalg.norm(normal, axis=-1, keepdims=True) + 1) / 2


def noise(rng: np.random.Generator, shape: tuple[int, int], exponent: float, max_length: float = 1.0) -> Array:
    """Return periodic noise of mean 0 and standard deviation 1, its amplitude ∝ q^−exponent above q = 1/max_length.

    Args:
        rng: generator of the random numbers.
        shape: (rows, columns).
        exponent: 1 is cloudy, 2 smooth.
        max_length: below the frequency 1/max_length the amplitude is constant; a fraction of the sheet's width.
    """
    rows, columns = shape
    q = np.hypot(np.fft.fftfreq(rows)[:, None] * columns, np.fft.rfftfreq(columns) * columns)
    amplitude = np.maximum(q, 1 / max_length) ** -exponent
    amplitude[0, 0] = 0
    field = np.fft.irfft2(np.fft.rfft2(rng.standard_normal(shape)) * amplitude, s=shape)
    return field / field.std()


def smooth_step(x: Array, start: float, end: float) -> Array:
    """Return 0 before `start`, 1 after `end` (which may be the smaller), and a Hermite polynomial between them."""
    t = np.clip((x - start) / (end - start), 0, 1)
    return t * t * (3 - 2 * t)
