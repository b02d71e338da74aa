"""Compares the noise and the time of the nodes with those of the OSL shader in Cycles, for docs/blender.md.

Run it by a Python that has bpy (cycles_picture.py):

    python tools/manual/nodes_noise.py SHAPE FILE.npz FILE.osl [SEEDS]

It renders the rectangle around the bright pixels by both in turn, with SEEDS seeds. Noise² is the variance over the
seeds, of pixels above 2 % of the brightest, without the hundredth of them where it is largest; time is the processor
time of the samples after the first ones. It prints ratios, nodes over shader: of noise² summed over the pixels and in
the median pixel, of luminance and of RGB, and of the time of a sample.
"""

import os
import sys
import tempfile
import time

import bpy
import numpy as np
from cycles_picture import build

SIZE, RADIUS, FEW, MANY = 96, 0.15, 100, 600
LUMINANCE = np.array([0.2126, 0.7152, 0.0722])


def picture(shader, shape, samples, seed, border, folder):
    """Linear sRGB within a border, (rows from below, columns, 3), and the processor time, s."""
    scene = build(shader, shape, RADIUS, samples, SIZE)
    scene.cycles.seed = seed
    if shape == "sphere":
        scene.camera.data.angle /= 2  # the middle, with more pixels in an order
    render = scene.render
    render.use_border = render.use_crop_to_border = True
    render.border_min_x, render.border_max_x, render.border_min_y, render.border_max_y = border
    render.filepath = os.path.join(folder, "picture.exr")
    began = time.process_time()
    bpy.ops.render.render(write_still=True)
    seconds = time.process_time() - began
    image = bpy.data.images.load(render.filepath)
    values = np.empty(len(image.pixels), np.float32)
    image.pixels.foreach_get(values)
    return values.reshape(image.size[1], image.size[0], 4)[..., :3].astype(float), seconds


def main(shape, *shaders, seeds):
    found, seconds = ({shader: [] for shader in shaders} for _ in range(2))
    with tempfile.TemporaryDirectory() as folder:
        whole = picture(shaders[1], shape, FEW, seeds, (0, 1, 0, 1), folder)[0] @ LUMINANCE
        rows, columns = np.nonzero(whole > 0.02 * np.quantile(whole, 0.999))
        border = [f(at) / SIZE for at in (columns, rows) for f in (np.min, lambda x: np.max(x) + 1)]
        for seed in range(seeds):
            for shader in shaders:
                _, few = picture(shader, shape, FEW, seed, border, folder)
                values, many = picture(shader, shape, MANY, seed, border, folder)
                found[shader].append(values.reshape(-1, 3))
                seconds[shader].append(many - few)
    values = np.array([found[shader] for shader in shaders])
    nodes, shader = (np.median(seconds[each]) for each in shaders)
    slower = nodes / shader
    mean = values.mean(axis=(0, 1)) @ LUMINANCE
    kept = mean > 0.02 * mean.max()
    print(f"{shape}: {kept.sum()} pixels of {kept.size}, a sample takes {slower:.2f} times as long")
    of_luminance = (values[:, :, kept] @ LUMINANCE).var(axis=1, ddof=1)
    of_RGB = values[:, :, kept].var(axis=1, ddof=1).sum(axis=2)
    for name, variance in (("luminance", of_luminance), ("RGB", of_RGB)):
        usual = (variance <= np.quantile(variance, 0.99, axis=1)[:, None]).all(axis=0)
        nodes, shader = variance[:, usual]
        both = nodes.sum() / shader.sum(), np.median(nodes / shader)
        print(f"noise² of {name}: {both[0]:.2f}, {both[1]:.2f}; × time: {slower * both[0]:.2f}, {slower * both[1]:.2f}")


if __name__ == "__main__":
    main(sys.argv[1], *map(os.path.abspath, sys.argv[2:4]), seeds=int((sys.argv[4:] or [8])[0]))
    sys.stdout.flush()
    os._exit(0)
