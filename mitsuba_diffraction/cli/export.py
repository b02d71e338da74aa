"""`mitsuba-diffraction export`: a surface for other programs, in the format of the suffix."""

from __future__ import annotations

from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from ..errors import RequestError, operand, shell_command
from ..export.blender_extension import write_extension
from ..export.colour_file import check_base, write_colours
from ..export.colour_table import Viewed
from ..export.cycles import write_shader
from ..export.exported_grating import ExportedGrating
from ..export.lswm import write_lswm
from ..export.node_tables import write_node_tables
from ..export.order_table import write_order_table
from ..export.shader_tables import ShaderTables, shader_recipe
from ..files.outputs import check_outputs
from ..precomputation.grating_spectrum import GratingSpectrum
from ..precomputation.in_scene import in_scene, with_plastic
from ..precomputation.requested_surface import RequestedSurface
from ..progress import progress_bar, say, tell
from ..scalar_theory.validity import scalar_error
from ..settings import VISIBLE, wavelengths_inside
from .arguments import (
    KEYS_OF_RECIPES,
    SURFACE,
    Overwrite,
    check_suffix,
    incidence_of,
    named_as_options,
    parse_numbers,
)

_OPTIONS = {"wavelengths": "--wavelength", "angles": "--angle", "azimuths": "--azimuth", "azimuth": "--azimuth"}
_OF_MEDIUM = ("theory", "material", "int_ior")
_INPUTS = {"orientation": "Orientation", "height_scale": "HeightScale", "base": "BaseColor"}  # of the shader
_IN_SCENES = ("coat_ior", "thin_film_ior", "thin_film_thickness", "transmission", "ext_ior", "lateral_scale", *_INPUTS)
_SHADERS = {".osl": write_shader, ".npz": write_node_tables}
_COLOURS = ".bin"
_OF_COLOURS = ("coat_ior", *_INPUTS)  # that it holds, beside the material
_RANGES = {
    ".csv": {"wavelength": "400:700:10", "angle": "0:80:5", "azimuth": "0"},
    ".json": {"wavelength": "450:650:50", "angle": "0:80:10", "azimuth": "0:360:30"},
}


def export(
    surface: Annotated[
        str | None,
        typer.Argument(
            metavar=SURFACE,
            help="a recipe (.toml), a profile, a scan, or for .bin, .osl and .npz a saved spectrum (.exr); "
            f"{KEYS_OF_RECIPES}, theory, material, int_ior; for .zip none",
        ),
    ] = None,
    *,
    output: Annotated[
        Path,
        typer.Option(
            "-o",
            "--output",
            help=".osl: a shader for Blender's Cycles; .zip: an extension of Blender; .npz: a surface for it; .bin: "
            "colours for three.js; .csv: the orders as a table; .json: a grating for Zemax OpticStudio and Speos",
        ),
    ],
    wavelength: Annotated[
        str | None,
        typer.Option(help="nm: a number, several, or first:last:step; default: 400:700:10, .json 450:650:50"),
    ] = None,
    angle: Annotated[
        str | None,
        typer.Option(
            help="polar angle of the light, degrees; default: 0:80:5, .json 0:80:10; .csv: littrow, littrow:m"
        ),
    ] = None,
    azimuth: Annotated[
        str | None, typer.Option(help="azimuth towards which the light travels, degrees; default: 0, .json 0:360:30")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Write a surface for another program."""
    if surface is None:
        _write_extension(output, overwrite)
        return
    requested = RequestedSurface.of(surface, aside=(*_OF_MEDIUM, *_IN_SCENES))
    check_suffix("-o", output, _COLOURS, *_SHADERS, *_RANGES)
    ranges = {"wavelength": wavelength, "angle": angle, "azimuth": azimuth}
    given = {key: text for key, text in ranges.items() if text is not None}
    _refuse_parameters_of_scenes(requested, surface, output)
    check_outputs(requested.files, [("-o", output)], overwrite=overwrite)
    if output.suffix.lower() not in _RANGES:
        if given:
            raise RequestError(f"--{', --'.join(given)}: {output} holds all directions and colours, wanted it without")
        (_write_colours if output.suffix.lower() == _COLOURS else _write_shader)(requested, output)
    elif requested.is_spectrum:
        raise RequestError(f"{surface}: got a saved spectrum for {output}, wanted the recipe, the profile or the scan")
    else:
        _write_orders(requested, output, given)


def _write_extension(output: Path, overwrite: bool) -> None:
    if output.suffix.lower() != ".zip":
        raise RequestError(f"SURFACE: got none for {output}, wanted a surface, or -o with a file .zip")
    check_outputs([], [("-o", output)], overwrite=overwrite)
    with progress_bar("tables of surfaces") as progress:
        held = write_extension(output, progress)
    tell(f"{output}: {held}")


def _refuse_parameters_of_scenes(requested: RequestedSurface, surface: str, output: Path) -> None:
    """Refuse parameters of the plugin that files for other programs do not hold, and name what does."""
    is_shader, has_colours = output.suffix.lower() in _SHADERS, output.suffix.lower() == _COLOURS
    held = _OF_COLOURS if has_colours else ()
    if output.suffix.lower() == ".npz" and requested.aside.get("transmission") == "sheet":
        held = ("transmission",)
    for key in _IN_SCENES:
        if key in requested.aside and key not in held:
            instead = f"set the input {_INPUTS[key]} of the shader" if is_shader and key in _INPUTS else ""
            if key == "transmission" and output.suffix.lower() == ".csv":
                command = shell_command("mitsuba-diffraction", "efficiency", surface, "--csv", operand(str(output)))
                instead = f"it holds orders in reflection; {command} has those in transmission"
            instead = instead or "wanted it without; scenes and `render --material` have it"
            raise RequestError(f"{key}: got {requested.aside[key]}, which {output} does not hold; {instead}")


def _check_scalar(requested: RequestedSurface, what: str) -> None:
    if requested.theory != "scalar":
        raise RequestError(
            f"{requested.title}: got theory={requested.theory}, and {what} holds scalar theory: wanted theory=scalar, "
            "or a file .csv or .json"
        )


def _write_shader(requested: RequestedSurface, output: Path) -> None:
    title = requested.title
    _check_scalar(requested, "a shader for Cycles")
    requested.say_extent()
    progress = partial(progress_bar, unit="%")
    saved = requested.is_spectrum
    spectrum = requested.spectrum() if saved else shader_recipe(requested.recipe).cached(progress)
    assert isinstance(spectrum, GratingSpectrum)
    media = requested.media
    sheet = media.transmission == "sheet" or (requested.is_film and media.below.transparent)
    tables = ShaderTables.of_spectrum(spectrum, media.below, sheet)
    if (media.transmits or sheet) and not (tables.sheet and output.suffix.lower() == ".npz"):
        say("note", f"{title}: the shader shows the light that it reflects; `render` shows what it transmits")
    _SHADERS[output.suffix.lower()](tables, output)
    if spectrum.warning:
        tell(f"! {spectrum.warning}")
    tell(f"{output}: {spectrum.source}; {tables.held}")


def _write_colours(requested: RequestedSurface, output: Path) -> None:
    title = requested.title
    _check_scalar(requested, "a file of colours")
    own = {name: value for name, value in requested.aside.items() if name not in ("theory", "base")}
    saved = requested.is_spectrum
    shown = in_scene(own if saved else with_plastic(requested.recipe, own, covered=True))
    coat, scale = shown.media.coat_index, max(1.0, shown.height_scale)
    base = None if (stated := requested.aside.get("base")) is None else str(stated)
    check_base(base, shown.media.below)
    requested.say_extent()
    progress = partial(progress_bar, unit="%")
    if saved:
        spectrum = requested.spectrum()
        if (found := VISIBLE[0] / spectrum.wavelengths[0]) < coat * scale * (1 - 1e-6):
            raise RequestError(
                f"{title}: got coat_ior and height_scale of {coat * scale:.4g} in all, wanted at most {found:.4g}, for "
                "which the spectrum was built; wanted its recipe, profile or scan"
            )
    else:
        recipe = requested.recipe
        if recipe.settings.wavelengths == VISIBLE:
            settings = replace(recipe.settings, wavelengths=wavelengths_inside(coat, scale))
            recipe = replace(recipe, settings=settings)
        spectrum = recipe.cached(progress)
    assert isinstance(spectrum, GratingSpectrum)
    viewed = Viewed(spectrum, shown.media.below, coat, shown.height_scale)
    colours = write_colours(viewed, output, shown.orientation, base)
    if spectrum.warning:
        tell(f"! {spectrum.warning}")
    if not colours.error.is_small:
        tell(f"! {title}: the colours of the file are less exact than usual: {colours.error}")
    tell(f"{output}: {spectrum.source}; {output.stat().st_size / 1e6:.1f} MB, {colours.error}")


def _write_orders(requested: RequestedSurface, output: Path, given: dict[str, str]) -> None:
    suffix = output.suffix.lower()
    ranges = _RANGES[suffix] | given
    wavelengths, angles = parse_numbers("--wavelength", ranges["wavelength"]), incidence_of("--angle", ranges["angle"])
    azimuths = parse_numbers("--azimuth", ranges["azimuth"])
    grating = ExportedGrating.of_surface(requested, float(wavelengths.min()) * 1e-3)
    requested.say_extent()
    with named_as_options(_OPTIONS), progress_bar(f"orders of {requested.title}") as progress:
        if suffix == ".csv":
            rows = write_order_table(grating, output, wavelengths, angles, azimuths, progress)
            what = f"{rows:,} rows"
        else:
            write_lswm(grating, output, wavelengths, angles, azimuths, progress)
            sides = "from both sides" if grating.transmits else "from above"
            unit = "wavelength" if len(wavelengths) == 1 else "wavelengths"
            what = f"{len(wavelengths)} {unit} × {len(angles)} × {len(azimuths)} directions of light {sides}"
    warning = scalar_error(grating.height_field, below=grating.below).warning if grating.theory == "scalar" else ""
    if warning:
        tell(f"! {warning}")
    tell(f"{output}: {grating.description}; {what}")
