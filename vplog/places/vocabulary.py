"""A visual vocabulary: k-means centres of RootSIFT descriptors (Sivic & Zisserman, Video Google, ICCV 2003).

Descriptors and centres are whole multiples of 1/512, so that every squared distance is exact in float32: the nearest
centre is the same whatever the order of the sum, the number of threads or the machine.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import faiss
import numpy as np
from numpy.typing import NDArray

from vplog.data import Bytes, Float32s, Int32s, Ints
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places.library import hnsw

ROOT_STEPS = np.float32(512)
"""Steps of 1 that roots of descriptors are whole multiples of: a byte of them reaches 0.498, and SIFT's own cut at 0.2
keeps values below that."""
_FEATURES_PER_WORD = 4
"""Least features a word: the mean of fewer is one image's noise."""
_ITERATIONS = 6
"""Iterations of k-means; with five features a word the mean distance to the centre stops falling after the fifth."""
_MOST_FEATURES_PER_WORD = 256
"""Largest random sample that is learned from, as in faiss' own k-means."""
_EXACT_WORDS = 1024
"""Up to so many words all distances are quicker than a graph."""
_LINKS, _EF_CONSTRUCTION, _EF_LEARN, _EF_SEARCH = 16, 40, 16, 64
"""Links and breadth of the HNSW graph (Malkov & Yashunin 2018). Of 16 000 words it finds the nearest for
97 features in 100 while learning, which k-means heals, and for 99.8 in 100 after: at 97 BoVF loses .02 of its R@1."""
_CHUNK = 1000
"""Features of one task of a thread."""


def root_sift(descriptors: Bytes) -> Float32s:
    """(M, 128) float32 of (M, 128) uint8: the root of each value's share of the sum, so of unit L2 length.

    Arandjelovic & Zisserman, Three things everyone should know, CVPR 2012, section 3; in steps of 1/512.
    """
    return root_sift_steps(descriptors) / ROOT_STEPS


class Vocabulary:
    """V visual words. Shared freely between threads."""

    def __init__(self, centres: Float32s) -> None:
        """`centres` (V, 128) are RootSIFT, multiples of 1/512."""
        self.centres = centres
        self._index = _index(centres * ROOT_STEPS, _EF_SEARCH)

    def __len__(self) -> int:
        return len(self.centres)

    def quantise(self, descriptors: Bytes) -> Int32s:
        """(M,) int32: the word of each of (M, 128) uint8 descriptors, the one of the nearest centre.

        Above 1024 words an approximate search misses the nearest for 2 in 1000, always in the same way.
        """
        return _nearest(self._index, root_sift_steps(descriptors))


def learn_vocabulary(descriptors: Bytes, words: int, seed: int, execution: Execution) -> Vocabulary:
    """At most `words` k-means centres of (F, 128) uint8 descriptors, fewer where there are too few features.

    The same for any number of threads. Raises LibraryError where there is no feature.
    """
    if len(descriptors) == 0:
        raise LibraryError("The reference images have not a single feature to learn words from; choose other images.")
    count = min(words, max(len(descriptors) // _FEATURES_PER_WORD, 1))
    rng = np.random.default_rng(seed)
    most = count * _MOST_FEATURES_PER_WORD
    if len(descriptors) > most:
        descriptors = descriptors[np.sort(rng.choice(len(descriptors), most, replace=False))]
    steps = root_sift_steps(descriptors)
    centres = steps[np.sort(rng.choice(len(steps), count, replace=False))]
    parts = [steps[at : at + _CHUNK] for at in range(0, len(steps), _CHUNK)]
    for _ in range(_ITERATIONS):
        index = _index(centres, _EF_LEARN)
        nearest = np.concatenate(list(execution.map(lambda part, index=index: _nearest(index, part), parts)))
        order = np.argsort(nearest, kind="stable")
        first = np.flatnonzero(np.diff(nearest[order], prepend=-1))  # centres without a feature are dropped
        members = np.diff(first, append=len(order))
        sums = np.add.reduceat(steps[order].astype(np.int32), first)  # whole numbers: no order of summation
        moved = np.rint(sums / members[:, None]).astype(np.float32)
        if np.array_equal(moved, centres):
            break
        centres = moved
    return Vocabulary(centres / ROOT_STEPS)


def root_sift_steps(descriptors: Bytes) -> Float32s:
    """RootSIFT (M, 128) in whole steps, 0..255."""
    values = descriptors.astype(np.float32)
    values /= np.maximum(values.sum(axis=1, keepdims=True), 1)
    np.sqrt(values, out=values)
    return np.minimum(np.rint(values * ROOT_STEPS), 255)


def _index(centres: Float32s, ef_search: int) -> Any:
    """Nearest of (V, 128) centres in steps, which are bytes as they are."""
    if len(centres) > _EXACT_WORDS:
        return hnsw(centres, _LINKS, _EF_CONSTRUCTION, ef_search)
    index: Any = faiss.IndexFlatL2(centres.shape[1])
    index.add(centres)
    return index


def _nearest(index: Any, steps: Float32s) -> Int32s:
    if len(steps) == 0:
        return np.zeros(0, np.int32)
    return index.search(steps, 1)[1][:, 0].astype(np.int32)


def postings(images: Sequence[NDArray[np.integer]], words: int) -> tuple[Ints, Int32s, Ints]:
    """An inverted file of images, each the numbers of its words: those with word w are start[w]..start[w + 1] of the
    images, in order; and the order that sorts all words of all images so."""
    owner = np.repeat(np.arange(len(images), dtype=np.int32), [len(image) for image in images])
    values = np.concatenate([np.zeros(0, np.int64), *images]).astype(np.int64)
    order = np.argsort(values, kind="stable")
    return np.searchsorted(values[order], np.arange(words + 1)).astype(np.int64), owner[order], order


def spread_rows(count: int, most: int) -> Ints:
    """At most `most` of `count` rows, evenly from the first to the last."""
    return np.unique(np.linspace(0, count - 1, min(count, most)).astype(np.int64))
