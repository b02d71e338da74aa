"""The material for three.js in a real browser, beside the colours of the table and a sum over a lit plane."""

import functools
import http.server
import json
import shutil
import threading
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from test_colour_table import SURFACES, directions, face, viewed

from mitsuba_diffraction.export import colour_file
from mitsuba_diffraction.export.colour_file import write_colours
from mitsuba_diffraction.export.colour_table import colours_of
from mitsuba_diffraction.optics.color import (
    SRGB_TO_XYZ,
    XYZ_to_linear_sRGB,
    auto_exposure,
    daylight,
    delta_E,
    into_gamut,
    matching_functions,
)

sync_api = pytest.importorskip("playwright.sync_api", reason="the package playwright is not installed")

CHROMIUM = shutil.which("chromium")
THREE = Path(__file__).parents[2] / "node_modules" / "three"
MODULE = Path(colour_file.__file__).parent / "assets" / "three"
OPTIONS = ["--use-angle=swiftshader", "--enable-unsafe-swiftshader", "--no-sandbox"]
PAGE = """<!doctype html><meta charset="utf-8"><link rel="icon" href="data:,"><script type="importmap">{"imports": {
"three": "./three/build/three.module.js"}}</script><script type="module" src="page.js"></script>"""


class Quiet(http.server.SimpleHTTPRequestHandler):
    """Modules are not loaded from files."""

    def log_message(self, *_):
        """Say nothing."""


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """The folder of the page, with the module and three.js."""
    if not THREE.is_dir():
        pytest.skip("three.js is not installed (npm install --no-save three, in the checkout)")
    path = tmp_path_factory.mktemp("three")
    (path / "three").symlink_to(THREE)
    (path / "module").symlink_to(MODULE)
    (path / "index.html").write_text(PAGE, encoding="utf-8")
    shutil.copy(Path(__file__).with_name("page_with_material.js"), path / "page.js")
    return path


@pytest.fixture(scope="module")
def tab(folder):
    """The page in chromium with its software renderer; its messages are collected in `messages`."""
    if CHROMIUM is None:
        pytest.skip("chromium is not installed (apt-get install chromium)")
    server = http.server.ThreadingHTTPServer(("127.0.0.1", 0), functools.partial(Quiet, directory=folder))
    threading.Thread(target=server.serve_forever, daemon=True).start()
    with sync_api.sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path=CHROMIUM, args=OPTIONS)
        page = browser.new_page()
        page.messages = []
        page.on("console", lambda message: page.messages.append(message.text))
        page.on("pageerror", lambda error: page.messages.append(str(error)))
        page.set_default_timeout(240_000)
        page.goto(f"http://127.0.0.1:{server.server_port}/index.html")
        page.wait_for_function("window.isReady")
        yield page
        browser.close()
    server.shutdown()
    server.server_close()


def call(tab, function, *arguments):
    """Call a function of the page; texels as (n, 4)."""
    tab.messages.clear()
    text = tab.evaluate(f"async (text) => JSON.stringify(await {function}(...JSON.parse(text)))", json.dumps(arguments))
    return np.array(json.loads(text)).reshape(-1, 4)


def f_cos(surface, colours, wi, wo):
    """K G T_i T_o C cos θ_i, XYZ (n, 3); directions (n, 3)."""
    n = surface.coat
    ki, ko = (np.sqrt(n**2 - (d[:, :2] ** 2).sum(axis=1)) for d in (wi, wo))
    u, w = -(wi + wo)[:, :2], ki + ko
    v = np.concatenate([u, w[:, None]], axis=1)
    inner = [np.concatenate([-d[:, :2], k[:, None]], axis=1) for d, k in ((wi, ki), (wo, ko))]
    along = [(v * d).sum(axis=1) for d in inner]
    half = w / np.linalg.norm(v, axis=1)
    k = along[0] * along[1] / (ki * ko * w**2)
    cosines = [a / (n * np.linalg.norm(v, axis=1)) for a in along]
    g = np.minimum(1, np.minimum(2 * half * ki / n / cosines[0], 2 * half * ko / n / cosines[1]))
    faces = face(wi[:, 2], n) * face(wo[:, 2], n) if n > 1 else 1
    return colours.colour(u, w) * (k * g * faces * wi[:, 2])[:, None]


def difference(found, wanted):
    """ΔE00 of XYZ, (n,), exposed like a picture."""
    exposure = auto_exposure(into_gamut(XYZ_to_linear_sRGB(wanted)))
    return delta_E(exposure * found, exposure * wanted)


@pytest.fixture(scope="module")
def exported(folder):
    """exported(name): surface and colours; the file is NAME.bin unless it has a name of its own."""

    @functools.cache
    def of(name, file=None, **settings):
        surface = viewed(name, **settings)
        return surface, write_colours(surface, folder / f"{file or name.replace(' ', '_')}.bin")

    return of


@pytest.mark.slow
@pytest.mark.parametrize("name", SURFACES)
def test_pairs_of_directions_have_the_colours_of_the_table(name, exported, tab):
    surface, colours = exported(name)
    wi, wo = directions(surface, 1000)
    pairs = np.pad(np.stack([wi, wo], axis=1), ((0, 0), (0, 0), (0, 1)))
    found = call(tab, "pairs", f"{name.replace(' ', '_')}.bin", pairs.ravel().tolist(), 0)[:, :3]
    wanted = f_cos(surface, colours, wi, wo)
    error = difference(found, wanted)
    assert error.mean() < 0.5
    assert np.percentile(error, 95) < 1.5
    assert found.sum() == pytest.approx(wanted.sum(), rel=0.03)
    assert not tab.messages, "\n".join(tab.messages)[:3000]


SIZE, EYE = 24, np.array([0.4, -1.8, 3.0])


def unit(v):
    """Vectors of length one."""
    return v / np.linalg.norm(v, axis=-1, keepdims=True)


def seen(size=SIZE, offset=(0.5, 0.5)):
    """Points on z = 0 in pixels, (n, 3), by a perspective camera of 40° that looks at the origin."""
    z = unit(EYE)
    x = unit(np.cross([0, 1, 0], z))
    y = np.cross(z, x)
    at = [(np.arange(size) + shift) / size * 2 - 1 for shift in offset]
    across, up = (np.tan(np.deg2rad(20)) * a.ravel() for a in np.meshgrid(*at))
    rays = across[:, None] * x + up[:, None] * y - z
    return EYE - rays * (EYE[2] / rays[:, 2])[:, None]


def axes(points, orientation, radial):
    """The pattern's axes at points, (n, 3, 3)."""
    x = unit(points * [1, 1, 0]) if radial else np.tile([1.0, 0, 0], (len(points), 1))
    y = np.cross([0, 0, 1.0], x)
    angle = np.deg2rad(orientation)
    z = np.tile([0, 0, 1.0], (len(points), 1))
    return np.stack([np.cos(angle) * x + np.sin(angle) * y, np.cos(angle) * y - np.sin(angle) * x, z], axis=1)


def mixed(XYZ):
    """Colours outside of the gamut, mixed with grey of their luminance, as XYZ."""
    rgb, luminance = XYZ_to_linear_sRGB(XYZ), XYZ[:, 1:2]
    kept = np.minimum(luminance / np.maximum(luminance - rgb.min(axis=1, keepdims=True), 1e-12), 1)
    return (luminance + (rgb - luminance) * kept) @ SRGB_TO_XYZ.T


def lit(surface, colours, points, frame, position, light, radius=0.0, count=300):
    """XYZ of the light of a lamp at points; the mean over a disc of an angular radius that is seen from each."""
    local = lambda v: np.einsum("nij,nj->ni", frame, v)  # noqa: E731
    wo, away = local(unit(EYE - points)), position - points * (light != "directional")
    away = np.broadcast_to(away, points.shape)
    distance = np.linalg.norm(away, axis=1)
    to_lamp = unit(away)
    a = unit(np.cross(to_lamp, [0, 0, 1.0] if light != "above" else [1.0, 0, 0]))
    b = np.cross(to_lamp, a)
    sine_of_edge = radius / distance if light != "directional" else np.full(len(points), np.sin(radius))
    total = 0
    for k in range(count if radius else 1):
        sine, phi = np.sqrt((k + 0.5) / count) * sine_of_edge * (radius > 0), k * np.pi * (3 - np.sqrt(5))
        across = a * np.cos(phi) + b * np.sin(phi)
        wi = to_lamp * np.sqrt(1 - sine**2)[:, None] + across * sine[:, None]
        total = total + f_cos(surface, colours, local(wi), wo) / (count if radius else 1)
    return total / (1 if light == "directional" else distance[:, None] ** 2)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "options"),
    [
        ("skin", {"light": "directional", "material": {"orientation": 30}}),
        ("skin", {"light": "point", "lamp": {"radius": 0.3}, "instanced": True}),
        ("skin", {"light": "directional", "lamp": {"angularRadius": 0.0175}}),
        ("blaze", {"light": "spot", "material": {"orientation": -20}}),
        ("blaze", {"light": "point", "lamp": {"radius": 0.15}}),
        ("foil of gold", {"light": "directional", "lamp": {"angularRadius": 0.035}, "material": {"radial": True}}),
        ("compact disc", {"light": "directional", "material": {"orientation": "tangential"}}),
    ],
)
def test_a_lit_plane_has_the_colours_of_its_directions(name, options, exported, tab):
    surface, colours = exported(name)
    position = np.array([-0.5, 2.1, 3.0])
    shown = {"eye": EYE.tolist(), "position": position.tolist(), "size": SIZE, "material": {}, **options}
    found = call(tab, "plane", f"{name.replace(' ', '_')}.bin", shown)[:, :3]
    assert not tab.messages, "\n".join(tab.messages)[:3000]
    points, orientation = seen(), shown["material"].get("orientation", 0)
    radial = shown["material"].get("radial", orientation == "tangential")
    frame = axes(points, 90 if orientation == "tangential" else orientation, radial)
    lamp = shown.get("lamp", {})
    radius = max(lamp.get("radius", 0), lamp.get("angularRadius", 0))
    wanted = mixed(lit(surface, colours, points, frame, position, shown["light"], radius))
    inside = (np.abs(points[:, :2]) < 0.9).all(axis=1) & (np.linalg.norm(points, axis=1) > 0.1)
    found = (found @ SRGB_TO_XYZ.T)[inside]
    error = difference(found, wanted[inside])
    # Of a lamp the material takes up to 16 Gaussians with its variance.
    assert error.mean() < (1 if radius else 0.3)
    assert np.percentile(error, 95) < (5 if radius else 1.5)
    # Few pixels have the image of a lamp in the mirror direction, whose edges are soft.
    assert found.sum() == pytest.approx(wanted[inside].sum(), rel=0.05 if radius else 0.03)


@pytest.mark.slow
@pytest.mark.parametrize("name", ["skin", "foil of gold"])
def test_a_rectangle_lights_by_its_area(name, exported, tab):
    surface, colours = exported(name)
    position, (width, height), count, fine = np.array([-0.5, 2.1, 3.0]), (0.8, 0.3), 24, 192
    shown = {"eye": EYE.tolist(), "position": position.tolist(), "material": {}, "light": "area"}
    shown["sizes"] = [width, height]
    file = f"{name.replace(' ', '_')}.bin"
    pictures = [call(tab, "plane", file, {**shown, "size": n})[:, :3] for n in (SIZE, fine)]
    assert not tab.messages, "\n".join(tab.messages)[:3000]
    z = unit(position)
    x = unit(np.cross([0, 1, 0], z))
    area, points, middle, flux = width * height / count**2, seen(), 0, 0.0
    for k in range(count**2):
        s, t = (k % count + 0.5) / count - 0.5, (k // count + 0.5) / count - 0.5
        place = position + s * width * x + t * height * np.cross(z, x)
        middle = middle + area * from_point(surface, colours, points, place, z)
        if name == "skin":
            # Few pixels have the image of the lamp in the mirror direction: the flux is that of points all over them.
            spread = seen(offset=((0.5 + 0.7548776662 * k) % 1, (0.5 + 0.5698402910 * k) % 1))
            flux += area * from_point(surface, colours, spread, place, z)[is_inside(spread), 1].sum() / SIZE**2
    found, summed = (picture @ SRGB_TO_XYZ.T for picture in pictures)
    inside = is_inside(points)
    error = difference(found[inside], mixed(middle)[inside])
    assert error.mean() < 1
    assert np.percentile(error, 95) < 5
    # The lobes of the foil are too narrow for these sums, but so narrow that they are directions beside the lamp.
    on_plane = is_inside(seen(fine))
    if name != "skin":
        flux = in_narrow_orders(surface, seen(fine)[on_plane], position, width / 2 * x, height / 2 * np.cross(z, x))
        flux /= fine**2
    assert summed[on_plane, 1].sum() / fine**2 == pytest.approx(flux, rel=0.03)


def is_inside(points):
    """Whether points are on the plane, beside its edge."""
    return (np.abs(points[:, :2]) < 0.9).all(axis=1)


def from_point(surface, colours, points, position, normal):
    """XYZ of the light of a unit of area at a position, (n, 3)."""
    away = position - points
    wi = unit(away)
    per_area = (wi @ normal)[:, None] / (away**2).sum(axis=1, keepdims=True)
    return f_cos(surface, colours, wi, unit(EYE - points)) * per_area


def in_narrow_orders(surface, points, position, x, y):
    """Y of the light of a rectangle of radiance one, summed over points, by its images in each order; no coat.

    Half of its width and of its height are x and y. Lobes are directions, λ² d²q = cos θ_i dω_i.
    """
    strong = surface.powers(20.0).ravel() > 1e-4
    q = np.stack(np.meshgrid(*surface.spectrum.grid.frequencies()), -1).reshape(-1, 2)[strong]
    step, nodes, normal, wo, total = 6.0, np.linspace(0, 2, 9), np.cross(x, y), unit(EYE - points), 0.0
    nm, everything = np.arange(380 + step / 2, 740, step), np.arange(360.0, 831.0)
    light = matching_functions(nm)[:, 1] * daylight(nm) * step
    light /= matching_functions(everything)[:, 1] @ daylight(everything)
    for wavelength, luminance in zip(nm * 1e-3, light, strict=True):
        powers = np.stack([surface.powers(2 * np.pi * w / wavelength).ravel()[strong] for w in nodes], axis=1)
        for u, power in zip(wavelength * q, powers, strict=True):
            tangent = -(wo[:, :2] + u)
            ki = np.sqrt(np.maximum(1 - (tangent**2).sum(axis=1), 1e-9))
            wi = np.concatenate([tangent, ki[:, None]], axis=1)
            distance = ((position - points) @ normal / (wi @ normal))[:, None]
            at = points + distance * wi - position
            hit = (ki > 1e-3) & (distance[:, 0] > 0) & (np.abs(at @ x) <= x @ x) & (np.abs(at @ y) <= y @ y)
            ki, ko = ki[hit], wo[hit, 2]
            w = ki + ko
            square = u @ u + w**2
            a, b = square / (2 * ki), square / (2 * ko)
            k_g = np.minimum(a * b / w**2, 2 * np.minimum(a, b) / w)
            reflectance = surface.reflectance(wavelength, np.broadcast_to(u, (len(w), 2)), w)
            total += luminance * (np.interp(w, nodes, power) * k_g * reflectance).sum()
    return total


@pytest.mark.slow
def test_a_file_that_cannot_be_read_is_grey_and_says_so_once(exported, folder, tab):
    exported("blaze")
    content = (folder / "blaze.bin").read_bytes()
    (folder / "short.bin").write_bytes(content[:-100])
    (folder / "later.bin").write_bytes(content.replace(b'"version": 3', b'"version": 9'))
    (folder / "other.bin").write_bytes(b"glTF" + content[4:])
    shown = {"eye": EYE.tolist(), "position": [0, 0, 3], "size": 8, "material": {}, "light": "directional"}
    wanted = {"short": "the file was cut short", "later": "version 9, wanted 3", "other": "not a file of colours"}
    for name, problem in wanted.items():
        grey = call(tab, "plane", f"{name}.bin", shown)[27, :3]
        assert np.ptp(grey) < 1e-3 < grey.min()
        assert tab.messages == [f"DiffractionMaterial: {name}.bin: {problem}; shown in grey"]


@pytest.mark.slow
def test_the_heights_of_separate_orders_have_a_scale(exported, tab):
    """Beside colours of scaled heights; lobes are wide, as few pixels would see narrow ones."""
    surface, colours = exported("blaze", "scaled", coherence_length=14.0)
    position, points, scale = np.array([-0.5, 2.1, 3.0]), seen(), 0.6
    shown = {"eye": EYE.tolist(), "position": position.tolist(), "size": SIZE, "light": "directional"}
    found = call(tab, "plane", "scaled.bin", {**shown, "material": {"heightScale": scale}})[:, :3] @ SRGB_TO_XYZ.T
    assert not tab.messages, "\n".join(tab.messages)[:3000]
    both = (colours_of(replace(surface, height_scale=scale)), colours)
    frame, inside = axes(points, 0, radial=False), is_inside(points)
    wanted, unscaled = (mixed(lit(surface, c, points, frame, position, "directional"))[inside] for c in both)
    assert difference(found[inside], wanted).mean() < 0.3
    assert found[inside].sum() == pytest.approx(wanted.sum(), rel=0.03)
    assert difference(unscaled, wanted).mean() > 1


@pytest.mark.slow
@pytest.mark.parametrize(("name", "scale", "wanted"), [("skin", 0.8, "1, as orders overlap"), ("blaze", 1.5, "0 to 1")])
def test_heights_that_a_file_does_not_hold_are_refused(name, scale, wanted, exported, tab):
    exported(name)
    shown = {"eye": EYE.tolist(), "position": [-0.5, 2.1, 3.0], "size": 8, "light": "directional"}
    pictures = [
        call(tab, "plane", f"{name}.bin", {**shown, "material": material}) for material in ({}, {"heightScale": scale})
    ]
    np.testing.assert_array_equal(*pictures)
    problem = f"heightScale: got {scale}, wanted {wanted}; export with height_scale, shown with 1"
    assert tab.messages == [f"DiffractionMaterial: {problem}"]


def under_white_sky(surface, wo):
    """XYZ of the light of a sky of radiance one, (n, 3), by all nodes of a spectrum and all wavelengths; wo (n, 3)."""
    q = np.stack(np.meshgrid(*surface.spectrum.grid.frequencies()), -1).reshape(-1, 2)
    step, n = 6.0, surface.coat
    nm, everything = np.arange(380 + step / 2, 740, step), np.arange(360.0, 831.0)
    light = matching_functions(nm) * daylight(nm)[:, None] * step
    light /= matching_functions(everything)[:, 1] @ daylight(everything)
    total, nodes = np.zeros((len(wo), 3)), np.linspace(0, 2 * n, 9)
    for wavelength, colour in zip(nm * 1e-3, light, strict=True):
        powers = np.stack([surface.powers(2 * np.pi * w / wavelength).ravel() for w in nodes])
        for found, direction in zip(total, wo, strict=True):
            tangent = -(direction[:2] + wavelength * q)
            kept = (tangent**2).sum(axis=1) < 1 - 1e-6
            tangent, u = tangent[kept], wavelength * q[kept]
            ki, ko = np.sqrt(n**2 - (tangent**2).sum(axis=1)), np.sqrt(n**2 - 1 + direction[2] ** 2)
            w = ki + ko
            square = (u**2).sum(axis=1) + w**2
            a, b = square / (2 * ki), square / (2 * ko)
            k_g = np.minimum(a * b / w**2, 2 * np.minimum(a, b) / w)
            at = w / nodes[1]
            below = np.minimum(at.astype(int), len(nodes) - 2)
            two = powers[below, np.flatnonzero(kept)], powers[below + 1, np.flatnonzero(kept)]
            power = two[0] * (1 - at + below) + two[1] * (at - below)
            found += (power * k_g * surface.reflectance(wavelength, u, w)).sum() * colour
    return total


@pytest.mark.slow
@pytest.mark.parametrize("name", ["blaze", "skin"])
def test_a_white_sky_has_the_light_of_all_orders(name, exported, tab):
    surface, _ = exported(name)
    shown = {"eye": EYE.tolist(), "sky": True, "size": SIZE, "material": {"skyPoints": 256}}
    found = call(tab, "plane", f"{name}.bin", shown)[:, :3]
    assert not tab.messages, "\n".join(tab.messages)[:3000]
    points = seen()
    some = [k for k in range(len(points)) if (np.abs(points[k, :2]) < 0.9).all()][::12]
    wanted = mixed(under_white_sky(surface, unit(EYE - points)[some]))
    error = difference(found[some] @ SRGB_TO_XYZ.T, wanted)
    assert error.mean() < 2
    assert (found[some] @ SRGB_TO_XYZ.T).sum() == pytest.approx(wanted.sum(), rel=0.05)


@pytest.mark.slow
def test_a_screen_casts_a_shadow(exported, tab):
    exported("skin")
    shown = {"eye": EYE.tolist(), "position": [0.1, 0.2, 3], "size": SIZE, "material": {}, "light": "spot"}
    light, shadow = (call(tab, "plane", "skin.bin", {**shown, "shadow": s})[:, :3] for s in (False, True))
    assert not tab.messages, "\n".join(tab.messages)[:3000]
    assert shadow.sum() < 0.02 * light.sum()


@pytest.mark.slow
def test_a_base_is_lit_through_the_surface(folder, exported, tab):
    surface, colours = exported("skin")
    write_colours(surface, folder / "base.bin", base="#a0522d")
    position = np.array([-0.5, 2.1, 3.0])
    shown = {"eye": EYE.tolist(), "position": position.tolist(), "size": SIZE, "material": {}, "light": "directional"}
    found = call(tab, "plane", "base.bin", shown)[:, :3] @ SRGB_TO_XYZ.T
    assert not tab.messages
    points = seen()
    wi, wo = np.broadcast_to(unit(position), points.shape), unit(EYE - points)
    srgb = np.array([0xA0, 0x52, 0x2D]) / 255
    below = (((srgb + 0.055) / 1.055) ** 2.4) @ SRGB_TO_XYZ.T
    through = face(wi[:, 2], 1.5) * face(wo[:, 2], 1.5) * wi[:, 2] / np.pi
    frame = axes(points, 0, radial=False)
    wanted = mixed(lit(surface, colours, points, frame, position, "directional") + through[:, None] * below)
    inside = (np.abs(points[:, :2]) < 0.9).all(axis=1)
    assert difference(found[inside], wanted[inside]).mean() < 0.3
