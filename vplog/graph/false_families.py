"""Likelihood of odometry, true closures and false closures together.

A true closure measures X_a^-1 X_b, a false one X_a^-1 D X_b. The closures of a false family have one displacement D of
the world, which is an unknown variable of the graph like the poses X. Poses and displacements are integrated over
(Laplace's approximation, exact for a linear graph).
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from vplog.data import Floats, Ints
from vplog.geometry import se3
from vplog.graph.build import informed
from vplog.graph.consistency import LOG_2PI, degrees_of_freedom, residual_sigma
from vplog.graph.displacements import Displacements
from vplog.graph.factors import Factors
from vplog.graph.least_squares import GAUGE_SIGMA, Objective
from vplog.graph.sparse.cholesky import Blocks, Cholesky


class Likelihood:
    """Likelihood of one set of true closures, together with the odometry and with families of false closures."""

    def __init__(self, factors: Factors, weight: Floats, poses: Floats) -> None:
        """Linearise the edges of weight (E,) 1 at their least squares `poses` (N, 4, 4)."""
        graph, d, loose = factors.graph, degrees_of_freedom(factors.graph), len(factors.loose(weight))
        self._objective = Objective(factors, weight)
        self._matrix, _ = self._objective.linearised(se3.between(poses[:1], poses))
        chi2 = float((weight * residual_sigma(graph, poses) ** 2).sum())
        known = float(np.linalg.slogdet(informed(graph, weight > 0))[1].sum())
        held = (1 + loose) * d * -2.0 * math.log(GAUGE_SIGMA)
        self.joined = int(factors.piece.max()) - loose
        """Number of pieces of odometry that only true closures join."""
        measured = np.count_nonzero(~graph.odometry & (weight > 0)) - self.joined
        self._of_true = 0.5 * (known + held - chi2 - LOG_2PI * d * measured)

    def explained(self, claims: Displacements, family: Ints) -> Explained:
        """Return the log density if K closures are in these families.

        `claims` are the closures on the poses. `family` (K,) numbers the false family of each closure; -1 stands for
        none. Displacements have density 1, and so have pieces of odometry that no true closure joins.
        """
        false = _Families.of(claims, family)
        factor = self._objective.factorised(false.added_to(self._matrix), 0.0, claims.edges[false.members])
        normal = false.eliminated(factor)
        covariance = np.asarray(np.linalg.inv(normal.information), np.float64)
        step = -covariance @ normal.pull
        log_determinant = factor.log_determinant() + float(np.linalg.slogdet(normal.information)[1])
        known = float(np.linalg.slogdet(false.information)[1].sum())
        measured = len(claims.axes) * (len(false.members) - len(false.displacement))
        chi2 = false.chi2 - normal.gain + float(normal.pull @ step)
        log_density = self._of_true + 0.5 * (known - log_determinant - chi2 - LOG_2PI * measured)
        numbers = np.unique(family[false.members])
        displacement = _displaced(false.displacement, step, claims.axes)
        return Explained(log_density, family, numbers, displacement, covariance, claims.axes)


@dataclass(frozen=True, eq=False)
class Explained:
    """Log density of a graph with false families, and their displacements."""

    log_density: float
    family: Ints
    """(K,) number of the false family of each closure, -1 for none."""
    numbers: Ints
    """(F,) numbers of the families with more than one closure."""
    displacement: Floats
    """(F, 4, 4) likeliest displacement of each."""
    covariance: Floats
    """(F d, F d) of all displacements, as twists on their left."""
    axes: list[int]

    def merged(self) -> Explained | None:
        """Merge the two families that agree best. Return None if there are less than two.

        The density gains that of the difference of both displacements at 0 (Savage and Dickey's density ratio), and
        the other displacements follow as in a Kalman update.
        """
        d, F = len(self.axes), len(self.numbers)
        if F < 2:
            return None
        first, second = np.triu_indices(F, 1)
        apart = se3.log(self.displacement[second] @ se3.inverse(self.displacement[first]))[:, self.axes]
        C = self.covariance.reshape(F, d, F, d).transpose(0, 2, 1, 3)
        spread = C[first, first] + C[second, second] - C[first, second] - C[second, first]
        log_normal = -0.5 * (se3.mahalanobis2(apart, spread) + np.linalg.slogdet(spread)[1] + d * LOG_2PI)
        best = int(np.argmax(log_normal))
        kept, dropped = int(first[best]), int(second[best])
        gain = self.covariance[:, kept * d : kept * d + d] - self.covariance[:, dropped * d : dropped * d + d]
        solved = np.linalg.solve(spread[best], np.concatenate([apart[best][:, None], gain.T], axis=1))
        rest = np.arange(F) != dropped
        rows = np.repeat(rest, d)
        return Explained(
            self.log_density + float(log_normal[best]),
            np.where(self.family == self.numbers[dropped], self.numbers[kept], self.family),
            self.numbers[rest],
            _displaced(self.displacement, gain @ solved[:, 0], self.axes)[rest],
            (self.covariance - gain @ solved[:, 1:])[rows][:, rows],
            self.axes,
        )


def _displaced(displacement: Floats, step: Floats, axes: list[int]) -> Floats:
    """Displacements (F, 4, 4) moved by twists (F d,) on their left."""
    twist = np.zeros((len(displacement), 6))
    twist[:, axes] = step.reshape(len(displacement), len(axes))
    return se3.exp(twist) @ displacement


class _Normal(NamedTuple):
    """Normal equations of F displacements after the N poses were eliminated."""

    information: Floats
    """(F d, F d)."""
    pull: Floats
    """(F d,) derivative of half the chi-square."""
    gain: float
    """By how much the poses lower chi-square."""


@dataclass(frozen=True, eq=False)
class _Families:
    """M closures of F false families, linearised about one displacement of each family."""

    claims: Displacements
    members: Ints
    """(M,)."""
    family: Ints
    """(M,) index of the family of each."""
    displacement: Floats
    """(F, 4, 4)."""
    information: Floats
    """(M, d, d)."""
    error: Floats
    """(M, d)."""
    by_a: Floats
    """(M, d, d) derivative of the error by the earlier pose. That by the later pose is the identity."""
    by_displacement: Floats
    """(M, d, d)."""

    @classmethod
    def of(cls, claims: Displacements, family: Ints) -> _Families:
        """Take the families (K,) with more than one closure, because a displacement explains a single one exactly."""
        numbers, first, row, size = np.unique(family, return_index=True, return_inverse=True, return_counts=True)
        shared = (size > 1) & (numbers >= 0)
        members, index = np.flatnonzero(shared[row]), np.cumsum(shared) - 1
        return cls.about(claims, members, index[row[members]], claims.displaced[first[shared]]).settled()

    @classmethod
    def about(cls, claims: Displacements, members: Ints, family: Ints, displacement: Floats) -> _Families:
        moved = displacement[family] @ claims.at_b[members]
        predicted = se3.inverse(claims.at_a[members]) @ moved
        error = se3.log(se3.between(claims.measured[members], predicted))[:, claims.axes]
        return cls(
            claims, members, family, displacement, np.linalg.inv(claims.noise[members]), error,
            -claims.adjoint(se3.inverse(predicted)), claims.adjoint(se3.inverse(moved)),
        )  # fmt: skip

    def settled(self) -> _Families:
        """Move the displacements to the least squares of the closures for given poses, and linearise again."""
        if not len(self.displacement):
            return self
        step = np.asarray(-np.linalg.solve(self._own(), self._pull()[:, :, None]), np.float64)
        displacement = _displaced(self.displacement, step, self.claims.axes)
        return self.about(self.claims, self.members, self.family, displacement)

    @property
    def a(self) -> Ints:
        return self.claims.a[self.members]

    @property
    def b(self) -> Ints:
        return self.claims.b[self.members]

    @property
    def chi2(self) -> float:
        return float(np.einsum("mi,mij,mj->", self.error, self.information, self.error))

    def _pull(self) -> Floats:
        """Derivative (F, d) of half the chi-square by the displacements."""
        by_error = self.information @ self.error[:, :, None]
        return self._summed(np.swapaxes(self.by_displacement, 1, 2) @ by_error)[:, :, 0]

    def _own(self) -> Floats:
        """Information (F, d, d) of the displacements for given poses."""
        return self._summed(np.swapaxes(self.by_displacement, 1, 2) @ self.information @ self.by_displacement)

    def _summed(self, values: Floats) -> Floats:
        """Sums (F, ...) over the closures of each family."""
        result = np.zeros((len(self.displacement), *values.shape[1:]))
        np.add.at(result, self.family, values)
        return result

    def added_to(self, matrix: Blocks) -> Blocks:
        """Add the information of these closures, at given displacements, to that of the poses."""
        ab, edges = np.swapaxes(self.by_a, 1, 2) @ self.information, self.claims.edges[self.members]
        diagonal, other = matrix.diagonal.copy(), matrix.other.copy()
        np.add.at(diagonal, self.a, ab @ self.by_a)
        np.add.at(diagonal, self.b, self.information)
        other[edges] += np.where((matrix.a[edges] > matrix.b[edges])[:, None, None], np.swapaxes(ab, 1, 2), ab)
        return matrix._replace(diagonal=diagonal, other=other)

    def eliminated(self, factor: Cholesky) -> _Normal:
        """Eliminate the poses, whose information with these closures is `factor`."""
        F, d, a, b, N = len(self.displacement), len(self.claims.axes), self.a, self.b, len(self.claims.chain.poses)
        weighted = self.information @ np.concatenate([self.by_displacement, self.error[:, :, None]], axis=2)

        def seen(rows: Ints, pulls: Floats) -> Floats:
            """By how much all closures see the poses move if these pull."""
            right = np.zeros((N, d, pulls.shape[2]))
            np.add.at(right, a[rows], np.swapaxes(self.by_a[rows], 1, 2) @ pulls)
            np.add.at(right, b[rows], pulls)
            moved = factor.solve(right)
            return np.swapaxes(weighted, 1, 2) @ (self.by_a @ moved[a] + moved[b])

        information = np.zeros((F, d, F, d))
        for family in range(F):
            rows = np.flatnonzero(self.family == family)
            information[:, :, family] = -self._summed(seen(rows, weighted[rows, :, :d])[:, :d])
        information[np.arange(F), :, np.arange(F)] += self._own()
        by_error = seen(np.arange(len(a)), weighted[:, :, d:])[:, :, 0] if F else np.zeros((0, d + 1))
        pull = self._pull() - self._summed(by_error[:, :d])
        return _Normal(information.reshape(F * d, F * d), pull.ravel(), float(by_error[:, d].sum()))
