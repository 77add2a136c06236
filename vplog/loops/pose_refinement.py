"""Least-squares refinement of a relative pose, and the reprojection errors by which its inliers are selected.

A landmark (x, y, rho) of the match's frame, normalised image coordinates and inverse depth in 1/m, is observed by the
query as another such triple; poses move as match_from_query exp(d), d rotation first.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass

import numba
import numpy as np
import scipy

from vplog.data import Bools, Floats
from vplog.geometry import se3
from vplog.geometry.small_matrices import invert

_HUBER = 1.5
"""Sigmas beyond which an error counts linearly: 96 % as efficient as least squares on Gaussian errors (Huber 1981)."""
_STEPS = 5
"""Gauss-Newton steps each time; RANSAC starts within the linear range and two or three converge."""
_CONVERGED = 1e-3
"""Squared length of a step in sigmas of the pose: a thirtieth of a sigma decides nothing that follows."""


@dataclass(frozen=True, eq=False)
class LandmarkMatches:
    """K landmarks (x, y, rho) of the match's camera, each observed by the query."""

    points: Floats
    """(K, 3)."""
    covariance: Floats
    """(K, 3, 3)."""
    rays: Floats
    """(K, 2) normalised image coordinates in the query."""
    noise: Floats
    """(K, 2, 2) covariance of the rays."""
    rho: Floats
    """(K,) inverse depth in 1/m that the query measured, NaN where it did not."""
    variance: Floats
    """(K,) of rho."""

    def rows(self, rows: Bools) -> LandmarkMatches:
        """Some of the matches."""
        return LandmarkMatches(**{name: values[rows] for name, values in vars(self).items()})

    @property
    def cloud(self) -> Floats:
        """(K, 3) m in the match's camera."""
        return np.column_stack([self.points[:, :2], np.ones(len(self.points))]) / self.points[:, 2:]


def agreement(match_from_query: Floats, matches: LandmarkMatches) -> tuple[Floats, Floats]:
    """Squared Mahalanobis distances (K,) of the image errors of matches: with the landmarks' covariance, and without
    it. NaN behind the query."""
    query_from_match = se3.inverse(match_from_query)
    return _agreement(query_from_match, matches.points, matches.covariance, matches.rays, matches.noise)


def fit(match_from_query: Floats, matches: LandmarkMatches) -> tuple[Floats, Floats, float]:
    """Gauss-Newton over all matches: the pose, its Hessian (6, 6), the residual variance over its expectation."""
    pose, hessian, cost = gauss_newton(match_from_query, lambda pose: normal_equations(pose, matches))
    return pose, hessian, cost / max(measurements(matches) - 6.0, 1.0)


def gauss_newton(
    pose: Floats, equations: Callable[[Floats], tuple[Floats, Floats, float]]
) -> tuple[Floats, Floats, float]:
    """The pose T exp(d) where the gradient by d vanishes, and the Hessian (6, 6) and cost before the last step; its
    `equations` are Hessian, gradient (6,) and cost at a pose."""
    hessian, cost = np.zeros((6, 6)), math.inf
    for _ in range(_STEPS):
        hessian, gradient, cost = equations(pose)
        try:
            step = np.negative(scipy.linalg.cho_solve(scipy.linalg.cho_factor(hessian, check_finite=False), gradient))
        except np.linalg.LinAlgError:  # no one pose is best
            break
        pose = pose @ se3.exp(step)
        if -step @ gradient < _CONVERGED:
            break
    return pose, hessian, cost


def measurements(matches: LandmarkMatches) -> int:
    """Number of coordinates and depths measured."""
    return 2 * len(matches.points) + int(np.isfinite(matches.rho).sum())


def normal_equations(match_from_query: Floats, matches: LandmarkMatches) -> tuple[Floats, Floats, float]:
    """Hessian (6, 6), gradient (6,) and robust cost of all matches in front of the query."""
    return _normal_equations(
        se3.inverse(match_from_query), matches.points, matches.covariance, matches.rays, matches.noise, matches.rho,
        matches.variance,
    )  # fmt: skip


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _agreement(query_from_match, points, covariance, rays, noise):
    K = points.shape[0]
    squared, alone = np.full(K, np.nan), np.full(K, np.nan)
    predicted, by_point, by_pose = np.empty(3), np.empty((3, 3)), np.empty((3, 6))
    for k in range(K):
        if not _predict(query_from_match, points[k], predicted, by_point, by_pose):
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
def _normal_equations(query_from_match, points, covariance, rays, noise, rho, variance):
    """Hessian (6, 6), gradient (6,) and robust cost of all matches in front of the query."""
    hessian, gradient, cost = np.zeros((6, 6)), np.zeros(6), 0.0
    predicted, by_point, by_pose = np.empty(3), np.empty((3, 3)), np.empty((3, 6))
    weight, residual = np.empty((3, 3)), np.empty(3)
    for k in range(points.shape[0]):
        if not _predict(query_from_match, points[k], predicted, by_point, by_pose):
            continue  # a step took it behind the query
        size = 3 if np.isfinite(rho[k]) else 2
        residual[0], residual[1] = predicted[0] - rays[k, 0], predicted[1] - rays[k, 1]
        residual[2] = predicted[2] - rho[k] if size == 3 else 0.0
        _weigh(by_point, covariance[k], noise[k], variance[k], size, weight)
        cost += _add(residual, weight, by_pose, size, gradient, hessian)
    return hessian, gradient, cost


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
    invert(total, size, weight)


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
def _predict(T, point, predicted, by_point, by_pose):
    """Write the query's observation of a landmark (x, y, rho), and its derivatives by landmark (3, 3) and pose (3, 6).
    T is query_from_match (4, 4).

    False where that is behind it.
    """
    x, y, rho = point[0], point[1], point[2]
    s0 = T[0, 0] * x + T[0, 1] * y + T[0, 2] + rho * T[0, 3]
    s1 = T[1, 0] * x + T[1, 1] * y + T[1, 2] + rho * T[1, 3]
    s2 = T[2, 0] * x + T[2, 1] * y + T[2, 2] + rho * T[2, 3]
    if not s2 > 0.0:
        return False
    depth = 1.0 / s2
    predicted[0], predicted[1], predicted[2] = s0 * depth, s1 * depth, rho * depth
    for i in range(3):
        # by s: 1 / s2 on the diagonal of the first two rows, -predicted / s2 in the last column
        along = 1.0 if i < 2 else 0.0
        last = -predicted[i] * depth
        for j in range(2):
            by_point[i, j] = along * depth * T[min(i, 1), j] + last * T[2, j]
        by_point[i, 2] = along * depth * T[min(i, 1), 3] + last * T[2, 3]
        first = depth if i == 0 else 0.0
        second = depth if i == 1 else 0.0
        # s moves by skew(s) d_rotation - rho d_translation
        by_pose[i, 0] = second * s2 - last * s1
        by_pose[i, 1] = last * s0 - first * s2
        by_pose[i, 2] = first * s1 - second * s0
        by_pose[i, 3], by_pose[i, 4], by_pose[i, 5] = -first * rho, -second * rho, -last * rho
    by_point[2, 2] += depth
    return True
