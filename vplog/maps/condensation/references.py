"""References of a map's library that its places can best do without, found and left out.

Which ones go is not decided by the queries that are lost without them: among a hundred references there are always
some without which by chance none is lost. Taking these away one after the other left half of a library before the
first query of the map's own was lost, and a walk that the map had not seen found .72 of its views instead of .85. So
references go at even steps of each drive and, of equal gaps, by how many each place is left with; the queries lost only
say how many. By the latter alone half of a library left .74 where even steps left .77, and both together .81.
"""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from vplog.data import Ints, Reference
from vplog.execution.execution import Execution
from vplog.maps.condensation.own_queries import OwnAnswers, OwnPlaces, query_own_places, search_in_memory
from vplog.maps.condensation.redundancy import Gaps
from vplog.places.code_search import CodeLists
from vplog.stages import CodedState

_LAST = 0.01
"""References that a place counts as left with when its last one goes, which keeps the logarithm finite."""


def remove_references(
    places: OwnPlaces, answers: OwnAnswers, state: CodedState, distance_m: float, most_lost: int,
    execution: Execution = Execution(),
) -> tuple[OwnPlaces, OwnAnswers, CodedState, Ints]:  # fmt: skip
    """The places by the references that stay, their answers, the recogniser with these, and their numbers before. No
    more than so many queries fewer are answered rightly."""
    order = removal_order(state.lists(*places.columns), state.references)

    def without(count: int) -> tuple[OwnPlaces, OwnAnswers, CodedState, Ints]:
        retained = np.sort(order[count:])
        small = state.subset(retained, execution)
        own = replace(places, columns=[state.on_subset(column, retained) for column in places.columns])
        search = search_in_memory(own, small, execution)
        return own, query_own_places(own, search, small, distance_m, execution), small, retained

    def lost(count: int) -> int:
        return len(answers.place) - len(without(count)[1].place)

    count = bisect_right(range(1, len(order)), most_lost, key=lost)
    return without(count) if count else (places, answers, state, np.arange(len(order)))


def removal_order(lists: CodeLists, references: Sequence[Reference]) -> Ints:
    """References in the order in which they go: always one that leaves the smallest gap among those of its drive, in
    which a library has them at even steps; of these the one that takes least from the sum over all places of the
    logarithm of how many references each has. That is less the more of them the place has beside it, so that none is
    left with few."""
    count, blocks = lists.start.shape[0], lists.start.shape[1] - 1
    cell = np.searchsorted(lists.start[:, :-1].ravel(), np.arange(len(lists.offset)), side="right") - 1
    reference, place = cell // blocks, cell % blocks * lists.block + lists.offset
    left, order = np.bincount(place, minlength=len(lists)), list[int]()
    along = np.array(sorted(range(count), key=lambda row: (references[row].drive, references[row].stamp_ns)))
    drive = np.unique([references[row].drive for row in along.tolist()], return_inverse=True)[1]
    gaps, rest = Gaps.of(drive, np.arange(float(count))), np.ones(count, np.bool_)
    while rest.any():
        gap = gaps.without(np.arange(count))
        loss = -np.log1p(-1.0 / np.maximum(left, 1.0 + _LAST))
        cost = np.bincount(reference, loss[place], count)[along]
        at = int(np.where(rest & (gap == gap[rest].min()), cost, np.inf).argmin())
        order.append(int(along[at]))
        rest[at] = False
        gaps.remove(at)
        left -= np.bincount(place[reference == order[-1]], minlength=len(lists))
    return np.array(order, np.int64)
