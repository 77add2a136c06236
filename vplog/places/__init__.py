"""Place recognition. A method is a settings object; the union below is what pipelines may name."""

from __future__ import annotations

from typing import Annotated, Any, get_args

from pydantic import Field

from vplog.places.bobb import BobbSettings
from vplog.places.bobb_paper import PaperBobbSettings
from vplog.places.bovf import BovfSettings
from vplog.places.fabmap import FabmapSettings
from vplog.places.gist import GistSettings
from vplog.places.hybrid import HybridSettings
from vplog.places.network_vector import OnnxSettings
from vplog.places.plugin import PluginSettings
from vplog.places.thumbnail import ThumbnailSettings
from vplog.places.vectors import VectorsSettings
from vplog.places.vlad import VladSettings

PlaceSettings = Annotated[
    BobbSettings
    | PaperBobbSettings
    | BovfSettings
    | FabmapSettings
    | GistSettings
    | HybridSettings
    | OnnxSettings
    | PluginSettings
    | ThumbnailSettings
    | VectorsSettings
    | VladSettings,
    Field(discriminator="kind"),
]
"""Every recogniser, by its `kind`."""
KINDS: dict[str, Any] = {one.model_fields["kind"].default: one for one in get_args(get_args(PlaceSettings)[0])}
"""The members of the union by kind."""
