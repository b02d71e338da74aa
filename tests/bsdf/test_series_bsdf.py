"""Amplitude series in the BSDF: values against direct sums, samples, derivatives, scenes."""

import dataclasses
import functools
import gc
import weakref

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import check_chi_square, direction, interaction, plugin, vectors
from test_bsdf import evaluate, expected, raw_plugin, towards

import mitsuba_diffraction as md
from mitsuba_diffraction.bsdf import theory

pytestmark = pytest.mark.usefixtures("llvm")
EACH = pytest.mark.parametrize("kind", ["taylor", "chebyshev"])
BLAZE = {"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25, "material": "Al"}

MAKE = {
    "blazed": lambda: md.gratings.blazed(2.5, 0.25),
    "crossed": lambda: md.gratings.crossed(2.0, 0.1, samples=32),
    "rough": lambda: md.HeightField(np.random.default_rng(2).random((20, 26)) * 0.2, 0.09),
}


@functools.cache
def spectrum(name, kind, coherence_length=65.0):
    return md.precompute(MAKE[name](), representation=kind, coherence_length=coherence_length)


@EACH
@pytest.mark.parametrize("name", ["blazed", "crossed"])
def test_separate_orders_have_the_powers_of_direct_sums(name, kind):
    bsdf, wi, field = raw_plugin(spectrum(name, kind)), direction(30, 20), MAKE[name]()
    m = np.stack(np.meshgrid(np.arange(-4, 5), np.arange(-4, 5) if name == "crossed" else 0), -1).reshape(-1, 2)
    for channel, wavelength in enumerate((400.0, 500.0, 600.0, 700.0)):
        wo = towards(wi, m / np.array(field.tile_size), wavelength)
        wo = wo[wo[:, 2] > 0.05]
        value = evaluate(bsdf, wi, wo, (400.0, 500.0, 600.0, 700.0))[0][:, channel]
        wanted = expected(field, wi, wo, (400.0, 500.0, 600.0, 700.0))[:, channel]
        np.testing.assert_allclose(value, wanted, rtol=3e-3, atol=1e-3 * wanted.max())


@EACH
def test_overlapping_orders_have_the_values_of_the_table(kind):
    of = spectrum("rough", kind, 3.0)
    assert min(of.neighbours) > 1
    wi = direction(20, 40)
    wo = towards(wi, np.random.default_rng(3).uniform(-1, 1, (60, 2)), 500)
    got = evaluate(raw_plugin(of), wi, wo, [500.0] * 4)[0][:, 0]
    q, kappa = -(wi + wo)[:, :2] / 0.5, 2 * np.pi * (wi + wo)[:, 2] / 0.5
    exact = md.reference.power_spectrum(MAKE["rough"](), q, kappa, coherence_length=3.0)
    scale = expected(MAKE["rough"](), wi, wo, [500.0], 3.0)[:, 0] / exact
    peak = 1 / (2 * np.pi * of.lobe_width**2)
    np.testing.assert_allclose(got / scale, exact, atol=1e-3 * peak)
    np.testing.assert_allclose(got / scale, of.evaluate(q, kappa), atol=1e-5 * peak)


@pytest.mark.few(2)
@EACH
@pytest.mark.parametrize("name", ["blazed", "rough"])
def test_samples_pass_the_chi_square_test(name, kind):
    check_chi_square(raw_plugin(spectrum(name, kind, 3.0)), direction(30, 20))


@EACH
def test_scaled_heights_have_the_values_of_that_depth(kind):
    wi, m = direction(20, 0), np.arange(-3, 4)
    wo = towards(wi, np.stack([m / 2.5, 0 * m], -1), 500)
    got = evaluate(plugin(spectrum("blazed", kind), height_scale=0.7, conserve_energy=False), wi, wo, [500.0] * 4)[0]
    wanted = expected(md.gratings.blazed(2.5, 0.7 * 0.25), wi, wo, [500.0])[:, 0]
    np.testing.assert_allclose(got[:, 0], wanted, rtol=3e-3, atol=1e-3 * wanted.max())


@pytest.mark.slow
@EACH
@pytest.mark.parametrize("coherence_length", [65.0, 3.0])
@pytest.mark.parametrize("mode", ["forward", "backward"])
def test_the_derivative_by_height_is_that_of_differences(kind, coherence_length, mode):
    bsdf = raw_plugin(spectrum("blazed", kind, coherence_length), height_scale=0.7)
    parameters, wi = mi.traverse(bsdf), direction(20, 0)
    m = np.arange(-2, 3) + 0.01
    wo = vectors(towards(wi, np.stack([m / 2.5, 0 * m], -1), 500))
    weights = mi.Float([1.0, 0.3, 0.8, 0.5, 1.2])
    si = interaction(np.tile(wi, (5, 1)), (500.0,) * 4, 5)

    def total(height):
        parameters["height_scale"] = height
        parameters.update()
        return dr.sum(bsdf.eval(mi.BSDFContext(), si, wo)[1] * weights)

    f = [total(mi.Float(0.7 + k * 0.01))[0] for k in (-2, -1, 1, 2)]
    wanted = (8 * (f[2] - f[1]) - (f[3] - f[0])) / 0.12
    x = mi.Float(0.7)
    dr.enable_grad(x)
    value = total(x)
    if mode == "forward":
        dr.forward(x)
        found = dr.grad(value)[0]
    else:
        dr.backward(value)
        found = dr.grad(x)[0]
    assert found == pytest.approx(wanted, rel=0.01)


def test_scenes_and_recipes_take_a_series(tmp_path):
    found = mi.load_dict({**BLAZE, "representation": "taylor", "terms": 20, "heights_from": "lowest"}).spectrum
    settings = found.settings
    assert (settings.representation, settings.terms, settings.heights_from) == ("taylor", 20, "lowest")
    recipe = tmp_path / "blaze.toml"
    recipe.write_text(
        '[surface]\nprofile = "blazed"\nperiod = 2.5\ndepth = 0.25\n[spectrum]\nrepresentation = "taylor"\n'
    )
    scene = {"type": "diffraction_grating", "filename": str(recipe), "material": "Al"}
    assert mi.load_dict(scene).spectrum.representation == "taylor"
    assert mi.load_dict({**scene, "representation": "chebyshev"}).spectrum.representation == "chebyshev"
    assert mi.load_dict({**scene, "representation": "slices"}).spectrum.representation == "slices"


FEW = {**BLAZE, "representation": "taylor", "terms": 20, "heights_from": "lowest"}  # errs by 0.44 at 360 nm
WRONG = {**FEW, "profile": "sinusoidal", "depth": 0.5, "terms": 8}


@pytest.fixture
def anew():
    """A function that forgets which spectra are in use and what was logged, as a new process does."""

    def forget():
        gc.collect()
        theory._warn.cache_clear()

    forget()
    return forget


def test_the_error_of_too_few_terms_is_logged_wherever_the_spectrum_is_from(anew, caplog, tmp_path):
    computed = mi.load_dict(FEW).spectrum
    computed.save(tmp_path / "few.exr")
    held = weakref.ref(computed)
    del computed
    anew()
    assert held() is None
    mi.load_dict(FEW)
    anew()
    mi.load_dict({"type": "diffraction_grating", "filename": str(tmp_path / "few.exr"), "material": "Al"})
    said = "taylor: 20 terms of heights from the lowest, of a range of 0.25 µm, err by 0.44 of the power"
    assert caplog.text.count(said) == 3


def test_a_spectrum_that_errs_by_all_of_the_light_is_refused_unless_its_tolerance_allows_it(anew, caplog, tmp_path):
    refusal = r"taylor: 8 terms of heights from the lowest.* err by 1\.3e\+09 of the power.*wanted more terms"
    for _ in range(2):  # computed, and cached
        with pytest.raises(RuntimeError, match=refusal):
            mi.load_dict(WRONG)
        anew()
    with pytest.warns(UserWarning, match="taylor: 8 terms"):
        spectrum = md.precompute(
            md.gratings.sinusoidal(2.5, 0.5), representation="taylor", terms=8, heights_from="lowest"
        )
    spectrum.save(tmp_path / "wrong.exr")
    with pytest.raises(RuntimeError, match=refusal):
        mi.load_dict({"type": "diffraction_grating", "filename": str(tmp_path / "wrong.exr"), "material": "Al"})
    assert not caplog.text
    accepted = mi.load_dict({**WRONG, "tolerance": 2e9})
    assert accepted.spectrum.error == pytest.approx(spectrum.error, rel=1e-3)
    assert not caplog.text
    with pytest.raises(RuntimeError, match=r"tolerance: got 2000000000\.0, wanted a fraction"):
        mi.load_dict({**BLAZE, "tolerance": 2e9})


@EACH
def test_series_of_all_lengths_share_a_kernel(kind):
    whole, wi = spectrum("crossed", kind, 3.0), direction(20, 40)
    wo = towards(wi, np.random.default_rng(3).uniform(-0.5, 0.5, (60, 2)), 500)
    launched = set()
    for count in (2, 3, 5, len(whole.table.terms)):
        table = dataclasses.replace(whole.table, terms=whole.table.terms[:count])
        shorter = raw_plugin(dataclasses.replace(whole, table=table))
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            evaluate(shorter, wi, wo, [500.0] * 4)
            history = dr.kernel_history((dr.KernelType.JIT,))
        launched.add(max(history, key=lambda kernel: len(kernel["ir"].getvalue()))["hash"])
    assert len(launched) == 1


def test_a_scene_gives_terms_as_text(tmp_path):
    scene = {**BLAZE, "representation": "taylor"}
    assert len(mi.load_dict({**scene, "terms": "30"}).spectrum.table.terms) == 30
    needed = mi.load_dict(scene).spectrum.settings.terms
    assert mi.load_dict({**scene, "terms": "auto"}).spectrum.settings.terms == needed < 20
    assert mi.load_dict({**BLAZE, "terms": "auto"}).spectrum.representation == "slices"


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"representation": "taylor", "terms": "0"}, "terms: got 0, wanted a whole number from 1 to 999"),
        ({"representation": "taylor", "terms": "many"}, "terms: got 'many', wanted a whole number"),
        ({"representation": "svd"}, "representation: got 'svd'"),
        ({"terms": 20}, "terms: got 20 with representation 'auto'"),
        ({"representation": "taylor", "terms": 0}, "terms: got 0"),
        (
            {"profile": "elaphe_synthetic", "size": 8.0, "patches": 2, "representation": "taylor"},
            "2 patches, wanted 'slices'",
        ),
    ],
)
def test_wrong_requests_are_refused(parameters, text):
    scene = {**BLAZE, **parameters}
    if "profile" in parameters:
        del scene["period"], scene["depth"]
    with pytest.raises(RuntimeError, match=text):
        mi.load_dict(scene)


def test_a_saved_spectrum_takes_no_representation(tmp_path):
    spectrum("blazed", "taylor").save(tmp_path / "saved.exr")
    scene = {"type": "diffraction_grating", "filename": str(tmp_path / "saved.exr"), "material": "Al"}
    assert mi.load_dict(scene).spectrum.representation == "taylor"
    with pytest.raises(
        RuntimeError, match=r"representation: got taylor with .*, wanted it when the spectrum is computed"
    ):
        mi.load_dict({**scene, "representation": "taylor"})
