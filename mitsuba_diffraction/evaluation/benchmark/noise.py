"""Noise of pictures at equal time: a scene with its gratings, and with Mitsuba's roughconductor in their place."""

from __future__ import annotations

import os
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...files.writing import examples_folder
from ...optics.color import spectrum_to_linear_sRGB
from ...progress import Progress, silent
from ...render.film import pass_seed, trace_pass
from ...render.parsed_scene import parsed
from ...render.passes import Accumulation
from ...render.scene import instantiated
from ...render.scene_film import channel_wavelengths, replace_films
from ...render.scene_light import draw_wavelengths_of_lights
from ...settings import VISIBLE
from ..comparison.series import shows_gratings

SCENES = ("xenopeltis", "elaphe", "compact_disc", "foil", "hologram", "rainbow")
DEPTHS = (2, 6)  # direct light alone; more
_ALPHA = 0.08  # of the roughconductor
_WAVELENGTH, _HALF_WIDTH = 550.0, 1.2  # nm

NOISE_COLUMNS = {
    "scene": "{.scene}",
    "depth": "{.depth}",
    "time": "{.time:.2f}",
    "noise²\non gratings": "{.on_gratings:.2f}",
    "noise²\nof the picture": "{.of_picture:.2f}",
    "noise² of\none wavelength": "{.of_one_wavelength:.2f}",
    "noise² × time\non gratings": "{.on_gratings_at_equal_time:.2f}",
    "noise² × time\nof the picture": "{.of_picture_at_equal_time:.2f}",
}


@dataclass(frozen=True)
class Noise:
    """A picture relative to the same with roughconductor in place of the gratings, at equal samples.

    Attributes:
        scene: name of its file, without extension.
        depth: `max_depth` of the path tracer.
        seconds: of processor time of the picture.
        time: ratio of the times.
        on_gratings: ratio of noise², the variance of linear sRGB over the square of its mean, on pixels that show
            gratings.
        of_picture: likewise, of all pixels.
        of_one_wavelength: like `on_gratings`, where all rays have nearly the same wavelength: without the noise of
            lobes that a ray meets at one of its four wavelengths only.
    """

    scene: str
    depth: int
    seconds: float
    time: float
    on_gratings: float
    of_picture: float
    of_one_wavelength: float

    @property
    def on_gratings_at_equal_time(self) -> float:
        """Ratio of noise² × time on pixels that show gratings."""
        return self.on_gratings * self.time

    @property
    def of_picture_at_equal_time(self) -> float:
        """Ratio of noise² × time of all pixels."""
        return self.of_picture * self.time


def measure_noise(
    scenes: Sequence[str | os.PathLike[str]] = (),
    *,
    depths: Sequence[int] = DEPTHS,
    width: int = 144,
    samples: int = 32,
    pictures: int = 4,
    progress: Progress = silent,
) -> list[Noise]:
    """Measure under the current variant; pictures with and without gratings alternate, in one process.

    Args:
        scenes: XML files; default: `SCENES` of the package.
        depths: `max_depth` of the path tracer.
        width: of the pictures, pixels.
        samples: per pixel, independent.
        pictures: of each kind, from which the variance of a pixel and the median of times are taken.
        progress: called with (steps done, steps in total).
    """
    paths = [Path(scene) for scene in scenes] or [examples_folder() / "scenes" / f"{name}.xml" for name in SCENES]
    found: list[Noise] = []
    total = len(paths) * len(depths) * (2 * pictures + 1)
    for path in paths:
        for depth in depths:
            done = len(found) * (2 * pictures + 1)
            pair = [load_for_noise(path, width, depth, gratings) for gratings in (True, False)]
            shown = shows_gratings(pair[0])
            times, radiance = np.zeros((2, pictures)), np.zeros((2, pictures, *shown.shape, channel_wavelengths().size))
            for index in range(-1, pictures):  # the first compiles
                for kind, scene in enumerate(pair):
                    begin = time.process_time()
                    picture = _radiance(scene, samples, index + 1)
                    if index >= 0:
                        times[kind, index], radiance[kind, index] = time.process_time() - begin, picture
                progress(done + index + 2, total)
            grating, rough = spectrum_to_linear_sRGB(radiance, channel_wavelengths())
            ratios = [relative_noise(grating, some) / relative_noise(rough, some) for some in (shown, shown | True)]
            for scene in pair:
                _draw_one_wavelength(scene)
            for index in range(pictures):
                for kind, scene in enumerate(pair):
                    radiance[kind, index] = _radiance(scene, samples, index)
                progress(done + pictures + index + 2, total)
            grating, rough = radiance.sum(axis=-1, keepdims=True)
            ratios.append(relative_noise(grating, shown) / relative_noise(rough, shown))
            median = np.median(times, axis=1)
            found.append(Noise(path.stem, depth, median[0], median[0] / median[1], *ratios))
    return found


def relative_noise(pictures: NDArray[np.float64], where: NDArray[np.bool_]) -> float:
    """Return the variance of pixels over the square of their mean, each a mean over the pixels in `where`.

    Args:
        pictures: independent ones of the same expectation, (pictures, rows, columns, 3).
        where: (rows, columns).
    """
    chosen = pictures[:, where]
    variance = chosen.var(axis=0, ddof=1).mean()
    return float(variance / ((chosen.mean(axis=0) ** 2).mean() - variance / len(chosen)))


def load_for_noise(path: Path, width: int, depth: int, gratings: bool) -> mi.Scene:
    """Load a scene with independent samples and the path tracer, with roughconductor in place of `gratings` or not."""
    with parsed(path, None) as (config, state):
        replace_films(state, width, None)
        for node in state.nodes:
            if node.type == mi.ObjectType.Integrator:
                node.props = mi.Properties("path")
                node.props["max_depth"] = depth
            elif node.type == mi.ObjectType.Sampler:
                node.props = mi.Properties("independent")
            elif node.props.plugin_name() == "diffraction_grating" and not gratings:
                identifier, node.props = node.props.id(), mi.Properties("roughconductor")
                node.props.set_id(identifier)
                node.props["material"], node.props["alpha"] = "Al", _ALPHA
        scene = instantiated(config, state)
    draw_wavelengths_of_lights(scene)
    return scene


def _radiance(scene: mi.Scene, samples: int, seed: int) -> NDArray[np.float32]:
    """Return the radiance of a picture, (rows, columns, channels)."""
    columns, rows = scene.sensors()[0].film().crop_size()
    sums = Accumulation.empty(rows, columns)
    sums.add(trace_pass(scene, samples, pass_seed(seed, 0)), samples)
    return sums.radiance()


def _draw_one_wavelength(scene: mi.Scene) -> None:
    """Make the first sensor draw wavelengths near `_WAVELENGTH` only."""
    distribution = mi.traverse(scene.sensors()[0].film().sensor_response_function())
    values = np.array(distribution["values"])
    far = np.abs(np.linspace(*VISIBLE, values.size) - _WAVELENGTH) > _HALF_WIDTH
    distribution["values"] = type(distribution["values"])(np.where(far, 0, values).astype(np.float32))
    distribution.update()
