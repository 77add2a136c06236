from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from vplog.data import Ranking
from vplog.loops.propose import ProposeSettings, candidate_stops, propose

from .scene import keyframes, pose


class ByDistance:
    """An index over numbers: the nearest rows first."""

    def __init__(self, values: list[float]) -> None:
        self.values = np.array(values)

    def query(self, descriptor: object, k: int, stop: int | None = None) -> Ranking:
        assert isinstance(descriptor, float)
        score = 1.0 / (1.0 + np.abs(self.values[:stop] - descriptor))
        rows = np.argsort(-score, kind="stable")[:k]
        return Ranking(rows.astype(np.int32), score[rows].astype(np.float32))


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
    found = propose(keyframes(poses), values, ByDistance(values), ProposeSettings(per_query=4), threads=2)
    best = found.rank == 0
    second = best & (found.query >= 135)
    np.testing.assert_array_equal(found.query[second] - found.match[second], 100)
    order = np.lexsort([found.rank, found.query])
    np.testing.assert_array_equal(order, np.arange(len(order)))
    for query in np.unique(found.query):
        rows = np.sort(found.match[found.query == query])
        assert len(rows) <= 4
        assert (np.diff(rows) > 1).all()  # no neighbours of a better one
        assert (np.diff(found.score[found.query == query]) <= 0).all()


def test_threads_change_nothing_and_no_candidates_are_fine() -> None:
    values = [float(i % 60) for i in range(150)]
    drive = keyframes(circle(150, 10.0))
    one, four = (propose(drive, values, ByDistance(values), ProposeSettings(), threads=n) for n in (1, 4))
    for name in ("query", "match", "rank", "score", "support"):
        assert getattr(one, name).tobytes() == getattr(four, name).tobytes()
    none = propose(keyframes([]), [], ByDistance([]), ProposeSettings())
    assert len(none.query) == len(none.score) == 0
    assert none.match.dtype == np.int32
