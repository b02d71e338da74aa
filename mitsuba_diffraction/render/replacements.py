"""Gratings in the place of BSDFs of a scene, by their id."""

from __future__ import annotations

import logging
from collections.abc import Mapping

import mitsuba as mi
import mitsuba.parser

from ..bsdf.diffraction_grating import check
from ..errors import RequestError
from ..precomputation.recipe import theory_in
from .parser_state import add_child, children_of, resolved_file

_log = logging.getLogger(__name__)


Replacements = Mapping[str, Mapping[str, bool | float | str]]
"""Id of a BSDF → parameters of the grating that replaces it."""


# Of BSDFs; `principled` has `spec_trans`.
_TRANSMITTING = {"dielectric", "roughdielectric", "thindielectric", "principledthin", "null"}


def check_replacements(replacements: Replacements) -> None:
    """Raise RequestError if a parameter of a grating is wrong, before a spectrum is computed for any of them."""
    for name, values in replacements.items():
        try:
            check(_grating(values))
        except RequestError as error:
            raise RequestError(f"material {name}: {error}") from None


def warn_of_unused_replacements(state: mi.parser.ParserState, replacements: Replacements) -> None:
    """Log a warning for each grating that replaces a BSDF to which nothing in the scene refers."""
    # Follow references from all objects of the scene except its BSDFs.
    waiting = [k for k in children_of(state, state.root.props).values() if state.nodes[k].type != mi.ObjectType.BSDF]
    used = set()
    while waiting:
        used.add(node := waiting.pop())
        waiting += [child for child in children_of(state, state.nodes[node].props).values() if child not in used]
    for name in replacements:
        if state.id_to_index[name] not in used:
            _log.warning("material %s: no shape uses the BSDF with that id, so the picture is unaffected", name)


def replace_bsdfs(state: mi.parser.ParserState, replacements: Replacements) -> None:
    """Replace BSDFs by gratings; see `SceneFile`."""
    bsdfs = {node.props.id(): k for k, node in enumerate(state.nodes) if node.type == mi.ObjectType.BSDF}
    for name, values in replacements.items():
        if name not in bsdfs:
            known = ", ".join(sorted(filter(None, bsdfs))) or "none: its BSDFs have no ids"
            raise RequestError(f"material: got the id {name!r}, the ids of BSDFs in the scene are {known}")
        try:
            replaced = _with_grating(state, bsdfs[name], values)
        except RequestError as error:
            raise RequestError(f"material {name}: {error}") from None
        replaced.set_id(name)
        state.nodes[bsdfs[name]].props = replaced


def _with_grating(state: mi.parser.ParserState, index: int, values: Mapping[str, bool | float | str]) -> mi.Properties:
    """Return a BSDF without id in which gratings replace the BSDFs that hold no others; a nested `null` remains.

    BSDFs that others in the scene may refer to are copied.
    """
    # A copy, as adding nodes invalidates references to them.
    props = mi.Properties(state.nodes[index].props)
    props.set_id("")
    inner = {} if props.plugin_name() == "diffraction_grating" else children_of(state, props, mi.ObjectType.BSDF)
    parts = {
        key: _with_grating(state, k, values) for key, k in inner.items() if state.nodes[k].props.plugin_name() != "null"
    }
    if parts:
        if props.plugin_name() == "twosided" and values.get("transmission", "none") != "none":
            return next(iter(parts.values()))
        for key, part in parts.items():
            props[key] = add_child(state, mi.ObjectType.BSDF, part)
        return props
    grating = _grating(values)
    if _has_base(values):
        if _transmits(props):
            raise RequestError(
                "got a dielectric in the place of a BSDF that transmits light, wanted transmission=sheet or "
                "interface, a metal (material=Al), or base=none"
            )
        grating["base"] = add_child(state, mi.ObjectType.BSDF, props)
    return grating


def _grating(values: Mapping[str, bool | float | str]) -> mi.Properties:
    """Return the properties of a grating with these parameters."""
    grating = mi.Properties("diffraction_grating")
    for key, value in values.items():
        if (key, value) != ("base", "none"):
            grating[key] = value
    return grating


def _has_base(values: Mapping[str, bool | float | str]) -> bool:
    """Return whether a BSDF can lie below a grating, and none is given: below a dielectric, in scalar theory."""
    if {"material", "base"} & values.keys() or values.get("transmission", "none") != "none":
        return False
    path = resolved_file(values.get("filename", ""))
    return "rigorous" not in (values.get("theory"), theory_in(path) if path.is_file() else "scalar")


def _transmits(props: mi.Properties) -> bool:
    """Return whether a BSDF that holds no other transmits light."""
    return props.plugin_name() in _TRANSMITTING or mi.Properties(props).get("spec_trans", 0.0) != 0
