"""Test of closures against GPS: a solution further from the fixes than odometry alone is rejected."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from vplog.graph.consistency import is_loop, odometry_chain, odometry_kept
from vplog.graph.gps_factors import chi2_of_fixes, world_from_enu

if TYPE_CHECKING:
    from vplog.data import Floats, PoseGraph, Solution
    from vplog.graph.gps_factors import Fixes

_ROUNDS = 10
"""Alignments, each weighed by what the one before leaves; jumps of fixes are down-weighted within a few."""


def keep_odometry_if_further(graph: PoseGraph, solution: Solution, fixes: Fixes) -> Solution:
    """The solution, or the odometry poses where these are nearer to the fixes, by the median, once both are aligned."""
    loops = is_loop(graph)
    if not (solution.weight[loops] > 0.5).any():
        return solution
    alone, solved = median_sigma(odometry_chain(graph)[0], fixes), median_sigma(solution.world_from_body, fixes)
    if solved <= alone:
        return solution
    return odometry_kept(
        graph,
        solution,
        f"with {int((solution.weight[loops] > 0.5).sum())} closures the GPS fixes are {solved:.2g} sigma off by the "
        f"median, and {alone:.2g} without, so some are false.",
    )


def median_sigma(poses: Floats, fixes: Fixes) -> float:
    """Median distance in sigma of the fixes to poses (N, 4, 4), aligned to most of them."""
    weight = np.ones(len(fixes))
    chi2 = weight
    for _ in range(_ROUNDS):
        chi2 = chi2_of_fixes(poses, fixes, world_from_enu(poses, fixes, weight))
        weight = 1.0 / (1.0 + chi2 / max(float(np.median(chi2)), 1e-12))  # Cauchy's, of the scale that most have
    return float(np.sqrt(np.median(chi2)))
