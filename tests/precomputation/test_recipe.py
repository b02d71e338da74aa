"""Recipes: what they refuse, what they build, and a cache that is keyed by content."""

import shutil
import warnings
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

import mitsuba_diffraction as md
from mitsuba_diffraction import GratingSpectrum, Recipe
from mitsuba_diffraction.energy.table import EnergyTable
from mitsuba_diffraction.precomputation import recipe as recipe_module
from mitsuba_diffraction.precomputation.requested_surface import RequestedSurface
from mitsuba_diffraction.precomputation.spectra import build_spectrum, load_spectrum
from mitsuba_diffraction.settings import RigorousSettings, ScalarSettings, Settings
from mitsuba_diffraction.surface.readers import read_height_field

SLOW = {"compact_disc", "dvd", "elaphe_synthetic", "morpho_ridges", "xenopeltis_synthetic", "xenopeltis_afm"}
SLOW |= {"elaphe_tile", "xenopeltis_tile"}
READY = {"elaphe", "xenopeltis"}
"""They take minutes; tests/precomputation/test_ready_spectra.py builds them."""
RECIPES = sorted((Path(__file__).parents[2] / "precompute").glob("*.toml"))
BLAZE = '[surface]\nprofile = "blazed"\nperiod = 2.5\ndepth = 0.25\n'
FAST = {"tolerance": 0.01, "coherence_length": 20.0}
"""Lobes so wide that the energy table is a small one."""
CROSSED = {"profile": "crossed", "period": 1.0, "depth": 0.1, "samples": 16}


def write(folder, text, name="recipe.toml"):
    path = folder / name
    path.write_text(text, encoding="utf-8")
    return path


def write_scan(folder, seed=0, name="scan.npy"):
    heights = np.random.default_rng(seed).random((6, 8)) * 0.1
    np.save(folder / name, heights)
    return heights


def test_a_recipe_that_windows_saved_is_read(tmp_path):
    (tmp_path / "notepad.toml").write_bytes(b"\xef\xbb\xbf" + BLAZE.replace("\n", "\r\n").encode())
    assert Recipe.load(tmp_path / "notepad.toml").surface == Recipe.load(write(tmp_path, BLAZE)).surface


def powers(spectrum):
    return spectrum.table.values


def contents(spectrum):
    """What a spectrum holds, without the spectrum: one that is in use is not read again."""
    return powers(spectrum), spectrum.error, spectrum.source, spectrum.grid, spectrum.source_digest


@pytest.fixture
def own_cache(tmp_path, monkeypatch):
    """An empty cache; gives the folder."""
    folder = tmp_path / "cache" / "of its own"
    monkeypatch.setenv("MITSUBA_DIFFRACTION_CACHE", str(folder))
    return folder


@pytest.fixture
def builds(monkeypatch):
    """The surfaces that were computed, not read from the cache, since the test began."""
    computed = []

    def spy(patches, *arguments, **options):
        computed.append(patches[0].digest)
        return build_spectrum(patches, *arguments, **options)

    monkeypatch.setattr(recipe_module, "build_spectrum", spy)
    return computed


# ---------------------------------------------------------------- what is refused


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "wanted either a profile or a scan"),
        ("[surface]\n", "wanted either a profile or a scan"),
        ('[surface]\nprofile = "blazed"\nscan = "a.npy"\n', "wanted either a profile or a scan"),
        ('[surface]\nprofile = "blased"\n', "'blased'"),
        ('[surface]\nprofile = ["blazed"]\n', "profile"),
        ("[surface]\nprofile = 3\n", "profile"),
        ('[surface]\nscan = "a.npy"\npixelsize = 1\n', "pixelsize"),
        ('[surface]\nscan = "a.npy"\nprepare = "level_plane"\n', "prepare: got 'level_plane', wanted a list of steps"),
        ('[surface]\nscan = "a.npy"\nprepare = ["level"]\n', "prepare: got 'level', wanted one of level_plane"),
        ('[surface]\nscan = "a.npy"\nprepare = [{ rotate = "x" }]\n', "prepare: rotate: got 'x', wanted a number"),
        (BLAZE + "prepare = [{ rotate = 1 }]\n", "prepare: got"),
        ('surface = "blazed"\n', r"\[surface\]"),
        (BLAZE + "[spectrum]\nresolution = 3\n", "resolution"),
        (BLAZE + "[spectra]\ntolerance = 0.1\n", "spectra"),
        ("spectrum = 3\n" + BLAZE, r"\[spectrum\]"),
        ("[surface\n", "not a TOML file"),
        ("a = " + 5000 * "[" + 5000 * "]", "not a TOML file"),
        (f"a = 1{'0' * 5000}", "not a TOML file"),
        (f'[surface]\nscan = "a.npy"\nprepare = [{{ rotate = 1{"0" * 400} }}]\n', "prepare: rotate: got 1000"),
        ("\x00", "not a TOML file"),
    ],
)
def test_wrong_recipes_are_refused(tmp_path, text, message):
    path = write(tmp_path, text)
    with pytest.raises(ValueError, match=message) as caught:
        Recipe.load(path)
    assert str(path) in str(caught.value)
    assert "\n" not in str(caught.value)


def test_bytes_that_are_no_text_are_refused(tmp_path):
    (tmp_path / "recipe.toml").write_bytes(b"\xff\xfe[surface]")
    with pytest.raises(ValueError, match=r"recipe.toml: not a TOML file"):
        Recipe.load(tmp_path / "recipe.toml")


def test_a_missing_recipe_is_named(tmp_path):
    with pytest.raises(FileNotFoundError, match=r"nothing\.toml: no such file"):
        Recipe.load(tmp_path / "nothing.toml")
    with pytest.raises(OSError, match=tmp_path.name):
        Recipe.load(tmp_path)


@pytest.mark.parametrize(
    ("entry", "name"),
    [
        ('tolerance = "fine"', "tolerance"),
        ("tolerance = 0", "tolerance"),
        ("tolerance = nan", "tolerance"),
        ("tolerance = [0.1]", "tolerance"),
        ('coherence_length = "65"', "coherence_length"),
        ("coherence_length = -1", "coherence_length"),
        ("coherence_length = [1, 2]", "coherence_length"),
        ("coherence_length = 1e308", "coherence_length"),
        ("coherence_length = 1e-320", "coherence_length"),
        (f"coherence_length = 1{'0' * 400}", "coherence_length"),
        (f"wavelengths = [360, 1{'0' * 400}]", "wavelengths"),
        ("wavelengths = 500", "wavelengths"),
        ("wavelengths = [360]", "wavelengths"),
        ("wavelengths = [830, 360]", "wavelengths"),
        ('wavelengths = ["blue", "red"]', "wavelengths"),
        ('representation = "wavelets"', "representation"),
        ("representation = 1", "representation"),
        ('extent = "ribbon"', "extent"),
        ('largest_angle = "steep"', "largest_angle"),
        ("largest_angle = 0", "largest_angle"),
        ("largest_angle = 91", "largest_angle"),
        ("extent = 5", "extent"),
    ],
)
def test_invalid_values_of_the_spectrum_are_refused_by_name(tmp_path, entry, name):
    path = write(tmp_path, f"{BLAZE}[spectrum]\n{entry}\n")
    with pytest.raises(ValueError, match=f"recipe.toml: {name}: ") as caught:
        Recipe.load(path)
    assert "\n" not in str(caught.value)


def test_options_override_the_values_of_a_recipe(tmp_path):
    path = write(tmp_path, BLAZE + '[spectrum]\ntolerance = 2\nmaterial = "Al"\n')
    recipe = Recipe.load(path, tolerance=0.1, theory="rigorous")
    assert recipe.settings == RigorousSettings(tolerance=0.1, material="Al")
    with pytest.raises(ValueError, match=r"^tolerance: got 7"):  # not a mistake of the file
        Recipe.load(path, tolerance=7, theory="rigorous")


@pytest.mark.parametrize(
    ("entries", "name"),
    [
        ("perid = 2.5\ndepth = 0.1", "perid"),
        ("period = 2.5", "depth"),
        ('period = "wide"\ndepth = 0.1', "period"),
        ("period = 2.5\ndepth = -1", "depth"),
        ("period = 1979-05-27\ndepth = 0.1", "period"),
        ("period = [2.5]\ndepth = 0.1", "period"),
        ("period = true\ndepth = 0.1", "period: got True"),
        (f"period = 1{'0' * 400}\ndepth = 0.1", "period: got 1000"),
        (f"period = 2.5\ndepth = 0.1\nsamples = 1{'0' * 400}", "samples: got 1000"),
    ],
)
@pytest.mark.parametrize("way", ["build", "cached"])
def test_invalid_values_of_a_profile_are_refused_by_name(tmp_path, entries, name, way):
    path = write(tmp_path, f'[surface]\nprofile = "lamellar"\n{entries}\n')
    with pytest.raises(ValueError, match=name):
        getattr(Recipe.load(path), way)()


@pytest.mark.parametrize(
    ("entries", "name"),
    [
        ('scan = "scan.npy"', "pixel_size"),
        ('scan = "scan.npy"\npixel_size = -1', "pixel_size"),
        ('scan = "scan.npy"\npixel_size = "0.1"', "pixel_size"),
        ('scan = "scan.npy"\npixel_size = [1, 2, 3]', "pixel_size"),
        ('scan = "scan.npy"\npixel_size = true', "pixel_size: got True"),
        (f'scan = "scan.npy"\npixel_size = 1{"0" * 400}', "pixel_size"),
        ('scan = "scan.npy"\npixel_size = 0.05\nheight_range = 0.1', "height_range"),
        ('scan = "scan.npy"\npixel_size = 0.05\nfill_missing = "yes"', "fill_missing"),
        ('scan = "scan.npy"\npixel_size = 0.05\nfill_missing = 1', "fill_missing"),
        ("scan = 3\npixel_size = 0.05", "scan"),
        ('scan = ["scan.npy"]\npixel_size = 0.05', "scan"),
    ],
)
@pytest.mark.parametrize("way", ["build", "cached"])
def test_invalid_values_of_a_scan_are_refused_by_name(tmp_path, own_cache, entries, name, way):
    write_scan(tmp_path)
    path = write(tmp_path, f"[surface]\n{entries}\n")
    with pytest.raises(ValueError, match=name):
        getattr(Recipe.load(path), way)()
    assert not own_cache.exists() or not list(own_cache.iterdir())


@pytest.mark.parametrize("way", ["build", "cached", "digest"])
def test_a_missing_scan_is_named(tmp_path, way):
    path = write(tmp_path, '[surface]\nscan = "gone.npy"\npixel_size = 0.05\n')
    with pytest.raises(FileNotFoundError, match=r"gone\.npy"):
        getattr(Recipe.load(path), way)()


# ---------------------------------------------------------------- what is built


def test_a_recipe_builds_the_described_spectrum(tmp_path):
    path = write(
        tmp_path,
        BLAZE + 'samples = 64\n[spectrum]\nextent = "tile"\ncoherence_length = 30\nwavelengths = [400, 700.0]\n'
        'largest_angle = 60\nrepresentation = "slices"\ntolerance = 1e-2\n',
    )
    got = Recipe.load(path).build()
    wanted = md.precompute(
        md.gratings.blazed(2.5, 0.25, samples=64),
        coherence_length=30.0,
        wavelengths=(400.0, 700.0),
        largest_angle=60.0,
        tolerance=1e-2,
    )
    assert (got.extent, got.largest_angle) == ("tile", 60.0)
    assert (got.representation, got.wavelengths, got.coherence_length) == ("slices", (400.0, 700.0), 30.0)
    assert got.source_digest == wanted.source_digest
    np.testing.assert_array_equal(got.table.values, wanted.table.values)


@pytest.mark.slow
def test_a_recipe_of_a_sample_builds_its_spectrum(tmp_path, own_cache):
    heights = np.random.default_rng(0).random((20, 24)) * 0.1
    np.save(tmp_path / "scan.npy", heights)
    path = write(
        tmp_path,
        '[surface]\nscan = "scan.npy"\npixel_size = [0.09, 0.08]\n'
        '[spectrum]\nextent = "sample"\ncoherence_length = 0.7\ntolerance = 0.02\n',
    )
    Recipe.load(path).cached()
    spectrum = Recipe.load(path).cached()  # read from the file
    assert len(list(own_cache.iterdir())) == 1
    field = md.HeightField(heights, (0.09, 0.08))
    wanted = md.precompute(field, extent="sample", coherence_length=0.7, tolerance=0.02)
    assert (spectrum.extent, spectrum.coherence_length, spectrum.grid) == ("sample", 0.7, wanted.grid)
    np.testing.assert_array_equal(powers(spectrum), powers(wanted))
    tile = write(tmp_path, path.read_text().replace('"sample"', '"tile"'), "tile.toml")
    assert Recipe.load(tile).digest() != Recipe.load(path).digest()


def test_a_spectrum_keeps_the_warning_of_scalar_theory(tmp_path):
    surface = {"profile": "sinusoidal", "period": 0.71, "depth": 0.3, "samples": 64}
    spectrum = Recipe(surface, ScalarSettings(**FAST)).build()
    assert spectrum.warning.startswith("scalar theory: errs by 63% of the reflected light")
    spectrum.save(tmp_path / "fine.exr")
    loaded = GratingSpectrum.load(tmp_path / "fine.exr")
    assert loaded.warning == spectrum.warning
    assert loaded.waves == spectrum.waves
    assert spectrum.digest == md.precompute(md.gratings.sinusoidal(0.71, 0.3, samples=64), **FAST).digest
    assert Recipe({**surface, "period": 3.0, "depth": 0.05}, ScalarSettings(**FAST)).build().warning == ""


def test_a_recipe_reports_the_coherence_length_that_its_scan_supports(tmp_path):
    np.save(tmp_path / "scan.npy", np.zeros((20, 24)))
    path = write(
        tmp_path,
        '[surface]\nscan = "scan.npy"\npixel_size = 0.09\n[spectrum]\nextent = "sample"\ntolerance = 0.02\n',
    )
    with pytest.warns(UserWarning, match=r"2.16 × 1.8 µm supports 0.9 µm of the requested 65 µm"):
        spectrum = Recipe.load(path).build()
    assert spectrum.coherence_length == pytest.approx(0.9)


def test_a_scan_is_relative_to_its_recipe(tmp_path, monkeypatch):
    (tmp_path / "scans").mkdir()
    heights = write_scan(tmp_path / "scans")
    path = write(tmp_path, '[surface]\nscan = "scans/scan.npy"\npixel_size = [0.05, 0.08]\n')
    monkeypatch.chdir(path.parent)
    recipe = Recipe.load(path.name)
    monkeypatch.chdir("/")
    field = recipe.height_field()
    np.testing.assert_array_equal(field.heights, heights)
    assert field.pixel_size == (0.05, 0.08)


def test_a_scan_with_missing_pixels_is_filled_if_the_recipe_requests_it(tmp_path, own_cache):
    heights = write_scan(tmp_path)
    heights[2, 3:5] = np.nan
    np.save(tmp_path / "scan.npy", heights)
    text = '[surface]\nscan = "scan.npy"\npixel_size = [0.05, 0.08]\n'
    for refusing in (text, text + "fill_missing = false\n"):
        with pytest.raises(ValueError, match="2 of 48 pixels are missing"):
            Recipe.load(write(tmp_path, refusing)).cached()
    recipe = Recipe.load(write(tmp_path, text + "fill_missing = true\n[spectrum]\ntolerance = 0.01\n"))
    wanted = md.HeightField(heights, (0.05, 0.08), fill_missing=True)
    recipe.cached()
    spectrum = recipe.cached()  # read from the file
    assert len(list(own_cache.iterdir())) == 1
    assert spectrum.source_digest == wanted.digest
    assert spectrum.source == "scan.npy (2 missing pixels filled)"
    assert recipe.height_field().filled == 2


def test_a_profile_has_no_missing_pixels(tmp_path):
    with pytest.raises(ValueError, match="fill_missing"):
        Recipe.load(write(tmp_path, BLAZE + "fill_missing = true\n")).height_field()


def test_a_recipe_of_a_measured_skin_has_its_heights(tmp_path, scan_file, scan):
    text = f'[surface]\nscan = "{scan_file("elaphe")}"\npixel_size = 0.0586\nheight_range = 0.375\n'
    assert Recipe.load(write(tmp_path, text)).height_field().digest == scan("elaphe").digest


@pytest.mark.few(4)
@pytest.mark.parametrize(
    "path",
    [
        pytest.param(p, id=p.name, marks=pytest.mark.slow if p.stem in SLOW else ())
        for p in RECIPES
        if p.stem not in READY
    ],
)
def test_the_recipes_of_this_repository_build(path):
    recipe = Recipe.load(path)
    one = {"patches": 1} if recipe.patches > 1 else {}
    spectrum = Recipe({**recipe.surface, **one}, replace(recipe.settings, tolerance=0.2), recipe.folder).build()
    assert spectrum.error <= 0.2
    if "depth" in recipe.surface:  # of a ruled grating it follows from its blaze
        depth = recipe.surface["depth"] * recipe.surface.get("index", 1.0)
        assert spectrum.height_range == pytest.approx(depth, rel=0.01)
    assert spectrum.coherence_length == recipe.settings.coherence_length


def test_there_are_recipes_in_this_repository():
    assert {path.stem for path in RECIPES} >= {"blaze", *READY}


# ---------------------------------------------------------------- the cache


def test_the_cache_is_read_the_second_time(own_cache, builds):
    recipe = Recipe(CROSSED, ScalarSettings(**FAST))
    first, second = (contents(recipe.cached()) for _ in range(2))
    assert len(builds) == 1
    assert [path.name for path in own_cache.iterdir()] == [f"{recipe.digest()}.exr"]
    np.testing.assert_array_equal(first[0], second[0])
    assert first[1:] == second[1:]


def test_a_file_in_the_cache_of_another_recipe_is_replaced(own_cache, builds):
    one, other = (Recipe(CROSSED, ScalarSettings(**{**FAST, "coherence_length": length})) for length in (20.0, 25.0))
    one.cached()
    (own_cache / f"{one.digest()}.exr").rename(own_cache / f"{other.digest()}.exr")
    assert other.cached().settings.coherence_length == 25.0
    assert len(builds) == 2


def test_a_spectrum_in_use_is_neither_built_nor_read_again(own_cache, builds):
    recipe = Recipe(CROSSED, ScalarSettings(**FAST))
    first = recipe.cached()
    assert not any(isinstance(value, md.HeightField) for value in vars(recipe).values())
    shutil.rmtree(own_cache)
    assert recipe.cached() is first
    assert len(builds) == 1


def test_e_is_computed_for_a_bsdf_and_added_to_the_cache(own_cache, monkeypatch):
    computed, of = [], EnergyTable.of
    monkeypatch.setattr(EnergyTable, "of", lambda spectrum: computed.append(spectrum) or of(spectrum))
    recipe = Recipe(CROSSED, ScalarSettings(**FAST))
    for spectrum in (recipe.cached(), load_spectrum(own_cache / f"{recipe.digest()}.exr", recipe.digest())):
        assert not computed
        assert spectrum.energy is None
    table = spectrum.energy_table()
    assert len(computed) == 1
    found = load_spectrum(own_cache / f"{recipe.digest()}.exr", recipe.digest())
    assert found.energy_table().as_plain() == table.as_plain()
    assert found.digest == spectrum.digest
    assert len(computed) == 1


def test_e_of_a_changed_copy_is_not_added_to_the_cache(own_cache):
    recipe = Recipe(CROSSED, ScalarSettings(**FAST))
    spectrum = recipe.cached()
    entry = (own_cache / f"{recipe.digest()}.exr").read_bytes()
    weaker = replace(spectrum.table, values=0.5 * spectrum.table.values)
    assert replace(spectrum, table=weaker).energy_table().values.min() > 0
    assert (own_cache / f"{recipe.digest()}.exr").read_bytes() == entry


def test_e_is_computed_where_the_cache_has_gone(own_cache):
    spectrum = Recipe(CROSSED, ScalarSettings(**FAST)).cached()
    shutil.rmtree(own_cache)
    assert spectrum.energy_table().values.min() > 0
    assert not own_cache.exists()


@pytest.mark.not_quick
@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("surface", "spectrum"),
    [
        ({"depth": 0.11}, {}),
        ({"period": 1.1}, {}),
        ({"profile": "sinusoidal"}, {}),
        ({}, {"tolerance": 0.02}),
        ({}, {"coherence_length": 15.0}),
        ({}, {"wavelengths": [400, 700]}),
        ({}, {"largest_angle": 50}),
    ],
)
def test_another_parameter_is_another_spectrum(own_cache, builds, surface, spectrum):
    one, other = (
        Recipe(CROSSED, ScalarSettings(**FAST)),
        Recipe({**CROSSED, **surface}, ScalarSettings(**{**FAST, **spectrum})),
    )
    assert one.digest() != other.digest()
    one.cached()
    got = other.cached()
    assert len(builds) == 2
    wanted = other.build()
    for name in (
        *("representation", "wavelengths", "coherence_length", "tolerance", "source_digest", "largest_angle"),
        *("truncated_power", "unresolved_power", "grid"),
    ):
        assert getattr(got, name) == getattr(wanted, name)


def test_a_recipe_with_the_file_of_an_index_is_the_same_by_every_path(tmp_path, monkeypatch):
    folder = tmp_path / "folder"
    folder.mkdir()
    (folder / "glass.spd").write_text("300 1.5\n900 1.6\n")
    write(folder, BLAZE + '[spectrum]\ntheory = "rigorous"\nmaterial = "glass.spd"\n')
    monkeypatch.chdir(folder)
    recipes = [Recipe.load(p) for p in ("recipe.toml", "../folder/recipe.toml", folder / "recipe.toml")]
    monkeypatch.chdir(tmp_path)
    digests = {recipe.digest() for recipe in recipes}
    assert len(digests) == 1
    (folder / "glass.spd").write_text("300 1.5\n900 1.7\n")
    assert recipes[0].digest() not in digests


@pytest.mark.slow
def test_the_cache_identifies_a_scan_by_its_bytes(tmp_path, own_cache, builds):
    text = '[surface]\nscan = "scan.npy"\npixel_size = 0.05\n[spectrum]\ntolerance = 0.01\n'
    folder_1, folder_2 = tmp_path / "first", tmp_path / "second"
    for folder in (folder_1, folder_2):
        folder.mkdir()
        write_scan(folder, seed=0)
        write(folder, text)
    first = Recipe.load(folder_1 / "recipe.toml").cached().source_digest
    Recipe.load(folder_2 / "recipe.toml").cached()
    assert len(builds) == 1  # the same content in another folder
    shutil.move(folder_2 / "scan.npy", folder_2 / "other.npy")
    write(folder_2, text.replace("scan.npy", "other.npy"))
    Recipe.load(folder_2 / "recipe.toml").cached()
    assert len(builds) == 1  # … and under another name
    heights = write_scan(folder_1, seed=1)
    changed = Recipe.load(folder_1 / "recipe.toml").cached()
    assert len(builds) == 2
    assert changed.source_digest != first
    assert changed.source_digest == md.HeightField(heights, 0.05).digest


@pytest.mark.few(1)
@pytest.mark.parametrize("damage", [b"", b"not a picture", None])
def test_a_damaged_entry_is_built_again(own_cache, builds, damage):
    recipe = Recipe(CROSSED, ScalarSettings(**FAST))
    whole = powers(recipe.cached())
    (path,) = own_cache.iterdir()
    path.write_bytes(path.read_bytes()[:-20] if damage is None else damage)
    got = powers(recipe.cached())
    assert len(builds) == 2
    np.testing.assert_array_equal(got, whole)
    np.testing.assert_array_equal(powers(GratingSpectrum.load(path)), whole)


def test_an_interrupted_build_leaves_no_entry(own_cache, monkeypatch):
    def interrupted(*_, **__):
        raise KeyboardInterrupt

    monkeypatch.setattr(recipe_module, "build_spectrum", interrupted)
    with pytest.raises(KeyboardInterrupt):
        Recipe({"profile": "blazed", "period": 2.5, "depth": 0.25}).cached()
    assert not own_cache.exists() or not list(own_cache.iterdir())


def test_digest_does_not_depend_on_the_order_of_entries():
    one = Recipe({"profile": "blazed", "period": 2.5, "depth": 0.25})
    assert one.digest() == Recipe({"depth": 0.25, "profile": "blazed", "period": 2.5}).digest()


def test_digest_does_not_depend_on_stated_defaults():
    stated = Settings.of(extent="tile", wavelengths=(360, 830), theory="scalar", **FAST)
    assert Recipe(CROSSED, stated).digest() == Recipe(CROSSED, ScalarSettings(**FAST)).digest()


@pytest.mark.parametrize(
    ("one", "same"),
    [
        ("ruled,lines_per_mm=1200", "ruled,lines_per_mm=1200.0"),
        ("blazed,period=2,depth=0.25,coherence_length=30", "blazed,depth=.25,coherence_length=3e1,period=2.00"),
        (
            "sinusoidal,period=1,depth=0.2,theory=rigorous,int_ior=2",
            "sinusoidal,period=1,depth=0.2,theory=rigorous,int_ior=2.0",
        ),
        ("elaphe_synthetic,extent=tile", "elaphe_synthetic,extent=tile,seed=0,patches=16"),
    ],
)
def test_digest_does_not_depend_on_how_a_number_is_written(one, same):
    first, second = (RequestedSurface.of(text).recipe for text in (one, same))
    assert first.patches == second.patches
    assert first.digest() == second.digest()


def test_the_cache_is_the_users_unless_named(monkeypatch, tmp_path):
    monkeypatch.delenv("MITSUBA_DIFFRACTION_CACHE")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setenv("HOME", str(tmp_path))
    assert "mitsuba_diffraction" in str(recipe_module.cache_folder())
    monkeypatch.setenv("MITSUBA_DIFFRACTION_CACHE", "elsewhere")
    assert recipe_module.cache_folder() == Path("elsewhere")


# ---------------------------------------------------------------- scans made ready


def tilted(folder):
    """A grating of 0.6 µm with a tilt, jumps between its lines and a hole; as scan.npy."""
    generator = np.random.default_rng(0)
    x = np.mgrid[:40, :70][1] * 0.05
    heights = 0.05 * np.cos(2 * np.pi * x / 0.613) + 0.2 * x + 0.02 * generator.standard_normal((40, 1))
    heights[10, 20] = np.nan
    np.save(folder / "scan.npy", heights)


PREPARED = """[surface]
scan = "scan.npy"
pixel_size = 0.05
prepare = ["level_plane", "align_lines", "fill_missing", { trim_edges = 0.1 }, { crop_periods = "x" }]
"""


def test_a_scan_is_prepared_and_the_spectrum_records_the_steps(tmp_path):
    tilted(tmp_path)
    recipe = Recipe.load(write(tmp_path, PREPARED + "[spectrum]\ntolerance = 0.01\n"))
    spectrum = recipe.build()
    spectrum.save(tmp_path / "out.exr")
    source = GratingSpectrum.load(tmp_path / "out.exr").source
    assert source == recipe.height_field().source
    steps = [part.split(":")[0] for part in source.split("; ")]
    assert steps[:5] == ["scan.npy", "level_plane", "align_lines", "fill_missing", "trim_edges"]
    assert "level_plane: tilt 11" in source  # atan 0.2, but for the waves that the patch cuts
    assert "fill_missing: 1 of 2800 pixels" in source
    assert "crop_periods: 5 × 613" in source
    assert spectrum.grid.tile_size[0] == pytest.approx(5 * 0.613, rel=2e-3)


def test_missing_pixels_are_filled_after_the_last_step(tmp_path):
    tilted(tmp_path)
    text = '[surface]\nscan = "scan.npy"\npixel_size = 0.05\nprepare = ["level_plane"]\n'
    with pytest.raises(ValueError, match=r"scan\.npy: heights: 1 of 2800 pixels are missing"):
        Recipe.load(write(tmp_path, text)).height_field()
    field = Recipe.load(write(tmp_path, text + "fill_missing = true\n")).height_field()
    assert field.filled == 1
    assert field.source.endswith("(1 missing pixel filled)")
    with pytest.raises(ValueError, match=r"scan\.npy: trim_edges: got 9 µm"):
        Recipe.load(write(tmp_path, text.replace('"level_plane"', "{ trim_edges = 9 }"))).height_field()


def test_rigorous_tables_are_built_again_after_a_change_of_their_version(tmp_path, monkeypatch):
    scalar, rigorous = (
        Recipe.load(write(tmp_path, BLAZE + f"[spectrum]\ntheory = '{t}'\n")) for t in ("scalar", "rigorous")
    )
    before = scalar.digest(), rigorous.digest()
    monkeypatch.setattr("mitsuba_diffraction.rigorous.build_table.BUILD_VERSION", 999)
    assert scalar.digest() == before[0]
    assert rigorous.digest() != before[1]


def test_the_cache_distinguishes_steps_and_their_order(tmp_path):
    tilted(tmp_path)
    texts = [
        PREPARED,
        PREPARED.replace("0.1", "0.2"),
        PREPARED.replace('"level_plane", "align_lines"', '"align_lines", "level_plane"'),
    ]
    assert len({Recipe.load(write(tmp_path, text)).digest() for text in texts}) == 3


def test_a_recipe_takes_unit_and_channel(tmp_path):
    (tmp_path / "scan.xyz").write_text("0 0 1\n1 0 2\n0 1 3\n1 1 4\n")
    text = '[surface]\nscan = "scan.xyz"\nunit = ["um", "nm"]\npixel_size = [0.5, 1]\n'
    field = Recipe.load(write(tmp_path, text)).height_field()
    np.testing.assert_allclose(field.heights, [[1e-3, 2e-3], [3e-3, 4e-3]])
    assert field.pixel_size == (0.5, 1.0)
    with pytest.raises(ValueError, match=r"channel: got 'Z' for \.xyz"):
        Recipe.load(write(tmp_path, text + 'channel = "Z"\n')).height_field()


@pytest.mark.slow
def test_the_command_takes_the_same_values_of_a_scan(tmp_path, command, monkeypatch):
    monkeypatch.chdir(tmp_path)
    tilted(tmp_path)
    steps = "prepare=level_plane,prepare=fill_missing,prepare=trim_edges=0.1,prepare=crop_periods=x"
    code, out, err = command(f"precompute scan.npy,pixel_size=0.05,tolerance=0.01,extent=tile,{steps}")
    assert code == 0, err
    source = GratingSpectrum.load("scan.exr").source
    assert out.startswith("scan.exr: tile of ")
    assert [part.split(":")[0] for part in source.split("; ")][1:] == [
        "level_plane",
        "fill_missing",
        "trim_edges",
        "crop_periods",
    ]
    (tmp_path / "scan.xyz").write_text("0 0 1\n1 0 2\n0 1 3\n1 1 4\n")
    code, out, err = command("precompute scan.xyz,unit=um,unit=nm,extent=tile,tolerance=0.01 -o points.exr")
    assert code == 0, err
    assert GratingSpectrum.load("points.exr").height_range == pytest.approx(3e-3)
    for arguments, words in (
        ("scan.npy,channel=Height", "channel: got 'Height' for .npy"),
        ("scan.xyz,unit=V", "unit: got the unit 'V'"),
        ("scan.npy,prepare=rotate=left", "prepare: got rotate=left, wanted rotate=…, a number of degrees"),
        ("blazed,unit=nm,prepare=despike", "blazed: got unit, prepare, wanted some of "),
    ):
        code, out, err = command(f"precompute {arguments} --overwrite")
        assert (code, out, len(err.splitlines())) == (2, "", 1)
        assert words in err


# ---------------------------------------------------------------- a cache that is damaged, or cannot be used


@pytest.mark.few(1)
@pytest.mark.posix("symbolic links without a privilege")
@pytest.mark.parametrize("damage", ["folder", "dangling link", "folder is a file", "folder is a dangling link"])
def test_without_a_cache_there_is_a_warning(own_cache, builds, damage):
    # Regression: the render was refused.
    recipe = Recipe(CROSSED, ScalarSettings(**FAST))
    entry = own_cache / f"{recipe.digest()}.exr"
    own_cache.parent.mkdir()
    if damage == "folder is a file":
        own_cache.write_text("")
    elif damage == "folder is a dangling link":
        own_cache.symlink_to("nowhere")
    else:
        own_cache.mkdir()
        if damage == "folder":
            entry.mkdir()
        else:
            entry.symlink_to("nowhere/spectrum.exr")
    for _ in range(2):
        with pytest.warns(recipe_module.CacheWarning) as warned:
            digest = recipe.cached().source_digest
        assert len(warned) == 1
    assert digest == recipe.height_field().digest
    assert len(builds) == 2


def test_one_warning_for_many_surfaces(own_cache):
    own_cache.parent.mkdir()
    own_cache.write_text("")
    with warnings.catch_warnings(record=True) as caught:
        warnings.simplefilter("default")
        for period in (1.0, 1.1, 1.2):
            Recipe({**CROSSED, "period": period}, ScalarSettings(**FAST)).cached()
    assert len(caught) == 1


@pytest.mark.slow
def test_a_spectrum_of_another_surface_under_a_name_of_the_cache_is_not_used(own_cache, builds):
    one, other = (Recipe({**CROSSED, "period": period}, ScalarSettings(**FAST)) for period in (1.0, 1.1))
    one.cached()
    entry = own_cache / f"{one.digest()}.exr"
    shutil.copy(entry, own_cache / f"{other.digest()}.exr")
    assert other.cached().source_digest == other.height_field().digest
    assert len(builds) == 2
    other.build().save(entry)  # one that precompute wrote names no recipe
    assert one.cached().source_digest == one.height_field().digest
    one.cached()
    assert len(builds) == 4


# ---------------------------------------------------------------- reading a scan


SAMPLE = """[surface]
scan = "scan.npy"
pixel_size = 0.05
[spectrum]
extent = "sample"
coherence_length = 0.9
tolerance = 0.05
"""


@pytest.mark.not_quick
@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("line", "reads"),
    [
        pytest.param("precompute scan.npy,pixel_size=0.05,tolerance=0.05", 1, marks=pytest.mark.slow),
        pytest.param("precompute scan.toml", 1, marks=pytest.mark.slow),
        ("inspect scan.toml", 1),
        ("render scene.xml --spp 1 --width 4 --overwrite", 1),
        ("render scene.xml --spp 1 --width 4 --overwrite", 0),  # from the cache
    ],
    ids=["precompute", "recipe", "inspect", "render", "render again"],
)
def test_a_command_reads_a_scan_once(tmp_path, command, monkeypatch, own_cache, line, reads):
    counted = []

    def read(path, **options):
        counted.append(path)
        return read_height_field(path, **options)

    monkeypatch.chdir(tmp_path)
    np.save("scan.npy", np.tile(np.sin(np.arange(64) * np.pi / 4) * 0.1, (60, 1)))
    write(tmp_path, SAMPLE, "scan.toml")
    without_e = '<boolean name="conserve_energy" value="false"/>'
    grating = f'<bsdf type="diffraction_grating"><string name="filename" value="scan.toml"/>{without_e}</bsdf>'
    shapes = 2 * f'<shape type="rectangle">{grating}</shape>'
    write(
        tmp_path,
        f'<scene version="3.0.0"><integrator type="path"/><sensor type="perspective"/>{shapes}</scene>',
        "scene.xml",
    )
    if not reads:
        Recipe.load("scan.toml").cached()
    monkeypatch.setattr(recipe_module, "read_height_field", read)
    code, _, err = command(line)
    assert code == 0, err
    assert len(counted) == reads
