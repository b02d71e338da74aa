"""Wavelengths that the spectrum does not cover: the grating is black there, and the others do not change."""

import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import array, floats, interaction, made_up, of_spectrum, random_directions, spectrum, use, vectors

import mitsuba_diffraction as md

BLAZE = {"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25}
DIFFUSE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.1, 0.4, 0.2]}}
GRATINGS = {
    "line": lambda: {**BLAZE, "material": "Al"},
    "coat": lambda: {**BLAZE, "material": "Al", "coat_ior": 1.5},
    "crossed": lambda: of_spectrum(spectrum("corner"), material="Cu"),
    "sample": lambda: of_spectrum(
        md.precompute(md.gratings.elaphe_synthetic(8), extent="sample", coherence_length=1.5),
        material="Al",
        conserve_energy=False,  # E is looked up as that of crossed gratings
    ),
    "base": lambda: {**BLAZE, "int_ior": 1.5, "base": DIFFUSE},
    "sheet": lambda: {**BLAZE, "int_ior": 1.5, "transmission": "sheet"},
    "interface": lambda: {**BLAZE, "int_ior": 1.5, "transmission": "interface"},
    "rigorous": lambda: of_spectrum(made_up(), material="Al"),
}
POLARISED = [name for name in GRATINGS if name != "rigorous"]  # the table that is made up has no Mueller matrices
# A coat contains a line, and the polarised interface what is computed for the other variant and for a sheet.
DEFAULT = {("llvm_ad_spectral", name) for name in ("coat", "crossed", "sample", "base", "rigorous")}
DEFAULT |= {("llvm_ad_spectral_polarized", "interface")}
CASES = [
    pytest.param(case, marks=[pytest.mark.slow] * (case not in DEFAULT))
    for case in (
        *(("llvm_ad_spectral", name) for name in GRATINGS),
        *(("llvm_ad_spectral_polarized", name) for name in POLARISED),
    )
]
COUNT = 300


def seen(bsdf, wi, wo, u, wavelengths):
    """Return the arrays of `eval_pdf` and of `sample`, spectra as (…, wavelengths, n)."""
    si = interaction(wi, wavelengths, len(wi))
    numbers = floats(u[0]), mi.Point2f(*map(floats, u[1:]))
    bs, weight = bsdf.sample(mi.BSDFContext(), si, *numbers)
    values = (*bsdf.eval_pdf(mi.BSDFContext(), si, vectors(wo)), weight, bs.wo, bs.pdf, bs.eta)
    return [array(x, np.float64) for x in values]


def directions(bsdf):
    """Return pairs above and below, including retroreflection, where a metal without index is 0/0; and samples."""
    rng = np.random.default_rng(5)
    wi, wo = (random_directions(rng, COUNT, 1e-3) * rng.choice([1, -1], (COUNT, 1)) for _ in range(2))
    wi[0], wo[: COUNT // 4] = [0, 0, 1], wi[: COUNT // 4]
    u = rng.random((3, COUNT)).astype(np.float32)
    wo[COUNT // 2 :] = seen(bsdf, wi, wo, u, (500.0,) * 4)[3].T[COUNT // 2 :]
    return wi, wo, u


@pytest.fixture(scope="module", params=CASES, ids=lambda case: " ".join(case))
def case(request):
    variant, name = request.param
    use(variant)
    bsdf = mi.load_dict(GRATINGS[name]())
    return variant, name, bsdf, directions(bsdf)


SPECIAL = [0.0, -0.0, 359.9, 830.1, 1000.0, -500.0, 1e-45, 1e30, np.inf, -np.inf, np.nan]  # in a coat 1000/1.5 nm


@pytest.mark.few(1)
def test_wavelengths_outside_the_spectrum_are_black_and_change_no_others(case):
    variant, name, bsdf, (wi, wo, u) = case
    mi.set_variant(variant)
    rng, covered = np.random.default_rng(4), np.array([450.0, 500.0, 600.0, 700.0])
    # Any float, and those of the order of a wavelength.
    any_float = rng.integers(1 << 32, size=50, dtype=np.uint32).view(np.float32)
    foreign = np.concatenate([SPECIAL, any_float[np.isfinite(any_float)], rng.uniform(100, 1500, 40)])
    if name == "base":  # Mitsuba's own reflectances are no numbers at wavelengths without end
        foreign = foreign[np.abs(foreign) < 1e6]
    expected = seen(bsdf, wi, wo, u, covered)[0]
    pairs = [np.tile(x, len(foreign)) for x in (wi.T, wo.T, u)]
    for channel in range(4):
        wavelengths = np.tile(covered, (len(foreign) * COUNT, 1))
        wavelengths[:, channel] = np.repeat(foreign, COUNT)
        found = seen(bsdf, pairs[0].T, pairs[1].T, pairs[2], wavelengths)
        assert all(np.isfinite(x).all() for x in found)
        assert all((x >= 0).all() for x in (found[1], found[4]))
        value, beside = found[0].reshape(*found[0].shape[:-1], -1, COUNT), np.arange(4) != channel
        others = np.broadcast_to(expected[..., None, :], value.shape)
        np.testing.assert_allclose(value[..., beside, :, :], others[..., beside, :, :], rtol=1e-5, atol=1e-6)
        if name != "base":
            # A dielectric with a spectrum for shorter wavelengths, those inside, covers longer ones outside.
            longest = 1300 if name in ("interface", "sheet") else 830
            is_covered = (foreign > 359.9) & (foreign <= longest)
            assert (value[..., channel, ~is_covered, :] == 0).all()
