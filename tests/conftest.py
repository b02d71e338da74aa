"""What all tests share: a cache of their own, the measured scans, and the command."""

import gc
import os
import shlex
import shutil
import signal
import sys
import warnings
from collections import defaultdict
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest
from hypothesis import settings
from threadpoolctl import threadpool_limits

import mitsuba_diffraction as md  # before Dr.Jit, so that it has an LLVM that works
from mitsuba_diffraction import cli, progress

from bsdf_support import use  # isort: skip
from mitsuba_diffraction.render import passes

# One example may be the first to import or to compile something.
# CI draws the same examples each time, so that a failure is of the change; slow tests draw others.
settings.register_profile("tests", deadline=None, max_examples=30, derandomize="CI" in os.environ)
settings.register_profile("slow", deadline=None, max_examples=200)
settings.register_profile("quick", deadline=None, max_examples=5)

gc.disable()  # while tests are collected, which makes no garbage

MEASURED = Path(__file__).parents[1] / "precompute" / "measured"
_HEIGHT_RANGE = {"elaphe": 0.375, "xenopeltis": 0.819}
"""µm, black to white."""
_TAKES_LONG = {"mi", "Furnace", "NotebookClient", "subprocess"}
"""What test modules import whose tests compile kernels, trace light in a furnace or start Python anew."""


def pytest_addoption(parser):
    """Add the options of tests/soak."""
    parser.addoption("--soak", type=float, default=0.0, metavar="MINUTES", help="try random configurations for so long")
    parser.addoption("--soak-seed", type=int, metavar="SEED", help="of the first configurations; printed with a fault")


def pytest_configure(config):
    """Draw fewer examples where slow tests are left out, and few where only quick ones run."""
    chosen = config.option.markexpr
    settings.load_profile("quick" if chosen == "quick" else "tests" if "not slow" in chosen else "slow")


@pytest.hookimpl(tryfirst=True)  # before -m selects
def pytest_collection_modifyitems(items):
    """Mark cases of tests as `slow` or `quick`.

    Of a test marked `few(n)`, n of the cases that are not slow stay so, evenly spaced; the others are slow.
    """
    cases = defaultdict(list)
    for item in items:
        if (few := item.get_closest_marker("few")) and not item.get_closest_marker("slow"):
            cases[few.args[0], item.function].append(item)
    for (count, _), those in cases.items():
        kept = np.linspace(0, len(those) - 1, count).round()
        for case in set(range(len(those))) - set(kept):
            those[case].add_marker(pytest.mark.slow)
    # Of the tests that do none of what takes long, one case each is quick.
    tests = set()
    for item in items:
        takes_long = "llvm" in item.fixturenames or _TAKES_LONG & vars(item.module).keys()
        marked = item.get_closest_marker("slow") or item.get_closest_marker("not_quick")
        if not (takes_long or marked or item.function in tests):
            tests.add(item.function)
            item.add_marker(pytest.mark.quick)
        if (posix := item.get_closest_marker("posix")) and os.name != "posix":
            item.add_marker(pytest.mark.skip(reason=f"{posix.args[0]}: not on {sys.platform}"))


@pytest.fixture(scope="session", autouse=True)
def imported_modules_are_no_garbage():
    """Leave what was imported out of later collections, each of which would take half a second."""
    gc.collect()
    gc.freeze()
    gc.enable()
    yield
    gc.unfreeze()


@pytest.fixture(scope="module", autouse=True)
def garbage_between_modules(imported_modules_are_no_garbage, request):
    """Collect garbage between modules only: Dr.Jit aborts where a scene is collected while `dr.freeze` records.

    A grating that outlives its module is in the kernels of all later ones: they are compiled again, seven times slower.
    """
    gc.collect()
    base = sys.modules.get("mitsuba_diffraction.bsdf.base")
    assert request.session.testsfailed or base is None or not base.living, "gratings of an earlier module live on"
    gc.disable()
    yield
    gc.enable()


@pytest.fixture(scope="session", autouse=True)
def one_thread_of_blas():
    """Compute with one thread in BLAS, here and in what tests start: waiting threads spin, on cores of other tests."""
    with threadpool_limits(1, user_api="blas"), pytest.MonkeyPatch.context() as patch:
        patch.setenv("OPENBLAS_NUM_THREADS", "1")
        yield


@pytest.fixture(scope="session", autouse=True)
def tables_of_e_are_kept():
    """Compute E once for all tests of a process that need the same one."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mitsuba_diffraction.energy.table.MAX_KEPT", 1000)
        yield


@pytest.fixture(scope="session", autouse=True)
def cache_folder(tmp_path_factory):
    """A folder for the spectra of recipes that lasts for this session only, the same for all its processes."""
    session = tmp_path_factory.getbasetemp()
    folder = (session.parent if "PYTEST_XDIST_WORKER" in os.environ else session) / "cache"
    folder.mkdir(exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("MITSUBA_DIFFRACTION_CACHE", str(folder))
        yield folder


@pytest.fixture(scope="session", autouse=True)
def ctrl_c():
    """Ctrl-C interrupts; what a script starts in the background ignores it."""
    before = signal.signal(signal.SIGINT, signal.default_int_handler)
    yield
    signal.signal(signal.SIGINT, before)


@pytest.fixture(scope="session")
def small_scenes(tmp_path_factory):
    """The folder of scenes beside that of recipes, with models of few texels."""
    root, repository = tmp_path_factory.mktemp("root"), Path(__file__).parents[1]
    scenes = root / "scenes"
    shutil.copytree(repository / "scenes", scenes, ignore=shutil.ignore_patterns("models", "__pycache__"))
    shutil.copytree(repository / "precompute", root / "precompute")
    with pytest.MonkeyPatch.context() as patch:
        patch.syspath_prepend(str(repository / "scenes"))
        import anodised
        import beetle
        import disc
        import foil
        import ground
        import hologram
        import snake
        import street
    models = scenes / "models"
    models.mkdir()
    snake.make(models, columns=640)
    disc.make(models, count=64)
    foil.make(models, count=60)
    ground.make(models, size=256)
    hologram.make(models, columns=32)
    anodised.make(models, columns=64)
    beetle.make(models, columns=90)
    street.make(models)
    return scenes


@pytest.fixture
def full_disk():
    """full_disk(size): a context in which no file becomes larger, not even one of the superuser; for marked `posix`."""
    import resource

    @contextmanager
    def limit(size):
        soft, hard = resource.getrlimit(resource.RLIMIT_FSIZE)
        resource.setrlimit(resource.RLIMIT_FSIZE, (size, hard))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, (soft, hard))

    return limit


@pytest.fixture
def small_passes(llvm, monkeypatch):
    """small_passes(side): passes take one sample per pixel of a square picture."""

    def take(side):
        monkeypatch.setattr(passes, "SAMPLES_PER_PASS", side**2)
        monkeypatch.setattr(passes, "SAMPLES_PER_PIXEL_OF_LARGE_PICTURES", 1)

    return take


@pytest.fixture
def scan_file():
    """scan_file(name): the path of a measured scan."""
    return lambda name: MEASURED / f"{name}_afm_100x100.png"


@pytest.fixture
def scan(scan_file):
    """scan(name): the height field of a measured scan."""
    return lambda name: md.read_height_field(scan_file(name), pixel_size=0.0586, height_range=_HEIGHT_RANGE[name])


@pytest.fixture(scope="session")
def panel():
    """20 µm of Xenopeltis, its missing pixels filled."""
    return md.read_height_field(MEASURED / "xenopeltis_afm_20um.npz", pixel_size=20 / 370, fill_missing=True)


@pytest.fixture
def command(monkeypatch, capfd):
    """command(line) or command(*words): (exit code, stdout, stderr) of the command, in this process."""
    # On a slow machine a command says how far it is, and how long it takes.
    monkeypatch.setattr(progress, "MIN_ANNOUNCED_SECONDS", 1e6)

    def call(*words):
        arguments = shlex.split(words[0]) if len(words) == 1 else words
        monkeypatch.setattr(sys, "argv", [cli.NAME, *arguments])
        monkeypatch.setattr(progress, "log_lines", lambda *label: lambda *done: None)
        monkeypatch.setattr(progress, "MIN_REPORTED_SECONDS", 1e6)
        # Warnings are shown, as they are to a person, and what shows them is put back afterwards.
        with warnings.catch_warnings():
            warnings.simplefilter("default")
            with pytest.raises(SystemExit) as caught:
                cli.main()
        return caught.value.code, *capfd.readouterr()

    return call


@pytest.fixture
def llvm():
    """The variant that most tests are for."""
    use("llvm_ad_spectral")
