"""Place recognition. A method is a settings object; the union below is what pipelines may name."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from vplog.places.bobb import BobbSettings

PlaceSettings = Annotated[BobbSettings, Field()]
"""Every recogniser, told apart by `kind`. A second one makes this a discriminated union."""
