"""The table of rigorous efficiencies against the solver."""

import warnings
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import mitsuba_diffraction as md
from mitsuba_diffraction import gratings, rigorous
from mitsuba_diffraction.rigorous import build
from mitsuba_diffraction.rigorous.build import build_spectrum
from mitsuba_diffraction.rigorous.spectrum import Axes, RigorousSpectrum
from mitsuba_diffraction.scalar_theory import fresnel
from mitsuba_diffraction.settings import Settings

SURFACE = gratings.blazed(0.3, 0.05, samples=64)
REQUEST = Settings(theory="rigorous", int_ior=1.5, wavelengths=(400.0, 500.0), tolerance=0.2, coherence_length=40.0)


@pytest.fixture(scope="module")
def spectrum(cache_folder):
    return build_spectrum(SURFACE, REQUEST)


def hemisphere(count, seed):
    rng = np.random.default_rng(seed)
    z, turn = rng.random((2, count))
    return np.stack([np.sqrt(1 - z**2) * f(2 * np.pi * turn) for f in (np.cos, np.sin)] + [z], axis=-1)


def test_the_axes_are_symmetric_and_whole_where_orders_pass_off():
    axes = Axes(0.9, (0.36, 0.83), 8, 5)
    assert axes.max_order == 4
    unit, step = np.divmod(np.arange(17), 8)
    np.testing.assert_allclose(axes.position(unit + np.sin(np.pi / 16 * step) ** 2), np.arange(17), atol=1e-6)
    assert axes.offset(-4) == 0
    assert axes.nodes == sum((int(np.ceil(5 - abs(m))) * 8 + 1) ** 2 for m in range(-4, 5))


@pytest.mark.slow
def test_the_table_has_the_efficiencies_of_the_solver(spectrum):
    errors = []
    for omega, wavelength in zip(hemisphere(25, 1), np.linspace(0.401, 0.499, 25), strict=True):
        exact = rigorous.efficiencies(SURFACE, omega, wavelength, int_ior=1.5)
        m, eta = spectrum.efficiencies(omega, wavelength)
        np.testing.assert_array_equal(m, exact.orders)
        errors.append(np.abs(eta - exact.unpolarised).sum() / exact.unpolarised.sum())
    assert np.mean(errors) < 1.5 * spectrum.error
    assert spectrum.error <= 0.2


def test_the_table_is_reciprocal(spectrum):
    c, g = np.random.default_rng(2).random((2, 100)) * [[0.3], [0.75]]
    for m in (-1, 0, 1):
        there, back = (spectrum.evaluate(m, sign * c, g, 0.45) for sign in (1, -1))
        np.testing.assert_allclose(there, back, atol=1e-6)


def test_grazing_light_is_mirrored(spectrum):
    m, eta = spectrum.efficiencies((1 - 1e-9, 0, 1e-6), 0.45)
    assert eta[list(m).index(0)] == pytest.approx(1, abs=1e-3)
    assert eta.sum() <= 1 + 1e-3


@pytest.mark.parametrize(
    ("depth", "material"), [(0.15, {"material": "Al"}), (0.05, {"int_ior": 1.5, "ext_ior": 1.6})], ids=["metal", "coat"]
)
def test_a_coarse_table_holds_no_more_light_than_came(depth, material, monkeypatch):
    """Few harmonics are enough for most light, not for all."""
    monkeypatch.setattr("mitsuba_diffraction.rigorous.build._SOLVED", (4,))
    monkeypatch.setattr("mitsuba_diffraction.rigorous.build._CHECKS", 2)
    surface = gratings.blazed(0.5, depth, samples=256)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        table = build_spectrum(surface, replace(REQUEST, **{"int_ior": None} | material, wavelengths=(400.0, 450.0)))
    assert table.values.min() >= 0
    assert table.values.max() <= 1


def test_a_profile_that_does_not_converge_is_refused():
    with pytest.raises(
        ValueError, match=r"error of 0\.\d+ with 80 harmonics at a wavelength of 400 nm, wanted at most"
    ):
        build_spectrum(
            gratings.lamellar(0.3, 0.3),
            replace(REQUEST, int_ior=None, material="Ag", wavelengths=(400.0, 450.0), tolerance=1e-4),
        )


def test_a_spectrum_survives_its_file(spectrum, tmp_path):
    spectrum.save(tmp_path / "table.exr")
    loaded = RigorousSpectrum.load(tmp_path / "table.exr")
    for ours, theirs in zip(loaded.tables, spectrum.tables, strict=True):
        assert ours.axes == theirs.axes
        np.testing.assert_array_equal(ours.values, theirs.values)
    for name in ("axes", "material", "int_ior", "coherence_length", "error", "harmonics", "source", "source_digest"):
        assert getattr(loaded, name) == getattr(spectrum, name)


@pytest.fixture(scope="module", params=["interface", "sheet"])
def glass(request):
    """A coarse table of light that passes, with its matrices."""
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for steps in ("_SOLVED", "_SOLVED_BOTH"):
            patch.setattr(f"mitsuba_diffraction.rigorous.build.{steps}", (4,))
        patch.setattr("mitsuba_diffraction.rigorous.build._CHECKS", 40)
        return build_spectrum(SURFACE, replace(REQUEST, polarised=True, transmission=request.param))


def test_a_table_of_glass_survives_its_file(glass, tmp_path):
    glass.save(tmp_path / "glass.exr")
    loaded = RigorousSpectrum.load(tmp_path / "glass.exr")
    assert loaded.transmission == glass.transmission
    for ours, theirs in zip(loaded.tables, glass.tables, strict=True):
        assert ours.axes == theirs.axes
        np.testing.assert_array_equal(ours.values, theirs.values)
        np.testing.assert_array_equal(ours.mueller, theirs.mueller)


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    cosine=st.floats(0.02, 1),
    turn=st.floats(0, 2 * np.pi),
    side=st.sampled_from([1, -1]),
    wavelength=st.floats(0.4, 0.5),
)
def test_light_is_reflected_or_transmitted(glass, cosine, turn, side, wavelength):
    sine = np.sqrt(1 - cosine**2)
    omega = sine * np.cos(turn), sine * np.sin(turn), side * cosine
    total = sum(glass.efficiencies(omega, wavelength, transmitted)[1].sum() for transmitted in (False, True))
    assert total == pytest.approx(1, abs=2 * max(glass.max_error, glass.max_error_near))


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    cosine=st.floats(0.05, 1),
    turn=st.floats(0, 2 * np.pi),
    side=st.sampled_from([1, -1]),
    wavelength=st.floats(0.4, 0.5),
)
def test_reversed_light_goes_back_as_it_came(glass, cosine, turn, side, wavelength):
    """Through the interface or the sheet and back: n_o ω_o,x = −λ m/T − n_i ω_i,x."""
    sine = np.sqrt(1 - cosine**2)
    omega = np.array([sine * np.cos(turn), sine * np.sin(turn), side * cosine])
    n_i, n_o = glass.indices[::side]
    for m, eta in zip(*glass.efficiencies(omega, wavelength, transmitted=True), strict=True):
        x, y = (-n_i * omega[:2] - [wavelength * m / 0.3, 0]) / n_o
        if x**2 + y**2 < 0.999:
            orders, back = glass.efficiencies((x, y, -side * np.sqrt(1 - x**2 - y**2)), wavelength, transmitted=True)
            assert back[list(orders).index(m)] == pytest.approx(eta, abs=1e-6)


def test_the_matrices_of_reversed_light_are_those_of_the_solver(glass, monkeypatch):
    """From below to above nothing is stored; the sheet has its own closed sum for it."""
    monkeypatch.setattr("mitsuba_diffraction.rigorous.build._CHECKS", 30)
    surface = build._Surface(SURFACE, replace(REQUEST, transmission=glass.transmission), 0.2)
    errors = []
    for alpha, g, wavelength, near, orders in surface.checks():
        if (1, 0) in orders and not near:
            m, matrices = orders[1, 0]
            found = glass.evaluate(m, alpha - m / 2, g, wavelength, (1, 0), mueller=True)
            errors.append(np.abs(found - matrices).max(initial=0))
    assert len(errors) > 8
    assert np.mean(errors) < 0.05


def test_a_sheet_with_a_flat_grating_is_a_plate():
    """All bounces: T = (1 − R)/(1 + R) of each polarisation, and R + T = 1."""
    flat = build._Surface(gratings.blazed(0.3, 0.0, samples=64), replace(REQUEST, transmission="sheet"), 0.01)
    k_0, alpha, k_y = 0.3 / 0.45, 0.3, 0.35
    (solved,) = flat.solve(alpha, np.sqrt(k_0**2 - k_y**2), [0.45])
    ways = flat.matrices(solved)
    reflectance = np.array(fresnel(np.sqrt(1 - (alpha**2 + k_y**2) / k_0**2), 1.5))
    wanted = np.mean((1 - reflectance) / (1 + reflectance))
    for way, (of_in, of_out, matrices) in ways.items():
        (place,) = np.flatnonzero(of_in == 0)
        assert (of_in == of_out).all()
        assert matrices[place, place, 0, 0] == pytest.approx(wanted if way[0] != way[1] else 1 - wanted, abs=1e-7)


def test_a_scalar_spectrum_is_refused(spectrum, tmp_path):
    md.precompute(SURFACE, tolerance=0.01).save(tmp_path / "scalar.exr")
    with pytest.raises(ValueError, match="not a rigorous spectrum"):
        RigorousSpectrum.load(tmp_path / "scalar.exr")
    spectrum.save(tmp_path / "rigorous.exr")
    with pytest.raises(ValueError, match="not a grating spectrum"):
        md.GratingSpectrum.load(tmp_path / "rigorous.exr")


@pytest.mark.slow
def test_an_interrupted_build_goes_on(tmp_path):
    class Enough(Exception):
        pass

    def stop(done, total):
        if done >= 5:
            raise Enough

    small = gratings.sinusoidal(0.15, 0.03, samples=32)
    with pytest.raises(Enough):
        build_spectrum(small, REQUEST, progress=stop, checkpoints=tmp_path)
    assert list(tmp_path.iterdir())
    steps = []
    again = build_spectrum(
        small, REQUEST, progress=lambda done, total: steps.append((done, total)), checkpoints=tmp_path
    )
    assert steps[0][0] >= 5
    np.testing.assert_array_equal(again.values, build_spectrum(small, REQUEST).values)
    assert not list(tmp_path.iterdir())


def test_progress_is_one_count_in_per_cent(monkeypatch):
    """Also where finer tables follow."""
    monkeypatch.setattr("mitsuba_diffraction.rigorous.build._SOLVED", (4, 8, 16))
    monkeypatch.setattr("mitsuba_diffraction.rigorous.build._CHECKS", 2)
    reports = []
    with pytest.warns(UserWarning, match="with 16 steps to a unit"):
        build_spectrum(
            gratings.sinusoidal(0.15, 0.03, samples=32),
            replace(REQUEST, tolerance=1e-4),
            progress=lambda done, total: reports.append((done, total)),
        )
    done, total = np.transpose(reports)
    assert (np.diff(done) >= 0).all()
    assert len(set(done)) > 10
    assert set(total) == {100}
    assert done[-1] == 100


def test_light_of_a_coarser_lattice_is_not_solved_again(monkeypatch):
    monkeypatch.setattr(build, "_CHECKS", 2)
    scatter, counts, values = build.scatter, [], []
    for steps in ((4, 8), (8,)):
        solved = []
        monkeypatch.setattr(build, "scatter", lambda *light, solved=solved: solved.append(1) or scatter(*light))
        monkeypatch.setattr(build, "_SOLVED", steps)
        with pytest.warns(UserWarning, match="with 8 steps to a unit"):
            found = build_spectrum(gratings.blazed(0.15, 0.03, samples=32), replace(REQUEST, tolerance=1e-4))
        counts.append(len(solved))
        values.append(found.values)
    assert counts[0] == counts[1]
    np.testing.assert_array_equal(*values)


def test_a_checkpoint_is_no_reason_to_fail(tmp_path):
    """In a folder that cannot be written to, and where a checkpoint is damaged."""
    small = gratings.sinusoidal(0.15, 0.03, samples=32)
    wanted = build_spectrum(small, REQUEST, checkpoints=tmp_path / "good").values
    (tmp_path / "file").write_text("")
    np.testing.assert_array_equal(build_spectrum(small, REQUEST, checkpoints=tmp_path / "file" / "x").values, wanted)

    def leave(done, total):
        if done >= 3:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        build_spectrum(small, REQUEST, progress=leave, checkpoints=tmp_path)
    (checkpoint,) = tmp_path.glob("rigorous-*.npz")
    checkpoint.write_bytes(checkpoint.read_bytes()[:100])
    np.testing.assert_array_equal(build_spectrum(small, REQUEST, checkpoints=tmp_path).values, wanted)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tolerance": 0}, "tolerance: got 0"),
        ({"extent": "sample"}, "got rigorous with extent 'sample'"),
        ({"int_ior": None}, "wanted one of the two"),
        ({"theory": "exact"}, "theory: got 'exact'"),
        ({"transmission": "glass"}, "transmission: got 'glass', wanted one of none, interface, sheet"),
        ({"transmission": "sheet", "int_ior": None, "material": "Al"}, "sheet and int_ior None, wanted a dielectric"),
        ({"transmission": "interface", "ext_ior": 1.3}, "and ext_ior 1.3, wanted no coat"),
        ({"theory": "scalar"}, "wanted none of them"),
        ({"height_field": gratings.crossed(2.0, 0.2, samples=8)}, "rows that differ"),
        ({"height_field": [SURFACE, SURFACE]}, r"theory: got rigorous and 2 patches .*, wanted one, of one row"),
        ({"largest_height_range": 0.04}, r"heights: got a range of 0\.049\d* µm, wanted at most 0\.04"),
    ],
)
def test_what_is_out_of_range_is_refused(change, message):
    arguments = {"height_field": SURFACE, "theory": "rigorous", "int_ior": 1.5} | change
    with pytest.raises(ValueError, match=message):
        md.precompute(**arguments)
