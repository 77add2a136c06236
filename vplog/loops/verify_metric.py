"""The pose between two keyframes from matches of one's features to the other's landmarks, with its covariance."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from vplog.data import Verdict
from vplog.geometry import se3
from vplog.loops import a_contrario, p3p_ransac, pose_refinement, undistort
from vplog.settings import Settings

if TYPE_CHECKING:
    from vplog.data import Camera, Floats
    from vplog.loops.landmarks import Landmarks, LandmarkSettings

_SAMPLE = 3
"""Points that fix a calibrated camera's pose: P3P."""
_MODELS = 4
"""Poses that three points allow: Gao et al. 2003."""
_CHI2_2 = 9.210
"""Mahalanobis^2 of a 2D error that 1 % of right matches exceed: chi-square, 2 degrees of freedom, 99 %."""
_ROUNDS = 8
"""Most times that the pose and who agrees with it are decided by each other."""
_SINGULAR = 1e12
"""Condition of the Hessian beyond which its inverse has no digit left that a sensor could have measured."""


class MetricSettings(Settings):
    """When a pose between two keyframes is accepted, and how certain it is."""

    min_inliers: int = Field(default=20, ge=6)
    """Matches that must agree with the pose; RTAB-Map's and ORB-SLAM's usual bound, well above chance."""
    min_share: float = Field(default=0.25, ge=0, le=1)
    """Share of the matches with landmarks that must agree: repeated structure lets a wrong pose gather some."""
    log10_false_alarms: float = Field(default=-6.0, le=0)
    """Most wrong poses expected by chance, as log10: at -6 one in a million pairs without a common view, where matches
    fall anywhere in the image (Moulon, Monasse & Marlet 2012)."""
    ransac_px: float = Field(default=4.0, gt=0)
    """Reprojection error in px that RANSAC calls an agreement; wide, as landmarks are uncertain too."""
    ransac_rounds: int = Field(default=500, ge=1, le=1_000_000)
    """Most samples of RANSAC: a pose is found with 99 % where 21 % of the matches are right."""
    max_error_px: float = Field(default=8.0, gt=0)
    """Reprojection error in px that no landmark's uncertainty excuses."""
    min_spread: float = Field(default=0.1, ge=0, le=1)
    """Share of the image that the inliers' bounding box must cover; less is one object, not a place, and a pose from
    under a third of the field of view magnifies every pixel of noise."""
    max_depths: float = Field(default=0.5, gt=0)
    """Longest translation as a multiple of the inliers' median depth: half the depth to the side leaves half of a
    53-degree view, and half the depth ahead doubles every size."""
    max_distance_m: float = Field(default=5.0, gt=0)
    """Longest translation in m: a place is as wide as the paper's widest spacing of views (1-5 m, section IV). Beyond
    it the pose may well be right, but its error grows with the distance, and a nearer keyframe says the same."""
    scale_share: float = Field(default=0.02, ge=0)
    """Standard deviation of the translation's length as a share of it, where odometry gave landmarks their scale."""
    systematic_px: float = Field(default=1.0, ge=0)
    """Standard deviation in px of what all matches of a pair share, so that no number of them averages it out: what
    calibration leaves (0.1-0.5 px over the image), rolling shutter, and landmarks that err together. It turns the
    camera by that angle, and moves it by that angle at the inliers' median depth."""


@dataclass(frozen=True, eq=False)
class Pose:
    """Verdict and pose of one pair of keyframes, between their cameras."""

    verdict: Verdict
    inliers: int
    spread: float
    match_from_query: Floats | None = None
    """(4, 4)."""
    covariance: Floats | None = None
    """(6, 6) rotation first, in the query's frame."""


def solve(
    landmarks: Landmarks,
    rows: np.ndarray,
    seen: Floats,
    seen_rho: tuple[Floats, Floats],
    image_share: Floats,
    camera: Camera,
    noise: LandmarkSettings,
    settings: MetricSettings,
    start: Floats | None = None,
) -> Pose:
    """The pose of the query's camera in the match's camera.

    Known landmarks `rows` (K,) were matched to query rays `seen` (K, 2), whose inverse depths `seen_rho` are (K,) in
    1/m and their variance (K,), NaN where unknown. `image_share` (K, 2) are the query's pixels as shares of its size.
    The pose `start`, where given and enough matches agree with it, is improved instead of one found anew.
    """
    focal_px, area_px = undistort.focal_px(camera), float(camera.width * camera.height)
    points = np.column_stack([landmarks.rays[rows], landmarks.rho[rows]])
    bearing = np.column_stack([points[:, :2], np.ones(len(points))])
    sigma = noise.pixel_sigma / focal_px
    cloud, near = bearing / points[:, 2:], settings.ransac_px / focal_px
    inlier = np.zeros(len(rows), bool)
    if start is not None:
        inlier = p3p_ransac.inliers(se3.inverse(start), cloud, seen, near)
    if start is None or inlier.sum() < settings.min_inliers:
        found = p3p_ransac.find_pose(cloud, seen, near, settings.ransac_rounds)
        if found is None:
            return Pose(Verdict.TOO_FEW_INLIERS, 0, 0.0)
        start, inlier = se3.inverse(found[0]), found[1]
    covariance = landmarks.covariance[rows]
    match_from_query, hessian, excess = start, np.eye(6), 1.0
    for _ in range(_ROUNDS):  # the pose decides who agrees, those decide the pose; it settles in two or three
        if inlier.sum() < _SAMPLE + 1:
            break
        chosen = (points[inlier], covariance[inlier], seen[inlier], seen_rho[0][inlier], seen_rho[1][inlier])
        match_from_query, hessian, excess = pose_refinement.fit(match_from_query, *chosen, sigma)
        distance, error = pose_refinement.agreement(match_from_query, points, covariance, seen, sigma)
        before, inlier = inlier, (distance < _CHI2_2) & (error < settings.max_error_px / focal_px)
        if np.array_equal(inlier, before):
            break
    count = int(inlier.sum())
    radius = settings.max_error_px
    alarms = a_contrario.log10_false_alarms(len(rows), count, _SAMPLE, _MODELS, np.pi * radius**2 / area_px)
    if (
        not np.isfinite(match_from_query).all()
        or count < max(settings.min_inliers, settings.min_share * len(rows))
        or alarms > settings.log10_false_alarms
    ):
        return Pose(Verdict.TOO_FEW_INLIERS, count, 0.0)
    spread = float(np.prod(np.ptp(image_share[inlier], axis=0)))
    if spread < settings.min_spread:
        return Pose(Verdict.POOR_SPREAD, count, spread)
    depth_m = float(np.median(1.0 / points[inlier, 2]))
    moved = match_from_query[:3, 3]
    if np.linalg.norm(moved) > settings.max_depths * depth_m:
        return Pose(Verdict.IMPLAUSIBLE_POSE, count, spread)
    if np.linalg.norm(moved) > settings.max_distance_m:
        return Pose(Verdict.TOO_FAR, count, spread)
    if np.linalg.cond(hessian) > _SINGULAR:  # such as landmarks on one line through the camera
        return Pose(Verdict.DEGENERATE_MOTION, count, spread)
    pose_covariance = np.asarray(np.linalg.inv(hessian), np.float64) * max(1.0, excess)
    shared = settings.systematic_px / focal_px
    pose_covariance[:3, :3] += shared**2 * np.eye(3)
    pose_covariance[3:, 3:] += (shared * depth_m) ** 2 * np.eye(3)
    if not landmarks.from_depth:  # a wrong scale of the landmarks stretches the translation alone, along itself
        along = match_from_query[:3, :3].T @ moved * settings.scale_share
        pose_covariance[3:, 3:] += np.outer(along, along)
    return Pose(Verdict.ACCEPTED, count, spread, match_from_query, pose_covariance)
