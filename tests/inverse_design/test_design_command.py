"""The command `design`: its files, what it says, and mistakes in one line."""

import signal
from importlib import import_module
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

import mitsuba_diffraction as md
from mitsuba_diffraction.errors import RequestError
from mitsuba_diffraction.files.outputs import check_outputs
from mitsuba_diffraction.files.picture_file import read_picture
from mitsuba_diffraction.inverse_design import search
from mitsuba_diffraction.inverse_design.target import finest_strokes
from mitsuba_diffraction.precomputation.recipe import Recipe

OPTIONS = "--texel 1 --texels 12 --wavelength 532 --starts 1"


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    picture = np.zeros((24, 24), np.uint8)
    picture[2:10, 12:22], picture[10:18, 12:15] = 255, 188  # 188 is half of the light of 255
    Image.fromarray(picture).save("flag.png")
    Image.fromarray(np.zeros_like(picture)).save("black.png")
    dot = np.zeros((65, 65), np.uint8)
    dot[31:34, 31:34] = 255
    Image.fromarray(dot).save("dot.png")
    Image.fromarray(np.dstack([picture] * 4)).save("alpha.png")
    Path("text.png").write_text("no picture")
    Path("cut.png").write_bytes(Path("flag.png").read_bytes()[:60])


@pytest.mark.not_quick
def test_a_design_is_written_as_relief_recipe_and_picture(command):
    code, said, error = command(f"design flag.png {OPTIONS} --seed 3 -o plate.gsf")
    assert (code, error) == (0, "")
    assert "532 nm" in said
    assert {path.name for path in Path().glob("plate.*")} == {"plate.gsf", "plate.tif", "plate.toml", "plate.png"}
    options = {"texel": 1.0, "texels": 12, "wavelengths": 532, "starts": 1, "seed": 3}
    expected = md.design(read_picture(Path("flag.png")), **options).height_field
    field = md.read_height_field("plate.gsf")
    assert field.pixel_size == pytest.approx(expected.pixel_size, rel=1e-6)
    assert field.heights == pytest.approx(expected.heights, abs=1e-6)
    counted = md.read_height_field("plate.tif")  # its description has its scale
    assert counted.heights == pytest.approx(expected.heights, abs=0.8 / 65535)
    assert counted.pixel_size == pytest.approx(expected.pixel_size, rel=1e-5)
    recipe = Recipe.load("plate.toml")
    assert np.array_equal(recipe.height_field().heights, field.heights)
    assert recipe.settings.coherence_length == 6
    # Files of the package may be replaced.
    check_outputs([], [("-o", path) for path in Path().glob("plate.*")])


@pytest.mark.not_quick
def test_files_for_makers_are_written(command, few_iterations):
    code, said, _ = command(
        f"design flag.png {OPTIONS} --levels 4 --export stl --export master --export gds -o step.gsf"
    )
    assert code == 0
    for name in ("step.stl", "step_master.gsf", "step.gds"):
        assert Path(name).stat().st_size > 1000
        assert f"\n{name}: " in said
    check_outputs([], [("-o", path) for path in Path().glob("step*")])


@pytest.fixture
def few_iterations(monkeypatch):
    """For notes and files of a design that need not be good."""
    monkeypatch.setattr(search, "FIRST_ITERATIONS", 1)
    monkeypatch.setattr(search, "LAST_ITERATIONS", 4)


@pytest.fixture
def noted(monkeypatch):
    """Designs end with the error "noted" once it is known what they need."""

    def search(*request, expect, **options):
        expect(0.0, 0.0)
        raise RequestError("noted")

    monkeypatch.setattr(import_module("mitsuba_diffraction.cli.design"), "search", search)


def test_texels_follow_from_the_detail(command, noted):
    code, _, error = command("design flag.png --texel 1 --wavelength 532 --starts 1 --detail 4")
    assert (code, error.rpartition(": ")[2]) == (2, "noted\n")
    assert "note: 11 texels along the period, 0.8 µm deep, angle 17.5°, for strokes of 1/4 of the picture" in error


def test_texels_follow_from_the_finest_strokes_of_the_picture(command, noted):
    bars = np.zeros((240, 240), np.uint8)
    bars[40:200, 30:210:24] = bars[40:200, 31:210:24] = bars[40:200, 32:210:24] = 255  # three pixels wide
    Image.fromarray(bars).save("bars.png")
    assert finest_strokes(read_picture(Path("bars.png"))) == pytest.approx(80, rel=0.2)
    assert finest_strokes(np.pad(np.ones((3, 20)), 10)) == pytest.approx(40 / 3, rel=0.2)
    code, _, error = command("design flag.png --wavelength 532 --height-range 0.3 --starts 1")
    assert code == 2
    assert "note: 32 texels along the period, 0.3 µm deep; the finest strokes are 1/7 of the picture" in error
    Image.fromarray(np.repeat([0, 255], 32).astype(np.uint8)[None].repeat(64, 0)).save("half.png")
    code, _, error = command("design half.png --wavelength 532 --angle 2 --starts 1")
    assert code == 2
    assert "note: 39 texels along the period" in error  # as many as two orders to each side take


def test_a_target_is_a_picture_as_seen_on_a_screen():
    found = read_picture(Path("flag.png"))
    assert found[5, 15] == 1
    assert found[15, 13] == pytest.approx(0.503, abs=1e-3)
    with Image.open("flag.png") as picture:
        picture.convert("RGBA").save("opaque.png")
    assert np.array_equal(read_picture(Path("opaque.png")), found)


def test_transparent_parts_are_dark_and_a_black_logo_is_inverted():
    found = read_picture(Path("flag.png"))
    with Image.open("alpha.png") as picture:
        alpha = np.asarray(picture, float)[..., 3] / 255
    assert read_picture(Path("alpha.png")) == pytest.approx(found * alpha)
    logo = np.zeros((24, 24, 4), np.uint8)
    logo[5:9, 3:20, 3] = 255  # black ink on a transparent ground
    Image.fromarray(logo).save("logo.png")
    assert read_picture(Path("logo.png")).max() == 0
    assert np.array_equal(read_picture(Path("logo.png"), invert=True), logo[..., 3] > 0)


def test_a_negative_is_cast_and_dark_on_light_is_named(command, noted):
    paper = 255 - np.asarray(Image.open("flag.png"))
    Image.fromarray(paper).save("paper.png")
    negative = read_picture(Path("paper.png"), invert=True)
    assert negative == pytest.approx(read_picture(Path("flag.png")), abs=1e-12)
    code, _, error = command(f"design paper.png {OPTIONS}")
    assert code == 2
    assert "note: paper.png is light up to its edges; --invert casts what is dark in it, with more contrast" in error


@pytest.mark.slow
def test_invert_is_not_advised_where_it_is_given(command):
    picture = np.zeros((24, 24), np.uint8)
    picture[8:12, 8:14] = 255
    Image.fromarray(picture).save("night.png")
    code, said, error = command(f"design night.png {OPTIONS} --invert")
    assert (code, error) == (0, "")
    assert "most of the picture is light: without --invert, its other parts are cast" in said
    Image.fromarray(np.full_like(picture, 255)).save("white.png")
    code, _, error = command("design white.png --invert")
    assert (code, error.partition("got ")[2]) == (2, "white alone, wanted light somewhere\n")


def test_a_target_is_upright_as_its_exif_data_say():
    exif = Image.Exif()
    exif[0x0112] = 6  # its first row is shown on the right
    with Image.open("flag.png") as picture:
        picture.save("phone.png", exif=exif)
    upright = read_picture(Path("flag.png"))
    assert np.array_equal(read_picture(Path("phone.png")), np.rot90(upright, -1))
    assert not np.array_equal(np.rot90(upright, -1), upright)


def test_a_target_may_be_a_pgm_of_16_bits():
    levels = np.linspace(0, 65535, 8).astype(">u2").reshape(1, 8).repeat(8, 0)
    Path("grey.pgm").write_bytes(b"P5 8 8 65535\n" + levels.tobytes())
    assert read_picture(Path("grey.pgm"))[0, [0, 7]] == pytest.approx([0, 1])


@pytest.mark.parametrize("kind", [np.float32, np.int32])
def test_a_target_of_32_bits_is_refused(kind):
    levels = np.linspace(0, 1, 8).reshape(1, 8).repeat(8, 0)
    Image.fromarray((levels * (1 if kind == np.float32 else 255)).astype(kind)).save("grey.tif")
    with pytest.raises(ValueError, match=r"grey\.tif: got numbers of 32 bits, wanted a picture of 8 or 16 bits"):
        read_picture(Path("grey.tif"))


@pytest.mark.few(1)
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_an_interrupted_command_writes_the_best_so_far(command, monkeypatch, number):
    class Bar:
        def __enter__(self):
            return self

        def __exit__(self, *_):
            pass

        def __call__(self, done, total):
            if done == 40:
                signal.raise_signal(number)

    monkeypatch.setattr(import_module("mitsuba_diffraction.cli.design"), "progress_bar", lambda *_: Bar())
    code, _, error = command(f"design flag.png {OPTIONS}")
    assert code == 130
    assert "flag_relief.gsf holds the best relief so far" in error
    assert np.ptp(md.read_height_field("flag_relief.gsf").heights) > 0.1


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ("black.png", "black.png: got black alone, wanted light somewhere; --invert casts what is dark"),
        ("flag.png --seen-on floor", "error: --seen-on: got 'floor', wanted wall or screen"),
        ("text.png", "text.png: not a picture that can be read"),
        ("cut.png", "cut.png: not a picture that can be read"),
        ("gone.png", "gone.png: no such file"),
        ("flag.png -o plate.exr", "-o: got plate.exr, wanted a file name that ends in .gsf or .tif"),
        ("flag.png -o flag.gsf", "-o flag.gsf: would overwrite flag.png, which is read"),
        ("flag.png --wavelength red", "--wavelength: got 'red', wanted a number"),
        ("flag.png --texel 0.2", "error: --texel: got 0.2 µm, wanted more than half the wavelength"),
        ("flag.png --detail 8 --texels 12", "--detail: got 8 and --texels 12, wanted one of them"),
        ("flag.png --export obj", "--export: got 'obj', wanted one of stl, gds, master"),
        ("flag.png --export gds", "--levels: got none, and gds has a layer for each, wanted their number"),
        ("flag.png --export gds --levels 1000000", "--levels: got 1000000, wanted at most 32768 for gds, one for"),
        (
            "flag.png --angle 0.5",
            "--texels: got 96 of 0.8 µm with an angle of 0.5°, wanted a period of at least",
        ),
        ("flag.png --starts 0", "error: --starts: got 0, wanted a whole number of at least 1"),
        ("flag.png --levels 1", "error: --levels: got 1, wanted a whole number of at least 2"),
        ("flag.png --wavelength 0.5", "error: --wavelength: got [0.5], wanted one or several in nm"),
        ("flag.png --height-range 800", "error: --height-range: got 800 µm"),
        ("flag.png --int-ior glass", "error: --int-ior: got 'glass', wanted"),
        ("flag.png --detail 1", "error: --detail: got 1.0, wanted the number of finest strokes"),
        ("flag.png --detail nan", "error: --detail: got nan, wanted the number of finest strokes"),
        ("flag.png --wavelength 500,nan", "error: --wavelength: got nan, wanted a positive number"),
        ("flag.png --wavelength 0", "error: --wavelength: got 0, wanted a positive number"),
        ("flag.png --angle 0", "error: --angle: got 0, wanted a positive number"),
        ("flag.png --texel 0", "error: --texel: got 0, wanted a positive number"),
        ("dot.png --texels 32", "error: dot.png: it is the mirror direction only"),
    ],
)
def test_mistakes_are_refused_in_one_line(command, arguments, message):
    before = set(Path().iterdir())
    code, said, error = command(f"design {arguments}")
    assert (code, said, error.count("\n")) == (2, "", 1)
    assert message in error
    assert set(Path().iterdir()) == before
