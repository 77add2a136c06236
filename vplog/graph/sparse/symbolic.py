"""Elimination order of the poses of a sparse graph, and the fill-in of the factor, in blocks: one row for each node.

Davis, Direct Methods for Sparse Linear Systems, SIAM 2006, chapters 4 and 7.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import gtsam
import numpy as np
from scipy import sparse
from scipy.sparse.csgraph import depth_first_order
from scipy.sparse.linalg import splu

from vplog.data import Int32s, Ints
from vplog.graph.sparse.kernels import Panels

_RELAXED = 0.1
"""Supernodes are merged if at most this share of the entries becomes zeros: dense work is faster than indices.
On 100,000 poses, 0.05 takes 4.1e9 operations, 0.1 takes 4.2e9, 0.2 takes 5.4e9 and half as many supernodes."""
_SMALL = 4
"""Number of nodes up to which supernodes are always merged: their entries cost less than their indices."""
_WIDEST = 16
"""Maximum number of nodes of a supernode. A panel of 96 rows and 2,000 columns fills an L2 cache of 1.5 MB."""


@dataclass(frozen=True, eq=False)
class Elimination:
    """Shape of a factor of a symmetric matrix of n rows, in supernodes."""

    place: Ints
    """(n,) when each node is eliminated."""
    panels: Panels

    @classmethod
    def of(cls, n: int, a: Int32s | Ints, b: Int32s | Ints) -> Elimination:
        """Eliminate a graph of n nodes with edges a, b (E,) by nested dissection (METIS); deterministic."""
        low, high = np.minimum(a, b).astype(np.int64), np.maximum(a, b).astype(np.int64)
        pairs = np.unique((low * n + high)[low != high])
        low, high = pairs // n, pairs % n
        place = dissected(n, low, high)
        pattern = _fill(n, place[low], place[high])
        count = np.diff(pattern.indptr).astype(np.int64)
        # the elimination tree, its roots below node n
        parent = np.full(n, n)
        parent[count > 0] = pattern.indices[pattern.indptr[:-1][count > 0]]
        tree = sparse.csr_array((np.ones(n), (parent, np.arange(n))), shape=(n + 1, n + 1))
        order = depth_first_order(tree, n, return_predecessors=False)[:0:-1]  # subtree by subtree, children first
        number = np.empty(n + 1, np.int64)
        number[order], number[n] = np.arange(n), n
        first = _supernodes(number[parent[order]], count[order])
        last = order[first[1:] - 1]
        start = np.concatenate([[0], np.cumsum(count[last])])
        node = np.repeat(np.arange(len(last)), count[last])
        rows = number[pattern.indices[np.arange(start[-1]) + (pattern.indptr[last] - start[:-1])[node]]]
        rows = np.sort(node * n + rows) % n
        width = np.diff(first)
        begin = np.concatenate([[0], np.cumsum(width * (width + count[last]))])
        node, longest = np.repeat(np.arange(len(last)), width), int((width + count[last]).max())
        return cls(number[place], Panels(first, start, rows, begin, node, longest))

    def locate(self, low: Ints, high: Ints, size: int) -> tuple[Ints, Ints]:
        """Return where the blocks (size, size) at rows low and columns high (K,) begin in the panels' values, and the
        distance of their lines. Both are places in the order, low <= high. -1 for blocks that are not in this shape."""
        first, start, rows, begin, node, _ = self.panels
        n, of = len(node), node[low]
        keys = np.repeat(np.arange(len(start) - 1) * n, np.diff(start)) + rows
        at = np.searchsorted(keys, of * n + high)
        width = first[of + 1] - first[of]
        length = width + start[of + 1] - start[of]
        inside = high < first[of + 1]
        known = inside | (np.append(keys, -1)[at] == of * n + high)
        column = np.where(inside, high - first[of], width + at - start[of])
        offset = (begin[of] + (low - first[of]) * length) * size * size + column * size
        return np.where(known, offset, -1), length * size


def dissected(n: int, a: Ints, b: Ints) -> Ints:
    """Return the position (n,) of each node in the elimination order."""
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


def _fill(n: int, a: Ints, b: Ints) -> sparse.csc_array:
    """Return the pattern below the diagonal of the factor of a graph whose edges a, b (E,) are named by place.

    SuperLU factorises the graph's Laplacian. The small multiple of I makes it regular, and is so small that no entry
    underflows along a chain of 10^5 nodes: SciPy drops zeros.
    """
    degree = np.bincount(np.concatenate([a, b]), minlength=n) + 1e-9
    one, two = np.concatenate([a, b, np.arange(n)]), np.concatenate([b, a, np.arange(n)])
    laplacian = sparse.csc_array((np.concatenate([-np.ones(2 * len(a)), degree]), (one, two)), shape=(n, n))
    lu = splu(laplacian, permc_spec="NATURAL", diag_pivot_thresh=0.0, options={"SymmetricMode": True})
    return sparse.csc_array(sparse.tril(lu.L, -1, format="csc")).sorted_indices()


def _supernodes(parent: Ints, count: Ints) -> Ints:
    """Return the first columns (S + 1,) of the supernodes, from each column's parent and number of rows below it.

    Runs of columns of equal structure, merged with the run before if that adds few zeros.
    """
    n = len(parent)
    equal = np.concatenate([[False], (parent[:-1] == np.arange(1, n)) & (count[:-1] == count[1:] + 1)])
    begins = np.flatnonzero(~equal).tolist()
    entries = np.concatenate([[0], np.cumsum(count + 1)]).tolist()
    parents, below, first = parent.tolist(), count.tolist(), list[int]()
    for run, end in pairwise([*begins, n]):
        begin = run
        while first and parents[begin - 1] < end:
            width = end - first[-1]
            whole = width * (width + 1) // 2 + width * below[end - 1]
            zeros = whole - (entries[end] - entries[first[-1]])
            if width > _WIDEST or (width > _SMALL and zeros > _RELAXED * whole):
                break
            begin = first.pop()
        first += range(begin, end, _WIDEST)
    return np.array([*first, n])
