"""What a page or a file of colours shows of a grating in a scene: its media in air, orientation and heights."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from ..errors import RequestError, did_you_mean, is_number
from ..optics.media import DEFAULT_INT_IOR, Media, MediumBelow
from ..optics.refractive_indices import constant
from ..settings import FROM_RADIUS
from .recipe import Recipe

AIR = 1.000277  # index of the outside, as Mitsuba's "air"

_NOT_SHOWN = {
    "transmission": "reflected light only",
    "ext_ior": "a grating in air",
    "lateral_scale": "a grating of one period",
}
"""Parameters of a scene that the page does not have, and what it shows instead."""

_OF_DISC: dict[str, Any] = {"material": "Al", "coat_ior": 1.55, "orientation": "radial"}
DISCS = ("compact_disc", "dvd")
"""Profiles of discs; without parameters of their own they have the polycarbonate over their metal."""

_SHOWN = ("coat_ior", "height_scale", "int_ior", "material", "orientation")
OF_SCENE = ("theory", *_SHOWN, *_NOT_SHOWN)
"""Names of the parameters of a grating in a scene, beside the values of its recipe."""


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
