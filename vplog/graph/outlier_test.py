"""Test of the closures of a solved graph against the prediction of the rest of it."""

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
"""Closures that cost at least this share of the worst one's cost are rejected with it; others may suffer from it."""
_MOST_SUSPECTS = 50
"""Groups that a round looks at, the most suspect first: some seconds on 10 000 poses; public graphs have up to 20."""
_MOST_JOINT = 100
"""Largest group whose joint cost is predicted: that is cubic, a tenth of a second for 100."""
_MOST_ROUNDS = 100
"""Most rounds of rejecting and readmitting; each rejects one for good, and public graphs take up to 10."""
_TOLERANCE = 1e-6
"""Least squares ends when a step gains less than this share of the error."""


@dataclass(frozen=True, eq=False)
class State:
    """Inliers so far, and their solution."""

    weight: Floats
    """(E,) 0 or 1."""
    poses: Floats
    """(N, 4, 4)."""
    chi2: float
    """Chi-square of the edges of weight 1 at the poses."""


@dataclass(frozen=True, eq=False)
class OutlierTest:
    """Leave-one-out test of the closures of one graph, one by one and in groups."""

    factors: Factors
    loops: Ints
    """(K,) candidate edges, without those rejected for good."""
    probability: float
    """Probability that a true closure is an inlier."""
    log_room: float
    """Log of the volume in which false closures are uniform, in m and rad."""
    max_iterations: int
    chain: OdometryChain

    def __call__(self, weight: Floats, poses: Floats) -> State:
        """Reject what costs the rest too much and readmit what the rest predicts, until nothing changes."""
        state = self.solve(weight, poses)
        returned = np.zeros(len(weight), bool)
        cleared: set[bytes] = set()
        for _ in range(_MOST_ROUNDS):
            accepted = self.loops[state.weight[self.loops] > 0]
            if len(accepted) == 0:
                return state
            try:
                single = tension(self.factors, state.weight, state.poses, accepted)
            except GraphError:  # nearly singular: no prediction
                return state
            cost = np.minimum(single.cost, state.chi2)  # first order may say more than there is
            limit = self.limit(state, cost, single.log_spread)
            if (cost > limit).any():
                out = accepted[(cost > limit) & (cost >= _WORST_SHARE * cost[cost > limit].max())]
                state = self.solve(_with_weight(state.weight, out, 0.0), state.poses)
                continue
            smaller = self.without_a_false_place(state, accepted, single, cleared)
            if smaller is not None:
                state = smaller
                continue
            rejected = self.loops[(state.weight[self.loops] == 0) & ~returned[self.loops]]
            back = self.predicted(state, rejected, single.freedom)
            if len(back) == 0:
                return state
            returned[back] = True  # readmitted once
            state = self.solve(_with_weight(state.weight, back, 1.0), state.poses)
        return state

    def without_a_false_place(self, state: State, accepted: Ints, single: Tension, cleared: set[bytes]) -> State | None:
        """The state without the first group of neighbouring closures that costs the rest too much, or None.

        Groups of high first-order cost are tested jointly, then by solving without them; those that pass are `cleared`.
        """
        factors = self.factors
        places = groups(factors.graph, accepted, self.chain)
        suspicion = np.minimum(
            group_costs(factors.graph, state.poses, accepted, single, places, self.chain), state.chi2
        )
        size = np.array([len(place) for place in places])
        limit = np.full(len(places), np.inf)  # groups of one were tested already
        for members in np.unique(size[size > 1]).tolist():
            limit[size == members] = self.limit_of_group(state, suspicion[size == members], members)
        ratio = suspicion / np.maximum(limit, 1e-300)
        suspects = [accepted[places[at]] for at in np.argsort(-ratio, kind="stable").tolist() if ratio[at] > 1.0]
        suspects = [members for members in suspects[:_MOST_SUSPECTS] if members.tobytes() not in cleared]
        if not suspects:
            return None
        information = Objective(factors, state.weight).information(state.poses)
        for members in suspects:
            cost = state.chi2  # of many, solving without them is faster than predicting it
            if len(members) <= _MOST_JOINT:
                cost = min(cost_together(factors, state.weight, state.poses, information, members), cost)
            if cost > self.limit_of_group(state, np.array([cost]), len(members))[0]:
                smaller = self.solve(_with_weight(state.weight, members, 0.0), state.poses)
                cost = state.chi2 - smaller.chi2
                if cost > self.limit_of_group(state, np.array([cost]), len(members))[0]:
                    return smaller
            cleared.add(members.tobytes())
        return None

    def predicted(self, state: State, rejected: Ints, freedom: Floats) -> Ints:
        """Rejected closures that the solved graph predicts."""
        graph = self.factors.graph
        most = self.limit(state, np.zeros(1))[0]
        # necessary where the rest predicts it no worse than any inlier
        rejected = rejected[residual_sigma(graph, state.poses, rejected) ** 2 <= most * (1.0 + freedom.max())]
        if len(rejected) == 0:
            return rejected
        apart, log_spread = distance(self.factors, state.weight, state.poses, rejected)
        return rejected[apart <= self.limit(state, np.zeros(len(rejected)), log_spread)]

    def limit(self, state: State, cost: Floats, log_spread: Floats | None = None) -> Floats:
        """(K,) how much chi-square each closure may cost the rest; the least of three bounds.

        1. By the claimed noise: the chi-square quantile.
        2. By the estimated noise: its scale is the chi-square of the graph without it per degree of freedom (at the
           quantile that it exceeds with the same probability). Residuals have long tails, so the bound is that of the
           generalised Gauss inequality for unimodal distributions: P(r^2 > k d) <= (2 / (d + 2))^(2 / d) / k
           (Van Parys, Goulart, Kuhn 2016).
        3. By chance: fewer than 1 - probability of all rejected closures, if uniform, are expected as near; the bound
           falls as the prediction's `log_spread` rises, but not below the mean of true ones.
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
        """(G,) the first two bounds for a group: a long tail for the group, none within it."""
        d = degrees_of_freedom(self.factors.graph)
        tail = d * (2.0 / (d + 2.0)) ** (2.0 / d) / (1.0 - self.probability)
        among = chi2_quantile(self.probability, (members - 1) * d)
        claimed = chi2_quantile(self.probability, members * d)
        return np.minimum(claimed, self._scale(state, cost, members) * (tail + among))

    def _scale(self, state: State, cost: Floats, members: int) -> Floats:
        """Factor (K,) of the noise's variance estimated without so many closures; inf without redundancy."""
        d = degrees_of_freedom(self.factors.graph)
        dof = d * (int(state.weight.sum()) - len(state.poses) + 1 - members)
        if dof <= 0:
            return np.full(len(cost), np.inf)
        return np.maximum(state.chi2 - cost, 0.0) / chi2_quantile(1.0 - self.probability, dof)

    def solve(self, weight: Floats, poses: Floats) -> State:
        """Least squares with these weights (E,) from these poses."""
        poses = descend(self.factors, weight, poses, self.max_iterations, _TOLERANCE).world_from_body
        return State(weight, poses, float((weight * residual_sigma(self.factors.graph, poses) ** 2).sum()))


def _with_weight(weight: Floats, edges: Ints, value: float) -> Floats:
    result = np.array(weight)
    result[edges] = value
    return result
