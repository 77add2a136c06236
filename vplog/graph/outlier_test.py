"""Closures of a solved graph held against what the rest of it predicts."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vplog.errors import GraphError
from vplog.graph.consistency import chi2_quantile, degrees_of_freedom, residual_sigma
from vplog.graph.least_squares import Objective, descend
from vplog.graph.leave_one_out import cost_together, distance, group_costs, groups, tension

if TYPE_CHECKING:
    from vplog.data import Floats, Ints
    from vplog.graph.consistency import OdometryChain
    from vplog.graph.factors import Factors
    from vplog.graph.leave_one_out import Tension

_WORST_SHARE = 0.5
"""Closures that cost at least this share of what the worst one does go with it; the others may only suffer from it."""
_MOST_SUSPECTS = 50
"""Groups that a round looks at, the most suspect first: some seconds on 10 000 poses; public graphs have up to 20."""
_MOST_FORETOLD = 100
"""Closures of a group whose cost together is foretold: that takes their cube, of 100 a tenth of a second."""
_MOST_ROUNDS = 100
"""Rounds of putting away and taking back at most; each puts one away for good, and public graphs take up to 10."""
_SETTLED = 1e-6
"""Least squares ends when a step gains less than this share of the error: what closures cost can be read off there."""


@dataclass(frozen=True, eq=False)
class State:
    """Who is believed so far, and where that leads."""

    weight: Floats
    """(E,) 0 or 1."""
    poses: Floats
    """(N, 4, 4)."""
    chi2: float
    """Of the edges of weight 1 at the poses."""


@dataclass(frozen=True, eq=False)
class Scrutiny:
    """What is asked of the closures of one graph."""

    factors: Factors
    loops: Ints
    """(K,) edges that may be false, without those that are out for good."""
    probability: float
    """With which a true one is kept."""
    log_room: float
    """Log of the volume over which false ones are spread, in m and rad."""
    max_iterations: int
    chain: OdometryChain

    def __call__(self, weight: Floats, poses: Floats) -> State:
        """Put away what costs the rest too much, take back what the rest predicts, until neither is left to do."""
        state = self.settle(weight, poses)
        returned = np.zeros(len(weight), bool)
        cleared: set[bytes] = set()
        for _ in range(_MOST_ROUNDS):
            accepted = self.loops[state.weight[self.loops] > 0]
            if len(accepted) == 0:
                return state
            try:
                pull = tension(self.factors, state.weight, state.poses, accepted)
            except GraphError:  # what is nearly open cannot be predicted; least squares may still find its best place
                return state
            cost = np.minimum(pull.cost, state.chi2)  # first order may say more than there is
            limit = self.limit(state, cost, pull.log_spread)
            if (cost > limit).any():
                out = accepted[(cost > limit) & (cost >= _WORST_SHARE * cost[cost > limit].max())]
                state = self.settle(_with_weight(state.weight, out, 0.0), state.poses)
                continue
            smaller = self.without_a_false_place(state, accepted, pull, cleared)
            if smaller is not None:
                state = smaller
                continue
            rejected = self.loops[(state.weight[self.loops] == 0) & ~returned[self.loops]]
            back = self.predicted(state, rejected, pull.freedom)
            if len(back) == 0:
                return state
            returned[back] = True  # once: what goes again stays away
            state = self.settle(_with_weight(state.weight, back, 1.0), state.poses)
        return state

    def without_a_false_place(self, state: State, accepted: Ints, pull: Tension, cleared: set[bytes]) -> State | None:
        """The state without the first group of neighbouring closures that costs the rest too much; None: none does.

        Groups support each other, so each that pulls hard enough to be suspected is looked at as a whole, and solved
        without where that speaks against it, too. Those that turn out well are added to `cleared`.
        """
        factors = self.factors
        places = groups(factors.graph, accepted, self.chain)
        suspicion = np.minimum(group_costs(factors.graph, state.poses, accepted, pull, places, self.chain), state.chi2)
        size = np.array([len(place) for place in places])
        limit = np.full(len(places), np.inf)  # of one: answered already
        for members in np.unique(size[size > 1]).tolist():
            limit[size == members] = self.limit_of_group(state, suspicion[size == members], members)
        ratio = suspicion / np.maximum(limit, 1e-300)
        suspects = [accepted[places[at]] for at in np.argsort(-ratio, kind="stable").tolist() if ratio[at] > 1.0]
        suspects = [members for members in suspects[:_MOST_SUSPECTS] if members.tobytes() not in cleared]
        if not suspects:
            return None
        information = Objective(factors, state.weight).information(state.poses)
        for members in suspects:
            cost = state.chi2  # of many, solving without them takes less than foretelling what that gives
            if len(members) <= _MOST_FORETOLD:
                cost = min(cost_together(factors, state.weight, state.poses, information, members), cost)
            if cost > self.limit_of_group(state, np.array([cost]), len(members))[0]:
                smaller = self.settle(_with_weight(state.weight, members, 0.0), state.poses)
                cost = state.chi2 - smaller.chi2
                if cost > self.limit_of_group(state, np.array([cost]), len(members))[0]:
                    return smaller
            cleared.add(members.tobytes())
        return None

    def predicted(self, state: State, rejected: Ints, freedom: Floats) -> Ints:
        """Closures among those put away that the solved graph predicts."""
        graph = self.factors.graph
        most = self.limit(state, np.zeros(1))[0]
        # a closure is at least this near if the rest predicts it no worse than any that is kept
        rejected = rejected[residual_sigma(graph, state.poses, rejected) ** 2 <= most * (1.0 + freedom.max())]
        if len(rejected) == 0:
            return rejected
        apart, log_spread = distance(self.factors, state.weight, state.poses, rejected)
        return rejected[apart <= self.limit(state, np.zeros(len(rejected)), log_spread)]

    def limit(self, state: State, cost: Floats, log_spread: Floats | None = None) -> Floats:
        """(K,) how much chi-square each closure may cost the rest; the least of three bounds.

        1. By the noise as said: the chi-square quantile.
        2. By the noise as found: the chi-square of the graph without it, per degree of freedom (at the quantile that it
           stays above with the same probability), is the scale of the noise. Residuals of real graphs have long tails,
           so the quantile is that of the generalised Gauss inequality, which holds for every distribution with one
           peak: P(r^2 > k d) <= (2 / (d + 2))^(2 / d) / k (Van Parys, Goulart, Kuhn 2016).
        3. By chance: so near that not even one of all those put away, spread at random, would have been expected to be
           as near, but with the probability that a true one may be lost. The worse the rest predicts it (`log_spread`),
           the nearer it has to be. But what true ones are off on average is not held against them.
        """
        d = degrees_of_freedom(self.factors.graph)
        claimed = chi2_quantile(self.probability, d)
        scale = self._scale(state, cost, 1)
        tail = d * (2.0 / (d + 2.0)) ** (2.0 / d) / (1.0 - self.probability)
        bound = np.minimum(claimed, scale * tail)
        false = len(state.weight) - int(state.weight.sum())
        if log_spread is None or false == 0:
            return bound
        ball = d / 2.0 * math.log(math.pi) - math.lgamma(d / 2.0 + 1.0)  # log volume of the unit ball
        share = math.log1p(-self.probability) - math.log(false) + self.log_room
        by_chance = np.exp(2.0 / d * (share - ball - log_spread))
        return np.minimum(bound, np.maximum(by_chance, d * np.minimum(scale, 1.0)))

    def limit_of_group(self, state: State, cost: Floats, members: int) -> Floats:
        """(G,) the first two bounds for closures that go together: a long tail for their place, none within it."""
        d = degrees_of_freedom(self.factors.graph)
        tail = d * (2.0 / (d + 2.0)) ** (2.0 / d) / (1.0 - self.probability)
        among = chi2_quantile(self.probability, (members - 1) * d)
        claimed = chi2_quantile(self.probability, members * d)
        return np.minimum(claimed, self._scale(state, cost, members) * (tail + among))

    def _scale(self, state: State, cost: Floats, members: int) -> Floats:
        """Factor (K,) of the noise's variance as the graph without so many closures shows it; inf where it does not."""
        d = degrees_of_freedom(self.factors.graph)
        dof = d * (int(state.weight.sum()) - len(state.poses) + 1 - members)
        if dof <= 0:
            return np.full(len(cost), np.inf)
        return np.maximum(state.chi2 - cost, 0.0) / chi2_quantile(1.0 - self.probability, dof)

    def settle(self, weight: Floats, poses: Floats) -> State:
        """Least squares with these weights (E,) from these poses."""
        poses = descend(self.factors, weight, poses, self.max_iterations, _SETTLED).world_from_body
        return State(weight, poses, float((weight * residual_sigma(self.factors.graph, poses) ** 2).sum()))


def _with_weight(weight: Floats, edges: Ints, value: float) -> Floats:
    result = np.array(weight)
    result[edges] = value
    return result
