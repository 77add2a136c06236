"""True pairs: each rule against the same rule on every pair of rows."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from vplog.data import Trajectory
from vplog.evaluate import pairs
from vplog.geometry import se3

SEEDS = st.integers(0, 2**32 - 1)


def table_of(found: pairs.Pairs, rows: int) -> np.ndarray:
    """(Q, M) bool."""
    table = np.zeros((len(found), rows), bool)
    for q in range(len(found)):
        table[q, found.rows(q)] = True
    return table


def check_form(found: pairs.Pairs) -> None:
    """Runs increase, hold a row at least, and do not touch."""
    assert (found.first < found.stop).all()
    for q in range(len(found)):
        runs = slice(found.start[q], found.start[q + 1])
        assert (found.first[runs][1:] > found.stop[runs][:-1]).all()


def poses(rng: np.random.Generator, count: int) -> np.ndarray:
    """Headings over the whole circle in a square of 20 m."""
    omega = np.zeros((count, 3))
    omega[:, 2] = rng.uniform(-np.pi, np.pi, count)
    return se3.pose(se3.so3_exp(omega), rng.uniform(0, 20, (count, 3)))


@settings(max_examples=50, deadline=None)
@given(SEEDS, st.integers(0, 4))
def test_by_number(seed: int, tolerance: int) -> None:
    """Some frames are lost on either side, so that rows are not numbers."""
    rng = np.random.default_rng(seed)
    query, match = (np.flatnonzero(rng.random(15) < 0.7) for _ in range(2))
    found = pairs.index_pairs(query, match, tolerance)
    check_form(found)
    np.testing.assert_array_equal(table_of(found, len(match)), np.abs(query[:, None] - match) <= tolerance)


@settings(max_examples=50, deadline=None)
@given(SEEDS)
def test_by_list(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = rng.random((12, 14)) < 0.3
    listed = rng.permutation(np.argwhere(true))
    query, match = np.flatnonzero(rng.random(12) < 0.8), np.flatnonzero(rng.random(14) < 0.8)
    found = pairs.listed_pairs(np.concatenate([listed, listed[:3]]), query, match)
    check_form(found)
    np.testing.assert_array_equal(table_of(found, len(match)), true[np.ix_(query, match)])
    assert found.count == true[np.ix_(query, match)].sum()


@settings(max_examples=50, deadline=None)
@given(SEEDS, st.floats(0.5, 30), st.floats(1, 200))
def test_by_pose(seed: int, distance_m: float, heading_deg: float) -> None:
    rng = np.random.default_rng(seed)
    query, match = poses(rng, 12), poses(rng, 17)
    relative = se3.between(query[:, None], match[None])
    apart, turned = np.linalg.norm(relative[..., :3, 3], axis=-1), np.degrees(se3.angle(relative))
    found = pairs.pose_pairs(query, match, distance_m, heading_deg)
    check_form(found)
    np.testing.assert_array_equal(table_of(found, 17), (apart <= distance_m) & (turned <= heading_deg))


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.floats(1, 179))
def test_the_heading_is_between_the_axes_whatever_the_roll(seed: int, heading_deg: float) -> None:
    rng = np.random.default_rng(seed)
    query, match = poses(rng, 12), poses(rng, 17)
    axes = [axis / np.linalg.norm(axis) for axis in rng.normal(size=(2, 3))]
    found = table_of(pairs.pose_pairs(query, match, 20.0, heading_deg, *axes), 17)
    looks, sees = (one[:, :3, :3] @ axis for one, axis in zip((query, match), axes, strict=True))
    apart = np.linalg.norm(query[:, None, :3, 3] - match[None, :, :3, 3], axis=-1)
    np.testing.assert_array_equal(found, (apart <= 20.0) & (np.degrees(np.arccos(looks @ sees.T)) <= heading_deg))
    rolled = se3.pose(se3.so3_exp(rng.uniform(-3, 3, (12, 1)) * axes[0]), np.zeros((12, 3)))
    np.testing.assert_array_equal(
        found, table_of(pairs.pose_pairs(query @ rolled, match, 20.0, heading_deg, *axes), 17)
    )


def test_an_axis_is_that_of_the_mount_or_none_where_a_vehicle_has_no_mount() -> None:
    phase = np.linspace(0.0, 6.0, 50)
    turn = np.stack([0 * phase, 0 * phase, phase + np.pi / 2], axis=1)
    car = se3.pose(se3.so3_exp(turn), np.stack([np.cos(phase), np.sin(phase), 0 * phase], axis=1))
    forward = se3.pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.ones(3))
    np.testing.assert_array_equal(pairs.optical_axis(forward, car), [1.0, 0.0, 0.0])
    assert pairs.optical_axis(np.eye(4), car) is None  # its z points up
    np.testing.assert_array_equal(pairs.optical_axis(np.eye(4), car @ forward), [0.0, 0.0, 1.0])  # poses of the camera
    assert pairs.optical_axis(None, car) is None
    assert pairs.optical_axis(np.eye(4), car[:0]) is None


def test_half_a_turn_allows_every_heading() -> None:
    rng = np.random.default_rng(5)
    query, match = poses(rng, 30), poses(rng, 30)
    query[0] = match[0] @ se3.pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3))
    assert pairs.pose_pairs(query, match, 100.0, 180.0).count == 900


@settings(max_examples=25, deadline=None)
@given(SEEDS, st.floats(0.5, 30))
def test_by_position(seed: int, distance_m: float) -> None:
    rng = np.random.default_rng(seed)
    query, match = rng.uniform(0, 20, (12, 2)), rng.uniform(0, 20, (17, 2))
    apart = np.linalg.norm(query[:, None] - match[None], axis=-1)
    np.testing.assert_array_equal(table_of(pairs.position_pairs(query, match, distance_m), 17), apart <= distance_m)


@settings(max_examples=50, deadline=None)
@given(SEEDS)
def test_pairs_below_stops(seed: int) -> None:
    rng = np.random.default_rng(seed)
    true = rng.random((12, 14)) < 0.5
    stops = rng.integers(0, 15, 12)
    kept = pairs.listed_pairs(np.argwhere(true), np.arange(12), np.arange(14)).below(stops)
    check_form(kept)
    wanted = true & (np.arange(14) < stops[:, None])
    np.testing.assert_array_equal(table_of(kept, 14), wanted)
    np.testing.assert_array_equal(kept.positive, wanted.any(1))


def test_standing_still_takes_no_memory() -> None:
    """20 000 frames at one place: 400 million pairs in 20 000 runs."""
    found = pairs.index_pairs(np.arange(20_000), np.arange(20_000), 20_000)
    assert found.count == 20_000**2
    assert found.start.nbytes + found.first.nbytes + found.stop.nbytes < 1_000_000


def test_truth_between_poses_and_beyond_them() -> None:
    seconds = np.array([0, 1, 2, 10, 11])
    steps = se3.pose(np.broadcast_to(np.eye(3), (5, 3, 3)), np.column_stack([seconds, seconds, seconds]).astype(float))
    at = np.array([-1, 0, 0.5, 2, 6, 10.25, 11, 12])
    found, known = pairs.poses_at(Trajectory(seconds * 10**9, steps), (at * 1e9).astype(np.int64))
    assert known.tolist() == [False, True, True, True, False, True, True, False]
    np.testing.assert_allclose(found[known, 0, 3], at[known])
    assert np.isnan(found[~known]).all()
    places, known_too = pairs.positions_at(
        seconds * 10**9 + 10**18, seconds[:, None].astype(float), (at * 1e9).astype(np.int64) + 10**18
    )
    assert known_too.tolist() == known.tolist()
    np.testing.assert_allclose(places[known, 0], at[known])


def test_no_sample_knows_nothing() -> None:
    nothing = Trajectory(np.zeros(0, np.int64), np.zeros((0, 4, 4)))
    assert not pairs.poses_at(nothing, np.arange(3))[1].any()
    assert not pairs.positions_at(nothing.stamp_ns, np.zeros((0, 2)), np.arange(3))[1].any()
