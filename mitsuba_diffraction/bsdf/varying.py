"""Numbers that may vary over the surface: numbers, textures, and files of pictures; the scales of a relief."""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError, is_number
from ..files.picture_file import IN_TEXTURE, check_picture
from .device_tables import larger
from .mitsuba_internals import nested_plugin

_MIN_HEIGHT_SCALE = 1e-6  # stands for 0, where κ₁, which bounds K of transmitted light, would vanish
_MIN_LATERAL_SCALE = 0.01  # below, a period is shorter than any wavelength


class VaryingNumber:
    """A number that may vary over the surface.

    Attributes:
        name: of the parameter.
        value: a number, several of them, or a texture of numbers, which may be given by the name of its file.
        values: the distinct values of a texture, ascending; interpolated ones lie between them.
    """

    def __init__(self, name: str, value: Any) -> None:
        """Take the value of the parameter `name`; a list has several numbers.

        Raises:
            RequestError: if it is neither a number nor a texture whose values are known.
        """
        self.name = name
        if isinstance(value := number_or_text(value), str):
            value = numbers_from(name, value)
        if not is_number(value) and not isinstance(value, mi.Texture | list):
            raise RequestError(f"{name}: got {value!r}, wanted a number or a texture")
        self.value = value if isinstance(value, mi.Texture) else mi.Float(value)
        self.read()

    @property
    def varies(self) -> bool:
        """Whether it is a texture."""
        return isinstance(self.value, mi.Texture)

    def read(self) -> None:
        """Read the values again, as the user may have changed them.

        Raises:
            RequestError: if they are unknown, as for a mesh attribute, or not finite.
        """
        found = [self.value]
        if self.varies:
            check_texture(self.name, self.value)
            parameters = mi.traverse(self.value)
            found = [parameters[key] for key in parameters.keys() if key.split(".")[-1] != "to_uv"]  # noqa: SIM118
            known = all(key.split(".")[-1] in ("data", "value", "to_uv") for key in parameters.keys())  # noqa: SIM118
            if not found or not known:
                raise RequestError(
                    f"{self.name}: got a {self.value.class_name()}, whose range is not known, wanted a number, bitmap "
                    "or checkerboard"
                )
        self.values = np.unique(np.concatenate([np.ravel(np.array(dr.detach(v), np.float64)) for v in found]))
        if not np.isfinite(self.values).all():
            raise RequestError(f"{self.name}: got values that are not finite, wanted numbers")

    def value_at(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> mi.Float:
        """Evaluate the number at a point."""
        return self.value.eval_1(si, active) if self.varies else self.value

    def put(self, callback: mi.TraversalCallback) -> None:
        """Add the number to the parameters of the scene."""
        callback.put(self.name, self.value, mi.ParamFlags.Differentiable)

    def __str__(self) -> str:
        low, high = self.values[[0, -1]]
        return f"{low:.6g} to {high:.6g}" if self.varies else str(self.value)


class Scales:
    """The scales of heights and lengths of a scene; iterates over both.

    Attributes:
        height: of the heights.
    """

    def __init__(self, height: Any, lateral: Any) -> None:
        self.height, self._lateral = VaryingNumber("height_scale", height), VaryingNumber("lateral_scale", lateral)

    def __iter__(self) -> Iterator[VaryingNumber]:
        return iter([self.height, self._lateral])

    @property
    def lateral(self) -> VaryingNumber | None:
        """The scale of lengths along the surface; None if it is the number 1 and nothing is derived by it."""
        of_lengths = self._lateral
        is_one = not of_lengths.varies and of_lengths.values[0] == 1 and not dr.grad_enabled(of_lengths.value)
        return None if is_one else of_lengths

    @property
    def max_scale(self) -> float:
        """The maximum scale, at least one: the spectrum must begin at a wavelength shorter by this factor."""
        return max(1.0, *(float(scale.values[-1]) for scale in self))

    def ratio_and_lateral(self, si: mi.SurfaceInteraction3f, active: mi.Bool) -> tuple[mi.Float, mi.Float]:
        """Return h/s and s at a point, h of the heights and s of lengths along the surface.

        Scaling lengths by s and heights by h is equivalent to scaling heights by h/s, at the wavelength λ/s and with
        lobes of the width s σ_q.
        """
        height = larger(self.height.value_at(si, active), _MIN_HEIGHT_SCALE)
        if self.lateral is None:
            return height, mi.Float(1.0)
        # Not the number itself: Dr.Jit cannot differentiate a branch in a virtual call that takes a member as it is.
        lateral = larger(self.lateral.value_at(si, active), _MIN_LATERAL_SCALE)
        return height / lateral, lateral

    @property
    def laterals(self) -> tuple[float, float]:
        """Bounds of the lateral scale."""
        return float(self._lateral.values[0]), float(self._lateral.values[-1])

    def ratios(self) -> tuple[float, float]:
        """Return bounds of the ratio of height scale to lateral scale."""
        low, high = np.maximum(self.height.values[[0, -1]], _MIN_HEIGHT_SCALE)
        min_lateral, max_lateral = self.laterals
        return float(low / max_lateral), float(high / min_lateral)

    def check(self, wavelengths: tuple[float, float], shortest: float, max_resolved: float | None) -> None:
        """Check the values against the range of a spectrum.

        Args:
            wavelengths: shortest and longest of the spectrum, nm.
            shortest: of the light next to the relief, nm.
            max_resolved: the maximum lateral scale for which orders do not overlap; None if they overlap.

        Raises:
            RequestError: with the wavelengths for which to build the spectrum.
        """
        # A spectrum may begin at a longer wavelength, as long as the lights of the scene do, too.
        covered = max(shortest / wavelengths[0], 1.0)
        for scale in self:
            if not scale.varies:
                dr.make_opaque(scale.value)
            low, high = scale.values[[0, -1]]
            minimum = 0.0 if scale is self.height else _MIN_LATERAL_SCALE
            if low < minimum or high > covered * (1 + 1e-6):
                bad = low if low < minimum else high
                raise RequestError(
                    f"{scale.name}: got {bad:.6g}, wanted {minimum:g} to {covered:.4g}: the spectrum was built for "
                    f"wavelengths from {wavelengths[0]:g} nm; for larger scales build it from {shortest:.4g} nm "
                    "divided by the scale" + (f", here {shortest / high:.4g} nm" if high > covered else "")
                )
        if self.lateral is not None and (max_resolved is None or self.lateral.values[-1] > max_resolved):
            derivative = " with a derivative" if dr.grad_enabled(self.lateral.value) else ""
            raise RequestError(
                f"lateral_scale: got {self.lateral}{derivative}, wanted 1"
                + ("" if max_resolved is None else f" or less than {max_resolved:.4g}")
                + ": only of orders that do not overlap the lobes keep their width (not of samples, of tiles as large "
                "as the coherence length, nor of line gratings with a coherence length below 15 um)"
            )


def number_or_text(value: Any) -> Any:
    """Return a text that is a number as a number, and all else as it is."""
    try:
        return float(value) if isinstance(value, str) else value
    except ValueError:
        return value


def numbers_from(name: str, file: str, white: float = 1.0, others: str = "") -> mi.Texture:
    """Return a texture of the numbers in a picture, without gamma. The maximum of an integer type becomes `white`.

    `others` are the texts that the parameter may have instead, for the message.

    Raises:
        FileNotFoundError: if there is no such file.
        RequestError: if it is not a picture, or larger than `check_picture` allows.
    """
    path = str(mi.file_resolver().resolve(file))
    check_picture(path, IN_TEXTURE)
    try:
        bitmap = mi.Bitmap(path)
    except RuntimeError:
        if Path(file).suffix[1:2].isalpha() and not os.path.exists(path):
            raise FileNotFoundError(f"{name}: {file}: no such file") from None
        raise RequestError(f"{name}: got {file!r}, wanted {others}a number or the file of a picture") from None
    bitmap.set_srgb_gamma(False)
    numbers = np.array(bitmap.convert(mi.Bitmap.PixelFormat.Y, mi.Struct.Type.Float32, srgb_gamma=False))
    if bitmap.component_format() in (mi.Struct.Type.UInt8, mi.Struct.Type.UInt16):
        numbers *= white
    (texture,) = nested_plugin("bitmap", bitmap=mi.Bitmap(numbers), raw=True).expand()
    return texture


def check_texture(name: str, texture: mi.Texture) -> None:
    """Check the values of a texture in the place of a number.

    Raises:
        RequestError: if some are not finite, or a bitmap has colours.
    """
    parameters = mi.traverse(texture)
    for key in parameters.keys():  # noqa: SIM118
        if key.split(".")[-1] in ("to_uv", "range"):
            continue
        values = np.array(dr.detach(parameters[key]), np.float64)
        if not np.isfinite(values).all():
            raise RequestError(f"{name}: got values that are not finite, wanted numbers")
        # Coefficients of an upsampled spectrum.
        if key.split(".")[-1] == "value" and values.size > 1:
            raise RequestError(f"{name}: got colours, wanted numbers")
    if "data" not in parameters:
        return
    try:
        texture.eval_1(dr.zeros(mi.SurfaceInteraction3f))
    except RuntimeError:
        raise RequestError(f"{name}: got a picture in colour, wanted numbers: set its parameter raw to true") from None
