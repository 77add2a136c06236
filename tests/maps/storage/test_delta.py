"""Delta Lake tables of a map: delta-rs and DuckDB see whole drives, of one state of the map at a version."""

from __future__ import annotations

import json
import os
import re
import time
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from itertools import pairwise
from typing import TYPE_CHECKING, Any

import duckdb
import pyarrow as pa
import pytest

from tests.maps import runs
from tests.maps.bucket import serving
from tests.maps.runs import LIBRARY, PLACES, make_map, put
from vplog.errors import ResultError
from vplog.maps.storage import delta, delta_log, map_store, objects
from vplog.results import tables
from vplog.storage import remote_path
from vplog.storage.json_records import with_checksum
from vplog.storage.remote_path import located

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from conftest import Said

deltalake = pytest.importorskip("deltalake", reason="reads Delta Lake: pip install deltalake")


SEEDS = {"one": (1, 2, 3), "two/3 %": (2,), "four": (4,), "five": (5,)}
"""Of the drives here; of others their number."""
COUNTED = "select drive, count(*), typeof(any_value(keyframe)) from keyframes group by 1 order by 1"


@pytest.fixture(scope="module")
def server() -> Iterator[None]:
    with serving():
        yield


@pytest.fixture(params=["folder", "bucket"])
def root(request: pytest.FixtureRequest, tmp_path: Path) -> Any:
    """Of no map yet; each test has its own."""
    if request.param == "folder":
        return tmp_path / "map"
    request.getfixturevalue("server")
    return located(f"s3://bucket/{request.node.name.split('[')[0]}")


def opened(root: Any, name: str, version: int | None = None) -> Any:
    options = {"aws_endpoint_url": os.environ.get("AWS_ENDPOINT_URL", ""), "allow_http": "true"}
    return deltalake.DeltaTable(f"{root}/delta/{name}", version, options if "://" in str(root) else None)


@cache
def rows_of(drive: str, seed: int, name: str) -> str:
    """The rows of a table of a run, as Delta has them."""
    table = tables.read_arrow(runs._made(drive, seed, LIBRARY) / f"{name}.parquet")
    schema = delta_log.plain_schema(table.schema)
    columns = [table[column].cast(schema.field(column).type) for column in schema.names[1:]]
    return str(pa.Table.from_arrays(columns, schema.names[1:]).to_pylist())


def seen(root: Any, version: int | None = None) -> dict[str, int]:
    """The seed of each drive, of which all tables have all rows, at the newest version of keyframes or at this one."""
    version = opened(root, "keyframes").version() if version is None else version
    found = dict[str, set[tuple[str, int]]]()
    for name in map_store.TABLES:
        table = opened(root, name, version).to_pyarrow_table()
        found[name] = set()
        for drive in set(table["drive"].to_pylist()):
            own = str(
                table.filter(pa.array([one == drive for one in table["drive"].to_pylist()]))
                .drop_columns("drive")
                .to_pylist()
            )
            [seed] = [seed for seed in SEEDS.get(drive) or [int(drive[1:])] if rows_of(drive, seed, name) == own]
            found[name].add((drive, seed))
    assert all(one == found["keyframes"] for one in found.values()), (version, found)
    return dict(found["keyframes"])


def tables_by_drive(root: Any) -> set[str]:
    """Folders of the data sets of a folder for each drive."""
    return {
        f"{name}/{path.name}" for name in map_store.TABLES if (root / name).exists() for path in (root / name).iterdir()
    }


def test_others_read_a_map_at_a_version(root: Any, verb: Callable[..., Said], monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(delta, "_ALL_EVERY", 2)
    states = [{"one": 1, "two/3 %": 2}, {"one": 3, "four": 4}, {"one": 3, "four": 4, "five": 5}]
    make_map(root, states[0])
    told = verb("map", "delta", root, "--json").json
    assert {name: told[name] for name in ("version", "drives", "files")} == {"version": 0, "drives": 2, "files": 1}
    assert verb("map", "delta", root, "--json").json == told, "nothing is to do"
    with map_store.writing(root) as store:
        put(store, "one", 3)
        put(store, "four", 4)
        map_store.remove(store, ["two/3 %"])
    with map_store.writing(root) as store:
        put(store, "five", 5)
    assert [seen(root, version) for version in range(3)] == states
    assert tables_by_drive(root) == {f"{name}/drive={drive}" for name in map_store.TABLES for drive in states[2]}
    assert len(opened(root, "keyframes").file_uris()) == 2
    assert "version 3, 3 drives in 1 file each" in verb("map", "compact", root).out
    table = opened(root, "keyframes")
    assert (seen(root), len(table.file_uris())) == (states[2], 1)
    entry = (root / "delta" / "keyframes" / "_delta_log" / f"{3:020}.json").read_text()
    assert (entry.count('"dataChange": false'), entry.count('"dataChange": true')) == (3, 0), "no row is another"
    found = duckdb.connect().register("keyframes", table.to_pyarrow_dataset()).execute(COUNTED)
    assert found.fetchall() == [(drive, PLACES, "INTEGER") for drive in sorted(states[2])]
    for name in map_store.TABLES:
        text = opened(root, name).schema().to_json()
        assert "unsigned" not in text
        assert text.count('"drive"') == 1
    assert opened(root, "edges").metadata().partition_columns == []
    with map_store.writing(root) as store:
        assert delta.vacuum(store, time.time() - 3600) == {"objects": 0, "bytes": 0}
        assert delta.vacuum(store, time.time() + 3600)["objects"] >= 3 * len(map_store.TABLES)
        assert delta.vacuum(store, time.time() - 3600) == {"objects": 0, "bytes": 0}, "by fewer hours than before"
    assert seen(root) == states[2]
    with pytest.raises(Exception, match="No files"):
        opened(root, "keyframes", 1)
    with map_store.writing(root) as store:
        put(store, "one", 2)
        map_store.remove(store, ["four", "five"])
    assert seen(root) == {"one": 2}
    links = set() if "://" in str(root) else {f"{name}/drive=one" for name in map_store.TABLES}
    assert tables_by_drive(root) == links, "of a bucket the Delta tables alone are left"
    with map_store.writing(root) as store:
        map_store.remove(store, ["one"])
    assert seen(root) == {}


def test_a_writer_killed_anywhere_leaves_tables_of_one_state(root: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before one of its writes of the tables; the next writer makes them those of the map."""
    make_map(root, {"one": 1})
    with map_store.writing(root) as store:
        map_store.follow_with_delta(store, begin=True)
    # 5 files, the commit, 5 logs
    for step in (0, 4, 5, 6, 9, 10, 11):
        left, seed = [step], 2 + step % 2

        def stepping(function: Any, left: list[int] = left) -> Any:
            def asked(path: Any, *arguments: Any) -> Any:
                if re.search(r"(^|delta/)(commits|\w+/_delta_log|\w+/part-)", path.place[1]):
                    left[0] -= 1
                    if left[0] < 0:
                        raise OSError("killed")
                return function(path, *arguments)

            return asked

        before = seen(root)
        with monkeypatch.context() as patch:
            patch.setattr(objects, "put_if", stepping(objects.put_if))
            patch.setattr(remote_path, "send", stepping(remote_path.send))
            try:
                with map_store.writing(root) as store:
                    put(store, "one", seed)
            except ResultError as error:
                assert "killed" in str(error)
        assert seen(root) == (before if step < 11 else {"one": seed})
        with map_store.writing(root):
            pass
        assert seen(root) == {"one": seed}


@pytest.mark.parametrize("root", ["bucket"], indirect=True)
def test_writers_at_once_and_readers_meanwhile(root: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each makes a commit of each of its drives; none undoes what another did."""
    monkeypatch.setattr(delta, "PATIENCE_S", 0.0)
    monkeypatch.setattr(delta, "_ALL_EVERY", 3)
    make_map(root, {"d0": 0})
    with map_store.writing(root) as store:
        map_store.follow_with_delta(store, begin=True)

    def write(number: int) -> None:
        with map_store.writing(root) as store:
            for seed in (number, number + 4):
                put(store, f"d{seed}", seed)

    with ThreadPoolExecutor(4) as pool:
        writers, known = [pool.submit(write, number) for number in range(1, 5)], [{"d0"}]
        while not all(writer.done() for writer in writers):
            known.append(set(seen(root)))
        for writer in writers:
            writer.result()
    assert all(one <= other for one, other in pairwise(known))
    assert seen(root) == {f"d{seed}": seed for seed in range(9)}


def test_damaged_commits_are_one_line(tmp_path: Path, verb: Callable[..., Said]) -> None:
    root = make_map(tmp_path / "map", {"one": 1})
    verb("map", "delta", root)
    first = root / "delta" / "commits" / f"{0:020}.json"
    whole = first.read_text()
    for text in ("", "[]", whole[:-9], whole.replace('"one"', '"two"')):
        first.write_text(text)
        assert f"{root}/delta is damaged. Move it out of the map" in verb("map", "compact", root).error
    first.write_text(whole.replace('"format": 1', '"format": 2'))
    assert "is damaged" in verb("map", "delta", root).error, "its checksum is another"
    first.write_text(json.dumps(with_checksum({"format": 2})))
    assert "in version 2 of its format" in verb("map", "delta", root).error
