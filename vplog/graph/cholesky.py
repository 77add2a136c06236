"""Factors R^T R of large sparse symmetric matrices in blocks, by supernodes, and what solves with them.

Multifrontal (Duff and Reid 1983; Davis, Direct Methods for Sparse Linear Systems, 2006): each supernode gathers its
columns and what its children hand on in one dense front, eliminates its columns, and hands on the rest. All in one
fixed order, and without a BLAS, of which the threads would decide on the last bits.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numba
import numpy as np

from vplog.errors import GraphError

if TYPE_CHECKING:
    from vplog.data import Floats, Int32s, Ints
    from vplog.graph.elimination import Elimination

_AT_ONCE = 8
"""Rows that are taken away from others in one loop: as many as a processor keeps pointers to."""
_STRIP = 512
"""Columns of a front that are worked on at once: eight rows of them, 32 kB, stay in the first cache."""
OPEN = "The graph leaves its poses too open to say where they are. Check its edges' information."


@dataclass(frozen=True, eq=False)
class Blocks:
    """A symmetric matrix of n x n blocks (d, d)."""

    diagonal: Floats
    """(n, d, d)."""
    a: Int32s | Ints
    """(E,) row of each other block; pairs may repeat, and add."""
    b: Int32s | Ints
    """(E,) its column; never the same."""
    other: Floats
    """(E, d, d) at row a, column b; its transpose at row b, column a."""


@dataclass(frozen=True, eq=False)
class Cholesky:
    """R of a matrix R^T R."""

    shape: Elimination
    size: int
    """d, of a block."""
    begin: Ints
    """(S + 1,) where the rows of R of each supernode begin in `values`."""
    values: Floats
    """For each supernode (k, k + m): k its columns, m the rows below them, all in scalars."""

    @classmethod
    def of(cls, shape: Elimination, matrix: Blocks) -> Cholesky:
        """Raises GraphError where the matrix is not positive definite, to working precision."""
        size = matrix.diagonal.shape[1]
        wide, below = np.diff(shape.first) * size, np.diff(shape.start) * size
        begin = np.concatenate([[0], np.cumsum(wide * (wide + below))])
        values = np.zeros(begin[-1])
        blocks = (matrix.diagonal, matrix.a, matrix.b, matrix.other)
        _scatter(shape.place, shape.first, shape.start, shape.rows, begin, values, *blocks)
        children = np.bincount(shape.parent[shape.parent >= 0], minlength=len(wide))
        stack = np.empty(_most_waiting(shape.parent, children, below))
        waiting, offset, state = np.empty(len(wide) + 1, np.int64), np.empty(len(wide) + 1, np.int64), np.zeros(2, int)
        tree = (shape.first, shape.start, shape.rows, children, size, stack, waiting, offset, state)
        if not _eliminate(int((wide + below).max()), begin, values, *tree):
            raise GraphError(OPEN)
        return cls(shape, size, begin, values)

    def solve(self, right: Floats) -> Floats:
        """x (n, d, c) of R^T R x = right (n, d, c)."""
        shape = self.shape
        moved = np.empty(right.shape)
        moved[shape.place] = right
        flat = moved.reshape(-1, right.shape[2])
        _solve(shape.first, shape.start, shape.rows, self.begin, self.size, self.values, flat)
        return moved[shape.place]


@numba.njit(cache=True, nogil=True)
def _most_waiting(parent: Ints, children: Ints, below: Ints) -> int:
    """Most numbers that are handed on and not taken yet at any time."""
    waiting = np.empty(len(below) + 1, np.int64)
    count, used, most = 0, 0, 0
    for node in range(len(below)):
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
def _scatter(
    place: Ints,
    first: Ints,
    start: Ints,
    rows: Ints,
    begin: Ints,
    values: Floats,
    diagonal: Floats,
    a: Int32s | Ints,
    b: Int32s | Ints,
    other: Floats,
) -> None:
    """Put the blocks of a matrix where R will be."""
    size = diagonal.shape[1]
    of = np.empty(len(place), np.int64)
    for node in range(len(first) - 1):
        of[first[node] : first[node + 1]] = node
    for row in range(len(place)):
        column = place[row]
        node = of[column]
        width = (first[node + 1] - first[node] + start[node + 1] - start[node]) * size
        at = (column - first[node]) * size
        for i in range(size):
            for j in range(size):
                values[begin[node] + (at + i) * width + at + j] += diagonal[row, i, j]
    for edge in range(len(a)):
        one, two = place[a[edge]], place[b[edge]]
        low, high = min(one, two), max(one, two)
        node = of[low]
        wide = first[node + 1] - first[node]
        width = (wide + start[node + 1] - start[node]) * size
        if high < first[node + 1]:
            at = (high - first[node]) * size
        else:
            at = (wide + found(rows, int(start[node]), int(start[node + 1]), int(high)) - start[node]) * size
        line = begin[node] + (low - first[node]) * size * width + at
        for i in range(size):
            for j in range(size):
                values[line + i * width + j] += other[edge, i, j] if one == low else other[edge, j, i]


@numba.njit(cache=True, nogil=True)
def _gather(
    node: int,
    front: Floats,
    first: Ints,
    start: Ints,
    rows: Ints,
    children: Ints,
    size: int,
    stack: Floats,
    waiting: Ints,
    offset: Ints,
    state: Ints,
) -> None:
    """Add what the children of a supernode handed on to its front, and take it off the stack."""
    wide = first[node + 1] - first[node]
    for _ in range(children[node]):
        state[0] -= 1
        child, here = waiting[state[0]], offset[state[0]]
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
        length = handed * size
        for k in range(handed):
            for i in range(size):
                line = here + (k * size + i) * length
                target = front[to[k] + i]
                for j in range(i, size):
                    target[to[k] + j] += stack[line + k * size + j]
                for other in range(k + 1, handed):
                    for j in range(size):
                        target[to[other] + j] += stack[line + other * size + j]
        state[1] = here


@numba.njit(cache=True, nogil=True)
def _hand_on(
    node: int, front: Floats, eliminated: int, stack: Floats, waiting: Ints, offset: Ints, state: Ints
) -> None:
    """Put what is left of a front on the stack."""
    left = len(front) - eliminated
    if left == 0:
        return
    here = state[1]
    waiting[state[0]], offset[state[0]] = node, here
    state[0] += 1
    state[1] = here + left * left
    for i in range(left):
        line = front[eliminated + i]
        for j in range(i, left):
            stack[here + i * left + j] = line[eliminated + j]


@numba.njit(cache=True, nogil=True)
def _eliminate(
    most: int,
    begin: Ints,
    values: Floats,
    first: Ints,
    start: Ints,
    rows: Ints,
    children: Ints,
    size: int,
    stack: Floats,
    waiting: Ints,
    offset: Ints,
    state: Ints,
) -> bool:
    """R in place of the matrix in `values`; False where it is not positive definite. No front is larger than `most`."""
    room = np.empty(most * most)
    for node in range(len(first) - 1):
        eliminated = (first[node + 1] - first[node]) * size
        length = eliminated + (start[node + 1] - start[node]) * size
        front = room[: length * length].reshape(length, length)
        for i in range(length):
            for j in range(i, length):
                front[i, j] = values[begin[node] + i * length + j] if i < eliminated else 0.0
        _gather(node, front, first, start, rows, children, size, stack, waiting, offset, state)
        if not _eliminate_front(front, eliminated):
            return False
        for i in range(eliminated):
            for j in range(i, length):
                values[begin[node] + i * length + j] = front[i, j]
        _hand_on(node, front, eliminated, stack, waiting, offset, state)
    return True


@numba.njit(cache=True, nogil=True)
def _eliminate_front(front: Floats, eliminated: int) -> bool:
    """R in the first rows of a front (f, f) of which the upper triangle is given, what is left of it in the others."""
    length = len(front)
    share = np.empty(_AT_ONCE)
    for begun in range(0, eliminated, _AT_ONCE):
        end = min(begun + _AT_ONCE, eliminated)
        for k in range(begun, end):
            line = front[k]
            if not line[k] > 0.0:  # NaN too
                return False
            inverse = 1.0 / np.sqrt(line[k])
            for j in range(k, length):
                line[j] *= inverse
            for i in range(k + 1, end):
                target, times = front[i], line[i]
                for j in range(i, length):
                    target[j] -= times * line[j]
        for left in range(end, length, _STRIP):
            right = min(left + _STRIP, length)
            for i in range(end, right):
                for k in range(begun, end):
                    share[k - begun] = front[k, i]
                take_away(front, i, front, begun, end, share, max(i, left), right)
    return True


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def take_away(
    target: Floats, row: int, rows: Floats, low: int, high: int, share: Floats, left: int, right: int
) -> None:
    """target[row] less the sum of rows[low:high], up to eight, each times its share, in columns left:right."""
    line = target[row, left:right]
    if high - low == _AT_ONCE:
        r0, r1, r2, r3 = (
            rows[low, left:right], rows[low + 1, left:right], rows[low + 2, left:right], rows[low + 3, left:right]
        )  # fmt: skip
        r4, r5, r6, r7 = (
            rows[low + 4, left:right], rows[low + 5, left:right], rows[low + 6, left:right], rows[low + 7, left:right]
        )  # fmt: skip
        s0, s1, s2, s3, s4, s5, s6, s7 = (
            share[0], share[1], share[2], share[3], share[4], share[5], share[6], share[7]
        )  # fmt: skip
        for j in range(len(line)):
            line[j] -= (
                s0 * r0[j] + s1 * r1[j] + s2 * r2[j] + s3 * r3[j] + s4 * r4[j] + s5 * r5[j] + s6 * r6[j] + s7 * r7[j]
            )
        return
    for k in range(low, high):
        one, times = rows[k, left:right], share[k - low]
        for j in range(len(line)):
            line[j] -= times * one[j]


@numba.njit(cache=True, nogil=True)
def _solve(first: Ints, start: Ints, rows: Ints, begin: Ints, size: int, values: Floats, right: Floats) -> None:
    """x of R^T R x = right (n d, c), in place, in order of elimination."""
    columns = right.shape[1]
    for node in range(len(first) - 1):
        at, wide = first[node] * size, (first[node + 1] - first[node]) * size
        length = wide + (start[node + 1] - start[node]) * size
        for k in range(wide):
            line = values[begin[node] + k * length : begin[node] + (k + 1) * length]
            for c in range(columns):
                right[at + k, c] /= line[k]
                value = right[at + k, c]
                for j in range(k + 1, wide):
                    right[at + j, c] -= line[j] * value
                j = wide
                for row in range(start[node], start[node + 1]):
                    for i in range(size):
                        right[rows[row] * size + i, c] -= line[j] * value
                        j += 1
    for node in range(len(first) - 2, -1, -1):
        at, wide = first[node] * size, (first[node + 1] - first[node]) * size
        length = wide + (start[node + 1] - start[node]) * size
        for k in range(wide - 1, -1, -1):
            line = values[begin[node] + k * length : begin[node] + (k + 1) * length]
            for c in range(columns):
                value = right[at + k, c]
                for j in range(k + 1, wide):
                    value -= line[j] * right[at + j, c]
                j = wide
                for row in range(start[node], start[node + 1]):
                    for i in range(size):
                        value -= line[j] * right[rows[row] * size + i, c]
                        j += 1
                right[at + k, c] = value / line[k]
