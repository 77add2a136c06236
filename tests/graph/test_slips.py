"""Steps of the odometry that slip: their prior, and what they measure."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.benchmarks.worlds import world
from tests.graph.drive import position_error, ring
from vplog.data import EdgeKind, PoseGraph
from vplog.graph.build import checked
from vplog.graph.consistency import is_loop
from vplog.graph.slips import MOVES, STANDS, Slipping, Slips
from vplog.graph.solve import GncSettings, decided
from vplog.graph.variance_components import Sigmas, claimed_times


def with_frozen(first: int, last: int) -> PoseGraph:
    graph = ring(60).graph
    measured = graph.a_from_b.copy()
    measured[first:last] = np.eye(4)
    return replace(graph, a_from_b=measured)


def test_the_change_of_the_prior_is_that_of_whole_states() -> None:
    graph = with_frozen(20, 24)
    slips = Slips(graph)
    state = np.zeros(59, np.int64)
    state[[5, 6, 7, 21, 40]] = [STANDS, STANDS, STANDS, MOVES, STANDS]
    before = slips._slipping(state).log_prior
    for step, gain in enumerate(slips._log_prior_gain(state > 0).tolist()):
        changed = np.array(state)
        changed[step] = 0 if state[step] else STANDS
        assert slips._slipping(changed).log_prior - before == pytest.approx(gain)


def test_a_long_run_is_likelier_than_as_many_short_ones() -> None:
    slips = Slips(ring(60).graph)
    run, apart = np.zeros((2, 59), np.int64)
    run[10:14] = apart[[10, 20, 30, 40]] = STANDS
    assert slips._slipping(run).log_prior > slips._slipping(apart).log_prior + 30.0


def test_odometry_that_reports_no_motion_slips_more_often() -> None:
    slips, sound = Slips(with_frozen(20, 24)), Slips(ring(60).graph)
    state = np.zeros(59, np.int64)
    state[20:24] = MOVES
    assert slips._slipping(state).log_prior > sound._slipping(state).log_prior + 5.0


@pytest.mark.parametrize("sigmas", [Sigmas(), Sigmas(0.25, 4.0)])
def test_what_a_slipping_step_measures_does_not_depend_on_the_noise(sigmas: Sigmas) -> None:
    graph = with_frozen(20, 24)
    state = np.zeros(len(graph.a), np.int64)
    state[10:12], state[20:24] = STANDS, MOVES
    applied = claimed_times(Slipping(state, 0.0).applied(graph, sigmas), sigmas)
    np.testing.assert_array_equal(applied.a_from_b[10:12], np.tile(np.eye(4), (2, 1, 1)))
    unknown = np.linalg.inv(applied.information[20])
    steps = graph.a_from_b[:59, :3, 3]
    assert np.linalg.norm(applied.a_from_b[20, :3, 3]) == pytest.approx(np.linalg.norm(steps, axis=1)[0], rel=0.1)
    assert np.trace(unknown[3:, 3:]) >= 0.5 * steps.var(0).sum()
    np.testing.assert_array_equal(applied.a_from_b[30:], graph.a_from_b[30:])


def test_frozen_odometry_keeps_its_closures() -> None:
    drive = ring(120, loops=40, noise=0.3)
    measured = drive.graph.a_from_b.copy()
    measured[50:56] = np.eye(4)
    decision = decided(replace(drive.graph, a_from_b=measured), GncSettings())
    assert decision.solution.weight.all()
    assert set(decision.slipping.edges.tolist()) == set(range(50, 56))
    assert position_error(decision.solution.world_from_body, drive.true) < 1.0


def test_sound_odometry_does_not_slip() -> None:
    for seed in range(4):
        drive = ring(120, loops=30, false=15, seed=seed)
        assert not len(decided(drive.graph, GncSettings()).slipping.edges)


def test_sessions_are_joined_by_whole_families() -> None:
    """No single closure between two sessions is predicted by anything."""
    made = world(7010, "sessions")
    graph, _ = checked(made.graph())
    kept = decided(graph, GncSettings()).solution.weight[is_loop(graph)] > 0.5
    np.testing.assert_array_equal(kept, made.is_true)


def test_without_a_closure_to_judge_no_step_slips() -> None:
    graph = with_frozen(20, 24)
    kind = [EdgeKind.ODOMETRY if one == EdgeKind.ODOMETRY else EdgeKind.KNOWN_LOOP for one in graph.kind]
    assert not len(decided(replace(graph, kind=kind), GncSettings()).slipping.edges)
