"""References of a map's library that its places can best do without, found and left out.

Which ones go is not decided by the queries that are lost without them: among a hundred references there are always
some without which by chance none is lost. Taking these away one after the other left half of a library before the
first query of the map's own was lost, and a walk that the map had not seen found .72 of its views instead of .85. So
references go by how many each place is left with, and the queries lost only say how many.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import replace

import numpy as np

from vplog.data import Ints
from vplog.execution.execution import Execution
from vplog.maps.condensation.own_queries import OwnAnswers, OwnPlaces, query_own_places, search_in_memory
from vplog.places.code_search import CodeLists
from vplog.stages import CodedState

_LAST = 0.01
"""References that a place counts as left with when its last one goes, which keeps the logarithm finite."""


def remove_references(
    places: OwnPlaces, answers: OwnAnswers, state: CodedState, distance_m: float, most_lost: int,
    execution: Execution = Execution(),
) -> tuple[OwnPlaces, OwnAnswers, CodedState]:  # fmt: skip
    """The places by the references that stay, their answers, and the recogniser with these. No more than so many
    queries fewer are answered rightly."""
    order = by_coverage(state.lists(*places.columns))

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


def by_coverage(lists: CodeLists) -> Ints:
    """References in the order in which they go: always the one that takes least from the sum over all places of the
    logarithm of how many references each has. That is less the more of them the place has beside it, so that none is
    left with few."""
    count, blocks = lists.start.shape[0], lists.start.shape[1] - 1
    cell = np.searchsorted(lists.start[:, :-1].ravel(), np.arange(len(lists.offset)), side="right") - 1
    reference, place = cell // blocks, cell % blocks * lists.block + lists.offset
    left, gone, order = np.bincount(place, minlength=len(lists)), np.zeros(count, np.bool_), list[int]()
    while len(order) < count:
        loss = -np.log1p(-1.0 / np.maximum(left, 1.0 + _LAST))
        cost = np.bincount(reference, loss[place], count)
        order.append(int(np.where(gone, np.inf, cost).argmin()))
        gone[order[-1]] = True
        left -= np.bincount(place[reference == order[-1]], minlength=len(lists))
    return np.array(order, np.int64)
