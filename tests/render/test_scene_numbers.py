"""Scenes written for RGB variants, with coloured pictures in the place of numbers: both kinds of variant agree."""

import mitsuba as mi
import numpy as np
import pytest
from bsdf_support import use
from PIL import Image

from mitsuba_diffraction.optics.color import radiance_to_linear_sRGB
from mitsuba_diffraction.render import render
from mitsuba_diffraction.render.scene_file import SceneFile

SCENE = """<scene version="3.0.0"><integrator type="path"><integer name="max_depth" value="3"/></integrator>
<sensor type="perspective"><float name="fov" value="30"/>
<transform name="to_world"><lookat origin="0, -3, 2" target="0, 0, 0" up="0, 0, 1"/></transform>
<film type="hdrfilm"><integer name="width" value="16"/><integer name="height" value="16"/><rfilter type="box"/></film>
</sensor><emitter type="point"><point name="position" x="1" y="1" z="2"/></emitter><emitter type="constant"/>
<texture type="bitmap" id="map"><string name="filename" value="map.png"/></texture>
<shape type="rectangle">{}</shape></scene>"""
DIFFUSE = '<bsdf type="diffuse"/>'
SHARED = '<bsdf type="diffuse"><ref id="map" name="reflectance"/></bsdf>'
BSDFS = {
    "bumpmap": f'<bsdf type="bumpmap"><ref id="map"/><float name="scale" value="0.3"/>{SHARED}</bsdf>',
    "weight": f'<bsdf type="blendbsdf">{{}}{DIFFUSE}{SHARED}</bsdf>',
    "normalmap": f'<bsdf type="normalmap">{{}}{DIFFUSE}</bsdf>',
    "opacity": f'<bsdf type="mask">{{}}{DIFFUSE}</bsdf>',
    "alpha": '<bsdf type="roughconductor">{}<string name="material" value="none"/></bsdf>',
    "roughness": '<bsdf type="principled">{}</bsdf>',
}


@pytest.fixture(scope="module")
def pictures(tmp_path_factory):
    """pictures(BSDF): mean colours of a picture in an RGB variant and of one by the command."""
    folder = tmp_path_factory.mktemp("scene")
    y, x = np.mgrid[:32, :32] / 32
    waves = 0.5 + 0.3 * np.sin(np.stack([12 * x, 9 * y + 3 * x + 1, 7 * (x + y)], -1))
    Image.fromarray((255 * waves).astype(np.uint8)).save(folder / "map.png")

    def of(bsdf):
        (folder / "scene.xml").write_text(SCENE.format(bsdf))
        use("llvm_ad_rgb")
        rgb = np.array(mi.render(mi.load_file(str(folder / "scene.xml")), spp=64))
        use("llvm_ad_spectral")
        image = render(SceneFile(folder / "scene.xml"), spp=256)
        return np.array([one.mean((0, 1)) for one in (rgb, radiance_to_linear_sRGB(image.radiance, image.wavelengths))])

    return of


@pytest.fixture(scope="module")
def plain(pictures):
    """The same of a white surface, as the light has another unit in RGB variants."""
    return pictures(DIFFUSE)


@pytest.mark.slow
@pytest.mark.parametrize("kind", BSDFS)
def test_coloured_pictures_of_numbers_are_those_of_rgb_variants(kind, pictures, plain):
    # Regression: "eval_1_grad(): … raw=false", after all was loaded, without a word of where.
    texture = f'<texture type="bitmap" name="{kind}"><string name="filename" value="map.png"/></texture>'
    rgb, spectral = pictures(BSDFS[kind].format(texture)) / plain
    np.testing.assert_allclose(spectral, rgb, rtol=0.03)
