"""Figures 3.1 and 4.1 of the draft of the thesis of 2014: interpolated transforms, and transforms of powers of heights.

python tools/thesis/fourier_figures.py FOLDER
"""

from __future__ import annotations

import argparse
import os
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import ArrayLike, NDArray
from published_surfaces import SURFACES
from scipy.special import diric, gammaln

from mitsuba_diffraction.evaluation.plots import figure, save_png
from mitsuba_diffraction.shader_2014.flss import FLSS
from mitsuba_diffraction.shader_2014.taylor_textures import MAX_TEXTURE_KAPPA, taylor_transforms
from mitsuba_diffraction.surface.heightfield import HeightField

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure

Array = NDArray[np.float64]

FILES = ("interpolation.png", "fourier_images.png")
_SURFACES = ("blaze", "elaphe_scan")
_POWERS = (1, 2, 8)
_WAVELENGTH = 0.55  # µm, of the transforms at normal incidence
_MAX_FREQUENCY = 3.0  # cycles/µm


def interpolated(
    texels: ArrayLike, orders: ArrayLike, x: ArrayLike, radius: int | None = None
) -> NDArray[np.complex128]:
    """Return Σ_m D((x − m)/N; N)/N texels[m]: exact if summed over all N orders of a tile of N pixels.

    D(t/N; N)/N = sin(πt)/(N sin(πt/N)), the kernel of PQ.

    Args:
        texels: (N,) of the orders.
        orders: (N,) m.
        x: (k,) positions.
        radius: sum over as many texels on each side of the nearest one; default: over all.
    """
    texels, orders, x = np.asarray(texels), np.asarray(orders), np.asarray(x, np.float64)[:, None]
    weights = diric(2 * np.pi * (x - orders) / texels.size, texels.size)
    if radius is not None:
        weights = np.where(np.abs(np.rint(x) - orders) <= radius, weights, 0)
    return weights @ texels


def tile_transform(heights: ArrayLike, kappa: float, x: ArrayLike) -> NDArray[np.complex128]:
    """Return A(x) = Σ_n e^{iκh_n} e^{−2πi x u_n/N}/N by direct sums, where u_n = n − (N − 1)/2.

    Args:
        heights: (N,) µm, one row of a tile.
        kappa: κ, rad/µm.
        x: (k,) positions q T in texels; orders are the integers.
    """
    heights = np.asarray(heights, np.float64)
    u = np.arange(heights.size) - (heights.size - 1) / 2
    return np.exp(-2j * np.pi * np.outer(x, u) / heights.size) @ np.exp(1j * kappa * heights) / heights.size


def _rms(error: NDArray, reference: NDArray) -> float:
    return float(np.sqrt(np.mean(np.abs(error) ** 2) / np.mean(np.abs(reference) ** 2)))


def _draw(panel: Axes, x: Array, exact: Array, interpolations: Mapping[str, tuple[Array, float]]) -> None:
    panel.plot(x, exact, color="0.75", linewidth=4)
    for (name, (values, error)), style in zip(interpolations.items(), ("C0-", "C3--", "C2:"), strict=False):
        panel.plot(x, values, style, linewidth=1.2, label=f"{name}: error {error:.2g}")
    low, high = panel.get_ylim()
    panel.set_ylim(low, high + 0.35 * (high - low))  # place for the legend
    panel.legend(fontsize=9, loc="upper left")


def plot_interpolation(surfaces: Sequence[str] = _SURFACES) -> Figure:
    """Plot figure 3.1: a sampled signal, and transforms of tiles between their orders, interpolated in several ways.

    Errors are r.m.s., relative to the r.m.s. of the interpolated quantity.
    """
    drawn = figure(12, 4.2)
    panels = drawn.subplots(1, 3)
    rng = np.random.default_rng(0)
    frequency, phase, amplitude = rng.uniform(0, 0.45, 40), rng.uniform(0, 2 * np.pi, 40), rng.normal(size=40)

    def signal(t: Array) -> Array:
        return np.cos(2 * np.pi * np.outer(t, frequency) + phase) @ amplitude

    t, samples = np.linspace(42, 58, 801), np.arange(100.0)
    values = {
        "sinc": np.sinc(t[:, None] - samples) @ signal(samples),
        "linear": np.interp(t, samples, signal(samples)),
    }
    _draw(
        panels[0], t, signal(t), {name: (found, _rms(found - signal(t), signal(t))) for name, found in values.items()}
    )
    shown = samples[42:59]
    panels[0].plot(shown, signal(shown), "k.", markersize=5)
    panels[0].set_title("A random signal of 100 samples", fontsize=11)
    panels[0].set_xlabel("t / samples")
    for panel, name, (low, high) in zip(panels[1:], surfaces, ((-3.5, 3.5), (52.5, 66.5)), strict=True):
        surface = SURFACES[name]
        field = surface.height_field
        heights, kappa = field.heights[0], 4 * np.pi / _WAVELENGTH
        count = heights.size
        orders, x = np.arange(-(count // 2), count - count // 2), np.linspace(low, high, 701)
        texels, exact = tile_transform(heights, kappa, orders), tile_transform(heights, kappa, x)
        found = {
            "sinc, 3 texels": interpolated(texels, orders, x, radius=1),
            "linear": np.interp(x, orders, texels),
            "sinc, all texels": interpolated(texels, orders, x),
        }
        _draw(
            panel, x, np.abs(exact), {key: (np.abs(value), _rms(value - exact, exact)) for key, value in found.items()}
        )
        inside = (orders > low) & (orders < high)
        panel.plot(orders[inside], np.abs(texels[inside]), "k.", markersize=5)
        panel.set_title(f"{surface.name}: |A| of one row of a tile", fontsize=11)
        panel.set_xlabel("order m = q T")
    drawn.suptitle(
        "Grey: exact; dots: samples. Transforms at normal incidence, "
        f"{1e3 * _WAVELENGTH:.0f} nm. Errors are r.m.s., of amplitudes",
        fontsize=10,
    )
    return drawn


def extrema(texels: NDArray[np.complex64], height: float) -> dict[str, Array]:
    """Return the extrema of F{hⁿ} in µmⁿ, as algorithm 4.1 stores them: (N,) each.

    Args:
        texels: of `taylor_transforms`, (n_y, n_x, N), of h/H.
        height: H in µm.
    """
    flat, scale = texels.reshape(-1, texels.shape[-1]), float(height) ** np.arange(texels.shape[-1])
    # h is real, so that Im F has a minimum of the same size.
    found = {"max Re": flat.real.max(axis=0), "−min Re": -flat.real.min(axis=0), "max Im": flat.imag.max(axis=0)}
    return {name: values.astype(np.float64) * scale for name, values in found.items()}


def _square(field: HeightField) -> HeightField:
    """Return a tile that is a picture: a profile of one row becomes as long along y."""
    if field.shape[0] > 1:
        return field
    pixel = field.pixel_size[0]
    return HeightField(np.repeat(field.heights, field.shape[1], axis=0), (pixel, pixel))


def plot_fourier_images(surfaces: Sequence[str] = _SURFACES, terms: int = FLSS.published_terms) -> Figure:
    """Plot figure 4.1: heights, |F{hⁿ}| of some powers n, and the extrema of all of them."""
    from matplotlib.colors import LogNorm

    drawn = figure(14, 5.8)
    axes = drawn.subplots(len(surfaces), len(_POWERS) + 2, width_ratios=(*(1,) * (len(_POWERS) + 1), 1.5))
    for row, name in zip(axes, surfaces, strict=True):
        surface = SURFACES[name]
        field = _square(surface.height_field)
        texels, height = taylor_transforms(field, terms, origin_at_centre=False, margin=0)
        width, depth = field.tile_size
        row[0].imshow(field.heights, cmap="gray", origin="lower", extent=(0, width, 0, depth))
        row[0].set_title(f"{surface.name}: h", fontsize=10)
        row[0].set_xlabel("x / µm")
        edges = [(-(n // 2) - 0.5, n - n // 2 - 0.5) for n in texels.shape[1::-1]]
        extent = [edge / size for pair, size in zip(edges, (width, depth), strict=True) for edge in pair]
        for panel, power in zip(row[1:-1], _POWERS, strict=True):
            magnitude = np.abs(texels[..., power])
            norm = LogNorm(1e-4, 1, clip=True)
            image = panel.imshow(magnitude / magnitude.max(), norm=norm, origin="lower", extent=extent, cmap="magma")
            panel.set(xlim=(-_MAX_FREQUENCY, _MAX_FREQUENCY), ylim=(-_MAX_FREQUENCY, _MAX_FREQUENCY))
            highest = f"{magnitude.max() * height**power:.2g} µm$^{power}$"
            panel.set_title(f"|F{{h$^{power}$}}|, max. {highest}", fontsize=9)
            panel.set_xlabel("q$_x$ · µm")
        row[1].set_ylabel("q$_y$ · µm")
        n = np.arange(1, terms)
        # At the shortest wavelength and normal incidence.
        factor = np.exp(n * np.log(MAX_TEXTURE_KAPPA) - gammaln(n + 1))
        largest = 0.0
        for (label, values), colour in zip(extrema(texels, height).items(), ("C0", "C1", "C2"), strict=True):
            positive = np.where(values > 0, values, np.nan)[1:]
            row[-1].semilogy(n, positive, color=colour, label=f"{label}, µmⁿ")
            row[-1].semilogy(n, positive * factor, "--", color=colour)
            largest = max(largest, np.nanmax(positive * factor))
        row[-1].plot([], [], "k--", label="the same times κⁿ/n!")
        row[-1].set_title(f"extrema of F{{hⁿ}}; dashed: up to {float(f'{largest:.2g}'):g}", fontsize=10)
        row[-1].set_xlabel("power n")
        row[-1].grid(alpha=0.3)
    axes[0, -1].legend(fontsize=8, loc="lower left")
    drawn.colorbar(image, ax=axes[:, -2], label="relative to the maximum", extend="min")
    return drawn


def save_fourier(
    folder: str | os.PathLike[str], surfaces: Sequence[str] = _SURFACES, terms: int = FLSS.published_terms
) -> None:
    """Write `FILES` into a folder, which exists."""
    for name, drawn in zip(FILES, (plot_interpolation(surfaces), plot_fourier_images(surfaces, terms)), strict=True):
        save_png(drawn, Path(folder) / name)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("folder", type=Path, help="of the figures; created if missing")
    folder = parser.parse_args().folder
    folder.mkdir(parents=True, exist_ok=True)
    save_fourier(folder)


if __name__ == "__main__":
    main()
