"""What is masked gives no features and no edges; what is not stays as it is."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from vplog.data import Camera, Frame
from vplog.features.extraction import describe
from vplog.features.sift import SiftSettings, thumbnail_of_image
from vplog.geometry.masking import filled, masked
from vplog.places.patches import describe_patches

if TYPE_CHECKING:
    from vplog.data import Bools, Bytes


def textured(height: int, width: int, rng: np.random.Generator) -> Bytes:
    coarse = rng.integers(0, 256, (height // 4 + 1, width // 4 + 1))
    return np.kron(coarse, np.ones((4, 4)))[:height, :width].astype(np.uint8)


def drawn_mask(height: int, width: int, rng: np.random.Generator) -> Bools:
    """A bonnet, a circle, or scattered px."""
    rows, columns = np.mgrid[:height, :width]
    return [
        rows < 0.7 * height + 0.1 * height * (columns / width - 0.5) ** 2,
        (rows - height / 2) ** 2 + (columns - width / 3) ** 2 > (height / 5) ** 2,
        rng.random((height, width)) > 0.3,
    ][rng.integers(3)]


def frame(image: Bytes, mask: Bools | None) -> Frame:
    camera = Camera("cam", None, "none", np.zeros(0), image.shape[1], image.shape[0], np.eye(4))
    return Frame(0, camera, image, mask=mask)


@pytest.mark.parametrize("seed", range(12))
def test_fill_changes_masked_px_alone_and_keeps_the_border_smooth(seed: int) -> None:
    rng = np.random.default_rng(seed)
    height, width = rng.integers(20, 200, 2)
    used, image = drawn_mask(height, width, rng), textured(height, width, rng)
    colour = np.dstack([image, image // 2, 255 - image])
    result = filled(image, used)
    assert (result[used] == image[used]).all()
    assert (filled(colour, used)[used] == colour[used]).all()
    assert (filled(colour, used)[..., 0] == result).all()
    other = np.where(used, image, rng.integers(0, 256, image.shape)).astype(np.uint8)
    assert (filled(other, used) == result).all()  # nothing of what was masked is left


def test_the_fill_goes_from_the_border_to_the_mean() -> None:
    image, used = np.full((100, 600), 100, np.uint8), np.ones((100, 600), bool)
    image[:, 200:300], used[:, 300:] = 220, False
    row = filled(image, used)[50, 299:].astype(int)
    assert row[0] == 220
    assert row[1] > 210
    assert (np.diff(row) <= 0).all()
    assert (np.diff(row) >= -20).all()
    assert row[-1] == 140


def test_no_feature_is_masked_and_the_others_are_as_many_as_without() -> None:
    image, used = textured(240, 320, np.random.default_rng(4)), np.ones((240, 320), bool)
    used[140:] = False
    free = SiftSettings(max_features=400)(image)
    found = describe(SiftSettings(max_features=400), frame(image, used))
    assert (free.points[:, 1] > 145).sum() > 80
    assert (np.rint(found.points[:, 1]) < 140).all()
    assert len(found) > 350  # the share of the masked part goes to the rest
    assert found.thumbnail is not None
    _, middles = describe_patches(found.thumbnail)
    assert len(middles)
    assert (middles[:, 1] < 0.87).all()
    assert (describe_patches(thumbnail_of_image(image))[1][:, 1] > 0.87).any()


def test_without_a_mask_all_stays() -> None:
    one = frame(textured(60, 80, np.random.default_rng(4)), None)
    assert masked(one) is one
    assert describe(SiftSettings(), one).points.tobytes() == SiftSettings()(one.image).points.tobytes()
