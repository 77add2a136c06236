"""Drives of 200 keyframes joined in a city grid: what the next one costs, and what error the joint graph is left with.

Streets are 100 m long and driven six times in each direction, whatever the number of drives: the city grows with them.
Where others drove before in the same direction, the last two are met, with a closure every 20 m, of which one in fifty
of those that are judged is false. Noise of the odometry is 2 cm and 0.1 degrees for each 2 m, of closures 5 cm and 0.3
degrees. Only what is solved is there: tables of drives and ledgers of pairs, as a batch leaves them.
"""

from __future__ import annotations

import math
import tempfile
import time
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, cast

import numpy as np

from tests.benchmarks.measure import Figure
from vplog.data import Closures, EdgeKind, Keyframes, Odometry, PoseGraph, Solution, Trajectory, Verdict
from vplog.execution.execution import Execution
from vplog.geometry import se3
from vplog.graph.lm import LmSettings
from vplog.graph.slips import Slipping
from vplog.graph.solve import Decision
from vplog.graph.variance_components import Sigmas
from vplog.joint import graph as joint
from vplog.joint import growth
from vplog.loops.verify import no_closures
from vplog.maps.joining import components
from vplog.maps.joining.components import Drives, PairLedger
from vplog.maps.joining.growth import Growth, Part
from vplog.maps.joining.join_states import JoinState
from vplog.maps.joining.joint_graph import verified, with_solve
from vplog.maps.joining.joint_record import keyframe_poses, recorded_components
from vplog.maps.storage.map_store import Store
from vplog.pipeline import load_pipeline
from vplog.results import tables

if TYPE_CHECKING:
    from collections.abc import Iterable, Iterator, Sequence

    from vplog.data import Floats, Ints
    from vplog.pipeline import Pipeline

EACH, ALONG, STREETS = 200, 50, 4
"""Keyframes of a drive and of a street, and streets of a drive."""
PASSES, MET = 6, 2
"""Passes of a street in each direction, and how many of the last of them are met."""
FALSE = 0.02
"""Share of false closures in the drives that are added one by one; those before have none, and are put in without a
decision, which would take hours."""
P_FALSE = 0.02
"""By which recognition is sure of closures, the false ones among them."""
ODOMETRY = np.array([np.radians(0.1)] * 3 + [0.02] * 3)
CLOSURE = np.array([np.radians(0.3)] * 3 + [0.05] * 3)
NEXT = 10
"""Drives that are added one by one."""
COST_BAR, ERROR_BAR = 2.0, 1.05
"""Of the next drive to the first hundred's, and of the error to that of the whole solved again."""
_STEP = np.array([[1, 0], [0, 1], [-1, 0], [0, -1]])
_ABOUT = tables.TableMetadata({}, "a" * 64)


def write_odometry(run: Path, keyframes: Keyframes, information: Floats, about: tables.TableMetadata) -> None:
    """The tables of a run whose solution is its odometry, each step with this information (6, 6)."""
    poses, stamps, count = keyframes.odom_from_body, keyframes.stamp_ns, len(keyframes.stamp_ns) - 1
    a, step = np.arange(count, dtype=np.int32), se3.between(poses[:-1], poses[1:])
    graph = PoseGraph(poses, a, a + 1, step, np.tile(information, (count, 1, 1)), [EdgeKind.ODOMETRY] * count)
    solution = Solution(poses, np.ones(count), 0.0, 0.0, 0, True, "")
    tables.write_keyframes(run / "keyframes.parquet", keyframes, poses, about)
    tables.write_edges(run / "edges.parquet", graph, solution, np.zeros(count), about)
    tables.write_closures(run / "closures.parquet", no_closures(), keyframes, about)
    odometry = Odometry(stamps, poses, None)
    tables.write_trajectory(run / "trajectory.parquet", Trajectory(stamps, poses), odometry, about)


@dataclass(frozen=True, eq=False)
class Made:
    """A drive of the city."""

    name: str
    true: Floats
    ledgers: list[PairLedger]


class City:
    """Drives made one after the other, and written into a map."""

    def __init__(self, root: Path, drives: int, seed: int = 0) -> None:
        self.false = 0.0
        self.root, self.random = root, np.random.default_rng(seed)
        self.side = max(round(np.sqrt(drives * STREETS / PASSES / 4.0) + 0.5), 3)
        self.drives: list[Made] = []
        self._keyframes: list[Keyframes] = []
        self._last: dict[tuple[int, int, int], list[tuple[int, int]]] = {}

    def grow(self, count: int) -> None:
        """Make and write drives until there are `count`."""
        while len(self.drives) < count:
            self._drive(len(self.drives))

    def _drive(self, number: int) -> None:
        random, name = self.random, f"d{number:06d}"
        corner, heading = random.integers(0, self.side, 2), int(random.integers(0, 4))
        true, met = [], list[tuple[int, int, int]]()
        for street in range(STREETS):
            heading = (heading + int(random.choice([0, 0, 1, 3]))) % 4
            while not ((corner + _STEP[heading] >= 0) & (corner + _STEP[heading] < self.side)).all():
                heading = (heading + 1) % 4
            yaw = heading * np.pi / 2
            place = corner + np.arange(ALONG)[:, None] / ALONG * _STEP[heading]
            height = 10.0 * np.sin(place[:, :1]) + 10.0 * np.cos(0.7 * place[:, 1:])
            rotation = np.broadcast_to(se3.so3_exp(np.array([0.0, 0.0, yaw])), (ALONG, 3, 3))
            true.append(se3.pose(rotation, np.concatenate([100.0 * place, height], axis=1)))
            passes = self._last.setdefault((int(corner[0]), int(corner[1]), heading), [])
            met += [(street, *one) for one in passes[-MET:] if one[0] != number]
            passes.append((number, street))
            corner = corner + _STEP[heading]
        poses = np.concatenate(true)
        keyframes = self._write_run(name, poses)
        pairs: dict[int, list[Ints]] = {}
        for street, other, there in met:
            rows = np.stack([np.arange(0, ALONG, 10) + ALONG * street, np.arange(0, ALONG, 10) + ALONG * there])
            pairs.setdefault(other, []).append(rows)
        self._keyframes.append(keyframes)
        self.drives.append(Made(name, poses, []))
        for other, rows in sorted(pairs.items()):
            query, match = np.concatenate(rows, axis=1)
            self.drives[-1].ledgers.append(self._write_ledger(number, other, query, match))

    def _write_run(self, name: str, true: Floats) -> Keyframes:
        run = self.root / "runs" / f"drive={name}"
        run.mkdir(parents=True)
        step = se3.between(true[:-1], true[1:]) @ se3.exp(self.random.normal(size=(EACH - 1, 6)) * ODOMETRY)
        chain = [np.eye(4)]
        for one in step:
            chain.append(chain[-1] @ one)
        keyframes = Keyframes(name, np.arange(EACH, dtype=np.int64) * 10**9, np.array(chain))
        write_odometry(run, keyframes, np.diag(ODOMETRY**-2.0), _ABOUT)
        return keyframes

    def _write_ledger(self, later: int, earlier: int, query: Ints, match: Ints) -> PairLedger:
        count, random = len(query), self.random
        measured = se3.between(self.drives[earlier].true[match], self.drives[later].true[query])
        measured = measured @ se3.exp(random.normal(size=(count, 6)) * CLOSURE)
        false = random.random(count) < self.false
        measured[false] = measured[false] @ se3.exp(random.normal(size=(false.sum(), 6)) * [0.1, 0.1, 0.5, 4, 4, 0.3])
        rows, shares, nan = np.zeros(count, np.int32), np.zeros(count, np.float32), np.full(count, np.nan)
        ledger = Closures(
            query=query.astype(np.int32), match=match.astype(np.int32), rank=rows, score=shares, support=rows,
            shared_references=[np.empty(0, np.uint16)] * count, shared_overlap=[np.empty(0, np.float32)] * count,
            matches=rows, landmarks=rows, inliers=rows, spread=shares, reverse_inliers=rows, scale=["depth"] * count,
            match_from_query=measured, information=np.broadcast_to(np.diag(CLOSURE**-2.0), (count, 6, 6)).copy(),
            verdict=[Verdict.ACCEPTED] * count, p_false=np.full(count, P_FALSE), residual_before=nan,
            residual_after=nan, weight=nan, query_camera=rows, match_camera=rows,
        )  # fmt: skip
        path = self.root / "joins" / f"drive=d{later:06d}" / f"match=d{earlier:06d}.parquet"
        path.parent.mkdir(parents=True, exist_ok=True)
        key = f"{later} in {earlier}"
        data = tables.joins_as_bytes([(self._keyframes[later], self._keyframes[earlier], ledger)], _ABOUT, key)
        path.write_bytes(data)
        return PairLedger(f"d{later:06d}", f"d{earlier:06d}", path, key, count)


class Cost:
    """CPU seconds, and the tables that are read."""

    def __init__(self) -> None:
        self.seconds = dict.fromkeys(("all", "add", "_solve"), 0.0)
        self.files = self.bytes = self.solved = 0

    def solve(self, city: City, count: int, pipeline: Pipeline, *, whole: bool = False) -> dict[str, Any]:
        """Solve the first drives of the city."""
        made = city.drives[:count]
        joins = [JoinState(one.name, at, one.name) for at, one in enumerate(made)]
        records = {one.name: {"key": one.name} for one in made}
        drives = Drives(joins, records, {}, "a" * 64, cast("Any", None), [])
        ledgers = [ledger for one in made for ledger in one.ledgers]
        read, add, solve = tables._read, Growth.add, Growth._solve

        def counted(path: Path, *rest: Any) -> Any:
            self.files, self.bytes = self.files + 1, self.bytes + path.stat().st_size
            return read(path, *rest)

        def timed(what: str, work: Any) -> Any:
            def run(*arguments: Any) -> Any:
                began = time.process_time()
                try:
                    return work(*arguments)
                finally:
                    self.seconds[what] += time.process_time() - began
                    self.solved += what == "_solve"

            return run

        began = time.process_time()
        tables._read, Growth.add, Growth._solve = counted, timed("add", add), timed("_solve", solve)  # pyrefly: ignore
        try:
            store = Store(city.root)
            store.staging.mkdir(exist_ok=True)
            return components.solve_groups(store, drives, ledgers, pipeline, Execution(1), whole=whole)
        finally:
            tables._read, Growth.add, Growth._solve = read, add, solve
            self.seconds["all"] += time.process_time() - began

    def facts(self, drives: int) -> dict[str, Any]:
        """What a drive costs."""
        placed = self.seconds["add"] - self.seconds["_solve"]
        return {
            "cpu_s": round(self.seconds["all"] / drives, 3), "placing_s": round(placed / drives, 3),
            "wholes": self.solved, "whole_s": round(self.seconds["_solve"] / max(self.solved, 1), 2),
            "tables": round(self.files / drives, 1), "kB": round(self.bytes / drives / 1000, 1),
        }  # fmt: skip


def errors(city: City, count: int, last: int) -> tuple[float, float, int]:
    """Root mean square of the positions' error, m, of all drives of the largest component in its frame and of the last
    ones of them, infinite where it has none of these; and how many of these it has."""
    store = Store(city.root)
    joints = recorded_components(store)
    largest = max({id(one.drives): one.drives for one in joints.values()}.values(), key=len)
    number = {one.name: at for at, one in enumerate(city.drives[:count])}
    inside = [drive for drive in largest if drive in number]
    found = np.concatenate([keyframe_poses(store, joints, drive)[:, :3, 3] for drive in inside])
    true = np.concatenate([city.drives[number[drive]].true[:, :3, 3] for drive in inside])
    aligned, _ = se3.umeyama(found, true)
    error = np.linalg.norm(found @ aligned[:3, :3].T + aligned[:3, 3] - true, axis=1)
    new = [number[drive] >= count - last for drive in inside]
    if not any(new):
        return math.inf, math.inf, 0
    of_new = error[np.repeat(new, EACH)]
    return float(np.sqrt((error**2).mean())), float(np.sqrt((of_new**2).mean())), sum(new)


def with_join(pipeline: Pipeline, **changes: Any) -> Pipeline:
    return pipeline.model_copy(update={"join": pipeline.join.model_copy(update=changes)})


@contextmanager
def undecided() -> Iterator[None]:
    """All closures are taken for true."""
    before = joint.decided, growth.decided

    def plain(graph: PoseGraph, *_: Any, **__: Any) -> Decision:
        return Decision(graph, LmSettings()(graph), Sigmas(), Slipping.nowhere(graph))

    joint.decided = growth.decided = plain
    try:
        yield
    finally:
        joint.decided, growth.decided = before


@contextmanager
def placed_by_truth(city: City) -> Iterator[None]:
    """Drives are put where they were, and not one after the other, so that the whole is solved once."""
    add, true = Growth.add, {one.name: one.true for one in city.drives}

    def put(self: Growth, drives: Iterable[str]) -> None:
        names, ledgers = [*self._part, *drives], {pair: read() for pair, read in self._pairs.items()}
        weight = {pair: np.ones(len(verified(one))) for pair, one in ledgers.items()}
        ledgers = {pair: with_solve(one, weight[pair], weight[pair]) for pair, one in ledgers.items()}
        folder = self._write(["truth", names], {name: true[name] for name in names}, {}, ledgers)
        self._part = dict.fromkeys(names, Part(dict.fromkeys(names, folder), set(names)))

    Growth.add = put  # pyrefly: ignore
    try:
        yield
    finally:
        Growth.add = add  # pyrefly: ignore


def city(sizes: Sequence[int], share: float | None = None) -> Iterator[Figure]:
    """The next drives of cities of these sizes, beside the last of the first hundred. All are placed: judging all
    closures anew, as in smaller graphs, costs more."""
    pipeline = with_join(load_pipeline("default"), judged_anew=12)
    pipeline = pipeline if share is None else with_join(pipeline, grown_share=share)
    first = 0.0
    for size in (100 - NEXT, *sizes):
        with tempfile.TemporaryDirectory() as folder:
            made, built, cost, whole = City(Path(folder), size + NEXT), Cost(), Cost(), Cost()
            made.grow(size)
            with undecided(), placed_by_truth(made):
                built.solve(made, size, pipeline, whole=True)
            made.false = FALSE
            made.grow(size + NEXT)
            for count in range(size + 1, size + NEXT + 1):
                cost.solve(made, count, pipeline)
            grown = errors(made, size + NEXT, NEXT)
            whole.solve(made, size + NEXT, pipeline, whole=True)
            again = errors(made, size + NEXT, NEXT)
        each = cost.seconds["all"] / NEXT
        first = first or each
        facts = {
            **cost.facts(NEXT), "built_cpu_s": round(built.seconds["all"], 1),
            "solved_again_cpu_s": round(whole.seconds["all"], 1),
        }  # fmt: skip
        yield Figure(f"city of {size}: the next drive, to the first hundred", each / first, COST_BAR, True, facts)
        facts = {"m": grown[0], "m_whole": again[0], "m_new": grown[1], "m_new_whole": again[1], "new": grown[2]}
        ratio = grown[0] / again[0] if math.isfinite(again[0]) else math.inf
        yield Figure(f"city of {size}: error to that of the whole", ratio, ERROR_BAR, True, facts)
