from __future__ import annotations

import hashlib
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import gtsam
import numpy as np
import pytest
from pydantic import TypeAdapter

from tests.graph.drive import position_error, ring, without_loops
from tests.graph.gtsam_graph import as_array, weighted
from vplog.data import EdgeKind, PoseGraph, Solution
from vplog.geometry import se3
from vplog.graph.consistency import chi2_quantile
from vplog.graph.solve import GncSettings, LmSettings, OptimiserSettings, about_slips, decided

METHODS = [GncSettings(), LmSettings()]


def loops(graph: PoseGraph) -> np.ndarray:
    return np.array([kind == EdgeKind.LOOP for kind in graph.kind])


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.kind)
def test_a_closed_loop_closes(method: GncSettings | LmSettings) -> None:
    drive = ring()
    solution = method(drive.graph)
    before, after = (position_error(x, drive.true) for x in (drive.keyframes.odom_from_body, solution.world_from_body))
    assert after < 0.4 * before
    assert solution.converged
    assert solution.error_after < 0.01 * solution.error_before
    assert (solution.weight == 1).all()
    np.testing.assert_array_equal(solution.world_from_body[0], drive.graph.world_from_body[0])


@pytest.mark.parametrize("method", METHODS, ids=lambda m: m.kind)
def test_without_loops_odometry_comes_back(method: GncSettings | LmSettings) -> None:
    drive = ring()
    solution = method(without_loops(drive.graph))
    np.testing.assert_allclose(solution.world_from_body, drive.keyframes.odom_from_body, atol=1e-9)
    assert solution.converged


@pytest.mark.parametrize("false", [2, 5, 9, 20])  # 9 to 50 % of the closures
@pytest.mark.parametrize("seed", range(3))
def test_false_closures_lose_their_weight_and_true_ones_keep_it(false: int, seed: int) -> None:
    drive = ring(loops=20, false=false, seed=seed)
    # beyond the 0.99 of the default, so that all true ones are to be kept
    solution = GncSettings(inlier_probability=0.99999)(drive.graph)
    np.testing.assert_array_equal(solution.weight[loops(drive.graph)], ~drive.false[loops(drive.graph)])
    assert position_error(solution.world_from_body, drive.true) < 0.5 * position_error(
        drive.keyframes.odom_from_body, drive.true
    )


@pytest.mark.parametrize("jump_m", [0.0, 10.0])
def test_a_step_that_the_closures_contradict_is_not_used(jump_m: float) -> None:
    drive = ring(60, loops=20, false=5)
    measured = drive.graph.a_from_b.copy()
    measured[30, 0, 3] += jump_m
    decision = decided(replace(drive.graph, a_from_b=measured), GncSettings())
    true = ~drive.false & ~drive.graph.odometry
    assert decision.solution.weight[true].all()
    assert position_error(decision.solution.world_from_body, drive.true) < 0.5
    found = [re.search(r"between poses (\d+) and (\d+)", text) for text in about_slips(decision, np.arange(60) + 100)]
    assert len(found) == (jump_m > 0.0)
    assert all(one is not None and 120 <= int(one[1]) <= 130 < int(one[2]) < 140 for one in found)


def test_a_robot_that_is_held_in_place_keeps_its_closures() -> None:
    """Its wheels turn for ten steps; closures see that it stands, and that the ways before and after meet there."""
    random = np.random.default_rng(1)
    drive = ring(60, loops=20, false=0)
    stalled = np.insert(drive.true, [30] * 10, drive.true[30], axis=0)
    graph = drive.graph
    a, b = (np.where(end > 30, end + 10, end).astype(np.int32) for end in (graph.a, graph.b))
    loops_ = ~graph.odometry
    steps = np.arange(69, dtype=np.int32)
    at, to = np.array([31, 33, 35, 32], np.int32), np.array([36, 38, 40, 39], np.int32)
    step = se3.between(stalled[:-1], stalled[1:]) @ se3.exp(random.normal(size=(69, 6)) * 0.002)
    step[30:40, 0, 3] += 1.0
    stands = se3.exp(random.normal(size=(4, 6)) * 0.01)
    info = graph.information
    held = replace(
        graph,
        world_from_body=stalled,
        a=np.concatenate([steps, a[loops_], at]),
        b=np.concatenate([steps + 1, b[loops_], to]),
        a_from_b=np.concatenate([step, graph.a_from_b[loops_], stands]),
        information=np.concatenate([np.tile(info[0], (69, 1, 1)), info[loops_], np.tile(info[loops_][:1], (4, 1, 1))]),
        kind=[EdgeKind.ODOMETRY] * 69 + [EdgeKind.LOOP] * (int(loops_.sum()) + 4),
    )
    decision = decided(held, GncSettings())
    assert decision.solution.weight.all()
    assert set(decision.slipping.edges.tolist()) == set(range(30, 40))
    assert position_error(decision.solution.world_from_body, stalled) < 0.5


def test_gnc_agrees_with_gtsam() -> None:
    """GTSAM's GncLMOptimizer, odometry and gauge known, keeps the same closures and ends at the same poses."""
    drive = ring(80, loops=12, false=6, seed=5)
    graph, n = drive.graph, 80
    factors = weighted(graph, np.ones(len(graph.a)))
    values = gtsam.Values()
    for node, pose in enumerate(graph.world_from_body):
        values.insert(node, gtsam.Pose3(pose))
    settings = gtsam.GncLMParams()
    settings.setKnownInliers(list(range(n)))  # the gauge comes first, then the odometry
    settings.setLossType(gtsam.GncLossType.TLS)
    optimiser = gtsam.GncLMOptimizer(factors, values, settings)
    optimiser.setInlierCostThresholdsAtProbability(0.99)
    expected = graph.world_from_body[0] @ as_array(optimiser.optimize(), 3)  # our factors have pose 0 as the origin
    solution = GncSettings()(graph)
    np.testing.assert_array_equal(solution.weight, optimiser.getWeights()[1:] > 0.5)
    np.testing.assert_allclose(solution.world_from_body, expected, atol=1e-3)
    assert chi2_quantile(0.99, 6) == pytest.approx(2 * optimiser.getInlierCostThresholds()[-1])


def test_the_same_graph_gives_the_same_bytes() -> None:
    code = (
        "import hashlib; from tests.graph.drive import ring; from vplog.graph.solve import GncSettings;"
        "s = GncSettings()(ring(false=9).graph);"
        "print(hashlib.sha256(s.world_from_body.tobytes() + s.weight.tobytes()).hexdigest())"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=Path(__file__).parents[2], capture_output=True, text=True, check=True
    )
    solution = GncSettings()(ring(false=9).graph)
    again = GncSettings()(ring(false=9).graph)
    assert solution.world_from_body.tobytes() == again.world_from_body.tobytes()
    here = hashlib.sha256(solution.world_from_body.tobytes() + solution.weight.tobytes()).hexdigest()
    assert done.stdout.strip() == here


def test_a_bad_start_is_repaired_by_the_chordal_solution() -> None:
    drive = ring(noise=0.0)
    random = np.random.default_rng(0)
    lost = drive.graph.world_from_body.copy()
    lost[1:] = lost[random.permutation(np.arange(1, len(lost)))]
    solution = LmSettings()(replace(drive.graph, world_from_body=lost))
    assert position_error(solution.world_from_body, drive.true) < 1e-6


def test_a_loop_may_be_written_either_way_round() -> None:
    drive = ring(false=5)
    swapped = replace(
        drive.graph,
        a=drive.graph.b,
        b=drive.graph.a,
        a_from_b=np.linalg.inv(drive.graph.a_from_b).astype(np.float64),
    )
    # only the loops: odometry goes forward
    keep = loops(drive.graph)
    mixed = replace(
        drive.graph,
        a=np.where(keep, swapped.a, drive.graph.a),
        b=np.where(keep, swapped.b, drive.graph.b),
        a_from_b=np.where(keep[:, None, None], swapped.a_from_b, drive.graph.a_from_b),
    )
    solution = GncSettings()(mixed)
    assert solution.weight[drive.false].sum() == 0
    assert position_error(solution.world_from_body, drive.true) < 1.0


def test_nothing_is_printed(capfd: pytest.CaptureFixture[str]) -> None:
    for method in METHODS:
        method(ring(60, 10, 5).graph)
    assert capfd.readouterr() == ("", "")


def test_methods_are_chosen_by_their_kind() -> None:
    adapter = TypeAdapter(OptimiserSettings)
    for method in METHODS:
        assert adapter.validate_python({"kind": method.kind}) == method
        assert isinstance(method(ring(20, 2).graph), Solution)
