"""Maps without the places that recognition can do without: what stays, and that they work on as before."""

from __future__ import annotations

import shutil
from dataclasses import replace
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import vplog
from tests.maps.bucket import serving
from tests.maps.joining.test_join import digests
from tests.maps.runs import write_run
from vplog.data import Boxes, Ranking
from vplog.execution.execution import Execution
from vplog.maps.condensation.own_queries import PASSES, OwnPlaces, later_passes, read_own_places
from vplog.maps.condensation.redundancy import OwnQueries, RemovalCandidates, remove_cross_validated, remove_redundant
from vplog.maps.condensation.references import removal_order
from vplog.maps.joining import candidate_drives
from vplog.maps.joining.candidate_drives import places_of
from vplog.maps.joining.joint_record import read_joint
from vplog.maps.search.query import open_map
from vplog.maps.storage import layout, map_store
from vplog.maps.storage.map_store import Store
from vplog.places.bobb import NO_REFERENCE
from vplog.places.code_search import build_lists
from vplog.results import tables
from vplog.results.run_record import write_run_json
from vplog.run.figures.closure_view import find_boxes
from vplog.testing.pictures import reference

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    from vplog.data import Reference

    Verb = Callable[..., Said]

HALVES = ("before", "after")


@pytest.fixture
def whole(halves: Path, tmp_path: Path) -> Path:
    """A map of two halves of a drive, joined."""
    return shutil.copytree(halves, tmp_path / "map", ignore=shutil.ignore_patterns("landmarks.parquet", ".cache"))


def line(rng: np.random.Generator, count: int, near: float) -> tuple[np.ndarray, OwnQueries]:
    """Places along a line that score by how near they are, with noise, each looked for among all others."""
    at = np.arange(count, dtype=np.float64)
    score = np.exp(-np.abs(at[:, None] - at) / 4) + rng.normal(0, 0.1, (count, count))
    np.fill_diagonal(score, -np.inf)

    def best(query: int, top: int) -> Ranking:
        rows = np.argsort(-score[query], kind="stable")[: min(top, count - 1)]
        return Ranking(rows.astype(np.int32), score[query, rows].astype(np.float32))

    def right(query: int, rows: np.ndarray) -> np.ndarray:
        return np.abs(at[rows] - at[query]) <= near

    return at, OwnQueries([best(query, 3) for query in range(count)], best, right)


@pytest.mark.parametrize("most", [0, 5])
def test_no_more_queries_are_lost_than_may_be(most: int) -> None:
    """Answers among the places that stay are those of a search among them alone, however short the lists were."""
    at, queries = line(np.random.default_rng(1), 60, 3.0)
    every = np.ones(60, np.bool_)
    removal = remove_redundant(queries, RemovalCandidates(np.zeros(60, np.int64), at, every, ~every), most)
    kept = every.copy()
    kept[removal.places] = False

    def answered(kept: np.ndarray) -> int:
        count = 0
        for query in range(60):
            rows = queries.deeper(query, 60).rows
            rows = rows[kept[rows]]
            count += bool(queries.right(query, rows[:1])[0])
        return count

    assert answered(every) - answered(kept) == removal.lost[-1] <= most
    assert 10 < len(removal.places) < 59
    rest = np.sort(removal.places[:10])
    assert np.diff(rest).min() > 1, "no gap is left while there are smaller ones"
    longer = remove_redundant(queries, RemovalCandidates(np.zeros(60, np.int64), at, every, ~every), most + 3)
    assert longer.places[: len(removal.places)].tolist() == removal.places.tolist()


def test_a_drive_not_seen_loses_no_more_than_is_stated() -> None:
    """Queries of the same places with noise of their own, in the mean over maps. Counted by the queries that choose,
    more are lost."""
    every, stated, unseen = np.ones(80, np.bool_), 4, {True: list[int](), False: list[int]()}
    for seed in range(12):
        rng = np.random.default_rng(seed)
        at, queries = line(rng, 80, 3.0)
        _, others = line(rng, 80, 3.0)
        about = RemovalCandidates(np.zeros(80, np.int64), at, every, ~every), stated
        for folds, removal in (
            (True, remove_cross_validated(queries, at % 2 == 0, *about)[0]),
            (False, remove_redundant(queries, *about)),
        ):
            kept = every.copy()
            kept[removal.places] = False
            rows = [others.deeper(query, 80).rows for query in range(80)]
            whole, small = (
                sum(bool(others.right(query, one[kept_of_it[one]][:1])[0]) for query, one in enumerate(rows))
                for kept_of_it in (every, kept)
            )
            unseen[folds].append(whole - small)
    assert np.mean(unseen[True]) <= stated < np.mean(unseen[False])


def test_references_go_by_how_many_each_place_is_left_with() -> None:
    """The only reference of a place outlasts one that many places name beside others."""
    references = np.array(
        [[0, 1, 2], [0, 1, 2], [0, 1, NO_REFERENCE], [0, 1, NO_REFERENCE], [3, NO_REFERENCE, NO_REFERENCE]], np.uint16
    )
    weights = np.where(references == NO_REFERENCE, 0, 9).astype(np.uint8)
    lists = build_lists(references, weights, np.zeros((*references.shape, 1), np.uint8), 5, 2)
    assert removal_order(lists, references_of("abcde")).tolist() == [4, 2, 0, 3, 1]


def test_references_go_at_even_steps_of_each_drive() -> None:
    """Of nine that all places name alike every other one, and none of two that are left at the end."""
    references = np.tile(np.arange(9, dtype=np.uint16), (4, 1))
    lists = build_lists(references, np.full((4, 9), 9, np.uint8), np.zeros((4, 9, 1), np.uint8), 9, 2)
    assert removal_order(lists, references_of("aaaaaaabb"))[:4].tolist() == [0, 2, 4, 6]
    assert sorted(removal_order(lists, references_of("aaaaaaaaa"))[:5].tolist()) == [0, 2, 4, 6, 8]


def references_of(drives: str) -> list[Reference]:
    """References of these drives, in their order."""
    return [replace(reference(0), drive=drive, stamp_ns=row) for row, drive in enumerate(drives)]


def test_places_that_later_drives_pass_without_finding_them_fade() -> None:
    """Those that come by looking the other way say nothing."""
    pose = np.tile(np.eye(4), (PASSES + 2, 1, 1))
    drive = np.arange(len(pose))
    places = OwnPlaces(
        [f"{one}" for one in drive], [pa.array([0])] * len(drive), drive.astype(np.int32), drive, drive * 0, pose
    )
    assert later_passes(places, 1.0).tolist() == [*range(PASSES + 1, -1, -1)]
    pose[-1, :3, :3] = np.diag([-1.0, 1.0, -1.0])
    pose[-2, 0, 3] = 2.0
    assert later_passes(places, 1.0)[0] == PASSES - 1


def test_a_condensed_map_works_as_before(whole: Path, halves: Path, tmp_path: Path, verb: Verb) -> None:
    small = tmp_path / "small"
    told = verb("map", "condense", whole, "-o", small, "--loss", "0.05", "--json").json
    assert told["places"]["before"] > told["places"]["after"] >= 2
    assert told["descriptor_bytes"]["before"] > told["descriptor_bytes"]["after"]
    assert told["recall"]["loss"] <= 0.05
    assert told["references"]["before"] > told["references"]["after"] >= 1
    assert told["library_bytes"]["before"] > 2 * told["library_bytes"]["after"]
    sizes = {one["drive"]: one["places"] for one in told["drives"]}
    for drive in HALVES:
        check_rows(whole, small, drive, sizes[drive]["after"])
    info = verb("map", "info", small, "--check", "--json").json
    assert (info["problems"], info["places"]) == ([], told["places"]["after"])
    log = halves.parent / "after.mcap"
    for length in (1, 5):
        answers = verb("map", "query", small, log, "--sequence", length, "--json").json["answers"]
        for one in answers:
            keyframe, stamp_ns = kept_of(small, one["drive"])
            assert one["stamp_ns"] == stamp_ns[keyframe.tolist().index(one["keyframe"])]
        assert {one["rank"] for one in answers} >= {0, 1}
        assert {one["p_match"] is None for one in answers if one["rank"]} == {True}
        known = [one["p_match"] for one in answers if not one["rank"] and one["p_match"] is not None]
        assert all(0 <= one <= 1 for one in known)
    with map_store.reading(small) as store:
        state = open_map(store, Execution())[2]
        for drive in HALVES:  # a new drive is searched among all keyframes
            assert len(places_of(store, drive, state)) == kept_of(small, drive)[0][-1] + 1
    places = verb("map", "export", small, "-o", tmp_path / "places.parquet", "--json").json
    assert places["places"] == told["places"]["after"]
    whole_joins = digests(whole)
    assert digests(small) == whole_joins
    assert verb("map", "join", small, "--json").json["searched"] == []
    assert digests(small) == whole_joins
    logs = [halves.parent / f"{drive}.mcap" for drive in HALVES]
    states = vplog.batch(logs, small, settings={"library.size": 12})["drives"]
    assert [one["state"] for one in states] == ["unchanged"] * 2
    merged = tmp_path / "merged"
    verb("map", "merge", small, "-o", merged)
    assert verb("map", "info", merged, "--json").json["places"] == told["places"]["after"]
    again = verb("map", "condense", small, "-o", tmp_path / "again", "--loss", "0.05", "--json").json
    assert again["places"]["after"] <= told["places"]["after"]
    assert "holds a map already" in verb("map", "condense", whole, "-o", small).error


def kept_of(root: Path, drive: str) -> tuple[np.ndarray, np.ndarray]:
    path = Store(root).file(drive, "descriptors.parquet")
    return tables.read_pictures(path)[0], tables.read_stamps(path)


def check_rows(whole: Path, small: Path, drive: str, count: int) -> None:
    """The rows that stay are as they were but for references that are gone, and so are all other files."""
    before, after = (pq.read_table(Store(root).file(drive, "descriptors.parquet")) for root in (whole, small))
    assert len(after) == count
    assert after.schema.equals(before.schema)
    assert after.drop_columns("descriptor").equals(before.drop_columns("descriptor").take(after["keyframe"]))
    was, now = (named(root, table["descriptor"].to_pylist()) for root, table in ((whole, before), (small, after)))
    left = {reference for row in now for reference in row}
    for row, keyframe in zip(now, after["keyframe"].to_pylist(), strict=True):
        assert row == {reference: found for reference, found in was[keyframe].items() if reference in left}
    ledgers = [pq.read_table(Store(root).run(drive) / "closures.parquet") for root in (whole, small)]
    assert ledgers[0].equals(ledgers[1])
    assert ledgers[1].schema.metadata[b"vplog.library"] == after.schema.metadata[b"vplog.library"]
    changed = ("drive.json", "run.json", "descriptors.parquet", "closures.parquet")
    for path in Store(whole).run(drive).iterdir():
        if path.is_file() and path.name not in changed:
            assert (Store(small).run(drive) / path.name).read_bytes() == path.read_bytes()


def named(root: Path, places: list[dict[str, list[int]]]) -> list[dict[Any, tuple[int, list[int]]]]:
    """Weight and boxes of each reference of places, by the image that it is."""
    with map_store.reading(root) as store:
        table = pq.read_table(store.library(str(store.head().library)) / "references.parquet")
    images = list(zip(table["drive"].to_pylist(), table["stamp_ns"].to_pylist(), strict=True))
    return [
        {
            images[number]: (place["weights"][rank], place["boxes"][9 * rank : 9 * rank + 9])
            for rank, number in enumerate(place["references"])
            if number < len(images)
        }
        for place in places
    ]


@pytest.mark.parametrize("first", [[0, 1, 2, 3], [0, 1], [0, 2], [1, 3], [2]])
def test_the_first_camera_has_a_place_at_each_keyframe_beside_others(
    first: list[int], monkeypatch: pytest.MonkeyPatch
) -> None:
    """Those of four that it has after a condensation, and two pictures of the second camera."""
    nearest = tables.on_keyframes(np.array(first, np.int32))
    rows = {0: (slice(0, len(first)), nearest), 1: (slice(len(first), len(first) + 2), None)}
    column = pa.array([*first, 100, 101])
    monkeypatch.setattr(candidate_drives, "read_column", lambda *_: column)
    monkeypatch.setattr(candidate_drives, "rows_on_keyframes", lambda *_: rows)
    store: Any = SimpleNamespace(rows=lambda *_: 4)
    state: Any = SimpleNamespace(from_arrow=lambda one: one.to_pylist())
    places = places_of(store, "drive", state)
    assert places[4:] == [100, 101]
    assert all(abs(place - row) == min(abs(row - one) for one in first) for row, place in enumerate(places[:4]))


def test_closures_have_the_numbers_of_the_references_that_are_left(tmp_path: Path) -> None:
    path, rng = write_run(tmp_path / "run", "drive") / "closures.parquet", np.random.default_rng(5)
    before, about = pq.read_table(path), tables.read_metadata(path)
    shared = [np.unique(rng.integers(0, 9, count)).astype(np.uint16) for count in rng.integers(0, 6, len(before))]
    overlap = [rng.random(len(one)).astype(np.float32) for one in shared]
    closures = replace(tables.read_closures(path), shared_references=shared, shared_overlap=overlap)
    keyframes = tables.read_keyframes(tmp_path / "run" / "keyframes.parquet")[0]
    tables.write_closures(path, closures, keyframes, tables.TableMetadata({}, about["vplog.library"]))
    before, left = pq.read_table(path), [1, 4, 8]
    tables.renumber_references(path, np.array([-1, 0, -1, -1, 1, -1, -1, -1, 2]), "another")
    after, found = pq.read_table(path), tables.read_closures(path)
    names = ["shared_references", "shared_overlap"]
    assert after.schema.equals(before.schema)
    assert after.drop_columns(names).equals(before.drop_columns(names))
    assert tables.read_metadata(path)["vplog.library"] == "another"
    for row, (known, share) in enumerate(zip(shared, overlap, strict=True)):
        there = np.isin(known, left)
        assert [left[number] for number in found.shared_references[row]] == known[there].tolist()
        np.testing.assert_array_equal(found.shared_overlap[row], share[there])
    boxes = Boxes(np.array([1, 4]), np.zeros((2, 1, 4)))
    state: Any = SimpleNamespace(boxes=lambda _: boxes)
    assert find_boxes(state, None, None, [8]) == [], "a view described again may have other references"


def test_drives_that_nothing_joins_are_condensed_each_for_itself(whole: Path, tmp_path: Path, verb: Verb) -> None:
    apart = shutil.copytree(whole, tmp_path / "apart", ignore=shutil.ignore_patterns("joint.json", "joint"))
    told: dict[str, Any] = verb("map", "condense", apart, "-o", tmp_path / "small", "--json").json
    assert told["queries"]["by_other_drives"] == 0
    assert any("No drives are joined" in line for line in told["warnings"])
    assert all(one["places"]["after"] for one in told["drives"])


def test_a_map_none_of_whose_places_finds_another_is_not_condensed(whole: Path, tmp_path: Path, verb: Verb) -> None:
    assert "No place of" in verb("map", "condense", whole, "-o", tmp_path / "small", "--distance-m", "1e-9").error
    assert not (tmp_path / "small").exists()


def test_photos_say_nothing_of_the_spacing_of_keyframes(whole: Path) -> None:
    """They have no poses; more of them than keyframes used to make it 0 m."""
    with map_store.reading(whole) as store:
        drives, _, state = open_map(store, Execution())
        alone = read_own_places(store, {"after": drives["after"]}, state)
        photos = {**drives, "before": {**drives["before"], layout.PICTURES: True}}
        beside = read_own_places(store, photos, state)
    assert beside.spacing_m == alone.spacing_m > 0
    assert ((beside.frame < 0) == (beside.drive == beside.drives.index("before"))).all()


def test_drives_that_came_since_the_whole_was_solved_are_in_its_frame(whole: Path, tmp_path: Path, verb: Verb) -> None:
    def queries(name: str) -> dict[str, Any]:
        return verb("map", "condense", whole, "-o", tmp_path / name, "--json").json["queries"]

    solved = queries("solved")
    assert solved["by_other_drives"] > 0
    record = {name: value for name, value in read_joint(whole).items() if name != "record_sha256"}
    component = record["groups"][0]["components"][0]
    shutil.copytree(whole / "joint" / component["folder"], whole / "joint" / "component=grown")
    component["grown"] = {component["drives"][-1]: "component=grown"}
    write_run_json(whole / "joint.json", record)
    assert queries("grown") == solved


def test_a_map_on_a_store_is_condensed_as_a_folder_is(whole: Path, tmp_path: Path, verb: Verb) -> None:
    def condensed(root: Any, target: Any) -> dict[str, Any]:
        told = verb("map", "condense", root, "-o", target, "--loss", "0.05", "--json").json
        return {name: told[name] for name in ("places", "references", "library_bytes", "recall")}

    here = [condensed(whole, tmp_path / "small"), condensed(tmp_path / "small", tmp_path / "smaller")]
    with serving():
        there = [condensed(whole, "s3://bucket/small"), condensed("s3://bucket/small", "s3://bucket/smaller")]
        info = verb("map", "info", "s3://bucket/smaller", "--check", "--json").json
        compared = verb("diff", "s3://bucket/small", "s3://bucket/smaller", "--json")
    assert there == here
    assert compared.code == 0, compared.error
    assert info["problems"] == info["damaged_files"] == []
    assert [sorted(one["drives"]) for one in info["components"]] == [sorted(HALVES)]


def test_a_map_that_was_not_condensed_to_its_end_says_so(
    whole: Path, tmp_path: Path, verb: Verb, monkeypatch: pytest.MonkeyPatch
) -> None:
    small, publish, count = tmp_path / "small", map_store.publish, iter(range(9))

    def killed(*arguments: Any) -> str:
        if next(count) == 1:
            raise KeyboardInterrupt
        return publish(*arguments)

    monkeypatch.setattr(map_store, "publish", killed)
    assert verb("map", "condense", whole, "-o", small).code == 130
    monkeypatch.undo()
    failures = verb("map", "info", small, "--json").json["failures"]
    assert set(failures) == set(HALVES)
    assert verb("map", "condense", whole, "-o", small, "--json").json["places"]["after"] > 0
    info = verb("map", "info", small, "--check", "--json").json
    assert (info["failures"], info["problems"], len(info["drives"])) == ({}, [], 2)
