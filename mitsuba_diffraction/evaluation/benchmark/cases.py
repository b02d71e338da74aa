"""The surfaces that are measured."""

from __future__ import annotations

import warnings
from dataclasses import dataclass

from ...files.writing import examples_folder
from ...precomputation.grating_spectrum import GratingSpectrum
from ...precomputation.recipe import Recipe
from ...precomputation.spectra import precompute
from ...settings import SUN_COHERENCE_LENGTH, ScalarSettings, Settings
from ...spectrum.sample import effective_coherence_length
from ...surface import gratings
from ...surface.heightfield import HeightField


@dataclass(frozen=True, eq=False)
class Case:
    """A surface and its extent.

    Attributes:
        name: for reports.
        height_field: the surface.
        extent: "tile" or "sample".
        coherence_length: µm.
    """

    name: str
    height_field: HeightField
    extent: str
    coherence_length: float

    def spectrum(
        self, tolerance: float = 1e-3, representation: str = "auto", terms: int | None = None
    ) -> GratingSpectrum:
        """Compute the spectrum of the surface; for arguments and errors see `precompute`."""
        with warnings.catch_warnings():
            # The warnings of coarse pixels and of few terms do not matter here.
            warnings.simplefilter("ignore", UserWarning)
            found = precompute(
                self.height_field,
                extent=self.extent,
                coherence_length=self.coherence_length,
                tolerance=tolerance,
                representation=representation,
                terms=terms,
            )
        assert isinstance(found, GratingSpectrum)
        return found


def bundled_cases() -> list[Case]:
    """Return analytic gratings, the synthetic skins and the disc of the recipes, and 65 µm of skin with 512² pixels."""
    sun = SUN_COHERENCE_LENGTH
    large = gratings.xenopeltis_synthetic(65.0, pixel_size=65 / 512, seed=1)
    return [
        Case("blazed", gratings.blazed(2.5, 0.25), "tile", sun),
        Case("sinusoidal", gratings.sinusoidal(2.5, 0.3), "tile", sun),
        Case("lamellar", gratings.lamellar(2.5, 0.2), "tile", sun),
        Case("crossed", gratings.crossed(2.0, 0.1), "tile", sun),
        # Coherence as in precompute/elaphe_synthetic.toml and xenopeltis_synthetic.toml.
        Case("elaphe_synthetic", gratings.elaphe_synthetic(32.0, seed=1), "tile", 26.0),
        Case("xenopeltis_synthetic", gratings.xenopeltis_synthetic(32.0, seed=1), "tile", 26.0),
        # As in precompute/compact_disc.toml.
        Case("compact disc", gratings.compact_disc(seed=1), "tile", 26.0),
        Case("65 µm tile", large, "tile", sun),
        Case("65 µm sample", large, "sample", effective_coherence_length(large, sun)),
    ]


_MEASURED_FOLDER = examples_folder() / "precompute" / "measured"
MEASURED = {"elaphe": 0.4347, "xenopeltis": 0.8187}
"""µm from black to white, of the scans of 65 µm in precompute/measured, as in the published maps."""
_CROP = slice(333, 999)  # of 1332 rows and columns: the central 32.5 µm

TIMED_TILES = ("synthetic, 0.375 µm", "measured Elaphe", "measured Xenopeltis")
"""Of `tiles`."""


def scan(name: str, height_range: float, settings: Settings) -> Recipe:
    """Return a scan of 65 µm as the author of the thesis used it, dust included (precompute/measured/README.md).

    Args:
        name: "elaphe" or "xenopeltis".
        height_range: from black to white, µm.
        settings: of its spectrum.
    """
    surface = {"scan": f"{name}_afm_65um.png", "pixel_size": 65 / 1332, "height_range": height_range}
    return Recipe(surface, settings, _MEASURED_FOLDER)


def tiles() -> list[Case]:
    """Return synthetic skins of three depths, and the centres of both measured skins, as tiles in sunlight.

    The heights of the measured skins are read from the pictures, without any preparation. They jump at the edges of a
    tile.
    """
    cases = [
        Case(
            f"synthetic, {depth:g} µm",
            gratings.elaphe_synthetic(8.0, depth=depth, seed=1),
            "tile",
            SUN_COHERENCE_LENGTH,
        )
        for depth in (0.15, 0.375, 0.6)
    ]
    for name, height_range in MEASURED.items():
        whole = scan(name, height_range, ScalarSettings()).height_field()
        field = HeightField(whole.heights[_CROP, _CROP], whole.pixel_size, source=f"centre of {whole.source}")
        cases.append(Case(f"measured {name.capitalize()}", field, "tile", SUN_COHERENCE_LENGTH))
    return cases


def scan_case(recipe: Recipe) -> Case:
    """Return a scan, with the coherence length of its recipe; of a sample at most the longest that it supports."""
    field, settings = recipe.height_field(), recipe.settings
    coherence = settings.coherence_length
    if settings.extent == "sample":
        coherence = effective_coherence_length(field, coherence)
    return Case(field.source, field, settings.extent, coherence)
