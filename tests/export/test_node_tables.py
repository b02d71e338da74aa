"""The tables for Blender's own nodes (.npz): what they hold, and colours in its working spaces."""

from types import SimpleNamespace

import colour
import numpy as np
import pytest
from scipy.special import jv

from mitsuba_diffraction.export.shader_tables import SHORTEST_DRAWN, ShaderTables, bins_of_wavelengths, shader_recipe
from mitsuba_diffraction.export.working_spaces import WORKING_SPACES, nonnegative_colours
from mitsuba_diffraction.files.outputs import check_outputs
from mitsuba_diffraction.optics.media import MediumBelow
from mitsuba_diffraction.precomputation.requested_surface import RequestedSurface

PERIOD, DEPTH = 1.6, 0.15


@pytest.mark.not_quick
def test_the_tables_of_a_grating_are_its_closed_form(command, tmp_path):
    path = tmp_path / "s.npz"
    code, said, error = command("export", f"sinusoidal,period={PERIOD},depth={DEPTH},material=Al", "-o", str(path))
    assert (code, error) == (0, "")
    check_outputs([], [("-o", path)])  # it has the mark, so it may be written again
    with np.load(path, allow_pickle=False) as read:
        tables = dict(read)
    assert f"{len(tables['frequencies'])} orders" in said
    assert not tables["sheet"]
    order = np.round(tables["frequencies"][:, 0] * PERIOD)
    kappa = np.linspace(0, tables["max_kappa"], tables["powers"].shape[1])
    np.testing.assert_allclose(tables["powers"], jv(order[:, None], kappa * DEPTH / 2) ** 2, atol=2e-3)
    assert list(tables["spaces"]) == list(WORKING_SPACES)
    for colours in tables["colours"]:
        assert colours.min() >= 0
        np.testing.assert_allclose(colours.mean(axis=0), 1, atol=1e-5)


@pytest.mark.parametrize("disc", ["compact_disc", "dvd"])
def test_the_tables_of_a_disc_are_for_light_inside_its_coat(disc):
    recipe = shader_recipe(RequestedSurface.of(disc).recipe)
    assert recipe.settings.wavelengths[0] < SHORTEST_DRAWN / 1.58  # polycarbonate


def test_a_bright_order_does_not_take_most_of_the_rows():
    q = np.linspace(-3, 3, 121)
    powers = np.full((121, 121), 0.4 / 121**2)
    powers[60, 60] += 0.6
    grid = SimpleNamespace(frequencies=lambda: (q, q))
    spectrum = SimpleNamespace(source="", max_kappa=60.0, lobe_width=0.007, grid=grid, powers=lambda kappa: powers)
    tables = ShaderTables.of_spectrum(spectrum, MediumBelow.of("none"))
    assert (np.abs(tables.rows) < 0.03).sum() < 12  # of 33 edges, 19 in proportion to the power
    np.testing.assert_allclose(tables.powers.mean(axis=0), 1, rtol=1e-3)


def test_mixtures_of_neighbouring_wavelengths_keep_luminance_and_colour():
    edges, signed = bins_of_wavelengths()
    middle = (edges[1:] + edges[:-1]) / 2
    step = np.clip((middle - np.linspace(0.46, 0.6, 15)[:, None]) / 0.15 + 0.5, 0, 1)
    band = np.clip((0.05 - np.abs(middle - np.linspace(0.44, 0.66, 23)[:, None])) / 0.03 + 0.5, 0, 1)
    for (space, matrix), colours in zip(WORKING_SPACES.items(), nonnegative_colours(edges, signed), strict=True):
        to_XYZ = np.linalg.inv(matrix).T @ colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ.T
        for mixtures, largest, mean in ((np.vstack([step, 1 - step]), 0.12, 0.02), (band, 0.27, 0.08)):
            wanted, found = (mixtures @ each @ to_XYZ for each in (signed @ matrix.T, colours))
            errors = np.abs(np.log(found[:, 1] / wanted[:, 1]))
            assert errors.max() < largest  # a cut at zero: 0.4 to 0.7
            assert errors.mean() < mean
            if mixtures is not band and space != "Linear Rec.709":
                pair = [colour.XYZ_to_Lab(0.4 * each / each[:, 1:2]) for each in (wanted, found)]
                assert colour.delta_E(*pair, method="CIE 2000").mean() < 1.6


@pytest.mark.parametrize(("name", "published"), [("Linear Rec.2020", "ITU-R BT.2020"), ("ACEScg", "ACEScg")])
def test_a_working_space_is_the_published_one(name, published):
    spaces = colour.RGB_COLOURSPACES
    wanted = colour.matrix_RGB_to_RGB(spaces["sRGB"], spaces[published], "Bradford")
    np.testing.assert_allclose(WORKING_SPACES[name], wanted, atol=5e-4)
