"""Posterior density of a set of true closures: the objective of the decision.

log p(T, f, s, u | z) = log p(z | T, f, o, s, u) + log P(T, f) + log p(s) + log P(u), up to a constant. T are the true
closures, f the families of the false ones, o the odometry, s the factors of the claimed noise (`Sigmas`), and u the
states of the odometry's steps (`Slipping`). `Likelihood` has the first term and `Episodes` the second one.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, replace

import numpy as np

from vplog.data import Bools, Floats, Ints
from vplog.graph.build import informed
from vplog.graph.consistency import LOG_2PI, OdometryChain, degrees_of_freedom, is_loop, odometry_chain
from vplog.graph.episodes import Episodes
from vplog.graph.factors import Factors
from vplog.graph.false_families import Explained, Likelihood
from vplog.graph.false_volume import log_false_volumes
from vplog.graph.least_squares import descend
from vplog.graph.leave_one_out import distance, tension
from vplog.graph.slips import Slipping
from vplog.graph.variance_components import Sigmas, claimed_times

RESOLUTIONS = (1.0, 0.25, 0.0625)
"""Shares of the odometry's noise at which false families are told apart: the finer, the better the odometry or the more
true closures correct it."""


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A set of true closures and of slipping steps, with the poses and the noise that it implies."""

    weight: Floats
    """(E,) 1 for odometry and true closures, 0 for false ones."""
    poses: Floats
    """(N, 4, 4)."""
    sigmas: Sigmas
    slipping: Slipping
    resolution: float
    """The one of RESOLUTIONS that told its false families apart."""
    log_density: float
    family: Ints
    """(K,) number of the false family of each closure of the episodes, -1 for true ones."""


@dataclass(frozen=True, eq=False)
class Posterior:
    """Posterior of the sets of true closures of one graph at fixed noise factors."""

    sigmas: Sigmas
    factors: Factors
    """The graph with its noise multiplied."""
    episodes: Episodes
    slipping: Slipping

    @classmethod
    def of(
        cls, claimed: Factors, sigmas: Sigmas, log_odds: Floats | None = None, slipping: Slipping | None = None
    ) -> Posterior:
        """Prepare the graph `claimed` with its noise multiplied by `sigmas`; `log_odds` as in `Episodes.of`."""
        slipping = slipping or Slipping.nowhere(claimed.graph)
        slipped = slipping.applied(claimed.graph, sigmas)
        sound, graph = claimed_times(claimed.graph, sigmas), claimed_times(slipped, sigmas)
        log_volumes = log_false_volumes(sound, odometry_chain(sound)[0])  # the same for all states of the odometry
        loops, chain = np.flatnonzero(is_loop(graph)), OdometryChain.of(graph)
        episodes = Episodes.of(graph, loops, chain, log_volumes, log_odds)
        return cls(sigmas, replace(claimed, graph=graph), episodes, slipping)

    def hypothesis(self, weight: Floats, poses: Floats, resolutions: Sequence[float] = RESOLUTIONS) -> Hypothesis:
        """Solve the edges of weight (E,) 1 from `poses`, and find the likeliest false families at the `resolutions`.

        Raises GraphError if the poses are not determined.
        """
        if (weight[~self.factors.graph.odometry] > 0).any():
            poses = descend(self.factors, weight, poses).world_from_body
        is_false, claims = weight[self.episodes.edges] == 0, self.episodes.claims.on(poses)
        likelihood, found = Likelihood(self.factors, weight, poses), dict[bytes, Hypothesis]()
        for resolution in resolutions:
            family = self.episodes.family(is_false, claims, resolution)
            if family.tobytes() not in found:
                best = self._merged(is_false, likelihood.explained(claims, family), likelihood.joined)
                found[family.tobytes()] = Hypothesis(weight, poses, self.sigmas, self.slipping, resolution, *best)
        return max(found.values(), key=lambda one: one.log_density)

    def _merged(self, is_false: Bools, explained: Explained | None, joined: int) -> tuple[float, Ints]:
        """Merge families as long as that raises the log density. Return it and the family (K,) of each closure."""
        best = -math.inf, np.empty(0, np.int64)
        while explained is not None:
            log_density = self._prior(is_false, explained.family, joined) + explained.log_density
            if log_density <= best[0]:
                break
            best, explained = (log_density, explained.family), explained.merged()
        return best

    def _prior(self, is_false: Bools, family: Ints, joined: int) -> float:
        of_states = self.episodes.log_prior(is_false, family) - joined * self.episodes.log_volume
        return of_states + self.sigmas.log_prior() + self.slipping.log_prior

    def most_gain(self, one: Hypothesis, group: Ints) -> float:
        """Return the most by which the log density can rise if the false closures `group` of the episodes are true: if
        all others predict them exactly."""
        is_false, family = one.weight[self.episodes.edges] == 0, np.array(one.family)
        is_false[group], family[group] = False, -1
        graph, edges = self.factors.graph, self.episodes.edges[group]
        exact = 0.5 * np.linalg.slogdet(informed(graph, edges) / (2.0 * math.pi))[1].sum()
        likelihood, claims = Likelihood(self.factors, one.weight, one.poses), self.episodes.claims.on(one.poses)
        rest = likelihood.explained(claims, family).log_density
        return self._prior(is_false, family, likelihood.joined) + rest + float(exact) - one.log_density

    def log_predictive(self, one: Hypothesis) -> Floats:
        """Return the log density (K,) of each closure given the true ones without it, in the order of the episodes."""
        edges, d = self.episodes.edges, degrees_of_freedom(self.factors.graph)
        result, true = np.empty(len(edges)), one.weight[edges] > 0
        if not true.all():
            cost, log_spread = distance(self.factors, one.weight, one.poses, edges[~true])
            result[~true] = -0.5 * cost - np.minimum(log_spread + 0.5 * d * LOG_2PI, self.episodes.log_volume)
        if true.any():
            found = tension(self.factors, one.weight, one.poses, edges[true])
            result[true] = -0.5 * found.cost
            result[true] -= np.minimum(found.log_spread + 0.5 * d * LOG_2PI, self.episodes.log_volume)
        return result
