"""`md.example_scene`: its rings of colour, against the grating equation."""

import colour
import numpy as np
import pytest

import mitsuba_diffraction as md

CMFS = colour.MSDS_CMFS["CIE 1931 2 Degree Standard Observer"]
PERIOD = 1.1  # µm


def hue(XYZ):
    _, a, b = np.moveaxis(colour.XYZ_to_Oklab(XYZ), -1, 0)
    return np.rad2deg(np.arctan2(b, a))


@pytest.mark.slow
def test_a_line_grating_shows_rings_of_its_colours(llvm):
    import mitsuba as mi

    parameters = {"period": PERIOD, "depth": 0.1, "coherence_length": 20.0}
    picture = np.array(mi.render(mi.load_dict(md.example_scene("sinusoidal", size=64, spp=256, **parameters))))
    sensor = mi.load_dict(md.example_scene("sinusoidal", size=64, **parameters)).sensors()[0]
    height, lamp = float(sensor.world_transform().matrix[2, 3][0]), 1.6
    x = (np.arange(64) + 0.5 - 32) / 32 * height * np.tan(np.deg2rad(15))
    radius = np.hypot(x, x[:, None])
    wavelength = 1e3 * PERIOD * (radius / np.hypot(radius, lamp) + radius / np.hypot(radius, height))
    ring = (wavelength > 450) & (wavelength < 640) & (radius < 1)
    assert ring.sum() > 300
    # Over the wavelengths of a pixel and of a lobe.
    lines = np.exp(-((CMFS.wavelengths - wavelength[ring][:, None]) ** 2) / (2 * 12.0**2))
    turn = (
        hue(picture[ring] @ colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ.T) - hue(lines @ CMFS.values) + 180
    ) % 360
    assert np.median(np.abs(turn - 180)) < 10
    outside = (wavelength > 760) & (radius < 1)
    assert picture[ring].max(axis=-1).min() > 5 * picture[outside].mean()


@pytest.mark.parametrize(
    ("surface", "parameters", "wanted"),
    [
        ("compact_disc", {}, {"profile": "compact_disc", "material": "Al"}),
        ("skin.exr", {"int_ior": 1.5}, {"filename": "skin.exr", "int_ior": 1.5}),
        ("blazed", {"period": 2.0, "eta": 1.3}, {"profile": "blazed", "period": 2.0, "eta": 1.3}),
    ],
)
def test_the_surface_of_an_example_has_the_parameters(llvm, surface, parameters, wanted):
    bsdf = md.example_scene(surface, **parameters)["grating"]["bsdf"]
    assert bsdf == {"type": "diffraction_grating", **wanted}


def test_a_spectrum_is_handed_over(llvm):
    spectrum = md.precompute(md.gratings.blazed(2.5, 0.25, samples=32), coherence_length=20.0)
    assert md.example_scene(spectrum)["grating"]["bsdf"]["spectrum"] is spectrum


def test_an_example_without_a_variant_is_refused(llvm, monkeypatch):
    import mitsuba as mi

    monkeypatch.setattr(mi, "variant", lambda: None)
    with pytest.raises(ValueError, match="variant: got none, wanted one before the scene"):
        md.example_scene()
