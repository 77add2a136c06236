"""The pose of a picture in a map: verified against the places most like it one by one, then fitted to all landmarks
that agree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from vplog.data import Camera, Features, Floats, Ints, Verdict
from vplog.features.matching import match_features
from vplog.geometry import se3
from vplog.loops import pose_refinement, undistort, verify_metric
from vplog.loops.calibration import motion_covariance
from vplog.loops.landmarks import Landmarks, with_rho
from vplog.loops.pose_refinement import LandmarkMatches
from vplog.loops.verify import VerifySettings
from vplog.loops.verify_metric import Pose

_Agreeing = tuple[Floats, Floats, Ints]
"""Landmarks (A, 3), their covariance (A, 3, 3), and the picture's features (A,) that match them."""

_GROUP = 3
"""Places that are verified before it is decided whether others are."""
_ENOUGH = 2
"""Times the inliers that a pose needs, with which it needs no more places: more landmarks then add nothing that the
shared error of calibration and map leaves."""
_RIVAL_SIGMA = 3.0
"""Standard deviations, of a count of matches, by which a pose must have more inliers than another one elsewhere."""
_PROGRESS = (
    Verdict.NO_CALIBRATION, Verdict.TOO_FEW_MATCHES, Verdict.TOO_FEW_LANDMARKS, Verdict.DEGENERATE_MOTION,
    Verdict.TOO_FEW_INLIERS, Verdict.POOR_SPREAD, Verdict.IMPLAUSIBLE_POSE, Verdict.TOO_FAR, Verdict.INCONSISTENT,
    Verdict.ACCEPTED,
)  # fmt: skip
"""Verdicts in the order of the checks: a place that fails a later one explains the picture better."""


@dataclass(frozen=True, eq=False)
class KeyframeLandmarks:
    """The landmarks of one keyframe of a map."""

    world_from_camera: Floats
    """(4, 4)."""
    features: Features
    """(L,) their descriptors, and where they are in the keyframe's image, all with depths."""
    sigma: Floats
    """(L,) standard deviation of the inverse depths in 1/m."""
    camera: Camera
    pixel_sigma: float
    measured: bool
    """By a sensor, or by odometry's metres."""

    @cached_property
    def landmarks(self) -> Landmarks:
        """(L,) in the keyframe's camera."""
        rays, rho = undistort.rays(self.camera, self.features.points), 1.0 / self.features.depth_m.astype(np.float64)
        covariance = with_rho(rays, self.sigma**2, self.camera, self.pixel_sigma)
        known = np.isfinite(rays).all(axis=1) & np.isfinite(covariance).all(axis=(1, 2)) & (rho > 0) & (self.sigma > 0)
        return Landmarks(rho, rays, covariance, known, len(rho), self.measured)

    def reach_m(self, max_depths: float) -> float:
        """How far off the keyframe a picture may be that is `max_depths` times a landmark's depth away from it."""
        return max_depths * float(self.features.depth_m.max(initial=0.0))


@dataclass(frozen=True, eq=False)
class Localization:
    """The verdict on a picture, and its pose in the map where that is `accepted`."""

    verdict: Verdict
    place: int
    """Row of the place that explains it best; -1 where it was compared with none."""
    matches: int
    """Feature matches with that place."""
    inliers: int
    """Features that agree with the pose."""
    places: int = 0
    """Places that they are of."""
    world_from_camera: Floats | None = None
    """(4, 4)."""
    covariance: Floats | None = None
    """(6, 6) rotation first, in the picture's camera; relative to the map, whose own error is not in it."""


@dataclass(frozen=True, eq=False)
class _Fit:
    """A picture verified against one place."""

    place: int
    mine: Ints
    """(K,) features of the picture that match a landmark."""
    rows: Ints
    """(K,) those landmarks."""
    pose: Pose
    world_from_camera: Floats | None = None


@dataclass(frozen=True, eq=False)
class _Query:
    """A picture's features with their rays."""

    features: Features
    rays: Floats
    noise: Floats
    """(M, 2, 2) covariance of the rays."""
    camera: Camera
    settings: VerifySettings

    def solve(self, landmarks: Landmarks, rows: Ints, mine: Ints, start: Floats | None = None) -> Pose:
        """The pose by landmarks `rows` (K,) that features `mine` (K,) match. A place's width limits closures, whose
        errors grow with the distance; a picture has what is nearest, and its covariance."""
        metric = self.settings.metric.model_copy(update={"max_distance_m": np.inf})
        own, noise = self.features.rows(mine), self.settings.landmarks
        return verify_metric.solve(landmarks, rows, own, self.rays[mine], self.camera, noise, metric, start)


def localize(
    features: Features, camera: Camera, places: Sequence[KeyframeLandmarks], settings: VerifySettings
) -> Localization:
    """The pose of a picture by its features (M,) and the places that it may be of, likeliest first.

    Each place is verified by itself, three at a time; once a pose has twice the inliers that it needs, those alone that
    may have a rival of it. The pose with most inliers starts a fit to the landmarks of all these places that agree with
    it. Where another pose elsewhere has as many, the picture is at neither.
    """
    if camera.matrix is None:
        return Localization(Verdict.NO_CALIBRATION, -1, 0, 0)
    if not places:
        return Localization(Verdict.TOO_FEW_MATCHES, -1, 0, 0)
    rays = undistort.rays(camera, features.points)
    noise = undistort.noise_of_rays(camera, rays, settings.landmarks.pixel_sigma)
    query = _Query(features, rays, noise, camera, settings)
    fits = _verified(query, places)
    best = max(fits, key=lambda fit: (_PROGRESS.index(fit.pose.verdict), fit.pose.inliers, len(fit.mine)))
    if any(_is_rival(fit, best, settings) for fit in fits):
        return Localization(Verdict.INCONSISTENT, best.place, len(best.mine), best.pose.inliers)
    return _refined(query, fits, best, places)


def _verified(query: _Query, places: Sequence[KeyframeLandmarks]) -> list[_Fit]:
    """The picture against the places, in groups by likelihood, of each the one with most matches first. Once there is a
    pose, a place that cannot have a rival of it has no pose of its own and adds the landmarks that agree, unless there
    are enough; at another that pose is tried before any is sampled."""
    fits, best = list[_Fit](), None
    for first in range(0, len(places), _GROUP):
        group = range(first, min(first + _GROUP, len(places)))
        if best is not None and best.pose.inliers >= _ENOUGH * query.settings.metric.min_inliers:
            group = [number for number in group if _is_far(places[number], places[best.place], query.settings)]
        matched = {number: _matched(query, places[number]) for number in group}
        for number in sorted(matched, key=lambda number: -len(matched[number][0])):
            place, fit = places[number], _Fit(number, *matched[number], Pose(Verdict.TOO_FEW_INLIERS, 0, 0.0))
            if best is None or _may_be_rival(query, fit, place, best, places[best.place]):
                fit = _fitted(query, fit, place, None if best is None else best.world_from_camera)
            if fit.world_from_camera is not None and (best is None or fit.pose.inliers > best.pose.inliers):
                best = fit
            fits.append(fit)
    return sorted(fits, key=lambda fit: fit.place)


def _is_far(place: KeyframeLandmarks, best: KeyframeLandmarks, settings: VerifySettings) -> bool:
    """Whether a pose by a place's landmarks may be elsewhere than one near the `best` place."""
    apart, metric = np.linalg.norm(place.world_from_camera[:3, 3] - best.world_from_camera[:3, 3]), settings.metric
    return bool(apart + place.reach_m(metric.max_depths) >= metric.max_distance_m)


def _may_be_rival(query: _Query, fit: _Fit, place: KeyframeLandmarks, best: _Fit, of: KeyframeLandmarks) -> bool:
    """Whether a place's matches may give a pose elsewhere with as many inliers as the best one has, which is `of`
    another place: whether so many disagree with it, and a pose may be so far off."""
    start, least = best.pose.match_from_query, _rival_inliers(best.pose.inliers)
    if start is None or len(fit.mine) <= least or not _is_far(place, of, query.settings):
        return False
    return len(fit.mine) - len(_agreeing(query, fit, place, of.world_from_camera, start)[2]) > least


def _matched(query: _Query, place: KeyframeLandmarks) -> tuple[Ints, Ints]:
    """Features of the picture (K,) and landmarks of the place (K,) that match."""
    mine, rows = match_features(query.features, place.features, query.settings.matching)
    usable = np.isfinite(query.rays[mine]).all(axis=1) & place.landmarks.known[rows]
    return mine[usable], rows[usable]


def _fitted(query: _Query, fit: _Fit, place: KeyframeLandmarks, start: Floats | None) -> _Fit:
    """The picture's pose by its matches with one place; `start` is world_from_camera (4, 4) to try first."""
    if len(fit.mine) < query.settings.metric.min_inliers:
        few = Verdict.TOO_FEW_MATCHES if place.landmarks.known.any() else Verdict.TOO_FEW_LANDMARKS
        return replace(fit, pose=Pose(few, 0, 0.0))
    start = None if start is None else se3.between(place.world_from_camera, start)
    pose = query.solve(place.landmarks, fit.rows, fit.mine, start)
    found = pose.match_from_query
    return replace(fit, pose=pose, world_from_camera=None if found is None else place.world_from_camera @ found)


def _is_rival(fit: _Fit, best: _Fit, settings: VerifySettings) -> bool:
    """Whether a pose elsewhere has as many inliers as the best, but for the noise of their count.

    Elsewhere is further off than views of one place can be: in a map that still errs, places around a picture give
    poses that differ by as much as the map does.
    """
    if fit.world_from_camera is None or best.world_from_camera is None:
        return False
    apart = np.linalg.norm(fit.world_from_camera[:3, 3] - best.world_from_camera[:3, 3])
    return bool(apart >= settings.metric.max_distance_m and fit.pose.inliers > _rival_inliers(best.pose.inliers))


def _rival_inliers(best: int) -> float:
    """Inliers that a pose has more of where it is as good as one with `best` of them, but for their count's noise."""
    return best - _RIVAL_SIGMA * best**0.5


def _refined(query: _Query, fits: Sequence[_Fit], best: _Fit, places: Sequence[KeyframeLandmarks]) -> Localization:
    """The best fit, improved by the landmarks of all places that agree with it, where it has a pose."""
    start, own = best.pose.match_from_query, best.pose.covariance
    pose, used = best.pose, 1
    if start is None or own is None:
        return Localization(pose.verdict, best.place, len(best.mine), pose.inliers)
    anchor, matched = places[best.place].world_from_camera, [fit for fit in fits if len(fit.mine)]
    agreeing = [_agreeing(query, fit, places[fit.place], anchor, start) for fit in matched]
    # of the places that explain it well, the nearest: one seen again later may have more landmarks, from further off
    counts, true = [len(rows) for _, _, rows in agreeing], anchor @ start
    well = [fit for fit, count in zip(matched, counts, strict=True) if 2 * count >= max(counts)]
    most = min(well, key=lambda fit: float(np.linalg.norm((places[fit.place].world_from_camera - true)[:3, 3])))
    points, covariance, mine = map(np.concatenate, zip(*agreeing, strict=True))
    # a feature counts once, by the landmark whose depth is surest: its pixel has one error, however many match it
    order = np.lexsort((covariance[:, 2, 2] / points[:, 2] ** 2, mine))
    chosen = order[np.unique(mine[order], return_index=True)[1]]
    merged = Landmarks(
        points[chosen, 2], points[chosen, :2], covariance[chosen], np.ones(len(chosen), bool), len(chosen),
        places[best.place].landmarks.from_depth,
    )  # fmt: skip
    refined = query.solve(merged, np.arange(len(chosen)), mine[chosen], start)
    if refined.match_from_query is not None and refined.covariance is not None and refined.inliers >= pose.inliers:
        pose, start, own = refined, refined.match_from_query, refined.covariance
        used = sum(len(rows) > 0 for _, _, rows in agreeing)  # else the landmarks of other places made it worse
    own = own + motion_covariance(start, query.settings.calibration.least_share)
    return Localization(Verdict.ACCEPTED, most.place, len(most.mine), pose.inliers, used, anchor @ start, own)


def _agreeing(query: _Query, fit: _Fit, place: KeyframeLandmarks, anchor: Floats, pose: Floats) -> _Agreeing:
    """The landmarks of a place that agree with a pose in the camera `anchor` (4, 4), in that camera."""
    rays, noise, unknown = query.rays[fit.mine], query.noise[fit.mine], np.full(len(fit.mine), np.nan)
    points, covariance = _moved(se3.between(anchor, place.world_from_camera), place.landmarks, fit.rows)
    squared, _ = pose_refinement.agreement(pose, LandmarkMatches(points, covariance, rays, noise, unknown, unknown))
    agrees = squared < verify_metric.CHI2_2
    return points[agrees], covariance[agrees], fit.mine[agrees]


def _moved(b_from_a: Floats, landmarks: Landmarks, rows: Ints) -> tuple[Floats, Floats]:
    """Landmarks `rows` (K,) of camera a as triples (K, 3) of camera b, and their covariance (K, 3, 3)."""
    rays, rho = landmarks.rays[rows], landmarks.rho[rows]
    bearing = np.column_stack([rays, np.ones(len(rays))])
    rotation, shift = b_from_a[:3, :3], b_from_a[:3, 3]
    moved = bearing @ rotation.T + rho[:, None] * shift
    depth = np.where(moved[:, 2] > 0, moved[:, 2], np.nan)[:, None]  # behind it: no triple, and it agrees with no pose
    points = np.column_stack([moved[:, :2], rho]) / depth
    by_moved = np.zeros((len(rays), 3, 3))
    by_moved[:, 0, 0] = by_moved[:, 1, 1] = 1.0 / depth[:, 0]
    by_moved[:, :, 2] = -points / depth
    by_triple = np.column_stack([rotation[:, 0], rotation[:, 1], shift])
    J = by_moved @ by_triple
    J[:, 2, 2] += 1.0 / depth[:, 0]
    return points, J @ landmarks.covariance[rows] @ np.swapaxes(J, 1, 2)
