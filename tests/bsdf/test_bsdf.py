"""The plugin against the formulas in float64, under rotation, and against its own samples."""

import functools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import (
    WAVELENGTHS,
    bitmap,
    check_chi_square,
    direction,
    floats,
    interaction,
    plugin,
    random_directions,
    use,
)

import mitsuba_diffraction as md
from mitsuba_diffraction.bsdf.testing import evaluate_pdf
from mitsuba_diffraction.settings import lobe_width

MAKE = {
    "flat": lambda: md.HeightField(np.zeros((1, 4)), 0.05),
    "blazed": lambda: md.gratings.blazed(2.5, 0.25),
    "sinusoidal": lambda: md.gratings.sinusoidal(2.5, 0.3),
    "lamellar": lambda: md.gratings.lamellar(2.5, 0.2),
    "crossed": lambda: md.gratings.crossed(2.0, 0.1, samples=32),
    "elaphe": lambda: md.gratings.elaphe_synthetic(8),
    "xenopeltis": lambda: md.gratings.xenopeltis_synthetic(8),
}


@functools.cache
def surface(name):
    return MAKE[name]()


@functools.cache
def spectrum(name, coherence_length=65.0):
    return md.precompute(surface(name), coherence_length=coherence_length)


def raw_plugin(of, **parameters):
    """Return the plugin without E, which tests/energy/test_energy.py tests."""
    return plugin(of, conserve_energy=False, **parameters)


def towards(wi, q, wavelength):
    """Return ω_o for the frequencies q (..., 2) at one wavelength (nm), NaN where evanescent."""
    t = -wavelength * 1e-3 * np.asarray(q) - wi[..., :2]
    with np.errstate(invalid="ignore"):
        return np.concatenate([t, np.sqrt(1 - (t**2).sum(-1, keepdims=True))], -1)


def evaluate(bsdf, wi, wo, wavelengths=WAVELENGTHS):
    """Return f cos θ_o (n, 4) and pdf (n,) in an LLVM variant."""
    value, pdf = evaluate_pdf(bsdf, wi, np.atleast_2d(wo), wavelengths)
    return value, pdf[:, 0]


def k_g(wi, wo):
    """Return K G in float64."""
    w = wi[..., 2] + wo[..., 2]
    d = 1 + (wi * wo).sum(-1)
    return d**2 / (wi[..., 2] * wo[..., 2] * w**2) * np.minimum(1, 2 * w * np.minimum(wi[..., 2], wo[..., 2]) / d)


def expected(height_field, wi, wo, wavelengths=WAVELENGTHS, coherence_length=65.0):
    """Return f cos θ_o for R = 1, (n, wavelengths)."""
    wo = np.atleast_2d(wo)
    wi = np.broadcast_to(wi, wo.shape)
    um = np.asarray(wavelengths) * 1e-3
    q = -(wi + wo)[:, None, :2] / um[:, None]
    kappa = 2 * np.pi * (wi + wo)[:, None, 2] / um
    s = md.reference.power_spectrum(height_field, q, kappa, coherence_length=coherence_length)
    return (k_g(wi, wo) * wo[:, 2])[:, None] * s / um**2


def test_flat_surface_gives_a_gaussian_about_the_mirror_direction(llvm):
    bsdf, wi = raw_plugin(spectrum("flat")), direction(40, 25)
    sigma = lobe_width(65.0)
    peak = 1 / (0.5**2 * 2 * np.pi * sigma**2)
    for offset in (0, 1, 2):
        wo = towards(wi, offset * sigma * np.array([[0.6, 0.8]]), 500)
        value, _ = evaluate(bsdf, wi, wo)
        wanted = k_g(wi, wo) * peak * np.exp(-(offset**2) / 2)
        np.testing.assert_allclose(value[:, 1] / wo[:, 2], wanted, rtol=2e-3)


@pytest.mark.few(2)
@pytest.mark.parametrize("name", ["blazed", "sinusoidal"])
@pytest.mark.parametrize(("theta", "phi"), [(0, 0), (30, 0), (45, 70)])
def test_orders_have_their_powers_and_the_gaps_are_dark(llvm, name, theta, phi):
    bsdf, wi = raw_plugin(spectrum(name)), direction(theta, phi)
    for channel, wavelength in enumerate(WAVELENGTHS):
        orders = np.arange(-6, 7)
        wo = towards(wi, np.stack([orders / 2.5, 0 * orders], -1), wavelength)
        wo = wo[wo[:, 2] > 0.01]
        value = evaluate(bsdf, wi, wo)[0][:, channel]
        wanted = expected(surface(name), wi, wo)[:, channel]
        np.testing.assert_allclose(value, wanted, rtol=3e-3, atol=1e-3 * wanted.max())
        wo = towards(wi, np.stack([(orders + 0.5) / 2.5, 0 * orders], -1), wavelength)
        wo = wo[np.isfinite(wo[:, 2])]
        assert evaluate(bsdf, wi, wo)[0][:, channel].max() < 1e-6 * wanted.max()


@pytest.mark.quick
def test_a_blaze_reflects_into_the_mirror_direction_of_its_facets(llvm):
    wi = direction(0)
    wo = towards(wi, np.array([[0.4, 0], [-0.4, 0]]), 500)
    assert wo[0, 0] < 0
    minus_x, plus_x = evaluate(raw_plugin(spectrum("blazed")), wi, wo)[0][:, 1]
    assert minus_x > 10 * max(plus_x, 1e-9)


def test_dielectric_is_fresnel_at_the_half_vector(llvm):
    wi = direction(50, 20)
    wo = towards(wi, np.array([[m / 2.5, 0] for m in (-1, 0, 1, 2)]), 500)
    wo = wo[np.isfinite(wo[:, 2])]
    mirror = evaluate(raw_plugin(spectrum("blazed")), wi, wo)[0][:, 1]
    assert (mirror > 0).all()
    c = np.sqrt((1 + wo @ wi) / 2)
    t = np.sqrt(1 - (1 - c**2) / 1.5**2)
    exact = (((c - 1.5 * t) / (c + 1.5 * t)) ** 2 + ((1.5 * c - t) / (1.5 * c + t)) ** 2) / 2
    value = evaluate(raw_plugin(spectrum("blazed"), int_ior=1.5, ext_ior=1.0), wi, wo)[0][:, 1]
    np.testing.assert_allclose(value / mirror, exact, rtol=1e-4)
    ratio = evaluate(raw_plugin(spectrum("blazed"), material="Al"), wi, wo)[0][:, 1] / mirror
    assert (ratio > 0.8).all()
    assert (ratio < 1).all()


def test_orientation_rotates_the_pattern(llvm):
    wi = direction(0)
    wo = towards(wi, np.array([[0.4, 0], [0, 0.4]]), 500)
    along_x, along_y = evaluate(raw_plugin(spectrum("blazed"), orientation=90.0), wi, wo)[0][:, 1]
    assert along_x == 0
    np.testing.assert_allclose(along_y, evaluate(raw_plugin(spectrum("blazed")), wi, wo)[0][0, 1], rtol=1e-4)

    c, s = np.cos(np.deg2rad(30)), np.sin(np.deg2rad(30))
    back = np.array([[c, s, 0], [-s, c, 0], [0, 0, 1]])
    rng = np.random.default_rng(1)
    wi, wo = random_directions(rng, 500, 0.1), random_directions(rng, 500, 0.1)
    turned, straight = raw_plugin(spectrum("blazed", 3.0), orientation=30.0), raw_plugin(spectrum("blazed", 3.0))
    value, wanted = evaluate(turned, wi, wo)[0], evaluate(straight, wi @ back.T, wo @ back.T)[0]
    np.testing.assert_allclose(value, wanted, rtol=1e-3, atol=1e-4 * wanted.max())


@pytest.mark.few(1)
@pytest.mark.parametrize("name", sorted(MAKE))
def test_values_are_finite_for_any_directions(llvm, name):
    bsdf = plugin(spectrum(name))
    rng = np.random.default_rng(3)
    wi, wo = random_directions(rng, 10_000), random_directions(rng, 10_000)
    grazing = direction(90, rng.uniform(0, 360, 2000))
    grazing[:, 2] = 1e-6
    wi[:2000], wo[1000:3000] = grazing, grazing
    wo[3000:4000] = wi[3000:4000]  # back to where it came from
    wo[4000:6000] = wi[4000:6000] * [-1, -1, 1]
    wavelengths = rng.uniform(360, 830, (10_000, 4))
    wavelengths[:10, 0], wavelengths[:10, 3] = 360, 830
    value, pdf = evaluate(bsdf, wi, wo, wavelengths)
    assert np.isfinite(value).all()
    assert (value >= 0).all()
    assert np.isfinite(pdf).all()
    assert (pdf >= 0).all()
    assert value.max() > 0


def albedo(height_field, wi, wavelength):
    """Return the sum over the orders of a one-row grating, each integrated over its lobe, R = 1."""
    period, h = height_field.tile_size[0], height_field.centred[0]
    x = (np.arange(h.size) + 0.5) / h.size
    nodes, weights = np.polynomial.hermite_e.hermegauss(7)
    weights = weights / weights.sum()
    sigma, total = lobe_width(65.0), 0.0
    for m in range(-14, 15):
        q = np.stack(np.meshgrid(m / period + sigma * nodes, sigma * nodes, indexing="ij"), -1).reshape(-1, 2)
        wo, share = towards(wi, q, wavelength), np.outer(weights, weights).ravel()
        share, wo = share[wo[:, 2] > 0], wo[wo[:, 2] > 0]
        kappa = 2e3 * np.pi * (wi[2] + wo[:, 2]) / wavelength
        eta = np.abs(np.exp(1j * (kappa[:, None] * h - 2 * np.pi * m * x)).mean(-1)) ** 2
        total += (share * k_g(wi, wo) * eta).sum()
    return total


@pytest.mark.parametrize("theta", [0, 60, 80])
def test_samples_follow_their_density_and_carry_the_albedo(llvm, theta):
    bsdf, wi, count = raw_plugin(spectrum("blazed")), direction(theta, 30), 400_000
    rng = np.random.default_rng(4)
    si = interaction(np.broadcast_to(wi, (count, 3)), count=count)
    bs, weight = bsdf.sample(
        mi.BSDFContext(), si, floats(rng.random(count)), mi.Point2f(*map(floats, rng.random((2, count))))
    )
    dr.eval(bs, weight)
    again = np.array(bsdf.pdf(mi.BSDFContext(), si, bs.wo))
    weight = np.array(weight)
    assert np.isfinite(weight).all()
    assert (weight >= 0).all()
    some = weight.max(0) > 0
    np.testing.assert_allclose(np.array(bs.pdf)[some], again[some], rtol=1e-3)
    np.testing.assert_allclose(weight.mean(1), [albedo(surface("blazed"), wi, x) for x in WAVELENGTHS], rtol=0.03)


@pytest.mark.few(2)
@pytest.mark.parametrize("theta", [0, 30, 60])
@pytest.mark.parametrize("name", ["blazed", "crossed"])
def test_samples_pass_the_chi_square_test(llvm, name, theta):
    check_chi_square(raw_plugin(spectrum(name, 3.0)), direction(theta, 20))


def test_variant_without_wavelengths_is_refused():
    use("llvm_ad_rgb")
    with pytest.raises(RuntimeError, match="spectral"):
        mi.load_dict({"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25})


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"period": 2.0}, "period: got it without profile, wanted it with one of blazed, "),
        ({"hight_scale": 1.0}, "hight_scale: unknown, wanted one of base, .*; did you mean height_scale"),
        ({"shadowing": "smith"}, "shadowing"),
        ({"fresnel": "exact"}, "fresnel"),
        ({"material": "none", "int_ior": 1.5}, "material"),
        ({"height_scale": 1.5}, "height_scale"),
        ({"height_scale": -0.5}, "height_scale"),
        ({"material": "Al", "base": {"type": "diffuse"}}, "base"),
        ({"material": "none", "base": {"type": "diffuse"}}, "base"),
        ({"int_ior": 0.0}, "int_ior: got 0"),
        ({"int_ior": np.nan}, "int_ior: got nan"),
        ({"ext_ior": np.inf}, "ext_ior: got inf"),
        ({"orientation": np.nan}, "orientation: got nan"),
        ({"orientation": np.full((8, 8, 1), np.nan)}, "orientation: got values that are not finite"),
        ({"orientation": np.full((8, 8, 3), 0.5)}, "orientation: got a picture in colour"),
        ({"height_scale": np.full((8, 8, 3), 0.5)}, "height_scale: got a picture in colour"),
    ],
)
def test_mistakes_are_refused(llvm, parameters, text):
    parameters = {
        name: bitmap(value, raw=value.shape[2] == 1) if isinstance(value, np.ndarray) else value
        for name, value in parameters.items()
    }
    with pytest.raises((RuntimeError, ValueError), match=text):
        mi.load_dict({"type": "diffraction_grating", "spectrum": spectrum("blazed"), **parameters})


@pytest.mark.parametrize("source", ["profile", "recipe"])
def test_parameters_of_scalar_theory_are_refused_before_a_table_is_computed(llvm, monkeypatch, tmp_path, source):
    monkeypatch.setattr(
        "mitsuba_diffraction.precomputation.recipe.Recipe.cached", lambda *_: pytest.fail("a table was computed")
    )
    recipe = tmp_path / "blazed.toml"
    recipe.write_text('[surface]\nprofile = "blazed"\n[spectrum]\ntheory = "rigorous"\nmaterial = "Al"\n')
    of = {"profile": "blazed", "theory": "rigorous", "material": "Al"}
    of = of if source == "profile" else {"filename": str(recipe), "material": "Al"}
    with pytest.raises(RuntimeError, match=r"height_scale: got 0\.5, wanted none with theory=rigorous"):
        mi.load_dict({"type": "diffraction_grating", "height_scale": 0.5, **of})


def test_scales_too_large_for_any_spectrum_are_refused(llvm):
    with pytest.raises(RuntimeError, match=r"height_scale, lateral_scale: got up to 1000, wanted at most 7\.2"):
        mi.load_dict({"type": "diffraction_grating", "profile": "blazed", "height_scale": 1000.0})


@pytest.mark.parametrize(
    ("name", "others"),
    [("int_ior", {"transmission": "interface"}), ("coat_ior", {"material": "Al"}), ("ext_ior", {"int_ior": 1.5})],
)
def test_an_index_too_large_for_any_spectrum_is_refused_by_its_name(llvm, name, others):
    # Regression: "height_scale, lateral_scale: got up to 1, wanted at most 0.072".
    with pytest.raises(RuntimeError, match=rf"{name}: got 100 with light of 360 nm, wanted at most 7\.2"):
        mi.load_dict({"type": "diffraction_grating", "profile": "blazed", name: 100.0, **others})


def test_constructors_leave_the_file_resolver_alone(llvm, monkeypatch):
    """mi.load_dict replaces it while other threads load plugins that need it: sunsky failed at times."""
    load = mi.load_dict
    path = load({"type": "path"})
    monkeypatch.setattr(mi, "load_dict", None)
    for medium in ({"material": "Al"}, {"int_ior": 1.7}):
        bsdf = load(
            {"type": "diffraction_grating", "profile": "blazed", **medium, "coat_ior": 1.5, "conserve_energy": False}
        )
        assert type(bsdf).__name__ == "DiffractionGrating"
    assert type(load({"type": "diffraction_path"}).path) is type(path)


@pytest.mark.parametrize(
    ("kind", "parameters"),
    [
        ("diffraction_grating", {"profile": "sinusoidal", "depth": 0.2}),
        ("diffraction_grating", {"profile": "blazed", "period": 2.5, "depth": 0.25, "height_scale": -1.0}),
        ("diffraction_grating", {"profile": "blazed", "period": 2.5, "depth": 0.25, "shadowing": "smith"}),
        ("diffraction_shader", {"variant": "phong"}),
    ],
)
def test_a_refused_plugin_disturbs_no_other(llvm, kind, parameters):
    """Dr.Jit calls all registered objects, also an incomplete one to which a traceback refers."""
    grating = {"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25}
    film = {"type": "specfilm", "width": 8, "height": 8, "green": {"type": "regular", "wavelength_min": 500.0}}
    film["green"].update(wavelength_max=600.0, values="1, 1")
    view = mi.ScalarTransform4f().look_at([0, 0, 4], [0, 0, 0], [0, 1, 0])
    scene = {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": {"type": "perspective", "to_world": view, "film": film},
        "light": {"type": "constant"},
        "grating": {"type": "sphere", "bsdf": grating},
        "other": {"type": "rectangle", "bsdf": {"type": "diffuse"}},
    }
    kept = []  # as a notebook does with the last error
    for seed in range(2):
        with pytest.raises((RuntimeError, ValueError)) as caught:
            mi.load_dict({"type": kind, **parameters})
        kept.append(caught)
        mi.render(mi.load_dict(scene), spp=1, seed=seed).numpy()


def test_unknown_profile_is_refused(llvm):
    with pytest.raises((RuntimeError, ValueError), match="profile"):
        mi.load_dict({"type": "diffraction_grating", "profile": "triangle", "period": 2.5, "depth": 0.25})


@pytest.mark.parametrize("variant", ["llvm_ad_spectral_polarized"])
def test_other_variants_give_the_same_values(variant):
    wi = direction(30, 20)
    wo = towards(wi, np.array([[m / 2.5, 0] for m in (-1, 0, 1)]), 500)
    use("llvm_ad_spectral")
    wanted, wanted_pdf = evaluate(plugin(spectrum("blazed"), int_ior=1.5), wi, wo)
    use(variant)
    bsdf = plugin(spectrum("blazed"), int_ior=1.5)
    for index, o in enumerate(wo):
        si = dr.zeros(mi.SurfaceInteraction3f)
        si.wi = mi.Vector3f(*map(float, wi))
        si.wavelengths = type(si.wavelengths)(*map(float, WAVELENGTHS))
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, mi.Vector3f(*map(float, o)))
        value = value[0, 0] if mi.is_polarized else value
        np.testing.assert_allclose(np.array(value).ravel(), wanted[index], rtol=1e-3, atol=1e-4 * wanted.max())
        np.testing.assert_allclose(np.array(pdf).ravel(), wanted_pdf[index], rtol=1e-3)


def test_the_base_receives_the_transmitted_light(llvm):
    wi = direction(35, 10)
    wo = np.concatenate([random_directions(np.random.default_rng(5), 50, 0.05), wi[None] * [-1, -1, 1]])
    base = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.5}}
    alone = plugin(spectrum("blazed"), int_ior=1.5, ext_ior=1.0)
    both = plugin(spectrum("blazed"), int_ior=1.5, ext_ior=1.0, base=base)

    def through(c):
        t = np.sqrt(1 - (1 - c**2) / 1.5**2)
        return 1 - (((c - 1.5 * t) / (c + 1.5 * t)) ** 2 + ((1.5 * c - t) / (1.5 * c + t)) ** 2) / 2

    below = through(wi[2]) * through(wo[:, 2]) * 0.5 / np.pi * wo[:, 2]
    wanted = evaluate(alone, wi, wo)[0] + below[:, None]
    np.testing.assert_allclose(evaluate(both, wi, wo)[0], wanted, rtol=1e-4)


def test_height_scale_can_be_changed(llvm):
    bsdf, wi = plugin(spectrum("sinusoidal"), conserve_energy=False), direction(20, 40)
    parameters = mi.traverse(bsdf)
    assert any(key.startswith("orientation") for key in parameters.keys())  # noqa: SIM118 (not a dict)
    parameters["height_scale"] = 0.6
    parameters.update()
    scaled = md.HeightField(surface("sinusoidal").heights * 0.6, surface("sinusoidal").pixel_size)
    wo = towards(wi, np.array([[m / 2.5, 0] for m in range(-3, 4)]), 500)
    wanted = expected(scaled, wi, wo)[:, 1]
    np.testing.assert_allclose(evaluate(bsdf, wi, wo)[0][:, 1], wanted, rtol=3e-3, atol=1e-3 * wanted.max())
