"""Leave-one-out cost of each closure in a solved graph.

The cost is by how much the chi-square of all other edges falls without the closure: its squared distance to the
prediction of the others, in units of the prediction's and its own noise (the externally studentised residual; Baarda's
data snooping, 1968).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vplog.data import Floats, Ints, PoseGraph
from vplog.geometry import se3
from vplog.graph.build import AXES, informed
from vplog.graph.consistency import residual_twists
from vplog.graph.least_squares import Objective
from vplog.graph.marginals import edge_covariances

if TYPE_CHECKING:
    from vplog.graph.factors import Factors

_LEAST_REDUNDANCY = 1e-9
"""Least redundancy of a closure, so that no quotient is infinite."""


@dataclass(frozen=True, eq=False)
class Tension:
    """Leave-one-out statistics of K closures in a solved graph."""

    cost: Floats
    """(K,) by how much chi-square falls without the closure, to first order."""
    whitened: Floats
    """(K, d) residuals in sigma, along axes on which the noise of the rest's prediction is independent."""
    whitener: Floats
    """(K, d, d) matrices that turn a residual into a whitened one."""
    redundancy: Floats
    """(K, d) share of a closure's error that its residual shows along these axes: 0 where nothing else checks it."""
    log_spread: Floats
    """(K,) half the log determinant of the covariance of the rest's prediction and the closure's noise together."""


def tension(factors: Factors, weight: Floats, poses: Floats, loops: Ints) -> Tension:
    """Leave-one-out statistics of closures `loops` (K,) of positive weight at the least squares solution `poses`.

    Raises GraphError where the poses are not determined.
    """
    graph = factors.graph
    axes = AXES[graph.dimension]
    error, Jr_inv = errors(graph, poses, loops)
    covariance = Jr_inv @ edge_covariances(Objective(factors, weight), poses, loops) @ np.swapaxes(Jr_inv, 1, 2)
    information = informed(graph, loops) * weight[loops, None, None]
    root = np.swapaxes(np.linalg.cholesky(information), 1, 2)
    # leverage: 1 where nothing else constrains the ends of the closure
    leverage, turn = np.linalg.eigh(root @ covariance @ np.swapaxes(root, 1, 2))
    rest = np.clip(1.0 - leverage, _LEAST_REDUNDANCY, 1.0)
    whitener = np.swapaxes(turn, 1, 2) @ root
    whitened = (whitener @ error[:, axes, None])[:, :, 0]
    return Tension(
        cost=(whitened**2 / rest).sum(1),
        whitened=whitened,
        whitener=np.asarray(whitener, np.float64),
        redundancy=rest,
        log_spread=-0.5 * (np.linalg.slogdet(information)[1] + np.log(rest).sum(1)),
    )


def distance(factors: Factors, weight: Floats, poses: Floats, loops: Ints) -> tuple[Floats, Floats]:
    """Squared distance (K,) of closures without weight to where the solved graph has them, in sigma, and log_spread."""
    graph = factors.graph
    axes = AXES[graph.dimension]
    # with next to no weight they are in the factorisation, which then knows their covariance, and change nothing
    barely = np.array(weight)
    barely[loops] = 1e-9
    error, Jr_inv = errors(graph, poses, loops)
    covariance = Jr_inv @ edge_covariances(Objective(factors, barely), poses, loops) @ np.swapaxes(Jr_inv, 1, 2)
    covariance = covariance + np.linalg.inv(informed(graph, loops))
    error = error[:, axes]
    return se3.mahalanobis2(error, covariance), 0.5 * np.linalg.slogdet(covariance)[1]


def errors(graph: PoseGraph, poses: Floats, loops: Ints) -> tuple[Floats, Floats]:
    """Residual twists (K, 6), and how they turn with the motion between the ends, (K, d, d).

    The inverse of the right Jacobian of the exponential, by its series (Barfoot 2017, eq. 7.77, with the other sign).
    """
    error = residual_twists(graph, poses, loops)
    ad = np.zeros((len(loops), 6, 6))
    ad[:, :3, :3] = ad[:, 3:, 3:] = se3.skew(error[:, :3])
    ad[:, 3:, :3] = se3.skew(error[:, 3:])
    squared = ad @ ad
    axes = AXES[graph.dimension]
    jacobian = np.eye(6) + ad / 2.0 + squared / 12.0 - squared @ squared / 720.0
    return error, jacobian[:, axes][:, :, axes]
