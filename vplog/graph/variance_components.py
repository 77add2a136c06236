"""Variance factors of odometry and closures, estimated with the solution, with the log's claims as a prior.

Foerstner, Ein Verfahren zur Schaetzung von Varianz- und Kovarianzkomponenten, 1979.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vplog.errors import GraphError
from vplog.graph.consistency import degrees_of_freedom, is_loop, redundancy, residual_sigma

if TYPE_CHECKING:
    from vplog.data import Floats
    from vplog.graph.least_squares import Objective

_SPREAD = 2.0 * math.log(4.0)
"""Sigma of the logarithm of a variance factor before anything was measured: drivers claim sigmas that are off by four
and, now and then, by ten."""
_LEAST_CLOSURES = 0.5
"""Closures are not taken for much better than they claim: those of neighbouring keyframes share landmarks, so they
agree with each other more than they are right."""
_LEAST = 2.0**-10
"""Variance factor beyond which, and beyond whose inverse, a claim is no longer one: 32 times in sigma."""
_STEPS = 30
"""Most Newton steps in one dimension; 5 are usual."""


class Sigmas(NamedTuple):
    """Factors by which claimed sigmas are multiplied."""

    odometry: float = 1.0
    closures: float = 1.0

    def log_prior(self) -> float:
        """Log of the prior density but for a constant: normal in the logarithm of each variance."""
        return -sum((2.0 * math.log(sigma) / _SPREAD) ** 2 for sigma in self) / 2.0

    def differ(self, other: Sigmas, by: float) -> bool:
        """Whether one of them is more than this share off its counterpart."""
        return any(abs(math.log(one / two)) > by for one, two in zip(self, other, strict=True))


def most_likely_variance(chi2: float, redundancy: float) -> float:
    """The variance factor of greatest posterior density for this chi-square by the claims.

    It maximises -r u / 2 - chi2 exp(-u) / 2 - u^2 / (2 _SPREAD^2) over u = log variance, which is concave.
    """
    u = 0.0
    for _ in range(_STEPS):
        pull = 0.5 * chi2 * math.exp(-u)
        step = (pull - 0.5 * redundancy - u / _SPREAD**2) / (pull + 1.0 / _SPREAD**2)
        u += min(max(step, -1.0), 3.0)
        if abs(step) < 1e-6:
            break
    return min(max(math.exp(u), _LEAST), 1.0 / _LEAST)


def estimate(objective: Objective, poses: Floats, present: Sigmas) -> Sigmas:
    """The sigmas of greatest posterior density at the least squares `poses` under the `present` ones.

    `objective.factors.graph` has the present sigmas. What closures and fixes do not check of the odometry, the closures
    have for themselves.
    """
    graph, weight = objective.factors.graph, objective.weight
    loops = is_loop(graph)
    chi2 = weight * residual_sigma(graph, poses) ** 2
    dof = degrees_of_freedom(graph)
    most = float(dof * np.count_nonzero(weight[loops]))
    if objective.positions is not None:
        most += 3.0 * np.count_nonzero(objective.positions.Omega.any((1, 2)))
    try:
        checks = redundancy(objective, poses, np.flatnonzero(~loops))
    except GraphError:  # noise so large that rounding decides
        checks = most
    checks = min(max(checks, 0.0), most, float(dof * (~loops).sum()))
    own = max(float(dof * np.count_nonzero(weight[loops])) - checks, 0.0)
    if objective.positions is not None:
        own = max(float(dof * np.count_nonzero(weight[loops])) * (1.0 - checks / max(most, 1.0)), 0.0)
    return Sigmas(
        math.sqrt(most_likely_variance(float(chi2[~loops].sum()) * present.odometry**2, checks)),
        max(math.sqrt(most_likely_variance(float(chi2[loops].sum()) * present.closures**2, own)), _LEAST_CLOSURES),
    )
