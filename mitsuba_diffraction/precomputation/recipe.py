"""A recipe: a surface and the parameters of its spectrum, in a TOML file.

[surface]                        # an analytic profile …
profile = "blazed"               # a name in gratings.PROFILES, followed by its parameters
period = 2.5                     # µm
depth = 0.25                     # µm
patches = 16                     # of a profile with a seed: number of seeds to average, from `seed` on

[surface]                        # … or a scan
scan = "skin.png"                # relative to the recipe; formats: readers.read_height_field
pixel_size = 0.0586              # µm, one number or [x, y]; needed if the file has none, else overrides it
height_range = 0.375             # µm, for integer images
channel = "Height"               # name or number, in a file with several; default: the heights
unit = "nm"                      # of a file without one; ["um", "nm"]: lateral, and of the heights of any file
prepare = [                      # steps of surface/prepare.py, in this order
    "level_plane",               # or "level_quadratic"
    "align_lines",               # remove offsets between rows
    { despike = 5.0 },           # remove outliers by more than this many standard deviations of the noise
    { mask_outliers = 2.25 },    # dust and pits become missing pixels; see prepare.mask_outliers
    "fill_missing",              # here, or with fill_missing = true after the last step
    { trim_edges = 0.5 },        # µm off each edge
    { rotate = -3.0 },           # degrees from +x towards +y
    { crop_periods = "xy" },     # to a whole number of periods along "x", "y" or both
]
fill_missing = true              # interpolate missing pixels; default: refuse them

[spectrum]                       # the parameters of settings.py, all optional
extent = "tile"
wavelengths = [360.0, 830.0]     # nm

On the command line, the same names follow the name of a profile, a recipe or a scan (surface_text.py).
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
from contextlib import AbstractContextManager, suppress
from dataclasses import dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

from ..errors import RequestError, check_whole, did_you_mean
from ..files.reading import check_file, read_bytes
from ..files.writing import cache_folder, examples_folder
from ..optics.media import index_files
from ..progress import Progress, no_progress, part, silent, stage
from ..settings import SPECTRUM_PARAMETERS, ScalarSettings, Settings
from ..surface.gratings import COHERENCE_LENGTHS, PATCHES, PROFILES, profile_name
from ..surface.heightfield import HeightField
from ..surface.prepare import apply_steps, check_steps
from ..surface.readers import read_height_field
from .grating_spectrum import SCALAR_FORMAT_VERSION, GratingSpectrum
from .spectra import Spectrum, build_spectrum, build_versions, is_rigorous, load_spectrum

if sys.version_info >= (3, 11):
    import tomllib
else:
    import tomli as tomllib

SCAN_KEYS = ("pixel_size", "height_range", "fill_missing", "channel", "unit", "prepare")
FLAGS = ("fill_missing", "polarised")  # true or false
REQUESTED = "representation", "terms", "heights_from", "tolerance"  # of a spectrum; they may override a recipe's
_OF_PROFILE = "coherence_length", "largest_height_range", *REQUESTED
MAX_RECIPE_BYTES = 2**14  # one of a kilobyte is long; the time and memory of a TOML parser are quadratic in a key
MAX_PATCHES = 1000  # of which the mean has three per cent of the speckle of one patch
# Incremented when the same input gives a different result, to invalidate the cache.
_BUILD_VERSION = 12
# Spectra in the package (tools/data/ready_spectra.py), named as in the cache.
READY_SPECTRA = Path(__file__).parents[1] / "data" / "spectra"
_HEIGHTS_TIME_FRACTION = 0.5  # of the build, spent on the heights of several patches: 0.1 for ridges, 0.9 for skins
# Mitsuba constructs plugins in parallel; only one of those with the same recipe may compute its spectrum.
_building = threading.Lock()
# Spectra in use, by the digest of their recipe, so that all BSDFs of one recipe read its file once.
_in_use: weakref.WeakValueDictionary[str, Spectrum] = weakref.WeakValueDictionary()


class CacheWarning(UserWarning):
    """Spectra cannot be cached and are recomputed each time."""


def parameters_of_profile(name: str) -> tuple[str, ...]:
    """Return the names of the parameters of a profile and of its spectrum, as in a scene."""
    return (*inspect.signature(PROFILES[name]).parameters, "patches", *_OF_PROFILE)


def source_named(name: str) -> str:
    """Return the name of a profile or of a file as it is, and for the name of a recipe in the package its path.

    Raises:
        RequestError: if the name has no suffix, and there is no such file, profile or recipe.
    """
    if name in PROFILES or Path(name).suffix or os.path.isfile(name):
        return name
    recipes = {path.stem: path for path in sorted((examples_folder() / "precompute").glob("*.toml"))}
    if name not in recipes:
        similar = did_you_mean(name, [*PROFILES, *recipes])
        wanted = similar or f", wanted {', '.join(dict.fromkeys([*PROFILES, *recipes]))}, or a file"
        raise RequestError(f"{name}: no file and no surface has this name{wanted}")
    return str(recipes[name])


def kind_of(source: str | os.PathLike[str]) -> str:
    """Return what a source of a surface is, by its name: "profile", "recipe", "spectrum" or "scan"."""
    if str(source) in PROFILES:
        return "profile"
    return {".toml": "recipe", ".exr": "spectrum"}.get(Path(source).suffix.lower(), "scan")


@dataclass(frozen=True)
class Recipe:
    """A surface and the parameters of its spectrum.

    Attributes:
        surface: name and parameters of a profile, or a scan with its scale; see the docstring of this module.
        settings: the parameters of its spectrum.
        folder: base of relative file names.

    Raises:
        ValueError: if something is missing, unknown or contradictory.
    """

    surface: Mapping[str, Any]
    settings: Settings = field(default_factory=ScalarSettings)
    folder: Path = Path()

    def __post_init__(self) -> None:
        plain = dict(self.surface)
        if ("profile" in self.surface) == ("scan" in self.surface):
            got = ", ".join(sorted(self.surface)) or "nothing"
            raise RequestError(f"[surface]: got {got}, wanted either a profile or a scan")
        if "profile" in self.surface:
            object.__setattr__(self, "surface", {**self.surface, "profile": profile_name(self.surface["profile"])})
        if "profile" in self.surface and "patches" in self.surface:
            patches = self.surface["patches"]
            check_whole("patches", patches, 1, MAX_PATCHES)
            if "seed" not in inspect.signature(PROFILES[self.surface["profile"]]).parameters:
                raise RequestError(
                    f"patches: got {patches!r} of the profile {self.surface['profile']!r}, wanted a profile with a seed"
                )
        if "scan" in self.surface:
            _refuse_unknown("[surface]", self.surface, frozenset({"scan", *SCAN_KEYS}))
            if not isinstance(self.surface["scan"], str):
                raise RequestError(f"scan: got {self.surface['scan']!r}, wanted a file name")
            check_steps(plain.pop("prepare", []))
        _refuse_other_values(plain)

    @classmethod
    def of_profile(cls, name: str, parameters: Mapping[str, Any], **settings: Any) -> Recipe:
        """Return the recipe of a profile, from the parameters that a scene may give; others are ignored.

        See `parameters_of_profile`.

        Args:
            name: of the profile.
            parameters: of the profile and its spectrum.
            settings: further ones of the spectrum.

        Raises:
            ValueError: if a value is wrong, or there is no such profile.
        """
        name = profile_name(name)
        given = {key: parameters[key] for key in parameters_of_profile(name) if key in parameters}
        default = {"coherence_length": COHERENCE_LENGTHS[name]} if name in COHERENCE_LENGTHS else {}
        of_spectrum = {key: given.pop(key) for key in _OF_PROFILE if key in given}
        return cls({"profile": name, **given}, Settings.of(**{**default, **of_spectrum, **settings}))

    def as_sample(self) -> Recipe:
        """Return the recipe with extent "sample"; its heights are not read again."""
        assert isinstance(self.settings, ScalarSettings)
        sample = replace(self, settings=replace(self.settings, extent="sample"))
        sample.__dict__["_height_field"] = self.height_field()
        return sample

    @property
    def value_names(self) -> tuple[str, ...]:
        """The names of the values that a recipe of such a surface may have, but for `scan` and `profile`."""
        is_scan = "scan" in self.surface
        own = SCAN_KEYS if is_scan else (*inspect.signature(PROFILES[self.surface["profile"]]).parameters, "patches")
        return (*own, *SPECTRUM_PARAMETERS)

    @classmethod
    def load(cls, path: str | os.PathLike[str], **settings: Any) -> Recipe:
        """Read a recipe; `settings`, by their names, override its own under `[spectrum]`.

        Raises:
            FileNotFoundError: if there is no such file.
            ValueError: if it is not TOML, or not a recipe.
        """
        path = Path(path)
        check_file(path, MAX_RECIPE_BYTES)
        try:
            # Windows' Notepad begins a file with a mark of its byte order.
            content = tomllib.loads(path.read_text(encoding="utf-8-sig"))
        # Syntax or encoding errors; numbers of too many digits; deeply nested brackets.
        except (ValueError, RecursionError) as error:
            raise RequestError(f"{path}: not a TOML file ({error})") from None
        try:
            _refuse_unknown("recipe", content, frozenset({"surface", "spectrum"}))
            surface, spectrum = content.get("surface", {}), content.get("spectrum", {})
            if not (isinstance(surface, dict) and isinstance(spectrum, dict)):
                raise RequestError("wanted the tables [surface] and [spectrum]")
            # Files are named relative to the recipe, wherever the process goes.
            folder = path.parent.absolute()
            spectrum |= {name: str(folder / file) for name, file in index_files(spectrum).items()} | settings
            _refuse_unknown("[spectrum]", spectrum, frozenset(SPECTRUM_PARAMETERS))
            _refuse_other_values(spectrum)
            return cls(surface, Settings.of(**spectrum), folder)
        except RequestError as error:
            in_file = str(error).partition(":")[0] not in settings
            raise RequestError(f"{path}: {error}" if in_file else str(error)) from None

    @property
    def files(self) -> list[Path]:
        """The files that the recipe names, if any: its scan, and the file of an index."""
        scans = [self.folder / self.surface["scan"]] if "scan" in self.surface else []
        return scans + list(index_files(self.settings.chosen).values())

    @property
    def patches(self) -> int:
        """The number of seeds over which the spectrum is averaged; 1 for a sample and for a deterministic surface."""
        if "patches" in self.surface:
            return int(self.surface["patches"])
        return PATCHES.get(self.surface.get("profile", ""), 1) if self.settings.extent == "tile" else 1

    def height_fields(self, progress: Progress = silent) -> tuple[HeightField, ...]:
        """Return the patches of seed, seed + 1, …; one for a deterministic surface."""
        if self.patches == 1:
            return (self.height_field(),)
        patches = [self.height_field()]  # raises for an invalid seed
        for seed in range(self.surface.get("seed", 0) + 1, self.surface.get("seed", 0) + self.patches):
            patches.append(Recipe({**self.surface, "patches": 1, "seed": seed}).height_field())
            progress(len(patches), self.patches)
        return tuple(patches)

    def height_field(self) -> HeightField:
        """Return the surface, read or computed at the first call; the first one if there are several patches."""
        with stage("heights"):
            return self._height_field

    @cached_property
    def _height_field(self) -> HeightField:
        parameters = dict(self.surface)
        if "scan" in parameters:
            return self._prepared_scan(parameters)
        name = parameters.pop("profile")
        parameters.pop("patches", None)
        signature = inspect.signature(PROFILES[name])
        _refuse_unknown(f"profile {name!r}", parameters, frozenset(signature.parameters))
        try:
            signature.bind(**parameters)
        except TypeError as error:
            raise RequestError(f"profile {name!r}: {error}") from None
        return PROFILES[name](**parameters)

    def _prepared_scan(self, parameters: dict[str, Any]) -> HeightField:
        path = self.folder / parameters.pop("scan")
        steps, fill = parameters.pop("prepare", []), parameters.pop("fill_missing", False)
        if not steps:
            return read_height_field(path, fill_missing=fill, **parameters)
        scan = read_height_field(path, keep_missing=True, **parameters)
        try:
            ready = apply_steps(scan, steps)
            return HeightField(ready.heights, ready.pixel_size, ready.source, fill_missing=fill, filled=ready.filled)
        except RequestError as error:
            raise RequestError(f"{path}: {error}") from None

    def summary(self) -> str:
        """Return what the surface is, its size and its depth."""
        field = self.height_field()
        size = " × ".join(f"{length:.4g}" for length in field.tile_size[: 2 if field.shape[0] > 1 else 1])
        kind = "tile of" if "scan" in self.surface else "period"
        if self.settings.extent == "sample":
            kind = "sample of an irregular surface,"
        if self.patches > 1:
            kind = f"{self.patches} random patches of"
        return f"{kind} {size} µm, {field.height_range:.3g} µm deep"

    def check(self) -> None:
        """Read or compute the surface, which checks its values, unless its spectrum is in the package or the cache.

        Raises:
            ValueError: if the profile, or the scan, is wrong.
        """
        name = f"{self.digest()}.exr"
        if not any((folder / name).is_file() for folder in (READY_SPECTRA, cache_folder())):
            self.height_field()

    def build(self, progress: Progress = silent) -> Spectrum:
        """Compute the spectrum; `progress` is called with (steps done, steps in all)."""
        patches = self.height_fields(part(progress, 0, _HEIGHTS_TIME_FRACTION))
        report = part(progress, _HEIGHTS_TIME_FRACTION if len(patches) > 1 else 0, 1)
        return build_spectrum(patches, self.settings, report, keep_waves=True)

    def digest(self) -> str:
        """Return the SHA-256 of everything that determines the spectrum: the recipe and the contents of the scan."""
        versions = [SCALAR_FORMAT_VERSION, _BUILD_VERSION, *build_versions(self.settings)]
        content = hashlib.sha256(".".join(map(str, versions)).encode())
        surface = {name: value for name, value in self.surface.items() if name not in ("scan", "patches")}
        if "profile" in surface:
            parameters = inspect.signature(PROFILES[surface["profile"]]).parameters.items()
            surface = {name: p.default for name, p in parameters if p.default is not p.empty} | surface
        for scan in self.files:
            content.update(read_bytes(scan))
            content.update(scan.suffix.lower().encode())
        settings = self.settings.chosen
        settings |= {name: file.name for name, file in index_files(settings).items()}
        # By values: 1200 and 1200.0 are one number.
        surface, settings = json.loads(json.dumps((surface, settings), default=str), parse_int=float)
        request = surface, self.patches, settings
        content.update(json.dumps(request, sort_keys=True, default=str).encode())
        return content.hexdigest()

    def cached(self, progress: Callable[[str], AbstractContextManager[Progress]] = no_progress) -> Spectrum:
        """Return the spectrum from the package or the cache, or compute and cache it, within progress(label).

        The cache is a folder of spectra named by `digest`: $MITSUBA_DIFFRACTION_CACHE, or the user's cache folder. A
        damaged entry, or one of another recipe, is replaced.

        Warns:
            CacheWarning: if the spectrum cannot be cached.
        """
        with _building:
            digest = self.digest()
            spectrum = _in_use.get(digest)
            if spectrum is None:
                spectrum = _in_use[digest] = self._from_cache(digest, progress)
            return spectrum

    def _from_cache(self, digest: str, progress: Callable[[str], AbstractContextManager[Progress]]) -> Spectrum:
        path = cache_folder() / f"{digest}.exr"
        for known in (READY_SPECTRA / path.name, path):
            with suppress(RequestError, OSError):
                return load_spectrum(known, recipe=digest)
        with progress(f"spectrum of {self.surface.get('scan') or self.surface['profile']}") as report:
            spectrum = self.build(report)
        # A scene keeps its recipes, but no longer needs their heights.
        self.__dict__.pop("_height_field", None)
        if isinstance(spectrum, GratingSpectrum):
            spectrum = replace(spectrum, cache=(path, digest))
        try:
            path.parent.mkdir(parents=True, exist_ok=True)
            spectrum.save(path, recipe=digest)
        except (RequestError, OSError, RuntimeError) as error:  # RuntimeError is what OpenEXR raises on a full disk
            # A text: the exception would tie this frame, and the spectrum in it, into a cycle.
            reason = getattr(error, "strerror", None) or str(error)
            warnings.warn(
                f"the cache {path.parent} cannot be written to ({reason}); spectra are recomputed each time",
                CacheWarning,
                stacklevel=1,
            )
        return spectrum


def theory_in(path: Path) -> str:
    """Return the theory of a recipe, or of a saved spectrum."""
    if kind_of(path) == "recipe":
        return Recipe.load(path).settings.theory
    return "rigorous" if is_rigorous(path) else "scalar"


def _refuse_unknown(where: str, table: Mapping[str, Any], known: frozenset[str]) -> None:
    if unknown := sorted(set(table) - known):
        similar = did_you_mean(unknown[0], known)
        raise RequestError(
            f"{where}: got the unknown name {', '.join(unknown)}, wanted among {', '.join(sorted(known))}{similar}"
        )


def _refuse_other_values(table: Mapping[str, Any]) -> None:
    for name, value in table.items():
        if isinstance(value, bool) and name not in FLAGS:
            raise RequestError(f"{name}: got {value!r}, wanted a number or a text")
        if not (_is_plain(value) or (isinstance(value, list | tuple) and all(_is_plain(v) for v in value))):
            raise RequestError(f"{name}: got {value!r}, wanted a number, a text, or a list of them")


def _is_plain(value: object) -> bool:
    # TOML integers have 64 bits; Python also parses larger ones, which overflow a float.
    return isinstance(value, float | str) or (isinstance(value, int) and -(2**63) <= value < 2**63)
