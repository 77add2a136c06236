"""Sequences of views instead of single ones, over any recogniser's scores: a return runs along a line of the matrix.

After Milford & Wyeth, SeqSLAM, ICRA 2012: with query q at row m, the views around q are at the rows around m. Scores
are taken relative to their mean by view and by row, then averaged along such lines, or along either half of them, where
a return begins or ends.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from typing import Any, Self

import numba
import numpy as np
from pydantic import Field, model_validator

from vplog.data import Float32s, Int32s, Ints, Ranking
from vplog.execution.execution import Execution
from vplog.places.dense import best_rows
from vplog.settings import Settings
from vplog.stages import PlaceIndex

_BLOCK = 64
"""Queries worked on at once: enough for every thread, and few enough that memory is that of a few rows."""
_MEAN_VIEWS = 256
"""Queries that a row's mean score is estimated from: its standard error is then 1/16 of one view's spread."""
_AGREE_ROWS, _AGREE_SHARE = 10, 0.1
"""A view agrees with a row among its ten best, as many as `vplog run` keeps of a query, of few rows the best tenth."""


class SequenceSettings(Settings):
    """How views are matched along with their neighbours. The views of both drives should be spaced evenly along the
    path, as keyframes are."""

    length: int = Field(default=21, ge=1, le=999)
    """Views in the window, the query in its middle: an odd number. 1 is off: each view for itself."""
    slowest: float = Field(default=0.9, gt=0, le=10)
    """Least ratio of the rows passed in the map to the views passed in the query. Evenly spaced views keep it near 1;
    views evenly spaced in time vary with the speed of the two drives. Every ratio more costs some certainty."""
    fastest: float = Field(default=1.1, gt=0, le=10)
    """Largest such ratio. All ratios between that end the window on another row are tried, and the best one counts."""

    @model_validator(mode="after")
    def _is_a_window(self) -> Self:
        if self.length % 2 == 0:
            raise ValueError(f"length {self.length} is even, and a window has a middle: set it to {self.length + 1}")
        if self.slowest > self.fastest:
            raise ValueError(f"slowest {self.slowest} is more than fastest {self.fastest}")
        return self

    def offsets(self) -> Ints:
        """(V, length) int64: by how many rows each view of the window is off, for each ratio tried."""
        half_window = self.length // 2
        rounding = 1e-9  # 10 x 1.1 must not miss 11
        ends = range(
            math.ceil(half_window * self.slowest - rounding), math.floor(half_window * self.fastest + rounding) + 1
        )
        nearest = round(half_window * (self.slowest + self.fastest) / 2)
        views = np.arange(-half_window, half_window + 1)
        lines = [
            (2 * np.abs(views) * end + half_window) // max(2 * half_window, 1) * np.sign(views)
            for end in ends or [nearest]
        ]
        return np.array(lines, np.int64)


def sequence_rows(
    row_of_scores: Callable[[int], Float32s],
    stops: Ints,
    settings: SequenceSettings,
    execution: Execution = Execution(),
) -> Iterator[tuple[Float32s, Int32s]]:
    """For each query q in order: scores and support, both (stops[q],), of the rows it may match.

    `row_of_scores(q)` gives the (stops[q],) scores of one view, the more alike the larger, of any scale; it is called
    from any thread, once or twice for each q. What is not finite counts as the row's least finite score: one
    blinded view is no veto. A cell at or above the stop of its own view is not there, whatever line it is on.

    A score is max over the ratios and over the window w, its past and its future half (each with the query) of
        sum(x) / sqrt(n * length)
    over the n cells of w that are there: for a whole window the mean, and for fewer views what keeps their noise at
    that of the mean. x is a view's score less its mean over the view's rows and less what is usual for the row. So 0
    is no more alike than chance. Support counts the other views of the window that by themselves would have ranked
    their row among their best ten, along the best line: 0..length - 1.

    Holds some 64 + length rows at a time. The same bytes for any number of threads.
    """
    stops = np.ascontiguousarray(stops, np.int64)
    half_window, offsets, count = settings.length // 2, settings.offsets(), len(stops)
    width = int(stops.max(initial=0))
    x = np.zeros((_BLOCK + 2 * half_window, width), np.float32)
    agrees = np.zeros(x.shape, np.bool_)

    row_means = _row_means(row_of_scores, stops, settings.length, execution)

    def fill(query: int) -> None:
        row, stop = query - first + half_window, stops[query]
        if stop:
            x[row, :stop] = _centred(row_of_scores(query)) - row_means[:stop]
            agrees[row, :stop] = _best_mask(x[row, :stop])

    def match(query: int) -> tuple[Float32s, Int32s]:
        return _match(x, agrees, stops, query, query - first + half_window, offsets)

    for first in range(0, count, _BLOCK):  # row half of the buffers is query `first`
        if first:
            x[: 2 * half_window], agrees[: 2 * half_window] = x[_BLOCK:].copy(), agrees[_BLOCK:].copy()
        filled = first + half_window if first else 0
        list(execution.map(fill, range(filled, min(first + _BLOCK + half_window, count))))
        yield from list(execution.map(match, range(first, min(first + _BLOCK, count))))


def rank_places(
    index: PlaceIndex, descriptors: Sequence[Any], stops: Ints, k: int, settings: SequenceSettings,
    execution: Execution, lines: Float32s | None = None,
) -> Iterator[tuple[Ranking, Int32s]]:  # fmt: skip
    """For each query in order: its k best rows below its stop, and their support, 0 where the length is 1.

    Rows that are no more alike than chance are left out; ties go to the earlier row. The scores of lines are written to
    `lines` (Q, M).
    """
    if settings.length > 1:
        rows = sequence_rows(
            lambda query: index.scores(descriptors[query], int(stops[query])), stops, settings, execution
        )
        for query, (score, support) in enumerate(rows):
            if lines is not None:
                lines[query, : len(score)] = score
            best = best_rows(np.maximum(score, 0.0), k)
            yield best, support[best.rows]
        return
    for ranking in execution.map(lambda at: index.query(descriptors[at], k, int(stops[at])), range(len(stops))):
        yield ranking, np.zeros(len(ranking.rows), np.int32)


def _row_means(row_of_scores: Callable[[int], Float32s], stops: Ints, length: int, execution: Execution) -> Float32s:
    """(W,) mean score of each row over views spread evenly over the drive.

    Shrunk towards 0 as by `length` more views, so that the only return to a row does not cancel itself.
    """
    queries = np.flatnonzero(stops > 0)
    queries = queries[np.unique(np.linspace(0, len(queries) - 1, min(_MEAN_VIEWS, len(queries))).round().astype(int))]
    total, count = np.zeros(stops.max(initial=0)), np.zeros(stops.max(initial=0), np.int64)
    for first in range(0, len(queries), _BLOCK):
        block = queries[first : first + _BLOCK].tolist()
        # in order: a sum of its own bytes
        for row in execution.map(lambda query: _centred(row_of_scores(query)), block):
            total[: len(row)] += row
            count[: len(row)] += 1
    return (total / (count + length)).astype(np.float32)


def _centred(row: Float32s) -> Float32s:
    """The scores of one view less their mean. No division by their spread: a view that is like nothing stays so."""
    finite = np.isfinite(row)
    if not finite.all():
        row = np.where(finite, row, row[finite].min() if finite.any() else 0.0)
    return (row - row.mean(dtype=np.float64)).astype(np.float32)


def _best_mask(row: Float32s) -> np.ndarray:
    """(stop,) bool: the rows that one view by itself would have ranked best."""
    most = min(_AGREE_ROWS, math.ceil(_AGREE_SHARE * len(row)))
    return (row >= np.partition(row, len(row) - most)[len(row) - most]) & (row > 0)


@numba.njit(cache=True, nogil=True)
def _match(x, agrees, stops, query, at, offsets):
    """(stop,) float32 scores and (stop,) int32 support of one query, which is row `at` of `x` and `agrees`."""
    stop, length, half_window = stops[query], offsets.shape[1], offsets.shape[1] // 2
    score = np.full(stop, -np.inf, np.float32)
    line = np.zeros(stop, np.int32)
    root = np.zeros(length + 1, np.float32)
    for n in range(1, length + 1):
        root[n] = 1.0 / np.sqrt(n * length)
    for v in range(offsets.shape[0]):
        past, ahead = np.zeros(stop, np.float32), np.zeros(stop, np.float32)  # both without the query itself
        past_n, ahead_n = np.zeros(stop, np.int32), np.zeros(stop, np.int32)
        for w in range(length):
            other = query + w - half_window
            if w == half_window or other < 0 or other >= stops.shape[0]:
                continue
            off = offsets[v, w]
            low, high = max(0, -off), min(stop, stops[other] - off)
            if high <= low:
                continue
            cells = x[at + w - half_window, low + off : high + off]
            if w < half_window:
                past[low:high] += cells
                past_n[low:high] += 1
            else:
                ahead[low:high] += cells
                ahead_n[low:high] += 1
        for m in range(stop):
            own = x[at, m]
            best = (past[m] + own + ahead[m]) * root[past_n[m] + 1 + ahead_n[m]]
            best = max(best, (past[m] + own) * root[past_n[m] + 1])
            best = max(best, (own + ahead[m]) * root[1 + ahead_n[m]])
            if best > score[m]:
                score[m], line[m] = best, v
    return score, _support(agrees, stops, query, at, offsets, line)


@numba.njit(cache=True, nogil=True)
def _support(agrees, stops, query, at, offsets, line):
    """(stop,) int32: the other views that agree, along the line chosen for each row."""
    support, half_window = np.zeros(len(line), np.int32), offsets.shape[1] // 2
    for w in range(offsets.shape[1]):
        other = query + w - half_window
        if w == half_window or other < 0 or other >= stops.shape[0]:
            continue
        for m in range(len(line)):
            cell = m + offsets[line[m], w]
            if cell >= 0 and cell < stops[other] and agrees[at + w - half_window, cell]:
                support[m] += 1
    return support
