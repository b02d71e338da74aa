"""What a page shows: a spectrum, the heights behind it, the material, and the same grating in a scene."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import RequestError, did_you_mean, is_number, operand, shell_command
from ..files.writing import examples_folder
from ..optics.materials import constant
from ..optics.media import DEFAULT_INT_IOR, Media, MediumBelow
from ..precomputation.grating_spectrum import GratingSpectrum
from ..precomputation.recipe import Recipe, parameters_of_profile
from ..precomputation.requested_surface import RequestedSurface
from ..precomputation.spectra import Spectrum
from ..precomputation.surface_text import written
from ..progress import NAME, Progress, no_progress
from ..settings import FROM_RADIUS, VISIBLE, wavelengths_inside
from ..spectrum.tables import SliceTable

AIR = 1.000277  # index of the outside, as Mitsuba's "air"

# WebGL2 guarantees array textures with sides of 2048 texels and 256 layers.
MAX_SIDE, MAX_LAYERS = 2048 - 6, 256  # with the margin of spectrum.js

_NOT_SHOWN = {
    "transmission": "reflected light only",
    "ext_ior": "a grating in air",
    "lateral_scale": "a grating of one period",
}
"""Parameters of a scene that the page does not have, and what it shows instead."""

_OF_DISC: dict[str, Any] = {"material": "Al", "coat_ior": 1.55, "orientation": "radial"}
DISCS = ("compact_disc", "dvd")
"""Profiles of discs; without parameters of their own they have the polycarbonate over their metal."""


@dataclass(frozen=True)
class InScene:
    """The parameters of a grating in a scene that a page shows.

    Attributes:
        media: around it, in air.
        orientation: degrees from the tangent to the pattern's x axis; or radial or tangential.
        height_scale: factor of the heights.
    """

    media: Media
    orientation: float | str
    height_scale: float

    def __post_init__(self) -> None:
        if self.orientation not in tuple(FROM_RADIUS) and not is_number(self.orientation):
            raise RequestError(f"orientation: got {self.orientation!r}, wanted degrees, radial or tangential")
        if not (is_number(self.height_scale) and self.height_scale >= 0):
            raise RequestError(f"height_scale: got {self.height_scale!r}, wanted a number ≥ 0")

    @property
    def coat_ior(self) -> float:
        """Index of the layer over the grating; one of none."""
        return 1.0 if self.media.coat is None else self.media.coat.nominal.real


@dataclass(frozen=True, eq=False)
class Surface:
    """A surface and its material.

    Attributes:
        name: its title.
        spectrum: S(q; κ) as slices.
        recipe: of the heights; None for a saved spectrum.
        grating: the surface as parameters of `diffraction_grating`; files by their names, without folders.
        in_scene: its media and scales.
        command: that makes the file of `grating`, if it is not there yet.
    """

    name: str
    spectrum: GratingSpectrum
    recipe: Recipe | None
    grating: Mapping[str, str | int | float]
    in_scene: InScene
    command: str = ""

    def __post_init__(self) -> None:
        spectrum: Spectrum = self.spectrum
        if not isinstance(spectrum, GratingSpectrum):
            raise RequestError(f"{self.name}: got theory=rigorous, wanted a surface of scalar theory")
        if not isinstance(spectrum.table, SliceTable):
            got = spectrum.representation
            raise RequestError(f"{self.name}: got representation {got!r}, wanted 'slices'")
        rows, columns = spectrum.grid.shape
        if max(rows, columns) > MAX_SIDE or spectrum.table.intervals > MAX_LAYERS:
            raise RequestError(
                f"{self.name}: got a table of {columns} × {rows} nodes and {spectrum.table.intervals} intervals of κ, "
                f"wanted at most {MAX_SIDE} × {MAX_SIDE} and {MAX_LAYERS}, the textures of WebGL2"
            )
        coat, shortest = self.in_scene.coat_ior, spectrum.wavelengths[0]
        if coat > 1 and coat / AIR * shortest > SHORTEST * (1 + 1e-6):
            raise RequestError(
                f"coat_ior: got {coat:g}, wanted at most {max(1, AIR * SHORTEST / shortest):.4g}: the spectrum was "
                f"built for wavelengths from {shortest:g} nm; give the page a recipe or a profile"
            )
        if self.in_scene.height_scale > (max_scale := self.max_height_scale) * (1 + 1e-6):
            raise RequestError(
                f"height_scale: got {self.in_scene.height_scale:g}, wanted at most {max_scale:.4g}: the spectrum was "
                f"built for wavelengths from {spectrum.wavelengths[0]:g} nm"
            )

    @property
    def max_height_scale(self) -> float:
        """The largest factor of the heights that the table covers for visible light."""
        return max(1.0, SHORTEST / self.in_scene.media.coat_index / self.spectrum.wavelengths[0])

    @classmethod
    def of_recipe(
        cls,
        recipe: Recipe,
        name: str,
        grating: Mapping[str, Any],
        parameters: Mapping[str, Any],
        progress: Callable[[str], AbstractContextManager[Progress]] = no_progress,
        command: str = "",
    ) -> Surface:
        """Return the surface of a recipe, whose spectrum is computed unless it is cached.

        Args:
            recipe: the surface.
            name: its title.
            grating: it as parameters of `diffraction_grating`.
            parameters: of the material; others are refused.
            progress: of the computation.
            command: as the attribute.
        """
        shown = in_scene(with_plastic(recipe, parameters, covered=not command))
        if recipe.settings.theory == "rigorous":  # before its table is computed
            raise RequestError(f"{name}: got theory=rigorous, wanted a surface of scalar theory")
        if not command and shown.coat_ior > 1 and recipe.settings.wavelengths == VISIBLE:
            # Of indices in single precision, as Mitsuba has them, so that a scene finds the same spectrum in the cache.
            index = float(np.float32(shown.coat_ior)) / float(np.float32(AIR))
            settings = replace(recipe.settings, wavelengths=wavelengths_inside(index))
            recipe = replace(recipe, settings=settings)
        spectrum = recipe.cached(progress)
        assert isinstance(spectrum, GratingSpectrum)
        return cls(name, spectrum, recipe, grating, shown, command)

    @classmethod
    def named(cls, source: str | os.PathLike[str], parameters: Mapping[str, Any]) -> Surface:
        """Return the surface of a profile or a file, with parameters of it and of its material; see `requested`."""
        return cls.requested(RequestedSurface.named(os.fspath(source), parameters, OF_SCENE))

    @classmethod
    def requested(
        cls,
        surface: RequestedSurface,
        progress: Callable[[str], AbstractContextManager[Progress]] = no_progress,
    ) -> Surface:
        """Return a requested surface, whose parameters in a scene (`OF_SCENE`) are set aside.

        Args:
            surface: a recipe, a saved spectrum, a profile or a scan.
            progress: of the computation.

        Raises:
            FileNotFoundError: if there is no such file.
            RequestError: if a parameter is wrong, or the page does not show such a surface.
        """
        path, parameters = surface.path, dict(surface.aside)
        if surface.is_spectrum:
            shown = in_scene(parameters)
            return cls(path.stem, surface.spectrum(), None, {"filename": path.name}, shown)  # type: ignore[arg-type]
        if (theory := parameters.pop("theory", "scalar")) != "scalar":
            raise RequestError(f"theory: got {theory}, wanted scalar")
        own, recipe, command = dict(surface.values), surface.recipe, ""
        is_recipe = surface.kind == "recipe"
        # A recipe of the package has its name in scenes and commands, wherever they are.
        of_package = is_recipe and path.resolve().parent == (examples_folder() / "precompute").resolve()
        name = path.stem if of_package else path.name
        grating: dict[str, Any]
        if surface.kind == "profile" and own.keys() <= set(parameters_of_profile(str(path))):
            grating = {"profile": str(path), **own}
        elif is_recipe and not own:
            grating = {"filename": name}
        else:
            grating = {"filename": f"{path.stem}.exr"}
            extent = {} if is_recipe else {"extent": recipe.settings.extent}
            text = written(name, own | extent)
            command = shell_command(NAME, "precompute", operand(text), "-o", operand(f"{path.stem}.exr"))
        return cls.of_recipe(recipe, path.stem, grating, parameters, progress, command)


SHORTEST = VISIBLE[0]  # nm, of the wavelengths of a page
_SHOWN = ("coat_ior", "height_scale", "int_ior", "material", "orientation")
OF_SCENE = ("theory", *_SHOWN, *_NOT_SHOWN)
"""Names of the parameters of a grating in a scene, beside the values of its recipe."""


def with_plastic(recipe: Recipe, parameters: Mapping[str, Any], covered: bool) -> dict[str, Any]:
    """Return the parameters of a material, and for a disc its own where they are not given.

    Args:
        recipe: of the surface.
        parameters: as given.
        covered: whether the spectrum is built for the light in a coat.
    """
    own = dict(_OF_DISC) if recipe.surface.get("profile") in DISCS else {}
    if "int_ior" in parameters:
        own.pop("material", None)
    if not covered:
        own.pop("coat_ior", None)
    return own | dict(parameters)


def in_scene(parameters: Mapping[str, Any]) -> InScene:
    """Return what a page shows of the parameters of a scene.

    Raises:
        RequestError: if one is wrong, or not shown in a page.
    """
    for name, value in parameters.items():
        if name in _NOT_SHOWN:
            raise RequestError(f"{name}: got {value!r}, and the page shows {_NOT_SHOWN[name]}")
        if name not in _SHOWN:
            similar = did_you_mean(name, _SHOWN)
            raise RequestError(f"{name}: got {value!r}, wanted a parameter among {', '.join(_SHOWN)}{similar}")
        if name in ("int_ior", "coat_ior") and not is_number(value):
            raise RequestError(f"{name}: got {value!r}, wanted a number")
    if "material" in parameters and "int_ior" in parameters:
        raise RequestError("material: a conductor or a perfect mirror takes no int_ior; give one or the other")
    if not 1 < (n := parameters.get("int_ior", DEFAULT_INT_IOR)) <= 10:
        raise RequestError(f"int_ior: got {n!r}, wanted an index above 1, at most 10")
    if not 1 <= (n := parameters.get("coat_ior", 1.0)) <= 10:
        raise RequestError(f"coat_ior: got {n!r}, wanted an index of 1 (no layer) to 10")
    media = Media(MediumBelow.requested(parameters), constant(AIR), constant(n))
    return InScene(media, parameters.get("orientation", 0.0), parameters.get("height_scale", 1.0))
