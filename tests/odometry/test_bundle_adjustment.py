"""Bundle adjustment of views with a lens that is not known."""

from __future__ import annotations

import numpy as np
import pytest

from vplog.data import Floats
from vplog.geometry import se3
from vplog.odometry.bundle_adjustment import Observations, adjust

SIGMA = 0.3 / 500.0
"""Of a normalised coordinate: 0.3 px at a focal length of 500 px."""


def views(turn: float) -> Floats:
    """(12, 4, 4) of a camera that goes ahead and turns by so many rad in all."""
    along = np.linspace(0.0, 1.0, 12)[:, None]
    return se3.exp(along * np.array([[0.1 * turn, turn, 0.0, 0.5, 0.2, 3.0]]))


@pytest.mark.parametrize(("s", "k"), [(0.7, 0.0), (1.3, -0.2), (1.0, 0.1)])
def test_focal_length_and_distortion_are_found(s: float, k: float) -> None:
    rng, poses = np.random.default_rng(3), views(0.5)
    depth = rng.uniform(8.0, 20.0, 150)
    points = np.column_stack([rng.uniform(-0.4, 0.6, (150, 2)) * depth[:, None], depth])
    at = np.stack([se3.transform(se3.inverse(pose), points) for pose in poses])
    rays = at[..., :2] / at[..., 2:]
    bent = s * (1.0 + k * (rays**2).sum(axis=2, keepdims=True)) * rays
    view, landmark = (one.ravel() for one in np.indices(rays.shape[:2]))
    count = len(view)
    measured = bent.reshape(-1, 2) + rng.normal(0.0, SIGMA, (count, 2))
    unknown = np.full(count, np.nan)
    noise = np.tile(np.eye(2) * SIGMA**2, (count, 1, 1))
    observed = Observations(view, landmark, np.column_stack([measured, unknown]), noise, unknown)
    found = adjust(poses, points, observed, metric=False, lens=np.array([1.0, 0.0]))
    assert found is not None
    error, sigma = found.lens - [s, k], np.sqrt(np.diag(found.lens_covariance))
    assert (np.abs(error) < 4.0 * sigma).all()
    assert (sigma < 0.01).all()
    turn = se3.between(found.world_from_camera[0], found.world_from_camera[-1])
    assert np.linalg.norm(se3.log((se3.inverse(turn) @ se3.between(poses[0], poses[-1]))[None])[0, :3]) < 0.01
    as_known = adjust(poses, points, observed, metric=False)
    assert as_known is not None and as_known.lens.tolist() == [1.0, 0.0]
