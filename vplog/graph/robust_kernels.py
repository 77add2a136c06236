"""Closures under a robust kernel (M-estimator): weights fall with the residual, and no closure is rejected."""

from __future__ import annotations

import math
from collections.abc import Callable
from typing import Any, Literal

import numpy as np
from gtsam.noiseModel import mEstimator
from pydantic import Field

from vplog.data import Floats, PoseGraph, Solution
from vplog.graph.build import checked
from vplog.graph.consistency import chi2_quantile, degrees_of_freedom, is_loop, residual_sigma
from vplog.graph.factors import Factors
from vplog.graph.initialise import initial_poses
from vplog.graph.least_squares import Loss, Objective, minimised
from vplog.graph.lm import as_solution
from vplog.settings import Settings


class KernelSettings(Settings):
    """Least squares with odometry as it is and every closure under a kernel of GTSAM."""

    kind: Any
    """Name of the method."""
    inlier_probability: float = Field(default=0.99, gt=0, lt=1)
    """A closure has half its weight at this quantile of a true one's chi-square (16.8 of 6 degrees)."""
    max_iterations: int = Field(default=100, ge=1)
    """Steps after which it gives up."""
    tolerance: float = Field(default=1e-6, gt=0)
    """Converged when a step gains less than this share of the error."""


def solve_robustly(graph: PoseGraph, settings: KernelSettings, kernel: Callable[[float], Any]) -> Solution:
    """Least squares with `kernel` made for the chi-square at which a closure has half its weight.

    Starts from the best of the poses given, the odometry and the linear solution, no closure counting for more than
    that. Weights are 1 for odometry and the kernel's at the end, 0..1, for loops. Raises GraphError where the graph
    cannot be solved.
    """
    graph, _ = checked(graph)
    factors = Factors.of(graph)
    loops = np.flatnonzero(is_loop(graph))
    half = chi2_quantile(settings.inlier_probability, degrees_of_freedom(graph))
    estimator = kernel(half)
    start = initial_poses(factors, np.ones(len(graph.a)), half)
    objective = Objective(factors, np.ones(len(graph.a)), Loss(loops, estimator))
    fit = minimised(objective, start, settings.max_iterations, settings.tolerance)
    weight = np.ones(len(graph.a))
    weight[loops] = [estimator.weight(sigma) for sigma in residual_sigma(graph, fit.world_from_body, loops).tolist()]
    accepted = int((weight[loops] > 0.5).sum())
    found = f"{accepted} of {len(loops)} closures have more than half their weight. Robust least squares"
    return as_solution(graph, weight, fit, found)


class CauchySettings(KernelSettings):
    """Weight of a closure k^2 / (k^2 + r^2), half of it at r = k: its pull falls, but never to nothing.

    Lee, Fraundorfer, Pollefeys: Robust pose-graph loop-closures with expectation-maximization, IROS 2013, section III.
    """

    kind: Literal["cauchy"] = "cauchy"
    """Name of the method."""

    def __call__(self, graph: PoseGraph) -> Solution:
        return solve_robustly(graph, self, lambda half: mEstimator.Cauchy.Create(math.sqrt(half)))


class DcsSettings(KernelSettings):
    """Dynamic covariance scaling: weight 1 up to r^2 = phi, beyond it (2 phi / (phi + r^2))^2.

    Agarwal, Tipaldi, Spinello, Stachniss, Burgard: Robust Map Optimization Using Dynamic Covariance Scaling, ICRA 2013,
    eq. 16. Half the weight is at r^2 = (2 sqrt(2) - 1) phi.
    """

    kind: Literal["dcs"] = "dcs"
    """Name of the method."""

    def __call__(self, graph: PoseGraph) -> Solution:
        return solve_robustly(graph, self, lambda half: mEstimator.DCS.Create(half / (2.0 * math.sqrt(2.0) - 1.0)))


class GemanMcClureSettings(KernelSettings):
    """Weight of a closure c^4 / (c^2 + r^2)^2, half of it at r^2 = (sqrt(2) - 1) c^2: far ones hardly pull at all.

    Geman and McClure: Statistical Methods for Tomographic Image Reconstruction, Bulletin of the ISI 52, 1987.
    """

    kind: Literal["geman_mcclure"] = "geman_mcclure"
    """Name of the method."""

    def __call__(self, graph: PoseGraph) -> Solution:
        return solve_robustly(
            graph,
            self,
            lambda half: mEstimator.GemanMcClure.Create(math.sqrt(half / (math.sqrt(2.0) - 1.0))),
        )


def truncated_weights(chi2: Floats, bound: float, mu: float) -> Floats:
    """Truncated least squares, reached by degrees (Yang et al., RA-L 2020, eq. 14): 1 for small ones, 0 for large."""
    with np.errstate(divide="ignore"):
        between = np.sqrt(bound * mu * (mu + 1.0) / chi2) - mu
    return np.where(chi2 <= bound * mu / (mu + 1.0), 1.0, np.where(chi2 >= bound * (mu + 1.0) / mu, 0.0, between))
