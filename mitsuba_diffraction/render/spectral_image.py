"""Spectral images, their OpenEXR files and their 8-bit previews."""

from __future__ import annotations

import itertools
import math
import os
import re
from collections.abc import Callable, Iterator, Mapping
from contextlib import closing, suppress
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError
from ..files.outputs import MARK, png_text
from ..files.reading import check_file
from ..files.writing import encoded_file, whole_file
from ..machine import usable_cores
from ..optics.color import (
    ViewTransform,
    XYZ_to_linear_sRGB,
    auto_exposure,
    into_gamut,
    neutral_view,
    on_screen,
    radiance_to_linear_sRGB,
    radiance_to_XYZ,
)
from ..spectrum.exr import load_exr, refuse_incomplete, silence

_LAYOUT_VERSION = "1.0"
# Radiance is per nm, the unit in the channel names: the authors of the layout and pbrt-v4 omit the nm⁻¹, and
# colour-science integrates the channels over wavelength.
_UNITS = "W.m^-2.sr^-1"
# The layout has decimal commas; other programs write points, too.
_CHANNEL = re.compile(r"S0\.(\d+[.,]?\d*|[.,]\d+)([Ee][+-]?\d+)?([kMGTPmunp]?)(m|Hz)")
_PREFIXES = {"k": 3, "M": 6, "G": 9, "T": 12, "P": 15, "": 0, "m": -3, "u": -6, "n": -9, "p": -12}
_SPEED_OF_LIGHT = 299792458  # m/s
# Header entries of OpenEXR and of the layout, which are not attributes.
_RESERVED = frozenset(
    (
        *("channels", "chunkCount", "compression", "dataWindow", "displayWindow", "lineOrder", "name"),
        *("pixelAspectRatio", "screenWindowCenter", "screenWindowWidth", "tiles", "type", "version", "view"),
        *("spectralLayoutVersion", "emissiveUnits", "writtenBy"),
    )
)


_JPEG_QUALITY = 95
PIXELS_PER_BLOCK = 2**15


def split_rows(rows: int, columns: int) -> list[slice]:
    """Return the blocks of rows in which large pictures are converted, to bound memory."""
    step = max(1, PIXELS_PER_BLOCK // columns)
    return [slice(first, first + step) for first in range(0, rows, step)]


def wider_hats(count: int, channels: int) -> NDArray[np.float32]:
    """Return the weights, (count, m), of `count` hats in m ≤ channels hats of unit area and k times the width."""
    k = next(k for k in itertools.count(1) if (count + 1) // k - 1 <= channels)
    centres = np.arange(k - 1, count - k + 1, k)
    return (np.maximum(0, 1 - np.abs(np.arange(count)[:, None] - centres) / k) / k).astype(np.float32)


@dataclass(frozen=True, eq=False)
class SpectralImage:
    """Spectral radiance per pixel.

    Attributes:
        wavelengths: (n,) float64, nm, ascending.
        radiance: (height, width, n) float32, W m⁻² sr⁻¹ nm⁻¹; row 0 is the top.
        attributes: metadata by name: text, integers (32 bits in the file) or floats (float32 in the file).
        alpha: (height, width) float32, 0 to 1, or None; radiance is multiplied by it, as is usual in OpenEXR.

    Raises:
        ValueError: if the shapes disagree, the wavelengths do not ascend, or an attribute has another type or a
            reserved name.
    """

    wavelengths: NDArray[np.float64]
    radiance: NDArray[np.float32]
    attributes: Mapping[str, str | int | float] = field(default_factory=dict)
    alpha: NDArray[np.float32] | None = None

    def __post_init__(self) -> None:
        wavelengths = np.array(self.wavelengths, dtype=np.float64)
        radiance = np.array(self.radiance, dtype=np.float32, order="C")
        if (
            wavelengths.ndim != 1
            or wavelengths.size == 0
            or not (np.isfinite(wavelengths).all() and np.all(np.diff(wavelengths, prepend=0.0) > 0))
        ):
            raise RequestError(f"wavelengths: got {self.wavelengths!r}, wanted (n,) positive and ascending, nm")
        if radiance.ndim != 3 or radiance.size == 0 or radiance.shape[2] != wavelengths.size:
            raise RequestError(
                f"radiance: got shape {radiance.shape}, wanted (height, width, {wavelengths.size}), none of them zero"
            )
        if self.alpha is not None:
            object.__setattr__(self, "alpha", np.array(self.alpha, dtype=np.float32))
            if np.shape(self.alpha) != radiance.shape[:2]:
                raise RequestError(f"alpha: got shape {np.shape(self.alpha)}, wanted {radiance.shape[:2]}")
        for name, value in self.attributes.items():
            if isinstance(value, int) and not -(2**31) <= value < 2**31:
                # OpenEXR would truncate it silently.
                raise RequestError(f"attributes: got {name!r} = {value}, wanted an integer of 32 bits")
            if name in _RESERVED or not isinstance(value, str | int | float):
                raise RequestError(
                    f"attributes: got {name!r} = {value!r}, wanted text or a number, under a name that is not OpenEXR's"
                )
        wavelengths.setflags(write=False)
        radiance.setflags(write=False)
        object.__setattr__(self, "wavelengths", wavelengths)
        object.__setattr__(self, "radiance", radiance)
        object.__setattr__(self, "attributes", dict(self.attributes))

    @property
    def shape(self) -> tuple[int, ...]:
        """(height, width, n)."""
        return self.radiance.shape

    def blocks(self) -> Iterator[NDArray[np.float32]]:
        """Yield the radiance from top to bottom, in blocks of rows."""
        for rows in split_rows(*self.shape[:2]):
            yield self.radiance[rows]

    def _fits_half(self) -> bool:
        """Return whether float16 rounds the picture by no more than 0.05 %, of radiance or of the mean radiance."""
        total, largest = 0.0, 0.0
        for block in self.blocks():
            rgb = radiance_to_linear_sRGB(block, self.wavelengths)
            # NaN is more than any limit.
            largest = np.maximum(largest, np.maximum(np.abs(block).max(), np.abs(rgb).max()))
            total += float(block.sum(dtype=np.float64))
        half = np.finfo(np.float16)
        return bool(largest <= half.max and total / math.prod(self.shape) >= half.smallest_normal)

    def save(
        self, path: str | os.PathLike[str], *, half: bool | None = False, rgb: bool = False, channels: int | None = None
    ) -> None:
        """Write an OpenEXR file in the spectral layout of Fichet, Pacanowski and Wilkie 2021.

        Channels `S0.405,000000nm` hold the radiance; R, G and B are linear sRGB (scaled as in `color`) for ordinary
        viewers, and A is alpha, if there is any.

        Args:
            half: write float16 instead of float32, in less than half the size. Radiance from 6.1e-5 to 65504 is then
                rounded by at most 2⁻¹¹ (0.05 %), smaller radiance by at most 3e-8. None: if none exceeds 65504 and the
                mean is at least 6.1e-5.
            rgb: write R, G and B (and A) alone, as float16, at most ±65504. Such a file cannot be loaded as a spectral
                image.
            channels: maximum number of wavelengths. Neighbouring ones are added with the weights that make their hats
                one of k times the width, for the smallest such k: 93, 46, 30, 22, … wavelengths, 5, 10, 15, 20, … nm
                apart.

        Raises:
            FileNotFoundError: if the folder does not exist.
            ValueError: if a radiance exceeds the range of float16, or channels is below 2 or given with rgb.
        """
        import Imath
        import OpenEXR

        if channels is not None and (rgb or channels < 2):
            raise RequestError(f"channels: got {channels}{' with rgb' if rgb else ''}, wanted two or more wavelengths")
        half = rgb or (self._fits_half() if half is None else half)
        kind, limit = (np.float16, float(np.finfo(np.float16).max)) if half else (np.float32, np.inf)
        pixel = Imath.Channel(Imath.PixelType(Imath.PixelType.HALF if half else Imath.PixelType.FLOAT))
        hats = None if channels is None else wider_hats(self.wavelengths.size, channels)
        wavelengths = self.wavelengths[:0] if rgb else self.wavelengths if hats is None else self.wavelengths @ hats
        numbers = [f"{wavelength:.6f}".replace(".", ",") for wavelength in wavelengths]
        names = ["R", "G", "B", *(f"S0.{number}nm" for number in numbers), *(["A"] if self.alpha is not None else [])]
        layout = {} if rgb else {"spectralLayoutVersion": _LAYOUT_VERSION, "emissiveUnits": _UNITS}
        attributes = {**self.attributes, **layout, "writtenBy": MARK}
        header = OpenEXR.Header(self.shape[1], self.shape[0])
        header |= {name: value.encode() if isinstance(value, str) else value for name, value in attributes.items()}
        header["channels"] = dict.fromkeys(names, pixel)
        # Wavelets compress noise better than ZIP.
        header["compression"] = Imath.Compression(Imath.Compression.PIZ_COMPRESSION)
        # Otherwise one thread compresses all pixels.
        OpenEXR.set_global_thread_count(usable_cores())
        # The only writer of OpenEXR that takes a file in blocks of rows.
        with whole_file(path) as temporary:
            with closing(OpenEXR.OutputFile(str(temporary), header)) as file:
                row = 0
                for block in self.blocks():
                    planes = radiance_to_linear_sRGB(block, self.wavelengths).astype(np.float32)
                    if rgb:
                        planes = np.clip(planes, -limit, limit)
                    else:
                        planes = np.concatenate([planes, block if hats is None else block @ hats], axis=-1)
                    if self.alpha is not None:
                        planes = np.concatenate([planes, self.alpha[row : row + len(block), :, None]], axis=-1)
                    row += len(block)
                    if (value := float(np.abs(planes).max())) > limit:
                        raise RequestError(
                            f"half: got radiances up to {value:.4g}, wanted at most {limit:.0f}; float32 holds them"
                        )
                    planes = planes.astype(kind)
                    file.writePixels({name: planes[..., i].tobytes() for i, name in enumerate(names)}, len(block))
            refuse_incomplete(temporary)

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> SpectralImage:
        """Read a file written by `save`.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is not an OpenEXR file, not in this layout and version, has no emissive channels, or one
                with another name than a wavelength or a frequency.
        """
        check_file(path, math.inf)
        try:
            header, channels = load_exr(Path(path))
        except RequestError as error:
            raise RequestError(f"{os.fspath(path)}: {error}") from None
        for name, wanted in (("spectralLayoutVersion", _LAYOUT_VERSION), ("emissiveUnits", _UNITS)):
            if header.get(name) != wanted:
                raise RequestError(f"{os.fspath(path)}: {name} is {header.get(name)!r}, wanted {wanted!r}")
        found = sorted((_wavelength(name, path), name) for name in channels if name.startswith("S0."))
        if not found:
            raise RequestError(f"{os.fspath(path)}: no channel like 'S0.405,000000nm'")
        for (one, first), (other, second) in itertools.pairwise(found):
            if one == other:
                raise RequestError(f"{os.fspath(path)}: two channels of {one:g} nm, {first!r} and {second!r}")
        shapes = {channels[name].pixels.shape for _, name in found}
        if len(shapes) > 1:
            raise RequestError(f"{os.fspath(path)}: got channels of {len(shapes)} sizes, wanted one")
        radiance = np.stack([channels[name].pixels for _, name in found], axis=-1)
        attributes = {
            name: value
            for name, value in header.items()
            if name not in _RESERVED and isinstance(value, str | int | float)
        }
        alpha = channels["A"].pixels.astype(np.float32) if "A" in channels else None
        return cls(np.array([wavelength for wavelength, _ in found]), radiance, attributes, alpha)


def _wavelength(name: str, path: str | os.PathLike[str]) -> float:
    """Return the wavelength in nm that an emissive channel names, in m or Hz with a prefix."""
    if (match := _CHANNEL.fullmatch(name)) is None:
        raise RequestError(f"{os.fspath(path)}: got the channel {name!r}, wanted one like 'S0.405,000000nm'")
    number, exponent, prefix, unit = match.groups(default="")
    value, power = float(number.replace(",", ".") + exponent), _PREFIXES[prefix]
    if unit == "m":
        return value * 10.0 ** (power + 9)
    return _SPEED_OF_LIGHT * 10.0 ** (9 - power) / value if value else math.inf


def stored_digest(path: str | os.PathLike[str]) -> str | None:
    """Return the attribute `digest` of a picture that `SpectralImage.save` or `save_preview` wrote.

    None if it has none, as the preview of an unfinished rendering, or is damaged.
    """
    import OpenEXR

    if Path(path).suffix.lower() != ".exr":
        return _notes(path).get("digest")
    with suppress(RuntimeError, ValueError), silence():
        return OpenEXR.File(os.fspath(path), header_only=True).header().get("digest")
    return None


def exposure_of_preview(path: str | os.PathLike[str]) -> float | None:
    """Return the exposure of a preview that `save_preview` wrote, None if it does not hold one."""
    with suppress(KeyError, ValueError):
        return float(_notes(path)["exposure"])
    return None


def _notes(path: str | os.PathLike[str]) -> dict[str, str]:
    """Return what `save_preview` noted in a picture: text chunks of PNG, lines NAME=VALUE of the comment of JPEG."""
    from PIL import Image

    damaged = OSError, SyntaxError, ValueError, AttributeError, Image.DecompressionBombError
    with suppress(*damaged), Image.open(path, formats=("PNG", "JPEG")) as picture:
        comment = picture.info.get("comment", b"").decode()
        return {**picture.info, **dict(line.split("=") for line in comment.splitlines()[1:])}
    return {}


def save_preview(
    image: SpectralImage,
    path: str | os.PathLike[str],
    exposure: float | None = None,
    denoise: Callable[[NDArray[np.float32]], NDArray[np.float32]] | None = None,
    view: ViewTransform = neutral_view,
) -> float:
    """Write an 8-bit sRGB preview of a spectral image, in the format given by the suffix of `path`: PNG or JPEG.

    It notes its exposure, and the digest of a finished rendering.

    Spectra → XYZ → linear sRGB → `into_gamut` → × exposure → view.

    Args:
        exposure: the factor for linear sRGB; by default `auto_exposure`. It is returned.
        denoise: applied to XYZ, (height, width, 3), such as `denoise.denoised_picture` of the scene.
        view: tone curve and encoding, such as `color.ocio_view`.

    Raises:
        ValueError: if Pillow does not support the suffix.
        OSError: of JPEG with alpha, or if it cannot be written.
    """
    from PIL import Image

    picture = np.concatenate([radiance_to_XYZ(block, image.wavelengths).astype(np.float32) for block in image.blocks()])
    if denoise is not None:
        picture = denoise(picture)
    blocks = split_rows(*picture.shape[:2])
    if image.alpha is not None:  # PNG has colours that are not multiplied by alpha
        picture /= np.where(image.alpha > 0, image.alpha, 1)[..., None]
    for rows in blocks:
        picture[rows] = into_gamut(XYZ_to_linear_sRGB(picture[rows]))
    if exposure is None:
        exposure = auto_exposure(picture)
    shown = np.concatenate([on_screen(picture[rows] * exposure, view) for rows in blocks])
    if image.alpha is not None:
        shown = np.dstack([shown, np.round(255 * image.alpha).astype(np.uint8)])
    notes = {"exposure": repr(exposure)}
    if "digest" in image.attributes:
        notes["digest"] = str(image.attributes["digest"])
    text = png_text()
    for name, value in notes.items():
        text.add_text(name, value)
    comment = "\n".join([MARK, *(f"{name}={value}" for name, value in notes.items())])
    with encoded_file(path) as stream:
        # Each format ignores the options of the other.
        Image.fromarray(shown).save(stream, pnginfo=text, comment=comment, quality=_JPEG_QUALITY, subsampling=0)
    return exposure
