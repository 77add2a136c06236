"""Localised frames and odometry together: a wrong one is left out, and the rest of the drive is in the map's frame."""

from __future__ import annotations

import numpy as np
import pytest

from vplog.data import Keyframes, Odometry
from vplog.geometry import se3
from vplog.maps.localization.trajectory import join_by_odometry
from vplog.pipeline import Pipeline

STEP = se3.exp(np.array([0.0, 0.0, 0.02, 1.0, 0.0, 0.0]))
MAP_FROM_START = se3.exp(np.array([0.1, -0.05, 2.0, 40.0, -7.0, 1.5]))
SIGMA = np.diag([0.01, 0.01, 0.01, 0.05, 0.05, 0.05]) ** 2


@pytest.mark.parametrize("wrong", [None, 7])
def test_a_wrong_frame_is_left_out(wrong: int | None) -> None:
    true = [MAP_FROM_START]
    for _ in range(60):
        true.append(true[-1] @ STEP)
    odom = [np.eye(4)]
    for _ in range(60):  # 2 % short
        odom.append(odom[-1] @ se3.exp(np.array([0.0, 0.0, 0.0202, 0.98, 0.0, 0.0])))
    stamps = np.arange(61, dtype=np.int64) * 10**8
    odometry, keys = Odometry(stamps, np.array(odom), None), np.arange(0, 61, 2)
    keyframes = Keyframes("drive", stamps[keys], np.array(odom)[keys])
    rows = np.arange(2, 30, 3)
    rng = np.random.default_rng(0)
    measured = np.array(true)[keys[rows]] @ se3.exp(rng.normal(0, np.sqrt(np.diag(SIGMA)), (len(rows), 6)))
    if wrong is not None:
        measured[wrong] = measured[wrong] @ se3.exp(np.array([0.0, 0.0, 0.5, 8.0, 3.0, 0.0]))
    covariance = np.tile(SIGMA, (len(rows), 1, 1))
    trajectory, agreed = join_by_odometry(odometry, keyframes, rows, measured, covariance, Pipeline())
    assert [row for row, agrees in enumerate(agreed) if not agrees] == ([] if wrong is None else [wrong])
    error = trajectory.world_from_body[:, :3, 3] - np.array(true)[:, :3, 3]
    assert np.linalg.norm(error, axis=1).max() < 0.5
