"""GIST: filters that see their own frequency and direction, and not the light."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.places.pictures import nothing
from vplog.data import THUMBNAIL_SIDE, Features
from vplog.execution.execution import Execution
from vplog.places.gist import GistSettings, gabor_filters

if TYPE_CHECKING:
    from vplog.data import Reference

SETTINGS = GistSettings()


def _of(image: np.ndarray) -> Features:
    return replace(nothing(), thumbnail=np.clip(image, 0, 255).astype(np.uint8))


@pytest.mark.parametrize("orientation", [0, 3, 6])
@pytest.mark.parametrize("scale", [0, 1, 2])
def test_a_grating_is_seen_by_the_filter_of_its_scale_and_direction(
    references: list[Reference], scale: int, orientation: int
) -> None:
    state = SETTINGS.learn(references[:1], Execution())
    frequency, angle = 0.3 / 1.85**scale, -np.pi * orientation / 8  # filters turn against the image's y, which is down
    y, x = np.mgrid[:THUMBNAIL_SIDE, :THUMBNAIL_SIDE]
    grating = 128 + 60 * np.cos(2 * np.pi * frequency * (x * np.cos(angle) + y * np.sin(angle)))
    energy = state.describe(_of(grating)).astype(np.float64).reshape(4, 8, 16).mean(axis=2)
    assert np.unravel_index(energy.argmax(), energy.shape) == (scale, orientation)


def test_texture_in_one_corner_is_seen_in_its_block(references: list[Reference]) -> None:
    image = np.full((THUMBNAIL_SIDE, THUMBNAIL_SIDE), 100.0)
    image[:32, 96:] += np.random.default_rng(0).normal(0, 30, (32, 32))
    energy = SETTINGS.learn(references[:1], Execution()).describe(_of(image)).astype(np.float64).reshape(4, 8, 4, 4)
    assert np.all(energy.argmax(axis=3)[0][:, 0] == 3)
    assert energy[0, :, 0, 3].min() > 3 * energy[0, :, 3, 0].max()


def test_light_matters_little(references: list[Reference]) -> None:
    state = SETTINGS.learn(references[:1], Execution())
    image = references[0].features.thumbnail
    assert image is not None
    index = state.index([state.describe(_of(image * 0.5)), state.describe(references[9].features)])
    same, other = index.scores(state.describe(_of(image.astype(float))))
    assert same > other + 0.1


def test_filters_pass_no_constant_and_cover_a_half_plane() -> None:
    filters = gabor_filters(192, 4, 8)
    assert filters.shape == (32, 192, 192)
    assert filters[:, 0, 0].max() < 0.05
    assert filters.max() == pytest.approx(1, abs=0.01)


def test_scores_fall_with_the_distance(references: list[Reference]) -> None:
    state = SETTINGS.learn(references, Execution())
    places = [state.describe(r.features) for r in references]
    matrix = np.array(places, np.float64)
    expected = 1 / (1 + np.linalg.norm(matrix - matrix[2], axis=1))
    np.testing.assert_allclose(state.index(places).scores(places[2]), expected, rtol=1e-6)
    assert state.bits == 512 * 16
