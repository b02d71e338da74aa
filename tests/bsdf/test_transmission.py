"""Transmission by a dielectric relief, against closed forms, Mitsuba's own interfaces and quadrature."""

import itertools
import sys

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.special
import scipy.stats
from bsdf_support import check_chi_square, direction, floats, interaction, random_directions, six_samples, use, vectors
from covering import covering

import mitsuba_diffraction as md
from mitsuba_diffraction import testing
from mitsuba_diffraction.bsdf.device_tables import on_device
from mitsuba_diffraction.bsdf.directions import Geometry, Incidence, Interface
from mitsuba_diffraction.bsdf.order_sampler import OrderSampler
from mitsuba_diffraction.optics.film_stack import Stack
from mitsuba_diffraction.optics.refractive_indices import RefractiveIndex, constant

PERIOD, ETA, WAVELENGTH = 3.35, 1.5, 0.5
IMPORTANCE = mi.TransportMode.Importance
KINDS = ["interface", "sheet"]


@pytest.fixture(autouse=True)
def llvm():
    use("llvm_ad_spectral")


def transmitting(kind, profile="sinusoidal", depth=0.5, **parameters):
    """The grating of glass; without E where that is not tested, as its table takes longest."""
    return mi.load_dict(
        {
            "type": "diffraction_grating",
            "profile": profile,
            "period": PERIOD,
            "depth": depth,
            "int_ior": ETA,
            "ext_ior": 1.0,
            "transmission": kind,
            **parameters,
        }
    )


def towards(theta, phi, side):
    return np.array(direction(theta, phi)) * [1, 1, side]


def outside(kind, side):
    return ETA if side < 0 and kind == "interface" else 1.0


def order_power(profile, depth, m, kappa):
    """Return c_m(κ) of a profile of full depth `depth`."""
    if profile == "sinusoidal":
        return scipy.special.jv(m, kappa * depth / 2) ** 2
    return np.sinc(kappa * depth / (2 * np.pi) - m) ** 2


def fresnel(cos_i, cos_o, n_i, n_o):
    s = (n_i * cos_i - n_o * cos_o) / (n_i * cos_i + n_o * cos_o)
    p = (n_o * cos_i - n_i * cos_o) / (n_o * cos_i + n_i * cos_o)
    return (s**2 + p**2) / 2


def closed_form(kind, profile, depth, wi, m):
    """Return K (1 − F) c_m of a transmitted order, and its direction; None where it does not propagate."""
    side = np.sign(wi[2])
    k_i = outside(kind, side) * wi[:2]
    k_o = -k_i - [m * WAVELENGTH / PERIOD, 0]
    n_out = outside(kind, -side)
    if k_o @ k_o >= 0.999 * n_out**2:
        return None
    n_i, n_o = (1, ETA) if side > 0 else (ETA, 1)
    z_i, z_o = np.sqrt(n_i**2 - k_i @ k_i), np.sqrt(n_o**2 - k_o @ k_o)
    v = np.append(k_i + k_o, side * (z_i - z_o))
    square = v @ v
    a_i, a_o = (square + n_i**2 - n_o**2) / 2, (square + n_o**2 - n_i**2) / 2
    if a_i * a_o > 0:
        return 0.0, np.append(k_o, -side * np.sqrt(n_out**2 - k_o @ k_o)) / n_out  # no facet refracts the pair
    k = abs(a_i * a_o) / (z_i * z_o * v[2] ** 2)
    cosines = abs(a_i) / np.sqrt(square) / n_i, abs(a_o) / np.sqrt(square) / n_o
    power = k * (1 - fresnel(*cosines, n_i, n_o)) * order_power(profile, depth, m, 2 * np.pi * v[2] / WAVELENGTH)
    if kind == "sheet":
        cos = np.sqrt(1 - k_o @ k_o) if side > 0 else abs(wi[2])
        power *= 1 - fresnel(cos, np.sqrt(1 - (1 - cos**2) / ETA**2), 1, ETA)
    return power, np.append(k_o, -side * np.sqrt(n_out**2 - k_o @ k_o)) / n_out


def power_of_order(bsdf, kind, wi, wo):
    """Return the power in the lobe around ω_o, by quadrature."""
    sigma = bsdf.spectrum.lobe_width
    step = np.linspace(-4, 4, 33) * sigma * WAVELENGTH
    u, v = (x.ravel() for x in np.meshgrid(step, step))
    n = outside(kind, np.sign(wo[2]))
    k = n * wo[:2, None] + [u, v]
    z = n**2 - (k**2).sum(0)
    omega = np.stack([*k, np.sign(wo[2]) * np.sqrt(np.maximum(z, 0))]) / n
    si = interaction(wi, (WAVELENGTH * 1e3,) * 4, omega.shape[1])
    value = np.array(bsdf.eval(mi.BSDFContext(IMPORTANCE), si, vectors(omega.T)))[0]
    # dk² = n² cos θ dω.
    return (value / np.maximum(n**2 * abs(omega[2]), 1e-6) * (z > 0)).sum() * (step[1] - step[0]) ** 2


@pytest.mark.few(1)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize(("profile", "depth"), [("sinusoidal", 0.5), ("blazed", 0.5), ("blazed", 0.8)])
@pytest.mark.parametrize(("theta", "phi"), [(0, 0), (25, 40), (50, 200)])
def test_orders_have_the_powers_of_the_closed_form(kind, profile, depth, theta, phi):
    bsdf = transmitting(kind, profile, depth, shadowing="none")
    for side in (1, -1):
        wi = towards(theta, phi, side)
        found, wanted = [], []
        for m in range(-14, 15):
            if (order := closed_form(kind, profile, depth, wi, m)) is not None:
                wanted.append(order[0])
                found.append(power_of_order(bsdf, kind, wi, order[1]))
        assert len(wanted) > 5
        assert np.abs(np.subtract(found, wanted)).sum() < 0.005 * max(1, np.sum(wanted))


def test_a_gap_of_air_in_glass_has_the_powers_of_the_closed_form_and_reflects_totally(monkeypatch):
    """Regression: light that a sheet reflects totally made NaN of the table that draws orders, which did not load."""
    monkeypatch.setattr(sys.modules[__name__], "ETA", 1 / ETA)
    bsdf = transmitting("sheet", depth=0.2, shadowing="none", conserve_energy=False)
    for side in (1, -1):
        wi = towards(25, 40, side)
        orders = [order for m in (-1, 0, 1) if (order := closed_form("sheet", "sinusoidal", 0.2, wi, m)) is not None]
        found = [power_of_order(bsdf, "sheet", wi, wo) for _, wo in orders]
        assert np.abs(np.subtract(found, [power for power, _ in orders])).sum() < 0.005
        for theta in (25, 60):
            wi = np.broadcast_to(towards(theta, 40, side), (1 << 14, 3))
            _, weight, bs = testing.sample(bsdf, wi, [WAVELENGTH * 1e3] * 4)
            transmitted = (weight[:, 0] * (np.array(bs.wo.z) * side < 0)).mean()
            assert np.isfinite(np.array(bs.pdf)).all()
            assert transmitted == pytest.approx(sum(power for power, _ in orders) if theta == 25 else 0, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("profile", ["sinusoidal", "blazed"])
def test_transmission_is_reciprocal(kind, profile):
    bsdf = transmitting(kind, profile)
    rng = np.random.default_rng(4)
    count = 4096
    wi = rng.normal(size=(count, 3))
    wi /= np.linalg.norm(wi, axis=1, keepdims=True)
    n_i = np.where(wi[:, 2] < 0, outside(kind, -1), 1.0)
    n_o = np.where(wi[:, 2] > 0, outside(kind, -1), 1.0)
    # Directions near orders: elsewhere both are zero.
    m = rng.integers(-4, 5, count)
    k = -n_i[:, None] * wi[:, :2] - np.stack([m * WAVELENGTH / PERIOD, 0 * m], -1) + rng.normal(size=(count, 2)) * 2e-3
    z = n_o**2 - (k**2).sum(-1)
    keep = (z > 0.01) & (abs(wi[:, 2]) > 0.1)
    wo = np.concatenate([k, (-np.sign(wi[:, 2]) * np.sqrt(np.maximum(z, 0)))[:, None]], -1)[keep] / n_o[keep, None]
    wi, n_i, n_o = wi[keep], n_i[keep], n_o[keep]
    ctx, wavelengths = mi.BSDFContext(IMPORTANCE), (WAVELENGTH * 1e3,) * 4

    def f(i, o):
        value = np.array(bsdf.eval(ctx, interaction(i, wavelengths, len(i)), vectors(o)))[0]
        return value / abs(o[:, 2])

    there, back = f(wi, wo) / n_o**2, f(wo, wi) / n_i**2
    assert (there > 1).sum() > 200
    np.testing.assert_allclose(there, back, rtol=1e-4, atol=1e-4 * there.max())
    # Radiance is scaled by the squared ratio of the indices.
    radiance = np.array(bsdf.eval(mi.BSDFContext(), interaction(wi, wavelengths, len(wi)), vectors(wo)))[0]
    np.testing.assert_allclose(radiance, there * abs(wo[:, 2]) * n_i**2, rtol=1e-5, atol=1e-5 * radiance.max())


@pytest.mark.slow
def test_a_sheet_is_reciprocal_where_facets_are_grazed():
    # Regression: 1 − F of light that facets nearly reflect totally had other rounding errors in the reversed pair.
    bsdf = transmitting("sheet", "sinusoidal", int_ior=2.4, coherence_length=2.0, conserve_energy=False)
    rng = np.random.default_rng(3)
    wi, wo = (random_directions(rng, 1 << 15, 0.02) * [1, 1, side] for side in (1, -1))
    there, back = (testing.evaluate(bsdf, i, o, [500.0])[:, 0] / abs(o[:, 2]) for i, o in ((wi, wo), (wo, wi)))
    np.testing.assert_allclose(there, back, rtol=1e-3, atol=1e-6 * there.max())


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("component", [0, 1])
def test_samples_follow_the_density_on_both_sides(kind, side, component):
    bsdf = transmitting(kind, "sinusoidal", 0.4, coherence_length=6.0)
    wi, wavelengths = towards(35, 20, side), (450.0, 500.0, 550.0, 650.0)
    ctx = mi.BSDFContext()
    ctx.component = component
    check_chi_square(bsdf, wi, wavelengths, ctx, cases=8, side=side if component == 0 else -side, ires=32)


@pytest.mark.slow
@pytest.mark.few(2)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("theta", [0, 40, 50, 75])
@pytest.mark.parametrize("side", [1, -1])
def test_sample_weights_have_a_small_variance(kind, theta, side):
    bsdf = transmitting(kind, "sinusoidal", 0.25)
    count = 1 << 17
    u = np.random.default_rng(1).random((3, count)).astype(np.float32)
    si = interaction(towards(theta, 10, side), (450.0, 500.0, 550.0, 650.0), count)
    bs, weight = bsdf.sample(mi.BSDFContext(IMPORTANCE), si, mi.Float(u[0]), mi.Point2f(u[1:]))
    weight = np.array(weight).mean(0)
    assert weight.mean() < 1.004
    assert weight.mean() ** 2 / (weight**2).mean() > 0.5
    pdf = bsdf.pdf(mi.BSDFContext(IMPORTANCE), si, bs.wo)
    glossy = (np.array(bs.pdf) > 0) & ~np.array(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta))
    np.testing.assert_allclose(np.array(pdf)[glossy], np.array(bs.pdf)[glossy], rtol=1e-3)


@pytest.mark.slow
@pytest.mark.few(1)
@pytest.mark.parametrize("theta", [75, 0, 40, 60])
@pytest.mark.parametrize("profile", ["film", "transmission_300"])
@pytest.mark.parametrize("kind", ["sheet", "interface"])
def test_samples_from_above_have_similar_weights(profile, kind, theta):
    # Regression: 0.23 of a sheet of film at 75°, 0.12 of an interface of 300 lines/mm; 0.41 is of a sheet of these.
    bsdf = mi.load_dict({"type": "diffraction_grating", "profile": profile, "transmission": kind})
    count, fractions = 1 << 14, []
    u = np.random.default_rng(1).random((3, count)).astype(np.float32)
    for phi, shift in itertools.product((0, 30, 60, 90), (0.125, 0.375, 0.625, 0.875)):
        wavelengths = 360 + 470 * (shift + np.arange(4)) / 4
        si = interaction(towards(theta, phi, 1), wavelengths, count)
        weight = np.array(bsdf.sample(mi.BSDFContext(IMPORTANCE), si, mi.Float(u[0]), mi.Point2f(u[1:]))[1]).mean(0)
        fractions.append(weight.mean() ** 2 / (weight**2).mean())
    assert np.mean(fractions) > (0.4 if (profile, kind, theta) == ("transmission_300", "sheet", 75) else 0.5)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("profile", "theta", "is_sheet", "above", "reflects"),
    covering(["film", "transmission_300"], [50, 0, 85], *[[False, True]] * 3),
)
def test_reflected_and_transmitted_orders_are_drawn_with_their_probabilities(profile, theta, is_sheet, above, reflects):
    spectrum = md.precompute(md.gratings.PROFILES[profile](), wavelengths=(240.0, 830.0), tolerance=0.01)
    table = OrderSampler(spectrum, Stack(1.0, constant(ETA)), is_sheet)
    kappas = mi.Float(1.0), mi.Float(1.0)
    interface = Interface(
        eta=mi.Float(ETA), is_sheet=is_sheet, kappas=kappas, transmitted_fraction=table.transmitted_fraction
    )
    k_i = interface.wave_vector(vectors(towards(theta, 20, 1 if above else -1)))
    k_o = interface.scattered(k_i, mi.Bool(reflects))
    incidence = Incidence.of(k_i, k_o, interface).at_wavelength(mi.Float(WAVELENGTH))
    m_x, m_y = np.meshgrid(*spectrum.grid.axes())
    share = np.array(
        table.probability(mi.Int32(m_x.ravel()), mi.Int32(m_y.ravel()), incidence, mi.Bool(True)), np.float64
    )
    assert share.sum() == pytest.approx(1, abs=1e-6)
    count = 1 << 18
    u = mi.Float(np.random.default_rng(2).random(count).astype(np.float32))
    drawn_x, drawn_y = table.sample(incidence, u, mi.Bool(True))
    rows, columns = spectrum.grid.shape
    drawn = (np.array(drawn_y) + rows // 2) * columns + np.array(drawn_x) + columns // 2
    often = share * count > 5
    found = np.bincount(drawn, minlength=rows * columns)
    chi_square = ((found - share * count)[often] ** 2 / (share * count)[often]).sum()
    assert abs(chi_square - often.sum()) < 4 * np.sqrt(2 * often.sum())
    # All that propagate can be drawn.
    k = np.array(k_i.tangent).ravel() + WAVELENGTH * np.stack([m_x, m_y], -1) / spectrum.grid.tile_size
    propagates = ((k**2).sum(-1) < np.array(k_o.index)[0] ** 2).ravel()
    assert (share[propagates] > 0).all()


def test_all_orders_that_propagate_in_a_medium_with_dispersion_can_be_drawn():
    """At any wavelength, where n may be other than in the middle of visible light."""
    period, count = 10.0, 1 << 19
    nm = np.arange(340, 861.0)
    medium = RefractiveIndex("dispersive", 1e-3 * nm, 1.46 + 0.02 / (1e-3 * nm) ** 2 + 0j)
    spectrum = md.precompute(md.gratings.sinusoidal(period, 0.2), wavelengths=(205.0, 830.0), tolerance=0.01)
    table = OrderSampler(spectrum, Stack(1.0, medium))
    rng = np.random.default_rng(6)
    omega, wavelength = random_directions(rng, count, least=0.0), rng.uniform(0.36, 0.83, count)
    above, reflects = rng.random((2, count)) < 0.5
    omega[~above, 2] *= -1
    n, kappas = medium(wavelength).real, (mi.Float(1.0), mi.Float(1.0))
    interface = Interface(eta=floats(n), kappas=kappas, transmitted_fraction=table.transmitted_fraction)
    k_i = interface.wave_vector(vectors(omega))
    incidence = Incidence.of(k_i, interface.scattered(k_i, on_device(reflects, mi.Bool)), interface)
    incidence = incidence.at_wavelength(floats(wavelength))
    # The first and the last order, by the grating equation.
    n_i, n_o = (np.where(of_side, 1, n) for of_side in (above, above == reflects))
    square = n_o**2 - (n_i * omega[:, 1]) ** 2
    for sign in (-1, 1):
        m = period / wavelength * (-n_i * omega[:, 0] + sign * np.sqrt(np.maximum(square, 0)))
        m = -sign * np.ceil(-sign * m)
        exists = (square > 0) & (np.abs(m) <= spectrum.grid.max_order[0])
        assert exists.sum() > count / 4
        probability = np.array(table.probability(on_device(m, mi.Int32), mi.Int32(0), incidence, mi.Bool(True)))
        assert (probability[exists] > 0).all()


@pytest.mark.slow  # of an index and heights that change, other tests have the values and the sampler
@pytest.mark.parametrize(("height_scale", "eta"), [(1.0, 1.75), (0.5, 1.5), (0.0, 1.5), (0.5, 1.75)])
def test_samples_follow_an_index_and_heights_that_change(height_scale, eta):
    changed, fresh = changed_and_fresh(height_scale, eta)
    u = np.random.default_rng(1).random((3, 1 << 16)).astype(np.float32)
    for side in (1, -1):
        si = interaction(towards(40, 10, side), (540.0, 560.0, 600.0, 650.0), u.shape[1])
        found = [
            bsdf.sample(mi.BSDFContext(IMPORTANCE), si, mi.Float(u[0]), mi.Point2f(u[1:])) for bsdf in (changed, fresh)
        ]
        (etas, _), weights = ([np.unique(np.array(bs.eta)) for bs, _ in found], [np.array(w) for _, w in found])
        np.testing.assert_allclose(etas, np.sort([1, eta**side]), rtol=1e-6)
        there, wanted = (weight.mean(1) for weight in weights)
        error = np.hypot(*(weight.std(1) / np.sqrt(u.shape[1]) for weight in weights))
        np.testing.assert_array_less(np.abs(there - wanted), 4 * error + 1e-3)
        assert (weights[0].mean(0) > 0).mean() > 0.5


def changed_and_fresh(height_scale, eta):
    """Return a plugin with changed parameters, and one loaded with them; the spectrum is for 360 nm at n = 1.8."""
    spectrum = md.precompute(md.gratings.blazed(PERIOD, 0.8), wavelengths=(200.0, 830.0 / 1.2), tolerance=1e-2)
    scene = {"type": "diffraction_grating", "spectrum": spectrum, "transmission": "interface", "ext_ior": 1.0}
    changed = mi.load_dict({**scene, "int_ior": ETA})
    parameters = mi.traverse(changed)
    for name, value in (("height_scale", height_scale), ("eta", eta)):
        parameters[name] = value
        parameters.update()
    return changed, mi.load_dict({**scene, "height_scale": height_scale, "int_ior": eta})


@pytest.mark.slow
@pytest.mark.few(1)
@pytest.mark.parametrize("eta", [1.25, 1.75])
def test_an_index_that_changes_has_its_own_e_and_orders(eta):
    changed, fresh = changed_and_fresh(1.0, eta)
    rng = np.random.default_rng(3)
    wi, wo = rng.normal(size=(2, 1 << 14, 3))
    wi, wo = (omega / np.linalg.norm(omega, axis=1, keepdims=True) for omega in (wi, wo))
    si = interaction(wi, (365.0, 450.0, 550.0, 700.0), len(wi))
    # Whatever is drawn by either can be evaluated by the other.
    for bsdf, other in ((changed, fresh), (fresh, changed)):
        bs, _ = bsdf.sample(mi.BSDFContext(), si, mi.Float(rng.random(len(wi))), mi.Point2f(rng.random((2, len(wi)))))
        value, pdf = (np.array(x) for x in bsdf.eval_pdf(mi.BSDFContext(), si, bs.wo))
        of_other, pdf_of_other = (np.array(x) for x in other.eval_pdf(mi.BSDFContext(), si, bs.wo))
        np.testing.assert_allclose(of_other, value, rtol=1e-4, atol=1e-3)
        np.testing.assert_allclose(pdf_of_other, pdf, rtol=1e-4, atol=1e-3)


def test_an_index_is_refused_for_which_the_spectrum_has_no_wavelengths():
    parameters = mi.traverse(transmitting("interface", conserve_energy=False))
    parameters["eta"] = 1.6
    with pytest.raises(ValueError, match=r"int_ior: got 1\.6, and a spectrum for wavelengths from 240 nm"):
        parameters.update()


@pytest.mark.slow
def test_other_parameters_leave_tables_of_varying_scales(monkeypatch):
    heights = {"type": "checkerboard", "color0": 0.95, "color1": 1.0}
    parameters = mi.traverse(transmitting("interface", period=1.0, depth=0.1, height_scale=heights))
    monkeypatch.setattr("mitsuba_diffraction.bsdf.shared.EnergyTable.of", None)
    monkeypatch.setattr("mitsuba_diffraction.bsdf.shared.OrderSampler", None)
    parameters["orientation.value"] = 30.0
    parameters.update()


@pytest.mark.slow
def test_bins_in_which_no_order_propagates_are_empty():
    """Inside glass, beyond the critical angle of all orders of a fine grating: 0/0 was no probability."""
    bsdf = transmitting("interface", depth=1.0, lateral_scale=0.1, conserve_energy=False)
    wi = testing.direction(80, 40) * [1, 1, -1]
    _, weight, bs = testing.sample(bsdf, np.broadcast_to(wi, (1 << 12, 3)), [650.0] * 4)
    assert np.isfinite(weight).all()
    assert np.isfinite(np.array(bs.pdf)).all()
    assert (np.array(bs.wo.z)[weight[:, 0] > 0] < 0).all()  # all light is totally reflected


@pytest.mark.parametrize("kind", KINDS)
def test_samples_have_their_component_and_index(kind):
    bsdf = transmitting(kind, conserve_energy=False)
    assert bsdf.component_count() == (3 if kind == "sheet" else 2)
    assert mi.has_flag(bsdf.flags(), mi.BSDFFlags.GlossyTransmission)
    count = 4096
    u = np.random.default_rng(1).random((3, count)).astype(np.float32)
    for side in (1, -1):
        wi = towards(30, 10, side)
        bs, _ = bsdf.sample(mi.BSDFContext(), interaction(wi, count=count), mi.Float(u[0]), mi.Point2f(u[1:]))
        is_transmitted = np.array(bs.wo)[2] * wi[2] < 0
        assert 0.5 < is_transmitted.mean() < 0.99
        names = np.where(is_transmitted, int(mi.BSDFFlags.GlossyTransmission), int(mi.BSDFFlags.GlossyReflection))
        drawn = (np.array(bs.pdf) > 0) & (np.array(bs.sampled_type) != int(mi.BSDFFlags.DeltaReflection))
        np.testing.assert_array_equal(np.array(bs.sampled_type)[drawn], names[drawn])
        np.testing.assert_array_equal(np.array(bs.sampled_component)[drawn], is_transmitted[drawn])
        eta = np.where(is_transmitted, outside(kind, -side) / outside(kind, side), 1)
        np.testing.assert_allclose(np.array(bs.eta)[drawn], eta[drawn], rtol=1e-6)


def test_the_flat_face_of_a_sheet_is_a_mirror():
    bsdf = transmitting("sheet", conserve_energy=False)
    plane = mi.load_dict({"type": "dielectric", "int_ior": ETA, "ext_ior": 1.0})
    ctx = mi.BSDFContext()
    ctx.component = 2
    wi = towards(60, 20, -1)
    bs, weight = bsdf.sample(ctx, interaction(wi), 0.3, mi.Point2f(0.2, 0.7))
    np.testing.assert_allclose(np.ravel(bs.wo), wi * [-1, -1, 1], atol=1e-6)
    ctx.component = 0
    _, wanted = plane.sample(ctx, interaction(wi * [1, 1, -1]), 0.3, mi.Point2f(0.2, 0.7))
    np.testing.assert_allclose(np.ravel(weight), np.ravel(wanted), rtol=1e-5)
    assert bs.sampled_type[0] == int(mi.BSDFFlags.DeltaReflection)


@pytest.mark.parametrize(
    ("parameters", "named"),
    [
        ({"transmission": "both"}, "transmission: got 'both'"),
        ({"transmission": "sheet", "material": "Al"}, "material: got 'Al' with transmission=sheet"),
        ({"transmission": "sheet", "int_ior": 1.5, "coat_ior": 1.4}, "coat_ior: got 1.4"),
        ({"transmission": "interface", "base": {"type": "diffuse"}}, "base: got a BSDF"),
        ({"transmission": "interface", "int_ior": 1.33, "ext_ior": 1.33}, "int_ior: got that of the outside"),
    ],
)
def test_opaque_materials_and_layers_are_refused(parameters, named):
    with pytest.raises(RuntimeError, match=named.replace("(", "\\(")):
        mi.load_dict({"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.2, **parameters})


def test_a_spectrum_without_the_short_wavelengths_inside_is_refused():
    spectrum = md.precompute(md.gratings.blazed(2.5, 0.2))
    with pytest.raises(RuntimeError, match="build it from 240 nm"):
        mi.load_dict(
            {
                "type": "diffraction_grating",
                "spectrum": spectrum,
                "int_ior": 1.5,
                "transmission": "sheet",
                "ext_ior": 1.0,
            }
        )


@pytest.mark.few(1)
@pytest.mark.parametrize("variant", ["llvm_ad_spectral_polarized"])
@pytest.mark.parametrize("kind", KINDS)
def test_other_variants_have_equal_values(variant, kind):
    directions = towards(20, 30, 1), towards(50, 250, -1)
    wanted = six_samples(transmitting(kind, "blazed", conserve_energy=False), directions)
    use(variant)
    found = six_samples(transmitting(kind, "blazed", conserve_energy=False), directions)
    # The flat face of a sheet polarises: its values are tested in test_polarisation.py.
    alike = slice(8, None) if kind == "sheet" else slice(None)
    np.testing.assert_allclose(found[alike], wanted[alike], rtol=2e-3, atol=1e-4 * wanted[alike].max())


@pytest.mark.slow
def test_water_shortens_wavelengths_outside():
    """At q = m/T orders lie at sin θ = m λ/(n T)."""
    bsdf = mi.load_dict(
        {
            "type": "diffraction_grating",
            "profile": "blazed",
            "period": 2.5,
            "depth": 0.2,
            "ext_ior": 1.33,
            "int_ior": 1.5,
        }
    )
    x = np.linspace(0.1, 0.4, 3001)
    wo = np.stack([-x, 0 * x, np.sqrt(1 - x**2)], -1)
    value = np.array(bsdf.eval(mi.BSDFContext(), interaction((0, 0, 1), (500.0,) * 4, len(x)), vectors(wo)))[0]
    value2 = np.array(
        bsdf.eval(mi.BSDFContext(), interaction((0, 0, 1), (500.0,) * 4, len(x)), vectors(wo * [-1, 1, 1]))
    )[0]
    strongest = x[np.argmax(np.maximum(value, value2))]
    assert min(abs(strongest - m * 0.5 / 1.33 / 2.5) for m in (1, 2)) < 1e-3


@pytest.mark.few(2)
@pytest.mark.parametrize("side", [1, -1])
@pytest.mark.parametrize("theta", [0, 30])
def test_large_smooth_facets_are_those_of_roughdielectric(theta, side):
    """For these, S(q; κ) dq is the density of slopes s = −v_∥/v_z, so that S = P(s) λ²/v_z²."""
    alpha = 0.05
    facets = mi.load_dict(
        {"type": "roughdielectric", "distribution": "beckmann", "alpha": alpha, "int_ior": ETA, "ext_ior": 1.0}
    )
    rng = np.random.default_rng(3)
    slope = rng.uniform(-1.5, 1.5, (500, 2)) * alpha
    wi = towards(theta, 40, side)
    h = np.concatenate([-slope, np.ones((500, 1))], -1)
    h /= np.linalg.norm(h, axis=1, keepdims=True)
    n_i, n_o = (1, ETA) if side > 0 else (ETA, 1)
    cos = h @ wi
    through = np.sqrt(1 - (n_i / n_o) ** 2 * (1 - cos**2))
    wo = (-n_i * wi + (n_i * cos - np.sign(cos) * n_o * through)[:, None] * h) / n_o
    si = interaction(wi, (500.0,) * 4, 500)
    wanted = np.array(facets.eval(mi.BSDFContext(IMPORTANCE), si, vectors(wo)))[0]

    material = mi.Float(ETA)
    interface = Interface(eta=material, kappas=(mi.Float(1e-6), mi.Float(1e-6)))
    pair = Geometry.of(*(interface.wave_vector(vectors(omega)) for omega in (wi, wo)), interface)
    incidence = Incidence.of(pair.incident, pair.outgoing, interface, kappa_sign=pair.kappa_sign)
    incidence = incidence.at_wavelength(mi.Float(0.5))
    factor = pair.order_factor(pair.tangent, incidence, mi.Float(2e6)) * (1 - mi.fresnel(pair.cos_half(), material)[0])
    density = np.exp(-(slope**2).sum(-1) / alpha**2) / (np.pi * alpha**2)
    np.testing.assert_allclose(np.array(factor / dr.square(pair.v_z)) * density, wanted, rtol=5e-3)


@pytest.mark.slow
@pytest.mark.parametrize("side", [1, -1])
def test_a_picture_of_large_smooth_facets_is_that_of_roughdielectric(side):
    """Slopes along x have Beckmann's distribution; the sky is striped."""
    alpha, period, count = 0.1, 80.0, 1600
    slopes = alpha / np.sqrt(2) * scipy.stats.norm.ppf((np.arange(count // 2) + 0.5) / (count // 2))
    heights = np.cumsum(np.append(slopes, slopes[::-1])) * period / count
    surface = md.HeightField(heights[None] - heights.mean(), period / count)
    spectrum = md.precompute(surface, coherence_length=26.0, wavelengths=(360 / ETA, 830), largest_height_range=2.3)
    stripes = 1 + 0.9 * np.sin(24 * np.linspace(0, 2 * np.pi, 256, endpoint=False))
    stripes = 1 + np.outer(np.sin(np.linspace(0, np.pi, 64)) ** 2, stripes - 1)
    sky = mi.Bitmap(np.repeat(stripes[..., None], 3, -1).astype(np.float32))
    media = {"int_ior": ETA, "ext_ior": 1.0}

    def picture(**bsdf):
        film = {"type": "hdrfilm", "width": 12, "height": 12, "rfilter": {"type": "box"}, "pixel_format": "luminance"}
        view = mi.ScalarTransform4f().look_at([1, 0.5, 3 * side], [0, 0, 0], [0, 1, 0])
        scene = {
            "type": "scene",
            "integrator": {"type": "path", "max_depth": 3},
            "sky": {"type": "envmap", "bitmap": sky},
            "plane": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(4), "bsdf": {**bsdf, **media}},
            "sensor": {
                "type": "perspective",
                "fov": 40,
                "to_world": view,
                "film": film,
                "sampler": {"type": "independent", "sample_count": 4096},
            },
        }
        return np.array(mi.render(mi.load_dict(scene)))[..., 0]

    found = picture(type="diffraction_grating", spectrum=spectrum, transmission="interface", conserve_energy=False)
    wanted = picture(type="roughdielectric", distribution="beckmann", alpha_u=alpha, alpha_v=0.01)
    difference = np.abs(found - wanted) / wanted.mean()
    assert difference.mean() < 0.02
    assert difference.max() < 0.07
    # Without facets it is another one.
    assert np.abs(picture(type="dielectric") - wanted).mean() / wanted.mean() > 0.08


@pytest.mark.parametrize("kind", KINDS)
def test_reflected_light_is_that_of_an_opaque_grating(kind):
    """Including pairs near the horizon with different polar angles."""
    rng = np.random.default_rng(8)
    count = 1 << 14
    cos, phi = 10 ** rng.uniform(-3, 0, count), rng.uniform(0, 2 * np.pi, count)
    sin = np.sqrt(1 - cos**2)
    wi = np.stack([sin * np.cos(phi), sin * np.sin(phi), cos], -1)
    k = -wi[:, :2] + rng.normal(size=(count, 2)) * 2e-3
    k[:, 0] -= rng.integers(-4, 5, count) * WAVELENGTH / PERIOD
    square = 1 - (k**2).sum(-1)
    wi, wo = wi[square > 0], np.column_stack([k, np.sqrt(np.maximum(square, 0))])[square > 0]
    si = interaction(wi, (WAVELENGTH * 1e3,) * 4, len(wi))
    spectrum = md.precompute(md.gratings.sinusoidal(PERIOD, 0.5), wavelengths=(360.0 / ETA, 830.0))
    scene = {"type": "diffraction_grating", "spectrum": spectrum, "int_ior": ETA, "ext_ior": 1.0}
    found, wanted = (
        np.array(
            mi.load_dict({**scene, "transmission": of, "conserve_energy": False}).eval(
                mi.BSDFContext(), si, vectors(wo)
            )
        )[0]
        for of in (kind, "none")
    )
    assert (wanted > 0).sum() > 4000
    assert (np.minimum(wi[:, 2], wo[:, 2])[wanted > 0] < 0.05).sum() > 500
    np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-4)


def reflected_and_transmitted(bsdf, wi, wavelength, count=1 << 16):
    """Return R and T by samples, and the standard error of their sum."""
    u = np.random.default_rng(1).random((3, count)).astype(np.float32)
    si = interaction(wi, (wavelength * 1e3,) * 4, count)
    bs, weight = bsdf.sample(mi.BSDFContext(IMPORTANCE), si, mi.Float(u[0]), mi.Point2f(u[1:]))
    weight, is_transmitted = np.array(weight)[0], np.array(bs.wo)[2] * wi[2] < 0
    return weight[~is_transmitted].sum() / count, weight[is_transmitted].sum() / count, weight.std() / np.sqrt(count)


@pytest.mark.few(2)
@pytest.mark.parametrize("kind", KINDS)
@pytest.mark.parametrize("relief", [{"depth": 0.0}, {"height_scale": 0.0}, {"height_scale": 1e-8}, {"depth": 0.004}])
def test_a_relief_without_height_is_a_plane(kind, relief):
    bsdf = transmitting(kind, **{"depth": 0.5, "conserve_energy": False, **relief})
    for theta, side in ((0, 1), (0, -1), (50, 1), (50, -1)):
        wi = towards(theta, 20, side)
        n_i, n_o = (1, ETA) if side > 0 or kind == "sheet" else (ETA, 1)
        f = fresnel(
            np.cos(np.deg2rad(theta)), np.emath.sqrt(1 - (n_i / n_o * np.sin(np.deg2rad(theta))) ** 2), n_i, n_o
        )
        f = 1.0 if np.iscomplex(f) else float(np.real(f))
        r, t, _ = reflected_and_transmitted(bsdf, wi, 0.55)
        if kind == "sheet":
            # From below the flat face is met first; light between both faces is left out.
            wanted = (f, (1 - f) ** 2) if side > 0 else (f + (1 - f) ** 2 * f, (1 - f) ** 2)
        else:
            wanted = f, 1 - f
        np.testing.assert_allclose((r, t), wanted, atol=0.015)


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("wi", "wavelength", "relief"),
    [
        pytest.param([0, 1, -0.01], 0.6, {"depth": 0.3}, id="inside, along the horizon"),
        pytest.param([0.87, 0.5, 0.01], 0.6, {"depth": 0.3}, id="along the horizon"),
        *(
            pytest.param(wi, wavelength, {"profile": "blazed", **relief}, id=name, marks=pytest.mark.slow)
            for name, wi, wavelength, relief in (
                ("5 µm deep", [0.809, 0.559, 0.182], 0.4763, {"period": 5.0, "depth": 5.0}),
                ("wide", [-0.979, -0.206, 0.01], 0.621, {"depth": 0.4, "coherence_length": 10.0}),
                ("wider", [-0.979, -0.206, 0.01], 0.621, {"depth": 0.4, "coherence_length": 2.0}),
            )
        ),
    ],
)
def test_the_albedo_of_samples_is_at_most_one(wi, wavelength, relief):
    r, t, error = reflected_and_transmitted(
        transmitting("interface", **relief), np.divide(wi, np.linalg.norm(wi)), wavelength
    )
    # E is linear between the nodes of a table: R + T is at most 1.02.
    assert r + t <= 1.02 + 3 * error


def test_an_invalid_index_is_refused():
    parameters = mi.traverse(transmitting("interface", conserve_energy=False))
    for eta in (1.0, 0.0, -1.5, np.nan):
        parameters["eta"] = mi.Float(eta)
        with pytest.raises(ValueError, match="eta: got"):
            parameters.update()
