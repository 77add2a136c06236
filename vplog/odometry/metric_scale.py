"""Metres for odometry in units of its own, by GPS fixes: its scale as it drifts along the path."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np
from scipy import sparse

from vplog.data import RECEIVER_SIGMA_M, SCALE_WANDER, Camera, Floats, Gps, Ints, Odometry
from vplog.execution.run_warnings import warn
from vplog.geometry import se3
from vplog.geometry.geodesy import local_enu

_APART = 10.0
"""Sigmas of a fix between two that are compared: their distance then is known to a seventh."""
_REACH = (1, 2, 4, 8)
"""Numbers of such steps over which distances are compared."""
_TUNING = 2.0
"""Sigmas beyond which a distance counts less (Huber)."""
_ROUNDS = 15
"""Gauss-Newton steps; from the median ratio some five converge."""
_ANY_SCALE = 1.0
"""Sigma of the log of a scale that was not measured: each piece has a unit of its own."""
_STRAIGHT_NS = 2_500_000_000
"""ns over which the way is taken for straight: three fixes at 1 Hz."""
_NAMED = 3
"""Pieces that are named."""
_LEAST = 3
"""Fixes at such distances from each other that give metres."""


class _Way(NamedTuple):
    """The fixes that are compared, of one piece of the odometry."""

    stamp_ns: Ints
    """(A,)."""
    enu_m: Floats
    """(A, 3)."""
    at: Floats
    """(A, 3) the odometry there."""


def in_metres(odometry: Odometry, gps: Gps, camera: Camera) -> Odometry | None:
    """Odometry with its steps multiplied by the scale that the fixes imply; None where the body does not move far
    enough for one. Pieces without such fixes take the scale of the others, see `without_scale`."""
    lever = camera.body_from_camera
    poses = se3.inverse(lever) @ odometry.odom_from_body @ lever
    bounds = np.concatenate([[0], odometry.breaks, [len(poses)]]).tolist()
    sigma_m = _sigma_m(gps)
    ways = [_way(odometry.stamp_ns[a:b], poses[a:b], gps, sigma_m) for a, b in pairwise(bounds)]
    found = [_log_scale(way, sigma_m) if len(way.stamp_ns) >= _LEAST else None for way in ways]
    known = [one for one in found if one is not None]
    if not known:
        return None
    common = float(np.median(np.concatenate(known)))
    log_scale = np.full(len(poses), common)
    for way, one, a, b in zip(ways, found, bounds[:-1], bounds[1:], strict=True):
        if one is not None:
            middle = (way.stamp_ns[1:] - odometry.stamp_ns[0] + way.stamp_ns[:-1] - odometry.stamp_ns[0]) / 2.0
            log_scale[a:b] = np.interp(odometry.stamp_ns[a:b] - odometry.stamp_ns[0], middle, one)
    metric = replace(scaled(odometry, np.exp(log_scale), camera), metric=True)
    unmeasured = [piece for piece, one in zip(pairwise(bounds), found, strict=True) if one is None]
    return without_scale(metric, unmeasured, "satellite fixes")


def without_scale(odometry: Odometry, pieces: list[tuple[int, int]], what: str) -> Odometry:
    """Odometry whose steps are as unsure as they are long in these pieces (from row, to row), where no scale was
    measured and that of the others stands in; they are noted."""
    pieces = [(a, b) for a, b in pieces if b - a > 1]
    if not pieces or odometry.covariance is None:
        return odometry
    covariance = odometry.covariance.copy()
    for a, b in pieces:
        step = se3.between(odometry.odom_from_body[a : b - 1], odometry.odom_from_body[a + 1 : b])[:, :3, 3]
        # an error of scale adds up over the piece, while those of its steps are summed as independent
        covariance[a + 1 : b, 3:, 3:] += (b - a) * _ANY_SCALE**2 * step[:, :, None] * step[:, None, :]
    since_s = (odometry.stamp_ns - odometry.stamp_ns[0]) / 1e9
    named = ", ".join(f"{since_s[a]:.1f} to {since_s[b - 1]:.1f} s" for a, b in pieces[:_NAMED])
    more = ", ..." if len(pieces) > _NAMED else ""
    warn(
        f"Visual odometry has no {what} by which to tell its scale in {len(pieces)} of its pieces ({named}{more}): "
        "that of the others is assumed, and may be wrong there."
    )
    return replace(odometry, covariance=covariance)


def scaled(odometry: Odometry, scale: Floats, camera: Camera) -> Odometry:
    """Odometry whose steps to each sample are multiplied (T,), those of the camera, as its place on the body is in
    metres."""
    lever = camera.body_from_camera
    poses = se3.inverse(lever) @ odometry.odom_from_body @ lever
    steps = np.diff(poses[:, :3, 3], axis=0) * scale[1:, None]
    steps[odometry.breaks - 1] = 0.0
    poses[1:, :3, 3] = poses[0, :3, 3] + np.cumsum(steps, axis=0)
    covariance = odometry.covariance
    if covariance is not None:
        covariance = covariance.copy()
        covariance[:, 3:] *= scale[:, None, None]
        covariance[:, :, 3:] *= scale[:, None, None]
    return replace(odometry, odom_from_body=lever @ poses @ se3.inverse(lever), covariance=covariance)


def random_walk(sigma: Floats) -> sparse.csr_array:
    """(N, N + 1) differences of neighbours in units of their sigmas (N,): the prior of a scale that wanders."""
    differences = sparse.diags_array([-1.0, 1.0], offsets=[0, 1], shape=(len(sigma), len(sigma) + 1)).tocsr()
    return sparse.diags_array(1.0 / sigma) @ differences


def _sigma_m(gps: Gps) -> float:
    """Standard deviation of a fix per axis in the plane: that claimed, or that of fixes about the line between their
    neighbours where it is larger."""
    variance = np.trace(gps.covariance[:, :2, :2], axis1=1, axis2=2) / 2.0  # the altitude may not be known
    known = variance[np.isfinite(variance) & (variance > 0)]
    claimed = float(np.sqrt(np.median(known))) if len(known) else RECEIVER_SIGMA_M
    fixes = local_enu(gps)
    new = np.append(
        True, (np.diff(fixes.enu_m[:, :2], axis=0) != 0).any(axis=1)
    )  # receivers' are repeated at a higher rate
    stamp_ns, enu_m = fixes.stamp_ns[new], fixes.enu_m[new]
    share = ((stamp_ns[1:-1] - stamp_ns[:-2]) / (stamp_ns[2:] - stamp_ns[:-2]))[:, None]
    off = (enu_m[1:-1] - (1.0 - share) * enu_m[:-2] - share * enu_m[2:])[stamp_ns[2:] - stamp_ns[:-2] <= _STRAIGHT_NS]
    spread = 1.4826 * float(np.median(np.abs(off[:, :2]))) if len(off) else 0.0
    return max(claimed, spread / 1.5**0.5)


def _way(stamp_ns: Ints, poses: Floats, gps: Gps, sigma_m: float) -> _Way:
    """Fixes within these samples, each `_APART` sigmas or more from the one before it."""
    fixes = local_enu(gps)
    inside = np.flatnonzero((fixes.stamp_ns >= stamp_ns[0]) & (fixes.stamp_ns <= stamp_ns[-1]))
    chosen = list[int]()
    for row in inside.tolist():
        if not chosen or np.linalg.norm(fixes.enu_m[row] - fixes.enu_m[chosen[-1]]) >= _APART * sigma_m:
            chosen.append(row)
    at = np.zeros((0, 3))
    if chosen and len(stamp_ns) > 1:
        at = se3.interpolate_at(stamp_ns, poses, fixes.stamp_ns[chosen])[:, :3, 3]
    return _Way(fixes.stamp_ns[chosen][: len(at)], fixes.enu_m[chosen][: len(at)], at)


def _log_scale(way: _Way, sigma_m: float) -> Floats | None:
    """(A-1,) between each two fixes: least squares of the logs of distances, of a scale that wanders slowly."""
    steps, count = np.diff(way.at, axis=0), len(way.at) - 1
    pairs = np.array([(a, a + reach) for reach in _REACH for a in range(count + 1 - reach)])
    square = ((way.enu_m[pairs[:, 1]] - way.enu_m[pairs[:, 0]]) ** 2).sum(1) - 6.0 * sigma_m**2
    own = np.linalg.norm(way.at[pairs[:, 1]] - way.at[pairs[:, 0]], axis=1)
    good = (square > (_APART * sigma_m / 2.0) ** 2) & (own > 0)
    pairs, length = pairs[good], np.sqrt(square[good])
    if not len(pairs):
        return None
    x = np.full(count, float(np.median(np.log(length / own[good]))))
    size = np.diff(pairs, axis=1).ravel()
    row = np.repeat(np.arange(len(pairs)), size)
    column = np.concatenate([np.arange(a, b) for a, b in pairs.tolist()])
    metres = np.linalg.norm(np.diff(way.enu_m, axis=0), axis=1)
    smooth = random_walk(SCALE_WANDER * np.sqrt((metres[1:] + metres[:-1]) / 2.0))
    sigma = np.sqrt(2.0) * sigma_m / length
    for _ in range(_ROUNDS):
        moved = np.exp(x)[:, None] * steps
        cumulative = np.concatenate([np.zeros((1, 3)), np.cumsum(moved, axis=0)])
        chord = cumulative[pairs[:, 1]] - cumulative[pairs[:, 0]]
        reached = np.maximum(np.linalg.norm(chord, axis=1), 1e-9)
        residual = np.log(length / reached) / sigma
        weight = np.sqrt(np.minimum(1.0, _TUNING / np.maximum(np.abs(residual), 1e-9))) / sigma
        gradient = (moved[column] * (chord / reached[:, None])[row]).sum(1) / reached[row]
        A = sparse.vstack([sparse.csr_array((gradient * weight[row], (row, column)), (len(pairs), count)), smooth])
        b = np.concatenate([residual * sigma * weight, -(smooth @ x)])
        step = sparse.linalg.spsolve((A.T @ A).tocsc(), A.T @ b)
        x = x + np.clip(step, -0.5, 0.5)
        if np.abs(step).max() < 1e-4:
            break
    return x
