"""A material of an OSL shader, which is kept inside of the .blend with its compiled code: exact colours, on CPU and
OptiX alone.
"""

from __future__ import annotations

import hashlib
import os
import tempfile

import bpy

from .nodes import INPUTS, finished


def script_material(name: str, path: str) -> tuple[bpy.types.Material, bpy.types.ShaderNode]:
    """Return a material of a shader that `mitsuba-diffraction export -o NAME.osl` wrote, and its node.

    Raises:
        ValueError: if it is another file, or does not compile.
        OSError: if it cannot be read.
    """
    try:
        with open(path, encoding="utf-8") as file:
            source = file.read()
    except UnicodeDecodeError:
        source = ""
    if not source.startswith("// mitsuba_diffraction output"):
        raise ValueError("not a shader of mitsuba-diffraction export -o NAME.osl")
    text = bpy.data.texts.new(os.path.basename(path))
    text.write(source)
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    material.node_tree.nodes.clear()
    script = material.node_tree.nodes.new("ShaderNodeScript")
    script.mode = "INTERNAL"
    script.script = text
    _compile(script, source)
    return finished(material, script)


def _compile(script: bpy.types.ShaderNode, source: str) -> None:
    """Give a node the code, its hash, without which Cycles does not take it, and the sockets of `INPUTS`."""
    import _cycles

    with tempfile.TemporaryDirectory() as folder:
        written, compiled = (os.path.join(folder, f"shader{suffix}") for suffix in (".osl", ".oso"))
        with open(written, "w", encoding="utf-8") as file:
            file.write(source)
        if not _cycles.osl_compile(written, compiled):
            raise ValueError("the shader does not compile")
        with open(compiled, encoding="utf-8") as file:
            script.bytecode = file.read()
    script.bytecode_hash = hashlib.md5(script.bytecode.encode(), usedforsecurity=False).hexdigest()
    script.inputs.clear()
    script.outputs.clear()
    for label, kind, value, _, _ in INPUTS:
        kind = "NodeSocketInt" if kind == "NodeSocketBool" else kind
        socket = script.inputs.new(kind, label)
        socket.default_value = type(value)(value) if kind != "NodeSocketInt" else int(value)
        socket.hide_value = label == "Tangent"
    script.outputs.new("NodeSocketShader", "BSDF")
