"""The normal equations of a pose graph at some poses. Arrays have the edges in their last axis, which is fast."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np
from scipy import sparse

from vplog.data import Floats, Ints, PoseGraph
from vplog.geometry import se3
from vplog.graph.sparse.cholesky import Blocks
from vplog.graph.workers import Workers

if TYPE_CHECKING:
    from collections.abc import Callable

_EDGES_AT_ONCE = 4096
"""Number of edges per task of a thread: their arrays fit into the L2 cache."""


def normal_equations(graph: PoseGraph, weight: Floats, poses: Floats) -> tuple[Blocks, Floats, float]:
    """Half the second and the first derivatives (n, d) of the weighted chi-square, and half of it, at `poses`.

    By a small motion of each pose in its own frame, rotation first, d = 6, or 3 in the plane. The residual of an edge
    is e = log(b_from_a_measured a_from_b), as GTSAM's BetweenFactor has it. It moves with b by J, the inverse of the
    right Jacobian of the exponential at e, and with a by -J Ad(b_from_a) (Barfoot 2017, eq. 7.77, 7.83).
    """
    size, edges = 3 if graph.dimension == 2 else 6, np.flatnonzero(weight)
    # by both ends, the second derivatives and the gradient
    terms, other = np.empty((2, len(edges), size, size + 1)), np.zeros((len(weight), size, size))
    moved = _last(poses)

    def add(rows: slice) -> float:
        of = edges[rows]
        error, Ad, J = _linearised(graph, of, moved)
        by_error, Omega = _weighted(graph, weight, of, error)
        bb = np.einsum("jie,jke->ike", J, np.einsum("ije,jke->ike", Omega, J))
        ab = -np.einsum("jie,jke->ike", Ad, bb)
        gradient = np.einsum("jie,je->ie", J, by_error)
        other[of] = ab.transpose(2, 0, 1)
        terms[0, rows, :, :size] = -np.einsum("ije,jke->eik", ab, Ad)
        terms[0, rows, :, size] = -np.einsum("jie,je->ei", Ad, gradient)
        terms[1, rows, :, :size], terms[1, rows, :, size] = bb.transpose(2, 0, 1), gradient.T
        return float((error * by_error).sum())

    cost = 0.5 * sum(_each(add, len(edges)))
    ends = np.concatenate([graph.a[edges], graph.b[edges]])
    add_up = sparse.csc_array((np.ones(len(ends)), ends, np.arange(len(ends) + 1)), shape=(len(poses), len(ends)))
    sums = (add_up @ terms.reshape(len(ends), -1)).reshape(-1, size, size + 1)
    return Blocks(sums[:, :, :size], graph.a, graph.b, other), sums[:, :, size], cost


def edge_costs(graph: PoseGraph, weight: Floats, poses: Floats, edges: Ints | None = None) -> Floats:
    """Half the weighted chi-square of each edge (E,), or of those named, at `poses`."""
    wanted = np.arange(len(graph.a)) if edges is None else np.asarray(edges, np.int64)
    cost, moved = np.zeros(len(wanted)), _last(poses)
    on = np.flatnonzero(weight[wanted])

    def add(rows: slice) -> None:
        of = wanted[on[rows]]
        error = _residual(graph, of, moved)[0]
        cost[on[rows]] = 0.5 * (error * _weighted(graph, weight, of, error)[0]).sum(0)

    _each(add, len(on))
    return cost


def _each(work: Callable[[slice], Any], count: int) -> list[Any]:
    with Workers() as workers:
        return workers.each(work, [(slice(k, k + _EDGES_AT_ONCE),) for k in range(0, count, _EDGES_AT_ONCE)])


def _weighted(graph: PoseGraph, weight: Floats, edges: Ints, error: Floats) -> tuple[Floats, Floats]:
    """Return Omega e (d, E) and Omega (d, d, E), the weighted information."""
    axes = slice(2, 5) if graph.dimension == 2 else slice(6)  # yaw, x, y
    Omega = _last(graph.information[edges, axes, axes]) * weight[edges]
    return np.einsum("ije,je->ie", Omega, error), Omega


def _last(values: Floats) -> Floats:
    """Return a copy of values (E, i, j) as (i, j, E)."""
    return np.ascontiguousarray(values.transpose(1, 2, 0))


def _residual(graph: PoseGraph, edges: Ints, poses: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the residuals (d, E), and the rotation (3, 3, E) and translation (3, E) of a_from_b."""
    one, two = np.take(poses, graph.a[edges], axis=2), np.take(poses, graph.b[edges], axis=2)
    z = _last(graph.a_from_b[edges])
    R = np.einsum("kie,kje->ije", one[:3, :3], two[:3, :3])
    t = np.einsum("kie,ke->ie", one[:3, :3], two[:3, 3] - one[:3, 3])
    shift = np.einsum("kie,ke->ie", z[:3, :3], t - z[:3, 3])
    if graph.dimension == 2:
        turn = np.arctan2(z[0, 0] * R[1, 0] - z[1, 0] * R[0, 0], z[0, 0] * R[0, 0] + z[1, 0] * R[1, 0])
        h, straight = turn / 2.0, 1.0 - _curve(turn**2) * turn**2
        return np.stack([turn, straight * shift[0] + h * shift[1], straight * shift[1] - h * shift[0]]), R, t
    omega = np.ascontiguousarray(se3.so3_log(np.einsum("kie,kje->eij", z[:3, :3], R)).T)
    across = _cross(omega, shift)
    # the inverse of the left Jacobian
    v = shift - across / 2.0 + _curve((omega**2).sum(0)) * _cross(omega, across)
    return np.concatenate([omega, v]), R, t


def _curve(angle2: Floats) -> Floats:
    """Return the factor of [omega]^2 in the inverse of the left Jacobian of SO(3), (1 - h cot h) / angle^2 with
    h = angle / 2, for squared angles (E,)."""
    large = np.where(angle2 > 1e-2, angle2, 1.0)
    half = np.sqrt(large) / 2.0
    series = 1.0 / 12.0 + angle2 / 720.0 + angle2**2 / 30240.0 + angle2**3 / 1209600.0
    return np.where(angle2 > 1e-2, (1.0 - half / np.tan(half)) / large, series)


def _cross(a: Floats, b: Floats) -> Floats:
    return np.stack([a[1] * b[2] - a[2] * b[1], a[2] * b[0] - a[0] * b[2], a[0] * b[1] - a[1] * b[0]])


def _linearised(graph: PoseGraph, edges: Ints, poses: Floats) -> tuple[Floats, Floats, Floats]:
    """Return the residuals (d, E), Ad(b_from_a) (d, d, E), and the inverse J (d, d, E) of the right Jacobian."""
    error, R, t = _residual(graph, edges, poses)
    Ad = np.zeros((len(error), len(error), len(edges)))
    if graph.dimension == 2:
        c, s, turn, J = R[0, 0], R[1, 0], error[0], np.zeros_like(Ad)
        curve = _curve(turn**2)
        Ad[0, 0], Ad[1, 0], Ad[2, 0] = 1.0, s * t[0] - c * t[1], c * t[0] + s * t[1]
        Ad[1, 1], Ad[1, 2], Ad[2, 1], Ad[2, 2] = c, s, -s, c
        # I + ad / 2 + curve ad^2 with ad = (0 0 0, y 0 -turn, -x turn 0) of the residual
        J[0, 0], J[1, 0], J[2, 0] = (
            1.0, error[2] / 2.0 + curve * turn * error[1], -error[1] / 2.0 + curve * turn * error[2]
        )  # fmt: skip
        J[1, 1] = J[2, 2] = 1.0 - curve * turn**2
        J[1, 2], J[2, 1] = -turn / 2.0, turn / 2.0
        return error, Ad, J
    Ad[:3, :3] = Ad[3:, 3:] = R.swapaxes(0, 1)
    for i in range(3):
        Ad[3 + i, :3] = _cross(t, R[:, i])  # -R^T [t]
    return error, Ad, _right_jacobian_inverse(error)


def _right_jacobian_inverse(error: Floats) -> Floats:
    """Return the inverse (6, 6, E) of the right Jacobian of the exponential at twists (6, E).

    x / (1 - exp(-x)) of x = ad(e), which is 1 + x / 2 + p x^2 + q x^4 exactly as (x^2 + angle^2)^2 x = 0.
    """
    omega, v = error[:3], error[3:]
    angle2, inner = (omega**2).sum(0), (omega * v).sum(0)
    large = np.where(angle2 > 1e-2, angle2, 1.0)
    half = np.sqrt(large) / 2.0
    even = half / np.tan(half) - 1.0  # x / 2 coth(x / 2) - 1, a function of x^2, at -angle^2
    derivative = (half / np.sin(half) ** 2 - 1.0 / np.tan(half)) / (8.0 * half)
    p = np.where(angle2 > 1e-2, -derivative - 2.0 * even / large, 1.0 / 12.0 - angle2**2 / 30240.0)
    q = np.where(angle2 > 1e-2, -(even + derivative * large) / large**2, -1.0 / 720.0 - angle2 / 15120.0)
    # x = (W 0, V W) with W = [omega] and V = [v], x^2 = (W^2 0, S W^2) and x^4 = (-angle^2 W^2 0, T W^2) with
    # W^2 = omega omega^T - angle^2, S = M - 2 omega.v and M = omega v^T + v omega^T,
    # T = 4 angle^2 omega.v - angle^2 M - 2 omega.v omega omega^T
    outer, mixed, both = omega[:, None] * omega, omega[:, None] * v, p - q * angle2
    J = np.zeros((6, 6, len(angle2)))
    J[:3, :3] = both * outer
    J[3:, :3] = both * (mixed + mixed.swapaxes(0, 1)) - 2.0 * q * inner * outer
    for i in range(3):
        j, k = (i + 1) % 3, (i + 2) % 3
        J[i, i] += 1.0 - both * angle2
        J[i, j] -= omega[k] / 2.0
        J[i, k] += omega[j] / 2.0
        J[3 + i, i] -= 2.0 * inner * (both - q * angle2)
        J[3 + i, j] -= v[k] / 2.0
        J[3 + i, k] += v[j] / 2.0
    J[3:, 3:] = J[:3, :3]
    return J
