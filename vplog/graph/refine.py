"""The odometry's noise and scale, estimated after the robust solve from the inlier closures and GPS fixes."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np
from pydantic import Field

from vplog.errors import GraphError
from vplog.graph.consistency import chi2_quantile, degrees_of_freedom, is_loop, redundancy, residual_sigma
from vplog.graph.factors import Factors
from vplog.graph.gps_factors import Fixes, chi2_of_fixes, inlier_fixes, with_fixes, world_from_enu
from vplog.graph.least_squares import Objective, minimised
from vplog.settings import Settings

if TYPE_CHECKING:
    from vplog.data import Bools, Floats, PoseGraph, Solution
    from vplog.graph.gps_factors import GpsSettings

_STEP = 1e-4
"""Step of the scale for differences: far above rounding, far below what any drive determines."""
_STEPS = 20
"""Most steps of least squares: each starts from the last round's best poses."""
_LONGEST = 0.05
"""Largest change of the scale in one round."""


class RefineSettings(Settings):
    """What is learned of the odometry from the constraints that were kept."""

    noise: bool = True
    """Estimate by what factor the odometry's covariance is too large or too small."""
    scale: bool = True
    """Estimate by what factor the odometry's metres are too short."""
    scale_sigma: float = Field(default=0.02, gt=0)
    """How far the scale is expected from 1: wheel and visual odometry lose 1-2 % of the way."""
    least_redundancy: float = Field(default=30.0, gt=0)
    """Degrees of freedom with which the constraints must check the odometry before its noise is judged by them: an
    estimate from 30 is good to a quarter."""
    most_change: float = Field(default=1e6, ge=1)
    """The covariance is changed by no more than this factor: a thousandfold sigma."""
    max_rounds: int = Field(default=12, ge=1)
    """Rounds after which it gives up; drives take 3-6."""


@dataclass(frozen=True, eq=False)
class Refined:
    """A solution with what it says of the sensors."""

    graph: PoseGraph
    """The graph as solved: metres of the odometry multiplied by `scale`, its covariance by `noise`."""
    solution: Solution
    noise: float
    """Factor of the odometry's covariance, 1 where it was not judged."""
    scale: float
    """Factor of the odometry's metres, 1 where it was not judged."""
    inlier: Floats
    """(F,) 1 for the GPS fixes that were kept, 0 for the others; empty without GPS."""
    world_from_enu: Floats | None
    """(4, 4) from the plane of the first fix, None without GPS."""


def refine(
    graph: PoseGraph,
    solution: Solution,
    of_odometry: Bools,
    settings: RefineSettings,
    fixes: Fixes | None = None,
    gps: GpsSettings | None = None,
) -> Refined:
    """Solve again with what the constraints kept say of the odometry, and with GPS where there is any.

    `of_odometry` (E,) marks edges whose metres are the odometry's: its own, and closures whose scale is taken from it.
    The weights of edges stay as they are. Raises GraphError where too few fixes agree.
    """
    weight, poses, inlier = solution.weight, solution.world_from_body, np.zeros(0)
    loops = is_loop(graph)
    checked = bool((weight[loops] > 0).any())
    if fixes is not None and gps is not None:
        poses, inlier = inlier_fixes(Factors.of(graph), weight, poses, fixes, gps)
        checked = True
    if not checked or not (settings.noise or settings.scale):
        return _refined(graph, solution, poses, 1.0, 1.0, fixes, inlier)

    noise, scale, present, before = 1.0, 1.0, graph, (1.0, 1.0)
    for _ in range(settings.max_rounds):
        present = rescaled(graph, of_odometry, ~loops, noise, scale)
        objective = _objective(present, weight, poses, fixes, inlier)
        poses = minimised(objective, poses, _STEPS, 1e-6).world_from_body
        before = noise, scale
        if settings.noise:
            noise *= _variance_factor(objective, poses, ~loops, settings.least_redundancy)
            noise = float(np.clip(noise, 1.0 / settings.most_change, settings.most_change))
        if settings.scale:
            scale += _scale_step(graph, weight, of_odometry, ~loops, noise, scale, poses, fixes, inlier, settings)
        if abs(np.log(noise / before[0])) < 0.05 and abs(scale - before[1]) < _STEP:
            break
    return _refined(present, solution, poses, before[0], before[1], fixes, inlier)


def rescaled(graph: PoseGraph, of_odometry: Bools, odometry: Bools, noise: float, scale: float) -> PoseGraph:
    """The graph with metres of some edges (E,) multiplied by `scale`, and the covariance of odometry by `noise`.

    What is multiplied has its noise multiplied too. With the noise left alone every constraint would be met best by a
    world of no size, and the estimate would be too small.
    """
    a_from_b, information = graph.a_from_b.copy(), graph.information.copy()
    a_from_b[of_odometry, :3, 3] *= scale
    information[of_odometry, 3:] /= scale
    information[of_odometry, :, 3:] /= scale
    information[odometry] /= noise
    return replace(graph, a_from_b=a_from_b, information=information)


def _objective(graph: PoseGraph, weight: Floats, poses: Floats, fixes: Fixes | None, inlier: Floats) -> Objective:
    """The weighted edges (E,) of the graph, and the fixes (F,) in the world of the poses where there are any."""
    factors = Factors.of(graph)
    return Objective(factors, weight) if fixes is None else with_fixes(factors, weight, poses, fixes, inlier)


def _variance_factor(objective: Objective, poses: Floats, odometry: Bools, least_redundancy: float) -> float:
    """By what factor the odometry's covariance is too small: its chi-square over its share of the redundancy.

    Variance components: Foerstner, Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten, 1979.
    """
    graph, edges = objective.factors.graph, np.flatnonzero(odometry)
    try:
        checks = redundancy(objective, poses, edges)
    except GraphError:
        # noise so large that rounding decides: all that the constraints could check, so that the next round has less
        checks = float(degrees_of_freedom(graph) * min(np.count_nonzero(objective.weight[~odometry]), len(edges)))
    if checks < least_redundancy:
        return 1.0
    chi2 = float((residual_sigma(graph, poses)[edges] ** 2).sum())
    return max(chi2, 1e-9) / checks


def _scale_step(
    graph: PoseGraph,
    weight: Floats,
    of_odometry: Bools,
    odometry: Bools,
    noise: float,
    scale: float,
    poses: Floats,
    fixes: Fixes | None,
    inlier: Floats,
    settings: RefineSettings,
) -> float:
    """A secant step towards the scale of least error, poses following it: by the slope here and a step aside.

    At the best poses for a scale the error does not change with the poses, so its slope is that with the poses fixed.
    """

    def gradient(at: float, start: Floats) -> float:
        present = rescaled(graph, of_odometry, odometry, noise, at)
        best = minimised(_objective(present, weight, start, fixes, inlier), start, _STEPS, 1e-8).world_from_body
        errors = [
            float((weight * residual_sigma(rescaled(graph, of_odometry, odometry, noise, at + side), best) ** 2).sum())
            for side in (-_STEP, _STEP)
        ]
        return (errors[1] - errors[0]) / (4.0 * _STEP) + (at - 1.0) / settings.scale_sigma**2

    aside = settings.scale_sigma / 4.0
    here, there = gradient(scale, poses), gradient(scale + aside, poses)
    curve = (there - here) / aside
    if curve <= 0.0:  # nothing to find: the prior alone would curve it upwards
        return 0.0
    return float(np.clip(-here / curve, -_LONGEST, _LONGEST))


def _refined(
    graph: PoseGraph,
    solution: Solution,
    poses: Floats,
    noise: float,
    scale: float,
    fixes: Fixes | None,
    inlier: Floats,
) -> Refined:
    """The refined solution, its reason saying what was learned."""
    world, sentences = None, []
    if noise != 1.0:
        sentences.append(
            f"The odometry's noise is {np.sqrt(noise):.2g} times what was assumed, by the constraints kept."
        )
    if scale != 1.0:
        sentences.append(f"Its metres are {abs(1.0 / scale - 1.0):.2%} too {'long' if scale < 1.0 else 'short'}.")
    if fixes is not None:
        world = world_from_enu(poses, fixes, np.maximum(inlier, 1e-9))
        chi2 = chi2_of_fixes(poses, fixes, world)[inlier > 0]
        beyond = int((chi2 > chi2_quantile(0.99, 3)).sum())
        sentences.append(
            f"{int(inlier.sum())} of {len(fixes)} GPS fixes were used, {beyond} of them beyond 99 % of their noise."
        )
    error = float(0.5 * (solution.weight * residual_sigma(graph, poses) ** 2).sum())
    refined = replace(
        solution, world_from_body=poses, error_after=error, reason=" ".join([solution.reason.strip(), *sentences])
    )
    return Refined(graph, refined, noise, scale, inlier, world)
