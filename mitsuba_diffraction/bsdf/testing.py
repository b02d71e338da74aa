"""Evaluation and sampling of BSDFs for NumPy arrays of directions and wavelengths."""

from __future__ import annotations

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..array_types import Real
from ..errors import RequestError
from ..variants import is_supported
from .device_tables import on_device


def direction(theta: ArrayLike, phi: ArrayLike = 0.0) -> Real:
    """Return unit vectors (..., 3) at θ from the normal and φ from the x axis, in degrees; the two broadcast."""
    theta, phi = np.deg2rad(theta), np.deg2rad(phi)
    return np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta) + 0 * phi], axis=-1)


def towards(wi: Real, q: ArrayLike, wavelength: ArrayLike) -> Real:
    """Return ω_o = (−λq − ω_i,t, z), (..., 3), of ω_i (..., 3), q (..., 2) in cycles/µm and wavelengths (...) in nm.

    All three broadcast; z is NaN where the frequency is evanescent.
    """
    across = -1e-3 * np.asarray(wavelength, np.float64)[..., None] * np.asarray(q) - wi[..., :2]
    with np.errstate(invalid="ignore"):
        return np.concatenate([across, np.sqrt(1 - (across**2).sum(axis=-1, keepdims=True))], axis=-1)


def vectors(omega: ArrayLike) -> mi.Vector3f:
    """Convert (n, 3) or (3,) to vectors of Mitsuba."""
    return _components(mi.Vector3f, omega)


def floats(values: ArrayLike) -> mi.Float:
    """Convert (n,) or a number to floats of Mitsuba."""
    return on_device(values)


def array(value: object, dtype: type | None = None) -> NDArray:
    """Convert a value of Dr.Jit to a NumPy array, (components, n).

    It is computed first: a kernel that also arranges the components would be compiled for every n.
    """
    dr.eval(value)
    return np.array(value, dtype)


def interaction(wi: ArrayLike, wavelengths: ArrayLike, uv: ArrayLike = (0.0, 0.0)) -> mi.SurfaceInteraction3f:
    """Return points of the plane z = 0, with tangents along x and y.

    Args:
        wi: ω_i, (n, 3) or (3,).
        wavelengths: (n, c) or (c,) in nm, c as many as a ray of the variant has.
        uv: (n, 2) or (2,).
    """
    si = dr.zeros(mi.SurfaceInteraction3f, len(np.atleast_2d(wi)))
    si.wi = vectors(wi)
    si.wavelengths = _components(type(si.wavelengths), wavelengths)
    si.uv = _components(mi.Point2f, uv)
    si.n = mi.Normal3f(0, 0, 1)
    si.sh_frame = mi.Frame3f(si.n)
    si.dp_du, si.dp_dv = mi.Vector3f(1, 0, 0), mi.Vector3f(0, 1, 0)
    return si


def evaluate_pdf(
    bsdf: mi.BSDF,
    wi: ArrayLike,
    wo: ArrayLike,
    wavelengths: ArrayLike,
    context: mi.BSDFContext | None = None,
    uv: ArrayLike = (0.0, 0.0),
) -> tuple[Real, Real]:
    """Evaluate f cos θ_o and the density of the BSDF's samples; leading dimensions broadcast.

    As many wavelengths are evaluated at once as a ray has (four); the last group is filled up by repetition.

    Args:
        bsdf: of the current variant.
        wi: ω_i, (..., 3) along dp_du, dp_dv and the normal.
        wo: ω_o, likewise.
        wavelengths: (..., c) in nm.
        context: the components of the BSDF; all by default.
        uv: (..., 2).

    Returns:
        f cos θ_o in 1/sr, (..., c), for unpolarised light in polarised variants; and the density in 1/sr of each group
        of wavelengths, (..., g).

    Raises:
        ValueError: if shapes do not match, or no spectral variant is set.
    """
    wi, wo, wavelengths = (np.asarray(values, np.float64) for values in (wi, wo, wavelengths))
    if wi.shape[-1:] != (3,) or wo.shape[-1:] != (3,) or wavelengths.ndim == 0:
        raise RequestError(
            f"wi, wo, wavelengths: got shapes {wi.shape}, {wo.shape}, {wavelengths.shape}, "
            "wanted (..., 3), (..., 3), (..., c)"
        )
    if not is_supported(mi.variant()):
        raise RequestError(f"variant: Mitsuba's is {mi.variant()}, wanted a spectral one such as llvm_ad_spectral")
    shape = np.broadcast_shapes(wi.shape[:-1], wo.shape[:-1], wavelengths.shape[:-1])
    count, channels = wavelengths.shape[-1], _channels()
    groups = np.resize(np.arange(count), (-(-count // channels), channels))
    wavelengths = np.broadcast_to(wavelengths, (*shape, count))[..., groups].reshape(-1, channels)
    wi, wo, uv = (
        np.repeat(np.broadcast_to(values, (*shape, size)).reshape(-1, size), len(groups), axis=0)
        for values, size in ((wi, 3), (wo, 3), (uv, 2))
    )
    context = context or mi.BSDFContext()
    value, pdf = bsdf.eval_pdf(context, interaction(wi, wavelengths, uv), vectors(wo))
    dr.eval(value, pdf)  # in one kernel
    value, pdf = _rows(value, len(wo)), array(pdf, np.float64)
    value = value.reshape(*shape, groups.size)[..., :count]
    return value, np.broadcast_to(pdf, len(wo)).reshape(*shape, len(groups))


def evaluate(bsdf: mi.BSDF, wi: ArrayLike, wo: ArrayLike, wavelengths: ArrayLike) -> Real:
    """Evaluate f cos θ_o in 1/sr, (..., c); arguments and errors of `evaluate_pdf`."""
    return evaluate_pdf(bsdf, wi, wo, wavelengths)[0]


def sample(
    bsdf: mi.BSDF,
    wi: ArrayLike,
    wavelengths: ArrayLike,
    seed: int = 1,
    context: mi.BSDFContext | None = None,
    uv: ArrayLike = (0.0, 0.0),
) -> tuple[Real, Real, mi.BSDFSample3f]:
    """Sample a BSDF.

    Args:
        bsdf: of the current variant.
        wi: ω_i, (n, 3), for one sample each.
        wavelengths: (c,) or (n, c) in nm, as many as a ray has.
        seed: of the random numbers.
        context: the components of the BSDF; all by default.
        uv: (n, 2) or (2,).

    Returns:
        ω_o (n, 3); the weights f cos θ_o/pdf, (n, c); and Mitsuba's sample.
    """
    count = len(np.asarray(wi))
    u = np.random.default_rng(seed).random((3, count)).astype(np.float32)
    found, weight = bsdf.sample(
        context or mi.BSDFContext(), interaction(wi, wavelengths, uv), floats(u[0]), mi.Point2f(*map(floats, u[1:]))
    )
    dr.eval(found, weight)  # in one kernel
    return array(found.wo, np.float64).T, _rows(weight, count), found


def _components(kind: type, values: ArrayLike) -> object:
    """Convert (n, k) or (k,) to an array of Mitsuba."""
    return kind(*map(floats, np.atleast_2d(values).T))


def _channels() -> int:
    """Return the wavelengths of a ray."""
    return len(mi.UnpolarizedSpectrum(0))


def _rows(value: mi.Spectrum, count: int) -> Real:
    """Convert a spectrum of Mitsuba, or the first element of a Mueller matrix: (count, c)."""
    found = array(mi.unpolarized_spectrum(value), np.float64).reshape(_channels(), -1)
    return np.broadcast_to(found, (len(found), count)).T
