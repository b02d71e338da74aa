"""Ready surfaces against what is known of them: angles, blaze, Bessel orders, pits; and by name in a scene."""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from scipy.special import jv

import mitsuba_diffraction as md
from mitsuba_diffraction import Recipe
from mitsuba_diffraction.precomputation.recipe import source_named
from mitsuba_diffraction.settings import lobe_width
from mitsuba_diffraction.surface.gratings import (
    COHERENCE_LENGTHS,
    EIGHT_TO_FOURTEEN,
    PATCHES,
    PROFILES,
    compact_disc,
    dvd,
    film,
    foil,
    morpho_ridges,
    ruled,
    transmission_300,
    transmission_600,
)

RECIPES = Path(__file__).parents[2] / "precompute"
DISCS = {"compact_disc": (compact_disc, 1.6, 0.833, 3.054), "dvd": (dvd, 0.74, 0.400, 1.866)}
"""Name → function, track pitch, shortest and longest pit but for sync codes' (3 and 11 channel bits; DVD: 14), µm."""


def order_powers(field, kappa):
    """η_m of the tile in float64, indexed [m_y, m_x] as fft2 has them."""
    return np.abs(np.fft.fft2(np.exp(1j * kappa * field.heights)) / field.heights.size) ** 2


def kappa_of(wavelength, theta_i=0.0, theta_o=0.0):
    """κ in rad/µm for a wavelength in µm and angles in degrees."""
    return 2 * np.pi / wavelength * (np.cos(np.deg2rad(theta_i)) + np.cos(np.deg2rad(theta_o)))


# ---------------------------------------------------------------- ruled gratings


@pytest.mark.parametrize(("lines", "blaze", "angle"), [(600, 500, 8.63), (1200, 500, 17.46), (300, 1000, 8.63)])
def test_a_ruled_grating_diffracts_its_blaze_wavelength_into_the_littrow_order(lines, blaze, angle):
    field = ruled(lines, blaze_wavelength=blaze)
    assert field.tile_size[0] == pytest.approx(1000 / lines)
    slope = np.diff(field.heights[0]) / field.pixel_size[0]
    np.testing.assert_allclose(np.degrees(np.arctan(slope)), angle, atol=0.01)
    # Light in and out along the facets' normal: q = 2 sin θ_B/λ is the first order, and holds all of the power.
    eta = order_powers(field, kappa_of(blaze * 1e-3, angle, angle))[0]
    assert 2 * np.sin(np.deg2rad(angle)) / (blaze * 1e-3) == pytest.approx(lines / 1000, rel=1e-3)
    assert eta[1] == pytest.approx(1, abs=1e-4)


def test_the_blaze_angle_stands_for_the_blaze_wavelength():
    # Richardson Gratings' catalogue: 600 lines/mm, 13.9°, 800 nm.
    by_angle = ruled(600, blaze_angle=13.9)
    np.testing.assert_allclose(by_angle.heights, ruled(600, blaze_wavelength=800.8).heights, atol=1e-4)
    assert by_angle.source == "ruled grating, 600 lines/mm, blazed for 800.8 nm in reflection (13.90°)"
    angle = 17.178
    of_glass = ruled(300, blaze_angle=angle, blaze_ior=1.52), ruled(300, blaze_wavelength=550, blaze_ior=1.52)
    np.testing.assert_allclose(*(field.heights for field in of_glass), atol=1e-4)


def test_a_grating_blazed_in_transmission_transmits_into_one_order():
    """By rigorous theory, of reflection blazes and of these."""
    light = {"angles": 0, "wavelengths": 550, "theory": "rigorous", "int_ior": 1.52, "transmission": "sheet"}
    for blaze_ior, low, high in ((1.52, 0.7, 1.0), (None, 0.0, 0.15)):
        field = ruled(300, blaze_wavelength=550, blaze_ior=blaze_ior)
        assert low < md.efficiencies(field, **light).order(-1).mean() < high


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"lines_per_mm": 0}, "lines_per_mm: got 0, wanted a positive number"),
        ({"lines_per_mm": "600"}, "lines_per_mm: got '600'"),
        ({"blaze_wavelength": 0.8}, "blaze_wavelength: got 0.8 nm, wanted at least 10 nm, not µm"),
        ({"blaze_wavelength": np.nan}, "blaze_wavelength: got nan"),
        ({"blaze_angle": 90}, "blaze_angle: got 90, wanted degrees above 0 and below 90"),
        ({"blaze_angle": 60, "blaze_ior": 1.5}, r"blaze_angle: got 60, wanted degrees above 0 and below 41\.81"),
        (
            {"blaze_angle": 10, "blaze_wavelength": 500},
            "blaze_angle: got 10 and blaze_wavelength, wanted one of the two",
        ),
        ({"blaze_ior": 1.0}, "blaze_ior: got 1.0, wanted an index above 1"),
        ({"blaze_ior": 1.5, "blaze_wavelength": 1700}, "got 1700 nm, wanted less than the period, 1667 nm"),
        ({"blaze_wavelength": 4000}, r"blaze_wavelength: got 4000 nm, wanted less than twice the period, 3333 nm"),
        ({"samples": 1}, "samples: got 1"),
    ],
)
def test_an_impossible_ruled_grating_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        ruled(**arguments)


@pytest.mark.parametrize(("make", "lines", "angle"), [(transmission_300, 300, 17.5), (transmission_600, 600, 28.7)])
def test_a_transmission_grating_has_facets_at_right_angles(make, lines, angle):
    field = make(samples=2000)
    slopes = np.diff(field.heights[0]) / field.pixel_size[0]
    assert field.tile_size[0] == pytest.approx(1000 / lines)
    assert slopes[0] == pytest.approx(np.tan(np.deg2rad(angle)))
    assert slopes[0] * slopes[-1] == pytest.approx(-1)


def test_the_facets_of_a_transmission_grating_deflect_light_as_prisms_do():
    # A prism of glass under air turns light along its normal by asin(n sin α) − α.
    index, angle = 1.52, np.deg2rad(17.5)
    deflected = np.sin(np.arcsin(index * np.sin(angle)) - angle)
    wavelength = deflected * 1000 / 300
    assert wavelength == pytest.approx(0.55, abs=0.02)
    cosine = np.sqrt(1 - deflected**2)
    eta = order_powers(transmission_300(), 2 * np.pi / wavelength * (index - cosine))[0]
    assert eta.max() == max(eta[1], eta[-1]) > 0.7


@pytest.mark.parametrize("angle", [0, -3.0, 50, np.nan, "17.5"])
def test_an_impossible_facet_angle_is_refused(angle):
    with pytest.raises(ValueError, match=r"facet_angle: got .*, wanted degrees above 0"):
        transmission_300(facet_angle=angle)


# ---------------------------------------------------------------- foil and film


def test_the_first_orders_of_the_film_are_the_brightest_of_sinusoids():
    kappa = 2 * np.pi * 0.5 / 0.55
    first = [order_powers(film(depth=depth), kappa)[0, 1] for depth in (0.6, film().height_range, 0.9)]
    assert (
        first[1]
        == max(first)
        == pytest.approx(np.max(jv(1, x := np.linspace(0, 2, 999)) ** 2 * jv(0, x) ** 2), rel=1e-2)
    )
    assert film().tile_size == pytest.approx((1000 / 530, 1000 / 530))


def test_a_crossed_foil_has_products_of_bessel_orders():
    field = foil(1.0, 0.15, samples=32)
    kappa = kappa_of(0.55)
    m = np.arange(-5, 6)
    wave = jv(m, kappa * 0.15 / 4) ** 2
    np.testing.assert_allclose(order_powers(field, kappa)[np.ix_(m, m)], wave[:, None] * wave, atol=1e-12)


def test_a_hexagonal_foil_has_the_first_orders_of_three_bessel_series():
    period, depth, kappa = 1.3, 0.2, kappa_of(0.55)
    field = foil(period, depth, directions=3, samples=60)
    eta = order_powers(field, kappa)
    # e^{iκh} = Σ i^{l+m+n} J_l J_m J_n e^{2πi (l k_0 + m k_1 + n k_2)·x} and k_2 = k_1 − k_0, so that all (l, m, n) =
    # (a + s, b − s, s) fall together into the order a k_0 + b k_1.
    x, s = kappa * depth / 4.5, np.arange(-20, 21)
    for a, b in ((0, 0), (1, 0), (0, 1), (1, 1), (2, 0), (3, -1)):
        amplitude = np.sum(1j ** (a + b + s) * jv(a + s, x) * jv(b - s, x) * jv(s, x))
        q = (a * np.array([1, 0]) + b * np.array([0.5, np.sqrt(0.75)])) / period
        m = q * field.tile_size
        np.testing.assert_allclose(m, np.rint(m), atol=1e-9)
        column, row = np.rint(m).astype(int)
        assert eta[row, column] == pytest.approx(abs(amplitude) ** 2, abs=1e-12)
    assert field.height_range == pytest.approx(depth, rel=1e-9)
    assert field.tile_size == pytest.approx((2 * period, 2 * period / np.sqrt(3)))


@pytest.mark.parametrize("samples", [16, 30, 64])
@pytest.mark.parametrize("directions", [2, 3])
def test_the_depth_of_a_foil_is_from_its_lowest_to_its_highest_point(directions, samples):
    assert foil(0.9, 0.12, directions=directions, samples=samples).height_range == pytest.approx(0.12, rel=1e-9)


@pytest.mark.parametrize("arguments", [{"directions": 4}, {"directions": "2"}, {"samples": 33}])
def test_an_impossible_foil_is_refused(arguments):
    (name,) = arguments
    with pytest.raises(ValueError, match=f"{name}: got"):
        foil(**arguments)


# ---------------------------------------------------------------- discs


def runs_along_a_track(field, period, track):
    """Lengths of the pits along the middle of a track, µm, whole ones only; to half a pixel each end."""
    column = int((track + 0.5) * period / field.pixel_size[0])
    high = field.heights[:, column] > field.height_range / 2
    edges = np.flatnonzero(np.diff(high.astype(int)))
    starts = edges if not high[0] else edges[1:]
    return np.diff(starts)[::2] * field.pixel_size[1]


@pytest.mark.parametrize("name", sorted(DISCS))
def test_pits_have_the_lengths_and_the_depth_of_the_standard(name):
    make, period, shortest, longest = DISCS[name]
    field = make(pixel_size=0.04, seed=3)
    lengths = np.concatenate([runs_along_a_track(field, period, track) for track in range(15)])
    assert len(lengths) > 80
    # A pit ends where its round end falls to half of the depth; sampled in steps of a pixel.
    assert lengths.min() == pytest.approx(shortest, abs=0.09)
    assert lengths.max() < longest + 0.09
    depth = {"compact_disc": 0.11, "dvd": 0.105}[name]
    assert field.height_range == pytest.approx(depth)
    assert np.mean(field.heights == 0) > 0.5
    assert np.mean(np.isclose(field.heights, depth)) > 0.05


def test_runs_have_maximum_entropy():
    probability = np.array(list(EIGHT_TO_FOURTEEN.values()))
    assert probability.sum() == pytest.approx(1, abs=1e-3)
    field = compact_disc(tracks=120, seed=5, pixel_size=0.05)
    lengths = np.concatenate([runs_along_a_track(field, 1.6, track) for track in range(120)])
    bits = lengths / 0.2777
    mean = np.average(list(EIGHT_TO_FOURTEEN), weights=probability)
    # Closed tracks, and pits that are cut by the patch's edge left out: nearly the same mean.
    assert bits.mean() == pytest.approx(mean, abs=0.25)


@pytest.mark.parametrize("name", sorted(DISCS))
def test_the_strongest_orders_of_a_disc_are_those_of_its_tracks(name):
    make, period, *_ = DISCS[name]
    field = make()
    eta = order_powers(field, kappa_of(0.55))
    eta[0, 0] = 0
    row, column = np.unravel_index(eta.argmax(), eta.shape)
    q = np.array([np.fft.fftfreq(field.shape[1], field.pixel_size[0])[column], row / field.tile_size[1]])
    assert abs(q[0]) == pytest.approx(1 / period)
    assert q[1] == 0
    # A compact disc at 550 nm and normal incidence: 20.1 degrees. A DVD: 48.0.
    angle = np.degrees(np.arcsin(0.55 * abs(q[0])))
    assert angle == pytest.approx({"compact_disc": 20.1, "dvd": 48.0}[name], abs=0.1)


@pytest.mark.parametrize("wavelength", [0.45, 0.55, 0.65])
def test_the_first_order_of_a_disc_follows_from_the_area_of_its_pits(wavelength):
    field = compact_disc(seed=2)
    phase = kappa_of(wavelength) * 0.11
    # The mean of the wave over y is 1 outside the track and 1 + p(e^{iφ} − 1) on its width w, p the fraction of pits.
    area = field.heights.mean() / 0.11 * 1.6 / 0.55
    expected = abs(np.exp(1j * phase) - 1) ** 2 * (area * 0.55 / 1.6 * np.sinc(0.55 / 1.6)) ** 2
    # Walls slope and ends are round.
    assert order_powers(field, kappa_of(wavelength))[0, 20] == pytest.approx(expected, rel=0.15)


@pytest.mark.parametrize("name", sorted(DISCS))
def test_tracks_are_independent_and_a_seed_determines_a_disc(name):
    make, period, *_ = DISCS[name]
    field = make(seed=1)
    middle = ((np.arange(20) + 0.5) * period / field.pixel_size[0]).astype(int)
    correlation = np.corrcoef(field.heights[:, middle].T)
    assert np.abs(correlation - np.eye(20)).max() < 0.6
    np.testing.assert_array_equal(field.heights, make(seed=1).heights)
    assert (field.heights != make(seed=2).heights).mean() > 0.1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"width": 0.9}, "width: got 0.9 µm, wanted 0.1 to 0.8331"),
        ({"width": 0}, "width: got 0, wanted a positive"),
        ({"tracks": 0}, "tracks: got 0"),
        ({"tracks": 2.5}, "tracks: got 2.5"),
        ({"length": 5.0}, "length: got 5.0 µm, wanted at least four of the longest pits, 12.22"),
        ({"pixel_size": 0.5}, "pixel_size: got 0.5 µm, wanted at most half of a pit's width"),
        ({"channel_bit": -1}, "channel_bit: got -1"),
        ({"seed": 0.5}, "seed: got 0.5"),
    ],
)
def test_an_impossible_disc_is_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        compact_disc(**arguments)


@pytest.mark.parametrize(
    ("name", "arguments"),
    [
        ("blazed", {"samples": 10**10}),
        ("crossed", {"period": 1.0, "depth": 0.1, "samples": 10**5}),
        ("foil", {"samples": 10**5}),
        ("compact_disc", {"length": 1e7}),
        ("compact_disc", {"tracks": 10**9}),
        ("compact_disc", {"length": 1e308}),
        ("elaphe_synthetic", {"size": 1e5}),
        ("xenopeltis_synthetic", {"size": 1e308}),
        ("morpho_ridges", {"pixel_size": 1e-6}),
    ],
)
def test_too_large_a_patch_is_refused_before_its_memory_is_allocated(name, arguments):
    with pytest.raises(ValueError, match="pixels, wanted at most"):
        PROFILES[name](**arguments)


def test_a_disc_of_one_long_track_takes_no_more_memory_than_its_heights():
    field = compact_disc(tracks=1, length=5000.0)
    assert field.shape == (100_000, 32)
    # Pits at both ends of the patch, as in its middle.
    mean = field.heights.mean(axis=1)
    assert mean[:8000].mean() == pytest.approx(mean.mean(), rel=0.2)
    assert mean[-8000:].mean() == pytest.approx(mean.mean(), rel=0.2)


# ---------------------------------------------------------------- ridges


def test_ridges_keep_their_period_and_are_uneven():
    field = morpho_ridges(seed=4)
    profile = np.abs(np.fft.rfft(field.heights.mean(axis=0)))
    profile[0] = 0
    assert field.tile_size[0] / profile.argmax() == pytest.approx(0.7)
    tops = field.heights.max(axis=0).reshape(-1)
    ridges = tops[tops > 0.5 * field.height_range]
    assert ridges.std() > 0.05 * field.height_range
    assert "no lamellae" in field.source
    with pytest.raises(ValueError, match=r"width: got 0.8 µm, wanted less than the period"):
        morpho_ridges(width=0.8)


# ---------------------------------------------------------------- the comb of a tile that repeats


@pytest.mark.few(2)
@pytest.mark.parametrize("name", sorted(COHERENCE_LENGTHS))
def test_the_comb_of_a_random_tile_is_blurred(name):
    tile = PROFILES[name]().tile_size
    sigma = lobe_width(COHERENCE_LENGTHS[name])
    for size in tile:
        q = np.linspace(0, 1 / size, 200)
        comb = sum(np.exp(-((q - m / size) ** 2) / (2 * sigma**2)) for m in range(-20, 21))
        assert (comb.max() - comb.min()) / (comb.max() + comb.min()) < 0.006


@pytest.mark.parametrize("name", sorted(COHERENCE_LENGTHS))
def test_a_recipe_and_a_scene_agree_on_coherence_length_and_patches(name):
    recipe = Recipe.load(RECIPES / f"{name}.toml")
    assert recipe.settings.coherence_length == COHERENCE_LENGTHS[name]
    assert recipe.surface["patches"] == PATCHES[name]


# ---------------------------------------------------------------- recipes, and by name in a scene


SMALL = ["blaze", "ruled_600", "ruled_1200", "foil_crossed", "foil_hexagonal", "transmission_300", "transmission_600"]


@pytest.mark.few(3)
@pytest.mark.parametrize(("name", "megabytes"), [*((name, 0.05) for name in SMALL), ("film", 0.11)])
def test_recipes_of_gratings_are_small_and_keep_their_tolerance(name, megabytes):
    spectrum = Recipe.load(RECIPES / f"{name}.toml").build()
    assert spectrum.error <= 1e-3
    assert spectrum.megabytes < megabytes


@pytest.mark.slow
@pytest.mark.parametrize("name", ["compact_disc", "dvd", "morpho_ridges"])
def test_recipes_of_random_surfaces_keep_their_tolerance_in_ten_megabytes(name):
    spectrum = Recipe.load(RECIPES / f"{name}.toml").build()
    assert spectrum.error <= spectrum.tolerance == 0.01
    assert spectrum.megabytes < 10


NAMED = {
    "blazed": {},
    "ruled": {"lines_per_mm": 1200.0},
    "foil": {"directions": 3},
    "film": {"samples": 32},
    "transmission_300": {"facet_angle": 20.0},
    "transmission_600": {},
    "compact_disc": {"tracks": 2, "length": 13.0},
    "dvd": {"tracks": 2, "length": 8.0},
    "elaphe_synthetic": {"size": 7.0},
    "xenopeltis_synthetic": {"size": 6.0},
    "morpho_ridges": {"size": 4.2},
}


@pytest.mark.parametrize("skin", ["elaphe", "xenopeltis"])
def test_a_skin_is_the_measured_one_and_its_synthetic_replica_says_so(skin):
    with pytest.raises(ValueError, match=f"^profile: got '{skin}', wanted one of .*{skin}_synthetic"):
        Recipe({"profile": skin, "size": 7.0})
    assert not hasattr(md.gratings, skin)
    assert "synthetic" in Recipe({"profile": f"{skin}_synthetic", "size": 7.0}).height_field().source
    measured = Recipe.load(source_named(skin))
    assert measured.surface["scan"] == f"measured/{skin}_afm_65um.png"
    assert not {"elaphe", "xenopeltis"} & PROFILES.keys()


def test_a_name_is_a_profile_a_file_or_a_recipe_of_the_package(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    assert source_named("compact_disc") == "compact_disc"
    assert source_named("gone.toml") == "gone.toml"
    assert Path(source_named("elaphe_afm")).samefile(RECIPES / "elaphe_afm.toml")
    Path("elaphe_afm").touch()
    assert source_named("elaphe_afm") == "elaphe_afm"
    with pytest.raises(
        ValueError, match=r"^compact_disk: no file and no surface has this name; did you mean compact_disc\?$"
    ):
        source_named("compact_disk")
    with pytest.raises(
        ValueError, match=r"^qqq: no file and no surface has this name, wanted blazed, .*xenopeltis_afm"
    ):
        source_named("qqq")


def test_a_scene_takes_a_profile_by_filename():
    mi.set_variant("llvm_ad_spectral")
    named, given = (
        mi.load_dict({"type": "diffraction_grating", key: "blazed", "material": "Al", "tolerance": 0.1})
        for key in ("filename", "profile")
    )
    assert named.spectrum is given.spectrum
    for key in ("filename", "profile"):
        with pytest.raises(RuntimeError, match=r"compact_disk.*; did you mean compact_disc"):
            mi.load_dict({"type": "diffraction_grating", key: "compact_disk"})


@pytest.mark.few(1)
@pytest.mark.parametrize("name", sorted(NAMED))
def test_a_ready_surface_is_used_in_a_scene_by_its_name(name):
    mi.set_variant("llvm_ad_spectral")
    numbers = "".join(
        f'<{"integer" if isinstance(value, int) else "float"} name="{key}" value="{value}"/>'
        for key, value in NAMED[name].items()
    )
    bsdf = mi.load_string(
        f'<bsdf version="3.0.0" type="diffraction_grating"><string name="profile" value="{name}"/>{numbers}'
        '<float name="tolerance" value="0.1"/><string name="material" value="Al"/></bsdf>'
    )
    assert PROFILES[name](**NAMED[name]).source in bsdf.spectrum.source
    assert bsdf.spectrum.patches == PATCHES.get(name, 1)
    assert bsdf.spectrum.coherence_length == COHERENCE_LENGTHS.get(name, 65.0)


@pytest.mark.few(1)
@pytest.mark.parametrize("name", ["blazed", "ruled", "foil", "film", "transmission_300"])
def test_gratings_have_defaults_for_all_parameters(name):
    mi.set_variant("llvm_ad_spectral")
    bsdf = mi.load_dict({"type": "diffraction_grating", "profile": name})
    assert bsdf.spectrum.source == PROFILES[name]().source


@pytest.mark.slow
def test_the_tracks_of_a_disc_run_round_it():
    if not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("Dr.Jit finds no LLVM")
    mi.set_variant("llvm_ad_spectral")
    # Light and eye over the disc's centre: the first order of every place lies along its radius.
    distance = 1.0
    scene = mi.load_dict(
        {
            "type": "scene",
            "disc": {
                "type": "disk",
                "bsdf": {"type": "diffraction_grating", "profile": "compact_disc", "tracks": 2, "length": 13.0,
                         "tolerance": 0.05, "material": "Al"},
            },
        }
    )  # fmt: skip
    # At the radius r, light from over the centre comes in at sin θ and is seen from there: 2 sin θ = λ/1.6.
    wavelength = 0.55
    sine = wavelength / 1.6 / 2
    r = distance * sine / np.sqrt(1 - sine**2)
    phi = np.deg2rad(np.arange(0.0, 360.0, 15.0))
    start = np.stack([r * np.cos(phi), r * np.sin(phi), np.ones_like(phi)])
    ray = mi.Ray3f(mi.Point3f(start), mi.Vector3f(0, 0, -1))
    ray.wavelengths = mi.UnpolarizedSpectrum(wavelength * 1e3)
    si = scene.ray_intersect(ray)
    towards = dr.normalize(mi.Point3f(0, 0, distance) - si.p)
    si.wi = si.to_local(towards)
    value = np.array(si.bsdf().eval(mi.BSDFContext(), si, si.to_local(towards)))[0]
    across = dr.normalize(mi.Point3f(0, 0, distance) - mi.Point3f(-si.p.y, si.p.x, si.p.z))
    # The same angles, but along the track: no order there.
    si.wi = si.to_local(dr.normalize(mi.Vector3f(across)))
    dark = np.array(si.bsdf().eval(mi.BSDFContext(), si, si.wi))[0]
    assert value.min() > 30 * dark.max()
    np.testing.assert_allclose(value, value.mean(), rtol=0.02)
