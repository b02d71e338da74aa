"""Numbers that may vary over the surface: numbers, textures, and pictures given by the names of their files."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import drjit as dr
import mitsuba as mi
import numpy as np

from ..errors import RequestError, is_number
from ..files.picture_file import IN_TEXTURE, check_picture
from .mitsuba_internals import nested_plugin


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
