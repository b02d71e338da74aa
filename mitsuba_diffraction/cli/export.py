"""`mitsuba-diffraction export`: a surface for other programs, in the format of the suffix."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from ..errors import RequestError
from ..export.exported_grating import ExportedGrating
from ..export.lswm import write_lswm
from ..export.order_table import write_order_table
from ..files.outputs import check_outputs
from ..progress import progress_bar, tell
from ..scalar_theory.validity import scalar_error
from .arguments import (
    Overwrite,
    angles_of,
    check_suffix,
    options_of_scan,
    parse_numbers,
    recipe_with,
    settings_of,
    surface_of,
    takes_scan,
)

_OF_MATERIAL = ("theory", "material", "int_ior")
_RANGES = {
    ".csv": {"wavelength": "400:700:10", "angle": "0:80:5", "azimuth": "0"},
    ".json": {"wavelength": "450:650:50", "angle": "0:80:10", "azimuth": "0:360:30"},
}
_SUFFIXES = tuple(_RANGES)


@takes_scan
def export(
    context: typer.Context,
    source: Annotated[
        str,
        typer.Argument(
            metavar="SURFACE[,name=value…]",
            help="a recipe (.toml), a profile, or a scan; name=value: theory, material, int_ior, and the parameters of "
            "a profile",
        ),
    ],
    output: Annotated[
        Path,
        typer.Option(
            "-o", "--output", help=".csv: the orders as a table; .json: a grating for Zemax OpticStudio and Speos"
        ),
    ],
    wavelength: Annotated[
        str | None,
        typer.Option(help="nm: a number, several, or first:last:step; default: 400:700:10, .json 450:650:50"),
    ] = None,
    angle: Annotated[
        str | None, typer.Option(help="polar angle of the light, degrees; default: 0:80:5, .json 0:80:10")
    ] = None,
    azimuth: Annotated[
        str | None, typer.Option(help="azimuth towards which the light travels, degrees; default: 0, .json 0:360:30")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a surface for another program."""
    name, values = surface_of(source)
    check_suffix("-o", output, *_SUFFIXES)
    suffix = output.suffix.lower()
    given = {"wavelength": wavelength, "angle": angle, "azimuth": azimuth}
    ranges = _RANGES[suffix] | {key: text for key, text in given.items() if text is not None}
    wavelengths, angles = parse_numbers("--wavelength", ranges["wavelength"]), angles_of("--angle", ranges["angle"])
    azimuths = parse_numbers("--azimuth", ranges["azimuth"])
    of_scan, settings = options_of_scan(context), settings_of(context)
    of_spectrum: dict[str, Any] = {key: settings[key] for key in ("extent", "coherence_length") if key in settings}
    if Path(name).suffix.lower() == ".exr":
        raise RequestError(f"{name}: got a saved spectrum for {output}, wanted the recipe, the profile or the scan")
    parameters = {key: values.pop(key) for key in _OF_MATERIAL if key in values}
    recipe = recipe_with(name, values, of_scan, of_spectrum)
    check_outputs([Path(name), *recipe.files], [("-o", output)], overwrite=overwrite)
    grating = ExportedGrating.of_recipe(recipe, source.partition(",")[0], parameters, float(wavelengths.min()) * 1e-3)
    with progress_bar(f"orders of {name}") as progress:
        if suffix == ".csv":
            rows = write_order_table(grating, output, wavelengths, angles, azimuths, progress)
            what = f"{rows:,} rows"
        else:
            write_lswm(grating, output, wavelengths, angles, azimuths, progress)
            sides = "from both sides" if grating.transmits else "from above"
            what = f"{len(wavelengths)} wavelengths × {len(angles)} × {len(azimuths)} directions of light {sides}"
    warning = scalar_error(grating.height_field).warning if grating.theory == "scalar" else ""
    if warning:
        tell(f"! {warning}")
    tell(f"{output}: {grating.description}; {what}")
