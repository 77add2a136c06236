"""Figures of queries that may be nowhere: against counting pairs, and where there is nothing to count."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from vplog.evaluate.open_set import auroc, recall_at_false_alarms, score_open_set
from vplog.evaluate.pairs import listed_pairs
from vplog.evaluate.retrieval import Ranks, rank_queries


def ranks_of(scores: np.ndarray, listed: list[list[int]]) -> Ranks:
    pairs = listed_pairs(np.array(listed, np.int64).reshape(-1, 2), *map(np.arange, scores.shape))
    return rank_queries(scores.astype(np.float32), pairs, np.full(len(scores), scores.shape[1]))


def test_the_area_is_the_share_of_pairs_in_order() -> None:
    rng = np.random.default_rng(0)
    scores, positive = rng.integers(0, 9, 60).astype(float), rng.random(60) < 0.4
    above = scores[positive][:, None] - scores[~positive]
    assert auroc(scores, positive) == pytest.approx(((above > 0) + 0.5 * (above == 0)).mean())
    assert auroc(scores, np.ones(60, bool)) is None
    assert auroc(scores, np.zeros(60, bool)) is None


def test_recall_at_false_alarms() -> None:
    """Of 200 queries without a match two may be answered; equals of the third are not."""
    nowhere = np.arange(200.0)
    scores = np.concatenate([nowhere, [197.0, 197.5, 198.5, 500.0]])
    positive = np.arange(204) >= 200
    right = np.where(np.arange(204) == 203, 0.0, 1.0)  # the most certain one is wrong
    assert recall_at_false_alarms(scores, right, positive) == pytest.approx(2 / 4)
    assert recall_at_false_alarms(scores, np.ones(204), positive, share=0.0) == pytest.approx(1 / 4)
    assert recall_at_false_alarms(scores, right, np.ones(204, bool)) is None


def test_figures_of_a_method() -> None:
    scores = np.array([[0.9, 0.1], [0.2, 0.8], [0.5, 0.4], [np.nan, np.nan]])
    found = score_open_set(ranks_of(scores, [[0, 0], [1, 0]]))
    assert found == {"without_match": 2, "auroc": 1.0, "recall_at_1_percent_false_alarms": 0.5}
    stated = replace(ranks_of(scores, [[0, 0], [1, 0]]), p_match=np.array([1.0, 0.5, 0.0, np.nan]))
    known = score_open_set(stated)["p_match"]
    assert (known["auroc"], known["mean"], sum(known["count"])) == (1.0, 0.5, 3)
    assert known["expected_calibration_error"] == pytest.approx(0.5 / 3, abs=1e-6)
    assert score_open_set(ranks_of(scores, [])) == {}


def test_queries_that_have_nothing_to_be_found_in_are_not_nowhere() -> None:
    """The first frames of a drive in its own past: no score of theirs says that they were told apart."""
    scores = np.array([[np.nan, np.nan], [0.9, np.nan], [0.3, 0.8]], np.float32)
    pairs = listed_pairs(np.array([[2, 1]]), np.arange(3), np.arange(2))
    found = score_open_set(
        replace(rank_queries(scores, pairs, np.array([0, 1, 2])), p_match=np.array([np.nan, 0.5, 1.0]))
    )
    assert (found["without_match"], found["auroc"], found["recall_at_1_percent_false_alarms"]) == (1, 0.0, 0.0)
    assert found["p_match"]["auroc"] == 1.0
    first = score_open_set(
        rank_queries(scores[[0, 2]], listed_pairs(np.array([[1, 1]]), np.arange(2), np.arange(2)), np.array([0, 2]))
    )
    assert (first["without_match"], first["auroc"]) == (0, None)
