"""Visual odometry with an IMU: gravity, metres of a single camera, and gaps where tracking was lost.

Metres are taken where the motion excites them, by the standard deviation of their scale.
"""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import NamedTuple

import numpy as np

from vplog.data import Camera, Floats, Imu, Keyframes, Odometry
from vplog.geometry import se3
from vplog.graph.correct_trajectory import correct_trajectory
from vplog.odometry.imu_graph import GRAVITY, Solved, States, gyro_bias, preintegrated, solved
from vplog.odometry.metric_scale import scaled

_PERIOD_NS = 190_000_000
"""ns between two states, at least: VINS' keyframes; a double integral over less is noise."""
SURE = 0.1
"""Sigma of the scale's log up to which it gives metres: as much as a single camera's wanders in 100 m."""
_LEAST_STATES = 10
"""States that determine a scale, biases and gravity: two seconds."""
_AGREES = 0.5
"""Share of the variance of the images' turns that a gyroscope must explain, else its mount or its clock is wrong."""
_NEAR = 3.0
"""m; sigma of the motion across a break up to which it is none."""


class Inertial(NamedTuple):
    """Odometry with an IMU."""

    odometry: Odometry
    """In a world whose z is up."""
    scale: float
    """Metres of its unit, in the median; 1 where it had metres."""
    sigma: float
    """Standard deviation of the log of the scale, where it is least known; 0 where it had metres."""
    bridged: int
    """Breaks that it crosses."""


def with_imu(odometry: Odometry, imu: Imu, camera: Camera) -> Inertial | str:
    """The odometry with gravity, breaks that the IMU crosses, and metres where they are sure; else why not."""
    if why := _not_accelerations(imu):
        return why
    states = _states(odometry, imu, camera, np.zeros(3))
    known = [one is not None for one in states.imu]
    if np.count_nonzero(known & ~states.broken) < _LEAST_STATES:
        return f"it covers less than {_LEAST_STATES} of the frames followed"
    bias, explained = gyro_bias(states)
    if explained < _AGREES:
        return "its turns are not those of the images: its mount (static transform) or its clock is another's"
    states = _states(odometry, imu, camera, bias)
    found = solved(states, odometry.metric)
    if found is None:
        return "its measurements and the images have no common solution"
    return _inertial(odometry, camera, states, found)


def _not_accelerations(imu: Imu) -> str:
    norm = float(np.median(np.linalg.norm(imu.accel, axis=1))) if len(imu.accel) else 0.0
    if 0.8 * GRAVITY < norm < 1.25 * GRAVITY:
        return ""
    return f"its accelerations have a median of {norm:.2g} m/s^2, where gravity has {GRAVITY}"


def _states(odometry: Odometry, imu: Imu, camera: Camera, bias: Floats) -> States:
    """Frames at a distance in time, and those at breaks, with what the IMU measured between them."""
    chosen = list[int]()
    for a, b in pairwise([0, *odometry.breaks.tolist(), len(odometry.stamp_ns)]):
        inside = [a]
        for row in range(a + 1, b):
            if odometry.stamp_ns[row] - odometry.stamp_ns[inside[-1]] >= _PERIOD_NS:
                inside.append(row)
        if len(inside) > 1:
            inside[-1] = b - 1
        chosen += inside
    rows = np.array(chosen)
    lever = camera.body_from_camera
    cameras = odometry.odom_from_body[rows] @ lever
    ad = se3.adjoint(se3.inverse(lever))
    each = np.zeros((len(odometry.stamp_ns), 6, 6)) if odometry.covariance is None else odometry.covariance
    sums = np.concatenate([np.zeros((1, 6, 6)), np.cumsum(ad @ each @ ad.T, axis=0)])
    covariance = np.zeros((len(rows), 6, 6))
    covariance[1:] = sums[rows[1:] + 1] - sums[rows[:-1] + 1]
    stamps = odometry.stamp_ns[rows]
    measured = [None, *(preintegrated(imu, int(a), int(b), bias) for a, b in pairwise(stamps))]
    return States(
        rows, cameras, se3.inverse(imu.body_from_imu) @ lever, covariance, np.isin(rows, odometry.breaks), measured
    )


def _inertial(odometry: Odometry, camera: Camera, states: States, found: Solved) -> Inertial:
    """The odometry by the solution."""
    sure = found.sigma <= SURE
    stamps = odometry.stamp_ns[states.rows]
    log_scale = np.interp(odometry.stamp_ns - stamps[0], stamps - stamps[0], found.log_scale)
    body_from_camera, poses = camera.body_from_camera, found.poses @ states.imu_from_camera
    if sure:
        odometry = replace(scaled(odometry, np.exp(log_scale), camera), metric=True)
    else:  # turns alone
        steps = np.diff(poses[:, :3, 3], axis=0) * np.exp(-found.log_scale[1:, None])
        poses[1:, :3, 3] = poses[0, :3, 3] + np.cumsum(steps, axis=0)
    own = Keyframes("", stamps, odometry.odom_from_body[states.rows])
    bodies = poses @ se3.inverse(body_from_camera)
    moved = correct_trajectory(odometry, own, bodies).world_from_body
    bridged = np.array([states.imu[k] is not None for k in np.flatnonzero(states.broken).tolist()], bool)
    breaks, covariance = odometry.breaks, odometry.covariance
    if covariance is not None and len(bridged):
        near = np.sqrt(np.trace(found.broken[:, 3:, 3:], axis1=1, axis2=2)) < _NEAR
        bridged &= near & sure
        ad = se3.adjoint(body_from_camera @ se3.inverse(states.imu_from_camera))
        covariance = covariance.copy()
        covariance[breaks[bridged]] = ad @ found.broken[bridged] @ ad.T
        breaks = breaks[~bridged]
        for row in breaks.tolist():  # the position is held
            moved[row:, :3, 3] += moved[row - 1, :3, 3] - moved[row, :3, 3]
    result = replace(odometry, odom_from_body=moved, breaks=breaks, covariance=covariance)
    return Inertial(result, float(np.exp(np.median(found.log_scale))), found.sigma, int(bridged.sum()))
