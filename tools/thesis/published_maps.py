"""Maps of the BRDF that the author of the thesis of 2014 published, and the same maps by this project.

    python tools/thesis/published_maps.py FOLDER

Each is a picture of the outgoing hemisphere, light along the normal: (x, y) = (sin θ_o cos φ_o, sin θ_o sin φ_o). They
were made by FLSS from an AFM scan of 65 µm, which is available, so that the emulation can be compared pixel by pixel.

FLSS as published sums 37 terms about the centre of the heights. The thesis counts heights from the lowest point; for
the map of Xenopeltis, whose height is 0.8187 µm, that series diverges.
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray
from PIL import Image
from scipy.optimize import minimize_scalar
from viewing_angle import MODEL, relative_reflectance, wavelengths

from mitsuba_diffraction.bsdf.testing import array, vectors
from mitsuba_diffraction.evaluation.benchmark.cases import scan
from mitsuba_diffraction.evaluation.plots import figure
from mitsuba_diffraction.evaluation.report import markdown, save_markdown
from mitsuba_diffraction.files.outputs import METADATA
from mitsuba_diffraction.files.writing import whole_file
from mitsuba_diffraction.precomputation.recipe import Recipe
from mitsuba_diffraction.progress import Progress, progress_bar, show, silent
from mitsuba_diffraction.progress import table as progress_table
from mitsuba_diffraction.settings import ScalarSettings
from mitsuba_diffraction.shader_2014.evaluate import shader_for
from mitsuba_diffraction.shader_2014.quirks import Quirks
from mitsuba_diffraction.shader_2014.tristimulus import WAVELENGTH_STEP, d65_weights, rgb_matrix
from mitsuba_diffraction.surface.heightfield import HeightField
from mitsuba_diffraction.variants import choose_variant

import mitsuba as mi  # isort: skip  (after LLVM has been chosen)

if TYPE_CHECKING:
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

_FOLDER = Path(__file__).parents[2] / "precompute" / "measured" / "published"
PUBLISHED, CORRECTED = "flss as published", "flss corrected"
METHODS = (PUBLISHED, CORRECTED, MODEL)

SIDE, RADIUS = 800, 380
"""Pixels of a published picture, and of the radius of the disc, sin θ_o = 1."""
ENCODINGS = ("sRGB", "gamma 2.5")
"""Transfer functions: of the published pictures, as their dark colours show, and of the shader."""
_MIRROR = 0.1  # sin θ_o; the pictures are saturated nearer to the mirror direction
_LIGHT = (0.0, 0.0, 1.0)
_COHERENCE_LENGTH = 65.0
_SETTINGS = ScalarSettings(coherence_length=_COHERENCE_LENGTH, wavelengths=(380, 780), tolerance=0.01)
# Relative radiance and the pictures' conversion of colours, so that maps differ by the light alone.
_QUIRKS = {
    PUBLISHED: Quirks.as_published(),
    CORRECTED: replace(Quirks.corrected(), relative=True, cie_rgb_matrix=True),
}


@dataclass(frozen=True, eq=False)
class PublishedMap:
    """A published picture and the surface that it shows.

    Attributes:
        name: for titles.
        picture: file in `precompute/measured/published`.
        recipe: of the heights, as the tile that the thesis takes them for, and of a spectrum of it.
        covered: (first row, end, first column, end) of rectangles where the picture shows something else.
    """

    name: str
    picture: str
    recipe: Recipe
    covered: tuple[tuple[int, int, int, int], ...] = ()

    def path(self) -> Path:
        """Return the path of the picture."""
        return _FOLDER / self.picture

    @property
    def height(self) -> float:
        """Of a scan, µm from black to white, which it need not contain."""
        return float(self.recipe.surface["height_range"])


PUBLISHED_MAPS = {
    "blaze": PublishedMap(
        "Blaze",
        "flss_blazed.png",
        Recipe({"profile": "blazed", "period": 2.5, "depth": 0.2462}, _SETTINGS),
        # An enlarged part, and the red frame around that part.
        (
            (450, 750, 480, 780),
            *((350, 353, 250, 350), (447, 450, 250, 350), (350, 450, 250, 253), (350, 450, 347, 350)),
        ),
    ),
    "elaphe": PublishedMap("Elaphe", "flss_elaphe.png", scan("elaphe", 0.4347, _SETTINGS)),
    "xenopeltis": PublishedMap("Xenopeltis", "flss_xeno.png", scan("xenopeltis", 0.8187, _SETTINGS)),
}
"""Name → published map."""


@dataclass(frozen=True, eq=False)
class Grid:
    """Every n-th pixel of a published picture along rows and columns.

    Attributes:
        rows, columns: (n,) of the pixels, in the picture.
        wo: (n, 3) ω_o. Rows of the picture ↔ y, without a flip.
        colours: (n, 3) gamma-encoded colours of the author's map, from 0 to 1.
        compared: (n,) whether the pixel is outside of the mirror direction and not covered.
    """

    rows: NDArray[np.int64]
    columns: NDArray[np.int64]
    wo: Array
    colours: Array
    compared: NDArray[np.bool_]

    def picture(self, values: Array) -> Array:
        """Return values (n, 3) as a picture of the disc, (side, side, 3); white outside."""
        step = int(np.gcd.reduce(np.diff(np.unique(self.rows))))
        side = SIDE // step
        result = np.ones((side, side, 3))
        result[self.rows // step, self.columns // step] = values
        return result


def grid(published: PublishedMap, step: int = 1) -> Grid:
    """Read a published map at every `step`-th pixel; the step divides the side of the picture."""
    with Image.open(published.path()) as file:
        picture = np.asarray(file.convert("RGB")) / 255
    chosen = np.arange(step // 2, SIDE, step)
    rows, columns = (index.ravel() for index in np.meshgrid(chosen, chosen, indexing="ij"))
    x, y = ((index + 0.5 - SIDE / 2) / RADIUS for index in (columns, rows))
    inside = np.hypot(x, y) < 0.999  # the outermost pixels are blended with white
    rows, columns, x, y = (values[inside] for values in (rows, columns, x, y))
    radius = np.hypot(x, y)
    compared = radius > _MIRROR
    for top, bottom, left, right in published.covered:
        compared &= ~((rows >= top) & (rows < bottom) & (columns >= left) & (columns < right))
    wo = np.stack([x, y, np.sqrt(1 - radius**2)], axis=-1)
    return Grid(rows, columns, wo, picture[rows, columns], compared)


def linear_rgb(published: PublishedMap, method: str, wo: ArrayLike) -> Array:
    """Evaluate a method for light along the normal.

    All methods give the relative radiance under D65, converted to CIE RGB like the published pictures, so that they
    differ by the light alone.

    Args:
        published: the map.
        method: one of `METHODS`.
        wo: ω_o, (n, 3).

    Returns:
        Linear RGB, (n, 3).
    """
    if method == MODEL:
        xyz = relative_reflectance(published.recipe.cached(), _LIGHT, wo, wavelengths()) @ (
            WAVELENGTH_STEP * d65_weights()[:: int(WAVELENGTH_STEP)]
        )
        return xyz @ rgb_matrix(cie_rgb_matrix=True).T
    return shader_rgb(published.recipe.height_field(), method, wo, [1.0])[0]


def shader_rgb(height_field: HeightField, method: str, wo: ArrayLike, height_scales: ArrayLike) -> Array:
    """Evaluate FLSS, with the heights scaled by each of (m,) factors: (m, n, 3); other arguments as `linear_rgb`."""
    shader = shader_for(height_field, "flss", _QUIRKS[method], coherence_length=_COHERENCE_LENGTH)
    wo = np.asarray(wo, np.float32)
    wi = vectors(np.broadcast_to(np.float32(_LIGHT), wo.shape))
    weights = shader.weights()
    scaled = [
        array(shader.rgb(wi, vectors(wo), weights, height_scale=mi.Float(scale))).T
        for scale in np.asarray(height_scales, np.float64)
    ]
    return np.stack(scaled).astype(np.float64)


class Agreement(NamedTuple):
    """Agreement of a map with the author's."""

    correlation: float
    """Of the encoded colours, over pixels and channels."""
    brightness: float
    """The factor of linear RGB with which the mean square of the difference is smallest."""


def encoded(linear: Array, brightness: float = 1.0, encoding: str = "sRGB") -> Array:
    """Return linear RGB times the brightness, clipped and encoded by one of `ENCODINGS`, from 0 to 1."""
    import colour

    clipped = np.clip(linear * brightness, 0, 1)
    if encoding == "gamma 2.5":
        return clipped ** (1 / 2.5)
    return colour.cctf_encoding(clipped, function="sRGB")


def agreement(pixels: Grid, linear: Array, encoding: str = "sRGB") -> Agreement:
    """Compare a map with the author's outside of the mirror direction, with one brightness for all pixels.

    Args:
        pixels: of the author's map.
        linear: (n, 3) linear RGB.
        encoding: one of `ENCODINGS`.
    """
    theirs, ours = pixels.colours[pixels.compared], linear[pixels.compared]

    def loss(log_brightness: float) -> float:
        return float(np.mean((encoded(ours, np.exp(log_brightness), encoding) - theirs) ** 2))

    starts = np.arange(-4.0, 10.0, 0.5) - np.log(np.percentile(ours, 99.9))
    best = starts[np.argmin([loss(start) for start in starts])]
    found = minimize_scalar(loss, bounds=(best - 0.5, best + 0.5), method="bounded", options={"xatol": 1e-3})
    brightness = float(np.exp(found.x))
    correlation = np.corrcoef(theirs.ravel(), encoded(ours, brightness, encoding).ravel())[0, 1]
    return Agreement(float(correlation), brightness)


def correlation_against_height(published: PublishedMap, heights: ArrayLike) -> Array:
    """Correlate FLSS as published with every 16th pixel of the author's map for each height range of the surface.

    Args:
        published: the map.
        heights: (n,) height ranges in µm.

    Returns:
        (n,).
    """
    pixels = grid(published, 16)
    scales = np.asarray(heights, np.float64) / published.height
    maps = shader_rgb(published.recipe.height_field(), PUBLISHED, pixels.wo, scales)
    return np.array([agreement(pixels, linear).correlation for linear in maps])


# ---------------------------------------------------------------- figures and the table

FILES = ("published_maps.png", "published_maps.md", "published_heights.png")
COLUMNS = ("map", "method", *(f"correlation, {encoding}" for encoding in ENCODINGS))
_TITLES = {PUBLISHED: "FLSS as published", CORRECTED: "FLSS corrected", MODEL: "this model"}
_HEIGHTS = np.arange(0.30, 0.92, 0.05)  # µm


@dataclass(frozen=True, eq=False)
class Row:
    """A published map and the maps of this project.

    Attributes:
        name: of the surface.
        pixels: of the author's map.
        maps: method → (n, 3) linear RGB.
    """

    name: str
    pixels: Grid
    maps: Mapping[str, Array]


def row(name: str, step: int = 2, methods: Iterable[str] = METHODS) -> Row:
    """Evaluate the maps of one of `PUBLISHED_MAPS` at every `step`-th pixel."""
    published = PUBLISHED_MAPS[name]
    pixels = grid(published, step)
    return Row(published.name, pixels, {method: linear_rgb(published, method, pixels.wo) for method in methods})


def plot_maps(rows: Iterable[Row]) -> Figure:
    """Plot the author's maps on the left and the maps of this project beside them, each titled with its correlation."""
    rows = list(rows)
    drawn = figure(3.1 * (1 + len(rows[0].maps)), 3.3 * len(rows))
    axes = drawn.subplots(len(rows), 1 + len(rows[0].maps), squeeze=False)
    for one, panels in zip(rows, axes, strict=True):
        pictures = {f"{one.name}, published": one.pixels.colours}
        for method, linear in one.maps.items():
            found = agreement(one.pixels, linear)
            pictures[f"{_TITLES[method]}: r = {found.correlation:.3f}"] = encoded(linear, found.brightness)
        for (title, colours), panel in zip(pictures.items(), panels, strict=True):
            panel.imshow(one.pixels.picture(colours), interpolation="nearest")
            panel.set_title(title, fontsize=11)
            panel.set_axis_off()
    drawn.supxlabel("r: correlation of the colours with those of the published map, outside of the mirror direction")
    return drawn


def table(rows: Iterable[Row]) -> list[list[str]]:
    """Return the correlations as rows of `COLUMNS`."""
    return [
        [one.name, _TITLES[method], *(f"{agreement(one.pixels, linear, kind).correlation:.3f}" for kind in ENCODINGS)]
        for one in rows
        for method, linear in one.maps.items()
    ]


def plot_heights(curves: Mapping[str, Array]) -> Figure:
    """Plot correlation against height range, a panel for each surface: name → (n,) at the heights."""
    drawn = figure(4.2 * len(curves), 3.6)
    axes = drawn.subplots(1, len(curves), sharey=True, squeeze=False)[0]
    for panel, (name, values) in zip(axes, curves.items(), strict=True):
        published = PUBLISHED_MAPS[name]
        panel.plot(_HEIGHTS, values, marker="o", markersize=4, label="FLSS as published")
        panel.axvline(published.height, color="0.4", linestyle="--", linewidth=1, label="height in the maps")
        panel.set_title(published.name, fontsize=11)
        panel.set_xlabel("height, black to white / µm")
        panel.set_ylim(0.88, 1.005)
        panel.grid(alpha=0.3)
    axes[0].set_ylabel("correlation with the published map")
    drawn.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=3, frameon=False)
    return drawn


def save_published(
    folder: str | os.PathLike[str],
    *,
    step: int = 2,
    progress: Progress = silent,
) -> list[list[str]]:
    """Write `FILES` into a folder: the maps, their correlations, and these against the heights of the skins.

    Args:
        folder: of the files; it exists.
        step: between pixels of the published pictures.
        progress: called with (steps done, steps in total).

    Returns:
        Rows of `COLUMNS`.
    """
    folder, skins = Path(folder), ("elaphe", "xenopeltis")
    total = len(PUBLISHED_MAPS) + len(skins)
    rows = []
    for name in PUBLISHED_MAPS:
        rows.append(row(name, step))
        progress(len(rows), total)
    curves: dict[str, Array] = {}
    for name in skins:
        curves[name] = correlation_against_height(PUBLISHED_MAPS[name], _HEIGHTS)
        progress(len(rows) + len(curves), total)
    for name, drawn in (("published_maps.png", plot_maps(rows)), ("published_heights.png", plot_heights(curves))):
        with whole_file(folder / name) as temporary:
            # Of all colours: a palette is too coarse for dark maps.
            drawn.savefig(temporary, format="png", dpi=100, metadata=METADATA)
    found = table(rows)
    save_markdown(markdown(COLUMNS, found, texts=2), folder / "published_maps.md")
    return found


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of the figures and the table; created if missing")
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    mi.set_variant(choose_variant(None))
    with progress_bar("published maps") as progress:
        found = save_published(folder, progress=progress)
    show(progress_table(COLUMNS, found, texts=2), width=80)


if __name__ == "__main__":
    main()
