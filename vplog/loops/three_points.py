"""The pose of a calibrated camera that most matches to known points agree with: random threes, a pose of each."""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numba
import numpy as np

from vplog.loops.conics import common_lines, set_conic

if TYPE_CHECKING:
    from vplog.data import Floats

_CONFIDENCE = 0.99
"""Sampling ends when three right matches would have been drawn with this probability."""
_SEED = 0x9E3779B97F4A7C15
"""Any number will do; always the same, so that the same matches give the same pose."""
_NEAR = 1e-12
"""Squared distance of two points against that of two others, below which they are in one place."""
_NARROW = 1e-8
"""Squared height of a triangle against its side: of a ten-thousandth of its length, the plane is anyone's."""
_POLISH = 3
"""Newton steps on the distances: they double the digits that the cubic's root leaves."""


def find_pose(points: Floats, seen: Floats, radius: float, rounds: int) -> tuple[Floats, np.ndarray] | None:
    """query_from_match (4, 4) and the agreeing matches (K,) bool, None where no three points fix a pose.

    Points (K, 3) in the match's camera were seen as rays (K, 2) by the query; those within `radius` of their ray, in
    normalised image coordinates, agree. At most `rounds` threes are drawn (Fischler & Bolles 1981).
    """
    pose, count = _sample(points, seen, radius**2, rounds, math.log(1.0 - _CONFIDENCE), np.uint64(_SEED))
    return (pose, agreeing(pose, points, seen, radius)) if count else None


def agreeing(query_from_match: Floats, points: Floats, seen: Floats, radius: float) -> np.ndarray:
    """(K,) bool: the matches within `radius` of where the pose (4, 4) has them."""
    return _agree(query_from_match, points, seen, radius**2)


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _agree(pose, points, seen, square):
    result = np.empty(points.shape[0], np.bool_)
    for k in range(points.shape[0]):
        result[k] = _error(pose, points[k], seen[k]) < square
    return result


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _sample(points, seen, square, rounds, log_missed, state):
    K = points.shape[0]
    best, most = np.eye(4), 0
    drawn, poses = np.empty(3, np.int64), np.empty((4, 3, 4))
    bearing = np.empty((K, 3))
    for k in range(K):
        length = math.sqrt(seen[k, 0] ** 2 + seen[k, 1] ** 2 + 1.0)
        bearing[k, 0], bearing[k, 1], bearing[k, 2] = seen[k, 0] / length, seen[k, 1] / length, 1.0 / length
    n = 0
    while n < rounds and K >= 3:
        n += 1
        for i in range(3):
            while True:
                # Knuth's MMIX; its high bits are the random ones
                state = state * np.uint64(6364136223846793005) + np.uint64(1442695040888963407)
                drawn[i] = np.int64((state >> np.uint64(33)) % np.uint64(K))
                if (i < 1 or drawn[i] != drawn[0]) and (i < 2 or drawn[i] != drawn[1]):
                    break
        for p in range(_poses(points, bearing, drawn, poses)):
            count = _agreeing(poses[p], points, seen, square, most)
            if count > most:
                most = count
                best[:3] = poses[p]
                missed = 1.0 - (count / K) ** 3
                rounds = n if missed <= 0.0 else min(rounds, math.ceil(log_missed / math.log(missed)))
    return best, most


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _error(pose, point, seen):
    """Squared distance of a point's image to where it was seen, infinite behind the camera."""
    z = pose[2, 0] * point[0] + pose[2, 1] * point[1] + pose[2, 2] * point[2] + pose[2, 3]
    if z <= 0.0:
        return np.inf
    x = pose[0, 0] * point[0] + pose[0, 1] * point[1] + pose[0, 2] * point[2] + pose[0, 3]
    y = pose[1, 0] * point[0] + pose[1, 1] * point[1] + pose[1, 2] * point[2] + pose[1, 3]
    return (x / z - seen[0]) ** 2 + (y / z - seen[1]) ** 2


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _agreeing(pose, points, seen, square, most):
    """How many matches agree; counting ends where no more than `most` can."""
    count, K = 0, points.shape[0]
    for k in range(K):
        if count + K - k <= most:
            return 0
        if _error(pose, points[k], seen[k]) < square:
            count += 1
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _poses(points, bearing, drawn, poses):
    """How many poses, written to `poses` (4, 3, 4), see three points in three directions.

    The distances l of the points satisfy l_i^2 + l_j^2 - 2 l_i l_j cos_ij = a_ij; without their common scale they are
    a line that two conics share.
    """
    a, b = np.empty(3), np.empty(3)  # of the pairs 01, 02, 12: squared distance, and -2 cos
    for pair in range(3):
        i, j = drawn[0 if pair < 2 else 1], drawn[1 if pair == 0 else 2]
        a[pair], b[pair] = 0.0, 0.0
        for d in range(3):
            a[pair] += (points[i, d] - points[j, d]) ** 2
            b[pair] -= 2.0 * bearing[i, d] * bearing[j, d]
    D, E, lines = np.empty((3, 3)), np.empty((3, 3)), np.empty((4, 3))
    scale = max(a[0], a[1], a[2])
    if not min(a[0], a[1], a[2]) > _NEAR * scale:
        return 0
    p, q, r = a[0] / scale, a[1] / scale, a[2] / scale
    set_conic(D, r, r - p, -p, r * b[0], 0.0, -p * b[2])
    set_conic(E, r, -q, r - q, 0.0, r * b[1], -q * b[2])
    count = 0
    for n in range(common_lines(D, E, lines)):
        line = lines[n]
        if line[0] + line[1] + line[2] < 0.0:
            line = -line
        if min(line[0], line[1], line[2]) <= 0.0:
            continue
        square = line[1] * line[1] + line[2] * line[2] + b[2] * line[1] * line[2]
        line = _polished(line * math.sqrt(a[2] / max(square, 1e-300)), a, b)
        if min(line[0], line[1], line[2]) > 0.0 and _place(poses[count], points, bearing, drawn, line):
            count += 1
    return count


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _polished(line, a, b):
    """(3,) the distances after Newton's steps on the three equations."""
    l0, l1, l2 = line[0], line[1], line[2]
    for _ in range(_POLISH):
        r0 = l0 * l0 + l1 * l1 + b[0] * l0 * l1 - a[0]
        r1 = l0 * l0 + l2 * l2 + b[1] * l0 * l2 - a[1]
        r2 = l1 * l1 + l2 * l2 + b[2] * l1 * l2 - a[2]
        j00, j01 = 2.0 * l0 + b[0] * l1, 2.0 * l1 + b[0] * l0
        j10, j12 = 2.0 * l0 + b[1] * l2, 2.0 * l2 + b[1] * l0
        j21, j22 = 2.0 * l1 + b[2] * l2, 2.0 * l2 + b[2] * l1
        determinant = -j00 * j12 * j21 - j01 * j10 * j22
        if determinant == 0.0:
            break
        l0, l1, l2 = (
            l0 - (-j12 * j21 * r0 - j01 * j22 * r1 + j01 * j12 * r2) / determinant,
            l1 - (-j10 * j22 * r0 + j00 * j22 * r1 - j00 * j12 * r2) / determinant,
            l2 - (j10 * j21 * r0 - j00 * j21 * r1 - j01 * j10 * r2) / determinant,
        )
    return np.array([l0, l1, l2])


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _place(pose, points, bearing, drawn, line):
    """Write the pose (3, 4) that moves three points to their distances along their bearings; False on one line."""
    here, there = np.empty((3, 3)), np.empty((3, 3))
    if not _triad(points[drawn[0]], points[drawn[1]], points[drawn[2]], here):
        return False
    first, second, third = bearing[drawn[0]] * line[0], bearing[drawn[1]] * line[1], bearing[drawn[2]] * line[2]
    if not _triad(first, second, third, there):
        return False
    for i in range(3):
        for j in range(3):
            pose[i, j] = there[0, i] * here[0, j] + there[1, i] * here[1, j] + there[2, i] * here[2, j]
    for i in range(3):
        pose[i, 3] = first[i]
        for j in range(3):
            pose[i, 3] -= pose[i, j] * points[drawn[0], j]
    return True


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _triad(a, b, c, axes):
    """Write the axes (3, 3), by rows, of a triangle: along a side, across its plane, and across both."""
    length, dot, square = 0.0, 0.0, 0.0
    for d in range(3):
        length += (b[d] - a[d]) ** 2
        square += (c[d] - a[d]) ** 2
    length = math.sqrt(length)
    if length == 0.0:
        return False
    for d in range(3):
        axes[0, d] = (b[d] - a[d]) / length
        dot += axes[0, d] * (c[d] - a[d])
    height = 0.0
    for d in range(3):
        axes[1, d] = c[d] - a[d] - dot * axes[0, d]
        height += axes[1, d] ** 2
    if not height > _NARROW * square:
        return False
    height = math.sqrt(height)
    for d in range(3):
        axes[1, d] /= height
    axes[2, 0] = axes[0, 1] * axes[1, 2] - axes[0, 2] * axes[1, 1]
    axes[2, 1] = axes[0, 2] * axes[1, 0] - axes[0, 0] * axes[1, 2]
    axes[2, 2] = axes[0, 0] * axes[1, 1] - axes[0, 1] * axes[1, 0]
    return True
