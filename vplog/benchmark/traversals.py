"""The frames of a drive as features on disk, and which of them may answer which query."""

from __future__ import annotations

import time
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Reference
from vplog.errors import LogError
from vplog.execution.execution import Execution
from vplog.features.extraction import extract_frames

if TYPE_CHECKING:
    from vplog.data import Bytes, Features, Float32s, Floats, Ints
    from vplog.features.store import FeatureStore
    from vplog.stages import Extractor, Log


@dataclass(frozen=True, eq=False)
class Traversal:
    """The frames of a drive as features, on disk."""

    name: str
    store: FeatureStore
    """Features of row i at i."""
    frames: Ints
    """(N,) numbers of the frames in the drive, increasing."""
    stamp_ns: Ints
    """(N,)."""
    references: list[Reference]
    """The frames asked for as reference images."""
    feature_ms: Floats
    """(N,) CPU ms that the features of each frame took, decoding not included; as they were done, in no other order."""
    warnings: list[str]

    def __len__(self) -> int:
        return len(self.frames)


def extract_traversal(
    log: Log,
    extractor: Extractor,
    store: FeatureStore,
    frames: Ints | None = None,
    chosen: Ints | None = None,
    execution: Execution = Execution(),
) -> Traversal:
    """Features of the frames with these numbers (all where None), streamed into an empty store.

    The images of `chosen`, numbers among them, are kept as references. Frames that cannot be decoded are left out,
    with a warning. Raises LogError where none is left.
    """
    stamps = log.stamps()
    frames = np.arange(len(stamps)) if frames is None else frames
    wanted = set() if chosen is None else set(chosen.tolist())
    numbers, spent, references, lost = [], [], [], []

    def timed(image: Bytes, depth_m: Float32s | None = None) -> Features:
        began = time.thread_time()
        features = extractor(image, depth_m)
        spent.append(1e3 * (time.thread_time() - began))
        return features

    found = extract_frames(log.frames(stamps[frames]), timed, execution)
    for stamp_ns, frame, features, why in execution.counted(f"extract {log.name}", found, len(frames)):
        if frame is None or features is None:
            lost.append(why)
            continue
        number = int(np.searchsorted(stamps, stamp_ns))
        store.append(features)
        numbers.append(number)
        if number in wanted:
            references.append(Reference(frame.image, features, log.name, stamp_ns))
    if not numbers:
        why = f" The first: {lost[0]}" if lost else " `vplog info` shows what is in it."
        raise LogError(f"{log.name}: none of {len(frames)} frames could be decoded.{why}")
    warnings = []
    if lost:
        warnings.append(f"{log.name}: {len(lost)} of {len(frames)} frames could not be decoded. First: {lost[0]}")
    rows = np.array(numbers, np.int64)
    return Traversal(log.name, store, rows, stamps[rows], references, np.array(spent), warnings)


def candidate_stops(query_frames: Ints, map_frames: Ints, min_gap: int | None) -> Ints:
    """(Q,) each query's candidates are the map rows below this: all, or those at least `min_gap` frames older."""
    if min_gap is None:
        return np.full(len(query_frames), len(map_frames), np.int64)
    return np.searchsorted(map_frames, query_frames - min_gap, side="right").astype(np.int64)
