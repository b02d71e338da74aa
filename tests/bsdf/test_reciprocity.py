"""n_o² f(ω_i, ω_o) = n_i² f(ω_o, ω_i): every kind of surface in every mode, with numbers, textures and dispersion."""

import dataclasses

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import bitmap, coarse_glass, made_up
from covering import covering
from test_modes import INDEX, MODES, SURFACES, spectrum

from mitsuba_diffraction import testing

PERIOD, COUNT = 2.5, 1024
SCALES = (0.55, 0.95)  # of the two halves of UV space, where they are textures
WITH_E = "resolved", "mirror"  # a row whose table of E takes milliseconds
VARIATIONS = ("numbers", "textures", "dispersive index", "dispersive coat")


def index_at(wavelengths):
    """n of a medium with dispersion."""
    return 1.48 + 0.012 / (1e-3 * np.asarray(wavelengths)) ** 2


def rows():
    """Each surface in each mode, and each of both with each variation that it has; slow where others do the same."""
    for surface, mode, variation in covering([*SURFACES, "rigorous"], [*MODES], VARIATIONS):
        transmits = "transmission" in MODES[mode]
        if surface == "rigorous" and mode == "base":  # the base needs R of a plane
            continue
        if surface == "rigorous":  # scales and indices are those of the table
            variation = "numbers"
        if transmits and variation == "dispersive coat":
            variation = "dispersive index"
        # Patches are read as overlapping orders are; of coarse rigorous tables, test_rigorous_transmission.py has one.
        slow = surface == "patches" or (surface == "rigorous" and transmits)
        yield pytest.param(surface, mode, variation, marks=pytest.mark.slow if slow else ())


@pytest.fixture(scope="module")
def medium(tmp_path_factory):
    """The file of a medium with dispersion."""
    file = tmp_path_factory.mktemp("media") / "dispersive.spd"
    file.write_text("".join(f"{w} {index_at(w):.9g}\n" for w in range(340, 861, 2)))
    return str(file)


def grating(surface, mode, variation, medium):
    """Return the BSDF, n of the medium below at wavelengths (n, c), and the two scales of lengths."""
    parameters, below, lengths = dict(MODES[mode]), None, (1.0, 1.0)
    if surface == "rigorous":
        table = coarse_glass(mode) if "transmission" in parameters else made_up(8.0)
        settings = {"ext_ior": INDEX} if mode == "coat" else {}
        settings |= {"coherence_length": 12.0} if "transmission" in parameters else {}
        table = dataclasses.replace(table, settings=dataclasses.replace(table.settings, **settings))
        parameters |= {"spectrum": table}
        parameters.pop("material", None)
    else:
        parameters |= {"spectrum": spectrum(surface), "height_scale": 0.8}
        parameters["conserve_energy"] = (surface, mode) == WITH_E
    if variation == "textures":
        parameters |= {"height_scale": bitmap([SCALES], filter_type="nearest")}
        if surface == "resolved":
            lengths = (0.9, 1.0)
            parameters |= {"lateral_scale": bitmap([lengths], filter_type="nearest")}
    if variation == "dispersive index":
        parameters.pop("material", None)
        parameters |= {"int_ior": medium, "ext_ior": 1.0}
    if variation == "dispersive coat":
        parameters |= {"coat_ior": medium, "ext_ior": 1.0}
    if mode == "interface":
        below = index_at if variation == "dispersive index" else lambda wavelengths: INDEX + 0 * wavelengths
    bsdf = mi.load_dict({"type": "diffraction_grating", **parameters})
    return bsdf, below or np.ones_like, np.array(lengths)


def pairs(transmits, below, lengths, wavelengths):
    """Return ω_i and ω_o (n, 3) near orders of one of the wavelengths, half of them transmitted, and UVs (n, 2)."""
    rng = np.random.default_rng(3)
    theta, phi = np.deg2rad(rng.uniform(0, 88, COUNT)), rng.uniform(0, 2 * np.pi, COUNT)
    wi = np.stack([np.sin(theta) * np.cos(phi), np.sin(theta) * np.sin(phi), np.cos(theta)], -1)
    sides = rng.choice([1, -1], (2, COUNT)) if transmits else np.ones((2, COUNT))
    wi[:, 2] *= sides[0]
    wavelength, texel = rng.choice(wavelengths, COUNT), rng.integers(2, size=COUNT)
    n_i, n_o = (np.where(side > 0, 1, below(wavelength)) for side in sides)
    orders = rng.integers(-4, 5, COUNT)[:, None] * np.eye(2)[rng.integers(2, size=COUNT)]
    q = orders / (PERIOD * lengths[texel, None]) + 0.01 * rng.normal(size=(COUNT, 2))
    across = (-1e-3 * wavelength[:, None] * q - n_i[:, None] * wi[:, :2]) / n_o[:, None]
    square = (across**2).sum(-1)
    kept = square < 0.998
    wo = np.column_stack([across, sides[1] * np.sqrt(np.maximum(1 - square, 0))])
    return wi[kept], wo[kept], np.column_stack([0.25 + 0.5 * texel, np.full(COUNT, 0.5)])[kept]


@pytest.mark.filterwarnings("ignore:pixels of")
@pytest.mark.parametrize(("surface", "mode", "variation"), list(rows()))
def test_the_bsdf_is_reciprocal(llvm, medium, capfd, surface, mode, variation):
    bsdf, below, lengths = grating(surface, mode, variation, medium)
    of_glass = surface == "rigorous" and "transmission" in MODES[mode]
    wavelengths = {"rigorous": (610.0, 660.0, 700.0, 800.0)}.get(surface, (400.0, 480.0, 600.0, 750.0))
    wavelengths = np.array((405.0, 440.0, 470.0, 498.0) if of_glass else wavelengths)
    wi, wo, uv = pairs("transmission" in MODES[mode], below, lengths, wavelengths)

    def per_square(wi, wo):
        """f/n_i² (n, c)."""
        value, _ = testing.evaluate_pdf(bsdf, wi, wo, wavelengths, uv=uv)
        n_i = np.where(wi[:, 2:] > 0, 1, below(wavelengths))
        return value / (np.abs(wo[:, 2:]) * n_i**2)

    with dr.scoped_set_flag(dr.JitFlag.Debug, True):  # also reports tables that are read outside of their memory
        forward, reverse = per_square(wi, wo), per_square(wo, wi)
    assert "out-of-bounds" not in capfd.readouterr().err
    # float32 of cosines next to the horizon, and of q at the edge of a lobe
    relative = 2e-3 + 3e-5 / np.minimum(np.abs(wi[:, 2:]), np.abs(wo[:, 2:])) ** 2
    scale = np.maximum(forward, reverse)
    np.testing.assert_array_less(np.abs(forward - reverse), relative * scale + 1e-4 * scale.max())
    for side in {*np.sign(wi[:, 2] * wo[:, 2])}:
        assert (scale[wi[:, 2] * wo[:, 2] * side > 0] > 1e-2 * np.median(scale[scale > 0])).mean() > 0.1
