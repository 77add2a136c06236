"""The linear systems of pose graphs: eliminated by GTSAM, or by our own supernodes where there are many poses.

The equations are the same at every size, so which of the two solves them decides nothing but the time. Supernodes are
compiled on first use, half a minute, and then faster: Levenberg-Marquardt takes 14.9 s at 100 000 poses where GTSAM
takes 25.8, and GNC 33.8 s at 30 000 where GTSAM takes 168.
"""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property
from typing import TYPE_CHECKING

import gtsam
import numpy as np

from vplog.errors import GraphError
from vplog.graph.sparse import selected_inversion
from vplog.graph.sparse.cholesky import OPEN, Cholesky

if TYPE_CHECKING:
    from collections.abc import Callable

    from vplog.data import Floats, Int32s, Ints
    from vplog.graph.sparse.frontal import Blocks
    from vplog.graph.sparse.symbolic import Elimination

LARGE_POSES = 10_000
"""Poses from which on supernodes are taken; below it GTSAM takes a second at most, and nothing need be compiled."""


def factorised(matrix: Blocks, shape: Callable[[], Elimination]) -> Supernodes | BayesTree:
    """The matrix, ready to be solved and inverted; `shape` is asked for only where supernodes are taken.

    Raises GraphError where the matrix is not positive definite, with GTSAM not before it is used.
    """
    return Supernodes.of(shape(), matrix) if len(matrix.diagonal) >= LARGE_POSES else BayesTree(matrix)


class Supernodes(Cholesky):
    """Our own factor with blocks of the inverse."""

    def inverse_blocks(self, a: Int32s | Ints, b: Int32s | Ints) -> tuple[Floats, Floats, Floats]:
        """Blocks (K, d, d) of the inverse at a, a; at a, b; and at b, b, of pairs that the shape was made with."""
        return selected_inversion.inverse_blocks(self, a, b)

    def joint_inverse(self, nodes: Ints) -> Floats:
        """The inverse (K d, K d) at a few different nodes (K,)."""
        return selected_inversion.joint_inverse(self, nodes)

    def log_determinant(self) -> float:
        """Log of the determinant of the matrix."""
        wide = np.diff(self.shape.first) * self.size
        below = np.diff(self.shape.start) * self.size
        # the diagonal of each supernode's rows of R, (wide, wide + below) one after the other
        node = np.repeat(np.arange(len(wide)), wide)
        column = np.arange(len(node)) - np.repeat(np.cumsum(wide) - wide, wide)
        return 2.0 * float(np.log(self.values[self.begin[node] + column * (wide + below + 1)[node]]).sum())


@dataclass(frozen=True, eq=False)
class BayesTree:
    """A matrix that GTSAM eliminates, as HessianFactors."""

    matrix: Blocks

    def solve(self, right: Floats) -> Floats:
        """x (n, d, c) of matrix x = right (n, d, c)."""
        n, size, columns = right.shape
        try:
            found = _as_factors(self.matrix, right).optimize()
        except RuntimeError:
            raise GraphError(OPEN) from None
        return np.swapaxes(np.array([found.at(node) for node in range(n)]).reshape(n, columns, size), 1, 2)

    @cached_property
    def tree(self) -> gtsam.GaussianBayesTree:
        try:
            return _as_factors(self.matrix, np.zeros((*self.matrix.diagonal.shape[:2], 1))).eliminateMultifrontal()
        except RuntimeError:
            raise GraphError(OPEN) from None

    def inverse_blocks(self, a: Int32s | Ints, b: Int32s | Ints) -> tuple[Floats, Floats, Floats]:
        """Blocks (K, d, d) of the inverse at a, a; at a, b; and at b, b, of pairs that have a block in the matrix.

        From the root down, each clique with the inverse at its separator, which its parent knows: Takahashi et al.
        1973; Kaess and Dellaert, RAS 2009, section 3.
        """
        size = self.matrix.diagonal.shape[1]
        ends: dict[int, list[tuple[int, int]]] = {}
        for row, (one, other) in enumerate(zip(a.tolist(), b.tolist(), strict=True)):
            ends.setdefault(one, []).append((row, other))
            ends.setdefault(other, []).append((row, one))
        aa, ab, bb = (np.zeros((len(a), size, size)) for _ in range(3))
        ready = [(clique, np.zeros((0, 0))) for clique in self.tree.roots()]
        while ready:
            clique, separator = ready.pop()
            keys = clique.conditional().keys()
            block, inner = _clique_inverse(clique.conditional(), separator)
            place = {key: slice(k * size, (k + 1) * size) for k, key in enumerate(keys)}
            for key in keys[: inner // size]:
                for row, other in ends.get(key, ()):
                    if other in place:
                        first, second = (place[key], place[other]) if a[row] == key else (place[other], place[key])
                        aa[row], ab[row], bb[row] = block[first, first], block[first, second], block[second, second]
            for number in range(clique.nrChildren()):
                child = clique[number]
                below = child.conditional()
                shared = below.keys()[below.R().shape[0] // size :]
                rows = (np.array([place[key].start for key in shared], int)[:, None] + np.arange(size)).ravel()
                ready.append((child, block[rows[:, None], rows]))
        return aa, ab, bb

    def joint_inverse(self, nodes: Ints) -> Floats:
        """The inverse (K d, K d) at a few different nodes (K,)."""
        joint = self.tree.jointMarginalCovariance(nodes.tolist())
        return np.block([[joint.at(one, other) for other in nodes.tolist()] for one in nodes.tolist()])

    def log_determinant(self) -> float:
        """Log of the determinant of the matrix."""
        return 2.0 * float(self.tree.logDeterminant())


def _clique_inverse(conditional: gtsam.GaussianConditional, separator: Floats) -> tuple[Floats, int]:
    """The inverse at the rows of a clique, frontal ones first, from that at its separator; and how many are frontal."""
    R_inv = np.linalg.inv(conditional.R())
    gain = -R_inv @ conditional.S()
    cross = gain @ separator
    inner = len(R_inv)
    inverse = np.empty((inner + len(separator), inner + len(separator)))  # np.block takes as long as the products
    inverse[:inner, :inner] = R_inv @ R_inv.T + cross @ gain.T
    inverse[:inner, inner:], inverse[inner:, :inner], inverse[inner:, inner:] = cross, cross.T, separator
    return inverse, inner


def _as_factors(matrix: Blocks, right: Floats) -> gtsam.GaussianFactorGraph:
    """The system of the matrix and right sides (n, d, c), which become one vector of c d numbers for each node."""
    columns = np.eye(right.shape[2])
    rows = right.shape[1] * right.shape[2]
    diagonal, other = (
        np.einsum("cd,nij->ncidj", columns, blocks).reshape(-1, rows, rows)
        for blocks in (matrix.diagonal, matrix.other)
    )
    result, zero, none = gtsam.GaussianFactorGraph(), np.zeros((rows, rows)), np.zeros(rows)
    for node, (block, side) in enumerate(zip(diagonal, np.swapaxes(right, 1, 2).reshape(-1, rows), strict=True)):
        result.push_back(gtsam.HessianFactor(node, block, side, 0.0))
    on = matrix.other.any((1, 2))
    for a, b, block in zip(matrix.a[on].tolist(), matrix.b[on].tolist(), other[on], strict=True):
        result.push_back(gtsam.HessianFactor(a, b, zero, block, none, zero, none, 0.0))
    return result
