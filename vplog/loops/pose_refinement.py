"""Least-squares refinement of a relative pose, and the reprojection errors by which its inliers are selected.

A landmark (x, y, rho) of the match's frame, normalised image coordinates and inverse depth in 1/m, is observed by the
query as another such triple; poses move as match_from_query exp(d), d rotation first.
"""

from __future__ import annotations

import math

import numba
import numpy as np

_HUBER = 1.5
"""Sigmas beyond which an error counts linearly: 96 % as efficient as least squares on Gaussian errors (Huber 1981)."""
_STEPS = 5
"""Gauss-Newton steps each time; RANSAC starts within the linear range and two or three converge."""
_CONVERGED = 1e-3
"""Squared length of a step in sigmas of the pose: a thirtieth of a sigma decides nothing that follows."""


@numba.njit(cache=True, nogil=True, error_model="numpy")
def agreement(match_from_query, points, covariance, rays, noise):
    """Squared Mahalanobis distances (K,) of the image errors of landmarks (K, 3), observed at (K, 2) with covariance
    `noise` (K, 2, 2): with the landmarks' `covariance` (K, 3, 3), and without it. NaN behind the query."""
    K = points.shape[0]
    squared, alone = np.full(K, np.nan), np.full(K, np.nan)
    rotation, shift = _inverse(match_from_query)
    predicted, by_point, by_pose = np.empty(3), np.empty((3, 3)), np.empty((3, 6))
    for k in range(K):
        if not _predict(rotation, shift, points[k], predicted, by_point, by_pose):
            continue
        a, b, c = noise[k, 0, 0], noise[k, 0, 1], noise[k, 1, 1]
        x, y = predicted[0] - rays[k, 0], predicted[1] - rays[k, 1]
        alone[k] = (c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b)
        for i in range(3):
            for j in range(3):
                a += by_point[0, i] * covariance[k, i, j] * by_point[0, j]
                b += by_point[0, i] * covariance[k, i, j] * by_point[1, j]
                c += by_point[1, i] * covariance[k, i, j] * by_point[1, j]
        squared[k] = (c * x * x - 2.0 * b * x * y + a * y * y) / (a * c - b * b)
    return squared, alone


@numba.njit(cache=True, nogil=True, error_model="numpy")
def fit(match_from_query, points, covariance, rays, rho, variance, noise):
    """Gauss-Newton over all matches: the pose, its Hessian (6, 6), the residual variance over its expectation.

    Landmarks (K, 3) with covariance (K, 3, 3) were observed at (K, 2) with covariance `noise` (K, 2, 2), and where the
    query measured them too at inverse depths `rho` (K,) with `variance` (K,), NaN elsewhere.
    """
    K = points.shape[0]
    pose, hessian, excess = match_from_query.copy(), np.eye(6), 1.0
    predicted, by_point, by_pose = np.empty(3), np.empty((3, 3)), np.empty((3, 6))
    weight, residual = np.empty((3, 3)), np.empty(3)
    gradient, step = np.empty(6), np.empty(6)
    for _ in range(_STEPS):
        rotation, shift = _inverse(pose)
        hessian[:] = 0.0
        gradient[:] = 0.0
        cost, freedom = 0.0, 0.0
        for k in range(K):
            size = 3 if np.isfinite(rho[k]) else 2
            freedom += size
            if not _predict(rotation, shift, points[k], predicted, by_point, by_pose):
                continue  # a step took it behind the query
            residual[0], residual[1], residual[2] = predicted[0] - rays[k, 0], predicted[1] - rays[k, 1], 0.0
            if size == 3:
                residual[2] = predicted[2] - rho[k]
            _weigh(by_point, covariance[k], noise[k], variance[k], size, weight)
            cost += _add(residual, weight, by_pose, size, gradient, hessian)
        excess = cost / max(freedom - 6.0, 1.0)
        if not _solve(hessian, gradient, step):
            break  # no one pose is best
        length = 0.0
        for p in range(6):
            step[p] = -step[p]
            length -= step[p] * gradient[p]
        pose = _retract(pose, step)
        if length < _CONVERGED:
            break
    return pose, hessian, excess


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _weigh(by_point, covariance, noise, variance, size, weight):
    """Write the inverse covariance of a residual: the landmark's through `by_point`, the pixels' and rho's."""
    total = np.empty((3, 3))
    for i in range(size):
        for j in range(size):
            s = 0.0
            for a in range(3):
                for b in range(3):
                    s += by_point[i, a] * covariance[a, b] * by_point[j, b]
            total[i, j] = s
    for i in range(2):
        for j in range(2):
            total[i, j] += noise[i, j]
    if size == 3:
        total[2, 2] += variance
    _invert(total, size, weight)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _add(residual, weight, by_pose, size, gradient, hessian):
    """Add a match to the gradient and the Hessian; its robust squared residual."""
    squared = 0.0
    for i in range(size):
        for j in range(size):
            squared += residual[i] * weight[i, j] * residual[j]
    robust = 1.0 / max(1.0, math.sqrt(max(squared, 0.0) / size) / _HUBER)
    for i in range(size):
        for p in range(6):
            weighted = 0.0
            for j in range(size):
                weighted += weight[i, j] * by_pose[j, p]
            weighted *= robust
            gradient[p] += weighted * residual[i]
            for q in range(6):
                hessian[p, q] += weighted * by_pose[i, q]
    return robust * squared


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _inverse(pose):
    """Rotation (3, 3) and translation (3,) the other way round."""
    rotation, shift = np.empty((3, 3)), np.zeros(3)
    for i in range(3):
        for j in range(3):
            rotation[i, j] = pose[j, i]
            shift[i] -= pose[j, i] * pose[j, 3]
    return rotation, shift


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _predict(rotation, shift, point, predicted, by_point, by_pose):
    """Write the query's observation of a landmark (x, y, rho), and its derivatives by landmark (3, 3) and pose (3, 6).

    False where that is behind it.
    """
    x, y, rho = point[0], point[1], point[2]
    s0 = rotation[0, 0] * x + rotation[0, 1] * y + rotation[0, 2] + rho * shift[0]
    s1 = rotation[1, 0] * x + rotation[1, 1] * y + rotation[1, 2] + rho * shift[1]
    s2 = rotation[2, 0] * x + rotation[2, 1] * y + rotation[2, 2] + rho * shift[2]
    if not s2 > 0.0:
        return False
    depth = 1.0 / s2
    predicted[0], predicted[1], predicted[2] = s0 * depth, s1 * depth, rho * depth
    for i in range(3):
        # by s: 1 / s2 on the diagonal of the first two rows, -predicted / s2 in the last column
        along = 1.0 if i < 2 else 0.0
        last = -predicted[i] * depth
        for j in range(2):
            by_point[i, j] = along * depth * rotation[min(i, 1), j] + last * rotation[2, j]
        by_point[i, 2] = along * depth * shift[min(i, 1)] + last * shift[2]
        first = depth if i == 0 else 0.0
        second = depth if i == 1 else 0.0
        # s moves by skew(s) d_rotation - rho d_translation
        by_pose[i, 0] = second * s2 - last * s1
        by_pose[i, 1] = last * s0 - first * s2
        by_pose[i, 2] = first * s1 - second * s0
        by_pose[i, 3], by_pose[i, 4], by_pose[i, 5] = -first * rho, -second * rho, -last * rho
    by_point[2, 2] += depth
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _invert(matrix, size, result):
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
def _solve(hessian, gradient, step):
    """Write the solution of hessian (6, 6) step = gradient by Cholesky's factors; False where it is singular."""
    lower = np.zeros((6, 6))
    for i in range(6):
        for j in range(i + 1):
            s = hessian[i, j]
            for k in range(j):
                s -= lower[i, k] * lower[j, k]
            if i > j:
                lower[i, j] = s / lower[j, j]
            elif s > 1e-14 * hessian[i, i]:  # beyond the rounding of the sum
                lower[i, i] = math.sqrt(s)
            else:
                return False
    for i in range(6):
        s = gradient[i]
        for k in range(i):
            s -= lower[i, k] * step[k]
        step[i] = s / lower[i, i]
    for i in range(5, -1, -1):
        s = step[i]
        for k in range(i + 1, 6):
            s -= lower[k, i] * step[k]
        step[i] = s / lower[i, i]
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _retract(pose, step):
    """pose exp(step): Rodrigues' formula and the left Jacobian."""
    x, y, z = step[0], step[1], step[2]
    angle = math.sqrt(x * x + y * y + z * z)
    if angle < 1e-5:  # the quotients lose their digits
        a, b, c = 1.0 - angle * angle / 6.0, 0.5 - angle * angle / 24.0, 1.0 / 6.0 - angle * angle / 120.0
    else:
        sinc = math.sin(0.5 * angle) / (0.5 * angle)
        a, b, c = math.sin(angle) / angle, 0.5 * sinc * sinc, (angle - math.sin(angle)) / angle**3
    skew = np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])
    turn, along = np.eye(3), np.eye(3)
    for i in range(3):
        for j in range(3):
            s = 0.0
            for k in range(3):
                s += skew[i, k] * skew[k, j]
            turn[i, j] += a * skew[i, j] + b * s
            along[i, j] += b * skew[i, j] + c * s
    result = np.eye(4)
    for i in range(3):
        result[i, 3] = pose[i, 3]
        for j in range(3):
            s, t = 0.0, 0.0
            for k in range(3):
                s += pose[i, k] * turn[k, j]
                t += along[j, k] * step[3 + k]
            result[i, j] = s
            result[i, 3] += pose[i, j] * t
    return result
