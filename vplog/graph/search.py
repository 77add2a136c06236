"""Search for the set of true closures, and the noise, of greatest posterior density with given odometry.

Proposals are graduated non-convexity over all closures, the largest families of closures that claim one displacement,
and the odometry alone. Each is improved by flips of closures, runs and families, as long as the posterior rises. A flip
is predicted from the current factorisation; a full solve confirms it.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from vplog.data import Bools, Floats, Ints, PoseGraph
from vplog.errors import GraphError
from vplog.geometry import se3
from vplog.graph.build import informed, parts, weakest_information
from vplog.graph.consistency import OdometryChain, is_loop
from vplog.graph.episodes import Episodes
from vplog.graph.factors import Factors
from vplog.graph.least_squares import Objective, descend
from vplog.graph.posterior import RESOLUTIONS, Hypothesis, Posterior
from vplog.graph.slips import Slipping
from vplog.graph.variance_components import Sigmas, claimed_times, estimate

Cost = Callable[[Factors, Floats, Floats], float]
"""By how much the log likelihood of other measurements falls with factors, weights (E,) and poses (N, 4, 4)."""
Proposal = Callable[[Factors, Bools], tuple[Floats, Floats]]
"""Weights (E,), 0 or 1, and poses (N, 4, 4) from which the search starts; the edges of the mask (E,) may be false."""

_MOST_INFORMATION = 1e4
"""Largest information of a closure as a multiple of the median one, so that none outweighs a hundred others."""
_KNOWN = 10.0
"""Information of an axis that a closure knows, as a multiple of what is known of any."""
_CLAIMS = (1.0, 10.0, 100.0)
"""Factors by which the claimed noise is multiplied in the proposals of graduated non-convexity. If claims are far too
small, it rejects all closures with the claims themselves."""
STEADY = 0.05
"""Change of a noise factor, as a share, below which it is settled."""
_LEAST_NOISE = Sigmas(0.25, 0.25, 1.0, 1.0)
"""Smallest noise factors of a decision. Neighbouring closures share landmarks, and odometry has biases: both agree with
themselves better than they are right. An estimate from that agreement would reject the closures that show the error. A
quarter of the odometry's claim is two standard deviations of the prior."""
ROUNDS = 4
"""Largest number of rounds of two estimates that depend on each other, such as poses and noise. Two are usual."""
LEAST_GROUP = 3
"""Smallest number of closures in a family that is proposed, and in a group that may show a slip."""
_FAMILIES = 2
"""Number of families that are proposed at each resolution."""


def attempted(solve: Callable[[], Hypothesis]) -> list[Hypothesis]:
    """Return the hypothesis of a solve in a list, which is empty if closures do not determine the poses."""
    try:
        return [solve()]
    except (GraphError, np.linalg.LinAlgError):
        return []


def bounded(graph: PoseGraph) -> PoseGraph:
    """Return the graph with the information of each closure at most `_MOST_INFORMATION` times the median one.

    The median of an axis is taken over the closures that know it.
    """
    loops = np.flatnonzero(~graph.odometry)
    if not len(loops):
        return graph
    axes = np.diagonal(informed(graph, loops), axis1=1, axis2=2)
    unknown = axes <= _KNOWN * np.diagonal(weakest_information(graph))  # such as height if closures are planar
    median = np.ma.median(np.ma.masked_array(axes, unknown), axis=0).filled(np.inf)
    excess = (axes / (median * _MOST_INFORMATION)).max(1)
    information = graph.information.copy()
    information[loops] /= np.maximum(excess, 1.0)[:, None, None]
    return replace(graph, information=information)


@dataclass(frozen=True, eq=False)
class Search:
    """The search in one graph with its claimed noise and one state of each step of the odometry."""

    claimed: Factors
    propose: Proposal
    log_odds: Floats | None
    slipping: Slipping

    def at(self, sigmas: Sigmas) -> Posterior:
        return Posterior.of(self.claimed, sigmas, self.log_odds, self.slipping)

    def with_slips(self, slipping: Slipping) -> Search:
        """Return the same search with other states of the odometry's steps."""
        return replace(self, slipping=slipping)

    def improved_from(self, start: Hypothesis) -> list[Hypothesis]:
        """Return the likeliest hypothesis that a set of true closures and graduated non-convexity lead to; none if
        neither determines the poses."""
        found = attempted(lambda: self.refit(start.weight, start.poses, start.sigmas))
        found += attempted(lambda: self.refit(*self.annealed(Sigmas()), Sigmas()))
        return sorted((self.improved(one) for one in found), key=log_density)[-1:]

    def annealed(self, sigmas: Sigmas) -> tuple[Floats, Floats]:
        """Weights (E,) and poses (N, 4, 4) that are proposed for the closures with this noise."""
        return self.propose(self.at(sigmas).factors, is_loop(self.claimed.graph))

    def hypotheses(self) -> list[Hypothesis]:
        """Return likely hypotheses. In the first, no closure is true, with the likeliest noise of those found."""
        posterior = self.at(Sigmas())
        loops, chain = is_loop(self.claimed.graph), OdometryChain.of(posterior.factors.graph)
        nothing, found = np.where(loops, 0.0, 1.0), list[Hypothesis]()
        for factor in _CLAIMS:
            noise = Sigmas(*[factor] * 4)
            annealed = attempted(lambda noise=noise: self.refit(*self.annealed(noise), noise))
            found += [self.improved(one) for one in annealed]
            if annealed and annealed[0].weight.all():
                break
        agree = bool(found) and max(found, key=log_density).weight.all()
        resolutions = RESOLUTIONS[:1] if agree else RESOLUTIONS  # if all agree, it is clear that not all are false
        none = posterior.hypothesis(nothing, chain.poses, resolutions)
        best, starts = max([none, *found], key=log_density), [none]
        for weight in self._families(best, loops):
            starts += attempted(lambda weight=weight: self.refit(weight, chain.poses, Sigmas()))
        if best.weight.all():  # it agrees as a whole, so no set that is less likely leads to a better one
            starts = [one for one in starts if one.log_density > best.log_density]
        found += [self.improved(one) for one in starts]
        others = dict.fromkeys(one.sigmas for one in found)  # nothing else tells the noise if no closure is true
        none_at = [self.at(sigmas).hypothesis(nothing, chain.poses, resolutions) for sigmas in others]
        return [max([none, *none_at], key=log_density), *found]

    def _families(self, best: Hypothesis, loops: Bools) -> Iterator[Floats]:
        """Weights (E,) of the largest families that may be true in place of the best set: those with a closure that it
        rejects, and those that are a quarter of it or more."""
        proposed = {best.weight.tobytes()}
        for share in RESOLUTIONS:
            rotation, translation, *of_closures = best.sigmas
            episodes = self.at(Sigmas(share * rotation, share * translation, *of_closures)).episodes
            size = np.bincount(episodes.families)
            for largest in np.argsort(-size, kind="stable")[:_FAMILIES].tolist():
                weight = np.where(loops, 0.0, 1.0)
                weight[episodes.edges[episodes.families == largest]] = 1.0
                may_be = (weight > best.weight).any() or 4 * size[largest] >= best.weight[loops].sum()
                if size[largest] >= LEAST_GROUP and may_be and weight.tobytes() not in proposed:
                    proposed.add(weight.tobytes())
                    yield weight

    def refit(self, weight: Floats, poses: Floats, sigmas: Sigmas) -> Hypothesis:
        """Solve the edges of weight (E,) 1 and estimate the noise, in turns."""
        for _ in range(ROUNDS):
            slipping = self.slipping.applied(self.claimed.graph, sigmas)
            factors = replace(self.claimed, graph=claimed_times(slipping, sigmas))
            poses = descend(factors, weight, poses).world_from_body
            before, sigmas = sigmas, estimate(Objective(factors, weight), poses, sigmas)
            sigmas = Sigmas(*np.maximum(sigmas, _LEAST_NOISE).tolist())
            if not sigmas.differ(before, STEADY):
                break
        return self.at(sigmas).hypothesis(weight, poses)

    def improved(self, best: Hypothesis) -> Hypothesis:
        """Flip closures, runs and families as long as the posterior rises; estimate the noise after each flip."""
        posterior = self.at(best.sigmas)
        while flipped := self._flipped(posterior, best):
            best = flipped[0]
            if best.weight[is_loop(self.claimed.graph)].any():
                for again in attempted(lambda best=best: self.refit(best.weight, best.poses, best.sigmas)):
                    if again.log_density > best.log_density:
                        best, posterior = again, self.at(again.sigmas)
        return best

    def _flipped(self, posterior: Posterior, best: Hypothesis) -> list[Hypothesis]:
        """A likelier hypothesis after one flip; none if no flip that is tried makes it likelier.

        First groups that join pieces are tried, then all promising flips together, then each of them.
        What a flip of a group gains is foreseen from its median closure, because the others of a group follow from one
        of them, true or false.
        """
        episodes = posterior.episodes
        is_false = best.weight[episodes.edges] == 0
        try:
            log_predictive = posterior.log_predictive(best)
        except (GraphError, np.linalg.LinAlgError):
            return []
        tried = _joining(posterior, best)
        promising: list[tuple[float, Ints]] = []
        for group in groups(episodes, is_false):
            share = float(episodes.false_share[group].mean())
            gain = float(np.median(log_predictive[group])) + episodes.log_volume + math.log((1.0 - share) / share)
            promising.append((gain if is_false[group[0]] else -gain, group))
        promising.sort(key=lambda one: -one[0])
        together = [group for gain, group in promising if gain > 0]
        tried += [(np.unique(np.concatenate(together)), best.poses)] if len(together) > 1 else []
        tried += [(group, best.poses) for gain, group in promising if gain > 0]
        for group, poses in tried:
            weight = np.array(best.weight)
            weight[episodes.edges[group]] = 1.0 - weight[episodes.edges[group]]
            for one in attempted(
                lambda weight=weight, poses=poses: posterior.hypothesis(weight, poses, [best.resolution])
            ):
                if one.log_density > best.log_density:
                    return [one]
        return []


def log_density(one: Hypothesis) -> float:
    """Key by which hypotheses are compared."""
    return one.log_density


def _joining(posterior: Posterior, one: Hypothesis) -> list[tuple[Ints, Floats]]:
    """Groups of false closures between pieces that no true closure joins, the largest first, and poses (N, 4, 4) with
    these pieces joined. Nothing predicts such closures."""
    graph, episodes, on = posterior.factors.graph, posterior.episodes, one.weight > 0
    part = parts(len(one.poses), graph.a[on], graph.b[on])
    result = list[tuple[Ints, Floats]]()
    for group in groups(episodes, one.weight[episodes.edges] == 0):
        edges = episodes.edges[group]
        if (part[graph.a[edges]] != part[graph.b[edges]]).all():
            a, b, between = int(graph.a[edges[0]]), int(graph.b[edges[0]]), graph.a_from_b[edges[0]]
            if part[b] == part[0]:  # pose 0 stays
                a, b, between = b, a, se3.inverse(between)
            poses = np.array(one.poses)
            poses[part == part[b]] = poses[a] @ between @ se3.inverse(poses[b]) @ poses[part == part[b]]
            result.append((group, poses))
    return sorted(result, key=lambda joined: -len(joined[0]))


def groups(episodes: Episodes, is_false: Bools) -> list[Ints]:
    """Closures that are flipped together: each alone, runs of one state and family, and families."""
    family = episodes.family(is_false)
    run = _run_labels(episodes, family)
    everything, false, true = np.arange(len(family)), np.flatnonzero(is_false), np.flatnonzero(~is_false)
    found: dict[bytes, Ints] = {}
    alike = episodes.families
    for label, members in ((everything, everything), (run, everything), (family, false), (alike, true), (alike, false)):
        order = members[np.argsort(label[members], kind="stable")]
        for group in np.split(order, np.flatnonzero(np.diff(label[order])) + 1):
            if len(group):
                found[group.tobytes()] = group
    return list(found.values())


def _run_labels(episodes: Episodes, family: Ints) -> Ints:
    """Number of the run of neighbouring closures of one state and family that each closure is of, (K,)."""
    run = np.arange(len(family))
    for k, nearest in enumerate(episodes.nearest.tolist()):
        if nearest >= 0 and family[nearest] == family[k] and episodes.continues[k] >= math.exp(-1.0):
            run[k] = run[nearest]
    return run


def true_runs(episodes: Episodes, is_false: Bools) -> list[Ints]:
    """Return each run of neighbouring true closures, as indices (n,) of the closures of the episodes."""
    run = np.where(is_false, -1, _run_labels(episodes, episodes.family(is_false)))
    return [np.flatnonzero(run == one) for one in np.unique(run[run >= 0]).tolist()]


def false_runs(episodes: Episodes, is_false: Bools) -> list[Ints]:
    """Return each run of neighbouring false closures of any family, as indices (n,) of those of the episodes."""
    run = np.where(is_false, _run_labels(episodes, np.where(is_false, 0, -1)), -1)
    return [np.flatnonzero(run == one) for one in np.unique(run[run >= 0]).tolist()]
