"""BoBB, with visual words where the library does not explain the scene: Tanaka et al., IROS 2014, section V.

Beside its boxes an image is one bit for each of a few visual words and each principal direction of descriptors: the
signs of a VLAD (Jegou et al., CVPR 2010) of residuals of unit length (Delhumeau et al., Revisiting the VLAD image
representation, ACM MM 2013) of keypoints and patches, with the position in the image as two more values.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numba
import numpy as np
import pyarrow as pa
import scipy
from pydantic import Field

from vplog.data import Bytes, Features, Float32s, Floats, Ints, Ranking, Reference
from vplog.execution.execution import Execution
from vplog.places.bobb import BobbSettings, BobbState
from vplog.places.code_search import CodeIndex, Place
from vplog.places.columns import from_column, to_column
from vplog.places.dense import best_rows
from vplog.places.library_files import ReferencesState, RelearnedSettings
from vplog.places.matches import Described, keypoints_of, patches_of
from vplog.places.vocabulary import ROOT_STEPS, spread_rows

_STEPS = 4096
"""Steps of 1: values are rounded to whole ones before they are summed over features, so that sums stay below 2^53 and
exact in any order, and no bit depends on the number of threads."""
_DIRECTIONS = 64
"""Principal directions of descriptors that are kept, half of them: those after hold a twentieth of the variance."""
_LEAST_VARIANCE = 1e-4
"""Share of the largest variance: directions with less are the noise of few features, and are not whitened further."""
_ITERATIONS = 10
"""Iterations of k-means; with a thousand features a word its centres hardly move after."""
_MOST_FEATURES = 100_000
"""Library features that words are learned from, spread evenly: more than enough for a few hundred directions."""
_MOST_REFERENCES = 500
"""References whose scores are compared with each other's, spread evenly: a quarter of a million pairs."""


class HybridSettings(RelearnedSettings):
    """Boxes of BoBB and signs of a few words: 96 + 64 bytes."""

    kind: Literal["hybrid"] = "hybrid"
    """Name of the recogniser."""
    bobb: BobbSettings = BobbSettings(references=8)
    """The boxes. Two references fewer than BoBB alone, so that a place stays within 160 bytes; its least size and its
    patches are the words' own, too."""
    features: int = Field(default=800, ge=0)
    """Strongest keypoints that have words, beside the patches: sums over many tell more, and cost no search."""
    words: int = Field(default=8, ge=1, le=256)
    """Visual words. Few, so that each has about a hundred features of an image and their sum is more than noise."""
    bits: Literal[8, 16, 32, 64] = 64
    """Directions a word in which its features differ, one bit each."""
    place: float = Field(default=1.0, ge=0)
    """How much where a feature lies counts: a difference of the whole image side weighs `place` times as much as the
    root mean square of descriptors' distances from their mean. One by day in shifted views; more helps in other light,
    where descriptors change and the layout does not; 0 asks for no place."""
    whitening: float = Field(default=0.5, ge=0, le=1)
    """Directions are divided by their variance to half this power: few of them would decide all bits otherwise."""
    share: float = Field(default=0.5, ge=0, le=1)
    """How much the words count against the boxes, in standard deviations of either between the references: a half is
    as much. What the library explains badly has few boxes in common, and is then told by the words."""
    seed: int = Field(default=0, ge=0)
    """Seed of the first centres and of the directions' rotation."""

    def learn(self, references: Iterable[Reference], execution: Execution) -> HybridState:
        """Index the references, learn words, and how scores vary. Raises LibraryError where there are no features."""
        references = list(references)
        bobb = self.bobb.learn(references, execution)
        vlad = learn_vlad([_features_of(r.features, self) for r in references], self)
        state = HybridState(self, references, bobb, vlad, self.share)
        rows = spread_rows(len(references), _MOST_REFERENCES).tolist()
        places = list(execution.map(lambda row: state.describe(references[row].features), rows))
        return HybridState(self, references, bobb, vlad, _balance(state.index(places), places, self.share))


@dataclass(frozen=True, eq=False)
class BinaryVlad:
    """W words in a space of 64 principal directions of descriptors and 2 of positions."""

    mean: Float32s
    """(128,) of RootSIFT."""
    directions: Float32s
    """(128, 64) of RootSIFT less the mean, to values whose root mean square length is 1."""
    place: float
    centres: Floats
    """(W, 66) whole steps of 1/4096."""
    rotation: Floats
    """(66, B) whole steps, so that each bit tells as much."""

    def signs(self, values: Float32s, points: Float32s) -> Bytes:
        """(W * B / 8,) bits: the side on which the features of a word lie, summed. All 0 without features."""
        placed = _with_position(values / ROOT_STEPS, points, self.mean, self.directions, self.place)
        return np.packbits(_sum_residuals(placed, self.centres, _STEPS) @ self.rotation > 0)


def _features_of(features: Features, settings: HybridSettings) -> Described:
    """Patches and keypoints of an image, RootSIFT in steps of 1/512."""
    wanted = settings.bobb.model_copy(update={"features": settings.features, "root_sift": True})
    found, patches = keypoints_of(features, wanted), patches_of(features, wanted)
    if found[0].shape[1] != patches[0].shape[1]:  # keypoints of a network, of another length than SIFT's and patches'
        return found
    values, points = map(np.concatenate, zip(found, patches, strict=True))
    return values, points


def learn_vlad(features: Sequence[Described], settings: HybridSettings) -> BinaryVlad:
    """A vocabulary of the library's features, of which there is one at least."""
    steps, points = map(np.concatenate, zip(*features, strict=True))
    rows = spread_rows(len(steps), _MOST_FEATURES)
    roots, points = steps[rows].astype(np.float64) / ROOT_STEPS, points[rows]
    mean, directions = _principal(roots, settings.whitening)
    rng = np.random.default_rng(settings.seed)
    values = _with_position(roots.astype(np.float32), points, mean, directions, settings.place)
    centres = _centres(values, settings.words, rng)
    rotation = np.linalg.qr(rng.normal(size=(values.shape[1], values.shape[1])))[0][:, : settings.bits]
    return BinaryVlad(mean, directions, settings.place, centres, np.rint(rotation * _STEPS))


def _principal(values: Floats, whitening: float) -> tuple[Float32s, Float32s]:
    """Mean (128,) and directions (128, 64) of (F, 128) RootSIFT."""
    mean = values.mean(axis=0)
    covariance = values.T @ values / len(values) - np.outer(mean, mean)
    variance, sides = np.linalg.eigh(covariance)
    largest = np.argsort(-variance, kind="stable")[:_DIRECTIONS]
    sides = sides[:, largest]
    # an eigenvector's sign is a matter of the machine: let its largest entry be positive
    sides = sides * np.sign(sides[np.argmax(np.abs(sides), axis=0), np.arange(len(largest))])
    variance = np.maximum(variance[largest], max(_LEAST_VARIANCE * variance.max(), 1e-12))
    length = np.sqrt((variance ** (1 - whitening)).sum())
    return mean.astype(np.float32), (sides / (variance ** (whitening / 2) * length)).astype(np.float32)


@numba.njit(cache=True, nogil=True)
def _project(descriptors, mean, directions):
    """(M, D) float32, one feature after the other: no BLAS, whose threads would compete with ours."""
    result = np.zeros((descriptors.shape[0], directions.shape[1]), np.float32)
    for f in range(descriptors.shape[0]):
        for i in range(descriptors.shape[1]):
            value = descriptors[f, i] - mean[i]
            for d in range(directions.shape[1]):
                result[f, d] += value * directions[i, d]
    return result


def _with_position(
    descriptors: Float32s, points: Float32s, mean: Float32s, directions: Float32s, place: float
) -> Floats:
    """(M, 66) whole steps."""
    position = (points - np.float32(0.5)) * np.float32(place)
    values = np.column_stack([_project(descriptors, mean, directions), position])
    return np.rint(values.astype(np.float64) * _STEPS)


def _centres(values: Floats, words: int, rng: np.random.Generator) -> Floats:
    """(W, 66) whole steps by k-means of (F, 66); a word that no feature is nearest to stays where it is."""
    centres = values[np.sort(rng.choice(len(values), words, replace=len(values) < words))]
    for _ in range(_ITERATIONS):
        word = _nearest(values, centres)
        count = np.bincount(word, minlength=words)[:, None]
        total = _sum_by_word(values, word, words)
        centres = np.where(count > 0, np.rint(total / np.maximum(count, 1)), centres)
    return centres


def _nearest(values: Floats, centres: Floats) -> Ints:
    """(F,) the word of each value: whole numbers, whose squared distances are exact in any order of the sum."""
    return scipy.spatial.distance.cdist(values, centres, "sqeuclidean").argmin(axis=1)


def _sum_by_word(values: Floats, word: Ints, words: int) -> Floats:
    """(W, 66) sums of whole numbers (F, 66), exact in any order."""
    return np.array([values[word == w].sum(axis=0) for w in range(words)])


def _sum_residuals(values: Floats, centres: Floats, steps: int) -> Floats:
    """(W, 66) for each word, the sum of its features' directions from it, of unit length, in whole steps."""
    word = _nearest(values, centres)
    residual = values - centres[word]
    length = np.sqrt(np.square(residual).sum(axis=1, keepdims=True))
    unit = np.rint(residual * (steps / np.maximum(length, 1.0)))  # whole numbers: a length below 1 is 0
    return _sum_by_word(unit, word, len(centres))


@dataclass(frozen=True, eq=False)
class HybridPlace(Place):
    """The descriptor: BoBB's boxes, and signs."""

    signs: Bytes
    """(W * B / 8,) of `BinaryVlad.signs`."""


class HybridState(ReferencesState):
    """A library, indexed, and its words. Shared freely between threads."""

    def __init__(
        self, settings: HybridSettings, references: list[Reference], bobb: BobbState, vlad: BinaryVlad, share: float
    ) -> None:
        """`share`, 0..1, is the part of the words in a score."""
        super().__init__(settings, references)
        self.bobb, self.vlad, self.share = bobb, vlad, share
        self.windows, self.boxes, self.shared = bobb.windows, bobb.boxes, bobb.shared
        self.voting_maps = bobb.voting_maps
        self._signs = settings.words * settings.bits // 8

    @property
    def bits(self) -> int:
        """Size of the boxes and the signs, as stored."""
        return self.bobb.bits + 8 * self._signs

    @property
    def arrow_type(self) -> pa.DataType:
        return pa.struct({"boxes": self.bobb.arrow_type, "signs": pa.list_(pa.uint8(), self._signs)})

    def describe(self, features: Features) -> HybridPlace:
        """Boxes and signs of the same features."""
        signs = self.vlad.signs(*_features_of(features, self.settings))
        return HybridPlace(**vars(self.bobb.describe(features)), signs=signs)

    def signs(self, places: Sequence[HybridPlace]) -> Bytes:
        """(N, W * B / 8)."""
        return np.array([place.signs for place in places], np.uint8).reshape(-1, self._signs)

    def index(self, descriptors: Sequence[HybridPlace]) -> HybridIndex:
        return HybridIndex(self.bobb.index(descriptors), self.signs(descriptors), self.share)

    def evidence(self, query: HybridPlace, match: HybridPlace) -> str:
        """`words` where their signs are more of the score of two places than the boxes."""
        boxes, words = self.index([match]).similarities(query)
        if self.share * words[0] > (1 - self.share) * boxes[0]:
            return "words"
        return self.bobb.evidence(query, match)

    def to_arrow(self, descriptors: Sequence[HybridPlace]) -> pa.Array:
        return to_column(self.arrow_type, iter((*self.bobb.arrays(descriptors), self.signs(descriptors))))

    def from_arrow(self, column: pa.Array) -> list[HybridPlace]:
        *boxes, signs = from_column(column, self.arrow_type)
        return list(map(HybridPlace, *self.bobb.checked(boxes), signs))


class HybridIndex:
    """Places of a map; rows are in the order given."""

    def __init__(self, boxes: CodeIndex, signs: Bytes, share: float) -> None:
        """`signs` (N, length); `share` of the words in a score."""
        self._boxes, self._signs, self._share = boxes, signs, share

    def __len__(self) -> int:
        return len(self._boxes)

    def similarities(self, descriptor: HybridPlace, stop: int | None = None) -> tuple[Float32s, Float32s]:
        """(stop,) BoBB's score, and agreement of the signs 0..1: 0 where half of them or fewer are equal."""
        boxes = self._boxes.scores(descriptor, stop)
        return boxes, _agreement(self._signs[: len(boxes)], descriptor.signs)

    def scores(self, descriptor: HybridPlace, stop: int | None = None) -> Float32s:
        """(stop,) 0..1: both similarities in their shares; 1 is equal."""
        boxes, words = self.similarities(descriptor, stop)
        return ((1 - self._share) * boxes + self._share * words).astype(np.float32)

    def query(self, descriptor: HybridPlace, k: int, stop: int | None = None) -> Ranking:
        return best_rows(self.scores(descriptor, stop), k)


def _agreement(signs: Bytes, query: Bytes) -> Float32s:
    """(N,) 1 - 2 x share of the bits that differ of (N, length), 0 at least, and 0 for an image without features."""
    differ = np.bitwise_count(signs ^ query).sum(axis=1, dtype=np.int64)
    agreement = np.maximum(1.0 - 2.0 * differ / (8 * len(query)), 0.0)
    return np.where(signs.any(axis=1) & query.any(), agreement, 0.0).astype(np.float32)


def _balance(index: HybridIndex, places: Sequence[HybridPlace], share: float) -> float:
    """Part of the words in a score, so that both similarities vary alike between different references at half.

    With fewer references than it takes to tell how they vary, `share` itself.
    """
    alike = np.array([index.similarities(place) for place in places])
    pairs = alike.transpose(1, 0, 2)[:, ~np.eye(len(places), dtype=bool)].astype(np.float64)
    boxes, words = pairs.std(axis=1).tolist() if pairs.size else (0.0, 0.0)
    if min(boxes, words) <= 0.0:
        return share
    return share / words / (share / words + (1 - share) / boxes)
