"""Poses of three points, and the one that most matches agree with."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vplog import geometry
from vplog.loops import three_points


def seen_from(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    moved = geometry.transform(pose, points)
    return moved[:, :2] / moved[:, 2:]


@settings(max_examples=200, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_one_of_the_poses_of_three_points_is_the_true_one_and_all_see_them_where_they_are(seed: int) -> None:
    rng = np.random.default_rng(seed)
    points = rng.uniform([-3, -3, 2], [3, 3, 10], (3, 3))
    true = geometry.exp(np.concatenate([rng.normal(0, 0.2, 3), rng.normal(0, 0.3, 3)]))
    if (geometry.transform(true, points)[:, 2] < 0.5).any():
        return
    seen = seen_from(true, points)
    bearing = np.column_stack([seen, np.ones(3)])
    bearing /= np.linalg.norm(bearing, axis=1, keepdims=True)
    poses = np.empty((4, 3, 4))
    count = three_points._poses(points, bearing, np.arange(3), poses)
    found = poses[:count]
    assert count
    for pose in found:
        np.testing.assert_allclose(seen_from(np.vstack([pose, [0, 0, 0, 1]]), points), seen, atol=1e-5)
        np.testing.assert_allclose(pose[:, :3] @ pose[:, :3].T, np.eye(3), atol=1e-9)
    # a view along the cylinder through the points fixes the pose to the root of the rounding only
    assert np.abs(found - true[:3]).max(axis=(1, 2)).min() < 1e-3


@pytest.mark.parametrize("wrong", [0, 20, 36, 44])
def test_the_pose_is_found_among_wrong_matches(wrong: int) -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform([-3, -3, 2], [3, 3, 10], (60, 3))
    true = geometry.exp(np.array([0.1, -0.2, 0.05, 0.3, -0.1, 0.2]))
    seen = seen_from(true, points)
    seen[:wrong] = rng.uniform(-0.5, 0.5, (wrong, 2))
    found = three_points.find_pose(points, seen, 0.005, 500)
    assert found is not None
    pose, agree = found
    assert agree[wrong:].all()
    assert agree[:wrong].sum() <= 2
    np.testing.assert_allclose(pose, true, atol=1e-6)
    again = three_points.find_pose(points, seen, 0.005, 500)
    assert again is not None
    assert again[0].tobytes() == pose.tobytes()
    np.testing.assert_array_equal(three_points.agreeing(pose, points, seen, 0.005), agree)


@pytest.mark.parametrize(
    "points",
    [np.zeros((0, 3)), np.ones((2, 3)), np.ones((9, 3)), np.column_stack([np.zeros((9, 2)), np.arange(1.0, 10)])],
)
def test_where_no_three_points_fix_a_pose_there_is_none(points: np.ndarray) -> None:
    assert three_points.find_pose(points, np.zeros((len(points), 2)), 0.005, 50) is None
