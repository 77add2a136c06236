"""Inverse of small symmetric matrices, for compiled loops."""

from __future__ import annotations

import numba


@numba.njit(cache=True, nogil=True, error_model="numpy")
def invert(matrix, size, result):
    """Write the inverse of the symmetric upper left `size` x `size`, 2 or 3."""
    a, b, d = matrix[0, 0], matrix[0, 1], matrix[1, 1]
    if size == 2:
        determinant = a * d - b * b
        result[0, 0], result[1, 1] = d / determinant, a / determinant
        result[0, 1] = result[1, 0] = -b / determinant
        return
    c, e, f = matrix[0, 2], matrix[1, 2], matrix[2, 2]
    xx, xy, xz = d * f - e * e, c * e - b * f, b * e - c * d
    determinant = a * xx + b * xy + c * xz
    result[0, 0], result[1, 1], result[2, 2] = (
        xx / determinant,
        (a * f - c * c) / determinant,
        (a * d - b * b) / determinant,
    )
    result[0, 1] = result[1, 0] = xy / determinant
    result[0, 2] = result[2, 0] = xz / determinant
    result[1, 2] = result[2, 1] = (b * c - a * e) / determinant
