"""Noise of pictures at equal time: `diffraction_path` beside `path`, and beside BSDFs of Mitsuba's for the gratings."""

from __future__ import annotations

import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...files.writing import examples_folder
from ...optics.color import radiance_to_linear_sRGB
from ...progress import Progress, silent
from ...render.scene import instantiated, shows_gratings
from ...render.scene_file import SceneFile
from ...render.scene_light import draw_wavelengths_of_lights
from ...render.spectral_film import channel_wavelengths, replace_films
from ...render.sums import Accumulation
from ...render.trace_pass import LightOfBands, bands_of, pass_seed, trace_pass
from .measured import write_measured

SCENES = ("xenopeltis", "elaphe", "compact_disc", "foil", "hologram", "rainbow")
SKINS = ("xenopeltis", "elaphe")  # held against `measured`, too
DEPTHS = (2, 6)  # direct light alone; more
_ALPHA = 0.08  # of the roughconductor

NOISE_COLUMNS = {
    "scene": "{.scene}",
    "beside": "{.beside}",
    "depth": "{.depth}",
    "time": "{.time:.2f}",
    "noise²\non gratings": "{.on_gratings:.2f}",
    "noise²\nof the picture": "{.of_picture:.2f}",
    "noise² × time\non gratings": "{.on_gratings_at_equal_time:.2f}",
    "noise² × time\nof the picture": "{.of_picture_at_equal_time:.2f}",
}


@dataclass(frozen=True)
class Noise:
    """A picture by `diffraction_path`, relative to one by `path` at equal samples.

    Attributes:
        scene: name of its file, without extension.
        beside: what the other picture has in place of the gratings: `roughconductor`, or `measured` with a synthetic
            lobe (`write_measured`); "path" if it has the gratings, too.
        depth: `max_depth` of the path tracer.
        seconds: of processor time of the picture.
        time: ratio of the times.
        on_gratings: ratio of noise², the variance of linear sRGB over the square of its mean, on pixels that show
            gratings.
        of_picture: likewise, of all pixels.
    """

    scene: str
    beside: str
    depth: int
    seconds: float
    time: float
    on_gratings: float
    of_picture: float

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
    width: int = 192,
    samples: int = 32,
    pictures: int = 4,
    progress: Progress = silent,
) -> list[Noise]:
    """Measure under the current variant; the pictures that are compared alternate, in one process.

    Args:
        scenes: XML files; default: `SCENES` of the package.
        depths: `max_depth` of the integrators.
        width: of the pictures, pixels.
        samples: per pixel, independent.
        pictures: of each kind, from which the variance of a pixel and the median of times are taken.
        progress: called with (steps done, steps in total).
    """
    paths = [Path(scene) for scene in scenes] or [examples_folder() / "scenes" / f"{name}.xml" for name in SCENES]
    cases = [(path, depth) for path in paths for depth in depths]
    found = []
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "synthetic.bsdf"
        write_measured(table)
        rough = {"type": "roughconductor", "material": "Al", "alpha": _ALPHA}
        tabulated = {"type": "measured", "filename": str(table)}
        for number, (path, depth) in enumerate(cases, 1):
            others: dict[str, dict[str, Any] | None] = {"path": None, "roughconductor": rough}
            if path.stem in SKINS:
                others["measured"] = tabulated
            kinds = [load_for_noise(path, width, None, type="diffraction_path", max_depth=depth)]
            kinds += [load_for_noise(path, width, other, max_depth=depth) for other in others.values()]
            shown = shows_gratings(kinds[0])
            times, radiance = _alternating(kinds, samples, pictures)
            own, *theirs = radiance_to_linear_sRGB(radiance, channel_wavelengths())
            for beside, time_of_it, of_it in zip(others, times[1:], theirs, strict=True):
                ratios = [relative_noise(own, some) / relative_noise(of_it, some) for some in (shown, shown | True)]
                found.append(Noise(path.stem, beside, depth, times[0], times[0] / time_of_it, *ratios))
            progress(number, len(cases))
    return found


def _alternating(
    kinds: Sequence[mi.Scene], samples: int, pictures: int
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Render pictures of all kinds in turn: medians of seconds of processor time, and (kinds, pictures, …) radiance."""
    times, radiance = np.zeros((len(kinds), pictures)), []
    lights = [LightOfBands(bands_of(scene)) for scene in kinds]  # prepared with the first picture
    for index in range(-1, pictures):  # the first compiles
        for kind, scene in enumerate(kinds):
            begin = time.process_time()
            picture = _radiance(scene, samples, index + 1, lights[kind])
            if index >= 0:
                times[kind, index] = time.process_time() - begin
                radiance.append(picture)
    return np.median(times, axis=1), np.stack(radiance).reshape(pictures, len(kinds), *picture.shape).swapaxes(0, 1)


def relative_noise(pictures: NDArray[np.float64], where: NDArray[np.bool_]) -> float:
    """Return the variance of pixels over the square of their mean, each a mean over the pixels in `where`.

    Args:
        pictures: independent ones of the same expectation, (pictures, rows, columns, 3).
        where: (rows, columns).
    """
    chosen = pictures[:, where]
    variance = chosen.var(axis=0, ddof=1).mean()
    return float(variance / ((chosen.mean(axis=0) ** 2).mean() - variance / len(chosen)))


def load_for_noise(
    path: Path, width: int, partner: dict[str, Any] | None, type: str = "path", **integrator: int
) -> mi.Scene:
    """Load a scene with independent samples and another integrator; `partner` replaces its gratings, if given."""
    with SceneFile(path).parsed() as (config, state):
        replace_films(state, width, None)
        for node in state.nodes:
            if node.type == mi.ObjectType.Integrator:
                node.props = _properties({"type": type, **integrator})
            elif node.type == mi.ObjectType.Sampler:
                node.props = mi.Properties("independent")
            elif node.props.plugin_name() == "diffraction_grating" and partner is not None:
                identifier, node.props = node.props.id(), _properties(partner)
                node.props.set_id(identifier)
        scene = instantiated(config, state)
    draw_wavelengths_of_lights(scene)
    return scene


def _properties(values: dict[str, Any]) -> mi.Properties:
    """Return the parameters of a plugin without nested ones."""
    properties = mi.Properties(values["type"])
    for name, value in values.items():
        if name != "type":
            properties[name] = value
    return properties


def _radiance(scene: mi.Scene, samples: int, seed: int, light: LightOfBands) -> NDArray[np.float32]:
    """Return the radiance of a picture of a single band, (rows, columns, channels)."""
    columns, rows = scene.sensors()[0].film().crop_size()
    sums = Accumulation.empty(rows, columns)
    sums.add(trace_pass(scene, samples, pass_seed(seed, 0), rows=(0, int(rows)), light=light), samples)
    return sums.radiance()
