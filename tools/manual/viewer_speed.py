"""Draw docs/interactive.png, and print its numbers: interactive shaders, the time of a frame, the error.

    python tools/manual/viewer_speed.py docs/interactive.png

A sphere under parallel light in the live view, drawn by Chromium's software renderer. Times are those of the processor,
so that other work beside it matters less; errors are ΔE00 from the path-traced picture of view.xml, the shaders of 2014
at its mean luminance, as published.
"""

from __future__ import annotations

import argparse
import os
import tempfile
from pathlib import Path
from typing import Any

import matplotlib.pyplot as plt
import numpy as np
from live_browser import draw, opened
from live_pages import RECIPES, SURFACES
from playwright.sync_api import Page

from mitsuba_diffraction.optics.color import XYZ_to_linear_sRGB, auto_exposure, delta_E, into_gamut, radiance_to_XYZ
from mitsuba_diffraction.render import render
from mitsuba_diffraction.variants import choose_variant

SIZE, SPP = 128, 128
VIEWPORT = {"width": 960, "height": 560}
NAMES = {"none": "this model", "flss": "FLSS", "nmm": "NMM", "pq": "PQ", "nmm_pq": "NMM with PQ", "gem": "GEM"}
MARKERS = {"none": "o", "flss": "s", "nmm": "^", "pq": "D", "nmm_pq": "v", "gem": "x"}
TICKS = os.sysconf("SC_CLK_TCK")


def processor_seconds(process: int) -> float:
    """Return the time of a process and of those that it started."""
    total = 0.0
    for task in Path(f"/proc/{process}/task").iterdir():
        total += sum(processor_seconds(int(child)) for child in (task / "children").read_text().split())
    fields = Path(f"/proc/{process}/stat").read_text().rpartition(")")[2].split()
    return total + (int(fields[11]) + int(fields[12])) / TICKS


def frame_time(tab: Page, side: str) -> float:
    """Return milliseconds of the processor for a frame of a side, beside the geometry, from half a second of frames."""
    text = """([side, frames]) => { const { renderer, state } = viewer;
      for (let k = 0; k < frames; k++) {
        renderer.geometryFrame = renderer[side].frame;
        renderer.draw(renderer[side], state, [0, 1], Infinity);
      } }"""
    before, frames, spent = processor_seconds(os.getpid()), 0, 0.0
    while spent < 0.5:
        tab.evaluate(text, [side, count := max(frames, 1)])
        frames, spent = frames + count, processor_seconds(os.getpid()) - before
    return 1e3 * spent / frames


def mean_of(tab: Page, side: str) -> np.ndarray[Any, Any]:
    """Return XYZ and coverage of pixels, from the top."""
    values = np.array(tab.evaluate(f"Array.from(viewer.renderer.readMean(viewer.renderer.{side}).values)"))
    return values.reshape(SIZE, SIZE, 4)[::-1]


def measured(surface: str) -> dict[str, tuple[float, float]]:
    """Return milliseconds and mean ΔE00 of each shader."""
    found: dict[str, tuple[float, float]] = {}
    recipe = SURFACES[surface][1]
    with opened(surface, viewport=VIEWPORT) as tab:
        style = f"{{ width: '{SIZE}px', height: '{SIZE}px', inset: 'auto' }}"
        tab.evaluate(f"Object.assign(document.getElementById('canvas').style, {style})")
        while tab.evaluate("viewer.renderer.height") != SIZE:
            tab.wait_for_timeout(100)
        state = {"shape": "sphere", "lightWidth": 0, "lightLength": 0, "sky": 0, "hasBase": False, "difference": True}
        draw(tab, {**state, "right": "none"}, 4)
        scene = tab.evaluate("viewer.scene()").replace(f'"{Path(recipe).stem}"', f'"{RECIPES / recipe}"')
        scene = scene.replace('type="path"', 'type="diffraction_path"')
        with tempfile.TemporaryDirectory() as folder:
            (path := Path(folder) / "view.xml").write_text(scene)
            image = render(path, spp=SPP)
        wanted = radiance_to_XYZ(image.radiance, image.wavelengths)
        for variant in NAMES:
            draw(tab, {**state, "right": variant}, 4 if variant == "none" else 1)
            side = "model" if variant == "none" else "shader"
            shown = mean_of(tab, side)
            inside = shown[..., 3] == 1
            reference, own = wanted[inside], shown[inside][:, :3]
            if side == "shader":
                own = own * (reference[:, 1].sum() / own[:, 1].sum())
            exposure = auto_exposure(into_gamut(XYZ_to_linear_sRGB(reference)))
            error = delta_E(*(np.clip(exposure * XYZ, 0, 1) for XYZ in (own, reference))).mean()
            tab.evaluate("viewer.state.maxFrames = 0")
            found[variant] = frame_time(tab, side), float(error)
            print(surface, NAMES[variant], "{:.0f} ms, ΔE00 {:.2f}".format(*found[variant]), flush=True)
    return found


def plot(results: dict[str, dict[str, tuple[float, float]]], path: Path) -> None:
    """Draw (milliseconds, ΔE00) of each shader, a panel for each surface."""
    figure, axes = plt.subplots(1, len(results), figsize=(7, 3.4), sharey=True, squeeze=False)
    for axis, (surface, shaders) in zip(axes[0], results.items(), strict=True):
        for variant, (time, error) in shaders.items():
            axis.plot(time, error, MARKERS[variant], color="C3" if variant == "none" else "C0", label=NAMES[variant])
        axis.set(xscale="log", yscale="log", xlabel="time of a frame in ms", title=SURFACES[surface][0])
        axis.margins(x=0.22, y=0.15)
        axis.grid(alpha=0.3)
    axes[0, 0].set_ylabel("mean ΔE00")
    axes[0, -1].legend(loc="lower right")
    figure.tight_layout()
    figure.savefig(path, dpi=110)
    plt.close(figure)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("surfaces", nargs="*", default=["blaze", "elaphe"])
    options = parser.parse_args()
    import mitsuba as mi  # after LLVM has been chosen

    mi.set_variant(choose_variant())
    plot({surface: measured(surface) for surface in options.surfaces}, options.output)


if __name__ == "__main__":
    main()
