"""The best places of a map for single views, over its index: exactly those of Eq. (1) over every place.

Segments are searched one after the other, each for all views at once, so that a map larger than memory is read once;
the answers so far bound the next segment's search. `search_shard` does it for some of the segments, anywhere that reads
their files, and the answers of shards are merged to those of one search.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import BrokenExecutor, Executor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Bytes, Float32s, Int32s, Ints, Ranking
from vplog.errors import ResultError
from vplog.execution.execution import Execution
from vplog.maps.search.segment import Segment, open_segment
from vplog.maps.storage.download_cache import cache_in
from vplog.places.bobb import Place
from vplog.places.code_search import CodeIndex, Pairing
from vplog.stages import CodedState

if TYPE_CHECKING:
    from vplog.maps.search.index import SegmentView
    from vplog.maps.storage.remote_map import StoredFile

NO_SCORE = np.float32(-np.inf)
"""Score of no answer."""
_PARTS_A_TASK = 4
"""Some 600 MB of a large map: seconds of work for the views of a log, against a second to send and start a task."""


@dataclass(frozen=True, eq=False)
class RankedPlaces:
    """The best places for Q views, best first: by falling score, then by drive, then by keyframe. Rows are filled up
    to K with none."""

    drive: Int32s
    """(Q, K) number of the drive, in order of IDs."""
    keyframe: Int32s
    """(Q, K) row of the drive's places, which is that of its keyframes unless the map was condensed."""
    score: Float32s
    """(Q, K), NONE where there are fewer."""
    support: Int32s
    """(Q, K) views of the window that agree."""

    @property
    def count(self) -> Ints:
        """(Q,) how many of the K there are."""
        return (self.score > NO_SCORE).sum(axis=1)


def no_answers(views: int, top: int) -> RankedPlaces:
    """(Q, K) none, to be written to."""
    drive, keyframe, support = np.zeros((3, views, top), np.int32)
    return RankedPlaces(drive, keyframe, np.full((views, top), NO_SCORE, np.float32), support)


def merge(parts: Sequence[RankedPlaces], top: int) -> RankedPlaces:
    """The best of all parts: exactly those of one search, where each part gives its own best in this order."""
    columns = [np.concatenate([vars(part)[name] for part in parts], axis=1) for name in vars(parts[0])]
    drive, keyframe, score, _ = columns
    order = np.lexsort((keyframe, drive, -score), axis=1)[:, :top]
    return RankedPlaces(*(np.take_along_axis(column, order, axis=1) for column in columns))


@dataclass(frozen=True, eq=False)
class Shard:
    """Some segments of a map to search, as a task for another process or machine."""

    segments: Sequence[Segment | Path | StoredFile]
    """A file, also one on an object store, or the segment itself where it is in memory alone."""
    numbers: Sequence[Int32s]
    """For each segment, (D,) number of its drives, -1 where one does not count."""
    views: Sequence[Place]
    overlap: Bytes
    """(256, 256) cells that the boxes of two numbers share."""
    pairing: Pairing
    top: int
    execution: Execution

    @property
    def locality(self) -> str:
        """Hash of the first of its files on an object store, which a machine that searched it before has cached."""
        return getattr(self.segments[0], "sha256", "") if self.segments else ""


def best_places(
    parts: Sequence[SegmentView], state: CodedState, views: Sequence[Place], top: int,
    execution: Execution = Execution(), executor: Executor | None = None,
) -> RankedPlaces:  # fmt: skip
    """The `top` best of all places for each of Q views. With an executor its workers search, each some of the parts,
    whose files they see under the same path, or fetch into their own caches. The same answers for any execution."""
    every = Shard(
        [(part.stored or part.path or part.segment) if executor else part.segment for part in parts],
        [part.numbers for part in parts], views, state.overlaps(), state.pairing, top, execution,
    )  # fmt: skip
    if executor is None:
        return search_shard(every)
    cuts = [slice(at, at + _PARTS_A_TASK) for at in range(0, len(parts), _PARTS_A_TASK)]
    every = replace(every, execution=Execution())
    shards = [replace(every, segments=every.segments[cut], numbers=every.numbers[cut]) for cut in cuts]
    best = no_answers(len(views), top)
    try:
        for done, found in enumerate(executor.map(search_shard, shards), start=1):
            best = merge([best, found], top)
            execution.progress("search", done, len(shards))
    except BrokenExecutor as error:
        raise ResultError(f"A worker was lost while it searched the map: {error}. Run the query again.") from None
    return best


def search_shard(shard: Shard) -> RankedPlaces:
    """The best of the shard's places for each view. Raises ResultError where a segment is gone or damaged."""
    best = no_answers(len(shard.views), shard.top)
    with ThreadPoolExecutor(shard.execution.threads) as pool:
        for done, (where, numbers) in enumerate(zip(shard.segments, shard.numbers, strict=True), start=1):
            segment = where if isinstance(where, Segment) else _open(where)
            best = merge([best, *_search_segment(segment, numbers, shard, best, pool)], shard.top)
            shard.execution.progress("search", done, len(shard.segments))
    return best


def _open(where: Path | StoredFile) -> Segment:
    path = where if isinstance(where, Path) else where.fetched(cache_in(None))
    try:
        return open_segment(path)
    except FileNotFoundError:
        raise ResultError(
            f"{path} is not there: the map has changed since the query began, or this machine does not see it. Run the "
            "query again, with the map where all machines have it under one path."
        ) from None


def _search_segment(
    segment: Segment, numbers: Int32s, shard: Shard, best: RankedPlaces, pool: ThreadPoolExecutor
) -> list[RankedPlaces]:
    """The best of a segment for each view: by view where they are many, else by view and stretch of blocks."""
    index, threads = CodeIndex(segment.lists, shard.overlap, shard.pairing), shard.execution.threads
    runs = segment.first[:-1], numbers >= 0
    pieces = 1 if len(shard.views) >= 2 * threads else threads
    cuts = np.linspace(0, index.blocks, pieces + 1).astype(int).tolist()

    def find(task: tuple[int, int]) -> Ranking:
        view, piece = task
        least = max(float(best.score[view, -1]), 0.0) if shard.top else 0.0
        return index.best(shard.views[view], shard.top, (cuts[piece], cuts[piece + 1]), least, runs)

    found = [no_answers(len(shard.views), shard.top) for _ in range(pieces)]
    tasks = [(view, piece) for view in range(len(shard.views)) for piece in range(pieces)]
    rankings = map(find, tasks) if threads == 1 else pool.map(find, tasks)  # a thread takes time to start
    for (view, piece), ranking in zip(tasks, rankings, strict=True):
        count = len(ranking.rows)
        owner = np.searchsorted(segment.first, ranking.rows, side="right") - 1
        answers = found[piece]
        answers.drive[view, :count] = numbers[owner]
        answers.keyframe[view, :count] = ranking.rows - segment.first[owner]
        answers.score[view, :count] = ranking.score
    return found
