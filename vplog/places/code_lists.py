"""Inverted lists of places whose boxes are numbers: by reference, then by row, as arrays that a file may hold."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import numba
import numpy as np

from vplog.errors import ResultError

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vplog.data import Bytes, Ints, Uint16s

BLOCK = 8192
"""Rows of a block: their bounds take 32 kB, a core's first cache; 4096 to 32768 cost the same to 20 %."""
MOST_ROWS = 65_536
"""Rows that a block may have: an offset has 16 bits."""
STEPS = 255
"""A bound is a product of two unit vectors, each value a whole number of these steps, rounded up."""


@dataclass(frozen=True, eq=False)
class CodeLists:
    """N places as E entries, one for each reference of a place, of a library of L references."""

    start: Ints
    """(L, B + 1) the entries of reference r in block b of rows are start[r, b]..start[r, b + 1]."""
    offset: Uint16s
    """(E,) row within the block, rising within a reference's part of it."""
    weight: Bytes
    """(E,) of the reference in its place, as described."""
    share: Bytes
    """(E,) the weight as part of the place's unit vector, in 255ths, rounded up."""
    boxes: Bytes
    """(E, I) numbers of the boxes."""
    square: NDArray[np.uint32]
    """(N,) sum of the squares of the place's weights, at least 1."""
    block: int
    """Rows of a block; the last one may have fewer."""

    def __len__(self) -> int:
        return len(self.square)

    @property
    def parts(self) -> tuple[Ints, Uint16s, Bytes, Bytes, Bytes, NDArray[np.uint32]]:
        """The arrays, in the order in which kernels take them and files hold them."""
        return self.start, self.offset, self.weight, self.share, self.boxes, self.square

    @property
    def nbytes(self) -> int:
        """Bytes that the places take: 13 a reference of a place with nine boxes, and 4 a place.

        Beside it, 8 a reference of the library and block of rows: 1 a place where L = 1000."""
        return sum(part.nbytes for part in self.parts)

    @cached_property
    def longest(self) -> int:
        """Most entries that a reference has in a block."""
        return int(np.diff(self.start).max(initial=0))


def build_lists(references: Uint16s, weights: Bytes, boxes: Bytes, library_size: int, block: int) -> CodeLists:
    """Lists of `references` and `weights` (N, J), a reference beyond the library is none, and `boxes` (N, J, I)."""
    count, _, windows = boxes.shape
    start = _count_entries(references, library_size, block)
    entries = int(start[-1, -1]) if start.size else 0
    offset, weight = np.empty(entries, np.uint16), np.empty(entries, np.uint8)
    share, coded = np.empty(entries, np.uint8), np.empty((entries, windows), np.uint8)
    square = np.empty(count, np.uint32)
    _fill(references, weights, boxes, block, start, offset, weight, share, coded, square)
    return CodeLists(start, offset, weight, share, coded, square, block)


def check_lists(lists: CodeLists) -> None:
    """Raises ResultError where a search would read or write beyond the arrays. Only `start` is looked at: whatever the
    other arrays of a stranger's file hold, they give wrong scores at worst."""
    start = lists.start.reshape(-1)
    blocks = -(-len(lists) // lists.block)
    sound = 0 < lists.block <= MOST_ROWS and lists.start.shape[1] == blocks + 1
    ends = len(start) == 0 or (start[0] == 0 and start[-1] == len(lists.offset))
    if not (sound and ends) or np.any(start[1:] < start[:-1]):  # not differences, which wrap round
        raise ResultError("Its lists do not fit together.")


@numba.njit(cache=True, nogil=True)
def _count_entries(references, library_size, block):
    """(L, B + 1) int64, `CodeLists.start`."""
    N, J = references.shape
    start = np.zeros((library_size, (N + block - 1) // block + 1), np.int64)
    for row in range(N):
        for j in range(J):
            if references[row, j] < library_size:
                start[references[row, j], row // block + 1] += 1
    total = 0
    for r in range(start.shape[0]):
        for b in range(start.shape[1]):
            total += start[r, b]
            start[r, b] = total
    return start


@numba.njit(cache=True, nogil=True)
def _fill(references, weights, boxes, block, start, offset, weight, share, coded, square):
    """Write the lists: by reference, then by row."""
    N, J, windows = boxes.shape
    at = start[:, 0].copy()
    for row in range(N):
        total = np.int64(0)
        for j in range(J):
            total += np.int64(weights[row, j]) * np.int64(weights[row, j])
        square[row] = max(total, 1)
        length = np.sqrt(np.float64(square[row]))
        for j in range(J):
            reference = references[row, j]
            if reference < start.shape[0]:
                e = at[reference]
                at[reference] += 1
                offset[e], weight[e] = row % block, weights[row, j]
                share[e] = np.ceil(weights[row, j] * STEPS / length)
                for i in range(windows):
                    coded[e, i] = boxes[row, j, i]
