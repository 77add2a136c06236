"""Retrieval figures against their definitions, written out without a shortcut."""

from __future__ import annotations

from itertools import permutations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vplog.errors import TruthError
from vplog.evaluate import retrieval
from vplog.evaluate.pairs import Pairs, listed_pairs

NAN = float("nan")


def pairs_of(true: np.ndarray) -> Pairs:
    """(Q, M) bool as pairs."""
    return listed_pairs(np.argwhere(true), np.arange(true.shape[0]), np.arange(true.shape[1]))


def ranked(scores: list[list[float]], true: list[list[int]], stops: list[int] | None = None) -> retrieval.Ranks:
    table = np.array(scores, np.float32)
    ends = np.full(len(table), table.shape[1]) if stops is None else np.array(stops)
    return retrieval.rank_queries(table, pairs_of(np.array(true, bool)), ends)


def orders(score: np.ndarray) -> list[np.ndarray]:
    """Every order of the rows by falling score: those that score the same in any order, NaN last."""
    score = np.where(np.isnan(score), -1.0, score)  # below all that problems() draws
    return [np.array(order) for order in permutations(range(len(score))) if (np.diff(score[list(order)]) <= 0).all()]


@st.composite
def problems(draw: st.DrawFn) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Scores (Q, M) with many ties, truth and stops, with a true candidate at least."""
    Q, M = draw(st.integers(1, 4)), draw(st.integers(1, 5))
    levels = st.sampled_from([0.0, 0.25, 0.5, 1.0, NAN])
    scores = np.array(draw(st.lists(st.lists(levels, min_size=M, max_size=M), min_size=Q, max_size=Q)), np.float32)
    truth = np.array(draw(st.lists(st.lists(st.booleans(), min_size=M, max_size=M), min_size=Q, max_size=Q)))
    stops = np.array(draw(st.lists(st.integers(0, M), min_size=Q, max_size=Q)))
    stops[0], truth[0, 0] = max(stops[0], 1), True
    return scores, truth, stops


@settings(max_examples=100, deadline=None)
@given(problems())
def test_ranks_are_means_over_all_orders_of_ties(problem: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    scores, truth, stops = problem
    ranks = retrieval.rank_queries(scores, pairs_of(truth), stops)
    first, hits = [], {k: [] for k in (1, 2, 5)}
    for score, true, stop in zip(scores, truth, stops, strict=True):
        if not true[:stop].any():
            continue
        given = ~np.isnan(score[:stop])
        if not (true[:stop] & given).any():  # the true row is no answer, and comes after all that are not true
            first.append((~true[:stop]).sum() / stop)
            for share in hits.values():
                share.append(0.0)
            continue
        found = np.array([np.flatnonzero(true[:stop][order])[0] for order in orders(score[:stop])])
        first.append(found.mean() / stop)
        for k, share in hits.items():
            share.append((found < k).mean())
    assert ranks.positive.sum() == len(first)
    assert retrieval.average_normalised_rank(ranks) == pytest.approx(100 * np.mean(first))
    for k, share in hits.items():
        assert retrieval.recall_at(ranks, k) == pytest.approx(np.mean(share))


@settings(max_examples=100, deadline=None)
@given(problems())
def test_the_curve_by_its_definition(problem: tuple[np.ndarray, np.ndarray, np.ndarray]) -> None:
    """At every threshold: the answers that score as much, those of them that are true, and the steps below."""
    scores, truth, stops = problem
    ranks = retrieval.rank_queries(scores, pairs_of(truth), stops)
    answers = []
    for score, true, stop in zip(scores, truth, stops, strict=True):
        if stop and not np.isnan(score[:stop]).all():
            best = np.nanmax(score[:stop])
            answers.append((best, true[:stop][score[:stop] == best].mean()))
    positives = sum(bool(true[:stop].any()) for true, stop in zip(truth, stops, strict=True))
    points = []
    for threshold in sorted({score for score, _ in answers}, reverse=True):
        kept = [true for score, true in answers if score >= threshold]
        points.append((threshold, sum(kept) / len(kept), sum(kept) / positives))
    curve = retrieval.precision_recall(ranks)
    np.testing.assert_allclose(
        np.column_stack([curve.threshold, curve.precision, curve.recall]), np.reshape(points, (-1, 3))
    )
    area = below = 0.0
    for _, precision, recall in points:
        area, below = area + (recall - below) * precision, recall
    assert retrieval.average_precision(curve) == pytest.approx(area)
    full = [recall for _, precision, recall in points if precision == 1]
    assert retrieval.recall_at_full_precision(curve) == pytest.approx(max(full, default=0.0))
    f1 = [2 * p * r / (p + r) for _, p, r in points if p + r]
    assert retrieval.best_f1(curve) == pytest.approx(max(f1, default=0.0))


def test_a_case_by_hand() -> None:
    """Answers by falling score: true .9, false .8 (no true row at all), true .7, false .6 (true row second)."""
    ranks = ranked(
        [[0.9, 0.1, 0.0], [0.1, 0.8, 0.2], [0.0, 0.1, 0.7], [0.6, 0.5, 0.4]],
        [[1, 0, 0], [0, 0, 0], [0, 0, 1], [0, 1, 0]],
    )
    score = retrieval.score_retrieval(ranks)
    assert ranks.top_row.tolist() == [0, 1, 2, 0]
    assert score.r_at_1 == pytest.approx(2 / 3)
    assert score.r_at_5 == 1.0
    assert score.anr == pytest.approx(100 * (1 / 3) / 3)
    assert score.ap == pytest.approx(1 / 3 + 1 / 3 * 2 / 3)
    assert score.recall_at_p100 == pytest.approx(1 / 3)
    assert score.f1 == pytest.approx(2 / 3)


def test_perfect_answers() -> None:
    found = retrieval.score_retrieval(ranked([[1, 0], [0, 1]], [[1, 0], [0, 1]]))
    assert (found.r_at_1, found.anr, found.ap, found.recall_at_p100, found.f1) == (1, 0, 1, 1, 1)


def test_rows_beyond_the_stop_are_no_candidates() -> None:
    """The best score, and a true row, stand beyond it."""
    ranks = ranked([[0.1, 0.2, 0.9], [0.3, 0.1, 0.9]], [[0, 1, 0], [0, 0, 1]], stops=[2, 2])
    assert ranks.top_row.tolist() == [1, 0]
    assert ranks.positive.tolist() == [True, False]
    assert ranks.candidates.tolist() == [2, 2]


def test_a_query_without_candidates_or_scores_has_no_answer() -> None:
    ranks = ranked([[0.5, 0.5], [NAN, NAN], [0.2, 0.9]], [[1, 0], [1, 0], [0, 1]], stops=[0, 2, 2])
    assert ranks.top_row.tolist() == [-1, -1, 1]
    assert np.isnan(ranks.top_score).tolist() == [True, True, False]
    curve = retrieval.precision_recall(ranks)
    assert curve.precision.tolist() == [1.0]
    assert curve.recall.tolist() == [0.5]  # of two positives: one has no answer, but could have had one
    assert retrieval.average_normalised_rank(ranks) == pytest.approx(100 * np.mean([1 / 2, 0]))


def test_rows_that_were_not_given_are_not_found_however_many_would_be_counted() -> None:
    """One answer a query, right, wrong and wrong, among three rows: no more are found by looking at five."""
    ranks = ranked([[0.9, NAN, NAN], [0.8, NAN, NAN], [NAN, 0.7, NAN]], [[1, 0, 0], [0, 1, 0], [1, 0, 0]])
    assert [retrieval.recall_at(ranks, k) for k in (1, 2, 5, 10)] == pytest.approx([1 / 3] * 4)
    assert ranks.true_given.tolist() == [True, False, False]
    assert retrieval.average_normalised_rank(ranks) == pytest.approx(100 * np.mean([0, 2 / 3, 2 / 3]))


@settings(max_examples=25, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_the_numbers_of_the_rows_do_not_matter(seed: int) -> None:
    rng = np.random.default_rng(seed)
    scores = rng.integers(0, 5, (20, 30)).astype(np.float32)
    true = rng.random((20, 30)) < 0.1
    true[0, 0] = True
    stops = np.full(20, 30)
    order = rng.permutation(30)
    a = retrieval.score_retrieval(retrieval.rank_queries(scores, pairs_of(true), stops))
    b = retrieval.score_retrieval(retrieval.rank_queries(scores[:, order], pairs_of(true[:, order]), stops))
    assert a == b


def test_without_positives_there_is_nothing_to_report() -> None:
    ranks = ranked([[0.1, 0.2]], [[0, 0]])
    with pytest.raises(TruthError, match="None of the 1 queries has a true match"):
        retrieval.score_retrieval(ranks)


def test_shapes_must_fit() -> None:
    with pytest.raises(ValueError, match="2 rows of scores, 1 queries"):
        retrieval.rank_queries(np.zeros((2, 3), np.float32), pairs_of(np.ones((1, 3), bool)), np.array([3, 3]))
