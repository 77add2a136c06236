"""The volumes over which false closures are spread."""

from __future__ import annotations

import math

import numpy as np

from vplog.data import Floats, Ints, PoseGraph
from vplog.geometry import se3
from vplog.graph.build import AXES, informed
from vplog.graph.consistency import LOG_2PI, is_loop

_REACH = 3
"""Keyframes over which views see the same things."""
_SAMPLE = 100
"""Number of poses whose pairs are compared."""
_LEAST_SIDE = 0.1
"""Shortest side of the box of positions as a share of its longest: a flat drive has false closures off its plane."""
_LEAST_SIDE_M = 5.0
"""Shortest side in m: a camera that hardly moves sees as far, and may take any part of what it sees for another one."""
_VIEW_RAD = 0.2
_VIEW_M = 0.5
"""Rotation and translation that SIFT features tolerate."""


def log_false_volumes(graph: PoseGraph, places: Floats) -> tuple[float, float]:
    """Return the logs of the volumes, in m^d rad^d, over which a false closure of this graph is spread: if it may pair
    any two poses, and if its poses are given.

    A false closure pairs any two of the poses `places` (N, 4, 4), a true one two that see the same place. Its relative
    pose is distributed like those of the other closures, because verification accepts nothing else. Both volumes are at
    most the box of positions times the volume of all rotations (8 pi^2, or 2 pi in the plane).
    """
    side = 2.0 * np.ptp(places[:, :3, 3], axis=0)[: graph.dimension]
    box = float(np.log(np.maximum(side, max(_LEAST_SIDE * side.max(), _LEAST_SIDE_M))).sum())
    box += math.log(2.0 * math.pi if graph.dimension == 2 else 8.0 * math.pi**2)
    loops = np.flatnonzero(is_loop(graph))
    axes = np.array(AXES[graph.dimension])
    if len(loops) <= 2 * len(axes):
        return box, box
    covariance, gap = _view_covariance(graph, loops, places), _smallest_gap(graph, loops)
    entropy = 0.5 * (len(axes) * (LOG_2PI + 1.0) + float(np.linalg.slogdet(covariance)[1]))  # of a Gaussian
    variance = np.array([np.diag(covariance)[axes < 3].mean(), np.diag(covariance)[axes >= 3].mean()])
    pairs = len(places) ** 2 / 2.0
    log_pairs = math.log(pairs / max(len(loops), pairs * _share_near(places, variance, gap)))
    return min(box, log_pairs + entropy), min(box, entropy)


def _smallest_gap(graph: PoseGraph, loops: Ints) -> int:
    return int(np.abs(graph.a[loops].astype(np.int64) - graph.b[loops]).min())


def _view_covariance(graph: PoseGraph, loops: Ints, places: Floats) -> Floats:
    """Covariance (d, d) of the relative pose of two keyframes that see one place, by the edges `loops` (K,)."""
    axes = np.array(AXES[graph.dimension])
    back = (graph.a[loops] > graph.b[loops])[:, None, None]
    relative = np.where(back, se3.inverse(graph.a_from_b[loops]), graph.a_from_b[loops])
    covariance = np.linalg.inv(informed(graph, loops)).mean(0) + np.diag(_view_sigmas(places)[axes] ** 2)
    return covariance + np.cov(se3.log(relative)[:, axes].T)


def _share_near(places: Floats, variance: Floats, gap: int) -> float:
    """Share of the pairs of poses (N, 4, 4), at least `gap` rows apart, that are as near as closures are: within sigmas
    of the variances (2,) of rotation vectors and translations per axis."""
    stride = -(-len(places) // _SAMPLE)
    R, t = places[::stride, :3, :3], places[::stride, :3, 3]
    first, second = np.triu_indices(len(R), max(gap // stride, 1))
    if not len(first):
        return 0.0
    cosine = 0.5 * (np.einsum("nij,nij->n", R[first], R[second]) - 1.0)
    angle2 = np.arccos(np.clip(cosine, -1.0, 1.0)) ** 2
    distance2 = ((t[first] - t[second]) ** 2).sum(1)
    return float((angle2 / variance[0] + distance2 / variance[1] <= 6.0).mean())


def _view_sigmas(places: Floats) -> Floats:
    """Standard deviations (6,) of the relative poses, rad and m, from which views of one place are recognised at least.

    Poses (N, 4, 4) of a drive may not have them: a robot on wheels never tilts by what features tolerate.
    """
    step = np.linalg.norm(np.diff(places[:, :3, 3], axis=0), axis=1)
    reach = _REACH * float(np.median(step)) if len(step) else 0.0
    sample = places[:: -(-len(places) // _SAMPLE)]
    first, second = np.triu_indices(len(sample), 1)
    relative = se3.log(se3.between(sample[first], sample[second]))
    most = np.sqrt((relative**2).mean(0)) if len(first) else np.full(6, np.inf)
    return np.minimum(np.repeat([_VIEW_RAD, max(reach, _VIEW_M)], 3), most)
