"""`mitsuba-diffraction efficiency`: the efficiencies of the orders of a grating, over angles and wavelengths."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from ..efficiency import efficiencies
from ..errors import RequestError
from ..outputs import check_outputs
from ..progress import progress_bar, tell
from ..recipe import Recipe
from ..surface.gratings import PROFILES
from .arguments import Overwrite, check_suffix, surface_of

_MAX_VALUES = 10_000  # of a range first:last:step


def efficiency(
    source: Annotated[
        str, typer.Argument(metavar="RECIPE|PROFILE[,name=value…]", help="a recipe (.toml), or a profile")
    ],
    angle: Annotated[
        str, typer.Option(help="of incidence, degrees: a number, several (0,30), or first:last:step")
    ] = "0",
    wavelength: Annotated[str, typer.Option(help="nm: a number, several, or first:last:step")] = "400:700:50",
    theory: Annotated[
        str | None, typer.Option(help="scalar or rigorous; default: that of the recipe, or scalar")
    ] = None,
    material: Annotated[
        str | None, typer.Option(help="a conductor, as Mitsuba names it; default: that of the recipe, or n = 1.5")
    ] = None,
    int_ior: Annotated[float | None, typer.Option(help="or the index of a dielectric")] = None,
    transmission: Annotated[
        str | None,
        typer.Option(help="none, interface or sheet: the transmitted orders; default: that of the recipe, or none"),
    ] = None,
    azimuth: Annotated[
        float, typer.Option(help="of the plane of incidence, degrees from x; 90: along the grooves")
    ] = 0,
    csv: Annotated[Path | None, typer.Option(help="save all numbers (.csv)")] = None,
    plot: Annotated[Path | None, typer.Option(help="save a plot (.png, .pdf, .svg)")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Compute the efficiencies of the orders of a grating."""
    angles, wavelengths = _numbers("--angle", angle), _numbers("--wavelength", wavelength)
    name, values = surface_of(source)
    if Path(name).suffix.lower() == ".toml":
        recipe = Recipe.load(name)
        recipe = Recipe({**recipe.surface, **values}, recipe.settings, recipe.folder)
    elif name not in PROFILES and (Path(name).suffix or Path(name).exists()):
        raise RequestError(f"{name}: got a file, wanted a recipe (.toml) or the name of a profile, such as blazed")
    else:
        recipe = Recipe({"profile": name, **values})
    settings = recipe.settings
    if settings.extent != "tile":
        raise RequestError(f"{name}: got a sample of an irregular surface, wanted a grating that repeats")
    if material is None and int_ior is None:
        material, int_ior = settings.material, settings.int_ior
    if csv is not None:
        check_suffix("--csv", csv, ".csv")
    if plot is not None:
        check_suffix("--plot", plot, ".png", ".pdf", ".svg")
    writes = [(option, path) for option, path in (("--csv", csv), ("--plot", plot)) if path is not None]
    check_outputs([Path(name), *recipe.files], writes, overwrite=overwrite)
    with progress_bar(f"efficiencies of {name}") as progress:
        found = efficiencies(
            recipe.height_field(),
            angles,
            wavelengths,
            theory=theory or settings.theory,
            material=material,
            int_ior=int_ior,
            transmission=transmission or settings.transmission,
            azimuth=azimuth,
            progress=progress,
        )
    tell(str(found))
    if csv is not None:
        found.save_csv(csv)
        tell(f"{csv}: all numbers")
    if plot is not None:
        found.plot(plot)
        tell(f"{plot}: a plot of the strongest orders")


def _numbers(option: str, text: str) -> NDArray[np.float64]:
    """Return the numbers in "30", "0,30,60" or "0:60:5" (60 included), (n,).

    Raises:
        ValueError: if the text has another form, or more than 10,000 numbers.

    """
    try:
        if ":" not in text:
            return np.array([float(part) for part in text.split(",")])
        first, last, step = (float(part) for part in text.split(":"))
        count = (last - first) / step
        if not 0 <= count < _MAX_VALUES:
            raise ValueError
        return first + step * np.arange(int(count + 1e-9) + 1)
    except (ValueError, ZeroDivisionError):
        raise RequestError(f"{option}: got {text!r}, wanted a number, numbers as 0,30,60, or first:last:step") from None
