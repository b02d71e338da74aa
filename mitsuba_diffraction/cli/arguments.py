"""Arguments shared by several commands: of scenes, of outputs, of scans and of the equivalent recipes."""

from __future__ import annotations

import functools
import inspect
import os
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import Annotated, Any

import numpy as np
import typer
from numpy.typing import NDArray

from ..errors import RequestError, did_you_mean, is_number
from ..files.writing import refuse_other_than_utf8
from ..precomputation.recipe import Recipe, parameters_of_profile, source_named
from ..progress import say
from ..settings import SPECTRUM_PARAMETERS, SUN_COHERENCE_LENGTH, Settings
from ..surface.gratings import PROFILES, RENAMED
from ..surface.prepare import STEP_NAMES, step_of

_MAX_VALUES = 10_000  # of a range first:last:step
Value = bool | int | float | str


def scene_parameters(define: Sequence[str] | None) -> dict[str, str]:
    """Return the scene parameters from the options -D NAME=VALUE."""
    parameters = {}
    for item in define or []:
        name, equals, value = item.partition("=")
        if not (name and equals):
            raise RequestError(f"-D: got {item!r}, wanted NAME=VALUE")
        refuse_other_than_utf8(item)
        if name in parameters:
            raise RequestError(f"-D {name}: got it twice, wanted one value")
        parameters[name] = _absolute(value)
    return parameters


def _absolute(value: str) -> str:
    """Return a file name on the command line, relative to the current folder, as an absolute one; other text as it is.

    A bare word or number is not a file name, even if a file of that name exists.
    """
    is_file = os.path.isfile(value) and (os.path.dirname(value) or Path(value).suffix[1:2].isalpha())
    return str(Path(value).resolve()) if is_file else value


Define = Annotated[list[str] | None, typer.Option("-D", metavar="NAME=VALUE", help="set a parameter of the scene")]
Overwrite = Annotated[bool, typer.Option("--overwrite", help="replace files of other programs, too, but never inputs")]
Variant = Annotated[str | None, typer.Option(help="Mitsuba variant; default: the fastest spectral one")]


@contextmanager
def named_as_options(names: Mapping[str, str]) -> Iterator[None]:
    """Name the options of the command line, not the parameters of Python, where a message begins with one of these."""
    try:
        yield
    except RequestError as error:
        name, colon, rest = str(error).partition(":")
        raise RequestError(names.get(name, name) + colon + rest) from error.__cause__


def check_suffix(option: str, path: Path, *suffixes: str) -> None:
    """Raise RequestError unless the name of an output ends in one of the suffixes."""
    if path.suffix.lower() not in suffixes:
        wanted = " or ".join(filter(None, [", ".join(suffixes[:-1]), suffixes[-1]]))
        raise RequestError(f"{option}: got {path}, wanted a file name that ends in {wanted}")


def surface_of(text: str) -> tuple[str, dict[str, Value]]:
    """Return source, as `source_named`, and parameters from SURFACE[,name=value…]; numbers and booleans converted."""
    source, *items = text.split(",")
    values: dict[str, Value] = {}
    for name, equals, value in (item.strip().partition("=") for item in items):
        if not (name and equals and value) or name in values:
            got = f"{text}: got {name + equals + value!r}"
            raise RequestError(f"{got}, wanted name=value, each name once{_no_lists(name)}")
        values[name] = converted(value)
    if source in RENAMED:
        say("note", f"{source} is the measured skin; {RENAMED[source]} is a synthetic one")
    return source_named(source), values


def _no_lists(name: str) -> str:
    """Return what to do if a part of SURFACE is the end of a list or of a number with a decimal comma, or ""."""
    return "; a number has a point, and a list of films stands in a scene" if is_number(converted(name)) else ""


def is_scan(source: str) -> bool:
    """Return whether a source is a scan, not a recipe (.toml), a saved spectrum (.exr) or a profile."""
    path = Path(source)
    is_file = bool(path.suffix) or path.is_file()
    return is_file and source not in PROFILES and path.suffix.lower() not in (".toml", ".exr")


def parse_numbers(option: str, text: str) -> NDArray[np.float64]:
    """Return the numbers in "30", "0,30,60" or "0:60:5" (60 included), (n,), at most 10,000."""
    try:
        if ":" not in text:
            return np.array([float(part) for part in text.split(",")])
        first, last, step = (float(part) for part in text.split(":"))
        count = (last - first) / step
        if not 0 <= count < _MAX_VALUES:
            raise ValueError
        return first + step * np.arange(int(count + 1e-9) + 1, dtype=np.float64)
    except (ValueError, ZeroDivisionError):
        raise RequestError(f"{option}: got {text!r}, wanted a number, numbers as 0,30,60, or first:last:step") from None


def angles_of(option: str, text: str) -> NDArray[np.float64]:
    """Return angles from the normal in degrees, (n,), given as in `parse_numbers`."""
    found = parse_numbers(option, text)
    if (wrong := found[~(np.abs(found) < 90)]).size:
        raise RequestError(f"{option}: got {wrong[0]:g}, wanted degrees above −90 and below 90")
    return found


def converted(text: str) -> Value:
    """Return a number, true or false, the absolute path of a file that exists, or the text."""
    for kind in (int, float):
        with suppress(ValueError):
            return kind(text)
    return {"true": True, "false": False}.get(text, _absolute(text))


def materials_of(texts: Sequence[str] | None) -> dict[str, dict[str, Value]]:
    """Return the parameters of the gratings that replace BSDFs, by id, from the options --material ID=…."""
    materials: dict[str, dict[str, Value]] = {}
    for text in texts or []:
        name, equals, rest = text.partition("=")
        if not (name and equals and rest.partition(",")[0]):
            raise RequestError(f"--material: got {text!r}, wanted ID=SURFACE[,name=value…]")
        source, values = surface_of(rest)
        if name in materials:
            raise RequestError(f"--material {name}: got it twice, wanted one grating")
        is_file = Path(source).suffix.lower() in (".toml", ".exr")
        if is_file and not os.path.isfile(source):
            raise FileNotFoundError(f"{source}: no such file")
        if is_film(source) and values.keys().isdisjoint(("transmission", "material", "coat_ior", "base")):
            values["transmission"] = "sheet"
            say("note", f"material {name}: {source} transmits light (transmission=sheet); transmission=none does not")
        # Absolute, as file names in a scene are relative to the folder of the scene.
        materials[name] = {**({"filename": os.path.abspath(source)} if is_file else {"profile": source}), **values}
    return materials


def is_film(source: str) -> bool:
    """Return whether a profile, or the profile of a recipe, is a transparent film."""
    profile = Recipe.load(source).surface.get("profile", "") if source.lower().endswith(".toml") else source
    return profile == "film" or profile.startswith("transmission_")


PixelSize = Annotated[float | None, typer.Option(help="pixel size of the scan, µm")]
HeightRange = Annotated[float | None, typer.Option(help="height difference of black and white, µm")]
_STEPS = f"apply a step, NAME or NAME=ARGUMENT, to the scan, in the given order: {', '.join(STEP_NAMES)}"
_COHERENCE_LENGTH = f"µm; default: that of the recipe, or of sunlight, {SUN_COHERENCE_LENGTH:g}"
SCAN_OPTIONS: dict[str, Any] = {
    "pixel_size": PixelSize,
    "height_range": HeightRange,
    "fill_missing": Annotated[bool, typer.Option("--fill-missing", help="interpolate missing pixels of the scan")],
    "channel": Annotated[str | None, typer.Option(help="channel of the scan, by name or number")],
    "unit": Annotated[
        list[str] | None,
        typer.Option(help="unit, for a scan without one; given twice: of lengths, then of heights, in any scan"),
    ],
    "prepare": Annotated[list[str] | None, typer.Option(help=_STEPS)],
    "extent": Annotated[
        str | None,
        typer.Option(help="tile (periodic) or sample (of an irregular surface); default: that of the recipe"),
    ],
    "coherence_length": Annotated[float | None, typer.Option(help=_COHERENCE_LENGTH)],
}


def takes_scan(command: Callable[..., None]) -> Callable[..., None]:
    """Give a command the options of a scan, which `options_of_scan` and `settings_of` read from the context."""
    own = list(inspect.signature(command, eval_str=True).parameters.values())
    keyword = inspect.Parameter.POSITIONAL_OR_KEYWORD
    added = [
        inspect.Parameter(name, keyword, default=False if name == "fill_missing" else None, annotation=annotation)
        for name, annotation in SCAN_OPTIONS.items()
    ]

    @functools.wraps(command)
    def run(**given: Any) -> None:
        command(**{parameter.name: given[parameter.name] for parameter in own})

    parameters = [*own[:-1], *added, own[-1]]  # the last is --overwrite
    run.__dict__["__signature__"] = inspect.Signature(parameters)
    run.__annotations__ = {parameter.name: parameter.annotation for parameter in parameters}
    return run


def options_of_scan(context: typer.Context) -> dict[str, object]:
    """Return the given options of a scan, under their names in recipes."""
    given = given_of(context, [name for name in SCAN_OPTIONS if name not in ("extent", "coherence_length")])
    if len(unit := given.get("unit", ())) == 1:
        given["unit"] = unit[0]
    steps = [*["level_plane"] * context.params.get("plane", False), *given.get("prepare", [])]
    return {**given, "prepare": [step_of(text) for text in steps]} if steps else given


def settings_of(context: typer.Context) -> dict[str, Any]:
    """Return the given options of the spectrum, by name."""
    given = given_of(context, SPECTRUM_PARAMETERS)
    return {name: converted(value) if name == "int_ior" else value for name, value in given.items()}


def given_of(context: typer.Context, names: Iterable[str]) -> dict[str, Any]:
    """Return the options of these names that were given, by name."""
    # Zero counts as given: it is checked where it is used.
    return {n: value for n in names if (value := context.params.get(n)) not in (None, ()) and value is not False}


def recipe_of(source: Path, of_scan: dict[str, Any], settings: dict[str, Any], extent: str = "sample") -> Recipe:
    """Return the recipe in a file, of a profile, or of a scan; `settings` override its own, and a scan's extent.

    Scans are samples by default, as they are rarely cut to whole periods.
    """
    if str(source) in PROFILES:
        if of_scan:
            raise RequestError(f"{source}: got {', '.join(of_scan)} of a profile, wanted them of a scan")
        return Recipe.of_profile(str(source), {}, **settings)
    if source.suffix.lower() != ".toml":
        return Recipe({"scan": source.name, **of_scan}, Settings.of(**{"extent": extent, **settings}), source.parent)
    if of_scan:
        names = ", ".join(f"--{name.replace('_', '-')}" for name in of_scan)
        raise RequestError(f"{names} go with a scan; the recipe {source} has its own")
    return Recipe.load(source, **settings)


def recipe_with(context: typer.Context, name: str, values: dict[str, Value]) -> Recipe | None:
    """Return the recipe of a scan, of a profile, or in a file, with values and options; None for a saved spectrum.

    Raises:
        RequestError: if there is no such value, or any with a saved spectrum (.exr).
    """
    of_scan, given = options_of_scan(context), settings_of(context)
    of_spectrum: dict[str, Any] = {key: given[key] for key in ("extent", "coherence_length") if key in given}
    if Path(name).suffix.lower() == ".exr":
        if options := ", ".join([*values, *of_scan, *of_spectrum]):
            raise RequestError(f"{name}: got {options} with a saved spectrum, wanted the recipe or the scan itself")
        return None
    if Path(name).suffix.lower() == ".toml":
        recipe = recipe_of(Path(name), of_scan, of_spectrum)
        return Recipe({**recipe.surface, **values}, recipe.settings, recipe.folder)
    if is_scan(name):
        recipe = recipe_of(Path(name), of_scan, of_spectrum)
        unknown, wanted = list(values), "the options of a scan, such as --pixel-size"
    else:
        recipe = Recipe.of_profile(name, values, **of_spectrum)
        known = parameters_of_profile(name)
        unknown, wanted = [*of_scan, *(key for key in values if key not in known)], f"some of {', '.join(known)}"
        wanted += did_you_mean(unknown[0], known) if unknown else ""
    if unknown:
        raise RequestError(f"{name}: got {', '.join(unknown)}, wanted {wanted}")
    return recipe
