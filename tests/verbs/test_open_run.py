"""A run opens in the viewer that is there; where none is, its path is said."""

from __future__ import annotations

import subprocess
import sys
import webbrowser
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from vplog.cli.results import _VIEWERS
from vplog.verbs import open_run

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import Said

    Verb = Callable[..., Said]


@pytest.fixture
def started(monkeypatch: pytest.MonkeyPatch) -> list[Any]:
    """Commands and addresses that would be opened on a display; no Foxglove is installed."""
    found: list[Any] = []

    def start(command: tuple[str, ...], **_: Any) -> subprocess.CompletedProcess[str]:
        found.append((*command[:-1], Path(command[-1]).is_file()))
        return subprocess.CompletedProcess(command, 0)

    monkeypatch.setenv("DISPLAY", ":9")
    monkeypatch.setattr(webbrowser, "open", lambda address: found.append(address) or True)
    monkeypatch.setattr(open_run.subprocess, "run", start)
    monkeypatch.setattr(open_run.shutil, "which", lambda _: None)
    return found


def without_rerun(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(open_run.importlib.util, "find_spec", lambda _: None)


def test_rerun_opens_a_recording_that_is_there_as_long_as_its_window(
    verb: Verb, finished: Path, started: list[Any]
) -> None:
    pytest.importorskip("rerun")
    said = verb("open", finished, "--json").json
    assert (said["viewer"], said["opened"], said["run"]) == ("rerun", True, str(finished))
    assert started == [(sys.executable, "-m", "rerun_cli", True)]
    assert not Path(said["path"]).exists()


def test_without_rerun_the_report_opens_in_the_browser(
    verb: Verb, finished: Path, started: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    without_rerun(monkeypatch)
    assert verb("open", finished).out == f"{finished}: {finished}/report.html opens in the browser\n"
    assert started == [(finished / "report.html").as_uri()]


def test_where_nothing_opens_the_path_is_said(
    verb: Verb, finished: Path, started: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    without_rerun(monkeypatch)
    said = verb("open", finished, "--with", "foxglove")
    assert "foxglove is not installed" in said.out
    assert said.out.endswith(f"{finished}/result.mcap\n")
    assert "pip install rerun-sdk" in verb("open", finished, "--with", "rerun").out
    monkeypatch.delenv("DISPLAY")
    said = verb("open", finished, "--json").json
    assert (said["opened"], said["path"]) == (False, f"{finished}/report.html")
    assert not started


def test_a_viewer_that_does_not_start_is_one_line(
    verb: Verb, finished: Path, started: list[Any], monkeypatch: pytest.MonkeyPatch
) -> None:
    without_rerun(monkeypatch)
    monkeypatch.setattr(webbrowser, "open", lambda _: False)
    said = verb("open", finished)
    assert said.code == 1
    assert said.err == f"vplog: error: report did not open {finished}/report.html. Choose another with --with.\n"


def test_the_command_line_knows_every_viewer() -> None:
    assert _VIEWERS == open_run.VIEWERS
