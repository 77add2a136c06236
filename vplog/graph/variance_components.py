"""Variance factors of odometry and closures, estimated with the solution, with the log's claims as a prior.

Foerstner, Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten, 1979.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import NamedTuple

import numpy as np
from scipy.special import wrightomega

from vplog.data import Bools, Floats, PoseGraph
from vplog.errors import GraphError
from vplog.geometry import se3
from vplog.graph.build import AXES, informed
from vplog.graph.consistency import degrees_of_freedom, residual_twists
from vplog.graph.least_squares import Objective
from vplog.graph.marginals import edge_covariances

_SPREAD = 2.0 * math.log(2.0)
"""Sigma of the logarithm of a variance factor before anything was measured: drivers claim sigmas that are off by two to
four and, now and then, by ten."""
_MOST_NOISE = 0.5
"""Sigma of odometry over its motion from one keyframe to the next."""


class Sigmas(NamedTuple):
    """Factors by which claimed sigmas are multiplied: rotation and translation of odometry, and of closures."""

    rotation: float = 1.0
    translation: float = 1.0
    closure_rotation: float = 1.0
    closure_translation: float = 1.0

    def log_prior(self) -> float:
        """Log of the prior density but for a constant: normal in the logarithm of each variance."""
        return -sum((2.0 * math.log(sigma) / _SPREAD) ** 2 for sigma in self) / 2.0

    def differ(self, other: Sigmas, by: float) -> bool:
        """Whether one of them is more than this share off its counterpart."""
        return any(abs(math.log(one / two)) > by for one, two in zip(self, other, strict=True))


def most_likely_variance(chi2: float, redundancy: float) -> float:
    """The variance factor of greatest posterior density for this chi-square by the claims.

    It maximises -r u / 2 - chi2 exp(-u) / 2 - u^2 / (2 _SPREAD^2) over u = log variance; Wright's omega function solves
    that in closed form.
    """
    expected = 0.5 * redundancy * _SPREAD**2
    u = float(wrightomega(math.log(0.5 * chi2 * _SPREAD**2 + 1e-300) + expected)) - expected
    return math.exp(u)


def claimed_times(graph: PoseGraph, sigmas: Sigmas) -> PoseGraph:
    """The graph with its sigmas multiplied."""
    odometry, closures = np.repeat(sigmas, 3).reshape(2, 6)
    factor = np.where(graph.odometry[:, None], odometry, closures)
    return replace(graph, information=graph.information / (factor[:, :, None] * factor[:, None, :]))


def estimate(objective: Objective, poses: Floats, present: Sigmas) -> Sigmas:
    """The sigmas of greatest posterior density at the least squares `poses` under the `present` ones.

    `objective.factors.graph` has the present sigmas. What closures and fixes do not check of the odometry, the closures
    have for themselves.
    """
    graph, weight = objective.factors.graph, objective.weight
    loops = ~graph.odometry & (weight > 0)
    closures_dof = float(degrees_of_freedom(graph) * weight[loops].sum())
    most = closures_dof
    if objective.positions is not None:
        most += 3.0 * np.count_nonzero(objective.positions.Omega.any((1, 2)))
    (chi2, checks), (closures, own) = _of_parts(objective, poses, [graph.odometry, loops])
    checks *= min(1.0, most / max(checks.sum(), 1e-12))
    rest = closures_dof * (1.0 - checks.sum() / max(most, 1.0))
    own = np.array([min(own[0], rest), max(rest - own[0], 0.0)])  # that of translations drowns in rounding
    parts = zip(np.append(chi2, closures), np.append(checks, own), present, strict=True)
    found = [math.sqrt(most_likely_variance(chi2 * factor**2, redundancy)) for chi2, redundancy, factor in parts]
    most_noise = np.maximum(np.array(present[:2]) * _most_factors(graph), 1.0)  # the claim itself is always possible
    return Sigmas(*np.minimum(found, [*most_noise, math.inf, math.inf]).tolist())


def _most_factors(graph: PoseGraph) -> list[float]:
    """Most that the factors of rotation and translation can be: what odometry measures is motion and noise, and where
    more than `_MOST_NOISE` of its root mean square is noise, it is none."""
    edges = np.flatnonzero(graph.odometry)
    axes = np.array(AXES[graph.dimension])
    motion = se3.log(graph.a_from_b[edges])[:, axes]
    covariance = np.asarray(np.linalg.inv(informed(graph, edges)), np.float64)
    found = []
    for part in (axes < 3, axes >= 3):
        chi2 = se3.mahalanobis2(motion[:, part], covariance[:, part][:, :, part])
        share = math.sqrt(float(chi2.mean()) / int(part.sum())) if len(edges) else math.inf
        found.append(_MOST_NOISE * share)
    return found


def _of_parts(objective: Objective, poses: Floats, kinds: list[Bools]) -> list[tuple[Floats, Floats]]:
    """Weighted chi-square and redundancy of the rotations and of the translations of each kind of edges (E,), (2,)
    each."""
    graph = objective.factors.graph
    axes = np.array(AXES[graph.dimension])
    edges = np.flatnonzero(np.logical_or.reduce(kinds))
    weight = objective.weight[edges]
    claimed = np.linalg.inv(informed(graph, edges))
    error = residual_twists(graph, poses, edges)
    chi2, trusted = np.zeros((2, len(edges))), np.zeros((2, len(edges)))
    try:
        solved = edge_covariances(objective, poses, edges)
    except GraphError:  # noise so large that rounding decides
        solved = np.zeros_like(claimed)
    parts = axes < 3, axes >= 3
    for number, part in enumerate(parts):  # of correlated noise, the marginal of each
        Omega = np.linalg.inv(claimed[:, part][:, :, part])
        e = error[:, axes[part]]
        chi2[number] = np.einsum("ni,nij,nj->n", e, Omega, e)
        trusted[number] = np.einsum("nij,nji->n", Omega, solved[:, part][:, :, part])
    size = np.array([int(part.sum()) for part in parts])
    found = []
    for kind in kinds:
        own = kind[edges] * weight
        checked = own.sum() * size - (own * trusted).sum(1)
        found.append(((own * chi2).sum(1), np.maximum(checked, 0.0)))
    return found
