"""Compiled loops over the supernodes of a block Cholesky factor R^T R = A.

`values` contains one dense panel per supernode, one after the other: its rows of R, (k, k + m) scalars, for its k
columns and the m rows below them. Only the upper triangle of the first k columns is used.

Arrays are copied and filled by loops and not by slices, for which Numba compiles checks and messages for seconds.
"""

from __future__ import annotations

from typing import Any, NamedTuple

import numba
import numpy as np

from vplog.data import Bools, Floats, Ints


class Panels(NamedTuple):
    """Shape of a factor in blocks: S supernodes, each a run of columns with equal structure."""

    first: Ints
    """(S + 1,) first column of each supernode, in elimination order."""
    start: Ints
    """(S + 1,) where the rows of each supernode begin in `rows`."""
    rows: Ints
    """Rows below the columns of each supernode that are not zero, increasing."""
    begin: Ints
    """(S + 1,) where the panel of each supernode begins, in blocks."""
    node: Ints
    """(n,) supernode of each column."""
    longest: int
    """Largest number of columns and rows below them of a supernode."""


_AT_ONCE = 8
"""Rows subtracted from a line in one loop: a processor has as many registers for their addresses."""
_SQUARE = 16
"""Rows and columns of the squares in which a matrix is mirrored: two cache lines each."""

_compiled = numba.njit(cache=True, nogil=True, error_model="numpy", fastmath={"contract", "reassoc"})


@_compiled
def _subtract(line: Floats, left: int, right: int, panel: Floats, low: int, high: int, factor: Floats) -> None:
    """Subtract rows low:high of a panel, each times its factor, from `line` in columns left:right.

    Eight rows at once need one load and one store of the line.
    """
    paired = high - (high - low) % _AT_ONCE
    for k in range(low, paired, _AT_ONCE):
        f0, f1, f2, f3, f4, f5, f6, f7 = (
            factor[k], factor[k + 1], factor[k + 2], factor[k + 3],
            factor[k + 4], factor[k + 5], factor[k + 6], factor[k + 7],
        )  # fmt: skip
        r0, r1, r2, r3, r4, r5, r6, r7 = (
            panel[k], panel[k + 1], panel[k + 2], panel[k + 3], panel[k + 4], panel[k + 5], panel[k + 6], panel[k + 7]
        )  # fmt: skip
        for j in range(left, right):
            line[j] -= (
                f0 * r0[j] + f1 * r1[j] + f2 * r2[j] + f3 * r3[j] + f4 * r4[j] + f5 * r5[j] + f6 * r6[j] + f7 * r7[j]
            )
    for k in range(paired, high):
        f0, r0 = factor[k], panel[k]
        for j in range(left, right):
            line[j] -= f0 * r0[j]


@_compiled
def _dot(a: Floats, b: Floats, begin: int, end: int) -> float:
    total = 0.0
    for j in range(begin, end):
        total += a[j] * b[j]
    return total


@_compiled
def _panel(panels: Panels, node: int, size: int, values: Floats) -> Floats:
    """Return the panel (k, k + m) of a supernode, a view of `values`."""
    width = (panels.first[node + 1] - panels.first[node]) * size
    length = width + (panels.start[node + 1] - panels.start[node]) * size
    begin = panels.begin[node] * size * size
    return values[begin : begin + width * length].reshape(width, length)


@_compiled
def _ancestor(panels: Panels, node: int, size: int, at: int, column: Ints) -> tuple[int, int]:
    """Return the supernode that contains rows[at], a row of `node`, and the end of the rows that it contains.

    Write to `column` where each scalar row from rows[at] on is in the panel of that supernode.
    """
    first, start, rows = panels.first, panels.start, panels.rows
    target = panels.node[rows[at]]
    end, along = at, start[target]
    for k in range(at, start[node + 1]):
        if rows[k] < first[target + 1]:
            block = rows[k] - first[target]
            end = k + 1
        else:
            while rows[along] != rows[k]:
                along += 1
            block = first[target + 1] - first[target] + along - start[target]
        for i in range(size):
            column[(k - start[node]) * size + i] = block * size + i
    return target, end


@_compiled
def factorise(panels: Panels, size: int, values: Floats) -> bool:
    """Replace a matrix in `values` by its factor; return False if the matrix is not positive definite.

    Right-looking: each supernode is eliminated, and its outer product is subtracted from its ancestors' panels.
    """
    zero: Any = np.int64(0)  # Numba compiles _subtract once more for a literal 0
    start, longest = panels.start, panels.longest * size
    factor, line, column = np.empty(longest), np.empty(longest), np.empty(longest, np.int64)
    for node in range(len(start) - 1):
        panel = _panel(panels, node, size, values)
        width, length = panel.shape
        for i in range(width):
            for k in range(i):
                factor[k] = panel[k, i]
            _subtract(panel[i], i, length, panel, zero, i, factor)
            if not panel[i, i] > 0.0:  # NaN too
                return False
            scale = 1.0 / np.sqrt(panel[i, i])
            for j in range(i, length):
                panel[i, j] *= scale
        at = start[node]
        while at < start[node + 1]:
            target, end = _ancestor(panels, node, size, at, column)
            above = _panel(panels, target, size, values)
            for own in range((at - start[node]) * size, (end - start[node]) * size):
                for k in range(width):
                    factor[k] = panel[k, width + own]
                for j in range(width + own, length):
                    line[j] = 0.0
                _subtract(line, width + own, length, panel, zero, width, factor)
                into = above[column[own]]
                for j in range(own, length - width):
                    into[column[j]] += line[width + j]
            at = end
    return True


@_compiled
def substitute(panels: Panels, size: int, values: Floats, right: Floats, forward: bool) -> None:
    """Replace each row of `right` (c, n d) by R^-T times the row if `forward`, else by R^-1 times the row.

    Supernodes at which a row is zero cost nothing forward.
    """
    first, start, rows = panels.first, panels.start, panels.rows
    line, where = np.empty(panels.longest * size), np.empty(panels.longest * size, np.int64)
    for at in range(len(start) - 1):
        node = at if forward else len(start) - 2 - at
        panel = _panel(panels, node, size, values)
        width, length = panel.shape
        for j in range(length):
            block = j // size
            row = first[node] + block if j < width else rows[start[node] + block - width // size]
            where[j] = row * size + j % size
        for x in right:
            zero = True
            for j in range(length):
                line[j] = x[where[j]] if j < width or not forward else 0.0
                zero = zero and line[j] == 0.0
            if zero:
                continue
            if forward:
                for k in range(width):
                    line[k] /= panel[k, k]
                    scale = line[k]
                    for j in range(k + 1, length):
                        line[j] -= scale * panel[k, j]
                for j in range(width, length):
                    x[where[j]] += line[j]
            else:
                for k in range(width - 1, -1, -1):
                    line[k] = (line[k] - _dot(panel[k], line, k + 1, length)) / panel[k, k]
            for j in range(width):
                x[where[j]] = line[j]


@_compiled
def invert(  # noqa: PLR0912 (one loop nest, compiled)
    panels: Panels, size: int, values: Floats, needed: Bools, inverse: Floats
) -> None:
    """Write the inverse Z of R^T R at the nonzeros of R into `inverse`, for supernodes that are needed and ancestors.

    Takahashi, Fagan and Chen 1973: Z_cb = -G Z_bb with G = R_cc^-1 R_cb, for the columns c of a supernode and the rows
    b below them. All blocks of Z_bb are in the panels of its ancestors.
    """
    zero: Any = np.int64(0)  # as in factorise
    start, longest = panels.start, panels.longest * size
    for node in range(len(needed)):
        if needed[node] and start[node] < start[node + 1]:
            needed[panels.node[panels.rows[start[node]]]] = True
    column = np.empty(longest, np.int64)
    room, room_of_G = np.empty(longest * longest), np.empty(longest * longest)
    for node in range(len(needed) - 1, -1, -1):
        if not needed[node]:
            continue
        panel, own = _panel(panels, node, size, values), _panel(panels, node, size, inverse)
        width, length = panel.shape
        below = length - width
        # Z_bb has the columns of the panel
        Z_bb, G = room[: below * length].reshape(below, length), room_of_G[: width * below].reshape(width, below)
        at = start[node]
        while at < start[node + 1]:
            target, end = _ancestor(panels, node, size, at, column)
            above = _panel(panels, target, size, inverse)
            for i in range((at - start[node]) * size, (end - start[node]) * size):
                source, into = above[column[i]], Z_bb[i]
                for j in range(i, below):
                    into[width + j] = source[column[j]]
            at = end
        for row in range(0, below, _SQUARE):  # neighbours in a column are far apart in memory
            for begin in range(row, below, _SQUARE):
                for i in range(row, min(row + _SQUARE, below)):
                    for j in range(max(begin, i), min(begin + _SQUARE, below)):
                        Z_bb[j, width + i] = Z_bb[i, width + j]
        for k in range(width - 1, -1, -1):
            for j in range(below):
                G[k, j] = panel[k, width + j]
                own[k, width + j] = 0.0
            _subtract(G[k], zero, below, G, k + 1, width, panel[k])
            for j in range(below):
                G[k, j] /= panel[k, k]
        for row in range(0, below, _AT_ONCE):  # these rows stay in the L1 cache
            for k in range(width):
                _subtract(own[k], width, length, Z_bb, row, min(row + _AT_ONCE, below), G[k])
        for k in range(width - 1, -1, -1):
            for j in range(width - 1, k, -1):
                own[k, j] = own[j, k] = -_dot(panel[k], own[j], k + 1, length) / panel[k, k]
            own[k, k] = (1.0 / panel[k, k] - _dot(panel[k], own[k], k + 1, length)) / panel[k, k]


@_compiled
def add_blocks(values: Floats, begin: Ints, step: Ints, turned: Bools, blocks: Floats) -> None:
    """Add blocks (K, d, d), transposed if `turned` (K,), to the lines that are `step` (K,) apart from `begin` (K,) on.

    Blocks with a negative `begin` are left out.
    """
    size = blocks.shape[1]
    for k in range(len(begin)):
        if begin[k] >= 0:
            for i in range(size):
                for j in range(size):
                    values[begin[k] + i * step[k] + j] += blocks[k, j, i] if turned[k] else blocks[k, i, j]
