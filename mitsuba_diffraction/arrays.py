"""Shapes of the arguments shared by all evaluations."""

from __future__ import annotations

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import RequestError


def matching(q: ArrayLike, kappa: ArrayLike) -> tuple[NDArray[np.float64], NDArray[np.float64]]:
    """q (..., 2) and κ (...) as float64 arrays, broadcast against each other.

    Raises:
        ValueError: if q does not end in a pair or is not finite, or the shapes do not broadcast.
    """
    q = np.asarray(q, np.float64)
    kappa = np.asarray(kappa, np.float64)
    if q.ndim == 0 or q.shape[-1] != 2:
        raise RequestError(f"q: got shape {q.shape}, wanted (..., 2) in cycles/µm")
    if not np.isfinite(q).all():
        raise RequestError("q: got numbers that are not finite, wanted cycles/µm")
    try:
        shape = np.broadcast_shapes(q.shape[:-1], kappa.shape)
    except ValueError:
        raise RequestError(
            f"kappa: got shape {kappa.shape}, which does not broadcast with q of shape {q.shape}"
        ) from None
    return np.broadcast_to(q, (*shape, 2)), np.broadcast_to(kappa, shape)
