"""Sequences over a whole matrix of scores at once, as the tests look at them."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog.places.sequence import SequenceSettings, sequence_rows

if TYPE_CHECKING:
    from vplog.data import Float32s, Ints


def match_sequences(scores: Float32s, settings: SequenceSettings, stops: Ints | None = None) -> Float32s:
    """(Q, M) scores of sequences from (Q, M) scores of single views, as `sequence_rows`; unchanged for length 1.

    NaN at and above stops[q] in row q; without stops every row may match.
    """
    stops = np.full(len(scores), scores.shape[1]) if stops is None else stops
    result = np.full(scores.shape, np.nan, np.float32)
    if settings.length == 1:
        rows = (scores[query, :stop] for query, stop in enumerate(stops))
    else:
        rows = (row for row, _ in sequence_rows(lambda query: scores[query, : stops[query]], stops, settings))
    for query, row in enumerate(rows):
        result[query, : len(row)] = row
    return result
