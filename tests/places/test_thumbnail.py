"""SeqSLAM's images: patch by patch of mean zero and deviation one, compared by absolute differences."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np

from tests.places.pictures import nothing
from vplog.data import THUMBNAIL_SIDE
from vplog.execution.execution import Execution
from vplog.places.thumbnail import ThumbnailSettings

if TYPE_CHECKING:
    from vplog.data import Reference

SETTINGS = ThumbnailSettings()


def test_patches_have_mean_zero_and_deviation_one(references: list[Reference]) -> None:
    state = SETTINGS.learn(references[:1], Execution())
    image = state.describe(references[0].features)
    assert image.dtype == np.uint8
    assert state.bits == 8 * image.size
    patches = (image.reshape(4, 8, 8, 8).astype(float) - 128) / 32
    np.testing.assert_allclose(patches.mean(axis=(1, 3)), 0, atol=0.02)
    np.testing.assert_allclose(patches.std(axis=(1, 3)), 1, atol=0.05)


def test_light_and_contrast_do_not_matter_but_flat_patches_stay_flat(references: list[Reference]) -> None:
    state = SETTINGS.learn(references[:1], Execution())
    rough = np.kron(np.random.default_rng(0).integers(0, 60, (32, 64)) * 2, np.ones((4, 2))).astype(np.uint8)
    darker = (rough // 2 + 100).astype(np.uint8)
    a, b = (state.describe(replace(nothing(), thumbnail=image)) for image in (rough, darker))
    np.testing.assert_array_equal(a, b)
    flat = np.full((THUMBNAIL_SIDE, THUMBNAIL_SIDE), 77, np.uint8)
    assert np.all(state.describe(replace(nothing(), thumbnail=flat)) == 128)


def test_scores_fall_with_the_sum_of_absolute_differences(references: list[Reference]) -> None:
    state = SETTINGS.learn(references, Execution())
    places = [state.describe(r.features) for r in references]
    apart = np.abs(np.array(places, float) - places[2].astype(float)).sum(axis=1)
    np.testing.assert_allclose(state.index(places).scores(places[2]), 1 - apart / (255 * 2048), atol=1e-6)
