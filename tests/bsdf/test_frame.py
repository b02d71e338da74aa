"""The orientation of the pattern in the world, from the direction into which a blazed corner reflects."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import PERIOD, WAVELENGTHS, array, corner_blaze, evaluate, grating, vectors

from mitsuba_diffraction.settings import lobe_width

DOWN = (0.0, 0.0, -1.0)
SQUARE = np.array([(0, 0), (1, 0), (1, 1), (0, 1)], float)
S = np.sqrt(0.5)


pytestmark = pytest.mark.usefixtures("llvm")


def scale(*factors):
    return mi.ScalarTransform4f().scale(list(factors))


def corner(**parameters):
    """Return the plugin without E, which does not depend on frames and takes long."""
    return grating("corner", conserve_energy=False, **parameters)


def mesh(uv=None):
    """Return the unit square of two triangles, (0 1 2) and (0 2 3), with or without UVs."""
    result = mi.Mesh("square", 4, 2, has_vertex_texcoords=uv is not None)
    parameters = mi.traverse(result)
    corners = np.concatenate([SQUARE, np.zeros((4, 1))], 1)
    parameters["vertex_positions"] = mi.Float(corners.ravel().astype(np.float32))
    parameters["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
    if uv is not None:
        parameters["vertex_texcoords"] = mi.Float(np.asarray(uv, np.float32).ravel())
    parameters.update()
    return result


def bent(uv, to_world, folder):
    """Return the same from a file, transformed by `to_world`."""
    path = folder / "square.ply"
    mesh(uv).write_ply(str(path))
    return {"type": "ply", "filename": str(path), "face_normals": True, "to_world": to_world}


def hit(shape, origin, towards, bsdf):
    """Return the interaction of a ray with the shape, which must have `bsdf`."""
    if isinstance(shape, dict):
        shape = {**shape, "bsdf": bsdf}
    scene = mi.load_dict({"type": "scene", "shape": shape})
    ray = mi.Ray3f(mi.Point3f(*map(float, origin)), mi.Vector3f(*map(float, towards)))
    si = scene.ray_intersect(ray)
    # Before the scene goes, on which what is not yet computed depends.
    dr.eval(si)
    assert dr.all(si.is_valid())
    si.wavelengths = type(si.wavelengths)(*WAVELENGTHS)
    return si


def world(si, bsdf, omega):
    """Return f cos θ_o at 500 nm for directions (n, 3) in the world."""
    return array(bsdf.eval(mi.BSDFContext(), si, si.to_local(vectors(omega))))[1]


def orders(mirror, x, y, n):
    """Return the directions of the orders (1, 1), (1, −1), (−1, 1), (−1, −1) at 500 nm, in the world."""
    step = 0.5 / PERIOD
    tangent = mirror - n * (mirror @ n)
    result = []
    for a, b in ((1, 1), (1, -1), (-1, 1), (-1, -1)):
        t = tangent - step * (a * x + b * y)
        result.append(t + n * np.sqrt(1 - t @ t))
    return np.array(result)


def check(shape, origin, towards, n, x, y, orientation=0.0, wrap=lambda nested: nested):
    """Check that the order (1, 1) of the corner, and it alone, is bright, towards −x −y."""
    bsdf = mi.load_dict(wrap(corner(orientation=orientation)))
    plain = mi.load_dict(corner())
    n, x, y, d = (np.asarray(v, float) for v in (n, x, y, towards))
    d = d / np.linalg.norm(d)
    si = hit(shape, origin, d, bsdf)
    mirror = d - 2 * n * (n @ d)
    found = world(si, bsdf, orders(mirror, x, y, n))
    # The plain grating on a table of its own.
    axes = np.stack([x, y, n])
    wanted = evaluate(plain, -axes @ d, orders(axes @ mirror, *np.eye(3)))[0][1]
    assert wanted[0] > 5 * max(wanted[1:])
    np.testing.assert_allclose(found, wanted, rtol=0.02, atol=1e-3 * wanted[0])


def test_the_corner_blaze_rises_along_x_and_y():
    h = corner_blaze().heights
    assert (np.diff(h[0])[:-1] > 0).all()
    assert (np.diff(h[:, 0])[:-1] > 0).all()


FLAT = {
    "rectangle": ({"type": "rectangle"}, (1, 0, 0), (0, 1, 0)),
    "rectangle of mirrored u": ({"type": "rectangle", "to_world": (-1, 1, 1)}, (-1, 0, 0), (0, -1, 0)),
    "rectangle of mirrored v": ({"type": "rectangle", "to_world": (1, -1, 1)}, (1, 0, 0), (0, 1, 0)),
    "stretched rectangle": ({"type": "rectangle", "to_world": (2, 0.5, 1)}, (1, 0, 0), (0, 1, 0)),
    "mesh": (SQUARE, (1, 0, 0), (0, 1, 0)),
    "mesh of mirrored u": (SQUARE * [-1, 1], (-1, 0, 0), (0, -1, 0)),
    "mesh of mirrored v": (SQUARE * [1, -1], (1, 0, 0), (0, 1, 0)),
    "mesh of exchanged u and v": (SQUARE[:, ::-1], (0, 1, 0), (-1, 0, 0)),
    "mesh of sheared u": (SQUARE @ [[1, 0], [0.5, 1]], (1, 0, 0), (0, 1, 0)),
    # u = x, v = x + y: dp_du is (1, −1), at 45° to dp_dv.
    "mesh of sheared v": (SQUARE @ [[1, 1], [0, 1]], (S, -S, 0), (S, S, 0)),
}


@pytest.mark.few(8)
@pytest.mark.parametrize(
    ("towards", "orientation"), [(DOWN, 0.0), ((0.3, -0.2, -1.0), 30.0)], ids=["normal", "oblique and turned"]
)
@pytest.mark.parametrize("name", sorted(FLAT))
def test_x_lies_along_dp_du_and_y_across(name, towards, orientation):
    shape, x, y = FLAT[name]
    if not isinstance(shape, dict):
        shape = mesh(shape)
    elif "to_world" in shape:
        shape = {**shape, "to_world": scale(*shape["to_world"])}
    x, y, a = np.array(x, float), np.array(y, float), np.deg2rad(orientation)
    x, y = np.cos(a) * x + np.sin(a) * y, np.cos(a) * y - np.sin(a) * x
    origin = np.array([0.4, 0.2, 0]) - 2 * np.array(towards)
    check(shape, origin, towards, (0, 0, 1), x, y, orientation)


@pytest.mark.parametrize(
    ("at", "x"),
    [((0.4, 0.2), (1, 0, 0)), ((0.2, 0.4), (S, S, 0))],
    ids=["first triangle", "second triangle"],
)
def test_mesh_without_uvs_takes_the_first_edge_of_each_triangle(at, x):
    check(mesh(), (*at, 2), DOWN, (0, 0, 1), x, np.cross((0, 0, 1), x))


def test_mesh_of_one_uv_for_all_has_one_frame():
    si = [hit(mesh(np.zeros((4, 2))), (*at, 2), DOWN, None) for at in ((0.4, 0.2), (0.2, 0.4))]
    s, t = (np.array([np.array(getattr(i.sh_frame, axis)).ravel() for i in si]) for axis in "st")
    np.testing.assert_array_equal(s[0], s[1])
    check(mesh(np.zeros((4, 2))), (0.4, 0.2, 2), DOWN, (0, 0, 1), s[0], t[0])


@pytest.mark.parametrize("factors", [(-1, 1, 1), (1, -1, 1), (-2, 3, 1)])
def test_mirrored_mesh_keeps_its_handedness(tmp_path, factors):
    """The normal of a mesh follows its triangles: a mirrored one is seen from below, with u along ±x."""
    shape = bent(SQUARE, scale(*factors), tmp_path)
    x = np.array([np.sign(factors[0]), 0, 0.0])
    place = np.array([0.4 * factors[0], 0.2 * factors[1], 0])
    si = hit(shape, place + 2 * np.array([0, 0, 1.0]), DOWN, mi.load_dict(corner()))
    n = np.array(si.sh_frame.n).ravel()
    check(shape, place + 2 * n, -n, n, x, np.cross(n, x))


def test_flipped_normals_reverse_y():
    shape = {"type": "rectangle", "flip_normals": True}
    check(shape, (0.4, 0.2, -2), (0, 0, 1), (0, 0, -1), (1, 0, 0), (0, -1, 0))


@pytest.mark.parametrize("at", [(0.3, 0.2), (-0.5, 0.1), (0.1, -0.6)])
@pytest.mark.parametrize("oblique", [0.0, 0.3])
def test_sphere_has_x_along_its_parallels(at, oblique):
    n = np.array([*at, np.sqrt(1 - at[0] ** 2 - at[1] ** 2)])
    x = np.array([-n[1], n[0], 0]) / np.hypot(n[0], n[1])
    towards = -n + oblique * x
    # On a sphere y is −dp_dv: v grows from the north pole.
    check({"type": "sphere"}, n - towards, towards, n, x, np.cross(n, x))


def test_disk_has_x_along_its_radius():
    x = np.array([0.6, 0.8, 0])
    check({"type": "disk"}, (*(0.5 * x[:2]), 2), DOWN, (0, 0, 1), x, np.cross((0, 0, 1), x))


@pytest.mark.parametrize("orientation", [0.0, "radial"])
def test_poles_of_a_sphere_are_finite(orientation):
    bsdf = mi.load_dict(corner(orientation=orientation))
    si = hit({"type": "sphere"}, (0, 0, 3), DOWN, bsdf)
    value = world(si, bsdf, orders(np.array([0, 0, 1.0]), *np.eye(3)))
    assert np.isfinite(value).all()
    assert value.max() > 0


@pytest.mark.slow
def test_back_of_a_twosided_surface_is_the_mirror_image():
    def twosided(nested):
        return {"type": "twosided", "nested": nested}

    # In the world the light goes to −x −y on either side: x, y and the normal −z are left-handed.
    for z in (1.0, -1.0):
        check({"type": "rectangle"}, (0.4, 0.2, 2 * z), (0, 0, -z), (0, 0, z), (1, 0, 0), (0, 1, 0), wrap=twosided)
    a = np.deg2rad(30)
    x, y = (np.cos(a), np.sin(a), 0), (-np.sin(a), np.cos(a), 0)
    check({"type": "rectangle"}, (0.4, 0.2, -2), (0.2, 0.1, 1), (0, 0, -1), x, y, 30.0, twosided)


def test_x_is_perpendicular_to_interpolated_normals(tmp_path):
    """x is dp_du minus its component along the shading normal, not the geometric one."""
    result = mi.Mesh("square", 4, 2, has_vertex_texcoords=True, has_vertex_normals=True)
    parameters = mi.traverse(result)
    n = np.array([0.3, 0.1, 1]) / np.linalg.norm([0.3, 0.1, 1])
    parameters["vertex_positions"] = mi.Float(np.c_[SQUARE, np.zeros(4)].ravel().astype(np.float32))
    parameters["faces"] = mi.UInt32([0, 1, 2, 0, 2, 3])
    parameters["vertex_texcoords"] = mi.Float(SQUARE.ravel().astype(np.float32))
    parameters["vertex_normals"] = mi.Float(np.tile(n, 4).astype(np.float32))
    path = tmp_path / "square.ply"
    result.write_ply(str(path))
    x = np.array([1, 0, 0]) - n * n[0]
    x /= np.linalg.norm(x)
    place = np.array([0.4, 0.2, 0])
    check({"type": "ply", "filename": str(path)}, place + 2 * n, -n, n, x, np.cross(n, x))


def test_period_is_that_of_the_pattern():
    """The step from order to order is λ/T, so that the directions above are those of bright orders."""
    bsdf = mi.load_dict(corner())
    si = hit({"type": "rectangle", "to_world": scale(3, 3, 3)}, (0.4, 0.2, 2), DOWN, bsdf)
    on = world(si, bsdf, orders(np.array([0, 0, 1.0]), *np.eye(3)))[0]
    off = world(si, bsdf, orders(np.array([0, 0, 1.0]), *(1.2 * np.eye(3)[:2]), np.eye(3)[2]))[0]
    assert on > 1e3 * off


@pytest.mark.parametrize("word", ["radial", "tangential"])
@pytest.mark.parametrize(
    "linear", [np.eye(2), [[0, -1], [1, 0]], [[-0.3, 0], [0, 0.3]], [[0.5, 0.4], [0, 0.7]]], ids=str
)
def test_a_radial_pattern_points_away_from_the_centre_of_uv_space(word, linear):
    """On a square of turned, mirrored or sheared UVs."""
    centre, point = np.array([0.4, 0.55]), np.array([0.65, 0.3])
    x = np.append(point - centre, 0) / np.linalg.norm(point - centre)
    y = np.cross((0, 0, 1), x)
    if word == "tangential":
        x, y = y, -x
    check(mesh((SQUARE - centre) @ np.transpose(linear) + 0.5), (*point, 2), DOWN, (0, 0, 1), x, y, word)


def test_a_radial_pattern_runs_along_a_curve(tmp_path):
    (tmp_path / "curve.txt").write_text("-2 0 0 0.5\n-1 0 0 0.5\n1 0 0 0.5\n2 0 0 0.5\n")
    curve = mi.load_dict({"type": "bsplinecurve", "filename": str(tmp_path / "curve.txt")})
    n = np.array([0, 0.6, 0.8])
    check(curve, (0.2, *(3 * n[1:])), -n, n, (1, 0, 0), np.cross(n, (1, 0, 0)), "radial")


# Pictures of four shapes side by side, and what the grating equation predicts, from their geometry alone.
SIDE, LINES, LENGTH = 24, 2.0, 4.0  # pixels of a shape; period and coherence length, µm
BANDS = np.arange(0.42, 0.701, 0.04)  # µm
SUN = np.array([0.3, 0.25, np.sqrt(1 - 0.3**2 - 0.25**2)])
PLACES = {"rectangle": -3.6, "disk": -1.2, "sphere": 1.2, "cylinder": 3.6}


def photographed(orientation):
    """Return a picture (SIDE, 4 SIDE, bands) from above of line gratings in the sun; the axes of round shapes are y."""
    at, upright = mi.ScalarTransform4f().translate, mi.ScalarTransform4f().rotate([1, 0, 0], -90)
    inner = {"sphere": upright, "cylinder": upright @ at([0, 0, -1]) @ scale(1, 1, 2)}
    lines = {"type": "diffraction_grating", "profile": "sinusoidal", "period": LINES, "depth": 0.1, "material": "none"}
    bsdf = mi.load_dict({**lines, "coherence_length": LENGTH, "conserve_energy": False, "orientation": orientation})
    peaks = {f"{x:.2f}".replace(".", "_"): f"{1e3 * x - 9}, {1e3 * x}, {1e3 * x + 9}" for x in BANDS}
    bands = {name: {"type": "irregular", "wavelengths": peak, "values": "0, 1, 0"} for name, peak in peaks.items()}
    above = mi.ScalarTransform4f().look_at([0, 0, 5], [0, 0, 0], [0, 1, 0]) @ scale(4.8, 4.8, 1)
    film = {"type": "specfilm", "width": 4 * SIDE, "height": SIDE, "component_format": "float32", **bands}
    film["rfilter"] = {"type": "box"}
    scene = {
        "type": "scene",
        "integrator": {"type": "path", "max_depth": 2},
        "sensor": {"type": "orthographic", "to_world": above, "film": film},
        "sun": {"type": "directional", "direction": (-SUN).tolist(), "irradiance": {"type": "uniform", "value": 1.0}},
        **{
            name: {"type": name, "to_world": at([x, 0, 0]) @ inner.get(name, scale(1, 1, 1)), "bsdf": bsdf}
            for name, x in PLACES.items()
        },
    }
    return np.array(mi.render(mi.load_dict(scene), spp=128, seed=1))


def predicted(shape, word):
    """Return the lobes of the orders ±1 on one shape, (SIDE, SIDE, bands), and where to compare them.

    Left out are the outlines and the mirror image of the sun.
    """
    at = 1.2 * ((np.arange(4 * SIDE) + 0.5) / (2 * SIDE) - 1)
    x, y = np.meshgrid(at, -at)
    z = {"sphere": np.sqrt(np.maximum(1 - x**2 - y**2, 0)), "cylinder": np.sqrt(np.maximum(1 - x**2, 0))}
    normals = {"sphere": (x, y, z.get(shape)), "cylinder": (x, 0 * y, z.get(shape))}
    n = np.stack(normals.get(shape, (0 * x, 0 * x, 0 * x + 1)), -1)
    axis = np.broadcast_to([0, 1.0, 0], n.shape)
    across = {"sphere": axis - n * n[..., 1:2], "cylinder": axis}.get(shape, np.stack([x, y, 0 * x], -1))
    if word == "tangential":
        across = np.cross(n, across)
    across = across / np.linalg.norm(across, axis=-1, keepdims=True)
    both = SUN + np.array([0, 0, 1.0])
    q = ((both - n * (n @ both)[..., None])[..., None, :]) / BANDS[:, None]
    lobes = sum(
        np.exp(-((q - m * across[..., None, :] / LINES) ** 2).sum(-1) / (2 * lobe_width(LENGTH) ** 2)) for m in (-1, 1)
    )
    far = np.hypot(x, y) if shape in ("disk", "sphere") else np.maximum(np.abs(x), np.abs(y))
    inside = ((far < 0.9) & (n @ SUN > 0.15))[..., None] & ((q**2).sum(-1) > (4 * lobe_width(LENGTH)) ** 2)
    pixels = lambda fine: fine.reshape(SIDE, 4, SIDE, 4, -1)  # noqa: E731
    return pixels(lobes).mean((1, 3)), pixels(inside).all((1, 3))


@pytest.mark.slow
@pytest.mark.parametrize("word", ["radial", "tangential"])
def test_pictures_of_radial_patterns_follow_the_grating_equation(word):
    # Regression: on disks, whose UVs are polar, on spheres and on cylinders the colours lay elsewhere.
    for shape, picture in zip(PLACES, np.split(photographed(word), 4, axis=1), strict=True):
        agreement = {}
        for other in ("radial", "tangential"):
            lobes, where = predicted(shape, other)
            agreement[other] = np.corrcoef(lobes[where], picture[where])[0, 1]
        assert agreement.pop(word) > 0.8, shape
        assert max(agreement.values()) < 0.2, shape


def test_the_centre_of_a_radial_pattern_is_finite():
    bsdf = mi.load_dict(corner(orientation="radial"))
    assert " from the radius," in str(bsdf)
    si = hit(mesh(SQUARE), (0.5, 0.5, 2), DOWN, bsdf)
    assert np.isfinite(world(si, bsdf, [(0.1, 0.2, 0.97)])).all()


@pytest.mark.parametrize(
    ("suffix", "value"),
    [("png", np.uint8(51)), ("png", np.uint16(13107)), ("exr", np.float32(72)), ("exr", np.float16(72))],
)
def test_an_orientation_is_read_from_a_picture(suffix, value, tmp_path):
    """White is 360° in a PNG: 51/255 of it are 72°."""
    cos, sin = np.cos(np.deg2rad(72)), np.sin(np.deg2rad(72))
    path = tmp_path / f"turn.{suffix}"
    mi.Bitmap(np.full((4, 4), value)).write(str(path))
    check(mesh(SQUARE), (0.4, 0.2, 2), DOWN, (0, 0, 1), (cos, sin, 0), (-sin, cos, 0), str(path))


def test_the_file_of_an_orientation_is_checked(tmp_path):
    (tmp_path / "text.png").write_text("text")
    with pytest.raises((RuntimeError, ValueError), match=r"orientation: missing\.png: no such file"):
        mi.load_dict(corner(orientation="missing.png"))
    for name in ("radiall", str(tmp_path / "text.png")):
        with pytest.raises(
            (RuntimeError, ValueError), match=r"orientation: got .*, wanted radial, tangential, a number"
        ):
            mi.load_dict(corner(orientation=name))
