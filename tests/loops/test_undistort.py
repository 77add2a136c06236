from __future__ import annotations

from dataclasses import replace

import cv2
import numpy as np
import pytest

from tests.loops.scene import camera
from vplog.errors import LogError
from vplog.loops import undistort

LENSES = [
    ("none", []),
    ("plumb_bob", [0.0] * 5),
    ("plumb_bob", [-0.28, 0.09, 1e-3, -5e-4]),
    ("plumb_bob", [-0.37, 0.2, 2e-4, 3e-4, -0.05]),
    ("rational_polynomial", [0.9, 0.3, 1e-4, -2e-4, 0.02, 1.25, 0.5, 0.08]),
    ("equidistant", [-0.013, 0.02, -0.012, 0.0026]),
    ("equidistant", []),
]


@pytest.mark.parametrize(("model", "distortion"), LENSES)
def test_pixels_to_rays_and_back(model: str, distortion: list[float]) -> None:
    lens = camera(model, distortion)
    grid = np.stack(np.meshgrid(np.linspace(0, 639, 17), np.linspace(0, 479, 13)), axis=-1).reshape(-1, 2)
    rays = undistort.rays(lens, grid)
    good = np.isfinite(rays).all(axis=1)
    assert good.mean() > 0.9
    depth = np.random.default_rng(0).uniform(0.5, 50, (len(grid), 1))
    back = undistort.project(lens, np.column_stack([rays, np.ones(len(rays))])[good] * depth[good])
    np.testing.assert_allclose(back, grid[good], atol=1e-5)


@pytest.mark.parametrize(("model", "distortion"), LENSES)
def test_points_to_pixels_and_back(model: str, distortion: list[float]) -> None:
    lens = camera(model, distortion)
    rays = np.random.default_rng(1).uniform(-0.45, 0.45, (200, 2))
    pixels = undistort.project(lens, np.column_stack([rays, np.ones(len(rays))]))
    np.testing.assert_allclose(undistort.rays(lens, pixels), rays, atol=1e-8)


@pytest.mark.parametrize(("model", "distortion"), LENSES)
def test_agrees_with_opencv_run_to_its_end_and_with_the_formula(model: str, distortion: list[float]) -> None:
    lens = camera(model, distortion)
    assert lens.matrix is not None
    grid = np.stack(np.meshgrid(np.linspace(40, 600, 16), np.linspace(40, 440, 12)), axis=-1).reshape(-1, 1, 2)
    found = undistort.rays(lens, grid[:, 0])
    end = (cv2.TERM_CRITERIA_COUNT | cv2.TERM_CRITERIA_EPS, 200, 1e-12)
    coefficients = np.array(distortion or [0.0] * 4)
    if model == "equidistant":
        expected = cv2.fisheye.undistortPoints(grid, lens.matrix, coefficients, criteria=end)
    else:
        expected = cv2.undistortPoints(grid, lens.matrix, coefficients, criteria=end)
    np.testing.assert_allclose(found, expected[:, 0], atol=1e-7)
    x, y = found.T
    r2 = x**2 + y**2
    if model == "equidistant":  # Kannala & Brandt 2006
        k, r = np.array([*distortion, 0, 0, 0, 0])[:4], np.sqrt(r2)
        angle = np.arctan(r)
        bent = angle * (1 + k[0] * angle**2 + k[1] * angle**4 + k[2] * angle**6 + k[3] * angle**8) / r
        seen = np.column_stack([x * bent, y * bent])
    else:  # Brown 1966, with the divisor of OpenCV's rational model
        k = np.array([*distortion, *[0.0] * 8])[:8]
        bent = (1 + k[0] * r2 + k[1] * r2**2 + k[4] * r2**3) / (1 + k[5] * r2 + k[6] * r2**2 + k[7] * r2**3)
        across = 2 * x * y
        seen = np.column_stack(
            [
                x * bent + k[2] * across + k[3] * (r2 + 2 * x**2),
                y * bent + k[2] * (r2 + 2 * y**2) + k[3] * across,
            ]
        )
    np.testing.assert_allclose(seen * [500.0, 510.0] + [320.0, 240.0], grid[:, 0], atol=1e-5)


@pytest.mark.parametrize(("model", "distortion"), LENSES)
def test_derivatives_are_central_differences_and_noise_follows_from_them(model: str, distortion: list[float]) -> None:
    lens, at, step = camera(model, distortion), np.random.default_rng(2).uniform(-0.4, 0.4, (20, 2)), 1e-4

    def project(rays: np.ndarray) -> np.ndarray:
        return undistort.project(lens, np.column_stack([rays, np.ones(len(rays))]))

    along = [(project(at + step * axis) - project(at - step * axis)) / (2 * step) for axis in np.eye(2)]
    J = undistort.px_from_ray(lens, at)
    np.testing.assert_allclose(J, np.stack(along, axis=2), rtol=1e-4, atol=0.01)
    expected = 0.25 * np.linalg.inv(np.swapaxes(J, 1, 2) @ J)
    np.testing.assert_allclose(undistort.noise_of_rays(lens, at, 0.5), expected, rtol=1e-9, atol=1e-15)
    assert lens.matrix is not None
    assert undistort.focal_px(lens) ** 2 == pytest.approx(lens.matrix[0, 0] * lens.matrix[1, 1])


def test_a_fisheye_without_coefficients_is_not_a_pinhole() -> None:
    point = np.array([[1.0, 0.0, 1.0]])
    assert undistort.project(camera("equidistant"), point)[0, 0] == pytest.approx(320 + 500 * np.pi / 4)


def test_where_the_lens_has_no_inverse_there_is_no_ray() -> None:
    lens = camera("plumb_bob", [-0.6, 0.0, 0.0, 0.0])  # r (1 - 0.6 r^2) never exceeds 0.497
    found = undistort.rays(lens, np.array([[320.0, 240.0], [320.0 + 500 * 0.6, 240.0]]))
    assert np.isfinite(found[0]).all()
    assert np.isnan(found[1]).all()


def test_beyond_the_fold_of_a_polynomial_there_is_no_ray() -> None:
    lens = camera("plumb_bob", [-0.35, 0.0, 0.0, 0.0])
    px = np.stack(np.meshgrid(np.arange(-400.0, 1040.0, 20.0), np.arange(-400.0, 880.0, 20.0)), axis=-1).reshape(-1, 2)
    found = undistort.rays(lens, px)
    radius = np.linalg.norm(found, axis=1)
    assert np.nanmax(radius) < (3 * 0.35) ** -0.5  # where r (1 - 0.35 r^2) is largest
    known = np.isfinite(radius) & (radius > 0)
    assert ((found * (px - px[radius == 0])).sum(axis=1)[known] > 0).all()
    assert known.mean() > 0.1


def test_nothing_in_nothing_out() -> None:
    assert undistort.rays(camera("equidistant"), np.empty((0, 2))).shape == (0, 2)
    assert undistort.project(camera(), np.empty((0, 3))).shape == (0, 2)


def test_points_behind_have_no_pixel() -> None:
    assert np.isnan(undistort.project(camera(), np.array([[0.0, 0.0, -1.0], [0.0, 0.0, 0.0]]))).all()


def test_unknown_lenses_are_named() -> None:
    with pytest.raises(LogError, match=r"'fov'.*plumb_bob"):
        undistort.rays(replace(camera(), distortion_model="fov"), np.zeros((1, 2)))
    with pytest.raises(LogError, match="no matrix"):
        undistort.focal_px(camera(calibrated=False))
