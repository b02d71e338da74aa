"""The loss of a design, its gradient and its parts, against quadrature and differences."""

import itertools
import time

import colour
import numpy as np
import pytest
import scipy.integrate
import scipy.ndimage

from mitsuba_diffraction.inverse_design.colour_distance import ColourDistance
from mitsuba_diffraction.inverse_design.far_field import blurred_texels, lobes_in_bins, nearest_levels
from mitsuba_diffraction.inverse_design.plate import Plate, depth_for_strokes, for_detail
from mitsuba_diffraction.inverse_design.search import far_field_of
from mitsuba_diffraction.inverse_design.target import wanted_fractions, with_unused
from mitsuba_diffraction.optics.color import lamp_to_linear_sRGB
from mitsuba_diffraction.scalar_theory.reference import order_powers
from mitsuba_diffraction.settings import lobe_width
from mitsuba_diffraction.surface.heightfield import HeightField


def plate(**changed):
    request = {"texel": 1.0, "texels": 10, "height_range": 0.8, "angle": 16.0, "wavelengths": np.array([450.0, 600.0])}
    return Plate(**{**request, "int_ior": None, "levels": None, "tool_blur": 0.2, **changed})


@pytest.mark.parametrize("int_ior", [None, 1.5])
def test_the_gradient_is_that_of_the_loss(int_ior):
    one, random = plate(int_ior=int_ior), np.random.default_rng(3)
    far_field = far_field_of(one, wanted_fractions(random.random((9, 7, 3)), one), one.coherence_length, 4, np.float64)
    heights, direction = random.uniform(0, 0.8, (10, 10)), random.standard_normal((10, 10))
    step = 1e-5
    difference = far_field.loss(heights + step * direction)[0] - far_field.loss(heights - step * direction)[0]
    gradient = far_field.loss(heights)[1]
    assert (gradient * direction).sum() == pytest.approx(difference / (2 * step), rel=1e-7)


def test_the_loss_compares_the_lobes_of_the_orders_with_the_target():
    one, heights = plate(), np.random.default_rng(1).uniform(0, 0.8, (10, 10))
    wanted = wanted_fractions(np.eye(8), one)
    far_field = far_field_of(one, wanted, one.coherence_length, 4)
    relief = far_field.relief(heights)
    field, differences = HeightField(relief, one.period / len(relief)), []
    for wavelength, kappa, t in zip([0.45, 0.6], one.kappa, wanted, strict=True):
        m = np.fft.fftfreq(len(relief), 1 / len(relief))
        # Midpoint rule within the bins, for every order.
        edges, fine = one.edges(len(t)), 40
        u = (np.arange(len(t) * fine) + 0.5) / (len(t) * fine) * (edges[-1] - edges[0]) + edges[0]
        sigma = wavelength * lobe_width(one.coherence_length)
        lobes = np.exp(-((u[:, None] + wavelength * m / one.period) ** 2) / (2 * sigma**2))
        lobes *= (u[1] - u[0]) / (np.sqrt(2 * np.pi) * sigma)
        lobes = lobes.reshape(len(t), fine, -1).sum(1)
        differences.append(((lobes @ order_powers(field, kappa) @ lobes.T - t) ** 2).sum() / (t**2).sum())
    assert far_field.loss(heights)[0] == pytest.approx(np.mean(np.power(differences, 3)) ** (1 / 3), rel=1e-4)


def test_the_distance_of_colours_is_that_of_oklab_at_equal_brightness():
    """By colour-science. A grey of 0.01 is added, as it is the same in LMS."""
    random = np.random.default_rng(4)
    wavelengths = np.array([450.0, 520.0, 600.0, 660.0])
    wanted, light = random.random((2, 4, 5, 5))
    found, _ = ColourDistance.of(wanted, wavelengths)(light)
    target, seen = (np.moveaxis(x, 0, -1) @ lamp_to_linear_sRGB(wavelengths) for x in (wanted, light))
    target, seen = target / target.max(), seen * (luminance(target).sum() / luminance(seen).sum() / target.max())
    pair = [colour.XYZ_to_Oklab(colour.RGB_to_XYZ(rgb + 0.01, "sRGB")) for rgb in (target, seen)]
    expected = ((pair[0] - pair[1]) ** 2 * [1, 8, 8]).sum(axis=-1).mean()
    assert found == pytest.approx(expected, rel=0.01)


def luminance(rgb):
    return colour.RGB_to_XYZ(rgb, "sRGB")[..., 1]


def test_lobes_are_integrals_of_gaussians():
    edges = np.array([-0.3, -0.1, 0.05])
    found = lobes_in_bins(edges, [2], 12.0, 0.5, 6.0)[:, 0]
    sigma = 0.5 * lobe_width(6.0)

    def lobe(u):
        return np.exp(-((u + 0.5 * 2 / 12) ** 2) / (2 * sigma**2)) / (np.sqrt(2 * np.pi) * sigma)

    expected = [scipy.integrate.quad(lobe, *pair)[0] for pair in itertools.pairwise(edges)]
    assert found == pytest.approx(expected, rel=1e-9)


def test_texels_are_blurred_as_by_a_gaussian_filter():
    per_texel = 400
    squares = np.repeat(np.eye(5), per_texel, axis=0)
    expected = scipy.ndimage.gaussian_filter1d(squares, 0.3 * per_texel, axis=0, mode="wrap", truncate=8)
    assert blurred_texels(5, per_texel, 0.3) == pytest.approx(expected, abs=1e-5)
    assert np.array_equal(blurred_texels(5, 4, 0), np.repeat(np.eye(5), 4, axis=0))


def test_levels_are_equidistant():
    found = nearest_levels(np.linspace(0, 0.7, 200), 0.7, 8)
    assert np.unique(found) == pytest.approx(np.arange(8) / 10)
    assert np.abs(found - np.linspace(0, 0.7, 200)).max() <= 0.05 + 1e-12


def test_targets_have_their_top_at_positive_y_and_their_right_at_positive_x():
    picture = np.zeros((30, 20))
    picture[:10, 15:] = 1  # upper right: a third of the height, a quarter of the width
    wanted = wanted_fractions(picture, plate())[0]
    y, x = np.meshgrid(*2 * [(np.arange(len(wanted)) + 0.5) / len(wanted) * 2 - 1], indexing="ij")
    assert wanted.sum() == pytest.approx(1)
    assert (wanted * x).sum() == pytest.approx(0.75 * 20 / 30, abs=0.01)  # its proportions are kept
    assert (wanted * y).sum() == pytest.approx(2 / 3, abs=0.01)
    wide = wanted_fractions(picture.T, plate())[0]
    assert wide[:3].sum() == wide[-3:].sum() == 0


def test_a_photograph_is_reduced_before_its_spectra_are_computed():
    # Regression: 12 megapixels took 200 s, in which nothing was said.
    tile = np.random.default_rng(0).random((24, 32, 3))
    begin = time.process_time()
    found = wanted_fractions(tile.repeat(64, 0).repeat(64, 1), plate(wavelengths=np.array([450.0, 600])))
    assert time.process_time() - begin < 5
    np.testing.assert_allclose(found, wanted_fractions(tile, plate(wavelengths=np.array([450.0, 600]))), atol=1e-12)


def test_grey_pictures_want_all_light_and_colours_what_they_can_use():
    white = np.array([430.0, 500, 540, 650])
    grey = np.random.default_rng(0).random((8, 8))
    wanted = wanted_fractions(grey, plate(wavelengths=white))
    assert wanted.sum(axis=(1, 2)) == pytest.approx(1)
    assert wanted_fractions(np.dstack([grey] * 3), plate(wavelengths=white)) == pytest.approx(wanted)
    picture = np.zeros((8, 8, 3))
    picture[:, :4, 0] = 1  # red on the left
    picture[:, 4:, 2] = 1  # blue on the right
    coloured = wanted_fractions(picture, plate(wavelengths=white))
    half = coloured.shape[1] // 2
    left, right = (side.sum(axis=(1, 2)) for side in (coloured[..., :half], coloured[..., half + 1 :]))
    assert right[0] > 20 * left[0]
    assert left[3] > 20 * right[3]
    assert max(left[2], right[2]) < 0.2  # green light cannot be used
    assert coloured.sum(axis=(1, 2)).max() == pytest.approx(1)
    turned = wanted_fractions(picture, plate(wavelengths=white[::-1]))
    assert turned == pytest.approx(coloured[::-1], abs=1e-9)


def test_light_that_colours_cannot_use_may_go_into_the_mirror_direction():
    picture = np.zeros((8, 8, 3))
    picture[:, :4, 0] = 1
    one = plate(wavelengths=np.array([450.0, 550, 650]), unused="mirror", texels=40)
    wanted = wanted_fractions(picture, one)
    spare = with_unused(wanted, one) - wanted
    assert spare.sum(axis=(1, 2)) == pytest.approx(1 - wanted.sum(axis=(1, 2)), abs=1e-3)
    y, x = np.meshgrid(*2 * [(one.edges(spare.shape[1])[1:] + one.edges(spare.shape[1])[:-1]) / 2], indexing="ij")
    assert spare[0][np.hypot(x, y) < 2 * one.pitch].sum() > 0.9 * spare[0].sum()
    assert with_unused(wanted, plate()) is wanted


@pytest.mark.parametrize("detail", [4, 12, 44, 70])
def test_a_detail_has_three_orders(detail):
    texels, angle = for_detail(detail, 0.8, 17.5, 532.0)
    assert texels <= 256
    assert 17.5 <= angle <= 30
    orders = 2 * np.sin(np.deg2rad(angle)) * texels * 0.8 / 0.532
    assert 3 * detail <= orders < 3 * detail * 1.02 + 2
    assert angle == 17.5 or texels > 250


@pytest.mark.parametrize(("edge", "int_ior"), [(0.3, None), (0.15, None), (0.3, 1.5)])
def test_a_facet_of_the_default_depth_spreads_light_over_one_stroke(edge, int_ior):
    """The width of the light that a single facet directs to the edge, by the diffraction integral."""
    strokes, wavelength = 20, 0.54
    depth = depth_for_strokes(strokes, [539.0, 541.0], int_ior)
    path = 2.0 if int_ior is None else int_ior - 1
    x = np.linspace(0, depth * path / edge, 2001)  # a rise of path edge/path · x
    direction = np.linspace(edge - 2 / strokes, edge + 2 / strokes, 801)
    amplitude = np.exp(2j * np.pi / wavelength * (edge - direction[:, None]) * x).mean(axis=1)
    bright = direction[np.abs(amplitude) ** 2 > 0.5]
    assert np.ptp(bright) == pytest.approx(2 * edge / strokes, rel=0.05)


def test_light_of_one_wavelength_and_coarse_strokes_take_the_smallest_depth():
    assert depth_for_strokes(60, 532.0) == depth_for_strokes(4, [430.0, 670.0]) == 0.8
    # No more than 16 wavelengths of path difference, which a plate accepts.
    assert Plate(0.8, 64, depth_for_strokes(500, [430.0, 670.0]), 17.5, np.array([430.0, 670.0]), None, None, 0.1)
    assert depth_for_strokes(500, [430.0, 670.0]) == 3.4


def test_finer_detail_than_a_plate_resolves_is_refused():
    with pytest.raises(ValueError, match="detail: got 500, wanted at most 128 strokes along an edge"):
        for_detail(500, 0.8, 17.5, 532.0)
    with pytest.raises(
        ValueError, match="detail: got 1, wanted the number of finest strokes along an edge, at least 2"
    ):
        for_detail(1, 0.8, 17.5, 532.0)
