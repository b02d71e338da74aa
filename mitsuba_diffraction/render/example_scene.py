"""A first scene: a disc, a lamp and a camera, placed so that its colours are seen."""

from __future__ import annotations

import os
from typing import Any

import mitsuba as mi

from ..errors import RequestError
from ..precomputation.spectra import Spectrum
from ..surface.gratings import PROFILES

LAMP_HEIGHT, CAMERA_HEIGHT = 1.6, 4.2  # above the centre of a disc of radius one
_OF_MEDIUM = ("material", "int_ior", "eta")


def example_scene(
    surface: str | os.PathLike[str] | Spectrum = "compact_disc", *, size: int = 256, spp: int = 64, **parameters: Any
) -> dict[str, Any]:
    """Return a scene for `mi.load_dict`: a disc of a surface under a small lamp, seen from above.

    The lamp and the camera are above the centre, and the pattern's x axis points away from the centre, as on a compact
    disc. Everywhere the orders of a line grating then lie in the plane of light and camera. At the distance r from the
    centre, order m has the wavelength T (r/√(r² + h²) + r/√(r² + H²))/m, for a period T and the heights h of the lamp
    and H of the camera: rings of colour, for periods of more than half a wavelength.

    Args:
        surface: a profile, a file (a saved spectrum, a recipe or a scan that one names), or a spectrum.
        size: of the picture, in pixels.
        spp: samples per pixel.
        parameters: of the `diffraction_grating`; without material and index it is of aluminium.

    Raises:
        ValueError: if no variant of Mitsuba is set. What is wrong with the surface is reported by `mi.load_dict`.
    """
    if mi.variant() is None:
        raise RequestError("variant: got none, wanted one before the scene: mi.set_variant('llvm_ad_spectral')")
    kind = "spectrum"
    if isinstance(surface, (str, os.PathLike)):
        surface = os.fspath(surface)
        kind = "profile" if surface in PROFILES else "filename"
    if not any(name in parameters for name in _OF_MEDIUM):
        parameters["material"] = "Al"
    to_world = mi.ScalarTransform4f().look_at(origin=[0, 0, CAMERA_HEIGHT], target=[0, 0, 0], up=[0, 1, 0])
    return {
        "type": "scene",
        "integrator": {"type": "diffraction_path", "max_depth": 3},
        "sensor": {
            "type": "perspective",
            "fov": 30,
            "to_world": to_world,
            "sampler": {"type": "independent", "sample_count": spp},
            "film": {"type": "hdrfilm", "width": size, "height": size, "rfilter": {"type": "gaussian"}},
        },
        "sky": {"type": "constant", "radiance": {"type": "d65", "scale": 0.0003}},
        "lamp": {"type": "point", "position": [0, 0, LAMP_HEIGHT], "intensity": {"type": "d65"}},
        "grating": {"type": "disk", "bsdf": {"type": "diffraction_grating", kind: surface, **parameters}},
    }
