"""The spectral film that replaces that of a scene, and its channels."""

from __future__ import annotations

import mitsuba as mi
import mitsuba.parser
import numpy as np
from numpy.typing import NDArray

from ..errors import RequestError
from ..settings import VISIBLE
from .parser_state import add_child, children_of

# Spacing of the channels, nm, at most.
#
# With 5 nm, colours differ from the exact ones by ΔE₂₀₀₀ ≤ 0.05 for lines 5 nm wide and by at most 0.6 for laser lines
# (10 nm: 1.3 and 3.2; 23.5 nm: 90), and the orders of a grating, 5–20 nm wide at a coherence length of 65 µm, are
# resolved. The spacing affects memory but not time, as `film` adds a sample to at most eight channels.
_CHANNEL_STEP = 5.0
_STEPS_PER_CHANNEL = 20  # of the density from which wavelengths are drawn; a step is narrower than a lamp's lines
_MAX_PIXELS = 2**25  # above 7680 × 4320; see also `trace_pass.check_memory`
_DEFAULT_SIZE = (768, 576)  # width and height of Mitsuba's films


SpectralRange = tuple[float, float]
"""(shortest, longest) wavelength that a film records, nm."""


def channel_wavelengths(spectral_range: SpectralRange = VISIBLE) -> NDArray[np.float64]:
    """Return the centres of the film's channels, (n,), nm, equidistant; the hat functions lie inside the range."""
    count = max(2, round((spectral_range[1] - spectral_range[0]) / _CHANNEL_STEP) - 1)
    return np.linspace(*spectral_range, count + 2)[1:-1]


def channel_weights(spectral_range: SpectralRange = VISIBLE) -> NDArray[np.float64]:
    """Return the area of the response of each channel, (n,); the recorded value divided by it is radiance.

    Mitsuba samples wavelengths in proportion to the sum of the responses of the film. With hats of unit area, half of
    the samples would have wavelengths to which the eye is insensitive. These weights follow the density of Mitsuba's
    RGB film, sech²(0.0072 (λ − 538 nm)) (Radziszewski, Boryczko and Alda 2009). They reduce colour noise by a quarter,
    as much as 1.8 times the samples would. The lower bound of one quarter limits the noise of a channel to twice the
    noise of the best one.
    """
    return np.maximum(np.cosh(0.0072 * (channel_wavelengths(spectral_range) - 538)) ** -2, 0.25)


def replace_films(state: mi.parser.ParserState, width: int | None, height: int | None) -> None:
    """Replace all films by spectral ones, and add one to sensors without a film."""
    kinds = [node.type for node in state.nodes]
    if mi.ObjectType.Sensor not in kinds:
        raise RequestError("the scene has no sensor")
    for index, kind in enumerate(kinds):
        # Each film adds nodes, which may reallocate the list and invalidate references to its elements: properties are
        # read as a copy and written by index.
        props = mi.Properties(state.nodes[index].props)
        if kind == mi.ObjectType.Film:
            state.nodes[index].props = _spectral_film(state, props, width, height)
        elif kind == mi.ObjectType.Sensor and "srf" in props:
            raise RequestError(
                "sensor: got srf, wanted none: the picture holds radiance at all wavelengths, which a response can "
                "weight afterwards"
            )
        elif kind == mi.ObjectType.Sensor and not children_of(state, props, mi.ObjectType.Film):
            props["film"] = add_child(state, mi.ObjectType.Film, _spectral_film(state, mi.Properties(), width, height))
            state.nodes[index].props = props


def _spectral_film(
    state: mi.parser.ParserState, old: mi.Properties, width: int | None, height: int | None
) -> mi.Properties:
    """Return the properties of a spectral film with the crop window of `old`."""
    old_size = tuple(_integer(old, name, size) for name, size in zip(("width", "height"), _DEFAULT_SIZE, strict=True))
    if width is None:
        width = old_size[0] if height is None else max(1, round(height * old_size[0] / old_size[1]))
    if height is None:
        height = max(1, round(width * old_size[1] / old_size[0]))

    film = mi.Properties("specfilm")
    film.set_id(old.id())
    film["width"], film["height"] = width, height
    film["component_format"] = "float32"
    for axis, new, old_extent in (("x", width, old_size[0]), ("y", height, old_size[1])):
        extent = "width" if axis == "x" else "height"
        offset = _integer(old, f"crop_offset_{axis}", 0)
        size = _integer(old, f"crop_{extent}", old_extent - offset)
        start = min(round(offset * new / old_extent), new - 1)
        end = min(max(round((offset + size) * new / old_extent), start + 1), new)
        film[f"crop_offset_{axis}"], film[f"crop_{extent}"] = start, end - start
    if film["crop_width"] * film["crop_height"] > _MAX_PIXELS:
        raise RequestError(
            f"film: got {film['crop_width']} × {film['crop_height']} pixels, wanted at most {_MAX_PIXELS} in all"
        )
    if "sample_border" in old:
        film["sample_border"] = old["sample_border"]
    for name, index in children_of(state, old, mi.ObjectType.ReconstructionFilter).items():
        film[name] = mi.Properties.ResolvedReference(index)
    spectral_range = _spectral_range(state, old)
    centres = channel_wavelengths(spectral_range)
    step = float(centres[1] - centres[0])
    triangle = 1 - np.abs(np.linspace(-1, 1, 2 * _STEPS_PER_CHANNEL + 1))
    for number, (centre, weight) in enumerate(zip(centres, channel_weights(spectral_range), strict=True)):
        hat = mi.Properties("regular")
        hat["wavelength_min"], hat["wavelength_max"] = float(centre - step), float(centre + step)
        hat["values"] = ", ".join(f"{weight / step * value:.17g}" for value in triangle)
        # Channels are numbered, as the parser refuses names with a dot; films order channels by name.
        film[f"channel_{number:03d}"] = add_child(state, mi.ObjectType.Texture, hat)
    return film


def _spectral_range(state: mi.parser.ParserState, film: mi.Properties) -> SpectralRange:
    """Return the wavelengths from the shortest to the longest of a film's bands if some are not visible, else these."""
    if film.plugin_name() != "specfilm":
        return VISIBLE
    textures = [
        mi.Properties(state.nodes[index].props) for index in children_of(state, film, mi.ObjectType.Texture).values()
    ]
    ranges = [mi.PluginManager.instance().create_object(texture).wavelength_range() for texture in textures]
    tables = [film[name].wavelengths for name in film.keys() if film.type(name) == mi.Properties.Type.Spectrum]  # noqa: SIM118
    ranges += [(min(table), max(table)) for table in tables if len(table)]
    if not ranges:
        return VISIBLE
    first, last = float(min(low for low, _ in ranges)), float(max(high for _, high in ranges))
    if VISIBLE[0] <= first and last <= VISIBLE[1]:
        return VISIBLE
    # Of a narrow line, at least two channels.
    middle, half = (first + last) / 2, max((last - first) / 2, 1.5 * _CHANNEL_STEP)
    return middle - half, middle + half


def _integer(film: mi.Properties, name: str, default: int) -> int:
    value = film.get(name, default)
    if not isinstance(value, int):
        raise RequestError(f"film: {name} is {value!r}, wanted a whole number of pixels")
    return value
