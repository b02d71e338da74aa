"""The BSDF of rigorous efficiencies, against its table in float64 and against the solver."""

import dataclasses
from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import check_chi_square, direction, evaluate, interaction, made_up, random_directions, use, vectors

import mitsuba_diffraction as md
from mitsuba_diffraction.bsdf import testing
from mitsuba_diffraction.optics.geometry import fresnel, horizon_gain
from mitsuba_diffraction.optics.refractive_indices import index_of
from mitsuba_diffraction.rigorous.rigorous_spectrum import RigorousSpectrum
from mitsuba_diffraction.rigorous.solver import mueller
from mitsuba_diffraction.settings import RigorousSettings

SURFACE = {"profile": "blazed", "period": 0.3, "depth": 0.05, "samples": 64}
SETTINGS = {"theory": "rigorous", "int_ior": 1.5, "wavelengths": [400.0, 500.0], "tolerance": 0.02, "polarised": True}
WAVELENGTHS = (405.0, 440.0, 470.0, 498.0)


def toml(value):
    return "true" if value is True else repr(value)


@pytest.fixture(scope="module")
def recipe_file(tmp_path_factory):
    """Return a recipe of a grating of 0.3 µm, which has the orders −1, 0 and 1."""
    path = tmp_path_factory.mktemp("rigorous") / "fine.toml"
    tables = {"surface": SURFACE, "spectrum": SETTINGS}
    lines = [
        f"[{name}]\n" + "".join(f"{k} = {str(v).lower() if v is True else repr(v)}\n" for k, v in table.items())
        for name, table in tables.items()
    ]
    path.write_text("".join(lines), encoding="utf-8")
    return path


@pytest.fixture(scope="module")
def solved(recipe_file):
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("mitsuba_diffraction.rigorous.build_table.CHECK_COUNT", 40)
        return md.Recipe.load(recipe_file).cached()


@pytest.fixture(scope="module", params=["solved", "made up", "made up, wide lobes"])
def spectrum(request):
    if request.param == "solved":
        return request.getfixturevalue("solved")
    return made_up(3.0 if "wide" in request.param else 65.0)


def plugin(spectrum, **parameters):
    return mi.load_dict({"type": "diffraction_grating", "spectrum": spectrum, **parameters})


def test_instances_of_one_table_share_it(llvm):
    one, other = (plugin(made_up(3.0)).layers.grating.theory.scattering for _ in range(2))
    assert one is other


def expected(spectrum, wi, wo, wavelength):
    """Return f = Σ_m η_m N(q − m/T; σ_q² I)/λ² in float64, with gains; wi, wo (n, 3), λ in µm."""
    axes, sigma = spectrum.axes, spectrum.lobe_width
    nu = axes.period / wavelength
    k_y, c = ((wo - wi)[:, i] * nu / 2 for i in (1, 0))
    g, q = np.sqrt(nu**2 - k_y**2), -(wi + wo)[:, :2] / wavelength
    f = np.zeros(len(wi))
    for m in range(-axes.max_order, axes.max_order + 1):
        square = ((q - [m / axes.period, 0]) ** 2).sum(1)
        lobe = np.exp(-square / (2 * sigma**2)) / (2 * np.pi * sigma**2 * -np.expm1(-(spectrum.cutoff_sigmas**2) / 2))
        lobe = np.where(square <= (spectrum.cutoff_sigmas * sigma) ** 2, lobe, 0)
        shift = [wavelength * m / axes.period, 0]
        of_order = [1 - ((omega[:, :2] + shift) ** 2).sum(1) for omega in (wi, wo)]
        for s, omega in zip(of_order, (wi, wo), strict=True):
            lobe *= np.where(s > 0, horizon_gain(np.minimum(s, omega[:, 2] ** 2) / (2 * wavelength * sigma)), 0)
        f += np.maximum(spectrum.evaluate(m, c, g, wavelength), 0) * lobe
    return f / wavelength**2


def pairs(spectrum, wavelength, count=400):
    """Return pairs of directions in the lobes of propagating orders."""
    rng = np.random.default_rng(7)
    wi = random_directions(rng, count)
    m = rng.integers(-spectrum.axes.max_order, spectrum.axes.max_order + 1, count)
    q = np.stack([m / spectrum.axes.period, 0 * m], axis=-1) + spectrum.lobe_width * rng.normal(size=(count, 2))
    t = -wavelength * q - wi[:, :2]
    there = (t**2).sum(1) < 0.99
    wi, t = wi[there], t[there]
    return wi, np.concatenate([t, np.sqrt(1 - (t**2).sum(1, keepdims=True))], axis=1)


@pytest.mark.few(4)
def test_f_is_the_sum_over_the_orders(llvm, spectrum):
    wi, wo = pairs(spectrum, 0.47, 400)
    value, _ = testing.evaluate_pdf(plugin(spectrum), wi, wo, (470.0,) * 4)
    wanted = expected(spectrum, wi, wo, 0.47) * wo[:, 2]
    assert wanted.max() > 0
    np.testing.assert_allclose(value[:, 0], wanted, rtol=5e-3, atol=1e-3 * wanted.max())


@pytest.mark.few(3)
@pytest.mark.parametrize("theta", [0, 40, 75, 88])
def test_samples_have_even_weights_that_average_to_the_efficiencies(llvm, spectrum, theta):
    wi = direction(theta, 30)
    for wavelength in (405.0, 470.0):
        _, weights, _ = testing.sample(plugin(spectrum), np.broadcast_to(wi, (100_000, 3)), (wavelength,) * 4, 1)
        weights = weights[:, 0]
        albedo = weights.mean()
        _, eta = spectrum.efficiencies(wi, wavelength * 1e-3)
        # Wide lobes extend below the horizon, where samples are lost.
        if spectrum.coherence_length > 10 and theta <= 75:
            assert albedo == pytest.approx(np.maximum(eta, 0).sum(), rel=0.03)
            assert albedo**2 / (weights**2).mean() >= 0.7
        assert albedo <= 1 + 1e-3


@pytest.mark.few(1)
@pytest.mark.parametrize("theta", [0, 40, 75])
def test_samples_pass_the_chi_square_test(llvm, solved, theta):
    wide = dataclasses.replace(solved, settings=dataclasses.replace(solved.settings, coherence_length=3.0))
    check_chi_square(plugin(wide, orientation=20.0), direction(theta, 20), WAVELENGTHS)
    check_chi_square(plugin(made_up(3.0), orientation=20.0), direction(theta, 20))


@pytest.mark.few(1)
@pytest.mark.parametrize("theta", [40, 0, 75])
def test_polarised_samples_pass_the_chi_square_test(solved, theta):
    use("llvm_ad_spectral_polarized")
    wide = dataclasses.replace(solved, settings=dataclasses.replace(solved.settings, coherence_length=3.0))
    check_chi_square(plugin(wide, orientation=20.0), direction(theta, 20), WAVELENGTHS)


def test_the_albedo_is_that_of_the_solver(llvm, solved):
    """Computed by samples, at directions and wavelengths that are not nodes."""
    for theta, phi, wavelength in ((10, 20, 412.0), (50, 70, 450.0), (70, 0, 490.0)):
        wi = direction(theta, phi)
        _, weights, _ = testing.sample(plugin(solved), np.broadcast_to(wi, (40_000, 3)), (wavelength,) * 4, 2)
        exact = md.rigorous.efficiencies(md.gratings.blazed(0.3, 0.05, samples=64), wi, wavelength * 1e-3, int_ior=1.5)
        assert weights[:, 0].mean() == pytest.approx(exact.unpolarised.sum(), rel=0.05)


def test_a_profile_by_formula_is_built_in_the_scene(llvm, monkeypatch):
    """The table has few nodes, and is not checked."""
    monkeypatch.setattr("mitsuba_diffraction.rigorous.build_table.SOLVED_STEPS", ((6, 8, 6),))
    monkeypatch.setattr("mitsuba_diffraction.rigorous.build_table.CHECK_COUNT", 10)
    fine = {"type": "diffraction_grating", "profile": "sinusoidal", "period": 0.2, "depth": 0.05, "samples": 32}
    bsdf = mi.load_dict({**fine, "theory": "rigorous", "int_ior": 1.5, "ext_ior": 1.0, "tolerance": 0.9})
    wi = direction(30, 20)
    _, weights, _ = testing.sample(bsdf, np.broadcast_to(wi, (20_000, 3)), (600.0,) * 4, 3)
    exact = md.rigorous.efficiencies(md.gratings.sinusoidal(0.2, 0.05, samples=32), wi, 0.6, int_ior=1.5)
    assert weights[:, 0].mean() == pytest.approx(exact.unpolarised.sum(), rel=0.1)
    assert "rigorous" in str(bsdf)


def test_files_recipes_and_profiles_have_equal_values(llvm, solved, recipe_file, tmp_path):
    saved = tmp_path / "fine.exr"
    solved.save(saved)
    wi, wo = direction(30, 10), -direction(30, 10) * [1, 1, -1]
    found = [
        evaluate(mi.load_dict({"type": "diffraction_grating", **surface}), wi, wo, wavelengths=WAVELENGTHS)[0]
        for surface in ({"spectrum": solved}, {"filename": str(saved)}, {"filename": str(recipe_file), "int_ior": 1.5})
    ]
    assert found[0].min() > 0
    for other in found[1:]:
        np.testing.assert_array_equal(other, found[0])


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"height_scale": 0.5}, "height_scale: got 0.5, wanted none with theory=rigorous: build the spectrum"),
        ({"shadowing": "none"}, "shadowing: got 'none', wanted none with theory=rigorous"),
        ({"conserve_energy": False}, "conserve_energy: got False, wanted none with theory=rigorous"),
        ({"tolerance": 0.1}, "tolerance: got 0.1 with a spectrum from Python, wanted it when the spectrum is computed"),
        ({"representation": "taylor"}, "representation: got taylor with a spectrum from Python"),
        ({"base": {"type": "diffuse"}}, "base: got a BSDF, wanted none with theory=rigorous"),
        ({"eta": 1.2, "k": 7.0}, "eta: got 1.2, wanted none with theory=rigorous: the spectrum has the index of its"),
        ({"eta": {"type": "uniform", "value": 1.2}}, "eta: got a texture, wanted none with theory=rigorous"),
        ({"material": "Al"}, "got material Al, but the rigorous spectrum is of int_ior 1.5"),
        ({"int_ior": 1.6}, "got int_ior 1.59956, but the rigorous spectrum is of int_ior 1.5"),
        ({"material": "none"}, "material: got 'none', wanted a real one for theory=rigorous"),
        ({"theory": "scalar"}, "theory: got 'scalar' with a spectrum of rigorous theory"),
        ({"theory": "vector"}, "theory: got 'vector', wanted one of scalar, rigorous"),
    ],
)
def test_parameters_of_scalar_theory_are_refused(llvm, solved, parameters, text):
    with pytest.raises(RuntimeError, match=text):
        plugin(solved, **parameters)


def test_a_table_is_of_the_index_in_a_file_wherever_that_lies(llvm, tmp_path):
    (tmp_path / "first").mkdir()
    table = tmp_path / "first" / "metal.spd"
    table.write_text("300 0.5 3\n900 0.6 4\n")
    settings = RigorousSettings(material="metal.spd", tolerance=0.01)
    spectrum = dataclasses.replace(made_up(), settings=settings, index_digest=index_of("material", str(table)).digest)
    spectrum.save(tmp_path / "first" / "table.exr")
    moved = (tmp_path / "first").rename(tmp_path / "second")
    scene = {"type": "diffraction_grating", "filename": str(moved / "table.exr"), "material": str(moved / "metal.spd")}
    assert "material metal.spd" in str(mi.load_dict(scene))
    (moved / "metal.spd").write_text("300 0.5 3\n900 0.6 5\n")
    with pytest.raises(RuntimeError, match=r"material: got material .*metal.spd, but the rigorous spectrum is of"):
        mi.load_dict(scene)


def test_surfaces_of_several_rows_are_refused(llvm):
    with pytest.raises(RuntimeError, match="rows that differ, wanted a surface that does not change along y"):
        mi.load_dict({"type": "diffraction_grating", "profile": "foil", "theory": "rigorous", "material": "Al"})


def test_the_rigorous_recipes_are_of_one_row():
    found = sorted((Path(__file__).parents[2] / "precompute" / "rigorous").glob("*.toml"))
    assert len(found) == 6
    for recipe in map(md.Recipe.load, found):
        assert recipe.height_field().shape[0] == 1
        assert recipe.settings.theory == "rigorous"


@pytest.mark.slow
@pytest.mark.parametrize("name", ["dvd_grooves", "foil_one_direction", "ruled_1200"])
def test_a_rigorous_recipe_keeps_its_tolerance(name):
    """Each takes minutes; `ruled_600` takes half an hour, its error is in precompute/README.md."""
    spectrum = md.Recipe.load(Path(__file__).parents[2] / "precompute" / "rigorous" / f"{name}.toml").build()
    assert spectrum.error <= spectrum.tolerance == 1e-2


# ---------------------------------------------------------------- polarised light


def entries(matrix):
    """Return the matrix at the first wavelength, (4, 4)."""
    dr.eval(matrix)  # in one kernel
    return np.array([[np.ravel(matrix[i, j][0])[0] for j in range(4)] for i in range(4)])


def mueller_of(bsdf, source, exit_, wavelength):
    """Return the Mueller matrix, (4, 4), for light from `source` to `exit_`, wavelength in nm."""
    return entries(bsdf.eval(mi.BSDFContext(), interaction(exit_, (wavelength,) * 4, 1), vectors(source)))


def between_stokes_axes(matrix, source, exit_):
    """Return a matrix between Mitsuba's axes from one between (ŝ, k̂ × ŝ), ŝ = ẑ × k̂."""
    full = mi.Spectrum(0.0)
    for i, j in np.ndindex(4, 4):
        full[i, j] = mi.UnpolarizedSpectrum(float(matrix[i, j]))
    axes = [vectors(np.cross([0, 0, 1], k) / np.linalg.norm(k[:2])) for k in (-source, exit_)]
    came, leaves = vectors(-source), vectors(exit_)
    return entries(
        mi.mueller.rotate_mueller_basis(
            full, came, axes[0], mi.mueller.stokes_basis(came), leaves, axes[1], mi.mueller.stokes_basis(leaves)
        )
    )


def test_mueller_matrices_of_a_plane_are_mitsubas():
    """Including the signs of circular polarisation."""
    use("llvm_ad_spectral_polarized")
    cosine, index = 0.6, 0.8 + 6j
    omega = np.sqrt(1 - cosine**2), 0, cosine
    found = md.rigorous.efficiencies(md.gratings.sinusoidal(0.3, 0.0, samples=64), omega, 0.45, int_ior=index)
    wanted = mi.mueller.specular_reflection(cosine, mi.Complex2f(index.real, index.imag))
    wanted = [[float(np.ravel(wanted[i, j])[0]) for j in range(4)] for i in range(4)]
    np.testing.assert_allclose(mueller(found.amplitudes[found.orders == 0][0]), wanted, atol=1e-5)


@pytest.mark.slow
def test_polarised_light_is_split_as_by_the_solver(solved):
    """Conical incidence at all azimuths, on a rotated pattern."""
    use("llvm_ad_spectral_polarized")
    surface, bsdf = md.gratings.blazed(0.3, 0.05, samples=64), plugin(solved, orientation=25.0)
    sin, cos = np.sin(np.deg2rad(25)), np.cos(np.deg2rad(25))
    turn = np.array([[cos, sin, 0], [-sin, cos, 0], [0, 0, 1]])
    differences = []
    for theta, phi in ((20, 10), (35, 100), (50, 200), (60, 310), (40, 65)):
        wi = direction(theta, phi)
        exact = md.rigorous.efficiencies(surface, turn @ wi, 0.45, int_ior=1.5)
        for m, amplitudes in zip(exact.orders, exact.amplitudes, strict=True):
            xy = np.array([-m * 0.45 / 0.3, 0]) - (turn @ wi)[:2]
            wo = turn.T @ [*xy, np.sqrt(1 - xy @ xy)]
            wanted = between_stokes_axes(mueller(amplitudes).real, wi, wo)
            found = mueller_of(bsdf, wi, wo, 450.0)
            share = exact.unpolarised[exact.orders == m][0] / exact.unpolarised.sum()
            found, wanted = found / found[0, 0], wanted / wanted[0, 0]
            differences.append(share * np.abs(found - wanted).max())
    assert max(differences) < 0.06


@pytest.mark.parametrize("variant", ["llvm_ad_spectral_polarized"])
def test_unpolarised_light_is_that_of_variants_without_polarisation(variant, solved):
    wi, wo = (omega[:6] for omega in pairs(solved, 0.47, 60))
    use("llvm_ad_spectral")
    wanted = testing.evaluate_pdf(plugin(solved), wi, wo, (470.0,) * 4)[0][:, 0]
    use(variant)
    bsdf = plugin(solved)
    # `evaluate_pdf` has the cosine of the light's direction, ω_o of the BSDF.
    matrices = np.array([mueller_of(bsdf, b, a, 470.0) for a, b in zip(wi, wo, strict=True)])
    np.testing.assert_allclose(matrices[:, 0, 0], wanted, rtol=1e-4, atol=1e-4 * wanted.max())
    # No light is more than polarised.
    for kind in (1, 2, 3):
        for sign in (-1, 1):
            out = matrices[:, :, 0] + sign * matrices[:, :, kind]
            assert (np.linalg.norm(out[:, 1:], axis=1) <= (1 + 2 * solved.polarisation_error) * out[:, 0]).all()


@pytest.mark.slow
def test_unpolarised_light_is_at_most_polarised_between_the_nodes_of_a_table(solved):
    use("llvm_ad_spectral_polarized")
    wi, wo = pairs(solved, 0.47, 2000)
    si = interaction(wi, (470.0,) * 4, len(wi))
    value = plugin(solved).eval(mi.BSDFContext(), si, vectors(wo))
    column = np.array([np.broadcast_to(np.array(value[i, 0])[0], len(wi)) for i in range(4)])
    bright = column[0] > 1e-6 * column[0].max()
    assert (np.linalg.norm(column[1:], axis=0)[bright] <= (1 + 1e-4) * column[0][bright]).all()


def test_a_table_of_unpolarised_light_is_refused_in_polarised_variants():
    use("llvm_ad_spectral_polarized")
    with pytest.raises(RuntimeError, match="wanted one that was built with polarised=True"):
        plugin(made_up())


# ---------------------------------------------------------------- under a coat


def under_coat(spectrum, **parameters):
    """Return a grating under a coat of index 1.5, with the table as if built for it: wavelengths outside are longer."""
    spectrum = dataclasses.replace(spectrum, settings=dataclasses.replace(spectrum.settings, ext_ior=1.5))
    return plugin(spectrum, **{"coat_ior": 1.5, "ext_ior": 1.0, **parameters})


def albedo_under_coat(spectrum, theta, phi, wavelength, efficiencies):
    """Return the albedo by samples, and F + Σ_m T_i T_o η_m; η(ω inside, λ inside), wavelength in µm."""
    wi = direction(theta, phi)
    inside = np.array([*wi[:2] / 1.5, np.sqrt(1 - (wi[:2] @ wi[:2]) / 2.25)])
    orders, eta = efficiencies(inside, wavelength / 1.5)
    square = (wi[0] + orders * wavelength / spectrum.axes.period) ** 2 + wi[1] ** 2
    leaves = square < 1
    front, back = (np.mean(fresnel(cosine, 1.5), axis=0) for cosine in (wi[2], np.sqrt(1 - square[leaves])))
    _, weights, _ = testing.sample(under_coat(spectrum), np.broadcast_to(wi, (40_000, 3)), (wavelength * 1e3,) * 4, 2)
    return weights[:, 0].mean(), front + ((1 - front) * (1 - back) * eta[leaves]).sum()


@pytest.mark.parametrize(("theta", "phi", "wavelength"), [(10, 20, 0.6), (50, 70, 0.7), (65, 0, 0.8)])
def test_a_coat_transmits_the_efficiencies_of_the_table(llvm, theta, phi, wavelength):
    found, wanted = albedo_under_coat(made_up(), theta, phi, wavelength, made_up().efficiencies)
    assert found == pytest.approx(wanted, rel=0.03)


@pytest.mark.slow
def test_a_coat_transmits_the_efficiencies_of_the_solver(llvm):
    surface, settings = md.gratings.blazed(0.3, 0.05, samples=64), {"material": "Al", "wavelengths": (270.0, 330.0)}
    metal = md.precompute(surface, theory="rigorous", ext_ior=1.5, tolerance=0.2, **settings)

    def efficiencies(omega, wavelength):
        index = md.rigorous.refractive_index(1.5 * wavelength, material="Al") / 1.5
        exact = md.rigorous.efficiencies(surface, omega, wavelength, int_ior=index)
        return exact.orders, exact.unpolarised

    for theta, phi, wavelength in ((10, 20, 0.412), (50, 70, 0.45), (65, 0, 0.48)):
        found, wanted = albedo_under_coat(metal, theta, phi, wavelength, efficiencies)
        assert found == pytest.approx(wanted, rel=0.03)
        assert found < 1


@pytest.mark.few(1)
@pytest.mark.parametrize("theta", [40, 0, 75])
def test_samples_under_a_coat_pass_the_chi_square_test(llvm, theta):
    check_chi_square(under_coat(made_up(3.0)), direction(theta, 20), (600.0, 700.0, 800.0, 900.0))


def test_unpolarised_light_is_polarised_under_a_coat(solved):
    """Against the product of the matrices of both refractions and of the grating."""
    use("llvm_ad_spectral_polarized")
    wi = direction(50, 70)
    wo = wi * [-1, -1, 1]
    found = mueller_of(under_coat(solved), wo, wi, 675.0)
    assert 0.02 < np.linalg.norm(found[1:, 0]) / found[0, 0] < 1
    # Without polarisation the mean transmittance of each face is taken, not that of s and of p.
    use("llvm_ad_spectral")
    plain = testing.evaluate_pdf(under_coat(solved), wi[None], wo[None], (675.0,) * 4)[0][0, 0]
    assert found[0, 0] == pytest.approx(plain, rel=0.1)


@pytest.mark.parametrize(
    ("parameters", "text"),
    [
        ({"coat_ior": 1.0}, "coat_ior: got none, but the rigorous spectrum is of .* below a medium of index 1.5"),
        ({"coat_ior": 1.6}, r"coat_ior: got 1\.6, but .* build it with ext_ior=1\.6"),
    ],
)
def test_a_spectrum_for_another_coat_is_refused(llvm, parameters, text):
    with pytest.raises(RuntimeError, match=text):
        under_coat(made_up(), **parameters)


def test_a_grating_is_built_for_the_coat_and_the_variant_of_the_scene(monkeypatch):
    """Checks the requested settings, as the table would take minutes."""
    use("llvm_ad_spectral_polarized")
    requested = []
    monkeypatch.setattr(md.Recipe, "cached", lambda recipe, *_: requested.append(recipe.settings.chosen) or made_up())
    scene = {"type": "diffraction_grating", "profile": "sinusoidal", "period": 0.3, "depth": 0.05, "theory": "rigorous"}
    for material in ({"material": "Al"}, {"int_ior": 1.8}):
        with pytest.raises(RuntimeError, match="polarised=True"):
            mi.load_dict({**scene, "coat_ior": 1.5, "ext_ior": 1.0, **material})
    assert [settings.pop("wavelengths") for settings in requested] == [(240.0, pytest.approx(830 / 1.5))] * 2
    assert requested == [
        {"theory": "rigorous", "material": "Al", "ext_ior": 1.5, "polarised": True},
        {"theory": "rigorous", "int_ior": 1.8, "ext_ior": 1.5, "polarised": True},
    ]


def test_precompute_warns_of_inaccurate_scalar_theory(command, tmp_path):
    recipe = tmp_path / "fine.toml"
    recipe.write_text('[surface]\nprofile = "sinusoidal"\nperiod = 0.71\ndepth = 0.3\nsamples = 64\n')
    code, out, _ = command("precompute", str(recipe), "-o", str(tmp_path / "fine.exr"))
    assert code == 0
    assert "! scalar theory: errs by" in out


def test_a_period_too_long_for_the_table_is_refused():
    with pytest.raises(ValueError, match=r"period: got 20 µm, wanted at most 3\.6 µm with theory=rigorous, 10 times"):
        md.precompute(md.gratings.sinusoidal(20.0, 0.1), theory="rigorous", material="Al")


@pytest.mark.slow
def test_precompute_writes_a_recipes_rigorous_spectrum(command, tmp_path):
    recipe, target = tmp_path / "moth_eye.toml", tmp_path / "moth_eye.exr"
    recipe.write_text(
        '[surface]\nprofile = "sinusoidal"\nperiod = 0.19\ndepth = 0.05\nsamples = 32\n'
        '[spectrum]\ntheory = "rigorous"\nint_ior = 1.5\nwavelengths = [400, 500]\ntolerance = 0.5\n',
        encoding="utf-8",
    )
    code, out, _ = command("precompute", str(recipe), "-o", str(target))
    assert code == 0
    assert "int_ior 1.5, rigorous theory" in out
    saved = RigorousSpectrum.load(target)
    assert (saved.medium_text, saved.mueller) == ("int_ior 1.5", None)
    # Values stand in for the recipe's.
    scalar = tmp_path / "scalar.toml"
    scalar.write_text('[surface]\nprofile = "sinusoidal"\nperiod = 0.19\ndepth = 0.05\nsamples = 32\n')
    values = "theory=rigorous,material=Al,ext_ior=1.5,polarised=true,tolerance=0.9"
    code, _, err = command("precompute", f"{scalar},{values}", "-o", str(tmp_path / "metal.exr"))
    assert (code, len(err.splitlines())) == (2, 1)
    assert "inside ext_ior=1.5: light of 360 to 830 nm in air has 240 to 553" in err
    values += ",wavelengths=240,wavelengths=553"
    code, out, _ = command("precompute", f"{scalar},{values}", "-o", str(tmp_path / "metal.exr"))
    assert code == 0
    assert "material Al below ext_ior 1.5, rigorous theory" in out
    assert "Mueller matrices, mean " in RigorousSpectrum.load(tmp_path / "metal.exr").details
    code, _, err = command("precompute", f"{scalar},theory=vector", "-o", str(tmp_path / "gone.exr"))
    assert (code, len(err.splitlines())) == (2, 1)
    assert "theory: got 'vector', wanted one of scalar, rigorous" in err
    content = bytearray(target.read_bytes())
    content[-200] ^= 1
    target.write_bytes(content)
    with pytest.raises(ValueError, match="its SHA-256 is wrong or missing"):
        RigorousSpectrum.load(target)
