"""Error of a picture against rendering time: the path tracer and the real-time shaders.

All pictures of a scene are compared with one reference: the path tracer's, with many samples and a third of the
lowest tolerance. The error of the path tracer tends to zero with noise and tolerance; the error of a shader tends to
its bias.
"""

from __future__ import annotations

import functools
import os
from collections.abc import Callable, Mapping, Sequence
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass

import numpy as np

from ...errors import RequestError
from ...files.outputs import METADATA
from ...files.writing import whole_file
from ...progress import Progress, no_progress
from ...settings import MIN_TOLERANCE
from ...shader_2014.comparison.difference import as_shown, difference, noise, time_of_error, white_luminance
from ...shader_2014.comparison.pictures import Picture, Pictures

PICTURE_TOLERANCES = (1e-1, 1e-2, 1e-3)
SAMPLE_COUNTS = (1, 4, 16, 64, 256)
SHADERS = ("flss", "nmm", "pq")
PICTURES_PER_POINT = 5  # of different seeds, whose medians count
SAMPLES_OF_OTHERS_PER_POINT = 4  # samples of all BSDFs other than gratings, per shading point

POINT_COLUMNS = {
    "picture": "{.name}",
    "samples": "{.samples}",
    "seconds": "{.seconds:.3g}",
    "ΔE00": "{.delta_e:.2f}",
    "relative MSE": "{.relative_mse:.1e}",
}


@dataclass(frozen=True)
class Point:
    """Error and rendering time of a picture, each the median over `PICTURES_PER_POINT` seeds.

    Attributes:
        name: "tolerance 0.01" of the path tracer, or "flss, corrected".
        traced: by the path tracer.
        samples: per pixel; shading points of a shader.
        seconds: of rendering, without loading and compiling.
        delta_e: mean CIEDE2000 to the reference.
        relative_mse: Σ (Y − Y_ref)²/Σ Y_ref² over the pixels that show surfaces, at the same mean luminance; Y is
            clipped at white, as a few much brighter pixels would dominate the sum.
    """

    name: str
    traced: bool
    samples: int
    seconds: float
    delta_e: float
    relative_mse: float


@dataclass(frozen=True)
class Convergence:
    """Errors and times of the pictures of one scene.

    Attributes:
        scene: file name and parameters.
        size: (width, height) in pixels.
        noise: mean CIEDE2000 of the reference due to noise; None for one sample per pixel.
        points: in the order of measurement.
    """

    scene: str
    size: tuple[int, int]
    noise: float | None
    points: tuple[Point, ...]

    def curves(self) -> dict[str, list[Point]]:
        """Group the points by name."""
        names = dict.fromkeys(point.name for point in self.points)
        return {name: [point for point in self.points if point.name == name] for name in names}

    def overtaken(self, name: str, error: str) -> float:
        """Return the time at which the path tracer's error falls below the minimum error of a shader.

        Args:
            name: of the shader's curve.
            error: "delta_e" or "relative_mse".

        Returns:
            Seconds, interpolated in logarithms along the fastest curve; the time of the fastest picture if that is
            already better, NaN if none is.
        """
        bias = min(getattr(point, error) for point in self.curves()[name])
        times = [
            time_of_error(bias, *([getattr(point, key) for point in curve] for key in ("seconds", error)))
            for curve in self.curves().values()
            if curve[0].traced
        ]
        return min((time for time in times if np.isfinite(time)), default=np.nan)


def check_tolerances(tolerances: Sequence[float]) -> None:
    """Raise RequestError if a third of the lowest tolerance, which the reference uses, is too low."""
    if not min(tolerances) / 3 >= MIN_TOLERANCE:
        raise RequestError(
            f"tolerance: got {min(tolerances):g}, wanted at least {3 * MIN_TOLERANCE:g}: "
            "the reference uses a third of the lowest"
        )


def convergence(
    scene_path: str | os.PathLike[str],
    *,
    tolerances: Sequence[float] = PICTURE_TOLERANCES,
    samples: Sequence[int] = SAMPLE_COUNTS,
    reference_samples: int = 2048,
    shaders: Sequence[str] = SHADERS,
    shading_points: Sequence[int] = (1, 4, 16),
    width: int | None = None,
    parameters: Mapping[str, str] | None = None,
    progress: Callable[[str], AbstractContextManager[Progress]] = no_progress,
) -> Convergence:
    """Render a scene with several tolerances, shaders and numbers of samples under the current variant.

    Args:
        scene_path: an XML scene with a parameter `tolerance` of its gratings, whose integrator is a path tracer, with a
            directional or point light.
        tolerances: of the spectra.
        samples: per pixel of the path tracer, ascending.
        reference_samples: per pixel of the reference.
        shaders: names.
        shading_points: per pixel of the shaders, ascending.
        width: in pixels; default: the width of the film.
        parameters: further values for the scene's `$name` parameters.
        progress: progress(label) is a context whose value is called with (done, total).

    Raises:
        FileNotFoundError: if there is no such scene.
        ValueError: if the request is wrong, or a shader cannot show the scene.
    """
    check_tolerances(tolerances)

    def pictures(tolerance: float, shader: str = SHADERS[0], seed: int = 0) -> Pictures:
        chosen = {**(parameters or {}), "tolerance": f"{tolerance:g}"}
        return Pictures(scene_path, shader, width=width, seed=seed, parameters=chosen)

    finest = min(tolerances)
    of = pictures(finest / 3, seed=1)
    with progress("reference") as bar:
        reference = of.path_traced(reference_samples, bar)
    white = white_luminance(reference.xyz, of.mask)
    points = []

    def errors(picture: Picture) -> tuple[float, float, float]:
        delta_e = difference(reference.xyz, picture.xyz, of.mask, white)
        wanted = as_shown(reference.xyz[of.mask] / white)[:, 1]
        found = as_shown(picture.xyz[of.mask] * (delta_e.exposure / white))[:, 1]
        return picture.seconds, delta_e.mean, float(((found - wanted) ** 2).sum() / (wanted**2).sum())

    def add(name: str, traced: bool, count: int, rendered: Callable[[], Picture], source: Pictures) -> None:
        found = []
        for seed in range(PICTURES_PER_POINT):
            source.seed = seed
            # With few samples a picture may miss all orders. It then has no exposure, and a shader's no brightness.
            with suppress(RequestError):
                found.append(errors(rendered()))
        if found:
            seconds, delta_e, mse = np.median(found, axis=0).tolist()
            points.append(Point(name, traced, count, seconds, delta_e, mse))

    for tolerance in tolerances:
        traced = pictures(tolerance)
        with progress(f"tolerance {tolerance:g}") as bar:
            for number, count in enumerate(samples, 1):
                add(f"tolerance {tolerance:g}", True, count, functools.partial(traced.path_traced, count), traced)
                bar(number, len(samples))
    for shader in shaders:
        shaded = pictures(finest, shader)
        for name, quirks in (("as published", shaded.quirks), ("corrected", ())):
            with progress(f"{shader}, {name}") as bar:
                for number, count in enumerate(shading_points, 1):
                    rendered = functools.partial(shaded.shaded, quirks, count, SAMPLES_OF_OTHERS_PER_POINT * count)
                    add(f"{shader}, {name}", False, count, rendered, shaded)
                    bar(number, len(shading_points))
    scene = " ".join(
        [os.path.basename(scene_path), *(f"-D {key}={value}" for key, value in (parameters or {}).items())]
    )
    rows, columns = of.mask.shape
    return Convergence(scene, (columns, rows), noise(reference.halves, of.mask, white), tuple(points))


def save_convergence_plot(found: Convergence, path: str | os.PathLike[str]) -> None:
    """Plot the mean CIEDE2000 against time: down is more accurate, left is faster."""
    from matplotlib import colormaps
    from matplotlib.figure import Figure
    from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter

    traced = {point.name for point in found.points if point.traced}
    figure = Figure(figsize=(8, 7), layout="constrained")  # with text that is read at 400 pixels
    panel = figure.subplots()
    blues = iter(colormaps["Blues"](np.linspace(0.6, 0.9, len(traced))[::-1]))
    shaders = dict(zip(SHADERS, ("#c0392b", "#d98c1f", "#6b8e23"), strict=True))
    for name, curve in found.curves().items():
        seconds, errors = ([getattr(point, key) for point in curve] for key in ("seconds", "delta_e"))
        if curve[0].traced:
            label = f"path tracer, {name}" if len(traced) > 1 else "path tracer"
            panel.loglog(seconds, errors, "o-", color=next(blues), markersize=8, linewidth=3, label=label)
            continue
        shader, manner = name.split(", ")
        panel.loglog(
            seconds, errors, "s--" if manner == "as published" else "D:", color=shaders[shader], markersize=8,
            linewidth=2, markerfacecolor=shaders[shader] if manner == "as published" else "white",
            label=f"{shader.upper()}, {manner.removeprefix('as ')}",
        )  # fmt: skip
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axis.set_minor_formatter(NullFormatter())
    panel.tick_params(labelsize=17)
    panel.set_xlabel("seconds", fontsize=18)
    panel.set_ylabel("mean difference of colour, ΔE00", fontsize=18)
    panel.grid(alpha=0.25)
    figure.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=16)
    with whole_file(path) as temporary:
        figure.savefig(temporary, format="png", dpi=130, metadata=METADATA)
