"""The Mitsuba variant to render with: diffraction needs a spectral one."""

from __future__ import annotations

from . import llvm
from .errors import RequestError


def is_spectral(name: str) -> bool:
    """Whether a variant carries wavelengths, e.g. ``llvm_ad_spectral`` or ``scalar_spectral_polarized``."""
    return "spectral" in name.split("_")


def spectral_variants() -> list[str]:
    """The spectral variants of the installed Mitsuba."""
    import mitsuba as mi

    return [name for name in mi.variants() if is_spectral(name)]


def choose_variant(requested: str | None = None) -> str:
    """The variant to render with: the requested one, or the fastest that runs on this machine.

    Args:
        requested: a spectral variant, or None for ``cuda_ad_spectral`` with a GPU and ``llvm_ad_spectral`` without.

    Raises:
        ValueError: ``requested`` is not a spectral variant.
        RuntimeError: the variant cannot run on this machine; the message names what to install.
    """
    import drjit as dr

    available = spectral_variants()
    if requested is None:
        if "cuda_ad_spectral" in available and dr.has_backend(dr.JitBackend.CUDA):
            return "cuda_ad_spectral"
        if "llvm_ad_spectral" not in available:
            raise RuntimeError(
                f"this Mitsuba has neither cuda_ad_spectral nor llvm_ad_spectral, only {', '.join(available)}"
            )
        if message := llvm.problem():
            raise RuntimeError(f"{message}. `--variant scalar_spectral` works without it, much more slowly")
        return "llvm_ad_spectral"

    if requested not in available:
        import mitsuba as mi

        reason = "is not spectral" if requested in mi.variants() else "is unknown"
        raise RequestError(f"variant {requested!r} {reason}; use one of {', '.join(available)}")
    if requested.startswith("cuda") and not dr.has_backend(dr.JitBackend.CUDA):
        raise RuntimeError(f"variant {requested!r} needs an NVIDIA GPU with a recent driver, and Dr.Jit found none")
    if requested.startswith("llvm") and (message := llvm.problem()):
        raise RuntimeError(f"variant {requested!r} cannot be used: {message}")
    return requested
