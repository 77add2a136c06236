"""Features of the frames of a drive in files that later comparisons of the same drive find."""

from __future__ import annotations

import os
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
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
from vplog.storage.scratch import replacing, scratch
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

    @contextmanager
    def opened(self, otherwise: Path) -> Iterator[tuple[Path, Path]]:
        """The folder for features, and one for links to those in use, for a block: both `otherwise` where nothing is
        kept. What was not used for longest goes before and after it, down to the largest size; linked files stay for
        those who read them."""
        folder = self.open()
        if folder is None:
            yield otherwise, otherwise
            return
        trim([folder], max_bytes(self.max_gb))
        try:
            with scratch("open", among=folder) as links:
                yield folder, links
        finally:
            trim([folder], max_bytes(self.max_gb))


@dataclass(frozen=True)
class FeatureFolder:
    """A folder for the features of one drive, and what these are made from beside its frames."""

    folder: Path
    links: Path
    """A folder for links to the files in use, which outlast their removal."""
    made_from: dict[str, Any] = field(default_factory=dict)
    """Plain values; the same ones stand for the same features."""

    @classmethod
    def of(
        cls, folder: Path, links: Path, path: Path, topics: TopicChoice | None, log: Log, extractor: Any
    ) -> FeatureFolder:
        """For the drive at `path`, which is `log`, known by lengths and times of its files."""
        return cls(folder, links, {
            "files": stat_signature(path),
            "topics": None if topics is None else image_topics(topics, log.camera().name),
            "features": extractor.model_dump(mode="json"),
            **code_of(__name__, "vplog.logs.detect", type(extractor).__module__),
        })  # fmt: skip

    def extract(self, log: Log, stamp_ns: Ints, extractor: Extractor, execution: Execution) -> Extracted:
        """Features and pictures of the frames with these stamps (N,), those that are not there yet from the log."""
        parts = [stamp_ns[at : at + PART_KEYFRAMES] for at in range(0, len(stamp_ns), PART_KEYFRAMES)]
        keys = [key_of({**self.made_from, "drive": log.name, "stamps": part.tolist()}) for part in parts]
        paths = {key: self._linked(key) for key in keys}
        missing = [
            (part, key) for part, key in zip(parts, keys, strict=True) if not is_whole(paths[key], key, part.tolist())
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
            paths[key] = self._linked(key)
        found = Extracted()
        for key in keys:
            found.add(paths[key])
        return found

    def _linked(self, key: str) -> Path:
        """The file of a part by a link of its own, marked as used now."""
        path = self._path(key)
        link = self.links / path.name
        if link == path:
            return path
        with suppress(OSError):  # it is not there yet, or the file system has no links
            link.unlink(missing_ok=True)
            os.link(path, link)
            os.utime(path)
            return link
        return path

    def _path(self, key: str) -> Path:
        return self.folder / file_name("frames", key)
