"""FAB-MAP: the probability that two images show one place, from which words tend to occur together.

Cummins & Newman, FAB-MAP: Probabilistic localization and mapping in the space of appearance, IJRR 27(6), 2008, and
Appearance-only SLAM at large scale with FAB-MAP 2.0, IJRR 30(9), 2011; below "2008" and "2.0".

An image is the set of words it has, z_q = 1 or 0. Behind a word is something that exists at the place or not, e_q, and
a detector that misses much of it. A place is p(e_q = 1 | L) for every word. The words of an image depend on each other
through a Chow-Liu tree, z_p being the parent of z_q.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, Self

import numpy as np
import pyarrow as pa
from numpy.typing import NDArray
from pydantic import Field, model_validator

from vplog.data import Bools, Features, Float32s, Floats, Ranking, Reference
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places.columns import from_lists, to_lists
from vplog.places.dense import ranked
from vplog.places.fabmap_model import (
    Evidence,
    Model,
    average_place,
    calibrate,
    learn_tree,
    log_likelihood_table,
    log_mean,
)
from vplog.places.library_files import ReferencesState, RelearnedSettings, keep_references
from vplog.places.vocabulary import Vocabulary, learn_vocabulary

Words = NDArray[np.uint16]

_WORD_BYTES, _PLACE_BYTES = 2, 4
"""In a table: a word's number in two bytes; where a place's list begins in four."""
_PLACE = pa.list_(pa.field("item", pa.uint16(), nullable=False))


class FabmapSettings(RelearnedSettings):
    """FAB-MAP 2.0: Chow-Liu tree, one image a place, inverted index, posterior over places and a new one."""

    kind: Literal["fabmap"] = "fabmap"
    """Name of the recogniser."""
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
    samples: int = Field(default=100, ge=2, le=100_000)
    """References drawn for a sampled new place; all of them where they are fewer."""
    new_place_prior: float = Field(default=0.9, ge=0, lt=1)
    """Prior of a new place, as in the papers; the places share the rest alike. 0: all queries are in the map."""
    smoothing: float = Field(default=0.99, gt=0, le=1)
    """Sigma: share of the likelihood kept, the rest is spread over all places (2.0, on likelihood smoothing)."""
    calibrate: bool = True
    """Weigh the evidence by what it is worth among the references themselves: words that occur together are not so
    many independent observations, so without it the posterior is far too certain."""
    seed: int = Field(default=0, ge=0)
    """Seed of the first centres of k-means and the samples."""

    @model_validator(mode="after")
    def _detects(self) -> Self:
        if self.seen_if_absent >= self.seen_if_there:
            raise ValueError(
                f"seen_if_absent {self.seen_if_absent} must be below seen_if_there {self.seen_if_there}: "
                "else an observed word would be evidence of its absence"
            )
        return self

    def learn(self, references: Iterable[Reference], execution: Execution) -> FabmapState:
        """Words and their tree from the references. Raises LibraryError where too few or featureless."""
        used = keep_references(references, self.features)
        if len(used) < 2:
            raise LibraryError(
                "fabmap learns which words occur together, so it needs at least two references; one was given."
            )
        descriptors = [reference.features.descriptors for reference in used]
        vocabulary = learn_vocabulary(np.concatenate(descriptors), self.words, self.seed, execution)
        images = list(execution.map(lambda rows: _words(vocabulary, rows), descriptors))
        tree = learn_tree(images, len(vocabulary), self.independence)
        model = Model(tree, log_likelihood_table(tree, self.seen_if_there, self.seen_if_absent))
        drawn = np.sort(np.random.default_rng(self.seed).permutation(len(images))[: self.samples])
        weight, new_place_nats = 1.0, 0.0
        if self.calibrate:
            weight, new_place_nats = calibrate(used, images, model, drawn if self.new_place == "sampled" else None)
        samples = Evidence([images[row] for row in drawn], model) if self.new_place == "sampled" else None
        return FabmapState(self, used, vocabulary, model, samples, weight, new_place_nats)


@dataclass(frozen=True, eq=False)
class FabmapState(ReferencesState):
    """Words, their tree and what evidence is worth. Shared freely between threads."""

    settings: FabmapSettings  # pyrefly: ignore[bad-override]
    references: list[Reference]  # pyrefly: ignore[bad-override]
    vocabulary: Vocabulary
    model: Model
    samples: Evidence | None
    """Places of the references drawn for a new place, None for the mean field."""
    weight: float
    """Exponent of the likelihood, 1 for the papers' own."""
    new_place_nats: float
    """Added to the log likelihood of a new place, 0 for the papers' own."""
    arrow_type = _PLACE

    @property
    def bits(self) -> int:
        """Size of the largest place: as many words as there may be. Images with fewer features take less."""
        return 8 * (_PLACE_BYTES + _WORD_BYTES * min(self.settings.features, len(self.vocabulary)))

    def describe(self, features: Features) -> Words:
        """(K,) uint16: the words present, increasing."""
        return _words(self.vocabulary, features.descriptors[: self.settings.features])

    def index(self, descriptors: Sequence[Words]) -> FabmapIndex:
        return FabmapIndex(self, descriptors)

    def index_of_part(self, descriptors: Sequence[Words]) -> FabmapPart:
        """An index of some places of a map, whose scores compare with those of its other parts."""
        return FabmapPart(self, descriptors)

    def to_arrow(self, descriptors: Sequence[Words]) -> pa.Array:
        return to_lists(descriptors, _PLACE)

    def from_arrow(self, column: pa.Array) -> list[Words]:
        return from_lists(column, _PLACE, len(self.vocabulary))


class FabmapPart:
    """Some places of a map; rows are in the order given. A posterior is over all places there are, so here a place's
    score is the natural log of how much more likely the image is there than at a new place: over the whole map the
    order is that of the posterior."""

    def __init__(self, state: FabmapState, places: Sequence[Words]) -> None:
        self._state, self._evidence = state, Evidence(places, state.model)

    def __len__(self) -> int:
        return len(self._evidence)

    def scores(self, descriptor: Words, stop: int | None = None) -> Float32s:
        """(stop,) natural log of each place's score."""
        return self._scored(descriptor, stop)[0]

    def query(self, descriptor: Words, k: int, stop: int | None = None) -> Ranking:
        """The k most probable places below row `stop` that share a word; ties go to the earlier row."""
        score, shared = self._scored(descriptor, stop)
        return ranked(np.flatnonzero(shared), score, k)

    def _scored(self, descriptor: Words, stop: int | None) -> tuple[Float32s, Bools]:
        """(stop,) scores, and whether each place shares a word with the image."""
        places, new, shared = self.log_likelihood(descriptor, stop)
        return (self._state.weight * (places - new)).astype(np.float32), shared

    def log_likelihood(self, descriptor: Words, stop: int | None = None) -> tuple[Floats, float, Bools]:
        """(stop,) ln p(Z | L) of the places, that of a new place with its calibration, and whether a place shares a
        word."""
        state = self._state
        places, shared = self._evidence(descriptor, len(self) if stop is None else min(stop, len(self)))
        if state.samples is None:
            new = average_place(descriptor, state.model)
        else:
            new = log_mean(state.samples(descriptor, len(state.samples))[0])
        return places, new + state.new_place_nats, shared


class FabmapIndex(FabmapPart):
    """A whole map: scores are natural logs of the posterior before smoothing, which would make all places that are far
    from the best equal. A query's prior is the same for every place."""

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

    def _scored(self, descriptor: Words, stop: int | None) -> tuple[Float32s, Bools]:
        places, _, shared = self._log_posterior(descriptor, stop)
        return places.astype(np.float32), shared

    def _log_posterior(self, descriptor: Words, stop: int | None) -> tuple[Floats, float, Bools]:
        """ln p(L | Z) of the places and of a new place before smoothing, and whether a place shares a word."""
        prior, weight = self._state.settings.new_place_prior, self._state.weight
        places, new, shared = self.log_likelihood(descriptor, stop)
        if len(places) == 0:
            return places, 0.0, shared
        places = weight * places + np.log((1 - prior) / len(places))
        new = weight * new + np.log(prior) if prior else -np.inf
        total = np.logaddexp(np.logaddexp.reduce(places), new)
        return places - total, float(new - total), shared


def _words(vocabulary: Vocabulary, descriptors: NDArray[np.uint8]) -> Words:
    return np.unique(vocabulary.quantise(descriptors)).astype(np.uint16)
