"""Plain least squares over all edges."""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from vplog.data import Floats, PoseGraph, Solution
from vplog.errors import plural
from vplog.graph.build import checked
from vplog.graph.consistency import residual_sigma
from vplog.graph.factors import Factors
from vplog.graph.initialise import initial_poses
from vplog.graph.least_squares import Fit, descend
from vplog.settings import Settings


class LmSettings(Settings):
    """Levenberg-Marquardt on all edges."""

    kind: Literal["lm"] = "lm"
    """Name of the method."""
    max_iterations: int = Field(default=100, ge=1)
    """Steps after which it gives up; graphs of drives take 5-20."""
    tolerance: float = Field(default=1e-6, gt=0)
    """Converged when a step gains less than this share of the error."""

    def __call__(self, graph: PoseGraph) -> Solution:
        """Solve. Raises GraphError where the graph is none or its poses are not determined."""
        graph, _ = checked(graph)
        factors = Factors.of(graph)
        weight = np.ones(len(graph.a))
        return solve_weighted(factors, weight, initial_poses(factors, weight), self.max_iterations, self.tolerance, "")


def solve_weighted(
    factors: Factors, weight: Floats, start: Floats, max_iterations: int, tolerance: float, found: str
) -> Solution:
    """Least squares over the weighted edges (E,) from `start`, as a Solution; `found` opens its reason."""
    fit = descend(factors, weight, start, max_iterations, tolerance)
    return as_solution(factors.graph, weight, fit, f"{found}Least squares")


def as_solution(graph: PoseGraph, weight: Floats, fit: Fit, found: str) -> Solution:
    """The fit of the weighted edges (E,) as a Solution; its reason is `found` and how the descent ended."""
    end = "converged" if fit.converged else "stopped at the step limit"
    return Solution(
        world_from_body=fit.world_from_body,
        weight=weight,
        error_before=half_chi2(graph, weight, graph.world_from_body),
        error_after=half_chi2(graph, weight, fit.world_from_body),
        iterations=fit.iterations,
        converged=fit.converged,
        reason=f"{found} {end} after {plural(fit.iterations, 'step')}.",
    )


def half_chi2(graph: PoseGraph, weight: Floats, poses: Floats) -> float:
    """Half the weighted chi-square of all edges at poses (N, 4, 4)."""
    return float(0.5 * (weight * residual_sigma(graph, poses) ** 2).sum())
