"""Spectra to colours: spectral radiance → CIE XYZ → linear sRGB → a picture for the screen.

Observer: CIE 1931, 2°. Primaries and white point (D65) of sRGB (IEC 61966-2-1). All tables come from colour-science.

Scale: XYZ is divided by the Y of a flat spectrum of one, ∫ȳ dλ = 106.857 nm, so that a constant 1 W m⁻² sr⁻¹ nm⁻¹ has
luminance 1. This is also what Mitsuba's own RGB film does. There is no chromatic adaptation: a flat spectrum looks
slightly pink beside D65.

colour-science takes about a second to import, longer than a small rendering; therefore it is imported by the functions
that use it, when they are called.
"""

from __future__ import annotations

from functools import lru_cache

import numpy as np
from numpy.typing import ArrayLike, NDArray

from .errors import RequestError

_OBSERVER = "CIE 1931 2 Degree Standard Observer"


@lru_cache(maxsize=8)
def _xyz_matrix(wavelengths: tuple[float, ...]) -> NDArray[np.float64]:
    """The matrix m of `spectrum_to_XYZ`, (n, 3); see there."""
    import colour

    centres = np.asarray(wavelengths)
    steps = np.diff(centres)
    if centres.size < 2 or steps[0] < 1 or np.ptp(steps) > 1e-3 * steps[0]:
        raise RequestError(
            f"wavelengths: got {centres.size} from {centres[0]:g} to {centres[-1]:g} nm, "
            "wanted two or more, ascending in equal steps of at least 1 nm"
        )
    step = float(np.mean(steps))
    cmfs = colour.MSDS_CMFS[_OBSERVER]
    spacing = 0.25
    fine = np.arange(cmfs.wavelengths[0], cmfs.wavelengths[-1] + spacing / 2, spacing)
    matching = np.stack([np.interp(fine, cmfs.wavelengths, column) for column in cmfs.values.T], axis=1)
    hats = np.maximum(0.0, 1 - np.abs(fine[:, None] - centres) / step) / step
    matrix = np.linalg.lstsq(hats, matching, rcond=None)[0] / (spacing * matching[:, 1].sum())
    matrix.setflags(write=False)
    return matrix


def spectrum_to_XYZ(radiance: ArrayLike, wavelengths: ArrayLike) -> NDArray[np.float64]:
    """CIE 1931 XYZ of spectra.

    A channel i of a spectral image is L_i = ∫ L(λ) t_i(λ) dλ with a hat t_i of unit area around λ_i. Colour is
    X = ∫ L(λ) x̄(λ) dλ. If x̄ = Σ_i m_i t_i, then X = Σ_i m_i L_i for every spectrum, be it smooth or a single line; so
    m is the least-squares fit of the matching function by the hats. With steps of 5 nm the fit misses x̄, ȳ and z̄ by
    0.002, 0.002 and 0.01 at most. (Taking x̄(λ_i) Δλ for m_i instead makes ten times the error for narrow lines.)

    Args:
        radiance: (..., n), W m⁻² sr⁻¹ nm⁻¹.
        wavelengths: (n,), nm, ascending in equal steps.

    Returns:
        (..., 3); Y = 1 for a constant spectrum of one.

    Raises:
        ValueError: if the wavelengths are not such a grid, or the shapes disagree.
    """
    radiance = np.asarray(radiance)
    wavelengths = np.asarray(wavelengths, dtype=np.float64)
    if wavelengths.ndim != 1 or radiance.ndim == 0 or radiance.shape[-1] != wavelengths.size:
        raise RequestError(
            f"radiance: got shape {radiance.shape}, wanted (..., n) for wavelengths of shape {wavelengths.shape}"
        )
    return radiance @ _xyz_matrix(tuple(wavelengths.tolist()))


def spectrum_to_linear_sRGB(radiance: ArrayLike, wavelengths: ArrayLike) -> NDArray[np.float64]:
    """Linear sRGB of spectra: (..., n) → (..., 3). Colours outside the gamut have negative parts.

    Arguments and errors are those of `spectrum_to_XYZ`.
    """
    return XYZ_to_linear_sRGB(spectrum_to_XYZ(radiance, wavelengths))


def XYZ_to_linear_sRGB(XYZ: NDArray[np.floating]) -> NDArray[np.float64]:
    """Linear sRGB of XYZ, (..., 3) each; negative parts outside the gamut."""
    import colour

    return XYZ @ colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB.T


def delta_E(XYZ_1: ArrayLike, XYZ_2: ArrayLike) -> NDArray[np.float64]:
    """The colour difference CIEDE2000 (CIE 142, ISO/CIE 11664-6) to an eye that takes D65 with Y = 1 for white.

    Args:
        XYZ_1: (..., 3).
        XYZ_2: likewise.

    Returns:
        (...).
    """
    import colour

    white = colour.CCS_ILLUMINANTS[_OBSERVER]["D65"]
    return colour.delta_E(*(colour.XYZ_to_Lab(np.asarray(XYZ), white) for XYZ in (XYZ_1, XYZ_2)), method="CIE 2000")


def daylight(wavelengths: ArrayLike) -> NDArray[np.float64]:
    """The illuminant D65 (CIE 15:2018) relative to its value at 560 nm, linear between the values of its table.

    Args:
        wavelengths: (n,), nm.

    Returns:
        (n,).
    """
    import colour

    table = colour.SDS_ILLUMINANTS["D65"]
    return np.interp(wavelengths, table.wavelengths, table.values) / 100


def into_gamut(rgb: NDArray[np.floating]) -> NDArray[np.float64]:
    """Mixes colours that sRGB cannot show with the grey of the same luminance, until no part is negative.

    c' = Y + t (c − Y), with the largest t ≤ 1 for which min(c') ≥ 0. Luminance is kept exactly and hue nearly (lines of
    one dominant wavelength are straight in XYZ). Cutting each channel off at zero would instead brighten every spectral
    colour, most of all cyan and violet. Where the luminance itself is not positive, or a value is not a number, the
    result is black.

    Args:
        rgb: (..., 3), linear sRGB.

    Returns:
        (..., 3), linear sRGB, not negative.
    """
    import colour

    rgb = np.nan_to_num(np.asarray(rgb, dtype=np.float64), nan=0.0, posinf=0.0, neginf=0.0)
    luminance = rgb @ colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ[1]
    luminance = np.maximum(luminance, 0.0)[..., None]
    lowest = np.minimum(rgb.min(axis=-1, keepdims=True), 0.0)
    span = luminance - lowest
    share = np.divide(luminance, span, out=np.zeros_like(span), where=span > 0)
    return np.maximum(luminance + share * (rgb - luminance), 0.0)


_SHOULDER_START = 0.8
_WHITENING = 0.15  # how fast: with this, a pixel ten times too bright is mixed to 58 %


def roll_off(rgb: NDArray[np.floating]) -> NDArray[np.float64]:
    """Compresses highlights into [0, 1] without turning their hue.

    The brightest channel p of a pixel stays as it is up to 0.8 and then follows 1 − d²/(p + d − 0.8), d = 0.2, which
    is smooth and reaches 1 at infinity; the other channels are scaled alike. What was very bright is then mixed towards
    white, as film and eyes do. This is the Khronos PBR Neutral tone mapper (Khronos Group, 2024) without its toe, which
    belongs to dielectric surfaces.

    Args:
        rgb: (..., 3), linear sRGB, not negative.

    Returns:
        (..., 3), linear sRGB in [0, 1].
    """
    peak = rgb.max(axis=-1, keepdims=True)
    d = 1 - _SHOULDER_START
    beyond = np.maximum(peak - _SHOULDER_START, 0.0)
    shown = np.where(beyond > 0, 1 - d * d / (beyond + d), peak)
    scaled = rgb * np.divide(shown, peak, out=np.ones_like(peak), where=peak > 0)
    white = 1 - 1 / (_WHITENING * (peak - shown) + 1)
    return scaled + white * (shown - scaled)


def auto_exposure(rgb: NDArray[np.floating]) -> float:
    """The factor that makes a picture neither dark nor burnt.

    It brings the 97th percentile of the brightest channel, over the lit pixels, to one. A lit pixel is one above a
    thousandth of the 99th percentile, so that neither a black background nor a few pixels of a lamp or of noise decide.
    The brightest channel is taken rather than luminance, which is small for saturated blue and red.

    Args:
        rgb: (..., 3), linear sRGB, not negative.

    Returns:
        The factor for linear radiance; 1 for a black picture.
    """
    peak = rgb.max(axis=-1)
    peak = peak[peak > 0]
    if peak.size == 0:
        return 1.0
    lit = peak[peak > 1e-3 * np.percentile(peak, 99)]
    return float(1 / np.percentile(lit, 97))


def on_screen(rgb: NDArray[np.floating]) -> NDArray[np.uint8]:
    """Exposed linear sRGB without negative parts → `roll_off` → sRGB's transfer function, in 8 bits."""
    import colour

    shown = colour.cctf_encoding(roll_off(rgb), function="sRGB")
    return np.round(255 * np.clip(shown, 0.0, 1.0)).astype(np.uint8)
