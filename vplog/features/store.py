"""Features of every keyframe on disk, so that memory does not grow with the drive."""

from __future__ import annotations

import threading
from contextlib import suppress
from pathlib import Path
from typing import Self

import numpy as np

from vplog.data import THUMBNAIL_SIDE, Features
from vplog.errors import ResultError

SIFT_BYTES = 128
"""Bytes of a descriptor."""
_FLOAT_BYTES = 4 * 4
"""x, y, size, depth as float32, before the descriptor."""
_THUMBNAIL_BYTES = THUMBNAIL_SIDE**2


def size_of(count: int, thumbnail: bool, values: int = SIFT_BYTES) -> int:
    """Bytes of an image's features, with descriptors of `values` bytes."""
    return count * (_FLOAT_BYTES + values) + thumbnail * _THUMBNAIL_BYTES


def features_to(features: Features) -> bytes:
    """The features of an image, without its size."""
    floats = np.column_stack([features.points, features.sizes, features.depth_m]).astype("<f4")
    small = b"" if features.thumbnail is None else features.thumbnail.tobytes()
    return floats.tobytes() + features.descriptors.tobytes() + small


def features_from(
    data: bytes, count: int, width: int, height: int, thumbnail: bool, values: int = SIFT_BYTES
) -> Features:
    """`count` features of an image of this size, from the `size_of` bytes of `features_to`."""
    floats = np.frombuffer(data, "<f4", count * 4).reshape(count, 4)
    small = np.frombuffer(data, np.uint8, _THUMBNAIL_BYTES, size_of(count, False, values)) if thumbnail else None
    return Features(
        points=np.ascontiguousarray(floats[:, :2]),
        sizes=floats[:, 2],
        descriptors=np.frombuffer(data, np.uint8, count * values, count * _FLOAT_BYTES).reshape(count, values),
        depth_m=floats[:, 3],
        width=width,
        height=height,
        thumbnail=None if small is None else small.reshape(THUMBNAIL_SIDE, THUMBNAIL_SIDE),
    )


class FeatureStore:
    """A scratch file of features, one keyframe after the other. Removed on exit; reads are safe from any thread."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._entries: list[tuple[int, int, int, int, bool, int]] = []
        self._lock = threading.Lock()
        try:
            self._file = path.open("w+b")
        except OSError as error:
            raise ResultError(f"Cannot write {path}: {error.strerror}. Set TMPDIR to a folder with room.") from None

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        with suppress(OSError):  # a full disk fails again, as in append, and the file is removed
            self._file.close()
        self._path.unlink(missing_ok=True)

    def __len__(self) -> int:
        return len(self._entries)

    def append(self, features: Features) -> None:
        """Store the next keyframe's features. Raises ResultError where the disk is full."""
        try:
            with self._lock:
                offset = self._file.seek(0, 2)
                self._file.write(features_to(features))
                self._file.flush()
        except OSError as error:
            raise ResultError(
                f"Cannot store features in {self._path}: {error.strerror}. "
                f"They need about {size_of(2000, False) // 1000} kB per keyframe while the run lasts."
            ) from None
        small, values = features.thumbnail is not None, features.descriptors.shape[1]
        self._entries.append((offset, len(features), features.width, features.height, small, values))

    def __getitem__(self, row: int) -> Features:
        """The features of keyframe `row`."""
        offset, count, width, height, small, values = self._entries[row]
        with self._lock:
            self._file.seek(offset)
            data = self._file.read(size_of(count, small, values))
        return features_from(data, count, width, height, small, values)
