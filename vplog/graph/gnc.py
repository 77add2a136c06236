"""Graduated non-convexity: closures that do not fit the rest lose their say, odometry is always believed.

Yang, Antonante, Tzoumas, Carlone: Graduated Non-Convexity for Robust Spatial Perception, RA-L 2020. Three things are
added to it, since it starts from a solve that believes every closure, which false ones can bend beyond return, and ends
where no closure has a large residual, which a false one has not either where little else holds the graph:

1. The start is what agrees with the odometry, by the mixture of agreement.py.
2. Noise is often said far too large, and then says nothing about false closures. So its scale is taken from the solved
   graph, and a closure has to fit to that.
3. In the end each closure, and each group of neighbouring ones, is held against what the rest predicts (leave_out.py).
   What costs the rest too much goes, and what was put away comes back where the rest predicts it.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal

import numpy as np
from pydantic import Field

from vplog.errors import GraphError
from vplog.graph.agreement import agreement
from vplog.graph.build import checked
from vplog.graph.consistency import OdometryChain, chi2_quantile, degrees_of_freedom, is_loop, residual_sigma
from vplog.graph.factors import Factors, least_squares
from vplog.graph.initialise import initial_poses
from vplog.graph.leave_out import distance, group_costs, groups, tension
from vplog.graph.lm import solve_kept
from vplog.graph.pcm import PcmSettings
from vplog.graph.truncated import truncated_weights
from vplog.settings import Settings

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vplog.data import Floats, Ints, PoseGraph, Solution
    from vplog.graph.leave_out import Tension

    Bools = NDArray[np.bool_]

_WORST_SHARE = 0.5
"""Closures that cost at least this share of what the worst one does go with it; the others may only suffer from it."""
_MOST_SUSPECTS = 50
"""Groups that a round solves without, the most suspect first; public graphs have up to 10."""
_MOST_ROUNDS = 100
"""Rounds of putting away and taking back at most; each puts one away for good, and public graphs take up to 10."""


class GncSettings(Settings):
    """Robust solve by graduated non-convexity with the truncated least squares loss."""

    kind: Literal["gnc"] = "gnc"
    """Name of the method."""
    inlier_probability: float = Field(default=0.99, gt=0, lt=1)
    """A true closure is kept with this probability: its chi-square of 6 degrees stays below that quantile (16.8)."""
    growth: float = Field(default=2.0, gt=1)
    """Factor by which the loss comes closer to the truncated one at each stage; the paper has 1.4, 2 found the
    same closures on drives of 850 keyframes in half the time."""
    steps: int = Field(default=3, ge=1)
    """Least squares steps per stage at most, each stage starts where the last ended; 10 000 poses need 3."""
    stage_tolerance: float = Field(default=0.01, gt=0)
    """A stage ends early when a step gains less than this share of the error."""
    max_stages: int = Field(default=60, ge=1)
    """Stages after which it gives up; residuals of 1e6 sigma take 40."""
    max_iterations: int = Field(default=100, ge=1)
    """Steps of the last solve, with the kept edges alone."""
    tolerance: float = Field(default=1e-6, gt=0)
    """The last solve has converged when a step gains less than this share of the error."""

    def __call__(self, graph: PoseGraph) -> Solution:
        """Solve. Weights are 1 for odometry, 0 or 1 for loops. Raises GraphError where the graph cannot be solved."""
        graph, _ = checked(graph)
        factors = Factors.of(graph)
        loops = np.flatnonzero(is_loop(graph))
        weight = np.ones(len(graph.a))
        if len(loops) == 0:
            start = initial_poses(factors, weight)
            return solve_kept(factors, weight, start, self.max_iterations, self.tolerance, "")
        weight[loops] = self._start(graph, loops)
        far = int((weight[loops] == 0).sum())
        bound = chi2_quantile(self.inlier_probability, degrees_of_freedom(graph))
        state = State(weight, initial_poses(factors, weight, bound))
        state, stages = self._anneal(factors, state, bound)
        state = self._hold_against_the_rest(factors, state, loops)
        kept = int(state.weight[loops].sum())
        found = (
            f"{kept} of {len(loops)} closures were kept. {far} did not agree with the odometry at first, "
            f"{stages} stages and a look at what each costs the others decided. "
        )
        return solve_kept(factors, state.weight, state.poses, self.max_iterations, self.tolerance, found)

    def _start(self, graph: PoseGraph, loops: Ints) -> Bools:
        """Closures (K,) to begin with: those that agree with the odometry or, where it does not lead, each other."""
        part = OdometryChain.of(graph).part
        across = part[graph.a[loops]] != part[graph.b[loops]]
        result = agreement(graph, loops).probability > 0.5
        kept, _ = PcmSettings(pair_probability=self.inlier_probability).consistent(graph, loops[across])
        result[across] = np.isin(loops[across], kept)
        return result

    def _anneal(self, factors: Factors, state: State, bound: float) -> tuple[State, int]:
        """Algorithm 1 of the paper over the closures of weight 1: those that are left have it, the others none."""
        judged = np.flatnonzero(is_loop(factors.graph) & (state.weight > 0))
        state = self._settle(factors, state.weight, state.poses)
        if len(judged) == 0:
            return state, 0
        weight, poses = np.array(state.weight), state.poses
        chi2 = residual_sigma(factors.graph, poses, judged) ** 2
        mu = bound / max(2.0 * chi2.max() - bound, bound)  # remark 5
        stage = 0
        for stage in range(1, self.max_stages + 1):  # noqa: B007 (told in the reason)
            weight[judged] = truncated_weights(chi2, bound, mu)
            if ((weight == 0) | (weight == 1)).all():
                break
            poses = least_squares(
                factors, factors.weighted(weight), poses, self.steps, self.stage_tolerance
            ).world_from_body
            chi2 = residual_sigma(factors.graph, poses, judged) ** 2
            mu *= self.growth
        return self._settle(factors, np.where(weight > 0.5, 1.0, 0.0), poses), stage

    def _hold_against_the_rest(self, factors: Factors, state: State, loops: Ints) -> State:
        """Put away what costs the rest too much, take back what the rest predicts, until neither is left to do."""
        returned = np.zeros(len(state.weight), bool)
        cleared: set[bytes] = set()
        for _ in range(_MOST_ROUNDS):
            kept = loops[state.weight[loops] > 0]
            if len(kept) == 0:
                return state
            try:
                pull = tension(factors, state.weight, state.poses, kept)
            except GraphError:  # what is nearly open cannot be predicted; least squares may still find its best place
                return state
            cost = np.minimum(pull.cost, state.chi2)  # first order may say more than there is
            limit = self._limit(factors, state, cost)
            if (cost > limit).any():
                out = kept[(cost > limit) & (cost >= _WORST_SHARE * cost.max())]
                state = self._settle(factors, _with(state.weight, out, 0.0), state.poses)
                continue
            smaller = self._without_a_false_place(factors, state, kept, pull, cleared)
            if smaller is not None:
                state = smaller
                continue
            back = self._predicted(factors, state, loops[(state.weight[loops] == 0) & ~returned[loops]], pull.freedom)
            if len(back) == 0:
                return state
            returned[back] = True  # once: what goes again stays away
            state = self._settle(factors, _with(state.weight, back, 1.0), state.poses)
        return state

    def _without_a_false_place(
        self, factors: Factors, state: State, kept: Ints, pull: Tension, cleared: set[bytes]
    ) -> State | None:
        """The state without the first group of neighbouring closures that costs the rest too much; None: none does.

        Groups support each other, so each is solved without, if it pulls hard enough to be suspected, and not `cleared`
        already; those that turn out well are added.
        """
        graph = factors.graph
        places = groups(graph, kept)
        suspicion = np.minimum(group_costs(graph, state.poses, kept, pull, places), state.chi2)
        suspicion[[len(place) == 1 for place in places]] = 0.0  # answered already
        size = np.array([len(place) for place in places])
        limit = np.zeros(len(places))
        for members in np.unique(size).tolist():
            limit[size == members] = self._limit(factors, state, suspicion[size == members], members)
        ratio = suspicion / np.maximum(limit, 1e-300)
        suspects = [place for place in np.argsort(-ratio, kind="stable") if ratio[place] > 1.0]
        for place in suspects[:_MOST_SUSPECTS]:
            members = kept[places[place]]
            if members.tobytes() in cleared:
                continue
            smaller = self._settle(factors, _with(state.weight, members, 0.0), state.poses)
            cost = state.chi2 - smaller.chi2
            if cost > self._limit(factors, state, np.array([cost]), len(members))[0]:
                return smaller
            cleared.add(members.tobytes())
        return None

    def _predicted(self, factors: Factors, state: State, away: Ints, freedom: Floats) -> Ints:
        """Closures among those put away that the solved graph predicts."""
        limit = self._limit(factors, state, np.zeros(1))[0]
        # a closure is at least this near if the rest predicts it no worse than any that is kept
        near = residual_sigma(factors.graph, state.poses, away) ** 2 <= limit * (1.0 + freedom.max())
        if not near.any():
            return away[:0]
        return away[near][distance(factors, state.weight, state.poses, away[near]) <= limit]

    def _limit(self, factors: Factors, state: State, cost: Floats, members: int = 1) -> Floats:
        """(K,) how much chi-square so many closures may cost the rest, by the noise as said and by the noise as found.

        As found: what the chi-square of the graph without them is, per degree of freedom, is the scale of the noise (at
        the quantile that it stays above with the same probability). Residuals of real graphs have long tails, so the
        bound for one closure is the generalised Gauss inequality, which holds for every distribution with one peak:
        P(r^2 > k d) <= (2 / (d + 2))^(2 / d) / k (Van Parys, Goulart, Kuhn 2016).
        """
        graph = factors.graph
        d = degrees_of_freedom(graph)
        said = chi2_quantile(self.inlier_probability, members * d)
        dof = d * (int(state.weight.sum()) - len(state.poses) + 1 - members)
        if dof <= 0:
            return np.full(len(cost), said)
        scale = np.maximum(state.chi2 - cost, 0.0) / chi2_quantile(1.0 - self.inlier_probability, dof)
        tail = d * (2.0 / (d + 2.0)) ** (2.0 / d) / (1.0 - self.inlier_probability)
        others = chi2_quantile(self.inlier_probability, (members - 1) * d) if members > 1 else 0.0
        return np.minimum(said, scale * (tail + others))

    def _settle(self, factors: Factors, weight: Floats, poses: Floats) -> State:
        """Least squares to where tensions can be read off: a thousandth of the error."""
        fit = least_squares(factors, factors.weighted(weight), poses, self.max_iterations, 1e-6)
        chi2 = float((weight * residual_sigma(factors.graph, fit.world_from_body) ** 2).sum())
        return State(weight, fit.world_from_body, chi2)


@dataclass(frozen=True, eq=False)
class State:
    """Who is believed so far, and where that leads."""

    weight: Floats
    """(E,) 0 or 1."""
    poses: Floats
    """(N, 4, 4)."""
    chi2: float = 0.0
    """Of the edges of weight 1 at the poses."""


def _with(weight: Floats, edges: Ints, value: float) -> Floats:
    result = np.array(weight)
    result[edges] = value
    return result
