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
    assert len(renderings) == 23
    assert {words[1] for words in models} == {
        f"scenes/{name}.py" for name in ("snake", "disc", "foil", "hologram", "anodised", "beetle", "street", "ground")
    }
    assert set(gallery.load(gallery.REFERENCES)) == set(renderings)
    for words in renderings.values():
        assert (ROOT / words[1]).is_file()


def test_pictures_are_small_enough():
    pictures = [path for path in (ROOT / "docs" / "gallery").iterdir() if path.suffix in (".jpg", ".png")]
    assert sorted(path.stem for path in pictures) == sorted(gallery.commands(PAGES)[1])
    for path in pictures:
        assert path.stat().st_size < 500_000, path.name
        assert f"(gallery/{path.name})" in PAGES[0].read_text(), path.name


def test_pictures_are_compressed_in_true_colour(tmp_path):
    path = tmp_path / "noise.png"
    rng = np.random.default_rng(0)
    smooth = np.linspace(60, 200, 900)[:, None, None] * np.array([1, 0.8, 0.6]) + np.zeros((900, 700, 3))
    Image.fromarray((smooth + rng.normal(0, 8, smooth.shape)).astype(np.uint8)).save(path)
    assert path.stat().st_size > 1e6
    target, quality = gallery.compress(path)
    assert (target, quality >= 85) == (tmp_path / "noise.jpg", True)
    assert target.stat().st_size < gallery.MAX_FILE_SIZE
    assert not path.exists()
    with Image.open(target) as picture:
        assert picture.mode == "RGB"
        assert np.abs(np.asarray(picture, float) - smooth).mean() < 8


@pytest.mark.slow
def test_a_palette_and_too_much_noise_are_refused(tmp_path):
    path = tmp_path / "noise.png"
    noise = Image.fromarray(np.random.default_rng(0).integers(0, 256, (900, 900, 3), np.uint8))
    for picture, message in ((noise.quantize(64), "noise.png: got mode P, wanted true colour"), (noise, "less noise")):
        picture.save(path)
        with pytest.raises(ValueError, match=message):
            gallery.compress(path)
        assert path.exists()


@pytest.mark.slow
def test_gallery_is_unchanged(capsys):
    assert gallery.main([]) == 0, capsys.readouterr().out
