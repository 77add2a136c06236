"""The solve of a drive as a whole: what the log claims of its odometry decides little, what closures agree on much."""

from __future__ import annotations

from dataclasses import replace
from itertools import accumulate
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.graph.drive import ODOMETRY_SIGMA, ledger, position_error, ring
from vplog.data import Gps, Keyframes, Odometry, Trajectory, Verdict
from vplog.evaluate.body_truth import BodyTruth
from vplog.evaluate.closures import score_poses
from vplog.geometry import geodesy, se3
from vplog.graph.consistency import is_loop
from vplog.loops.verify import no_closures
from vplog.pipeline import Pipeline, load_pipeline
from vplog.run.back_end import keyframe_covariances, solve

if TYPE_CHECKING:
    from tests.graph.drive import Drive
    from vplog.run.back_end import BackEndResult


def solved(drive: Drive, claimed: float, aside_m: float = 0.0) -> BackEndResult:
    """The drive with a constant covariance so many times its true one, its closures moved aside."""
    loops = is_loop(drive.graph)
    measured = drive.graph.a_from_b[loops].copy()
    measured[:, 0, 3] += aside_m
    closures = ledger(drive.graph.b[loops], drive.graph.a[loops], measured)
    count = len(drive.odometry.stamp_ns)
    odometry = Odometry(
        drive.odometry.stamp_ns,
        drive.odometry.odom_from_body,
        np.tile(np.diag(claimed * ODOMETRY_SIGMA**2), (count, 1, 1)),
    )
    return solve(odometry, drive.keyframes, closures, None, Pipeline())


@pytest.mark.parametrize("claimed", [1e-6, 1 / 64, 1.0, 64.0])
def test_the_covariance_that_the_log_claims_decides_little(claimed: float) -> None:
    drive = ring(240, 60, seed=4, noise=1.0)
    honest, found = solved(drive, 1.0), solved(drive, claimed)
    kept = [one.closures.verdict.count(Verdict.ACCEPTED) for one in (honest, found)]
    assert abs(kept[0] - kept[1]) <= 0.1 * kept[0]
    errors = [position_error(one.refined.solution.world_from_body, drive.true) for one in (honest, found)]
    assert errors[1] < 1.1 * errors[0] + 0.02


def test_a_covariance_that_closures_contradict_gives_way_to_the_drift_model() -> None:
    drive = ring(240, 60, seed=4)
    rough = replace(drive, odometry=replace(drive.odometry))
    found = solved(rough, 1e-6)
    told = " ".join(found.warnings)
    assert "is implausible" in told
    assert found.closures.verdict.count(Verdict.ACCEPTED) >= 50


def test_poisoned_closures_end_with_the_odometry_and_say_so() -> None:
    drive = ring(240, 60, seed=4)
    found = solved(drive, 1.0, aside_m=30.0)
    assert found.closures.verdict.count(Verdict.ACCEPTED) == 0
    assert found.refined.solution.reason.startswith("Odometry was kept: ")
    np.testing.assert_allclose(found.trajectory.world_from_body, drive.odometry.odom_from_body, atol=1e-6)


@pytest.mark.parametrize("fixed", [False, True], ids=["without fixes", "with fixes"])
def test_fixes_relate_the_pieces_of_a_drive(fixed: bool) -> None:
    count = 200
    angle = np.linspace(0.0, 3.0 * np.pi, count)
    vectors = np.stack([0 * angle, 0 * angle, angle + np.pi / 2], axis=1)
    true = se3.pose(se3.so3_exp(vectors), 60.0 * np.stack([np.cos(angle), np.sin(angle), 0 * angle], axis=1))
    odometry = se3.inverse(true[:1]) @ true
    turned = se3.exp(np.array([[0.0, 0.0, 2.0, 0.0, 0.0, 0.0]]))[0]
    odometry[100:] = odometry[99] @ turned @ se3.inverse(odometry[100]) @ odometry[100:]
    stamps = np.arange(count) * 500_000_000 + 10**18
    noise = np.tile(np.diag([1e-6] * 3 + [1e-4] * 3), (count, 1, 1))
    given = Odometry(stamps, odometry, noise, breaks=np.array([100]), increments=True)
    near = np.random.default_rng(0).normal(true[:, :3, 3], 0.3)
    latitude, longitude, altitude = geodesy.geodetic(near, (48.0, 11.0, 500.0)).T
    fixes = Gps(stamps, latitude, longitude, altitude, np.tile(0.09 * np.eye(3), (count, 1, 1)))
    pipeline = load_pipeline("default", ["gps.use=true"] * fixed)
    found = solve(given, Keyframes("drive", stamps[::2], odometry[::2]), no_closures(), fixes, pipeline)
    assert found.pieces == 2 - fixed
    assert fixed != any("breaks of the odometry have no closure" in one for one in found.warnings)


def test_covariances_hold_for_a_gyroscope_with_a_wrong_scale() -> None:
    """Check the mean NEES of simulated drives whose odometry has errors of scale in its turns and its lengths."""
    random, found = np.random.default_rng(5), list[float]()
    for seed in range(6):
        drive = ring(120, 0, seed=seed)
        steps = se3.log(se3.between(drive.odometry.odom_from_body[:-1], drive.odometry.odom_from_body[1:]))
        steps *= np.repeat(1.0 + np.array([0.03, 0.02]) * random.normal(size=2), 3)
        odom_from_body = np.array([*accumulate(se3.exp(steps), np.matmul, initial=np.eye(4))])
        covariance = np.tile(np.diag(ODOMETRY_SIGMA**2), (len(odom_from_body), 1, 1))
        odometry = replace(drive.odometry, odom_from_body=odom_from_body, covariance=covariance, increments=True)
        keyframes = replace(drive.keyframes, odom_from_body=odom_from_body)
        result = solve(odometry, keyframes, no_closures(), None, Pipeline())
        own = keyframe_covariances(result)
        assert own is not None
        truth = BodyTruth(Trajectory(keyframes.stamp_ns, drive.true))
        nees = score_poses(keyframes.stamp_ns, result.refined.solution.world_from_body, [0], [own], truth).nees
        assert nees is not None
        found.append(nees)
    assert 0.5 < np.mean(found) < 2.0, found
