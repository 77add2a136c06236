"""Errors as large as they claim have a median near 1, whatever a truth that drifts between two visits says."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.graph.drive import ledger
from vplog.data import Closures, Keyframes, Trajectory, Verdict
from vplog.evaluate.body_truth import BodyTruth
from vplog.evaluate.closures import PoseScore, score_poses, score_residuals
from vplog.geometry import se3

SIGMA = np.repeat([0.003, 0.05], 3)
LAP = 200


def drive(claimed: float = 1.0) -> tuple[Keyframes, Closures, BodyTruth]:
    """Two laps, the second 0.3 m beside the first, and a closure from every keyframe of it."""
    random = np.random.default_rng(0)
    turn = np.linspace(0, 2 * np.pi, LAP, endpoint=False)
    zero = np.zeros(LAP)
    rotation = se3.so3_exp(np.stack([zero, zero, turn], axis=1))
    laps = [se3.pose(rotation, np.stack([r * np.cos(turn), r * np.sin(turn), zero], axis=1)) for r in (50.0, 50.3)]
    poses = np.concatenate(laps)
    stamps = np.arange(2 * LAP, dtype=np.int64) * 10**9
    match, query = np.arange(LAP, dtype=np.int32), np.arange(LAP, 2 * LAP, dtype=np.int32)
    z = se3.between(poses[match], poses[query]) @ se3.exp(random.normal(size=(LAP, 6)) * SIGMA)
    information = np.tile(np.diag(1.0 / (claimed * SIGMA) ** 2), (LAP, 1, 1))
    accepted = replace(ledger(query, match, z), information=information)
    return Keyframes("laps", stamps, poses), accepted, BodyTruth(Trajectory(stamps, poses))


@pytest.mark.parametrize("claimed", [0.5, 1.0, 4.0])
def test_medians_are_the_errors_in_units_of_the_claim(claimed: float) -> None:
    found = score_residuals(*drive(claimed))
    assert found.closures == LAP
    assert found.pairs == LAP - 1
    assert found.to_truth == pytest.approx(0.94 / claimed, rel=0.08)
    assert found.to_neighbours == pytest.approx(0.94 / claimed, rel=0.08)


def test_a_truth_that_is_off_between_the_laps_spoils_the_one_figure_and_not_the_other() -> None:
    keyframes, closures, truth = drive()
    off = truth.trajectory.world_from_body.copy()
    off[LAP:, 2, 3] += 1.0
    found = score_residuals(keyframes, closures, BodyTruth(Trajectory(keyframes.stamp_ns, off)))
    assert found.to_truth is not None
    assert found.to_truth > 5
    assert found.to_neighbours == pytest.approx(0.94, rel=0.08)


def test_nothing_accepted_is_no_figure() -> None:
    keyframes, closures, truth = drive()
    found = score_residuals(keyframes, replace(closures, verdict=[Verdict.TOO_FAR] * LAP), truth)
    assert (found.closures, found.to_truth, found.pairs, found.to_neighbours) == (0, None, 0, None)


@pytest.mark.parametrize("claimed", [0.5, 1.0, 4.0])
def test_nees_is_one_where_poses_are_off_by_what_they_claim(claimed: float) -> None:
    """In the frame of the truth, wherever the reference keyframe is by either."""
    keyframes, _, truth = drive()
    poses, reference = truth.trajectory.world_from_body, 30
    error = np.random.default_rng(1).normal(size=(2 * LAP, 6)) * SIGMA
    error[reference] = 0.0
    elsewhere = se3.exp(np.array([[0.2, -0.1, 2.0, 30.0, -7.0, 4.0]]))
    covariance = np.tile(np.diag((claimed * SIGMA) ** 2), (2 * LAP, 1, 1))
    covariance[7] = np.nan
    found = score_poses(keyframes.stamp_ns, elsewhere @ poses @ se3.exp(error), [reference], [covariance], truth)
    assert found.keyframes == 2 * LAP - 2
    assert found.nees == pytest.approx(claimed**-2, rel=0.1)
    assert found.median_sigma_m == pytest.approx(claimed * 0.05 * np.sqrt(3))


def test_a_wrong_truth_of_the_first_keyframes_does_not_decide_the_nees() -> None:
    """The first five true poses are 1 m too high, which is 20 standard deviations of a pose."""
    keyframes, _, truth = drive()
    stamps, poses, references = keyframes.stamp_ns, truth.trajectory.world_from_body, list(range(0, 2 * LAP, 10))
    turned = [se3.adjoint(se3.between(poses, poses[[reference]])) for reference in references]
    own = np.diag(SIGMA**2)  # the errors of two poses are independent
    covariances = [own + Ad @ own @ np.swapaxes(Ad, 1, 2) for Ad in turned]
    wrong = poses.copy()
    wrong[:5, 2, 3] += 1.0
    too_high = BodyTruth(Trajectory(stamps, wrong))
    error = np.random.default_rng(1).normal(size=(2 * LAP, 6)) * SIGMA
    for factor in (1.0, 2.0):
        solved, expected = poses @ se3.exp(factor * error), pytest.approx(factor**2, rel=0.25)
        assert score_poses(stamps, solved, references, covariances, truth).nees == expected
        assert score_poses(stamps, solved, references, covariances, too_high).nees == expected
    by_first = score_poses(stamps, poses @ se3.exp(error), references[:1], covariances[:1], too_high).nees
    assert by_first is not None
    assert by_first > 2.0


def test_poses_without_covariance_or_orientation_have_no_nees() -> None:
    keyframes, _, truth = drive()
    stamps, poses = keyframes.stamp_ns, truth.trajectory.world_from_body
    none, covariance = PoseScore(0, None, None), np.tile(np.eye(6), (2 * LAP, 1, 1))
    assert score_poses(stamps, poses, [0], [covariance * np.nan], truth) == none
    assert score_poses(stamps, poses, [0], [covariance], replace(truth, oriented=False)) == none
