"""Each case in an interpreter of its own: which LLVM Dr.Jit has is settled once per process."""

from __future__ import annotations

import os
import shutil
import subprocess
import sys
from importlib import metadata
from pathlib import Path

import pytest

WHEEL_FILES = [
    Path(file.locate()).resolve()
    for distribution in metadata.distributions(name="karellen-llvm-core")
    for file in distribution.files or ()
    if ".so" in file.name
]
WHEEL = next((file for file in WHEEL_FILES if file.name.startswith("libLLVM") and file.is_file()), None)

needs_wheel = pytest.mark.skipif(WHEEL is None, reason="karellen-llvm-core is not installed")

IMPORT = "import mitsuba_diffraction; from mitsuba_diffraction import variants; import drjit as dr, mitsuba as mi"
USE = """
assert variants.llvm_problem() is None, variants.llvm_problem()
assert dr.detail.llvm_version() >= variants.MINIMUM_VERSION, dr.detail.llvm_version()
mi.set_variant("llvm_ad_spectral")
assert dr.allclose(dr.maximum(mi.Float(1, 2), dr.opaque(mi.Float, 1.5)), [1.5, 2])
"""
PATH = "import os; print(os.environ['DRJIT_LIBLLVM_PATH'])"


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
    process = subprocess.run([sys.executable, "-c", "\n".join(lines)], env=environment, capture_output=True, text=True)
    assert process.returncode == 0, f"exit code {process.returncode}\n{process.stdout}{process.stderr}"
    return process


@pytest.mark.slow
@needs_wheel
@pytest.mark.parametrize("major", [14, 15])
def test_the_wheel_replaces_an_old_llvm(major: int) -> None:
    process = run(IMPORT, USE, library=old_library(major))
    assert "is not an LLVM 17 or later" in process.stderr


@pytest.mark.slow
@needs_wheel
def test_the_wheel_replaces_a_missing_llvm() -> None:
    run(IMPORT, USE, library="/nonexistent")


@pytest.mark.slow
@needs_wheel
def test_the_wheel_is_used_by_default() -> None:
    assert not run(IMPORT, USE).stderr


@pytest.mark.slow
@pytest.mark.few(1)
@needs_wheel
@pytest.mark.parametrize("first", ["import drjit", "import mitsuba"])
def test_an_old_llvm_that_was_loaded_first_is_reported_before_a_kernel_aborts(first: str) -> None:
    process = run(
        first,
        IMPORT,
        "mi.set_variant('llvm_ad_spectral')",
        "try: mi.load_dict({'type': 'diffraction_grating', 'profile': 'blazed', 'period': 2.5, 'depth': 0.25})",
        "except RuntimeError as error: print(error)",
        library=old_library(15),
    )
    line = process.stdout.splitlines()[-1]
    assert "found 15." in line
    assert "import mitsuba_diffraction before mitsuba" in line


@pytest.mark.slow
@needs_wheel
def test_a_usable_llvm_of_the_user_stays(tmp_path: Path) -> None:
    (tmp_path / "lib").symlink_to(WHEEL.parent)
    library = tmp_path / "lib" / WHEEL.name
    process = run(IMPORT, USE, PATH, library=str(library))
    assert process.stdout.strip() == str(library)


@pytest.mark.slow
@pytest.mark.skipif(not any(file.name.startswith("libc++.so.1") for file in WHEEL_FILES), reason="no such wheel")
def test_a_wheel_without_its_links_is_used(tmp_path: Path) -> None:
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

    process = run(IMPORT, USE, PATH, library="/nonexistent", python_path=info.parent)
    assert process.stdout.strip() == str(folder / WHEEL.name)


@pytest.mark.few(1)
@pytest.mark.parametrize("first", ["", "import mitsuba"])
def test_without_any_llvm_the_message_says_what_is_missing(first: str) -> None:
    process = run(
        "from importlib import metadata; metadata.distributions = lambda **arguments: []",
        first,
        IMPORT,
        "print(variants.llvm_problem())",
        "mi.set_variant('scalar_spectral'); mi.load_dict({'type': 'diffuse'})",
        "from mitsuba_diffraction.variants import choose_variant",
        "try: choose_variant('llvm_ad_spectral')",
        "except RuntimeError as error: print(error)",
        library="/nonexistent",
    )
    line, refusal = process.stdout.splitlines()
    assert "needs LLVM 17 or later (none found)" in line
    assert "DRJIT_LIBLLVM_PATH" in line
    assert line in refusal


def test_a_library_that_dr_jit_misses_is_named(tmp_path: Path) -> None:
    """Its own report of it is a NameError of Dr.Jit 1.5."""
    missing = "libatomic.so.1: cannot open shared object file: No such file or directory"
    (tmp_path / "mitsuba.py").write_text(
        f"try:\n    raise ImportError({missing!r})\nexcept ImportError:\n    _drjit_ext\n"
    )
    (tmp_path / "scene.xml").write_text('<scene version="3.0.0"/>')
    command = [sys.executable, "-m", "mitsuba_diffraction", "render", str(tmp_path / "scene.xml")]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), *sys.path])}
    process = subprocess.run(command, env=environment, capture_output=True, text=True)
    wanted = f"mitsuba-diffraction: error: Dr.Jit cannot be loaded: {missing} (Debian: apt install libatomic1)\n"
    assert (process.returncode, process.stderr) == (1, wanted)
