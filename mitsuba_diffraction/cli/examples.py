"""`mitsuba-diffraction examples`: the scenes, recipes and measured skins that the package brings."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ..errors import RequestError
from ..files.writing import examples_folder, whole_file
from ..progress import tell
from .arguments import Overwrite

_OUTPUT_FOLDERS = {"models", "out", "__pycache__"}
"""Folders in a checkout that hold outputs of scripts and renderings."""


def examples(
    folder: Annotated[Path, typer.Argument(metavar="[DIR]", help="target folder; created if missing")] = Path(),
    overwrite: Overwrite = False,
) -> None:
    """Copy the scenes, recipes and measured skins that the package contains."""
    root = examples_folder()
    contents = {folder / path: (root / path).read_bytes() for path in _files(root)}
    new = {
        target: content
        for target, content in contents.items()
        if not target.is_file() or target.read_bytes() != content
    }
    for target in new:
        if target.exists() and not overwrite:
            raise RequestError(f"{target} exists and is another file; --overwrite replaces it")
    for target, content in new.items():
        target.parent.mkdir(parents=True, exist_ok=True)
        with whole_file(target) as temporary:
            temporary.write_bytes(content)
    tell(f"{folder}: {len(contents)} files, described in scenes/README.md and precompute/README.md")


def _files(root: Path) -> list[Path]:
    """Return the files of the examples, relative to `root`."""
    found = [path.relative_to(root) for name in ("scenes", "precompute") for path in sorted((root / name).rglob("*"))]
    excluded = {path for path in found if _OUTPUT_FOLDERS & set(path.parts) or path.name.startswith(".")}
    # .exr files beside scenes and recipes are renderings and spectra; .exr files in subfolders are textures.
    excluded |= {path for path in found if path.suffix == ".exr" and len(path.parts) == 2}
    return [path for path in found if path not in excluded and (root / path).is_file()]
