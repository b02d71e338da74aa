"""The comparison of pictures of a scene with those by Mitsuba, and whether it can fail."""

import functools

import numpy as np
import pytest

from mitsuba_diffraction.evaluation.validation import scene_pictures
from mitsuba_diffraction.evaluation.validation.scene_pictures import MAX_DEVIATION, PICTURES, PictureDifference

SCENE = """<scene version="3.0.0">
    <default name="sun" value="1"/>
    <integrator type="path"><integer name="max_depth" value="3"/></integrator>
    <sensor type="perspective"><float name="fov" value="60"/>
        <transform name="to_world"><lookat origin="0,-3.5,2.5" target="0,.5,.5" up="0,0,1"/></transform>
        <film type="hdrfilm"><integer name="width" value="32"/><integer name="height" value="24"/></film>
        <sampler type="multijitter"/>
    </sensor>
    <shape type="rectangle"><transform name="to_world"><scale value="4"/></transform>
        <bsdf type="diffuse"><rgb name="reflectance" value=".5"/></bsdf></shape>
    <shape type="sphere"><point name="center" x="0" y="0" z=".8"/><float name="radius" value=".8"/>
        <bsdf type="diffraction_grating"><string name="profile" value="blazed"/>
            <float name="coherence_length" value="1.5"/><string name="material" value="none"/></bsdf></shape>
    <shape type="sphere"><point name="center" x="0" y="-3" z="6"/><float name="radius" value="1.5"/>
        <emitter type="area"><spectrum name="radiance" value="$sun"/></emitter></shape>
</scene>"""


def pictures(seed, mean=1.0, shape=(PICTURES, 10, 12, 3)):
    return mean * (1 + 0.2 * np.random.default_rng(seed).standard_normal(shape))


def test_noise_is_no_difference():
    found = [PictureDifference.of(pictures(2 * seed), pictures(2 * seed + 1)) for seed in range(50)]
    deviations = np.concatenate([each.deviations.ravel() for each in found])
    # The larger of two estimates of an error is a little too large.
    assert 0.8 < deviations.std() < 1.0
    assert all(each.is_noise for each in found)
    assert max(abs(each.ratio - 1) / each.error for each in found) < 5


def test_a_block_that_differs_is_found():
    brighter = pictures(0)
    brighter[:, 3:6, 9:, 1] *= 1.5
    found = PictureDifference.of(brighter, pictures(1))
    assert (found.is_noise, found.position) == (False, (1, 3, 1))
    assert found.relative[found.position] == pytest.approx(0.5, abs=0.1)
    assert str(found).startswith("a difference beyond noise: +")


def test_correlated_pixels_are_not_taken_for_independent():
    """Each picture has a brightness of its own."""
    of_picture = [1 + 0.2 * np.random.default_rng(seed).standard_normal((PICTURES, 1, 1, 1)) for seed in range(40)]
    found = [
        PictureDifference.of(pictures(0, a), pictures(1, b))
        for a, b in zip(of_picture[::2], of_picture[1::2], strict=True)
    ]
    assert max(abs(each.deviation) for each in found) < MAX_DEVIATION


def test_black_pictures_are_equal_and_not_a_number_differs():
    black = np.zeros((PICTURES, 4, 4, 3))
    assert PictureDifference.of(black, black).is_noise
    assert not PictureDifference.of(black + 1, black).is_noise
    assert not PictureDifference.of(np.where(np.arange(3) == 1, np.nan, 1.0) + black, black + 1).is_noise


def test_a_picture_of_a_single_pixel_is_compared():
    assert PictureDifference.of(pictures(0, shape=(8, 1, 1, 3)), pictures(1, shape=(8, 1, 1, 3))).deviations.shape == (
        1,
        1,
        3,
    )


@pytest.mark.slow
def test_the_command_finds_light_that_is_missing(command, tmp_path, monkeypatch):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    briefly = functools.partial(scene_pictures.compare_scene, seconds=4.0)
    monkeypatch.setattr(scene_pictures, "compare_scene", briefly)
    code, out, _ = command("validate", str(path), "-D", "sun=2", "--json", str(tmp_path / "a.json"))
    assert (code, "no difference beyond noise: at most" in out) == (0, True)
    # As if the floor were black.
    monkeypatch.setattr("mitsuba_diffraction.integrator.diffraction_path.is_black", lambda *arguments: True)
    code, out, error = command("validate", str(path))
    assert (code, "a difference beyond noise: -" in out) == (1, True)
    assert "1 of 1 checks missed" in error


@pytest.mark.slow
def test_what_cannot_be_compared_is_refused(command, tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE.replace('"path"', '"direct"').replace('<integer name="max_depth" value="3"/>', ""))
    code, _, error = command("validate", "blazed", "-D", "sun=2")
    assert (code, "-D: got blazed, wanted a scene (.xml)" in error) == (2, True)
    code, _, error = command("validate", str(tmp_path / "nothing.xml"))
    assert (code, "no such file" in error) == (2, True)
    code, _, error = command("validate", str(path))
    assert (code, "got an integrator other than path" in error) == (2, True)
