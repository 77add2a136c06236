"""Patches of an image's thumbnail at even steps, described by the directions of their edges.

Dense patches need no detector, which fires elsewhere in other light (Torii et al., 24/7 place recognition by view
synthesis, CVPR 2015). A patch is 4 x 4 cells of 8 directions, as SIFT's (Lowe 2004), upright; an edge and its negative
have one direction (Dalal & Triggs, CVPR 2005).
"""

from __future__ import annotations

import numba
import numpy as np

from vplog.data import Bytes, Float32s
from vplog.places.vocabulary import ROOT_STEPS

CELL = 8
"""px of the thumbnail along a cell; a patch is then a quarter of the image along each side."""
CELLS = 4
"""Along a patch; it moves by one cell, so patches overlap by three quarters."""
DIRECTIONS = 8
"""Directions of edges, over half a turn: 4 x 4 x 8 = 128 values, as SIFT."""
_MOST = 0.2
"""Values of unit length are cut here, Lowe's way to keep a single strong edge from ruling."""


def describe_patches(thumbnail: Bytes) -> tuple[Float32s, Float32s]:
    """Descriptors (P, 128) float32, whole numbers 0..255, and (P, 2) middles as shares of the image's sides.

    `thumbnail` is the grey image (S, S) uint8. Patches without any edge are left out.
    """
    values, points = _describe(_edges(np.sqrt(np.arange(256.0))[thumbnail], CELL, DIRECTIONS), CELLS, _MOST)
    used = values.any(axis=1)
    return np.minimum(np.rint(np.sqrt(values[used]) * ROOT_STEPS), 255.0).astype(np.float32), points[used]


@numba.njit(cache=True, nogil=True)
def _edges(image, cell, directions):
    """(n, n, directions) strength of the edges in cells of (S, S) light, whose root makes a shadow's edges fainter.

    Each pixel counts to its two nearest directions and four nearest cells, more where it is nearer.
    """
    S = image.shape[0]
    n = S // cell
    result = np.zeros((n, n, directions))
    for y in range(S):
        above, below = abs(y - 1), S - 1 - abs(S - 2 - y)
        v = (y + 0.5) / cell - 0.5
        row = int(np.floor(v))
        for x in range(S):
            left, right = abs(x - 1), S - 1 - abs(S - 2 - x)
            falling, rising = image[below, right] - image[above, left], image[above, right] - image[below, left]
            gx = falling + rising + 2.0 * (image[y, right] - image[y, left])  # Sobel's; exactly 0 where all is even
            gy = falling - rising + 2.0 * (image[below, x] - image[above, x])
            strength = np.sqrt(gx * gx + gy * gy)
            if strength == 0.0:
                continue
            turn = (np.arctan2(gy, gx) / np.pi % 1.0) * directions
            first = int(turn)
            part = turn - first
            u = (x + 0.5) / cell - 0.5
            column = int(np.floor(u))
            for r in range(2):
                if not 0 <= row + r < n:
                    continue
                along_y = (v - row if r else 1.0 - (v - row)) * strength
                for c in range(2):
                    if 0 <= column + c < n:
                        share = along_y * (u - column if c else 1.0 - (u - column))
                        result[row + r, column + c, first % directions] += share * (1.0 - part)
                        result[row + r, column + c, (first + 1) % directions] += share * part
    return result


@numba.njit(cache=True, nogil=True)
def _describe(edges, cells, most):
    """(P, cells^2 * directions) of unit sum, 0 without an edge, and middles (P, 2) float32."""
    n, directions = edges.shape[0], edges.shape[2]
    along = n - cells + 1
    values = np.zeros((along * along, cells * cells * directions))
    points = np.empty((along * along, 2), np.float32)
    for i in range(along):
        for j in range(along):
            value = values[i * along + j]
            points[i * along + j, 0], points[i * along + j, 1] = (j + 0.5 * cells) / n, (i + 0.5 * cells) / n
            at, length = 0, 0.0
            for r in range(cells):
                for c in range(cells):
                    for d in range(directions):
                        value[at] = edges[i + r, j + c, d]
                        length += value[at] ** 2
                        at += 1
            if length == 0.0:
                continue
            total = 0.0
            for at in range(value.shape[0]):
                value[at] = min(value[at] / np.sqrt(length), most)
                total += value[at]
            for at in range(value.shape[0]):
                value[at] /= total
    return values, points
