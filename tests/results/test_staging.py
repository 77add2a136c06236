"""A folder's results change as a whole, wherever a writer is killed or fails, and nothing else in it changes."""

from __future__ import annotations

import json
import os
import random
import signal
import sys
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from vplog.errors import ResultError, SettingsError, VplogError
from vplog.results import staging
from vplog.results.staging import recover, staged

if TYPE_CHECKING:
    from collections.abc import Callable

    from conftest import Said

OLD = {"run.json": "old", "a.parquet": "old", "b.parquet": "old", "east/a.parquet": "old", "west/a.parquet": "old"}
NEW = {"run.json": "new", "b.parquet": "new", "c.parquet": "new", "library/c.parquet": "new", "west/a.parquet": "new"}
OWN = {"notes.txt": "mine", "east/photo.png": "mine", "library/notes.txt": "mine", "d.parquet": "mine"}
RESULTS = [f"{folder}{name}" for folder in ("", "east/", "west/") for name in ("run.json", "[abc].parquet")]


def files(folder: Path) -> dict[str, str]:
    names = [path.relative_to(folder) for path in folder.rglob("*") if path.is_file()]
    return {name.as_posix(): (folder / name).read_text() for name in names if not name.parts[0].startswith(".")}


def put(folder: Path, tree: dict[str, str]) -> None:
    for name, text in tree.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(text)


def replace(out: Path) -> None:
    with staged(out, lambda: RESULTS) as made:
        put(made, NEW)


@pytest.fixture
def out(tmp_path: Path) -> Path:
    put(tmp_path / "out", OLD | OWN)
    return tmp_path / "out"


def test_new_results_replace_old_ones_and_nothing_else(out: Path) -> None:
    replace(out)
    assert files(out) == NEW | OWN
    assert not list(out.rglob(".*"))
    (out / "east" / "photo.png").unlink()
    with staged(out, lambda: RESULTS) as made:
        put(made, {"run.json": "third"})
    assert not (out / "west").exists(), "a folder of results alone goes with them"


EVENTS = ("os.rename", "os.remove", "os.mkdir", "os.rmdir", "open", "shutil.rmtree")


def killed(out: Path, after: int) -> bool:
    """Replace in a child process that is killed at its n-th change of a file; False where it came to its end."""
    child = os.fork()
    if child == 0:
        left = [after]

        def count(event: str, arguments: tuple[object, ...]) -> None:
            if event in EVENTS and (event != "open" or "w" in str(arguments[1])):
                left[0] -= 1
                if left[0] == 0:
                    os.kill(os.getpid(), signal.SIGKILL)

        sys.addaudithook(count)
        replace(out)
        os._exit(0)
    _, status = os.waitpid(child, 0)
    return os.WIFSIGNALED(status)


def test_killed_at_any_change_of_a_file(tmp_path: Path) -> None:
    """The next reader finds the old results or the new ones, the next writer writes; what is not ours stays."""
    found, ended = list[str](), False
    for after in range(1, 200):
        out = tmp_path / f"{after}" / "out"
        put(out, OLD | OWN)
        ended = not killed(out, after)
        recover(out if after % 2 else out / "west")
        assert files(out) in (OLD | OWN, NEW | OWN), f"killed at change {after}"
        found.append(files(out)["run.json"])
        replace(out)
        assert files(out) == NEW | OWN
        assert not list(out.rglob(".*"))
        if ended:
            break
    assert ended
    assert found == sorted(found, reverse=True), "old until the commit, new from then on"
    assert found.count("old") >= 5
    assert found.count("new") >= 8


CHANGES = ("replace", "rename", "unlink", "mkdir", "rmdir")


def test_any_change_of_a_file_may_fail(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """It is said in one line, and the old results or the new ones are there when the cause is gone."""
    errors = set[str]()
    left = [0]

    def failing(change: Callable[..., object]) -> Callable[..., object]:
        def call(path: Path, *arguments: object, **options: object) -> object:
            left[0] -= 1
            if left[0] == 0:
                raise OSError(28, "No space left on device", str(path))
            return change(path, *arguments, **options)

        return call

    for after in range(1, 100):
        out, left[0] = tmp_path / f"{after}" / "out", after
        put(out, OLD | OWN)
        with monkeypatch.context() as patch:
            for name in CHANGES:
                patch.setattr(Path, name, failing(getattr(Path, name)))
            try:
                replace(out)
            except (VplogError, OSError) as error:
                errors.add(type(error).__name__)
        recover(out)
        assert files(out) in (OLD | OWN, NEW | OWN), f"change {after} failed"
        replace(out)
        assert files(out) == NEW | OWN
        if left[0] > 0:
            break
    assert left[0] > 0
    assert "ResultError" in errors


@pytest.mark.parametrize("error", [KeyboardInterrupt, ResultError, MemoryError])
def test_what_fails_leaves_the_results_before(error: type[BaseException], out: Path, tmp_path: Path) -> None:
    for folder, known in ((out, OLD | OWN), (tmp_path / "none", None)):
        with pytest.raises(error), staged(folder, lambda: RESULTS) as made:
            put(made, NEW)
            raise error
        assert (files(folder) if folder.exists() else None) == known
        assert not list(tmp_path.rglob(".*"))


def test_one_writer_at_a_time(out: Path) -> None:
    with staged(out, lambda: RESULTS) as made:
        put(made, NEW)
        with pytest.raises(SettingsError, match=r"Another vplog process is writing to .*Wait"), staged(out, list):
            pass
        recover(out)  # a reader does not wait
        assert files(out) == OLD | OWN
    assert files(out) == NEW | OWN


def test_where_a_folder_may_be(tmp_path: Path, out: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """The folder itself keeps its place: it may be the current one, a link, or below one that cannot be written."""
    link, known = tmp_path / "link", out.stat().st_ino
    link.symlink_to(out)
    replace(link)
    assert link.is_symlink()
    monkeypatch.chdir(out)
    replace(Path())
    tmp_path.chmod(0o500)
    try:
        replace(out)
    finally:
        tmp_path.chmod(0o700)
    assert files(out) == NEW | OWN
    assert out.stat().st_ino == known
    (tmp_path / "empty").mkdir()
    replace(tmp_path / "empty")
    assert files(tmp_path / "empty") == NEW


def test_things_in_the_way_are_named_and_results_wait_for_them(out: Path) -> None:
    (out / "c.parquet").mkdir()
    with pytest.raises(ResultError, match=rf": {out}/c\.parquet: .*clear the way"):
        replace(out)
    with pytest.raises(ResultError, match="clear the way"):
        recover(out)
    (out / "c.parquet").rmdir()
    recover(out)
    assert files(out) == NEW | OWN


@pytest.mark.parametrize("stale", [["../mine.txt"], ["link/mine.txt"], ["{tmp}/mine.txt"], [3], {"a": 1}, "x", None])
def test_the_committed_results_of_a_stranger_lead_nowhere_else(stale: object, tmp_path: Path) -> None:
    """Neither what is to be removed nor where it is moved."""
    out, committed = tmp_path / "out", tmp_path / "out" / staging._COMMITTED
    put(tmp_path, {"mine.txt": "mine", "mine/mine.txt": "mine"})
    put(committed, {} if stale else {"link/mine.txt": "theirs"})
    committed.mkdir(parents=True, exist_ok=True)
    (out / "link").symlink_to(tmp_path / "mine")
    if stale:
        (committed / staging._STALE).write_text(json.dumps(stale).replace("{tmp}", str(tmp_path)))
    with pytest.raises(ResultError, match="vplog did not write it"):
        recover(out)
    assert files(tmp_path)["mine.txt"] == files(tmp_path)["mine/mine.txt"] == "mine"


@pytest.mark.parametrize("linked", ["", "sub"])
def test_links_to_committed_results_are_not_followed(linked: str, tmp_path: Path) -> None:
    out = tmp_path / "out"
    put(tmp_path, {"mine/mine.txt": "mine"})
    place = out / staging._COMMITTED / linked
    place.parent.mkdir(parents=True)
    place.symlink_to(tmp_path / "mine")
    try:
        recover(out)
    except ResultError as error:
        assert ("is a link" if linked else "did not write it") in str(error)
    assert files(tmp_path)["mine/mine.txt"] == "mine"


def test_random_trees_under_random_kills(tmp_path: Path) -> None:
    """Killed twice in a row, also while it recovers."""
    chance = random.Random(5)
    for number in range(25):
        out = tmp_path / f"{number}" / "out"
        put(out, OLD | OWN)
        for _ in range(2):
            killed(out, chance.randint(1, 45))
        recover(out)
        assert files(out) in (OLD | OWN, NEW | OWN)


def test_a_reader_mends_what_a_writer_was_killed_at(out: Path, verb: Callable[..., Said]) -> None:
    staging_folder = out / staging._STAGING
    put(staging_folder, {"run.json": '{"finished": false, "log": "/new.mcap"}'})
    staging._commit(out, RESULTS)
    for asked in (("evaluate", out, "--truth", "gps"), ("export", out, "--format", "tum", "-o", out / "x"),
                  ("report", out), ("explain", out, "--worst")):  # fmt: skip
        said = verb(*asked).error
        assert f"The run of /new.mcap in {out} did not finish. Go on with it: vplog run --resume -o {out}" in said
    assert files(out).keys() == {"run.json"} | OWN.keys()
