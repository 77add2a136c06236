"""Our pose graph in GTSAM's terms, and back. Every optimiser goes through here."""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cached_property
from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np

from vplog import geometry
from vplog.data import EdgeKind
from vplog.errors import GraphError
from vplog.graph.build import informed, parts
from vplog.graph.elimination import Elimination

if TYPE_CHECKING:
    from vplog.data import Bools, Floats, Ints, PoseGraph

GAUGE_SIGMA = 1e-6
"""rad and m; holds pose 0 where it is, so that the rest has one best place. What it lets through is undone after."""
_ALIKE = 0.99
"""Share of a shape's edges that are still there for it to serve: a new one costs as much as a few steps."""
_PLANAR = [1, 2, 0]
"""GTSAM has x, y, yaw; the planar rows here are yaw, x, y."""


@dataclass(frozen=True, eq=False)
class Fit:
    """Where a least squares descent ended."""

    world_from_body: Floats
    iterations: int
    converged: bool


@dataclass(frozen=True, eq=False)
class Factors:
    """The edges of a graph as GTSAM's factors, with pose 0 as the origin of everything."""

    graph: PoseGraph
    information: Floats
    """(E, d, d) in GTSAM's order of axes; d = 6, or 3 in the plane."""
    piece: Ints
    """(N,) number of the piece of odometry that each pose is on, in order of their first poses."""
    eliminations: list[tuple[Bools, Elimination]] = field(default_factory=list, repr=False)
    """Those made last, with the edges (E,) that each is of."""

    @classmethod
    def of(cls, graph: PoseGraph) -> Factors:
        information = informed(graph)
        if graph.dimension == 2:
            information = information[:, _PLANAR][:, :, _PLANAR]
        odometry = np.array([kind == EdgeKind.ODOMETRY for kind in graph.kind], bool)
        return cls(graph, information, parts(len(graph.world_from_body), graph.a[odometry], graph.b[odometry]))

    @cached_property
    def whole(self) -> list[Any]:
        """BetweenFactorPose3 or Pose2 of each edge with its full information.

        Edges of equal information share a noise model, as in most files all do.
        """
        graph = self.graph
        shared: dict[bytes, Any] = {}
        noise = []
        for matrix in np.ascontiguousarray(self.information):
            name = matrix.tobytes()
            if name not in shared:
                shared[name] = gtsam.noiseModel.Gaussian.Information(matrix)
            noise.append(shared[name])
        between = gtsam.BetweenFactorPose2 if graph.dimension == 2 else gtsam.BetweenFactorPose3
        ends = zip(graph.a.tolist(), graph.b.tolist(), as_gtsam(graph.a_from_b, graph.dimension), noise, strict=True)
        return [between(a, b, measured, model) for a, b, measured, model in ends]

    def elimination(self, on: Bools) -> Elimination:
        """A shape that holds all of these edges (E,): one made before where it has few others, else a new one."""
        for edges, shape in self.eliminations:
            if not (on & ~edges).any() and on.sum() >= _ALIKE * edges.sum():
                return shape
        shape = Elimination.of(len(self.graph.world_from_body), self.graph.a[on], self.graph.b[on])
        self.eliminations[:] = [*self.eliminations[-1:], (on, shape)]
        return shape

    def weighted(self, weight: Floats) -> gtsam.NonlinearFactorGraph:
        """The edges of positive weight (E,), their information times the weight, and the gauge at pose 0.

        Those of weight 1 are taken as they are, which is most of them at every stage.
        """
        result = self.gauged(self.loose(weight))
        scaled = np.flatnonzero((weight > 0) & (weight != 1))
        # the factor of L^T, upper triangular, is what GTSAM keeps of an information L L^T
        roots = np.swapaxes(np.linalg.cholesky(self.information[scaled] * weight[scaled, None, None]), 1, 2)
        root = dict(zip(scaled.tolist(), np.ascontiguousarray(roots), strict=True))
        between = gtsam.BetweenFactorPose2 if self.graph.dimension == 2 else gtsam.BetweenFactorPose3
        for edge in np.flatnonzero(weight > 0).tolist():
            factor = self.whole[edge]
            if edge in root:
                noise = gtsam.noiseModel.Gaussian.SqrtInformation(root[edge], False)
                factor = between(int(self.graph.a[edge]), int(self.graph.b[edge]), factor.measured(), noise)
            result.add(factor)
        return result

    def robust(self, loops: Ints, estimator: Any) -> gtsam.NonlinearFactorGraph:
        """All edges, the loops among them under a robust estimator of GTSAM, and the gauge at pose 0."""
        result, robust = self.gauged(), set(loops.tolist())
        between = gtsam.BetweenFactorPose2 if self.graph.dimension == 2 else gtsam.BetweenFactorPose3
        for edge, factor in enumerate(self.whole):
            if edge not in robust:
                result.add(factor)
                continue
            noise = gtsam.noiseModel.Robust.Create(estimator, factor.noiseModel())
            result.add(between(int(self.graph.a[edge]), int(self.graph.b[edge]), factor.measured(), noise))
        return result

    def loose(self, weight: Floats) -> Ints:
        """First poses of what no edge of positive weight (E,) joins to pose 0; such parts stay where they are."""
        if not self.piece.any():
            return np.empty(0, np.int64)
        on = weight > 0
        joined = parts(int(self.piece.max()) + 1, self.piece[self.graph.a[on]], self.piece[self.graph.b[on]])
        _, first = np.unique(joined[self.piece], return_index=True)
        return first[1:]

    def gauged(self, loose: Ints | tuple[()] = ()) -> gtsam.NonlinearFactorGraph:
        """No edges yet, pose 0 held at the origin and loose ones where the graph has them from there."""
        result = gtsam.NonlinearFactorGraph()
        world = self.graph.world_from_body
        held = [0, *loose]
        planar = self.graph.dimension == 2
        noise = gtsam.noiseModel.Isotropic.Sigma(3 if planar else 6, GAUGE_SIGMA)
        prior = gtsam.PriorFactorPose2 if planar else gtsam.PriorFactorPose3
        places = as_gtsam(geometry.between(world[:1], world[held]), self.graph.dimension)
        for node, pose in zip(held, places, strict=True):
            result.add(prior(int(node), pose, noise))
        return result


def least_squares(
    factors: Factors, weighted: gtsam.NonlinearFactorGraph, start: Floats, max_iterations: int, tolerance: float
) -> Fit:
    """The least error of a graph of these factors from poses `start` (N, 4, 4), pose 0 staying where it is.

    Gauss-Newton as long as its steps help, which is half the work of Levenberg-Marquardt, then that. Ends when a step
    gains less than `tolerance` of the error. Raises GraphError where the poses are not determined.
    """
    values = as_values(geometry.between(start[:1], start), factors.graph.dimension)
    steps, converged = 0, False
    try:
        quick = gtsam.GaussNewtonOptimizer(weighted, values, gtsam.GaussNewtonParams())
        least, gain = quick.error(), 0.0
        while steps < max_iterations and not converged:
            quick.iterate()
            steps += 1
            before, gain = gain, least - quick.error()
            # a step gains at most as much less than the one before as that did: the next is not worth its time
            coming = gain * gain / before if 0 < gain < before else abs(gain)
            converged = min(abs(gain), coming) <= tolerance * max(least, 1.0)
            if not (gain >= 0 or converged):  # NaN too
                break
            # a copy: what the optimiser returns is its own, and is gone after its next step
            values, least = gtsam.Values(quick.values()), quick.error()
    except RuntimeError:  # too weakly determined for an undamped step
        steps, converged = 0, False
    try:
        if not converged and steps < max_iterations:
            settings = gtsam.LevenbergMarquardtParams()
            settings.setMaxIterations(max_iterations - steps)
            settings.setRelativeErrorTol(tolerance)
            settings.setAbsoluteErrorTol(tolerance)
            careful = gtsam.LevenbergMarquardtOptimizer(weighted, values, settings)
            values = careful.optimize()
            steps += int(careful.iterations())
            converged = steps < max_iterations
        poses = as_array(values, factors.graph.dimension)
    except RuntimeError as error:
        first = str(error).strip().splitlines()[0] if str(error).strip() else "no reason given"
        raise GraphError(f"The pose graph cannot be solved ({first}). Check the information of its edges.") from None
    if not np.isfinite(poses).all():
        raise GraphError("The pose graph's solution is not finite. Check the information of its edges.")
    return Fit(anchored(poses, start[0]), steps, converged)


def as_gtsam(poses: Floats, dimension: int) -> list[Any]:
    """Pose3, or Pose2 of planar poses."""
    if dimension == 3:
        return [gtsam.Pose3(pose) for pose in poses]
    yaw = np.arctan2(poses[:, 1, 0], poses[:, 0, 0])
    return [gtsam.Pose2(*row) for row in np.stack([poses[:, 0, 3], poses[:, 1, 3], yaw], axis=1).tolist()]


def as_values(poses: Floats, dimension: int) -> gtsam.Values:
    values = gtsam.Values()
    for node, pose in enumerate(as_gtsam(poses, dimension)):
        values.insert(node, pose)
    return values


def as_array(values: gtsam.Values, dimension: int) -> Floats:
    """(N, 4, 4) of the poses 0..N-1."""
    if dimension == 3:
        rows = gtsam.utilities.extractPose3(values)  # (N, 12): rotation by rows, then translation
        return geometry.pose(rows[:, :9].reshape(-1, 3, 3), rows[:, 9:])
    x, y, yaw = gtsam.utilities.extractPose2(values).T
    zero = np.zeros(len(x))
    return geometry.pose(geometry.so3_exp(np.stack([zero, zero, yaw], axis=1)), np.stack([x, y, zero], axis=1))


def anchored(poses: Floats, world_from_first: Floats) -> Floats:
    """The poses (N, 4, 4) moved as one so that the first is exactly where asked."""
    moved = world_from_first @ geometry.inverse(poses[0]) @ poses
    moved[0] = world_from_first
    return moved
