"""A rigorous spectrum as an OpenEXR file: float32, ZIP, one part.

Channel `eta(07)` holds plane 7 of the table (`Axes`): the squares [P, R] of the orders −M … M from top to bottom, each
at the left. Numbers in the header are double precision.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np
import OpenEXR

from ..errors import RequestError
from ..files import whole_file
from ..spectrum.file import silence
from .axes import Axes

if TYPE_CHECKING:
    from .spectrum import RigorousSpectrum

Spectrum = TypeVar("Spectrum")

FORMAT = "mitsuba_diffraction rigorous spectrum"
FORMAT_VERSION = 1

_NUMBERS = ("coherence_length", "tolerance", "error", "worst", "worst_near")
_TEXTS = ("material", "source", "source_digest")


def save(spectrum: RigorousSpectrum, path: str | os.PathLike[str]) -> None:
    """Write `spectrum` to `path`, whole or not at all.

    Raises:
        OSError: if the file cannot be written.
    """
    axes = spectrum.axes
    orders = range(-axes.largest, axes.largest + 1)
    sheet = np.zeros((axes.planes, sum(axes.side(m) for m in orders), axes.side(0)), np.float32)
    top = 0
    for m in orders:
        side = axes.side(m)
        sheet[:, top : top + side, :side] = _square(axes, spectrum.values, m)
        top += side
    index = complex(spectrum.int_ior)
    header = {
        "type": OpenEXR.scanlineimage,
        "compression": OpenEXR.ZIP_COMPRESSION,
        "format": FORMAT,
        "formatVersion": FORMAT_VERSION,
        "period": np.array([axes.period]),
        "wavelengths": np.array(axes.wavelengths),
        "steps": axes.steps,
        "planes": axes.planes,
        "harmonics": spectrum.harmonics,
        "intIor": np.array([index.real, index.imag]),
        **{_camel(name): np.array([getattr(spectrum, name)]) for name in _NUMBERS},
        **{_camel(name): getattr(spectrum, name) for name in _TEXTS},
        "units": "lengths and wavelengths in micrometres",
    }
    with whole_file(path) as temporary:
        OpenEXR.File(header, {_channel(k): plane for k, plane in enumerate(sheet)}).write(str(temporary))


def load(path: str | os.PathLike[str], construct: Callable[..., Spectrum]) -> Spectrum:
    """Hand what `save` wrote to the constructor of a `RigorousSpectrum`.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a rigorous spectrum, is damaged, or is of a version not known here.
    """
    path = Path(path)
    if not path.is_file():
        raise FileNotFoundError(f"{path}: no such file")
    try:
        with silence():
            file = OpenEXR.File(str(path), separate_channels=True)
            header, channels = file.header(), file.channels()
    except Exception as error:
        raise RequestError(f"{path}: not a readable OpenEXR file ({' '.join(str(error).split())})") from None
    if header.get("format") != FORMAT:
        raise RequestError(f"{path}: got an OpenEXR file of another kind, wanted a rigorous spectrum")
    if header.get("formatVersion") != FORMAT_VERSION:
        raise RequestError(
            f"{path}: got format version {header.get('formatVersion')}, wanted {FORMAT_VERSION}; "
            "build the spectrum again with this version of mitsuba_diffraction"
        )
    try:
        (period,), wavelengths = header["period"], tuple(float(x) for x in header["wavelengths"])
        axes = Axes(float(period), wavelengths, header["steps"], header["planes"])
        sheet = np.stack([channels[_channel(k)].pixels for k in range(axes.planes)])
        squares, top = [], 0
        for m in range(-axes.largest, axes.largest + 1):
            side = axes.side(m)
            squares.append(sheet[:, top : top + side, :side].reshape(axes.planes, side**2))
            top += side
        return construct(
            axes=axes,
            values=np.ascontiguousarray(np.concatenate(squares, axis=1)),
            int_ior=complex(*(float(x) for x in header["intIor"])),
            harmonics=header["harmonics"],
            **{name: float(header[_camel(name)][0]) for name in _NUMBERS},
            **{name: header[_camel(name)] for name in _TEXTS},
        )
    except KeyError as error:
        raise RequestError(f"{path}: a damaged spectrum, {error} is missing") from None
    except (TypeError, ValueError, IndexError) as error:
        raise RequestError(f"{path}: a damaged spectrum ({' '.join(str(error).split())})") from None


def _square(axes: Axes, values: np.ndarray, m: int) -> np.ndarray:
    side, start = axes.side(m), axes.offset(m)
    return values[:, start : start + side**2].reshape(-1, side, side)


def _channel(plane: int) -> str:
    return f"eta({plane:02d})"


def _camel(name: str) -> str:
    first, *others = name.split("_")
    return first + "".join(word.capitalize() for word in others)
