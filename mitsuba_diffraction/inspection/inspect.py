"""Inspection of a surface before it is rendered."""

from __future__ import annotations

import warnings
from collections.abc import Callable
from dataclasses import dataclass, field

import numpy as np

from ..grating_spectrum import GratingSpectrum
from ..outputs import plain
from ..precomputation import precompute
from ..scalar_theory import ScalarError, scalar_error
from ..settings import SUN_COHERENCE_LENGTH, VISIBLE, Settings
from ..spectrum.sample import carried_coherence_length, standard_error
from ..surface.heightfield import HeightField
from ..surface.periods import Period, find_periods, repeated
from .colours import LONGEST_COHERENCE
from .statistics import Statistics, statistics
from .uncertainty import SHARE, Change, changes, concerns

_TOLERANCE = 0.02
_MOST_TIMES = 8


@dataclass(frozen=True)
class Inspection:
    """A surface in numbers.

    Attributes:
        height_field: the surface.
        extent: "tile" or "sample".
        statistics: heights, slopes, tilt.
        periods: as of `find_periods`: single ones, then bands; empty if none is significant.
        carried: the coherence length that a scan supports, µm, at most that of sunlight; a tile supports any.
        coherence_length: the requested one, limited to `carried`, µm.
        standard_error: of a sample's spectrum at that coherence length, a share of the reflected power; None of a tile.
        scalar_error: of scalar theory for this surface.
        changes: effects of ±5 % of height scale, pixel size and, for a scan, tip broadening; empty without a period.
        concerns: reasons to distrust a picture.
        spectrum: of at most `LONGEST_COHERENCE`, for predicted colours.
        shown: the height field; a small tile is repeated, a profile extended to a square.
    """

    height_field: HeightField
    extent: str
    statistics: Statistics
    periods: tuple[Period, ...]
    carried: float
    coherence_length: float
    standard_error: float | None
    scalar_error: ScalarError
    changes: tuple[Change, ...]
    concerns: tuple[str, ...]
    spectrum: GratingSpectrum = field(repr=False)
    shown: HeightField = field(repr=False)

    @property
    def direction(self) -> float:
        """The direction, in degrees, of the plane in which colours are shown: that of the main period, else x."""
        return self.periods[0].direction if self.periods else 0.0

    def as_json(self) -> dict[str, object]:
        """Return all numbers by name, lengths in µm; what is not a number is None."""
        rows, columns = self.height_field.shape
        return plain(
            {
                "source": self.height_field.source,
                "extent": self.extent,
                "pixels": [columns, rows],
                "pixel_size": self.height_field.pixel_size,
                "size": self.height_field.tile_size,
                "filled": self.height_field.filled,
                "statistics": self.statistics,
                "periods": self.periods,
                "carried_coherence_length": self.carried,
                "coherence_length": self.coherence_length,
                "standard_error": self.standard_error,
                "scalar_error": self.scalar_error,
                "changes": self.changes,
                "concerns": self.concerns,
            }
        )


def inspect(
    height_field: HeightField,
    *,
    extent: str = "sample",
    coherence_length: float = SUN_COHERENCE_LENGTH,
    measured: bool = True,
    progress: Callable[[int, int], None] | None = None,
) -> Inspection:
    """Inspect a surface.

    Args:
        height_field: the surface.
        extent: "sample": a piece of a larger, irregular surface; "tile": it repeats.
        coherence_length: the requested one, µm.
        measured: whether it is a scan; tilt, steps of the heights and the tip matter only for scans.
        progress: called with (steps done, steps in all).

    Raises:
        ValueError: on an unknown extent, a coherence length that is not positive, or a sample of too few pixels.
    """
    Settings(extent, coherence_length)
    sun = SUN_COHERENCE_LENGTH
    carried = carried_coherence_length(height_field, sun) if extent == "sample" else max(sun, coherence_length)
    used = min(float(coherence_length), carried)
    step = iter(range(1, 5))
    report = progress or (lambda done, total: None)

    def build(surface: HeightField) -> GratingSpectrum:
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", UserWarning)  # of pixels and coherence `concerns` tells in its own words
            spectrum = precompute(
                surface,
                extent=extent,
                coherence_length=min(used, LONGEST_COHERENCE),
                # Heights may be scaled up by the share that is tried.
                wavelengths=(VISIBLE[0] / (1 + SHARE), VISIBLE[1]),
                tolerance=_TOLERANCE,
            )
        report(next(step), 4)
        return spectrum

    numbers = statistics(height_field, extent=extent)
    shortest = VISIBLE[0] * 1e-3
    periods = find_periods(height_field, extent=extent)
    spectrum = build(height_field)
    scalar = scalar_error(height_field, extent)
    result = Inspection(
        height_field=height_field,
        extent=extent,
        statistics=numbers,
        periods=periods,
        carried=carried,
        coherence_length=used,
        standard_error=standard_error(
            height_field, coherence_length=used, largest_kappa=4 * np.pi / shortest, reach=2 / shortest
        )
        if extent == "sample"
        else None,
        scalar_error=scalar,
        changes=changes(height_field, spectrum, periods[0], extent=extent, measured=measured, build=build)
        if periods
        else (),
        concerns=concerns(height_field, numbers, used, measured=measured, scalar=scalar),
        spectrum=spectrum,
        shown=_widened(repeated(height_field, _MOST_TIMES) if extent == "tile" else height_field),
    )
    report(4, 4)
    return result


def _widened(field: HeightField) -> HeightField:
    """Extend a profile along its axis of one pixel to a square."""
    for axis in (0, 1):
        if field.shape[axis] == 1 < field.shape[1 - axis]:
            count = min(field.shape[1 - axis], 256)
            sizes = list(field.pixel_size)
            sizes[1 - axis] = field.tile_size[axis] / count
            return HeightField(np.repeat(field.heights, count, axis), (sizes[0], sizes[1]), field.source)
    return field
