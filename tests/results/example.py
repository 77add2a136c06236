"""A small solved run to write and read back: a circle driven once, with closures of every fate."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vplog.data import Camera, Closures, EdgeKind, Keyframes, Odometry, PoseGraph, Solution, Trajectory, Verdict
from vplog.geometry import se3
from vplog.results import places_map
from vplog.results.places_map import PLACE, read_drives
from vplog.results.tables import TableMetadata

if TYPE_CHECKING:
    from collections.abc import Sequence
    from pathlib import Path

    from vplog.data import Floats

COUNT = 30
METADATA = TableMetadata({"solver": {"method": "gnc", "iterations": 100}, "features": {"size": 1.5}}, "0123abcd")


@dataclass(frozen=True)
class Run:
    keyframes: Keyframes
    graph: PoseGraph
    solution: Solution
    closures: Closures
    trajectory: Trajectory
    odometry: Odometry
    camera: Camera


def read_map(path: Path, kind: pa.DataType) -> tuple[pa.Table, pa.Array]:
    """The places of a whole map, and their descriptors."""
    descriptors = pa.concat_arrays([places.descriptors for places in read_drives(path, kind)])
    return pq.read_table(path, columns=PLACE.names), descriptors


def write_map(path: Path, folders: Sequence[Path]) -> dict[str, Any]:
    """The places of runs in one file; what was written."""
    drives = {
        name: places_map.drive_header(run) for name, run in zip(places_map.names_of(folders), folders, strict=True)
    }
    return places_map.write_places(path, drives, map(places_map.read_places, folders))


def random_poses(rng: np.random.Generator, count: int) -> Floats:
    return se3.exp(rng.normal(size=(count, 6)) * [1, 1, 1, 20, 20, 20])


def make_run(seed: int = 0) -> Run:
    rng = np.random.default_rng(seed)
    turn = np.linspace(0.0, 2.0 * np.pi, COUNT)
    odom = se3.pose(
        se3.so3_exp(turn[:, None] * [0.0, 0.0, 1.0]),
        10.0 * np.stack([np.sin(turn), 1.0 - np.cos(turn), 0.0 * turn], axis=1),
    )
    world = odom @ se3.exp(0.03 * rng.normal(size=(COUNT, 6)))
    keyframes = Keyframes("a drive", 1_700_000_000_123_456_789 + 100_000_000 * np.arange(COUNT), odom)
    verdict = list(Verdict)
    count = len(verdict)
    query = np.sort(rng.integers(COUNT // 2, COUNT, count)).astype(np.int32)
    match = rng.integers(0, COUNT // 2, count).astype(np.int32)
    solved = np.array([v in (Verdict.ACCEPTED, Verdict.REJECTED_BY_SOLVER) for v in verdict])
    square = rng.normal(size=(count, 6, 6))
    known = np.where(solved, 1.0, np.nan)
    closures = Closures(
        query=query,
        match=match,
        rank=np.arange(count, dtype=np.int32),
        score=rng.random(count, dtype=np.float32),
        support=rng.integers(0, 9, count).astype(np.int32),
        shared_references=[rng.integers(0, 100, row % 4).astype(np.uint16) for row in range(count)],
        shared_overlap=[rng.random(row % 4, dtype=np.float32) for row in range(count)],
        matches=rng.integers(0, 900, count).astype(np.int32),
        landmarks=rng.integers(0, 900, count).astype(np.int32),
        inliers=rng.integers(0, 900, count).astype(np.int32),
        spread=rng.random(count, dtype=np.float32),
        reverse_inliers=rng.integers(-1, 900, count).astype(np.int32),
        scale=["depth" if one else "none" for one in solved],
        match_from_query=random_poses(rng, count) * known[:, None, None],
        information=(square @ square.transpose(0, 2, 1) + np.eye(6)) * known[:, None, None],
        verdict=verdict,
        p_false=rng.random(count) * known,
        residual_before=rng.random(count) * known,
        residual_after=rng.random(count) * known,
        weight=rng.random(count) * known,
        query_camera=rng.integers(0, 3, count).astype(np.int32),
        match_camera=rng.integers(0, 3, count).astype(np.int32),
    )
    a = np.arange(COUNT - 1, dtype=np.int32)
    edges = COUNT - 1 + int(solved.sum())
    square = rng.normal(size=(edges, 6, 6))
    graph = PoseGraph(
        world_from_body=odom,
        a=np.concatenate([a, match[solved]]),
        b=np.concatenate([a + 1, query[solved]]).astype(np.int32),
        a_from_b=np.concatenate([se3.between(odom[a], odom[a + 1]), closures.match_from_query[solved]]),
        information=square @ square.transpose(0, 2, 1) + np.eye(6),
        kind=[EdgeKind.ODOMETRY] * (COUNT - 1) + [EdgeKind.LOOP] * int(solved.sum()),
    )
    camera_axes = np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]])
    camera = Camera("front", None, "none", np.zeros(0), 640, 480, se3.pose(camera_axes, np.array([1.0, 0.0, 0.5])))
    solution = Solution(world, rng.random(edges), 9.0, 1.0, 5, True, "The steps became small.")
    odometry = Odometry(keyframes.stamp_ns, odom, None)
    return Run(keyframes, graph, solution, closures, Trajectory(keyframes.stamp_ns, world), odometry, camera)
