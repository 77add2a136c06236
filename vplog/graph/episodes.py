"""Prior of which closures are true and which false ones belong together: episodes along the path.

Neighbouring keyframes look alike, so closures come in episodes. An episode has one cause: the place is revisited, or it
is mistaken for another one. Between a closure and its nearest earlier one, l keyframes away, the episode continues with
probability exp(-l / EPISODE); otherwise a new one begins, which is false with probability phi. The closures of a false
episode claim one displacement of the world between the two visits (`Displacements`). It is uniform over the volume of
false closures (`log_false_volumes`), or with probability REPEATED that of an earlier false episode, as in equal aisles.
With probability SCATTERED a closure in the middle of a false episode claims another displacement, in that volume for
given poses.
`docs/how-it-works.md` states the whole model.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property

import numba
import numpy as np

from vplog.data import Bools, Floats, Ints, PoseGraph
from vplog.graph.consistency import LOG_2PI, OdometryChain
from vplog.graph.displacements import Displacements

EPISODE = 3.0
"""Mean length of an episode in keyframes. Prior: a few neighbouring keyframes share most of their features, and a cause
of aliasing rarely covers a longer path."""
REPEATED = 0.3
"""Prior probability that a false episode repeats the displacement of an earlier one, as in a row of equal aisles. Late
revisits of a simulated lap are all kept from 0.1 to 0.7. At 0.1 a drive was accepted whose closures are all false."""
SCATTERED = 0.1
"""Prior probability that a closure of a false episode does not agree with the one before: matches between two places
that only look alike may fit several poses."""
SHARES = np.linspace(0.05, 0.95, 10)
"""Values of phi, equally likely, if recognition does not tell how likely a closure is false."""
_MOST_FAMILIES = 50
"""Number of latest families that a new false episode may repeat, and of families with a displacement of their own. It
bounds the work for thousands of false closures."""


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
    log_view: float
    """The same for given poses."""
    claims: Displacements

    @classmethod
    def of(
        cls,
        graph: PoseGraph,
        loops: Ints,
        chain: OdometryChain,
        log_volumes: tuple[float, float],
        log_odds: Floats | None,
    ) -> Episodes:
        """Prepare the edges `loops` (K,). `log_odds` (E,) are the log odds that an edge is false by recognition, None
        or all 0 if these are unknown; `chain` is the graph's odometry, `log_volumes` as `log_false_volumes` returns."""
        ends = np.sort(np.stack([graph.a[loops], graph.b[loops]]).astype(np.int64), axis=0)
        edges = loops[np.lexsort(ends)]
        claims = Displacements(graph, edges, chain)
        nearest, gap = _nearest_before(claims.a, claims.b, chain.part)
        if log_odds is None or not log_odds[edges].any():
            share = np.tile(SHARES, (len(edges), 1))
        else:
            share = 1.0 / (1.0 + np.exp(-log_odds[edges, None]))
        continues = np.exp(-np.maximum(gap, 1.0) / EPISODE)  # two closures of one pair of keyframes may differ, too
        return cls(edges, nearest, continues, share, *log_volumes, claims)

    def family(self, is_false: Bools, claims: Displacements | None = None, resolution: float = 1.0) -> Ints:
        """Return the number of the false family of each closure (K,), -1 for true ones; `is_false` (K,) are false.

        The closures of a family claim about the same displacement. `claims` are the displacements on poses that true
        closures have corrected; by default on those of the odometry. `resolution` multiplies the odometry's noise.
        """
        claims = claims or self.claims
        K, d = len(self.edges), len(claims.axes)
        family, (first, last, size) = np.full(K, -1), np.zeros((3, K), np.int64)
        begins = (1.0 - self._stays) * self.false_share[:, self.false_share.shape[1] // 2]
        alone, scattered = (1.0 - REPEATED) * math.exp(-self.log_volume), SCATTERED * math.exp(-self.log_view)
        _track(
            np.flatnonzero(is_false), self.nearest, self.continues, begins, alone, scattered,
            claims.a, claims.b, claims.chain.part, np.array(claims.axes), claims.displaced,
            claims.own, claims.after, resolution**2 * claims.chain.total, np.zeros((K, d)), claims.own.copy(),
            np.empty((4, d, d + 2)), first, last, size, family,
        )  # fmt: skip
        small = np.flatnonzero(is_false & (np.argsort(np.argsort(-size, kind="stable"))[family] >= _MOST_FAMILIES))
        family[small] = K + np.arange(len(small))  # each by itself
        return family

    def log_prior(self, is_false: Bools, family: Ints) -> float:
        """Return log P(states, families), with the density of the first displacement of each family.

        `is_false` (K,) are the false closures, and `family` (K,) is as `self.family` returns it.
        """
        false = np.flatnonzero(is_false)
        earlier, members = np.zeros((2, len(is_false)))  # earlier false closures, and those of the same family
        earlier[false] = np.arange(len(false))
        by_family = false[np.argsort(family[false], kind="stable")]
        begin = np.searchsorted(family[by_family], family[by_family])
        members[by_family] = np.arange(len(by_family)) - begin
        follows = is_false[self.nearest] & (self.nearest >= 0)
        same = follows & (family[self.nearest] == family)
        # if the episode of the nearest earlier closure continues, and if another one begins
        new = SCATTERED * math.exp(-self.log_view) * (members == 0)
        continues = np.where(is_false, np.where(same, 1.0 - SCATTERED, new) * follows, ~follows)
        repeats = REPEATED * members / np.maximum(earlier, 1.0)
        alone = (1.0 - REPEATED) * math.exp(-self.log_volume)
        begins = np.where(is_false, np.where(members > 0, repeats, alone), 1.0)[:, None]
        begins = begins * np.where(is_false[:, None], self.false_share, 1.0 - self.false_share)
        stays = self._stays[:, None]
        of_share = np.log(stays * continues[:, None] + (1.0 - stays) * begins + 1e-300).sum(0)
        most = of_share.max()
        return float(most + np.log(np.exp(of_share - most).mean()))

    @property
    def _stays(self) -> Floats:
        return np.where(self.nearest >= 0, self.continues, 0.0)

    @cached_property
    def families(self) -> Ints:
        """(K,) number of the family that each closure is of if all are false."""
        return self.family(np.ones(len(self.edges), bool))


def _nearest_before(a: Ints, b: Ints, part: Ints) -> tuple[Ints, Floats]:
    """Nearest earlier closure (K,) between the same two pieces of odometry, and its distance in keyframes (K,): the
    larger one of the distances at both ends."""
    nearest, gap, k = np.full(len(a), -1), np.full(len(a), np.inf), np.arange(len(a))
    for lag in range(1, len(a)):
        k = k[k >= lag]
        k = k[b[k] - b[k - lag] < gap[k]]  # b increases, so no earlier closure is nearer
        if len(k) == 0:
            break
        apart = np.maximum(np.abs(a[k] - a[k - lag]), b[k] - b[k - lag])
        nearer = (apart < gap[k]) & (part[a[k]] == part[a[k - lag]]) & (part[b[k]] == part[b[k - lag]])
        nearest[k[nearer]], gap[k[nearer]] = k[nearer] - lag, apart[nearer]
    return nearest, gap


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _track(
    false: Ints, nearest: Ints, continues: Floats, begins: Floats, alone: float, scattered: float,
    a: Ints, b: Ints, part: Ints, axes: Ints, displaced: Floats, own: Floats, after: Floats, total: Floats,
    mean: Floats, covariance: Floats, room: Floats,
    first: Ints, last: Ints, size: Ints, family: Ints,
) -> None:  # fmt: skip
    """Write the family (K,) of the closures `false`.

    The displacement of each family is tracked by a Kalman filter, about that of its first member: the odometry between
    two members is its process noise. A closure joins the family that it most likely belongs to. The `first` and `last`
    member and the `size` of each family are overwritten, as are `mean` (K, d) and `covariance` (K, d, d) at its first
    member, and `room` (4, d, d + 2). Loops and not array expressions, for which Numba compiles for seconds.
    """
    d, count, spread = len(axes), 0, room[2]
    for k in false:
        stay, before = 0.0, -1
        if nearest[k] >= 0:
            stay, before = continues[k], family[nearest[k]]
        chosen, best, slot = count, begins[k] * alone + (stay * scattered if before >= 0 else 0.0), 0
        begin = max(0, count - _MOST_FAMILIES)
        members = 0
        for f in range(begin, count):
            members += size[f]
        for at in range(begin - 1, count):  # an older family may only continue
            f = before if at < begin else at
            if f < 0 or (at < begin <= f) or part[a[last[f]]] != part[a[k]] or part[b[last[f]]] != part[b[k]]:
                continue
            root = room[slot]
            _twist(displaced[first[f]], displaced[k], axes, room[3], root)
            _odometry_noise(after[first[f]], total, a[last[f]], a[k], b[last[f]], b[k], room[3], spread)
            for i in range(d):
                root[i, d + 1] -= mean[first[f], i]
                for j in range(d):
                    spread[i, j] += covariance[first[f], i, j] + own[k, i, j]
            density = math.exp(_log_normal(spread, root))
            joint = 0.0
            if f == before:
                joint = density * stay * (1.0 - SCATTERED)
            if at >= begin:
                joint += density * begins[k] * REPEATED * size[f] / members
            if joint > best:
                chosen, best, slot = f, joint, 1 - slot
        if chosen == count:
            first[count] = k
            count += 1
        else:
            _update(room[1 - slot], own[k], room[3], mean[first[chosen]], covariance[first[chosen]])
        last[chosen] = k
        size[chosen] += 1
        family[k] = chosen


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _update(root: Floats, own: Floats, white: Floats, mean: Floats, covariance: Floats) -> None:
    """Kalman update of the mean (d,) and covariance (d, d) of a family by a closure's `own` noise (d, d).

    Take the `root` of `_log_normal`. `white` (d, d) is overwritten.
    """
    d = len(mean)
    for i in range(d):
        mean[i] += root[i, d + 1]
        for j in range(d):
            white[i, j] = own[i, j]
            for k in range(i):
                white[i, j] -= root[i, k] * white[k, j]
            white[i, j] /= root[i, i]
    for i in range(d):
        for j in range(d):
            covariance[i, j] = own[i, j]
            for k in range(d):
                covariance[i, j] -= white[k, i] * white[k, j]
            mean[i] -= white[j, i] * root[j, d]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _twist(one: Floats, two: Floats, axes: Ints, turn: Floats, result: Floats) -> None:
    """Write the axes (d,) of the twist from one pose (4, 4) to another to the last column of `result` (d, d + 2).

    As `se3.log`, through the quaternion, stable up to half a turn. `turn` (3, 4) is overwritten.
    """
    for i in range(3):
        turn[i, 3] = 0.0
        for j in range(3):
            turn[i, 3] += one[j, i] * (two[j, 3] - one[j, 3])
            turn[i, j] = one[0, i] * two[0, j] + one[1, i] * two[1, j] + one[2, i] * two[2, j]
    m, x, y, z = turn, turn[2, 1] - turn[1, 2], turn[0, 2] - turn[2, 0], turn[1, 0] - turn[0, 1]
    w = 1.0 + m[0, 0] + m[1, 1] + m[2, 2]
    if w < 1.0:
        if m[0, 0] >= m[1, 1] and m[0, 0] >= m[2, 2]:
            w, x, y, z = x, 1.0 + m[0, 0] - m[1, 1] - m[2, 2], m[0, 1] + m[1, 0], m[0, 2] + m[2, 0]
        elif m[1, 1] >= m[2, 2]:
            w, x, y, z = y, m[0, 1] + m[1, 0], 1.0 - m[0, 0] + m[1, 1] - m[2, 2], m[1, 2] + m[2, 1]
        else:
            w, x, y, z = z, m[0, 2] + m[2, 0], m[1, 2] + m[2, 1], 1.0 - m[0, 0] - m[1, 1] + m[2, 2]
        if w < 0.0:
            w, x, y, z = -w, -x, -y, -z
    norm = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 / w if norm < 1e-9 * w else 2.0 * math.atan2(norm, w) / norm
    x, y, z = scale * x, scale * y, scale * z
    # the inverse of the left Jacobian: v = t - omega x t / 2 + k omega x (omega x t)
    square = x * x + y * y + z * z
    half = math.sqrt(square) / 2.0
    k = 1.0 / 12.0 + square / 720.0
    if half > 1e-2:
        k = (1.0 - half * math.cos(half) / math.sin(half)) / square
    tx, ty, tz = turn[0, 3], turn[1, 3], turn[2, 3]
    cx, cy, cz = y * tz - z * ty, z * tx - x * tz, x * ty - y * tx
    turn[0, 0], turn[0, 1], turn[0, 2] = x, y, z
    turn[1, 0] = tx - cx / 2.0 + k * (y * cz - z * cy)
    turn[1, 1] = ty - cy / 2.0 + k * (z * cx - x * cz)
    turn[1, 2] = tz - cz / 2.0 + k * (x * cy - y * cx)
    for row in range(len(axes)):
        result[row, len(axes) + 1] = turn[axes[row] // 3, axes[row] % 3]


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _odometry_noise(
    after: Floats, total: Floats, a0: int, a1: int, b0: int, b1: int, moved: Floats, result: Floats
) -> None:
    """Covariance (d, d) that the odometry adds between two closures, in place; see `Displacements.apart`."""
    d, sign_a, sign_b = len(after), 1.0 if a1 >= a0 else -1.0, 1.0 if b1 >= b0 else -1.0
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


@numba.njit(cache=True, nogil=True, error_model="numpy")
def _log_normal(covariance: Floats, root: Floats) -> float:
    """Log density of the normal error in the last column of `root` (d, d + 2).

    It is -700 at least, and so it is if the covariance is not positive definite. The
    covariance's Cholesky factor is written to `root`, and the whitened error to its last column but one.
    """
    d, value = len(root), 0.0
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
        white = root[i, d + 1]
        for k in range(i):
            white -= root[i, k] * root[k, d]
        root[i, d] = white / root[i, i]
        value -= math.log(root[i, i]) + 0.5 * root[i, d] ** 2 + 0.5 * LOG_2PI
    return max(value, -700.0)
