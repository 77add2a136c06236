from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.loops.scene import keyframes, pose
from vplog.geometry import se3
from vplog.loops.calibration import body_twists, stamp_covariance


def test_wrong_stamps_move_a_closure_as_the_body_moves() -> None:
    """Against samples: two bodies in motion, each seen a little too early or late."""
    rng = np.random.default_rng(0)
    closure, match, query = (se3.exp(rng.normal(0, 0.3, 6)), *rng.normal(0, 1.0, (2, 6)))
    late = rng.normal(0, 0.01, (20_000, 2, 1))
    seen = se3.exp(late[:, 0] * match) @ closure @ se3.exp(late[:, 1] * query)
    error = se3.log(se3.between(closure, seen))
    claimed = stamp_covariance(closure, match, query, 0.01)
    np.testing.assert_allclose(np.cov(error.T), claimed, atol=0.05 * np.abs(claimed).max())


def test_speed_is_the_odometrys() -> None:
    drive = keyframes([pose(2.0 * i, yaw=0.0) for i in range(5)])
    drive = replace(drive, stamp_ns=drive.stamp_ns // 4)  # four a second
    np.testing.assert_allclose(body_twists(drive), np.tile([0, 0, 0, 8.0, 0, 0], (5, 1)), atol=1e-12)
    assert np.isfinite(body_twists(keyframes([pose(0)]))).all()
