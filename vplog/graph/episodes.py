"""Prior of which closures are true, and likelihood of the false ones: episodes along the path.

Neighbouring keyframes look alike, so closures come in episodes. An episode has one cause: the place is revisited, or it
is mistaken for another one. Between a closure and its nearest earlier one, l keyframes away, the episode continues with
probability exp(-l / EPISODE); otherwise a new one begins, which is false with probability phi. All closures of a false
episode claim one displacement of the world between the two visits (`Displacements`). It is uniform over the volume of
false closures (`log_false_volume`), or with probability REPEATED that of an earlier false episode, as in equal aisles.
`docs/how-it-works.md` states the whole model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np

from vplog.data import Bools, Floats, Ints, PoseGraph
from vplog.graph.consistency import OdometryChain
from vplog.graph.displacements import Displacements
from vplog.graph.normal_equations import logarithm

EPISODE = 3.0
"""Mean length of an episode in keyframes. Prior: a few neighbouring keyframes share most of their features, and a cause
of aliasing rarely covers a longer path."""
REPEATED = 0.3
"""Prior probability that a false episode repeats the displacement of an earlier one, as in a row of equal aisles. Late
revisits of a simulated lap are all kept from 0.1 to 0.7. At 0.1 a drive was accepted whose closures are all false."""
SHARES = np.linspace(0.05, 0.95, 10)
"""Values of phi, equally likely, if recognition does not tell how likely a closure is false."""
_FAMILIES = 50
"""Number of latest families that a new false episode may repeat; bounds the work for thousands of false closures."""
_FAR = 40.0
"""Half the chi-square, above the log of the volume, from which a displacement surely belongs to another family."""
_LOG_2PI = math.log(2.0 * math.pi)


@dataclass(frozen=True, eq=False)
class Episodes:
    """K closures in the order of their later, then their earlier keyframe."""

    edges: Ints
    """(K,) edges of the graph."""
    nearest: Ints
    """(K,) nearest earlier closure in this order, -1 if there is none between the same pieces of odometry."""
    continues: Floats
    """(K,) probability that the episode of that closure continues."""
    false_share: Floats
    """(K, S) probability that an episode that begins here is false, for S equally likely values."""
    log_volume: float
    """Log of the volume over which displacements of false closures are spread."""
    claims: Displacements

    @classmethod
    def of(
        cls, graph: PoseGraph, loops: Ints, chain: OdometryChain, log_volume: float, log_odds: Floats | None
    ) -> Episodes:
        """Prepare the edges `loops` (K,). `log_odds` (E,) are the log odds that an edge is false by recognition, None
        or all 0 if these are unknown; `chain` is the graph's odometry."""
        ends = np.sort(np.stack([graph.a[loops], graph.b[loops]]).astype(np.int64), axis=0)
        edges = loops[np.lexsort(ends)]
        claims = Displacements(graph, edges, chain)
        nearest, gap = _nearest_before(claims.a, claims.b, chain.part)
        if log_odds is None or not log_odds[edges].any():
            share = np.tile(SHARES, (len(edges), 1))
        else:
            share = 1.0 / (1.0 + np.exp(-log_odds[edges, None]))
        continues = np.exp(-np.maximum(gap, 1.0) / EPISODE)  # two closures of one pair of keyframes may differ, too
        return cls(edges, nearest, continues, share, log_volume, claims)

    def log_density(self, is_false: Bools) -> tuple[float, Ints]:
        """Return log P(states) + log p(false closures) if `is_false` (K,) are false, and the family of each (K,).

        Closures of one family claim one displacement; -1 stands for a true closure.
        """
        family, claims = np.full(len(self.edges), -1), self.claims
        log_density = _log_density(
            np.asarray(is_false, bool), self.nearest, self.continues, self.false_share, self.log_volume, family,
            claims.a, claims.b, claims.chain.part, np.array(claims.axes), claims.displaced, claims.own, claims.after,
            claims.chain.total,
        )  # fmt: skip
        return log_density, family

    @cached_property
    def families(self) -> Ints:
        """(K,) number of the family that each closure is of if all are false."""
        return self.log_density(np.ones(len(self.edges), bool))[1]


@numba.njit(cache=True, nogil=True)
def _nearest_before(a: Ints, b: Ints, part: Ints) -> tuple[Ints, Floats]:
    """Nearest earlier closure (K,) between the same two pieces of odometry, and its distance in keyframes (K,): the
    larger one of the distances at both ends."""
    nearest, gap = np.full(len(a), -1), np.full(len(a), np.inf)
    for k in range(len(a)):
        for j in range(k - 1, -1, -1):
            if b[k] - b[j] >= gap[k]:
                break
            if part[a[j]] == part[a[k]] and part[b[j]] == part[b[k]]:
                apart = max(abs(a[k] - a[j]), b[k] - b[j])
                if apart < gap[k]:
                    nearest[k], gap[k] = j, apart
    return nearest, gap


@numba.njit(cache=True, nogil=True)
def _log_density(
    is_false: Bools, nearest: Ints, continues: Floats, false_share: Floats, log_volume: float, family: Ints,
    a: Ints, b: Ints, part: Ints, axes: Ints, displaced: Floats, own: Floats, after: Floats, total: Floats,
) -> float:  # fmt: skip
    """See `Episodes.log_density`; `family` (K,) is filled in place.

    The displacement of each family is tracked by a Kalman filter, about that of its first member: the odometry between
    two members is its process noise. A closure joins the family that it most likely belongs to.
    """
    K, d, S = len(is_false), len(axes), false_share.shape[1]
    count, middle = 0, S // 2
    reference, last, size = np.empty(K, np.int64), np.empty(K, np.int64), np.empty(K, np.int64)
    mean, covariance = np.empty((K, d)), np.empty((K, d, d))
    error, spread = np.empty(d), np.empty((d, d))
    best_error, best_spread = np.empty(d), np.empty((d, d))
    moved, root = np.empty((d, d)), np.empty((d, d + 1))
    result, density = np.zeros(S), np.empty(S)
    for k in range(K):
        stay = continues[k] if nearest[k] >= 0 else 0.0
        before = family[nearest[k]] if nearest[k] >= 0 else -2
        if not is_false[k]:
            goes_on = stay if before == -1 else 0.0
            result += np.log(goes_on + (1.0 - stay) * (1.0 - false_share[k]) + 1e-300)
            continue
        begins = (1.0 - stay) * false_share[k]
        density[:] = begins * (1.0 - REPEATED) * math.exp(-log_volume)
        chosen, most = count, density[middle]
        first = max(0, count - _FAMILIES)
        members = size[first:count].sum()
        for at in range(first - 1, count):  # first the family that may continue, then those that may be repeated
            f = before if at < first else at
            if f < 0 or part[a[last[f]]] != part[a[k]] or part[b[last[f]]] != part[b[k]]:
                continue
            _error(displaced[reference[f]], displaced[k], axes, mean[f], error)
            _odometry_noise(after[reference[f]], total, a[last[f]], a[k], b[last[f]], b[k], moved, spread)
            for i in range(d):
                for j in range(d):
                    spread[i, j] += covariance[f, i, j] + own[k, i, j]
            value = math.exp(_log_normal(error, spread, root, log_volume + _FAR))
            if at < first:
                density += value * stay
                value *= stay
            else:
                density += value * begins * REPEATED * size[f] / members
                value *= begins[middle] * REPEATED * size[f] / members
            if value > most:
                chosen, most = f, value
                best_error[:], best_spread[:] = error, spread
        result += np.log(density + 1e-300)
        if chosen == count:
            reference[count], size[count] = k, 0
            mean[count], covariance[count] = 0.0, own[k]
            count += 1
        else:
            gain = np.linalg.solve(best_spread, best_spread - own[k]).T
            mean[chosen] += gain @ best_error
            covariance[chosen] = gain @ own[k]
        last[chosen] = k
        size[chosen] += 1
        family[k] = chosen
    best = result.max()
    return best + math.log(np.exp(result - best).mean())


@numba.njit(cache=True, nogil=True)
def _error(one: Floats, two: Floats, axes: Ints, mean: Floats, error: Floats) -> None:
    """Twist from one pose to another, less the mean (d,), in place."""
    R, t, twist = np.empty((3, 3)), np.empty(3), np.empty(6)
    for i in range(3):
        t[i] = 0.0
        for j in range(3):
            t[i] += one[j, i] * (two[j, 3] - one[j, 3])
            R[i, j] = one[0, i] * two[0, j] + one[1, i] * two[1, j] + one[2, i] * two[2, j]
    logarithm(R, t, twist)
    for row in range(len(error)):
        error[row] = twist[axes[row]] - mean[row]


@numba.njit(cache=True, nogil=True)
def _odometry_noise(
    after: Floats, total: Floats, a0: int, a1: int, b0: int, b1: int, moved: Floats, result: Floats
) -> None:
    """Covariance (d, d) that the odometry adds between two closures, in place; see `Displacements.apart`."""
    d, sign_a, sign_b = len(result), 1.0 if a1 >= a0 else -1.0, 1.0 if b1 >= b0 else -1.0
    for i in range(d):
        for j in range(d):
            moved[i, j] = 0.0
            for k in range(d):
                moved[i, j] += after[i, k] * sign_a * (total[a1, k, j] - total[a0, k, j])
    for i in range(d):
        for j in range(d):
            result[i, j] = sign_b * (total[b1, i, j] - total[b0, i, j])
            for k in range(d):
                result[i, j] += moved[i, k] * after[j, k]


@numba.njit(cache=True, nogil=True)
def _log_normal(error: Floats, covariance: Floats, root: Floats, most: float) -> float:
    """Log density of a normal error (d,). It is -700 if half the chi-square is surely more than `most`, or if the
    covariance is not positive definite.

    `root` (d, d + 1) is room for the Cholesky factor and, in its last column, the whitened error.
    """
    d, value = len(error), 0.0
    if 0.5 * (error**2).sum() > most * np.trace(covariance):
        return -700.0
    for i in range(d):
        for j in range(i + 1):
            rest = covariance[i, j]
            for k in range(j):
                rest -= root[i, k] * root[j, k]
            if i > j:
                root[i, j] = rest / root[j, j]
            elif rest > 0.0:
                root[i, i] = math.sqrt(rest)
            else:
                return -700.0
        white = error[i]
        for k in range(i):
            white -= root[i, k] * root[k, d]
        root[i, d] = white / root[i, i]
        value -= math.log(root[i, i]) + 0.5 * root[i, d] ** 2 + 0.5 * _LOG_2PI
    return max(value, -700.0)
