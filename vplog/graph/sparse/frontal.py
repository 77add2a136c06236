"""Frontal matrices of supernodes: assembled from the matrix and from the update matrices of their children."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from vplog.data import Floats, Int32s, Ints
from vplog.graph.sparse.dense_front import eliminate_front

Entries = tuple[Ints, Ints, Ints]
"""Result of `by_supernode`."""


class Blocks(NamedTuple):
    """A symmetric matrix of n x n blocks (d, d)."""

    diagonal: Floats
    """(n, d, d)."""
    a: Int32s | Ints
    """(E,) row of each other block; pairs may repeat, and add."""
    b: Int32s | Ints
    """(E,) its column; never the same."""
    other: Floats
    """(E, d, d) at row a, column b; its transpose at row b, column a."""


class Form(NamedTuple):
    """An Elimination for compiled loops."""

    first: Ints
    start: Ints
    rows: Ints
    place: Ints
    parent: Ints


@numba.njit(cache=True, nogil=True)
def largest_stack(low: int, high: int, parent: Ints, children: Ints, below: Ints) -> int:
    """Most entries of update matrices on the stack at any time while supernodes low:high, whole subtrees, are
    eliminated."""
    pending = np.empty(high - low + 1, np.int64)
    count, used, most = 0, 0, 0
    for node in range(low, high):
        for _ in range(children[node]):
            count -= 1
            used -= pending[count]
        if parent[node] >= 0:
            pending[count] = below[node] ** 2
            used += pending[count]
            count += 1
            most = max(most, used)
    return most


@numba.njit(cache=True, nogil=True)
def position(rows: Ints, low: int, high: int, row: int) -> int:
    """Position of `row` in rows[low:high], which increase, by binary search."""
    while low < high:
        middle = (low + high) // 2
        if rows[middle] < row:
            low = middle + 1
        else:
            high = middle
    return low


@numba.njit(cache=True, nogil=True)
def by_supernode(place: Ints, first: Ints, a: Int32s | Ints, b: Int32s | Ints) -> Entries:
    """The node (n,) that each column is of, and which blocks each supernode assembles.

    Those are `edges[begin[node]:begin[node + 1]]`, in their order.
    """
    of, pose = np.empty(len(place), np.int64), np.empty(len(place), np.int64)
    for node in range(len(first) - 1):
        of[first[node] : first[node + 1]] = node
    for row in range(len(place)):
        pose[place[row]] = row
    begin = np.zeros(len(first) + 1, np.int64)
    for edge in range(len(a)):
        begin[of[min(place[a[edge]], place[b[edge]])] + 2] += 1
    for node in range(len(first)):
        begin[node + 1] += begin[node]
    edges = np.empty(len(a), np.int64)
    for edge in range(len(a)):
        node = of[min(place[a[edge]], place[b[edge]])]
        edges[begin[node + 1]] = edge
        begin[node + 1] += 1
    return pose, begin[:-1].copy(), edges


@numba.njit(cache=True, nogil=True)
def assemble(node: int, front: Floats, form: Form, entries: Entries, matrix: Blocks) -> None:
    """Write the blocks of a matrix in the columns of a supernode into the upper triangle of its front."""
    first, start, rows, place, _ = form
    pose, begin, edges = entries
    diagonal, a, b, other = matrix
    size = diagonal.shape[1]
    width = first[node + 1] - first[node]
    for i in range(len(front)):
        front[i, i:] = 0.0
    for k in range(width):
        row, at = pose[first[node] + k], k * size
        for i in range(size):
            for j in range(i, size):
                front[at + i, at + j] += diagonal[row, i, j]
    for edge in edges[begin[node] : begin[node + 1]]:
        one, two = place[a[edge]], place[b[edge]]
        low, high = min(one, two), max(one, two)
        if high < first[node + 1]:
            to = (high - first[node]) * size
        else:
            where = position(rows, int(start[node]), int(start[node + 1]), int(high))
            if where == start[node + 1] or rows[where] != high:
                continue  # of no weight, and not in this shape
            to = (width + where - start[node]) * size
        at = (low - first[node]) * size
        for i in range(size):
            for j in range(size):
                front[at + i, to + j] += other[edge, i, j] if one == low else other[edge, j, i]


@numba.njit(cache=True, nogil=True)
def child_rows(node: int, child: int, form: Form, size: int) -> Ints:
    """Positions in the front of a supernode of the rows below one of its children."""
    first, start, rows, _, _ = form
    width = first[node + 1] - first[node]
    count = start[child + 1] - start[child]
    to = np.empty(count, np.int64)
    along = start[node]
    for k in range(count):
        row = rows[start[child] + k]
        if row < first[node + 1]:
            to[k] = (row - first[node]) * size
        else:
            while rows[along] != row:
                along += 1
            to[k] = (width + along - start[node]) * size
    return to


@numba.njit(cache=True, nogil=True)
def extend_add(front: Floats, to: Ints, size: int, update: Floats, skipped: int, low: int, high: int) -> None:
    """Add rows low:high, in blocks, of a child's update matrix: `update` without its first rows and columns."""
    for k in range(low, high):
        for i in range(size):
            line = update[skipped + k * size + i, skipped:]
            target = front[to[k] + i]
            for j in range(i, size):
                target[to[k] + j] += line[k * size + j]
            for other in range(k + 1, len(to)):
                for j in range(size):
                    target[to[other] + j] += line[other * size + j]


@numba.njit(cache=True, nogil=True)
def store_rows(front: Floats, values: Floats) -> None:
    """Copy the first rows of a front (f, f), upper triangle, into `values` (k f,)."""
    length = len(front)
    for i in range(len(values) // length):
        values[i * length : i * length + i] = 0.0
        for j in range(i, length):
            values[i * length + j] = front[i, j]


@numba.njit(cache=True, nogil=True)
def eliminate_run(
    low: int, end: int, form: Form, children: Ints, begin: Ints, values: Floats, entries: Entries, matrix: Blocks
) -> tuple[bool, Floats, Ints]:
    """Eliminate supernodes low:end, whole subtrees: their rows of R in `values`.

    Returns whether they are positive definite, the update matrices of the roots, one after the other, and these roots.
    """
    first, start, _, _, parent = form
    size = matrix.diagonal.shape[1]
    below, most = np.empty(len(parent), np.int64), 0
    for node in range(low, end):
        below[node] = (start[node + 1] - start[node]) * size
        most = max(most, (first[node + 1] - first[node]) * size + below[node])
    room = np.empty(most * most)
    stack = np.empty(largest_stack(low, end, parent, children, below))
    pending = np.empty(end - low + 1, np.int64)
    count, used = 0, 0
    for node in range(low, end):
        eliminated = (first[node + 1] - first[node]) * size
        length = eliminated + below[node]
        front = room[: length * length].reshape(length, length)
        assemble(node, front, form, entries, matrix)
        for _ in range(children[node]):
            count -= 1
            child = pending[count]
            used -= below[child] ** 2
            update = stack[used : used + below[child] ** 2].reshape(below[child], below[child])
            to = child_rows(node, child, form, size)
            extend_add(front, to, size, update, 0, 0, len(to))
        if not eliminate_front(front, eliminated):
            return False, stack[:0].copy(), pending[:0].copy()
        store_rows(front, values[begin[node] : begin[node + 1]])
        if parent[node] >= 0:
            pending[count] = node
            count += 1
            update = stack[used : used + below[node] ** 2].reshape(below[node], below[node])
            used += below[node] ** 2
            for i in range(below[node]):
                for j in range(i, below[node]):
                    update[i, j] = front[eliminated + i, eliminated + j]
    return True, stack[:used].copy(), pending[:count].copy()
