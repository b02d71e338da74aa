"""The memory and the cores of this process: made-up files of the kernel, and real limits."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

from mitsuba_diffraction import machine
from mitsuba_diffraction.machine import allowed_cores, available_memory, usable_cores

GB = 10**9
UNLIMITED = "9223372036854771712"
GROUPS = "sys/fs/cgroup"


@pytest.fixture
def kernel(tmp_path, monkeypatch):
    """kernel(files): a system with these files under / and 8 GB of memory, without other limits."""
    monkeypatch.setattr(machine, "PROCESS", tmp_path / "proc" / "self")
    monkeypatch.setattr(machine, "CONTROL_GROUPS", tmp_path / GROUPS)
    monkeypatch.setattr(machine, "_address_space", lambda: None)
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(64)), raising=False)

    def write(files):
        for name, text in {"proc/meminfo": "MemAvailable: 7000000 kB\nSwapFree: 1000000 kB\n", **files}.items():
            (tmp_path / name).parent.mkdir(parents=True, exist_ok=True)
            (tmp_path / name).write_text(text)

    return write


def of_memory(group, limit, usage, stat=""):
    """Files of a group of version 2."""
    folder = f"{GROUPS}/{group}"
    return {f"{folder}/memory.max": limit, f"{folder}/memory.current": usage, f"{folder}/memory.stat": stat}


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("", {}, 8.192),
        # In a container, its own group is the root.
        ("0::/\n", of_memory("", "3000000000\n", "1000000000\n"), 2),
        ("0::/\n", of_memory("", "max\n", "1000000000\n"), 8.192),
        # Pages of files can be dropped.
        ("0::/\n", of_memory("", "3000000000", "2500000000", "anon 1\ninactive_file 500000000\n"), 1),
        # The minimum over a group and those around it, of which one uses more than is allowed.
        ("0::/a/b\n", of_memory("a/b", "max", "1") | of_memory("a", "5000000000", "6000000000"), 0),
        # Version 1, of a group that is not visible under its outer path.
        (
            "3:memory:/docker/abc\n0::/../x\n",
            {
                f"{GROUPS}/memory/memory.limit_in_bytes": "600000000\n",
                f"{GROUPS}/memory/memory.usage_in_bytes": "200000000\n",
                f"{GROUPS}/memory/memory.stat": "cache 7\ntotal_inactive_file 100000000\n",
            },
            0.5,
        ),
        (
            "3:memory:/a\n",
            {f"{GROUPS}/memory/a/memory.limit_in_bytes": UNLIMITED, f"{GROUPS}/memory/a/memory.usage_in_bytes": "9"},
            8.192,
        ),
    ],
)
def test_the_available_memory_is_the_least_of_all_limits(kernel, own, files, expected):
    kernel({"proc/self/cgroup": own, **files})
    assert available_memory() == expected * GB


@pytest.mark.parametrize(
    ("own", "files", "expected"),
    [
        ("", {}, 64),
        ("0::/a\n", {"a/cpu.max": "150000 100000\n"}, 2),
        ("0::/a\n", {"a/cpu.max": "max 100000\n", "cpu.max": "5000 100000"}, 1),
        ("1:cpu,cpuacct:/\n", {"cpu/cpu.cfs_quota_us": "400000\n", "cpu/cpu.cfs_period_us": "100000\n"}, 4),
        ("1:cpu:/\n", {"cpu/cpu.cfs_quota_us": "-1\n", "cpu/cpu.cfs_period_us": "100000\n"}, 64),
    ],
)
def test_cores_follow_affinity_and_quota(kernel, own, files, expected):
    kernel({"proc/self/cgroup": own, **{f"{GROUPS}/{name}": text for name, text in files.items()}})
    assert allowed_cores() == expected
    assert usable_cores() == min(expected, 8)


@pytest.mark.skipif(not Path("/proc/meminfo").exists(), reason="Linux alone reports it")
def test_the_available_memory_is_at_most_that_of_the_system():
    pages = os.sysconf("SC_AVPHYS_PAGES") * os.sysconf("SC_PAGE_SIZE")
    assert machine._memory_of_machine() > 0.5 * pages
    assert 0 < available_memory() <= 1.1 * machine._memory_of_machine()


@pytest.mark.posix("ulimit")
def test_the_limit_of_address_space_counts():
    program = "from mitsuba_diffraction.machine import available_memory; print(available_memory())"
    limited = f"ulimit -v 1000000; exec {sys.executable} -c '{program}'"
    found = int(subprocess.run(["sh", "-c", limited], capture_output=True, check=True, text=True).stdout)
    limit = 1.024 * GB - machine._ARENA_BYTES * usable_cores()
    assert limit - 0.3 * GB < found < limit


@pytest.mark.slow
@pytest.mark.posix("ulimit")
@pytest.mark.parametrize("megabytes", [400, 500, 600, 700, 800, 900, 1000, 1100, 1200, 1500])
def test_a_picture_fits_into_the_address_space_or_is_refused_in_one_line(megabytes, tmp_path):
    scene = Path(__file__).parents[1] / "scenes" / "blaze.xml"
    line = f"render {scene} --width 512 --spp 16 --no-denoise -o {tmp_path}/out.exr"
    limited = f"ulimit -v {megabytes}000; exec {sys.executable} -m mitsuba_diffraction {line}"
    done = subprocess.run(["sh", "-c", limited], capture_output=True, text=True)
    # Between, the threads that have allocated so far decide, and whether kernels were compiled.
    assert done.returncode in ({2} if megabytes < 1000 else {0} if megabytes > 1200 else {0, 2}), done.stderr
    refusals = ("error: memory: got", "error: film: got")
    assert (tmp_path / "out.exr").exists() or any(refusal in done.stderr.splitlines()[-1] for refusal in refusals)
