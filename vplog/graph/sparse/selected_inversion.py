"""Selected inversion: the blocks of the inverse of a large sparse matrix at the nonzeros of its factor.

Takahashi, Fagan and Chen 1973, by supernodes: the inverse at the rows and columns of a supernode follows from R and
from the inverse at its rows below, all of which are in its parent's front. So all edges of a graph together cost about
as much as two factorisations. The supernodes above all subtrees come first, front by front, then these in parallel.
"""

from __future__ import annotations

import numba
import numpy as np

from vplog.data import Floats, Int32s, Ints
from vplog.graph.sparse.cholesky import Cholesky
from vplog.graph.sparse.frontal import Form, child_rows, position
from vplog.graph.sparse.frontal_inversion import extract, invert_run, invert_together, store_blocks
from vplog.graph.sparse.workers import Workers


def inverse_blocks(factor: Cholesky, a: Int32s | Ints, b: Int32s | Ints) -> tuple[Floats, Floats, Floats]:
    """Blocks (K, d, d) of the inverse at a, a; at a, b; and at b, b, of pairs that the shape was made with."""
    shape, size = factor.shape, factor.size
    width, below = np.diff(shape.first) * size, np.diff(shape.start) * size
    one, two = shape.place[a], shape.place[b]
    low, high = np.minimum(one, two), np.maximum(one, two)
    where = np.searchsorted(shape.first, low, "right") - 1  # the front that holds both
    order = np.argsort(where, kind="stable")
    requested = np.searchsorted(where[order], np.arange(len(width) + 1))
    low, high = low[order], high[order]
    blocks = np.zeros((3, len(order), size, size))

    needed = _needed(shape.parent, np.diff(requested))
    children = np.flatnonzero((shape.parent >= 0) & needed)
    children = children[np.argsort(shape.parent[children], kind="stable")]
    child = np.searchsorted(shape.parent[children], np.arange(len(width) + 1))
    form, requests = shape.form, (requested, low, high, blocks)
    known: dict[int, Floats] = {}
    with Workers() as workers:
        for node in reversed(shape.subtrees.top):
            if not needed[node]:
                continue
            length = int(width[node] + below[node])
            front = np.empty((length, length))
            if below[node]:
                front[width[node] :, width[node] :] = known.pop(node)
            root = factor.values[factor.begin[node] : factor.begin[node + 1]].reshape(width[node], length)
            invert_together(front, root, workers)
            store_blocks(node, front, form, size, requests)
            tasks = []
            for below_it in children[child[node] : child[node + 1]].tolist():
                known[below_it] = np.empty((below[below_it], below[below_it]))
                tasks.append((front, child_rows(node, below_it, form, size), size, known[below_it]))
            workers.each(extract, tasks)
        given = [
            np.concatenate([np.empty(0), *(known.pop(root).ravel() for root in roots.tolist() if root in known)])
            for roots in shape.subtrees.roots
        ]
        tree = (form, size, factor.begin, factor.values, needed, (child, children, below), requests)
        tasks = [(*run, roots, *tree) for run, roots in zip(shape.subtrees.runs, given, strict=True)]
        workers.each(invert_run, tasks)
    result = np.empty_like(blocks)
    result[:, order] = blocks
    turned = (one > two)[:, None, None]  # the blocks are in order of elimination: first, both, second
    aa, ab, bb = result
    return (
        np.where(turned, bb, aa),
        np.where(turned, np.swapaxes(ab, 1, 2), ab),
        np.where(turned, aa, bb),
    )


def joint_inverse(factor: Cholesky, nodes: Ints) -> Floats:
    """The inverse (K d, K d) at a few different nodes (K,): R^-T of their unit vectors, on their paths to the root."""
    shape, size = factor.shape, factor.size
    place = shape.place[nodes]
    own = np.searchsorted(shape.first, place, "right") - 1
    path: set[int] = set()
    for node in own.tolist():
        while node >= 0 and node not in path:
            path.add(node)
            node = int(shape.parent[node])  # noqa: PLW2901 (on the way up)
    along = np.array(sorted(path))
    width = shape.first[along + 1] - shape.first[along]
    begin = np.cumsum(width) - width
    columns = np.concatenate(
        [np.arange(begun, end) for begun, end in zip(shape.first[along], shape.first[along + 1], strict=True)]
    )
    unit = np.zeros((len(columns) * size, len(nodes) * size))
    for k, at in enumerate(np.searchsorted(columns, place).tolist()):
        unit[at * size : (at + 1) * size, k * size : (k + 1) * size] = np.eye(size)
    _forward(along, begin, columns, shape.form, factor.begin, size, factor.values, unit)
    result = np.zeros((len(nodes) * size, len(nodes) * size))
    _gram(unit, result)
    return result


@numba.njit(cache=True, nogil=True)
def _forward(
    along: Ints, begun: Ints, columns: Ints, form: Form, begin: Ints, size: int, values: Floats, unit: Floats
) -> None:
    """R^-T of the columns of `unit`, in place, by the supernodes `along`, whose columns are `columns`."""
    first, start, rows, _, _ = form
    for k in range(len(along)):
        node, at = along[k], begun[k]
        width = first[node + 1] - first[node]
        length = width + start[node + 1] - start[node]
        to = np.empty(length, np.int64)
        for i in range(length):
            if i < width:
                to[i] = at + i
            else:
                to[i] = position(columns, int(at + width), len(columns), int(rows[start[node] + i - width]))
        for i in range(width * size):
            line = begin[node] + i * length * size
            own = unit[at * size + i]
            for c in range(len(own)):
                own[c] /= values[line + i]
            for j in range(i + 1, length * size):
                target, share = unit[to[j // size] * size + j % size], values[line + j]
                for c in range(len(own)):
                    target[c] -= share * own[c]


@numba.njit(cache=True, nogil=True)
def _gram(lines: Floats, result: Floats) -> None:
    """Add the products of all columns of `lines` with each other, in a fixed order."""
    for line in lines:
        for i in range(len(line)):
            if line[i] != 0.0:
                target, share = result[i], line[i]
                for j in range(len(line)):
                    target[j] += share * line[j]


@numba.njit(cache=True, nogil=True)
def _needed(parent: Ints, requested: Ints) -> np.ndarray:
    """Whether blocks of each supernode or of a descendant are requested."""
    needed = requested > 0
    for node in range(len(parent)):
        if needed[node] and parent[node] >= 0:
            needed[parent[node]] = True
    return needed
