"""Places as the vector that a network gives of the whole image: anyone's, in an ONNX file."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import ClassVar, Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray

from vplog.data import Bytes, Features, Frame, Reference
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.features.onnx_model import NetworkSettings
from vplog.places.dense import VectorState, unit
from vplog.places.library_files import RelearnedSettings, keep_references

MAX_DIMENSIONS = 2**16
"""Values of a vector: eight times those of the longest in the field, SALAD's 8448 (Izquierdo & Civera, CVPR 2024)."""


class OnnxSettings(NetworkSettings, RelearnedSettings):
    """A network's vector of the whole image. It learns nothing: the references only go into the library."""

    LOCATIONS: ClassVar = NetworkSettings.LOCATIONS

    kind: Literal["onnx"] = "onnx"
    """Name of the recogniser."""

    def learn(self, references: Iterable[Reference], execution: Execution) -> OnnxState:
        """Nothing to learn. Raises LibraryError where there is no reference, or the network does not take it."""
        used = keep_references(references)
        picture = np.repeat(used[0].image[..., None], 1 if self.network.colour == "grey" else 3, axis=2)
        return OnnxState(self, used, pa.list_(pa.float16(), len(self.vector(picture))))

    def vector(self, image: Bytes) -> NDArray[np.float16]:
        """(D,) of unit length of (H, W, C) pixels. Raises LibraryError where the network gives something else."""
        found = self.run(image, [self.network.output])[0]
        if found.shape[:1] != (1,) or not 1 <= found.size <= MAX_DIMENSIONS or found.dtype.kind != "f":
            shape = " x ".join(map(str, found.shape))
            raise LibraryError(
                f"{self.model} gives {shape} values of {found.dtype} for an image, not a vector of at most "
                f"{MAX_DIMENSIONS}. Name the output that is one in its .yaml."
            )
        if not np.isfinite(found).all():
            raise LibraryError(f"{self.model} gives values that are not finite for an image. Look at mean and std.")
        return unit(found.reshape(-1).astype(np.float32)).astype(np.float16)


@dataclass(frozen=True, eq=False)
class OnnxState(VectorState):
    """The network. Shared freely between threads."""

    settings: OnnxSettings  # pyrefly: ignore[bad-override]
    references: list[Reference]  # pyrefly: ignore[bad-override]
    arrow_type: pa.FixedSizeListType  # pyrefly: ignore[bad-override]

    @property
    def colour(self) -> bool:
        return self.settings.network.colour != "grey"

    def describe_frame(self, frame: Frame) -> NDArray[np.float16]:
        """(D,) of unit length."""
        return self.settings.vector(self.settings.network.image_of(frame))

    def describe(self, features: Features) -> NDArray[np.float16]:
        """Raises LibraryError: features are no image."""
        raise LibraryError("A network needs the image itself, and only its features are given. Give the log.")
