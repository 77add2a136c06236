"""A recogniser of one's own: mean colours of blocks of the image, which `vplog compare` knows once it is installed."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import cv2
import numpy as np
import pyarrow as pa
from pydantic import Field

from vplog.places.dense import VectorIndex, VectorState, nearness
from vplog.places.library_files import RelearnedSettings, keep_references

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence

    from numpy.typing import NDArray

    from vplog.data import Features, Frame, Reference
    from vplog.execution.execution import Execution


class MeanColours(RelearnedSettings):
    """The settings: what a user may change, each with its default and a sentence."""

    kind: Literal["mean_colours"] = "mean_colours"
    """The name of the entry point."""
    blocks: int = Field(default=8, ge=1, le=64)
    """Blocks along each side."""

    def learn(self, references: Iterable[Reference], execution: Execution) -> MeanColoursState:
        """Make the state; a method that learns would do it here, from the reference images."""
        return MeanColoursState(self, keep_references(references))


class MeanColoursState(VectorState):
    """The state: an image in, a descriptor out, and an index over the descriptors of a map."""

    colour = True
    """Frames are decoded in colour."""

    def __init__(self, settings: MeanColours, references: list[Reference]) -> None:
        self.settings, self.references = settings, references
        self.arrow_type = pa.list_(pa.float16(), 3 * settings.blocks**2)

    def describe_frame(self, frame: Frame) -> NDArray[np.float16]:
        """(3 * blocks^2,) of an image."""
        side = self.settings.blocks
        small = cv2.resize(np.asarray(frame.colour), (side, side), interpolation=cv2.INTER_AREA)
        return (small / 255).astype(np.float16).reshape(-1)

    def describe(self, features: Features) -> NDArray[np.float16]:
        """A recogniser of local features has this in place of `colour` and `describe_frame`."""
        raise TypeError("mean_colours looks at the image itself")

    def index(self, descriptors: Sequence[NDArray[np.float16]]) -> VectorIndex:
        return VectorIndex(self.matrix(descriptors, np.float32), nearness)
