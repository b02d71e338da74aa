"""A profile h(x) as a curve x(t), z(t), its parameter laid so that few harmonics resolve it."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray
from scipy.ndimage import median_filter

from ..errors import RequestError
from ..surface.heightfield import HeightField

Real = NDArray[np.float64]

SAMPLES = 4096
# An edge turns the curve by more than this (rad) and by more than so many times the median turn of nine pixels.
_EDGE, _OF_MEDIAN, _MOST_EDGES = 0.1, 8.0, 8
# At an edge the curve runs as slowly in t as 1 − this of its mean; a piece of the length l has a share l^_SHARE of t.
# Of those tried, 0.8 … 0.95 and 0.35 … 1 on blazes, ruled and lamellar gratings, these need the fewest harmonics.
_GRADING, _SHARE = 0.9, 0.65
# A bend of one radian takes as much of t as this share of the whole length. Of 0 … 0.32, this needs the fewest
# harmonics: a sinusoid of silver eight times as deep as wide 56, without it more than 140.
_BEND = 0.04


@dataclass(frozen=True, eq=False)
class Curve:
    """One period of a profile, lengths in periods, at t = 0, 1/n, … 1.

    Attributes:
        x, z: (n + 1,), x rising by 1 from the first to the last.
        tilt: ζ, the angle from z to the direction in which the curve is moved: half way between those to which the
            steepest rise and the steepest fall are equally steep.
    """

    x: Real
    z: Real
    tilt: float

    @property
    def tangent(self) -> tuple[Real, Real]:
        """J = ẋ cos ζ − ḣ sin ζ and M = ẋ sin ζ + ḣ cos ζ between the points, (n,) each."""
        x, z = (np.diff(c) * len(self.x[1:]) for c in (self.x, self.z))
        cos, sin = np.cos(self.tilt), np.sin(self.tilt)
        return x * cos - z * sin, x * sin + z * cos

    @property
    def middle(self) -> tuple[Real, Real]:
        """x and z half way between the points, (n,) each."""
        return tuple((c[1:] + c[:-1]) / 2 for c in (self.x, self.z))


def is_profile(height_field: HeightField) -> bool:
    """Return whether the heights do not change along y."""
    return bool(np.ptp(height_field.heights, axis=0).max() == 0)


def curve_of(height_field: HeightField) -> Curve:
    """Return the curve of a surface of one row: straight lines from pixel to pixel, round the end of the tile.

    The facet that leads back in a sawtooth is thus one pixel wide, and so is the wall of a lamellar grating. Between
    edges the length of the curve grows at a rate of 1 − η (4 cos 2πτ + cos 4πτ)/5: slowly near the edges, where fields
    are singular (Granet 1999), and evenly away from them, where a fast run makes for short waves. Smooth bends count as
    length (`_BEND`), so that sharp crests are resolved.

    Raises:
        ValueError: if the rows of the height field differ.
    """
    rows = height_field.centred
    if not is_profile(height_field):
        raise RequestError(
            f"height field: got {len(rows)} rows that differ, wanted a surface that does not change along y; "
            "rigorous theory is offered for such only"
        )
    period = height_field.tile_size[0]
    n = rows.shape[1]
    x = (np.arange(n + 1) + 0.5) / n
    z = np.append(rows[0], rows[0, 0]) / period
    angles = np.arctan2(np.diff(z), np.diff(x))
    turns = np.abs(angles - np.roll(angles, 1))
    edges = np.flatnonzero(turns > np.maximum(_EDGE, _OF_MEDIAN * median_filter(turns, 9, mode="wrap")))
    edges = np.sort(edges[np.argsort(-turns[edges])[:_MOST_EDGES]])
    turns[edges] = 0
    steps = np.hypot(np.diff(x), np.diff(z))
    steps = steps / steps.sum() + _BEND / 2 * (turns + np.roll(turns, -1))
    if len(edges):
        # Begin at an edge.
        x, z = (np.append(np.roll(c[:-1], -edges[0]), 0) for c in (x, z))
        x[:-1] += x[:-1] < x[0]
        x[-1], z[-1] = x[0] + 1, z[0]
        steps = np.roll(steps, -edges[0])
        edges = edges - edges[0]
    s = np.concatenate([[0.0], np.cumsum(steps)])
    at = _graded(s[edges], s[-1]) if len(edges) else np.linspace(0, s[-1], SAMPLES + 1)
    return Curve(np.interp(at, s, x), np.interp(at, s, z), -(angles.min() + angles.max()) / 2)


def _graded(edges: Real, length: float) -> Real:
    """Return s at t = 0, 1/n, … 1, with a whole number of steps between edges."""
    ends = np.append(edges, length)
    shares = np.cumsum(np.diff(ends) ** _SHARE)
    steps = np.append(0, np.round(shares / shares[-1] * SAMPLES)).astype(int)
    at = [np.zeros(1)]
    for (a, b), n in zip(itertools.pairwise(ends), np.diff(steps), strict=True):
        t = np.arange(1, n + 1) / max(n, 1)
        at.append(a + (b - a) * (t - _GRADING / (20 * np.pi) * (8 * np.sin(2 * np.pi * t) + np.sin(4 * np.pi * t))))
    return np.concatenate(at)
