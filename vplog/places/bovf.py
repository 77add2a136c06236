"""Bag of visual features: Sivic & Zisserman, Video Google, ICCV 2003, with RootSIFT.

An image is its visual words and how often each occurs. Two images compare by the cosine of their tf-idf vectors
(section 4), which an inverted file computes for a whole map at once.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal

import numba
import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import Field

from vplog.data import Features, Float32s, Ranking, Reference
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places.columns import from_lists, to_lists
from vplog.places.dense import best_rows
from vplog.places.library_files import ReferencesState, RelearnedSettings, keep_references
from vplog.places.vocabulary import Vocabulary, learn_vocabulary, postings

_WORD_BYTES, _PLACE_BYTES = 3, 4
"""In a table: a word's number in two bytes and its count in one; where a place's list begins in four."""
_MAX_COUNT = 255
"""Largest count of a byte; a word that occurs more often in one image is no better known for it."""
_WORD = np.dtype([("word", np.uint16), ("count", np.uint8)])
_FIELDS = [pa.field(name, pa.from_numpy_dtype(_WORD[name]), nullable=False) for name in ("word", "count")]
_PLACE = pa.list_(pa.field("item", pa.struct(_FIELDS), nullable=False))


class BovfSettings(RelearnedSettings):
    """Bag of visual features: tf-idf, cosine, inverted file."""

    kind: Literal["bovf"] = "bovf"
    """Name of the recogniser."""
    features: int = Field(default=800, ge=1)
    """Strongest features of an image that are used."""
    words: int = Field(default=16_000, ge=1, le=65_536)
    """Visual words, of the order of the paper's 16 000; fewer where the references have too few features."""
    max_bytes: int | None = Field(default=None, ge=_PLACE_BYTES + _WORD_BYTES)
    """Bytes a place may take in a table: only its words of highest tf-idf that fit are kept. None keeps all."""
    damp_bursts: bool = True
    """Whether a word counts by the root of how often it occurs: Jegou et al., On the burstiness of visual elements,
    CVPR 2009, section 4.1. A fence is then not a place."""
    seed: int = Field(default=0, ge=0)
    """Seed of the first centres of k-means."""

    def learn(self, references: Iterable[Reference], execution: Execution) -> BovfState:
        """Words and their idf from the references. Raises LibraryError where they are fewer than two or featureless."""
        used = keep_references(references, self.features)
        if len(used) < 2:
            raise LibraryError(
                "bovf weighs a word by how few of the references have it, so it needs at least two; one was given."
            )
        descriptors = np.concatenate([reference.features.descriptors for reference in used])
        vocabulary = learn_vocabulary(descriptors, self.words, self.seed, execution)
        holders = np.zeros(len(vocabulary), np.int64)
        for reference in used:
            holders[np.unique(vocabulary.quantise(reference.features.descriptors))] += 1
        # section 4.1: log N / n_i; the approximate search may leave a word to no reference, which is as rare as one
        idf = np.log(len(used) / np.maximum(holders, 1)).astype(np.float32)
        return BovfState(self, used, vocabulary, idf)


@dataclass(frozen=True, eq=False)
class BovfState(ReferencesState):
    """A vocabulary with the weight of each word. Shared freely between threads."""

    settings: BovfSettings  # pyrefly: ignore[bad-override]
    references: list[Reference]  # pyrefly: ignore[bad-override]
    vocabulary: Vocabulary
    idf: Float32s
    """(V,)."""
    arrow_type = _PLACE

    @property
    def _most_words(self) -> int:
        s = self.settings
        fit = s.features if s.max_bytes is None else (s.max_bytes - _PLACE_BYTES) // _WORD_BYTES
        return min(fit, s.features, len(self.vocabulary))

    @property
    def bits(self) -> int:
        """Size of the largest place: as many words as there may be. Images with fewer features take less."""
        return 8 * (_PLACE_BYTES + _WORD_BYTES * self._most_words)

    def describe(self, features: Features) -> NDArray:
        """(K,) words, increasing, with their counts; words that all references have weigh nothing and are left out."""
        found = self.vocabulary.quantise(features.descriptors[: self.settings.features])
        words, counts = np.unique(found, return_counts=True)
        place = np.empty(len(words), _WORD)
        place["word"], place["count"] = words, np.minimum(counts, _MAX_COUNT)
        weight = _tf_idf(place, self)
        best = np.lexsort((words, -weight))[: self._most_words]
        return place[np.sort(best[weight[best] > 0])]

    def index(self, descriptors: Sequence[NDArray]) -> WordIndex:
        return WordIndex(descriptors, self)

    def to_arrow(self, descriptors: Sequence[NDArray]) -> pa.Array:
        return to_lists(descriptors, _PLACE)

    def from_arrow(self, column: pa.Array) -> list[NDArray]:
        places = from_lists(column, _PLACE, len(self.vocabulary))
        if not column.flatten().field("count").to_numpy().all():
            raise LibraryError("The descriptors name a word zero times; compute them again with `vplog run`.")
        return places


class WordIndex:
    """Inverted file: for each word, the places that have it with their weight. Rows are in the order given."""

    def __init__(self, places: Sequence[NDArray], state: BovfState) -> None:
        self._count, self._state = len(places), state
        self._list_start, self._list_place, order = postings([place["word"] for place in places], len(state.idf))
        weights = [np.zeros(0, np.float32), *(_weights(place, state) for place in places)]
        self._list_weight = np.concatenate(weights)[order]

    def __len__(self) -> int:
        return self._count

    def scores(self, descriptor: NDArray, stop: int | None = None) -> Float32s:
        """(stop,) cosine of the tf-idf vectors of the query and each place, 0 where they share no word."""
        stop = self._count if stop is None else min(stop, self._count)
        lists = self._list_start, self._list_place, self._list_weight
        return _products(descriptor["word"].copy(), _weights(descriptor, self._state), *lists, stop)

    def query(self, descriptor: NDArray, k: int, stop: int | None = None) -> Ranking:
        return best_rows(self.scores(descriptor, stop), k)


def _tf_idf(place: NDArray, state: BovfState) -> Float32s:
    """(K,) section 4.1. The paper's tf divides by the number of features, which the cosine cancels."""
    counted = place["count"].astype(np.float32)
    return (np.sqrt(counted) if state.settings.damp_bursts else counted) * state.idf[place["word"]]


def _weights(place: NDArray, state: BovfState) -> Float32s:
    """(K,) tf-idf of unit length."""
    weights = _tf_idf(place, state)
    return weights / max(np.sqrt(np.square(weights).sum()), np.float32(1e-9))


@numba.njit(cache=True, nogil=True)
def _products(words, weights, list_start, list_place, list_weight, stop):
    """(stop,) float32: sum over the query's words of its weight times the place's, in the order of the words."""
    result = np.zeros(stop, np.float32)
    for k in range(words.shape[0]):
        for e in range(list_start[words[k]], list_start[words[k] + 1]):
            if list_place[e] >= stop:
                break
            result[list_place[e]] += weights[k] * list_weight[e]
    return result
