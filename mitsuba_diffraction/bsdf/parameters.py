"""The parameters of a scene, read and checked: the surface, the media around it, its scales."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import mitsuba as mi

from ..errors import RequestError, is_number
from ..handed_over_spectra import handed_over
from ..optics.geometry import SHADOWING
from ..optics.media import Media, MediumBelow
from ..optics.refractive_indices import KnownRange, is_file
from ..precomputation.recipe import REQUESTED, Recipe, kind_of, source_named
from ..precomputation.requested_surface import RequestedSurface
from ..precomputation.spectra import Spectrum, load_spectrum
from ..rigorous.build_table import medium_below
from ..rigorous.rigorous_spectrum import RigorousSpectrum
from ..settings import (
    FROM_RADIUS,
    MIN_WAVELENGTH,
    SPECTRUM_PARAMETERS,
    THEORIES,
    TRANSMISSIONS,
    VISIBLE,
    RigorousSettings,
    wavelengths_inside,
)
from ..surface.gratings import PROFILES
from .base import Base, base_from
from .coat import Coat
from .fresnel import Boundary, below_from, boundary_from
from .indices import index_from
from .mitsuba_internals import nested_plugin
from .thin_film import with_film
from .varying import Scales, check_texture, numbers_from

_MAX_DEGREES = 1e6
_SCALAR_ONLY = {
    "height_scale": "build the spectrum of the other depth",
    "lateral_scale": "build the spectrum of the other period",
    "base": "transmitted light is not computed; leave it out",
    "eta": "the spectrum has the index of its material; leave it out",
    "k": "the spectrum has the index of its material; leave it out",
    "conserve_energy": "they conserve energy by themselves; leave it out",
    "shadowing": "it is part of the efficiencies; leave it out",
    "thin_film_thickness": "its tables are of bare surfaces; leave it out",
    "thin_film_ior": "its tables are of bare surfaces; leave it out",
    "thin_film_scale": "its tables are of bare surfaces; leave it out",
}


def _given(props: mi.Properties, *names: str) -> dict[str, Any]:
    """Return the parameters of these names that a scene has."""
    return {name: props[name] for name in names if name in props}


def media_from(props: mi.Properties) -> Media:
    """Return the media of a scene, from `ext_ior`, `coat_ior`, `int_ior` or `material`, and `transmission`.

    Raises:
        RequestError: if an index is out of range, or the material does not transmit.
    """
    kind = props.get("transmission", TRANSMISSIONS[0])
    for name in ("material", "base", "coat_ior", "eta", "k") if kind in TRANSMISSIONS[1:] else ():
        if name in props:
            got = repr(props[name]) if isinstance(props[name], str | float | int) else "a BSDF"
            raise RequestError(f"{name}: got {got} with transmission={kind}, wanted a dielectric (int_ior) alone")
    coat = index_from("coat_ior", props["coat_ior"]) if "coat_ior" in props else None
    below = below_from(_given(props, "int_ior", "ext_ior", "coat_ior", "material", "eta", "k"))
    return Media(below, index_from("ext_ior", props.get("ext_ior", "air")), coat, kind)


def spectrum_or_recipe_from(props: mi.Properties, media: Media, scale: float = 1.0) -> Spectrum | Recipe:
    """Return the spectrum given by `filename` or `spectrum`, or the recipe given by `filename` or `profile`.

    The recipe is for the wavelengths λ/n in a coat or a dielectric, divided by the maximum `scale`, and, if it is
    rigorous, for the medium below. Its spectrum is not computed here, so that all other parameters can be checked
    before.

    Raises:
        RequestError: unless exactly one of them is given and valid.
        FileNotFoundError: if there is no such file.
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
    if given == ["spectrum"]:
        _refuse_requested(props, "a spectrum from Python")
    if given != ["profile"]:
        found = handed_over.get(props["spectrum"]) if "spectrum" in given else _from_file(props, media, scale)
        if not isinstance(found, Spectrum | Recipe):
            raise RequestError(
                f"spectrum: got {props['spectrum']!r}, wanted a spectrum in Python's load_dict; XML takes a filename"
            )
        own = _theory_of(found)
        if props.get("theory", own) != own:
            raise RequestError(f"theory: got {theory!r} with a spectrum of {own} theory, wanted one built for it")
        return found
    settings = {"theory": theory, **_medium_settings(props, media)} if theory == "rigorous" else {}
    return _inside(media, scale, Recipe.of_profile(props["profile"], props, **_requested(props), **settings))


def _theory_of(found: Spectrum | Recipe) -> str:
    return found.settings.theory if isinstance(found, Recipe) else found.theory


def _requested(props: mi.Properties) -> dict[str, Any]:
    """Return the parameters of the spectrum that a scene requests; `terms` is a text where it may be "auto"."""
    given = _given(props, *REQUESTED)
    if isinstance(terms := given.get("terms"), str) and terms.isdecimal():
        given["terms"] = int(terms)
    return given


def _refuse_requested(props: mi.Properties, of: str) -> None:
    """Check that nothing but a default is requested of a spectrum that is computed already."""
    for name, value in _requested(props).items():
        if value not in ("auto", SPECTRUM_PARAMETERS[name].default):
            raise RequestError(
                f"{name}: got {value} with {of}, wanted it when the spectrum is computed, or a recipe (.toml)"
            )


def _inside(media: Media, scale: float, recipe: Recipe) -> Recipe:
    """Return the recipe with the wavelengths next to the relief, divided by `scale`, and, if rigorous, the media.

    Parameters that do not match the recipe are refused here, before a table is computed.
    """
    settings, overrides = recipe.settings, dict[str, Any]()
    if isinstance(settings, RigorousSettings):
        if settings.transmission != "none":
            _check_transmission(settings.transmission, media)
        overrides = _media_settings(media)
    if settings.wavelengths == VISIBLE:
        overrides["wavelengths"] = _next_to_relief(settings.theory, media, scale, VISIBLE)
    return replace(recipe, settings=replace(settings, **overrides))


def _next_to_relief(theory: str, media: Media, scale: float, wavelengths: tuple[float, float]) -> tuple[float, float]:
    """Return the wavelengths (shortest, longest) for which to build a spectrum, from the wavelengths in air, nm."""
    # Rigorous tables of a bare surface are for the wavelengths above it.
    if theory == "rigorous" and media.coat is None:
        return wavelengths
    if media.index > (max_index := wavelengths[0] / MIN_WAVELENGTH):
        raise RequestError(
            f"{media.index_name}: got {media.index:.3g} with light of {wavelengths[0]:g} nm, wanted at most "
            f"{max_index:.3g}: inside, wavelengths would be shorter than {MIN_WAVELENGTH:g} nm"
        )
    return wavelengths_inside(media.index, scale, wavelengths)


def _from_file(props: mi.Properties, media: Media, scale: float) -> Spectrum | Recipe:
    """Return the spectrum or the recipe of a file."""
    path = Path(str(mi.file_resolver().resolve(str(props["filename"]))))
    given = _requested(props)
    if not path.suffix:
        path = Path(source_named(str(path)))
    kind = kind_of(path)
    if kind in ("recipe", "spectrum") and not path.is_file():
        # An unresolved path is relative; the resolver begins with the folder of the scene.
        folder = Path(str(mi.file_resolver()[0])) / path.parent
        available = sorted(other.name for other in folder.glob("*") if kind_of(other) in ("recipe", "spectrum"))
        raise FileNotFoundError(f"{path}: no such file; {folder} holds {', '.join(available) or 'no spectrum'}")
    if kind in ("recipe", "profile"):
        return _inside(media, scale, RequestedSurface.named(str(path), given).recipe)
    if kind == "spectrum":
        _refuse_requested(props, str(path))
        return load_spectrum(path)
    raise RequestError(
        f"filename: got {path}, wanted a saved spectrum (.exr) or a recipe (.toml); "
        "a scan is turned into a spectrum by `mitsuba-diffraction precompute`, or named by a recipe"
    )


def _medium_settings(props: mi.Properties, media: Media) -> dict[str, Any]:
    """Return `material` or `int_ior` for `precompute`, the index relative to the outside.

    Raises:
        RequestError: if they are two spectra, or the material is the perfect mirror.
    """
    below = media.below
    if below.parameter == "eta":
        raise RequestError("eta: got spectra with theory=rigorous, wanted the name of a conductor or a file: material")
    below.check_theory("rigorous")
    assert below.index is not None
    if below.index.is_constant:  # rounded to the digits of a float32
        return {"int_ior": float(f"{media.eta:.6g}")}
    return {below.parameter: _resolved(props[below.parameter])}


def _resolved(index: str) -> str:
    """Return the name of a medium, or the path of the file of an index."""
    return str(Path(str(mi.file_resolver().resolve(index))).absolute()) if is_file(index) else index


def _media_settings(media: Media) -> dict[str, Any]:
    """Return the settings for `precompute` that follow from the coat, the transmission and the variant."""
    medium: dict[str, Any] = {} if media.coat is None else {"ext_ior": float(f"{media.coat_index:.6g}")}
    if media.transmits:
        medium["transmission"] = media.transmission
    return {**medium, "polarised": True} if mi.is_polarized else medium


def _check_transmission(of_spectrum: str, media: Media) -> None:
    """Check `transmission` of a rigorous spectrum.

    Raises:
        RequestError: if it differs from `transmission` of the scene.
    """
    if of_spectrum != media.transmission:
        raise RequestError(
            f"transmission: got {media.transmission!r}, but the rigorous spectrum is of transmission={of_spectrum}: "
            "say the same, or build the spectrum for it"
        )


def _refuse_scalar_only(props: mi.Properties) -> None:
    """Check that no parameter of scalar theory alone is given.

    Raises:
        RequestError: if one is.
    """
    for name, advice in _SCALAR_ONLY.items():
        if name in props:
            texture = isinstance(props[name], mi.Texture)
            got = "a BSDF" if name == "base" else "a texture" if texture else repr(props[name])
            raise RequestError(f"{name}: got {got}, wanted none with theory=rigorous: {advice}")


def check_rigorous(spectrum: RigorousSpectrum, request: GratingRequest) -> None:
    """Check that a rigorous spectrum is of the material, the media and the polarisation of a scene.

    Raises:
        RequestError: if it is not.
    """
    media, stated = request.media, request.stated
    coat = media.coat
    if media.outside > 1 and coat is None:
        raise RequestError(f"ext_ior: got {media.outside:g} with theory=rigorous, wanted air or a coat")
    _check_transmission(spectrum.transmission, media)
    if mi.is_polarized and spectrum.mueller is None:
        raise RequestError(
            f"theory: got a rigorous spectrum of unpolarised light in the variant {mi.variant()}, wanted one that was "
            "built with polarised=True"
        )
    medium = media.coat_index
    if abs(spectrum.settings.ext_ior - medium) > 1e-3 * medium:
        raise RequestError(
            f"coat_ior: got {'none' if coat is None else f'{coat.nominal.real:g}'}, but the rigorous spectrum is of a "
            f"grating below a medium of index {spectrum.settings.ext_ior:g}: build it with ext_ior={medium:.4g}"
        )
    if stated is None:
        return
    if not spectrum.is_of(MediumBelow.requested(stated)):
        got = " ".join(f"{name} {value}" for name, value in stated.items())
        raise RequestError(
            f"material: got {got}, but the rigorous spectrum is of {spectrum.medium_text}: "
            "leave it out, or build the spectrum for this material"
        )


def _base_from(props: mi.Properties) -> Base | None:
    """Return the base of the parameter of this name, or None.

    Raises:
        RequestError: if a nested BSDF has another name.
    """
    if any(name != "base" and isinstance(value, mi.BSDF) for name, value in props.objects()):
        raise RequestError(
            'base: got a nested BSDF without this name, wanted <bsdf name="base" …> (in load_dict, the key "base")'
        )
    return base_from(props["base"]) if "base" in props else None


@dataclass(frozen=True)
class GratingRequest:
    """The parameters of a grating, checked before a spectrum is computed for it.

    Attributes:
        media: around the grating.
        coat: the layer over it, or None.
        scales: of heights and of lengths along the surface; one in rigorous theory.
        scale: the maximum of both, for which a recipe in `spectrum_or_recipe` is made.
        orientation: degrees from the tangent to the pattern's x axis.
        from_radius: whether they are from the radius, away from the centre of the surface, instead.
        boundary: R and T of a plane, for scalar theory.
        stated: `material` or `int_ior` of the scene, as settings of a rigorous spectrum; None in scalar theory, and if
            the scene leaves them to the spectrum.
        base: below the grating, or None.
        shadowing: whether G is a factor in scalar theory.
        conserve_energy: whether E is.
        spectrum_or_recipe: a spectrum, or the recipe to compute one.
    """

    media: Media
    coat: Coat | None
    scales: Scales
    scale: float
    orientation: mi.Texture
    from_radius: bool
    boundary: Boundary
    stated: dict[str, Any] | None
    base: Base | None
    shadowing: bool
    conserve_energy: bool
    spectrum_or_recipe: Spectrum | Recipe

    @property
    def known_ranges(self) -> tuple[KnownRange, ...]:
        """Where each index that the scene names is known."""
        return *self.media.known_ranges, *self.boundary.known_ranges(), *self._known_of_recipe

    @cached_property
    def _known_of_recipe(self) -> tuple[KnownRange, ...]:
        """Where the index of a rigorous recipe is known: once, as its file may be gone when a kernel is traced."""
        settings = self.spectrum_or_recipe.settings if isinstance(self.spectrum_or_recipe, Recipe) else None
        return medium_below(settings).known_ranges if isinstance(settings, RigorousSettings) else ()

    def widened(self, wavelengths: tuple[float, float], scale: float = 1.0) -> Recipe | None:
        """Return the recipe for light of these wavelengths in air, nm; None for one that sets its own, or a file.

        It covers the scales of the scene, and `scale`.
        """
        if not isinstance(self.spectrum_or_recipe, Recipe):
            return None
        settings = self.spectrum_or_recipe.settings
        if settings.wavelengths != _next_to_relief(settings.theory, self.media, self.scale, VISIBLE):
            return None
        of_scene = _next_to_relief(settings.theory, self.media, max(scale, self.scales.max_scale), wavelengths)
        return replace(self.spectrum_or_recipe, settings=replace(settings, wavelengths=of_scene))

    @classmethod
    def of(cls, props: mi.Properties) -> GratingRequest:
        """Read the parameters of a scene.

        Raises:
            RequestError: if one is wrong, or they contradict each other.
        """
        media, scales = media_from(props), Scales(props.get("height_scale", 1.0), props.get("lateral_scale", 1.0))
        angle = props.get("orientation", 0.0)
        if isinstance(angle, float | int) and not (is_number(angle) and abs(angle) <= _MAX_DEGREES):
            raise RequestError(f"orientation: got {angle}, wanted degrees, up to {_MAX_DEGREES:g}, or a texture")
        from_radius = angle in tuple(FROM_RADIUS)
        if from_radius:
            orientation = nested_plugin("uniform", value=FROM_RADIUS[angle])
        elif isinstance(angle, str):
            orientation = numbers_from("orientation", angle, 360.0, "radial, tangential, ")
        else:
            orientation = props.get_texture("orientation", 0.0)
        check_texture("orientation", orientation)
        coat = Coat.of(media)
        of_metal = media.below.parameter == "eta"
        eta_and_k = (props.get_texture("eta"), props.get_texture("k", 0.0)) if of_metal else None
        bare = boundary_from(media, coat, eta_and_k)
        scale, stated = scales.max_scale, None
        given = spectrum_or_recipe_from(props, media, scale)
        if _theory_of(given) == "rigorous":
            _refuse_scalar_only(props)
            # With a coat, `ext_ior` is the index above the coat.
            if any(name in props for name in ("material", "int_ior", *(["ext_ior"] if media.coat is None else []))):
                stated = _medium_settings(props, media)
        boundary = with_film(bare, _given(props, "thin_film_thickness", "thin_film_ior", "thin_film_scale"))
        base = _base_from(props)
        if base is not None and not boundary.transparent:
            raise RequestError("base: got a BSDF below a conductor or a perfect mirror, which transmit no light")
        shadowing = props.get("shadowing", SHADOWING[0])
        if shadowing not in SHADOWING:
            raise RequestError(f"shadowing: got {shadowing!r}, wanted one of {', '.join(SHADOWING)}")
        conserve_energy = props.get("conserve_energy", True)
        if not isinstance(conserve_energy, bool):
            raise RequestError(f"conserve_energy: got {conserve_energy!r}, wanted true or false")
        return cls(
            media=media,
            coat=coat,
            scales=scales,
            scale=scale,
            orientation=orientation,
            from_radius=from_radius,
            boundary=boundary,
            stated=stated,
            base=base,
            shadowing=shadowing == "v_cavity",
            conserve_energy=conserve_energy,
            spectrum_or_recipe=given,
        )
