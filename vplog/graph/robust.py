"""Closures under a robust kernel: the less they fit, the less they pull, but none is thrown out."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Solution
from vplog.graph.build import checked
from vplog.graph.consistency import chi2_quantile, degrees_of_freedom, is_loop, residual_sigma
from vplog.graph.factors import Factors, least_squares
from vplog.graph.initialise import initial_poses
from vplog.graph.lm import half_chi2

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.data import PoseGraph


def solve_robustly(
    graph: PoseGraph, kernel: Callable[[float], Any], probability: float, max_iterations: int, tolerance: float
) -> Solution:
    """Least squares with odometry as it is and every closure under `kernel`, made by GTSAM for a chi-square.

    That chi-square is the `probability` quantile of a true closure's: there it has half its weight. Starts from the
    best of the poses given, the odometry and the linear solution, no closure counting for more than that. Weights are
    the kernel's at the end, 0..1. Raises GraphError where the graph cannot be solved.
    """
    graph, _ = checked(graph)
    factors = Factors.of(graph)
    loops = np.flatnonzero(is_loop(graph))
    half = chi2_quantile(probability, degrees_of_freedom(graph))
    estimator = kernel(half)
    start = initial_poses(factors, np.ones(len(graph.a)), half)
    fit = least_squares(factors, factors.robust(loops, estimator), start, max_iterations, tolerance)
    weight = np.ones(len(graph.a))
    weight[loops] = [estimator.weight(sigma) for sigma in residual_sigma(graph, fit.world_from_body, loops).tolist()]
    kept = int((weight[loops] > 0.5).sum())
    end = "converged" if fit.converged else "stopped at the limit"
    return Solution(
        world_from_body=fit.world_from_body,
        weight=weight,
        error_before=half_chi2(graph, weight, graph.world_from_body),
        error_after=half_chi2(graph, weight, fit.world_from_body),
        iterations=fit.iterations,
        converged=fit.converged,
        reason=f"{kept} of {len(loops)} closures have more than half their weight. "
        f"Robust least squares {end} after {fit.iterations} step{'' if fit.iterations == 1 else 's'}.",
    )
