"""The optimisers to choose from. To add one: a module with its settings, one name here."""

from __future__ import annotations

from typing import Annotated

import numpy as np
from pydantic import Field

from vplog.data import Floats, Ints, PoseGraph
from vplog.graph.build import checked
from vplog.graph.gnc import Decision, GncSettings
from vplog.graph.lm import LmSettings
from vplog.graph.pcm import PcmSettings
from vplog.graph.robust_kernels import CauchySettings, DcsSettings, GemanMcClureSettings
from vplog.graph.search import Cost
from vplog.graph.slips import STANDS, Slipping
from vplog.graph.variance_components import Sigmas
from vplog.stages import Optimiser

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
    return Decision(graph, optimiser(graph), Sigmas(), Slipping.nowhere(graph))


def about_slips(decision: Decision, names: Ints) -> list[str]:
    """A warning of each run of steps in which the odometry slips. `names` (N,) are those of the poses."""
    state, graph = decision.slipping.state, decision.graph
    edges = decision.slipping.edges
    first = np.minimum(graph.a[edges], graph.b[edges])
    edges = edges[np.argsort(first, kind="stable")]
    first = np.sort(first)
    cuts = np.flatnonzero((np.diff(first) > 1) | (np.diff(state[edges]) != 0)) + 1
    return [
        f"The closures contradict the odometry between poses {names[run[0]]} and {names[run[-1] + 1]}: the robot "
        f"{'stood still' if state[edges[start]] == STANDS else 'moved as elsewhere'}. Its odometry is not used there."
        for start, run in zip([0, *cuts.tolist()], np.split(first, cuts), strict=True)
        if len(run)
    ]
