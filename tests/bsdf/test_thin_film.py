"""A thin film on the relief, against the transfer matrices of the package tmm, and against bare surfaces."""

import functools
import itertools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import tmm
from bsdf_support import (
    bitmap,
    check_chi_square,
    direction,
    draw,
    evaluate,
    floats,
    interaction,
    random_directions,
    use,
)

import mitsuba_diffraction as md
from mitsuba_diffraction.optics.refractive_indices import refractive_index

WAVELENGTHS = np.linspace(400, 800, 9)
ANGLES = np.arange(0.0, 81.0, 10)
ZNS = {"thin_film_ior": 2.35, "thin_film_thickness": 0.08}
ABSORBING = {"thin_film_ior": "Cu2O", "thin_film_thickness": 0.1}
FILMS = {
    # (index, or name, and thickness in µm)
    "high": (2.35, 0.08),
    "low": (1.38, 0.25),
    "thick": (1.7, 2.0),
    "absorbing": ("Cu2O", 0.15),
    "metal": ("Au", 0.02),
}
BELOW = {"dielectric": {"int_ior": 1.5}, "metal": {"material": "Al"}, "coat": {"int_ior": 1.5, "coat_ior": 1.5}}


def index_of(ior, wavelength):
    """n + ik of a parameter, at a wavelength in nm."""
    return refractive_index(wavelength * 1e-3, material=ior) if isinstance(ior, str) else ior


def layers(pol, ior, thickness, below, wavelength, angle, outside=1.0, backwards=False):
    """The solution of tmm; the angle in radians is that in the medium of incidence."""
    n = [outside, index_of(ior, wavelength), index_of(below.get("material", below.get("int_ior")), wavelength)]
    return tmm.coh_tmm(pol, n[::-1] if backwards else n, [np.inf, thickness * 1e3, np.inf], angle, wavelength)


def filmed(ior, thickness, **parameters):
    exterior = {} if "material" in parameters else {"ext_ior": 1.0}
    return {"thin_film_ior": ior, "thin_film_thickness": thickness, **exterior, **parameters}


@functools.cache
def spectrum():
    """Of wide lobes: light in most directions."""
    return md.precompute(md.gratings.sinusoidal(2.5, 0.3), coherence_length=4.0, wavelengths=(200.0, 830.0))


def load(**parameters):
    """The grating without E, which does not depend on the film."""
    return mi.load_dict({"type": "diffraction_grating", "spectrum": spectrum(), "conserve_energy": False, **parameters})


def material_of(bsdf):
    return bsdf.layers.grating.theory.boundary


def powers(bsdf, cosines, wavelengths):
    """R and T of the material, (n,), at cosines that are negative from below."""
    si = interaction([0, 0, 1], [[w] * 4 for w in wavelengths], len(wavelengths))
    return [np.array(p)[0].astype(float) for p in material_of(bsdf).r_and_t(si, floats(cosines), mi.Bool(True))]


@pytest.mark.parametrize("below", ["dielectric", "metal"])
@pytest.mark.parametrize("film", FILMS)
def test_a_plane_reflects_and_transmits_as_by_transfer_matrices(llvm, film, below):
    ior, thickness = FILMS[film]
    cases = list(itertools.product(WAVELENGTHS, np.deg2rad(ANGLES)))
    wavelengths, angles = np.transpose(cases)
    reflected, transmitted = powers(load(**filmed(ior, thickness, **BELOW[below])), np.cos(angles), wavelengths)
    expected = [[layers(pol, ior, thickness, BELOW[below], *case) for pol in "sp"] for case in cases]
    wanted = np.array([[np.mean([pol[power] for pol in case]) for power in "RT"] for case in expected])
    np.testing.assert_allclose(reflected, wanted[:, 0], atol=1e-4)
    if below == "dielectric":
        np.testing.assert_allclose(transmitted, wanted[:, 1], atol=1e-4)
        assert np.ptp(wanted[:, 0]) > 0.1
    if isinstance(ior, float) and below == "dielectric":
        np.testing.assert_allclose(reflected + transmitted, 1, atol=1e-5)
    elif below == "dielectric":
        assert (reflected + transmitted).max() < 0.99


@pytest.mark.parametrize("film", ["high", "absorbing"])
def test_light_from_below_is_reflected_as_by_transfer_matrices(llvm, film):
    """Beyond the critical angle, too; as much is transmitted as in the reverse direction."""
    ior, thickness = FILMS[film]
    cases = list(itertools.product(WAVELENGTHS, np.deg2rad([0, 20, 40, 45, 60, 80])))
    wavelengths, angles = np.transpose(cases)
    bsdf = load(**filmed(ior, thickness, int_ior=1.5, transmission="interface"))
    reflected, transmitted = powers(bsdf, -np.cos(angles), wavelengths)
    for n, (wavelength, angle) in enumerate(cases):
        below = {"int_ior": 1.5}
        expected = [layers(pol, ior, thickness, below, wavelength, angle, backwards=True) for pol in "sp"]
        assert reflected[n] == pytest.approx(np.mean([e["R"] for e in expected]), abs=1e-4)
        assert transmitted[n] == pytest.approx(np.mean([e["T"] for e in expected]), abs=1e-4)


@pytest.mark.parametrize(("film", "below", "backwards"), [("high", "dielectric", False), ("high", "dielectric", True),
                         ("absorbing", "dielectric", False), ("low", "metal", False)])  # fmt: skip
def test_polarised_planes_have_the_amplitudes_of_transfer_matrices(film, below, backwards):
    """R_s, R_p and the phase between s and p; the same of transmitted light."""
    use("llvm_ad_spectral_polarized")
    ior, thickness = FILMS[film]
    cases = list(itertools.product(WAVELENGTHS, np.deg2rad([0, 25, 40, 60, 80])))
    wavelengths, angles = np.transpose(cases)
    transmission = {"transmission": "interface"} if backwards else {}
    material = material_of(load(**filmed(ior, thickness, **BELOW[below], **transmission)))
    si = interaction([0, 0, 1], [[w] * 4 for w in wavelengths], len(cases))
    cosines = floats(-np.cos(angles) if backwards else np.cos(angles))
    for reflects in [True, False] if below == "dielectric" else [True]:
        matrix = np.array(material.planes(si, cosines, mi.Bool(reflects), mi.Bool(True))[0]).astype(float)
        for n, (wavelength, angle) in enumerate(cases):
            found = matrix[..., n]
            s, p = (layers(pol, ior, thickness, BELOW[below], wavelength, angle, backwards=backwards) for pol in "sp")
            of_s, of_p = (each["R" if reflects else "T"] for each in (s, p))
            np.testing.assert_allclose([found[0, 0] + found[0, 1], found[0, 0] - found[0, 1]], [of_s, of_p], atol=1e-4)
            cross = s["r"] * np.conj(p["r"]) if reflects else s["t"] * np.conj(p["t"])
            cross *= np.sqrt(of_s * of_p) / max(abs(cross), 1e-9)
            np.testing.assert_allclose(found[2, 2] + 1j * found[3, 2], cross, atol=2e-4)


MODES = {
    "reflection": {"int_ior": 1.5},
    "interface": {"int_ior": 1.5, "transmission": "interface"},
    "sheet": {"int_ior": 1.5, "transmission": "sheet"},
    "coat": {"int_ior": 1.7, "coat_ior": 1.4},
    "metal": {"material": "Au"},
}


def pairs(rng, count, sides):
    wi, wo = random_directions(rng, count), random_directions(rng, count)
    if sides:
        wi[:, 2] *= rng.choice([-1, 1], count)
        wo[:, 2] *= rng.choice([-1, 1], count)
    return wi, wo


def values(bsdf, wi, wo):
    """f cos θ_o, (4, n), or Mueller matrices (4, 4, 4, n)."""
    ctx, si = mi.BSDFContext(), interaction(wi, (400.0, 500.0, 600.0, 700.0), len(wi))
    value = bsdf.eval(ctx, si, mi.Vector3f(*map(floats, wo.T)))
    dr.eval(value)
    return np.array(value, np.float64)


@pytest.mark.few(3)
@pytest.mark.parametrize("variant", ["llvm_ad_spectral", "llvm_ad_spectral_polarized"])
@pytest.mark.parametrize("mode", MODES)
def test_no_thickness_and_indices_of_either_medium_are_the_bare_surface(mode, variant):
    use(variant)
    parameters = MODES[mode]
    bare = load(**parameters)
    wi, wo = pairs(np.random.default_rng(3), 3000, "transmission" in parameters)
    expected = values(bare, wi, wo)
    scale = np.abs(expected).max()
    assert scale > 0
    above = parameters.get("coat_ior", "air" if "int_ior" in parameters else 1.0)
    below = parameters.get("int_ior", parameters.get("material"))
    for film in ((2.35, 0.0), (above, 0.3), (below, 0.3)):
        found = values(load(**parameters, thin_film_ior=film[0], thin_film_thickness=film[1]), wi, wo)
        np.testing.assert_allclose(found, expected, rtol=1e-5, atol=2e-6 * scale, err_msg=str(film))
    filmed = values(load(**parameters, thin_film_ior=2.35, thin_film_thickness=0.1), wi, wo)
    shown = np.abs(expected) > 0.01 * scale
    assert (np.abs(filmed - expected) > 0.2 * np.abs(expected))[shown].any()


@pytest.mark.few(3)
@pytest.mark.parametrize("mode", MODES)
def test_the_plugin_reflects_as_a_plane_at_the_half_vector(llvm, mode):
    """Relative to the bare surface, by tmm, at all four wavelengths."""
    parameters, wavelengths = MODES[mode], (400.0, 500.0, 600.0, 700.0)
    rng = np.random.default_rng(5)
    wi, wo = pairs(rng, 2000, False)
    bare = values(load(**parameters), wi, wo)
    found = values(load(**parameters, **ABSORBING), wi, wo)
    outside = parameters.get("coat_ior", 1.0)
    inside = [np.stack([w[:, 0] / outside, w[:, 1] / outside, np.sqrt(1 - (w[:, :2] ** 2).sum(1) / outside**2)], 1)
              for w in (wi, wo)]  # fmt: skip
    cos_half = np.sqrt((1 + (inside[0] * inside[1]).sum(1)) / 2)
    for channel, wavelength in enumerate(wavelengths):
        shown = np.flatnonzero(bare[channel] > 1e-3 * bare.max())[:40]
        assert len(shown) == 40
        for n in shown:
            with_film, without = (
                np.mean([layers(pol, "Cu2O", d, parameters, wavelength, np.arccos(cos_half[n]), outside)["R"]
                         for pol in "sp"]) for d in (0.1, 0.0)
            )  # fmt: skip
            assert found[channel, n] / bare[channel, n] == pytest.approx(with_film / without, rel=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(("mode", "least"), [("interface", 0.99), ("sheet", 0.95)])
def test_a_relief_with_a_clear_film_reflects_and_transmits_all_light(llvm, mode, least, side):
    """Of a sheet, light that both faces reflect is lost; a film that absorbs leaves less."""
    ctx = mi.BSDFContext(mi.TransportMode.Importance)
    wi = direction(15, 20) * [1, 1, side]
    bsdfs = [load(**MODES[mode], height_scale=0.1, conserve_energy=True, **film) for film in ({}, ZNS, ABSORBING)]
    albedos = [draw(bsdf, wi, 100_000, ctx)[1].mean(1) for bsdf in bsdfs]
    bare, clear, absorbing = albedos
    for albedo in (bare, clear):
        assert least < albedo.min() <= albedo.max() < 1.005
    assert (absorbing < clear).all()
    assert absorbing.min() < 0.8


@pytest.mark.few(2)
@pytest.mark.parametrize("mode", MODES)
def test_the_reverse_pair_has_the_same_value(llvm, mode):
    parameters = MODES[mode]
    bsdf = load(**parameters, **ABSORBING, orientation=30.0)
    wi, wo = pairs(np.random.default_rng(6), 3000, "transmission" in parameters)
    there, back = values(bsdf, wi, wo) / np.abs(wo[:, 2]), values(bsdf, wo, wi) / np.abs(wi[:, 2])
    if mode == "interface":
        # Radiance scales with n² of its medium.
        n_i, n_o = (np.where(w[:, 2] > 0, 1.0, 1.5) for w in (wi, wo))
        there, back = there / n_i**2, back / n_o**2
    assert there.max() > 0
    np.testing.assert_allclose(there, back, rtol=1e-3, atol=1e-5 * there.max())


def test_a_thickness_may_vary_over_the_surface(llvm):
    steps = bitmap([[0.05, 0.3]], filter_type="nearest")
    varying = load(int_ior=1.5, thin_film_ior=2.0, thin_film_thickness=steps)
    assert mi.has_flag(varying.flags(), mi.BSDFFlags.SpatiallyVarying)
    wi, wo = direction(20), np.array([direction(20, 180)])
    for u, thickness in ((0.25, 0.05), (0.75, 0.3)):
        expected = evaluate(load(int_ior=1.5, thin_film_ior=2.0, thin_film_thickness=thickness), wi, wo)[0]
        np.testing.assert_allclose(evaluate(varying, wi, wo, uv=(u, 0.5))[0], expected, rtol=1e-5)


@pytest.mark.parametrize("thickness", ["number", "texture"])
@pytest.mark.parametrize("scale", ["number", "texture"])
def test_the_bounds_of_a_thickness_are_those_of_its_products(llvm, thickness, scale):
    """The tables of E and of the samplers hold the films between them."""
    values = {"thickness": [0.05, 0.1], "scale": [0.4, 0.9]}
    kinds = {"thickness": thickness, "scale": scale}
    given = {name: bitmap([of]) if kinds[name] == "texture" else of[0] for name, of in values.items()}
    film = {"thin_film_ior": 2.35, "thin_film_thickness": given["thickness"], "thin_film_scale": given["scale"]}
    bsdf = load(int_ior=1.5, **film)
    (found,), bounds = bsdf.layers.grating.theory.boundary.thicknesses()
    used = [of if kinds[name] == "texture" else of[:1] for name, of in values.items()]
    products = [a * b for a, b in itertools.product(*used)]
    np.testing.assert_allclose([found * bound for bound in bounds], [min(products), max(products)], rtol=1e-6)


def test_a_metal_may_vary_under_a_film(llvm):
    metal = bitmap([[0.5, 2.0]], filter_type="nearest")
    filmed = load(eta=metal, k=3.0, thin_film_ior=2.0, thin_film_thickness=0.1)
    assert mi.has_flag(filmed.flags(), mi.BSDFFlags.SpatiallyVarying)


@pytest.mark.slow
@pytest.mark.parametrize(("mode", "side"), [("reflection", 1), ("interface", 1), ("interface", -1), ("sheet", -1)])
def test_samples_pass_the_chi_square_test(llvm, mode, side):
    ctx = mi.BSDFContext()
    ctx.type_mask = +mi.BSDFFlags.GlossyReflection
    bsdf = load(**MODES[mode], **ABSORBING)
    check_chi_square(bsdf, direction(30, 20) * [1, 1, side], ctx=ctx, cases=4, side=side)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("film", "parameters"),
    [
        (("Al", 0.05), {}),
        (("Ag", 0.03), {}),
        ((4.0, 0.034), {}),
        ((2.35, 0.08), {}),
        (("Al", 0.05), {"transmission": "sheet"}),
        (("Al", 0.05), {"int_ior": 1.05}),
        ((2.35, 2.0), {}),
        (("8 x (2.35, 1.38)", "8 x (0.06, 0.1)"), {}),
    ],
)
def test_a_film_on_a_relief_that_transmits_makes_no_light(llvm, film, parameters):
    """R + T from the samples: with E of the bare surface it reached 1.9."""
    surface = {"profile": "sinusoidal", "period": 2.5, "depth": 0.5, "ext_ior": 1.0, "int_ior": 1.5}
    film = dict(zip(("thin_film_ior", "thin_film_thickness"), film, strict=True))
    bsdf = mi.load_dict({"type": "diffraction_grating", **surface, "transmission": "interface", **film, **parameters})
    ctx = mi.BSDFContext()
    ctx.mode = mi.TransportMode.Importance  # powers, without the scaling of radiance
    for theta, side in ((0, 1), (60, 1), (89, 1), (80, -1)):
        _, weight = draw(bsdf, direction(theta) * [1, 1, side], 1 << 15, ctx, wavelengths=WAVELENGTHS[::2][:4])
        total, error = weight.mean(1), weight.std(1) / np.sqrt(1 << 15)
        assert (total < 1.02 + 4 * error).all()
        assert total.max() > 0.5


WRONG = [
    ({"thin_film_thickness": "nosuch.png"}, "thin_film_thickness: nosuch.png: no such file"),
    ({"thin_film_thickness": -0.1}, "thin_film_thickness: got -0.1, wanted 0 to 4 um"),
    ({"thin_film_thickness": float("nan")}, "thin_film_thickness: got nan, wanted a number"),
    ({"thin_film_thickness": 5.0}, "thin_film_thickness: got 5, wanted 0 to 4 um; a thicker layer is a coat"),
    ({"material": "none"}, "thin_film_thickness: got a film on material=none"),
    ({"thin_film_ior": "zinc"}, "thin_film_ior: got 'zinc', wanted one of"),
    ({"thin_film_ior": "titanium"}, "thin_film_ior: got 'titanium', did you mean Ti"),
    ({"thin_film_ior": -1.0}, "thin_film_ior: got -1.0, wanted a positive index"),
    ({"thin_film_ior": True}, "thin_film_ior: got True, wanted a positive index"),
    ({"theory": "rigorous"}, "thin_film_thickness: got 0.08, wanted none with theory=rigorous"),
]


@pytest.mark.parametrize(("parameters", "message"), WRONG)
def test_wrong_films_are_refused_in_one_line(llvm, parameters, message):
    base = {"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25}
    with pytest.raises(RuntimeError, match=message) as error:
        mi.load_dict({**base, **ZNS, **parameters})
    assert "\n" not in str(error.value).partition("RequestError: ")[2].strip()


def test_half_a_film_and_textures_out_of_range_are_refused(llvm):
    base = {"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25}
    for name, value in ZNS.items():
        with pytest.raises(RuntimeError, match=f"{name}: got it alone"):
            mi.load_dict({**base, name: value})
    with pytest.raises(RuntimeError, match=r"got 4\.5, wanted 0 to 4 um"):
        mi.load_dict({**base, **ZNS, "thin_film_thickness": bitmap([[0.1, 4.5]])})
    bsdf = mi.load_dict({**base, **ZNS})
    parameters = mi.traverse(bsdf)
    parameters["thin_film_thickness"] = mi.Float(-1.0)
    with pytest.raises(ValueError, match="got -1, wanted 0 to 4 um"):
        parameters.update()
