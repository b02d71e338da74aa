"""The maps that the author of the thesis of 2014 published, against those of this project."""

from dataclasses import replace

import numpy as np
import published_maps
import pytest
from PIL import Image
from published_maps import (
    COLUMNS,
    CORRECTED,
    FILES,
    METHODS,
    PUBLISHED,
    PUBLISHED_MAPS,
    agreement,
    correlation_against_height,
    encoded,
    grid,
    linear_rgb,
    row,
    save_published,
    shader_rgb,
)
from viewing_angle import MODEL

from mitsuba_diffraction.surface.heightfield import HeightField

BLAZE, ELAPHE = PUBLISHED_MAPS["blaze"], PUBLISHED_MAPS["elaphe"]


def halved(height_field):
    """The means of 2 × 2 pixels, with which the shader's textures are four times as fast."""
    rows, columns = (side // 2 for side in height_field.shape)
    means = height_field.heights.reshape(rows, 2, columns, 2).mean(axis=(1, 3))
    return HeightField(means, tuple(2 * size for size in height_field.pixel_size))


@pytest.mark.slow
def test_the_emulated_shader_gives_the_published_map_of_the_blaze(llvm):
    pixels = grid(BLAZE, 8)
    linear = linear_rgb(BLAZE, PUBLISHED, pixels.wo)
    found = agreement(pixels, linear)
    assert found.correlation >= 0.98
    # The mirror image blazes to the other side.
    mirrored = linear_rgb(BLAZE, PUBLISHED, pixels.wo * (-1, 1, 1))
    assert agreement(pixels, mirrored).correlation < 0.9


@pytest.mark.slow
def test_the_emulated_shader_gives_the_published_map_of_elaphe_from_half_the_pixels(llvm):
    pixels = grid(ELAPHE, 20)
    heights = halved(ELAPHE.recipe.height_field())
    as_published, doubled = (agreement(pixels, found) for found in shader_rgb(heights, PUBLISHED, pixels.wo, [1, 2]))
    assert as_published.correlation >= 0.99
    assert doubled.correlation < 0.95
    # The author's program has a brightness of 1000 unless its slider is moved.
    assert as_published.brightness == pytest.approx(1000, rel=0.3)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "lowest"), [("blaze", 0.98), ("elaphe", 0.98), ("xenopeltis", 0.92)])
def test_the_emulated_shader_gives_the_published_maps_pixel_by_pixel(llvm, name, lowest):
    published = PUBLISHED_MAPS[name]
    pixels = grid(published)
    assert pixels.wo.shape[0] > 440_000
    linear = linear_rgb(published, PUBLISHED, pixels.wo)
    # The pictures are encoded as sRGB; with the power of the shader's code, dark colours differ.
    assert agreement(pixels, linear).correlation >= 0.98
    assert agreement(pixels, linear, "gamma 2.5").correlation >= lowest


@pytest.mark.slow
@pytest.mark.parametrize("name", ["elaphe", "xenopeltis"])
def test_model_and_corrected_shader_are_alike_and_less_like_the_published_map(llvm, name):
    found = row(name, 16)
    correlations = {method: agreement(found.pixels, linear).correlation for method, linear in found.maps.items()}
    assert correlations[MODEL] == pytest.approx(correlations[CORRECTED], abs=0.01)
    assert correlations[MODEL] < correlations[PUBLISHED]


@pytest.mark.slow
@pytest.mark.parametrize(("name", "height"), [("elaphe", 0.4347), ("xenopeltis", 0.8187)])
def test_the_published_maps_have_the_heights_of_the_best_correlation(llvm, name, height):
    heights = height * np.array([0.7, 0.85, 1, 1.15])
    found = correlation_against_height(PUBLISHED_MAPS[name], heights)
    assert heights[found.argmax()] == height
    assert found.max() > 0.99


def test_agreement_recovers_the_brightness():
    pixels = grid(ELAPHE, 16)
    linear = 3 * pixels.colours**2.2 / 300
    exact = replace(pixels, colours=encoded(linear, 300.0))
    found = agreement(exact, linear)
    assert found.correlation == pytest.approx(1)
    assert found.brightness == pytest.approx(300, rel=0.05)


def test_covered_parts_of_a_picture_are_not_compared():
    pixels = grid(BLAZE)
    enlarged = (pixels.rows > 452) & (pixels.rows < 748) & (pixels.columns > 482) & (pixels.columns < 777)
    assert pixels.colours[enlarged].max() == 1
    assert not pixels.compared[enlarged].any()
    frame = (pixels.colours == (1, 0, 0)).all(axis=1) & (np.abs(pixels.rows - 399.5) > 20)
    assert frame.sum() > 500
    assert not pixels.compared[frame].any()
    radius = np.hypot(*pixels.wo[:, :2].T)
    assert radius[pixels.compared].min() > 0.1


def test_a_picture_of_a_grid_is_the_published_one():
    pixels = grid(ELAPHE, 2)
    shown = pixels.picture(pixels.colours)
    with Image.open(ELAPHE.path()) as file:
        published = np.asarray(file.convert("RGB"))[1::2, 1::2] / 255
    inside = (shown != 1).any(axis=2)
    np.testing.assert_array_equal(shown[inside], published[inside])
    assert inside.mean() == pytest.approx(np.pi / 4 * 0.95**2, abs=0.02)


@pytest.mark.slow
def test_figures_and_table_are_written(llvm, tmp_path, monkeypatch):
    monkeypatch.setattr(published_maps, "row", lambda name, step: row("blaze", 8, METHODS[:1]))
    monkeypatch.setattr(published_maps, "correlation_against_height", lambda published, heights: 0.5 + 0 * heights)
    steps = []
    table = save_published(tmp_path, step=16, progress=lambda *step: steps.append(step))
    assert [len(line) for line in table] == [len(COLUMNS)] * 3
    assert float(table[0][2]) >= 0.98
    assert steps[-1] == (5, 5)
    assert sorted(path.name for path in tmp_path.iterdir()) == sorted(FILES)
    assert f"| {table[0][2]} |" in (tmp_path / "published_maps.md").read_text()
