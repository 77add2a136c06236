"""Bag of visual features: the cosine of tf-idf vectors, cut to a number of bytes where asked."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pytest

from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places.bovf import BovfSettings, BovfState

if TYPE_CHECKING:
    from vplog.data import Reference

SMALL = BovfSettings(words=300, features=250)


@pytest.fixture(scope="module")
def learned(references: list[Reference]) -> BovfState:
    return SMALL.learn(references, Execution(2))


def test_one_reference_is_too_few(references: list[Reference]) -> None:
    with pytest.raises(LibraryError, match="at least two"):
        SMALL.learn(references[:1], Execution())


@pytest.mark.parametrize("damped", [False, True])
def test_scores_are_cosines_of_tf_idf(references: list[Reference], damped: bool) -> None:
    state = BovfSettings(words=300, features=250, damp_bursts=damped).learn(references, Execution(2))
    V = len(state.vocabulary)
    counts = np.array(
        [np.bincount(state.vocabulary.quantise(r.features.descriptors[:250]), minlength=V) for r in references]
    )
    idf = np.log(len(references) / np.maximum((counts > 0).sum(axis=0), 1))
    vectors = (np.sqrt(counts) if damped else counts) * idf
    vectors /= np.linalg.norm(vectors, axis=1, keepdims=True)
    index = state.index([state.describe(r.features) for r in references])
    found = [index.scores(state.describe(r.features)) for r in references]
    np.testing.assert_allclose(found, vectors @ vectors.T, atol=1e-5)


@pytest.mark.parametrize("max_bytes", [7, 64, 129, 100_000])
def test_a_cut_place_fits_its_bytes_and_keeps_the_weightiest(
    references: list[Reference], learned: BovfState, max_bytes: int
) -> None:
    state = BovfSettings(words=300, features=250, max_bytes=max_bytes).learn(references, Execution(2))
    places = [state.describe(r.features) for r in references]
    column = state.to_arrow(places)
    assert column.nbytes <= (max_bytes + 0.5) * len(places)  # half a byte: the list of n places has n + 1 offsets
    assert state.bits <= 8 * max_bytes
    for place, reference in zip(places, references, strict=True):
        full = learned.describe(reference.features)
        weight = dict(zip(full["word"].tolist(), np.sqrt(full["count"]) * learned.idf[full["word"]], strict=True))
        kept = set(place["word"].tolist())
        assert len(kept) == min((max_bytes - 4) // 3, len(weight))
        dropped = weight.keys() - kept
        assert min(weight[w] for w in kept) >= max((weight[w] for w in dropped), default=0)


def test_damaged_tables_are_refused(learned: BovfState) -> None:
    def column(words: list[int], counts: list[int]) -> pa.Array:
        place = list(zip(words, counts, strict=True))
        return learned.to_arrow([np.array(place, [("word", np.uint16), ("count", np.uint8)])])

    assert len(learned.from_arrow(column([1, 2], [1, 1]))[0]) == 2
    for words, counts in ([2, 1], [1, 1]), ([1, 1], [1, 1]), ([1, 2], [1, 0]):
        with pytest.raises(LibraryError, match=r"twice|zero times"):
            learned.from_arrow(column(words, counts))
    with pytest.raises(LibraryError, match="does not have"):
        learned.from_arrow(column([1, 60_000], [1, 1]))
    other = column([5, 9], [1, 1])
    joined = pa.concat_arrays([other, column([], []), other])
    assert [place["word"].tolist() for place in learned.from_arrow(joined)] == [[5, 9], [], [5, 9]]
