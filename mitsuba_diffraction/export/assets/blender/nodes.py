"""A node group of Blender's own shader nodes that diffracts light, for every device of Cycles.

Each sample draws a wavelength and an order by White Noise of its position, and returns one Glossy lobe about the half
vector of the direction from which light of that order comes; a sheet adds one of transmitted light. Needs bpy and NumPy
alone; lengths are in µm, frequencies in cycles/µm. `tables` are the arrays of `mitsuba-diffraction export SURFACE -o
NAME.npz`, and may have `coat`, the index of a clear layer over the relief.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import bpy
import numpy as np

_FORMAT = 1  # of the tables
_LIGHTS = 1024  # slots, of which each bin of wavelengths has as many as is its probability
_LUMINANCE, _WEIGHT_OF_RGB = np.array([0.2, 0.7, 0.1]), 0.5  # in that probability; of luminance it is 1
_SLOTS_OF_ORDER, _MIN_SLOTS, _MAX_SLOTS = 12, 256, 4096
_DIRECTIONS, _SECTORS_OF_AZIMUTH, _HEIGHTS = 4, 4, 16  # of cos θ_o, ω_o and h/λ; each has probabilities of its own
_COSINES = 64  # of the reflectance
_MIN_ROUGHNESS = 0.05  # a lobe of no width meets small lamps by chance alone
_AZIMUTHS, _ALBEDO_COSINES = 25, 16
_REFRACTION = 4.0  # an index that deflects light up to 75°
_SECTORS, _RINGS, _STAR_TURN = 12, 6.0, 5.0  # of a star; turns of the pattern for one around the axis

INPUTS: tuple[tuple[str, str, Any, tuple[float, float] | None, str], ...] = (
    ("HeightScale", "NodeSocketFloat", 1.0, (0.0, 2.0), "Factor of the heights"),
    ("Orientation", "NodeSocketFloat", 0.0, (-360.0, 360.0), "Degrees from the tangent to the x axis of the pattern"),
    ("Radial", "NodeSocketBool", False, None, "The tangent points away from the object's z axis, as on a disc"),
    ("Tangent", "NodeSocketVector", (0.0, 0.0, 0.0), None, "Of the pattern; unconnected: the object's x axis"),
    ("Roughness", "NodeSocketFloat", 1.0, (0.0, 100.0), "Factor of the width of the orders"),
    ("Tint", "NodeSocketColor", (1.0, 1.0, 1.0, 1.0), None, "Factor of all colours"),
    ("BaseColor", "NodeSocketColor", (0.0, 0.0, 0.0, 1.0), None, "Diffuse colour below a dielectric"),
)


def read_tables(path: str) -> dict[str, np.ndarray]:
    """Return the tables of a file.

    Raises:
        ValueError: if it is another file, or of another version.
        OSError: if it cannot be read.
    """
    try:
        with np.load(path, allow_pickle=False) as read:
            tables = dict(read)
        known = int(tables["format"])
    except OSError:
        raise
    except Exception:
        raise ValueError("not tables of mitsuba-diffraction export -o NAME.npz") from None
    if known != _FORMAT:
        raise ValueError(f"tables of format {known}; this version reads format {_FORMAT}")
    return tables


def working_space() -> str:
    """Return the working space of the file that is open, in Blender's words."""
    colorspace = getattr(bpy.data, "colorspace", None)  # since 5.0; one space before
    return "Linear Rec.709" if colorspace is None else colorspace.working_space


def new_material(name: str, tables: Mapping[str, np.ndarray]) -> tuple[bpy.types.Material, bpy.types.ShaderNode]:
    """Return a material of these tables, and its group."""
    tree = node_group(name, tables)
    material = bpy.data.materials.new(name)
    material.use_nodes = True
    material.node_tree.nodes.clear()
    group = material.node_tree.nodes.new("ShaderNodeGroup")
    group.node_tree = tree
    return finished(material, group)


def finished(
    material: bpy.types.Material, node: bpy.types.ShaderNode
) -> tuple[bpy.types.Material, bpy.types.ShaderNode]:
    """Return a material with the output of a node as its surface, and the node."""
    node.name = node.label = "Diffraction"
    node.width = 220
    output = material.node_tree.nodes.new("ShaderNodeOutputMaterial")
    output.location = (320, 0)
    material.node_tree.links.new(node.outputs["BSDF"], output.inputs["Surface"])
    return material, node


def add_star(tree: bpy.types.NodeTree, group: bpy.types.ShaderNode) -> None:
    """Turn the pattern by sectors around the z axis of the object, as in a holographic star."""
    add = _Nodes(tree)
    at = add.components(add.node("ShaderNodeTexCoord").outputs["Object"])
    turns = add.multiply(add.math("ARCTAN2", at[1], at[0]), _SECTORS / (2 * np.pi))
    distance = add.math("SQRT", add.add(add.multiply(at[0], at[0]), add.multiply(at[1], at[1])))
    # Facets of the points of the star, which meet at ridges, and rings between them.
    within = add.math("ABSOLUTE", add.subtract(add.math("FRACT", turns), 0.5))
    ring = add.math("FLOOR", add.multiply(distance, _RINGS, add.add(0.6, within)))
    step = add.add(add.math("FLOOR", turns), add.multiply(ring, 0.5))
    add.put(group.inputs["Orientation"], add.multiply(step, 360.0 / _SECTORS * _STAR_TURN))


def node_group(name: str, tables: Mapping[str, np.ndarray]) -> bpy.types.NodeTree:
    """Return a new group of these tables.

    Raises:
        ValueError: if they have no powers for the shortest wavelength inside the coat, or for the working space.
    """
    coat, max_scale = float(tables.get("coat", 1.0)), float(tables["max_height_scale"])
    if coat > 1 and tables.get("sheet"):
        raise ValueError(f"got a coat of index {coat:.3g}; a sheet that transmits light has none")
    if coat > max_scale * (1 + 1e-6):
        raise ValueError(f"got a coat of index {coat:.3g}; these tables are for one of up to {max(max_scale, 1):.3g}")
    tree = bpy.data.node_groups.new(name, "ShaderNodeTree")
    for label, kind, value, limits, tip in INPUTS:
        socket = tree.interface.new_socket(label, in_out="INPUT", socket_type=kind)
        socket.default_value = value
        socket.description = tip
        socket.hide_value = label == "Tangent"
        if limits:
            socket.min_value, socket.max_value = limits
        if label == "HeightScale":
            socket.max_value = max_scale / coat
    tree.interface.new_socket("BSDF", in_out="OUTPUT", socket_type="NodeSocketShader")
    _Grating(tree, name, tables).build()
    return tree


class _Nodes:
    """Adds nodes to a tree; sockets and numbers are operands."""

    def __init__(self, tree: bpy.types.NodeTree) -> None:
        self.tree = tree

    def node(self, kind: str, **settings: Any) -> Any:
        node = self.tree.nodes.new(kind)
        for key, value in settings.items():
            setattr(node, key, value)
        number = len(self.tree.nodes)
        node.location = (number * 40 % 2400, -(number * 40 // 2400) * 300)
        node.hide = True
        return node

    def put(self, socket: Any, value: Any) -> None:
        if isinstance(value, bpy.types.NodeSocket):
            self.tree.links.new(value, socket)
        else:
            socket.default_value = value

    def math(self, operation: str, *operands: Any) -> Any:
        node = self.node("ShaderNodeMath", operation=operation)
        for socket, value in zip(node.inputs, operands):  # noqa: B905  (of three sockets, often one is not used)
            self.put(socket, value)
        return node.outputs[0]

    def vector(self, operation: str, *operands: Any) -> Any:
        node = self.node("ShaderNodeVectorMath", operation=operation)
        for k, value in enumerate(operands):
            self.put(node.inputs["Scale"] if operation == "SCALE" and k else node.inputs[k], value)
        return node.outputs["Value" if operation in ("DOT_PRODUCT", "LENGTH") else "Vector"]

    def add(self, a: Any, b: Any) -> Any:
        return self.math("ADD", a, b)

    def subtract(self, a: Any, b: Any) -> Any:
        return self.math("SUBTRACT", a, b)

    def multiply(self, first: Any, *others: Any) -> Any:
        for other in others:
            first = self.math("MULTIPLY", first, other)
        return first

    def divide(self, a: Any, b: Any) -> Any:
        return self.math("DIVIDE", a, b)

    def larger(self, a: Any, b: Any) -> Any:
        return self.math("MAXIMUM", a, b)

    def smaller(self, a: Any, b: Any) -> Any:
        return self.math("MINIMUM", a, b)

    def dot(self, a: Any, b: Any) -> Any:
        return self.vector("DOT_PRODUCT", a, b)

    def scaled(self, a: Any, factor: Any) -> Any:
        return self.vector("SCALE", a, factor)

    def sum(self, first: Any, *others: Any) -> Any:
        for other in others:
            first = self.vector("ADD", first, other)
        return first

    def difference(self, a: Any, b: Any) -> Any:
        return self.vector("SUBTRACT", a, b)

    def normalised(self, a: Any) -> Any:
        return self.vector("NORMALIZE", a)

    def between(self, factor: Any, a: Any, b: Any) -> Any:
        """Return the vector a for the factor 0, b for 1."""
        node = self.node("ShaderNodeMix", data_type="VECTOR")
        sockets = {socket.identifier: socket for socket in (*node.inputs, *node.outputs)}
        for name, value in (("Factor_Float", factor), ("A_Vector", a), ("B_Vector", b)):
            self.put(sockets[name], value)
        return sockets["Result_Vector"]

    def combined(self, x: Any, y: Any, z: Any = 0.0) -> Any:
        node = self.node("ShaderNodeCombineXYZ")
        for socket, value in zip(node.inputs, (x, y, z), strict=True):
            self.put(socket, value)
        return node.outputs[0]

    def components(self, a: Any) -> Any:
        node = self.node("ShaderNodeSeparateXYZ")
        self.put(node.inputs[0], a)
        return node.outputs[:3]

    def table(self, image: bpy.types.Image, u: Any, v: Any = None, interpolation: str = "Closest") -> Any:
        """Return the colour and the alpha of an image at (u, v), or of one row at u; outside of it, at its edge."""
        node = self.node("ShaderNodeTexImage", interpolation=interpolation, extension="EXTEND")
        node.image = image
        self.put(node.inputs["Vector"], u if v is None else self.combined(u, v))
        return node.outputs["Color"], node.outputs["Alpha"]

    def number(self, image: bpy.types.Image, u: Any, v: Any = None) -> Any:
        """Return a number between those of an image."""
        return self.table(image, u, v, "Linear")[1]

    def texel(self, x: Any, count: int, last: float = 1.0) -> Any:
        """Return the coordinate in an image of `count` numbers, the first for x = 0, the last for x = `last`."""
        return self.math("MULTIPLY_ADD", x, (count - 1) / count / last, 0.5 / count)

    def random(self, position: Any) -> Any:
        """Return three random numbers; the position of a sample is never twice the same."""
        node = self.node("ShaderNodeTexWhiteNoise", noise_dimensions="4D")
        self.put(node.inputs["Vector"], position)
        node.inputs["W"].default_value = 0.5
        return self.components(node.outputs["Color"])


class _Grating(_Nodes):
    def __init__(self, tree: bpy.types.NodeTree, name: str, tables: Mapping[str, np.ndarray]) -> None:
        super().__init__(tree)
        self.name, self.tables = name, tables
        self.orders = "frequencies" in tables
        self.coat = float(tables.get("coat", 1.0))
        self.dielectric = bool((tables["index"].imag == 0).all() and (tables["index"].real > 0).all())
        self.sheet = self.dielectric and bool(tables.get("sheet", False))

    def image(self, what: str, values: np.ndarray) -> bpy.types.Image:
        """Return a packed float image of (rows, columns) numbers, or of 4 channels."""
        if values.ndim == 2:
            values = np.repeat(values[:, :, None], 4, axis=2)
        height, width = values.shape[:2]
        image = bpy.data.images.new(f"{self.name} {what}", width, height, alpha=True, float_buffer=True, is_data=True)
        image.colorspace_settings.name = "Non-Color"
        image.alpha_mode = "CHANNEL_PACKED"
        image.use_half_precision = False
        image.pixels.foreach_set(np.ascontiguousarray(values, np.float32).ravel())
        image.update()
        image.pack()
        return image

    def build(self) -> None:
        tables = self.tables
        inputs = self.node("NodeGroupInput").outputs
        geometry = self.node("ShaderNodeNewGeometry").outputs
        position, normal, to_camera = geometry["Position"], geometry["Normal"], geometry["Incoming"]
        behind, outside = geometry["Backfacing"], normal
        if self.sheet:  # seen from behind, Blender's normal is the other one
            outside = self.scaled(normal, self.math("MULTIPLY_ADD", behind, -2.0, 1.0))
        x, y = self.tangents(inputs, outside)
        random = self.random(position)

        # The wavelength, its colour, and the direction from which light of the order comes.
        lights = _lights(tables, self.space())
        of_light = random[0]
        colour, wavelength = self.table(self.image("lights", lights[None]), of_light)
        u_o, v_o, c_o = (self.dot(to_camera, axis) for axis in (x, y, normal))
        c_o = self.larger(c_o, 0.0)
        of_heights = self.divide(inputs["HeightScale"], wavelength)
        azimuth = self.math("ARCTAN2", v_o, u_o)
        q_x, q_y, width_x, width_y, u_power, chance = self.drawn(random[1:], of_heights, azimuth, c_o)
        step_x, step_y = self.multiply(wavelength, q_x), self.multiply(wavelength, q_y)
        u, v = (self.math("MULTIPLY_ADD", wavelength, *each) for each in ((q_x, u_o), (q_y, v_o)))  # of −ω_i
        # Blender's root of a negative number is 0, and so is a quotient by 0: no weight where a cosine is 0.
        c_i = self.math("SQRT", self.subtract(1.0, self.math("MULTIPLY_ADD", u, u, self.multiply(v, v))))
        added = self.scaled(normal, self.add(c_i, c_o))  # ω_i + ω_o
        added = self.difference(self.difference(added, self.scaled(x, step_x)), self.scaled(y, step_y))
        half = self.normalised(added)

        # Its weight: R K G E and the power at κ over the probability; cosines are those in the coat times its index.
        coat = self.coat
        true_c_i, true_c_o, c_i, c_o = c_i, c_o, self.inside(c_i), self.inside(c_o)
        w = self.add(c_i, c_o)
        powers, slices = self.image("powers", tables["powers"].T), tables["powers"].shape[1]

        def power_at(w: Any, powers: bpy.types.Image) -> Any:
            kappa = self.multiply(of_heights, w)
            return self.number(powers, u_power, self.texel(kappa, slices, float(tables["max_kappa"]) / (2 * np.pi)))

        power = power_at(w, powers)
        length = self.vector("LENGTH", added if coat == 1 else self.combined(step_x, step_y, w))
        # K G = min(1, a / (4 min(c_i, c_o))) a / max(c_i, c_o)
        a = self.divide(self.multiply(length, length), w)
        shadowed = self.smaller(self.multiply(self.divide(a, self.smaller(c_i, c_o)), 0.25), 1.0)
        k_g = self.divide(self.multiply(shadowed, a), self.larger(c_i, c_o))
        index = np.interp(lights[:, 3].reshape(-1, 16).mean(axis=1), _middle(tables), tables["index"]) / coat
        reflectances = self.image("reflectance", _reflectances(index))
        reflectance = self.number(reflectances, of_light, self.texel(length, _COSINES, 2 * coat))
        factors = 1 / np.maximum(self.albedos(), 1.0)
        e = self.number(
            self.image("E", factors),
            self.texel(c_o, factors.shape[1], coat),
            self.math("MULTIPLY_ADD", azimuth, (1 - 1 / len(factors)) / (2 * np.pi), 0.5),
        )
        weight = self.multiply(power, chance, k_g, reflectance, e)
        if coat > 1:
            faces = self.image("coat", _reflectances(np.full(1, coat)).T)
            at_front, at_back = (self.number(faces, self.texel(c, _COSINES)) for c in (true_c_o, true_c_i))
            entering = self.subtract(1.0, at_front)
            weight = self.multiply(weight, entering, self.subtract(1.0, at_back))

        # The lobe: slopes of facets along the difference of the directions and across, or along x and y of a cell.
        slope = self.multiply(self.larger(inputs["Roughness"], _MIN_ROUGHNESS), wavelength)
        alpha_x = self.divide(self.multiply(slope, width_x), true_c_i)
        alpha_y = self.divide(self.multiply(slope, width_y), self.vector("LENGTH", added) if coat > 1 else length)
        along = x
        if self.orders:  # at the mirror direction any axis does
            along = self.sum(self.difference(added, self.scaled(to_camera, 2.0)), self.scaled(x, 1e-4))
        tinted = self.vector("MULTIPLY", colour, inputs["Tint"])
        shaded = self.lobe(self.scaled(tinted, weight), alpha_x, alpha_y, half, along)
        if self.sheet:
            mirrored = self.sum(to_camera, self.scaled(normal, self.multiply(true_c_i, 2.0)))
            to_other = self.difference(added, mirrored)
            square_step = self.math("MULTIPLY_ADD", step_x, step_x, self.multiply(step_y, step_y))
            gain, w = self.refracted(self.exchanged(behind, true_c_i, c_o), square_step, reflectances, of_light)
            transmitted = power_at(w, self.image("transmitted powers", _transmitted(tables).T))
            width = self.divide(self.multiply(slope, 2.0, width_x), self.math("SQRT", true_c_i))
            of_sheet = self.refraction(to_camera, to_other, width, behind)
            self.put(of_sheet.inputs["Color"], self.scaled(tinted, self.multiply(gain, transmitted, chance)))
            shaded = self.both(shaded, of_sheet)
        elif self.dielectric:
            into_base = self.subtract(1.0, self.number(reflectances, of_light, self.texel(c_o, _COSINES, coat)))
            diffuse = self.node("ShaderNodeBsdfDiffuse")
            factor = self.multiply(into_base, _entering(index), entering if coat > 1 else 1.0)
            self.put(diffuse.inputs["Color"], self.scaled(inputs["BaseColor"], factor))
            shaded = self.both(shaded, diffuse)
        if coat > 1:
            front = self.node("ShaderNodeBsdfAnisotropic", distribution="GGX")
            self.put(front.inputs["Color"], self.combined(at_front, at_front, at_front))
            front.inputs["Roughness"].default_value = 0.0
            shaded = self.both(shaded, front)
        self.put(self.node("NodeGroupOutput").inputs["BSDF"], shaded)

    def lobe(self, colour: Any, alpha_x: Any, alpha_y: Any, normal: Any, tangent: Any) -> Any:
        """Return the shader of a lobe of these widths along the tangent and across."""
        # Blender's anisotropy a makes slopes of ratio (1 - a)², narrower along the tangent for a > 0.
        root_x, root_y = (self.math("SQRT", self.smaller(alpha, 0.7)) for alpha in (alpha_x, alpha_y))
        node = self.node("ShaderNodeBsdfAnisotropic", distribution="BECKMANN")
        self.put(node.inputs["Color"], colour)
        self.put(node.inputs["Roughness"], self.math("SQRT", self.multiply(root_x, root_y)))
        difference = self.subtract(root_y, root_x)
        self.put(node.inputs["Anisotropy"], self.divide(difference, self.larger(root_x, root_y)))
        self.put(node.inputs["Normal"], normal)
        self.put(node.inputs["Tangent"], tangent)
        return node.outputs[0]

    def exchanged(self, factor: Any, a: Any, b: Any) -> tuple[Any, Any]:
        """Return a and b for the factor 0, b and a for 1."""
        change = self.multiply(factor, self.subtract(b, a))
        return self.add(a, change), self.subtract(b, change)

    def refracted(
        self, cosines: tuple[Any, Any], square_step: Any, reflectances: bpy.types.Image, of_light: Any
    ) -> tuple[Any, Any]:
        """Return what both faces of a sheet transmit, without the power of the order, and w.

        Args:
            cosines: outside, at the flat face and at the relief.
            square_step: |λq|².
            reflectances: by wavelength and cosine.
            of_light: coordinate of the wavelength.
        """
        flat, relief = cosines
        excess = float(np.median(self.tables["index"].real)) ** 2 - 1
        inside = self.math("SQRT", self.math("MULTIPLY_ADD", flat, flat, excess))
        w = self.subtract(inside, relief)
        square = self.add(square_step, self.multiply(w, w))
        of_facet = self.larger(self.subtract(excess, square), 0.0)  # 0: no facet refracts one direction into the other
        a_flat = self.divide(self.add(square, excess), self.multiply(inside, 2.0))
        a_relief = self.divide(of_facet, self.multiply(relief, 2.0))
        larger = self.larger(a_flat, a_relief)
        g = self.smaller(self.divide(self.multiply(square, 4.0), self.multiply(larger, larger)), 1.0)
        k = self.divide(self.multiply(a_flat, a_relief), self.multiply(w, w))
        at_facet = self.smaller(self.divide(of_facet, self.multiply(self.math("SQRT", square), 2.0)), 1.0)
        lost = (self.number(reflectances, of_light, self.texel(c, _COSINES)) for c in (flat, at_facet))
        return self.multiply(k, g, *(self.subtract(1.0, each) for each in lost)), w

    def refraction(self, to_camera: Any, to_light: Any, width: Any, behind: Any) -> Any:
        """Return a lobe of this width, √2 σ, which refracts one direction into another on the other face."""
        across = self.sum(to_camera, self.scaled(to_light, _REFRACTION))
        length = self.vector("LENGTH", across)
        deflected = self.math("MULTIPLY_ADD", self.dot(to_camera, to_light), 1.0, _REFRACTION)
        stretched = self.multiply(self.math("SQRT", self.divide(deflected, length)), self.divide(_REFRACTION, length))
        lobe = self.node("ShaderNodeBsdfRefraction", distribution="BECKMANN")
        exponent = self.math("MULTIPLY_ADD", behind, -2.0, 1.0)  # Cycles inverts the index there
        self.put(lobe.inputs["IOR"], self.math("POWER", _REFRACTION, exponent))
        alpha = self.smaller(self.larger(self.multiply(width, stretched), 1e-4), 0.7)
        self.put(lobe.inputs["Roughness"], self.math("SQRT", alpha))
        self.put(lobe.inputs["Normal"], self.scaled(across, self.divide(-1.0, length)))
        return lobe

    def inside(self, cosine: Any) -> Any:
        """Return the index of the coat times the cosine in it of a direction of this cosine outside."""
        if self.coat == 1:
            return cosine
        return self.math("SQRT", self.math("MULTIPLY_ADD", cosine, cosine, self.coat**2 - 1))

    def both(self, shaded: Any, other: Any) -> Any:
        """Return the sum of a shader and that of a node."""
        node = self.node("ShaderNodeAddShader")
        self.put(node.inputs[0], shaded)
        self.put(node.inputs[1], other.outputs[0])
        return node.outputs[0]

    def space(self) -> int:
        names = list(map(str, self.tables["spaces"]))
        if (space := working_space()) not in names:
            raise ValueError(f"the working space of this file is {space}, wanted one of {', '.join(names)}")
        return names.index(space)

    def tangents(self, inputs: Any, normal: Any) -> tuple[Any, Any]:
        """Return the x and y axes of the pattern."""

        def in_world(a: Any) -> Any:
            node = self.node(
                "ShaderNodeVectorTransform", vector_type="VECTOR", convert_from="OBJECT", convert_to="WORLD"
            )
            self.put(node.inputs["Vector"], a)
            return node.outputs[0]

        at = self.components(self.node("ShaderNodeTexCoord").outputs["Object"])
        given = self.math("GREATER_THAN", self.vector("LENGTH", inputs["Tangent"]), 0.0)
        tangent = self.between(given, in_world((1.0, 0.0, 0.0)), inputs["Tangent"])
        tangent = self.between(inputs["Radial"], tangent, in_world(self.combined(at[0], at[1])))
        tangent = self.normalised(self.difference(tangent, self.scaled(normal, self.dot(normal, tangent))))
        turned = self.math("RADIANS", inputs["Orientation"])
        across = self.vector("CROSS_PRODUCT", normal, tangent)
        x = self.sum(self.scaled(tangent, self.math("COSINE", turned)), self.scaled(across, self.math("SINE", turned)))
        return x, self.vector("CROSS_PRODUCT", normal, x)

    def drawn(self, random: Any, of_heights: Any, azimuth: Any, c_o: Any) -> tuple[Any, Any, Any, Any, Any, Any]:
        """Return q, √½ and √2 of its widths, the coordinate of its powers, and one over its probability.

        Args:
            random: two numbers.
            of_heights: h/λ.
            azimuth: of ω_o, rad.
            c_o: cos θ_o, outside of the coat.
        """
        of_order, along_y = random
        count, width = len(self.tables["powers"]), float(self.tables["lobe_width"]) * 0.5**0.5
        if self.orders:
            largest = float(self.tables["max_kappa"]) / (4 * np.pi * self.coat)
            height = self.smaller(self.multiply(of_heights, 1 / largest), 1 - 1e-4)
            sectors = _SECTORS_OF_AZIMUTH
            direction = self.math("FLOOR", self.multiply(c_o, _DIRECTIONS * (1 - 1e-6)))
            turns = self.math("MULTIPLY_ADD", azimuth, sectors * (0.5 - 1e-6) / np.pi, 0.5 * sectors)
            sector = self.math("FLOOR", turns)
            row = self.add(self.math("MULTIPLY_ADD", direction, float(sectors), sector), height)
            row = self.multiply(row, 1 / (_DIRECTIONS * sectors))
            values, chance = self.table(self.image("orders", _orders(self.tables)), of_order, row)
            q_x, q_y, u_power = self.components(values)
            return q_x, q_y, width, 2 * width, u_power, chance
        rows, columns = self.tables["rows"], self.tables["columns"]
        low, high = (np.repeat(edges, columns.shape[1] - 1) for edges in (rows[:-1], rows[1:]))
        left = columns[:, :-1].ravel()
        cells = np.stack([left, low, columns[:, 1:].ravel() - left, high - low], axis=-1)
        below = self.math("SNAP", of_order, 1 / count)
        along_x = self.multiply(self.subtract(of_order, below), float(count))
        values, size_y = self.table(self.image("cells", cells[None]), of_order)
        left, low, size_x = self.components(values)
        return (
            self.math("MULTIPLY_ADD", size_x, along_x, left),
            self.math("MULTIPLY_ADD", size_y, along_y, low),
            self.larger(self.multiply(size_x, 0.35 * 0.5**0.5), width),
            self.larger(self.multiply(size_y, 0.35 * 2**0.5), 2 * width),
            self.add(below, 0.5 / count),
            1.0,
        )

    def albedos(self) -> np.ndarray:
        """Return what a perfect mirror would reflect, by azimuth of ω_o and cos θ_o."""
        if not self.orders:
            return self.tables["albedo"].mean(axis=0)
        return _albedos_of_orders(self.tables)


def _middle(tables: Mapping[str, np.ndarray]) -> np.ndarray:
    return (tables["edges"][1:] + tables["edges"][:-1]) / 2


def _shared(weights: np.ndarray, slots: int) -> np.ndarray:
    """Return the entry that each slot has; an entry has slots in proportion to its weight, and at least one."""
    numbers = 1 + weights / weights.sum() * (slots - len(weights))
    return np.minimum(np.searchsorted(np.cumsum(numbers), np.arange(slots) + 0.5), len(weights) - 1)


def _lights(tables: Mapping[str, np.ndarray], space: int) -> np.ndarray:
    """Return colours and wavelengths of equal probability, (slots, 4)."""
    colours, edges = tables["colours"][space], tables["edges"]
    luminance, strength = colours @ _LUMINANCE, np.linalg.norm(colours, axis=1)
    light = _shared(luminance / luminance.mean() + _WEIGHT_OF_RGB * strength / strength.mean(), _LIGHTS)
    numbers = np.bincount(light)
    bounds = np.append(0, np.cumsum(numbers))
    wavelengths = np.interp(np.arange(_LIGHTS) + 0.5, bounds, edges)
    weights = _LIGHTS / len(colours) / numbers[light]
    return np.column_stack([colours[light] * weights[:, None], wavelengths])


def _orders(tables: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return (rows, slots, 4): q_x, q_y, the coordinate of the powers, one over the probability of the order.

    A row is of one cos θ_o, azimuth of ω_o and h/λ, of which the last varies fastest. There the probability of an order
    is that of its reflected or, for a sheet, transmitted light, a mean over wavelengths and directions.
    """
    coat, count = float(tables.get("coat", 1.0)), len(tables["powers"])
    slots = int(np.clip(_SLOTS_OF_ORDER * count, _MIN_SLOTS, _MAX_SLOTS))
    within = np.ix_(np.array([0.25, 0.75]), (np.arange(8) + 0.5) / 8, _middle(tables)[4::10] / coat, np.zeros(1))
    if tables.get("sheet"):
        tables = {**tables, "powers": _transmitted(tables)}
    shape = (_DIRECTIONS, _SECTORS_OF_AZIMUTH, _HEIGHTS)
    rows = np.empty((*shape, slots, 4))
    for direction, sector, height in np.ndindex(shape):
        c_o = np.sqrt(1 - (1 - ((direction + within[0]) / _DIRECTIONS) ** 2) / coat**2)
        azimuth = ((sector + within[1]) / _SECTORS_OF_AZIMUTH * 2 - 1) * np.pi
        kappa_1 = (height + 0.5) / _HEIGHTS * float(tables["max_kappa"]) / 2
        light = _of_orders(tables, azimuth, c_o, within[2], kappa_1, np.sqrt(1 - coat**-2)).mean(axis=(0, 1, 2))
        order = _shared(light + 1e-9, slots)
        chances = slots / np.bincount(order)[order]
        rows[direction, sector, height] = np.column_stack(
            [tables["frequencies"][order], (order + 0.5) / count, chances]
        )
    return rows.reshape(-1, slots, 4)


def _of_orders(
    tables: Mapping[str, np.ndarray], azimuth: Any, c_o: Any, wavelength: np.ndarray, kappa_1: Any, min_c_i: float
) -> np.ndarray:
    """Return the power of each order times K G, along the last axis, or, of a sheet, the transmitted powers.

    Args:
        azimuth: of ω_o, rad, as all with a last axis of 1.
        c_o: cos θ_o, inside the coat as the wavelength.
        wavelength: µm.
        kappa_1: κ over cos θ_i + cos θ_o.
        min_c_i: cos θ_i inside the coat, below which there is no light.
    """
    q, sine = tables["frequencies"], np.sqrt(1 - c_o**2)
    u_i, v_i = sine * np.cos(azimuth) + wavelength * q[:, 0], sine * np.sin(azimuth) + wavelength * q[:, 1]
    square = 1 - u_i**2 - v_i**2
    c_i = np.sqrt(np.maximum(square, 1e-8))
    if tables.get("sheet"):
        excess = float(np.median(tables["index"].real)) ** 2 - 1
        pairs = ((c_i, c_o), (c_o, c_i))  # at the flat face and the relief, seen from in front and from behind
        steps = (np.sqrt(flat**2 + excess) - relief for flat, relief in pairs)
        light = sum(_between(tables["powers"], kappa_1 * w / tables["max_kappa"]) for w in steps)
    else:
        w = c_i + c_o
        square_v = wavelength**2 * (q**2).sum(axis=1) + w**2
        k_g = square_v**2 / (4 * c_i * c_o * w**2) * np.minimum(1, 4 * w * np.minimum(c_i, c_o) / square_v)
        light = k_g * _between(tables["powers"], kappa_1 * w / tables["max_kappa"])
    return light * (square > max(min_c_i**2, 1e-8))


def _between(powers: np.ndarray, coordinate: np.ndarray) -> np.ndarray:
    """Return the powers of orders, along the last axis, at κ relative to its maximum."""
    count, slices = powers.shape
    at = np.clip(coordinate, 0, 1) * (slices - 1)
    below = np.minimum(at.astype(int), slices - 2)
    order = np.arange(count)
    return powers[order, below] * (1 - at + below) + powers[order, below + 1] * (at - below)


def _transmitted(tables: Mapping[str, np.ndarray]) -> np.ndarray:
    """Return the powers of the orders at −κ, which are those of −q at κ."""
    q = tables["frequencies"]
    return tables["powers"][[np.argmin(((q + each) ** 2).sum(axis=1)) for each in q]]


def _albedos_of_orders(tables: Mapping[str, np.ndarray]) -> np.ndarray:
    wavelength = _middle(tables)[::4, None] / float(tables.get("coat", 1.0))
    albedo = np.zeros((_AZIMUTHS, _ALBEDO_COSINES))
    for j, i in np.ndindex(albedo.shape):
        c_o, azimuth = max(i / (_ALBEDO_COSINES - 1), 0.02), (2 * j / (_AZIMUTHS - 1) - 1) * np.pi
        light = _of_orders({**tables, "sheet": np.array(False)}, azimuth, c_o, wavelength, 2 * np.pi / wavelength, 0.0)
        albedo[j, i] = light.sum(axis=1).mean()
    return albedo


def _reflectances(index: np.ndarray) -> np.ndarray:
    """Return the mean reflectance of both polarisations, (cosines, bins); an index of 0 is the perfect mirror."""
    cosine = np.maximum(np.linspace(0, 1, _COSINES), 1e-6)[:, None]
    root = np.sqrt(index.astype(complex) ** 2 - 1 + cosine**2)
    s = (cosine - root) / (cosine + root)
    mirror = index == 0
    square = np.where(mirror, 1, index.astype(complex) ** 2)
    p = (square * cosine - root) / (square * cosine + root)
    return np.where(mirror, 1.0, (np.abs(s) ** 2 + np.abs(p) ** 2) / 2)


def _entering(index: np.ndarray) -> float:
    """Return the fraction of diffuse light that enters a dielectric."""
    cosine = np.linspace(0, 1, _COSINES)
    reflectance = _reflectances(index).mean(axis=1) * 2 * cosine
    return 1 - float(((reflectance[1:] + reflectance[:-1]) / 2).mean())
