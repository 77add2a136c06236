"""The index of a map on disk: the best places are those of Eq. (1) over all, whatever the index went through."""

from __future__ import annotations

import os
import shutil
import zlib
from concurrent.futures import ProcessPoolExecutor, ThreadPoolExecutor
from dataclasses import replace
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from tests.benchmarks.scale import made_up_library, write_drive
from tests.benchmarks.search import Places, make_places, plain_scores
from vplog.errors import ResultError
from vplog.execution.execution import Execution
from vplog.maps.search import exact as map_search
from vplog.maps.search import index as map_index
from vplog.maps.search import query as map_query
from vplog.maps.search import sequences
from vplog.maps.search.exact import RankedPlaces, best_places, no_answers
from vplog.maps.search.index import update_index
from vplog.maps.search.query import MapQuery, search
from vplog.maps.search.segment import open_segment
from vplog.maps.search.sequences import LineSearch, drives_by_votes
from vplog.maps.storage.map_store import Store
from vplog.places.bobb import NO_BOX, BobbSettings, BobbState, Place
from vplog.places.sequence import SequenceSettings

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.stages import PlaceState

SETTINGS = BobbSettings(references=4, windows_along=2)
LIBRARY = 30
TOP = 6


@pytest.fixture(scope="module")
def state() -> BobbState:
    return made_up_library(SETTINGS, LIBRARY)


class Map:
    """A map, and all its places beside it."""

    def __init__(self, root: Path, state: BobbState) -> None:
        self.store, self.state, self.places = Store(root), state, dict[str, Places]()

    def put(self, number: int, count: int, seed: int | None = None) -> None:
        """A drive, also in place of the one it was; weights are few, so that scores tie."""
        length = max(count, 1)
        places = make_places(length, SETTINGS, number if seed is None else seed, LIBRARY, length).rows(slice(count))
        weights, boxes = np.maximum(places.weights // 100 * 100, 100), places.boxes // 20 * 20
        places = Places(places.references, weights, np.where(boxes < 60, boxes, NO_BOX).astype(np.uint8))
        self.places[f"drive-{number:09d}"] = places
        write_drive(self.store, number, places, self.state)

    def take(self, number: int) -> None:
        shutil.rmtree(self.store.run(f"drive-{number:09d}"))
        del self.places[f"drive-{number:09d}"]

    def views(self, count: int) -> list[Place]:
        """Some from the map, some not."""
        new = make_places(count, SETTINGS, 1000, LIBRARY, 1)
        known = [one for one in self.places.values() if len(one)]
        every = [new if n % 2 else known[n % len(known)] for n in range(count)]
        rows = [n % len(one) for n, one in enumerate(every)]
        return [Place(p.references[r], p.weights[r], p.boxes[r]) for p, r in zip(every, rows, strict=True)]

    def expected(self, view: Place, top: int = TOP) -> list[tuple[float, int, int]]:
        scored = []
        for number, drive in enumerate(sorted(self.places)):
            scores = plain_scores(self.places[drive], view, SETTINGS, SETTINGS.pairing)
            scored += [(-float(score), number, row) for row, score in enumerate(scores) if score > 0]
        return sorted(scored)[:top]

    def update(self, threads: int = 1) -> tuple[list[map_index.SegmentView], list[str]]:
        return update_index(self.store, self.store.drives(), self.state, Execution(threads))

    def check(self, threads: int = 1) -> list[map_index.SegmentView]:
        """The index says what brute force does; its parts."""
        parts, warnings = self.update(threads)
        assert not warnings
        views = self.views(8)
        found = best_places(parts, self.state, views, TOP, Execution(threads))
        for at, view in enumerate(views):
            assert told(found, at) == self.expected(view)
        assert sum(part.places for part in parts) == sum(map(len, self.places.values()))
        return parts

    def files(self) -> dict[str, bytes]:
        return {path.name: path.read_bytes() for path in self.store.index.iterdir()}


def told(found: RankedPlaces, view: int) -> list[tuple[float, int, int]]:
    columns = (-found.score[view], found.drive[view], found.keyframe[view])
    return list(zip(*(part[: found.count[view]].tolist() for part in columns), strict=True))


@pytest.fixture
def made(tmp_path: Path, state: BobbState) -> Map:
    """Five drives, one without a place."""
    result = Map(tmp_path / "map", state)
    for number, count in enumerate((0, 40, 25, 3, 60)):
        result.put(number, count)
    return result


def test_the_best_places_are_those_of_brute_force(made: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    """In one segment or many, by any number of threads and by workers elsewhere, for one view or many."""
    made.check()
    shutil.rmtree(made.store.index)
    monkeypatch.setattr(map_index, "CAPACITY", 50)
    monkeypatch.setattr("vplog.places.bobb.BLOCK", 16)
    monkeypatch.setattr(map_search, "_PARTS_A_TASK", 1)
    parts = made.check(threads=3)
    assert len(parts) == 3
    views = made.views(5)
    alone = best_places(parts, made.state, views[:1], TOP, Execution(4))
    with ProcessPoolExecutor(2) as workers:
        found = best_places(parts, made.state, views, TOP, executor=workers)
    in_memory = [replace(part, path=None) for part in parts]
    with ThreadPoolExecutor(2) as workers:
        again = best_places(in_memory, made.state, views, TOP, executor=workers)
    for at, view in enumerate(views):
        assert told(found, at) == told(again, at) == made.expected(view)
    assert told(alone, 0) == made.expected(views[0])
    assert len(made.expected(views[0], 1000)) > 2 * TOP, "else nothing is left out"


def test_a_map_may_grow_shrink_and_change(made: Map) -> None:
    [first] = made.check()
    made.put(5, 2)
    small = made.check()
    assert first.path in {part.path for part in small}, "a small drive does not write the large segment again"
    made.take(1)
    made.check()
    made.put(4, 60, seed=77)  # the same name, other places
    made.check()
    made.take(4)
    made.take(2)
    [last] = made.check()
    assert len(last.segment) == last.places == 5, "what is mostly gone is written anew"
    assert list(made.files()) == [last.path and last.path.name]


def test_drives_one_by_one_make_few_segments(tmp_path: Path, state: BobbState) -> None:
    grown, at_once = Map(tmp_path / "grown", state), Map(tmp_path / "at once", state)
    for number in range(20):
        grown.put(number, 10)
        at_once.put(number, 10)
        parts, _ = grown.update()
        assert len(parts) <= 1 + np.log2(number + 1)
    grown.check()
    at_once.check()
    shutil.rmtree(grown.store.index)
    grown.check(threads=4)
    assert grown.files() == at_once.files(), "the same drives, the same bytes"


def test_a_finished_index_is_left_as_it_is(made: Map) -> None:
    made.check()
    before = {path: path.stat().st_mtime_ns for path in made.store.index.iterdir()}
    made.check()
    assert {path: path.stat().st_mtime_ns for path in made.store.index.iterdir()} == before


def test_of_two_that_have_a_drive_one_counts(made: Map, tmp_path: Path) -> None:
    """A reader may find the segments of before and after a merge."""
    made.check()
    shutil.copytree(made.store.index, tmp_path / "old")
    made.put(5, 200)
    made.check()
    shutil.copytree(tmp_path / "old", made.store.index, dirs_exist_ok=True)
    assert len(made.files()) == 2
    made.check()
    assert len(made.files()) == 1


def test_other_recognisers_are_searched_drive_by_drive(made: Map) -> None:
    class Other:
        """The same recogniser without inverted lists."""

        def __getattr__(self, name: str) -> Any:
            if name == "lists":
                raise AttributeError(name)
            return getattr(made.state, name)

    views = made.views(4)
    other = cast("PlaceState", Other())
    found, warnings = search(made.store, made.store.drives(), other, views, MapQuery(TOP), LineSearch(), Execution(2))
    assert not warnings
    assert [told(found, at) for at in range(4)] == [made.expected(view) for view in views]
    assert not made.store.index.exists()


def die(*_: object) -> None:
    os._exit(1)


def test_a_lost_worker_is_one_line(made: Map, monkeypatch: pytest.MonkeyPatch) -> None:
    parts = made.check()
    monkeypatch.setattr(map_search, "search_shard", die)
    with ProcessPoolExecutor(1) as workers, pytest.raises(ResultError, match="Run the query again"):
        best_places(parts, made.state, made.views(1), TOP, executor=workers)


def test_a_map_that_cannot_be_written_to_is_searched_all_the_same(made: Map) -> None:
    made.store.index.touch()
    parts, warnings = made.update()
    assert len(warnings) == 1
    assert "is not stored" in warnings[0]
    view = made.views(1)[0]
    assert told(best_places(parts, made.state, [view], TOP), 0) == made.expected(view)


def test_a_damaged_segment_is_made_again(made: Map) -> None:
    [part] = made.check()
    assert part.path
    whole = part.path.read_bytes()
    for broken, why in (
        (whole[:-1], "bytes"), (whole + b"x", "bytes"), (whole[:20], "not a part"), (b"", "not a part"),
        (b"PAR1" + whole[4:], "not a part"), (whole.replace(b'"block":8192', b'"block":0000'), "not JSON"),
        (whole.replace(b'"block":8192', b'"block":8191'), "checksum"),
        (whole.replace(b'"format":2', b'"format":3'), "of another version of vplog. Its header"),
        (whole.replace(b'"windows":4', b'"windows":-'), "not JSON"),
        (whole.replace(b'"entries":', b'"entrees":'), "lacks a value"),
    ):  # fmt: skip
        part.path.unlink()
        part.path.write_bytes(broken)
        with pytest.raises(ResultError, match=why):
            open_segment(part.path)
        _, warnings = made.update()
        assert len(warnings) == 1
        part.path.unlink(missing_ok=True)
        made.check()
        assert part.path.read_bytes() == whole


@settings(max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(seed=st.integers(0, 10**9))
def test_no_bytes_lead_beyond_the_arrays(made: Map, seed: int) -> None:
    """Whatever a stranger's file holds, it is refused or searched; its scores may be anything."""
    rng = np.random.default_rng(seed)
    [part] = made.update()[0]
    assert part.path
    data = np.frombuffer(part.path.read_bytes(), np.uint8).copy()
    where = rng.integers(0, len(data), rng.integers(1, 40))
    if seed % 2:  # past the header
        where = rng.integers(1000, len(data), 2000)
    data[where] = rng.integers(0, 256, len(where)) if seed % 3 else 255
    path = part.path.with_name("strange.lists")
    path.write_bytes(data[:-4].tobytes() + zlib.crc32(data[:-4].tobytes()).to_bytes(4, "little"))
    try:
        segment = open_segment(path)
    except ResultError:
        return
    finally:
        path.unlink()
    if len(segment.contents) == len(part.numbers):
        found = best_places([map_index.SegmentView(segment, None, part.numbers)], made.state, made.views(4), TOP)
        assert found.score.shape == (4, TOP)


def test_sequences_in_a_large_map_are_those_of_the_likely_drives(
    tmp_path: Path, state: BobbState, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A log that follows one of forty drives: the same answers as with lines in every drive."""
    large = Map(tmp_path / "map", state)
    for number in range(40):
        large.put(number, 30)
    followed = large.places["drive-000000023"]
    views = [Place(followed.references[row], followed.weights[row], followed.boxes[row]) for row in range(5, 25)]
    drives, by_five = large.store.drives(), LineSearch(SequenceSettings(length=5))
    every, nothing = search(large.store, drives, state, views, MapQuery(1), by_five)
    monkeypatch.setattr(map_query, "EXACT_PLACES", 100)
    likely, said = search(large.store, drives, state, views, MapQuery(1), by_five)
    assert not nothing
    assert "of 40 drives" in said[0]
    assert every.drive[:, 0].tolist() == [23] * 20
    for name in ("drive", "keyframe", "score", "support"):
        np.testing.assert_array_equal(getattr(likely, name), getattr(every, name))


def test_a_drive_is_likely_by_how_far_it_stands_out() -> None:
    """Drive 7 is best for one view of five by much, drive 2 a little for all, the others for none by anything."""
    drive = np.array([[2, 3, 4], [2, 3, 5], [7, 2, 3], [2, 4, 5], [2, 3, 4]], np.int32)
    score = np.array([[0.3, 0.2, 0.2], [0.3, 0.2, 0.2], [0.9, 0.3, 0.2], [0.3, 0.2, 0.2], [0.3, 0.2, 0.2]], np.float32)
    none = np.zeros((5, 3), np.int32)
    found = drives_by_votes(RankedPlaces(drive, none, score, none), 5)
    assert {2, 7} <= set(found.tolist())
    assert len(drives_by_votes(no_answers(0, 3), 5)) == 0
    many = np.arange(50, dtype=np.int32)[None]
    falling = np.linspace(1, 0.1, 50, dtype=np.float32)[None]
    assert drives_by_votes(RankedPlaces(many, many, falling, many), 5).tolist() == list(range(8))


def test_places_of_a_condensed_drive_are_as_many_as_are_asked_for(monkeypatch: pytest.MonkeyPatch) -> None:
    """Though the best one stands for most keyframes."""
    nearest = np.concatenate([np.full(300, 4), np.arange(5, 12)])

    class Index:
        def scores(self, *_: Any) -> np.ndarray:
            return np.where(np.arange(12) == 4, 9, np.arange(12) / 12).astype(np.float32)

    on_keyframes = sequences._OnKeyframes(cast("Any", Index()), nearest)
    monkeypatch.setattr(sequences, "drive_indexes", lambda *_: [(0, on_keyframes, nearest)])
    nothing = cast("Any", None)
    found = sequences.best_lines(nothing, {3: "condensed"}, nothing, [0], 5, LineSearch(), Execution())
    assert found.keyframe.tolist() == [[4, 11, 10, 9, 8]]
    assert found.count.tolist() == [5]
