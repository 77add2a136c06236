"""Each step against a slow one of plain Python, and a recogniser that finds what it has seen in 120 bytes."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.places.pictures import noisy, nothing, reference
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places import expected_votes
from vplog.places.bobb import NO_BOX, NO_REFERENCE, BobbSettings, BobbState, Place, _rarity
from vplog.places.code_search import BLOCK, CodeIndex, build_lists
from vplog.places.matches import WeighedMatchSettings, _itself, _weigh, index_references, large_enough

if TYPE_CHECKING:
    from vplog.data import Reference

TINY = BobbSettings(references=4, features=250)


@pytest.fixture(scope="module")
def learned(references: list[Reference]) -> BobbState:
    return TINY.learn(references, Execution(2))


def test_without_a_floor_matches_that_agree_with_none_name_no_reference(references: list[Reference]) -> None:
    """A view of one feature has none beside it."""
    state = BobbSettings(references=4, features=250, agreement_floor=0.0).learn(references, Execution())
    features = [replace(noisy(one.features, 1), thumbnail=None) for one in references]
    for one in features:
        assert (state.describe(one.rows(slice(1))).references == NO_REFERENCE).all()
        assert state.describe(one).weights[0] == 255


def test_a_place_of_the_defaults_is_stored_in_120_bytes(references: list[Reference]) -> None:
    state = BobbSettings().learn(references, Execution())
    column = state.to_arrow([state.describe(r.features) for r in references])
    assert state.bits == 960
    leaves = [column.field(i).flatten() for i in range(column.type.num_fields)]
    assert sum(len(leaf) * leaf.type.bit_width // 8 for leaf in leaves) == 120 * len(references)


@pytest.mark.parametrize(("own", "weight"), [(1.0, 255), (2.0, 180), (4.0, 128)])
def test_a_reference_is_explained_by_itself_more_than_by_the_best_other(
    own: float, weight: int, references: list[Reference]
) -> None:
    """By the root of how much more."""
    learned = BobbSettings(references=4, features=250, own=own).learn(references, Execution(2))
    places = [learned.describe(r.features) for r in references]
    windows = np.arange(9)
    for row, place in enumerate(places):
        assert place.references[0] == row
        assert place.weights[0] == 255
        assert place.weights[1] in (0, weight)
        column = place.boxes[0] % 9
        assert (column[windows % 3 == 0] < column[windows % 3 == 2]).all()  # its boxes lie as the windows do
    index = learned.index(places)
    found = [index.query(learned.describe(noisy(r.features, 9)), 1).rows[0] for r in references]
    assert np.mean(np.abs(np.array(found) - np.arange(len(found))) <= 1) > 0.9
    again = [index.query(place, 1) for place in places]
    assert [r.rows[0] for r in again] == list(range(len(places)))


def test_without_its_own_image_others_explain_a_reference(references: list[Reference]) -> None:
    learned = BobbSettings(references=4, features=250, own=0).learn(references, Execution(2))
    for row, r in enumerate(references):
        assert row not in learned.describe(r.features).references.tolist()


def test_an_image_without_features_shares_nothing(learned: BobbState, references: list[Reference]) -> None:
    empty = learned.describe(nothing())
    assert (empty.references == NO_REFERENCE).all()
    assert (empty.boxes == NO_BOX).all()
    index = learned.index([learned.describe(references[0].features), empty])
    assert len(index.query(empty, 5).rows) == 0
    assert index.scores(learned.describe(references[0].features))[1] == 0


def test_references_stand_by_falling_weight_and_the_best_has_255(
    learned: BobbState, references: list[Reference]
) -> None:
    for seed in range(12, 18):
        place = learned.describe(reference(seed).features)
        weights = place.weights.astype(int)
        assert weights[0] in (0, 255)
        assert (np.diff(weights) <= 0).all()
        used = place.references != NO_REFERENCE
        assert (weights[used] > 0).all()
        assert (weights[~used] == 0).all()


def test_grain_is_not_used() -> None:
    features = reference(3).features
    least = 0.02 * np.sqrt(320 * 200)
    kept = large_enough(features, WeighedMatchSettings(least_size=0.02, features=1000))
    assert (kept.sizes >= least).all()
    assert len(kept) == (features.sizes >= least).sum() < len(features)
    of_a_network = replace(features, sizes=np.full(len(features), 0.1, np.float32))  # all alike tell nothing of grain
    assert len(large_enough(of_a_network, WeighedMatchSettings(least_size=0.02, features=1000))) == len(features)


@pytest.mark.parametrize("kinds", [{"features": 0}, {"patch_weight": 0.0}, {}])
def test_matches_are_of_the_kinds_asked_for(kinds: dict[str, float], references: list[Reference]) -> None:
    wanted = WeighedMatchSettings(**kinds)
    matcher = index_references(references, wanted)
    keypoints, patches = matcher.indexed()
    assert (keypoints is None) == (wanted.features == 0)
    assert (patches is None) == (wanted.patch_weight == 0)
    seen = noisy(references[2].features, 9)
    found = matcher.match(seen)
    assert np.argmax(np.add.reduceat(np.append(found.weight, 0), found.start[:-1])) == 2
    expected = min(len(large_enough(seen, wanted)), wanted.features) + 169 * (wanted.patch_weight != 0)
    assert len(found.points) == expected
    assert found.itself == -1
    assert matcher.match(references[2].features).itself == 2


def test_features_without_a_thumbnail_have_keypoints_alone(references: list[Reference]) -> None:
    matcher = index_references(references, WeighedMatchSettings())
    bare = replace(noisy(references[2].features, 9), thumbnail=None)
    assert len(matcher.match(bare).points) == len(large_enough(bare, matcher.settings))
    with pytest.raises(LibraryError, match="single feature"):
        index_references(references, WeighedMatchSettings(features=0, patch_weight=0))


def test_popular_references_count_less() -> None:
    explained = np.array([[0.7, 0.2, 0.1], [0.6, 0.4, 0.0]])
    rare = _rarity(explained, 0.5)
    assert rare[0] < rare[1] < rare[2]
    np.testing.assert_array_equal(_rarity(explained, 0.0), 1.0)


@settings(max_examples=40, deadline=None)
@given(seed=st.integers(0, 10_000), itself=st.booleans())
def test_weights_are_those_of_the_definition(seed: int, itself: bool) -> None:
    rng = np.random.default_rng(seed)
    owner = np.sort(rng.integers(0, 5, 40)).astype(np.int32)
    distance = np.sort(rng.integers(0, 50, (6, 8)), axis=1).astype(np.float32)
    entry = np.array([rng.choice(40, 8, replace=False) for _ in range(6)])
    left_out = int(owner[entry[0, 0]]) if itself else -1
    feature, library, weight = _weigh(distance, entry, owner, 5, left_out, 0.8)
    expected = {}
    for f in range(6):
        pairs = [(d, e) for d, e in zip(distance[f], entry[f], strict=True) if owner[e] != left_out]
        last = pairs[-1][0] if pairs else 0.0
        nearest = {}
        for d, e in pairs:
            w = 1 - float(d) / (0.8 * float(last)) if last > 0 else 0.0
            if owner[e] not in nearest and w > 0:
                nearest[owner[e]] = (e, w)
        for e, w in nearest.values():
            expected[f, e] = w / np.sqrt(len(nearest))
    assert set(zip(feature.tolist(), library.tolist(), strict=True)) == set(expected)
    for f, e, w in zip(feature, library, weight, strict=True):
        assert w == pytest.approx(expected[f, e], rel=1e-5)


def test_an_image_is_itself_where_most_features_are_equal() -> None:
    owner = np.array([0, 0, 1, 1], np.int32)
    entry = np.array([[2, 0], [3, 1], [0, 2]])
    assert _itself(np.array([[0, 5], [0, 5], [0, 5]], np.float32), entry, owner, 2) == 1
    assert _itself(np.array([[0, 5], [1, 5], [1, 5]], np.float32), entry, owner, 2) == -1


@pytest.mark.parametrize("patches", [1, 5, 16, 32])
def test_the_closed_form_is_the_average_over_random_partitions(patches: int) -> None:
    """Two points share a patch of a random partition as often as the kernel says (Alg. 3 lines 6-13)."""
    borders = np.sort(np.random.default_rng(patches).random((20_000, patches - 1)), axis=1)
    middle = (np.arange(16) + 0.5) / 16
    patch = (borders[:, None, :] < middle[None, :, None]).sum(axis=2)
    together = (patch == patch[:, 8:9]).mean(axis=0)
    np.testing.assert_allclose(together, expected_votes.box_sums(16, patches, 1)[8], atol=0.015)


@settings(max_examples=25, deadline=None)
@given(seed=st.integers(0, 10_000))
def test_boxes_are_those_with_most_votes(seed: int) -> None:
    rng = np.random.default_rng(seed)
    here, there = rng.random((30, 2), np.float32), rng.random((30, 2), np.float32)
    weight = rng.random(30, np.float32)
    windows = expected_votes.even_windows(2, 0.6)
    along_x, along_y = expected_votes.box_sums(8, 8, 3), expected_votes.box_sums(6, 4, 2)
    boxes = expected_votes.best_boxes(here, there, weight, windows, along_y, along_x, 255)
    for window, box in zip(windows, boxes, strict=True):
        votes = np.zeros((6, 8))
        for (x, y), (u, v), w in zip(here, there, weight, strict=True):
            if window[0] <= x <= window[2] and window[1] <= y <= window[3]:
                column, row = (np.arange(8) + 0.5) / 8, (np.arange(6) + 0.5) / 6
                at = (int(u * 8) + 0.5) / 8, (int(v * 6) + 0.5) / 6
                votes += w * ((1 - np.abs(row - at[1])) ** 3)[:, None] * (1 - np.abs(column - at[0])) ** 7
        sums = [votes[y : y + 2, x : x + 3].sum() for y in range(5) for x in range(6)]
        if max(sums) > 0:
            assert sums[box] == pytest.approx(max(sums))
        else:
            assert box == 255


def test_matches_that_move_alike_count_more_than_a_stray() -> None:
    here = np.array([[0.1, 0.1], [0.3, 0.2], [0.5, 0.6], [0.8, 0.3]], np.float32)
    there = here + np.array([0.05, 0.0], np.float32)
    there[3] = [0.1, 0.9]
    ones = np.ones(4, np.float32)
    agreed = expected_votes.agreement(here, there, ones, 0.07, 0.3)
    np.testing.assert_allclose(agreed[:3], 0.3 + 0.7 * (1 - np.exp(-2)), rtol=1e-4)
    assert agreed[3] == pytest.approx(0.3)
    np.testing.assert_array_equal(expected_votes.agreement(here, there, ones, 0.07, 1.0), ones)


def test_overlaps_are_those_of_rectangles() -> None:
    table = expected_votes.overlaps((5, 4), 3, 2)
    for a in range(20):
        for b in range(20):
            field_a, field_b = np.zeros((5, 7), bool), np.zeros((5, 7), bool)
            field_a[a // 5 : a // 5 + 2, a % 5 : a % 5 + 3] = True
            field_b[b // 5 : b // 5 + 2, b % 5 : b % 5 + 3] = True
            assert table[a, b] == (field_a & field_b).sum()
    assert not table[20:].any()
    assert not table[:, 20:].any()


@settings(max_examples=30, deadline=None)
@given(seed=st.integers(0, 10_000), pairing=st.sampled_from(["best", "same", "both"]), stop=st.integers(0, 14))
def test_search_is_equation_1(seed: int, pairing: str, stop: int) -> None:
    rng = np.random.default_rng(seed)
    count, J, windows, L = 12, 3, 4, 6
    references = np.array([rng.choice(L, J, replace=False) for _ in range(count)], np.uint16)
    references[rng.random((count, J)) < 0.2] = NO_REFERENCE
    weights = rng.integers(1, 256, (count, J)).astype(np.uint8)
    weights[references == NO_REFERENCE] = 0
    boxes = rng.integers(0, 20, (count, J, windows)).astype(np.uint8)
    boxes[rng.random(boxes.shape) < 0.1] = NO_BOX
    table = expected_votes.overlaps((5, 4), 3, 2)
    lists = build_lists(references, weights, boxes, L, BLOCK)
    index = CodeIndex(lists, table, pairing)  # pyrefly: ignore[bad-argument-type]
    query = Place(references[0], weights[0], boxes[0])
    unit = weights / np.maximum(np.linalg.norm(weights.astype(float), axis=1, keepdims=True), 1)
    scores = index.scores(query, stop)
    assert len(scores) == min(stop, count)
    for m in range(len(scores)):
        total = np.zeros(3)
        for j in range(J):
            for k in range(J):
                if references[0, j] == references[m, k] != NO_REFERENCE:
                    cells = table[boxes[0, j][:, None], boxes[m, k][None]] / 6
                    best, same = cells.max(axis=1).mean(), np.diag(cells).mean()
                    right, left = (cells[0, 1] + cells[2, 3]) / 4, (cells[1, 0] + cells[3, 2]) / 4
                    both = (best + np.array([same, 1.2 * right, 1.2 * left])) / 2
                    total += unit[0, j] * unit[m, k] * {"best": best, "same": same, "both": both}[pairing]
        assert scores[m] == pytest.approx(total.max(), abs=1e-6)
    ranking = index.query(query, 5, stop)
    order = np.lexsort((np.arange(len(scores)), -scores))
    order = order[scores[order] > 0][:5]
    np.testing.assert_array_equal(ranking.rows, order)


@pytest.mark.parametrize("wrong", [{"columns": 60}, {"box_columns": 17}, {"pairing": "worst"}, {"references": 0}])
def test_settings_that_fit_no_byte_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(ValueError, match=r"(?i)byte|larger|most|input should"):
        BobbSettings(**wrong)
