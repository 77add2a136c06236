"""Patches against a slow description of the same in NumPy, and what light must not change."""

from __future__ import annotations

import numpy as np
import pytest

from vplog.places.patches import CELL, CELLS, DIRECTIONS, describe_patches

SIDE = 64


def scene(seed: int) -> np.ndarray:
    rng = np.random.default_rng(seed)
    coarse = rng.uniform(40, 200, (10, 10))
    return np.kron(coarse, np.ones((7, 7)))[:SIDE, :SIDE].astype(np.uint8)


def slow_edges(image: np.ndarray) -> np.ndarray:
    """(n, n, directions): triangular windows, by matrices."""
    padded = np.pad(np.sqrt(image.astype(float)), 1, mode="reflect")
    smooth, step = np.array([1.0, 2.0, 1.0]), np.array([-1.0, 0.0, 1.0])

    def filtered(down: np.ndarray, across: np.ndarray) -> np.ndarray:
        kernel = np.outer(down, across)
        windows = np.lib.stride_tricks.sliding_window_view(padded, (3, 3))
        return np.einsum("yxij,ij->yx", windows, kernel)

    gx, gy = filtered(smooth, step), filtered(step, smooth)
    turn = (np.arctan2(gy, gx) % np.pi) / np.pi * DIRECTIONS
    apart = np.abs(turn[..., None] - np.arange(DIRECTIONS))
    by_direction = np.maximum(1 - np.minimum(apart, DIRECTIONS - apart), 0) * np.hypot(gx, gy)[..., None]
    middle = (np.arange(SIDE // CELL) + 0.5) * CELL
    near = np.maximum(1 - np.abs(np.arange(SIDE) + 0.5 - middle[:, None]) / CELL, 0)
    return np.einsum("iy,yxd,jx->ijd", near, by_direction, near)


@pytest.mark.parametrize("seed", range(4))
def test_patches_are_those_of_the_definition(seed: int) -> None:
    image = scene(seed)
    edges = slow_edges(image)
    along = SIDE // CELL - CELLS + 1
    values, points = describe_patches(image)
    assert values.shape == (along**2, 128)
    assert values.dtype == points.dtype == np.float32
    for row, (value, point) in enumerate(zip(values, points, strict=True)):
        i, j = divmod(row, along)
        np.testing.assert_allclose(point * SIDE, [(j + CELLS / 2) * CELL, (i + CELLS / 2) * CELL], rtol=1e-6)
        part = edges[i : i + CELLS, j : j + CELLS].ravel()
        part = np.minimum(part / np.linalg.norm(part), 0.2)
        expected = np.minimum(np.rint(np.sqrt(part / part.sum()) * 512), 255)
        assert np.abs(value - expected).max() <= 1  # a rounding may fall to the other side


@pytest.mark.parametrize("level", [0, 77, 255])
def test_an_even_image_has_no_patches(level: int) -> None:
    values, points = describe_patches(np.full((128, 128), level, np.uint8))
    assert values.shape == (0, 128)
    assert points.shape == (0, 2)


def test_dimmer_light_changes_little_and_another_scene_much() -> None:
    image = scene(1)
    bright = describe_patches(image)[0]
    dim = describe_patches((image * 0.4).astype(np.uint8))[0]
    other = describe_patches(scene(2))[0]
    assert np.linalg.norm(bright - dim, axis=1).mean() < 0.1 * np.linalg.norm(bright - other, axis=1).mean()


def test_an_edge_and_its_negative_are_alike() -> None:
    edge = np.full((SIDE, SIDE), 60, np.uint8)
    edge[:, SIDE // 2 :] = 180
    there, negative = describe_patches(edge)[0], describe_patches((240 - edge).astype(np.uint8))[0]
    np.testing.assert_array_equal(there, negative)
