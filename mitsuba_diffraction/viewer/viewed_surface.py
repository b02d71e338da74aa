"""What a page shows: a spectrum, the heights behind it, the material, and the same grating in a scene."""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from contextlib import AbstractContextManager
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from ..errors import RequestError, operand, shell_command
from ..files.writing import examples_folder
from ..precomputation.grating_spectrum import GratingSpectrum
from ..precomputation.in_scene import AIR, OF_SCENE, InScene, in_scene, with_plastic
from ..precomputation.recipe import Recipe, parameters_of_profile
from ..precomputation.requested_surface import RequestedSurface
from ..precomputation.spectra import Spectrum
from ..precomputation.surface_text import written
from ..progress import NAME, Progress, no_progress
from ..settings import VISIBLE, wavelengths_inside
from ..spectrum.tables import SliceTable

# WebGL2 guarantees array textures with sides of 2048 texels and 256 layers.
MAX_SIDE, MAX_LAYERS = 2048 - 6, 256  # with the margin of spectrum.js


@dataclass(frozen=True, eq=False)
class ViewedSurface:
    """A surface and the media around it.

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
    ) -> ViewedSurface:
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
    def named(cls, source: str | os.PathLike[str], parameters: Mapping[str, Any]) -> ViewedSurface:
        """Return the surface of a profile or a file, with parameters of it and of its material; see `requested`."""
        return cls.requested(RequestedSurface.named(os.fspath(source), parameters, OF_SCENE))

    @classmethod
    def requested(
        cls,
        surface: RequestedSurface,
        progress: Callable[[str], AbstractContextManager[Progress]] = no_progress,
    ) -> ViewedSurface:
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
