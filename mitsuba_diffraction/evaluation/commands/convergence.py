"""`mitsuba-diffraction convergence`: the error of a picture against its time."""

from __future__ import annotations

import math
from pathlib import Path
from typing import Annotated

import typer

from ... import outputs
from ...cli.arguments import Define, Overwrite, Variant, check_suffix, scene_parameters
from ...progress import progress_bar, show, table, tell


def convergence(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.xml")],
    plot: Annotated[Path, typer.Option("-o", "--output", help="plot of error against time (.png)")],
    tolerance: Annotated[list[float] | None, typer.Option(help="of the spectra; default: 0.1, 0.01 and 0.001")] = None,
    spp: Annotated[list[int] | None, typer.Option(min=1, help="samples per pixel; default: 1, 4, … 256")] = None,
    reference_spp: Annotated[int, typer.Option(min=2, help="samples per pixel of the reference")] = 2048,
    width: Annotated[int, typer.Option(min=1, help="pixels")] = 128,
    variant: Variant = None,
    json: Annotated[Path | None, typer.Option(help="save the numbers (.json)")] = None,
    define: Define = None,
    overwrite: Overwrite = False,
) -> None:
    """Measure the error of a picture against time, for the path tracer and the real-time shaders.

    The scene needs a parameter `tolerance` of its gratings.
    """
    import mitsuba as mi

    from ...llvm import choose_variant
    from ...render.scene import files_of_scene
    from ..comparison import convergence as study
    from ..report import cells

    parameters, tolerances = scene_parameters(define), sorted(tolerance or study.TOLERANCES, reverse=True)
    check_suffix("-o", plot, ".png")
    written = [("-o", plot), *([("--json", json)] if json is not None else [])]
    study.check_tolerances(tolerances)
    reads = files_of_scene(scene, {**parameters, "tolerance": f"{tolerances[0]:g}"})
    outputs.check_outputs(reads, written, overwrite=overwrite)
    mi.set_variant(choose_variant(variant))
    found = study.convergence(
        scene,
        tolerances=tolerances,
        samples=sorted(spp or study.SAMPLES),
        reference_samples=reference_spp,
        width=width,
        parameters=parameters,
        progress=progress_bar,
    )
    study.save_plot(found, plot)
    if json is not None:
        outputs.save_json(found, json)
    show(table(study.COLUMNS, (cells(study.COLUMNS, point) for point in found.points)), width=100)
    for name, curve in found.curves().items():
        if not curve[0].traced:
            times = [found.overtaken(name, error) for error in ("delta_e", "relative_mse")]
            when = ["not overtaken" if math.isnan(time) else f"overtaken after {time:.2g} s" for time in times]
            tell(f"{name}: {when[0]} (ΔE00), {when[1]} (relative MSE)")
    tell(f"the reference owes ΔE00 {found.noise:.2f} to noise")
