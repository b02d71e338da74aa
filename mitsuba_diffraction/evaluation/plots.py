"""Pictures of the evaluation's arrays (matplotlib)."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

import numpy as np

from ..color import daylight, into_gamut, on_screen, spectrum_to_linear_sRGB
from .brdf_map import BRDFMap
from .slits import Slits, analytic_intensity, tiled_intensity
from .surfaces import Surface
from .viewing_angle import MODEL, PeriodFit, ReflectanceMap, fit_period, grating_equation, peak_angles, wavelengths

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.cm import ScalarMappable
    from matplotlib.figure import Figure
    from PIL.PngImagePlugin import PngInfo

TITLES = {MODEL: "this model", "flss": "FLSS", "nmm": "NMM", "pq": "PQ", "gem": "GEM"}
_PEAK, _EQUATION = "#d62728", "#1f77b4"
_DARKEST = 1e-3  # of the strongest reflectance outside of the specular peak


def figure(width: float, height: float) -> Figure:
    """An empty figure, inches, that belongs to no window."""
    from matplotlib.figure import Figure

    return Figure(figsize=(width, height), layout="constrained")


def png(drawn: Figure, dpi: float = 110, pnginfo: PngInfo | None = None) -> bytes:
    """A figure as a PNG of 256 colours and their mixtures, half the size of one of all colours."""
    from PIL import Image

    whole, reduced = io.BytesIO(), io.BytesIO()
    drawn.savefig(whole, format="png", dpi=dpi)
    with Image.open(whole) as picture:
        picture = picture.convert("RGB")
        palette = picture.quantize(256, kmeans=2)
        # Pillow mixes colours only for a palette that it is given.
        mixed = picture.quantize(palette=palette, dither=Image.Dither.FLOYDSTEINBERG)
        mixed.save(reduced, format="png", optimize=True, pnginfo=pnginfo)
    return reduced.getvalue()


def plot_reflectance(maps: Sequence[ReflectanceMap]) -> Figure:
    """Reflectance over wavelength and viewing angle, with the peak curve and the grating equation over it.

    One panel for each map; all maps are of one surface and one θ_i. Each panel has the logarithmic scale of its own
    strongest reflectance outside of the specular peak, three decades deep.
    """
    drawn = figure(3.1 * len(maps) + 0.9, 4.4)
    axes = drawn.subplots(1, len(maps), sharex=True, sharey=True, squeeze=False)[0]
    for panel, found in zip(axes, maps, strict=True):
        image = _draw_map(panel, found)
        fit = fit_period(found)
        variance = f"{fit.variance:.2g}" if fit.variance >= 1e-3 else "< 0.001"
        panel.set_title(f"{TITLES[found.method]}\nperiod {fit.mean:.1f} nm, variance {variance} nm²", fontsize=10)
        panel.set_xlabel("wavelength λ / nm")
    surface, incidence = maps[0].surface, maps[0].incidence
    axes[0].set_ylabel("viewing angle θ$_r$ / °")
    bar = drawn.colorbar(image, ax=axes, pad=0.01)
    bar.set_label("reflectance / strongest\noutside of the mirror direction")
    drawn.suptitle(f"{surface.name}: light at θ$_i$ = {incidence:g}°, mirror direction at θ$_r$ = {-incidence:g}°")
    handles, labels = axes[0].get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    return drawn


def _draw_map(panel: Axes, found: ReflectanceMap) -> ScalarMappable:
    from matplotlib.collections import LineCollection
    from matplotlib.colors import LogNorm

    strongest = np.nanmax(np.where(found.order > 0.5, found.reflectance, 0))
    shown = np.clip(found.reflectance / strongest, _DARKEST, 1)
    style = {"cmap": "viridis", "norm": LogNorm(_DARKEST, 1), "rasterized": True}
    if found.discrete:
        # A line for each order; between them there is nothing.
        panel.set_facecolor("0.85")
        places = np.stack([np.broadcast_to(found.wavelengths[:, None], shown.shape), found.angles], axis=-1)
        steps = np.stack([places[:-1], places[1:]], axis=2).reshape(-1, 2, 2)
        image = panel.add_collection(LineCollection(steps, array=shown[:-1].ravel(), linewidths=0.9, **style))
    else:
        image = panel.pcolormesh(found.wavelengths, found.angles, shown.T, shading="nearest", **style)
    panel.plot(found.wavelengths, peak_angles(found), color=_PEAK, linewidth=2.5, label="peak")
    period = found.surface.period
    equation = grating_equation(period, found.incidence, found.wavelengths)
    panel.plot(
        found.wavelengths, equation, color="black", linewidth=1, linestyle=(0, (4, 4)),
        label=f"grating equation, d = {1e3 * period:g} nm",
    )  # fmt: skip
    panel.set_xlim(found.wavelengths[[0, -1]])
    panel.set_ylim(-90, 90)
    panel.set_yticks(range(-90, 91, 30))
    return image


def plot_brdf_maps(maps: Sequence[Sequence[BRDFMap]]) -> Figure:
    """BRDF maps, a row for each projection and a column for each method; all of one surface and one light.

    The ticks beside the diffracting axis are where the grating equation puts 450, 550 and 650 nm of the orders.
    """
    drawn = figure(2.5 * len(maps[0]) + 0.3, 2.75 * len(maps) + 0.5)
    axes = drawn.subplots(len(maps), len(maps[0]), squeeze=False)
    for row, panels in zip(maps, axes, strict=True):
        for column, (found, panel) in enumerate(zip(row, panels, strict=True)):
            _draw_brdf(panel, found, labelled=column == 0)
    first = maps[0][0]
    theta, phi = first.incidence
    coherence = first.surface.coherence_length
    drawn.suptitle(
        f"{first.surface.name}: light from θ$_i$ = {theta:g}°, φ$_i$ = {phi:g}°, coherent over {coherence:g} µm"
    )
    return drawn


def _draw_brdf(panel: Axes, found: BRDFMap, labelled: bool) -> None:
    half = [(axis[1] - axis[0]) / 2 for axis in (found.x, found.y)]
    extent = (found.x[0] - half[0], found.x[-1] + half[0], found.y[0] - half[1], found.y[-1] + half[1])
    alpha = ~np.isnan(found.rgb[..., 0])
    picture = np.concatenate([found.picture, alpha[..., None]], axis=-1)
    panel.imshow(picture, origin="lower", extent=extent, interpolation="nearest")
    panel.set_title(f"{TITLES[found.method]}, exposure {float(f'{found.exposure:.2g}'):g}", fontsize=9)
    _mark_orders(panel, found)
    panel.tick_params(labelsize=7)
    if found.projection == "hemisphere":
        panel.set_xticks((-90, -45, 0, 45, 90))
        panel.set_yticks((-90, -45, 0, 45, 90))
    if labelled:
        names = {"hemisphere": ("θ$_o$ cos φ$_o$ / °", "θ$_o$ sin φ$_o$ / °"), "uv": ("u", "v")}[found.projection]
        panel.set_xlabel(names[0], fontsize=9)
        panel.set_ylabel(names[1], fontsize=9)
    panel.set_frame_on(False)


def _mark_orders(panel: Axes, found: BRDFMap) -> None:
    """Ticks beside the places of the orders, so that they hide no light."""
    across = 1 - found.surface.axis
    size = found.x[-1] - found.x[0]
    for order in (-2, -1, 1, 2):
        for nanometres, tint in ((450.0, "#6677ff"), (550.0, "#33cc33"), (650.0, "#ff4433")):
            place = np.array(found.places_of_orders(np.float64(nanometres), np.int64(order)))
            ends = np.stack([place, place])
            ends[:, across] += np.array([0.08, 0.12]) * size
            panel.plot(*ends.T, color=tint, linewidth=1)
            if nanometres == 550 and np.isfinite(place).all():
                place[across] += 0.15 * size
                panel.text(*place, f"{order}", color="0.7", size=7, ha="center", va="center")


def plot_slits(counts: Sequence[int] = (1, 2, 3, 7), wavelength: float = 500.0) -> Figure:
    """Intensity on a screen behind N slits: the formula, and this project's sum over tiles (figure 5.5)."""
    drawn = figure(7, 1.5 * len(counts) + 0.8)
    axes = drawn.subplots(len(counts), 1, sharex=True, sharey=True)
    place = np.linspace(-10e3, 10e3, 2001)
    for panel, count in zip(axes, counts, strict=True):
        slits = Slits(count)
        sine = slits.sine(place)
        formula, tiled = (f(slits, sine, wavelength) for f in (analytic_intensity, tiled_intensity))
        panel.plot(place * 1e-3, formula, color=_EQUATION, linewidth=2, label="sinc²(bs/λ) · sin²(Nδ/2)/N²sin²(δ/2)")
        panel.plot(place[::8] * 1e-3, tiled[::8], "o", color=_PEAK, markersize=2, label="one tile × D(qd; N), as in PQ")
        difference = np.abs(tiled - formula).max()
        panel.text(
            0.01, 0.92, f"N = {count}\nlargest difference {difference:.0e}", transform=panel.transAxes, va="top", size=9
        )
        panel.set_ylim(0, 1.05)
    axes[-1].set_xlim(-10, 10)
    axes[-1].set_xlabel("place on the screen / mm")
    drawn.supylabel("intensity / largest")
    slits = Slits(1)
    drawn.suptitle(
        f"Slits {slits.width:g} µm wide, {slits.separation:g} µm apart, screen at {slits.distance * 1e-6:g} m, "
        f"λ = {wavelength:g} nm",
        size=11,
    )
    handles, labels = axes[0].get_legend_handles_labels()
    drawn.legend(handles, labels, loc="outside lower center", ncols=2, frameon=False)
    return drawn


def plot_slit_patterns(counts: Sequence[int] = (1, 7), wavelength: float = 500.0) -> Figure:
    """What the screen behind N slits looks like in light of one wavelength, and in daylight (figure 5.6)."""
    drawn = figure(7, 1.35 * len(counts) + 0.6)
    axes = drawn.subplots(2 * len(counts), 1, sharex=True)
    place, nanometres = np.linspace(-25e3, 25e3, 1501), wavelengths()
    # Light in one wavelength: all of a step of 5 nm, made as bright as daylight.
    line = np.where(nanometres == wavelength, 1.0, 0.0)
    lights = ((line, f"{wavelength:g} nm"), (daylight(nanometres), "daylight"))
    for index, count in enumerate(counts):
        slits = Slits(count)
        intensity = tiled_intensity(slits, slits.sine(place)[:, None], nanometres, samples=100)
        for panel, (light, name) in zip(axes[2 * index : 2 * index + 2], lights, strict=True):
            rgb = into_gamut(spectrum_to_linear_sRGB(intensity * light, nanometres))
            # The middle at the white of the screen; the square root lifts the faint outer orders.
            peak = rgb.max(axis=-1, keepdims=True) / rgb.max()
            pixels = on_screen(rgb / rgb.max() / np.sqrt(np.maximum(peak, 1e-9)))
            panel.imshow(pixels[None], aspect="auto", extent=(-25, 25, 0, 1))
            panel.set_yticks([])
            panel.set_ylabel(f"N = {count}\n{name}", rotation=0, ha="right", va="center", size=9)
    axes[-1].set_xlabel("place on the screen / mm (brightness: square root of the intensity)")
    return drawn


def plot_patch_fits(
    surface: Surface,
    lengths: Sequence[float],
    heights: Sequence[float],
    fits: Mapping[str, Sequence[tuple[float, PeriodFit]]],
) -> Figure:
    """Fitted period over the length of the cut patch, with the lines d = T/m that PQ cannot leave.

    Args:
        surface: which the patches were cut from.
        lengths: T of each patch, µm.
        heights: the mean period of the heights inside each patch, µm.
        fits: method → pairs of T and the fit.
    """
    drawn = figure(7.5, 4.4)
    axes = drawn.subplots()
    lengths, period = np.asarray(lengths), surface.period
    for order in range(int(lengths[0] / period) - 1, int(lengths[-1] / period) + 3):
        axes.plot(lengths, lengths / order * 1e3, color="0.75", linewidth=0.8, zorder=0)
    axes.plot([], [], color="0.75", linewidth=0.8, label="T/m, m a whole number")
    axes.plot(lengths, np.asarray(heights) * 1e3, color="black", linewidth=1, label="heights in the patch")
    for method, colour, marker, label in (
        (MODEL, _EQUATION, "s", "this model, extent “sample”"),
        ("pq", _PEAK, "o", "PQ, as published"),
    ):
        at, found = zip(*fits[method], strict=True)
        axes.errorbar(
            at, [fit.mean for fit in found], [fit.variance**0.5 for fit in found], color=colour, marker=marker,
            markersize=4, linestyle="none", linewidth=1, label=label,
        )  # fmt: skip
    axes.set_ylim(0.86 * period * 1e3, 1.14 * period * 1e3)
    axes.set_xlabel("length T of the patch along the diffracting axis / µm")
    axes.set_ylabel("fitted period / nm (bars: standard deviation)")
    axes.set_title(f"Patches cut out of {surface.name}", size=11)
    drawn.legend(loc="outside lower center", ncols=2, frameon=False, fontsize=9)
    return drawn
