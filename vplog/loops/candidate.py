"""One candidate closure: matched, solved from query to match, and checked by the pose from match to query."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import cached_property, lru_cache

import numpy as np
from pydantic import Field

from vplog.data import Camera, Features, Floats, Keyframes, Verdict
from vplog.features.matching import MatchSettings, PairMatches, first_matches, match_features
from vplog.geometry import se3
from vplog.loops import undistort, verify_epipolar, verify_metric
from vplog.loops.calibration import CalibrationSettings, motion_covariance
from vplog.loops.landmarks import FeaturesOf, Landmarks, LandmarkSettings, landmarks_of
from vplog.loops.verify_epipolar import EpipolarSettings
from vplog.loops.verify_metric import MetricSettings, Pose
from vplog.settings import Settings

_LENIENT = {"min_inliers": 6, "min_share": 0.0, "min_spread": 0.0, "max_depths": np.inf, "max_distance_m": np.inf}
"""Metric settings under which a pose is found wherever chance does not explain it."""
_CHI2_6 = 22.458
"""Mahalanobis^2 of a 6D error that 0.1 % of right pairs exceed: chi-square, 6 degrees of freedom, 99.9 %."""
_REMEMBERED = 64
"""Keyframes whose landmarks are kept, some 10 MB."""
_BISECTIONS = 20
"""Bisections of the weight 0..1, to one in a million."""


class VerifySettings(Settings):
    """Verification of a proposed closure."""

    min_matches: int = Field(default=25, ge=0)
    """Feature matches below which a candidate is rejected before its pose is estimated. Of the 20 inliers required a
    fifth has no landmark, and two images of different places share 16 by chance, seldom 25."""
    always: int = Field(default=3, ge=1)
    """Best candidates of a keyframe that are verified in any case; the others are where one of these, or of those of
    the keyframe before or after, shares enough matches. Of a drive's keyframes most return to nowhere."""
    enough: int = Field(default=0, ge=0)
    """Accepted ones among these best from which the others of a keyframe are left out, 0 never: they tell the graph of
    a drive that passes a place often little more."""
    matching: MatchSettings = MatchSettings()
    """Feature matching."""
    landmarks: LandmarkSettings = LandmarkSettings()
    """Triangulation of the map frame's features."""
    calibration: CalibrationSettings = CalibrationSettings()
    """Trust in a calibrated camera's rotations and stamps."""
    metric: MetricSettings = MetricSettings()
    """Acceptance of a pose, for a calibrated camera."""
    both_ways: bool = True
    """Whether an accepted pose is verified in reverse too, the match in the query's landmarks: the
    two must agree within their joint noise, and make one closure together."""
    epipolar: EpipolarSettings = EpipolarSettings()
    """Acceptance of two images, for an uncalibrated camera."""


def lenient(settings: VerifySettings) -> VerifySettings:
    """Settings under which a pair that a person accepts has its pose wherever chance does not explain it."""
    metric = settings.metric.model_copy(update=_LENIENT)
    return settings.model_copy(update={"min_matches": metric.min_inliers, "both_ways": False, "metric": metric})


@dataclass(frozen=True, eq=False)
class Drive:
    """Keyframes, camera, features, settings and matches of a drive, as verification takes them."""

    keyframes: Keyframes
    camera: Camera
    features: FeaturesOf
    settings: VerifySettings
    matches: PairMatches

    @cached_property
    def landmarks(self) -> Callable[[int], Landmarks]:
        """The landmarks of a keyframe. They are made of five images, and neighbours ask for the same again."""

        def make(row: int) -> Landmarks:
            s = self.settings
            return landmarks_of(
                row, self.keyframes, self.camera, self.features, s.matching.features, self.matches, s.landmarks
            )

        return lru_cache(_REMEMBERED)(make)

    @property
    def stereo(self) -> bool:
        """Whether depths are those of a stereo pair."""
        return self.camera.baseline_m is not None


@dataclass(frozen=True, eq=False)
class Row:
    """One candidate's part of the ledger."""

    matches: int
    landmarks: int
    pose: Pose
    scale: str = "none"
    pairs: tuple[np.ndarray, np.ndarray] | None = None
    """Feature rows (K,) of the query and of the match that were matched, where a pose was accepted."""
    reverse_inliers: int = -1


def check_queries(later: Drive, earlier: Drive, match: int, queries: Sequence[int]) -> list[Row]:
    """The queries of one drive that were proposed for one frame of a drive before it, or of the same one.

    The frame's landmarks are made once, if at all.
    """
    settings = later.settings
    theirs = earlier.features(match)
    landmarks = None
    rows = []
    for query in queries:
        own = later.features(query)
        few = first_matches(own, theirs, settings.matching, settings.min_matches)
        if few is not None:
            rows.append(Row(few, 0, Pose(Verdict.TOO_FEW_MATCHES, 0, 0.0)))
            continue
        mine, found = match_features(own, theirs, settings.matching)
        if len(mine) < settings.min_matches:
            rows.append(Row(len(mine), 0, Pose(Verdict.TOO_FEW_MATCHES, 0, 0.0)))
        elif later.camera.matrix is None or earlier.camera.matrix is None:
            pose = verify_epipolar.solve(
                own.points[mine], theirs.points[found], own.width, own.height, settings.epipolar
            )
            rows.append(Row(len(mine), 0, pose))
        else:
            if landmarks is None:
                landmarks = earlier.landmarks(match)
            rows.append(_check_metric(later, own, (mine, found), landmarks, earlier.stereo, settings.metric))
    return rows


def check_reverse(
    later: Drive, earlier: Drive, query: int, matches: Sequence[int], rows: Sequence[Row], share: float
) -> list[Row]:
    """The accepted rows of one query, each fused with its pose in reverse, from the query's own landmarks.

    `share` is the calibration's error. Where the query has too few landmarks the row is unchanged.
    """
    landmarks = later.landmarks(query)
    # the limits have been checked in one direction; in reverse only the pose is compared
    metric = lenient(later.settings).metric
    result = []
    for match, row in zip(matches, rows, strict=True):
        if row.pairs is None:
            raise ValueError("only a row with a pose is checked in reverse")
        start = None if row.pose.match_from_query is None else se3.inverse(row.pose.match_from_query)
        theirs, pairs = earlier.features(match), (row.pairs[1], row.pairs[0])
        reverse = _check_metric(earlier, theirs, pairs, landmarks, later.stereo, metric, start)
        if reverse.landmarks < later.settings.metric.min_inliers:
            result.append(row)
        else:
            result.append(replace(row, pose=_fuse(row.pose, reverse.pose, share), reverse_inliers=reverse.pose.inliers))
    return result


def _check_metric(
    drive: Drive,
    own: Features,
    pairs: tuple[np.ndarray, np.ndarray],
    landmarks: Landmarks,
    stereo: bool,
    metric: MetricSettings,
    start: Floats | None = None,
) -> Row:
    """Features `own` of a frame of `drive`, rows pairs[0] (K,), against the landmarks of rows pairs[1] (K,) of the
    other frame, whose depths, if it has any, are of a stereo pair or not; `start` is a pose to try first."""
    settings, camera, (mine, found) = drive.settings, drive.camera, pairs
    rays = undistort.rays(camera, own.points[mine])
    usable = landmarks.known[found] & np.isfinite(rays).all(axis=1)
    matches, count = len(mine), int(usable.sum())
    if count < metric.min_inliers:
        # features were followed, but none moved enough against the others to have a depth
        still = not landmarks.from_depth and landmarks.tracked >= settings.min_matches > landmarks.known.sum()
        verdict = Verdict.DEGENERATE_MOTION if still else Verdict.TOO_FEW_LANDMARKS
        return Row(matches, count, Pose(verdict, 0, 0.0))
    query, noise = own.rows(mine[usable]), settings.landmarks
    pose = verify_metric.solve(landmarks, found[usable], query, rays[usable], camera, noise, metric, start)
    if pose.verdict is not Verdict.ACCEPTED:
        return Row(matches, count, pose)
    scale = ("stereo" if stereo else "depth") if landmarks.from_depth else "odometry"
    return Row(matches, count, pose, scale, (mine.astype(np.int32), found.astype(np.int32)))


def _fuse(pose: Pose, reverse: Pose, share: float) -> Pose:
    """The poses estimated from query to match and in reverse, fused; INCONSISTENT where they disagree."""
    if pose.match_from_query is None or pose.covariance is None:
        raise ValueError("only a row with a pose is checked in reverse")
    inconsistent = replace(pose, verdict=Verdict.INCONSISTENT, match_from_query=None, covariance=None)
    if reverse.match_from_query is None or reverse.covariance is None:
        return inconsistent
    other, covariance = reversed_pose(reverse.match_from_query, reverse.covariance)
    # a wrong calibration changes the two poses differently, as their depths differ
    wider = pose.covariance + motion_covariance(pose.match_from_query, share)
    if not agree(pose.match_from_query, wider, other, covariance):
        return inconsistent
    fused, joint = covariance_intersection(pose.match_from_query, pose.covariance, other, covariance)
    return replace(pose, match_from_query=fused, covariance=joint)


def reversed_pose(b_from_a: Floats, covariance: Floats) -> tuple[Floats, Floats]:
    """a_from_b (4, 4) of b_from_a, and its covariance (6, 6) moved from the frame of a to that of b.

    (T exp(d))^-1 = T^-1 exp(-Ad_T d).
    """
    Ad = se3.adjoint(b_from_a)
    return se3.inverse(b_from_a), Ad @ covariance @ Ad.T


def agree(pose: Floats, covariance: Floats, other: Floats, other_covariance: Floats) -> bool:
    """Whether two estimates a_from_b (4, 4), with covariances (6, 6) in b, are one pose within their joint noise.

    They share pixels, whose errors partly cancel in the difference: the sum of the covariances is generous, and what
    fails it is no noise.
    """
    difference = se3.log(se3.between(pose, other))
    return bool(difference @ np.linalg.solve(covariance + other_covariance, difference) < _CHI2_6)


def covariance_intersection(
    pose: Floats, covariance: Floats, other: Floats, other_covariance: Floats
) -> tuple[Floats, Floats]:
    """One estimate of two of a_from_b that may share any part of their errors: pose (4, 4), covariance (6, 6).

    Julier & Uhlmann 1997: information w A + (1 - w) B is never too sure, however the errors
    are correlated; w is that of the smallest determinant of the covariance. Where one estimate is better in every
    direction it is taken alone.
    """
    a, b = (np.asarray(np.linalg.inv(c), np.float64) for c in (covariance, other_covariance))
    # det(w A + (1 - w) B) = det(B) prod(1 + w (r - 1)) over the eigenvalues r of B^-1 A; its log is concave in w
    gain = np.linalg.eigvals(other_covariance @ a).real - 1.0
    low, high = 0.0, 1.0
    for _ in range(_BISECTIONS):
        w = (low + high) / 2.0
        low, high = (w, high) if (gain / (1.0 + w * gain)).sum() > 0 else (low, w)
    w = (low + high) / 2.0
    information = w * a + (1.0 - w) * b
    joint = np.asarray(np.linalg.inv(information), np.float64)
    step = joint @ ((1.0 - w) * b @ se3.log(se3.between(pose, other)))
    return pose @ se3.exp(step), joint
