"""The error of a picture against the number of terms of its spectrum."""

import json
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from test_comparison import GRATING, SUN, write

import mitsuba_diffraction  # noqa: F401 (settles which LLVM is used before a variant is set)
from mitsuba_diffraction.evaluation.convergence.by_terms import study
from mitsuba_diffraction.render import render
from mitsuba_diffraction.render.scene_file import SceneFile

REQUESTED = "".join(f'<string name="{name}" value="${name}"/>' for name in ("representation", "terms", "heights_from"))
ORIGINS = ("mean", "lowest")
WITH_TERMS = GRATING.format(profile="blazed", period=2.0, coherence=3.0, base=REQUESTED)


@pytest.mark.slow
def test_more_terms_and_heights_from_the_mean_have_a_smaller_error(llvm, tmp_path):
    scene = write(tmp_path / "scene.xml", SUN, WITH_TERMS)
    slices, *series = study(scene, terms=(2, 6), samples=64, width=16).rows
    assert (slices.name, slices.terms, slices.error, slices.delta_e) == ("slices", None, 0, 0)
    assert [(row.heights_from, row.terms) for row in series] == [(o, n) for o in ("mean", "lowest") for n in (2, 6)]
    (coarse, fine), (_, fine_of_lowest) = ([row.error for row in series if row.heights_from == o] for o in ORIGINS)
    assert coarse > 9 * fine
    assert fine < 0.3 * fine_of_lowest
    assert all(row.spectrum_error > 1e-3 for row in series if row.terms == 2)
    # 2N words of an order for each of four wavelengths, where slices read one to four.
    assert [row.words / (4 * row.terms) for row in series] == [series[0].words / 8] * 4
    assert slices.words < series[0].words * 2


@pytest.mark.slow
def test_the_error_of_the_picture_falls_to_that_of_slices(llvm, tmp_path):
    scene = write(tmp_path / "scene.xml", SUN, WITH_TERMS)
    found = study(scene, terms=(2, 4, 6, 20), samples=64, width=16)
    slices, *series = found.rows
    assert (slices.name, slices.terms, slices.error, slices.delta_e) == ("slices", None, 0, 0)
    assert [(row.heights_from, row.terms) for row in series] == [(o, n) for o in ORIGINS for n in (2, 4, 6, 20)]
    mean, lowest = ([row.error for row in series if row.heights_from == origin] for origin in ORIGINS)
    assert mean[0] > 3 * mean[1] > 9 * mean[2]
    assert mean[2] < 0.3 * lowest[2]
    assert max(mean[-1], lowest[-1]) < 2e-3
    assert all(row.spectrum_error > 1e-3 for row in series if row.terms == 2)
    # 2N words of an order for each of four wavelengths, where slices read one to four.
    assert [row.words / (4 * row.terms) for row in series[:4]] == [series[0].words / 8] * 4
    assert slices.words < series[0].words * 2

    # The same from the pictures of `render`, whose random numbers are others; it is told to accept the error.
    scene.write_text(scene.read_text().replace(REQUESTED, REQUESTED + '<float name="tolerance" value="$tolerance"/>'))
    files = (
        SceneFile(
            scene, {"heights_from": "mean", "representation": kind, "terms": n, "tolerance": error}, size=(16, None)
        )
        for kind, n, error in (("slices", "auto", "0.01"), ("taylor", "2", "10"))
    )
    wanted, other = (render(file, spp=512).radiance.astype(float)[found.shown] for file in files)
    assert np.abs(other - wanted).sum() / wanted.sum() == pytest.approx(mean[0], rel=0.2)


@pytest.mark.slow
def test_the_command_prints_a_row_for_each_number_of_terms(command, llvm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(Path("scene.xml"), SUN, WITH_TERMS)
    line = "convergence scene.xml --terms 2,3 --width 8 --spp 1 -o plot.png --json numbers.json -D heights_from=mean"
    code, out, err = command(f"{line} -D representation=chebyshev --variant llvm_ad_spectral")
    assert (code, err) == (0, "")
    rows = json.loads(Path("numbers.json").read_text())["rows"]
    assert [row["name"] for row in rows] == ["slices", "chebyshev, 2 terms", "chebyshev, 3 terms"]
    assert all(row["name"] in out for row in rows)
    with Image.open("plot.png") as picture:
        assert np.ptp(np.asarray(picture.convert("L"))) > 100


@pytest.mark.parametrize(
    ("arguments", "words"),
    [
        ("--terms 0", "terms: got 0, wanted a whole number from 1 to 999"),
        ("--terms 4,2.5", "terms: got 2.5, wanted a whole number"),
        ("--terms nan", "terms: got nan, wanted a whole number"),
        ("--terms x", "--terms: got 'x', wanted a number"),
        ("--terms 4 --tolerance 0.1", "--terms: got --tolerance"),
        ("--terms 4 -D representation=slices", "terms: got 4 with representation 'slices', wanted it with a series"),
        ("--terms 4 -D heights_from=top", "heights_from: got 'top', wanted one of mean, lowest"),
        ("--terms 4 -D gone=1", "unused parameters: - $gone"),
    ],
)
def test_a_mistake_is_one_line(arguments, words, command, llvm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(Path("scene.xml"), SUN, WITH_TERMS)
    code, out, err = command(f"convergence scene.xml -o plot.png --width 8 --variant llvm_ad_spectral {arguments}")
    assert (code, out) == (2, "")
    assert len(err.splitlines()) == 1, err
    assert words in err
    assert [path.name for path in tmp_path.iterdir()] == ["scene.xml"]


def test_a_scene_without_the_parameters_is_refused(command, llvm, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    write(Path("scene.xml"))
    code, _, err = command("convergence scene.xml --terms 4 -o plot.png --width 8 --variant llvm_ad_spectral")
    assert code == 2
    assert "unused parameters: - $representation" in err
