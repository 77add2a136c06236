"""Eq. (1): the overlap of boxes on shared references, over a whole map and by reference for the ledger of closures."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np

from vplog.data import Bytes, Float32s, Floats, Int32s, Ints, Ranking, SharedReferences, Uint16s
from vplog.places.dense import best_rows

Compare = Callable[[Ints, Ints, Ints, Ints], tuple[Floats, Floats]]


_PAIRS = 4096
"""Pairs of places that are compared at once: their references and boxes take some ten MB."""


@dataclass(frozen=True, eq=False)
class BoxPlace:
    """J references and I boxes on each."""

    references: Int32s
    """(J,) best first, -1 where fewer references share anything."""
    boxes: Bytes
    """(J, I, 4) x0 y0 x1 y1 in cells of the grid, all zero where nothing was found."""


class BoxIndex:
    """Places of a map, through inverted lists by reference; rows are in the order given."""

    def __init__(self, references: Int32s, boxes: Bytes, library_size: int, grid: int) -> None:
        """`references` (N, J), -1 for none; `boxes` (N, J, I, 4) in cells of a grid x grid image."""
        self._count, self._area = len(references), grid * grid
        flat = references.reshape(-1)
        entries = np.argsort(flat, kind="stable")
        entries = entries[flat[entries] >= 0]
        self._list_start = np.searchsorted(flat[entries], np.arange(library_size + 1)).astype(np.int64)
        self._list_place = (entries // max(references.shape[1], 1)).astype(np.int32)
        self._list_boxes = np.ascontiguousarray(boxes.reshape(len(flat), *boxes.shape[2:])[entries])

    def __len__(self) -> int:
        return self._count

    def scores(self, descriptor: BoxPlace, stop: int | None = None) -> Float32s:
        """(stop,) Eq. (1) of the query against each place: mean best overlap of its boxes, as a share of the image."""
        stop = self._count if stop is None else min(stop, self._count)
        references, boxes = descriptor.references, descriptor.boxes
        overlap = _overlap(references, boxes, self._list_start, self._list_place, self._list_boxes, stop)
        return (overlap / (boxes.shape[0] * boxes.shape[1] * self._area)).astype(np.float32)

    def query(self, descriptor: BoxPlace, k: int, stop: int | None = None) -> Ranking:
        return best_rows(self.scores(descriptor, stop), k)


@numba.njit(cache=True, nogil=True)
def _overlap(references, boxes, list_start, list_place, list_boxes, stop):
    """(stop,) int64: sum over the query's boxes of the largest overlap in cells with a box on the same reference."""
    result = np.zeros(stop, np.int64)
    for j in range(references.shape[0]):
        if references[j] < 0:
            continue
        for e in range(list_start[references[j]], list_start[references[j] + 1]):
            if list_place[e] >= stop:
                break
            total = 0
            for i in range(boxes.shape[1]):
                x0, y0 = np.int32(boxes[j, i, 0]), np.int32(boxes[j, i, 1])  # bytes would wrap below zero
                x1, y1 = np.int32(boxes[j, i, 2]), np.int32(boxes[j, i, 3])
                best = 0
                for other in range(list_boxes.shape[1]):
                    w = min(x1, np.int32(list_boxes[e, other, 2])) - max(x0, np.int32(list_boxes[e, other, 0]))
                    h = min(y1, np.int32(list_boxes[e, other, 3])) - max(y0, np.int32(list_boxes[e, other, 1]))
                    if w > 0 and h > 0:
                        best = max(best, w * h)
                total += best
            result[list_place[e]] += total
    return result


def list_shared(references: Ints, query: Int32s, match: Int32s, compare: Compare) -> SharedReferences:
    """The references (N, J) of places that two of them share, for C pairs of rows; a negative number is none.

    `compare` gets rows (S,) of the query places, the ranks (S,) of their reference, and the same of the match places,
    and gives the overlap (S,) of their boxes and what it is worth in the score (S,), up to a factor of the pair.
    """
    numbers: list[Uint16s] = []
    shares: list[Float32s] = []
    for start in range(0, len(query), _PAIRS):
        rows, others = query[start : start + _PAIRS].astype(np.int64), match[start : start + _PAIRS].astype(np.int64)
        mine, theirs = references[rows], references[others]
        pair, rank, other_rank = np.nonzero((mine[:, :, None] == theirs[:, None, :]) & (mine >= 0)[:, :, None])
        overlap, worth = compare(rows[pair], rank, others[pair], other_rank)
        number = mine[pair, rank]
        order = np.lexsort((number, -worth, pair))
        ends = np.cumsum(np.bincount(pair, minlength=len(rows)))[:-1]
        numbers += np.split(number[order].astype(np.uint16), ends)
        shares += np.split(overlap[order].astype(np.float32), ends)
    return SharedReferences(numbers, shares)
