"""Diffraction gratings for Mitsuba 3.

Importing this package registers the BSDF `diffraction_grating` and the integrators `diffraction_path` and
`diffraction_shader` for all spectral variants as soon as Mitsuba is imported. Everything up to the spectrum file works
without importing Mitsuba.
"""

from __future__ import annotations

import importlib
import importlib.metadata
from typing import TYPE_CHECKING

from .registration.import_hook import register as _register

if TYPE_CHECKING:  # type checkers do not see what is imported on first use
    from . import rigorous
    from .bsdf import testing
    from .files.writing import examples_folder
    from .inspection.efficiency import efficiencies
    from .inspection.peaks import peak_efficiencies
    from .inverse_design import design
    from .precomputation.grating_spectrum import GratingSpectrum
    from .precomputation.recipe import Recipe
    from .precomputation.spectra import precompute
    from .render.example_scene import example_scene
    from .scalar_theory import reference
    from .surface import gratings
    from .surface.heightfield import HeightField
    from .surface.readers import read_height_field
    from .viewer import view

_HOME = {
    "GratingSpectrum": "precomputation.grating_spectrum",
    "HeightField": "surface.heightfield",
    "Recipe": "precomputation.recipe",
    "design": "inverse_design",
    "efficiencies": "inspection.efficiency",
    "example_scene": "render.example_scene",
    "examples_folder": "files.writing",
    "gratings": "surface.gratings",
    "peak_efficiencies": "inspection.peaks",
    "precompute": "precomputation.spectra",
    "read_height_field": "surface.readers",
    "reference": "scalar_theory.reference",
    "rigorous": "rigorous",
    "testing": "bsdf.testing",
    "view": "viewer",
}

__all__ = [
    "GratingSpectrum",
    "HeightField",
    "Recipe",
    "design",
    "efficiencies",
    "example_scene",
    "examples_folder",
    "gratings",
    "peak_efficiencies",
    "precompute",
    "read_height_field",
    "reference",
    "rigorous",
    "testing",
    "view",
]


def __getattr__(name: str) -> object:
    """Import a public name on its first use (PEP 562)."""
    if name == "__version__":
        return importlib.metadata.version(__name__)
    if name not in _HOME:
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    module = importlib.import_module(f".{_HOME[name]}", __name__)
    globals()[name] = value = getattr(module, name, module)  # some are modules themselves
    return value


def __dir__() -> list[str]:
    return sorted({*globals(), *__all__})


_register()
