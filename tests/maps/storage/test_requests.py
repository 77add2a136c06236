"""How often a map on an object store is asked: a server answers each request in some 20 to 50 ms."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest

from tests.maps.bucket import counting, serving
from tests.maps.runs import put_rows
from tests.maps.storage.test_download_cache import fill
from vplog.maps.storage import map_store
from vplog.maps.storage.layout import folder_name
from vplog.maps.storage.remote_map import Mirror
from vplog.storage.remote_path import located

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from conftest import Said

DRIVES = (10, 100)


@pytest.fixture(scope="module")
def server() -> Iterator[None]:
    with serving():
        yield


@pytest.fixture(scope="module", params=DRIVES)
def root(server: None, finished: Path, request: pytest.FixtureRequest) -> Any:
    """Of so many drives: all but two are entries of the manifest alone, with the files of one of these."""
    library = json.loads((finished / "library" / "library.json").read_text())["hash"]
    root: Any = fill(located(f"s3://bucket/map{request.param}"), finished, library)
    with map_store.writing(root) as store:
        assert store.mirror is not None
        ten = store.mirror.drives["ten"]
        more = {
            drive: {**ten, "record": {**ten["record"], "drive": drive, "key": drive}}
            for drive in (f"d{number}" for number in range(request.param - 2))
        }
        store.mirror.commit("many", lambda snapshot: snapshot["drives"].update(more))
        data = (root / "runs" / folder_name("ten") / ten["generation"] / "descriptors.parquet").read_bytes()
        for drive in more:
            (root / "runs" / folder_name(drive) / ten["generation"] / "descriptors.parquet").ask("put", data)
    return root


def test_a_reader_asks_as_often_of_a_large_map(
    root: Any, verb: Callable[..., Said], tiny_drives: list[Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The manifest, and what is wanted of what it names."""
    with counting() as asked, monkeypatch.context() as patch:
        patch.setattr(Mirror, "fetch", None)  # no folder of a drive is made to tell of it
        assert verb("map", "info", root, "--json").json["places"] > 0
    assert asked.keys() == {"GET"}
    assert asked["GET"] <= 5, "map.json, the snapshot, its layers, and library.json"
    query = ("map", "query", root, tiny_drives[0] / "drive.mcap", "--cache", tmp_path, "--json")
    first = verb(*query).json
    with counting() as asked:
        assert verb(*query).json == first
    assert asked.keys() == {"GET"}
    assert asked["GET"] <= 4


def test_a_writer_asks_as_often_of_a_large_map(root: Any, finished: Path, verb: Callable[..., Said]) -> None:
    library = json.loads((finished / "library" / "library.json").read_text())["hash"]
    with counting() as asked, map_store.writing(root) as store:
        put_rows(store, "new", finished, library, slice(5, 20))
    assert asked.keys() == {"GET", "PUT", "COPY"}
    assert asked["GET"] <= 5, "two of them whether there are Delta tables"
    assert asked["COPY"] == len(map_store.TABLES)
    with counting() as asked:
        verb("map", "remove", root, "new")
    assert asked["LIST"] <= 5
    assert asked["GET"] <= 7
