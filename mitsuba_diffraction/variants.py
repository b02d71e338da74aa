"""The variants of Mitsuba that can render here, and a usable LLVM for those of Dr.Jit's CPU backend.

Dr.Jit loads libLLVM once, when it is imported: the library in ``DRJIT_LIBLLVM_PATH``, or else the newest of the system.
That may be missing or too old, without an error: with LLVM 15 and 16 the first kernel with ``dr.maximum`` or
``dr.clip`` aborts the process. :func:`choose_libllvm` therefore selects the library of an installed wheel unless the
variable already points to a suitable one; it must run before Dr.Jit is imported. On x86-64 Linux the wheel is
``karellen-llvm-core``, elsewhere that of the extra ``llvm``, of whose package, an experimental one, only the library
is used.
"""

from __future__ import annotations

import ctypes
import itertools
import os
import platform
import re
import warnings
from importlib import metadata
from pathlib import Path

from .errors import RequestError, pip_install

MINIMUM_VERSION = (17, 0, 0)
"""Oldest LLVM that compiles every kernel: 15 and 16 abort at ``fmaximum``, Dr.Jit itself refuses 14."""

_PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"
_WHEEL = "karellen-llvm-core"  # of x86-64 Linux, where the package requires it
_WHEELS = _WHEEL, "llvm-nanobind"
# Names of libLLVM in the wheels: of Linux, of Windows, and of macOS, where they are too long for what repairs wheels.
_LIBRARY = re.compile(r"libLLVM.*\.so.*|LLVM\.dll|l[0-9a-f]+\.dylib")
_SYSTEM_LLVM = {
    "Windows": "LLVM's own installer (LLVM-C.dll)",
    "Darwin": "`brew install llvm` (libLLVM.dylib)",
    "Linux": "a package of your distribution, such as libllvm19 (libLLVM.so)",
}
_GPUS = {"cuda": "an NVIDIA GPU with a recent driver", "metal": "a GPU of Apple"}
# The first wheel's libLLVM finds these through symbolic links that are only created at the next start of the
# interpreter, and never in a read-only environment. Loading them first, in this order, lets it find them by name.
_RUNTIME_LIBRARIES = ("libunwind.so.1", "libc++abi.so.1", "libc++.so.1")


def choose_libllvm() -> None:
    """Point ``DRJIT_LIBLLVM_PATH`` to the wheel's library unless it names a suitable one. Call before Dr.Jit loads."""
    given = os.environ.get(_PATH_VARIABLE)
    if given and _library_version(given) >= MINIMUM_VERSION:
        return
    if path := _wheel_library():
        if given and given != path:
            message = f"{_PATH_VARIABLE}={given!r} is not an LLVM {MINIMUM_VERSION[0]} or later; using {path!r}"
            warnings.warn(message, RuntimeWarning, stacklevel=2)
        os.environ[_PATH_VARIABLE] = path


def llvm_problem() -> str | None:
    """Return None if Dr.Jit has a suitable LLVM, otherwise one line with the problem and its remedy."""
    import drjit as dr

    version = tuple(dr.detail.llvm_version()) if dr.has_backend(dr.JitBackend.LLVM) else ()
    if version >= MINIMUM_VERSION:
        return None
    found = f"found {'.'.join(map(str, version))}" if version else "none found"
    if _wheel_library():
        advice = "import mitsuba_diffraction before mitsuba and drjit, which load LLVM only once"
    else:
        wheel = f"`pip install {_WHEEL}` (without --target, which omits the library)"
        if (platform.system(), platform.machine()) != ("Linux", "x86_64"):
            wheel = f"with Python 3.12 or later `{pip_install('llvm')}`"
        source = _SYSTEM_LLVM.get(platform.system(), "LLVM")
        advice = f"{wheel}, or {source}; {_PATH_VARIABLE} may hold the path of the library"
    return f"Dr.Jit's CPU backend needs LLVM {MINIMUM_VERSION[0]} or later ({found}): {advice}"


def _load(path: str | Path) -> ctypes.CDLL | None:
    try:
        return ctypes.CDLL(str(path))
    except OSError:
        return None


def _library_version(path: str | Path) -> tuple[int, ...]:
    """Return the version of the libLLVM at ``path``, () if it does not load or is older than LLVM 16."""
    library = _load(path)
    if library is None or not hasattr(library, "LLVMGetVersion"):
        return ()
    numbers = [ctypes.c_uint() for _ in range(3)]
    library.LLVMGetVersion(*map(ctypes.byref, numbers))
    return tuple(number.value for number in numbers)


def _wheel_library() -> str | None:
    """Return the path of a wheel's libLLVM if it loads, or None."""
    for distribution in itertools.chain.from_iterable(metadata.distributions(name=name) for name in _WHEELS):
        files = [
            Path(file.locate()).resolve()
            for file in distribution.files or ()
            if file.name.startswith(_RUNTIME_LIBRARIES) or _LIBRARY.fullmatch(file.name)
        ]
        for name in _RUNTIME_LIBRARIES:
            for file in files:
                if file.name.startswith(name):
                    _load(file)
        for file in files:
            if _LIBRARY.fullmatch(file.name) and _library_version(file) >= MINIMUM_VERSION:
                return str(file)
    return None


def is_supported(name: str | None) -> bool:
    """Return whether a variant is spectral and compiles kernels: ``llvm_ad_spectral``, ``cuda_ad_spectral_polarized``.

    Scalar variants would run the plugin's Python code for each sample, a thousand times slower.
    """
    parts = (name or "").split("_")
    return "spectral" in parts and "scalar" not in parts


def choose_variant(requested: str | None = None) -> str:
    """Choose the variant to render with: the requested one, or that of a GPU (CUDA, Metal), else LLVM's.

    Raises:
        ValueError: ``requested`` is not a spectral variant, or a scalar one.
        RuntimeError: the variant cannot run on this machine; the message names what to install.
    """
    import drjit as dr
    import mitsuba as mi

    available = [name for name in mi.variants() if is_supported(name)]
    backends = {"cuda": dr.JitBackend.CUDA, "metal": dr.JitBackend.Metal}
    gpus = [name for name, backend in backends.items() if dr.has_backend(backend)]
    if requested is None:
        for gpu in gpus:
            if f"{gpu}_ad_spectral" in available:
                return f"{gpu}_ad_spectral"
        if message := llvm_problem():
            raise RuntimeError(message)
        return "llvm_ad_spectral"

    if requested not in available:
        reason = "is unknown"
        if requested in mi.variants():
            reason = "is scalar" if "spectral" in requested else "is not spectral"
        raise RequestError(f"variant {requested!r} {reason}; use one of {', '.join(available)}")
    kind = requested.partition("_")[0]
    if kind in _GPUS and kind not in gpus:
        raise RuntimeError(f"variant {requested!r} needs {_GPUS[kind]}, and Dr.Jit found none")
    if kind == "llvm" and (message := llvm_problem()):
        raise RuntimeError(f"variant {requested!r} cannot be used: {message}")
    return requested


def use_threads(count: int) -> None:
    """Let Dr.Jit use so many threads, two at least: with one, Mitsuba 3.9.1 hangs when it reads or writes an EXR."""
    import drjit as dr

    if (count := max(2, count)) != dr.thread_count():
        dr.set_thread_count(count)
