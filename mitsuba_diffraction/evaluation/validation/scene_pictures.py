"""Pictures of a scene by `diffraction_path` beside those by Mitsuba's own integrator.

Eight pictures each, with independent random numbers, are averaged over 4 × 4 blocks. The standard error of a block is
the larger one of two estimates: from the means of the block in each picture, which holds however its pixels are
correlated, and from its pixels, which is less uncertain, but at least 0.05 % of the mean of the picture. A difference
of more than six standard errors is a fault.

The reference is `path`. Where a surface has null interactions, as `mask` has, it is `prb`, Mitsuba's path tracer in
Python: `path` of Mitsuba 3.9.1 drops the light of rays that leave the scene after null interactions alone. (`volpath`
counts depth without null interactions, and finds suns and bulbs behind them, which the other integrators do not.)
"""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ...bsdf.mitsuba_internals import nested_plugin, parts
from ...errors import RequestError
from ...progress import Progress, silent
from ...render.scene import instantiated, recorded_range
from ...render.scene_file import SceneFile
from ...render.spectral_film import channel_wavelengths, channel_weights, replace_films
from ...render.trace_pass import trace_pass
from ..record import Record

PICTURES = 8  # by each integrator
MAX_DEVIATION = 6.0  # standard errors
_BLOCKS = 4  # along each side of a picture
_BANDS = 3  # of the wavelengths of a spectral film
_WIDTH = 32  # pixels
SECONDS = 30.0
_ROUNDING = 1e-5  # relative, of sums in single precision
_MIN_ERROR = 5e-4  # of a block, relative to the mean of the picture: nearly black ones have few bright paths
_TIMED_SPP, _LOG2_SPP = 32, (2, 12)

PictureStack = Sequence[NDArray[np.floating]] | NDArray[np.floating]
Render = Callable[[int, int], NDArray[np.float64]]  # samples per pixel, seed → picture (height, width, channels)


@dataclass(frozen=True)
class PictureDifference:
    """The difference of pictures from those of a reference.

    Attributes:
        ratio, error: of the means over all pixels and channels, and its standard error.
        deviations: of the means of blocks, in standard errors, (rows, columns, channels).
        relative: the same relative to the mean of the reference over the whole picture.
    """

    ratio: float
    error: float
    deviations: NDArray[np.float64]
    relative: NDArray[np.float64]

    @classmethod
    def of(cls, found: PictureStack, reference: PictureStack, blocks: int = _BLOCKS) -> PictureDifference:
        """Compare pictures with independent seeds, (height, width, channels) each."""
        both = [np.asarray(pictures, np.float64) for pictures in (found, reference)]
        (mean, error), (wanted, its_error) = (_block_means(pictures, blocks) for pictures in both)
        total, of_total = (_mean_and_error(pictures.mean((1, 2, 3))) for pictures in both)
        change, scale = mean - wanted, of_total[0] or 1.0
        error = np.maximum(np.hypot(error, its_error), np.maximum(_ROUNDING * np.abs(wanted), _MIN_ERROR * abs(scale)))
        with np.errstate(divide="ignore", invalid="ignore"):
            deviations = np.where(change == 0, 0.0, change / error)
        ratio = 1.0 if total[0] == of_total[0] else total[0] / scale
        return cls(ratio, float(np.hypot(total[1], of_total[1]) / scale), deviations, change / scale)

    @property
    def position(self) -> tuple[int, int, int]:
        """Row and column of the block, and channel, of the largest deviation; NaN counts as the largest."""
        size = np.where(np.isnan(self.deviations), np.inf, np.abs(self.deviations))
        row, column, channel = np.unravel_index(np.argmax(size), size.shape)
        return int(row), int(column), int(channel)

    @property
    def deviation(self) -> float:
        """The largest deviation, in standard errors."""
        return float(self.deviations[self.position])

    @property
    def is_noise(self) -> bool:
        """Whether no block deviates by more than six standard errors."""
        return bool(abs(self.deviation) <= MAX_DEVIATION)

    def __str__(self) -> str:
        if not self.is_noise:
            return f"a difference beyond noise: {self.deviation:+.1f} standard errors"
        return f"no difference beyond noise: at most {100 * (abs(self.ratio - 1) + 2 * self.error):.1g} %"


def _block_means(pictures: NDArray[np.float64], blocks: int) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """Return the means over blocks, (rows, columns, channels), and their standard errors."""
    rows, columns = (np.array_split(np.arange(size), min(blocks, size)) for size in pictures.shape[1:3])
    means, variances = [], []
    for row in rows:
        for column in columns:
            block = pictures[:, row[0] : row[-1] + 1, column[0] : column[-1] + 1]
            of_pixels = block.var(0, ddof=1).mean((0, 1)) / (len(row) * len(column))
            means.append(block.mean((0, 1, 2)))
            variances.append(np.maximum(block.mean((1, 2)).var(0, ddof=1), of_pixels) / len(pictures))
    shape = len(rows), len(columns), -1
    return np.reshape(means, shape), np.sqrt(np.reshape(variances, shape))


def _mean_and_error(values: NDArray[np.float64]) -> tuple[float, float]:
    return float(values.mean()), float(values.std(ddof=1) / np.sqrt(len(values)))


def reference_integrator(scene: mi.Scene) -> str:
    """Return the name of Mitsuba's own integrator for a scene: `path`, or `prb` if surfaces have null interactions."""
    shapes = parts(scene, mi.Shape)
    shapes += [member for shape in shapes for member in parts(shape, mi.Shape)]  # of groups
    bsdfs = [bsdf for shape in shapes if (bsdf := shape.bsdf()) is not None]
    return "prb" if any(bsdf.flags() & +mi.BSDFFlags.Null for bsdf in bsdfs) else "path"


@dataclass(frozen=True)
class SceneComparison:
    """The picture that `render` traces of a scene, and the one by Mitsuba's own integrator.

    Attributes:
        difference: of eight pictures each.
        reference: name of Mitsuba's integrator.
        where: of the largest deviation: pixels and wavelengths.
    """

    difference: PictureDifference
    reference: str
    where: str

    @property
    def records(self) -> list[Record]:
        """The ratio of the means, and the largest deviation."""
        found, group, source = self.difference, "scene", f"{self.reference} of Mitsuba {mi.__version__}"
        ratio = Record(found.ratio, 1.0, None, False, f"± {found.error:.1g}", group, "ratio of the means", source)
        name = "largest difference, in standard errors"
        return [ratio, Record(found.deviation, 0.0, MAX_DEVIATION, False, self._largest, group, name, source)]

    @property
    def _largest(self) -> str:
        relative = 100 * self.difference.relative[self.difference.position]
        return f"{relative:+.2g} % of the mean, {self.difference.deviation:+.1f} standard errors, in {self.where}"

    def __str__(self) -> str:
        mean = f"mean: {self.difference.ratio:.4f} ± {self.difference.error:.1g} times that by {self.reference}"
        return f"{mean}; largest difference: {self._largest}\n{self.difference}"


def compare_scene(
    scene_file: SceneFile, progress: Progress = silent, *, seconds: float = SECONDS, first_seed: int = 1
) -> SceneComparison:
    """Compare the picture that `render` traces of a scene with that by Mitsuba's integrator.

    Args:
        scene_file: its pictures are traced 32 pixels wide.
        progress: called after each picture.
        seconds: that the pictures take, beside the time to compile.
        first_seed: of 16 in succession.

    Raises:
        RequestError: if `render` does not trace the scene by `diffraction_path`, or the scene is wrong.
    """
    small = replace(scene_file, size=(_WIDTH, None))
    ours, theirs = small.load(), _reference_scene(small)
    integrator = ours.integrator()
    if not hasattr(integrator, "parts"):
        raise RequestError(
            f"{small.path}: got an integrator other than path, without which there is nothing to compare"
        )
    name = reference_integrator(theirs)
    reference = nested_plugin(name, max_depth=integrator.max_depth, rr_depth=integrator.rr_depth)
    weights = channel_weights(recorded_range(ours))

    def found(spp: int, seed: int) -> NDArray[np.float64]:
        sums = trace_pass(ours, spp, seed).astype(np.float64)
        return _in_bands(sums[..., :-1] / sums[..., -1:])

    def wanted(spp: int, seed: int) -> NDArray[np.float64]:
        return _in_bands(np.array(mi.render(theirs, integrator=reference, spp=spp, seed=seed)) / weights)

    renders = (found, wanted)
    counts = [_samples_in(seconds / (len(renders) * PICTURES), render) for render in renders]
    stacks: list[list[NDArray[np.float64]]] = [[], []]
    for number in range(len(renders) * PICTURES):
        which = number // PICTURES
        stacks[which].append(renders[which](counts[which], first_seed + number))
        progress(number + 1, len(renders) * PICTURES)
    difference = PictureDifference.of(stacks[0], stacks[1])
    return SceneComparison(difference, name, _where(difference, stacks[0][0].shape, ours))


def _reference_scene(scene_file: SceneFile) -> mi.Scene:
    """Load the scene with the film of `render`, but with independent samples."""
    with scene_file.parsed() as (config, state):
        replace_films(state, *scene_file.size)
        for node in state.nodes:
            if node.type == mi.ObjectType.Sampler:
                node.props, name = mi.Properties("independent"), node.props.id()
                node.props.set_id(name)
        return instantiated(config, state)


def _samples_in(seconds: float, render: Render) -> int:
    """Return the samples per pixel that take so long, a power of two."""
    render(_TIMED_SPP, 0)  # compiles
    start = time.perf_counter()
    render(_TIMED_SPP, 0)
    count = _TIMED_SPP * seconds / (time.perf_counter() - start)
    return int(2 ** np.clip(np.floor(np.log2(count)), *_LOG2_SPP))


def _in_bands(picture: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the means over bands of the channels, (height, width, bands)."""
    return np.stack([band.mean(-1) for band in np.array_split(picture, _BANDS, axis=-1)], -1)


def _where(difference: PictureDifference, shape: tuple[int, ...], scene: mi.Scene) -> str:
    """Return the pixels and wavelengths of the largest deviation, in words."""
    row, column, band = difference.position
    rows, columns = (
        np.array_split(np.arange(size), count)[k]
        for size, count, k in zip(shape, difference.deviations.shape, (row, column), strict=False)
    )
    wavelengths = np.array_split(channel_wavelengths(recorded_range(scene)), _BANDS)[band]
    return (
        f"rows {rows[0]} to {rows[-1]}, columns {columns[0]} to {columns[-1]} of {shape[1]} × {shape[0]} pixels, "
        f"{wavelengths[0]:.0f} to {wavelengths[-1]:.0f} nm"
    )
