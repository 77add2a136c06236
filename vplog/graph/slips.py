"""Odometry that does not measure the motion: steps in which wheels slip, the robot is held, or the odometry is frozen.

Each step of the odometry is sound or slips. In a step that reports an ordinary motion and slips, the robot stands. A
step that reports no motion, or far more than the others, says nothing if it slips: the robot moves as in the other
steps. Slips come in runs, a Markov chain along the path. `docs/how-it-works.md` states the whole model.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from vplog.data import Bools, Floats, Ints, PoseGraph
from vplog.errors import GraphError
from vplog.geometry import se3
from vplog.graph.build import AXES, informed
from vplog.graph.factors import Factors
from vplog.graph.least_squares import Objective, descend
from vplog.graph.leave_one_out import Tension, tension
from vplog.graph.variance_components import Sigmas, claimed_times

SOUND, STANDS, MOVES = range(3)
"""States of a step."""
_BEGINS = 1e-6
"""Prior probability that a run of slipping steps begins at a step of ordinary motion."""
_LENGTH = 5.0
"""Mean length of a run in keyframes."""
_UNUSUAL = 0.01
"""Prior probability that such a run begins at a step that reports no motion, or far more than the others."""
_STILL, _FAR = 0.01, 2.0
"""Motion that is reported as none, and motion that is far too much, as a share of what 95 % of the steps stay below."""
_MOST = 0.5
"""Largest share of slipping steps. A search for slips that exceeds it ends without a result."""


@dataclass(frozen=True, eq=False)
class Slipping:
    """States of the steps of a graph's odometry."""

    state: Ints
    """(E,) of each edge; `SOUND` for edges that are no step."""
    log_prior: float

    @classmethod
    def nowhere(cls, graph: PoseGraph) -> Slipping:
        return cls(np.zeros(len(graph.a), np.int64), 0.0)

    @property
    def edges(self) -> Ints:
        """Edges that slip."""
        return np.flatnonzero(self.state)

    def applied(self, graph: PoseGraph, sigmas: Sigmas) -> PoseGraph:
        """Return the graph in which slipping steps measure what their state says.

        `claimed_times` multiplies their noise by `sigmas`, so that of unknown motion is divided by these.
        """
        if not self.state.any():
            return graph
        a_from_b, information = graph.a_from_b.copy(), graph.information.copy()
        a_from_b[self.edges], covariance = _measured(graph, self.edges, self.state[self.edges], sigmas)
        factor = np.repeat(sigmas[:2], 3)
        information[self.edges] = np.linalg.inv(covariance) * factor[:, None] * factor
        return replace(graph, a_from_b=a_from_b, information=information)


@dataclass(frozen=True, eq=False)
class _States:
    """States (S,) of the steps, and the solution with them."""

    state: Ints
    factors: Factors
    poses: Floats
    log_density: float
    log_prior: float


class Slips:
    """The steps of a graph's odometry in order of the path, and the prior of their states."""

    def __init__(self, graph: PoseGraph) -> None:
        edges = _steps(graph)
        first = np.minimum(graph.a[edges], graph.b[edges]).astype(np.int64)
        self.edges = edges[np.argsort(first, kind="stable")]
        """(S,) edges of the steps."""
        self._graph = graph
        self._follows = np.diff(np.sort(first), prepend=-2) == 1
        twist = np.linalg.norm(se3.log(graph.a_from_b[self.edges]).reshape(-1, 2, 3), axis=2)
        usual = np.quantile(twist, 0.95, axis=0) if len(twist) else np.zeros(2)
        still = (twist <= _STILL * usual).all(1)
        unusual = still | (twist > _FAR * usual).any(1)
        self._slips_as = np.where(unusual, MOVES, STANDS)
        self._begins = np.where(unusual, math.log(_UNUSUAL), math.log(_BEGINS))
        self._stays = np.where(still, 0.0, math.log(1.0 - 1.0 / _LENGTH))
        self._ends = np.where(np.append(False, still[:-1]) & ~still, 0.0, -math.log(_LENGTH))

    def likeliest(
        self, factors: Factors, weight: Floats, poses: Floats, sigmas: Sigmas, start: Slipping, least: float = -np.inf
    ) -> Slipping | None:
        """Return the states that the closures of weight (E,) 1 imply, by changes from `start`, each the likeliest.

        `poses` (N, 4, 4) are where the least squares start, `factors` those of the claimed graph. None if the log prior
        of the states falls below `least`, if too many steps slip, or if the poses are not determined.
        """
        try:
            present = self._solved(factors, weight, poses, sigmas, start.state[self.edges])
            while np.count_nonzero(present.state) <= _MOST * len(self.edges) and present.log_prior >= least:
                better = self._changed(weight, sigmas, present)
                if better is None:
                    return self._slipping(present.state)
                present = better
        except (GraphError, np.linalg.LinAlgError):
            pass
        return None

    def _changed(self, weight: Floats, sigmas: Sigmas, present: _States) -> _States | None:
        """Change the step that gains most, and as many beside it as gain more; None if no step gains."""
        slips, rest = present.state > 0, tension(present.factors, weight, present.poses, self.edges)
        now, other = (
            self._log_likelihood(present.factors.graph, rest, sigmas, state)
            for state in (present.state, np.where(slips, SOUND, self._slips_as))
        )
        prior_gain = self._log_prior_gain(slips)
        gain = other - now + prior_gain
        step, best = int(np.argmax(gain)), None
        last = present.log_density + min(float(prior_gain[step]), 0.0)  # a run may begin that pays with more steps
        if present.log_density + gain[step] <= last:
            return None
        for steps in self._about(step, gain, slips == slips[step]):
            changed = np.array(present.state)
            changed[steps] = SOUND if slips[step] else self._slips_as[steps]
            found = self._solved(present.factors, weight, present.poses, sigmas, changed)
            if found.log_density <= last:
                break
            last = found.log_density
            if last > (best or present).log_density:
                best = found
        return best

    def _about(self, step: int, gain: Floats, may: Bools) -> Iterator[Ints]:
        """1, 2, 4, ... steps about this one that may change, those beside it of larger `gain` (S,) first."""
        first, last, size = step, step, 1
        while True:
            yield np.arange(first, last + 1)
            size *= 2
            while last - first + 1 < size:
                left = first > 0 and self._follows[first] and may[first - 1]
                right = last + 1 < len(gain) and self._follows[last + 1] and may[last + 1]
                if not (left or right):
                    if last - first + 1 > size // 2:
                        yield np.arange(first, last + 1)
                    return
                if left and not (right and gain[last + 1] >= gain[first - 1]):
                    first -= 1
                else:
                    last += 1

    def _solved(self, factors: Factors, weight: Floats, poses: Floats, sigmas: Sigmas, state: Ints) -> _States:
        """Solve with these states (S,), up to a constant that only `weight` changes."""
        slipping = self._slipping(state)
        graph = claimed_times(slipping.applied(self._graph, sigmas), sigmas)
        factors = replace(factors, graph=graph)
        poses = descend(factors, weight, poses).world_from_body
        objective = Objective(factors, weight)
        known = np.linalg.slogdet(informed(graph, self.edges))[1].sum()
        log_density = 0.5 * (known - objective.information(poses).log_determinant()) - objective.cost(poses)
        log_density = float(log_density) + slipping.log_prior
        return _States(state, factors, poses, log_density, slipping.log_prior)

    def _slipping(self, state: Ints) -> Slipping:
        """The states (S,) of the steps as those of edges."""
        of_edges = np.zeros(len(self._graph.a), np.int64)
        of_edges[self.edges] = state
        slips = state > 0
        before = np.append(False, slips[:-1]) & self._follows
        return Slipping(of_edges, float(self._log_transitions(before, slips).sum()))

    def _log_transitions(self, before: Bools, slips: Bools) -> Floats:
        """Log prior of whether each step slips, given whether the one before does, all (S,)."""
        leaves = np.where(before, self._ends, 0.0)
        return np.where(slips, np.where(before, self._stays, self._begins), leaves)

    def _log_prior_gain(self, slips: Bools) -> Floats:
        """Change of the log prior (S,) if one of the steps, which slip or do not (S,), changes."""

        def of(own: Bools) -> Floats:
            before = np.append(False, slips[:-1]) & self._follows
            after = np.append(self._log_transitions(np.append(False, own[:-1]), slips)[1:], 0.0)
            return self._log_transitions(before, own) + np.where(np.append(self._follows[1:], False), after, 0.0)

        return of(~slips) - of(slips)

    def _log_likelihood(self, graph: PoseGraph, rest: Tension, sigmas: Sigmas, state: Ints) -> Floats:
        """Log density (S,) of the motions that the steps measure in these states (S,), given the `rest` of the edges,
        up to a constant."""
        axes = AXES[graph.dimension]
        predicted = rest.whitened / rest.redundancy
        motion, covariance = _measured(self._graph, self.edges, state, sigmas)
        apart = se3.log(se3.between(graph.a_from_b[self.edges], motion))[:, axes]
        error = predicted - (rest.whitener @ apart[:, :, None])[:, :, 0]
        total = rest.whitener @ covariance[:, axes][:, :, axes] @ np.swapaxes(rest.whitener, 1, 2)
        diagonal = np.arange(len(axes))
        total[:, diagonal, diagonal] += (1.0 - rest.redundancy) / rest.redundancy
        return -0.5 * (se3.mahalanobis2(error, total) + np.linalg.slogdet(total)[1])


def _steps(graph: PoseGraph) -> Ints:
    """Edges of the odometry from one pose to the next, in either direction."""
    return np.flatnonzero(graph.odometry & (np.abs(graph.b.astype(np.int64) - graph.a) == 1))


def _forward(graph: PoseGraph, edges: Ints, motion: Floats) -> Floats:
    """Motions (K, 4, 4) of these edges from the earlier to the later pose, or back from these."""
    back = (graph.a[edges] > graph.b[edges])[:, None, None]
    return np.where(back, se3.inverse(motion), motion)


def _measured(graph: PoseGraph, edges: Ints, state: Ints, sigmas: Sigmas) -> tuple[Floats, Floats]:
    """Return the motion a_from_b (K, 4, 4) that `edges` (K,) measure in these states (K,), and its covariance
    (K, 6, 6) with the claimed noise multiplied by `sigmas`."""
    factor, moves = np.repeat(sigmas[:2], 3), state == MOVES
    covariance = np.asarray(np.linalg.inv(graph.information[edges]), np.float64) * factor[:, None] * factor
    motion = np.where((state == STANDS)[:, None, None], np.eye(4), graph.a_from_b[edges])
    if moves.any():
        steps = _steps(graph)
        twists = se3.log(_forward(graph, steps, graph.a_from_b[steps]))
        usual = np.median(twists, axis=0)
        covariance[moves] += (twists - usual).T @ (twists - usual) / len(steps)
        motion[moves] = _forward(graph, edges[moves], np.tile(se3.exp(usual[None])[0], (int(moves.sum()), 1, 1)))
    return motion, covariance
