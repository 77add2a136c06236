from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from tests.benchmarks.graphs import city, spoiled, with_strangers
from tests.graph.drive import ring
from vplog.data import EdgeKind
from vplog.graph.consistency import is_loop
from vplog.graph.odometry_mixture import agreement

CITY = city(1500, seed=2)


@pytest.mark.parametrize("share", [0.1, 0.5, 0.9])
def test_true_and_false_are_told_apart_and_counted(share: float) -> None:
    graph, false = with_strangers(CITY, share, seed=0)
    loops = np.flatnonzero(is_loop(graph))
    found = agreement(graph, loops)
    wrong = false[loops]
    assert found.share == pytest.approx(1 - share, abs=0.05)
    assert found.probability[~wrong].mean() > 0.95
    assert found.probability[wrong].mean() < 0.1
    assert found.odometry_scale == pytest.approx(1.0, rel=0.5)


@pytest.mark.parametrize("factor", [1 / 16, 1 / 4, 4.0])
def test_noise_said_wrong_is_found_and_changes_little(factor: float) -> None:
    graph, _ = spoiled(CITY, 0.5, seed=1)
    loops = np.flatnonzero(is_loop(graph))
    honest = agreement(graph, loops)
    found = agreement(replace(graph, information=graph.information * factor**2), loops)
    assert found.odometry_scale == pytest.approx(factor * honest.odometry_scale, rel=0.01)
    np.testing.assert_allclose(found.probability, honest.probability, atol=0.01)


def test_spatial_drives_too() -> None:
    drive = ring(loops=20, false=20)
    loops = np.flatnonzero(is_loop(drive.graph))
    found = agreement(drive.graph, loops)
    np.testing.assert_array_equal(found.probability > 0.5, ~drive.false[loops])


def test_where_odometry_does_not_lead_nothing_is_said() -> None:
    graph = ring(50, 8).graph
    kind = list(graph.kind)
    kind[20] = EdgeKind.LOOP
    graph = replace(graph, kind=kind)
    loops = np.flatnonzero(is_loop(graph))
    across = (graph.a[loops] <= 20) & (graph.b[loops] > 20)
    assert (agreement(graph, loops).probability[across] == 1).all()
    everywhere = agreement(graph, loops[across])
    assert (everywhere.odometry_scale, everywhere.loop_scale, everywhere.share) == (1, 1, 1)
