"""A recipe: which surface, and how its spectrum is built, in a TOML file.

[surface]                        # a profile by formula …
profile = "blazed"               # a name of gratings.PROFILES, its parameters beside it
period = 2.5                     # µm
depth = 0.25                     # µm

[surface]                        # … or a scan
scan = "skin.png"                # relative to the recipe; formats: readers.read_height_field
pixel_size = 0.0586              # µm, one number or [x, y]; where the file has none, or to overrule it
height_range = 0.375             # µm, for integer images
channel = "Height"               # a name or a number, of a file with several; without it, the one of heights
unit = "nm"                      # of a file that names none; ["um", "nm"]: along the surface, and of the heights
prepare = [                      # steps of surface/prepare.py, done in this order
    "level_plane",               # or "level_quadratic"
    "align_lines",               # bring the rows to one level
    { despike = 5.0 },           # spikes beyond so many standard deviations of the noise
    "fill_missing",              # here; or, with fill_missing = true, after the last step
    { trim_edges = 0.5 },        # µm off each edge
    { rotate = -3.0 },           # degrees from +x towards +y
    { crop_periods = "xy" },     # to whole periods along "x", "y" or both
]
fill_missing = true              # pixels without a height are filled from their surroundings; without it, refused

[spectrum]                       # every line may be left out
extent = "tile"
coherence_length = 65.0          # µm
wavelengths = [360.0, 830.0]     # nm
largest_angle = 90.0             # degrees from the normal
representation = "auto"
tolerance = 1e-3
largest_height_range = 20.0      # µm; deeper surfaces are refused
theory = "scalar"                # or "rigorous", of one row and of one material:
material = "Al"                  # a conductor by Mitsuba's name,
int_ior = 1.5                    # or an index of refraction
"""

from __future__ import annotations

import hashlib
import inspect
import json
import os
import sys
import threading
import warnings
import weakref
from collections.abc import Callable, Mapping
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from .files import cache_folder, refuse_special
from .rigorous.spectrum import RigorousSpectrum
from .spectrum import GratingSpectrum
from .spectrum.build import precompute
from .spectrum.file import FORMAT_VERSION
from .spectrum.load import load_spectrum
from .surface.gratings import PROFILES
from .surface.heightfield import HeightField
from .surface.prepare import apply_steps, check_steps
from .surface.readers import read_height_field

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

Spectrum = GratingSpectrum | RigorousSpectrum

_SCAN_KEYS = frozenset({"scan", "pixel_size", "height_range", "fill_missing", "channel", "unit", "prepare"})
_SPECTRUM_KEYS = frozenset(
    {
        *("extent", "coherence_length", "wavelengths", "largest_angle", "representation", "tolerance"),
        *("largest_height_range", "theory", "material", "int_ior"),
    }
)
# Raised when the same input gives other numbers than before, so that the cache is not read.
_BUILD_VERSION = 4
# Mitsuba constructs plugins on several threads; two that name one recipe must not build it twice.
_building = threading.Lock()
# Spectra in use, by the digest of their recipe: a scene with many instances reads the file once.
_in_use: weakref.WeakValueDictionary[str, Spectrum] = weakref.WeakValueDictionary()


class CacheWarning(UserWarning):
    """Spectra cannot be kept in the cache: they are built anew each time."""


@dataclass(frozen=True)
class Recipe:
    """A surface and the way to its spectrum.

    Attributes:
        surface: a profile's name and parameters, or a scan with its scale; see the head of this file.
        spectrum: arguments of `precompute`.
        folder: where relative file names start.

    Raises:
        ValueError: if something is missing, unknown or contradictory.
    """

    surface: Mapping[str, Any]
    spectrum: Mapping[str, Any] = field(default_factory=dict)
    folder: Path = Path()

    def __post_init__(self) -> None:
        if ("profile" in self.surface) == ("scan" in self.surface):
            raise ValueError(f"[surface]: got {_names(self.surface)}, wanted either a profile or a scan")
        if "profile" in self.surface and self.surface["profile"] not in tuple(PROFILES):
            raise ValueError(f"profile: got {self.surface['profile']!r}, wanted one of {', '.join(PROFILES)}")
        if "scan" in self.surface:
            _refuse_unknown("[surface]", self.surface, _SCAN_KEYS)
            if not isinstance(self.surface["scan"], str):
                raise ValueError(f"scan: got {self.surface['scan']!r}, wanted a file name")
            check_steps(self.surface.get("prepare", []))
        _refuse_unknown("[spectrum]", self.spectrum, _SPECTRUM_KEYS)
        for name, value in [*self.surface.items(), *self.spectrum.items()]:
            if name == "prepare" and "scan" in self.surface:
                continue  # checked above
            if isinstance(value, bool) and name != "fill_missing":
                raise ValueError(f"{name}: got {value!r}, wanted a number or a text")
            if not (_is_plain(value) or (isinstance(value, list | tuple) and all(_is_plain(v) for v in value))):
                raise ValueError(f"{name}: got {value!r}, wanted a number, a text, or a list of them")
        for name in ("tolerance", "coherence_length", "largest_angle", "largest_height_range", "int_ior"):
            if name in self.spectrum and not _is_number(self.spectrum[name]):
                raise ValueError(f"{name}: got {self.spectrum[name]!r}, wanted a number")
        if "wavelengths" in self.spectrum and not isinstance(self.spectrum["wavelengths"], list | tuple):
            raise ValueError(f"wavelengths: got {self.spectrum['wavelengths']!r}, wanted [shortest, longest] in nm")

    @classmethod
    def load(cls, path: str | os.PathLike[str]) -> Recipe:
        """Read a recipe.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is not TOML, or not a recipe.
        """
        path = Path(path)
        refuse_special(path)
        try:
            with open(path, "rb") as file:
                content = tomllib.load(file)
        except FileNotFoundError:
            raise FileNotFoundError(f"{path}: no such file") from None
        # Of the parser and of the text; a number of too many digits; brackets in brackets in brackets.
        except (ValueError, RecursionError) as error:
            raise ValueError(f"{path}: not a TOML file ({error})") from None
        try:
            _refuse_unknown("recipe", content, frozenset({"surface", "spectrum"}))
            surface, spectrum = content.get("surface", {}), content.get("spectrum", {})
            if not (isinstance(surface, dict) and isinstance(spectrum, dict)):
                raise ValueError("wanted the tables [surface] and [spectrum]")
            return cls(surface, spectrum, path.parent)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def height_field(self) -> HeightField:
        """The surface."""
        parameters = dict(self.surface)
        if "scan" in parameters:
            return self._prepared_scan(parameters)
        name = parameters.pop("profile")
        try:
            return PROFILES[name](**parameters)
        except TypeError as error:
            known = inspect.signature(PROFILES[name]).parameters
            unknown = sorted(set(parameters) - set(known))
            # The text alone: a local name of the exception would tie it and all its frames into a cycle.
            wrong = (
                f"got the unknown name {', '.join(unknown)}, wanted among {', '.join(known)}" if unknown else str(error)
            )
            raise ValueError(f"profile {name!r}: {wrong}") from None

    def _prepared_scan(self, parameters: dict[str, Any]) -> HeightField:
        path = self.folder / parameters.pop("scan")
        steps, fill = parameters.pop("prepare", []), parameters.pop("fill_missing", False)
        for name in ("pixel_size", "unit"):
            if isinstance(parameters.get(name), list):
                parameters[name] = tuple(parameters[name])
        if not steps:
            return read_height_field(path, fill_missing=fill, **parameters)
        scan = read_height_field(path, keep_missing=True, **parameters)
        try:
            ready = apply_steps(scan, steps)
            return HeightField(ready.heights, ready.pixel_size, ready.source, fill_missing=fill)
        except ValueError as error:
            raise ValueError(f"{path}: {error}") from None

    def build(self, progress: Callable[[int, int], None] | None = None) -> Spectrum:
        """The spectrum, computed."""
        arguments = dict(self.spectrum)
        if "wavelengths" in arguments:
            arguments["wavelengths"] = tuple(arguments["wavelengths"])
        return precompute(self.height_field(), progress=progress, **arguments)

    def digest(self) -> str:
        """SHA-256 of everything that the spectrum depends on: the recipe's words and the scan's bytes."""
        content = hashlib.sha256(f"{FORMAT_VERSION}.{_BUILD_VERSION}".encode())
        surface = dict(self.surface)
        if "scan" in surface:
            scan = self.folder / surface.pop("scan")
            refuse_special(scan)
            try:
                content.update(scan.read_bytes())
            except FileNotFoundError:
                raise FileNotFoundError(f"{scan}: no such file") from None
            content.update(scan.suffix.lower().encode())
        content.update(json.dumps([surface, dict(self.spectrum)], sort_keys=True).encode())
        return content.hexdigest()

    def cached(self, progress: Callable[[int, int], None] | None = None) -> Spectrum:
        """The spectrum from the cache, or built and put there.

        The cache is a folder of spectra named by `digest`: $MITSUBA_DIFFRACTION_CACHE, or the user's cache folder. An
        entry that is damaged, or of another recipe, is replaced.

        Warns:
            CacheWarning: if the spectrum cannot be kept.
        """
        with _building:
            digest = self.digest()
            spectrum = _in_use.get(digest)
            if spectrum is None:
                spectrum = _in_use[digest] = self._from_cache(digest, progress)
            return spectrum

    def _from_cache(self, digest: str, progress: Callable[[int, int], None] | None) -> Spectrum:
        path = cache_folder() / f"{digest}.exr"
        with suppress(ValueError, OSError):
            return load_spectrum(path, recipe=digest)
        spectrum = self.build(progress)
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            spectrum.save(path, recipe=digest)
        except (ValueError, OSError, RuntimeError) as error:  # RuntimeError is what OpenEXR raises on a full disk
            reason = getattr(error, "strerror", None) or error
            warnings.warn(
                f"the cache {path.parent} cannot be written to ({reason}); spectra are built anew each time",
                CacheWarning,
                stacklevel=1,
            )
        return spectrum


def _refuse_unknown(where: str, table: Mapping[str, Any], known: frozenset[str]) -> None:
    if unknown := sorted(set(table) - known):
        raise ValueError(f"{where}: got the unknown name {', '.join(unknown)}, wanted among {', '.join(sorted(known))}")


def _is_number(value: object) -> bool:
    return isinstance(value, int | float) and not isinstance(value, bool)


def _is_plain(value: object) -> bool:
    # TOML's integers have 64 bits; Python reads greater ones, too, which no float holds.
    return isinstance(value, float | str) or (isinstance(value, int) and -(2**63) <= value < 2**63)


def _names(table: Mapping[str, Any]) -> str:
    return ", ".join(sorted(table)) or "nothing"
