"""The live pages of the manual: a hook of MkDocs (mkdocs.yml), which makes them with the site.

    python tools/manual/live_pages.py FOLDER

writes them to a folder instead.
"""

from __future__ import annotations

import logging
import sys
from dataclasses import replace
from functools import cache
from pathlib import Path

from mkdocs.config.defaults import MkDocsConfig
from mkdocs.structure.files import File, Files

from mitsuba_diffraction.viewer.page import page
from mitsuba_diffraction.viewer.viewed_surface import ViewedSurface

RECIPES = Path(__file__).parents[2] / "precompute"
SURFACES = {
    "compact_disc": ("Compact disc", "compact_disc.toml", {}),
    "dvd": ("DVD", "dvd.toml", {}),
    "foil": ("Foil of crossed gratings", "foil_crossed.toml", {"material": "Al"}),
    "blaze": ("Blazed grating of aluminium", "blaze.toml", {"material": "Al"}),
    "elaphe": ("Skin of Elaphe", "elaphe.toml", {}),
    "xenopeltis": ("Skin of Xenopeltis", "xenopeltis.toml", {}),
    "film": ("Film of diffraction glasses, reflected light", "film.toml", {}),
    "scan": ("A scan: Elaphe, 5.9 µm", "elaphe_afm.toml", {}),
}
"""Title, recipe and material of each, in the order of the list in the page of all."""
PAGES = {"surfaces": tuple(SURFACES), "turning": ("compact_disc", "foil", "xenopeltis")}
"""The surfaces of pages with several; the start page of the manual shows one that turns."""
_log = logging.getLogger("mkdocs.hooks.live_pages")


@cache  # `mkdocs serve` builds the site anew after each change
def live_page(name: str) -> str:
    """Return the page of one of `SURFACES`, or one of `PAGES`, as HTML."""
    surfaces = []
    for title, recipe, parameters in (SURFACES[one] for one in PAGES.get(name, (name,))):
        _log.info(f"live/{name}.html: {title}, which takes minutes unless its spectrum is cached")
        surfaces.append(replace(ViewedSurface.named(RECIPES / recipe, parameters), name=title))
    return page(*surfaces)


def on_files(files: Files, config: MkDocsConfig) -> Files:
    """Add the pages to the site, as live/surfaces.html and live/turning.html."""
    for name in PAGES:
        files.append(File.generated(config, f"live/{name}.html", content=live_page(name)))
    return files


if __name__ == "__main__":
    folder = Path(sys.argv[1])
    folder.mkdir(parents=True, exist_ok=True)
    for name in PAGES:
        (folder / f"{name}.html").write_text(live_page(name), encoding="utf-8")
