"""Every error of `render/` that no other test provokes, each in one line."""

import asyncio
import re
import sys
from types import SimpleNamespace

import numpy as np
import pytest
from bsdf_support import use
from test_render import CONSTANT, SENSOR, SPHERE, write_scene

from mitsuba_diffraction.errors import RequestError
from mitsuba_diffraction.render import cluster, denoise, passes, render, trace_pass
from mitsuba_diffraction.render.passes import split
from mitsuba_diffraction.render.scene_file import SceneFile
from mitsuba_diffraction.render.spectral_image import SpectralImage

CAMERA = SENSOR.format(film='<film type="hdrfilm"><integer name="width" value="{}"/></film>')
GLASS = '<shape type="sphere"><bsdf type="dielectric" id="glass"/></shape>'


def one_line(message, call, error=RequestError):
    with pytest.raises(error, match=message) as found:
        call()
    assert "\n" not in str(found.value)


@pytest.mark.parametrize(
    ("message", "content"),
    [
        ("the file holds a .*Camera, wanted a scene", CAMERA.format(8).replace("<sensor", '<sensor version="3.0.0"')),
        ("the scene has no sensor", '<scene version="3.0.0"><integrator type="path"/></scene>'),
        ("the scene has no integrator", f'<scene version="3.0.0">{CAMERA.format(8)}</scene>'),
        (
            "sensor: got srf, wanted none",
            CAMERA.format(8)
            .replace("</sensor>", '<spectrum name="srf" value="500:0,530:1,560:0"/></sensor>')
            .join(['<scene version="3.0.0"><integrator type="path"/>', "</scene>"]),
        ),
        (
            "film: width is 8.5, wanted a whole number of pixels",
            f'<scene version="3.0.0"><integrator type="path"/>{CAMERA.format(8.5).replace("integer", "float")}</scene>',
        ),
        (
            r"film: got 1000000 × 576 pixels, wanted at most 33554432 in all",
            f'<scene version="3.0.0"><integrator type="path"/>{CAMERA.format(10**6)}</scene>',
        ),
    ],
)
def test_scenes_that_cannot_be_rendered(llvm, tmp_path, message, content):
    path = tmp_path / "scene.xml"
    path.write_text(content)
    one_line(message, lambda: SceneFile(path).load())


def test_requests_that_cannot_be_met(llvm, tmp_path, monkeypatch):
    path = write_scene(tmp_path, CONSTANT + GLASS)
    one_line("width: got 0, wanted a positive number of pixels", lambda: SceneFile(path, size=(0, None)).load())
    grating = {"glass": {"profile": "blazed", "period": 2.5, "depth": 0.25}}
    one_line("in the place of a BSDF that transmits light", lambda: SceneFile(path, replacements=grating).load())
    one_line("spp: got 0, wanted a positive number", lambda: render(path, spp=0))
    one_line("wanted at most .* for so large a picture", lambda: split(SceneFile(path).load(), 10**14))
    monkeypatch.setattr(trace_pass, "available_memory", lambda: 1000)
    one_line("film: got 8 × 8 pixels, which take .* that are available", lambda: render(path, spp=1))
    monkeypatch.setitem(sys.modules, "pyoidn", None)
    one_line("denoise: pyoidn is not installed", denoise.check_requirements)
    monkeypatch.setitem(sys.modules, "distributed", None)
    one_line("a Dask cluster needs the package distributed", lambda: cluster.trace_on("tcp://a:1"), RuntimeError)
    one_line("wanted names of files and folders in UTF-8", lambda: render(tmp_path / "s\udce9.xml", spp=1))
    use("scalar_rgb")
    one_line("variant: got 'scalar_rgb', wanted a spectral one", lambda: SceneFile(path).load())


def test_integrators_whose_samples_are_correlated_are_named(llvm, tmp_path, caplog):
    path = write_scene(tmp_path, CONSTANT + SPHERE, sensor=SENSOR.replace("independent", "multijitter"))
    path.write_text(path.read_text().replace('type="path"', 'type="prb"'))
    render(path, spp=1)
    assert "sampler: got MultijitterSampler, wanted independent" in caplog.text


@pytest.mark.parametrize(
    ("luminance", "message"),
    [(np.nan, "luminance is not finite at pixel x = 2, y = 1"), (1e9, "luminance is 1e[+]09, far above the lights")],
)
def test_pixels_that_cannot_be_are_named(luminance, message, caplog):
    picture = np.ones((3, 4), np.float32)
    picture[1, 2] = luminance
    passes._warn_of_implausible_pixels(picture, 1e4)
    assert caplog.messages
    assert re.search(message, caplog.text)


@pytest.mark.slow
def test_a_black_picture_says_so(llvm, tmp_path, caplog):
    """Blender's default scene, a cube and a point light, with metal on it: no facet mirrors the lamp."""
    lamp = '<emitter type="point"><point name="position" x="9" y="0" z="0"/></emitter>'
    mirror = '<shape type="rectangle"><bsdf type="conductor"/></shape>'
    render(write_scene(tmp_path, lamp + mirror), spp=1)
    assert "the picture is black: no light reaches the camera" in caplog.text


def test_pictures_that_are_none(tmp_path):
    for message, arguments in (
        (r"wavelengths: got .*, wanted \(n,\) positive and ascending", ([500, 400], np.zeros((1, 1, 2)))),
        (
            r"radiance: got shape \(1, 1, 3\), wanted \(height, width, 2\), none of them zero",
            ([400, 500], [[[1, 2, 3]]]),
        ),
        ("attributes: got 'channels' = 'x', wanted text or a number, under a name that is not OpenEXR's", None),
    ):
        attributes = {} if arguments else {"channels": "x"}
        arguments = arguments or ([400, 500], np.zeros((1, 1, 2)))
        one_line(message, lambda arguments=arguments, attributes=attributes: SpectralImage(*arguments, attributes))
    path = tmp_path / "rgb.exr"
    SpectralImage([400.0, 410.0], np.zeros((1, 1, 2))).save(path, rgb=True)
    one_line("spectralLayoutVersion is None, wanted '1.0'", lambda: SpectralImage.load(path))


class Fails:
    """A client of Dask all of whose tasks raise."""

    def __init__(self, error):
        self.error = error

    def __enter__(self):
        return self

    def __exit__(self, *_):
        return None

    def wait_for_workers(self, *_, **__):
        if isinstance(self.error, asyncio.TimeoutError):
            raise self.error

    @property
    def scheduler(self):
        return self

    def ncores(self, *_, **__):
        return {"a": 1}

    def sync(self, call, *_, **__):
        return call()

    def run(self, call, *arguments, **__):
        return {"a": call(*arguments)}

    def cancel(self, *_, **__):
        return None

    def submit(self, *_, **__):
        return self

    def result(self):
        raise self.error


def test_workers_that_fail(monkeypatch):
    distributed = pytest.importorskip("distributed")

    async def answers(address):
        return SimpleNamespace(close=lambda: asyncio.sleep(0))

    monkeypatch.setattr(distributed.comm, "connect", answers)
    job = SimpleNamespace(samples=(1,), bands=((0, 1),))
    worker = SimpleNamespace(address="tcp://a:2")
    for error, message in (
        (distributed.KilledWorker("trace", worker, 3), "workers of tcp://a:1 die while tracing: "),
        (ModuleNotFoundError("No module named 'mitsuba'"), "a worker of tcp://a:1 lacks a package: No module named"),
        (distributed.TimeoutError(), "the Dask scheduler at tcp://a:1 has no workers"),
        (distributed.comm.CommClosedError("closed"), "the Dask scheduler at tcp://a:1 is gone"),
    ):
        monkeypatch.setattr(distributed, "Client", lambda *_, error=error, **__: Fails(error))
        one_line(message, lambda: next(cluster.trace_on("tcp://a:1")(job, None, 0)), RuntimeError)
