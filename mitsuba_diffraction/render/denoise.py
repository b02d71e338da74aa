"""Denoised previews, by Intel Open Image Denoise on the CPU. Spectral pictures are never denoised.

The denoiser expects noise that is independent from pixel to pixel. The reconstruction filter h of a film correlates it,
with the autocorrelation r = h ⋆ h and hence the power spectrum R(f) = Σ_n r(n) e^{2πi n f}. The picture is therefore
divided by √R in the frequency domain, denoised, and multiplied by √R.
"""

from __future__ import annotations

import os
import re
from dataclasses import dataclass
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray
from scipy import fft

from ..bsdf.device_tables import on_device
from ..errors import RequestError, pip_install
from ..optics.color import SRGB_TO_XYZ
from .spectral_image import split_rows
from .trace_pass import Rows

_SAMPLES_OF_GUIDES = 16  # per pixel
_ALBEDO_WAVELENGTHS = (610.0, 550.0, 465.0)  # nm: red, green, blue
_STEPS_PER_PIXEL = 100  # of the numerical autocorrelation
_MIN_RESPONSE = 0.1  # lower bound of √R, for filters that remove a frequency
DENOISED_PIXELS = 2**20  # take 0.6 GB
BLENDED_ROWS = 64  # of two bands


@dataclass(frozen=True, eq=False)
class Guides:
    """Auxiliary pictures for the denoiser, for the first sensor.

    Attributes:
        albedo: float32 (rows, columns, 3), 0 to 1: of the first surface hit if it is diffuse, else one.
        normals: float32 (rows, columns, 3): shading normals in world space; zero for the background.
        response: √R of the reconstruction filter at the frequencies of a discrete cosine transform, (rows, columns, 1).
    """

    albedo: NDArray[np.float32]
    normals: NDArray[np.float32]
    response: NDArray[np.float64]


def default_of(scene: str | os.PathLike[str]) -> str | None:
    """Return the value of `<default name="denoise" value="…"/>` of an XML scene, which Mitsuba ignores, or None."""
    # By regular expressions: Mitsuba reads scenes that XML parsers refuse, such as scenes with "--" in a comment.
    text = re.sub(r"<!--.*?-->", "", Path(scene).read_text(encoding="utf-8", errors="replace"), flags=re.DOTALL)
    tags = (dict(re.findall(r"""(\w+)\s*=\s*["'](.*?)["']""", tag)) for tag in re.findall(r"<default\b([^>]*)>", text))
    return {tag.get("name"): tag.get("value") for tag in tags}.get("denoise")


def is_requested(scene: str | os.PathLike[str], given: str | None = None) -> bool:
    """Return whether a denoised preview is requested by an XML scene, or by a value given for its default."""
    value = given or default_of(scene) or "false"
    if value not in ("true", "false"):
        raise RequestError(f"{os.fspath(scene)}: denoise: got {value!r}, wanted true or false")
    return value == "true"


def check_requirements() -> None:
    """Check that previews can be denoised.

    Raises:
        ValueError: if pyoidn is not installed.
    """
    try:
        import pyoidn  # noqa: F401
    except ModuleNotFoundError:
        raise RequestError(f"denoise: pyoidn is not installed; {pip_install('denoise')}") from None


def guides(scene: mi.Scene, band: Rows | None = None) -> Guides:
    """Render the guides of a scene, or of a band of its rows; for errors see `check_requirements`."""
    check_requirements()
    sensor = scene.sensors()[0]
    columns, rows = (int(size) for size in sensor.film().crop_size())
    first, end = band or (0, rows)
    blocks = split_rows(end - first, columns)
    parts = [_guides(scene, first + block.start, min(end, first + block.stop)) for block in blocks]
    response = np.multiply.outer(*(_response(sensor.film().rfilter(), size) for size in (end - first, columns)))
    albedo, normals = (np.concatenate(part) for part in zip(*parts, strict=True))
    return Guides(albedo, normals, response[..., None])


def _guides(scene: mi.Scene, first: int, end: int) -> tuple[NDArray[np.float32], NDArray[np.float32]]:
    """Return albedo and normals of rows."""
    sensor = scene.sensors()[0]
    columns, rows = (int(size) for size in sensor.film().crop_size())
    sampler = mi.load_dict({"type": "independent"})
    sampler.seed(first, (end - first) * columns * _SAMPLES_OF_GUIDES)
    pixel = dr.arange(mi.UInt32, (end - first) * columns * _SAMPLES_OF_GUIDES) // _SAMPLES_OF_GUIDES
    corner = mi.Point2f(pixel % columns, pixel // columns + dr.opaque(mi.UInt32, first))
    position = (corner + sampler.next_2d()) / mi.Point2f(columns, rows)
    ray, _ = sensor.sample_ray_differential(0.0, sampler.next_1d(), position, sampler.next_2d())
    ray.wavelengths = type(ray.wavelengths)(*_ALBEDO_WAVELENGTHS, _ALBEDO_WAVELENGTHS[1])
    hit = scene.ray_intersect(ray)
    bsdf = hit.bsdf(ray)
    diffuse = mi.has_flag(bsdf.flags(), mi.BSDFFlags.Diffuse)
    albedo = mi.unpolarized_spectrum(bsdf.eval_diffuse_reflectance(hit, diffuse))
    albedo = dr.select(diffuse, dr.clip(albedo, 0, 1), 1)
    normal = dr.select(hit.is_valid(), hit.sh_frame.n, 0)
    dr.eval(albedo, normal)  # in one kernel, instead of one that traces rays for each of six numbers

    def mean(*channels: mi.Float) -> NDArray[np.float32]:
        values = [np.array(x).reshape(end - first, columns, _SAMPLES_OF_GUIDES).mean(-1) for x in channels]
        return np.stack(values, -1).astype(np.float32)

    return mean(*(albedo[i] for i in range(3))), mean(normal.x, normal.y, normal.z)


def _response(kernel: mi.ReconstructionFilter, size: int) -> NDArray[np.float64]:
    """Return √R at the frequencies of a discrete cosine transform of `size` numbers, one at f = 0; (size,)."""
    shifts = np.arange(int(np.ceil(2 * kernel.radius())) + 1)
    x = np.arange(-kernel.radius(), kernel.radius(), 1 / _STEPS_PER_PIXEL) + 0.5 / _STEPS_PER_PIXEL
    h = np.array(kernel.eval(on_device(x)))
    autocorrelation = np.array([h @ np.interp(x + shift, x, h, 0, 0) for shift in shifts])
    autocorrelation[1:] *= 2
    power = np.cos(np.pi * np.arange(size)[:, None] / size * shifts) @ autocorrelation
    return np.sqrt(np.maximum(power / power[0], _MIN_RESPONSE**2))


def denoised(XYZ: NDArray[np.floating], guide: Guides) -> NDArray[np.float64]:
    """Denoise a picture, XYZ of any scale, (rows, columns, 3), by guides of the same pixels."""
    import pyoidn

    # Denoised in XYZ, where no visible colour has a negative component. In an RGB space that contains all of them, the
    # luminance of violet light is a small difference of channels. Denoising loses this difference: violet pixels become
    # black.
    white = SRGB_TO_XYZ.sum(1)  # divisor of XYZ, so that grey has equal channels
    albedo = np.ascontiguousarray(guide.albedo @ (SRGB_TO_XYZ.T / white), np.float32)
    uncorrelated = fft.idctn(fft.dctn(XYZ / white, axes=(0, 1)) / guide.response, axes=(0, 1))
    noisy = np.ascontiguousarray(uncorrelated, np.float32)
    result = pyoidn.denoise(noisy, albedo=albedo, normal=guide.normals, hdr=True)
    return fft.idctn(fft.dctn(result.astype(np.float64), axes=(0, 1)) * guide.response, axes=(0, 1)) * white


def denoised_picture(scene: mi.Scene, XYZ: NDArray[np.floating]) -> NDArray[np.floating]:
    """Denoise a picture of a scene, (rows, columns, 3); a large one in bands that overlap and are blended."""
    rows, columns, _ = XYZ.shape
    dr.flush_malloc_cache()
    count = 1
    if rows * columns > DENOISED_PIXELS:
        count = -(-rows // max(BLENDED_ROWS, DENOISED_PIXELS // columns - BLENDED_ROWS))
    result, total = np.zeros_like(XYZ), np.zeros((rows, 1, 1), XYZ.dtype)
    for index in range(count):
        first = max(0, rows * index // count - BLENDED_ROWS // 2)
        end = min(rows, rows * (index + 1) // count + BLENDED_ROWS // 2)
        from_edge = np.minimum(np.arange(1, end - first + 1), np.arange(end - first, 0, -1))
        weight = np.minimum(from_edge, BLENDED_ROWS)[:, None, None].astype(XYZ.dtype)
        result[first:end] += weight * denoised(XYZ[first:end], guides(scene, (first, end)))
        total[first:end] += weight
    return result / total
