"""The best places of a map for views along with their neighbours: lines within drives, drive by drive.

A line needs the scores of every place of its drive for every view of the log, which is nothing for a few drives and
out of reach for a map of thousands. There the drives are chosen first, by single views over the whole map, which is
exact and fast; lines are then as exact within the drives chosen as in a small map. A drive is missed only when none of
its places is among the best hundred of the map for any view, or when eight others are better so for each stretch of
views.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Float32s, Floats, Int32s, Ints, Ranking
from vplog.execution.execution import Execution
from vplog.maps.search.exact import NO_SCORE, RankedPlaces, merge, no_answers
from vplog.maps.search.index import read_column, rows_on_keyframes
from vplog.maps.storage.damage import reading_drive
from vplog.places.dense import best_rows
from vplog.places.sequence import SequenceSettings, rank_places
from vplog.stages import PlaceIndex, PlaceState, index_of_part
from vplog.storage.mapped_table import mapped_scores
from vplog.storage.scratch import scratch

if TYPE_CHECKING:
    from vplog.loops.match_probability import LookAlikes
    from vplog.maps.storage.map_store import Store

EXACT_PLACES = 200_000
"""Up to so many places lines are drawn in every drive: some minutes of one core for a log of a thousand views."""
PLACES_A_VIEW = 100
"""Best places of each single view, which vote for their drives."""
_DRIVES_A_STRETCH = 8
"""Drives chosen for each stretch of views as long as a window."""
_SINGLE_VIEWS = SequenceSettings(length=1)


@dataclass(frozen=True, eq=False)
class LineSearch:
    """How views are matched along with their neighbours; a window of one view is a search by single views."""

    settings: SequenceSettings = _SINGLE_VIEWS
    look_alikes: LookAlikes | None = None
    """Collects look-alikes of the lines, where given."""


def best_lines(
    store: Store, drives: Mapping[int, str], state: PlaceState, descriptors: Sequence[Any], top: int,
    search: LineSearch, execution: Execution,
) -> RankedPlaces:  # fmt: skip
    """The `top` best places of some drives, by their numbers in the map, for each of Q views in order.

    Drives are read one after the other, so memory is that of the largest; of lines, look-alikes are taken from the
    scores of one drive, which are on disk meanwhile. Works for any recogniser, and for a window of one view. Raises
    LibraryError where a drive's descriptors are of another library.
    """
    settings, look_alikes = search.settings, search.look_alikes
    best = no_answers(len(descriptors), top)
    parts = (
        (number, part)
        for number, drive in execution.counted("search", drives.items(), len(drives))
        for part in drive_indexes(store, drive, state, settings)
    )
    for number, (begin, index, nearest) in parts:
        stops = np.full(len(descriptors), len(index), np.int64)
        most = top if nearest is None else top * int(np.bincount(nearest).max())
        found = no_answers(len(descriptors), top)
        found.drive[:] = number
        with ExitStack() as stack:
            lines, shape = None, (len(descriptors), len(index))
            if look_alikes is not None:
                file = stack.enter_context(scratch("scores")) / "scores.npy"
                lines = mapped_scores(file, shape)
            rankings = rank_places(index, descriptors, stops, most, settings, Execution(execution.threads), lines)
            for view, (ranking, support) in enumerate(rankings):
                rows, first = ranking.rows, np.arange(len(ranking.rows))
                if nearest is not None:  # of the keyframes that a place stands for, the best one
                    rows = nearest[rows]
                    first = np.sort(np.unique(rows, return_index=True)[1])
                first = first[:top]
                count = len(first)
                found.keyframe[view, :count], found.score[view, :count] = begin + rows[first], ranking.score[first]
                found.support[view, :count] = support[first]
            best = merge([best, found], top)
            if lines is not None and look_alikes is not None:  # in place of an earlier one's, whose answers are worse
                own = (best.drive[:, 0] == number) & (best.keyframe[:, 0] >= begin)
                first = np.flatnonzero((best.count > 0) & own)
                look_alikes.take(lines, first, first)
    return best


def drive_indexes(
    store: Store, drive: str, state: PlaceState, settings: SequenceSettings
) -> Iterator[tuple[int, PlaceIndex, Ints | None]]:
    """Indexes of a drive's places, each with the row of its first. For lines there is one of each camera, with a row
    for every keyframe, since these are spaced evenly, and the scores of the nearest place, whose row in the index comes
    along where not every keyframe has its own."""
    column = read_column(store, drive, state)
    parts = rows_on_keyframes(store, drive).values() if settings.length > 1 else [(slice(0, len(column)), None)]
    for rows, nearest in parts:
        with reading_drive(drive):
            index = index_of_part(state, state.from_arrow(column[rows]))
        yield rows.start, (index if nearest is None else _OnKeyframes(index, nearest)), nearest


@dataclass(frozen=True, eq=False)
class _OnKeyframes:
    """Places with the row of the nearest one for each keyframe (N,)."""

    index: PlaceIndex
    nearest: Ints

    def __len__(self) -> int:
        return len(self.nearest)

    def scores(self, descriptor: Any, stop: int | None = None) -> Float32s:
        return self.index.scores(descriptor)[self.nearest[:stop]]

    def query(self, descriptor: Any, k: int, stop: int | None = None) -> Ranking:
        return best_rows(self.scores(descriptor, stop), k)


def drives_by_votes(single: RankedPlaces, length: int) -> Ints:
    """Numbers of the drives in which lines may be, increasing: for each stretch of `length` views, each half over the
    last, those with most votes of the best places of single views."""
    view, drive, votes = drive_votes(single)
    chosen = []
    for start in range(0, len(single.score), max(length // 2, 1)):
        part = slice(*np.searchsorted(view, [start, start + length]))
        total = np.bincount(drive[part], votes[part])
        best = np.argsort(-total, kind="stable")[:_DRIVES_A_STRETCH]
        chosen.append(best[total[best] > 0])
    return np.unique(np.concatenate(chosen)) if chosen else np.empty(0, np.int64)


def drive_votes(single: RankedPlaces) -> tuple[Ints, Int32s, Floats]:
    """(C,) views, rising, drives, and the vote of each view for the drive.

    A vote is the score of the drive's best place less that of the last of the view's places, so a view that resembles
    everything has little weight.
    """
    top = single.score.shape[1]
    there = single.score > NO_SCORE
    least = np.where(there, single.score, np.inf).min(axis=1, initial=np.inf)
    full = there.sum(axis=1) == top
    votes = np.where(there, single.score - np.where(full, least, 0.0)[:, None] + np.float32(1e-6), 0.0)
    view, rank = np.nonzero(there)
    order = np.lexsort((rank, single.drive[view, rank], view))
    view, rank = view[order], rank[order]
    drive = single.drive[view, rank]
    first = np.ones(len(view), np.bool_)  # a drive's best place for a view comes first
    first[1:] = (view[1:] != view[:-1]) | (drive[1:] != drive[:-1])
    return view[first], drive[first], votes[view[first], rank[first]].astype(np.float64)
