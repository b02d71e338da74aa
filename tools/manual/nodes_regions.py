"""Compares nodes or the OSL shader in Cycles with diffraction_path, by bright regions, for a table in docs/blender.md.

    python tools/manual/nodes_regions.py .npz|.osl SAMPLES [WORKING_SPACE [NAME ...]]

$BLENDER_PYTHON is a Python with bpy (cycles_picture.py); NAME is one of `SCENES`. Of each region it prints the fraction
of the light, the luminance relative to that of diffraction_path, ΔE00, and ΔE00 of the nearest colour of the working
space.
"""

import os
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
from scipy import ndimage
from scipy.optimize import minimize

import mitsuba_diffraction  # noqa: F401  (before Mitsuba)
from mitsuba_diffraction.export.working_spaces import WORKING_SPACES
from mitsuba_diffraction.optics.color import SRGB_TO_XYZ, XYZ_to_linear_sRGB, delta_E, radiance_to_XYZ

SIZE, RADIUS, PASSES, PASS = 96, 0.15, 4, 512
WAVELENGTHS = np.arange(390, 721, 10.0)
METAL = {"material": "Al"}
SCENES = {
    "sinusoid": ("plane", {"profile": "sinusoidal", "period": 1.6, "depth": 0.15, "coherence_length": 30.0, **METAL}),
    "blaze": ("disc", {"profile": "blazed", "period": 1.9, "depth": 0.2, "coherence_length": 30.0, **METAL}),
    "disc": ("disc", {"profile": "compact_disc", "coherence_length": 30.0, **METAL}),
    "foil": ("sphere", {"profile": "foil", "coherence_length": 12.0, **METAL}),
    "skin": ("sphere", {"profile": "xenopeltis_synthetic"}),
    "film": ("pane", {"profile": "film", "int_ior": 1.5, "transmission": "sheet"}),
}


def path_traced(shape, parameters):
    """XYZ by `diffraction_path`, of the wavelengths that the shader draws, (SIZE, SIZE, 3)."""
    import mitsuba as mi

    mi.set_variant("llvm_ad_spectral")
    to = mi.ScalarTransform4f()
    film = {"type": "specfilm", "width": SIZE, "height": SIZE, "rfilter": {"type": "box"}}
    for number, w in enumerate(WAVELENGTHS.tolist()):
        film[f"band_{number:03d}"] = {"type": "spectrum", "value": [(w - 10, 0.0), (w, 0.1), (w + 10, 0.0)]}
    around = {"orientation": "radial"} if shape == "disc" else {}
    lamp = {"type": "area", "radiance": {"type": "d65", "scale": 100.0}}
    above, below = to.translate([0, -1, 3]).rotate([1, 0, 0], 180), to.translate([0, -1, -3])
    place = (below if shape == "pane" else above).scale(RADIUS)
    camera = to.look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    scene = mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "diffraction_path", "max_depth": 2},
            "camera": {"type": "perspective", "fov": 40, "to_world": camera, "film": film},
            "shape": {
                "type": "sphere" if shape == "sphere" else "rectangle",
                "bsdf": {"type": "diffraction_grating", **parameters, **around},
            },
            "lamp": {"type": "disk", "to_world": place, "emitter": lamp},
        }
    )
    spectra = sum(np.array(mi.render(scene, spp=PASS, seed=seed)) for seed in range(PASSES)) / PASSES
    return radiance_to_XYZ(spectra.reshape(-1, len(WAVELENGTHS)), WAVELENGTHS).reshape(SIZE, SIZE, 3)


def in_cycles(suffix, shape, parameters, samples, space):
    """XYZ by Cycles, (SIZE, SIZE, 3)."""
    with tempfile.TemporaryDirectory() as folder:
        shader, out = Path(folder, f"grating{suffix}"), Path(folder, "grating.npy")
        profile, *values = [f"{name}={value}" for name, value in parameters.items()]
        surface = ",".join([profile.removeprefix("profile="), *values])
        subprocess.run(["mitsuba-diffraction", "export", surface, "-o", str(shader)], check=True)
        script = Path(__file__).with_name("cycles_picture.py")
        words = [os.environ["BLENDER_PYTHON"], script, shader, shape, RADIUS, samples, SIZE, out]
        words += [space] if space != "Linear Rec.709" else []
        subprocess.run([str(word) for word in words], check=True, stdout=subprocess.DEVNULL)
        return np.load(out) @ (SRGB_TO_XYZ @ np.linalg.inv(WORKING_SPACES[space])).T


def difference(first, second):
    """ΔE00 of two colours at the same luminance."""
    return float(delta_E(0.4 * first / first[1], 0.4 * second / second[1]))


def bound(wanted, space):
    """ΔE00 of the nearest colour of a working space."""
    of_space = WORKING_SPACES[space] @ XYZ_to_linear_sRGB(wanted)
    if of_space.min() >= 0:
        return 0.0
    to_XYZ = SRGB_TO_XYZ @ np.linalg.inv(WORKING_SPACES[space])
    start = np.log(np.maximum(of_space, 0.01 * of_space.max()))
    return minimize(lambda x: difference(wanted, to_XYZ @ np.exp(x)), start, method="Nelder-Mead").fun


def main(suffix, samples, space="Linear Rec.709", *names):
    for name in names or SCENES:
        wanted, found = path_traced(*SCENES[name]), in_cycles(suffix, *SCENES[name], samples, space)
        luminance = wanted[..., 1]
        labels, count = ndimage.label(ndimage.maximum_filter(luminance > 0.02 * luminance.max(), 3))
        light = ndimage.sum(luminance, labels, range(1, count + 1)) / luminance.sum()
        for k in np.flatnonzero(light > 0.03 * light.sum()) + 1:
            of, by = (picture[labels == k].mean(axis=0) for picture in (wanted, found))
            errors = f"{by[1] / of[1]:.3f}, {difference(of, by):.1f}, {bound(of, space):.1f}"
            print(f"{name}: {light[k - 1]:.2f} of the light: {errors}", flush=True)


if __name__ == "__main__":
    main(*sys.argv[1:])
