"""VLAD: Jegou et al., Aggregating local descriptors into a compact image representation, CVPR 2010.

With RootSIFT, intra-normalisation (Arandjelovic & Zisserman, All about VLAD, CVPR 2013) and PCA whitening (Jegou &
Chum, Negative evidences and co-occurrences in image retrieval, ECCV 2012).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import Field

from vplog.data import Features, Float32s, Reference
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places.dense import VectorState, products, unit
from vplog.places.library_files import RelearnedSettings, keep_references
from vplog.places.vocabulary import Vocabulary, learn_vocabulary, root_sift, spread_rows

_MAX_PCA_REFERENCES = 2000
"""Images that the PCA looks at, spread evenly over the references: its time grows with their cube, 1 s for these."""


class VladSettings(RelearnedSettings):
    """Vector of locally aggregated descriptors, whitened by PCA."""

    kind: Literal["vlad"] = "vlad"
    """Name of the recogniser."""
    features: int = Field(default=800, ge=1)
    """Strongest features of an image that are used."""
    centres: int = Field(default=64, ge=1, le=4096)
    """k-means centres, as most of the papers; fewer where the references have too few features."""
    dimensions: int | None = Field(default=128, ge=1)
    """Directions of the PCA that are kept, at most one fewer than there are references. None keeps the whole vector of
    128 values a centre as it is: 16 kB, and on new drives better than a PCA of few references."""
    shrinkage: float = Field(default=1.0, ge=0)
    """Multiple of the mean variance added to each direction's before whitening: few references tell it badly."""
    seed: int = Field(default=0, ge=0)
    """Seed of the first centres of k-means."""

    def learn(self, references: Iterable[Reference], execution: Execution) -> VladState:
        """Centres and PCA from the references. Raises LibraryError where they are fewer than two or featureless."""
        used = keep_references(references, self.features)
        if len(used) < 2:
            raise LibraryError("vlad learns in what its references differ, so it needs at least two; one was given.")
        descriptors = np.concatenate([reference.features.descriptors for reference in used])
        vocabulary = learn_vocabulary(descriptors, self.centres, self.seed, execution)
        if self.dimensions is None:
            return VladState(self, used, vocabulary, None)
        rows = spread_rows(len(used), _MAX_PCA_REFERENCES)
        raw = list(execution.map(lambda row: aggregate(used[row].features, self.features, vocabulary), rows))
        return VladState(self, used, vocabulary, Whitening.learn(np.array(raw), self.dimensions, self.shrinkage))


@dataclass(frozen=True, eq=False)
class VladState(VectorState):
    """Centres and a whitening projection. Shared freely between threads."""

    settings: VladSettings  # pyrefly: ignore[bad-override]
    references: list[Reference]  # pyrefly: ignore[bad-override]
    vocabulary: Vocabulary
    whitening: Whitening | None
    """None for vectors without PCA."""

    @property
    def arrow_type(self) -> pa.FixedSizeListType:  # pyrefly: ignore[bad-override]
        size = self.vocabulary.centres.size if self.whitening is None else len(self.whitening.projection)
        return pa.list_(pa.float16(), size)

    def describe(self, features: Features) -> NDArray[np.float16]:
        """(D,) of unit length; all zero for an image without features."""
        raw = aggregate(features, self.settings.features, self.vocabulary)
        if self.whitening is None or not raw.any():
            return raw[: self.arrow_type.list_size].astype(np.float16)
        return self.whitening.apply(raw).astype(np.float16)


def aggregate(features: Features, count: int, vocabulary: Vocabulary) -> Float32s:
    """(V * 128,) float32 of unit length: for each centre, the sum of what its features differ from it by.

    Jegou et al. 2010, section 3; each centre's part at unit length (Arandjelovic & Zisserman 2013, section 3.2).
    """
    words = vocabulary.quantise(features.descriptors[:count])
    difference = root_sift(features.descriptors[:count]) - vocabulary.centres[words]
    order = np.argsort(words, kind="stable")
    first = np.flatnonzero(np.diff(words[order], prepend=-1))
    parts = np.zeros_like(vocabulary.centres)
    parts[words[order[first]]] = np.add.reduceat(difference[order], first)
    parts /= np.maximum(np.linalg.norm(parts, axis=1, keepdims=True), np.float32(1e-9))
    return unit(parts.reshape(-1))


@dataclass(frozen=True, eq=False)
class Whitening:
    """Projection on the directions in which references differ most, to like variance in each."""

    mean: Float32s
    """(V,)."""
    projection: Float32s
    """(D, V)."""

    @classmethod
    def learn(cls, raw: Float32s, dimensions: int, shrinkage: float) -> Whitening:
        """From (L, V) vectors, by the eigenvectors of their (L, L) products."""
        mean = raw.mean(axis=0)
        centred = (raw - mean).astype(np.float64)
        variance, sides = np.linalg.eigh(centred @ centred.T / len(raw))
        variance = np.maximum(variance, 0)
        order = np.argsort(-variance, kind="stable")[: min(dimensions, len(raw) - 1)]
        directions = sides[:, order].T @ centred
        directions /= np.maximum(np.linalg.norm(directions, axis=1, keepdims=True), 1e-9)
        # an eigenvector's sign is a matter of the machine: let its largest entry be positive
        largest = np.argmax(np.abs(directions), axis=1)
        directions *= np.sign(directions[np.arange(len(order)), largest])[:, None]
        weight = 1 / np.sqrt(np.maximum(variance[order] + shrinkage * variance.mean(), 1e-12))
        return cls(mean.astype(np.float32), (directions * weight[:, None]).astype(np.float32))

    def apply(self, raw: Float32s) -> Float32s:
        """(D,) of unit length of (V,)."""
        return unit(products(self.projection, raw - self.mean))
