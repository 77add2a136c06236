"""The pose between two keyframes from matches of one's features to the other's landmarks, with its covariance.

P3P in RANSAC is OpenCV's USAC: PoseLib is as accurate and faster on few right matches, but has no wheel for Linux on
ARM. Its local optimisation takes two thirds of the time and is left out where most and many matches agree without
it, as the pose is refitted to its inliers in any case.
"""

from __future__ import annotations

from dataclasses import dataclass
from math import comb, log10

import cv2
import numpy as np
from pydantic import Field

from vplog.data import Bools, Camera, Features, Float32s, Floats, Ints, Verdict
from vplog.geometry import se3
from vplog.loops import pose_refinement, undistort
from vplog.loops.landmarks import Landmarks, LandmarkSettings, inverse_depth
from vplog.loops.pose_refinement import LandmarkMatches
from vplog.settings import Settings

SAMPLE = 3
"""Points that determine a calibrated camera's pose: P3P; a fourth selects among its up to four solutions."""
MODELS = 4
"""Poses that three points allow: Gao et al. 2003."""
_CONFIDENCE = 0.99
"""RANSAC ends when three right matches would have been drawn with this probability."""
_MOST, _MANY = 0.5, 60
"""Share of the matches that agree with a pose, and their number, from which on it needs no local optimisation."""
CHI2_2 = 9.210
"""Mahalanobis^2 of a 2D error that 1 % of right matches exceed: chi-square, 2 degrees of freedom, 99 %."""
_ROUNDS = 8
"""Most rounds of refitting the pose to its inliers and selecting inliers by the pose."""
SINGULAR = 1e12
"""Condition of the Hessian beyond which its inverse has no digit left that a sensor could have measured."""


class MetricSettings(Settings):
    """Acceptance of a pose between two keyframes, and its covariance."""

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
    it the pose may well be right, but its error grows with the distance, and a nearer keyframe constrains it better."""
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


def observe(
    landmarks: Landmarks, rows: Ints, rays: Floats, depth_m: Float32s, camera: Camera, settings: LandmarkSettings
) -> LandmarkMatches:
    """Known landmarks `rows` (K,) matched to rays (K, 2) of a camera, with measured depths (K,) in m, NaN unknown."""
    return LandmarkMatches(
        np.column_stack([landmarks.rays[rows], landmarks.rho[rows]]),
        landmarks.covariance[rows],
        rays,
        undistort.noise_of_rays(camera, rays, settings.pixel_sigma),
        *inverse_depth(depth_m.astype(np.float64), settings),
    )


def solve(
    landmarks: Landmarks,
    rows: Ints,
    query: Features,
    rays: Floats,
    camera: Camera,
    noise: LandmarkSettings,
    settings: MetricSettings,
    start: Floats | None = None,
) -> Pose:
    """The pose of the query's camera in the match's camera, by its known landmarks `rows` (K,) that the `query`'s
    features (K,) match, whose rays are (K, 2).

    The pose `start`, where given and enough matches agree with it, is improved instead of sampling one.
    """
    focal_px, area_px, pixel_sigma = undistort.focal_px(camera), float(camera.width * camera.height), noise.pixel_sigma
    matches = observe(landmarks, rows, rays, query.depth_m, camera, noise)
    points, cloud = matches.points, matches.cloud
    # as long in rays as for most matches: what is nearer to the centre of a wide view is sorted out next
    near = settings.ransac_px / pixel_sigma * float(np.median(np.linalg.det(matches.noise))) ** 0.25
    inlier = np.zeros(len(points), bool)
    if start is not None:
        inlier = inliers(se3.inverse(start), cloud, matches.rays, near)
    if start is None or inlier.sum() < settings.min_inliers:
        found = find_pose(cloud, matches.rays, near, settings.ransac_rounds)
        if found is None:
            return Pose(Verdict.TOO_FEW_INLIERS, 0, 0.0)
        start, inlier = se3.inverse(found[0]), found[1]
    match_from_query, hessian, excess, inlier = refit(start, inlier, matches, settings.max_error_px / pixel_sigma)
    count = int(inlier.sum())
    radius = settings.max_error_px
    alarms = log10_false_alarms(len(points), count, SAMPLE, MODELS, np.pi * radius**2 / area_px)
    if (
        not np.isfinite(match_from_query).all()
        or count < max(settings.min_inliers, settings.min_share * len(points))
        or alarms > settings.log10_false_alarms
    ):
        return Pose(Verdict.TOO_FEW_INLIERS, count, 0.0)
    spread = float(np.prod(np.ptp(query.points[inlier] / [query.width, query.height], axis=0)))
    if spread < settings.min_spread:
        return Pose(Verdict.POOR_SPREAD, count, spread)
    depth_m = float(np.median(1.0 / points[inlier, 2]))
    moved = match_from_query[:3, 3]
    if np.linalg.norm(moved) > settings.max_depths * depth_m:
        return Pose(Verdict.IMPLAUSIBLE_POSE, count, spread)
    if np.linalg.norm(moved) > settings.max_distance_m:
        return Pose(Verdict.TOO_FAR, count, spread)
    if np.linalg.cond(hessian) > SINGULAR:  # such as landmarks on one line through the camera
        return Pose(Verdict.DEGENERATE_MOTION, count, spread)
    pose_covariance = np.asarray(np.linalg.inv(hessian), np.float64) * max(1.0, excess)
    shared = settings.systematic_px / focal_px
    pose_covariance[:3, :3] += shared**2 * np.eye(3)
    pose_covariance[3:, 3:] += (shared * depth_m) ** 2 * np.eye(3)
    if not landmarks.from_depth:  # a wrong scale of the landmarks stretches the translation alone, along itself
        along = match_from_query[:3, :3].T @ moved * settings.scale_share
        pose_covariance[3:, 3:] += np.outer(along, along)
    return Pose(Verdict.ACCEPTED, count, spread, match_from_query, pose_covariance)


def refit(
    match_from_query: Floats, inlier: Bools, matches: LandmarkMatches, most_sigmas: float
) -> tuple[Floats, Floats, float, Bools]:
    """The pose refitted to its inliers (K,), its Hessian, the residual variance over its expectation, and its inliers,
    which lie within `most_sigmas` of the pixels' noise."""
    hessian, excess = np.eye(6), 1.0
    for _ in range(_ROUNDS):  # refit to the inliers, select inliers by the refit pose; converges in two or three
        if inlier.sum() < SAMPLE + 1:
            break
        match_from_query, hessian, excess = pose_refinement.fit(match_from_query, matches.rows(inlier))
        distance, alone = pose_refinement.agreement(match_from_query, matches)
        before, inlier = inlier, (distance < CHI2_2) & (alone < most_sigmas**2)
        if np.array_equal(inlier, before):
            break
    return match_from_query, hessian, excess, inlier


def find_pose(points: Floats, rays: Floats, radius: float, rounds: int) -> tuple[Floats, np.ndarray] | None:
    """query_from_match (4, 4) and its inliers (K,) bool; None where no three points fix a pose.

    Points (K, 3) in the match's camera were observed as rays (K, 2) by the query; those within `radius` of their ray,
    in normalised image coordinates, are inliers. At most `rounds` samples are drawn (Fischler & Bolles 1981), the same
    ones for the same matches.
    """
    if len(points) <= SAMPLE:
        return None
    usac = cv2.UsacParams()
    usac.threshold, usac.confidence, usac.maxIterations = radius, _CONFIDENCE, rounds
    result = None
    for usac.loMethod in (cv2.LOCAL_OPTIM_NULL, cv2.LOCAL_OPTIM_INNER_LO):
        try:
            found, _, turn, moved, _ = cv2.solvePnPRansac(points, rays, np.eye(3), None, params=usac)
        except cv2.error:  # points on one line
            return None
        if not found or not (np.isfinite(turn).all() and np.isfinite(moved).all()):
            continue
        rotation = np.asarray(cv2.Rodrigues(turn)[0], np.float64)
        pose = se3.pose(rotation, np.asarray(moved, np.float64).ravel())
        result = pose, inliers(pose, points, rays, radius)
        if result[1].sum() >= max(_MOST * len(points), _MANY):
            break
    return result


def inliers(query_from_match: Floats, points: Floats, rays: Floats, radius: float) -> np.ndarray:
    """(K,) bool: the matches in front of the camera and within `radius` of where the pose (4, 4) projects them."""
    x, y, z = se3.transform(query_from_match, points).T
    with np.errstate(divide="ignore", invalid="ignore"):
        return (z > 0) & ((x / z - rays[:, 0]) ** 2 + (y / z - rays[:, 1]) ** 2 < radius**2)


def log10_false_alarms(matches: int, inliers: int, sample: int, models: int, share: float) -> float:
    """log10 of the number of false alarms of a model that `inliers` of `matches` agree with.

    Moisan & Stival 2004, proposition 2; Moulon, Monasse & Marlet 2012, eq. 1. `sample` matches fix a model, in up to
    `models` ways; a wrong match agrees with a given model with probability `share` (0..1), the share of the image that
    lies within the tolerance.
    """
    if inliers <= sample:
        return log10(max(models, 1)) + log10(max(matches, 1))  # the sample alone proves nothing
    return (
        log10(models)
        + log10(max(matches - sample, 1))
        + log10(comb(matches, inliers))
        + log10(comb(inliers, sample))
        + (inliers - sample) * log10(min(max(share, 1e-300), 1.0))
    )
