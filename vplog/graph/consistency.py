"""Whether the edges of a graph agree with its poses, with each other and with their noise."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from vplog import geometry
from vplog.data import EdgeKind

if TYPE_CHECKING:
    from numpy.typing import NDArray

    from vplog.data import Floats, Ints, PoseGraph, Solution

    Bools = NDArray[np.bool_]

_SURE = 0.999999
"""Probability with which odometry as good as its noise says passes keep_odometry_if_worse: 6.2 sigma for one loop."""


def residual_sigma(graph: PoseGraph, world_from_body: Floats) -> Floats:
    """Mahalanobis distance (E,) of each edge to the poses (N, 4, 4): sqrt(e^T information e), e as GTSAM's Pose3."""
    a_from_b = geometry.between(world_from_body[graph.a], world_from_body[graph.b])
    error = geometry.log(geometry.between(graph.a_from_b, a_from_b))
    return np.sqrt(np.maximum(np.einsum("ei,eij,ej->e", error, graph.information, error), 0.0))


def residual_before(graph: PoseGraph) -> Floats:
    """Mahalanobis distance (E,) of each loop to the odometry alone; 0 for odometry edges.

    The noise is the loop's plus what the odometry accumulates from a to b: covariances add along the chain when each
    is moved to one frame by the adjoint, to first order, so a running sum answers every loop at once (Barfoot and
    Furgale 2014, eq. 55, second order). NaN where odometry edges do not lead from a to b.
    """
    result = np.zeros(len(graph.a))
    loops = np.flatnonzero([kind == EdgeKind.LOOP for kind in graph.kind])
    if len(loops) == 0:
        return result
    poses, leads = odometry_chain(graph)
    step = np.linalg.inv(graph.information[leads])
    step[leads < 0] = 0.0
    # about the first pose, so that the sums stay small where the odometry's frame is far away, as UTM is
    moved = geometry.adjoint(geometry.between(poses[:1], poses))
    total = np.cumsum(moved @ step @ np.swapaxes(moved, 1, 2), axis=0)
    part = np.cumsum(leads < 0)

    a, b = graph.a[loops], graph.b[loops]
    back = geometry.adjoint(geometry.between(poses[b], poses[:1]))
    sign = np.where(a < b, 1.0, -1.0)[:, None, None]  # a loop may be written either way round
    covariance = back @ (sign * (total[b] - total[a])) @ np.swapaxes(back, 1, 2)
    covariance = covariance + np.linalg.inv(graph.information[loops])
    error = geometry.log(geometry.between(graph.a_from_b[loops], geometry.between(poses[a], poses[b])))
    chi2 = (error * np.linalg.solve(covariance, error[:, :, None])[:, :, 0]).sum(1)
    result[loops] = np.where(part[a] == part[b], np.sqrt(np.maximum(chi2, 0.0)), np.nan)
    return result


def odometry_chain(graph: PoseGraph) -> tuple[Floats, Ints]:
    """Poses (N, 4, 4) by the odometry edges alone, and the odometry edge (N,) that leads to each pose, -1 for none.

    A pose without an edge from its predecessor (a second robot, a gap) stays at its initial place.
    """
    edges = np.flatnonzero([kind == EdgeKind.ODOMETRY for kind in graph.kind])
    edges = edges[graph.b[edges] == graph.a[edges] + 1][::-1]  # reversed: the first of several wins
    leads = np.full(len(graph.world_from_body), -1)
    leads[graph.b[edges]] = edges
    poses = np.array(graph.world_from_body)
    for node in np.flatnonzero(leads >= 0):
        poses[node] = poses[node - 1] @ graph.a_from_b[leads[node]]
    return poses, leads


def far_from_odometry(graph: PoseGraph, probability: float) -> Bools:
    """Loops (E,) whose distance to the odometry alone is beyond what noise reaches with this probability."""
    bound = chi2_quantile(probability, 6)
    return np.asarray(np.nan_to_num(residual_before(graph)) ** 2 > bound)


def keep_odometry_if_worse(graph: PoseGraph, solution: Solution) -> Solution:
    """The solution, or the odometry poses where the solution bends the odometry more than its noise allows.

    Odometry alone has no residual. Each of the L closures kept can bend it by its 6 degrees of freedom, and if all are
    true, the sum of chi-squares over the M odometry edges stays below the 0.999999 quantile of chi-square with
    6 min(L, M) degrees of freedom. Beyond it either false closures were believed or the noise is far too small: in
    both cases the poses cannot be trusted.
    """
    odometry = np.array([kind == EdgeKind.ODOMETRY for kind in graph.kind])
    dof = 6 * min(int(odometry.sum()), int((solution.weight[~odometry] > 0.5).sum()))
    if dof == 0:
        return solution
    chi2 = float((residual_sigma(graph, solution.world_from_body)[odometry] ** 2).sum())
    bound = chi2_quantile(_SURE, dof)
    if chi2 <= bound:
        return solution
    return replace(
        solution,
        world_from_body=odometry_chain(graph)[0],
        weight=np.where(odometry, 1.0, 0.0),
        error_before=0.0,
        error_after=0.0,
        reason=f"Odometry was kept: {dof // 6} closures bend it to a chi-square of {chi2:.4g} where its noise allows "
        f"{bound:.4g}, so some are false or the noise is too small.",
    )


def chi2_quantile(probability: float, dof: int) -> float:
    """Value that chi-square with an even `dof` stays below with this probability.

    Its upper tail is that of a Poisson count: P(chi2 > x) = sum over i < dof / 2 of exp(-x / 2) (x / 2)^i / i!
    (Abramowitz and Stegun, 26.4.21), inverted by bisection.
    """
    count = np.arange(dof // 2)
    log_factorial = np.concatenate([[0.0], np.cumsum(np.log(count[1:]))])

    def tail(x: float) -> float:
        return float(np.exp(count * math.log(x / 2.0) - log_factorial - x / 2.0).sum())

    low, high = 1e-9, 2.0 * dof + 100.0  # beyond every probability that a float can tell from 1
    while high - low > 1e-12 * high:
        middle = (low + high) / 2.0
        if tail(middle) > 1.0 - probability:
            low = middle
        else:
            high = middle
    return high
