from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.loops.scene import Scene, camera, empty, keyframes, pose, proposals, scene, verify, view
from vplog.data import Features, Verdict
from vplog.features.stereo_depth import StereoSettings, stereo_depth
from vplog.geometry import se3
from vplog.loops.verify import VerifySettings

LENS = replace(camera(), matrix=np.array([[500.0, 0, 320], [0, 500.0, 240], [0, 0, 1]]))
BASELINE_M = 0.5
SHIFT = se3.pose(np.eye(3), np.array([BASELINE_M, 0.0, 0.0]))


def pair(place: Scene, at: np.ndarray, rng: np.random.Generator, noise_px: float = 0.3) -> tuple[Features, Features]:
    """Left and right view; the right camera sits `BASELINE_M` along the left one's x."""
    right = replace(LENS, body_from_camera=LENS.body_from_camera @ SHIFT)
    return view(place, at, LENS, rng, noise_px=noise_px), view(place, at, right, rng, noise_px=noise_px)


def true_depth(place: Scene, at: np.ndarray, features: Features) -> np.ndarray:
    """(M,) by descriptor; NaN for clutter."""
    z = se3.transform(se3.inverse(at @ LENS.body_from_camera), place.points)[:, 2]
    apart = np.abs(features.descriptors[:, None].astype(np.int16) - place.descriptors[None].astype(np.int16)).max(
        axis=2
    )
    best = apart.argmin(axis=1)
    return np.where(apart[np.arange(len(features)), best] <= 8, z[best], np.nan)


def test_depths_are_as_good_as_their_disparities() -> None:
    rng = np.random.default_rng(0)
    place = scene(rng, 1500, 40.0)
    left, right = pair(place, pose(0), rng)
    found, true = stereo_depth(left, right, 500.0, BASELINE_M, StereoSettings()), true_depth(place, pose(0), left)
    assert found.dtype == np.float32
    assert found.shape == (len(left),)
    known = np.isfinite(found)
    assert known.sum() > 0.6 * np.isfinite(true).sum()  # near points of one image leave the other
    assert np.isnan(found[np.isnan(true)]).mean() > 0.95  # clutter has no depth
    both = known & np.isfinite(true)
    error_px = 500.0 * BASELINE_M * (1.0 / found[both] - 1.0 / true[both])
    assert 0.7 < np.median(np.abs(error_px)) / 0.6745 / (0.3 * np.sqrt(2)) < 1.3
    assert (np.abs(error_px) < 2.0).mean() > 0.98


def test_shifted_principal_points_are_taken_out() -> None:
    rng = np.random.default_rng(1)
    left, right = pair(scene(rng, 800, 40.0), pose(0), rng)
    moved = replace(right, points=right.points - np.array([16.0, 0.0], np.float32))  # whole, so that nothing rounds
    expected = stereo_depth(left, right, 500.0, BASELINE_M, StereoSettings())
    found = stereo_depth(left, moved, 500.0, BASELINE_M, StereoSettings(), zero_px=16.0)
    np.testing.assert_allclose(found, expected, rtol=1e-3)


def test_rows_that_do_not_correspond_have_no_depth() -> None:
    rng = np.random.default_rng(2)
    left, right = pair(scene(rng, 800, 40.0), pose(0), rng)
    tilted = replace(right, points=right.points + np.array([0.0, 30.0], np.float32))
    assert np.isfinite(stereo_depth(left, tilted, 500.0, BASELINE_M, StereoSettings())).mean() < 0.03
    swapped = stereo_depth(right, left, 500.0, BASELINE_M, StereoSettings())  # every disparity is negative
    assert np.isfinite(swapped).mean() < 0.03


@pytest.mark.parametrize(("focal", "baseline"), [(0.0, 0.5), (500.0, -0.1), (np.nan, 0.5), (500.0, np.inf)])
def test_no_stereo_without_a_baseline(focal: float, baseline: float) -> None:
    with pytest.raises(ValueError, match="positive"):
        stereo_depth(empty(LENS), empty(LENS), focal, baseline, StereoSettings())


def test_nothing_in_nothing_out() -> None:
    rng = np.random.default_rng(3)
    left, _ = pair(scene(rng, 100), pose(0), rng)
    assert stereo_depth(empty(LENS), left, 500.0, 0.5, StereoSettings()).shape == (0,)
    assert np.isnan(stereo_depth(left, empty(LENS), 500.0, 0.5, StereoSettings())).all()


def test_a_stereo_closure_has_metres_without_odometry() -> None:
    rng = np.random.default_rng(4)
    place = scene(rng, 2500, 50.0)
    poses = np.array([pose(0.0), pose(0.4, 0.5, yaw=0.08)])
    seen = []
    for at in poses:
        left, right = pair(place, at, rng)
        seen.append(replace(left, depth_m=stereo_depth(left, right, 500.0, BASELINE_M, StereoSettings())))
    still = keyframes([poses[0], poses[0]])  # the odometry says nothing of how they lie
    lens = replace(LENS, baseline_m=BASELINE_M)
    ledger = verify(proposals([(1, 0)]), still, lens, seen.__getitem__, VerifySettings())
    assert ledger.verdict == [Verdict.ACCEPTED]
    assert ledger.scale == ["stereo"]
    assert ledger.reverse_inliers[0] > 50
    error = se3.log(se3.between(se3.between(poses[0], poses[1]), ledger.match_from_query[0]))
    assert np.linalg.norm(error[3:]) < 0.05
    assert np.sqrt(error @ ledger.information[0] @ error / 6) < 2.0
