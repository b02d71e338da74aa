"""The commands as a person meets them: one line for a mistake, a file for a success, nothing for an interrupt."""

import contextlib
import importlib
import os
import re
import signal
import subprocess
import sys
import time
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import OpenEXR
import pytest
from PIL import Image

import mitsuba_diffraction as md
from mitsuba_diffraction.cli import _CtrlC, main
from mitsuba_diffraction.cli.arguments import scene_parameters
from mitsuba_diffraction.errors import RequestError
from mitsuba_diffraction.precomputation.recipe import Recipe
from mitsuba_diffraction.progress import log_lines
from mitsuba_diffraction.render.scene_file import SceneFile
from mitsuba_diffraction.render.spectral_image import SpectralImage

# So shallow that scalar theory holds: a warning would appear in whichever test is the first.
BLAZE = '[surface]\nprofile = "blazed"\nperiod = 2.5\ndepth = 0.2\nsamples = 64\n'
# Lobes so wide that the energy table is a small one.
QUICK = BLAZE + "[spectrum]\ncoherence_length = 20\n"
SCENE = """<scene version="3.0.0"><default name="spectrum" value="blaze.toml"/><integrator type="path"/>
<sensor type="perspective"><transform name="to_world"><lookat origin="0,0,4" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/></film></sensor>
<emitter type="constant"/><shape type="sphere"><bsdf type="diffraction_grating">
<string name="filename" value="$spectrum"/></bsdf></shape></scene>"""


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    """Each test stands in a folder of its own, with a recipe and a scan."""
    monkeypatch.chdir(tmp_path)
    Path("blaze.toml").write_text(QUICK)
    Path("deep.toml").write_text(BLAZE.replace("0.2", "5"))
    np.save("wide.npy", np.random.default_rng(1).random((20, 24)) * 0.1)
    np.save("scan.npy", np.random.default_rng(1).random((6, 8)) * 0.1)
    holed = np.load("scan.npy")
    holed[2, 3] = np.nan
    np.save("holed.npy", holed)
    np.save("pixel.npy", np.ones((1, 1)))
    np.save("counts.npy", np.arange(48, dtype=np.uint8).reshape(6, 8))
    return tmp_path


def files():
    return {path.name for path in Path().iterdir()}


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("frobnicate", "frobnicate"),
        ("precompute", "Missing argument"),
        ("precompute gone.toml", "gone.toml"),
        ("precompute gone.npy,pixel_size=0.1", "gone.npy"),
        ("precompute .", ""),
        ("precompute blaze.toml --colour red", "--colour"),
        ("precompute blaze.toml,tolerance=fine", "tolerance: got 'fine'"),
        ("precompute blaze.toml,tolerance=7", "tolerance: got 7"),
        ("precompute blaze.toml,tolerance=nan", "tolerance: got nan"),
        ("precompute blaze.toml,coherence_length=-3", "coherence_length: got -3"),
        ("precompute blaze.toml,representation=wavelets", "representation: got 'wavelets'"),
        ("precompute blaze.toml,extent=ribbon", "extent: got 'ribbon', wanted one of tile, sample"),
        ("precompute blaze.toml,largest_angle=91", "largest_angle: got 91"),
        ("precompute blaze.toml,largest_angle=steep", "largest_angle: got 'steep'"),
        ("precompute deep.toml,representation=taylor", "of a range of 4.92 µm"),
        ("precompute blaze.toml,terms=20", "terms: got 20 with representation 'auto', wanted it with a series"),
        ("precompute blaze.toml,representation=taylor,terms=20.5", "terms: got 20.5, wanted a whole number"),
        ("precompute scan.npy,pixel_size=0.05,extent=sample", "wanted at least 4 pixels of 0.05 µm"),
        ("precompute blaze.toml,pixel_size=0.1", "blaze.toml: got pixel_size, wanted some of period, depth, "),
        ("precompute blaze.toml,tolerence=0.1", "; did you mean tolerance?"),
        ("precompute blaze.toml,depth", "blaze.toml,depth: got 'depth', wanted name=value"),
        ("precompute blaze.toml --tolerance", "Option '--tolerance' requires an argument"),
        ("precompute blaze.toml --pixel-sise 1", "No such option: --pixel-sise"),
        ("precompute holed.npy,pixel_size=0.05", "1 of 48 pixels are missing"),
        ("precompute holed.npy,pixel_size=0.05", "or fill_missing, which interpolates them from their surroundings"),
        ("precompute blaze.toml -o out.png", "out.png"),
        ("precompute blaze.toml -o out", "ends in .exr"),
        ("precompute blaze.toml -o nowhere/out.exr", "nowhere/out.exr"),
        ("precompute blaze.toml blaze.toml -o out.exr", "-o: got 2 sources"),
        ("precompute blaze.toml blaze.npy", "blaze.exr would be written twice"),
        ("precompute scan.npy", "pixel_size"),
        ("precompute counts.npy", "pixel_size, height_range: both missing"),
        ("render scene.xml -D a=1 -D a=2", "-D a: got it twice"),
        ("precompute scan.npy,pixel_size=0", "pixel_size: got 0"),
        ("precompute scan.npy,pixel_size=1e6", "got 1e+06 µm, wanted at most the coherence length, 65 µm"),
        (
            "precompute scan.npy,pixel_size=30,coherence_length=20",
            "pixel_size: got 30 µm, wanted at most the coherence length, 20 µm",
        ),
        ("precompute scan.npy,pixel_size=0.05,height_range=1", "height_range"),
        ("inspect pixel.npy,pixel_size=0.05", "pixel.npy: got a surface of 1 × 1 pixel, wanted more"),
        ("efficiency scan.npy", "scan.npy: pixel_size: the file has none, wanted one number or (x, y) in µm"),
        ("efficiency gone.exr", "gone.exr"),
        ("precompute counts.npy,pixel_size=0.05", "height_range: missing"),
        ("render", "Missing argument"),
        ("render gone.xml", "gone.xml"),
        ("render scene.xml -o out.tiff", "out.tiff, wanted a file name that ends in .exr, .png or .jpg"),
        ("render scene.xml -o out.png --rgb --float", "--float, --rgb: how an .exr is stored; got out.png"),
        ("render scene.xml -o out.jpg --channels 9", "--channels: how an .exr is stored; got out.jpg"),
        ("render scene.xml -o nowhere/out.exr", "nowhere"),
        ("render scene.xml -D spectrum", "-D: got 'spectrum', wanted NAME=VALUE"),
        ("render scene.xml -D =blaze.toml", "-D: got '=blaze.toml'"),
        ("render scene.xml --until-error 5", "--until-error: got 5.0, wanted a relative error between 0 and 1"),
        ("render scene.xml --material a=scan.npy,pixel_size=1", "--material a: got scan.npy, wanted a recipe (.toml)"),
        ("render scene.xml --material a=blazed,unit=um,unit=nm", "--material a: got a list, unit, which a recipe"),
        ("render scene.xml --spp 0", "--spp"),
        ("render scene.xml --spp many", "--spp"),
        ("render scene.xml --width 0", "--width"),
        ("render scene.xml --seed -1", "--seed"),
        ("render scene.xml --variant scalar_rgb", "scalar_rgb"),
        ("render scene.xml --variant scalar_spectral", "is scalar"),
        ("render scene.xml --variant scalar_rgbx", "unknown"),
        ("render scene.xml --spp 1 -D spectrum=gone.exr", "gone.exr"),
        ("render scene.xml --spp 1 -D spectre=blaze.toml", "spectre"),
    ],
)
def test_a_mistake_is_one_line_and_exit_code_2(command, arguments, words):
    Path("scene.xml").write_text(SCENE)
    before = files()
    code, out, err = command(arguments)
    assert code == 2
    assert out == ""
    assert len(err.splitlines()) == 1, err
    assert err.startswith("mitsuba-diffraction: error: ")
    assert words in err
    assert "Traceback" not in err
    assert files() == before


@pytest.mark.parametrize(
    "text",
    [
        "[surface",
        '[surface]\nprofile = "blased"\n',
        '[surface]\nprofile = ["blazed"]\n',
        "[surface]\nscan = 3\npixel_size = 0.05\n",
        BLAZE + '[spectrum]\ntolerance = "fine"\n',
        BLAZE + "[spectrum]\nwavelengths = 500\n",
        BLAZE + 'typo = "\\u001b[31m\\n"\n',
    ],
)
def test_a_recipe_that_is_wrong_is_one_line(command, text):
    Path("wrong.toml").write_text(text)
    code, out, err = command("precompute", "wrong.toml")
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1, err
    assert "\x1b" not in err


@pytest.mark.parametrize("name", ["precompute", "inspect"])
def test_a_saved_spectrum_is_no_surface_of_these_commands(command, name):
    Path("saved.exr").touch()
    code, _, err = command(name, "saved.exr")
    assert code == 2
    assert "error: saved.exr: got a saved spectrum, wanted the recipe, the profile or the scan" in err


def test_a_spectrum_cut_short_is_one_line(command):
    Path("scene.xml").write_text(SCENE)
    command("precompute", "blaze.toml")
    content = Path("blaze.exr").read_bytes()
    Path("blaze.exr").write_bytes(content[: len(content) * 3 // 4])
    code, out, err = command("render scene.xml --spp 1 -D spectrum=blaze.exr")
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1, err
    assert "blaze.exr" in err


def test_precompute_writes_the_file_that_it_names_and_prints_its_error(command):
    Path("blaze.toml").write_text(BLAZE.replace("0.2", "0.25"))
    code, out, err = command("precompute blaze.toml,coherence_length=65")
    assert (code, err.strip()) == (0, "")
    line = r"blaze.exr: period 2.5 µm, 0.\d+ µm deep; error \d\.\de-\d\d \(tolerance 0.001\); \d\.\d kB\n"
    assert re.fullmatch(line, out)
    code, out, _ = command("precompute blaze.toml,coherence_length=65 --verbose")
    spectrum = md.GratingSpectrum.load("blaze.exr")
    assert out.startswith("blaze.exr: ")
    assert len(out.splitlines()) == 4
    for part in ("blazed grating", "2.5 × 2.5 µm", "27 × 1 orders", "kB", f"error {spectrum.error:.1e}", "0.001"):
        assert part in out
    assert "tile, " in out
    assert "coherence length 65 µm\nslices; truncated, at most: 0.0e+00 of the power at weak frequencies; " in out
    # All but the orders up to 13, the last one below 2/λ: summed here.
    kappa = np.linspace(0, spectrum.max_kappa, 2000)[:, None]
    eta = [
        np.abs(np.exp(1j * kappa * 0.25 * np.arange(64) / 64 - 2j * np.pi * m * np.arange(64) / 64).mean(axis=1)) ** 2
        for m in range(-13, 14)
    ]
    reported = float(out.split("frequencies; ")[1].split()[0])
    assert reported == pytest.approx(1 - np.sum(eta, axis=0).min(), rel=0.05)
    assert f"{spectrum.unresolved_power:.1e} at frequencies that no direction reaches" in out


@pytest.mark.slow
def test_precompute_takes_a_sample_by_options(command):
    code, out, err = command(
        "precompute wide.npy,pixel_size=0.09,extent=sample,largest_angle=60,tolerance=0.02,"
        "representation=slices -o out.exr --verbose"
    )
    assert code == 0
    messages = err.splitlines()
    assert len(messages) == 1
    assert messages[0].startswith(
        "mitsuba-diffraction: warning: coherence_length: a scan of 2.16 × 1.8 µm supports 0.9 µm"
    )
    spectrum = md.GratingSpectrum.load("out.exr")
    assert (spectrum.extent, spectrum.largest_angle, spectrum.tolerance) == ("sample", 60.0, 0.02)
    assert spectrum.representation == "slices"
    rows, columns = spectrum.grid.shape
    for part in (f"sample, {columns} × {rows} frequencies", "cycles/µm apart", "coherence length 0.9 µm", "truncated"):
        assert part in out
    assert f"{spectrum.truncated_power:.1e} of the power" in out
    assert f"{spectrum.unresolved_power:.1e} at frequencies that" in out


def test_a_smaller_angle_takes_fewer_orders(command):
    code, out, _ = command("precompute blaze.toml,largest_angle=29 --verbose")
    assert code == 0
    assert "13 × 1 orders" in out
    assert md.GratingSpectrum.load("blaze.exr").largest_angle == 29.0


def test_options_override_the_recipe(command):
    Path("blaze.toml").write_text(BLAZE + "[spectrum]\ntolerance = 0.1\ncoherence_length = 30\n")
    code, _, _ = command("precompute blaze.toml,tolerance=0.02,coherence_length=20 -o out.exr")
    assert code == 0
    spectrum = md.GratingSpectrum.load("out.exr")
    assert (spectrum.tolerance, spectrum.coherence_length) == (0.02, 20.0)


def test_precompute_takes_a_series_by_options(command):
    code, out, _ = command("precompute blaze.toml,representation=taylor,terms=6,heights_from=lowest -o out.exr")
    assert code == 0
    assert "! taylor: 6 terms of heights from the lowest" in out
    settings = md.GratingSpectrum.load("out.exr").settings
    assert (settings.representation, settings.terms, settings.heights_from) == ("taylor", 6, "lowest")
    assert "taylor" in out


def test_scans_are_read_with_their_scale(command):
    code, _, _ = command("precompute counts.npy,extent=tile,pixel_size=0.05,height_range=0.5 -o out.exr")
    assert code == 0
    spectrum = md.GratingSpectrum.load("out.exr")
    assert spectrum.height_range == pytest.approx(47 / 255 * 0.5)
    assert spectrum.pixel_size == (0.05, 0.05)
    assert spectrum.source == "counts.npy"


def test_missing_pixels_of_a_scan_are_filled_on_request(command):
    code, out, _ = command("precompute holed.npy,extent=tile,pixel_size=0.05,fill_missing=true -o out.exr --verbose")
    assert code == 0
    assert "\nholed.npy (1 missing pixel filled)\n" in out
    spectrum = md.GratingSpectrum.load("out.exr")
    assert spectrum.source == "holed.npy (1 missing pixel filled)"
    assert spectrum.source_digest == md.HeightField(np.load("holed.npy"), 0.05, fill_missing=True).digest


@pytest.mark.slow
def test_a_bare_scan_with_a_seam_is_a_sample(command):
    x = np.arange(48) * 0.05
    np.save("whole.npy", 0.1 * np.sin(2 * np.pi * x / 0.8) + np.zeros((8, 1)))
    np.save("broken.npy", 0.1 * np.sin(2 * np.pi * x / 0.9) + np.zeros((8, 1)))
    code, out, err = command("precompute broken.npy,pixel_size=0.05,tolerance=0.01")
    assert (code, "sample of an irregular surface" in out) == (0, True)
    assert re.search(r"r.m.s. steps at the seam 64.3 nm along x \(\d\d.\d inside\) and 0 nm along y", err)
    for words in ("extent=sample", "extent=tile", "crop_periods"):
        assert words in err
    code, _, err = command("precompute broken.npy,pixel_size=0.05,tolerance=0.01,extent=tile --overwrite")
    assert (code, "seam" in err) == (0, False)
    code, out, err = command("precompute whole.npy,pixel_size=0.05,tolerance=0.01")
    assert (code, "tile of 2.4" in out) == (0, True)
    assert "whole.npy: taken as extent=tile: its edges meet, r.m.s. steps at the seam" in err


def test_the_version_is_printed(command):
    code, out, err = command("--version")
    assert (code, err) == (0, "")
    assert re.fullmatch(r"mitsuba-diffraction [\d.]+\S*, Mitsuba 3\.\S+\n", out)


def test_help_shows_the_defaults(command):
    for words in (("precompute", "default: ./NAME.exr"), ("render", "or 64")):
        code, out, _ = command(words[0], "--help")
        assert code == 0
        assert words[1] in " ".join(re.sub(r"[│|]", " ", out).split())


def test_progress_without_a_terminal_is_printed_in_lines(capfd):
    show = log_lines("scene.xml", first=0)
    show(3, 7)
    assert re.fullmatch(r"mitsuba-diffraction: scene.xml: 3 of 7, 0 s\n", capfd.readouterr().err)
    log_lines("scene.xml")(3, 7)  # short work prints nothing
    assert capfd.readouterr().err == ""


def test_spectra_of_many_sources_are_named_after_them(command):
    Path("other.toml").write_text(QUICK)
    code, out, _ = command("precompute", "blaze.toml", "other.toml")
    assert code == 0
    assert [line.split(":")[0] for line in out.splitlines() if ".exr: " in line] == ["blaze.exr", "other.exr"]
    assert {"blaze.exr", "other.exr"} <= files()


@pytest.mark.few(2)
@pytest.mark.parametrize("name", ["a[red]b.exr", "a[b]c.exr", "a:smile:.exr", "é ü.exr"])
def test_the_printed_name_is_that_of_the_file(command, name):
    # Regression: square brackets and words between colons were taken for markup.
    code, out, _ = command("precompute", "blaze.toml", "-o", name)
    assert code == 0
    assert name in files()
    assert out.startswith(f"{name}: ")
    code, _, err = command("precompute", name.replace(".exr", ".toml"))
    assert code == 2
    assert name.replace(".exr", ".toml") in err


def test_a_folder_whose_name_looks_like_markup_is_accepted(command):
    Path("dir[").mkdir()
    code, out, _ = command("precompute", "blaze.toml", "-o", "dir[/x].exr")
    assert code == 0
    assert out.startswith("dir[/x].exr: ")


def test_a_warning_is_a_line_and_not_a_failure(command):
    code, out, err = command("precompute scan.npy,extent=tile,pixel_size=0.2 -o out.exr")
    assert code == 0
    assert "out.exr" in out
    messages = [line for line in err.splitlines() if line]
    assert len(messages) == 2  # one for each axis
    assert all(line.startswith("mitsuba-diffraction: warning: pixels of 200 nm along ") for line in messages)


@pytest.mark.parametrize("place", ["precompute", "save"])
def test_an_interrupt_leaves_no_file(command, monkeypatch, place):
    def interrupted(*arguments, **named):
        raise KeyboardInterrupt

    if place == "precompute":
        monkeypatch.setattr("mitsuba_diffraction.precomputation.recipe.build_spectrum", interrupted)
    else:
        monkeypatch.setattr(OpenEXR.File, "write", interrupted, raising=True)
    before = files()
    code, out, err = command("precompute", "blaze.toml")
    assert (code, out) == (130, "")
    assert err.strip() == "mitsuba-diffraction: interrupted: nothing was written"
    assert files() == before


@pytest.mark.parametrize("error", [MemoryError(), OSError("disk full"), RuntimeError("no luck")])
def test_a_failure_is_one_line_and_exit_code_1(command, monkeypatch, error):
    def fail(*arguments, **named):
        raise error

    monkeypatch.setattr("mitsuba_diffraction.precomputation.recipe.build_spectrum", fail)
    code, out, err = command("precompute", "blaze.toml")
    assert (code, out) == (1, "")
    assert err.strip() == f"mitsuba-diffraction: error: {str(error) or 'MemoryError'}"


BROADCAST = "operands could not be broadcast together with shapes (2,) (3,) "
BUG = "mitsuba-diffraction: error: this is a bug in mitsuba_diffraction ("


def broadcast(*arguments, **named):
    """A mistake as code makes it, with NumPy's own exception, a ValueError."""
    return np.zeros(2) + np.zeros(3)


def test_a_bug_is_reported_as_such(command, monkeypatch):
    monkeypatch.setattr("mitsuba_diffraction.precomputation.recipe.build_spectrum", broadcast)
    code, out, err = command("precompute", "blaze.toml")
    assert (code, out) == (1, "")
    assert err == f"{BUG}ValueError: {BROADCAST}); mitsuba-diffraction --debug … shows where\n"
    code, out, err = command("--debug precompute blaze.toml")
    assert (code, out) == (1, "")
    assert err.startswith("Traceback")
    assert "in broadcast" in err
    assert BUG in err


def test_a_bug_inside_a_plugin_is_not_blamed_on_the_scene(command, monkeypatch):
    Path("scene.xml").write_text(SCENE)
    monkeypatch.setattr("mitsuba_diffraction.bsdf.parameters.boundary_from", broadcast)
    code, _, err = command("render scene.xml --spp 1 -o out.exr")
    assert code == 1
    assert len(err.splitlines()) == 1, err
    assert err.startswith(f"{BUG}ValueError: ")
    assert BROADCAST.strip() in err
    code, _, err = command("--debug render scene.xml --spp 1 -o out.exr")
    assert code == 1
    assert "in broadcast" in err


def test_a_bug_while_rendering_is_reported_as_such(command, monkeypatch):
    Path("scene.xml").write_text(SCENE)
    monkeypatch.setattr("mitsuba_diffraction.render.trace_pass.needs_mitsubas_film", broadcast)
    code, out, err = command("render scene.xml --spp 1 -o out.exr")
    assert (code, out) == (1, "")
    assert err.startswith(f"{BUG}ValueError: ")


@pytest.mark.parametrize(
    ("raised", "code", "words"),
    [
        (RuntimeError, 1, "error: the order is zero"),
        (RequestError, 2, "error: the order is zero"),
        (ZeroDivisionError, 1, "this is a bug in mitsuba_diffraction (ZeroDivisionError: the order is zero)"),
    ],
)
def test_an_error_in_a_loop_of_drjit_shows_its_cause(command, monkeypatch, llvm, raised, code, words):
    def compare(*arguments, **named):
        def body(count):
            raise raised("the order is zero")

        dr.while_loop((dr.arange(mi.UInt32, 4),), lambda count: count < 3, body)

    monkeypatch.setattr("mitsuba_diffraction.shader_2014.comparison.compare", compare)
    Path("scene.xml").write_text(SCENE)
    found, out, err = command("compare scene.xml --variant llvm_ad_spectral")
    assert (found, out, len(err.splitlines())) == (code, "", 1)
    assert words in err


def test_debug_shows_where_a_request_is_refused(command):
    code, _, err = command("--debug precompute blaze.toml,tolerance=7")
    assert code == 2
    assert err.startswith("Traceback")
    assert err.splitlines()[-1].startswith("mitsuba-diffraction: error: tolerance: got 7")


def test_help_exits_with_zero(command):
    for line in ("", "--help"):
        code, out, err = command(line)
        assert (code, err) == (0, "")
        assert "mitsuba-diffraction examples && mitsuba-diffraction render" in out
        assert "precompute" in out


def test_shells_complete_commands(command, monkeypatch):
    monkeypatch.setenv("_MITSUBA_DIFFRACTION_COMPLETE", "complete_bash")
    monkeypatch.setenv("COMP_WORDS", "mitsuba-diffraction prec")
    monkeypatch.setenv("COMP_CWORD", "1")
    code, out, _ = command("")
    assert (code, out.split()) == (0, ["precompute"])


@pytest.mark.parametrize("count", [0, -4])
def test_a_scene_without_samples_is_refused(command, count):
    sampler = '<sampler type="independent"><integer name="sample_count" value="$spp"/></sampler><film'
    Path("scene.xml").write_text(SCENE.replace("<film", sampler))
    code, out, err = command(f"render scene.xml -D spp={count}")
    assert (code, out) == (2, "")
    assert err == (
        f"mitsuba-diffraction: error: scene.xml: sample_count: got {count}, wanted a positive number of samples\n"
    )


def test_render_takes_the_samples_of_the_scene_and_writes_half_precision(command):
    line = "render sampled.xml -o out.exr --width 8 --variant llvm_ad_spectral -D spectrum=blaze.toml"
    sampler = '<sampler type="independent"><integer name="sample_count" value="3"/></sampler></sensor>'
    Path("sampled.xml").write_text(SCENE.replace("</sensor>", sampler))
    code, out, err = command(line)
    assert code == 0, err
    half, size = SpectralImage.load("out.exr").radiance, Path("out.exr").stat().st_size
    assert f" s, {size / 1e3:.0f} kB\n" in out
    for name in ("out.exr", "out.png"):
        Path(name).unlink()
    code, _, err = command(f"{line} --float")
    assert code == 0, err
    assert Path("out.exr").stat().st_size > 1.4 * size
    whole = SpectralImage.load("out.exr")
    assert whole.attributes["spp"] == 3
    np.testing.assert_allclose(half, whole.radiance, rtol=2.0**-11, atol=3e-8)
    assert (half != whole.radiance).any()
    code, _, err = command(f"{line} --channels 50 --overwrite")
    assert code == 0, err
    assert SpectralImage.load("out.exr").wavelengths.size == 46
    code, _, err = command(f"{line} --rgb")
    assert code == 0, err
    assert set(OpenEXR.File("out.exr", separate_channels=True).channels()) == {"R", "G", "B"}
    code, _, err = command(f"{line} --rgb --channels 50")
    assert code == 2
    assert "--rgb writes no wavelengths" in err


def test_render_writes_a_spectral_picture_and_a_preview(command):
    if not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("Dr.Jit finds no LLVM")
    Path("scene.xml").write_text(SCENE)
    code, out, err = command(
        "render scene.xml -o out.exr --spp 2 --width 8 --variant llvm_ad_spectral -D spectrum=blaze.toml"
    )
    assert (code, err.strip()) == (0, "")
    channels = OpenEXR.File("out.exr", separate_channels=True).channels()
    assert channels["R"].pixels.shape == (8, 8)
    assert any(name.startswith("S0.") and name.endswith("nm") for name in channels)
    assert np.isfinite(channels["G"].pixels).all()
    assert channels["G"].pixels[4, 4] > 0
    assert out.startswith("out.exr: 8 × 8 pixels")
    assert "out.png" in files()


def test_a_picture_alone_is_the_preview_of_the_spectral_one(command):
    Path("scene.xml").write_text(SCENE)
    line = "render scene.xml --spp 2 --width 8 --variant llvm_ad_spectral -D spectrum=blaze.toml --exposure 1"
    before = files()
    for name in ("out.exr", "a.png", "b.jpg"):
        for _ in range(2):  # the second time over its own file
            code, out, err = command(f"{line} -o {name}")
            assert (code, err.strip()) == (0, "")
    assert re.fullmatch(r"b\.jpg: 8 × 8 pixels, 8 bits, 2 samples per pixel, .*exposed by \+1\.00 stops .*\n", out)
    assert files() - before == {"out.exr", "out.png", "a.png", "b.jpg"}
    preview, png, jpeg = (np.array(Image.open(name)).astype(int) for name in ("out.png", "a.png", "b.jpg"))
    np.testing.assert_array_equal(png, preview)
    assert np.abs(jpeg - preview).max() < 20


def test_a_picture_with_alpha_is_no_jpeg(command):
    Path("scene.xml").write_text(
        SCENE.replace("</film>", '<string name="pixel_format" value="rgba"/></film>').replace("$spectrum", "blaze.toml")
    )
    line = "render scene.xml --spp 2 --width 8 --variant llvm_ad_spectral"
    before = files()
    code, out, err = command(f"{line} -o a.JPG")
    assert (code, out, files()) == (2, "", before)
    assert err.strip().endswith("-o: got a.JPG, but the scene has alpha, which JPEG has not; wanted .exr or .png")
    assert command(f"{line} -o a.png")[0] == 0
    with Image.open("a.png") as picture:
        assert picture.mode == "RGBA"


def test_the_first_message_comes_before_the_scene_is_loaded(monkeypatch, capfd):
    """A log was silent for as long as loading and compiling took."""

    def interrupted(*arguments, **named):
        raise KeyboardInterrupt

    Path("scene.xml").write_text(SCENE)
    monkeypatch.setattr(SceneFile, "load", interrupted)
    monkeypatch.setattr(sys, "argv", ["mitsuba-diffraction", "render", "scene.xml"])
    with pytest.raises(SystemExit):
        main()
    said = capfd.readouterr().err.splitlines()
    assert said[0] == "mitsuba-diffraction: scene.xml: loading and compiling"
    assert said[1:] == ["mitsuba-diffraction: interrupted: nothing was written"]


def test_the_installed_command_ends_with_its_exit_code(folder):
    program = Path(sys.executable).with_name("mitsuba-diffraction")
    start = (
        [str(program)] if program.is_file() else [sys.executable, "-c", "import mitsuba_diffraction.cli as c; c.main()"]
    )
    done = subprocess.run([*start, "precompute", "gone.toml"], cwd=folder, capture_output=True, text=True, timeout=60)
    assert done.returncode == 2
    assert done.stdout == ""
    assert done.stderr == "mitsuba-diffraction: error: gone.toml: no such file\n"


def test_precompute_refuses_an_unwritable_target_before_the_work(command, monkeypatch):
    monkeypatch.setattr(
        "mitsuba_diffraction.precomputation.recipe.build_spectrum", lambda *_, **__: pytest.fail("it went to work")
    )
    code, _, err = command("precompute blaze.toml -o nowhere/out.exr")
    assert (code, err.count("got nowhere/out.exr, but the folder nowhere is not there")) == (2, 1)


@pytest.mark.parametrize(
    ("value", "is_file"), [("blazed", False), ("0.25", False), ("./blazed", True), ("a.exr", True)]
)
def test_a_value_of_a_parameter_is_a_file_only_if_it_looks_like_one(folder, value, is_file):
    for name in ("blazed", "0.25", "a.exr"):
        Path(name).touch()
    wanted = str((folder / value).resolve()) if is_file else value
    assert scene_parameters([f"p={value}"]) == {"p": wanted}


def test_benchmark_plots_png_only(command):
    code, out, err = command("benchmark --plot speed.pdf")
    assert (code, out) == (2, "")
    assert "--plot: got speed.pdf, wanted a file name that ends in .png" in err


@pytest.mark.slow
def test_benchmark_refuses_a_tolerance_before_it_measures(command):
    code, out, err = command("benchmark --tolerance -1")
    assert (code, out) == (2, "")
    assert "tolerance: got -1.0, wanted a fraction" in err


def test_an_interrupt_inside_a_plugin_is_not_blamed_on_the_scene(command):
    """Mitsuba makes a RuntimeError of whatever a constructor raises."""

    mi.set_variant("llvm_ad_spectral")

    class Pressing(mi.BSDF):
        def __init__(self, props):
            mi.BSDF.__init__(self, props)
            try:
                signal.raise_signal(signal.SIGINT)
            except KeyboardInterrupt:
                raise ValueError("no such grating") from None

    mi.register_bsdf("pressing", Pressing)
    Path("scene.xml").write_text(SCENE.replace("diffraction_grating", "pressing"))
    before = signal.getsignal(signal.SIGINT)
    code, out, err = command("render scene.xml --spp 1")
    assert (code, out) == (130, "")
    assert err.strip() == "mitsuba-diffraction: interrupted: nothing was written"
    assert signal.getsignal(signal.SIGINT) is before


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupt_swallowed_by_the_loader_ends_the_rendering(command, monkeypatch, number):
    """As C++ code and the garbage collector may do while the scene is loaded."""

    load = SceneFile.load

    def ignoring(*args, **kwargs):
        with contextlib.suppress(KeyboardInterrupt):
            signal.raise_signal(number)
        return load(*args, **kwargs)

    monkeypatch.setattr(SceneFile, "load", ignoring)
    Path("scene.xml").write_text(SCENE)
    code, _, err = command("render scene.xml --spp 1")
    assert code == 130
    assert err.strip() == "mitsuba-diffraction: interrupted: nothing was written"
    assert not Path("scene.exr").exists()


def test_sigterm_interrupts_precompute(command, monkeypatch):
    def end(*arguments):
        signal.raise_signal(signal.SIGTERM)

    monkeypatch.setattr(Recipe, "build", end)
    code, out, err = command("precompute blazed -o blazed.exr")
    assert (code, out, err) == (130, "", "mitsuba-diffraction: interrupted: nothing was written\n")


@pytest.mark.parametrize("name", ["SIGINT", "SIGTERM"])
def test_an_interrupt_during_an_import_waits_for_its_end(monkeypatch, name):
    # Regression: while Mitsuba was imported, which creates enumerations in Python, Ctrl-C aborted the process.
    press, number = f"signal.raise_signal(signal.{name})", getattr(signal, name)
    Path("interrupted.py").write_text(f"import signal, time\n{press}; time.sleep(0.03); {press}\ncomplete = True\n")
    monkeypatch.syspath_prepend(".")

    def work():
        importlib.import_module("interrupted")
        for _ in range(1000):
            time.sleep(0.01)

    before = signal.signal(number, _CtrlC())
    try:
        with pytest.raises(KeyboardInterrupt):
            work()
        time.sleep(0.2)  # once, although it was pressed twice
    finally:
        signal.signal(number, before)
    assert sys.modules.pop("interrupted").complete


@pytest.mark.slow
@pytest.mark.posix("SIGINT to one process")
@pytest.mark.parametrize("seconds", [0.5, 1.0, 2.0, 3.0, 4.0, 6.0])
def test_an_interrupt_at_any_time_is_one_line(seconds):
    Path("scene.xml").write_text(SCENE)
    start = "import signal as s; s.signal(s.SIGINT, s.default_int_handler)"
    run = f"{start}; from mitsuba_diffraction.__main__ import main; main()"
    arguments = ["render", "scene.xml", "--spp", "100000000"]
    environment = {**os.environ, "PYTHONPATH": str(Path(md.__file__).parents[1])}
    running = subprocess.Popen(
        [sys.executable, "-c", run, *arguments], stdout=-1, stderr=-1, text=True, env=environment
    )
    time.sleep(seconds)
    running.send_signal(signal.SIGINT)
    out, err = running.communicate()
    assert running.returncode == 130
    # Mitsuba's log goes there, of a grating too fine for scalar theory.
    assert all("scalar theory" in line for line in out.replace("\x1b[0m", "").splitlines() if line)
    # Beside lines of progress, and of the time that is expected.
    progress = " spp, ", "loading and compiling", "100000000 samples per pixel: about "
    (message,) = [line for line in err.splitlines() if not any(part in line for part in progress)]
    assert message.startswith("mitsuba-diffraction: interrupted: ")
