"""Evaluation of the shader for NumPy arrays of directions."""

from __future__ import annotations

from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..bsdf.device_tables import on_device
from ..bsdf.testing import array, vectors
from ..errors import RequestError
from ..surface.heightfield import HeightField
from ..variants import is_supported
from .flss import FLSS
from .gem import GEM
from .nmm import NMM
from .nmm_pq import NMMPQ
from .pq import PQ
from .quirks import Quirks
from .shader import Shader, TextureShader

VARIANTS = {"flss": FLSS, "nmm": NMM, "pq": PQ, "nmm_pq": NMMPQ, "gem": GEM}


def shader_for(height_field: HeightField, variant: str, quirks: Quirks, **settings: Any) -> Shader:
    """Return the shader of a given name (`VARIANTS`) in the current Mitsuba variant.

    Raises:
        ValueError: if the name is unknown, or no vectorised Mitsuba variant is set.
    """
    if variant not in VARIANTS:
        raise RequestError(f"variant: got {variant!r}, wanted one of {', '.join(VARIANTS)}")
    if not is_supported(mi.variant()):
        raise RequestError(f"variant: Mitsuba's is {mi.variant()}, wanted a spectral one such as llvm_ad_spectral")
    return VARIANTS[variant](height_field, quirks, **settings)


def colour(
    height_field: HeightField,
    wi: ArrayLike,
    wo: ArrayLike,
    *,
    variant: str = "flss",
    quirks: Quirks | None = None,
    **settings: Any,
) -> NDArray[np.float32]:
    """Compute the shader's colour of a tile with an index of 1.5 under D65.

    Args:
        height_field: the tile.
        wi: ω_i, (..., 3) in the frame of the tile.
        wo: ω_o, likewise; shapes broadcast.
        variant: one of `VARIANTS`.
        quirks: default: as published.
        settings: further arguments of the shader class.

    Returns:
        Linear RGB, (..., 3).

    Raises:
        ValueError: if an argument is invalid.
    """
    shader = shader_for(height_field, variant, quirks or Quirks.as_published(), **settings)
    wi, wo, shape = _directions(wi, wo)
    return array(shader.rgb(wi, wo, shader.weights())).T.reshape(*shape, 3)


def relative_radiance(
    height_field: HeightField,
    wi: ArrayLike,
    wo: ArrayLike,
    wavelengths: ArrayLike,
    *,
    variant: str = "flss",
    quirks: Quirks | None = None,
    **settings: Any,
) -> NDArray[np.float32]:
    """Compute ρ(λ), the radiance relative to a flat mirror at normal incidence (eq. 3.11), for an index of 1.5.

    Args:
        height_field: the tile.
        wi: ω_i, (..., 3) in the frame of the tile.
        wo: ω_o, likewise.
        wavelengths: (...) in nm; all three broadcast.
        variant: "flss" or "pq"; "nmm" and "nmm_pq" are evaluated as at one of their own wavelengths, which equals
            "flss" and "pq".
        quirks: default: as published.
        settings: further arguments of the shader class.

    Returns:
        (...).

    Raises:
        ValueError: if an argument is invalid.
    """
    if variant == "gem":
        raise RequestError("variant: gem has no spectrum, only RGB")
    shader = shader_for(height_field, variant, quirks or Quirks.as_published(), **settings)
    assert isinstance(shader, TextureShader)
    wavelengths = np.asarray(wavelengths, np.float32)
    wi, wo = (np.broadcast_to(omega, (*wavelengths.shape, 3)) if np.ndim(omega) == 1 else omega for omega in (wi, wo))
    wi, wo, shape = _directions(wi, wo)
    wavelengths = np.broadcast_to(wavelengths, shape).ravel()
    return np.array(shader.relative_radiance(wi, wo, on_device(wavelengths))).reshape(shape)


def _directions(wi: ArrayLike, wo: ArrayLike) -> tuple[mi.Vector3f, mi.Vector3f, tuple[int, ...]]:
    """Return two arrays (..., 3) of directions as Dr.Jit arrays, and the shape (...)."""
    wi, wo = (np.asarray(omega, np.float32) for omega in (wi, wo))
    if wi.shape[-1:] != (3,) or wo.shape[-1:] != (3,):
        raise RequestError(f"wi, wo: got shapes {wi.shape} and {wo.shape}, wanted (..., 3)")
    wi, wo = np.broadcast_arrays(wi, wo)
    return vectors(wi.reshape(-1, 3)), vectors(wo.reshape(-1, 3)), wi.shape[:-1]
