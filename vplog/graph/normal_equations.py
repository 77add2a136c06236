"""The normal equations of a pose graph at some poses, edge by edge in compiled loops."""

from __future__ import annotations

from collections.abc import Callable
from math import atan2, cos, sin, sqrt
from typing import NamedTuple

import numba
import numpy as np

from vplog.data import Floats, Int32s, Ints, PoseGraph
from vplog.graph.sparse.cholesky import Blocks
from vplog.graph.workers import Workers

Terms = Callable[[Ints, int, int, "_Edges", Floats, "_Sums"], None]


_LEAST_SHARE = 4096
"""Poses or edges that a thread takes at least, some milliseconds."""
_BY_THREAD = 4
"""Shares for each thread, so that a slow one delays the others little."""


class _Edges(NamedTuple):
    """The edges of a graph for compiled loops."""

    a: Int32s
    b: Int32s
    measured: Floats
    """(E, 4, 4)."""
    information: Floats
    """(E, d, d)."""
    weight: Floats


class _Sums(NamedTuple):
    """Sums over the edges, zero at first."""

    cost: Floats
    """(E,) half the chi-square."""
    diagonal: Floats
    """(n, d, d), or empty where only costs are computed, as are those below."""
    other: Floats
    """(E, d, d)."""
    gradient: Floats
    """(n, d)."""


def normal_equations(graph: PoseGraph, weight: Floats, poses: Floats) -> tuple[Blocks, Floats, float]:
    """Half the second and the first derivatives (n, d) of the weighted chi-square, and half of it, at `poses`.

    By a small motion of each pose in its own frame, rotation first, d = 6, or 3 in the plane. The residual of an edge
    is e = log(b_from_a_measured a_from_b), as GTSAM's BetweenFactor has it; it moves with b as the inverse of the right
    Jacobian of the exponential at e says, J, and with a as -J Ad(b_from_a) (Barfoot 2017, eq. 7.77, 7.83).
    """
    size = 3 if graph.dimension == 2 else 6
    n, edges = len(poses), len(graph.a)
    sums = _Sums(np.zeros(edges), np.zeros((n, size, size)), np.zeros((edges, size, size)), np.zeros((n, size)))
    terms, given = _terms(graph, weight)

    def add(low: int, high: int) -> None:
        """The edges with an end among poses low:high, in their order; an edge between two ranges is in both."""
        ends = ((low <= one) & (one < high) for one in (graph.a, graph.b))
        terms(np.flatnonzero(np.logical_or(*ends)), low, high, given, poses, sums)

    with Workers() as workers:
        workers.each(add, workers.ranges(0, n, _LEAST_SHARE, _BY_THREAD))
    return Blocks(sums.diagonal, graph.a, graph.b, sums.other), sums.gradient, float(sums.cost.sum())


def edge_costs(graph: PoseGraph, weight: Floats, poses: Floats, edges: Ints | None = None) -> Floats:
    """Half the weighted chi-square of each edge (E,), or of those named, at `poses`."""
    terms, given = _terms(graph, weight)
    none = np.empty((0, 0, 0))
    sums = _Sums(np.zeros(len(graph.a)), none, none, np.empty((0, 0)))
    wanted = np.arange(len(graph.a)) if edges is None else np.asarray(edges, np.int64)
    with Workers() as workers:
        parts = workers.ranges(0, len(wanted), _LEAST_SHARE, _BY_THREAD)
        workers.each(terms, [(wanted[low:high], 0, len(poses), given, poses, sums) for low, high in parts])
    return sums.cost if edges is None else sums.cost[edges]


def _terms(graph: PoseGraph, weight: Floats) -> tuple[Terms, _Edges]:
    """The compiled sum over edges for the dimension of the graph, and its edges as arrays."""
    planar = graph.dimension == 2
    information = graph.information[:, 2:5, 2:5] if planar else graph.information  # yaw, x, y
    given = (np.ascontiguousarray(one, np.float64) for one in (graph.a_from_b, information, weight))
    return _planar if planar else _spatial, _Edges(graph.a, graph.b, *given)


@numba.njit(cache=True, nogil=True)
def _planar(edges: Ints, low: int, high: int, given: _Edges, poses: Floats, sums: _Sums) -> None:
    """Add the normal equations of these edges for poses low:high; only costs where `diagonal` is empty.

    What belongs to an edge and not to a pose is added by the range that has its first end.
    """
    a, b, measured, _, weight = given
    error, Ad, Jr_inv, turned, JtOmega = np.empty(3), np.zeros((3, 3)), np.eye(3), np.empty((3, 3)), np.empty((3, 3))
    for at in range(len(edges)):
        edge = int(edges[at])
        if weight[edge] == 0.0:
            continue
        one, two, z = poses[a[edge]], poses[b[edge]], measured[edge]
        # a_from_b, and from there to where b was measured
        dx, dy = two[0, 3] - one[0, 3], two[1, 3] - one[1, 3]
        x, y = one[0, 0] * dx + one[1, 0] * dy, one[0, 1] * dx + one[1, 1] * dy
        c = one[0, 0] * two[0, 0] + one[1, 0] * two[1, 0]
        s = one[0, 0] * two[1, 0] - one[1, 0] * two[0, 0]
        ex, ey = x - z[0, 3], y - z[1, 3]
        ex, ey = z[0, 0] * ex + z[1, 0] * ey, z[0, 1] * ex + z[1, 1] * ey
        turn = atan2(z[0, 0] * s - z[1, 0] * c, z[0, 0] * c + z[1, 0] * s)
        h = turn / 2.0
        straight = 1.0 - h**2 / 3.0 - h**4 / 45.0 - 2.0 * h**6 / 945.0  # h cot h where h is small
        curve = 1.0 / 12.0 + turn * turn / 720.0
        if abs(h) >= 1e-2:
            straight = h * cos(h) / sin(h)
            curve = (1.0 - straight) / (turn * turn)
        error[0], error[1], error[2] = turn, straight * ex + h * ey, straight * ey - h * ex
        # -Ad(b_from_a); b_from_a turns by -turn of b and shifts by (-c x - s y, s x - c y)
        Ad[0, 0] = -1.0
        Ad[1, 0], Ad[2, 0] = -(s * x - c * y), -(c * x + s * y)
        Ad[1, 1], Ad[1, 2], Ad[2, 1], Ad[2, 2] = -c, -s, s, -c
        # I + ad / 2 + curve ad^2 with ad = (0 0 0, y 0 -turn, -x turn 0) of the residual
        Jr_inv[1, 0] = error[2] / 2.0 + curve * turn * error[1]
        Jr_inv[2, 0] = -error[1] / 2.0 + curve * turn * error[2]
        Jr_inv[1, 1] = Jr_inv[2, 2] = 1.0 - curve * turn * turn
        Jr_inv[1, 2], Jr_inv[2, 1] = -h, h
        _product(Jr_inv, Ad, turned)
        _add(edge, low, high, given, error, turned, Jr_inv, sums, JtOmega)


@numba.njit(cache=True, nogil=True)
def _spatial(edges: Ints, low: int, high: int, given: _Edges, poses: Floats, sums: _Sums) -> None:
    """Add the normal equations of these edges for poses low:high; only costs where `diagonal` is empty.

    What belongs to an edge and not to a pose is added by the range that has its first end.
    """
    a, b, measured, _, weight = given
    error, Ad, Jr_inv, by_a, JtOmega = (
        np.empty(6), np.zeros((6, 6)), np.empty((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    )  # fmt: skip
    ad, square, fourth = np.zeros((6, 6)), np.empty((6, 6)), np.empty((6, 6))
    turned, rest, x, shift = np.empty((3, 3)), np.empty((3, 3)), np.empty(3), np.empty(3)
    for at in range(len(edges)):
        edge = int(edges[at])
        if weight[edge] == 0.0:
            continue
        one, two, z = poses[a[edge]], poses[b[edge]], measured[edge]
        for i in range(3):  # a_from_b
            x[i] = 0.0
            for k in range(3):
                x[i] += one[k, i] * (two[k, 3] - one[k, 3])
            for j in range(3):
                turned[i, j] = one[0, i] * two[0, j] + one[1, i] * two[1, j] + one[2, i] * two[2, j]
        for i in range(3):  # b_measured_from_b
            shift[i] = 0.0
            for k in range(3):
                shift[i] += z[k, i] * (x[k] - z[k, 3])
            for j in range(3):
                rest[i, j] = z[0, i] * turned[0, j] + z[1, i] * turned[1, j] + z[2, i] * turned[2, j]
        logarithm(rest, shift, error)
        # -Ad(b_from_a): R^T and -R^T [x] with a_from_b = (R, x)
        for i in range(3):
            r0, r1, r2 = turned[0, i], turned[1, i], turned[2, i]
            Ad[i, 0], Ad[i, 1], Ad[i, 2] = -r0, -r1, -r2
            Ad[3 + i, 3], Ad[3 + i, 4], Ad[3 + i, 5] = -r0, -r1, -r2
            Ad[3 + i, 0], Ad[3 + i, 1], Ad[3 + i, 2] = (
                r1 * x[2] - r2 * x[1],
                r2 * x[0] - r0 * x[2],
                (r0 * x[1] - r1 * x[0]),
            )
        _right_jacobian_inverse(error, Jr_inv, ad, square, fourth)
        _product(Jr_inv, Ad, by_a)
        _add(edge, low, high, given, error, by_a, Jr_inv, sums, JtOmega)


@numba.njit(cache=True, nogil=True)
def logarithm(rotation: Floats, shift: Floats, error: Floats) -> None:
    """The twist of a motion, as geometry.log: through the quaternion, stable up to half a turn."""
    m = rotation
    trace = m[0, 0] + m[1, 1] + m[2, 2]
    if trace >= 0.0:
        w = 1.0 + trace
        x, y, z = m[2, 1] - m[1, 2], m[0, 2] - m[2, 0], m[1, 0] - m[0, 1]
    elif m[0, 0] >= m[1, 1] and m[0, 0] >= m[2, 2]:
        x = 1.0 + m[0, 0] - m[1, 1] - m[2, 2]
        w, y, z = m[2, 1] - m[1, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]
    elif m[1, 1] >= m[2, 2]:
        y = 1.0 - m[0, 0] + m[1, 1] - m[2, 2]
        w, x, z = m[0, 2] - m[2, 0], m[0, 1] + m[1, 0], m[1, 2] + m[2, 1]
    else:
        z = 1.0 - m[0, 0] - m[1, 1] + m[2, 2]
        w, x, y = m[1, 0] - m[0, 1], m[0, 2] + m[2, 0], m[1, 2] + m[2, 1]
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    norm = sqrt(x * x + y * y + z * z)
    scale = 2.0 / w if norm < 1e-9 * w else 2.0 * atan2(norm, w) / norm
    x, y, z = scale * x, scale * y, scale * z
    # the inverse of the left Jacobian: v = t - omega x t / 2 + k omega x (omega x t)
    square = x * x + y * y + z * z
    half = sqrt(square) / 2.0
    k = 1.0 / 12.0 + square / 720.0
    if half > 1e-2:
        k = (1.0 - half * cos(half) / sin(half)) / square
    cx, cy, cz = y * shift[2] - z * shift[1], z * shift[0] - x * shift[2], x * shift[1] - y * shift[0]
    error[0], error[1], error[2] = x, y, z
    error[3] = shift[0] - cx / 2.0 + k * (y * cz - z * cy)
    error[4] = shift[1] - cy / 2.0 + k * (z * cx - x * cz)
    error[5] = shift[2] - cz / 2.0 + k * (x * cy - y * cx)


@numba.njit(cache=True, nogil=True)
def _product(a: Floats, b: Floats, result: Floats) -> None:
    size = len(a)
    for i in range(size):
        for j in range(size):
            result[i, j] = 0.0
            for k in range(size):
                result[i, j] += a[i, k] * b[k, j]


@numba.njit(cache=True, nogil=True)
def _right_jacobian_inverse(error: Floats, Jr_inv: Floats, ad: Floats, square: Floats, fourth: Floats) -> None:
    """The inverse of the right Jacobian of the exponential at a twist (6,), in `Jr_inv`; the others are room for it.

    x / (1 - exp(-x)) of x = ad(e), which is 1 + x / 2 + p x^2 + q x^4 exactly as (x^2 + angle^2)^2 x = 0.
    """
    angle2 = error[0] ** 2 + error[1] ** 2 + error[2] ** 2
    if angle2 < 1e-2:
        p, q = 1.0 / 12.0 - angle2**2 / 30240.0, -1.0 / 720.0 - angle2 / 15120.0
    else:
        half = sqrt(angle2) / 2.0
        even = half * cos(half) / sin(half) - 1.0  # x / 2 coth(x / 2) - 1, a function of x^2, at -angle^2
        derivative = (half / sin(half) ** 2 - cos(half) / sin(half)) / (8.0 * half)
        p = -derivative - 2.0 * even / angle2
        q = -(even + derivative * angle2) / angle2**2
    for at in range(3):
        after, last = (at + 1) % 3, (at + 2) % 3
        ad[at, after] = ad[3 + at, 3 + after] = -error[last]
        ad[at, last] = ad[3 + at, 3 + last] = error[after]
        ad[3 + at, after], ad[3 + at, last] = -error[3 + last], error[3 + after]
    _product(ad, ad, square)
    _product(square, square, fourth)
    for i in range(6):
        for j in range(6):
            Jr_inv[i, j] = ad[i, j] / 2.0 + p * square[i, j] + q * fourth[i, j]
        Jr_inv[i, i] += 1.0


@numba.njit(cache=True, nogil=True)
def _add(  # noqa: PLR0912 (one loop nest, compiled)
    edge: int,
    low: int,
    high: int,
    given: _Edges,
    error: Floats,
    by_a: Floats,
    by_b: Floats,
    sums: _Sums,
    JtOmega: Floats,
) -> None:
    """Half the chi-square of one edge, which moves with its ends as `by_a` and `by_b` (d, d) say; its share of the
    normal equations of poses low:high is added."""
    size, a, b = len(error), given.a[edge], given.b[edge]
    Omega, weight = given.information[edge], given.weight[edge]
    cost, diagonal, other, gradient = sums
    if low <= a < high:
        for i in range(size):
            for j in range(size):
                cost[edge] += 0.5 * weight * error[i] * Omega[i, j] * error[j]
    if len(diagonal) == 0:
        return
    for end in range(2):
        node, by = (a, by_a) if end == 0 else (b, by_b)
        if not low <= node < high:
            continue
        for i in range(size):  # J^T of the edge times its information
            for j in range(size):
                JtOmega[i, j] = 0.0
                for k in range(size):
                    JtOmega[i, j] += by[k, i] * Omega[k, j]
                JtOmega[i, j] *= weight
        for i in range(size):
            for j in range(size):
                gradient[node, i] += JtOmega[i, j] * error[j]
                for k in range(size):
                    diagonal[node, i, j] += JtOmega[i, k] * by[k, j]
                if end == 0:
                    for k in range(size):
                        other[edge, i, j] += JtOmega[i, k] * by_b[k, j]
