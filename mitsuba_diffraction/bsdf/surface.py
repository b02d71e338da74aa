"""Which surface a scene names: a saved spectrum, a recipe, a profile by formula, or a spectrum from Python."""

from __future__ import annotations

import functools
import inspect
import weakref
from dataclasses import replace
from pathlib import Path

import mitsuba as mi

from ..errors import RequestError
from ..precomputation import Spectrum, load_spectrum
from ..progress import progress_bar
from ..recipe import Recipe
from ..rigorous.spectrum import RigorousSpectrum
from ..settings import THEORIES, VISIBLE, Settings, wavelengths_inside
from ..surface.gratings import COHERENCE_LENGTHS, PROFILES
from .media import Media
from .theory import check_transmission, refuse_scalar_only, settings_from, settings_of_medium

_per_cent = functools.partial(progress_bar, unit="%")
_PREFIX = "handed over: "
_OF_SPECTRUM = "representation", "terms", "heights_from", "tolerance"  # of a profile, or in the place of a recipe's own
_handed_over: weakref.WeakValueDictionary[str, Spectrum] = weakref.WeakValueDictionary()


def surface_from(props: mi.Properties, media: Media, scale: float = 1.0) -> tuple[Spectrum, Recipe | None]:
    """The spectrum that the parameters `filename`, `spectrum`, or `profile` with its own parameters name.

    Wavelengths are shorter inside a coat or a dielectric: what is built here is built for λ/n, and for the largest
    `scale` of lengths, as if wavelengths were shorter by it.

    Returns:
        The spectrum, and the recipe behind it. A saved spectrum has none: it does not say which heights it is of.

    Raises:
        ValueError: unless exactly one of them is given, or if what it names cannot be had.
    """
    given = [name for name in ("filename", "spectrum", "profile") if name in props]
    theory = props.get("theory", "scalar")
    if theory not in THEORIES:
        raise RequestError(f"theory: got {theory!r}, wanted one of {', '.join(THEORIES)}")
    if len(given) != 1:
        raise RequestError(
            f"surface: got {' and '.join(given) or 'nothing'}, wanted one of filename (a saved spectrum or a recipe), "
            f"profile ({', '.join(PROFILES)}) or, from Python, spectrum"
        )
    if given != ["profile"]:
        if given == ["spectrum"]:
            spectrum, recipe = _taken_over(props["spectrum"]), None
        else:
            spectrum, recipe = _from_file(props, media, scale)
        found = "rigorous" if isinstance(spectrum, RigorousSpectrum) else "scalar"
        if props.get("theory", found) != found:
            raise RequestError(f"theory: got {theory!r} with a spectrum of {found} theory, wanted one built for it")
        return spectrum, recipe
    name = props["profile"]
    if name not in PROFILES:
        raise RequestError(f"profile: got {name!r}, wanted one of {', '.join(PROFILES)}")
    known = inspect.signature(PROFILES[name]).parameters
    surface = {"profile": name, **{key: props[key] for key in (*known, "patches") if key in props}}
    settings = {"coherence_length": COHERENCE_LENGTHS[name]} if name in COHERENCE_LENGTHS else {}
    settings |= {key: props[key] for key in ("coherence_length", "largest_height_range", *_OF_SPECTRUM) if key in props}
    if theory == "rigorous":
        settings |= {"theory": theory, **settings_from(props, media.coat)}
    recipe = _inside(props, media, scale, Recipe(surface, Settings(**settings)))
    return recipe.cached(_per_cent), recipe


def _inside(props: mi.Properties, media: Media, scale: float, recipe: Recipe) -> Recipe:
    """Return the recipe for the wavelengths next to the relief, and, of rigorous theory, for the variant.

    A larger `scale` of lengths needs shorter ones, too. What the scene must not say is refused here, before a table is
    computed.
    """
    settings, inside = recipe.settings, {}
    wavelengths = wavelengths_inside(media.index, scale)
    if settings.theory == "rigorous":
        refuse_scalar_only(props)
        if settings.transmission != "none":
            check_transmission(settings.transmission, media)
        inside = settings_of_medium(media)
    # Rigorous tables of a bare surface are for the wavelengths above it.
    shorter = media.index * scale > 1 and (settings.theory == "scalar" or media.coat is not None)
    if shorter and settings.wavelengths == VISIBLE:
        inside["wavelengths"] = wavelengths
    return replace(recipe, settings=replace(settings, **inside))


def _from_file(props: mi.Properties, media: Media, scale: float) -> tuple[Spectrum, Recipe | None]:
    path = Path(str(mi.file_resolver().resolve(str(props["filename"]))))
    given = {name: props[name] for name in _OF_SPECTRUM if name in props}
    suffix = path.suffix.lower()
    if suffix in (".toml", ".exr") and not path.is_file():
        # What is not found stays relative; the folder of a scene is searched first.
        folder = Path(str(mi.file_resolver()[0])) / path.parent
        there = sorted(other.name for other in folder.glob("*") if other.suffix.lower() in (".exr", ".toml"))
        raise FileNotFoundError(f"{path}: no such file; {folder} holds {', '.join(there) or 'no spectrum'}")
    if suffix == ".toml":
        recipe = _inside(props, media, scale, Recipe.load(path, **given))
        return recipe.cached(_per_cent), recipe
    if suffix == ".exr":
        for name, value in given.items():
            raise RequestError(f"{name}: got {value} with {path}, wanted it when the spectrum is computed")
        return load_spectrum(path), None
    raise RequestError(
        f"filename: got {path}, wanted a saved spectrum (.exr) or a recipe (.toml); "
        "a scan is turned into a spectrum by `mitsuba-diffraction precompute`, or named by a recipe"
    )


def _taken_over(handle: str) -> Spectrum:
    spectrum = _handed_over.get(handle)
    if spectrum is None:
        raise RequestError(f"spectrum: got {handle!r}, wanted a spectrum in Python's load_dict; XML takes a filename")
    return spectrum


def hand_over(value: object) -> object:
    """A scene dictionary in which every spectrum is replaced by a handle.

    Mitsuba's load_dict accepts only types bound in C++, so an object of ours travels by name.
    """
    if isinstance(value, Spectrum):
        handle = f"{_PREFIX}{id(value)}"
        _handed_over[handle] = value
        return handle
    if isinstance(value, dict):
        return {key: hand_over(item) for key, item in value.items()}
    return value
