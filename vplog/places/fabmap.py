"""FAB-MAP: the probability that two images show one place, from which words tend to occur together.

Cummins & Newman, FAB-MAP: Probabilistic localization and mapping in the space of appearance, IJRR 27(6), 2008, and
Appearance-only SLAM at large scale with FAB-MAP 2.0, IJRR 30(9), 2011; below "2008" and "2.0".

An image is the set of words it has, z_q = 1 or 0. Behind a word is something that exists at the place or not, e_q, and
a detector that misses much of it. A place is p(e_q = 1 | L) for every word. The words of an image depend on each other
through a Chow-Liu tree, z_p being the parent of z_q.
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import TYPE_CHECKING, Literal, Self

import numba
import numpy as np
import pyarrow as pa
from pydantic import Field, model_validator

from vplog.data import Ranking
from vplog.errors import LibraryError
from vplog.places import stored
from vplog.places.chow_liu import ChowLiuTree, learn_tree
from vplog.places.relearn import keep_references, relearn
from vplog.places.vocabulary import Vocabulary, learn_vocabulary
from vplog.settings import Settings

if TYPE_CHECKING:
    from collections.abc import Iterable, Sequence
    from pathlib import Path

    from numpy.typing import NDArray

    from vplog.data import Features, Float32s, Floats, Reference

    Words = NDArray[np.uint16]
    Bools = NDArray[np.bool_]

_WORD_BYTES, _PLACE_BYTES = 2, 4
"""In a table: a word's number in two bytes; where a place's list begins in four."""
_PLACE = pa.list_(pa.field("item", pa.uint16(), nullable=False))
_UNSEEN, _SEEN, _AVERAGE = 0, 1, 2
"""What is known of a word at a place: its one image lacks it, has it, or there is no image."""
_LEAST_IMAGES = 10
"""A drive with fewer images tells nothing of how much to trust the evidence."""
_MOST_QUERIES = 200
"""So many references are asked of, spread evenly; more would not change the second digit of the weight."""
_NEAR_SHARE = 10
"""An image's place may be seen from a tenth of the drive's images before and after it; the others are far."""
_WEIGHTS = np.geomspace(0.01, 1.0, 201)
"""Weights tried, in steps of 2.3 %: below 0.01 the posterior is the prior, above 1 a word would count twice."""


class FabmapSettings(Settings):
    """FAB-MAP 2.0: Chow-Liu tree, one image a place, inverted index, posterior over places and a new one."""

    kind: Literal["fabmap"] = "fabmap"
    """Which recogniser."""
    features: int = Field(default=800, ge=1)
    """Strongest features of an image that are used."""
    words: int = Field(default=11_000, ge=1, le=65_536)
    """Visual words, the smaller of the vocabularies of 2.0; by 4 000 a hundred references are told apart less well."""
    seen_if_there: float = Field(default=0.39, gt=0, lt=1)
    """p(z = 1 | e = 1): how often the detector finds what is there, as measured by the papers."""
    seen_if_absent: float = Field(default=0.0, ge=0, lt=1)
    """p(z = 1 | e = 0): how often it finds what is not there, as in the papers; below `seen_if_there`."""
    independence: float = Field(default=20.0, gt=0)
    """Images' worth of belief that two words have nothing to do with each other, against the pair's counts; of 2 to
    100, that by which a hundred references are best told apart."""
    new_place: Literal["mean_field", "sampled"] = "mean_field"
    """A place never seen is like the average place, or like a reference; those must be from elsewhere then."""
    samples: int = Field(default=100, ge=2)
    """References drawn for a sampled new place; all of them where they are fewer."""
    new_place_prior: float = Field(default=0.9, ge=0, lt=1)
    """Prior of a new place, as in the papers; the places share the rest alike. 0: all queries are in the map."""
    smoothing: float = Field(default=0.99, gt=0, le=1)
    """Sigma: share of the likelihood kept, the rest is spread over all places (2.0, on likelihood smoothing)."""
    calibrate: bool = True
    """Weigh the evidence by what it is worth among the references themselves: words that occur together are not so
    many independent observations, so without it the posterior is far too certain."""
    seed: int = Field(default=0, ge=0)
    """Of the first centres of k-means and the samples."""

    @model_validator(mode="after")
    def _detects(self) -> Self:
        if self.seen_if_absent >= self.seen_if_there:
            raise ValueError(
                f"seen_if_absent {self.seen_if_absent} must be below seen_if_there {self.seen_if_there}: "
                "a word seen would else speak against its being there"
            )
        return self

    def learn(self, references: Iterable[Reference], threads: int) -> FabmapState:
        """Words and their tree from the references. Raises LibraryError where too few or featureless."""
        kept = keep_references(references, self.features)
        if len(kept) < 2:
            raise LibraryError(
                "fabmap learns which words occur together, so it needs at least two references; one was given."
            )
        descriptors = [reference.features.descriptors for reference in kept]
        vocabulary = learn_vocabulary(np.concatenate(descriptors), self.words, self.seed, threads)
        with ThreadPoolExecutor(threads) as pool:
            images = list(pool.map(lambda rows: _words(vocabulary, rows), descriptors))
        tree = learn_tree(images, len(vocabulary), self.independence)
        model = Model(tree, log_likelihood_table(tree, self.seen_if_there, self.seen_if_absent))
        drawn = np.sort(np.random.default_rng(self.seed).permutation(len(images))[: self.samples])
        weight, new_place_nats = 1.0, 0.0
        if self.calibrate:
            weight, new_place_nats = _calibrate(kept, images, model, drawn if self.new_place == "sampled" else None)
        samples = Evidence([images[row] for row in drawn], model) if self.new_place == "sampled" else None
        return FabmapState(self, kept, vocabulary, model, samples, weight, new_place_nats)

    def load(self, folder: Path, threads: int) -> FabmapState:
        """A library saved by `FabmapState.save`. Raises LibraryError where it is damaged or gives another hash."""
        return relearn(FabmapSettings, folder, threads)


def log_likelihood_table(tree: ChowLiuTree, seen_if_there: float, seen_if_absent: float) -> Floats:
    """(V, 3, 2, 2) ln p(z_q | z_p, L): by what is known of q at L (unseen, seen, nothing), then z_p, then z_q.

    The word may or may not exist at the place (2008, section on the observation likelihood):
    p(z_q | z_p, L) = sum over e_q of p(z_q | e_q, z_p) p(e_q | L).
    """
    detector = np.array([[1 - seen_if_absent, seen_if_absent], [1 - seen_if_there, seen_if_there]])  # [e, z]
    marginal = np.stack([1 - tree.present, tree.present], axis=1)  # (V, z)
    given_parent = np.stack([1 - tree.present_given_parent, tree.present_given_parent], axis=2)  # (V, z_p, z)
    # p(z_q | e_q, z_p) is proportional to p(z_q | e_q) p(z_q | z_p) / p(z_q): detection does not depend on z_p.
    # The papers write it (1 + alpha / beta)^-1.
    observed = detector[:, None] * (given_parent / marginal[:, None])[:, None]  # (V, e, z_p, z)
    observed /= observed.sum(axis=3, keepdims=True)
    # The place model: the prior p(e_q = 1) is how often the word occurs at all, and the place's one image updates it
    # by Bayes' rule (2008, on the update of the place model).
    exists = np.empty((len(tree), 3))
    for known in (_UNSEEN, _SEEN):
        there, absent = detector[1, known] * tree.present, detector[0, known] * (1 - tree.present)
        exists[:, known] = there / (there + absent)
    exists[:, _AVERAGE] = tree.present
    exists = exists[:, :, None, None]
    return np.log(exists * observed[:, None, 1] + (1 - exists) * observed[:, None, 0])


class Model:
    """The tree's edges and the likelihoods, as the kernels want them."""

    def __init__(self, tree: ChowLiuTree, table: Floats) -> None:
        self.tree, self.table = tree, table
        order = np.argsort(tree.parent, kind="stable").astype(np.int32)
        start = np.searchsorted(tree.parent[order], np.arange(len(tree) + 1))
        self.children, self.child_start = order, start.astype(np.int64)


class Evidence:
    """ln p(Z | L) of every place at once: FAB-MAP 2.0's inverted index.

    Almost all words are absent from both image and place. What a place is worth to an image without any word is
    summed beforehand; then only words of the image and their children in the tree are corrected for, and only at the
    places that have the word. Rows are in the order given.
    """

    def __init__(self, places: Sequence[Words], model: Model) -> None:
        self._count, self._model = len(places), model
        lengths = [len(place) for place in places]
        owners = np.repeat(np.arange(len(places), dtype=np.int32), lengths)
        words = np.concatenate([np.zeros(0, np.int64), *(place.astype(np.int64) for place in places)])
        order = np.argsort(words, kind="stable")
        self._list_start = np.searchsorted(words[order], np.arange(len(model.tree) + 1)).astype(np.int64)
        self._list_place = owners[order]
        silent = model.table[:, :, 0, 0]
        gain = (silent[:, _SEEN] - silent[:, _UNSEEN])[words]
        self._base = silent[:, _UNSEEN].sum() + np.bincount(owners, gain, minlength=len(places))

    def __len__(self) -> int:
        return self._count

    def __call__(self, words: Words, stop: int) -> tuple[Floats, Bools]:
        """(stop,) ln p(Z | L), and whether the place has a word of the image."""
        model = self._model
        return _evidence(
            words, model.tree.parent, model.child_start, model.children, model.table,
            self._list_start, self._list_place, self._base[:stop],
        )  # fmt: skip


@numba.njit(cache=True, nogil=True)
def _evidence(words, parent, child_start, children, table, list_start, list_place, base):
    """(stop,) float64 log likelihood and bool: starts from `base`, a sum per place; `words` increase."""
    V, stop = parent.shape[0], base.shape[0]
    present = np.zeros(V, np.bool_)
    for word in words:
        present[word] = True
    result, shared = base.copy(), np.zeros(stop, np.bool_)
    everywhere = 0.0
    for word in words:
        for k in range(-1, child_start[word + 1] - child_start[word]):
            q = np.int64(word) if k < 0 else np.int64(children[child_start[word] + k])
            if k >= 0 and present[q]:
                continue  # it is one of the words itself
            z = 1 if present[q] else 0
            zp = 1 if parent[q] >= 0 and present[parent[q]] else 0
            everywhere += table[q, 0, zp, z] - table[q, 0, 0, 0]
            change = (table[q, 1, zp, z] - table[q, 0, zp, z]) - (table[q, 1, 0, 0] - table[q, 0, 0, 0])
            for e in range(list_start[q], list_start[q + 1]):
                place = list_place[e]
                if place >= stop:
                    break
                result[place] += change
                if z == 1:
                    shared[place] = True
    return result + everywhere, shared


def _average_place(words: Words, model: Model) -> float:
    """ln p(Z | the average place): the mean field approximation of a new place (2008, section on new places)."""
    present = np.zeros(len(model.tree), np.int64)
    present[words] = 1
    parent = model.tree.parent
    z_parent = np.where(parent < 0, 0, present[parent])
    return float(model.table[np.arange(len(parent)), _AVERAGE, z_parent, present].sum())


def _log_mean(logs: Floats) -> float:
    """ln of the mean of exp: a new place by samples (2008, section on new places)."""
    return float(np.logaddexp.reduce(logs) - np.log(len(logs)))


def _calibrate(
    references: Sequence[Reference], images: Sequence[Words], model: Model, drawn: NDArray[np.int64] | None
) -> tuple[float, float]:
    """What the evidence is worth, from the references alone: its weight, and nats to add to a new place's.

    References are queries in turn, and the others of the same drive are the places: those next to it in time show its
    place, those far from it in time do not, and no truth is needed. The weight is an exponent of the likelihood (a
    temperature: Guo et al., On calibration of modern neural networks, ICML 2017, section 4.2; Ribatet, Cooley &
    Davison, Statistica Sinica 22, 2012, adjust composite likelihoods by it), here the one that makes the neighbours
    most likely. The tree has seen the query too; trees without it give a weight within 3 %.
    The nats make a new place come out as often as there is one, where every query is asked twice: with all the other
    places, and with the far ones only. The papers' own (1, 0) where too few references have neighbours.
    """
    asked, others, neighbour, far = _by_time(references)
    if len(asked) < _LEAST_IMAGES:
        return 1.0, 0.0
    evidence = Evidence(images, model)
    log_ratio = np.empty((len(asked), len(images)))
    for k, row in enumerate(asked):
        log_ratio[k] = evidence(images[row], len(images))[0]
        new_place = (
            _average_place(images[row], model) if drawn is None else _log_mean(log_ratio[k, drawn[drawn != row]])
        )
        log_ratio[k] -= new_place
    surprise = [
        (_log_sum(weight * log_ratio, others) - _log_sum(weight * log_ratio, neighbour)).mean() for weight in _WEIGHTS
    ]
    weight = float(_WEIGHTS[np.argmin(surprise)])
    # both questions together have a new place half of the time: even odds against the mean of the places
    known = [_log_sum(weight * log_ratio, places) - np.log(places.sum(axis=1)) for places in (others, far)]
    return weight, _even_odds(np.concatenate(known), len(asked)) / weight


def _by_time(references: Sequence[Reference]) -> tuple[NDArray[np.int64], Bools, Bools, Bools]:
    """(A,) rows to ask of, and (A, L) which are the other places of the drive, which its neighbours, which are far."""
    names = {name: number for number, name in enumerate(sorted({reference.drive for reference in references}))}
    drive = np.array([names[reference.drive] for reference in references])
    order = np.lexsort((np.arange(len(drive)), np.array([reference.stamp_ns for reference in references]), drive))
    size = np.bincount(drive)
    position = np.empty(len(drive), np.int64)
    position[order] = np.arange(len(drive)) - (np.cumsum(size) - size)[drive[order]]
    asked = np.flatnonzero(size[drive] >= _LEAST_IMAGES)
    asked = asked[:: -(-len(asked) // _MOST_QUERIES) or 1]
    same = drive[asked, None] == drive
    gap = np.abs(position[asked, None] - position)
    return asked, same & (gap > 0), same & (gap == 1), same & (gap > size[drive] / _NEAR_SHARE) & (gap > 1)


def _log_sum(logs: Floats, chosen: Bools) -> Floats:
    """(A,) ln of the sum of exp over the chosen of (A, L)."""
    return np.logaddexp.reduce(logs, axis=1, where=chosen, initial=-np.inf)


def _even_odds(known: Floats, new_places: int) -> float:
    """The log likelihood of a new place at which its probabilities against `known` sum to `new_places`."""
    low, high = known.min() - 50.0, known.max() + 50.0  # e^-50 is nothing beside 1
    for _ in range(60):  # halvings: to the last bit of a sum that grows with the answer
        middle = (low + high) / 2
        if np.exp(-np.logaddexp(0, known - middle)).sum() < new_places:
            low = middle
        else:
            high = middle
    return float((low + high) / 2)


@dataclass(frozen=True, eq=False)
class FabmapState:
    """Words, their tree and what evidence is worth. Shared freely between threads."""

    settings: FabmapSettings
    references: list[Reference]
    vocabulary: Vocabulary
    model: Model
    samples: Evidence | None
    """Places of the references drawn for a new place, None for the mean field."""
    weight: float
    """Exponent of the likelihood, 1 for the papers' own."""
    new_place_nats: float
    """Added to the log likelihood of a new place, 0 for the papers' own."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "hash", stored.references_hash(self.references, self.settings))

    hash: str = ""

    @property
    def _most_words(self) -> int:
        return min(self.settings.features, len(self.vocabulary))

    @property
    def bits(self) -> int:
        """Size of the largest place: as many words as there may be. Images with fewer features take less."""
        return 8 * (_PLACE_BYTES + _WORD_BYTES * self._most_words)

    @property
    def arrow_type(self) -> pa.DataType:
        return _PLACE

    def describe(self, features: Features) -> Words:
        """(K,) uint16: the words present, increasing."""
        return _words(self.vocabulary, features.descriptors[: self.settings.features])

    def index(self, descriptors: Sequence[Words]) -> FabmapIndex:
        return FabmapIndex(self, descriptors)

    def to_arrow(self, descriptors: Sequence[Words]) -> pa.Array:
        start = np.concatenate([[0], np.cumsum([len(place) for place in descriptors])]).astype(np.int32)
        words = np.concatenate([np.zeros(0, np.uint16), *descriptors]).astype(np.uint16)
        return pa.ListArray.from_arrays(pa.array(start), pa.array(words), type=_PLACE)

    def from_arrow(self, column: pa.Array) -> list[Words]:
        """The places of a table's column. Raises LibraryError where it is of another kind or library."""
        if not column.type.equals(_PLACE):
            raise LibraryError(f"Descriptors of type {column.type} do not fit this recogniser's {_PLACE}.")
        items = column.flatten()
        if column.null_count or items.null_count:
            raise LibraryError("Some descriptors have no value; write them anew with `vplog run`.")
        words = items.to_numpy()
        if len(words) and words.max() >= len(self.vocabulary):
            raise LibraryError("The descriptors name words that this library does not have.")
        lengths = column.value_lengths().to_numpy()
        stop = np.cumsum(lengths)
        start = stop - lengths
        rising = np.diff(words.astype(np.int32), prepend=-1) > 0
        rising[start[start < len(words)]] = True  # a place's first word follows none
        if not np.all(rising):
            raise LibraryError("The descriptors name a word twice or out of order; write them anew with `vplog run`.")
        return [words[a:b] for a, b in zip(start, stop, strict=True)]

    def save(self, folder: Path) -> None:
        stored.save_references(self.references, self.settings, folder)


class FabmapIndex:
    """Places of a map; rows are in the order given. A query's prior is the same for every place."""

    def __init__(self, state: FabmapState, places: Sequence[Words]) -> None:
        self._state, self._evidence = state, Evidence(places, state.model)

    def __len__(self) -> int:
        return len(self._evidence)

    def log_likelihood(self, descriptor: Words, stop: int | None = None) -> tuple[Floats, float]:
        """(stop,) float64 ln p(Z | L) of the places and that of a new place, neither weighed nor smoothed."""
        places, _ = self._evidence(descriptor, self._below(stop))
        return places, self._new_place(descriptor)

    def scores(self, descriptor: Words, stop: int | None = None) -> Float32s:
        """(stop,) natural log of each place's posterior, before smoothing.

        Smoothing keeps the order of a query's places, but would make all that are far from the best equal.
        """
        return self._log_posterior(descriptor, stop)[0].astype(np.float32)

    def posterior(self, descriptor: Words, stop: int | None = None) -> tuple[Floats, float]:
        """(stop,) float64 probability of each place, smoothed, and that of a new place; they sum to 1.

        A new place is certain where there is no other.
        """
        s = self._state.settings
        places, new, _ = self._log_posterior(descriptor, stop)
        if len(places) == 0:
            return np.zeros(0), 1.0
        prior = np.append(np.full(len(places), (1 - s.new_place_prior) / len(places)), s.new_place_prior)
        possible = prior > 0
        prior = prior[possible]
        likelihood = np.append(places, new)[possible] - np.log(prior)
        likelihood = np.exp(likelihood - np.logaddexp.reduce(likelihood))
        # 2.0, on likelihood smoothing: p(Z | L) becomes sigma p(Z | L) + (1 - sigma) / number of places
        joint = (s.smoothing * likelihood + (1 - s.smoothing) / len(likelihood)) * prior
        joint /= joint.sum()
        return joint[: len(places)], float(joint[-1]) if s.new_place_prior else 0.0

    def query(self, descriptor: Words, k: int, stop: int | None = None) -> Ranking:
        """The k most probable places below row `stop` that share a word; ties go to the earlier row."""
        places, _, shared = self._log_posterior(descriptor, stop)
        score = places.astype(np.float32)
        rows = np.flatnonzero(shared)
        rows = rows[np.lexsort((rows, -score[rows]))][: max(k, 0)]
        return Ranking(rows.astype(np.int32), score[rows])

    def _log_posterior(self, descriptor: Words, stop: int | None) -> tuple[Floats, float, Bools]:
        """ln p(L | Z) of the places and of a new place before smoothing, and whether a place shares a word."""
        state = self._state
        prior = state.settings.new_place_prior
        places, shared = self._evidence(descriptor, self._below(stop))
        if len(places) == 0:
            return places, 0.0, shared
        places = state.weight * places + np.log((1 - prior) / len(places))
        new = -np.inf
        if prior:
            new = state.weight * (self._new_place(descriptor) + state.new_place_nats) + np.log(prior)
        total = np.logaddexp(np.logaddexp.reduce(places), new)
        return places - total, float(new - total), shared

    def _new_place(self, descriptor: Words) -> float:
        samples = self._state.samples
        if samples is None:
            return _average_place(descriptor, self._state.model)
        return _log_mean(samples(descriptor, len(samples))[0])

    def _below(self, stop: int | None) -> int:
        return len(self) if stop is None else min(stop, len(self))


def _words(vocabulary: Vocabulary, descriptors: NDArray[np.uint8]) -> Words:
    return np.unique(vocabulary.quantise(descriptors)).astype(np.uint16)
