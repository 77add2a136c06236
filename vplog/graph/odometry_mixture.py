"""Mixture of true and false closures by their distance to the odometry, with the scales of the noise."""

from __future__ import annotations

import math

import numpy as np

from vplog.data import Bools, Floats, Ints, PoseGraph
from vplog.graph.build import AXES, informed
from vplog.graph.consistency import OdometryChain, residual_twists
from vplog.graph.evidence import log_room, runs
from vplog.graph.variance_components import Sigmas, claimed_times

_ODOMETRY = 2.0 ** np.arange(-5, 6)
_CLOSURES = 2.0 ** np.arange(-1, 4)
"""Factors of sigmas tried. 20 closures do not tell a factor more finely than by two."""
_ROTATION = 4.0 ** np.arange(-2, 3)
"""Factors of the rotation's sigma beside that of the translation."""
_MOST = 3
"""Modes that are worth a solve."""


def modes(graph: PoseGraph, loops: Ints, chain: OdometryChain) -> list[tuple[Sigmas, Bools]]:
    """Sigmas at which closures `loops` (K,) are likely, most likely ones first, and which of them are true by each.

    A true closure is off the odometry by N(0, s^2 C + t^2 R), C what the chain of odometry from a to b adds up to, R
    its own noise; a false one is uniform over the box that the odometry spans and all rotations. The share of true ones
    is found by expectation maximisation (Lee, Fraundorfer and Pollefeys, IROS 2013) for each s and t; neighbouring
    closures, which share the drift, count by the root of their number. Closures are true where odometry does not lead
    from one end to the other. `chain` is the graph's.
    """
    known = chain.part[graph.a[loops]] == chain.part[graph.b[loops]]
    if not known.any():
        return [(Sigmas(), np.ones(len(loops), bool))]
    fits = np.empty((len(_ROTATION), len(_ODOMETRY)), object)
    for k, rotation in enumerate(_ROTATION.tolist()):
        present = claimed_times(graph, Sigmas(rotation=rotation)) if rotation != 1.0 else graph
        mixture = _Mixture(present, loops[known], OdometryChain.of(present) if rotation != 1.0 else chain)
        for n, s in enumerate(_ODOMETRY.tolist()):
            tried = (mixture.fit(Sigmas(rotation * s, s, t, t)) for t in _CLOSURES.tolist())
            fits[k, n] = max(tried, key=lambda fit: fit[0])
    likelihood = np.array([[fit[0] for fit in row] for row in fits])
    around = np.pad(likelihood, 1, constant_values=-np.inf)
    windows = np.lib.stride_tricks.sliding_window_view(around, (3, 3))
    peaks = np.argwhere(likelihood >= windows.max((2, 3))).tolist()
    found = []
    for k, n in sorted(peaks, key=lambda at: -likelihood[at[0], at[1]])[:_MOST]:
        true = np.ones(len(loops), bool)
        true[known] = fits[k, n][2] > 0.5
        found.append((fits[k, n][1], true))
    return found


class _Mixture:
    """Mixture of true and false closures, whitened, as a function of the sigmas."""

    def __init__(self, graph: PoseGraph, loops: Ints, chain: OdometryChain) -> None:
        axes = AXES[graph.dimension]
        a, b = graph.a[loops], graph.b[loops]
        error = residual_twists(graph, chain.poses, loops)[:, axes]
        # with both covariances diagonal, a scale costs one division: whiten by the closure's, turn to the chain's axes
        root = np.swapaxes(np.linalg.cholesky(informed(graph, loops)), 1, 2)
        spread, turn = np.linalg.eigh(root @ chain.covariance(a, b) @ np.swapaxes(root, 1, 2))
        self._spread = np.maximum(spread, 0.0)
        self._error2 = (np.swapaxes(turn, 1, 2) @ (root @ error[:, :, None]))[:, :, 0] ** 2
        self._log_volume = np.log(np.abs(np.linalg.det(root)))
        self._false = -log_room(graph, chain.poses)
        size = {edge: len(run) for run in runs(graph, loops) for edge in run.tolist()}
        self._counts = np.array([size[edge] for edge in loops.tolist()]) ** -0.5

    def fit(self, sigmas: Sigmas) -> tuple[float, Sigmas, Floats]:
        """Log likelihood with the prior of these sigmas, and the probability of each closure (K,) to be true."""
        variance = sigmas.translation**2 * self._spread + sigmas.closure_translation**2
        true = self._log_volume - 0.5 * (self._error2 / variance + np.log(2.0 * np.pi * variance)).sum(1)
        share, least = 0.5, 1.0 / (2.0 * len(true))  # half a closure, so that no share is 0 or 1
        sure = np.zeros(len(true))
        for _ in range(30):
            odds = np.exp(np.clip(math.log(share / (1.0 - share)) + true - self._false, -700.0, 700.0))
            sure = odds / (1.0 + odds)
            before = share
            share = float(np.clip(self._counts @ sure / self._counts.sum(), least, 1.0 - least))
            if abs(share - before) < 1e-3 * min(share, 1.0 - share):
                break
        each = np.logaddexp(math.log(share) + true, math.log(1.0 - share) + self._false)
        return float(self._counts @ each) + sigmas.log_prior(), sigmas, sure
