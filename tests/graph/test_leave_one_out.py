"""What closures cost the rest, told from one factorisation, is what solving without them shows."""

from __future__ import annotations

from typing import TYPE_CHECKING

import gtsam
import numpy as np
import pytest

from tests.benchmarks.graphs import city
from tests.graph.drive import ring
from tests.graph.gtsam_graph import as_values, weighted
from vplog.geometry import se3
from vplog.graph.consistency import is_loop, residual_sigma
from vplog.graph.factors import Factors
from vplog.graph.least_squares import Objective, descend
from vplog.graph.leave_one_out import distance, tension
from vplog.graph.marginals import edge_covariances

if TYPE_CHECKING:
    from vplog.data import PoseGraph

GRAPHS = {"planar": city(200, seed=1), "spatial": ring(80, loops=10).graph}
each_graph = pytest.mark.parametrize("graph", GRAPHS.values(), ids=GRAPHS)


def solved(graph: PoseGraph, weight: np.ndarray) -> tuple[np.ndarray, float]:
    poses = descend(Factors.of(graph), weight, graph.world_from_body, 100, 1e-12).world_from_body
    return poses, float((weight * residual_sigma(graph, poses) ** 2).sum())


@each_graph
def test_covariances_agree_with_gtsam(graph: PoseGraph) -> None:
    weight = np.ones(len(graph.a))
    loops = np.flatnonzero(is_loop(graph))
    poses, _ = solved(graph, weight)
    found = edge_covariances(Objective(Factors.of(graph), weight), poses, loops)
    marginals = gtsam.Marginals(weighted(graph, weight), as_values(se3.between(poses[:1], poses), graph.dimension))
    axes, order = ([2, 3, 4], [2, 0, 1]) if graph.dimension == 2 else (list(range(6)), list(range(6)))
    for row, (a, b) in enumerate(zip(graph.a[loops].tolist(), graph.b[loops].tolist(), strict=True)):
        joint = marginals.jointMarginalCovariance([a, b])
        blocks = [[joint.at(one, other)[np.ix_(order, order)] for other in (a, b)] for one in (a, b)]
        moved = se3.adjoint(se3.between(poses[b], poses[a]))[np.ix_(axes, axes)]
        change = np.concatenate([-moved, np.eye(len(axes))], axis=1)
        expected = change @ np.block(blocks) @ change.T
        # GTSAM loses digits of a planar edge's derivative where its residual turns by less than a milliradian
        np.testing.assert_allclose(found[row], expected, rtol=1e-6, atol=1e-6 * np.abs(expected).max())


@each_graph
def test_the_cost_is_what_chi_square_falls_by(graph: PoseGraph) -> None:
    weight = np.ones(len(graph.a))
    loops = np.flatnonzero(is_loop(graph))
    factors = Factors.of(graph)
    poses, whole = solved(graph, weight)
    pull = tension(factors, weight, poses, loops)
    for row in range(0, len(loops), max(len(loops) // 6, 1)):
        without = np.where(np.arange(len(graph.a)) == loops[row], 0.0, 1.0)
        other, left = solved(graph, without)
        assert pull.cost[row] == pytest.approx(whole - left, rel=0.05, abs=0.02)
        # and from the other side: how far it is from where the others predict it
        apart, spread = distance(factors, without, other, loops[row : row + 1])
        assert apart[0] == pytest.approx(whole - left, rel=0.05, abs=0.02)
        assert spread[0] == pytest.approx(pull.log_spread[row], abs=0.02)
