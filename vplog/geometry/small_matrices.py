"""Products and inverses of small matrices, for compiled loops."""

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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def product(a, b, times, result):
    """Write times a b."""
    for i in range(a.shape[0]):
        for j in range(b.shape[1]):
            result[i, j] = 0.0
            for k in range(a.shape[1]):
                result[i, j] += times * a[i, k] * b[k, j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_inner(result, row, column, a, b):
    """Add a^T b to the block of the result that begins at `row` and `column`."""
    for k in range(a.shape[0]):
        for i in range(a.shape[1]):
            for j in range(b.shape[1]):
                result[row + i, column + j] += a[k, i] * b[k, j]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def add_moved(result, row, a, vector):
    """Add a^T vector to the part of the result that begins at `row`."""
    for k in range(a.shape[0]):
        for i in range(a.shape[1]):
            result[row + i] += a[k, i] * vector[k]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def subtract_outer(result, row, column, a, b):
    """Subtract a b^T, of three columns each, from the block of the result that begins at `row` and `column`."""
    for i in range(a.shape[0]):
        x, y, z = a[i, 0], a[i, 1], a[i, 2]
        if x == y == z == 0.0:
            continue
        for j in range(b.shape[0]):
            result[row + i, column + j] -= x * b[j, 0] + y * b[j, 1] + z * b[j, 2]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def subtract_moved(result, row, a, vector):
    """Subtract a vector from the part of the result that begins at `row`."""
    for i in range(a.shape[0]):
        for k in range(a.shape[1]):
            result[row + i] -= a[i, k] * vector[k]
