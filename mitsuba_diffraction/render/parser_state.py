"""Access to the state of Mitsuba's parser: children of a plugin, new plugins, files."""

from __future__ import annotations

from pathlib import Path

import mitsuba as mi
import mitsuba.parser


def children_of(
    state: mi.parser.ParserState, props: mi.Properties, kind: mi.ObjectType | None = None
) -> dict[str, int]:
    """Return name → index in the parser's list of the children of a node; if `kind` is given, only of this kind."""
    # Of a copy: reading marks a property as used, and Mitsuba reports unused ones as errors.
    copy, kind_of_reference = mi.Properties(props), mi.Properties.Type.ResolvedReference
    references = [(name, copy[name].index()) for name in copy.keys() if copy.type(name) == kind_of_reference]  # noqa: SIM118
    return {name: index for name, index in references if kind in (None, state.nodes[index].type)}


def add_child(
    state: mi.parser.ParserState, kind: mi.ObjectType, props: mi.Properties
) -> mi.Properties.ResolvedReference:
    """Append a node and return a reference to it for its parent."""
    node = mi.parser.SceneNode()
    node.type = kind
    node.props = props
    state.nodes.append(node)
    return mi.Properties.ResolvedReference(len(state.nodes) - 1)


def resolved_file(name: object) -> Path:
    """Return the path of a file that a scene names."""
    return Path(str(mi.file_resolver().resolve(str(name))))
