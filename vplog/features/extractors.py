"""Every way to find local features: what pipelines may name."""

from __future__ import annotations

from typing import Annotated

from pydantic import Field

from vplog.features.learned import OnnxFeatureSettings
from vplog.features.sift import SiftSettings

FeatureSettings = Annotated[SiftSettings | OnnxFeatureSettings, Field(discriminator="kind")]
"""Every extractor, by its `kind`."""
