"""A spectrum from its file, of scalar or of rigorous theory."""

from __future__ import annotations

import os

from ..rigorous import spectrum as rigorous_file
from ..rigorous.spectrum import RigorousSpectrum
from .grating_spectrum import GratingSpectrum

Spectrum = GratingSpectrum | RigorousSpectrum

_HEADER = 2**16  # bytes, in which the format is told


def load_spectrum(path: str | os.PathLike[str], recipe: str | None = None) -> Spectrum:
    """Read a spectrum that `save` wrote.

    Args:
        path: the file.
        recipe: the digest of the recipe from which it must have been built.

    Raises:
        FileNotFoundError: if there is no such file.
        ValueError: if it is not a spectrum, is damaged, of another version, or was not built from that recipe.
    """
    rigorous = False
    if os.path.isfile(path):
        with open(path, "rb") as stream:
            rigorous = rigorous_file.FORMAT.encode() in stream.read(_HEADER)
    return (RigorousSpectrum if rigorous else GratingSpectrum).load(path, recipe)
