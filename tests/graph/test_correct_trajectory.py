from __future__ import annotations

from dataclasses import replace

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.graph.drive import ring
from vplog.data import Keyframes, Odometry
from vplog.geometry import se3
from vplog.graph.correct_trajectory import correct_trajectory

TRUE = ring(61, 1, noise=0.0).true
STAMPS = np.arange(61, dtype=np.int64) * 100_000_000 + 1_600_000_000_000_000_000


def drive(seed: int, far: float = 0.0) -> tuple[Odometry, Keyframes]:
    """61 samples; every fifth or so is a keyframe, some between two samples, none at the ends."""
    random = np.random.default_rng(seed)
    poses = se3.pose(np.eye(3), np.array([far, -far, 0.0])) @ TRUE
    keys = np.sort(STAMPS[np.arange(4, 57, 5)] + random.choice([0, 37_000_000], 11))
    return Odometry(STAMPS, poses, None), Keyframes("", keys, se3.interpolate_at(STAMPS, poses, keys))


def shifts(seed: int, n: int, size: float = 0.05) -> np.ndarray:
    return se3.exp(np.random.default_rng(seed).normal(size=(n, 6)) * size)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000), st.sampled_from([0.0, 1e6]))
def test_uncorrected_keyframes_leave_the_odometry_as_it_was(seed: int, far: float) -> None:
    odometry, keyframes = drive(seed, far)
    result = correct_trajectory(odometry, keyframes, keyframes.odom_from_body)
    np.testing.assert_allclose(result.world_from_body, odometry.odom_from_body, atol=1e-8)
    np.testing.assert_array_equal(result.stamp_ns, odometry.stamp_ns)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000))
def test_one_motion_of_all_keyframes_moves_the_whole_trajectory(seed: int) -> None:
    odometry, keyframes = drive(seed)
    moved = shifts(seed, 1, 1.0)[0]
    result = correct_trajectory(odometry, keyframes, moved @ keyframes.odom_from_body)
    np.testing.assert_allclose(result.world_from_body, moved @ odometry.odom_from_body, atol=1e-9)


@settings(max_examples=20, deadline=None)
@given(st.integers(0, 1000))
def test_keyframes_are_met_and_the_path_has_no_jumps(seed: int) -> None:
    odometry, keyframes = drive(seed)
    world = keyframes.odom_from_body @ shifts(seed, len(keyframes.stamp_ns))
    result = correct_trajectory(odometry, keyframes, world).world_from_body
    at, sample = np.nonzero(keyframes.stamp_ns[:, None] == STAMPS)
    np.testing.assert_allclose(result[sample], world[at], atol=1e-9)
    before = np.linalg.norm(np.diff(odometry.odom_from_body[:, :3, 3], axis=0), axis=1)
    after = np.linalg.norm(np.diff(result[:, :3, 3], axis=0), axis=1)
    assert (np.abs(after - before) < 0.6).all()  # some 0.3 m between keyframes' corrections, over five samples


def test_samples_outside_of_the_keyframes_hang_on_the_nearest() -> None:
    odometry, keyframes = drive(0)
    world = keyframes.odom_from_body @ shifts(1, len(keyframes.stamp_ns))
    result = correct_trajectory(odometry, keyframes, world).world_from_body
    for key, part in ((0, slice(0, 4)), (-1, slice(57, None))):
        moved = world[key] @ se3.inverse(keyframes.odom_from_body[key])
        np.testing.assert_allclose(result[part], moved @ odometry.odom_from_body[part], atol=1e-9)


def test_one_keyframe_moves_everything() -> None:
    odometry, keyframes = drive(0)
    one = Keyframes("", keyframes.stamp_ns[:1], keyframes.odom_from_body[:1])
    result = correct_trajectory(odometry, one, one.odom_from_body)
    np.testing.assert_allclose(result.world_from_body, odometry.odom_from_body, atol=1e-9)


def test_samples_beside_a_break_move_with_their_own_piece() -> None:
    """The second piece is moved by 50 m: no sample lies on the way between the two."""
    odometry, keyframes = drive(0)
    begin = 31
    odometry = replace(odometry, breaks=np.array([begin]))
    second = keyframes.stamp_ns >= STAMPS[begin]
    moved = np.where(second[:, None, None], se3.pose(np.eye(3), np.array([50.0, 0.0, 0.0])), np.eye(4))
    result = correct_trajectory(odometry, keyframes, moved @ keyframes.odom_from_body).world_from_body
    np.testing.assert_allclose(result[:begin], odometry.odom_from_body[:begin], atol=1e-9)
    np.testing.assert_allclose(result[begin:], moved[-1] @ odometry.odom_from_body[begin:], atol=1e-9)
