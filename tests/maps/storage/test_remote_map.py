"""A map on an object store, against a server that speaks S3 on loopback."""

from __future__ import annotations

import json
import os
import random
import shutil
import subprocess
import sys
import threading
from datetime import UTC, datetime, timedelta
from itertools import count
from typing import TYPE_CHECKING, Any

import pyarrow.dataset as ds
import pytest
from pyarrow import fs

from tests.maps.bucket import serving
from tests.maps.runs import LIBRARY, PLACES, make_map, put, seeds
from vplog.errors import ResultError, SettingsError
from vplog.maps.info import describe_map
from vplog.maps.storage import lease_lock, map_store, objects, remote_map, upload
from vplog.maps.storage.contents import skip_damaged
from vplog.maps.storage.damage import UnreachableError
from vplog.storage.remote_path import located

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
    """Of the objects, without the two parts that are never the same."""
    return {name for name in objects.files_below(root) if name not in (".lock", "rest.json")}


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


def test_all_else_of_a_map_goes_with_it(root: Any) -> None:
    make_map(root, {"one": 1, "two": 2})

    def write(store: map_store.Store, text: str) -> None:
        for name in ("joins/drive=one/joins.parquet", "joins/drive=two/joins.parquet", "joint.json"):
            (store.root / name).parent.mkdir(parents=True, exist_ok=True)
            (store.root / name).write_text(text)

    with map_store.writing(root) as store:
        write(store, "1")
        put(store, "two", 2)
        assert not (store.run("two") / "trajectory.tum").exists(), "what was sent does not fill the disk"
        assert seeds(store.run("two")) == {2}
        assert (store.full_run("two") / "trajectory.tum").stat().st_size == store.sizes("two")["trajectory.tum"]
    with map_store.writing(root) as store:
        assert (store.root / "joins/drive=two/joins.parquet").read_text() == "1"
        write(store, "2")
    assert objects.get(root / "joins/drive=one/joins.parquet") == b"2"
    with map_store.writing(root) as store:
        map_store.remove(store, ["one"])
    with map_store.writing(root) as store:
        assert not (store.root / "joins/drive=one").exists()
        assert (store.root / "joins/drive=two/joins.parquet").read_text() == "2"
    assert not any("one" in name for name in names(root))
    assert len([name for name in names(root) if name.startswith("rest/")]) == 2


def test_a_writer_stopped_anywhere_leaves_the_old_drive_or_the_new(root: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Before one of its requests; then nothing more comes from it, not even that it gives the lock back."""
    make_map(root, {"one": 1})
    ticks = count()
    monkeypatch.setattr(lease_lock, "_release", lambda _: None)
    monkeypatch.setattr(lease_lock, "_started", lambda _: str(next(ticks)))  # every holder's process has ended
    before = len(names(root))
    # 8 files come first, then the manifest, 5 tables, and away with what was replaced
    for step in (9, 10, 15):
        with map_store.writing(root) as store, pytest.MonkeyPatch.context() as patch:
            left = [step]

            def stepping(function: Any, left: list[int] = left) -> Any:
                def asked(*arguments: Any) -> Any:
                    left[0] -= 1
                    if left[0] <= 0:
                        raise OSError("killed")
                    return function(*arguments)

                return asked

            for name in ("send", "copy", "remove"):
                patch.setattr(objects, name, stepping(getattr(objects, name)))
            patch.setattr(remote_map.Mirror, "write", stepping(remote_map.Mirror.write))
            patch.setattr(upload, "_SENT_AT_ONCE", 1)
            with pytest.raises(ResultError, match="killed"):
                put(store, "one", 9)
        [found] = same_state(root)["one"]
        assert found == (1 if step <= 9 else 9)
        if found == 9:
            with map_store.writing(root):
                pass  # what was left to do is done
            generation = json.loads(objects.get(root / "runs/drive=one/drive.json") or b"")["generation"]
            for table in map_store.TABLES:
                whole = objects.get(root / f"runs/drive=one/{generation}/{table}.parquet")
                assert objects.get(root / f"{table}/drive=one/{table}.parquet") == whole
            named = {name for name in names(root) if not name.startswith("runs/drive=one/")}
            of_drive = [name for name in names(root) if name.startswith(f"runs/drive=one/{generation}/")]
            assert len(named) + len(of_drive) + 1 == before
        if step == 10:
            with map_store.writing(root) as store:
                put(store, "one", 1)


def test_what_nobody_names_goes_after_a_day(root: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    make_map(root, {"one": 1, "two": 2})
    left = root / "runs" / "drive=one" / ("0" * 16) / "run.json"
    left.ask("put", b"{}")
    objects.remove(root / "runs" / "drive=two")
    with map_store.writing(root) as store:
        write_rest(store, "1")
    assert left.exists()
    assert any("two" in name for name in names(root))
    monkeypatch.setattr(upload, "_LEFT_OVER", -upload._LEFT_OVER)
    for _ in range(2):
        with map_store.writing(root) as store:
            assert (store.root / "joint.json").read_text() == "1", "which its manifest names"
    assert not any("0" * 16 in name or "drive=two" in name for name in names(root))
    assert same_state(root) == {"one": {1}}


def write_rest(store: map_store.Store, text: str, *more: str) -> None:
    for name in ("joins/drive=one/joins.parquet", "joint.json", *more):
        (store.root / name).parent.mkdir(parents=True, exist_ok=True)
        (store.root / name).write_text(text)


def test_what_joins_drives_is_kept_of_a_writer_that_fails(root: Any) -> None:
    make_map(root, {"one": 1})
    with pytest.raises(KeyboardInterrupt), map_store.writing(root) as store:
        write_rest(store, "1")
        raise KeyboardInterrupt
    with map_store.writing(root) as store:
        assert (store.root / "joint.json").read_text() == "1"
        write_rest(store, "2")
        store.flush()
        assert objects.get(root / "joint.json") == b"2", "before the writer's end"
        store.flush()
    assert len([name for name in names(root) if name.startswith("rest/")]) == 2


def test_data_sets_of_what_joins_drives_are_as_their_manifest(root: Any) -> None:
    """A writer is killed right behind the manifest; the next one does the rest."""
    make_map(root, {"one": 1})
    with map_store.writing(root) as store:
        write_rest(store, "1", "joint/component=a/poses.parquet")
    with pytest.MonkeyPatch.context() as patch, map_store.writing(root) as store:
        patch.setattr(upload, "_finish_rest", lambda *_: None)
        shutil.rmtree(store.root / "joint")
        write_rest(store, "2")
    assert objects.get(root / "joint.json") == b"1"
    with map_store.writing(root):
        pass
    assert objects.get(root / "joint.json") == b"2"
    assert not any(name.startswith("joint/") for name in names(root))
    assert len([name for name in names(root) if name.startswith("rest/")]) == 2
    [lost] = {name.split("/")[1] for name in names(root) if name.startswith("rest/")}
    objects.remove(root / "rest" / lost)
    with map_store.writing(root) as store:
        assert "is not there" in store.joint_damage
    with map_store.writing(root) as store:
        assert not store.joint_damage


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
        try:
            said.append(same_state(root)["one"])
        except ResultError as error:
            assert "replaced" in str(error), "which is said where a part was handed out before"
    writer.join()
    assert all(len(one) == 1 for one in said)
    assert len({seed for one in said for seed in one}) > 1
    assert same_state(root)["one"] == {5}
    assert len([name for name in names(root) if name.startswith("runs/")]) == 9


def test_a_reader_that_comes_late_takes_the_new_drive(root: Any) -> None:
    make_map(root, {"one": 1, "two": 2})
    with map_store.reading(root) as store:
        store.file("two", "run.json")
        with map_store.writing(root) as writer:
            put(writer, "one", 5)
            put(writer, "two", 5)
        assert seeds(store.run("one")) == {5}
        with pytest.raises(ResultError, match="replaced"):  # of which a part was handed out
            store.file("two", "keyframes.parquet")
        with map_store.writing(root) as writer:
            map_store.remove(writer, ["one"])
        store.evict("one")
        with pytest.raises(ResultError, match="removed"):
            store.run("one")


def test_two_writers(root: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """One gets in; where it dies on another machine the next one waits for its lease, and the dead may not go on."""
    make_map(root, {"one": 1})
    entered, refused, both = list[int](), list[str](), threading.Barrier(4, timeout=300)

    def enter(number: int) -> None:
        both.wait()
        try:
            with map_store.writing(root):
                entered.append(number)
                both.wait()
        except SettingsError as error:
            refused.append(str(error))
            both.wait()

    threads = [threading.Thread(target=enter, args=(number,)) for number in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert (len(entered), len(refused)) == (1, 3)
    assert all("Another vplog process" in text for text in refused)

    monkeypatch.setattr(lease_lock, "_release", lambda _: None)
    with map_store.writing(root) as gone:  # it ends without giving its lock back
        pass
    monkeypatch.setattr(lease_lock, "_machine", lambda: "another machine")
    with pytest.raises(SettingsError, match=r"expires within 1\d\d s"), map_store.writing(root):
        pass
    monkeypatch.setattr(lease_lock, "LEASE_S", -1.0)
    monkeypatch.setattr(lease_lock, "RENEWALS", -20)
    with map_store.writing(root) as store:
        put(store, "two", 2)
        lock = gone.mirror.lock  # pyrefly: ignore[missing-attribute]
        assert lock is not None
        lease_lock._write(lock, lease_lock._content(lock))
        gone.staging.mkdir(parents=True)
        with pytest.raises(ResultError, match="taken"):
            put(gone, "two", 3)
    shutil.rmtree(gone.root)
    assert same_state(root) == {"one": {1}, "two": {2}}


def test_a_writer_that_was_stopped_before_its_write_replaces_nothing(
    root: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Its lease ran out meanwhile, which it does not know: the store refuses each of its writes."""
    make_map(root, {"one": 1})
    monkeypatch.setattr(lease_lock, "_release", lambda _: None)
    with map_store.writing(root) as stopped:
        stopped.write_failures({"bad": {"log": "bad.mcap", "error": "old"}})
    monkeypatch.setattr(lease_lock, "_started", lambda _: "it has ended")
    with map_store.writing(root) as store:
        put(store, "one", 2)
        write_rest(store, "2")
        store.write_failures({"bad": {"log": "bad.mcap", "error": "new"}})
    monkeypatch.setattr(lease_lock.Lock, "check", lambda _: None)
    stopped.staging.mkdir(parents=True)
    with pytest.raises(ResultError, match=r"Another writer has replaced .*drive\.json"):
        put(stopped, "one", 3)
    with pytest.raises(ResultError, match=r"replaced .*drive\.json"):
        upload.relocate(stopped.mirror, "one", "elsewhere.mcap")  # pyrefly: ignore[bad-argument-type]
    with pytest.raises(ResultError, match=r"replaced .*failures\.json"):
        stopped.write_failures({})
    write_rest(stopped, "3")
    with pytest.raises(ResultError, match=r"replaced .*rest\.json"):
        stopped.flush()
    monkeypatch.undo()
    monkeypatch.setattr(lease_lock, "LEASE_S", 0.0)  # it sees that it slept for a lease, and asks
    with pytest.raises(ResultError, match="taken"):
        put(stopped, "two", 3)
    shutil.rmtree(stopped.root)
    assert same_state(root) == {"one": {2}}
    with map_store.reading(root) as store:
        store.mirror.rest()  # pyrefly: ignore[missing-attribute]
        assert (store.root / "joint.json").read_text() == "2"
        assert store.failures()["bad"]["error"] == "new"


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
    with pytest.raises(SettingsError, match="Cannot write"), map_store.writing(root):
        pass
    assert same_state(root) == {"one": {1}}


def test_a_lock_is_as_old_as_the_store_says(root: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    """Not as the clock of who asks."""
    make_map(root, {"one": 1})
    before = names(root)
    with map_store.writing(root):
        monkeypatch.setattr(objects, "server_time", lambda _: datetime.now(UTC) + timedelta(seconds=60))
        with pytest.raises(SettingsError, match=r"expires within [56]\d s"), map_store.writing(root):
            pass
        monkeypatch.undo()
        with pytest.raises(SettingsError, match="expires within 1"), map_store.writing(root):
            pass
    assert names(root) == before


KILLED = """
import os, signal, sys
from tests.maps.runs import put
from vplog.maps.storage import objects
from vplog.maps.storage import map_store as store
from vplog.storage.remote_path import located
with store.writing(located(sys.argv[1])) as writer:
    put(writer, "one", 2)
    send, sent = objects.send, []
    def some(*arguments):
        sent.append(arguments)
        if len(sent) == 5:
            os.kill(os.getpid(), signal.SIGKILL)
        return send(*arguments)
    objects.send = some
    put(writer, "two", 2)
"""


def test_a_killed_process_is_followed_at_once(root: Any, tmp_path: Path) -> None:
    make_map(root, {"one": 1})
    done = subprocess.run([sys.executable, "-c", KILLED, str(root)], check=False, env=dict(os.environ))
    assert done.returncode == -9
    assert same_state(root) == {"one": {2}}
    with map_store.writing(root) as store:
        put(store, "two", 3)
    assert same_state(root) == {"one": {2}, "two": {3}}


def test_what_is_no_map_is_one_line(root: Any, verb: Callable[..., Said]) -> None:
    assert "is not a map" in verb("map", "info", root).error
    (root / "thesis.txt").ask("put", b"no map")
    with pytest.raises(SettingsError, match=r"thesis\.txt"), map_store.writing(root):
        pass
    with pytest.raises(SettingsError, match="for reading"), map_store.writing(located("http://127.0.0.1:1/map")):
        pass
    with pytest.raises(SettingsError, match="Cannot write"), map_store.writing(located("s3://no-such-bucket/map")):
        pass
    place = root / "map"
    make_map(place, {"one": 1})
    manifest = place / "runs" / "drive=one" / "drive.json"
    sound = json.loads(objects.get(manifest) or b"")
    files = sound["files"]
    for change in (
        {"generation": "../../.."}, {"files": {"../../up": files["run.json"]}}, {"files": {"/up": files["run.json"]}},
        {"files": {"run.json": {"bytes": "many", "sha256": ""}}}, {"replaces": "../runs"}, {"files": []},
    ):  # fmt: skip
        manifest.ask("put", upload._json_of({**sound, **change}))
        assert "not a manifest" in verb("map", "info", place, "--json").json["damaged"]["one"]
    for about in ({"bytes": 3}, {"sha256": "0" * 64}):
        changed = {**files, "run.json": {**files["run.json"], **about}}
        manifest.ask("put", upload._json_of({**sound, "files": changed}))
        assert "does not have the length and sha256" in verb("map", "info", place, "--json").json["damaged"]["one"]
    manifest.ask("put", upload._json_of(sound))
    objects.remove(place / "runs" / "drive=one" / sound["generation"])
    assert "has lost files" in verb("map", "info", place, "--json").json["damaged"]["one"]


def _put_back(place: Any, data: bytes | None) -> None:
    if data is None:
        objects.remove(place)
    else:
        place.ask("put", data)


@pytest.mark.parametrize("how", ["flip", "gone", "longer", "manifest", "no manifest"])
def test_a_damaged_drive_is_left_out_and_published_again(
    root: Any, verb: Callable[..., Said], tmp_path: Path, how: str
) -> None:
    """It is named, the others are answered with, and its objects stay until it is there again."""
    root = root / how.replace(" ", "-")
    make_map(root, {"one": 1, "two": 2})
    run = root / "runs/drive=one"
    file = run / json.loads(objects.get(run / "drive.json") or b"")["generation"] / "descriptors.parquet"
    place = run / "drive.json" if "manifest" in how else file
    data = objects.get(place) or b""
    _put_back(place, {
        "flip": data[:40] + bytes([data[40] ^ 4]) + data[41:], "gone": None, "longer": data + b"x",
        "manifest": data[:-9], "no manifest": None,
    }[how])  # fmt: skip
    said = verb("map", "export", root, "-o", tmp_path / "places.parquet", "--json")
    assert (said.code, said.json["drives"]) == (0, ["two"]), said.err
    assert "one is damaged and left out" in said.json["warnings"][0]
    assert json.loads(verb("map", "info", root, "--check", "--json").out)["damaged_files"]
    said = verb("map", "merge", root, "-o", tmp_path / "merged", "--json")
    assert [one["drive"] for one in said.json["drives"]] == ["two"], said.err
    assert "one is damaged and left out" in said.json["warnings"][0]
    with map_store.writing(root) as store:
        assert "manifest" in how or store.damaged_files("one")
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


def _joined(root: Any) -> None:
    make_map(root, {"one": 1, "two": 2})
    with map_store.writing(root) as store:
        write_rest(store, "{}", "joint/component=a/poses.parquet", "joins/drive=two/joins.parquet")


def _flipped(data: bytes) -> bytes:
    at = data.index(b'"bytes": ') + 9
    return data[:at] + bytes([data[at] ^ 1]) + data[at + 1 :]


@pytest.mark.parametrize("how", ["cut", "flip", "object", "gone"])
def test_a_damaged_joint_record_stops_no_writer(root: Any, verb: Callable[..., Said], how: str) -> None:
    """It is named and dropped with the joint graphs; what is sound beside it stays where a manifest names it."""
    root = root / how
    _joined(root)
    manifest = objects.get(root / "rest.json") or b""
    place = root / "rest" / json.loads(manifest)["generation"] / "joint/component=a/poses.parquet"
    match how:
        case "cut":
            (root / "rest.json").ask("put", manifest[:-9])
        case "flip":
            (root / "rest.json").ask("put", _flipped(manifest))
        case "object":
            place.ask("put", b"other")
        case _:
            objects.remove(place)
    damaged = "rest.json" if how in ("cut", "flip") else "poses.parquet"
    with map_store.reading(root) as store, pytest.raises(ResultError, match=damaged):
        assert store.mirror is not None
        store.mirror.rest()
    said = verb("map", "remove", root, "two", "--json")
    assert (said.code, said.json["drives"]) == (0, ["one"]), said.err
    assert damaged in said.json["warnings"][0]
    assert "map join" in said.json["warnings"][0]
    with map_store.writing(root) as store:
        assert not store.joint_damage
        assert (store.root / "joins/drive=one/joins.parquet").exists() == (damaged != "rest.json")
        assert not (store.root / "joint.json").exists()
    assert not any(name.startswith(("joint", "joins/drive=two")) for name in names(root))
    assert verb("map", "remove", root, "one", "--json").json["warnings"] == []


def test_no_flip_of_a_manifest_is_silent(root: Any) -> None:
    make_map(root, {"one": 1})
    place, rng = root / "runs/drive=one/drive.json", random.Random(1)
    data = objects.get(place) or b""
    sound = remote_map.checked_manifest(data, place)
    for bit in rng.sample(range(8 * len(data)), 300):
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        try:
            found = remote_map.checked_manifest(bytes(damaged), place)  # one more where the checksum's name is hit
            assert {name: found[name] for name in sound} == sound, bit
        except ResultError:
            pass
