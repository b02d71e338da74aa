"""Light that a scene has and a table lacks: the grating covers it, or the scene is refused; it is never black."""

import re

import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import albedo, direction, made_up, plugin

import mitsuba_diffraction as md
from mitsuba_diffraction.bsdf.base import gratings_in
from mitsuba_diffraction.bsdf.light import _emits, is_black
from mitsuba_diffraction.precomputation.surface_text import written
from mitsuba_diffraction.settings import ScalarSettings

WAVELENGTHS = (450.0, 530.0, 600.0, 700.0)
PROFILE = {"type": "diffraction_grating", "profile": "sinusoidal", "period": 2.5, "depth": 0.25}
GRATING = {**PROFILE, "coherence_length": 4.0}
WHITE = {"type": "uniform", "value": 1.0}


def spectrum(*wavelengths):
    return md.precompute(md.gratings.sinusoidal(2.5, 0.25), wavelengths=wavelengths, coherence_length=4.0)


def scene(bsdf, film=None, light=WHITE):
    """Return a scene of one grating under a sky; film: (shortest, longest) wavelength of its band."""
    camera = {"type": "hdrfilm", "width": 2, "height": 2}
    if film:
        band = {"type": "regular", "wavelength_min": film[0], "wavelength_max": film[1], "values": "1, 1"}
        camera |= {"type": "specfilm", "band": band}
    view = mi.ScalarTransform4f().look_at([0, 0, 3], [0, 0, 0], [0, 1, 0])
    return {
        "type": "scene",
        "integrator": {"type": "path"},
        "sensor": {"type": "orthographic", "to_world": view, "film": camera},
        "light": {"type": "constant", "radiance": light},
        "grating": {"type": "rectangle", "bsdf": bsdf},
    }


def mean(bsdf, film):
    """Return the mean of the radiance per nm that a film records of a BSDF under a white sky."""
    return np.array(mi.render(mi.load_dict(scene(bsdf, film)), spp=1024)).mean() / (film[1] - film[0])


@pytest.mark.parametrize("coat", [pytest.param({}, marks=pytest.mark.slow), {"coat_ior": 1.3}])
def test_a_spectrum_for_shorter_wavelengths_holds_for_longer_ones(llvm, coat):
    # Regression: a spectrum built for a coat of 1.55 and used with a thinner one, or none, was black above 535 nm.
    short, exact = (spectrum(360 / n, 830 / n) for n in (1.55, 1.3 if coat else 1.0))
    metal = {"material": "Al", "conserve_energy": False, **coat}
    found, wanted = (albedo(plugin(s, **metal), direction(20, 40), wavelengths=WAVELENGTHS) for s in (short, exact))
    np.testing.assert_allclose(found, wanted, rtol=0.01)


@pytest.mark.slow
def test_a_lower_index_is_not_black(llvm):
    # Regression: lowered from 2.4 to 1.5, nothing was transmitted above 530 nm.
    grating = {**GRATING, "transmission": "interface", "conserve_energy": False}
    lowered, wanted = (mi.load_dict({**grating, "int_ior": n}) for n in (2.4, 1.5))
    parameters = mi.traverse(lowered)
    parameters["eta"] = 1.5
    parameters.update()
    values = (albedo(bsdf, direction(20, 40), wavelengths=WAVELENGTHS) for bsdf in (lowered, wanted))
    np.testing.assert_allclose(*values, rtol=0.02)


@pytest.mark.slow
def test_a_film_of_infrared_or_ultraviolet_light_is_not_black(llvm):
    # Regression: near infrared light was black, without a word.
    flat = {**GRATING, "depth": 0.05, "material": "none"}
    for film in ((850, 950), (320, 330)):
        assert mean(flat, film) == pytest.approx(1, abs=0.02)
    metal, mirror = (mean({**bsdf, "material": "Al"}, (840, 880)) for bsdf in (flat, {"type": "conductor"}))
    assert metal == pytest.approx(mirror, abs=0.02)


def test_light_that_a_table_lacks_is_refused_with_its_range(llvm):
    of = {"type": "diffraction_grating", "conserve_energy": False}  # no table of E, which takes long
    saved, visible = ({**of, "spectrum": spectrum(*w)} for w in ((500, 600), (360, 830)))
    metal = {**GRATING, **of, "material": "Al"}
    for bsdf, film, message in (
        (saved, None, r"light from 360 nm, .* from 500 nm: build it from 36"),
        (visible, (300, 400), r"light from 300 nm, .* from 360 nm: build it from 300"),
        (metal, (850, 950), r"material: got light of 850 to 950 nm, and a table of 298.757 to 885.601 nm \(Al\)"),
        ({"type": "twosided", "bsdf": metal}, (850, 950), "material: got light of 850 to 950 nm"),
    ):
        with pytest.raises(RuntimeError, match=message) as found:
            mi.load_dict(scene(bsdf, film))
        assert "\n" not in str(found.value)


@pytest.fixture
def few_steps(monkeypatch):
    """Of tables whose values are not looked at."""
    monkeypatch.setattr("mitsuba_diffraction.rigorous.build_table.SOLVED_STEPS", ((6, 8, 6),))
    monkeypatch.setattr("mitsuba_diffraction.rigorous.build_table.CHECK_COUNT", 10)


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:rigorous table")
def test_a_rigorous_spectrum_is_refused_outside_its_wavelengths(llvm, few_steps):
    settings = {"theory": "rigorous", "int_ior": 1.5, "tolerance": 0.2, "coherence_length": 40.0}
    of = md.precompute(md.gratings.sinusoidal(1.0, 0.1), wavelengths=(500, 600), **settings)
    bsdf = {"type": "diffraction_grating", "spectrum": of}
    with pytest.raises(RuntimeError, match=r"light of 360 to 830 nm and a rigorous spectrum of 500 to 600 nm: build"):
        mi.load_dict(scene(bsdf))
    mi.load_dict(scene(bsdf, (510, 590)))


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:rigorous table")
def test_below_a_coat_a_rigorous_spectrum_is_refused_with_the_wavelengths_that_it_needs(llvm, few_steps):
    # Regression: light of 360 to 830 nm was refused with "build it for wavelengths=(360, 830)", those of the spectrum.
    settings = {"theory": "rigorous", "material": "Al", "ext_ior": 1.5, "tolerance": 0.2, "coherence_length": 40.0}
    of = md.precompute(md.gratings.sinusoidal(0.7, 0.1), wavelengths=(300, 590), **settings)
    with pytest.raises(RuntimeError, match=r"those inside of the index 1\.4") as refused:
        mi.load_dict(scene({"type": "diffraction_grating", "spectrum": of, "material": "Al", "coat_ior": 1.5}))
    first, last = map(float, re.search(r"=\((.*), (.*)\)", str(refused.value)).groups())
    assert (first, last) == pytest.approx((360 / 1.5, 830 / 1.5), rel=1e-3)


def test_wavelengths_without_light_need_no_table(llvm):
    line = {"type": "regular", "wavelength_min": 530.0, "wavelength_max": 534.0, "values": "1, 1"}
    grating = {"type": "diffraction_grating", "spectrum": spectrum(500, 600)}
    loaded = mi.load_dict(scene(grating, light=line))
    (bsdf,) = {bsdf for shape in loaded.shapes() for bsdf in gratings_in(shape.bsdf())}
    shortest, longest = bsdf.layers.grating.theory.light
    assert 500 <= shortest <= 530 < 534 <= longest


def test_a_table_that_ends_a_fraction_of_a_nanometre_before_the_light_is_refused(llvm):
    # Regression: an error of Dr.Jit, as no wavelength was tried between them.
    grating = {"type": "diffraction_grating", "spectrum": spectrum(360.1, 830)}
    with pytest.raises(RuntimeError, match=r"got light from 360 nm, and a spectrum for wavelengths from 360\.1 nm"):
        mi.load_dict(scene(grating))
    band = {"type": "regular", "wavelength_min": 360.1, "wavelength_max": 830.0, "values": "1, 1"}
    mi.load_dict(scene(grating, light=band))


def test_a_white_surface_is_not_black_in_a_narrow_band(llvm):
    # Regression: no wavelength was tried.
    assert not is_black(mi.load_dict({"type": "diffuse"}), 550.0, 550.1)


def test_a_spectrum_that_is_not_of_the_emission_does_not_make_a_light_dark(llvm):
    """`sunsky` has one, the albedo of the ground; its light needs a table all the same."""
    built = mi.load_dict({"type": "scene", "sky": {"type": "sunsky", "albedo": 0.0}})
    assert _emits(built.emitters()[0], 600, 700)


@pytest.mark.parametrize("change", ["another sensor", "another light"])
def test_light_that_reaches_a_loaded_scene_is_not_black(llvm, change):
    # Regression: a picture by a sensor that was not in the scene, or of a light that had changed, was black.
    film, flat = (850, 950), {**GRATING, "depth": 0.05, "material": "none"}
    if change == "another sensor":
        loaded = mi.load_dict(scene(flat))
        sensor = mi.load_dict(scene(flat, film)["sensor"])
        picture = mi.render(loaded, sensor=sensor, spp=1024)
    else:
        dark = {"type": "irregular", "wavelengths": "300, 809, 810, 1000", "values": "1, 1, 0, 0"}
        loaded = mi.load_dict(scene(flat, film, dark))
        parameters = mi.traverse(loaded)
        parameters["light.radiance.values"] = [1.0] * 4
        parameters.update()
        picture = mi.render(loaded, spp=1024)
    assert np.array(picture).mean() / (film[1] - film[0]) == pytest.approx(1, abs=0.02)


def test_a_sensor_of_light_outside_a_table_is_refused(llvm):
    metal = {**GRATING, "conserve_energy": False, "material": "Al"}
    sensor = mi.load_dict(scene(metal, (850, 950))["sensor"])
    with pytest.raises(
        ValueError, match=r"material: got light of 850 to 950 nm, and a table of 298\.757 to 885\.601 nm"
    ):
        mi.render(mi.load_dict(scene(metal)), sensor=sensor, spp=1)


@pytest.mark.slow
def test_a_picture_in_infrared_leaves_the_scene_as_it_was(llvm):
    # Regression: its light replaced that of the scene, so that scales for which there is no table were accepted.
    loaded = mi.load_dict(scene({"type": "diffraction_grating", "spectrum": spectrum(360, 830), "material": "none"}))
    mi.render(loaded, sensor=mi.load_dict(scene(GRATING, (850, 950))["sensor"]), spp=1)
    parameters = mi.traverse(loaded)
    parameters["grating.bsdf.height_scale"] = 2.0
    with pytest.raises(ValueError, match="height_scale: got 2, wanted 0 to 1"):
        parameters.update()


def test_a_refused_sensor_leaves_the_scene_as_it_was(llvm):
    of = md.precompute(md.gratings.sinusoidal(2.5, 0.25), wavelengths=(300, 830), coherence_length=4.0)
    grating = {"type": "diffraction_grating", "spectrum": of, "material": "none", "conserve_energy": False}
    loaded = mi.load_dict(scene({**grating, "height_scale": 1.2}))
    with pytest.raises(ValueError, match=r"height_scale: got 1\.2, wanted 0 to 1\.033"):
        mi.render(loaded, sensor=mi.load_dict(scene(grating, (310, 355))["sensor"]), spp=1)
    parameters = mi.traverse(loaded)
    parameters["grating.bsdf.height_scale"] = 1.1
    parameters.update()


@pytest.mark.slow
def test_a_spectrum_for_ultraviolet_has_the_current_index(llvm):
    # Regression: the tables were made for the index of the scene at loading.
    glass = {**GRATING, "depth": 0.1, "transmission": "interface", "int_ior": 1.5}
    loaded, fresh = (mi.load_dict(scene({**glass, "int_ior": n})) for n in (1.5, 1.2))
    parameters = mi.traverse(loaded)
    parameters["grating.bsdf.eta"] = parameters["grating.bsdf.eta"] * (1.2 / 1.5)
    parameters.update()
    sensor = mi.load_dict(scene(glass, (250, 300))["sensor"])
    for one in (loaded, fresh):
        mi.render(one, sensor=sensor, spp=1)
    found, wanted = (albedo(one.shapes()[0].bsdf(), direction(45, 20) * [1, 1, -1]) for one in (loaded, fresh))
    np.testing.assert_allclose(found, wanted, rtol=0.02)


def test_visible_light_outside_a_saved_spectrum_is_refused_once_it_is_there(llvm):
    line = {"type": "irregular", "wavelengths": "360, 529, 530, 540, 541, 830", "values": "0, 0, 1, 1, 0, 0"}
    loaded = mi.load_dict(scene({"type": "diffraction_grating", "spectrum": spectrum(500, 600)}, light=line))
    mi.render(loaded, spp=1)
    parameters = mi.traverse(loaded)
    parameters["light.radiance.values"] = [1.0] * 6
    parameters.update()
    with pytest.raises(ValueError, match="light from 360 nm"):
        mi.render(loaded, spp=1)


def test_a_scene_without_a_sensor_is_refused_by_mitsuba(llvm):
    with pytest.raises(Exception, match="No sensor specified"):
        mi.render(mi.load_dict({"type": "scene", "integrator": {"type": "path"}, "shape": {"type": "sphere"}}))


def test_the_error_of_scalar_theory_is_that_of_the_light_and_logged_once(llvm, caplog):
    relief = {"profile": "crossed", "period": 2.5, "depth": 0.35, "samples": 64}
    settings = ScalarSettings(coherence_length=4.0, wavelengths=(240.0, 830.0), tolerance=0.1)
    fine = {"type": "diffraction_grating", "spectrum": md.Recipe(relief, settings).build(), "conserve_energy": False}

    def warnings_of(film=None, **parameters):
        caplog.clear()
        mi.load_dict(scene({**fine, **parameters}, film))
        return [message for record in caplog.records if "scalar theory" in (message := record.getMessage())]

    assert warnings_of() == []  # 12 % in visible light, within the range
    (infrared,) = warnings_of((1500.0, 1600.0))
    assert "scalar theory: errs by about 16% of the reflected light" in infrared
    assert "(mean over 1517–1583 nm and 0–20°, n = 1.5)" in infrared
    assert warnings_of((1500.0, 1600.0)) == []
    assert warnings_of((1500.0, 1600.0), coat_ior=1.5) == []  # 1000 to 1067 nm in the coat
    (of_metal,) = warnings_of((2200.0, 2300.0), material="none")
    assert "(mean over 2217–2283 nm and 0–20°, aluminium)" in of_metal


def flat(coherence_length):
    return {**GRATING, "depth": 0.0, "material": "none", "coherence_length": coherence_length, "conserve_energy": False}


@pytest.mark.parametrize(
    ("coherence_length", "film", "light"),
    [
        (0.1, None, 360),
        pytest.param(0.8, None, 830, marks=pytest.mark.slow),
        pytest.param(0.8, (400, 900), 900, marks=pytest.mark.slow),
    ],
)
def test_a_window_shorter_than_the_wavelength_is_refused(llvm, coherence_length, film, light):
    # Regression: of a coherence length of 0.1 µm, a flat mirror reflected 0.05 to 0.25.
    refusal = f"coherence_length: got {coherence_length:g} µm with light of {light} nm, wanted at least the wavelength"
    with pytest.raises(RuntimeError, match=refusal):
        mi.load_dict(scene(flat(coherence_length), film))


def test_the_light_of_the_scene_decides_on_the_shortest_window(llvm):
    assert mi.load_dict(scene(flat(0.8), (400, 780)))


@pytest.mark.slow
@pytest.mark.parametrize("theta", [0, 45, 75])
def test_a_flat_mirror_with_a_window_of_one_wavelength_reflects_nearly_all_light(llvm, theta):
    found = albedo(mi.load_dict(flat(0.7)), direction(theta, 0), wavelengths=[700.0] * 4)
    np.testing.assert_allclose(found, 1, atol=0.17)


def table(folder, name, rows):
    """The path of a table (λ in µm, n, k)."""
    path = folder / name
    path.write_text("wl,n,k\n" + "".join(f"{row}\n" for row in rows))
    return str(path)


ENDS = {
    "inside visible light": (["0.42,1.70,0", "0.68,1.60,0"], "420 to 680 nm"),
    "in the infrared": (["2,3.45,0", "5,3.42,0"], "2000 to 5000 nm"),
    "at its only row": (["0.5876,1.6,0"], "587.6 nm"),
}
# Parameters that name an index, with the file in the place of "{}"; R at normal incidence if its n is N.
N = 2.2
BELOW = 3.0


def of_films(*thicknesses):
    """R of films of the index N, or 1.5 for the first of several, on BELOW, over 3 to 3.2 µm."""
    found = []
    for wavelength in np.linspace(3.0, 3.2, 50):
        above, r = BELOW, 0.0
        for k, d in reversed(list(enumerate(thicknesses))):
            n = 1.5 if k < len(thicknesses) - 1 else N
            face = (n - above) / (n + above)
            r = (face + r) / (1 + face * r) * np.exp(4j * np.pi * n * d / wavelength)
            above = n
        face = (1 - above) / (1 + above)
        found.append(abs((face + r) / (1 + face * r)) ** 2)
    return float(np.mean(found))


def fresnel(n):
    return ((n - 1) / (n + 1)) ** 2


NAMED = {
    "material": ({"material": "{}"}, fresnel(N)),
    "int_ior": ({"int_ior": "{}"}, fresnel(N)),
    # Radiance is n² times smaller outside.
    "int_ior, transmission": ({"int_ior": "{}", "transmission": "interface"}, fresnel(N) + (1 - fresnel(N)) / N**2),
    "ext_ior": ({"int_ior": BELOW, "ext_ior": "{}"}, fresnel(BELOW / N)),
    "coat_ior": (
        {"int_ior": BELOW, "coat_ior": "{}"},
        fresnel(N) + (1 - fresnel(N)) ** 2 * fresnel(BELOW / N),
    ),
    "thin_film_ior": ({"int_ior": BELOW, "thin_film_ior": "{}", "thin_film_thickness": 0.3}, of_films(0.3)),
    "thin_film_ior, list": (
        {"int_ior": BELOW, "thin_film_ior": "1.5, {}", "thin_film_thickness": "0.4, 0.2"},
        of_films(0.4, 0.2),
    ),
}
FLAT = {**GRATING, "depth": 0.0, "coherence_length": 65.0, "conserve_energy": False}


def with_file(named, file):
    given = {name: v.replace("{}", file) if isinstance(v, str) else v for name, v in NAMED[named][0].items()}
    return {**FLAT, **given}


@pytest.mark.few(9)
@pytest.mark.parametrize("end", ENDS)
@pytest.mark.parametrize("named", NAMED)
def test_light_that_a_file_of_an_index_lacks_is_refused_by_parameter_file_and_ranges(llvm, tmp_path, named, end):
    # Regression: the index was constant beyond the table, without a word.
    rows, known = ENDS[end]
    bsdf, parameter = with_file(named, table(tmp_path, "glass.csv", rows)), named.partition(",")[0]
    refusal = rf"{parameter}: got light of 360 to 830 nm, and a table of {known} \(glass\.csv\)"
    with pytest.raises(RuntimeError, match=refusal):
        mi.load_dict(scene(bsdf))


def test_light_that_the_material_of_a_rigorous_recipe_lacks_is_refused(llvm, tmp_path, monkeypatch):
    table(tmp_path, "glass.csv", ["0.42,1.7,0", "0.68,1.6,0"])
    recipe = tmp_path / "recipe.toml"
    recipe.write_text(
        '[surface]\nprofile = "sinusoidal"\nperiod = 0.7\ndepth = 0.1\n'
        '[spectrum]\ntheory = "rigorous"\nmaterial = "glass.csv"\n'
    )
    monkeypatch.setattr(md.Recipe, "cached", lambda self, progress: made_up())  # which takes minutes
    bsdf = {"type": "diffraction_grating", "filename": str(recipe)}
    with pytest.raises(RuntimeError, match=r"material: got light of 360 to 830 nm, and a table of 420 to 680 nm"):
        mi.load_dict(scene(bsdf))
    loaded = mi.load_dict(scene(bsdf, (450, 600)))
    (tmp_path / "glass.csv").unlink()
    mi.render(loaded, spp=1)


def test_a_rigorous_table_to_be_saved_is_of_wavelengths_at_which_its_index_is_known(tmp_path, command):
    # A scene knows the wavelengths of a saved table, but not the range of its material.
    settings = {"theory": "rigorous", "material": table(tmp_path, "glass.csv", ["0.42,1.7,0", "0.68,1.6,0"])}
    refusal = r"material: got light of 360 to 830 nm, and a table of 420 to 680 nm \(glass\.csv\)"
    with pytest.raises(ValueError, match=refusal):
        md.precompute(md.gratings.sinusoidal(0.7, 0.1), **settings)
    inside = r"light of 420 to 840 nm, .* inside ext_ior=1\.2: light of 350 to 700 nm in air has 292 to 583"
    with pytest.raises(ValueError, match=inside):
        md.precompute(md.gratings.sinusoidal(0.7, 0.1), **settings, ext_ior=1.2, wavelengths=(350, 700))
    surface = written("sinusoidal", {"period": 0.7, "depth": 0.1, **settings})
    code, _, error = command("precompute", surface, "-o", str(tmp_path / "table.exr"))
    assert code == 2
    assert re.search(refusal, error)


@pytest.mark.few(2)
@pytest.mark.parametrize("named", NAMED)
def test_an_infrared_table_is_the_index_in_infrared_light(llvm, tmp_path, named):
    # Elsewhere another one; but ext_ior, and the samples of transmitted light, have one index, where the table begins.
    n = N if named in ("int_ior, transmission", "ext_ior") else 1.2
    file = table(tmp_path, "infrared.csv", [f"{x},{y},0" for x, y in ((2, n), (2.9, n), (2.96, N), (3.24, N), (5, n))])
    assert mean(with_file(named, file), (3000.0, 3200.0)) == pytest.approx(NAMED[named][1], rel=0.02)


@pytest.mark.parametrize("named", ["int_ior", "ext_ior", "coat_ior"])
def test_a_medium_that_absorbs_infrared_light_is_transparent_only_in_visible_light(llvm, tmp_path, named):
    file = table(tmp_path, "water.csv", ["0.3,1.3,1e-7", "1,1.3,1e-6", "3,1.4,0.3", "4,1.4,0.01"])
    mi.load_dict(scene(with_file(named, file)))
    with pytest.raises(RuntimeError, match=rf"{named}: got light of 2900 to 3100 nm, and k up to 0\.3 \(water\.csv\)"):
        mi.load_dict(scene(with_file(named, file), (2900, 3100)))


@pytest.mark.parametrize("n", [3.45, "BK7"])
def test_a_material_without_absorption_reflects_as_a_dielectric(llvm, tmp_path, n):
    # Regression: "no probability mass found!"
    file = n if n == "BK7" else table(tmp_path, "clear.csv", ["0.3,3.45,0", "0.9,3.45,0"])
    found = albedo(mi.load_dict({**FLAT, "material": file}), direction(60, 40), wavelengths=[550.0] * 4)
    cos = np.cos(np.deg2rad(60))
    eta = 1.5185 if n == "BK7" else n
    inside = np.sqrt(eta**2 - 1 + cos**2)
    s, p = (cos - inside) / (cos + inside), (eta**2 * cos - inside) / (eta**2 * cos + inside)
    np.testing.assert_allclose(found, (s**2 + p**2) / 2, rtol=0.01)


def spectrum_of(*values):
    return {"type": "irregular", "wavelengths": "450, 500, 650", "values": ", ".join(map(str, values))}


@pytest.mark.parametrize(
    ("eta", "k", "refusal"),
    [
        (spectrum_of(1, 1, 1), 3.0, "eta: got light of 360 to 830 nm, and a table of 450 to 650 nm"),
        (1.0, spectrum_of(3, 3, 3), "k: got light of 360 to 830 nm, and a table of 450 to 650 nm"),
        (
            {"type": "checkerboard", "color0": spectrum_of(1, 1, 1), "color1": 2.0},
            *(3.0, "eta: got light of 360 to 830 nm, and a table of 450 to 650 nm"),
        ),
        (spectrum_of(1, 1000, 1), 3.0, "eta: got [0-9.]+, wanted 0 to 100"),
        *((bad, 3.0, f"eta: got {bad}, wanted 0 to 100") for bad in (float("nan"), -1, 101.5)),
        *((1.0, bad, f"k: got {bad}, wanted 0 to 100") for bad in (float("nan"), -1, 101.5)),
        (0.0, 0.0, r"eta: got an index eta \+ ik of 0, wanted 0.01 to 100"),
        ("bitmap", 3.0, "eta: got -1, wanted 0 to 100"),
    ],
)
def test_spectra_that_end_inside_the_light_or_are_no_index_are_refused(llvm, eta, k, refusal):
    # Regression: R was 1 beyond the ends, and NaN under a film.
    if eta == "bitmap":
        pixels = np.ones((40, 50, 1), np.float32)
        pixels[33, 21] = -1
        eta = {"type": "bitmap", "bitmap": mi.Bitmap(pixels), "raw": True}
    with pytest.raises(RuntimeError, match=refusal):
        mi.load_dict(scene({**FLAT, "eta": eta, "k": k}))


@pytest.mark.parametrize("bad", [float("nan"), -1.0, 1e30])
@pytest.mark.parametrize("name", ["eta", "k"])
def test_an_index_that_becomes_none_is_refused(llvm, name, bad):
    parameters = mi.traverse(mi.load_dict({**FLAT, "eta": 1.0, "k": 3.0}))
    parameters[f"{name}.value"] = bad
    with pytest.raises(ValueError, match=f"{name}: got {bad:g}".replace("+", r"\+") + ", wanted 0 to 100"):
        parameters.update()


def test_spectra_of_an_index_are_not_traversed_while_eval_is_recorded(llvm, monkeypatch):
    bsdf = mi.load_dict({**FLAT, "eta": spectrum_of(1, 1, 1), "k": 3.0})
    monkeypatch.setattr("mitsuba.traverse", lambda _: pytest.fail("traversed"))
    assert albedo(bsdf, direction(20, 40), wavelengths=WAVELENGTHS).max() > 0


def test_a_spectrum_that_comes_to_end_inside_the_light_is_refused(llvm):
    of_metal = {"type": "irregular", "wavelengths": "350, 500, 850", "values": "1, 1, 1"}
    loaded = mi.load_dict(scene({**FLAT, "eta": of_metal, "k": 3.0}))
    parameters = mi.traverse(loaded)
    parameters["grating.bsdf.eta.wavelengths"] = [450.0, 500.0, 650.0]
    parameters.update()
    with pytest.raises(ValueError, match="eta: got light of 360 to 830 nm, and a table of 450 to 650 nm"):
        mi.render(loaded, spp=1)
