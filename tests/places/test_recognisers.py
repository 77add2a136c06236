"""What every recogniser of the union must do, whatever its descriptors are."""

from __future__ import annotations

import typing
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.places.pictures import nothing
from vplog.data import THUMBNAIL_SIDE
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places import PlaceSettings
from vplog.places.bobb import BobbSettings
from vplog.places.bobb_paper import PaperBobbSettings
from vplog.places.bovf import BovfSettings
from vplog.places.fabmap import FabmapSettings
from vplog.places.gist import GistSettings
from vplog.places.hybrid import HybridSettings
from vplog.places.thumbnail import ThumbnailSettings
from vplog.places.vlad import VladSettings
from vplog.stages import BoxState, CodedState

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from vplog.data import Reference
    from vplog.settings import Settings
    from vplog.stages import PlaceState

UNION = typing.get_args(typing.get_args(PlaceSettings)[0])
CASES: dict[str, Any] = {
    "bobb": BobbSettings(references=4, features=150),
    "bobb, reduced": BobbSettings(references=3, features=150, windows_along=2, popularity=0, pairing="best"),
    "bobb_paper": PaperBobbSettings(partitions=5, features=150),
    "bovf": BovfSettings(words=200, features=150),
    "bovf, cut": BovfSettings(words=200, features=150, max_bytes=64),
    "fabmap": FabmapSettings(words=100, features=150),
    "gist": GistSettings(blocks=2),
    "hybrid": HybridSettings(bobb=BobbSettings(references=4, features=150), words=4),
    "thumbnail": ThumbnailSettings(),
    "vlad": VladSettings(centres=8, features=150),
    "vlad, whole": VladSettings(centres=8, features=150, dimensions=None),
}
"""Settings that are quick."""
WHOLE_IMAGE = ("gist", "thumbnail")
"""Kinds that look at no features."""
BLANK = replace(nothing(), thumbnail=np.full((THUMBNAIL_SIDE, THUMBNAIL_SIDE), 77, np.uint8))
"""A grey wall."""


@dataclass(frozen=True)
class Case:
    settings: Any
    state: PlaceState
    """Learned with one thread."""
    places: list[Any]
    """Of the references."""
    column: pa.Array


@pytest.fixture(scope="module")
def cases(references: list[Reference]) -> dict[str, Case]:
    made = {}
    for name, settings in CASES.items():
        state = settings.learn(references, Execution())
        places = [state.describe(reference.features) for reference in references]
        made[name] = Case(settings, state, places, state.to_arrow(places))
    return made


@pytest.fixture(params=CASES)
def case(request: pytest.FixtureRequest, cases: dict[str, Case]) -> Case:
    return cases[request.param]


def described(state: PlaceState, references: Sequence[Reference], threads: int) -> pa.Array:
    with ThreadPoolExecutor(threads) as pool:
        return state.to_arrow(list(pool.map(state.describe, [reference.features for reference in references])))


@pytest.mark.parametrize("settings", UNION)
def test_every_member_is_tested_under_its_kind(settings: type[Settings]) -> None:
    kind = settings.model_fields["kind"].default
    assert any(type(quick) is settings and name.split(",")[0] == kind for name, quick in CASES.items())


def test_any_number_of_threads_gives_the_same_bytes(case: Case, references: list[Reference]) -> None:
    other = case.settings.learn(iter(references), Execution(3))
    assert other.hash == case.state.hash
    assert described(other, references, 3).equals(case.column)
    blank = other.describe(BLANK)
    here, there = (state.index([*case.places, blank]) for state in (case.state, other))
    for place in case.places:
        assert here.scores(place).tobytes() == there.scores(place).tobytes()


def test_a_saved_library_is_the_same_recogniser(case: Case, references: list[Reference], tmp_path: Path) -> None:
    case.state.save(tmp_path)
    loaded = type(case.settings)().load(tmp_path, Execution(2))  # the folder's settings count, not these
    assert loaded.settings == case.settings
    assert loaded.hash == case.state.hash
    assert described(loaded, references, 1).equals(case.column)
    record = tmp_path / "library.json"
    record.write_text(record.read_text().replace(case.state.hash, "0" * 64))
    with pytest.raises(LibraryError, match="hash"):
        case.settings.load(tmp_path, Execution())
    with pytest.raises(LibraryError, match="not a library"):
        case.settings.load(tmp_path / "none", Execution())


def test_settings_that_differ_give_other_hashes(cases: dict[str, Case]) -> None:
    assert len({case.state.hash for case in cases.values()}) == len(CASES)


def test_a_map_is_rebuilt_from_a_table(case: Case, references: list[Reference], tmp_path: Path) -> None:
    state, places = case.state, case.places
    assert case.column.type.equals(state.arrow_type)
    assert len(case.column) == len(references)
    pq.write_table(pa.table({"place": case.column}), tmp_path / "places.parquet")
    read = pq.read_table(tmp_path / "places.parquet")["place"].combine_chunks()
    stored = state.from_arrow(read)
    assert state.to_arrow(stored).equals(case.column)
    assert state.to_arrow(state.from_arrow(case.column[3:7])).equals(state.to_arrow(places[3:7]))
    assert len(state.from_arrow(state.to_arrow([]))) == 0
    index, rebuilt = state.index(places), state.index(stored)
    assert len(rebuilt) == len(places)
    for place, again in zip(places, stored, strict=True):
        np.testing.assert_array_equal(index.scores(place), rebuilt.scores(again))


def test_a_query_sorts_the_scores_and_ties_go_to_the_earlier_row(case: Case) -> None:
    n = len(case.places)
    index = case.state.index(case.places + case.places)  # every row has an equal
    assert len(index) == 2 * n
    for row, place in enumerate(case.places):
        for stop in (None, 0, 7, n + 5):
            scores = index.scores(place, stop)
            assert scores.dtype == np.float32
            assert len(scores) == (2 * n if stop is None else stop)
            full = index.query(place, 10 * n, stop)
            np.testing.assert_array_equal(full.score, scores[full.rows])
            assert full.rows.tolist() == sorted(set(full.rows.tolist()), key=lambda r: (-scores[r], r))
            for k in (0, 1, 4):
                np.testing.assert_array_equal(index.query(place, k, stop).rows, full.rows[:k])
        ranked = index.query(place, 10 * n).rows.tolist()
        assert ranked[:2] == [row, row + n]  # itself and its copy


def test_a_map_in_parts_is_ranked_as_a_whole(case: Case) -> None:
    """Drives of a map are asked one after the other."""
    n, cut = len(case.places), len(case.places) // 3
    of_part = getattr(case.state, "index_of_part", case.state.index)
    whole, parts = case.state.index(case.places), (of_part(case.places[:cut]), of_part(case.places[cut:]))
    for place in case.places:
        found = [part.query(place, n) for part in parts]
        rows = np.concatenate([found[0].rows, found[1].rows + cut])
        score = np.concatenate([one.score for one in found])
        np.testing.assert_array_equal(np.concatenate([part.scores(place) for part in parts])[rows], score)
        ranked = whole.query(place, n)
        together = rows[np.lexsort((rows, -score))]
        # what the one says is equal to its last bit may be in another order
        np.testing.assert_allclose(whole.scores(place)[together], ranked.score, rtol=1e-6)
        assert together[0] == ranked.rows[0]


def test_without_a_map_nothing_is_found(case: Case) -> None:
    index = case.state.index([])
    assert len(index) == len(index.scores(case.places[0])) == len(index.query(case.places[0], 5).rows) == 0


def test_an_image_without_features_is_described(case: Case, references: list[Reference]) -> None:
    state = case.state
    blank = state.describe(BLANK)
    column = state.to_arrow([blank, case.places[0]])
    assert state.to_arrow(state.from_arrow(column)).equals(column)
    index = state.index(state.from_arrow(column))
    assert index.query(case.places[0], 1).rows.tolist() == [1]
    if case.settings.kind in WHOLE_IMAGE:
        assert index.query(blank, 1).rows.tolist() == [0]
        with pytest.raises(LibraryError, match="whole images"):
            state.describe(nothing())
    else:
        assert len(index.query(blank, 5).rows) == 0
        assert index.query(case.places[0], 5).rows.tolist() == [1]
        with pytest.raises(LibraryError, match="feature"):
            case.settings.learn([replace(reference, features=BLANK) for reference in references[:3]], Execution())


def test_boxes_of_any_recogniser_that_has_them(case: Case, references: list[Reference]) -> None:
    state = case.state
    assert isinstance(state, BoxState) == case.settings.kind.startswith(("bobb", "hybrid"))
    assert isinstance(state, CodedState) == (case.settings.kind == "bobb")
    if not isinstance(state, BoxState):
        return
    assert [one.stamp_ns for one in state.references] == [one.stamp_ns for one in references]
    places = [*case.places, state.describe(BLANK)]
    found = [state.boxes(place) for place in places]
    assert not len(found[-1].references)
    for one in found:
        assert one.corners.shape[:2] == (len(one.references), len(state.windows(0)))
        inside = one.corners[~np.isnan(one.corners).any(axis=2)]
        assert np.all((inside >= 0) & (inside <= 1))
        assert np.all(inside[:, :2] < inside[:, 2:])
    query, match = np.divmod(np.arange(len(places) ** 2, dtype=np.int32), len(places))
    shared = state.shared(places, query, match)
    for q, m, numbers in zip(query, match, shared.references, strict=True):
        assert set(numbers.tolist()) == set(found[q].references.tolist()) & set(found[m].references.tolist())
    features = references[0].features
    votes = state.voting_map(features, int(found[0].references[0]))
    assert votes.min() >= 0
    assert votes.max() == 1.0
    assert not state.voting_map(BLANK, 0).any()


def test_a_library_needs_references(case: Case) -> None:
    with pytest.raises(LibraryError, match="at least"):
        case.settings.learn([], Execution())


def test_columns_of_another_kind_are_refused(case: Case, cases: dict[str, Case]) -> None:
    columns = [other.column for other in cases.values() if not other.column.type.equals(case.column.type)]
    assert len(columns) >= len(UNION) - 1
    for column in [*columns, pa.array([1.0])]:
        with pytest.raises(LibraryError, match="not fit"):
            case.state.from_arrow(column)
    with pytest.raises(LibraryError, match="no value"):
        case.state.from_arrow(pa.array([None], case.state.arrow_type))
