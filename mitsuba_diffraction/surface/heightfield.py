"""Height fields."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import RequestError
from . import missing


def as_pixel_size(value: float | tuple[float, float]) -> tuple[float, float]:
    """Return one number or (x, y), in µm, as a pair of positive floats.

    Raises:
        ValueError: if the value is neither, or not positive and finite.
    """
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
        filled: how many missing pixels were filled, including those that were cut off since.

    Missing pixels (NaN, infinite or masked) are refused. `fill_missing=True` interpolates them instead; see
    `missing.fill_missing`; they are added to `filled`. `keep_missing=True` keeps them as NaN for the steps of
    `prepare`; such a height field has neither a height range nor a spectrum.

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
        if not (isinstance(filled, int) and filled >= 0):
            raise RequestError(f"filled: got {filled!r}, wanted a number of pixels")
        array = np.array(missing.as_heights(heights), order="C")
        pixel_size = as_pixel_size(pixel_size)
        gaps = ~np.isfinite(array)
        if fill_missing and gaps.any():
            count = int(gaps.sum())
            array = missing.fill_missing(array, pixel_size)
            source = f"{source} ({count} missing pixel{'s' if count > 1 else ''} filled)"
            filled += count
        elif keep_missing:
            if gaps.all():
                raise RequestError(f"heights: all {gaps.size} pixels are missing, wanted at least one height in µm")
            array[gaps] = np.nan
        elif gaps.any():
            raise RequestError(_refusal(gaps))
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
        """Highest minus lowest point, µm.

        Raises:
            ValueError: if pixels are missing.
        """
        self._refuse_gaps()
        return float(np.ptp(self.heights))

    def _refuse_gaps(self) -> None:
        if (gaps := self.gaps).any():
            raise RequestError(_refusal(gaps))

    @property
    def half_range(self) -> float:
        """H in µm: the centred heights obey |h| ≤ H."""
        return self.height_range / 2

    @property
    def centred(self) -> NDArray[np.float64]:
        """Heights relative to the centre of their range, (N_y, N_x) µm. An offset only changes the phase of e^{iκh}.

        Raises:
            ValueError: if pixels are missing.
        """
        self._refuse_gaps()
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


def _refusal(gaps: NDArray[np.bool_]) -> str:
    row, column = np.argwhere(gaps)[0]
    return (
        f"heights: {gaps.sum()} of {gaps.size} pixels are missing or not finite, "
        f"the first at row {row}, column {column}; wanted finite heights in µm "
        "(fill_missing=True, or --fill-missing, fills them from their surroundings)"
    )
