"""Pose graphs with false closures, real and made, by every method; and the time a solve takes beside bare GTSAM."""

from __future__ import annotations

import os
import statistics
import tempfile
import time
from collections import Counter
from dataclasses import replace
from multiprocessing import get_context
from pathlib import Path
from queue import Empty
from typing import TYPE_CHECKING, Any

import gtsam
import numpy as np
from pydantic import TypeAdapter

from tests.benchmarks.measure import Figure, in_turns, seconds
from vplog.data import Bools, EdgeKind, Floats, Ints, PoseGraph
from vplog.geometry import se3
from vplog.graph.consistency import is_loop, odometry_chain
from vplog.graph.solve import LmSettings, OptimiserSettings, decided
from vplog.results.g2o import read_g2o, write_g2o

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator, Sequence

    from vplog.data import Floats, Solution

METHODS = ("gnc", "pcm", "dcs", "cauchy", "geman_mcclure", "lm")
SHARES = (0.1, 0.5, 0.7, 0.8, 0.9)
ATE_BARS = {"intel": (0.015, 0.036, 0.04, 0.05, 0.05), "CSAIL": (0.012, 0.045, 0.07, 0.09, 0.09)}
"""m, of gnc, at each of the shares."""
GROUPS = (5, 10, 20)
COSTS = {
    "torus3D": 12118.0,
    "sphere2500": 675.701,
    "city10000": 255.994,
    "parking-garage": 0.6342,
    "kitti_00": 49.161,
}
"""Error, half the chi-square, that least squares is known to reach."""
TIME_BAR = 1.5
BICOCCA_BAR = 1.1
SIZES = (1_000, 10_000, 100_000)
TURNS_POSES = 20_000
"""Largest made graph that is solved in turns, and robustly too. Bare GTSAM takes minutes on larger ones, so it has one
try there; large_graphs.py times the robust solve of these."""
BARE_LIMIT_S = 900.0
"""After which bare GTSAM is ended there."""


def folder() -> Path:
    return Path(os.environ.get("VPLOG_DATA", Path(__file__).parents[3] / "shared" / "data")) / "posegraphs"


def method(kind: str) -> Any:
    return TypeAdapter(OptimiserSettings).validate_python({"kind": kind})


def graphs(seeds: int, rounds: int, methods: Sequence[str] = METHODS, sizes: Sequence[int] = SIZES) -> Iterator[Figure]:
    """Every figure that the public graphs at hand allow, and the times on made ones."""
    public = folder() / "SE-Sync"
    for name, bars in ATE_BARS.items():
        if (public / f"{name}.g2o").is_file():
            yield from outliers(name, read_g2o(public / f"{name}.g2o").graph, SHARES, bars, seeds, methods)
    yield from bicocca(folder() / "rrr" / "B25b", methods)
    for name, cost in COSTS.items():
        if (public / f"{name}.g2o").is_file():
            yield least_squares_time(name, public / f"{name}.g2o", cost, TIME_BAR, rounds)
    for size in sizes:
        yield made_time(size, min(rounds, 3))


# --- false closures made --------------------------------------------------------------------------------------------


def spoiled(graph: PoseGraph, share: float, seed: int) -> tuple[PoseGraph, np.ndarray]:
    """The graph with a share of its closures measured at random, and which (E,) they are.

    Shifts are uniform over a box half as wide as the map either way, turns over the circle.
    """
    random = np.random.default_rng(seed)
    loops = np.flatnonzero(is_loop(graph))
    false = random.choice(loops, round(share * len(loops)), replace=False)
    measured = np.array(graph.a_from_b)
    measured[false] = _anywhere(random, len(false), np.ptp(odometry_chain(graph)[0][:, :2, 3], axis=0))
    wrong = np.zeros(len(graph.a), bool)
    wrong[false] = True
    return replace(graph, a_from_b=measured), wrong


def with_strangers(graph: PoseGraph, share: float, seed: int) -> tuple[PoseGraph, np.ndarray]:
    """The graph with random closures between random poses added, until they are this share of all."""
    random = np.random.default_rng(seed)
    loops = np.flatnonzero(is_loop(graph))
    count = round(len(loops) * share / (1 - share))
    a, b = np.sort(random.integers(0, len(graph.world_from_body) - 20, (2, count)), axis=0)
    measured = _anywhere(random, count, np.ptp(odometry_chain(graph)[0][:, :2, 3], axis=0))
    return _added(graph, a, b + 20, measured, random)


def with_groups(graph: PoseGraph, truth: Floats, count: int, size: int, seed: int) -> tuple[PoseGraph, np.ndarray]:
    """The graph with groups of false closures that agree: `size` poses in a row look like another `size` in a row.

    What the robot sees is displaced as one, so within a group every two closures are consistent; places are at least
    3 m apart in truth (N, 4, 4) and claimed to be one, give or take 0.3 m and 10 degrees.
    """
    random = np.random.default_rng(seed)
    starts, ends, measured = [], [], []
    while len(starts) < count:
        a, b = np.sort(random.integers(0, len(truth) - size, 2))
        if b - a < size + 20 or np.linalg.norm(truth[a, :3, 3] - truth[b, :3, 3]) < 3.0:
            continue
        near = _planar(random.normal(0, 0.3, 1), random.normal(0, 0.3, 1), random.normal(0, np.radians(10), 1))[0]
        rows = np.arange(size)
        displaced = truth[a] @ near @ se3.inverse(truth[b])
        starts.append(a + rows)
        ends.append(b + rows)
        measured.append(se3.between(truth[a + rows], displaced @ truth[b + rows]))
    return _added(graph, np.concatenate(starts), np.concatenate(ends), np.concatenate(measured), random)


def _added(
    graph: PoseGraph, a: np.ndarray, b: np.ndarray, measured: Floats, random: np.random.Generator
) -> tuple[PoseGraph, np.ndarray]:
    like = random.choice(np.flatnonzero(is_loop(graph)), len(a))
    grown = replace(
        graph,
        a=np.concatenate([graph.a, a]).astype(np.int32),
        b=np.concatenate([graph.b, b]).astype(np.int32),
        a_from_b=np.concatenate([graph.a_from_b, measured]),
        information=np.concatenate([graph.information, graph.information[like]]),
        kind=graph.kind + [EdgeKind.LOOP] * len(a),
    )
    return grown, np.arange(len(grown.a)) >= len(graph.a)


def _anywhere(random: np.random.Generator, count: int, extent: np.ndarray) -> Floats:
    x, y = (random.uniform(-side / 2, side / 2, count) for side in extent)
    return _planar(x, y, random.uniform(-np.pi, np.pi, count))


def _planar(x: np.ndarray, y: np.ndarray, yaw: np.ndarray) -> Floats:
    zero = np.zeros(len(x))
    return se3.pose(se3.so3_exp(np.stack([zero, zero, yaw], axis=1)), np.stack([x, y, zero], axis=1))


def aligned_error(estimate: Floats, truth: Floats) -> float:
    """Root mean square distance of positions in m, after the best rigid alignment."""
    moved, _ = se3.umeyama(estimate[:, :3, 3], truth[:, :3, 3])
    away = se3.transform(moved, estimate[:, :3, 3]) - truth[:, :3, 3]
    return float(np.sqrt((away**2).sum(1).mean()))


def outliers(
    name: str, graph: PoseGraph, shares: Sequence[float], bars: Sequence[float], seeds: int, methods: Sequence[str]
) -> Iterator[Figure]:
    """Median error against the optimum without false closures, which is what least squares finds on the clean graph."""
    optimum = LmSettings()(graph).world_from_body
    for share, bar in zip(shares, bars, strict=True):
        cases = [spoiled(graph, share, seed) for seed in range(seeds)]
        yield from _judged(f"{name}, {share:.0%} of the closures random", cases, optimum, methods, bar, share <= 0.8)
    for share in shares:
        cases = [with_strangers(graph, share, seed) for seed in range(seeds)]
        # the others take minutes on so many
        yield from _judged(f"{name}, random closures added to {share:.0%}", cases, optimum, methods[:1], None, False)
    for size in GROUPS:
        for count in (1, 5):
            cases = [with_groups(graph, optimum, count, size, seed) for seed in range(seeds)]
            yield from _judged(f"{name}, {count} groups of {size} that agree", cases, optimum, methods, bars[0], False)


def _judged(
    what: str,
    cases: list[tuple[PoseGraph, np.ndarray]],
    optimum: Floats,
    methods: Sequence[str],
    bar: float | None,
    keeps_all: bool,
) -> Iterator[Figure]:
    facts: dict[str, Any] = {}
    for kind in methods:
        found = [_one(graph, false, method(kind), optimum) for graph, false in cases]
        facts[kind] = {
            "ate_m": round(statistics.median(one["ate_m"] for one in found), 4),
            "worst_m": round(max(one["ate_m"] for one in found), 4),
            "true_rejected": [one["true_rejected"] for one in found],
            "false_kept": [one["false_kept"] for one in found],
            "seconds": round(statistics.median(one["seconds"] for one in found), 2),
        }
    first = facts[methods[0]]
    yield Figure(f"{what}: error of {methods[0]} in m", first["ate_m"], bar, True, facts)
    if keeps_all:
        yield Figure(f"{what}: true ones rejected", max(first["true_rejected"]), 0, True)


def _one(graph: PoseGraph, false: np.ndarray, optimiser: Any, optimum: Floats) -> dict[str, Any]:
    solved: list[Solution] = []
    spent = seconds(lambda: solved.append(decided(graph, optimiser).solution), time.perf_counter)
    kept = solved[0].weight > 0.5
    return {
        "ate_m": aligned_error(solved[0].world_from_body, optimum),
        "true_rejected": int((is_loop(graph) & ~false & ~kept).sum()),
        "false_kept": int((false & kept).sum()),
        "seconds": spent,
    }


# --- false closures as a recogniser makes them ----------------------------------------------------------------------


def bicocca_truth(place: Path) -> tuple[Bools, Floats]:
    """Which poses (N,) have a place by GPS, and those places (N, 4, 4), without directions."""
    stamps = np.loadtxt(place / "timestamps" / "B25b_timestamps.txt")
    truth = np.loadtxt(place / "timestamps" / "Bicocca_2009-02-25b-GT-extended.csv", delimiter=",")
    after = np.clip(np.searchsorted(truth[:, 0], stamps), 1, len(truth) - 1)
    # where fixes are no more than 1 s apart
    known = (stamps >= truth[0, 0]) & (stamps <= truth[-1, 0]) & (truth[after, 0] - truth[after - 1, 0] <= 1.0)
    places = np.tile(np.eye(4), (len(stamps), 1, 1))
    places[:, 0, 3], places[:, 1, 3] = (np.interp(stamps, truth[:, 0], truth[:, axis]) for axis in (1, 2))
    return known, places


def false_by_gps(graph: PoseGraph, loops: Ints, known: Bools, places: Floats) -> Bools:
    """Closures (K,) of other distances than between those places. 3 m: twice what the fixes are off."""
    a, b = graph.a[loops], graph.b[loops]
    apart = np.linalg.norm((places[a] - places[b])[:, :2, 3], axis=1)
    return known[a] & known[b] & (np.abs(apart - np.linalg.norm(graph.a_from_b[loops, :2, 3], axis=1)) > 3.0)


def bicocca(place: Path, methods: Sequence[str]) -> Iterator[Figure]:
    """Bicocca 25b (Latif, Cadena, Neira, IJRR 2013): error against its GPS truth, as a share of the best method's."""
    if not place.is_dir():
        return
    known, places = bicocca_truth(place)
    for threshold in ("0.150", "0.300", "0.500"):
        graph = read_g2o(place / f"B25b_{threshold}.g2o").graph
        odometry = aligned_error(odometry_chain(graph)[0][known], places[known])
        loops = np.flatnonzero(is_loop(graph))
        false = false_by_gps(graph, loops, known, places)
        facts: dict[str, Any] = {"odometry_m": round(odometry, 3), "closures": len(loops), "false": int(false.sum())}
        for kind in methods:
            optimiser = method(kind)
            solved: list[Solution] = []
            spent = seconds(lambda: solved.append(decided(graph, optimiser).solution), time.perf_counter)  # noqa: B023
            kept = solved[0].weight[loops] > 0.5
            facts[kind] = {
                "ate_m": round(aligned_error(solved[0].world_from_body[known], places[known]), 3),
                "kept": int(kept.sum()),
                "false_kept": int((kept & false).sum()),
                "odometry_kept": not kept.any(),
                "seconds": round(spent, 2),
            }
        ours = facts[methods[0]]["ate_m"]
        best = min(facts[kind]["ate_m"] for kind in methods)
        name = f"B25b {threshold}: error of {methods[0]} to that of the best"
        yield Figure(name, ours / best, BICOCCA_BAR, True, facts)
        yield Figure(f"B25b {threshold}: error of {methods[0]} to that of the odometry", ours / odometry, 1.0, True)


# --- time -----------------------------------------------------------------------------------------------------------


def least_squares_time(name: str, path: Path, cost: float | None, bar: float | None, rounds: int) -> Figure:
    """Reading and plain least squares, ours to bare GTSAM: readG2o, chordal or LAGO start, Levenberg-Marquardt."""
    solved: list[Solution] = []
    bare: list[tuple[float, str]] = []

    def ours() -> None:
        solved.append(LmSettings()(read_g2o(path).graph))

    turns = in_turns(ours, lambda: bare.append(bare_gtsam(path)), rounds, time.perf_counter)
    error = solved[-1].error_after
    facts = {
        "seconds": [round(one, 3) for one in turns.medians],
        "error": error,
        "error_of_bare": bare[-1][0],
        "start_of_bare": bare[-1][1],
        "known_error": cost,
        "reached": cost is None or error <= cost * (1 + 1e-5),
    }
    ratio = turns.ratio if facts["reached"] else float("inf")  # an answer that is none has no time
    return Figure(f"{name}: least squares, time to that of bare GTSAM", ratio, bar, True, facts)


def bare_gtsam(path: Path) -> tuple[float, str]:
    """The error that GTSAM alone reaches, and from which start, by its own defaults."""
    spatial = "SE3" in path.read_text(encoding="ascii")[:200]
    graph, values = gtsam.readG2o(str(path), spatial)
    held = gtsam.NonlinearFactorGraph(graph)
    if spatial:
        held.add(gtsam.PriorFactorPose3(0, values.atPose3(0), gtsam.noiseModel.Isotropic.Sigma(6, 1e-6)))
    else:
        held.add(gtsam.PriorFactorPose2(0, values.atPose2(0), gtsam.noiseModel.Isotropic.Sigma(3, 1e-6)))
    begun = "chordal" if spatial else "lago"
    try:
        start = gtsam.InitializePose3.initialize(held) if spatial else gtsam.lago.initialize(held)
    except (RuntimeError, ValueError):  # LAGO takes diagonal noise alone
        start, begun = values, "file"
    end = gtsam.LevenbergMarquardtOptimizer(held, start, gtsam.LevenbergMarquardtParams()).optimize()
    return float(held.error(end)), begun


def city(poses: int, seed: int = 0) -> PoseGraph:
    """A walk over the crossings of a square city, closures where it comes back to one, noise as in city10000."""
    random = np.random.default_rng(seed)
    blocks = max(int(np.sqrt(poses) / 2), 3)
    heading = np.cumsum(random.choice([0, 0, 0, 1, -1], poses)) % 4
    step = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
    at = np.zeros((poses, 2), int)
    for k in range(1, poses):
        there = at[k - 1] + step[heading[k - 1]]
        at[k] = np.where((there < 0) | (there >= blocks), at[k - 1], there)
    true = _planar(at[:, 0].astype(float), at[:, 1].astype(float), heading * np.pi / 2)
    last: dict[tuple[int, int], int] = {}
    pairs = [(k - 1, k) for k in range(1, poses)]
    for k, cell in enumerate(map(tuple, at.tolist())):
        if k - last.get(cell, k) > 10 and random.random() < 0.5:
            pairs.append((last[cell], k))
        last[cell] = k
    a, b = np.array(pairs).T
    noise = random.normal(size=(len(a), 3)) * [0.03, 0.03, 0.02]
    measured = se3.between(true[a], true[b]) @ _planar(*noise.T)
    information = np.zeros((len(a), 6, 6))
    information[:, [2, 3, 4], [2, 3, 4]] = [0.02**-2, 0.03**-2, 0.03**-2]
    kind = [EdgeKind.ODOMETRY] * (poses - 1) + [EdgeKind.LOOP] * (len(a) - poses + 1)
    graph = PoseGraph(true, a.astype(np.int32), b.astype(np.int32), measured, information, kind, 2)
    return replace(graph, world_from_body=odometry_chain(graph)[0])


def made_time(poses: int, rounds: int) -> Figure:
    """The same ratio on a city of so many poses, told without a bar, with what the robust solve takes beside."""
    graph = city(poses)
    with tempfile.TemporaryDirectory() as place:
        path = Path(place) / "city.g2o"
        write_g2o(path, graph, graph.world_from_body)
        name = f"a city of {poses} poses"
        if poses > TURNS_POSES:
            figure = time_beside_limited(name, path)
        else:
            figure = least_squares_time(name, path, None, None, rounds)
    facts = {**figure.facts, **Counter(str(kind) for kind in graph.kind)}
    if poses <= TURNS_POSES:
        robust: list[Solution] = []
        spent = seconds(lambda: robust.append(method("gnc")(graph)), time.perf_counter)
        facts |= {"gnc_seconds": round(spent, 2), "gnc_reason": robust[0].reason}
    return replace(figure, facts=facts)


def time_beside_limited(name: str, path: Path) -> Figure:
    """As least_squares_time, once, with bare GTSAM in a process of its own that is ended at the limit."""
    LmSettings()(city(1000))  # what is compiled is not counted
    solved: list[Solution] = []
    spent = seconds(lambda: solved.append(LmSettings()(read_g2o(path).graph)), time.perf_counter)
    facts: dict[str, Any] = {"seconds": round(spent, 2), "error": solved[0].error_after}
    waited, told = apart(bare_gtsam, (path,), BARE_LIMIT_S)
    if told is None:
        facts["bare"] = f"not done after {waited:.0f} s, > {waited / spent:.0f} x slower"
    else:
        facts |= {"seconds_of_bare": round(waited, 2), "error_of_bare": told[0], "start_of_bare": told[1]}
        facts["bare"] = f"{waited / spent:.1f} x slower"
    return Figure(f"{name}: least squares, time to that of bare GTSAM", spent / waited, None, True, facts)


def apart(work: Callable[..., Any], arguments: tuple[Any, ...], limit_s: float) -> tuple[float, Any]:
    """Seconds that a call takes in a new process, and what it returns, None where it is ended at the limit."""
    context = get_context("spawn")
    results = context.Queue()
    process = context.Process(target=_told, args=(results, work, arguments), daemon=True)
    process.start()
    try:
        return results.get(timeout=limit_s)
    except Empty:
        return limit_s, None
    finally:
        process.kill()
        process.join()


def _told(results: Any, work: Callable[..., Any], arguments: tuple[Any, ...]) -> None:
    told: list[Any] = []
    spent = seconds(lambda: told.append(work(*arguments)), time.perf_counter)
    results.put((spent, told[0]))
