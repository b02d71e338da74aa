"""A grating for Zemax OpticStudio and Speos: its fields, unitarity, reciprocity, Fresnel's formulas and directions."""

import itertools
import json

import numpy as np
import pytest

import mitsuba_diffraction as md

SIDES = ("lower", "upper")


def decoded(matrix):
    """An array in Lumerical's encoding, the first index fastest, by counting."""
    assert matrix["_type"] == "matrix"
    size, data = matrix["_size"], matrix["_data"]
    if matrix["_complex"]:
        data = [complex(*pair) for pair in zip(data[::2], data[1::2], strict=True)]
    values = np.empty(size, complex if matrix["_complex"] else float)
    for number, at in enumerate(itertools.product(*(range(n) for n in reversed(size)))):
        values[tuple(reversed(at))] = data[number]
    assert len(data) == number + 1
    return values


@pytest.fixture
def exported(command, tmp_path):
    """exported(surface, options): the file that the command writes for it, with arrays decoded."""

    def read(surface, *options):
        path = tmp_path / "grating.json"
        code, said, error = command("export", surface, "-o", str(path), *options)
        assert (code, error) == (0, ""), error
        assert "directions of light from" in said
        content = json.loads(path.read_text(encoding="utf-8"))
        for side in SIDES:
            found = content[f"grat_results_{side}"]
            found |= {name: decoded(found[name]) for name in ("R", "T", "list_orders_R", "list_orders_T")}
        return content

    return read


def at(content, side, kind, order, a=0, b=0, w=0):
    """The amplitudes of an order, [out, in]."""
    found = content[f"grat_results_{side}"]
    orders = found[f"list_orders_{kind}"].astype(int).tolist()
    return found[kind][a, b, w, orders.index(list(order))]


def test_the_fields_are_those_of_the_format(exported):
    content = exported(
        "crossed,period=0.9,period_y=0.7,depth=0.1", "--wavelength", "450,600", "--angle", "0,20,40", "--azimuth", "0"
    )
    assert {"n_lower", "n_upper", "grat_results_lower", "grat_results_upper", "description"} <= content.keys()
    assert (content["n_lower"], content["n_upper"]) == (1.5, 1)
    np.testing.assert_allclose(content["reciprocal_lattice_vector_1"], [2 * np.pi / 0.9e-6, 0])
    np.testing.assert_allclose(content["reciprocal_lattice_vector_2"], [0, 2 * np.pi / 0.7e-6])
    for side in SIDES:
        found = content[f"grat_results_{side}"]
        np.testing.assert_allclose(found["wavelength"], [450e-9, 600e-9])
        assert found["angle_definition"] == {"theta": [0, 20, 40], "phi": [0]}
        assert found["lossless"] is True
        for kind in "RT":
            assert found[kind].shape == (3, 1, 2, len(found[f"list_orders_{kind}"]), 2, 2)
            assert found[f"list_orders_{kind}"].shape[1] == 2


def test_orders_go_where_the_lattice_vectors_say(exported):
    content = exported(
        "blazed,period=0.9,depth=0.2,theory=rigorous", "--wavelength", "500", "--angle", "50", "--azimuth", "0,30"
    )
    k_0 = 2 * np.pi / 500e-9
    for side, kind in itertools.product(SIDES, "RT"):
        found = content[f"grat_results_{side}"]
        n_i = content[f"n_{side}"]
        n_o = n_i if kind == "R" else content[f"n_{'upper' if side == 'lower' else 'lower'}"]
        for b, phi in enumerate(np.deg2rad(found["angle_definition"]["phi"])):
            k_i = n_i * k_0 * np.sin(np.deg2rad(50)) * np.array([np.cos(phi), np.sin(phi)])
            for order, matrix in zip(found[f"list_orders_{kind}"], found[kind][0, b, 0], strict=True):
                k_o = k_i + order @ [content[f"reciprocal_lattice_vector_{i}"] for i in (1, 2)]
                assert (np.abs(matrix).max() > 0) == (np.hypot(*k_o) < n_o * k_0)


def test_a_lossless_grating_keeps_all_light(exported):
    content = exported(
        "blazed,period=0.9,depth=0.2,theory=rigorous", "--wavelength", "500", "--angle", "0,50", "--azimuth", "0,30"
    )
    for side, a, b in itertools.product(SIDES, (0, 1), (0, 1)):
        found = content[f"grat_results_{side}"]
        power = sum((np.abs(found[kind][a, b, 0]) ** 2).sum(axis=(0, 1)) for kind in "RT")
        np.testing.assert_allclose(power, 1, atol=1e-5)


def test_light_through_the_grating_may_be_reversed(exported):
    """T from below into an order is T from above of the reversed pair, transposed."""
    surface, wavelength, theta, phi, n = "blazed,period=0.9,depth=0.2,theory=rigorous", 0.5, 40.0, 20.0, 1.5
    down = exported(surface, "--wavelength", "500", "--angle", f"{theta}", "--azimuth", f"{phi}")
    order = 1
    k = np.sin(np.deg2rad(theta)) * np.array([np.cos(np.deg2rad(phi)), np.sin(np.deg2rad(phi))])
    k_o = k + np.array([order * wavelength / 0.9, 0])
    back = np.rad2deg([np.arcsin(np.hypot(*k_o) / n), np.arctan2(-k_o[1], -k_o[0])]).tolist()
    up = exported(surface, "--wavelength", "500", "--angle", f"{back[0]!r}", f"--azimuth={back[1]!r}")
    forward, backward = at(down, "upper", "T", (order, 0)), at(up, "lower", "T", (order, 0))
    # ŝ = −ẑ × k̂ of reversed light has the other sign, p̂ = k̂ × ŝ has not.
    np.testing.assert_allclose(backward, np.diag([-1, 1]) @ forward.T @ np.diag([-1, 1]), atol=5e-4)
    assert np.abs(forward).max() > 0.2


def test_a_plane_has_the_amplitudes_of_fresnel(exported):
    content = exported(
        "sinusoidal,period=1,depth=0,theory=rigorous,int_ior=1.5",
        "--wavelength",
        "500",
        "--angle",
        "0,30",
        "--azimuth",
        "0,70",
    )
    for b, (a, angle) in itertools.product((0, 1), enumerate((0, 30))):
        i, o = np.cos(np.deg2rad(angle)), np.sqrt(1 - (np.sin(np.deg2rad(angle)) / 1.5) ** 2)
        r_s, r_p = (i - 1.5 * o) / (i + 1.5 * o), (1.5 * i - o) / (1.5 * i + o)
        np.testing.assert_allclose(at(content, "upper", "R", (0, 0), a, b), [[r_s, 0], [0, r_p]], atol=1e-8)
    inside = exported(
        "sinusoidal,period=1,depth=0,theory=rigorous,int_ior=1.5",
        "--wavelength",
        "500",
        "--angle",
        "60",
        "--azimuth",
        "0",
    )
    np.testing.assert_allclose(np.abs(np.diag(at(inside, "lower", "R", (0, 0)))), 1, atol=1e-8)  # total reflection
    assert not np.any(inside["grat_results_lower"]["T"])


def test_scalar_theory_and_metals(exported):
    content = exported("foil,period=1.1,material=Al", "--wavelength", "550", "--angle", "20", "--azimuth", "0")
    expected = md.efficiencies(md.gratings.foil(period=1.1), 20, 550, material="Al")
    assert content["grat_results_upper"]["lossless"] is False
    for m in ((0, 0), (1, -1)):
        found = np.abs(at(content, "upper", "R", (-m[0], -m[1]))) ** 2
        np.testing.assert_allclose(found, np.diag(expected.order(*m)[0, 0]), rtol=1e-6, atol=1e-9)
    assert not content["grat_results_lower"]["R"].any()
    assert not content["grat_results_upper"]["T"].any()
    # From below, inside of the medium, lengths are n times as long; a shallow relief barely changes Fresnel's values.
    glass = exported(
        "foil,period=1.1,depth=0.002,int_ior=1.5", "--wavelength", "550", "--angle", "20", "--azimuth", "0"
    )
    i, o = np.cos(np.deg2rad(20)), np.sqrt(1 - (1.5 * np.sin(np.deg2rad(20))) ** 2)
    r_s = (1.5 * i - o) / (1.5 * i + o)
    assert abs(at(glass, "lower", "R", (0, 0))[0, 0]) == pytest.approx(r_s, rel=1e-2)
    assert abs(at(glass, "lower", "T", (0, 0))[0, 0]) == pytest.approx(np.sqrt(1 - r_s**2), rel=1e-2)
