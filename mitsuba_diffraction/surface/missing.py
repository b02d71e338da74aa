"""Missing pixels: NaN, infinite or masked."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray
from scipy import sparse
from scipy.sparse.linalg import splu

from ..errors import RequestError


def as_heights(heights: ArrayLike) -> NDArray[np.float64]:
    """Return heights as an array, (N_y, N_x) µm, NaN where masked; copied only if necessary.

    Raises:
        ValueError: if it is not a two-dimensional array of real numbers with at least one pixel.
    """
    try:
        if np.iscomplexobj(heights):
            raise RequestError
        if np.ma.isMaskedArray(heights):
            heights = heights.astype(np.float64).filled(np.nan)
        array = np.asarray(heights, dtype=np.float64)
    except (TypeError, ValueError):
        raise RequestError(
            f"heights: got {type(heights).__name__}, wanted a two-dimensional array of real heights in µm"
        ) from None
    if array.ndim != 2 or array.size == 0:
        raise RequestError(f"heights: got an array of shape {array.shape}, wanted (rows, columns), at least (1, 1)")
    return array


def fill_missing(heights: ArrayLike, pixel_size: tuple[float, float] = (1.0, 1.0)) -> NDArray[np.float64]:
    """Fill missing pixels by harmonic interpolation.

    The missing heights minimise ∫|∇h|² subject to the known ones, so that ∇²h = 0 in every hole. At a missing pixel p,

        Σ_n w_n (h_n − h_p) = 0,    w = 1/d_x² along a row, 1/d_y² along a column

    over those of its four neighbours n that lie inside the array. At the edge of the array this implies the natural
    boundary condition ∂h/∂n = 0. Filled heights lie within the range of the known ones.

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
    heights = as_heights(heights)
    missing = ~np.isfinite(heights)
    rows, columns = np.nonzero(missing)
    count = len(rows)
    if count == 0:
        return heights
    if count == heights.size:
        raise RequestError(f"heights: all {count} pixels are missing, wanted at least one height in µm to fill from")
    known = heights[~missing]
    lowest, highest = known.min(), known.max()
    middle = lowest / 2 + highest / 2  # solved relative to it, to preserve digits
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
    filled[missing] = np.clip(factors.solve(right_side) + middle, lowest, highest)
    return filled
