"""The edges of a graph with what every solve needs to know of them."""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from vplog.data import Bools, Floats, Ints, PoseGraph
from vplog.graph.build import parts
from vplog.graph.sparse.symbolic import Elimination

_ALIKE = 0.99
"""Share of a shape's edges that are still there for it to serve: a new one costs as much as a few steps."""
_SHAPES = 4
"""Shapes that are kept."""


@dataclass(frozen=True, eq=False)
class Factors:
    """The edges of a graph, the pieces that they join, and the shapes in which they were eliminated."""

    graph: PoseGraph
    piece: Ints
    """(N,) number of the piece of odometry that each pose is on, in order of their first poses."""
    eliminations: list[tuple[Bools, Elimination]] = field(default_factory=list, repr=False)
    """The last eliminations, with the edges (E,) of each."""

    @classmethod
    def of(cls, graph: PoseGraph) -> Factors:
        odometry = graph.odometry
        return cls(graph, parts(len(graph.world_from_body), graph.a[odometry], graph.b[odometry]))

    def elimination(self, on: Bools) -> Elimination:
        """A shape that holds all of these edges (E,): one made before where it has few others, else a new one."""
        for edges, shape in self.eliminations:
            if not (on & ~edges).any() and on.sum() >= _ALIKE * edges.sum():
                return shape
        shape = Elimination.of(len(self.graph.world_from_body), self.graph.a[on], self.graph.b[on])
        self.eliminations[:] = [*self.eliminations[1 - _SHAPES :], (on, shape)]
        return shape

    def loose(self, weight: Floats) -> Ints:
        """First poses of what no edge of positive weight (E,) joins to pose 0; such parts stay where they are."""
        if not self.piece.any():
            return np.empty(0, np.int64)
        on = weight > 0
        joined = parts(int(self.piece.max()) + 1, self.piece[self.graph.a[on]], self.piece[self.graph.b[on]])
        _, first = np.unique(joined[self.piece], return_index=True)
        return first[1:]
