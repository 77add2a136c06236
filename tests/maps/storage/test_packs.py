"""Small files of drives in packs: every answer is as before, and what is replaced goes by age."""

from __future__ import annotations

import json
import shutil
from typing import TYPE_CHECKING, Any

import pytest

from tests.maps.bucket import counting, serving
from tests.maps.runs import make_map, put, seeds
from tests.maps.storage.test_download_cache import fill
from vplog.errors import ResultError
from vplog.maps.storage import map_store, objects, packs, snapshot, upload
from vplog.storage.remote_path import located, objects_below
from vplog.storage.scratch import files_in

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from conftest import Said

    from vplog.maps.storage.remote_map import Mirror


@pytest.fixture(scope="module")
def server() -> Iterator[None]:
    with serving():
        yield


@pytest.fixture
def root(server: None, request: pytest.FixtureRequest) -> Any:
    """Of no map yet; each test has its own."""
    return located(f"s3://bucket/{request.node.name.split('[')[0]}")


def state(root: Any, **how: Any) -> dict[str, set[Any]]:
    """What the files of all drives say; each has the bytes that the manifest names."""
    with map_store.reading(root, **how) as store:
        return {drive: seeds(store.full_run(drive)) for drive in store.drives()}


def vacuum(root: Any) -> None:
    with map_store.writing(root) as store:
        upload.vacuum(store.mirror, -1.0)  # pyrefly: ignore[bad-argument-type]


def test_every_answer_is_as_before(
    root: Any, finished: Path, tiny_drives: list[Path], verb: Callable[..., Said], tmp_path: Path
) -> None:
    library = json.loads((finished / "library" / "library.json").read_text())["hash"]
    fill(root, finished, library)
    log = tiny_drives[0] / "drive.mcap"

    def answers() -> list[Any]:
        folder = tmp_path / "answers"
        folder.mkdir()
        told = [
            verb("map", "query", root, log, "--sequence", 1, "--cache-gb", 0, "--json"),
            verb("map", "query", root, log, "-o", folder / "answers.parquet", "--cache-gb", 0),
            verb("localize", root, log, "--json"),
            verb("map", "info", root, "--check", "--json"),
            verb("map", "export", root, "-o", folder / "places.parquet"),
            verb("map", "merge", root, "-o", folder / "merged"),
            verb("map", "condense", root, "-o", folder / "condensed"),
        ]
        assert [one.code for one in told if told.index(one) != 2] == [0] * 6, told
        bytes_of = {file: (folder / file).read_bytes() for file in files_in(folder)}
        shutil.rmtree(folder)
        return [[one.out for one in told], bytes_of]

    before = answers()
    told = verb("map", "compact", root, "--json").json
    assert (told["packs"], told["delta"]) == (1, None)
    assert told["files"] >= 14
    vacuum(root)
    assert not any(name.endswith("keyframes.parquet") for name in objects_below(root / "runs"))
    after = answers()
    assert after[0] == before[0]
    assert after[1].keys() == before[1].keys()
    assert [file for file in after[1] if after[1][file] != before[1][file]] == []
    assert verb("map", "compact", root).out == f"{root}: 0 files of drives put into 0 packs\n"


def test_packs_change_with_their_drives(root: Any, verb: Callable[..., Said], monkeypatch: pytest.MonkeyPatch) -> None:
    drives = {f"d{number}": number for number in range(6)}
    make_map(root, drives)
    before = {drive: {seed} for drive, seed in drives.items()}
    older = str(snapshot.Manifest(root).log[0]["version"])
    assert json.loads((root / "map.json").read_bytes())["format"] == snapshot.STORE_FORMAT
    with map_store.writing(root) as store:
        assert packs.compact(mirror(store)) == {"files": 6 * 7, "packs": 1}
    assert json.loads((root / "map.json").read_bytes())["format"] == snapshot.PACKED_FORMAT
    assert verb("map", "vacuum", root, "--hours", 24, "--json").json["objects"] == 0
    assert state(root) == state(root, as_of=older) == before
    with counting() as asked:
        state(root)
    assert asked["GET"] <= 4 + 2 * 7, "each section once, but for what is in two"
    with map_store.writing(root) as store:
        put(store, "d0", 9)
        map_store.remove(store, ["d1"])
    vacuum(root)
    before = {**before, "d0": {9}}
    del before["d1"]
    assert state(root) == before
    with map_store.writing(root) as store:
        map_store.remove(store, ["d2", "d3"])
        monkeypatch.setattr(packs, "_PACK_BYTES", 400_000)
        assert packs.compact(mirror(store))["packs"] == 1, "less than half of it is used"
    vacuum(root)
    assert len(objects_below(root / "packs")) == 1
    assert state(root) == {"d0": {9}, "d4": {4}, "d5": {5}}


def test_another_writer_meanwhile_and_one_that_is_killed(root: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """What changed while a pack was made is not taken from it; a pack that none names is vacuumed."""
    make_map(root, {"one": 1, "two": 2})
    send = objects.send

    def overtaken(*arguments: Any) -> Any:
        monkeypatch.setattr(objects, "send", send)
        with map_store.writing(root) as other:
            put(other, "one", 3)
        return send(*arguments)

    with map_store.writing(root) as store:
        monkeypatch.setattr(objects, "send", overtaken)
        packs.compact(mirror(store))
    assert state(root) == {"one": {3}, "two": {2}}
    entries = snapshot.Manifest(root).now["drives"]
    assert {drive: "pack" in entry["files"]["run.json"] for drive, entry in entries.items()} == {
        "one": False, "two": True,
    }  # fmt: skip

    def killed(*_: Any) -> None:
        raise OSError("killed")

    with monkeypatch.context() as patch, map_store.writing(root) as store:
        patch.setattr(snapshot.objects, "put_if", killed)
        with pytest.raises(ResultError, match="killed"):
            packs.compact(mirror(store))
    assert len(objects_below(root / "packs")) == 2
    vacuum(root)
    assert len(objects_below(root / "packs")) == 1
    assert state(root) == {"one": {3}, "two": {2}}


def test_a_damaged_pack_is_named(root: Any, verb: Callable[..., Said]) -> None:
    make_map(root, {"one": 1, "two": 2})
    verb("map", "compact", root)
    [token] = objects_below(root / "packs")
    whole = (root / "packs" / token).read_bytes()
    for data in (whole[: len(whole) // 2], bytes(len(whole)), whole[:-9] + b"\0" + whole[-8:]):
        (root / "packs" / token).ask("put", data)
        said = verb("map", "info", root, "--check")
        assert (said.code, "does not have the length and sha256" in said.err) == (1, True), said
    (root / "packs" / token).ask("delete")
    assert "is not there" in verb("map", "info", root, "--check").err


def mirror(store: map_store.Store) -> Mirror:
    assert store.mirror is not None
    return store.mirror
