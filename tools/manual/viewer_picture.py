"""Take docs/viewer.png: a live page in Chromium, as it opens.

    python tools/manual/viewer_picture.py docs/viewer.png
    python tools/manual/viewer_picture.py --dark --width 390 --height 844 phone.png

needs what tools/manual/live_browser.py needs.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from live_browser import draw, opened
from live_pages import SURFACES


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("output", type=Path)
    parser.add_argument("--surface", choices=SURFACES, default="compact_disc")
    parser.add_argument("--with", dest="right", default="none", help="the other side: flss, nmm, …")
    parser.add_argument("--dark", action="store_true")
    parser.add_argument("--frames", type=int, default=16)
    parser.add_argument("--width", type=int, default=960)
    parser.add_argument("--height", type=int, default=560)
    options = parser.parse_args()
    size = {"width": options.width, "height": options.height}
    with opened(options.surface, viewport=size, color_scheme="dark" if options.dark else "light") as tab:
        draw(tab, {"right": options.right}, options.frames)
        tab.screenshot(path=options.output)


if __name__ == "__main__":
    main()
