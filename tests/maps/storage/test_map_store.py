"""A map in a folder: whoever reads it while it is written, or after a writer was killed, finds one state of a drive."""

from __future__ import annotations

import errno
import os
import shutil
import signal
from contextlib import suppress
from typing import TYPE_CHECKING, Any

import pyarrow as pa
import pyarrow.dataset as ds
import pyarrow.parquet as pq
import pytest

from tests.maps.runs import PLACES, make_map, put, seeds, write_run
from vplog.errors import ResultError, SettingsError
from vplog.maps.joining import drive_pairs
from vplog.maps.storage import local, map_store
from vplog.maps.storage.layout import sha256_of
from vplog.storage.scratch import replacing

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path


def forked(work: Callable[[], None]) -> int:
    """Do it in a process of its own; how that ended."""
    child = os.fork()
    if child == 0:
        with suppress(BaseException):
            work()
            os._exit(0)
        os._exit(1)
    return os.waitpid(child, 0)[1]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return make_map(tmp_path / "map", {"one": 1, "two": 2})


def test_a_reader_never_sees_half_a_drive(root: Path, tmp_path: Path) -> None:
    """While another process puts two runs in each other's place, over and over."""
    runs = [write_run(tmp_path / f"{seed}", "one", seed) for seed in (3, 4)]

    def replace_often() -> None:
        with map_store.writing(root) as store:
            for turn in range(40):
                made = store.staging / "made"
                shutil.copytree(runs[turn % 2], made)
                map_store.publish(store, "one", made)

    store, said = map_store.Store(root), list[Any]()
    child = os.fork()
    if child == 0:
        with suppress(BaseException):
            replace_often()
            os._exit(0)
        os._exit(1)
    ended, status = 0, 0
    while not ended:
        assert list(store.drives()) == ["one", "two"], "neither is ever gone"
        with suppress(ResultError):  # on a slow machine it is never left alone for long enough
            said.append(store.read("one", seeds))
        ended, status = os.waitpid(child, os.WNOHANG)
    assert status == 0
    assert all(len(one) == 1 for one in said)
    assert said


def test_what_is_read_while_it_changes_is_read_again(root: Path) -> None:
    store, asked = map_store.Store(root), list[Any]()

    def replaced_meanwhile(run: Path) -> set[Any]:
        found = seeds(run)
        if not asked:
            with map_store.writing(root) as writer:
                put(writer, "one", 5)
        asked.append(run)
        return found

    assert store.read("one", replaced_meanwhile) == {5}
    assert len(asked) == 2
    with pytest.raises(ResultError, match="no such table"):
        store.read("one", lambda run: (_ for _ in ()).throw(ResultError(f"no such table in {run}")))
    shutil.rmtree(store.run("one"))
    with pytest.raises(ResultError, match="removed"):
        store.read("one", seeds)


@pytest.mark.parametrize("exchanges", [True, False], ids=["exchange", "two renames"])
def test_a_writer_killed_anywhere_leaves_the_old_drive_or_the_new(
    root: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, exchanges: bool
) -> None:
    """Killed before its n-th change of the disk, for every n; the next writer puts right what is left over."""
    if not exchanges:
        monkeypatch.setattr(local, "exchange_folders", lambda *_: False)
    old, new = write_run(tmp_path / "old", "one", 1), write_run(tmp_path / "new", "one", 9)
    store, steps, states = map_store.Store(root), 0, set[int]()
    while True:
        steps += 1

        def publish(steps: int = steps) -> None:
            with map_store.writing(root) as writer:
                made = writer.staging / "made"
                shutil.copytree(new, made)
                left = [steps]

                def stepping(function: Any) -> Any:
                    def step(*arguments: Any, **named: Any) -> Any:
                        left[0] -= 1
                        if left[0] == 0:
                            os.kill(os.getpid(), signal.SIGKILL)
                        return function(*arguments, **named)

                    return step

                for owner, name in (
                    (type(root), "rename"), (type(root), "replace"), (type(root), "unlink"), (os, "link"),
                    (shutil, "rmtree"), (local, "exchange_folders"),
                ):  # fmt: skip
                    setattr(owner, name, stepping(getattr(owner, name)))
                map_store.publish(writer, "one", made)

        ended = forked(publish)
        assert ended in (0, signal.SIGKILL)
        if exchanges:
            [state] = store.read("one", seeds)
            states.add(state)
        with map_store.writing(root) as writer:
            [settled] = writer.read("one", seeds)
            assert list(writer.drives()) == ["one", "two"]
        for name in map_store.TABLES:
            assert (store.root / name / "drive=one" / f"{name}.parquet").read_bytes() == (
                store.run("one") / f"{name}.parquet"
            ).read_bytes()
        assert not store.staging.exists()
        assert settled in (1, 9)
        if ended == 0:
            break
        with map_store.writing(root) as writer:
            shutil.copytree(old, writer.staging / "old")
            map_store.publish(writer, "one", writer.staging / "old")
    assert steps > 10
    assert settled == 9
    assert states == ({1, 9} if exchanges else set())


def test_one_writer_at_a_time_and_none_after_a_kill(root: Path) -> None:
    ready, go = os.pipe(), os.pipe()
    child = os.fork()
    if child == 0:
        with map_store.writing(root):
            os.write(ready[1], b"1")
            os.read(go[0], 1)
        os._exit(0)
    os.read(ready[0], 1)
    with pytest.raises(SettingsError, match="Another vplog process"), map_store.writing(root):
        pass
    os.kill(child, signal.SIGKILL)
    os.waitpid(child, 0)
    with map_store.writing(root) as store:
        assert list(store.drives()) == ["one", "two"]


def test_a_half_removed_drive_is_none(root: Path) -> None:
    store = map_store.Store(root)
    for drive in ("one", "two"):
        (store.run(drive) / "drive.json").unlink()  # `rm -r` takes files in any order
    assert store.drives() == {}


@pytest.mark.parametrize("name", ["поездка по городу " * 12, "京都" * 60, "a" * 240, "%" * 100])
def test_a_drive_may_be_called_anything(tmp_path: Path, name: str) -> None:
    root = make_map(tmp_path / "map", {name: 1, f"{name}2": 2})
    store = map_store.Store(root)
    assert list(store.drives()) == sorted([name, f"{name}2"])
    assert seeds(store.run(f"{name}2")) == {2}
    ledger = drive_pairs.ledger_path(store, f"{name}2", name)
    ledger.parent.mkdir(parents=True)
    with replacing(ledger) as stream:
        stream.write(b"ledger")
    drive_pairs.remove_stale_ledgers(store, f"{name}2", {name})
    assert ledger.exists()
    drive_pairs.remove_stale_ledgers(store, f"{name}2", set())
    assert not ledger.exists()


def test_copies_of_tables_are_compared_of_new_drives_alone(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where there are no hard links: to read all tables of a map twice takes as long as it is large."""
    hashed = list[Any]()

    def refuse(*_: Any) -> None:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr("os.link", refuse)
    root = make_map(tmp_path / "map", {"one": 1, "two": 2})
    monkeypatch.setattr(local, "sha256_of", lambda path: hashed.append(path) or sha256_of(path))
    with map_store.writing(root):
        assert not hashed
    run, other = root / "runs" / "drive=one", tmp_path / "run"
    shutil.copytree(run, other)
    shutil.rmtree(run)
    other.rename(run)
    path = run / "edges.parquet"
    path.write_bytes(path.read_bytes()[:-9] + b"anything!")
    (root / "keyframes" / "drive=two" / "keyframes.parquet").unlink()
    with map_store.writing(root):
        assert hashed
    assert not any("drive=two" in str(one) for one in hashed)
    assert (root / "edges" / "drive=one" / "edges.parquet").read_bytes() == path.read_bytes()
    assert (root / "keyframes" / "drive=two" / "keyframes.parquet").exists()


def test_a_drive_whose_tables_are_not_linked_is_in_the_map(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on a disk that fills up after the rename. The next writer links them; until then none is that of the drive
    before."""

    def full(*_: Any) -> None:
        raise ResultError("No space left on device")

    with map_store.writing(root) as store, monkeypatch.context() as patch:
        patch.setattr(local, "link_tables", full)
        put(store, "two", 3)
        assert store.read("two", seeds) == {3}
    assert not (root / "keyframes" / "drive=two").exists()
    with map_store.writing(root) as store:
        source = store.run("two") / "keyframes.parquet"
        assert (root / "keyframes" / "drive=two" / "keyframes.parquet").samefile(source)


def test_the_tables_are_a_data_set_by_drive(root: Path) -> None:
    for name in map_store.TABLES:
        found = ds.dataset(root / name, partitioning="hive", exclude_invalid_files=True)
        assert found.count_rows(filter=ds.field("drive") == "one") > 0
    keyframes = ds.dataset(root / "descriptors", partitioning="hive").to_table()
    assert sorted(keyframes["drive"].to_pylist()) == ["one"] * PLACES + ["two"] * PLACES


def test_drives_that_are_called_like_numbers_are_a_data_set_as_the_readme_has_it(tmp_path: Path) -> None:
    root = make_map(tmp_path / "map", {"0001": 1, "0002": 2})
    by_drive = ds.partitioning(pa.schema([("drive", pa.string())]), flavor="hive")
    for name in map_store.TABLES:
        for table in (
            ds.dataset(root / name, partitioning=by_drive).to_table(),
            pq.read_table(root / name, partitioning=by_drive),  # as pandas does
        ):
            assert set(table["drive"].to_pylist()) == {"0001", "0002"}, name
