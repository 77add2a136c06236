"""A state of a map that is held open, and the newest one, which takes its place while others still answer by it."""

from __future__ import annotations

import weakref
from collections.abc import Sequence
from contextlib import ExitStack
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from vplog.data import Int32s, Ints
from vplog.errors import ResultError, VplogError
from vplog.execution.execution import Execution
from vplog.maps.geo_bounds import DriveBounds
from vplog.maps.localization.places import Places, opened
from vplog.maps.search.exact import best_places
from vplog.maps.search.index import SegmentView, check_content, pictures_of, update_index
from vplog.maps.search.query import MapQuery, open_map, search
from vplog.maps.search.sequences import LineSearch
from vplog.maps.storage import map_store, objects
from vplog.maps.storage.contents import damage_warnings, skip_damaged
from vplog.maps.storage.damage import reading_drive
from vplog.maps.storage.download_cache import Cache
from vplog.maps.storage.map_store import Store
from vplog.pipeline import Pipeline
from vplog.results import tables
from vplog.stages import CodedState, PlaceState
from vplog.storage.remote_path import RemotePath

_DRIVES = 4096
"""Drives whose stamps stay in memory: some 100 MB of drives of 2000 keyframes."""


class UnreadableMapError(ResultError):
    """The map cannot be read, which is no fault of what is asked."""


@dataclass(frozen=True, eq=False)
class OpenState:
    """A state of a map; its index stays in memory, or mapped into it."""

    store: Store
    drives: dict[str, dict[str, Any]]
    pipeline: Pipeline
    state: PlaceState
    parts: list[SegmentView]
    warnings: list[str]

    @cached_property
    def places(self) -> int:
        """Number of places."""
        if isinstance(self.state, CodedState):
            return sum(part.places for part in self.parts)
        return skip_damaged(
            self.store,
            lambda: sum(self.store.rows("descriptors", one) for one in self.drives if one not in self.store.damaged),
        )

    @cached_property
    def _bounds(self) -> DriveBounds:
        return DriveBounds(self.drives)

    def answers(self, descriptors: Sequence[Any], query: MapQuery) -> tuple[list[dict[str, Any]], list[str]]:
        """The best places for each view by itself, best first, as plain values; and warnings. Damaged drives are left
        out. Raises UnreadableMapError where the map cannot be read, else what is wrong with the query."""
        numbers, warnings = self._bounds.within(query.drives, query.box, str(self.store))
        try:
            answers, more = skip_damaged(self.store, lambda: self._answers(descriptors, query.top, numbers))
        except ResultError as error:
            raise UnreadableMapError(str(error)) from error
        return answers, warnings + more + damage_warnings(self.store)

    def _answers(
        self, descriptors: Sequence[Any], top: int, numbers: Ints
    ) -> tuple[list[dict[str, Any]], list[str]]:  # fmt: skip
        names, warnings = self._bounds.names, list[str]()
        numbers = np.array([one for one in numbers.tolist() if names[one] not in self.store.damaged], np.int64)
        if not len(numbers):
            return [], warnings
        if isinstance(self.state, CodedState):
            parts = [part for one in self.parts if (part := one.of(numbers)).places]
            top = min(top, sum(part.places for part in parts))
            found = best_places(parts, self.state, descriptors, top)
        else:
            only = MapQuery(top, drives=[names[number] for number in numbers.tolist()])
            found, warnings = search(self.store, self.drives, self.state, descriptors, only, LineSearch())
        answers = []
        for view, count in enumerate(found.count.tolist()):
            for rank in range(count):
                drive, row = names[int(found.drive[view, rank])], int(found.keyframe[view, rank])
                keyframe_of, stamp_ns = self._keyframes(drive)
                keyframe, score = int(keyframe_of[row]), float(found.score[view, rank])
                known = {"drive": drive, "keyframe": keyframe, "stamp_ns": int(stamp_ns[row]), "score": score}
                answers.append({"query": view, "rank": rank, **known})
        return answers, warnings

    @cached_property
    def _keyframes(self) -> Any:
        """Keyframe and stamp of the places of a drive, of the last `_DRIVES` that were asked for."""

        def read(drive: str) -> tuple[Int32s, Ints]:
            path = self.store.file(drive, "descriptors.parquet")
            with reading_drive(drive):
                found = pictures_of(self.store, drive)[0], tables.read_stamps(path)
            check_content(self.store, drive, self.drives[drive])
            return found

        return lru_cache(_DRIVES)(read)


class NewestState:
    """The newest state of a map, and the places that pictures are localised among."""

    def __init__(self, root: Path, cache: Cache | None, execution: Execution) -> None:
        """Raises VplogError where it cannot be read."""
        self.root, self._cache, self._execution = root, cache, execution
        self._mark = self._marked()
        self.now = self._opened(execution)
        self.problem = ""
        """Why the newest state cannot be read, and that before it is answered from; empty where it can."""
        self._localized: tuple[OpenState, Places] | None = None

    def refresh(self) -> bool:
        """Open the newest state if it is another one; whether it is. A state that cannot be read is tried again.

        Sets `problem` if it fails, and raises what is neither a VplogError nor an OSError."""
        before = self._mark
        try:
            if (mark := self._marked()) != before:
                self.now, self._mark = self._opened(Execution(self._execution.threads)), mark
            self.problem = ""
        except Exception as error:
            why = str(error) or type(error).__name__
            self.problem = f"The newest state of the map cannot be read, and the one before it answers: {why}"
            if not isinstance(error, VplogError | OSError):
                raise
        return self._mark != before

    def localized_in(self) -> Places:
        """The newest state's places with poses and landmarks, for one thread at a time. Raises VplogError."""
        now = self.now
        if self._localized is None or self._localized[0] is not now:
            with ExitStack() as stack:
                places = stack.enter_context(opened(self.root, Execution()))
                weakref.finalize(places, stack.pop_all().close)
            self._localized = now, places
        return self._localized[1]

    def _marked(self) -> Any:
        """What differs where the map does: of a folder, times of what is replaced and of what is renamed into it."""
        if isinstance(self.root, RemotePath):
            found = objects.get_with_version(self.root / "map.json")
            return found and found[1]
        names = ("map.json", "runs", "removed.json", "joint.json")
        return [(self.root / name).stat().st_mtime_ns for name in names if (self.root / name).exists()]

    def _opened(self, execution: Execution) -> OpenState:
        with ExitStack() as stack:
            store = stack.enter_context(map_store.reading(self.root, self._cache))
            drives, pipeline, state = open_map(store, execution)
            parts, warnings = list[SegmentView](), list[str]()

            def indexed(state: CodedState) -> tuple[dict[str, dict[str, Any]], list[SegmentView], list[str]]:
                drives = map_store.common_library(store)[1]
                return drives, *update_index(store, drives, state, execution)

            if isinstance(state, CodedState):
                drives, parts, warnings = skip_damaged(store, lambda: indexed(state))
            found = OpenState(store, drives, pipeline, state, parts, warnings)
            weakref.finalize(found, stack.pop_all().close)  # when the last answer by it is given
        return found
