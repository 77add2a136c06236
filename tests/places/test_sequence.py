from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from pydantic import ValidationError

from tests.places.sequence_matrix import match_sequences
from vplog.data import Ranking
from vplog.execution.execution import Execution
from vplog.places.sequence import SequenceSettings, rank_places, sequence_rows


def by_definition(scores: np.ndarray, stops: np.ndarray, chosen: SequenceSettings) -> tuple[np.ndarray, np.ndarray]:
    """Scores and support as documented, a cell at a time; at most 256 queries, so that all tell what is usual."""
    count, half = len(scores), chosen.length // 2
    x = np.full(scores.shape, np.nan)
    for q, stop in enumerate(stops):
        row = scores[q, :stop].astype(np.float64)
        if stop:
            row[~np.isfinite(row)] = row[np.isfinite(row)].min() if np.isfinite(row).any() else 0.0
            x[q, :stop] = row - row.mean()
    x = x - np.nansum(x, axis=0) / ((~np.isnan(x)).sum(0) + chosen.length)
    agrees = np.zeros(x.shape, bool)
    for q, stop in enumerate(stops):
        best = np.sort(x[q, :stop])[::-1][: min(10, int(np.ceil(stop / 10)))]
        agrees[q, :stop] = (x[q, :stop] >= best[-1]) & (x[q, :stop] > 0) if stop else False
    result, support = np.full(scores.shape, np.nan), np.zeros(scores.shape, int)
    for q, stop in enumerate(stops):
        for m in range(stop):
            for line in chosen.offsets():
                there = [
                    (d, q + d, m + int(off))
                    for d, off in zip(range(-half, half + 1), line, strict=True)
                    if 0 <= q + d < count and 0 <= m + off < stops[q + d]
                ]
                for low, high in ((-half, half), (-half, 0), (0, half)):
                    cells = [x[row, column] for d, row, column in there if low <= d <= high]
                    score = sum(cells) / np.sqrt(len(cells) * chosen.length)
                    if not result[q, m] >= score + 1e-6:  # NaN too; the first of equal lines
                        support[q, m] = sum(agrees[row, column] for d, row, column in there if d)
                    result[q, m] = np.nanmax([result[q, m], score])
    return result, support


def walks(rng: np.random.Generator, query: np.ndarray, count: int, noise: float = 0.3) -> np.ndarray:
    """(Q, count) scores of views at `query` in map rows (NaN nowhere): alike within about two rows, and noise."""
    apart = np.abs(np.nan_to_num(query, nan=1e6)[:, None] - np.arange(count))
    return (np.exp(-((apart / 1.5) ** 2)) + rng.normal(0, noise, (len(query), count))).astype(np.float32)


@settings(max_examples=15, deadline=None)
@given(
    st.integers(1, 40), st.integers(1, 30), st.sampled_from([3, 5, 11]), st.integers(0, 2**32 - 1), st.booleans(),
    st.sampled_from([(1.0, 1.0), (0.5, 2.0), (0.9, 1.1), (1.3, 1.3)]),
)  # fmt: skip
def test_scores_and_support_are_as_defined(
    count: int, width: int, length: int, seed: int, one_drive: bool, ratios: tuple[float, float]
) -> None:
    rng = np.random.default_rng(seed)
    chosen = SequenceSettings(length=length, slowest=ratios[0], fastest=ratios[1])
    width = count if one_drive else width
    stops = np.maximum(np.arange(count) - 4, 0) if one_drive else np.full(count, width)
    scores = rng.normal(size=(count, width)).astype(np.float32)
    scores[rng.random(scores.shape) < 0.1] = -np.inf
    expected, support = by_definition(scores, stops, chosen)
    found = match_sequences(scores, chosen, stops)
    np.testing.assert_allclose(found, expected, atol=1e-4)
    for q, (score, agreeing) in enumerate(sequence_rows(lambda q: scores[q, : stops[q]], stops, chosen)):
        np.testing.assert_array_equal(score, found[q, : stops[q]])
        assert score.dtype == np.float32
        assert agreeing.dtype == np.int32
        assert (agreeing <= length - 1).all()
        if ratios[0] == ratios[1]:  # of two lines that tie, either may be meant
            np.testing.assert_array_equal(agreeing, support[q, : stops[q]])


def test_neighbours_tell_apart_what_single_views_cannot() -> None:
    scores = walks(np.random.default_rng(0), np.arange(200.0), 200, noise=0.5)
    alone = np.abs(scores.argmax(1) - np.arange(200)) <= 2
    together = np.abs(match_sequences(scores, SequenceSettings()).argmax(1) - np.arange(200)) <= 2
    assert alone.mean() < 0.7
    assert together.all()


def test_a_return_is_found_from_its_first_view_to_its_last() -> None:
    """One drive: views 200 to 239 are again at 50 to 89, and before and after that at nothing seen before."""
    rng = np.random.default_rng(1)
    count, returns = 300, np.arange(200, 240)
    query = np.full(count, np.nan)
    query[returns] = returns - 150
    scores, stops = walks(rng, query, count, noise=0.25), np.maximum(np.arange(count) - 49, 0)
    found = match_sequences(scores, SequenceSettings(), stops)
    best = np.array([np.nanmax(row, initial=-np.inf) for row in found])
    where = np.array([np.argmax(row[:stop]) if stop else -1 for row, stop in zip(found, stops, strict=True)])
    assert (np.abs(where[returns] - (returns - 150)) <= 2).all()
    half = SequenceSettings().length // 2
    elsewhere = np.setdiff1d(np.arange(count), np.arange(returns[0] - half, returns[-1] + half + 1))
    assert best[returns].min() > best[elsewhere].max()  # the ends too stand out from chance
    rows = list(sequence_rows(lambda q: scores[q, : stops[q]], stops, SequenceSettings()))
    middle = [rows[q][1][q - 150] for q in returns[half:-half]]
    assert min(middle) >= half
    assert np.median([support[np.argmax(s)] for s, support in rows[100:180]]) < half


@pytest.mark.parametrize("ratio", [0.75, 1.0, 1.5])
def test_other_speeds_are_matched_where_they_are_allowed(ratio: float) -> None:
    query = 20 + ratio * np.arange(100)
    scores = walks(np.random.default_rng(2), query, 200, noise=0.5)
    found = match_sequences(scores, SequenceSettings(slowest=0.7, fastest=1.6))
    assert (np.abs(found.argmax(1) - query) <= 2.5).mean() > 0.95


def test_what_lies_at_or_above_the_stop_changes_nothing() -> None:
    rng = np.random.default_rng(3)
    stops = np.maximum(np.arange(120) - 20, 0)
    scores = rng.normal(size=(120, 120)).astype(np.float32)
    blind = np.where(np.arange(120) < stops[:, None], scores, np.float32(1e9))
    chosen = SequenceSettings(length=11, slowest=0.8, fastest=1.4)
    found = match_sequences(blind, chosen, stops)
    assert found.tobytes() == match_sequences(scores, chosen, stops).tobytes()
    np.testing.assert_array_equal(np.isnan(found), np.arange(120) >= stops[:, None])


def test_scale_and_offset_of_the_scores_do_not_matter() -> None:
    scores = np.random.default_rng(4).normal(size=(90, 70)).astype(np.float32)
    found = match_sequences(scores, SequenceSettings())
    np.testing.assert_allclose(match_sequences(8 * scores - 100, SequenceSettings()), 8 * found, atol=1e-3)


def test_one_blinded_view_is_no_veto() -> None:
    scores = np.log(np.clip(walks(np.random.default_rng(5), np.arange(80.0), 80, 0.1), 1e-6, None))
    scores[40] = -np.inf
    scores[20, 20] = -np.inf
    found = match_sequences(scores, SequenceSettings(length=11))
    assert np.isfinite(found).all()
    assert (np.abs(found.argmax(1) - np.arange(80)) <= 2).all()


def test_length_1_leaves_scores_as_they_are() -> None:
    scores = np.random.default_rng(6).normal(size=(9, 7)).astype(np.float32)
    np.testing.assert_array_equal(match_sequences(scores, SequenceSettings(length=1)), scores)


def test_threads_and_blocks_change_nothing() -> None:
    scores = np.random.default_rng(7).normal(size=(700, 90)).astype(np.float32)  # more queries than tell what is usual
    stops = np.minimum(np.arange(700) // 5, 90)

    def result(threads: int) -> list[tuple[bytes, bytes]]:
        rows = sequence_rows(lambda q: scores[q, : stops[q]], stops, SequenceSettings(), Execution(threads))
        return [(score.tobytes(), support.tobytes()) for score, support in rows]

    one, three = result(1), result(3)
    assert len(one) == 700
    assert one == three


def test_rows_are_asked_for_in_a_window_that_moves() -> None:
    asked: list[int] = []
    rng = np.random.default_rng(8)

    def row(query: int) -> np.ndarray:
        asked.append(query)
        return rng.random(50).astype(np.float32)

    rows = sequence_rows(row, np.full(5000, 50), SequenceSettings())
    next(rows)
    told = len(asked)
    assert told <= 256 + 64 + 21
    for _ in range(999):
        next(rows)
    assert len(asked) - told <= 1100


class Index:
    """An index over the rows of a matrix; `query` answers in a way of its own, so that a test sees who was asked."""

    def __init__(self, scores: np.ndarray) -> None:
        self._scores = scores

    def __len__(self) -> int:
        return self._scores.shape[1]

    def scores(self, descriptor: int, stop: int | None = None) -> np.ndarray:
        return self._scores[descriptor, :stop]

    def query(self, descriptor: int, k: int, stop: int | None = None) -> Ranking:
        return Ranking(np.arange(min(k, stop or 0), dtype=np.int32), np.full(min(k, stop or 0), descriptor, np.float32))


def test_ranks_are_those_of_the_sequence_scores() -> None:
    scores = walks(np.random.default_rng(9), np.arange(150.0) % 75, 150)
    stops = np.maximum(np.arange(150) - 20, 0)
    expected = match_sequences(scores, SequenceSettings(), stops)
    ranked = list(rank_places(Index(scores), list(range(150)), stops, 5, SequenceSettings(), execution=Execution(2)))
    assert len(ranked) == 150
    for row, (ranking, support) in zip(expected, ranked, strict=True):
        order = np.argsort(-np.nan_to_num(row, nan=-1.0), kind="stable")[:5]
        order = order[np.nan_to_num(row[order], nan=-1.0) > 0]
        np.testing.assert_array_equal(ranking.rows, order)
        np.testing.assert_array_equal(ranking.score, row[order])
        assert support.shape == order.shape


def test_single_views_are_ranked_by_the_index_itself() -> None:
    index, stops = Index(np.zeros((100, 100), np.float32)), np.arange(100)
    for query, (ranking, support) in enumerate(
        rank_places(index, list(range(100)), stops, 5, SequenceSettings(length=1), execution=Execution(2))
    ):
        assert len(ranking.rows) == len(support) == min(query, 5)
        assert (ranking.score == query).all()
        assert not support.any()


def test_nothing_to_match() -> None:
    for length in (1, 21):
        chosen = SequenceSettings(length=length)
        assert list(rank_places(Index(np.zeros((0, 0))), [], np.zeros(0, np.int64), 5, chosen, Execution())) == []
        ranked = list(rank_places(Index(np.zeros((3, 3))), [0, 1, 2], np.zeros(3, np.int64), 5, chosen, Execution()))
        assert [len(ranking.rows) for ranking, _ in ranked] == [0, 0, 0]


def test_every_ratio_ends_on_another_row() -> None:
    lines = SequenceSettings(length=21, slowest=0.9, fastest=1.1).offsets()
    np.testing.assert_array_equal(lines[:, -1], [9, 10, 11])
    np.testing.assert_array_equal(lines, -lines[:, ::-1])
    np.testing.assert_array_equal(SequenceSettings(length=5, slowest=1.1, fastest=1.2).offsets(), [[-2, -1, 0, 1, 2]])


@pytest.mark.parametrize("wrong", [{"length": 10}, {"length": 0}, {"slowest": 1.2}, {"slowest": 0.0}])
def test_settings_that_make_no_window(wrong: dict[str, float]) -> None:
    with pytest.raises(ValidationError):
        SequenceSettings.model_validate(wrong)
