"""Path tracing in passes: their number and seeds, interrupts, progress and checkpoints of unfinished renderings."""

from __future__ import annotations

import hashlib
import json
import logging
import math
import os
import shutil
import signal
import tempfile
import threading
import time
from bisect import bisect_left
from collections.abc import Callable, Generator, Iterator
from contextlib import closing, contextmanager, nullcontext
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from importlib import metadata
from itertools import accumulate, chain
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError
from ..files.writing import exclusive
from ..progress import bytes_text, stage
from .scene import recorded_range, warn_of_gratings
from .scene_file import SceneFile
from .scene_light import max_plausible_luminance
from .spectral_film import SpectralRange, channel_wavelengths
from .spectral_image import SpectralImage
from .sums import BandedImage, BandedSums, checkpoint_of_band, error_of_picture
from .trace_pass import (
    LightOfBands,
    Rows,
    bands_of,
    check_memory,
    is_independent,
    max_samples,
    needs_mitsubas_film,
    pass_seed,
    sampler_of,
    trace_pass,
)

_log = logging.getLogger(__name__)

# Two million samples take some seconds on two cores, so that progress and interrupts are responsive. Passes of large
# pictures have up to eight samples per pixel, as adding a pass to the sum takes one core as long as tracing a third of
# a sample per pixel.
SAMPLES_PER_PASS = 2**21
SAMPLES_PER_PIXEL_OF_LARGE_PICTURES = 8
# The error is estimated from four passes on; a rendering with `until_error` is split into at least sixteen.
_MIN_PASSES_FOR_ERROR = 4
_MIN_PASSES_UNTIL_ERROR = 16
_MAX_PASSES = 10**6  # weeks, at some seconds each
# Two short passes come first: one that compiles, and one that tells early how long the picture takes. Not of pictures
# of some seconds, nor where two passes of any size are at most a tenth of the work.
_SHORT_PASS = 1 / 32  # of the samples per pixel
MIN_SPP_FOR_SHORT_PASSES, MIN_SAMPLES_FOR_SHORT_PASSES, _MAX_PASSES_WITH_SHORT = 16, 2**20, 19
MIN_CHECKPOINT_INTERVAL = 20  # in units of the time that writing a checkpoint takes


@dataclass(frozen=True)
class Job:
    """Everything that determines the bits of a picture, except for the processor; sent to workers.

    Attributes:
        scene: the scene, by its absolute path.
        variant: Mitsuba variant.
        seed: random seed.
        samples: samples per pixel of each pass.
        bands: `trace_pass.bands_of` the scene.
        until_error: see `render`.
        alpha: whether alpha is recorded.
        spectral_range: (shortest, longest) wavelength that is recorded, nm.
        content: digest of the scene, the files it references, and the order of its shapes (`content_of`).
        versions: of the packages involved.
    """

    scene: SceneFile
    variant: str
    seed: int
    samples: tuple[int, ...]
    bands: tuple[Rows, ...]
    until_error: float | None
    alpha: bool
    spectral_range: SpectralRange
    content: str
    versions: tuple[str, ...]

    def digest(self) -> str:
        """Return the SHA-256 of everything but the path of the scene."""
        request = asdict(self)
        del request["scene"]["path"]
        return hashlib.sha256(json.dumps(request, sort_keys=True).encode()).hexdigest()

    def __hash__(self) -> int:
        return hash(self.digest())


# Yields the results of `trace_band` for `first`, `first` + 1, … in order, or None while nothing is being traced; see
# `trace_locally`.
Tracer = Callable[[Job, "mi.Scene", int], Generator["NDArray[np.float32] | None", None, None]]


@dataclass(frozen=True)
class Estimate:
    """What a rendering needs.

    Attributes:
        columns, rows: pixels.
        channels: wavelengths.
        spp: samples per pixel; the maximum with `until_error`.
        memory: bytes, in addition to the scene.
        disk: bytes of the checkpoints of several bands, else zero.
        seconds: to the end.
    """

    columns: int
    rows: int
    channels: int
    spp: int
    memory: int
    disk: int
    seconds: float


class Finished(Exception):
    """A picture of an earlier run satisfies the request."""


class Interrupted(KeyboardInterrupt):
    """Interruption by Ctrl-C between two passes.

    Attributes:
        image: the picture from the passes completed.
    """

    def __init__(self, image: SpectralImage) -> None:
        super().__init__(f"after {image.attributes['spp']} samples per pixel")
        self.image = image


def trace_band(job: Job, scene: mi.Scene, index: int, light: LightOfBands) -> NDArray[np.float32]:
    """Trace number `index` of the bands of all passes, see `BandedSums.done` and `trace_pass`."""
    number, band = divmod(index, len(job.bands))
    return trace_pass(scene, job.samples[number], pass_seed(job.seed, number), None, job.bands[band], light, job.alpha)


def trace_locally(job: Job, scene: mi.Scene, first: int) -> Generator[NDArray[np.float32] | None, None, None]:
    """Trace the bands of the passes of a job from `first` on in this process; see `trace_band`."""
    light = LightOfBands(job.bands)
    for index in range(first, len(job.samples) * len(job.bands)):
        yield trace_band(job, scene, index, light)


def content_of(scene_file: SceneFile, scene: mi.Scene) -> str:
    """Return the digest of a scene, of the files that it references, and of the order of its shapes.

    The order decides which lamp a random number draws. It is that of the file, but inside of Mitsuba's shape `merge` it
    follows addresses in memory (Mitsuba 3.9.1).
    """
    shapes = (f"{shape.class_name()} {shape.id()} {shape.primitive_count()} {shape.bbox()}" for shape in scene.shapes())
    return hashlib.sha256("\n".join([scene_file.digest(), *shapes]).encode()).hexdigest()


def versions() -> tuple[str, ...]:
    """Return the versions of the packages that determine the result of a pass."""
    return tuple(f"{name} {metadata.version(name)}" for name in ("mitsuba", "drjit", "mitsuba_diffraction"))


def render(
    scene_file: SceneFile | str | os.PathLike[str],
    *,
    spp: int,
    seed: int = 0,
    until_error: float | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    seconds: float = 60.0,
    finished: str | None = None,
    tracer: Tracer = trace_locally,
    progress: Callable[[float, float, float], None] = lambda done, total, error: None,
    announce: Callable[[Estimate], None] = lambda estimate: None,
    on_load: Callable[[mi.Scene], object] = lambda scene: None,
    on_checkpoint: Callable[[SpectralImage], object] = lambda image: None,
) -> SpectralImage:
    """Render the first sensor of a scene spectrally, with its own integrator, in the current variant.

    The samples are split into passes with independent seeds, which are added in the order of their indices. The same
    seed therefore gives the same bits (within the limits of `trace_pass`), interrupted or not, on one machine or on
    several.

    Args:
        scene_file: an XML scene, by its path alone if nothing else is requested; its film may be of any kind.
        spp: samples per pixel, four wavelengths each; the scene's sampler may add up to three.
        seed: random seed, not negative.
        until_error: stop when the relative error of the picture (`error_of_picture`) is at most this; spp is then the
            maximum.
        checkpoint: file in which the sums are saved periodically. If it exists, rendering resumes from it. The caller
            removes it after saving the picture (`discard_checkpoints`). Large pictures have several.
        seconds: interval between checkpoints, or twenty times the time that writing one takes (with `on_checkpoint`),
            if that is longer.
        finished: the attribute `digest` of a picture of an earlier run.
        tracer: traces the passes; default: this process, see also `cluster.trace_on`.
        progress: called at the start and after each pass with the samples per pixel done, in total (with `until_error`,
            extrapolated from the current error), and the current error (NaN before four passes).
        announce: called after two passes (of the bands of a large picture: the first compiles), and again after a tenth
            of the work if the time differs by more than a quarter from what was announced.
        on_load: called with the scene before the first pass, unless the picture is `finished`.
        on_checkpoint: called after each checkpoint, while rendering goes on, with the picture so far. To bound memory,
            it is read from the sums block by block.

    Returns:
        The picture; its attributes are the scene, the variant, the samples per pixel, the seed, the error (from four
        passes on) and the digest of the request. A large one is read from its checkpoints when it is saved.

    Raises:
        FileNotFoundError: if there is no such scene.
        ValueError: (a) as for `SceneFile.load`; (b) if a number is out of range; (c) if there is too little memory
            for the picture or too little disk for its bands; (d) if the checkpoint belongs to another rendering or is
            in use.
        RuntimeError: if rendering failed, with the cause on one line.
        OSError: if a checkpoint cannot be written; the previous one is kept.
        Finished: without rendering, if the picture with the digest `finished` satisfies this request.
        Interrupted: at the end of the current pass on the first Ctrl-C, with the picture so far, after a checkpoint.
        KeyboardInterrupt: immediately on the second Ctrl-C, or if no pass has been completed.
    """
    if not isinstance(scene_file, SceneFile):
        scene_file = SceneFile(scene_file)
    job, scene = _job(scene_file, spp, seed, until_error)
    if finished == job.digest():
        raise Finished

    columns, rows = (int(size) for size in scene.sensors()[0].film().crop_size())
    memory = check_memory(scene, max(job.samples), job.bands)
    disk = _check_disk(job, columns, checkpoint)
    max_luminance = max_plausible_luminance(scene)
    on_load(scene)
    channels = channel_wavelengths(job.spectral_range).size
    with nullcontext() if checkpoint is None else exclusive(checkpoint):
        sums = BandedSums(job.bands, job.samples, columns, job.digest(), checkpoint, job.alpha, job.spectral_range)
        complete = _trace(
            job,
            scene,
            sums,
            checkpoint,
            seconds,
            tracer,
            progress,
            lambda remaining: announce(Estimate(columns, rows, channels, sum(job.samples), memory, disk, remaining)),
            on_checkpoint,
        )
    if sums.done < len(job.bands):
        raise KeyboardInterrupt
    _warn_of_implausible_pixels(sums.luminance, max_luminance)
    image = _image(sums, job, Path(scene_file.path).name, complete=complete)
    if not complete:
        raise Interrupted(image)
    return image


def _trace(
    job: Job,
    scene: mi.Scene,
    sums: BandedSums,
    checkpoint: str | os.PathLike[str] | None,
    seconds: float,
    tracer: Tracer,
    progress: Callable[[float, float, float], None],
    announce: Callable[[float], None],
    on_checkpoint: Callable[[SpectralImage], object],
) -> bool:
    """Add passes to the sums until the picture is complete or Ctrl-C was pressed; return whether it is complete."""
    first, work = sums.done, [samples for samples in job.samples for _ in job.bands]
    # Bands and passes differ: the second estimate is made after a tenth of the work, and after all bands.
    tenth = bisect_left(list(accumulate(work[first:])), sum(work[first:]) / 10) + 1
    estimates = {first + 2, first + max(1 + len(job.bands), tenth)}
    spent, before, expected = 0.0, 0.0, 0.0
    complete = _is_complete(sums, job, progress)
    last_checkpoint, interval = time.monotonic(), seconds
    with deferred_interrupt() as interrupted, closing(tracer(job, scene, sums.done)) as traced:
        while not (complete or interrupted()):
            with stage("kernels and first pass" if sums.done == first else "rendering"):
                if (result := next(traced)) is None:
                    continue
                sums.add(result)
                del result
            before, spent = (now := time.perf_counter()), spent + (now - before if sums.done > first + 1 else 0)
            if sums.done in estimates:
                remaining = spent / sum(work[first + 1 : sums.done]) * sum(work[sums.done :])
                if not 0.8 <= (spent + remaining) / (expected or math.inf) <= 1.25:
                    expected = spent + remaining
                    announce(remaining)
            complete = _is_complete(sums, job, progress)
            due = interrupted() or time.monotonic() - last_checkpoint >= interval
            if checkpoint is not None and due and not complete:
                last_checkpoint = time.monotonic()
                sums.save()
                if not interrupted():
                    with stage("preview"):
                        on_checkpoint(BandedImage(sums, {}))
                interval = max(seconds, MIN_CHECKPOINT_INTERVAL * (time.monotonic() - last_checkpoint))
    return complete


def _job(scene_file: SceneFile, spp: int, seed: int, until_error: float | None) -> tuple[Job, mi.Scene]:
    """Check the arguments of `render`; return its job and the scene."""
    if spp < 1:
        raise RequestError(f"spp: got {spp}, wanted a positive number of samples per pixel")
    if seed < 0:
        raise RequestError(f"seed: got {seed}, wanted an integer that is not negative")
    if until_error is not None and not 0 < until_error < 1:
        raise RequestError(f"until_error: got {until_error}, wanted a relative error between 0 and 1, such as 0.01")
    with stage("reading"):
        scene = scene_file.load()
    sampler, whole = scene.sensors()[0].sampler(), needs_mitsubas_film(scene.integrator())
    if whole and not is_independent(sampler):
        _log.warning(
            "sampler: got %s, wanted independent: with this integrator or in this variant its samples are not uniform, "
            "and colours may be wrong by some per cent",
            sampler.class_name(),
        )
    samples = split(scene, spp, 1 if until_error is None else _MIN_PASSES_UNTIL_ERROR)
    with stage("checks"):
        warn_of_gratings(scene)
    job = Job(
        scene=replace(scene_file, path=str(Path(scene_file.path).resolve())),
        variant=mi.variant(),
        seed=seed,
        samples=samples,
        bands=bands_of(scene),
        until_error=until_error,
        alpha=scene_file.has_alpha() and not whole,
        spectral_range=recorded_range(scene),
        content=content_of(scene_file, scene),
        versions=versions(),
    )
    return job, scene


def _check_disk(job: Job, columns: int, checkpoint: str | os.PathLike[str] | None) -> int:
    """Check that the checkpoints of a picture in several bands fit on the disk; return their bytes, while written."""
    bands = job.bands
    if len(bands) == 1:
        return 0
    paths = [] if checkpoint is None else [Path(checkpoint_of_band(checkpoint, band)) for band in range(len(bands))]
    folder = paths[0].absolute().parent if paths else Path(tempfile.gettempdir())
    rows = [end - first for first, end in bands]
    needed = 4 * columns * (channel_wavelengths(job.spectral_range).size + 6) * (sum(rows) + max(rows))
    available = shutil.disk_usage(folder).free + sum(path.stat().st_size for path in paths if path.is_file())
    if needed > available:
        raise RequestError(
            f"{folder}: got {columns} × {bands[-1][1]} pixels, whose checkpoints take {bytes_text(needed)} of the "
            f"disk, wanted at most the {bytes_text(available)} that are free"
        )
    return needed


def _image(sums: BandedSums, job: Job, scene: str, complete: bool) -> SpectralImage:
    """Return the picture so far; only a complete one has the digest of the request."""
    passes = sums.done // len(job.bands)
    attributes: dict[str, str | int | float] = {
        "scene": scene,
        "variant": job.variant,
        "spp": sum(job.samples[:passes]),
        "seed": str(job.seed),
    }
    if passes >= _MIN_PASSES_FOR_ERROR:
        attributes["error"] = error_of_picture(sums.errors)
    if complete:
        attributes["digest"] = job.digest()
    return BandedImage(sums, attributes)


def _warn_of_implausible_pixels(luminance: NDArray[np.float32], limit: float) -> None:
    """Log a warning that names a pixel whose luminance is not finite, or else the brightest one above the limit.

    Another one if all pixels are black.
    """
    luminance = np.abs(luminance)
    if not luminance.any():
        _log.warning("the picture is black: no light reaches the camera; metal shows only lights and lit objects")
    if count := np.count_nonzero(~(luminance <= limit) | np.isinf(luminance)):
        row, column = np.unravel_index(np.argmax(luminance), luminance.shape)  # NaN counts as the maximum
        value = luminance[row, column]
        problem = f"is {value:.2g}, far above the lights of the scene" if np.isfinite(value) else "is not finite"
        _log.warning(
            "luminance %s at pixel x = %d, y = %d (from the top left): %d such pixels", problem, column, row, count
        )


def split(scene: mi.Scene, spp: int, min_passes: int = 1) -> tuple[int, ...]:
    """Return the samples per pixel of each pass; at least `min_passes` passes, if there are enough samples.

    Where they are few, two short ones come first. They are numbers that the sampler draws (`max_samples`). If its
    smallest one does not divide `spp`, the last pass exceeds that. They are determined by the request only, so that an
    interruption does not change the passes.
    """
    sampler = scene.sensors()[0].sampler()
    pixels = math.prod(scene.sensors()[0].film().crop_size())
    passes = -(-spp * pixels // max(SAMPLES_PER_PASS, SAMPLES_PER_PIXEL_OF_LARGE_PICTURES * pixels))
    if passes > _MAX_PASSES:
        raise RequestError(f"spp: got {spp}, wanted at most {_MAX_PASSES * spp // passes:.2g} for so large a picture")
    passes = min(max(passes, min_passes), spp)
    short = 0
    if (
        min_passes == 1
        and passes * len(bands_of(scene)) <= _MAX_PASSES_WITH_SHORT
        and spp >= MIN_SPP_FOR_SHORT_PASSES
        and spp * pixels >= MIN_SAMPLES_FOR_SHORT_PASSES
    ):
        short = max(1, round(_SHORT_PASS * spp))
    rest = spp - 2 * short
    ends = chain([short, 2 * short] if short else [], (2 * short + rest * k // passes for k in range(1, passes)))
    largest, smallest = cache(partial(max_samples, sampler)), sampler_of(sampler, 1).sample_count()
    samples: list[int] = []
    total = 0
    while total < spp:
        end = next(ends, spp)
        if size := largest(end - total) or (smallest if end == spp else 0):
            samples.append(size)
            total += size
    return tuple(samples)


def _is_complete(sums: BandedSums, job: Job, progress: Callable[[float, float, float], None]) -> bool:
    """Report progress and return whether the picture is complete."""
    passes, bands = divmod(sums.done, len(job.bands))
    error = error_of_picture(sums.errors) if passes >= _MIN_PASSES_FOR_ERROR else math.nan
    done: float = sum(job.samples[:passes])
    if bands:
        done += round(job.samples[passes] * bands / len(job.bands), 2)
    total: float = sum(job.samples)
    expected = total
    if job.until_error is not None and not math.isnan(error):
        # The error falls with the square root of the number of samples.
        expected = min(total, max(done, round(done * (error / job.until_error) ** 2)))
    progress(done, expected, error)
    return not bands and (passes == len(job.samples) or (job.until_error is not None and error <= job.until_error))


@contextmanager
def deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Yield a function that returns whether Ctrl-C was pressed; a second one interrupts at once.

    An exception between two statements could make the sums inconsistent with their count. Where SIGTERM interrupts like
    Ctrl-C, as in a command, it is deferred alike. Python handles signals only in the main thread. Signals that are
    ignored, as SIGINT in background jobs of a script, stay ignored.
    """
    before = {number: signal.getsignal(number) for number in (signal.SIGINT, signal.SIGTERM)}
    handlers = {number: handler for number, handler in before.items() if callable(handler)}
    if threading.current_thread() is not threading.main_thread():
        handlers = {}
    pressed = threading.Event()
    # The handler of the command line has already raised an exception, which other code has suppressed.
    if any(getattr(handler, "pressed", False) for handler in handlers.values()):
        pressed.set()

    def restore() -> None:
        for number, handler in handlers.items():
            signal.signal(number, handler)

    def on_first_press(number: int, frame: object) -> None:
        pressed.set()
        restore()

    for number in handlers:
        signal.signal(number, on_first_press)
    try:
        yield pressed.is_set
    finally:
        restore()
