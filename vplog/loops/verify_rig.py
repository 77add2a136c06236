"""Verification by all cameras of a body at once, as one generalised camera (Pless 2003).

Matches of all pairs of cameras that look the same way give one pose of the body. Its start is the pose by one pair, or
that of P3P in RANSAC on each pair's matches, whichever most matches of all agree with: a minimal solver of three rays
through different centres (Nister & Stewenius 2007) is only needed where no pair has three right matches.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from itertools import product
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Bools, Closures, Floats, Ints, Verdict
from vplog.features.matching import match_features
from vplog.geometry import se3
from vplog.loops import pose_refinement, undistort
from vplog.loops.calibration import body_twists, motion_covariance, stamp_covariance
from vplog.loops.candidate import Drive, agree
from vplog.loops.pose_refinement import LandmarkMatches
from vplog.loops.verify_metric import CHI2_2, MODELS, SAMPLE, SINGULAR, find_pose, inliers, log10_false_alarms, observe

if TYPE_CHECKING:
    from vplog.execution.execution import Execution

_MOST_APART = np.cos(np.radians(50.0))
"""Between the optical axes of two cameras whose images are matched: beyond it a view of usual width shares little."""
_LEAST = 6
"""Matches of a pair of cameras that are worth looking at: three fix a pose, and as many must agree with it."""
_ROUNDS = 8
"""Most rounds of refitting the pose to its inliers and selecting inliers by the pose."""


@dataclass(frozen=True, eq=False)
class _Pair:
    """Matches of one camera at the query with one at the match."""

    cameras: tuple[int, int]
    mounts: tuple[Floats, Floats]
    """body_from_camera (4, 4) of both."""
    matches: LandmarkMatches
    place: Floats
    """(K, 2) in the query's image, in shares of its sides."""
    focal_px: float
    area_px: int
    """px of the query's image."""
    scale: str

    def of_cameras(self, match_from_query: Floats) -> Floats:
        """match_from_query (4, 4) of the cameras by that of the bodies."""
        return se3.inverse(self.mounts[1]) @ match_from_query @ self.mounts[0]

    def of_bodies(self, match_from_query: Floats) -> Floats:
        return self.mounts[1] @ match_from_query @ se3.inverse(self.mounts[0])

    def equations(self, match_from_query: Floats, inlier: Bools) -> tuple[Floats, Floats, float]:
        """Hessian (6, 6), gradient (6,) and cost of the inliers (K,) by the pose T exp(d) of the bodies, which moves
        that of the cameras by Ad d."""
        chosen = self.matches.rows(inlier)
        hessian, gradient, cost = pose_refinement.normal_equations(self.of_cameras(match_from_query), chosen)
        Ad = se3.adjoint(se3.inverse(self.mounts[0]))
        return Ad.T @ hessian @ Ad, Ad.T @ gradient, cost

    def information(self, match_from_query: Floats, inlier: Bools, excess: float, systematic_px: float) -> Floats:
        """(6, 6) of the pose of the bodies by the inliers (K,), with what all of them err in together."""
        shared, depth_m = systematic_px / self.focal_px, float(np.median(1.0 / self.matches.points[inlier, 2]))
        Ad = se3.adjoint(self.mounts[0])
        S = Ad @ np.diag([shared**2] * 3 + [(shared * depth_m) ** 2] * 3) @ Ad.T
        H = self.equations(match_from_query, inlier)[0] / max(excess, 1.0)
        return np.asarray(np.linalg.solve(np.eye(6) + H @ S, H), np.float64)  # (H^-1 + S)^-1, also of a singular H

    def spread(self, inlier: Bools) -> float:
        """Share of the image that the inliers' bounding box covers."""
        return float(np.prod(np.ptp(self.place[inlier], axis=0))) if inlier.any() else 0.0


@dataclass(eq=False)
class Rig:
    """The cameras of one drive, as its candidates are checked."""

    drives: Sequence[Drive]
    """The pictures of each camera; the first has one at every keyframe."""
    rows: Sequence[Ints]
    """Keyframe of each picture, increasing."""
    share: float
    """Largest `calibration_share` of the cameras."""
    twists: Floats = field(init=False)

    def __post_init__(self) -> None:
        self.twists = body_twists(self.drives[0].keyframes)

    def pictures(self, keyframe: int) -> list[tuple[int, int, Floats]]:
        """Camera, picture, and body_from_camera (4, 4) of each picture of a keyframe, by its own stamp."""
        body, found = self.drives[0].keyframes.odom_from_body[keyframe], []
        for number, (drive, rows) in enumerate(zip(self.drives, self.rows, strict=True)):
            at = int(np.searchsorted(rows, keyframe))
            if at < len(rows) and rows[at] == keyframe and drive.camera.matrix is not None:
                moved = se3.between(body, drive.keyframes.odom_from_body[at])
                found.append((number, at, moved @ drive.camera.body_from_camera))
        return found


def verify_together(closures: Closures, rig: Rig, execution: Execution) -> list[Closures]:
    """The C candidates of several cameras, those with enough matches with the pose and verdict by all cameras that
    share a view. Counts stay those of one pair of cameras."""
    calibrated = np.array([drive.camera.matrix is not None for drive in rig.drives])
    both = calibrated[closures.query_camera] & calibrated[closures.match_camera]
    tried = np.flatnonzero(both & ~closures.of(Verdict.TOO_FEW_MATCHES, Verdict.NO_CALIBRATION))
    order = tried[np.argsort(closures.match[tried], kind="stable")].tolist()  # landmarks of a match are remembered
    found = execution.map(lambda at: _verified(closures.rows(np.array([at])), rig), order)
    better = dict(zip(order, found, strict=True))
    return [better.get(at) or closures.rows(np.array([at])) for at in range(len(closures))]


def _verified(row: Closures, rig: Rig) -> Closures | None:
    """One candidate by all cameras; None where these add nothing to what one pair of them has."""
    settings, accepted = rig.drives[0].settings, bool(row.accepted[0])
    metric, start = settings.metric, row.match_from_query[0] if accepted else None
    pairs = _pairs(row, start, rig)
    if len(pairs) < 2 or (found := _solve(pairs, start, rig)) is None:
        return None
    pose, excess, inlier = found
    counts = [int(one.sum()) for one in inlier]
    used = [at for at, count in enumerate(counts) if count >= _LEAST]
    if len(used) < 2:
        return None
    information = sum(pairs[at].information(pose, inlier[at], excess, metric.systematic_px) for at in used)
    if np.linalg.cond(information) > SINGULAR:
        return None
    covariance = np.asarray(np.linalg.inv(information), np.float64) + motion_covariance(pose, rig.share)
    best = int(np.argmax(counts))
    scale = row.scale[0] if accepted else pairs[best].scale
    if scale == "odometry":
        along = pose[:3, :3].T @ pose[:3, 3] * metric.scale_share
        covariance[3:, 3:] += np.outer(along, along)
    speeds = rig.twists[row.match[0]], rig.twists[row.query[0]]
    covariance += stamp_covariance(pose, *speeds, settings.calibration.stamp_sigma_s)
    inverse = np.linalg.inv(covariance)
    posed = replace(row, match_from_query=pose[None], information=(inverse + inverse.T)[None] / 2.0, scale=[scale])
    if accepted:
        same = agree(row.match_from_query[0], np.linalg.inv(row.information[0]), pose, covariance)
        return posed if same else None
    if not _is_sure(pose, pairs, inlier, rig):
        return None
    of_pair = {
        "matches": len(pairs[best].place), "landmarks": len(pairs[best].place), "inliers": counts[best],
        "spread": pairs[best].spread(inlier[best]), "query_camera": pairs[best].cameras[0],
        "match_camera": pairs[best].cameras[1],
    }  # fmt: skip
    columns: Any = {name: np.array([value], getattr(row, name).dtype) for name, value in of_pair.items()}
    return replace(posed, verdict=[Verdict.ACCEPTED], **columns)


def _pairs(row: Closures, start: Floats | None, rig: Rig) -> list[_Pair]:
    """The matches of all pairs of cameras that look the same way, by the pose `start`, or by the pair whose candidate
    it is."""
    later, earlier = rig.pictures(int(row.query[0])), rig.pictures(int(row.match[0]))
    if start is None:
        mounts = [{number: mount for number, _, mount in some} for some in (later, earlier)]
        start = mounts[1][int(row.match_camera[0])] @ se3.inverse(mounts[0][int(row.query_camera[0])])
    found = []
    for (a, query, query_mount), (b, match, match_mount) in product(later, earlier):
        if (start @ query_mount)[:3, 2] @ match_mount[:3, 2] < _MOST_APART:
            continue
        drive, other = rig.drives[a], rig.drives[b]
        own, settings = drive.features(query), drive.settings
        mine, theirs = match_features(own, other.features(match), settings.matching)
        if len(mine) < _LEAST:
            continue
        landmarks, rays = other.landmarks(match), undistort.rays(drive.camera, own.points[mine])
        usable = np.flatnonzero(landmarks.known[theirs] & np.isfinite(rays).all(axis=1))
        if len(usable) >= _LEAST:
            used = own.rows(mine[usable])
            matches = observe(landmarks, theirs[usable], rays[usable], used.depth_m, drive.camera, settings.landmarks)
            scale = ("stereo" if other.stereo else "depth") if landmarks.from_depth else "odometry"
            place, focal_px = used.points / [own.width, own.height], undistort.focal_px(drive.camera)
            area_px = own.width * own.height
            found.append(_Pair((a, b), (query_mount, match_mount), matches, place, focal_px, area_px, scale))
    return found


def _solve(pairs: Sequence[_Pair], start: Floats | None, rig: Rig) -> tuple[Floats, float, list[Bools]] | None:
    """match_from_query (4, 4) of the bodies, residual variance over its expectation, and the inliers of each pair; None
    where there is no pose."""
    settings = rig.drives[0].settings
    metric, most = settings.metric, (settings.metric.max_error_px / settings.landmarks.pixel_sigma) ** 2
    near = [metric.ransac_px / one.focal_px for one in pairs]
    starts = [] if start is None else [start]
    if start is None:
        for one, radius in zip(pairs, near, strict=True):
            sampled = find_pose(one.matches.cloud, one.matches.rays, radius, metric.ransac_rounds)
            starts += [] if sampled is None else [one.of_bodies(se3.inverse(sampled[0]))]
    tried = [(pose, [_within(one, pose, radius) for one, radius in zip(pairs, near, strict=True)]) for pose in starts]
    if not tried:
        return None
    excess, (pose, inlier) = 1.0, max(tried, key=lambda one: sum(int(each.sum()) for each in one[1]))
    for _ in range(_ROUNDS):
        if sum(int(each.sum()) for each in inlier) < metric.min_inliers:
            return None
        pose, excess = _fit(pose, pairs, inlier)
        before, inlier = inlier, [_agreeing(one, pose, most) for one in pairs]
        if all(np.array_equal(a, b) for a, b in zip(before, inlier, strict=True)):
            break
    return (pose, excess, inlier) if np.isfinite(pose).all() else None


def _fit(pose: Floats, pairs: Sequence[_Pair], inlier: Sequence[Bools]) -> tuple[Floats, float]:
    """The pose by the inliers of all pairs, and the residual variance over its expectation."""

    def equations(pose: Floats) -> tuple[Floats, Floats, float]:
        H, g, costs = zip(*(one.equations(pose, rows) for one, rows in zip(pairs, inlier, strict=True)), strict=True)
        return np.sum(H, axis=0), np.sum(g, axis=0), sum(costs)

    pose, _, cost = pose_refinement.gauss_newton(pose, equations)
    counts = [pose_refinement.measurements(one.matches.rows(rows)) for one, rows in zip(pairs, inlier, strict=True)]
    return pose, cost / max(sum(counts) - 6.0, 1.0)


def _within(pair: _Pair, pose: Floats, radius: float) -> Bools:
    return inliers(se3.inverse(pair.of_cameras(pose)), pair.matches.cloud, pair.matches.rays, radius)


def _agreeing(pair: _Pair, pose: Floats, most: float) -> Bools:
    squared, alone = pose_refinement.agreement(pair.of_cameras(pose), pair.matches)
    return (squared < CHI2_2) & (alone < most)


def _is_sure(pose: Floats, pairs: Sequence[_Pair], inlier: Sequence[Bools], rig: Rig) -> bool:
    """Whether the pose holds to the bounds of one camera's, with the inliers of all."""
    metric, each = rig.drives[0].settings.metric, list(zip(pairs, inlier, strict=True))
    count, total = sum(int(rows.sum()) for rows in inlier), sum(map(len, inlier))
    chance = np.pi * metric.max_error_px**2 / min(one.area_px for one in pairs)
    alarms = log10_false_alarms(total, count, SAMPLE, MODELS * len(pairs), chance)
    depth_m = np.median(np.concatenate([1.0 / one.matches.points[rows, 2] for one, rows in each]))
    return bool(
        count >= max(metric.min_inliers, metric.min_share * total)
        and alarms <= metric.log10_false_alarms
        and sum(one.spread(rows) for one, rows in each) >= metric.min_spread
        and np.linalg.norm(pose[:3, 3]) <= min(metric.max_depths * depth_m, metric.max_distance_m)
    )
