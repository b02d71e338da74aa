"""`mitsuba-diffraction benchmark`: speed against error."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console

from ..errors import RequestError
from ..surface.readers import read_height_field
from .arguments import Overwrite, claim
from .console import out, progress_bar
from .inputs import files_read


def benchmark(
    context: typer.Context,
    scan: Annotated[Path | None, typer.Argument(metavar="[SCAN]", help="a scan to measure with")] = None,
    pixel_size: Annotated[float | None, typer.Option(help="of the scan, µm")] = None,
    height_range: Annotated[float | None, typer.Option(help="of the scan, black to white, µm")] = None,
    surface: Annotated[list[str] | None, typer.Option(help="only these of the bundled ones")] = None,
    tolerance: Annotated[list[float] | None, typer.Option(help="only these")] = None,
    variant: Annotated[str | None, typer.Option(help="of Mitsuba; the fastest spectral one by default")] = None,
    json: Annotated[Path | None, typer.Option(help="write the results here, too")] = None,
    plot: Annotated[Path | None, typer.Option(help="draw error against speed here (.png)")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Speed against error of every representation, as ratios to Mitsuba's roughconductor."""
    import mitsuba as mi

    from ..studies.benchmark import run, save_json, save_plot, tables
    from ..studies.cases import bundled_cases, scan_case
    from ..studies.sampling import measure
    from ..variants import choose_variant

    writes = [(option, path) for option, path in (("--json", json), ("--plot", plot)) if path is not None]
    claim(context, [] if scan is None else files_read(scan), writes)
    cases = bundled_cases()
    names = [case.name for case in cases]
    if unknown := set(surface or []) - set(names):
        raise RequestError(f"--surface: got {', '.join(sorted(unknown))}, wanted among {', '.join(names)}")
    cases = [case for case in cases if not surface or case.name in surface]
    if scan is not None:
        cases.append(scan_case(read_height_field(scan, pixel_size=pixel_size, height_range=height_range)))
    mi.set_variant(choose_variant(variant))
    with progress_bar("speed and error") as progress:
        results, shaders = run(cases, **({"tolerances": tolerance} if tolerance else {}), progress=progress)
    with progress_bar("sampling") as progress:
        sampling = measure(cases, progress=progress)
    # Wide enough wherever it goes, a file too.
    wide = Console(highlight=False, width=max(out.width, 140))
    wide.print(*tables(results, shaders, sampling), sep="\n\n")
    if json is not None:
        save_json(results, shaders, sampling, json)
    if plot is not None:
        save_plot(results, plot)
