"""The difference between two pictures: exposure, CIEDE2000, luminance."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...errors import RequestError
from ...optics.color import XYZ_to_linear_sRGB, auto_exposure, delta_E, into_gamut


@dataclass(frozen=True, eq=False)
class Difference:
    """Difference of a picture from a reference.

    Attributes:
        exposure: the factor by which the picture was multiplied, so that both have the same mean luminance.
        delta_e: (height, width) CIEDE2000, NaN where nothing is compared.
        luminance_error: Σ|Y − Y_ref| / Σ Y_ref, as shown.
    """

    exposure: float
    delta_e: NDArray[np.float64]
    luminance_error: float

    @property
    def mean(self) -> float:
        """The mean CIEDE2000."""
        return float(np.nanmean(self.delta_e))

    @property
    def percentile_95(self) -> float:
        """The 95th percentile of CIEDE2000."""
        return float(np.nanpercentile(self.delta_e, 95))

    @property
    def max(self) -> float:
        """The maximum CIEDE2000."""
        return float(np.nanmax(self.delta_e))


def as_shown(xyz: NDArray[np.float64]) -> NDArray[np.float64]:
    """Scale colours with Y > 1 to Y = 1 at equal chromaticity: CIEDE2000 is not defined above white."""
    return xyz / np.maximum(xyz[..., 1:2], 1)


def white_luminance(xyz: NDArray[np.float64], where: NDArray[np.bool_]) -> float:
    """Return the luminance that a preview of the picture shows as white (`auto_exposure` of the pixels in `where`)."""
    return 1 / auto_exposure(into_gamut(XYZ_to_linear_sRGB(xyz[where])))


def difference(
    reference: NDArray[np.float64], xyz: NDArray[np.float64], where: NDArray[np.bool_], white: float
) -> Difference:
    """Compare two pictures.

    Args:
        reference: XYZ, (height, width, 3).
        xyz: of the other picture, likewise.
        where: (height, width), the pixels that are compared.
        white: the luminance of the reference that is shown as white.

    Raises:
        ValueError: if there are no such pixels, or one picture is black there.
    """
    sums = [float(picture[where][:, 1].sum()) for picture in (reference, xyz)]
    if not min(sums) > 0:
        raise RequestError(f"luminance: got sums {sums[0]:.3g} and {sums[1]:.3g} of two pictures, wanted positive ones")
    exposure = sums[0] / sums[1]
    first, second = as_shown(reference[where] / white), as_shown(xyz[where] * (exposure / white))
    delta_e = np.full(where.shape, np.nan)
    delta_e[where] = delta_E(first, second)
    error = np.abs(second[:, 1] - first[:, 1]).sum() / first[:, 1].sum()
    return Difference(exposure, delta_e, float(error))


def time_of_error(error: float, seconds: ArrayLike, errors: ArrayLike) -> float:
    """Return the time after which the error of a picture falls below a given one, interpolated in logarithms.

    Args:
        error: positive.
        seconds: (n,) ascending, of pictures.
        errors: (n,) of these.

    Returns:
        The first time if that error is below already, NaN if none is.
    """
    seconds, errors = np.log(seconds), np.log(errors)
    below = np.flatnonzero(errors < np.log(error))
    if not len(below):
        return float("nan")
    span = slice(max(below[0] - 1, 0), below[0] + 1)
    return float(np.exp(np.interp(-np.log(error), -errors[span], seconds[span])))


def noise(halves: NDArray[np.float64] | None, where: NDArray[np.bool_], white: float) -> float | None:
    """Estimate the mean CIEDE2000 between a picture and its noise-free limit: half of it between its two halves.

    The variance of the mean of two halves is a quarter of the variance of their difference.

    Args:
        halves: of `Picture`.
        where: (height, width), the pixels that are compared.
        white: the luminance that is shown as white.
    """
    if halves is None:
        return None
    first, second = (as_shown(half[where] / white) for half in halves)
    return float(delta_E(first, second).mean()) / 2
