"""The light that a picture wants of a plate: a fraction of each wavelength in each direction."""

from __future__ import annotations

import math

import numpy as np
import scipy.ndimage
import scipy.sparse
from numpy.typing import ArrayLike

from ..array_types import Real
from ..errors import RequestError
from ..optics.color import lamp_to_linear_sRGB, upsampled
from .far_field import lobes_in_bins
from .plate import Plate

_BINS_PER_ORDER = 1.5
_MAX_PIXELS = 512  # along an edge, in which strokes are measured
_KEPT = 0.9  # of the bright part, by discs as wide as its finest strokes


def wanted_fractions(target: ArrayLike, plate: Plate) -> Real:
    """Return t, the wanted fraction of the light in each bin, (w, bins, bins), rows ↔ +y.

    Pixels are squares: the longer edge of the picture fills the frame, and the rest of it is dark. Colours are
    reflectances ρ(λ) of the light of a lamp (`upsampled`), t = ρ/max Σ ρ over the wavelengths: with one wavelength all
    of its light is wanted in the picture; in a grey picture the light of all wavelengths is.

    Raises:
        ValueError: if the target is not a picture, is black, or lies in the mirror direction.
    """
    try:
        picture = np.asarray(target, np.float64)
    except (TypeError, ValueError):
        raise RequestError(f"target: got {type(target).__name__}, wanted an array of numbers") from None
    if picture.ndim == 3 and picture.shape[2] in (2, 4):
        raise RequestError(f"target: got shape {picture.shape}, with alpha; wanted an opaque picture, grey or RGB")
    if picture.size == 0 or not (picture.ndim == 2 or (picture.ndim == 3 and picture.shape[2] == 3)):
        raise RequestError(f"target: got shape {picture.shape}, wanted (rows, columns) or (rows, columns, 3)")
    if not (np.isfinite(picture).all() and picture.min() >= 0):
        raise RequestError(
            f"target: got {np.count_nonzero(~(picture >= 0) | np.isinf(picture))} values that are negative or not "
            "finite, wanted linear radiance ≥ 0"
        )
    if picture.max() == 0:
        raise RequestError("target: got black everywhere, wanted light somewhere")
    channels = picture[..., None] if picture.ndim == 2 else picture
    count = math.ceil(_BINS_PER_ORDER * plate.orders_across)
    binned = _in_bins(channels / channels.max(), count)
    if binned.shape[-1] == 3 and np.ptp(binned, axis=-1).max() > 0:
        order, matrix = np.argsort(plate.wavelengths), lamp_to_linear_sRGB(plate.wavelengths)
        bands = upsampled(binned, matrix[order])[..., np.argsort(order)]
    else:
        bands = np.repeat(binned[..., :1], len(plate.wavelengths), axis=-1)
    wanted = np.moveaxis(bands, -1, 0) / bands.sum(axis=(0, 1)).max()
    middles = (plate.edges(count)[1:] + plate.edges(count)[:-1]) / 2
    near = np.hypot(*np.meshgrid(middles, middles)) < plate.pitch
    if wanted[:, ~near].sum() < 1e-9 * wanted.sum():
        raise RequestError(
            f"target: it is the mirror direction only (within {plate.pitch:.2g} of it), into which a flat plate sends "
            "all light; wanted light elsewhere, too"
        )
    return wanted


def is_coloured(wanted: Real) -> bool:
    """Return whether wavelengths have different targets."""
    return bool(np.ptp(wanted, axis=0).max() > 1e-6 * wanted.max())


def with_unused(wanted: Real, plate: Plate) -> Real:
    """Return t with the light that the colours leave unused in the lobe of order 0, if the plate wants it there."""
    if plate.unused != "mirror":
        return wanted
    edges, aim = plate.edges(wanted.shape[1]), wanted.copy()
    for one, wavelength in zip(aim, plate.wavelengths, strict=True):
        lobe = lobes_in_bins(edges, [0], plate.period, wavelength * 1e-3, plate.coherence_length)[:, 0]
        one += (1 - one.sum()) * np.outer(lobe, lobe)
    return aim


def finest_strokes(target: ArrayLike) -> float:
    """Return how many of the finest bright strokes of a picture fit along its longer edge.

    The width of a stroke is the diameter of the largest disc whose opening keeps 90 % of the bright part, which is
    brighter than half of the maximum (granulometry: Matheron 1975, Random Sets and Integral Geometry).
    """
    picture = np.asarray(target, np.float64)
    step = math.ceil(max(picture.shape[:2]) / _MAX_PIXELS)
    few = picture[::step, ::step]
    grey = few if few.ndim == 2 else few.mean(axis=-1)
    bright = np.pad(grey > grey.max() / 2, 1)
    depth = scipy.ndimage.distance_transform_edt(bright)
    for radius in range(2, math.ceil(depth.max()) + 1):
        opened = scipy.ndimage.distance_transform_edt(depth < radius) < radius
        if np.count_nonzero(opened & bright) < _KEPT * np.count_nonzero(bright):
            break
    else:
        radius = max(math.ceil(depth.max()), 1) + 1
    # The last radius that keeps it is of strokes of 2 radius − 1 or 2 radius pixels.
    return max(picture.shape[:2]) / step / (2 * radius - 2.5)


def _in_bins(channels: Real, count: int) -> Real:
    """Return a picture, rows from the top, in square bins, rows from the bottom: (count, count, channels)."""
    size = max(channels.shape[:2])
    rows, columns = (scipy.sparse.csr_array(_overlaps(n, size, count)) for n in channels.shape[:2])
    # Each pixel is in one or two bins along each axis.
    strips = rows[:, ::-1] @ channels.reshape(len(channels), -1)  # (count, columns · channels)
    strips = strips.reshape(count, *channels.shape[1:]).swapaxes(0, 1)
    found = columns @ strips.reshape(len(strips), -1)
    return found.reshape(count, count, -1).swapaxes(0, 1) * (count / size) ** 2


def _overlaps(pixels: int, length: int, bins: int) -> Real:
    """Return the length of each pixel in each of the bins, (bins, pixels), in pixels.

    The bins are `length` long in all, and the pixels in the middle of them.
    """
    edges = np.linspace(0, length, bins + 1) - (length - pixels) / 2
    below = np.clip(edges[:, None] - np.arange(pixels), 0, 1)
    return np.diff(below, axis=0)
