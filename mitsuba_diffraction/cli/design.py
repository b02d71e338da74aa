"""`mitsuba-diffraction design`: from a picture to the relief that casts it."""

from __future__ import annotations

import functools
import inspect
import math
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from numpy.typing import NDArray

from ..errors import RequestError, is_number
from ..files.outputs import check_outputs, free_name
from ..files.picture_file import read_picture
from ..inverse_design import Design, Verdict, makers
from ..inverse_design import design as search
from ..inverse_design.output import SUFFIXES, save
from ..inverse_design.plate import MIN_STROKES, depth_for_strokes, for_detail, resolved_strokes
from ..inverse_design.search import WHITE
from ..inverse_design.target import finest_strokes
from ..precomputation.surface_text import converted
from ..progress import bytes_text, progress_bar, say, show, table, takes_long, tell, time_text
from .arguments import Overwrite, check_suffix, named_as_options, parse_numbers
from .render import Stopped

_MIN_SAID_MEMORY = 1e9  # bytes
_MIN_TEXELS, _MAX_TEXELS = 32, 96  # along the period by default; more take minutes
_LEGIBLE = 2 / 3  # of the texels of --detail, with which letters can be read
_OPTIONS = {name: f"--{name.replace('_', '-')}" for name in ("detail", "export", *inspect.signature(search).parameters)}
_OPTIONS["wavelengths"] = "--wavelength"


def design(
    target: Annotated[Path, typer.Argument(metavar="TARGET.png", help="the picture to cast, grey or RGB")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="relief (.gsf, .tif); default: ./TARGET_relief.gsf")
    ] = None,
    texel: Annotated[float, typer.Option(help="side of a texel, µm")] = 0.8,
    texels: Annotated[int | None, typer.Option(help="texels along the period; default: 32 to 96, by --detail")] = None,
    detail: Annotated[
        float | None,
        typer.Option(
            help="number of its finest strokes along an edge of the picture, by default as measured in it; sets "
            "--texels, and --angle if need be"
        ),
    ] = None,
    height_range: Annotated[
        float | None,
        typer.Option(help="largest difference of heights, µm; default: 0.8, or more for fine strokes in white light"),
    ] = None,
    angle: Annotated[
        float, typer.Option(help="degrees from the mirror direction to the middle of an edge of the picture")
    ] = 17.5,
    wavelength: Annotated[
        str | None, typer.Option(help="nm: one of a laser, several (450,550) or first:last:step; default: white light")
    ] = None,
    int_ior: Annotated[
        str | None,
        typer.Option(help="index of a sheet that transmits the light: a number, a name such as PMMA, or a file"),
    ] = None,
    seen_on: Annotated[
        str, typer.Option(help="wall (seen from the side of the plate) or screen (translucent, from the other side)")
    ] = "wall",
    invert: Annotated[bool, typer.Option("--invert", help="cast what is dark in the picture")] = False,
    unused: Annotated[
        str,
        typer.Option(help="where light goes that the colours cannot use: outside (of the frame), or mirror (order 0)"),
    ] = "outside",
    levels: Annotated[int | None, typer.Option(help="number of equidistant heights; default: continuous")] = None,
    tool_blur: Annotated[float, typer.Option(help="standard deviation of the tool's blur, µm")] = 0.13,
    export: Annotated[
        list[str] | None, typer.Option(help="also write: stl, gds (of --levels) or master (of a mould); repeatable")
    ] = None,
    starts: Annotated[
        int | None,
        typer.Option(help="random reliefs, of which the best is continued; default: 24, fewer of many texels"),
    ] = None,
    seed: Annotated[int, typer.Option(help="of the random reliefs")] = 0,
    overwrite: Overwrite = False,
) -> None:
    """Compute the relief that casts a picture in white light, or in that of a laser."""
    default = free_name(f"{target.stem}_relief", lambda stem: [Path(stem + suffix) for suffix in SUFFIXES], [target])
    path = output or Path(f"{default}.gsf")
    check_suffix("-o", path, ".gsf", ".tif")
    picture = read_picture(target, invert=invert)
    with named_as_options(_OPTIONS):
        exports = makers.export_paths(export or [], path)
        if "gds" in exports:
            makers.check_gds(levels)
    outputs = [path.with_suffix(suffix) for suffix in SUFFIXES]
    outputs += exports.values()
    named = [("-o" if output == path else f"-o {path}", output) for output in outputs]
    check_outputs([target], named, overwrite=overwrite)
    if picture.max() == 0:
        help_ = "" if invert else "; --invert casts what is dark"
        raise RequestError(f"{target}: got {'white' if invert else 'black'} alone, wanted light somewhere{help_}")
    if not invert and _is_dark_on_light(picture):
        say("note", f"{target} is light up to its edges; --invert casts what is dark in it, with more contrast")
    wavelengths = None if wavelength is None else parse_numbers("--wavelength", wavelength).tolist()
    # Before the number of texels is computed from them.
    for option, value in (("--texel", texel), ("--angle", angle), ("--wavelength", np.min(wavelengths or WHITE))):
        if not (is_number(value) and value > 0):
            raise RequestError(f"{option}: got {value:g}, wanted a positive number")
    options = _OPTIONS | {"target": str(target)}
    strokes, longest, note = finest_strokes(picture), max(wavelengths or WHITE), ""
    index = None if int_ior is None else converted(int_ior)
    if height_range is None:
        with named_as_options(options):
            height_range = depth_for_strokes(strokes if detail is None else detail, wavelengths or WHITE, index)
    if detail is not None:
        if texels is not None:
            raise RequestError(f"--detail: got {detail:g} and --texels {texels}, wanted one of them")
        with named_as_options(options):
            texels, angle = for_detail(detail, texel, angle, longest)
        note = (
            f"{texels} texels along the period, {height_range:g} µm deep, angle {angle:g}°, for strokes of "
            f"1/{detail:g} of the picture"
        )
    elif texels is None:
        fitting = math.ceil(max(_LEGIBLE * strokes, MIN_STROKES) / resolved_strokes(1, texel, angle, longest))
        texels = min(max(fitting, _MIN_TEXELS), _MAX_TEXELS)
        finest = f"the finest strokes are 1/{strokes:.0f} of the picture"
        note = f"{texels} texels along the period, {height_range:g} µm deep; {finest}"
    bar = progress_bar(f"design of {target.name}", "iterations")
    with named_as_options(options), bar as progress:
        found = search(
            picture,
            texel,
            texels,
            height_range,
            angle,
            wavelengths,
            index,
            levels,
            seen_on=seen_on,
            unused=unused,
            tool_blur=tool_blur,
            starts=starts if starts is not None else max(4, round(24 * (_MIN_TEXELS / max(texels, _MIN_TEXELS)) ** 2)),
            seed=seed,
            progress=progress,
            expect=functools.partial(_say_effort, note),
        )
    paths = save(found, path)
    makers.export(found, exports)
    _report(found)
    relief, tiff, recipe, figure = paths
    field = found.height_field
    tell(
        f"{relief}: one period, {field.tile_size[0]:.4g} × {field.tile_size[1]:.4g} µm\n{tiff}: the same, pixels of "
        f"{field.pixel_size[0] * 1e3:.4g} nm, {height_range:g} µm from black to white; its top row is at the lowest "
        f"y\n{recipe}: its recipe, for scenes\n{figure}: target, prediction and relief"
    )
    for name, file in exports.items():
        tell(f"{file}: {makers.EXPORTS[name][1]}")
    verdict = Verdict.of(found, strokes, inverted=invert, names=_OPTIONS | {"negative": "--invert"})
    for warning in filter(None, [found.warning, "" if verdict.grade == "good" else str(verdict)]):
        tell(f"! {warning}")
    if verdict.grade == "good":
        tell(str(verdict))
    if found.interrupted:
        raise Stopped(f"{relief} holds the best relief so far")


def _say_effort(chosen: str, seconds: float, memory: float) -> None:
    if chosen:
        say("note", chosen)
    if takes_long(seconds) or memory > _MIN_SAID_MEMORY:
        effort = f"about {time_text(seconds)} and {bytes_text(memory)} of memory"
        say("note", f"{effort}; Ctrl-C ends the search and keeps the best relief so far")


def _is_dark_on_light(picture: NDArray[np.float64]) -> bool:
    """Return whether most of the edge of a picture is bright, as on a sheet of paper."""
    grey = picture if picture.ndim == 2 else picture.mean(axis=-1)
    edge = np.concatenate([grey[0], grey[-1], grey[:, 0], grey[:, -1]])
    return bool(np.median(edge) > grey.max() / 2)


def _report(found: Design) -> None:
    columns = ["wavelength", "in the picture", "correlation", "unevenness", "mirror direction", *found.changed]
    light, *changed = (found.in_picture(efficiency) for efficiency in (found.efficiency, *found.changed.values()))
    measures = (found.wavelengths, light, found.correlation, found.unevenness, found.mirror)
    rows = [
        [f"{wavelength:.0f} nm", f"{light:.1%}", f"{correlation:.3f}", f"{unevenness:.2f}", *(f"{x:.1%}" for x in rest)]
        for wavelength, light, correlation, unevenness, *rest in zip(*measures, *changed, strict=True)
    ]
    show(table(columns, rows), width=130)
    if not np.isnan(found.colour_difference):
        tell(f"ΔE00 of target and prediction: {found.colour_difference:.1f}, a mean over the frame")
