"""Place recognition of a drive by a learned recogniser: descriptors of all keyframes, and candidate closures."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from vplog.data import Int32s, Keyframes, SharedReferences
from vplog.execution.execution import Execution
from vplog.loops.propose import Proposals, ProposeSettings, candidate_stops, propose
from vplog.places.sequence import SequenceSettings, rank_places
from vplog.places.views import views_of
from vplog.run.cache.codecs import columns_codec, descriptors_codec
from vplog.run.cache.feature_shards import Extracted
from vplog.run.cache.steps import step
from vplog.stages import BoxState, Log, PlaceState


@step(
    "describe",
    lambda state, log, features: descriptors_codec(state, len(features)),
    items=lambda state, log, features: len(features),
    without=("log",),  # the features stand for the log's images
)
def describe(state: PlaceState, log: Log, features: Extracted, *, execution: Execution) -> Sequence[Any]:
    """A descriptor for every keyframe, in order."""
    views = views_of(state, log, np.array(features.stamp_ns, np.int64), features.__getitem__)
    return list(execution.counted("describe", views.described(execution), len(features)))


@step("propose", lambda *_: columns_codec(Proposals), items=lambda state, descriptors, *_: len(descriptors))
def find_candidates(
    state: PlaceState,
    descriptors: Sequence[Any],
    keyframes: Keyframes,
    settings: ProposeSettings,
    sequence: SequenceSettings,
    *,
    execution: Execution,
) -> Proposals:
    """The earlier keyframes that each may be a return to, by sequences of views or view by view."""
    index, stops = state.index(descriptors), candidate_stops(keyframes, settings)
    return propose(rank_places(index, descriptors, stops, settings.ranked, sequence, execution), settings)


def shared_of(state: PlaceState, descriptors: Sequence[Any], query: Int32s, match: Int32s) -> SharedReferences:
    """The references that explain both places of each pair of rows; none where the recogniser has no boxes."""
    if isinstance(state, BoxState):
        return state.shared(descriptors, query, match)
    return SharedReferences([np.empty(0, np.uint16)] * len(query), [np.empty(0, np.float32)] * len(query))
