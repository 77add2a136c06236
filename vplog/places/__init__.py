"""Place recognition. A method is a settings object; the union below is what pipelines may name."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from vplog.places.bobb import BobbSettings
from vplog.places.bobb_paper import PaperBobbSettings
from vplog.places.bovf import BovfSettings
from vplog.places.fabmap import FabmapSettings
from vplog.places.gist import GistSettings
from vplog.places.hybrid import HybridSettings
from vplog.places.thumbnail import ThumbnailSettings
from vplog.places.vlad import VladSettings

PlaceSettings = Annotated[
    BobbSettings
    | PaperBobbSettings
    | BovfSettings
    | FabmapSettings
    | GistSettings
    | HybridSettings
    | ThumbnailSettings
    | VladSettings,
    Field(discriminator="kind"),
]
"""Every recogniser, by its `kind`."""
