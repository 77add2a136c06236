"""The frames of a log as a recogniser takes them: as features, as images, or as descriptors that are there already."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass
from typing import Any

from vplog.data import Features, Ints
from vplog.execution.execution import Execution
from vplog.geometry.masking import masked
from vplog.stages import FrameState, Log, PlaceState, StoredState


@dataclass(frozen=True)
class Views:
    """N frames in order; `describe(load(item))` of each item is its descriptor."""

    items: Iterable[Any]
    load: Callable[[Any], Any]
    describe: Callable[[Any], Any]

    def described(self, execution: Execution) -> Iterator[Any]:
        """The descriptors, in order."""
        return execution.map(lambda item: self.describe(self.load(item)), self.items, ahead=2)


def views_of(
    state: PlaceState, log: Log, stamp_ns: Ints, features: Callable[[int], Features | None], query: bool | None = False
) -> Views:
    """The frames of `log` with these stamps (N,), of which `features(row)` are the local features.

    `query` says whether the log is that of a pair whose frames are looked for; None: it is both in turn. Raises
    LibraryError where stored descriptors are not those of the log.
    """
    if isinstance(state, StoredState):
        return Views(state.stored(log, stamp_ns, query), lambda one: one, lambda one: one)
    if isinstance(state, FrameState):
        return Views(log.frames(stamp_ns), lambda encoded: masked(encoded.decode(state.colour)), state.describe_frame)
    return Views(range(len(stamp_ns)), features, state.describe)
