"""The Mueller matrix of the grating against that of Mitsuba's rough conductor, which has plane facets, too."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import array, use, vectors

import mitsuba_diffraction as md

WAVELENGTHS = (400.0, 500.0, 600.0, 700.0)


@pytest.fixture
def polarised():
    use("llvm_ad_spectral_polarized")


def grating(**parameters):
    # Lobes as wide as the facets': light everywhere.
    spectrum = md.precompute(md.gratings.sinusoidal(2.5, 0.3), coherence_length=2.0, wavelengths=(239.0, 830.0))
    return mi.load_dict({"type": "diffraction_grating", "spectrum": spectrum, "conserve_energy": False, **parameters})


def directions(count=200):
    random = np.random.default_rng(4)
    cosine, phi = random.uniform(0.4, 0.95, (2, count)), random.uniform(0, 2 * np.pi, (2, count))
    sine = np.sqrt(1 - cosine**2)
    return np.stack([sine * np.cos(phi), sine * np.sin(phi), cosine], axis=1)


def matrices(bsdf, wi, wo, mode=None):
    """Return Mueller matrices, (4, 4, wavelengths, n)."""
    si = dr.zeros(mi.SurfaceInteraction3f, wi.shape[1])
    si.wi = vectors(wi.T)
    si.wavelengths = type(si.wavelengths)(*WAVELENGTHS)
    si.sh_frame = mi.Frame3f(mi.Normal3f(0, 0, 1))
    ctx = mi.BSDFContext(mode or mi.TransportMode.Radiance)
    return array(bsdf.eval(ctx, si, vectors(wo.T)), np.float64)


@pytest.mark.few(1)
@pytest.mark.parametrize("mode", ["Radiance", "Importance"])
def test_a_metal_polarises_as_a_rough_conductor(polarised, mode):
    mode = getattr(mi.TransportMode, mode)
    wi, wo = directions()
    rough = mi.load_dict({"type": "roughconductor", "material": "Au", "distribution": "beckmann", "alpha": 0.6})
    found, expected = (matrices(bsdf, wi, wo, mode) for bsdf in (grating(material="Au"), rough))
    there = (found[0, 0] > 1e-6) & (expected[0, 0] > 1e-6)
    assert there.sum() > 300
    for row, column in np.ndindex(4, 4):
        np.testing.assert_allclose(
            (found[row, column] / np.where(there, found[0, 0], 1))[there],
            (expected[row, column] / np.where(there, expected[0, 0], 1))[there],
            atol=2e-4,
            err_msg=f"{row}, {column}",
        )


@pytest.mark.slow
def test_light_reflected_at_brewsters_angle_is_s_light(polarised):
    angle = np.arctan(1.5)
    wi = np.array([[np.sin(angle)], [0], [np.cos(angle)]])
    m = matrices(grating(int_ior=1.5, ext_ior=1.0), wi, np.array([[-1], [1], [1]]) * wi)[..., 0]
    assert (m[0, 0] > 0).all()
    np.testing.assert_allclose(np.hypot(m[1, 0], m[2, 0]) / m[0, 0], 1, atol=1e-3)


@pytest.mark.slow
def test_unpolarised_values_equal_those_of_unpolarised_variants(polarised):
    wi, wo = directions(50)
    brightness = matrices(grating(int_ior=1.5), wi, wo)[0, 0]
    mi.set_variant("llvm_ad_spectral")
    np.testing.assert_allclose(brightness, matrices(grating(int_ior=1.5), wi, wo), rtol=1e-4, atol=1e-6)


@pytest.mark.few(1)
def test_a_perfect_mirror_depolarises(polarised):
    m = matrices(grating(material="none"), *directions(20))
    assert (m[0, 0] > 0).any()
    m[0, 0] = 0
    assert (m == 0).all()


@pytest.mark.slow
def test_retroreflection_has_a_finite_matrix(polarised):
    wi = np.array([[0.0], [0.0], [1.0]])
    assert np.isfinite(matrices(grating(int_ior=1.5), wi, wi)).all()


@pytest.mark.slow
def test_equal_indices_reflect_nothing(polarised):
    m = matrices(grating(int_ior=1.0, ext_ior=1.0), *directions(20))
    assert (m == 0).all()


@pytest.mark.few(2)
@pytest.mark.parametrize("parameters", [{"material": "Au"}, {"int_ior": 1.5, "transmission": "sheet"}])
def test_the_reverse_direction_has_the_transposed_matrix(polarised, parameters):
    bsdf = grating(orientation=37.0, **parameters)
    wi, wo = directions()
    if "transmission" in parameters:
        wo[2, ::2] *= -1
    back = matrices(bsdf, wo, wi).swapaxes(0, 1) / np.abs(wi[2])
    # An observer who looks the other way sees the plane of polarisation mirrored.
    back[2] *= -1
    back[:, 2] *= -1
    there = matrices(bsdf, wi, wo) / np.abs(wo[2])
    assert there[0, 0].max() > 0
    np.testing.assert_allclose(there, back, rtol=1e-4, atol=1e-5 * there[0, 0].max())
    # No light leaves more than wholly polarised, whatever the light that comes.
    stokes = np.random.default_rng(6).normal(size=(3, 50))
    stokes = np.concatenate([np.ones((1, 50)), stokes / np.linalg.norm(stokes, axis=0)])
    diffracted = np.einsum("ij...,jk->i...k", there, stokes)
    assert (np.linalg.norm(diffracted[1:], axis=0) <= diffracted[0] + 1e-5 * there[0, 0].max()).all()


def test_a_relief_turned_over_has_the_matrices_of_the_other_side(polarised):
    """Light in glass that a sinusoid reflects or transmits is light above a sinusoid in air below glass."""
    wi, wo = directions()
    wi, wo = np.concatenate([wi, wi], axis=1), np.concatenate([wo, wo * [[1], [1], [-1]]], axis=1)
    over = np.array([[1], [-1], [-1]])
    found = matrices(grating(int_ior=1.5, ext_ior=1.0, transmission="interface"), over * wi, over * wo)
    expected = matrices(grating(int_ior=1.0, ext_ior=1.5, transmission="interface"), wi, wo)
    for half in (slice(200), slice(200, None)):
        brightness = expected[0, 0][:, half]
        assert (brightness > 1e-2 * brightness.max()).mean() > 0.1
        for of_stokes in (  # what does not depend on the axes
            lambda m: m[0, 0],
            lambda m: m[3, 3],
            lambda m: np.hypot(m[0, 1], m[0, 2]),
            lambda m: np.hypot(m[1, 0], m[2, 0]),
            lambda m: m[1, 1] * m[2, 2] - m[1, 2] * m[2, 1],
        ):
            a, b = of_stokes(found)[:, half], of_stokes(expected)[:, half]
            np.testing.assert_allclose(a, b, rtol=2e-3, atol=2e-4 * np.abs(b).max())


def powers(cosine, index):
    """Return R_s and R_p of a dielectric, (2, n)."""
    within = np.sqrt(1 - (1 - cosine**2) / index**2)
    s, p = (cosine - index * within) / (cosine + index * within), (index * cosine - within) / (index * cosine + within)
    return np.stack([s**2, p**2])


@pytest.mark.few(1)
@pytest.mark.parametrize("kind", ["sheet", "coat"])
def test_faces_of_a_layer_polarise_what_the_relief_reflects_or_transmits(polarised, kind):
    """In one plane s and p are separate: ⟨T_i R T_o⟩ over both, where unpolarised variants have ⟨T_i⟩⟨R⟩⟨T_o⟩."""
    theta_i, theta_o = np.deg2rad([[20, 40, 60, 70, 75], [50, 30, 65, 80, 20]])
    side = -1 if kind == "sheet" else 1
    wi = np.stack([np.sin(theta_i), 0 * theta_i, np.cos(theta_i)])
    wo = np.stack([-np.sin(theta_o), 0 * theta_o, side * np.cos(theta_o)])
    if kind == "coat":
        outer, index, parameters = 1.33, 1.5 / 1.33, {"int_ior": 1.5, "coat_ior": 1.33, "ext_ior": 1.0}
        inside = [w[:2] / outer for w in (wi, wo)]
        i, o = (np.concatenate([t, np.sqrt(1 - (t**2).sum(0, keepdims=True))]) for t in inside)
        faces = [1 - powers(w[2], outer) for w in (wi, wo)]
        cosine = np.sqrt((1 + (i * o).sum(0)) / 2)
        facet = powers(cosine, index)
    else:
        index, parameters = 1.5, {"int_ior": 1.5, "ext_ior": 1.0, "transmission": "sheet"}
        half = wi + np.concatenate([wo[:2], -np.sqrt(index**2 - (wo[:2] ** 2).sum(0, keepdims=True))])
        cosine = np.abs((wi * half).sum(0)) / np.linalg.norm(half, axis=0)
        faces, facet = [1 - powers(-wo[2], index)], 1 - powers(cosine, index)
    wanted = np.prod([facet, *faces], axis=0).mean(0) / np.prod([x.mean(0) for x in (facet, *faces)], axis=0)
    found = matrices(grating(**parameters), wi, wo)[0, 0]
    mi.set_variant("llvm_ad_spectral")
    unpolarised = matrices(grating(**parameters), wi, wo)
    there = unpolarised > 1e-7
    assert there.any(0).sum() >= 4
    assert np.ptp(wanted) > 0.02
    np.testing.assert_allclose((found / np.where(there, unpolarised, 1))[there], (wanted + 0 * found)[there], rtol=1e-3)
