"""Queries that may be nowhere in the map: whether scores tell them from those that are."""

from __future__ import annotations

from typing import Any

import numpy as np

from vplog.data import Bools, Floats
from vplog.evaluate.retrieval import Ranks, Reliability, reliability

FALSE_ALARMS = 0.01
"""Share of the queries without a match that may be answered."""


def score_open_set(ranks: Ranks) -> dict[str, Any]:
    """Figures of the scores of answers, and of `p_match` where it is known; empty where no query has a match.

    `auroc` and `recall_at_1_percent_false_alarms` need queries without a match, None where all have one. Queries that
    are looked for among no rows, as the first of a drive in its own past, count for neither.
    """
    if not ranks.positive.any():
        return {}
    ranked = ranks.candidates > 0
    positive = ranks.positive[ranked]
    found: dict[str, Any] = {"without_match": int((~positive).sum())}
    scores = np.where(np.isnan(ranks.top_score), -np.inf, ranks.top_score.astype(np.float64))[ranked]
    found["auroc"] = auroc(scores, positive)
    found["recall_at_1_percent_false_alarms"] = recall_at_false_alarms(scores, ranks.top_true[ranked], positive)
    if ranks.p_match is not None:
        known = reliability_of_matches(ranks)
        found["p_match"] = {
            "auroc": auroc(np.nan_to_num(ranks.p_match[ranked], nan=-1.0), positive),
            "mean": round(float(np.nanmean(ranks.p_match)), 6),
            **known.as_json(),
        }
    return found


def reliability_of_matches(ranks: Ranks) -> Reliability:
    """The share of right answers by `p_match`. Raises TruthError where none has one, ValueError without any."""
    if ranks.p_match is None:
        raise ValueError("no probabilities")
    known = ~np.isnan(ranks.p_match)
    return reliability(np.clip(ranks.p_match[known], 0.0, 1.0), ranks.top_true[known] > 0.5)


def auroc(scores: Floats, positive: Bools) -> float | None:
    """Area below the receiver operating characteristic: how often a query (Q,) with a match scores more than one
    without, equals by half (Hanley and McNeil 1982); None where one of the two is missing."""
    count, others = int(positive.sum()), int((~positive).sum())
    if not count or not others:
        return None
    _, group, size = np.unique(scores, return_inverse=True, return_counts=True)
    mean_rank = np.cumsum(size) - (size - 1) / 2  # of equals; scipy.stats takes a second to load
    above = mean_rank[group][positive].sum() - count * (count + 1) / 2
    return float(above / (count * others))


def recall_at_false_alarms(scores: Floats, right: Floats, positive: Bools, share: float = FALSE_ALARMS) -> float | None:
    """Share of the queries with a match that are answered, and rightly (Q,), where the score is above what all but
    `share` of those without a match reach; None without any of these."""
    if positive.all() or not positive.any():
        return None
    nowhere = np.sort(scores[~positive])[::-1]
    bound = nowhere[int(share * len(nowhere))]  # so many may be above it
    return float((right * (scores > bound))[positive].sum() / positive.sum())
