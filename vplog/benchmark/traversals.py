"""The frames of a drive as features on disk, and which of them may answer which query."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from vplog.benchmark.feature_cache import FeatureFolder
from vplog.data import Bytes, Floats, Ints, Reference
from vplog.errors import LogError
from vplog.execution.execution import Execution
from vplog.geometry.masking import masked
from vplog.places.self_recognition import NO_IMAGE
from vplog.run.cache.feature_shards import Extracted
from vplog.stages import Extractor, Log


@dataclass(frozen=True, eq=False)
class Traversal:
    """The frames of a drive as features, on disk."""

    log: Log
    store: Extracted
    """Features and a small picture of row i at i."""
    frames: Ints
    """(N,) numbers of the frames in the drive, increasing."""
    stamp_ns: Ints
    """(N,)."""
    names: list[str] | None
    """File of each frame; None of a recording."""
    feature_ms: Floats
    """CPU ms that the features of each frame took, decoding not included; in no order."""
    warnings: list[str]

    @property
    def name(self) -> str:
        return self.log.name

    def __len__(self) -> int:
        return len(self.frames)

    def name_of(self, row: int) -> str:
        """File of a row, or its number in the drive."""
        return str(self.frames[row]) if self.names is None else self.names[row]


def extract_traversal(
    log: Log,
    extractor: Extractor,
    folder: FeatureFolder,
    frames: Ints | None = None,
    execution: Execution = Execution(),
) -> Traversal:
    """Features of the frames with these numbers (all where None), in files of the folder.

    Frames that cannot be decoded are left out, with a warning. Raises LogError where none is left.
    """
    stamps, names = log.stamps(), log.file_names()
    frames = np.arange(len(stamps)) if frames is None else frames
    store = folder.extract(log, stamps[frames], extractor, execution)
    if not len(store):
        why = f" The first: {store.lost[0]}" if store.lost else " `vplog info` shows what is in it."
        raise LogError(f"{log.name}: none of {len(frames)} frames could be decoded.{why}")
    warnings = []
    if lost := store.lost:
        warnings.append(f"{log.name}: {len(lost)} of {len(frames)} frames could not be decoded. First: {lost[0]}")
    stamp_ns = np.array(store.stamp_ns, np.int64)
    numbers = np.searchsorted(stamps, stamp_ns)
    named = None if names is None else [names[number] for number in numbers.tolist()]
    return Traversal(log, store, numbers, stamp_ns, named, np.array(store.cpu_ms), warnings)


def references_of(traversal: Traversal, numbers: Ints, images: bool = True) -> list[Reference]:
    """The frames with these numbers as references, without those that cannot be decoded; their images are not read
    again unless they count. Raises LogError."""
    log, rows = traversal.log, np.flatnonzero(np.isin(traversal.frames, numbers))
    stamp_ns = traversal.stamp_ns[rows]
    shown = images_at(log, stamp_ns) if images else [NO_IMAGE] * len(rows)
    found = zip(shown, rows.tolist(), stamp_ns.tolist(), strict=True)
    return [Reference(image, traversal.store[row], log.name, stamp) for image, row, stamp in found]


def images_at(log: Log, stamp_ns: Ints) -> list[Bytes]:
    """The grey images of the frames with these stamps (K,), increasing. Raises LogError where one is gone."""
    images = [masked(frame.decode()).image for frame in log.frames(stamp_ns)] if len(stamp_ns) else []
    if len(images) < len(stamp_ns):
        raise LogError(f"{log.name}: a frame that was read before cannot be read again. Leave the log unchanged.")
    return images


def candidate_stops(query_frames: Ints, map_frames: Ints, min_gap: int | None) -> Ints:
    """(Q,) each query's candidates are the map rows below this: all, or those at least `min_gap` frames older."""
    if min_gap is None:
        return np.full(len(query_frames), len(map_frames), np.int64)
    return np.searchsorted(map_frames, query_frames - min_gap, side="right").astype(np.int64)
