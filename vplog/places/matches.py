"""Matches of an image's features with those of a library, each with a weight.

Keypoints match keypoints, and patches at even steps, which bear other light better, match patches. Where the paper has
one absolute distance, a match here weighs by how much nearer it is than the feature's last neighbour.
"""

from __future__ import annotations

import threading
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from typing import Annotated, Any, Generic, TypeVar

import numba
import numpy as np
from pydantic import Field

from vplog.data import Features, Float32s, Floats, Int32s, Ints, Reference
from vplog.errors import LibraryError
from vplog.places.library import hnsw
from vplog.places.library_files import keep_references
from vplog.places.patches import describe_patches
from vplog.places.vocabulary import root_sift_steps
from vplog.settings import Settings

PATCH_WEIGHT = 2.0
"""Weight of a patch's match where patches are used: 169 of them then weigh about as much as 400 keypoints, on the
images of a library among themselves."""
KindWeights = tuple[float, float | Floats]
"""Weight of a match of keypoints, and of one of patches, of which each of the L references may have its own (L,)."""
Described = tuple[Float32s, Float32s]
"""Descriptors (M, 128), whole numbers 0..255, and (M, 2) points as shares of the image's sides."""


Value = TypeVar("Value")


class Once(Generic[Value]):
    """A value made by the first call, from whichever thread; the others wait for it."""

    def __init__(self, make: Callable[[], Value]) -> None:
        self._make, self._made, self._lock = make, list[Value](), threading.Lock()

    def __call__(self) -> Value:
        with self._lock:
            if not self._made:
                self._made.append(self._make())
        return self._made[0]


class WeighedMatchSettings(Settings):
    """Matching of features to those of a library."""

    features: int = Field(default=400, ge=0)
    """Strongest keypoints of an image that are used, of those large enough; 0 uses patches alone."""
    least_size: float = Field(default=0.006, ge=0, le=1)
    """Smallest keypoint used, as a share of the image's mean side: below about 3 px of a 640 x 360 image, keypoints are
    grain that another camera, resolution or light does not show again."""
    root_sift: bool = True
    """Compare the roots of descriptors (Arandjelovic & Zisserman 2012) instead of the descriptors."""
    patch_weight: Annotated[float, Field(ge=0)] | tuple[Annotated[float, Field(ge=0)], ...] | None = None
    """A patch's match weighs this many times a keypoint's; 0 uses keypoints alone. A number for each reference, or one
    for all. None takes 2, and 0 on references where storeys or aisles of one layout mislead patches, as the library's
    own images show (see vplog/places/self_recognition.py)."""
    neighbours: int = Field(default=24, ge=2, le=1024)
    """Nearest library features looked at for each feature; the last one sets the scale of the others' distances."""
    reach: float = Field(default=0.8, gt=0)
    """A match weighs 1 - d2 / (reach x d2 of the last neighbour), squared distances, and nothing below zero."""
    hnsw_links: int = Field(default=16, ge=2, le=256)
    """Links of a node in the HNSW graph (Malkov & Yashunin 2018)."""
    hnsw_ef_construction: int = Field(default=40, ge=1, le=4096)
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
    """(E,) 0..1, times `patch_weight` where it is of a patch."""
    itself: int
    """The reference that is the image itself, -1 where none is. It has no matches: it explains everything."""
    points: Float32s
    """(M, 2) where all the image's features are, as shares of its sides."""

    def votes(self) -> Floats:
        """(L,) total weight of each reference's matches, added in the order they stand."""
        count = np.diff(self.start)
        owner = np.repeat(np.arange(len(count)), count)
        return np.asarray(np.bincount(owner, self.weight, len(count)), np.float64)


@dataclass(frozen=True, eq=False)
class Indexed:
    """The F features of one kind that L references have."""

    owner: Int32s
    """(F,) reference of each."""
    points: Float32s
    """(F, 2) as shares of the reference's sides."""
    graph: Any


class Matcher:
    """The features of L references, indexed on first use. Safe to share between threads."""

    def __init__(self, references: list[Reference], settings: WeighedMatchSettings) -> None:
        self.references, self.settings = references, settings
        self.indexed = Once(lambda: (self._index(keypoints_of), self._index(patches_of)))
        """Keypoints and patches; None where they are not used, or the references have none."""

    def __len__(self) -> int:
        return len(self.references)

    def _index(self, described: Callable[[Features, WeighedMatchSettings], Described]) -> Indexed | None:
        s = self.settings
        values, points = zip(*(described(r.features, s) for r in self.references), strict=True)
        owner = np.repeat(np.arange(len(values), dtype=np.int32), list(map(len, values)))
        if not len(owner):
            return None
        graph = hnsw(np.concatenate(values), s.hnsw_links, s.hnsw_ef_construction, s.neighbours)
        return Indexed(owner, np.concatenate(points), graph)

    def match(self, features: Features, weights: KindWeights = (1.0, PATCH_WEIGHT)) -> Matches:
        """Matches of an image, those of keypoints and those of patches with these weights; none of a kind with 0."""
        s, L = self.settings, len(self.references)
        found = []
        for kind, described, times in zip(self.indexed(), (keypoints_of, patches_of), weights, strict=True):
            if kind is not None and np.any(times):
                values, points = described(features, s)
                if len(values):
                    found.append((kind, times, points, *kind.graph.search(values, s.neighbours)))
        itself = max((_itself(distance, entry, kind.owner, L) for kind, _, _, distance, entry in found), default=-1)
        none = np.zeros((0, 2), np.float32)
        parts = [(np.zeros(0, np.int32), none, none, none[:, 0])]
        for kind, times, points, distance, entry in found:
            feature, library, weight = _weigh(distance, entry, kind.owner, L, itself, s.reach)
            weight *= np.broadcast_to(np.float32(times), L)[kind.owner[library]]
            counts = weight > 0
            feature, library = feature[counts], library[counts]
            parts.append((kind.owner[library], points[feature], kind.points[library], weight[counts]))
        owner, here, there, weight = map(np.concatenate, zip(*parts, strict=True))
        order = np.argsort(owner, kind="stable")
        start = np.searchsorted(owner[order], np.arange(L + 1)).astype(np.int32)
        points = np.concatenate([none, *(points for _, _, points, _, _ in found)])
        return Matches(start, here[order], there[order], weight[order], itself, points)


def large_enough(features: Features, settings: WeighedMatchSettings) -> Features:
    """The strongest features of those that are large enough."""
    least = settings.least_size * np.sqrt(features.width * features.height)
    alike = len(features) and features.sizes.max() == features.sizes.min()  # a network's, which tell nothing of grain
    return features.rows(np.flatnonzero((features.sizes >= least) | alike)[: settings.features])


def keypoints_of(features: Features, settings: WeighedMatchSettings) -> Described:
    """The large enough keypoints of an image, strongest first."""
    used = large_enough(features, settings)
    values = root_sift_steps(used.descriptors) if settings.root_sift else used.descriptors.astype(np.float32)
    points = (used.points + 0.5) / np.array([features.width, features.height])
    return values, points.astype(np.float32)


def patches_of(features: Features, settings: WeighedMatchSettings) -> Described:
    """The patches of an image; none where the features have no thumbnail."""
    if settings.patch_weight == 0 or features.thumbnail is None:
        return np.zeros((0, 128), np.float32), np.zeros((0, 2), np.float32)
    return describe_patches(features.thumbnail)


def index_references(references: Iterable[Reference], settings: WeighedMatchSettings) -> Matcher:
    """The references' features, not yet indexed. Raises LibraryError where they have none."""
    used = [replace(r, features=large_enough(r.features, settings)) for r in keep_references(references)]
    matcher = Matcher(used, settings)
    if not any(len(r.features) for r in used) and matcher.indexed()[1] is None:
        raise LibraryError(f"None of the {len(used)} reference images has a single feature; choose other images.")
    return matcher


def _itself(distance: Float32s, entry: Ints, owner: Int32s, L: int) -> int:
    """The reference that most features (F, K) of the image are found on without any difference, or -1."""
    same = np.bincount(owner[entry[(entry >= 0) & (distance <= 0.0)]], minlength=L)
    most = int(same.argmax())
    return most if 2 * same[most] > len(distance) else -1


@numba.njit(cache=True, nogil=True)
def _weigh(distance, entry, owner, L, itself, reach):
    """(feature, library feature, weight) of every match; the weights of a feature share it between its references.

    A feature matched on d references is divided by the root of d, as a frequent word is less distinctive.
    """
    F, K = distance.shape
    feature, library = np.empty(F * K, np.int32), np.empty(F * K, np.int32)
    weight = np.empty(F * K, np.float32)
    last_feature = np.full(L, -1, np.int32)
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
            if reference == itself or last_feature[reference] == f:
                continue
            w = 1.0 - distance[f, k] / (reach * last) if last > 0.0 else 0.0
            if w <= 0.0:
                break
            last_feature[reference] = f
            feature[count], library[count], weight[count] = f, entry[f, k], w
            count += 1
        share = 1.0 / np.sqrt(max(count - first, 1))
        for at in range(first, count):
            weight[at] *= share
    return feature[:count], library[:count], weight[:count]
