"""Samples of every kind of surface in every mode: their density, their weights, their pdf. Modes multiply."""

import dataclasses
import functools

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import WAVELENGTHS, array, coarse_glass, direction, made_up, vectors

import mitsuba_diffraction as md
from mitsuba_diffraction import testing

INDEX = 1.5
DENSE = (225.0, 830.0)  # nm, the wavelengths in a medium of an index up to 1.6


def scalar(heights, **settings):
    return lambda: md.precompute(heights(), wavelengths=DENSE, tolerance=1e-2, **settings)


SURFACES = {
    "resolved": scalar(lambda: md.gratings.blazed(2.5, 0.25), coherence_length=16.0),
    "overlapping": scalar(lambda: md.gratings.crossed(2.5, 0.25), coherence_length=4.0),
    "spline": scalar(lambda: md.gratings.xenopeltis_synthetic((9.0, 8.0)), extent="sample", coherence_length=4.0),
    "line": scalar(
        lambda: md.HeightField(md.gratings.blazed(2.5, 0.25).heights.T, (2.5, 2.5 / 512)), coherence_length=5.0
    ),
    "patches": scalar(lambda: [md.gratings.elaphe_synthetic(8.0, seed=seed) for seed in (1, 2)], coherence_length=5.0),
}
MODES = {
    "coat": {"material": "none", "coat_ior": INDEX, "ext_ior": 1.0},
    "mirror": {"material": "none"},
    "base": {"int_ior": INDEX, "ext_ior": 1.0, "base": {"type": "diffuse", "reflectance": 0.5}},
    "interface": {"int_ior": INDEX, "ext_ior": 1.0, "transmission": "interface"},
    "sheet": {"int_ior": INDEX, "ext_ior": 1.0, "transmission": "sheet"},
}
PAIRS = [(surface, mode) for surface in (*SURFACES, "rigorous") for mode in MODES]
PAIRS.remove(("rigorous", "base"))  # the base needs R of a plane
spectrum = functools.cache(lambda surface: SURFACES[surface]())


def grating(surface, mode):
    """Return the BSDF, and the wavelengths at which its table is read."""
    parameters = MODES[mode]
    if surface != "rigorous":
        # E, one table for each of these, is a factor of value and weight alike.
        parameters = {**parameters, "spectrum": spectrum(surface), "conserve_energy": False}
        return mi.load_dict({"type": "diffraction_grating", **parameters}), WAVELENGTHS

    def changed(table, **settings):
        return dataclasses.replace(table, settings=dataclasses.replace(table.settings, **settings))

    if "transmission" in parameters:
        table = changed(coarse_glass(mode), coherence_length=12.0)
        parameters = {**parameters, "spectrum": table}
        return mi.load_dict({"type": "diffraction_grating", **parameters}), (405.0, 440.0, 470.0, 498.0)
    table = changed(made_up(8.0), ext_ior=INDEX if mode == "coat" else 1.0)
    parameters = {key: value for key, value in parameters.items() if key != "material"}
    wavelengths = (600.0, 700.0, 800.0, 900.0) if mode == "coat" else WAVELENGTHS
    return mi.load_dict({"type": "diffraction_grating", "spectrum": table, **parameters}), wavelengths


def incidences(mode):
    """Return ω_i from above and, with transmission, from below: inside of a medium beyond the critical angle, too."""
    above = direction([0, 45, 80, 88], [0, 130, 250, 20])
    return np.concatenate([above, above * [1, 1, -1]]) if "transmission" in MODES[mode] else above


RINGS, SECTORS = 12, 16  # bins of θ and φ
STEPS = 28, 40  # of the grid in each of them


def directions_of_bins():
    """Return directions above the surface, in the order of `bin_of`, and dω of each; they are denser at the horizon."""
    (rings, of_theta), (sectors, of_phi) = (RINGS, STEPS[0]), (SECTORS, STEPS[1])
    theta = (np.arange(rings * of_theta) + 0.5) * 90 / (rings * of_theta)
    phi = (np.arange(sectors * of_phi) + 0.5) * 360 / (sectors * of_phi)
    omega = direction(theta[:, None], phi).reshape(-1, 3)
    return omega, np.sqrt(1 - omega[:, 2] ** 2) * np.deg2rad(theta[1] - theta[0]) * np.deg2rad(phi[1] - phi[0])


def bin_of(omega):
    """Return the bins of directions (n, 3), on either side of the surface."""
    ring = np.degrees(np.arccos(np.minimum(np.abs(omega[:, 2]), 1))) * RINGS / 90
    sector = np.degrees(np.arctan2(omega[:, 1], omega[:, 0])) % 360 * SECTORS / 360
    return np.minimum(ring.astype(int), RINGS - 1) * SECTORS + np.minimum(sector.astype(int), SECTORS - 1)


def in_bins(omega, *terms):
    """Return sums of terms (n,) over the bins of directions: (bins,) each."""
    return [np.bincount(bin_of(omega), of, RINGS * SECTORS) for of in terms]


@pytest.mark.filterwarnings("ignore:pixels of")
@pytest.mark.few(6)
@pytest.mark.parametrize(("surface", "mode"), PAIRS)
def test_samples_have_their_density_and_average_to_the_integral_in_every_bin(llvm, surface, mode):
    bsdf, wavelengths = grating(surface, mode)
    wi, count, ctx = incidences(mode), 1 << 16, mi.BSDFContext()
    of_wi = np.repeat(wi, count, axis=0)
    omega, weight, bs = testing.sample(bsdf, of_wi, wavelengths)
    again = np.array(bsdf.pdf(ctx, testing.interaction(of_wi, wavelengths), bs.wo), np.float64)
    pdf, is_delta = np.array(bs.pdf, np.float64), np.array(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta))
    assert np.isfinite(pdf).all()
    assert np.isfinite(weight).all()
    assert (weight >= 0).all()
    drawn = (pdf > 0) & ~is_delta
    np.testing.assert_allclose(again[drawn], pdf[drawn], rtol=2e-3)
    if surface == "resolved":
        # A table of orders that belongs to another medium or scale has the integrals, with more noise.
        of_all, fraction = np.where(drawn, weight.mean(axis=-1), 0).reshape(len(wi), count), drawn.reshape(len(wi), -1)
        useful = of_all.mean(axis=1) ** 2 / np.maximum((of_all**2).mean(axis=1) * fraction.mean(axis=1), 1e-30)
        assert (useful[fraction.mean(axis=1) > 0.4] > 0.35).all()

    # Neither of the integrals has its directions from the sampler, whose density would cancel.
    wo, area = directions_of_bins()
    for side in (1, -1) if "transmission" in MODES[mode] else (1,):
        si = testing.interaction(np.repeat(wi, len(wo), axis=0), wavelengths)
        value, density = bsdf.eval_pdf(ctx, si, vectors(np.tile(wo * [1, 1, side], (len(wi), 1))))
        dr.eval(value, density)
        value = array(value, np.float64).reshape(-1, len(wi), len(wo)) * area
        density = np.array(density, np.float64).reshape(len(wi), -1) * area
        is_here = (drawn & (omega[:, 2] * side > 0)).reshape(len(wi), count)
        for k in range(len(wi)):
            inside, of_direction = is_here[k], slice(k * count, (k + 1) * count)
            where, weights = omega[of_direction][inside], weight[of_direction][inside].T
            (fraction,) = in_bins(where, np.full(len(where), 1 / count))
            (integral,) = in_bins(wo, density[k])
            noise = np.sqrt(np.maximum(integral, fraction) / count)
            # Lobes are as narrow as the grid is wide, and bins and the horizon cut through some.
            np.testing.assert_array_less(np.abs(integral - fraction), 5 * noise + 0.04 * integral + 2e-3)
            assert integral.sum() == pytest.approx(fraction.sum(), rel=0.02, abs=4 * 0.5 / np.sqrt(count))
            for channel in range(4):
                mean, square = in_bins(where, weights[channel] / count, weights[channel] ** 2 / count)
                # The variance also from the grid, as few samples may have most of it.
                of_grid = np.where(density[k] > 0, value[channel, k] ** 2 / np.maximum(density[k], 1e-30), 0)
                integral, of_grid = in_bins(wo, value[channel, k], of_grid)
                square = np.maximum(square, of_grid)
                error = np.sqrt(square / count) + np.max(weights[channel], initial=0) / count
                np.testing.assert_array_less(np.abs(integral - mean), 5 * error + 0.04 * integral + 2e-3)
                error = np.sqrt(square.sum() / count)
                assert abs(mean.sum() - integral.sum()) < 4 * error + 0.02 * integral.sum() + 1e-9
