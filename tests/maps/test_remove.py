"""Drives are removed all or none, whatever fails or is killed on the way."""

from __future__ import annotations

import json
import os
import shutil
import signal
from pathlib import Path
from typing import TYPE_CHECKING, Any

import pytest

from tests.maps.bucket import serving
from tests.maps.runs import make_map, put, seeds
from tests.maps.storage.test_map_store import forked
from vplog.errors import ResultError, VplogError
from vplog.maps.remove import remove_drives
from vplog.maps.storage import catalogue, map_store, objects
from vplog.storage.remote_path import located, objects_below

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from conftest import Said

DRIVES = {"one": 1, "two": 2, "three": 3}
GONE = ["one", "three"]


@pytest.fixture
def root(tmp_path: Path) -> Path:
    return whole_map(tmp_path / "map")


def whole_map(root: Path) -> Path:
    make_map(root, DRIVES)
    for drive in DRIVES:
        for name in ("joins", ".cache"):
            (root / name / f"drive={drive}").mkdir(parents=True)
            (root / name / f"drive={drive}" / "file").write_text(drive)
    (root / "failures.json").write_text(json.dumps({"bad": {"log": "/bad", "error": "why"}}))
    return root


def files(root: Path) -> dict[str, bytes]:
    hidden = (".lock", ".staging", catalogue.NAME)
    names = [path for path in sorted(root.rglob("*")) if path.is_file()]
    return {str(path.relative_to(root)): path.read_bytes() for path in names if path.name not in hidden}


def steps(patch: pytest.MonkeyPatch, left: list[int], end: Callable[[], None]) -> None:
    """End at the n-th change of the disk that a removal or a merge makes."""

    def stepping(function: Any) -> Any:
        def step(*arguments: Any, **named: Any) -> Any:
            left[0] -= 1
            if left[0] == 0:
                end()
            return function(*arguments, **named)

        return step

    for owner, name in ((Path, "rename"), (Path, "replace"), (Path, "unlink"), (Path, "mkdir"), (os, "fsync"),
                        (os, "link"), (os, "unlink"), (os, "rmdir"), (shutil, "rmtree")):  # fmt: skip
        patch.setattr(owner, name, stepping(getattr(owner, name)))


def drives_of(root: Any) -> dict[str, Any]:
    """Those that readers see; each has all its files."""
    with map_store.reading(root) as store:
        return {drive: store.read(drive, seeds) for drive in store.drives()}


def check_all_or_none(root: Path, before: dict[str, bytes]) -> bool:
    """Whether they are out, as readers see it and as the next writer leaves it."""
    found = drives_of(root)
    out = "one" not in found
    assert sorted(found) == (["two"] if out else sorted(DRIVES))
    with map_store.writing(root) as store:
        assert sorted(store.drives()) == sorted(found)
    now = files(root)
    if out:
        assert not any(f"drive={drive}/" in name for drive in GONE for name in now), "swept"
        assert map_store.Store(root).removed() == []
    else:
        assert {name: data for name, data in now.items() if not name.endswith(".part")} == before
    return out


@pytest.mark.parametrize("how", ["kill", "fail"])
def test_a_removal_stopped_anywhere_takes_all_or_none(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, how: str
) -> None:
    outcomes, whole, step = set[bool](), whole_map(tmp_path / "whole"), 0
    for step in (*range(1, 20), *range(20, 1000, 5)):
        root = tmp_path / f"{step}"
        shutil.copytree(whole, root)
        before = files(root)

        def work(root: Path = root, step: int = step) -> None:
            with pytest.MonkeyPatch.context() as patch:
                steps(patch, [step], lambda: os.kill(os.getpid(), signal.SIGKILL))
                remove_drives(root, GONE)

        def failed(root: Path = root, step: int = step) -> int:
            def fail() -> None:
                raise PermissionError(13, "Permission denied")

            left = [step]
            with pytest.MonkeyPatch.context() as patch:
                steps(patch, left, fail)
                try:
                    remove_drives(root, GONE)
                except (VplogError, OSError) as error:
                    said = str(error)
                else:
                    return int(left[0] <= 0)
            if "as before" in said:
                assert sorted(drives_of(root)) == sorted(DRIVES)
            if "out of" in said:
                assert list(drives_of(root)) == ["two"]
            return 1

        ended = forked(work) if how == "kill" else failed()
        outcomes.add(check_all_or_none(root, before))
        if ended == 0:
            break
    assert step > 15
    assert outcomes == {True, False}


def test_a_failed_rename_leaves_every_drive_as_it_was(root: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of the second, when the first is moved already."""
    before, rename = files(root), Path.rename

    def refuse(self: Path, target: Path) -> Path:
        if self.name == "drive=three":
            raise PermissionError(13, "Permission denied")
        return rename(self, target)

    with monkeypatch.context() as patch, pytest.raises(ResultError, match=r"one, three are in .* as before"):
        patch.setattr(Path, "rename", refuse)
        remove_drives(root, GONE)
    assert not check_all_or_none(root, before)


def test_permissions_are_looked_at_before_anything_is_touched(
    root: Path, monkeypatch: pytest.MonkeyPatch, verb: Callable[..., Said]
) -> None:
    before, access = files(root), os.access
    for name in ("runs/drive=three", "keyframes/drive=one", "joins/drive=three", "runs", ".cache"):
        place = root / name
        with monkeypatch.context() as patch:
            patch.setattr(os, "access", lambda path, mode, place=place: Path(path) != place and access(path, mode))
            said = verb("map", "remove", root, *GONE)
        assert f"no permission to change {place}. The map is as it was" in said.error
        assert files(root) == before
    assert sorted(drives_of(root)) == sorted(DRIVES)


def test_a_drive_comes_again_after_its_removal_was_killed(root: Path) -> None:
    map_store.Store(root).write_removed(["one"])
    assert sorted(drives_of(root)) == ["three", "two"]
    with map_store.writing(root) as store:
        put(store, "one", 9)
    assert drives_of(root)["one"] == {9}


@pytest.fixture(scope="module")
def server() -> Iterator[None]:
    with serving():
        yield


@pytest.mark.parametrize(("how", "steps_of"), [("once", (1, 3, 11, 1000)), ("for good", (1, 2, 5, 12))])
def test_a_removal_on_a_store_that_fails_anywhere_takes_all_or_none(
    server: None, monkeypatch: pytest.MonkeyPatch, how: str, steps_of: tuple[int, ...]
) -> None:
    outcomes = set[bool]()
    # two for the store's conditions, the snapshot, map.json, the drives' tables; none
    for step in steps_of:
        root: Any = located(f"s3://bucket/remove-{how.replace(' ', '-')}-{step}")
        make_map(root, DRIVES)
        left = [step]

        def stepping(function: Any, left: list[int] = left) -> Any:
            def asked(place: Any, *arguments: Any) -> Any:
                left[0] -= 1
                if left[0] == 0 or (left[0] < 0 and how == "for good"):
                    raise OSError("ACCESS_DENIED")
                return function(place, *arguments)

            return asked

        with map_store.writing(root):
            pass  # nothing is left to do
        with monkeypatch.context() as patch:
            for name in ("put_if", "remove", "send", "copy"):
                patch.setattr(objects, name, stepping(getattr(objects, name)))
            failed = False
            try:
                remove_drives(root, GONE)
            except VplogError as error:
                failed = True
                assert "ACCESS_DENIED" in str(error)
        found = sorted(drives_of(root))
        assert found in (["two"], sorted(DRIVES))
        with map_store.writing(root) as store:
            assert sorted(store.drives()) == found
        assert sorted(drives_of(root)) == found
        outcomes.add(found == ["two"])
        if found == ["two"]:
            left_there = [name for name in objects_below(root) if not name.startswith(("runs/", "rest/"))]
            assert not any("one" in name or "three" in name for name in left_there)
        assert failed or found == ["two"]
        assert not failed or found != ["two"] or how == "for good", "the next writer removes its tables"
    assert outcomes == {True, False}
