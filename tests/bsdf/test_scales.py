"""Scales of the relief, numbers and textures, against gratings with scaled heights and lengths."""

import io
import zlib

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import scipy.special
from bsdf_support import (
    PERIOD,
    SURFACES,
    WAVELENGTHS,
    albedo,
    array,
    bitmap,
    check_chi_square,
    direction,
    draw,
    evaluate,
    floats,
    interaction,
    made_up,
    of_spectrum,
    plugin,
    random_directions,
    towards,
    use,
    vectors,
)
from PIL import Image

import mitsuba_diffraction as md
from mitsuba_diffraction import testing
from mitsuba_diffraction.bsdf.varying import numbers_from
from mitsuba_diffraction.errors import RequestError

WI = direction(30, 20)
TRANSMITS = {"int_ior": 1.5, "transmission": "interface"}


def corner():
    """Return `corner_blaze` with enough pixels for its orders at the shortest wavelengths."""
    along_x = md.gratings.blazed(PERIOD, 0.2, samples=96).heights[0]
    return md.HeightField(along_x[None, :] + along_x[:, None], PERIOD / 96)


def scaled(surface, lateral, heights):
    """Return the surface with its lengths and heights scaled."""
    return md.HeightField(surface.heights * heights, np.multiply(surface.pixel_size, lateral))


def steps(values):
    """Return a texture of scales without interpolation."""
    return bitmap(values, filter_type="nearest")


def for_scales(surface, largest, **settings):
    """Return a spectrum that covers scales up to `largest`."""
    return md.precompute(surface, wavelengths=(360 / largest, 830), **settings)


def near_orders(lateral, orders, wi=WI):
    """Return directions of the orders at 500 nm, on the slopes of their lobes, and random ones."""
    wo = [towards(wi, np.add(orders, by), 500, 1 / (PERIOD * lateral)) for by in ([0, 0], [0.02, 0.01])]
    return np.concatenate([*wo, random_directions(np.random.default_rng(0), 500)])


LINE = [(m, 0) for m in range(-6, 7)]
SQUARE = [(m, n) for m in range(-4, 5) for n in range(-4, 5)]


@pytest.mark.few(1)
@pytest.mark.parametrize(("lateral", "heights"), [(1.4, 0.8), (0.6, 1.3)])
@pytest.mark.parametrize(
    ("surface", "orders", "parameters"),
    [
        (SURFACES["blazed"], LINE, {}),
        (corner, SQUARE, {}),
        (SURFACES["blazed"], LINE, {"coat_ior": 1.5}),
        (SURFACES["blazed"], LINE, TRANSMITS),
        (SURFACES["blazed"], LINE, {"int_ior": 1.5, "transmission": "sheet"}),
    ],
    ids=["line", "crossed", "coat", "interface", "sheet"],
)
def test_constant_scales_equal_a_grating_built_with_them(llvm, surface, orders, parameters, lateral, heights):
    """Densities may differ, as their averages are over other intervals of κ."""
    parameters = {"conserve_energy": False, **parameters}
    largest = 1.5 * (1.5 if len(parameters) > 1 else 1)
    of_table = plugin(for_scales(surface(), largest), lateral_scale=lateral, height_scale=heights, **parameters)
    built = plugin(for_scales(scaled(surface(), lateral, heights), largest), **parameters)
    wo = near_orders(lateral, orders)
    if "transmission" in parameters:
        below = near_orders(lateral, orders, WI)
        wo = np.concatenate([wo, below * [1, 1, -1]])
    found, wanted = (evaluate(bsdf, WI, wo)[0] for bsdf in (of_table, built))
    assert wanted.max() > 100
    # Both tables err by their tolerance.
    np.testing.assert_allclose(found, wanted, rtol=2e-3, atol=5e-4 * wanted.max())


@pytest.mark.few(1)
@pytest.mark.parametrize("lateral", [1.4, 0.6])
@pytest.mark.parametrize(
    ("surface", "parameters"), [(SURFACES["blazed"], {}), (corner, {}), (SURFACES["blazed"], TRANSMITS)]
)
def test_samples_of_scaled_gratings_are_unbiased(llvm, surface, parameters, lateral):
    bsdf = plugin(
        for_scales(surface(), 2.5, coherence_length=20),
        **{"lateral_scale": lateral, "height_scale": 1.2, "conserve_energy": False, **parameters},
    )
    ctx = mi.BSDFContext()
    ctx.type_mask = mi.BSDFFlags.GlossyReflection
    count = 1 << 18
    _, weights = draw(bsdf, WI, count, ctx)
    error = weights.std(1) / np.sqrt(count)
    np.testing.assert_array_less(np.abs(weights.mean(1) - albedo(bsdf, WI, ctx=ctx)), 4 * error + 2e-3)
    check_chi_square(bsdf, WI, ctx=ctx)


def test_textures_of_scales_are_read_at_the_point(llvm):
    of = for_scales(SURFACES["blazed"](), 1.5)
    laterals, heights = np.array([[0.7, 1.0], [1.2, 1.5]]), np.array([[0.4, 0.8, 1.1]])
    textured = plugin(of, lateral_scale=steps(laterals), height_scale=steps(heights), conserve_energy=False)
    for v, row in enumerate(laterals):
        for u, lateral in enumerate(row):
            for column, height in enumerate(heights[0]):
                uv = ((u + (column + 0.5) / 3) / 2, (v + 0.5) / 2)
                height = heights[0, int(uv[0] * 3)]
                wo = near_orders(lateral, LINE)
                alone = plugin(of, lateral_scale=lateral, height_scale=height, conserve_energy=False)
                # Their densities differ: orders are drawn by tables for ranges of heights.
                found, wanted = evaluate(textured, WI, wo, uv=uv)[0], evaluate(alone, WI, wo)[0]
                np.testing.assert_allclose(found, wanted, rtol=1e-4, atol=1e-4 * wanted.max())


@pytest.mark.parametrize("given", [{}, {"lateral_scale": 1.0}], ids=["default", "given"])
def test_a_lateral_scale_of_one_costs_nothing_and_can_be_changed(llvm, given):
    of = for_scales(SURFACES["blazed"](), 1)
    bsdf = plugin(of, **given)
    parameters, wo = mi.traverse(bsdf), near_orders(0.8, LINE)
    assert bsdf.layers.grating.scales.lateral is None
    parameters["lateral_scale"] = 0.8
    parameters.update()
    np.testing.assert_allclose(evaluate(bsdf, WI, wo)[0], evaluate(plugin(of, lateral_scale=0.8), WI, wo)[0], rtol=1e-5)


def test_a_profile_is_scaled_up_as_well_as_down(llvm):
    """Its spectrum is computed once for a search that goes up, and is that of the longer period."""
    profile = {"type": "diffraction_grating", "profile": "blazed", "depth": 0.25, "conserve_energy": False}
    bsdf = mi.load_dict({**profile, "period": PERIOD})
    bsdf.cover((380.0, 780.0))
    parameters, spectra = mi.traverse(bsdf), [bsdf.spectrum]
    for scale in (1.1, 1.25):
        parameters["lateral_scale"] = scale
        parameters.update()
        spectra.append(bsdf.spectrum)
    wo = near_orders(scale, LINE)
    wanted = evaluate(mi.load_dict({**profile, "period": PERIOD * scale}), WI, wo)[0]
    np.testing.assert_allclose(evaluate(bsdf, WI, wo)[0], wanted, rtol=2e-3, atol=1e-3 * wanted.max())
    assert spectra[1] is not spectra[0]
    assert spectra[1] is spectra[2]
    assert bsdf.layers.grating.lacks((380.0, 780.0)) == []


def test_a_derivative_by_lengths_of_orders_that_overlap_is_refused(llvm):
    parameters = mi.traverse(plugin(for_scales(SURFACES["blazed"](), 1, coherence_length=5.0)))
    dr.enable_grad(parameters["lateral_scale"])
    parameters.set_dirty("lateral_scale")
    with pytest.raises(ValueError, match=r"lateral_scale: got \[1\] with a derivative, wanted 1: only of orders"):
        parameters.update()


@pytest.mark.parametrize("variant", ["llvm_ad_spectral_polarized"])
def test_scales_in_other_variants(variant):
    of = for_scales(SURFACES["blazed"](), 1.5)
    uv, wo = (0.9, 0.5), near_orders(1.3, [(m, 0) for m in range(-2, 3)])[:10]

    def evaluated(name):
        use(name)
        scales = {"lateral_scale": steps([[0.7, 1.3]]), "height_scale": steps([[0.5, 0.9]]), "conserve_energy": False}
        return evaluate(plugin(of, **scales), WI, wo, uv=uv)

    wanted, found = evaluated("llvm_ad_spectral"), evaluated(variant)
    for a, b in zip(found, wanted, strict=True):
        np.testing.assert_allclose(a, b, rtol=1e-3, atol=1e-4 * b.max())


def difference(function, at, step):
    """Return the central difference of fourth order."""
    f = [function(at + k * step) for k in (-2, -1, 1, 2)]
    return (8 * (f[2] - f[1]) - (f[3] - f[0])) / (12 * step)


@pytest.mark.parametrize(
    "parameters", [{}, pytest.param(TRANSMITS, marks=pytest.mark.slow)], ids=["mirror", "interface"]
)
@pytest.mark.parametrize(("name", "step"), [("height_scale", 0.01), ("lateral_scale", 1e-3)])
def test_derivatives_by_texels_are_those_of_differences(llvm, name, step, parameters):
    start = np.random.default_rng(3).uniform(0.85, 0.95, (2, 3, 1)).astype(np.float32)
    scales = {"lateral_scale": 0.9, name: bitmap(start)}
    settings = {"conserve_energy": False, **scales, **parameters}
    bsdf = plugin(for_scales(SURFACES["sinusoidal"](), 1.5, coherence_length=20), **settings)
    # Values of separate orders do not depend on the sampler.
    bsdf.layers.grating.theory.update = lambda: None
    scene, key = mi.traverse(bsdf), f"{name}.data"
    wo = near_orders(0.9, np.repeat(np.array(LINE)[3:-3], 3, axis=0))
    wo = wo[: len(wo) - 500]
    rng = np.random.default_rng(1)
    weights, uv = rng.uniform(0.5, 1.5, len(wo)), rng.random((len(wo), 2))
    si = interaction(np.tile(WI, (len(wo), 1)), (500.0,) * 4, len(wo), uv)

    def value(tensor):
        scene[key] = tensor
        scene.update()
        return bsdf.eval(mi.BSDFContext(), si, vectors(wo))[1]

    x = mi.TensorXf(start)
    dr.enable_grad(x)
    dr.backward(dr.sum(value(x) * floats(weights)))
    found = np.array(dr.grad(x))
    scale = np.abs(found).max()
    assert scale > 1
    for place in np.ndindex(*start.shape):
        one = np.zeros_like(start)
        one[place] = 1

        def total(s, one=one):
            return array(value(mi.TensorXf(start + np.float32(s) * one)), np.float64).ravel() @ weights

        np.testing.assert_allclose(found[place], difference(total, 0.0, step), rtol=0.01, atol=5e-3 * scale)


@pytest.mark.slow
def test_recipes_and_profiles_are_built_for_the_scales(llvm):
    parameters = {"type": "diffraction_grating", "profile": "blazed", "period": 1.0, "depth": 0.1}
    parameters["conserve_energy"] = False
    bsdf = mi.load_dict(parameters | {"lateral_scale": steps([[0.5, 1.5]]), "height_scale": 1.2})
    assert bsdf.spectrum.wavelengths == pytest.approx((240, 830))
    assert bsdf.layers.components[0] & +mi.BSDFFlags.SpatiallyVarying
    bsdf = mi.load_dict(parameters | {"height_scale": 2.0, "coat_ior": 1.5})
    assert bsdf.spectrum.wavelengths == pytest.approx((120, 830 / 1.5), rel=1e-3)


@pytest.mark.parametrize(
    ("parameters", "message"),
    [
        ({"lateral_scale": [[0.5, 1.25]]}, "lateral_scale: got 1.25, wanted 0.01 to 1: .* 360 nm; .* here 288 nm"),
        ({"height_scale": [[0.5, 1.25]]}, "height_scale: got 1.25, wanted 0 to 1: .* here 288 nm"),
        ({"height_scale": [[-0.5, 0.5]]}, "height_scale: got -0.5, wanted 0 to 1"),
        ({"lateral_scale": [[0.0, 0.5]]}, "lateral_scale: got 0, wanted 0.01 to 1"),
        ({"lateral_scale": [[np.nan, 0.5]]}, "lateral_scale: got values that are not finite"),
        ({"lateral_scale": "a"}, "lateral_scale: got 'a', wanted a number or the file of a picture"),
        ({"lateral_scale": {"type": "mesh_attribute", "name": "vertex_s"}}, "MeshAttribute, whose range is not known"),
        ({"coherence_length": 5.0, "lateral_scale": 0.5}, "lateral_scale: got .*0.5.*, wanted 1: only of orders"),
        (
            {"lateral_scale": [[0.5, 1.0]], "theory": "rigorous"},
            "lateral_scale: got a texture, wanted none with theory=rigorous: build the spectrum of the other period",
        ),
    ],
)
def test_scales_that_the_spectrum_does_not_cover_are_refused(llvm, parameters, message):
    """The message is one line with the spectrum to build."""
    parameters = {name: steps(v) if isinstance(v, list) else v for name, v in parameters.items()}
    if "theory" in parameters:
        of, parameters = made_up(), {"material": "Al", "lateral_scale": parameters["lateral_scale"]}
    else:
        of = for_scales(SURFACES["blazed"](), 1, coherence_length=parameters.pop("coherence_length", 65.0))
    with pytest.raises(RuntimeError, match=message) as caught:
        mi.load_dict(of_spectrum(of, **parameters))
    assert "\n" not in str(caught.value).split("lateral_scale: got")[-1].strip()


def test_scales_that_let_orders_overlap_are_refused(llvm):
    of = for_scales(corner(), 1.5, coherence_length=10)
    with pytest.raises(RuntimeError, match=r"lateral_scale: got .*1.5.*, wanted 1 or less than 1\.\d+: only"):
        plugin(of, lateral_scale=1.5)


def albedo_of_orders(bsdf, of, wi, wavelength, lateral, uv):
    """Return ∫ f cos θ_o dω_o = ∫ f du dv at one wavelength (nm), by quadrature over the lobes of all orders."""
    # The horizon cuts lobes near it.
    half = 10 if wi[2] > 0.1 else 40
    offsets = 3.2 / half * of.lobe_width * np.arange(-half, half + 1)
    q = [(q[:, None] / lateral + offsets).ravel() for q in of.grid.frequencies()]
    t = -1e-3 * wavelength * np.stack(np.meshgrid(*q), -1).reshape(-1, 2) - wi[:2]
    t = t[(t**2).sum(-1) < 1 - 1e-8]
    wo = np.concatenate([t, np.sqrt(1 - (t**2).sum(-1, keepdims=True))], -1)
    value = evaluate(bsdf, wi, wo, uv=uv, wavelengths=(wavelength,) * 4)[0][0].astype(np.float64)
    return (value / wo[:, 2]).sum() * (1e-3 * wavelength * (offsets[1] - offsets[0])) ** 2


def grazing(rng, count):
    """Return directions up to 89.5°, half of them uniform in solid angle, half in the polar angle."""
    uniform = random_directions(rng, count, 0.01)
    polar = direction(rng.uniform(0, 89.5, count), rng.uniform(0, 360, count))
    return np.where(rng.random(count)[:, None] < 0.5, uniform, polar)


SCALED = {
    "sinusoidal": lambda: md.gratings.sinusoidal(1.0, 0.25),
    "blazed": lambda: md.gratings.blazed(2.5, 0.25),
    "foil": lambda: md.gratings.foil(1.0, 0.15, directions=3),
}


@pytest.mark.parametrize(
    ("name", "pairs"),
    [("sinusoidal", 8), *(pytest.param(name, 100, marks=pytest.mark.slow) for name in sorted(SCALED))],
)
def test_the_albedo_is_at_most_one_at_random_scales(llvm, name, pairs):
    """At most 1.02, and above 1.01 for one pair of 100, with more scales than the table has nodes for."""
    rng, side = np.random.default_rng(5), int(np.ceil(np.sqrt(pairs)))
    of = for_scales(SCALED[name](), 1.6, coherence_length=65)
    laterals, heights = rng.uniform(0.6, 1.6, (side, side)), rng.uniform(0, 1.6, (side, side))
    if pairs < 20:
        # An interval of few tables.
        laterals, heights = (rng.uniform(0.8, 0.9, (side, side)) for _ in range(2))
    bsdf = plugin(of, lateral_scale=steps(laterals), height_scale=steps(heights))
    found = [
        albedo_of_orders(
            bsdf, of, wi, rng.uniform(360, 830), laterals[place], ((place[1] + 0.5) / side, (place[0] + 0.5) / side)
        )
        for place, wi in zip(list(np.ndindex(side, side))[:pairs], grazing(rng, pairs), strict=True)
    ]
    assert max(found) <= 1.02
    assert (np.array(found) > 1.01).sum() <= 1
    assert np.mean(found) > 0.7


@pytest.mark.slow
@pytest.mark.parametrize("name", ["sinusoidal", pytest.param("foil", marks=pytest.mark.slow)])
def test_e_of_few_scales_is_that_of_separate_gratings(llvm, name):
    """E of each of three pitches is that of a grating built with that pitch."""
    of, laterals = for_scales(SCALED[name](), 1.5, coherence_length=65), (0.8, 1.0, 1.4)
    bsdf = plugin(of, lateral_scale=steps([laterals]))
    rng = np.random.default_rng(6)
    for k, lateral in enumerate(laterals):
        alone = plugin(for_scales(scaled(SCALED[name](), lateral, 1), 1.5, coherence_length=65))
        place = (k + 0.5) / 3, 0.5
        pairs = [[albedo_of_orders(b, of, wi, 450.0, lateral, place) for b in (bsdf, alone)] for wi in grazing(rng, 8)]
        assert np.max(pairs) <= 1.01
        # The grid cells of both tables differ, and with them the local loss.
        found, wanted = np.mean(pairs, axis=0)
        assert found > wanted - 0.01


@pytest.mark.slow
@pytest.mark.parametrize("parameters", [{"material": "none"}, TRANSMITS], ids=["reflected", "transmitted"])
def test_e_of_very_different_heights_is_that_of_each(llvm, parameters):
    """For deep and shallow reliefs, from both sides of an interface."""
    index, heights, count = parameters.get("int_ior", 1.0), (0.1, 1.0), 200
    of = md.precompute(md.gratings.foil(1.5, 0.6, directions=2), wavelengths=(360 / index, 830 / index))
    both = plugin(of, height_scale=steps([heights]), **parameters)
    wi, wo = (random_directions(np.random.default_rng(seed), count) for seed in (7, 8))

    def found(bsdf, height, under):
        energy = bsdf.layers.grating.theory.energy
        pair = [energy.coordinates(vectors(omega)) for omega in (wi * [1, 1, under], wo)]
        return np.array(energy.factor(pair, floats(np.full(count, 1 / 0.55)), mi.Float(height)))

    for height in heights:
        alone = plugin(of, height_scale=height, **parameters)
        for under in (1, -1) if "transmission" in parameters else (1,):
            difference = found(both, height, under) - found(alone, height, under)
            assert np.abs(difference.mean()) < 0.01
            assert np.abs(difference).mean() < 0.03


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:pixels of")
@pytest.mark.parametrize("scale", ["number", pytest.param("texel", marks=pytest.mark.slow)])
@pytest.mark.parametrize("surface", ["blazed", pytest.param("xenopeltis_synthetic", marks=pytest.mark.slow)])
def test_a_relief_of_no_height_is_a_plane(llvm, surface, scale):
    """Regression: at a height scale of 0 rounding errors of the table were multiplied by K, up to 1e7."""
    shape = {
        "blazed": {"period": PERIOD, "depth": 0.3},
        "xenopeltis_synthetic": {"coherence_length": 10.0, "patches": 1},
    }
    grating = {"type": "diffraction_grating", "profile": surface, **shape[surface], "int_ior": 1.5, "ext_ior": 1.0}
    grating["height_scale"] = steps([0.0, 1.0]) if scale == "texel" else 0.0
    uv = (0.25, 0.5)
    for mode, wi, wanted in (
        ("sheet", direction(30, 20), (1 - mi.fresnel(mi.Float(np.cos(np.pi / 6)), 1.5)[0][0]) ** 2),
        ("interface", direction(60, 20) * [1, 1, -1], 0.0),  # total reflection
    ):
        bsdf = mi.load_dict({**grating, "transmission": mode})
        wo, weights, _ = testing.sample(bsdf, np.tile(wi, (20_000, 1)), WAVELENGTHS, uv=uv)
        transmitted = np.where((wo[:, 2] * wi[2] < 0)[:, None], weights, 0).mean()
        assert transmitted == pytest.approx(wanted, abs=0.01)
    # Uniform directions find what samples miss.
    above = random_directions(np.random.default_rng(1), 20_000)
    assert evaluate(bsdf, wi, above, uv=uv)[0].mean() * 2 * np.pi < 0.05


@pytest.mark.parametrize("transmission", ["interface", "sheet"])
def test_undiffracted_light_of_a_finer_grating_is_that_of_the_closed_form(llvm, transmission):
    """(1 − F) J₀(π (n − 1) h/λ)², on a grid about order 0; at lateral scales below one it was extrapolated as κ²."""
    surface = {"profile": "sinusoidal", "period": 5.0, "depth": 0.3, "int_ior": 1.5, "ext_ior": 1.0}
    scales = {"height_scale": 0.1, "lateral_scale": 0.3, "conserve_energy": False}
    bsdf = mi.load_dict({"type": "diffraction_grating", **surface, **scales, "transmission": transmission})
    context = mi.BSDFContext()
    context.mode = mi.TransportMode.Importance
    for wavelength in (450.0, 650.0, 800.0):
        step = wavelength * 1e-3 * bsdf.spectrum.lobe_width / (1.5 if transmission == "interface" else 1) / 5
        t = np.stack(np.meshgrid(*[np.arange(-30, 31) * step] * 2), -1).reshape(-1, 2)
        wo = np.column_stack([t, -np.sqrt(1 - (t**2).sum(-1))])
        value, _ = testing.evaluate_pdf(bsdf, np.array([0, 0, 1.0]), wo, [wavelength] * 4, context)
        power = (value[:, 0] / -wo[:, 2]).sum() * step**2
        wanted = 0.96 * scipy.special.jv(0, np.pi * 0.5 * 0.03 / (wavelength * 1e-3)) ** 2
        assert power == pytest.approx(wanted * (0.96 if transmission == "sheet" else 1), rel=0.01)


def test_a_picture_that_would_fill_the_memory_is_refused(llvm, tmp_path):
    # A PNG of one row says that it has 13,000.
    path, written = tmp_path / "large.png", io.BytesIO()
    Image.new("L", (13_000, 1)).save(written, "PNG")
    content = bytearray(written.getvalue())
    content[20:24] = (13_000).to_bytes(4, "big")
    content[29:33] = zlib.crc32(content[12:29]).to_bytes(4, "big")
    path.write_bytes(content)
    with pytest.raises(RequestError, match=r"got a picture of 169000000 numbers in 0.1 kB, wanted at most"):
        numbers_from("height_scale", str(path))
