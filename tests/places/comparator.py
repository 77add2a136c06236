"""What every comparator must do, asked of each in its own test file."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from vplog.errors import LibraryError

from .pictures import nothing

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.data import Reference


def check_threads_folders_and_tables(settings: Any, references: list[Reference], tmp_path: Path) -> None:
    """Descriptors are the same from any number of threads, from a saved library and from a Parquet file."""
    state = settings.learn(references, 1)
    places = [state.describe(reference.features) for reference in references]
    column = state.to_arrow(places)
    assert column.type.equals(state.arrow_type)
    assert len(column) == len(references)

    other = settings.learn(iter(references), 4)
    with ThreadPoolExecutor(4) as pool:
        again = list(pool.map(other.describe, [reference.features for reference in references]))
    assert other.hash == state.hash
    assert other.to_arrow(again).equals(column)

    state.save(tmp_path / "library")
    loaded = type(settings)().load(tmp_path / "library", 2)  # the folder's settings count, not these
    assert loaded.settings == settings
    assert loaded.hash == state.hash
    assert loaded.to_arrow([loaded.describe(reference.features) for reference in references]).equals(column)

    pq.write_table(pa.table({"place": column}), tmp_path / "places.parquet")
    read = pq.read_table(tmp_path / "places.parquet")["place"].combine_chunks()
    assert state.to_arrow(state.from_arrow(read)).equals(column)
    assert state.to_arrow(state.from_arrow(column[3:7])).equals(state.to_arrow(places[3:7]))
    index, rebuilt = state.index(places), state.index(state.from_arrow(read))
    for place in places:
        np.testing.assert_array_equal(index.scores(place), rebuilt.scores(place))


def check_search(settings: Any, references: list[Reference]) -> None:
    """A place finds itself first; scores and queries agree; `stop` cuts; ties go to the earlier row."""
    state = settings.learn(references, 2)
    places = [state.describe(reference.features) for reference in references]
    index = state.index(places + places)
    n = len(places)
    assert len(index) == 2 * n
    for row, place in enumerate(places):
        scores = index.scores(place)
        assert scores.dtype == np.float32
        ranking = index.query(place, 5)
        assert ranking.rows[0] == row
        assert ranking.rows[1] == row + n  # its copy, equally good
        np.testing.assert_array_equal(ranking.score, scores[ranking.rows])
        assert np.all(np.diff(ranking.score) <= 0)
        np.testing.assert_array_equal(index.scores(place, 7), scores[:7])
        full = index.query(place, 100, 7)
        expected = [r for r in sorted(range(7), key=lambda r: (-scores[r], r)) if scores[r] != 0]
        np.testing.assert_array_equal(full.rows, expected)
        np.testing.assert_array_equal(index.query(place, 3, 7).rows, full.rows[:3])
        assert len(index.query(place, 0).rows) == 0
    empty = state.index([])
    assert len(empty) == 0
    assert len(empty.query(places[0], 5).rows) == 0
    assert len(state.from_arrow(state.to_arrow([]))) == 0


def check_bad_input(settings: Any, references: list[Reference], tmp_path: Path) -> None:
    """No references, a damaged library and columns of another kind are errors of one line."""
    with pytest.raises(LibraryError, match="at least one"):
        settings.learn([], 1)
    with pytest.raises(LibraryError, match="not a library"):
        settings.load(tmp_path / "none", 1)
    state = settings.learn(references[:4], 1)
    state.save(tmp_path / "library")
    record = tmp_path / "library" / "library.json"
    record.write_text(record.read_text().replace(state.hash, "0" * 64))
    with pytest.raises(LibraryError, match="hash"):
        settings.load(tmp_path / "library", 1)
    with pytest.raises(LibraryError, match="do not fit"):
        state.from_arrow(pa.array([1.0]))
    with pytest.raises(LibraryError, match="no value"):
        state.from_arrow(pa.array([None], state.arrow_type))


def check_features_only(settings: Any, references: list[Reference]) -> None:
    """An image without features has a descriptor that finds nothing and is found by none."""
    state = settings.learn(references, 1)
    blank, place = state.describe(nothing()), state.describe(references[0].features)
    index = state.index([blank, place])
    assert len(index.query(blank, 5).rows) == 0
    assert index.query(place, 5).rows.tolist() == [1]
    with pytest.raises(LibraryError, match="feature"):
        settings.learn([type(references[0])(references[0].image, nothing(), "", 1)] * 3, 1)
