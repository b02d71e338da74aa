"""A rigorous spectrum as an OpenEXR file: float32, ZIP, one part.

Channel `eta(07)` holds plane 7 of the table (`Axes`): the squares [P, R] of the orders −M … M from top to bottom, each
at the left; below them, if the table is polarised, the Mueller matrices of this plane, one after the other. Numbers in
the header are double precision.
"""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, TypeVar

import numpy as np

from ..errors import RequestError
from ..spectrum.exr import doubles, one_line, read, write
from .axes import Axes

if TYPE_CHECKING:
    from .spectrum import RigorousSpectrum

Spectrum = TypeVar("Spectrum")
FORMAT = "mitsuba_diffraction rigorous spectrum"
FORMAT_VERSION = 2

_NUMBERS = ("ext_ior", "coherence_length", "tolerance", "error", "worst", "worst_near", "polarisation_error")
_TEXTS = ("material", "source", "source_digest")


def save(spectrum: RigorousSpectrum, path: str | os.PathLike[str], recipe: str = "") -> None:
    """Write `spectrum` to `path`, whole or not at all; `recipe` is the digest of that from which it was built.

    Raises:
        OSError: if the file cannot be written.
    """
    axes = spectrum.axes
    height, width = sum(axes.side(m) for m in axes.orders), axes.side(0)
    matrices = np.zeros((axes.planes, 0)) if spectrum.mueller is None else spectrum.mueller.reshape(axes.planes, -1)
    more = -(-matrices.shape[1] // width)
    sheet = np.zeros((axes.planes, height + more, width), np.float32)
    sheet[:, height:].reshape(axes.planes, -1)[:, : matrices.shape[1]] = matrices
    top = 0
    for m in axes.orders:
        side = axes.side(m)
        sheet[:, top : top + side, :side] = axes.square(spectrum.values, m)
        top += side
    index = complex(spectrum.int_ior)
    header = {
        "period": doubles(axes.period),
        "wavelengths": doubles(*axes.wavelengths),
        "steps": axes.steps,
        "planes": axes.planes,
        "harmonics": spectrum.harmonics,
        "polarised": int(spectrum.mueller is not None),
        "intIor": doubles(index.real, index.imag),
        **{_camel(name): doubles(getattr(spectrum, name)) for name in _NUMBERS},
        **{_camel(name): getattr(spectrum, name) for name in _TEXTS},
        "units": "lengths and wavelengths in micrometres",
    }
    write(path, FORMAT, FORMAT_VERSION, header, {_channel(k): plane for k, plane in enumerate(sheet)}, recipe)


def load(path: str | os.PathLike[str], construct: Callable[..., Spectrum], recipe: str | None = None) -> Spectrum:
    """Hand what `save` wrote to the constructor of a `RigorousSpectrum`; errors as in `RigorousSpectrum.load`."""
    path = Path(path)
    header, channels = read(path, FORMAT, FORMAT_VERSION, recipe)
    try:
        (period,), wavelengths = header["period"], tuple(float(x) for x in header["wavelengths"])
        axes = Axes(float(period), wavelengths, header["steps"], header["planes"])
        sheet = np.stack([channels[_channel(k)].pixels for k in range(axes.planes)])
        squares, top = [], 0
        for m in axes.orders:
            side = axes.side(m)
            squares.append(sheet[:, top : top + side, :side].reshape(axes.planes, side**2))
            top += side
        mueller = None
        if header["polarised"]:
            flat = sheet[:, top:].reshape(axes.planes, -1)[:, : 16 * axes.nodes]
            mueller = np.ascontiguousarray(flat.reshape(axes.planes, axes.nodes, 4, 4))
        return construct(
            axes=axes,
            mueller=mueller,
            values=np.ascontiguousarray(np.concatenate(squares, axis=1)),
            int_ior=complex(*(float(x) for x in header["intIor"])),
            harmonics=header["harmonics"],
            **{name: float(header[_camel(name)][0]) for name in _NUMBERS},
            **{name: header[_camel(name)] for name in _TEXTS},
        )
    except KeyError as error:
        raise RequestError(f"{path}: a damaged spectrum, {error} is missing") from None
    except (TypeError, ValueError, IndexError) as error:
        raise RequestError(f"{path}: a damaged spectrum ({one_line(error)})") from None


def _channel(plane: int) -> str:
    return f"eta({plane:02d})"


def _camel(name: str) -> str:
    first, *others = name.split("_")
    return first + "".join(word.capitalize() for word in others)
