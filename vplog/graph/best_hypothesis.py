"""The likeliest true closures and slipping steps of a graph.

Closures that the odometry contradicts are false, or the odometry slips. `Search` finds the likeliest closures for given
states of the odometry. Here closures and states are found together: a set of true closures grows, group by group, and
each group must gain more than the slips that it implies cost.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from vplog.data import Floats, Ints, PoseGraph
from vplog.graph.consistency import OdometryChain, is_loop
from vplog.graph.factors import Factors
from vplog.graph.posterior import Hypothesis
from vplog.graph.search import (
    LEAST_GROUP,
    ROUNDS,
    STEADY,
    Cost,
    Proposal,
    Search,
    attempted,
    bounded,
    false_runs,
    groups,
    log_density,
    true_runs,
)
from vplog.graph.slips import Slipping, Slips
from vplog.graph.variance_components import Sigmas


def best_hypothesis(
    graph: PoseGraph, propose: Proposal, cost: Cost | None = None, log_odds: Floats | None = None
) -> Hypothesis:
    """Return the hypothesis of greatest posterior density, less the cost of other measurements.

    `log_odds` (E,) are the log odds that an edge is false by recognition; None or all 0 if these are unknown. Raises
    GraphError if the graph cannot be solved.
    """
    claimed, loops = Factors.of(bounded(graph)), is_loop(graph)
    search = Search(claimed, propose, log_odds, Slipping.nowhere(graph))
    found = search.hypotheses()
    found += _WithSlips(search, Slips(claimed.graph)).hypotheses(found)

    def less_cost(one: Hypothesis) -> float:
        if cost is None:
            return one.log_density
        factors = search.with_slips(one.slipping).at(one.sigmas).factors
        return one.log_density - cost(factors, one.weight, one.poses)

    likeliest = max(found, key=less_cost)
    return likeliest if likeliest.weight[loops].any() else found[0]  # nothing but true closures shows a slip


@dataclass(frozen=True, eq=False)
class _WithSlips:
    """The search for slipping steps, and the closures that are true with them."""

    sound: Search
    slips: Slips

    def hypotheses(self, found: list[Hypothesis]) -> list[Hypothesis]:
        """Return likely hypotheses with slips, and those `found` without slips with the noise of these."""
        best, result = max(found, key=log_density), list[Hypothesis]()
        for start in self._starts(best):
            grown = self._improved(self._grown(start))
            with_slips = [one for one in grown if one.slipping.state.any()]
            result += [self._pruned(one) if one.log_density > best.log_density else one for one in with_slips]
        for one in list(result):
            for weight in (found[0].weight, best.weight):
                for slipping in (self.sound.slipping, one.slipping):
                    result += self._solved(slipping, replace(one, weight=weight))
        return result

    def _starts(self, best: Hypothesis) -> list[Hypothesis]:
        """Sets of closures, with the slips that they imply, from which the search starts: those that are true without
        slips, and those that graduated non-convexity keeps if it may reject odometry as well. Empty if the first imply
        no slip and no group is rejected."""
        graph = self.sound.claimed.graph
        loops, chain = is_loop(graph), OdometryChain.of(graph)
        noise = Sigmas(max(best.sigmas.rotation, 1.0), max(best.sigmas.translation, 1.0))
        noisier = replace(best, sigmas=noise)
        slipping = self._implied(noisier)
        if slipping is not None and not slipping.state.any() and not self._rejected(best):
            return []
        kept, _ = self.sound.propose(self.sound.claimed, np.ones(len(loops), bool))
        annealed = replace(best, weight=np.where(loops, kept, 1.0), poses=chain.poses)
        implied = self._settled(slipping, noisier)
        return implied + self._with_implied(replace(annealed, sigmas=Sigmas()))

    def _rejected(self, one: Hypothesis) -> list[Ints]:
        """Groups of rejected closures that may show a slip, those that span the shortest path first."""
        episodes = self.sound.with_slips(one.slipping).at(one.sigmas).episodes
        is_false = one.weight[episodes.edges] == 0
        alike = [group for group in groups(episodes, is_false) if is_false[group[0]]]
        found = {group.tobytes(): group for group in alike + false_runs(episodes, is_false)}
        span = episodes.claims.b - episodes.claims.a
        large = [group for group in found.values() if len(group) >= LEAST_GROUP]
        return sorted(large, key=lambda group: (int(span[group].max()), -len(group)))

    def _solved(self, slipping: Slipping, one: Hypothesis) -> list[Hypothesis]:
        """The closures and the noise of a hypothesis with other states of the steps; none if that cannot be solved."""
        posterior, poses = self.sound.with_slips(slipping).at(one.sigmas), one.poses
        if not one.weight[is_loop(self.sound.claimed.graph)].any():
            poses = OdometryChain.of(posterior.factors.graph).poses
        return attempted(lambda: posterior.hypothesis(one.weight, poses))

    def _with_implied(self, one: Hypothesis, least: float = -np.inf) -> list[Hypothesis]:
        """The closures of a hypothesis with the slips and the noise that they imply; none if the log prior of the slips
        falls below `least`, as in `Slips.likeliest`."""
        return self._settled(self._implied(one, least), one, least)

    def _implied(self, one: Hypothesis, least: float = -np.inf) -> Slipping | None:
        return self.slips.likeliest(self.sound.claimed, one.weight, one.poses, one.sigmas, one.slipping, least)

    def _settled(self, slipping: Slipping | None, one: Hypothesis, least: float = -np.inf) -> list[Hypothesis]:
        """The closures of a hypothesis with these states of the steps, from which noise and states are estimated in
        turns; none if these are None or do not determine the poses."""
        found: list[Hypothesis] = []
        for _ in range(ROUNDS):
            new = [] if slipping is None else self._refit(slipping, one)
            if not new or (found and new[0].log_density <= found[0].log_density):
                break
            found, before = new, one.sigmas
            one = new[0]
            if not one.sigmas.differ(before, STEADY):
                break
            slipping = self._implied(one, least)
        return found

    def _refit(self, slipping: Slipping, one: Hypothesis) -> list[Hypothesis]:
        """The closures of a hypothesis with other states of the steps and the noise that they imply."""
        if not one.weight[is_loop(self.sound.claimed.graph)].any():
            return self._solved(slipping, one)
        search = self.sound.with_slips(slipping)
        return attempted(lambda: search.refit(one.weight, one.poses, one.sigmas))

    def _improved(self, one: Hypothesis) -> list[Hypothesis]:
        return self.sound.with_slips(one.slipping).improved_from(one)

    def _grown(self, best: Hypothesis) -> Hypothesis:
        """Add groups of closures that gain more than the slips that they imply cost, always the first of `_rejected`
        that gains."""
        best, tried = self.sound.with_slips(best.slipping).improved(best), set[bytes]()
        while True:
            posterior, before = self.sound.with_slips(best.slipping).at(best.sigmas), best
            new = [group for group in self._rejected(best) if group.tobytes() not in tried]
            for group in new:
                weight = np.array(before.weight)
                weight[posterior.episodes.edges[group]] = 1.0
                least = before.slipping.log_prior - posterior.most_gain(before, group)
                found = self._with_implied(replace(before, weight=weight), least)
                if found and found[0].log_density > before.log_density:
                    best = found[0]
                    break
                tried.add(group.tobytes())
            if best is before:
                break
            best = self.sound.with_slips(best.slipping).improved(best)
        return best

    def _pruned(self, best: Hypothesis) -> Hypothesis:
        """Leave out runs of closures that gain less than the slips that they imply cost."""
        for _ in range(ROUNDS):
            before = best
            episodes = self.sound.with_slips(best.slipping).at(best.sigmas).episodes
            for run in true_runs(episodes, best.weight[episodes.edges] == 0):
                weight = np.array(best.weight)
                weight[episodes.edges[run]] = 0.0
                less = replace(best, weight=weight)
                slipping = self._implied(less)
                if slipping is not None and (slipping.state != best.slipping.state).any():
                    best = max([best, *self._settled(slipping, less)], key=log_density)
            if best is before:
                break
            best = max([best, *self._improved(best)], key=log_density)
        return best
