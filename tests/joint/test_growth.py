"""A drive is placed among poses that stay as a solve of all would place it, and the whole gives way when it is solved
again."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.joint.test_joint import SHIFT, between, joint_error, lap, moved
from vplog.geometry import se3
from vplog.graph.solve import GncSettings
from vplog.joint.graph import Between, JoinSettings, join
from vplog.joint.growth import Anchored, place, solve_again, turned_round
from vplog.refinement.refine import RefineSettings

HOW = (GncSettings(), JoinSettings())


def anchored(tie: Between, world_from_body: np.ndarray) -> Anchored:
    return Anchored(tie, world_from_body[tie.match])


@pytest.mark.parametrize(("false", "seed"), [(0, 0), (6, 1), (9, 2)])
def test_a_drive_is_placed_among_drives_that_stay(false: int, seed: int) -> None:
    laps = [lap(seed + number) for number in (10, 20, 30)]
    true = [one for _, one in laps]
    new = moved(laps[2][0], SHIFT)
    ties = [between(2, 0, true, 25, seed), between(2, 1, true, 20, seed + 1, false=false)]
    found = place(new, [anchored(tie, true[tie.earlier]) for tie in ties], *HOW)
    assert found.world_from_body is not None
    assert found.apart == {}
    assert found.weight[1][:false].sum() == 0
    assert sum(weight.sum() for weight in found.weight) >= 0.9 * (45 - false)
    error = np.linalg.norm(found.world_from_body[:, :3, 3] - true[2][:, :3, 3], axis=1)
    assert error.max() < 0.3
    assert np.isfinite(found.residual[0]).all()


def test_drives_that_have_drifted_apart_lose_no_closures() -> None:
    """One of those met is 40 cm, eight sigmas of a closure, from where the other has it."""
    laps = [lap(number) for number in (11, 21, 31)]
    true = [one for _, one in laps]
    drifted = se3.exp(np.array([0.0, 0.0, 0.01, 0.3, 0.25, 0.0])) @ true[1]
    ties = [between(2, 0, true, 25, 3), between(2, 1, true, 25, 4)]
    found = place(laps[2][0], [anchored(ties[0], true[0]), anchored(ties[1], drifted)], *HOW)
    assert sum(weight.sum() for weight in found.weight) >= 45


def test_false_closures_place_nothing() -> None:
    laps = [lap(number) for number in (12, 22)]
    true = [one for _, one in laps]
    tie = between(1, 0, true, 8, 5, false=8)
    found = place(laps[1][0], [anchored(tie, true[0])], *HOW)
    assert found.world_from_body is None
    assert list(found.apart) == [0]
    few = replace(tie, **{name: getattr(tie, name)[:2] for name in ("query", "match", "match_from_query")})
    few = replace(few, information=tie.information[:2], of_odometry=tie.of_odometry[:2])
    assert place(laps[1][0], [anchored(few, true[0])], *HOW).world_from_body is None


def test_closures_turned_round_say_the_same() -> None:
    """Their residuals, at poses that they do not meet exactly, are equal in sigma to first order."""
    laps = [lap(number) for number in (13, 23)]
    true, random = [one for _, one in laps], np.random.default_rng(6)
    noise = random.normal(size=(20, 6, 6))
    tie = replace(between(1, 0, true, 20, 6), information=noise @ np.swapaxes(noise, 1, 2) * 100.0)
    other = turned_round(tie)
    error = se3.log(se3.inverse(tie.match_from_query) @ se3.between(true[0][tie.match], true[1][tie.query]))
    back = se3.log(se3.inverse(other.match_from_query) @ se3.between(true[1][other.match], true[0][other.query]))
    sigma = np.einsum("ni,nij,nj->n", error, tie.information, error)
    np.testing.assert_allclose(np.einsum("ni,nij,nj->n", back, other.information, back), sigma, rtol=0.1)
    again = turned_round(other)
    np.testing.assert_allclose(again.information, tie.information, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("seed", [0, 1])
def test_the_whole_solved_again_is_as_if_all_were_solved_at_once(seed: int) -> None:
    """From placed drives, with a true closure rejected and a false one kept when they were placed."""
    laps = [lap(10 * seed + number) for number in range(4)]
    true = [one for _, one in laps]
    ties = [between(j, i, true, 20, 10 * i + j + seed, false=2) for j in range(4) for i in range(j)]
    wanted = join([one for one, _ in laps], ties, *HOW, RefineSettings())
    started = [
        moved(one, se3.exp(np.array([0.0, 0.0, 0.002 * at, 0.3 * at, 0.0, 0.0]))) for at, (one, _) in enumerate(laps)
    ]
    weight = [np.array(one) for one in wanted.weight]
    weight[0][0] = 1.0
    weight[1][5] = 1.0 - weight[1][5]
    found = solve_again(started, ties, weight, *HOW, RefineSettings())
    assert found.maps == [(0, 1, 2, 3)]
    assert found.weight[0][0] == 0.0
    assert sum(np.abs(a - b).sum() for a, b in zip(found.weight, wanted.weight, strict=True)) <= 3
    assert joint_error(found.world_from_body, true) < 1.05 * joint_error(wanted.world_from_body, true)


def test_what_nothing_holds_together_is_parted() -> None:
    laps = [lap(number) for number in (14, 24, 34)]
    true = [one for _, one in laps]
    ties = [between(1, 0, true, 15, 7), between(2, 1, true, 15, 8)]
    weight = [np.ones(15), np.zeros(15)]
    far = moved(laps[2][0], SHIFT)
    found = solve_again([laps[0][0], laps[1][0], far], ties, weight, *HOW, RefineSettings())
    assert found.maps == [(0, 1), (2,)]
    np.testing.assert_array_equal(found.world_from_body[2], far.graph.world_from_body)
