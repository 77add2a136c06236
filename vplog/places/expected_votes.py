"""Common pattern discovery in closed form: what Algorithm 3 of Tanaka et al. 2014 gives on average.

M - 1 random cuts of a side of length 1 leave two points dx apart in one of the M patches with the probability
(1 - dx)^(M - 1), so the average over partitions votes (1 - |dx|)^(M - 1) (1 - |dy|)^(N - 1) around every match. Votes
are summed over a coarse grid, by one matrix of kernel and box for each side.
"""

from __future__ import annotations

import numba
import numpy as np

from vplog.data import Bytes, Floats


def box_sums(cells: int, patches: int, box: int) -> Floats:
    """(P, cells): votes that a match in a cell gives to each of the P = cells - box + 1 boxes along one side."""
    middle = (np.arange(cells) + 0.5) / cells
    kernel = (1.0 - np.abs(middle[:, None] - middle)) ** (patches - 1)
    inside = np.tri(cells - box + 1, cells, box - 1) - np.tri(cells - box + 1, cells, -1)
    return inside @ kernel


def even_windows(along: int, share: float) -> Floats:
    """(along^2, 4) x0 y0 x1 y1 of windows at even steps, rows first, each `share` of the image's sides."""
    corner = np.linspace(0.0, 1.0 - share, along) if along > 1 else np.array([(1.0 - share) / 2])
    return np.array([[x, y, x + share, y + share] for y in corner for x in corner])


@numba.njit(cache=True, nogil=True)
def agreement(here, there, weight, reach, floor):
    """(E,) float32 weights of one image pair's matches, those that move as others do counting most.

    1 - exp(-s) of the weight s of all other matches within about `reach` (share of the image) of the same displacement;
    `floor` of the weight is kept in any case.
    """
    E = weight.shape[0]
    moved, others = there - here, np.zeros(E)
    scale = 1.0 / (2.0 * reach * reach)
    for a in range(E):
        for b in range(a + 1, E):
            dx, dy = moved[a, 0] - moved[b, 0], moved[a, 1] - moved[b, 1]
            q = (dx * dx + dy * dy) * scale
            if q < 8.0:  # exp(-8) = 3e-4: nothing beyond
                agrees = np.exp(-q)
                others[a] += weight[b] * agrees
                others[b] += weight[a] * agrees
    return (weight * (floor + (1.0 - floor) * (1.0 - np.exp(-others)))).astype(np.float32)


@numba.njit(cache=True, nogil=True)
def vote(here, there, weight, window, columns, rows):
    """(rows, columns) weight of the matches from inside a window of the image, by the reference's cell they fall in."""
    V = np.zeros((rows, columns))
    for e in range(weight.shape[0]):
        x, y = here[e, 0], here[e, 1]
        if window[0] <= x <= window[2] and window[1] <= y <= window[3]:
            column = min(max(int(there[e, 0] * columns), 0), columns - 1)
            row = min(max(int(there[e, 1] * rows), 0), rows - 1)
            V[row, column] += weight[e]
    return V


@numba.njit(cache=True, nogil=True)
def votes_of_boxes(V, along_y, along_x):
    """(P_y, P_x) votes inside each box: along_y @ V @ along_x.T, without a BLAS whose sums depend on the machine."""
    rows, columns = V.shape
    strips = np.zeros((along_y.shape[0], columns))
    for p in range(along_y.shape[0]):
        for row in range(rows):
            for column in range(columns):
                strips[p, column] += along_y[p, row] * V[row, column]
    result = np.zeros((along_y.shape[0], along_x.shape[0]))
    for p in range(along_y.shape[0]):
        for q in range(along_x.shape[0]):
            s = 0.0
            for column in range(columns):
                s += strips[p, column] * along_x[q, column]
            result[p, q] = s
    return result


@numba.njit(cache=True, nogil=True)
def best_boxes(here, there, weight, windows, along_y, along_x, none):
    """(I,) uint8 number of the box with most votes for each window, rows first; `none` without a vote."""
    rows, columns = along_y.shape[1], along_x.shape[1]
    result = np.full(windows.shape[0], none, np.uint8)
    for i in range(windows.shape[0]):
        V = vote(here, there, weight, windows[i], columns, rows)
        if V.sum() > 0.0:
            result[i] = np.argmax(votes_of_boxes(V, along_y, along_x))
    return result


def overlaps(positions: tuple[int, int], width: int, height: int) -> Bytes:
    """(256, 256) uint8 cells that two boxes of width x height cells share, by their numbers; nothing for numbers that
    are no box."""
    x, y = map(np.arange, positions)
    along_x = np.maximum(width - np.abs(x[:, None] - x), 0)
    along_y = np.maximum(height - np.abs(y[:, None] - y), 0)
    count = len(x) * len(y)
    table = np.zeros((256, 256), np.uint8)
    table[:count, :count] = np.einsum("ab,cd->acbd", along_y, along_x).reshape(count, count)
    return table
