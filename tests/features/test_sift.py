"""SIFT features: where they are, in which order, and how deep."""

from __future__ import annotations

from typing import Any

import cv2
import numpy as np
import pytest

from vplog.errors import SettingsError
from vplog.features.sift import SiftSettings

pytestmark = pytest.mark.usefixtures("computed_anew")


def texture(seed: int, width: int = 320, height: int = 200) -> np.ndarray:
    rng = np.random.default_rng(seed)
    total = np.zeros((height, width))
    for octave in range(6):
        rough = rng.standard_normal((max(height >> octave, 4), max(width >> octave, 4)))
        total += cv2.resize(rough, (width, height), interpolation=cv2.INTER_CUBIC) * 1.6**octave
    return np.clip(127 + total * 45 / total.std(), 0, 255).astype(np.uint8)


def blob(width: int, height: int, x: float, y: float, sigma: float) -> np.ndarray:
    """A bright spot whose middle is x, y; the top-left pixel's centre is 0, 0."""
    columns, rows = np.meshgrid(np.arange(width), np.arange(height))
    return np.rint(40 + 200 * np.exp(-((columns - x) ** 2 + (rows - y) ** 2) / (2 * sigma**2))).astype(np.uint8)


@pytest.mark.parametrize(("x", "y"), [(100.0, 60.0), (101.0, 57.0), (40.5, 80.25), (30.2, 31.7)])
@pytest.mark.parametrize(("sigma", "doubled"), [(2.0, True), (4.0, True), (4.0, False)])
def test_a_blob_is_found_at_its_middle(x: float, y: float, sigma: float, doubled: bool) -> None:
    points = SiftSettings(doubled=doubled)(blob(160, 120, x, y, sigma)).points
    np.testing.assert_allclose(points[0], [x, y], atol=0.1)


@pytest.mark.parametrize(("width", "height"), [(320, 240), (321, 241), (323, 243)])
@pytest.mark.parametrize(("x", "y"), [(60.0, 50.0), (61.0, 181.0), (280.5, 200.25)])
@pytest.mark.parametrize("halvings", [1, 2])
def test_reduced_images_keep_full_coordinates(width: int, height: int, x: float, y: float, halvings: int) -> None:
    image = blob(width, height, x, y, 10.0)
    features = SiftSettings(max_megapixels=image.size / 4**halvings * 1e-6, min_features=0)(image)
    np.testing.assert_allclose(features.points[0], [x, y], atol=0.3)
    assert (features.width, features.height) == (width, height)
    whole = SiftSettings(min_features=0)(image)
    assert features.sizes[0] == pytest.approx(whole.sizes[0], rel=0.1)


def test_strongest_first_and_no_more_than_asked_for() -> None:
    image = texture(1)
    many, few = (SiftSettings(max_features=most, min_features=0)(image) for most in (300, 40))
    assert len(few) == 40
    assert 40 < len(many) <= 300
    np.testing.assert_array_equal(few.points, many.points[:40])
    np.testing.assert_array_equal(few.descriptors, many.descriptors[:40])
    assert (many.points.dtype, many.descriptors.dtype) == (np.float32, np.uint8)
    assert many.descriptors.shape == (len(many), 128)
    assert many.sizes.shape == many.depth_m.shape == (len(many),)
    assert (many.points >= 0).all()
    assert (many.points <= [319, 199]).all()
    # a copy of lower contrast has weaker features: those of the bright half of the picture come first
    halves = np.concatenate([image, (image.astype(int) // 3 + 80).astype(np.uint8)], axis=1)
    points = SiftSettings(max_features=2000, contrast_threshold=0.01)(halves).points
    rank = np.arange(len(points))
    assert np.median(rank[points[:, 0] < 300]) < np.median(rank[points[:, 0] > 340])


def test_the_same_image_gives_the_same_bytes() -> None:
    image = texture(2)
    threads = cv2.getNumThreads()
    try:
        results = []
        for count in (1, 4):
            cv2.setNumThreads(count)
            results.append(SiftSettings()(image))
    finally:
        cv2.setNumThreads(threads)
    for name in ("points", "sizes", "descriptors"):
        assert getattr(results[0], name).tobytes() == getattr(results[1], name).tobytes()


@pytest.mark.parametrize("shape", [(200, 320), (1, 1), (1, 50), (50, 1), (3, 3)])
def test_flat_and_tiny_images_have_no_features(shape: tuple[int, int]) -> None:
    features = SiftSettings()(np.full(shape, 128, np.uint8), np.ones(shape, np.float32))
    assert len(features) == 0
    assert features.points.shape == (0, 2)
    assert features.descriptors.shape == (0, 128)
    assert (features.height, features.width) == shape


def test_depth_is_that_of_the_pixel_under_the_point() -> None:
    image = texture(3)
    depth = np.random.default_rng(0).uniform(1, 50, image.shape).astype(np.float32)
    depth[:, :100] = np.nan
    features = SiftSettings()(image, depth)
    columns, rows = np.floor(features.points + 0.5).astype(int).T
    np.testing.assert_array_equal(features.depth_m, depth[rows, columns])
    assert np.isnan(features.depth_m).any()
    assert np.isfinite(features.depth_m).any()
    assert np.isnan(SiftSettings()(image).depth_m).all()


@pytest.mark.parametrize("change", [{"max_features": 0}, {"max_megapixels": 0.0}, {"contrast_threshold": -1.0}])
def test_settings_that_cannot_work(change: dict[str, Any]) -> None:
    with pytest.raises(SettingsError):
        SiftSettings.read(change, "test")


@pytest.mark.parametrize("sigma", [2.5, 4.0, 7.0])
def test_a_blob_is_as_large_as_it_is(sigma: float) -> None:
    """A Gaussian blob of blur s is strongest at scale s (Lindeberg 1998); its size is the diameter."""
    features = SiftSettings(doubled=False, min_features=0)(blob(200, 160, 99.3, 80.6, sigma))
    np.testing.assert_allclose(features.points[0], [99.3, 80.6], atol=0.1)
    assert features.sizes[0] / 2 == pytest.approx(sigma, rel=0.15)


def test_an_edge_is_no_feature() -> None:
    image = np.full((120, 160), 40, np.uint8)
    image[:, 80:] = 200
    assert len(SiftSettings(doubled=False)(image)) == 0


def test_features_are_found_again_in_a_turned_and_larger_picture() -> None:
    """Most of the strong ones, in their places, with descriptors nearest to their own."""
    image = texture(5, 480, 360)
    turn = cv2.getRotationMatrix2D((240, 180), 30.0, 1.25)
    settings = SiftSettings(max_features=300, doubled=False)
    a, b = settings(image), settings(cv2.warpAffine(image, turn, (480, 360)).astype(np.uint8))
    expected = a.points @ turn[:, :2].T + turn[:, 2]
    inside = ((expected > 40) & (expected < [440, 320])).all(axis=1)
    distance = np.square(a.descriptors[:, None].astype(np.int64) - b.descriptors[None].astype(np.int64)).sum(axis=2)
    nearest = distance.argmin(axis=1)
    right = np.linalg.norm(expected - b.points[nearest], axis=1) < 3.0
    assert inside.sum() > 60
    assert right[inside].mean() > 0.5
    grown = b.sizes[nearest][inside & right] / a.sizes[inside & right]
    assert np.median(grown) == pytest.approx(1.25, rel=0.05)


def test_doubling_finds_smaller_features() -> None:
    image = cv2.resize(texture(7, 640, 400), (160, 100), interpolation=cv2.INTER_AREA).astype(np.uint8)
    plain, doubled = (SiftSettings(doubled=both, min_features=0)(image) for both in (False, True))
    assert len(doubled) > 2 * len(plain)
    assert doubled.sizes.min() < 2.0
    assert plain.sizes.min() > 2.8
    offset = np.linalg.norm(plain.points[:20, None] - doubled.points[None], axis=2).min(axis=1)
    assert np.median(offset) < 0.3


POOR = {
    "dark": lambda image, rng: image * 0.05 + rng.normal(0, 0.5, image.shape),
    "flat": lambda image, rng: 127 + (image - 127.0) * 0.06 + rng.normal(0, 0.4, image.shape),
    "small": lambda image, _: cv2.resize(image, (128, 80), interpolation=cv2.INTER_AREA),
}


@pytest.mark.parametrize("kind", POOR)
def test_poor_pictures_give_the_features_of_good_ones(kind: str) -> None:
    image = texture(3)
    poor = np.clip(np.rint(POOR[kind](image, np.random.default_rng(1))), 0, 255).astype(np.uint8)
    bare, found = SiftSettings(min_features=0)(poor), SiftSettings()(poor)
    assert len(found) > max(2 * len(bare), 150)
    good = SiftSettings(doubled=True)(image)  # poor ones are doubled before anything else
    points = found.points * (image.shape[1] / poor.shape[1])
    off = np.linalg.norm(points[:, None] - good.points[None], axis=2).min(axis=1)
    assert np.median(off) < 2.0  # where those of the good picture are, not of the noise
    assert (found.width, found.height) == poor.shape[::-1]


@pytest.mark.parametrize("doubled", [True, False])
def test_a_good_picture_is_taken_as_it_is(doubled: bool) -> None:
    image = texture(5, 640, 400)
    good = SiftSettings(doubled=doubled)
    assert len(good(image)) > good.least_features
    same = SiftSettings(doubled=doubled, min_features=0)
    assert good(image).descriptors.tobytes() == same(image).descriptors.tobytes()


def test_a_picture_with_few_features_is_doubled_and_no_other() -> None:
    image = texture(7, 640, 400)
    few = cv2.resize(image, (160, 100), interpolation=cv2.INTER_AREA).astype(np.uint8)
    for picture, doubled in ((image, False), (few, True)):
        found = SiftSettings(min_features=250)(picture)
        same = SiftSettings(doubled=doubled, min_features=0)(picture)
        assert found.descriptors.tobytes() == same.descriptors.tobytes()


def test_no_features_are_made_of_noise() -> None:
    dark = np.random.default_rng(2).integers(0, 2, (200, 320)).astype(np.uint8)
    assert len(SiftSettings()(dark)) == len(SiftSettings()(0 * dark)) == 0
