"""Whether the edges of a graph agree with its poses, with each other and with their noise."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import dataclass
from functools import cached_property, lru_cache

import numpy as np
from scipy.special import chdtri

from vplog.data import Bools, EdgeKind, Floats, Int32s, Ints, PoseGraph
from vplog.geometry import se3
from vplog.graph.build import AXES, informed, parts
from vplog.graph.normal_equations import edge_costs

LOG_2PI = math.log(2.0 * math.pi)
_BESIDE = 3
"""Keyframes between neighbours of a run, at both ends: they see the same things."""
_LONGEST_RUN = 20
"""Largest number of closures of a run; beyond it the view has changed."""


def residual_sigma(graph: PoseGraph, world_from_body: Floats, edges: Ints | None = None) -> Floats:
    """Mahalanobis distance of each edge (E,), or of those named, to the poses (N, 4, 4): sqrt(e^T Omega e).

    e is the residual of GTSAM's BetweenFactor of Pose3, or of Pose2 in the plane.
    """
    return np.sqrt(np.maximum(2.0 * edge_costs(graph, np.ones(len(graph.a)), world_from_body, edges), 0.0))


def residual_twists(graph: PoseGraph, world_from_body: Floats, edges: Ints) -> Floats:
    """(K, 6) residuals of edges at poses (N, 4, 4), rotation first: those of GTSAM's BetweenFactor of Pose3."""
    measured = se3.between(world_from_body[graph.a[edges]], world_from_body[graph.b[edges]])
    return se3.log(se3.between(graph.a_from_b[edges], measured))


def degrees_of_freedom(graph: PoseGraph) -> int:
    """Degrees of freedom of one edge: 6, or 3 in the plane."""
    return len(AXES[graph.dimension])


def is_loop(graph: PoseGraph) -> Bools:
    """Edges (E,) that may be false: closures but known inliers."""
    return np.array([kind == EdgeKind.LOOP for kind in graph.kind], bool)


def residual_before(graph: PoseGraph, chain: OdometryChain | None = None) -> Floats:
    """Mahalanobis distance (E,) of each loop to the odometry alone; 0 for odometry edges.

    The noise is the loop's plus what the odometry accumulates from a to b: covariances add along the chain when each
    is moved to one frame by the adjoint, to first order, so a running sum answers every loop at once (Barfoot and
    Furgale 2014, eq. 55, second order). NaN where odometry edges do not lead from a to b. `chain` is the graph's where
    it is at hand.
    """
    result = np.zeros(len(graph.a))
    loops = np.flatnonzero(~graph.odometry)
    if len(loops) == 0:
        return result
    result[loops] = (chain or OdometryChain.of(graph)).distance(loops, graph)
    return result


@dataclass(frozen=True, eq=False)
class OdometryChain:
    """Poses by the odometry alone, and its covariance between any two of them.

    With `poses` replaced, the covariance is that of the odometry along those.
    """

    poses: Floats
    """(N, 4, 4)."""
    part: Ints
    """(N,) number of the unbroken piece of odometry that a pose is on."""
    step: Floats
    """(N, d, d) covariance of the step to each pose, in the frame of that pose; d = 6, or 3 in the plane."""
    axes: list[int]

    @classmethod
    def of(cls, graph: PoseGraph) -> OdometryChain:
        poses, leads = odometry_chain(graph)
        axes = AXES[graph.dimension]
        step = np.asarray(np.linalg.inv(informed(graph, leads)), np.float64)
        # noise is in the frame of an edge's b: moved to the later pose where that is a
        back = np.flatnonzero((leads >= 0) & (graph.a[leads] > graph.b[leads]))
        if len(back):
            turned = se3.adjoint(graph.a_from_b[leads[back]])[:, axes][:, :, axes]
            step[back] = turned @ step[back] @ np.swapaxes(turned, 1, 2)
        step[leads < 0] = 0.0
        return cls(poses, np.cumsum(leads < 0).astype(np.int64), step, axes)

    @cached_property
    def total(self) -> Floats:
        """(N, d, d) covariance summed from the first pose on, about the first pose.

        About that pose the sums stay small even if the odometry's frame is far away, as UTM is.
        """
        moved = se3.adjoint(se3.between(self.poses[:1], self.poses))[:, self.axes][:, :, self.axes]
        return np.cumsum(moved @ self.step @ np.swapaxes(moved, 1, 2), axis=0)

    def distance(self, loops: Ints, graph: PoseGraph) -> Floats:
        """(K,) sigma of the edges `loops` to the odometry, the noise of both together; NaN where it does not lead."""
        a, b = graph.a[loops], graph.b[loops]
        covariance = self.covariance(a, b) + np.linalg.inv(informed(graph, loops))
        chi2 = se3.mahalanobis2(residual_twists(graph, self.poses, loops)[:, self.axes], covariance)
        return np.where(self.part[a] == self.part[b], np.sqrt(np.maximum(chi2, 0.0)), np.nan)

    def covariance(self, a: Int32s, b: Int32s) -> Floats:
        """(L, d, d) of a_from_b by odometry, in the frame of b, to first order."""
        back = se3.adjoint(se3.between(self.poses[b], self.poses[:1]))[:, self.axes][:, :, self.axes]
        sign = np.where(a < b, 1.0, -1.0)[:, None, None]  # a loop may be written either way round
        return back @ (sign * (self.total[b] - self.total[a])) @ np.swapaxes(back, 1, 2)


def odometry_chain(graph: PoseGraph) -> tuple[Floats, Ints]:
    """Poses (N, 4, 4) by the odometry edges alone, and the odometry edge (N,) that leads to each pose, -1 for none.

    An edge may be written either way round. A pose without an edge from its predecessor (a second robot, a gap) stays
    at its initial place.
    """
    edges = np.flatnonzero(graph.odometry)
    edges = edges[np.abs(graph.b[edges] - graph.a[edges]) == 1][::-1]  # reversed: the first of several wins
    leads = np.full(len(graph.world_from_body), -1)
    leads[np.maximum(graph.a[edges], graph.b[edges])] = edges
    step = graph.a_from_b[leads]
    back = (leads >= 0) & (graph.a[leads] > graph.b[leads])
    step[back] = se3.inverse(step[back])
    return _chained(np.where((leads >= 0)[:, None, None], step, graph.world_from_body), leads < 0), leads


def _chained(step: Floats, begins: Bools) -> Floats:
    """Return the running products (N, 4, 4) of the steps, which start again where a chain `begins` (N,).

    Rows of about sqrt(N) poses are multiplied side by side, then each row by the last pose of the row before it.
    """
    length = math.isqrt(len(step)) + 1
    missing = length * length - len(step)
    rows = np.concatenate([step, np.tile(np.eye(4), (missing, 1, 1))]).reshape(length, length, 4, 4)
    follows = ~np.append(begins, np.zeros(missing, bool)).reshape(length, length)
    for k in range(1, length):
        rows[:, k] = np.where(follows[:, k, None, None], rows[:, k - 1] @ rows[:, k], rows[:, k])
    joined = np.logical_and.accumulate(follows, axis=1)
    for k in range(1, length):
        rows[k, joined[k]] = rows[k - 1, -1] @ rows[k, joined[k]]
    return rows.reshape(-1, 4, 4)[: len(step)]


def runs(graph: PoseGraph, loops: Ints) -> Iterator[Ints]:
    """Yield the edges `loops` (K,) in runs: closures between neighbouring keyframes at both ends, in order."""
    first, second = np.minimum(graph.a[loops], graph.b[loops]), np.maximum(graph.a[loops], graph.b[loops])
    order = np.lexsort((second, first))
    at, to = first[order].astype(np.int64), second[order].astype(np.int64)
    begin = np.searchsorted(at, at - _BESIDE)
    near = [
        start + np.flatnonzero(np.abs(to[start : this + 1] - to[this]) <= _BESIDE)
        for this, start in enumerate(begin.tolist())
    ]
    this = np.repeat(np.arange(len(loops)), [len(others) for others in near])
    label = parts(len(loops), np.concatenate([*near, this[:0]]), this)
    by_run = np.lexsort((to, label))
    for run in np.split(by_run, np.cumsum(np.bincount(label))[:-1]):
        for start in range(0, len(run), _LONGEST_RUN):
            yield loops[order[run[start : start + _LONGEST_RUN]]]


def far_from_odometry(graph: PoseGraph, probability: float, chain: OdometryChain | None = None) -> Bools:
    """Loops (E,) whose distance to the odometry alone is beyond what noise reaches with this probability."""
    bound = chi2_quantile(probability, degrees_of_freedom(graph))
    return np.asarray(np.nan_to_num(residual_before(graph, chain)) ** 2 > bound)


@lru_cache
def chi2_quantile(probability: float, dof: int) -> float:
    """Value that chi-square with `dof` degrees of freedom stays below with this probability."""
    return float(chdtri(dof, 1.0 - probability))
