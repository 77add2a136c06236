"""References of a map's library that fewest of its places name, found and left out.

Which ones go is not decided by the queries that are lost without them: among a hundred references there are always
some without which by chance none is lost. Taking these away one after the other left half of a library before the
first query of the map's own was lost, and a walk that the map had not seen found .72 of its views instead of .85. So
references go in the order of the places that name them, and the queries lost only say how many.
"""

from __future__ import annotations

from bisect import bisect_right
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vplog.execution.execution import Execution
from vplog.maps.condensation.own_queries import OwnAnswers, OwnPlaces, query_own_places, search_in_memory

if TYPE_CHECKING:
    from vplog.stages import CodedState


def remove_references(
    places: OwnPlaces, answers: OwnAnswers, state: CodedState, distance_m: float, most_lost: int,
    execution: Execution = Execution(),
) -> tuple[OwnPlaces, OwnAnswers, CodedState]:  # fmt: skip
    """The places by the references that stay, their answers, and the recogniser with these. No more than so many
    queries fewer are answered rightly."""
    start = state.lists(*places.columns).start
    order = np.argsort(start[:, -1] - start[:, 0], kind="stable")

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
