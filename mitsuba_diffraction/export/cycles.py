"""A shader for Blender's Cycles (.osl): the wavelengths, orders and indices that it draws from, as arrays in its text.

A shader does not see the lights, but it may draw a wavelength and an order and return a lobe about the half vector of
the direction from which that light would come. Arrays are parameters of the shader: their values then cost nothing
when it runs, and Blender shows no sockets for them.
"""

from __future__ import annotations

import os
import re
from collections.abc import Callable, Mapping
from dataclasses import replace
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike

from ..array_types import Real
from ..files.outputs import MARK
from ..files.writing import whole_file
from ..inspection.efficiency import description
from ..optics.color import SRGB_TO_XYZ, XYZ_to_linear_sRGB, daylight, matching_functions
from ..optics.geometry import diffracted, fresnel
from ..optics.media import Media, MediumBelow
from ..precomputation.grating_spectrum import GratingSpectrum
from ..precomputation.recipe import Recipe
from ..settings import VISIBLE, wavelengths_inside
from ..spectrum.grids import OrderGrid

SHORTEST_DRAWN, LONGEST_DRAWN = 390.0, 720.0  # nm, outside of which a display needs next to nothing
_BINS = 48  # of wavelengths
_MAX_ORDERS = 1000  # among which the shader chooses by their powers
_ROWS, _COLUMNS = 32, 96  # of the cells of a continuum
_SLICES = (17, 33, 65, 129)  # of κ
_MAX_SLICE_ERROR = 2e-3  # of the reflected power, of orders; of a continuum, which has more values, ten times as much
_COSINES, _AZIMUTHS, _LIGHTS = 12, 13, 5  # of the table of albedos of a continuum
_MAX_HEIGHT_SCALE = 2.0
_ASSETS = Path(__file__).parent / "assets"


def shader_recipe(recipe: Recipe) -> Recipe:
    """Return the recipe of the spectrum of a shader: of a grating, one that allows for `_MAX_HEIGHT_SCALE`."""
    settings = recipe.settings
    if settings.extent != "tile" or recipe.patches > 1 or settings.wavelengths != VISIBLE:
        return recipe
    return replace(recipe, settings=replace(settings, wavelengths=wavelengths_inside(1.0, _MAX_HEIGHT_SCALE)))


def write_shader(spectrum: GratingSpectrum, path: str | os.PathLike[str], below: MediumBelow) -> str:
    """Write the shader of a spectrum of scalar theory; return what it holds.

    Args:
        spectrum: S(q; κ).
        path: of the file.
        below: the medium below it, in air.

    Raises:
        ValueError: if the material is wrong.
    """
    what = description(spectrum.source, Media(below), 0.0)
    edges, colours = _wavelength_bins()
    index = np.array([below.at(w) for w in (edges[1:] + edges[:-1]) / 2])
    index = np.where(np.isinf(index), 0, index)
    max_kappa = min(_MAX_HEIGHT_SCALE * 4e3 * np.pi / SHORTEST_DRAWN, spectrum.max_kappa)
    arrays: dict[str, tuple[str, Real]] = {
        "Edges": ("float", edges),
        "Colours": ("color", colours),
        "Eta": ("float", index.real),
        "Absorption": ("float", index.imag),
    }
    q = np.stack(np.meshgrid(*spectrum.grid.frequencies()), -1)
    numbers: dict[str, object] = {"bins": _BINS, "width": f"{spectrum.lobe_width:.6g}"}
    kept = np.hypot(*np.moveaxis(q, -1, 0)) <= 2e3 / SHORTEST_DRAWN
    if isinstance(spectrum.grid, OrderGrid) and kept.sum() <= _MAX_ORDERS:
        powers = _sliced(spectrum, max_kappa, lambda values: values[kept], _MAX_SLICE_ERROR)
        arrays |= {"Frequencies": ("float", q[kept]), "Powers": ("float", powers)}
        choice, held = "orders", f"{len(powers)} orders"
        numbers |= {"count": len(powers)}
    else:
        rows, columns, of_cells = _cells(spectrum, max_kappa)
        powers = _sliced(spectrum, max_kappa, of_cells, 10 * _MAX_SLICE_ERROR)
        albedo = _albedo(rows, columns, powers, max_kappa, edges)
        arrays |= {"Rows": ("float", rows), "Columns": ("float", columns)}
        arrays |= {"Powers": ("float", powers), "Albedo": ("float", albedo)}
        choice, held = "continuum", f"{_COLUMNS} × {_ROWS} frequencies"
        numbers |= {"columns": _COLUMNS, "cells": _ROWS * _COLUMNS}
        numbers |= {"cosines": _COSINES, "azimuths": _AZIMUTHS, "lights": _LIGHTS}
    numbers |= {
        "slices": powers.shape[-1],
        "max_kappa": f"{max_kappa:.9g}",
        "max_scale": f"{max_kappa / (4e3 * np.pi / SHORTEST_DRAWN):.3g}",
        "entering": f"{1 - _mean_reflectance(float(np.median(index.real))):.4g}",
        "mark": MARK,
        "what": " ".join(what.split()),
        "name": re.sub(r"\W", "_", f"diffraction_{Path(path).stem}", flags=re.ASCII),
        "arrays": "\n".join(_parameter(name, kind, values) for name, (kind, values) in arrays.items()),
    }
    text = _filled("cycles.osl", {**numbers, "choice": _filled(f"{choice}.osl", numbers).rstrip()})
    with whole_file(path) as temporary:
        temporary.write_text(text, encoding="utf-8")
    return f"{held}, {powers.shape[-1]} values of κ"


def _filled(name: str, values: Mapping[str, object]) -> str:
    """Return a template with its places filled in."""
    text = (_ASSETS / name).read_text(encoding="utf-8")
    return re.sub(r"\{\{(\w+)\}\}", lambda found: str(values[found[1]]), text)


def _parameter(name: str, kind: str, values: ArrayLike) -> str:
    """Return an array as a parameter of the shader."""
    flat = [f"{x:.6g}" for x in np.ravel(values)]
    if kind == "color":
        flat = [f"color({r}, {g}, {b})" for r, g, b in zip(flat[::3], flat[1::3], flat[2::3], strict=True)]
    lines = [", ".join(flat[start : start + 16]) for start in range(0, len(flat), 16)]
    return f"    {kind} {name}[{len(flat)}] = {{\n        " + ",\n        ".join(lines) + "\n    },"


def _wavelength_bins() -> tuple[Real, Real]:
    """Return the edges of bins of equal probability, µm, (n + 1,), and the linear sRGB of their light, (n, 3).

    The probability is that of what a display needs, the mean of |r|, |g| and |b|; half of it is the luminance. The mean
    of the colours is white, (1, 1, 1).
    """
    wavelengths = np.arange(SHORTEST_DRAWN, LONGEST_DRAWN + 0.01, 0.1)
    colours = XYZ_to_linear_sRGB(matching_functions(wavelengths)) * daylight(wavelengths)[:, None]
    colours /= colours.sum(axis=0)
    need = np.abs(colours).mean(axis=1)
    density = need / need.sum() + np.maximum(colours @ SRGB_TO_XYZ[1], 0)
    chance = np.concatenate([[0.0], np.cumsum(density / density.sum())])
    bounds = np.append(wavelengths, LONGEST_DRAWN + 0.1) - 0.05
    edges = np.interp(np.linspace(0, 1, _BINS + 1), chance, bounds)
    summed = np.concatenate([np.zeros((1, 3)), np.cumsum(colours, axis=0)])
    at_edges = np.stack([np.interp(edges, bounds, column) for column in summed.T], axis=1)
    return edges * 1e-3, _BINS * np.diff(at_edges, axis=0)


def _sliced(spectrum: GratingSpectrum, max_kappa: float, of_nodes: Callable[[Real], Real], error: float) -> Real:
    """Return powers at equally spaced κ from 0 to `max_kappa`, (n, K), which are linear between them up to `error`."""

    def at(count: int) -> Real:
        return np.stack(
            [of_nodes(np.maximum(spectrum.powers(k), 0)) for k in np.linspace(0, max_kappa, count)], axis=-1
        )

    for count in _SLICES:
        fine = at(2 * count - 1)
        between = (fine[:, :-1:2] + fine[:, 2::2]) / 2
        if np.abs(between - fine[:, 1::2]).sum(axis=0).max() < error * fine.sum(axis=0).max():
            break
    return fine[:, ::2]


def _cells(spectrum: GratingSpectrum, max_kappa: float) -> tuple[Real, Real, Callable[[Real], Real]]:
    """Return edges of rows and columns of cells of equal mean power, and the powers of cells from those of nodes.

    The edges of the rows are (n + 1,), those of the columns in each (n, k + 1), in cycles/µm. Powers are multiplied by
    the number of cells: they are then the weights of a sample that draws all cells with equal probability.
    """
    kappas = np.linspace(0.3, 1, 8) * min(max_kappa, 4e3 * np.pi / SHORTEST_DRAWN)
    mean = np.mean([np.maximum(spectrum.powers(kappa), 0) for kappa in kappas], axis=0)
    q_x, q_y = spectrum.grid.frequencies()
    rows, of_rows = _equal_parts(q_y, mean.sum(axis=1), _ROWS)
    pairs = [_equal_parts(q_x, weights @ mean, _COLUMNS) for weights in of_rows]

    def of_cells(powers: Real) -> Real:
        strips = of_rows @ powers
        return (
            _ROWS
            * _COLUMNS
            * np.concatenate([of_columns @ strip for (_, of_columns), strip in zip(pairs, strips, strict=True)])
        )

    return rows, np.stack([columns for columns, _ in pairs]), of_cells


def _equal_parts(nodes: Real, power: Real, count: int) -> tuple[Real, Real]:
    """Return edges of parts of equal power, (n + 1,), and the fraction of each node in each part, (n, nodes).

    The power of a node is spread evenly up to half way to its neighbours. The outermost edges leave out a tenth of
    their parts, without which the weak tails of a spectrum would be drawn too far out.
    """
    step = nodes[1] - nodes[0] if len(nodes) > 1 else 1e-3
    bounds = np.append(nodes, nodes[-1] + step) - step / 2
    chance = np.concatenate([[0.0], np.cumsum(power + 1e-9 * power.max())])
    edges = np.interp(np.linspace(0, chance[-1], count + 1), chance, bounds)
    inside = np.minimum(edges[1:, None], bounds[1:]) - np.maximum(edges[:-1, None], bounds[:-1])
    edges[[0, -1]] = np.interp(np.array([0.1, count - 0.1]) / count * chance[-1], chance, bounds)
    return edges, np.maximum(inside, 0) / step


def _albedo(rows: Real, columns: Real, powers: Real, max_kappa: float, edges: Real) -> Real:
    """Return what a perfect mirror would reflect, by wavelength, azimuth of ω_o and cos θ_o."""
    q = np.stack(
        [
            (columns[:, 1:] + columns[:, :-1]).ravel() / 2,
            np.repeat((rows[1:] + rows[:-1]) / 2, _COLUMNS),
        ],
        axis=-1,
    )
    albedo = np.zeros((_LIGHTS, _AZIMUTHS, _COSINES))
    for k, j, i in np.ndindex(albedo.shape):
        wavelength = float(np.interp(k / (_LIGHTS - 1), np.linspace(0, 1, len(edges)), edges))
        cosine, azimuth = max(i / (_COSINES - 1), 0.02), (j / (_AZIMUTHS - 1) - 0.5) * 2 * np.pi
        tangent = np.sqrt(1 - cosine**2) * np.array([np.cos(azimuth), np.sin(azimuth)])
        found = diffracted(tangent, wavelength * q)
        at = np.minimum(2 * np.pi * found.v_z / wavelength / max_kappa, 1) * (powers.shape[1] - 1)
        below = np.minimum(at.astype(int), powers.shape[1] - 2)
        kept = powers[found.kept]
        number = np.arange(len(kept))
        power = kept[number, below] * (1 - at + below) + kept[number, below + 1] * (at - below)
        albedo[k, j, i] = (power * found.k_g).sum() / len(q)
    return albedo


def _mean_reflectance(index: float) -> float:
    """Return the reflectance of a dielectric for diffuse light."""
    if index <= 0:
        return 1.0
    cosines = (np.arange(200) + 0.5) / 200
    return float(np.mean(2 * cosines * np.mean(fresnel(cosines, index), axis=0)))
