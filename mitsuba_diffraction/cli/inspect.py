"""`mitsuba-diffraction inspect`: statistics, predicted colours and reliability of a surface."""

from __future__ import annotations

import math
from collections.abc import Sequence
from pathlib import Path
from typing import Annotated

import numpy as np
import typer
from rich.table import Table
from rich.text import Text

from ..errors import RequestError
from ..files.outputs import check_outputs, free_name, plain, save_json
from ..inspection import Inspection, save_picture
from ..inspection import inspect as look
from ..inspection.predicted_colours import GREEN, Colour, colours_at
from ..precomputation.requested_surface import RequestedSurface
from ..progress import progress_bar, show, table, tell
from ..settings import SUN_COHERENCE_LENGTH, lobe_width
from .arguments import KEYS_OF_RECIPES, SURFACE, Overwrite, angles_of, check_suffix


def inspect(
    surface: Annotated[
        str, typer.Argument(metavar=SURFACE, help=f"a scan, a recipe (.toml), or a profile; {KEYS_OF_RECIPES}")
    ],
    output: Annotated[
        Path | None,
        typer.Option("-o", "--output", help="figure (.png, .pdf, .svg); default: ./NAME_inspect.png"),
    ] = None,
    angle: Annotated[
        str, typer.Option(help="angle of incidence for --view, degrees: a number, several (0,30), or first:last:step")
    ] = "0",
    view: Annotated[
        str | None,
        typer.Option(help="print the colours at these angles, degrees, positive on the side opposite to the light"),
    ] = None,
    json: Annotated[Path | None, typer.Option(help="save the numbers (.json)")] = None,
    pixel_size: Annotated[float | None, typer.Option(help="of a scan, µm; the same as pixel_size=… of SURFACE")] = None,
    height_range: Annotated[
        float | None, typer.Option(help="from black to white of a picture, µm; the same as height_range=…")
    ] = None,
    overwrite: Overwrite = False,
) -> None:
    """Report and plot the statistics, periods and predicted colours of a surface, and how reliable they are."""
    angles, views = angles_of("--angle", angle), np.zeros(0) if view is None else angles_of("--view", view)
    if view is None and angle != "0":
        raise RequestError(f"--angle: got {angle} without --view, wanted the angles of the viewer, too")
    requested = RequestedSurface.of(surface, options={"pixel_size": pixel_size, "height_range": height_range})
    source, reads = requested.path, requested.files
    default_name = free_name(f"{source.stem}_inspect", lambda stem: [Path(f"{stem}.png")], reads)
    picture = output or Path(f"{default_name}.png")
    check_suffix("-o", picture, ".png", ".pdf", ".svg")
    check_outputs(reads, [("-o", picture), *([("--json", json)] if json else [])], overwrite=overwrite)
    recipe = requested.recipe
    height_field = recipe.height_field()
    if height_field.heights.size == 1:
        raise RequestError(f"{source}: got a surface of 1 × 1 pixel, wanted more: one height has no spectrum")
    requested.say_extent()
    with progress_bar(f"inspection of {source.name}", "%") as progress:
        inspection = look(
            height_field,
            extent=recipe.settings.extent,
            coherence_length=recipe.settings.coherence_length,
            measured="scan" in recipe.surface,
            progress=progress,
        )
    colours = colours_at(inspection.spectrum, inspection.direction, angles, views)
    save_picture(inspection, picture, title=source.stem if requested.kind == "recipe" else source.name)
    if json is not None:
        save_json({**inspection.as_json(), **({"colours": plain(colours)} if colours else {})}, json)
    tables = [_table(inspection)]
    tables += [_changes_table(inspection)] if inspection.changes else []
    tables += [_colours_table(colours)] if colours else []
    show(*tables, width=130)
    if len(tables) > 1:
        tell("")
    for concern in inspection.concerns:
        tell(f"! {concern}")
    tell(f"{picture}: height map, spectrum and predicted colours" + (f"\n{json}: the numbers" if json else ""))


def _table(inspection: Inspection) -> Table:
    rows = Table(box=None, show_header=False, pad_edge=False)
    rows.add_column(style="bold", no_wrap=True)
    rows.add_column()
    for name, value in [*_surface_lines(inspection), *_diffraction_lines(inspection)]:
        rows.add_row(name, Text(value))  # Text: file names are not markup
    return rows


def _surface_lines(inspection: Inspection) -> list[tuple[str, str]]:
    field, numbers = inspection.height_field, inspection.statistics
    rows, columns = field.shape
    kind = "periodic tile" if inspection.extent == "tile" else "sample of a larger surface"
    levels = f"{numbers.levels} different heights"
    if 1 < numbers.levels <= 256:
        levels += f", {numbers.step * 1e3:.3g} nm apart"
    return [
        ("surface", f"{field.source} ({kind})"),
        ("size", f"{field.tile_size[0]:.4g} × {field.tile_size[1]:.4g} µm, {columns} × {rows} pixels"),
        ("pixel size", f"{field.pixel_size[0] * 1e3:.4g} × {field.pixel_size[1] * 1e3:.4g} nm"),
        ("missing", f"{field.filled} pixels, filled" if field.filled else "none"),
        ("heights", f"{_nm(field.height_range)} from lowest to highest; {levels}"),
        *(
            [("tilt", f"{round(numbers.tilt, 3):g}°, {round(numbers.tilt_height * 1e3, 1):g} nm from corner to corner")]
            if inspection.extent == "sample"
            else []
        ),
        ("roughness", f"Sa {_nm(numbers.Sa)}, Sq {_nm(numbers.Sq)}, Sz {_nm(numbers.Sz)}"),
        ("slopes", f"Sdq {numbers.Sdq:.3g} (r.m.s.); 1 % of the sloping pixels above {numbers.steepest:.3g}°"),
    ]


def _diffraction_lines(inspection: Inspection) -> list[tuple[str, str]]:
    lines = []
    for number, period in enumerate(inspection.periods):
        name = "period" if number == 0 else "another period"
        lines.append((name, f"{period}; {period.strength:.1%} of the variance"))
    if not inspection.periods:
        hint = " (for a single period of a grating: extent=tile)" if inspection.extent == "sample" else ""
        lines.append(("period", f"none stands out{hint}"))
    else:
        lines.append(("550 nm goes to", _angles_of_green(inspection.periods[0].period)))
    lobe = math.degrees(GREEN * lobe_width(inspection.coherence_length))
    length = f"{inspection.coherence_length:.3g} µm"
    if inspection.extent == "sample":
        length += f" (largest for this scan: {inspection.max_coherence_length:.3g}; sunlight: {SUN_COHERENCE_LENGTH:g})"
    lines.append(("coherence length", f"{length}: at 550 nm an order is ±{lobe:.2g}° wide (1 σ)"))
    if inspection.standard_error is not None:
        error = f"{inspection.standard_error:.2g} of the reflected power, estimated from the scatter within this scan"
        lines.append(("standard error", error))
    lines.append(("scalar theory", str(inspection.scalar_error)))
    if inspection.piece is not inspection.height_field:
        x, y = inspection.piece.tile_size
        length = f"{inspection.spectrum.coherence_length:.3g} µm"
        lines.append(("colours", f"of the middle {x:.3g} × {y:.3g} µm, at a coherence length of {length}"))
    return lines


def _angles_of_green(period: float) -> str:
    """Return where the first orders of 550 nm leave, of a period in µm: −sin θ_i + m λ/T = sin θ_m."""
    sines = [order * GREEN / period for order in range(1, 4)]
    angles = [f"{math.degrees(math.asin(sine)):.1f}°" for sine in sines if sine < 1]
    if angles:
        return f"{', '.join(angles)} (orders 1, 2, … at normal incidence)"
    if sines[0] >= 2:
        return "no angle: the period is shorter than half the wavelength"
    first = math.degrees(math.asin(sines[0] - 1))
    return f"no angle at normal incidence; order 1 back towards the light, from {first:.0f}° incidence on"


def _changes_table(inspection: Inspection) -> Table:
    before = inspection.changes[0].before
    columns = ["5 % more or less of", "period"]
    for order, fraction in before.items():
        columns += [f"power in orders\n±{order}, {fraction:.3g}", "their colour"]
    rows = []
    for change in inspection.changes:
        name = f"{change.what} {change.by:+.0%}"
        if np.isfinite(change.tip_radius):
            kind = "blunter" if change.tip_radius > 0 else "sharper"
            name += f" (tip {kind} by {abs(change.tip_radius) * 1e3:.0f} nm)"
        row = [name, f"{change.period:+.1%}"]
        for order, fraction in before.items():
            row += [
                f"{change.after[order] / fraction - 1:+.1%}" if fraction > 0 else "",
                f"ΔE00 {change.colour[order]:.1f}",
            ]
        rows.append(row)
    return table(columns, rows)


def _colours_table(colours: Sequence[Colour]) -> Table:
    columns = ["incidence", "view", "X", "Y", "Z", "sRGB"]
    rows = [[f"{c.angle:g}°", f"{c.view:g}°", *(f"{value:.4g}" for value in c.XYZ), c.sRGB] for c in colours]
    return table(columns, rows)


def _nm(length: float) -> str:
    return f"{length * 1e3:.3g} nm" if length < 1 else f"{length:.4g} µm"
