"""References of a map's library that its right answers owe least to.

Which ones go is not decided by the queries that are lost without them: among a hundred references there are always
some without which by chance none is lost, and taking these away one after the other until one is removes half of a
library, which drives that the map has not seen miss (`python -m tests.benchmarks condense`). So they go in the order
of what they add to right answers, and the queries lost only say how many.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import replace
from typing import TYPE_CHECKING, cast

import numpy as np
import pyarrow as pa

from vplog.execution.execution import Execution
from vplog.maps.condensation.own_queries import OwnAnswers, OwnPlaces, query_own_places, search_in_memory

if TYPE_CHECKING:
    from vplog.data import Ints
    from vplog.stages import BoxState, CodedState

_MOST_PAIRS = 20_000
"""Queries, evenly along the map, whose answers tell what the references add: two hundred for each of a hundred."""


def remove_references(
    places: OwnPlaces, answers: OwnAnswers, state: CodedState, distance_m: float, most_lost: int,
    execution: Execution = Execution(),
) -> tuple[OwnPlaces, OwnAnswers, CodedState]:  # fmt: skip
    """The places by the references that stay, their answers, and the recogniser with these. No more than so many
    queries fewer are answered rightly."""
    order = _least_needed(places, answers, state)

    def without(count: int) -> tuple[OwnPlaces, OwnAnswers, CodedState]:
        retained = np.sort(order[count:])
        small = state.subset(retained, execution)
        own = replace(places, columns=[state.on_subset(column, retained) for column in places.columns])
        search = search_in_memory(own, small, execution)
        return own, query_own_places(own, search, small, distance_m, execution), small

    def lost(count: int) -> int:
        return len(answers.place) - len(without(count)[1].place)

    count = bisect_right(range(1, len(order)), most_lost, key=lost)
    return without(count) if count else (places, answers, state)


def _least_needed(places: OwnPlaces, answers: OwnAnswers, state: CodedState) -> Ints:
    """(L,) references by how much of the boxes of queries and their right answers is common on them, least first."""
    step = -(-len(answers.place) // _MOST_PAIRS) or 1
    match = np.array([one.rows[0] for one in answers.queries.best[::step]], np.int64)
    column = pa.concat_arrays(places.columns).take(pa.array(np.concatenate([answers.place[::step], match])))
    query = np.arange(len(match), dtype=np.int32)
    shared = cast("BoxState", state).shared(state.from_arrow(column), query, query + np.int32(len(match)))
    parts = zip(shared.references, shared.overlap, strict=True)
    needed = np.zeros(state.shape[0])
    for references, overlap in parts:
        needed[references] += overlap
    return np.argsort(needed, kind="stable")
