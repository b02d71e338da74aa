"""Mitsuba 3.9.1: a mesh that `merge_meshes` makes has no bounding box; for a report to its developers.

    python tools/merged_meshes.py

prints the radiance of a white floor beside a wall, lit by the half of a sky that the wall does not hide: 0.25, and more
where the shapes are merged. `Scene::bbox` holds the sphere alone, and shadow rays to the sky end before the wall.
"""

import mitsuba as mi
import numpy as np

mi.set_variant("scalar_rgb")
turned = mi.ScalarTransform4f().translate([0, 2, 0]).rotate([1, 0, 0], 90).scale(1e3)
view = mi.ScalarTransform4f().look_at([0, 0, 1], [0, 0, 0], [0, 1, 0])
film = {"type": "hdrfilm", "width": 8, "height": 8, "rfilter": {"type": "box"}}
scene = {
    "type": "scene",
    "sensor": {"type": "perspective", "fov": 1, "to_world": view, "film": film},
    "integrator": {"type": "direct"},
    "floor": {"type": "rectangle", "bsdf": {"type": "diffuse", "id": "both"}},
    "wall": {"type": "rectangle", "to_world": turned, "bsdf": {"type": "ref", "id": "both"}},
    "ball": {"type": "sphere", "center": [0, -2, 0.1], "radius": 0.1},
    "sky": {"type": "constant"},
}
for optimize in (True, False):
    loaded = mi.load_dict(scene, optimize=optimize)
    print(f"optimize={optimize}: {np.mean(mi.render(loaded, spp=4096)):.4f}; {loaded.bbox()}")
