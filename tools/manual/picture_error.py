"""Draw docs/picture_error.png: the error of pictures of a compact disc under a lamp against their time.

    python tools/manual/picture_error.py docs/picture_error.png

The disc is rendered by `diffraction_path`, by `path`, and as a rough conductor in place of the grating, in turn and in
one process. The references are by `path`. The error is the root of Σ(c − c_ref)²/Σ c_ref² of linear sRGB on the disc;
the mean CIEDE2000 is printed, too. Points are medians over seeds, bands reach from the lowest to the highest.
"""

from __future__ import annotations

import sys
import time

import mitsuba_diffraction  # noqa: F401  before Dr.Jit

import mitsuba as mi  # isort: skip  (after LLVM has been chosen)
import numpy as np
from matplotlib.figure import Figure
from matplotlib.ticker import FuncFormatter, LogLocator, NullFormatter
from numpy.typing import NDArray

from mitsuba_diffraction.evaluation.benchmark.noise import load_for_noise
from mitsuba_diffraction.files.outputs import METADATA
from mitsuba_diffraction.files.writing import examples_folder, whole_file
from mitsuba_diffraction.optics.color import XYZ_to_linear_sRGB, radiance_to_XYZ
from mitsuba_diffraction.progress import progress_bar, say
from mitsuba_diffraction.render.passes import split
from mitsuba_diffraction.render.scene import shows_gratings
from mitsuba_diffraction.render.spectral_film import channel_wavelengths
from mitsuba_diffraction.render.sums import Accumulation
from mitsuba_diffraction.render.trace_pass import pass_seed, trace_pass
from mitsuba_diffraction.shader_2014.comparison.difference import difference, white_luminance

Array = NDArray[np.float64]

WIDTH, DEPTH = 96, 2
COUNTS, SEEDS = (16, 64, 256), 7
REFERENCES = {"path": 12288, "roughconductor": 2048}  # samples
ROUGH = {"type": "roughconductor", "material": "Al", "alpha": 0.08}
KINDS = {  # label → what stands in place of the grating, integrator, colour
    "path": (None, "path", "#c0392b"),
    "diffraction_path": (None, "diffraction_path", "#1f5fa8"),
    "roughconductor": (ROUGH, "path", "#777777"),
}


def picture(scene: mi.Scene, samples: int, seed: int) -> tuple[Array, float]:
    """Return XYZ of a picture, (rows, columns, 3), and seconds of processor time."""
    columns, rows = scene.sensors()[0].film().crop_size()
    sums = Accumulation.empty(rows, columns)
    begin = time.process_time()
    for index, some in enumerate(split(scene, samples)):
        sums.add(trace_pass(scene, some, pass_seed(seed, index)), some)
    return radiance_to_XYZ(sums.radiance(), channel_wavelengths()), time.process_time() - begin


def errors(reference: Array, xyz: Array, where: NDArray[np.bool_]) -> tuple[float, float]:
    """Return the relative r.m.s. error of linear sRGB and the mean CIEDE2000 where the disc is."""
    wanted, rgb = (XYZ_to_linear_sRGB(one[where]) for one in (reference, xyz))
    relative = np.sqrt(((rgb - wanted) ** 2).sum() / (wanted**2).sum())
    return float(relative), difference(reference, xyz, where, white_luminance(reference, where)).mean


def measure() -> dict[str, Array]:
    """Return seconds, relative errors and mean CIEDE2000 of each kind, (3, seeds, counts)."""
    path = examples_folder() / "scenes" / "compact_disc.xml"
    scenes = {
        kind: load_for_noise(path, WIDTH, partner, type=integrator, max_depth=DEPTH)
        for kind, (partner, integrator, _) in KINDS.items()
    }
    where = shows_gratings(scenes["diffraction_path"])
    references = {kind: picture(scenes[kind], count, 1000)[0] for kind, count in REFERENCES.items()}
    references["diffraction_path"] = references["path"]
    found = {kind: np.zeros((3, SEEDS, len(COUNTS))) for kind in KINDS}
    with progress_bar("pictures") as bar:
        for column, count in enumerate(COUNTS):
            for seed in range(-1, SEEDS):  # the first compiles
                for kind, scene in scenes.items():
                    xyz, spent = picture(scene, count, seed + 1)
                    if seed >= 0:
                        found[kind][:, seed, column] = spent, *errors(references[kind], xyz, where)
            bar(column + 1, len(COUNTS))
    return found


def main(output: str) -> None:
    """Measure, print the numbers and draw the figure."""
    mi.set_variant("llvm_ad_spectral")
    found = measure()
    unit = np.median(found["roughconductor"][0, :, -1]) / COUNTS[-1]
    figure = Figure(figsize=(8, 6), layout="constrained")  # with text that is read at 400 pixels
    panel = figure.subplots()
    for kind, (_, _, colour) in KINDS.items():
        times, relative, delta_e = np.median(found[kind], axis=1) / np.array([[unit], [1], [1]])
        for row in zip(COUNTS, times, relative, delta_e, strict=True):
            say(kind, "{} samples: time {:.3g}, error {:.3g}, ΔE00 {:.3g}".format(*row))
        band = found[kind][1]
        panel.fill_between(times, band.min(0), band.max(0), color=colour, alpha=0.25, linewidth=0)
        label = kind if kind == "roughconductor" else f"grating, {kind}"
        panel.loglog(times, relative, "o-", color=colour, markersize=8, linewidth=3, label=label)
    for axis in (panel.xaxis, panel.yaxis):
        axis.set_major_locator(LogLocator(subs=(1, 2, 5)))
        axis.set_major_formatter(FuncFormatter(lambda x, _: f"{x:g}"))
        axis.set_minor_formatter(NullFormatter())
    panel.tick_params(labelsize=17)
    panel.set_xlabel("time, in samples of roughconductor", fontsize=18)
    panel.set_ylabel("relative error of the picture", fontsize=18)
    panel.grid(alpha=0.25)
    panel.legend(frameon=False, fontsize=18)
    with whole_file(output) as temporary:
        figure.savefig(temporary, format="png", dpi=130, metadata=METADATA)


if __name__ == "__main__":
    main(sys.argv[1])
