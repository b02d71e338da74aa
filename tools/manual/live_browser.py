"""Live pages in Chromium, for the pictures and numbers of docs/viewer.md.

Needs the package playwright and Chromium (`apt-get install chromium`).
"""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from live_pages import live_page
from playwright.sync_api import Page, sync_playwright


@contextmanager
def opened(surface: str, **settings: Any) -> Iterator[Page]:
    """Open the page of a surface of live_pages.py, with settings of `Browser.new_page`."""
    arguments = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
    with tempfile.TemporaryDirectory() as folder, sync_playwright() as playwright:
        path = Path(folder) / "page.html"
        path.write_text(live_page(surface), encoding="utf-8")
        chromium = playwright.chromium.launch(executable_path=shutil.which("chromium"), args=arguments)
        tab = chromium.new_page(**settings)
        tab.goto(path.as_uri())
        tab.evaluate("viewer.ready")
        yield tab
        chromium.close()


def draw(tab: Page, changes: dict[str, Any], frames: int) -> None:
    """Change the state of the page, and wait until that many frames are drawn."""
    tab.evaluate("(changes) => viewer.set(changes)", {**changes, "maxFrames": frames})
    tab.evaluate("new Promise((done) => requestAnimationFrame(() => requestAnimationFrame(done)))")
    sides = 1 if tab.evaluate("viewer.state.right") == "none" else 2
    # The page forbids eval, and with it wait_for_function. The second side waits for its transforms.
    while tab.evaluate("viewer.renderer.sides.filter((side) => side.frame >= viewer.state.maxFrames).length") < sides:
        tab.wait_for_timeout(200)
