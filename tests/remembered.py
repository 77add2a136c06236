"""Functions of bytes that tests call again and again for the same ones: what they gave is kept on disk for all workers.

The first call is always real; what the same call gives another time, or in another thread, is tested without this.
"""

from __future__ import annotations

import hashlib
import os
import pickle
import threading
from pathlib import Path
from typing import TYPE_CHECKING, Any

import faiss

from vplog.features.sift import SiftSettings
from vplog.places import coverage, library, matches, vocabulary

if TYPE_CHECKING:
    from collections.abc import Callable

    import pytest

    from vplog.data import Bytes, Float32s

MOST_PX = 200_000
"""Of an image whose features are kept: frames of the demo have 83,000, and those of real drives come once."""


def remember(patch: pytest.MonkeyPatch, folder: Path) -> None:
    """Keep SIFT of small images, and indices of descriptors."""
    detect, hnsw, serialized = SiftSettings._detect, library.hnsw, faiss.serialize_index

    def detect_once(settings: SiftSettings, pixels: Bytes) -> Any:
        if pixels.size > MOST_PX:
            return detect(settings, pixels)
        told = (pixels.shape, settings.max_features, settings.contrast_threshold)
        return _once(folder, pixels.tobytes(), told, lambda: detect(settings, pixels))

    def hnsw_once(values: Float32s, *options: int) -> Any:
        made = _once(folder, values.tobytes(), (values.shape, *options), lambda: serialized(hnsw(values, *options)))
        return faiss.deserialize_index(made)

    patch.setattr(SiftSettings, "_detect", detect_once)
    for module in (coverage, library, matches, vocabulary):
        patch.setattr(module, "hnsw", hnsw_once)


def _once(folder: Path, data: bytes, told: tuple[object, ...], make: Callable[[], Any]) -> Any:
    file = folder / hashlib.sha256(data + repr(told).encode()).hexdigest()
    if file.exists():
        return pickle.loads(file.read_bytes())  # noqa: S301 (of this session)
    made = make()
    part = file.with_name(f"{file.name}.{os.getpid()}.{threading.get_ident()}")
    part.write_bytes(pickle.dumps(made))
    part.replace(file)
    return made
