"""Conics through which three distances are found: singular ones, the planes they are made of, the lines on those."""

from __future__ import annotations

import math

import numba
import numpy as np

_FLAT = 1e-12
"""Coefficients below this share of the others are zero but for rounding."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def common_lines(D, E, lines):
    """How many real lines x, written to `lines` (4, 3), two conics x^T D x = 0 and x^T E x = 0 share.

    One of the conics D + g E is singular: two planes, each of which cuts the others in two lines (Persson & Nordberg,
    Lambda Twist, ECCV 2018).
    """
    A = np.empty((3, 3))
    g = _root(_det(E), _mixed(E, D), _mixed(D, E), _det(D))
    for i in range(3):
        for j in range(3):
            A[i, j] = D[i, j] + g * E[i, j]
    count = 0
    planes, normals = _planes(A)
    for plane in range(planes):
        count += _lines_on(normals[plane], D, E, lines[count:])
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _lines_on(normal, D, E, lines):
    """How many lines of a plane, written to `lines`, lie on the conics that cut it in the same ones."""
    u, v = np.empty(3), np.empty(3)
    _across(normal, u, v)
    # either conic will do: the one that bends more
    a, b, c = _form(D, u, u), _form(D, u, v), _form(D, v, v)
    d, e, f = _form(E, u, u), _form(E, u, v), _form(E, v, v)
    if abs(d) + abs(e) + abs(f) > abs(a) + abs(b) + abs(c):
        a, b, c = d, e, f
    under = b * b - a * c
    if under < 0.0 or max(abs(a), abs(c)) <= _FLAT * abs(b):
        return 0
    root = math.sqrt(under)
    for n in range(2):
        # a x^2 + 2 b x y + c y^2 = 0 along x u + y v
        top = root - b if n else -root - b
        x, y = (top / a, 1.0) if abs(a) > abs(c) else (1.0, top / c)
        for i in range(3):
            lines[n, i] = x * u[i] + y * v[i]
    return 2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def set_conic(M, xx, yy, zz, xy, xz, yz):
    """Write the symmetric (3, 3) of xx x^2 + yy y^2 + zz z^2 + xy x y + xz x z + yz y z."""
    M[0, 0], M[1, 1], M[2, 2] = xx, yy, zz
    M[0, 1] = M[1, 0] = 0.5 * xy
    M[0, 2] = M[2, 0] = 0.5 * xz
    M[1, 2] = M[2, 1] = 0.5 * yz


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _det(M):
    return (
        M[0, 0] * (M[1, 1] * M[2, 2] - M[1, 2] * M[2, 1])
        - M[0, 1] * (M[1, 0] * M[2, 2] - M[1, 2] * M[2, 0])
        + M[0, 2] * (M[1, 0] * M[2, 1] - M[1, 1] * M[2, 0])
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _mixed(M, N):
    """trace(adj(M) N): the derivative of det(M + t N) by t at 0, both symmetric."""
    return (
        (M[1, 1] * M[2, 2] - M[1, 2] ** 2) * N[0, 0]
        + (M[0, 0] * M[2, 2] - M[0, 2] ** 2) * N[1, 1]
        + (M[0, 0] * M[1, 1] - M[0, 1] ** 2) * N[2, 2]
        + 2.0 * (M[0, 2] * M[1, 2] - M[0, 1] * M[2, 2]) * N[0, 1]
        + 2.0 * (M[0, 1] * M[1, 2] - M[0, 2] * M[1, 1]) * N[0, 2]
        + 2.0 * (M[0, 1] * M[0, 2] - M[0, 0] * M[1, 2]) * N[1, 2]
    )


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _root(a, b, c, d):
    """A real root of a x^3 + b x^2 + c x + d, the one furthest from the others."""
    if abs(a) < _FLAT * (abs(b) + abs(c) + abs(d)):
        if abs(b) < _FLAT * (abs(c) + abs(d)):
            return -d / c
        under = max(c * c - 4.0 * b * d, 0.0)
        q = -0.5 * (c + math.copysign(math.sqrt(under), c))
        return q / b if abs(q) > 0.0 else 0.0
    b, c, d = b / a, c / a, d / a
    third = b / 3.0
    p, q = c / 3.0 - third * third, third * third * third - 0.5 * third * c + 0.5 * d
    # y^3 + 3 p y + 2 q = 0 with x = y - third
    under = q * q + p * p * p
    if under >= 0.0:
        s = -math.copysign((abs(q) + math.sqrt(under)) ** (1.0 / 3.0), q)
        y = s - p / s if s != 0.0 else 0.0
    else:
        size = math.sqrt(-p)
        y = -math.copysign(2.0 * size * math.cos(math.acos(min(abs(q) / (size * size * size), 1.0)) / 3.0), q)
    x = y - third
    for _ in range(2):
        slope = (3.0 * x + 2.0 * b) * x + c
        if slope == 0.0:
            break
        x -= (((x + b) * x + c) * x + d) / slope
    return x


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _planes(A):
    """(n, normals (2, 3)): the planes through 0 on which x^T A x vanishes, A (3, 3) symmetric and singular."""
    normals = np.zeros((2, 3))
    trace = A[0, 0] + A[1, 1] + A[2, 2]
    minors = A[0, 0] * A[1, 1] - A[0, 1] ** 2 + A[0, 0] * A[2, 2] - A[0, 2] ** 2 + A[1, 1] * A[2, 2] - A[1, 2] ** 2
    # the eigenvalues beside 0; of one sign, no real plane
    if minors > 0.0:
        return 0, normals
    root = math.sqrt(0.25 * trace * trace - minors)
    high, low = 0.5 * trace + root, 0.5 * trace - root
    first, second = np.empty(3), np.empty(3)
    if not (_eigenvector(A, high, first) and _eigenvector(A, low, second)):
        return 0, normals
    up, down = math.sqrt(max(high, 0.0)), math.sqrt(max(-low, 0.0))
    for d in range(3):
        normals[0, d], normals[1, d] = up * first[d] + down * second[d], up * first[d] - down * second[d]
    return 2, normals


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _eigenvector(A, value, result):
    """Write the unit eigenvector: across two rows of A - value I. False where it is not one direction."""
    best = 0.0
    for i in range(3):
        j = (i + 1) % 3
        a0, a1, a2 = A[i, 0], A[i, 1], A[i, 2]
        b0, b1, b2 = A[j, 0], A[j, 1], A[j, 2]
        if i == 0:
            a0, b1 = a0 - value, b1 - value
        elif i == 1:
            a1, b2 = a1 - value, b2 - value
        else:
            a2, b0 = a2 - value, b0 - value
        x, y, z = a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0
        square = x * x + y * y + z * z
        if square > best:
            best = square
            result[0], result[1], result[2] = x, y, z
    if best == 0.0:
        return False
    length = math.sqrt(best)
    for d in range(3):
        result[d] /= length
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _across(normal, u, v):
    """Write two unit vectors across the normal and each other."""
    n0, n1, n2 = normal[0], normal[1], normal[2]
    length = math.sqrt(n0 * n0 + n1 * n1 + n2 * n2)
    n0, n1, n2 = n0 / length, n1 / length, n2 / length
    if abs(n0) < 0.6:
        u[0], u[1], u[2] = 0.0, n2, -n1
    else:
        u[0], u[1], u[2] = -n2, 0.0, n0
    size = math.sqrt(u[0] ** 2 + u[1] ** 2 + u[2] ** 2)
    for d in range(3):
        u[d] /= size
    v[0], v[1], v[2] = n1 * u[2] - n2 * u[1], n2 * u[0] - n0 * u[2], n0 * u[1] - n1 * u[0]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _form(M, u, v):
    result = 0.0
    for i in range(3):
        for j in range(3):
            result += u[i] * M[i, j] * v[j]
    return result
