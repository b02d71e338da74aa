"""Print the kernels that Dr.Jit compiles for a first picture of a scene, and for others (docs/speed.md).

    python tools/manual/kernels.py [NAME …]

Each scene is rendered in a process of its own, with an empty cache of kernels: 8 × 4 pixels of one sample, the same
again, 24 × 18 pixels of one sample, and of four.
"""

from __future__ import annotations

import contextlib
import importlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

SCENES = Path(__file__).parents[2] / "scenes"
NAMES = ("blaze", "xenopeltis", "compact_disc", "foil", "hologram", "projection")
PICTURES = ((8, 4, 1), (8, 4, 1), (24, 18, 1), (24, 18, 4))  # width, height, samples


def count(name: str) -> None:
    """Render in this process, and print a row of the table."""
    from mitsuba_diffraction import cli  # chooses LLVM

    dr = importlib.import_module("drjit")
    dr.set_flag(dr.JitFlag.KernelHistory, True)
    cells, compiled = [], []
    with tempfile.TemporaryDirectory() as folder:
        for width, height, samples in PICTURES:
            arguments = ["render", str(SCENES / f"{name}.xml"), "--width", str(width), "--height", str(height)]
            arguments += ["--spp", str(samples), "-o", f"{folder}/picture.exr", "--overwrite"]
            sys.argv[1:] = arguments
            with contextlib.redirect_stdout(None), contextlib.suppress(SystemExit):
                cli.main()
            kernels = [kernel for kernel in dr.kernel_history() if kernel["type"] == dr.KernelType.JIT]
            new = [kernel for kernel in kernels if not kernel["cache_hit"]]
            compiled += [kernel["hash"] for kernel in new]
            seconds = sum(kernel["codegen_time"] + kernel["backend_time"] for kernel in new) / 1e3
            cells.append(f"{len(new)} of {len(kernels)}, {seconds:.1f} s")
    twice = len(compiled) - len(set(compiled))
    print(f"| `{name}.xml` | {' | '.join(cells)} | {twice} |", flush=True)


def main(names: list[str]) -> None:
    print("| scene | first | again | another size | more samples | twice |\n|---|---|---|---|---|---|", flush=True)
    for name in names or NAMES:
        with tempfile.TemporaryDirectory() as home:
            subprocess.run([sys.executable, __file__, "--one", name], env={**os.environ, "HOME": home}, check=True)


if __name__ == "__main__":
    if sys.argv[1:2] == ["--one"]:
        count(sys.argv[2])
    else:
        main(sys.argv[1:])
