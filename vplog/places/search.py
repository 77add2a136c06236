"""Eq. (1) over a whole map, exactly, through inverted lists by reference: only boxes on a shared reference overlap."""

from __future__ import annotations

from typing import TYPE_CHECKING, Protocol

import numba
import numpy as np

from vplog.places.dense import best_rows

if TYPE_CHECKING:
    from vplog.data import Bytes, Float32s, Int32s, Ranking


class BoxPlace(Protocol):
    @property
    def references(self) -> Int32s: ...
    @property
    def boxes(self) -> Bytes: ...


class BoxIndex:
    """Places of a map; rows are in the order given."""

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
        """The k best places below row `stop` that overlap at all; ties go to the earlier row."""
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
