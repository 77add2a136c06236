"""One scale along a drive without metres: its scale drift, estimated from closures.

As the seven degrees of freedom of Strasdat, Montiel & Davison 2010 (Scale drift-aware large scale monocular SLAM), with
the scale solved first: two views of one place, each with landmarks in the unit of its own time, give their ratio.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from scipy import sparse

from vplog.data import SCALE_WANDER, Camera, Floats, Ints, Keyframes, Odometry
from vplog.execution.execution import Execution
from vplog.geometry import se3
from vplog.graph.noise import broken_edges
from vplog.loops.candidate import Drive, Row, check_queries
from vplog.loops.propose import Proposals
from vplog.odometry.metric_scale import random_walk, scaled
from vplog.run.cache.codecs import json_codec
from vplog.run.cache.steps import step
from vplog.run.verification import DriveFeatures, for_verification

_RANKS = 2
"""Candidates of a keyframe that are measured: those of neighbouring ranks give the same ratio."""
_MEASURED = 4000
"""Places that candidates are measured at, evenly spread over the drive: its scale wanders over hundreds of metres."""
_LEAST = 12
"""Landmarks of both views that give a ratio."""
_ACROSS = 1.0
"""Sigma of the log of the scale across a break: each piece begins with a unit of its own."""
_BEST = 0.02
"""Least standard deviation of a ratio's log: landmarks of a view err together."""
_TUNING = 2.0
"""Sigmas beyond which a ratio counts less (Huber)."""
_ROUNDS = 20
"""Rounds of reweighting; five are usual."""


def _rows(tree: list[list[float]]) -> Floats:
    return np.array(tree, np.float64).reshape(-1, 4)


@step("scale", lambda *_: json_codec(_rows, np.ndarray.tolist), lambda proposals, _: len(proposals.query))
def scale_ratios(proposals: Proposals, drive: DriveFeatures, *, execution: Execution) -> Floats:
    """(K, 4) query, match, log of the ratio of the match's to the query's unit, and its sigma, of the candidates that
    geometry finds."""
    if drive.camera.matrix is None:
        return np.zeros((0, 4))
    every = -(-len(drive.keyframes.stamp_ns) // _MEASURED)
    views, first = for_verification(drive), proposals.rows((proposals.rank < _RANKS) & (proposals.match % every == 0))
    order = np.argsort(first.match, kind="stable")
    groups = np.split(order, np.flatnonzero(np.diff(first.match[order])) + 1) if len(order) else []

    def measure(group: Ints) -> list[tuple[float, ...]]:
        match, queries = int(first.match[group[0]]), first.query[group].tolist()
        rows = check_queries(views, views, match, queries)
        found = [_ratio(views, query, match, row) for query, row in zip(queries, rows, strict=True)]
        return [one for one in found if one is not None]

    measured = execution.counted("scale", execution.map(measure, groups), len(groups))
    return np.array([one for group in measured for one in group], np.float64).reshape(-1, 4)


def _ratio(drive: Drive, query: int, match: int, row: Row) -> tuple[float, ...] | None:
    """By the depths of landmarks in the query's view, in the unit of the match and in its own."""
    if row.pairs is None or row.pose.match_from_query is None:
        return None
    mine, theirs = row.pairs
    own, other = drive.landmarks(query), drive.landmarks(match)
    both = own.known[mine] & other.known[theirs]
    ray = np.column_stack([other.rays[theirs[both]], np.ones(int(both.sum()))])
    at = se3.transform(se3.inverse(row.pose.match_from_query), ray / other.rho[theirs[both], None])
    ratio = at[:, 2] * own.rho[mine[both]]
    logs = np.log(ratio[ratio > 0])
    if len(logs) < _LEAST:
        return None
    middle = float(np.median(logs))
    spread = 1.4826 * float(np.median(np.abs(logs - middle)))  # of a Gaussian
    return float(query), float(match), middle, max(1.2533 * spread / len(logs) ** 0.5, _BEST)


def in_one_scale(
    odometry: Odometry, keyframes: Keyframes, camera: Camera, ratios: Floats
) -> tuple[Odometry, Keyframes]:
    """Odometry and keyframes whose unit is the same throughout, as far as ratios (K, 4) tell."""
    if not len(ratios):
        return odometry, keyframes
    log_scale = _log_scale(odometry, keyframes, ratios)
    since_ns, at_ns = odometry.stamp_ns - keyframes.stamp_ns[0], keyframes.stamp_ns - keyframes.stamp_ns[0]
    begin_ns, every = since_ns[odometry.breaks], np.zeros(len(since_ns))
    piece, piece_of = (np.searchsorted(begin_ns, one, "right") for one in (since_ns, at_ns))
    for one in np.unique(piece_of):  # each has its own unit
        every[piece == one] = np.interp(since_ns[piece == one], at_ns[piece_of == one], log_scale[piece_of == one])
    odometry = scaled(odometry, np.exp(every), camera)
    poses = se3.interpolate_at(odometry.stamp_ns, odometry.odom_from_body, keyframes.stamp_ns)
    return odometry, replace(keyframes, odom_from_body=poses)


def _log_scale(odometry: Odometry, keyframes: Keyframes, ratios: Floats) -> Floats:
    """(N,) of the keyframes by least squares, of a scale that wanders slowly; its median is 0."""
    poses, count = keyframes.odom_from_body, len(keyframes.stamp_ns)
    sigma = SCALE_WANDER * np.sqrt(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1) + 1e-6)
    sigma[broken_edges(odometry, keyframes.stamp_ns)] = _ACROSS
    smooth = random_walk(sigma)
    rows, ones = np.arange(len(ratios)), np.ones(len(ratios))
    ends = (np.concatenate([rows, rows]), ratios[:, :2].T.ravel().astype(np.int64))
    differences = sparse.csr_array((np.concatenate([ones, -ones]), ends), (len(ratios), count))
    anchor = sparse.csr_array(([1.0], ([0], [0])), (1, count))
    x = np.zeros(count)
    for _ in range(_ROUNDS):
        residual = np.abs(differences @ x - ratios[:, 2]) / ratios[:, 3]
        weight = np.sqrt(np.minimum(1.0, _TUNING / np.maximum(residual, 1e-9))) / ratios[:, 3]
        A = sparse.vstack([sparse.diags_array(weight) @ differences, smooth, anchor])
        b = np.concatenate([weight * ratios[:, 2], np.zeros(count)])
        before, x = x, sparse.linalg.spsolve((A.T @ A).tocsc(), A.T @ b)
        if np.abs(x - before).max() < 1e-4:
            break
    return x - np.median(x)
