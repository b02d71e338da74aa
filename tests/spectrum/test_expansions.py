"""The series in κ against their closed forms, by direct sums over pairs of pixels, and the bounds that they name."""

from math import factorial, lgamma

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import jv

import mitsuba_diffraction as md
from mitsuba_diffraction.spectrum.tables import (
    Series,
    SeriesTable,
    SliceTable,
    chebyshev,
    chebyshev_nodes,
    chebyshev_polynomials,
    chebyshev_transform,
    nodes_for,
    svd,
    taylor,
)

LARGEST_KAPPA = 4 * np.pi / 0.36
CENTRE = LARGEST_KAPPA / 2
KINDS = {"taylor": taylor, "chebyshev": chebyshev}
T = np.linspace(-1, 1, 301)
KAPPAS = CENTRE * (1 + T)


def ignore(done, total):
    pass


def at_nodes(count):
    return CENTRE * (1 + chebyshev_nodes(count))


def first(terms, found):
    series, projection = found
    return series.first(terms), projection[:terms]


# ---------------------------------------------------------------- closed forms


def pairs(heights, m):
    """The differences in height of all pairs of pixels, and their factors in η_m: Σ factor e^{iκu} = η_m."""
    count = len(heights)
    x = np.arange(count)
    wave = np.exp(-2j * np.pi * m * (x[:, None] - x) / count) / count**2
    return (heights[:, None] - heights).ravel(), wave.ravel()


def coefficient(kind, n, u):
    """B_n of e^{iκu}."""
    if kind == "taylor":
        return (1j * CENTRE * u) ** n / factorial(n) * np.exp(1j * CENTRE * u)
    return (2 if n else 1) * 1j**n * jv(n, CENTRE * u) * np.exp(1j * CENTRE * u)


@pytest.mark.parametrize("kind", ["taylor", "chebyshev"])
@pytest.mark.parametrize("depth", [0.05, 0.2])
def test_terms_are_those_of_the_closed_form(kind, depth):
    heights = np.random.default_rng(2).random(5) * depth
    field = md.HeightField(heights[None], 0.05)
    nodes = nodes_for(CENTRE * field.height_range, 1e-8)
    series, projection = first(6, KINDS[kind](LARGEST_KAPPA, nodes))
    table = SeriesTable.build(series, projection, lambda kappa: md.reference.order_powers(field, kappa), ignore)
    for m in range(5):
        u, factors = pairs(heights, m)
        for n in range(6):
            wanted = (factors * coefficient(kind, n, u)).sum()
            assert abs(wanted.imag) < 1e-12
            assert table.terms[n, 0, m] == pytest.approx(wanted.real, abs=2e-6 * max(1, (CENTRE * depth) ** n / 9))


@pytest.mark.parametrize("kind", ["taylor", "chebyshev"])
def test_two_heights_give_the_terms_of_a_cosine(kind):
    # η_0 = (1 + cos κd)/2 of a step of height d; every other order is (1 − cos κd)/2.
    depth = 0.1
    field = md.HeightField([[0.0, depth]], 0.05)
    series, projection = first(7, KINDS[kind](LARGEST_KAPPA, 30))
    table = SeriesTable.build(series, projection, lambda kappa: md.reference.order_powers(field, kappa), ignore)
    x = CENTRE * depth
    for n in range(7):
        phase = np.cos(x + n * np.pi / 2)
        size = x**n / factorial(n) if kind == "taylor" else (2 if n else 1) * jv(n, x)
        assert table.terms[n, 0, 0] == pytest.approx(((n == 0) + size * phase) / 2, abs=3e-7)
        assert table.terms[n, 0, 1] == pytest.approx(((n == 0) - size * phase) / 2, abs=3e-7)


def test_weights_are_monomials_and_chebyshev_polynomials():
    n = np.arange(9)
    np.testing.assert_allclose(taylor(LARGEST_KAPPA, 9)[0].weights(KAPPAS), T[:, None] ** n, atol=1e-13)
    wanted = np.cos(n * np.arccos(T)[:, None])
    np.testing.assert_allclose(chebyshev(LARGEST_KAPPA, 9)[0].weights(KAPPAS), wanted, atol=1e-13)


@pytest.mark.parametrize("kind", ["taylor", "chebyshev"])
def test_the_first_of_many_functions_are_those_of_fewer_nodes(kind):
    few, part = KINDS[kind](LARGEST_KAPPA, 5)[0], KINDS[kind](LARGEST_KAPPA, 12)[0].first(5)
    assert (part.name, part.terms) == (few.name, few.terms) == (kind, 5)
    # So a spectrum that was built and one that was loaded are the same to the last bit.
    np.testing.assert_array_equal(part.modes, few.modes)


@pytest.mark.parametrize("series", [taylor(2.0, 3)[0], chebyshev(2.0, 3)[0], Series("svd", 2.0, np.eye(3, 5))])
def test_weights_of_many_kappas_are_those_of_each(series):
    kappas = np.linspace(0, 2, 6).reshape(2, 3)
    assert series.weights(kappas).shape == (2, 3, 3)
    np.testing.assert_allclose(series.weights(kappas)[1, 2], series.weights(2.0), atol=1e-15)


@given(count=st.integers(1, 14), seed=st.integers(0, 2**32 - 1))
def test_projections_return_the_coefficients_of_a_polynomial(count, seed):
    wanted = np.random.default_rng(seed).normal(size=count)
    t = chebyshev_nodes(count + 2)
    _, projection = first(count, taylor(LARGEST_KAPPA, count + 2))
    np.testing.assert_allclose(projection @ np.polynomial.polynomial.polyval(t, wanted), wanted, atol=1e-8)
    _, projection = first(count, chebyshev(LARGEST_KAPPA, count + 2))
    np.testing.assert_allclose(projection @ np.polynomial.chebyshev.chebval(t, wanted), wanted, atol=1e-12)


# ---------------------------------------------------------------- bounds


def left_out(kind, terms, height, nodes):
    """max |e^{iκu} − Σ g_n B_n| over κ, n < `terms`, in float64."""
    series, projection = first(terms, kind(LARGEST_KAPPA, nodes))
    terms = projection @ np.exp(1j * at_nodes(nodes) * height)
    return np.abs(series.weights(KAPPAS) @ terms - np.exp(1j * KAPPAS * height)).max()


@given(height=st.floats(-0.4, 0.4), terms=st.integers(1, 25))
def test_the_remainder_of_taylor_is_bounded_by_lagrange(height, terms):
    x = CENTRE * abs(height)
    nodes = max(terms, nodes_for(x, 1e-13))
    bound = x**terms / factorial(terms)
    assert left_out(taylor, terms, height, nodes) <= bound * (1 + 1e-9) + 1e-15 * 2.5**nodes
    # It is not far below: of terms that fall off, the first one left out is nearly all.
    if 4 * x < terms and bound > 1e-5:
        assert left_out(taylor, terms, height, nodes) >= 0.7 * bound


@given(height=st.floats(-2, 2), terms=st.integers(1, 60))
def test_the_remainder_of_chebyshev_is_the_bessel_functions_beyond(height, terms):
    x = CENTRE * height
    nodes = max(terms, nodes_for(abs(x), 1e-13))
    bound = 2 * np.abs(jv(np.arange(terms, terms + 200), x)).sum()
    assert left_out(chebyshev, terms, height, nodes) <= bound + 1e-11


@given(height=st.floats(-5, 5))
def test_terms_of_chebyshev_are_bounded_by_two_and_fall_off(height):
    x = abs(CENTRE * height)
    nodes = nodes_for(x, 1e-10)
    terms = np.abs(chebyshev(LARGEST_KAPPA, nodes)[1] @ np.exp(1j * at_nodes(nodes) * height))
    assert terms.max() <= 2 + 1e-9
    n = np.arange(nodes)
    beyond = n > x
    # |2 J_n(x)| ≤ 2 (x/2)ⁿ/n!
    bound = [2 * np.exp(m * np.log(max(x, 1e-300) / 2) - lgamma(m + 1)) for m in n[beyond]]
    assert (terms[beyond] <= np.array(bound) * (1 + 1e-6) + 1e-9).all()


@given(x=st.floats(0, 90), tolerance=st.floats(1e-9, 0.1))
def test_nodes_resolve_the_wave_to_the_tolerance(x, tolerance):
    count = nodes_for(x, tolerance)
    values = np.exp(1j * x * chebyshev_nodes(count))
    got = chebyshev_polynomials(T, count) @ (chebyshev_transform(count) @ values)
    assert np.abs(got - np.exp(1j * x * T)).max() <= tolerance + 1e-12


@pytest.mark.few(1)
@pytest.mark.parametrize(("terms", "divisor"), [(3, 192), (4, 3072)])
@given(height=st.floats(-5, 5), intervals=st.integers(1, 400), phase=st.floats(0, 2 * np.pi), share=st.floats(0.0, 1.0))
def test_polynomials_through_chebyshev_points_keep_their_bound(terms, divisor, height, intervals, phase, share):
    table = SliceTable.build(
        intervals, terms, LARGEST_KAPPA, lambda kappa: np.cos(kappa * height + phase).reshape(1, 1), lambda v: v, ignore
    )
    kappas = LARGEST_KAPPA * (np.arange(0, intervals, max(1, intervals // 20)) + share) / intervals
    got = np.array([table.powers(kappa)[0, 0] for kappa in kappas])
    bound = (abs(height) * LARGEST_KAPPA / intervals) ** terms / divisor
    assert np.abs(got - np.cos(kappas * height + phase)).max() <= bound + 3e-6  # float32


# ---------------------------------------------------------------- the singular value decomposition


@pytest.fixture(scope="module")
def values():
    """η at 24 nodes of a small surface, (24, orders)."""
    field = md.HeightField(np.random.default_rng(4).random((3, 5)) * 0.2, 0.05)
    return np.array([md.reference.order_powers(field, kappa).ravel() for kappa in at_nodes(24)])


def test_modes_are_orthonormal_over_the_nodes(values):
    series, projection = svd(LARGEST_KAPPA, values)
    at = series.weights(at_nodes(24))
    np.testing.assert_allclose(at.T @ at, np.eye(series.terms), atol=1e-12)
    np.testing.assert_allclose(projection, at.T, atol=1e-12)


def test_no_separable_sum_of_as_many_terms_is_nearer(values):
    # Eckart and Young: in the weighted mean square, what is left out are the smaller singular values.
    weight = 1 / np.sqrt(np.abs(values).mean(axis=0))
    singular = np.linalg.svd(values * weight, compute_uv=False)
    for terms in (1, 3, 5):
        few, projection = first(terms, svd(LARGEST_KAPPA, values))
        assert few.terms == terms
        remainder = values - few.weights(at_nodes(24)) @ (projection @ values)
        assert np.linalg.norm(remainder * weight) == pytest.approx(np.linalg.norm(singular[terms:]), rel=1e-9)


def test_frequencies_without_power_change_nothing():
    series, _ = svd(LARGEST_KAPPA, np.stack([np.ones(8), np.zeros(8)], axis=-1))
    assert np.isfinite(series.modes).all()
    np.testing.assert_allclose(np.abs(series.first(1).weights(KAPPAS)), 8**-0.5, rtol=1e-9)


@pytest.mark.parametrize("modes", [np.zeros(3), np.zeros((0, 3)), np.full((1, 2), np.nan)])
def test_wrong_modes_are_refused(modes):
    with pytest.raises(ValueError, match="modes: got"):
        Series("svd", 1.0, modes)


# ---------------------------------------------------------------- how many terms


def random_scan(depth):
    return md.HeightField(np.random.default_rng(1).random((16, 20)) * depth, (0.09, 0.08))


def terms_of(kinds, field, extent):
    return [
        md.precompute(field, extent=extent, representation=kind, coherence_length=0.6).table.series.terms
        for kind in kinds
    ]


@pytest.mark.few(4)
@pytest.mark.parametrize("depth", [0.15, 0.3, 0.5])
@pytest.mark.parametrize(
    ("make", "extent"),
    [
        (lambda depth: md.gratings.sinusoidal(2.5, depth, samples=64), "tile"),
        (lambda depth: md.gratings.blazed(2.5, depth, samples=64), "tile"),
        (lambda depth: random_scan(depth), "tile"),
        (lambda depth: random_scan(depth), "sample"),
    ],
    ids=["sinusoid", "blaze", "random tile", "random sample"],
)
def test_svd_takes_half_the_terms_of_taylor(make, extent, depth):
    # Half of an odd number is rounded up. Below 0.15 µm both take a handful.
    taylor, chebyshev, svd = terms_of(["taylor", "chebyshev", "svd"], make(depth), extent)
    assert svd <= (taylor + 1) // 2, (taylor, svd)
    assert svd <= chebyshev <= taylor


@pytest.mark.parametrize("kind", ["taylor", "chebyshev", "svd"])
def test_a_flat_surface_takes_one_term(kind):
    spectrum = md.precompute(md.HeightField(np.zeros((4, 6)), 0.05), representation=kind, tolerance=1e-5)
    assert spectrum.table.series.terms == 1
    assert spectrum.powers(20.0).max() == pytest.approx(1, abs=2e-7)


def test_the_nodes_of_very_deep_surfaces_are_finite():
    # Beyond x = 1400 the bound exceeds every float before it falls.
    assert 0.5 * 3000 < nodes_for(3000.0, 1e-5) < 1.5 * 3000
