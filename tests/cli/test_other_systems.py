"""Every command where there is no POSIX, and in an encoding of Windows, tried on Linux; what differs by system."""

import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from PIL import Image

from mitsuba_diffraction import cli
from mitsuba_diffraction.errors import pip_install, shell_command

# Removes what Windows does not have, but for what the libraries need on Linux. A text file without an encoding, if the
# package opens it, is an error.
WITHOUT_POSIX = """
import os, signal, sys, warnings
for name in ("fcntl", "resource", "pwd", "grp", "termios", "tty", "pty", "syslog", "curses", "readline"):
    sys.modules[name] = None
for module, names in (
    (os, "fork forkpty O_DIRECTORY mkfifo mknod getpgid setsid killpg nice getloadavg sched_getaffinity"),
    (signal, "SIGHUP SIGKILL SIGQUIT SIGALRM SIGUSR1 SIGUSR2 SIGPIPE SIGCHLD SIGTSTP alarm setitimer pthread_kill"),
):
    for name in names.split():
        delattr(module, name)
warnings.filterwarnings("ignore", "only soft file lock is available")
warnings.filterwarnings("ignore", category=EncodingWarning)
warnings.filterwarnings("error", category=EncodingWarning, module="mitsuba_diffraction")
from mitsuba_diffraction import cli
from mitsuba_diffraction.render import passes
passes.SAMPLES_PER_PASS = 64
for line in sys.stdin.read().splitlines():
    sys.argv = [cli.NAME, *line.split()]
    try:
        cli.main()
    except SystemExit as exit:
        print(f"{exit.code}: {line}", file=sys.stderr)
"""
SCENE = """<scene version="3.0.0"><integrator type="path"/><sensor type="perspective"><float name="fov" value="35"/>
<transform name="to_world"><lookat origin="0,-6,5" target="0,0,0.7" up="0,0,1"/></transform>
<film type="hdrfilm"><integer name="width" value="8"/><integer name="height" value="6"/></film></sensor>
<default name="tolerance" value="0.1"/><default name="representation" value="slices"/>
<default name="terms" value="auto"/><default name="heights_from" value="mean"/>
<emitter type="directional"><vector name="direction" value="0,1,-1"/></emitter>
<shape type="sphere"><point name="center" value="0,0,1"/><bsdf type="diffraction_grating">
<string name="profile" value="blazed"/><float name="period" value="2"/><float name="depth" value="0.25"/>
<float name="coherence_length" value="3"/><float name="tolerance" value="$tolerance"/>
<string name="representation" value="$representation"/><string name="terms" value="$terms"/>
<string name="heights_from" value="$heights_from"/>
<bsdf type="diffuse" name="base"/></bsdf></shape></scene>"""
QUICK = 3
LINES = (
    "examples",
    "efficiency blazed,depth=0.1",
    "view blazed,depth=0.1 -o page.html --no-open",
    "inspect scan.png,pixel_size=0.5,height_range=0.3 -o inspected.png",
    "precompute scan.png,pixel_size=0.5,height_range=0.3,tolerance=0.1 -o scan.exr",
    "export blazed,depth=0.1 -o orders.csv --wavelength 500 --angle 30",
    "render scene.xml -o picture.exr --spp 4 --checkpoint 0",
    "design target.png --texels 16 --texel 1 --wavelength 532 --starts 1 -o plate.gsf",
    "hologram target.png -o hologram",
    "compare scene.xml --spp 4 --width 8 --no-costs -o compared",
    "benchmark --surface blazed --tolerance 0.1 --json benchmark.json",
    "convergence scene.xml --terms 6,12 --width 8 --spp 4 -o terms.png",
    "validate blazed",
)


@pytest.mark.slow
@pytest.mark.posix("what it takes away")
@pytest.mark.parametrize("lines", [LINES[:QUICK], pytest.param(LINES[QUICK:], marks=pytest.mark.slow)])
def test_every_command_runs_without_posix(lines, tmp_path):
    assert {command.callback.__name__ for command in cli.app.registered_commands} == {line.split()[0] for line in LINES}
    heights = 127 + 120 * np.sin(np.arange(16) * np.pi / 4)
    Image.fromarray(np.tile(heights, (16, 1)).astype(np.uint8)).save(tmp_path / "scan.png")
    Image.fromarray(np.uint8(255 * np.eye(16))).save(tmp_path / "target.png")
    (tmp_path / "scene.xml").write_text(SCENE)
    done = subprocess.run(
        [sys.executable, "-X", "warn_default_encoding", "-c", WITHOUT_POSIX],
        cwd=tmp_path,
        input="\n".join(lines).encode(),
        capture_output=True,
        env={**os.environ, "PYTHONIOENCODING": "cp1252", "PYTHONPATH": str(Path(cli.__file__).parents[2])},
    )
    out, err = done.stdout.decode("cp1252"), done.stderr.decode("cp1252")
    ended = [line for line in err.splitlines() if line.partition(": ")[2] in lines]
    assert ended == [f"0: {line}" for line in lines], err
    assert "lambda" in out or lines != LINES[:QUICK]
    assert "\\u" not in out + err
    assert not [path for path in tmp_path.rglob(".*") if path.is_file()]


def test_commands_in_messages_are_quoted_for_the_shell_of_the_system(monkeypatch):
    words = ("mitsuba-diffraction", "view", "a scan.png", "x,y", "it's")
    assert shell_command(*words) == """mitsuba-diffraction view 'a scan.png' x,y 'it'"'"'s'"""
    monkeypatch.setattr(os, "name", "nt")
    assert shell_command(*words) == """mitsuba-diffraction view "a scan.png" "x,y" "it's\""""
    assert pip_install("llvm") == "pip install mitsuba_diffraction[llvm]"


def test_what_a_pipe_cannot_encode_is_printed_in_words():
    code = "from mitsuba_diffraction.progress import *; adapt_streams(); tell('λ − 5 µm ≤ ΔE00 π 10⁶ é \\udcff')"
    for encoding, expected in (
        ("cp1252", "lambda - 5 µm <= DeltaE00 pi 10^6 é \\udcff"),
        ("ascii", "lambda - 5 um <= DeltaE00 pi 10^6 \\xe9 \\udcff"),
        ("utf-8", "λ − 5 µm ≤ ΔE00 π 10⁶ é \\udcff"),
    ):
        environment = {**os.environ, "PYTHONIOENCODING": encoding}
        done = subprocess.run([sys.executable, "-c", code], capture_output=True, env=environment)
        assert done.stdout.decode(encoding).strip() == expected
