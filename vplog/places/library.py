"""The raw-image library: reference images with their raw SIFT features, which serve as the vocabulary.

A visual word is the number of a library feature. A feature of any image is translated into all the library features
that are its near neighbours and close enough: several words per feature (section III-B of Tanaka et al. 2014).
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any, Literal

import faiss
import numpy as np
from pydantic import Field

from vplog.data import Bytes, Float32s, Int32s, Ints, Reference
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places.library_files import keep_references
from vplog.settings import Settings


class WordSettings(Settings):
    """Quantisation of features to visual words."""

    features: int = Field(default=800, ge=1)
    """Strongest features of an image that are used."""
    neighbours: int = Field(default=10, ge=1, le=1024)
    """Nearest library features looked at for each feature."""
    max_l1: float = Field(default=0.4, ge=0)
    """Normalised L1 distance below which two descriptors are the same word: the paper's check."""
    l1_range: Literal[1, 2] = 2
    """The largest distance that two descriptors can have: the paper does not say how its distance is normalised. 2: the
    descriptors have unit L1 length. 1: their distance is a share of the largest as well, so that twice as far is still
    the same word. The paper's measure, ANR, comes nearer to what it claims with 1 (docs/guides/compare.md)."""
    hnsw_links: int = Field(default=16, ge=2, le=256)
    """Links of a node in the HNSW graph (Malkov & Yashunin 2018); recall of the first neighbour .94 at ef 16."""
    hnsw_ef_construction: int = Field(default=40, ge=1, le=4096)
    """Breadth of the search while the graph is built."""
    hnsw_ef_search: int = Field(default=16, ge=1, le=4096)
    """Breadth of the search for a feature's neighbours; raised to `neighbours` where it is less."""


@dataclass(frozen=True, eq=False)
class Words:
    """Words of M features: feature f has values[start[f]:start[f + 1]], increasing."""

    start: Int32s
    values: Int32s


@dataclass(frozen=True, eq=False)
class Library:
    """L reference images; feature f of reference r is one of start[r]..start[r + 1]."""

    references: list[Reference]
    start: Int32s
    """(L + 1,)."""
    descriptors: Bytes
    """(F, 128)."""
    points: Float32s
    """(F, 2) px of its reference."""
    settings: WordSettings
    words: Words
    """Words of the library's own features, where `build_library` has `own`: each has its own number at least."""
    index: Any

    def __len__(self) -> int:
        return len(self.references)

    def size(self, reference: int) -> tuple[int, int]:
        """Width and height in px."""
        features = self.references[reference].features
        return features.width, features.height

    def translate(self, descriptors: Bytes) -> Words:
        """Words of (M, 128) descriptors. Exact whole-number distances: the same on any machine and thread."""
        return _translate(self.index, self.descriptors, descriptors, self.settings)


def build_library(
    references: Iterable[Reference], settings: WordSettings, execution: Execution, own: bool = True
) -> Library:
    """Index the references' strongest features; without `own`, who only translates, these get no words themselves.

    Raises LibraryError where there is no feature.
    """
    used = keep_references(references, settings.features)
    start = np.concatenate([[0], np.cumsum([len(reference.features) for reference in used])]).astype(np.int32)
    if start[-1] == 0:
        raise LibraryError(f"None of the {len(used)} reference images has a single feature; choose other images.")
    descriptors = np.concatenate([reference.features.descriptors for reference in used])
    points = np.concatenate([reference.features.points for reference in used])
    breadth = max(settings.hnsw_ef_search, settings.neighbours)
    index = hnsw(descriptors.astype(np.float32), settings.hnsw_links, settings.hnsw_ef_construction, breadth)
    nothing = Words(np.zeros(1, np.int32), np.zeros(0, np.int32))
    words = _own_words(index, descriptors, settings, execution) if own else nothing
    return Library(used, start, descriptors, points, settings, words, index)


def hnsw(values: Float32s, links: int, ef_construction: int, ef_search: int) -> Any:
    """HNSW over (F, D) whole numbers 0..255, built on one thread: the order of insertion decides the graph.

    Squared distances are whole numbers below 2^24, so float32 sums them without rounding in any order.
    """
    # bytes, not floats: the same distances from a quarter of the memory, 1.5 times as fast
    index: Any = faiss.index_factory(values.shape[1], f"HNSW{links}_SQ8_direct")
    index.train(values[:1])
    index.hnsw.efConstruction = ef_construction
    index.hnsw.efSearch = ef_search
    threads = faiss.omp_get_max_threads()
    faiss.omp_set_num_threads(1)
    try:
        index.add(values)
    finally:
        faiss.omp_set_num_threads(threads)
    return index


def _own_words(index: Any, descriptors: Bytes, settings: WordSettings, execution: Execution) -> Words:
    def part(first: int) -> Words:
        return _translate(index, descriptors, descriptors[first : first + 1000], settings, first)

    parts = list(execution.map(part, range(0, len(descriptors), 1000)))
    counts = np.concatenate([np.diff(words.start) for words in parts])
    start = np.concatenate([[0], np.cumsum(counts)]).astype(np.int32)
    return Words(start, np.concatenate([words.values for words in parts]))


def _translate(
    index: Any, library: Bytes, descriptors: Bytes, settings: WordSettings, first: int | None = None
) -> Words:
    """Near neighbours that pass the L1 check; with `first`, row r is library feature first + r and has its own word."""
    if len(descriptors) == 0:
        return Words(np.zeros(1, np.int32), np.zeros(0, np.int32))
    none = np.iinfo(np.int64).max
    neighbours = index.search(descriptors.astype(np.float32), settings.neighbours)[1]
    close = l1_distance(descriptors, library, neighbours) < settings.max_l1 * 2 / settings.l1_range
    neighbours = np.where(close & (neighbours >= 0), neighbours, none)
    if first is not None:
        own = first + np.arange(len(descriptors))[:, None]
        neighbours = np.concatenate([own, np.where(neighbours == own, none, neighbours)], axis=1)
    neighbours.sort(axis=1)
    valid = neighbours < none
    start = np.concatenate([[0], np.cumsum(valid.sum(axis=1))]).astype(np.int32)
    return Words(start, neighbours[valid].astype(np.int32))


def l1_distance(descriptors: Bytes, library: Bytes, neighbours: Ints) -> Float32s:
    """(M, k) L1 distance, 0..2, of descriptors (M, 128) scaled to unit L1 length to library rows (M, k)."""
    a = descriptors.astype(np.float32)
    b = library[neighbours].astype(np.float32)
    a /= np.maximum(a.sum(axis=-1, keepdims=True), 1.0)
    b /= np.maximum(b.sum(axis=-1, keepdims=True), 1.0)
    b -= a[:, None]
    return np.abs(b, out=b).sum(axis=-1)
