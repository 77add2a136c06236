"""Which library features an image's features are like, and how much each of these matches is worth.

The paper takes every neighbour below one absolute distance for the same word. Distances change with light and blur, so
here a match counts by how much nearer it is than the feature's last neighbour, which nobody takes for the same.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numba
import numpy as np
from pydantic import Field

from vplog.errors import LibraryError
from vplog.places.library import hnsw
from vplog.places.vocabulary import root_sift
from vplog.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Iterable

    from vplog.data import Bytes, Features, Float32s, Int32s, Reference

_ROOT_STEPS = 512.0
"""RootSIFT values are whole steps of 1/512; a byte holds all below one half, and larger ones hardly occur."""


class WeighedMatchSettings(Settings):
    """How features are matched to those of a library."""

    features: int = Field(default=800, ge=1)
    """Strongest features of an image that are used, of those large enough."""
    least_size: float = Field(default=0.006, ge=0, le=1)
    """Smallest feature used, as a share of the image's mean side: below about 3 px of a 640 x 360 image, features are
    grain that another camera, resolution or light does not show again."""
    root_sift: bool = True
    """Compare the roots of descriptors (Arandjelovic & Zisserman 2012) instead of the descriptors."""
    neighbours: int = Field(default=32, ge=2)
    """Nearest library features looked at for each feature; the last one sets the scale of the others' distances."""
    reach: float = Field(default=0.8, gt=0)
    """A match weighs 1 - d2 / (reach x d2 of the last neighbour), squared distances, and nothing below zero."""
    hnsw_links: int = Field(default=16, ge=2)
    """Links of a node in the HNSW graph (Malkov & Yashunin 2018)."""
    hnsw_ef_construction: int = Field(default=40, ge=1)
    """Breadth of the search while the graph is built."""


@dataclass(frozen=True, eq=False)
class Matches:
    """E matches, grouped by reference, increasing; a feature matches a reference once, where it is nearest."""

    start: Int32s
    """(L + 1,) matches of reference r are rows start[r]..start[r + 1]."""
    here: Float32s
    """(E, 2) where in the image, as shares of its sides."""
    there: Float32s
    """(E, 2) where in the reference, as shares of its sides."""
    weight: Float32s
    """(E,) 0..1."""
    features: int
    """Features of the image that were used."""


@dataclass(frozen=True, eq=False)
class Matcher:
    """The features of L references, indexed. Shared freely between threads."""

    references: list[Reference]
    settings: WeighedMatchSettings
    owner: Int32s
    """(F,) reference of each library feature."""
    points: Float32s
    """(F, 2) as shares of the reference's sides."""
    index: Any

    def __len__(self) -> int:
        return len(self.references)

    def match(self, features: Features) -> Matches:
        """Matches of an image. A reference that is the image itself explains nothing, and is left out."""
        used = large_enough(features, self.settings)
        count, L = len(used), len(self.references)
        if count == 0:
            nothing = np.zeros((0, 2), np.float32)
            return Matches(np.zeros(L + 1, np.int32), nothing, nothing, np.zeros(0, np.float32), 0)
        distance, entry = self.index.search(_comparable(used.descriptors, self.settings), self.settings.neighbours)
        itself = _itself(distance, entry, self.owner, L)
        feature, library, weight = _weigh(distance, entry, self.owner, L, itself, self.settings.reach)
        order = np.argsort(self.owner[library], kind="stable")
        feature, library, weight = feature[order], library[order], weight[order]
        start = np.searchsorted(self.owner[library], np.arange(L + 1)).astype(np.int32)
        return Matches(start, shares(used)[feature], self.points[library], weight, count)


def large_enough(features: Features, settings: WeighedMatchSettings) -> Features:
    """The strongest features of those that are large enough."""
    least = settings.least_size * np.sqrt(features.width * features.height)
    rows = np.flatnonzero(features.sizes >= least)[: settings.features]
    return replace(
        features,
        points=features.points[rows],
        sizes=features.sizes[rows],
        descriptors=features.descriptors[rows],
        depth_m=features.depth_m[rows],
    )


def shares(features: Features) -> Float32s:
    """(M, 2) points as shares of the image's sides."""
    return ((features.points + 0.5) / np.array([features.width, features.height])).astype(np.float32)


def index_references(references: Iterable[Reference], settings: WeighedMatchSettings) -> Matcher:
    """Index the references' features. Raises LibraryError where they have none, or are too many to be numbered."""
    kept = [replace(r, features=large_enough(r.features, settings)) for r in references]
    if not kept:
        raise LibraryError("A library needs at least one reference image; none was given.")
    counts = [len(reference.features) for reference in kept]
    if sum(counts) == 0:
        raise LibraryError(f"None of the {len(kept)} reference images has a single feature; choose other images.")
    descriptors = np.concatenate([reference.features.descriptors for reference in kept])
    values = _comparable(descriptors, settings)
    index = hnsw(values, settings.hnsw_links, settings.hnsw_ef_construction, settings.neighbours)
    points = np.concatenate([shares(reference.features) for reference in kept])
    owner = np.repeat(np.arange(len(kept), dtype=np.int32), counts)
    return Matcher(kept, settings, owner, points, index)


def _comparable(descriptors: Bytes, settings: WeighedMatchSettings) -> Float32s:
    """(M, 128) float32 whole numbers 0..255."""
    if not settings.root_sift:
        return descriptors.astype(np.float32)
    return np.minimum(np.rint(root_sift(descriptors) * _ROOT_STEPS), 255.0).astype(np.float32)


@numba.njit(cache=True, nogil=True)
def _itself(distance, entry, owner, L):
    """The reference that most features of the image are found on without any difference, or -1."""
    same = np.zeros(L, np.int32)
    for f in range(distance.shape[0]):
        for k in range(distance.shape[1]):
            if entry[f, k] < 0 or distance[f, k] > 0.0:
                break
            same[owner[entry[f, k]]] += 1
    most = np.argmax(same)
    return most if 2 * same[most] > distance.shape[0] else -1


@numba.njit(cache=True, nogil=True)
def _weigh(distance, entry, owner, L, itself, reach):
    """(feature, library feature, weight) of every match; the weights of a feature share it between its references.

    A feature seen on d references is divided by the root of d: it tells less, as a frequent word does.
    """
    F, K = distance.shape
    feature, library = np.empty(F * K, np.int32), np.empty(F * K, np.int32)
    weight = np.empty(F * K, np.float32)
    seen = np.full(L, -1, np.int32)
    count = 0
    for f in range(F):
        last = 0.0
        for k in range(K):
            if entry[f, k] >= 0 and owner[entry[f, k]] != itself:
                last = distance[f, k]
        first = count
        for k in range(K):
            if entry[f, k] < 0:
                continue
            reference = owner[entry[f, k]]
            if reference == itself or seen[reference] == f:
                continue
            w = 1.0 - distance[f, k] / (reach * last) if last > 0.0 else 0.0
            if w <= 0.0:
                break
            seen[reference] = f
            feature[count], library[count], weight[count] = f, entry[f, k], w
            count += 1
        share = 1.0 / np.sqrt(max(count - first, 1))
        for at in range(first, count):
            weight[at] *= share
    return feature[:count], library[:count], weight[:count]
