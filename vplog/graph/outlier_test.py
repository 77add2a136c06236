"""Test of the closures of a solved graph against the prediction of the rest of it."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Floats, Ints
from vplog.errors import GraphError
from vplog.graph.build import informed
from vplog.graph.consistency import OdometryChain, chi2_quantile, degrees_of_freedom, residual_sigma
from vplog.graph.least_squares import Objective, descend
from vplog.graph.leave_one_out import Tension, cost_together, distance, group_costs, groups, tension

if TYPE_CHECKING:
    from vplog.graph.factors import Factors

_WORST_SHARE = 0.5
"""Closures that cost at least this share of the worst one are rejected with it; it may be swamping the others."""
_MOST_SUSPECTS = 50
"""Groups that a round looks at, the most suspect first: some seconds on 10 000 poses; public graphs have up to 20."""
_MOST_JOINT = 100
"""Largest group whose joint cost is predicted: that is cubic, a tenth of a second for 100."""
_MOST_ROUNDS = 100
"""Most rounds of rejecting and readmitting; each rejects one for good, and public graphs take up to 10."""
_FURTHEST = 100.0
"""Residuals beyond so many limits are not looked at again: the noise of a prediction by the graph is seldom larger than
ten times that of a closure."""
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
    strict: bool = False
    """Whether a closure may cost no more than `probability` says, however unlikely it is to fit so well by chance."""

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
            limit = self.limit(single.log_spread)
            if (cost > limit).any():
                out = accepted[(cost > limit) & (cost >= _WORST_SHARE * cost[cost > limit].max())]
                state = self.solve(_with_weight(state.weight, out, 0.0), state.poses)
                continue
            smaller = self.without_false_group(state, accepted, single, cleared)
            if smaller is not None:
                state = smaller
                continue
            rejected = self.loops[(state.weight[self.loops] == 0) & ~returned[self.loops]]
            back = self.predicted(state, rejected)
            if len(back) == 0:
                return state
            returned[back] = True  # readmitted once
            state = self.solve(_with_weight(state.weight, back, 1.0), state.poses)
        return state

    def without_false_group(self, state: State, accepted: Ints, single: Tension, cleared: set[bytes]) -> State | None:
        """The state without the first group of neighbouring closures that costs the rest too much, or None.

        Groups of high first-order cost are tested jointly, then by solving without them; those that pass are `cleared`.
        """
        factors = self.factors
        found = groups(factors.graph, accepted, self.chain)
        cost = group_costs(factors.graph, state.poses, accepted, single, found, self.chain)
        size = np.array([len(members) for members in found])
        spread = np.array([single.log_spread[members].max() for members in found])
        limit = np.array([self.limit_of_group(*one) for one in zip(size.tolist(), spread.tolist(), strict=True)])
        ratio = np.where(size > 1, np.minimum(cost, state.chi2) / limit, 0.0)  # groups of one were tested already
        worst = [at for at in np.argsort(-ratio, kind="stable").tolist() if ratio[at] > 1.0][:_MOST_SUSPECTS]
        suspects = [(accepted[found[at]], float(limit[at])) for at in worst]
        suspects = [(members, most) for members, most in suspects if members.tobytes() not in cleared]
        if not suspects:
            return None
        information = Objective(factors, state.weight).information(state.poses)
        for members, most in suspects:
            cost = state.chi2  # of many, solving without them is faster than predicting it
            if len(members) <= _MOST_JOINT:
                cost = min(cost_together(factors, state.weight, state.poses, information, members), cost)
            if cost > most:
                smaller = self.solve(_with_weight(state.weight, members, 0.0), state.poses)
                if state.chi2 - smaller.chi2 > most:
                    return smaller
            cleared.add(members.tobytes())
        return None

    def predicted(self, state: State, rejected: Ints) -> Ints:
        """Rejected closures that the solved graph predicts."""
        graph = self.factors.graph
        own = -0.5 * np.linalg.slogdet(informed(graph, rejected))[1]
        # an upper bound of the residual of what is within the limit, whatever the prediction's noise adds to its own
        near = residual_sigma(graph, state.poses, rejected) ** 2 <= _FURTHEST * self.limit(own)
        rejected = rejected[near]
        if len(rejected) == 0:
            return rejected
        apart, log_spread = distance(self.factors, state.weight, state.poses, rejected)
        return rejected[apart <= self.limit(log_spread)]

    def limit(self, log_spread: Floats) -> Floats:
        """(K,) how much chi-square each closure may cost the rest: what makes it as likely true as false.

        False ones are uniform in the room, unless the test is `strict`. `log_spread` is half the log determinant of the
        covariance of the rest's prediction and the closure's noise together. A true one as the noise has it passes by
        `probability` at least.
        """
        d = degrees_of_freedom(self.factors.graph)
        if self.strict:
            return np.full(len(log_spread), chi2_quantile(self.probability, d))
        by_chance = 2.0 * (self.log_room - log_spread) - d * math.log(2.0 * math.pi)
        return np.maximum(by_chance, chi2_quantile(self.probability, d))

    def limit_of_group(self, members: int, log_spread: float) -> float:
        """The limit of a group: it may be off as one as a closure may, and its members as their noise has it."""
        d = degrees_of_freedom(self.factors.graph)
        among = chi2_quantile(self.probability, (members - 1) * d) if members > 1 else 0.0
        return among + float(self.limit(np.array([log_spread]))[0])

    def solve(self, weight: Floats, poses: Floats) -> State:
        """Least squares with these weights (E,) from these poses."""
        poses = descend(self.factors, weight, poses, self.max_iterations, _TOLERANCE).world_from_body
        return State(weight, poses, float((weight * residual_sigma(self.factors.graph, poses) ** 2).sum()))


def _with_weight(weight: Floats, edges: Ints, value: float) -> Floats:
    result = np.array(weight)
    result[edges] = value
    return result
