"""Which closures are true, and how large the noise is: sets of closures with the sigmas that they imply, compared.

Robust solvers decide by the noise that a log claims, which is often wrong by a factor; and where false closures agree
with each other, the largest agreeing set may be theirs. So several solves start from different sigmas, each estimates
its own, and the evidence of all closures (`evidence`) chooses among them and the odometry alone.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vplog.errors import GraphError
from vplog.graph.build import informed
from vplog.graph.consistency import OdometryChain, is_loop
from vplog.graph.evidence import log_evidence
from vplog.graph.factors import Factors
from vplog.graph.gnc import GncSettings
from vplog.graph.least_squares import Objective, descend
from vplog.graph.odometry_mixture import modes
from vplog.graph.robust_kernels import DcsSettings
from vplog.graph.variance_components import Sigmas, estimate

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.data import Bools, Floats, PoseGraph
    from vplog.stages import Optimiser

_MOST_INFORMATION = 1e4
"""A closure's information as a multiple of the median one's, so that none outweighs a hundred others."""
_ROUNDS = 4
"""Most rounds of estimating the sigmas and testing the closures again; 2 are usual."""
_STEADY = 0.2
"""Change of a sigma below which closures need not be tested again."""
_ALIKE = 0.01
"""Share of the closures by which a start must differ from what was found to be tried."""
_VERY_STRONG = 5.0
"""Log of the odds by which closures must be likelier true than all false to be used, as a false one does more harm than
a true one good: Kass and Raftery, Bayes Factors, 1995, call it very strong. What another method that was chosen makes
of them is used where the odds are even."""
_STEPS, _TOLERANCE = 100, 1e-6


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A set of true closures."""

    weight: Floats
    """(E,) 1 for odometry and true closures, 0 for false ones."""
    poses: Floats
    """(N, 4, 4)."""
    sigmas: Sigmas
    log_evidence: float


def best_hypothesis(
    graph: PoseGraph, optimiser: Optimiser, cost: Callable[[Factors, Floats, Floats], float] | None = None
) -> Hypothesis:
    """The hypothesis of greatest evidence: the optimiser's, with `gnc` from several starts, or that none is true.

    `cost` is what other measurements cost more with factors, weights and poses: by how much their log likelihood falls.
    Raises GraphError where the graph cannot be solved.
    """
    graph, loops = bounded(graph), np.flatnonzero(is_loop(graph))
    none = np.where(is_loop(graph), 0.0, 1.0)
    chain = OdometryChain.of(graph)
    found: list[Hypothesis] = []
    if isinstance(optimiser, GncSettings):
        sets = [np.ones(len(loops), bool)]
        soft = DcsSettings()(graph).weight[loops] > 0.5  # which starts from all of them, and throws none out
        for sigmas, likely in [(Sigmas(), sets[0]), *modes(graph, loops, chain), (Sigmas(), soft)]:
            if found and min(float((likely != one).mean()) for one in sets) <= _ALIKE:
                continue
            try:
                found += _from_start(graph, optimiser, sigmas, likely)
            except (GraphError, np.linalg.LinAlgError):  # a start that leaves poses open
                continue
            sets = [one.weight[loops] > 0 for one in found]
    else:
        solution = optimiser(graph)
        kept = np.where(solution.weight > 0.5, 1.0, 0.0)
        found.append(_judged(graph, kept, *_estimated(graph, kept, solution.world_from_body, Sigmas())))
    for sigmas in dict.fromkeys([Sigmas(), *(one.sigmas for one in found)]):
        alone = _judged(graph, none, chain.poses, sigmas)
        margin = _VERY_STRONG if isinstance(optimiser, GncSettings) else 0.0
        found.append(replace(alone, log_evidence=alone.log_evidence + margin))
    if cost is None:
        return max(found, key=lambda one: one.log_evidence)
    best, most = found[-1], -np.inf
    for one in sorted(found, key=lambda one: -one.log_evidence):
        if one.log_evidence <= most:  # its measurements can only lower it
            break
        left = one.log_evidence - cost(Factors.of(claimed_times(graph, one.sigmas)), one.weight, one.poses)
        best, most = (one, left) if left > most else (best, most)
    return best


def bounded(graph: PoseGraph) -> PoseGraph:
    """The graph with the information of each closure at most `_MOST_INFORMATION` times the median one's."""
    loops = np.flatnonzero(is_loop(graph))
    if not len(loops):
        return graph
    axes = np.diagonal(informed(graph)[loops], axis1=1, axis2=2)
    excess = (axes / (np.median(axes, axis=0) * _MOST_INFORMATION)).max(1)
    information = graph.information.copy()
    information[loops] /= np.maximum(excess, 1.0)[:, None, None]
    return replace(graph, information=information)


def claimed_times(graph: PoseGraph, sigmas: Sigmas) -> PoseGraph:
    """The graph with its sigmas multiplied."""
    factor = np.where(is_loop(graph), sigmas.closures, sigmas.odometry)
    return replace(graph, information=graph.information / factor[:, None, None] ** 2)


def _from_start(graph: PoseGraph, gnc: GncSettings, sigmas: Sigmas, likely: Bools) -> list[Hypothesis]:
    """Graduated non-convexity over the `likely` closures (K,), then estimates of the sigmas and tests by them.

    The last test lets pass what chance would hardly bring so near, and a stricter one what the noise explains; they are
    two hypotheses where they differ.
    """
    weight, poses = gnc.annealed(Factors.of(claimed_times(graph, sigmas)), likely)
    found: list[Hypothesis] = []
    for strict in (False, True):
        for _ in range(_ROUNDS):
            weight, poses = gnc.tested(Factors.of(claimed_times(graph, sigmas)), weight, poses, strict)
            before = sigmas
            poses, sigmas = _estimated(graph, weight, poses, sigmas)
            if not sigmas.differ(before, _STEADY):
                break
        if not found or (weight != found[0].weight).any():
            found.append(_judged(graph, weight, poses, sigmas))
    return found


def _estimated(graph: PoseGraph, weight: Floats, poses: Floats, sigmas: Sigmas) -> tuple[Floats, Sigmas]:
    """Least squares of the weighted edges and the sigmas that they imply, in turns."""
    for _ in range(_ROUNDS):
        factors = Factors.of(claimed_times(graph, sigmas))
        poses = descend(factors, weight, poses, _STEPS, _TOLERANCE).world_from_body
        before, sigmas = sigmas, estimate(Objective(factors, weight), poses, sigmas)
        if not sigmas.differ(before, _STEADY / 4.0):
            break
    return poses, sigmas


def _judged(graph: PoseGraph, weight: Floats, poses: Floats, sigmas: Sigmas) -> Hypothesis:
    factors = Factors.of(claimed_times(graph, sigmas))
    if (weight[is_loop(graph)] > 0).any():
        poses = descend(factors, weight, poses, _STEPS, _TOLERANCE).world_from_body
    found = log_evidence(factors, weight, poses, OdometryChain.of(factors.graph)) + sigmas.log_prior()
    return Hypothesis(weight, poses, sigmas, found)
