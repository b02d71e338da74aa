"""Interpolation and Fourier images against closed forms; their figures."""

import fourier_figures
import numpy as np
import pytest
from fourier_figures import extrema, interpolated, tile_transform
from PIL import Image

import mitsuba_diffraction as md
from mitsuba_diffraction.shader_2014.taylor_textures import taylor_transforms


@pytest.mark.parametrize("count", [40, 41])
def test_the_kernel_of_a_tile_interpolates_its_transform_exactly(count):
    heights = np.random.default_rng(count).random(count)
    orders, x = np.arange(-(count // 2), count - count // 2), np.linspace(-7, 7, 101)
    texels, exact = tile_transform(heights, 9.0, orders), tile_transform(heights, 9.0, x)
    np.testing.assert_allclose(interpolated(texels, orders, x), exact, atol=1e-12)
    near = interpolated(texels, orders, x, radius=1)
    np.testing.assert_allclose(near[::50], exact[::50], atol=1e-12)  # at orders
    assert np.abs(near - exact).max() > 0.02


def test_the_transform_of_a_blaze_is_the_analytic_one():
    # h = Hx/T: A(x) = sinc(x − κH/2π), up to a phase.
    x, height, count = np.linspace(-3, 3, 61), 0.246, 2000
    heights = height * (np.arange(count) + 0.5) / count
    found = np.abs(tile_transform(heights, 20.0, x))
    np.testing.assert_allclose(found, np.abs(np.sinc(x - 20.0 * height / (2 * np.pi))), atol=1e-5)


def test_the_extrema_of_a_blaze_are_the_analytic_ones():
    height = 0.3
    texels, found = taylor_transforms(md.gratings.blazed(2.5, height), 6, origin_at_centre=False, margin=0)
    values = extrema(texels, found)
    # The mean of hⁿ about the centre, in order 0, is the largest of even powers.
    n = np.arange(0, 6, 2)
    np.testing.assert_allclose(values["max Re"][::2], (height / 2) ** n / (n + 1), rtol=0.02)
    # F{h} of a ramp in order 1.
    assert values["max Im"][1] == pytest.approx(height / (2 * np.pi), rel=0.02)


@pytest.mark.slow
def test_the_figures_are_written(llvm, tmp_path):
    fourier_figures.save_fourier(tmp_path, ("blaze", "blaze"), 9)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(fourier_figures.FILES)
    for path in tmp_path.iterdir():
        with Image.open(path) as picture:
            picture.load()
            assert min(picture.size) > 300
