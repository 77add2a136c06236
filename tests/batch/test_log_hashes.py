"""Logs that have not changed since the last batch are not read again, and all others are."""

from __future__ import annotations

import hashlib
import os
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from vplog.batch import log_hashes
from vplog.batch.log_hashes import known_hashes
from vplog.batch.plan import DriveInput
from vplog.batch.worker import told
from vplog.errors import LogError, VplogError
from vplog.execution.execution import Execution
from vplog.logs import TopicChoice
from vplog.logs.formats.mcap_layout import MAGIC
from vplog.results.run_record import read_run_json
from vplog.storage.remote_path import RemotePath, located

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.fixture
def read(monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Names of the files that are read from now on; what was just written counts as settled."""
    found: list[str] = []
    original = log_hashes.hash_inputs

    def counted(path: Path, told: Callable[[int], None]) -> dict[str, str]:
        found.append(path.name)
        return original(path, told)

    monkeypatch.setattr(log_hashes, "hash_inputs", counted)
    monkeypatch.setattr(log_hashes, "_SETTLED_S", -3600.0)
    return found


@pytest.fixture
def logs(tmp_path: Path) -> dict[str, Path]:
    (tmp_path / "folder").mkdir()
    for name in ("one.mcap", "two.mcap", "folder/a.mcap", "folder/b.mcap"):
        (tmp_path / name).write_bytes(log(name))
    return {name: tmp_path / name for name in ("one.mcap", "two.mcap", "folder")}


def asked(logs: dict[str, Path], record: Path, **beside: Path) -> tuple[list[dict[str, str]], dict[str, str]]:
    answers = known_hashes(given(logs, TopicChoice.model_validate(beside)), record, Execution(2))
    errors = {name: str(answer) for name, answer in zip(logs, answers, strict=True) if isinstance(answer, VplogError)}
    return [{} if isinstance(answer, VplogError) else answer for answer in answers], errors


def given(logs: dict[str, Path], topics: TopicChoice) -> list[DriveInput]:
    return [DriveInput(path, topics=topics) for path in logs.values()]


def log(text: str) -> bytes:
    """What begins as a log."""
    return MAGIC + text.encode()


def sha256(text: str) -> str:
    return hashlib.sha256(log(text)).hexdigest()


def test_what_has_not_changed_is_not_read_again(logs: dict[str, Path], tmp_path: Path, read: list[str]) -> None:
    record, odometry = tmp_path / ".inputs.json", tmp_path / "odometry.tum"
    odometry.write_text("0 0 0 0 0 0 0 1")
    first = asked(logs, record, odometry_file=odometry)
    beside = {"beside odometry_file odometry.tum": hashlib.sha256(b"0 0 0 0 0 0 0 1").hexdigest()}
    assert first == (
        [
            {"one.mcap": sha256("one.mcap"), **beside},
            {"two.mcap": sha256("two.mcap"), **beside},
            {"a.mcap": sha256("folder/a.mcap"), "b.mcap": sha256("folder/b.mcap"), **beside},
        ],
        {},
    )
    read.clear()
    assert asked(logs, record, odometry_file=odometry) == first
    assert not read
    (tmp_path / "folder" / "c.mcap").write_bytes(log("more"))
    now = logs["two.mcap"].stat()
    logs["two.mcap"].write_bytes(log("TWO.mcap"))
    os.utime(logs["two.mcap"], ns=(now.st_atime_ns, now.st_mtime_ns))  # a copy may bring its time of writing along
    while logs["two.mcap"].stat().st_ctime_ns == now.st_ctime_ns:  # clocks of file systems tick every 10 ms
        os.utime(logs["two.mcap"], ns=(now.st_atime_ns, now.st_mtime_ns))
    found, _ = asked(logs, record, odometry_file=odometry)
    assert sorted(read) == ["folder", "two.mcap"]  # one a thread, in any order
    assert found[0] == first[0][0]
    assert found[1]["two.mcap"] == sha256("TWO.mcap")
    assert found[2]["c.mcap"] == sha256("more")


def test_a_log_just_written_is_read_the_next_time_too(
    logs: dict[str, Path], tmp_path: Path, read: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(log_hashes, "_SETTLED_S", 3600.0)
    asked(logs, tmp_path / ".inputs.json")
    read.clear()
    asked(logs, tmp_path / ".inputs.json")
    assert sorted(read) == ["folder", "one.mcap", "two.mcap"]


def test_a_log_that_cannot_be_read_is_one_line(logs: dict[str, Path], tmp_path: Path) -> None:
    gone = tmp_path / "gone.mcap"
    found, errors = asked({**logs, "gone": gone}, tmp_path / ".inputs.json")
    assert [len(one) for one in found] == [1, 1, 2, 0]
    assert errors == {"gone": f"Cannot read {gone}: No such file or directory."}


@pytest.mark.parametrize("damage", ["", "[]", "{", '{"LOG": 3}', '{"LOG": {"stat": {"a": 1}, "hashes": {}}}'])
def test_a_damaged_record_is_made_anew(logs: dict[str, Path], tmp_path: Path, read: list[str], damage: str) -> None:
    record = tmp_path / ".inputs.json"
    first = asked(logs, record)
    whole = record.read_text()
    record.write_text(damage.replace("LOG", str(logs["one.mcap"])))
    assert asked(logs, record) == first
    assert len(read) == 6
    assert record.read_text() == whole


def test_no_flipped_bit_of_the_record_gives_another_hash(
    logs: dict[str, Path], tmp_path: Path, read: list[str]
) -> None:
    record, rng = tmp_path / ".inputs.json", np.random.default_rng(0)
    first, whole = asked(logs, record), record.read_bytes()
    for bit in rng.integers(8 * len(whole), size=100):
        data = bytearray(whole)
        data[bit // 8] ^= 1 << bit % 8
        record.write_bytes(data)
        assert asked(logs, record) == first


def test_the_record_forgets_logs_that_are_gone(logs: dict[str, Path], tmp_path: Path, read: list[str]) -> None:
    record = tmp_path / ".inputs.json"
    asked(logs, record)
    logs.pop("one.mcap").unlink()
    (tmp_path / "three.mcap").write_bytes(log("three"))
    asked({"three": tmp_path / "three.mcap"}, record)
    assert set(read_run_json(record)) == {str(tmp_path / name) for name in ("two.mcap", "folder", "three.mcap")}
    assert read[3:] == ["three.mcap"]


def test_a_log_of_the_record_that_cannot_be_asked_for_stops_nothing(
    logs: dict[str, Path], tmp_path: Path, read: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    """It is in a folder that is closed now."""
    record, closed = tmp_path / ".inputs.json", logs.pop("one.mcap")
    asked({"one.mcap": closed}, record)
    stat = Path.stat

    def refused(path: Path, **how: Any) -> Any:
        if path == closed:
            raise PermissionError(13, "Permission denied", str(path))
        return stat(path, **how)

    monkeypatch.setattr(Path, "stat", refused)
    assert asked(logs, record)[1] == {}
    assert len(read_run_json(record)) == 3
    assert (read[0], sorted(read[1:])) == ("one.mcap", ["folder", "two.mcap"])


def test_a_record_that_cannot_be_written_is_done_without(logs: dict[str, Path], tmp_path: Path) -> None:
    assert len(asked(logs, tmp_path / "no" / ".inputs.json")[0]) == 3


def test_what_is_no_log_is_not_read(tmp_path: Path, read: list[str]) -> None:
    """However large; a pipe would wait for its writer."""
    large, pipe, home = tmp_path / "disk.img", tmp_path / "pipe.mcap", tmp_path / "home"
    with large.open("wb") as file:
        file.truncate(10**13)
    os.mkfifo(pipe)
    home.mkdir()
    (home / "large").symlink_to(large)
    found, errors = asked({"large": large, "pipe": pipe, "home": home}, tmp_path / ".inputs.json")
    assert found == [{}, {}, {}]
    assert not read
    assert "which no log does" in errors["large"]
    assert "neither a file nor a folder" in errors["pipe"]
    assert "no log and no images" in errors["home"]


def test_reading_tells_how_far_it_is_and_ends_at_once(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A log of 10 TB takes hours: Ctrl-C does not wait for that."""
    large, told = tmp_path / "large.mcap", list[tuple[str, int, int]]()
    large.write_bytes(MAGIC)
    with large.open("r+b") as file:
        file.truncate(10**13)
    monkeypatch.setattr(log_hashes, "_PROGRESS_EVERY_S", 0.05)

    def interrupt(*what: Any) -> None:
        told.append(what)
        if told[-1][1]:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        known_hashes(given({"large": large}, TopicChoice()), tmp_path / ".inputs.json", Execution(2, interrupt))
    assert told[-1][0] == "check (MB)"
    assert 0 < told[-1][1] < told[-1][2] == 10**7


def test_files_beside_a_log_of_one_name_are_told_apart(tmp_path: Path, logs: dict[str, Path]) -> None:
    """As where each drive has a number."""
    beside = {f"{what}_file": tmp_path / what / "0042.txt" for what in ("odometry", "calibration")}
    for what, file in beside.items():
        file.parent.mkdir()
        file.write_text(what)
    first, *_ = known_hashes(given(logs, TopicChoice.model_validate(beside)), tmp_path / "record", Execution(1))
    beside["odometry_file"].write_text("another")
    second, *_ = known_hashes(given(logs, TopicChoice.model_validate(beside)), tmp_path / "record", Execution(1))
    assert first != second


@pytest.mark.parametrize(("retries", "fault"), [(1, "network"), (2, "")])
def test_a_server_is_asked_again(retries: int, fault: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It answers at the third attempt."""
    failures = [OSError("reset"), OSError("reset")]

    def version(_: RemotePath) -> str:
        if failures:
            raise failures.pop()
        return "length 1"

    monkeypatch.setattr(RemotePath, "is_dir", lambda _: False)
    monkeypatch.setattr(RemotePath, "version", version)
    log = DriveInput(located("s3://bucket/a.mcap"))
    [found] = known_hashes([log], tmp_path / "record", Execution(1), retries)
    assert (told(found, log.url)[1] if isinstance(found, LogError) else "") == fault


def test_masks_of_one_name_are_told_apart(tmp_path: Path, logs: dict[str, Path]) -> None:
    masks = {}
    for topic, text in (("/left", b"one"), ("/right", b"two")):
        masks[topic] = tmp_path / topic.strip("/") / "mask.png"
        masks[topic].parent.mkdir()
        masks[topic].write_bytes(text)
    found, *_ = known_hashes(given(logs, TopicChoice(masks=masks)), tmp_path / "record", Execution(1))
    assert isinstance(found, dict)
    beside = {name: text for name, text in found.items() if name.startswith("beside")}
    assert {name: hashlib.sha256(masks[name.split()[2]].read_bytes()).hexdigest() for name in beside} == beside
    assert len(beside) == 2
