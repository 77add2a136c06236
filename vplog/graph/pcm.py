"""Pairwise consistency maximisation: the largest set of closures that agree with each other two by two.

Mangelson, Dominic, Eustice, Vasudevan: Pairwise Consistent Measurement Set Maximization for Robust Multi-Robot Map
Merging, ICRA 2018. Needs no start, and works where odometry does not join the ends of a closure, as between robots.
"""

from __future__ import annotations

from typing import Literal

import numpy as np
from pydantic import Field

from vplog.data import Bools, Ints, PoseGraph, Solution
from vplog.geometry import se3
from vplog.graph.build import checked
from vplog.graph.clique import largest_clique
from vplog.graph.consistency import OdometryChain, chi2_quantile, degrees_of_freedom, far_from_odometry, is_loop
from vplog.graph.displacements import Displacements
from vplog.graph.factors import Factors
from vplog.graph.initialise import initial_poses
from vplog.graph.lm import solve_weighted
from vplog.settings import Settings

_PAIRS = 1 << 12
"""Pairs of closures that are compared at once: some megabytes."""


class PcmSettings(Settings):
    """Largest set of pairwise consistent closures, then least squares."""

    kind: Literal["pcm"] = "pcm"
    """Name of the method."""
    pair_probability: float = Field(default=0.99, gt=0, lt=1)
    """Two true closures are found consistent with this probability: chi-square of 6 degrees up to that quantile."""
    gate_probability: float = Field(default=0.999999, gt=0, lt=1)
    """A closure further from the odometry alone than this quantile (6.2 sigma) is out from the start."""
    most_closures: int = Field(default=3000, ge=1)
    """Most closures compared, those nearest to the odometry: 3000 have 4.5 million pairs, some 20 s."""
    clique_steps: int = Field(default=100_000, ge=1)
    """Branches of the exact search for the largest set, some seconds; the best one so far is taken after that."""
    max_iterations: int = Field(default=100, ge=1)
    """Steps after which the last solve gives up."""
    tolerance: float = Field(default=1e-6, gt=0)
    """The last solve has converged when a step gains less than this share of the error."""

    def __call__(self, graph: PoseGraph) -> Solution:
        """Solve. Weights are 1 for odometry, 0 or 1 for loops. Raises GraphError where the graph cannot be solved."""
        graph, _ = checked(graph)
        factors = Factors.of(graph)
        loops = np.flatnonzero(is_loop(graph))
        weight = np.ones(len(graph.a))
        found = ""
        if len(loops):
            weight[loops] = 0.0
            near = loops[~far_from_odometry(graph, self.gate_probability)[loops]]
            accepted, exact = self.consistent(graph, near)
            weight[accepted] = 1.0
            found = (
                f"{len(accepted)} of {len(loops)} closures were kept, the largest consistent set "
                f"{'there is' if exact else 'found'}; {len(loops) - len(near)} were too far from the odometry. "
            )
        start = initial_poses(factors, weight)
        return solve_weighted(factors, weight, start, self.max_iterations, self.tolerance, found)

    def consistent(self, graph: PoseGraph, loops: Ints, chain: OdometryChain | None = None) -> tuple[Ints, bool]:
        """The largest set among the edges `loops` found, in order, and whether there is none larger.

        `chain` is the graph's where it is at hand.
        """
        chain, chosen = chain or OdometryChain.of(graph), loops
        if len(loops) > self.most_closures:
            apart = chain.distance(loops, graph)
            chosen = np.sort(loops[np.argsort(apart, kind="stable")[: self.most_closures]])
        bound = chi2_quantile(self.pair_probability, degrees_of_freedom(graph))
        members, exact = largest_clique(consistency(graph, chosen, bound, chain), self.clique_steps)
        return chosen[members], exact and len(chosen) == len(loops)


def consistency(graph: PoseGraph, loops: Ints, bound: float, chain: OdometryChain | None = None) -> Bools:
    """(K, K) whether each two of the closures agree: the way round both, by odometry, comes back to where it began.

    Mahalanobis distance squared of what they claim up to `bound` (eq. 3). Closures between other pieces of odometry say
    nothing about each other, which counts as agreement.
    """
    chain = chain or OdometryChain.of(graph)
    claims = Displacements(graph, loops, chain)
    piece = np.stack([chain.part[claims.a], chain.part[claims.b]], axis=1)
    result = np.ones((len(loops), len(loops)), bool)
    one, two = np.triu_indices(len(loops), 1)
    alike = (piece[one] == piece[two]).all(1)
    one, two = one[alike], two[alike]
    for first in range(0, len(one), _PAIRS):
        this, other = one[first : first + _PAIRS], two[first : first + _PAIRS]
        result[this, other] = result[other, this] = se3.mahalanobis2(*claims.apart(this, other)) <= bound
    return result
