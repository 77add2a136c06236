"""Displacements of the world between two visits that closures claim, and how likely some of them are one."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import TYPE_CHECKING

import numba
import numpy as np

from vplog.geometry import se3
from vplog.graph.dense_front import eliminate_front
from vplog.graph.normal_equations import logarithm

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vplog.data import Bools, Floats, Ints
    from vplog.graph.consistency import OdometryChain

_EARLIER = 200
"""Runs before one that may share its displacement: bounds the pairs of graphs with thousands of false closures."""
_PAIRS = 1 << 12
"""Pairs of runs compared at once: some megabytes."""
_LOG_2PI = math.log(2.0 * math.pi)


@dataclass(eq=False)
class Compared:
    """Claims that were compared in one room, by their names, which are numbers: of sets that differ in a few, most
    were."""

    joint: dict[tuple[int, ...], float] = field(default_factory=dict)
    pairs: Ints = field(default_factory=lambda: np.zeros(0, np.int64))
    """(P,) the earlier one's name times 2^32 plus the later one's, increasing."""
    alike: Bools = field(default_factory=lambda: np.zeros(0, bool))
    """(P,) whether the two agree."""

    def known(self, pairs: Ints) -> tuple[Ints, Bools]:
        """(K,) where the pairs stand, and which of them were compared."""
        at = np.searchsorted(self.pairs, pairs)
        return at, np.append(self.pairs, -1)[at] == pairs

    def take(self, pairs: Ints, alike: Bools) -> None:
        """Further pairs."""
        order = np.argsort(joined := np.concatenate([self.pairs, pairs]), kind="stable")
        self.pairs, self.alike = joined[order], np.concatenate([self.alike, alike])[order]


class Displacements:
    """Displacements D = X_a z X_b^-1 of the world between two visits that K closures claim, X the odometry.

    Two agree where D_i^-1 D_j is the identity but for the noise of both and of the odometry from a_i to a_j and from
    b_i to b_j (Mangelson et al., Pairwise Consistent Measurement Set Maximization, ICRA 2018, eq. 3).
    """

    def __init__(
        self, chain: OdometryChain, a: Ints, b: Ints, measured: Floats, noise: Floats,
        names: Sequence[int] | None = None, compared: Compared | None = None,
    ) -> None:  # fmt: skip
        """Closures z `measured` (K, 4, 4) from earlier poses a to later ones b with `noise` (K, d, d) in b's frame.

        `compared` holds what is known of closures of these `names`, and gets more.
        """
        self._chain, self._a, self._b = chain, a, b
        at_a, at_b = (se3.between(chain.poses[:1], chain.poses[end]) for end in (a, b))
        self._displaced = at_a @ measured @ se3.inverse(at_b)
        Ad = self._adjoint(at_b)
        self._own = Ad @ noise @ np.swapaxes(Ad, 1, 2)
        self._after = self._adjoint(se3.inverse(self._displaced))
        self._names = np.arange(len(a)) if names is None else np.array(names, np.int64)
        self._compared = Compared() if compared is None else compared

    @property
    def count(self) -> int:
        return len(self._a)

    def near(self, room: float) -> list[list[int]]:
        """Earlier claims with which each agrees more likely than it is anywhere in the room."""
        part, near = self._chain.part, [[] for _ in range(self.count)]
        each = np.minimum(np.arange(self.count), _EARLIER)
        two = np.repeat(np.arange(self.count), each)
        one = np.arange(len(two)) - np.repeat(np.cumsum(each) - np.arange(self.count), each)
        comparable = (part[self._a[one]] == part[self._a[two]]) & (part[self._b[one]] == part[self._b[two]])
        one, two = one[comparable], two[comparable]
        pairs = (self._names[one] << 32) + self._names[two]
        new = np.flatnonzero(~self._compared.known(pairs)[1])
        self._compared.take(pairs[new], self._alike(one[new], two[new], room))
        alike = self._compared.alike[self._compared.known(pairs)[0]]
        for earlier, later in zip(one[alike].tolist(), two[alike].tolist(), strict=True):
            near[later].append(earlier)
        return near

    def _alike(self, one: Ints, two: Ints, room: float) -> Bools:
        """(P,)."""
        found = np.zeros(len(one), bool)
        for start in range(0, len(one), _PAIRS):
            rows = slice(start, start + _PAIRS)
            error, covariance = self.apart(one[rows], two[rows])
            log_volume = np.linalg.slogdet(covariance)[1] + error.shape[1] * _LOG_2PI
            found[rows] = -0.5 * (se3.mahalanobis2(error, covariance) + log_volume) > -room
        return found

    def log_joint(self, members: list[int]) -> float:
        """Log density of these given that all claim one displacement, whatever it is; -inf where the noise has no
        positive definite covariance."""
        if len(members) == 1:
            return 0.0
        key, joint = tuple(self._names[members].tolist()), self._compared.joint
        if key not in joint:
            rows, axes = np.array(members), np.array(self._chain.axes)
            claims = self._a, self._b, self._displaced, self._after, self._own
            joint[key] = _log_joint(rows, axes, *claims, self._chain.total)
        return joint[key]

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


@numba.njit(cache=True, nogil=True)
def _log_joint(
    members: Ints, axes: Ints, a: Ints, b: Ints, displaced: Floats, after: Floats, own: Floats, total: Floats
) -> float:
    """See `Displacements.log_joint`: as seen from the member in the middle.

    An error of D is Ad(D)^-1 W_a - W_b, W the random walk of the odometry's error about the first pose.
    """
    size, d, middle = len(members), len(axes), members[len(members) // 2]
    there, twist, Ad = displaced[middle], np.empty(6), np.ascontiguousarray(after[middle])
    turned = np.ascontiguousarray(there[:3, :3].T)
    error, covariance, ends = np.empty((size, d)), np.empty((size * d, size * d)), (a[members], b[members])
    moved, both = np.empty((2, size, d, d)), np.empty((size, d, d))  # Ad T of either end, Ad T Ad^T of the first
    for k in range(size):
        apart = displaced[members[k]]
        logarithm(turned @ np.ascontiguousarray(apart[:3, :3]), turned @ (apart[:3, 3] - there[:3, 3]), twist)
        error[k] = twist[axes]
        for end in range(2):
            moved[end, k] = Ad @ total[ends[end][k]]
        both[k] = moved[0, k] @ Ad.T
    for k in range(size):
        for j in range(k, size):
            of_a = both[k] if ends[0][k] <= ends[0][j] else both[j]
            of_b = total[min(ends[1][k], ends[1][j])]
            mixed = moved[0, k] if ends[0][k] <= ends[1][j] else moved[1, j]
            swapped = moved[0, j] if ends[0][j] <= ends[1][k] else moved[1, k]
            for row in range(d):
                for column in range(d):
                    value = of_a[row, column] + of_b[row, column] - mixed[row, column] - swapped[column, row]
                    covariance[k * d + row, j * d + column] = value
        covariance[k * d : k * d + d, k * d : k * d + d] += own[members[k]]
    return log_common(error, covariance)[0]


@numba.njit(cache=True, nogil=True)
def log_common(error: Floats, covariance: Floats) -> tuple[float, Floats, Floats]:
    """Log density of errors (K, d) about a common mean that may be anything; the mean (d,) and its information (d, d).

    Of `covariance` (K d, K d) the upper triangle is read; the density is -inf where it is not positive definite.
    """
    size, d = error.shape
    end = size * d
    front, mean, information = np.zeros((end + d + 1, end + d + 1)), np.zeros(d), np.zeros((d, d))
    front[:end, :end] = covariance
    for row in range(end):
        front[row, end + row % d] = 1.0
        front[row, end + d] = error[row // d, row % d]
    if not eliminate_front(front, end):
        return -np.inf, mean, information
    rest = -front[end:, end:]
    for i in range(d):
        for j in range(i, d):
            information[i, j] = information[j, i] = rest[i, j]
    if not eliminate_front(rest, d):
        return -np.inf, mean, information
    volume = 0.0
    for i in range(end):
        volume += math.log(front[i, i])
    for i in range(d - 1, -1, -1):
        volume += math.log(rest[i, i])
        mean[i] = rest[i, d]
        for j in range(i + 1, d):
            mean[i] -= rest[i, j] * mean[j]
        mean[i] /= rest[i, i]
    return -0.5 * rest[d, d] - volume - 0.5 * (size - 1) * d * _LOG_2PI, mean, information
