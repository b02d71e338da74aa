"""`mitsuba-diffraction convergence`: the error of a picture against its time."""

from __future__ import annotations

import math
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from ...cli.arguments import Define, Overwrite, Variant, check_suffix, parse_numbers, scene_parameters
from ...errors import RequestError
from ...files import outputs
from ...progress import cells, progress_bar, show, table, tell
from ...settings import ORIGINS

if TYPE_CHECKING:
    from ..convergence.by_terms import SeriesStudy


def convergence(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.xml")],
    plot: Annotated[Path, typer.Option("-o", "--output", help="plot of error against time (.png)")],
    tolerance: Annotated[
        list[str] | None, typer.Option(help="of the spectra, one or several: 0.1,0.01; default: 0.1,0.01,0.001")
    ] = None,
    terms: Annotated[
        str | None, typer.Option(help="compare numbers of terms of a series, 4,6,8, with slices instead")
    ] = None,
    spp: Annotated[
        list[int] | None, typer.Option(min=1, help="samples per pixel; default: 1, 4, … 256; with --terms: 16")
    ] = None,
    reference_spp: Annotated[
        int | None, typer.Option(min=2, help="samples per pixel of the reference; default: 2048")
    ] = None,
    width: Annotated[int, typer.Option(min=1, help="pixels")] = 128,
    variant: Variant = None,
    json: Annotated[Path | None, typer.Option(help="save the numbers (.json)")] = None,
    define: Define = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure the error of a picture against time, for the path tracer and the real-time shaders.

    The scene needs a parameter `tolerance` of its gratings; with --terms, `representation`, `terms` and `heights_from`.
    """
    import mitsuba as mi

    from ...render.scene_file import SceneFile
    from ...variants import choose_variant
    from ..convergence import by_terms as series
    from ..convergence import by_tolerance as study

    parameters = scene_parameters(define)
    if terms is None:
        given = [value for text in tolerance or [] for value in parse_numbers("--tolerance", text).tolist()]
        tolerances = sorted(given or study.PICTURE_TOLERANCES, reverse=True)
        study.check_tolerances(tolerances)
        own = {"tolerance": f"{tolerances[0]:g}"}
    elif tolerance or reference_spp or len(spp or []) > 1:
        raise RequestError("--terms: got --tolerance, --reference-spp or several --spp, too; wanted at most one --spp")
    else:
        counts = [int(count) if count.is_integer() else count for count in parse_numbers("--terms", terms).tolist()]
        own = {"representation": "auto", "terms": "auto", "heights_from": ORIGINS[0]}
    check_suffix("-o", plot, ".png")
    written = [("-o", plot), *([("--json", json)] if json is not None else [])]
    outputs.check_outputs(SceneFile(scene, {**parameters, **own}).files(), written, overwrite=overwrite)
    mi.set_variant(choose_variant(variant))
    if terms is not None:
        origin = parameters.get("heights_from")
        found_series = series.study(
            scene,
            terms=counts,
            origins=ORIGINS if origin is None else (origin,),
            samples=spp[0] if spp else series.SERIES_SAMPLES,
            width=width,
            parameters=parameters,
            progress=progress_bar,
        )
        _report_series(found_series, plot, json)
        return
    found = study.convergence(
        scene,
        tolerances=tolerances,
        samples=sorted(spp or study.SAMPLE_COUNTS),
        reference_samples=reference_spp or 2048,
        width=width,
        parameters=parameters,
        progress=progress_bar,
    )
    study.save_convergence_plot(found, plot)
    if json is not None:
        outputs.save_json(found, json)
    show(table(study.POINT_COLUMNS, (cells(study.POINT_COLUMNS, point) for point in found.points)), width=100)
    for name, curve in found.curves().items():
        if not curve[0].traced:
            times = [found.overtaken(name, error) for error in ("delta_e", "relative_mse")]
            when = ["not overtaken" if math.isnan(time) else f"overtaken after {time:.2g} s" for time in times]
            tell(f"{name}: {when[0]} (ΔE00), {when[1]} (relative MSE)")
    if found.noise is not None:
        tell(f"the reference owes ΔE00 {found.noise:.2f} to noise")


def _report_series(found: SeriesStudy, plot: Path, json: Path | None) -> None:
    from ..convergence import by_terms as series
    from ..plots import save_png

    save_png(series.plot_series(found), plot)
    if json is not None:
        outputs.save_json({"scene": found.scene, "samples": found.samples, "rows": found.rows}, json)
    show(table(series.SERIES_COLUMNS, (cells(series.SERIES_COLUMNS, row) for row in found.rows), texts=2), width=120)
