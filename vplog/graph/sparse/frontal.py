"""Fronts of supernodes: what a matrix says about their columns, and what the supernodes below hand on to them."""

from __future__ import annotations

from typing import NamedTuple

import numba
import numpy as np

from vplog.data import Floats, Int32s, Ints
from vplog.graph.sparse.dense_front import eliminate_front

Listed = tuple[Ints, Ints, Ints]
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
def most_waiting(low: int, high: int, parent: Ints, children: Ints, below: Ints) -> int:
    """Most numbers that supernodes low:high, whole subtrees, hand on and that are not taken yet at any time."""
    waiting = np.empty(high - low + 1, np.int64)
    count, used, most = 0, 0, 0
    for node in range(low, high):
        for _ in range(children[node]):
            count -= 1
            used -= waiting[count]
        if parent[node] >= 0:
            waiting[count] = below[node] ** 2
            used += waiting[count]
            count += 1
            most = max(most, used)
    return most


@numba.njit(cache=True, nogil=True)
def found(rows: Ints, low: int, high: int, row: int) -> int:
    """Where `row` is among rows[low:high], which increase."""
    while low < high:
        middle = (low + high) // 2
        if rows[middle] < row:
            low = middle + 1
        else:
            high = middle
    return low


@numba.njit(cache=True, nogil=True)
def by_supernode(place: Ints, first: Ints, a: Int32s | Ints, b: Int32s | Ints) -> tuple[Ints, Ints, Ints]:
    """The node (n,) that each column is of, and which edges meet the columns of each supernode first.

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
def fill(node: int, front: Floats, form: Form, listed: Listed, matrix: Blocks) -> None:
    """Put the blocks of a matrix in the columns of a supernode into the upper triangle of its front."""
    first, start, rows, place, _ = form
    pose, begin, edges = listed
    diagonal, a, b, other = matrix
    size = diagonal.shape[1]
    wide = first[node + 1] - first[node]
    for i in range(len(front)):
        front[i, i:] = 0.0
    for k in range(wide):
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
            where = found(rows, int(start[node]), int(start[node + 1]), int(high))
            if where == start[node + 1] or rows[where] != high:
                continue  # of no weight, and not in this shape
            to = (wide + where - start[node]) * size
        at = (low - first[node]) * size
        for i in range(size):
            for j in range(size):
                front[at + i, to + j] += other[edge, i, j] if one == low else other[edge, j, i]


@numba.njit(cache=True, nogil=True)
def rows_of_child(node: int, child: int, form: Form, size: int) -> Ints:
    """Where in the front of a supernode the rows below one of its children are."""
    first, start, rows, _, _ = form
    wide = first[node + 1] - first[node]
    handed = start[child + 1] - start[child]
    to = np.empty(handed, np.int64)
    along = start[node]
    for k in range(handed):
        row = rows[start[child] + k]
        if row < first[node + 1]:
            to[k] = (row - first[node]) * size
        else:
            while rows[along] != row:
                along += 1
            to[k] = (wide + along - start[node]) * size
    return to


@numba.njit(cache=True, nogil=True)
def gather(front: Floats, to: Ints, size: int, handed: Floats, skipped: int, low: int, high: int) -> None:
    """Add rows low:high, in blocks, of what a child hands on: `handed` without its first rows and columns."""
    for k in range(low, high):
        for i in range(size):
            line = handed[skipped + k * size + i, skipped:]
            target = front[to[k] + i]
            for j in range(i, size):
                target[to[k] + j] += line[k * size + j]
            for other in range(k + 1, len(to)):
                for j in range(size):
                    target[to[other] + j] += line[other * size + j]


@numba.njit(cache=True, nogil=True)
def keep(front: Floats, values: Floats) -> None:
    """The first rows of a front (f, f), upper triangle, as `values` (k f,)."""
    length = len(front)
    for i in range(len(values) // length):
        values[i * length : i * length + i] = 0.0
        for j in range(i, length):
            values[i * length + j] = front[i, j]


@numba.njit(cache=True, nogil=True)
def eliminate_run(
    low: int, end: int, form: Form, children: Ints, begin: Ints, values: Floats, listed: Listed, matrix: Blocks
) -> tuple[bool, Floats, Ints]:
    """R of supernodes low:end, whole subtrees, in `values`, and what is left for others to take.

    Whether they are positive definite; what each root of the subtrees hands on, one after the other; and these roots.
    """
    first, start, _, _, parent = form
    size = matrix.diagonal.shape[1]
    below, most = np.empty(len(parent), np.int64), 0
    for node in range(low, end):
        below[node] = (start[node + 1] - start[node]) * size
        most = max(most, (first[node + 1] - first[node]) * size + below[node])
    room = np.empty(most * most)
    stack = np.empty(most_waiting(low, end, parent, children, below))
    waiting = np.empty(end - low + 1, np.int64)
    count, used = 0, 0
    for node in range(low, end):
        eliminated = (first[node + 1] - first[node]) * size
        length = eliminated + below[node]
        front = room[: length * length].reshape(length, length)
        fill(node, front, form, listed, matrix)
        for _ in range(children[node]):
            count -= 1
            child = waiting[count]
            used -= below[child] ** 2
            handed = stack[used : used + below[child] ** 2].reshape(below[child], below[child])
            to = rows_of_child(node, child, form, size)
            gather(front, to, size, handed, 0, 0, len(to))
        if not eliminate_front(front, eliminated):
            return False, stack[:0].copy(), waiting[:0].copy()
        keep(front, values[begin[node] : begin[node + 1]])
        if parent[node] >= 0:
            waiting[count] = node
            count += 1
            handed = stack[used : used + below[node] ** 2].reshape(below[node], below[node])
            used += below[node] ** 2
            for i in range(below[node]):
                for j in range(i, below[node]):
                    handed[i, j] = front[eliminated + i, eliminated + j]
    return True, stack[:used].copy(), waiting[:count].copy()
