"""A run folder is of one log: another's run is refused, and an interrupted one leaves the run before as it was."""

from __future__ import annotations

import json
import os
import random
import shlex
import shutil
import signal
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests.cli.test_main import no_images, no_messages, no_odometry, wrong_magic
from tests.forked import VPLOG, Forked
from tests.verbs.test_resume import OPTIONS, QUICK
from vplog.cli import main, parser
from vplog.errors import LogError, ResultError, SettingsError
from vplog.logs import TopicChoice
from vplog.pipeline import Pipeline, load_pipeline
from vplog.results.run_record import command_of, read_finished_run, write_run_json
from vplog.run import provenance, run_folder
from vplog.run.reference_library import build_library
from vplog.run.run_folder import CacheOptions, staged_run
from vplog.storage.folders import numbered
from vplog.storage.remote_path import RemotePath
from vplog.verbs.export import export

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import Said

    from vplog.verbs.demo.record import Demo

    Verb = Callable[..., Said]


def tree(out: Path) -> dict[str, bytes]:
    """All in a folder but what is kept for resuming."""
    names = [path.relative_to(out) for path in out.rglob("*") if path.is_file()]
    return {name.as_posix(): (out / name).read_bytes() for name in names if name.parts[0] != ".cache"}


def complete(out: Path, logs: Path | list[Path], force: bool = False, joint: bool = False, stage: bool = False) -> None:
    """A run that has nothing but its account."""
    paths = logs if isinstance(logs, list) else [logs]
    drives: dict[str, Any] = {path.stem: path for path in paths} if joint else {}
    asked = provenance.head(Pipeline(), paths[0] if joint else paths, 1)
    if joint:
        asked |= run_folder.provenance.logs_of(paths)
    with staged_run(out, asked, paths, drives=drives, cache=CacheOptions(force=force)) as made:
        for name, one in {**drives, **({} if joint else {"": paths})}.items():
            if name:
                complete(made / name, one)
            else:
                write(made, one)
        if joint:
            account = {**asked, "finished": True}
            (made / "run.json").write_text(json.dumps({**account, "drives": [{"folder": name} for name in drives]}))
        if stage:
            (out / ".cache" / "extract-0.stage").write_text("a result")
            raise KeyboardInterrupt


def write(made: Path, paths: list[Path]) -> None:
    account = {**provenance.head(Pipeline(), paths, 1), "finished": True, "inputs": run_folder.hash_inputs(paths)}
    (made / "run.json").write_text(json.dumps(account))


@pytest.fixture
def log(tmp_path: Path) -> Path:
    return written(tmp_path / "a.mcap", b"one log")


@pytest.fixture
def other(tmp_path: Path) -> Path:
    return written(tmp_path / "b.mcap", b"another log")


def written(path: Path, data: bytes) -> Path:
    path.write_bytes(data)
    return path


def refused(out: Path, logs: Path | list[Path], why: str, joint: bool = False) -> None:
    before = tree(out)
    with pytest.raises(SettingsError, match=why):
        complete(out, logs, joint=joint)
    assert tree(out) == before


def test_the_run_of_another_log_is_refused(log: Path, other: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    complete(out, log)
    refused(out, other, f"{out} is the run of {log}.*another folder with -o.*--force")
    alike = written(tmp_path / "c.mcap", b"two log")
    refused(out, alike, "another log")
    complete(out, other, force=True)
    assert read_finished_run(out)["log"] == str(other)


def test_a_run_is_not_written_into_its_log(tmp_path: Path) -> None:
    """The log would be another one by it: nothing could be cached or gone on with."""
    folder = tmp_path / "drive"
    folder.mkdir()
    for out in (folder, folder / "out", folder / "image_0" / "out"):
        with pytest.raises(SettingsError, match="is within the log"):
            complete(out, folder)
    complete(tmp_path / "drive-out", folder)


def test_a_log_on_an_object_store_may_be_a_folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(RemotePath, "is_dir", lambda _: True)
    head: dict[str, Any] = {"settings": {}, "log": "s3://bucket/drive"}
    paths: list[Any] = [RemotePath("s3://bucket/drive")]
    with staged_run(tmp_path / "out", head, paths, cache=CacheOptions(force=True)) as made:
        (made / "run.json").write_text("{}")
    assert (tmp_path / "out" / "run.json").is_file()


def test_the_same_log_is_known(log: Path, other: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """By path, length and times without reading it; moved, copied or touched by its content."""
    out, counted = tmp_path / "out", list[object]()
    complete(out, log)
    original = run_folder.hash_inputs
    monkeypatch.setattr(run_folder, "hash_inputs", lambda paths: counted.append(paths) or original(paths))
    run_folder._check_same_logs(out, [log])
    with pytest.raises(SettingsError):
        run_folder._check_same_logs(out, [other])
    assert not counted, "lengths tell"
    moved = tmp_path / "sub" / "moved.mcap"
    moved.parent.mkdir()
    shutil.copyfile(log, moved)
    run_folder._check_same_logs(out, [moved])
    os.utime(log)
    run_folder._check_same_logs(out, [log])
    log.rename(tmp_path / "renamed.mcap")
    run_folder._check_same_logs(out, [tmp_path / "renamed.mcap"])
    assert len(counted) == 3
    written(log, b"new log")
    refused(out, log, "another log, or has changed since")
    written(log, b"a longer log")
    refused(out, log, "another log, or has changed since")


def test_runs_of_several_drives_hold_all_drives_of_the_run_before(log: Path, other: Path, tmp_path: Path) -> None:
    """Drives may come, in any order; none goes without --force, and with it what it had goes."""
    out, third = tmp_path / "out", written(tmp_path / "c.mcap", b"a third log")
    complete(out, [log, other], joint=True)
    (out / "b" / "notes.txt").write_text("mine")
    (out / ".cache" / "b").mkdir(parents=True)
    (out / ".cache" / "b" / "extract-0.stage").write_text("kept")
    complete(out, [third, other, log], joint=True)
    assert {path.name for path in out.iterdir() if path.is_dir()} == {"a", "b", "c", ".cache"}
    refused(out, [log, third], f"the run of {other}", joint=True)
    refused(out, log, "is another log")
    complete(out, [log, third], joint=True, force=True)
    assert tree(out).keys() == {"run.json", "a/run.json", "c/run.json", "b/notes.txt"}
    assert not (out / ".cache").exists()
    complete(out, log, force=True)
    assert tree(out).keys() == {"run.json", "b/notes.txt"}
    refused(out, [log, other], "is another log", joint=True)
    refused(out, [log, other], "is another log")
    complete(out, [log, other], force=True)
    complete(out, [other, log])
    refused(out, other, "another log")


@pytest.mark.parametrize("force", [False, True])
def test_a_drive_of_a_joint_run_or_of_a_map_is_not_replaced(
    force: bool, log: Path, other: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    complete(tmp_path / "out", [log, other], joint=True)
    drive = tmp_path / "map" / "runs" / "drive=a"
    complete(drive, log)
    written(drive / "drive.json", b"{}")
    before = tree(tmp_path)
    for folder in (tmp_path / "out" / "a", drive):
        monkeypatch.chdir(folder)
        for out in (folder, Path()):
            with pytest.raises(SettingsError, match=f"{out} is a drive of the run or map in {folder.parent}"):
                complete(out, log, force=force)
    assert tree(tmp_path) == before
    complete(tmp_path / "out" / "c", log, force=force)


def test_random_sets_of_logs(tmp_path: Path) -> None:
    """Refused if and only if the content of a log of the run before is not among those given."""
    chance = random.Random(7)
    for number in range(40):
        out = tmp_path / f"{number}"
        out.mkdir()
        paths = [written(out / f"{name}.mcap", bytes([chance.randint(0, 2)] * 3)) for name in "abcd"]
        before, now = ([path for path in paths if chance.random() < 0.5] or [paths[0]] for _ in range(2))
        complete(out / "run", before, joint=True)
        content = {path: path.read_bytes() for path in before}
        for path in before:
            if chance.random() < 0.3:
                written(path, bytes([chance.randint(0, 2)] * 3))
        given = [path.read_bytes() for path in now]
        lost = [
            path for path, data in content.items()
            if (path.read_bytes() != data if path in now else data not in given)
        ]  # fmt: skip
        if lost:
            refused(out / "run", now, "the run of", joint=True)
        else:
            complete(out / "run", now, joint=True)


def test_an_unfinished_run_of_another_log_is_not_dropped(log: Path, other: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    complete(out, log)
    before = tree(out)
    with pytest.raises(KeyboardInterrupt) as stopped:
        complete(out, other, force=True, stage=True)
    assert stopped.value.__notes__ == [
        f"0.0 MB of results of stages (extract) are kept in {out}/.cache. Go on with: vplog run --resume -o {out}"
    ]
    assert tree(out) == before
    assert read_finished_run(out)["log"] == str(log)
    refused(out, log, f"{out} keeps an unfinished run of {other}, not of {log}. Go on .*vplog run --resume -o {out}")
    complete(out, log, force=True)
    assert not (out / ".cache" / "run.json").exists()


@pytest.mark.parametrize("error", [KeyboardInterrupt, LogError, ResultError])
def test_a_run_that_came_to_nothing_leaves_nothing(error: type[BaseException], log: Path, tmp_path: Path) -> None:
    with pytest.raises(error), staged_run(tmp_path / "new" / "out", provenance.head(Pipeline(), log, 1), [log]):
        raise error
    assert not (tmp_path / "new").exists()


def test_a_run_whose_log_cannot_be_used_is_not_to_be_resumed(log: Path, other: Path, tmp_path: Path) -> None:
    """It would fail again; stages that it finished stay for other runs."""
    out = tmp_path / "out"
    asked = {**provenance.head(Pipeline(), log, 1), **run_folder.provenance.logs_of([log, other])}
    with pytest.raises(LogError) as failed, staged_run(out, asked, [log, other], drives=["a", "b"]):
        written(out / ".cache" / "extract-0.stage", b"a result")
        raise LogError
    assert failed.value.__notes__ == [f"0.0 MB of results of stages (extract) are kept in {out}/.cache."]
    assert [path.name for path in out.rglob("*") if path.is_file()] == ["extract-0.stage"]
    complete(out, log)


def test_a_request_stays_while_it_is_gone_on_with(log: Path, tmp_path: Path) -> None:
    out = tmp_path / "out"
    for stage in (True, False):
        with pytest.raises(KeyboardInterrupt), staged_run(out, provenance.head(Pipeline(), log, 1), [log]):
            if stage:
                (out / ".cache" / "extract-0.stage").write_text("a result")
            raise KeyboardInterrupt
        assert (out / ".cache" / "run.json").exists()


def test_a_run_killed_before_its_first_stage_and_interrupted_again_can_be_gone_on_with(
    log: Path, tmp_path: Path
) -> None:
    out = tmp_path / "out"
    write_run_json(out / ".cache" / "run.json", {**provenance.head(Pipeline(), log, 1), "finished": False})
    with pytest.raises(KeyboardInterrupt) as stopped, staged_run(out, provenance.head(Pipeline(), log, 1), [log]):
        raise KeyboardInterrupt
    assert stopped.value.__notes__ == [f"Go on with: vplog run --resume -o {out}"]
    assert (out / ".cache" / "run.json").is_file()


def test_a_log_that_changed_is_not_resumed(log: Path, tmp_path: Path, verb: Callable[..., Said]) -> None:
    out = tmp_path / "out"
    with pytest.raises(KeyboardInterrupt):
        complete(out, log, stage=True)
    written(log, b"new log")
    assert f"{log} changed since the run in {out} began. Begin it again" in verb("run", "--resume", "-o", out).error


def _holds(*names: str) -> Callable[[Path], None]:
    def put(out: Path) -> None:
        for name in names:
            (out / name).parent.mkdir(parents=True, exist_ok=True)
            (out / name).write_text("{}")

    return put


OTHER_THINGS = {
    "files": _holds("notes.txt"), "map": _holds("map.json", "runs/drive=a/run.json"), "library": _holds("library.json"),
    "foreign run.json": _holds("run.json", "notes.txt"), "study": _holds("study.json"), "drive": _holds("drive/a.mcap"),
}  # fmt: skip


@pytest.mark.parametrize("force", [[], ["--force"]], ids=["plain", "force"])
@pytest.mark.parametrize("holds", OTHER_THINGS)
def test_a_folder_with_other_things_stays(
    holds: str, force: list[str], drive: Demo, tmp_path: Path, verb: Callable[..., Said]
) -> None:
    out = tmp_path / "out"
    OTHER_THINGS[holds](out)
    if holds == "foreign run.json":
        (out / "run.json").write_text('{"experiment": 3}')
    before = tree(out)
    for logs in ([drive.log], [drive.log, drive.log]):
        error = verb("run", *logs, "-o", out, *force, *OPTIONS).error
        assert "a folder with other things in it, not a run. Choose another with -o." in error
        assert tree(out) == before
        assert not list(out.glob(".*"))


@pytest.mark.parametrize(
    "command",
    ["export RUN --format tum -o", "report RUN -o", "optimize RUN/graph.g2o -o", "info LOG --html",
     "localize RUN LOG -o", "map export RUN -o", "map query RUN LOG -o"],
)  # fmt: skip
def test_logs_and_results_are_not_replaced_by_a_single_file(
    command: str, finished: Path, drive: Demo, tmp_path: Path, verb: Callable[..., Said]
) -> None:
    out = shutil.copytree(finished, tmp_path / "run")
    logs = {"a.mcap": drive.log.read_bytes(), "a.bag": b"#ROSBAG V2.0\n", "a.db3": b"SQLite format 3\0"}
    pictures = {
        "a.jpg": b"\xff\xd8\xff\xe1", "a.g2o": b"\x89PNG\r\n\x1a\n", "a.tif": b"MM\0*", "a.mp4": b"\0\0\0\x18ftypisom",
        "a.avi": b"RIFF1234AVI ", "a.mkv": b"\x1a\x45\xdf\xa3",
    }  # fmt: skip
    records = {"map/map.json": b"{}", "map/joint.json": b"{}", "map/edges/drive=a/edges.parquet": b"PAR1"}
    (tmp_path / "map" / "runs").mkdir(parents=True)
    (tmp_path / "map" / "edges" / "drive=a").mkdir(parents=True)
    for name, data in (logs | pictures | records).items():
        (tmp_path / name).write_bytes(data)
    results = [out / name for name in ("run.json", "closures.parquet", "result.mcap", "library/library.json")]
    before = tree(tmp_path)
    words = command.replace("RUN", str(out)).replace("LOG", str(drive.log)).split()
    for path in [*results, *(tmp_path / name for name in logs | pictures | records)]:
        said = verb(*words, path)
        assert said.code == 2
        assert f"{path} is a " in said.err.splitlines()[-1]
    assert tree(tmp_path) == before


def test_a_folder_is_no_file_to_write_and_is_refused_before_any_work(
    finished: Path, tmp_path: Path, verb: Callable[..., Said]
) -> None:
    for words in (["optimize", finished / "graph.g2o"], ["report", finished], ["map", "export", finished]):
        said = verb(*words, "-o", tmp_path)
        assert said.code == 2
        assert f"argument -o/--output: {tmp_path} is a folder: name a file." in said.err
    assert (
        f"{tmp_path} is a folder, and tum a file." in verb("export", finished, "--format", "tum", "-o", tmp_path).error
    )


def test_nothing_that_writes_a_file_replaces_a_log(finished: Path, drive: Demo, tmp_path: Path) -> None:
    log = Path(shutil.copy(drive.log, tmp_path))
    (tmp_path / "link").symlink_to(log)
    for path in (log, tmp_path / "link"):
        with pytest.raises(ResultError, match="is a recorded log, which is not replaced"):
            export(finished, "tum", path)
    assert log.read_bytes() == drive.log.read_bytes()


def test_libraries_and_demos_take_no_other_folder(tiny: Demo, tmp_path: Path, verb: Callable[..., Said]) -> None:
    """A file of the name of a record makes no library or study."""
    for holds in ("files", "map", "study", "library"):
        out = tmp_path / holds
        OTHER_THINGS[holds](out)
        before = tree(out)
        assert "other things in it, not a library" in verb("library", tiny.log, "-o", out, *OPTIONS).error
        study = ("study", tiny.log, "--truth", "odometry", "--min-gap", "5", "-o", out)
        assert "other things in it, not a study" in verb(*study).error
        assert tree(out) == before
    run = tmp_path / "run"
    _holds("run.json", "library/library.json")(run)
    assert f"is the library of the run in {run}" in verb("library", tiny.log, "-o", run / "library", *OPTIONS).error
    for name, data in (("drive.mcap", tiny.log.read_bytes()[8:]), ("truth.tum", b"1 0 0 0 0 0 0 1\n")):
        out = tmp_path / name / "drive"
        out.mkdir(parents=True)
        (out / name).write_bytes(data.replace(b"vplog demo", b"my robot's"))
        before = tree(out)
        assert f"{out / name} is not of a demo" in verb("demo", "-o", out.parent).error
        assert tree(out) == before


def test_an_interrupted_library_leaves_the_one_before(
    tiny: Demo, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out, pipeline = tmp_path / "library", load_pipeline("default", QUICK)
    build_library([tiny.log], out, pipeline)
    before = tree(out)
    for error in (KeyboardInterrupt, OSError):

        def fails(*_: object, error: type[BaseException] = error) -> None:
            raise error

        monkeypatch.setattr("json.dumps", fails)  # of the last file of a library
        with pytest.raises((KeyboardInterrupt, Exception)):
            build_library([tiny.log], out, load_pipeline("default", [*QUICK, "library.size=3"]))
        assert tree(out) == before
        monkeypatch.undo()
    build_library([tiny.log], out, load_pipeline("default", [*QUICK, "library.size=3"]))
    assert tree(out) != before


def test_a_library_of_another_log_is_not_replaced_without_force(verb: Verb, tiny: Demo, tmp_path: Path) -> None:
    """One of the same log is, with other settings too; a damaged one is of an unknown log."""
    out, other = tmp_path / "library", tmp_path / f"other{tiny.log.suffix}"
    shutil.copyfile(tiny.log, other)
    arguments = ("library", "-o", out, *(part for one in QUICK for part in ("--set", one)))
    assert verb(*arguments, tiny.log).code == 0
    assert verb(*arguments, tiny.log, "--set", "library.size=3").code == 0
    before = tree(out)
    said = verb(*arguments, other)
    assert "is another log or has changed. Choose another folder with -o" in said.error
    assert tree(out) == before
    assert verb(*arguments, other, "--force").code == 0
    (out / "references.parquet").write_bytes(b"PAR1")
    before = tree(out)
    assert "its logs are not known" in verb(*arguments, other).error
    assert tree(out) == before
    assert verb(*arguments, other, "--force").code == 0


def test_a_drive_may_be_called_library() -> None:
    names: list[str] = []
    for name in ("library", "a", "a", "library"):
        names.append(numbered(name, name, {"library", *names}))
    assert names == ["library-2", "a", "a-2", "library-3"]


def test_a_run_over_that_of_another_log_is_interrupted_killed_and_gone_on_with(
    tiny: Demo, tiny_drives: list[Path], tmp_path: Path, verb: Callable[..., Said]
) -> None:
    """With --force; until it is whole every verb finds the run before, and then it is that of an empty folder."""
    other = tiny_drives[1] / "drive.mcap"
    out, empty, chance = tmp_path / "out", tmp_path / "empty", random.Random(17)
    verb("run", tiny.log, "-o", out, *OPTIONS)
    (out / "notes.txt").write_text("mine")
    before = tree(out)
    assert f"{out} is the run of {tiny.log}" in verb("run", other, "-o", out, *OPTIONS).error
    told: list[object] = [other, "--force", *OPTIONS]
    code = f"from vplog.run import feature_extraction as parts; parts.PART_KEYFRAMES = 4; {VPLOG}"
    for sent, status in ((signal.SIGINT, 130), (signal.SIGKILL, -9), (signal.SIGTERM, 143)):
        stages = set(out.glob(".cache/*.stage"))
        process = Forked(code, "run", "-o", out, "--json", "--threads", 1, *told)
        for _ in range(chance.randint(1, 2) * 100_000):
            if process.poll() is not None or set(out.glob(".cache/*.stage")) - stages:
                break
            time.sleep(0.01)
        assert process.poll() is None, process.ended()
        process.send(sent)
        ended, said, error = process.ended()
        assert (ended, said) == (status, "")
        if sent != signal.SIGKILL:
            assert error.startswith("vplog: interrupted; ")
            assert error.endswith(f"are kept in {out}/.cache. Go on with: vplog run --resume -o {out}\n")
            assert len(error.splitlines()) == 1
            assert {path.name for path in out.glob(".*")} == {".cache"}
        assert {name: data for name, data in tree(out).items() if not name.startswith(".vplog")} == before
        assert verb("evaluate", out, "--truth", tiny.truth, "--json").json["truth"] == str(tiny.truth)
        assert verb("export", out, "--format", "tum", "-o", tmp_path / "x.tum").code == 0
        assert (tmp_path / "x.tum").read_bytes() == before["trajectory.tum"]
        told = ["--resume"]
    assert verb("run", "--resume", "-o", out, "--json").json["log"] == str(other)
    verb("run", other, "-o", empty, *OPTIONS)
    assert {path.name for path in out.glob(".*")} == {".cache"}
    own = {name: data for name, data in tree(out).items() if name not in ("run.json", "report.html", "notes.txt")}
    assert own == {name: data for name, data in tree(empty).items() if name not in ("run.json", "report.html")}
    assert tree(out).keys() - tree(empty).keys() == {"notes.txt"}


def test_explained_closures_go_with_the_run_that_they_are_of(log: Path, other: Path, tmp_path: Path) -> None:
    out, mine = tmp_path / "out", ("closure-5.svg", "closure-5-mine.png", "closure-x.png", "a-closure-5.png")
    complete(out, [log, other], joint=True)
    for folder in (out, out / "a", out / "b"):
        for name in ("closure-7.png", "closure-12345.png", *mine):
            (folder / name).write_text("a picture")
    complete(out, [log, other], joint=True)
    assert tree(out).keys() == {"run.json"} | {
        f"{folder}{name}" for folder in ("", "a/", "b/") for name in ("run.json", *mine)
    }


def test_what_cannot_be_begun_leaves_no_folder(drive: Demo, tmp_path: Path, verb: Callable[..., Said]) -> None:
    """Nor one above it, nor does it touch a run that is there, whatever fails before anything is computed."""
    bad, log, text = tmp_path / "bad", drive.log, written(tmp_path / "x.yaml", b"nothing: 1")
    bad.mkdir()
    blind, lost, empty = no_images(bad, log), no_odometry(bad, log), no_messages(bad, log)
    given = [
        [blind], [lost], [empty], [wrong_magic(bad, log)], [bad / "absent"], ["http://127.0.0.1:9/x.mcap"],
        [log, lost], [log, bad / "absent"], ["--one-drive", log, lost], [log, blind, "--gps"],
        *([log, *one] for one in (
            ["--library", bad / "absent"], ["--library", bad], ["--set", "solve.kind=none"], ["--pipeline", text],
            ["--image-topic", "/absent"], ["--odometry-topic", "/absent"], ["--camera-info-topic", "/absent"],
            ["--odometry-file", text], ["--calibration", text], ["--depth-topic", "/absent"],
        )),
    ]  # fmt: skip
    run, new = tmp_path / "run", tmp_path / "new" / "folder" / "out"
    complete(run, log)
    before = tree(run)
    for number, arguments in enumerate(given):
        assert verb("run", *arguments, "-o", run if number % 5 == 1 else new, *OPTIONS).code in (1, 2), arguments
        assert not (tmp_path / "new").exists(), arguments
        assert tree(run) == before, arguments
        assert not list(run.glob(".*")), arguments
    for arguments in (
        ["batch", bad / "absent"], ["batch", log, "--library", bad], ["library", blind], ["demo", "--set", "x.y=1"],
        ["study", bad / "absent", log, "--truth", "index"], ["map", "merge", bad / "absent"],
        ["compare", blind, log, "--methods", "bobb", "--truth", "index"],
    ):  # fmt: skip
        assert verb(*arguments, "-o", new).code == 1, arguments
        assert not (tmp_path / "new").exists(), arguments


def test_caches_of_an_unfinished_run_of_several_go_with_it(tmp_path: Path) -> None:
    """Its drives are in no run.json yet; those of the new run stay."""
    for drive in ("before", "after"):
        (tmp_path / ".cache" / drive).mkdir(parents=True)
        (tmp_path / ".cache" / drive / "extract-000000-0.stage").touch()
    patterns = run_folder._results_in(tmp_path, None, {"after": tmp_path / "after.mcap"}, resumable=True)
    found = {path.relative_to(tmp_path).as_posix() for pattern in patterns for path in tmp_path.glob(pattern)}
    assert found == {".cache/before/extract-000000-0.stage"}


def test_the_command_of_a_run_has_all_that_it_was_given(tmp_path: Path) -> None:
    """So that a run with decisions differs from it in these alone."""
    changed = ["places.references=3", "gps.use=true"]
    pipeline = load_pipeline("default", [*changed, "decisions.file=d.csv"])
    topics = TopicChoice(
        image="/a b", odometry="visual", masks={"": tmp_path / "m.png"}, gps_any_status=True, image_offset_s=-0.4
    )
    words = provenance.arguments([tmp_path / "1.bag", tmp_path / "2.bag"], topics, pipeline, tmp_path / "library")
    command = command_of({"arguments": words}, "out", "--decisions", "d.csv")
    given = main._parser().parse_args(shlex.split(command)[1:])
    assert parser.topics_of(given) == topics
    assert (given.logs, given.one_drive) == ([tmp_path / "1.bag", tmp_path / "2.bag"], True)
    assert given.library == tmp_path / "library"
    assert parser.pipeline_of(given) == load_pipeline("default", changed)


@pytest.mark.parametrize("references", [None, 4, 10, 3])
def test_the_command_has_settings_of_another_kind_that_are_defaults_of_the_usual_one(
    references: int | None, tmp_path: Path
) -> None:
    """They are none of its own."""
    changed = ["places.kind=bobb_paper", *([] if references is None else [f"places.references={references}"])]
    pipeline = load_pipeline("default", changed)
    words = provenance.arguments([tmp_path / "1.bag"], TopicChoice(), pipeline)
    given = main._parser().parse_args(["run", *words, "-o", "out"])
    assert parser.pipeline_of(given) == pipeline
    assert words.count("--set") == (1 if pipeline == load_pipeline("default", changed[:1]) else 2)
