"""The benchmark of the shader of 2014 reports its errors and its reads of texels."""

import pytest
from rich.console import Console

from mitsuba_diffraction import gratings
from mitsuba_diffraction.evaluation.benchmark.cases import Case
from mitsuba_diffraction.evaluation.benchmark.shader_speed import shader_speeds, speed_table

BLAZE = Case("blaze", gratings.blazed(2.5, 0.25), "tile", 65.0)


@pytest.mark.slow
def test_a_corrected_shader_shows_the_colours_of_this_model(llvm):
    shaders = shader_speeds(BLAZE, count=1 << 8, repetitions=1)
    published, corrected = shaders[:2]
    assert (published.surface, published.shader) == ("blaze", "flss, as published")
    assert published.texel_reads > 20_000
    assert published.evaluate_ratio > 0
    # Without its quirks the shader differs by its 5 nm steps and the patches' 10 nm.
    assert corrected.delta_e[0] < published.delta_e[0]
    assert corrected.delta_e[0] < 1
    console = Console(width=200, record=True)
    console.print(speed_table(shaders))
    assert "flss, as published" in console.export_text()
