"""The optimisers to choose from. To add one: a module with its settings, one name here."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from vplog.graph.gnc import GncSettings
from vplog.graph.lm import LmSettings

__all__ = ["GncSettings", "LmSettings", "OptimiserSettings"]

OptimiserSettings = Annotated[GncSettings | LmSettings, Field(discriminator="kind")]
