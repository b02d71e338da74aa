"""`mitsuba-diffraction efficiency`: the light in the orders of a grating or the peaks of an irregular surface."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated, Any

import typer

from ..errors import RequestError
from ..files.outputs import check_outputs
from ..inspection.efficiency import OrderEfficiencies, efficiencies
from ..inspection.peaks import check_request, peak_efficiencies
from ..precomputation.grating_spectrum import GratingSpectrum
from ..precomputation.spectra import load_spectrum
from ..progress import progress_bar, tell
from ..scalar_theory.validity import scalar_error
from ..settings import ScalarSettings
from .arguments import (
    Overwrite,
    angles_of,
    check_suffix,
    converted,
    parse_numbers,
    recipe_with,
    surface_of,
    takes_scan,
)


@takes_scan
def efficiency(
    context: typer.Context,
    source: Annotated[
        str,
        typer.Argument(
            metavar="SURFACE[,name=value…]",
            help="a recipe (.toml), a profile, a scan, or a saved spectrum (.exr) of an irregular surface",
        ),
    ],
    angle: Annotated[
        str, typer.Option(help="angle of incidence, degrees: a number, several (0,30), or first:last:step")
    ] = "0",
    wavelength: Annotated[str, typer.Option(help="nm: a number, several, or first:last:step")] = "400:700:50",
    theory: Annotated[
        str | None, typer.Option(help="scalar or rigorous; default: that of the recipe, or scalar")
    ] = None,
    material: Annotated[
        str | None, typer.Option(help="a conductor, as Mitsuba names it; default: that of the recipe, or n = 1.5")
    ] = None,
    int_ior: Annotated[
        str | None, typer.Option(help="the index of a dielectric instead: a number, a name such as BK7, or a file")
    ] = None,
    transmission: Annotated[
        str | None,
        typer.Option(help="none, or transmitted orders, too: interface or sheet; default: that of the recipe, or none"),
    ] = None,
    azimuth: Annotated[
        float, typer.Option(help="azimuth of the plane of incidence, degrees from x; 90: along the grooves")
    ] = 0,
    csv: Annotated[Path | None, typer.Option(help="save all numbers (.csv)")] = None,
    plot: Annotated[Path | None, typer.Option(help="save a plot (.png, .pdf, .svg)")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Compute how much light goes into each order of a grating, or each spectral peak of an irregular surface."""
    angles, wavelengths = angles_of("--angle", angle), parse_numbers("--wavelength", wavelength)
    name, values = surface_of(source)
    recipe = recipe_with(context, name, values)
    settings = ScalarSettings() if recipe is None else recipe.settings
    chosen = settings.chosen
    theory, transmission = theory or settings.theory, transmission or chosen.get("transmission", "none")
    index: complex | str | None = None if int_ior is None else converted(int_ior)
    if material is None and int_ior is None:
        material, index = chosen.get("material"), chosen.get("int_ior")
    if csv is not None:
        check_suffix("--csv", csv, ".csv")
    if plot is not None:
        check_suffix("--plot", plot, ".png", ".pdf", ".svg")
    writes = [(option, path) for option, path in (("--csv", csv), ("--plot", plot)) if path is not None]
    check_outputs([Path(name), *(recipe.files if recipe else [])], writes, overwrite=overwrite)
    irregular = recipe is None or settings.extent == "sample" or recipe.patches > 1
    if irregular and (theory, transmission) != ("scalar", "none"):
        raise RequestError(
            f"{name}: got theory {theory}, transmission {transmission} of an irregular surface, wanted scalar, none"
        )
    material_of: dict[str, Any] = {"material": material, "int_ior": index, "azimuth": azimuth}
    found: OrderEfficiencies
    if recipe is None or irregular:
        check_request(settings.wavelengths, angles, wavelengths, material, index)  # before a spectrum is computed
        cached = load_spectrum(name) if recipe is None else recipe.cached(partial(progress_bar, unit="%"))
        if not isinstance(cached, GratingSpectrum):
            raise RequestError(f"{name}: got a spectrum of rigorous theory, wanted its recipe")
        with progress_bar(f"peaks of {name}") as progress:
            found = peak_efficiencies(cached, angles, wavelengths, **material_of, progress=progress)
        warning = cached.warning
    else:
        with progress_bar(f"efficiencies of {name}") as progress:
            found = efficiencies(
                recipe.height_field(),
                angles,
                wavelengths,
                theory=theory,
                transmission=transmission,
                **material_of,
                progress=progress,
            )
            warning = scalar_error(recipe.height_field()).warning if theory == "scalar" else ""
    tell(str(found))
    if warning:
        tell(f"! {warning.replace('theory=rigorous', '--theory rigorous')}")
    if csv is not None:
        found.save_csv(csv)
        tell(f"{csv}: all numbers")
    if plot is not None:
        found.plot(plot)
        tell(f"{plot}: a plot of the strongest {'peaks' if irregular else 'orders'}")
