"""How a library's images recognise each other, and what follows for its size and for patches."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.typing import NDArray

from tests.places.pictures import nothing, reference
from vplog.data import Features, Reference
from vplog.errors import LibraryError
from vplog.execution.execution import Execution
from vplog.places.bobb import BobbSettings
from vplog.places.matches import PATCH_WEIGHT
from vplog.places.reference_choice import LibrarySettings, choose
from vplog.places.self_recognition import (
    MOST,
    NO_IMAGE,
    add_until_enough,
    further,
    lacking,
    margin,
    misleading_patches,
    neighbours,
    recognised_shares,
)


def _at(stamp_ns: int, features: Features | None = None, drive: str = "drive") -> Reference:
    return Reference(NO_IMAGE, features or nothing(), drive, stamp_ns)


def _drawn(rng: np.random.Generator, count: int = 60) -> Features:
    """Keypoints that no other image has."""
    points = rng.uniform(0, [320, 200], (count, 2)).astype(np.float32)
    descriptors = rng.integers(0, 120, (count, 128)).astype(np.uint8)
    full = np.full(count, 12, np.float32)
    return Features(points, full, descriptors, np.full(count, np.nan, np.float32), 320, 200)


def _walk(rng: np.random.Generator, length: int) -> list[Features]:
    """Frames of which each shows a third of the one before it."""
    frames = [_drawn(rng)]
    for _ in range(length - 1):
        fresh, old = _drawn(rng), frames[-1]
        shown = np.concatenate([old.descriptors[40:], fresh.descriptors[20:]])
        frames.append(replace(fresh, descriptors=shown, points=np.concatenate([old.points[40:], fresh.points[20:]])))
    return frames


def _patch_weights(references: list[Reference], patch_weight: float | None = None) -> NDArray:
    return BobbSettings(patch_weight=patch_weight).learn(references, Execution()).weights().patches


def test_neighbours_are_of_one_drive_and_near_in_time() -> None:
    references = [_at(0), _at(7, drive="other"), _at(30), _at(10), _at(20), _at(8, drive="other")]
    near = neighbours(references)
    assert (near == near.T).all()
    assert not near.diagonal().any()
    assert near[0].tolist() == [False, False, False, True, True, False], "two stamps on; 30 is the third"
    assert near[1].tolist() == [False] * 5 + [True]


def test_votes_for_itself_and_no_votes_do_not_count() -> None:
    near = neighbours([_at(stamp) for stamp in range(6)])
    votes = np.zeros((6, 6))
    votes[0, [0, 1, 5]] = 9, 2, 1
    votes[1, [4, 2]] = 3, 2
    assert (margin(votes, near) > 0).tolist() == [True, False, False, False, False, False]


@pytest.mark.parametrize("seed", range(5))
def test_patches_of_equal_storeys_mislead_and_others_do_not(seed: int) -> None:
    """Two storeys whose thumbnails are equal place by place: keypoints tell them apart, patches cannot."""
    rng = np.random.default_rng(seed)
    keypoints = _walk(rng, 24)
    storey = [reference(12 * seed + view).features.thumbnail for view in range(12)]
    equal = [_at(row, replace(one, thumbnail=storey[row % 12])) for row, one in enumerate(keypoints)]
    assert _patch_weights(equal).tolist() == [0.0] * 24
    plain = [_at(row, one) for row, one in enumerate(keypoints)]
    assert _patch_weights(plain).tolist() == [PATCH_WEIGHT] * 24
    assert _patch_weights(equal, patch_weight=1.0).tolist() == [1.0] * 24, "what was said stands"


def test_one_image_lost_by_chance_does_not_switch_patches_off() -> None:
    count = 40
    references = [_at(stamp) for stamp in range(count)]
    sound = np.eye(count, k=1) + np.eye(count, k=-1)
    wrong = np.zeros((count, count))
    wrong[3, 30] = 5.0
    assert not misleading_patches(sound, wrong, references).any()
    wrong[np.arange(3, 9), 30] = 5.0
    assert misleading_patches(sound, wrong, references)[:30].all()


def _tower_and_street(seed: int) -> list[Reference]:
    """Two storeys of equal thumbnails, and a drive that has none."""
    rng = np.random.default_rng(seed)
    storey = [reference(view).features.thumbnail for view in range(12)]
    tower = [_at(row, replace(one, thumbnail=storey[row % 12])) for row, one in enumerate(_walk(rng, 24))]
    return [*tower, *(_at(row, one, "street") for row, one in enumerate(_walk(rng, 30)))]


@pytest.mark.parametrize("seed", range(3))
def test_each_drive_of_a_library_decides_on_its_patches_in_any_order(seed: int) -> None:
    references = _tower_and_street(seed)
    order = np.random.default_rng(seed).permutation(len(references))
    weights = _patch_weights([references[row] for row in order.tolist()])
    assert weights.tolist() == np.where(order < 24, 0.0, PATCH_WEIGHT).tolist()


@pytest.mark.parametrize("seed", range(3))
def test_a_drive_of_the_same_way_in_other_light_does_not_switch_patches_off(seed: int) -> None:
    """By night keypoints are others, and patches alone find the place: in a drive of its own that is no mistake."""
    rng, count = np.random.default_rng(seed), 30
    drives = [_at(row, drive=name) for name in ("day", "night") for row in range(count)]
    rng.shuffle(drives)
    row, name = np.array([one.stamp_ns for one in drives]), np.array([one.drive for one in drives])
    one_drive = name[:, None] == name
    keypoints = np.where(one_drive & (np.abs(row[:, None] - row) == 1), rng.uniform(1, 2, (2 * count, 2 * count)), 0.0)
    patches = np.where(~one_drive & (row[:, None] == row), 9.0, 0.0)
    assert not misleading_patches(keypoints, patches, drives).any()
    storeys = [replace(one, drive="one", stamp_ns=one.stamp_ns + 100 * (one.drive == "night")) for one in drives]
    assert misleading_patches(keypoints, patches, storeys).all(), "in one drive they are storeys"


def test_evidence_is_what_counts_on_the_references_that_two_places_share() -> None:
    references = _tower_and_street(1)
    state = BobbSettings().learn(references, Execution())
    storey, next_door, street = (state.describe(references[row].features) for row in (4, 5, 40))
    assert state.evidence(storey, next_door) == "keypoints"
    assert state.evidence(street, street) == "keypoints and patches"
    assert state.evidence(storey, state.describe(nothing())) == ""
    alone = [replace(one, features=one.features.rows(slice(0))) for one in references[:24]]
    patches = BobbSettings(features=0, patch_weight=1.0).learn(alone, Execution())
    place = patches.describe(alone[4].features)
    assert patches.evidence(place, place) == "patches"


def test_places_of_one_log_decide_by_what_is_around_them() -> None:
    count = 300
    references = [_at(stamp) for stamp in range(count)]
    sound = np.eye(count, k=1) + np.eye(count, k=-1)
    patches = 0.5 * sound
    rows = np.arange(100)
    patches[rows, (rows + 50) % 100] = 3.0
    found = misleading_patches(sound, patches, references)
    assert found[:80].all()
    assert not found[150:].any()


def test_a_part_of_a_library_keeps_the_weights_of_patches(tmp_path: Path) -> None:
    image = np.zeros((200, 320), np.uint8)
    state = BobbSettings().learn([replace(one, image=image) for one in _tower_and_street(3)], Execution())
    rows = np.array([1, 3, 25, 26])
    part = state.subset(rows, Execution())
    assert part.weights().patches.tolist() == [0.0, 0.0, PATCH_WEIGHT, PATCH_WEIGHT]
    part.save(tmp_path / "library")
    loaded = BobbSettings().load(tmp_path / "library", Execution())
    assert loaded.weights().patches.tolist() == part.weights().patches.tolist()
    with pytest.raises(LibraryError, match="4 numbers for 2 reference images"):
        part.settings.learn(part.references[:2], Execution())


@pytest.mark.parametrize("seed", range(4))
def test_a_walk_needs_no_more_references_and_places_on_their_own_take_all(seed: int) -> None:
    rng, execution = np.random.default_rng(seed), Execution()
    stamps, wanted = np.arange(90), LibrarySettings(seed=seed)
    first = choose(stamps, wanted)
    alone = [_at(row, _drawn(rng)) for row in range(90)]
    assert recognised_shares(alone, execution)["drive"] < 0.3
    assert add_until_enough(first, stamps, wanted, 90, alone.__getitem__, execution).tolist() == list(range(90))
    bounded = add_until_enough(first, stamps, wanted, 30, alone.__getitem__, execution)
    assert len(bounded) == 30
    assert np.isin(first, bounded).all()
    walk = [_at(row, one) for row, one in enumerate(_walk(rng, 90))]
    found = add_until_enough(np.arange(0, 90, 2), stamps, wanted, 90, walk.__getitem__, execution)
    assert len(found) == 90, "two steps apart nothing of the walk is shared"
    assert add_until_enough(np.arange(90), stamps, wanted, MOST, walk.__getitem__, execution).tolist() == list(
        range(90)
    )
    assert recognised_shares(walk, execution) == {"drive": 1.0}
    both = [*walk, *(replace(one, drive="tower") for one in alone)]
    assert lacking(both, execution) == {"tower"}


def test_no_features_and_no_frames_ask_for_nothing() -> None:
    empty = [_at(row) for row in range(5)]
    assert not lacking(empty, Execution())
    none = further(np.arange(3), np.arange(3), LibrarySettings(), 0)
    assert len(none) == 0
