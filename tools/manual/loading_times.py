"""Print the table of docs/speed.md: the time from a command to the first picture, with and without cached results.

    python tools/manual/loading_times.py [NAME …]

Each command renders 8 × 4 pixels of one sample, four times: with nothing cached, with all cached, without the spectrum,
without Dr.Jit's kernels.
"""

from __future__ import annotations

import os
import resource
import shutil
import subprocess
import sys
import tempfile
import time
from pathlib import Path

SCENES = Path(__file__).parents[2] / "scenes"
SCENE = """<scene version="3.0.0">
    <integrator type="diffraction_path"/>
    <sensor type="perspective">
        <transform name="to_world"><lookat origin="0, -3, 3" target="0, 0, 0" up="0, 0, 1"/></transform>
        <film type="hdrfilm"><rfilter type="box"/></film>
    </sensor>
    <emitter type="constant"/>
    <shape type="rectangle"><bsdf type="diffraction_grating">{}</bsdf></shape>
</scene>
"""
SURFACES: dict[str, dict[str, float | str]] = {
    "blazed": {"period": 1.7, "depth": 0.31},
    "crossed": {"period": 2.3, "depth": 0.21},
    "compact_disc": {"period": 1.5, "depth": 0.12},
    "foil": {"depth": 0.7},
    "xenopeltis_synthetic": {"depth": 0.4},
    "film": {"depth": 0.7, "transmission": "sheet", "int_ior": 1.5},
}
RUN = "from mitsuba_diffraction import cli, progress; progress._MIN_REPORTED_DURATION = 0; cli.main()"


def run(scene: Path, folder: Path) -> tuple[float, float, str]:
    """Return the wall and the processor time of a command in seconds, and what its wall time was spent on."""
    environment = {**os.environ, "HOME": str(folder / "home"), "MITSUBA_DIFFRACTION_CACHE": str(folder / "cache")}
    command = [sys.executable, "-c", RUN, "render", str(scene), "--width", "8", "--height", "4", "--spp", "1"]
    before, start = resource.getrusage(resource.RUSAGE_CHILDREN), time.perf_counter()
    printed = subprocess.run(
        [*command, "-o", str(folder / "picture.exr"), "--overwrite"],
        env=environment,
        check=True,
        capture_output=True,
        text=True,
    ).stdout
    wall, after = time.perf_counter() - start, resource.getrusage(resource.RUSAGE_CHILDREN)
    used = after.ru_utime + after.ru_stime - before.ru_utime - before.ru_stime
    return wall, used, printed.rpartition(" s: ")[2].strip()


def main(names: list[str]) -> None:
    print("| surface | nothing cached | without the spectrum | without kernels | all cached | ratio | first, s |")
    print("|---|---|---|---|---|---|---|", flush=True)
    for name in names or ["projection.xml", *SURFACES]:
        with tempfile.TemporaryDirectory() as temporary:
            folder = Path(temporary)
            scene = SCENES / name
            if name in SURFACES:
                scene, parameters = folder / "scene.xml", {"profile": name, **SURFACES[name]}
                scene.write_text(
                    SCENE.format(
                        "".join(
                            f'<{"string" if isinstance(value, str) else "float"} name="{key}" value="{value}"/>'
                            for key, value in parameters.items()
                        )
                    )
                )
            (folder / "home").mkdir()
            first, full = run(scene, folder), run(scene, folder)
            for spectrum in (folder / "cache").glob("*.exr"):
                spectrum.unlink()
            no_spectrum = run(scene, folder)
            shutil.rmtree(folder / "home")
            (folder / "home").mkdir()
            no_kernels = run(scene, folder)
            cells = [f"{wall:.1f} ({used:.1f})" for wall, used, _ in (first, no_spectrum, no_kernels, full)]
            ratio = f"{no_spectrum[0] / full[0]:.1f} ({no_spectrum[1] / full[1]:.1f})"
            print(f"| `{name}` | {' | '.join(cells)} | {ratio} | {first[2]} |", flush=True)


if __name__ == "__main__":
    main(sys.argv[1:])
