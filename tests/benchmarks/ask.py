"""Questions that a person answers until the map is as good as one that knows every answer.

Asked are those of `vplog ask`, random ones, and those of the lowest score first, three at a time, after which the
robust solve goes on with the answers; an answer is for all closures of a run, whoever asks. The map is as good where
its error is at most 5 % above that with every answer, which is taken to be 2 % of the odometry's at least. Of the poses
without a closure one in 25 is left, joined by the odometry between, so that a solve takes seconds.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from tests.benchmarks.graphs import aligned_error, bicocca_truth, false_by_gps, folder
from tests.benchmarks.measure import Figure
from vplog.data import EdgeKind, PoseGraph
from vplog.geometry import se3
from vplog.graph.build import AXES
from vplog.graph.consistency import OdometryChain, odometry_chain, runs
from vplog.graph.factors import Factors
from vplog.graph.posterior import Posterior
from vplog.graph.questions import questions
from vplog.graph.solve import GncSettings, LmSettings, decided
from vplog.graph.variance_components import Sigmas, claimed_times
from vplog.results import tables
from vplog.results.g2o import read_g2o

if TYPE_CHECKING:
    from collections.abc import Iterator, Sequence
    from pathlib import Path

    from vplog.data import Bools, Floats, Ints

AT_ONCE = 3
"""The verb asks ten; fewer tell the ways apart."""
STRIDE = 25
MISPLACED_M = (2.0, 6.0)
RUN, FALSE_RUNS, DRIFT = 12, 6, 0.05
"""Closures of a run that is put in, such runs, and drift of the odometry as a share of the path."""
WITHIN = 1.05
LEAST_SHARE = 0.02
THRESHOLDS = ("0.150", "0.300", "0.500")
"""Least score of the closures of Bicocca's files: all that is known of the score of each."""
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
    truth: Floats
    """(N, 4, 4), NaN where it is not known."""

    def error_m(self, poses: Floats) -> float:
        known = np.isfinite(self.truth[:, 0, 3])
        return aligned_error(poses[known], self.truth[known])


def ask(most: int, seeds: int, runs: Sequence[Path] = ()) -> Iterator[Figure]:
    """Questions needed by `vplog ask` as a share of those by each other way, and the curves of them."""
    for case in cases(seeds, runs):
        yield from compared(case, most)


def cases(seeds: int, runs: Sequence[Path]) -> Iterator[Case]:
    """Finished runs and KITTI 00 with places like their neighbours, Bicocca 25b with the false closures of its
    recogniser."""
    for run in runs:
        _, poses = tables.read_keyframes(run / "keyframes.parquet")
        graph, weight, _ = tables.read_edges(run / "edges.parquet", poses)
        kept = graph.odometry | (weight > 0.5)
        graph = replace(
            graph, a=graph.a[kept], b=graph.b[kept], a_from_b=graph.a_from_b[kept],
            information=graph.information[kept], kind=[graph.kind[edge] for edge in np.flatnonzero(kept).tolist()],
        )  # fmt: skip
        for seed in range(seeds):
            yield _with_false(f"{run.name}, false runs put in", graph, *injected(graph, seed), seed)
    path = folder() / "SE-Sync" / "kitti_00.g2o"
    for seed in range(seeds if path.is_file() else 0):
        clean = read_g2o(path).graph
        yield _with_false("kitti_00, places misplaced", clean, *misplaced(clean, seed), seed)
    place = folder() / "rrr" / "B25b"
    if place.is_dir():
        yield from _bicocca(place)


def _with_false(name: str, clean: PoseGraph, graph: PoseGraph, false: Bools, seed: int) -> Case:
    optimum = LmSettings()(clean).world_from_body
    # as of a recogniser whose false answers are alike: half a sigma apart
    score = np.random.default_rng(seed).normal(size=len(false)) - 0.5 * false
    return coarse(Case(f"{name}, seed {seed}", graph, false, score, optimum))


def _bicocca(place: Path) -> Iterator[Case]:
    known, places = bicocca_truth(place)
    graphs = [read_g2o(place / f"B25b_{one}.g2o").graph for one in THRESHOLDS]
    truth = np.where(known[:, None, None], places, np.nan)
    for at, graph in enumerate(graphs):
        loops = np.flatnonzero(~graph.odometry)
        false, score = np.zeros(len(graph.a), bool), np.zeros(len(graph.a))
        false[loops] = false_by_gps(graph, loops, known, places)
        for other in graphs[at + 1 :]:
            pairs = set(zip(other.a.tolist(), other.b.tolist(), strict=True))
            score += [pair in pairs for pair in zip(graph.a.tolist(), graph.b.tolist(), strict=True)]
        yield coarse(Case(f"B25b {THRESHOLDS[at]}", graph, false, score, truth))


def misplaced(graph: PoseGraph, seed: int) -> tuple[PoseGraph, Bools]:
    """The graph with a third of the places taken for one that lies some metres on or back, as facades and aisles are:
    all closures of a place agree, and the odometry would stand it. Which edges (E,) are."""
    random, chain = np.random.default_rng(seed), OdometryChain.of(graph)
    places = _places(graph)
    a_from_b, false = graph.a_from_b.copy(), np.zeros(len(graph.a), bool)
    forward = se3.between(chain.poses[:-1], chain.poses[1:])[:, :3, 3]
    for at in random.choice(len(places), -(-len(places) // 3), replace=False).tolist():
        run = places[at]
        way = forward[np.minimum(graph.a[run], len(forward) - 1)]
        way = way / np.linalg.norm(way, axis=1, keepdims=True)
        a_from_b[run, :3, 3] += random.choice([-1.0, 1.0]) * random.uniform(*MISPLACED_M) * way
        false[run] = True
    return replace(graph, a_from_b=a_from_b), false


def injected(graph: PoseGraph, seed: int) -> tuple[PoseGraph, Bools]:
    """The graph with runs of closures between places that are not one, as of streets that look alike: those of a run
    agree with each other, and the odometry, which may drift by `DRIFT` of the path, would stand it. Which edges (E,)
    are."""
    random, chain = np.random.default_rng(seed), OdometryChain.of(graph)
    at = chain.poses[:, :3, 3]
    along_m = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(at, axis=0), axis=1))])
    first = np.arange(0, len(at) - RUN, 5)
    apart_m = np.linalg.norm(at[first, None] - at[None, first], axis=2)
    path_m = along_m[None, first] - along_m[first, None]
    solved = graph.world_from_body[first, :3, 3]
    true_m = np.linalg.norm(solved[:, None] - solved[None], axis=2)
    pairs = np.argwhere((path_m > 50.0) & (apart_m < DRIFT * path_m) & (true_m > 5.0))
    loops = np.flatnonzero(~graph.odometry)
    a, b, a_from_b = [], [], []
    for here, there in first[pairs[random.choice(len(pairs), min(FALSE_RUNS, len(pairs)), replace=False)]].tolist():
        same = se3.between(chain.poses[here], chain.poses[there])
        same[:3, 3] = random.normal(size=3)
        run = np.arange(RUN)
        a.append(here + run)
        b.append(there + run)
        to = se3.between(chain.poses[there], chain.poses[there + run])
        a_from_b.append(se3.between(chain.poses[here + run], chain.poses[here]) @ same @ to)
    count = RUN * len(a)
    graph = replace(
        graph,
        a=np.concatenate([graph.a, *a]).astype(np.int32),
        b=np.concatenate([graph.b, *b]).astype(np.int32),
        a_from_b=np.concatenate([graph.a_from_b, *a_from_b]),
        information=np.concatenate([graph.information, graph.information[random.choice(loops, count)]]),
        kind=[*graph.kind, *[EdgeKind.LOOP] * count],
    )
    return graph, np.arange(len(graph.a)) >= len(graph.a) - count


def coarse(case: Case) -> Case:
    """The case with fewer poses: the ends of closures, and one in `STRIDE` of the others."""
    graph, count = case.graph, len(case.truth)
    chain, loops = OdometryChain.of(graph), np.flatnonzero(~graph.odometry)
    rows = np.unique(np.concatenate([np.arange(0, count, STRIDE), [count - 1], graph.a[loops], graph.b[loops]]))
    a, b = rows[:-1].astype(np.int32), rows[1:].astype(np.int32)
    axes = np.array(AXES[graph.dimension])
    information = np.zeros((len(a), 6, 6))
    information[:, axes[:, None], axes] = np.linalg.inv(chain.covariance(a, b))
    fewer = replace(
        graph,
        world_from_body=chain.poses[rows],
        a=np.searchsorted(rows, np.concatenate([a, graph.a[loops]])).astype(np.int32),
        b=np.searchsorted(rows, np.concatenate([b, graph.b[loops]])).astype(np.int32),
        a_from_b=np.concatenate([se3.between(chain.poses[a], chain.poses[b]), graph.a_from_b[loops]]),
        information=np.concatenate([information, graph.information[loops]]),
        kind=[EdgeKind.ODOMETRY] * len(a) + [EdgeKind.LOOP] * len(loops),
    )
    none = np.zeros(len(a))
    false, score = (np.concatenate([none, one[loops].astype(float)]) for one in (case.false, case.score))
    return replace(case, graph=fewer, false=false > 0, score=score, truth=case.truth[rows])


def compared(case: Case, most: int) -> Iterator[Figure]:
    """The figures of a case, each way asking at most so many questions."""
    odometry = case.error_m(odometry_chain(case.graph)[0])
    everything = np.where(case.graph.odometry, 0, np.where(case.false, -1, 1))
    goal = WITHIN * max(case.error_m(_solved(case.graph, everything)[0].world_from_body), LEAST_SHARE * odometry)
    unasked = _solved(case.graph, np.zeros(len(everything), np.int64))
    curves = {way: curve(case, way, most, goal, unasked) for way in WAYS}
    needed = {way: _needed(one, goal) for way, one in curves.items()}
    facts: dict[str, Any] = {"odometry_m": round(odometry, 3), "goal_m": round(goal, 3), "false": int(case.false.sum())}
    facts |= {"closures": int((~case.graph.odometry).sum()), "needed": needed, "curves_m": curves}
    count = {way: 2 * most if one is None else max(one, 1) for way, one in needed.items()}
    for way in WAYS[1:]:
        ratio = count[WAYS[0]] / count[way]
        yield Figure(f"{case.name}: questions of {WAYS[0]} to those of {way}", ratio, 1.0, True, facts)


def _needed(errors: list[float], goal: float) -> int | None:
    """Questions after which the error first is at the goal; None where it never is."""
    return next((AT_ONCE * at for at, error in enumerate(errors) if error <= goal), None)


def curve(case: Case, way: str, most: int, goal: float, unasked: tuple[PoseGraph, Floats]) -> list[float]:
    """Errors in m after none, three, six .. questions, up to the goal; `unasked` is solved without answers."""
    answer = np.zeros(len(case.graph.a), np.int64)  # 1 true, -1 false
    random = np.random.default_rng(0)
    errors: list[float] = []
    while True:
        graph, weight = _solved(case.graph, answer) if errors else unasked
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
    unknown = [run for run in _places(graph) if not answer[run].any()]
    unknown = [unknown[at] for at in random.permutation(len(unknown))]
    return unknown if way == "random" else sorted(unknown, key=lambda run: float(case.score[run].mean()))


def _places(graph: PoseGraph) -> list[Ints]:
    """Runs of closures that claim one displacement."""
    episodes = Posterior.of(Factors.of(graph), Sigmas()).episodes
    families = [episodes.edges[episodes.families == number] for number in range(episodes.families.max() + 1)]
    return [run for family in families for run in runs(graph, family)]


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
