"""The sums of samples under the filters of pixels, compared with sums in float64."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

from mitsuba_diffraction.render.scene_file import SceneFile
from mitsuba_diffraction.render.trace_pass import collect, equal_ranges, trace_pass, unfolded

CHANNELS, SAMPLES = 5, 3


@pytest.mark.parametrize("columns", [3, 4, 9])
@pytest.mark.parametrize(("rfilter", "margins"), [("box", (0, 0, 0)), ("gaussian", (2, 1, 0)), ("tent", (0, 0, 1))])
def test_samples_are_gathered_with_the_weights_of_the_filter(rfilter, margins, columns, llvm):
    rows = 4
    sides, above, below = margins
    traced = rows + above + below, columns + 2 * sides
    rng = np.random.default_rng(3)
    pixel = np.repeat(np.arange(np.prod(traced)), SAMPLES)
    x = (pixel % traced[1] - sides + rng.random(pixel.size)).astype(np.float32)
    y = (pixel // traced[1] - above + rng.random(pixel.size)).astype(np.float32)
    channel = rng.uniform(-0.9, CHANNELS - 0.1, (2, pixel.size)).astype(np.float32)
    value = rng.random((2, pixel.size)).astype(np.float32)
    plugin = mi.load_dict({"type": rfilter})

    def gathered(earlier):
        count = equal_ranges(dr.opaque(mi.UInt32, SAMPLES))
        numbers = [mi.Float(row) for row in channel], [mi.Float(row) for row in value]
        return collect(plugin, mi.Point2f(x, y), *numbers, (rows, columns), margins, count, CHANNELS, earlier)

    found = unfolded(gathered(gathered(None)), (rows, columns))

    centre_y, centre_x = np.mgrid[:rows, :columns] + 0.5
    offsets = np.stack([x - centre_x[..., None], y - centre_y[..., None]])
    weight = np.prod(np.array(plugin.eval(mi.Float(offsets.astype(np.float32).ravel()))).reshape(offsets.shape), 0)
    hats = np.maximum(0, 1 - np.abs(channel[..., None] - np.arange(CHANNELS)))
    sums = np.einsum("yxs,js,jsc->yxc", weight, value, hats)
    np.testing.assert_allclose(found[..., :-1], 2 * sums, rtol=1e-5, atol=1e-5)
    np.testing.assert_allclose(found[..., -1], weight.sum(-1), rtol=1e-5)


def test_samples_without_a_value_count_as_zero(llvm, tmp_path):
    class Halves(mi.SamplingIntegrator):
        """One for half of the samples, NaN for the others."""

        def __init__(self):
            mi.SamplingIntegrator.__init__(self, mi.Properties())

        def sample(self, scene, sampler, ray, medium=None, active=True):
            return mi.Spectrum(dr.select(sampler.next_1d() < 0.5, 1, np.nan)), mi.Bool(True), []

    film = '<film type="hdrfilm"><integer name="width" value="6"/><integer name="height" value="5"/></film>'
    path = tmp_path / "scene.xml"
    path.write_text(
        f'<scene version="3.0.0"><integrator type="path"/><sensor type="perspective">{film}</sensor></scene>'
    )
    sums = trace_pass(SceneFile(path).load(), 64, 0, Halves())
    radiance = sums[..., :-1].mean(-1) / sums[..., -1]
    assert np.nanmin(radiance) > 0.3 * np.nanmax(radiance)
    assert np.isfinite(radiance).all()
