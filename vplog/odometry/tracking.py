"""One frame followed from a reference frame: its points found again, and its pose by the landmarks they are of."""

from __future__ import annotations

from dataclasses import dataclass, replace

import cv2
import numpy as np
from scipy.spatial import KDTree

from vplog.data import Float32s, Floats, Frame
from vplog.features.extraction import describe
from vplog.features.matching import MatchSettings, match_features
from vplog.features.sift import SiftSettings
from vplog.geometry import se3
from vplog.loops import undistort
from vplog.loops.pose_refinement import LandmarkMatches
from vplog.loops.verify_metric import MetricSettings, find_pose, log10_false_alarms, refit
from vplog.odometry.sensor import Points, Sensor, follow

_CORNERS = 300
"""Points of a frame: RTAB-Map's and VINS' 150 to 1000; more cost time, and hardly sharpen a pose."""
_QUALITY = 0.005
"""Least corner response as a share of the image's best: a low bound, as their distance limits their number."""
_LARGE = 1 << 20
"""px of an image from which on its corners are those of half of it: they are followed as patches, so that a pixel
does not matter, and looking for them in a full HD image takes longer than following them."""
_SPREAD = 0.6
"""Corners are no closer than this share of the distance at which they would cover the image evenly."""
_SETTINGS = MetricSettings()
_CHANCE = 3, 4
"""Points that fix a pose, and poses that they allow (P3P)."""
_EPIPOLAR_PX = 3.0
"""px by which a point without a depth may miss its epipolar line: four sigmas of a corner."""
_SINGULAR = 1e12
"""Condition of the Hessian beyond which its inverse has no digit left that a sensor could have measured."""


@dataclass(frozen=True, eq=False)
class ReferenceFrame:
    """A frame that later ones are followed from."""

    frame: Frame
    ids: np.ndarray
    """(K,) int64 numbers of the landmarks."""
    points: Points
    """Their places in the image; rho as estimated from all views, not as measured here."""
    free: int
    """The least number that no landmark has."""

    def extended(self, points: Points) -> ReferenceFrame:
        """With further points, which are new landmarks."""
        ids = np.concatenate([self.ids, self.free + np.arange(len(points.px))])
        return ReferenceFrame(self.frame, ids, self.points.joined(points), self.free + len(points.px))

    @property
    def covariance(self) -> Floats:
        """(K, 3, 3) of (x, y, rho)."""
        result = np.zeros((len(self.ids), 3, 3))
        result[:, :2, :2] = self.points.noise
        result[:, 2, 2] = self.points.variance
        return result


@dataclass(frozen=True, eq=False)
class Motion:
    """A frame's pose by the reference."""

    reference_from_camera: Floats
    covariance: Floats
    """(6, 6) in the frame's camera."""
    rows: np.ndarray
    """(I,) int64 points of the reference that agree with it."""
    points: Points
    """(I,) where they lie in the frame."""
    systematic: Floats
    """(6, 6) covariance by what all points err in together, which no number of them averages out."""


def corners(frame: Frame, taken: Float32s) -> Float32s:
    """(K, 2) px of corners at a distance from those `taken`, the strongest first: as many as are left to _CORNERS."""
    image, times = frame.image, 1
    mask = np.full(image.shape, 255, np.uint8) * (True if frame.mask is None else frame.mask)
    while image.size > _LARGE:
        image, times = cv2.resize(image, None, fx=0.5, fy=0.5, interpolation=cv2.INTER_AREA), 2 * times
        mask = cv2.resize(mask, image.shape[::-1], interpolation=cv2.INTER_NEAREST)
    apart = _SPREAD * np.sqrt(image.size / _CORNERS)
    for x, y in np.rint(taken / times).astype(int).tolist():
        cv2.circle(mask, (x, y), round(apart), 0, -1)
    left = _CORNERS - len(taken)
    found = cv2.goodFeaturesToTrack(image, left, _QUALITY, apart, mask=mask) if left > 0 else None
    if found is None:
        return np.zeros((0, 2), np.float32)
    return (np.asarray(found, np.float32).reshape(-1, 2) + np.float32(0.5)) * times - np.float32(0.5)


def track(
    reference: ReferenceFrame, frame: Frame, guess: Floats, sensor: Sensor
) -> tuple[ReferenceFrame, Motion] | None:
    """The motion to a frame: points followed from where `guess`, reference_from_camera, has them, else from where they
    were, else matched as SIFT features, which the reference returned then has, too; None where the frame is lost."""
    for px in (_predicted(reference, guess, sensor), reference.points.px):
        found = follow(reference.frame.image, frame.image, reference.points.px, px)
        rows = np.flatnonzero(np.isfinite(found).all(axis=1))
        observed = sensor.measure(frame, found[rows])
        if (motion := solve(reference, rows, observed, sensor)) is not None:
            return reference, motion if sensor.metric else _with_unplaced(motion, reference, rows, observed, sensor)
    if not sensor.metric:
        return None
    first, second = rematch(reference.frame, frame, sensor)
    rows = len(reference.ids) + np.arange(len(first.px))
    extended = reference.extended(first)
    motion = solve(extended, rows, second, sensor)
    return None if motion is None else (extended, motion)


def _with_unplaced(
    motion: Motion, reference: ReferenceFrame, rows: np.ndarray, observed: Points, sensor: Sensor
) -> Motion:
    """The motion with further points: those of the reference without a depth that were followed along the epipolar
    line of the motion."""
    R, t = motion.reference_from_camera[:3, :3], motion.reference_from_camera[:3, 3]
    sound = np.isfinite(observed.rays).all(axis=1) & np.isfinite(observed.noise).all(axis=(1, 2))
    unplaced = np.flatnonzero(np.isnan(reference.points.rho[rows]) & sound)
    first = np.column_stack([reference.points.rays[rows[unplaced]], np.ones(len(unplaced))])
    second = np.column_stack([observed.rays[unplaced], np.ones(len(unplaced))])
    E = se3.skew(t[None])[0] @ R
    line = first @ E  # of the second view
    with np.errstate(divide="ignore", invalid="ignore"):
        off = np.abs((line * second).sum(axis=1)) / np.linalg.norm(line[:, :2], axis=1)
    near = unplaced[~(off > _EPIPOLAR_PX / sensor.focal_px)]
    return replace(
        motion, rows=np.concatenate([motion.rows, rows[near]]), points=motion.points.joined(observed.rows(near))
    )


def rematch(reference: Frame, frame: Frame, sensor: Sensor) -> tuple[Points, Points]:
    """SIFT features that match, with a depth in the first frame, as points of the one and of the other."""
    a, b = (describe(SiftSettings(), one) for one in (reference, frame))
    mine, theirs = match_features(a, b, MatchSettings())
    first, second = (
        sensor.measure(one, np.ascontiguousarray(features.points[rows]))
        for one, features, rows in ((reference, a, mine), (frame, b, theirs))
    )
    known = np.flatnonzero(np.isfinite(np.column_stack([first.rho, first.rays])).all(axis=1))
    return first.rows(known), second.rows(known)


def solve(reference: ReferenceFrame, rows: np.ndarray, observed: Points, sensor: Sensor) -> Motion | None:
    """The motion by points `rows` (K,) of the reference, observed in a frame; None where they agree on none."""
    known = np.isfinite(np.column_stack([observed.rays, observed.noise.reshape(-1, 4), reference.points.rho[rows]]))
    valid = np.flatnonzero(known.all(axis=1))
    rows, observed = rows[valid], observed.rows(valid)
    points = reference.points.rows(rows)
    near = _SETTINGS.ransac_px / sensor.focal_px
    found = find_pose(cloud(points), observed.rays, near, _SETTINGS.ransac_rounds)
    if found is None:
        return None
    xyrho = np.column_stack([points.rays, points.rho])
    variance = np.nan_to_num(observed.variance)
    matches = LandmarkMatches(xyrho, reference.covariance[rows], observed.rays, observed.noise, observed.rho, variance)
    most = _SETTINGS.max_error_px / sensor.pixel_sigma
    pose, hessian, excess, inlier = refit(se3.inverse(found[0]), found[1], matches, most)
    count, area = int(inlier.sum()), float(sensor.camera.width * sensor.camera.height)
    alarms = log10_false_alarms(len(rows), count, *_CHANCE, np.pi * _SETTINGS.max_error_px**2 / area)
    if count < max(_SETTINGS.min_inliers, _SETTINGS.min_share * len(rows)) or alarms > _SETTINGS.log10_false_alarms:
        return None
    if not np.isfinite(pose).all() or np.linalg.cond(hessian) > _SINGULAR:
        return None
    covariance = np.asarray(np.linalg.inv(hessian) * max(1.0, excess), np.float64)
    shared, depth_m = _SETTINGS.systematic_px / sensor.focal_px, float(np.median(1.0 / points.rho[inlier]))
    systematic = np.diag([*[shared**2] * 3, *[(shared * depth_m) ** 2] * 3])
    return Motion(pose, covariance, rows[inlier], observed.rows(inlier), systematic)


def _predicted(reference: ReferenceFrame, guess: Floats, sensor: Sensor) -> Float32s:
    """(K, 2) px at which the frame shows the landmarks by a guess of its pose; where it does not, as the reference."""
    at = se3.transform(se3.inverse(guess), cloud(_placed(reference.points)))
    px = undistort.project(sensor.camera, at).astype(np.float32)
    size = np.array([sensor.camera.width, sensor.camera.height], np.float32)
    inside = np.logical_and.reduce(np.isfinite(px) & (px > 0) & (px < size), axis=1)
    return np.where(inside[:, None], px, reference.points.px)


def _placed(points: Points) -> Points:
    """The points, those without a depth at that of the nearest in the image that has one."""
    known = np.isfinite(points.rho)
    if known.all() or not known.any():
        return points
    _, nearest = KDTree(points.px[known]).query(points.px[~known])
    rho = points.rho.copy()
    rho[~known] = points.rho[known][nearest]
    return replace(points, rho=rho)


def cloud(points: Points) -> Floats:
    """(K, 3) m in the camera's frame."""
    return np.column_stack([points.rays, np.ones(len(points.rays))]) / points.rho[:, None]
