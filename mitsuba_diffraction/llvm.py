"""A usable LLVM for Dr.Jit's CPU backend.

Dr.Jit loads libLLVM when it is imported: the library that ``DRJIT_LIBLLVM_PATH`` names, else the newest of the system.
What the system has may be missing or too old, and Dr.Jit does not say so: with LLVM 15 and 16 the first kernel that
holds ``dr.maximum`` or ``dr.clip`` aborts the process. :func:`ensure` sees to it that Dr.Jit has an LLVM of at least
:data:`MINIMUM_VERSION`, taken where needed from the wheel ``karellen-llvm-core``. An LLVM that is recent enough stays.
"""

from __future__ import annotations

import ctypes
import mmap
import os
import platform
import struct
import sys
import warnings
from importlib import metadata
from pathlib import Path

MINIMUM_VERSION = (17, 0, 0)
"""Oldest LLVM that compiles every kernel: 15 and 16 stop at ``fmaximum``, Dr.Jit itself refuses 14."""

_PATH_VARIABLE = "DRJIT_LIBLLVM_PATH"
_WHEEL = "karellen-llvm-core"
# The wheel's libLLVM finds these through symbolic links that are only made at the next start of the interpreter, and
# never in a read-only environment. Loaded beforehand, in this order, they are found by their names instead.
_RUNTIME_LIBRARIES = ("libunwind.so.1", "libc++abi.so.1", "libc++.so.1")

# Dr.Jit exports its C++ functions under their mangled names.
_INIT = "_Z8jit_initj"
_SHUTDOWN = "_Z12jit_shutdowni"
_REGISTRY_BOUND = "_Z21jit_registry_id_boundPKcS0_"
_INIT_ATTEMPTED = b"_ZL24jitc_llvm_init_attempted"
_INIT_SUCCESS = b"_ZL22jitc_llvm_init_success"

# Kinds of Mitsuba objects that Dr.Jit keeps in its registry of instances.
_REGISTERED = (
    *("BSDF", "Emitter", "Film", "Integrator", "Medium", "Mesh", "PhaseFunction"),
    *("ReconstructionFilter", "Sampler", "Scene", "Sensor", "Shape", "Texture", "Volume"),
)

_obstacle: str | None = None


def ensure() -> None:
    """Puts a usable LLVM in force if there is one; never fails for want of one (see :func:`problem`).

    Dr.Jit not imported yet: ``DRJIT_LIBLLVM_PATH`` is set to the wheel's library, unless it already names a usable one,
    and Dr.Jit is imported. Dr.Jit imported already, with no LLVM or one too old: its backend is started again with the
    wheel's.

    Where Dr.Jit had no LLVM nothing is lost. Where it had one too old, CPU arrays survive, evaluated or not, and so do
    scalar scenes and the number of threads; kernels are compiled anew. Mitsuba objects of an ``llvm_*`` or ``cuda_*``
    variant and GPU arrays would not survive: while one is alive the old LLVM stays and :func:`problem` says so. Dr.Jit
    does not tell of two more things that are lost: functions recorded by ``dr.freeze``, and threads other than this one
    that have computed with the old LLVM, which crash when they compute again. Importing this package first avoids all.
    """
    global _obstacle
    _obstacle = None
    if "drjit" not in sys.modules:
        _choose_before_import()

    import drjit  # noqa: F401  (loads libLLVM)

    if not _usable(_version_in_force()):
        path = _wheel_library()
        _obstacle = _replace(path) if path else None


def problem() -> str | None:
    """Returns None when a usable LLVM is in force, else one line that says what is wrong and what to do."""
    version = _version_in_force()
    if _usable(version):
        return None
    found = f"found {_text(version)}" if version else "none found"
    if _obstacle:
        return f"Dr.Jit's CPU backend needs LLVM {MINIMUM_VERSION[0]} or later ({found}): {_obstacle}"
    advice = f"install LLVM {MINIMUM_VERSION[0]} or later, or set {_PATH_VARIABLE} to its libLLVM"
    if platform.system() == "Linux" and platform.machine() == "x86_64":
        advice = f"`pip install {_WHEEL}` (without --target, which leaves the library out), or {advice}"
    return f"Dr.Jit's CPU backend needs LLVM {MINIMUM_VERSION[0]} or later ({found}): {advice}"


def _text(version: tuple[int, ...]) -> str:
    return ".".join(str(number) for number in version)


def _usable(version: tuple[int, ...] | None) -> bool:
    return version is not None and version >= MINIMUM_VERSION


def _version_in_force() -> tuple[int, ...] | None:
    import drjit as dr

    return tuple(dr.detail.llvm_version()) if dr.has_backend(dr.JitBackend.LLVM) else None


def _load(path: str | Path) -> ctypes.CDLL | None:
    try:
        return ctypes.CDLL(str(path))
    except OSError:
        return None


def _library_version(path: str | Path) -> tuple[int, ...] | None:
    """Version of the libLLVM at ``path``, or None where it does not load or is older than LLVM 16."""
    library = _load(path)
    if library is None or not hasattr(library, "LLVMGetVersion"):
        return None
    numbers = [ctypes.c_uint() for _ in range(3)]
    library.LLVMGetVersion(*map(ctypes.byref, numbers))
    return tuple(number.value for number in numbers)


def _wheel_library() -> str | None:
    """Path of a libLLVM that the wheel has installed and that loads, or None."""
    for distribution in metadata.distributions(name=_WHEEL):
        files = [
            Path(file.locate()).resolve()
            for file in distribution.files or ()
            if file.name.startswith(("libLLVM", *_RUNTIME_LIBRARIES))
        ]
        for name in _RUNTIME_LIBRARIES:
            for file in files:
                if file.name.startswith(name):
                    _load(file)
        for file in files:
            if file.name.startswith("libLLVM") and _usable(_library_version(file)):
                return str(file)
    return None


def _choose_before_import() -> None:
    given = os.environ.get(_PATH_VARIABLE)
    if given and _usable(_library_version(given)):
        return
    if path := _wheel_library():
        _set_path(path)


def _set_path(path: str) -> None:
    """Names ``path`` to Dr.Jit; says so where the user had named another library."""
    given = os.environ.get(_PATH_VARIABLE)
    if given and given != path:
        message = f"{_PATH_VARIABLE}={given!r} does not give an LLVM {MINIMUM_VERSION[0]} or later; using {path!r}"
        warnings.warn(message, RuntimeWarning, stacklevel=4)
    os.environ[_PATH_VARIABLE] = path


def _replace(path: str) -> str | None:
    """Starts Dr.Jit's LLVM backend again with the library at ``path``; returns what stands in the way, if anything."""
    import drjit as dr

    advice = "import mitsuba_diffraction before mitsuba and drjit"
    library = next(Path(dr.__file__).parent.glob("libdrjit-core.*"), None)
    core = ctypes.CDLL(str(library)) if library else None
    if core is None or not all(hasattr(core, name) for name in (_INIT, _SHUTDOWN, _REGISTRY_BOUND)):
        return f"this Dr.Jit cannot change its LLVM once imported; {advice}"

    llvm = 1 << dr.JitBackend.LLVM.value
    others = [backend for backend in (dr.JitBackend.CUDA, dr.JitBackend.Metal) if dr.has_backend(backend)]
    threads = dr.thread_count()
    if dr.has_backend(dr.JitBackend.LLVM):
        if _instances_alive(core):
            return f"objects of a scene were loaded before it could be changed; {advice}, or before loading a scene"
        if _arrays_alive({backend.name for backend in others}):
            return f"arrays on the GPU were made before it could be changed; {advice}"
        _set_path(path)
        getattr(core, _SHUTDOWN)(ctypes.c_int(0))
    else:
        _set_path(path)
        _forget_failed_start(core, library)
    getattr(core, _INIT)(ctypes.c_uint32(llvm | sum(1 << backend.value for backend in others)))
    if dr.has_backend(dr.JitBackend.LLVM) and dr.thread_count() != threads:
        dr.set_thread_count(threads)
    return None if _usable(_version_in_force()) else f"Dr.Jit did not take {path!r}; {advice}"


def _instances_alive(core: ctypes.CDLL) -> bool:
    """Whether Mitsuba objects of a compiled variant exist; a shutdown would leave them dangling."""
    mitsuba = sys.modules.get("mitsuba")
    if mitsuba is None:
        return False
    bound = getattr(core, _REGISTRY_BOUND)
    variants = [variant for variant in mitsuba.variants() if not variant.startswith("scalar")]
    return any(bound(variant.encode(), kind.encode()) for variant in variants for kind in _REGISTERED)


def _arrays_alive(backends: set[str]) -> bool:
    """Whether Dr.Jit variables of one of the named backends exist."""
    import drjit as dr

    if not backends:
        return False
    rows = (line.split() for line in dr.whos(as_string=True).splitlines())
    return any(len(row) > 1 and row[0].isdigit() and row[1] in backends for row in rows)


def _forget_failed_start(core: ctypes.CDLL, library: Path) -> None:
    """Lets Dr.Jit look for LLVM again after it found none.

    Dr.Jit remembers in a static flag that it tried, and clears the flag only where it had found an LLVM. The flag has
    no exported name; it is found through the symbol table of the file, and left alone unless both it and its neighbour
    hold what a failed start leaves.
    """
    symbols = _elf_symbols(library, (_INIT.encode(), _INIT_ATTEMPTED, _INIT_SUCCESS))
    if len(symbols) < 3:
        return
    base = ctypes.cast(getattr(core, _INIT), ctypes.c_void_p).value - symbols[_INIT.encode()]
    attempted = ctypes.c_ubyte.from_address(base + symbols[_INIT_ATTEMPTED])
    success = ctypes.c_ubyte.from_address(base + symbols[_INIT_SUCCESS])
    if (attempted.value, success.value) == (1, 0):
        attempted.value = 0


def _elf_symbols(path: Path, wanted: tuple[bytes, ...]) -> dict[bytes, int]:
    """Addresses, relative to the base, of symbols of a 64-bit little-endian ELF file (suffixes ``.lto_priv`` aside)."""
    found: dict[bytes, int] = {}
    with open(path, "rb") as file, mmap.mmap(file.fileno(), 0, access=mmap.ACCESS_READ) as data:
        if data[:6] != b"\x7fELF\x02\x01":
            return found
        (table,) = struct.unpack_from("<Q", data, 0x28)
        size, count = struct.unpack_from("<HH", data, 0x3A)
        sections = [struct.unpack_from("<IIQQQQIIQQ", data, table + size * index) for index in range(count)]
        for _, kind, _, _, offset, length, link, _, _, _ in sections:
            if kind != 2:  # SHT_SYMTAB
                continue
            strings = sections[link][4]
            for name, _, _, section, value, _ in struct.iter_unpack("<IBBHQQ", data[offset : offset + length]):
                if section:
                    text = data[strings + name : data.find(b"\0", strings + name)].split(b".")[0]
                    if text in wanted:
                        found[text] = value
    return found
