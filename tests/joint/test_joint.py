"""Drives that know nothing of each other's start end in one map where closures join them, and only there."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.graph import drive as drives
from vplog.data import EdgeKind, Trajectory
from vplog.evaluate.trajectory import ate
from vplog.geometry import se3
from vplog.graph.solve import GncSettings
from vplog.joint.graph import Between, JoinSettings, SessionGraph, join
from vplog.refinement.refine import RefineSettings

SHIFT = se3.exp(np.array([0.1, -0.2, 2.0, 30.0, 10.0, -3.0]))
CLOSURE = np.diag(1.0 / drives.CLOSURE_SIGMA**2)


def lap(seed: int, loops: int = 10) -> tuple[SessionGraph, np.ndarray]:
    ring = drives.ring(80, loops, seed=seed)
    graph = ring.graph
    return SessionGraph(graph, np.array([kind == EdgeKind.ODOMETRY for kind in graph.kind])), ring.true


def moved(drive: SessionGraph, by: np.ndarray) -> SessionGraph:
    return replace(drive, graph=replace(drive.graph, world_from_body=by @ drive.graph.world_from_body))


def between(later: int, earlier: int, true: list[np.ndarray], count: int, seed: int, false: int = 0) -> Between:
    random = np.random.default_rng(seed)
    query = np.sort(random.choice(len(true[later]), count, replace=False))
    match = np.array([np.linalg.norm(true[earlier][:, :3, 3] - true[later][q, :3, 3], axis=1).argmin() for q in query])
    z = se3.between(true[earlier][match], true[later][query])
    z = z @ se3.exp(random.normal(size=(count, 6)) * drives.CLOSURE_SIGMA)
    z[:false] = z[:false] @ se3.exp(random.normal(size=(false, 6)) * [0.1, 0.1, 0.5, 4.0, 4.0, 0.3])
    information, none = np.broadcast_to(CLOSURE, (count, 6, 6)).copy(), np.zeros(count)
    return Between(later, earlier, query, match, z, information, none > 0, none)


def one_run(true: list[np.ndarray], log_odds: float) -> Between:
    """Closures of 16 neighbouring keyframes."""
    every = between(1, 0, true, len(true[1]), seed=3)
    return replace(some(every, np.arange(20, 36)), log_odds=np.full(16, log_odds))


def some(tie: Between, rows: np.ndarray) -> Between:
    names = ("query", "match", "match_from_query", "information", "of_odometry", "log_odds")
    return replace(tie, **{name: getattr(tie, name)[rows] for name in names})


@pytest.mark.parametrize(("p_false", "maps"), [(0.02, [(0, 1)]), (0.5, [(0, 1)]), (0.98, [(0,), (1,)])])
def test_drives_that_share_one_stretch_are_joined_unless_recognition_is_against_it(p_false: float, maps: list) -> None:
    """Nothing but the closures themselves tells how the drives lie to each other."""
    (first, true_first), (second, true_second) = (lap(seed, loops=0) for seed in (1, 2))
    ties = one_run([true_first, true_second], math.log(p_false / (1.0 - p_false)))
    found = join([first, moved(second, SHIFT)], [ties], GncSettings(), JoinSettings(), RefineSettings())
    assert found.maps == maps


def joint_error(poses: list[np.ndarray], true: list[np.ndarray]) -> float:
    both = np.concatenate(poses), np.concatenate(true)
    stamps = np.arange(len(both[0]), dtype=np.int64) * 10**9
    return ate(Trajectory(stamps, both[0]), Trajectory(stamps, both[1])).rmse_m


@pytest.mark.parametrize("false", [0, 6])
def test_two_drives_become_one_map(false: int) -> None:
    (first, true_first), (second, true_second) = lap(1), lap(2)
    true = [true_first, true_second]
    ties = between(1, 0, true, 20, seed=3, false=false)
    found = join([first, moved(second, SHIFT)], [ties], GncSettings(), JoinSettings(), RefineSettings())
    assert found.maps == [(0, 1)]
    assert found.weight[0][:false].sum() == 0
    assert found.weight[0][false:].sum() >= 18 - false
    assert joint_error(found.world_from_body, true) < 0.3
    np.testing.assert_allclose(found.world_from_body[0][0], first.graph.world_from_body[0])


def test_a_drive_that_joins_nothing_is_left_as_it_is() -> None:
    (first, true_first), (second, true_second), (third, true_third) = lap(1), lap(2), lap(3)
    true = [true_first, true_second, true_third]
    third = moved(third, SHIFT)
    ties = [between(1, 0, true, 10, 0), between(2, 0, true, 6, 1, false=6), between(2, 1, true, 2, 2)]
    found = join([first, second, third], ties, GncSettings(), JoinSettings(), RefineSettings())
    assert found.maps == [(0, 1), (2,)]
    np.testing.assert_array_equal(found.world_from_body[2], third.graph.world_from_body)
    assert found.weight[1].sum() == found.weight[2].sum() == 0
    assert np.isnan(found.residual[1]).all()
    assert list(found.apart) == [1]


def test_a_chain_of_drives_is_joined_through_the_middle_one() -> None:
    laps = [lap(seed) for seed in (1, 2, 3)]
    true = [one for _, one in laps]
    ties = [between(1, 0, true, 10, 0), between(2, 1, true, 10, 1)]
    found = join(
        [drive if at == 0 else moved(drive, SHIFT) for at, (drive, _) in enumerate(laps)],
        ties,
        GncSettings(),
        JoinSettings(),
        RefineSettings(),
    )
    assert found.maps == [(0, 1, 2)]
    assert joint_error(found.world_from_body, true) < 0.3


def test_no_ties_no_maps() -> None:
    first, _ = lap(1)
    found = join([first, first], [], GncSettings(), JoinSettings(), RefineSettings())
    assert found.maps == [(0,), (1,)]
    assert found.solved == {}


def mistold(seed: int, factor: float) -> tuple[SessionGraph, np.ndarray]:
    """A lap whose odometry is worse than it says."""
    (first, true), random = lap(seed), np.random.default_rng(seed)
    graph, odometry = first.graph, first.of_odometry
    noise = random.normal(size=(odometry.sum(), 6)) * drives.ODOMETRY_SIGMA * factor
    measured = np.array(graph.a_from_b)
    measured[odometry] = se3.between(true[graph.a[odometry]], true[graph.b[odometry]]) @ se3.exp(noise)
    return replace(first, graph=replace(graph, a_from_b=measured)), true


def test_noise_that_is_somewhat_mistold_parts_no_drives() -> None:
    """The more closures, the more surely a test of all of odometry tells 1.3 from 1."""
    laps = [mistold(seed, 1.3) for seed in range(4)]
    true = [one for _, one in laps]
    ties = [between(j, i, true, 30, 10 * i + j) for j in range(4) for i in range(j)]
    shifted = [drive if at == 0 else moved(drive, SHIFT) for at, (drive, _) in enumerate(laps)]
    found = join(shifted, ties, GncSettings(), JoinSettings(), RefineSettings())
    assert found.maps == [(0, 1, 2, 3)]
    assert sum(weight.sum() for weight in found.weight) > 0.9 * 30 * len(ties)
    assert joint_error(found.world_from_body, true) < 0.3


def test_odometry_six_times_worse_than_it_says_parts_no_drives() -> None:
    laps = [mistold(seed, 6.0) for seed in (1, 2)]
    ties = [between(1, 0, [one for _, one in laps], 40, 0)]
    found = join([one for one, _ in laps], ties, GncSettings(), JoinSettings(), RefineSettings())
    assert (found.maps, found.weight[0].sum()) == ([(0, 1)], 40)


def test_one_view_that_looks_like_others_joins_nothing() -> None:
    laps = [lap(seed) for seed in (1, 2)]
    tie = between(1, 0, [true for _, true in laps], 12, 0)
    rows = np.array([3, 3, 3, 3])
    one = some(tie, rows)
    one = replace(one, match=one.match + np.arange(-1, 3))
    found = join([drive for drive, _ in laps], [one], GncSettings(), JoinSettings(), RefineSettings())
    assert found.maps == [(0,), (1,)]


def test_few_closures_of_drives_that_others_join_are_kept() -> None:
    laps = [lap(seed) for seed in (1, 2, 3)]
    true = [one for _, one in laps]
    ties = [between(1, 0, true, 10, 0), between(2, 1, true, 10, 1), between(2, 0, true, 2, 2)]
    found = join([drive for drive, _ in laps], ties, GncSettings(), JoinSettings(), RefineSettings())
    assert found.maps == [(0, 1, 2)]
    assert found.weight[2].tolist() == [1.0, 1.0]
    assert np.isfinite(found.residual[2]).all()


def looking_alike(true: list[np.ndarray], random: np.random.Generator) -> Between:
    """Six neighbours of the one drive that see what six of the other see, elsewhere: they agree with each other."""
    tie = between(1, 0, true, 12, 0)
    rows, query, match = np.zeros(6, int), np.arange(20, 26), np.arange(60, 66)
    wrong = se3.exp(np.array([0.0, 0.0, 0.3, 2.0, 1.0, 0.0]))
    z = se3.between(true[0][match], true[0][np.full(6, 60)]) @ wrong
    z = z @ se3.between(true[1][np.full(6, 20)], true[1][query])
    z = z @ se3.exp(random.normal(size=(6, 6)) * drives.CLOSURE_SIGMA)
    return replace(some(tie, rows), query=query, match=match, match_from_query=z)


def test_neighbours_of_one_place_that_looks_like_another_join_nothing() -> None:
    laps = [lap(seed) for seed in (1, 2)]
    tie = looking_alike([true for _, true in laps], np.random.default_rng(0))
    found = join([drive for drive, _ in laps], [tie], GncSettings(), JoinSettings(), RefineSettings())
    assert found.maps == [(0,), (1,)]
    loose = JoinSettings(spacing=1)
    assert join([drive for drive, _ in laps], [tie], GncSettings(), loose, RefineSettings()).maps == [(0, 1)]


def test_places_that_all_look_like_their_neighbours_do_not_part_what_others_join() -> None:
    """Three places of the third drive, four views each, look like the first drive's 5 m further on: one aisle for the
    next. They agree with each other, and not with the way through the second drive."""
    laps = [lap(seed) for seed in (1, 2, 3)]
    true = [one for _, one in laps]
    tie = between(2, 0, true, 80, 2)
    rows = np.concatenate([np.arange(start, start + 4) for start in (5, 20, 40)])
    aside = se3.exp(np.array([0.0, 0.0, 0.3, 5.0, 0.0, 0.0]))
    z = se3.inverse(true[0][tie.match[rows]]) @ aside @ true[2][tie.query[rows]]
    false = replace(some(tie, rows), match_from_query=z)
    ties = [between(1, 0, true, 15, 0), between(2, 1, true, 15, 1), false]
    found = join([drive for drive, _ in laps], ties, GncSettings(), JoinSettings(), RefineSettings())
    assert found.maps == [(0, 1, 2)]
    assert [weight.sum() for weight in found.weight] == [15, 15, 0]
    assert joint_error(found.world_from_body, true) < 0.3
