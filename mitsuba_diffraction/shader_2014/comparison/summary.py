"""Results of a comparison: tables for the terminal, notes, and JSON."""

from __future__ import annotations

import dataclasses

import numpy as np
from rich.table import Table

from ...progress import cells, table
from ..diffraction_shader import PUBLISHED_BRIGHTNESS
from .pictures import NO_SHADOWS
from .quirk_costs import MIN_EFFECT, QuirkCosts
from .side_by_side import Comparison

CAUSES = {
    "schlick": "Schlick's Fresnel",
    "fixed_index": "index of 1.5",
    "complex_window_sum": "speckle of one point",
    "one_texel": "3 × 3 texels",
    "floor_anchor": "window off centre",
    "fixed_coherence": "coherence of 65 µm",
    "periodic_scan": "seams of the scan",
    "fixed_terms": "number of Taylor terms",
    "no_jacobian": "no dλ/dn",
    "wrong_product": "wrong product",
    "d65_light": "D65 as light",
    "relative": "no 1/λ²",
    "cie_rgb_matrix": "CIE RGB for sRGB",
    "constant_blend": "constant blend",
    NO_SHADOWS: "no cast shadows",
}
"""The quirks in words."""


def titles(comparison: Comparison) -> dict[str, str]:
    """Return the titles of the pictures."""
    result = {"path_traced": "path tracer, this model", "same_light": "this model, same light"}
    for kind in (comparison.shader, *comparison.others):
        prefix = "" if kind == comparison.shader else f"{kind}_"
        shader = kind.upper().replace("_", " with ")
        result |= {f"{prefix}published": f"{shader} as published", f"{prefix}corrected": f"{shader} corrected"}
    return result


_TO_REFERENCE = {
    "exposure\nfactor": "{.exposure:.3g}",
    "ΔE00\nmean": "{.mean:.2f}",
    "ΔE00\n95 %": "{.percentile_95:.1f}",
    "luminance\nerror": "{.luminance_error:.1%}",
}


def picture_table(comparison: Comparison) -> Table:
    """Return a table of the pictures and their differences, for a terminal."""
    columns = (
        "bright-\nness",
        *_TO_REFERENCE,
        "ΔE00 to\nsame light",
        "reads per\npoint",
        "samples\nper pixel",
        "seconds",
        "of path\ntracer",
    )
    rows = []
    for name, title in titles(comparison).items():
        found, same = comparison.to_path_traced.get(name), comparison.to_same_light.get(name)
        picture = comparison.pictures[name]
        reads = comparison.shader_reads.get(name, comparison.model_reads)
        differences = ["1", "", "", ""] if found is None else cells(_TO_REFERENCE, found)
        brightness = "" if picture.brightness is None else f"{picture.brightness:.3g}"
        same_light = "" if same is None else f"{same.mean:.2f}"
        time = float("nan") if found is None else comparison.time_of_error(name)
        bound = "< " if comparison.few_samples and time == comparison.few_samples[0][1] else ""
        rows.append([title, brightness, *differences, same_light, str(reads), str(picture.samples)])
        rows[-1] += [f"{picture.seconds:.1f}", "" if np.isnan(time) else f"{bound}{time:.2g}"]
    return table(("picture", *columns), rows)


def quirk_table(costs: QuirkCosts) -> Table:
    """Return a table of the visible quirks, largest fraction first, for a terminal."""
    rows = []
    for name in costs.visible():
        one = costs.quirks[name]
        rows.append([name, CAUSES[name], f"{one.drop:+.2f}", f"{one.rise:+.2f}", f"{one.fraction:.0%}"])
    return table(("quirk", "cause", "drop", "rise", "fraction"), rows)


def notes(comparison: Comparison) -> list[str]:
    """Return explanations of the tables, one line each."""
    rows, columns = comparison.mask.shape
    lines = [
        f"compared: the {100 * comparison.mask.mean():.0f} % of {columns} × {rows} pixels that show only gratings; "
        f"Y = {comparison.white:.4g} is white; one exposure factor gives a picture the mean luminance of its reference",
        "gratings are shown with what lies below them"
        if comparison.pigment
        else "gratings show diffraction alone, without what lies below them",
        f"brightness: {PUBLISHED_BRIGHTNESS:g} in the published program; a factor of the diffraction alone",
        "same light: the shader's, of directional and point lights; here with the shadows that surfaces cast",
        "ΔE00 to same light: the mean, of pictures of the same points, so that noise cancels",
        "reads: texels of two numbers (shader), or packets of four for the wavelengths of a ray (this model)",
    ]
    if comparison.few_samples:
        lines.append(
            "seconds of path tracer: those after which its own picture has the same mean ΔE00, by pictures of "
            f"{', '.join(str(count) for count, *_ in comparison.few_samples)} samples per pixel"
        )
    whose = {
        "path_traced": "in the path-traced picture",
        "same_light": "in the same light's",
        "corrected": "in the corrected shader's",
    }
    known = [f"{noise:.2f} {words}" for name, words in whose.items() if (noise := comparison.noise[name]) is not None]
    if known:
        lines.append(f"noise: a mean ΔE00 of {', '.join(known)}")
    if comparison.coated:
        lines.append("coat: the shader shows coated gratings without their coat; it does not converge to this model")
    elif comparison.truncated_fraction is not None:
        lines.append(
            "limit: corrected, the shader converges to this model in the same light; its neighbourhood omits at most "
            f"{100 * comparison.truncated_fraction:.2g} % of a line"
        )
    if comparison.samples:
        lines.append(
            "scan: as published it is one period of a tiling; corrected, one transform of the tapered scan, within "
            "about 5 % of this model's average over windows"
        )
    if comparison.patches > 1:
        lines.append(f"patches: this model is the mean over {comparison.patches} of them, the shader has the first")
    if comparison.series_error is not None and comparison.series_error > 0.01:
        lines.append(f"terms: the Taylor series of the corrected shader has an error of {comparison.series_error:.1g}")
    if (costs := comparison.costs) is not None:
        lines.append(
            f"quirks: pictures of {costs.size[0]} × {costs.size[1]} pixels, {costs.samples} samples, "
            f"{costs.shading_points} shading points"
        )
        lines.append(
            f"quirks, mean ΔE00 to same light: {costs.published:.2f} as published, {costs.corrected:.2f} corrected"
        )
        if below := [name for name in costs.quirks if name not in costs.visible()]:
            lines.append(f"quirks whose drop and rise are at most {MIN_EFFECT:g}: {', '.join(below)}")
        lines += [
            "drop: decrease of the published shader's mean ΔE00 with this quirk alone corrected",
            "rise: increase of the corrected shader's mean ΔE00 with this quirk alone added",
            "fraction: the mean of both over the mean ΔE00 of the published shader; fractions do not add up to one",
        ]
    return lines


_NUMBERS = ("exposure", "mean", "percentile_95", "max", "luminance_error")
"""Of `Difference`."""


def as_dict(comparison: Comparison) -> dict[str, object]:
    """Return all numbers by the names of the attributes, for `outputs.save_json`."""
    found = {field.name: getattr(comparison, field.name) for field in dataclasses.fields(comparison)}
    mask = found.pop("mask")
    found |= {"size": mask.shape[::-1], "compared": float(mask.mean())}
    found["pictures"] = {
        name: {"samples": picture.samples, "seconds": picture.seconds, "brightness": picture.brightness}
        for name, picture in comparison.pictures.items()
    }
    found["published_brightness"] = PUBLISHED_BRIGHTNESS
    for reference in ("to_path_traced", "to_same_light"):
        found[reference] = {
            name: {number: getattr(one, number) for number in _NUMBERS} for name, one in found[reference].items()
        }
    return found
