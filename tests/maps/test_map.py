"""What is in a map and where a log is in it, on maps put together from one finished run."""

from __future__ import annotations

import hashlib
import json
import shutil
import subprocess
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, cast

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from tests.joined import copied
from tests.maps.runs import map_of_run, put_rows
from vplog import logs
from vplog.data import Odometry
from vplog.execution.execution import Execution
from vplog.maps.search.query import MapQuery, search, select_views
from vplog.maps.search.sequences import LineSearch
from vplog.maps.storage import map_store
from vplog.maps.storage.layout import drive_names, folder_name, free_name
from vplog.pipeline import load_pipeline
from vplog.results import run_record, tables
from vplog.run.keyframes import KeyframeSettings
from vplog.storage.json_records import CHECKSUM

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    from vplog.stages import PlaceState
    from vplog.verbs.demo.record import Demo

    Verb = Callable[..., Said]


@pytest.fixture(scope="module")
def library(finished: Path) -> str:
    return json.loads((finished / "library" / "library.json").read_text())["hash"]


@pytest.fixture
def root(finished: Path, tmp_path: Path) -> Path:
    return map_of_run(tmp_path / "map", finished)


def test_a_map_tells_what_is_in_it(root: Path, finished: Path, library: str, verb: Verb) -> None:
    told = verb("map", "info", root, "--json").json
    every = len(pq.read_table(finished / "keyframes.parquet"))
    assert told["library"]["hash"] == library
    assert {one["drive"]: one["places"] for one in told["drives"]} == {
        "all": every,
        "back 1/2": every - 21,
        "ten": 10,
    }
    assert told["places"] == 2 * every - 11
    sizes = [path.stat().st_size for path in root.glob("descriptors/*/*.parquet")]
    assert told["descriptor_bytes"] == sum(sizes)
    assert told["bytes_per_place"] == pytest.approx(sum(sizes) / told["places"], abs=0.1)
    assert "3 drives" in verb("map", "info", root).out
    du = subprocess.run(["du", "-sk", root], capture_output=True, text=True, check=True).stdout
    assert told["bytes"] == 1024 * int(du.split()[0])


def test_a_drive_goes_with_its_folders(root: Path, verb: Verb) -> None:
    shutil.rmtree(root / "runs" / "drive=ten")
    told = verb("map", "info", root, "--json").json
    assert [one["drive"] for one in told["drives"]] == ["all", "back 1/2"]
    assert sum("drive=ten belongs to no drive" in problem for problem in told["problems"]) == len(map_store.TABLES)
    for folder in root.glob("*/drive=ten"):
        shutil.rmtree(folder)
    told = verb("map", "info", root, "--json").json
    assert not any("ten" in problem for problem in told["problems"])


def test_the_best_of_the_drives_are_those_of_one_index(root: Path, library: str) -> None:
    pipeline, store = load_pipeline("default"), map_store.Store(root)
    state = cast("PlaceState", pipeline.places.load(store.library(library), Execution()))
    views = state.from_arrow(tables.read_descriptors(store.run("all") / "descriptors.parquet")[0])
    names, known, owner, rows = list(store.drives()), [], [], []
    for number, name in enumerate(names):
        places = state.from_arrow(tables.read_descriptors(store.run(name) / "descriptors.parquet")[0])
        known += list(places)
        owner += [number] * len(places)
        rows += list(range(len(places)))
    index = state.index(known)
    answers, _ = search(store, store.drives(), state, views, MapQuery(7), LineSearch(), Execution(2))
    for at, view in enumerate(views):
        ranking = index.query(view, 7)
        count = answers.count[at]
        assert count == len(ranking.rows)
        assert np.array_equal(answers.score[at, :count], ranking.score)
        assert answers.drive[at, :count].tolist() == [owner[row] for row in ranking.rows]
        assert answers.keyframe[at, :count].tolist() == [rows[row] for row in ranking.rows]


@pytest.mark.parametrize(("count", "shift_ns"), [(1, 0), (3, 10**12)])
def test_without_two_frames_with_odometry_every_frame_is_a_query(count: int, shift_ns: int) -> None:
    """As of one image beside odometry, or where the clocks differ, which a warning says."""
    stamps = np.arange(count, dtype=np.int64) * 10**9
    odometry = Odometry(np.arange(5, dtype=np.int64) * 10**9 + shift_ns, np.tile(np.eye(4), (5, 1, 1)), None)
    log: Any = SimpleNamespace(name="log", odometry=lambda: odometry, stamps=lambda: stamps, file_names=lambda: None)
    found, keyframes, warnings = select_views(log, KeyframeSettings())
    assert (found.tolist(), keyframes) == (stamps.tolist(), None)
    assert len(warnings) == (count > 1)


def test_frames_without_odometry_are_searched_one_by_one(root: Path, drive: Demo, verb: Verb, tmp_path: Path) -> None:
    """They are not spaced evenly along the path, as those in a window of views are."""
    video = copied(drive.log, tmp_path / "video.mcap", lambda topic, _: topic not in ("/odom", "/gps/fix"))
    told = verb("map", "query", root, video, "--json").json
    assert told["sequence"] == 1
    assert any("--sequence" in text for text in told["warnings"])
    assert verb("map", "query", root, video, "--sequence", 5, "--json").json["sequence"] == 5


def test_a_drive_is_found_where_it_is(root: Path, drive: Demo, verb: Verb, tmp_path: Path) -> None:
    out, query = tmp_path / "placed.parquet", ("map", "query", root, drive.log, "--top", 3, "--sequence", 5)
    told = verb(*query, "-o", out, "--json", "--threads", 2).json
    table, digest = pq.read_table(out), hashlib.sha256(out.read_bytes()).hexdigest()
    assert table.to_pylist() == [{name: one[name] for name in table.column_names} for one in told["answers"]]
    assert told["answered"] == told["views"] > 30
    best = [answer for answer in told["answers"] if answer["rank"] == 0]
    assert all(answer["query_stamp_ns"] == answer["stamp_ns"] for answer in best if answer["drive"] == "all")
    assert sum(answer["keyframe"] == answer["query"] for answer in best) >= 0.9 * len(best)
    assert "views matched to a place" in verb(*query, "-o", out, "--threads", 1).out
    assert hashlib.sha256(out.read_bytes()).hexdigest() == digest


def test_a_picture_is_found(root: Path, finished: Path, drive: Demo, verb: Verb, tmp_path: Path) -> None:
    """At the keyframe that it shows."""
    stamps = pq.read_table(finished / "keyframes.parquet")["stamp_ns"].to_numpy()
    frame = next(iter(logs.open(drive.log).frames(stamps[30:31])))
    cv2.imwrite(str(tmp_path / "picture.png"), frame.decode().image)
    answers = verb("map", "query", root, tmp_path / "picture.png", "--top", 1, "--json").json["answers"]
    assert [(one["drive"], one["keyframe"], one["query_name"]) for one in answers] == [("all", 30, "picture.png")]


def test_places_of_another_library_are_refused(root: Path, finished: Path, drive: Demo, verb: Verb) -> None:
    with map_store.writing(root) as store:
        put_rows(store, "stranger", finished, "f" * 64)
    assert "places do not compare" in verb("map", "query", root, drive.log).error
    assert any("do not compare" in problem for problem in verb("map", "info", root, "--json").json["problems"])
    shutil.rmtree(root / "runs" / "drive=stranger")
    path = root / "runs" / "drive=all" / "descriptors.parquet"  # drive.json says one thing, the table another
    table = pq.read_table(path)
    path.unlink()
    pq.write_table(table.replace_schema_metadata({**table.schema.metadata, b"vplog.library": b"e" * 64}), path)
    assert "all is damaged and left out" in verb("map", "query", root, drive.log).err


def test_what_is_no_map_is_one_line(root: Path, verb: Verb) -> None:
    record = run_record.read_run_json(root / "map.json")
    for change, why in (({"format": 99}, "version 99"), ({"library": "../.."}, "lacks a valid library")):
        (root / "map.json").write_text(json.dumps({**record, **change}))
        assert why in verb("map", "info", root).error
    (root / "map.json").write_text("{")
    assert "is not JSON" in verb("map", "info", root).error


def test_names_are_of_the_log_and_stay() -> None:
    def named(names: str, paths: str, known: dict[str, tuple[str, str]], inputs: str | None = None) -> list[str]:
        told = {drive: {"log": log, "inputs": {"f": content}} for drive, (log, content) in known.items()}
        contents = [{"f": content} for content in (inputs or paths)]
        return drive_names(list(names), list(paths), told, contents)

    assert named("aab", "123", {}) == ["a", "a-2", "b"]
    known = {"a": ("1", "x"), "a-2": ("2", "y")}
    assert named("aa", "21", known) == ["a-2", "a"]
    assert named("a", "3", known, "y") == ["a-2"], "moved: known by its content"
    assert named("aa", "31", known, "zz") == ["a-3", "a"], "changed at its place, and a new one"
    assert named("b", "3", known, "y") == ["b"], "another name is another drive"
    assert drive_names([CHECKSUM], ["1"], {}, [{}]) == [f"{CHECKSUM}-2"], "a field of failures.json"


def test_drives_have_folders_of_their_own_where_a_disk_does_not_tell_cases_apart() -> None:
    """As those of macOS, Windows, exFAT and SMB do."""
    rng = np.random.default_rng(0)
    for _ in range(50):
        known = dict[str, dict[str, Any]]()
        for day in ("1", "2"):
            names = [str("".join(rng.permutation([*"aAbB-2"])[:3])) for _ in range(12)]
            paths, contents = [f"{day}/{at}" for at in range(12)], [{"f": f"{day} {at}"} for at in range(12)]
            found = drive_names(names, paths, known, contents)
            known |= {drive: {"log": path, "inputs": {}} for drive, path in zip(found, paths, strict=True)}
            assert drive_names(names, paths, known, contents) == found, "they stay"
        assert len({folder_name(drive).casefold() for drive in known}) == 24
    assert free_name("Drive", "/x/Drive.mcap", ["drive"]) == "Drive-2"
