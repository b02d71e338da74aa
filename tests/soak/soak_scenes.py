"""Random scenes, judged by the comparison of `mitsuba-diffraction validate SCENE`, with independent seeds.

Each is a file of XML, loaded once for `diffraction_path` and once for Mitsuba's integrator; and twice more, for a frame
after an update of some parameters, with or without a frame before it. A seed gives the same scene. It draws

- one or two gratings: line profiles, crossed ones, skins with a continuum; of metals, dielectrics, with a film, a coat,
  a base, transmission as interface or sheet; bare or in `twosided`, `mask`, `blendbsdf`, `normalmap`, `bumpmap`; turned
  by a number or a texture
- on `rectangle`, `disk`, `sphere`, `cylinder`, `cube`, `ply` and `obj` (a bent sheet with UVs), `instance`,
  `bsplinecurve`, `linearcurve`, `sdfgrid`; some flipped, some under a transform that shears
- a floor, at times a wall that shares its BSDF (which Mitsuba merges), and at times another object: `diffuse` with
  each kind of spectrum and texture, `plastic`, `roughplastic`, `conductor`, `roughconductor`, `dielectric`,
  `roughdielectric`, `thindielectric`, `principled`, `principledthin`, `hair`, `null`, `mask`, `blendbsdf`, `twosided`,
  `normalmap`, `bumpmap`
- one to three lights of several `sampling_weight`s: `area` on each shape and with a texture, `directionalarea`,
  `constant`, `envmap`, `sunsky`, `directional`, `point`, `spot`, `projector`
- `perspective`, at times with a shifted principal point, `thinlens`, `orthographic`; each sampler and filter of
  reconstruction; a crop window; depths from 2 to 6 or no limit, with Russian roulette from 3 or 5.

It draws no participating media, which `path` and `diffraction_path` do not render; no `timed_sunsky`, which no
integrator of Mitsuba 3.9.1 renders in `llvm_ad_spectral`; no `ellipsoids` and `ellipsoidsmesh`, which rays meet from
outside only, so that paths from the light and from the eye have other obstacles (docs/integrators.md).

Lobes are wide, and lamps that are seen in mirrors large, so that `path` converges.
"""

from __future__ import annotations

import functools
import re
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np

import mitsuba_diffraction as md
from mitsuba_diffraction.evaluation.validation.scene_pictures import SceneComparison, compare_scene
from mitsuba_diffraction.render.scene_file import SceneFile

SECONDS = 3.0  # of all pictures of a scene
LONGER = 8  # times as long, of a second look with other seeds
SHAPES = ("rectangle", "disk", "sphere", "cylinder", "cube", "ply", "obj")
OTHER_SHAPES = ("bsplinecurve", "linearcurve", "sdfgrid")


@functools.cache
def spectra(folder: Path) -> dict[str, Path]:
    """Files of spectra with wide lobes, by name; those of skins are continua."""
    surfaces = {
        "blazed": (md.gratings.blazed(2.5, 0.25), 1.5),
        "sinusoid": (md.gratings.sinusoidal(1.6, 0.3), 2.0),
        "crossed": (md.gratings.crossed(2.0, 0.3, samples=64), 1.5),
        "deep": (md.gratings.sinusoidal(3.0, 0.8), 3.0),
        "elaphe": (md.gratings.elaphe_synthetic(8), 1.5),
        "xenopeltis": (md.gratings.xenopeltis_synthetic(8), 2.0),
    }
    files = {}
    for name, (height_field, coherence_length) in surfaces.items():
        files[name] = folder / f"{name}.exr"
        if files[name].exists():
            continue
        # Also inside of glass, where wavelengths are shorter.
        settings = {"coherence_length": coherence_length, "tolerance": 0.02, "wavelengths": (230, 830)}
        md.precompute(height_field, **settings).save(files[name])
    return files


def plugin(tag, kind, *children, name="", **parameters):
    """A plugin in XML: its children, also in XML, and its parameters, whose types are those in Python."""
    tags, inner = {bool: "boolean", int: "integer", float: "float"}, []
    for key, value in parameters.items():
        text = str(value).lower() if isinstance(value, bool) else value
        inner.append(f'<{tags.get(type(value), "string")} name="{key}" value="{text}"/>')
    named = f' name="{name}"' if name else ""
    return f'<{tag} type="{kind}"{named}>{"".join(children)}{"".join(inner)}</{tag}>'


def vector(tag, values, name=""):
    (x, y, z), named = map(float, values), f' name="{name}"' if name else ""
    return f'<{tag}{named} x="{x}" y="{y}" z="{z}"/>'


def to_world(*steps):
    return f'<transform name="to_world">{"".join(steps)}</transform>'


def looking(origin, target, up=(0, 0, 1)):
    of, at, upwards = (", ".join(str(float(x)) for x in point) for point in (origin, target, up))
    return f'<lookat origin="{of}" target="{at}" up="{upwards}"/>'


class RandomScene:
    """The XML of a scene, drawn from a seed; its pictures and meshes are written to a folder."""

    def __init__(self, seed: int, folder: Path, files: dict[str, Path]):
        self.rng, self.folder, self.spectra, self.count = np.random.default_rng(seed), folder, files, 0

    def pick(self, *choices):
        return choices[self.rng.integers(len(choices))]

    def chance(self, probability):
        return bool(self.rng.random() < probability)

    def uniform(self, low, high):
        return float(self.rng.uniform(low, high))

    def place(self, height):
        return [*self.rng.uniform(-0.8, 0.8, 2), height]

    def file(self, name):
        self.count += 1
        return self.folder / f"{self.count}_{name}"

    # ------------------------------------------------------------------ spectra, textures
    def picture(self, values):
        path = self.file("picture.exr")
        mi.Bitmap(np.asarray(values, np.float32)).write(str(path))
        return path

    def numbers(self, name, low, high):
        """A texture of numbers, nearest or bilinear."""
        side = self.pick(2, 4)
        path = self.picture(self.rng.uniform(low, high, (side, side, 1)))
        kind = self.pick("nearest", "bilinear")
        return plugin("texture", "bitmap", name=name, filename=path, raw=True, filter_type=kind)

    def number_or_texture(self, name, low, high):
        if self.chance(0.5):
            return self.numbers(name, low, high)
        return f'<float name="{name}" value="{self.uniform(low, high)}"/>'

    def colour(self, name, scale=1.0, varies=True):
        """A reflectance, or a radiance up to a scale."""
        a, b, c = (self.uniform(0.05, 0.95) * scale for _ in range(3))
        kind = self.pick("grey", "rgb", "number", "table", "uniform", *["bitmap", "checkerboard"] * varies)
        if kind == "uniform":
            return plugin("texture", "uniform", name=name, value=a)
        if kind == "bitmap":
            return plugin("texture", "bitmap", name=name, filename=self.picture(scale * self.rng.random((4, 4, 3))))
        if kind == "checkerboard":
            colours = f'<rgb name="color0" value="{a}"/><rgb name="color1" value="{b}"/>'
            return plugin("texture", "checkerboard", colours, name=name)
        tag = "rgb" if kind in ("grey", "rgb") else "spectrum"
        table = f"360:{a}, 500:{b}, 620:{c}, 830:{b}"
        value = {"grey": self.pick(0.2, 0.5, 1.0) * scale, "rgb": f"{a} {b} {c}", "number": a, "table": table}[kind]
        return f'<{tag} name="{name}" value="{value}"/>'

    def tilted(self):
        angle = np.deg2rad(self.uniform(3, 15))
        rgb = (np.array([np.sin(angle), 0, np.cos(angle)]) + 1) / 2
        return plugin("texture", "bitmap", name="normalmap", filename=self.picture(np.tile(rgb, (2, 2, 1))), raw=True)

    # ------------------------------------------------------------------ BSDFs
    def grating(self):
        kind = self.pick("metal", "metal", "mirror", "glass", "base", "interface", "sheet", "film", "coat")
        transmits = kind in ("interface", "sheet")
        parameters = {
            "metal": {"material": "Al"},
            "mirror": {"material": "none"},
            "glass": {"int_ior": 1.8},
            "film": {"thin_film_ior": 2.0, "thin_film_thickness": 0.15, "int_ior": 1.5},
            "coat": {"coat_ior": 1.5, "material": "Al"},
        }.get(kind, {"int_ior": 1.5})
        if transmits:
            parameters["transmission"] = kind
        parameters["conserve_energy"] = False
        children = [self.receiver("base", nested=True, transmits=False)] * (kind == "base")
        if self.chance(0.4):
            children.append(self.number_or_texture("orientation", 0, 180))
        path = self.spectra[self.pick(*self.spectra)]
        bsdf = plugin("bsdf", "diffraction_grating", *children, filename=path, **parameters)
        return bsdf, transmits

    def surface(self):
        """A grating, perhaps in other BSDFs."""
        bsdf, transmits = self.grating()
        kind = self.pick("bare", "bare", "bare", "twosided", "mask", "blendbsdf", "normalmap", "bumpmap")
        if kind == "twosided" and not transmits:
            return plugin("bsdf", kind, bsdf)
        if kind == "mask":
            return plugin("bsdf", kind, self.number_or_texture("opacity", 0.3, 0.9), bsdf)
        if kind == "blendbsdf":
            other = self.receiver(nested=True, transmits=False)
            if transmits:  # else Mitsuba counts light twice
                other = plugin("bsdf", "twosided", other)
            return plugin("bsdf", kind, self.number_or_texture("weight", 0.2, 0.8), bsdf, other)
        if kind == "normalmap":
            return plugin("bsdf", kind, self.tilted(), bsdf)
        if kind == "bumpmap":
            return plugin("bsdf", kind, self.numbers("arbitrary", 0, 0.3), bsdf)
        return bsdf

    def receiver(self, name="", nested=False, transmits=True):
        """A BSDF of Mitsuba."""
        kinds = ["diffuse"] * 5 + ["plastic", "roughplastic", "conductor", "roughconductor", "principled"]
        if not nested:
            kinds += ["normalmap", "bumpmap", "blendbsdf", "twosided"]
            kinds += ["dielectric", "roughdielectric", "thindielectric", "mask", "null"] * transmits
            kinds += ["principledthin", "hair"] * transmits
        kind, children, parameters = self.pick(*kinds), [], {}
        if kind == "diffuse":
            children = [self.colour("reflectance")] * self.chance(0.9)
        elif kind in ("plastic", "roughplastic"):
            children = [self.colour("diffuse_reflectance")]
        elif kind == "conductor":
            parameters = {"material": "Al"}
        elif kind == "principled":
            children = [self.colour("base_color")]
            parameters = {"roughness": self.uniform(0.3, 0.8), "metallic": self.pick(0.0, 0.5), "clearcoat": 0.3}
        elif kind == "principledthin":
            children = [self.colour("base_color")]
            parameters = {"roughness": self.uniform(0.3, 0.8), "spec_trans": 0.4, "diff_trans": 0.6}
        elif kind == "hair":
            parameters = {"longitudinal_roughness": 0.3, "eumelanin": self.uniform(0.1, 1.0)}
        elif kind == "normalmap":
            children = [self.tilted(), self.receiver(nested=True)]
        elif kind == "bumpmap":
            children = [self.numbers("arbitrary", 0, 0.3), self.receiver(nested=True)]
        elif kind == "blendbsdf":
            inner = [self.receiver(nested=True) for _ in range(2)]
            children = [self.number_or_texture("weight", 0.2, 0.8), *inner]
        elif kind == "twosided":
            children = [self.receiver(nested=True, transmits=False)]
        elif kind == "mask":
            children = [self.number_or_texture("opacity", 0.3, 0.9), self.receiver(nested=True)]
        if kind.startswith("rough"):
            parameters["alpha"] = self.pick(0.3, 0.5)
        return plugin("bsdf", kind, *children, name=name, **parameters)

    # ------------------------------------------------------------------ shapes
    def transform(self, size, height):
        axis = self.rng.normal(size=3)
        if not self.chance(0.2):  # Mitsuba's `rotate` shears if its axis is not of unit length
            axis /= np.linalg.norm(axis)
        scale = size * self.rng.uniform(0.6, 1.4, 3) if self.chance(0.3) else [size] * 3
        rotation = vector("rotate", axis).replace("/>", f' angle="{self.uniform(0, 60)}"/>')
        return to_world(vector("scale", scale), rotation, vector("translate", self.place(height)))

    def bent_sheet(self, kind):
        """A mesh with UVs, as `ply` or `obj`."""
        u, v = np.meshgrid(*[np.linspace(0, 1, 6)] * 2)
        points = np.stack([2 * u - 1, 2 * v - 1, 0.3 * u * (1 - u)], -1)
        k = np.arange(36).reshape(6, 6)
        a, b, c, d = (part.ravel() for part in (k[:-1, :-1], k[:-1, 1:], k[1:, 1:], k[1:, :-1]))
        if kind == "obj":
            path = self.file("sheet.obj")
            lines = ["v {} {} {}".format(*p) for p in points.reshape(-1, 3)]
            lines += [f"vt {x} {y}" for x, y in zip(u.ravel(), v.ravel(), strict=True)]
            lines += ["f {0}/{0} {1}/{1} {2}/{2} {3}/{3}".format(*f) for f in np.stack([a, b, c, d], -1) + 1]
            path.write_text("\n".join(lines))
            return path
        mesh = mi.Mesh("sheet", 36, 50, has_vertex_texcoords=True)
        params = mi.traverse(mesh)
        params["vertex_positions"] = np.float32(points).ravel()
        params["faces"] = np.uint32([np.stack([a, b, c], -1), np.stack([a, c, d], -1)]).ravel()
        params["vertex_texcoords"] = np.float32(np.stack([u, v], -1)).ravel()
        params.update()
        path = self.file("sheet.ply")
        mesh.write_ply(str(path))
        return path

    def curve(self):
        """A curve, and out of sight another: Mitsuba may crash at the end of the last one (docs/integrators.md)."""
        path = self.file("curve.txt")
        seen = "-1 0 0.5 0.15\n0 0 0.8 0.15\n0.5 0.5 0.6 0.15\n1 0.5 0.5 0.15\n1.5 0.7 0.5 0.15\n"
        path.write_text(seen + "\n" + "".join(f"{x} 0 -3 1e-4\n" for x in range(4)))
        return path

    def distances(self):
        """A bent ball, as distances to it on a grid."""
        z, y, x = np.meshgrid(*[np.linspace(-1, 1, 10)] * 3, indexing="ij")
        path = self.file("distances.vol")
        mi.VolumeGrid(np.float32(np.sqrt(x * x + y * y + z * z) - 0.7 + 0.1 * x * y)[..., None]).write(str(path))
        return path

    def shape(self, size, height, *children, kinds=SHAPES):
        kind, parameters, placed = self.pick(*kinds), {}, [self.transform(size, height)]
        if self.chance(0.1):
            parameters["flip_normals"] = True
        if kind in ("ply", "obj"):
            parameters["filename"] = self.bent_sheet(kind)
        elif kind == "sphere":
            placed, parameters["radius"] = [vector("point", self.place(height), "center")], 0.7 * size
        elif kind == "cylinder":
            x, y, z = self.place(height)
            placed = [vector("point", [x - size, y, z], "p0"), vector("point", [x + size, y, z], "p1")]
            parameters["radius"] = 0.5 * size
        elif kind.endswith("curve"):
            placed, parameters = [], {"filename": self.curve()}
        elif kind == "sdfgrid":
            scale, moved = vector("scale", [1.5 * size] * 3), vector("translate", self.place(height))
            placed, parameters = [to_world(scale, moved)], {"filename": self.distances()}
        return plugin("shape", kind, *placed, *children, **parameters)

    def gratings(self):
        found = ""
        for _ in range(self.pick(1, 1, 2)):
            size, height = self.uniform(0.3, 0.8), self.uniform(0.5, 1.2)
            if self.chance(0.1):
                self.count += 1
                group = plugin("shape", "shapegroup", self.shape(size, 0.3, self.surface()))
                found += group.replace("<shape ", f'<shape id="group{self.count}" ', 1)
                found += plugin("shape", "instance", f'<ref id="group{self.count}"/>', self.transform(1.0, height))
            else:
                kinds = OTHER_SHAPES if self.chance(0.25) else SHAPES
                found += self.shape(size, height, self.surface(), kinds=kinds)
        return found

    # ------------------------------------------------------------------ lights
    def light(self, kind, weight):
        position = [self.uniform(-2, 2), self.uniform(-2.5, 1), self.uniform(2.5, 4)]
        look = looking(position, [self.uniform(-0.5, 0.5), self.uniform(-0.5, 0.5), 0.5], (0.1, 1, 0.2))
        of = {} if weight == 1 else {"sampling_weight": weight}
        if kind == "directionalarea":
            facing = to_world(f'<scale value="{self.uniform(0.5, 1.2)}"/>', look)
            emitter = plugin("emitter", kind, self.colour("radiance", 3.0, False), **of)
            return plugin("shape", self.pick("rectangle", "disk"), facing, emitter)
        if kind == "area":
            varies = self.chance(0.3)
            emitter = plugin("emitter", "area", self.colour("radiance", 1.0 if varies else 3.0, varies), **of)
            size = self.uniform(0.5, 1.2)
            if self.chance(0.5):
                facing = to_world(f'<scale value="{size}"/>', look)
                return plugin("shape", self.pick("rectangle", "disk"), facing, emitter)
            bsdf = [self.receiver()] * self.chance(0.2)
            kinds = ("sphere", "cylinder", "cube", "ply")
            return self.shape(size, self.uniform(2.5, 4), *bsdf, emitter, kinds=kinds)
        if kind == "constant":
            return plugin("emitter", kind, self.colour("radiance", 0.3, varies=False), **of)
        if kind == "envmap":
            values = self.rng.uniform(0, 0.2, (16, 32, 3))
            values[2:6, 8:14] = self.uniform(1, 3)
            return plugin("emitter", kind, filename=self.picture(values), **of)
        if kind == "sunsky":  # with a sun so wide that `path` finds it in a grating
            sun = vector("vector", [self.uniform(-1, 1), -0.5, 0.9], "sun_direction")
            scales = {"sun_scale": self.pick(0.0, 0.05), "sky_scale": 0.1, "sun_aperture": 8.0}
            return plugin("emitter", kind, sun, **scales, **of)
        if kind == "directional":
            direction = vector("vector", [self.uniform(-0.6, 0.6), self.uniform(0, 0.6), -0.8], "direction")
            return plugin("emitter", kind, direction, self.colour("irradiance", 1.0, varies=False), **of)
        if kind == "point":
            return plugin(
                "emitter", kind, vector("point", position, "position"), self.colour("intensity", 6.0, False), **of
            )
        if kind == "spot":
            angle = self.uniform(15, 35)
            return plugin(
                "emitter", kind, to_world(look), self.colour("intensity", 8.0, False), cutoff_angle=angle, **of
            )
        picture = plugin("texture", "bitmap", name="irradiance", filename=self.picture(self.rng.random((4, 4, 3))))
        return plugin("emitter", kind, to_world(look), picture, fov=self.uniform(20, 45), **of)

    def lights(self):
        skies = ["constant", "envmap", "sunsky"]
        kinds = ["area", "area", "directionalarea", "directional", "point", "spot", "projector", *skies]
        found = ""
        for number in range(self.pick(1, 1, 2, 3)):
            kind = self.pick(*kinds)
            # A scene draws at least one lamp.
            found += self.light(kind, self.pick(1.0, 1.0, 0.3, 4.0, 0.0 if number else 1.0))
            kinds = [other for other in kinds if kind not in skies or other not in skies]
        return found

    # ------------------------------------------------------------------ sensor, scene
    def sensor(self):
        kind = self.pick("perspective", "perspective", "perspective", "thinlens", "orthographic")
        angle = np.deg2rad(self.uniform(-140, -40))
        steps = [looking([3.5 * np.cos(angle), 3.5 * np.sin(angle), self.uniform(1.2, 4)], [0, 0, 0.5])]
        parameters = {"fov": self.uniform(30, 60)}
        if kind == "orthographic":
            steps, parameters = ['<scale value="1.5"/>', *steps], {}
        elif kind == "thinlens":
            parameters |= {"aperture_radius": 0.15, "focus_distance": 4.0}
        elif self.chance(0.2):
            parameters["principal_point_offset_x"] = self.uniform(-0.2, 0.2)
        size = {"width": 32, "height": 24}
        if self.chance(0.2):
            size |= {"crop_offset_x": 4, "crop_offset_y": 3, "crop_width": 24, "crop_height": 18}
        rfilter = plugin("rfilter", self.pick("box", "tent", "gaussian", "mitchell", "catmullrom", "lanczos"))
        sampler = plugin("sampler", self.pick("independent", "stratified", "multijitter", "orthogonal", "ldsampler"))
        film = plugin("film", "hdrfilm", rfilter, **size)
        return plugin("sensor", kind, to_world(*steps), sampler, film, **parameters)

    def surroundings(self):
        """A floor, and perhaps a wall and another object."""
        floor, of_floor = self.receiver().replace("<bsdf ", '<bsdf id="floor" ', 1), '<ref id="floor"/>'
        found = floor + plugin("shape", "rectangle", to_world('<scale value="4"/>'), of_floor)
        if self.chance(0.6):
            wall = to_world('<rotate x="1" angle="90"/><scale value="4"/><translate y="1.5"/>')
            found += plugin("shape", "rectangle", wall, of_floor if self.chance(0.7) else self.receiver())
        if self.chance(0.4):
            kinds = SHAPES + OTHER_SHAPES
            found += self.shape(self.uniform(0.2, 0.5), self.uniform(0.3, 1.5), self.receiver(), kinds=kinds)
        return found

    def xml(self):
        depths = {"max_depth": self.pick(2, 3, 3, 4, 5, 6, -1), "rr_depth": self.pick(3, 5)}
        parts = [plugin("integrator", "path", **depths), self.sensor()]
        parts += [self.surroundings(), self.gratings(), self.lights()]
        return '<scene version="3.0.0">\n' + "\n".join(parts) + "\n</scene>\n"


def scene_of(seed: int, folder: Path, files: dict[str, Path]) -> Path:
    """Write the scene of a seed; return its file."""
    folder = folder / f"scene{seed}"
    folder.mkdir(exist_ok=True)
    path = folder / "scene.xml"
    path.write_text(RandomScene(seed, folder, files).xml())
    return path


def _is_path(path: Path) -> bool:
    """Whether `diffraction_path` traces a scene by `path`."""
    scene = SceneFile(path).load()
    return scene.integrator().parts(scene, scene.sensors()[0])[0] is scene.integrator().path


# Ends of the names of parameters, and what an update makes of their values.
UPDATES = {
    "radiance.value": lambda value: 0.3 * value,
    "intensity.value": lambda value: 3.0 * value,
    "irradiance.value": lambda value: 3.0 * value,
    "reflectance.value": lambda value: 0.5 * value,
    "sampling_weight": lambda value: 4.0 * value,
    "height_scale": lambda value: 0.6 * value,
    "orientation.value": lambda value: value + 30.0,
    "to_world": lambda value: mi.Transform4f().translate([0.1, -0.05, 0.15]) @ value,
}


def update(scene: mi.Scene, seed: int) -> list[str]:
    """Change one to three parameters of a scene; return their names.

    They are chosen by their position: names of objects without an id are addresses, and differ between loads.
    """
    rng, parameters = np.random.default_rng(seed), mi.traverse(scene)
    known = [(key, end) for key in parameters.keys() for end in UPDATES if f".{key}".endswith(f".{end}")]  # noqa: SIM118
    chosen = [known[k] for k in rng.permutation(len(known))[: rng.integers(1, 4)]]
    for name, end in chosen:
        parameters[name] = UPDATES[end](parameters[name])
    parameters.update()
    return [re.sub(r"\d{6,}", "", name) for name, _ in chosen]


def judge_update(seed: int, path: Path) -> None:
    """Compare a frame after an update with that of the scene loaded anew, where no frame came before the update."""
    frames, names = [], []
    for has_frame_before in (True, False):
        scene = SceneFile(path).load()
        if has_frame_before:
            mi.render(scene, spp=1, seed=7)
        names.append(update(scene, seed))
        frames.append(np.array(mi.render(scene, spp=4, seed=8)))
    found, wanted = frames
    assert names[0] == names[1], f"{path}: updates of {names}"
    # Positions may differ by rounding, by which a few paths meet another surface.
    same = np.isclose(found, wanted, rtol=1e-3, atol=1e-4 * np.abs(wanted).max()).mean()
    assert found.shape == wanted.shape, f"{path}: update of {names[0]}"
    assert same > 0.97, f"{path}: update of {names[0]}: {same:.2f} of the pixels are those of a scene loaded anew"


def judge_scene(seed: int, folder: Path, files: dict[str, Path]) -> SceneComparison:
    """Compare the pictures of a scene; again, longer and with other seeds, if they differ.

    The reference may miss rare bright paths, and then underestimates its own error.

    Raises:
        AssertionError: if the scene differs both times, or after an update, with the file that was written.
    """
    mi.set_variant("llvm_ad_spectral")
    path = scene_of(seed, folder, files)
    judge_update(seed, path)
    found = compare_scene(SceneFile(path), seconds=SECONDS)
    if not found.difference.is_noise and found.reference == "prb" and _is_path(path):
        return found  # with the fault of `path` behind null interactions
    if not found.difference.is_noise:
        found = compare_scene(SceneFile(path), seconds=LONGER * SECONDS, first_seed=100)
    dr.flush_malloc_cache()
    assert found.difference.is_noise, f"{path}: {found}"
    return found
