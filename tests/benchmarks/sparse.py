"""Linear algebra of pose graphs: compile time, factorisation, solution and selected inverse, beside native GTSAM."""

from __future__ import annotations

import os
import statistics
import subprocess
import sys
import tempfile
import time
from pathlib import Path
from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np

from tests.benchmarks.graphs import folder
from tests.benchmarks.large_graphs import drives
from tests.benchmarks.measure import Figure
from vplog.graph.normal_equations import normal_equations
from vplog.graph.sparse.cholesky import Cholesky, inverse_blocks
from vplog.graph.sparse.symbolic import Elimination
from vplog.results.g2o import read_g2o

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

NAMES = ("CSAIL", "intel", "sphere2500", "M3500b", "kitti_00", "torus3D", "city10000", "ais2klinik")
JOINT_POSES = 100_000
GAUGE = 1e12
"""Information that holds pose 0."""
ROUNDS = 7


def sparse(names: tuple[str, ...] = NAMES, joint_poses: int = JOINT_POSES) -> Iterator[Figure]:
    """Yield CPU milliseconds of each step on public graphs and on a joint graph, and CPU seconds to compile."""
    with tempfile.TemporaryDirectory() as cache:
        environment = {**os.environ, "NUMBA_CACHE_DIR": cache}
        command = [sys.executable, "-c", "from tests.benchmarks.sparse import first_call; first_call()"]
        first, second = (float(subprocess.check_output(command, env=environment, text=True)) for _ in range(2))
    yield Figure("sparse solver: CPU s to compile", first - second, None, True)
    files = {file.stem: file for file in folder().rglob("*.g2o")}
    for name in names:
        if name in files:
            yield _of_graph(name, files[name])
    yield _of_graph(f"joint graph of {joint_poses} poses", None, joint_poses)


def first_call() -> None:
    """Print CPU seconds that all steps take on a small graph."""
    graph = drives(600, each=300)
    matrix, gradient, _ = normal_equations(graph, np.ones(len(graph.a)), graph.world_from_body)
    matrix.diagonal[0] += GAUGE * np.eye(6)
    began = time.process_time()
    factor = Cholesky.of(Elimination.of(len(graph.world_from_body), graph.a, graph.b), matrix)
    factor.solve(gradient[:, :, None])
    factor.log_determinant()
    inverse_blocks(factor, graph.a, graph.b)
    print(time.process_time() - began)


def _of_graph(name: str, file: Path | None, joint_poses: int = 0) -> Figure:
    graph = read_g2o(file).graph if file else drives(joint_poses, each=5_000)
    weight, poses = np.ones(len(graph.a)), graph.world_from_body
    matrix, gradient, _ = normal_equations(graph, weight, poses)
    matrix.diagonal[0] += GAUGE * np.eye(matrix.diagonal.shape[1])
    right = gradient[:, :, None]
    shape = Elimination.of(len(poses), graph.a, graph.b)
    factor = Cholesky.of(shape, matrix)
    rounds = ROUNDS if file else 2
    facts: dict[str, Any] = {
        "poses": len(poses),
        "edges": len(graph.a),
        "order_ms": _milliseconds(lambda: Elimination.of(len(poses), graph.a, graph.b), rounds),
        "linearise_ms": _milliseconds(lambda: normal_equations(graph, weight, poses), rounds),
        "factorise_ms": _milliseconds(lambda: Cholesky.of(shape, matrix), rounds),
        "solve_ms": _milliseconds(lambda: factor.solve(right), rounds),
        "log_determinant_ms": _milliseconds(factor.log_determinant, rounds),
        "selected_inverse_ms": _milliseconds(lambda: inverse_blocks(factor, graph.a, graph.b), rounds),
    }
    ours = facts["linearise_ms"] + facts["factorise_ms"] + facts["solve_ms"]
    if file is None:
        return Figure(f"{name}: linearise and solve, ms", ours, None, True, facts)
    factors, values = gtsam.readG2o(str(file), graph.dimension == 3)
    if graph.dimension == 3:
        factors.addPriorPose3(0, values.atPose3(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6))
    else:
        factors.addPriorPose2(0, values.atPose2(0), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6))
    ordering = gtsam.Ordering.ColamdNonlinearFactorGraph(factors)
    try:
        facts["gtsam_ms"] = _milliseconds(lambda: factors.linearize(values).optimize(ordering), rounds)
    except RuntimeError:  # it refuses ais2klinik as indeterminate
        return Figure(f"{name}: linearise and solve, ms", ours, None, True, facts)
    return Figure(f"{name}: linearise and solve, time to native GTSAM's", ours / facts["gtsam_ms"], None, True, facts)


def _milliseconds(work: Callable[[], object], rounds: int) -> float:
    """Return the median CPU time."""
    spent = []
    for _ in range(rounds):
        began = time.process_time()
        work()
        spent.append(1e3 * (time.process_time() - began))
    return round(statistics.median(spent), 2)
