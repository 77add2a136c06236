"""The best places of a map for views along with their neighbours: lines within drives, drive by drive.

A line needs the scores of every place of its drive for every view of the log, which is nothing for a few drives and
out of reach for a map of thousands. There the drives are chosen first, by single views over the whole map, which is
exact and fast; lines are then as exact within the drives chosen as in a small map. A drive is missed only when none of
its places is among the best hundred of the map for any view, or when eight others are better so for each stretch of
views.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Floats, Int32s, Ints
from vplog.execution.execution import Execution
from vplog.maps.search.exact import NO_SCORE, Answers, merge, no_answers
from vplog.maps.search.index import read_column
from vplog.maps.storage.damage import reading_drive
from vplog.places.sequence import SequenceSettings, rank_places
from vplog.stages import PlaceState, index_of_part

if TYPE_CHECKING:
    from vplog.maps.storage.map_store import Store

EXACT_PLACES = 200_000
"""Up to so many places lines are drawn in every drive: some minutes of one core for a log of a thousand views."""
PLACES_A_VIEW = 100
"""Best places of each single view that vote for their drives."""
_DRIVES_A_STRETCH = 8
"""Drives chosen for each stretch of views as long as a window."""


def best_lines(
    store: Store, drives: Mapping[int, str], state: PlaceState, descriptors: Sequence[Any], top: int,
    settings: SequenceSettings, execution: Execution,
) -> Answers:  # fmt: skip
    """The `top` best places of some drives, by their numbers in the map, for each of Q views in order.

    Drives are read one after the other, so memory is that of the largest. Works for any recogniser, and for a window
    of one view. Raises LibraryError where a drive's descriptors are of another library.
    """
    best = no_answers(len(descriptors), top)
    for number, drive in execution.counted("search", drives.items(), len(drives)):
        column = read_column(store, drive, state)
        with reading_drive(drive):
            index = index_of_part(state, state.from_arrow(column))
        stops = np.full(len(descriptors), len(column), np.int64)
        rankings = rank_places(index, descriptors, stops, top, settings, Execution(execution.threads))
        found = no_answers(len(descriptors), top)
        found.drive[:] = number
        for view, (ranking, support) in enumerate(rankings):
            count = len(ranking.rows)
            found.keyframe[view, :count], found.score[view, :count] = ranking.rows, ranking.score
            found.support[view, :count] = support
        best = merge([best, found], top)
    return best


def drives_by_credit(single: Answers, length: int) -> Ints:
    """Numbers of the drives in which lines may be, rising, by the best places of each single view.

    Stretches of `length` views, each half over the last, name the drives with most credit.
    """
    view, drive, credit = drive_credits(single)
    chosen = []
    for start in range(0, len(single.score), max(length // 2, 1)):
        part = slice(*np.searchsorted(view, [start, start + length]))
        total = np.bincount(drive[part], credit[part])
        best = np.argsort(-total, kind="stable")[:_DRIVES_A_STRETCH]
        chosen.append(best[total[best] > 0])
    return np.unique(np.concatenate(chosen)) if chosen else np.empty(0, np.int64)


def drive_credits(single: Answers) -> tuple[Ints, Int32s, Floats]:
    """(C,) views, rising, drives, and the vote of each view for the drive.

    A vote is the score of the drive's best place less that of the last of the view's places, so a view that resembles
    everything has little weight.
    """
    top = single.score.shape[1]
    there = single.score > NO_SCORE
    least = np.where(there, single.score, np.inf).min(axis=1, initial=np.inf)
    full = there.sum(axis=1) == top
    credit = np.where(there, single.score - np.where(full, least, 0.0)[:, None] + np.float32(1e-6), 0.0)
    view, rank = np.nonzero(there)
    order = np.lexsort((rank, single.drive[view, rank], view))
    view, rank = view[order], rank[order]
    drive = single.drive[view, rank]
    first = np.ones(len(view), np.bool_)  # a drive's best place for a view comes first
    first[1:] = (view[1:] != view[:-1]) | (drive[1:] != drive[:-1])
    return view[first], drive[first], credit[view[first], rank[first]].astype(np.float64)
