"""What many tests share: a small drive made on the spot, a finished run of it, the verbs, and the real drives."""

from __future__ import annotations

import fcntl
import gc
import json
import os
import shutil
from concurrent.futures import Future
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest
from hypothesis import settings

from tests import durations
from tests.plain_install import make_environment
from tests.remembered import remember
from vplog.cli import main, progress
from vplog.execution.execution import Execution
from vplog.execution.process_pool import OwnProcesses
from vplog.pipeline import load_pipeline, run
from vplog.verbs.demo import SMALL, make_drive

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from vplog.verbs.demo.record import Demo

# a check of a change must not fail by the luck of the draw: the same inputs each time, and on
# `HYPOTHESIS_PROFILE=anew` others each time and twice as many, for those who look for what is not yet known
settings.register_profile("same", derandomize=True, deadline=None, max_examples=50)
settings.register_profile("anew", print_blob=True, deadline=None)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "same"))

# servers of the tests are on this machine, whatever proxy there is
os.environ["NO_PROXY"] = os.environ["no_proxy"] = "127.0.0.1,localhost"

TINY = SMALL.model_copy(update={"laps": 1.2, "frame_rate_hz": 1.5, "width": 320, "height": 180})


def pytest_addoption(parser: pytest.Parser) -> None:
    about = f"write {durations.FILE.name}, for the mark `slow`"
    parser.addoption("--record-durations", action="store_true", help=about)


def pytest_configure(config: pytest.Config) -> None:
    if config.getoption("--record-durations"):
        config.pluginmanager.register(durations.Recorder())


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Mark slow tests by their measured time. Files that take longest come first: each stays with one worker, and the
    others would wait for the last."""
    functions = durations.known()
    files = durations.by_file(functions)
    for item in items:
        if functions.get(item.nodeid.partition("[")[0], 0.0) > durations.SLOW_S:
            item.add_marker("slow")
    items.sort(key=lambda item: -files[item.nodeid.partition("::")[0]])


def pytest_collection_finish() -> None:
    """Modules and tests are no garbage: looking through them again and again takes a twelfth of all time."""
    gc.freeze()
    gc.set_threshold(50_000)


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


@pytest.fixture(scope="session", autouse=True)
def own_cache(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Tests keep out of the user's cache."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("VPLOG_CACHE", str(tmp_path_factory.mktemp("cache")))
        yield


@pytest.fixture(scope="session", autouse=True)
def quick() -> Iterator[None]:
    """No line a minute on stderr, however slow the machine, and no waiting for the disk."""
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(progress, "LINE_EVERY_S", 1e9)
        patch.setattr(os, "fsync", lambda _: None)
        yield


@pytest.fixture(scope="session", autouse=True)
def in_process() -> Iterator[pytest.MonkeyPatch]:
    """Drives of a batch are computed in the process of the test: a new one loads modules for seconds, to the same
    bytes. Tests of the processes themselves ask for `own_processes`."""

    def submit(_: OwnProcesses, function: Callable[..., Any], *args: Any) -> Future[Any]:
        future: Future[Any] = Future()
        future.set_result(function(*args))
        return future

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(OwnProcesses, "submit", submit)
        yield patch


@pytest.fixture
def own_processes(in_process: pytest.MonkeyPatch) -> Iterator[None]:
    """Drives of a batch are computed in processes of their own, as users have it."""
    instead = OwnProcesses.submit
    in_process.undo()
    yield
    in_process.setattr(OwnProcesses, "submit", instead)


@pytest.fixture(scope="session", autouse=True)
def remembered(shared_folder: Path) -> Iterator[pytest.MonkeyPatch]:
    """Features of a frame and the index of a library are computed once by all workers together."""
    (folder := shared_folder / "remembered").mkdir(exist_ok=True)
    with pytest.MonkeyPatch.context() as patch:
        remember(patch, folder)
        yield patch


@pytest.fixture
def computed_anew(remembered: pytest.MonkeyPatch, shared_folder: Path) -> Iterator[None]:
    """Features and indices are computed each time, as users have it."""
    remembered.undo()
    yield
    remember(remembered, shared_folder / "remembered")


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
def shared_folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The folder of all workers of this session, in which each has one of its own."""
    base = tmp_path_factory.getbasetemp()
    return base.parent if "PYTEST_XDIST_WORKER" in os.environ else base


@pytest.fixture(scope="session")
def made_once(shared_folder: Path) -> Callable[[str, Callable[[Path], object]], Path]:
    """A folder by its name, filled by the first process of the tests that asks for it; the others wait for that."""

    def made(name: str, fill: Callable[[Path], object]) -> Path:
        folder, filled = shared_folder / f"once-{name}", shared_folder / f"once-{name}.filled"
        with (shared_folder / f"once-{name}.lock").open("w") as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not filled.exists():
                shutil.rmtree(folder, ignore_errors=True)
                folder.mkdir()
                fill(folder)
                filled.touch()
        return folder

    return made


@pytest.fixture(scope="session")
def environment(made_once: Callable[..., Path]) -> Callable[..., Path]:
    """Return a virtual environment with the checkout and these requirements, and without any other package."""

    def installed(*requirements: str) -> Path:
        wanted = sorted({".", *requirements})
        name = "-".join(["environment", *wanted]).replace("/", "")
        return made_once(name, lambda folder: make_environment(folder, *wanted))

    return installed


@pytest.fixture(scope="session")
def drive(made_once: Callable[..., Path]) -> Demo:
    """The small demo drive: about 45 frames, of which the last dozen pass known places."""
    from vplog.verbs.demo.record import Demo
    from vplog.verbs.demo.scene import make_scene

    folder = made_once("drive", lambda folder: make_drive(folder, SMALL))
    return Demo(**vars(make_scene(SMALL)), log=folder / "drive.mcap", truth=folder / "truth.tum")


@pytest.fixture(scope="session")
def tiny_drives(made_once: Callable[..., Path]) -> list[Path]:
    """Folders of two drives of about 25 small frames each, of one name: drive.mcap and truth.tum."""

    def fill(folder: Path) -> None:
        for number, name in enumerate("ab"):
            make_drive(folder / name, TINY.model_copy(update={"seed": SMALL.seed + number}), Execution())

    made = made_once("tiny", fill)
    return [made / name for name in "ab"]


@pytest.fixture(scope="session")
def tiny(tiny_drives: list[Path]) -> Demo:
    """The first of the tiny drives, of which the last half dozen frames pass known places."""
    from vplog.verbs.demo.record import Demo
    from vplog.verbs.demo.scene import make_scene

    folder = tiny_drives[0]
    return Demo(**vars(make_scene(TINY)), log=folder / "drive.mcap", truth=folder / "truth.tum")


@pytest.fixture(scope="session")
def finished(drive: Demo, made_once: Callable[..., Path]) -> Path:
    """The folder of a default run on the small drive, with two threads. Tests read it and leave it as it is."""
    pipeline, execution = load_pipeline("default"), Execution(2)
    return made_once("finished", lambda folder: run(drive.log, folder / "run", pipeline, execution=execution)) / "run"


@pytest.fixture(scope="session")
def compiled(finished: Path) -> None:
    """The kernels of a run are compiled and on disk, before workers and their processes would each compile them."""


@pytest.fixture(scope="session")
def joint(drive: Demo, made_once: Callable[..., Path]) -> Path:
    """The folder of a joint run of three drives, beside their logs. Tests read it and leave it as it is."""
    from tests.joined import run_together

    return made_once("joint", lambda folder: run_together(drive, folder)) / "out"


@pytest.fixture(scope="session")
def halves(drive: Demo, made_once: Callable[..., Path]) -> Path:
    """A map of two halves of the small drive, joined, beside their logs. Tests leave it as it is, but for landmarks."""
    import vplog
    from tests.joined import copied

    def fill(folder: Path) -> None:
        middle = vplog.open_log(drive.log).stamps()[22]
        before = copied(drive.log, folder / "before.mcap", lambda topic, ns: topic == "/tf_static" or ns <= middle)
        after = copied(drive.log, folder / "after.mcap", lambda topic, ns: topic == "/tf_static" or ns > middle)
        done = vplog.batch([before, after], folder / "map", settings={"library.size": 12})
        assert done["failed"] == 0

    return made_once("halves", fill) / "map"


@pytest.fixture(scope="session")
def shared_data() -> Path:
    """The folder of real data, which is not part of the project."""
    folder = Path(os.environ.get("VPLOG_DATA", Path(__file__).parents[2] / "shared" / "data"))
    if not folder.is_dir():
        pytest.skip(f"no folder {folder}: set VPLOG_DATA to the folder with the real drives")
    return folder
