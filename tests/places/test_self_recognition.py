"""How a library's images recognise each other, and what follows for its size and for patches."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.places.pictures import nothing, reference
from vplog.data import Features, Reference
from vplog.execution.execution import Execution
from vplog.places.bobb import BobbSettings
from vplog.places.matches import PATCH_WEIGHT
from vplog.places.reference_choice import LibrarySettings, choose
from vplog.places.self_recognition import (
    MOST,
    NO_IMAGE,
    add_until_enough,
    further,
    neighbours,
    patches_mislead,
    recognised,
    recognised_share,
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
    assert recognised(votes, near).tolist() == [True, False, False, False, False, False]


@pytest.mark.parametrize("seed", range(5))
def test_patches_of_equal_storeys_mislead_and_others_do_not(seed: int) -> None:
    """Two storeys whose thumbnails are equal place by place: keypoints tell them apart, patches cannot."""
    rng = np.random.default_rng(seed)
    keypoints = _walk(rng, 24)
    storey = [reference(12 * seed + view).features.thumbnail for view in range(12)]
    equal = [_at(row, replace(one, thumbnail=storey[row % 12])) for row, one in enumerate(keypoints)]
    assert BobbSettings().learn(equal, Execution()).weights().kinds == (1.0, 0.0)
    plain = [_at(row, one) for row, one in enumerate(keypoints)]
    assert BobbSettings().learn(plain, Execution()).weights().kinds == (1.0, PATCH_WEIGHT)
    assert BobbSettings(patch_weight=1.0).learn(equal, Execution()).weights().kinds == (1.0, 1.0), (
        "what was said stands"
    )


def test_one_image_lost_by_chance_does_not_switch_patches_off() -> None:
    count = 40
    references = [_at(stamp) for stamp in range(count)]
    sound = np.eye(count, k=1) + np.eye(count, k=-1)
    wrong = np.zeros((count, count))
    wrong[3, 30] = 5.0
    assert not patches_mislead(sound, wrong, references)
    wrong[np.arange(3, 9), 30] = 5.0
    assert patches_mislead(sound, wrong, references)


def test_a_part_of_a_library_keeps_the_weight_of_patches() -> None:
    rng = np.random.default_rng(3)
    storey = [reference(view).features.thumbnail for view in range(12)]
    state = BobbSettings().learn(
        [_at(row, replace(one, thumbnail=storey[row % 12])) for row, one in enumerate(_walk(rng, 24))], Execution()
    )
    assert state.subset(np.arange(4), Execution()).weights().kinds == state.weights().kinds == (1.0, 0.0)


@pytest.mark.parametrize("seed", range(4))
def test_a_walk_needs_no_more_references_and_places_on_their_own_take_all(seed: int) -> None:
    rng, execution = np.random.default_rng(seed), Execution()
    stamps, wanted = np.arange(90), LibrarySettings(seed=seed)
    first = choose(stamps, wanted)
    alone = [_at(row, _drawn(rng)) for row in range(90)]
    assert recognised_share(alone, execution) < 0.3
    assert add_until_enough(first, stamps, wanted, 90, alone.__getitem__, execution).tolist() == list(range(90))
    bounded = add_until_enough(first, stamps, wanted, 30, alone.__getitem__, execution)
    assert len(bounded) == 30
    assert np.isin(first, bounded).all()
    walk = [_at(row, one) for row, one in enumerate(_walk(rng, 90))]
    found = add_until_enough(np.arange(0, 90, 2), stamps, wanted, 90, walk.__getitem__, execution)
    assert 45 <= len(found) <= 90
    assert add_until_enough(np.arange(90), stamps, wanted, MOST, walk.__getitem__, execution).tolist() == list(
        range(90)
    )
    assert recognised_share(walk, execution) == 1.0


def test_no_features_and_no_frames_ask_for_nothing() -> None:
    empty = [_at(row) for row in range(5)]
    assert recognised_share(empty, Execution()) == 1.0
    none = further(np.arange(3), np.arange(3), LibrarySettings(), 0)
    assert len(none) == 0
