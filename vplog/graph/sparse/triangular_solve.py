"""Forward and back substitution through R^T R, run by run of its elimination tree."""

from __future__ import annotations

import numba
import numpy as np

from vplog.data import Floats, Ints
from vplog.graph.sparse.frontal import Form, position


@numba.njit(cache=True, nogil=True)
def forward_run(
    low: int, end: int, later: Ints, form: Form, begin: Ints, size: int, values: Floats, right: Floats
) -> Floats:
    """R^-T at the columns of supernodes low:end, whole subtrees, in `right` (n d, c), in place.

    What (k d, c) this adds to the rows `later` (k,) after them, increasing.
    """
    first, start, rows, _, _ = form
    begun, after, columns = first[low], first[end], right.shape[1]
    own = (after - begun) * size
    whole = np.zeros((own + len(later) * size, columns))
    for row in range(own):
        for c in range(columns):
            whole[row, c] = right[begun * size + row, c]
    for node in range(low, end):
        at, width = (first[node] - begun) * size, (first[node + 1] - first[node]) * size
        count = start[node + 1] - start[node]
        length = width + count * size
        to = np.empty(count, np.int64)
        for k in range(count):
            row = rows[start[node] + k]
            to[k] = (row - begun) * size if row < after else own + position(later, 0, len(later), int(row)) * size
        for k in range(width):
            line = values[begin[node] + k * length : begin[node] + (k + 1) * length]
            for c in range(columns):
                whole[at + k, c] /= line[k]
                value = whole[at + k, c]
                for j in range(k + 1, width):
                    whole[at + j, c] -= line[j] * value
                j = width
                for there in to:
                    for i in range(size):
                        whole[there + i, c] -= line[j] * value
                        j += 1
    for row in range(own):
        for c in range(columns):
            right[begun * size + row, c] = whole[row, c]
    return whole[own:]


@numba.njit(cache=True, nogil=True)
def add_rows(right: Floats, rows: Ints, size: int, more: Floats) -> None:
    """Add blocks (k d, c) to rows (k,) of `right` (n d, c)."""
    for k in range(len(rows)):
        for i in range(size):
            for c in range(right.shape[1]):
                right[rows[k] * size + i, c] += more[k * size + i, c]


@numba.njit(cache=True, nogil=True)
def back_run(low: int, end: int, form: Form, begin: Ints, size: int, values: Floats, right: Floats) -> None:
    """R^-1 at the columns of supernodes low:end, in `right` (n d, c), in place, where all after them are done."""
    first, start, rows, _, _ = form
    columns = right.shape[1]
    for node in range(end - 1, low - 1, -1):
        at, width = first[node] * size, (first[node + 1] - first[node]) * size
        length = width + (start[node + 1] - start[node]) * size
        for k in range(width - 1, -1, -1):
            line = values[begin[node] + k * length : begin[node] + (k + 1) * length]
            for c in range(columns):
                value = right[at + k, c]
                for j in range(k + 1, width):
                    value -= line[j] * right[at + j, c]
                j = width
                for row in range(start[node], start[node + 1]):
                    for i in range(size):
                        value -= line[j] * right[rows[row] * size + i, c]
                        j += 1
                right[at + k, c] = value / line[k]
