"""The frames of a drive as features on disk, and which of them may answer which query."""

from __future__ import annotations

from contextlib import suppress
from dataclasses import dataclass

import numpy as np

from vplog.benchmark.feature_cache import FeatureFolder
from vplog.data import Bytes, Features, Floats, Ints, Reference
from vplog.errors import LogError
from vplog.execution.execution import Execution
from vplog.geometry.masking import masked
from vplog.places.self_recognition import NO_IMAGE
from vplog.run.cache.feature_shards import Extracted
from vplog.stages import Extractor, Log
from vplog.storage.image_file import decode_image


@dataclass(frozen=True, eq=False)
class Traversal:
    """The frames of a drive, one a row, and the features of those that can be decoded, on disk."""

    log: Log
    frames: Ints
    """(N,) numbers of the frames in the drive, increasing."""
    stamp_ns: Ints
    """(N,)."""
    names: list[str] | None
    """File of each frame; None of a recording."""
    store: Extracted
    """Features and small pictures of K frames."""
    decoded: Ints
    """(K,) rows of the frames in `store`, increasing."""
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

    def features(self, row: int) -> Features:
        """Return the features of a row that is among `decoded`."""
        return self.store[int(np.searchsorted(self.decoded, row))]

    def picture(self, row: int) -> Bytes | None:
        """Return the grey picture (H, W) of a row, small if it is stored, or None if it cannot be decoded."""
        if row in self.decoded:
            return decode_image(self.store.picture(int(np.searchsorted(self.decoded, row))))
        with suppress(LogError):
            return images_at(self.log, self.stamp_ns[[row]])[0]
        return None


def extract_traversal(
    log: Log,
    extractor: Extractor,
    folder: FeatureFolder,
    frames: Ints | None = None,
    execution: Execution = Execution(),
) -> Traversal:
    """Extract the features of the frames with these numbers (all if None) to files of the folder.

    Frames that cannot be decoded have no features, and there is a warning. Raises LogError if no frame can be decoded.
    """
    frames = np.arange(len(log.stamps())) if frames is None else frames
    stamp_ns = log.stamps()[frames]
    store = folder.extract(log, stamp_ns, extractor, execution)
    if not len(store):
        why = f" The first: {store.lost[0]}" if store.lost else " `vplog info` shows what is in it."
        raise LogError(f"{log.name}: none of {len(frames)} frames could be decoded.{why}")
    warnings = []
    if lost := store.lost:
        warnings.append(f"{log.name}: {len(lost)} of {len(frames)} frames could not be decoded. First: {lost[0]}")
    decoded = np.searchsorted(stamp_ns, store.stamp_ns)
    return Traversal(log, frames, stamp_ns, _names_of(log, frames), store, decoded, np.array(store.cpu_ms), warnings)


def without_features(log: Log, frames: Ints) -> Traversal:
    """Return the frames with these numbers for methods that need no pixels: none is decoded."""
    nothing = np.zeros(0, np.int64)
    return Traversal(log, frames, log.stamps()[frames], _names_of(log, frames), Extracted(), nothing, nothing / 1.0, [])


def _names_of(log: Log, frames: Ints) -> list[str] | None:
    names = log.file_names()
    return None if names is None else [names[number] for number in frames.tolist()]


def references_of(traversal: Traversal, numbers: Ints, images: bool = True) -> list[Reference]:
    """The frames with these numbers as references, without those that cannot be decoded; their images are not read
    again unless they count. Raises LogError."""
    log, decoded = traversal.log, traversal.decoded
    chosen = np.flatnonzero(np.isin(traversal.frames[decoded], numbers))
    stamp_ns = traversal.stamp_ns[decoded[chosen]]
    shown = images_at(log, stamp_ns) if images else [NO_IMAGE] * len(chosen)
    found = zip(shown, chosen.tolist(), stamp_ns.tolist(), strict=True)
    return [Reference(image, traversal.store[at], log.name, stamp) for image, at, stamp in found]


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
