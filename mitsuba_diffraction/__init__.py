"""Diffraction gratings for Mitsuba 3.

Importing this package registers the BSDF `diffraction_grating` and the integrator `diffraction_shader` for every
spectral variant of Mitsuba, and sees to it that Dr.Jit finds an LLVM that works.
"""

from . import llvm

llvm.ensure()

from . import gratings, reference, rigorous  # noqa: E402 (LLVM must be settled before anything imports Dr.Jit)
from . import plugin as _plugin  # noqa: E402, F401 (registers on import)
from .heightfield import HeightField  # noqa: E402
from .precompute import precompute  # noqa: E402
from .readers import read_height_field  # noqa: E402
from .recipe import Recipe  # noqa: E402
from .spectrum import GratingSpectrum  # noqa: E402

__all__ = [
    "GratingSpectrum",
    "HeightField",
    "Recipe",
    "gratings",
    "precompute",
    "read_height_field",
    "reference",
    "rigorous",
]
