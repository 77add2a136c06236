"""One candidate closure: matched, solved, solved again the other way round."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from vplog.data import Verdict
from vplog.features.matching import MatchSettings, first_matches, match_features
from vplog.geometry import se3
from vplog.loops import reverse_check, undistort, verify_epipolar, verify_metric
from vplog.loops.calibration import CalibrationSettings, motion_covariance
from vplog.loops.landmarks import Landmarks, LandmarkSettings, inverse_depth, landmarks_of
from vplog.loops.verify_epipolar import EpipolarSettings
from vplog.loops.verify_metric import MetricSettings, Pose
from vplog.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vplog.data import Camera, Features, Floats, Keyframes
    from vplog.loops.landmarks import FeaturesOf


_ANY_POSE = {"min_inliers": 6, "min_spread": 0.0, "max_depths": np.inf, "max_distance_m": np.inf}
"""Metric settings under which a pose is found wherever chance does not explain it."""


class VerifySettings(Settings):
    """How a proposed closure is checked."""

    min_matches: int = Field(default=25, ge=0)
    """Feature matches below which two images are not looked at further. Of the 20 that must agree in the end a fifth
    has no landmark, and two images of different places share 16 by chance, seldom 25."""
    matching: MatchSettings = MatchSettings()
    """Which features are taken for the same point."""
    landmarks: LandmarkSettings = LandmarkSettings()
    """How the map frame's features get their 3D position."""
    calibration: CalibrationSettings = CalibrationSettings()
    """How far a calibrated camera's rotations and stamps are trusted."""
    metric: MetricSettings = MetricSettings()
    """When a pose is accepted, for a calibrated camera."""
    both_ways: bool = True
    """Whether an accepted pose is verified in reverse too, the match in the query's landmarks: the
    two must agree within their joint noise, and make one closure together."""
    epipolar: EpipolarSettings = EpipolarSettings()
    """When two images agree, for an uncalibrated camera."""


@dataclass(frozen=True, eq=False)
class Drive:
    """What every candidate of a drive is checked with."""

    keyframes: Keyframes
    camera: Camera
    features: FeaturesOf
    settings: VerifySettings
    stereo: bool
    """Whether depths are those of a stereo pair."""


@dataclass(frozen=True, eq=False)
class Row:
    """One candidate's part of the ledger."""

    matches: int
    landmarks: int
    pose: Pose
    scale: str = "none"
    pairs: tuple[np.ndarray, np.ndarray] | None = None
    """Feature rows (K,) of the query and of the match that were matched, where a pose was believed."""
    reverse_inliers: int = -1


def check_queries(later: Drive, earlier: Drive, match: int, queries: Sequence[int]) -> list[Row]:
    """The queries of one drive that were proposed for one frame of a drive before it, or of the same one.

    The frame's landmarks are made once, if at all.
    """
    settings = later.settings
    theirs = earlier.features(match)
    known = None
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
            if known is None:
                known = _landmarks(earlier, match)
            rows.append(_check_metric(later, own, mine, found, known, earlier.stereo, settings.metric))
    return rows


def check_back(
    later: Drive, earlier: Drive, query: int, matches: Sequence[int], rows: Sequence[Row], share: float
) -> list[Row]:
    """The believed rows of one query with what the query's own landmarks say of them.

    `share` is the calibration's, by which both ways may be bent. Where the query has too few landmarks, one way has to
    do, and the row keeps `reverse_inliers` -1.
    """
    known = _landmarks(later, query)
    # where and how far apart the views are is decided already; what is asked is only whether the same pose comes out
    lenient = later.settings.metric.model_copy(update=_ANY_POSE)
    result = []
    for match, row in zip(matches, rows, strict=True):
        if row.pairs is None:
            raise ValueError("a row without a pose was to be checked the other way round")
        mine, found = row.pairs
        there = None if row.pose.match_from_query is None else se3.inverse(row.pose.match_from_query)
        back = _check_metric(earlier, earlier.features(match), found, mine, known, later.stereo, lenient, there)
        if back.landmarks < later.settings.metric.min_inliers:
            result.append(row)
        else:
            result.append(replace(row, pose=_of_both(row.pose, back.pose, share), reverse_inliers=back.pose.inliers))
    return result


def _landmarks(drive: Drive, row: int) -> Landmarks:
    settings = drive.settings
    return landmarks_of(row, drive.keyframes, drive.camera, drive.features, settings.matching, settings.landmarks)


def _check_metric(
    drive: Drive,
    own: Features,
    mine: np.ndarray,
    found: np.ndarray,
    known: Landmarks,
    stereo: bool,
    metric: MetricSettings,
    start: Floats | None = None,
) -> Row:
    """Features `mine` (K,) of one frame of `drive` against the landmarks of `found` (K,) in the other frame, whose
    depths, if it has any, are of a stereo pair or not; `start` is a pose to try first."""
    settings, camera = drive.settings, drive.camera
    rays = undistort.rays(camera, own.points[mine])
    usable = known.known[found] & np.isfinite(rays).all(axis=1)
    matches, count = len(mine), int(usable.sum())
    if count < metric.min_inliers:
        # features were followed, but none moved enough against the others to have a depth
        still = not known.from_depth and known.tracked >= settings.min_matches > known.known.sum()
        verdict = Verdict.DEGENERATE_MOTION if still else Verdict.TOO_FEW_LANDMARKS
        return Row(matches, count, Pose(verdict, 0, 0.0))
    depth_m = own.depth_m[mine[usable]].astype(np.float64)
    pose = verify_metric.solve(
        known,
        found[usable],
        rays[usable],
        inverse_depth(depth_m, settings.landmarks),
        own.points[mine[usable]] / [own.width, own.height],
        camera,
        settings.landmarks,
        metric,
        start,
    )
    if pose.verdict is not Verdict.ACCEPTED:
        return Row(matches, count, pose)
    scale = ("stereo" if stereo else "depth") if known.from_depth else "odometry"
    return Row(matches, count, pose, scale, (mine.astype(np.int32), found.astype(np.int32)))


def _of_both(pose: Pose, back: Pose, share: float) -> Pose:
    """The pose of the query in the match and that of the match in the query as one, or their disagreement."""
    if pose.match_from_query is None or pose.covariance is None:
        raise ValueError("a row without a pose was to be checked the other way round")
    apart = replace(pose, verdict=Verdict.INCONSISTENT, match_from_query=None, covariance=None)
    if back.match_from_query is None or back.covariance is None:
        return apart
    other, covariance = reverse_check.reversed_pose(back.match_from_query, back.covariance)
    # a wrong calibration bends the two ways differently, as their depths differ
    bent = pose.covariance + motion_covariance(pose.match_from_query, share)
    if not reverse_check.agree(pose.match_from_query, bent, other, covariance):
        return apart
    fused, joint = reverse_check.together(pose.match_from_query, pose.covariance, other, covariance)
    return replace(pose, match_from_query=fused, covariance=joint)
