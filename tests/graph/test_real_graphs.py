"""Public benchmark graphs, solved to the costs that plain GTSAM is known to reach."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import gtsam
import numpy as np
import pytest

from tests.benchmarks.graphs import with_groups
from vplog.data import EdgeKind, PoseGraph
from vplog.graph.consistency import is_loop
from vplog.graph.solve import GncSettings, LmSettings, decided
from vplog.results.g2o import read_g2o

FOLDER = Path(os.environ.get("VPLOG_DATA", Path(__file__).parents[3] / "shared" / "data")) / "posegraphs"


def read(name: str) -> PoseGraph:
    path = FOLDER / "SE-Sync" / name
    if not path.exists():
        pytest.skip(f"{path} is not there; set VPLOG_DATA to the folder of public data.")
    factors, values = gtsam.readG2o(str(path), True)
    edges: list[Any] = [factors.at(k) for k in range(factors.size())]  # typed as the base of all factors
    keys = np.array([edge.keys() for edge in edges], np.int32)
    order = list(range(len(values.keys())))
    return PoseGraph(
        world_from_body=np.array([values.atPose3(node).matrix() for node in order]),
        a=keys[:, 0],
        b=keys[:, 1],
        a_from_b=np.array([edge.measured().matrix() for edge in edges]),
        information=np.array([edge.noiseModel().information() for edge in edges]),
        kind=[EdgeKind.ODOMETRY if b == a + 1 else EdgeKind.LOOP for a, b in keys],
    )


@pytest.mark.parametrize(("name", "chi2"), [("parking-garage.g2o", 1.2683848), ("sphere2500.g2o", 1351.4019)])
def test_least_squares_reaches_the_known_cost(name: str, chi2: float) -> None:
    solution = LmSettings()(read(name))
    assert solution.converged
    assert 2.0 * solution.error_after == pytest.approx(chi2, rel=1e-4)


def test_true_closures_within_what_is_claimed_survive_groups_of_false_ones() -> None:
    """Most of CSAIL's closures are three times as good as claimed, and some are as claimed."""
    path = FOLDER / "SE-Sync" / "CSAIL.g2o"
    if not path.exists():
        pytest.skip(f"{path} is not there; set VPLOG_DATA to the folder of public data.")
    graph = read_g2o(path).graph
    graph, false = with_groups(graph, LmSettings()(graph).world_from_body, count=5, size=5, seed=0)
    kept = decided(graph, GncSettings()).solution.weight > 0.5
    assert (kept == ~false)[is_loop(graph)].all()
