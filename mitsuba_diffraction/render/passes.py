"""Path-trace a scene in passes."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from pathlib import Path

import mitsuba as mi
import numpy as np

from .scene import channel_wavelengths, channel_weights, load_spectral_scene, root_cause
from .spectral_image import SpectralImage

# Two million take some seconds on two cores, so that progress shows and an interrupt is heard.
_SAMPLES_PER_PASS = 2**21


def render(
    scene_path: str | os.PathLike[str],
    *,
    spp: int,
    width: int | None = None,
    height: int | None = None,
    seed: int = 0,
    parameters: Mapping[str, str] | None = None,
    progress: Callable[[int, int], None] = lambda done, total: None,
) -> SpectralImage:
    """Renders the first sensor of a scene with its own integrator, spectrally, under the current variant.

    The samples are split into passes of about two million with independent seeds, accumulated in float64. The same
    seed gives the same picture.

    Args:
        scene_path: an XML scene; its film may be of any kind (see `load_spectral_scene`).
        spp: samples per pixel, four wavelengths each.
        width: pixels, if the film's size shall not hold.
        height: likewise.
        seed: of the random numbers, not negative.
        parameters: values for the scene's `$name` parameters.
        progress: called with (done, total) samples per pixel after each pass.

    Returns:
        The picture; radiance per nm at `channel_wavelengths()`.

    Raises:
        FileNotFoundError: if there is no such scene.
        ValueError: if the request is wrong, as for `load_spectral_scene`, or spp or seed is out of range.
        RuntimeError: if rendering failed, with the cause in one line.
        KeyboardInterrupt: as it comes; nothing has been written.
    """
    if spp < 1:
        raise ValueError(f"spp: got {spp}, wanted a positive number of samples per pixel")
    if seed < 0:
        raise ValueError(f"seed: got {seed}, wanted an integer that is not negative")
    scene = load_spectral_scene(scene_path, width=width, height=height, parameters=parameters)
    wavelengths = channel_wavelengths()
    columns, rows = scene.sensors()[0].film().crop_size()
    total = np.zeros((rows, columns, wavelengths.size))
    done = 0
    passes = min(spp, -(-spp * rows * columns // _SAMPLES_PER_PASS))
    for index in range(passes):
        samples = spp * (index + 1) // passes - done
        total += samples * _render_pass(scene, samples, _pass_seed(seed, index))
        done += samples
        progress(done, spp)
    attributes = {"scene": Path(scene_path).name, "variant": mi.variant(), "spp": spp, "seed": str(seed)}
    return SpectralImage(wavelengths, total / (spp * channel_weights()), attributes)


def _pass_seed(seed: int, index: int) -> int:
    """A 32-bit seed for one pass, independent of those of its neighbours and of other `seed`s."""
    return int(np.random.SeedSequence((seed, index)).generate_state(1)[0])


def _render_pass(scene: mi.Scene, spp: int, seed: int) -> np.ndarray:
    """One pass, (height, width, n) float32."""
    try:
        return np.array(mi.render(scene, spp=spp, seed=seed))
    except Exception as error:
        raise RuntimeError(f"rendering failed: {root_cause(error)}") from error
