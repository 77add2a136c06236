"""The best places of a map for single views, over its index: exactly those of Eq. (1) over every place.

Parts are searched one after the other, each for all views at once, so that a map larger than memory is read once; what
a view has found so far tells the next part what it need not look at. `search_shard` does it for some of the parts,
anywhere that reads their files, and what the shards find is merged to what one search would.
"""

from __future__ import annotations

from concurrent.futures import BrokenExecutor, ThreadPoolExecutor
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vplog.errors import ResultError
from vplog.maps.search.segment import Segment, open_segment
from vplog.maps.search.top_k import merge, no_answers
from vplog.places.code_search import CodeIndex

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence
    from concurrent.futures import Executor
    from pathlib import Path

    from vplog.data import Bytes, Int32s, Ranking
    from vplog.maps.search.index import Part
    from vplog.maps.search.top_k import Answers
    from vplog.places.bobb import Place
    from vplog.places.code_search import Pairing
    from vplog.stages import CodedState

    Progress = Callable[[str, int, int], None]

_PARTS_A_TASK = 4
"""Some 600 MB of a large map: seconds of work for the views of a log, against a second to send and start a task."""


@dataclass(frozen=True, eq=False)
class Shard:
    """Some parts of a map to search, as it goes to another process or machine."""

    segments: Sequence[Segment | Path]
    """A file, or the segment itself where it is in memory alone."""
    numbers: Sequence[Int32s]
    """Of each segment, (D,) number of its drives, -1 where one does not count."""
    views: Sequence[Place]
    overlap: Bytes
    """(256, 256) cells that the boxes of two numbers share."""
    pairing: Pairing
    top: int
    threads: int


def best_places(
    parts: Sequence[Part],
    state: CodedState,
    views: Sequence[Place],
    top: int,
    threads: int = 1,
    executor: Executor | None = None,
    progress: Progress = lambda *_: None,
) -> Answers:
    """The `top` best of all places for each of Q views. With an executor its workers search, each some of the parts,
    whose files they must see under the same path; without one `threads` do here. The same answers for any of them."""
    every = Shard(
        [part.path if part.path and executor else part.segment for part in parts],
        [part.numbers for part in parts], views, state.overlaps(), state.pairing, top, threads,
    )  # fmt: skip
    if executor is None:
        return search_shard(every, progress)
    cuts = [slice(at, at + _PARTS_A_TASK) for at in range(0, len(parts), _PARTS_A_TASK)]
    shards = [replace(every, segments=every.segments[cut], numbers=every.numbers[cut], threads=1) for cut in cuts]
    best = no_answers(len(views), top)
    try:
        for done, found in enumerate(executor.map(search_shard, shards)):
            best = merge([best, found], top)
            progress("search", done + 1, len(shards))
    except BrokenExecutor as error:
        raise ResultError(f"A worker was lost while it searched the map: {error}. Run the query again.") from None
    return best


def search_shard(shard: Shard, progress: Progress = lambda *_: None) -> Answers:
    """The best of the shard's places for each view. Raises ResultError where a segment is gone or damaged."""
    best = no_answers(len(shard.views), shard.top)
    with ThreadPoolExecutor(shard.threads) as pool:
        for done, (where, numbers) in enumerate(zip(shard.segments, shard.numbers, strict=True)):
            segment = where if isinstance(where, Segment) else _open(where)
            best = merge([best, *_search_segment(segment, numbers, shard, best, pool)], shard.top)
            progress("search", done + 1, len(shard.segments))
    return best


def _open(path: Path) -> Segment:
    try:
        return open_segment(path)
    except FileNotFoundError:
        raise ResultError(
            f"{path} is not there: the map has changed since the query began, or this machine does not see it. Run the "
            "query again, with the map where all machines have it under one path."
        ) from None


def _search_segment(
    segment: Segment, numbers: Int32s, shard: Shard, best: Answers, pool: ThreadPoolExecutor
) -> list[Answers]:
    """The best of a segment for each view: by view where they are many, else by view and stretch of blocks."""
    index = CodeIndex(segment.lists, shard.overlap, shard.pairing)
    runs = segment.first[:-1], numbers >= 0
    pieces = 1 if len(shard.views) >= 2 * shard.threads else shard.threads
    cuts = np.linspace(0, index.blocks, pieces + 1).astype(int).tolist()

    def find(task: tuple[int, int]) -> Ranking:
        view, piece = task
        least = max(float(best.score[view, -1]), 0.0) if shard.top else 0.0
        return index.best(shard.views[view], shard.top, (cuts[piece], cuts[piece + 1]), least, runs)

    found = [no_answers(len(shard.views), shard.top) for _ in range(pieces)]
    tasks = [(view, piece) for view in range(len(shard.views)) for piece in range(pieces)]
    rankings = map(find, tasks) if shard.threads == 1 else pool.map(find, tasks)  # a thread takes time to start
    for (view, piece), ranking in zip(tasks, rankings, strict=True):
        count = len(ranking.rows)
        owner = np.searchsorted(segment.first, ranking.rows, side="right") - 1
        answers = found[piece]
        answers.drive[view, :count] = numbers[owner]
        answers.keyframe[view, :count] = ranking.rows - segment.first[owner]
        answers.score[view, :count] = ranking.score
    return found
