"""Passes on a Dask cluster: the bits of one machine, also when a worker is lost."""

import contextlib
import functools
import logging
import os
import signal
import socket
import subprocess
import sys
import threading
import time
from importlib.util import find_spec
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mitsuba_diffraction  # noqa: F401 (settles which LLVM is used before a variant is set)
from mitsuba_diffraction.render import SpectralImage, cluster, passes, render
from mitsuba_diffraction.render.cluster import trace_on
from mitsuba_diffraction.render.passes import Interrupted
from mitsuba_diffraction.render.scene_file import SceneFile

pytestmark = pytest.mark.skipif(not find_spec("distributed"), reason="Dask is not installed")

SIZE = 16
CONSTANT = '<emitter type="constant"/>'
SCENE = f"""<scene version="3.0.0"><integrator type="path"/>
<sensor type="perspective"><transform name="to_world"><lookat origin="0,-4,2" target="0,0,0.5" up="0,0,1"/></transform>
<film type="hdrfilm"><integer name="width" value="{SIZE}"/><integer name="height" value="{SIZE}"/>
<rfilter type="gaussian"/></film></sensor>{CONSTANT}
<shape type="sphere"><point name="center" x="0.4" y="0" z="0.5"/><bsdf type="diffraction_grating">
<string name="profile" value="blazed"/><float name="period" value="2.5"/><float name="depth" value="0.25"/>
</bsdf></shape></scene>"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch, small_passes):
    """Each test stands in a folder of its own, with a scene; passes take one sample per pixel."""
    small_passes(SIZE)
    monkeypatch.chdir(tmp_path)
    Path("scene.xml").write_text(SCENE)
    threads, caches = dr.thread_count(), (cluster.scene_of, cluster.light_of)  # before a test replaces one
    yield tmp_path
    for cache in caches:
        cache.cache_clear()
    dr.set_thread_count(threads)


def start(**options):
    import distributed  # takes a second

    return distributed.LocalCluster(dashboard_address=":0", threads_per_worker=1, **options)


def client_of(address):
    import distributed

    return distributed.Client(address, set_as_default=False)


@pytest.fixture
def threads_of_this_process():
    """A cluster of two workers that are threads of this process: for what traces nothing.

    While one thread traces, no other may let go of a scene: Dr.Jit calls every BSDF that there is in the process.
    """
    with start(n_workers=2, processes=False, protocol="tcp") as local:
        yield local.scheduler_address


@pytest.fixture
def processes(request):
    """A cluster of as many workers, each of which is a process of its own."""
    with start(n_workers=request.param, processes=True) as local:
        yield local


def with_light_from_gratings(scene):
    """The same on a floor in the sun, by the integrator that finds what the grating throws onto it."""
    sun = '<emitter type="directional"><vector name="direction" x="0" y="1" z="-1"/></emitter>'
    return scene.replace('"path"', '"diffraction_path"').replace("</scene>", f'{sun}<shape type="rectangle"/></scene>')


def with_a_folder(scene):
    """The same, whose sphere and sky are in files of a folder that the scene names."""
    start, end = scene.index("<shape"), scene.index("</shape>") + len("</shape>")
    Path("parts").mkdir()
    # Mitsuba hangs when it reads an EXR picture with one thread, as each of these workers has.
    mi.Bitmap(np.linspace(0.5, 2, 8 * 16 * 3, dtype=np.float32).reshape(8, 16, 3)).write("parts/sky.exr")
    sky = '<emitter type="envmap"><string name="filename" value="sky.exr"/></emitter>'
    Path("parts/sphere.xml").write_text(f'<scene version="3.0.0">{scene[start:end]}</scene>')
    scene = f'{scene[:start]}<path value="parts"/><include filename="sphere.xml"/>{scene[end:]}'
    return scene.replace('<path value="parts"/>', "").replace(CONSTANT, f'<path value="parts"/>{sky}')


@pytest.mark.slow
@pytest.mark.few(1)
@pytest.mark.parametrize("scene", [SCENE, with_light_from_gratings(SCENE)], ids=["path", "diffraction_path"])
@pytest.mark.parametrize("processes", [1, 2], indirect=True)
def test_a_cluster_gives_the_bits_of_one_machine(scene, processes, command):
    Path("scene.xml").write_text(with_a_folder(scene))
    line = (
        f"render scene.xml -o out.exr --float --spp 9 --variant llvm_ad_spectral --dask {processes.scheduler_address}"
    )
    code, _, err = command(line)
    assert (code, err) == (0, "")
    here = render("scene.xml", spp=9)
    np.testing.assert_array_equal(SpectralImage.load("out.exr").radiance, here.radiance)

    # Interrupted there and resumed here.
    def ctrl_c(done, total, error):
        if done == 4:
            signal.raise_signal(signal.SIGINT)

    with pytest.raises(Interrupted):
        render("scene.xml", spp=9, checkpoint="c", tracer=trace_on(processes.scheduler_address), progress=ctrl_c)
    resumed = render("scene.xml", spp=9, checkpoint="c")
    np.testing.assert_array_equal(resumed.radiance, here.radiance)


def test_results_that_arrive_out_of_order_are_added_in_order(threads_of_this_process, monkeypatch):
    seeds, ended, later_ended = [passes.pass_seed(0, number) for number in range(16)], [], threading.Event()

    def invented(scene, spp, seed, *others):
        """Numbers whose sum depends on the order: what is added between the second and the third pass is lost."""
        number, shape = seeds.index(seed), (SIZE, SIZE, 94)
        if number == 2 and not later_ended.is_set():
            assert later_ended.wait(60)
            time.sleep(0.3)  # until the result of the later one has arrived
        ended.append(number)
        if number > 2:
            later_ended.set()
        if number in (1, 2):
            return np.full(shape, {1: 1e18, 2: -1e18}[number], np.float32)
        return np.random.default_rng(seed).normal(size=shape).astype(np.float32)

    monkeypatch.setattr(passes, "trace_pass", invented)
    later_ended.set()
    local = render("scene.xml", spp=16)
    assert ended == list(range(16))
    ended.clear()
    later_ended.clear()
    # Without the lock, two threads would load a scene and set the number of threads at once.
    dr.set_thread_count(1)
    with monkeypatch.context() as only_here:
        only_here.setattr(cluster, "pass_lock", contextlib.nullcontext())
        only_here.setattr(cluster, "scene_of", lambda job: None)
        only_here.setattr(cluster, "light_of", lambda job: None)
        remote = render("scene.xml", spp=16, tracer=trace_on(threads_of_this_process))
    assert sorted(ended) == list(range(16))
    assert max(ended[: ended.index(2)]) > 2
    np.testing.assert_array_equal(remote.radiance, local.radiance)


def test_failures_of_a_worker_are_one_line(threads_of_this_process, monkeypatch, command):
    line = f"render scene.xml --spp 9 --variant llvm_ad_spectral --dask {threads_of_this_process}"

    def fail(*arguments):
        raise RuntimeError("rendering failed: no luck")

    monkeypatch.setattr(passes, "trace_pass", fail)
    code, out, err = command(line)
    assert (code, out) == (1, "")
    assert err.splitlines()[-1] == "mitsuba-diffraction: error: rendering failed: no luck"

    # A worker has the absolute path.
    load, digest = SceneFile.load, SceneFile.digest

    def miss(scene_file):
        if os.path.isabs(scene_file.path):
            raise FileNotFoundError("scene.xml: no such file")
        return load(scene_file)

    with monkeypatch.context() as only_here:
        only_here.setattr(SceneFile, "load", miss)
        cluster.scene_of.cache_clear()
        code, out, err = command(line)
    assert (code, out) == (1, "")
    assert err.splitlines()[-1].endswith("error: a worker cannot load the scene: scene.xml: no such file")
    monkeypatch.setattr(SceneFile, "digest", lambda file: "another" if os.path.isabs(file.path) else digest(file))
    cluster.scene_of.cache_clear()
    cluster.light_of.cache_clear()
    code, out, err = command(line)
    assert (code, out) == (1, "")
    assert "scene.xml: on a worker, the scene or a file that it references is different" in err.splitlines()[-1]
    monkeypatch.setattr(cluster, "versions", lambda: ("mitsuba 2.0",))
    code, out, err = command(line)
    assert "a worker has mitsuba 2.0; wanted mitsuba 3" in err.splitlines()[-1]


def test_an_unreachable_scheduler_is_one_line(command, monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_TIMEOUT", 0.5)
    line = "render scene.xml --spp 9 --variant llvm_ad_spectral --dask"
    for address in ("tcp://127.0.0.1:1", "nonsense://x"):
        code, out, err = command(f"{line} {address}")
        assert (code, out) == (1, "")
        assert f"mitsuba-diffraction: error: no Dask scheduler at {address}" in err.splitlines()[-1]
    with start(n_workers=0, processes=False, protocol="tcp") as local:
        code, out, err = command(f"{line} {local.scheduler_address}")
        assert (code, out) == (1, "")
        assert err.splitlines()[-1].endswith("has no workers")


def test_a_port_that_is_silent_is_no_scheduler(command, monkeypatch):
    monkeypatch.setattr(cluster, "CONNECT_TIMEOUT", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"tcp://127.0.0.1:{silent.getsockname()[1]}"
        code, out, err = command(f"render scene.xml --spp 9 --variant llvm_ad_spectral --dask {address}")
    assert (code, out) == (1, "")
    assert err.strip() == f"mitsuba-diffraction: error: no Dask scheduler at {address}: it does not answer"


@pytest.fixture
def invented_passes(monkeypatch):
    """Passes that are not traced, so that workers may be threads of this process."""
    monkeypatch.setattr(cluster, "pass_lock", contextlib.nullcontext())
    monkeypatch.setattr(cluster, "scene_of", functools.cache(lambda job: None))
    monkeypatch.setattr(cluster, "light_of", lambda job: None)
    monkeypatch.setattr(cluster, "SECONDS_BETWEEN_LOOKS", 0.05)
    monkeypatch.setattr(passes, "trace_pass", lambda scene, spp, *_: np.full((SIZE, SIZE, 94), spp, np.float32))
    dr.set_thread_count(1)


def workers_of(address):
    with client_of(address) as client:
        return set(client.nthreads())


def lose_workers(local):
    local.scale(0)
    until = time.monotonic() + 10
    while local.scheduler.workers and time.monotonic() < until:
        time.sleep(0.01)


def test_other_workers_are_waited_for(invented_passes, monkeypatch, caplog):
    monkeypatch.setattr(cluster, "SECONDS_WITHOUT_WORKERS", 0.2)
    with start(n_workers=1, processes=False, protocol="tcp") as local:

        def lose(done, total, error):
            if done == 3:
                lose_workers(local)

        class Joining(logging.Handler):
            def emit(self, record):
                local.scale(1)

        joining = Joining()
        logging.getLogger(cluster.__name__).addHandler(joining)
        try:
            image = render("scene.xml", spp=8, tracer=trace_on(local.scheduler_address), progress=lose)
        finally:
            logging.getLogger(cluster.__name__).removeHandler(joining)
    assert image.attributes["spp"] == 8
    expected = f"the Dask scheduler at {local.scheduler_address} has no workers left; waiting for others"
    assert [record.getMessage() for record in caplog.records if record.name == cluster.__name__] == [expected]


def test_ctrl_c_is_heard_without_workers(invented_passes, monkeypatch):
    monkeypatch.setattr(cluster, "SECONDS_WITHOUT_WORKERS", 0.2)
    monkeypatch.setattr(cluster._log, "warning", lambda *arguments: signal.raise_signal(signal.SIGINT))
    with start(n_workers=1, processes=False, protocol="tcp") as local, pytest.raises(Interrupted) as caught:
        render(
            "scene.xml",
            spp=8,
            tracer=trace_on(local.scheduler_address),
            progress=lambda done, total, error: lose_workers(local) if done == 3 else None,
        )
    assert 3 <= caught.value.image.attributes["spp"] < 8


def test_a_late_worker_of_another_version_is_left_out(invented_passes, monkeypatch, caplog):
    from distributed import get_worker

    with start(n_workers=1, processes=False, protocol="tcp") as local:
        first, known = workers_of(local.scheduler_address), cluster.versions()

        def versions():
            return known if get_worker().address in first else ("mitsuba 2.0",)

        monkeypatch.setattr(cluster, "versions", versions)

        def join(done, total, error):
            if done == 3:
                local.scale(2)
                local.wait_for_workers(2)

        image = render("scene.xml", spp=40, tracer=trace_on(local.scheduler_address), progress=join)
        (late,) = workers_of(local.scheduler_address) - first
    assert image.attributes["spp"] == 40
    messages = {record.getMessage() for record in caplog.records if record.name == cluster.__name__}
    assert messages == {f"the worker at {late} is left out: a worker has mitsuba 2.0; wanted {', '.join(known)}"}


WORKER_WITHOUT_PACKAGE = """import sys
sys.modules["mitsuba_diffraction"] = None
sys.path[:] = [folder for folder in sys.path if folder]
from distributed.cli.dask_worker import main
main([sys.argv[1], "--no-nanny", "--no-dashboard", "--nthreads", "1"])"""


@pytest.mark.slow
@pytest.mark.parametrize("late", [True, False])
def test_a_worker_without_the_package_is_left_out(late, invented_passes, caplog):
    with start(n_workers=1 if late else 0, processes=False, protocol="tcp") as local, contextlib.ExitStack() as ends:
        first = workers_of(local.scheduler_address)

        def join(done=3, *others):
            if done == 3:
                call = [sys.executable, "-c", WORKER_WITHOUT_PACKAGE, local.scheduler_address]
                worker = subprocess.Popen(call, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
                ends.callback(worker.wait)
                ends.callback(worker.kill)
                with client_of(local.scheduler_address) as client:
                    client.wait_for_workers(len(first) + 1, timeout=120)

        if late:
            image = render("scene.xml", spp=40, tracer=trace_on(local.scheduler_address), progress=join)
            assert image.attributes["spp"] == 40
            (without,) = workers_of(local.scheduler_address) - first
            messages = [record.getMessage() for record in caplog.records if record.name == cluster.__name__]
            assert messages == [f"the worker at {without} is left out: it lacks the package mitsuba_diffraction"]
        else:
            join()
            with pytest.raises(RuntimeError, match=r"no worker of tcp://.* has the package mitsuba_diffraction"):
                render("scene.xml", spp=40, tracer=trace_on(local.scheduler_address))


@pytest.mark.slow
def test_the_checkpoint_survives_a_stop_of_the_scheduler():
    local = start(n_workers=1, processes=False, protocol="tcp")

    def close(done, total, error):
        if done == 3:
            local.close()

    with local, pytest.raises(RuntimeError, match=r"the Dask scheduler at tcp://.* is gone"):
        render("scene.xml", spp=60, checkpoint="c", seconds=0, tracer=trace_on(local.scheduler_address), progress=close)
    whole = render("scene.xml", spp=60, checkpoint="c")
    np.testing.assert_array_equal(whole.radiance, render("scene.xml", spp=60).radiance)


@pytest.mark.slow
def test_a_killed_scheduler_is_one_line():
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        address = f"tcp://127.0.0.1:{free.getsockname()[1]}"
    scheduler = ["scheduler", "--host", "127.0.0.1", "--port", address.rpartition(":")[2], "--no-dashboard"]
    dask = [
        subprocess.Popen([sys.executable, "-m", "dask", *words], stderr=subprocess.DEVNULL)
        for words in (scheduler, ["worker", address, "--no-dashboard", "--no-nanny", "--death-timeout", "20"])
    ]
    line = f"render scene.xml -o out.exr --spp 100000 --checkpoint 0 --variant llvm_ad_spectral --dask {address}"
    try:
        command = [sys.executable, "-m", "mitsuba_diffraction", *line.split()]
        rendering = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
        until = time.monotonic() + 120
        while not Path("out.exr.checkpoint").exists():
            assert rendering.poll() is None, rendering.stderr.read()
            assert time.monotonic() < until
            time.sleep(0.1)
        dask[0].kill()
        _, err = rendering.communicate(timeout=120)
    finally:
        for process in dask:
            process.kill()
            process.wait()
    assert rendering.returncode == 1
    lines = [text for text in err.splitlines() if " spp, " not in text]
    assert lines[0] == "mitsuba-diffraction: scene.xml: loading and compiling"
    assert lines[1:] == [f"mitsuba-diffraction: error: the Dask scheduler at {address} is gone"]


@pytest.mark.slow
@pytest.mark.posix("SIGKILL")
@pytest.mark.parametrize("processes", [2], indirect=True)
def test_the_passes_of_a_lost_worker_are_traced_again(processes):
    here = render("scene.xml", spp=60)
    with client_of(processes.scheduler_address) as client:
        pids = list(client.run(os.getpid).values())
    assert len(set(pids)) == 2
    calls = []

    def kill(done, total, error):
        calls.append(done)
        if done == 7:
            os.kill(pids[0], signal.SIGKILL)

    there = render("scene.xml", spp=60, tracer=trace_on(processes.scheduler_address), progress=kill)
    assert calls == list(range(61))
    np.testing.assert_array_equal(there.radiance, here.radiance)
