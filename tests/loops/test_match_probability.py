"""Probabilities of answers, learned without a truth: on drawn scores whose truth is known."""

from __future__ import annotations

import numpy as np
import pytest

from vplog.loops.false_rate import conformal_p
from vplog.loops.match_probability import best_places, match_probabilities, place_extent

Q, M = 300, 400


def drawn(
    share: float, seed: int = 0, lift: float = 6.0, others: float = 1.0
) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scores of look-alike rows; `share` of the queries have a place of five rows that scores more, and score others
    `others` times as high. With it the best rows, and which of them are right."""
    rng = np.random.default_rng(seed)
    scores = rng.gumbel(0, 1, (Q, M)).astype(np.float32)
    scores = np.apply_along_axis(lambda row: np.convolve(row, [0.5, 1.0, 0.5], "same"), 1, scores)
    at = rng.integers(5, M - 5, Q)
    inside = rng.random(Q) < share
    scores[inside] *= others
    for query in np.flatnonzero(inside):
        scores[query, at[query] - 2 : at[query] + 3] += lift * rng.uniform(1.0, 3.0)
    best = scores.argmax(1)
    return scores, np.full(Q, M), inside & (np.abs(best - at) <= 2)


@pytest.mark.parametrize(("share", "cautious"), [(0.3, 0.1), (0.5, 0.15), (0.8, 0.25)])
def test_probabilities_are_those_of_being_right(share: float, cautious: float) -> None:
    """Or less: where most queries have a place, too little is known of what others would reach."""
    scores, stops, right = drawn(share)
    p = match_probabilities(scores, stops)
    assert p is not None
    assert ((p >= 0) & (p <= 1)).all()
    assert right.mean() - cautious < p.mean() < right.mean() + 0.08
    sure = p > 0.5
    assert sure.any()
    assert right[sure].mean() > p[sure].mean() - 0.05
    order = np.argsort(scores.max(1))
    assert (np.diff(p[order]) >= -1e-9).all()  # falls with the score alone


@pytest.mark.parametrize("share", [0.1, 0.3, 0.5, 0.8])
def test_queries_that_have_a_place_may_score_others_low(share: float) -> None:
    """As where scores are shares of what explains a view: queries that are nowhere tell what look-alikes reach."""
    means = np.array(
        [
            (found.mean(), right.mean())
            for scores, stops, right in (drawn(share, seed, others=0.2) for seed in range(3))
            if (found := match_probabilities(scores, stops)) is not None
        ]
    )
    assert means.shape == (3, 2)
    assert abs(means[:, 0] - means[:, 1]).max() < 0.15


def test_drives_that_share_nothing() -> None:
    """Few queries pass for found where none is in the map."""
    scores, stops, right = drawn(0.0)
    p = match_probabilities(scores, stops)
    assert not right.any()
    assert p is not None
    assert p.mean() < 0.25
    assert (p > 0.9).mean() < 0.05


def test_too_few_queries_teach_nothing() -> None:
    scores, stops, _ = drawn(0.5)
    assert match_probabilities(scores[:19], stops[:19]) is None
    stops[10:] = 2  # no third place
    assert match_probabilities(scores, stops) is None
    stops[:50] = M
    found = match_probabilities(scores, stops)
    assert found is not None
    assert np.isnan(found).tolist() == [False] * 50 + [True] * (Q - 50)


def test_a_place_is_as_long_as_scores_hang_together() -> None:
    rng = np.random.default_rng(0)
    noise = rng.normal(size=(50, 300))
    assert place_extent(noise.astype(np.float32)) == 2
    smooth = np.array([np.convolve(row, np.ones(11), "same") for row in noise], np.float32)
    assert 10 <= place_extent(smooth) <= 18  # the correlation of 11 rows falls by a tenth a row
    smooth[:, 200:] = np.nan
    assert 10 <= place_extent(smooth) <= 18


def test_other_places_are_elsewhere() -> None:
    row = np.array([0, 5, 9, 8, 1, 6, np.nan, 2], np.float32)
    np.testing.assert_array_equal(best_places(row, 1), [9.0, 6.0, 2.0])
    np.testing.assert_array_equal(best_places(row, 3), [9.0, 2.0, np.nan])
    np.testing.assert_array_equal(best_places(row, 7), [9.0, np.nan, np.nan])
    assert np.isnan(best_places(row[:0], 1)).all()


def test_conformal_p_values_count_themselves() -> None:
    null = np.array([3.0, 1.0, 2.0, 2.0])
    np.testing.assert_allclose(conformal_p(np.array([0.0, 2.0, 2.5, 9.0]), null), [1.0, 0.8, 0.4, 0.2])
