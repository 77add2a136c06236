"""How probable it is that the best answer to each view is its place, learned on the answers themselves.

What look-alike places of the answer's own drive score tells what the best of them would: other drives may show the same
place, and say nothing of look-alikes. A map is larger than one drive, and the best of more of them scores higher.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Float32s, Floats, Ints
from vplog.execution.execution import Execution
from vplog.loops.match_probability import best_places, place_extent, probabilities
from vplog.maps.search.sequences import drive_index
from vplog.places.sequence import SequenceSettings, sequence_rows
from vplog.storage.scratch import scratch

if TYPE_CHECKING:
    from vplog.maps.search.exact import Answers
    from vplog.maps.storage.map_store import Store
    from vplog.stages import PlaceIndex, PlaceState


def answer_probabilities(
    store: Store, drives: Mapping[int, str], state: PlaceState, descriptors: Sequence[Any], answers: Answers,
    settings: SequenceSettings, execution: Execution = Execution(),
) -> Floats:  # fmt: skip
    """(Q,) probability of the first answer of each view; NaN without one, and of all where too few have look-alikes.

    `drives` are those that were searched, by number. Those that hold first answers are searched again, one after the
    other, for the scores of all their places, which are on disk meanwhile.
    """
    best, size = np.full((len(descriptors), 3), np.nan), np.ones(len(descriptors))
    answered = answers.count > 0
    numbers: list[int] = np.unique(answers.drive[answered, 0]).tolist()
    for number in numbers:
        views = np.flatnonzero(answered & (answers.drive[:, 0] == number))
        index, _ = drive_index(store, drives[number], state, settings)
        with scratch("scores") as folder:
            scores = _scores(index, descriptors, views, settings, folder, execution)
            extent = place_extent(scores)
            best[views] = [best_places(row, extent) for row in scores]
        size[views] = len(index)
    total = sum(store.rows("descriptors", drive) for drive in drives.values()) if answered.any() else 0
    found = probabilities(best, np.maximum(total / size, 1.0))
    return np.full(len(descriptors), np.nan) if found is None else found


def _scores(
    index: PlaceIndex, descriptors: Sequence[Any], views: Ints, settings: SequenceSettings, folder: Path,
    execution: Execution,
) -> Float32s:  # fmt: skip
    """(V, M) scores of some views, or of the lines through them, in a file of the folder."""
    found = np.lib.format.open_memmap(folder / "scores.npy", "w+", np.dtype("<f4"), (len(views), len(index)))
    if settings.length == 1:
        for at, row in enumerate(execution.map(lambda view: index.scores(descriptors[view]), views.tolist())):
            found[at] = row
        return found
    at = {view: number for number, view in enumerate(views.tolist())}
    stops = np.full(len(descriptors), len(index), np.int64)
    rows = sequence_rows(lambda view: index.scores(descriptors[view]), stops, settings, Execution(execution.threads))
    for view, (row, _) in enumerate(rows):
        if view in at:
            found[at[view]] = row
    return found
