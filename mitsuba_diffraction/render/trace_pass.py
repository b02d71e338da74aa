"""One rendering pass with deterministic filtering: equal seeds give equal bits.

Mitsuba accumulates samples in its film from several threads with atomic additions. As floating-point sums depend on
their order, the result is not reproducible when several threads contribute to a pixel: with any filter wider than a
pixel, and with the box filter if the samples of a pixel are split among threads. Here the samples are stored, and each
pixel gathers its own in a fixed order, independent of the number of threads.

Four wavelengths contribute to at most eight of the hat-shaped channels; a `specfilm` adds each sample to all of them.
"""

from __future__ import annotations

import functools
import operator
import tempfile
from bisect import bisect_right
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..bsdf.device_tables import on_device
from ..bsdf.light import recorded_wavelengths
from ..bsdf.mitsuba_internals import INDEPENDENT
from ..errors import RequestError, root_cause
from ..integrator.paths import LightPaths, random_numbers, unpacked
from ..machine import available_memory
from ..progress import bytes_text
from .scene import no_warnings, recorded_range
from .spectral_film import channel_wavelengths, channel_weights

Rows = tuple[int, int]
"""The first row of a band of a picture, and the row after its last."""

# A band of this many pixels, 1024 × 768, takes up to 1.3 GB.
BAND_PIXELS = 3 * 2**18
# Kernels, preview and file of a picture, in addition to what grows with its size; each thread of the file reserves some
# of the address space.
_FURTHER_BYTES = 200_000_000
_GROUP = 4  # neighbouring pixels of which `collect` gathers the samples at once
_SPOOLED_BYTES = 2**22  # in memory for each band

# Index of a pixel (row by row), mask → index of its first sample and one past its last. Its samples are contiguous.
SampleRange = Callable[["mi.UInt32", "mi.Bool"], tuple["mi.UInt32", "mi.UInt32"]]


def pass_seed(seed: int, index: int) -> int:
    """Return a 32-bit seed for one pass, independent of the seeds of other passes and other `seed`s."""
    return int(np.random.SeedSequence((seed, index)).generate_state(1)[0])


def bands_of(scene: mi.Scene) -> tuple[Rows, ...]:
    """Return the bands of rows in which the picture of the first sensor is traced, to bound memory.

    Mitsuba's film takes whole pictures only.
    """
    columns, rows = (int(size) for size in scene.sensors()[0].film().crop_size())
    whole = needs_mitsubas_film(scene.integrator())
    count = 1 if whole else min(rows, -(-rows * columns // BAND_PIXELS))
    return tuple(pairwise(rows * index // count for index in range(count + 1)))


def trace_pass(
    scene: mi.Scene,
    spp: int,
    seed: int,
    integrator: mi.Integrator | None = None,
    rows: Rows | None = None,
    light: LightOfBands | None = None,
    alpha: bool = False,
) -> NDArray[np.float32]:
    """Trace the first sensor once and return the sums that determine radiance.

    With the filter f, the position p_s of sample s on the film, its radiance L_s(λ) at four wavelengths λ_sj (divided
    by their density) and the hats t_i of unit area around the wavelengths of the channels, a pixel at c holds

        Σ_s f(c − p_s) ¼ Σ_j L_s(λ_sj) t_i(λ_sj)    in channel i,    and finally    Σ_s f(c − p_s);

    their ratio is radiance per nm. The sums of passes are additive. Samplers that correlate samples are rotated
    (`rotated_sampler`), so that any pass has the expectation of independent samples.

    The result is determined, bit for bit, by the seed, the scene, the versions of Mitsuba and Dr.Jit and the type of
    processor. Integrators that need Mitsuba's film (`needs_mitsubas_film`) are not reproducible in the last bits.

    Args:
        scene: from `SceneFile.load`.
        spp: samples per pixel; the scene's sampler may draw more (`sampler_of`).
        seed: 32 bits.
        integrator: replaces the integrator of the scene.
        rows: traced rows; default: all. Samples outside these rows count if they are under the filter of one of their
            pixels. Bands have independent random numbers, except for the paths from the light, which are common to all.
        light: of all bands; required with `rows`.
        alpha: also return Σ_s f(c − p_s) v_s, with v_s one if the integrator finds the sample valid, else zero; not
            with Mitsuba's film.

    Returns:
        (height, width, n + 1) float32, of the rows; with alpha, (height, width, n + 2): it is the last but one.

    Raises:
        RuntimeError: if tracing failed, with the cause on one line.
    """
    integrator = scene.integrator() if integrator is None else integrator
    try:
        if needs_mitsubas_film(integrator):
            return trace_with_mitsubas_film(scene, integrator, spp, seed)
        rows = rows or (0, int(scene.sensors()[0].film().crop_size()[1]))
        return _trace(scene, integrator, spp, seed, rows, light or LightOfBands((rows,)), alpha)
    except Exception as error:
        raise RuntimeError(f"rendering failed: {root_cause(error)}") from error


def needs_mitsubas_film(integrator: mi.Integrator) -> bool:
    """Return whether an integrator can only render whole pictures, with Mitsuba's film and the scene's sampler."""
    return not isinstance(integrator, mi.SamplingIntegrator) or isinstance(integrator, mi.CppADIntegrator)


def check_memory(scene: mi.Scene, spp: int, bands: tuple[Rows, ...] | None = None) -> int:
    """Check that a picture fits into the available memory, where the system reports it (Linux); return what it takes.

    The peak memory has three parts: 8 n + 84 bytes per pixel of a band with n channels (the sums and the result of a
    pass in float32, and its luminance), 40 bytes per sample of a pass of the band (position on the film, channels and
    values of four wavelengths), and 8 bytes per pixel of the film. With Mitsuba's film, 14 n and 24 n were measured.

    Args:
        scene: from `SceneFile.load`.
        spp: samples per pixel of the largest pass.
        bands: in which it is traced; default: whole.

    Raises:
        ValueError: if more memory is needed than available.
    """
    columns, rows = (int(size) for size in scene.sensors()[0].film().crop_size())
    largest = rows if bands is None else max(end - first for first, end in bands)
    n = channel_wavelengths(recorded_range(scene)).size
    pixel_bytes, sample_bytes = (14 * n, 24 * n) if needs_mitsubas_film(scene.integrator()) else (8 * n + 84, 40)
    needed = columns * (largest * (pixel_bytes + sample_bytes * spp) + 8 * rows)
    dr.flush_malloc_cache()
    if (available := available_memory()) is not None and needed + _FURTHER_BYTES > available:
        raise RequestError(
            f"film: got {columns} × {rows} pixels, which take {bytes_text(needed)} of memory beside the "
            f"{bytes_text(_FURTHER_BYTES)} of any picture, wanted at most the "
            f"{bytes_text(available)} that are available"
        )
    return needed


def sampler_of(sampler: mi.Sampler, spp: int) -> mi.Sampler:
    """Return a copy of a sampler that draws `spp` samples per pixel; some round up, to a square or a power of four."""
    copy = sampler.clone()
    with no_warnings():
        copy.set_sample_count(spp)
    return copy


def max_samples(sampler: mi.Sampler, limit: int) -> int:
    """Return the largest number of samples per pixel, up to a limit, that a sampler draws; without one, zero."""
    numbers = range(1, limit + 1)

    def drawn(spp: int) -> int:
        return sampler_of(sampler, spp).sample_count()

    # The largest that is rounded to at most the limit.
    return bisect_right(numbers, limit, key=drawn)


def is_independent(sampler: mi.Sampler) -> bool:
    """Return whether no two numbers of a sampler are correlated."""
    return sampler.class_name() == INDEPENDENT


def rotated_sampler(sampler: mi.Sampler, seed: int, pixel: mi.UInt32) -> mi.Sampler:
    """Return a seeded sampler whose samples are uniform in all dimensions; the same sampler if it is `independent`.

    In Mitsuba's stratifying samplers, pairs of dimensions are not uniform, whatever the seed: with eight samples per
    pixel, sixteenths of the unit square receive up to 24 % (`multijitter`) or 17 % (`stratified`) too much or too
    little, and 34 % for any number of samples with `ldsampler`; pictures then have wrong colours. Here a random shift
    per pixel and dimension is added to each number, modulo one (Cranley and Patterson, 1976): each sample is uniform,
    and the samples of a pixel remain stratified.

    Args:
        pixel: index of the pixel of each sample; its width is the number of samples for which the sampler is seeded.
    """
    return sampler if is_independent(sampler) else _rotated_sampler(mi.variant())(sampler, seed, pixel)


@functools.cache
def _rotated_sampler(variant: str) -> type:
    """Define the sampler for a variant, as its base class depends on the variant."""

    class RotatedSampler(mi.Sampler):
        """Sampler whose numbers are shifted at random for each pixel and dimension, see `rotated_sampler`."""

        def __init__(self, sampler: mi.Sampler, seed: int, pixel: mi.UInt32) -> None:
            mi.Sampler.__init__(self, mi.Properties())
            self.sampler = sampler
            self.rng = random_numbers(seed, 0x7F4A7C15, pixel)

        def next_1d(self, active: mi.Bool = True) -> mi.Float:
            return _fraction(self.sampler.next_1d(active) + self.rng.next_float32())

        def next_2d(self, active: mi.Bool = True) -> mi.Point2f:
            x, y = self.sampler.next_2d(active)
            return mi.Point2f(_fraction(x + self.rng.next_float32()), _fraction(y + self.rng.next_float32()))

        def to_string(self) -> str:
            return f"RotatedSampler[{self.sampler}]"

    return RotatedSampler


def _fraction(number: mi.Float) -> mi.Float:
    return number - dr.floor(number)


def trace_with_mitsubas_film(scene: mi.Scene, integrator: mi.Integrator, spp: int, seed: int) -> NDArray[np.float32]:
    recorded = np.array(mi.render(scene, integrator=integrator, spp=spp, seed=seed))
    picture = recorded / channel_weights(recorded_range(scene)).astype(np.float32)
    count = np.float32(sampler_of(scene.sensors()[0].sampler(), spp).sample_count())
    return np.concatenate([picture * count, np.full((*picture.shape[:2], 1), count)], axis=-1)


class LightOfBands:
    """Contributions of the paths from the light of one pass (`LightPaths.splats`), by band, in the order of tracing.

    They are in temporary files if they are many. What a `diffraction_path` prepares for a scene is kept for all passes.
    """

    def __init__(self, bands: tuple[Rows, ...]) -> None:
        self.bands = bands
        self._traced: tuple[int, int] | None = None
        self._files: list[Any] = []
        self._prepared: tuple[mi.Integrator, mi.SamplingIntegrator, LightPaths | None] | None = None

    def parts(
        self, integrator: Any, scene: mi.Scene, sensor: mi.Sensor
    ) -> tuple[mi.SamplingIntegrator, LightPaths | None]:
        """Return `parts` of a `diffraction_path` for a scene that does not change from pass to pass."""
        if self._prepared is None or self._prepared[0] is not integrator:
            self._prepared = integrator, *integrator.parts(scene, sensor)
        return self._prepared[1:]

    def splats_of(self, rows: Rows, light: LightPaths, spp: int, seed: int, margin: int) -> NDArray[np.float32]:
        """Return the contributions to some rows of a pass, and to `margin` rows above and below."""
        if self._traced != (spp, seed):
            self.__del__()
            self._files = [tempfile.SpooledTemporaryFile(_SPOOLED_BYTES) for _ in self.bands]  # noqa: SIM115
            for traced in light.splats(seed, light.count(spp)):
                for (first, end), file in zip(self.bands, self._files, strict=True):
                    row = traced[:, 1]
                    # Points on the lower edge of the film count as part of its last row.
                    below = np.inf if end == self.bands[-1][1] else end + margin
                    file.write(traced[(row >= first - margin) & (row < below)].tobytes())
            self._traced = spp, seed
        file = self._files[self.bands.index(rows)]
        file.seek(0)
        return np.frombuffer(file.read(), np.float32).reshape(-1, 2 + 2 * dr.size_v(mi.Spectrum))

    def __del__(self) -> None:
        for file in self._files:
            file.close()


def _trace(
    scene: mi.Scene,
    integrator: mi.SamplingIntegrator,
    spp: int,
    seed: int,
    rows: Rows,
    light_of_bands: LightOfBands,
    alpha: bool,
) -> NDArray[np.float32]:
    sensor = scene.sensors()[0]
    film = sensor.film()
    columns, film_rows = (int(size) for size in film.crop_size())
    (first, end), rfilter = rows, film.rfilter()
    border = rfilter.border_size() if film.sample_border() else 0
    # Rows above and below that are traced as well.
    radius = _radius(rfilter)
    margins = border, min(first + border, radius), min(film_rows + border - end, radius)
    traced_columns, traced_rows = columns + 2 * border, end - first + sum(margins[1:])
    shape, channels = (end - first, columns), channel_wavelengths(recorded_range(scene)).size

    sampler = sampler_of(sensor.sampler(), spp)
    spp = sampler.sample_count()
    sums = None
    if hasattr(integrator, "parts"):
        integrator, light = light_of_bands.parts(integrator, scene, sensor)
        if light is not None:
            # What Dr.Jit keeps of the last pass is larger than the contributions, which are in other memory.
            dr.flush_malloc_cache()
            splats = light_of_bands.splats_of(rows, light, spp, seed, radius)
            sums = _sums_of_light(film, splats, first, spp, shape, margins)
    seed = pass_seed(seed, first) if first else seed
    sampler.set_samples_per_wavefront(spp)
    size = traced_columns * traced_rows * spp
    sampler.seed(seed, size)

    # Opaque, so that passes of different sizes share their kernels.
    count, stride = dr.opaque(mi.UInt32, spp), dr.opaque(mi.UInt32, traced_columns)
    pixel = dr.arange(mi.UInt32, size) // count
    sampler = rotated_sampler(sampler, seed, pixel)
    row = pixel // stride
    corner = mi.Vector2f(mi.Vector2i(pixel - row * stride, row) - mi.Vector2i(border, dr.opaque(mi.Int32, margins[1])))
    position = corner + sampler.next_2d()
    aperture = sampler.next_2d() if sensor.needs_aperture_sample() else mi.Point2f(0.5)
    time = mi.Float(sensor.shutter_open())
    if sensor.shutter_open_time() > 0:
        time += sampler.next_1d() * sensor.shutter_open_time()
    on_film = mi.Point2f(position.x, position.y + dr.opaque(mi.Float, first)) / mi.ScalarVector2f(columns, film_rows)
    ray, weight = sensor.sample_ray_differential(time, sampler.next_1d(), on_film, aperture)
    ray.scale_differential(spp**-0.5)
    if hasattr(integrator, "trace"):
        received, valid = integrator.trace(scene, sampler, ray, weight)
    else:
        radiance, valid, _ = integrator.sample(scene, sampler, ray, sensor.get_medium())
        received = [(ray.wavelengths, weight * radiance)]
    channel, value = [], []
    for wavelengths, of_light in received:
        channels_of_light, values = _on_channels(film, wavelengths, of_light)
        channel += channels_of_light
        value += values
    covered = [dr.select(valid, mi.Float(1), 0)] if alpha else []
    dr.eval(position, channel, value, covered)
    collected = functools.partial(collect, rfilter, position, size=shape, margins=margins, samples=equal_ranges(count))
    traced = unfolded(collected(channel, value, channels=channels, earlier=sums), shape)
    if alpha:
        coverage = unfolded(collected([dr.zeros(mi.Float, size)], covered, channels=1), shape)
        traced = np.concatenate([traced[..., :-1], coverage], axis=-1)
    return traced


def _on_channels(film: mi.Film, wavelengths: mi.Spectrum, value: mi.Spectrum) -> tuple[list[mi.Float], list[mi.Float]]:
    """Return the fractional channel of each wavelength, and its contribution; `value` is weighted as by the sensor."""
    # The weight of the sensor contains the response of the film, in proportion to which wavelengths are drawn.
    si = dr.zeros(mi.SurfaceInteraction3f)
    si.wavelengths = wavelengths
    response = film.sensor_response_function().eval(si)
    radiance = mi.unpolarized_spectrum(value) * dr.select(response > 0, dr.rcp(response), 0)
    # As in Mitsuba's film, where Dr.Jit leaves NaN out of scattered sums; it does not where it scatters four at once.
    radiance = dr.select(dr.isnan(radiance), 0, radiance)
    centres = channel_wavelengths(recorded_wavelengths(film))
    step = float(centres[1] - centres[0])
    return list((wavelengths - float(centres[0])) / step), list(radiance / (len(radiance) * step))


def _sums_of_light(
    film: mi.Film,
    splats: NDArray[np.float32],
    first: int,
    spp: int,
    size: tuple[int, int],
    margins: tuple[int, int, int],
) -> mi.Float:
    """Return the sums of the contributions of paths from the light (see `collect`).

    Contributions are sorted by pixel, and within a pixel by the order of tracing.
    """
    rows, columns = size
    _, above, below = margins
    row = np.clip(np.floor(splats[:, 1] - np.float32(first)).astype(np.int64) + above, 0, rows + above + below - 1)
    pixel = row * columns + np.clip(splats[:, 0].astype(np.int64), 0, columns - 1)
    position, wavelengths, value = unpacked(splats[np.argsort(pixel, kind="stable")])
    position.y -= dr.opaque(mi.Float, first)
    counts = np.bincount(pixel, minlength=(rows + above + below) * columns)
    starts = on_device(np.concatenate([[0], counts.cumsum()]), mi.UInt32)
    channel, value = _on_channels(film, wavelengths, value * dr.opaque(mi.Float, spp))
    dr.eval(position, channel, value)

    def range_of_pixel(index: mi.UInt32, active: mi.Bool) -> tuple[mi.UInt32, mi.UInt32]:
        return dr.gather(mi.UInt32, starts, index, active), dr.gather(mi.UInt32, starts, index + 1, active)

    channels = channel_wavelengths(recorded_wavelengths(film)).size
    sums = collect(film.rfilter(), position, channel, value, size, margins, range_of_pixel, channels)
    # The contributions are not needed any more when the samples are traced.
    dr.eval(sums)
    return sums


def equal_ranges(count: mi.UInt32) -> SampleRange:
    """Return the function that gives the index range of a pixel's samples if every pixel has `count` samples."""
    return lambda pixel, active: (pixel * count, pixel * count + count)


def _radius(rfilter: mi.ReconstructionFilter) -> int:
    """Return how many pixels away from its own a sample can contribute."""
    return int(np.ceil(rfilter.radius() - 0.5))


@dr.syntax
def collect(
    rfilter: mi.ReconstructionFilter,
    position: mi.Point2f,
    channel: list[mi.Float],
    value: list[mi.Float],
    size: tuple[int, int],
    margins: tuple[int, int, int],
    samples: SampleRange,
    channels: int,
    earlier: mi.Float | None = None,
) -> mi.Float:
    """Gather the samples under the filter of each pixel, in one lane for four pixels of a row.

    `channel` and `value` are lists; the value at a fractional channel is divided linearly between the two nearest
    channels. There are also samples in the `margins`: pixels at each side, rows above and rows below. `unfolded`
    returns the sums, which are added to `earlier` ones, by pixel.
    """
    rows, columns = size
    sides, above, below = margins
    kernel_radius = _radius(rfilter)
    box = rfilter.is_box_filter()
    groups = -(-columns // _GROUP)
    group = dr.arange(mi.UInt32, rows * groups)
    across = dr.opaque(mi.UInt32, groups)
    row = group // across
    y, x = mi.Int32(row), mi.Int32((group - row * across) * _GROUP)
    base = row * (channels * across) + group  # of its first channel, in groups
    sums = dr.zeros(mi.Float, rows * groups * _GROUP * (channels + 1)) if earlier is None else earlier
    # Not a state of the loops, which would be copied. Four neighbours are added at once.
    add = functools.partial(dr.scatter_reduce, dr.ReduceOp.Add, sums, mode=dr.ReduceMode.NoConflicts)
    inner = dr.opaque(mi.Int32, columns)
    stride, last_x = inner + 2 * sides, inner + sides
    first_y, last_y = dr.opaque(mi.Int32, -above), dr.opaque(mi.Int32, rows + below)

    def add_light(
        channel: list[mi.Float],
        value: list[mi.Float],
        filter_weight: mi.Vector4f,
        index: mi.UInt32,
        base: mi.UInt32,
        active: mi.Bool,
    ) -> None:
        for of_channel, of_value in zip(channel, value, strict=True):
            fractional = dr.gather(mi.Float, of_channel, index, active)
            weighted = of_value * filter_weight
            lower = dr.floor(fractional)
            upper_weight = fractional - lower
            k = mi.Int32(lower)
            for target, part in ((k, weighted * (1 - upper_weight)), (k + 1, weighted * upper_weight)):
                exists = active & (target >= 0) & (target < channels)
                add(part, base + mi.UInt32(target) * across, exists)

    weight = dr.zeros(mi.Vector4f, rows * groups)
    width = 2 * kernel_radius + _GROUP
    tap = mi.UInt32(0)
    while tap < width * (2 * kernel_radius + 1):
        source_y = y + mi.Int32(tap // width) - kernel_radius
        source_x = x + mi.Int32(tap % width) - kernel_radius
        inside = (source_x >= -sides) & (source_y >= first_y) & (source_x < last_x) & (source_y < last_y)
        index, end = samples(mi.UInt32((source_y - first_y) * stride + source_x + sides), inside)
        while index < end:
            filter_weight = mi.Vector4f([dr.select(source_x == x + k, mi.Float(1), 0) for k in range(_GROUP)])
            if dr.hint(not box, mode="scalar"):
                offset_x = mi.Float(x) + 0.5 - dr.gather(mi.Float, position.x, index, inside)
                offset_y = mi.Float(y) + 0.5 - dr.gather(mi.Float, position.y, index, inside)
                of_row = rfilter.eval(offset_y, inside)
                filter_weight = mi.Vector4f([rfilter.eval(offset_x + k, inside) * of_row for k in range(_GROUP)])
            for first in range(0, len(channel), 4):
                channels_of_light = channel[first : first + 4]
                values = [dr.gather(mi.Float, of, index, inside) for of in value[first : first + 4]]
                if dr.hint(first == 0, mode="scalar"):
                    add_light(channels_of_light, values, filter_weight, index, base, inside)
                else:
                    # Few samples of most pictures have light of lamps without extent.
                    lit = functools.reduce(operator.or_, (of_sample != 0 for of_sample in values))
                    if lit:
                        add_light(channels_of_light, values, filter_weight, index, base, lit)
            weight += dr.select(inside, filter_weight, 0)
            index += 1
        tap += 1
    dr.scatter(sums, weight, base + channels * across)
    return sums


def unfolded(sums: mi.Float, size: tuple[int, int]) -> NDArray[np.float32]:
    """Return what `collect` gathered for (rows, columns), in the memory of Dr.Jit, without a copy.

    The shape is (rows, columns, channels + 1); the last are the sums of filter weights.
    """
    rows, columns = size
    by_channel = np.asarray(sums).reshape(rows, -1, -(-columns // _GROUP) * _GROUP)
    return np.moveaxis(by_channel[..., :columns], 1, 2)
