"""`mitsuba-diffraction benchmark`: speed against error, of this model and of the shader of 2014."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated

import typer

from ...cli.arguments import KEYS_OF_RECIPES, SURFACE, Overwrite, Variant, check_suffix
from ...errors import RequestError
from ...files import outputs
from ...precomputation.requested_surface import RequestedSurface
from ...progress import cells, progress_bar, show, table


def benchmark(
    scan: Annotated[
        str | None, typer.Argument(metavar=f"[{SURFACE}]", help=f"also measure this scan; {KEYS_OF_RECIPES}")
    ] = None,
    surface: Annotated[list[str] | None, typer.Option(help="only these of the built-in surfaces")] = None,
    tolerance: Annotated[list[float] | None, typer.Option(help="only these tolerances")] = None,
    variant: Variant = None,
    terms: Annotated[
        bool, typer.Option("--terms", help="measure the amplitude series by number of terms instead; minutes")
    ] = False,
    pictures: Annotated[
        bool,
        typer.Option("--pictures", help="measure the noise of the package's scenes at equal time instead; minutes"),
    ] = False,
    json: Annotated[Path | None, typer.Option(help="save the results and the processor's name (.json)")] = None,
    plot: Annotated[Path | None, typer.Option(help="plot error against speed (.png)")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure error and speed of the tables, relative to Mitsuba's roughconductor."""
    import mitsuba as mi

    from ...variants import choose_variant
    from ..benchmark.cases import bundled_cases, scan_case
    from ..benchmark.sampling import measure
    from ..benchmark.shader_speed import shader_speeds, speed_table
    from ..benchmark.speed import machine
    from ..benchmark.study import TOLERANCES, benchmark_tables, run_benchmark, save_speed_plot

    if plot is not None:
        check_suffix("--plot", plot, ".png")
    writes = [(option, path) for option, path in (("--json", json), ("--plot", plot)) if path is not None]
    requested = None if scan is None else RequestedSurface.of(scan)
    outputs.check_outputs([] if requested is None else requested.files, writes, overwrite=overwrite)
    if terms and (scan is not None or surface or tolerance):
        raise RequestError("--terms: got other surfaces or tolerances, too; it has tiles of its own")
    if pictures and (scan is not None or surface or tolerance or terms or plot is not None):
        raise RequestError("--pictures: got another option than --variant and --json, too; it has scenes of its own")
    cases = bundled_cases()
    names = [case.name for case in cases]
    if unknown := set(surface or []) - set(names):
        raise RequestError(f"--surface: got {', '.join(sorted(unknown))}, wanted among {', '.join(names)}")
    cases = [case for case in cases if not surface or case.name in surface]
    if requested is not None:
        if "scan" not in requested.recipe.surface:
            raise RequestError(f"{requested.title}: got no scan; --surface takes the built-in surfaces")
        cases.append(scan_case(requested.recipe))
        requested.say_extent()
    mi.set_variant(choose_variant(variant))
    if terms:
        _measure_terms(json, plot)
        return
    if pictures:
        _measure_noise(json)
        return
    with progress_bar("speed and error") as progress:
        results = run_benchmark(cases, tolerances=tolerance or TOLERANCES, progress=progress)
    with progress_bar("shader of 2014") as progress:
        shaders = []
        for number, case in enumerate(tiles := [case for case in cases if case.extent == "tile"], 1):
            shaders += shader_speeds(case)
            progress(number, len(tiles))
    with progress_bar("sampling") as progress:
        # Pictures need no more.
        sampling = measure(cases, max(tolerance or TOLERANCES), progress=progress)
    show(*benchmark_tables(results, sampling), speed_table(shaders), width=140)
    if json is not None:
        found = {"speed and error": results, "real-time shader": shaders, "sampling": sampling}
        outputs.save_json({"machine": machine(), **found}, json)
    if plot is not None:
        save_speed_plot(results, plot)


def _measure_terms(json: Path | None, plot: Path | None) -> None:
    from ..benchmark import terms
    from ..benchmark.cases import TIMED_TILES, tiles
    from ..benchmark.speed import machine
    from ..plots import save_png

    with progress_bar("number of terms") as progress:
        found = terms.measure_terms(tiles(), TIMED_TILES, progress=progress)
    show(*terms.terms_tables(found), width=190)
    if json is not None:
        outputs.save_json({"machine": machine(), **outputs.plain(found)}, json)
    if plot is not None:
        save_png(terms.plot_terms(found), plot)


def _measure_noise(json: Path | None) -> None:
    from ..benchmark.noise import NOISE_COLUMNS, measure_noise
    from ..benchmark.speed import machine

    with progress_bar("noise of pictures") as progress:
        noise = measure_noise(progress=progress)
    show(table(NOISE_COLUMNS, (cells(NOISE_COLUMNS, row) for row in noise)), width=110)
    if json is not None:
        outputs.save_json({"machine": machine(), "noise": noise}, json)
