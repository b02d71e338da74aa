"""`mitsuba-diffraction hologram`: a picture as a hologram of gratings, with its scene and a preview."""

from __future__ import annotations

import math
import re
from pathlib import Path
from typing import Annotated, Literal

import typer

from ..errors import RequestError
from ..files.outputs import MARK, check_outputs
from ..files.writing import examples_folder, whole_file
from ..inverse_design import hologram as of_picture
from ..progress import progress_bar, tell
from .arguments import Overwrite
from .render import render

_SPP = 24  # of the preview, which is denoised if the extra is installed
_FOV = 17.5  # degrees: of hologram.xml, with a hologram of `of_picture.SIZE`


def hologram(
    picture: Annotated[Path, typer.Argument(metavar="PICTURE", help="any picture (.png, .jpg, …)")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="folder; default: ./PICTURE_hologram")] = None,
    size: Annotated[float, typer.Option(min=4, max=24, metavar="CM", help="width of the hologram, 16 : 9")] = 16.0,
    tilt: Annotated[
        float, typer.Option(min=-30, max=30, metavar="DEGREES", help="tilt towards the eye: the colours change")
    ] = 0.0,
    material: Annotated[
        Literal["foil", "clear"], typer.Option(help="aluminium foil, or clear plastic with zinc sulphide")
    ] = "foil",
    lamp: Annotated[
        float, typer.Option(min=0.1, max=5, metavar="CM", help="radius of the lamp; pale colours if it is large")
    ] = 0.8,
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
        lateral, heights, _ = of_picture.write(picture, models, width=size)
    text = (examples_folder() / "scenes" / "hologram.xml").read_text(encoding="utf-8")
    text = re.sub(r"Its textures are made by: python .*\.py", MARK, text, count=1)
    # The camera sees as much beside a hologram of any size.
    angle = math.degrees(2 * math.atan(math.tan(math.radians(_FOV / 2)) * size / of_picture.SIZE[0]))
    for name, value in {"tilt": tilt, "lamp": lamp, "card": material, "size": size, "fov": f"{angle:.4g}"}.items():
        text = re.sub(rf'(<default name="{name}" value=)"[^"]*"', rf'\1"{value}"', text, count=1)
    with whole_file(scene) as temporary:
        temporary.write_text(text, encoding="utf-8")
    periods = f"{of_picture.PERIOD * lateral.min():.2f} to {of_picture.PERIOD * lateral.max():.2f} µm"
    tell(
        f"{scene}: a hologram of {size:g} × {size * of_picture.SIZE[1] / of_picture.SIZE[0]:g} cm, periods {periods}, "
        f"depths up to {1e3 * of_picture.DEPTH * heights.max():.0f} nm"
    )
    render(scene, preview, spp=_SPP, overwrite=overwrite)
