"""The cells of constant density along one axis of the frequency plane, and what of a spectrum lies in each."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.special import ndtr

from ..spectrum import GratingSpectrum
from ..spectrum.orders import OrderGrid
from ..spectrum.spline_grid import spline_integral

FINE = 0.06  # cycles/µm: cells are no wider, to follow the horizon
LOBE = 4.0  # σ_q: how far the lobes of orders are followed


@dataclass(frozen=True, eq=False)
class CellAxis:
    """The cells along one axis.

    Attributes:
        spacing: Δ in cycles/µm, a whole part of the spacing of the nodes.
        largest: M, |m| ≤ M.
        shares: (2 M + 1, nodes), the integral of the lobe or spline of each node over each cell.
    """

    spacing: float
    largest: int
    shares: NDArray[np.float64]

    @classmethod
    def of(cls, spectrum: GratingSpectrum, axis: int, widest: float) -> CellAxis:
        """Along x (0) or y (1), of cells that are no wider than so many σ_q."""
        grid, sigma = spectrum.grid, spectrum.lobe_width
        nodes = grid.frequencies()[axis]
        if isinstance(grid, OrderGrid):
            between, side = 1 / grid.tile_size[axis], min(spectrum.lobes[axis].half_width, LOBE * sigma)
        else:
            between, side = grid.spacing[axis], 1.5 * grid.spacing[axis]
        spacing = between / np.ceil(between / min(widest * sigma, FINE))
        largest = int(np.ceil((nodes[-1] + side) / spacing - 0.5))
        ends = (np.arange(-largest, largest + 2) - 0.5) * spacing
        if isinstance(grid, OrderGrid):
            below = ndtr((ends[:, None] - nodes) / sigma)
        else:
            below = spline_integral((ends[:, None] - nodes) / between)
        return cls(spacing, largest, np.diff(below, axis=0))
