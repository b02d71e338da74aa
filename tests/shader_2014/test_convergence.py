"""The error of pictures against the time that they took."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_comparison import GRATING, SUN, write

import mitsuba_diffraction  # noqa: F401 (settles which LLVM is used before a variant is set)
from mitsuba_diffraction.evaluation.convergence.by_tolerance import (
    Convergence,
    Point,
    convergence,
    save_convergence_plot,
)

WITH_TOLERANCE = GRATING.format(profile="blazed", period=2.0, coherence=3.0, base="").replace(
    "</bsdf>", '<float name="tolerance" value="$tolerance"/></bsdf>'
)


def point(name, seconds, error):
    return Point(name, name.startswith("tolerance"), 1, seconds, error, error**2)


def test_the_path_tracer_overtakes_at_the_interpolated_time():
    found = Convergence(
        "scene.xml",
        (8, 8),
        0.0,
        (
            *(point("tolerance 0.1", *pair) for pair in ((0.1, 8.0), (0.4, 4.0), (1.6, 3.0))),
            *(point("tolerance 0.01", *pair) for pair in ((1.0, 8.0), (4.0, 4.0), (16.0, 2.0))),
            *(point("flss, corrected", *pair) for pair in ((9.0, 7.0), (99.0, 3.5))),
            point("nmm, as published", 1.0, 9.0),
            point("pq, as published", 1.0, 2.5),
            point("pq, corrected", 1.0, 1.0),
        ),
    )
    # Between 0.4 s and 1.6 s, where the error falls from 4 to 3; straight in logarithms.
    fraction = np.log(4 / 3.5) / np.log(4 / 3)
    for error in ("delta_e", "relative_mse"):
        assert found.overtaken("flss, corrected", error) == pytest.approx(0.4 * 4**fraction)
        assert found.overtaken("nmm, as published", error) == pytest.approx(0.1)  # from the first picture on
        assert found.overtaken("pq, as published", error) == pytest.approx(4 * 4 ** (np.log(4 / 2.5) / np.log(2)))
        assert np.isnan(found.overtaken("pq, corrected", error))


def test_any_number_of_tolerances_is_plotted(tmp_path):
    points = [point(f"tolerance {0.1 * 2**-k:g}", 1.0 + seconds, 9.0 - k) for k in range(6) for seconds in range(2)]
    save_convergence_plot(Convergence("scene.xml", (8, 8), 0.0, tuple(points)), tmp_path / "plot.png")
    with Image.open(tmp_path / "plot.png") as picture:
        assert picture.width > 1000


@pytest.mark.slow
def test_noise_falls_with_time_and_a_coarse_table_stops(llvm, tmp_path):
    scene = write(tmp_path / "scene.xml", SUN, WITH_TOLERANCE)
    found = convergence(
        scene,
        tolerances=(0.3, 1e-3),
        samples=(64, 4096),
        reference_samples=16384,
        shaders=("nmm",),
        shading_points=(64,),
    )
    curves = found.curves()
    assert [point.samples for point in curves["tolerance 0.001"]] == [64, 4096]
    fine, coarse = ([point.relative_mse for point in curves[f"tolerance {each}"]] for each in (0.001, 0.3))
    # The mean square of noise is inverse to the number of samples, but for that of the reference.
    assert fine[0] > 16 * fine[1]
    assert coarse[1] > 4 * fine[1]
    published, corrected = (curves[f"nmm, {each}"][0].delta_e for each in ("as published", "corrected"))
    assert published > corrected > curves["tolerance 0.001"][1].delta_e


@pytest.mark.slow
def test_the_command_writes_a_plot_and_numbers(command, llvm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(Path("scene.xml"), SUN, WITH_TOLERANCE)
    line = "convergence scene.xml -o plot.png --json numbers.json --width 16 --spp 1 --spp 2 --reference-spp 4"
    code, out, err = command(f"{line} --tolerance 0.1 --variant llvm_ad_spectral")
    assert (code, err) == (0, "")
    assert "pq, corrected: " in out
    assert "overtaken" in out
    points = json.loads(Path("numbers.json").read_text())["points"]
    assert [point["name"] for point in points[:3]] == ["tolerance 0.1", "tolerance 0.1", "flss, as published"]
    with Image.open("plot.png") as picture:
        assert picture.width > 1000
        assert np.ptp(np.asarray(picture.convert("L"))) > 100


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("", "unused parameters: - $tolerance"),
        ("--tolerance -1", "tolerance: got -1, wanted at least 3e-05: the reference uses a third of the lowest"),
        ("--tolerance 0.1 --tolerance 2e-5", "tolerance: got 2e-05, wanted at least 3e-05"),
        ("--tolerance 0.1,2e-5", "tolerance: got 2e-05, wanted at least 3e-05"),
        ("--tolerance fine", "--tolerance: got 'fine', wanted a number"),
        ("-o plot.pdf", "-o: got plot.pdf, wanted a file name that ends in .png"),
        ("--spp 0", "--spp"),
        ("--width 8 --width 9", "--width: got it twice, wanted one value"),
        ("-o scene.xml", "--output: got it twice"),
    ],
)
def test_a_mistake_is_one_line(arguments, words, command, llvm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(Path("scene.xml"))
    output = "" if "-o plot" in arguments else "-o plot.png"
    code, out, err = command(f"convergence scene.xml {output} --variant llvm_ad_spectral {arguments}")
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1, err
    assert words in err
    assert [path.name for path in tmp_path.iterdir()] == ["scene.xml"]
