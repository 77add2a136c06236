"""The features and pictures of a drive's keyframes, in the files that extraction left in the stage cache."""

from __future__ import annotations

import json
import os
import struct
from collections.abc import Iterable, Sequence
from copy import copy
from itertools import pairwise
from pathlib import Path
from typing import NamedTuple

import numpy as np

from vplog.data import Bools, Features
from vplog.errors import ResultError
from vplog.features.matching import MatchSettings, PairMatches
from vplog.features.store import SIFT_BYTES, features_from, features_to, size_of
from vplog.run.cache.stage_cache import CONTENT_AT, AbsentError, DamagedError

_LENGTH = struct.Struct("<I")
"""Bytes of the JSON head of a part, which comes before its features and pictures."""
_TIME = np.dtype("<f4")
"""Type of the CPU times, which come after them."""


class _Row(NamedTuple):
    """Position of a keyframe's features and picture in the file of its part."""

    stamp_ns: int
    offset: int
    """Offset from the end of the head, in bytes."""
    features: int
    width: int
    height: int
    thumbnail: int
    """1 where there is one."""
    picture: int
    """Bytes of the picture, which follows the features; 0 for none."""
    values: int = SIFT_BYTES
    """Bytes of a descriptor."""

    @property
    def size(self) -> int:
        """Bytes of the features."""
        return size_of(self.features, bool(self.thumbnail), self.values)

    @property
    def end(self) -> int:
        return self.offset + self.size + self.picture


class Extracted:
    """Features and pictures of keyframes in the files of their parts. Reads are safe from any thread."""

    def __init__(self) -> None:
        self.stamp_ns: list[int] = []
        """Stamps of the keyframes that were decoded."""
        self.lost: list[str] = []
        """Reasons of the frames that were not decoded."""
        self.undecodable: list[tuple[str, int]] = []
        """Topic and stamp of each message whose image does not decode, those beside a sound one among them."""
        self.cpu_ms: list[float] = []
        """CPU time of features, where the parts say it."""
        self.files: list[str] = []
        self._blank: frozenset[int] = frozenset()
        self._rows: list[tuple[Path, int, _Row]] = []
        self._matches: dict[MatchSettings, PairMatches] = {}

    def add(self, path: Path) -> None:
        """Take the keyframes of the next part. Raises DamagedError, and AbsentError where there is no such file."""
        try:
            with path.open("rb") as stream:
                length = stream.seek(0, os.SEEK_END)
                stream.seek(CONTENT_AT)
                begin = CONTENT_AT + _LENGTH.size + (head_bytes := _LENGTH.unpack(stream.read(_LENGTH.size))[0])
                if begin > length:
                    raise DamagedError("its header is longer than the file")
                head = json.loads(stream.read(head_bytes))
                rows = [_Row(*map(int, row)) for row in head["rows"]]
                for row in rows:
                    if min(row[1:]) < 0 or not row.width or not row.height or begin + row.end > length:
                        raise DamagedError("its header points beyond its end")
                stream.seek(begin + max((row.end for row in rows), default=0))
                cpu_ms = np.frombuffer(stream.read(), _TIME).tolist()
            lost = [str(why) for why in head["lost"]]
            undecodable = [(str(topic), int(stamp_ns)) for topic, stamp_ns in head["undecodable"]]
        except FileNotFoundError:
            raise AbsentError from None
        except (OSError, ValueError, TypeError, KeyError, RecursionError, struct.error) as error:
            raise DamagedError(f"its header cannot be read: {error}") from None
        self.stamp_ns += [row.stamp_ns for row in rows]
        self.lost += lost
        self.undecodable += undecodable
        self.cpu_ms += cpu_ms
        self.files.append(path.name)
        self._rows += [(path, begin, row) for row in rows]

    @property
    def token(self) -> str:
        """Stands for all that the features were made from: the names of the files hold the hashes of that."""
        return " ".join([*self.files, *map(str, sorted(self._blank))])

    def __len__(self) -> int:
        return len(self._rows)

    def __getitem__(self, at: int) -> Features:
        """The features of keyframe `at`. Raises ResultError where its file is gone."""
        path, begin, row = self._rows[at]
        data = _bytes_at(path, begin + row.offset, row.size)
        found = features_from(data, row.features, row.width, row.height, bool(row.thumbnail), row.values)
        return found.rows(slice(0)) if at in self._blank else found

    def repeats(self) -> Bools:
        """(N,) whether each keyframe shows the picture of the one before: features that are the same to the last bit,
        whatever their depth. Only keyframes whose sizes are alike are read."""
        found = np.zeros(len(self), bool)
        for at, ((_, _, before), (_, _, row)) in enumerate(pairwise(self._rows), 1):
            if row.features and row[2:] == before[2:]:
                one, other = self[at - 1], self[at]
                same = np.array_equal(one.points, other.points)
                found[at] = same and np.array_equal(one.descriptors, other.descriptors)
        return found

    def blank(self, rows: Bools) -> Extracted:
        """The keyframes, some (N,) of them without features."""
        found = copy(self)
        found._blank, found._matches = frozenset(np.flatnonzero(rows).tolist()), {}
        return found

    def matches(self, settings: MatchSettings) -> PairMatches:
        """Matches of pairs of keyframes, shared by the steps of a run."""
        return self._matches.setdefault(settings, PairMatches(self.__getitem__, settings))

    @property
    def counts(self) -> list[int]:
        """Number of features of each keyframe."""
        return [0 if at in self._blank else row.features for at, (_, _, row) in enumerate(self._rows)]

    @property
    def has_pictures(self) -> bool:
        return any(row.picture for _, _, row in self._rows)

    def picture(self, at: int) -> bytes:
        """The JPEG of keyframe `at`; empty where pictures are switched off."""
        path, begin, row = self._rows[at]
        return _bytes_at(path, begin + row.offset + row.size, row.picture)


def _bytes_at(path: Path, offset: int, length: int) -> bytes:
    try:
        with path.open("rb", buffering=0) as stream:
            stream.seek(offset)
            data = stream.read(length)
    except OSError as error:
        raise ResultError(f"Cannot read {path}: {error.strerror}. Did another run use the folder? Run again.") from None
    if len(data) != length:
        raise ResultError(f"{path} was cut off while it was in use. Run again.")
    return data


def packed(
    decoded: Iterable[tuple[int, Features, bytes]], lost: Sequence[str], undecodable: Sequence[tuple[str, int]],
    cpu_ms: Sequence[float] = (),
) -> bytes:  # fmt: skip
    """Content of the file of a part: stamp, features and picture of its keyframes, and why others were lost. `cpu_ms`
    is for comparisons, and a run's parts have none; the same input gives other times, which come last, so that all else
    is in its place for those who have opened the file when another process writes it again."""
    rows, chunks, at = [], [], 0
    for stamp_ns, features, picture in decoded:
        data, small = features_to(features), int(features.thumbnail is not None)
        size, values = (features.width, features.height), features.descriptors.shape[1]
        rows.append(_Row(stamp_ns, at, len(features), *size, small, len(picture), values))
        chunks += [data, picture]
        at += len(data) + len(picture)
    head = json.dumps({"rows": rows, "lost": lost, "undecodable": undecodable}).encode()
    return b"".join([_LENGTH.pack(len(head)), head, *chunks, np.array(cpu_ms, _TIME).tobytes()])
