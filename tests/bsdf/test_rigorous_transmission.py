"""Transmission by rigorous theory: the BSDF against its tables in float64."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import (
    check_chi_square,
    coarse_glass,
    direction,
    floats,
    interaction,
    random_directions,
    six_samples,
    use,
    vectors,
)
from scipy.special import erf

import mitsuba_diffraction as md
from mitsuba_diffraction.rigorous.rigorous_spectrum import Axes, RigorousSpectrum
from mitsuba_diffraction.settings import RigorousSettings

PERIOD, ETA, WAVELENGTH = 0.3, 1.5, 0.45
WAVELENGTHS = (405.0, 440.0, 470.0, 498.0)
IMPORTANCE = mi.TransportMode.Importance


@pytest.fixture(scope="module", params=["interface", "sheet"])
def glass(request):
    """Return a coarse table of reflected and transmitted light, with Mueller matrices."""
    return coarse_glass(request.param)


@pytest.fixture(autouse=True)
def llvm():
    use("llvm_ad_spectral")


def plugin(spectrum, **parameters):
    scene = {"type": "diffraction_grating", "spectrum": spectrum, "transmission": spectrum.transmission}
    return mi.load_dict({**scene, "int_ior": ETA, "ext_ior": 1.0, **parameters})


def towards(theta, phi, side):
    return np.array(direction(theta, phi)) * [1, 1, side]


def index(spectrum, omega):
    """Return n outside, for directions (…, 3)."""
    return np.where(np.asarray(omega)[..., 2] < 0, spectrum.indices[1], 1.0)


def exit_of(spectrum, wi, m, transmitted, wavelength=WAVELENGTH):
    """Return the direction of order m; None near the horizon."""
    side = -np.sign(wi[2]) if transmitted else np.sign(wi[2])
    n = index(spectrum, [0, 0, side])
    k = -index(spectrum, wi) * wi[:2] - [m * wavelength / PERIOD, 0]
    return None if k @ k > (0.97 * n) ** 2 else np.append(k, side * np.sqrt(n**2 - k @ k)) / n


def lobe_of(spectrum, wo):
    """Return directions around ω_o, (n, 3), where they exist, offsets in σ_q, (n, 2), and dk² = n² cos θ dω."""
    step = np.linspace(-4, 4, 33)
    offsets = np.stack(np.meshgrid(step, step), -1).reshape(-1, 2)
    n, sigma = index(spectrum, wo), spectrum.lobe_width * WAVELENGTH
    k = n * wo[:2] + sigma * offsets
    z = np.sqrt(n**2 - (k**2).sum(-1))
    return np.column_stack([k, np.sign(wo[2]) * z]) / n, offsets, (sigma * (step[1] - step[0])) ** 2


def power_of_order(bsdf, wi, wo):
    """Return the power in the lobe around ω_o, by quadrature."""
    omega, _, area = lobe_of(bsdf.spectrum, wo)
    si = interaction(wi, (WAVELENGTH * 1e3,) * 4, len(omega))
    value = np.array(bsdf.eval(mi.BSDFContext(IMPORTANCE), si, vectors(omega)))[0]
    return (value / (index(bsdf.spectrum, wo) ** 2 * abs(omega[:, 2]))).sum() * area


def power_in_table(spectrum, wi, wo, m):
    """Return ∫ η N dq over the lobe by the same quadrature, η of pairs of directions."""
    omega, offsets, area = lobe_of(spectrum, wo)
    c, k_y = ((index(spectrum, wo) * omega - index(spectrum, wi) * wi)[:, :2] * PERIOD / (2 * WAVELENGTH)).T
    square = (PERIOD / WAVELENGTH) ** 2 - k_y**2
    sides = int(wi[2] < 0), int(wo[2] < 0)
    eta = spectrum.evaluate(m, c, np.sign(square) * np.sqrt(abs(square)), WAVELENGTH, sides)
    inside, cutoff = (abs(offsets) < spectrum.cutoff_sigmas).all(-1), spectrum.cutoff_sigmas
    density = np.exp(-(offsets**2).sum(-1) / 2) * inside / (2 * np.pi * erf(cutoff / np.sqrt(2)) ** 2)
    return (eta * density).sum() * area / (spectrum.lobe_width * WAVELENGTH) ** 2


@pytest.mark.few(2)
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize(("theta", "phi"), [(0, 0), (25, 40), (35, 200), (60, 95)])
def test_orders_have_the_powers_of_the_table(glass, theta, phi, side):
    bsdf, wi = plugin(glass), towards(theta, phi, side)
    found, wanted = [], []
    for transmitted in (False, True):
        for m in glass.efficiencies(wi, WAVELENGTH, transmitted)[0]:
            if (wo := exit_of(glass, wi, m, transmitted)) is not None:
                found.append(power_of_order(bsdf, wi, wo))
                wanted.append(power_in_table(glass, wi, wo, m))
    np.testing.assert_allclose(found, wanted, atol=0.001)
    assert sum(wanted) > 0.8


def pairs(spectrum, count=4096):
    """Return pairs of directions near reflected and transmitted orders."""
    rng = np.random.default_rng(4)
    wi = rng.normal(size=(count, 3))
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    side = rng.choice([1, -1], count)
    n_o = index(spectrum, np.stack([0 * side, 0 * side, side], -1))
    k = -index(spectrum, wi)[:, None] * wi[:, :2] + rng.normal(size=(count, 2)) * spectrum.lobe_width * WAVELENGTH
    k[:, 0] -= rng.integers(-2, 3, count) * WAVELENGTH / PERIOD
    z = n_o**2 - (k**2).sum(-1)
    keep = (z > 0.01) & (abs(wi[:, 2]) > 0.1)
    wo = np.concatenate([k, (side * np.sqrt(np.maximum(z, 0)))[:, None]], -1) / n_o[:, None]
    return wi[keep], wo[keep]


def test_transmission_and_reflection_are_reciprocal(glass):
    bsdf = plugin(glass)
    wi, wo = pairs(glass)
    n_i, n_o = index(glass, wi), index(glass, wo)

    def f(i, o, mode=IMPORTANCE):
        value = bsdf.eval(mi.BSDFContext(mode), interaction(i, (WAVELENGTH * 1e3,) * 4, len(i)), vectors(o))
        return np.array(value)[0] / abs(o[:, 2])

    there, back = f(wi, wo) / n_o**2, f(wo, wi) / n_i**2
    assert (there > 1).sum() > 500
    np.testing.assert_allclose(there, back, rtol=2e-4, atol=1e-4 * there.max())
    # Radiance is scaled by the squared ratio of the indices.
    radiance = f(wi, wo, mi.TransportMode.Radiance)
    np.testing.assert_allclose(radiance, there * n_i**2, rtol=1e-5, atol=1e-5 * radiance.max())


@pytest.mark.few(2)
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("component", [0, 1])
def test_samples_follow_the_density_on_both_sides(glass, side, component):
    bsdf, wi = plugin(glass), towards(35, 20, side)
    ctx = mi.BSDFContext()
    ctx.component = component
    check_chi_square(bsdf, wi, WAVELENGTHS, ctx, cases=8, side=side if component == 0 else -side)


@pytest.mark.few(2)
@pytest.mark.parametrize("theta", [0, 40, 75])
@pytest.mark.parametrize("side", [1, -1])
def test_weights_average_to_the_efficiencies(glass, theta, side):
    bsdf, wi, count = plugin(glass), towards(theta, 10, side), 1 << 16
    u = np.random.default_rng(1).random((3, count)).astype(np.float32)
    si = interaction(wi, (WAVELENGTH * 1e3,) * 4, count)
    bs, weight = bsdf.sample(mi.BSDFContext(IMPORTANCE), si, mi.Float(u[0]), mi.Point2f(u[1:]))
    weight, is_transmitted = np.array(weight)[0], np.array(bs.wo)[2] * wi[2] < 0
    for transmitted in (False, True):
        wanted = glass.efficiencies(wi, WAVELENGTH, transmitted)[1].sum()
        assert weight[is_transmitted == transmitted].sum() / count == pytest.approx(wanted, abs=0.02)
    assert weight.mean() ** 2 / (weight**2).mean() > 0.5
    drawn = np.array(bs.pdf) > 0
    pdf = np.array(bsdf.pdf(mi.BSDFContext(IMPORTANCE), si, bs.wo))
    np.testing.assert_allclose(pdf[drawn], np.array(bs.pdf)[drawn], rtol=1e-3)
    names = np.where(is_transmitted, int(mi.BSDFFlags.GlossyTransmission), int(mi.BSDFFlags.GlossyReflection))
    np.testing.assert_array_equal(np.array(bs.sampled_type)[drawn], names[drawn])


def test_a_sheet_has_no_second_flat_face(glass):
    assert plugin(glass).component_count() == 2


def entries(matrix):
    """Return the matrix at the first wavelength, (4, 4)."""
    dr.eval(matrix)  # in one kernel
    return np.array([[np.ravel(matrix[i, j][0])[0] for j in range(4)] for i in range(4)])


def between_stokes_axes(matrix, source, exit_):
    """Return a matrix between Mitsuba's axes from one between (ê, k̂ × ê), ê the component of ŷ perpendicular to k̂."""
    full = mi.Spectrum(0.0)
    for i, j in np.ndindex(4, 4):
        full[i, j] = mi.UnpolarizedSpectrum(floats(matrix[i, j]))  # a number would be compiled into the kernel
    waves = [vectors(-source), vectors(exit_)]
    axes = [dr.normalize(mi.Vector3f(0, 1, 0) - k.y * k) for k in waves]
    turned = [(k, axis, mi.mueller.stokes_basis(k)) for k, axis in zip(waves, axes, strict=True)]
    return entries(mi.mueller.rotate_mueller_basis(full, *turned[0], *turned[1]))


@pytest.mark.parametrize("variant", ["llvm_ad_spectral_polarized"])
def test_mueller_matrices_are_those_of_the_table(glass, variant):
    use(variant)
    bsdf, seen = plugin(glass), 0
    for theta, phi, side in ((50, 20, 1), (40, 200, -1)):
        wi = towards(theta, phi, side)
        alpha, k_y = -index(glass, wi) * wi[:2] * PERIOD / WAVELENGTH
        square = (PERIOD / WAVELENGTH) ** 2 - k_y**2
        g = np.sign(square) * np.sqrt(abs(square))
        for transmitted in (False, True):
            ways = int(side < 0), int((side < 0) != transmitted)
            for m in (-1, 0, 1):
                if (wo := exit_of(glass, wi, m, transmitted)) is None:
                    continue
                wanted = glass.evaluate(m, alpha - m / 2, g, WAVELENGTH, ways, mueller=True)
                # Light of the opposite k_y is mirrored at the plane of incidence.
                signs = np.array([1, 1, -1, -1]) if k_y < 0 else np.ones(4)
                wanted = np.outer(signs, signs) * wanted / wanted[0, 0]
                # The table is coarse: unpolarised light would become more than polarised.
                wanted /= np.sqrt(max((wanted[0, 1:] ** 2).sum(), (wanted[1:, 0] ** 2).sum(), 1))
                wanted[0, 0] = 1
                wanted = between_stokes_axes(wanted, wi, wo)
                si = interaction(wi, (WAVELENGTH * 1e3,) * 4)
                found = entries(bsdf.eval(mi.BSDFContext(IMPORTANCE), si, vectors(wo)))
                np.testing.assert_allclose(found / found[0, 0], wanted, atol=2e-3)
                seen += 1
    assert seen >= 7


@pytest.mark.few(1)
@pytest.mark.parametrize("variant", ["llvm_ad_spectral_polarized"])
def test_other_variants_have_equal_values(glass, variant):
    directions = towards(20, 30, 1), towards(50, 250, -1)
    wanted = six_samples(plugin(glass), directions, WAVELENGTHS)
    use(variant)
    found = six_samples(plugin(glass), directions, WAVELENGTHS)
    np.testing.assert_allclose(found, wanted, rtol=2e-3, atol=1e-4 * wanted.max())


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"transmission": "none"}, "transmission: got 'none', but the rigorous spectrum is of transmission={}: say"),
        ({"int_ior": 1.6}, "got int_ior 1.6, but the rigorous spectrum is of int_ior 1.5"),
        ({"material": "Al"}, "material: got 'Al' with transmission={}"),
        ({"coat_ior": 1.4}, "coat_ior: got 1.4 with transmission={}"),
        ({"height_scale": 0.5}, "height_scale: got 0.5, wanted none with theory=rigorous"),
    ],
)
def test_another_transmission_than_that_of_the_table_is_refused(glass, parameters, text):
    with pytest.raises(RuntimeError, match=text.format(glass.transmission)):
        plugin(glass, **parameters)


def test_scenes_build_tables_with_their_transmission(glass, monkeypatch, tmp_path):
    """Profiles and recipes request the transmission of the scene."""
    requested = []
    monkeypatch.setattr(md.Recipe, "cached", lambda recipe, *_: requested.append(recipe.settings) or glass)
    scene = {"type": "diffraction_grating", "int_ior": ETA, "ext_ior": 1.0, "transmission": glass.transmission}
    recipe = tmp_path / "glass.toml"
    recipe.write_text(
        '[surface]\nprofile = "blazed"\nperiod = 0.3\ndepth = 0.05\n[spectrum]\ntheory = "rigorous"\nint_ior = 1.5\n',
        encoding="utf-8",
    )
    mi.load_dict({**scene, "profile": "blazed", "period": 0.3, "depth": 0.05, "theory": "rigorous"})
    mi.load_dict({**scene, "filename": str(recipe)})
    assert [settings.transmission for settings in requested] == [glass.transmission] * 2
    recipe.write_text(recipe.read_text() + 'transmission = "sheet"\n', encoding="utf-8")
    with pytest.raises(RuntimeError, match="transmission: got 'none', but the rigorous spectrum is of"):
        mi.load_dict({**scene, "filename": str(recipe), "transmission": "none"})
    assert len(requested) == 2  # nothing was built


@pytest.mark.parametrize("glass", ["sheet"], indirect=True)
@pytest.mark.parametrize("side", [1, -1])
def test_a_sheet_in_a_uniform_sky_has_the_radiance_of_the_table(glass, side):
    """Rendered by `path`, with reflected and transmitted light."""
    scene = mi.load_dict(
        {
            "type": "scene",
            "sky": {"type": "constant", "radiance": {"type": "uniform", "value": 1.0}},
            "sheet": {"type": "rectangle", "bsdf": plugin(glass)},
        }
    )
    count = 1 << 16
    sampler = mi.load_dict({"type": "independent", "sample_count": count})
    sampler.seed(0, count)
    wi = towards(25, 40, side)
    ray = mi.Ray3f(mi.Point3f(*map(float, wi)), vectors(-wi))
    ray.wavelengths = mi.Spectrum(*WAVELENGTHS)
    found, valid, _ = mi.load_dict({"type": "path", "max_depth": 3}).sample(scene, sampler, mi.RayDifferential3f(ray))
    assert dr.all(valid)
    wanted = [sum(glass.efficiencies(wi, w * 1e-3, way)[1].sum() for way in (False, True)) for w in WAVELENGTHS]
    np.testing.assert_allclose(np.array(found).mean(1), wanted, atol=0.02)


@pytest.mark.parametrize("side", [1, -1])
def test_orders_with_a_rayleigh_anomaly_in_a_bin_are_drawn(side):
    """All orders have equal efficiencies, so that an order missing in a bin would have a large weight."""
    axes = Axes(1.7, (0.36, 0.83), (1, 1, 1), ETA, "interface")
    values = np.full(axes.shape, 0.01, np.float32)
    settings = RigorousSettings(int_ior=ETA, tolerance=0.01, transmission="interface")
    alike = RigorousSpectrum(axes, values, None, settings, 0, 0, 0, 1, "made up", "")
    rng, count = np.random.default_rng(2), 1 << 16
    wi = random_directions(rng, count, 0.2) * [1, 1, side]
    u = rng.random((3, count)).astype(np.float32)
    ctx = mi.BSDFContext(IMPORTANCE)
    _, weight = plugin(alike).sample(ctx, interaction(wi, (500.0,) * 4, count), mi.Float(u[0]), mi.Point2f(u[1:]))
    assert np.array(weight)[0].max() < 2
