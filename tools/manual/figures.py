"""Renew figures of the manual, each by its command.

    python tools/manual/figures.py                    # all names, with their times
    python tools/manual/figures.py screen gallery/window

A command writes to a temporary folder, {out}; its figures then replace those in docs/. The commands of the gallery are
on its page. What `mitsuba-diffraction NAME` draws is in the module that `evaluation/commands/NAME.py` or `cli/NAME.py`
calls.
"""

from __future__ import annotations

import argparse
import base64
import os
import shlex
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import nbformat

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
sys.path.insert(0, str(ROOT / "scenes"))
PROGRAMS = {"python": [sys.executable], "mitsuba-diffraction": [sys.executable, "-m", "mitsuba_diffraction"]}


@dataclass(frozen=True)
class Figure:
    """Figures made together.

    Attributes:
        files: below docs/.
        commands: one a line, run in the folder of the repository; $NAME is a variable of the environment.
        minutes: on two cores, if more than one.
        needs: what the extra `test` does not install.
        cell: of the notebook that the commands run, by its id; its picture is the figure.
    """

    files: tuple[str, ...]
    commands: str
    minutes: int | None = None
    needs: str = ""
    cell: str = ""


def notebook(file: str, name: str, cell: str, minutes: int) -> Figure:
    """Return a figure that a cell of a notebook shows."""
    return Figure((file,), f"jupyter execute notebooks/{name}.ipynb --output={{out}}/notebook", minutes, cell=cell)


FIGURES = (
    Figure(("benchmark.png",), "mitsuba-diffraction benchmark --plot {out}/benchmark.png", 8),
    Figure(
        ("blender.jpg",),
        """$BLENDER_PYTHON scenes/blender.py $ADDON {out}/exported.xml
        mitsuba-diffraction render {out}/exported.xml -o {out}/blender.png --spp 128 --denoise \
            --material mat-Disc=compact_disc,material=Al,coat_ior=1.55,orientation=radial \
            --material mat-Skin=xenopeltis_synthetic --material mat-Glass=film --material mat-Foil=foil,material=Al""",
        5,
        needs="a Python with bpy as $BLENDER_PYTHON, a checkout of Mitsuba-Blender as $ADDON (scenes/blender.py)",
    ),
    Figure(
        ("blender_nodes.jpg", "blender_paths.jpg"),
        "python tools/manual/blender_table.py {out}",
        10,
        needs="a Python with bpy as $BLENDER_PYTHON (tools/manual/cycles_picture.py)",
    ),
    Figure(
        ("compare.jpg", "compare-others.jpg"),
        """mitsuba-diffraction compare scenes/xenopeltis.xml -D light=sun --pigment --shader flss --shader nmm \
            --shader pq --shader gem --width 516 --spp 64 --shading-points 2 -o {out}/compare""",
        20,
    ),
    Figure(
        ("cycles.png",),
        "python tools/manual/cycles_figure.py {out}/cycles.png",
        6,
        needs="a Python with bpy as $BLENDER_PYTHON (tools/manual/cycles_picture.py)",
    ),
    Figure(("design.png",), "mitsuba-diffraction design precompute/designed/cat.png -o {out}/design.gsf"),
    Figure(("sunset.png",), "python tools/manual/design_table.py {out}/sunset.png"),
    Figure(
        ("word.jpg",),
        """mitsuba-diffraction design precompute/designed/diffract.png -o {out}/word.gsf
        mitsuba-diffraction render scenes/projection.xml -D plate={out}/word.toml --exposure 10.5 \
            --width 1280 --height 720 --spp 24 --denoise -o {out}/word.exr""",
        10,
    ),
    Figure(("eye_chart.png",), "python tools/manual/eye_chart.py {out}/eye_chart.png"),
    Figure(
        ("efficiencies.png",),
        """mitsuba-diffraction efficiency ruled,lines_per_mm=1200,theory=rigorous,material=Al --angle 17.5 \
            --wavelength 400:700:10 --plot {out}/efficiencies.png""",
    ),
    Figure(("first_scene.png",), "python tools/manual/first_scene.py {out}/first_scene.png"),
    Figure(("inspect.png",), "mitsuba-diffraction inspect precompute/elaphe.toml -o {out}/inspect.png"),
    Figure(
        ("lamp.webp",),
        """mitsuba-diffraction render scenes/compact_disc.xml -D table=dark -D azimuth=-180:168 --exposure 2.8 \
            --width 320 --height 180 --spp 9 --denoise --frames 30 -o {out}/lamp.png""",
        3,
    ),
    Figure(
        ("measured_gratings.png", "measured_transmission.png"),
        "python tools/manual/measured_figures.py {out}/measured_gratings.png {out}/measured_transmission.png",
    ),
    Figure(
        ("orbit.webp",),
        """mitsuba-diffraction render scenes/compact_disc.xml -D table=dark --exposure 2.8 --width 320 --height 180 \
            --spp 9 --denoise --orbit --frames 30 -o {out}/orbit.png""",
        3,
    ),
    notebook("patch_length.png", "02_brdf_and_grating_equation", "cell-16", 6),
    Figure(("picture_error.png",), "python tools/manual/picture_error.py {out}/picture_error.png", 3),
    Figure(("ready_surfaces.jpg",), "python tools/manual/contact_sheet.py {out}/ready_surfaces.png", 3),
    Figure(("removed_dust.png",), "python tools/manual/measured_skins.py {out}/removed_dust.png"),
    notebook("scalar_theory.png", "05_can_i_trust_the_picture", "cell-07", 3),
    Figure(
        ("screen.png",),
        """mitsuba-diffraction render scenes/screen.xml --spp 384 -o {out}/screen.exr
        python scenes/screen.py {out}/screen.exr {out}/screen.png""",
        2,
    ),
    notebook("slits.png", "02_brdf_and_grating_equation", "cell-14", 6),
    Figure(("taylor_row.jpg",), "python tools/manual/taylor_row.py {out}/taylor_row.png", 3),
    Figure(("published_snakes.png",), "python tools/thesis/published_snakes.py {out}/published_snakes.png", 3),
    Figure(
        ("thin_film.png", "film_stack.png"), "python tools/manual/thin_film.py {out}/thin_film.png {out}/film_stack.png"
    ),
    Figure(("fourier_images.png", "interpolation.png"), "python tools/thesis/fourier_figures.py {out}"),
    Figure(("published_heights.png", "published_maps.png"), "python tools/thesis/published_maps.py {out}", 8),
    Figure(
        ("viewing_angle_elaphe_scan.png", "viewing_angle_xenopeltis_scan.png"),
        "python tools/thesis/evaluation.py {out} elaphe_scan xenopeltis_scan",
        8,
    ),
    Figure(
        ("interactive.png",),
        "python tools/manual/viewer_speed.py {out}/interactive.png",
        8,
        needs="Chromium (tools/manual/live_browser.py)",
    ),
    Figure(
        ("viewer.png", "viewer_snake.png"),
        """python tools/manual/viewer_picture.py {out}/viewer.png --frames 12
        python tools/manual/viewer_picture.py {out}/viewer_snake.png --surface xenopeltis --frames 12""",
        needs="Chromium (tools/manual/live_browser.py)",
    ),
)


def figures() -> Iterator[Figure]:
    """Return `FIGURES` and the pictures of the gallery."""
    import gallery

    yield from FIGURES
    for name, words in gallery.commands([DOCS / "gallery.md"])[1].items():
        words = ["{out}/" + word.removeprefix("docs/") if word.startswith("docs/") else word for word in words]
        line = shlex.join(["mitsuba-diffraction", *words])
        yield Figure((f"gallery/{name}.jpg",), line, needs="the models of the gallery, whose page tells the times")


def renew(figure: Figure, docs: Path = DOCS) -> None:
    """Run the commands of a figure and replace its files in a folder.

    Raises:
        subprocess.CalledProcessError: if a command fails.
    """
    import gallery

    with tempfile.TemporaryDirectory() as folder:
        out = Path(folder)
        (out / "gallery").mkdir()
        for line in figure.commands.replace("\\\n", " ").splitlines():
            program, *words = shlex.split(os.path.expandvars(line.strip()))
            words = [word.replace("{out}", out.as_posix()) for word in words]
            subprocess.run([*PROGRAMS.get(program, [program]), *words], cwd=ROOT, check=True)
        if figure.cell:
            (out / figure.files[0]).write_bytes(shown(out / "notebook.ipynb", figure.cell))
        for file in figure.files:
            made = out / file
            if made.suffix == ".jpg":
                gallery.compress(made.with_suffix(".png"))
            shutil.move(made, docs / file)


def shown(path: Path, cell: str) -> bytes:
    """Return the PNG that a cell of a notebook shows."""
    (found,) = (one for one in nbformat.read(path, as_version=4).cells if one.id == cell)
    (picture,) = (out.data["image/png"] for out in found.outputs if "image/png" in out.get("data", {}))
    return base64.b64decode(picture)


def main(arguments: Sequence[str] | None = None) -> None:
    """Renew the named figures, or list all."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("names", nargs="*", metavar="NAME")
    options = parser.parse_args(arguments)
    known = {file.rpartition(".")[0]: figure for figure in figures() for file in figure.files}
    if unknown := set(options.names) - set(known):
        parser.error(f"got {', '.join(sorted(unknown))}, wanted names among {', '.join(known)}")
    if not options.names:
        for name, figure in known.items():
            time = "" if figure.minutes is None else f"{figure.minutes} min"
            print(f"{name:33} {time:7} {figure.needs and f'needs {figure.needs}'}".rstrip())
    for figure in dict.fromkeys(known[name] for name in options.names):
        renew(figure)


if __name__ == "__main__":
    main()
