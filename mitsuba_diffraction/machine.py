"""The memory and the cores that this process may use: those of the machine, within the limits of its container."""

from __future__ import annotations

import math
import os
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path, PurePosixPath

PROCESS, CONTROL_GROUPS = Path("/proc/self"), Path("/sys/fs/cgroup")
_MAX_THREADS = 8
_ARENA_BYTES = 2**26  # of the address space, which malloc of glibc takes for each thread when it first allocates


def available_memory() -> int | None:
    """Return the number of bytes that this process can allocate; None if unknown, as on systems other than Linux.

    It is the minimum of three: what the machine has available, swap included; what the control groups of the process
    leave, those of containers, Slurm and systemd, version 2 or 1, where pages of files that can be dropped count as
    free; and what the limit of its address space leaves (`ulimit -v`).
    """
    limits = [_memory_of_machine(), _address_space()]
    for folder in _control_groups("memory"):
        for limit, usage, droppable in (
            ("memory.max", "memory.current", "inactive_file"),
            ("memory.limit_in_bytes", "memory.usage_in_bytes", "total_inactive_file"),
        ):
            with suppress(OSError, ValueError):  # "max", or no file: no limit
                left = int((folder / limit).read_text("utf-8")) - int((folder / usage).read_text("utf-8"))
                limits.append(left + _entries(folder / "memory.stat").get(droppable, 0))
    return min((max(limit, 0) for limit in limits if limit is not None), default=None)


def allowed_cores() -> int:
    """Return the number of cores that this process may use: its affinity, and the quota of its control groups."""
    affinity = getattr(os, "sched_getaffinity", None)
    cores = len(affinity(0)) if affinity else os.cpu_count() or 1
    for folder in _control_groups("cpu"):
        for names in (("cpu.max",), ("cpu.cfs_quota_us", "cpu.cfs_period_us")):
            with suppress(OSError, ValueError):  # "max", or no file: no limit
                quota, period = map(int, " ".join((folder / name).read_text("utf-8") for name in names).split())
                if quota > 0:
                    cores = min(cores, max(1, math.ceil(quota / period)))
    return cores


def usable_cores() -> int:
    """Return the number of threads that compute at once: one for each allowed core, at most eight, for the memory."""
    return min(allowed_cores(), _MAX_THREADS)


def _memory_of_machine() -> int | None:
    entries = _entries(PROCESS.parent / "meminfo")
    return 1024 * (entries["MemAvailable"] + entries["SwapFree"]) if "MemAvailable" in entries else None


def _address_space() -> int | None:
    try:
        import resource
    except ImportError:  # Windows
        return None
    limit, _ = resource.getrlimit(resource.RLIMIT_AS)
    used = 1024 * _entries(PROCESS / "status").get("VmSize", 0) + _ARENA_BYTES * usable_cores()
    return None if limit == resource.RLIM_INFINITY else limit - used


@contextmanager
def at_most(number_of_bytes: int) -> Iterator[None]:
    """Let the block map so much more memory, on Linux: what a library in C allocates cannot be seen before."""
    used = _entries(PROCESS / "status").get("VmSize")
    if used is None:
        yield
        return
    import resource

    before = resource.getrlimit(resource.RLIMIT_AS)
    limit = 1024 * used + number_of_bytes
    if before[0] == resource.RLIM_INFINITY or limit < before[0]:
        resource.setrlimit(resource.RLIMIT_AS, (limit, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, before)


def _control_groups(controller: str) -> Iterator[Path]:
    """Yield the folders of the control groups of this process and of all groups around them."""
    lines: list[str] = []
    with suppress(OSError):
        lines = (PROCESS / "cgroup").read_text("utf-8").splitlines()
    for line in lines:
        number, controllers, path = line.split(":", 2)
        group = PurePosixPath(path.lstrip("/"))
        # Version 2 has a single hierarchy; beside those of version 1, it is mounted at `unified`.
        roots = [CONTROL_GROUPS, CONTROL_GROUPS / "unified"] if number == "0" else [CONTROL_GROUPS / controller]
        if number == "0" or controller in controllers.split(","):
            # Inside of a container, its own group may be the root, whatever its path outside.
            inner = [] if ".." in group.parts else [group, *group.parents]
            yield from (root / name for root in roots for name in dict.fromkeys([*inner, PurePosixPath(".")]))


def _entries(file: Path) -> dict[str, int]:
    """Return the lines `name number` or `name: number` of a file of the kernel, of which there may be none."""
    entries = {}
    with suppress(OSError):
        for line in file.read_text("utf-8").splitlines():
            name, *values = line.replace(":", " ").split() or [""]
            if values and values[0].isdigit():
                entries[name] = int(values[0])
    return entries
