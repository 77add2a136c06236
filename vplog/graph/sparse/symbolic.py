"""Elimination order of the poses of a sparse graph, and the fill-in of the factor.

Davis, Direct Methods for Sparse Linear Systems, SIAM 2006, chapters 4 and 7. Everything here is in blocks: one row of
the matrix for each node.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import gtsam
import numba
import numpy as np

from vplog.data import Int32s, Ints
from vplog.graph.sparse.frontal import Form
from vplog.graph.sparse.subtrees import Subtrees

_RELAXED = 0.1
"""A supernode is merged with the one that it leads to where no more than this share of the entries is zeros: dense work
is faster than indices. On 100 000 poses 0.05 takes 4.1e9 operations, 0.1 takes 4.2e9, 0.2 5.4e9 and half the fronts."""
_SMALL = 4
"""Nodes up to which two supernodes are merged whatever zeros that adds: their entries cost less than their indices."""


@dataclass(frozen=True, eq=False)
class Elimination:
    """The shape of a factor of a symmetric matrix of n rows, in supernodes: S runs of columns of equal structure."""

    place: Ints
    """(n,) when each node is eliminated."""
    first: Ints
    """(S + 1,) first column of each supernode, in order of elimination."""
    parent: Ints
    """(S,) supernode that assembles the update matrix of each; -1 for roots."""
    start: Ints
    """(S + 1,) where the rows of each begin in `rows`."""
    rows: Ints
    """Rows below the columns of each supernode that are not zero, increasing."""

    @classmethod
    def of(cls, n: int, a: Int32s | Ints, b: Int32s | Ints) -> Elimination:
        """The elimination of a graph of n nodes and edges a, b (E,), by nested dissection (METIS); deterministic."""
        low, high = np.minimum(a, b).astype(np.int64), np.maximum(a, b).astype(np.int64)
        pairs = np.unique(low * n + high)
        low, high = pairs // n, pairs % n
        low, high = low[low != high], high[low != high]
        place = dissected(n, low, high)
        first, neighbours = _adjacency(n, place[low], place[high])
        parent = _elimination_tree(n, first, neighbours)
        after = _postordered(parent)
        place = after[place]
        first, neighbours = _adjacency(n, place[low], place[high])
        parent = _elimination_tree(n, first, neighbours)
        count = _counts(n, first, neighbours, parent)
        columns, parents, size = _supernodes(parent, count, _RELAXED, _SMALL)
        start = np.concatenate([[0], np.cumsum(size)])
        rows = _structure(n, first, neighbours, columns, parents, start)
        keys = np.sort(np.repeat(np.arange(len(size)) * n, size) + rows)  # by supernode, then row
        return cls(place, columns, parents, start, keys % n)

    @property
    def form(self) -> Form:
        """The elimination for compiled loops."""
        return Form(self.first, self.start, self.rows, self.place, self.parent)

    @cached_property
    def subtrees(self) -> Subtrees:
        """Subtrees that can be eliminated in parallel."""
        return Subtrees.of(self.form)


def dissected(n: int, a: Ints, b: Ints) -> Ints:
    """(n,) position of each node in the elimination order."""
    graph = gtsam.SymbolicFactorGraph()
    for one, other in zip(a.tolist(), b.tolist(), strict=True):
        graph.push_factor(one, other)
    alone = np.setdiff1d(np.arange(n), np.concatenate([a, b]))
    order = alone
    if len(a):
        found = gtsam.Ordering.MetisSymbolicFactorGraph(graph)
        order = np.concatenate([alone, np.fromiter((found.at(k) for k in range(found.size())), np.int64, found.size())])
    place = np.empty(n, np.int64)
    place[order] = np.arange(n)
    return place


def _adjacency(n: int, a: Ints, b: Ints) -> tuple[Ints, Ints]:
    """For each column the rows next to it, increasing: where each begins (n + 1,), and rows."""
    column, row = np.concatenate([a, b]), np.concatenate([b, a])
    order = np.lexsort((row, column))
    return np.searchsorted(column[order], np.arange(n + 1)), row[order]


@numba.njit(cache=True, nogil=True)
def _elimination_tree(n: int, first: Ints, neighbours: Ints) -> Ints:
    """Parent (n,) of each column in the elimination tree, -1 for roots: Liu 1986, with path compression."""
    parent = np.full(n, -1, np.int64)
    ancestor = np.full(n, -1, np.int64)
    for row in range(n):
        for at in range(first[row], first[row + 1]):
            node = neighbours[at]
            while node != -1 and node < row:
                above = ancestor[node]
                ancestor[node] = row
                if above == -1:
                    parent[node] = row
                node = above
    return parent


@numba.njit(cache=True, nogil=True)
def _postordered(parent: Ints) -> Ints:
    """New number (n,) of each column: children right before their parents, the tree's shape as it is."""
    n = len(parent)
    child = np.full(n, -1, np.int64)
    sibling = np.full(n, -1, np.int64)
    for node in range(n - 1, -1, -1):
        if parent[node] >= 0:
            sibling[node] = child[parent[node]]
            child[parent[node]] = node
    number = np.empty(n, np.int64)
    stack = np.empty(n, np.int64)
    count = 0
    for root in range(n):
        if parent[root] >= 0:
            continue
        top = 0
        stack[0] = root
        while top >= 0:
            node = stack[top]
            if child[node] >= 0:
                top += 1
                stack[top] = child[node]
                child[node] = sibling[child[node]]
            else:
                number[node] = count
                count += 1
                top -= 1
    return number


@numba.njit(cache=True, nogil=True)
def _counts(n: int, first: Ints, neighbours: Ints, parent: Ints) -> Ints:
    """Rows (n,) below the diagonal of each column of the factor: row by row, along the tree."""
    count = np.zeros(n, np.int64)
    visited = np.full(n, -1, np.int64)
    for row in range(n):
        visited[row] = row
        for at in range(first[row], first[row + 1]):
            node = neighbours[at]
            if node >= row:
                break
            while visited[node] != row:
                visited[node] = row
                count[node] += 1
                node = parent[node]
    return count


@numba.njit(cache=True, nogil=True)
def _supernodes(parent: Ints, count: Ints, relaxed: float, small: int) -> tuple[Ints, Ints, Ints]:
    """First columns (S + 1,), parents (S,) and rows below (S,) of the supernodes.

    Runs of columns that differ by their diagonal only, and runs merged with the next where that adds few zeros.
    """
    n = len(parent)
    first = np.empty(n + 1, np.int64)
    rows = np.empty(n, np.int64)
    entries = np.empty(n, np.int64)  # of the columns as counted, without what merging adds
    made = 0
    column = 0
    while column < n:
        end = column + 1
        true = count[column] + 1
        while end < n and parent[end - 1] == end and count[end - 1] == count[end] + 1:
            true += count[end] + 1
            end += 1
        below = count[end - 1]
        while made > 0 and column <= parent[column - 1] < end:
            width = end - first[made - 1]
            whole = width * (width + 1) // 2 + width * below
            together = true + entries[made - 1]
            if width > small and whole - together > relaxed * whole:
                break
            made -= 1
            column, true = first[made], together
        first[made], rows[made], entries[made] = column, below, true
        made += 1
        column = end
    first[made] = n
    of = np.empty(n, np.int64)
    for node in range(made):
        of[first[node] : first[node + 1]] = node
    parents = np.empty(made, np.int64)
    for node in range(made):
        above = parent[first[node + 1] - 1]
        parents[node] = of[above] if above >= 0 else -1
    return first[: made + 1].copy(), parents, rows[:made].copy()


@numba.njit(cache=True, nogil=True)
def _structure(n: int, first: Ints, neighbours: Ints, columns: Ints, parents: Ints, start: Ints) -> Ints:
    """The rows of each supernode below its columns, in no order: its own and those of its children."""
    rows = np.empty(start[-1], np.int64)
    visited = np.full(n, -1, np.int64)
    child = np.full(len(parents), -1, np.int64)
    sibling = np.full(len(parents), -1, np.int64)
    for node in range(len(parents)):
        end, count = columns[node + 1], start[node]
        for column in range(columns[node], end):
            count = _add_rows(node, end, neighbours[first[column] : first[column + 1]], visited, rows, count)
        below = child[node]
        while below >= 0:
            count = _add_rows(node, end, rows[start[below] : start[below + 1]], visited, rows, count)
            below = sibling[below]
        if parents[node] >= 0:
            sibling[node] = child[parents[node]]
            child[parents[node]] = node
    return rows


@numba.njit(cache=True, nogil=True)
def _add_rows(node: int, end: int, more: Ints, visited: Ints, rows: Ints, count: int) -> int:
    """Append to a supernode's `rows` those of the rows `more` from `end` on that it does not have yet."""
    for row in more:
        if row >= end and visited[row] != node:
            visited[row] = node
            rows[count] = row
            count += 1
    return count
