"""Questions to a person: closures whose verdict is doubtful, and would move the map if it were turned.

Ranked by expected model change (Settles, Active Learning Literature Survey, 2009, 3.3): the probability that the
verdict is wrong, times how far the map moves then. The probability is that of the back end's own evidence, raised to a
power as where a model leaves things out (Miller and Dunson, Robust Bayesian inference via coarsening, JASA 2019).
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from vplog.data import Bools, Floats, Ints, PoseGraph
from vplog.geometry import se3
from vplog.graph.consistency import residual_sigma, runs
from vplog.graph.episodes import Episodes
from vplog.graph.factors import Factors
from vplog.graph.posterior import Posterior
from vplog.graph.search import attempted
from vplog.graph.variance_components import Sigmas

_MOST = 16
"""Runs of closures that are turned, of either verdict by either order: each costs a solve from the map as it is."""
_FAMILIES = 8
"""Largest families of runs that are turned as a whole."""
_LEAST, _POSES = 4, 40_000
"""Fewer are turned, but so many at least, where the graph has so many poses that each takes long."""
_POWER = 0.1
"""Power of the evidence: the closures of a run, some ten, see the same things and err together."""
_LEAST_P_FALSE = 0.005
"""Least probability that what is in the solution is false, whatever the evidence says: false closures that agree with
each other make it. The share of false ones kept that the back end is held to on random worlds."""


@dataclass(frozen=True, eq=False)
class Question:
    """A run of neighbouring closures that agree with each other: one answer is for all of them."""

    edges: Ints
    """(K,)."""
    p_wrong: float
    """Probability that their verdict is wrong."""
    moved_m: float
    """Root mean square distance, after alignment, of the poses from where they are with the verdict turned."""

    @property
    def expected_m(self) -> float:
        return self.p_wrong * self.moved_m


def questions(graph: PoseGraph, weight: Floats, log_odds: Floats, decided: Bools) -> list[Question]:
    """Questions about the closures of a solved graph, those first that are expected to move it most.

    `graph` is at the least squares of its edges of weight (E,) 1; closures of weight 0 are left out of it. `log_odds`
    (E,) are of being false by what else is known of a closure, 0 where nothing is; on those `decided` (E,) nothing is
    asked. Raises GraphError where the poses are not determined.
    """
    posterior = Posterior.of(Factors.of(graph), Sigmas())
    now = posterior.hypothesis(weight, graph.world_from_body)
    best: dict[int, Question] = {}
    for closures, turned in _sets(graph, posterior.episodes, weight, decided):
        other = np.array(weight)
        other[turned] = 1.0 - weight[turned]
        start = now.poses if other[~graph.odometry].any() else posterior.episodes.claims.chain.poses
        for then in attempted(lambda other=other, start=start: posterior.hypothesis(other, start)):
            used = weight[turned[0]] > 0
            odds = _POWER * (then.log_density - now.log_density)
            odds += float(log_odds[turned].mean()) * (1.0 if used else -1.0)
            p_wrong = max(1.0 / (1.0 + math.exp(min(-odds, 700.0))), _LEAST_P_FALSE if used else 0.0)
            one = Question(closures, p_wrong, _moved_m(now.poses, then.poses))
            first = int(closures[0])
            best[first] = max(best.get(first, one), one, key=lambda one: one.expected_m)
    return sorted(best.values(), key=lambda one: (-one.expected_m, int(one.edges[0])))


def _sets(graph: PoseGraph, episodes: Episodes, weight: Floats, decided: Bools) -> Iterator[tuple[Ints, Ints]]:
    """Closures to ask about, and those that are turned with them.

    Each run by itself; and where runs that claim one displacement have no decision among them, all by the longest one:
    a person who knows of one of them knows of them all.
    """
    misfit = residual_sigma(graph, graph.world_from_body)
    most = min(_MOST, max(_LEAST, _POSES // len(graph.world_from_body)))
    families = [episodes.edges[episodes.families == number] for number in range(episodes.families.max(initial=-1) + 1)]
    families.sort(key=len, reverse=True)
    known: list[Ints] = []
    for used in (True, False):
        some = [run[(weight[run] > 0) == used] for family in families for run in runs(graph, family)]
        some = [run for one in some if len(run := one[~decided[one]])]
        # as the search flips them: the used ones that fit worst, the others that fit best; and what stands alone
        doubtful = np.argsort([float(misfit[run].mean()) * (-1.0 if used else 1.0) for run in some], kind="stable")
        alone = np.argsort(-_apart(graph, some), kind="stable")
        chosen = dict.fromkeys([*doubtful[:most].tolist(), *alone[:most].tolist()])
        yield from ((some[at], some[at]) for at in chosen)
        known += some
    for family in families[:_FAMILIES]:
        if decided[family].any():
            continue
        used = (weight[family] > 0).any()
        members = [run for run in known if (weight[run[0]] > 0) == used and np.isin(run[0], family)]
        if len(members) > 1:
            yield max(members, key=len), np.concatenate(members)


def _apart(graph: PoseGraph, runs: list[Ints]) -> Floats:
    """Poses (R,) between the ends of each run and those of the nearest other one."""
    middle = np.array([run[len(run) // 2] for run in runs], np.int64)
    ends = np.sort(np.stack([graph.a[middle], graph.b[middle]], axis=1).astype(np.float64), axis=1)
    apart = [np.sort(np.abs(ends - one).sum(1))[1:2].sum() for one in ends]
    return np.array(apart, np.float64)


def _moved_m(now: Floats, then: Floats) -> float:
    here, there = now[:, :3, 3], then[:, :3, 3]
    return float(np.sqrt(((se3.transform(se3.umeyama(there, here)[0], there) - here) ** 2).sum(1).mean()))
