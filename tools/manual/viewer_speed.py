"""Print the table of docs/speed.md on the live view: the time of a frame, of this model and of the shader of 2014.

    python tools/manual/viewer_speed.py

A sphere under parallel light, drawn by Chromium's software renderer; both shaders draw all pixels in turn.
"""

from __future__ import annotations

import argparse
from statistics import median

from live_browser import draw, opened
from live_pages import SURFACES

SIZE, FRAMES = 512, 2  # the first one is compiled
CONTROLS = 330  # pixels beside the picture
VARIANTS = ("flss", "nmm", "pq", "nmm_pq", "gem")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("surfaces", nargs="*", default=list(SURFACES))
    options = parser.parse_args()
    print("| surface | this model, ms |", " | ".join(name.upper().replace("_", " ") for name in VARIANTS), "| MB |")
    print("|---|---|" + "---|" * (len(VARIANTS) + 1), flush=True)
    for surface in options.surfaces:
        with opened(surface, viewport={"width": SIZE + CONTROLS, "height": SIZE}) as tab:
            state = {"shape": "sphere", "lightWidth": 0, "lightLength": 0, "sky": 0, "difference": True}
            model, ratios = [], []
            for variant in VARIANTS:
                draw(tab, {**state, "right": variant}, FRAMES)
                own, other = tab.evaluate("viewer.renderer.sides.map((side) => side.milliseconds)")
                model.append(own)
                ratios.append(other / own)
            width = tab.evaluate("viewer.renderer.width")
            assert width == SIZE, width
            megabytes = tab.evaluate("viewer.renderer.spectrum.bytes") / 1e6
        print(
            f"| {surface} | {median(model):.0f} |",
            " | ".join(f"{ratio:.2g}" for ratio in ratios),
            f"| {megabytes:.2g} |",
        )


if __name__ == "__main__":
    main()
