"""Common pattern discovery by randomized visual phrases: Algorithm 3 of Tanaka et al. 2014.

Boxes lie on a grid of G x G cells, so the kernel keeps the sum of the voting map V over each cell: a patch adds its
similarity times the pixels it shares with the cell, which is the per-pixel algorithm exactly.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numba
import numpy as np
from numpy.typing import NDArray

from vplog.data import Float32s, Floats, Int32s, Ints


class Pattern(NamedTuple):
    """One reference, ready for discovery: its words, and the features and patches that have them."""

    words: Int32s
    """(U,) its words, increasing."""
    posting_start: Int32s
    """Features with word u are posting[posting_start[u]:posting_start[u + 1]]."""
    posting: Int32s
    patches: NDArray
    totals: Int32s
    x_cuts: Int32s
    y_cuts: Int32s
    grid_x: Int32s
    grid_y: Int32s


def draw_partitions(width: int, height: int, K: int, M: int, N: int, rng: np.random.Generator) -> tuple[Int32s, Int32s]:
    """Cuts in px, (K, M + 1) from 0 to the width and (K, N + 1) from 0 to the height, of K independent partitions into
    M columns x N rows, uniform over the pixel borders (Alg. 3 line 6)."""

    def cuts(length: int, parts: int) -> Int32s:
        inner = np.sort(rng.integers(0, length + 1, (K, parts - 1)), axis=1)
        ends = np.zeros((K, 1), np.int64), np.full((K, 1), length)
        return np.concatenate([ends[0], inner, ends[1]], axis=1).astype(np.int32)

    return cuts(width, M), cuts(height, N)


def grid_cuts(length: int, cells: int) -> Int32s:
    """(cells + 1,) px: the borders of the grid's cells along one side."""
    return ((np.arange(cells + 1) * length + cells // 2) // cells).astype(np.int32)


def patches_of(points: Float32s, x_cuts: Int32s, y_cuts: Int32s) -> NDArray[np.uint16]:
    """(K, F) the patch n * M + m each point falls in; points past an edge count to the pixel at the edge."""
    pixel = (points.astype(np.float64) + 0.5).astype(np.int64)
    columns, rows = (
        (np.clip(pixel[:, axis], 0, cuts[0, -1] - 1)[:, None] >= cuts[:, None, 1:-1]).sum(axis=2)
        for axis, cuts in enumerate((x_cuts, y_cuts))
    )
    return (rows * (x_cuts.shape[1] - 1) + columns).astype(np.uint16)


def patch_totals(patches: NDArray[np.uint16], words_per_feature: Ints, count: int) -> Int32s:
    """(K, count) how many words the features of each patch have (the size of H_mnk)."""
    totals = [np.bincount(patch, words_per_feature, count) for patch in patches]
    return np.array(totals, np.int32)


@numba.njit(cache=True, nogil=True)
def vote(H, H_size, pattern):
    """Sum of the voting map V over each cell of the grid (Alg. 3 lines 1-16): (G, G) float64, rows are y.

    H (U,) int32 counts of the reference's words in the window, `H_size` the count of all its words, known here or
    not; `pattern` is the reference's Pattern.
    The similarity is normalised histogram intersection, sum(min) / sum(max) (Jiang, Meng, Yuan, CVPR 2012).
    """
    _, posting_start, posting, patches, totals, x_cuts, y_cuts, grid_x, grid_y = pattern
    K, F = patches.shape
    M, N, G = x_cuts.shape[1] - 1, y_cuts.shape[1] - 1, grid_x.shape[0] - 1
    features, weights, bound = _split_words(H, posting_start, posting, F)
    V = np.zeros((G, G))
    common = np.zeros(totals.shape[1], np.int32)
    strips = np.zeros((N, G))
    for k in range(K):
        patch = patches[k]
        for e in range(features.shape[0]):
            common[patch[features[e]]] += weights[e]
        for u in bound:
            for e in range(posting_start[u], posting_start[u + 1]):
                p = patch[posting[e]]
                before = 0  # features of this word in this patch already counted: min(H, H_mnk) stops at H
                for other in range(posting_start[u], e):
                    before += patch[posting[other]] == p
                common[p] += before < H[u]
        # V += S x the pixels a patch shares with a cell (lines 11-13), first along x, then along y
        for n in range(N):
            strip = strips[n]
            empty = True
            for m in range(M):
                p = n * M + m
                if common[p]:
                    if empty:
                        strip[:] = 0.0
                        empty = False
                    S = common[p] / (H_size + totals[k, p] - common[p])
                    common[p] = 0
                    _spread(strip, S, x_cuts[k, m], x_cuts[k, m + 1], grid_x)
            if not empty:
                _stack(V, strip, y_cuts[k, n], y_cuts[k, n + 1], grid_y)
    return V


@numba.njit(cache=True, nogil=True)
def _split_words(H, posting_start, posting, F):
    """Features whose words H never limits, with how many such words they have; and the words that H may limit."""
    per_feature = np.zeros(F, np.int32)
    bound = np.empty(H.shape[0], np.int64)
    count = 0
    for u in range(H.shape[0]):
        if H[u] >= posting_start[u + 1] - posting_start[u]:
            for e in range(posting_start[u], posting_start[u + 1]):
                per_feature[posting[e]] += 1
        elif H[u] > 0:
            bound[count] = u
            count += 1
    features = np.flatnonzero(per_feature)
    return features, per_feature[features], bound[:count]


@numba.njit(cache=True, nogil=True)
def _spread(strip, S, x0, x1, grid_x):
    """strip += S x the pixels that [x0, x1) shares with each cell along x."""
    G = strip.shape[0]
    column = min(np.int64(x0) * G // grid_x[G], G - 1)  # cells are even to a pixel: the first is this one or beside
    while column > 0 and grid_x[column] > x0:
        column -= 1
    while grid_x[column + 1] <= x0:
        column += 1
    while column < G and grid_x[column] < x1:
        strip[column] += S * (min(x1, grid_x[column + 1]) - max(x0, grid_x[column]))
        column += 1


@numba.njit(cache=True, nogil=True)
def _stack(V, strip, y0, y1, grid_y):
    """V += strip x the pixels that [y0, y1) shares with each cell along y."""
    G = V.shape[0]
    for row in range(G):
        if grid_y[row] >= y1:
            break
        if grid_y[row + 1] > y0:
            tall = min(y1, grid_y[row + 1]) - max(y0, grid_y[row])
            for column in range(G):
                V[row, column] += strip[column] * tall


def box_shapes(grid: int, max_share: float, aspects: tuple[float, ...]) -> Int32s:
    """(A, 2) width and height in cells of the largest boxes of at most `max_share` of the image, one per aspect.

    The share is one cell at least.
    """
    area = int(grid * grid * max_share)
    shapes = []
    for aspect in aspects:
        width = min(max(int(math.sqrt(area * aspect) + 0.5), 1), grid, area)
        shapes.append((width, min(area // width, grid)))
    return np.array(sorted(set(shapes)), np.int32)


@numba.njit(cache=True, nogil=True)
def dominant_box(V, shapes):
    """(x0, y0, x1, y1) in cells of the box with the largest sum of votes, by the integral image; zeros without votes.

    Ties go to the first shape, then the topmost, then the leftmost box.
    """
    G = V.shape[0]
    total = np.zeros((G + 1, G + 1))
    for y in range(G):
        line = 0.0
        for x in range(G):
            line += V[y, x]
            total[y + 1, x + 1] = total[y, x + 1] + line
    best = 0.0
    box = np.zeros(4, np.uint8)
    # a box that is better by rounding alone is not better: the first one stays
    margin = 1e-9 * total[G, G]
    for s in range(shapes.shape[0]):
        w, h = shapes[s, 0], shapes[s, 1]
        for y in range(G - h + 1):
            for x in range(G - w + 1):
                votes = total[y + h, x + w] - total[y, x + w] - total[y + h, x] + total[y, x]
                if votes > best + margin:
                    best = votes
                    box[0], box[1], box[2], box[3] = x, y, x + w, y + h
    return box


def count_boxes(grid: int, shapes: Int32s) -> int:
    """Number of different boxes, the empty one too: the values of a box's bits."""
    return 1 + int(sum((grid - w + 1) * (grid - h + 1) for w, h in shapes))


def voting_map(cells: Floats, grid_x: Int32s, grid_y: Int32s) -> NDArray[np.float64]:
    """(G, G) mean of V over each cell, for pictures."""
    return cells / np.maximum(np.outer(np.diff(grid_y), np.diff(grid_x)), 1)
