"""Make the figure and the table of measured/README.md: python tools/manual/measured_skins.py docs/removed_dust.png

The figure shows the pixels that the recipes of the scans of 65 µm remove. For the two height scales of Xenopeltis, the
panel of 20 µm is located in its scan of 65 µm by normalised cross-correlation; then properties of the skin follow for
either scale.
"""

from __future__ import annotations

import sys
from pathlib import Path

import numpy as np
from numpy.typing import NDArray
from PIL import Image
from scipy import ndimage, signal

from mitsuba_diffraction.files.writing import whole_file
from mitsuba_diffraction.precomputation.recipe import Recipe
from mitsuba_diffraction.scalar_theory.validity import scalar_error
from mitsuba_diffraction.surface import prepare
from mitsuba_diffraction.surface.heightfield import HeightField
from mitsuba_diffraction.surface.readers import read_height_field

RECIPES = Path(__file__).parents[2] / "precompute"
SCALES = 0.4435, 0.8187  # µm, black to white
SURROUNDINGS = 1.6  # µm; slower waves are left out

Array = NDArray[np.float64]


def draw_removed(path: Path, side: int = 560) -> None:
    """Draw both scans, each `side` pixels wide, with the removed pixels in red."""
    panels = []
    for name in ("elaphe", "xenopeltis"):
        recipe = Recipe.load(RECIPES / f"{name}.toml")
        surface = recipe.surface
        scan = read_height_field(recipe.files[0], surface["pixel_size"], surface["height_range"])
        gaps = prepare.apply_steps(scan, surface["prepare"][:1]).gaps
        with Image.open(recipe.files[0]) as picture:
            grey = np.asarray(picture.convert("L").resize((side, side))) // 4
        removed = np.asarray(Image.fromarray(gaps).convert("L").resize((side, side))) > 0
        panels.append(np.where(removed, np.uint8(64), grey))
    figure = Image.fromarray(np.hstack([panels[0], np.full((side, 6), 63, np.uint8), panels[1]]))
    figure.putpalette([4 * level for level in range(64) for _ in range(3)] + [255, 0, 0])
    with whole_file(path) as temporary:
        figure.save(temporary, "PNG", optimize=True)


def structure(heights: Array, pixel: float) -> Array:
    """Return heights relative to their surroundings, in the unit of the heights."""
    return heights - ndimage.gaussian_filter(heights, SURROUNDINGS / pixel)


def locate(panel: Array, scan: Array) -> tuple[float, tuple[int, int], float]:
    """Find a panel in a scan of the same pixel size: correlation, first row and column, ratio of the r.m.s. heights."""
    products = signal.fftconvolve(scan, panel[::-1, ::-1], "valid")
    squares = signal.fftconvolve(scan**2, np.ones(panel.shape), "valid")
    correlation = products / np.sqrt(squares * (panel**2).sum())
    row, column = np.unravel_index(np.argmax(correlation), correlation.shape)
    found = scan[row : row + panel.shape[0], column : column + panel.shape[1]]
    return float(correlation.max()), (int(row), int(column)), float(panel.std() / found.std())


def register() -> None:
    """Print where the panel lies in the scan, and how its heights compare."""
    recipe = Recipe.load(RECIPES / "xenopeltis.toml")
    pixel = recipe.surface["pixel_size"]
    scan = read_height_field(recipe.files[0], pixel_size=pixel, height_range=SCALES[0]).heights
    panel = read_height_field(RECIPES / "measured" / "xenopeltis_afm_20um.npz", fill_missing=True)
    zoomed = ndimage.zoom(panel.heights, panel.pixel_size[0] / pixel)
    edge = round(SURROUNDINGS / pixel)  # where the surroundings are cut off
    inside = structure(zoomed, pixel)[edge:-edge, edge:-edge]
    correlation, (row, column), ratio = locate(inside, structure(scan, pixel))
    print(
        f"panel of 20 µm in the scan of 65 µm: correlation {correlation:.3f}, at x = {(column - edge) * pixel:.1f} µm, "
        f"y = {(row - edge) * pixel:.1f} µm; its heights are {ratio:.2f} times those of the scan"
    )


def properties(scale: float) -> list[str]:
    """Return the properties of the scan for one height scale, as they are printed."""
    recipe = Recipe.load(RECIPES / "xenopeltis.toml")
    field = recipe.height_field()
    heights = structure(field.heights, field.pixel_size[0]) * scale / recipe.surface["height_range"]
    low, high = np.percentile(heights, [1, 99])
    slope = np.hypot(*np.gradient(heights, *field.pixel_size))
    mirror = [abs(np.exp(4j * np.pi / wavelength * heights).mean()) ** 2 for wavelength in (0.45, 0.55, 0.65)]
    error = scalar_error(HeightField(heights, field.pixel_size), "sample").reflected
    return [
        f"{1e3 * heights.std():.0f} nm",
        f"{1e3 * (high - low):.0f} nm",
        ", ".join(
            f"{np.degrees(np.arctan(value)):.0f}°" for value in ((slope**2).mean() ** 0.5, np.percentile(slope, 99))
        ),
        ", ".join(f"{100 * value:.0f} %" for value in mirror),
        f"{100 * error:.0f} %",
    ]


def main() -> None:
    """Draw the figure if it is named; print the registration and the table."""
    if len(sys.argv) > 1:
        draw_removed(Path(sys.argv[1]))
    register()
    rows = (
        "r.m.s. height of the structure",
        "1 % to 99 % of its heights",
        "slope: r.m.s., 99 % of the surface below",
        "not diffracted, normal incidence, 450, 550, 650 nm",
        "error of scalar theory",
    )
    print("| black to white | " + " | ".join(f"{scale} µm" for scale in SCALES) + " |\n|---|---|---|")
    for name, *values in zip(rows, *(properties(scale) for scale in SCALES), strict=True):
        print(f"| {name} | " + " | ".join(values) + " |")


if __name__ == "__main__":
    main()
