"""Gaussian levels, their extrema, and descriptors of what is around them."""

from __future__ import annotations

import cv2
import numpy as np
import pytest

from vplog.features import scale_space
from vplog.features.sift import SiftSettings

from .test_sift import blob, texture


@pytest.mark.parametrize("shape", [(40, 60), (7, 5), (1, 9), (9, 1), (2, 2)])
def test_a_blur_is_that_of_opencv(shape: tuple[int, int]) -> None:
    image = np.random.default_rng(0).uniform(0, 255, shape).astype(np.float32)
    kernel = scale_space._kernel(1.5)
    blurred, difference = np.empty_like(image), np.empty_like(image)
    scale_space.blur_into(image, blurred, difference, kernel)
    if min(shape) > len(kernel):  # smaller ones OpenCV mirrors again and again
        whole = np.concatenate([kernel[:0:-1], kernel])
        expected = cv2.sepFilter2D(image, -1, whole, whole, borderType=cv2.BORDER_REFLECT_101)
        np.testing.assert_allclose(blurred, expected, atol=1e-3)
    assert blurred.min() >= image.min() - 1e-3
    assert blurred.max() <= image.max() + 1e-3
    np.testing.assert_array_equal(difference, blurred - image)


def test_octaves_halve_and_levels_get_more_blurred() -> None:
    image = texture(4).astype(np.float32)
    found = list(scale_space.octaves(image, 0.5))
    assert [levels.shape[1:] for levels, _ in found] == [(200, 320), (100, 160), (50, 80), (25, 40)]
    for levels, differences in found:
        np.testing.assert_array_equal(differences, np.diff(levels, axis=0))
        assert (np.diff([np.abs(np.diff(level)).mean() for level in levels]) < 0).all()


@pytest.mark.parametrize("sigma", [2.5, 4.0, 7.0])
def test_a_blob_is_as_large_as_it_is(sigma: float) -> None:
    """A Gaussian blob of blur s is strongest at scale s (Lindeberg 1998); its size is the diameter."""
    features = SiftSettings(doubled=False)(blob(200, 160, 99.3, 80.6, sigma))
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


def test_descriptors_are_nearly_opencvs() -> None:
    """Libraries of either work with the other: most of OpenCV's features have one of ours, described alike."""
    image = texture(6, 480, 360)
    ours = SiftSettings(doubled=False)(image)
    keypoints, theirs = cv2.SIFT.create(contrastThreshold=0.02, enable_precise_upscale=True).detectAndCompute(
        image, None
    )
    large = np.array([point.size > 3.6 for point in keypoints])  # without those of the doubled image
    points = np.array([point.pt for point in keypoints])[large]
    theirs = theirs[large].astype(np.int64)
    apart = np.linalg.norm(points[:, None] - ours.points[None], axis=2)
    difference = np.square(theirs[:, None] - ours.descriptors[None].astype(np.int64)).sum(axis=2)
    near = np.where(apart < 1.0, difference, np.iinfo(np.int64).max).min(axis=1)
    others = np.where(apart > 10.0, difference, np.iinfo(np.int64).max).min(axis=1)
    found = near < np.iinfo(np.int64).max
    assert len(points) > 100
    assert found.mean() > 0.6
    assert (near[found] < others[found]).mean() > 0.8
    length = np.linalg.norm(ours.descriptors.astype(float), axis=1)
    assert np.median(np.abs(length - 512)) < 2


def test_doubling_finds_smaller_features() -> None:
    image = cv2.resize(texture(7, 640, 400), (160, 100), interpolation=cv2.INTER_AREA).astype(np.uint8)
    plain, doubled = SiftSettings(doubled=False)(image), SiftSettings()(image)
    assert len(doubled) > 2 * len(plain)
    assert doubled.sizes.min() < 2.0
    assert plain.sizes.min() > 2.8
    offset = np.linalg.norm(plain.points[:20, None] - doubled.points[None], axis=2).min(axis=1)
    assert np.median(offset) < 0.3
