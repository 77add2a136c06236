"""The benchmark of pose graphs runs, on next to nothing and without a look at the clock."""

from __future__ import annotations

import time
from typing import TYPE_CHECKING

import numpy as np

from tests.benchmarks import graphs as benchmark
from tests.benchmarks.ask import WAYS, Case, coarse, compared
from tests.benchmarks.large_graphs import _solved, drives
from vplog.graph.build import parts
from vplog.graph.consistency import is_loop
from vplog.results.g2o import write_g2o

if TYPE_CHECKING:
    from pathlib import Path

    import pytest

CITY = benchmark.city(120, seed=1)


def test_a_city_has_closures_and_is_the_same_twice() -> None:
    again = benchmark.city(120, seed=1)
    np.testing.assert_array_equal(CITY.a_from_b, again.a_from_b)
    assert is_loop(CITY).sum() >= 10


def test_false_closures_are_as_many_and_as_they_should_be() -> None:
    loops = int(is_loop(CITY).sum())
    graph, false = benchmark.spoiled(CITY, 0.5, 0)
    assert false.sum() == round(loops / 2)
    np.testing.assert_array_equal(graph.a_from_b[~false], CITY.a_from_b[~false])
    graph, false = benchmark.with_strangers(CITY, 0.8, 0)
    assert false.sum() == 4 * loops
    graph, false = benchmark.with_groups(CITY, CITY.world_from_body, 2, 5, 0)
    assert false.sum() == 10
    assert len(graph.kind) == len(graph.a) == len(CITY.a) + 10


def test_every_figure_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "posegraphs" / "SE-Sync").mkdir(parents=True)
    write_g2o(tmp_path / "posegraphs" / "SE-Sync" / "intel.g2o", CITY, CITY.world_from_body)
    write_g2o(tmp_path / "posegraphs" / "SE-Sync" / "city10000.g2o", CITY, CITY.world_from_body)
    monkeypatch.setenv("VPLOG_DATA", str(tmp_path))
    monkeypatch.setattr(benchmark, "SHARES", (0.1,))
    monkeypatch.setattr(benchmark, "GROUPS", (5,))
    monkeypatch.setattr(benchmark, "ATE_BARS", {"intel": (0.5,)})
    figures = list(benchmark.graphs(seeds=1, rounds=1, methods=("gnc", "lm"), sizes=(150,)))
    names = " ".join(figure.name for figure in figures)
    for part in ("random", "added", "groups of 5", "city10000", "a city of 150 poses"):
        assert part in names
    assert figures[0].passed
    assert figures[0].facts["gnc"]["false_kept"] == [0]
    assert figures[-1].facts["error"] <= figures[-1].facts["error_of_bare"] * (1 + 1e-4)


def test_questions_bring_a_map_near_the_one_that_knows_all() -> None:
    graph, false = benchmark.with_groups(CITY, CITY.world_from_body, 2, 5, 0)
    case = coarse(Case("city", graph, false, 0.0 * false, CITY.world_from_body))
    figures = list(compared(case, 3))
    assert [figure.name for figure in figures] == [f"city: questions of ask to those of {way}" for way in WAYS[1:]]
    facts = figures[0].facts
    assert facts["false"] == 10
    for way in WAYS:
        assert len(facts["curves_m"][way]) <= 2
        assert (facts["needed"][way] is None) == (facts["curves_m"][way][-1] > facts["goal_m"])


def test_drives_are_joined_by_closures_alone() -> None:
    graph, again = drives(900, each=300), drives(900, each=300)
    np.testing.assert_array_equal(graph.a_from_b, again.a_from_b)
    odometry = ~is_loop(graph)
    assert odometry.sum() == 897
    assert (graph.a[odometry] // 300 == graph.b[odometry] // 300).all()
    assert (graph.a // 300 != graph.b // 300).any()
    assert not parts(900, graph.a, graph.b).any()


def test_a_large_solve_is_told_of() -> None:
    assert _solved("city", 120, "lm")["loops"] == is_loop(benchmark.city(120)).sum()


def test_a_call_is_ended_at_its_limit() -> None:
    spent, told = benchmark.apart(sorted, ([3, 1, 2],), 600.0)
    assert told == [1, 2, 3]
    assert spent < 600.0
    assert benchmark.apart(time.sleep, (60.0,), 0.1) == (0.1, None)
