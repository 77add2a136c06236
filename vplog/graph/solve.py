"""The optimisers to choose from. To add one: a module with its settings, one name here."""

from __future__ import annotations

from typing import TYPE_CHECKING, Annotated

from pydantic import Field

from vplog.graph.consistency import KNOWN_TO, keep_odometry_if_worse
from vplog.graph.gnc import GncSettings
from vplog.graph.lm import LmSettings
from vplog.graph.pcm import PcmSettings
from vplog.graph.robust_kernels import CauchySettings, DcsSettings, GemanMcClureSettings

if TYPE_CHECKING:
    from vplog.data import PoseGraph, Solution
    from vplog.stages import Optimiser

__all__ = [
    "CauchySettings",
    "DcsSettings",
    "GemanMcClureSettings",
    "GncSettings",
    "LmSettings",
    "OptimiserSettings",
    "PcmSettings",
    "gated",
]

OptimiserSettings = Annotated[
    GncSettings | PcmSettings | DcsSettings | CauchySettings | GemanMcClureSettings | LmSettings,
    Field(discriminator="kind"),
]


def gated(graph: PoseGraph, optimiser: Optimiser) -> Solution:
    """What the optimiser makes of the graph, or the odometry poses where that cannot be believed.

    `gnc` has held every closure that it keeps against all others, so what odometry is bent by is then sooner the noise,
    which nobody knows so well; what the others believe has to pass by the noise as said.
    """
    return keep_odometry_if_worse(graph, optimiser(graph), KNOWN_TO if isinstance(optimiser, GncSettings) else None)
