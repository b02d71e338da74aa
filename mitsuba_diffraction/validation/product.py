"""What is validated: the BSDF, evaluated through Mitsuba, and the shapes that checks need of it."""

from __future__ import annotations

import functools
from typing import Any

import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..heightfield import HeightField
from ..precompute import precompute
from ..scalar_theory import geometry
from ..spectrum import GratingSpectrum

Array = NDArray[np.float64]

TOLERANCE = 1e-5
"""Of the spectra: an analytic check to 1e-4 is to see the model, not its tables."""
_RADII, _ANGLES = 16, 16


def bsdf(spectrum: GratingSpectrum, conserve: bool = True, **parameters: Any) -> mi.BSDF:
    """The plugin; a perfect mirror unless an index or a material is given.

    `conserve=False` leaves out E, which is no part of what closed forms describe: R K G S/λ² alone.
    """
    if not {"int_ior", "material"} & set(parameters):
        parameters["material"] = "none"
    plugin = mi.load_dict({"type": "diffraction_grating", "spectrum": spectrum, **parameters})
    if not conserve:
        plugin.energy = None
    return plugin


@functools.lru_cache(maxsize=32)
def _built(height_field: HeightField, settings: tuple[tuple[str, Any], ...]) -> GratingSpectrum:
    return precompute(height_field, **dict(settings))


def spectrum_of(height_field: HeightField, **settings: Any) -> GratingSpectrum:
    """`precompute`, to 1e-5 unless told otherwise; kept for the next check of the same surface."""
    return _built(height_field, tuple(sorted({"tolerance": TOLERANCE, **settings}.items())))


def direction(theta: float, phi: float = 0.0) -> Array:
    """Degrees from the normal and from x → a unit vector (3,)."""
    theta, phi = np.deg2rad(theta), np.deg2rad(phi)
    return np.array([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)])


def value(of: mi.BSDF, wi: ArrayLike, wo: ArrayLike, wavelength: ArrayLike) -> Array:
    """f [1/sr] for directions (..., 3) and wavelengths (...) in µm; zero where ω_o is not above the surface."""
    wi, wo = np.broadcast_arrays(wi, wo)
    shape = wo.shape[:-1]
    wi, wo = wi.reshape(-1, 3), wo.reshape(-1, 3)
    nanometres = mi.Float(np.broadcast_to(wavelength, shape).ravel() * 1e3)
    si = mi.SurfaceInteraction3f()
    si.wi = mi.Vector3f(wi.T)
    si.wavelengths = type(si.wavelengths)(*[nanometres] * len(si.wavelengths))
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    found = np.array(of.eval(mi.BSDFContext(), si, mi.Vector3f(wo.T)), np.float64)
    # Of a polarised variant, the Mueller matrix's first element.
    found = found[0, 0, 0] if found.ndim == 4 else found[0]
    above = wo[:, 2] > 0
    return np.where(above, found / np.where(above, wo[:, 2], 1), 0).reshape(shape)


def towards(wi: Array, q: ArrayLike, wavelength: ArrayLike) -> Array:
    """ω_o (..., 3) of the frequencies q (..., 2), cycles/µm, at wavelengths (...) in µm; z = 0 where evanescent."""
    across = -np.asarray(wavelength)[..., None] * q - wi[..., :2]
    return np.concatenate([across, np.sqrt(np.maximum(1 - (across**2).sum(-1, keepdims=True), 0))], axis=-1)


def factor(wi: Array, wo: Array) -> Array:
    """K G of directions (..., 3), in float64."""
    return geometry(wi[..., 2], wo[..., 2], (wi * wo).sum(-1))


def lobe_power(of: mi.BSDF, spectrum: GratingSpectrum, wi: Array, q: ArrayLike, wavelength: float) -> Array:
    """The share of the incident power that the BSDF reflects into the lobes about q: ∫ f cos θ_o dω_o = λ² ∫ f dq.

    Gauss points along the radius, equal angles around; a lobe ends at the reach of the spectrum.

    Args:
        of: the BSDF.
        spectrum: that it shows, of a tile whose lobes do not overlap.
        wi: (3,).
        q: (n, 2) cycles/µm; what of a lobe is below the horizon does not count.
        wavelength: µm.

    Returns:
        (n,).
    """
    x, weights = np.polynomial.legendre.leggauss(_RADII)
    reach = spectrum.reach * spectrum.lobe_width
    radius = (x + 1) / 2 * reach
    angle = 2 * np.pi * (np.arange(_ANGLES) + 0.5) / _ANGLES
    area = np.repeat(weights * reach / 2 * radius * 2 * np.pi / _ANGLES, _ANGLES)
    offset = (radius[:, None, None] * np.stack([np.cos(angle), np.sin(angle)], -1)).reshape(-1, 2)
    points = np.asarray(q, np.float64)[:, None, :] + offset
    wo = towards(wi, points, np.full(points.shape[:-1], wavelength))
    return value(of, wi, wo, wavelength) @ area * wavelength**2


def orders_above(spectrum: GratingSpectrum, wi: Array, wavelength: float, largest: float = 80.0) -> Array:
    """The orders m (n, 2) of a tile that leave at up to `largest` degrees from the normal."""
    m_x, m_y = np.meshgrid(*spectrum.grid.axes())
    m = np.stack([m_x.ravel(), m_y.ravel()], axis=-1)
    across = -wavelength * m / spectrum.grid.tile_size - wi[:2]
    return m[np.hypot(*across.T) < np.sin(np.deg2rad(largest))]


def order_powers(of: mi.BSDF, spectrum: GratingSpectrum, wi: Array, m: Array, wavelength: float) -> tuple[Array, Array]:
    """η_m (n,) that the BSDF shows, of the orders m (n, 2): what their lobes reflect, without K and G; and their κ."""
    q = m / np.asarray(spectrum.grid.tile_size)
    wo = towards(wi, q, np.full(len(q), wavelength))
    kappa = 2 * np.pi * (wi[2] + wo[:, 2]) / wavelength
    return lobe_power(of, spectrum, wi, q, wavelength) / factor(wi, wo), kappa
