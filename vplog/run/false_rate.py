"""The false discovery rate of a drive's ledger, and the closures admitted by `false_rate.rate`."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vplog.data import Bools, Closures, Ints, Keyframes, Odometry, Verdict
from vplog.evaluate.body_truth import TruthAt
from vplog.evaluate.closure_pose import pose_bounds, pose_errors
from vplog.execution.execution import Execution
from vplog.execution.run_warnings import warn
from vplog.geometry import se3
from vplog.graph.build import build_graph
from vplog.graph.consistency import OdometryChain
from vplog.graph.noise import NoiseSettings, broken_edges, edge_covariance
from vplog.loops.candidate import Drive
from vplog.loops.false_rate import (
    MOST_APART,
    FalseRateSettings,
    are_unrated,
    at_rate,
    certain_pairs,
    evidence,
    mirrored_evidence,
    null_pairs,
    with_p_false,
)
from vplog.loops.propose import Proposals, ProposeSettings, candidate_stops
from vplog.loops.verify import verify_between
from vplog.run.cache.codecs import closures_codec
from vplog.run.cache.steps import step
from vplog.run.verification import DriveFeatures, for_verification

_FAR_M = 1e6
"""m between two pieces of a drive, of which nothing is known."""


@dataclass(frozen=True)
class RatingSettings:
    """The settings that closures are rated by."""

    false_rate: FalseRateSettings
    propose: ProposeSettings
    noise: NoiseSettings


@step("p_false", lambda *_: closures_codec(), items=lambda closures, *_: len(closures))
def rate_closures(
    closures: Closures,
    odometry: Odometry,
    views: Sequence[DriveFeatures],
    rows: Sequence[Ints],
    rating: RatingSettings,
    *,
    execution: Execution,
) -> Closures:
    """The ledger with `p_false`, and with `rate` without what is likelier to be false, by pairs of all cameras.

    `views` are the pictures of each camera, the first one's at every keyframe, and `rows` the keyframes of each.
    """
    if not evidence(closures).any():  # there is nothing to rate
        return closures
    reach_m, settings, noise = views[0].settings.metric.max_distance_m, rating.false_rate, rating.noise
    ruled_out = beyond_drift(closures, views[0].keyframes, odometry, noise, reach_m, settings.sigmas)
    if are_unrated(evidence(closures), int(ruled_out.sum()), settings):
        return replace(closures, p_false=np.where(ruled_out & (evidence(closures) > 0), 1.0, closures.p_false))
    left = np.flatnonzero(~ruled_out)
    count = min(max(null_pairs(evidence(closures), settings) - int(ruled_out.sum()), 0), len(left))
    chosen = left[np.linspace(0, len(left) - 1, count).astype(np.int64)]
    mirror = _mirrored(closures.rows(chosen), [for_verification(view) for view in views], rows, execution)
    # a moving camera's landmarks come from these very neighbours, so that they tell little of other closures
    most = settings.certain_pairs // len(views) if {"depth", "stereo"} & set(closures.scale) else 0
    certain = [_certain_pairs(view, odometry, rating.propose, most, execution) for view in views]
    known = [_by_odometry(one, view, noise, settings) for one, view in zip(certain, views, strict=True)]
    closures = with_p_false(closures, ruled_out, mirror, *map(np.concatenate, zip(*known, strict=True)))
    return _admitted(closures, settings, int(ruled_out.sum()), count)


def _mirrored(closures: Closures, drives: Sequence[Drive], rows: Sequence[Ints], execution: Execution) -> Ints:
    """Evidence (C,) of candidates whose query is mirrored, by pairs of cameras."""
    cameras, found = np.stack([closures.query_camera, closures.match_camera]), [np.zeros(0, np.int64)]
    for q, m in np.unique(cameras, axis=1).T.tolist():
        of = closures.rows(np.flatnonzero((cameras == [[q], [m]]).all(axis=0)))
        query, match = (rows[n].searchsorted(one).astype(np.int32) for n, one in ((q, of.query), (m, of.match)))
        proposals = Proposals(query, match, of.rank, of.score, of.support)
        found.append(mirrored_evidence(proposals, drives[q], drives[m], execution))
    return np.concatenate(found)


def _certain_pairs(
    drive: DriveFeatures, odometry: Odometry, propose: ProposeSettings, most: int, execution: Execution
) -> Closures:
    """The ledger of at most so many pairs of neighbouring pictures of one camera."""
    keyframes, views = drive.keyframes, for_verification(drive)
    piece = np.zeros(len(keyframes.stamp_ns))
    piece[broken_edges(odometry, keyframes.stamp_ns) + 1] = _FAR_M  # what lies behind a break is near nothing before
    positions = np.column_stack([keyframes.odom_from_body[:, :3, 3], np.cumsum(piece)])
    stops = candidate_stops(keyframes, propose)
    pairs = certain_pairs(positions, stops, drive.settings.metric.max_distance_m, most)
    return verify_between(pairs, views, views, execution, share=0.0)


def _by_odometry(
    certain: Closures, drive: DriveFeatures, noise: NoiseSettings, settings: FalseRateSettings
) -> tuple[Ints, Bools]:
    """Evidence (K,) of the verified ones of certain pairs with a pose, and whether `vplog evaluate` would call it
    wrong with the odometry as the truth, which may drift meanwhile."""
    poses = drive.keyframes.odom_from_body
    step = np.zeros((len(poses), 2))  # rad and m
    between = se3.between(poses[:-1], poses[1:])
    step[1:] = np.column_stack([se3.angle(between), np.linalg.norm(between[:, :3, 3], axis=1)])
    path = np.cumsum(step, axis=0)
    turned, moved = (path - path[np.maximum(np.arange(len(poses)) - MOST_APART, 0)]).T
    drift = [noise.turn_per_radian * turned + noise.turn_per_metre * moved, noise.drift_per_metre * moved]
    none = np.zeros_like(step)
    known = np.ones(len(poses), bool)
    query, match = TruthAt(poses, known, settings.sigmas * np.stack(drift, 1)), TruthAt(poses, known, none)
    cameras = drive.camera.body_from_camera, drive.camera.body_from_camera
    posed, _, wrong, _ = pose_errors(certain, query, match, pose_bounds(poses[:, :3, 3]), cameras)
    rows = posed & certain.of(Verdict.ACCEPTED)
    return evidence(certain)[rows], wrong[rows]


def beyond_drift(
    closures: Closures, keyframes: Keyframes, odometry: Odometry, noise: NoiseSettings, reach_m: float, sigmas: float
) -> Bools:
    """(C,) candidates whose ends odometry has further apart than `reach_m` by so many sigmas of its drift."""
    model = noise.model_copy(update={"source": "model"})
    covariance = edge_covariance(odometry, keyframes.stamp_ns, model)[0]  # a log may claim anything
    chain = OdometryChain.of(build_graph(keyframes, covariance, None)[0])
    drift = chain.covariance(closures.match, closures.query)[:, 3:, 3:]
    apart = np.diff(keyframes.odom_from_body[:, :3, 3][np.stack([closures.match, closures.query])], axis=0)[0]
    sigma_m = np.sqrt(np.maximum(np.linalg.eigvalsh(drift)[:, -1], 0.0))
    return np.linalg.norm(apart, axis=1) - sigmas * sigma_m > reach_m


def _admitted(closures: Closures, settings: FalseRateSettings, ruled_out: int, mirrored: int) -> Closures:
    """The ledger without what is likelier to be false than the rate, if any, with a warning where that is all."""
    if (rate := settings.rate) is None:
        return closures
    verified = closures.of(Verdict.ACCEPTED)
    least = closures.p_false[verified].min(initial=1.0)
    if verified.any() and least > rate:
        more_pairs = ", or raise --set false_rate.null_pairs" if settings.null_pairs else ""  # 0: none can be mirrored
        warn(
            f"--false-rate {rate:g}: no closure is that certain. Of the {verified.sum()} verified the best have a "
            f"false rate of {least:.2g}, by {ruled_out} pairs that odometry rules out and {mirrored} mirrored ones. "
            f"Allow more than that{more_pairs}."
        )
    return at_rate(closures, rate)
