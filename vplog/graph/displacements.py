"""Displacements of the world between two visits that closures claim."""

from __future__ import annotations

from copy import copy
from dataclasses import replace

import numpy as np

from vplog.data import Floats, Ints, PoseGraph
from vplog.geometry import se3
from vplog.graph.build import AXES, informed
from vplog.graph.consistency import OdometryChain


class Displacements:
    """Displacements D = X_a z X_b^-1 of the world that K closures z claim; X are the poses of a chain, a before b.

    Two closures agree if D_i^-1 D_j is the identity within the noise of both and of the odometry from a_i to a_j and
    from b_i to b_j (Mangelson et al., Pairwise Consistent Measurement Set Maximization, ICRA 2018, eq. 3).
    """

    def __init__(self, graph: PoseGraph, loops: Ints, chain: OdometryChain) -> None:
        """Take the edges `loops` (K,) of the graph; `chain` is the graph's odometry."""
        back = (graph.a[loops] > graph.b[loops])[:, None, None]
        self.edges, self.axes = loops, AXES[graph.dimension]
        self.a = np.minimum(graph.a[loops], graph.b[loops]).astype(np.int64)
        self.b = np.maximum(graph.a[loops], graph.b[loops]).astype(np.int64)
        noise = np.linalg.inv(informed(graph, loops))
        Ad = self.adjoint(graph.a_from_b[loops])
        self.noise = np.where(back, Ad @ noise @ np.swapaxes(Ad, 1, 2), noise)
        """(K, d, d) covariance of the measured motion, in the frame of the later pose."""
        self.measured = np.where(back, se3.inverse(graph.a_from_b[loops]), graph.a_from_b[loops])
        """(K, 4, 4) measured motion, earlier_from_later."""
        self._place(chain)

    def on(self, poses: Floats) -> Displacements:
        """Return the displacements that the closures claim if these are the poses (N, 4, 4)."""
        result = copy(self)
        result._place(replace(self.chain, poses=poses))
        return result

    def _place(self, chain: OdometryChain) -> None:
        self.chain = chain
        self.at_a, self.at_b = (se3.between(chain.poses[:1], chain.poses[end]) for end in (self.a, self.b))
        self.displaced = self.at_a @ self.measured @ se3.inverse(self.at_b)
        """(K, 4, 4) about the first pose."""
        Ad = self.adjoint(self.at_b)
        self.own = np.ascontiguousarray(Ad @ self.noise @ np.swapaxes(Ad, 1, 2))
        """(K, d, d) covariance of the closure's own noise, about the first pose."""
        self.after = np.ascontiguousarray(self.adjoint(se3.inverse(self.displaced)))
        """(K, d, d) moves the odometry's noise at a into the frame of the displacement."""

    def adjoint(self, poses: Floats) -> Floats:
        """Return the adjoints (K, d, d) of poses (K, 4, 4) on the axes of the graph."""
        return se3.adjoint(poses)[:, self.axes][:, :, self.axes]

    def apart(self, first: Ints, second: Ints) -> tuple[Floats, Floats]:
        """Return the twist (P, d) from the displacements `first` (P,) to `second`, and its covariance (P, d, d)."""
        total, after = self.chain.total, self.after[first]
        of_a, of_b = (
            np.where(end[second] >= end[first], 1.0, -1.0)[:, None, None] * (total[end[second]] - total[end[first]])
            for end in (self.a, self.b)
        )
        covariance = self.own[first] + self.own[second] + of_b + after @ of_a @ np.swapaxes(after, 1, 2)
        return se3.log(se3.between(self.displaced[first], self.displaced[second]))[:, self.axes], covariance
