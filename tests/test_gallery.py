"""The gallery's check sees changes and lets noise pass."""

import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

ROOT = Path(__file__).parents[1]
sys.path.insert(0, str(ROOT / "scenes"))

import gallery  # noqa: E402

PAGES = [ROOT / "docs" / "gallery.md"]


def scene(seed, factor=1.0, spoilt=None):
    """A noisy picture: a gradient, gamma-distributed paths, and a few that are a thousand times too bright."""
    rng = np.random.default_rng(seed)
    picture = np.linspace(0.2, 2, 160)[None, :, None] * np.array([1.0, 0.8, 0.6]) * np.ones((90, 1, 1))
    picture = picture * rng.gamma(2, 0.5, (90, 160, 1))
    picture[rng.random((90, 160)) < 1e-3] += 1000
    if spoilt is not None:
        picture[spoilt] *= 2
    return factor * picture


@pytest.fixture(scope="module")
def reference():
    return gallery.Reference.of([scene(seed) for seed in range(100, 100 + gallery.SEEDS)])


def test_pictures_that_differ_by_noise_pass(reference):
    assert min(reference.probability(scene(seed)) for seed in range(40)) > gallery.SIGNIFICANCE


@pytest.mark.parametrize(
    "change", [{"factor": 1.1}, {"factor": 0.9}, {"spoilt": np.s_[30:60, 75:105]}, {"spoilt": np.s_[..., 2]}]
)
def test_pictures_that_differ_by_more_than_noise_fail(reference, change):
    assert max(reference.probability(scene(seed, **change)) for seed in range(20)) < gallery.SIGNIFICANCE


def test_references_are_kept(reference, tmp_path):
    path = tmp_path / "references.npz"
    gallery.save({"a": reference, "b": reference}, path)
    found = gallery.load(path)
    assert sorted(found) == ["a", "b"]
    assert found["b"].count == gallery.SEEDS
    assert found["b"].probability(scene(3)) == pytest.approx(reference.probability(scene(3)), rel=0.01)


def test_commands_come_from_the_pages(tmp_path):
    page = tmp_path / "page.md"
    line = "mitsuba-diffraction render scenes/x.xml -D light=sun --spp 256 -o docs/gallery/x_sun.exr"
    page.write_text(f"First `python scenes/disc.py`.\n\n    {line}\n\n| `{line}` | 12 s |\n", encoding="utf-8")
    models, renderings = gallery.commands([page])
    assert [words[1] for words in models] == ["scenes/disc.py"]
    assert list(renderings) == ["x_sun"]
    words = gallery.small(renderings["x_sun"], 5, tmp_path / "y.exr")
    assert words[:4] == ["render", str(ROOT / "scenes" / "x.xml"), "-D", "light=sun"]
    assert words.count("--spp") == words.count("-o") == 1
    assert "256" not in words
    page.write_text(f"    {line}\n    {line.replace('sun ', 'lamp ')}\n", encoding="utf-8")
    with pytest.raises(ValueError, match="x_sun"):
        gallery.commands([page])


def test_every_picture_has_a_reference():
    models, renderings = gallery.commands(PAGES)
    assert len(renderings) == 21
    assert {words[1] for words in models} == {
        f"scenes/{name}.py" for name in ("snake", "disc", "foil", "hologram", "ground")
    }
    assert set(gallery.load(gallery.REFERENCES)) == set(renderings)
    for words in renderings.values():
        assert (ROOT / words[1]).is_file()


def test_pictures_are_small_enough():
    pictures = sorted((ROOT / "docs" / "gallery").glob("*.png"))
    assert {path.stem for path in pictures} == set(gallery.commands(PAGES)[1])
    for path in pictures:
        assert path.stat().st_size < 500_000, path.name


@pytest.mark.slow
def test_pictures_are_compressed(tmp_path):
    path = tmp_path / "noise.png"
    rng = np.random.default_rng(0)
    smooth = np.linspace(60, 200, 900)[:, None, None] + np.zeros((900, 800, 3))
    Image.fromarray((smooth + rng.normal(0, 8, smooth.shape)).astype(np.uint8)).save(path)
    assert path.stat().st_size > 1e6
    assert gallery.compress(path) >= 32
    assert path.stat().st_size < gallery.MAX_FILE_SIZE
    with Image.open(path) as picture:
        assert np.abs(np.asarray(picture.convert("RGB"), float) - smooth).mean() < 15
    assert gallery.compress(path) == 0


@pytest.mark.slow
def test_gallery_is_unchanged(capsys):
    assert gallery.main([]) == 0, capsys.readouterr().out
