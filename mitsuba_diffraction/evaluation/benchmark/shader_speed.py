"""The real-time shader on the same surfaces: memory reads, speed, and error of its colours."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from rich.table import Table

from ...bsdf.testing import vectors
from ...optics.color import SRGB_TO_XYZ
from ...optics.geometry import k_g
from ...progress import cells, table
from ...settings import VISIBLE
from ...shader_2014.evaluate import shader_for
from ...shader_2014.quirks import Quirks
from ...shader_2014.shader import Shader
from ...shader_2014.tristimulus import PUBLISHED_R0
from .accuracy import Exact, patch_difference, patch_directions
from .cases import Case
from .speed import Rays, seconds

_SHADERS = (("flss", "as published"), ("flss", "corrected"), ("nmm", "as published"), ("pq", "as published"))

_COLUMNS = {
    "surface": "{.surface}",
    "shader": "{.shader}",
    "texel reads": "{.texel_reads}",
    "speed\nratio": "{.evaluate_ratio:.1e}",
    "ΔE00\nmean": "{0.delta_e[0]:.2f}",
    "ΔE00\nmax": "{0.delta_e[1]:.1f}",
}


@dataclass(frozen=True)
class ShaderSpeed:
    """A shader on a tile.

    Attributes:
        surface: name of the case.
        shader: variant, "as published" with all quirks or "corrected" with none.
        texel_reads: maximum number for one shading point.
        evaluate_ratio: shading points per second, to eval_pdf of roughconductor (Al) in the same run.
        delta_e: (mean, maximum) CIEDE2000 of the twelve patches against the exact model, after one factor of exposure.
    """

    surface: str
    shader: str
    texel_reads: int
    evaluate_ratio: float
    delta_e: tuple[float, float]


def shader_speeds(case: Case, *, count: int = 1 << 14, repetitions: int = 3) -> list[ShaderSpeed]:
    """Measure the shaders on a tile under the current variant.

    Args:
        case: the tile.
        count: shading points at once.
        repetitions: of each timing, interleaved.
    """
    exact, rays = Exact(case, VISIBLE), Rays(count)
    rough = mi.load_dict({"type": "roughconductor", "material": "Al"})
    shaders = shaders_of(case)
    work = {"rough": lambda: rays.evaluate(rough)}
    work |= {name: shading(rays, shader) for name, shader in shaders.items()}
    taken = seconds(work, repetitions)
    return [
        ShaderSpeed(
            surface=case.name,
            shader=name,
            texel_reads=shader.texel_reads,
            evaluate_ratio=taken["rough"] / taken[name],
            delta_e=shader_difference(shader, exact),
        )
        for name, shader in shaders.items()
    ]


def speed_table(shaders: Sequence[ShaderSpeed]) -> Table:
    """Return a table of the shaders, for a terminal."""
    return table(_COLUMNS, (cells(_COLUMNS, row) for row in shaders), texts=2)


def shaders_of(case: Case) -> dict[str, Shader]:
    """Return shaders of a tile by name."""
    manners = {"as published": Quirks.as_published(), "corrected": Quirks.corrected()}
    return {
        f"{variant}, {manner}": shader_for(case.height_field, variant, manners[manner]) for variant, manner in _SHADERS
    }


def shading(rays: Rays, shader: Shader) -> Callable[[], None]:
    """Return a function that evaluates a shader for all rays."""
    weights = shader.weights()
    return lambda: dr.eval(shader.rgb(rays.si.wi, rays.wo, weights))


def shader_difference(shader: Shader, exact: Exact) -> tuple[float, float]:
    """Return mean and maximum CIEDE2000 of the patches against the exact model, after one factor of exposure."""
    wi, wo = patch_directions()
    cos_half = np.sqrt((1 + (wi * wo).sum(axis=-1)) / 2)
    factor = k_g(wi[:, 2], wo[:, 2], ((wi + wo)[:, :2] ** 2).sum(axis=-1))
    wanted = exact.xyz * ((PUBLISHED_R0 + (1 - PUBLISHED_R0) * (1 - cos_half) ** 5) * factor)[:, None]
    rgb = np.array(shader.rgb(vectors(wi), vectors(wo), shader.weights()), np.float64).T
    xyz = rgb @ SRGB_TO_XYZ.T
    return patch_difference(wanted, xyz * (wanted[:, 1].sum() / xyz[:, 1].sum()))
