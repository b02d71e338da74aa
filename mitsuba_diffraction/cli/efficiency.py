"""`mitsuba-diffraction efficiency`: the light in the orders of a grating or the peaks of an irregular surface."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from ..errors import RequestError
from ..export.exported_grating import medium_in_air
from ..files.outputs import check_outputs
from ..inspection.efficiency import OrderEfficiencies, order_efficiencies
from ..inspection.peaks import check_request, efficiencies_of_peaks
from ..precomputation.grating_spectrum import GratingSpectrum
from ..precomputation.spectra import load_spectrum
from ..precomputation.surface_text import parsed
from ..progress import progress_bar, tell
from ..scalar_theory.validity import scalar_error
from ..settings import ScalarSettings
from .arguments import (
    KEYS_OF_RECIPES,
    SURFACE,
    Overwrite,
    angles_of,
    check_suffix,
    named_as_options,
    parse_numbers,
    recipe_of,
)

_OF_LIGHT = ("theory", "transmission", "material", "int_ior", "ext_ior")  # besides the surface


@named_as_options({"wavelengths": "--wavelength"})
def efficiency(
    surface: Annotated[
        str,
        typer.Argument(
            metavar=SURFACE,
            help="a recipe (.toml), a profile, a scan, or a saved spectrum (.exr) of an irregular surface; "
            f"{KEYS_OF_RECIPES}, theory, material (a conductor) or int_ior (default: 1.5), and transmission (none, "
            "interface, sheet)",
        ),
    ],
    angle: Annotated[
        str, typer.Option(help="angle of incidence, degrees: a number, several (0,30), or first:last:step")
    ] = "0",
    wavelength: Annotated[str, typer.Option(help="nm: a number, several, or first:last:step")] = "400:700:50",
    azimuth: Annotated[
        float, typer.Option(help="azimuth of the plane of incidence, degrees from x; 90: along the grooves")
    ] = 0,
    csv: Annotated[Path | None, typer.Option(help="save all numbers (.csv)")] = None,
    plot: Annotated[Path | None, typer.Option(help="save a plot (.png, .pdf, .svg)")] = None,
    overwrite: Overwrite = False,
) -> None:
    """Compute how much light goes into each order of a grating, or each spectral peak of an irregular surface."""
    angles, wavelengths = angles_of("--angle", angle), parse_numbers("--wavelength", wavelength)
    name, values = parsed(surface)
    given = {key: values.pop(key) for key in _OF_LIGHT if key in values}
    # The names of rigorous theory are known to its recipes alone.
    of_theory = {"theory": "rigorous"} if given.get("theory") == "rigorous" else {}
    recipe = recipe_of(name, values | of_theory)
    settings = ScalarSettings() if recipe is None else recipe.settings
    chosen = {"theory": "scalar", "transmission": "none", **settings.chosen}
    theory, transmission = (given.get(key, chosen[key]) for key in _OF_LIGHT[:2])
    below = medium_in_air(chosen, given)
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
    light = angles, wavelengths, azimuth
    found: OrderEfficiencies
    if recipe is None or irregular:
        check_request(settings.wavelengths, angles, wavelengths, below)  # before a spectrum is computed
        cached = load_spectrum(name) if recipe is None else recipe.cached(partial(progress_bar, unit="%"))
        if not isinstance(cached, GratingSpectrum):
            raise RequestError(f"{name}: got a spectrum of rigorous theory, wanted its recipe")
        with progress_bar(f"peaks of {name}") as progress:
            found = efficiencies_of_peaks(cached, below, *light, progress)
        warning = cached.warning
    else:
        with progress_bar(f"efficiencies of {name}") as progress:
            found = order_efficiencies(recipe.height_field(), below, *light, theory, transmission, progress)
            warning = scalar_error(recipe.height_field(), below=below).warning if theory == "scalar" else ""
    tell(str(found))
    if warning:
        tell(f"! {warning}")
    if csv is not None:
        found.save_csv(csv)
        tell(f"{csv}: all numbers")
    if plot is not None:
        found.plot(plot)
        tell(f"{plot}: a plot of the strongest {'peaks' if irregular else 'orders'}")
