"""A clear layer over the grating, against Fresnel's formulas and closed forms inside the layer."""

import mitsuba as mi
import numpy as np
import pytest
import tmm
from bsdf_support import array, check_chi_square, direction, interaction, random_directions, use, vectors

import mitsuba_diffraction as md
from mitsuba_diffraction import testing
from mitsuba_diffraction.optics.geometry import fresnel, k_g

INDEX = 1.55
GRATING = {"type": "diffraction_grating", "coherence_length": 3.0}
AIR = 1.000277
RELATIVE = INDEX / AIR


def coated(profile="blazed", **parameters):
    surface = {"blazed": {"period": 2.5, "depth": 0.25}, "lamellar": {"period": 2.5, "depth": 0.1}}[profile]
    given = {"coat_ior": INDEX, "coherence_length": 3.0, **parameters}
    if "int_ior" not in given:
        given.setdefault("material", "none")
    return mi.load_dict({"type": "diffraction_grating", "profile": profile, **surface, **given})


def inside(omega):
    """Return directions in the layer, by Snell's law."""
    across = omega[..., :2] / RELATIVE
    return np.concatenate([across, np.sqrt(1 - (across**2).sum(-1, keepdims=True))], -1)


def transmittance(cosine):
    """Return the transmittance of the front face for unpolarised light."""
    return 1 - np.mean(fresnel(cosine, RELATIVE), axis=0)


@pytest.mark.few(1)
@pytest.mark.parametrize("theta", [0.0, 25.0, 50.0])
def test_orders_inside_the_coat_have_the_powers_of_the_closed_form(llvm, theta):
    wavelength, wi = 0.5, direction(theta)
    bsdf = coated("lamellar", coherence_length=200.0, conserve_energy=False)
    sigma = bsdf.spectrum.lobe_width
    offsets = np.linspace(-6, 6, 61) * sigma
    cell = (offsets[1] - offsets[0]) ** 2
    checked = 0
    for m in (-3, -1, 0, 1, 3):
        q = np.stack(np.broadcast_arrays(m / 2.5 + offsets[:, None], offsets), -1).reshape(-1, 2)
        wo = testing.towards(wi, q, 1e3 * wavelength)
        centre = testing.towards(wi, np.array([m / 2.5, 0.0]), 1e3 * wavelength)
        if not np.isfinite(wo).all() or centre[2] < 0.2:
            continue
        power = wavelength**2 * cell * (testing.evaluate(bsdf, wi, wo, [1e3 * wavelength])[:, 0] / wo[:, 2]).sum()
        i, o = inside(wi), inside(centre)
        kappa = 2 * np.pi * RELATIVE * (i[2] + o[2]) / wavelength
        eta = np.cos(kappa * 0.05) ** 2 if m == 0 else (2 / (np.pi * m) * np.sin(kappa * 0.05)) ** 2
        geometry = k_g(i[2], o[2], ((i + o)[:2] ** 2).sum())
        expected = transmittance(wi[2]) * transmittance(centre[2]) * geometry * eta
        assert power == pytest.approx(expected, abs=1e-3)
        checked += 1
    assert checked >= 3


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["Radiance", "Importance"])
def test_a_coat_of_nearly_the_index_outside_changes_no_matrix(mode):
    """An equal index would be no coat."""
    use("llvm_ad_spectral_polarized")
    rng = np.random.default_rng(0)
    wi, wo = random_directions(rng, 200, 0.3), random_directions(rng, 200, 0.3)
    plain = {"profile": "blazed", "period": 2.5, "depth": 0.25, "material": "Al", "coherence_length": 3.0}
    bare = mi.load_dict({"type": "diffraction_grating", **plain})
    found, wanted = (
        array(
            each.eval(
                mi.BSDFContext(getattr(mi.TransportMode, mode)), interaction(wi, (400, 500, 600, 700), 200), vectors(wo)
            )
        )
        for each in (coated(coat_ior=AIR + 3e-3, material="Al"), bare)
    )
    assert found.shape == wanted.shape == (4, 4, 4, 200)
    np.testing.assert_allclose(found, wanted, rtol=2e-2, atol=5e-3 * wanted.max())
    # Light of the reversed pair has another matrix, the transpose up to signs.
    assert np.abs(wanted - wanted.swapaxes(0, 1)).max() > 0.05 * wanted.max()


@pytest.mark.few(3)
@pytest.mark.parametrize("theta", [0, 45, 75, 88])
@pytest.mark.parametrize("turned", [0, 70])
def test_the_front_face_follows_fresnel_and_no_light_is_gained(llvm, theta, turned):
    wi = np.broadcast_to(direction(theta, turned), (100_000, 3))
    bsdf = coated()
    wo, weight, bs = testing.sample(bsdf, wi, [550] * 4)
    mirrored = np.array(mi.has_flag(bs.sampled_type, mi.BSDFFlags.DeltaReflection)) & (np.array(bs.pdf) > 0)
    np.testing.assert_allclose(wo[mirrored], np.broadcast_to(wi[0] * [-1, -1, 1], (mirrored.sum(), 3)), atol=1e-6)
    assert np.unique(np.array(bs.sampled_component)[mirrored]) == [1]
    front = np.mean(fresnel(wi[0, 2], RELATIVE))
    # The probability of the front face times the weight of its samples is exact.
    np.testing.assert_allclose(np.array(bs.pdf)[mirrored] * weight[mirrored, 0], front, rtol=1e-4)
    albedo = weight[:, 0].mean()
    assert front < albedo < 1 + 4 * weight[:, 0].std() / np.sqrt(len(weight))


@pytest.mark.slow
def test_samples_of_resolved_orders_average_to_the_integral_on_a_grid(llvm):
    """Orders beyond the critical angle of the coat, most of the power of these gratings, are not drawn.

    The integrals are over a grid of directions about each order, which is drawn from nothing: with directions from the
    sampler, a wrong density would cancel.
    """
    wavelength, count = 0.55, 1 << 15
    context = mi.BSDFContext()
    context.type_mask = +mi.BSDFFlags.GlossyReflection
    for profile, theta in (("sinusoidal", 45.0), ("ruled", 45.0), ("ruled", 80.0)):
        period, depth = (2.5, 0.3) if profile == "sinusoidal" else (1 / 1.2, 0.3)
        surface = {"profile": "sinusoidal" if profile == "sinusoidal" else "blazed", "period": period, "depth": depth}
        bsdf = mi.load_dict({"type": "diffraction_grating", **surface, "material": "Al", "coat_ior": 1.5})
        wi, sigma = direction(theta), bsdf.spectrum.lobe_width
        offsets = np.linspace(-6, 6, 61) * sigma
        m = np.arange(-12, 13)
        q = np.stack(np.broadcast_arrays(m[:, None, None] / period + offsets[:, None], offsets), -1).reshape(-1, 2)
        wo = testing.towards(wi, q, 1e3 * wavelength)
        wo = wo[np.isfinite(wo).all(-1) & (wo[:, 2] > 1e-3)]
        area = (wavelength * (offsets[1] - offsets[0])) ** 2
        value, pdf = (
            (found[:, 0] / wo[:, 2]).sum() * area
            for found in testing.evaluate_pdf(bsdf, wi, wo, [1e3 * wavelength] * 4, context)
        )
        _, weight, bs = testing.sample(bsdf, np.broadcast_to(wi, (count, 3)), [1e3 * wavelength] * 4, context=context)
        drawn, weight = np.array(bs.pdf) > 0, weight[:, 0]
        # The defensive lobe is outside of the grid.
        np.testing.assert_allclose(pdf, drawn.mean(), atol=0.025)
        np.testing.assert_allclose(weight.mean(), value, rtol=0.02, atol=4 * weight.std() / np.sqrt(count))


@pytest.mark.parametrize("theta", [0, 60])
def test_samples_pass_the_chi_square_test(llvm, theta):
    context = mi.BSDFContext()
    context.type_mask = +mi.BSDFFlags.GlossyReflection
    check_chi_square(coated(conserve_energy=False), direction(theta, 20), ctx=context)


def test_a_pigmented_base_has_the_transmittances_of_the_layer(llvm):
    base = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.5}}
    wi, wo = direction(20.0), direction(65.0, 90)
    context = mi.BSDFContext()
    context.component = 1
    value, _ = testing.evaluate_pdf(coated(int_ior=INDEX, base=base), wi, wo, [550], context)
    # The grating's own index is that of the layer: only the front face reflects.
    expected = transmittance(wi[2]) * transmittance(wo[2]) * 0.5 / np.pi * wo[2]
    assert value[0] == pytest.approx(expected, rel=1e-4)


def test_the_polarised_variant_agrees():
    wi, wo = direction(1e-3), direction(12.0, 30)
    found = []
    for variant in ("llvm_ad_spectral", "llvm_ad_spectral_polarized"):
        use(variant)
        found.append(testing.evaluate(coated(material="Al"), wi, wo, [450, 550, 650, 750]))
    # At oblique incidence the front face polarises, which changes the second transmittance a little.
    np.testing.assert_allclose(found[1], found[0], rtol=1e-2)


def test_s_polarised_light_stays_s_polarised():
    """At oblique incidence in the plane perpendicular to the grooves, s light stays s light."""
    use("llvm_ad_spectral_polarized")
    wi = direction(56.0)
    wo = wi * [-1, 1, 1]
    bsdf = coated(material="none")
    si = interaction(wi)
    matrix = array(bsdf.eval(mi.BSDFContext(), si, vectors(wo)))[..., 0, 0]
    s, p = 1 - np.array(fresnel(wi[2], RELATIVE)).ravel()
    # The stokes basis of either direction lies along s or p: both transmissions give (s² + p²)/2 and ±(s² − p²)/2.
    assert abs(matrix[0, 1] / matrix[0, 0]) == pytest.approx(abs(s - p) / (s + p), rel=0.02)


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"coat_ior": 0.9}, "coat_ior: got 0.9, wanted at least one"),
        ({"coat_ior": 1.2, "ext_ior": 1.33, "int_ior": 1.5}, "coat_ior: got 1.2, wanted at least one and that of"),
        ({"coat_ior": float("nan")}, "coat_ior: got nan"),
        ({"base": {"type": "diffuse"}}, "base: got a BSDF below a conductor"),
    ],
)
def test_a_wrong_coat_is_refused(llvm, parameters, text):
    with pytest.raises(RuntimeError, match=text):
        coated(**parameters)


@pytest.mark.parametrize(
    ("layer", "without"),
    [
        pytest.param({"coat_ior": 1.0, "material": "Al"}, {"material": "Al"}, marks=pytest.mark.slow),
        ({"coat_ior": "air", "int_ior": 1.8}, {"int_ior": 1.8}),
        pytest.param(
            {"coat_ior": 1.33, "ext_ior": 1.33, "int_ior": 1.8},
            {"ext_ior": 1.33, "int_ior": 1.8},
            marks=pytest.mark.slow,
        ),
        # A layer of the index of water on a metal in water.
        pytest.param(
            {"coat_ior": 1.33, "ext_ior": 1.33, "material": "Al"},
            {"coat_ior": 1.3314, "ext_ior": 1.33, "material": "Al"},
            marks=pytest.mark.slow,
        ),
    ],
)
def test_a_coat_with_the_exterior_index_changes_nothing(llvm, layer, without):
    found = coated(**layer, conserve_energy=False)
    assert found.layers.coat is None
    plain = {"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25, "coherence_length": 3.0}
    wi, wo = direction(20.0), direction(-30.0)
    plain = mi.load_dict({**plain, "conserve_energy": False, **without})
    values = [testing.evaluate(bsdf, wi, wo, [550]) for bsdf in (found, plain)]
    np.testing.assert_allclose(values[0], values[1], rtol=1e-6 if "coat_ior" not in without else 0.02)


def test_a_coat_without_its_wavelengths_is_refused(llvm):
    spectrum = md.precompute(md.gratings.blazed(2.5, 0.25))
    with pytest.raises(RuntimeError, match=r"build it from 232\.3 nm"):
        mi.load_dict({"type": "diffraction_grating", "spectrum": spectrum, "coat_ior": INDEX})


def polycarbonate(wavelength):
    """n by Sultanova, Kasarova and Nikolov 2009, λ in µm."""
    return np.sqrt(1 + 1.4182 * wavelength**2 / (wavelength**2 - 0.021304))


def keratin(wavelength):
    """n by Leertouwer, Wilts and Stavenga 2011, λ in µm."""
    return 1.532 + 5.89e-3 / wavelength**2


def constant(n):
    return lambda wavelength: n


BELOW = {
    # The parameters of a scene; the films from the outside in, n(λ) and thickness in µm; n(λ) of the material.
    "keratin": ({"int_ior": "keratin"}, [], keratin),
    "number": ({"int_ior": 1.7}, [], constant(1.7)),
    "itself": ({"int_ior": "polycarbonate"}, [], polycarbonate),
    "metal": ({"eta": 0.8, "k": 3.0}, [], constant(0.8 + 3j)),
    "film": (
        {"int_ior": "keratin", "thin_film_ior": 2.35, "thin_film_thickness": 0.7},
        [(constant(2.35), 0.7)],
        keratin,
    ),
    "low film": (
        {"int_ior": 1.9, "thin_film_ior": "keratin", "thin_film_thickness": 0.7},
        [(keratin, 0.7)],
        constant(1.9),
    ),
    "film of the coat": (
        {"int_ior": 1.9, "thin_film_ior": "polycarbonate", "thin_film_thickness": 0.7},
        [(polycarbonate, 0.7)],
        constant(1.9),
    ),
    "stack on metal": (
        {"eta": 0.8, "k": 3.0, "thin_film_ior": "keratin, 2.35", "thin_film_thickness": "0.5, 0.3"},
        [(keratin, 0.5), (constant(2.35), 0.3)],
        constant(0.8 + 3j),
    ),
    "stack": (
        {"int_ior": "keratin", "thin_film_ior": "2.35, 1.38", "thin_film_thickness": "0.5, 0.3"},
        [(constant(2.35), 0.5), (constant(1.38), 0.3)],
        keratin,
    ),
}
LIGHT = np.array([380.0, 450.0, 550.0, 700.0])


def under_polycarbonate(below, sine, wavelength):
    """R and T of a plane under polycarbonate, and T of its face, by `tmm`, (3, 2) for s and p; λ in µm."""
    _, films, substrate = BELOW[below]
    coat = polycarbonate(wavelength)
    n = [coat, *(index(wavelength) for index, _ in films), substrate(wavelength)]
    d = [np.inf, *(thickness for _, thickness in films), np.inf]
    found = [tmm.coh_tmm(which, n, d, np.arcsin(sine / coat), wavelength) for which in "sp"]
    faces = [tmm.coh_tmm(which, [1, coat], [np.inf] * 2, np.arcsin(sine), wavelength)["T"] for which in "sp"]
    return np.array([*([of[key] for of in found] for key in "RT"), faces])


@pytest.mark.few(4)
@pytest.mark.parametrize("polarised", [False, True], ids=["spectral", "polarised"])
@pytest.mark.parametrize("theta", [0.0, 60.0])
@pytest.mark.parametrize("below", BELOW)
def test_below_a_coat_with_dispersion_the_reflectance_has_both_indices_of_each_wavelength(below, theta, polarised):
    """A flat surface in the mirror direction, against a perfect mirror, which depolarises, below the same coat."""
    use("llvm_ad_spectral_polarized" if polarised else "llvm_ad_spectral")
    flat = md.precompute(md.HeightField(np.zeros((16, 16)), 0.05), wavelengths=(210, 830))
    parameters = {"type": "diffraction_grating", "spectrum": flat, "coat_ior": "polycarbonate", "ext_ior": 1.0}
    wi = direction(theta)
    wo = wi * [-1, -1, 1]
    bsdf, mirror = (mi.load_dict(parameters | others) for others in (BELOW[below][0], {"material": "none"}))
    found, of_mirror = (testing.evaluate(one, wi, wo, LIGHT) for one in (bsdf, mirror))
    wanted = []
    for wavelength in LIGHT * 1e-3:
        reflected, _, face = under_polycarbonate(below, np.sin(np.deg2rad(theta)), wavelength)
        # Of unpolarised light, whose two parts are transmitted by the face twice.
        wanted.append(np.mean(face**2 * reflected) / np.mean(face) ** 2 if polarised else np.mean(reflected))
    np.testing.assert_allclose(found / of_mirror, wanted, rtol=1e-3, atol=1e-6)


@pytest.mark.few(2)
@pytest.mark.parametrize("theta", [0.0, 60.0])
@pytest.mark.parametrize("below", [name for name, (_, _, index) in BELOW.items() if np.isreal(index(0.5))])
def test_below_a_coat_with_dispersion_the_base_has_the_transmittance_of_each_wavelength(llvm, below, theta):
    base = {"type": "diffuse", "reflectance": {"type": "uniform", "value": 0.5}}
    bsdf = coated("lamellar", coat_ior="polycarbonate", ext_ior=1.0, base=base, **BELOW[below][0])
    wi, wo = direction(theta, 30), direction(20.0, 200)
    context = mi.BSDFContext()
    context.component = 1
    value = testing.evaluate_pdf(bsdf, wi, wo, LIGHT, context)[0]
    for found, wavelength in zip(value, LIGHT * 1e-3, strict=True):
        wanted = 0.5 / np.pi * wo[2]
        for omega in (wi, wo):
            _, transmitted, face = under_polycarbonate(below, np.sqrt(1 - omega[2] ** 2), wavelength)
            wanted *= face.mean() * transmitted.mean()
        assert found == pytest.approx(wanted, rel=2e-4)
