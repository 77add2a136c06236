"""Features of the frames of a drive in files that later comparisons of the same drive find."""

from __future__ import annotations

import os
import time
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np

from vplog.data import Bytes, Features, Float32s, Ints
from vplog.execution.execution import Execution
from vplog.features.extraction import extract_frames
from vplog.logs import TopicChoice
from vplog.results.previews import PictureSettings
from vplog.run.cache.code_hash import code_of
from vplog.run.cache.feature_shards import Extracted, packed
from vplog.run.cache.stage_cache import file_name, key_of, sealed
from vplog.run.feature_extraction import PART_KEYFRAMES, described, image_topics, is_whole
from vplog.stages import Extractor, Log
from vplog.storage.input_hashes import stat_signature
from vplog.storage.scratch import replacing
from vplog.storage.user_cache import cache_folder, max_bytes, trim


@dataclass(frozen=True)
class CacheChoice:
    """Options of the cache of features between calls."""

    folder: Path | None = None
    """None for the user's cache."""
    max_gb: float | None = None
    """Largest size in 10^9 bytes, None for the default; 0 keeps nothing."""

    def open(self) -> Path | None:
        """The folder for features, None where nothing is kept. Raises SettingsError where it cannot be used."""
        return cache_folder(self.folder, "features", self.max_gb)

    def trim(self) -> None:
        """Remove what was not used for longest, down to the largest size."""
        if (folder := self.open()) is not None:
            trim([folder], max_bytes(self.max_gb))


@dataclass(frozen=True)
class FeatureFolder:
    """A folder for the features of one drive, and what these are made from beside its frames."""

    folder: Path
    made_from: dict[str, Any] = field(default_factory=dict)
    """Plain values; the same ones stand for the same features."""

    @classmethod
    def of(cls, folder: Path, path: Path, topics: TopicChoice | None, extractor: Any) -> FeatureFolder:
        """For the drive at `path`, known by lengths and times of its files."""
        return cls(folder, {
            "files": stat_signature(path),
            "topics": None if topics is None else image_topics(topics),
            "features": extractor.model_dump(mode="json"),
            **code_of(__name__, "vplog.logs.detect", type(extractor).__module__),
        })  # fmt: skip

    def extract(self, log: Log, stamp_ns: Ints, extractor: Extractor, execution: Execution) -> Extracted:
        """Features and pictures of the frames with these stamps (N,), those that are not there yet from the log."""
        parts = [stamp_ns[at : at + PART_KEYFRAMES] for at in range(0, len(stamp_ns), PART_KEYFRAMES)]
        keys = [key_of({**self.made_from, "drive": log.name, "stamps": part.tolist()}) for part in parts]
        missing = [
            (part, key)
            for part, key in zip(parts, keys, strict=True)
            if not is_whole(self._path(key), key, part.tolist())
        ]
        wanted = [stamp for part, _ in missing for stamp in part.tolist()]
        done = len(stamp_ns) - len(wanted)
        spent: list[float] = []

        def timed(image: Bytes, depth_m: Float32s | None = None) -> Features:
            began = time.thread_time()
            features = extractor(image, depth_m)
            spent.append(round(1e3 * (time.thread_time() - began), 3))
            return features

        frames = extract_frames(log.frames(stamp_ns[np.isin(stamp_ns, wanted)]), timed, execution)
        counted = execution.part(done, len(stamp_ns)).counted(f"extract {log.name}", frames, len(stamp_ns))
        for part, key in missing:
            decoded, lost = described(islice(counted, len(part)), PictureSettings())
            times, spent[:] = spent[:], []
            with replacing(self._path(key)) as stream:
                stream.write(sealed(key, packed(decoded, lost, [], times)))
        found = Extracted()
        for key in keys:
            os.utime(self._path(key))  # used now
            found.add(self._path(key))
        return found

    def _path(self, key: str) -> Path:
        return self.folder / file_name("frames", key)
