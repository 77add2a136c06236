"""Common pattern discovery by randomized visual phrases: Algorithm 3 of Tanaka et al. 2014.

The voting map of a window is needed only through sums over boxes, and boxes lie on a grid of G x G cells, so the
kernel keeps the sum of V over each cell: a patch adds its similarity times the pixels it shares with the cell.
That is the per-pixel algorithm exactly, without touching pixels.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numba
import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vplog.data import Floats, Int32s


@dataclass(frozen=True, eq=False)
class Partitions:
    """K random partitions of one reference image into M columns x N rows."""

    x_cuts: Int32s
    """(K, M + 1) px, from 0 to the width."""
    y_cuts: Int32s
    """(K, N + 1) px, from 0 to the height."""


def draw_partitions(width: int, height: int, K: int, M: int, N: int, rng: np.random.Generator) -> Partitions:
    """K independent partitions, cuts uniform over the pixel borders (Alg. 3 line 6)."""

    def cuts(length: int, parts: int) -> Int32s:
        inner = np.sort(rng.integers(0, length + 1, (K, parts - 1)), axis=1)
        ends = np.zeros((K, 1), np.int64), np.full((K, 1), length)
        return np.concatenate([ends[0], inner, ends[1]], axis=1).astype(np.int32)

    return Partitions(cuts(width, M), cuts(height, N))


def grid_cuts(length: int, cells: int) -> Int32s:
    """(cells + 1,) px: the borders of the grid's cells along one side."""
    return ((np.arange(cells + 1) * length + cells // 2) // cells).astype(np.int32)


@numba.njit(cache=True, nogil=True)
def patches_of(points, x_cuts, y_cuts):
    """(K, F) uint16: the patch m * N + n each point falls in. Points lie inside the image."""
    K, F = x_cuts.shape[0], points.shape[0]
    M, N = x_cuts.shape[1] - 1, y_cuts.shape[1] - 1
    result = np.empty((K, F), np.uint16)
    for k in range(K):
        for f in range(F):
            x, y = int(points[f, 0] + 0.5), int(points[f, 1] + 0.5)  # the pixel the point is in
            m = min(np.searchsorted(x_cuts[k], x, side="right") - 1, M - 1)
            n = min(np.searchsorted(y_cuts[k], y, side="right") - 1, N - 1)
            result[k, f] = m * N + n
    return result


@numba.njit(cache=True, nogil=True)
def patch_totals(patches, words_per_feature, count):
    """(K, count) int32: how many words the features of each patch have (the size of H_mnk)."""
    K, F = patches.shape
    result = np.zeros((K, count), np.int32)
    for k in range(K):
        for f in range(F):
            result[k, patches[k, f]] += words_per_feature[f]
    return result


@numba.njit(cache=True, nogil=True)
def vote(H, H_size, posting_start, posting, patches, totals, x_cuts, y_cuts, grid_x, grid_y):
    """Sum of the voting map V over each cell of the grid (Alg. 3 lines 1-16): (G, G) float64, rows are y.

    H (U,) int32 counts of the reference's words in the window, `H_size` the count of all its words, known here or
    not. Features with the reference's word u are posting[posting_start[u]:posting_start[u + 1]].
    The similarity is normalised histogram intersection, sum(min) / sum(max) (Jiang, Meng, Yuan, CVPR 2012).
    """
    K = patches.shape[0]
    N = y_cuts.shape[1] - 1
    G = grid_x.shape[0] - 1
    V = np.zeros((G, G))
    common = np.zeros(totals.shape[1], np.int32)
    touched = np.empty(totals.shape[1], np.int32)
    for k in range(K):
        count = 0
        for u in range(H.shape[0]):
            if H[u] == 0:
                continue
            for e in range(posting_start[u], posting_start[u + 1]):
                p = patches[k, posting[e]]
                before = 0  # features of this word in this patch already counted: min(H, H_mnk) stops at H
                for other in range(posting_start[u], e):
                    if patches[k, posting[other]] == p:
                        before += 1
                if before < H[u]:
                    if common[p] == 0:
                        touched[count] = p
                        count += 1
                    common[p] += 1
        for t in range(count):
            p = touched[t]
            S = common[p] / (H_size + totals[k, p] - common[p])
            common[p] = 0
            m, n = p // N, p % N
            _add_patch(V, S, x_cuts[k, m], x_cuts[k, m + 1], y_cuts[k, n], y_cuts[k, n + 1], grid_x, grid_y)
    return V


@numba.njit(cache=True, nogil=True)
def _add_patch(V, S, x0, x1, y0, y1, grid_x, grid_y):
    """V += S x the pixels that the patch [x0, x1) x [y0, y1) shares with each cell (Alg. 3 lines 11-13)."""
    G = V.shape[0]
    first_x = np.searchsorted(grid_x, x0, side="right") - 1
    row = np.searchsorted(grid_y, y0, side="right") - 1
    while row < G and grid_y[row] < y1:
        tall = min(y1, grid_y[row + 1]) - max(y0, grid_y[row])
        column = first_x
        while column < G and grid_x[column] < x1:
            wide = min(x1, grid_x[column + 1]) - max(x0, grid_x[column])
            V[row, column] += S * (wide * tall)
            column += 1
        row += 1


def box_shapes(grid: int, max_share: float, aspects: tuple[float, ...]) -> Int32s:
    """(A, 2) width and height in cells of the largest boxes of at most `max_share` of the image, one per aspect."""
    area = int(grid * grid * max_share)
    shapes = []
    for aspect in aspects:
        width = min(max(int(math.sqrt(area * aspect) + 0.5), 1), grid)
        height = min(area // width, grid)
        shapes.append((width, max(height, 1)))
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
    """How many different boxes there are to choose from, the empty one too: what a box's bits have to tell apart."""
    return 1 + int(sum((grid - w + 1) * (grid - h + 1) for w, h in shapes))


def voting_map(cells: Floats, grid_x: Int32s, grid_y: Int32s) -> NDArray[np.float64]:
    """(G, G) mean of V over each cell, for pictures."""
    return cells / np.maximum(np.outer(np.diff(grid_y), np.diff(grid_x)), 1)
