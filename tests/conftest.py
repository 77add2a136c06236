"""What many tests share: a small drive made on the spot, a finished run of it, the verbs, and the real drives."""

from __future__ import annotations

import json
import os
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import settings

from vplog.cli import main
from vplog.demo import SMALL, make_drive
from vplog.execution.execution import Execution
from vplog.pipeline import load_pipeline, run

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.demo.record import Drive

# a check of a change must not fail by the luck of the draw: the same inputs each time, and on
# `HYPOTHESIS_PROFILE=anew` others each time, for those who look for what is not yet known
settings.register_profile("same", derandomize=True, deadline=None)
settings.register_profile("anew", print_blob=True, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))

# servers of the tests are on this machine, whatever proxy there is
os.environ["NO_PROXY"] = os.environ["no_proxy"] = "127.0.0.1,localhost"

DURATIONS = Path(__file__).parent / "durations.json"
"""Seconds by test function, of those that `--record-durations` found to take more than `_NOTED_S`."""
_NOTED_S = 0.1
_SLOW_S = 0.25
"""From here on a test is `slow`: the others together take a minute on two cores."""


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--record-durations", action="store_true", help=f"write {DURATIONS.name}, for the mark `slow`")


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--record-durations"):
        config.pluginmanager.register(_Recorder())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark slow tests by their measured time. Files that take longest come first: each stays with one worker, and the
    others would wait for the last."""
    known: dict[str, float] = json.loads(DURATIONS.read_text(encoding="utf-8"))
    of_file: dict[str, float] = {}
    for name, seconds in known.items():
        file = name.partition("::")[0]
        of_file[file] = of_file.get(file, 0.0) + seconds
    for item in items:
        if known.get(item.nodeid.partition("[")[0], 0.0) > _SLOW_S:
            item.add_marker("slow")
    items.sort(key=lambda item: -of_file.get(item.nodeid.partition("::")[0], 0.0))


class _Recorder:
    """The longest case of every test function, with what its fixtures take."""

    def __init__(self) -> None:
        self.cases: dict[str, float] = {}

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        self.cases[report.nodeid] = self.cases.get(report.nodeid, 0.0) + report.duration

    def pytest_sessionfinish(self, session: pytest.Session) -> None:
        if hasattr(session.config, "workerinput"):
            return
        longest: dict[str, float] = {}
        for name, seconds in self.cases.items():
            function = name.partition("[")[0]
            longest[function] = max(longest.get(function, 0.0), round(seconds, 1))
        noted = {name: seconds for name, seconds in sorted(longest.items()) if seconds > _NOTED_S}
        DURATIONS.write_text(json.dumps(noted, indent=0) + "\n", encoding="utf-8")


@dataclass(frozen=True)
class Said:
    """How a verb ended and what it said."""

    code: int
    out: str
    err: str

    @property
    def json(self) -> dict[str, Any]:
        """The one JSON object on stdout; anything beside it fails the test."""
        assert self.code == 0, self.err
        value = json.loads(self.out)
        assert isinstance(value, dict)
        return value

    @property
    def error(self) -> str:
        """The one line of a known error: nothing on stdout, no traceback, and no fault of ours."""
        assert (self.code, self.out) == (1, "")
        lines = self.err.splitlines()
        assert len(lines) == 1, self.err
        assert lines[0].startswith("vplog: error: "), lines[0]
        assert "Internal error" not in lines[0]
        assert "Traceback" not in lines[0]
        return lines[0].removeprefix("vplog: error: ")


@pytest.fixture
def verb(capfd: pytest.CaptureFixture[str]) -> Callable[..., Said]:
    """Run a verb in this process; what native libraries print counts too."""

    def call(*arguments: object) -> Said:
        capfd.readouterr()
        with pytest.raises(SystemExit) as stop:
            main.main([str(argument) for argument in arguments])
        out, err = capfd.readouterr()
        assert isinstance(stop.value.code, int)
        return Said(stop.value.code, out, err)

    return call


@pytest.fixture(scope="session")
def drive(tmp_path_factory: pytest.TempPathFactory) -> Drive:
    """The small demo drive: about 45 frames, of which the last dozen pass known places."""
    return make_drive(tmp_path_factory.mktemp("drive"), SMALL)


@pytest.fixture(scope="session")
def finished(drive: Drive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a default run on the small drive, with two threads. Tests read it and leave it as it is."""
    out = tmp_path_factory.mktemp("finished") / "run"
    run(drive.log, out, load_pipeline("default"), execution=Execution(2))
    return out


@pytest.fixture(scope="session")
def joint(drive: Drive, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of a joint run of three drives, beside their logs. Tests read it and leave it as it is."""
    from tests.joined import run_together

    return run_together(drive, tmp_path_factory.mktemp("joint"))


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real data, which is not part of the project."""
    folder = Path(os.environ.get("VPLOG_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no folder {folder}: set VPLOG_DATA to the folder with the real drives")
    return folder
