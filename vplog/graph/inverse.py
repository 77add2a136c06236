"""Blocks of the inverse of a large sparse matrix: those that its factor touches, and nothing else.

Takahashi, Fagan and Chen 1973, by supernodes: the inverse at the rows and columns of a supernode follows from R and
from the inverse at its rows below, all of which its parent knows. So all edges of a graph together cost about as much
as two factorisations.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numba
import numpy as np

from vplog.graph.cholesky import found, take_away

if TYPE_CHECKING:
    from vplog.data import Floats, Int32s, Ints
    from vplog.graph.cholesky import Cholesky

_AT_ONCE = 8
"""Rows worked out at once, and rows that are taken away from others in one loop."""
_STRIP = 512
"""Columns of a front that are worked on at once: eight rows of them, 32 kB, stay in the first cache."""


def inverse_blocks(factor: Cholesky, a: Int32s | Ints, b: Int32s | Ints) -> tuple[Floats, Floats, Floats]:
    """Blocks (K, d, d) of the inverse at a, a; at a, b; and at b, b, of pairs that the shape was made with."""
    shape, size = factor.shape, factor.size
    wide, below = np.diff(shape.first) * size, np.diff(shape.start) * size
    one, two = shape.place[a], shape.place[b]
    low, high = np.minimum(one, two), np.maximum(one, two)
    where = np.searchsorted(shape.first, low, "right") - 1  # the front that holds both
    order = np.argsort(where, kind="stable")
    asked = np.searchsorted(where[order], np.arange(len(wide) + 1))
    low, high = low[order], high[order]
    kept = np.zeros((3, len(order), size, size))

    needed = _needed(shape.parent, np.diff(asked))
    handed = np.flatnonzero((shape.parent >= 0) & needed)
    children = handed[np.argsort(shape.parent[handed], kind="stable")]
    child = np.searchsorted(shape.parent[children], np.arange(len(wide) + 1))
    stack = np.empty(_most_waiting(needed, child, children, below))
    used = np.zeros(1, int)
    tree = (shape.first, shape.start, shape.rows, child, children, size, stack, used)
    wanted = (asked, low, high, kept)
    _invert(int((wide + below).max()), needed, factor.begin, factor.values, *tree, *wanted)
    result = np.empty_like(kept)
    result[:, order] = kept
    turned = (one > two)[:, None, None]  # kept as first, both, second in order of elimination
    aa, ab, bb = result
    return (
        np.where(turned, bb, aa),
        np.where(turned, np.swapaxes(ab, 1, 2), ab),
        np.where(turned, aa, bb),
    )


def joint_inverse(factor: Cholesky, nodes: Ints) -> Floats:
    """The inverse (K d, K d) at a few different nodes (K,): R^-T of their unit vectors, on their ways to the root."""
    shape, size = factor.shape, factor.size
    place = shape.place[nodes]
    own = np.searchsorted(shape.first, place, "right") - 1
    path: set[int] = set()
    for node in own.tolist():
        while node >= 0 and node not in path:
            path.add(node)
            node = int(shape.parent[node])  # noqa: PLW2901 (on the way up)
    along = np.array(sorted(path))
    wide = shape.first[along + 1] - shape.first[along]
    begin = np.cumsum(wide) - wide
    columns = np.concatenate(
        [np.arange(begun, end) for begun, end in zip(shape.first[along], shape.first[along + 1], strict=True)]
    )
    unit = np.zeros((len(columns) * size, len(nodes) * size))
    for k, at in enumerate(np.searchsorted(columns, place).tolist()):
        unit[at * size : (at + 1) * size, k * size : (k + 1) * size] = np.eye(size)
    _onward(along, begin, columns, shape.first, shape.start, shape.rows, factor.begin, size, factor.values, unit)
    result = np.zeros((len(nodes) * size, len(nodes) * size))
    _squared(unit, result)
    return result


@numba.njit(cache=True, nogil=True)
def _onward(
    along: Ints,
    begun: Ints,
    columns: Ints,
    first: Ints,
    start: Ints,
    rows: Ints,
    begin: Ints,
    size: int,
    values: Floats,
    unit: Floats,
) -> None:
    """R^-T of the columns of `unit`, in place, by the supernodes `along`, whose columns are `columns`."""
    for k in range(len(along)):
        node, at = along[k], begun[k]
        wide = first[node + 1] - first[node]
        length = wide + start[node + 1] - start[node]
        to = np.empty(length, np.int64)
        for i in range(length):
            if i < wide:
                to[i] = at + i
            else:
                to[i] = found(columns, int(at + wide), len(columns), int(rows[start[node] + i - wide]))
        for i in range(wide * size):
            line = begin[node] + i * length * size
            own = unit[at * size + i]
            for c in range(len(own)):
                own[c] /= values[line + i]
            for j in range(i + 1, length * size):
                target, share = unit[to[j // size] * size + j % size], values[line + j]
                for c in range(len(own)):
                    target[c] -= share * own[c]


@numba.njit(cache=True, nogil=True)
def _squared(lines: Floats, result: Floats) -> None:
    """Add the products of all columns of `lines` with each other, in a fixed order."""
    for line in lines:
        for i in range(len(line)):
            if line[i] != 0.0:
                target, share = result[i], line[i]
                for j in range(len(line)):
                    target[j] += share * line[j]


@numba.njit(cache=True, nogil=True)
def _needed(parent: Ints, asked: Ints) -> np.ndarray:
    """Whether each supernode or one of those below it is asked for."""
    needed = asked > 0
    for node in range(len(parent)):
        if needed[node] and parent[node] >= 0:
            needed[parent[node]] = True
    return needed


@numba.njit(cache=True, nogil=True)
def _most_waiting(needed: np.ndarray, child: Ints, children: Ints, below: Ints) -> int:
    """Most numbers that are handed down and not taken yet at any time."""
    used, most = 0, 0
    handed = np.zeros(len(below), np.bool_)
    for node in range(len(below) - 1, -1, -1):
        if needed[node]:
            if handed[node]:
                used -= below[node] ** 2
            for at in range(child[node], child[node + 1]):
                handed[children[at]] = True
                used += below[children[at]] ** 2
            most = max(most, used)
    return int(most)


@numba.njit(cache=True, nogil=True)
def _take(front: Floats, rows: int, stack: Floats, used: Ints) -> None:
    """The inverse at the rows below a supernode, from the stack."""
    left = len(front) - rows
    used[0] -= left * left
    here = used[0]
    for i in range(left):
        line = front[rows + i]
        for j in range(left):
            line[rows + j] = stack[here + i * left + j]


@numba.njit(cache=True, nogil=True)
def _hand_down(
    node: int,
    front: Floats,
    first: Ints,
    start: Ints,
    rows: Ints,
    child: Ints,
    children: Ints,
    size: int,
    stack: Floats,
    used: Ints,
) -> None:
    """Put what each child needs on the stack, the one that comes next on top."""
    wide = first[node + 1] - first[node]
    for at in range(child[node], child[node + 1]):
        below = children[at]
        count = start[below + 1] - start[below]
        here, length = used[0], count * size
        used[0] += length * length
        taken = np.empty(count, np.int64)
        along = start[node]
        for k in range(count):
            row = rows[start[below] + k]
            if row < first[node + 1]:
                taken[k] = (row - first[node]) * size
            else:
                while rows[along] != row:
                    along += 1
                taken[k] = (wide + along - start[node]) * size
        for k in range(count):
            for i in range(size):
                source = front[taken[k] + i]
                line = here + (k * size + i) * length
                for other in range(count):
                    for j in range(size):
                        stack[line + other * size + j] = source[taken[other] + j]


@numba.njit(cache=True, nogil=True)
def _note(
    node: int,
    front: Floats,
    first: Ints,
    start: Ints,
    rows: Ints,
    size: int,
    asked: Ints,
    low: Ints,
    high: Ints,
    result: Floats,
) -> None:
    """Keep the blocks that are asked of a supernode."""
    wide = first[node + 1] - first[node]
    for pair in range(asked[node], asked[node + 1]):
        one = (low[pair] - first[node]) * size
        if high[pair] < first[node + 1]:
            two = (high[pair] - first[node]) * size
        else:
            two = (wide + found(rows, int(start[node]), int(start[node + 1]), int(high[pair])) - start[node]) * size
        for i in range(size):
            for j in range(size):
                result[0, pair, i, j] = front[one + i, one + j]
                result[1, pair, i, j] = front[one + i, two + j]
                result[2, pair, i, j] = front[two + i, two + j]


@numba.njit(cache=True, nogil=True)
def _invert(
    most: int,
    needed: np.ndarray,
    begin: Ints,
    values: Floats,
    first: Ints,
    start: Ints,
    rows: Ints,
    child: Ints,
    children: Ints,
    size: int,
    stack: Floats,
    used: Ints,
    asked: Ints,
    low: Ints,
    high: Ints,
    result: Floats,
) -> None:
    """All supernodes that are needed, from the last to the first. No front is larger than `most`."""
    room = np.empty(most * most)
    for node in range(len(first) - 2, -1, -1):
        if not needed[node]:
            continue
        wide = (first[node + 1] - first[node]) * size
        length = wide + (start[node + 1] - start[node]) * size
        front = room[: length * length].reshape(length, length)
        _take(front, wide, stack, used)
        _invert_front(front, values[begin[node] : begin[node + 1]].reshape(wide, length))
        _note(node, front, first, start, rows, size, asked, low, high, result)
        _hand_down(node, front, first, start, rows, child, children, size, stack, used)


@numba.njit(cache=True, nogil=True)
def _invert_front(front: Floats, root: Floats) -> None:
    """The inverse (f, f) from R's rows (k, f) and from its lower right part, which is given, in place."""
    wide, length = root.shape
    gain, share = np.empty((_AT_ONCE, length)), np.empty(_AT_ONCE)
    end = wide
    while end > 0:
        begun = max(end - _AT_ONCE, 0)
        _gained(root, begun, end, gain)
        for k in range(begun, end):
            for j in range(end, length):
                front[k, j] = 0.0
        for left in range(end, length, _STRIP):
            right = min(left + _STRIP, length)
            for i in range(end, length, _AT_ONCE):
                last = min(i + _AT_ONCE, length)
                for k in range(begun, end):
                    for other in range(i, last):
                        share[other - i] = gain[k - begun, other]
                    take_away(front, k, front, i, last, share, left, right)
        for k in range(begun, end):
            for j in range(end, length):
                front[j, k] = front[k, j]
        # within the block, row by row
        for k in range(end - 1, begun - 1, -1):
            for j in range(end - 1, k - 1, -1):
                total = 1.0 / root[k, k] if j == k else 0.0
                for i in range(k + 1, length):
                    total -= root[k, i] * front[i, j]
                front[k, j] = front[j, k] = total / root[k, k]
        end = begun


@numba.njit(cache=True, nogil=True)
def _gained(root: Floats, begun: int, end: int, gain: Floats) -> None:
    """Rows begun:end of R by its block there, from column `end` on: what these are told by all after them."""
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
