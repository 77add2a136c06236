"""Jumps of odometry: steps that no motion explains, of a relocalisation, a reset to zero or a stray pose."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from vplog import geometry
from vplog.logs.containers import plural

if TYPE_CHECKING:
    from vplog.data import Floats, Ints, Odometry
    from vplog.logs.containers import Notes

_ACCELERATION_M_S2 = 10.0
"""m/s^2; tyres hold 1 g, and what flies or is carried rarely has more for longer than a sample."""
_TURN_RAD_S = 12.0
"""rad/s; two revolutions a second, by which no camera sees anything."""
_LEAST_TURN_RAD = 0.1
"""rad; a smaller turn in one step is noise of short periods."""
_TIMES = 10.0
"""A jump departs so many times further from the motion beside it than nine tenths of the drive's own steps do."""
_PERIODS = 3.0
"""A jump is also longer than the way of so many periods: stamps that jitter crowd that much motion into one step."""
_BESIDE = 3
"""Steps on either side whose median speed a step is held against: one or two of them may be jumps themselves."""
_LEAST = 4 * _BESIDE
"""Poses; fewer do not tell what is usual."""
_NAMED = 4
"""Jumps that are named."""


def find_jumps(stamp_ns: Ints, poses: Floats) -> Ints:
    """Rows of poses (T, 4, 4) at (T,) increasing stamps from which the next pose is reached by a jump."""
    if len(stamp_ns) < _LEAST:
        return np.zeros(0, np.int64)
    seconds = np.diff(stamp_ns) / 1e9
    step = geometry.between(poses[:-1], poses[1:])
    speed = step[:, :3, 3] / seconds[:, None]
    departure_m = np.linalg.norm(speed - _beside(speed), axis=1) * seconds
    least_s = np.maximum(seconds, np.median(seconds))
    window_s = np.convolve(seconds, np.ones(2 * _BESIDE + 1), "same")
    usual_m_s, turn = _usual(np.linalg.norm(speed, axis=1)), geometry.angle(step)
    limits_m = (
        _ACCELERATION_M_S2 * least_s * window_s / 2, _TIMES * _usual(departure_m), _PERIODS * usual_m_s * least_s
    )  # fmt: skip
    limits_rad = (_TURN_RAD_S * least_s, _TIMES * _usual(turn), _LEAST_TURN_RAD)
    far = np.all([departure_m > limit for limit in limits_m], axis=0)
    turned = np.all([turn > limit for limit in limits_rad], axis=0)
    return np.flatnonzero(np.logical_or(far, turned))


def without_jumps(odometry: Odometry, what: str, notes: Notes) -> Odometry:
    """The odometry with its motion continued over each jump as it was before; stray poses are left out. Both is said.

    What follows a jump is moved as one piece, so every other step stays as logged. The covariance of the pose behind a
    jump becomes unknown.
    """
    stamp_ns, poses, covariance = odometry.stamp_ns, odometry.odom_from_body, odometry.covariance
    rows = find_jumps(stamp_ns, poses)
    stray = _stray(stamp_ns, poses, rows)
    if stray.any():
        notes.add(f"{what}: {plural(int(stray.sum()), 'pose')} far off those before and behind left out.")
        stamp_ns, poses = stamp_ns[~stray], poses[~stray]
        covariance = None if covariance is None else covariance[~stray]
        rows = find_jumps(stamp_ns, poses)
    if len(rows):
        notes.add(_sentence(stamp_ns, poses, rows, what))
        poses = _continued(stamp_ns, poses, rows)
        covariance = None if covariance is None else covariance.copy()
        if covariance is not None:
            covariance[rows + 1] = np.nan
    return replace(odometry, stamp_ns=stamp_ns, odom_from_body=poses, covariance=covariance)


def _beside(speed: Floats) -> Floats:
    """(T, 3) median of each speed and those beside it."""
    around = np.pad(speed, ((_BESIDE, _BESIDE), (0, 0)), mode="reflect")
    return np.asarray(np.median(sliding_window_view(around, 2 * _BESIDE + 1, axis=0), axis=-1))


def _usual(values: Floats) -> float:
    """What nine tenths of the values stay below, zeros left out: a robot that stands has no say."""
    moving = values[values > 0]
    return float(np.quantile(moving, 0.9)) if len(moving) else 0.0


def _stray(stamp_ns: Ints, poses: Floats, rows: Ints) -> np.ndarray:
    """(T,) bool: poses between two jumps close together, without which there is none."""
    stray = np.zeros(len(stamp_ns), bool)
    for a, b in zip(rows[:-1].tolist(), rows[1:].tolist(), strict=True):
        if b - a < _BESIDE and not stray[a]:
            kept = np.ones(len(stamp_ns), bool)
            kept[a + 1 : b + 1] = False
            near = slice(max(a - _LEAST, 0), b + _LEAST)
            kept_near = kept[near]
            jumps = find_jumps(stamp_ns[near][kept_near], poses[near][kept_near])
            stray[a + 1 : b + 1] = a - near.start not in jumps
    return stray


def _continued(stamp_ns: Ints, poses: Floats, rows: Ints) -> Floats:
    """The poses, those behind each jump moved to where the motion before it leads."""
    result = poses.copy()
    for row, stop in zip(rows.tolist(), [*(rows[1:] + 1).tolist(), len(poses)], strict=True):
        onward = np.eye(4)
        if row and row - 1 not in rows:
            share = (stamp_ns[row + 1] - stamp_ns[row]) / (stamp_ns[row] - stamp_ns[row - 1])
            before = geometry.log(geometry.between(poses[row - 1], poses[row])[None])
            onward = geometry.exp(before * min(share, _TIMES))[0]
        result[row + 1 : stop] = result[row] @ onward @ geometry.inverse(poses[row + 1]) @ poses[row + 1 : stop]
    return result


def _sentence(stamp_ns: Ints, poses: Floats, rows: Ints, what: str) -> str:
    metres = np.linalg.norm(poses[rows + 1, :3, 3] - poses[rows, :3, 3], axis=1)
    at_s = (stamp_ns[rows + 1] - stamp_ns[0]) / 1e9
    named = [f"{m:.1f} m at {s:.1f} s" for m, s in zip(metres[:_NAMED], at_s[:_NAMED], strict=True)]
    more = f" and {len(rows) - _NAMED} times more" if len(rows) > _NAMED else ""
    return (
        f"{what}: the poses jump by {', '.join(named)}{more} (a relocalisation or a reset?); the motion before is "
        "continued there, and what follows is moved to it."
    )
