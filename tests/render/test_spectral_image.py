import errno
import os
import stat

import numpy as np
import OpenEXR
import pytest
from PIL import Image

from mitsuba_diffraction.files.writing import whole_file
from mitsuba_diffraction.optics.color import radiance_to_linear_sRGB
from mitsuba_diffraction.render import spectral_image
from mitsuba_diffraction.render.spectral_image import SpectralImage, save_preview

GRID = np.arange(365.0, 830.0, 5.0)


@pytest.fixture
def image():
    radiance = np.random.default_rng(0).normal(size=(4, 7, GRID.size)).astype(np.float32)
    return SpectralImage(GRID, radiance, {"scene": "a.xml", "spp": 16, "height_scale": 0.5})


def test_a_saved_image_is_loaded_unchanged(image, tmp_path):
    image.save(tmp_path / "a.exr")
    loaded = SpectralImage.load(tmp_path / "a.exr")
    np.testing.assert_array_equal(loaded.radiance, image.radiance)
    np.testing.assert_array_equal(loaded.wavelengths, image.wavelengths)
    assert loaded.attributes == image.attributes
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]


def test_threads_compress_the_same_file(image, tmp_path, monkeypatch):
    before, files = OpenEXR.global_thread_count(), []
    try:
        for cores in (1, 3):
            monkeypatch.setattr(spectral_image, "usable_cores", lambda cores=cores: cores)
            image.save(tmp_path / "picture.exr")
            files.append((tmp_path / "picture.exr").read_bytes())
            assert OpenEXR.global_thread_count() == cores
    finally:
        OpenEXR.set_global_thread_count(before)
    assert files[0] == files[1]


def test_fractional_wavelengths_are_loaded_unchanged(tmp_path):
    image = SpectralImage([404.5, 412.25], np.ones((1, 1, 2)))
    image.save(tmp_path / "a.exr")
    np.testing.assert_array_equal(SpectralImage.load(tmp_path / "a.exr").wavelengths, [404.5, 412.25])


def test_the_file_has_the_spectral_layout(image, tmp_path):
    image.save(tmp_path / "a.exr")
    file = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True)
    header, channels = file.header(), file.channels()
    assert header["spectralLayoutVersion"] == "1.0"
    assert header["emissiveUnits"] == "W.m^-2.sr^-1"
    assert header["compression"] == OpenEXR.PIZ_COMPRESSION
    assert len(channels) == GRID.size + 3
    assert channels["S0.405,000000nm"].pixels.dtype == np.float32
    np.testing.assert_array_equal(channels["S0.405,000000nm"].pixels, image.radiance[..., 8])
    rgb = radiance_to_linear_sRGB(image.radiance, GRID)
    for index, name in enumerate("RGB"):
        np.testing.assert_allclose(channels[name].pixels, rgb[..., index], rtol=1e-5, atol=1e-6)


def test_alpha_is_a_channel_of_the_file_and_of_the_preview(tmp_path, monkeypatch):
    monkeypatch.setattr(spectral_image, "PIXELS_PER_BLOCK", 8)  # two rows
    alpha = np.linspace(0, 1, 5 * 4).reshape(5, 4)
    image = SpectralImage(GRID, alpha[..., None] * np.linspace(1, 2, GRID.size), alpha=alpha)
    image.save(tmp_path / "a.exr")
    image.save(tmp_path / "rgb.exr", rgb=True)
    np.testing.assert_array_equal(SpectralImage.load(tmp_path / "a.exr").alpha, alpha.astype(np.float32))
    channels = OpenEXR.File(str(tmp_path / "rgb.exr"), separate_channels=True).channels()
    assert sorted(channels) == ["A", "B", "G", "R"]
    np.testing.assert_array_equal(channels["A"].pixels, alpha.astype(np.float16))
    # The colours of PNG are not multiplied by alpha.
    save_preview(image, tmp_path / "a.png")
    with Image.open(tmp_path / "a.png") as preview:
        assert preview.mode == "RGBA"
        pixels = np.array(preview)
    np.testing.assert_array_equal(pixels[..., 3], np.round(255 * alpha))
    np.testing.assert_array_equal(pixels[alpha > 0][:, :3], np.broadcast_to(pixels[-1, -1, :3], (19, 3)))
    assert pixels[-1, -1, :3].max() > 200
    with pytest.raises(ValueError, match=r"alpha: got shape \(5,\), wanted \(5, 4\)"):
        SpectralImage(GRID, image.radiance, alpha=alpha[:, 0])


def test_colour_science_reads_the_file(image, tmp_path):
    pytest.importorskip("OpenImageIO", reason="colour-science reads spectral images through OpenImageIO")
    import colour

    image.save(tmp_path / "a.exr")
    components, specification = colour.read_spectral_image_Fichet2021(tmp_path / "a.exr", additional_data=True)
    assert specification.is_emissive
    assert list(components) == ["S0"]
    wavelengths, values = components["S0"]
    order = np.argsort(wavelengths)
    np.testing.assert_allclose(wavelengths[order], GRID)
    np.testing.assert_array_equal(values[..., order], image.radiance)


@pytest.mark.parametrize(
    ("wavelengths", "shape", "attributes", "message"),
    [
        ([500.0, 490.0], (1, 1, 2), {}, "ascending"),
        ([], (1, 1, 0), {}, "ascending"),
        ([500.0, 510.0], (1, 1, 3), {}, r"\(1, 1, 3\)"),
        ([500.0, 510.0], (1, 2), {}, r"\(1, 2\)"),
        ([500.0, 510.0], (1, 1, 2), {"compression": "none"}, "compression"),
        ([500.0, 510.0], (1, 1, 2), {"list": [1]}, "list"),
        ([500.0, 510.0], (1, 1, 2), {"big": 2**31}, "32 bits"),
    ],
)
def test_wrong_images_are_refused(wavelengths, shape, attributes, message):
    with pytest.raises(ValueError, match=message):
        SpectralImage(wavelengths, np.zeros(shape), attributes)


def test_an_image_owns_its_radiance():
    radiance = np.ones((1, 1, 2), np.float32)
    image = SpectralImage([500.0, 510.0], radiance)
    radiance[:] = 2
    assert (image.radiance == 1).all()
    with pytest.raises(ValueError, match="read-only"):
        image.radiance[:] = 3


def write_exr(path, attributes, channels):
    header = {"compression": OpenEXR.ZIP_COMPRESSION, "type": OpenEXR.scanlineimage, **attributes}
    OpenEXR.File(header, {name: np.ones((2, 2), np.float32) for name in channels}).write(str(path))


@pytest.mark.parametrize(
    ("attributes", "channels", "message"),
    [
        ({}, ["R"], "spectralLayoutVersion is None, wanted '1.0'"),
        ({"spectralLayoutVersion": "2.0"}, ["R"], "'2.0'"),
        ({"spectralLayoutVersion": "1.0", "emissiveUnits": "lux"}, ["R"], "'lux'"),
        ({"spectralLayoutVersion": "1.0", "emissiveUnits": "W.m^-2.sr^-1"}, ["T.500nm", "S1.500nm"], "no channel"),
        (
            {"spectralLayoutVersion": "1.0", "emissiveUnits": "W.m^-2.sr^-1"},
            ["S0.500nm", "S0.510 nm"],
            r"a.exr: got the channel 'S0.510 nm', wanted one like 'S0.405,000000nm'",
        ),
        (
            {"spectralLayoutVersion": "1.0", "emissiveUnits": "W.m^-2.sr^-1"},
            ["S0.500nm", "S0.0,5um"],
            r"a.exr: two channels of 500 nm, 'S0.0,5um' and 'S0.500nm'",
        ),
    ],
)
def test_unknown_layouts_are_refused(attributes, channels, message, tmp_path):
    write_exr(tmp_path / "a.exr", attributes, channels)
    with pytest.raises(ValueError, match=message):
        SpectralImage.load(tmp_path / "a.exr")


@pytest.mark.parametrize(
    "name",
    ["S0.500,5nm", "S0.500.5nm", "S0.0,5005um", "S0.5,005E2nm", "S0.5005e-10m", "S0.,5005um", "S0.598,985930THz"],
)
def test_channels_are_named_as_the_layout_allows(name, tmp_path):
    # 299,792.458 nm THz / 500.5 nm = 598.985930… THz.
    write_exr(tmp_path / "a.exr", {"spectralLayoutVersion": "1.0", "emissiveUnits": "W.m^-2.sr^-1"}, ["S0.400nm", name])
    np.testing.assert_allclose(SpectralImage.load(tmp_path / "a.exr").wavelengths, [400, 500.5], rtol=1e-8)


def test_unreadable_files_are_refused(image, tmp_path, capfd):
    with pytest.raises(FileNotFoundError):
        SpectralImage.load(tmp_path / "none.exr")
    (tmp_path / "text.exr").write_text("hello")
    with pytest.raises(ValueError, match="cannot be read as OpenEXR"):
        SpectralImage.load(tmp_path / "text.exr")
    image.save(tmp_path / "half.exr")
    whole = (tmp_path / "half.exr").read_bytes()
    (tmp_path / "half.exr").write_bytes(whole[: len(whole) // 2])
    with pytest.raises(ValueError, match="cannot be read as OpenEXR, is it whole"):
        SpectralImage.load(tmp_path / "half.exr")
    assert capfd.readouterr().err == ""


@pytest.mark.parametrize("error", [OSError("disk full"), KeyboardInterrupt()])
def test_failed_save_keeps_the_old_file(image, tmp_path, monkeypatch, error):
    (tmp_path / "a.exr").write_text("old")

    def blocks(self):
        yield self.radiance[:1]
        raise error

    monkeypatch.setattr(SpectralImage, "blocks", blocks)
    with pytest.raises(type(error)):
        image.save(tmp_path / "a.exr")
    assert [path.name for path in tmp_path.iterdir()] == ["a.exr"]
    assert (tmp_path / "a.exr").read_text() == "old"


def test_a_whole_file_appears_at_the_end_only(tmp_path):
    target = tmp_path / "a.txt"
    with whole_file(target) as temporary:
        assert temporary.parent == tmp_path
        assert temporary.suffix == ".txt"
        temporary.write_text("new")
        assert not target.exists()
    assert target.read_text() == "new"
    assert len(list(tmp_path.iterdir())) == 1
    beside = tmp_path / "beside.txt"
    beside.write_text("")
    assert stat.S_IMODE(target.stat().st_mode) == stat.S_IMODE(beside.stat().st_mode)


def test_a_full_disk_names_the_file(tmp_path):
    with pytest.raises(OSError, match="No space left") as found, whole_file(tmp_path / "out.html"):
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))
    assert found.value.filename == str(tmp_path / "out.html")


def test_whole_file_refuses_a_folder_and_a_missing_folder(tmp_path):
    with pytest.raises(FileNotFoundError, match="folder"), whole_file(tmp_path / "none" / "a.txt"):
        pass
    with pytest.raises(ValueError, match="not an ordinary file"), whole_file(tmp_path):
        pass


@pytest.mark.posix("symbolic links without a privilege")
def test_whole_file_follows_links(tmp_path):
    (tmp_path / "target.txt").write_text("old")
    (tmp_path / "link.txt").symlink_to("target.txt")
    with whole_file(tmp_path / "link.txt") as temporary:
        temporary.write_text("new")
    assert (tmp_path / "link.txt").is_symlink()
    assert (tmp_path / "target.txt").read_text() == "new"


def test_half_precision_refuses_values_out_of_range(tmp_path):
    image = SpectralImage([500.0, 505.0], np.full((1, 1, 2), 7e4))
    with pytest.raises(ValueError, match=r"half: got radiances up to .*float32"):
        image.save(tmp_path / "a.exr", half=True)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize(("factor", "kind"), [(1.0, np.float16), (1e-6, np.float32), (1e6, np.float32)])
def test_half_precision_is_chosen_where_it_rounds_by_less_than_noise(image, factor, kind, tmp_path):
    radiance = np.abs(image.radiance)
    scaled = SpectralImage(image.wavelengths, radiance * (factor / radiance.mean()), image.attributes)
    scaled.save(tmp_path / "a.exr", half=None)
    file = OpenEXR.File(str(tmp_path / "a.exr"), separate_channels=True)
    assert {channel.pixels.dtype for channel in file.channels().values()} == {np.dtype(kind)}
    error = np.abs(SpectralImage.load(tmp_path / "a.exr").radiance - scaled.radiance)
    assert (error <= 2.0**-11 * np.maximum(scaled.radiance, scaled.radiance.mean())).all()


def test_rgb_alone_is_that_of_the_spectral_file_in_half_precision(image, tmp_path):
    image.save(tmp_path / "spectral.exr", half=True)
    image.save(tmp_path / "rgb.exr", rgb=True)
    spectral, rgb = (
        OpenEXR.File(str(tmp_path / f"{name}.exr"), separate_channels=True) for name in ("spectral", "rgb")
    )
    assert set(rgb.channels()) == {"R", "G", "B"}
    for name, channel in rgb.channels().items():
        assert channel.pixels.dtype == np.float16
        np.testing.assert_array_equal(channel.pixels, spectral.channels()[name].pixels)
    assert rgb.header()["spp"] == 16
    with pytest.raises(ValueError, match="spectralLayoutVersion is None"):
        SpectralImage.load(tmp_path / "rgb.exr")
    # A lamp that is brighter than a half float is no failure after hours of rendering.
    bright = SpectralImage(GRID, np.full((1, 1, GRID.size), 1e6))
    bright.save(tmp_path / "rgb.exr", rgb=True)
    assert OpenEXR.File(str(tmp_path / "rgb.exr"), separate_channels=True).channels()["G"].pixels == 65504


@pytest.mark.parametrize(("channels", "count", "spacing"), [(92, 46, 10), (46, 46, 10), (16, 14, 30), (2, 2, 120)])
def test_fewer_channels_are_wider_hats(channels, count, spacing, tmp_path):
    # Spectra of one and of a ramp remain, and a line at 505.7 nm is seen by hats of the new width.
    line = np.maximum(0, 1 - np.abs(505.7 - GRID) / 5) / 5
    SpectralImage(GRID, np.stack([GRID**0, GRID / 100, line])[None]).save(tmp_path / "a.exr", channels=channels)
    loaded = SpectralImage.load(tmp_path / "a.exr")
    grid = loaded.wavelengths
    assert grid.size == count
    np.testing.assert_allclose(np.diff(grid), spacing)
    expected = np.maximum(0, 1 - np.abs(505.7 - grid) / spacing) / spacing
    np.testing.assert_allclose(loaded.radiance[0], [grid**0, grid / 100, expected], rtol=1e-5, atol=1e-8)


@pytest.mark.parametrize("wrong", [{"channels": 1}, {"channels": 0}, {"channels": 46, "rgb": True}])
def test_wrong_channels_are_refused(image, tmp_path, wrong):
    with pytest.raises(ValueError, match="channels: got"):
        image.save(tmp_path / "a.exr", **wrong)
    assert list(tmp_path.iterdir()) == []


def test_a_picture_too_large_to_be_opened_is_no_preview(tmp_path, monkeypatch):
    Image.new("L", (9, 9)).save(tmp_path / "a.png")
    monkeypatch.setattr(Image, "MAX_IMAGE_PIXELS", 9)
    assert spectral_image.exposure_of_preview(tmp_path / "a.png") is None
