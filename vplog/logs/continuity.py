"""Jumps of odometry: steps that no motion explains, of a relocalisation, a reset to zero or an outlier."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from vplog.data import Floats, Ints, Odometry
from vplog.errors import plural
from vplog.geometry import se3
from vplog.logs.formats.container import Notes
from vplog.logs.stamps import longest_gap_ns

_ACCELERATION_M_S2 = 10.0
"""m/s^2; tyres hold 1 g, and little has more for longer than a moment:"""
_IMPULSE_M_S = 5.0
"""m/s; 10 g for 50 ms, as drones and hands that shake a camera."""
_TURN_RAD_S = 20.0
"""rad/s; three revolutions a second, as fast as drones flip, by which no camera sees anything."""
_LEAST_TURN_RAD = 0.1
"""rad; a smaller turn in one step is noise of short periods."""
_TIMES = 10.0
"""A jump deviates so many times further from the neighbouring motion than nine tenths of the drive's own steps do."""
_PERIODS = 3.0
"""A jump is also longer than the path of so many periods: jittering stamps put that much motion into one step."""
_GAP_S = 1.0
"""s; longer intervals are gaps, and do not count for the period."""
_WINDOW = 3
"""Steps on either side whose median velocity a step is held against: one of them may be a jump itself."""
_LEAST = 4 * _WINDOW
"""Poses; fewer are too few for a quantile."""
_SAME = 1e-3
"""m and rad; a pose that is as near the first one is that of an estimator that was started again,"""
_AWAY_M = 0.5
"""m; unless it was no further from there just before."""
_FASTEST = 0.99
"""Quantile of the speed that a body moves at most in a gap, but for a factor: it may stand but for a while."""
_NAMED = 4
"""Jumps that are named."""


def find_jumps(stamp_ns: Ints, poses: Floats) -> Ints:
    """Rows of poses (T, 4, 4) at (T,) increasing stamps from which the next pose is reached by a jump."""
    if len(stamp_ns) < _LEAST:
        return np.zeros(0, np.int64)
    seconds = np.diff(stamp_ns) / 1e9
    step = se3.between(poses[:-1], poses[1:])
    rotation, translation = se3.so3_log(step[:, :3, :3]), step[:, :3, 3]
    deviation_rad, deviation_m = (_deviation(steps, seconds) for steps in (rotation, translation))
    usual_s = np.minimum(seconds, max(_GAP_S, float(np.median(seconds)))).mean()  # the mean: stamps of bursts crowd
    least_s = np.maximum(seconds, usual_s)
    window_s = np.convolve(seconds, np.ones(3), "same")
    length_m = np.linalg.norm(translation, axis=1)
    limits_m = (
        least_s * (_ACCELERATION_M_S2 * window_s / 2 + _IMPULSE_M_S), _TIMES * _typical(deviation_m, length_m > 0),
        _PERIODS * _typical(length_m / seconds, length_m > 0) * least_s,
    )  # fmt: skip
    turn_rad = np.linalg.norm(rotation, axis=1)
    limits_rad = (_TURN_RAD_S * least_s, _TIMES * _typical(turn_rad, turn_rad > 0), _LEAST_TURN_RAD)
    far = np.all([deviation_m > limit for limit in limits_m], axis=0)
    turned = np.all([deviation_rad > limit for limit in limits_rad], axis=0)
    return np.flatnonzero(np.logical_or(far, turned))


def without_jumps(odometry: Odometry, what: str, notes: Notes) -> Odometry:
    """The odometry with its motion continued over each jump, and without outliers; both are noted. What follows a
    jump is moved as one piece, and the covariance of the pose behind it becomes unknown."""
    stamp_ns, poses, covariance = odometry.stamp_ns, odometry.odom_from_body, odometry.covariance
    restarts = _restarts(stamp_ns, poses)
    if len(restarts):
        seconds = ", ".join(f"{(stamp_ns[row + 1] - stamp_ns[0]) / 1e9:.1f} s" for row in restarts[:_NAMED].tolist())
        notes.add(
            f"{what}: it starts again from its first pose, or from zero, after a gap, at "
            f"{seconds} (a node that was restarted?): only closures and fixes relate what is before to what is behind."
        )
        poses = _extrapolated(stamp_ns, poses, restarts, held=True)
    starts_ns = np.union1d(stamp_ns[odometry.breaks], stamp_ns[restarts + 1])
    rows = find_jumps(stamp_ns, poses)
    outlier = _outlier(stamp_ns, poses, rows)
    if outlier.any():
        notes.add(f"{what}: {plural(int(outlier.sum()), 'pose')} far from those before and after left out.")
        stamp_ns, poses = stamp_ns[~outlier], poses[~outlier]
        covariance = None if covariance is None else covariance[~outlier]
        rows = find_jumps(stamp_ns, poses)
    if len(rows):
        notes.add(_sentence(stamp_ns, poses, rows, what))
        poses = _extrapolated(stamp_ns, poses, rows)
        covariance = None if covariance is None else covariance.copy()
        if covariance is not None:
            covariance[rows + 1] = np.nan
    breaks = np.unique(np.searchsorted(stamp_ns, starts_ns))
    return replace(odometry, stamp_ns=stamp_ns, odom_from_body=poses, covariance=covariance, breaks=breaks)


def _restarts(stamp_ns: Ints, poses: Floats) -> Ints:
    """Rows behind which, after a gap, the poses begin again at the first one, or at zero, as estimators do, further
    than they ever move in the time: in so long any jump might be a motion by what bodies can."""
    seconds, step_m = np.diff(stamp_ns) / 1e9, np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1)
    gap = np.diff(stamp_ns) > longest_gap_ns(stamp_ns)
    rows = np.flatnonzero(gap)
    away = se3.between(poses[:1], poses)
    far_m, far_rad = np.linalg.norm(away[:, :3, 3], axis=1), se3.angle(away)
    same = (far_m < _SAME) & (far_rad < _SAME)
    again = same[rows + 1] & (far_m[rows] > _AWAY_M)
    if (~gap).sum() >= _LEAST:
        fastest = float(np.quantile((step_m / seconds)[~gap], _FASTEST))
        zero = (np.linalg.norm(poses[rows + 1, :3, 3], axis=1) < _AWAY_M) & (
            se3.angle(poses[rows + 1]) < _LEAST_TURN_RAD
        )
        again |= zero & (step_m[rows] > np.maximum(_PERIODS * fastest * seconds[rows], _AWAY_M))
    return rows[again]


def _deviation(steps: Floats, seconds: Floats) -> Floats:
    """(T,) how far each of (T, 3) steps is from those between the medians of the steps before and behind, as velocities
    or, where the stamps jitter, as they are."""
    found = []
    for scale in (seconds, np.ones_like(seconds)):
        rate = steps / scale[:, None]
        around = np.pad(rate, ((_WINDOW, _WINDOW), (0, 0)), mode="reflect")
        level = np.median(sliding_window_view(around, _WINDOW, axis=0), axis=-1)
        ends = level[: len(rate)], level[-len(rate) :]
        found.append(np.linalg.norm(rate - rate.clip(np.minimum(*ends), np.maximum(*ends)), axis=1) * scale)
    return np.minimum(*found)


def _typical(values: Floats, moving: np.ndarray) -> float:
    """The 90 % quantile of the values of steps that move: a robot at rest does not count."""
    return float(np.quantile(values[moving], 0.9)) if moving.any() else 0.0


def _outlier(stamp_ns: Ints, poses: Floats, rows: Ints) -> np.ndarray:
    """(T,) bool: poses between two jumps close together, without which there is none."""
    outlier = np.zeros(len(stamp_ns), bool)
    for a, b in zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True):
        if b - a < _WINDOW and not outlier[a]:
            rest = np.ones(len(stamp_ns), bool)
            rest[a + 1 : b + 1] = False
            near = slice(max(a - _LEAST, 0), b + _LEAST)
            rest_near = rest[near]
            jumps = find_jumps(stamp_ns[near][rest_near], poses[near][rest_near])
            outlier[a + 1 : b + 1] = a - near.start not in jumps
    return outlier


def _extrapolated(stamp_ns: Ints, poses: Floats, rows: Ints, held: bool = False) -> Floats:
    """The poses, those behind each jump moved to where the motion before it leads, or to where it was (`held`)."""
    result = poses.copy()
    for row, stop in zip(rows.tolist(), [*(rows[1:] + 1).tolist(), len(poses)], strict=True):
        onward = np.eye(4)
        if row and row - 1 not in rows and not held:
            share = (stamp_ns[row + 1] - stamp_ns[row]) / (stamp_ns[row] - stamp_ns[row - 1])
            before = se3.log(se3.between(poses[row - 1], poses[row])[None])
            onward = se3.exp(before * min(share, _TIMES))[0]
        result[row + 1 : stop] = result[row] @ onward @ se3.inverse(poses[row + 1]) @ poses[row + 1 : stop]
    return result


def _sentence(stamp_ns: Ints, poses: Floats, rows: Ints, what: str) -> str:
    named = []
    for row in rows[:_NAMED].tolist():
        step = se3.between(poses[row], poses[row + 1])
        metres, degrees = np.linalg.norm(step[:3, 3]), np.degrees(se3.angle(step))
        named.append(f"{metres:.1f} m and {degrees:.0f} deg at {(stamp_ns[row + 1] - stamp_ns[0]) / 1e9:.1f} s")
    more = f" and {len(rows) - _NAMED} times more" if len(rows) > _NAMED else ""
    return (
        f"{what}: the poses jump by {', '.join(named)}{more} (a relocalisation or a reset?); the motion before is "
        "extrapolated there, and later poses are shifted to fit."
    )
