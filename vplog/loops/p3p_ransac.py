"""The pose of a calibrated camera by P3P in RANSAC: OpenCV's USAC with its local optimisation.

PoseLib is as accurate and faster on few right matches, but has no wheel for Linux on ARM.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import cv2
import numpy as np

from vplog.geometry import se3

if TYPE_CHECKING:
    from vplog.data import Floats

_CONFIDENCE = 0.99
"""Sampling ends when three right matches would have been drawn with this probability."""
_SAMPLE = 4
"""Fewest matches: three for P3P (Gao et al. 2003), one more to tell its up to four poses apart."""


def find_pose(points: Floats, rays: Floats, radius: float, rounds: int) -> tuple[Floats, np.ndarray] | None:
    """query_from_match (4, 4) and its inliers (K,) bool; None where no three points fix a pose.

    Points (K, 3) in the match's camera were observed as rays (K, 2) by the query; those within `radius` of their ray,
    in normalised image coordinates, are inliers. At most `rounds` samples are drawn (Fischler & Bolles 1981), the same
    ones for the same matches.
    """
    if len(points) < _SAMPLE:
        return None
    usac = cv2.UsacParams()
    usac.threshold, usac.confidence, usac.maxIterations = radius, _CONFIDENCE, rounds
    try:
        found, _, turn, moved, _ = cv2.solvePnPRansac(points, rays, np.eye(3), None, params=usac)
    except cv2.error:  # points on one line
        return None
    if not found or not (np.isfinite(turn).all() and np.isfinite(moved).all()):
        return None
    rotation = np.asarray(cv2.Rodrigues(turn)[0], np.float64)
    pose = se3.pose(rotation, np.asarray(moved, np.float64).ravel())
    return pose, inliers(pose, points, rays, radius)


def inliers(query_from_match: Floats, points: Floats, rays: Floats, radius: float) -> np.ndarray:
    """(K,) bool: the matches in front of the camera and within `radius` of where the pose (4, 4) projects them."""
    x, y, z = se3.transform(query_from_match, points).T
    with np.errstate(divide="ignore", invalid="ignore"):
        return (z > 0) & ((x / z - rays[:, 0]) ** 2 + (y / z - rays[:, 1]) ** 2 < radius**2)
