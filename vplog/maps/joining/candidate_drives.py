"""Candidates for the places of new drives in the earlier drives of a map."""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from vplog.execution.execution import Execution
from vplog.maps.geo_bounds import DriveBounds
from vplog.maps.joining.inter_session import Candidates, PlacesByCamera, candidates_among
from vplog.maps.search.exact import best_places
from vplog.maps.search.index import read_column, rows_on_keyframes, update_index
from vplog.maps.search.sequences import PLACES_A_VIEW, drive_votes
from vplog.maps.storage.damage import reading_drive
from vplog.stages import CodedState, PlaceState

if TYPE_CHECKING:
    from vplog.maps.storage.map_store import Store
    from vplog.pipeline import Pipeline

_CHOICE = 3
"""Drives searched for each that may be verified, so that `likely_drives` has enough to choose from. Single views and
sequences seldom differ in which drives score high, but in their order."""
_AT_ONCE = 64
"""New drives that are searched in one earlier drive while its places are in memory; theirs are too, some 40 MB."""


def places_of(store: Store, drive: str, state: PlaceState) -> Sequence[Any]:
    """The place of each keyframe of a drive, in a condensed map the nearest that it has; then those of the pictures of
    further cameras. Raises DamagedDriveError where they are of another recogniser."""
    column, rows_of = read_column(store, drive, state), rows_on_keyframes(store, drive)
    own_rows, nearest = rows_of.get(0, (slice(0, 0), None))
    if len(rows_of) > 1:  # pictures of further cameras come after those of all keyframes
        known = np.arange(own_rows.stop - own_rows.start) if nearest is None else nearest
        if more := store.rows("keyframes", drive) - len(known):
            nearest = np.concatenate([known, np.repeat(known[-1:], more)])
    with reading_drive(drive):
        found = {camera: state.from_arrow(column[rows]) for camera, (rows, _) in rows_of.items() if camera}
        first = column if not found else column[rows_of[0][0]]
        own = state.from_arrow(first if nearest is None else first.take(pa.array(nearest)))
    return PlacesByCamera([own, *(found.get(n, []) for n in range(1, max(found) + 1))]) if found else own


def candidates_of(
    store: Store, drives: Mapping[str, Mapping[str, Any]], new: Sequence[int], state: PlaceState, pipeline: Pipeline,
    execution: Execution = Execution(),
) -> dict[int, Candidates]:  # fmt: skip
    """For each new drive, by number, its best candidates in the drives of `drives_to_search`. `drives` are the records
    of all, in order."""
    names, found = list(drives), dict[int, Candidates]()
    counts = [min(number, _CHOICE * pipeline.join.most_drives) for number in new]
    for first in range(0, len(new), _AT_ONCE):
        block = {number: places_of(store, names[number], state) for number in new[first : first + _AT_ONCE]}
        searched = drives_to_search(store, drives, block, state, pipeline, Execution(execution.threads))
        found |= candidates_among(
            block, lambda number: places_of(store, names[number], state), searched, state, pipeline,
            execution.part(sum(counts[:first]), sum(counts)),
        )  # fmt: skip
    return found


def drives_to_search(
    store: Store, drives: Mapping[str, Mapping[str, Any]], later: Mapping[int, Sequence[Any]], state: PlaceState,
    pipeline: Pipeline, execution: Execution = Execution(),
) -> dict[int, Collection[int]]:  # fmt: skip
    """For each drive of `later`, places by number, the drives of a lower number that it is searched in: those that may
    be near, and where these are many the ones with most votes of its single views, by the map's index. A drive may be
    near unless both have GPS bounds that are more than `join.apart_m` apart.

    So the cost of a further drive grows as that of a query of the map, not with the number of drives. Maps of
    recognisers without an index are searched drive by drive.
    """
    most, bounds = _CHOICE * pipeline.join.most_drives, DriveBounds(drives)
    near = {number: np.flatnonzero(bounds.near(number, pipeline.join.apart_m)[:number]) for number in later}
    searched: dict[int, Collection[int]] = {number: rows.tolist() for number, rows in near.items()}
    if max(map(len, near.values())) <= most or not isinstance(state, CodedState):
        return searched
    # places that are found and not joined stay in the index
    found = {drive: about for drive, about in store.drives().items() if about["library"] == state.hash}
    every = {**drives, **found}
    parts, _ = update_index(store, every, state, execution)
    for number, views in later.items():
        if len(near[number]) <= most:
            continue
        numbers = np.full(len(every) + 1, -1, np.int32)  # the last stands for drives that are in no part
        numbers[near[number]] = near[number]
        before = [replace(part, numbers=numbers[part.numbers]) for part in parts]
        _, drive, votes = drive_votes(best_places(before, state, views, PLACES_A_VIEW, execution))
        like = np.bincount(drive, votes, number)
        best = np.lexsort((np.arange(number), -like))[:most]
        searched[number] = np.sort(best[like[best] > 0]).tolist()
    return searched
