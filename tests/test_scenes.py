"""The scenes that come with the package render."""

from pathlib import Path

import drjit as dr
import mitsuba as mi
import numpy as np
import pytest

import mitsuba_diffraction as md
from mitsuba_diffraction.render import render

SCENES = Path(__file__).parents[1] / "scenes"


def check(image, size):
    assert image.radiance.shape[:2] == (size, size)
    assert np.isfinite(image.radiance).all()
    assert image.radiance.mean() > 0


@pytest.fixture
def llvm():
    if not dr.has_backend(dr.JitBackend.LLVM):
        pytest.skip("Dr.Jit finds no LLVM")
    mi.set_variant("llvm_ad_spectral")


@pytest.mark.parametrize("name", ["blaze", "elaphe", "xenopeltis"])
def test_scene_renders(llvm, name):
    check(render(SCENES / f"{name}.xml", spp=4, width=16, height=16), 16)


def test_scene_of_a_scan_renders(llvm, tmp_path):
    path = tmp_path / "spectrum.exr"
    md.precompute(md.gratings.elaphe(8)).save(path)
    check(render(SCENES / "scan.xml", spp=4, width=16, height=16, parameters={"spectrum": str(path)}), 16)


def test_blaze_renders_in_the_scalar_variant():
    mi.set_variant("scalar_spectral")
    check(render(SCENES / "blaze.xml", spp=1, width=4, height=4), 4)
