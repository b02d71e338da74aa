"""The commands, thin: they read arguments, call the package, and say what came of it.

Exit codes: 0 done; 1 the work failed or was interrupted; 2 the request was wrong.
"""

from __future__ import annotations

import sys
import time
import warnings
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Annotated

import typer
from rich.console import Console
from rich.progress import BarColumn, MofNCompleteColumn, Progress, TextColumn, TimeElapsedColumn, TimeRemainingColumn

from .coherence import SUN_COHERENCE_LENGTH
from .precompute import REPRESENTATIONS, precompute
from .readers import read_height_field
from .recipe import Recipe
from .spectrum import GratingSpectrum

NAME = "mitsuba-diffraction"
# Click's, or that of the copy of Click which newer versions of Typer carry.
_UsageError = typer.BadParameter.__base__

app = typer.Typer(add_completion=False, no_args_is_help=False, help="Diffraction gratings for Mitsuba 3.")
_out = Console(highlight=False, soft_wrap=True)
_err = Console(stderr=True, highlight=False, soft_wrap=True)


@app.callback()
def _commands() -> None:
    """Diffraction gratings for Mitsuba 3."""


@app.command("precompute")
def _precompute(
    sources: Annotated[list[Path], typer.Argument(metavar="RECIPE|SCAN...", help="recipes (.toml), or scans")],
    output: Annotated[
        Path | None, typer.Option("-o", "--output", help="the spectrum (.exr); beside you by default")
    ] = None,
    pixel_size: Annotated[float | None, typer.Option(help="of a scan, µm")] = None,
    height_range: Annotated[float | None, typer.Option(help="of a scan, black to white, µm")] = None,
    fill_missing: Annotated[
        bool, typer.Option("--fill-missing", help="of a scan, fill pixels without a height from their surroundings")
    ] = False,
    representation: Annotated[str | None, typer.Option(help=", ".join(REPRESENTATIONS))] = None,
    tolerance: Annotated[float | None, typer.Option(help="error allowed, as a share of the reflected power")] = None,
    extent: Annotated[
        str | None, typer.Option(help="tile (the patch repeats) or sample (a piece of an irregular surface)")
    ] = None,
    largest_angle: Annotated[float | None, typer.Option(help="that the scene has, degrees from the normal")] = None,
    coherence_length: Annotated[
        float | None, typer.Option(help=f"µm; {SUN_COHERENCE_LENGTH:g} is that of sunlight")
    ] = None,
) -> None:
    """Turn a recipe or a scan into the spectrum of its phase."""
    if output is not None and len(sources) > 1:
        raise ValueError(f"-o: got {len(sources)} sources, wanted one (without -o each is named after its source)")
    given = {
        "extent": extent,
        "coherence_length": coherence_length,
        "largest_angle": largest_angle,
        "representation": representation,
        "tolerance": tolerance,
    }
    settings = {name: value for name, value in given.items() if value is not None}
    for source in sources:
        target = output or Path(source.with_suffix(".exr").name)
        if target.suffix.lower() != ".exr":
            raise ValueError(f"-o: got {target}, wanted a file name that ends in .exr")
        with _progress(f"spectrum of {source.name}") as progress:
            spectrum = _spectrum(source, pixel_size, height_range, fill_missing, settings, progress)
            spectrum.save(target)
        _tell(
            f"{target}: {spectrum.source}; {spectrum.extent}, {spectrum.grid}; coherence length "
            f"{spectrum.coherence_length:.4g} µm; {spectrum.representation}, {spectrum.megabytes:.3g} MB, "
            f"error {spectrum.error:.1e} (asked {spectrum.tolerance:g})\n"
            f"left out, at most: {spectrum.dropped:.1e} of the power in weak frequencies; {spectrum.beyond:.1e} where "
            "no light reaches or no pixel resolves"
        )


def _spectrum(
    source: Path,
    pixel_size: float | None,
    height_range: float | None,
    fill_missing: bool,
    settings: dict[str, object],
    progress: Callable[[int, int], None],
) -> GratingSpectrum:
    if source.suffix.lower() == ".toml":
        if pixel_size is not None or height_range is not None or fill_missing:
            raise ValueError(
                f"--pixel-size, --height-range and --fill-missing go with a scan; the recipe {source} has its own"
            )
        recipe = Recipe.load(source)
        return Recipe(recipe.surface, {**recipe.spectrum, **settings}, recipe.folder).build(progress)
    height_field = read_height_field(
        source, pixel_size=pixel_size, height_range=height_range, fill_missing=fill_missing
    )
    return precompute(height_field, progress=progress, **settings)


@app.command("render")
def _render(
    scene: Annotated[Path, typer.Argument(metavar="SCENE.xml")],
    output: Annotated[Path | None, typer.Option("-o", "--output", help="the spectral picture (.exr)")] = None,
    spp: Annotated[int, typer.Option(min=1, help="samples per pixel")] = 64,
    width: Annotated[int | None, typer.Option(min=1, help="pixels; the scene's own by default")] = None,
    height: Annotated[int | None, typer.Option(min=1, help="pixels; the scene's own by default")] = None,
    variant: Annotated[str | None, typer.Option(help="of Mitsuba; the fastest spectral one by default")] = None,
    seed: Annotated[int, typer.Option(min=0)] = 0,
    define: Annotated[
        list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="a parameter of the scene")
    ] = None,
) -> None:
    """Path-trace a scene into a spectral picture (.exr) and a preview (.png) beside it."""
    import mitsuba as mi

    from .color import save_preview
    from .render import render
    from .variants import choose_variant

    target = output or Path(scene.with_suffix(".exr").name)
    if target.suffix.lower() != ".exr":
        raise ValueError(f"-o: got {target}, wanted a file name that ends in .exr")
    if not target.parent.is_dir():
        raise ValueError(f"-o: got {target}, but the folder {target.parent} is not there")
    parameters = {}
    for item in define or []:
        name, equals, value = item.partition("=")
        if not (name and equals):
            raise ValueError(f"-D: got {item!r}, wanted NAME=VALUE")
        # A file named on the command line is relative to where the command is given.
        parameters[name] = str(Path(value).resolve()) if Path(value).is_file() else value
    mi.set_variant(choose_variant(variant))
    start = time.perf_counter()
    with _progress(scene.name) as progress:
        image = render(scene, spp=spp, width=width, height=height, seed=seed, parameters=parameters, progress=progress)
    image.save(target)
    preview = target.with_suffix(".png")
    exposure = save_preview(image, preview)
    rows, columns, bins = image.radiance.shape
    _tell(
        f"{target}: {columns} × {rows} pixels, {bins} wavelengths, {spp} samples per pixel, {mi.variant()}, "
        f"{time.perf_counter() - start:.1f} s\n{preview}: preview, exposure {exposure:.4g}"
    )


@app.command("benchmark")
def _benchmark(
    scan: Annotated[Path | None, typer.Argument(metavar="[SCAN]", help="a scan to measure with")] = None,
    pixel_size: Annotated[float | None, typer.Option(help="of the scan, µm")] = None,
    height_range: Annotated[float | None, typer.Option(help="of the scan, black to white, µm")] = None,
    surface: Annotated[list[str] | None, typer.Option(help="only these of the bundled ones")] = None,
    tolerance: Annotated[list[float] | None, typer.Option(help="only these")] = None,
    variant: Annotated[str | None, typer.Option(help="of Mitsuba; the fastest spectral one by default")] = None,
    json: Annotated[Path | None, typer.Option(help="write the results here, too")] = None,
    plot: Annotated[Path | None, typer.Option(help="draw error against speed here (.png)")] = None,
) -> None:
    """Speed against error of every representation, as ratios to Mitsuba's roughconductor."""
    import mitsuba as mi

    from .benchmark import bundled_cases, measure, report, run, scan_case
    from .variants import choose_variant

    cases = bundled_cases()
    names = [case.name for case in cases]
    if unknown := set(surface or []) - set(names):
        raise ValueError(f"--surface: got {', '.join(sorted(unknown))}, wanted among {', '.join(names)}")
    cases = [case for case in cases if not surface or case.name in surface]
    if scan is not None:
        cases.append(scan_case(read_height_field(scan, pixel_size=pixel_size, height_range=height_range)))
    mi.set_variant(choose_variant(variant))
    with _progress("speed and error") as progress:
        results, shaders = run(cases, **({"tolerances": tolerance} if tolerance else {}), progress=progress)
    with _progress("sampling") as progress:
        sampling = measure(cases, progress=progress)
    # Wide enough wherever it goes, a file too.
    wide = Console(highlight=False, width=max(_out.width, 140))
    wide.print(report.table(results), report.shader_table(shaders), report.sampling_table(sampling), sep="\n\n")
    if json is not None:
        report.save_json(results, shaders, sampling, json)
    if plot is not None:
        report.save_plot(results, plot)


@contextmanager
def _progress(label: str) -> Iterator[Callable[[int, int], None]]:
    columns = (TextColumn("{task.description}", markup=False), BarColumn(), MofNCompleteColumn(), TimeElapsedColumn())
    with Progress(*columns, TimeRemainingColumn(), console=_err, transient=True, disable=not _err.is_terminal) as bars:
        task = bars.add_task(label, total=None)
        yield lambda done, total: bars.update(task, completed=done, total=total)


def _tell(text: str) -> None:
    # File names are no markup.
    _out.print(text, markup=False, emoji=False)


def _say(kind: str, message: object) -> None:
    _err.print(f"{NAME}: {kind}: {' '.join(str(message).split())}", markup=False, emoji=False)


def main() -> None:
    """Entry point of the command `mitsuba-diffraction`."""
    warnings.showwarning = lambda message, *args, **kwargs: _say("warning", message)
    try:
        code = app(prog_name=NAME, standalone_mode=False) or 0
        if code == 130:  # newer versions of Typer turn Ctrl-C into this code
            raise KeyboardInterrupt
    except _UsageError as error:
        _say("error", f"{error.format_message()} (try {NAME} --help)")
        code = 2
    except (ValueError, FileNotFoundError, IsADirectoryError, NotADirectoryError) as error:
        _say("error", error)
        code = 2
    except (KeyboardInterrupt, typer.Abort):
        _say("interrupted", "nothing was written")
        code = 1
    except (RuntimeError, OSError, MemoryError) as error:
        _say("error", str(error) or type(error).__name__)
        code = 1
    sys.exit(code)
