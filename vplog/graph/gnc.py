"""Graduated non-convexity: inconsistent closures are down-weighted, odometry keeps its weight.

Yang, Antonante, Tzoumas, Carlone: Graduated Non-Convexity for Robust Spatial Perception, RA-L 2020. `search` takes its
result as one proposal of the decision.
"""

from __future__ import annotations

from typing import Literal, NamedTuple

import numpy as np
from pydantic import Field

from vplog.data import Bools, Floats, PoseGraph, Solution
from vplog.graph.best_hypothesis import best_hypothesis
from vplog.graph.build import checked
from vplog.graph.consistency import OdometryChain, chi2_quantile, degrees_of_freedom, is_loop, residual_sigma
from vplog.graph.factors import Factors
from vplog.graph.initialise import initial_poses
from vplog.graph.least_squares import descend
from vplog.graph.lm import half_chi2, solve_weighted
from vplog.graph.robust_kernels import truncated_weights
from vplog.graph.search import Cost, bounded
from vplog.graph.slips import Slipping
from vplog.graph.variance_components import Sigmas
from vplog.settings import Settings

_JOINS = 1e-6
"""Least weight of odometry, so that the poses stay determined."""


class Decision(NamedTuple):
    """Selection of the true closures and of the steps of the odometry that slip."""

    graph: PoseGraph
    """With the sigmas that are claimed, no closure's far below those of the others, and slipping steps replaced."""
    solution: Solution
    sigmas: Sigmas
    """By what the claimed sigmas were multiplied."""
    slipping: Slipping


class GncSettings(Settings):
    """Robust solve by graduated non-convexity with the truncated least squares loss."""

    kind: Literal["gnc"] = "gnc"
    """Name of the method."""
    inlier_probability: float = Field(default=0.99, gt=0, lt=1)
    """A true closure is kept with this probability: its chi-square of 6 degrees stays below that quantile (16.8)."""
    growth: float = Field(default=2.0, gt=1)
    """Factor by which the loss comes closer to the truncated one at each stage; the paper has 1.4, 2 found the
    same closures on drives of 850 keyframes in half the time."""
    steps: int = Field(default=3, ge=1)
    """Least squares steps per stage at most, each stage starts where the last ended; 10 000 poses need 3."""
    stage_tolerance: float = Field(default=0.01, gt=0)
    """A stage ends early when a step gains less than this share of the error."""
    max_stages: int = Field(default=60, ge=1)
    """Stages after which it gives up; residuals of 1e6 sigma take 40."""
    max_iterations: int = Field(default=100, ge=1)
    """Steps of the last solve, with the kept edges alone."""
    tolerance: float = Field(default=1e-6, gt=0)
    """The last solve has converged when a step gains less than this share of the error."""

    def __call__(self, graph: PoseGraph) -> Solution:
        """Solve. Weights are 1 for odometry, 0 or 1 for loops. Raises GraphError if the graph cannot be solved."""
        return self.decided(graph).solution

    def decided(self, graph: PoseGraph, cost: Cost | None = None, log_odds: Floats | None = None) -> Decision:
        """Decide which closures are true, and solve the graph with them; arguments as those of `best_hypothesis`."""
        graph, _ = checked(graph)
        factors, loops = Factors.of(graph), is_loop(graph)
        if not loops.any():
            weight = np.ones(len(graph.a))
            start = initial_poses(factors, weight)
            solution = solve_weighted(factors, weight, start, self.max_iterations, self.tolerance, "")
            return Decision(graph, solution, Sigmas(), Slipping.nowhere(graph))
        best = best_hypothesis(graph, self.annealed, cost, log_odds)
        graph = best.slipping.applied(bounded(graph), best.sigmas)
        count, inliers = int(loops.sum()), int(best.weight[loops].sum())
        if inliers == 0:
            why = f"Odometry was kept: the {count} closures are likelier to be all false than any of them to be true."
            before, after = (half_chi2(graph, best.weight, poses) for poses in (graph.world_from_body, best.poses))
            solution = Solution(best.poses, best.weight, before, after, 0, True, why)
            return Decision(graph, solution, Sigmas(), best.slipping)
        found = f"{inliers} of {count} closures were kept. "
        solution = solve_weighted(
            Factors.of(graph), best.weight, best.poses, self.max_iterations, self.tolerance, found
        )
        return Decision(graph, solution, best.sigmas, best.slipping)

    def annealed(self, factors: Factors, may_be_false: Bools) -> tuple[Floats, Floats]:
        """Return weights (E,), 0 or 1, and poses (N, 4, 4) by graduated non-convexity with the noise of the graph.

        The edges `may_be_false` (E,) may be rejected: closures, or odometry as well.
        """
        graph = factors.graph
        weight = np.ones(len(graph.a))
        bound = chi2_quantile(self.inlier_probability, degrees_of_freedom(graph))
        trusts_odometry = not (may_be_false & graph.odometry).any()
        start = initial_poses(factors, weight, bound) if trusts_odometry else OdometryChain.of(graph).poses
        return self._anneal(factors, weight, start, bound, may_be_false)

    def _anneal(
        self, factors: Factors, weight: Floats, poses: Floats, bound: float, may_be_false: Bools
    ) -> tuple[Floats, Floats]:
        """Algorithm 1 of the paper over these edges (E,) of weight 1: weights 0 or 1, and poses."""
        weight, joins = np.array(weight), np.where(factors.graph.odometry, _JOINS, 0.0)
        judged = np.flatnonzero(may_be_false & (weight > 0))
        if len(judged) == 0:
            return weight, poses
        poses = descend(factors, weight, poses, self.max_iterations, 1e-3).world_from_body
        chi2 = residual_sigma(factors.graph, poses, judged) ** 2
        if (chi2 > bound).mean() <= 1.0 - self.inlier_probability:  # as many as there are where all are true
            return weight, poses
        mu = bound / max(2.0 * chi2.max() - bound, bound)  # remark 5
        for _ in range(self.max_stages):
            weight[judged] = truncated_weights(chi2, bound, mu)
            if ((weight == 0) | (weight == 1)).all():
                break
            trusted = np.maximum(weight, joins)
            poses = descend(factors, trusted, poses, self.steps, self.stage_tolerance).world_from_body
            chi2 = residual_sigma(factors.graph, poses, judged) ** 2
            mu *= self.growth
        return np.where(weight > 0.5, 1.0, 0.0), poses
