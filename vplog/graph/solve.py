"""The optimisers to choose from. To add one: a module with its settings, one name here."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Annotated, NamedTuple

import numpy as np
from pydantic import Field

from vplog.data import Floats, Ints, PoseGraph, Solution
from vplog.graph.build import checked
from vplog.graph.consistency import is_loop
from vplog.graph.evidence import Accidents, agreeing, runs
from vplog.graph.factors import Factors
from vplog.graph.gnc import GncSettings
from vplog.graph.hypotheses import best_hypothesis, bounded
from vplog.graph.lm import LmSettings, half_chi2, solve_weighted
from vplog.graph.pcm import PcmSettings
from vplog.graph.robust_kernels import CauchySettings, DcsSettings, GemanMcClureSettings
from vplog.graph.variance_components import Sigmas, claimed_times
from vplog.stages import Optimiser

if TYPE_CHECKING:
    from vplog.graph.hypotheses import Cost

_SHARE, _PLACES = 1 / 3, 3
"""Share of the closures, and their runs, that agree on a displacement before it is said to be the odometry's."""

OptimiserSettings = Annotated[
    GncSettings | PcmSettings | DcsSettings | CauchySettings | GemanMcClureSettings | LmSettings,
    Field(discriminator="kind"),
]


class Decision(NamedTuple):
    """Selection of the true closures."""

    graph: PoseGraph
    """With the sigmas that are claimed, no closure's far below those of the others."""
    solution: Solution
    sigmas: Sigmas
    """By what the claimed sigmas were multiplied."""


def decided(
    graph: PoseGraph, optimiser: Optimiser, cost: Cost | None = None, log_odds: Floats | None = None
) -> Decision:
    """Decide which closures are true, and solve the graph with them.

    With `gnc` the decision is the hypothesis of greatest evidence, less the cost of other measurements (`cost`). Every
    other optimiser decides by itself, and its solution is returned unchanged. `log_odds` (E,) are the log odds that an
    edge is false, by recognition and geometry.

    Raises GraphError if the graph cannot be solved.
    """
    graph, _ = checked(graph)
    loops = is_loop(graph)
    if not isinstance(optimiser, GncSettings) or not loops.any():
        return Decision(graph, optimiser(graph), Sigmas())
    best = best_hypothesis(graph, optimiser, cost, log_odds)
    if best.sigmas.at_bound:  # beyond it true closures are lost
        again = best_hypothesis(claimed_times(graph, best.sigmas), optimiser, cost, log_odds)
        best = replace(again, sigmas=best.sigmas.times(again.sigmas))
    graph = bounded(graph)
    count, inliers = int(loops.sum()), int(best.weight[loops].sum())
    if inliers == 0:
        why = f"Odometry was kept: the {count} closures are likelier to be all false than any of them to be true."
        before, after = (half_chi2(graph, best.weight, poses) for poses in (graph.world_from_body, best.poses))
        solution = Solution(best.poses, best.weight, before, after, 0, True, why)
        return Decision(graph, solution, Sigmas())  # nothing tells
    found = f"{inliers} of {count} closures were kept. "
    solution = solve_weighted(
        Factors.of(graph), best.weight, best.poses, optimiser.max_iterations, optimiser.tolerance, found
    )
    return Decision(graph, solution, best.sigmas)


def about_jump(decision: Decision, names: Ints) -> list[str]:
    """A warning where many rejected closures claim one displacement, as they do across a step of the odometry that is
    far beyond its noise, where a wheel slipped or frames are missing. `names` (N,) are those of the poses."""
    graph, loops = decision.graph, is_loop(decision.graph)
    rejected = np.flatnonzero(loops & (decision.solution.weight < 0.5))
    if len(rejected) <= _SHARE * loops.sum():
        return []
    largest = next(iter(agreeing(Accidents(graph), rejected)), rejected[:0])
    places = sum(1 for _ in runs(graph, largest))
    if len(largest) <= _SHARE * loops.sum() or places < _PLACES:
        return []
    ends = np.sort([graph.a[largest], graph.b[largest]], axis=0)
    first, last = int(ends[0].max()), int(ends[1].min())
    if first >= last:
        return []
    return [
        f"{len(largest)} rejected closures of {places} places agree on one displacement: they are true if the odometry "
        f"jumps between poses {names[first]} and {names[last]}. Look at it there."
    ]
