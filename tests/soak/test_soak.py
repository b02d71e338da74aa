"""Random configurations, judged by oracles that share no code with the plugin; random scenes, beside Mitsuba.

    python -m pytest tests/soak                                              fixed seeds, half a minute
    python -m pytest tests/soak -k scenes --soak 120 --soak-seed 1000        two hours, from a seed on

A failure shows the configuration and its seed; `--soak-seed` without `--soak` finds it again and shrinks it. It
becomes a case in `CASES`.
"""

import gc
import time
import traceback

import drjit as dr
import hypothesis
import mitsuba as mi
import pytest
from hypothesis import HealthCheck, Phase, given, settings
from soak_grammar import Configuration, Surface, configurations
from soak_model import Cauchy
from soak_oracles import judge
from soak_scenes import RandomScene, judge_scene, spectra

pytestmark = [
    pytest.mark.filterwarnings("ignore:pixels of"),
    pytest.mark.filterwarnings("ignore:terms"),
    pytest.mark.filterwarnings("ignore:sample of"),
]
FIXED_SEED = 1
EXAMPLES = 20  # of each seed of a long run
SINUSOID = Surface("sinusoid", (2.5, 2.5), 0.3)
CASES = {
    # Orders beyond the critical angle of the coat were part of the sums of probabilities, but could not be drawn.
    "coat over resolved orders": Configuration(
        SINUSOID, coat=1.5, directions=((45.0, 0.0, 0), (80.0, 30.0, 0)), wavelengths=(550.0,) * 4
    ),
    "ruled grating under a coat": Configuration(
        Surface("triangle", (0.8333, 0.8333), 0.2), material="Al", coat=1.5, directions=((30.0, 0.0, 0),)
    ),
    # E was that of the bare surface.
    "aluminium film on an interface": Configuration(
        Surface("sinusoid", (2.5, 2.5), 0.5),
        material=1.5,
        films=(("Al", 0.05),),
        transmission="interface",
        directions=((89.0, 0.0, 0),),
    ),
    "silver film on a sheet": Configuration(
        Surface("sinusoid", (2.5, 2.5), 0.5),
        material=1.5,
        films=(("Ag", 0.03),),
        transmission="sheet",
        directions=((89.0, 0.0, 0),),
    ),
    "dense film on glass of nearly no index": Configuration(
        Surface("sinusoid", (2.5, 2.5), 0.5),
        material=1.05,
        films=((2.35, 0.08),),
        transmission="interface",
        directions=((89.0, 0.0, 0),),
    ),
    # In the tail of a wide lobe κ of the order and κ of the two directions have opposite signs; the sign of the latter
    # was taken, which errs by η(κ)/η(−κ).
    "tail of an order whose κ has the other sign": Configuration(
        Surface("harmonics", (1.267, 1.267), 0.963, shape=0.782, seed=84, count=3),
        coherence_length=1.5,
        material=1.5,
        transmission="interface",
        shadowing="none",
        conserve_energy=False,
        directions=((110.71, 0.0, 3),),
        wavelengths=(830.0, 714.1, 449.9, 635.8),
    ),
    # The index of the coat was that of 547 nm.
    "medium under a coat of which both disperse": Configuration(
        SINUSOID, material=Cauchy(1.532, 0.0059), coat=Cauchy(1.54, 0.012), wavelengths=(380.0, 450.0, 550.0, 700.0)
    ),
    # The process ended.
    "derivative by lengths": Configuration(SINUSOID, lateral_scale=0.9, derived=5, directions=((20.0, 0.0, 0),)),
    # f has a step where an order is at the horizon inside of a sheet, and the last bit decides on the side.
    "order at the horizon inside of a sheet": Configuration(
        Surface("harmonics", (1.0, 1.0), 1.1, shape=0.847, seed=77, count=1),
        coherence_length=12.55,
        material=1.5,
        outside=1.55,
        films=((Cauchy(1.728, 0.0185), 0.159),),
        transmission="sheet",
        height_scale=0.708,
        shadowing="none",
        conserve_energy=False,
        directions=((180.0, 359.0, 0),),
        wavelengths=(500.0, 701.0, 360.0, 380.0),
    ),
    # The judge took it for a fault: R + T of 1.09 beside a Rayleigh anomaly, where the table errs by up to 0.09.
    "order beside its anomaly in a rigorous table": Configuration(
        Surface("triangle", (0.41, 0.41), 0.028, seed=99),
        coherence_length=10.74,
        material=1.9,
        transmission="interface",
        theory="rigorous",
        directions=((70.73, 0.0, 0),),
        wavelengths=(656.1, 600.0, 783.2, 488.5),
    ),
    # Likewise: 5e-7 of the light in the tail of a lobe between points of its grid,
    "tail of a lobe at the edge of a square": Configuration(
        Surface("triangle", (1.0, 1.0), 0.333, shape=0.416, seed=71),
        coherence_length=21.1,
        material="Ag",
        outside=1.383,
        coat=1.5,
        conserve_energy=False,
        directions=((0.43, 293.1, 0), (0.0, 0.0, 0), (88.57, 21.2, 0)),
        wavelengths=(814.7, 701.0, 657.3, 724.9),
    ),
    # and steps of a table of which η is a thirtieth, in differences that nearly cancel over a band.
    "derivative by an index of a deep sheet": Configuration(
        Surface("sinusoid", (0.532, 0.532), 1.016, seed=45, turned=True),
        coherence_length=16.0,
        material=1.327,
        outside=1.105,
        transmission="sheet",
        height_scale=0.899,
        lateral_scale=0.899,
        shadowing="none",
        derived=59,
        directions=((180.0, 0.0, 0), (89.1, 0.0, 0)),
        wavelengths=(554.3, 578.0, 695.4, 360.0),
    ),
    # Rows of bins without power were drawn, and had no density.
    "no frequency propagates": Configuration(
        Surface("ridges", (1.111, 1.111), 0.534, shape=0.5, seed=91),
        coherence_length=6.04,
        material=3.102,
        transmission="interface",
        conserve_energy=False,
        directions=((92.31, 281.6, 2),),
        wavelengths=(778.7, 432.4, 377.2, 804.0),
    ),
}


@pytest.mark.few(1)
@pytest.mark.parametrize("name", CASES)
def test_case(llvm, tmp_path, name):
    judge(CASES[name], tmp_path, ("value", "density", "tables", "derivatives"))


@pytest.mark.parametrize("fixed", [1, pytest.param(4, marks=pytest.mark.slow)])
def test_random_configurations(llvm, tmp_path, pytestconfig, capsys, fixed):
    """The number of `fixed` configurations of a fixed seed, or random ones as the options say."""
    minutes, seed = pytestconfig.getoption("--soak"), pytestconfig.getoption("--soak-seed")
    if not minutes:
        explore(*(FIXED_SEED, fixed) if seed is None else (seed, EXAMPLES), tmp_path)
        return
    if fixed > 1:
        pytest.skip("these seeds were judged by the test of one configuration")
    repeat(lambda seed: explore(seed, EXAMPLES, tmp_path, shrink=False), "configurations", minutes, seed, capsys)


def test_curves_of_scenes_end_within_their_arrays(llvm, tmp_path):
    """Seed 230210: the process ended where a ray met the end of the last curve."""
    curves = mi.load_dict({"type": "bsplinecurve", "filename": str(RandomScene(1, tmp_path, {}).curve())})
    found = dr.zeros(mi.PreliminaryIntersection3f)
    found.t, found.shape, found.prim_uv = mi.Float(1), mi.ShapePtr(curves), mi.Point2f(1, 0)
    ray = mi.Ray3f([0, 0, 3], [0, 0, -1])
    assert curves.primitive_count() == 3
    with dr.scoped_set_flag(dr.JitFlag.Debug):  # reports what is read outside of an array
        found.prim_index = mi.UInt32(1)  # the last segment in sight
        dr.eval(curves.compute_surface_interaction(ray, found))
        found.prim_index = mi.UInt32(2)
        with pytest.raises(RuntimeError, match="out-of-bounds"):  # of Mitsuba 3.9.1; with a later one, draw one curve
            dr.eval(curves.compute_surface_interaction(ray, found))


@pytest.mark.slow
def test_random_scenes(llvm, tmp_path, pytestconfig, capsys):
    """Two scenes of fixed seeds, or random ones as the options say."""
    minutes, seed = pytestconfig.getoption("--soak"), pytestconfig.getoption("--soak-seed")
    files = spectra(tmp_path)
    if not minutes:
        for each in (0, 5) if seed is None else (seed,):
            judge_scene(each, tmp_path, files)
        return

    def judged(seed):
        judge_scene(seed, tmp_path, files)
        gc.collect()
        return 1

    repeat(judged, "scenes", minutes, seed, capsys)


def repeat(judged, what, minutes, seed, capsys):
    """Judge for so long, from a seed on; print faults, and at times how many were judged."""
    start = report = time.monotonic()
    seed = time.time_ns() % 10**6 if seed is None else seed
    tried, faults = 0, []
    while time.monotonic() < start + 60 * minutes:
        before = tried
        try:
            tried += judged(seed)
        except Exception as error:
            faults.append(seed)
            with capsys.disabled():
                # With its cause, which Mitsuba hides behind an error of its own.
                said = (error, error.__cause__) if error.__cause__ else (error,)
                lines = "".join(line for one in said for line in traceback.format_exception_only(one))
                print(f"\n--soak-seed {seed}: {lines}", flush=True)
        seed += 1
        elapsed = time.monotonic() - start
        if time.monotonic() > report + 300 or before == tried:
            report = time.monotonic()
            with capsys.disabled():
                print(f"\n{elapsed / 60:.0f} min, seed {seed}, {tried} {what} without a fault", flush=True)
    with capsys.disabled():
        print(f"\n{tried} {what}, {60 * tried / elapsed:.1f} a minute, {len(faults)} faults: {faults}")
    assert not faults


def explore(seed, examples, folder, shrink=True):
    """Judge random configurations of a seed; return how many."""
    tried = []

    @hypothesis.seed(seed)
    @settings(
        max_examples=examples,
        phases=[Phase.generate, *([Phase.shrink] if shrink else [])],
        deadline=None,
        database=None,
        derandomize=False,
        report_multiple_bugs=False,
        suppress_health_check=list(HealthCheck),
    )
    @given(configurations())
    def judged(configuration):
        tried.append(configuration)
        try:
            judge(configuration, folder)
        finally:
            gc.collect()

    judged()
    return len(tried)
