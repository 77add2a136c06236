"""Closures that are all false alike are not half believed; a few false ones among true ones change nothing."""

from __future__ import annotations

from dataclasses import replace
from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.graph.drive import ring
from vplog.graph.consistency import is_loop, keep_odometry_if_worse, odometry_chain
from vplog.graph.cross_check import CrossCheckSettings, cross_checked
from vplog.graph.solve import GncSettings

if TYPE_CHECKING:
    from vplog.data import PoseGraph


def poisoned(off_m: float) -> PoseGraph:
    """Forty closures, every one claiming to stand so far to the side of where it does."""
    graph = ring(120, loops=40, seed=1).graph
    measured = graph.a_from_b.copy()
    aside = np.eye(4)
    aside[0, 3] = off_m
    measured[is_loop(graph)] = aside @ measured[is_loop(graph)]
    return replace(graph, a_from_b=measured)


def gated(graph: PoseGraph) -> tuple[np.ndarray, str]:
    solution = cross_checked(graph, keep_odometry_if_worse(graph, GncSettings()(graph)), CrossCheckSettings())
    return solution.world_from_body, solution.reason


@pytest.mark.parametrize(
    ("off_m", "why"),
    [(0.7, "robust methods disagree about the 40"), (1.1, "closures its chi-square"), (3.0, "none of the 40")],
)
def test_poisoned_closures_leave_the_odometry_and_a_sentence(off_m: float, why: str) -> None:
    graph = poisoned(off_m)
    poses, reason = gated(graph)
    np.testing.assert_array_equal(poses, odometry_chain(graph)[0])
    assert reason.startswith("Odometry was kept: ")
    assert why in reason


def test_it_is_the_cross_check_that_tells() -> None:
    graph = poisoned(0.7)
    solution = keep_odometry_if_worse(graph, GncSettings()(graph))
    assert 0 < solution.weight[is_loop(graph)].sum() < 36
    assert cross_checked(graph, solution, CrossCheckSettings(use=False)) is solution
    assert cross_checked(graph, solution, CrossCheckSettings(rejected_share=0.9)) is solution


@pytest.mark.parametrize("false", [0, 2, 8, 20])
def test_false_closures_among_true_ones_do_not_cost_the_true_ones(false: int) -> None:
    graph = ring(120, loops=40, false=false, seed=2).graph
    solution = keep_odometry_if_worse(graph, GncSettings()(graph))
    assert cross_checked(graph, solution, CrossCheckSettings()) is solution
    assert solution.weight[is_loop(graph)].sum() >= 38
