"""Height fields, and their missing pixels: NaN, infinite or masked."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import RequestError

_MIN_PIXEL, _MAX_PIXEL = 1e-9, 1e9  # µm: squares and products of others overflow


def as_pixel_size(value: float | tuple[float, float]) -> tuple[float, float]:
    """Return one number or (x, y), in µm, as a pair of positive floats."""
    try:
        if isinstance(value, str | bool):
            raise TypeError
        # To type checkers a float is no Real.
        x, y = (value, value) if isinstance(value, float | Real) else value
        pair = (float(x), float(y))
    except (TypeError, ValueError, OverflowError):
        raise RequestError(f"pixel_size: got {value!r}, wanted one number or (x, y) in µm") from None
    if not all(np.isfinite(p) and p > 0 for p in pair):
        raise RequestError(f"pixel_size: got {value!r}, wanted positive numbers in µm")
    return pair


@dataclass(frozen=True, eq=False)
class HeightField:
    """Heights h(y, x) on a regular grid.

    Attributes:
        heights: (N_y, N_x) float64, µm; row ↔ +y, column ↔ +x.
        pixel_size: (x, y) in µm; one number for square pixels.
        source: origin of the heights (a file name, a formula) and processing steps, as text.
        filled: number of missing pixels that were filled, including those cut off afterwards.

    Missing pixels (NaN, infinite or masked) are refused. `fill_missing=True` interpolates them (`harmonic_fill`) and
    adds their number to `filled`. `keep_missing=True` keeps them as NaN for the steps of `prepare`; such a height
    field has neither a height range nor a spectrum.

    Raises:
        ValueError: if the heights are not a two-dimensional array of finite numbers with at least one pixel (with
            `fill_missing=True` or `keep_missing=True`: one finite number is enough), or if the pixel size is not
            positive.
    """

    heights: NDArray[np.float64]
    pixel_size: tuple[float, float]
    source: str = "array"
    filled: int = 0

    def __init__(
        self,
        heights: ArrayLike,
        pixel_size: float | tuple[float, float],
        source: str = "array",
        fill_missing: bool = False,
        keep_missing: bool = False,
        filled: int = 0,
    ) -> None:
        for name, value in (("fill_missing", fill_missing), ("keep_missing", keep_missing)):
            if not isinstance(value, bool | np.bool_):
                raise RequestError(f"{name}: got {value!r}, wanted True or False")
        array = np.array(as_heights(heights), order="C")
        pixel_size = as_pixel_size(pixel_size)
        if not all(_MIN_PIXEL <= p <= _MAX_PIXEL for p in pixel_size):
            raise RequestError(f"pixel_size: got {pixel_size} µm, wanted {_MIN_PIXEL:g} to {_MAX_PIXEL:g}")
        gaps = ~np.isfinite(array)
        if fill_missing and gaps.any():
            count = int(gaps.sum())
            array = harmonic_fill(array, pixel_size)
            source = f"{source} ({count} missing pixel{'s' if count > 1 else ''} filled)"
            filled += count
        elif keep_missing:
            if gaps.all():
                raise RequestError(f"heights: all {gaps.size} pixels are missing, wanted at least one height in µm")
            array[gaps] = np.nan
        else:
            _refuse(gaps)
        array.setflags(write=False)
        object.__setattr__(self, "heights", array)
        object.__setattr__(self, "pixel_size", pixel_size)
        object.__setattr__(self, "source", str(source))
        object.__setattr__(self, "filled", filled)

    @property
    def shape(self) -> tuple[int, int]:
        """(N_y, N_x): rows, columns."""
        rows, columns = self.heights.shape
        return rows, columns

    @property
    def tile_size(self) -> tuple[float, float]:
        """(T_x, T_y) in µm: the period of the surface if the patch is repeated."""
        rows, columns = self.shape
        return columns * self.pixel_size[0], rows * self.pixel_size[1]

    @property
    def gaps(self) -> NDArray[np.bool_]:
        """Mask of missing pixels, (N_y, N_x)."""
        return np.isnan(self.heights)

    @property
    def height_range(self) -> float:
        """Highest minus lowest point, µm."""
        _refuse(self.gaps)
        return float(np.ptp(self.heights))

    @property
    def half_range(self) -> float:
        """H in µm: the centred heights obey |h| ≤ H."""
        return self.height_range / 2

    @property
    def centred(self) -> NDArray[np.float64]:
        """Heights relative to the centre of their range, (N_y, N_x) µm. An offset only changes the phase of e^{iκh}."""
        _refuse(self.gaps)
        return self.heights - (self.heights.min() + self.heights.max()) / 2

    @property
    def digest(self) -> str:
        """SHA-256 of the heights and the pixel size, hexadecimal."""
        content = hashlib.sha256(np.asarray([*self.shape], dtype="<i8").tobytes())
        content.update(np.asarray(self.pixel_size, dtype="<f8").tobytes())
        content.update(self.heights.astype("<f8").tobytes())
        return content.hexdigest()

    def __repr__(self) -> str:
        rows, columns = self.shape
        x, y = self.tile_size
        height_range = np.nanmax(self.heights) - np.nanmin(self.heights)
        gaps = f"{count} missing, " if (count := int(self.gaps.sum())) else ""
        return (
            f"HeightField({columns} × {rows} pixels, {gaps}{x:.4g} × {y:.4g} µm, "
            f"height range {height_range:.4g} µm, source={self.source!r})"
        )


def _refuse(gaps: NDArray[np.bool_]) -> None:
    if gaps.any():
        row, column = np.argwhere(gaps)[0]
        raise RequestError(
            f"heights: {gaps.sum()} of {gaps.size} pixels are missing or not finite, "
            f"the first at row {row}, column {column}; wanted finite heights in µm, or fill_missing, which "
            "interpolates them from their surroundings"
        )


def as_heights(heights: ArrayLike) -> NDArray[np.float64]:
    """Return heights as an array, (N_y, N_x) µm, NaN where masked; copied only if necessary."""
    got = type(heights).__name__
    try:
        kind = np.asarray(heights).dtype
        got += f" of type {kind}"
        if kind.kind in "bcSU":
            raise TypeError
        if np.ma.isMaskedArray(heights):
            heights = np.ma.filled(np.ma.asarray(heights, np.float64), np.nan)
        array = np.asarray(heights, dtype=np.float64)
    except (TypeError, ValueError):
        raise RequestError(f"heights: got {got}, wanted a two-dimensional array of real heights in µm") from None
    if array.ndim != 2 or array.size == 0:
        raise RequestError(f"heights: got an array of shape {array.shape}, wanted (rows, columns), at least (1, 1)")
    return array


def harmonic_fill(heights: ArrayLike, pixel_size: tuple[float, float] = (1.0, 1.0)) -> NDArray[np.float64]:
    """Fill missing pixels by harmonic interpolation.

    The missing heights minimise ∫|∇h|² subject to the known ones, so that ∇²h = 0 in every hole. At a missing pixel p,

        Σ_n w_n (h_n − h_p) = 0,    w = 1/d_x² along a row, 1/d_y² along a column

    over the pixel's neighbours n, of the four, that lie inside the array. At the edge of the array this implies the
    natural boundary condition ∂h/∂n = 0. Filled heights lie within the range of the known ones.

    Pérez, Gangnet and Blake 2003, "Poisson image editing", ACM Transactions on Graphics 22(3), 313–318: equations
    1 and 2, and 7 without a guidance field, with neighbourhoods truncated at the edge of the array.

    Args:
        heights: (N_y, N_x) µm; a pixel is missing where it is NaN, infinite or masked.
        pixel_size: (d_x, d_y), positive; only their ratio matters.

    Returns:
        (N_y, N_x) µm, a new array, or the input if nothing is missing.

    Raises:
        ValueError: if the heights are not a two-dimensional array of real numbers with at least one pixel, or if all
            of them are missing.
    """
    from scipy import sparse
    from scipy.sparse.linalg import splu

    heights = as_heights(heights)
    missing = ~np.isfinite(heights)
    rows, columns = np.nonzero(missing)
    count = len(rows)
    if count == 0:
        return heights
    if count == heights.size:
        raise RequestError(f"heights: all {count} pixels are missing, wanted at least one height in µm to fill from")
    known = heights[~missing]
    minimum, maximum = known.min(), known.max()
    middle = minimum / 2 + maximum / 2  # solved relative to it, to preserve digits
    unknown = np.empty(heights.shape, np.int64)
    unknown[missing] = np.arange(count)
    weight_x, weight_y = (np.min(pixel_size) / np.asarray(pixel_size, np.float64)) ** 2

    diagonal, right_side = np.zeros(count), np.zeros(count)
    links = []
    for down, right, weight in ((0, -1, weight_x), (0, 1, weight_x), (-1, 0, weight_y), (1, 0, weight_y)):
        row, column = rows + down, columns + right
        pixel = np.flatnonzero((row >= 0) & (row < heights.shape[0]) & (column >= 0) & (column < heights.shape[1]))
        row, column = row[pixel], column[pixel]
        diagonal[pixel] += weight
        is_missing = missing[row, column]
        right_side[pixel[~is_missing]] += weight * (heights[row, column][~is_missing] - middle)
        links.append((pixel[is_missing], unknown[row, column][is_missing], weight))
    equation = np.concatenate([np.arange(count), *(pixel for pixel, _, _ in links)])
    neighbour = np.concatenate([np.arange(count), *(other for _, other, _ in links)])
    values = np.concatenate([diagonal, *(np.full(len(pixel), -weight) for pixel, _, weight in links)])
    matrix = sparse.csc_matrix((values, (equation, neighbour)), shape=(count, count))
    # Symmetric and positive definite (every hole borders on a known pixel): no pivoting needed.
    factors = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    filled = heights.copy()
    filled[missing] = np.clip(factors.solve(right_side) + middle, minimum, maximum)
    return filled
