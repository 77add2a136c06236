"""Graduated non-convexity: closures that do not fit the rest lose their say, odometry is always believed.

Yang, Antonante, Tzoumas, Carlone: Graduated Non-Convexity for Robust Spatial Perception, RA-L 2020.
GTSAM's GncLMOptimizer does the same, but descends to the end from the first poses at every one of some 40 stages.
Here a stage takes a few steps from where the last one ended, which finds the same closures in a small part of the
time. And the first weights come from the odometry, not from a solve that believes every closure: odometry is known
to be free of outliers, while that solve can end where no later stage gets out of.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from vplog.data import EdgeKind, Solution
from vplog.graph.build import checked
from vplog.graph.consistency import chi2_quantile, far_from_odometry, residual_sigma
from vplog.graph.factors import edge_factors, least_squares
from vplog.graph.initialise import initial_poses
from vplog.graph.lm import solve_kept
from vplog.settings import Settings

if TYPE_CHECKING:
    from vplog.data import Floats, PoseGraph


class GncSettings(Settings):
    """Robust solve by graduated non-convexity with the truncated least squares loss."""

    kind: Literal["gnc"] = "gnc"
    """Name of the method."""
    inlier_probability: float = Field(default=0.99, gt=0, lt=1)
    """A true closure is kept with this probability: its chi-square of 6 degrees stays below that quantile (16.8)."""
    gate_probability: float = Field(default=0.999999, gt=0, lt=1)
    """A closure further from the odometry alone than this quantile (6.2 sigma) is out from the start:
    wide, as the odometry's noise is the least known number here."""
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
    tolerance: float = Field(default=1e-9, gt=0)
    """The last solve has converged when a step gains less than this share of the error."""

    def __call__(self, graph: PoseGraph) -> Solution:
        """Solve. Weights are 1 for odometry, 0 or 1 for loops. Raises GraphError where the graph cannot be solved."""
        graph, _ = checked(graph)
        factors = edge_factors(graph)
        loop = np.array([kind != EdgeKind.ODOMETRY for kind in graph.kind])
        weight = np.where(far_from_odometry(graph, self.gate_probability), 0.0, 1.0)
        bound = chi2_quantile(self.inlier_probability, 6)
        gated = int((weight == 0).sum())
        judged = loop & (weight > 0)
        poses = initial_poses(graph, factors, weight, bound)
        stage = 0
        if judged.any():
            chi2 = residual_sigma(graph, poses)[judged] ** 2
            mu = bound / max(2.0 * chi2.max() - bound, bound)  # remark 5
            for stage in range(1, self.max_stages + 1):  # noqa: B007 (told in the reason)
                weight[judged] = _weights(chi2, bound, mu)
                if ((weight == 0) | (weight == 1)).all():
                    break
                poses = least_squares(graph, factors, weight, poses, self.steps, self.stage_tolerance).world_from_body
                chi2 = residual_sigma(graph, poses)[judged] ** 2
                mu *= self.growth
            weight = np.where(weight > 0.5, 1.0, 0.0)
        found = (
            f"{int(weight[loop].sum())} of {int(loop.sum())} closures were kept, {gated} were too far from the "
            f"odometry, {int(judged.sum() - weight[judged].sum())} went in {stage} stages. "
        )
        return solve_kept(
            graph, factors, weight, poses, self.max_iterations, self.tolerance, found if loop.any() else ""
        )


def _weights(chi2: Floats, bound: float, mu: float) -> Floats:
    """Eq. (14): 1 for small residuals, 0 for large ones, between them falling."""
    with np.errstate(divide="ignore"):
        between = np.sqrt(bound * mu * (mu + 1.0) / chi2) - mu
    return np.where(chi2 <= bound * mu / (mu + 1.0), 1.0, np.where(chi2 >= bound * (mu + 1.0) / mu, 0.0, between))
