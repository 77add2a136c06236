"""Subtrees of an elimination tree that are eliminated in parallel, and the rest above them."""

from __future__ import annotations

from dataclasses import dataclass

import numba
import numpy as np

from vplog.data import Floats, Ints
from vplog.graph.sparse.frontal import Form

_PIECES = 64
"""A run takes no more than this share of the work: 16 threads have four each, and few fronts are above them all."""
_LEAST_RUN = 1e6
"""Work of a run below which threads are not worth their start: some ten milliseconds."""


@dataclass(frozen=True, eq=False)
class Subtrees:
    """Independent runs of supernodes, each one or more whole subtrees; the same for any number of threads."""

    runs: list[tuple[int, int]]
    """First supernode and the one after the last, the run of most work first."""
    roots: list[Ints]
    """Roots of the subtrees of each run."""
    after: list[Ints]
    """Rows after each run that it updates."""
    top: list[int]
    """Supernodes above all runs, in order of elimination."""
    children: list[list[int]]
    """Children of each supernode of the top."""

    @classmethod
    def of(cls, shape: Form) -> Subtrees:
        parent, width, below = shape.parent, np.diff(shape.first), np.diff(shape.start)
        work = width * (width + below).astype(float) ** 2
        total = _subtree_sums(parent, work)
        limit = max(float(work.sum()) / _PIECES, _LEAST_RUN)
        high = total > limit
        runs, load = _runs(parent, total, high, limit)
        runs = runs[np.argsort(-load, kind="stable")]
        ends = np.flatnonzero((parent < 0) | high[parent])  # of subtrees, and the top
        roots = [ends[np.searchsorted(ends, low) : np.searchsorted(ends, end)] for low, end in runs]
        # the rows below a supernode are columns of its parent, or below that, too
        after = [
            np.unique(np.concatenate([shape.rows[shape.start[root] : shape.start[root + 1]] for root in own]))
            for own in roots
        ]
        top = np.flatnonzero(high)
        below_top = ends[parent[ends] >= 0]
        below_top = below_top[np.argsort(parent[below_top], kind="stable")]
        begin = np.searchsorted(parent[below_top], top)
        end = np.searchsorted(parent[below_top], top, "right")
        children = [below_top[one:two].tolist() for one, two in zip(begin, end, strict=True)]
        return cls([(int(low), int(end)) for low, end in runs], roots, after, top.tolist(), children)


@numba.njit(cache=True, nogil=True)
def _subtree_sums(parent: Ints, work: Floats) -> Floats:
    """Sum (S,) of the work of each subtree, by its root."""
    total = work.copy()
    for node in range(len(parent)):
        if parent[node] >= 0:
            total[parent[node]] += total[node]
    return total


@numba.njit(cache=True, nogil=True)
def _runs(parent: Ints, total: Floats, high: np.ndarray, limit: float) -> tuple[Ints, Floats]:
    """First and one after last (K, 2) of the runs, and their work (K,): neighbouring subtrees up to the limit."""
    ends = np.empty((len(parent), 2), np.int64)
    load = np.empty(len(parent))
    count, begun, taken = 0, 0, 0.0
    open_from = 0  # first supernode of the subtree that the next root ends
    for node in range(len(parent)):
        root = not high[node] and (parent[node] < 0 or high[parent[node]])
        if (high[node] or (root and taken + total[node] > limit)) and open_from > begun:
            ends[count, 0], ends[count, 1], load[count] = begun, open_from, taken
            count += 1
            begun, taken = open_from, 0.0
        if high[node]:
            begun = open_from = node + 1
        elif root:
            taken += total[node]
            open_from = node + 1
    if open_from > begun:
        ends[count, 0], ends[count, 1], load[count] = begun, open_from, taken
        count += 1
    return ends[:count].copy(), load[:count].copy()
