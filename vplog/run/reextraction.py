"""Features of the keyframes of a finished drive, extracted from its log again."""

from __future__ import annotations

import threading
from collections.abc import Iterable
from typing import TYPE_CHECKING

from vplog.data import Features, Ints
from vplog.errors import LogError
from vplog.features.extraction import extract_frames
from vplog.features.store import FeatureStore
from vplog.stages import Log

if TYPE_CHECKING:
    from vplog.execution.execution import Execution
    from vplog.run.feature_extraction import Extraction

_BLOCK = 16
"""Keyframes extracted together where one was not announced: its neighbours are needed next, and to read a log again
costs as much as several."""


class ReextractedFeatures:
    """Features of keyframes, extracted from the log on demand. Reads are safe from any thread."""

    def __init__(
        self, log: Log, stamp_ns: Ints, settings: Extraction, store: FeatureStore, execution: Execution
    ) -> None:
        self._log, self._stamp_ns, self._settings, self._execution = log, stamp_ns, settings, execution
        self._store, self._at = store, dict[int, int]()
        self._lock = threading.Lock()

    def fetch(self, rows: Iterable[int]) -> None:
        """Extract the features of those rows that lack them, in one pass of the log. Raises LogError."""
        with self._lock:
            missing = [row for row in sorted({int(row) for row in rows}) if row not in self._at]
            if not missing:
                return
            settings, frames = self._settings, self._log.frames(self._stamp_ns[missing])
            found = extract_frames(frames, settings.features, self._execution, settings.stereo)
            for row, (stamp_ns, _, features, why) in zip(missing, found, strict=False):
                if features is None or stamp_ns != self._stamp_ns[row]:
                    raise LogError(f"The log {self._log.name} does not have keyframe {row} of the drive. {why}")
                self._store.append(features)
                self._at[row] = len(self._store) - 1
            if missing[-1] not in self._at:
                raise LogError(
                    f"The log {self._log.name} does not have all keyframes of the drive. Give the whole log of the run."
                )

    def __getitem__(self, row: int) -> Features:
        if row not in self._at:
            first = row - row % _BLOCK
            self.fetch(range(first, min(first + _BLOCK, len(self._stamp_ns))))
        return self._store[self._at[row]]
