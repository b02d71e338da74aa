"""The mean power of each order over several patches, drawn anew from one kind of irregular surface."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import scipy.fft
from numpy.typing import NDArray

from ..errors import RequestError
from ..progress import Progress
from ..surface.heightfield import HeightField
from .tables import chebyshev_nodes, chebyshev_polynomials, chebyshev_transform, nodes_for, position
from .tile import TilePowers

# Where the interpolation in κ is compared with direct sums, parts of the largest κ.
_CHECKED = (0.137, 0.618, 0.983)


class MeanPowers(TilePowers):
    """(1/P) Σ_p η_m(κ) of P patches that each repeat: the mean over the many patches that a pixel covers.

    Powers are band-limited in κ by the height range, so that their values at Chebyshev nodes give them everywhere
    (Jacobi–Anger); transforming every patch anew for every κ would take ten times as long. The transforms at the nodes
    are in single precision. What that and the interpolation change is measured against direct sums in double precision
    and added to the error of a table.
    """

    def __init__(
        self,
        height_fields: Sequence[HeightField],
        reach: float,
        lobe_radius: float,
        largest_kappa: float,
        tolerance: float,
        progress: Progress,
    ) -> None:
        """Take patches of one size; reach and radius as `TilePowers`; the largest κ in rad/µm; and the tolerance.

        `progress` is called with the patches done and in all.
        """
        super().__init__(height_fields[0], reach, lobe_radius)
        self._largest_kappa = largest_kappa
        height_range = max(field.height_range for field in height_fields)
        self._nodes = nodes_for(largest_kappa * height_range / 2, 0.01 * tolerance)
        total = np.zeros((self._nodes, *self.grid.shape))
        checked = np.zeros((len(_CHECKED), *self.grid.shape))
        for number, field in enumerate(height_fields, 1):
            heights = field.centred.astype(np.float32)
            for j, kappa in enumerate((1 + chebyshev_nodes(self._nodes)) / 2 * largest_kappa):
                total[j] += self.grid.take(_powers(heights, kappa))
            one = TilePowers(field, reach, lobe_radius)
            for j, share in enumerate(_CHECKED):
                checked[j] += one(share * largest_kappa)
            progress(number, len(height_fields))
        flat = total.reshape(self._nodes, -1) / len(height_fields)
        self._coefficients = chebyshev_transform(self._nodes) @ flat
        self.own_error = max(
            float(np.abs(self(share * largest_kappa) - direct / len(height_fields)).sum())
            for share, direct in zip(_CHECKED, checked, strict=True)
        )

    def __call__(self, kappa: float) -> NDArray[np.float64]:
        """Compute the mean of η_m(κ), (rows, columns); κ in rad/µm."""
        values = chebyshev_polynomials(position(np.array([kappa]), self._largest_kappa), self._nodes)
        return (values @ self._coefficients).reshape(self.grid.shape)


def _powers(heights: NDArray[np.float32], kappa: float) -> NDArray[np.float32]:
    """Compute η_m(κ) of all orders in single precision, (N_y, N_x), as in `scipy.fft.fftfreq`."""
    phase = np.float32(kappa) * heights
    wave = np.empty(heights.shape, np.complex64)
    wave.real, wave.imag = np.cos(phase), np.sin(phase)
    transform = scipy.fft.fft2(wave, norm="forward", overwrite_x=True)
    return transform.real**2 + transform.imag**2


def check_patches(height_fields: Sequence[HeightField], extent: str) -> None:
    """Raise RequestError unless there is one patch, or several of one size that repeat."""
    if not height_fields:
        raise RequestError("patches: got none, wanted at least one")
    if len(height_fields) > 1 and extent != "tile":
        raise RequestError(f"patches: got {len(height_fields)} with extent {extent!r}, wanted 1, or extent 'tile'")
    first = height_fields[0]
    for field in height_fields[1:]:
        if field.shape != first.shape or not np.allclose(field.tile_size, first.tile_size, rtol=1e-9):
            raise RequestError(f"patches: got {field!r} beside {first!r}, wanted patches of one size")
