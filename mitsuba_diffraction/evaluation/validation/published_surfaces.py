"""Surfaces of the thesis of 2014, chapter 5, and the plane of incidence of each."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ...errors import RequestError
from ...grating_spectrum import GratingSpectrum
from ...recipe import Recipe
from ...settings import Settings
from ...surface.heightfield import HeightField


@dataclass(frozen=True, eq=False)
class PublishedSurface:
    """A grating, and the published numbers about it.

    Light and viewer are in the plane of the normal and the diffracting axis. Angles are positive towards −x (−y): the
    blaze direction is positive, and the grating equation d (sin θ_i + sin θ_r) = nλ has n > 0.

    Attributes:
        name: for titles.
        recipe: of the heights and the spectrum.
        axis: the diffracting axis, 0 for x and 1 for y.
        period: d of the grating equation, µm, as published.
        published: (mean in nm, variance in nm²) of the period that the thesis fits (table 5.1).
    """

    name: str
    recipe: Recipe
    axis: int
    period: float
    published: tuple[float, float]

    def __post_init__(self) -> None:
        if self.axis not in (0, 1):
            raise RequestError(f"axis: got {self.axis!r}, wanted 0 for x or 1 for y")
        if not self.period > 0:
            raise RequestError(f"period: got {self.period!r}, wanted a positive number in µm")

    @cached_property
    def height_field(self) -> HeightField:
        """The heights."""
        return self.recipe.height_field()

    @cached_property
    def spectrum(self) -> GratingSpectrum:
        """S(q; κ), from the cache of recipes or built."""
        return self.recipe.cached()

    @property
    def coherence_length(self) -> float:
        """L_c in µm."""
        return float(self.recipe.settings.coherence_length)

    def direction(self, angle: ArrayLike) -> NDArray[np.float64]:
        """Return unit vectors (..., 3) at angles (...) in degrees from the normal, in the plane of the surface."""
        angle = np.deg2rad(np.asarray(angle, np.float64))
        result = np.zeros((*angle.shape, 3))
        result[..., self.axis], result[..., 2] = -np.sin(angle), np.cos(angle)
        return result

    def with_coherence_length(self, coherence_length: float) -> PublishedSurface:
        """Return the same surface with another coherence length, µm."""
        recipe = replace(self.recipe, settings=replace(self.recipe.settings, coherence_length=coherence_length))
        return PublishedSurface(self.name, recipe, self.axis, self.period, self.published)


def _skin(profile: str, depth: float) -> Recipe:
    """Return the surface of precompute/elaphe.toml or xenopeltis.toml."""
    return Recipe(
        {"profile": profile, "size": 32.0, "depth": depth, "seed": 1, "patches": 1}, Settings(coherence_length=26.0)
    )


SURFACES = {
    "blaze": PublishedSurface(
        "Blaze", Recipe({"profile": "blazed", "period": 2.5, "depth": 0.246}), 0, 2.5, (2500.34, 0.16)
    ),
    "elaphe": PublishedSurface("Elaphe (synthetic)", _skin("elaphe", 0.375), 1, 1.144, (1144.28, 0.15)),
    "xenopeltis": PublishedSurface("Xenopeltis (synthetic)", _skin("xenopeltis", 0.443), 0, 1.552, (1552.27, 0.45)),
}
"""Name → surface. The skins are synthetic stand-ins; those of the thesis were measured."""
