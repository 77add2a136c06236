"""The pose that most matches agree with, and the number of false alarms of such a pose."""

from __future__ import annotations

from math import comb, log10

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vplog.geometry import se3
from vplog.loops import verify_metric
from vplog.loops.verify_metric import log10_false_alarms


def project(pose: np.ndarray, points: np.ndarray) -> np.ndarray:
    moved = se3.transform(pose, points)
    return moved[:, :2] / moved[:, 2:]


@pytest.mark.parametrize("wrong", [0, 20, 36, 44])
def test_the_pose_is_found_among_wrong_matches(wrong: int) -> None:
    rng = np.random.default_rng(5)
    points = rng.uniform([-3, -3, 2], [3, 3, 10], (60, 3))
    true = se3.exp(np.array([0.1, -0.2, 0.05, 0.3, -0.1, 0.2]))
    seen = project(true, points)
    seen[:wrong] = rng.uniform(-0.5, 0.5, (wrong, 2))
    found = verify_metric.find_pose(points, seen, 0.005, 500)
    assert found is not None
    pose, agree = found
    assert agree[wrong:].all()
    assert agree[:wrong].sum() <= 2
    np.testing.assert_allclose(pose, true, atol=1e-4)  # OpenCV samples in single precision
    again = verify_metric.find_pose(points, seen, 0.005, 500)
    assert again is not None
    assert again[0].tobytes() == pose.tobytes()
    np.testing.assert_array_equal(verify_metric.inliers(pose, points, seen, 0.005), agree)


@pytest.mark.parametrize(
    "points",
    [
        np.zeros((0, 3)),
        np.ones((3, 3)),
        np.ones((9, 3)),
        np.column_stack([np.zeros((9, 2)), np.arange(1.0, 10)]),
        np.full((9, 3), np.nan),
        np.full((9, 3), np.inf),
    ],
)
def test_where_no_three_points_fix_a_pose_there_is_none(points: np.ndarray) -> None:
    assert verify_metric.find_pose(points, np.zeros((len(points), 2)), 0.005, 50) is None


@given(st.integers(8, 300), st.data(), st.sampled_from([(3, 4), (7, 3)]), st.floats(1e-6, 1.0))
def test_agrees_with_the_formula_in_whole_numbers(n: int, data: st.DataObject, kind: tuple[int, int], p: float) -> None:
    sample, models = kind
    k = data.draw(st.integers(sample + 1, n)) if n > sample + 1 else n
    expected = log10(models * (n - sample)) + log10(comb(n, k)) + log10(comb(k, sample)) + (k - sample) * log10(p)
    assert log10_false_alarms(n, k, sample, models, p) == pytest.approx(expected, abs=1e-6)


def test_more_agreement_is_less_chance_and_the_sample_alone_is_none() -> None:
    alarms = [log10_false_alarms(60, k, 3, 4, 1e-3) for k in range(10, 61)]
    assert alarms == sorted(alarms, reverse=True)
    assert log10_false_alarms(60, 3, 3, 4, 1e-3) > 0
    assert log10_false_alarms(0, 0, 3, 4, 1e-3) >= 0
