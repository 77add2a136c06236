"""The optimisers to choose from. To add one: a module with its settings, one name here."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from vplog.data import Floats, Ints, PoseGraph
from vplog.graph.build import checked
from vplog.graph.consistency import OdometryChain, is_loop, runs
from vplog.graph.episodes import Episodes
from vplog.graph.false_volume import log_false_volume
from vplog.graph.gnc import Decision, GncSettings
from vplog.graph.lm import LmSettings
from vplog.graph.pcm import PcmSettings
from vplog.graph.robust_kernels import CauchySettings, DcsSettings, GemanMcClureSettings
from vplog.graph.search import Cost
from vplog.graph.variance_components import Sigmas
from vplog.stages import Optimiser

_SHARE, _PLACES = 1 / 3, 3
"""Share of the closures, and their runs, that agree on a displacement before it is said to be the odometry's."""

OptimiserSettings = Annotated[
    GncSettings | PcmSettings | DcsSettings | CauchySettings | GemanMcClureSettings | LmSettings,
    Field(discriminator="kind"),
]


def decided(
    graph: PoseGraph, optimiser: Optimiser, cost: Cost | None = None, log_odds: Floats | None = None
) -> Decision:
    """Decide which closures are true, and solve the graph with them.

    `gnc` stands for the hypothesis of greatest posterior density, less the `cost` of other measurements. Every other
    optimiser decides by itself, and its solution is returned unchanged. `log_odds` (E,) are the log odds that an edge
    is false, by recognition and geometry.

    Raises GraphError if the graph cannot be solved.
    """
    if isinstance(optimiser, GncSettings):
        return optimiser.decided(graph, cost, log_odds)
    graph, _ = checked(graph)
    return Decision(graph, optimiser(graph), Sigmas())


def about_jump(decision: Decision, names: Ints) -> list[str]:
    """A warning where many rejected closures claim one displacement, as they do across a step of the odometry that is
    far beyond its noise, where a wheel slipped or frames are missing. `names` (N,) are those of the poses."""
    graph, loops = decision.graph, is_loop(decision.graph)
    rejected = np.flatnonzero(loops & (decision.solution.weight < 0.5))
    if len(rejected) <= _SHARE * loops.sum():
        return []
    chain = OdometryChain.of(graph)
    episodes = Episodes.of(graph, rejected, chain, log_false_volume(graph, chain.poses), None)
    largest = episodes.edges[episodes.families == np.bincount(episodes.families).argmax()]
    places = sum(1 for _ in runs(graph, largest))
    if len(largest) <= _SHARE * loops.sum() or places < _PLACES:
        return []
    ends = np.sort([graph.a[largest], graph.b[largest]], axis=0)
    first, last = int(ends[0].max()), int(ends[1].min())
    if first >= last:
        return []
    return [
        f"{len(largest)} rejected closures of {places} places agree on one displacement: they are true if the odometry "
        f"jumps between poses {names[first]} and {names[last]}. Look at it there."
    ]
