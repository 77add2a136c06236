"""Algorithm 3 of Tanaka et al. 2014 line by line, pixel by pixel: what the fast kernel must agree with."""

from __future__ import annotations

from collections import Counter
from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

import numpy as np

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vplog.data import Floats, Int32s


@dataclass(frozen=True)
class Picture:
    """A reference image as the algorithm sees it."""

    width: int
    height: int
    pixels: list[tuple[int, int]]
    """Column and row of the pixel each feature is in."""
    words: list[list[int]]
    """Words of each feature."""


def similarity(H: Counter[int], H_mnk: Counter[int]) -> float:
    """Normalised histogram intersection over the whole vocabulary."""
    words = set(H) | set(H_mnk)
    largest = sum(max(H[word], H_mnk[word]) for word in words)
    return sum(min(H[word], H_mnk[word]) for word in words) / largest if largest else 0.0


def voting_image(H: Counter[int], picture: Picture, x_cuts: Int32s, y_cuts: Int32s) -> Floats:
    """(height, width) V, lines 1 to 16."""
    V = np.zeros((picture.height, picture.width))
    for xs, ys in zip(x_cuts, y_cuts, strict=True):
        for x0, x1 in pairwise(xs):
            for y0, y1 in pairwise(ys):
                H_mnk: Counter[int] = Counter()
                for (x, y), words in zip(picture.pixels, picture.words, strict=True):
                    if x0 <= x < x1 and y0 <= y < y1:
                        H_mnk.update(words)
                V[y0:y1, x0:x1] += similarity(H, H_mnk)
    return V


def cell_sums(V: Floats, grid_x: Int32s, grid_y: Int32s) -> Floats:
    """(G, G) sums of V's pixels over the grid's cells."""
    G = len(grid_x) - 1
    return np.array(
        [[V[grid_y[r] : grid_y[r + 1], grid_x[c] : grid_x[c + 1]].sum() for c in range(G)] for r in range(G)]
    )


def box_sum(V: Floats, grid_x: Int32s, grid_y: Int32s, box: NDArray[np.uint8]) -> float:
    x0, y0, x1, y1 = box
    return float(V[grid_y[y0] : grid_y[y1], grid_x[x0] : grid_x[x1]].sum())


def all_boxes(grid: int, shapes: Int32s) -> set[tuple[int, int, int, int]]:
    """Every box of these widths and heights in cells that lies on the grid."""
    sides = {(int(w), int(h)) for w, h in shapes}
    return {
        (x0, y0, x1, y1)
        for x0 in range(grid)
        for y0 in range(grid)
        for x1 in range(x0 + 1, grid + 1)
        for y1 in range(y0 + 1, grid + 1)
        if (x1 - x0, y1 - y0) in sides
    }


def dominant_sum(V: Floats, grid_x: Int32s, grid_y: Int32s, shapes: Int32s) -> float:
    """The largest sum of V over any of the boxes."""
    boxes = all_boxes(len(grid_x) - 1, shapes)
    return max(box_sum(V, grid_x, grid_y, np.array(box, np.uint8)) for box in boxes)
