"""Surfaces of the thesis of 2014, chapter 5, and the plane of incidence of each."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import ArrayLike, NDArray

from mitsuba_diffraction.evaluation.benchmark.cases import scan
from mitsuba_diffraction.precomputation.grating_spectrum import GratingSpectrum
from mitsuba_diffraction.precomputation.recipe import Recipe
from mitsuba_diffraction.settings import SUN_COHERENCE_LENGTH, ScalarSettings
from mitsuba_diffraction.surface.heightfield import HeightField


@dataclass(frozen=True, eq=False)
class PublishedSurface:
    """A grating, and the published numbers about it.

    Light and viewer are in the plane of the normal and the diffracting axis. Angles are positive towards the light,
    which the grating equation d (sin θ_i + sin θ_r) = nλ has for n > 0.

    Attributes:
        name: for titles.
        recipe: of the heights and the spectrum.
        axis: the diffracting axis, 0 for x and 1 for y; of the two, that which is nearer to the azimuth.
        period: d of the grating equation, µm, as published.
        published: (mean in nm, variance in nm²) of the period that the draft of the thesis fits (table 5.1).
        azimuth: of the light, degrees from x towards y; by default along −x or −y, the direction of a blaze.
        final: by method, (mean, standard deviation) in nm of table 5.1 of the final text, which calls the latter
            variance; where it has the surface and the method.
        angles: range of the viewing angles of the published maps (final text, figures 5.8 to 5.10), degrees.
    """

    name: str
    recipe: Recipe
    axis: int
    period: float
    published: tuple[float, float]
    azimuth: float | None = None
    final: Mapping[str, tuple[float, float]] = field(default_factory=dict)
    angles: tuple[float, float] = (-90.0, 90.0)

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

    @property
    def shader_coherence_length(self) -> float:
        """L_c of the shader in µm: where it repeats a scan as a tile, L_c of sunlight, as published."""
        return SUN_COHERENCE_LENGTH if self.recipe.settings.extent == "sample" else self.coherence_length

    def direction(self, angle: ArrayLike) -> NDArray[np.float64]:
        """Return unit vectors (..., 3) at angles (...) in degrees from the normal, positive on the light's side."""
        angle = np.deg2rad(np.asarray(angle, np.float64))
        azimuth = np.deg2rad((180.0, 270.0)[self.axis] if self.azimuth is None else self.azimuth)
        # Rounded, so that a plane along an axis has no other component.
        x, y = np.round((np.cos(azimuth), np.sin(azimuth)), 12)
        return np.stack([x * np.sin(angle), y * np.sin(angle), np.cos(angle)], axis=-1)

    def with_coherence_length(self, coherence_length: float) -> PublishedSurface:
        """Return the same surface with another coherence length, µm."""
        settings = replace(self.recipe.settings, coherence_length=coherence_length)
        return replace(self, recipe=replace(self.recipe, settings=settings))


def _skin(profile: str, depth: float) -> Recipe:
    """Return a surface like that of precompute/elaphe_synthetic.toml or xenopeltis_synthetic.toml."""
    return Recipe(
        {"profile": profile, "size": 32.0, "depth": depth, "seed": 1, "patches": 1},
        ScalarSettings(coherence_length=26.0),
    )


# Nearly half of the scan, the largest coherence length that it supports.
_AS_SAMPLE = ScalarSettings(extent="sample", coherence_length=32.0, tolerance=0.01)


SURFACES = {
    "blaze": PublishedSurface(
        "Blaze",
        Recipe({"profile": "blazed", "period": 2.5, "depth": 0.246}),
        0,
        2.5,
        (2500.34, 0.16),
        final={"flss": (2499.997, 0.377), "nmm": (2499.997, 0.377), "pq": (2502.428, 0.390)},
        angles=(-55.0, -40.0),
    ),
    "elaphe": PublishedSurface("Elaphe (synthetic)", _skin("elaphe_synthetic", 0.375), 1, 1.144, (1144.28, 0.15)),
    "xenopeltis": PublishedSurface(
        "Xenopeltis (synthetic)", _skin("xenopeltis_synthetic", 0.443), 0, 1.552, (1552.27, 0.45)
    ),
    "elaphe_scan": PublishedSurface(
        "Elaphe (scan)",
        scan("elaphe", 0.4347, _AS_SAMPLE),
        0,
        1.144,
        (1144.28, 0.15),
        azimuth=0.0,
        final={"flss": (1144.262, 0.401), "nmm": (1144.179, 0.677), "pq": (1052.308, 49.678)},
        angles=(-40.0, -15.0),
    ),
    "xenopeltis_scan": PublishedSurface(
        "Xenopeltis (scan)",
        scan("xenopeltis", 0.4435, _AS_SAMPLE),
        1,
        1.552,
        (1552.27, 0.45),
        final={"flss": (1552.27, 0.45)},
        angles=(-50.0, -25.0),
    ),
}
"""Name → surface. The synthetic skins have the periods that the thesis fits to its scans. The thesis does not state the
azimuth of the light; on the scan of Elaphe it is the side of x on which FLSS has the published period."""
