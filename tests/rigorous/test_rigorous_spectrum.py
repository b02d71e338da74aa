"""The table of rigorous efficiencies against the solver."""

import warnings
from copy import copy
from dataclasses import replace

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

import mitsuba_diffraction as md
from mitsuba_diffraction import gratings, rigorous
from mitsuba_diffraction.errors import RequestError
from mitsuba_diffraction.optics.geometry import fresnel
from mitsuba_diffraction.rigorous import build_table
from mitsuba_diffraction.rigorous.build_table import build_rigorous
from mitsuba_diffraction.rigorous.rigorous_spectrum import Axes, RigorousSpectrum, interval_bounds, interval_of
from mitsuba_diffraction.settings import RigorousSettings

SURFACE = gratings.blazed(0.3, 0.05, samples=64)
REQUEST = RigorousSettings(int_ior=1.5, wavelengths=(400.0, 500.0), tolerance=0.2, coherence_length=40.0)


def coarse(steps, request):
    """Build a table of few steps, its error measured by few checks."""
    with pytest.MonkeyPatch.context() as patch, warnings.catch_warnings():
        warnings.simplefilter("ignore")
        for name in ("SOLVED_STEPS", "SOLVED_STEPS_TRANSMISSION"):
            patch.setattr(build_table, name, (steps,))
        patch.setattr(build_table, "CHECK_COUNT", 40)
        return build_rigorous(SURFACE, request)


@pytest.fixture(scope="module")
def spectrum():
    return coarse((8, 10, 8), REQUEST)


def hemisphere(count, seed):
    rng = np.random.default_rng(seed)
    z, turn = rng.random((2, count))
    return np.stack([np.sqrt(1 - z**2) * f(2 * np.pi * turn) for f in (np.cos, np.sin)] + [z], axis=-1)


def test_intervals_end_at_rayleigh_anomalies():
    axes = Axes(0.9, (0.36, 0.83), (8, 8, 4))
    assert axes.max_order == 4
    assert axes.blocks == {(1, 0): 0, (2, 0): 1, (3, 0): 5, (4, 0): 14, (5, 0): 30}
    a, count = np.random.default_rng(0).random((2, 99)) * [[0.5], [5.0]]
    n = np.arange(-6, 7)
    orders = (np.abs(n + a[:, None]) < count[:, None]).sum(axis=1)
    np.testing.assert_array_equal(interval_of(count**2, a), orders)
    for interval in range(1, 5):
        for bound in np.sqrt(interval_bounds(interval, a, 0.0)):
            np.testing.assert_allclose(np.abs(np.abs(n[:, None] + a) - bound).min(axis=0), 0, atol=1e-9)


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


@pytest.mark.slow
def test_the_table_is_reciprocal(spectrum):
    c, g = np.random.default_rng(2).random((2, 100)) * [[0.3], [0.75]]
    for m in (-1, 0, 1):
        forward, reverse = (spectrum.evaluate(m, sign * c, g, 0.45) for sign in (1, -1))
        np.testing.assert_allclose(forward, reverse, atol=1e-6)


def test_light_at_grazing_incidence_is_reflected_into_order_zero(spectrum):
    m, eta = spectrum.efficiencies((1 - 1e-9, 0, 1e-6), 0.45)
    assert eta[list(m).index(0)] == pytest.approx(1, abs=1e-3)
    assert eta.sum() <= 1 + 1e-3


@pytest.mark.parametrize(
    ("depth", "material"), [(0.15, {"material": "Al"}), (0.05, {"int_ior": 1.5, "ext_ior": 1.6})], ids=["metal", "coat"]
)
def test_no_efficiency_of_a_coarse_table_exceeds_one(depth, material, monkeypatch):
    """The harmonics of the table suffice for most directions, not for all."""
    monkeypatch.setattr("mitsuba_diffraction.rigorous.build_table.SOLVED_STEPS", ((3, 4, 3),))
    monkeypatch.setattr("mitsuba_diffraction.rigorous.build_table.CHECK_COUNT", 2)
    surface = gratings.blazed(0.5, depth, samples=256)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        table = build_rigorous(surface, replace(REQUEST, **{"int_ior": None} | material, wavelengths=(400.0, 450.0)))
    assert table.values.min() >= 0
    assert table.values.max() <= 1


@pytest.mark.not_quick
def test_a_profile_that_does_not_converge_is_refused():
    with pytest.raises(
        ValueError, match=r"error of 0\.\d+ with 80 harmonics at a wavelength of 400 nm, wanted at most"
    ):
        build_rigorous(
            gratings.lamellar(0.3, 0.3),
            replace(REQUEST, int_ior=None, material="Ag", wavelengths=(400.0, 450.0), tolerance=1e-4),
        )


def test_a_spectrum_is_unchanged_by_saving_and_loading(spectrum, tmp_path):
    assert len(repr(spectrum)) < 1000
    spectrum.save(tmp_path / "table.exr")
    loaded = RigorousSpectrum.load(tmp_path / "table.exr")
    np.testing.assert_array_equal(loaded.values, spectrum.values)
    for name in ("axes", "settings", "error", "harmonics", "source", "source_digest", "digest"):
        assert getattr(loaded, name) == getattr(spectrum, name)


@pytest.mark.parametrize(
    ("name", "value"),
    [("coherence_length", -1.0), ("tolerance", 7.0), ("ext_ior", 0.5), ("int_ior", 1.5 + 1j), ("transmission", "all")],
)
def test_settings_in_a_file_are_checked(spectrum, tmp_path, name, value):
    altered = copy(replace(spectrum.settings, transmission="interface" if name == "int_ior" else "none"))
    object.__setattr__(altered, name, value)
    wrong = copy(spectrum)
    object.__setattr__(wrong, "settings", altered)
    wrong.save(tmp_path / "table.exr")
    wanted = "transmission" if name == "int_ior" else name
    with pytest.raises(RequestError, match=rf"table.exr: a damaged spectrum \({wanted}: got "):
        RigorousSpectrum.load(tmp_path / "table.exr")


@pytest.fixture(scope="module", params=["interface", pytest.param("sheet", marks=pytest.mark.slow)])
def glass(request):
    """A table with transmission and Mueller matrices."""
    return coarse((6, 10, 6), replace(REQUEST, polarised=True, transmission=request.param))


@pytest.mark.slow
def test_a_table_with_transmission_is_unchanged_by_saving_and_loading(glass, tmp_path):
    glass.save(tmp_path / "glass.exr")
    loaded = RigorousSpectrum.load(tmp_path / "glass.exr")
    assert loaded.transmission == glass.transmission
    assert loaded.axes == glass.axes
    np.testing.assert_array_equal(loaded.values, glass.values)
    np.testing.assert_array_equal(loaded.mueller, glass.mueller)


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    cosine=st.floats(0.02, 1),
    turn=st.floats(0, 2 * np.pi),
    side=st.sampled_from([1, -1]),
    wavelength=st.floats(0.4, 0.5),
)
def test_reflected_and_transmitted_efficiencies_sum_to_one(glass, cosine, turn, side, wavelength):
    sine = np.sqrt(1 - cosine**2)
    omega = sine * np.cos(turn), sine * np.sin(turn), side * cosine
    total = sum(glass.efficiencies(omega, wavelength, transmitted)[1].sum() for transmitted in (False, True))
    assert total == pytest.approx(1, abs=2 * max(glass.max_error, glass.max_error_near))


def test_energy_is_conserved_where_the_shortest_wavelength_truncates_an_interval(glass):
    """R + T was off by up to 0.39 there."""
    sums = []
    for omega, wavelength, side in zip(hemisphere(600, 7), np.linspace(0.401, 0.499, 600), [1, -1] * 300, strict=True):
        if omega[2] > 0.02:
            omega_i = omega * [1, 1, side]
            sums.append(sum(glass.efficiencies(omega_i, wavelength, is_t)[1].sum() for is_t in (False, True)))
    assert np.abs(np.array(sums) - 1).max() < 0.08
    assert np.abs(np.array(sums) - 1).mean() < 0.01


def test_the_fit_to_a_parabola_has_the_least_mean_square_error():
    """h² f''/√720 between the ends, instead of h² f''/√120 with values of the parabola."""
    weights = build_table._fitted(lambda x: build_table._cubic(6, x), 12)
    x = np.linspace(0.25, 0.75, 1201)
    found = np.interp(x, np.arange(13) / 12, weights @ (np.arange(7) / 6) ** 2)
    assert np.sqrt(np.mean((found - x**2) ** 2)) == pytest.approx(2 / 144 / np.sqrt(720), rel=0.01)
    np.testing.assert_allclose(weights[[0, -1]], np.eye(7)[[0, -1]], atol=1e-12)


@settings(max_examples=60, deadline=None, suppress_health_check=list(HealthCheck))
@given(
    cosine=st.floats(0.05, 1),
    turn=st.floats(0, 2 * np.pi),
    side=st.sampled_from([1, -1]),
    wavelength=st.floats(0.4, 0.5),
)
def test_transmitted_efficiencies_are_reciprocal(glass, cosine, turn, side, wavelength):
    """Through the interface or the sheet in both directions: n_o ω_o,x = −λ m/T − n_i ω_i,x."""
    sine = np.sqrt(1 - cosine**2)
    omega = np.array([sine * np.cos(turn), sine * np.sin(turn), side * cosine])
    n_i, n_o = glass.indices[::side]
    for m, eta in zip(*glass.efficiencies(omega, wavelength, transmitted=True), strict=True):
        x, y = (-n_i * omega[:2] - [wavelength * m / 0.3, 0]) / n_o
        if x**2 + y**2 < 0.999:
            orders, reverse = glass.efficiencies((x, y, -side * np.sqrt(1 - x**2 - y**2)), wavelength, transmitted=True)
            assert reverse[list(orders).index(m)] == pytest.approx(eta, abs=1e-6)


def test_matrices_of_reversed_light_agree_with_the_solver(glass, monkeypatch):
    """The table does not store light from below to above; the sheet has its own closed sum for it."""
    monkeypatch.setattr("mitsuba_diffraction.rigorous.build_table.CHECK_COUNT", 30)
    relief = build_table._SolvedRelief(SURFACE, replace(REQUEST, transmission=glass.transmission), 0.2)
    errors = []
    for alpha, g, wavelength, near, orders in relief.checks():
        if (1, 0) in orders and not near:
            m, matrices = orders[1, 0]
            found = glass.evaluate(m, alpha - m / 2, g, wavelength, (1, 0), mueller=True)
            errors.append(np.abs(found - matrices).max(initial=0))
    assert len(errors) > 8
    assert np.mean(errors) < 0.05


def test_a_sheet_with_a_flat_grating_is_a_plate():
    """With all internal reflections T = (1 − R)/(1 + R) for each polarisation, and R + T = 1."""
    flat = build_table._SolvedRelief(
        gratings.blazed(0.3, 0.0, samples=64), replace(REQUEST, transmission="sheet"), 0.01
    )
    k_0, alpha, k_y = 0.3 / 0.45, 0.3, 0.35
    square = k_0**2 - k_y**2
    (solved,) = flat.solve(alpha, square, [flat.light(square, 0.45)])
    matrices_by_sides = flat.matrices(solved)
    reflectance = np.array(fresnel(np.sqrt(1 - (alpha**2 + k_y**2) / k_0**2), 1.5))
    wanted = np.mean((1 - reflectance) / (1 + reflectance))
    for (side_i, side_o), (incident, outgoing, matrices) in matrices_by_sides.items():
        (index,) = np.flatnonzero(incident == 0)
        assert (incident == outgoing).all()
        assert matrices[index, index, 0, 0] == pytest.approx(wanted if side_i != side_o else 1 - wanted, abs=1e-7)


@pytest.mark.parametrize("transmission", ["interface", "sheet"])
def test_nodes_of_imaginary_k_y_continue_fresnels_formulas(transmission):
    """Where γ > ν: Fresnel's formulas in β alone, which are real there, too; likewise for a plate."""
    flat = build_table._SolvedRelief(
        gratings.blazed(0.3, 0.0, samples=64), replace(REQUEST, transmission=transmission), 0.01
    )
    nu2, square, alpha = 0.4, 0.7, 0.5
    square_below = square + 1.25 * nu2
    (solved,) = flat.solve(alpha, square, [(nu2, square_below)])
    beta, beta_below = np.sqrt(square - alpha**2), np.sqrt(square_below - alpha**2)
    powers = np.array([((n * beta - beta_below) / (n * beta + beta_below)) ** 2 for n in (1, 1.5**2)])
    wanted = np.mean(powers if transmission == "interface" else 2 * powers / (1 + powers))
    incident, _, matrices = flat.matrices(solved)[0, 0]
    (index,) = np.flatnonzero(incident == 0)
    assert matrices[index, index, 0, 0] == pytest.approx(wanted, rel=1e-6)


@pytest.mark.slow
def test_the_table_of_a_ruled_glass_agrees_with_the_solver_for_light_from_inside():
    """With Rayleigh anomalies above and below, also where no order propagates above."""
    surface = gratings.transmission_600()
    settings = {"theory": "rigorous", "wavelengths": (500, 700), "int_ior": 1.52, "transmission": "interface"}
    table = md.precompute(surface, **settings)
    errors = []
    for omega, wavelength in zip(hemisphere(40, 3) * [1, 1, -1], np.linspace(0.505, 0.695, 40), strict=True):
        exact = rigorous.efficiencies(surface, omega, wavelength, int_ior=1.52)
        wanted = ((False, exact.unpolarised), (True, exact.transmission.unpolarised))
        errors.append(sum(np.abs(table.efficiencies(omega, wavelength, is_t)[1] - eta).sum() for is_t, eta in wanted))
    assert np.mean(errors) < 0.01
    assert max(errors) < 0.03


def test_a_scalar_spectrum_is_refused(spectrum, tmp_path):
    md.precompute(SURFACE, tolerance=0.01).save(tmp_path / "scalar.exr")
    with pytest.raises(ValueError, match="another kind; wanted a rigorous spectrum"):
        RigorousSpectrum.load(tmp_path / "scalar.exr")
    spectrum.save(tmp_path / "rigorous.exr")
    with pytest.raises(ValueError, match="another kind; wanted a grating spectrum"):
        md.GratingSpectrum.load(tmp_path / "rigorous.exr")


def test_an_interrupted_build_has_the_name_of_its_values(tmp_path):
    relief = gratings.sinusoidal(0.15, 0.03, samples=32)

    def digest(**indices):
        settings = RigorousSettings(wavelengths=(500, 600), tolerance=0.1, **indices)
        return build_table._SolvedRelief(relief, settings, 0.1).digest

    names = {
        digest(int_ior=2, ext_ior=1),
        digest(int_ior=2.0, ext_ior=1.0),
        digest(int_ior=2 + 0j, ext_ior=np.float64(1)),
    }
    assert len(names) == 1
    assert digest(int_ior=2.5) not in names
    assert digest(int_ior=2, ext_ior=1.2) not in names


@pytest.mark.slow
def test_an_interrupted_build_resumes(tmp_path):
    class Enough(Exception):
        pass

    def stop(done, total):
        if done >= 5:
            raise Enough

    small = gratings.sinusoidal(0.15, 0.03, samples=32)
    with pytest.raises(Enough):
        build_rigorous(small, REQUEST, progress=stop, checkpoints=tmp_path)
    assert list(tmp_path.iterdir())
    steps = []
    again = build_rigorous(
        small, REQUEST, progress=lambda done, total: steps.append((done, total)), checkpoints=tmp_path
    )
    assert steps[0][0] >= 5
    np.testing.assert_array_equal(again.values, build_rigorous(small, REQUEST).values)
    assert not list(tmp_path.iterdir())


@pytest.mark.not_quick
def test_progress_in_per_cent_begins_anew_with_a_finer_table(monkeypatch):
    monkeypatch.setattr(build_table, "SOLVED_STEPS", ((3, 3, 3), (4, 4, 4), (5, 5, 5)))
    monkeypatch.setattr(build_table, "CHECK_COUNT", 2)
    reports = []
    with pytest.warns(UserWarning, match="with 5 steps per interval"):
        build_rigorous(
            gratings.sinusoidal(0.15, 0.03, samples=32),
            replace(REQUEST, tolerance=1e-4),
            progress=lambda done, total: reports.append((done, total)),
        )
    done, total = np.transpose(reports)
    assert set(total) == {100}
    (ends,) = np.nonzero(done == 100)
    tables = np.split(done, ends + 1)[:-1]
    assert len(tables) == 3
    for table in tables:
        assert (np.diff(table) >= 0).all()
        assert len(set(table)) > 3


@pytest.mark.parametrize("transmission", ["none", "sheet", "interface"])
def test_the_work_of_a_job_is_the_number_of_its_eigenproblems(transmission, monkeypatch):
    """Jobs differ by a factor of five and more, so that equal steps of progress would mislead."""
    solved = []

    def counting(*arguments):
        # Harmonics that are raised where energy is not conserved cannot be foreseen.
        if arguments[0] is relief.gratings[0]:
            solved.append(arguments)
        return fields(*arguments)

    fields = build_table.half_space
    monkeypatch.setattr(build_table, "half_space", counting)
    monkeypatch.setattr(build_table._SolvedRelief.solve, "__defaults__", (0, counting))
    monkeypatch.setattr(build_table, "_PAIR_WORK", 0)
    relief = build_table._SolvedRelief(SURFACE, replace(REQUEST, transmission=transmission), 0.2)
    jobs = build_table._CoarseSolver(relief, (3, 4, 3), polarised=False)
    work, counted = jobs.work(), []
    for job in range(len(jobs.jobs)):
        solved.clear()
        (jobs._job if jobs.transmits else jobs._planes)(job)
        counted.append(len(solved))
    assert work == counted
    assert max(work) >= 5 * min(each for each in work if each)


@pytest.mark.slow
@pytest.mark.not_quick
@pytest.mark.filterwarnings("ignore:rigorous table")  # of few steps
def test_a_build_succeeds_without_a_usable_checkpoint(tmp_path, monkeypatch):
    """The folder cannot be written to, or the checkpoint is damaged."""
    monkeypatch.setattr(build_table, "SOLVED_STEPS", ((6, 8, 6),))
    monkeypatch.setattr(build_table, "CHECK_COUNT", 10)
    small = gratings.sinusoidal(0.15, 0.03, samples=32)
    wanted = build_rigorous(small, REQUEST, checkpoints=tmp_path / "good").values
    (tmp_path / "file").write_text("")
    np.testing.assert_array_equal(build_rigorous(small, REQUEST, checkpoints=tmp_path / "file" / "x").values, wanted)

    def leave(done, total):
        if done >= 3:
            raise InterruptedError

    with pytest.raises(InterruptedError):
        build_rigorous(small, REQUEST, progress=leave, checkpoints=tmp_path)
    (checkpoint,) = tmp_path.glob("rigorous-*.npz")
    checkpoint.write_bytes(checkpoint.read_bytes()[:100])
    np.testing.assert_array_equal(build_rigorous(small, REQUEST, checkpoints=tmp_path).values, wanted)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"tolerance": 0}, "tolerance: got 0"),
        ({"extent": "sample"}, "extent: got 'sample' with theory 'rigorous'"),
        ({"int_ior": None}, "wanted one of the two"),
        ({"theory": "exact"}, "theory: got 'exact'"),
        ({"transmission": "glass"}, "transmission: got 'glass', wanted one of none, interface, sheet"),
        (
            {"transmission": "sheet", "int_ior": None, "material": "Al"},
            "sheet with material 'Al' and int_ior None, wanted a dielectric",
        ),
        ({"transmission": "interface", "ext_ior": 1.3}, "and ext_ior 1.3, wanted no coat"),
        ({"theory": "scalar"}, "int_ior: got 1.5 with theory 'scalar', wanted none"),
        ({"height_field": gratings.crossed(2.0, 0.2, samples=8)}, "rows that differ"),
        ({"height_field": [SURFACE, SURFACE]}, r"theory: got rigorous and 2 patches .*, wanted one, of one row"),
        ({"largest_height_range": 0.04}, r"heights: got a range of 0\.049\d* µm, wanted at most 0\.04"),
    ],
)
def test_arguments_out_of_range_are_refused(change, message):
    arguments = {"height_field": SURFACE, "theory": "rigorous", "int_ior": 1.5} | change
    with pytest.raises(ValueError, match=message):
        md.precompute(**arguments)
