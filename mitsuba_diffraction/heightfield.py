"""A height field: the surface as it was measured or designed."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from numbers import Real

import numpy as np
from numpy.typing import ArrayLike, NDArray

from . import missing


def as_pixel_size(value: float | tuple[float, float]) -> tuple[float, float]:
    """One number or (x, y), in µm, as a pair of positive floats.

    Raises:
        ValueError: if the value is neither, or not positive and finite.
    """
    if isinstance(value, Real):
        pair = (float(value), float(value))
    else:
        try:
            if isinstance(value, str):
                raise TypeError
            x, y = value
            pair = (float(x), float(y))
        except (TypeError, ValueError):
            raise ValueError(f"pixel_size: got {value!r}, wanted one number or (x, y) in µm") from None
    if not all(np.isfinite(p) and p > 0 for p in pair):
        raise ValueError(f"pixel_size: got {value!r}, wanted positive numbers in µm")
    return pair


@dataclass(frozen=True, eq=False)
class HeightField:
    """Heights h(y, x) on a regular grid.

    Attributes:
        heights: (N_y, N_x) float64, µm; row ↔ +y, column ↔ +x.
        pixel_size: (x, y) in µm; one number stands for square pixels.
        source: where the heights come from (a file name, a formula), for people to read; it says how many were filled.
        filled: how many pixels were missing and are filled.

    Pixels that are missing (NaN, infinite or masked) are refused. With `fill_missing=True` they are filled from
    their surroundings instead; see `missing.fill_missing`.

    Raises:
        ValueError: if the heights are not a two-dimensional array of finite numbers with at least one pixel (with
            `fill_missing=True`: one finite number is enough), or if the pixel size is not positive.
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
    ) -> None:
        if not isinstance(fill_missing, bool | np.bool_):
            raise ValueError(f"fill_missing: got {fill_missing!r}, wanted True or False")
        array = np.array(missing.as_heights(heights), order="C")
        pixel_size = as_pixel_size(pixel_size)
        places = np.argwhere(~np.isfinite(array))
        filled = len(places)
        if filled and not fill_missing:
            row, column = places[0]
            raise ValueError(
                f"heights: {filled} of {array.size} pixels are missing or not finite, "
                f"the first at row {row}, column {column}; wanted finite heights in µm "
                "(fill_missing=True, or --fill-missing, fills them from their surroundings)"
            )
        if filled:
            array = missing.fill_missing(array, pixel_size)
            source = f"{source} ({filled} missing pixel{'s' if filled > 1 else ''} filled)"
        array.setflags(write=False)
        object.__setattr__(self, "heights", array)
        object.__setattr__(self, "pixel_size", pixel_size)
        object.__setattr__(self, "source", str(source))
        object.__setattr__(self, "filled", filled)

    @property
    def shape(self) -> tuple[int, int]:
        """(N_y, N_x): rows, columns."""
        return self.heights.shape

    @property
    def tile_size(self) -> tuple[float, float]:
        """(T_x, T_y) in µm: the period of the surface if the patch repeats for ever."""
        rows, columns = self.shape
        return columns * self.pixel_size[0], rows * self.pixel_size[1]

    @property
    def height_range(self) -> float:
        """Highest minus lowest point, µm."""
        return float(np.ptp(self.heights))

    @property
    def half_range(self) -> float:
        """H in µm: the centred heights obey |h| ≤ H."""
        return self.height_range / 2

    @property
    def centred(self) -> NDArray[np.float64]:
        """Heights about the middle of their range, (N_y, N_x) µm. A common offset changes the phase of e^{iκh} only."""
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
        return (
            f"HeightField({columns} × {rows} pixels, {x:.4g} × {y:.4g} µm, "
            f"height range {self.height_range:.4g} µm, source={self.source!r})"
        )
