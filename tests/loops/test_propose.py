from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.loops.scene import keyframes, pose
from vplog.data import Ranking
from vplog.loops.propose import ProposeSettings, candidate_stops, propose

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vplog.data import Int32s, Ints


def by_distance(values: list[float], stops: Ints, k: int) -> Iterator[tuple[Ranking, Int32s]]:
    """Rankings over numbers, the nearest earlier ones first; the support of a row is the row."""
    for value, stop in zip(values, stops, strict=True):
        score = 1.0 / (1.0 + np.abs(np.array(values)[:stop] - value))
        rows = np.argsort(-score, kind="stable")[:k].astype(np.int32)
        yield Ranking(rows, score[rows].astype(np.float32)), rows


def circle(count: int, radius_m: float) -> list[np.ndarray]:
    turn = np.linspace(0, 4 * np.pi, count)  # twice around
    return [pose(radius_m * np.cos(a), radius_m * np.sin(a), yaw=(a + np.pi) % (2 * np.pi) - np.pi) for a in turn]


@settings(max_examples=50, deadline=None)
@given(st.integers(0, 150), st.integers(0, 40), st.floats(0, 60), st.floats(0, 50), st.floats(0, 100), st.integers())
def test_every_gap_holds(count: int, rows: int, steps: float, gap_s: float, gap_m: float, seed: int) -> None:
    rng = np.random.default_rng(abs(seed))
    step = rng.exponential(1.0, count) * (rng.random(count) > 0.2)  # it stands still now and then
    drive = keyframes([pose(x) for x in np.cumsum(step)])
    drive = replace(drive, stamp_ns=np.cumsum(rng.integers(1, 3 * 10**9, count)).astype(np.int64))
    chosen = ProposeSettings(gap_keyframes=rows, gap_steps=steps, gap_s=gap_s, gap_m=gap_m)
    stops = candidate_stops(drive, chosen)
    assert stops.shape == (count,)
    assert (stops <= np.arange(count)).all()
    assert (np.diff(stops) >= 0).all()
    moving = step[1:][step[1:] > 0]
    path = np.cumsum(step)
    needed_m = max(gap_m, steps * np.median(moving)) if len(moving) else gap_m
    for i in range(count):
        for j in range(i):  # exactly the rows that keep every gap
            kept = (
                i - j >= min(rows, count // 4)
                and path[i] - path[j] >= needed_m
                and drive.stamp_ns[i] - drive.stamp_ns[j] >= int(gap_s * 1e9)
            )
            near = abs(path[i] - path[j] - needed_m) < 2e-6 * max(needed_m, 1.0)  # rounding decides there
            assert near or kept == (j < stops[i])


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
def test_gaps_follow_the_scale_of_the_drive(scale: float) -> None:
    at_one = candidate_stops(keyframes(circle(400, 50.0)), ProposeSettings())
    scaled = candidate_stops(keyframes(circle(400, 50.0 * scale)), ProposeSettings())
    np.testing.assert_array_equal(at_one, scaled)
    assert at_one[-1] == 370


def test_a_drive_that_never_moves_still_has_candidates_by_rows() -> None:
    stops = candidate_stops(keyframes([np.eye(4)] * 200), ProposeSettings())
    assert stops[-1] == 170


def test_the_second_lap_finds_the_first() -> None:
    poses = circle(200, 30.0)
    values = [float(i % 100) for i in range(200)]
    chosen = ProposeSettings(per_query=4)
    found = propose(by_distance(values, candidate_stops(keyframes(poses), chosen), chosen.ranked), chosen)
    best = found.rank == 0
    second = best & (found.query >= 135)
    np.testing.assert_array_equal(found.query[second] - found.match[second], 100)
    np.testing.assert_array_equal(found.support, found.match)
    order = np.lexsort([found.rank, found.query])
    np.testing.assert_array_equal(order, np.arange(len(order)))
    for query in np.unique(found.query):
        rows = np.sort(found.match[found.query == query])
        assert len(rows) <= 4
        assert (np.diff(rows) > 1).all()  # no neighbours of a better one
        assert (np.diff(found.score[found.query == query]) <= 0).all()


@pytest.mark.parametrize(
    ("suppress", "per_query", "rows"), [(1, 3, [50, 48, 30]), (0, 3, [50, 51, 48]), (2, 9, [50, 30, 10]), (1, 1, [50])]
)
def test_the_best_that_are_no_neighbours_of_a_better_one_are_taken(
    suppress: int, per_query: int, rows: list[int]
) -> None:
    ranked = np.array([50, 51, 48, 30, 52, 10], np.int32)
    ranking = Ranking(ranked, np.linspace(1, 0.5, 6, dtype=np.float32))
    found = propose([(ranking, 2 * ranked)] * 2, ProposeSettings(suppress=suppress, per_query=per_query))
    assert found.match.tolist() == rows * 2
    assert found.support.tolist() == [2 * row for row in rows * 2]
    assert found.query.tolist() == [0] * len(rows) + [1] * len(rows)
    assert found.rank.tolist() == [*range(len(rows))] * 2


@pytest.mark.parametrize("count", [0, 1, 20])
def test_no_candidates_are_fine(count: int) -> None:
    nothing = Ranking(np.zeros(0, np.int32), np.zeros(0, np.float32))
    none = propose([(nothing, nothing.rows)] * count, ProposeSettings())
    assert len(none.query) == len(none.score) == len(none.support) == 0
    assert none.match.dtype == none.support.dtype == np.int32
    assert none.score.dtype == np.float32
