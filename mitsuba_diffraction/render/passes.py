"""Path-trace a scene in passes."""

from __future__ import annotations

import hashlib
import json
import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, contextmanager
from dataclasses import asdict, dataclass
from importlib import metadata
from itertools import pairwise
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError
from .accumulation import Accumulation
from .checkpoint import load_checkpoint, save_checkpoint
from .film import pass_seed, samples_drawn, trace_pass
from .scene import channel_wavelengths, load_spectral_scene, scene_digest
from .spectral_image import SpectralImage

# Two million take some seconds on two cores, so that progress shows and an interrupt is heard. A large picture gets
# eight samples per pixel nevertheless: adding a pass to the sum takes one core as long as a third of a sample.
_SAMPLES_PER_PASS = 2**21
_LEAST_SAMPLES_PER_PIXEL = 8
# Where the noise decides when to stop, it is estimated from the passes: from four on, and of sixteen at least.
_PASSES_TO_JUDGE = 4
_LEAST_PASSES_TO_CONVERGE = 16
# Of seconds each: weeks.
_MOST_PASSES = 10**6
# Of the time at most a twentieth goes into checkpoints, however large they are.
_CHECKPOINT_SHARE = 20


@dataclass(frozen=True)
class Job:
    """All that decides the bits of a picture, apart from the processor. Processes pass it to each other.

    Attributes:
        scene: absolute path of the XML file.
        width, height, parameters, motion: as for `load_spectral_scene`.
        variant: of Mitsuba.
        seed: of the random numbers.
        samples: samples per pixel of each pass.
        until_error: as for `render`.
        content: of the scene and the files that it names (`scene_digest`).
        versions: of the packages that trace.
    """

    scene: str
    width: int | None
    height: int | None
    parameters: tuple[tuple[str, str], ...]
    motion: tuple[float, ...] | None
    variant: str
    seed: int
    samples: tuple[int, ...]
    until_error: float | None
    content: str
    versions: tuple[str, ...]

    def digest(self) -> str:
        """SHA-256 of everything but the place of the scene."""
        told = {name: value for name, value in asdict(self).items() if name != "scene"}
        return hashlib.sha256(json.dumps(told, sort_keys=True).encode()).hexdigest()

    def load(self) -> mi.Scene:
        """The scene; errors are those of `load_spectral_scene`."""
        return load_spectral_scene(
            self.scene, width=self.width, height=self.height, parameters=dict(self.parameters), motion=self.motion
        )


# Gives the passes `first`, `first` + 1, … of a job, one after the other; see `trace_here`.
Tracer = Callable[[Job, "mi.Scene", int], Iterator[NDArray[np.float32]]]


class Interrupted(KeyboardInterrupt):
    """Ctrl-C between two passes.

    Attributes:
        image: the picture from the passes so far.
    """

    def __init__(self, image: SpectralImage) -> None:
        super().__init__(f"after {image.attributes['spp']} samples per pixel")
        self.image = image


def trace_here(job: Job, scene: mi.Scene, first: int) -> Iterator[NDArray[np.float32]]:
    """The passes of a job from `first` on, traced in this process; see `trace_pass`."""
    for index in range(first, len(job.samples)):
        yield trace_pass(scene, job.samples[index], pass_seed(job.seed, index))


def versions() -> tuple[str, ...]:
    """Of the packages that decide what a pass gives."""
    return tuple(f"{name} {metadata.version(name)}" for name in ("mitsuba", "drjit", "mitsuba_diffraction"))


def render(
    scene_path: str | os.PathLike[str],
    *,
    spp: int,
    width: int | None = None,
    height: int | None = None,
    seed: int = 0,
    parameters: Mapping[str, str] | None = None,
    motion: tuple[float, ...] | None = None,
    until_error: float | None = None,
    checkpoint: str | os.PathLike[str] | None = None,
    seconds: float = 60.0,
    finished: SpectralImage | None = None,
    tracer: Tracer = trace_here,
    progress: Callable[[int, int, float], None] = lambda done, total, error: None,
) -> SpectralImage:
    """Renders the first sensor of a scene with its own integrator, spectrally, under the current variant.

    The samples are split into passes with independent seeds. Passes are added in float64 in the order of their number,
    wherever and whenever they were traced: the same seed gives the same bits (within the limits of `trace_pass`),
    interrupted or not, on one machine or on several.

    Args:
        scene_path: an XML scene; its film may be of any kind (see `load_spectral_scene`).
        spp: samples per pixel, four wavelengths each; the scene's sampler may round it up.
        width: pixels, if the film's size shall not hold.
        height: likewise.
        seed: of the random numbers, not negative.
        parameters: values for the scene's `$name` parameters.
        motion: of the camera, as for `load_spectral_scene`.
        until_error: stop as soon as the picture's relative error (`Accumulation.error`) is not above this; spp is then
            the most that is taken.
        checkpoint: the file where the sums are kept every so often. If it is there, rendering goes on from it. It stays
            when the picture is done: who has saved the picture removes it.
        seconds: between two checkpoints, or twenty times as long as one takes to write, if that is longer.
        finished: a picture of an earlier run; it is given back if it is what was asked for, and nothing is traced.
        tracer: who traces the passes; this process by default, see `cluster.trace_on`.
        progress: called with the samples per pixel done, those to be done (with `until_error`, as many as the noise so
            far lets expect), and the error so far (not a number before four passes), at the start and after each pass.

    Returns:
        The picture; radiance per nm at `channel_wavelengths()`. Its attributes name the scene, the variant, the samples
        per pixel, the seed, the error (if there were four passes), and the digest of the request that it fulfils.

    Raises:
        FileNotFoundError: if there is no such scene.
        ValueError: if the request is wrong, as for `load_spectral_scene`, a number is out of range, or the checkpoint
            is not one of this rendering.
        RuntimeError: if rendering failed, with the cause in one line.
        OSError: if a checkpoint cannot be written; the last one is still whole.
        Interrupted: on the first Ctrl-C, at the end of the pass, with the picture so far and the checkpoint written.
        KeyboardInterrupt: on the second Ctrl-C, at once, or if there is no pass yet.
    """
    if spp < 1:
        raise RequestError(f"spp: got {spp}, wanted a positive number of samples per pixel")
    if seed < 0:
        raise RequestError(f"seed: got {seed}, wanted an integer that is not negative")
    if until_error is not None and not 0 < until_error < 1:
        raise RequestError(f"until_error: got {until_error}, wanted a relative error between 0 and 1, such as 0.01")
    where = {"width": width, "height": height, "parameters": dict(parameters or {}), "motion": motion}
    scene = load_spectral_scene(scene_path, **where)
    columns, rows = (int(size) for size in scene.sensors()[0].film().crop_size())
    job = Job(
        scene=str(Path(scene_path).resolve()),
        width=width,
        height=height,
        parameters=tuple(sorted(where["parameters"].items())),
        motion=motion,
        variant=mi.variant(),
        seed=seed,
        samples=split(scene, spp, 1 if until_error is None else _LEAST_PASSES_TO_CONVERGE),
        until_error=until_error,
        content=scene_digest(scene_path, parameters),
        versions=versions(),
    )
    if finished is not None and finished.attributes.get("digest") == job.digest():
        return finished

    sums = None if checkpoint is None else load_checkpoint(checkpoint, job.digest())
    saved = 0 if sums is None else sums.samples
    if sums is None:
        sums = Accumulation.empty(rows, columns, channel_wavelengths())
    ends = _judge(sums, job, progress)
    last, wait = time.monotonic(), seconds
    with _deferred_interrupt() as interrupted, closing(tracer(job, scene, sums.passes)) as traced:
        while not (ends or interrupted()):
            sums.add(next(traced), job.samples[sums.passes])
            ends = _judge(sums, job, progress)
            due = interrupted() or time.monotonic() - last >= wait
            if checkpoint is not None and due and not ends:
                last = time.monotonic()
                _save(checkpoint, job, sums, saved)
                saved = sums.samples
                wait = max(seconds, _CHECKPOINT_SHARE * (time.monotonic() - last))
    if not sums.passes:
        raise KeyboardInterrupt
    attributes = {"scene": Path(scene_path).name, "variant": job.variant, "spp": sums.samples, "seed": str(seed)}
    if sums.passes >= _PASSES_TO_JUDGE:
        attributes["error"] = sums.error()
    if not ends:
        raise Interrupted(SpectralImage(sums.wavelengths, sums.radiance(), attributes))
    return SpectralImage(sums.wavelengths, sums.radiance(), {**attributes, "digest": job.digest()})


def split(scene: mi.Scene, spp: int, least: int = 1) -> tuple[int, ...]:
    """Samples per pixel of each pass of a picture; `least` passes or more, as far as there are samples for them.

    Nothing but the request decides, so that an interrupt changes no pass.
    """
    pixels = math.prod(scene.sensors()[0].film().crop_size())
    passes = -(-spp * pixels // max(_SAMPLES_PER_PASS, _LEAST_SAMPLES_PER_PIXEL * pixels))
    if passes > _MOST_PASSES:
        raise RequestError(f"spp: got {spp}, wanted at most {_MOST_PASSES * spp // passes:.2g} for so large a picture")
    passes = min(max(passes, least), spp)
    ends = [spp * index // passes for index in range(passes + 1)]
    return tuple(samples_drawn(scene, end - start) for start, end in pairwise(ends))


def _judge(sums: Accumulation, job: Job, progress: Callable[[int, int, float], None]) -> bool:
    """Tells the progress, and gives whether the picture is done."""
    error = sums.error() if sums.passes >= _PASSES_TO_JUDGE else math.nan
    expected = total = sum(job.samples)
    if job.until_error is not None and not math.isnan(error):
        # The error falls with the root of the samples.
        expected = min(total, max(sums.samples, round(sums.samples * (error / job.until_error) ** 2)))
    progress(sums.samples, expected, error)
    return sums.passes == len(job.samples) or (job.until_error is not None and error <= job.until_error)


def _save(checkpoint: str | os.PathLike[str], job: Job, sums: Accumulation, saved: int) -> None:
    try:
        save_checkpoint(checkpoint, job.digest(), sums)
    except OSError as error:
        left = f"the last one, of {saved} samples per pixel, is whole" if saved else "there is none yet"
        raise OSError(f"{os.fspath(checkpoint)}: cannot be written ({error.strerror or error}); {left}") from error


@contextmanager
def _deferred_interrupt() -> Iterator[Callable[[], bool]]:
    """Gives what tells whether there was a Ctrl-C; a second one interrupts at once.

    An exception between two statements would leave the sums and their count in disagreement. Python hears signals in
    the main thread alone; where Ctrl-C is ignored, as in what a script starts in the background, it stays ignored.
    """
    before = signal.getsignal(signal.SIGINT)
    if threading.current_thread() is not threading.main_thread() or before in (signal.SIG_IGN, None):
        yield lambda: False
        return
    asked = threading.Event()

    def note(number: int, frame: object) -> None:
        asked.set()
        signal.signal(signal.SIGINT, before)

    signal.signal(signal.SIGINT, note)
    try:
        yield asked.is_set
    finally:
        signal.signal(signal.SIGINT, before)
