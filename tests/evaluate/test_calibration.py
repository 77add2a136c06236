from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from vplog.errors import TruthError
from vplog.evaluate.retrieval import reliability

ANSWERS = st.lists(st.tuples(st.floats(0, 1), st.booleans()), min_size=1, max_size=60)


def test_a_worked_example() -> None:
    found = reliability([0.1, 0.2, 0.6, 0.8, 1.0], np.array([False, True, False, True, True]), 2)
    assert found.edges == pytest.approx([0, 0.5, 1])
    assert list(found.count) == [2, 3]
    assert found.confidence == pytest.approx([0.15, 0.8])
    assert found.accuracy == pytest.approx([0.5, 2 / 3])
    assert found.expected_calibration_error == pytest.approx((2 * 0.35 + 3 * (0.8 - 2 / 3)) / 5)
    assert found.overconfidence == pytest.approx((2.7 - 3) / 5)


def test_outcomes_drawn_from_the_probabilities_are_calibrated() -> None:
    rng = np.random.default_rng(0)
    probability = rng.random(100_000)
    right = rng.random(100_000) < probability
    # the mean of |share - p| over 10 bins of 10 000 draws is below sqrt(.25 / 10 000) = .005
    assert reliability(probability, right, 10).expected_calibration_error < 0.005
    assert reliability(np.sqrt(probability), right, 10).overconfidence == pytest.approx(2 / 3 - 1 / 2, abs=0.01)


@given(ANSWERS, st.integers(1, 20))
def test_agrees_with_a_loop_over_the_bins(answers: list[tuple[float, bool]], bins: int) -> None:
    probability, right = np.array([p for p, _ in answers]), np.array([r for _, r in answers])
    found = reliability(probability, right, bins)
    assert found.count.sum() == len(answers)
    error = 0.0
    for b in range(bins):
        upper = probability <= 1 if b == bins - 1 else probability < found.edges[b + 1]
        inside = (probability >= found.edges[b]) & upper
        assert found.count[b] == inside.sum()
        if not inside.any():
            assert np.isnan(found.confidence[b]) and np.isnan(found.accuracy[b])
            continue
        assert found.confidence[b] == pytest.approx(probability[inside].mean())
        assert found.accuracy[b] == pytest.approx(right[inside].mean())
        error += inside.sum() * abs(probability[inside].mean() - right[inside].mean())
    assert found.expected_calibration_error == pytest.approx(error / len(answers))


def test_one_bin_tells_the_mean() -> None:
    found = reliability([0.0, 1.0, 1.0, 1.0], np.array([True, True, False, False]), 1)
    assert found.expected_calibration_error == pytest.approx(0.25) == found.overconfidence


def test_refuses_what_is_no_probability() -> None:
    nothing = np.zeros(0, bool)
    with pytest.raises(TruthError, match="No query has an answer"):
        reliability([], nothing, 10)
    for bad in ([1.5], [-0.1], [np.nan]):
        with pytest.raises(ValueError, match="between 0 and 1"):
            reliability(bad, np.array([True]), 10)
    with pytest.raises(ValueError, match="outcomes"):
        reliability([0.5], np.array([True, False]), 10)
