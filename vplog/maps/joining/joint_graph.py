"""Several drives and the ledgers between them in one graph, and its results in tables: for runs and for maps."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from vplog.data import Closures, Floats, Ints, Keyframes, Odometry, PoseGraph, Trajectory, Verdict
from vplog.graph.build import busier, subgraph
from vplog.graph.correct_trajectory import correct_trajectory
from vplog.joint import graph as graph_joint
from vplog.loops.false_rate import log_odds_false
from vplog.maps.storage.damage import reading_drive
from vplog.maps.storage.layout import folder_name
from vplog.refinement.refine import Refined, about_odometry
from vplog.results import g2o, run_record, tables
from vplog.run.back_end import by_odometry
from vplog.storage.scratch import put_in_place

if TYPE_CHECKING:
    from vplog.maps.storage.map_store import Store
    from vplog.pipeline import Pipeline

    Ledgers = Mapping[tuple[int, int], Closures]
    """Ledgers by numbers of the later drive, whose keyframes are the queries, and of the earlier one."""


@dataclass(frozen=True, eq=False)
class SolvedDrive:
    """A drive as its own run solved it."""

    keyframes: Keyframes
    graph: graph_joint.SessionGraph
    odometry: Callable[[], Odometry]
    """Needed for its trajectory alone."""


def solve_drives(
    drives: Sequence[SolvedDrive], ledgers: Ledgers, pipeline: Pipeline
) -> tuple[graph_joint.Joined, dict[tuple[int, int], Closures]]:
    """The joint graphs of connected drives, and the ledgers with weights, residuals and verdicts of the solve. Raises
    GraphError where a graph cannot be solved."""
    between = [verified_closures(*pair, ledger) for pair, ledger in ledgers.items()]
    graphs = [drive.graph for drive in drives]
    joined = graph_joint.join(graphs, between, pipeline.solve, pipeline.join, pipeline.refine)
    judged = map(with_solve, ledgers.values(), joined.weight, joined.residual)
    return joined, dict(zip(ledgers, judged, strict=True))


def own_drive(graph: PoseGraph, weight: Floats, closures: Closures) -> graph_joint.SessionGraph:
    """The graph of a drive at its solved poses, without the closures that its own solve rejected (`weight` (E,) 0)."""
    odometry = graph.odometry
    used = np.flatnonzero(np.isfinite(closures.weight))
    metric = np.array([closures.scale[row] != "none" for row in used.tolist()], bool)
    of_odometry = by_odometry(graph, closures, np.concatenate([used[metric], used[~metric]]))
    edges = np.flatnonzero(odometry | (weight > 0.5))
    own = subgraph(graph, np.arange(len(graph.world_from_body)), edges)
    return graph_joint.SessionGraph(own, of_odometry[edges])


def read_drive(name: str, run: Path) -> SolvedDrive:
    """A drive by the tables of its run folder. Raises DamagedDriveError."""
    with reading_drive(name):
        keyframes, poses = tables.read_keyframes(run / "keyframes.parquet")
        graph, weight, _ = tables.read_edges(run / "edges.parquet", poses)
        own = own_drive(graph, weight, tables.read_closures(run / "closures.parquet"))

    def read_odometry() -> Odometry:
        with reading_drive(name):
            return tables.read_trajectory(run / "trajectory.parquet")[1]

    return SolvedDrive(keyframes, own, read_odometry)


def pair_record(query_drive: str, match_drive: str, ledger: Closures) -> dict[str, Any]:
    """A pair of drives as run.json and component.json have it."""
    inliers = int(np.nansum(ledger.weight))
    return {
        "query_drive": query_drive,
        "match_drive": match_drive,
        "candidates": len(ledger),
        "verified": int(np.isfinite(ledger.weight).sum()),
        "kept": inliers,
        "median_residual_sigma": float(np.nanmedian(ledger.residual_after)) if inliers else None,
    }


def solution_record(drives: Sequence[str], joins: Sequence[dict[str, Any]], refined: Refined) -> dict[str, Any]:
    """component.json of a solution."""
    names = ("error_before", "error_after", "iterations", "converged", "reason")
    return {
        "drives": drives,
        "joins": joins,
        "solution": {name: getattr(refined.solution, name) for name in names},
        "odometry": about_odometry(refined),
    }


def write_component(
    store: Store, name: str, drives: Mapping[str, SolvedDrive], poses: Mapping[str, Floats],
    ledgers: Sequence[tuple[Keyframes, Keyframes, Closures]], record: dict[str, Any], header: tables.TableMetadata,
    refined: Refined | None = None,
) -> None:  # fmt: skip
    """A folder of MAP/joint: the tables of drives at these poses (N, 4, 4) each, the ledgers between them, and the
    graph where it was solved as a whole. Raises ResultError."""
    made, place = store.staging / "joint" / name, store.root / "joint" / name
    shutil.rmtree(made, ignore_errors=True)
    for drive, one in drives.items():
        (made / folder_name(drive)).mkdir(parents=True)
        write_drive(made / folder_name(drive), "", one, poses[drive], header)
    if refined is not None:
        g2o.write_g2o(made / "graph.g2o", refined.graph, refined.solution.world_from_body)
    tables.write_joins(made / "joins.parquet", ledgers, header)
    run_record.write_run_json(made / "component.json", record)
    place.parent.mkdir(exist_ok=True)
    shutil.rmtree(place, ignore_errors=True)
    put_in_place(made, place)


def write_drive(
    folder: Path, prefix: str, drive: SolvedDrive, poses: Floats, header: tables.TableMetadata
) -> Trajectory:
    """Tables of keyframes (N, 4, 4) and trajectory of a drive in the frame of its map. Returns the trajectory."""
    odometry = drive.odometry()
    trajectory = correct_trajectory(odometry, drive.keyframes, poses)
    tables.write_keyframes(folder / f"{prefix}keyframes.parquet", drive.keyframes, poses, header)
    tables.write_trajectory(folder / f"{prefix}trajectory.parquet", trajectory, odometry, header)
    return trajectory


def verified(ledger: Closures) -> Ints:
    """Rows of the closures that geometry has verified, whatever a later solve made of them."""
    return np.flatnonzero(ledger.accepted | np.isfinite(ledger.weight))


def verified_closures(later: int, earlier: int, ledger: Closures) -> graph_joint.Between:
    """The verified rows of a ledger for a joint graph."""
    rows = verified(ledger)
    shared = busier(ledger.match[rows], ledger.query[rows])
    return graph_joint.Between(
        later,
        earlier,
        query=ledger.query[rows].astype(np.int64),
        match=ledger.match[rows].astype(np.int64),
        match_from_query=ledger.match_from_query[rows],
        information=ledger.information[rows] / shared[:, None, None],
        of_odometry=np.array([ledger.scale[row] == "odometry" for row in rows.tolist()], bool),
        log_odds=log_odds_false(ledger)[rows],
    )


def with_solve(ledger: Closures, weight: Floats, residual: Floats) -> Closures:
    """The ledger with weights and residuals (L,) of its verified rows from the joint solve."""
    rows = verified(ledger)
    weights, residuals, verdict = np.full(len(ledger), np.nan), np.full(len(ledger), np.nan), list(ledger.verdict)
    weights[rows], residuals[rows] = weight, residual
    for row, one in zip(rows.tolist(), weight.tolist(), strict=True):
        if one < 0.5:
            verdict[row] = Verdict.REJECTED_BY_SOLVER
        elif verdict[row] is Verdict.REJECTED_BY_SOLVER:  # of an earlier solve
            verdict[row] = Verdict.ACCEPTED
    return replace(ledger, weight=weights, residual_after=residuals, verdict=verdict)
