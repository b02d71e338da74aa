"""Each case in an interpreter of its own: which LLVM Dr.Jit has is settled once per process."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

from mitsuba_diffraction import llvm

ROOT = Path(llvm.__file__).resolve().parents[1]
WHEEL_FILES = [
    Path(file.locate()).resolve()
    for distribution in metadata.distributions(name="karellen-llvm-core")
    for file in distribution.files or ()
    if ".so" in file.name
]
WHEEL = next((file for file in WHEEL_FILES if file.name.startswith("libLLVM") and file.is_file()), None)

needs_wheel = pytest.mark.skipif(WHEEL is None, reason="karellen-llvm-core is not installed")

BEGIN = {
    "package": "",
    "drjit": "import drjit",
    "mitsuba": "import mitsuba",
    "variant": "import mitsuba as mi; mi.set_variant('llvm_ad_spectral')",
}
ENSURE = "from mitsuba_diffraction import llvm; llvm.ensure(); import drjit as dr, mitsuba as mi"
USE = """
assert llvm.problem() is None, llvm.problem()
assert dr.detail.llvm_version() >= llvm.MINIMUM_VERSION, dr.detail.llvm_version()
mi.set_variant("llvm_ad_spectral")
assert dr.allclose(dr.maximum(mi.Float(1, 2), dr.opaque(mi.Float, 1.5)), [1.5, 2])
"""


def old_library(major: int) -> str:
    """Path of the system's libLLVM of that version; skips the test where there is none."""
    for pattern in (f"lib/*/libLLVM-{major}.so*", f"lib*/libLLVM-{major}.so*", f"lib/llvm-{major}/lib/libLLVM*.so*"):
        if found := sorted(Path("/usr").glob(pattern)):
            return str(found[0])
    pytest.skip(f"this system has no libLLVM {major}")


def run(*lines: str, library: str | None = None, python_path: Path | None = None) -> subprocess.CompletedProcess[str]:
    environment = {name: value for name, value in os.environ.items() if name != "DRJIT_LIBLLVM_PATH"}
    if library is not None:
        environment["DRJIT_LIBLLVM_PATH"] = library
    if python_path is not None:
        environment["PYTHONPATH"] = str(python_path)
    process = subprocess.run(
        [sys.executable, "-c", "\n".join(lines)], cwd=ROOT, env=environment, capture_output=True, text=True
    )
    assert process.returncode == 0, f"exit code {process.returncode}\n{process.stdout}{process.stderr}"
    return process


@needs_wheel
@pytest.mark.parametrize("begin", BEGIN)
def test_takes_the_place_of_an_old_llvm(begin: str) -> None:
    process = run(BEGIN[begin], ENSURE, USE, library=old_library(15))
    assert "does not give an LLVM 17 or later" in process.stderr


@needs_wheel
@pytest.mark.parametrize("begin", ["package", "mitsuba"])
def test_takes_the_place_of_an_llvm_that_drjit_refuses(begin: str) -> None:
    run(BEGIN[begin], ENSURE, USE, library=old_library(14))


@needs_wheel
@pytest.mark.parametrize("begin", ["package", "mitsuba"])
def test_takes_the_place_of_a_missing_llvm(begin: str) -> None:
    run(BEGIN[begin], ENSURE, USE, library="/nonexistent")


@needs_wheel
def test_without_the_user_doing_anything() -> None:
    process = run("import mitsuba as mi; mi.set_variant('scalar_spectral')", ENSURE, USE)
    assert "DRJIT_LIBLLVM_PATH" not in process.stderr


@needs_wheel
def test_arrays_threads_and_scalar_scenes_survive_the_exchange(tmp_path: Path) -> None:
    before = """
import drjit as dr, mitsuba as mi
mi.set_variant("scalar_rgb")
box = mi.cornell_box()
box["sensor"]["film"].update(width=8, height=8)
scalar_scene = mi.load_dict(box)
mi.render(scalar_scene, spp=1)
mi.set_variant("llvm_ad_spectral")
dr.set_thread_count(3)
evaluated = mi.Float([1, 2, 3]) + 1
dr.eval(evaluated)
pending = 2 * evaluated
tensor = mi.TensorXf([1, 2, 3, 4], (2, 2))
dr.enable_grad(evaluated)
square = evaluated * evaluated
"""
    after = f"""
assert dr.thread_count() == 3, dr.thread_count()
assert evaluated.numpy().tolist() == [2, 3, 4] and pending.numpy().tolist() == [4, 6, 8]
assert tensor.numpy().tolist() == [[1, 2], [3, 4]]
dr.backward(square)
assert dr.grad(evaluated).numpy().tolist() == [4, 6, 8]
image = mi.render(mi.load_dict(mi.cornell_box()), spp=1)
mi.util.write_bitmap({str(tmp_path / "box.exr")!r}, image, write_async=False)
assert dr.allclose(mi.TensorXf(mi.Bitmap({str(tmp_path / "box.exr")!r})), image, rtol=1e-2, atol=1e-2)
mi.set_variant("scalar_rgb")
assert mi.render(scalar_scene, spp=1).shape == (8, 8, 3)
"""
    run(before, ENSURE, USE, after, library=old_library(15))


@needs_wheel
def test_scene_loaded_with_an_old_llvm_is_left_whole() -> None:
    begin = "import mitsuba as mi; mi.set_variant('llvm_ad_spectral'); bsdf = mi.load_dict({'type': 'diffuse'})"
    process = run(begin, ENSURE, "print(llvm.problem())", library=old_library(15))
    assert "found 15.0" in process.stdout
    assert "import mitsuba_diffraction before" in process.stdout
    assert process.stdout.count("\n") == 1


@needs_wheel
@pytest.mark.parametrize("begin", ["package", "variant"])
def test_a_usable_llvm_of_the_user_stays(begin: str, tmp_path: Path) -> None:
    (tmp_path / "lib").symlink_to(WHEEL.parent)
    library = tmp_path / "lib" / WHEEL.name
    process = run(
        f"import os\n{BEGIN[begin]}",
        "from mitsuba_diffraction import llvm; llvm._replace = llvm._wheel_library = None",
        ENSURE,
        USE,
        "print(os.environ['DRJIT_LIBLLVM_PATH'])",
        library=str(library),
    )
    assert process.stdout.strip() == str(library)


@pytest.mark.skipif(not any(file.name.startswith("libc++.so.1") for file in WHEEL_FILES), reason="no such wheel")
def test_wheel_whose_links_are_not_made_yet(tmp_path: Path) -> None:
    """As right after pip, in the interpreter that runs on, or in an environment that is read-only."""
    folder = tmp_path / "lib"
    libraries = {file.name: file for file in WHEEL_FILES if file.name.startswith(("libLLVM", "libc++", "libunwind"))}
    record = []
    for name, file in libraries.items():
        target = folder / file.relative_to(WHEEL.parent)
        target.parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(file, target)
        record.append(f"../lib/{target.relative_to(folder)},,")
        assert name == target.name
    info = tmp_path / "site" / "karellen_llvm_core-99.dist-info"
    info.mkdir(parents=True)
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: karellen-llvm-core\nVersion: 99\n")
    (info / "RECORD").write_text("\n".join(record) + "\n")

    process = run(
        "import os", "import mitsuba", ENSURE, USE, "print(os.environ['DRJIT_LIBLLVM_PATH'])",
        library="/nonexistent", python_path=info.parent,
    )  # fmt: skip
    assert process.stdout.strip() == str(folder / WHEEL.name)


@pytest.mark.parametrize("begin", ["package", "mitsuba"])
def test_no_llvm_at_all(begin: str) -> None:
    process = run(
        "from importlib import metadata; metadata.distributions = lambda **arguments: []",
        BEGIN[begin],
        ENSURE,
        "print(llvm.problem())",
        "mi.set_variant('scalar_spectral'); mi.load_dict({'type': 'diffuse'})",
        "from mitsuba_diffraction.variants import choose_variant",
        "assert choose_variant('scalar_spectral') == 'scalar_spectral'",
        "try: choose_variant('llvm_ad_spectral')",
        "except RuntimeError as error: print(error)",
        library="/nonexistent",
    )
    line, refusal = process.stdout.splitlines()
    assert "needs LLVM 17 or later (none found)" in line
    assert "DRJIT_LIBLLVM_PATH" in line
    assert line in refusal
