"""Colours by one look-up, beside the BSDF summed over wavelengths."""

from dataclasses import replace

import mitsuba as mi
import numpy as np
import pytest

import mitsuba_diffraction as md
from mitsuba_diffraction.bsdf.testing import evaluate
from mitsuba_diffraction.export import colour_table
from mitsuba_diffraction.export.colour_table import (
    ColourTable,
    OrderColours,
    Viewed,
    colours_of,
    from_shared_exponents,
    to_shared_exponents,
)
from mitsuba_diffraction.optics.color import (
    XYZ_to_linear_sRGB,
    auto_exposure,
    daylight,
    delta_E,
    into_gamut,
    matching_functions,
)
from mitsuba_diffraction.optics.media import MediumBelow

AIR = 1.000277
SURFACES = {
    # (recipe or profile, material, index of the coat, whether orders are separate)
    "blaze": ("blaze", "Al", None, True),
    "foil of gold": ("foil_crossed", "Au", None, True),
    "skin": ("elaphe", None, None, False),
    "skin of Xenopeltis": ("xenopeltis", None, None, False),
    "compact disc": ("compact_disc", "Al", 1.55, False),
    "DVD": ("dvd", "Al", 1.55, False),
}


def viewed(name, **settings):
    surface, material, coat, _ = SURFACES[name]
    recipe = md.Recipe.load(md.examples_folder() / "precompute" / f"{surface}.toml")
    recipe = replace(recipe, settings=replace(recipe.settings, **settings))
    if coat:
        recipe = replace(recipe, settings=replace(recipe.settings, wavelengths=(360 / coat, 830.0)))
    return Viewed(recipe.cached(), MediumBelow.of(material), coat / AIR if coat else 1.0)


def face(cosine, n):
    """Unpolarised transmittance of the face of a coat, by Fresnel's formulas."""
    inside = np.sqrt(1 - (1 - cosine**2) / n**2)
    s, p = (cosine - n * inside) / (cosine + n * inside), (n * cosine - inside) / (n * cosine + inside)
    return 1 - (s**2 + p**2) / 2


def by_bsdf(surface, name, wi, wo, step=2.0):
    """XYZ of f/(K G T_i T_o) by the BSDF in daylight, (n, 3); K and G as Stam and Torrance have them."""
    _, material, coat, _ = SURFACES[name]
    parameters = {"spectrum": surface.spectrum, "conserve_energy": False, **({"coat_ior": coat} if coat else {})}
    parameters |= {"material": material} if material else {"int_ior": 1.5}
    bsdf = mi.load_dict({"type": "diffraction_grating", **parameters})
    nm = np.arange(380 + step / 2, 740, step).reshape(-1, 4)
    f = np.concatenate([evaluate(bsdf, wi, wo, np.tile(four, (len(wi), 1))) for four in nm], axis=1) / wo[:, 2:]
    light = matching_functions(nm.ravel()) * daylight(nm.ravel())[:, None] * step
    everything = np.arange(360.0, 831.0)
    f = f @ light / (matching_functions(everything)[:, 1] @ daylight(everything))
    n = surface.coat
    inner = [
        np.concatenate([d[:, :2] / n, np.sqrt(1 - (d[:, :2] ** 2).sum(1, keepdims=True) / n**2)], 1) for d in (wi, wo)
    ]
    (ci, co), dot = (d[:, 2] for d in inner), (inner[0] * inner[1]).sum(axis=1)
    half = inner[0] + inner[1]
    half /= np.linalg.norm(half, axis=1, keepdims=True)
    k = (1 + dot) ** 2 / (ci * co * (ci + co) ** 2)
    g = np.minimum(1, 2 * half[:, 2] * np.minimum(ci, co) / (half * inner[1]).sum(axis=1))
    return f / (k * g * (face(wi[:, 2], n) * face(wo[:, 2], n) if n > 1 else 1))[:, None]


def directions(surface, count):
    """Directions whose u and w are those of the pairs of a surface."""
    rng = np.random.default_rng(3)
    theta, phi = np.deg2rad(rng.uniform(0, 60, count)), rng.uniform(0, 2 * np.pi, count)
    incident = np.sin(theta)[:, None] * np.stack([np.cos(phi), np.sin(phi)], -1)
    if surface.has_separate_orders:
        q = np.array([m / surface.spectrum.grid.tile_size[0] for m in rng.integers(-2, 3, count)])
        q = np.stack([q, np.zeros(count)], -1) + surface.spectrum.lobe_width * rng.normal(size=(count, 2))
        outgoing = -incident - rng.uniform(0.42, 0.68, count)[:, None] * q
    else:
        sine, phi = np.sqrt(1 - rng.uniform(0.2, 1, count) ** 2), rng.uniform(0, 2 * np.pi, count)
        outgoing = sine[:, None] * np.stack([np.cos(phi), np.sin(phi)], -1)
    kept = (outgoing**2).sum(axis=1) < 0.96
    tangents = [incident[kept], outgoing[kept]]
    return [np.concatenate([t, np.sqrt(1 - (t**2).sum(axis=1, keepdims=True))], 1) for t in tangents]


@pytest.mark.parametrize(
    "name", [pytest.param(name, marks=() if name == "blaze" else pytest.mark.slow) for name in SURFACES]
)
def test_a_look_up_has_the_colour_of_the_bsdf(name, llvm):
    surface = viewed(name)
    colours = colours_of(surface)
    assert isinstance(colours, OrderColours if SURFACES[name][3] else ColourTable)
    wi, wo = directions(surface, 1000)
    wanted = by_bsdf(surface, name, wi, wo)
    u = -(wi + wo)[:, :2]
    w = np.sqrt(surface.coat**2 - (wi[:, :2] ** 2).sum(1)) + np.sqrt(surface.coat**2 - (wo[:, :2] ** 2).sum(1))
    found = colours.colour(u, w)
    exposure = auto_exposure(into_gamut(XYZ_to_linear_sRGB(wanted)))
    error = delta_E(exposure * found, exposure * wanted)
    assert error.mean() < 0.5
    assert np.percentile(error, 95) < 1.5
    ordinary = wanted[:, 1] < np.percentile(wanted[:, 1], 99)  # beside the few in the mirror direction of a skin
    assert found[ordinary].sum() == pytest.approx(wanted[ordinary].sum(), rel=0.03)
    np.testing.assert_allclose(found[~ordinary, 1], wanted[~ordinary, 1], rtol=0.15)
    assert colours.error.is_small


@pytest.mark.few(1)
@pytest.mark.parametrize("length", [14.0, 9.0, 25.0, 40.0])
def test_lobes_of_any_width_have_the_colour_of_the_integral(length, monkeypatch):
    monkeypatch.setattr(colour_table, "PAIRS", 400)
    surface = viewed("blaze", coherence_length=length)
    assert surface.has_separate_orders
    assert colours_of(surface).error.is_small


def test_three_numbers_have_nine_bits_and_an_exponent():
    rng = np.random.default_rng(1)
    values = rng.uniform(size=(500, 3)) * 10.0 ** rng.uniform(-3, 4, (500, 1))
    assert (
        np.abs(from_shared_exponents(to_shared_exponents(values)) - values) <= values.max(axis=1, keepdims=True) / 511
    ).all()
    # The example of GL_EXT_texture_shared_exponent: one is 256/512 times 2.
    assert to_shared_exponents(np.ones((1, 3)))[0] == 256 | 256 << 9 | 256 << 18 | 16 << 27


def test_too_many_separate_orders_are_refused(monkeypatch):
    monkeypatch.setattr(colour_table, "MAX_ORDERS", 3)
    spectrum = md.precompute(md.gratings.blazed(5.0, 0.25))
    with pytest.raises(ValueError, match=r"got \d+ separate orders, wanted at most 3"):
        colours_of(Viewed(spectrum, MediumBelow.of("Al")))
