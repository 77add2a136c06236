"""The ledger: every proposed closure checked by geometry, the rejected ones with their reason."""

from __future__ import annotations

import logging
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING

import cv2
import numpy as np
from pydantic import Field

from vplog import geometry
from vplog.data import Closures, Verdict
from vplog.loops import undistort, verify_epipolar, verify_metric
from vplog.loops.calibration import CalibrationSettings, motion_covariance, rotation_share, turning_pairs
from vplog.loops.landmarks import Landmarks, LandmarkSettings, inverse_depth, landmarks_of
from vplog.loops.matching import MatchSettings, match_features
from vplog.loops.verify_epipolar import EpipolarSettings
from vplog.loops.verify_metric import MetricSettings, Pose
from vplog.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.data import Camera, Features, Floats, Ints, Keyframes
    from vplog.loops.propose import Proposals

    FeaturesOf = Callable[[int], Features]
    Progress = Callable[[int, int], None]

_LOG = logging.getLogger(__name__)
_SUSPICIOUS_SHARE = 0.05
"""Disagreement of camera and odometry that is worth a word: five times a careful calibration's error."""


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
    """How far a calibrated camera's rotations are trusted."""
    metric: MetricSettings = MetricSettings()
    """When a pose is believed, for a calibrated camera."""
    epipolar: EpipolarSettings = EpipolarSettings()
    """When two images agree, for an uncalibrated camera."""


@dataclass(frozen=True, eq=False)
class _Row:
    """One candidate's part of the ledger."""

    matches: int
    landmarks: int
    pose: Pose


def verify(
    proposals: Proposals,
    keyframes: Keyframes,
    camera: Camera,
    features: FeaturesOf,
    settings: VerifySettings,
    threads: int = 1,
    progress: Progress | None = None,
) -> Closures:
    """The ledger of `proposals`, one row each, in their order.

    `features` gives the features of a keyframe row and is called from any thread. `progress(done, total)` counts
    candidates and is called from the caller's thread. The result does not depend on `threads`. Candidates are worked
    through by map frame, whose landmarks are made once, and only when some query shares enough features with it.

    Raises LogError for a calibrated camera with an unknown distortion model.
    """
    total = len(proposals.query)
    if camera.matrix is not None:
        undistort.focal_px(camera)  # refuse an unknown lens before the work, not within it
    order = np.lexsort([proposals.query, proposals.match])
    groups = np.split(order, np.flatnonzero(np.diff(proposals.match[order])) + 1) if total else []

    def check(match: int, queries: list[int]) -> list[_Row]:
        cv2.setNumThreads(1)  # one candidate, one thread; the pool is the only parallelism
        return _check_queries(match, queries, keyframes, camera, features, settings)

    rows: list[_Row | None] = [None] * total
    done = 0
    share = 0.0
    with ThreadPoolExecutor(max(threads, 1)) as pool:
        if camera.matrix is not None and total:
            pairs = turning_pairs(keyframes, settings.calibration)
            turns = pool.map(check, pairs[:, 0].tolist(), [[later] for later in pairs[:, 1].tolist()])
            share = _calibration_share(pairs, [row.pose for (row,) in turns], keyframes, camera, settings)
        matches = [int(proposals.match[group[0]]) for group in groups]
        queries = [proposals.query[group].tolist() for group in groups]
        for group, found in zip(groups, pool.map(check, matches, queries), strict=True):
            for at, row in zip(group, found, strict=True):
                rows[at] = row
            done += len(group)
            if progress is not None:
                progress(done, total)
    return _ledger(proposals, [row for row in rows if row is not None], camera, share)


def _calibration_share(
    pairs: Ints, poses: list[Pose], keyframes: Keyframes, camera: Camera, settings: VerifySettings
) -> float:
    """By what share the camera's rotations over turning pairs (P, 2) disagree with the odometry's."""
    good = [at for at, pose in enumerate(poses) if pose.verdict is Verdict.ACCEPTED]
    earlier, later = pairs[good].T
    driven = geometry.between(keyframes.odom_from_body[earlier], keyframes.odom_from_body[later])
    seen = np.array([_of_body(found, camera) for at in good if (found := poses[at].match_from_query) is not None])
    share = rotation_share(driven, seen, settings.calibration)
    if share > _SUSPICIOUS_SHARE:
        _LOG.warning(
            "Camera %r and odometry disagree by %.0f %% about rotations: closures claim less. Check the focal length.",
            camera.name,
            100.0 * share,
        )
    return share


def _of_body(match_from_query: Floats, camera: Camera) -> Floats:
    """A motion of the camera as a motion of the body."""
    return camera.body_from_camera @ match_from_query @ geometry.inverse(camera.body_from_camera)


def _check_queries(
    match: int, queries: list[int], keyframes: Keyframes, camera: Camera, features: FeaturesOf, settings: VerifySettings
) -> list[_Row]:
    """The queries that were proposed for one map frame."""
    theirs = features(match)
    known = None
    rows = []
    for query in queries:
        own = features(query)
        mine, found = match_features(own, theirs, settings.matching)
        if len(mine) < settings.min_matches:
            rows.append(_Row(len(mine), 0, Pose(Verdict.TOO_FEW_MATCHES, 0, 0.0)))
        elif camera.matrix is None:
            pose = verify_epipolar.solve(
                own.points[mine], theirs.points[found], own.width, own.height, settings.epipolar
            )
            rows.append(_Row(len(mine), 0, pose))
        else:
            if known is None:
                known = landmarks_of(match, keyframes, camera, features, settings.matching, settings.landmarks)
            rows.append(_check_metric(own, mine, found, known, camera, settings))
    return rows


def _check_metric(
    own: Features,
    mine: np.ndarray,
    found: np.ndarray,
    known: Landmarks,
    camera: Camera,
    settings: VerifySettings,
) -> _Row:
    rays = undistort.rays(camera, own.points[mine])
    usable = known.known[found] & np.isfinite(rays).all(axis=1)
    matches, count = len(mine), int(usable.sum())
    if count < settings.metric.min_inliers:
        # features were followed, but none moved enough against the others to have a depth
        still = not known.from_depth and known.tracked >= settings.min_matches > known.known.sum()
        verdict = Verdict.DEGENERATE_MOTION if still else Verdict.TOO_FEW_LANDMARKS
        return _Row(matches, count, Pose(verdict, 0, 0.0))
    depth_m = own.depth_m[mine[usable]].astype(np.float64)
    pose = verify_metric.solve(
        known,
        found[usable],
        rays[usable],
        inverse_depth(depth_m, settings.landmarks),
        own.points[mine[usable]] / [own.width, own.height],
        camera,
        settings.landmarks,
        settings.metric,
    )
    return _Row(matches, count, pose)


def _ledger(proposals: Proposals, rows: list[_Row], camera: Camera, calibration_share: float) -> Closures:
    """The columns of the ledger; poses and their information moved from the camera to the body."""
    count = len(rows)
    pose, information = np.full((count, 4, 4), np.nan), np.full((count, 6, 6), np.nan)
    move = geometry.adjoint(geometry.inverse(camera.body_from_camera))
    for at, row in enumerate(rows):
        found, covariance = row.pose.match_from_query, row.pose.covariance
        if found is None or covariance is None:
            continue
        pose[at] = _of_body(found, camera)
        turned = move.T @ np.linalg.inv(covariance + motion_covariance(found, calibration_share)) @ move
        information[at] = (turned + turned.T) / 2.0
    return Closures(
        query=proposals.query.astype(np.int32),
        match=proposals.match.astype(np.int32),
        rank=proposals.rank.astype(np.int32),
        score=proposals.score.astype(np.float32),
        support=proposals.support.astype(np.int32),
        matches=np.array([row.matches for row in rows], np.int32),
        landmarks=np.array([row.landmarks for row in rows], np.int32),
        inliers=np.array([row.pose.inliers for row in rows], np.int32),
        spread=np.array([row.pose.spread for row in rows], np.float32),
        match_from_query=pose,
        information=information,
        verdict=[row.pose.verdict for row in rows],
        residual_before=np.full(count, np.nan),
        residual_after=np.full(count, np.nan),
        weight=np.full(count, np.nan),
    )
