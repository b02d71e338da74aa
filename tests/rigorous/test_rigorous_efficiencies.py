"""Rigorous efficiencies against Fresnel's formulas, two coupled-wave solvers, energy, reciprocity and scalar theory."""

import json
from pathlib import Path

import numpy as np
import pytest

from mitsuba_diffraction import HeightField, gratings, rigorous
from mitsuba_diffraction.evaluation.validation.coupled_waves import SOLVED_PROFILES, cases
from mitsuba_diffraction.optics.geometry import fresnel
from mitsuba_diffraction.scalar_theory.closed_form import profile_powers, scalar_orders
from mitsuba_diffraction.scalar_theory.validity import scalar_error

SCATMECH = json.loads((Path(__file__).parents[1] / "data" / "scatmech.json").read_text(encoding="utf-8"))
CONICAL = np.array([-0.3, 0.35, 0.887])


def light(degrees, turned=0.0):
    """ω_i at an angle from the normal, from −x, with the plane of incidence rotated towards +y."""
    angle, azimuth = np.deg2rad([degrees, turned])
    return np.array([-np.sin(angle) * np.cos(azimuth), np.sin(angle) * np.sin(azimuth), np.cos(angle)])


def asymmetric(period, depth, apex, samples=1000):
    x = (np.arange(samples) + 0.5) / samples
    return HeightField(depth * np.where(x < apex, x / apex, (1 - x) / (1 - apex))[None], (period / samples, period))


def difference(found, wanted):
    return np.abs(found - wanted).sum() / wanted.sum()


@pytest.mark.parametrize("direction", [(0, 0, 1), (0.5, 0, 0.8), (0.4, -0.4, 0.6), (0, 0.6, 0.8)])
@pytest.mark.parametrize("material", [{"int_ior": 1.5}, {"material": "Al"}])
def test_a_flat_surface_follows_fresnel(direction, material):
    found = rigorous.efficiencies(gratings.blazed(0.8, 0.0), direction, 0.55, **material)
    index = rigorous.refractive_index(0.55, **material)
    cosine = direction[2] / np.linalg.norm(direction)
    n = list(found.orders).index(0)
    np.testing.assert_allclose((found.s[n], found.p[n]), fresnel(cosine, index), rtol=1e-10)
    np.testing.assert_allclose(np.delete(found.unpolarised, n), 0, atol=1e-20)
    # r_s = (cos θ − √…)/(cos θ + …), and r_p of the opposite sign at normal incidence, ŝ and p̂ as documented.
    root = np.sqrt(index**2 - 1 + cosine**2)
    r_s, r_p = (cosine - root) / (cosine + root), (index**2 * cosine - root) / (index**2 * cosine + root)
    np.testing.assert_allclose(found.amplitudes[n], [[r_s, 0], [0, r_p]], atol=1e-10)


MEENT = [
    case
    for case in cases()
    if case.period == 2.5 and case.depth <= 0.25 and case.angle <= 40 and case.profile != "blazed"
]


@pytest.mark.few(10)
@pytest.mark.parametrize("case", MEENT, ids=lambda case: f"{case.profile}, {case.material}, {case}")
def test_in_plane_incidence_agrees_with_meent(case):
    found = rigorous.efficiencies(
        SOLVED_PROFILES[case.profile](case.period, case.depth), light(case.angle), case.wavelength, int_ior=case.index
    )
    np.testing.assert_array_equal(found.orders, case.orders)
    assert difference(found.s, case.te) < 1.5e-3
    # For p light a staircase of metal does not converge; it is compared with a lamellar grating below.
    if case.material == "dielectric":
        assert difference(found.p, case.tm) < 4e-3


@pytest.mark.parametrize("case", SCATMECH, ids=lambda case: "{profile}-{index[1]}-{type}-{angle}".format(**case))
def test_conical_incidence_agrees_with_scatmech(case):
    """Air to glass and glass to air, reflected and transmitted."""
    surface = {
        "sinusoidal": lambda: gratings.sinusoidal(1.0, 0.2),
        "triangular": lambda: asymmetric(1.0, 0.2, 0.8),
        "lamellar": lambda: gratings.lamellar(1.0, 0.2, duty=0.4, samples=20),
    }[case["profile"]]()
    index = complex(*case["index"])
    omega = light(case["angle"], 50) * [1, 1, 1 if case["type"] < 2 else -1]
    found = rigorous.efficiencies(surface, omega, 0.55, int_ior=index, tolerance=1e-4)
    reflected = case["type"] in (0, 2)
    orders = found.orders if reflected else found.transmitted_orders
    powers = (np.abs(found.amplitudes if reflected else found.transmitted_amplitudes) ** 2).sum(axis=1)
    # For light inside, the staircases of SCATMECH, of 150 steps, err by 2e-3.
    bound = 5e-3 if index.imag else 3e-3 if case["type"] == 2 and case["profile"] != "lamellar" else 1e-3
    for name, ours in (("unpolarised", powers.mean(axis=1)), ("s", powers[:, 0])):
        if name in case:
            wanted = np.array([case[name][str(m)] for m in orders])
            assert len(wanted) == len(case[name])
            assert difference(ours, wanted) < bound


@pytest.mark.parametrize(("angle", "turned", "side"), [(35, 0, 1), (35, 50, 1), (25, 0, -1), (35, 50, -1)])
def test_transmitted_orders_of_a_lamellar_grating_agree_with_meent(angle, turned, side):
    """Its modes are exact for vertical walls; in the plane across the grooves and conical, from both sides."""
    meent = pytest.importorskip("meent")
    indices, transmitted = (1.0, 1.5)[::side], []
    for polarisation in (0.0, 1.0):
        solver = meent.call_mee(
            backend=0,
            pol=polarisation,
            n_top=indices[0],
            n_bot=indices[1],
            theta=np.deg2rad(angle),
            phi=np.deg2rad(turned) if turned else None,
            period=[1.0, 1.0],
            wavelength=0.55,
            thickness=[0.2],
            ucell=np.where(np.arange(1000) < 400, 1.5, 1.0)[None, None],
            fto=[30, 0],
            fourier_type=0,
        )
        transmitted.append(solver.conv_solve().res.de_ti.ravel())
    wanted = np.mean(transmitted, axis=0)
    surface = gratings.lamellar(1.0, 0.2, duty=0.4, samples=20)
    found = rigorous.efficiencies(surface, light(angle, turned) * [1, 1, side], 0.55, int_ior=1.5, tolerance=1e-3)
    ours = (np.abs(found.transmitted_amplitudes) ** 2).sum(axis=1).mean(axis=1)
    assert len(ours) == (wanted > 1e-9).sum() >= 3
    # Meent's order m is −m here.
    assert difference(ours, wanted[30 - found.transmitted_orders]) < 2e-3


@pytest.mark.parametrize("samples", [24, 240])
def test_a_shallow_lamellar_grating_of_gold_has_vertical_walls(samples):
    """Fourier modes of vertical walls tend to 0.1587 in the order next to the normal, for p light."""
    found = rigorous.efficiencies(gratings.lamellar(1.0, 0.05, samples=samples), light(10), 0.6328, material="Au")
    assert abs(found.p[list(found.orders).index(1)] - 0.1587) < found.error


@pytest.mark.parametrize("azimuth", [40, 140])
def test_the_error_is_about_what_more_harmonics_change(azimuth):
    """Blazed metals converge as slowly as 1/N for p light."""
    grating = gratings.ruled(1200)
    found = rigorous.efficiencies(grating, light(50, azimuth), 0.6, material="Au")
    limit = rigorous.efficiencies(grating, light(50, azimuth), 0.6, material="Au", harmonics=110)
    assert 1e-4 < difference(found.p, limit.p) < 1.5 * found.error


SURFACES = {
    "sinusoidal": lambda: gratings.sinusoidal(0.9, 0.3),
    "blazed": lambda: gratings.blazed(0.9, 0.3),
    "lamellar": lambda: gratings.lamellar(0.9, 0.2, samples=256),
}


@pytest.mark.parametrize("profile", SURFACES)
def test_reflected_and_transmitted_power_of_a_dielectric_sum_to_one(profile):
    found = rigorous.efficiencies(SURFACES[profile](), CONICAL, 0.55, int_ior=1.5, harmonics=32)
    assert found.s.sum() + found.transmitted[0] == pytest.approx(1, abs=1e-6)
    assert found.p.sum() + found.transmitted[1] == pytest.approx(1, abs=1e-6)


@pytest.mark.parametrize("omega", [-CONICAL, (0.75, 0.2, -0.6), (0.1, 0.8, -0.6)])
@pytest.mark.parametrize("profile", SURFACES)
def test_power_is_conserved_for_light_from_inside(profile, omega):
    """Also beyond the critical angle, where order 0 or all orders are reflected totally."""
    found = rigorous.efficiencies(SURFACES[profile](), omega, 0.55, int_ior=1.5, harmonics=40)
    np.testing.assert_allclose(np.add([found.s.sum(), found.p.sum()], found.transmitted), 1, atol=1e-6)


@pytest.mark.parametrize("direction", [(0, 0, -1), (0.3, -0.2, -0.8), (0.9, 0.1, -0.4)])
def test_a_flat_surface_follows_fresnel_from_inside(direction):
    """In amplitude: r_s = (n cos θ − cos θ')/(n cos θ + cos θ'), cos θ' = i |cos θ'| beyond the critical angle."""
    found = rigorous.efficiencies(gratings.blazed(0.8, 0.0), direction, 0.55, int_ior=1.5)
    cosine = -direction[2] / np.linalg.norm(direction)
    outside = np.sqrt(1 - 2.25 * (1 - cosine**2) + 0j)
    below, above = (1.5 * cosine, outside), (cosine, 1.5 * outside)
    wanted = [(a - b) / (a + b) for a, b in (below, above)]
    np.testing.assert_allclose(found.amplitudes[list(found.orders).index(0)], np.diag(wanted), atol=1e-10)
    if outside.imag == 0:
        root = 2 * np.sqrt(1.5 * cosine * outside)
        transmitted = found.transmitted_amplitudes[list(found.transmitted_orders).index(0)]
        np.testing.assert_allclose(transmitted, np.diag([root / sum(below), root / sum(above)]), atol=1e-10)


@pytest.mark.parametrize("profile", SURFACES)
def test_transmission_is_reciprocal(profile):
    """T from ω_i into order m is T of the reversed pair of directions, and so for amplitudes."""
    found = rigorous.efficiencies(SURFACES[profile](), CONICAL, 0.55, int_ior=1.5, harmonics=40)
    omega_i = CONICAL / np.linalg.norm(CONICAL)
    assert len(found.transmitted_orders) > 2
    for m, amplitudes in zip(found.transmitted_orders, found.transmitted_amplitudes, strict=True):
        x, y = (-omega_i[:2] - [0.55 * m / 0.9, 0]) / 1.5
        reverse = rigorous.efficiencies(
            SURFACES[profile](), (x, y, -np.sqrt(1 - x**2 - y**2)), 0.55, int_ior=1.5, harmonics=40
        )
        other = reverse.transmitted_amplitudes[list(reverse.transmitted_orders).index(m)]
        # For reversed light ŝ has the opposite sign, p̂ the same.
        np.testing.assert_allclose(amplitudes, [[1, -1], [-1, 1]] * other.T, atol=2e-5)
        assert (np.abs(amplitudes) ** 2).sum() == pytest.approx((np.abs(other) ** 2).sum(), abs=2e-6)


def test_a_dielectric_as_deep_as_its_period_conserves_energy():
    found = rigorous.efficiencies(gratings.sinusoidal(0.5, 0.5), CONICAL, 0.55, int_ior=1.5, harmonics=32)
    np.testing.assert_allclose(np.add([found.s.sum(), found.p.sum()], found.transmitted), 1, atol=1e-6)


@pytest.mark.few(2)
@pytest.mark.parametrize("profile", SURFACES)
@pytest.mark.parametrize("index", [1.5, 0.9 + 6j])
def test_reflection_is_reciprocal(profile, index):
    found = rigorous.efficiencies(SURFACES[profile](), CONICAL, 0.55, int_ior=index, harmonics=40)
    omega_i = CONICAL / np.linalg.norm(CONICAL)
    assert len(found.orders) == 4
    for m, amplitudes in zip(found.orders[::2], found.amplitudes[::2], strict=True):
        tangential = -omega_i[:2] - [0.55 * m / 0.9, 0]
        reverse = rigorous.efficiencies(
            SURFACES[profile](), [*tangential, np.sqrt(1 - tangential @ tangential)], 0.55, int_ior=index, harmonics=40
        )
        other = reverse.amplitudes[list(reverse.orders).index(m)]
        assert (np.abs(amplitudes) ** 2).sum() == pytest.approx((np.abs(other) ** 2).sum(), abs=2e-6)
        # s to p in one direction is p to s in the other, up to signs.
        np.testing.assert_allclose(np.abs(amplitudes), np.abs(other.T), atol=1e-3)


def test_scalar_theory_holds_for_a_wide_period():
    surface, wavelength = gratings.sinusoidal(10.0, 0.12), 0.5
    found = rigorous.efficiencies(surface, light(5), wavelength, int_ior=1.5)
    scalar = scalar_orders(profile_powers(surface), 10.0, wavelength, 5.0, 1.5)
    np.testing.assert_array_equal(found.orders, scalar.m)
    assert difference(scalar.unpolarised, found.unpolarised) < 5e-3


def test_a_sawtooth_is_blazed_into_the_same_order_as_in_scalar_theory():
    # 2 depth / λ = 1: the facet's mirror direction is that of m = 1, towards −x.
    found = rigorous.efficiencies(gratings.blazed(5.0, 0.25), (0, 0, 1), 0.5, material="Al")
    assert found.orders[np.argmax(found.unpolarised)] == 1
    assert found.unpolarised.max() > 0.7


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("surface", "index", "goal"),
    [
        (gratings.sinusoidal(0.275, 0.275), 1.5, 1e-3),
        (gratings.blazed(0.8, 0.8), 1.5, 1e-3),
        (gratings.blazed(0.8, 0.8), None, 5e-3),
        (gratings.sinusoidal(0.8, 0.8), None, 5e-3),
        (gratings.lamellar(0.8, 0.4), None, 5e-3),
    ],
    ids=["half a wavelength", "deep blaze", "deep blaze of aluminium", "deep sinusoid of aluminium", "lamellar"],
)
def test_the_reported_error_is_the_actual_one(surface, index, goal):
    material = {"int_ior": index} if index else {"material": "Al"}
    found = rigorous.efficiencies(surface, CONICAL, 0.55, tolerance=goal, **material)
    exact = rigorous.efficiencies(surface, CONICAL, 0.55, harmonics=70, **material)
    assert found.error <= goal
    assert found.harmonics < 45
    for one, other in ((found.s, exact.s), (found.p, exact.p)):
        assert difference(one, other) <= goal


def test_power_is_conserved_under_a_denser_coat():
    """The coat may be denser than the grating, so that some orders are reflected totally."""
    found = rigorous.efficiencies(asymmetric(0.5, 0.1, 0.7), CONICAL, 0.3, int_ior=1.3 / 1.58)
    assert found.s.sum() + found.transmitted[0] == pytest.approx(1, abs=1e-6)
    assert found.p.sum() + found.transmitted[1] == pytest.approx(1, abs=1e-6)


def test_all_orders_of_a_coarse_grating_are_found():
    """At oblique incidence the largest |m| exceeds the period in wavelengths."""
    found = rigorous.efficiencies(gratings.sinusoidal(13.7, 0.05, samples=256), light(60), 1.0, int_ior=1.5)
    sine = np.sin(np.deg2rad(60))
    np.testing.assert_array_equal(found.orders, np.arange(np.ceil(-13.7 * (1 - sine)), np.floor(13.7 * (1 + sine)) + 1))


def ridged(period, depth, samples=512):
    """|sin|: a sharp valley between round ridges."""
    x = (np.arange(samples) + 0.5) / samples
    return HeightField(depth * np.abs(np.sin(np.pi * x))[None], (period / samples, period))


@pytest.mark.parametrize(
    ("surface", "direction", "wavelength", "index"),
    [
        (gratings.sinusoidal(4.21678, 1.17292, samples=256), (-0.17501, 0.178126, 0.968319), 0.593122, 3.44014),
        (gratings.sinusoidal(2.0, 2.3, samples=512), CONICAL, 0.55, 3.5),
        (ridged(3.58, 0.83), CONICAL, 0.637, 3.424),
        pytest.param(gratings.blazed(6.0, 2.57), CONICAL, 0.55, 3.36, marks=pytest.mark.slow),
    ],
    ids=["sinusoid", "deep sinusoid", "ridges", "blaze"],
)
def test_deep_dielectrics_of_high_index_conserve_energy(surface, direction, wavelength, index):
    found = rigorous.efficiencies(surface, direction, wavelength, int_ior=index)
    assert found.error < 1e-3
    np.testing.assert_allclose(np.add([found.s.sum(), found.p.sum()], found.transmitted), 1, atol=1e-5)
    assert (abs(found.transmitted_amplitudes) ** 2).sum(axis=(0, 1)) == pytest.approx(found.transmitted)
    # Orders propagate below up to |k_x + m/T| = n/λ, in the plane of constant k_y.
    k_x, k_y = -np.array(direction)[:2] / np.linalg.norm(direction)
    m = np.arange(-60, 61)
    below = m[(k_x - m * wavelength / surface.tile_size[0]) ** 2 + k_y**2 < index**2]
    np.testing.assert_array_equal(found.transmitted_orders, below)


def test_a_sinusoid_eight_times_as_deep_as_wide_converges():
    """Its crests are sharp: their radius is a thousandth of their height."""
    found = rigorous.efficiencies(gratings.sinusoidal(0.5, 4.0), CONICAL, 0.55, int_ior=1.5)
    assert found.harmonics <= 80
    assert found.error < 1e-3
    np.testing.assert_allclose(np.add([found.s.sum(), found.p.sum()], found.transmitted), 1, atol=1e-3)


def test_more_harmonics_do_not_lose_digits():
    surface = gratings.sinusoidal(2.0, 2.3, samples=512)
    some, more = (
        rigorous.efficiencies(surface, CONICAL, 0.55, int_ior=3.5, harmonics=harmonics) for harmonics in (60, 80)
    )
    assert difference(some.s, more.s) < 1e-7
    assert difference(some.p, more.p) < 1e-7


def test_a_deep_dielectric_agrees_with_meent():
    """s light; 22 harmonics, 128 and 256 layers, extrapolated (`tools/data/coupled_waves.py`)."""
    found = rigorous.efficiencies(gratings.sinusoidal(1.3, 1.6), light(20), 0.6, int_ior=3.0)
    np.testing.assert_array_equal(found.orders, [-1, 0, 1, 2])
    assert difference(found.s, np.array([0.0254429, 0.0295994, 0.0012986, 0.0009813])) < 3e-3


def test_deep_gold_at_grazing_incidence_converges():
    found = rigorous.efficiencies(gratings.sinusoidal(2.8, 8.2), light(88), 0.55, material="Au")
    assert found.error < 1e-3
    assert 0.8 < found.p.sum() < found.s.sum() < 1


@pytest.mark.not_quick
def test_too_few_harmonics_raise_a_warning():
    surface = gratings.sinusoidal(0.5, 4.0)
    with pytest.warns(UserWarning, match=r"error of 0\.\d+ with 80 harmonics, wanted at most 1e-09") as warnings:
        found = rigorous.efficiencies(surface, CONICAL, 0.55, material="Ag", tolerance=1e-9)
    assert len(warnings) == 1
    assert found.harmonics == 80
    assert found.error > 1e-9


def test_outgoing_power_above_the_incident_power_is_refused():
    deep = gratings.sinusoidal(5.0, 10.0)
    with pytest.raises(ValueError, match="wanted at most 1; 10 µm are too deep for a period of 5 µm"):
        rigorous.efficiencies(deep, CONICAL, 0.55, int_ior=3.0, harmonics=60)


def test_amplitudes_are_finite_along_the_grooves_and_at_grazing_incidence():
    for direction in ((0, 0.999, 0.04), (0.9999, 0, 0.01), (-0.7, 0.71, 0.01)):
        found = rigorous.efficiencies(gratings.blazed(0.8, 0.2), direction, 0.55, material="Al")
        assert np.isfinite(found.amplitudes).all()
        assert found.s.sum() <= 1 + 1e-6
        assert found.p.sum() <= 1 + 1e-6


def test_indices_of_metals_agree_with_mitsuba():
    mi = pytest.importorskip("mitsuba")
    mi.set_variant("scalar_spectral")
    for metal in ("Al", "Au", "Cr"):
        parameters = mi.traverse(mi.load_dict({"type": "conductor", "material": metal}))
        wanted = [
            np.interp(550, parameters[f"{part}.wavelengths"], parameters[f"{part}.values"]) for part in ("eta", "k")
        ]
        found = rigorous.refractive_index(0.55, material=metal)
        np.testing.assert_allclose([found.real, found.imag], wanted, rtol=1e-4)


def test_the_index_of_titanium_is_that_published():
    """At 2.26 eV, Johnson and Christy 1974, table I."""
    assert rigorous.refractive_index(0.549, material="Ti") == pytest.approx(2.54 + 3.43j)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"direction": (0.6, 0.8, 0)}, "the third not zero"),
        ({"direction": (0, 0, -1), "int_ior": 1.5 + 1j}, "light from inside of an absorbing material"),
        ({"direction": (0, 1)}, "direction: got"),
        ({"wavelength": 550.0}, "wavelength: got 550.0, wanted µm"),
        ({"int_ior": None}, "wanted one of the two"),
        ({"material": "Al"}, "wanted one of the two"),
        ({"int_ior": None, "material": "unobtainium"}, "wanted one of .*Al"),
        ({"int_ior": "glass"}, "int_ior: got 'glass'"),
        ({"int_ior": 1.5 - 1j}, "k ≥ 0"),
        ({"tolerance": 0.0}, "tolerance: got"),
        ({"harmonics": 0}, "harmonics: got"),
        ({"height_field": gratings.crossed(2.0, 0.2, samples=8)}, "rows that differ"),
    ],
)
def test_arguments_out_of_range_are_refused(change, message):
    arguments = {"height_field": gratings.blazed(), "direction": (0, 0, 1), "wavelength": 0.55, "int_ior": 1.5}
    with pytest.raises(ValueError, match=message):
        rigorous.efficiencies(**(arguments | change))


@pytest.mark.parametrize("height", [0.0, 0.1])
@pytest.mark.parametrize("omega", [(0, 0, 1), (0, 0, -1), (0.5, 0, 0.75**0.5)])
@pytest.mark.parametrize("wavelength", [0.25, 0.5])
def test_an_order_exactly_at_the_horizon_is_the_limit_of_nearby_wavelengths(height, omega, wavelength):
    surface = gratings.sinusoidal(1.0, height)
    at, near = (rigorous.efficiencies(surface, omega, λ, int_ior=1.5) for λ in (wavelength, wavelength * (1 + 1e-9)))
    shared = np.isin(at.orders, near.orders)
    assert at.error < 1e-3
    np.testing.assert_allclose(at.unpolarised[shared], near.unpolarised, atol=1e-4)


@pytest.mark.slow
def test_the_error_of_scalar_theory_is_found_with_an_order_at_the_horizon():
    """Order 8 of 2.4 µm, at 450 nm and normal incidence, inside n = 1.5."""
    near, at = (scalar_error(gratings.sinusoidal(period, 0.1)) for period in (2.4003, 2.4))
    assert at.reflected == pytest.approx(near.reflected, rel=0.02)
    assert at.transmitted == pytest.approx(near.transmitted, rel=0.02)
