"""Colours of bins of wavelengths in the working spaces of Blender, where a renderer takes no negative ones."""

from __future__ import annotations

from types import MappingProxyType

import numpy as np

from ..array_types import Real
from ..optics.color import SRGB_TO_XYZ

WORKING_SPACES = MappingProxyType(
    {
        "Linear Rec.709": np.eye(3),
        # ITU-R BT.2087.
        "Linear Rec.2020": np.array(
            [[0.627404, 0.329283, 0.043313], [0.069097, 0.919540, 0.011362], [0.016391, 0.088013, 0.895595]]
        ),
        # AP1 primaries, from D65 by Bradford's adaptation.
        "ACEScg": np.array(
            [[0.613097, 0.339523, 0.047379], [0.070194, 0.916354, 0.013452], [0.020616, 0.109570, 0.869815]]
        ),
    }
)
"""Matrices from linear sRGB, by Blender's names."""
_SPREADS = (0.03, 0.1, 0.2)  # standard deviations of the light of an order in a direction, of its mean wavelength
_MEANS = 60  # of the wavelengths of such mixtures
_WEIGHT_OF_MIXTURES = 4.0  # relative to that of a bin
_WEIGHT_OF_WHITE = 1e3


def nonnegative_colours(edges: Real, colours: Real) -> Real:
    """Return non-negative colours of bins in each of `WORKING_SPACES`, (spaces, n, 3), of which the mean is white.

    Light of one wavelength lies outside of a working space, and what a display shows is a mixture of neighbouring ones.
    These colours minimise the squared error of the XYZ of such mixtures, and of the bins themselves, without which a
    few bins would have all of the light and a picture would be noisy.

    Args:
        edges: of the bins, µm, (n + 1,).
        colours: linear sRGB of their light, (n, 3), of which the mean is white.
    """
    from scipy.optimize import nnls

    middle = (edges[1:] + edges[:-1]) / 2
    means, spreads = (
        x.ravel() for x in np.meshgrid(np.linspace(middle[0], middle[-1], _MEANS), np.array(_SPREADS), indexing="ij")
    )
    mixtures = np.exp(-0.5 * ((middle - means[:, None]) / (spreads * means)[:, None]) ** 2)
    mixtures *= _WEIGHT_OF_MIXTURES / mixtures.sum(axis=1, keepdims=True)
    mixtures = np.vstack([np.eye(len(middle)), mixtures])
    found = []
    for matrix in WORKING_SPACES.values():
        to_XYZ = SRGB_TO_XYZ @ np.linalg.inv(matrix)
        rows = np.einsum("eb,mn->menb", to_XYZ, mixtures).reshape(-1, 3 * len(colours))
        wanted = rows @ (colours @ matrix.T).ravel()
        white = np.tile(np.eye(3), len(colours)) * _WEIGHT_OF_WHITE / len(colours)
        solved, _ = nnls(np.vstack([rows, white]), np.append(wanted, 3 * [_WEIGHT_OF_WHITE]))
        positive = solved.reshape(-1, 3)
        found.append(positive / positive.mean(axis=0))
    return np.stack(found)
