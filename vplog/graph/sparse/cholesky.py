"""Factors R^T R of large sparse symmetric matrices in blocks, and what solves with them.

The reason for linear algebra of our own is the selected inverse (`inverse_blocks`): for 850 poses and 125 closures
it takes 9.8 ms, where GTSAM's marginals take 460 ms. To linearise and solve takes 0.4 to 0.5 times the CPU time
of native GTSAM on planar graphs of 1,000 to 10,000 poses, and 1.1 to 1.4 times on sphere2500 and torus3D. Without
supernodes, factorising sphere2500, torus3D and city10000 takes 2.0 to 2.4 times as long.
`python -m tests.benchmarks sparse` measures the times.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, NamedTuple, Self

import numpy as np

from vplog.data import Floats, Int32s, Ints
from vplog.errors import GraphError
from vplog.graph.sparse import kernels

if TYPE_CHECKING:
    from vplog.graph.sparse.symbolic import Elimination

OPEN = "The graph does not constrain all its poses. Check the information of its edges."


class Blocks(NamedTuple):
    """A symmetric matrix of n x n blocks (d, d)."""

    diagonal: Floats
    """(n, d, d)."""
    a: Int32s | Ints
    """(E,) row of each other block; pairs may repeat, and add."""
    b: Int32s | Ints
    """(E,) its column; never the same."""
    other: Floats
    """(E, d, d) at row a, column b; its transpose at row b, column a."""


@dataclass(frozen=True, eq=False)
class Cholesky:
    """R of a matrix R^T R."""

    shape: Elimination
    size: int
    """d, of a block."""
    values: Floats
    """Rows of R, as in `kernels`."""

    @classmethod
    def of(cls, shape: Elimination, matrix: Blocks) -> Self:
        """Factorise a matrix; blocks that are not in the shape must be 0.

        Raises GraphError if the matrix is not positive definite, to working precision.
        """
        size, place = matrix.diagonal.shape[1], shape.place
        values = np.zeros(shape.panels.begin[-1] * size * size)
        for a, b, blocks in ((place, place, matrix.diagonal), (place[matrix.a], place[matrix.b], matrix.other)):
            begin, step = shape.locate(np.minimum(a, b), np.maximum(a, b), size)
            kernels.add_blocks(values, begin, step, a > b, blocks)
        if not kernels.factorise(shape.panels, size, values):
            raise GraphError(OPEN)
        return cls(shape, size, values)

    def solve(self, right: Floats) -> Floats:
        """x (n, d, c) of R^T R x = right (n, d, c)."""
        moved = np.empty((right.shape[2], *right.shape[:2]))
        moved[:, self.shape.place] = right.transpose(2, 0, 1)
        x = moved.reshape(len(moved), right.shape[0] * right.shape[1])
        for forward in (True, False):
            kernels.substitute(self.shape.panels, self.size, self.values, x, forward)
        return x.reshape(right.shape[2], *right.shape[:2]).transpose(1, 2, 0)[self.shape.place]

    def log_determinant(self) -> float:
        """Log of the determinant of the matrix."""
        begin, step = self.shape.locate(self.shape.place, self.shape.place, self.size)
        along = np.arange(self.size)
        return 2.0 * float(np.log(self.values[begin[:, None] + (step[:, None] + 1) * along]).sum())


def inverse_blocks(factor: Cholesky, a: Int32s | Ints, b: Int32s | Ints) -> tuple[Floats, Floats, Floats]:
    """Return blocks (K, d, d) of the inverse at a, a; at a, b; and at b, b, of pairs that the shape was made with.

    Selected inversion (Takahashi, Fagan and Chen 1973) computes the inverse only at the nonzeros of the factor, so all
    edges of a graph together cost about as much as two factorisations.
    """
    shape, size = factor.shape, factor.size
    one, two = shape.place[a], shape.place[b]
    low, high = np.minimum(one, two), np.maximum(one, two)
    needed = np.zeros(len(shape.panels.first) - 1, bool)
    needed[shape.panels.node[low]] = True
    inverse = np.empty_like(factor.values)
    kernels.invert(shape.panels, size, factor.values, needed, inverse)

    def blocks(row: Ints, column: Ints) -> Floats:
        begin, step = shape.locate(row, column, size)
        along = np.arange(size)
        return inverse[begin[:, None, None] + step[:, None, None] * along[:, None] + along]

    ab = blocks(low, high)
    return blocks(one, one), np.where((one > two)[:, None, None], np.swapaxes(ab, 1, 2), ab), blocks(two, two)
