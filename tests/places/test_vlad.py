"""VLAD: sums of residuals, whitened, found again."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pytest

from tests.places.pictures import nothing
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places.vlad import VladSettings, Whitening, aggregate
from vplog.places.vocabulary import learn_vocabulary, root_sift

if TYPE_CHECKING:
    from vplog.data import Reference

SMALL = VladSettings(centres=8, features=250)
WHOLE = VladSettings(centres=8, features=250, dimensions=None)


def test_bad_input(references: list[Reference]) -> None:
    with pytest.raises(LibraryError, match="at least two"):
        SMALL.learn(references[:1], Execution())
    state = SMALL.learn(references, Execution())
    broken = np.full(state.bits // 16, np.nan, np.float16)
    with pytest.raises(LibraryError, match="finite"):
        state.from_arrow(state.to_arrow([broken]))
    with pytest.raises(LibraryError, match="do not fit"):
        state.from_arrow(pa.array([[1.0]], pa.list_(pa.float16(), 1)))


def test_a_vector_is_the_residuals_centre_by_centre(references: list[Reference]) -> None:
    features = references[0].features
    vocabulary = learn_vocabulary(features.descriptors, 5, 0, Execution())
    parts = np.zeros((len(vocabulary), 128))
    for descriptor in root_sift(features.descriptors[:100]).astype(np.float64):
        nearest = np.square(vocabulary.centres - descriptor).sum(axis=1).argmin()
        parts[nearest] += descriptor - vocabulary.centres[nearest]
    parts /= np.maximum(np.linalg.norm(parts, axis=1, keepdims=True), 1e-9)
    expected = parts.reshape(-1) / np.linalg.norm(parts)
    np.testing.assert_allclose(aggregate(features, 100, vocabulary), expected, atol=1e-6)
    assert not aggregate(nothing(), 100, vocabulary).any()


def test_without_shrinkage_the_whitened_references_are_white() -> None:
    raw = np.random.default_rng(0).normal(size=(40, 300)).astype(np.float32) * np.linspace(1, 5, 300, dtype=np.float32)
    white = Whitening.learn(raw, 20, 0.0)
    projected = (raw - white.mean) @ white.projection.T
    np.testing.assert_allclose(projected.T @ projected / len(raw), np.eye(20), atol=1e-3)
    assert len(Whitening.learn(raw, 128, 1.0).projection) == 39  # so many directions do 40 references span


def test_places_are_of_unit_length_and_as_long_as_the_references_allow(references: list[Reference]) -> None:
    state = SMALL.learn(references, Execution())
    place = state.describe(references[0].features)
    assert place.shape == (len(references) - 1,)
    assert np.linalg.norm(place.astype(np.float64)) == pytest.approx(1, abs=2e-3)
    assert WHOLE.learn(references, Execution()).bits == 8 * 128 * 16
