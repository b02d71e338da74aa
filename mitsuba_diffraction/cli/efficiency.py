"""`mitsuba-diffraction efficiency`: the light in the orders of a grating or the peaks of an irregular surface."""

from __future__ import annotations

from functools import partial
from pathlib import Path
from typing import Annotated

import typer

from ..errors import RequestError
from ..files.outputs import check_outputs
from ..inspection.efficiency import OrderEfficiencies, order_efficiencies
from ..inspection.peaks import check_request, efficiencies_of_peaks
from ..precomputation.grating_spectrum import GratingSpectrum
from ..precomputation.requested_surface import RequestedSurface
from ..progress import progress_bar, say, tell
from ..scalar_theory.validity import scalar_error
from ..settings import ScalarSettings
from .arguments import (
    KEYS_OF_RECIPES,
    SURFACE,
    Overwrite,
    check_suffix,
    incidence_of,
    named_as_options,
    parse_numbers,
)

_OF_LIGHT = ("theory", "transmission", "material", "int_ior", "ext_ior")  # besides the surface


@named_as_options({"wavelengths": "--wavelength", "angles": "--angle", "azimuth": "--azimuth"})
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
        str,
        typer.Option(
            help="angle of incidence, degrees: a number, several (0,30), or first:last:step; or littrow, where order 1 "
            "returns to the source; littrow:m, order m"
        ),
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
    angles, wavelengths = incidence_of("--angle", angle), parse_numbers("--wavelength", wavelength)
    requested = RequestedSurface.of(surface, aside=_OF_LIGHT)
    name, theory = requested.title, requested.theory
    media = requested.media
    if csv is not None:
        check_suffix("--csv", csv, ".csv")
    if plot is not None:
        check_suffix("--plot", plot, ".png", ".pdf", ".svg")
    writes = [(option, path) for option, path in (("--csv", csv), ("--plot", plot)) if path is not None]
    check_outputs(requested.files, writes, overwrite=overwrite)
    if (irregular := requested.is_irregular) and (theory == "rigorous" or media.transmits):
        what, other = ("a saved spectrum", ", or its recipe") if requested.is_spectrum else ("an irregular surface", "")
        raise RequestError(
            f"{name}: got theory {theory}, transmission {media.transmission} of {what}, wanted scalar, none{other}"
        )
    requested.say_extent()
    light = angles, wavelengths, azimuth
    found: OrderEfficiencies
    if irregular:
        valid = (ScalarSettings() if requested.is_spectrum else requested.recipe.settings).wavelengths
        check_request(valid, angles, wavelengths, media.below)  # before a spectrum is computed
        cached = requested.spectrum(partial(progress_bar, unit="%"))
        assert isinstance(cached, GratingSpectrum)
        with progress_bar(f"peaks of {name}") as progress:
            found = efficiencies_of_peaks(cached, media.below, *light, progress)
        warning = cached.warning
    else:
        field, values = requested.period, requested.recipe.surface
        if media.transmits and values.get("profile") == "ruled" and "blaze_ior" not in values:
            say("note", "ruled is blazed for reflected light; blaze_ior=, the index, blazes it for transmission")
        with progress_bar(f"efficiencies of {name}") as progress:
            found = order_efficiencies(field, media, *light, theory, progress)
            warning = scalar_error(field, below=media.below).warning if theory == "scalar" else ""
    tell(str(found))
    if warning:
        tell(f"! {warning}")
    if csv is not None:
        found.save_csv(csv)
        tell(f"{csv}: all numbers")
    if plot is not None:
        found.plot(plot)
        tell(f"{plot}: a plot of the strongest {'peaks' if irregular else 'orders'}")
