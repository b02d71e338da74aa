import sys

import colour
import numpy as np
import pytest
from PIL import Image

from mitsuba_diffraction.optics import color
from mitsuba_diffraction.optics.color import (
    auto_exposure,
    delta_E,
    into_gamut,
    lamp_to_linear_sRGB,
    linear_sRGB_to_XYZ,
    ocio_view,
    on_screen,
    radiance_to_linear_sRGB,
    radiance_to_XYZ,
    roll_off,
    upsampled,
)
from mitsuba_diffraction.render.spectral_image import SpectralImage, save_preview

GRID = np.arange(365.0, 830.0, 5.0)
FINE = np.arange(360.0, 831.0)
OBSERVER = "CIE 1931 2 Degree Standard Observer"
CMFS = colour.MSDS_CMFS[OBSERVER]
LUMINANCE = colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ[1]


def through_hats(spectrum):
    """What a film with unit hats on GRID records of a spectrum given at FINE."""
    hats = np.maximum(0, 1 - np.abs(FINE[:, None] - GRID) / 5) / 5
    return spectrum @ hats


def exact_XYZ(spectrum):
    sd = colour.SpectralDistribution(spectrum, FINE)
    return colour.sd_to_XYZ(sd, CMFS, k=1 / CMFS.values[:, 1].sum(), method="Integration")


def test_flat_spectrum_of_one_is_equal_energy_white():
    np.testing.assert_allclose(radiance_to_XYZ(np.ones(GRID.size), GRID), exact_XYZ(np.ones(FINE.size)), rtol=2e-4)
    np.testing.assert_allclose(radiance_to_XYZ(np.ones(GRID.size), GRID)[1], 1, rtol=2e-4)


def test_D65_is_white():
    d65 = colour.SDS_ILLUMINANTS["D65"]
    rgb = radiance_to_linear_sRGB(through_hats(np.interp(FINE, d65.wavelengths, d65.values)), GRID)
    np.testing.assert_allclose(rgb / rgb[1], 1, atol=2e-3)


@pytest.mark.parametrize("wavelength", [420.0, 447.0, 500.0, 503.0, 546.0, 588.0, 633.0, 680.0])
@pytest.mark.parametrize("width", [1.0, 4.0, 20.0])
def test_narrow_lines_have_the_right_color(wavelength, width):
    line = np.exp(-((FINE - wavelength) ** 2) / (2 * width**2))
    white = colour.CCS_ILLUMINANTS["CIE 1931 2 Degree Standard Observer"]["D65"]
    exact = exact_XYZ(line)
    labs = [
        colour.XYZ_to_Lab(XYZ / (2 * exact[1]), white) for XYZ in (exact, radiance_to_XYZ(through_hats(line), GRID))
    ]
    assert colour.delta_E(*labs, method="CIE 2000") < 0.25


def test_pictures_are_converted_pixel_by_pixel():
    spectra = np.random.default_rng(1).random((3, 4, GRID.size))
    rgb = radiance_to_linear_sRGB(spectra, GRID)
    assert rgb.shape == (3, 4, 3)
    np.testing.assert_allclose(rgb[2, 1], radiance_to_linear_sRGB(spectra[2, 1], GRID))


@pytest.mark.parametrize("grid", [[], [500.0], [500.0, 510.0, 530.0], [510.0, 500.0], [500.0, 500.5]])
def test_other_grids_are_refused(grid):
    with pytest.raises(ValueError, match="equal steps"):
        radiance_to_XYZ(np.ones(len(grid)), grid)


def test_disagreeing_shapes_are_refused():
    with pytest.raises(ValueError, match=r"\(2, 5\)"):
        radiance_to_XYZ(np.ones((2, 5)), GRID)


WAVELENGTHS = np.arange(385.0, 700.5)
WIDTHS, EXPOSURES = [2.0, 8.0, 20.0], [0.1, 0.3, 1.0, 3.0, 10.0]


def spectrum_of_lines(width):
    """Linear sRGB of Gaussian lines at `WAVELENGTHS`, of equal power; the brightest has luminance 1."""
    lines = np.exp(-((FINE - WAVELENGTHS[:, None]) ** 2) / (2 * width**2))
    XYZ = lines @ CMFS.values
    return XYZ / XYZ[:, 1].max() @ colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB.T


def oklab(rgb):
    return colour.XYZ_to_Oklab(rgb @ colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ.T)


@pytest.mark.parametrize("exposure", EXPOSURES)
@pytest.mark.parametrize("width", WIDTHS)
def test_a_spectrum_has_no_edges_and_the_hues_of_its_light(width, exposure):
    light = spectrum_of_lines(width) * exposure
    shown = roll_off(into_gamut(light))
    assert shown.min() >= 0
    assert shown.max() <= 1
    steps = np.linalg.norm(np.diff(colour.cctf_encoding(shown, function="sRGB"), axis=0), axis=1)
    assert np.abs(np.log2(steps[1:] / steps[:-1])).max() < 1
    (_, a, b), (_, a_shown, b_shown) = oklab(light).T, oklab(shown).T
    hue, hue_shown = np.arctan2(b, a), np.arctan2(b_shown, a_shown)
    turn = np.rad2deg((hue_shown - hue + np.pi) % (2 * np.pi) - np.pi)
    assert np.abs(turn).max() < 12


@pytest.mark.parametrize("width", WIDTHS)
def test_into_gamut_keeps_luminance_and_scale(width):
    light = spectrum_of_lines(width)
    assert (light.min(axis=-1) < 0).all()
    shown = into_gamut(light)
    assert (shown >= 0).all()
    np.testing.assert_allclose(shown @ LUMINANCE, light @ LUMINANCE, rtol=1e-9)
    np.testing.assert_allclose(into_gamut(1e-3 * light), 1e-3 * shown, rtol=1e-4, atol=1e-9)


def test_colours_inside_the_gamut_and_below_the_shoulder_are_unchanged():
    """Colours of which also those of 1.3 times the chroma have no component below a tenth of the mean."""
    rgb = np.random.default_rng(2).random((200, 3))
    lab = oklab(rgb)
    wider = colour.Oklab_to_XYZ(lab * [1, 1.3, 1.3]) @ colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB.T
    inside = wider.min(axis=-1) > 0.1 * wider.mean(axis=-1)
    assert inside.sum() > 50
    np.testing.assert_array_equal(into_gamut(rgb[inside]), rgb[inside])
    dim = rgb[inside & (rgb.max(axis=-1) < 0.7)]
    np.testing.assert_array_equal(roll_off(dim), dim)


@pytest.mark.parametrize("bad", [(np.nan, 1, 1), (-1, -2, -3), (0, 0, 0), (np.inf, -np.inf, 0)])
def test_into_gamut_maps_invalid_colors_to_black(bad):
    assert (into_gamut(np.array([bad])) == 0).all()


def test_roll_off_is_smooth_and_stays_below_one():
    grey = np.linspace(0, 50, 5001)[:, None] * np.ones(3)
    shown = roll_off(grey)
    np.testing.assert_allclose(shown[:, 0], shown[:, 2])
    np.testing.assert_allclose(shown[:80], grey[:80])
    assert (np.diff(shown[:, 0]) > 0).all()
    assert shown.max() < 1
    slope = np.diff(shown[:, 0]) / 0.01
    assert np.abs(np.diff(slope)).max() < 0.15  # no kink where the shoulder begins

    red = roll_off(np.array([[0.5, 0, 0], [2, 0, 0], [1000, 0, 0]]))
    np.testing.assert_allclose(red[0], [0.5, 0, 0])
    assert red[1, 1:].max() < 0.2 < 0.9 < red[1, 0]
    assert red[2].min() > 0.95


def test_auto_exposure_follows_the_picture():
    rgb = np.random.default_rng(3).random((40, 40, 3))
    exposure = auto_exposure(rgb)
    assert 0.9 < exposure < 1.2
    np.testing.assert_allclose(auto_exposure(1e-5 * rgb), 1e5 * exposure)
    framed = np.zeros((200, 200, 3))
    framed[80:120, 80:120] = rgb
    np.testing.assert_allclose(auto_exposure(framed), exposure, rtol=0.02)
    rgb[3, 4] = 1e9
    np.testing.assert_allclose(auto_exposure(rgb), exposure, rtol=0.02)
    assert auto_exposure(np.zeros((2, 2, 3))) == 1


def test_a_preview_shows_dark_and_red_pixels_as_such(tmp_path):
    radiance = np.zeros((6, 9, GRID.size), np.float32)
    radiance[:, 3:6] = 0.01 * np.random.default_rng(4).random((6, 3, 1))
    radiance[:, 6:, 60] = 0.2  # a red line
    radiance[0, 0] = np.nan
    exposure = save_preview(SpectralImage(GRID, radiance), tmp_path / "a.png")
    assert exposure > 1
    with Image.open(tmp_path / "a.png") as picture:
        assert (picture.mode, picture.size) == ("RGB", (9, 6))
        pixels = np.array(picture).astype(int)
    assert (pixels[:, :3] == 0).all()
    assert (pixels[:, 6:, 0] > pixels[:, 6:, 2] + 60).all()
    assert pixels.max() > 200


def test_preview_of_unknown_format_writes_nothing(tmp_path):
    with pytest.raises(ValueError, match=r"\.nonsense"):
        save_preview(SpectralImage(GRID, np.ones((2, 2, GRID.size))), tmp_path / "a.nonsense")
    assert list(tmp_path.iterdir()) == []


ACES = "ocio://cg-config-v2.1.0_aces-v1.3_ocio-v2.3"  # in each version of OpenColorIO since 2.3
EXPOSED = np.array([[0.0, 0, 0], [0.18, 0.18, 0.18], [1, 1, 1], [8, 8, 8], [0.9, 0.05, 0.02], [0.02, 0.1, 3]])


def test_a_view_is_that_of_OpenImageIO(monkeypatch):
    oiio = pytest.importorskip("OpenImageIO")
    monkeypatch.setenv("OCIO", ACES)
    picture = oiio.ImageBuf(EXPOSED[None].astype(np.float32))
    shown = oiio.ImageBufAlgo.ociodisplay(
        picture, "sRGB - Display", "ACES 1.0 - SDR Video", "lin_rec709_srgb", colorconfig=ACES
    )
    assert not shown.has_error, shown.geterror()
    wanted = np.clip(255 * shown.get_pixels()[0], 0, 255)
    np.testing.assert_allclose(on_screen(EXPOSED, ocio_view("aces")), wanted, atol=1)
    # The output transform of ACES shows a grey of 18 % as one of 10 %, within the toe of its curve.
    grey = colour.cctf_decoding(on_screen(EXPOSED[1], ocio_view("aces")) / 255, function="sRGB")
    np.testing.assert_allclose(grey, 0.1, atol=0.01)


def test_views_are_those_of_the_configuration(monkeypatch, tmp_path):
    monkeypatch.delenv("OCIO", raising=False)
    with pytest.raises(ValueError, match=r"^view: got 'AgX', the views of ocio://default are ACES .*, Raw"):
        ocio_view("AgX")
    monkeypatch.setenv("OCIO", str(tmp_path / "gone.ocio"))
    with pytest.raises(ValueError, match=r"gone.ocio cannot be used by OpenColorIO \("):
        ocio_view("AgX")
    # The name of a view may be the beginning of another's.
    text = """ocio_profile_version: 2
roles: {default: XYZ, scene_linear: XYZ, cie_xyz_d65_interchange: XYZ}
displays:
  mine:
    - !<View> {name: Curve Log, colorspace: log}
    - !<View> {name: Curve, colorspace: half}
colorspaces:
  - !<ColorSpace> {name: XYZ}
  - !<ColorSpace> {name: log, from_scene_reference: !<LogTransform> {base: 2}}
  - !<ColorSpace>
    name: half
    from_scene_reference: !<MatrixTransform> {matrix: [.5, 0, 0, 0, 0, .5, 0, 0, 0, 0, .5, 0, 0, 0, 0, 1]}
"""
    (tmp_path / "mine.ocio").write_text(text)
    monkeypatch.setenv("OCIO", str(tmp_path / "mine.ocio"))
    to_XYZ = colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ
    np.testing.assert_allclose(ocio_view("CURVE")(EXPOSED), EXPOSED @ to_XYZ.T / 2, rtol=1e-5, atol=1e-6)


def test_without_OpenColorIO_a_view_is_refused_in_one_line(monkeypatch):
    monkeypatch.setitem(sys.modules, "PyOpenColorIO", None)
    with pytest.raises(ValueError, match=r"pip install 'mitsuba_diffraction\[ocio\]'"):
        ocio_view("ACES")


WHITE = 1e3 / np.linspace(1e3 / 430, 1e3 / 670, 8)


def test_colours_become_spectra_of_these_colours():
    """All but the most saturated ones, whose spectra would leave the range from 0 to 1."""
    matrix = lamp_to_linear_sRGB(WHITE)
    assert matrix.sum(axis=0) == pytest.approx(1)
    encoded = np.array([[0, 80, 255], [200, 120, 40], [255, 255, 0], [90, 90, 90], [0, 0, 0]]) / 255
    rgb = colour.cctf_decoding(encoded, function="sRGB")
    spectra = upsampled(rgb, matrix)
    assert spectra.min() >= 0
    assert spectra.max() <= 1
    assert spectra @ matrix == pytest.approx(rgb, abs=2e-4)
    random = np.random.default_rng(0).random((7, 9, 3))
    difference = delta_E(linear_sRGB_to_XYZ(random), linear_sRGB_to_XYZ(upsampled(random, matrix) @ matrix))
    assert difference.max() < 2
    assert np.median(difference) < 0.01


def test_spectra_of_colours_are_those_of_another_implementation():
    wavelengths = np.arange(400.0, 701.0, 10.0)
    rgb = colour.cctf_decoding(np.array([0.7, 0.45, 0.2]), function="sRGB")
    found = upsampled(rgb, lamp_to_linear_sRGB(wavelengths))
    shape = colour.SpectralShape(400, 700, 10)
    cmfs = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"].copy().align(shape)
    daylight = colour.SDS_ILLUMINANTS["D65"].copy().align(shape)
    expected = colour.recovery.XYZ_to_sd_Jakob2019(linear_sRGB_to_XYZ(rgb), cmfs, daylight).values
    assert found == pytest.approx(expected, abs=0.02)


def test_light_of_a_laser_is_grey():
    assert lamp_to_linear_sRGB(np.array([532.0])) == pytest.approx(np.ones((1, 3)))
    assert upsampled(np.full((2, 3), 0.3), np.ones((1, 3))) == pytest.approx(np.full((2, 1), 0.3), abs=1e-6)


def test_srgb_is_as_in_colour_science():
    values = np.append(np.linspace(0, 0.01, 50), np.linspace(0, 1, 50)).reshape(-1, 1)
    np.testing.assert_allclose(color.plain_view(values), colour.cctf_encoding(values, function="sRGB"), atol=1e-12)
    np.testing.assert_array_equal(color.XYZ_TO_SRGB, colour.RGB_COLOURSPACES["sRGB"].matrix_XYZ_to_RGB)
    np.testing.assert_array_equal(color.SRGB_TO_XYZ, colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ)
    ultraviolet, white = radiance_to_XYZ(np.eye(2), [250.0, 255.0]), colour.CCS_ILLUMINANTS[OBSERVER]["D65"]
    np.testing.assert_allclose(ultraviolet, np.tile(colour.xy_to_XYZ(white) / 2, (2, 1)), rtol=1e-12)


def test_the_observer_and_its_light_are_those_of_colour_science():
    table = color.observer()
    np.testing.assert_allclose(table[:, :4], np.column_stack([CMFS.wavelengths, CMFS.values]), rtol=1e-12)
    d65 = colour.SDS_ILLUMINANTS["D65"]
    wavelengths = np.arange(360.0, 900, 2.5)
    wanted = np.interp(wavelengths, d65.wavelengths, d65.values) / 100
    np.testing.assert_allclose(color.daylight(wavelengths), wanted, rtol=1e-9)


def test_colour_differences_are_those_of_colour_science():
    random = np.random.default_rng(5)
    first = random.random((20_000, 3)) ** 3
    second = np.where(
        random.random((20_000, 1)) < 0.5, first * random.normal(1, 0.02, (20_000, 3)), random.random((20_000, 3))
    )
    first[:50] = np.linspace(0, 1, 50)[:, None] * colour.xy_to_XYZ([0.3127, 0.3290])  # grey
    white = colour.CCS_ILLUMINANTS[OBSERVER]["D65"]
    wanted = colour.delta_E(*(colour.XYZ_to_Lab(XYZ, white) for XYZ in (first, second)), method="CIE 2000")
    np.testing.assert_allclose(delta_E(first, second), wanted, atol=1e-9)
    assert delta_E(first, first).max() == 0
