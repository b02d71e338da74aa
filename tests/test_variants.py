from __future__ import annotations

import functools
import platform
from importlib import metadata

import drjit as dr
import mitsuba as mi
import pytest

from mitsuba_diffraction import variants


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch):
    """Pretends that the machine has a GPU or not, a usable LLVM or not."""

    def pretend(*, gpu: bool, problem: str | None, backend: dr.JitBackend = dr.JitBackend.CUDA) -> None:
        monkeypatch.setattr(dr, "has_backend", lambda asked: gpu and asked == backend)
        monkeypatch.setattr(variants, "llvm_problem", lambda: problem)

    return pretend


@pytest.mark.parametrize("name", ["llvm_ad_spectral", "cuda_ad_spectral_polarized", "metal_ad_spectral"])
def test_spectral_variants_are_supported(name: str) -> None:
    assert variants.is_supported(name)


@pytest.mark.parametrize("name", ["scalar_rgb", "scalar_spectral", "llvm_ad_mono_polarized", "", None])
def test_other_variants_are_not_supported(name: str) -> None:
    assert not variants.is_supported(name)


def test_a_gpu_comes_first(machine) -> None:
    machine(gpu=True, problem="no LLVM")
    assert variants.choose_variant() == "cuda_ad_spectral"


def test_metal_comes_first_where_mitsuba_has_it(machine, monkeypatch: pytest.MonkeyPatch) -> None:
    machine(gpu=True, problem=None, backend=dr.JitBackend.Metal)
    assert variants.choose_variant() == "llvm_ad_spectral"
    monkeypatch.setattr(mi, "variants", lambda: ["llvm_ad_spectral", "metal_ad_spectral"])
    assert variants.choose_variant() == variants.choose_variant("metal_ad_spectral") == "metal_ad_spectral"
    machine(gpu=False, problem=None)
    with pytest.raises(RuntimeError, match=r"'metal_ad_spectral' needs a GPU of Apple"):
        variants.choose_variant("metal_ad_spectral")


@pytest.mark.parametrize(
    ("system", "words"),
    [
        (("Windows", "AMD64"), ("mitsuba_diffraction[llvm]", "LLVM's own installer", "LLVM-C.dll")),
        (("Darwin", "arm64"), ("mitsuba_diffraction[llvm]", "brew install llvm", "libLLVM.dylib")),
        (("Linux", "aarch64"), ("mitsuba_diffraction[llvm]", "libllvm19", "libLLVM.so")),
        (("Linux", "x86_64"), ("pip install karellen-llvm-core", "libllvm19")),
    ],
)
def test_without_llvm_the_message_names_that_of_the_system(monkeypatch, system, words) -> None:
    monkeypatch.setattr(dr, "has_backend", lambda backend: False)
    monkeypatch.setattr(variants, "_wheel_library", lambda: None)
    for name, value in zip(("system", "machine"), system, strict=True):
        monkeypatch.setattr(platform, name, lambda value=value: value)
    line = variants.llvm_problem()
    assert all(word in line for word in (*words, "DRJIT_LIBLLVM_PATH"))


@pytest.mark.parametrize("name", ["llvm/LLVM.dll", "x.libs/libLLVM-a6b168f6.so.21.1", "x.dylibs/l99c09c.dylib"])
def test_the_library_of_the_extra_is_found_under_each_of_its_names(monkeypatch, tmp_path, name: str) -> None:
    info = tmp_path / "llvm_nanobind-21.dist-info"
    info.mkdir()
    (info / "METADATA").write_text("Metadata-Version: 2.1\nName: llvm-nanobind\nVersion: 21\n")
    (info / "RECORD").write_text(f"llvm/__init__.abi3.so,,\nx.libs/libzstd-28866717.so.1.4.4,,\n{name},,\n")
    (tmp_path / name).parent.mkdir()
    (tmp_path / name).touch()  # newer versions of importlib.metadata list files that exist
    # In place of loading it, which the system of the wheel alone can do.
    monkeypatch.setattr(variants, "_library_version", lambda path: (21, 1, 6))
    monkeypatch.setattr(metadata, "distributions", functools.partial(metadata.distributions, path=[str(tmp_path)]))
    assert variants._wheel_library() == str(tmp_path / name)


def test_llvm_where_there_is_no_gpu(machine) -> None:
    machine(gpu=False, problem=None)
    assert variants.choose_variant() == "llvm_ad_spectral"


def test_without_gpu_and_llvm_the_message_says_what_to_install(machine) -> None:
    machine(gpu=False, problem="install this")
    with pytest.raises(RuntimeError, match="install this"):
        variants.choose_variant()


def test_the_requested_variant_is_chosen(machine) -> None:
    machine(gpu=False, problem=None)
    assert variants.choose_variant("llvm_ad_spectral_polarized") == "llvm_ad_spectral_polarized"


def test_a_requested_variant_that_cannot_run_is_refused(machine) -> None:
    machine(gpu=False, problem="install this")
    with pytest.raises(RuntimeError, match=r"'llvm_ad_spectral' cannot be used: install this"):
        variants.choose_variant("llvm_ad_spectral")
    with pytest.raises(RuntimeError, match=r"'cuda_ad_spectral' needs an NVIDIA GPU"):
        variants.choose_variant("cuda_ad_spectral")


@pytest.mark.parametrize(
    ("name", "reason"),
    [("llvm_ad_rgb", "is not spectral"), ("scalar_spectral", "is scalar"), ("spectral", "is unknown")],
)
def test_a_requested_variant_that_is_unknown_or_not_supported_is_refused(machine, name: str, reason: str) -> None:
    machine(gpu=True, problem=None)
    with pytest.raises(ValueError, match=rf"'{name}' {reason}; use one of .*llvm_ad_spectral"):
        variants.choose_variant(name)
