"""Samples against their density, the integral of the density, and the effective fraction of samples."""

import functools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import (
    WAVELENGTHS,
    albedo,
    check_chi_square,
    direction,
    draw,
    floats,
    hemisphere,
    interaction,
    plugin,
    use,
    vectors,
)
from covering import covering

import mitsuba_diffraction as md
from mitsuba_diffraction import testing
from mitsuba_diffraction.bsdf.continuum_sampler import BinSampler
from mitsuba_diffraction.bsdf.directions import Incidence, Interface
from mitsuba_diffraction.bsdf.inversion import AliasTable
from mitsuba_diffraction.bsdf.order_sampler import OrderSampler

SKINS = "elaphe", "xenopeltis"  # slow to build
BUNDLED = {
    "blazed": lambda: md.gratings.blazed(2.5, 0.246),
    "sinusoidal": lambda: md.gratings.sinusoidal(2.5, 0.25),
    "lamellar": lambda: md.gratings.lamellar(2.5, 0.25),
    "crossed": lambda: md.gratings.crossed(2.5, 0.25),
    "elaphe": lambda: md.gratings.elaphe_synthetic(32.0, seed=1),
    "xenopeltis": lambda: md.gratings.xenopeltis_synthetic(32.0, seed=1),
}
SMALL = {
    **BUNDLED,
    "elaphe": lambda: md.gratings.elaphe_synthetic(8.0),
    "xenopeltis": lambda: md.gratings.xenopeltis_synthetic(8.0),
    "sample": lambda: md.gratings.xenopeltis_synthetic((9.0, 8.0)),
    "column": lambda: md.HeightField(md.gratings.blazed(2.5, 0.246).heights.T, (2.5, 2.5 / 512)),
}
WIDE = {
    **{name: BUNDLED[name] for name in ("blazed", "sinusoidal", "lamellar")},
    "ruled": md.gratings.PROFILES["ruled"],
    "morpho_ridges": md.gratings.PROFILES["morpho_ridges"],
    "skewed ruled": lambda: md.HeightField(
        0.4 * np.interp(np.arange(96) / 96, [0, 0.7, 1], [0, 1, 0])[None], (1.9 / 96, 1.9)
    ),
}
"""With few rows of orders; at a coherence length of 5 µm the horizon truncates their lobes."""
RECIPE_COHERENCE = {"elaphe": 26.0, "xenopeltis": 26.0}
"""Coherence lengths of precompute/*.toml, µm; 65 for others."""


@functools.cache
def bundled(name):
    return md.precompute(BUNDLED[name](), coherence_length=RECIPE_COHERENCE.get(name, 65.0))


@functools.cache
def blurred(name):
    """Return a spectrum whose lobes are wide enough for the bins of a chi² test."""
    if name == "sample":
        return md.precompute(SMALL[name](), extent="sample", coherence_length=4.0)
    return md.precompute(SMALL[name](), coherence_length=6.0 if name in RECIPE_COHERENCE else 3.0)


def numbers(count, seed=0):
    return np.random.default_rng(seed).random((3, count), dtype=np.float32)


def points(u):
    """Convert (3, count) to the arguments of `sample`."""
    first, *second = map(floats, u)
    return first, mi.Point2f(*second)


def incidence_of(omega, wavelength):
    """Return light incident from ω that is reflected; λ in µm."""
    interface = Interface()
    k_i = interface.wave_vector(vectors(omega))
    return Incidence.of(k_i, interface.scattered(k_i, mi.Bool(True)), interface).at_wavelength(floats(wavelength))


def sampled(bsdf, wi, wavelengths, count, seed=0):
    """Return the sample of Mitsuba, and its weights (4, count) in float64."""
    bs, weight = bsdf.sample(mi.BSDFContext(), interaction(wi, wavelengths, count), *points(numbers(count, seed)))
    dr.eval(bs, weight)
    return bs, np.array(weight, np.float64)


# ---------------------------------------------------------------- the density

ALONE = [(w,) * 4 for w in WAVELENGTHS]
REDUCED = [
    ("blazed", 0, 0, WAVELENGTHS),
    ("blazed", 60, 20, WAVELENGTHS),
    ("blazed", 80, 110, ALONE[1]),
    ("column", 60, 20, WAVELENGTHS),
    ("lamellar", 80, 20, WAVELENGTHS),
    ("sinusoidal", 30, 70, ALONE[0]),
    ("crossed", 60, 35, ALONE[2]),
    ("crossed", 80, 200, WAVELENGTHS),
    ("elaphe", 30, 20, WAVELENGTHS),
    ("xenopeltis", 60, 290, WAVELENGTHS),
    ("xenopeltis", 80, 20, ALONE[3]),
    ("sample", 0, 0, WAVELENGTHS),
    ("sample", 60, 20, ALONE[1]),
    ("sample", 80, 200, WAVELENGTHS),
]
DIRECTIONS = (0, 0), (30, 20), (30, 110), (60, 20), (60, 200), (80, 70), (80, 290)
FULL = [
    (name, theta, phi, wavelengths)
    for name, (theta, phi), wavelengths in covering([*SMALL], DIRECTIONS, (WAVELENGTHS, *ALONE))
]
CASES = [*REDUCED, *(pytest.param(*case, marks=pytest.mark.slow) for case in FULL if case not in REDUCED)]


@pytest.mark.few(1)
@pytest.mark.parametrize(("name", "theta", "phi", "wavelengths"), CASES)
def test_samples_pass_the_chi_square_test(llvm, name, theta, phi, wavelengths):
    check_chi_square(plugin(blurred(name), conserve_energy=False), direction(theta, phi), wavelengths, cases=len(CASES))


@pytest.mark.few(1)
@pytest.mark.parametrize("theta", [0, 60])
@pytest.mark.parametrize("extent", ["tile", "sample"])
@pytest.mark.parametrize("name", ["elaphe", "xenopeltis"])
def test_samples_of_a_real_scan_pass_the_chi_square_test(llvm, scan, name, extent, theta):
    spectrum = md.precompute(scan(name), extent=extent, coherence_length=2.9)
    check_chi_square(plugin(spectrum, conserve_energy=False), direction(theta, 20), cases=len(CASES))


@pytest.mark.few(1)
@pytest.mark.parametrize("shortest", [500.0, 600.0, 800.0])
def test_wavelengths_that_are_not_covered_are_not_sampled(llvm, shortest):
    heights = md.gratings.sinusoidal(2.5, 0.25)
    spectrum = md.precompute(heights, wavelengths=(shortest, 830.0), coherence_length=3.0)
    bsdf = plugin(spectrum, conserve_energy=False)
    wi, wavelengths = direction(20, 40), (450.0, 550.0, 650.0, 750.0)
    bs, weight = draw(bsdf, wi, 1 << 18, wavelengths=wavelengths)
    wanted = albedo(bsdf, wi, wavelengths=wavelengths)
    assert (wanted[np.array(wavelengths) < shortest] == 0).all()
    error = weight.std(1) / np.sqrt(weight.shape[1])
    np.testing.assert_array_less(np.abs(weight.mean(1) - wanted), 4 * error + 2e-3 * wanted + 1e-9)
    # The density is that of the samples.
    wo, area = hemisphere()
    si = interaction(wi, wavelengths, len(wo))
    pdf = np.array(bsdf.pdf(mi.BSDFContext(), si, vectors(wo)), np.float64)
    drawn = (np.array(bs.pdf) > 0).mean()
    assert abs((pdf / wo[:, 2]).sum() * area - drawn) < 5e-3


def test_a_spectrum_need_not_begin_at_the_shortest_wavelength(llvm):
    # Regression: height_scale = 1 was refused.
    spectrum = md.precompute(
        md.gratings.sinusoidal(2.5, 0.25), wavelengths=(400.0, 700.0), coherence_length=3.0, tolerance=1e-3
    )
    bsdf, whole = (
        plugin(s, conserve_energy=False)
        for s in (spectrum, md.precompute(md.gratings.sinusoidal(2.5, 0.25), coherence_length=3.0, tolerance=1e-3))
    )
    wi, wo = direction(20, 40), direction([10, 25, 60], 220)
    found, wanted = (testing.evaluate(b, wi, wo, [380.0, 401.0, 550.0, 699.0]) for b in (bsdf, whole))
    assert (found[:, 0] == 0).all()
    np.testing.assert_allclose(found[:, 1:], wanted[:, 1:], rtol=0.02, atol=1e-3 * wanted.max())
    with pytest.raises(RuntimeError, match=r"height_scale: got 1\.1, wanted 0 to 1"):
        plugin(spectrum, height_scale=1.1)


@pytest.mark.slow
def test_above_the_maximum_angle_only_the_base_reflects(llvm):
    of = md.precompute(md.gratings.sinusoidal(2.5, 0.25), largest_angle=60.0, coherence_length=3.0)
    bsdf = plugin(of, int_ior=1.5, base={"type": "diffuse"}, conserve_energy=False)
    for theta in (40, 70):
        _, weight = draw(bsdf, direction(theta, 20), 1 << 18)
        wanted = albedo(bsdf, direction(theta, 20))
        error = weight.std(1) / np.sqrt(weight.shape[1])
        np.testing.assert_array_less(np.abs(weight.mean(1) - wanted), 4 * error + 2e-3 * wanted)


# ---------------------------------------------------------------- the work that a sample does


def shifted(u):
    """Return four wavelengths as in Mitsuba's path tracer: equally spaced over 360–830 nm, shifted by `u`."""
    return 360 + 470 * ((u + np.arange(4) / 4) % 1)


def effective_fraction(bsdf, theta, phi, draws, count):
    """Return E[w]²/E[w²] of the weight w, averaged over wavelengths, then over draws of them; and max w / E[w]."""
    fractions, largest = [], 0.0
    for seed in range(draws):
        _, weight = sampled(bsdf, direction(theta, phi), shifted((seed + 0.5) / draws / 4), count, seed=seed)
        assert np.isfinite(weight).all()
        assert (weight >= 0).all()
        w = weight.mean(axis=0)
        fractions.append(w.mean() ** 2 / (w**2).mean())
        largest = max(largest, w.max() / w.mean())
    return np.mean(fractions), largest


@pytest.mark.few(1)
@pytest.mark.parametrize(
    ("name", "theta", "phi"),
    [
        pytest.param(*row, marks=pytest.mark.slow if row[0] in SKINS else ())
        for row in covering([*BUNDLED], [60, 85, 0, 15, 30, 45, 75], [0, 30, 60, 90, 180, 210, 300])
    ],
)
def test_the_effective_sample_fraction_is_above_its_bound(llvm, name, theta, phi):
    fraction, largest = effective_fraction(plugin(bundled(name)), theta, phi, draws=4, count=1 << 15)
    assert fraction >= (0.4 if theta == 85 else 0.5)
    assert largest < 20


@pytest.mark.few(1)
@pytest.mark.parametrize(("name", "theta", "phi"), covering([*WIDE], [75, 85, 60, 30, 0], [90, 0, 30, 210]))
def test_lobes_truncated_by_the_horizon_are_drawn_above_it(llvm, name, theta, phi):
    # Regression: 0.33 to 0.48 for light that comes in along the grooves, at 75° and more.
    bsdf = plugin(md.precompute(WIDE[name](), coherence_length=5.0, tolerance=1e-2))
    fractions = []
    for wavelength in (420.0, 500.0, 580.0, 660.0):
        _, weight = sampled(bsdf, direction(theta, phi), (wavelength,) * 4, 1 << 15)
        fractions.append(weight[0].mean() ** 2 / (weight[0] ** 2).mean())
    # Four cells of κ are few for a lamellar grating: S has zeros in κ.
    # Where a lobe is cut by the horizon K G grows towards it, and q is drawn by the powers alone.
    assert np.mean(fractions) >= 0.3


@pytest.mark.few(1)
@pytest.mark.parametrize("theta", [89.99, 89, 50, 0])
@pytest.mark.parametrize("name", ["blazed", "crossed", pytest.param("elaphe", marks=pytest.mark.slow)])
def test_weights_are_finite_and_pdf_is_that_of_the_sample(llvm, name, theta):
    bsdf, wi, count = plugin(bundled(name)), direction(theta, 30), 1 << 15
    for wavelengths in ((360.0, 830.0, 360.0, 830.0), (355.0, 835.0, 500.0, 500.0)):
        bs, weight = sampled(bsdf, wi, wavelengths, count)
        assert np.isfinite(weight).all()
        assert (weight >= 0).all()
        again = np.array(bsdf.pdf(mi.BSDFContext(), interaction(wi, wavelengths, count), bs.wo))
        pdf = np.array(bs.pdf)
        assert np.isfinite(pdf).all()
        some = pdf > 0
        np.testing.assert_allclose(pdf[some], again[some], rtol=1e-3)


def test_the_sampler_follows_the_height_scale(llvm):
    bsdf = plugin(bundled("blazed"), height_scale=0.5, conserve_energy=False)
    assert effective_fraction(bsdf, 60, 30, draws=4, count=1 << 15)[0] > 0.5


# ---------------------------------------------------------------- the samplers


@pytest.mark.parametrize("name", ["lamellar", "turned", "crossed"])
def test_all_light_of_a_continuum_is_drawn_with_its_density(llvm, name):
    """Up to the horizon, on spirals; and moments of the density on a spiral are those of samples of a lattice."""
    relief = md.gratings.lamellar(2.5, 0.4) if name != "crossed" else md.gratings.crossed(2.5, 0.25)
    if name == "turned":
        relief = md.HeightField(relief.heights.T, relief.pixel_size[::-1])
    spectrum, wavelength = md.precompute(relief, coherence_length=3.0), 0.5
    sampler, count, golden = BinSampler(spectrum), 1 << 14, np.pi * (3 - np.sqrt(5))
    s = direction([0, 25, 50, 70, 85, 85, 89], [0, 10, 130, 290, 180, 95, 355])[:, None]

    def density(tangent):
        """p of ω_o,∥ = −`tangent`, (directions, n, 2)."""
        at = [of.ravel() for of in np.moveaxis((tangent - s[..., :2]) / wavelength, -1, 0)]
        incidence = incidence_of(np.repeat(s, tangent.shape[-2], axis=1).reshape(-1, 3), wavelength)
        p = sampler.density(mi.Vector2f(*map(floats, at)), incidence, mi.Bool(True))
        return np.array(p, np.float64).reshape(len(s), -1), np.stack(at, -1).reshape(len(s), -1, 2)

    def spiral(radius):
        phi = golden * np.arange(len(radius))
        return radius[None, :, None] * np.stack([np.cos(phi), np.sin(phi)], -1)

    # Light up to the horizon can be drawn.
    cos = np.linspace(0.002, 1, 2000)
    p, q = density(spiral(np.sqrt(1 - cos**2)))
    kappa = 2 * np.pi / wavelength * (s[..., 2] + cos)
    power = spectrum.evaluate(q, kappa)
    assert (p[power > 2e-3 * power.max(1, keepdims=True)] > 0).all()

    # The density and that of the samples integrate functions to the same values, 1 to 1.
    p, q = density(spiral(np.sqrt((np.arange(1 << 17) + 0.5) / (1 << 17))))
    lattice = (np.arange(count)[:, None] * [1 / count, 0.7548776662466927, 0.5698402909980532]) % 1
    u = np.tile(lattice.T, len(s)).astype(np.float32)
    drawn, _ = sampler.sample(incidence_of(np.repeat(s[:, 0], count, axis=0), wavelength), *points(u), mi.Bool(True))
    dr.eval(drawn)
    found = np.stack([np.array(of, np.float64) for of in drawn], -1).reshape(len(s), count, 2)
    for of in (lambda q: np.ones(q.shape[:-1]), lambda q: q[..., 0], lambda q: q[..., 1], lambda q: (q**2).sum(-1)):
        wanted, got = (p * of(q)).mean(1) * np.pi / wavelength**2, of(found).mean(1)
        np.testing.assert_allclose(got, wanted, atol=4e-3)


@pytest.mark.few(3)
@pytest.mark.parametrize("name", ["crossed", "column", "sample", pytest.param("elaphe", marks=pytest.mark.slow)])
@pytest.mark.parametrize(("theta", "phi"), [(0, 0), (40, 130), (85, 250)])
def test_continua_are_drawn_with_their_density_and_propagate(llvm, name, theta, phi):
    count, wavelength, rings, sectors, points_of_side = 1 << 20, 0.5, 12, 24, 48
    sampler = BinSampler(blurred(name))
    s = direction(theta, phi)
    incidence = incidence_of(s, wavelength)
    q, _ = sampler.sample(incidence, *points(numbers(count)), True)
    dr.eval(q)
    tangent = np.array([wavelength * np.array(x, np.float64) for x in q]) + s[:2, None]
    distance = np.hypot(*tangent)
    assert distance.max() <= 1 + 1e-5

    # Cells of rings and sectors in the unit disc of ω_o,∥; the density is averaged over points of each of them.
    found, _, _ = np.histogram2d(
        np.minimum(distance, 1 - 1e-9), np.arctan2(*tangent), bins=(rings, sectors), range=((0, 1), (-np.pi, np.pi))
    )
    assert found.sum() == count
    radius = ((np.arange(rings * points_of_side) + 0.5) / (rings * points_of_side))[:, None]
    angle = 2 * np.pi * (np.arange(sectors * points_of_side) + 0.5) / (sectors * points_of_side) - np.pi
    at = (radius * np.sin(angle) - s[0]) / wavelength, (radius * np.cos(angle) - s[1]) / wavelength
    density = sampler.density(mi.Vector2f(*(floats(x.ravel()) for x in at)), incidence, mi.Bool(True))
    density = np.array(density, np.float64).reshape(len(radius), len(angle))
    means = (radius * density).reshape(rings, points_of_side, sectors, points_of_side).mean((1, 3))
    wanted = means * 2 * np.pi / (rings * sectors * wavelength**2) * count
    assert wanted.sum() == pytest.approx(count, rel=2e-3)
    # Regression: around the centre of the disc, whose inversion is at infinity, it was up to 10⁸ times as large.
    near = [[-of / wavelength + 1e-5 * k for k in (0, 1, 3)] for of in s[:2]]
    of_near = np.array(sampler.density(mi.Vector2f(*map(floats, near)), incidence, mi.Bool(True)))
    assert of_near.max() <= 1.01 * density.max()
    found, wanted = found[wanted > 20], wanted[wanted > 20]
    # Points resolve densities, which jump at the borders of bins, to a per cent.
    chi_square = ((found - wanted) ** 2 / (wanted + (0.01 * wanted) ** 2)).sum()
    assert abs(chi_square - len(found)) < 4 * np.sqrt(2 * len(found))


def test_an_alias_table_draws_with_the_given_probabilities(llvm):
    """Equidistant numbers draw each index in proportion to its weight, and what is left of a number is uniform."""
    rng, count = np.random.default_rng(5), 1 << 20
    weights = rng.random((6, 37)) ** [[0], [1], [4], [20], [1], [1]]
    weights[4] = np.arange(37) == 30
    weights[5] = 0
    table = AliasTable(weights)
    weights[5] = 1
    u = (np.arange(count) + 0.5) / count
    for distribution, of_each in enumerate(weights):
        index, rest = table.draw(mi.UInt32(distribution), floats(u), mi.Bool(True))
        found = np.bincount(np.array(index), minlength=37) / count
        np.testing.assert_allclose(found, of_each / of_each.sum(), atol=3 / count * 37)
        middles = np.bincount(np.array(index), np.array(rest, np.float64), 37) / count
        np.testing.assert_allclose(middles, found / 2, atol=1e-4)
        assert 0 <= float(dr.min(rest)[0]) <= float(dr.max(rest)[0]) < 1


@pytest.mark.few(3)
@pytest.mark.parametrize("name", ["blazed", "column", "crossed"])
@pytest.mark.parametrize(("theta", "phi"), [(0, 0), (40, 130), (85, 250)])
def test_orders_are_drawn_with_their_probabilities(llvm, name, theta, phi):
    spectrum, count = md.precompute(SMALL[name]()), 1 << 20
    sampler = OrderSampler(spectrum)
    incidence = incidence_of(direction(theta, phi), 0.5)
    u, _ = points(numbers(count))
    drawn_x, drawn_y = sampler.sample(incidence, u, True)
    dr.eval(drawn_x, drawn_y)
    rows, columns = spectrum.grid.shape
    m_x, m_y = (m.ravel() for m in np.meshgrid(*spectrum.grid.axes()))
    orders = mi.Int32(m_x), mi.Int32(m_y)
    probability = np.array(sampler.probability(*orders, incidence, mi.Bool(True)), np.float64)
    assert probability.sum() == pytest.approx(1, abs=1e-6)

    column, row = (
        np.array(x) + np.zeros(count, int) + m for x, m in zip((drawn_x, drawn_y), spectrum.grid.max_order, strict=True)
    )
    found = np.bincount(row * columns + column, minlength=rows * columns)
    assert found[probability == 0].sum() == 0
    often = probability * count > 5
    wanted = probability[often] * count
    chi_square = ((found[often] - wanted) ** 2 / wanted).sum()
    assert abs(chi_square - often.sum()) < 4 * np.sqrt(2 * often.sum())

    # All that propagate can be drawn, and few others are.
    s = np.array(direction(theta, phi))
    t_x, t_y = (m * 0.5 / tile for m, tile in zip((m_x, m_y), spectrum.grid.tile_size, strict=True))
    propagates = (t_x + s[0]) ** 2 + (t_y + s[1]) ** 2 < 1
    assert (probability[propagates] > 0).all()
    assert probability[propagates].sum() > 0.75  # the horizon crosses bins


@pytest.mark.parametrize("theta", [0, 40])
def test_no_wavelength_is_sampled_outside_of_its_lobe(llvm, theta):
    # Regression: lobes were drawn whole and evaluated truncated. What a short wavelength drew outside its lobe of the
    # mirror order counted for longer ones: 800 nm reflected 5.8 % too much.
    spectrum = md.precompute(md.gratings.sinusoidal(2.5, 0.02), coherence_length=16.0, tolerance=0.1)
    bsdf = plugin(spectrum, conserve_energy=False)
    assert bsdf.layers.grating.theory.scattering.resolved
    wi, wavelengths = direction(theta, 20), (400.0, 410.0, 420.0, 800.0)
    _, weight = draw(bsdf, wi, 1 << 18, wavelengths=wavelengths)
    wanted = albedo(bsdf, wi, side=1024, wavelengths=wavelengths)
    error = weight.std(1) / np.sqrt(weight.shape[1])
    np.testing.assert_array_less(np.abs(weight.mean(1) - wanted), 4 * error + 2e-3 * wanted)


@pytest.mark.slow
def test_orders_are_drawn_where_their_lobes_are_narrow_and_apart(llvm):
    elaphe = md.precompute(SMALL["elaphe"](), coherence_length=26.0)
    for of, sampler in ((elaphe, BinSampler), (blurred("blazed"), BinSampler), (bundled("blazed"), OrderSampler)):
        assert isinstance(plugin(of).layers.grating.theory.scattering.sampler, sampler)


def test_a_mirror_with_wide_lobes_is_sampled(llvm):
    bsdf = plugin(md.precompute(md.HeightField(np.zeros((1, 8)), 0.05), coherence_length=3.0), conserve_energy=False)
    check_chi_square(bsdf, direction(60, 20), WAVELENGTHS)


# ---------------------------------------------------------------- other variants


@pytest.mark.few(2)
@pytest.mark.parametrize("variant", ["llvm_ad_spectral_polarized"])
@pytest.mark.parametrize("name", ["blazed", "crossed", pytest.param("elaphe", marks=pytest.mark.slow)])
def test_other_variants_draw_the_same_samples(variant, name):
    count, wi = 40, direction(50, 25)
    use("llvm_ad_spectral")
    bs, weight = sampled(plugin(blurred(name), conserve_energy=False), wi, WAVELENGTHS, count)
    wanted, wanted_pdf = np.array(bs.wo).T, np.array(bs.pdf)
    use(variant)
    bsdf, u = plugin(blurred(name), conserve_energy=False), numbers(count)
    bs, value = bsdf.sample(mi.BSDFContext(), interaction(wi, WAVELENGTHS, count), *points(u))
    drawn = wanted_pdf > 0
    np.testing.assert_allclose(np.array(bs.pdf), wanted_pdf, rtol=5e-3)
    np.testing.assert_allclose(np.array(bs.wo).T[drawn], wanted[drawn], atol=2e-5)
    np.testing.assert_allclose(np.array(value[0, 0])[:, drawn], weight[:, drawn], rtol=5e-3, atol=1e-4)
