"""Questions: doubtful closures that move the map come first, neighbours are one question, decided ones are none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from tests.graph.drive import ring
from vplog.data import EdgeKind, PoseGraph
from vplog.geometry import se3
from vplog.graph.factors import Factors
from vplog.graph.least_squares import descend
from vplog.graph.questions import questions


def with_false_place(size: int = 4) -> tuple[PoseGraph, np.ndarray, np.ndarray]:
    """Two laps with true closures and a run of `size` false ones that agree, all of them believed: the graph at its
    solution, the weights, and which edges are false."""
    drive = ring(120, 16, seed=4)
    a, b = 20 + np.arange(size), 60 + np.arange(size)  # a third of a lap apart
    displaced = drive.true[a[0]] @ se3.inverse(drive.true[b[0]])
    graph = replace(
        drive.graph,
        a=np.concatenate([drive.graph.a, a]).astype(np.int32),
        b=np.concatenate([drive.graph.b, b]).astype(np.int32),
        a_from_b=np.concatenate([drive.graph.a_from_b, se3.between(drive.true[a], displaced @ drive.true[b])]),
        information=np.concatenate([drive.graph.information, drive.graph.information[-size:]]),
        kind=drive.graph.kind + [EdgeKind.LOOP] * size,
    )
    weight = np.ones(len(graph.a))
    poses = descend(Factors.of(graph), weight, graph.world_from_body, 100, 1e-4).world_from_body
    return replace(graph, world_from_body=poses), weight, np.arange(len(graph.a)) >= len(graph.a) - size


def test_a_false_place_is_one_question_doubted_where_it_is_believed_and_never_asked_again() -> None:
    graph, weight, false = with_false_place()
    nothing, none = np.zeros(len(weight)), np.zeros(len(weight), bool)
    found = questions(graph, weight, nothing, none)
    [place] = [one for one in found if false[one.edges].any()]
    np.testing.assert_array_equal(place.edges, np.flatnonzero(false))
    assert place.p_wrong > 0.9
    assert place.moved_m > 1.0
    expected_m = [one.expected_m for one in found]
    assert expected_m == sorted(expected_m, reverse=True)
    edges = np.concatenate([one.edges for one in found])
    assert sorted(edges.tolist()) == np.flatnonzero(~graph.odometry).tolist()  # each closure once
    without = np.where(false, 0.0, weight)
    [place] = [one for one in questions(graph, without, nothing, none) if false[one.edges].any()]
    assert place.p_wrong < 0.01
    assert place.moved_m > 1.0
    again = questions(graph, without, nothing, false)
    assert not false[np.concatenate([one.edges for one in again])].any()


def test_what_else_is_known_of_a_closure_counts() -> None:
    graph, weight, false = with_false_place()
    weight = np.where(false, 0.0, weight)
    odds = np.where(graph.odometry, 0.0, -6.0)
    plain, known = (
        {int(one.edges[0]): one.p_wrong for one in questions(graph, weight, given, np.zeros(len(weight), bool))}
        for given in (odds * 0.0, odds)
    )
    assert all(known[edge] <= plain[edge] for edge in plain if weight[edge] > 0)
    assert known[edge := int(np.flatnonzero(false)[0])] >= plain[edge]
