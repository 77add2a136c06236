"""Eq. (1) over a map of places whose boxes are numbers, with weights of the references: exact, in whole numbers.

Only boxes on a shared reference overlap, so a query visits the lists of its own references and nothing else. Overlaps
are read from a table, summed as integers and scaled once: no order of summing changes a score.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal, Protocol

import numba
import numpy as np

from vplog.places.dense import best_rows

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vplog.data import Bytes, Float32s, Ranking

    Uint16s = NDArray[np.uint16]

_PAIRINGS = {"best": (1, 0), "same": (0, 1), "both": (1, 1)}
"""Weights of a box's best overlap and of its overlap with the same window's box."""


class CodedPlace(Protocol):
    @property
    def references(self) -> Uint16s: ...
    @property
    def weights(self) -> Bytes: ...
    @property
    def boxes(self) -> Bytes: ...


class CodeIndex:
    """Places of a map; rows are in the order given."""

    def __init__(
        self,
        references: Uint16s,
        weights: Bytes,
        boxes: Bytes,
        overlap: Bytes,
        library_size: int,
        pairing: Literal["best", "same", "both"],
    ) -> None:
        """`references` and `weights` (N, J), a reference beyond the library is none; `boxes` (N, J, I) numbers of
        boxes; `overlap` (256, 256) cells that two boxes share."""
        self._count = len(references)
        self._overlap, self._best, self._same = overlap, *_PAIRINGS[pairing]
        self._whole = int(overlap.max(initial=1)) * (self._best + self._same)
        flat = references.reshape(-1)
        entries = np.argsort(flat, kind="stable")
        self._list_start = np.searchsorted(flat[entries], np.arange(library_size + 1)).astype(np.int64)
        entries = entries[: self._list_start[-1]]
        self._list_place = (entries // max(references.shape[1], 1)).astype(np.int32)
        self._list_weight = weights.reshape(-1)[entries]
        self._list_boxes = np.ascontiguousarray(boxes.reshape(len(flat), boxes.shape[-1])[entries])
        self._length = np.sqrt(np.maximum((weights.astype(np.int64) ** 2).sum(axis=1), 1))

    def __len__(self) -> int:
        return self._count

    def scores(self, descriptor: CodedPlace, stop: int | None = None) -> Float32s:
        """(stop,) 0..1: mean overlap of the boxes, weighted by the references' weights as unit vectors; 1 is equal."""
        stop = self._count if stop is None else min(stop, self._count)
        overlap = _overlap(
            descriptor.references, descriptor.weights, descriptor.boxes, self._overlap, self._best, self._same,
            self._list_start, self._list_place, self._list_weight, self._list_boxes, stop,
        )  # fmt: skip
        own = np.sqrt(max(int((descriptor.weights.astype(np.int64) ** 2).sum()), 1))
        return (overlap / (self._length[:stop] * (own * self._whole * descriptor.boxes.shape[1]))).astype(np.float32)

    def query(self, descriptor: CodedPlace, k: int, stop: int | None = None) -> Ranking:
        """The k best places below row `stop` that overlap at all; ties go to the earlier row."""
        return best_rows(self.scores(descriptor, stop), k)


@numba.njit(cache=True, nogil=True)
def _overlap(
    references, weights, boxes, overlap, best, same, list_start, list_place, list_weight, list_boxes, stop
):  # fmt: skip
    """(stop,) int64: sum over shared references of the product of weights and the overlaps of their boxes."""
    result = np.zeros(stop, np.int64)
    windows = boxes.shape[1]
    for j in range(references.shape[0]):
        if references[j] >= list_start.shape[0] - 1:
            continue
        for e in range(list_start[references[j]], list_start[references[j] + 1]):
            if list_place[e] >= stop:
                break
            total = 0
            for i in range(windows):
                row = overlap[boxes[j, i]]
                if same:
                    total += np.int64(row[list_boxes[e, i]])
                if best:
                    most = row[list_boxes[e, 0]]
                    for other in range(1, windows):
                        cells = row[list_boxes[e, other]]
                        most = cells if cells > most else most
                    total += np.int64(most)
            result[list_place[e]] += np.int64(weights[j]) * np.int64(list_weight[e]) * total
    return result
