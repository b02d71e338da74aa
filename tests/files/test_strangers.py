"""Files from strangers are read or refused in one line, within 10 s and 1 GB of memory: crafted ones, and mutants."""

import subprocess
import sys
from pathlib import Path

import pytest
import strangers
from test_instrument_files import needs_the_extra

MUTANTS = 500  # `python strangers.py NAME:2000` in this folder tries more
_OF_THE_EXTRA = {
    *("x3p", "x3p_text", "sur", "tmd", "nms", "ibw", "jpk", "jpk_archive", "park", "nanoscope", "nanoscope_text"),
    *("mdt", "datx", "opd", "vk4", "vk6", "zon", "zon_compressed", "h5_jpk"),
    *("os3d", "zmg", "plux", "lext", "oir", "poir"),
}
_SLOW_TO_MAKE = {"spectrum_rigorous", "spectrum_of_sample"}
_OURS = strangers.FORMATS.keys() - _OF_THE_EXTRA


def in_another_process(*names):
    command = [sys.executable, str(Path(strangers.__file__)), *names]
    done = subprocess.run(command, capture_output=True, text=True, timeout=3600)
    assert (done.returncode, done.stdout) == (0, ""), done.stderr[-2000:]


@pytest.mark.not_quick
@pytest.mark.posix("limits the memory of a process")
def test_crafted_files_are_refused():
    in_another_process(*strangers.CRAFTED)


@pytest.mark.slow
@pytest.mark.posix("limits the memory of a process")
@needs_the_extra
def test_files_that_unpack_to_gigabytes_are_refused():
    in_another_process(*strangers.SLOWLY_CRAFTED)


@pytest.mark.slow
@pytest.mark.posix("limits the memory of a process")
def test_large_files_are_read_within_the_limits():
    in_another_process(*strangers.LARGE)


@pytest.mark.filterwarnings("ignore")
@pytest.mark.parametrize("name", sorted(_OURS - _SLOW_TO_MAKE))
def test_some_mutants_are_read_or_refused(name, tmp_path):
    assert not list(strangers.faults_of_mutants(name, 5, tmp_path))


@pytest.mark.slow
@pytest.mark.posix("limits the memory of a process")
@pytest.mark.parametrize("names", [_OURS, pytest.param(_OF_THE_EXTRA, marks=needs_the_extra)], ids=["ours", "extra"])
def test_mutants_are_read_or_refused(names):
    in_another_process(*(f"{name}:{MUTANTS}" for name in sorted(names)))
