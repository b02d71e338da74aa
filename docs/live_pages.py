"""Live pages of the manual: a hook of MkDocs (mkdocs.yml), which makes them with the site.

    python docs/live_pages.py FOLDER

writes them to a folder instead.
"""

from __future__ import annotations

import sys
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from mitsuba_diffraction.viewer.page import page
from mitsuba_diffraction.viewer.surface import Surface

RECIPES = Path(__file__).parents[1] / "precompute"
SURFACES = {
    "blaze": ("blaze.toml", {"material": "Al"}),
    "elaphe": ("elaphe.toml", {}),
    "xenopeltis": ("xenopeltis.toml", {}),
}


def live_page(name: str) -> str:
    """Return the page of one of `SURFACES` as HTML."""
    recipe, parameters = SURFACES[name]
    return page(Surface.named(RECIPES / recipe, parameters))


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages to the site, as live/NAME.html."""
    for name in SURFACES:
        files.append(File.generated(config, f"live/{name}.html", content=live_page(name)))
    return files


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name in SURFACES:
        (folder / f"{name}.html").write_text(live_page(name), encoding="utf-8")
