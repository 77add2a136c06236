"""Drives taken from map to map and out of it; none with another library, none twice, none half."""

from __future__ import annotations

import hashlib
import os
import shutil
import signal
from typing import TYPE_CHECKING, Any

import pyarrow.parquet as pq
import pytest

from tests.maps.runs import LIBRARY, OTHER_LIBRARY, make_map, put, seeds
from tests.maps.storage.test_map_store import forked
from tests.maps.test_remove import steps
from vplog.errors import ResultError
from vplog.maps.merge import merge_maps
from vplog.maps.storage import layout, map_store
from vplog.results import run_record

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    Verb = Callable[..., Said]


def digests(root: Path, drive: str) -> dict[str, str]:
    run = map_store.Store(root).run(drive)
    return {file.name: hashlib.sha256(file.read_bytes()).hexdigest() for file in run.iterdir()}


def states(told: dict[str, Any]) -> list[tuple[str, str, str]]:
    return [(one["drive"], one["as"], one["state"]) for one in told["drives"]]


def test_drives_come_as_they_are_and_those_whose_name_is_taken_get_a_number(verb: Verb, tmp_path: Path) -> None:
    a = make_map(tmp_path / "a", {"walk": 1, "ride": 2})
    b = make_map(tmp_path / "b", {"walk": 3, "walk-2": 4, "walk-10": 5, "ride": 2})
    both = tmp_path / "both"
    told = verb("map", "merge", a, b, "-o", both, "--json").json
    assert states(told) == [
        ("ride", "ride", "taken"), ("walk", "walk", "taken"), ("ride", "ride", "there already"),
        ("walk", "walk-2", "taken"), ("walk-2", "walk-3", "taken"), ("walk-10", "walk-10", "taken"),
    ]  # fmt: skip
    store = map_store.Store(both)
    assert {drive: seeds(store.run(drive)) for drive in store.drives()} == {
        "ride": {2}, "walk": {1}, "walk-10": {5}, "walk-2": {3}, "walk-3": {4},
    }  # fmt: skip
    assert store.head().library == LIBRARY
    assert digests(both, "walk") == digests(a, "walk")
    assert digests(both, "walk-10") == digests(b, "walk-10")
    moved, own = digests(both, "walk-2"), digests(b, "walk")
    assert {name for name in own if moved[name] != own[name]} == {"keyframes.parquet", "drive.json"}
    for drive, record in store.drives().items():
        assert set(pq.read_table(store.run(drive) / "keyframes.parquet")["drive"].to_pylist()) == {drive}
        made_from = {name: record[name] for name in ("drive", "inputs", "library", "topics")}
        assert record["key"] == layout.key_of(made_from), (
            "which is that of a batch, so that it leaves the drive as it is"
        )
    assert "6 drives" not in verb("map", "info", both).out
    again = verb("map", "merge", b, a, "-o", both, "--json").json
    assert {state for _, _, state in states(again)} == {"there already"}
    assert "0 of 6 drives taken" in verb("map", "merge", a, b, "-o", both).out


def test_a_merge_killed_anywhere_has_each_drive_whole_or_not_at_all(tmp_path: Path) -> None:
    """And goes on to the same end; the drives of the target stay as they were."""
    source, whole, step = make_map(tmp_path / "source", {"walk": 1, "ride": 2}), tmp_path / "whole", 0
    for drive in ("walk", "ride"):
        (source / "joins" / f"drive={drive}").mkdir(parents=True)
        (source / "joins" / f"drive={drive}" / "features.parquet").write_text(drive)
    make_map(whole, {"walk": 3})
    merge_maps([source], whole)
    wanted = {drive: digests(whole, drive) for drive in map_store.Store(whole).drives()}
    outcomes = set[int]()
    for step in (*range(1, 40), *range(40, 1000, 7)):
        target = make_map(tmp_path / f"{step}", {"walk": 3})

        def work(target: Path = target, step: int = step) -> None:
            with pytest.MonkeyPatch.context() as patch:
                steps(patch, [step], lambda: os.kill(os.getpid(), signal.SIGKILL))
                merge_maps([source], target)

        ended = forked(work)
        with map_store.reading(target) as store:
            found = {drive: digests(target, drive) for drive in store.drives()}
            assert not store.damaged
        assert found.items() <= wanted.items()
        assert "walk" in found
        outcomes.add(len(found))
        merge_maps([source], target)
        assert {drive: digests(target, drive) for drive in map_store.Store(target).drives()} == wanted
        assert not list(target.rglob("*.part"))
        assert {path.read_text() for path in (target / "joins").rglob("*.parquet")} == {"walk", "ride"}
        if ended == 0:
            break
    assert outcomes == {1, 2, 3}
    assert step > 30


def test_a_merge_that_was_stopped_while_it_copied_leaves_no_half_drive(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Killed, or the disk full, with any of the files there."""
    a, target = make_map(tmp_path / "a", {"one": 1}), tmp_path / "b"
    copytree, files = shutil.copytree, len(list(map_store.Store(a).run("one").iterdir())) - 1
    for stop in range(files):
        left = [stop]

        def copied(source: str, to: str, left: list[int] = left) -> str:
            left[0] -= 1
            if left[0] < 0:
                raise OSError(28, "No space left on device")
            return shutil.copyfile(source, to)

        with monkeypatch.context() as patch:
            patch.setattr(
                shutil, "copytree", lambda *told, **more: copytree(*told, **(more | {"copy_function": copied}))
            )
            patch.setattr("vplog.maps.merge.copy_library", lambda *_: None)
            with pytest.raises(ResultError, match="Cannot copy"):
                merge_maps([a], target)
        with map_store.writing(target) as store:
            assert not store.drives()
    merge_maps([a], target)
    assert digests(target, "one") == digests(a, "one")
    for damage in (b"", b"{}", b'{"drive": "two"}'):  # of a worker on another machine
        with map_store.writing(target) as store:
            made = store.staging / "made"
            shutil.copytree(store.run("one"), made)
            (made / "drive.json").write_bytes(damage)
            saved = copytree(store.staging, tmp_path / "saved", dirs_exist_ok=True)
        copytree(saved, store.staging)
        with map_store.writing(target) as store:
            assert list(store.drives()) == ["one"]


def test_a_merge_that_was_killed_right_behind_the_library_goes_on(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    source, target = make_map(tmp_path / "source", {"one": 1}), tmp_path / "target"
    add_library = map_store.add_library

    def killed(*arguments: Any) -> None:
        add_library(*arguments)
        raise KeyboardInterrupt

    with monkeypatch.context() as patch, pytest.raises(KeyboardInterrupt):
        patch.setattr(map_store, "add_library", killed)
        merge_maps([source], target)
    assert [one["drive"] for one in merge_maps([source], target)["drives"]] == ["one"]
    assert map_store.Store(target).head() == map_store.Store(source).head()


def test_no_drive_of_the_target_gives_way(tmp_path: Path) -> None:
    """Not where it has two of one content either."""
    a, b = make_map(tmp_path / "a", {"run": 1, "run-2": 1}), make_map(tmp_path / "b", {"run": 2})
    assert states(merge_maps([b], a)) == [("run", "run-3", "taken")]
    assert {drive: seeds(map_store.Store(a).run(drive)) for drive in ("run", "run-2", "run-3")} == {
        "run": {1}, "run-2": {1}, "run-3": {2},
    }  # fmt: skip


def test_single_drives_are_taken(verb: Verb, tmp_path: Path) -> None:
    a, b = make_map(tmp_path / "a", {"one": 1, "two": 2}), make_map(tmp_path / "b", {"three": 3})
    told = verb("map", "merge", a, b, "--drive", "two", "--drive", "three", "-o", tmp_path / "c", "--json").json
    assert states(told) == [("two", "two", "taken"), ("three", "three", "taken")]
    assert "Drives: one, three, two" in verb("map", "merge", a, b, "--drive", "four", "-o", tmp_path / "c").error


def test_another_library_is_refused_everywhere_and_nothing_is_written(verb: Verb, tmp_path: Path) -> None:
    a, b = make_map(tmp_path / "a", {"one": 1}), make_map(tmp_path / "b", {"two": 2}, OTHER_LIBRARY)
    said = verb("map", "merge", a, b, "-o", tmp_path / "both").error
    assert f"library {OTHER_LIBRARY[:12]}" in said
    assert f"vplog map redescribe {b} --library {a}/libraries/{LIBRARY}" in said
    assert not (tmp_path / "both").exists()
    assert "do not compare" in verb("map", "merge", b, "-o", a).error
    assert list(map_store.Store(a).drives()) == ["one"]

    with map_store.writing(a) as store:  # by hand, as nobody should
        put(store, "strange", 3, OTHER_LIBRARY)
    for arguments in (
        ("merge", a, "-o", tmp_path / "c"), ("export", a, "-o", tmp_path / "c"), ("query", a, tmp_path / "any.mcap"),
        ("redescribe", a, "--library", b / "libraries" / OTHER_LIBRARY, "-o", tmp_path / "c"),
    ):  # fmt: skip
        assert "add its log with `vplog batch`" in verb("map", *arguments).error
        assert not (tmp_path / "c").exists()
    assert any("do not compare" in problem for problem in verb("map", "info", a, "--json").json["problems"])
    verb("map", "remove", a, "strange")
    assert verb("map", "info", a, "--json").json["problems"] == [
        "1 of 1 drives were made with other settings than the last batch had, or by another version of vplog. "
        "`vplog batch` with their logs computes them again; the first is /logs/1/one.mcap."
    ]


def test_what_cannot_be_merged_is_one_line(verb: Verb, tmp_path: Path) -> None:
    a = make_map(tmp_path / "a", {"one": 1})
    assert "neither a map nor" in verb("map", "merge", a, tmp_path / "none", "-o", tmp_path / "c").error
    (tmp_path / "folder").mkdir()
    assert "is not a map" in verb("map", "merge", a, tmp_path / "folder", "-o", tmp_path / "c").error
    assert "own" in verb("map", "merge", a, "-o", a).error or "target" in verb("map", "merge", a, "-o", a).error
    assert "given twice" in verb("map", "merge", a, a, "-o", tmp_path / "c").error
    assert not (tmp_path / "c").exists()
    empty = make_map(tmp_path / "empty", {})
    assert "no finished drive" in verb("map", "merge", empty, "-o", tmp_path / "c").error
    verb("map", "merge", a, "-o", empty)
    assert list(map_store.Store(empty).drives()) == ["one"]


def test_a_damaged_library_is_not_taken(verb: Verb, tmp_path: Path) -> None:
    source, target = make_map(tmp_path / "source", {"walk": 1}), tmp_path / "target"
    (source / "libraries" / LIBRARY / "features.parquet").write_bytes(b"PAR1")
    assert "features.parquet of library aaaaaaaaaaaa is damaged" in verb("map", "merge", source, "-o", target).error
    assert not list((target).glob("runs/*"))


def test_removing_is_as_removing_the_folders(verb: Verb, tmp_path: Path) -> None:
    a, b = (make_map(tmp_path / name, {"one": 1, "two": 2, "three": 3}) for name in "ab")
    for root in (a, b):
        for name in ("joins", ".cache"):
            (root / name / "drive=one").mkdir(parents=True)
            (root / name / "drive=one" / "file").write_text("of one")
        run_record.write_run_json(root / "failures.json", {"bad": {"log": "/bad", "error": "why"}})
    told = verb("map", "remove", a, "one", "three", "bad", "--json").json
    empty = {"still_joined": [], "warnings": []}
    assert told == {"map": str(a), "removed": ["one", "three", "bad"], "drives": ["two"], **empty}
    for drive in ("one", "three"):
        for folder in [*b.glob(f"*/drive={drive}"), b / ".cache" / f"drive={drive}"]:
            shutil.rmtree(folder, ignore_errors=True)
    names = {path.relative_to(a) for path in a.rglob("*")}
    assert names == {path.relative_to(b) for path in b.rglob("*")}
    assert run_record.read_run_json(a / "failures.json") == {}
    assert "Drives: two" in verb("map", "remove", a, "two", "none").error
    assert list(map_store.Store(a).drives()) == ["two"], "all or nothing"
