"""The base under the grating: values, samples and components with any BSDF that reflects."""

import colour
import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import (
    albedo,
    array,
    bitmap,
    check_chi_square,
    direction,
    draw,
    evaluate,
    grating,
    interaction,
    random_directions,
    through,
    towards,
    uniform,
    use,
    vectors,
)
from covering import covering

DIFFUSE = {"type": "diffuse", "reflectance": uniform(0.5)}
ROUGH = {"type": "roughconductor", "alpha": 0.3}
SMOOTH = {
    "diffuse": lambda: DIFFUSE,
    "checkerboard": lambda: {
        "type": "diffuse",
        "reflectance": {"type": "checkerboard", "color0": uniform(0.1), "color1": uniform(0.9)},
    },
    "bitmap": lambda: {"type": "diffuse", "reflectance": bitmap(np.random.default_rng(1).random((4, 4, 3)), raw=False)},
    "roughplastic": lambda: {"type": "roughplastic", "alpha": 0.2, "diffuse_reflectance": uniform(0.4)},
    "principled": lambda: {"type": "principled", "base_color": uniform(0.6), "roughness": 0.4, "metallic": 0.3},
    "roughconductor": lambda: ROUGH,
    "blendbsdf": lambda: {"type": "blendbsdf", "weight": 0.3, "first": DIFFUSE, "second": ROUGH},
    "bumpmap": lambda: {
        "type": "bumpmap",
        "texture": bitmap(np.random.default_rng(2).random((8, 8, 1))),
        "scale": 0.05,
        "nested": DIFFUSE,
    },
    "twosided": lambda: {"type": "twosided", "nested": DIFFUSE},
    "grating": lambda: grating("corner", coherence_length=3.0),
}
MIRRORS = {
    "conductor": lambda: {"type": "conductor", "material": "Al"},
    "plastic": lambda: {"type": "plastic", "diffuse_reflectance": uniform(0.5)},
}


def over(base, name="blazed", coherence_length=3.0):
    return mi.load_dict(grating(name, coherence_length, int_ior=1.5, ext_ior=1.0, base=base))


def alone(name="blazed", coherence_length=3.0):
    return mi.load_dict(grating(name, coherence_length, int_ior=1.5, ext_ior=1.0))


pytestmark = pytest.mark.usefixtures("llvm")


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(SMOOTH))
def test_value_is_the_sum_of_the_grating_and_the_transmitted_base(name):
    rng = np.random.default_rng(3)
    wo, uv = random_directions(rng, 500), rng.random((500, 2))
    wi = random_directions(rng, 500)
    base = mi.load_dict(SMOOTH[name]())
    below = evaluate(base, wi, wo, uv=uv)[0]
    assert below.max() > 0.01
    wanted = evaluate(alone(), wi, wo)[0] + through(wi[:, 2]) * through(wo[:, 2]) * below
    np.testing.assert_allclose(evaluate(over(SMOOTH[name]()), wi, wo, uv=uv)[0], wanted, rtol=2e-4, atol=1e-6)


@pytest.mark.few(1)
@pytest.mark.parametrize("name", sorted(SMOOTH))
def test_weights_are_value_over_density_and_average_to_the_albedo(name):
    bsdf, wi, count, uv = over(SMOOTH[name]()), direction(40, 30), 1 << 17, (0.3, 0.4)
    bs, weight = draw(bsdf, wi, count, uv=[uv])
    wo = np.array(bs.wo).T
    value, pdf = evaluate(bsdf, wi, wo, uv=[uv])
    some = np.array(bs.pdf) > 0
    np.testing.assert_allclose(np.array(bs.pdf)[some], pdf[some], rtol=1e-3)
    np.testing.assert_allclose((weight * pdf)[:, some], value[:, some], rtol=2e-3, atol=1e-6)
    error = weight.std(1) / np.sqrt(count)
    wanted = albedo(bsdf, wi, uv=[uv])
    np.testing.assert_array_less(np.abs(weight.mean(1) - wanted), 4 * error + 2e-3 * wanted)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("base", "theta"),
    [
        ("diffuse", 60),
        ("plastic", 0),
        ("roughplastic", 85),
        *(
            pytest.param(base, theta, marks=pytest.mark.slow)
            for base, theta in [
                ("diffuse", 0),
                ("diffuse", 85),
                ("plastic", 60),
                ("plastic", 85),
                ("roughplastic", 0),
                ("roughplastic", 60),
            ]
        ),
    ],
)
def test_samples_pass_the_chi_square_test(base, theta):
    check_chi_square(over({**SMOOTH, **MIRRORS}[base]()), direction(theta, 20), cases=9)


@pytest.mark.few(1)
@pytest.mark.parametrize("name", sorted(MIRRORS))
def test_specular_base_is_attenuated_by_both_transmittances(name):
    wi, count = direction(50, 70), 1 << 16
    bsdf, base = over(MIRRORS[name]()), mi.load_dict(MIRRORS[name]())
    bs, weight = draw(bsdf, wi, count)
    mirror = np.array(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta))
    assert 0.02 < mirror.mean() < 0.95
    np.testing.assert_allclose(np.array(bs.wo).T[mirror], np.tile(wi * [-1, -1, 1], (mirror.sum(), 1)), atol=1e-6)
    # pdf is the fraction of these samples.
    share = np.array(bs.pdf)[mirror]
    np.testing.assert_allclose(share, mirror.mean(), atol=4 * np.sqrt(0.25 / count))
    # What the mirror returns, and with it the whole.
    of_base, of_base_weight = draw(base, wi, count)
    returned = np.where(mi.has_flag(of_base.sampled_type, mi.BSDFFlags.Delta), of_base_weight, 0).mean(1)
    wanted = through(wi[2]) ** 2 * returned
    np.testing.assert_allclose(np.where(mirror, weight, 0).mean(1), wanted, rtol=0.02)
    np.testing.assert_allclose(weight.mean(1), wanted + albedo(bsdf, wi), rtol=0.02)
    # eval and pdf do not see it.
    value, _ = evaluate(bsdf, wi, np.array(bs.wo).T[mirror][:1])
    assert value.max() < 10


@pytest.mark.parametrize(
    "base",
    [
        {"type": "dielectric"},
        {"type": "thindielectric"},
        {"type": "roughdielectric"},
        {"type": "null"},
        {"type": "mask", "opacity": 0.5, "nested": DIFFUSE},
        {"type": "principled", "spec_trans": 0.5},
    ],
    ids=lambda base: base["type"],
)
def test_a_transmissive_base_is_refused(base):
    with pytest.raises((RuntimeError, ValueError), match="base: got a BSDF that lets light through"):
        over(base)


def test_a_base_that_is_no_bsdf_is_refused():
    with pytest.raises((RuntimeError, ValueError), match="base"):
        over(uniform(0.5))


@pytest.mark.parametrize("base", [0.25, "#a0522d", "#FFFFFF"])
def test_a_number_or_a_colour_is_a_diffuse_base(base):
    """Decoded by colour-science."""
    reflectance = base
    if isinstance(base, str):
        encoded = [int(base[i : i + 2], 16) / 255 for i in (1, 3, 5)]
        reflectance = {"type": "rgb", "value": colour.cctf_decoding(encoded, function="sRGB").tolist()}
    wo = random_directions(np.random.default_rng(5), 50)
    wanted = evaluate(over({"type": "diffuse", "reflectance": reflectance}), direction(20), wo)[0]
    np.testing.assert_allclose(evaluate(over(base), direction(20), wo)[0], wanted, rtol=1e-3)


@pytest.mark.parametrize("base", [1.5, -0.1, "#a05", "sienna", True])
def test_a_base_of_no_reflectance_is_refused(base):
    with pytest.raises((RuntimeError, ValueError), match=r"base: got .*, wanted a BSDF, a reflectance from 0 to 1"):
        over(base)


@pytest.mark.slow
def test_flags_and_components_are_those_of_grating_and_base():
    flags = mi.BSDFFlags
    for name, base in (*SMOOTH.items(), *MIRRORS.items()):
        nested, bsdf = mi.load_dict(base()), over(base())
        assert bsdf.component_count() == 1 + nested.component_count()
        assert bsdf.flags(0) & +flags.GlossyReflection
        kinds = +flags.All | +flags.SpatiallyVarying
        for i in range(nested.component_count()):
            assert bsdf.flags(i + 1) & kinds == nested.flags(i) & kinds
        assert not bsdf.flags() & +flags.BackSide
        for flag in (flags.DiffuseReflection, flags.DeltaReflection, flags.SpatiallyVarying):
            assert bool(bsdf.flags() & +flag) == bool(nested.flags() & +flag), (name, flag)


def contexts():
    """Return contexts of the grating alone and of the base alone."""
    result = []
    for index in (0, 1):
        result.append(mi.BSDFContext())
        result[-1].component = index
        result.append(mi.BSDFContext())
        result[-1].type_mask = +(mi.BSDFFlags.GlossyReflection, mi.BSDFFlags.DiffuseReflection)[index]
    return result


def test_components_can_be_evaluated_separately():
    bsdf, wi = over(DIFFUSE), direction(40, 30)
    rng = np.random.default_rng(4)
    wo = random_directions(rng, 200)
    of_grating, its_pdf = evaluate(alone(), wi, wo)
    of_base = through(wi[2]) * through(wo[:, 2]) * 0.5 / np.pi * wo[:, 2] + np.zeros((4, 1))
    wanted = [(of_grating, its_pdf)] * 2 + [(of_base, wo[:, 2] / np.pi)] * 2
    for ctx, (value, pdf), component in zip(contexts(), wanted, (0, 0, 1, 1), strict=True):
        found = evaluate(bsdf, wi, wo, ctx)
        np.testing.assert_allclose(found[0], value, rtol=1e-3, atol=1e-6)
        np.testing.assert_allclose(found[1], pdf, rtol=1e-3)
        bs, weight = draw(bsdf, wi, 1 << 12, ctx)
        assert (np.array(bs.sampled_component) == component).all()
        some = np.array(bs.pdf) > 0
        value, pdf = evaluate(bsdf, wi, np.array(bs.wo).T, ctx)
        np.testing.assert_allclose((weight * pdf)[:, some], value[:, some], rtol=2e-3, atol=1e-6)
    ctx = mi.BSDFContext()
    ctx.component = 2
    assert evaluate(bsdf, wi, wo, ctx)[0].max() == 0
    assert draw(bsdf, wi, 16, ctx)[1].max() == 0


@pytest.mark.parametrize("theta", [0, 30, 60, 85])
@pytest.mark.parametrize("reflectance", [0.02, 0.5])
def test_samples_are_split_in_proportion_to_power(theta, reflectance):
    def fraction(bsdf):
        _, weight = draw(bsdf, direction(theta, 30), 1 << 16)
        w = weight.mean(0)
        assert w.max() < 6 * w.mean()
        return w.mean() ** 2 / (w**2).mean()

    bsdf = over({"type": "diffuse", "reflectance": uniform(reflectance)}, "blazed", 65.0)
    found = fraction(bsdf)
    bsdf.layers._grating_probability = lambda *_: mi.Float(0.5)
    assert found > fraction(bsdf) + 0.04
    if reflectance == 0.5 and theta <= 60:
        assert found > 0.93


def test_samples_follow_a_textured_base():
    bsdf = over(SMOOTH["checkerboard"]())
    shares = []
    for uv in ((0.2, 0.2), (0.7, 0.2)):
        bs, _ = draw(bsdf, direction(20), 1 << 12, uv=[uv])
        shares.append((np.array(bs.sampled_component) == 0).mean())
    assert max(shares) > 2 * min(shares)


@pytest.mark.few(3)
@pytest.mark.parametrize(
    ("theta", "name", "base"),
    covering(
        [0, 70, 89, 30, 45, 80, 85],
        ["blazed", "deep blazed", "elaphe"],
        [{"type": "diffuse", "reflectance": uniform(1.0)}, {"type": "conductor"}],
    ),
)
def test_the_albedo_with_a_base_is_at_most_one(name, base, theta):
    count = 1 << 16
    _, weight = draw(over(base, name, 65.0), direction(theta, 30), count)
    assert weight.mean() > 0.2
    assert (weight.mean(1) <= 1 + 4 * weight.std(1) / np.sqrt(count)).all()


OTHERS = [None, "diffuse", "conductor"]


def over_or_alone(base):
    return alone() if base is None else over({**SMOOTH, **MIRRORS}[base]())


def some_directions(wi):
    return np.concatenate([towards(wi, [[0, 0], [1, 0], [-1, 0]], 500), random_directions(np.random.default_rng(5), 5)])


def values_and_samples(base, wi):
    value, pdf = evaluate(over_or_alone(base), wi, some_directions(wi))
    bs, weight = draw(over_or_alone(base), wi, 16)
    component = np.array(bs.sampled_component) + np.zeros(16)
    return value.T, pdf, np.array(bs.wo).T, np.array(bs.pdf), weight.T, component


@pytest.mark.few(1)
@pytest.mark.parametrize("base", OTHERS)
def test_polarised_variants_agree_with_the_unpolarised(base):
    wi = direction(40, 30)
    wanted = values_and_samples(base, wi)
    use("llvm_ad_spectral_polarized")
    for found, value in zip(values_and_samples(base, wi), wanted, strict=True):
        np.testing.assert_allclose(found, value, rtol=5e-3, atol=2e-4)
    # The grating polarises (test_polarisation.py); neither does a diffuse base, nor a mirror in other directions.
    wo = some_directions(wi)
    si = interaction(np.tile(wi, (len(wo), 1)), count=len(wo))
    value, of_grating = (
        array(bsdf.eval(mi.BSDFContext(), si, vectors(wo))).reshape(16, -1) for bsdf in (over_or_alone(base), alone())
    )
    assert np.abs(of_grating[1:]).max() > 0
    np.testing.assert_array_equal(value[1:], of_grating[1:])
    u = np.random.default_rng(1).random((3, 16)).astype(np.float32)
    si = interaction(np.tile(wi, (16, 1)), count=16)
    bs, weight = over_or_alone(base).sample(mi.BSDFContext(), si, mi.Float(u[0]), mi.Point2f(u[1], u[2]))
    dr.eval(bs, weight)
    if base == "conductor":
        of_mirror = np.array(bs.sampled_component) == 1
        assert np.abs(np.array(weight).reshape(16, 4, 16)[1:][..., of_mirror]).max() > 0.1


def test_base_is_dark_from_behind():
    for name in ("principled", "twosided"):
        bsdf = over(SMOOTH[name]())
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), interaction([0.6, 0, -0.8]), vectors([-0.6, 0, -0.8]))
        assert np.array(value).max() == 0
        assert np.array(pdf).max() == 0


NEGATIVE = r"base: got a reflectance of -5, wanted 0 or more"


@pytest.mark.parametrize(
    ("reflectance", "key"),
    [
        (uniform(0.5), "value"),
        ({"type": "checkerboard", "color0": uniform(0.1), "color1": uniform(0.9)}, "color1.value"),
        (bitmap(np.full((8, 8, 1), 0.5)), "data"),
    ],
)
def test_a_reflectance_changed_to_a_negative_one_is_refused(llvm, reflectance, key):
    # Regression: it gave negative light.
    bsdf = mi.load_dict(
        {"type": "twosided", "nested": grating(int_ior=1.5, base={**DIFFUSE, "reflectance": reflectance})}
    )
    parameters = mi.traverse(bsdf)
    (name,) = (name for name in parameters.keys() if name.endswith(f"base.reflectance.{key}"))  # noqa: SIM118
    parameters[name] = 0.2 * parameters[name]
    parameters.update()
    values = np.array(parameters[name])
    values[(-1,) * values.ndim] = -5
    parameters[name] = type(parameters[name])(values)
    with pytest.raises(ValueError, match=NEGATIVE):
        parameters.update()


def test_a_negative_reflectance_is_refused(llvm):
    with pytest.raises(RuntimeError, match=NEGATIVE):
        mi.load_dict(grating(int_ior=1.5, base={"type": "diffuse", "reflectance": uniform(-5)}))


@pytest.mark.slow
def test_a_varnish_without_diffuse_light_is_sampled_below_a_coat_of_its_index():
    """Regression: only the face of the coat was, as the grating reflects nothing and the base no diffuse light."""
    varnish = {"type": "plastic", "diffuse_reflectance": uniform(0.0), "int_ior": 1.5, "ext_ior": 1.0}
    bsdf = {"type": "diffraction_grating", "profile": "blazed", "coherence_length": 3.0, "base": varnish}
    bsdf = mi.load_dict({**bsdf, "int_ior": 1.5, "ext_ior": 1.0, "coat_ior": 1.5})
    bs, weight = draw(bsdf, direction(37, 0), 1 << 16)
    of_base = np.array(bs.sampled_component) == 1
    reflectance = np.array(mi.fresnel(mi.Float(np.cos(np.deg2rad(37))), 1.5)[0]).item()
    assert np.where(of_base, weight, 0).mean() == pytest.approx((1 - reflectance) ** 2 * reflectance, rel=0.05)
