from __future__ import annotations

import drjit as dr
import pytest

from mitsuba_diffraction import variants


@pytest.fixture
def machine(monkeypatch: pytest.MonkeyPatch):
    """Pretends that the machine has a GPU or not, a usable LLVM or not."""

    def pretend(*, gpu: bool, problem: str | None) -> None:
        monkeypatch.setattr(dr, "has_backend", lambda backend: gpu and backend == dr.JitBackend.CUDA)
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
