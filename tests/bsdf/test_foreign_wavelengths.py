"""Wavelengths that the spectrum does not cover: the grating is black there, and the others do not change."""

import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import array, floats, interaction, made_up, of_spectrum, random_directions, spectrum, use, vectors
from hypothesis import assume, example, given
from hypothesis import strategies as st

import mitsuba_diffraction as md

BLAZE = {"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25}
DIFFUSE = {"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.1, 0.4, 0.2]}}
COAT = {"coat_ior": 1.5, "coat_absorption": 0.1, "coat_thickness": 1.0}
GRATINGS = {
    "line": lambda: {**BLAZE, "material": "Al"},
    "coat": lambda: {**BLAZE, "material": "Al", **COAT},
    "crossed": lambda: of_spectrum(spectrum("corner"), material="Cu", fresnel="schlick"),
    "sample": lambda: of_spectrum(
        md.precompute(md.gratings.elaphe(8), extent="sample", coherence_length=1.5), material="Al"
    ),
    "base": lambda: {**BLAZE, "int_ior": 1.5, "base": DIFFUSE},
    "sheet": lambda: {**BLAZE, "int_ior": 1.5, "transmission": "sheet"},
    "interface": lambda: {**BLAZE, "int_ior": 1.5, "transmission": "interface"},
    "rigorous": lambda: of_spectrum(made_up(), material="Al"),
}
POLARISED = [name for name in GRATINGS if name != "rigorous"]  # the table that is made up has no Mueller matrices
CASES = [("llvm_ad_spectral", name) for name in GRATINGS]
CASES += [
    pytest.param(("llvm_ad_spectral_polarized", name), marks=[pytest.mark.slow] * (name not in ("line", "interface")))
    for name in POLARISED
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


@given(
    foreign=st.one_of(
        st.floats(width=32), st.sampled_from([359.9, 830.1, 0.0, -0.0, -500.0, 1e-45, 1e30, np.inf, -np.inf, np.nan])
    ),
    channel=st.integers(0, 3),
)
@example(foreign=0.0, channel=1)
@example(foreign=359.9, channel=0)
@example(foreign=1000.0, channel=3)  # inside a coat 667 nm
@example(foreign=np.nan, channel=2)
@example(foreign=np.inf, channel=3)
def test_a_wavelength_outside_the_spectrum_is_black_and_changes_no_other(case, foreign, channel):
    variant, name, bsdf, (wi, wo, u) = case
    # Mitsuba's own reflectances are no numbers at wavelengths without end.
    assume(name != "base" or abs(foreign) < 1e6)
    mi.set_variant(variant)
    wavelengths = [450.0, 500.0, 600.0, 700.0]
    beside = [x for x in range(4) if x != channel]
    expected = seen(bsdf, wi, wo, u, wavelengths)[0]
    wavelengths[channel] = foreign
    found = seen(bsdf, wi, wo, u, wavelengths)
    assert all(np.isfinite(x).all() for x in found)
    assert all((x >= 0).all() for x in (found[1], found[4]))
    np.testing.assert_allclose(found[0][..., beside, :], expected[..., beside, :], rtol=1e-5, atol=1e-6)
    # A dielectric with a spectrum for shorter wavelengths, those inside, covers longer ones outside.
    longest = 1300 if name in ("interface", "sheet") else 830
    if not 359.9 < foreign <= longest and name != "base":
        assert (found[0][..., channel, :] == 0).all()
