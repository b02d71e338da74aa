"""`mitsuba-diffraction design`: from a picture to the relief that casts it."""

from __future__ import annotations

import functools
import inspect
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
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
from .arguments import Overwrite, as_command, check_suffix, named_as_options, parse_numbers
from .render import Stopped

_MIN_SAID_MEMORY = 1e9  # bytes
_MIN_TEXELS, _MAX_TEXELS = 32, 96  # along the period by default; more take minutes
_LEGIBLE = 2 / 3  # of the texels of --detail, with which letters can be read
_OPTIONS = {name: f"--{name.replace('_', '-')}" for name in ("detail", "export", *inspect.signature(search).parameters)}
_OPTIONS["wavelengths"] = "--wavelength"


@dataclass(frozen=True)
class DesignRequest:
    """What `design` was asked for: its arguments and options."""

    target: Annotated[Path, typer.Argument(metavar="TARGET.png", help="the picture to cast, grey or RGB")]
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="relief (.gsf, .tif); default: ./TARGET_relief.gsf")
    ] = None
    texel: Annotated[float, typer.Option(help="side of a texel, µm")] = 0.8
    texels: Annotated[int | None, typer.Option(help="texels along the period; default: 32 to 96, by --detail")] = None
    detail: Annotated[
        float | None,
        typer.Option(
            help="number of its finest strokes along an edge of the picture, by default as measured in it; sets "
            "--texels, and --angle if need be"
        ),
    ] = None
    height_range: Annotated[
        float | None,
        typer.Option(help="largest difference of heights, µm; default: 0.8, or more for fine strokes in white light"),
    ] = None
    angle: Annotated[
        float, typer.Option(help="degrees from the mirror direction to the middle of an edge of the picture")
    ] = 17.5
    wavelength: Annotated[
        str | None, typer.Option(help="nm: one of a laser, several (450,550) or first:last:step; default: white light")
    ] = None
    int_ior: Annotated[
        str | None,
        typer.Option(help="index of a sheet that transmits the light: a number, a name such as PMMA, or a file"),
    ] = None
    seen_on: Annotated[
        str, typer.Option(help="wall (seen from the side of the plate) or screen (translucent, from the other side)")
    ] = "wall"
    invert: Annotated[bool, typer.Option("--invert", help="cast what is dark in the picture")] = False
    unused: Annotated[
        str,
        typer.Option(help="where light goes that the colours cannot use: outside (of the frame), or mirror (order 0)"),
    ] = "outside"
    levels: Annotated[int | None, typer.Option(help="number of equidistant heights; default: continuous")] = None
    tool_blur: Annotated[float, typer.Option(help="standard deviation of the tool's blur, µm")] = 0.13
    export: Annotated[
        list[str] | None, typer.Option(help="also write: stl, gds (of --levels) or master (of a mould); repeatable")
    ] = None
    starts: Annotated[
        int | None,
        typer.Option(help="random reliefs, of which the best is continued; default: 24, fewer of many texels"),
    ] = None
    seed: Annotated[int, typer.Option(help="of the random reliefs")] = 0
    overwrite: Overwrite = False

    def outputs(self) -> tuple[Path, dict[str, Path]]:
        """Return the paths of the relief and of the exports, which may be written.

        Raises:
            RequestError: if one of them may not.
        """
        stem = f"{self.target.stem}_relief"
        default = free_name(stem, lambda stem: [Path(stem + suffix) for suffix in SUFFIXES], [self.target])
        path = self.output or Path(f"{default}.gsf")
        check_suffix("-o", path, ".gsf", ".tif")
        with named_as_options(_OPTIONS):
            exports = makers.export_paths(self.export or [], path)
            if "gds" in exports:
                makers.check_gds(self.levels)
        outputs = [*(path.with_suffix(suffix) for suffix in SUFFIXES), *exports.values()]
        named = [("-o" if output == path else f"-o {path}", output) for output in outputs]
        check_outputs([self.target], named, overwrite=self.overwrite)
        return path, exports

    def check_light(self, picture: NDArray[np.float64]) -> None:
        """Refuse a picture without light, and name `--invert` where it is dark on light."""
        if picture.max() == 0:
            help_ = "" if self.invert else "; --invert casts what is dark"
            colour = "white" if self.invert else "black"
            raise RequestError(f"{self.target}: got {colour} alone, wanted light somewhere{help_}")
        if not self.invert and _is_dark_on_light(picture):
            say(
                "note", f"{self.target} is light up to its edges; --invert casts what is dark in it, with more contrast"
            )

    def wavelengths(self) -> list[float] | None:
        """Return the wavelengths in nm, None for white light; check the numbers from which texels are computed."""
        wavelengths = None if self.wavelength is None else parse_numbers("--wavelength", self.wavelength).tolist()
        shortest = np.min(wavelengths or WHITE)
        for option, value in (("--texel", self.texel), ("--angle", self.angle), ("--wavelength", shortest)):
            if not (is_number(value) and value > 0):
                raise RequestError(f"{option}: got {value:g}, wanted a positive number")
        return wavelengths

    def size(self, strokes: float, wavelengths: list[float] | None, index: float | str | None) -> _Size:
        """Return the size of the plate for a picture of `strokes` along an edge, as far as it is not requested."""
        light, depth, angle = wavelengths or WHITE, self.height_range, self.angle
        if depth is None:
            depth = depth_for_strokes(strokes if self.detail is None else self.detail, light, index)
        if self.detail is not None:
            if self.texels is not None:
                raise RequestError(f"--detail: got {self.detail:g} and --texels {self.texels}, wanted one of them")
            texels, angle = for_detail(self.detail, self.texel, angle, max(light))
            why = f", angle {angle:g}°, for strokes of 1/{self.detail:g} of the picture"
        elif self.texels is None:
            per_texel = resolved_strokes(1, self.texel, angle, max(light))
            fitting = math.ceil(max(_LEGIBLE * strokes, MIN_STROKES) / per_texel)
            texels = min(max(fitting, _MIN_TEXELS), _MAX_TEXELS)
            why = f"; the finest strokes are 1/{strokes:.0f} of the picture"
        else:
            return _Size(self.texels, depth, angle, "")
        return _Size(texels, depth, angle, f"{texels} texels along the period, {depth:g} µm deep{why}")


@dataclass(frozen=True)
class _Size:
    """Texels along the period, the height range in µm, the angle in degrees, and a note on what sets them."""

    texels: int
    height_range: float
    angle: float
    note: str


@as_command(DesignRequest)
def design(request: DesignRequest) -> None:
    """Compute the relief that casts a picture in white light, or in that of a laser."""
    picture = read_picture(request.target, invert=request.invert)
    path, exports = request.outputs()
    request.check_light(picture)
    wavelengths, strokes = request.wavelengths(), finest_strokes(picture)
    index = None if request.int_ior is None else converted(request.int_ior)
    bar = progress_bar(f"design of {request.target.name}", "iterations")
    with named_as_options(_OPTIONS | {"target": str(request.target)}):
        size = request.size(strokes, wavelengths, index)
        fewer = (_MIN_TEXELS / max(size.texels, _MIN_TEXELS)) ** 2
        with bar as progress:
            found = search(
                picture,
                request.texel,
                size.texels,
                size.height_range,
                size.angle,
                wavelengths,
                index,
                request.levels,
                seen_on=request.seen_on,
                unused=request.unused,
                tool_blur=request.tool_blur,
                starts=request.starts if request.starts is not None else max(4, round(24 * fewer)),
                seed=request.seed,
                progress=progress,
                expect=functools.partial(_say_effort, size.note),
            )
    paths = save(found, path)
    makers.export(found, exports)
    _report(found)
    _report_files(found, paths, exports)
    _report_verdict(found, strokes, request.invert)
    if found.interrupted:
        raise Stopped(f"{paths[0]} holds the best relief so far")


def _report_files(found: Design, paths: Sequence[Path], exports: Mapping[str, Path]) -> None:
    relief, tiff, recipe, figure = paths
    field = found.height_field
    tell(
        f"{relief}: one period, {field.tile_size[0]:.4g} × {field.tile_size[1]:.4g} µm\n{tiff}: the same, pixels of "
        f"{field.pixel_size[0] * 1e3:.4g} nm, {found.plate.height_range:g} µm from black to white; its top row is at "
        f"the lowest y\n{recipe}: its recipe, for scenes\n{figure}: target, prediction and relief"
    )
    for name, file in exports.items():
        tell(f"{file}: {makers.EXPORTS[name][1]}")


def _report_verdict(found: Design, strokes: float, inverted: bool) -> None:
    verdict = Verdict.of(found, strokes, inverted=inverted, names=_OPTIONS | {"negative": "--invert"})
    for warning in filter(None, [found.warning, "" if verdict.grade == "good" else str(verdict)]):
        tell(f"! {warning}")
    if verdict.grade == "good":
        tell(str(verdict))


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
