"""Pictures of numbers in a scene, such as heights and weights: in spectral variants with the values of RGB variants."""

from __future__ import annotations

import mitsuba as mi
import mitsuba.parser

from .parser_state import add_child, children_of, resolved_file

_OF_ANY_NAME = {"bumpmap", "normalmap"}
_NUMBERS = {
    *("opacity", "weight", "alpha", "alpha_u", "alpha_v", "roughness", "anisotropic", "metallic", "spec_trans"),
    *("diff_trans", "spec_tint", "sheen", "sheen_tint", "clearcoat", "clearcoat_gloss", "flatness", "theta", "delta"),
}
"""Parameters of Mitsuba's BSDFs that are numbers, and may be textures."""


def read_numbers(config: mi.parser.ParserConfig, state: mi.parser.ParserState) -> None:
    """Replace coloured pictures in the place of numbers by linear ones, with `raw`, without which Mitsuba stops.

    RGB variants take the luminance of a picture, or three numbers, after removing its gamma; spectral ones turn colours
    into spectra, which have none, and end in "eval_1(): … raw=false" while a picture is traced.
    """
    mi.parser.transform_resolve(config, state)
    for index in range(len(state.nodes)):
        if state.nodes[index].type != mi.ObjectType.BSDF:
            continue
        # A copy, as adding nodes invalidates references to them; textures may be those of colours, too.
        props = mi.Properties(state.nodes[index].props)
        for name, child in children_of(state, props, mi.ObjectType.Texture).items():
            is_number = name in _NUMBERS or props.plugin_name() in _OF_ANY_NAME
            if is_number and (linear := _linear(state.nodes[child].props)) is not None:
                props[name] = add_child(state, mi.ObjectType.Texture, linear)
        state.nodes[index].props = props


def _linear(texture: mi.Properties) -> mi.Properties | None:
    """Return the properties of a coloured bitmap without gamma and conversion to spectra; None of other textures."""
    props = mi.Properties(texture)
    if props.plugin_name() != "bitmap" or props.get("raw", False) or "filename" not in props:
        return None
    path = str(resolved_file(props["filename"]))
    bitmap = mi.Bitmap(path)
    if bitmap.pixel_format() not in (mi.Bitmap.PixelFormat.RGB, mi.Bitmap.PixelFormat.RGBA):
        return None
    props.set_id("")
    del props["filename"]
    # Made anew for each scene, which alters it.
    props["bitmap"] = bitmap.convert(mi.Bitmap.PixelFormat.RGB, mi.Struct.Type.Float32, srgb_gamma=False)
    props["raw"] = True
    return props
