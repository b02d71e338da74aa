"""A surface as a command requests it: its source, values that replace those of a recipe, and whether it is a tile."""

from __future__ import annotations

from collections.abc import Callable, Collection, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, field
from functools import cached_property
from pathlib import Path
from typing import Any

from ..errors import RequestError, did_you_mean
from ..optics.media import Media, MediumBelow
from ..progress import Progress, no_progress, say
from ..settings import SPECTRUM_PARAMETERS, TRANSMISSIONS, ScalarSettings, Settings
from ..surface.heightfield import HeightField
from ..surface.prepare import repeats_without_seam
from .recipe import Recipe, kind_of, source_named
from .spectra import Spectrum, check_height_range, is_rigorous, load_spectrum
from .surface_text import parsed


@dataclass(frozen=True)
class RequestedSurface:
    """A surface that a command, a page or a scene requests.

    Attributes:
        title: the source as it was typed, for messages.
        source: the name of a profile, or a file; of a recipe of the package its path.
        values: by the names that a recipe has, under `[surface]` and `[spectrum]`.
        aside: values that a command uses itself, such as the medium below.
        names_aside: the names that may be among them.
    """

    title: str
    source: str
    values: Mapping[str, Any]
    aside: Mapping[str, Any] = field(default_factory=dict)
    names_aside: Collection[str] = ()

    @classmethod
    def of(cls, text: str, aside: Collection[str] = (), options: Mapping[str, Any] | None = None) -> RequestedSurface:
        """Return the surface of SURFACE[,name=value…].

        Args:
            text: as it was typed.
            aside: names of the values that a command uses itself.
            options: more values, which are options of the command; None where one was not given.

        Raises:
            RequestError: if it is not such a text, a value is given twice, or there is no such surface.
        """
        title, values = parsed(text)
        given = {name: value for name, value in (options or {}).items() if value is not None}
        if twice := values.keys() & given.keys():
            name = min(twice)
            raise RequestError(f"{name}: got {values[name]!r} and {given[name]!r}, wanted one value")
        return cls.named(title, values | given, aside)

    @classmethod
    def named(cls, name: str, values: Mapping[str, Any], aside: Collection[str] = ()) -> RequestedSurface:
        """Return the surface of a profile, a recipe of the package or a file; for arguments and errors see `of`."""
        own = {key: value for key, value in values.items() if key not in aside}
        kept = {key: value for key, value in values.items() if key in aside}
        return cls(name, source_named(name), own, kept, aside)

    @property
    def kind(self) -> str:
        """One of "profile", "recipe", "spectrum", "scan"."""
        return kind_of(self.source)

    @property
    def path(self) -> Path:
        """The source as a path, from which names of files are made."""
        return Path(self.source)

    @property
    def is_spectrum(self) -> bool:
        """Whether it is a saved spectrum, which takes no values.

        Raises:
            RequestError: if it has some.
        """
        if self.kind == "spectrum" and self.values:
            got = ", ".join(self.values)
            raise RequestError(f"{self.source}: got {got} with a saved spectrum, wanted the recipe or the scan itself")
        return self.kind == "spectrum"

    @cached_property
    def stated(self) -> Recipe:
        """The recipe as it is stated, before a scan is read.

        Raises:
            FileNotFoundError: if there is no such file.
            RequestError: if it or a value is wrong, or unknown, or it is a saved spectrum.
        """
        of_surface = dict(self.values)
        settings = {name: of_surface.pop(name) for name in SPECTRUM_PARAMETERS if name in of_surface}
        if self.aside.get("theory") == "rigorous":  # whose parameters no other recipe knows
            settings["theory"] = "rigorous"
        if self.is_spectrum:
            raise RequestError(f"{self.source}: got a saved spectrum, wanted the recipe, the profile or the scan")
        if self.kind == "profile":
            recipe = Recipe.of_profile(self.source, {}, **settings)
        elif self.kind == "recipe":
            recipe = Recipe.load(self.path, **settings)
        else:
            recipe = Recipe({"scan": self.path.name}, Settings.of(**settings), self.path.parent)
        known = recipe.value_names
        if unknown := [name for name in of_surface if name not in known]:
            names = (*known, *(name for name in self.names_aside if name not in known))
            wanted = f"wanted some of {', '.join(names)}{did_you_mean(unknown[0], names)}"
            raise RequestError(f"{self.title}: got {', '.join(unknown)}, {wanted}")
        return Recipe({**recipe.surface, **of_surface}, recipe.settings, recipe.folder)

    @cached_property
    def _tile_by_seam(self) -> tuple[bool, str] | None:
        """Whether a scan without `extent` repeats without a seam, and why; None of other surfaces."""
        if self.kind != "scan" or "extent" in self.values or not isinstance(self.stated.settings, ScalarSettings):
            return None
        return repeats_without_seam(self.stated.height_field())

    @cached_property
    def recipe(self) -> Recipe:
        """The recipe of the surface.

        A scan whose `extent` is not given is one period of a grating if it repeats without a seam, and a sample of an
        irregular surface otherwise; for errors see `stated`.
        """
        is_tile, _ = self._tile_by_seam or (True, "")
        return self.stated if is_tile else self.stated.as_sample()

    def say_extent(self) -> None:
        """Print as what a scan without `extent` is taken, once all of a request is checked."""
        if self._tile_by_seam is None:
            return
        is_tile, reason = self._tile_by_seam
        found = "tile" if is_tile else "sample"
        advice = "" if is_tile else "; extent=tile repeats it, prepare=crop_periods crops it to whole periods"
        say("note", f"{self.title}: taken as extent={found}: {reason}{advice}")

    @property
    def files(self) -> list[Path]:
        """The files that are read, whether they exist or not."""
        own = [] if self.kind == "profile" else [self.path]
        return own + ([] if self.kind == "spectrum" else self.stated.files)

    @property
    def theory(self) -> str:
        """The theory, "scalar" or "rigorous"."""
        if "theory" in self.aside:
            return str(self.aside["theory"])
        if self.kind == "spectrum":
            return "rigorous" if is_rigorous(self.source) else "scalar"
        return self.stated.settings.theory

    @property
    def _of_recipe(self) -> Mapping[str, Any]:
        """The parameters of its recipe, those of its media among them."""
        return {} if self.is_spectrum else self.stated.settings.chosen

    @property
    def below(self) -> MediumBelow:
        """The medium below, for orders in air.

        Raises:
            RequestError: as `MediumBelow.of`, or if the surface lies below another medium than air.
        """
        outside = {**self._of_recipe, **self.aside}.get("ext_ior", 1)
        if outside != 1:
            raise RequestError(f"ext_ior: got {outside} of the recipe, wanted none: these orders are in air")
        return MediumBelow.requested(self.aside, self._of_recipe)

    @property
    def media(self) -> Media:
        """It in air, with the light that it transmits; for errors see `below` and `Media`."""
        kind = {**self._of_recipe, **self.aside}.get("transmission", TRANSMISSIONS[0])
        return Media(self.below, transmission=kind)

    @property
    def is_irregular(self) -> bool:
        """Whether it is an irregular surface, which has no orders."""
        return self.is_spectrum or self.recipe.settings.extent == "sample" or self.recipe.patches > 1

    @property
    def period(self) -> HeightField:
        """One period of a grating, for its orders.

        Raises:
            RequestError: if it is deeper than its `largest_height_range`; others as `recipe`.
        """
        heights = self.recipe.height_field()
        check_height_range(heights, self.recipe.settings)
        return heights

    @property
    def is_film(self) -> bool:
        """Whether it is the profile of a transparent film."""
        profile = self.source if self.kind == "profile" else ""
        if self.kind == "recipe":
            profile = Recipe.load(self.path).surface.get("profile", "")
        return profile == "film" or profile.startswith("transmission_")

    def spectrum(self, progress: Callable[[str], AbstractContextManager[Progress]] = no_progress) -> Spectrum:
        """Return the spectrum: loaded, from the cache, or computed within progress(label); for errors see `recipe`."""
        return load_spectrum(self.path) if self.is_spectrum else self.recipe.cached(progress)
