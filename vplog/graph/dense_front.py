"""Elimination of the first rows of one dense symmetric matrix, without a BLAS."""

from __future__ import annotations

import numba
import numpy as np

from vplog.data import Floats

AT_ONCE = 8
"""Rows subtracted from another in one loop: as many as a processor has registers for their pointers."""
STRIP = 512
"""Columns of a front per block: eight rows of them, 32 kB, stay in the L1 cache."""
_PANEL = 8 * AT_ONCE
"""Rows eliminated before the rest is updated: a strip of them, 256 kB, stays in the L2 cache."""


@numba.njit(cache=True, nogil=True)
def eliminate_front(front: Floats, eliminated: int) -> bool:
    """R in the first rows of a front (f, f) of which the upper triangle is given, what is left of it in the others.

    False where these rows are not positive definite.
    """
    length = len(front)
    scale = np.empty(_PANEL)
    for begun in range(0, eliminated, _PANEL):
        end = min(begun + _PANEL, eliminated)
        if not _panel(front, begun, end, scale, begun, length):
            return False
        _subtract_panel(front, begun, end, end, length)
    return True


@numba.njit(cache=True, nogil=True)
def _panel(front: Floats, begun: int, end: int, scale: Floats, low: int, high: int) -> bool:
    """Rows begun:end of R in columns low:high. Columns from `begun` on come first: their pivots scale the rest."""
    share = np.empty(AT_ONCE)
    for left in range(low, high, STRIP):
        right = min(left + STRIP, high)
        for first in range(begun, end, AT_ONCE):
            last = min(first + AT_ONCE, end)
            for k in range(first, last):
                line = front[k]
                if left == begun:
                    if not line[k] > 0.0:  # NaN too
                        return False
                    scale[k - begun] = 1.0 / np.sqrt(line[k])
                inverse = scale[k - begun]
                for j in range(max(k, left), right):
                    line[j] *= inverse
                for i in range(k + 1, last):
                    target, times = front[i], line[i]
                    for j in range(max(i, left), right):
                        target[j] -= times * line[j]
            for i in range(last, end):
                for k in range(first, last):
                    share[k - first] = front[k, i]
                subtract_scaled(front, i, front, first, last, share, max(i, left), right)
    return True


@numba.njit(cache=True, nogil=True)
def _subtract_panel(front: Floats, begun: int, end: int, low: int, high: int) -> None:
    """Subtract the outer products of the complete rows begun:end of R from rows low:high."""
    length = len(front)
    share = np.empty(AT_ONCE)
    for left in range(low, length, STRIP):
        right = min(left + STRIP, length)
        for i in range(low, min(high, right)):
            for first in range(begun, end, AT_ONCE):
                last = min(first + AT_ONCE, end)
                for k in range(first, last):
                    share[k - first] = front[k, i]
                subtract_scaled(front, i, front, first, last, share, max(i, left), right)


@numba.njit(cache=True, nogil=True, fastmath={"contract"})
def subtract_scaled(
    target: Floats, row: int, rows: Floats, low: int, high: int, share: Floats, left: int, right: int
) -> None:
    """target[row] less the sum of rows[low:high], up to eight, each times its share, in columns left:right."""
    line = target[row, left:right]
    if high - low == AT_ONCE:
        r0, r1, r2, r3 = (
            rows[low, left:right], rows[low + 1, left:right], rows[low + 2, left:right], rows[low + 3, left:right]
        )  # fmt: skip
        r4, r5, r6, r7 = (
            rows[low + 4, left:right], rows[low + 5, left:right], rows[low + 6, left:right], rows[low + 7, left:right]
        )  # fmt: skip
        s0, s1, s2, s3, s4, s5, s6, s7 = (
            share[0], share[1], share[2], share[3], share[4], share[5], share[6], share[7]
        )  # fmt: skip
        for j in range(len(line)):
            line[j] -= (
                s0 * r0[j] + s1 * r1[j] + s2 * r2[j] + s3 * r3[j] + s4 * r4[j] + s5 * r5[j] + s6 * r6[j] + s7 * r7[j]
            )
        return
    for k in range(low, high):
        one, times = rows[k, left:right], share[k - low]
        for j in range(len(line)):
            line[j] -= times * one[j]
