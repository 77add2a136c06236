"""Geman-McClure kernel: far closures hardly pull at all.

Geman and McClure: Statistical Methods for Tomographic Image Reconstruction, Bulletin of the ISI 52, 1987.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, Literal

import gtsam
from pydantic import Field

from vplog.graph.robust import solve_robustly
from vplog.settings import Settings

if TYPE_CHECKING:
    from vplog.data import PoseGraph, Solution


class GemanMcClureSettings(Settings):
    """Least squares with the weight of a closure c^4 / (c^2 + r^2)^2."""

    kind: Literal["geman_mcclure"] = "geman_mcclure"
    """Name of the method."""
    inlier_probability: float = Field(default=0.99, gt=0, lt=1)
    """A closure has half its weight, which is at r^2 = (sqrt(2) - 1) c^2, at this quantile of a true one's chi-square
    (16.8 of 6 degrees)."""
    max_iterations: int = Field(default=100, ge=1)
    """Steps after which it gives up."""
    tolerance: float = Field(default=1e-6, gt=0)
    """It has converged when a step gains less than this share of the error."""

    def __call__(self, graph: PoseGraph) -> Solution:
        """Solve. Weights are 1 for odometry, 0..1 for loops. Raises GraphError where the graph cannot be solved."""
        return solve_robustly(graph, _kernel, self.inlier_probability, self.max_iterations, self.tolerance)


def _kernel(half: float) -> gtsam.noiseModel.mEstimator.Base:
    return gtsam.noiseModel.mEstimator.GemanMcClure.Create(math.sqrt(half / (math.sqrt(2.0) - 1.0)))
