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
# Light of an order in a direction, as a lamp of some degrees and the edges of an object leave it, nm.
_BANDS = (20.0, 40.0, 60.0, 80.0, 120.0, 160.0, 220.0)  # full widths
_STEPS = (20.0, 50.0, 100.0, 150.0)
_CENTRES = 25  # of bands and steps
_WEIGHT_OF_BIN = 0.6  # of a mixture: 1
_WEIGHT_OF_LUMINANCE = 2.0
_WEIGHT_OF_WHITE = 10.0


def nonnegative_colours(edges: Real, colours: Real) -> Real:
    """Return non-negative colours of bins in each of `WORKING_SPACES`, (spaces, n, 3), of which the mean is white.

    Light of one wavelength lies outside of a working space, but most mixtures that an order shows lie inside. These
    colours minimise the squared error of XYZ, relative to the luminance, of such mixtures and of the bins themselves.

    Args:
        edges: of the bins, µm, (n + 1,).
        colours: linear sRGB of their light, (n, 3), of which the mean is white.
    """
    from scipy.optimize import nnls

    mixtures, weights = _mixtures(edges * 1e3)
    XYZ = mixtures @ colours @ SRGB_TO_XYZ.T
    weights = (weights / XYZ[:, 1])[:, None] * np.array([1, np.hypot(1, _WEIGHT_OF_LUMINANCE), 1])
    found = []
    for matrix in WORKING_SPACES.values():
        rows = np.einsum("me,eb,mn->menb", weights, SRGB_TO_XYZ @ np.linalg.inv(matrix), mixtures)
        white = np.tile(np.eye(3), len(colours)) * _WEIGHT_OF_WHITE / len(colours)
        equations = np.vstack([rows.reshape(-1, 3 * len(colours)), white])
        right = np.append((weights * XYZ).ravel(), 3 * [_WEIGHT_OF_WHITE])
        q, r = np.linalg.qr(equations)
        positive = nnls(r, q.T @ right, maxiter=100 * len(right))[0].reshape(-1, 3)
        found.append(positive / positive.mean(axis=0))
    return np.stack(found)


def _mixtures(edges: Real) -> tuple[Real, Real]:
    """Return the fraction of each bin in mixtures, (m, n), and their weights, (m,); edges in nm."""
    wavelengths = edges[:-1, None] + np.diff(edges)[:, None] * (np.arange(8) + 0.5) / 8
    from_centres = wavelengths - np.linspace(edges[0] + 20, edges[-1] - 30, _CENTRES)[:, None, None]
    found = [np.exp(-4 * np.log(2) * (from_centres / width) ** 2).mean(axis=2) for width in _BANDS]
    for width in _STEPS:
        step = (1 / (1 + np.exp(-3.5 * from_centres / width))).mean(axis=2)
        found += [step, 1 - step]
    bins = len(edges) - 1
    mixtures = np.concatenate([np.eye(bins), *found])
    return mixtures / bins, np.append(np.full(bins, _WEIGHT_OF_BIN), np.ones(len(mixtures) - bins))
