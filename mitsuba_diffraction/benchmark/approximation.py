"""The real-time shader on the same surfaces: what it reads, how fast it is, and how far its colours are off."""

from __future__ import annotations

from dataclasses import dataclass

import drjit as dr
import mitsuba as mi
import numpy as np
from numpy.typing import NDArray

from ..shader.base import Shader
from ..shader.evaluate import shader_for
from ..shader.quirks import Quirks
from ..shader.spectral_weights import SpectralWeights
from .accuracy import Exact, delta_e, patch_directions
from .cases import Case
from .speed import Rays, rates

_R_0 = 0.04  # skin
_SHADERS = (("flss", True), ("flss", False), ("nmm", True), ("pq", True))


@dataclass(frozen=True)
class Approximation:
    """A shader on a tile.

    Attributes:
        surface: name of the case.
        variant: "flss", "nmm" or "pq".
        as_published: with its published peculiarities, or with none.
        texel_reads: for one shading point, at most.
        evaluate_ratio: shading points per second, to eval_pdf of roughconductor (Al) in the same run.
        delta_e: (mean, largest) CIEDE2000 of the twelve patches against the exact model, after one factor of exposure.
    """

    surface: str
    variant: str
    as_published: bool
    texel_reads: int
    evaluate_ratio: float
    delta_e: tuple[float, float]


def approximations(case: Case, exact: Exact, *, count: int = 1 << 14, repetitions: int = 3) -> list[Approximation]:
    """Measure the shaders on a tile under the variant in force.

    Args:
        case: the tile.
        exact: of the same case.
        count: shading points at once.
        repetitions: of each timing, interleaved.
    """
    rays = Rays(count)
    rough = mi.load_dict({"type": "roughconductor", "material": "Al"})
    wanted = exact.xyz() * _scalar_factor()[:, None]
    shaders, work = {}, {"rough": lambda: rays.evaluate(rough)}
    for variant, published in _SHADERS:
        quirks = Quirks.as_published() if published else Quirks.corrected()
        shader = shader_for(case.height_field, variant, quirks)
        weights = shader.weights(_R_0)
        shaders[variant, published] = shader, weights
        work[variant, published] = lambda s=shader, w=weights: _shade(s, w, rays)
    speed = rates(rays, work, repetitions)
    results = []
    for (variant, published), (shader, weights) in shaders.items():
        wi, wo = (mi.Vector3f(omega.T.astype(np.float32)) for omega in patch_directions())
        xyz = np.array(shader.rgb(wi, wo, weights), np.float64).T @ _rgb_to_xyz().T
        xyz *= wanted[:, 1].sum() / xyz[:, 1].sum()
        results.append(
            Approximation(
                surface=case.name,
                variant=variant,
                as_published=published,
                texel_reads=shader.texel_reads,
                evaluate_ratio=speed[variant, published] / speed["rough"],
                delta_e=delta_e(wanted, xyz),
            )
        )
    return results


def _shade(shader: Shader, weights: SpectralWeights, rays: Rays) -> None:
    dr.eval(shader.rgb(rays.wi, rays.wo, weights))
    dr.sync_thread()


def _scalar_factor() -> NDArray[np.float64]:
    """R·K·G of the patches, (12,): Schlick's R, Stam's K, the V-cavity's G."""
    wi, wo = patch_directions()
    w = wi[:, 2] + wo[:, 2]
    d = 1 + (wi * wo).sum(axis=-1)
    k = d**2 / (wi[:, 2] * wo[:, 2] * w**2)
    g = np.minimum(1, 2 * w * np.minimum(wi[:, 2], wo[:, 2]) / d)
    return (_R_0 + (1 - _R_0) * (1 - np.sqrt(d / 2)) ** 5) * k * g


def _rgb_to_xyz() -> NDArray[np.float64]:
    import colour

    return colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ
