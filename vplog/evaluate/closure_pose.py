"""Whether a closure's pose is that of the truth: the criterion of `vplog evaluate`.

The error E = truth^-1 closure, in the query's frame, is a rotation vector and a translation, each with the block C of
the claimed covariance. A closure is right where, for both parts e,

    e' (b^2 I + k^2 C)^-1 e <= 1   and   |e| <= 2 b

* b of a translation is .04 m sqrt(L / 1 m), 2 m at most: odometry and truth drift as a random walk. .04 m is .4 % after
  100 m, the best odometries of KITTI's table; GNSS bounds the truth of long drives to 2 m. L is the length of the path,
  at most pi times the diagonal of the drive.
* b of a rotation is 5 degrees: half of the turn that makes another keyframe.
* k is 4.0, the 99.9 % bound of three Gaussians; 2 b bounds what a claimed covariance may excuse.
* A closure out of bounds by less than the uncertainty of the truth, `TruthAt.error`, is not judged; nor is one with an
  end that the truth does not cover.

A right closure further off than its covariance allows is over-confident, not false. Of a closure without metres
rotation and direction are judged: the step between the cameras has its length from the truth.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Bools, Closures, Floats
from vplog.geometry import se3

if TYPE_CHECKING:
    from vplog.evaluate.body_truth import TruthAt

_DRIFT_M = 0.04
"""m after 1 m: see above."""
_MOST_M = 2.0
"""m: see above."""
_ROTATION_DEG = 5.0
_MOST_CLAIMED = 2.0
"""Times the bound that a claimed covariance may widen it to."""
_CHI = 4.033
"""sqrt of the 99.9 % quantile of chi-square with three degrees of freedom, 16.27."""
_OPEN = 1e-12
"""Eigenvalues of an information below this share of the largest claim nothing along their direction."""


@dataclass(frozen=True)
class PoseBounds:
    """Bounds on the error of a true closure's pose."""

    translation_m: float
    rotation_deg: float = _ROTATION_DEG
    most: float = _MOST_CLAIMED
    """Times these, that the claimed covariance may widen them to."""
    length_m: float = 0.0
    """Length of the drive they are for."""

    @property
    def b(self) -> Floats:
        """(2,) rad and m."""
        return np.array([np.radians(self.rotation_deg), self.translation_m])


def pose_bounds(*drives: Floats) -> PoseBounds:
    """The bounds for closures within a drive, or between drives, of true positions (N, 3) in m in one frame each."""
    length_m = 0.0
    for positions in drives:
        if len(positions):
            path_m = float(np.linalg.norm(np.diff(positions, axis=0), axis=1).sum())
            length_m += min(path_m, float(np.pi * np.linalg.norm(np.ptp(positions, axis=0))))
    return PoseBounds(min(_DRIFT_M * float(np.sqrt(length_m)), _MOST_M), length_m=length_m)


def pose_errors(
    closures: Closures,
    query: TruthAt,
    match: TruthAt,
    bounds: PoseBounds,
    cameras: tuple[Floats, Floats] = (np.eye(4), np.eye(4)),
) -> tuple[Bools, Bools, Bools, Bools]:
    """Judge the closures by the truth at the keyframes of their queries and of their matches.

    `cameras` are body_from_camera, (4, 4) or (C, 4, 4), of queries and of matches. Four of (C,): with a pose
    and a truth at both ends; right; wrong, which not judged ones are not either; right but further off than the claimed
    covariance and the truth's error allow (99.9 %).
    """
    posed = np.isfinite(closures.match_from_query).all((1, 2))
    posed &= query.known[closures.query] & match.known[closures.match]
    rows = np.flatnonzero(posed)
    there, here = closures.match[rows], closures.query[rows]
    true = se3.between(match.world_from_body[there], query.world_from_body[here])
    measured, claimed = closures.match_from_query[rows], _covariance(closures.information[rows])
    directed = np.array([closures.scale[row] == "none" for row in rows], bool)
    into, out = (np.broadcast_to(one, (len(closures), 4, 4))[rows[directed]] for one in cameras)
    measured[directed] = _at_true_length(measured[directed], true[directed], into, out)
    claimed[directed] = 0.0
    apart = se3.between(true, measured)
    # a truth that is turned at the match moves the query by as much at its distance
    lever = match.error[there, 0] * np.linalg.norm(true[:, :3, 3], axis=1)
    unsure = np.hypot(query.error[here], match.error[there])
    unsure[:, 1] = np.hypot(unsure[:, 1], lever)
    within, possible, consistent = (np.ones(len(rows), bool) for _ in range(3))
    for part, error in enumerate((se3.so3_log(apart[:, :3, :3]), apart[:, :3, 3])):
        covariance = claimed[:, 3 * part : 3 * part + 3, 3 * part : 3 * part + 3]
        size = np.maximum(np.linalg.norm(error, axis=1), 1e-12)
        left = error * np.maximum(1.0 - unsure[:, part] / size, 0.0)[:, None]
        within &= _within(error, covariance, bounds.b[part])
        possible &= _within(left, covariance, bounds.b[part])
        consistent &= _normalised(left, covariance) <= _CHI
    right, wrong, overconfident = (np.zeros(len(closures), bool) for _ in range(3))
    right[rows], wrong[rows], overconfident[rows] = within, ~possible, within & ~consistent
    return posed, right, wrong, overconfident


def _at_true_length(measured: Floats, true: Floats, into: Floats, out: Floats) -> Floats:
    """Closures (R, 4, 4) whose step from the query's camera, body_from_camera `into`, to the match's, `out`, is as long
    as the true one."""
    measured, true = (se3.inverse(out) @ one @ into for one in (measured, true))
    length, wanted = (np.linalg.norm(one[:, :3, 3], axis=1, keepdims=True) for one in (measured, true))
    measured[:, :3, 3] *= wanted / np.maximum(length, 1e-12)
    return out @ measured @ se3.inverse(into)


def _within(error: Floats, covariance: Floats, b: float) -> Bools:
    """(R,) the criterion above."""
    if not b > 0:
        return np.linalg.norm(error, axis=1) <= 0.0
    widened = b**2 * np.eye(3) + _CHI**2 * covariance
    return (_normalised(error, widened) <= 1.0) & (np.linalg.norm(error, axis=1) <= _MOST_CLAIMED * b)


def _normalised(error: Floats, covariance: Floats) -> Floats:
    """(R,) sqrt(e' C^-1 e); where nothing is claimed, C = 0, it is 0 for an error of 0 alone."""
    return np.sqrt(np.maximum(se3.mahalanobis2(error, covariance + 1e-18 * np.eye(3)), 0.0))


def _covariance(information: Floats) -> Floats:
    """(R, 6, 6) of what closures claim; zero where they claim nothing, very large along what they leave open."""
    covariance = np.zeros_like(information)
    known = np.isfinite(information).all((1, 2))
    values, vectors = np.linalg.eigh(information[known])
    largest = np.maximum(values[:, -1:], 1e-300)
    covariance[known] = (vectors / np.maximum(values, _OPEN * largest)[:, None, :]) @ np.swapaxes(vectors, 1, 2)
    return covariance
