"""The index agrees with Eq. (1) by brute force, to the last bit, whatever it may leave out on the way."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Literal

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vplog.places import code_search, expected_votes
from vplog.places.code_search import CodeIndex, Place

NO_REFERENCE, NO_BOX = 65_535, 255
POSITIONS = 20
"""Boxes of 3 x 2 cells on a grid of 7 x 5."""
TABLE = expected_votes.overlaps((5, 4), 3, 2)
Pairing = Literal["best", "same", "both"]
PAIRINGS: tuple[Pairing, ...] = ("best", "same", "both")


class Places(Place):
    """As a map (N, J), (N, J), (N, J, I); `place(n)` is one of them."""

    def __len__(self) -> int:
        return len(self.references)

    def place(self, row: int) -> Places:
        return Places(self.references[row], self.weights[row], self.boxes[row])

    def first(self, rows: int) -> Places:
        return Places(self.references[:rows], self.weights[:rows], self.boxes[:rows])

    def index(self, library: int, pairing: Pairing) -> CodeIndex:
        lists = code_search.build_lists(self.references, self.weights, self.boxes, library, code_search.BLOCK)
        return CodeIndex(lists, TABLE, pairing)


def _places(rng: np.random.Generator, count: int, J: int, windows: int, library: int) -> Places:
    """Weights and boxes are few, so that scores tie; some places have fewer references than J, some none."""
    references = rng.permuted(np.tile(np.arange(library), (count, 1)), axis=1)[:, :J].astype(np.uint16)
    references[np.arange(J) >= rng.integers(0, J + 1, (count, 1))] = NO_REFERENCE
    weights = rng.choice([1, 80, 255], (count, J)).astype(np.uint8)
    boxes = rng.choice([0, 1, 7, POSITIONS - 1, NO_BOX], (count, J, windows)).astype(np.uint8)
    weights[references == NO_REFERENCE] = 0
    boxes[references == NO_REFERENCE] = NO_BOX
    return Places(references, weights, boxes)


def _equation_1(query: Places, other: Places, pairing: Pairing) -> np.float32:
    """Eq. (1) with weights: whole numbers to the end, then one division."""
    total, along = np.zeros(3, np.int64), math.isqrt(query.boxes.shape[1])
    for j, reference in enumerate(query.references.tolist()):
        for k in np.flatnonzero((other.references == reference) & (reference != NO_REFERENCE)):
            cells = TABLE[query.boxes[j][:, None], other.boxes[k][None]].astype(int)
            best, column = int(cells.max(axis=1).sum()), np.arange(len(cells)) % along
            same, right, left = int(np.diag(cells).sum()), 0, 0
            for window in np.flatnonzero(column > 0):
                right, left = right + int(cells[window - 1, window]), left + int(cells[window, window - 1])
            alike = {
                "best": [best] * 3, "same": [same] * 3, "both": 5 * best + np.array([5 * same, 6 * right, 6 * left]),
            }[pairing]  # fmt: skip
            total += int(query.weights[j]) * int(other.weights[k]) * np.array(alike)
    lengths = [np.sqrt(max(int((p.weights.astype(int) ** 2).sum()), 1)) for p in (other, query)]
    whole = int(TABLE.max()) * (10 if pairing == "both" else 1) * query.boxes.shape[1]
    return np.float32(total.max() / (lengths[0] * (lengths[1] * whole)))


def _top(scores: np.ndarray, k: int) -> list[int]:
    return [row for row in sorted(range(len(scores)), key=lambda row: (-scores[row], row)) if scores[row] > 0][:k]


@settings(max_examples=60, deadline=None)
@given(
    seed=st.integers(0, 10**6),
    count=st.integers(0, 60),
    windows=st.sampled_from([4, 9]),
    pairing=st.sampled_from(PAIRINGS),
    k=st.sampled_from([0, 1, 3, 20, 1000]),
    stop=st.one_of(st.none(), st.integers(0, 70)),
    block=st.sampled_from([1, 7, 16, code_search.BLOCK]),
)
def test_scores_and_queries_are_those_of_the_formula(
    seed: int, count: int, windows: int, pairing: Pairing, k: int, stop: int | None, block: int
) -> None:
    """Blocks of few rows make the search leave out what the rows before them show to be out of reach."""
    rng = np.random.default_rng(seed)
    places = _places(rng, count, J=4, windows=windows, library=9)
    query = _places(rng, 1, J=4, windows=windows, library=9).place(0)
    if count and rng.random() < 0.5:
        query = places.place(int(rng.integers(count)))
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(code_search, "BLOCK", block)
        index = places.index(9, pairing)
        scores, ranking = index.scores(query, stop), index.query(query, k, stop)
    seen = count if stop is None else min(stop, count)
    np.testing.assert_array_equal(scores, [_equation_1(query, places.place(n), pairing) for n in range(seen)])
    assert ranking.rows.tolist() == _top(scores, k)
    np.testing.assert_array_equal(ranking.score, scores[ranking.rows])
    assert (scores.dtype, ranking.rows.dtype, ranking.score.dtype) == (np.float32, np.int32, np.float32)


@pytest.mark.parametrize("pairing", PAIRINGS)
def test_over_many_blocks_the_best_are_those_of_a_full_sort(pairing: Pairing) -> None:
    """More places than a block has, and most of them left out unseen: the order is still that of all scores."""
    rng = np.random.default_rng(4)
    count = 2 * code_search.BLOCK + 1000
    places = _places(rng, count, J=6, windows=9, library=40)
    index = places.index(40, pairing)
    assert len(index) == count
    for row in (0, code_search.BLOCK, count - 1):
        query = places.place(row)
        scores = index.scores(query)
        for stop in (None, code_search.BLOCK, count - 500):
            assert index.query(query, 20, stop).rows.tolist() == _top(scores[:stop], 20)


def test_stop_is_a_map_of_the_first_rows() -> None:
    rng = np.random.default_rng(5)
    places = _places(rng, 40, J=3, windows=9, library=6)
    index = places.index(6, "both")
    for stop in (0, 1, 17, 40):
        alone = places.first(stop).index(6, "both")
        for row in range(10):
            query = places.place(row)
            np.testing.assert_array_equal(index.scores(query, stop), alone.scores(query))
            assert index.query(query, 4, stop).rows.tolist() == alone.query(query, 4).rows.tolist()


def test_a_place_equal_to_the_query_scores_1_and_ties_go_to_the_earlier_row() -> None:
    one = Places(np.array([[2, 5]], np.uint16), np.array([[255, 100]], np.uint8), np.full((1, 2, 9), 7, np.uint8))
    many = Places(*(np.repeat(part, 50, axis=0) for part in (one.references, one.weights, one.boxes)))  # type: ignore[arg-type]
    for pairing in PAIRINGS:
        index = many.index(6, pairing)
        np.testing.assert_allclose(index.scores(one.place(0)), 1.0, rtol=1e-6)
        for k in (1, 7, 50):
            assert index.query(one.place(0), k).rows.tolist() == list(range(k))


def test_references_beyond_the_library_and_places_without_any_share_nothing() -> None:
    rng = np.random.default_rng(6)
    places = _places(rng, 30, J=4, windows=4, library=9)
    known = places.references < 5
    part = replace(places, references=np.where(known, places.references, NO_REFERENCE).astype(np.uint16))
    smaller = places.index(5, "both")
    for row in range(30):
        np.testing.assert_array_equal(
            smaller.scores(places.place(row)), part.index(5, "both").scores(places.place(row))
        )
    nobody = Places(np.full(4, NO_REFERENCE, np.uint16), np.zeros(4, np.uint8), np.full((4, 4), NO_BOX, np.uint8))
    assert not smaller.scores(nobody).any()
    assert len(smaller.query(nobody, 5).rows) == 0


def test_memory_is_told_to_the_byte() -> None:
    """A reference of a place: two bytes of row, its weight and its share, nine boxes; a place: its length."""
    rng = np.random.default_rng(7)
    places = _places(rng, 500, J=10, windows=9, library=20)
    used = int((places.references != NO_REFERENCE).sum())
    assert places.index(20, "both").nbytes == used * (2 + 1 + 1 + 9) + 500 * 4 + 8 * 20 * 2


@pytest.mark.parametrize("pairing", PAIRINGS)
def test_places_as_good_as_their_bound_are_not_left_out(pairing: Pairing, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where every box is the query's own, a score is all that the weights allow: a bound rounded down would be less."""
    monkeypatch.setattr(code_search, "BLOCK", 64)
    rng = np.random.default_rng(8)
    references = rng.permuted(np.tile(np.arange(8), (3000, 1)), axis=1)[:, :6].astype(np.uint16)
    weights = rng.integers(1, 256, references.shape).astype(np.uint8)
    places = Places(references, weights, np.full((3000, 6, 9), 7, np.uint8))
    index = places.index(8, pairing)
    for row in range(0, 3000, 200):
        query = places.place(row)
        assert index.query(query, 20).rows.tolist() == _top(index.scores(query), 20)
