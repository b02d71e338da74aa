"""Spectra to colours: spectral radiance → CIE XYZ → linear sRGB → display.

Observer: CIE 1931, 2°. Primaries and white point (D65) of sRGB (IEC 61966-2-1). For a display, `into_gamut` and
`roll_off` reduce chroma at constant hue of Oklab (Ottosson 2020, A perceptual color space for image processing).

Scale: XYZ is divided by the Y of a flat spectrum of one, ∫ȳ dλ = 106.857 nm, so that a constant 1 W m⁻² sr⁻¹ nm⁻¹ has
luminance 1, as in Mitsuba's RGB film. There is no chromatic adaptation: a flat spectrum is slightly pink relative to
D65.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from functools import cache, lru_cache
from pathlib import Path

import numpy as np
from numpy.typing import ArrayLike, NDArray

from ..errors import RequestError, pip_install
from ..settings import VISIBLE

_D65 = (0.3127, 0.3290)  # x and y

# IEC 61966-2-1:1999
XYZ_TO_SRGB = np.array([[3.2406, -1.5372, -0.4986], [-0.9689, 1.8758, 0.0415], [0.0557, -0.2040, 1.0570]])
SRGB_TO_XYZ = np.array([[0.4124, 0.3576, 0.1805], [0.2126, 0.7152, 0.0722], [0.0193, 0.1192, 0.9505]])


@cache
def observer() -> NDArray[np.float64]:
    """Return λ in nm, x̄, ȳ, z̄ and the illuminant D65 relative to 560 nm (CIE 15:2018) at each nm, (471, 5)."""
    return np.loadtxt(Path(__file__).parents[1] / "data" / "observer.csv", delimiter=",")


def matching_functions(wavelengths: ArrayLike) -> NDArray[np.float64]:
    """Return x̄, ȳ, z̄ of the CIE 1931 2° observer at wavelengths (n,) in nm: (n, 3).

    They are interpolated linearly between the wavelengths of the observer and constant outside.
    """
    known, *columns, _ = observer().T
    return np.stack([np.interp(np.asarray(wavelengths), known, column) for column in columns], axis=1)


@lru_cache(maxsize=8)
def _xyz_matrix(wavelengths: tuple[float, ...]) -> NDArray[np.float64]:
    """Return the matrix m of `radiance_to_XYZ`, (n, 3)."""
    centres = np.asarray(wavelengths)
    steps = np.diff(centres)
    if centres.size < 2 or steps[0] < 1 or np.ptp(steps) > 1e-3 * steps[0]:
        ends = f" from {centres[0]:g} to {centres[-1]:g} nm" if centres.size else ""
        raise RequestError(
            f"wavelengths: got {centres.size}{ends}, wanted two or more, ascending in equal steps of at least 1 nm"
        )
    step = float(np.mean(steps))
    if centres[0] - step >= VISIBLE[1] or centres[-1] + step <= VISIBLE[0]:
        x, y = _D65
        white = np.array([x / y, 1, (1 - x - y) / y])
        return np.tile(white / centres.size, (centres.size, 1))
    spacing = 0.25
    fine = np.arange(VISIBLE[0], VISIBLE[1] + spacing / 2, spacing)
    matching = matching_functions(fine)
    hats = np.maximum(0.0, 1 - np.abs(fine[:, None] - centres) / step) / step
    matrix = np.linalg.lstsq(hats, matching, rcond=None)[0] / (spacing * matching[:, 1].sum())
    matrix.setflags(write=False)
    return matrix


def radiance_to_XYZ(radiance: ArrayLike, wavelengths: ArrayLike) -> NDArray[np.float64]:
    """Compute CIE 1931 XYZ of spectra.

    A channel i of a spectral image is L_i = ∫ L(λ) t_i(λ) dλ with a hat t_i of unit area around λ_i. Colour is
    X = ∫ L(λ) x̄(λ) dλ. If x̄ = Σ_i m_i t_i, then X = Σ_i m_i L_i for any spectrum, smooth or a single line; m is
    therefore the least-squares fit of the matching function by the hats. At a spacing of 5 nm the largest residuals of
    x̄, ȳ and z̄ are 0.002, 0.002 and 0.01. (With m_i = x̄(λ_i) Δλ, the error for narrow lines is ten times larger.)
    Light that is invisible at all wavelengths is shown as grey of its mean radiance.

    Args:
        radiance: (..., n), W m⁻² sr⁻¹ nm⁻¹.
        wavelengths: (n,), nm, ascending in equal steps.

    Returns:
        (..., 3); Y = 1 for a constant spectrum of one.

    Raises:
        ValueError: if the wavelengths are not equally spaced, or the shapes do not match.
    """
    radiance = np.asarray(radiance)
    wavelengths = np.asarray(wavelengths, dtype=np.float64)
    if wavelengths.ndim != 1 or radiance.ndim == 0 or radiance.shape[-1] != wavelengths.size:
        raise RequestError(
            f"radiance: got shape {radiance.shape}, wanted (..., n) for wavelengths of shape {wavelengths.shape}"
        )
    return radiance @ _xyz_matrix(tuple(wavelengths.tolist()))


def radiance_to_linear_sRGB(radiance: ArrayLike, wavelengths: ArrayLike) -> NDArray[np.float64]:
    """Compute linear sRGB of spectra, (..., n) → (..., 3). Colours outside the gamut have negative components.

    For arguments and errors see `radiance_to_XYZ`.
    """
    return XYZ_to_linear_sRGB(radiance_to_XYZ(radiance, wavelengths))


def XYZ_to_linear_sRGB(XYZ: NDArray[np.floating]) -> NDArray[np.float64]:
    """Convert XYZ to linear sRGB, (..., 3) each; negative components outside the gamut."""
    return XYZ @ XYZ_TO_SRGB.T


def linear_sRGB_to_XYZ(rgb: NDArray[np.floating]) -> NDArray[np.float64]:
    """Convert linear sRGB to XYZ, (..., 3) each."""
    return rgb @ SRGB_TO_XYZ.T


_DARK = 216 / 24389  # below which lightness is linear, as in CIE L*


def _lab(XYZ: ArrayLike) -> NDArray[np.float64]:
    """Return CIE L*a*b* (CIE 15:2018) relative to D65 with Y = 1, (..., 3)."""
    x, y = _D65
    ratio = np.asarray(XYZ, np.float64) / [x / y, 1, (1 - x - y) / y]
    f = np.where(ratio > _DARK, np.cbrt(ratio), 841 / 108 * ratio + 4 / 29)
    return np.stack([116 * f[..., 1] - 16, 500 * (f[..., 0] - f[..., 1]), 200 * (f[..., 1] - f[..., 2])], axis=-1)


def delta_E(XYZ_1: ArrayLike, XYZ_2: ArrayLike) -> NDArray[np.float64]:
    """Compute the colour difference CIEDE2000 (CIE 142, ISO/CIE 11664-6) relative to D65 with Y = 1.

    Both colours are (..., 3), the result is (...). Symbols as in Sharma, Wu and Dalal 2005, The CIEDE2000
    color-difference formula.
    """
    (L_1, a_1, b_1), (L_2, a_2, b_2) = (np.moveaxis(_lab(XYZ), -1, 0) for XYZ in (XYZ_1, XYZ_2))

    def chroma_weight(chroma: NDArray[np.float64]) -> NDArray[np.float64]:
        return np.sqrt(chroma**7 / (chroma**7 + 25.0**7))

    G = 0.5 * (1 - chroma_weight((np.hypot(a_1, b_1) + np.hypot(a_2, b_2)) / 2))
    C_1, C_2 = np.hypot((1 + G) * a_1, b_1), np.hypot((1 + G) * a_2, b_2)
    h_1, h_2 = (np.arctan2(b, (1 + G) * a) % (2 * np.pi) for a, b in ((a_1, b_1), (a_2, b_2)))
    grey = C_1 * C_2 == 0
    turn = np.where(grey, 0.0, (h_2 - h_1 + np.pi) % (2 * np.pi) - np.pi)
    h = np.where(grey, h_1 + h_2, h_1 + turn / 2)
    L, C = (L_1 + L_2) / 2, (C_1 + C_2) / 2
    T = 1 - 0.17 * np.cos(h - np.pi / 6) + 0.24 * np.cos(2 * h)
    T += 0.32 * np.cos(3 * h + np.pi / 30) - 0.2 * np.cos(4 * h - np.deg2rad(63))
    dL = (L_2 - L_1) / (1 + 0.015 * (L - 50) ** 2 / np.sqrt(20 + (L - 50) ** 2))
    dC = (C_2 - C_1) / (1 + 0.045 * C)
    dH = 2 * np.sqrt(C_1 * C_2) * np.sin(turn / 2) / (1 + 0.015 * C * T)
    from_blue = (np.rad2deg(h) % 360 - 275) / 25
    R_T = -2 * chroma_weight(C) * np.sin(np.deg2rad(60) * np.exp(-(from_blue**2)))
    return np.sqrt(np.maximum(dL**2 + dC**2 + dH**2 + R_T * dC * dH, 0.0))


def daylight(wavelengths: ArrayLike) -> NDArray[np.float64]:
    """Return the illuminant D65 (CIE 15:2018) relative to its value at 560 nm, linearly interpolated: (n,), nm.

    It is constant outside 360 to 780 nm.
    """
    return np.interp(np.asarray(wavelengths), observer()[:, 0], observer()[:, 4])


def lamp_to_linear_sRGB(wavelengths: NDArray[np.float64]) -> NDArray[np.float64]:
    """Return the matrix from fractions of a lamp's light at wavelengths in nm to linear sRGB, (n, 3).

    The lamp is daylight between the first and the last wavelength, fractions are linear between them, and all of its
    light is white. Light of one wavelength, or within 2 nm, is shown as grey.
    """
    first, last = wavelengths.min(), wavelengths.max()
    count = len(wavelengths)
    if last - first < 2:
        return np.full((count, 3), 1 / count)
    shown = np.linspace(first, last, min(41, 1 + int(last - first)))
    order = np.argsort(wavelengths)
    hats = np.stack([np.interp(shown, wavelengths[order], one) for one in np.eye(count)[:, order]])
    return radiance_to_linear_sRGB(hats * daylight(shown), shown) / radiance_to_linear_sRGB(daylight(shown), shown)


_UPSAMPLING_STEPS, _MIN_DAMPING = 60, 1e-9


def upsampled(rgb: NDArray[np.floating], matrix: NDArray[np.floating]) -> NDArray[np.float64]:
    """Return smooth spectra from 0 to 1 that have colours, (..., 3) → (..., n), where `matrix` allows them.

    Each is ½ + p/(2 √(1 + p²)), p a parabola over the wavelengths (Jakob and Hanika 2019, A low-dimensional function
    space for efficient spectral upsampling), fitted by damped Gauss–Newton steps to the cube roots of linear sRGB, in
    which steps are about as large as they look.

    Args:
        rgb: linear sRGB from 0 to 1.
        matrix: from a spectrum at n wavelengths in ascending order to linear sRGB, (n, 3).
    """
    colours, index = np.unique(np.reshape(rgb, (-1, 3)), axis=0, return_inverse=True)
    x = np.linspace(-1, 1, len(matrix)) if len(matrix) > 1 else np.zeros(1)
    powers = np.stack([np.ones_like(x), x, x**2], axis=-1)

    def lightness(values: NDArray[np.floating]) -> NDArray[np.floating]:
        return np.where(values > _DARK, np.cbrt(values), (values / _DARK + 2) * np.cbrt(_DARK) / 3)

    def reflectances(c: NDArray[np.float64]) -> NDArray[np.float64]:
        p = c @ powers.T
        return 0.5 + p / (2 * np.sqrt(1 + p**2))

    def residual(c: NDArray[np.float64]) -> NDArray[np.float64]:
        return lightness(reflectances(c) @ matrix) - lightness(colours)

    mean = np.clip(colours.mean(axis=-1), 0.01, 0.99)
    c = np.zeros((len(colours), 3))
    c[:, 0] = (2 * mean - 1) / np.sqrt(1 - (2 * mean - 1) ** 2)
    damping, error = np.full(len(c), 1e-2), (residual(c) ** 2).sum(axis=-1)
    for _ in range(_UPSAMPLING_STEPS):
        p = c @ powers.T
        slope = (0.5 / (1 + p**2) ** 1.5)[..., None] * powers  # (colours, n, 3)
        reached = np.maximum(reflectances(c) @ matrix, _DARK)
        jacobian = np.einsum("nk,cnj->ckj", matrix, slope) / (3 * np.cbrt(reached**2))[..., None]
        normal = jacobian.swapaxes(1, 2) @ jacobian
        normal += np.eye(3) * (damping * (1e-12 + normal.trace(axis1=1, axis2=2)))[:, None, None]
        step = np.linalg.solve(normal, (jacobian.swapaxes(1, 2) @ residual(c)[..., None]))[..., 0]
        found = (residual(c - step) ** 2).sum(axis=-1)
        better = found < error
        c, error = np.where(better[:, None], c - step, c), np.where(better, found, error)
        damping = np.clip(np.where(better, damping / 4, damping * 8), _MIN_DAMPING, 1 / _MIN_DAMPING)
    return reflectances(c)[index].reshape(*np.shape(rgb)[:-1], len(matrix))


SRGB_TO_LMS = np.array(
    [
        [0.4122214708, 0.5363325363, 0.0514459929],
        [0.2119034982, 0.6806995451, 0.1073969566],
        [0.0883024619, 0.2817188376, 0.6299787005],
    ]
)
_LMS_TO_SRGB = np.linalg.inv(SRGB_TO_LMS)
LMS_TO_OKLAB = np.array(  # of their cube roots
    [
        [0.2104542553, 0.7936177850, -0.0040720468],
        [1.9779984951, -2.4285922050, 0.4505937099],
        [0.0259040371, 0.7827717662, -0.8086757660],
    ]
)
_SHOULDER_START = 0.8
_ROUNDNESS = 0.3
_BISECTIONS = 20


def _with_chroma(rgb: NDArray[np.floating], factor: float | NDArray[np.floating]) -> NDArray[np.float64]:
    """Multiply the chroma of Oklab by factors (..., 1), at constant hue and lightness; linear sRGB, (..., 3)."""
    root = np.cbrt(rgb @ SRGB_TO_LMS.T)
    grey = (root @ LMS_TO_OKLAB[0])[..., None]  # in Oklab, the three roots of a grey are its lightness
    return (grey + factor * (root - grey)) ** 3 @ _LMS_TO_SRGB.T


def _is_inside(rgb: NDArray[np.floating]) -> NDArray[np.bool_]:
    """Whether colours are in the rounded gamut, linear sRGB (..., 3) → (..., 1)."""
    mean = rgb.mean(axis=-1, keepdims=True)
    return (rgb.min(axis=-1, keepdims=True) >= 0) & (rgb.prod(axis=-1, keepdims=True) >= (_ROUNDNESS * mean) ** 3)


def _shoulder(x: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return x up to 0.8 and 1 − d²/(x + d − 0.8), d = 0.2, above, which is smooth and tends to 1."""
    d = 1 - _SHOULDER_START
    return np.where(x > _SHOULDER_START, 1 - d * d / (np.maximum(x - _SHOULDER_START, 0.0) + d), x)


def into_gamut(rgb: NDArray[np.floating]) -> NDArray[np.float64]:
    """Desaturate colours near and outside the boundary of the sRGB gamut, at constant luminance and hue of Oklab.

    The gamut is rounded: the geometric mean of the components is at least 0.3 of their arithmetic mean. It has no
    corners, at which the colours of a spectrum would have edges. For a chroma of x times that of the boundary at the
    same hue, colours are unchanged up to x = 0.8; above, x becomes 1 − d²/(x + d − 0.8), d = 0.2, as in `roll_off`. The
    result is black where the luminance is not positive or a value is not finite. Both are linear sRGB, (..., 3).
    """
    rgb = np.asarray(rgb, dtype=np.float64)
    rgb = np.where(np.isfinite(rgb).all(axis=-1, keepdims=True), rgb, 0.0)
    luminance = np.maximum(rgb @ SRGB_TO_XYZ[1], 0.0)[..., None]
    result = np.where(luminance > 0, rgb, 0.0)
    changed = (luminance > 0)[..., 0] & ~_is_inside(_with_chroma(rgb, 1 / _SHOULDER_START))[..., 0]
    colours = rgb[changed] / luminance[changed]
    inside, outside = np.zeros((len(colours), 1)), np.full((len(colours), 1), 1 / _SHOULDER_START)
    for _ in range(_BISECTIONS):
        middle = (inside + outside) / 2
        found = _is_inside(_with_chroma(colours, middle))
        inside, outside = np.where(found, middle, inside), np.where(found, outside, middle)
    mapped = np.maximum(_with_chroma(colours, outside * _shoulder(1 / outside)), 0.0)
    found = (mapped @ SRGB_TO_XYZ[1])[..., None]
    # Of no colour that can be seen is the lightness negative; such a one becomes grey.
    result[changed] = luminance[changed] * np.divide(mapped, found, out=np.ones_like(mapped), where=found > 0)
    return result


_WHITENING = 0.15  # a pixel ten times too bright is desaturated by 58 %


def _size(rgb: NDArray[np.floating]) -> NDArray[np.floating]:
    """Return a smooth norm, at least the brightest channel and at most 1.09 times it: (..., 3) → (..., 1).

    It is the mean μ plus the 3-norm of what exceeds it, and hence μ for a grey.
    """
    mean = rgb.mean(axis=-1, keepdims=True)
    return mean + np.cbrt((np.maximum(rgb - mean, 0.0) ** 3).sum(axis=-1, keepdims=True))


def roll_off(rgb: NDArray[np.floating]) -> NDArray[np.float64]:
    """Compress highlights into [0, 1] at constant hue of Oklab.

    A smooth norm p of a pixel, about its brightest channel, is unchanged up to 0.8. Above, it becomes
    1 − d²/(p + d − 0.8) with d = 0.2, which is smooth and tends to 1. Very bright pixels are also desaturated. Both
    curves are those of the Khronos PBR Neutral tone mapper (Khronos Group, 2024), without its toe, which applies to
    dielectric surfaces. Both colours are linear sRGB, (..., 3), not negative.
    """
    result = np.array(rgb, np.float64)
    bright = _size(result)[..., 0] > _SHOULDER_START
    size = _size(result[bright])
    shown = _shoulder(size)
    whiter = np.maximum(_with_chroma(result[bright], 1 / (_WHITENING * (size - shown) + 1)), 0.0)
    result[bright] = whiter * shown / _size(whiter)
    return result


def auto_exposure(rgb: NDArray[np.floating]) -> float:
    """Compute an automatic exposure, the factor for linear radiance, from linear sRGB (..., 3) that is not negative.

    Scales the 97th percentile of the brightest channel over the lit pixels to one. A pixel is lit if it exceeds a
    thousandth of the 99th percentile, which makes the result robust against a black background, visible lamps and
    fireflies. The brightest channel is used because the luminance of saturated blue and red is small. The exposure of a
    black picture is 1.
    """
    peak = rgb.max(axis=-1)
    peak = peak[peak > 0]
    if peak.size == 0:
        return 1.0
    lit = peak[peak > 1e-3 * np.percentile(peak, 99)]
    return float(1 / np.percentile(lit, 97))


ViewTransform = Callable[[NDArray[np.floating]], NDArray[np.floating]]
"""Exposed linear sRGB, (..., 3) → values for a display, 0 to 1."""


def neutral_view(rgb: NDArray[np.floating]) -> NDArray[np.floating]:
    """Encode exposed, non-negative linear sRGB for a display: `roll_off`, transfer function of sRGB."""
    return _encoded(roll_off(rgb))


def plain_view(rgb: NDArray[np.floating]) -> NDArray[np.floating]:
    """Encode exposed, non-negative linear sRGB for a display: the transfer function of sRGB alone, clipped at one."""
    return _encoded(np.minimum(rgb, 1.0))


def _encoded(rgb: NDArray[np.floating]) -> NDArray[np.floating]:
    """Apply the transfer function of sRGB (IEC 61966-2-1) to values that are not negative."""
    return np.where(rgb <= 0.0031308, 12.92 * rgb, 1.055 * rgb ** (1 / 2.4) - 0.055)


def ocio_view(name: str) -> ViewTransform:
    """Return a view of OpenColorIO for its default display, such as the filmic curve of ACES.

    The configuration comes from $OCIO. Without $OCIO it is the one built into OpenColorIO (ACES for computer graphics).
    Colours enter as XYZ relative to D65, by the role `cie_xyz_d65_interchange`.

    Args:
        name: of the view, or the beginning of it, in upper or lower case.

    Raises:
        ValueError: if OpenColorIO is not installed, the configuration cannot be used, or it has no such view.
    """
    try:
        import PyOpenColorIO as ocio
    except ModuleNotFoundError:
        raise RequestError(f"view: opencolorio is not installed; {pip_install('ocio')}") from None
    source = os.environ.get("OCIO") or "ocio://default"
    try:
        config = ocio.Config.CreateFromFile(source)
        display = config.getDefaultDisplay()
        views = list(config.getViews(display))
        view = min((view for view in views if view.casefold().startswith(name.casefold())), key=len, default=None)
        if view is None:
            raise RequestError(f"view: got {name!r}, the views of {source} are {', '.join(views)}")
        transform = config.getProcessor("cie_xyz_d65_interchange", display, view, ocio.TRANSFORM_DIR_FORWARD)
    except (ocio.Exception, ocio.ExceptionMissingFile) as error:
        raise RequestError(f"view: {source} cannot be used by OpenColorIO ({' '.join(str(error).split())})") from None
    processor = transform.getDefaultCPUProcessor()

    def shown(rgb: NDArray[np.floating]) -> NDArray[np.floating]:
        values = np.ascontiguousarray(linear_sRGB_to_XYZ(rgb), np.float32)
        processor.applyRGB(values)
        return values

    return shown


def on_screen(rgb: NDArray[np.floating], view: ViewTransform = neutral_view) -> NDArray[np.uint8]:
    """Encode exposed, non-negative linear sRGB for a display, 8 bits."""
    return np.round(255 * np.clip(view(rgb), 0.0, 1.0)).astype(np.uint8)


def hex_code(rgb: NDArray[np.floating]) -> str:
    """Return the sRGB code, "#ffc08a", of non-negative linear sRGB (3,), its brightest component scaled to one."""
    shown = _encoded(rgb / max(rgb.max(), 1e-300))
    return "#" + bytes(np.round(255 * shown).astype(np.uint8)).hex()
