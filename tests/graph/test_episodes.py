"""The prior of closures and of families of false ones, against probabilities that are written out."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from tests.graph.drive import ring
from tests.graph.test_search import late_revisit
from vplog.data import EdgeKind
from vplog.geometry import se3
from vplog.graph.consistency import OdometryChain, is_loop
from vplog.graph.episodes import EPISODE, REPEATED, SCATTERED, SHARES, Episodes

VOLUME, VIEW = 9.0, 5.0
"""Logs of the volumes of false closures between any poses, and between given ones."""


def episodes_of(loops: int, seed: int = 0, log_odds: float | None = None) -> Episodes:
    graph = ring(120, loops, seed=seed).graph
    edges = np.flatnonzero(is_loop(graph))
    odds = None if log_odds is None else np.full(len(graph.a), log_odds)
    return Episodes.of(graph, edges, OdometryChain.of(graph), (VOLUME, VIEW), odds)


def prior(episodes: Episodes, *is_false: bool) -> float:
    states = np.array(is_false)
    return episodes.log_prior(states, episodes.family(states))


def test_a_single_closure_is_true_or_anywhere_in_the_volume() -> None:
    episodes = episodes_of(1)
    assert prior(episodes, False) == pytest.approx(math.log(np.mean(1.0 - SHARES)))
    assert prior(episodes, True) == pytest.approx(math.log(np.mean(SHARES) * (1.0 - REPEATED)) - VOLUME)


def test_recognition_gives_the_prior_of_an_episode() -> None:
    for p_false in (0.01, 0.3):
        episodes = episodes_of(1, log_odds=math.log(p_false / (1.0 - p_false)))
        assert prior(episodes, False) == pytest.approx(math.log(1.0 - p_false))


def test_two_false_closures_continue_repeat_or_are_independent() -> None:
    episodes = episodes_of(2, seed=3)
    stays, alone, both = episodes.continues[1], (1.0 - REPEATED) * math.exp(-VOLUME), np.array([True, True])
    begins = (1.0 - stays) * SHARES
    for family, second in (
        ([0, 0], stays * (1.0 - SCATTERED) + begins * REPEATED),
        ([0, 1], stays * SCATTERED * math.exp(-VIEW) + begins * alone),
    ):
        expected = math.log(np.mean(SHARES * alone * second))
        assert episodes.log_prior(both, np.array(family)) == pytest.approx(expected)


def test_the_distance_of_episodes_is_that_of_the_nearest_earlier_closure() -> None:
    episodes = episodes_of(40, seed=5)
    ends = np.stack([episodes.claims.a, episodes.claims.b], axis=1)
    for k in range(1, len(ends)):
        gap = np.abs(ends[:k] - ends[k]).max(1).min()
        assert episodes.continues[k] == pytest.approx(math.exp(-max(gap, 1) / EPISODE))


def test_false_closures_that_claim_one_displacement_are_one_family() -> None:
    """True ones all claim that the world has not moved, so they are one family, too."""
    drive = ring(120, loops=30, false=20, seed=1)
    edges = np.flatnonzero(is_loop(drive.graph))
    episodes = Episodes.of(drive.graph, edges, OdometryChain.of(drive.graph), (VOLUME, VIEW), None)
    largest = episodes.families == np.bincount(episodes.families).argmax()
    assert largest[~drive.false[episodes.edges]].mean() > 0.9
    assert largest[drive.false[episodes.edges]].mean() < 0.2


def test_a_false_displacement_becomes_unlikely_with_the_path_that_it_covers() -> None:
    """That is what tells a late revisit from a place that looks like another one. The odometry is all but exact here,
    so closures agree equally well however far apart they are."""
    odds = []
    for spacing in (1, 3, 9):
        graph = late_revisit(spacing, 1e-6, 0, 2)
        edges = np.flatnonzero(is_loop(graph))[:11]
        episodes = Episodes.of(graph, edges, OdometryChain.of(graph), (VOLUME, VIEW), None)
        true, false = (prior(episodes, *[state] * 11) for state in (False, True))
        odds.append(true - false)
    assert odds[0] + 3.0 < odds[1] < odds[2] - 1.0


def test_false_closures_are_compared_on_corrected_poses() -> None:
    """The odometry turns between two false closures; poses without that error show that they claim the same."""
    graph = ring(60, 0, seed=2).graph
    shift, ends = se3.exp(np.array([[0.0, 0, 0.3, 8.0, 3.0, 0.0]]))[0], [(5, 40), (25, 55)]
    true = graph.world_from_body
    measured = np.array([se3.inverse(true[a]) @ shift @ true[b] for a, b in ends])
    odometry = graph.a_from_b.copy()
    odometry[45] = odometry[45] @ se3.exp(np.array([[0.0, 0, 1.0, 0, 0, 0]]))[0]
    graph = replace(
        graph, a=np.append(graph.a, [5, 25]).astype(np.int32), b=np.append(graph.b, [40, 55]).astype(np.int32),
        a_from_b=np.concatenate([odometry, measured]), kind=[*graph.kind, EdgeKind.LOOP, EdgeKind.LOOP],
        information=1e4 * np.concatenate([graph.information, graph.information[:2]]),
    )  # fmt: skip
    episodes = Episodes.of(graph, np.array([59, 60]), OdometryChain.of(graph), (VOLUME, VIEW), None)
    both = np.array([True, True])
    assert episodes.family(both).tolist() == [0, 1]
    assert episodes.family(both, episodes.claims.on(true)).tolist() == [0, 0]
