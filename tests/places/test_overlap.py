"""The index agrees with Eq. (1) of Tanaka et al. 2014 by brute force."""

from __future__ import annotations

import numpy as np
import pytest

from vplog.places.overlap import BoxIndex, BoxPlace


def _place(rng: np.random.Generator, library: int, J: int, I: int, grid: int) -> BoxPlace:  # noqa: E741
    references = rng.permutation(library)[:J].astype(np.int32)
    corners = np.sort(rng.integers(0, grid + 1, (J, I, 2, 2)), axis=2)  # some boxes are empty
    boxes = np.concatenate([corners[:, :, 0], corners[:, :, 1]], axis=-1).astype(np.uint8)
    known = int(rng.integers(0, J + 1))
    references[known:], boxes[known:] = -1, 0
    return BoxPlace(references, boxes)


def _overlap(a: np.ndarray, b: np.ndarray) -> int:
    wide, tall = (min(int(a[n + 2]), int(b[n + 2])) - max(int(a[n]), int(b[n])) for n in (0, 1))
    return max(wide, 0) * max(tall, 0)


def _similarity(query: BoxPlace, other: BoxPlace, grid: int) -> float:
    """Eq. (1), as a share of the image: for each box the best over all i', j' on the same reference."""
    J, boxes = query.boxes.shape[:2]
    total = 0
    for j, r in enumerate(query.references):
        for box in query.boxes[j]:
            same = [other.boxes[k] for k in range(J) if other.references[k] == r and r >= 0]
            total += max((_overlap(box, b) for group in same for b in group), default=0)
    return total / (J * boxes * grid * grid)


def _map(seed: int, count: int = 40) -> tuple[list[BoxPlace], BoxIndex, int]:
    rng = np.random.default_rng(seed)
    J, I, library = (int(n) for n in (rng.integers(1, 5), rng.integers(1, 5), rng.integers(5, 9)))  # noqa: E741
    grid = int(rng.choice([4, 16, 64, 255]))
    places = [_place(rng, library, J, I, grid) for _ in range(count)]
    references, boxes = np.array([p.references for p in places]), np.array([p.boxes for p in places])
    return places, BoxIndex(references, boxes, library, grid), grid


@pytest.mark.parametrize("seed", range(8))
def test_scores_are_equation_1(seed: int) -> None:
    places, index, grid = _map(seed)
    for query in places[:10]:
        expected = [_similarity(query, other, grid) for other in places]
        np.testing.assert_allclose(index.scores(query), expected, rtol=1e-6)


@pytest.mark.parametrize("seed", range(8))
def test_a_query_is_the_top_of_a_full_sort(seed: int) -> None:
    places, index, _ = _map(seed)
    for query in places[:10]:
        scores = index.scores(query)
        order = [row for row in sorted(range(len(scores)), key=lambda row: (-scores[row], row)) if scores[row] > 0]
        for k in (1, 3, 39, 40, 1000):
            ranking = index.query(query, k)
            assert ranking.rows.tolist() == order[:k]
            np.testing.assert_array_equal(ranking.score, scores[order[:k]])


def test_stop_is_a_map_of_the_first_rows() -> None:
    places, index, grid = _map(3)
    for stop in (0, 1, 17, 40, 100):
        part = places[:stop]
        references = np.array([p.references for p in part], np.int32).reshape(-1, *places[0].references.shape)
        boxes = np.array([p.boxes for p in part], np.uint8).reshape(-1, *places[0].boxes.shape)
        alone = BoxIndex(references, boxes, 9, grid)
        for query in places[:10]:
            np.testing.assert_array_equal(index.scores(query, stop), alone.scores(query))
            a, b = index.query(query, 4, stop), alone.query(query, 4)
            assert a.rows.tolist() == b.rows.tolist()
            assert a.score.tolist() == b.score.tolist()


def test_ties_go_to_the_earlier_row() -> None:
    place = BoxPlace(np.array([2], np.int32), np.array([[[0, 0, 2, 2]]], np.uint8))
    index = BoxIndex(np.full((50, 1), 2, np.int32), np.tile(place.boxes, (50, 1, 1, 1)), 3, 8)
    for k in (1, 7, 50):
        assert index.query(place, k).rows.tolist() == list(range(k))


def test_an_empty_map_has_no_answer() -> None:
    index = BoxIndex(np.zeros((0, 4), np.int32), np.zeros((0, 4, 4, 4), np.uint8), 10, 64)
    query = BoxPlace(np.arange(4, dtype=np.int32), np.full((4, 4, 4), 1, np.uint8))
    assert len(index) == 0
    assert len(index.query(query, 5).rows) == 0
    assert len(index.scores(query)) == 0
