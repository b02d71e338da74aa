"""Progress of long work, in a log, a terminal and a notebook."""

import functools
import io
import math
import re
import time
from types import SimpleNamespace

import mitsuba as mi
import nbformat
import pytest
from nbclient import NotebookClient
from rich.console import Console

import mitsuba_diffraction as md
from mitsuba_diffraction import progress
from mitsuba_diffraction.settings import ScalarSettings

RUBBED = {"profile": "xenopeltis_synthetic", "size": 5.0, "patches": 3}


@pytest.mark.slow
def test_a_log_reports_in_one_line_that_a_spectrum_is_computed(llvm, capfd, monkeypatch):
    """From Python a skin took half a minute without a word."""
    monkeypatch.setattr(progress, "log_lines", functools.partial(progress.log_lines, first=0, seconds=math.inf))
    for _ in range(2):  # the second time it is read from the cache
        mi.load_dict({"type": "diffraction_grating", "profile": "lamellar", "period": 3.1, "depth": 0.1})
    out, err = capfd.readouterr()
    assert out == ""
    assert re.fullmatch(r"mitsuba-diffraction: spectrum of lamellar: \d+ %, powers, 0 s\n", err)


def test_progress_begins_with_the_heights_and_never_decreases():
    reports = []
    md.Recipe(RUBBED, ScalarSettings(coherence_length=3.0, tolerance=0.05)).build(
        lambda *numbers: reports.append(numbers)
    )
    done, total = zip(*reports, strict=True)
    assert set(total) == {100}
    assert list(done) == sorted(done)
    assert done[0] < 50  # the part of the heights
    assert done[-1] == 100


def test_a_terminal_shows_a_bar_below_another(monkeypatch):
    shown = io.StringIO()
    monkeypatch.setattr(progress, "err", Console(file=shown, force_terminal=True, width=100))
    with progress.progress_bar("scene.xml", "spp", "loading") as outer:
        with progress.progress_bar("spectrum of elaphe") as inner:
            inner(3, 7)
            progress._bars[0].refresh()
        outer(1, 64, 0.25)
        progress._bars[0].refresh()
    text = re.sub(r"\x1b\[[0-9;?]*[a-zA-Z]", "", shown.getvalue())
    for words in ("loading", "spectrum of elaphe", "3/7", "1/64 spp, error 0.25"):
        assert words in text
    assert not progress._bars


def test_a_log_says_what_is_done_before_anything_can_be_counted(capsys, monkeypatch):
    monkeypatch.setattr(progress, "MIN_REPORTED_SECONDS", 0.05)
    with progress.progress_bar("skin.toml", "%"), progress.stage("reading"):
        time.sleep(0.5)
    with progress.progress_bar("skin.toml", "%") as show:
        show(3, 100)
        capsys.readouterr()
        time.sleep(0.2)
    assert capsys.readouterr().err == ""
    with progress.progress_bar("skin.toml", "%"), progress.stage("reading"):
        time.sleep(0.5)
    assert capsys.readouterr().err == "mitsuba-diffraction: skin.toml: reading\n"


def test_a_log_says_early_how_long_the_rest_takes(capsys, monkeypatch):
    """Work that is resumed at 40 % after 20 s, and does 1 % a second: 60 s are left, not 30."""
    now = [0.0]
    monkeypatch.setattr(progress, "time", SimpleNamespace(monotonic=lambda: now[0]))
    show = progress.log_lines("spectrum", "%")
    for done in range(40, 101):
        now[0] = 20.0 + done - 40
        show(done, 100)
    assert capsys.readouterr().err.splitlines() == [
        "mitsuba-diffraction: spectrum: 40 %, 20 s",
        "mitsuba-diffraction: spectrum: 42 %, 22 s, about 58 s left",
        "mitsuba-diffraction: spectrum: 72 %, 52 s, about 28 s left",
    ]


@pytest.mark.parametrize(("seconds", "text"), [(0.2, "0 s"), (89, "89 s"), (150, "2 min"), (9000, "2.5 h")])
def test_a_time_is_written_in_its_unit(seconds, text):
    assert progress.time_text(seconds) == text


@pytest.mark.parametrize(
    ("count", "text"), [(1.4, "0.0 kB"), (950e3, "950 kB"), (4.93e6, "4.9 MB"), (100e6, "100 MB"), (2.13e9, "2.1 GB")]
)
def test_bytes_are_written_without_powers_of_ten(count, text):
    assert progress.bytes_text(count) == text


@pytest.mark.slow
def test_a_notebook_shows_a_line():
    source = """
from mitsuba_diffraction import progress
progress.MIN_REPORTED_SECONDS = 0
with progress.progress_bar("spectrum of elaphe") as show:
    show(3, 7)
"""
    notebook = nbformat.v4.new_notebook(cells=[nbformat.v4.new_code_cell(source)])
    NotebookClient(notebook, timeout=120).execute()
    (output,) = notebook.cells[0].outputs
    assert output["data"]["text/plain"] == "spectrum of elaphe: 0 s"


def test_long_commands_print_how_long_their_stages_took(capsys, monkeypatch):
    now = [100.0]
    monkeypatch.setattr(progress.time, "perf_counter", lambda: now[0])
    for inner in (2.0, 7.6):
        with progress.durations():
            now[0] += 1
            with progress.stage("powers"):
                now[0] += 1
                with progress.stage("heights"):
                    now[0] += inner
                now[0] += 0.5
    # The first took less than ten seconds. Inner stages do not count for outer ones.
    assert capsys.readouterr().out == "took 10.1 s: powers 1.5, heights 7.6, other 1.0\n"


def test_a_file_does_not_command_the_terminal(capsys):
    """Names, and the origin that a spectrum states, may hold escape sequences."""
    name = "\x1b]0;title\x07\x1b[31mred\x9b2J\r"
    progress.tell(name)
    progress.say("error", name)
    progress.show(progress.table(["a"], [[f"{name}[/b]"]]), width=80)
    shown = "".join(capsys.readouterr())
    assert not set(shown) & {"\x1b", "\x07", "\x9b", "\r"}
    assert shown.count(r"\x1b[31mred\x9b2J") == 3


def test_a_long_message_is_cut(capsys):
    progress.say("error", 3_000_000 * "x")
    assert len(capsys.readouterr().err) < 5000
