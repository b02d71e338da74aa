"""Preparation of scans: levelling, line alignment, despiking, missing pixels, rotation, cropping; the seam of a tile.

Each step takes a height field and returns a new one, whose `source` records the result of the step. Missing pixels
(NaN) remain missing until `fill_missing`; the other steps ignore them.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import Any

import numpy as np
from numpy.typing import NDArray
from scipy import ndimage

from ..errors import RequestError, did_you_mean, is_number
from .heightfield import HeightField, harmonic_fill
from .periods import Period, find_periods

_MIN_VISIBLE_RATIO = 1.5  # of the steps across a seam to those inside
_MIN_VISIBLE_STEP = 0.002  # µm; a step of 2 nm scatters (4π·0.002/0.45)² = 0.3 % of incident blue light


def seam_steps(height_field: HeightField) -> dict[str, tuple[float, float]]:
    """Return the height steps between adjacent pixels across the seam and inside the patch.

    Returns:
        For each axis of more than two pixels, "x" or "y": the r.m.s. step from the last pixel to the first, and from
        each pixel to the next, µm. Missing pixels are ignored.
    """
    found = {}
    for axis, heights in (("x", height_field.heights), ("y", height_field.heights.T)):
        if heights.shape[1] > 2:
            inside, across = np.diff(heights, axis=1), heights[:, 0] - heights[:, -1]
            found[axis] = (float(np.sqrt(np.nanmean(across**2))), float(np.sqrt(np.nanmean(inside**2))))
    return found


def repeats_without_seam(height_field: HeightField) -> tuple[bool, str]:
    """Return whether the seams of a tiling are invisible, and why; otherwise its period would act as a grating.

    In noise, in which neighbouring pixels differ by more than the r.m.s. height, no seam could be seen.
    """
    pairs, height = seam_steps(height_field).items(), float(np.nanstd(height_field.heights))
    if any(inside > max(height, _MIN_VISIBLE_STEP) for _, (_, inside) in pairs):
        return False, "neighbouring pixels differ by more than the r.m.s. height, as in noise"
    seen = any(across > max(_MIN_VISIBLE_RATIO * inside, _MIN_VISIBLE_STEP) for _, (across, inside) in pairs)
    texts = [f"{across * 1e3:.3g} nm along {axis} ({inside * 1e3:.3g} inside)" for axis, (across, inside) in pairs]
    edges = "its edges do not meet" if seen else "its edges meet"
    return not seen, f"{edges}, r.m.s. steps at the seam {' and '.join(texts)}"


_NEIGHBOURHOOD = 5  # side of the neighbourhood of a pixel, pixels
_SURROUNDINGS_FRACTION = 1 / 40  # of the shorter side of a scan: standard deviation of the weights of the surroundings
_OUTLIER_PERCENTILE = 99.0
_OUTLIER_MARGIN = 2  # pixels
_SIGMA_PER_MAD = 1.4826  # standard deviation of a normal distribution over its median absolute deviation
_MAX_MISFIT = 0.05  # of a second wave at the seam, in periods
_MIN_RELATIVE_STRENGTH = 0.1  # of a second wave relative to the strongest; a weaker one is ignored
Step = str | Mapping[str, object]
"""The name of a step, or {name: argument}."""


def level_plane(height_field: HeightField) -> HeightField:
    """Subtract the least-squares plane: the tilt of the sample. Missing pixels are ignored."""
    return _level(height_field, 1)


def level_quadratic(height_field: HeightField) -> HeightField:
    """Subtract the least-squares quadratic surface: the tilt, and the bow of a tube scanner."""
    return _level(height_field, 2)


def _level(height_field: HeightField, degree: int) -> HeightField:
    heights = height_field.heights
    rows, columns = heights.shape
    x, y = ((np.arange(n) - (n - 1) / 2) / max((n - 1) / 2, 1) for n in (columns, rows))  # [−1, 1]
    # A single row has no slope along y, and two rows have no bow.
    powers = [(i, j) for i in range(degree + 1) for j in range(degree + 1 - i) if i < columns and j < rows]
    known = ~height_field.gaps
    mean = heights[known].mean()
    terms = np.array([(y[:, None] ** j * x**i)[known] for i, j in powers])
    coefficients = np.zeros(len(powers))
    # By the normal equations, which are small; a second solution, for the residual, removes the error of the first.
    for _ in range(2):
        residual = heights[known] - mean - coefficients @ terms
        coefficients += np.linalg.lstsq(terms @ terms.T, terms @ residual, rcond=1e-12)[0]
    fitted = sum(c * y[:, None] ** j * x**i for c, (i, j) in zip(coefficients, powers, strict=True))
    found = dict(zip(powers, coefficients, strict=True))
    half = [max((n - 1) / 2, 1) * size for n, size in zip((columns, rows), height_field.pixel_size, strict=True)]
    tilts = [np.degrees(np.arctan(found.get(p, 0.0) / h)) for p, h in zip([(1, 0), (0, 1)], half, strict=True)]
    description = f"tilt {tilts[0]:.3g}° along x, {tilts[1]:.3g}° along y"
    if degree == 2:
        description += (
            f", bow {found.get((2, 0), 0.0) * 1e3:.3g} nm along x, {found.get((0, 2), 0.0) * 1e3:.3g} nm along y"
        )
    name = "level_plane" if degree == 1 else "level_quadratic"
    return _after(height_field, heights - mean - fitted, f"{name}: {description}")


def align_lines(height_field: HeightField) -> HeightField:
    """Remove the offsets between the lines (rows) of a scan.

    The offset between adjacent rows is the median of their differences, which is robust against features across few
    columns. A linear trend of the offsets is a tilt and is kept (see `level_plane`). Structure shared by whole rows is
    removed as well: not for gratings whose lines run along x.
    """
    heights = height_field.heights
    lines = np.flatnonzero(~height_field.gaps.all(axis=1))
    offsets = np.zeros(len(lines))
    previous = heights[lines[0]]
    for k, line in enumerate(lines[1:], 1):
        difference = heights[line] - previous
        shared = difference[~np.isnan(difference)]
        offsets[k] = offsets[k - 1] + (np.median(shared) if len(shared) else 0.0)
        # Missing pixels are replaced by pixels of the line before.
        previous = np.where(np.isnan(heights[line]), previous + offsets[k] - offsets[k - 1], heights[line])
    # The median slope of an oblique asymmetric profile is not zero, which accumulates to a tilt over the lines.
    offsets -= np.polyval(np.polyfit(lines, offsets, 1 if len(lines) > 1 else 0), lines)
    aligned = heights.copy()
    aligned[lines] -= offsets[:, None]
    description = f"offsets {offsets.std() * 1e3:.3g} nm rms, {np.abs(offsets).max() * 1e3:.3g} nm at most"
    return _after(height_field, aligned, f"align_lines: {description}")


def despike(height_field: HeightField, threshold: float = 5.0) -> HeightField:
    """Replace outliers.

    Of the 5 × 5 neighbourhood of a pixel, the five highest and the five lowest pixels may be outliers, e.g. a streak
    along a line. The pixel is an outlier if it is above, or below, all others by more than `threshold` standard
    deviations σ of the noise and by more than twice their range. At the bottom of a groove with straight walls, a pixel
    is below the others by at most their range. Outliers are filled like missing pixels. A ridge one pixel wide on flat
    ground is also removed.

    σ is estimated after Immerkær 1996, "Fast noise variance estimation", Computer Vision and Image Understanding 64(2),
    300–302, from the mixed second differences along x and y, which nearly vanish for a smooth surface. For robustness
    the median of their moduli is used, not the mean.

    Raises:
        ValueError: if the threshold is not positive.
    """
    _check("despike", threshold)
    gaps = height_field.gaps
    whole = harmonic_fill(height_field.heights, height_field.pixel_size)
    # The surface is extrapolated with its slope at the edges; a spike exactly in a corner is not detected.
    inside = slice(_NEIGHBOURHOOD // 2, -(_NEIGHBOURHOOD // 2))
    padded = np.pad(whole, _NEIGHBOURHOOD // 2, mode="reflect", reflect_type="odd")
    ranks = _NEIGHBOURHOOD, -_NEIGHBOURHOOD - 1
    low, high = (ndimage.rank_filter(padded, rank, _NEIGHBOURHOOD)[inside, inside] for rank in ranks)
    sigma = white_noise(whole)
    excess = np.maximum(whole - high, low - whole)
    spikes = ~gaps & (excess > threshold * sigma) & (excess > 2 * (high - low))
    cleaned = height_field.heights
    if spikes.any():
        cleaned = harmonic_fill(np.where(spikes, np.nan, whole), height_field.pixel_size)
        cleaned = np.where(gaps, np.nan, np.where(spikes, cleaned, height_field.heights))
    description = f"{spikes.sum()} of {spikes.size} pixels beyond {threshold:g} × {sigma * 1e3:.3g} nm"
    return _after(height_field, cleaned, f"despike: {description}")


def white_noise(heights: NDArray[np.float64]) -> float:
    """Estimate the standard deviation of white noise on a smooth surface, µm."""
    differences = heights
    for dimension, count in enumerate(heights.shape):
        if count > 2:
            differences = np.diff(differences, 2, axis=dimension) / np.sqrt(6)  # 1² + 2² + 1²
    return float(_SIGMA_PER_MAD * np.median(np.abs(differences))) if differences is not heights else 0.0


def mask_outliers(height_field: HeightField, factor: float = 2.25) -> HeightField:
    """Mark dust and pits as missing: regions far above, or far below, their surroundings.

    With r = h − ⟨h⟩, ⟨h⟩ the Gaussian-weighted mean of the surroundings (standard deviation 1/40 of the shorter side of
    the scan), p_k the percentiles of r, a connected region above p_99 is an outlier if one of its pixels is above p_50
    + factor (p_99 − p_50); below, likewise with p_1. It is marked with a margin of two pixels. Percentiles, on either
    side its own, follow the depth and the skewness of the structure.

    Raises:
        ValueError: if the factor is not at least 1.
    """
    _check("mask_outliers", factor)
    gaps = height_field.gaps
    whole = harmonic_fill(height_field.heights, height_field.pixel_size)
    # A profile has no side along its axis of one pixel.
    sides = [side if n > 1 else np.inf for side, n in zip(height_field.tile_size, gaps.shape[::-1], strict=True)]
    width = _SURROUNDINGS_FRACTION * min(min(sides), max(height_field.tile_size))
    relative = whole - ndimage.gaussian_filter(whole, [width / pixel for pixel in height_field.pixel_size[::-1]])
    relative -= np.median(relative)
    outliers = np.zeros(gaps.shape, bool)
    for deviation in (relative, -relative):
        edge = np.percentile(deviation, _OUTLIER_PERCENTILE)
        regions, count = ndimage.label(deviation > edge)
        is_outlier = np.zeros(count + 1, bool)
        is_outlier[regions[deviation > factor * edge]] = True
        outliers |= is_outlier[regions]
    outliers = ndimage.binary_dilation(outliers, np.ones((3, 3)), _OUTLIER_MARGIN) & ~gaps
    masked = np.where(outliers, np.nan, height_field.heights)
    _check_any("mask_outliers", masked)
    return _after(height_field, masked, f"mask_outliers: {outliers.sum()} of {outliers.size} pixels")


def fill_missing(height_field: HeightField) -> HeightField:
    """Fill missing pixels by harmonic interpolation (`heightfield.harmonic_fill`)."""
    filled = harmonic_fill(height_field.heights, height_field.pixel_size)
    count = int(height_field.gaps.sum())
    return _after(height_field, filled, f"fill_missing: {count} of {filled.size} pixels", filled=count)


def trim_edges(height_field: HeightField, width: float) -> HeightField:
    """Cut off at least `width` µm at each edge, where the tip reverses, in whole pixels.

    Raises:
        ValueError: if the width is not positive, or nothing would be left.
    """
    _check("trim_edges", width)
    rows, columns = height_field.shape
    cuts = [
        int(np.ceil(min(width / size, n) - 1e-9)) if n > 1 else 0  # a profile has no edges along its axis of one pixel
        for n, size in zip((columns, rows), height_field.pixel_size, strict=True)
    ]
    if 2 * cuts[0] >= columns or 2 * cuts[1] >= rows:
        x, y = height_field.tile_size
        raise RequestError(f"trim_edges: got {width:g} µm at each edge of {x:.4g} × {y:.4g} µm: nothing would be left")
    inside = height_field.heights[cuts[1] : rows - cuts[1], cuts[0] : columns - cuts[0]]
    _check_any("trim_edges", inside)
    return _after(height_field, inside, f"trim_edges: {cuts[0]} columns and {cuts[1]} rows at each edge")


def rotate(height_field: HeightField, degrees: float) -> HeightField:
    """Rotate the surface from +x towards +y about the centre of the patch.

    Heights are interpolated by cubic splines; multiples of 90° rotate the pixels themselves. The largest axis-aligned
    rectangle inside the rotated patch is kept, so that nothing is extrapolated. A pixel is missing if one of the four
    around its position is.

    Raises:
        ValueError: if the angle is not a finite number, or no pixel fits into the rotated patch.
    """
    from scipy.interpolate import RectBivariateSpline

    _check("rotate", degrees)
    quarters = degrees / 90
    if quarters == np.rint(quarters):
        quarter_turns = int(np.rint(quarters)) % 4
        # rot90 rotates from +x (columns) towards −y (rows), but rows run along +y here.
        d_x, d_y = height_field.pixel_size
        size = (d_y, d_x) if quarter_turns % 2 else (d_x, d_y)
        return _after(height_field, np.rot90(height_field.heights, -quarter_turns), f"rotate: {degrees:g}°", size)
    rows, columns = height_field.shape
    d_x, d_y = height_field.pixel_size
    cos, sin = np.cos(np.radians(degrees)), np.sin(np.radians(degrees))
    # Between the centres of the outermost pixels.
    width, height = largest_rectangle((columns - 1) * d_x, (rows - 1) * d_y, abs(cos), abs(sin))
    count = [int(np.floor(length / d + 1e-9)) + 1 for length, d in ((width, d_x), (height, d_y))]
    if min(count) < 2:
        raise RequestError(f"rotate: no pixels fit into {columns} × {rows} pixels rotated by {degrees:g}°")
    x, y = ((np.arange(n) - (n - 1) / 2) * d for n, d in zip(count, (d_x, d_y), strict=True))
    x, y = np.meshgrid(x, y)
    positions = np.array([(cos * y - sin * x) / d_y + (rows - 1) / 2, (cos * x + sin * y) / d_x + (columns - 1) / 2])
    whole = harmonic_fill(height_field.heights, height_field.pixel_size)
    # Not ndimage's splines, whose slope vanishes at the edges.
    degree = [min(3, n - 1) for n in (rows, columns)]
    spline = RectBivariateSpline(np.arange(rows), np.arange(columns), whole, kx=degree[0], ky=degree[1])
    rotated = spline.ev(*positions)
    gaps = ndimage.map_coordinates(height_field.gaps.astype(float), positions, order=1, mode="nearest") > 1e-9
    rotated[gaps] = np.nan
    _check_any("rotate", rotated)
    return _after(height_field, rotated, f"rotate: {degrees:g}°, {count[0]} × {count[1]} of {columns} × {rows} pixels")


def largest_rectangle(width: float, height: float, cos: float, sin: float) -> tuple[float, float]:
    """Return the sides of the largest rectangle inside a rotated one, for an angle with cos, sin > 0.

    If all four corners lie on the rotated rectangle, W = w cos + h sin and H = w sin + h cos give w and h. For a long
    and narrow rectangle only two corners on its long sides are active, and wh is largest at w sin = h cos, half of the
    short side S = w sin + h cos (or with cos and sin exchanged).
    """
    short = min(width, height)
    if short <= 2 * sin * cos * max(width, height) or abs(cos - sin) < 1e-12:
        return (short / 2 / sin, short / 2 / cos) if width >= height else (short / 2 / cos, short / 2 / sin)
    determinant = cos**2 - sin**2
    return (width * cos - height * sin) / determinant, (height * cos - width * sin) / determinant


def crop_periods(height_field: HeightField, axes: str = "xy") -> HeightField:
    """Crop along "x", "y" or "xy" to a whole number of periods, so that the patch tiles without a seam.

    `find_periods` finds at most two periods. Along each axis the strongest wave with a period along this axis is taken.
    Candidate lengths are multiples of its period that keep at least half of the patch. The largest candidate that is
    nearly a multiple of the second period, too, is chosen; if there is none, the one closest to such a multiple.
    Without a second period, it is the largest. As the length is not a whole number of pixels, a remainder of up to half
    a pixel would be a seam, which diffracts into spurious orders. The heights are therefore resampled by cubic splines
    to the nearest number of pixels.

    Raises:
        ValueError: if pixels are missing, no period is found, or less than one fits into the patch.
    """
    _check("crop_periods", axes)
    if height_field.gaps.any():
        raise RequestError(f"crop_periods: {height_field.gaps.sum()} pixels are missing, wanted fill_missing before it")
    found = find_periods(height_field)
    waves = [wave for wave in found if wave.strength >= _MIN_RELATIVE_STRENGTH * found[0].strength]
    if not waves:
        raise RequestError("crop_periods: no period stands out of the spectrum of the heights")
    description = []
    heights, sizes = height_field.heights, list(height_field.pixel_size)
    for axis in axes:
        k = "xy".index(axis)
        heights, sizes[k], part = _crop(heights, 1 - k, sizes[k], waves, axis)
        description.append(part)
    if all("no period" in part for part in description):
        raise RequestError(f"crop_periods: {'; '.join(description)}")
    return _after(height_field, heights, f"crop_periods: {', '.join(description)}", (sizes[0], sizes[1]))


def _crop(
    heights: NDArray[np.float64], dimension: int, size: float, waves: Sequence[Period], axis: str
) -> tuple[NDArray[np.float64], float, str]:
    """Crop along one axis; return the heights, their pixel size, and a description."""
    from scipy.interpolate import make_interp_spline

    count = heights.shape[dimension]
    q, uncertainty = (np.array(v) for v in zip(*(_component(wave, axis) for wave in waves), strict=True))
    across = np.flatnonzero(q * count * size >= 1 - 1e-9)
    if count == 1 or len(across) == 0:
        return heights, size, f"no period along {axis}"
    first = across[0]
    max_number = int(np.floor(q[first] * count * size + 1e-6))
    numbers = np.arange(max_number, max_number // 2 - 1 if max_number > 1 else 0, -1)
    lengths = np.maximum(numbers, 1) / q[first]
    misfits = np.abs(q[:, None] * lengths - np.rint(q[:, None] * lengths))
    max_misfit = misfits.max(axis=0)
    fits = max_misfit <= _MAX_MISFIT
    best = int(np.argmax(fits)) if fits.any() else int(np.argmin(max_misfit))
    length, misfit = lengths[best], np.delete(misfits[:, best], first)
    exact = length / size
    new = int(np.rint(exact))
    start = (count - exact) / 2
    if abs(exact - new) < 1e-3 or new < 4:
        cut = slice((count - new) // 2, (count - new) // 2 + new)
        heights = heights[:, cut] if dimension == 1 else heights[cut]
        how = f"{new} of {count} pixels"
    else:
        spline = make_interp_spline(np.arange(count), heights, k=3, axis=dimension)
        heights = spline(start - 0.5 + (np.arange(new) + 0.5) * exact / new)
        how = f"{exact:.2f} of {count} pixels, resampled to {new}"
        size = length / new
    description = f"{max(numbers[best], 1)} × {1e3 / q[first]:.4g} nm along {axis} ({how}, "
    description += f"known to {length * uncertainty[first]:.2g} periods"
    description += f", the other wave is {misfit.max():.2g} periods off)" if len(misfit) else ")"
    return heights, size, description


def _component(wave: Period, axis: str) -> tuple[float, float]:
    """Return |q| along an axis in cycles/µm, and its standard uncertainty."""
    along, across = wave.q if axis == "x" else wave.q[::-1]
    spread = along * wave.period_uncertainty / wave.period, across * np.radians(wave.direction_uncertainty)
    return abs(float(along)), float(np.hypot(*spread))


# ---------------------------------------------------------------- recipes


def _is_positive(value: Any) -> bool:
    return is_number(value) and value > 0


_NO_ARGUMENT = (lambda argument: False), "no argument"
_STEPS: dict[str, tuple[Callable[..., HeightField], Callable[[Any], bool], str]] = {
    "level_plane": (level_plane, *_NO_ARGUMENT),
    "level_quadratic": (level_quadratic, *_NO_ARGUMENT),
    "align_lines": (align_lines, *_NO_ARGUMENT),
    "despike": (despike, _is_positive, "a positive number of standard deviations"),
    "mask_outliers": (mask_outliers, lambda value: _is_positive(value) and value >= 1, "a number of at least 1"),
    "fill_missing": (fill_missing, *_NO_ARGUMENT),
    "rotate": (rotate, is_number, "a number of degrees"),
    "crop_periods": (crop_periods, ("x", "y", "xy").__contains__, "'x', 'y' or 'xy'"),
    "trim_edges": (trim_edges, _is_positive, "a positive number of µm"),
}
"""Name → function, check of an argument, and description of a valid argument."""

_ARGUMENT_REQUIRED = ("rotate", "trim_edges")  # the others have no argument, or a default


def _check(name: str, argument: object, where: str = "") -> None:
    _, is_valid, wanted = _STEPS[name]
    if not is_valid(argument):
        raise RequestError(f"{where}{name}: got {argument!r}, wanted {wanted}")


MAX_STEPS = 32  # of a recipe; each takes seconds of a large scan


def check_steps(steps: object) -> list[tuple[str, tuple[object, ...]]]:
    """Check a list of steps, each a name or {name: argument}, and return their names and arguments."""
    if not isinstance(steps, list | tuple):
        raise RequestError(f"prepare: got {steps!r}, wanted a list of steps")
    if len(steps) > MAX_STEPS:
        raise RequestError(f"prepare: got {len(steps)} steps, wanted at most {MAX_STEPS}")
    found = []
    for step in steps:
        name, *arguments = next(iter(step.items())) if isinstance(step, Mapping) and len(step) == 1 else [step]
        if not (isinstance(name, str) and name in _STEPS):
            raise RequestError(f"prepare: got {step!r}, wanted one of {', '.join(_STEPS)}")
        for argument in arguments:
            _check(name, argument, "prepare: ")
        if not arguments and name in _ARGUMENT_REQUIRED:
            raise RequestError(f"prepare: {name}: missing its argument, wanted {{ {name} = … }}")
        found.append((name, tuple(arguments)))
    return found


def apply_steps(height_field: HeightField, steps: Sequence[Step]) -> HeightField:
    """Apply all steps in order and return the height field.

    Raises:
        ValueError: if a step is invalid or cannot be applied.
    """
    for name, arguments in check_steps(steps):
        height_field = _STEPS[name][0](height_field, *arguments)
    return height_field


def step_of(text: str) -> Step:
    """Parse a step given on the command line: `level_plane`, `despike=4`, `crop_periods=x`.

    Raises:
        ValueError: if there is no such step, or its argument is missing or wrong.
    """
    name, equals, value = text.partition("=")
    if name not in _STEPS:
        raise RequestError(f"prepare: got {text}, wanted one of {', '.join(_STEPS)}{did_you_mean(name, _STEPS)}")
    argument: float | str = value
    with suppress(ValueError):
        argument = float(value)
    _, is_valid, wanted = _STEPS[name]
    if equals and not is_valid(argument):
        form = name if (is_valid, wanted) == _NO_ARGUMENT else f"{name}=…"
        raise RequestError(f"prepare: got {text}, wanted {form}, {wanted}")
    if not equals and name in _ARGUMENT_REQUIRED:
        raise RequestError(f"prepare: got {text}, wanted {name}=…, {wanted}")
    return {name: argument} if equals else name


def _after(
    height_field: HeightField,
    heights: NDArray,
    description: str,
    pixel_size: tuple[float, float] | None = None,
    filled: int = 0,
) -> HeightField:
    source = f"{height_field.source}; {description}"
    size, filled = pixel_size or height_field.pixel_size, height_field.filled + filled
    return HeightField(heights, size, source, keep_missing=True, filled=filled)


def _check_any(name: str, heights: NDArray[np.float64]) -> None:
    if np.isnan(heights).all():
        raise RequestError(f"{name}: all remaining pixels are missing")
