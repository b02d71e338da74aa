"""The series of the amplitude e^{iκh} of a tile: their terms in closed form, their bounds, their error, their file."""

import warnings
from math import factorial

import numpy as np
import OpenEXR
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.special import jv

import mitsuba_diffraction as md
from mitsuba_diffraction import GratingSpectrum, HeightField, precompute
from mitsuba_diffraction.spectrum.tables import AmplitudeTable

MAX_KAPPA = 4 * np.pi / 0.36
SERIES = ["taylor", "chebyshev"]
EACH = pytest.mark.parametrize("kind", SERIES)


def rough(shape, depth, seed=5):
    return HeightField(np.random.default_rng(seed).random(shape) * depth, (0.07, 0.0585))


def origin(field, heights_from):
    return field.heights - (field.heights.min() if heights_from == "lowest" else field.heights.mean())


def quietly(field, **arguments):
    """A series of too few terms, whose error is known."""
    with warnings.catch_warnings():
        warnings.simplefilter("ignore", UserWarning)
        return precompute(field, **arguments)


def exact_powers(spectrum, field, kappa):
    """η of the kept orders by the sum over pixels; the Nyquist order of an even number has half on each side."""
    rows, columns = field.shape
    m_x, m_y = spectrum.grid.axes()
    wave_y = np.exp(-2j * np.pi * np.outer(m_y, np.arange(rows)) / rows)
    wave_x = np.exp(-2j * np.pi * np.outer(np.arange(columns), m_x) / columns)
    eta = np.abs(wave_y @ np.exp(1j * kappa * field.heights) @ wave_x / (rows * columns)) ** 2
    return eta * np.outer(*(np.where(2 * np.abs(m) == n, 0.5, 1.0) for m, n in ((m_y, rows), (m_x, columns))))


# ---------------------------------------------------------------- closed forms and bounds


@EACH
@pytest.mark.parametrize("heights_from", ["mean", "lowest"])
def test_terms_are_transforms_of_powers_or_chebyshev_polynomials(kind, heights_from):
    field = rough((5, 9), 0.2)
    spectrum = quietly(field, representation=kind, terms=6, heights_from=heights_from)
    table, h = spectrum.table, origin(field, heights_from)
    assert table.height == pytest.approx(np.abs(h).max(), rel=1e-12)
    m_x, m_y = spectrum.grid.axes()
    assert len(m_x) > 5
    wave_y = np.exp(-2j * np.pi * np.outer(m_y, np.arange(5)) / 5) / 5
    wave_x = np.exp(-2j * np.pi * np.outer(np.arange(9), m_x) / 9) / 9
    u = h / np.abs(h).max()
    for n in range(6):
        function = u**n if kind == "taylor" else np.polynomial.chebyshev.Chebyshev.basis(n)(u)
        np.testing.assert_allclose(table.terms[n], wave_y @ function @ wave_x, atol=1e-7)


def test_weights_are_those_of_the_taylor_and_jacobi_anger_series():
    kappa, height, n = np.array([0.0, 3.0, 17.0]), 0.2, np.arange(7)
    x = (kappa * height)[:, None]
    terms = np.zeros((7, 1, 1), np.complex64)
    wanted = (1j * x) ** n / [factorial(k) for k in n]
    np.testing.assert_allclose(AmplitudeTable("taylor", 20.0, height, terms).weights(kappa), wanted, rtol=1e-6)
    wanted = np.where(n, 2, 1) * 1j**n * jv(n, x)
    np.testing.assert_allclose(AmplitudeTable("chebyshev", 20.0, height, terms).weights(kappa), wanted, atol=1e-7)


@pytest.mark.few(1)
@pytest.mark.not_quick
@EACH
@given(terms=st.integers(1, 25), depth=st.sampled_from([0.05, 0.15, 0.3]), seed=st.integers(0, 99))
def test_the_remainder_is_within_the_lagrange_or_bessel_bound(kind, terms, depth, seed):
    field = rough((4, 6), depth, seed)
    spectrum = quietly(field, representation=kind, terms=terms, tolerance=0.5)
    x = MAX_KAPPA * np.abs(origin(field, "mean")).max()
    bound = x**terms / factorial(terms) if kind == "taylor" else 2 * np.abs(jv(np.arange(terms, terms + 80), x)).sum()
    error = np.abs(spectrum.powers(MAX_KAPPA) - exact_powers(spectrum, field, MAX_KAPPA)).sum()
    # Σ|Δη| ≤ 2‖ΔF‖ + ‖ΔF‖², by Cauchy and Schwarz; float32.
    assert error <= bound * (2 + bound) * (1 + 1e-6) + 1e-5


@pytest.mark.parametrize(
    ("kind", "depth", "terms"),
    [
        *[("taylor", 0.15, 11), ("taylor", 0.5, 28)],
        *[("chebyshev", 0.15, 8), ("chebyshev", 0.5, 16), ("chebyshev", 1.0, 26)],
    ],
)
def test_the_number_of_terms_of_a_sinusoid_agrees_with_an_independent_count(kind, depth, terms):
    # The count was made for 1e-3 of the amplitude; a tolerance of the power, with its margin, takes up to two more.
    spectrum = precompute(md.gratings.sinusoidal(2.5, depth), representation=kind)
    assert terms <= len(spectrum.table.terms) <= terms + 2
    assert spectrum.settings.terms == len(spectrum.table.terms)


# ---------------------------------------------------------------- the error


@EACH
@pytest.mark.parametrize("heights_from", ["mean", "lowest"])
@pytest.mark.parametrize("shape", [(1, 1), (1, 9), (8, 1), (5, 7), (6, 4)])
def test_a_tile_is_within_its_stored_error(kind, heights_from, shape):
    field = rough(shape, 0.25)
    spectrum = precompute(field, representation=kind, heights_from=heights_from, tolerance=1e-3)
    assert spectrum.representation == kind
    assert spectrum.settings.heights_from == heights_from
    assert spectrum.error <= 1e-3
    for kappa in (0.0, 13.0, 29.0, MAX_KAPPA):
        exact = exact_powers(spectrum, field, kappa)
        assert np.abs(spectrum.powers(kappa) - exact).sum() <= spectrum.error
        row, column = np.indices(exact.shape)
        one_by_one = spectrum.table.powers_at(row, column, np.full(exact.shape, kappa))
        np.testing.assert_allclose(one_by_one, spectrum.powers(kappa), atol=1e-5)


@EACH
def test_overlapping_lobes_of_a_tile_are_within_the_stored_error(kind):
    field = rough((20, 24), 0.2)
    spectrum = precompute(field, representation=kind, coherence_length=3.0, tolerance=1e-2)
    q = np.random.default_rng(4).uniform(-3, 3, (3000, 2))
    for kappa in (9.0, 20.0, MAX_KAPPA):
        exact = md.reference.power_spectrum(field, q, kappa, coherence_length=3.0)
        assert np.abs(spectrum.evaluate(q, kappa) - exact).mean() * 36 <= spectrum.error <= 1e-2


def test_too_few_terms_raise_one_warning_and_record_their_error():
    field = md.gratings.sinusoidal(2.5, 0.375)
    with pytest.warns(UserWarning, match="taylor: 20 terms of heights from the lowest") as caught:
        spectrum = precompute(field, representation="taylor", terms=20, heights_from="lowest")
    assert len(caught) == 1
    assert caught[0].filename == __file__
    max_error = max(
        np.abs(spectrum.powers(kappa) - exact_powers(spectrum, field, kappa)).sum()
        for kappa in np.linspace(0, MAX_KAPPA, 60)
    )
    assert max_error <= spectrum.error <= 1.01 * max_error
    assert max_error > 1e-3


@pytest.mark.few(1)
@pytest.mark.parametrize(("depth", "heights_from"), [(1.0, "mean"), (0.6, "lowest"), (20.0, "mean")])
def test_taylor_refuses_deep_surfaces_with_the_reason(depth, heights_from):
    field = md.gratings.sinusoidal(2.5, depth)
    with pytest.raises(ValueError, match=r"taylor: .*in float32 they grow to e\^.*cancel.*'chebyshev', or 'slices'"):
        quietly(field, representation="taylor", heights_from=heights_from)


@pytest.mark.parametrize("depth", [1.0, 5.0])
def test_chebyshev_keeps_the_tolerance_on_deep_surfaces(depth):
    spectrum = precompute(md.gratings.sinusoidal(2.5, depth), representation="chebyshev")
    m = spectrum.grid.axes()[0]
    for kappa in (3.0, 17.0, MAX_KAPPA):
        assert np.abs(spectrum.powers(kappa)[0] - jv(m, kappa * depth / 2) ** 2).sum() <= 1.1e-3


@EACH
def test_a_flat_tile_takes_one_term(kind):
    spectrum = precompute(HeightField(np.zeros((4, 6)), 0.05), representation=kind)
    assert len(spectrum.table.terms) == 1
    assert spectrum.powers(20.0).max() == 1


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"representation": "svd"}, "representation: got 'svd', wanted one of auto, slices, taylor, chebyshev"),
        ({"terms": 5}, "terms: got 5 with representation 'auto', wanted it with a series"),
        ({"heights_from": "lowest"}, "heights_from: got 'lowest' with representation 'auto'"),
        ({"representation": "taylor", "heights_from": "top"}, "heights_from: got 'top', wanted one of mean, lowest"),
        ({"representation": "taylor", "terms": 0}, "terms: got 0, wanted a whole number"),
        ({"representation": "taylor", "terms": 2.5}, "terms: got 2.5, wanted a whole number"),
        ({"representation": "taylor", "extent": "sample"}, "got 'taylor' with extent 'sample', wanted 'slices'"),
        ({"representation": "chebyshev", "theory": "rigorous", "int_ior": 1.5}, "representation: got"),
    ],
)
def test_wrong_requests_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        precompute(rough((4, 6), 0.1), **arguments)


@EACH
def test_a_mean_of_patches_is_refused_in_favour_of_slices(kind):
    with pytest.raises(ValueError, match=f"got '{kind}' with 2 patches, wanted 'slices'"):
        precompute([rough((4, 6), 0.1, seed) for seed in (1, 2)], representation=kind)


# ---------------------------------------------------------------- the file


@pytest.mark.parametrize(("kind", "name"), [("taylor", "F{u^003}"), ("chebyshev", "F{T_003}")])
@pytest.mark.parametrize("heights_from", ["mean", "lowest"])
def test_a_series_is_unchanged_by_saving_and_loading(tmp_path, kind, name, heights_from):
    spectrum = precompute(rough((4, 7), 0.2), representation=kind, heights_from=heights_from)
    spectrum.save(tmp_path / "saved.exr")
    back = GratingSpectrum.load(tmp_path / "saved.exr")
    assert (back.digest, back.settings, back.error) == (spectrum.digest, spectrum.settings, spectrum.error)
    np.testing.assert_array_equal(back.table.terms, spectrum.table.terms)
    channels = OpenEXR.File(str(tmp_path / "saved.exr"), separate_channels=True).channels()
    assert len(channels) == 2 * len(spectrum.table.terms)
    for part in ("real", "imag"):
        pixels = channels[f"{name}.{part[:2]}"].pixels
        assert pixels.dtype == np.float32
        np.testing.assert_array_equal(pixels, getattr(spectrum.table.terms[3], part))


@pytest.mark.parametrize(
    "terms", [np.zeros((3, 2), np.complex64), np.zeros((2, 1, 1)), np.full((2, 1, 1), np.nan, np.complex64)]
)
def test_invalid_tables_are_refused(terms):
    with pytest.raises(ValueError, match="terms: got"):
        AmplitudeTable("taylor", 1.0, 0.1, terms)
