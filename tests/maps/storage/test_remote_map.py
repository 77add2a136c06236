"""A map on an object store, against a server that speaks S3 on loopback."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import threading
import time
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import pyarrow.dataset as ds
import pytest
from pyarrow import fs

from tests.maps.bucket import counting, serving
from tests.maps.runs import LIBRARY, PLACES, make_map, put, seeds, write_run
from vplog.errors import ResultError, SettingsError
from vplog.maps.info import describe_map
from vplog.maps.joining import join
from vplog.maps.storage import delta, map_store, objects, snapshot, upload
from vplog.maps.storage.contents import damage_warnings, skip_damaged
from vplog.maps.storage.damage import UnreachableError
from vplog.pipeline import load_pipeline
from vplog.results import tables
from vplog.storage.remote_path import located, objects_below

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from conftest import Said


@pytest.fixture(scope="module")
def server() -> Iterator[None]:
    with serving():
        yield


@pytest.fixture
def root(server: None, request: pytest.FixtureRequest) -> Any:
    """Of no map yet; each test has its own."""
    return located(f"s3://bucket/{request.node.name.split('[')[0]}")


def names(root: Any) -> set[str]:
    """Of the objects, without the parts that are never the same."""
    return {name for name in objects_below(root) if not name.startswith((".", "snapshots/"))}


def entry(root: Any, drive: str) -> dict[str, Any]:
    """What the newest snapshot says of a drive."""
    return snapshot.Manifest(root).now["drives"][drive]


def write_anyway(root: Any, change: Callable[[dict[str, Any]], object]) -> None:
    """A snapshot as a stranger would write it."""
    made = snapshot.Manifest(root)
    made.commit("by hand", change)


def same_state(root: Any) -> dict[str, set[Any]]:
    """What the drives of a map say; every other object is one that they name."""
    with map_store.reading(root) as store:
        return {drive: seeds(store.run(drive)) for drive in store.drives()}


def test_a_map_is_there_as_it_is_in_a_folder(root: Any, tmp_path: Path) -> None:
    drives = {"one": 1, "two/3 %": 2}
    here, there = make_map(tmp_path / "map", drives), make_map(root, drives)
    with map_store.reading(here) as a, map_store.reading(there) as b:
        assert a.head() == b.head()
        records = {drive: {**record} for drive, record in a.drives().items()}
        for record in records.values():  # the manifest has them there
            assert record.pop("files").keys() >= {"run.json"}
        assert records == b.drives()
        assert b.library(LIBRARY).joinpath("library.json").read_bytes() == (
            a.library(LIBRARY).joinpath("library.json").read_bytes()
        )
        for drive in drives:
            assert a.sizes(drive) == {**b.sizes(drive), "drive.json": a.sizes(drive)["drive.json"]}
            assert a.rows("descriptors", drive) == b.rows("descriptors", drive) == PLACES
            for name in b.sizes(drive).keys() - {"drive.json"}:
                assert (b.full_run(drive) / name).read_bytes() == (a.run(drive) / name).read_bytes()
    system = fs.S3FileSystem(endpoint_override=os.environ["AWS_ENDPOINT_URL"])
    for name in map_store.TABLES:
        place = str(root / name).removeprefix("s3://")
        found = ds.dataset(place, partitioning="hive", filesystem=system, format="parquet").to_table()
        assert found.equals(ds.dataset(here / name, partitioning="hive", format="parquet").to_table())
    told, known = describe_map(there), describe_map(here)
    assert {**told, "map": "", "bytes": 0, "drives": []} == {**known, "map": "", "bytes": 0, "drives": []}


def rest_of(root: Any) -> dict[str, str]:
    """What joins the drives of a map, by name."""
    with map_store.reading(root) as store:
        assert store.mirror is not None
        store.mirror.rest()
        return {name: (store.root / name).read_text() for name in store.mirror.local_rest()}


def write_rest(store: map_store.Store, text: str, *more: str) -> None:
    assert store.mirror is not None
    store.mirror.rest()
    for name in ("joins/drive=one/joins.parquet", "joint.json", *more):
        (store.root / name).parent.mkdir(parents=True, exist_ok=True)
        (store.root / name).write_text(text)


def test_all_else_of_a_map_goes_with_it(root: Any) -> None:
    make_map(root, {"one": 1, "two": 2})
    two = "joins/drive=two/joins.parquet"
    with map_store.writing(root) as store:
        write_rest(store, "1", two)
        put(store, "two", 3)
        assert not (store.run("two") / "trajectory.tum").exists(), "what was sent does not fill the disk"
        assert seeds(store.run("two")) == {3}
        assert (store.full_run("two") / "trajectory.tum").stat().st_size == store.sizes("two")["trajectory.tum"]
    assert set(rest_of(root).values()) == {"1"}
    with map_store.writing(root) as store:
        write_rest(store, "2")
    assert rest_of(root) == {"joins/drive=one/joins.parquet": "2", "joint.json": "2", two: "1"}
    assert objects.get(root / "joins/drive=one/joins.parquet") == b"2"
    with map_store.writing(root) as store:
        map_store.remove(store, ["one"])
    assert rest_of(root) == {"joint.json": "2", two: "1"}
    assert not any("one" in name for name in names(root) if not name.startswith(("runs", "rest")))


def test_a_folder_beside_drives_is_removed_without_being_fetched(root: Any) -> None:
    make_map(root, {"a.b": 1})
    name = "joins/drive=a.b/match=one.parquet"
    with map_store.writing(root) as store:
        write_rest(store, "ledger", name)
    assert name in rest_of(root)
    with map_store.writing(root) as store:
        assert store.has_beside(name)
        store.remove_beside("joins/drive=a.b")
        assert not store.has_beside(name)
    assert name not in rest_of(root)


def test_a_writer_killed_anywhere_leaves_the_old_drive_or_the_new(root: Any) -> None:
    """Before one of its requests; then nothing more comes from it."""
    make_map(root, {"one": 1})
    # 7 files come first, then the snapshot, map.json, and 5 tables
    for step in (7, 8, 9, 10, 14):
        left = [step]

        def stepping(function: Any, left: list[int] = left) -> Any:
            def asked(*arguments: Any) -> Any:
                left[0] -= 1
                if left[0] < 0:
                    raise KeyboardInterrupt
                return function(*arguments)

            return asked

        with (
            pytest.MonkeyPatch.context() as patch,
            pytest.raises(KeyboardInterrupt),
            map_store.writing(root) as store,
        ):
            for name in ("send", "copy", "put_if"):
                patch.setattr(objects, name, stepping(getattr(objects, name)))
            patch.setattr(upload, "_SENT_AT_ONCE", 1)
            put(store, "one", 9)
        [found] = same_state(root)["one"]
        assert found == (1 if step < 9 else 9)
        with map_store.writing(root):
            pass  # what was left to do is done
        for table in map_store.TABLES:
            whole = objects.get(root / f"runs/drive=one/{entry(root, 'one')['generation']}/{table}.parquet")
            assert objects.get(root / f"{table}/drive=one/{table}.parquet") == whole
        if found == 9:
            with map_store.writing(root) as store:
                put(store, "one", 1)
    assert upload.vacuum(store.mirror, -1.0)["objects"] > 0  # pyrefly: ignore[bad-argument-type]
    assert len([name for name in names(root) if name.startswith("runs/drive=one/")]) == 7
    assert same_state(root) == {"one": {1}}


def test_what_no_snapshot_names_goes_by_age(
    root: Any, verb: Callable[..., Said], monkeypatch: pytest.MonkeyPatch
) -> None:
    make_map(root, {"one": 1, "two": 2})
    left = [root / "runs" / "drive=one" / ("0" * 16) / "run.json", root / "thesis.txt"]
    for place in left:
        place.ask("put", b"{}")
    with map_store.reading(root) as store, map_store.writing(root) as writer:
        write_rest(writer, "1")
        put(writer, "one", 3)
        map_store.remove(writer, ["two"])
        assert verb("map", "vacuum", root, "--json").json["objects"] == 0
        assert seeds(store.run("one")) == {1}, "a reader has its snapshot"
        assert seeds(store.run("two")) == {2}
    with map_store.reading(root) as store:
        assert verb("map", "vacuum", root, "--hours", 24, "--json").json["objects"] == 0
        with map_store.writing(root) as writer:
            put(writer, "one", 4)
            assert upload.vacuum(writer.mirror, -1.0)["objects"] > 16  # pyrefly: ignore[bad-argument-type]
        with pytest.raises(ResultError, match="replaced"):
            store.run("one")
    assert [place.exists() for place in left] == [False, True]
    assert not any("drive=two" in name for name in names(root))
    assert same_state(root) == {"one": {4}}
    assert rest_of(root)["joint.json"] == "1"
    monkeypatch.setattr(upload, "VACUUM_S", -1)
    with pytest.raises(ResultError, match="stopped for too long"), map_store.writing(root) as writer:
        put(writer, "two", 5)


def test_vacuum_removes_many_objects_with_few_requests(root: Any) -> None:
    make_map(root, {"one": 1})
    stale = [*(f"runs/drive=one/{'0' * 16}/{number}" for number in range(40)), "joint/none/graph.g2o"]
    parts = [f"part-{number}.parquet" for number in range(40)]
    for place in (*map(root.__truediv__, stale), *map((root / "delta" / "keyframes").__truediv__, parts)):
        place.ask("put", b"{}")
    with map_store.writing(root) as store, counting() as requests:
        assert upload.vacuum(store.mirror, -1.0)["objects"] >= 41  # pyrefly: ignore[bad-argument-type]
        assert delta.vacuum(store, time.time() + 10.0) == {"objects": 40, "bytes": 80}
    assert requests.total() < 30
    assert not names(root / "joint") | names(root / "delta")
    assert same_state(root) == {"one": {1}}
    for name in ("one", "two"):
        (root / "listed" / name).ask("put", b"")
    objects.delete(root / "listed", ["two", "three", "one"])
    assert not names(root / "listed")


def as_of(root: Any, then: str) -> dict[str, set[Any]]:
    """What the drives of a map said at a version or a time."""
    with map_store.reading(root, as_of=then) as store:
        return {drive: seeds(store.run(drive)) for drive in store.drives()}


def test_a_map_is_read_as_of_a_version_or_a_time_until_it_is_vacuumed(
    root: Any, verb: Callable[..., Said], monkeypatch: pytest.MonkeyPatch
) -> None:
    days = iter(range(1, 1000))
    monkeypatch.setattr(snapshot, "now", lambda: f"2026-01-{next(days):02}T12:00:00+00:00")
    monkeypatch.setattr(snapshot, "_MOST_CHANGES", 2)
    make_map(root, {"one": 1, "two": 2})
    with map_store.writing(root) as store:
        put(store, "one", 3)
        map_store.remove(store, ["two"])
    rows = verb("map", "log", root, "--json").json["snapshots"]
    states = {one["version"]: as_of(root, str(one["version"])) for one in rows}
    assert [state for number, state in sorted(states.items()) if state != states.get(number - 1)] == [
        {}, {"one": {1}}, {"one": {1}, "two": {2}}, {"one": {3}, "two": {2}}, {"one": {3}},
    ]  # fmt: skip
    assert {one["version"]: as_of(root, one["time"][:13]) for one in rows} == states
    assert as_of(root, rows[1]["time"].replace("T12:", "T13:")) == states[rows[1]["version"]]
    query = ("map", "query", root, root, "--cache-gb", 0, "--as-of")
    first, last = rows[-1]["time"], rows[0]["version"]
    said = f"has no snapshot as of {last + 1}, but versions 1 of {first} to {last} of {rows[0]['time']}: vplog map log"
    assert said in verb(*query, last + 1).error
    assert "has no snapshot as of 2025-12-31" in verb(*query, "2025-12-31").error
    assert "is no version and no time" in verb(*query, "yesterday").error
    with map_store.writing(root) as store:
        upload.vacuum(store.mirror, -1.0)  # pyrefly: ignore[bad-argument-type]
    assert f"What {root} was at 2 is removed" in verb(*query, 2).error
    assert as_of(root, str(snapshot.Manifest(root).log[0]["version"])) == {"one": {3}}


def test_what_joins_drives_is_kept_of_a_writer_that_fails(root: Any) -> None:
    make_map(root, {"one": 1})
    with pytest.raises(KeyboardInterrupt), map_store.writing(root) as store:
        write_rest(store, "1")
        raise KeyboardInterrupt
    assert rest_of(root)["joint.json"] == "1"
    with map_store.writing(root) as store:
        write_rest(store, "2")
        store.flush()
        assert objects.get(root / "joint.json") == b"2", "before the writer's end"
        before = snapshot.Manifest(root).log[0]
        store.flush()
        assert snapshot.Manifest(root).log[0] == before


def test_data_sets_of_what_joins_drives_are_as_their_manifest(root: Any) -> None:
    """A writer is killed right behind the manifest; the next one does the rest."""
    make_map(root, {"one": 1})
    with map_store.writing(root) as store:
        write_rest(store, "1", "joint/component=a/poses.parquet")
    with pytest.MonkeyPatch.context() as patch, map_store.writing(root) as store:
        patch.setattr(upload, "_copy", lambda *_: None)
        write_rest(store, "2")
        shutil.rmtree(store.root / "joint")
    assert objects.get(root / "joint.json") == b"1"
    with map_store.writing(root):
        pass
    assert objects.get(root / "joint.json") == b"2"
    assert not any(name.startswith("joint/") for name in names(root))


def test_a_store_that_copies_nothing_undoes_no_commit(root: Any) -> None:
    """The next writer copies."""

    def refused(*_: Any) -> None:
        raise OSError("SlowDown")

    make_map(root, {"one": 1, "two": 2})
    with pytest.MonkeyPatch.context() as patch, map_store.writing(root) as store:
        write_rest(store, "1")
        patch.setattr(objects, "copy", refused)
        patch.setattr(objects, "remove", refused)
        put(store, "three", 3)
        map_store.remove(store, ["two"])
    assert same_state(root) == {"one": {1}, "three": {3}}
    assert objects.get(root / "joint.json") is None
    with map_store.writing(root):
        pass
    assert objects.get(root / "joint.json") == b"1"
    assert {name.split("/")[0] for name in names(root / "keyframes")} == {"drive=one", "drive=three"}


def test_a_reader_never_sees_half_a_drive(root: Any) -> None:
    make_map(root, {"one": 1})
    over = threading.Event()

    def replace_often() -> None:
        try:
            with map_store.writing(root) as store:
                for seed in range(2, 6):
                    put(store, "one", seed)
        finally:
            over.set()

    writer, said = threading.Thread(target=replace_often), []
    writer.start()
    while not over.is_set():
        said.append(same_state(root)["one"])
    writer.join()
    assert all(len(one) == 1 for one in said)
    assert len({seed for one in said for seed in one}) > 1
    assert same_state(root)["one"] == {5}


def test_writers_do_not_exclude_each_other(root: Any) -> None:
    """What one does at the same time as another is done to what that one has made of the map."""
    make_map(root, {"one": 1, "two": 2})
    with map_store.writing(root) as a, map_store.writing(root) as b:
        put(a, "three", 3)
        put(b, "four", 4)
        map_store.annotate(a, "two", {"log": "elsewhere.mcap"})
        b.update_failures({"bad": {"log": "bad.mcap", "error": "b"}})
        a.update_failures({"worse": {"log": "worse.mcap", "error": "a"}})
        map_store.remove(b, ["one"])
        a.write_head(map_store.Head(LIBRARY, {"seed": 1}))
        assert a.drives().keys() == {"one", "two", "three"}, "and has the map as it was"
    assert same_state(root) == {"two": {2}, "three": {3}, "four": {4}}
    with map_store.reading(root) as store:
        assert store.failures().keys() == {"bad", "worse"}
        assert store.drives()["two"]["log"] == "elsewhere.mcap"
        assert store.head().settings == {"seed": 1}


def test_writers_that_begin_a_map_at_once_do_not_exclude_each_other(root: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """One comes between another's look for a map and for other things; a third was killed before there was a map."""
    (root / "snapshots" / "00000001-0.json.gz").ask("put", b"")
    below = upload.names_below

    def late(place: Any) -> dict[str, bool]:
        monkeypatch.setattr(upload, "names_below", below)
        make_map(root, {"one": 1})
        return below(place)

    monkeypatch.setattr(upload, "names_below", late)
    with map_store.writing(root) as store:
        assert store.drives().keys() == {"one"}
        put(store, "two", 2)
    assert same_state(root) == {"one": {1}, "two": {2}}


def test_what_two_writers_do_to_one_drive(root: Any) -> None:
    make_map(root, {"one": 1})
    with map_store.writing(root) as a, map_store.writing(root) as b:
        put(a, "one", 2)
        with pytest.raises(ResultError, match="Another writer has replaced one in"):
            put(b, "one", 3)
        with pytest.raises(ResultError, match="replaced one in"):
            map_store.annotate(b, "one", {"log": "elsewhere.mcap"})
        put(a, "new", 4)
        put(b, "new", 4)
        assert entry(root, "new") == a.mirror.drives["new"], "made from the same"  # pyrefly: ignore[missing-attribute]
        put(a, "drive", 5)
        put(b, "drive", 6)
        write_rest(a, "1")
        a.flush()
        write_rest(b, "2")
        with pytest.raises(ResultError, match="joined drives"):
            b.flush()
        b.mirror.refresh()  # pyrefly: ignore[missing-attribute]
        write_rest(b, "3")
        b.flush()
        with pytest.raises(ResultError, match=r"has given .* the library a"):
            a.write_head(map_store.Head("b" * 64, {}))
        a.write_head(map_store.Head(None, {"seed": 2}))  # as one that begins a map: another was faster
    assert same_state(root) == {"one": {2}, "new": {4}, "drive": {5}, "drive-2": {6}}
    assert snapshot.Manifest(root).now["library"] == LIBRARY
    assert rest_of(root)["joint.json"] == "3"


def test_a_drive_is_sent_by_one_machine_and_committed_by_another(root: Any, tmp_path: Path) -> None:
    """Also under another ID, where a third has put another drive of its own in."""
    make_map(root, {"one": 1})
    with map_store.writing(root) as a, map_store.writing(root) as b:
        made = {seed: write_run(tmp_path / f"{seed}", "drive", seed, LIBRARY) for seed in (5, 6, 7)}
        sent = {seed: upload.send_run(root, folder, time.time()) for seed, folder in made.items()}
        old = upload.SentRun(sent[7].entry, time.time() - upload.VACUUM_S + 3600)  # a day by a clock an hour ahead
        assert same_state(root) == {"one": {1}}
        for folder in made.values():
            shutil.rmtree(folder)
        assert map_store.publish(a, "drive", made[5], sent[5]) == "drive"
        assert map_store.publish(b, "drive", made[6], sent[6]) == "drive-2"
        assert (seeds(a.run("drive")), seeds(b.run("drive-2"))) == ({5}, {6})
        assert tables.read_keyframes(b.run("drive-2") / "keyframes.parquet")[0].drive == "drive-2"
        with pytest.raises(ResultError, match="stopped for too long"):
            map_store.publish(b, "other", made[7], old)
        upload.vacuum(b.mirror, -1.0)  # pyrefly: ignore[bad-argument-type]
    assert same_state(root) == {"one": {1}, "drive": {5}, "drive-2": {6}}
    assert len({name.split("/")[2] for name in names(root) if name.startswith("runs/")}) == 3
    with map_store.reading(root) as store:
        assert [store.damaged_files(drive) for drive in store.drives()] == [[], [], []]


def test_a_join_that_crosses_another_is_repeated(root: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """With the drives of the writer that was first, and what joins them."""
    make_map(root, {"one": 1})
    seen = list[set[str]]()

    def joined(work: Any, _: object) -> dict[str, Any]:
        seen.append(set(work.store.drives()))
        if len(seen) == 1:
            with map_store.writing(root) as other:
                put(other, "two", 2)
                write_rest(other, "theirs", "joins/drive=two/match=one.parquet")
        (work.store.root / "joint.json").write_text("ours")
        return {}

    monkeypatch.setattr(join, "_join", joined)
    monkeypatch.setattr(join, "read_drives", lambda *_: SimpleNamespace(joins=[]))
    with map_store.writing(root) as store:
        join.join(store, load_pipeline("default"))
    assert seen == [{"one"}, {"one", "two"}]
    assert set(rest_of(root).values()) == {"ours", "theirs"}
    assert objects.get(root / "joint.json") == b"ours"


def test_layers_say_what_was_written(root: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Changes of any number, by two writers in turn; a reader makes four requests."""
    make_map(root, {"one": 1})
    monkeypatch.setattr(snapshot, "_MOST_CHANGES", 3)
    writers, rng = [snapshot.Manifest(root) for _ in range(2)], random.Random(2)
    one, expected = writers[0].now["drives"]["one"], {"one"}
    for number in range(40):
        new = {f"d{rng.randrange(60)}" for _ in range(rng.choice((1, 1, 2, 20)))}
        gone = set(rng.sample(sorted(expected), min(len(expected), rng.choice((0, 1, 1, 2))))) - new
        expected = (expected | new) - gone

        def change(found: snapshot.Snapshot, new: set[str] = new, gone: set[str] = gone) -> None:
            found["drives"] |= {drive: {**one, "record": {**one["record"], "drive": drive}} for drive in new}
            for drive in gone:
                found["drives"].pop(drive, None)

        writers[number % 2].commit(f"{number}", change)
        with counting() as asked:
            found = snapshot.Manifest(root)
        assert found.now["drives"].keys() == expected
        assert asked.total() <= 4
    assert len(snapshot.Manifest(root).layers) == 2
    assert len(objects_below(root / "snapshots")) > 45
    with map_store.writing(root) as store:
        upload.vacuum(store.mirror, -1.0)  # pyrefly: ignore[bad-argument-type]
    assert len(objects_below(root / "snapshots")) <= 5
    assert snapshot.Manifest(root).now["drives"].keys() == expected


def test_a_store_that_decides_nothing_is_only_read(root: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """As one that takes no notice of conditions, or is told to make none."""
    make_map(root, {"one": 1})

    def put_anyway(path: Any, data: bytes, _: object) -> dict[str, str]:
        path.ask("put", data)
        return {"e_tag": "any"}

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(objects, "put_if", put_anyway)
        with pytest.raises(SettingsError, match="no conditional writes") as error, map_store.writing(root):
            pass
    assert "\n" not in str(error.value)
    monkeypatch.setenv("AWS_CONDITIONAL_PUT", "disabled")
    with pytest.raises(SettingsError, match="Cannot read or write"), map_store.writing(root):
        pass
    assert same_state(root) == {"one": {1}}


WRITERS = """
import json, os, signal, sys
import pyarrow, shutil, time
from tests.maps.runs import LIBRARY, put, write_run
from vplog.maps.storage import map_store, objects, upload
from vplog.storage.remote_path import located
pyarrow.array([])  # loads pandas, which takes half a second in each fork otherwise
root, plans = located(sys.argv[1]), json.loads(sys.argv[2])

def write(number, dies_at):
    left = [dies_at]
    def counted(function):
        def call(*arguments):
            left[0] -= 1
            if left[0] == 0:
                os.kill(os.getpid(), signal.SIGKILL)
            return function(*arguments)
        return call
    for name in ("send", "copy", "put_if", "get_with_version"):
        setattr(objects, name, counted(getattr(objects, name)))
    with map_store.writing(root) as store:
        for seed in range(2):
            drive = f"drive{number}-{seed}"
            if drive not in store.drives():
                made = write_run(store.staging / "made", drive, 10 * number + seed, LIBRARY)
                sent = upload.send_run(root, made, time.time())
                if seed:  # as if on another machine
                    shutil.rmtree(made)
                map_store.publish(store, drive, made, sent)
        if number < 3:
            put(store, "common", 99)

def begin(number, dies_at):
    if (pid := os.fork()) == 0:
        write(number, dies_at)
        os._exit(0)
    return pid

running = {begin(number, dies_at): number for number, dies_at in enumerate(plans)}
killed = 0
while running:
    pid, status = os.wait()
    number = running.pop(pid)
    if os.WIFSIGNALED(status):
        killed += 1
        running[begin(number, 0)] = number
    assert os.WIFSIGNALED(status) or status == 0, status
print(killed)
"""
"""The processes are forks, as each would import for a second."""


def test_ten_writers_at_once_lose_nothing(root: Any) -> None:
    """Killed at any of their requests and begun again; what a reader sees meanwhile is one of the snapshots."""
    make_map(root, {"one": 1})
    plans = [random.Random(number).randrange(3, 30) if number % 2 else 0 for number in range(10)]
    line = [sys.executable, "-c", WRITERS, str(root), json.dumps(plans)]
    writers = subprocess.Popen(line, stdout=subprocess.PIPE, text=True, env=dict(os.environ))
    seen = list[tuple[int, int]]()
    while writers.poll() is None:
        time.sleep(0.3)
        with map_store.reading(root) as store:
            assert store.mirror is not None
            seen.append((store.mirror.manifest.log[0]["version"], len(store.drives())))
            assert len(seeds(store.run(max(store.drives())))) == 1
    said = writers.communicate()[0]
    assert (writers.returncode, said) == (0, "5\n")
    expected = {f"drive{number}-{seed}": {10 * number + seed} for number in range(10) for seed in range(2)}
    assert same_state(root) == {"one": {1}, "common": {99}, **expected}
    rows = {row["version"]: row["drives"] for row in snapshot.Manifest(root).log}
    assert sorted(rows) == list(range(1, max(rows) + 1))
    assert len(set(seen)) > 3
    assert all(rows[version] == drives for version, drives in seen)


def test_what_is_no_map_is_one_line(root: Any, verb: Callable[..., Said]) -> None:
    assert "is not a map" in verb("map", "info", root).error
    (root / "thesis.txt").ask("put", b"no map")
    with pytest.raises(SettingsError, match=r"thesis\.txt"), map_store.writing(root):
        pass
    with pytest.raises(SettingsError, match="for reading"), map_store.writing(located("http://127.0.0.1:1/map")):
        pass
    with (
        pytest.raises(SettingsError, match="Cannot read or write"),
        map_store.writing(located("s3://no-such-bucket/map")),
    ):
        pass
    place = root / "map"
    make_map(place, {"one": 1})
    sound = entry(place, "one")
    files = sound["files"]

    def info(*more: str, **change: Any) -> Said:
        write_anyway(place, lambda found: found["drives"].update(one={**sound, **change}))
        return verb("map", "info", place, *more)

    head = objects.get(place / "map.json") or b""
    for change in (
        {"generation": "../../.."}, {"files": {"../../up": files["run.json"]}}, {"files": {"/up": files["run.json"]}},
        {"files": {"run.json": {"bytes": "many", "sha256": ""}}}, {"files": []},
        {"record": {**sound["record"], "drive": "two"}},
    ):  # fmt: skip
        write_anyway(place, lambda found, change=change: found["drives"].update(one={**sound, **change}))
        assert "is no snapshot" in verb("map", "info", place).error
        (place / "map.json").ask("put", head)
    for about in ({"bytes": 3}, {"sha256": "0" * 64}):
        changed = {**files, "run.json": {**files["run.json"], **about}}
        found = json.loads(info("--check", "--json", files=changed).out)
        assert "does not have the length and sha256" in found["damaged_files"][0]
    info()
    objects.remove(place / "runs" / "drive=one" / sound["generation"])
    assert "is not there" in json.loads(verb("map", "info", place, "--check", "--json").out)["damaged_files"][0]


def test_a_damaged_manifest_is_one_line(root: Any, verb: Callable[..., Said]) -> None:
    make_map(root, {"one": 1})
    [newest, *_] = snapshot.Manifest(root).log
    for name in ("map.json", newest["object"]):
        data, rng = objects.get(root / name) or b"", random.Random(1)
        for bit in rng.sample(range(8 * len(data)), 20):
            damaged = bytearray(data)
            damaged[bit // 8] ^= 1 << bit % 8
            (root / name).ask("put", bytes(damaged))
            said = verb("map", "info", root, "--json")  # a checksum's name may be hit
            assert said.error if said.code else said.json["places"] == PLACES
        (root / name).ask("put", data)
    assert same_state(root) == {"one": {1}}


def _put_back(place: Any, data: bytes | None) -> None:
    if data is None:
        objects.remove(place)
    else:
        place.ask("put", data)


@pytest.mark.parametrize("how", ["flip", "gone", "longer"])
def test_a_damaged_drive_is_left_out_and_published_again(
    root: Any, verb: Callable[..., Said], tmp_path: Path, how: str
) -> None:
    """It is named, the others are answered with, and its objects stay until it is there again."""
    root = root / how
    make_map(root, {"one": 1, "two": 2})
    place = root / "runs/drive=one" / entry(root, "one")["generation"] / "descriptors.parquet"
    data = objects.get(place) or b""
    _put_back(place, {
        "flip": data[:40] + bytes([data[40] ^ 4]) + data[41:], "gone": None, "longer": data + b"x",
    }[how])  # fmt: skip
    said = verb("map", "export", root, "-o", tmp_path / "places.parquet", "--json")
    assert (said.code, said.json["drives"]) == (0, ["two"]), said.err
    assert "one is damaged and left out" in said.json["warnings"][0]
    assert json.loads(verb("map", "info", root, "--check", "--json").out)["damaged_files"]
    said = verb("map", "merge", root, "-o", tmp_path / "merged", "--json")
    assert [one["drive"] for one in said.json["drives"]] == ["two"], said.err
    assert "one is damaged and left out" in said.json["warnings"][0]
    with map_store.writing(root) as store:
        assert store.damaged_files("one")
        assert store.damaged_files("two") == []
        put(store, "one", 3)
    assert same_state(root) == {"one": {3}, "two": {2}}


def test_a_store_that_cannot_be_reached_damages_no_drive(root: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    make_map(root, {"one": 1})

    def refused(*_: Any) -> str:
        raise OSError("connection reset")

    monkeypatch.setattr(objects, "fetch", refused)
    with map_store.reading(root) as store:
        with pytest.raises(UnreachableError, match="connection reset"):
            skip_damaged(store, lambda: (store.rows("keyframes", "one") and store.earth("one")) or store.run("one"))
        assert store.damaged == {}


@pytest.mark.parametrize("how", ["object", "gone"])
def test_a_damaged_joint_record_stops_no_writer(root: Any, verb: Callable[..., Said], how: str) -> None:
    """It is named and dropped with the joint graphs; what is sound beside it stays where a manifest names it."""
    root = root / how
    make_map(root, {"one": 1, "two": 2})
    poses = "joint/component=a/poses.parquet"
    with map_store.writing(root) as store:
        write_rest(store, "{}", poses, "joins/drive=two/joins.parquet")
    place = root / "rest" / snapshot.Manifest(root).now["rest"][poses]["generation"] / poses
    _put_back(place, b"other" if how == "object" else None)
    with pytest.raises(ResultError, match=r"poses\.parquet"):
        rest_of(root)
    said = verb("map", "remove", root, "two", "--json")
    assert (said.code, said.json["drives"]) == (0, ["one"]), said.err
    with map_store.writing(root) as store:
        assert store.mirror is not None
        store.mirror.rest()
        assert "poses.parquet" in store.mirror.rest_damage
        assert "map join" in damage_warnings(store)[0]
    assert rest_of(root) == {"joins/drive=one/joins.parquet": "{}"}
    assert not any(name.startswith(("joint", "joins/drive=two")) for name in names(root))
