"""`md.view`: the page of a surface in a notebook."""

from __future__ import annotations

import html
import os
from collections.abc import Mapping
from typing import Any

from ..errors import RequestError
from ..precomputation.grating_spectrum import GratingSpectrum
from ..precomputation.in_scene import in_scene
from ..precomputation.recipe import Recipe
from .page import page
from .viewed_surface import ViewedSurface


class View:
    """A page, shown by Jupyter in a frame of its own.

    Attributes:
        page: its HTML.
        height: of the frame, pixels.
    """

    def __init__(self, page: str, height: int) -> None:
        self.page, self.height = page, height

    def _repr_html_(self) -> str:
        style = f"width:100%;height:{self.height}px;border:0"
        return f'<iframe srcdoc="{html.escape(self.page)}" style="{style}"></iframe>'


def view(surface: str | os.PathLike[str] | Recipe | GratingSpectrum, height: int = 640, **parameters: Any) -> View:
    """Return a live view of a surface for a notebook.

    Args:
        surface: a recipe or its file (.toml), a spectrum or its file (.exr), or the name of a profile.
        height: of the view, pixels.
        parameters: `material` or `int_ior`, `orientation`, `height_scale`; and the parameters of the profile.

    Raises:
        RequestError: if a parameter is wrong, or the page does not show such a surface.
    """
    return View(page(_surface(surface, parameters)), height)


def _surface(surface: object, parameters: Mapping[str, Any]) -> ViewedSurface:
    if isinstance(surface, GratingSpectrum):
        file = {"filename": "surface.exr"}
        return ViewedSurface(
            "surface", surface, None, file, in_scene(parameters), '# in Python: spectrum.save("surface.exr")'
        )
    if isinstance(surface, Recipe):
        name = str(surface.surface.get("profile") or surface.surface.get("scan"))
        command = '# in Python: recipe.build().save("surface.exr")'
        return ViewedSurface.of_recipe(surface, name, {"filename": "surface.exr"}, parameters, command=command)
    if isinstance(surface, str | os.PathLike):
        return ViewedSurface.named(surface, parameters)
    raise RequestError(
        f"surface: got {type(surface).__name__}, wanted a file, a profile, a Recipe or a GratingSpectrum"
    )
