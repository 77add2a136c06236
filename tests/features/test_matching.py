from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vplog.data import Features
from vplog.features.matching import MatchSettings, first_matches, match, match_features


def reference(a: np.ndarray, b: np.ndarray, ratio: float) -> list[tuple[int, int]]:
    """The definition, one row at a time in whole numbers."""
    if len(a) == 0 or len(b) < 2:
        return []
    distances = ((a[:, None].astype(int) - b[None].astype(int)) ** 2).sum(axis=2)
    result = []
    for i, row in enumerate(distances):
        j = int(row.argmin())
        second = np.delete(row, j).min()
        if int(distances[:, j].argmin()) == i and float(row[j]) < ratio**2 * float(second):
            result.append((i, j))
    return result


@settings(max_examples=60, deadline=None)
@given(
    st.integers(0, 12),
    st.integers(0, 12),
    st.sampled_from([2, 32, 128, 256]),
    st.sampled_from([1, 3, 255]),
    st.integers(0, 2**32 - 1),
)
def test_agrees_with_the_definition_ties_included(rows_a: int, rows_b: int, length: int, top: int, seed: int) -> None:
    rng = np.random.default_rng(seed)
    a = rng.integers(0, top + 1, (rows_a, length), dtype=np.uint8)
    b = rng.integers(0, top + 1, (rows_b, length), dtype=np.uint8)
    found = match(a, b, 0.9)
    assert list(zip(*(part.tolist() for part in found), strict=True)) == reference(a, b, 0.9)


def test_distances_of_the_largest_values_are_exact() -> None:
    a = np.full((1, 128), 255, np.uint8)
    b = np.zeros((2, 128), np.uint8)
    b[1, 0] = 1  # nearer by 509 of 8 million
    b[1, 1:] = 0
    rows, found = match(a, b, 1.0)
    assert rows.tolist() == [0]
    assert found.tolist() == [1]


def test_one_vote_for_a_point_with_two_orientations() -> None:
    rng = np.random.default_rng(0)
    descriptors = rng.integers(0, 255, (4, 128), dtype=np.uint8)
    points = np.array([[1, 1], [1, 1], [5, 5], [9, 9]], np.float32)
    features = Features(points, np.ones(4, np.float32), descriptors, np.full(4, np.nan, np.float32), 20, 20)
    mine, theirs = match_features(features, features, MatchSettings())
    assert mine.tolist() == [0, 2, 3]
    assert theirs.tolist() == [0, 2, 3]


@pytest.mark.parametrize("count", [1, 2, 3])
def test_only_the_strongest_are_matched(count: int) -> None:
    rng = np.random.default_rng(0)
    descriptors = rng.integers(0, 255, (4, 128), dtype=np.uint8)
    points = rng.uniform(0, 9, (4, 2)).astype(np.float32)
    features = Features(points, np.ones(4, np.float32), descriptors, np.full(4, np.nan, np.float32), 20, 20)
    mine, _ = match_features(features, features, MatchSettings(features=count))
    assert mine.tolist() == (list(range(count)) if count > 1 else [])


def test_a_first_look_ends_what_shares_little_and_nothing_else() -> None:
    rng = np.random.default_rng(1)
    many = rng.integers(0, 255, (1000, 128), dtype=np.uint8)
    points = rng.uniform(0, 500, (1000, 2)).astype(np.float32)
    unknown, size = np.full(1000, np.nan, np.float32), np.ones(1000, np.float32)
    here = Features(points, size, many, unknown, 500, 500)
    there = Features(points, size, np.roll(many, 5, axis=0), unknown, 500, 500)
    other = Features(points, size, rng.integers(0, 255, (1000, 128), dtype=np.uint8), unknown, 500, 500)
    chosen = MatchSettings()
    assert first_matches(here, there, chosen, 25) is None
    few = first_matches(here, other, chosen, 25)
    assert few is not None
    assert few < 10
    assert first_matches(here, other, chosen.model_copy(update={"first_look": 1000}), 25) is None
    assert first_matches(here, other, chosen, 0) is None
