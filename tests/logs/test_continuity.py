"""Jumps of odometry against drives that have none, and that have been given some."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from scipy.spatial.transform import Rotation

from tests.logs.drives import START_NS, matrices, matrix
from vplog.data import Odometry
from vplog.geometry import se3
from vplog.logs.continuity import find_jumps, without_jumps
from vplog.logs.formats.container import Notes

seeds = st.integers(0, 2**32 - 1)


def drive(seed: int) -> tuple[np.ndarray, np.ndarray]:
    """Stamps and poses of something that speeds up, slows down, stands and turns, at any speed, rate and noise."""
    rng = np.random.default_rng(seed)
    count, rate_hz, fastest = int(rng.integers(60, 400)), rng.uniform(1, 100), 10 ** rng.uniform(-1, 1.5)
    seconds = np.full(count, 1 / rate_hz) * rng.uniform(0.8, 1.2, count)
    change = rng.normal(0, min(0.3 * fastest, 3.0), count) * np.sqrt(seconds)  # an acceleration that bodies have
    speed = np.abs(np.cumsum(change)).clip(0, fastest) * (rng.random(count) < 0.98)
    yaw = np.cumsum(rng.normal(0, 0.3, count) * seconds)
    steps = (speed * seconds)[:, None] * np.stack([np.cos(yaw), np.sin(yaw), np.zeros(count)], 1)
    position = np.cumsum(steps, axis=0) + rng.normal(0, 0.002, (count, 3))
    poses = matrices(position, Rotation.from_rotvec(np.outer(yaw, [0, 0, 1])))
    return START_NS + (np.cumsum(seconds) * 1e9).astype(np.int64), poses


def path_m(poses: np.ndarray) -> float:
    return float(np.linalg.norm(np.diff(poses[:, :3, 3], axis=0), axis=1).sum())


@given(seeds)
def test_no_drive_without_a_jump_has_one(seed: int) -> None:
    stamp_ns, poses = drive(seed)
    odometry = without_jumps(Odometry(stamp_ns, poses, None), "/odom", notes := Notes())
    assert notes.lines == []
    np.testing.assert_array_equal(odometry.odom_from_body, poses)


@given(seeds, st.floats(4, 200), st.sampled_from(["measured", "arrival", "bursts"]))
def test_flips_and_stamps_of_arrival_are_no_jumps(seed: int, rate_hz: float, stamps: str) -> None:
    """A drone that drifts, flips at 19 rad/s, and is shaken by 10 g for 50 ms each way; 1 to 300 ms late."""
    rng = np.random.default_rng(seed)
    fine_s = np.arange(0, 20, 0.005)
    at_s, flips_s = np.array([4, 10, 16]) + rng.uniform(-2, 2, (2, 3))
    turned = 19 * (fine_s[:, None] - flips_s).clip(0, 2 * np.pi / 19).sum(1)
    turned += np.cumsum(rng.normal(0, 0.01, len(fine_s)))
    shaken = 100 * ((np.abs(fine_s[:, None] - at_s) < 0.05) * np.sign(fine_s[:, None] - at_s)).sum(1)
    way = 0.3 * fine_s + np.cumsum(np.cumsum(shaken)) * 0.005**2
    rows = (np.arange(0, 20, 1 / rate_hz) / 0.005).astype(np.int64)
    taken_s = fine_s[rows]
    late_s = {"measured": 0 * taken_s, "arrival": rng.exponential(0.02, len(rows)), "bursts": -taken_s % 0.3}[stamps]
    stamp_ns = START_NS + (np.sort(taken_s + late_s) * 1e9).astype(np.int64) + 10_000 * np.arange(len(rows))
    poses = matrices(way[rows, None] * [1, 0.2, 0], Rotation.from_rotvec(turned[rows, None] * [1, 0, 0]))
    odometry = without_jumps(Odometry(stamp_ns, poses, None), "/odom", notes := Notes())
    assert notes.lines == []
    np.testing.assert_array_equal(odometry.odom_from_body, poses)


@given(seeds, st.integers(1, 3), st.booleans())
def test_jumps_are_found_and_the_motion_continues(seed: int, times: int, resets: bool) -> None:
    """Relocalisations by a multiple of what the drive moves in a second, or the pose set to zero."""
    stamp_ns, true = drive(seed)
    rng = np.random.default_rng([seed, 1])
    rows = np.sort(rng.choice(np.arange(10, len(true) - 10, 8), times, replace=False))
    poses = true.copy()
    step_m = float(np.linalg.norm(np.diff(true[:, :3, 3], axis=0), axis=1).max())
    for row in rows.tolist():
        way = rng.normal(size=3)
        shift = matrix(way / np.linalg.norm(way) * (200 + 100 * step_m), Rotation.from_rotvec(rng.normal(size=3) / 9))
        behind = shift @ poses[row + 1 :]
        poses[row + 1 :] = se3.inverse(poses[row + 1]) @ poses[row + 1 :] if resets else behind
    covariance = np.tile(np.eye(6), (len(true), 1, 1))
    near = np.linalg.norm(poses[rows + 1, :3, 3] - poses[rows, :3, 3], axis=1) < 50 + 50 * step_m
    if near.any():  # a reset close to zero is no jump that could be told
        return
    assert find_jumps(stamp_ns, poses).tolist() == rows.tolist()
    odometry = without_jumps(Odometry(stamp_ns, poses, covariance), "/odom", notes := Notes())
    assert odometry.covariance is not None
    assert np.flatnonzero(np.isnan(odometry.covariance).any((1, 2))).tolist() == (rows + 1).tolist()
    for first, stop in zip([0, *(rows + 1)], [*(rows + 1), len(true)], strict=True):  # every piece is as it was
        part = slice(first, stop)
        was, now = (se3.between(poses[first], poses[part]) for poses in (true, odometry.odom_from_body))
        np.testing.assert_allclose(now, was, atol=1e-6)
    assert path_m(odometry.odom_from_body) <= path_m(true) + 3 * times * step_m
    assert (
        f"/odom: the poses jump by {np.linalg.norm(poses[rows[0] + 1, :3, 3] - poses[rows[0], :3, 3]):.1f} m"
        in (notes.lines[0])
    )


@given(seeds, st.integers(1, 2))
def test_jumps_of_odometry_without_noise_are_found(seed: int, times: int) -> None:
    """A simulator's, or interpolated: speed changes evenly, so that nearly no step deviates but the jumps."""
    rng = np.random.default_rng(seed)
    seconds = np.arange(0, 20, 1 / rng.uniform(8, 50))
    knots = np.arange(0, 24, 3.0)
    speed, turn = (np.interp(seconds, knots, rng.uniform(low, high, 8)) for low, high in ((0.5, 8), (-0.3, 0.3)))
    yaw, period = np.cumsum(turn) * seconds[1], seconds[1]
    place = np.cumsum(np.stack([speed * np.cos(yaw), speed * np.sin(yaw), 0 * yaw], 1), axis=0) * period
    rows = np.sort(rng.choice(np.arange(10, len(seconds) - 10, 8), times, replace=False))
    for row in rows.tolist():
        place[row + 1 :] += rng.choice([-1, 1], 3) * rng.uniform(10, 40)
    poses = matrices(place, Rotation.from_rotvec(np.outer(yaw, [0, 0, 1])))
    assert find_jumps(START_NS + (seconds * 1e9).astype(np.int64), poses).tolist() == rows.tolist()


@given(seeds, st.integers(1, 2))
def test_stray_poses_are_left_out(seed: int, together: int) -> None:
    stamp_ns, true = drive(seed)
    rows = np.arange(20, len(true) - 20, 31)
    stray = (rows[:, None] + np.arange(together)).ravel()
    poses = true.copy()
    poses[stray, :3, 3] += 500.0
    odometry = without_jumps(Odometry(stamp_ns, poses, None), "/odom", notes := Notes())
    np.testing.assert_array_equal(odometry.odom_from_body, np.delete(true, stray, axis=0))
    assert f"{len(stray)} pose" in notes.lines[0]


@pytest.mark.parametrize("count", [1, 2, 5])
def test_few_poses_have_no_jumps(count: int) -> None:
    poses = matrices(1e3 * np.random.default_rng(3).normal(size=(count, 3)), Rotation.identity(count))
    assert not len(find_jumps(START_NS + 10**8 * np.arange(count), poses))
