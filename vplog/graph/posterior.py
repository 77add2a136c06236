"""Posterior density of a set of true closures: the objective of the decision.

log p(T, s | z) = log p(z_T | odometry, s) + log p(z_F) + log P(T) + log p(s), up to a constant. T are the true closures
and F the false ones, s the factors of the claimed noise (`Sigmas`). The first term integrates over the poses (Laplace's
approximation, exact for a linear graph). `Episodes` has the second and the third term.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from vplog.data import Floats, Ints
from vplog.graph.build import informed
from vplog.graph.consistency import OdometryChain, degrees_of_freedom, is_loop, odometry_chain, residual_sigma
from vplog.graph.episodes import Episodes
from vplog.graph.factors import Factors
from vplog.graph.false_volume import log_false_volumes
from vplog.graph.least_squares import GAUGE_SIGMA, Objective, descend
from vplog.graph.leave_one_out import distance, tension
from vplog.graph.slips import Slipping
from vplog.graph.variance_components import Sigmas, claimed_times

STEPS, TOLERANCE = 100, 1e-4
"""Limits of the least squares that compare hypotheses."""
_LOG_2PI = math.log(2.0 * math.pi)


@dataclass(frozen=True, eq=False)
class Hypothesis:
    """A set of true closures and of slipping steps, with the poses and the noise that it implies."""

    weight: Floats
    """(E,) 1 for odometry and true closures, 0 for false ones."""
    poses: Floats
    """(N, 4, 4)."""
    sigmas: Sigmas
    log_density: float
    slipping: Slipping


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
        of_false = claimed_times(slipped, Sigmas(*sigmas[:2]))  # the noise of true closures is not that of false ones
        log_volumes = log_false_volumes(sound, odometry_chain(sound)[0])  # the same for all states of the odometry
        loops, chain = np.flatnonzero(is_loop(graph)), OdometryChain.of(graph)
        episodes = Episodes.of(of_false, loops, chain, log_volumes, log_odds)
        return cls(sigmas, replace(claimed, graph=graph), episodes, slipping)

    def hypothesis(self, weight: Floats, poses: Floats) -> Hypothesis:
        """Solve the edges of weight (E,) 1 from `poses`. Raises GraphError if these are not determined."""
        if (weight[~self.factors.graph.odometry] > 0).any():
            poses = descend(self.factors, weight, poses, STEPS, TOLERANCE).world_from_body
        return Hypothesis(weight, poses, self.sigmas, self.log_density(weight, poses), self.slipping)

    def log_density(self, weight: Floats, poses: Floats) -> float:
        """Return the log of the posterior density; `poses` are the least squares of the edges of weight (E,) 1."""
        density, _ = self.episodes.log_density(weight[self.episodes.edges] == 0, poses)
        true = np.flatnonzero(~self.factors.graph.odometry & (weight > 0))
        density += self.sigmas.log_prior() + self.slipping.log_prior
        return density + (self._log_true(weight, poses, true) if len(true) else 0.0)

    def _log_true(self, weight: Floats, poses: Floats, true: Ints) -> float:
        """Log density of the true closures under the odometry: N(0, A C A^T + R) by the matrix determinant lemma."""
        factors, graph = self.factors, self.factors.graph
        d = degrees_of_freedom(graph)
        loose = len(factors.loose(weight))
        held = (1 + loose) * d * -2.0 * math.log(GAUGE_SIGMA)
        joined = int(factors.piece.max()) - loose  # pieces of odometry that only closures join may be anywhere
        determinant = Objective(factors, weight).information(poses).log_determinant() - held
        known = np.linalg.slogdet(informed(graph, weight > 0))[1].sum()
        chi2 = weight * residual_sigma(graph, poses) ** 2
        normal = 0.5 * (known - determinant - chi2.sum()) - 0.5 * _LOG_2PI * d * (len(true) - joined)
        return float(normal) - joined * self.episodes.log_volume

    def most_gain(self, one: Hypothesis, group: Ints) -> float:
        """Return the most by which the log density can rise if the false closures `group` of the episodes are true: if
        all others predict them exactly."""
        is_false = one.weight[self.episodes.edges] == 0
        changed = np.array(is_false)
        changed[group] = False
        states = self.episodes.log_density(changed)[0] - self.episodes.log_density(is_false)[0]
        known = np.linalg.slogdet(informed(self.factors.graph, self.episodes.edges[group]))[1].sum()
        return states + float(0.5 * (known - len(group) * degrees_of_freedom(self.factors.graph) * _LOG_2PI))

    def log_predictive(self, one: Hypothesis) -> Floats:
        """Return the log density (K,) of each closure given the true ones without it, in the order of the episodes."""
        edges, d = self.episodes.edges, degrees_of_freedom(self.factors.graph)
        result, true = np.empty(len(edges)), one.weight[edges] > 0
        if not true.all():
            cost, log_spread = distance(self.factors, one.weight, one.poses, edges[~true])
            result[~true] = -0.5 * cost - np.minimum(log_spread + 0.5 * d * _LOG_2PI, self.episodes.log_volume)
        if true.any():
            found = tension(self.factors, one.weight, one.poses, edges[true])
            result[true] = -0.5 * found.cost
            result[true] -= np.minimum(found.log_spread + 0.5 * d * _LOG_2PI, self.episodes.log_volume)
        return result
