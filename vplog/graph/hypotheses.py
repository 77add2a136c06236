"""Which closures are true, and how large the noise is: sets of closures with the sigmas that they imply, compared.

Robust solvers decide by the noise that a log claims, which is often wrong by a factor; and where false closures agree
with each other, the largest agreeing set may be theirs. So several solves start from different sigmas, each estimates
its own, and the evidence of all closures (`evidence`) chooses among them and the odometry alone.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING

import numpy as np

from vplog.errors import GraphError
from vplog.graph.build import informed, weakest_information
from vplog.graph.consistency import OdometryChain, chi2_quantile, degrees_of_freedom, is_loop, residual_sigma
from vplog.graph.evidence import (
    TAIL,
    Accidents,
    StudentT,
    Views,
    agreeing,
    log_evidence,
    log_room,
    log_tails,
    runs,
    student_t,
)
from vplog.graph.factors import Factors
from vplog.graph.gnc import GncSettings
from vplog.graph.least_squares import Objective, descend
from vplog.graph.leave_one_out import distance
from vplog.graph.odometry_mixture import modes
from vplog.graph.robust_kernels import DcsSettings
from vplog.graph.variance_components import Sigmas, claimed_times, estimate

if TYPE_CHECKING:
    from collections.abc import Callable, Sequence

    from vplog.data import Bools, Floats, Ints, PoseGraph

    Cost = Callable[[Factors, Floats, Floats], float]

_MOST_INFORMATION = 1e4
"""A closure's information as a multiple of the median one's, so that none outweighs a hundred others."""
_KNOWN = 10.0
"""Information of an axis that a closure knows, as a multiple of what is known of any."""
_ROUNDS = 4
"""Most rounds of estimating the sigmas and testing the closures again; 2 are usual."""
_STEADY = 0.2
"""Change of a sigma below which closures need not be tested again."""
_ALIKE = 0.01
"""Share of the closures by which a start must differ from what was found to be tried."""
_AS_CLAIMED = 2.0
"""Factor of a sigma up to which noise is as claimed."""
_FAMILIES = 2
"""Largest families of closures that are worth a solve: the true one and one that is taken for it."""
_SHARES = (1.0, 0.25, 0.0625)
"""Shares of the odometry's sigmas by which families are told apart."""
_VERY_STRONG = 5.0
"""Log of the odds by which closures must be likelier true than all false to be used, as a false one does more harm than
a true one good: Kass and Raftery, Bayes Factors, 1995, call it very strong."""
_STRONG = 3.0
"""Likewise, where recognition tells the closures of this drive from its pairs that are none: there, 20 to 1 is strong
evidence, and more cannot be counted from some hundred pairs."""
_MULTIPLES = (2.0 ** np.arange(-3.0, 5.0)).tolist()
"""Noise of odometry as multiples of its claim, over which its drift is integrated."""
_FLIPS, _MOST_FLIPS = 4, 10
"""Runs of either kind that are tried at once, and turns."""
_COMPARED = 4
"""Likeliest sets that are compared at the same sigmas."""
_LEAST_FAMILY = 3
"""Closures of a family that is tried as a whole; runs are smaller."""
_GROWTH = 30
"""Rounds in which a set of closures grows at most: each adds as large a share of the runs."""
_STEPS, _TOLERANCE = 100, 1e-4


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
    graph: PoseGraph, gnc: GncSettings, cost: Cost | None = None, log_odds: Floats | None = None
) -> Hypothesis:
    """Return the hypothesis of greatest evidence: a result of `gnc` from several starts, or that no closure is true.

    `cost` is what other measurements cost more with factors, weights and poses: by how much their log likelihood falls.
    `log_odds` (E,) are of being false by recognition and geometry; where they are sure, odometry alone is best only if
    it is with the noise that it claims, too.
    Raises GraphError where the graph cannot be solved.
    """
    graph, loops = bounded(graph), np.flatnonzero(is_loop(graph))
    claimed = Factors.of(graph)
    none = np.where(is_loop(graph), 0.0, 1.0)
    chain = OdometryChain.of(graph)
    found = _searched(claimed, gnc, loops, chain)
    found += _at_the_sigmas_of_others(claimed, found)
    likeliest = [one.sigmas for one in _likeliest(found)]
    for sigmas in dict.fromkeys([Sigmas(), *likeliest]):  # others would be of what false closures happen to share
        alone = hypothesis_of(claimed, none, chain.poses, sigmas)
        found.append(replace(alone, log_evidence=alone.log_evidence + _VERY_STRONG))
    best = _likeliest(found)[0] if cost is None else _least_cost(claimed, found, cost)
    if best.weight[loops].any():
        others = attempted(lambda: _readmitted(claimed, best, gnc, cost))
        others = others or attempted(lambda: _undisputed(claimed, best, found, cost))
    elif log_odds is not None:
        some = _likeliest([one for one in found if one.weight[loops].any()])
        others = attempted(lambda: [one for one in some if _recognised(claimed, one, chain, log_odds, cost)])
    else:
        others = []
    return next(iter(others), best)


def _undisputed(claimed: Factors, best: Hypothesis, found: list[Hypothesis], cost: Cost | None) -> list[Hypothesis]:
    """The hypothesis with the closures that every other that contradicts it, and is hardly less likely, has as well;
    none where nothing contradicts it, or all is disputed."""

    def likelihood(one: Hypothesis) -> float:
        costs = 0.0 if cost is None else cost(_times(claimed, one.sigmas), one.weight, one.poses)
        return one.log_evidence - costs

    enough, common = likelihood(best) - _VERY_STRONG, np.array(best.weight)
    for one in found:
        if one.log_evidence > enough and _contradict(one, best) and (common > one.weight).any():
            common = np.minimum(common, one.weight) if cost is None or likelihood(one) > enough else common
    if (common == best.weight).all() or not common[is_loop(claimed.graph)].any():
        return []
    return [_refit(claimed, common, best.poses, best.sigmas)]


def _contradict(one: Hypothesis, other: Hypothesis) -> bool:
    """Whether closures are true by the one alone, and others by the other alone."""
    return bool((one.weight > other.weight).any() and (one.weight < other.weight).any())


def _readmitted(claimed: Factors, best: Hypothesis, gnc: GncSettings, cost: Cost | None) -> list[Hypothesis]:
    """The hypothesis with the closures that it predicts within the noise that the log claims, unless that is very
    unlikely where noise has heavy tails: estimated from those that fit best, noise is too small for the others.

    By the odometry that the log claims, which may be far worse than what is estimated, false ones may be within: those
    that need more than `TAIL` times the noise that is claimed for closures themselves are left out. Closures that claim
    too much noise have false ones within it, too: by the others, those that come back must be likelier true than false
    together (their pseudo-likelihood; Besag, Statistical analysis of non-lattice data, 1975). Where all of them are too
    unlikely, the least likely ones are left out.
    """
    loops, rejected = is_loop(claimed.graph), np.flatnonzero(best.weight == 0)
    if not len(rejected):
        return []
    d = degrees_of_freedom(claimed.graph)
    quantile = chi2_quantile(gnc.inlier_probability, d)
    poses = descend(claimed, best.weight, best.poses, _STEPS, _TOLERANCE).world_from_body
    apart, _ = distance(claimed, best.weight, poses, rejected)
    within = rejected[apart <= quantile]
    if not len(within):
        return []
    weight, at = np.array(best.weight), AtSigmas.of(claimed, best.sigmas)
    most = TAIL * math.sqrt(quantile / d) / best.sigmas.of_closures
    enough = _under_student_t(at, best, cost)[0] - _VERY_STRONG
    while len(within):
        weight[within] = 1.0
        true, false = (sum(1 for _ in runs(claimed.graph, np.flatnonzero(loops & (weight == of)))) for of in (1, 0))
        likelihood, residuals = _under_student_t(at, replace(best, weight=weight), cost)
        log_odds = residuals.log_density[within] + at.accidents.room + math.log((true + 1) / (false + 1))
        unlikely = residuals.multiple[within] > most
        if not unlikely.any():
            if log_odds.sum() <= 0.0:
                break
            more = _refit(claimed, weight, best.poses, best.sigmas)
            if max(likelihood, _under_student_t(AtSigmas.of(claimed, more.sigmas), more, cost)[0]) > enough:
                return [more]
            unlikely = log_odds <= min(log_odds.min(), 0.0)
            if not unlikely.any():
                break
        weight = np.array(best.weight)
        within = within[~unlikely]
    return []


def _under_student_t(at: AtSigmas, one: Hypothesis, cost: Cost | None) -> tuple[float, StudentT]:
    """The log evidence of the hypothesis, less the cost, where the noise of closures is Student's t; and residuals.

    Each closure has the noise that is expected of it, by turns with the poses (expectation maximisation).
    """
    poses, multiple, found, graph = one.poses, np.ones(len(one.weight)), -math.inf, at.factors.graph
    of_loops = ~graph.odometry & (one.weight > 0)
    residuals = StudentT(0.0, multiple, multiple)
    for _ in range(_ROUNDS):
        information = graph.information / multiple[:, None, None] ** 2
        factors = replace(at.factors, graph=replace(graph, information=information))
        normal = replace(at, factors=factors).hypothesis(one.weight, poses)
        residuals = student_t(factors, one.weight, normal.poses, multiple)
        poses, multiple = normal.poses, residuals.multiple
        chi2 = (residual_sigma(factors.graph, poses) ** 2)[of_loops]
        found = normal.log_evidence - log_tails(chi2, degrees_of_freedom(graph)) + residuals.log_gain
    return found - (0.0 if cost is None else cost(at.factors, one.weight, poses)), residuals


def _recognised(claimed: Factors, one: Hypothesis, chain: OdometryChain, log_odds: Floats, cost: Cost | None) -> bool:
    """Whether recognition is sure of its runs of closures, and odometry leaves them likelier true than false.

    How well closures agree with each other along a run does not tell what odometry gathers over the drive, so each run
    counts as one measurement, and odometry may drift by any multiple of its claim.
    """
    graph = claimed.graph
    accepted = np.flatnonzero(is_loop(graph) & (one.weight > 0))
    sure = -sum(float(log_odds[run].mean()) for run in runs(graph, accepted))
    if sure <= _STRONG:
        return False
    views, factors = Views.of(graph, accepted, chain.poses), Factors.of(Accidents(graph).one_a_run(accepted))
    if not is_loop(factors.graph).any():
        return False
    prior, by_odometry = [], []
    for multiple in _MULTIPLES:
        sigmas = Sigmas(multiple, multiple)
        present = _times(factors, sigmas)
        at = AtSigmas(sigmas, present, Accidents(present.graph, views))
        true = at.hypothesis(np.ones(len(present.graph.a)), one.poses)
        none = at.hypothesis(np.where(is_loop(present.graph), 0.0, 1.0), chain.poses)
        odds = true.log_evidence - none.log_evidence
        if cost is not None:
            odds -= cost(present, true.weight, true.poses) - cost(present, none.weight, none.poses)
        prior.append(sigmas.log_prior())
        by_odometry.append(prior[-1] + odds)
    return sure + float(np.logaddexp.reduce(by_odometry) - np.logaddexp.reduce(prior)) > 0.0


def _least_cost(claimed: Factors, found: list[Hypothesis], cost: Cost) -> Hypothesis:
    """The hypothesis of greatest evidence less what it costs other measurements."""
    best, most = found[-1], -np.inf
    judged: list[Hypothesis] = []
    for one in sorted(found, key=lambda one: -one.log_evidence):
        if one.log_evidence <= most:  # its measurements can only lower it
            break
        if any((one.weight == other.weight).all() and not one.sigmas.differ(other.sigmas, _STEADY) for other in judged):
            continue
        judged.append(one)
        try:
            left = one.log_evidence - cost(_times(claimed, one.sigmas), one.weight, one.poses)
        except GraphError:  # nearly singular
            continue
        best, most = (one, left) if left > most else (best, most)
    return best


def _searched(claimed: Factors, gnc: GncSettings, loops: Ints, chain: OdometryChain) -> list[Hypothesis]:
    """Hypotheses by graduated non-convexity from sets of closures that may be true, and from families of them."""
    graph = claimed.graph
    likely_modes = modes(graph, loops, chain)
    soft = DcsSettings()(graph).weight[loops] > 0.5  # which starts from all of them, and throws none out
    found: list[Hypothesis] = []
    tried: list[Bools] = []
    for sigmas, likely in [(Sigmas(), np.ones(len(loops), bool)), *likely_modes, (Sigmas(), soft)]:
        if _is_new(likely, tried):
            found += _from_start(claimed, gnc, sigmas, likely)
            tried += [one.weight[loops] > 0 for one in found[-2:]]
    best = max(found, key=lambda one: one.log_evidence, default=None)
    agreed = best if best is not None and best.weight.all() and max(best.sigmas) <= _AS_CLAIMED else None
    if agreed is not None and not agreed.sigmas.differ(Sigmas(), math.log(_AS_CLAIMED)):
        return found
    sigmas = likely_modes[0][0]
    starts = [sigmas, Sigmas()] if sigmas.differ(Sigmas(), math.log(_AS_CLAIMED)) else [sigmas]
    families = [one for sigmas in starts for one in _families(graph, loops, sigmas)]
    whole = [loops[one] for one in families if one.sum() >= _LEAST_FAMILY]
    if agreed is not None:
        found.append(_improved(claimed, agreed, whole))
        if found[-1].weight.all():  # and better than claimed, without any of them likelier to be false
            return found
    of_families = []
    for likely in families:
        if _is_new(likely, tried):
            weight = np.ones(len(graph.a))
            weight[loops] = likely
            of_families += attempted(lambda weight=weight: [_refit(claimed, weight, chain.poses, Sigmas())])
    of_families = sorted(of_families, key=lambda one: -one.log_evidence)[:_FAMILIES]
    for one in of_families:
        found += attempted(lambda one=one: _tested(claimed, gnc, one.weight, one.poses, one.sigmas))
    found += of_families
    best = _likeliest(found)
    if all((one.weight[loops] == 0).mean() <= _ALIKE for one in best):  # next to all agree
        return found + [_improved(claimed, one) for one in best]
    grown = attempted(lambda: [_grown(claimed, sigmas, chain)])
    rival = _likeliest([one for one in found if _contradict(one, best[0])])
    found += [_improved(claimed, one, whole) for one in [*best, *rival, *grown]]
    for one in _likeliest(found):
        found += attempted(lambda one=one: _tested(claimed, gnc, one.weight, one.poses, one.sigmas))
    return found


def _at_the_sigmas_of_others(claimed: Factors, found: list[Hypothesis]) -> list[Hypothesis]:
    """The likeliest sets, each with the sigmas of the others: false closures, too, tell of the noise by how well those
    of a run agree, and sets compare fairly where they share their sigmas."""
    sets: list[Hypothesis] = []
    for one in sorted(found, key=lambda one: -one.log_evidence):
        if len(sets) < _COMPARED and not any((one.weight == other.weight).all() for other in sets):
            sets.append(one)
    pairs = [(one, other.sigmas) for one in sets for other in sets if one.sigmas.differ(other.sigmas, _STEADY)]
    at = {sigmas: AtSigmas.of(claimed, sigmas) for sigmas in dict.fromkeys(sigmas for _, sigmas in pairs)}
    return [
        two for one, s in pairs for two in attempted(lambda one=one, s=s: [at[s].hypothesis(one.weight, one.poses)])
    ]


def _likeliest(found: list[Hypothesis]) -> list[Hypothesis]:
    """The one of greatest evidence, if there is any."""
    return sorted(found, key=lambda one: -one.log_evidence)[:1]


def _grown(claimed: Factors, sigmas: Sigmas, chain: OdometryChain) -> Hypothesis:
    """The closures that are accepted run by run, always those of the best odds by the graph of the ones before: what
    is near in odometry tells how far the rest has drifted. It ends where chance brings the next as near."""
    graph, factors = claimed.graph, _times(claimed, sigmas)
    weight, poses = np.where(is_loop(graph), 0.0, 1.0), chain.poses
    left = list(runs(graph, np.flatnonzero(is_loop(graph))))
    room, at_once = log_room(factors.graph, poses), -(-len(left) // _GROWTH)
    while left:
        apart, log_spread = distance(factors, weight, poses, np.concatenate(left))
        odds = room - 0.5 * (apart + degrees_of_freedom(graph) * math.log(2.0 * math.pi)) - log_spread
        ends = np.cumsum([len(run) for run in left])[:-1]
        of_run = np.array([np.median(one) for one in np.split(odds, ends)])
        surest = np.argsort(-of_run, kind="stable")[:at_once].tolist()
        best = [at for at in surest if of_run[at] > _VERY_STRONG]
        if not best:
            break
        weight[np.concatenate([left[at] for at in best])] = 1.0
        left = [run for at, run in enumerate(left) if at not in best]
        poses = descend(factors, weight, poses, _STEPS, _TOLERANCE).world_from_body
    return _refit(claimed, weight, poses, sigmas)


def _is_new(likely: Bools, tried: list[Bools]) -> bool:
    """Whether the set (K,) differs from all that were tried; it is one of them then."""
    new = bool(likely.any()) and all(float((likely != one).mean()) > _ALIKE for one in tried)
    tried += [likely] * new
    return new


def attempted(solve: Callable[[], list[Hypothesis]]) -> list[Hypothesis]:
    """The hypotheses of a solve; none where closures leave poses open."""
    try:
        return solve()
    except (GraphError, np.linalg.LinAlgError):
        return []


def _families(graph: PoseGraph, loops: Ints, sigmas: Sigmas) -> list[Bools]:
    """Sets of closures (K,) that agree with each other, whatever they make of the odometry.

    The better the odometry is taken to be, the finer it tells families apart.
    """
    found = []
    for share in _SHARES:
        tried = sigmas._replace(rotation=share * sigmas.rotation, translation=share * sigmas.translation)
        present = claimed_times(graph, tried)
        found += [np.isin(loops, edges) for edges in agreeing(Accidents(present), loops)[:_FAMILIES]]
    return found


def _improved(claimed: Factors, best: Hypothesis, families: Sequence[Ints] = ()) -> Hypothesis:
    """The hypothesis after flips of runs of closures, each the best of some, as long as they make it likelier.

    Tried are the rejected runs that fit best, the accepted ones that fit worst, and `families` rejected as a whole:
    their members support each other.
    """
    loops, at, given = is_loop(claimed.graph), AtSigmas.of(claimed, best.sigmas), best
    for _ in range(_MOST_FLIPS):
        misfit = residual_sigma(at.factors.graph, best.poses)
        flips: list[Ints] = []
        for accepted, sign in ((False, 1.0), (True, -1.0)):
            edges = np.flatnonzero(loops & ((best.weight > 0) == accepted))
            flips += sorted(runs(claimed.graph, edges), key=lambda run: sign * float(misfit[run].mean()))[:_FLIPS]
        flips += [accepted for family in families if len(accepted := family[best.weight[family] > 0])]
        tried = [one for run in flips for one in _flipped(at, best, run)]
        better = max(tried, key=lambda one: one.log_evidence, default=best)
        if better.log_evidence <= best.log_evidence:
            break
        best = better
        poses, sigmas = _estimated(claimed, best.weight, best.poses, best.sigmas)
        if sigmas.differ(best.sigmas, _STEADY):  # what false closures come to is computed once for all flips at others
            other = AtSigmas.of(claimed, sigmas)
            again = other.hypothesis(best.weight, poses)
            at, best = (other, again) if again.log_evidence > best.log_evidence else (at, best)
    if best is given:
        return best
    again = _refit(claimed, best.weight, best.poses, best.sigmas)
    return max(again, best, key=lambda one: one.log_evidence)


def _flipped(at: AtSigmas, best: Hypothesis, run: Ints) -> list[Hypothesis]:
    weight = np.array(best.weight)
    weight[run] = 1.0 - weight[run]
    if not weight[is_loop(at.factors.graph)].any():
        return []
    return attempted(lambda: [at.hypothesis(weight, best.poses)])


def bounded(graph: PoseGraph) -> PoseGraph:
    """The graph with the information of each closure at most `_MOST_INFORMATION` times the median one's, of those that
    know the axis."""
    loops = np.flatnonzero(~graph.odometry)
    if not len(loops):
        return graph
    axes = np.diagonal(informed(graph, loops), axis1=1, axis2=2)
    unknown = axes <= _KNOWN * np.diagonal(weakest_information(graph))  # as height where closures are planar
    median = np.ma.median(np.ma.masked_array(axes, unknown), axis=0).filled(np.inf)
    excess = (axes / (median * _MOST_INFORMATION)).max(1)
    information = graph.information.copy()
    information[loops] /= np.maximum(excess, 1.0)[:, None, None]
    return replace(graph, information=information)


def _from_start(claimed: Factors, gnc: GncSettings, sigmas: Sigmas, likely: Bools) -> list[Hypothesis]:
    """Graduated non-convexity over the `likely` closures (K,), then estimates of the sigmas and tests by them."""

    def solve() -> list[Hypothesis]:
        weight, poses = gnc.annealed(_times(claimed, sigmas), likely)
        if not weight.all():
            return _tested(claimed, gnc, weight, poses, sigmas)
        all_true = _refit(claimed, weight, poses, sigmas)  # noise first, by which least squares finds its way
        return [all_true, *_tested(claimed, gnc, weight, all_true.poses, all_true.sigmas)]

    return attempted(solve)


def _tested(claimed: Factors, gnc: GncSettings, weight: Floats, poses: Floats, sigmas: Sigmas) -> list[Hypothesis]:
    """Estimates of the sigmas and tests of all closures by them, in turns.

    The last test lets pass what chance would hardly bring so near, and a stricter one what the noise explains; they are
    two hypotheses where they differ.
    """
    found: list[Hypothesis] = []
    for strict in (False, True):
        for _ in range(_ROUNDS):
            weight, poses = gnc.tested(_times(claimed, sigmas), weight, poses, strict)
            before = sigmas
            poses, sigmas = _estimated(claimed, weight, poses, sigmas)
            if not sigmas.differ(before, _STEADY):
                break
        if not found or (weight != found[0].weight).any():
            found.append(hypothesis_of(claimed, weight, poses, sigmas))
    return found


def _refit(claimed: Factors, weight: Floats, poses: Floats, sigmas: Sigmas) -> Hypothesis:
    return hypothesis_of(claimed, weight, *_estimated(claimed, weight, poses, sigmas))


def _estimated(claimed: Factors, weight: Floats, poses: Floats, sigmas: Sigmas) -> tuple[Floats, Sigmas]:
    """Least squares of the weighted edges and the sigmas that they imply, in turns."""
    for _ in range(_ROUNDS):
        factors = _times(claimed, sigmas)
        poses = descend(factors, weight, poses, _STEPS, _TOLERANCE).world_from_body
        before, sigmas = sigmas, estimate(Objective(factors, weight), poses, sigmas)
        if not sigmas.differ(before, _STEADY / 4.0):
            break
    return poses, sigmas


@dataclass(frozen=True, eq=False)
class AtSigmas:
    """The graph with its sigmas multiplied, on which sets of closures are compared."""

    sigmas: Sigmas
    factors: Factors
    accidents: Accidents

    @classmethod
    def of(cls, claimed: Factors, sigmas: Sigmas) -> AtSigmas:
        factors = _times(claimed, sigmas)
        return cls(sigmas, factors, Accidents(factors.graph))

    def hypothesis(self, weight: Floats, poses: Floats) -> Hypothesis:
        """The least squares of the weighted edges from `poses`, and their evidence."""
        if (weight[~self.factors.graph.odometry] > 0).any():
            poses = descend(self.factors, weight, poses, _STEPS, _TOLERANCE).world_from_body
        found = log_evidence(self.factors, weight, poses, self.accidents) + self.sigmas.log_prior()
        return Hypothesis(weight, poses, self.sigmas, found)


def hypothesis_of(claimed: Factors, weight: Floats, poses: Floats, sigmas: Sigmas) -> Hypothesis:
    """The least squares of the weighted edges from `poses`, and their evidence, with these sigmas."""
    return AtSigmas.of(claimed, sigmas).hypothesis(weight, poses)


def _times(claimed: Factors, sigmas: Sigmas) -> Factors:
    """The factors with their sigmas multiplied; the shapes of eliminations serve all of them."""
    return replace(claimed, graph=claimed_times(claimed.graph, sigmas))
