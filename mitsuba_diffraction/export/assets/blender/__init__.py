"""Blender's extension "Diffraction Gratings": materials of discs, foil, film, skins and line gratings."""

from __future__ import annotations

import os
from typing import Any

import bpy
import numpy as np

from . import line_gratings, nodes, scripts

_TABLES = os.path.join(os.path.dirname(__file__), "tables")
_READY = {
    "compact_disc": "Compact disc",
    "dvd": "DVD",
    "foil": "Embossed foil",
    "xenopeltis": "Skin of Xenopeltis",
    "elaphe": "Skin of Elaphe",
    "film": "Diffraction film",
}
_SHEETS = ("film",)  # transparent and without a coat; nodes alone
_STAR = "star"
_FURTHER = {_STAR: "Holographic star", **line_gratings.PROFILES}
_FILE = "file"
_MEDIA = {"own": "Its own", "Al": "Aluminium", "Ag": "Silver", "Au": "Gold", "Cu": "Copper", "index": "Glass, skin"}


def _items(names: dict[str, str]) -> tuple[tuple[str, str, str], ...]:
    return tuple((key, name, "") for key, name in names.items())


class DiffractionSettings(bpy.types.PropertyGroup):
    """What the panel asks for."""

    surface: bpy.props.EnumProperty(  # type: ignore[valid-type]
        name="Surface", items=_items({**_READY, **_FURTHER, _FILE: "From a file…"})
    )
    file: bpy.props.StringProperty(  # type: ignore[valid-type]
        name="File", subtype="FILE_PATH", description="NAME.npz, or NAME.osl, of mitsuba-diffraction export -o"
    )
    exact: bpy.props.BoolProperty(  # type: ignore[valid-type]
        name="Exact Colours (OSL)", description="A script, which Cycles runs on the CPU and OptiX alone"
    )
    medium: bpy.props.EnumProperty(name="Material", items=_items(_MEDIA))  # type: ignore[valid-type]
    index: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Refractive Index", default=1.5, min=1.01, max=4.0, precision=3
    )
    period: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Period (µm)", default=1.667, min=0.4, max=50.0, precision=3
    )
    depth: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Depth (µm)", default=0.15, min=0.0, max=2.0, precision=3
    )
    coat: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Coat Index", default=1.0, min=1.0, max=2.5, precision=3, description="Of a clear layer over it; 1 is none"
    )
    duty: bpy.props.FloatProperty(  # type: ignore[valid-type]
        name="Duty", default=0.5, min=0.01, max=0.99, description="Width of the ridges relative to the period"
    )

    @property
    def script(self) -> str | None:
        """The file of the OSL shader, if there is one and it is wanted."""
        if self.surface == _FILE:
            return bpy.path.abspath(self.file) if self.file.endswith(".osl") else None
        return os.path.join(_TABLES, f"{self.surface}.osl") if self.exact and self.has_script else None

    @property
    def has_script(self) -> bool:
        """Whether the extension holds an OSL shader of the surface."""
        return self.surface in _READY and self.surface not in _SHEETS

    def tables(self) -> dict[str, np.ndarray]:
        """Return the tables of the surface.

        Raises:
            ValueError, OSError: if the file does not have them.
        """
        if self.surface == _FILE:
            tables = nodes.read_tables(bpy.path.abspath(self.file))
        elif self.surface in _FURTHER:
            base = nodes.read_tables(os.path.join(_TABLES, "foil.npz"))
            profile = "sinusoidal" if self.surface == _STAR else self.surface
            tables = line_gratings.line_grating(profile, self.period, self.depth, self.duty, base)
        else:
            tables = nodes.read_tables(os.path.join(_TABLES, f"{self.surface}.npz"))
        if self.surface in _SHEETS or self.medium == "index":
            tables["index"] = np.full(len(tables["index"]), self.index, np.complex128)
        elif self.medium != "own":
            tables["index"] = np.load(os.path.join(_TABLES, "metals.npz"))[self.medium]
        tables["coat"] = np.array(1.0 if self.surface in _SHEETS else self.coat)
        return tables


class MATERIAL_OT_diffraction_create(bpy.types.Operator):
    """Give the active object a new material that diffracts light"""

    bl_idname = "material.diffraction_create"
    bl_label = "Create Material"
    bl_options = {"REGISTER", "UNDO"}  # noqa: RUF012  (Blender's)

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return context.object is not None and hasattr(context.object.data, "materials")

    def execute(self, context: bpy.types.Context) -> set[str]:
        settings = context.scene.diffraction
        name = settings.bl_rna.properties["surface"].enum_items[settings.surface].name
        if settings.surface == _FILE:
            name = os.path.splitext(os.path.basename(settings.file))[0]
        try:
            if script := settings.script:
                material, group = scripts.script_material(name, script)
                context.scene.cycles.shading_system = True
            else:
                material, group = nodes.new_material(name, settings.tables())
        except (OSError, ValueError) as error:
            what = error.strerror if isinstance(error, OSError) and error.strerror else error
            self.report({"ERROR"}, f"{settings.file or name}: {what}")
            return {"CANCELLED"}
        if settings.surface in ("compact_disc", "dvd"):
            group.inputs["Radial"].default_value = True if script is None else 1
        if settings.surface == _STAR:
            nodes.add_star(material.node_tree, group)
        if getattr(context.object.data, "uv_layers", None):
            tangent = material.node_tree.nodes.new("ShaderNodeTangent")
            tangent.direction_type = "UV_MAP"
            tangent.location = (-220, -120)
            material.node_tree.links.new(tangent.outputs[0], group.inputs["Tangent"])
        if context.object.material_slots:
            context.object.active_material = material
        else:
            context.object.data.materials.append(material)
        return {"FINISHED"}


class MATERIAL_PT_diffraction(bpy.types.Panel):
    """The panel in Material Properties."""

    bl_label = "Diffraction Grating"
    bl_space_type = "PROPERTIES"
    bl_region_type = "WINDOW"
    bl_context = "material"

    @classmethod
    def poll(cls, context: bpy.types.Context) -> bool:
        return MATERIAL_OT_diffraction_create.poll(context)

    def draw(self, context: bpy.types.Context) -> None:
        settings, layout = context.scene.diffraction, self.layout
        layout.use_property_split = True
        layout.prop(settings, "surface")
        if settings.surface == _FILE:
            layout.prop(settings, "file")
        elif settings.surface in _FURTHER:
            layout.prop(settings, "period")
            layout.prop(settings, "depth")
            if settings.surface == "lamellar":
                layout.prop(settings, "duty")
        elif settings.has_script:
            layout.prop(settings, "exact")
        if settings.surface in _SHEETS:
            layout.prop(settings, "index")
        elif settings.script is None:
            layout.prop(settings, "medium")
            if settings.medium == "index":
                layout.prop(settings, "index")
            layout.prop(settings, "coat")
        layout.operator(MATERIAL_OT_diffraction_create.bl_idname, icon="MATERIAL")
        material: Any = context.object.active_material
        if material and material.node_tree and (group := material.node_tree.nodes.get("Diffraction")):
            for socket in group.inputs:
                if not socket.is_linked and not socket.hide_value:
                    layout.prop(socket, "default_value", text=socket.name)


_CLASSES = (DiffractionSettings, MATERIAL_OT_diffraction_create, MATERIAL_PT_diffraction)


def register() -> None:
    for each in _CLASSES:
        bpy.utils.register_class(each)
    bpy.types.Scene.diffraction = bpy.props.PointerProperty(type=DiffractionSettings)


def unregister() -> None:
    del bpy.types.Scene.diffraction
    for each in reversed(_CLASSES):
        bpy.utils.unregister_class(each)
