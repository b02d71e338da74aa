"""Noise of pictures at equal time: a scene with its gratings, and with a BSDF of Mitsuba's in their place."""

from __future__ import annotations

import itertools
import os
import tempfile
import time
from collections.abc import Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...files.writing import examples_folder
from ...optics.color import spectrum_to_linear_sRGB
from ...progress import Progress, silent
from ...render.scene import instantiated
from ...render.scene_file import SceneFile
from ...render.scene_light import draw_wavelengths_of_lights
from ...render.spectral_film import channel_wavelengths, replace_films
from ...render.sums import Accumulation
from ...render.trace_pass import pass_seed, trace_pass
from ...settings import VISIBLE
from ...shader_2014.comparison.series import shows_gratings
from .measured import write_measured
from .perfect_sampling import sample_perfectly

SCENES = ("xenopeltis", "elaphe", "compact_disc", "foil", "hologram", "rainbow")
SKINS = ("xenopeltis", "elaphe")  # held against `measured`, too
DEPTHS = (2, 6)  # direct light alone; more
_ALPHA = 0.08  # of the roughconductor
_WAVELENGTH, _HALF_WIDTH = 550.0, 1.2  # nm
_FOUR, _MANY = 4, 16  # samples at a point

NOISE_COLUMNS = {
    "scene": "{.scene}",
    "beside": "{.beside}",
    "depth": "{.depth}",
    "time": "{.time:.2f}",
    "noise²\non gratings": "{.on_gratings:.2f}",
    "noise²\nof the picture": "{.of_picture:.2f}",
    "noise² of\none wavelength": "{.of_one_wavelength:.2f}",
    "noise² × time\non gratings": "{.on_gratings_at_equal_time:.2f}",
    "noise² × time\nof the picture": "{.of_picture_at_equal_time:.2f}",
}
BOUNDS_COLUMNS = {
    "scene": "{.scene}",
    "perfect\nsampling": "{.perfect:.2f}",
    "beside\nroughconductor": "{.perfect_beside_roughconductor:.2f}",
    "four samples:\ntime": "{.time_of_four:.2f}",
    "\nnoise²": "{.four:.2f}",
    "\nnoise² × time": "{.four_at_equal_time:.2f}",
    "\nall samples": "{.all:.2f}",
    "\nbeside\nroughconductor": "{.all_beside_roughconductor:.2f}",
}


@dataclass(frozen=True)
class Noise:
    """A picture relative to the same with another BSDF in place of the gratings, at equal samples.

    Attributes:
        scene: name of its file, without extension.
        beside: the other BSDF: `roughconductor`, or `measured` with a synthetic lobe (`write_measured`).
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
    beside: str
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


@dataclass(frozen=True)
class Bounds:
    """Noise² of direct light on pixels that show gratings, by more work at each point that a ray hits.

    All are relative to one sample of the BSDF and one of the lights, as `path` takes them. With n of each, noise² is
    V_∞ + (V_1 − V_∞)/n; V_∞ remains if the light that a point reflects at the four wavelengths of a ray is known
    exactly.

    Attributes:
        scene: name of its file, without extension.
        perfect: by one sample of each, and a density proportional to the mean of f cos θ_o over the wavelengths.
        perfect_beside_roughconductor: the same, relative to `roughconductor` in place of the gratings.
        time_of_four, four: time and noise² by four samples of the BSDF and one of the lights.
        all: V_∞, from n = 1 and 16.
        all_beside_roughconductor: V_∞, relative to one sample of each with `roughconductor`.
    """

    scene: str
    perfect: float
    perfect_beside_roughconductor: float
    time_of_four: float
    four: float
    all: float
    all_beside_roughconductor: float

    @property
    def four_at_equal_time(self) -> float:
        """Ratio of noise² × time by four samples of the BSDF."""
        return self.four * self.time_of_four


def measure_noise(
    scenes: Sequence[str | os.PathLike[str]] = (),
    *,
    depths: Sequence[int] = DEPTHS,
    width: int = 144,
    samples: int = 32,
    pictures: int = 4,
    progress: Progress = silent,
) -> tuple[list[Noise], list[Bounds]]:
    """Measure under the current variant; the pictures that are compared alternate, in one process.

    Args:
        scenes: XML files; default: `SCENES` of the package.
        depths: `max_depth` of the path tracer.
        width: of the pictures, pixels.
        samples: per pixel, independent.
        pictures: of each kind, from which the variance of a pixel and the median of times are taken.
        progress: called with (steps done, steps in total).
    """
    paths = [Path(scene) for scene in scenes] or [examples_folder() / "scenes" / f"{name}.xml" for name in SCENES]
    with tempfile.TemporaryDirectory() as folder:
        table = Path(folder) / "synthetic.bsdf"
        write_measured(table)
        rough = {"type": "roughconductor", "material": "Al", "alpha": _ALPHA}
        tabulated = {"type": "measured", "filename": str(table)}
        pairs = [
            (path, partner, depth)
            for path in paths
            for partner in (rough, tabulated)
            if partner is rough or path.stem in SKINS
            for depth in depths
        ]
        total, count = len(pairs) + len(paths), itertools.count(1)
        found = []
        for path, partner, depth in pairs:
            scenes_of_pair = [load_for_noise(path, width, other, max_depth=depth) for other in (None, partner)]
            found.append(_noise(path.stem, str(partner["type"]), depth, scenes_of_pair, samples, pictures))
            progress(next(count), total)
        bounds = []
        for path in paths:
            shadings = [(None, 1), (None, 1), (None, _FOUR), (rough, 1)]
            of_path = [
                load_for_noise(path, width, other, type="direct", bsdf_samples=directions)
                for other, directions in shadings
            ]
            sample_perfectly(of_path[1])
            bounds.append(_bounds(path.stem, of_path, samples, pictures))
            progress(next(count), total)
    return found, bounds


def _noise(name: str, beside: str, depth: int, pair: list[mi.Scene], samples: int, pictures: int) -> Noise:
    shown = shows_gratings(pair[0])
    times, radiance = _alternating(_as_they_are(pair), samples, pictures)
    grating, other = spectrum_to_linear_sRGB(radiance, channel_wavelengths())
    ratios = [relative_noise(grating, some) / relative_noise(other, some) for some in (shown, shown | True)]
    for scene in pair:
        _draw_one_wavelength(scene)
    grating, other = _alternating(_as_they_are(pair), samples, pictures)[1].sum(axis=-1, keepdims=True)
    ratios.append(relative_noise(grating, shown) / relative_noise(other, shown))
    return Noise(name, beside, depth, times[0], times[0] / times[1], *ratios)


def _bounds(name: str, scenes: list[mi.Scene], samples: int, pictures: int) -> Bounds:
    shown = shows_gratings(scenes[0])
    many_samples = scenes[0], _averaging(mi.variant())(scenes[0].integrator())
    times, radiance = _alternating([*_as_they_are(scenes), many_samples], samples, pictures)
    one, perfect, four, rough, many = (
        relative_noise(kind, shown) for kind in spectrum_to_linear_sRGB(radiance, channel_wavelengths())
    )
    rest = max((_MANY * many - one) / (_MANY - 1), 0.0)
    return Bounds(name, perfect / one, perfect / rough, times[2] / times[0], four / one, rest / one, rest / rough)


def _as_they_are(scenes: Sequence[mi.Scene]) -> list[tuple[mi.Scene, mi.SamplingIntegrator]]:
    """Return scenes with the integrators that they have."""
    return [(scene, scene.integrator()) for scene in scenes]


def _alternating(
    kinds: Sequence[tuple[mi.Scene, mi.SamplingIntegrator]], samples: int, pictures: int
) -> tuple[NDArray[np.float64], NDArray[np.float32]]:
    """Render pictures of all kinds in turn: medians of seconds of processor time, and (kinds, pictures, …) radiance."""
    times, radiance = np.zeros((len(kinds), pictures)), []
    for index in range(-1, pictures):  # the first compiles
        for kind, (scene, integrator) in enumerate(kinds):
            begin = time.process_time()
            picture = _radiance(scene, integrator, samples, index + 1)
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


def _radiance(scene: mi.Scene, integrator: mi.SamplingIntegrator, samples: int, seed: int) -> NDArray[np.float32]:
    """Return the radiance of a picture, (rows, columns, channels)."""
    columns, rows = scene.sensors()[0].film().crop_size()
    sums = Accumulation.empty(rows, columns)
    sums.add(trace_pass(scene, samples, pass_seed(seed, 0), integrator), samples)
    return sums.radiance()


@cache
def _averaging(variant: str) -> type:
    """Return the class of an integrator that averages `_MANY` samples of another one along each ray of the camera.

    `direct` of Mitsuba 3.9.1 with many `emitter_samples` adds the light of each sample of a delta emitter in full.
    """

    class Averaged(mi.SamplingIntegrator):
        def __init__(self, one: mi.SamplingIntegrator) -> None:
            mi.SamplingIntegrator.__init__(self, mi.Properties("averaged"))
            self.one = one

        @dr.syntax
        def sample(
            self,
            scene: mi.Scene,
            sampler: mi.Sampler,
            ray: mi.RayDifferential3f,
            medium: mi.Medium | None = None,
            active: mi.Bool = True,
        ) -> tuple[mi.Spectrum, mi.Bool, list[mi.Float]]:
            radiance, valid, number = mi.Spectrum(0), mi.Bool(False), mi.UInt32(0)
            while number < _MANY:
                value, valid, _ = self.one.sample(scene, sampler, ray, medium, active)
                radiance += value
                number += 1
            return radiance / _MANY, valid, []

    return Averaged


def _draw_one_wavelength(scene: mi.Scene) -> None:
    """Make the first sensor draw wavelengths near `_WAVELENGTH` only."""
    distribution = mi.traverse(scene.sensors()[0].film().sensor_response_function())
    values = np.array(distribution["values"])
    far = np.abs(np.linspace(*VISIBLE, values.size) - _WAVELENGTH) > _HALF_WIDTH
    distribution["values"] = type(distribution["values"])(np.where(far, 0, values).astype(np.float32))
    distribution.update()
