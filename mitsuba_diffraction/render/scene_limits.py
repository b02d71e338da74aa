"""Limits of scenes, which may come from strangers: Mitsuba's parser and its objects recurse until the stack is full."""

from __future__ import annotations

import html
import re
from collections.abc import Iterator, Mapping
from pathlib import Path

import mitsuba as mi
import mitsuba.parser

from ..errors import RequestError
from ..files.reading import MAX_NESTING, read_bytes
from .parser_state import children_of, resolved_file

MAX_INCLUDES = 1000  # of a scene, those of included files among them
MAX_VALUE = 2**16  # characters of a parameter whose value contains others

_FOLLOWED = {"default", "path", "include"}  # elements that decide which files are included

# Every alternative matches up to the end of a damaged file, so that none is tried twice.
_MARKUP = re.compile(
    rb"<!--.*?(?:-->|\Z)|<!\[CDATA\[.*?(?:\]\]>|\Z)|<\?.*?(?:\?>|\Z)|<!(?P<other>\w*)|</(?P<end>)"
    rb"""|<(?P<element>[^"'>]*(?:(?:"[^"]*"?|'[^']*'?)[^"'>]*)*)>?""",
    re.DOTALL,
)
_ATTRIBUTE = re.compile(r"""(?<![\w:.-])([\w:.-]+)\s*=\s*(?:"([^"]*)"|'([^']*)')""")


def check_nesting(path: Path, parameters: Mapping[str, str]) -> None:
    """Check the levels of elements of a scene and the files that it includes, before Mitsuba parses them.

    Folders of `<path value="…"/>` are searched in `mi.file_resolver()`, which the caller replaces.

    Raises:
        RequestError: if elements are nested in more than `MAX_NESTING` others, there are more than `MAX_INCLUDES`
            includes, a file has a document type, or a parameter has a value of more than `MAX_VALUE`.
    """
    values, before, includes = dict(parameters), mi.file_resolver(), 0
    folders = mi.FileResolver(before)
    mi.set_file_resolver(folders)
    try:
        # Of the file that is read and of those that include it: folder, the rest of its elements, level of its root.
        stack = [(path.parent, _elements(read_bytes(path)), 0)]
        while stack:
            folder, elements, base = stack[-1]
            if (found := next(elements, None)) is None:
                stack.pop()
                continue
            level, name, attributes = found
            if base + level > MAX_NESTING:
                raise RequestError(f"got more than {MAX_NESTING} levels of nested elements, wanted fewer")
            attributes = {key: _substituted(value, values) for key, value in attributes.items()}
            if name == "default" and {"name", "value"} <= attributes.keys():
                values.setdefault(attributes["name"], attributes["value"])
            elif name == "path" and "value" in attributes:
                beside = folder / attributes["value"]
                folders.prepend(str(beside if beside.exists() else resolved_file(attributes["value"])))
            elif name == "include" and (included := resolved_file(attributes.get("filename", ""))).is_file():
                if (includes := includes + 1) > MAX_INCLUDES:
                    raise RequestError(f"got more than {MAX_INCLUDES} includes, wanted fewer")
                stack.append((included.parent, _elements(read_bytes(included)), base + level))
    finally:
        mi.set_file_resolver(before)


def _elements(content: bytes) -> Iterator[tuple[int, str, dict[str, str]]]:
    """Yield level, name and, of those in `_FOLLOWED`, attributes of the elements of XML, which may be damaged.

    Not by a strict parser: Mitsuba accepts what is no valid XML, such as "--" in comments.
    """
    level = 0
    for found in _MARKUP.finditer(content):
        if found["end"] is not None:
            level -= 1
        elif (other := found["other"]) is not None:
            raise RequestError(f"got XML with <!{other[:20].decode(errors='replace')}, wanted elements and comments")
        elif (element := found["element"]) is not None:
            level += 1
            text = element.decode(errors="replace")
            tag = re.match(r"[^\s/]*", text)
            name = tag[0] if tag else ""
            found_here = _ATTRIBUTE.findall(text) if name in _FOLLOWED else ()
            yield level, name, {key: html.unescape(one or two) for key, one, two in found_here}
            level -= text.endswith("/")


def _substituted(text: str, values: Mapping[str, str]) -> str:
    """Return a text with the values of its parameters, longest names first, as Mitsuba replaces them."""
    for name in sorted(values, key=len, reverse=True) if "$" in text else ():
        if len(text) + text.count(f"${name}") * len(values[name]) > MAX_VALUE:
            raise RequestError(f"got a value of more than {MAX_VALUE} characters with its parameters, wanted fewer")
        text = text.replace(f"${name}", values[name])
    return text


def check_depth(state: mi.parser.ParserState) -> None:
    """Check the levels of objects in objects of a scene whose references are resolved.

    Raises:
        RequestError: if there are more than `MAX_NESTING`.
    """
    children = [set(children_of(state, node.props).values()) for node in state.nodes]
    level, depth = {0}, 0
    while level := set().union(*(children[index] for index in level)):
        if (depth := depth + 1) > MAX_NESTING:
            raise RequestError(f"got more than {MAX_NESTING} levels of objects that contain others, wanted fewer")
