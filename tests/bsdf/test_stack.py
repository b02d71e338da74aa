"""Stacks of films and dispersion: transfer matrices of the package tmm, closed forms, bare surfaces."""

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest
import tmm
from bsdf_support import bitmap, direction, draw, evaluate, floats, interaction, six_samples, use
from test_thin_film import load, material_of, pairs, powers

from mitsuba_diffraction import testing
from mitsuba_diffraction.optics import film_stack
from mitsuba_diffraction.optics.refractive_indices import constant, index_of, refractive_index

WAVELENGTHS = (420.0, 500.0, 580.0, 660.0)
STACK = {"thin_film_ior": "3 x (2.35, 1.38)", "thin_film_thickness": "3 x (0.06, 0.1)"}


def solved(pol, films, below, wavelength, angle, outside=1.0):
    """The solution of tmm for films (n, d in µm)."""
    indices = [outside, *(n for n, _ in films), below]
    return tmm.coh_tmm(pol, indices, [np.inf, *(1e3 * d for _, d in films), np.inf], angle, wavelength)


def random_stacks(count, seed=0):
    """Stacks of 1 to 30 films of up to 4 µm in all, half of them with absorption: films, index below, λ, angle."""
    rng = np.random.default_rng(seed)
    for _ in range(count):
        number = int(rng.integers(1, 31))
        n = rng.uniform(1.2, 3, number) + 1j * rng.choice([0, 0.01, 1]) * rng.random(number) * (rng.random() < 0.5)
        thickness = rng.dirichlet(np.ones(number)) * rng.uniform(0.05, 4)
        films = list(zip(n.tolist(), thickness.tolist(), strict=True))
        yield films, rng.uniform(1.3, 2), rng.uniform(360, 830), np.deg2rad(rng.uniform(0, 89))


def test_r_and_t_in_numpy_are_those_of_transfer_matrices():
    for films, below, wavelength, angle in random_stacks(200):
        layers = [(n, 1e3 * d / wavelength) for n, d in films]
        for indices, cosine in (((1.0, layers, below), np.cos(angle)), ((below, layers[::-1], 1.0), 0.9)):
            reflected, transmitted = film_stack.r_and_t(np.array(cosine), *indices)
            of_tmm = [
                solved(pol, [(n, d * wavelength * 1e-3) for n, d in indices[1]], indices[2], wavelength, a, indices[0])
                for pol, a in zip("sp", [np.arccos(cosine)] * 2, strict=True)
            ]
            np.testing.assert_allclose(reflected, [found["R"] for found in of_tmm], atol=1e-9)
            np.testing.assert_allclose(transmitted, [found["T"] for found in of_tmm], atol=1e-9)


@pytest.mark.few(1)
@pytest.mark.parametrize("below", ["dielectric", "metal"])
def test_r_and_t_in_a_scene_are_those_of_transfer_matrices(llvm, below):
    """Of random stacks, with the same kernel for all numbers of films."""
    kernels = set()
    for films, index, wavelength, angle in random_stacks(60, seed=1):
        films = [(n.real, d) for n, d in films]
        lists = {
            "thin_film_ior": ", ".join(f"{n:.9g}" for n, _ in films),
            "thin_film_thickness": ", ".join(f"{d:.9g}" for _, d in films),
        }
        if len(films) == 1:
            continue
        material = {"int_ior": index, "ext_ior": 1.0} if below == "dielectric" else {"material": "Al"}
        found = material_of(load(**material, **lists))
        with dr.scoped_set_flag(dr.JitFlag.KernelHistory):
            reflected, transmitted = powers_of(found, [np.cos(angle)], [wavelength])
            kernels |= {entry["hash"] for entry in dr.kernel_history([dr.KernelType.JIT])}
        beneath = index if below == "dielectric" else refractive_index(wavelength * 1e-3, material="Al")
        of_tmm = [solved(pol, films, beneath, wavelength, angle) for pol in "sp"]
        assert reflected[0] == pytest.approx(np.mean([f["R"] for f in of_tmm]), abs=2e-4)
        if below == "dielectric":
            assert transmitted[0] == pytest.approx(np.mean([f["T"] for f in of_tmm]), abs=2e-4)
            assert reflected[0] + transmitted[0] == pytest.approx(1, abs=1e-4)
    assert len(kernels) <= 2


def powers_of(material, cosines, wavelengths):
    si = interaction([0, 0, 1], [[w] * 4 for w in wavelengths], len(wavelengths))
    found = material.r_and_t(si, floats(cosines), mi.Bool(True))
    dr.eval(found)
    return [np.array(p)[0].astype(float) for p in found]


@pytest.mark.parametrize("transmission", ["none", "interface"])
def test_absorbing_films_are_those_of_transfer_matrices(llvm, transmission):
    """From above and, with transmission, from below, in the reverse order."""
    names, thicknesses = ["Cu2O", "2.0", "Ag", "keratin"], [0.05, 0.1, 0.01, 0.2]
    lists = {"thin_film_ior": ", ".join(names), "thin_film_thickness": ", ".join(map(str, thicknesses))}
    bsdf = load(int_ior=1.5, ext_ior=1.0, transmission=transmission, conserve_energy=False, **lists)
    for wavelength, angle, side in ((450, 0.2, 1), (600, 1.2, 1), (500, 0.6, -1), (650, 1.3, -1)):
        if side < 0 and transmission == "none":
            continue
        films = [(complex(index_of("thin_film_ior", _float(n))(wavelength * 1e-3)), d) for n, d in
                 zip(names, thicknesses, strict=True)]  # fmt: skip
        reflected, transmitted = powers(bsdf, [side * np.cos(angle)], [wavelength])
        way = (films, 1.5, wavelength, angle, 1.0) if side > 0 else (films[::-1], 1.0, wavelength, angle, 1.5)
        of_tmm = [solved(pol, *way) for pol in "sp"]
        assert reflected[0] == pytest.approx(np.mean([f["R"] for f in of_tmm]), abs=1e-4)
        assert transmitted[0] == pytest.approx(np.mean([f["T"] for f in of_tmm]), abs=1e-4)


def _float(text):
    try:
        return float(text)
    except ValueError:
        return text


def test_a_quarter_wave_stack_has_its_closed_form(llvm):
    """Born and Wolf 1999, §1.6.5: R = ((1 − n_s/n_0 (n_H/n_L)^2N …)/(1 + …))² at the central wavelength."""
    n_h, n_l, n_s, central = 2.3, 1.38, 1.52, 550.0
    for pairs_ in (2, 5, 9):
        lists = {
            "thin_film_ior": f"{pairs_} x ({n_h}, {n_l})",
            "thin_film_thickness": f"{pairs_} x ({central * 1e-3 / 4 / n_h}, {central * 1e-3 / 4 / n_l})",
        }
        reflected, _ = powers(load(int_ior=n_s, ext_ior=1.0, **lists), [1.0], [central])
        y = n_s * (n_h / n_l) ** (2 * pairs_)
        assert reflected[0] == pytest.approx(((1 - y) / (1 + y)) ** 2, abs=2e-5)


def test_polarised_stacks_have_the_amplitudes_of_transfer_matrices():
    use("llvm_ad_spectral_polarized")
    films = [(2.35, 0.06), (1.38, 0.1)] * 3
    for side in (1, -1):
        transmission = {"transmission": "interface"} if side < 0 else {}
        material = material_of(load(int_ior=1.5, ext_ior=1.0, **STACK, **transmission))
        for wavelength, angle in ((450, 0.3), (600, 1.0)):
            si = interaction([0, 0, 1], [[wavelength] * 4])
            for reflects in (True, False):
                found = np.array(
                    material.planes(si, floats([side * np.cos(angle)]), mi.Bool(reflects), mi.Bool(True))[0]
                ).astype(float)[..., 0]
                way = (films, 1.5, wavelength, angle, 1.0) if side > 0 else (films[::-1], 1.0, wavelength, angle, 1.5)
                s, p = (solved(pol, *way) for pol in "sp")
                of_s, of_p = (each["R" if reflects else "T"] for each in (s, p))
                np.testing.assert_allclose(
                    [found[0, 0] + found[0, 1], found[0, 0] - found[0, 1]], [of_s, of_p], atol=1e-4
                )
                cross = s["r"] * np.conj(p["r"]) if reflects else s["t"] * np.conj(p["t"])
                cross *= np.sqrt(of_s * of_p) / max(abs(cross), 1e-9)
                np.testing.assert_allclose(found[2, 2] + 1j * found[3, 2], cross, atol=3e-4)


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("films", "without"),
    [
        ({"thin_film_ior": "2.35, 1.7", "thin_film_thickness": "0, 0"}, {}),
        ({"thin_film_ior": "1.0, 1.5", "thin_film_thickness": "0.2, 0.3"}, {}),
        ({"thin_film_ior": "2.35, 2.35", "thin_film_thickness": "0.03, 0.05"},
         {"thin_film_ior": 2.35, "thin_film_thickness": 0.08}),
        ({**STACK, "thin_film_scale": 0.0}, {}),
        ({"thin_film_ior": 2.35, "thin_film_thickness": 0.04, "thin_film_scale": 2.0},
         {"thin_film_ior": 2.35, "thin_film_thickness": 0.08}),
    ],
)  # fmt: skip
@pytest.mark.parametrize("transmission", ["none", "interface"])
def test_equal_stacks_are_equal(llvm, films, without, transmission):
    """Films of no thickness or of the index of a neighbour are none, two of one index are one."""
    wi, wo = pairs(np.random.default_rng(0), 200, transmission != "none")
    found, wanted = (
        testing.evaluate(load(int_ior=1.5, ext_ior=1.0, transmission=transmission, **each), wi, wo, WAVELENGTHS)
        for each in (films, without)
    )
    np.testing.assert_allclose(found, wanted, rtol=2e-4, atol=1e-5 * wanted.max())
    assert wanted.max() > 1e-3


def test_the_scale_of_a_stack_varies_over_the_surface(llvm):
    scale = bitmap([[0.5, 1.5]], filter_type="nearest")
    varying = load(int_ior=1.5, **STACK, thin_film_scale=scale)
    assert mi.has_flag(varying.flags(), mi.BSDFFlags.SpatiallyVarying)
    wi, wo = direction(20), np.array([direction(20, 180)])
    for u, factor in ((0.25, 0.5), (0.75, 1.5)):
        lists = {**STACK, "thin_film_thickness": f"3 x ({0.06 * factor}, {0.1 * factor})"}
        expected = evaluate(load(int_ior=1.5, **lists), wi, wo)[0]
        np.testing.assert_allclose(evaluate(varying, wi, wo, uv=(u, 0.5))[0], expected, rtol=1e-4)


def test_thicknesses_are_updated_and_have_derivatives(llvm):
    bsdf = load(int_ior=1.5, ext_ior=1.0, **STACK)
    parameters = mi.traverse(bsdf)
    other = {**STACK, "thin_film_thickness": "3 x (0.05, 0.12)"}
    parameters["thin_film_thickness"] = mi.Float([0.05, 0.12] * 3)
    parameters.update()
    wi, wo = direction(20), np.array([direction(20, 180)])
    expected = evaluate(load(int_ior=1.5, ext_ior=1.0, **other), wi, wo)[0]
    np.testing.assert_allclose(evaluate(bsdf, wi, wo)[0], expected, rtol=1e-5)

    def reflectance(thickness):
        parameters["thin_film_thickness"] = thickness
        parameters.update()
        found = material_of(bsdf).r_and_t(interaction([0, 0, 1], [[500.0] * 4]), mi.Float(0.9), mi.Bool(True))
        return found[0][0]

    thickness = mi.Float([0.05, 0.12] * 3)
    dr.enable_grad(thickness)
    dr.backward(reflectance(thickness))
    gradient, step = np.array(dr.grad(thickness)), 2e-4
    for film in (0, 3):
        change = step * (np.arange(6) == film)
        ends = [float(reflectance(mi.Float(np.array([0.05, 0.12] * 3) + s * change))[0]) for s in (1, -1)]
        assert gradient[film] == pytest.approx((ends[0] - ends[1]) / (2 * step), rel=0.02, abs=0.01)


@pytest.mark.parametrize(
    ("films", "message"),
    [
        ({"thin_film_ior": "2, 3", "thin_film_thickness": "0.1"}, "got 1 thicknesses for 2 films"),
        ({"thin_film_ior": "2", "thin_film_thickness": "0.1, 0.2"}, "got 2 thicknesses for 1 films"),
        ({"thin_film_ior": "2, 3", "thin_film_thickness": 0.1}, "got one number for 2 films, wanted a list"),
        ({"thin_film_ior": "2 x (2, 3", "thin_film_thickness": "0.1"}, "wanted a list such as '2.35, 1.38'"),
        ({"thin_film_ior": "2,, 3", "thin_film_thickness": "0.1"}, "wanted a list"),
        ({"thin_film_ior": "99 x (2, 3)", "thin_film_thickness": "0.1"}, "wanted a list of 1 to 100"),
        ({"thin_film_ior": "2, 3", "thin_film_thickness": "0.1, thick"}, "got 'thick', wanted 0 to 4 um"),
        ({"thin_film_ior": "2, 3", "thin_film_thickness": "3, 2"}, "got 5, wanted 0 to 4 um"),
        ({"thin_film_ior": "2, 3", "thin_film_thickness": "0.1, -0.2"}, "got -0.2, wanted 0 to 4 um"),
        ({"thin_film_ior": "2, zinc", "thin_film_thickness": "0.1, 0.2"}, "thin_film_ior: got 'zinc'"),
        ({"thin_film_scale": 2.0}, "thin_film_scale: got it alone"),
        (
            {"thin_film_ior": 2.0, "thin_film_thickness": 0.1, "thin_film_scale": -1.0},
            "thin_film_scale: got -1, wanted 0",
        ),
        ({"thin_film_ior": "2, 3", "thin_film_thickness": "inf, .1"}, "thin_film_thickness: got inf, wanted 0 to 4"),
        ({"thin_film_ior": "1,45", "thin_film_thickness": "0,1"}, "thin_film_ior: got '1,45', a decimal comma"),
        ({"thin_film_ior": 1.45, "thin_film_thickness": "0,1"}, "thin_film_thickness: got '0,1', a decimal comma"),
        ({"thin_film_ior": "1,45, 2,35", "thin_film_thickness": "0,1, 0,2"}, "a decimal comma"),
        ({"int_ior": "Al"}, "int_ior: got 'Al', wanted a number, a file"),
        ({"int_ior": "nowhere.yml"}, "no such file"),
        ({"k": 3.0}, "k: got k, wanted eta and k"),
        ({"eta": 1.0, "material": "Al"}, "eta: got eta, wanted eta and k, or material"),
        ({"eta": 1.0, "int_ior": 1.5}, "takes no int_ior"),
        ({"eta": 1.0, "k": 3.0, "theory": "rigorous"}, "wanted the name of a conductor or a file"),
    ],
)
def test_wrong_stacks_and_indices_are_refused_in_one_line(llvm, films, message):
    base = {"type": "diffraction_grating", "profile": "blazed", "period": 2.5, "depth": 0.25}
    with pytest.raises(RuntimeError, match=message) as error:
        mi.load_dict({**base, **films})
    assert "\n" not in str(error.value).partition("RequestError: ")[2].strip()


def test_films_from_files_whose_names_have_commas_and_parentheses(llvm, tmp_path):
    # Regression: "Malitson (1).csv" was no list.
    paths = []
    for k, name in enumerate(("Malitson (1).csv", "Malitson, 1965.csv")):
        paths.append(str(tmp_path / name))
        (tmp_path / name).write_text(f"wl,n\n0.3,{1.5 + k}\n0.9,{1.5 + k}\n")
    first, second = paths
    for iors, thicknesses, wanted in (
        (first, 0.1, [1.5]),
        (second, "0.1", [2.5]),
        (f"{first}, 2, {second}", ".1, .1, .1", [1.5, 2, 2.5]),
        (f"2 x ({second}, {first}), 1.38", "5 x (.1)", [2.5, 1.5, 2.5, 1.5, 1.38]),
    ):
        films = material_of(load(int_ior=1.5, thin_film_ior=iors, thin_film_thickness=thicknesses)).films
        assert [film.nominal for film in films] == pytest.approx(wanted)


def test_a_table_that_ends_in_the_far_infrared_is_as_fine_in_visible_light(llvm, tmp_path):
    # Regression: the nodes of a table that ends at 200 µm were 50 nm apart.
    file = tmp_path / "a.csv"
    rows = "".join(f"{x / 1000},{1.5 + x % 20 / 20}\n" for x in range(300, 910, 10))
    file.write_text(f"wl,n\n{rows}200,1.5\n")
    film, stack = {"int_ior": 1.3, "thin_film_thickness": 0.1}, {"int_ior": 1.3, "thin_film_thickness": "0.1, 0.1"}
    for found, wanted in (
        ({"int_ior": str(file)}, {"int_ior": 2.0}),
        ({"material": str(file)}, {"int_ior": 2.0, "ext_ior": 1.0}),
        ({**film, "thin_film_ior": str(file)}, {**film, "thin_film_ior": 2.0}),
        ({**stack, "thin_film_ior": f"{file}, {file}"}, {**stack, "thin_film_ior": "2, 2"}),
    ):
        of_table, of_number = (powers(load(**given), [0.9], [510.0])[0] for given in (found, wanted))
        np.testing.assert_allclose(of_table, of_number, rtol=1e-4)


def test_an_index_of_hundreds_in_the_far_infrared_is_that_of_a_material(llvm, tmp_path):
    # Regression: "eta: got 100.002, wanted 0 to 100", though light has its wavelengths elsewhere.
    visible, whole = tmp_path / "visible.csv", tmp_path / "whole.csv"
    visible.write_text("wl,n,k\n0.3,0.4,4\n0.9,1.6,8\n")
    whole.write_text(visible.read_text() + "20,60,150\n200,300,420\n")
    of_whole, of_visible = (powers(load(material=str(file)), [0.9], [600.0])[0] for file in (whole, visible))
    np.testing.assert_allclose(of_whole, of_visible, rtol=1e-4)


def test_one_film_given_as_texts_is_one_film(llvm):
    texts = load(int_ior=1.5, thin_film_ior="1.38", thin_film_thickness="0.1", thin_film_scale="2")
    numbers = load(int_ior=1.5, thin_film_ior=1.38, thin_film_thickness=0.1, thin_film_scale=2.0)
    assert str(material_of(texts)) == str(material_of(numbers))


def test_spectra_of_eta_and_k_are_those_of_the_conductor(llvm):
    """Against Mitsuba's tables of aluminium, given as spectra, and its own conductor."""
    wavelengths = np.arange(400.0, 701.0, 10)
    index = np.array([refractive_index(w * 1e-3, material="Al") for w in wavelengths])
    own = {
        name: {
            "type": "irregular",
            "wavelengths": ", ".join(map(str, wavelengths)),
            "values": ", ".join(f"{x:.9g}" for x in part),
        }
        for name, part in (("eta", index.real), ("k", index.imag))
    }
    wi, wo = pairs(np.random.default_rng(0), 100, False)
    found, wanted = (testing.evaluate(load(**each), wi, wo, WAVELENGTHS) for each in (own, {"material": "Al"}))
    np.testing.assert_allclose(found, wanted, rtol=2e-3)
    si, cosine = interaction([0, 0, 1], [[550.0] * 4]), 0.4
    reflected = material_of(load(eta=1.2, k=6.0))(si, mi.Float(cosine), mi.Bool(True))[0]
    assert float(reflected[0]) == pytest.approx(
        float(mi.fresnel_conductor(cosine, mi.Complex2f(1.2, 6.0))[0]), rel=1e-5
    )


@pytest.mark.parametrize(
    ("transmission", "conserve_energy"),
    [
        ("sheet", False),
        pytest.param("sheet", True, marks=pytest.mark.slow),
        pytest.param("interface", True, marks=pytest.mark.slow),
    ],
)
def test_a_medium_with_dispersion_is_a_constant_one_at_each_wavelength(llvm, transmission, conserve_energy):
    """Directions, powers, densities and E at λ are those of a grating whose index is that at λ, for light of one λ."""
    common = {"profile": "blazed", "period": 2.5, "depth": 0.25, "ext_ior": 1.0, "transmission": transmission}
    common |= {"type": "diffraction_grating", "coherence_length": 4.0, "conserve_energy": conserve_energy}
    rng = np.random.default_rng(0)
    wi, wo = pairs(rng, 400, True)
    dispersive = mi.load_dict({**common, "int_ior": "polycarbonate"})
    for wavelength in (400.0, 680.0):
        n = index_of("int_ior", "polycarbonate")(wavelength * 1e-3).real
        constant_ = mi.load_dict({**common, "int_ior": float(n)})
        found, wanted = (
            testing.evaluate_pdf(bsdf, wi, wo, [wavelength] * 4)[0][:, 0] for bsdf in (dispersive, constant_)
        )
        # E and κ₁ are tables laid out for another index.
        np.testing.assert_allclose(found, wanted, rtol=0.03, atol=2e-3 * wanted.max())
        assert np.median(np.abs(found - wanted)[wanted > 1e-3 * wanted.max()]) < 1e-3 * wanted.max()
        assert wanted.max() > 0.01


@pytest.mark.slow
@pytest.mark.parametrize(
    "parameters",
    [
        {"int_ior": "polycarbonate", "transmission": "interface"},
        {"int_ior": "polycarbonate", "transmission": "sheet"},
        {"material": "Al", "coat_ior": "polycarbonate"},
    ],
)
def test_samples_of_a_medium_with_dispersion_have_their_density(llvm, parameters):
    """Orders of glass leave at angles that depend on λ through n; weights stay below two."""
    bsdf = mi.load_dict(
        {"type": "diffraction_grating", "profile": "sinusoidal", "period": 2.5, "depth": 0.3, **parameters}
    )
    ctx = mi.BSDFContext()
    ctx.mode = mi.TransportMode.Importance
    for theta, side in ((20, 1), (50, 1), (30, -1)):
        if side < 0 and "transmission" not in parameters:
            continue
        wi = direction(theta, 20) * [1, 1, side]
        bs, weight = draw(bsdf, wi, 1 << 14, ctx, wavelengths=WAVELENGTHS)
        again = np.array(bsdf.pdf(ctx, interaction(wi, WAVELENGTHS, 1 << 14), bs.wo), np.float64)
        kept = (np.array(bs.pdf) > 0) & ~np.array(mi.has_flag(bs.sampled_type, mi.BSDFFlags.Delta))
        np.testing.assert_allclose(again[kept], np.array(bs.pdf)[kept], rtol=5e-3)
        total = weight.mean(1)
        assert (total < 1.02 + 4 * weight.std(1) / 128).all()
        # The four wavelengths at once, of which one is drawn.
        assert (weight.mean(0) < 2).mean() > 0.999


@pytest.mark.slow
def test_the_angle_of_a_transmitted_order_follows_the_index(llvm):
    """The grating equation with n(λ): sin θ_i = n sin θ_t + m λ/T."""
    bsdf = mi.load_dict(
        {"type": "diffraction_grating", "profile": "blazed", "period": 1.0, "depth": 0.3, "int_ior": "polycarbonate",
         "ext_ior": 1.0, "transmission": "interface"}
    )  # fmt: skip
    for wavelength in (400.0, 680.0):
        n = index_of("int_ior", "polycarbonate")(wavelength * 1e-3).real
        wi = direction(30)
        _, weight, bs = testing.sample(bsdf, np.broadcast_to(wi, (1 << 14, 3)), [wavelength] * 4)
        down = (np.array(bs.wo).T[:, 2] < 0) & (weight[:, 0] > 0)
        sines, powers_ = np.array(bs.wo).T[down, 0], weight[down, 0]
        m = np.rint((-wi[0] - n * sines) / (wavelength * 1e-3))
        for order in (0, 1):
            mean = np.average(sines[m == order], weights=powers_[m == order])
            assert mean == pytest.approx((-wi[0] - order * wavelength * 1e-3) / n, abs=2e-3)


def test_a_constant_index_stays_as_fast_and_as_it_was(llvm):
    """A number, a constant table and `Stack` of it are one: no lookup of the wavelength is compiled."""
    bsdf = load(int_ior=1.5, ext_ior=1.0, transmission="interface")
    assert material_of(bsdf).dispersion is None
    assert not bsdf.layers.interface.disperses
    assert film_stack.Stack(1.0, constant(1.5)).is_plain
    assert six_samples(bsdf, [direction(20), direction(50)]).shape == (13, 6)
