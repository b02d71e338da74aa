"""A grating that is black because it is opaque and lit, or seen, from below is named in the log."""

import logging
from pathlib import Path

import mitsuba as mi
import pytest

from mitsuba_diffraction.render.scene import warn_of_gratings
from mitsuba_diffraction.render.scene_file import SceneFile

SCENE = """<scene version="3.0.0"><integrator type="path"/>
<sensor type="perspective"><transform name="to_world"><lookat origin="0,0,{eye}" target="0,0,0" up="0,1,0"/></transform>
<film type="hdrfilm"/></sensor>
<shape type="rectangle" id="film"><bsdf type="diffraction_grating"><string name="profile" value="blazed"/>
<float name="period" value="2.5"/><float name="depth" value="0.1"/><string name="transmission" value="{kind}"/></bsdf>
</shape>
<shape type="sphere"><point name="center" x="0.3" y="0" z="{light}"/><float name="radius" value="0.3"/>
<emitter type="area"><rgb name="radiance" value="1"/></emitter></shape></scene>"""


@pytest.mark.few(2)
@pytest.mark.parametrize(
    ("eye", "light", "kind", "message"),
    [
        (4, -5, "none", "of shape film is lit from below only"),
        (-4, 5, "none", "of shape film is seen from below only"),
        (4, 5, "none", ""),
        (4, -5, "sheet", ""),
    ],
)
def test_an_opaque_grating_lit_or_seen_from_below_is_logged(tmp_path, caplog, eye, light, kind, message):
    mi.set_variant("llvm_ad_spectral")
    (tmp_path / "s.xml").write_text(SCENE.format(eye=eye, light=light, kind=kind))
    with caplog.at_level(logging.WARNING, logger="mitsuba_diffraction.render.scene"):
        warn_of_gratings(SceneFile(tmp_path / "s.xml", size=(8, 8)).load())
    messages = [record.getMessage() for record in caplog.records]
    assert len(messages) == bool(message)
    assert all(message in logged and "transmission=sheet" in logged for logged in messages)


@pytest.mark.slow
def test_a_denoised_rendering_logs_it_once(tmp_path, monkeypatch, command):
    monkeypatch.chdir(tmp_path)
    Path("s.xml").write_text(SCENE.format(eye=4, light=-5, kind="none"))
    code, _, err = command("render s.xml --denoise --spp 1 --width 8 --height 8 --variant llvm_ad_spectral")
    assert (code, err.count("is lit from below only")) == (0, 1)
