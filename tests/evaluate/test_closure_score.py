from __future__ import annotations

import dataclasses
import json
from typing import TYPE_CHECKING

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.evaluate.data import data
from vplog.data import Closures, Keyframes, Trajectory, Verdict
from vplog.errors import TruthError
from vplog.evaluate.body_truth import BodyTruth
from vplog.evaluate.closures import ClosureScore, PlaceCriterion, score_closures
from vplog.evaluate.truth import read_truth
from vplog.geometry import se3

if TYPE_CHECKING:
    from collections.abc import Sequence

    from vplog.data import Floats, Ints

SECOND = 1_000_000_000


def planar(x: Sequence[float], y: Sequence[float], yaw_deg: Sequence[float]) -> Floats:
    yaw = np.radians(np.array(yaw_deg, float))
    rotation = se3.so3_exp(yaw[:, None] * [0.0, 0.0, 1.0])
    return se3.pose(rotation, np.stack([np.array(x, float), np.array(y, float), 0 * yaw], axis=1))


def ledger(pairs: Sequence[tuple[int, int, float, bool]]) -> Closures:
    """Rows of query, match, score and whether accepted, without a pose; inliers fall as the score rises."""
    count = len(pairs)
    query, match, score, accepted = (list(column) for column in zip(*pairs, strict=True)) if pairs else ([], [], [], [])
    zeros, nan = np.zeros(count, np.int32), np.full(count, np.nan)
    return Closures(
        query=np.array(query, np.int32),
        match=np.array(match, np.int32),
        rank=zeros,
        score=np.array(score, np.float32),
        support=zeros,
        shared_references=[np.empty(0, np.uint16)] * count,
        shared_overlap=[np.empty(0, np.float32)] * count,
        matches=zeros,
        landmarks=zeros,
        inliers=np.array([round(1000 * (1 - s)) for s in score], np.int32),
        spread=zeros.astype(np.float32),
        reverse_inliers=zeros,
        scale=["odometry"] * count,
        match_from_query=np.full((count, 4, 4), np.nan),
        information=np.full((count, 6, 6), np.nan),
        verdict=[Verdict.ACCEPTED if a else Verdict.TOO_FEW_INLIERS for a in accepted],
        p_false=nan,
        residual_before=nan,
        residual_after=nan,
        weight=nan,
        query_camera=zeros,
        match_camera=zeros,
    )


def score(poses: Floats, closures: Closures, stop: Ints | None = None) -> ClosureScore:
    stamps = SECOND * np.arange(len(poses))
    keyframes = Keyframes("d", stamps, poses)
    stop = np.maximum(np.arange(len(poses)) - 2, 0) if stop is None else stop
    return scored(keyframes, closures, Trajectory(stamps, poses), stop)


def scored(
    keyframes: Keyframes, closures: Closures, truth: Trajectory, stop: Ints, place: PlaceCriterion | None = None
) -> ClosureScore:
    return score_closures(keyframes, closures, BodyTruth(truth), stop, place)[0]


# There and back: 0..3 go east, 4 and 5 are far off, 6..8 pass 0..2 again the same way, 9 stands at 3 and looks west.
ROUTE = planar([0, 10, 20, 30, 200, 300, 1, 11, 21, 30], [0] * 10, [0] * 9 + [180])


def test_shares_of_a_drive_known_by_hand() -> None:
    closures = ledger(
        [
            (6, 0, 0.9, True),  # true
            (7, 1, 0.8, False),  # true, but rejected
            (7, 2, 0.7, True),  # 9 m apart: false
            (9, 3, 0.6, True),  # the same place, looking the other way: false, opposite
            (8, 2, 0.5, True),  # true
        ]
    )
    found = score(ROUTE, closures)
    assert (found.keyframes, found.outside, found.candidates) == (10, 0, 5)
    assert (found.accepted, found.accepted_true, found.precision) == (4, 2, 0.5)
    assert (found.revisits, found.revisits_found, found.recall) == (3, 2, 2 / 3)
    assert found.opposite == 1
    # by score: true true false false true; recall rises by 1/3 at ranks 1, 2 and 5
    assert found.average_precision == pytest.approx((1 + 1 + 3 / 5) / 3)
    assert found.recall_at_full_precision == pytest.approx(2 / 3)
    # by inliers the order is the reverse: true false false true true
    assert found.average_precision_by_inliers == pytest.approx((1 + 2 / 4 + 3 / 5) / 3)
    assert found.recall_at_full_precision_by_inliers == pytest.approx(1 / 3)


def test_equal_scores_come_together() -> None:
    found = score(ROUTE, ledger([(6, 0, 0.5, True), (7, 2, 0.5, True)]))
    assert found.average_precision == pytest.approx(1 / 3 * 1 / 2)
    assert found.recall_at_full_precision == 0.0


def test_keyframes_outside_the_truth_do_not_count() -> None:
    stamps = SECOND * np.arange(10)
    keyframes = Keyframes("d", stamps, ROUTE)
    stop = np.maximum(np.arange(10) - 2, 0)
    truth = Trajectory(stamps[1:8], ROUTE[1:8])
    closures = ledger([(6, 0, 0.9, True), (7, 1, 0.8, True), (9, 3, 0.7, True)])
    found = scored(keyframes, closures, truth, stop)
    assert (found.keyframes, found.outside, found.candidates) == (7, 3, 1)
    assert (found.precision, found.recall, found.revisits) == (1.0, 1.0, 1)


def test_truth_is_interpolated_but_not_over_long_gaps() -> None:
    poses = planar([0, 1, 2, 3], [0] * 4, [0] * 4)
    keyframes = Keyframes("d", SECOND * np.array([0, 1, 2, 3]), poses)
    close = Trajectory(SECOND * np.array([0, 1, 3]), poses[[0, 1, 3]])
    wide = Trajectory(SECOND * np.array([0, 3]), poses[[0, 3]])
    stop = np.array([0, 1, 2, 3])
    assert scored(keyframes, ledger([]), close, stop).outside == 0
    assert scored(keyframes, ledger([]), wide, stop).outside == 2
    found = scored(keyframes, ledger([(2, 1, 0.5, True)]), close, stop, PlaceCriterion(1.001))
    assert found.precision == 1.0
    assert scored(keyframes, ledger([(2, 1, 0.5, True)]), close, stop, PlaceCriterion(0.999)).precision == 0.0


def test_nothing_accepted_and_nothing_to_find() -> None:
    found = score(ROUTE, ledger([]))
    assert (found.precision, found.recall, found.average_precision, found.recall_at_full_precision) == (None, 0, 0, 0)
    found = score(ROUTE[:5], ledger([]))
    assert (found.precision, found.recall, found.average_precision, found.revisits) == (None, None, None, 0)
    json.dumps(dataclasses.asdict(found), allow_nan=False)


def test_truth_of_another_drive_is_one_line() -> None:
    keyframes = Keyframes("d", SECOND * np.arange(10), ROUTE)
    other = Trajectory(SECOND * np.arange(100, 110), ROUTE)
    nothing = Trajectory(np.zeros(0, np.int64), ROUTE[:0])
    for truth in (other, nothing):
        with pytest.raises(TruthError, match="none of the 10 keyframes"):
            scored(keyframes, ledger([]), truth, np.arange(10))


@settings(max_examples=15, deadline=None)
@given(st.integers(0, 2**32 - 1))
def test_scores_agree_with_counting_every_pair(seed: int) -> None:
    """Revisits and average precision against plain loops over all pairs and all thresholds."""
    rng = np.random.default_rng(seed)
    count = 40
    poses = planar(
        rng.uniform(0, 60, count).tolist(), rng.uniform(0, 20, count).tolist(), rng.uniform(-180, 180, count).tolist()
    )
    stop = np.maximum(np.arange(count) - rng.integers(0, 10), 0)
    rows = [(q, m) for q in range(count) for m in range(stop[q])]
    chosen = [rows[i] for i in sorted(rng.choice(len(rows), 60, replace=False))]
    closures = ledger([(q, m, float(rng.integers(0, 20)) / 20, bool(rng.random() < 0.5)) for q, m in chosen])
    found = score(poses, closures, stop)

    def true(i: int, j: int) -> bool:
        relative = np.linalg.inv(poses[i]) @ poses[j]
        turn = np.degrees(np.arccos(np.clip((np.trace(relative[:3, :3]) - 1) / 2, -1, 1)))
        return bool(np.linalg.norm(relative[:3, 3]) <= 6.0 and turn <= 45.0)

    revisits = {i for i in range(count) if any(true(i, j) for j in range(stop[i]))}
    assert found.revisits == len(revisits)
    if not revisits:
        return
    average = recall = full = 0.0
    for threshold in sorted(set(closures.score.tolist()), reverse=True):
        kept = [(q, m) for (q, m), s in zip(chosen, closures.score, strict=True) if s >= threshold]
        precision = sum(true(q, m) for q, m in kept) / len(kept)
        now = len({q for q, m in kept if true(q, m)}) / len(revisits)
        average, recall = average + (now - recall) * precision, now
        full = now if precision == 1.0 else full
    assert found.average_precision == pytest.approx(average)
    assert found.recall_at_full_precision == pytest.approx(full)


def test_loops_of_a_real_drive() -> None:
    """The drive passes one street again in the same direction and one in the opposite direction."""
    truth = read_truth(data("drives/kitti00.groundtruth.tum"))
    keyframes = Keyframes("kitti00", truth.stamp_ns[::2], truth.world_from_body[::2])
    rows = np.arange(len(keyframes.stamp_ns))
    position = truth.world_from_body[::2, :3, 3]

    def nearest(query: int, start: int, stop: int) -> int:
        return start + int(np.linalg.norm(position[start:stop] - position[query], axis=1).argmin())

    same = [
        (row, nearest(row, 40, 120), 0.9, True) for row in range(783, 820)
    ]  # before, it is still turning into the street
    opposite = [(row, nearest(row, 280, 300), 0.5, True) for row in range(694, 709)]
    found = scored(keyframes, ledger([*same, *opposite]), truth, np.maximum(rows - 100, 0), PlaceCriterion(10.0))
    assert found.outside == 0
    assert (found.accepted, found.accepted_true, found.opposite) == (
        len(same) + len(opposite),
        len(same),
        len(opposite),
    )
    assert found.revisits_found == len(same)
    assert found.recall_at_full_precision == found.recall


def test_a_rear_camera_sees_the_place_on_the_way_back() -> None:
    """The body stands at 3 and looks west, where its rear camera looks as the front one did."""
    ahead = se3.pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.zeros(3))
    behind = se3.pose(np.diag([-1.0, -1.0, 1.0]), np.zeros(3)) @ ahead
    stamps = SECOND * np.arange(10)
    keyframes, truth = Keyframes("d", stamps, ROUTE), BodyTruth(Trajectory(stamps, ROUTE))
    stop = np.maximum(np.arange(10) - 2, 0)
    closures = dataclasses.replace(ledger([(9, 3, 0.6, True)]), query_camera=np.ones(1, np.int32))
    found, _ = score_closures(keyframes, closures, truth, stop, cameras=[ahead, behind])
    assert (found.opposite, found.same_place, found.place_precision, found.accepted_true) == (0, 1, 1.0, 1)
    assert (found.revisits, found.revisits_found) == (4, 1)
    front = dataclasses.replace(closures, query_camera=np.zeros(1, np.int32))
    found, _ = score_closures(keyframes, front, truth, stop, cameras=[ahead, behind])
    assert (found.opposite, found.same_place) == (1, 0)
    one, _ = score_closures(keyframes, front, truth, stop, cameras=[ahead])
    assert one.revisits == 3
