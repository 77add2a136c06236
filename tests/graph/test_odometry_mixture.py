from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.benchmarks.graphs import city, spoiled, with_strangers
from tests.graph.drive import ring
from vplog.data import EdgeKind
from vplog.graph.consistency import OdometryChain, is_loop
from vplog.graph.odometry_mixture import modes
from vplog.graph.variance_components import Sigmas

CITY = city(1500, seed=2)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_true_and_false_are_told_apart(share: float) -> None:
    graph, false = with_strangers(CITY, share, seed=0)
    loops = np.flatnonzero(is_loop(graph))
    sigmas, true = modes(graph, loops, OdometryChain.of(graph))[0]
    assert true[~false[loops]].mean() > 0.95
    assert true[false[loops]].mean() < 0.1
    assert 0.5 <= sigmas.translation <= 2.0


@pytest.mark.parametrize("factor", [1 / 8, 1 / 4, 4.0])
def test_sigmas_claimed_wrongly_are_found_and_change_little(factor: float) -> None:
    graph, _ = spoiled(CITY, 0.5, seed=1)
    odometry = ~is_loop(graph)
    information = graph.information * np.where(odometry, factor**2, 1.0)[:, None, None]
    (honest, expected), (sigmas, true) = (
        modes(one, np.flatnonzero(~odometry), OdometryChain.of(one))[0]
        for one in (graph, replace(graph, information=information))
    )
    assert factor / 2.0 <= sigmas.translation / honest.translation <= factor * 2.0
    assert (true != expected).mean() < 0.02


def test_spatial_drives_too() -> None:
    drive = ring(loops=20, false=20)
    loops = np.flatnonzero(is_loop(drive.graph))
    np.testing.assert_array_equal(modes(drive.graph, loops, OdometryChain.of(drive.graph))[0][1], ~drive.false[loops])


def test_closures_between_pieces_of_odometry_pass() -> None:
    graph = ring(50, 8).graph
    kind = list(graph.kind)
    kind[20] = EdgeKind.LOOP
    graph = replace(graph, kind=kind)
    loops = np.flatnonzero(is_loop(graph))
    across = (graph.a[loops] <= 20) & (graph.b[loops] > 20)
    assert modes(graph, loops, OdometryChain.of(graph))[0][1][across].all()
    [(sigmas, true)] = modes(graph, loops[across], OdometryChain.of(graph))
    assert sigmas == Sigmas()
    assert true.all()
