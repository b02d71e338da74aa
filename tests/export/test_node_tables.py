"""The tables for Blender's own nodes (.npz): what they hold, and colours in its working spaces."""

import colour
import numpy as np
import pytest
from scipy.special import jv

from mitsuba_diffraction.export.working_spaces import WORKING_SPACES
from mitsuba_diffraction.files.outputs import check_outputs

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
    order = np.round(tables["frequencies"][:, 0] * PERIOD)
    kappa = np.linspace(0, tables["max_kappa"], tables["powers"].shape[1])
    np.testing.assert_allclose(tables["powers"], jv(order[:, None], kappa * DEPTH / 2) ** 2, atol=2e-3)
    assert list(tables["spaces"]) == list(WORKING_SPACES)
    for matrix, colours in zip(tables["matrices"], tables["colours"], strict=True):
        assert colours.min() >= 0
        np.testing.assert_allclose(colours.mean(axis=0), 1, atol=1e-5)
        signed = tables["signed_colours"] @ matrix.T
        # Mixtures as of an order under a lamp: nearer to the right colour than a cut is.
        middle = (tables["edges"][1:] + tables["edges"][:-1]) / 2
        mixtures = np.exp(-0.5 * ((middle - np.linspace(0.45, 0.65, 9)[:, None]) / 0.05) ** 2)
        cut = np.maximum(signed, 0) / np.maximum(signed, 0).mean(axis=0)
        to_XYZ = np.linalg.inv(matrix).T @ colour.RGB_COLOURSPACES["sRGB"].matrix_RGB_to_XYZ.T
        errors = [np.linalg.norm(mixtures @ (found - signed) @ to_XYZ) for found in (colours, cut)]
        assert errors[0] < errors[1]


@pytest.mark.parametrize(("name", "published"), [("Linear Rec.2020", "ITU-R BT.2020"), ("ACEScg", "ACEScg")])
def test_a_working_space_is_the_published_one(name, published):
    spaces = colour.RGB_COLOURSPACES
    wanted = colour.matrix_RGB_to_RGB(spaces["sRGB"], spaces[published], "Bradford")
    np.testing.assert_allclose(WORKING_SPACES[name], wanted, atol=5e-4)
