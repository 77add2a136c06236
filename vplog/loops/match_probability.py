"""The probability that a query's best row is its place, learned on the queries' own scores without a truth.

Two groups (Efron, Large-Scale Inference, 2010, chapter 5): queries that are somewhere in the map, and queries that are
nowhere, whose best row is the best of rows that only look alike. What such rows reach each query shows by its second
and third best place. Scores with an exponential tail have independent spacings, that of rank i is 1/i of the first in
the mean (Renyi, On the theory of order statistics, 1953): twice the second spacing above the second place is a draw of
what the best of look-alike rows would be.

Queries that have a place need not score others as queries that have none do: where a score is a share of what explains
a view, little is left for others. So a draw counts by how likely its own query is nowhere, which follows from its
spacings alone: the ratio of two exponential spacings of any one scale has a known distribution. Where queries that have
a place score others higher, the probabilities are the more cautious the more of these there are.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from vplog.data import Float32s, Floats, Ints

_LEAST = 20
"""Queries, at least, from which rates can be learned: one more or less then changes them by 5 %."""
_SAMPLED = 200
"""Queries from which the extent of a place is measured."""


def match_probabilities(scores: Float32s, stops: Ints) -> Floats | None:
    """(Q,) probability that the best row shows the query's place, by (Q, M) scores of the rows below each stop (Q,).

    NaN without two more places to compare with; None where too few queries have these.
    """
    extent = place_extent(scores)
    return probabilities(np.array([best_places(scores[q, : stops[q]], extent) for q in range(len(scores))]))


def probabilities(best: Floats, share: Floats | float = 1.0) -> Floats | None:
    """(Q,) probability that the best place is right, by the scores (Q, 3) of the best three; None where too few queries
    have these.

    Where the three are the best of one part of a map, the best look-alike of the whole map, `share` times as large,
    exceeds that of the part by the logarithm of it, in units of the tail.
    """
    known = np.flatnonzero(np.isfinite(best).all(axis=1)) if len(best) else np.empty(0, np.int64)
    if len(known) < _LEAST:
        return None
    found = np.full(len(best), np.nan)
    first, second, third = best[known].T
    tail = 2.0 * (second - third)
    base = second + tail * np.log(np.broadcast_to(share, len(best))[known])
    gap = np.maximum(first - base, 0.0)
    own = np.divide(tail, gap + tail, out=np.ones(len(known)), where=gap + tail > 0)
    found[known] = 1.0 - null_probabilities(first, base + tail, own)
    return found


def place_extent(scores: Float32s) -> int:
    """Rows from the best one within which others may show its place: twice the distance at which the correlation of
    scores along the map falls below 1/e, since two views share something as far as the reach of both."""
    some = np.unique(np.linspace(0, len(scores) - 1, min(_SAMPLED, len(scores))).astype(int))
    rows = np.asarray(scores[some], np.float64)
    finite = np.isfinite(rows)
    total = np.where(finite, rows, 0.0)
    centred = np.where(finite, rows - total.sum(1, keepdims=True) / np.maximum(finite.sum(1, keepdims=True), 1), 0.0)
    power = np.square(centred).sum()
    most = max(scores.shape[1] // 8, 1)
    return 2 * next((d for d in range(1, most) if (centred[:, d:] * centred[:, :-d]).sum() < power / np.e), most)


def best_places(row: Float32s, extent: int) -> Floats:
    """(3,) best scores that are more than `extent` rows from each other; NaN where there are no more."""
    score, found = np.where(np.isfinite(row), row, -np.inf), np.full(3, np.nan, np.float64)
    for place in range(3 if len(score) else 0):
        at = int(score.argmax())
        if score[at] == -np.inf:
            break
        found[place] = score[at]
        score[max(at - extent, 0) : at + extent + 1] = -np.inf
    return found


@dataclass(frozen=True, eq=False)
class LookAlikes:
    """The best scores of places that look alike to each of Q queries, in the part of a map that its first answer is
    of."""

    best: Floats
    """(Q, 3), NaN where there are no more."""
    rows: Floats
    """(Q,) places of that part."""

    @classmethod
    def of(cls, queries: int) -> LookAlikes:
        """None yet."""
        return cls(np.full((queries, 3), np.nan), np.ones(queries))

    def take(self, scores: Float32s, rows: Ints, queries: Ints) -> None:
        """The best of the (rows, M) scores of one part for some queries (V,), whose rows are (V,)."""
        if len(rows):
            extent = place_extent(scores[rows[np.unique(np.linspace(0, len(rows) - 1, _SAMPLED).astype(int))]])
            self.best[queries] = [best_places(scores[row], extent) for row in rows.tolist()]
            self.rows[queries] = scores.shape[1]


def null_probabilities(found: Floats, null: Floats, own: Floats) -> Floats:
    """(N,) local false discovery rate by a null draw of each query, falling with the score. `own`, the p-values of each
    query by itself, tell the share of nulls, by Storey 2002, eq. 6, at one half, and by their density what each draw
    counts."""
    count = len(own)
    share = min(1.0, (1.0 + (own > 0.5).sum()) / (0.5 * count))
    nowhere = np.minimum(1.0, share * _density_ratio(-own, -(np.arange(count) + 0.5) / count, np.ones(count)))
    return np.minimum(1.0, share * _density_ratio(found, null, nowhere))


def _density_ratio(found: Floats, null: Floats, weight: Floats) -> Floats:
    """(N,) density of nulls (K,), each of a weight, by that of the found (N,), by isotonic regression on both."""
    null = np.append(null, np.inf)  # one more above all: no score is certain for free
    weight = np.append(weight, weight.mean())
    pool, of_null = np.concatenate([found, null]), np.repeat([0.0, 1.0], [len(found), len(null)])
    weights = np.concatenate([np.ones(len(found)), weight * (len(found) / weight.sum())])
    order = np.lexsort((of_null, pool))
    fitted = np.empty(len(pool))
    fitted[order] = scipy.optimize.isotonic_regression(of_null[order], weights=weights[order], increasing=False).x
    return fitted[: len(found)] / np.maximum(1.0 - fitted[: len(found)], 1e-9)
