"""The pose between two keyframes from matches of one's features to the other's landmarks, with honest information."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from pydantic import Field

from vplog import geometry
from vplog.data import Verdict
from vplog.loops import chance, undistort
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
_HUBER = 1.5
"""Sigmas beyond which an error counts linearly: 96 % as efficient as least squares on Gaussian errors (Huber 1981)."""
_STEPS = 5
"""Gauss-Newton steps each time; RANSAC starts within the linear range and two or three converge."""
_CONVERGED = 1e-3
"""Squared length of a step in sigmas of the pose: a thirtieth of a sigma decides nothing that follows."""
_SINGULAR = 1e12
"""Condition of the Hessian beyond which its inverse has no digit left that a sensor could have measured."""


class MetricSettings(Settings):
    """When a pose between two keyframes is believed, and how much."""

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
    """Most samples of RANSAC: a pose is found with 99 % where 31 % of the matches are right, as OpenCV draws a fourth
    match to choose among the poses of three."""
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
    """What geometry says of one pair of keyframes; frames are the cameras', later the bodies'."""

    verdict: Verdict
    inliers: int
    spread: float
    match_from_query: Floats | None = None
    """(4, 4)."""
    covariance: Floats | None = None
    """(6, 6) rotation first, in the query's frame."""
    information: Floats | None = None
    """(6, 6) in place of a covariance, where the translation's length is not known."""


def solve(
    landmarks: Landmarks,
    rows: np.ndarray,
    seen: Floats,
    seen_rho: tuple[Floats, Floats],
    image_share: Floats,
    camera: Camera,
    noise: LandmarkSettings,
    settings: MetricSettings,
) -> Pose:
    """The pose of the query's camera in the match's camera.

    Known landmarks `rows` (K,) were matched to query rays `seen` (K, 2), whose inverse depths `seen_rho` are (K,) in
    1/m and their variance (K,), NaN where unknown. `image_share` (K, 2) are the query's pixels as shares of its size.
    """
    focal_px, area_px = undistort.focal_px(camera), float(camera.width * camera.height)
    points = np.column_stack([landmarks.rays[rows], landmarks.rho[rows]])
    bearing = np.column_stack([points[:, :2], np.ones(len(points))])
    found, turn, shift, _ = cv2.solvePnPRansac(
        bearing / points[:, 2:],
        seen,
        np.eye(3),
        None,
        iterationsCount=settings.ransac_rounds,
        reprojectionError=settings.ransac_px / focal_px,
        confidence=0.99,
        flags=cv2.SOLVEPNP_AP3P,
    )
    if not found or not np.isfinite(turn).all() or not np.isfinite(shift).all():
        return Pose(Verdict.TOO_FEW_INLIERS, 0, 0.0)
    turn, shift = np.asarray(turn, np.float64)[:, 0], np.asarray(shift, np.float64)[:, 0]
    query_from_match = geometry.pose(geometry.so3_exp(turn), shift)
    match_from_query = geometry.inverse(query_from_match)
    covariance = landmarks.covariance[rows]
    sigma = noise.pixel_sigma / focal_px
    inlier = np.zeros(len(rows), bool)
    hessian, excess = np.eye(6), 1.0
    for _ in range(3):  # the pose decides who agrees, those decide the pose; it settles in two
        distance, error = _agreement(match_from_query, points, covariance, seen, sigma)
        before, inlier = inlier, (distance < _CHI2_2) & (error < settings.max_error_px / focal_px)
        if inlier.sum() < _SAMPLE + 1 or np.array_equal(inlier, before):
            break
        chosen = (points[inlier], covariance[inlier], seen[inlier], seen_rho[0][inlier], seen_rho[1][inlier])
        match_from_query, hessian, excess = _refine(match_from_query, *chosen, sigma)
    count = int(inlier.sum())
    radius = settings.max_error_px
    alarms = chance.log10_false_alarms(len(rows), count, _SAMPLE, _MODELS, np.pi * radius**2 / area_px)
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


def _refine(
    match_from_query: Floats,
    points: Floats,
    covariance: Floats,
    seen: Floats,
    seen_rho: Floats,
    seen_variance: Floats,
    sigma: float,
) -> tuple[Floats, Floats, float]:
    """Gauss-Newton over all inliers: the pose, its Hessian (6, 6) and the residual variance over its expectation."""
    deep = np.isfinite(seen_rho)
    measured = np.column_stack([seen, np.where(deep, seen_rho, 0.0)])
    noise = np.zeros((len(points), 3, 3))
    noise[:, 0, 0] = noise[:, 1, 1] = sigma**2
    noise[:, 2, 2] = np.where(deep, seen_variance, 1.0)
    freedom = np.where(deep, 3.0, 2.0)
    hessian, excess = np.eye(6), 1.0
    for _ in range(_STEPS):
        predicted, by_pose, by_point = _predict(match_from_query, points)
        total = noise + by_point @ covariance @ np.swapaxes(by_point, 1, 2)
        total[~deep, 2, :] = total[~deep, :, 2] = 0.0  # no depth was measured: only the two image errors speak
        total[~deep, 2, 2] = 1.0
        lost = ~np.isfinite(predicted).all(axis=1)  # a step took them behind the query: they say nothing
        by_pose[lost], predicted[lost], total[lost] = 0.0, measured[lost], np.eye(3)
        residual = predicted - measured
        residual[~deep, 2] = 0.0
        by_pose[~deep, 2] = 0.0
        weight = np.linalg.inv(total)
        squared = ((weight @ residual[..., None])[..., 0] * residual).sum(axis=1)
        robust = 1.0 / np.maximum(1.0, np.sqrt(squared / freedom) / _HUBER)
        weighted = (robust[:, None, None] * weight @ by_pose).reshape(-1, 6)
        hessian = weighted.T @ by_pose.reshape(-1, 6)
        gradient = weighted.T @ residual.ravel()
        excess = float((robust * squared).sum() / max(freedom.sum() - 6.0, 1.0))
        step = -np.linalg.lstsq(hessian, gradient, rcond=1e-12)[0]
        match_from_query = match_from_query @ geometry.exp(step)
        if step @ hessian @ step < _CONVERGED:
            break
    return match_from_query, hessian, excess


def _predict(match_from_query: Floats, points: Floats) -> tuple[Floats, Floats, Floats]:
    """Where landmarks (K, 3) are seen: (x, y, rho) in the query, with derivatives by pose (K, 3, 6) and landmark.

    The pose moves as match_from_query exp(d).
    """
    query_from_match = geometry.inverse(match_from_query)
    rotation, translation = query_from_match[:3, :3], query_from_match[:3, 3]
    rho = points[:, 2]
    seen = np.column_stack([points[:, :2], np.ones(len(points))]) @ rotation.T + rho[:, None] * translation
    depth = np.where(seen[:, 2] > 0, seen[:, 2], np.nan)  # behind the query: nothing is predicted
    predicted = np.column_stack([seen[:, :2], rho]) / depth[:, None]
    by_seen = np.zeros((len(points), 3, 3))
    by_seen[:, 0, 0] = by_seen[:, 1, 1] = 1.0 / depth
    by_seen[:, :, 2] = -predicted / depth[:, None]
    by_pose = np.concatenate([by_seen @ geometry.skew(seen), -by_seen * rho[:, None, None]], axis=2)
    by_point = by_seen @ np.column_stack([rotation[:, :2], translation])
    by_point[:, 2, 2] += 1.0 / depth
    return predicted, by_pose, by_point


def _agreement(
    match_from_query: Floats, points: Floats, covariance: Floats, seen: Floats, sigma: float
) -> tuple[Floats, Floats]:
    """Squared Mahalanobis distance (K,) and length (K,) of the image errors, NaN behind the query."""
    predicted, _, by_point = _predict(match_from_query, points)
    error = predicted[:, :2] - seen
    by_point = by_point[:, :2]
    total = by_point @ covariance @ np.swapaxes(by_point, 1, 2)
    total[:, [0, 1], [0, 1]] += sigma**2
    determinant = total[:, 0, 0] * total[:, 1, 1] - total[:, 0, 1] ** 2
    squared = (
        total[:, 1, 1] * error[:, 0] ** 2
        - 2.0 * total[:, 0, 1] * error[:, 0] * error[:, 1]
        + total[:, 0, 0] * error[:, 1] ** 2
    ) / determinant
    return squared, np.linalg.norm(error, axis=1)
