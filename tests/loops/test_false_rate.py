"""The expected share of false closures: held on candidates whose truth is known, and cautious where little is known."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import cv2
import numpy as np
import pytest

from tests.loops import scene
from tests.results.example import make_run
from vplog.data import Closures, Verdict
from vplog.execution.execution import Execution
from vplog.features.sift import SiftSettings, mirrored
from vplog.loops.candidate import Drive, VerifySettings
from vplog.loops.false_rate import (
    FalseRateSettings,
    are_unrated,
    at_rate,
    certain_pairs,
    mirrored_evidence,
    null_pairs,
    p_false,
    with_p_false,
    wrong_poses,
)
from vplog.loops.propose import Proposals
from vplog.loops.verify import drive_of, verify_between
from vplog.run import false_rate as run_false_rate


@pytest.mark.parametrize("rate", [0.1, 0.05, 0.01])
def test_the_share_of_false_candidates_stays_below_the_rate(rate: float) -> None:
    """Means over worlds in which false candidates do as well as pairs that are none, and a tenth to a half is true."""
    shares, found = [], []
    for seed in range(200):
        rng = np.random.default_rng(seed)
        true = rng.random(1000) < rng.uniform(0.1, 0.5)
        value = np.where(true, rng.poisson(60, 1000), by_chance(rng, 1000))
        taken = p_false(value, by_chance(rng, 4000), np.zeros(1000)) <= rate
        shares.append((taken & ~true).sum() / max(taken.sum(), 1))
        found.append((taken & true).sum() / true.sum())
    assert np.mean(shares) <= rate
    assert np.mean(found) > 0.8


def by_chance(rng: np.random.Generator, count: int) -> np.ndarray:
    """Most are refused by geometry, and those that pass have few inliers."""
    return np.where(rng.random(count) < 0.9, 0, 15 + rng.geometric(0.2, count))


def test_few_pairs_support_no_small_rate() -> None:
    candidates = np.array([100] * 20 + [0] * 180)
    assert (p_false(candidates, np.zeros(0, np.int64), np.zeros(200))[:20] == 1.0).all()
    some, more = (p_false(candidates, np.zeros(count, np.int64), np.zeros(200))[0] for count in (100, 1000))
    assert more < 0.01 < some < 1.0


@pytest.mark.parametrize("rate", [0.05, 0.01, 0.001])
def test_a_rate_is_given_the_pairs_that_it_needs(rate: float) -> None:
    """Where all that is verified is true, none of it is left out for want of pairs that are no closures."""
    candidates = np.array([100] * 200 + [0] * 600)
    count = null_pairs(candidates, FalseRateSettings(rate=rate))
    assert count >= null_pairs(candidates, FalseRateSettings()) == 200
    assert (p_false(candidates, np.zeros(count, np.int64), np.zeros(800))[:200] <= rate).all()


def test_without_mirrored_pairs_few_others_leave_candidates_unrated() -> None:
    candidates, none = np.array([100] * 20 + [0] * 180), FalseRateSettings(null_pairs=0)
    assert null_pairs(candidates, none) == null_pairs(candidates, FalseRateSettings(null_pairs=0, rate=0.01)) == 0
    assert are_unrated(candidates, 19, none)
    assert not are_unrated(candidates, 20, none)
    assert p_false(candidates, np.zeros(20, np.int64), np.zeros(200))[0] < 0.5
    assert not are_unrated(candidates, 0, FalseRateSettings(null_pairs=0, rate=0.01)), "a rate is held"
    assert not are_unrated(candidates, 0, FalseRateSettings())


def test_more_evidence_is_never_likelier_to_be_false() -> None:
    rng = np.random.default_rng(0)
    value = rng.integers(0, 50, 300)
    rate = p_false(value, rng.integers(0, 30, 300), rng.random(300))
    order = np.argsort(value, kind="stable")
    assert (np.diff(rate[order]) <= 0).all()
    assert ((rate > 0) & (rate <= 1)).all()


def test_wrong_poses_are_as_frequent_as_among_certain_pairs_of_as_many_inliers() -> None:
    rng = np.random.default_rng(2)
    certain = rng.integers(20, 120, 4000)
    found = wrong_poses(np.array([25, 60, 110]), certain, rng.random(4000) < np.where(certain < 40, 0.3, 0.02))
    np.testing.assert_allclose(found, [0.3, 0.02, 0.02], atol=0.03)
    assert (wrong_poses(np.array([25, 60]), np.zeros(0, np.int64), np.zeros(0, bool)) == 0.0).all()
    rate = p_false(np.array([60, 25, 0]), np.zeros(1000, np.int64), np.array([0.02, 0.3, 1.0]))
    assert rate[0] < 0.03
    assert 0.1 < rate[1] < 0.2


def test_certain_pairs_are_near_and_no_candidates() -> None:
    line = np.column_stack([np.arange(200.0), np.zeros((200, 2))])
    stops = np.maximum(np.arange(200) - 20, 0)
    pairs = certain_pairs(line, stops, 5.0, 50)
    assert len(pairs.query) == 50
    assert set(pairs.query - pairs.match) <= set(range(1, 6))
    assert (pairs.match >= stops[pairs.query]).all()
    assert not len(certain_pairs(line[:1], stops[:1], 5.0, 50).query)


def test_what_odometry_rules_out_is_false_and_what_was_not_verified_has_no_rate() -> None:
    ledger, _ = road()
    ruled_out = np.zeros(len(ledger), bool)
    ruled_out[0] = True
    found = with_p_false(ledger, ruled_out, np.zeros(1000, np.int64), np.zeros(0, np.int64), np.zeros(0, bool))
    assert found.p_false[0] == 1.0
    verified = found.of(Verdict.ACCEPTED)
    assert (np.isfinite(found.p_false) == verified).all()
    kept = at_rate(found, 0.5)
    assert kept.verdict[0] is Verdict.NOT_SIGNIFICANT
    assert kept.of(Verdict.ACCEPTED).sum() == verified.sum() - 1


def test_a_mirrored_view_is_no_closure() -> None:
    ledger, drive = road()
    assert ledger.of(Verdict.ACCEPTED).all()
    proposals = Proposals(ledger.query, ledger.match, ledger.rank, ledger.score, ledger.support)
    assert (mirrored_evidence(proposals, drive, drive, Execution()) == 0).all()


def test_features_are_mirrored_as_the_image_is() -> None:
    """SIFT on the mirrored image finds the points and descriptors that exchanging bins makes of the others."""
    noise = np.random.default_rng(1).integers(0, 256, (240, 320), np.uint8)
    blurred = cv2.GaussianBlur(noise, (0, 0), 3.0).astype(float)
    image = (255 * (blurred - blurred.min()) / np.ptp(blurred)).astype(np.uint8)
    extract = SiftSettings()
    own, other = extract(image), extract(np.ascontiguousarray(image[:, ::-1]))
    found = mirrored(own)
    apart = np.linalg.norm(found.points[:, None] - other.points[None], axis=2)
    near, same = apart.argmin(1), apart.min(1) < 0.5
    assert same.mean() > 0.8
    error = np.linalg.norm(found.descriptors[same].astype(float) - other.descriptors[near[same]], axis=1)
    assert np.median(error) < 100.0  # of 512, the length of a descriptor; others are 400 apart
    np.testing.assert_array_equal(mirrored(found).descriptors, own.descriptors)


@cache
def road() -> tuple[Closures, Drive]:
    """A ledger of true closures along a road, and its drive."""
    rng, lens = np.random.default_rng(3), scene.camera()
    place, poses = scene.scene(rng), [scene.pose(1.2 * i % 14.4, 0.3 * (i > 11)) for i in range(24)]
    seen = [scene.view(place, pose, lens, rng, depth=True) for pose in poses]
    drive = drive_of(scene.keyframes(poses), lens, seen.__getitem__, VerifySettings())
    return verify_between(scene.proposals([(12 + i, i) for i in range(1, 12)]), drive, drive, Execution(), 0.0), drive


@pytest.mark.parametrize("null", [0, 200])
def test_a_rate_out_of_reach_names_a_remedy_that_works(null: int, caplog: pytest.LogCaptureFixture) -> None:
    """More mirrored pairs are none where none can be mirrored, as with the features of a network."""
    verified = make_run(0).closures
    verified = replace(verified, verdict=[Verdict.ACCEPTED] * len(verified), p_false=np.full(len(verified), 0.4))
    found = run_false_rate._admitted(verified, FalseRateSettings(rate=0.1, null_pairs=null), 3, 0)
    assert set(found.verdict) == {Verdict.NOT_SIGNIFICANT}
    assert ("false_rate.null_pairs" in caplog.text) == (null > 0)
