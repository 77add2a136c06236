"""Mixture of true and false closures by their distance to the odometry, with the scales of the noise."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import TYPE_CHECKING

import numpy as np

from vplog.geometry import se3
from vplog.graph.build import AXES, informed
from vplog.graph.consistency import OdometryChain

if TYPE_CHECKING:
    from vplog.data import Floats, Ints, PoseGraph

_RANGE = (2.0**-6, 2.0**3)
"""Scales searched. Claimed noise is often far too large; at eight times it true closures spread as false ones."""
_COARSE, _FINE = 4.0, 2.0**0.5
"""Factors between scales, first and last: 20 closures do not tell a scale more finely."""
_LEAST_SIDE = 0.1
"""Shortest side of the box of places as a share of its longest: a flat drive still has false closures off its plane."""


@dataclass(frozen=True, eq=False)
class Agreement:
    """A mixture of true and false closures, fitted to how far each is from the odometry alone."""

    probability: Floats
    """(K,) that a closure is true; 1 where odometry does not lead from one end to the other, so that it cannot tell."""
    odometry_scale: float
    """Sigma of the odometry as a multiple of what its information says."""
    loop_scale: float
    """Sigma of the closures as a multiple of what their information says."""
    share: float
    """Share of true closures, 0..1."""
    log_room: float
    """Log of the volume that false closures are spread over, in m and rad."""


def agreement(graph: PoseGraph, loops: Ints, chain: OdometryChain | None = None) -> Agreement:
    """Fit the mixture to the closures `loops` (K,) of the graph, by greatest likelihood.

    A true closure is off the odometry by N(0, s^2 C + t^2 R), C what the chain of odometry from a to b adds up to, R
    its own noise; a false one is uniform over the box that the odometry spans and all rotations. The scales s and t are
    searched and the share of true ones is found by expectation maximisation (Lee, Fraundorfer and Pollefeys, IROS
    2013), so neither too large nor too small a claimed noise decides. `chain` is the graph's where it is at hand.
    """
    chain = chain or OdometryChain.of(graph)
    room = _log_volume(chain.poses[:, :3, 3], graph.dimension)
    known = chain.part[graph.a[loops]] == chain.part[graph.b[loops]]
    probability = np.ones(len(loops))
    if not known.any():
        return Agreement(probability, 1.0, 1.0, 1.0, room)
    axes = AXES[graph.dimension]
    a, b, measured = graph.a[loops[known]], graph.b[loops[known]], graph.a_from_b[loops[known]]
    error = se3.log(se3.between(measured, se3.between(chain.poses[a], chain.poses[b])))[:, axes]
    # with both covariances diagonal, a scale costs one division: whiten by the closure's, turn to the chain's axes
    root = np.swapaxes(np.linalg.cholesky(informed(graph)[loops[known]]), 1, 2)
    spread, turn = np.linalg.eigh(root @ chain.covariance(a, b) @ np.swapaxes(root, 1, 2))
    error2 = (np.swapaxes(turn, 1, 2) @ (root @ error[:, :, None]))[:, :, 0] ** 2
    log_volume = np.log(np.abs(np.linalg.det(root)))
    false = -room

    def fit(s: float, t: float, share: float) -> tuple[float, float, Floats]:
        """Log likelihood, share of true ones, and their probabilities at these scales."""
        variance = s**2 * np.maximum(spread, 0.0) + t**2
        true = log_volume - 0.5 * (error2 / variance + np.log(2.0 * np.pi * variance)).sum(1)
        sure = np.zeros(len(true))
        least = 1.0 / (2.0 * len(true))  # half a closure, so that no share is 0 or 1
        for _ in range(50):
            odds = np.exp(np.clip(math.log(share / (1.0 - share)) + true - false, -700.0, 700.0))
            sure = odds / (1.0 + odds)
            before, share = share, float(np.clip(sure.mean(), least, 1.0 - least))
            if abs(share - before) < 1e-3 * min(share, 1.0 - share):
                break
        return float(np.logaddexp(math.log(share) + true, math.log(1.0 - share) + false).sum()), share, sure

    step = _COARSE
    ladder = [_RANGE[0] * step**rung for rung in range(round(math.log(_RANGE[1] / _RANGE[0], step)) + 1)]
    tried = {(s, t): fit(s, t, 0.5) for s in ladder for t in ladder}
    best = max(tried, key=lambda scales: tried[scales][0])
    while step > _FINE:
        step = math.sqrt(step)
        around = [(best[0] * step**i, best[1] * step**j) for i in (-1, 0, 1) for j in (-1, 0, 1)]
        inside = [scales for scales in around if all(_RANGE[0] <= one <= _RANGE[1] for one in scales)]
        tried = {best: tried[best]} | {scales: fit(*scales, tried[best][1]) for scales in inside if scales != best}
        best = max(tried, key=lambda scales: tried[scales][0])
    _, share, probability[known] = tried[best]
    return Agreement(probability, float(best[0]), float(best[1]), share, room)


def _log_volume(places: Floats, dimension: int) -> float:
    """Log of how many relative poses there are between places (N, 3): metres cubed times 8 pi^2, or squared times 2 pi.

    8 pi^2 is the volume of the rotations in units of small rotation vectors.
    """
    side = 2.0 * np.ptp(places, axis=0)[:dimension]
    side = np.maximum(side, max(_LEAST_SIDE * side.max(), 1e-6))
    return float(np.log(side).sum()) + math.log(2.0 * math.pi if dimension == 2 else 8.0 * math.pi**2)
