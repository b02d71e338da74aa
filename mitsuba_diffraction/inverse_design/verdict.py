"""Whether a plate works, in one line, from thresholds; if not, what would help."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from types import MappingProxyType

import numpy as np

from .plate import Plate, depth_for_strokes, resolved_strokes
from .result import Design

# Fraction of the light in the picture, contrast, correlation with the target: at least these, means over wavelengths.
GOOD_BOUNDS = (0.6, 0.6, 0.85)
VISIBLE_BOUNDS = (0.3, 0.3, 0.6)
# ΔE00 of a coloured target and what is predicted, at most these.
COLOUR_BOUNDS = {"good": 10.0, "fair": 15.0}
_MAX_STEP = 0.45  # of levels, in wavelengths of path difference; larger ones send light into the mirror direction
_MIN_PATH = 0.75  # of the whole relief, in wavelengths
_SHALLOW = 0.75  # of the depth for the finest strokes
_MAX_LIT = 0.6  # fraction of the frame that is light
_NO_PIGMENTS = "one relief has no three pigments: all wavelengths follow the same slopes"


@dataclass(frozen=True)
class Verdict:
    """What a plate is worth: "good", "visible" or "bad", with its measures and, unless it is good, a remedy.

    Attributes:
        grade: by `GOOD_BOUNDS` and `VISIBLE_BOUNDS`; at most "visible" where colours are poor.
        light, contrast, correlation: means over the wavelengths.
        remedy: which argument to change, or "".
        colours: "good", "fair" or "poor" by `COLOUR_BOUNDS`, with ΔE00; "" of a grey target and of a laser.
    """

    grade: str
    light: float
    contrast: float
    correlation: float
    remedy: str
    colours: str = ""

    @classmethod
    def of(
        cls,
        design: Design,
        strokes: float | None = None,
        *,
        inverted: bool = False,
        names: Mapping[str, str] = MappingProxyType({}),
    ) -> Verdict:
        """Judge a design.

        Args:
            design: the design.
            strokes: its picture's finest strokes along an edge, for the remedy.
            inverted: whether it casts the negative of the picture.
            names: of the arguments of `design` in the remedy, by their names; "detail" and "negative" are options of
                the command line alone.
        """
        measures = design.light, design.contrast, float(np.mean(design.correlation))
        grade = next(
            (
                name
                for name, bounds in (("good", GOOD_BOUNDS), ("visible", VISIBLE_BOUNDS))
                if all(value >= bound for value, bound in zip(measures, bounds, strict=True))
            ),
            "bad",
        )
        difference, colours, remedy = design.colour_difference, "", ""
        if design.coloured and not math.isnan(difference):
            name = next((name for name, bound in COLOUR_BOUNDS.items() if difference <= bound), "poor")
            colours = f"{name} (ΔE00 {difference:.0f})"
            if name == "poor" and grade == "good":
                grade, remedy = "visible", _NO_PIGMENTS
        if grade != "good":
            remedy = remedy or _remedy(design, strokes, inverted, names)
        return cls(grade, *measures, remedy, colours)

    def __str__(self) -> str:
        numbers = (
            f"{self.light:.0%} of the light in the picture, contrast {self.contrast:.2f}, correlation "
            f"{self.correlation:.2f}"
        ) + (f", colours {self.colours}" if self.colours else "")
        if self.grade == "good":
            return f"good: {numbers}"
        said = "the picture can be seen, but is pale or uneven" if self.grade == "visible" else "the picture fails"
        if self.remedy == _NO_PIGMENTS:
            said = "the picture can be seen, in other colours"
        return f"{said}: {numbers}; {self.remedy}"


def _remedy(design: Design, strokes: float | None, inverted: bool, names: Mapping[str, str]) -> str:
    """Return the argument that most likely helps, the first cause that is found."""

    def named(name: str) -> str:
        return names.get(name, name)

    plate = design.plate
    wave = _depth(plate)  # µm, of a path difference of one wavelength
    path, depth = plate.height_range / wave, named("height_range")
    if path < _MIN_PATH:
        return f"the relief is too shallow: raise {depth} to {3 * wave:.2g} µm, or at least {wave:.2g}"
    if plate.levels == 2:
        return (
            f"two levels send as much light into the picture turned by half a circle: raise {named('levels')} to 4 or "
            f"more, with {depth} {wave * 3 / 4:.2g}"
        )
    if plate.levels is not None and path / (plate.levels - 1) > _MAX_STEP:
        count = 1 + math.ceil(path / _MAX_STEP)
        return (
            f"the steps are too high: raise {named('levels')} to {count} or more, or lower {depth} to "
            f"{wave * (plate.levels - 1) / plate.levels:.2g} µm"
        )
    if plate.tool_blur > plate.texel:
        return f"the tool is too blunt: {named('tool_blur')} of at most a texel, {plate.texel:.2g} µm"
    if design.inside.mean() > _MAX_LIT and not design.coloured:
        negative = names.get("negative", "its negative")
        cast = (
            f"without {negative}, its other parts are cast" if inverted else f"{negative} casts its dark parts instead"
        )
        return f"most of the picture is light: {cast}"
    if strokes is not None and plate.levels is None and plate.wavelengths.size > 1:
        deep = depth_for_strokes(strokes, plate.wavelengths, plate.int_ior)
        if plate.height_range < _SHALLOW * deep:
            return f"facets are too short for its strokes in light of many wavelengths: {depth} {deep:.2g}"
    resolved = resolved_strokes(plate.texels, plate.texel, plate.angle, float(plate.wavelengths.max()))
    if strokes is not None and strokes > resolved:
        texels = math.ceil(plate.texels * strokes / resolved)
        return (
            f"its finest strokes are 1/{strokes:.0f} of it, and the plate resolves 1/{resolved:.0f}: "
            + (f"{names['detail']} {strokes:.0f}" if "detail" in names else f"texels {texels}")
            + ("" if plate.wavelengths.size == 1 else f", or the light of a laser, such as {named('wavelengths')} 532")
        )
    return "use a picture of less detail"


def _depth(plate: Plate) -> float:
    """Return the depth in µm with a path difference of one wavelength, on average over the wavelengths."""
    return float(2 * np.pi / np.abs(plate.kappa).mean())
