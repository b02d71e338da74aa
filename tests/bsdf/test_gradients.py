"""Derivatives of eval and of a rendering against differences; what is recomputed for a changed parameter."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import (
    array,
    bitmap,
    direction,
    floats,
    grating,
    hemisphere,
    interaction,
    of_spectrum,
    towards,
    uniform,
    vectors,
)

import mitsuba_diffraction as md
from mitsuba_diffraction.bsdf import shared

ORDERS = [(a, 0) for a in range(-3, 4)]
WI = direction(20, 30)


pytestmark = pytest.mark.usefixtures("llvm")


def near_orders():
    """Return directions on the slopes of the lobes of 500 nm, and weights that prevent cancellation."""
    wo = towards(WI, np.add(ORDERS, [0.03, 0.05]), 500)
    return wo, np.random.default_rng(1).uniform(0.5, 1.5, len(wo))


class Total:
    """A weighted sum of f cos θ_o over directions, as a function of one parameter of the scene."""

    def __init__(self, key, wavelengths=(500.0,) * 4, **parameters):
        self.bsdf = mi.load_dict(grating(**{"coherence_length": 10.0, **parameters}))
        self.theory = self.bsdf.layers.grating.theory
        self.parameters = mi.traverse(self.bsdf)
        self.key = key
        self.wo, self.weights = near_orders()
        count = len(self.wo)
        self.uv = np.random.default_rng(2).random((count, 2))
        self.si = interaction(np.tile(WI, (count, 1)), wavelengths, count, uv=self.uv)

    def __call__(self, value):
        self.parameters[self.key] = value
        self.parameters.update()
        f = self.bsdf.eval(mi.BSDFContext(), self.si, vectors(self.wo))
        return dr.sum(f[1] * floats(self.weights))

    def number(self, value):
        """Return the sum in float64, for differences."""
        self.parameters[self.key] = floats(value) if np.isscalar(value) else value
        self.parameters.update()
        f = self.bsdf.eval(mi.BSDFContext(), self.si, vectors(self.wo))
        return array(f, np.float64)[1] @ self.weights


def difference(total, at, step):
    """Return the central difference of fourth order, (8(f₁ − f₋₁) − (f₂ − f₋₂))/12 h."""
    f = [total(at + k * step) for k in (-2, -1, 1, 2)]
    return (8 * (f[2] - f[1]) - (f[3] - f[0])) / (12 * step)


NUMBERS = {
    # key, value, step
    "height": ("height_scale", 0.7, 0.01, {"name": "sinusoidal"}),
    "height of a blaze": ("height_scale", 0.8, 0.01, {}),
    "height of skin": ("height_scale", 0.8, 0.01, {"name": "elaphe"}),
    "lateral": ("lateral_scale", 0.9, 1e-3, {"name": "sinusoidal", "coherence_length": 20.0, "lateral_scale": 0.9}),
    # Within a grid cell of E, whose derivative jumps at its edges.
    "orientation": ("orientation.value", 2.0, 0.02, {}),
    "orientation of skin": ("orientation.value", 25.0, 0.3, {"name": "elaphe"}),
    "index": ("eta", 1.5, 0.02, {"int_ior": 1.5}),
    "index over a base": ("eta", 1.5, 0.02, {"int_ior": 1.5, "base": {"type": "diffuse"}}),
    "film": ("thin_film_thickness", 0.1, 2e-3, {"int_ior": 1.5, "thin_film_ior": 2.35, "thin_film_thickness": 0.1}),
    "film on metal": (
        "thin_film_thickness",
        *(0.2, 2e-3, {"material": "Au", "thin_film_ior": "Cu2O", "thin_film_thickness": 0.2}),
    ),
}


@pytest.mark.few(2)
@pytest.mark.parametrize("mode", ["forward", "backward"])
@pytest.mark.parametrize("case", NUMBERS)
def test_the_derivative_by_a_number_is_that_of_differences(case, mode):
    key, at, step, parameters = NUMBERS[case]
    total = Total(key, **parameters)
    if key in ("height_scale", "lateral_scale"):
        # With E, whose table is coarse, in tests/energy.
        total.theory.update = lambda: None
        total.theory.energy = None
    wanted = difference(total.number, at, step)
    x = mi.Float(at)
    dr.enable_grad(x)
    value = total(x)
    if mode == "forward":
        dr.forward(x)
        found = dr.grad(value)[0]
    else:
        dr.backward(value)
        found = dr.grad(x)[0]
    assert abs(wanted) > 1e-3
    np.testing.assert_allclose(found, wanted, rtol=0.01)


def test_the_derivative_by_lengths_lacks_orders_that_cross_the_horizon():
    """Summed over directions: that of differences, for pairs between whose orders none appears or vanishes.

    An order is at the horizon where (c ± x) T s/λ of one of the directions is a whole number, c² = 1 − y².
    """
    period, at, step, wavelengths = 2.0, 0.97, 1e-3, (430.0, 500.0, 570.0, 640.0)
    spectrum = md.precompute(md.gratings.sinusoidal(period, 0.25), coherence_length=16.0)
    bsdf = mi.load_dict(of_spectrum(spectrum, material="Al", conserve_energy=False))
    wi, parameters = direction(80, 0), mi.traverse(bsdf)
    x, y = np.meshgrid(np.linspace(-0.9999, 0.9999, 6000), np.linspace(-0.1, 0.1, 9))
    wo = np.stack([x, y, np.sqrt(np.maximum(1 - x**2 - y**2, 0))], axis=-1)[x**2 + y**2 < 1]
    si = interaction(np.tile(wi, (len(wo), 1)), wavelengths, len(wo))

    def values(scale):
        parameters["lateral_scale"] = scale
        parameters.update()
        return bsdf.eval(mi.BSDFContext(), si, vectors(wo))

    def orders(scale, omega):
        c, size = np.hypot(omega[..., 0], omega[..., 2]), period * scale / (1e-3 * np.array(wavelengths)[:, None])
        return np.floor([(c - omega[..., 0]) * size, (c + omega[..., 0]) * size])

    def sums(f, pairs=True):
        return np.where(pairs, array(f, np.float64) / wo[:, 2], 0).sum(axis=1)

    s = mi.Float(at)
    dr.enable_grad(s)
    f = values(s)
    dr.forward(s)
    found, total = dr.grad(f), sums(dr.detach(f))
    wanted = difference(lambda scale: array(values(scale), np.float64), at, step)
    first, last = at - 2 * step, at + 2 * step
    of_wo, of_wi = ((orders(first, each) == orders(last, each)).all(axis=0) for each in (wo, wi[None]))
    same = of_wo & of_wi
    assert of_wi.all()
    np.testing.assert_allclose(sums(found, same) / total, sums(wanted, same) / total, atol=5e-3)
    # The sum over all directions is wrong at grazing incidence.
    assert (np.abs(sums(found) - sums(wanted)) > total).all()


@pytest.mark.parametrize("key", ["eta.values", "k.values"])
def test_the_derivative_by_the_index_of_a_metal_is_that_of_differences(key):
    total = Total(key, material="Cu")
    start = np.array(total.parameters[key], np.float64)
    # One entry for each nm from the beginning of the table, 302.4 nm, on: at 500 nm only one counts.
    entry = 500 - 303
    wanted = difference(lambda s: total.number(mi.Float(start + s * (np.arange(len(start)) == entry))), 0.0, 0.02)
    x = mi.Float(start)
    dr.enable_grad(x)
    dr.backward(total(x))
    found = np.array(dr.grad(x))
    assert abs(wanted) > 1e-3
    np.testing.assert_allclose(found[entry], wanted, rtol=0.01)
    np.testing.assert_allclose(found.sum(), found[entry], rtol=1e-4)


def test_the_derivative_by_a_texture_of_thicknesses_is_that_of_differences():
    start = np.float32([[0.08, 0.1], [0.12, 0.14]])[..., None]
    total = Total("thin_film_thickness.data", int_ior=1.5, thin_film_ior=2.35, thin_film_thickness=bitmap(start))
    x = mi.TensorXf(start)
    dr.enable_grad(x)
    dr.backward(total(x))
    found = np.array(dr.grad(x))
    step = np.zeros_like(start)
    step[0, 1] = 1
    wanted = difference(lambda t: total.number(mi.TensorXf(start + np.float32(t) * step)), 0.0, 2e-3)
    assert abs(wanted) > 1e-3
    np.testing.assert_allclose(found[0, 1, 0], wanted, rtol=0.01)


def test_the_derivative_by_a_texture_of_orientations_is_that_of_differences():
    start = np.random.default_rng(3).uniform(-3, 3, (3, 3, 1)).astype(np.float32)
    total = Total("orientation.data", orientation=bitmap(start))
    assert tuple(total.parameters["orientation.data"].shape) == start.shape
    x = mi.TensorXf(start)
    dr.enable_grad(x)
    dr.backward(total(x))
    found = np.array(dr.grad(x))
    scale = np.abs(found).max()
    assert (np.abs(found) > 0.02 * scale).sum() >= 3
    for place in np.argwhere(np.abs(found) > 0.02 * scale):
        one = np.zeros_like(start)
        one[tuple(place)] = 1
        wanted = difference(lambda s, one=one: total.number(mi.TensorXf(start + np.float32(s) * one)), 0.0, 0.1)
        np.testing.assert_allclose(found[tuple(place)], wanted, rtol=0.01, atol=2e-3 * scale)


@pytest.mark.slow
def test_derivatives_are_finite_where_orders_vanish_and_at_the_horizon():
    bsdf = mi.load_dict(grating("deep blazed", int_ior=1.5, base={"type": "diffuse"}))
    parameters = mi.traverse(bsdf)
    values = {"height_scale": mi.Float(0.9), "eta": mi.Float(1.5), "orientation.value": mi.Float(10.0)}
    for key, value in values.items():
        dr.enable_grad(value)
        parameters[key] = value
    parameters.update()
    wo = np.concatenate([hemisphere(32)[0], [[1, 0, 0], [1, 0, -1e-3], -WI * [1, 1, -1], WI]])
    wi = np.repeat([WI, [0, 0, 1], [1, 0, 1e-7]], len(wo), axis=0)
    wo = np.tile(wo, (3, 1))
    f = bsdf.eval(mi.BSDFContext(), interaction(wi, count=len(wo)), vectors(wo))
    dr.backward(dr.sum(f, axis=None))
    for value in values.values():
        assert np.isfinite(np.array(dr.grad(value))).all()


@pytest.mark.parametrize(
    ("key", "at"),
    [pytest.param("height_scale", 0.8, marks=pytest.mark.slow), ("eta", 1.5), ("orientation.value", 10.0)],
)
def test_weights_of_samples_have_the_derivative_of_the_value(key, at):
    """The sampled direction is fixed, so its density must not be differentiated."""
    base = {"type": "diffuse", "reflectance": uniform(0.5)}
    bsdf = mi.load_dict(grating("sinusoidal", 10.0, int_ior=1.5, base=base))
    parameters = mi.traverse(bsdf)
    count = 1 << 12
    u = np.random.default_rng(4).random((3, count)).astype(np.float32)
    si = interaction(np.tile(WI, (count, 1)), count=count)

    def slope(function):
        x = mi.Float(at)
        dr.enable_grad(x)
        parameters[key] = x
        parameters.update()
        value = function()
        dr.forward(x)
        return np.array(dr.grad(value), np.float64)

    ctx = mi.BSDFContext()
    numbers = floats(u[0]), mi.Point2f(*map(floats, u[1:]))
    parameters[key] = mi.Float(at)
    parameters.update()
    bs, _ = bsdf.sample(ctx, si, *numbers)
    dr.eval(bs)
    wo, pdf = dr.detach(bs.wo), np.array(bs.pdf)
    found = slope(lambda: bsdf.sample(ctx, si, *numbers)[1]) * pdf
    wanted = slope(lambda: bsdf.eval(ctx, si, wo))
    some = pdf > 0
    scale = np.abs(wanted).max()
    assert scale > 0
    np.testing.assert_allclose(found[:, some], wanted[:, some], rtol=5e-3, atol=1e-3 * scale)


def scene(**parameters):
    return mi.load_dict(
        {
            "type": "scene",
            "integrator": {"type": "prb", "max_depth": 3},
            "sky": {"type": "constant", "radiance": uniform(1.0)},
            "sun": {"type": "directional", "direction": [0.3, 0.2, -1], "irradiance": uniform(3.0)},
            "sensor": {
                "type": "perspective",
                "fov": 30,
                "to_world": mi.ScalarTransform4f().look_at([0, -2, 3], [0, 0, 0], [0, 0, 1]),
                "film": {
                    "type": "specfilm",
                    "width": 8,
                    "height": 8,
                    "rfilter": {"type": "box"},
                    "component_format": "float32",
                    "band": {"type": "regular", "wavelength_min": 450, "wavelength_max": 650, "values": "1, 1"},
                },
            },
            "sphere": {"type": "sphere", "bsdf": grating(**{"coherence_length": 5.0, **parameters}) | {"id": "skin"}},
        }
    )


@pytest.mark.slow
@pytest.mark.parametrize(("key", "at", "step"), [("eta", 1.5, 0.05), ("height_scale", 0.7, 0.05)])
def test_the_derivative_of_a_rendering_is_that_of_differences(key, at, step):
    world = scene(name="sinusoidal", int_ior=1.5, base={"type": "diffuse", "reflectance": uniform(0.2)})
    parameters = mi.traverse(world)
    key = next(name for name in parameters.keys() if name.endswith(f".{key}"))  # noqa: SIM118 (not a dict)

    def brightness(value, seed, spp):
        parameters[key] = value
        parameters.update()
        # Of the left half: the whole hardly depends on the heights.
        image = mi.render(world, parameters, spp=spp, seed=seed)
        return dr.mean(image[:, :4, :], axis=None)

    slopes = []
    for seed in range(4):
        x = mi.Float(at)
        dr.enable_grad(x)
        dr.backward(brightness(x, seed, 256))
        slopes.append(dr.grad(x)[0])
    assert np.isfinite(slopes).all()
    pairs = [
        [float(brightness(mi.Float(at + sign * step), seed, 2048).array[0]) for sign in (1, -1)] for seed in range(4)
    ]
    differences = [(high - low) / (2 * step) for high, low in pairs]
    error = np.hypot(np.std(slopes, ddof=1), np.std(differences, ddof=1)) / 2
    wanted = np.mean(differences)
    assert abs(np.mean(slopes) - wanted) < 4 * error + 0.03 * abs(wanted)
    assert error < 0.3 * abs(wanted)


class Count:
    """A counter of the calls of a function of a module."""

    def __init__(self, patch, module, name):
        self.calls, original = 0, getattr(module, name)

        def counted(*args, **kwargs):
            self.calls += 1
            return original(*args, **kwargs)

        patch.setattr(module, name, counted)


def test_changes_rebuild_only_what_depends_on_them(monkeypatch):
    bsdf = mi.load_dict(grating("deep blazed", int_ior=1.5, base={"type": "diffuse", "reflectance": uniform(0.3)}))
    parameters = mi.traverse(bsdf)
    tables = Count(monkeypatch, shared.EnergyTable, "of")
    lines = Count(monkeypatch, shared.ScalarOrders, "__init__")
    theory = bsdf.layers.grating.theory
    scattering, table = theory.scattering, theory.energy
    for key, value in (("orientation.value", 20.0), ("eta", 1.4), ("base.reflectance.value", 0.1)):
        assert key in parameters
        parameters[key] = value
        parameters.update()
        assert tables.calls == 0
        assert theory.energy is table
    parameters["height_scale"] = 0.87
    parameters.update()
    assert tables.calls == 1
    assert theory.energy is not table
    parameters["height_scale"] = 1.0
    parameters.update()
    # That of the spectrum's own height is kept with it.
    assert tables.calls == 1
    assert theory.scattering.power is scattering.power
    assert lines.calls == 0


def compiled(action):
    """Return how many kernels an action launched, and how many of them were compiled."""
    dr.kernel_history_clear()
    with dr.scoped_set_flag(dr.JitFlag.KernelHistory, True):
        action()
        history = [entry for entry in dr.kernel_history() if entry["type"] == dr.KernelType.JIT]
    dr.kernel_history_clear()
    return len(history), sum(not entry["cache_hit"] for entry in history)


@pytest.mark.parametrize(
    "key", [pytest.param("height_scale", marks=pytest.mark.slow), "eta", "orientation.value", "base.reflectance.value"]
)
def test_changed_numbers_compile_nothing(key):
    bsdf = mi.load_dict(grating("deep blazed", int_ior=1.5, base={"type": "diffuse", "reflectance": uniform(0.3)}))
    parameters = mi.traverse(bsdf)
    wo = np.concatenate([towards(WI, ORDERS, 500), [direction(20, 210)]])
    si = interaction(np.tile(WI, (len(wo), 1)), count=len(wo))
    results = []

    def evaluate():
        value, pdf = bsdf.eval_pdf(mi.BSDFContext(), si, vectors(wo))
        dr.eval(value, pdf)
        results.append(np.array(value))

    # A number in the code of a kernel would compile one for each value. Others than in the last run, whose kernels lie
    # on disk. Dr.Jit itself writes the same program in a few orders, also where nothing has changed: so not none.
    tries, misses = 10, []
    for value in np.random.default_rng().uniform(0.6, 0.95, tries):
        parameters[key] = float(value) * (1.6 if key == "eta" else 1)
        parameters.update()
        launched, missed = compiled(evaluate)
        assert launched > 0
        misses.append(missed > 0)
    assert np.sum(misses) <= tries / 2
    assert np.abs(results[0] - results[1]).max() > 1e-5
