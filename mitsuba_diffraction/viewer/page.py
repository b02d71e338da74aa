"""The page: HTML, styles, JavaScript and GLSL from `assets`, and the data of a surface, in one text."""

from __future__ import annotations

import html
import json
import os
import re
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError
from ..files.outputs import MARK
from ..optics.color import observer
from ..optics.media import DEFAULT_INT_IOR, MediumBelow
from ..optics.refractive_indices import conductor
from ..precomputation.in_scene import AIR, DISCS
from ..settings import FROM_RADIUS, SUN_COHERENCE_LENGTH, VISIBLE
from ..spectrum.grids import OrderGrid
from ..spectrum.sample import effective_coherence_length, window_axes
from ..spectrum.tables import HALF_SCALE, SliceTable
from ..surface.heightfield import HeightField
from .arrays import encoded
from .coil import coil
from .viewed_surface import ViewedSurface

MAX_PAGE_BYTES = 6_000_000  # of a page of one surface
MAX_HEIGHTS_SIDE = 512  # pixels of the heights for the shader of 2014

SHORTEST_SHOWN = 380.0  # nm, of the wavelengths that a page shows
NODES_AT_ONCE = 8  # the most along one axis that contribute at one q, as MAX_LOBES of spectrum.js

METALS = ("Al", "Ag", "Au", "Cr", "Cu", "W")
"""The conductors among which a page chooses, besides that of the surface."""

DESIGN = "design of "  # in the title of a designed relief, see `inverse_design.result`
_SKINS = ("elaphe_synthetic", "xenopeltis_synthetic")  # profiles

# Radii of the hole, and of the inner and outer edge of the tracks, relative to 60 mm (IEC 60908, ECMA-267).
_RINGS = dict(zip(DISCS, ((7.5 / 60, 23 / 60, 58.5 / 60), (7.5 / 60, 22.6 / 60, 58.5 / 60)), strict=True))

_ASSETS = Path(__file__).parent / "assets"
_STYLES = ("page.css",)
_SCRIPTS = (
    _ASSETS.parents[1] / "export/assets/three/shading.js",
    *(
        _ASSETS / f"{name}.js"
        for name in (
            *("data", "gl", "colour", "spectrum", "colours", "shapes", "view", "shader_2014"),
            *("renderer", "pick", "command", "controls", "main"),
        )
    ),
)


def page(surface: ViewedSurface, *others: ViewedSurface, picture: NDArray[np.float16] | None = None) -> str:
    """Return the page of a surface as HTML.

    Args:
        surface: what is shown first.
        others: what the page has beside it, in a list.
        picture: linear sRGB for comparison with the first, (height, width, 3), the lowest row first.

    Raises:
        RequestError: if the page of one surface would be larger than `MAX_PAGE_BYTES`, or two surfaces have one name.
    """
    text = (_ASSETS / "page.html").read_text(encoding="utf-8")
    shaders = {path.stem: path.read_text(encoding="utf-8") for path in sorted(_ASSETS.glob("*.glsl"))}
    parts = {
        "title": html.escape(surface.name),
        "mark": MARK,
        "styles": "\n".join((_ASSETS / name).read_text(encoding="utf-8") for name in _STYLES),
        "scripts": "\n".join(path.read_text(encoding="utf-8") for path in _SCRIPTS).replace("\nexport ", "\n"),
        "shaders": _json(shaders),
    }
    names = [one.name for one in (surface, *others)]
    if len(set(names)) < len(names):
        raise RequestError(f"surfaces: got {', '.join(names)}, wanted each name once")
    around = len(text.encode()) + sum(len(part.encode()) for part in parts.values())
    data = []
    for index, one in enumerate((surface, *others)):
        of_one = _data(one, picture if index == 0 else None)
        data.append(_json(of_one))
        if (size := around + len(data[-1].encode())) > MAX_PAGE_BYTES:
            raise RequestError(
                f"{one.name}: got a page of {size / 1e6:.3g} MB, wanted at most {MAX_PAGE_BYTES / 1e6:g}; a larger "
                "tolerance or a shorter coherence length makes its table smaller"
                + _suggestion(one, 1 - (size - MAX_PAGE_BYTES) / len(of_one["spectrum"]["table"]["data"]))
            )
    tags = (f'<script id="data{i or ""}" type="application/json">{one}</script>' for i, one in enumerate(data))
    parts |= {"data": "\n".join(tags), "names": _json(names)}
    # In one pass, as a part may hold what looks like the name of another.
    return re.sub(r"\{\{(\w+)\}\}", lambda match: parts[match[1]], text)


def _suggestion(surface: ViewedSurface, factor: float) -> str:
    """Return an option that makes the table of a sample smaller by a factor, as the end of a message, or ""."""
    # The nodes of a sample lie as densely as its lobes are narrow, along both axes.
    length = 0.9 * surface.spectrum.coherence_length * max(factor, 0) ** 0.5
    return f": coherence_length={length:.2g}" if surface.spectrum.extent == "sample" else ""


def reference_picture(path: str | os.PathLike[str]) -> NDArray[np.float16]:
    """Return a spectral picture as linear sRGB in half precision, (height, width, 3), the lowest row first."""
    from ..optics.color import radiance_to_linear_sRGB
    from ..render.spectral_image import SpectralImage

    image = SpectralImage.load(path)
    rgb = radiance_to_linear_sRGB(image.radiance, image.wavelengths)[::-1]
    largest = np.finfo(np.float16).max
    return np.clip(rgb, -largest, largest).astype(np.float16)


def _json(content: object) -> str:
    """Return JSON that may stand inside of a script element."""
    # "<!--" and "<script" would change how the rest of the page is read.
    return json.dumps(content, ensure_ascii=False, separators=(",", ":")).replace("<", "\\u003c")


def _data(surface: ViewedSurface, picture: NDArray[np.float16] | None) -> dict[str, Any]:
    return {
        "name": surface.name,
        "summary": _summary(surface),
        "shape": _shape(surface),
        "rings": _RINGS.get(_profile(surface)),
        "source": surface.spectrum.source,
        "version": metadata.version("mitsuba_diffraction"),
        "grating": dict(surface.grating),
        "integers": [name for name, value in surface.grating.items() if isinstance(value, int)],
        "command": surface.command,
        "inScene": _in_scene(surface),
        "spectrum": _spectrum(surface),
        "metals": _metals(surface.in_scene.media.below),
        "light": encoded(_light()),
        "coil": coil(),
        "scales": "elaphe" if "elaphe" in surface.spectrum.source else "xenopeltis",
        "heights": _heights(surface),
        "picture": None if picture is None else encoded(picture),
    }


def _summary(surface: ViewedSurface) -> str:
    """Return what the surface is, in one line."""
    if surface.recipe is None:
        return f"Saved spectrum, coherence length {surface.spectrum.coherence_length:.3g} µm."
    summary = surface.recipe.summary()
    return f"{summary[0].upper()}{summary[1:]}."


def _shape(surface: ViewedSurface) -> str:
    """Return the object that is shown first: the snake for skins and samples of other irregular surfaces."""
    if _profile(surface) in _RINGS:
        return "disc"
    if DESIGN in surface.spectrum.source:
        return "wall"
    if surface.in_scene.orientation in FROM_RADIUS:
        return "plate"
    return "coil" if surface.spectrum.extent == "sample" or _profile(surface) in _SKINS else "sphere"


def _profile(surface: ViewedSurface) -> str:
    return "" if surface.recipe is None else str(surface.recipe.surface.get("profile"))


def _in_scene(surface: ViewedSurface) -> dict[str, Any]:
    shown = surface.in_scene
    orientation, below = shown.orientation, shown.media.below
    return {
        "int_ior": below.index.nominal.real if below.transparent and below.index else DEFAULT_INT_IOR,
        "material": _metal(below),
        "coat_ior": shown.coat_ior,
        "height_scale": shown.height_scale,
        "air": AIR,
        "orientation": FROM_RADIUS.get(orientation, orientation) if isinstance(orientation, str) else orientation,
        "from_radius": orientation in FROM_RADIUS,
        "max_height_scale": surface.max_height_scale,
    }


def _metal(below: MediumBelow) -> str:
    """Return the name of a metal, "none" of the perfect mirror, or "" of a dielectric."""
    return "none" if below.index is None else "" if below.transparent else str(below.index)


def _spectrum(surface: ViewedSurface) -> dict[str, Any]:
    """Return the grid and the table: (K, terms, rows, columns) in half precision where that is exact."""
    spectrum, grid, table = surface.spectrum, surface.spectrum.grid, surface.spectrum.table
    assert isinstance(table, SliceTable)  # see `ViewedSurface`
    # Nodes that no visible light reaches are zero, and take no space.
    pitch = [1 / t for t in grid.tile_size] if isinstance(grid, OrderGrid) else grid.spacing
    x, y = (np.maximum(np.abs(q) - NODES_AT_ONCE / 2 * d, 0) for q, d in zip(grid.frequencies(), pitch, strict=True))
    reached = np.hypot(x, y[:, None]) <= 2e3 / SHORTEST_SHOWN
    values = table.values * reached
    unit = 1.0
    if table.words_per_node < 4:
        unit = 1 / HALF_SCALE
        values = (values * np.float32(HALF_SCALE)).astype(np.float16)
    of_grid = (
        {"kind": "orders", "tile_size": grid.tile_size}
        if isinstance(grid, OrderGrid)
        else {"kind": "splines", "spacing": grid.spacing, "limit": [min(limit, 1e30) for limit in grid.limit]}
    )
    return of_grid | {
        "max_order": grid.max_order,
        "max_kappa": table.max_kappa,
        "unit": unit,
        "table": encoded(values),
        "coherence_length": spectrum.coherence_length,
        "cutoff_sigmas": spectrum.cutoff_sigmas,
        "largest_angle": spectrum.largest_angle,
        "wavelengths": spectrum.wavelengths,
        "patches": spectrum.patches,
        "extent": spectrum.extent,
        "error": spectrum.error,
        "warning": spectrum.warning,
    }


def _heights(surface: ViewedSurface) -> dict[str, Any] | None:
    """Return the heights for the shader of 2014, as whole numbers from the lowest; None for a saved spectrum."""
    if surface.recipe is None:
        return None
    field = surface.recipe.height_field()
    # The middle, at most.
    first = [max(0, (n - MAX_HEIGHTS_SIDE) // 2) for n in field.shape]
    piece = field.heights[tuple(slice(i, i + MAX_HEIGHTS_SIDE) for i in first)]
    height_range = float(np.ptp(piece))
    numbers = np.rint((piece - piece.min()) * (65535 / (height_range or 1.0))).astype(np.uint16)
    lengths = {"own": surface.spectrum.coherence_length, "sun": SUN_COHERENCE_LENGTH}
    is_sample = surface.recipe.settings.extent == "sample"
    return {
        "values": encoded(numbers),
        "shape": piece.shape,
        "range": height_range,
        "pixel_size": field.pixel_size,
        "windows": {
            name: _windows(HeightField(piece, field.pixel_size), length)
            for name, length in lengths.items()
            if is_sample
        },
    }


def _windows(sample: HeightField, coherence_length: float) -> dict[str, Any]:
    """Return the coherence length that a sample supports, and Σ_p a²(x − x_p) of its windows along x and y."""
    length = effective_coherence_length(sample, coherence_length)
    squares = []
    for (window, starts), count in zip(window_axes(sample, length), sample.shape[::-1], strict=True):
        sums = np.zeros(count)
        for start in starts:
            sums[start : start + len(window)] += window**2
        squares.append(encoded(sums.astype(np.float32)))
    return {"length": length, "squares": squares}


def _nanometres() -> NDArray[np.float64]:
    return np.arange(VISIBLE[0], VISIBLE[1] + 1)


def _light() -> NDArray[np.float32]:
    """Return x̄, ȳ, z̄ and the light, D65 with Y = 1, at each nm: (471, 4)."""
    table = observer()
    matching, light = table[:, 1:4] / table[:, 2].sum(), table[:, 4]
    return np.column_stack([matching, light / (light @ matching[:, 1])]).astype(np.float32)


def _metals(below: MediumBelow) -> dict[str, Any]:
    """Return n + ik of the conductors at each nm, (471, 2), as `Conductor` of the BSDF has them."""
    metals = {name: conductor(name) for name in METALS}
    if below.index is not None and not below.transparent:
        metals |= {_metal(below): below.index}
    found = {}
    for name, medium in metals.items():
        index = medium(_nanometres() * 1e-3)
        found[name] = encoded(np.stack([index.real, index.imag], -1).astype(np.float32))
    return found
