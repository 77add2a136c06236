"""The optimisers to choose from. To add one: a module with its settings, one name here."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from vplog.graph.cauchy import CauchySettings
from vplog.graph.dcs import DcsSettings
from vplog.graph.geman_mcclure import GemanMcClureSettings
from vplog.graph.gnc import GncSettings
from vplog.graph.lm import LmSettings
from vplog.graph.pcm import PcmSettings

__all__ = [
    "CauchySettings",
    "DcsSettings",
    "GemanMcClureSettings",
    "GncSettings",
    "LmSettings",
    "OptimiserSettings",
    "PcmSettings",
]

OptimiserSettings = Annotated[
    GncSettings | PcmSettings | DcsSettings | CauchySettings | GemanMcClureSettings | LmSettings,
    Field(discriminator="kind"),
]
