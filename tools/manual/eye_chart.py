"""Print how well designed plates resolve bars, and draw the chart: python tools/manual/eye_chart.py docs/eye_chart.png

The chart has a row of three bars and equal gaps for each width, in distances λ/T of adjacent orders. It is cast by
plates for a laser of 532 nm and for white light (orders of 550 nm). Contrast is (L − L₀)/(L + L₀) of the mean radiances
of the bars and of the gaps between them, the mean over the wavelengths.
"""

from __future__ import annotations

import argparse
import math
from pathlib import Path

import numpy as np
from matplotlib.figure import Figure
from numpy.typing import NDArray

import mitsuba_diffraction as md
from mitsuba_diffraction.evaluation.plots import save_png
from mitsuba_diffraction.optics.color import into_gamut, on_screen, plain_view

WIDTHS = (2, 3, 4, 6)  # of a bar, in orders
TEXELS, ANGLE, TEXEL = 64, 17.5, 0.8
ROW, GAP = 8, 3  # orders: height of a row of bars, and between two
PIXELS = 8  # along an order
PLATES = {"laser": {"wavelengths": 532.0}, "white light": {}}
STARTS = 2


def chart(orders_across: float) -> tuple[NDArray[np.float64], dict[int, tuple[NDArray[np.bool_], NDArray[np.bool_]]]]:
    """Return the chart, rows from the top, and for each width masks of its bars and its gaps."""
    y, x = (np.mgrid[0 : orders_across : 1 / PIXELS, 0 : orders_across : 1 / PIXELS] - orders_across / 2)[:]
    picture, masks = np.zeros(x.shape), {}
    for row, width in enumerate(WIDTHS):
        top = (row - len(WIDTHS) / 2) * (ROW + GAP) + GAP / 2
        inside = (y >= top) & (y < top + ROW) & (np.abs(x) < 2.5 * width)
        bar = np.floor((x + 2.5 * width) / width).astype(int) % 2 == 0
        picture[inside & bar] = 1
        masks[width] = inside & bar, inside & ~bar
    return picture, masks


def contrasts(design: md.inverse_design.Design, masks: dict) -> dict[int, float]:
    """Return the contrast of the bars of each width."""
    light = design.predicted[:, ::-1, :: -1 if design.plate.mirrored else 1]  # rows from the top, as it is seen
    found = {}
    for width, (bars, gaps) in masks.items():
        rows, columns = (np.arange(n) * light.shape[1] // n for n in bars.shape)
        fine = light[:, rows][:, :, columns]
        bright, dark = fine[:, bars].mean(axis=1), fine[:, gaps].mean(axis=1)
        found[width] = float(((bright - dark) / (bright + dark)).mean())
    return found


def main() -> None:
    """Design the plates, print the table, and draw the figure."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("picture", type=Path, nargs="?")
    arguments = parser.parse_args()
    figure = Figure(figsize=(9, 3.3), layout="constrained")
    panels = figure.subplots(1, len(PLATES) + 1)
    print(f"| bars | {' | '.join(f'{width} orders' for width in WIDTHS)} |\n|---|{'---|' * len(WIDTHS)}")
    for panel, (name, options) in zip(panels[1:], PLATES.items(), strict=True):
        wavelength = options.get("wavelengths", 550.0) * 1e-3
        orders_across = 2 * math.sin(math.radians(ANGLE)) * TEXELS * TEXEL / wavelength
        picture, masks = chart(orders_across)
        found = md.design(picture, TEXEL, TEXELS, angle=ANGLE, starts=STARTS, **options)
        print(f"| {name} | {' | '.join(f'{x:.2f}' for x in contrasts(found, masks).values())} |", flush=True)
        for axes, light, title in zip((panels[0], panel), found.seen, ("target", name), strict=True):
            axes.imshow(on_screen(into_gamut(light), plain_view), origin="lower")
            axes.set(title=title, xticks=[], yticks=[])
    if arguments.picture:
        save_png(figure, arguments.picture)


if __name__ == "__main__":
    main()
