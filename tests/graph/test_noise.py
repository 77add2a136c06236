from __future__ import annotations

from dataclasses import replace
from itertools import accumulate

import numpy as np
import pytest

from vplog.data import Odometry
from vplog.errors import GraphError
from vplog.geometry import se3
from vplog.graph.noise import NoiseSettings, edge_covariance

T = 101
STAMPS = np.arange(T, dtype=np.int64) * 100_000_000
RANDOM = np.random.default_rng(4)
STEPS = se3.exp(RANDOM.normal(size=(T, 6)) * 0.02 + np.array([0, 0, 0.02, 0.5, 0, 0]))
POSES = np.array(list(accumulate(STEPS, np.matmul)))
SMALL = np.diag([1e-4, 1e-4, 2e-4, 1e-2, 2e-2, 1e-2])  # within the model's best and worst
WIDE = NoiseSettings(best_share=1e-3, worst_share=1e6)


def odometry(covariance: np.ndarray | None) -> Odometry:
    return Odometry(STAMPS, POSES, covariance)


def fluctuating() -> np.ndarray:
    root = RANDOM.normal(size=(T, 6, 6)) * 0.01
    return SMALL + root @ np.swapaxes(root, 1, 2)


@pytest.mark.parametrize(
    "covariance",
    [None, np.zeros((T, 6, 6)), np.full((T, 6, 6), np.nan), np.full((T, 6, 6), np.inf), np.full((T, 6, 6), -1.0)],
    ids=["none", "zero", "nan", "inf", "negative"],
)
def test_unknown_covariance_gives_the_model_and_a_warning(covariance: np.ndarray | None) -> None:
    result, warnings, source = edge_covariance(odometry(covariance), STAMPS[::10], NoiseSettings())
    expected, none, _ = edge_covariance(
        odometry(SMALL + np.zeros((T, 1, 1))), STAMPS[::10], NoiseSettings(source="model")
    )
    assert source == "model"
    assert len(warnings) == 1
    assert none == []
    np.testing.assert_array_equal(result, expected)


def test_model_over_the_whole_drive_is_the_linear_rate() -> None:
    settings = NoiseSettings(floor_m=1e-9, memory_m=1e9)
    result, _, _ = edge_covariance(odometry(None), STAMPS[[0, -1]], settings)
    metres = np.linalg.norm(se3.between(POSES[:-1], POSES[1:])[:, :3, 3], axis=1).sum()
    assert np.sqrt(result[0, 3, 3]) == pytest.approx(settings.drift_per_metre * metres)


def test_increments_are_independent_of_how_the_drive_is_cut() -> None:
    """Two edges in a row, moved to one frame, are as uncertain as one over both; cuts fall between samples too."""
    cut = np.array([STAMPS[5], STAMPS[5] + 33_000_000, STAMPS[31], STAMPS[31] + 250_000_000, STAMPS[60]])
    logged = fluctuating()
    whole, _, source = edge_covariance(odometry(logged), STAMPS[[5, 60]], WIDE)
    parts, _, _ = edge_covariance(odometry(logged), cut, WIDE)
    assert source == "increments"
    poses = se3.interpolate_at(STAMPS, POSES, cut[1:])
    moved = se3.adjoint(se3.between(poses[-1], poses))
    np.testing.assert_allclose((moved @ parts @ np.swapaxes(moved, 1, 2)).sum(0), whole[0], rtol=0.01, atol=1e-6)


def test_increments_agree_with_simulated_errors() -> None:
    random = np.random.default_rng(0)
    logged = np.broadcast_to(SMALL * 0.01, (T, 6, 6))
    expected, _, _ = edge_covariance(odometry(logged), STAMPS[[0, 40]], WIDE)
    noise = se3.exp(random.normal(size=(4000, 40, 6)) * np.sqrt(np.diag(SMALL * 0.01)))
    end = np.broadcast_to(np.eye(4), (4000, 4, 4))
    for k in range(40):
        end = end @ se3.between(POSES[k], POSES[k + 1]) @ noise[:, k]
    error = se3.log(se3.between(se3.between(POSES[0], POSES[40]), end))
    np.testing.assert_allclose(np.cov(error.T), expected[0], atol=0.08 * np.abs(expected).max())


def accumulated(poses: np.ndarray) -> np.ndarray:
    """(T, 6, 6) of the poses since the start, each increment with the noise `SMALL`."""
    result = [1e-9 * np.eye(6)]
    for moved in se3.adjoint(se3.between(poses[1:], poses[:-1])):
        result.append(moved @ result[-1] @ moved.T + SMALL)
    return np.array(result)


@pytest.mark.parametrize("turn", [0.0, 0.1], ids=["away", "in circles"])
def test_growing_covariance_is_taken_apart_into_the_increments(turn: float) -> None:
    """In circles that of the translations grows and shrinks with the distance from the start."""
    poses = np.array(list(accumulate(STEPS @ se3.exp(np.array([[0, 0, turn, 2.0, 0, 0]])), np.matmul)))
    drive = Odometry(STAMPS, poses, accumulated(poses))
    result, _, source = edge_covariance(drive, STAMPS[::10], WIDE)
    increments, _, other = edge_covariance(Odometry(STAMPS, poses, SMALL + np.zeros((T, 1, 1))), STAMPS[::10], WIDE)
    assert (source, other) == ("accumulated", "increments")
    np.testing.assert_allclose(result, increments, rtol=1e-3, atol=1e-6)


def test_axes_without_variance_take_the_model() -> None:
    planar = np.diag([0.0, 1e6, 2e-4, 1e-2, 2e-2, 0.0]) + np.zeros((T, 1, 1))
    result, warnings, _ = edge_covariance(odometry(planar), STAMPS[::10], NoiseSettings())
    model, _, _ = edge_covariance(odometry(None), STAMPS[::10], NoiseSettings())
    np.testing.assert_allclose(result[:, [0, 1, 5], [0, 1, 5]], model[:, [0, 1, 5], [0, 1, 5]])
    assert "roll, pitch, z" in warnings[0]


def test_unusable_samples_give_the_model_to_their_edges_only() -> None:
    logged = fluctuating()
    clean, _, _ = edge_covariance(odometry(logged), STAMPS[::10], WIDE)
    logged[14] = np.nan
    result, warnings, _ = edge_covariance(odometry(logged), STAMPS[::10], WIDE)
    model, _, _ = edge_covariance(odometry(None), STAMPS[::10], WIDE)
    np.testing.assert_allclose(result[1], model[1])
    np.testing.assert_array_equal(np.delete(result, 1, 0), np.delete(clean, 1, 0))
    assert "1 of 101 samples" in warnings[0]


@pytest.mark.parametrize("scale", [1e-12, 1e-6, 1.0, 1e4], ids=str)
def test_every_matrix_is_symmetric_and_within_the_shares_of_the_model(scale: float) -> None:
    settings = NoiseSettings()
    result, _, _ = edge_covariance(odometry(SMALL * scale + np.zeros((T, 1, 1))), STAMPS[::7], settings)
    model, _, _ = edge_covariance(odometry(None), STAMPS[::7], settings)
    np.testing.assert_array_equal(result, np.swapaxes(result, 1, 2))
    sigma = np.sqrt(np.diagonal(model, axis1=1, axis2=2))
    values = np.linalg.eigvalsh(result / sigma[:, :, None] / sigma[:, None, :])
    assert values.min() >= settings.best_share**2 * (1 - 1e-9)
    assert values.max() <= settings.worst_share**2 * (1 + 1e-9)


@pytest.mark.parametrize("part", [slice(0, 3), slice(3, 6)], ids=["heading", "position"])
def test_a_vain_part_is_said_even_beside_a_sound_one(part: slice) -> None:
    covariance = SMALL.copy()
    covariance[part, part] *= 1e-6
    _, sound, _ = edge_covariance(odometry(SMALL + np.zeros((T, 1, 1))), STAMPS[::7], NoiseSettings())
    _, vain, _ = edge_covariance(odometry(covariance + np.zeros((T, 1, 1))), STAMPS[::7], NoiseSettings())
    assert not any("raised" in warning for warning in sound)
    assert any("is implausible" in warning and "raised" in warning for warning in vain)


@pytest.mark.parametrize("rest", [1.0, 1e-4])
def test_constants_of_a_driver_are_bounded_by_the_model(rest: float) -> None:
    """One for motion, and one for each fifth sample, where the robot stands."""
    covariance = 1e4 * SMALL * np.where(np.arange(T) % 5 == 0, rest, 1.0)[:, None, None]
    result, warnings, _ = edge_covariance(odometry(covariance), STAMPS[::7], NoiseSettings())
    model, _, _ = edge_covariance(odometry(None), STAMPS[::7], NoiseSettings())
    sigma = np.sqrt(np.diagonal(model, axis1=1, axis2=2))
    largest = np.linalg.eigvalsh(result / sigma[:, :, None] / sigma[:, None, :])[:, -1]
    assert np.median(largest) == pytest.approx(1.0, rel=1e-3)
    assert any(f"{1 + (rest < 1.0)} constant" in warning and "lowered" in warning for warning in warnings)


@pytest.mark.parametrize(
    ("scale", "increments", "lowered"), [(1e4, False, True), (1e4, True, False), (1, False, False)]
)
def test_the_covariance_of_a_pose_that_is_corrected_is_bounded_by_the_model(
    scale: float, increments: bool, lowered: bool
) -> None:
    """It fluctuates, and as noise of increments it would grow with the rate of samples."""
    drive = replace(odometry(scale * fluctuating()), increments=increments)
    result, warnings, source = edge_covariance(drive, STAMPS[::7], NoiseSettings())
    model, _, _ = edge_covariance(odometry(None), STAMPS[::7], NoiseSettings())
    share = np.sqrt(np.diagonal(result, axis1=1, axis2=2) / np.diagonal(model, axis1=1, axis2=2))
    assert source == "increments"
    assert (share.max() <= 1.001) == lowered
    assert any("does not grow" in warning for warning in warnings) == lowered


def test_constants_that_tell_how_sure_the_odometry_is_stay_apart() -> None:
    """As of a tracking camera with states of confidence: what is lost is no surer than what is tracked."""
    level = np.where(np.arange(T) < 2 * T // 3, 1e2, 1e4)[:, None, None]  # it does not grow, it changes once
    result, _, _ = edge_covariance(odometry(SMALL * level), STAMPS[::10], NoiseSettings())
    sigma_m = np.sqrt(result[:, 3, 3])
    assert sigma_m[-2] == pytest.approx(10.0 * sigma_m[1], rel=0.01)


def test_marks_at_the_start_do_not_make_constants_of_estimates() -> None:
    logged = fluctuating()
    clean, _, _ = edge_covariance(odometry(logged), STAMPS[::10], NoiseSettings())
    logged[:3] = 1e6 * np.eye(6)
    marked, _, _ = edge_covariance(odometry(logged), STAMPS[::10], NoiseSettings())
    np.testing.assert_allclose(marked[1:], clean[1:])


def test_keyframes_outside_of_the_odometry_are_refused() -> None:
    with pytest.raises(GraphError, match="within the odometry"):
        edge_covariance(odometry(None), STAMPS[[0, 50]] - 1, NoiseSettings())
