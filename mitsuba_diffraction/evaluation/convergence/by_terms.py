"""Error of a picture against the number of terms of an amplitude series, with the picture of slices as reference.

All pictures have the same random numbers.
"""

from __future__ import annotations

import itertools
import os
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import TYPE_CHECKING

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...bsdf.theory import errors_shown
from ...errors import RequestError
from ...optics.color import XYZ_to_linear_sRGB, delta_E, into_gamut, on_screen, radiance_to_XYZ
from ...precomputation.grating_spectrum import GratingSpectrum
from ...progress import Progress, no_progress
from ...render import SpectralImage
from ...render.passes import split
from ...render.scene import shows_gratings
from ...render.scene_file import SceneFile
from ...render.spectral_film import channel_wavelengths
from ...render.sums import Accumulation
from ...render.trace_pass import pass_seed, trace_pass
from ...settings import ORIGINS, SERIES, ScalarSettings
from ...shader_2014.comparison.difference import as_shown, white_luminance
from ...shader_2014.comparison.pictures import Picture
from ...shader_2014.shaded_gratings import gratings_of

if TYPE_CHECKING:
    from matplotlib.figure import Figure

SERIES_TERMS = (4, 6, 8, 10, 15, 20)
SERIES_SAMPLES = 16

SERIES_COLUMNS = {
    "spectrum": "{.name}",
    "heights from": "{.heights_from}",
    "∫|ΔS| dq": "{.spectrum_error:.1e}",
    "Σ|ΔL|/ΣL": "{.error:.2e}",
    "ΔE00 mean": "{.delta_e:.2f}",
    "ΔE00 95 %": "{.delta_e_95:.2f}",
    "words read": "{.words}",
    "MB": "{.megabytes:.3g}",
    "seconds": "{.seconds:.3g}",
    "compiling": "{.compiling:.2g}",
}


@dataclass(frozen=True)
class Row:
    """A picture, compared with the picture by slices.

    Attributes:
        name: "slices", or "taylor, 20 terms".
        heights_from: "mean" or "lowest".
        terms: N; None for slices.
        spectrum_error: ∫|ΔS| dq, a fraction of the reflected power, measured when the spectrum was built.
        error: Σ|ΔL|/ΣL over the wavelengths and the pixels that show gratings.
        delta_e, delta_e_95: mean and 95th percentile of CIEDE2000 over these pixels.
        words: of 32 bits, read for one evaluation of four wavelengths.
        megabytes: of the table.
        seconds: of processor time (on a GPU: of time), of rendering without compiling.
        compiling: likewise, by which the first pass exceeds another one.
    """

    name: str
    heights_from: str
    terms: int | None
    spectrum_error: float
    error: float
    delta_e: float
    delta_e_95: float
    words: int
    megabytes: float
    seconds: float
    compiling: float


@dataclass(frozen=True, eq=False)
class SeriesStudy:
    """The pictures of one scene: slices first, then each number of terms, from each origin.

    Attributes:
        scene: file name and parameters.
        samples: per pixel.
        rows: in the order of measurement.
        xyz: (height, width, 3) each, of the rows.
        shown: (height, width) bool, the pixels that show gratings.
    """

    scene: str
    samples: int
    rows: tuple[Row, ...]
    xyz: tuple[NDArray[np.float64], ...]
    shown: NDArray[np.bool_]


def study(
    scene_path: str | os.PathLike[str],
    *,
    terms: Sequence[int] = SERIES_TERMS,
    origins: Sequence[str] = ORIGINS,
    samples: int = SERIES_SAMPLES,
    width: int | None = None,
    parameters: Mapping[str, str] | None = None,
    progress: Callable[[str], AbstractContextManager[Progress]] = no_progress,
) -> SeriesStudy:
    """Render a scene with slices and with series of several numbers of terms, under the current variant.

    Args:
        scene_path: an XML scene with the parameters `representation`, `terms` and `heights_from` of a grating.
        terms: numbers of terms, ascending.
        origins: levels of h = 0, among "mean" and "lowest".
        samples: per pixel.
        width: in pixels; default: the width of the film.
        parameters: further values for the scene's `$name` parameters; `representation` is "taylor" by default.
        progress: progress(label) is a context whose value is called with (done, total).

    Raises:
        FileNotFoundError: if there is no such scene.
        ValueError: if the request is wrong, or no grating of the scene takes a series.
    """
    own = {"representation": SERIES[0], **(parameters or {})}
    kind = own["representation"]
    for origin, count in itertools.product(origins, terms):
        ScalarSettings(representation=kind, terms=count, heights_from=origin)
    wanted = [{"representation": "auto", "terms": "auto", "heights_from": "mean"}]
    wanted += [{"terms": str(count), "heights_from": origin} for origin in origins for count in terms]
    rows: list[Row] = []
    pictures: list[Picture] = []
    with progress("pictures") as bar:
        for values in wanted:
            scene = _loaded(scene_path, width, {**own, **values})
            spectrum = _spectrum(scene, kind if rows else "slices")
            picture, compiling = _traced(scene, samples)
            if not rows:
                shown = shows_gratings(scene)
                white = white_luminance(picture.xyz, shown)
            reference = (pictures or [picture])[0]
            radiance, expected = (one.image.radiance[shown].astype(np.float64) for one in (picture, reference))
            colours = _delta_e(picture.xyz, reference.xyz, shown, white)
            rows.append(
                Row(
                    name=f"{kind}, {values['terms']} terms" if rows else "slices",
                    heights_from=values["heights_from"],
                    terms=int(values["terms"]) if rows else None,
                    spectrum_error=spectrum.error,
                    error=float(np.abs(radiance - expected).sum() / expected.sum()),
                    delta_e=float(colours.mean()),
                    delta_e_95=float(np.percentile(colours, 95)),
                    words=4 * int(np.prod(spectrum.neighbours)) * spectrum.table.words_per_node,
                    megabytes=spectrum.megabytes,
                    seconds=picture.seconds,
                    compiling=compiling,
                )
            )
            pictures.append(picture)
            bar(len(rows), len(wanted))
    name = " ".join([os.path.basename(scene_path), *(f"-D {key}={value}" for key, value in (parameters or {}).items())])
    return SeriesStudy(name, samples, tuple(rows), tuple(picture.xyz for picture in pictures), shown)


def _loaded(path: str | os.PathLike[str], width: int | None, parameters: Mapping[str, str]) -> mi.Scene:
    # The error of a series is in the table.
    with errors_shown():
        return SceneFile(path, parameters, size=(width, None)).load()


def _spectrum(scene: mi.Scene, representation: str) -> GratingSpectrum:
    """Return the spectrum of the gratings that have a representation."""
    found = [bsdf.spectrum for bsdf in gratings_of(scene)[0] if bsdf.spectrum.representation == representation]
    if not found:
        raise RequestError(f"representation: got no grating of {representation}, wanted one in the scene")
    return found[0]


def _traced(scene: mi.Scene, samples: int) -> tuple[Picture, float]:
    """Return a picture, and the seconds of compiling its kernels."""
    # Processor time does not depend on other processes, but excludes the time of a GPU.
    clock = time.process_time if mi.variant().startswith("llvm") else time.perf_counter
    columns, rows = scene.sensors()[0].film().crop_size()
    sums, passes = Accumulation.empty(rows, columns), split(scene, samples, 2)
    radiance_to_XYZ(sums.radiance(), channel_wavelengths())  # loads the observer
    # By `path`: the wavelengths that `diffraction_path` keeps depend on their values, and differ between pictures.
    integrator = getattr(scene.integrator(), "path", scene.integrator())
    begin = clock()
    # It has as many samples as the others, since kernels depend on their number.
    trace_pass(scene, passes[0], 0, integrator)
    compiled = clock()
    for index, some in enumerate(passes):
        sums.add(trace_pass(scene, some, pass_seed(0, index), integrator), some)
    seconds = clock() - compiled
    image = SpectralImage(channel_wavelengths(), sums.radiance())
    return Picture(image, sums.samples, seconds), max(0.0, compiled - begin - seconds / len(passes))


def _delta_e(
    xyz: NDArray[np.float64], reference: NDArray[np.float64], where: NDArray[np.bool_], white: float
) -> NDArray[np.float64]:
    """Return CIEDE2000 of the pixels in `where` at one exposure; `white` is the luminance that is shown as white."""
    return delta_E(*(as_shown(one[where] / white) for one in (xyz, reference)))


def plot_series(found: SeriesStudy) -> Figure:
    """Plot the pictures of each number of terms and of slices, CIEDE2000 below them, and errors and times."""
    from matplotlib.figure import Figure

    origins, terms = (
        list(dict.fromkeys(getattr(row, key) for row in found.rows[1:])) for key in ("heights_from", "terms")
    )
    by_row = {(row.heights_from, row.terms): (row, xyz) for row, xyz in zip(found.rows, found.xyz, strict=True)}
    (reference, expected), white = by_row["mean", None], white_luminance(found.xyz[0], found.shown)
    height = 2 * len(origins) * (13.0 / (len(terms) + 1) * found.shown.shape[0] / found.shown.shape[1] + 0.3)
    figure = Figure(figsize=(13.6, height + 3.2), layout="constrained")
    upper, lower = figure.subfigures(2, 1, height_ratios=[height, 3.0])
    panels = upper.subplots(2 * len(origins), len(terms) + 1, squeeze=False)
    for panel in panels.ravel():
        panel.set(xticks=[], yticks=[], facecolor="0.88")
        panel.spines[:].set_visible(False)
    for origin, top, below in zip(origins, panels[::2], panels[1::2], strict=True):
        top[0].set_ylabel(f"heights from\n{'the mean' if origin == 'mean' else 'the lowest point'}")
        below[-1].set_axis_off()
        for column, count in enumerate([*terms, None]):
            row, xyz = by_row[origin if count else "mean", count]
            pixels = on_screen(into_gamut(XYZ_to_linear_sRGB(xyz / white)))
            top[column].imshow(pixels, interpolation="nearest")
            top[column].set_title(row.name, fontsize="medium", parse_math=False)
            if count:
                colours = np.full(found.shown.shape, np.nan)
                colours[found.shown] = _delta_e(xyz, expected, found.shown, white)
                image = below[column].imshow(colours, cmap="inferno", vmin=0, vmax=10, interpolation="nearest")
                below[column].set_title(f"ΔE00 mean {row.delta_e:.2g}", fontsize="small", pad=3)
        bar = upper.colorbar(
            image, cax=below[-1].inset_axes([0.05, 0.5, 0.9, 0.1]), extend="max", orientation="horizontal"
        )
        bar.set_label("ΔE00 to slices", fontsize="small")
    errors, times = lower.subplots(1, 2)
    for origin, colour in zip(origins, ("#1f6fb4", "#c8281e"), strict=False):
        rows = [by_row[origin, count][0] for count in terms]
        errors.semilogy(terms, [row.error for row in rows], "o-", color=colour, label=f"picture, heights from {origin}")
        errors.semilogy(terms, [row.spectrum_error for row in rows], "s--", color=colour, label=f"spectrum, {origin}")
        ratios = [row.seconds / reference.seconds for row in rows]
        times.plot(terms, ratios, "o-", color=colour, label=f"heights from {origin}")
    errors.set_ylabel("Σ|ΔL|/ΣL; ∫|ΔS| dq")
    times.set_ylabel("time relative to slices")
    times.set_ylim(0)
    for panel in (errors, times):
        panel.set_xlabel("number of terms N")
        panel.grid(alpha=0.25)
        panel.legend(fontsize="small", frameon=False)
    figure.suptitle(f"{found.scene}, {found.samples} samples per pixel", fontsize=10, parse_math=False)
    return figure
