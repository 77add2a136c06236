"""The index of a map on disk: segments, of which each holds the places of some drives.

It grows as a log-structured index does: new drives make a new segment, which takes in those not larger than itself, so
that there are few of them and a place is written again only as often as the map doubles. A segment names its drives by
content, so MAP/index alone determines which segments serve. The folder may be removed at any time.
"""

from __future__ import annotations

import os
import time
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from itertools import accumulate
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa

from vplog.data import Int32s, Ints
from vplog.errors import LibraryError, ResultError
from vplog.execution.execution import Execution
from vplog.maps.search.segment import SUFFIX, Content, Segment, open_segment, write_segment
from vplog.maps.storage.contents import library_mismatch
from vplog.maps.storage.damage import DamagedDriveError, files_of, reading_drive
from vplog.maps.storage.layout import ADD_AGAIN, grouped
from vplog.results import tables

if TYPE_CHECKING:
    from vplog.maps.storage.map_store import Store
    from vplog.maps.storage.remote_map import StoredFile
    from vplog.stages import CodedState, PlaceState

CAPACITY = 1 << 20
"""Places of a segment, unless a single drive has more: some 140 MB, and while it is made twice that in memory."""
_LEFT_OVER_S = 86_400.0
"""Age of a half-written file of a process that was killed: no segment takes a day."""


@dataclass(frozen=True, eq=False)
class SegmentView:
    """A segment, and which of its drives a search takes from it."""

    segment: Segment
    path: Path | None
    """None where it is in memory alone."""
    numbers: Int32s
    """(D,) number of each of its drives in the map; -1 where the map no longer has it, or another segment has it."""
    stored: StoredFile | None = None
    """Where a map on an object store has it, for other machines."""

    @property
    def places(self) -> int:
        """Number of places that the map still has."""
        return int(np.diff(self.segment.first)[self.numbers >= 0].sum())

    def of(self, numbers: Iterable[int]) -> SegmentView:
        """The segment with the drives of these numbers alone."""
        return replace(
            self, numbers=np.where(np.isin(self.numbers, np.fromiter(numbers, np.int32)), self.numbers, np.int32(-1))
        )


def update_index(
    store: Store, drives: Mapping[str, Mapping[str, Any]], state: CodedState, execution: Execution = Execution()
) -> tuple[list[SegmentView], list[str]]:
    """The parts that together have every place of the drives once, and warnings.

    Missing segments are made and written; those that no drive needs any more are removed. A map that cannot be written
    to is indexed in memory. Raises ResultError or LibraryError where descriptors cannot be read or are of another
    library.
    """
    wanted = list(execution.map(lambda drive: content_of(store, drive, drives[drive]), drives))
    known, useless, warnings = _open_all(store, state)
    parts, missing = _assign_drives(known, wanted)
    if missing and store.mirror is not None:  # a writer may have indexed them
        store.mirror.fetch_index(store.index)
        known, useless, warnings = _open_all(store, state)
        parts, missing = _assign_drives(known, wanted)
    absorbed, groups = _plan_compaction(parts, missing, {one: store.rows("descriptors", one.drive) for one in missing})
    parts = [part for part in parts if part not in absorbed]
    numbers = {one: number for number, one in enumerate(wanted)}
    done = 0
    for group in groups:
        segment, path = _build(store, group, state, execution), None
        try:
            path = write_segment(store.index, segment)
            segment = open_segment(path)
        except (ResultError, OSError) as error:
            path = None
            warnings += [] if done else [f"The index is not stored, so every query builds it again. {error}"]
        parts.append(SegmentView(segment, path, np.array([numbers[one] for one in group], np.int32)))
        done += len(group)
        execution.progress("index", done, sum(map(len, groups)))
    used = {part.path for part in parts}
    if all(part.path for part in parts):
        _remove([path for path in [*useless, *(path for _, path in known)] if path not in used], store)
    return parts, warnings


def content_of(store: Store, drive: str, about: Mapping[str, Any]) -> Content:
    """The drive's content by its drive.json or, on an object store, its manifest."""
    files = files_of(about) if store.mirror is None else store.mirror.drives[drive]["files"]
    return Content(drive, about["key"], str(files.get("descriptors.parquet", {}).get("sha256", "")))


def check_content(store: Store, drive: str, about: Mapping[str, Any]) -> None:
    """Raises ResultError where the map has a drive of another content by now than its drive.json `about` is of."""
    _check_content(store, content_of(store, drive, about))


def _check_content(store: Store, one: Content) -> None:
    if content_of(store, one.drive, store.record(one.drive)) != one:
        path = store.file(one.drive, "descriptors.parquet")
        raise ResultError(f"{path} was replaced while the map was searched. Run again.")


def _open_all(store: Store, state: CodedState) -> tuple[list[tuple[Segment, Path]], list[Path], list[str]]:
    """The segments that fit the library, the files that are of no use, and why the damaged ones are not."""
    known, useless, warnings = [], [], []
    cached = store.mirror is not None and store.mirror.cache is not None
    for path in sorted(store.index.glob(f"*{SUFFIX}")):
        try:
            segment = open_segment(path)
            if cached:
                with suppress(OSError):
                    os.utime(path)  # least recently used files go first
        except FileNotFoundError:  # another process has put it into a larger one
            continue
        except ResultError as error:
            useless.append(path)
            warnings += [] if cached else [f"{error} It was left out."]  # in a cache it costs time alone
            continue
        shape = (segment.lists.start.shape[0], segment.lists.boxes.shape[1])
        if segment.library == state.hash and shape == state.shape:
            known.append((segment, path))
        else:
            useless.append(path)
    return known, useless, warnings


def _assign_drives(
    known: Sequence[tuple[Segment, Path]], wanted: Sequence[Content]
) -> tuple[list[SegmentView], list[Content]]:
    """Assign every drive to one segment, the largest that has it; and the drives that none has."""
    left = {one: number for number, one in enumerate(wanted)}
    parts = []
    for segment, path in sorted(known, key=lambda one: (-len(one[0]), one[1].name)):
        numbers = np.array([left.pop(one, -1) for one in segment.contents], np.int32)
        if np.any(numbers >= 0):
            parts.append(SegmentView(segment, path, numbers))
    return parts, list(left)


def _plan_compaction(
    parts: Sequence[SegmentView], missing: Sequence[Content], places: dict[Content, int]
) -> tuple[list[SegmentView], list[list[Content]]]:
    """Which parts are put into new ones, and the drives of each new one, in order of IDs."""
    absorbed, total = [], sum(places[one] for one in missing)
    for part in sorted(parts, key=lambda part: part.places):
        if 2 * part.places < len(part.segment) or part.places <= min(total, CAPACITY // 2):  # mostly gone, or small
            absorbed.append(part)
            total += part.places
            counts = np.diff(part.segment.first).tolist()
            alive = zip(part.segment.contents, counts, part.numbers.tolist(), strict=True)
            places |= {one: count for one, count, number in alive if number >= 0}
    return absorbed, list(grouped(sorted(places), places.__getitem__, CAPACITY))


def _build(store: Store, group: Sequence[Content], state: CodedState, execution: Execution) -> Segment:
    def read(one: Content) -> pa.Array:
        column = read_column(store, one.drive, state)
        _check_content(store, one)
        return column

    columns = list(execution.map(read, group))
    first = np.array(list(accumulate(map(len, columns), initial=0)), np.int64)
    try:
        lists = state.lists(*columns)
    except LibraryError:
        for one, column in zip(group, columns, strict=True):  # whose they are
            with reading_drive(one.drive):
                state.lists(column)
        raise
    return Segment(state.hash, tuple(group), first, lists)


def read_column(store: Store, drive: str, state: PlaceState) -> pa.Array:
    """A drive's descriptors in the type of the recogniser. Raises DamagedDriveError where they cannot be read, or are
    of another library or recogniser."""
    path = store.file(drive, "descriptors.parquet")
    with reading_drive(drive):
        column, made_by = tables.read_descriptors(path)
        if made_by != state.hash:
            raise LibraryError(library_mismatch(store, drive, made_by, state.hash))
    try:
        return column.cast(state.arrow_type)  # the names of list items change in Parquet, nothing else may
    except pa.ArrowException:
        raise DamagedDriveError(
            f"{path} is of another recogniser. Where it should not be, {ADD_AGAIN}", drive
        ) from None


def pictures_of(store: Store, drive: str) -> tuple[Int32s, Int32s]:
    """(P,) keyframes and (P,) cameras of the places of a drive: all of them, unless the map was condensed. Raises
    DamagedDriveError."""
    with reading_drive(drive):
        return tables.read_pictures(store.file(drive, "descriptors.parquet"))


def rows_on_keyframes(store: Store, drive: str) -> dict[int, tuple[slice, Ints | None]]:
    """By camera, the rows of its places and, counted from their first, (N,) the one nearest to each keyframe; None
    where each has its own. Raises DamagedDriveError."""
    pictures = pictures_of(store, drive)
    return {
        camera: (rows, tables.on_keyframes(pictures[0][rows])) for camera, rows in tables.pictures_by_camera(pictures)
    }


def _remove(paths: Sequence[Path], store: Store) -> None:
    """Remove segments, and parts of writers that were killed. Who has a file open keeps it, and one that cannot be
    removed does no harm."""
    for path in [*paths, *store.index.glob(".*.part")]:
        with suppress(OSError):  # its writer has just renamed it, or it is a folder
            if path.suffix != ".part" or path.stat().st_mtime < time.time() - _LEFT_OVER_S:
                path.unlink(missing_ok=True)
