"""Place retrieval: ranks of the true rows, and precision over recall of every query's best answer.

Each figure is its mean over all orders of rows of equal score. A candidate without a score (NaN) was not given as an
answer: it is never counted as found, and it ranks after all candidates that are not true.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike

from vplog.data import Bools, Float32s, Floats, Int32s, Ints
from vplog.errors import TruthError

if TYPE_CHECKING:
    from vplog.evaluate.pairs import Pairs


BINS = 10
"""Bins of the probability: with the 200 answers of a short traversal a bin holds 20."""


@dataclass(frozen=True, eq=False)
class Ranks:
    """Ranks of the true rows of Q queries, by their scores."""

    candidates: Ints
    """(Q,) rows that could be an answer."""
    top_row: Int32s
    """(Q,) the row that scores most, the earliest of several; -1 without an answer."""
    top_score: Float32s
    """(Q,) its score; NaN without an answer: where there is no candidate, or none with a score."""
    top_true: Floats
    """(Q,) share of the rows with that score that are true, 0..1."""
    positive: Bools
    """(Q,) queries with a true row among their candidates."""
    better: Ints
    """(Q,) candidates that rank before the query's best true row: those that score more or, if it has no score, all
    that are not true. 0 if the query has no true row, as below."""
    tied_false: Ints
    """(Q,) other candidates, not true, that score as much."""
    tied_true: Ints
    """(Q,) true rows that score as much, itself included."""
    true_row: Int32s
    """(Q,) the true row that scores most, the earliest of several; -1 where the query has none."""
    true_given: Bools
    """(Q,) queries with a true row that has a score."""
    p_match: Floats | None = None
    """(Q,) probability that the answer is right, NaN without an answer; None where none is stated."""
    evidence: Sequence[str] | None = None
    """(Q,) what most of an answer's score is of, empty without an answer; None where there is one kind of evidence."""


@dataclass(frozen=True, eq=False)
class Curve:
    """Precision over recall of the best answers of all queries, most certain first."""

    threshold: Floats
    """(T,) falling: the different scores of the answers."""
    precision: Floats
    """(T,) answers with at least that score that are true, as a share of these answers."""
    recall: Floats
    """(T,) the same as a share of the positives."""


@dataclass(frozen=True)
class RetrievalScore:
    """The figures of one method."""

    r_at_1: float
    """Share of the positives whose best answer is true."""
    r_at_5: float
    """Share of the positives with a true row among the best 5."""
    r_at_10: float
    anr: float
    """Average normalised rank, %: see `average_normalised_rank`."""
    ap: float
    """Area below precision over recall."""
    recall_at_p100: float
    """Recall of the most answers, most certain first, that are all true."""
    f1: float
    """Largest harmonic mean of precision and recall on the curve."""


def rank_queries(scores: Float32s, truth: Pairs, stops: Ints) -> Ranks:
    """Rank the rows below `stops[q]`, (Q,), of each query by `scores` (Q, M), one row of the matrix at a time.

    Raises ValueError where the shapes do not fit.
    """
    if len(scores) != len(truth) or len(scores) != len(stops):
        raise ValueError(f"{len(scores)} rows of scores, {len(truth)} queries with truth, {len(stops)} stops")
    Q = len(scores)
    truth = truth.below(stops)
    top_row, top_score = np.full(Q, -1, np.int32), np.full(Q, np.nan, np.float32)
    top_true, true_row = np.zeros(Q), np.full(Q, -1, np.int32)
    better, tied_false, tied_true = (np.zeros(Q, np.int64) for _ in range(3))
    true_given = np.zeros(Q, bool)
    for q in range(Q):
        score = np.asarray(scores[q, : stops[q]])
        score = np.where(np.isnan(score), -np.inf, score)
        rows = truth.rows(q)
        true = score[rows]
        if len(score) and score.max() > -np.inf:
            best = score.max()
            top_row[q], top_score[q] = score.argmax(), best
            top_true[q] = np.count_nonzero(true == best) / np.count_nonzero(score == best)
        if len(true):
            best, true_row[q] = true.max(), rows[true.argmax()]
            true_given[q] = best > -np.inf
            if true_given[q]:
                better[q] = np.count_nonzero(score > best)
                tied_true[q] = np.count_nonzero(true == best)
                tied_false[q] = np.count_nonzero(score == best) - tied_true[q]
            else:
                better[q] = len(score) - len(true)
    return Ranks(
        np.asarray(stops, np.int64), top_row, top_score, top_true, truth.positive, better, tied_false, tied_true,
        true_row, true_given,
    )  # fmt: skip


def recall_at(ranks: Ranks, k: int) -> float:
    """R@k: share of the positives with a true row among their k best rows, or among all that have a score if these are
    fewer. Raises TruthError without positives."""
    positive = _positives(ranks)
    slots = k - ranks.better[positive]
    false, tied = ranks.tied_false[positive], ranks.tied_false[positive] + ranks.tied_true[positive]
    missed = np.ones(len(slots))  # chance that the rows drawn for the open slots are all false
    for drawn in range(k):
        chance = np.maximum(false - drawn, 0) / np.maximum(tied - drawn, 1)
        missed *= np.where(drawn < slots, chance, 1.0)
    return float(((1.0 - missed) * ranks.true_given[positive]).mean())


def average_normalised_rank(ranks: Ranks) -> float:
    """ANR in %: the rank of the best true row, counted from 0, over the number of candidates; mean of the positives.

    0 where every query finds a true row first; about 50 by chance for queries with one true row.
    Raises TruthError without positives.
    """
    positive = _positives(ranks)
    # the first of t among t + f rows in random order comes after f / (t + 1) others
    ahead = ranks.better[positive] + ranks.tied_false[positive] / (ranks.tied_true[positive] + 1)
    return float(100.0 * (ahead / ranks.candidates[positive]).mean())


def precision_recall(ranks: Ranks) -> Curve:
    """Every query answers with its best row, if it has one; recall is taken over the positives.

    The answer of a query without a true row is wrong, wherever it stands. Raises TruthError without positives.
    """
    positives = int(_positives(ranks).sum())
    answered = np.flatnonzero(~np.isnan(ranks.top_score))
    score, true = ranks.top_score[answered].astype(np.float64), ranks.top_true[answered]
    order = np.argsort(-score, kind="stable")
    score, found = score[order], np.cumsum(true[order])
    last_of_equal = np.flatnonzero(np.append(score[1:] != score[:-1], True)[: len(score)])  # no threshold parts equals
    found = found[last_of_equal]
    return Curve(score[last_of_equal], found / (last_of_equal + 1), found / positives)


def average_precision(curve: Curve) -> float:
    """Area below the steps of the curve; 0 without a true answer."""
    return float((np.diff(curve.recall, prepend=0.0) * curve.precision).sum())


def recall_at_full_precision(curve: Curve) -> float:
    """Recall of the longest beginning of the curve at precision 1; 0 where the most certain answer is wrong."""
    full = curve.recall[curve.precision == 1.0]
    return float(full.max()) if len(full) else 0.0


def best_f1(curve: Curve) -> float:
    """Largest 2 p r / (p + r) on the curve."""
    total = curve.precision + curve.recall
    f1 = 2.0 * curve.precision * curve.recall / np.where(total > 0, total, 1.0)
    return float(f1.max()) if len(f1) else 0.0


def score_retrieval(ranks: Ranks) -> RetrievalScore:
    """Every figure of one method. Raises TruthError without positives."""
    curve, anr = precision_recall(ranks), average_normalised_rank(ranks)
    r_1, r_5, r_10 = (recall_at(ranks, k) for k in (1, 5, 10))
    ap, full = average_precision(curve), recall_at_full_precision(curve)
    return RetrievalScore(r_1, r_5, r_10, anr, ap, full, best_f1(curve))


def _positives(ranks: Ranks) -> Bools:
    if not ranks.positive.any():
        raise TruthError(
            f"None of the {len(ranks.positive)} queries has a true match among its candidates, so nothing can be "
            "found. Check that the truth is that of these drives, or allow more with its tolerance or distance."
        )
    return ranks.positive


@dataclass(frozen=True, eq=False)
class Reliability:
    """The reliability diagram: B bins of equal width of the probability, 0..1."""

    edges: Floats
    """(B + 1,); a bin has its lower edge, the last both."""
    count: Ints
    """(B,) answers in each."""
    confidence: Floats
    """(B,) their mean probability; NaN in an empty bin."""
    accuracy: Floats
    """(B,) the share of them that are right; NaN in an empty bin."""
    expected_calibration_error: float
    """Mean distance of accuracy and confidence over the answers: 0 where every bin's probability is its accuracy."""

    @property
    def overconfidence(self) -> float:
        """Mean probability less the share that is right, -1..1; positive where answers are more certain than right."""
        filled = self.count > 0
        gap = self.confidence[filled] - self.accuracy[filled]
        return float((self.count[filled] * gap).sum() / self.count.sum())

    def as_json(self) -> dict[str, Any]:
        """The diagram as plain values; None where a bin is empty."""
        filled = self.count > 0
        return {
            "expected_calibration_error": round(self.expected_calibration_error, 6),
            "overconfidence": round(self.overconfidence, 6),
            "count": self.count.tolist(),
            "confidence": [round(c, 6) if f else None for c, f in zip(self.confidence.tolist(), filled, strict=True)],
            "accuracy": [round(a, 6) if f else None for a, f in zip(self.accuracy.tolist(), filled, strict=True)],
        }


def reliability(probability: ArrayLike, right: Bools, bins: int = BINS) -> Reliability:
    """Compare the probabilities (Q,) of Q answers with which of them are right (Q,).

    Guo et al., On calibration of modern neural networks, ICML 2017, Eq. (3). Raises TruthError without answers, and
    ValueError where the shapes do not fit or a probability is not one.
    """
    probability = np.asarray(probability, np.float64)
    right = np.asarray(right, bool)
    if probability.ndim != 1 or probability.shape != right.shape or bins < 1:
        raise ValueError(f"{probability.shape} probabilities, {right.shape} outcomes, {bins} bins")
    if len(probability) == 0:
        raise TruthError(
            "No query has an answer, so there is no probability to calibrate. Give candidates for one query at least."
        )
    if not np.all((probability >= 0) & (probability <= 1)):
        raise ValueError("a probability is not between 0 and 1")
    edges = np.linspace(0.0, 1.0, bins + 1)
    row = np.clip(np.searchsorted(edges, probability, side="right") - 1, 0, bins - 1)
    count = np.bincount(row, minlength=bins)
    filled = np.where(count > 0, count, np.nan)
    confidence = np.bincount(row, probability, minlength=bins) / filled
    accuracy = np.bincount(row, right, minlength=bins) / filled
    error = float(np.nansum(count * np.abs(accuracy - confidence)) / len(probability))
    return Reliability(edges, count, confidence, accuracy, error)
