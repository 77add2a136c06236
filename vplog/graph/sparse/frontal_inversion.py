"""Fronts of supernodes filled with the inverse of a matrix, from the inverse in their parents' fronts."""

from __future__ import annotations

import numba
import numpy as np

from vplog.data import Bools, Floats, Ints
from vplog.graph.sparse.dense_front import AT_ONCE, STRIP, subtract_scaled
from vplog.graph.sparse.frontal import Form, child_rows, position
from vplog.graph.sparse.workers import Workers

Requests = tuple[Ints, Ints, Ints, Floats]
"""Where the pairs of each supernode begin, (S + 1,), their columns (K,), (K,), and the blocks (3, K, d, d)."""
Tree = tuple[Ints, Ints, Ints]
"""Where the children of each supernode begin, (S + 1,), these, and how many rows are below each, (S,)."""

SHARED = 1024
"""Rows from which on a front is worth sharing between threads: eight of them then take four milliseconds of one."""
_LEAST_SHARE = 64
"""Columns that a thread takes at least."""


def invert_together(front: Floats, root: Floats, workers: Workers) -> None:
    """`invert_front` by several threads where the front is large."""
    width, length = root.shape
    if length < SHARED or workers.count == 1:
        invert_front(front, root)
        return
    gain = np.empty((AT_ONCE, length))
    end = width
    while end > 0:
        begun = max(end - AT_ONCE, 0)
        _gain_of_panel(root, begun, end, gain)
        parts = workers.ranges(end, length, _LEAST_SHARE)
        workers.each(_off_diagonal, [(front, begun, end, gain, left, right) for left, right in parts])
        _diagonal_block(front, root, begun, end)
        end = begun


@numba.njit(cache=True, nogil=True)
def invert_front(front: Floats, root: Floats) -> None:
    """The inverse (f, f) from R's rows (k, f) and from its lower right part, which is given, in place."""
    width, length = root.shape
    gain = np.empty((AT_ONCE, length))
    end = width
    while end > 0:
        begun = max(end - AT_ONCE, 0)
        _gain_of_panel(root, begun, end, gain)
        _off_diagonal(front, begun, end, gain, end, length)
        _diagonal_block(front, root, begun, end)
        end = begun


@numba.njit(cache=True, nogil=True)
def _off_diagonal(front: Floats, begun: int, end: int, gain: Floats, low: int, high: int) -> None:
    """Rows begun:end of the inverse in columns low:high, all after `end`, and their mirror image."""
    length = len(front)
    share = np.empty(AT_ONCE)
    for k in range(begun, end):
        for j in range(low, high):
            front[k, j] = 0.0
    for left in range(low, high, STRIP):
        right = min(left + STRIP, high)
        for i in range(end, length, AT_ONCE):
            last = min(i + AT_ONCE, length)
            for k in range(begun, end):
                for other in range(i, last):
                    share[other - i] = gain[k - begun, other]
                subtract_scaled(front, k, front, i, last, share, left, right)
    for k in range(begun, end):
        for j in range(low, high):
            front[j, k] = front[k, j]


@numba.njit(cache=True, nogil=True)
def _diagonal_block(front: Floats, root: Floats, begun: int, end: int) -> None:
    """Rows and columns begun:end of the inverse, row by row."""
    length = root.shape[1]
    for k in range(end - 1, begun - 1, -1):
        for j in range(end - 1, k - 1, -1):
            total = 1.0 / root[k, k] if j == k else 0.0
            for i in range(k + 1, length):
                total -= root[k, i] * front[i, j]
            front[k, j] = front[j, k] = total / root[k, k]


@numba.njit(cache=True, nogil=True)
def _gain_of_panel(root: Floats, begun: int, end: int, gain: Floats) -> None:
    """Rows begun:end of R from column `end` on, multiplied by the inverse of their diagonal block."""
    length = root.shape[1]
    for k in range(end - 1, begun - 1, -1):
        line = gain[k - begun]
        for j in range(end, length):
            line[j] = root[k, j]
        for i in range(k + 1, end):
            times, other = root[k, i], gain[i - begun]
            for j in range(end, length):
                line[j] -= times * other[j]
        inverse = 1.0 / root[k, k]
        for j in range(end, length):
            line[j] *= inverse


@numba.njit(cache=True, nogil=True)
def store_blocks(node: int, front: Floats, form: Form, size: int, requests: Requests) -> None:
    """Store the blocks that are requested of a supernode."""
    first, start, rows, _, _ = form
    requested, low, high, result = requests
    width = first[node + 1] - first[node]
    for pair in range(requested[node], requested[node + 1]):
        one = (low[pair] - first[node]) * size
        if high[pair] < first[node + 1]:
            two = (high[pair] - first[node]) * size
        else:
            two = (width + position(rows, int(start[node]), int(start[node + 1]), int(high[pair])) - start[node]) * size
        for i in range(size):
            for j in range(size):
                result[0, pair, i, j] = front[one + i, one + j]
                result[1, pair, i, j] = front[one + i, two + j]
                result[2, pair, i, j] = front[two + i, two + j]


@numba.njit(cache=True, nogil=True)
def extract(front: Floats, to: Ints, size: int, part: Floats) -> None:
    """Copy the rows and columns `to`, in blocks, of a front into `part`."""
    for k in range(len(to)):
        for i in range(size):
            source, line = front[to[k] + i], part[k * size + i]
            for other in range(len(to)):
                for j in range(size):
                    line[other * size + j] = source[to[other] + j]


@numba.njit(cache=True, nogil=True)
def _largest_stack(low: int, end: int, given: int, needed: Bools, parent: Ints, tree: Tree) -> int:
    """Most entries on the stack at any time, `given` of them at first."""
    child, children, below = tree
    used = most = given
    for node in range(end - 1, low - 1, -1):
        if needed[node]:
            if parent[node] >= 0:
                used -= below[node] ** 2
            for at in range(child[node], child[node + 1]):
                used += below[children[at]] ** 2
            most = max(most, used)
    return int(most)


@numba.njit(cache=True, nogil=True)
def invert_run(
    low: int, end: int, given: Floats, form: Form, size: int, begin: Ints, values: Floats, needed: Bools, tree: Tree,
    requests: Requests,
) -> None:  # fmt: skip
    """Supernodes low:end that are needed, whole subtrees, from the last to the first.

    `given` is the inverse at the rows below each of their roots that are needed, one after the other.
    """
    first, parent, most = form.first, form.parent, 0
    child, children, below = tree
    for node in range(low, end):
        if needed[node]:
            most = max(most, (first[node + 1] - first[node]) * size + below[node])
    room = np.empty(most * most)
    stack = np.empty(_largest_stack(low, end, len(given), needed, parent, tree))
    for i in range(len(given)):
        stack[i] = given[i]
    used = len(given)
    for node in range(end - 1, low - 1, -1):
        if not needed[node]:
            continue
        width, left = (first[node + 1] - first[node]) * size, below[node]
        length = width + left
        front = room[: length * length].reshape(length, length)
        if parent[node] >= 0:
            used -= left * left
            for i in range(left):
                for j in range(left):
                    front[width + i, width + j] = stack[used + i * left + j]
        invert_front(front, values[begin[node] : begin[node + 1]].reshape(width, length))
        store_blocks(node, front, form, size, requests)
        for at in range(child[node], child[node + 1]):
            count = below[children[at]]
            to = child_rows(node, children[at], form, size)
            extract(front, to, size, stack[used : used + count * count].reshape(count, count))
            used += count * count
