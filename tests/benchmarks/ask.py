"""Questions that a person answers until the map is as good as one that knows every answer.

Asked are those of `vplog ask`, random ones, and those of the lowest score first, ten at a time, after which the robust
solve goes on with the answers; an answer is for all closures of a run, whoever asks. The map is as good where its error
is at most 5 % above that with every answer, which is taken to be 2 % of the odometry's at least.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.benchmarks.graphs import aligned_error, bicocca_truth, false_by_gps, folder, with_groups
from tests.benchmarks.measure import Figure
from vplog.data import EdgeKind, PoseGraph
from vplog.graph.consistency import OdometryChain, odometry_chain
from vplog.graph.evidence import accidents, log_room
from vplog.graph.questions import questions
from vplog.graph.solve import GncSettings, LmSettings, decided
from vplog.graph.variance_components import claimed_times
from vplog.results.g2o import read_g2o

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from vplog.data import Bools, Floats, Ints

AT_ONCE = 10
WITHIN = 1.05
LEAST_SHARE = 0.02
THRESHOLDS = ("0.300", "0.500")
"""Of Bicocca's files: closures of the first, and of the score that the others pass."""
WAYS = ("ask", "random", "lowest score")


@dataclass(frozen=True, eq=False)
class Case:
    """A graph whose closures are known to be true or false."""

    name: str
    graph: PoseGraph
    false: Bools
    """(E,)."""
    score: Floats
    """(E,) of the recogniser."""
    error_m: Callable[[Floats], float]
    """Of poses (N, 4, 4)."""


def ask(most: int, seeds: int) -> Iterator[Figure]:
    """Questions needed by `vplog ask` as a share of those by each other way, and the curves of them."""
    for case in cases(seeds):
        yield from compared(case, most)


def cases(seeds: int) -> Iterator[Case]:
    """Bicocca 25b with the false closures of its recogniser, and KITTI 00 with places made that look alike."""
    place = folder() / "rrr" / "B25b"
    if place.is_dir():
        known, places = bicocca_truth(place)
        first, *others = (read_g2o(place / f"B25b_{one}.g2o").graph for one in THRESHOLDS)
        loops = np.flatnonzero(~first.odometry)
        false, score = np.zeros(len(first.a), bool), np.zeros(len(first.a))
        false[loops] = false_by_gps(first, loops, known, places)
        for other in others:
            pairs = set(zip(other.a.tolist(), other.b.tolist(), strict=True))
            score += [pair in pairs for pair in zip(first.a.tolist(), first.b.tolist(), strict=True)]
        yield Case(
            f"B25b {THRESHOLDS[0]}", first, false, score, lambda poses: aligned_error(poses[known], places[known])
        )
    path = folder() / "SE-Sync" / "kitti_00.g2o"
    for seed in range(seeds if path.is_file() else 0):
        clean = read_g2o(path).graph
        optimum = LmSettings()(clean).world_from_body
        graph, false = with_groups(clean, optimum, 5, 10, seed)
        # as a recogniser has them whose false answers are alike: half a sigma apart
        score = np.random.default_rng(seed).normal(size=len(false)) - 0.5 * false
        yield Case(
            f"kitti_00, 5 false places, seed {seed}", graph, false, score,
            lambda poses, optimum=optimum: aligned_error(poses, optimum),
        )  # fmt: skip


def compared(case: Case, most: int) -> Iterator[Figure]:
    """The figures of a case, each way asking at most so many questions."""
    odometry = case.error_m(odometry_chain(case.graph)[0])
    everything = np.where(case.graph.odometry, 0, np.where(case.false, -1, 1))
    goal = WITHIN * max(case.error_m(_solved(case.graph, everything)[0].world_from_body), LEAST_SHARE * odometry)
    curves = {way: curve(case, way, most, goal) for way in WAYS}
    needed = {way: _needed(one, goal) for way, one in curves.items()}
    facts: dict[str, Any] = {"odometry_m": round(odometry, 3), "goal_m": round(goal, 3), "false": int(case.false.sum())}
    facts |= {"closures": int((~case.graph.odometry).sum()), "needed": needed, "curves_m": curves}
    for way in WAYS[1:]:
        ratio = (needed[WAYS[0]] or 1) / max(needed[way] or 2 * most, 1)
        yield Figure(f"{case.name}: questions of {WAYS[0]} to those of {way}", ratio, 1.0, True, facts)


def _needed(errors: list[float], goal: float) -> int | None:
    """Questions after which the error first is at the goal; None where it never is."""
    return next((AT_ONCE * at for at, error in enumerate(errors) if error <= goal), None)


def curve(case: Case, way: str, most: int, goal: float) -> list[float]:
    """Errors in m after none, ten, twenty .. questions, up to the goal."""
    answer = np.zeros(len(case.graph.a), np.int64)  # 1 true, -1 false
    random = np.random.default_rng(0)
    errors: list[float] = []
    while True:
        graph, weight = _solved(case.graph, answer)
        errors.append(round(case.error_m(graph.world_from_body), 4))
        if errors[-1] <= goal or AT_ONCE * len(errors) > most:
            return errors
        runs = _runs(case, way, graph, weight, answer, random)
        if not runs:
            return errors
        for run in runs[:AT_ONCE]:
            answer[run] = -1 if case.false[run].mean() > 0.5 else 1


def _runs(
    case: Case, way: str, graph: PoseGraph, weight: Floats, answer: Ints, random: np.random.Generator
) -> list[Ints]:
    """The runs of closures in the order in which they are asked about."""
    if way == "ask":
        return [one.edges for one in questions(graph, weight, np.zeros(len(weight)), answer != 0)]
    chain = OdometryChain.of(graph)
    loops = np.flatnonzero(~graph.odometry)
    runs = [run for run in accidents(graph, loops, chain, log_room(graph, chain.poses)) if not answer[run].any()]
    runs = [runs[at] for at in random.permutation(len(runs))]
    return runs if way == "random" else sorted(runs, key=lambda run: float(case.score[run].mean()))


def _solved(graph: PoseGraph, answer: Ints) -> tuple[PoseGraph, Floats]:
    """The graph at the robust solution with these answers, with the noise that it found, and the weights (E,)."""
    kind = [EdgeKind.KNOWN_LOOP if one > 0 else was for one, was in zip(answer.tolist(), graph.kind, strict=True)]
    asked = np.flatnonzero(answer >= 0)
    some = replace(
        graph,
        a=graph.a[asked],
        b=graph.b[asked],
        a_from_b=graph.a_from_b[asked],
        information=graph.information[asked],
        kind=[kind[edge] for edge in asked.tolist()],
    )
    found = decided(some, GncSettings())
    weight = np.zeros(len(answer))
    weight[asked] = found.solution.weight > 0.5
    solved = claimed_times(replace(graph, kind=kind), found.sigmas)
    return replace(solved, world_from_body=found.solution.world_from_body), weight
