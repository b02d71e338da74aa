"""The albedo that integrators show and denoisers need: the reflectance of the material, and the base under it."""

import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import WAVELENGTHS, array, direction, interaction, plugin, spectrum

from mitsuba_diffraction.render.denoise import guides

PAINT = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.5}}


def albedo(bsdf, theta=0.0):
    return np.ravel(array(bsdf.eval_diffuse_reflectance(interaction(direction(theta, 30))), np.float64))


def specular(theta, **parameters):
    """Return R of one of Mitsuba's smooth surfaces."""
    smooth = mi.load_dict({"type": "conductor", **parameters})
    _, weight = smooth.sample(mi.BSDFContext(), interaction(direction(theta, 30)), 0.5, mi.Point2f(0.5, 0.5))
    return np.ravel(array(weight, np.float64))


@pytest.mark.parametrize("theta", [0, 60])
def test_the_albedo_is_that_of_a_plane_and_its_base(llvm, theta):
    # Regression: it was zero for all gratings.
    of = spectrum("blazed")
    np.testing.assert_allclose(albedo(plugin(of, material="none"), theta), 1)
    np.testing.assert_allclose(albedo(plugin(of, material="Al"), theta), specular(theta, material="Al"), rtol=2e-3)
    bare, painted = (albedo(plugin(of, int_ior=1.5, **base), theta) for base in ({}, {"base": PAINT}))
    np.testing.assert_allclose(painted, bare + (1 - bare) * 0.5, rtol=1e-5)
    face = float(np.ravel(mi.fresnel(mi.Float(np.cos(np.deg2rad(theta))), 1.5 / 1.000277)[0])[0])
    np.testing.assert_allclose(bare, face, rtol=1e-3)
    both = mi.load_dict({"type": "twosided", "bsdf": plugin(of, material="Al")})
    si = interaction(-direction(theta, 30))
    found = np.ravel(array(both.eval_diffuse_reflectance(si)))
    np.testing.assert_allclose(found, specular(theta, material="Al"), rtol=2e-3)
    assert len(bare) == len(WAVELENGTHS)


def test_the_denoiser_sees_the_paint_under_a_grating(llvm):
    view = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    scene = {
        "type": "scene",
        "sensor": {"type": "orthographic", "to_world": view, "film": {"type": "hdrfilm", "width": 4, "height": 4}},
        "surface": {"type": "rectangle", "bsdf": plugin(spectrum("blazed"), int_ior=1.5, base=PAINT)},
    }
    np.testing.assert_allclose(guides(mi.load_dict(scene)).albedo, 0.52, atol=0.01)
