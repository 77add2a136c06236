"""Drives into a map: the same bytes for any number of jobs and after any kill, and nothing done twice."""

from __future__ import annotations

import hashlib
import json
import multiprocessing
import os
import random
import shlex
import shutil
import signal
import subprocess
import sys
import time
from concurrent.futures import BrokenExecutor, Executor, Future
from concurrent.futures.process import BrokenProcessPool
from contextlib import suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast
from unittest.mock import Mock

import duckdb
import pytest

from tests.features.small_networks import corners
from tests.forked import VPLOG, Forked
from tests.joined import rewritten
from tests.maps.bucket import serving
from vplog.batch import batch, dry_run
from vplog.batch.batch import run_batch
from vplog.batch.engine import BatchOptions, LocalEngine, as_completed, open_engine
from vplog.batch.plan import DriveInput, PlannedDrive, absolute_log, common_record, name_of
from vplog.batch.worker import DriveState, Outcome, Task, compute_drive
from vplog.errors import LibraryError, LogError, ResultError, SettingsError
from vplog.execution.process_pool import OwnProcesses, ProcessExpired
from vplog.logs import TopicChoice
from vplog.maps.storage import map_store, objects
from vplog.maps.storage.layout import drive_names
from vplog.maps.storage.upload import send_run
from vplog.pipeline import Pipeline, load_pipeline
from vplog.places.vectors import VectorsSettings
from vplog.results.run_record import read_run_json, write_run_json
from vplog.run.reference_library import build_library
from vplog.storage.input_hashes import bytes_of
from vplog.storage.remote_path import RemotePath, located, send
from vplog.verbs.demo.record import IMAGE

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import Said
    from mcap.records import Message

    from vplog.verbs.demo.record import Demo

QUICK = (
    "features.max_features=200", "features.max_megapixels=0.03", "features.min_features=0", "library.size=6",
    "library.seed=1", "places.neighbours=8", "pictures.closures=0", "pictures.megapixels=0", "propose.per_query=1",
    "propose.gap_keyframes=15", "propose.gap_steps=15", "verify.calibration.pairs=0",
)  # fmt: skip
OPTIONS = [option for one in QUICK for option in ("--set", one)]


def files(root: Path) -> dict[str, tuple[int, str]]:
    """Inode and sha256 of every file that is not hidden, by name."""
    return {
        str(path.relative_to(root)): (path.stat().st_ino, hashlib.sha256(path.read_bytes()).hexdigest())
        for path in sorted(root.rglob("*"))
        if path.is_file() and not path.name.startswith(".")
    }


def tables(root: Path) -> dict[str, str]:
    return {name: digest for name, (_, digest) in files(root).items() if name.endswith(".parquet")}


@pytest.fixture(scope="module")
def logs(tiny_drives: list[Path]) -> list[Path]:
    return [folder / "drive.mcap" for folder in tiny_drives]


@pytest.fixture(scope="module")
def whole(compiled: None, logs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A map of both at once, one after the other."""
    root = tmp_path_factory.mktemp("whole") / "map"
    told = run_batch(logs, root, load_pipeline("default", QUICK))
    assert [(one["drive"], one["state"]) for one in told["drives"]] == [("drive", "computed"), ("drive-2", "computed")]
    return root


def refusing(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Drives that are to be computed, while none is."""
    asked: list[str] = []

    def refuse(_: LocalEngine, task: Task) -> Future[Outcome]:
        asked.append(task.drive)
        future: Future[Outcome] = Future()
        future.set_result(Outcome("not now"))
        return future

    monkeypatch.setattr(LocalEngine, "start", refuse)
    return asked


def test_duckdb_reads_every_table_by_drive(whole: Path) -> None:
    for name in map_store.TABLES:
        counted = f"select drive, count(*) from '{whole}/{name}/*/*.parquet' group by 1 order by 1"  # noqa: S608
        rows = duckdb.execute(counted).fetchall()
        assert [drive for drive, _ in rows] == ["drive", "drive-2"], name
        assert all(count > 0 for _, count in rows)
    own = duckdb.execute(
        f"select distinct drive from read_parquet('{whole}/keyframes/*/*.parquet', hive_partitioning = false)"  # noqa: S608
    ).fetchall()
    assert sorted(own) == [("drive",), ("drive-2",)]
    assert (whole / "closures/drive=drive/closures.parquet").samefile(whole / "runs/drive=drive/closures.parquet")


def test_a_map_grows_by_its_new_drives_alone(
    whole: Path,
    logs: list[Path],
    tmp_path: Path,
    verb: Callable[..., Said],
    monkeypatch: pytest.MonkeyPatch,
    request: pytest.FixtureRequest,
) -> None:
    """With two jobs in processes of their own, the library given, one drive after the other and a bad one between: the
    bytes of one batch."""
    monkeypatch.setattr(batch, "_FREE_BYTES", 0)  # however full the disk is
    [library] = (whole / "libraries").iterdir()
    root, bad = tmp_path / "map", tmp_path / "bad.mcap"
    bad.write_bytes(b"no log at all")
    verb("batch", logs[0], "-o", root, "--library", library, "--threads", 2, *OPTIONS)
    before = files(root)
    request.getfixturevalue("own_processes")
    said = verb("batch", *logs, bad, tmp_path / "gone.bag", "-o", root, "--jobs", 2, "--threads", 2, "--json", *OPTIONS)
    assert said.code == 1
    assert "2 of 4 drives failed" in said.err
    told = json.loads(said.out)
    assert [one["state"] for one in told["drives"]] == ["unchanged", "computed", "failed", "failed"]
    assert tables(root) == tables(whole)

    after = files(root)
    new = {name for name in after if after[name] != before.get(name)}
    assert {name for name in new if not name.startswith(("joint", "joins/states-"))} - {"failures.json"} == {
        name for name in after if "drive=drive-2/" in name
    }
    assert set(before) <= set(after)
    failures = read_run_json(root / "failures.json")
    assert list(failures) == ["bad", "gone"]
    assert "which no log does" in failures["bad"]["error"]

    assert verb("batch", *logs, "-o", root, "--json", *OPTIONS).json["failed"] == 0  # the bad ones are not given
    assert files(root) == after


def test_what_is_missing_or_changed_is_done_again(
    whole: Path, logs: list[Path], monkeypatch: pytest.MonkeyPatch
) -> None:
    pipeline = load_pipeline("default", QUICK)
    before = files(whole)
    asked = refusing(monkeypatch)
    (whole / "edges" / "drive=drive" / "edges.parquet").unlink()
    assert run_batch(logs, whole, pipeline)["failed"] == 0
    assert asked == []
    assert tables(whole) == {name: digest for name, (_, digest) in before.items() if name.endswith(".parquet")}

    assert run_batch(logs[::-1], whole, pipeline)["failed"] == 0, "in another order they keep their names"
    changed = load_pipeline("default", [*QUICK, "propose.per_query=2"])
    told = run_batch(logs[:1], whole, changed)
    assert [(one["state"], one["error"]) for one in told["drives"]] == [("failed", "not now")]
    assert asked == ["drive"]
    monkeypatch.setattr("vplog.maps.storage.layout.code_hash", lambda: "other code")
    assert run_batch(logs, whole, pipeline)["failed"] == 2
    assert asked[1:] == ["drive", "drive-2"]
    assert {**files(whole), "map.json": 0, "failures.json": 0}.keys() == {
        **before,
        "map.json": 0,
        "failures.json": 0,
    }.keys()
    monkeypatch.undo()
    assert run_batch(logs, whole, pipeline)["failed"] == 0
    assert read_run_json(whole / "failures.json") == {}


@pytest.mark.parametrize("damage", ["flip", "gone", "record", "report"])
def test_a_damaged_drive_is_computed_again_and_stops_no_other(
    whole: Path, logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: str
) -> None:
    """By the batch that has its log; another one names it and leaves it out."""
    root, pipeline = tmp_path / "map", load_pipeline("default", QUICK)
    shutil.copytree(whole, root, copy_function=shutil.copyfile)
    run = root / "runs" / "drive=drive-2"
    name = {"flip": "edges.parquet", "gone": "edges.parquet", "record": "drive.json", "report": "report.html"}[damage]
    data = bytearray((run / name).read_bytes())
    (run / name).unlink()
    if damage != "gone":
        data[len(data) // 3] ^= 4 if damage != "record" else 128
        (run / name).write_bytes(data)
    asked = refusing(monkeypatch)
    told = run_batch(logs[:1], root, pipeline)
    assert [(one["drive"], one["state"]) for one in told["drives"]] == [("drive", "unchanged")]
    said = [*told["warnings"], *(told["joined"] or {}).get("warnings", [])]
    if damage in ("gone", "record"):  # the other damages are found by who reads the file
        assert sum("drive-2 is damaged and left out" in line for line in said) == 1
    told = run_batch(logs, root, pipeline, options=BatchOptions(join=False))
    assert [(one["drive"], one["state"]) for one in told["drives"]] == [("drive", "unchanged"), ("drive-2", "failed")]
    assert asked == ["drive-2"]
    assert any("drive-2 is damaged and left out" in line for line in told["warnings"])


def test_the_folder_a_batch_is_called_in_is_not_read(
    whole: Path, logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """It may be a home with a million files, or one with a name that no record can hold."""
    (tmp_path / "\udcff").touch()
    monkeypatch.chdir(tmp_path)
    assert run_batch(logs, whole, load_pipeline("default", QUICK))["failed"] == 0


def test_new_vectors_in_the_same_file_are_another_input(tmp_path: Path) -> None:
    file = tmp_path / "vectors.npy"
    pipeline = Pipeline(places=VectorsSettings(file=str(file), model="salad"))
    records = [common_record(pipeline, None) for content in (b"1", b"2", b"1") if file.write_bytes(content)]
    assert records[0] == records[2] != records[1]


def test_another_library_or_writer_is_refused(whole: Path, logs: list[Path], tmp_path: Path) -> None:
    pipeline = load_pipeline("default", QUICK)
    before = files(whole)
    other = tmp_path / "other"
    build_library(logs[:1], other, pipeline)
    with pytest.raises(LibraryError, match="cannot be compared"):
        run_batch(logs, whole, pipeline, other)
    with pytest.raises(LibraryError, match=r"places\.references"):
        run_batch(logs, whole, load_pipeline("default", [*QUICK, "places.references=5"]))
    with map_store.writing(whole), pytest.raises(SettingsError, match="Another vplog process"):
        run_batch(logs, whole, pipeline)
    with pytest.raises(SettingsError, match="given twice"):
        run_batch([logs[0], logs[0]], whole, pipeline)
    (tmp_path / "thesis.txt").write_text("not a map")
    with pytest.raises(SettingsError, match=r"thesis.txt|other"):
        run_batch(logs, tmp_path, pipeline)
    assert files(whole) == before


def test_other_features_are_refused_before_the_map_has_their_settings(
    whole: Path, logs: list[Path], tmp_path: Path
) -> None:
    before, model = files(whole), corners(tmp_path, values=64)  # descriptors as long as those of SIFT
    settings = ("features.kind=onnx", f"features.model={model}", "places.neighbours=8")
    with pytest.raises(LibraryError, match=r"features\.kind=sift"):
        run_batch(logs[:1], whole, load_pipeline("default", settings))
    assert files(whole) == before


def test_a_killed_batch_leaves_finished_drives_and_goes_on(whole: Path, logs: list[Path], tmp_path: Path) -> None:
    """Killed while the first drive runs, then once it is in; what is there is whole, and the end is the same."""
    root, reference = tmp_path / "map", tables(whole)
    for until in (root / ".staging", root / "runs" / "drive=drive"):
        batch = Forked(VPLOG, "batch", *logs, "-o", root, "--jobs", 1, *OPTIONS)
        while batch.poll() is None and not until.exists():
            time.sleep(0.02)
        time.sleep(random.Random(until.name).uniform(0, 1))
        batch.send(signal.SIGKILL)
        batch.ended()
        finished = {folder.name for folder in root.glob("runs/*")}
        for name, digest in tables(root).items():
            assert ".staging" in name or digest == reference[name]
            assert ".staging" in name or "libraries" in name or name.split("/")[1] in finished
    assert run_batch(logs, root, load_pipeline("default", QUICK))["failed"] == 0
    assert tables(root) == reference
    assert not (root / ".staging").exists()


@dataclass
class Fated:
    """An engine whose drives end as they are told to, one outcome or error for each attempt."""

    fates: dict[str, list[Outcome | Exception]]
    begun: list[str] = field(default_factory=list)
    cores: int = 4
    max_cores: int = 4

    def concurrency(self, threads: int) -> int:
        return self.cores // threads

    def executor_for(self, threads: int) -> Executor | None:
        return None

    @property
    def executor(self) -> Executor | None:
        return None

    def start(self, task: Task) -> Future[Outcome]:
        self.begun.append(task.drive)
        future: Future[Outcome] = Future()
        fate = self.fates[task.drive].pop(0)
        future.set_exception(fate) if isinstance(fate, Exception) else future.set_result(fate)
        return future

    def fetch(self, task: Task, outcome: Outcome) -> None:
        if outcome.worker == "gone":
            raise BrokenExecutor("What it gave back was lost.")


def test_a_drive_is_tried_again_where_that_may_help_and_stops_no_other(tmp_path: Path) -> None:
    died, bad, good = BrokenExecutor("Its worker was killed."), Outcome("No such topic."), Outcome(worker="here")
    engine = Fated({
        "unlucky": [died, Outcome("Out of memory.", "memory"), good],
        "bad": [bad],
        "good": [good],
        "lost": [Outcome(worker="gone"), good],
        "offline": [Outcome("The server does not answer.", "network"), good],
        "slow": [Outcome("It took longer.", "time limit"), good],
        "hopeless": [died, died, died],
        "odd": [ValueError("what\nis this")],
    })  # fmt: skip
    topics, pipeline = TopicChoice(), load_pipeline("default")
    tasks = [Task(name, name, tmp_path, tmp_path, pipeline, topics, 1, {}) for name in engine.fates]
    told: list[DriveState] = []
    found = as_completed(cast("LocalEngine", engine), tasks, BatchOptions(2, on_drive=told.append))
    ended = {task.drive: (outcome.error, attempts) for task, outcome, attempts in found}
    assert ended == {
        "unlucky": ("", 3),
        "bad": ("No such topic.", 1),
        "good": ("", 1),
        "lost": ("", 2),
        "offline": ("", 2),
        "slow": ("It took longer.", 1),
        "hopeless": ("Its worker was killed.", 3),
        "odd": ("Internal error: ValueError: what is this.", 1),
    }
    assert set(engine.begun[:8]) == set(engine.fates), "each has its turn before one is tried again"
    states = [(one.state, one.attempts, one.fault) for one in told if one.drive == "unlucky"]
    assert states == [
        ("started", 1, ""), ("retried", 1, "worker"), ("started", 2, ""), ("retried", 2, "memory"), ("started", 3, ""),
    ]  # fmt: skip


@pytest.mark.parametrize(
    ("behind", "fault"), [(OSError("reset"), "network"), (FileNotFoundError(), "input"), (ValueError(), "input")]
)
def test_the_network_is_no_fault_of_a_log(
    behind: Exception, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def unreadable(*_: object) -> None:
        try:
            raise behind
        except type(behind):
            raise LogError("It cannot be read.") from None

    monkeypatch.setattr("vplog.logs.open", unreadable)
    for log, expected in (("s3://bucket/a.mcap", fault), ("/a.mcap", "input")):
        task = Task("a", log, tmp_path, tmp_path, load_pipeline("default"), TopicChoice(), 1, {})
        assert compute_drive(task).fault == expected


@pytest.mark.parametrize(("limit", "fault"), [({"time_s": 1e-4}, "time limit"), ({"memory_mb": 1.0}, "memory limit")])
def test_a_drive_over_its_limit_ends(
    limit: dict[str, float], fault: str, whole: Path, logs: list[Path], tmp_path: Path, own_processes: None
) -> None:
    [library] = (whole / "libraries").iterdir()
    pipeline = load_pipeline("default", QUICK)
    task = Task("a", str(logs[0]), tmp_path / "run", library, pipeline, TopicChoice(), 1, {}, **limit)  # pyrefly: ignore[bad-argument-type]
    with OwnProcesses(1) as processes:
        [(_, outcome, attempts)] = as_completed(LocalEngine(processes, 1), [task], BatchOptions())
    assert (outcome.fault, attempts) == (fault, 1)
    assert outcome.seconds > 0
    assert "--drive-" in outcome.error
    over_ray = BatchOptions(engine="ray", drive_timeout_s=1)
    with pytest.raises(SettingsError, match="for --engine local"), open_engine(over_ray, 1):
        pass


def test_workers_send_their_drives_to_a_store(
    whole: Path, logs: list[Path], own_processes: None, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The batch commits them, and no file of theirs passes through it."""
    [library], sent, send = (whole / "libraries").iterdir(), list[str](), objects.send
    monkeypatch.setattr(objects, "send", lambda path, source: (sent.append(str(path)), send(path, source))[1])
    with serving():
        root = located("s3://bucket/sent")
        told = run_batch(logs, root, load_pipeline("default", QUICK), library, options=BatchOptions(2, join=False))
        assert [one["state"] for one in told["drives"]] == ["computed", "computed"]
        with map_store.reading(root) as store:
            for drive in ("drive", "drive-2"):
                assert not store.damaged_files(drive)
                assert tables(store.run(drive)) == tables(whole / "runs" / f"drive={drive}")
    assert sent
    assert not [name for name in sent if "/runs/" in name]


@pytest.mark.parametrize("retries", [0, 1])
def test_a_finished_drive_is_committed_again(
    retries: int, halves: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The store takes the first commit, and its answer is lost."""
    made, put_if, lost = tmp_path / "made", objects.put_if, [OSError("reset")]
    shutil.copytree(halves / "runs/drive=before", made)

    def losing(path: RemotePath, data: bytes, version: Any) -> Any:
        found = put_if(path, data, version)
        if path.name == "map.json" and lost:
            raise lost.pop()
        return found

    monkeypatch.setattr(batch, "_PAUSE_S", 0.0)
    with serving():
        root = located("s3://bucket/map")
        with map_store.writing(root) as store:
            monkeypatch.setattr(objects, "put_if", losing)
            task = Task("before", "a.mcap", made, tmp_path, load_pipeline("default"), TopicChoice(), 1, {})
            sent = send_run(RemotePath("s3://bucket/map"), made, time.time())
            state = batch._publish(store, task, Outcome(sent=sent), 1, retries)
        assert (state.state, state.fault) == (("computed", "") if retries else ("failed", "network"))
        with map_store.reading(root) as store:
            assert list(store.drives()) == ["before"]
            assert not store.damaged_files("before")


def test_the_hashes_of_logs_outlast_the_scratch_folder_of_a_map_in_a_bucket() -> None:
    with serving():
        places = []
        for name in "aab":
            with map_store.writing(located(f"s3://bucket/{name}")) as store:
                places.append(batch._hashes_record(store))
        assert places[0] == places[1] != places[2]
        assert places[0].parent == Path(os.environ["VPLOG_CACHE"], "hashes")


def test_a_process_that_dies_takes_no_other_along(monkeypatch: pytest.MonkeyPatch, own_processes: None) -> None:
    with OwnProcesses(2) as processes:
        dying, living = processes.submit(signal.raise_signal, signal.SIGKILL), processes.submit(os.getpid)
        with pytest.raises(ProcessExpired):
            dying.result()
        assert living.result() != processes.submit(os.getpid).result() != os.getpid()
        outcome = computed_by(monkeypatch, processes, signal.raise_signal, signal.SIGKILL)
        assert outcome.error.startswith("Its process was killed")
        with monkeypatch.context() as patch:
            patch.setattr(OwnProcesses, "begin", Mock(side_effect=BrokenProcessPool()))
            assert computed_by(monkeypatch, processes, os.getpid).error.startswith("Its process was killed")
    slept: list[Future[None]] = []
    with pytest.raises(KeyboardInterrupt), OwnProcesses(1) as processes:
        slept += [processes.submit(time.sleep, 600) for _ in range(3)]
        raise KeyboardInterrupt
    assert not multiprocessing.active_children()


def computed_by(
    monkeypatch: pytest.MonkeyPatch, processes: OwnProcesses, function: Callable[..., Any], *args: Any
) -> Outcome:
    """How a batch takes a task of this function for its drive."""
    engine = LocalEngine(processes, 1)
    monkeypatch.setattr(engine, "start", lambda _: processes.submit(function, *args))
    task = Task("drive", "log", Path(), Path(), load_pipeline("default"), TopicChoice(), 1, {})
    [(_, outcome, _)] = as_completed(engine, [task], BatchOptions(1, retries=0))
    return outcome


def test_processes_that_are_begun_are_those_of_the_first_tasks_or_end(own_processes: None) -> None:
    with OwnProcesses(1) as processes:
        processes.begin()
        [ahead] = multiprocessing.active_children()
        assert processes.submit(os.getpid).result() == ahead.pid
        assert processes.submit(os.getpid).result() != ahead.pid
    assert not multiprocessing.active_children()
    with OwnProcesses(1) as processes:
        processes.begin()
        [ahead] = multiprocessing.active_children()
        os.kill(ahead.pid or 0, signal.SIGKILL)
        ahead.join()
        with suppress(BrokenExecutor, ProcessExpired):
            processes.submit(os.getpid).result()
        assert processes.submit(os.getpid).result() != os.getpid(), "others take its place"


def test_a_map_goes_on_with_its_own_settings(
    whole: Path, logs: list[Path], tmp_path: Path, verb: Callable[..., Said], monkeypatch: pytest.MonkeyPatch
) -> None:
    root = Path(shutil.copytree(whole, tmp_path / "map"))
    told = verb("batch", *logs, "-o", root, "--json").json
    assert [one["state"] for one in told["drives"]] == ["unchanged", "unchanged"]
    assert told["warnings"] == []
    refusing(monkeypatch)
    said = verb("batch", logs[0], "-o", root, "--set", "propose.per_query=2", "--json", "--no-join")
    assert said.code == 1
    assert json.loads((root / "map.json").read_text())["settings"]["propose"]["per_query"] == 2
    assert json.loads((root / "map.json").read_text())["settings"]["features"]["max_features"] == 200
    assert f"the first is {logs[1]}" in json.loads(said.out)["warnings"][0]


def test_logs_that_cannot_be_read_leave_the_settings_of_the_map(whole: Path, tmp_path: Path) -> None:
    root = Path(shutil.copytree(whole, tmp_path / "map"))
    before = (root / "map.json").read_bytes()
    done = run_batch([tmp_path / "gone.bag"], root, load_pipeline("default", [*QUICK, "propose.per_query=2"]))
    assert done["failed"] == 1
    assert (root / "map.json").read_bytes() == before


def test_a_log_that_cannot_be_asked_for_stops_no_other(
    whole: Path, logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, closed = Path(shutil.copytree(whole, tmp_path / "map")), tmp_path / "closed.mcap"
    is_dir = Path.is_dir

    def refused(path: Path) -> bool:
        if path == closed:
            raise PermissionError(13, "Permission denied", str(path))
        return is_dir(path)

    monkeypatch.setattr(Path, "is_dir", refused)
    told = run_batch([closed, *logs], root, load_pipeline("default", QUICK))
    assert [(one["drive"], one["state"]) for one in told["drives"]] == [
        ("closed", "failed"), ("drive", "unchanged"), ("drive-2", "unchanged"),
    ]  # fmt: skip
    assert str(closed) in told["drives"][0]["error"]


def test_a_log_without_a_sound_image_stops_no_library(logs: list[Path], tmp_path: Path) -> None:

    def black(topic: str, message: Message) -> bytes:
        data = message.data
        return data[:60] + bytes(len(data) - 60) if topic == IMAGE else data

    bad = rewritten(logs[0], tmp_path / "bad.mcap", black)
    told = run_batch([bad, logs[0]], tmp_path / "map", load_pipeline("default", QUICK))
    assert [(one["drive"], one["state"]) for one in told["drives"]] == [("bad", "failed"), (logs[0].stem, "computed")]


def test_a_moved_log_is_followed_and_a_copy_is_said(whole: Path, logs: list[Path], tmp_path: Path) -> None:
    """Joins and other libraries read it again. Nothing else of the drive changes."""
    root = Path(shutil.copytree(whole, tmp_path / "map"))
    moved = Path(shutil.copy2(logs[0], tmp_path / logs[0].name))
    before = tables(root)
    cut, again = tmp_path / "cut.mcap", tmp_path / "again.mcap"
    for bad in (cut, again):
        bad.write_bytes(logs[0].read_bytes()[:200])
    told = run_batch(
        [moved, logs[0], cut, again], root, load_pipeline("default", QUICK), options=BatchOptions(join=False)
    )
    assert (told["failed"], len(told["warnings"])) == (2, 1)
    told["drives"] = told["drives"][:2]
    # the path decides which is the known one, so the copy is another drive
    assert [(one["drive"], one["state"]) for one in told["drives"]] == [("drive-3", "computed"), ("drive", "unchanged")]
    assert "the same recording, byte for byte" in told["warnings"][0]
    alone = run_batch([moved], root, load_pipeline("default", QUICK), options=BatchOptions(join=False))
    assert "it is in the map as drive-3 and drive" in alone["warnings"][0], "of an earlier batch, too"
    told = run_batch([moved], Path(shutil.copytree(whole, tmp_path / "other")), load_pipeline("default", QUICK))
    assert [(one["drive"], one["state"]) for one in told["drives"]] == [("drive", "unchanged")]
    with map_store.reading(tmp_path / "other") as store:
        assert store.drives()["drive"]["log"] == str(moved)
    assert tables(tmp_path / "other") == before


def test_a_recording_at_the_place_of_another_is_said_to_replace_it(
    whole: Path, logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """As where each day is written over the one before; not where settings change, or a part of the drive is added."""

    def compute(_: LocalEngine, task: Task) -> Future[Outcome]:
        shutil.copytree(whole / "runs" / "drive=drive", task.folder)
        write_run_json(task.folder / "drive.json", task.record)
        future: Future[Outcome] = Future()
        future.set_result(Outcome(""))
        return future

    def batch_of(log: Path, *settings: str) -> list[str]:
        pipeline = load_pipeline("default", [*QUICK, *settings])
        told = run_batch([log], root, pipeline, options=BatchOptions(join=False))
        assert [(one["drive"], one["state"]) for one in told["drives"]] == [(log.stem, "computed")]
        return [warning for warning in told["warnings"] if "replaced" in warning]

    monkeypatch.setattr(LocalEngine, "start", compute)
    root, log, folder = Path(shutil.copytree(whole, tmp_path / "map")), tmp_path / "today.mcap", tmp_path / "bag"
    folder.mkdir()
    shutil.copy2(logs[0], log)
    shutil.copy2(logs[0], folder / "part_0.mcap")
    for place in (log, folder):
        assert batch_of(place) == []
        assert batch_of(place, "propose.per_query=2") == []
    shutil.copy2(logs[1], folder / "part_1.mcap")
    assert batch_of(folder) == []
    shutil.copy2(logs[1], log)
    [warning] = batch_of(log)
    assert warning.startswith(f"today is replaced: {log} is another file than before")


def test_a_replaced_object_is_said() -> None:
    """As latest.mcap of a bucket, which is written over every night."""
    name = "s3://bucket/latest.mcap"
    before, now = ({"latest.mcap": f"length {size}, time 1"} for size in (1, 2))
    told = [DriveState("latest", name, "computed")]
    assert name in batch._replaced_recordings(told, [now], {"latest": {"inputs": before}})[0]
    assert not batch._replaced_recordings(told, [now], {"latest": {"inputs": now}})


def test_cpu_hours_are_those_of_drives_that_were_computed_from_the_log() -> None:
    def of(*results: str) -> dict[str, Any]:
        stages = {f"stage {number}": {"result": result} for number, result in enumerate(results)}
        return {"totals": {"cpu_seconds": 10.0 * len(results)}, "counts": {"frames": 10}, "stages": stages}

    runs = {"whole": of("computed", "computed"), "resumed": of("reused", "computed")}
    store = Mock(drives=lambda: runs, figures=runs.__getitem__)
    assert dry_run._cpu_s_per_image(store) == (2.0, 1)


def test_bytes_of_a_bag_in_a_bucket_are_those_of_its_files(tmp_path: Path) -> None:
    (tmp_path / "part").write_bytes(bytes(10))
    with serving():
        for name in ("bag_0.mcap", "bag_1.mcap"):
            send(RemotePath(f"s3://bucket/bag/{name}"), tmp_path / "part")
        assert [bytes_of(located(f"s3://bucket/bag{name}"), remote=True) for name in ("", "/bag_0.mcap")] == [20, 10]


def test_a_file_of_metrics_that_cannot_be_written_is_said_first(tmp_path: Path, verb: Callable[..., Said]) -> None:
    said = verb("batch", tmp_path / "a.mcap", "-o", tmp_path / "map", "--metrics", tmp_path / "no" / "a.prom")
    assert "there is no folder" in said.error


def test_a_join_that_fails_takes_no_fates_along(
    whole: Path, logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, verb: Callable[..., Said]
) -> None:
    root, bad = Path(shutil.copytree(whole, tmp_path / "map")), tmp_path / "bad.mcap"
    bad.write_bytes(b"no log at all")

    def full(*_: object) -> None:
        raise ResultError("The disk is full.")

    monkeypatch.setattr(batch, "join_drives", full)
    said = verb("batch", *logs, "-o", root, *OPTIONS)
    assert (said.code, said.out.count("unchanged")) == (1, 2)
    assert said.err.splitlines()[-1] == (
        f"vplog: error: The drives are in {root}, but not joined: The disk is full. Then join them: "
        f"vplog map join {root}"
    )
    said = verb("batch", *logs, bad, "-o", root, *OPTIONS)
    assert said.code == 1
    assert "bad: failed, 0.0 s: " in said.err
    assert "1 of 3 drives failed" in said.err
    assert list(read_run_json(root / "failures.json")) == ["bad"]
    monkeypatch.setattr("vplog.maps.storage.layout.code_hash", lambda: "other code")
    found = run_batch([bad], root, load_pipeline("default", QUICK), options=BatchOptions(join=False))
    assert "Another version of vplog or its packages made 2 of the drives" in found["warnings"][0]


def test_what_was_found_stays_known_after_ctrl_c(
    whole: Path, logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    root, bad = Path(shutil.copytree(whole, tmp_path / "map")), tmp_path / "bad.mcap"
    bad.write_bytes(b"no log at all")

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(batch, "as_completed", interrupted)
    with pytest.raises(KeyboardInterrupt):
        run_batch([bad, *logs], root, load_pipeline("default", QUICK))
    assert list(read_run_json(root / "failures.json")) == ["bad"]


def test_a_manifest_names_tags_which_stay(
    whole: Path, logs: list[Path], tmp_path: Path, verb: Callable[..., Said]
) -> None:
    root, manifest = shutil.copytree(whole, tmp_path / "map"), tmp_path / "drives.csv"
    manifest.write_text(f"log,vehicle,truth\n{logs[0]},v1,t.tum\n{logs[1]},v2,\n")
    metrics = tmp_path / "batch.prom"
    for given in ([manifest], logs):
        done = verb("batch", *given, "-o", root, "--no-join", "--json", "--metrics", metrics, *OPTIONS).json
        assert f'vplog_batch_drives{{map="{root}",state="unchanged"}} 2\n' in metrics.read_text()
        assert [(one["drive"], one["state"]) for one in done["drives"]] == [
            ("drive", "unchanged"),
            ("drive-2", "unchanged"),
        ]
        record = read_run_json(root / "runs/drive=drive/drive.json")
        assert (record["tags"], record["truth"]) == ({"vehicle": "v1"}, str(tmp_path / "t.tum"))
        assert "vehicle=v2" in verb("map", "info", root).out


def test_a_dry_run_writes_nothing_and_reckons_by_the_drives_of_the_map(
    whole: Path, logs: list[Path], drive: Demo, tmp_path: Path, verb: Callable[..., Said]
) -> None:
    new, before = Path(shutil.copyfile(logs[0], tmp_path / "new.mcap")), files(whole)
    dry = (*logs, new, tmp_path / "gone.bag", "--dry-run", "--cost-per-cpu-hour", 3600, *OPTIONS)
    said = verb("batch", *dry, "-o", whole, "--json")
    assert (said.code, "1 of 4 drives would fail" in said.err) == (1, True)
    found = json.loads(said.out)
    assert files(whole) == before
    states = ["unchanged", "unchanged", "compute", "failed"]
    assert [one["state"] for one in found["drives"]] == states
    runs = [read_run_json(whole / f"runs/drive={drive}/run.json") for drive in ("drive", "drive-2")]
    cpu_s, images = sum(one["totals"]["cpu_seconds"] for one in runs), sum(one["counts"]["frames"] for one in runs)
    assert (found["compute"], found["bytes"], found["images"]) == (1, new.stat().st_size, runs[0]["counts"]["frames"])
    assert found["cpu_seconds_per_image"] == pytest.approx(cpu_s / images, abs=1e-3)
    assert found["cost"] == pytest.approx(cpu_s / images * found["images"], abs=0.02)
    other = verb("batch", logs[0], "--dry-run", "--odometry-file", drive.truth, "-o", whole, "--json", *OPTIONS).json
    assert other["compute"] == 1, "by a file that is not that of the map"
    root = Path(shutil.copytree(whole, tmp_path / "copy"))
    with map_store.writing(root) as store:
        map_store.annotate(store, "drive", {"log": str(new)})
    assert verb("batch", new, "--dry-run", "-o", root, "--json", *OPTIONS).json["compute"] == 1, "of another time"
    said = verb("batch", *dry, "-o", tmp_path / "map")
    assert (said.code, "3 of 4 drives to compute" in said.out, (tmp_path / "map").exists()) == (1, True, False)
    for option in (("--dry-run", "--metrics", tmp_path / "a.prom"), ("--cost-per-cpu-hour", 1)):
        assert "--dry-run" in verb("batch", *logs, "-o", whole, *option).error
    for name, more in (("report", ()), ("explain", ("--closure", 0)), ("ask", ())):
        assert "whose files stay as they are" in verb(name, whole / "runs" / "drive=drive", *more).error
    assert files(whole) == before
    assert "have topics of their own" in verb("evaluate", whole, "--truth", "gps", "--gps-topic", "/rtk").error


def test_a_dry_run_is_refused_as_its_batch(
    halves: Path, finished: Path, tmp_path: Path, verb: Callable[..., Said]
) -> None:
    (tmp_path / "decisions.csv").write_text("query,match,decision\n")
    for refused, why in (
        (("--library", finished / "library"), "they cannot be compared"),
        (("--set", f"decisions.file={tmp_path / 'decisions.csv'}"), "Decisions are for one drive at a time"),
        (("--set", "places.references=2"), "was made with places"),
    ):
        command = ("batch", halves.parent / "before.mcap", "-o", halves, "--set", "library.size=12", *refused)
        assert why in verb(*command, "--dry-run").error
        assert verb(*command).error == verb(*command, "--dry-run").error


def test_logs_that_are_refused_leave_no_map(whole: Path, tmp_path: Path, verb: Callable[..., Said]) -> None:
    [library] = (whole / "libraries").iterdir()
    for more in ([], ["--library", library]):
        assert "gone.bag" in verb("batch", tmp_path / "gone.bag", "-o", tmp_path / "map", *more, *OPTIONS).error
        assert not (tmp_path / "map").exists()


def test_one_odometry_file_is_of_one_drive(logs: list[Path], tmp_path: Path, verb: Callable[..., Said]) -> None:
    said = verb("batch", *logs, "-o", tmp_path / "map", "--odometry-file", tmp_path / "poses.tum")
    assert "2 logs are given. Give each drive its own" in said.error


@pytest.mark.parametrize(("bad", "closed", "code"), [(False, "| true", 0), (True, "2>&1 | true", 1)])
def test_the_exit_status_is_that_of_the_batch(
    whole: Path, logs: list[Path], tmp_path: Path, bad: bool, closed: str, code: int
) -> None:
    """Whoever reads what it prints, or does not."""
    root, given = shutil.copytree(whole, tmp_path / "map"), [*logs, *([tmp_path / "gone.bag"] if bad else [])]
    options = [*OPTIONS, "--no-join", "--threads", "1"]
    command = shlex.join([sys.executable, "-m", "vplog", "batch", *map(str, given), "-o", str(root), *options])
    done = subprocess.run(
        ["bash", "-c", f"{command} {closed}; exit ${{PIPESTATUS[0]}}"],
        capture_output=True, text=True, check=False, env=os.environ | {"PYTHONUNBUFFERED": ""},
    )  # fmt: skip
    assert (done.returncode, "Exception ignored" in done.stderr) == (code, False), done.stderr
    assert "Internal error" not in done.stderr
    failures = Path(root, "failures.json")
    assert bool(failures.exists() and read_run_json(failures)) == bad


def test_a_drive_is_called_as_its_folder_is(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "monday").mkdir()
    monkeypatch.chdir(tmp_path / "monday")
    found = (name_of(Path()), name_of(Path("../monday")), absolute_log(Path("../monday")))
    assert found == ("monday", "monday", str(tmp_path / "monday"))
    (tmp_path / "far" / "below").mkdir(parents=True)
    (tmp_path / "link").symlink_to("far/below")
    assert absolute_log(Path("../link/../a.mcap")) == str(tmp_path / "far" / "a.mcap"), "as the system reads it"
    assert (absolute_log(Path("../link")), name_of(Path("../link"))) == (str(tmp_path / "link"), "link")


def test_the_name_of_a_drive_that_failed_is_its_own(tmp_path: Path) -> None:
    (tmp_path / "a").mkdir()
    (tmp_path / "b").mkdir()
    with map_store.writing(tmp_path / "map") as store:
        store.update_failures({"run": {"log": str(tmp_path / "a" / "run.mcap"), "error": "bad"}})
    known = {drive: {"log": told["log"], "inputs": None} for drive, told in store.failures().items()}
    names = [str(tmp_path / folder / "run.mcap") for folder in "ba"]
    assert drive_names(["run", "run"], names, known, [{"run.mcap": "1"}, {"run.mcap": "2"}]) == ["run-2", "run"]


def test_engines_that_are_not_there_are_said(logs: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    pipeline = load_pipeline("default", QUICK)
    with pytest.raises(SettingsError, match="Engines: local, ray"):
        run_batch(logs, tmp_path / "map", pipeline, options=BatchOptions(engine="slurm"))
    with pytest.raises(SettingsError, match="Add --engine ray"):
        run_batch(logs, tmp_path / "map", pipeline, options=BatchOptions(address="10.0.0.1:6379"))
    monkeypatch.setitem(sys.modules, "ray", None)
    with pytest.raises(SettingsError, match="pip install ray"):
        run_batch(logs, tmp_path / "map", pipeline, options=BatchOptions(engine="ray"))


def test_the_longest_log_is_begun_first(tmp_path: Path) -> None:
    at = {name: tmp_path / name for name in ("short", "gone", "long", "same")}
    for name, size in (("short", 10), ("long", 30), ("same", 10)):
        at[name].write_bytes(bytes(size))
    like = Task("", "", tmp_path, tmp_path, load_pipeline("default"), TopicChoice(), 1, {})
    wanted = [PlannedDrive(DriveInput(path), {"drive": name}, "compute") for name, path in at.items()]
    with map_store.writing(tmp_path / "map") as store:
        found = batch._tasks(store, wanted, like, longest_first=True)
        assert [task.drive for task in found] == ["long", "short", "same", "gone"]
        assert [task.in_parts for task in found] == [True, False, False, False], "longer than all others together"
        assert [task.in_parts for task in batch._tasks(store, wanted[:2], like, True)] == [True, False]
        at["same"].write_bytes(bytes(20))
        assert not any(task.in_parts for task in batch._tasks(store, wanted, like, True))
        assert batch._tasks(store, wanted[1:2], like, True)[0].in_parts, "it has all machines for itself"
