"""The recogniser's state: the same whatever the threads, on disk and in tables, and it finds what it has seen."""

from __future__ import annotations

import math
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.places.literal import all_boxes
from tests.places.pictures import SMALL, noisy, nothing, reference
from vplog.errors import LibraryError, SettingsError
from vplog.execution.execution import Execution
from vplog.places import bobb_paper, rvp
from vplog.places.bobb_paper import PaperBobbSettings, PaperBobbState
from vplog.places.overlap import BoxPlace

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.data import Features, Reference


def _equal(a: BoxPlace, b: BoxPlace) -> bool:
    return np.array_equal(a.references, b.references) and np.array_equal(a.boxes, b.boxes)


def test_no_more_references_than_the_ledger_can_number(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(bobb_paper.lib, "build_library", lambda *_: range(65_535))
    with pytest.raises(LibraryError, match="may have 65534 reference images, this one 65535"):
        SMALL.learn([], Execution())


@pytest.fixture(scope="module")
def queries(references: list[Reference]) -> list[Features]:
    seen = [noisy(r.features, seed) for seed, r in enumerate(references)]
    return [*seen, reference(50).features, nothing()]


@pytest.fixture(scope="module")
def places(state: PaperBobbState, queries: list[Features]) -> list[BoxPlace]:
    return [state.describe(features) for features in queries]


def test_describing_from_many_threads_changes_nothing(
    state: PaperBobbState, queries: list[Features], places: list[BoxPlace]
) -> None:
    with ThreadPoolExecutor(4) as pool:
        again = list(pool.map(state.describe, queries * 2))
    assert all(map(_equal, again, places * 2))


def test_learning_with_many_threads_changes_nothing(state: PaperBobbState, references: list[Reference]) -> None:
    words = state.library.words
    for threads in (1, 4):
        other = SMALL.learn(references, Execution(threads))
        assert other.hash == state.hash
        np.testing.assert_array_equal(other.library.words.start, words.start)
        np.testing.assert_array_equal(other.library.words.values, words.values)
        for a, b in zip(other.patterns, state.patterns, strict=True):
            for part, same in zip(a, b, strict=True):
                np.testing.assert_array_equal(part, same)


def test_a_saved_library_describes_the_same(
    state: PaperBobbState, queries: list[Features], places: list[BoxPlace], tmp_path: Path
) -> None:
    state.save(tmp_path / "a" / "library")
    loaded = PaperBobbSettings().load(tmp_path / "a" / "library", Execution(2))  # the folder's settings count
    assert loaded.settings == SMALL
    assert loaded.hash == state.hash
    assert all(map(_equal, map(loaded.describe, queries), places))
    loaded.save(tmp_path / "b")
    for name in ("library.json", "features.parquet", "references.parquet"):
        assert (tmp_path / "b" / name).read_bytes() == (tmp_path / "a" / "library" / name).read_bytes()


def test_seeds_give_other_windows_and_partitions(references: list[Reference]) -> None:
    a, b = (
        PaperBobbSettings(partitions=5, features=100, references=2, seed=seed).learn(references[:3], Execution())
        for seed in (0, 1)
    )
    assert a.hash != b.hash
    assert not np.array_equal(a._windows, b._windows)
    assert not np.array_equal(a.patterns[0].x_cuts, b.patterns[0].x_cuts)
    assert not np.array_equal(a.patterns[0].x_cuts, a.patterns[1].x_cuts)


def test_the_hash_tells_libraries_apart(state: PaperBobbState, references: list[Reference]) -> None:
    assert SMALL.learn(references[::-1], Execution()).hash != state.hash
    assert SMALL.learn(references[:-1], Execution()).hash != state.hash


@pytest.mark.parametrize(
    "change", [{}, {"grid": 13, "boxes": 2}, {"references": 2, "max_box_share": 0.3, "aspects": (1.0,), "grid": 9}]
)
def test_bits_of_a_place(references: list[Reference], change: dict[str, Any]) -> None:
    settings = PaperBobbSettings(**(dict[str, Any](partitions=1, features=20, grid=20) | change))
    state = settings.learn(references[:7], Execution())
    boxes = len(all_boxes(settings.grid, rvp.box_shapes(settings.grid, settings.max_box_share, settings.aspects))) + 1
    sets = math.factorial(7) // math.factorial(settings.references) // math.factorial(7 - settings.references)
    per_box = next(bits for bits in range(64) if 2**bits >= boxes)
    per_set = next(bits for bits in range(64) if 2**bits >= sets)
    assert state.bits == per_set + settings.references * settings.boxes * per_box


def test_the_papers_references_take_22_bits(references: list[Reference]) -> None:
    """Section V: log2 C(100, 4) is told in 22 bits."""
    many = [references[row % 12] for row in range(100)]
    state = PaperBobbSettings(partitions=1, features=3).learn(many, Execution())
    per_box = math.ceil(math.log2(rvp.count_boxes(64, rvp.box_shapes(64, 0.1, state.settings.aspects))))
    assert state.bits == 22 + 16 * per_box


def test_boxes_are_small_and_where_references_are(places: list[BoxPlace]) -> None:
    found = 0
    for place in places:
        assert place.boxes.shape == (4, 4, 4)
        x0, y0, x1, y1 = np.moveaxis(place.boxes.astype(int), -1, 0)
        assert ((x0 <= x1) & (y0 <= y1)).all()
        assert place.boxes.max() <= SMALL.grid
        assert ((x1 - x0) * (y1 - y0) <= SMALL.max_box_share * SMALL.grid**2).all()
        assert not place.boxes[place.references < 0].any()
        chosen = place.references[place.references >= 0]
        assert len(set(chosen.tolist())) == len(chosen)
        found += (x1 > x0).sum()
    assert found > 100


def test_an_image_without_features_is_like_nothing(state: PaperBobbState, places: list[BoxPlace]) -> None:
    empty = places[-1]
    assert (empty.references == -1).all()
    assert not empty.boxes.any()
    index = state.index(places)
    assert not index.scores(empty).any()
    assert len(index.query(empty, 5).rows) == 0
    assert all(index.scores(place)[-1] == 0 for place in places)


def test_fewer_references_than_asked_for(state: PaperBobbState, references: list[Reference]) -> None:
    """A single feature explains its own reference, and its neighbours perhaps."""
    f, few = references[2].features, 0
    for row in range(40):
        place = state.describe(f.rows(slice(row, row + 1)))
        few += int(place.references[-1] == -1)
        assert not place.boxes[place.references == -1].any()
        assert 2 in place.references or place.references[-1] >= 0
    assert few > 0


def test_the_reference_itself_explains_an_image_best(places: list[BoxPlace]) -> None:
    assert [int(place.references[0]) for place in places[:12]] == list(range(12))


def test_a_place_is_most_like_itself(
    state: PaperBobbState, references: list[Reference], queries: list[Features], places: list[BoxPlace]
) -> None:
    index = state.index([state.describe(r.features) for r in references])
    for row, r in enumerate(references):
        assert index.query(state.describe(r.features), 1).rows.tolist() == [row]
    for row in range(12):  # and so are its noisy views
        assert index.query(places[row], 1).rows.tolist() == [row]


def test_places_survive_a_parquet_file(state: PaperBobbState, places: list[BoxPlace], tmp_path: Path) -> None:
    pq.write_table(pa.table({"place": state.to_arrow(places)}), tmp_path / "d.parquet")
    column = pq.read_table(tmp_path / "d.parquet")["place"].combine_chunks()
    assert column.type == state.arrow_type
    back = state.from_arrow(column)
    assert all(map(_equal, back, places))
    assert all(map(_equal, state.from_arrow(column.slice(3, 5)), places[3:8]))
    np.testing.assert_array_equal(state.index(back).scores(places[4]), state.index(places).scores(places[4]))


def test_no_places_at_all(state: PaperBobbState, places: list[BoxPlace]) -> None:
    assert state.from_arrow(state.to_arrow([])) == []
    index = state.index([])
    assert len(index) == 0
    assert len(index.query(places[0], 3).rows) == 0


def test_columns_of_other_libraries_are_refused(state: PaperBobbState, places: list[BoxPlace]) -> None:
    good = state.to_arrow(places)
    for column in (pa.array([1, 2]), good.field("references"), good.cast(pa.struct([("a", pa.int32())]), safe=False)):
        with pytest.raises(LibraryError, match="do not fit"):
            state.from_arrow(column)
    boxes = places[0].boxes
    for wrong in (12, -2, 2**31 - 1):
        with pytest.raises(LibraryError, match="references that this library lacks"):
            state.from_arrow(state.to_arrow([BoxPlace(np.array([0, 1, wrong, -1], np.int32), boxes)]))
    with pytest.raises(LibraryError, match="beyond the grid"):
        state.from_arrow(state.to_arrow([BoxPlace(places[0].references, np.full((4, 4, 4), 65, np.uint8))]))


def test_columns_with_empty_rows_are_refused(state: PaperBobbState, places: list[BoxPlace]) -> None:
    rows = state.to_arrow(places).to_pylist()
    for damage in (
        None,
        {"references": None, "boxes": rows[0]["boxes"]},
        {"references": rows[0]["references"], "boxes": None},
        {"references": [0, None, 1, 2], "boxes": rows[0]["boxes"]},
    ):
        with pytest.raises(LibraryError):
            state.from_arrow(pa.array([*rows, damage], state.arrow_type))


def test_too_small_a_library_is_refused(references: list[Reference]) -> None:
    with pytest.raises(LibraryError, match=r"3 reference images, but places\.references is 4"):
        SMALL.learn(references[:3], Execution())


@pytest.mark.parametrize(
    "change",
    [
        {"grid": 256},
        {"grid": 3},  # a tenth of nine cells is none
        {"columns": 257},
        {"rows": 0},
        {"references": 0},
        {"boxes": 0},
        {"partitions": 0},
        {"window_share": 1.1},
        {"max_box_share": 0.0},
        {"aspects": []},
        {"aspects": [-1.0]},
        {"features": 0},
        {"neighbours": 0},
        {"seed": -1},
    ],
)
def test_settings_that_cannot_work(change: dict[str, Any]) -> None:
    with pytest.raises(SettingsError):
        PaperBobbSettings.read(change, "test")
