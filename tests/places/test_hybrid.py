"""Hybrid: boxes and signs of words, each as it is alone, balanced by the references."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pytest
from hypothesis import given
from hypothesis import strategies as st

from tests.places.pictures import noisy, nothing, reference
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places.bobb import BobbSettings, Place
from vplog.places.dense import thumbnail_of
from vplog.places.hybrid import HybridIndex, HybridPlace, HybridSettings, HybridState, learn_vlad
from vplog.places.matches import WeighedMatchSettings, patches_of
from vplog.places.patches import describe_patches
from vplog.places.vocabulary import root_sift

if TYPE_CHECKING:
    from vplog.data import Bytes, Features, Reference

SMALL = HybridSettings(bobb=BobbSettings(references=4, features=250), words=4)


@pytest.fixture(scope="module")
def hybrid(references: list[Reference]) -> HybridState:
    return SMALL.learn(references, Execution(2))


def test_evidence_is_the_larger_part_of_the_score(hybrid: HybridState, references: list[Reference]) -> None:
    place, other = (hybrid.describe(references[row].features) for row in (0, 1))
    for share, expected in ((0.0, hybrid.bobb.evidence(place, other)), (1.0, "words")):
        state = HybridState(hybrid.settings, hybrid.references, hybrid.bobb, hybrid.vlad, share)
        assert state.evidence(place, replace(other, signs=place.signs)) == expected


class NoBoxes:
    """The boxes of `count` places that have nothing in common with any."""

    def __init__(self, count: int) -> None:
        self.count = count

    def __len__(self) -> int:
        return self.count

    def scores(self, _descriptor: object, stop: int | None = None) -> np.ndarray:
        return np.zeros(self.count if stop is None else min(stop, self.count), np.float32)


def signs_alone(signs: Bytes) -> HybridIndex:
    return HybridIndex(NoBoxes(len(signs)), signs, 1.0)  # pyrefly: ignore[bad-argument-type]


def literal_signs(state: HybridState, features: Features) -> list[bool]:
    """What `BinaryVlad.signs` says, a feature and a bit at a time."""
    words = state.vlad
    residuals = [np.zeros(words.centres.shape[1]) for _ in words.centres]
    size = np.array([features.width, features.height])
    patches, middles = describe_patches(thumbnail_of(features))
    descriptors = np.concatenate([root_sift(features.descriptors), patches / 512])
    points = np.concatenate([(features.points + 0.5) / size, middles])
    for descriptor, point in zip(descriptors, points, strict=True):
        value = (descriptor.astype(np.float64) - words.mean) @ words.directions
        value = np.append(value, (point - 0.5) * words.place)
        differences = [value - centre / 4096 for centre in words.centres]
        nearest = int(np.argmin([np.linalg.norm(difference) for difference in differences]))
        residuals[nearest] += differences[nearest] / np.linalg.norm(differences[nearest])
    return [float(residual @ direction) > 0 for residual in residuals for direction in words.rotation.T]


def test_signs_are_those_of_the_words_residuals(references: list[Reference]) -> None:
    whole = SMALL.model_copy(update={"bobb": SMALL.bobb.model_copy(update={"least_size": 0.0})})
    state = whole.learn(references, Execution())
    for row in (0, 5):
        features = state.bobb.matcher.references[row].features
        bits = np.unpackbits(state.describe(features).signs).astype(bool)
        # a sum next to zero may round to the other side
        assert np.mean(bits == literal_signs(state, features)) > 0.98


def test_bits_are_even_and_near_features_give_near_signs(hybrid: HybridState, references: list[Reference]) -> None:
    places = [hybrid.describe(row.features) for row in references]
    again = [hybrid.describe(noisy(row.features, 3)) for row in references]
    bits = np.array([np.unpackbits(place.signs) for place in places])
    assert 0.4 < bits.mean() < 0.6
    other = np.array([np.unpackbits(place.signs) for place in again])
    differ = (bits[:, None] != other[None]).mean(axis=2)
    assert np.diag(differ).max() < differ[~np.eye(len(differ), dtype=bool)].min()


@given(
    st.integers(1, 20).flatmap(lambda n: st.lists(st.binary(min_size=n, max_size=n), min_size=1, max_size=30)),
    st.integers(0, 29),
)
def test_agreement_counts_equal_bits(rows: list[bytes], query: int) -> None:
    signs = np.array([list(row) for row in rows], np.uint8)
    asked = signs[query % len(signs)]
    none = Place(np.zeros(0, np.uint16), np.zeros(0, np.uint8), np.zeros((0, 9), np.uint8))
    _, agreement = signs_alone(signs).similarities(HybridPlace(**vars(none), signs=asked))
    differ = np.unpackbits(signs ^ asked, axis=1).mean(axis=1)
    expected = np.maximum(1 - 2 * differ, 0) * signs.any(axis=1) * asked.any()
    np.testing.assert_allclose(agreement, expected, atol=1e-6)


def test_a_score_is_both_similarities_in_their_shares(hybrid: HybridState, references: list[Reference]) -> None:
    places = [hybrid.describe(row.features) for row in references]
    index, boxes = hybrid.index(places), hybrid.bobb.index(places)
    for place in places[:4]:
        alone, words = index.similarities(place)
        np.testing.assert_array_equal(alone, boxes.scores(place))
        np.testing.assert_allclose(
            index.scores(place), (1 - hybrid.share) * alone + hybrid.share * words, rtol=1e-6, atol=1e-7
        )
    assert index.scores(places[2])[2] == pytest.approx(1)


def test_at_a_half_both_vary_alike_between_the_references(hybrid: HybridState, references: list[Reference]) -> None:
    places = [hybrid.describe(row.features) for row in references]
    index = hybrid.index(places)
    alike = np.array([index.similarities(place) for place in places])
    boxes, words = (part[~np.eye(len(places), dtype=bool)].std() for part in alike.transpose(1, 0, 2))
    assert (1 - hybrid.share) * boxes == pytest.approx(hybrid.share * words, rel=1e-4)
    for share in (0.0, 1.0):
        assert SMALL.model_copy(update={"share": share}).learn(references, Execution()).share == share


def test_words_tell_places_that_the_library_does_not_explain(references: list[Reference]) -> None:
    """References of one panorama, places of another: no box is of use, the words are."""
    state = SMALL.learn(references[:6], Execution())
    elsewhere = [reference(seed) for seed in range(40, 52, 2)]
    index = state.index([state.describe(row.features) for row in elsewhere])
    found = [index.query(state.describe(noisy(row.features, 1)), 1).rows[0] for row in elsewhere]
    assert found == list(range(len(elsewhere)))


def test_a_place_fits_160_bytes(references: list[Reference]) -> None:
    state = HybridSettings().learn(references[:2], Execution())
    assert state.bits <= 8 * 160


def test_one_reference_is_enough(references: list[Reference]) -> None:
    state = SMALL.learn(references[:1], Execution())
    assert state.share == SMALL.share
    assert not state.describe(nothing()).signs.any()


def test_fewer_features_than_words_will_do(references: list[Reference]) -> None:
    described = patches_of(references[0].features, WeighedMatchSettings())
    words = learn_vlad([described], HybridSettings(words=256, bits=8))
    assert words.signs(*described).shape == (256,)


def test_bad_columns_are_refused(hybrid: HybridState, references: list[Reference]) -> None:
    column = hybrid.to_arrow([hybrid.describe(references[0].features)])
    with pytest.raises(LibraryError, match="not fit"):
        hybrid.from_arrow(column.field("boxes"))
    boxes = pa.array([None], hybrid.bobb.arrow_type)
    broken = pa.StructArray.from_arrays([boxes, column.field("signs")], fields=list(hybrid.arrow_type))
    with pytest.raises(LibraryError, match="no value"):
        hybrid.from_arrow(broken)
