"""The integrator `diffraction_path` compared with Mitsuba's `path`."""

import signal
from functools import partial

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import bitmap, grating, uniform, use

import mitsuba_diffraction  # noqa: F401 (settles which LLVM is used before a variant is set)
from mitsuba_diffraction.integrator.eye_paths import _power_heuristic
from mitsuba_diffraction.integrator.paths import Gratings, LightPaths, SplatBuffer
from mitsuba_diffraction.integrator.scene_cache import SceneCache
from mitsuba_diffraction.render import scene_file
from mitsuba_diffraction.render.scene_file import SceneFile
from mitsuba_diffraction.render.spectral_film import channel_weights
from mitsuba_diffraction.render.trace_pass import trace_pass

SUN = {"type": "directional", "direction": [0, 0.6, -0.8], "irradiance": uniform(1.0)}
SKY = {"type": "constant", "radiance": uniform(0.05)}


def blaze(coherence_length=1.5, **parameters):
    """A grating, by default with lobes so wide that `path` converges as well; without E, for speed."""
    return grating("blazed", coherence_length, conserve_energy=False, **parameters)


def at(*position):
    return mi.ScalarTransform4f().translate(position)


def diffuse(reflectance):
    return {"type": "diffuse", "reflectance": uniform(reflectance)}


def plate(bsdf, scale=1.0, height=0.1):
    return {"type": "rectangle", "to_world": at(0, 0, height).scale(scale), "bsdf": bsdf}


def scene(sensor=None, film=None, **parts):
    """A floor and a wall behind it, white; z is up, and the camera looks along y."""
    look = mi.ScalarTransform4f().look_at([0, -3.5, 2.5], [0, 0.5, 0.5], [0, 0, 1])
    size = {"width": 8, "height": 8, "component_format": "float32", "pixel_format": "rgb", "rfilter": {"type": "box"}}
    wall = at(0, 1.5, 0).rotate([1, 0, 0], 90).scale(4)
    return mi.load_dict(
        {
            "type": "scene",
            "sensor": {
                **{"type": "perspective", "fov": 60, "to_world": look, **(sensor or {})},
                **{"film": {"type": "hdrfilm", **size, **(film or {})}, "sampler": {"type": "independent"}},
            },
            "floor": {"type": "rectangle", "to_world": mi.ScalarTransform4f().scale(4), "bsdf": diffuse(0.6)},
            "wall": {"type": "rectangle", "to_world": wall, "bsdf": diffuse(0.8)},
            **parts,
        }
    )


def sun_alone():
    return scene(plate=plate(blaze(material="Al"), height=0.4), sun=SUN)


def taylor_terms():
    bsdf = {"type": "diffraction_grating", "profile": "blazed", "coherence_length": 1.5, "conserve_energy": False}
    return scene(plate=plate({**bsdf, "material": "Al", "representation": "taylor", "terms": 20}, height=0.4), sun=SUN)


def sun_and_sky():
    """A grating with pigment on both sides of a plate."""
    pigment = blaze(int_ior=1.8, base=diffuse(0.4))
    return scene(plate={**plate({"type": "twosided", "bsdf": pigment}, height=0.4)}, sun=SUN, sky=SKY)


def lamp_and_spot():
    """Two gratings, one with a direction that varies over the plate, a mirror, and a camera with a lens."""
    orientation = {
        **{"type": "bitmap", "raw": True, "filter_type": "nearest"},
        "bitmap": mi.Bitmap(np.array([[0, 90], [45, 120]], np.float32)[..., None]),
    }
    mirror = {"type": "conductor", "material": "none"}
    return scene(
        sensor={"type": "thinlens", "aperture_radius": 0.2, "focus_distance": 4.0},
        plate=plate(blaze(material="Al", orientation=orientation)),
        ball={"type": "sphere", "center": [-1, 0.3, 0.5], "radius": 0.4, "bsdf": blaze(material="Al")},
        mirror={"type": "rectangle", "to_world": at(2.2, 0.5, 1).rotate([0, 1, 0], -90), "bsdf": mirror},
        lamp={
            **{"type": "sphere", "center": [0.5, -1, 3], "radius": 0.3},
            "emitter": {"type": "area", "radiance": uniform(2.0)},
        },
        spot={
            **{"type": "spot", "intensity": uniform(2.0), "cutoff_angle": 25},
            "to_world": mi.ScalarTransform4f().look_at([-1, -2, 3], [0, 0, 0], [0, 1, 0]),
        },
    )


def tilted_normals(degrees):
    """A texture for `normalmap` that tilts the normal by the same angle everywhere."""
    angle = np.deg2rad(degrees)
    return bitmap(np.tile((np.array([np.sin(angle), 0, np.cos(angle)]) + 1) / 2, (2, 2, 1)))


def ramp():
    """A texture for `bumpmap`: a plane that rises along u and v, with a step at its edge."""
    u = (np.arange(8) + 0.5) / 8
    return bitmap(0.7 * u[None, :] + 0.3 * u[:, None], filter_type="bilinear", wrap_mode="clamp")


def blend_under_a_point():
    """A grating blended with a mirror, on a normal map, which tilts the normal by 15°."""
    blend = {"type": "blendbsdf", "weight": 0.3, "grating": blaze()}
    blend["mirror"] = {"type": "roughconductor", "material": "Al", "alpha": 0.4}
    tilted = {"type": "normalmap", "normalmap": tilted_normals(15), "bsdf": blend}
    light = {"type": "point", "position": [0, -1, 3], "intensity": uniform(5.0)}
    return scene(plate=plate({"type": "twosided", "bsdf": tilted}), light=light, sky=SKY)


def perturbed(kind, flips, shadows, **coat):
    """Sunlight at 60° on a grating with a perturbed normal, bare or under a coat that reflects as a mirror does."""
    sun = {"type": "directional", "direction": [0.8, 0.3, -0.5], "irradiance": uniform(1.0)}
    bsdf = {
        **{"normalmap": {"normalmap": tilted_normals(15)}, "bumpmap": {"texture": ramp(), "scale": 0.3}}[kind],
        **{"type": kind, "flip_invalid_normals": flips, "use_shadowing_function": shadows},
        "bsdf": {"type": "diffraction_grating", "profile": "blazed", "coherence_length": 1.5, "material": "Al", **coat},
    }
    return scene(plate=plate({"type": "twosided", "bsdf": bsdf}, height=0.4), sun=sun, sky=SKY)


def lamp_that_is_a_grating():
    """A sphere that glows faintly, under a spot light."""
    glow = {"type": "area", "radiance": uniform(0.02)}
    ball = {"type": "sphere", "center": [0.1, 0.2, 0.8], "radius": 0.5, "bsdf": blaze(material="Al"), "emitter": glow}
    to_world = mi.ScalarTransform4f().look_at([0.1, -1.5, 3], [0.1, 0.2, 0.8], [0, 1, 0])
    spot = {"type": "spot", "intensity": uniform(2.0), "cutoff_angle": 9, "to_world": to_world}
    return scene(ball=ball, spot=spot)


def group_of_gratings(sun=SUN, sky=SKY, **parts):
    """An instance of a grating and a white ball."""
    ball = {"type": "sphere", "center": [0, 0, 0.6], "radius": 0.3, "bsdf": diffuse(0.5)}
    group = {"type": "shapegroup", "grating": plate(blaze(material="Al"), 0.5), "ball": ball}
    instance = {"type": "instance", "to_world": at(1, 0, 0.2), "group": {"type": "ref", "id": "group"}}
    return scene(group=group, instance=instance, sun=sun, sky=sky, **parts)


def instance_beside_a_grating(**lights):
    return group_of_gratings(plate=plate(blaze(material="Al"), 0.5, 0.4), **lights)


def ball_of_light():
    """A lamp for which candidates are drawn."""
    emitter = {"type": "area", "radiance": uniform(0.5)}
    return {"type": "sphere", "center": [0.4, -0.8, 3.4], "radius": 1.0, "emitter": emitter}


def curve_beside_a_grating(tmp_path):
    path = tmp_path / "curve.txt"
    path.write_text("-1 0 0.5 0.1\n0 0 0.8 0.1\n0.5 0.5 0.6 0.1\n1 0.5 0.5 0.1\n1.5 0.7 0.5 0.1\n")
    curve = {"type": "bsplinecurve", "filename": str(path), "bsdf": blaze(material="Al")}
    return scene(curve=curve, plate=plate(blaze(material="Al"), 0.5, 0.4), sun=SUN, sky=SKY)


def film(kind, facing=1, **parameters):
    """A film above the floor, its relief above (`facing` 1) or below (−1)."""
    turned = mi.ScalarTransform4f().rotate([0, 1, 0], 0 if facing > 0 else 180)
    bsdf = {"type": "diffraction_grating", "profile": "blazed", "coherence_length": 1.5, "transmission": kind}
    bsdf = {**bsdf, "conserve_energy": False, **parameters}
    return {"type": "rectangle", "to_world": at(0, 0, 0.8) @ turned, "bsdf": bsdf}


def window(kind, facing=1):
    """Sunlight transmitted to the floor by a film."""
    return scene(pane=film(kind, facing), sun=SUN)


def films_between_lamps(kind="sheet"):
    """A film on a normal map between an area light and a point light below it, and an upright film."""
    tilted = film(kind)
    tilted["bsdf"] = {"type": "normalmap", "normalmap": tilted_normals(11.5), "bsdf": tilted["bsdf"]}
    return scene(
        tilted=tilted,
        upright={**film(kind), "to_world": at(1.2, -0.3, 1).rotate([1, 0, 0], 70).scale(0.6)},
        lamp={
            **{"type": "sphere", "center": [0.3, -0.8, 2.5], "radius": 0.3},
            "emitter": {"type": "area", "radiance": uniform(2.0)},
        },
        below={"type": "point", "position": [-0.4, 0.5, 0.3], "intensity": uniform(0.3)},
    )


def halves(picture):
    """Means over 2 × 2 regions of a picture."""
    rows, columns = picture.shape[:2]
    return picture[..., :3].reshape(2, rows // 2, 2, columns // 2, 3).mean((1, 3, 4))


def region_means(built, integrator, spp, pictures=12):
    """Means and their standard errors, (2, 2) each, from independent pictures."""
    means = [halves(np.array(mi.render(built, integrator=integrator, spp=spp, seed=k))) for k in range(pictures)]
    return np.mean(means, 0), np.std(means, 0, ddof=1) / np.sqrt(pictures)


def assert_agree(built, depth, spp, **parameters):
    names = ("path", "diffraction_path")
    integrators = [mi.load_dict({"type": name, "max_depth": depth, **parameters}) for name in names]
    (wanted, its_error), (found, error) = (region_means(built, each, spp) for each in integrators)
    np.testing.assert_array_less(np.abs(found - wanted), 4 * np.hypot(its_error, error))
    # Without the paths from the light the check would fail.
    eye, light = integrators[1].parts(built, built.sensors()[0])
    left, _ = region_means(built, eye, spp, pictures=4)
    assert light is not None
    assert ((wanted - left) / its_error).max() > 6


@pytest.mark.parametrize(
    ("build", "depth", "spp"),
    [
        (sun_alone, 3, 512),
        pytest.param(partial(window, "interface"), 3, 1024, marks=pytest.mark.slow, id="enters"),
        pytest.param(partial(window, "interface", -1), 3, 1024, marks=pytest.mark.slow, id="leaves"),
        pytest.param(partial(window, "sheet"), 3, 1024, marks=pytest.mark.slow, id="relief first"),
        pytest.param(partial(window, "sheet", -1), 3, 1024, marks=pytest.mark.slow, id="flat face first"),
        pytest.param(films_between_lamps, 5, 2048, marks=pytest.mark.slow, id="films"),
        pytest.param(partial(films_between_lamps, "interface"), 5, 2048, marks=pytest.mark.slow, id="glass"),
        pytest.param(taylor_terms, 3, 1024, marks=pytest.mark.slow),
        pytest.param(sun_and_sky, 4, 1024, marks=pytest.mark.slow),
        pytest.param(lamp_and_spot, 5, 2048, marks=pytest.mark.slow),
        pytest.param(blend_under_a_point, -1, 1024, marks=pytest.mark.slow),
        pytest.param(lamp_that_is_a_grating, 3, 512, marks=pytest.mark.slow),
        pytest.param(instance_beside_a_grating, 4, 1024, marks=pytest.mark.slow),
        pytest.param(
            lambda: instance_beside_a_grating(sun=ball_of_light()),
            5,
            2048,
            marks=pytest.mark.slow,
            id="lamp and instance",
        ),
    ],
)
def test_converges_to_the_limit_of_path(build, depth, spp, llvm):
    assert_agree(build(), depth, spp, rr_depth=3)


@pytest.mark.slow
def test_instances_alone_have_the_limit_of_path(llvm):
    """No light is traced from gratings, but direct light on them is drawn by candidates."""
    built = group_of_gratings(sun=ball_of_light(), sky={**SKY, "radiance": uniform(0.005)})
    integrators = [mi.load_dict({"type": name, "max_depth": 4}) for name in ("path", "diffraction_path")]
    eye, light = integrators[1].parts(built, built.sensors()[0])
    assert (eye.candidates.any, light) == (True, None)
    (wanted, its_error), (found, error) = (region_means(built, each, 1024) for each in integrators)
    np.testing.assert_array_less(np.abs(found - wanted), 4 * np.hypot(its_error, error))


@pytest.mark.slow
def test_converges_beside_a_curve(llvm, tmp_path):
    assert_agree(curve_beside_a_grating(tmp_path), 4, 1024)


@pytest.mark.parametrize("is_instance", [False, True])
def test_no_light_leaves_points_of_a_grating_in_a_curve(llvm, tmp_path, is_instance):
    """Regression: rays from the inside of a curve do not meet it, so that paths from the light left it."""
    path = tmp_path / "curve.txt"
    path.write_text("".join(f"{x} 0 0.5 0.3\n" for x in (-0.9, -0.3, 0.3, 0.9)))
    parts = {"curve": {"type": "linearcurve", "filename": str(path), "bsdf": diffuse(0.5)}}
    if is_instance:
        group = {"type": "shapegroup", **parts}
        parts = {"group": group, "copy": {"type": "instance", "group": {"type": "ref", "id": "group"}}}
    assert_agree(scene(**parts, plate=plate(blaze(material="Al"), 0.5, 0.4), sun=SUN), 3, 256)


@pytest.mark.slow
@pytest.mark.parametrize("shadows", [True, False], ids=["shadowing", "no shadowing"])
@pytest.mark.parametrize("flips", [True, False], ids=["flips", "no flips"])
@pytest.mark.parametrize(("kind", "coat"), [("normalmap", {}), ("normalmap", {"coat_ior": 1.5}), ("bumpmap", {})])
def test_converges_with_perturbed_normals(kind, coat, flips, shadows, llvm):
    assert_agree(perturbed(kind, flips, shadows, **coat), 4, 1024)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("grating", "where"),
    [
        (lambda: plate(blaze(26.0, material="Al"), 0.5), np.s_[:4]),
        (lambda: film("sheet", coherence_length=26.0), np.s_[4:]),
    ],
    ids=["onto a wall", "through a film onto the floor"],
)
def test_light_cast_by_a_grating_is_far_less_noisy_than_with_path(grating, where, llvm):
    built = scene(grating=grating(), sun=SUN)
    noise = {}
    for name in ("path", "diffraction_path"):
        integrator = mi.load_dict({"type": name, "max_depth": 3})
        pictures = [np.array(mi.render(built, integrator=integrator, spp=64, seed=k))[where] for k in range(12)]
        noise[name] = np.var(pictures, 0, ddof=1).mean()
    assert noise["path"] > 50 * noise["diffraction_path"], noise


def test_light_paths_begin_where_gratings_are_lit(llvm):
    """Three of four plates lie in the shadow; one of four candidates is lit with a probability of 1 − (3/4)⁴."""
    roof = plate({"type": "twosided", "bsdf": diffuse(0.5)}, height=1.0)
    roof["to_world"] = at(0, 0, 1.0).scale([3, 1, 1])
    transforms = [at(x, 0.75, 0.1).scale(0.3) for x in (-2, -1, 1)] + [at(0, -2.5, 0.1).scale(0.3)]
    plates = {f"plate{k}": {"type": "rectangle", "to_world": to, "bsdf": blaze()} for k, to in enumerate(transforms)}
    built = scene(roof=roof, sun=SUN, **plates)
    _, light = mi.load_dict({"type": "diffraction_path", "max_depth": 3}).parts(built, built.sensors()[0])
    _, power, _, starts = light._start(mi.PCG32(size=2**14))
    assert dr.mean(mi.Float(starts))[0] == pytest.approx(1 - 0.75**4, abs=0.02)
    assert dr.all(dr.any(power != 0) | ~starts)


@pytest.mark.slow
def test_each_wavelength_of_a_start_has_a_path_of_its_own(llvm):
    """Each direction of a line grating of narrow lobes has one of the four wavelengths."""
    built = scene(plate=plate(blaze(26.0), 0.5), sun=SUN)
    _, light = mi.load_dict({"type": "diffraction_path", "max_depth": 3}).parts(built, built.sensors()[0])
    starts = 1000
    buffer = SplatBuffer(4 * starts)
    light._trace(0, 0, starts, 1.0, buffer)
    path = np.sort(np.array(buffer._path)[: buffer.count()])
    values = buffer.content()[:, -4:]
    strongest = np.full((starts, 4), -1)
    # Not the zeroth order, in which all wavelengths have the same direction.
    strongest.flat[path] = np.where(values.max(1) > 0.9 * values.sum(1), values.argmax(1), -1)
    seen = strongest[(strongest >= 0).all(1)]
    assert len(seen) > 100
    assert (np.sort(seen, 1) == np.arange(4)).all(1).mean() > 0.5


def test_an_infinite_density_has_the_weight_zero(llvm):
    """The square of that of a lamp at grazing incidence overflows."""
    assert dr.all(_power_heuristic(mi.Float([1e30, np.inf]), mi.Float(1)) == 0)


def test_buffers_of_later_launches_are_large_enough_at_once(llvm, monkeypatch):
    built = scene(plate=plate(blaze(), 0.5), sun=SUN)
    _, light = mi.load_dict({"type": "diffraction_path", "max_depth": 3}).parts(built, built.sensors()[0])
    traced = []
    original = LightPaths._trace
    monkeypatch.setattr(LightPaths, "_trace", lambda *arguments: traced.append(0) or original(*arguments))
    light._capacity = 0.1
    wanted = list(light.splats(1, 4000))
    assert len(traced) == 2
    found = list(light.splats(1, 4000))
    assert len(traced) == 3
    np.testing.assert_array_equal(found, wanted)


@pytest.mark.parametrize(
    ("kind", "transform", "is_drawn_on"),
    [
        ("disk", lambda: at(2000, 1000, 0).rotate([0.8, 0, 0.6], 40), True),
        ("disk", lambda: mi.ScalarTransform4f(np.eye(4) + 0.3 * np.eye(4, k=1)), True),
        ("sphere", lambda: at(1, 2, 3).scale(1e-3), True),
        # Mitsuba takes its transpose for its inverse.
        ("disk", lambda: mi.ScalarTransform4f().rotate([1, 0, 0.3], 40), False),
        ("sphere", lambda: mi.ScalarTransform4f().scale([1, 1, 2]), False),
    ],
)
def test_points_are_drawn_on_shapes_only_where_rays_find_them(kind, transform, is_drawn_on, llvm):
    shape = {"type": kind, "to_world": transform(), "bsdf": blaze()}
    assert len(Gratings(mi.load_dict({"type": "scene", "shape": shape}), SceneCache()).shapes) == is_drawn_on


def beam_on_a_grating():
    """All light in the room is cast by the plate."""
    beam = mi.ScalarTransform4f().look_at([0, -2.3, 3.5], [0, 0, 0.4], [0, 1, 0])
    spot = {"type": "spot", "intensity": uniform(8.0), "cutoff_angle": 11, "to_world": beam}
    return scene(plate=plate(blaze(material="Al"), height=0.4), spot=spot)


def small_grating_in_the_sun():
    return scene(plate=plate(blaze(material="Al"), 0.05, height=0.4), sun=SUN)


@pytest.mark.parametrize(("build", "number"), [(beam_on_a_grating, 1 / 2), (small_grating_in_the_sun, 1 / 64)])
def test_light_paths_are_as_many_as_their_light_in_the_picture_requires(build, number, llvm):
    built = build()
    integrator = mi.load_dict({"type": "diffraction_path", "max_depth": 3})
    found = [integrator.parts(built, built.sensors()[0])[1] for _ in range(2)]
    assert [light.per_sample for light in found] == [number, number]
    assert found[0].count(64) == 64 * 64 * number


@pytest.mark.slow
def test_few_light_paths_have_the_expectation_of_many(llvm, monkeypatch):
    built = sun_alone()
    integrator = mi.load_dict({"type": "diffraction_path", "max_depth": 3})
    monkeypatch.setattr(LightPaths, "_number_per_sample", lambda self: 1 / 64)
    few, error = region_means(built, integrator, 4096)
    monkeypatch.setattr(LightPaths, "_number_per_sample", lambda self: 1 / 2)
    many, its_error = region_means(built, integrator, 512)
    np.testing.assert_array_less(np.abs(few - many), 4 * np.hypot(error, its_error))
    assert (error < 0.02 * many.max()).all()


@pytest.mark.few(4)
@pytest.mark.parametrize(
    ("bsdf", "traces"),
    [
        (diffuse(0.0), False),
        (diffuse(0.1), True),
        # The coefficients of Mitsuba's upsampled grey are 0, 0, 0; those of black are 0, 0, −8192.
        ({"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.5, 0.5, 0.5]}}, True),
        ({"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.0, 0.0, 0.0]}}, False),
        ({"type": "diffuse", "reflectance": {"type": "rgb", "value": [0.0, 0.0, 0.7]}}, True),
        ({"type": "diffuse", "reflectance": {"type": "spectrum", "value": [(600, 0), (601, 1), (602, 0)]}}, True),
        ({"type": "diffuse", "reflectance": {"type": "checkerboard", "color0": 0.0, "color1": 0.0}}, True),
        ({"type": "twosided", "bsdf": diffuse(0.2)}, True),
        ({"type": "conductor"}, True),
    ],
)
def test_light_paths_are_traced_only_if_a_surface_reflects_them(bsdf, traces, llvm, monkeypatch):
    monkeypatch.setattr(LightPaths, "_number_per_sample", lambda self: 0.5)  # traces a pilot
    lamp = {**plate(bsdf, height=2.0), "emitter": {"type": "area", "radiance": uniform(1.0)}}
    built = scene(floor=plate(blaze(), 4, 0), wall=plate(blaze(), 0.5), lamp=lamp)
    eye, light = mi.load_dict({"type": "diffraction_path", "max_depth": 3}).parts(built, built.sensors()[0])
    assert type(eye).__name__ == "EyePaths"
    assert (light is not None) == traces


def two_gratings():
    """A ball of which a floor shows the image; both are gratings."""
    narrow = blaze(26.0, material="Al")
    ball = {"type": "sphere", "center": [0, 0, 0.8], "radius": 0.8, "bsdf": narrow}
    return scene(floor=plate(narrow, 4, 0), wall=ball, sky=SKY)


def image_of_a_wall(bsdf, coherence_length=1.5, x=0, tilt=90):
    """A plate that lights a wall, which is seen in the plate alone."""
    wall = {"type": "rectangle", "to_world": at(x, 1.5, 0).rotate([1, 0, 0], tilt).scale(4), "bsdf": bsdf}
    camera = {"to_world": mi.ScalarTransform4f().look_at([x, -3.5, 2.5], [x, 0, 0.1], [0, 0, 1]), "fov": 6}
    lit = {"type": "rectangle", "to_world": at(x, 0, 0.1).scale(0.5), "bsdf": blaze(coherence_length, material="Al")}
    return scene(camera, plate=lit, wall=wall, sun=SUN)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("build", "depth", "spp", "ratio"),
    [
        pytest.param(two_gratings, 6, 32, 1.4),
        pytest.param(
            partial(image_of_a_wall, {"type": "plastic"}), 4, 1024, 2, id="plastic wall", marks=pytest.mark.slow
        ),
        # Mitsuba offsets the origins of rays by 1e-4 of the coordinates.
        pytest.param(
            partial(image_of_a_wall, diffuse(0.8), x=100, tilt=60),
            4,
            1024,
            1,
            id="far from the origin",
            marks=pytest.mark.slow,
        ),
        pytest.param(partial(image_of_a_wall, diffuse(0.8), 26.0), 4, 1024, 4, id="wall", marks=pytest.mark.slow),
    ],
)
def test_light_of_two_gratings_is_less_noisy_than_with_path(build, depth, spp, ratio, llvm):
    built, noise, means, errors = build(), [], [], []
    for name in ("path", "diffraction_path"):
        integrator = mi.load_dict({"type": name, "max_depth": depth})
        # Of a wall so many that a single bright path does not decide.
        count = 48 if depth == 4 else 12
        pictures = np.array([mi.render(built, integrator=integrator, spp=spp, seed=k) for k in range(count)])
        noise.append(pictures.var(0, ddof=1).mean())
        means.append(pictures.mean())
        errors.append(pictures.mean((1, 2, 3)).std(ddof=1) / np.sqrt(len(pictures)))
    assert abs(means[0] - means[1]) < 4 * np.hypot(*errors)
    assert noise[0] > ratio * noise[1], noise


@pytest.mark.few(1)
@pytest.mark.parametrize(("bsdf", "depth"), [(blaze, 1), (blaze, 2), (lambda: diffuse(0.5), 5)])
def test_without_light_cast_by_gratings_it_is_path(bsdf, depth, llvm):
    # At the first grating the light of a sun has wavelengths of its own.
    sun = {} if bsdf is blaze and depth == 2 else {"sun": SUN}
    built = scene(plate=plate(bsdf()), sky=SKY, **sun)
    pictures = [
        np.array(mi.render(built, integrator=mi.load_dict({"type": name, "max_depth": depth}), spp=4, seed=3))
        for name in ("path", "diffraction_path")
    ]
    np.testing.assert_array_equal(*pictures)


def test_polarised_variants_trace_from_the_eye():
    use("llvm_ad_spectral_polarized")
    built = scene(plate=plate(blaze()), sun=SUN)
    integrator = mi.load_dict({"type": "diffraction_path", "max_depth": 3})
    assert integrator.parts(built, built.sensors()[0]) == (integrator.path, None)


def test_sensors_without_a_connection_trace_from_the_eye(llvm):
    built = scene(plate=plate(blaze()), sun=SUN)
    integrator = mi.load_dict({"type": "diffraction_path"})
    assert integrator.parts(built, mi.load_dict({"type": "orthographic"})) == (integrator.path, None)


@pytest.mark.parametrize(
    ("parameters", "message"), [({"hide_emitters": True}, "hide_emitters: got true"), ({"max_dept": 3}, "max_dept")]
)
def test_wrong_parameters_are_refused(parameters, message, llvm):
    with pytest.raises(RuntimeError, match=message):
        mi.load_dict({"type": "diffraction_path", **parameters})


def test_samples_outside_the_edge_are_refused(llvm):
    with_border = {"sample_border": True, "rfilter": {"type": "gaussian"}}
    built = scene(plate=plate(blaze()), sun=SUN, film=with_border)
    with pytest.raises(ValueError, match="sample_border: got true"):
        mi.load_dict({"type": "diffraction_path"}).render(built)


SCENE = """<scene version="3.0.0">
    <integrator type="diffraction_path"><integer name="max_depth" value="4"/></integrator>
    <sensor type="perspective"><float name="fov" value="60"/>
        <transform name="to_world"><lookat origin="0,-3.5,2.5" target="0,.5,.5" up="0,0,1"/></transform>
        <film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="12"/>
            <integer name="crop_offset_x" value="3"/><integer name="crop_width" value="12"/>
            <integer name="crop_offset_y" value="2"/><integer name="crop_height" value="8"/>
            <rfilter type="gaussian"/></film>
    </sensor>
    <shape type="rectangle"><transform name="to_world"><scale value="4"/></transform></shape>
    <shape type="rectangle"><transform name="to_world"><rotate x="1" angle="90"/><scale value="4"/>
        <translate y="1.5"/></transform></shape>
    <shape type="rectangle"><transform name="to_world"><translate z=".1"/></transform>
        <bsdf type="diffraction_grating"><string name="profile" value="blazed"/><float name="period" value="2.5"/>
            <float name="depth" value="0.25"/><float name="coherence_length" value="6"/>
            <string name="material" value="none"/></bsdf></shape>
    <emitter type="directional"><vector name="direction" x="0" y=".6" z="-.8"/></emitter>
</scene>"""


@pytest.mark.slow
def test_any_number_of_light_paths_has_the_same_kernel_of_a_body_recorded_once(llvm, tmp_path, monkeypatch):
    (tmp_path / "scene.xml").write_text(SCENE)
    built = SceneFile(tmp_path / "scene.xml").load()
    _, light = built.integrator().parts(built, built.sensors()[0])
    hashes, recorded, scatter = [], [], light._scatter
    monkeypatch.setattr(light, "_scatter", lambda *arguments: recorded.append(0) or scatter(*arguments))
    for count in (300, 700):
        dr.kernel_history_clear()
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
            assert list(light.splats(0, count))
            hashes.append({kernel["hash"] for kernel in dr.kernel_history((dr.KernelType.JIT,))})
    assert hashes[0] == hashes[1]
    assert len(recorded) == 2


@pytest.mark.slow
def test_passes_do_not_depend_on_threads_and_agree_with_mitsubas_film(llvm, tmp_path):
    path = tmp_path / "scene.xml"
    path.write_text(SCENE)
    built = SceneFile(path).load()
    threads = dr.thread_count()
    try:
        passes = []
        for count in (1, 3):
            dr.set_thread_count(count)
            passes.append(trace_pass(built, 64, 5))
    finally:
        dr.set_thread_count(threads)
    np.testing.assert_array_equal(*passes)
    own = [trace_pass(built, 1024, k) for k in range(4)]
    own = np.mean([halves(each[..., :-1] / each[..., -1:]) for each in own], 0)
    theirs = np.mean([halves(np.array(mi.render(built, spp=1024, seed=k)) / channel_weights()) for k in range(4)], 0)
    np.testing.assert_allclose(own, theirs, rtol=0.1)


@pytest.mark.few(1)
def test_aov_around_it_gives_its_picture(llvm):
    built = sun_alone()
    inner = {"type": "diffraction_path", "max_depth": 3}
    around = mi.load_dict({"type": "aov", "aovs": "z:depth", "inner": inner})
    own = np.array(mi.render(built, integrator=mi.load_dict(inner), spp=16, seed=5))
    channels = np.array(mi.render(built, integrator=around, spp=16, seed=5))
    assert channels.shape[2] == own.shape[2] + 1
    np.testing.assert_allclose(channels[..., :3], own[..., :3], rtol=1e-4)


@pytest.mark.slow
@pytest.mark.parametrize("mode", ["forward", "backward"])
def test_gradients_are_finite_differences(llvm, mode):
    built = sun_alone()
    integrator = mi.load_dict({"type": "diffraction_path", "max_depth": 3})
    params = mi.traverse(built)

    def brightness(reflectance):
        params["wall.bsdf.reflectance.value"] = reflectance
        params.update()
        return dr.mean(mi.render(built, params, integrator=integrator, seed=7, spp=256), axis=None)

    # Light scattered twice by the wall exceeds max_depth, so that the brightness is a linear function.
    finite = (brightness(mi.Float(0.9)) - brightness(mi.Float(0.7))) / 0.2
    reflectance = mi.Float(0.8)
    dr.enable_grad(reflectance)
    picture = brightness(reflectance)
    if mode == "forward":
        dr.forward(reflectance)
    else:
        dr.backward(picture)
    found = dr.grad(picture if mode == "forward" else reflectance)
    np.testing.assert_allclose(np.array(found).item(), np.array(finite).item(), rtol=0.03)


@pytest.mark.slow
def test_both_halves_draw_the_lines_of_a_lamp(llvm, tmp_path, monkeypatch):
    path = tmp_path / "scene.xml"
    line = '<spectrum name="irradiance" value="545:0, 546:1, 547:0"/></emitter>'
    path.write_text(SCENE.replace("</emitter>", line))

    def pictures():
        built = SceneFile(path).load()
        eye, _ = built.integrator().parts(built, built.sensors()[0])
        for k in range(8):
            whole = trace_pass(built, 32, k)[..., :-1].sum((0, 1, 2))
            from_eye = trace_pass(built, 32, k, eye)[..., :-1].sum((0, 1, 2))
            yield from_eye, whole - from_eye

    found = np.array(list(pictures()))
    # Drawn by the response of the film alone they have the same mean and far more noise.
    monkeypatch.setattr(scene_file, "draw_wavelengths_of_lights", lambda built: None)
    wanted = np.array(list(pictures()))
    error = np.std(wanted, 0, ddof=1) / np.sqrt(len(wanted))
    np.testing.assert_array_less(np.abs(found.mean(0) - wanted.mean(0)), 4 * error)
    np.testing.assert_array_less(10 * np.var(found, 0, ddof=1), np.var(wanted, 0, ddof=1))


@pytest.mark.slow
def test_a_light_that_draws_no_wavelengths_is_rendered(llvm, tmp_path):
    path, colours = tmp_path / "scene.xml", '<texture type="checkerboard" name="radiance"/>'
    lamp = f'<shape type="rectangle"><emitter type="area">{colours}</emitter></shape></scene>'
    path.write_text(SCENE.replace("</scene>", lamp))
    assert np.isfinite(trace_pass(SceneFile(path).load(), 4, 1)).all()


@pytest.mark.slow
def test_the_handler_of_ctrl_c_is_kept(llvm):
    built = scene(plate=plate(blaze()), sun=SUN)
    handler = signal.signal(signal.SIGINT, signal.default_int_handler)
    try:
        mi.render(built, integrator=mi.load_dict({"type": "diffraction_path", "max_depth": 3}), spp=1)
        with pytest.raises(KeyboardInterrupt):
            signal.raise_signal(signal.SIGINT)
    finally:
        signal.signal(signal.SIGINT, handler)
