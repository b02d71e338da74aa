"""`mitsuba-diffraction hologram`: a picture as a hologram of gratings, with its scene and a preview."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Annotated

import typer

from ..errors import RequestError
from ..files.outputs import MARK, check_outputs
from ..files.writing import examples_folder, whole_file
from ..inverse_design import hologram as of_picture
from ..progress import progress_bar, tell
from .arguments import Overwrite
from .render import render

_SPP = 24  # of the preview, which is denoised if the extra is installed


def hologram(
    picture: Annotated[Path, typer.Argument(metavar="PICTURE", help="any picture (.png, .jpg, …)")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="folder; default: ./PICTURE_hologram")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Turn a picture into a hologram of gratings, red, green and blue: textures, a scene, and a preview of it."""
    folder = output or Path(f"{picture.stem}_hologram")
    models, scene, preview = folder / "models", folder / "hologram.xml", folder / "hologram.png"
    textures = of_picture.textures_in(models)
    of_picture.fitted(picture, 16)  # refused before a folder is made
    made = [path for path in (folder, models) if not path.exists()]
    models.mkdir(parents=True, exist_ok=True)
    try:
        check_outputs([picture], [("-o", path) for path in (*textures, scene, preview)], overwrite=overwrite)
    except RequestError:
        for path in reversed(made):
            path.rmdir()
        raise
    with progress_bar(f"gratings of {picture.name}", "", "computing"):
        lateral, heights, _ = of_picture.write(picture, models)
    text = (examples_folder() / "scenes" / "hologram.xml").read_text(encoding="utf-8")
    maker = f"{MARK}; its stone is made by: python scenes/ground.py"
    with whole_file(scene) as temporary:
        temporary.write_text(
            re.sub(r"Its textures are made by:\s+python .*\.py", maker, text, count=1), encoding="utf-8"
        )
    periods = f"{of_picture.PERIOD * lateral.min():.2f} to {of_picture.PERIOD * lateral.max():.2f} µm"
    tell(
        f"{scene}: a hologram of {of_picture.SIZE[0]:g} × {of_picture.SIZE[1]:g} cm, periods {periods}, "
        f"depths up to {1e3 * of_picture.DEPTH * heights.max():.0f} nm; its parameters are in scenes/README.md"
    )
    render(scene, preview, spp=_SPP, overwrite=overwrite)
