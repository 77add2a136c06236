"""How well a set of true closures explains all of them: the logarithm of its marginal likelihood.

True closures are measurements of the solved graph; the poses are integrated over (Laplace's approximation, exact where
the graph is linear). False ones come in runs, since neighbouring keyframes look alike: a run measures a place that is
displaced by the same motion, and different runs may share their displacement, as where one aisle is taken for the next.
So a run of false closures is one accident, and so is a family of runs.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from vplog.geometry import se3
from vplog.graph.build import AXES, informed, parts
from vplog.graph.consistency import degrees_of_freedom, is_loop, residual_sigma
from vplog.graph.least_squares import GAUGE_SIGMA, Objective

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vplog.data import Floats, Ints, PoseGraph
    from vplog.graph.consistency import OdometryChain
    from vplog.graph.factors import Factors

_BESIDE = 3
"""Keyframes between neighbours of a run, at both ends: they see the same things."""
_LONGEST = 20
"""Closures of a run that count as one accident; beyond that the view has changed."""
_EARLIER = 200
"""Runs before one that may share its displacement: bounds the pairs of graphs with thousands of false closures."""
_PAIRS = 1 << 12
"""Pairs of runs compared at once: some megabytes."""
_LOG_2PI = math.log(2.0 * math.pi)
_LEAST_SIDE = 0.1
"""Shortest side of the box of places as a share of its longest: a flat drive still has false closures off its plane."""


_LEAST_SIDE_M = 5.0
"""m; a camera that hardly moves sees as much, and takes any of it for another part of it."""


class _Run(NamedTuple):
    """A run of false closures, as one measurement from an earlier to a later pose."""

    a: int
    b: int
    a_from_b: Floats
    covariance: Floats
    """(d, d) in the frame of b."""


def log_evidence(factors: Factors, weight: Floats, poses: Floats, chain: OdometryChain) -> float:
    """Log density of all closures where those of positive weight (E,), 0 or 1, are true.

    `poses` are their least squares, `chain` the graph's odometry.
    """
    graph = factors.graph
    loops = is_loop(graph)
    true, false = np.flatnonzero(loops & (weight > 0)), np.flatnonzero(loops & (weight == 0))
    room = log_room(chain.poses[:, :3, 3], graph.dimension)
    total, accidents = _log_false(graph, false, chain, room)
    places = sum(1 for _ in runs(graph, true))
    # each place is true or an accident, the share of true ones unknown: the beta function
    total += math.lgamma(places + 1) + math.lgamma(accidents + 1) - math.lgamma(places + accidents + 2)
    return total + (_log_true(factors, weight, poses, true, room) if len(true) else 0.0)


def _log_true(factors: Factors, weight: Floats, poses: Floats, true: Ints, room: float) -> float:
    """Log density of the true closures under the odometry: N(0, A C A^T + R) by the matrix determinant lemma."""
    graph = factors.graph
    d = degrees_of_freedom(graph)
    loose = len(factors.loose(weight))
    held = (1 + loose) * d * -2.0 * math.log(GAUGE_SIGMA)
    joined = int(factors.piece.max()) - loose  # pieces of odometry whose place only closures tell
    determinant = Objective(factors, weight).information(poses).log_determinant() - held
    known = np.linalg.slogdet(informed(graph)[weight > 0])[1].sum()
    chi2 = float((weight * residual_sigma(graph, poses) ** 2).sum())
    return float(0.5 * (known - determinant - chi2) - 0.5 * _LOG_2PI * d * (len(true) - joined) - joined * room)


def log_room(places: Floats, dimension: int) -> float:
    """Log of how many relative poses there are between places (N, 3): metres cubed times 8 pi^2, or squared times 2 pi.

    8 pi^2 is the volume of the rotations in units of small rotation vectors.
    """
    side = 2.0 * np.ptp(places, axis=0)[:dimension]
    side = np.maximum(side, max(_LEAST_SIDE * side.max(), _LEAST_SIDE_M))
    return float(np.log(side).sum()) + math.log(2.0 * math.pi if dimension == 2 else 8.0 * math.pi**2)


def runs(graph: PoseGraph, loops: Ints) -> Iterator[Ints]:
    """The edges `loops` (K,) in runs of neighbouring keyframes at both ends, in order."""
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
        for start in range(0, len(run), _LONGEST):
            yield loops[order[run[start : start + _LONGEST]]]


def _log_false(graph: PoseGraph, false: Ints, chain: OdometryChain, room: float) -> tuple[float, int]:
    """Log density of the false closures, and how many runs they are."""
    total, accidents, together = 0.0, 0, []
    for run in runs(graph, false):
        accidents += 1
        inner, one = _as_one(graph, run, chain)
        if one is None or inner < -room * (len(run) - 1):  # they do not agree with each other
            total -= room * len(run)
        else:
            total += inner
            together.append(one)
    return total + _log_displacements(together, chain, room), accidents


def _as_one(graph: PoseGraph, run: Ints, chain: OdometryChain) -> tuple[float, _Run | None]:
    """Log density of the members of a run given a displacement common to them, and the run as one measurement.

    Seen from the middle one's ends, they differ by their own noise and by that of the odometry between them.
    """
    axes, X, size = chain.axes, chain.poses, len(run)
    d = len(axes)
    a, b, measured, noise = forward(graph, run)
    middle = size // 2
    at, to = int(a[middle]), int(b[middle])
    if size == 1:
        return 0.0, _Run(at, to, measured[0], noise[0])
    if (chain.part[a] != chain.part[at]).any() or (chain.part[b] != chain.part[to]).any():
        return 0.0, None
    there = se3.between(X[at][None], X[a]) @ measured @ se3.between(X[b], X[to][None])
    error = se3.log(se3.between(measured[middle][None], there))[:, axes]
    covariance = np.zeros((size, d, size, d))
    from_first = se3.between(X[to], X[0])
    for end, frame in ((b, from_first), (a, se3.inverse(measured[middle]) @ se3.between(X[at], X[0]))):
        Ad = se3.adjoint(frame)[axes][:, axes]
        legs = Ad @ (chain.total[end] - chain.total[end[middle]]) @ Ad.T
        legs, side = np.abs(np.sign(end - end[middle]))[:, None, None] * legs, np.sign(end - end[middle])
        far = np.abs(end - end[middle])
        k, j = np.nonzero(side[:, None] * side > 0)  # members on one side share the odometry to the nearer one
        shared = np.where(far[k] <= far[j], k, j)
        covariance[k, :, j, :] += side[shared][:, None, None] * legs[shared]
    Ad = se3.adjoint(se3.between(X[to][None], X[b]))[:, axes][:, :, axes]
    covariance[range(size), :, range(size), :] += Ad @ noise @ np.swapaxes(Ad, 1, 2)
    try:
        root = np.linalg.cholesky(covariance.reshape(size * d, size * d))
    except np.linalg.LinAlgError:
        return 0.0, None
    whitened = np.linalg.solve(root, np.column_stack([np.tile(np.eye(d), (size, 1)), error.ravel()]))
    J, e = whitened[:, :d], whitened[:, d]
    information, gradient = J.T @ J, J.T @ e
    displaced = np.zeros(6)
    displaced[axes] = np.linalg.solve(information, gradient)
    inner = -0.5 * float(e @ e - gradient @ displaced[axes]) - float(np.log(np.diag(root)).sum())
    inner -= 0.5 * float(np.linalg.slogdet(information)[1]) + 0.5 * (size - 1) * d * _LOG_2PI
    mean = measured[middle] @ se3.exp(displaced[None])[0]
    return inner, _Run(at, to, mean, np.asarray(np.linalg.inv(information), np.float64))


def forward(graph: PoseGraph, edges: Ints) -> tuple[Ints, Ints, Floats, Floats]:
    """The edges from their earlier pose a to their later one b: a, b, a_from_b and covariance in the frame of b."""
    axes = AXES[graph.dimension]
    back = (graph.a[edges] > graph.b[edges])[:, None, None]
    noise = np.linalg.inv(informed(graph)[edges])
    Ad = se3.adjoint(graph.a_from_b[edges])[:, axes][:, :, axes]
    return (
        np.minimum(graph.a[edges], graph.b[edges]).astype(np.int64),
        np.maximum(graph.a[edges], graph.b[edges]).astype(np.int64),
        np.where(back, se3.inverse(graph.a_from_b[edges]), graph.a_from_b[edges]),
        np.where(back, Ad @ noise @ np.swapaxes(Ad, 1, 2), noise),
    )


def _log_displacements(together: list[_Run], chain: OdometryChain, room: float) -> float:
    """Log density of the runs' displacements: each is a new one, anywhere, or that of an earlier run.

    Which of them is as likely one as the other, as at a new table of a Chinese restaurant.
    """
    if not together:
        return 0.0
    count, density = len(together), np.full((len(together), len(together)), -np.inf)
    a, b = np.array([run.a for run in together]), np.array([run.b for run in together])
    one, two = np.triu_indices(count, 1)
    near = (two - one <= _EARLIER) & (chain.part[a[one]] == chain.part[a[two]])
    near &= chain.part[b[one]] == chain.part[b[two]]
    one, two = one[near], two[near]
    measured = np.array([run.a_from_b for run in together])
    claims = Displacements(chain, a, b, measured, np.array([run.covariance for run in together]))
    for start in range(0, len(one), _PAIRS):
        this, other = one[start : start + _PAIRS], two[start : start + _PAIRS]
        error, covariance = claims.apart(this, other)
        log_volume = np.linalg.slogdet(covariance)[1] + error.shape[1] * _LOG_2PI
        density[this, other] = -0.5 * (se3.mahalanobis2(error, covariance) + log_volume)
    choices = np.logaddexp.reduce(np.vstack([np.full(count, -room), density]), axis=0)
    return float(choices.sum()) - math.lgamma(count + 1)


class Displacements:
    """What K closures claim: that the world is displaced by D = X_a z X_b^-1 between two visits, X the odometry.

    Two agree where D_i^-1 D_j is the identity but for the noise of both and of the odometry from a_i to a_j and from
    b_i to b_j (Mangelson et al., Pairwise Consistent Measurement Set Maximization, ICRA 2018, eq. 3).
    """

    def __init__(self, chain: OdometryChain, a: Ints, b: Ints, measured: Floats, noise: Floats) -> None:
        """Closures z `measured` (K, 4, 4) from earlier poses a to later ones b with `noise` (K, d, d) in b's frame."""
        self._chain, self._a, self._b = chain, a, b
        at_a, at_b = (se3.between(chain.poses[:1], chain.poses[end]) for end in (a, b))
        self._displaced = at_a @ measured @ se3.inverse(at_b)
        Ad = self._adjoint(at_b)
        self._own = Ad @ noise @ np.swapaxes(Ad, 1, 2)
        self._after = self._adjoint(se3.inverse(self._displaced))

    def _adjoint(self, poses: Floats) -> Floats:
        return se3.adjoint(poses)[:, self._chain.axes][:, :, self._chain.axes]

    def apart(self, one: Ints, other: Ints) -> tuple[Floats, Floats]:
        """Twist (P, d) from the displacements `one` (P,) to `other`, about the first pose, and its covariance."""
        total, after = self._chain.total, self._after[one]
        of_a, of_b = (
            np.where(end[other] >= end[one], 1.0, -1.0)[:, None, None] * (total[end[other]] - total[end[one]])
            for end in (self._a, self._b)
        )
        covariance = self._own[one] + self._own[other] + of_b + after @ of_a @ np.swapaxes(after, 1, 2)
        return se3.log(se3.between(self._displaced[one], self._displaced[other]))[:, self._chain.axes], covariance
