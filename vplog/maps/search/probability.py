"""Probability that the best answer to each view is its place, learned on the answers themselves.

It is compared with the best score that look-alike places would reach, which is estimated from the answer's own drive:
other drives may show the same place, and are no look-alikes. The estimate is scaled up to the size of the map, since
the best of more look-alikes scores higher.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Floats
from vplog.execution.execution import Execution
from vplog.loops.match_probability import LookAlikes, probabilities
from vplog.maps.search.sequences import drive_indexes
from vplog.places.sequence import SequenceSettings
from vplog.storage.mapped_table import mapped_scores
from vplog.storage.scratch import scratch

if TYPE_CHECKING:
    from vplog.maps.search.exact import RankedPlaces
    from vplog.maps.storage.map_store import Store
    from vplog.stages import PlaceState


def answer_probabilities(
    store: Store, drives: Mapping[int, str], state: PlaceState, descriptors: Sequence[Any], answers: RankedPlaces,
    look_alikes: LookAlikes | None, execution: Execution = Execution(),
) -> Floats:  # fmt: skip
    """(Q,) probability of the first answer of each view; NaN without one, and of all where too few have look-alikes.

    `drives` are those that were searched, by number. A search for single views leaves out most places, and has no
    `look_alikes`: those that hold first answers are then scored whole, one after the other.
    """
    answered = answers.count > 0
    if look_alikes is None:
        look_alikes, numbers = LookAlikes.of(len(descriptors)), np.unique(answers.drive[answered, 0])
        for number in numbers.tolist():
            views = np.flatnonzero(answered & (answers.drive[:, 0] == number))
            [(_, index, _)] = drive_indexes(store, drives[number], state, SequenceSettings(length=1))
            with scratch("scores") as folder:
                scores = mapped_scores(folder / "scores.npy", (len(views), len(index)))
                for at, row in enumerate(execution.map(lambda view: index.scores(descriptors[view]), views.tolist())):  # noqa: B023
                    scores[at] = row
                look_alikes.take(scores, np.arange(len(views)), views)
    total = sum(store.rows("descriptors", drive) for drive in drives.values()) if answered.any() else 0
    found = probabilities(look_alikes.best, np.maximum(total / look_alikes.rows, 1.0))
    return np.full(len(descriptors), np.nan) if found is None else found
