"""Local features of a network in an ONNX file that gives points and descriptors: SuperPoint, ALIKED, XFeat and others.

Descriptors become bytes as SIFT's are: whole numbers that are not negative, of length 512. Each value has two, one for
its positive and one for its negative part, so that distances between like values stay, and histograms' kernels and
L1 distances mean what they mean for SIFT.
"""

from __future__ import annotations

from typing import Any, ClassVar, Literal

import numpy as np
from numpy.typing import NDArray
from pydantic import Field

from vplog.data import Bytes, Features, Float32s
from vplog.errors import LibraryError
from vplog.features.onnx_model import NetworkInput, NetworkSettings
from vplog.features.sift import depth_at, thumbnail_of_image

_LENGTH = np.float32(512)
"""Length of a descriptor, as of SIFT's by OpenCV, for which thresholds are meant."""
_ALIKE = 0.01
"""Share by which lengths of descriptors that a network normalises differ at most, in half precision, too."""
_MOST_VALUES = 1024
"""Values of a descriptor: four times SuperPoint's."""


class LocalNetwork(NetworkInput):
    """Input of a network of local features, and the names of its outputs."""

    points: str = "keypoints"
    """Name of the output with (N, 2) x and y in px of the image that it gets, (0, 0) the centre of the first."""
    descriptors: str = "descriptors"
    """Name of the output with (N, D) or (D, N) descriptors."""
    scores: str = ""
    """Name of the output with (N,) scores, the strongest first of which are kept; empty where they come in order."""
    diameter_px: float = Field(default=16.0, gt=0)
    """Diameter of the neighbourhood that a feature describes, in px of the network's input: 16 is two cells of most."""


class OnnxFeatureSettings(NetworkSettings):
    """Local features of a network, which gets the grey image in each of its channels."""

    LOCATIONS: ClassVar = NetworkSettings.LOCATIONS

    kind: Literal["onnx"] = "onnx"
    """Name of the extractor."""
    network: LocalNetwork = LocalNetwork()
    """Its input and outputs; those left out are read from the YAML."""
    max_features: int = Field(default=2000, ge=1)
    """Features kept of an image."""

    def __call__(self, image: Bytes, depth_m: Float32s | None = None) -> Features:
        """Features of a grey (H, W) uint8 image; `depth_m` (H, W) float32 m registered to it is read at the points.

        Raises LibraryError where the network does not take it, or gives something else.
        """
        network, (height, width) = self.network, image.shape
        names = [name for name in (network.points, network.descriptors, network.scores) if name]
        pixels = np.repeat(image[..., None], 1 if network.colour == "grey" else 3, axis=2)
        axes = (2, 2, 1)  # without that of a batch, which networks may give or not
        found = [
            one[0] if one.ndim == axis + 1 and len(one) == 1 else one
            for one, axis in zip(self.run(pixels, names), axes, strict=False)
        ]
        points, descriptors = self._paired(found[0], found[1])
        order = np.arange(len(points))
        if network.scores:
            if found[2].shape != (len(points),):
                raise self._wrong("scores", found[2])
            order = np.lexsort((points[:, 1], points[:, 0], -found[2]))
        taken = network.taken(height, width)
        scale = np.array([width / taken[1], height / taken[0]], np.float32)
        points = (points.astype(np.float32) + 0.5) * scale - 0.5
        inside = np.all((points > -0.5) & (points < np.array([width, height]) - 0.5), axis=1)
        order = order[inside[order]][: self.max_features]
        points = points[order]
        return Features(
            points=points,
            sizes=np.full(len(points), network.diameter_px * np.sqrt(scale[0] * scale[1]), np.float32),
            descriptors=as_bytes(descriptors[order]),
            depth_m=depth_at(points, depth_m),
            width=width,
            height=height,
            thumbnail=thumbnail_of_image(image),
        )

    def _paired(self, points: NDArray[Any], descriptors: NDArray[Any]) -> tuple[NDArray[Any], NDArray[Any]]:
        """Points (N, 2) and descriptors (N, D), which a network may give as (D, N). Raises LibraryError for other
        shapes or types, and values that are not finite."""
        if points.ndim != 2 or points.shape[1] != 2 or not np.isfinite(points).all():
            raise self._wrong("points", points)
        if descriptors.ndim == 2 and (len(descriptors) != len(points) or _are_columns(descriptors)):
            descriptors = descriptors.T
        fits = descriptors.ndim == 2 and descriptors.dtype.kind == "f" and len(descriptors) == len(points)
        if not fits or not 1 <= descriptors.shape[1] <= _MOST_VALUES or not np.isfinite(descriptors).all():
            raise self._wrong("descriptors", descriptors)
        return points, descriptors

    def _wrong(self, name: str, found: NDArray[Any]) -> LibraryError:
        shape = " x ".join(map(str, found.shape))
        return LibraryError(
            f"{self.model}: output {getattr(self.network, name)} has {shape} values of {found.dtype}, which have the "
            f"wrong shape or type for {name} or are not finite. Name the right outputs in its .yaml."
        )


def _are_columns(descriptors: NDArray[Any]) -> bool:
    """Whether as many descriptors as each has values are the columns: these are equally long, and the rows are not."""
    if descriptors.shape[0] != descriptors.shape[1]:
        return False
    of_rows, of_columns = (np.linalg.norm(descriptors.astype(np.float64), axis=axis) for axis in (1, 0))
    return bool(np.ptp(of_columns) <= _ALIKE * of_columns.mean() and np.ptp(of_rows) > _ALIKE * of_rows.mean())


def as_bytes(descriptors: NDArray[Any]) -> Bytes:
    """(N, 2 D) uint8 of (N, D) floats: at length 512 the positive parts, then the negative ones."""
    values = descriptors.astype(np.float32)
    values *= _LENGTH / np.maximum(np.linalg.norm(values, axis=1, keepdims=True), np.float32(1e-9))
    both = np.concatenate([np.maximum(values, 0), np.maximum(-values, 0)], axis=1)
    return np.minimum(np.rint(both), 255).astype(np.uint8)
