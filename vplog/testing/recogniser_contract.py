"""Contract of every recogniser, whatever its descriptors are.

from vplog.testing.recogniser_contract import RecogniserContract

class TestMine(RecogniserContract):
    settings = MineSettings()
"""

from __future__ import annotations

import json
import pickle
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from vplog.data import Reference
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places.views import views_of
from vplog.stages import PlaceState, index_of_part
from vplog.storage.json_records import with_checksum
from vplog.testing.pictures import PictureLog, reference

COUNT = 12
"""Pictures of a library and of a map."""


def references() -> list[Reference]:
    return [reference(seed) for seed in range(COUNT)]


def drive() -> PictureLog:
    return PictureLog([one.image for one in references()])


def describe(state: PlaceState, threads: int = 1) -> list[Any]:
    """The places of the drive, whose features are those of the references."""
    log, known = drive(), references()
    views = views_of(state, log, log.stamps(), lambda row: known[row].features)
    return list(views.described(Execution(threads)))


@dataclass(frozen=True)
class Learned:
    """A recogniser that learned from the references with one thread."""

    state: PlaceState
    places: list[Any]
    column: pa.Array


class RecogniserContract:
    """Tests of one recogniser; a subclass names its `settings`, quick ones."""

    settings: Any = None
    _learned: Learned | None = None

    @property
    def learned(self) -> Learned:
        """Made once for all tests of a class."""
        if type(self)._learned is None:
            state = self.settings.learn(references(), Execution())
            places = describe(state)
            type(self)._learned = Learned(state, places, state.to_arrow(places))
        found = type(self)._learned
        assert found is not None
        return found

    def test_settings_are_plain_values(self) -> None:
        """They stand in run.json and in libraries, and go to other processes."""
        tree = self.settings.model_dump(mode="json")
        assert tree["kind"] == type(self.settings).model_fields["kind"].default
        assert type(self.settings).read(tree, "run.json") == self.settings
        assert pickle.loads(pickle.dumps(self.settings)) == self.settings  # noqa: S301

    def test_any_number_of_threads_gives_the_same_bytes(self) -> None:
        here = self.learned
        other = self.settings.learn(iter(references()), Execution(3))
        assert other.hash == here.state.hash
        assert other.to_arrow(describe(other, 3)).equals(here.column)
        indexes = [state.index(here.places) for state in (here.state, other)]
        for place in here.places:
            assert indexes[0].scores(place).tobytes() == indexes[1].scores(place).tobytes()

    def test_a_saved_library_is_the_same_recogniser(self, tmp_path: Path) -> None:
        here = self.learned
        here.state.save(tmp_path)
        loaded = self.settings.load(tmp_path, Execution(2))
        assert loaded.hash == here.state.hash
        assert loaded.to_arrow(describe(loaded)).equals(here.column)
        record = tmp_path / "library.json"
        other = json.loads(record.read_text().replace(here.state.hash, "0" * 64))
        record.write_text(json.dumps(with_checksum(other)))
        with pytest.raises(LibraryError, match="hash"):
            self.settings.load(tmp_path, Execution())
        with pytest.raises(LibraryError, match="not a library"):
            self.settings.load(tmp_path / "none", Execution())

    def test_a_map_is_rebuilt_from_a_table(self, tmp_path: Path) -> None:
        state, places, column = self.learned.state, self.learned.places, self.learned.column
        assert column.type.equals(state.arrow_type)
        assert len(column) == COUNT
        pq.write_table(pa.table({"place": column}), tmp_path / "places.parquet")
        stored = state.from_arrow(pq.read_table(tmp_path / "places.parquet")["place"].combine_chunks())
        assert state.to_arrow(stored).equals(column)
        assert state.to_arrow(state.from_arrow(column[3:7])).equals(state.to_arrow(places[3:7]))
        assert len(state.from_arrow(state.to_arrow([]))) == 0
        index, rebuilt = state.index(places), state.index(stored)
        assert len(rebuilt) == len(places)
        for place, again in zip(places, stored, strict=True):
            np.testing.assert_array_equal(index.scores(place), rebuilt.scores(again))

    def test_a_query_sorts_the_scores_and_ties_go_to_the_earlier_row(self) -> None:
        places = self.learned.places
        index = self.learned.state.index(places + places)  # every row has an equal
        assert len(index) == 2 * COUNT
        for row, place in enumerate(places):
            for stop in (None, 0, 7, COUNT + 5):
                scores = index.scores(place, stop)
                assert scores.dtype == np.float32
                assert len(scores) == (2 * COUNT if stop is None else stop)
                full = index.query(place, 10 * COUNT, stop)
                np.testing.assert_array_equal(full.score, scores[full.rows])
                assert full.rows.tolist() == sorted(set(full.rows.tolist()), key=lambda r: (-scores[r], r))
                for k in (0, 1, 4):
                    np.testing.assert_array_equal(index.query(place, k, stop).rows, full.rows[:k])
            assert index.query(place, 10 * COUNT).rows.tolist()[:2] == [row, row + COUNT]  # itself and its copy

    def test_a_map_in_parts_is_ranked_as_a_whole(self) -> None:
        """Drives of a map are searched one after the other."""
        state, places, cut = self.learned.state, self.learned.places, COUNT // 3
        whole, parts = state.index(places), [index_of_part(state, part) for part in (places[:cut], places[cut:])]
        for place in places:
            found = [part.query(place, COUNT) for part in parts]
            rows = np.concatenate([found[0].rows, found[1].rows + cut])
            score = np.concatenate([one.score for one in found])
            np.testing.assert_array_equal(np.concatenate([part.scores(place) for part in parts])[rows], score)
            together = rows[np.lexsort((rows, -score))]
            # what is equal in the whole to its last bit may be in another order in parts
            np.testing.assert_allclose(whole.scores(place)[together], whole.query(place, COUNT).score, rtol=1e-6)
            assert together[0] == whole.query(place, COUNT).rows[0]

    def test_without_a_map_nothing_is_found(self) -> None:
        index, place = self.learned.state.index([]), self.learned.places[0]
        assert len(index) == len(index.scores(place)) == len(index.query(place, 5).rows) == 0

    def test_a_library_needs_references(self) -> None:
        with pytest.raises(LibraryError, match="at least"):
            self.settings.learn([], Execution())

    def test_columns_of_another_kind_are_refused(self) -> None:
        with pytest.raises(LibraryError, match="not fit"):
            self.learned.state.from_arrow(pa.array([1.0]))
        with pytest.raises(LibraryError, match="no value"):
            self.learned.state.from_arrow(pa.array([None], self.learned.state.arrow_type))

    def test_its_size_is_known(self) -> None:
        assert self.learned.state.bits > 0
