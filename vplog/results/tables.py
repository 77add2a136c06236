"""The Parquet tables of a run folder: literal schemas, and a writer and a reader for each.

Poses are scalar columns `tx ty tz` (m) and `qx qy qz qw` (unit, w >= 0), which DuckDB and Polars query directly;
6x6 matrices are lists of 36, row by row, rotation first. What is NaN in our arrays because it is not known is null in
a table. No clock, path or thread count enters a file, and row groups have a fixed size.
"""

from __future__ import annotations

import io
import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import StrEnum
from itertools import pairwise
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import pyarrow as pa

from vplog.data import (
    Closures,
    EdgeKind,
    Floats,
    Int32s,
    Ints,
    Keyframes,
    Odometry,
    PoseGraph,
    Solution,
    Trajectory,
    Verdict,
)
from vplog.errors import ResultError, nearest
from vplog.geometry import se3
from vplog.storage.json_records import canonical_json
from vplog.storage.parquet_limits import (
    VERSION_KEY,
    check_columns,
    filled,
    open_table,
    read_schema,
    read_table,
    write_table,
)
from vplog.storage.scratch import replacing
from vplog.version import __version__

T = TypeVar("T", bound=StrEnum)

ROWS_PER_GROUP = 65_536
"""Rows of a row group; 64 Ki rows of the widest table here are about 40 MB in memory."""
DESCRIPTORS_PER_GROUP = 1_024
"""Rows of a row group of descriptors, which may take tens of kB each."""


@dataclass(frozen=True)
class TableMetadata:
    """The run that made a table, in its header; equal for equal runs."""

    settings: dict[str, Any]
    """The full tree of settings."""
    library: str
    """Hash of the place library, empty where none was used."""

    def record(self) -> dict[str, str]:
        """Keys and texts of the header of a file."""
        return {
            "vplog.settings": canonical_json(self.settings),
            "vplog.library": self.library,
            "vplog.version": __version__,
        }


def column(name: str, kind: pa.DataType, unit: str, description: str, nullable: bool = False) -> pa.Field:
    """A column of a table with its unit and description."""
    return pa.field(name, kind, nullable, metadata={"unit": unit, "description": description})


POSE_COLUMNS = ("tx", "ty", "tz", "qx", "qy", "qz", "qw")


def pose_columns(prefix: str, text: str, nullable: bool = False) -> list[pa.Field]:
    return [
        *(column(f"{prefix}t{axis}", pa.float64(), "m", f"{text}: position, {axis}.", nullable) for axis in "xyz"),
        *(column(f"{prefix}q{axis}", pa.float64(), "1", f"{text}: quaternion, {axis}.", nullable) for axis in "xyzw"),
    ]


MATRIX = pa.list_(pa.field("element", pa.float64(), nullable=False), 36)
_POSE = pa.list_(pa.field("element", pa.float64(), nullable=False), 16)
_NUMBERS = pa.list_(pa.field("element", pa.uint16(), nullable=False))
FLOAT32_LIST = pa.list_(pa.field("element", pa.float32(), nullable=False))
_OPEN_SHARE = 1e-12
"""Least eigenvalue of an information matrix as a share of its largest, below which nothing is known along it: a turn
known to 0.01 degrees and a shift to 10 m are 3e-10 apart."""
_INFORMATION_UNIT = "rad^-2, rad^-1 m^-1, m^-2"

KEYFRAMES = pa.schema(
    [
        column("keyframe", pa.int32(), "row", "Row of the keyframe, 0 is the first."),
        column("drive", pa.string(), "", "Name of the drive."),
        column("stamp_ns", pa.int64(), "ns", "Stamp of the frame, in the log's clock."),
        *pose_columns("odom_", "odom_from_body, as the odometry has it"),
        *pose_columns("world_", "world_from_body, optimised"),
        column(
            "covariance", MATRIX, "rad^2, rad m, m^2",
            "6x6 of world_from_body in the body frame, by the solved graph, with the scale that all metres share where "
            "it is not known: relative to the first keyframe, or to earth with GPS; null where not known.", True,
        ),
    ]
)  # fmt: skip
CLOSURES = pa.schema(
    [
        column("query", pa.int32(), "row", "Keyframe, the later one."),
        column("match", pa.int32(), "row", "Keyframe, the earlier one."),
        column("query_stamp_ns", pa.int64(), "ns", "Stamp of the query keyframe."),
        column("match_stamp_ns", pa.int64(), "ns", "Stamp of the match keyframe."),
        column("rank", pa.int32(), "1", "Place among the query's candidates, 0 is the best."),
        column("score", pa.float32(), "1", "The recogniser's similarity, on its own scale."),
        column("support", pa.int32(), "pairs", "Neighbours of the pair that agree by sequence; 0 without a sequence."),
        column("shared_references", _NUMBERS, "1", "Library references that explain both; empty without boxes."),
        column("shared_overlap", FLOAT32_LIST, "1", "Of each, the share of a box that the two have in common, 0 to 1."),
        column("matches", pa.int32(), "features", "Feature matches that passed the ratio and mutual tests."),
        column("landmarks", pa.int32(), "features", "Matches with a known 3D position in the map frame."),
        column("inliers", pa.int32(), "features", "Matches that agree with the pose, or with the epipolar geometry."),
        column("spread", pa.float32(), "1", "Share of the query image that the inliers' bounding box covers."),
        column("reverse_inliers", pa.int32(), "features", "Inliers from match to query, -1 where not tried."),
        column("scale", pa.string(), "", "Where the metres come from: `odometry`, `depth`, `stereo` or `none`."),
        *pose_columns("", "match_from_query between body frames, null where no pose was found", nullable=True),
        column("information", MATRIX, _INFORMATION_UNIT, "6x6 of match_from_query, in the query's body frame.", True),
        column("covariance", MATRIX, "rad^2, rad m, m^2", "The inverse of the information.", True),
        column("verdict", pa.string(), "", "What became of the candidate."),
        column("reason", pa.string(), "", "The verdict in one sentence."),
        column(
            "p_false",
            pa.float64(),
            "1",
            "Expected share of false closures among it and all that are surer; null where geometry found none.",
            True,
        ),
        column("residual_before", pa.float64(), "sigma", "Mahalanobis distance to the odometry, null if unused.", True),
        column("residual_after", pa.float64(), "sigma", "Mahalanobis distance to the solution, null if unused.", True),
        column("weight", pa.float64(), "1", "Weight of the robust solve, 0 to 1, null if unused.", True),
        column("query_camera", pa.int32(), "1", "The query's camera by its number in run.json; 0 is the first.", True),
        column("match_camera", pa.int32(), "1", "The match's camera by its number in run.json; 0 is the first.", True),
    ]
)
JOINS = pa.schema(
    [
        column("query_drive", pa.string(), "", "Drive of the query keyframe, the later one given."),
        column("match_drive", pa.string(), "", "Drive of the match keyframe."),
        *CLOSURES,
    ]
)
EDGES = pa.schema(
    [
        column("a", pa.int32(), "row", "Keyframe."),
        column("b", pa.int32(), "row", "Keyframe."),
        column(
            "kind",
            pa.string(),
            "",
            "`odometry`, `loop` or, by decision, `known_loop`. GPS fixes are no edges.",
        ),
        *pose_columns("", "a_from_b, as measured"),
        column("information", MATRIX, _INFORMATION_UNIT, "6x6 of a_from_b, in the frame of b."),
        column("weight", pa.float64(), "1", "Weight of the robust solve, 0 to 1."),
        column("residual", pa.float64(), "sigma", "Mahalanobis distance of the measurement to the solution."),
    ]
)
TRAJECTORY = pa.schema(
    [
        column("stamp_ns", pa.int64(), "ns", "Stamp of the odometry sample, in the log's clock."),
        *pose_columns("", "world_from_body, optimised"),
        *pose_columns("odom_", "odom_from_body, as logged"),
    ]
)

PLACED = pa.schema(
    [
        column("query", pa.int32(), "row", "View of the log, 0 is the first."),
        column("query_stamp_ns", pa.int64(), "ns", "Stamp of the view, in the log's clock."),
        column("rank", pa.int32(), "1", "0 is the view's best answer."),
        column("drive", pa.string(), "", "Drive of the place; with keyframe it joins with MAP/keyframes."),
        column("keyframe", pa.int32(), "row", "Keyframe of that drive, 0 is the first."),
        column("stamp_ns", pa.int64(), "ns", "Stamp of the picture, in its log's clock."),
        column("score", pa.float32(), "1", "Similarity by the recogniser; of a sequence, how much above the usual."),
        column("support", pa.int32(), "1", "Other views of the window that agree; 0 where views stand alone."),
        column(
            "p_match",
            pa.float32(),
            "1",
            "Probability that the view's best answer is its place, learned on the answers without a truth, so that it "
            "compares between views; null for other answers, and where too few views have look-alikes.",
            True,
        ),
        column("camera", pa.int32(), "1", "Number of the picture's camera in run.json; 0 is the first.", True),
    ]
)
"""Answers of a query of a map, by view, then by rank."""
LOCALIZED = pa.schema(
    [
        column("picture", pa.string(), "", "File of the picture, or its stamp in a log."),
        column("stamp_ns", pa.int64(), "ns", "Stamp of the picture, in the log's clock."),
        column("verdict", pa.string(), "", "`accepted` where it has a pose."),
        column("sentence", pa.string(), "", "The verdict in one sentence."),
        column("drive", pa.string(), "", "Drive of the keyframe that explains it best; null without one.", True),
        column("keyframe", pa.int32(), "row", "That keyframe, 0 is the drive's first; null without one.", True),
        column("frame", pa.string(), "", "Frame of the pose: the first of the drives joined with that one.", True),
        column("matches", pa.int32(), "features", "Feature matches with that keyframe's landmarks."),
        column("inliers", pa.int32(), "features", "Features that agree with the pose."),
        column("places", pa.int32(), "keyframes", "Keyframes whose landmarks they match."),
        *pose_columns("", "world_from_camera, null where not localised", nullable=True),
        column("covariance", MATRIX, "rad^2, rad m, m^2", "6x6 of the pose in the camera, relative to the map.", True),
        column("longitude", pa.float64(), "deg", "WGS84; null where the frame's place on earth is not known.", True),
        column("latitude", pa.float64(), "deg", "WGS84; null where the frame's place on earth is not known.", True),
        column("altitude_m", pa.float64(), "m", "WGS84; null where the frame's place on earth is not known.", True),
    ]
)
_SCHEMAS = {"keyframes": KEYFRAMES, "closures": CLOSURES, "joins": JOINS, "edges": EDGES, "trajectory": TRAJECTORY}


def descriptors_schema(descriptor: pa.DataType) -> pa.Schema:
    """Schema of the descriptors of a recogniser that stores one place as `descriptor`."""
    return pa.schema(
        [
            column("keyframe", pa.int32(), "row", "Row of the keyframe, 0 is the first."),
            column("stamp_ns", pa.int64(), "ns", "Stamp of the picture."),
            column("descriptor", descriptor, "", "The place, in the recogniser's own Arrow type."),
            column("camera", pa.int32(), "1", "Number of the camera in run.json; null where it has one.", True),
        ]
    )


def write_keyframes(
    path: Path,
    keyframes: Keyframes,
    world_from_body: Floats,
    metadata: TableMetadata,
    covariance: Floats | None = None,
) -> None:
    """keyframes.parquet, with the optimised poses (N, 4, 4) and their covariance (N, 6, 6), NaN where unknown."""
    count = len(keyframes.stamp_ns)
    columns = {
        "keyframe": np.arange(count, dtype=np.int32),
        "drive": [keyframes.drive] * count,
        "stamp_ns": keyframes.stamp_ns,
        **_pose_values("odom_", keyframes.odom_from_body),
        **_pose_values("world_", world_from_body),
        "covariance": np.full((count, 6, 6), np.nan) if covariance is None else covariance,
    }
    _write(path, "keyframes", _table(KEYFRAMES, columns), metadata)


def read_keyframe_covariance(path: Path) -> Floats:
    """(N, 6, 6) of the keyframes' optimised poses, NaN where not known."""
    return _matrices(_read(path, "keyframes", KEYFRAMES), "covariance")


def read_keyframes(path: Path) -> tuple[Keyframes, Floats]:
    """The keyframes and their optimised poses (N, 4, 4). The drive of an empty table is ``."""
    table = _read(path, "keyframes", KEYFRAMES)
    drive = table["drive"][0].as_py() if len(table) else ""
    keyframes = Keyframes(drive, _values(table, "stamp_ns"), read_poses(table, "odom_"))
    return keyframes, read_poses(table, "world_")


def write_closures(path: Path, closures: Closures, keyframes: Keyframes, metadata: TableMetadata) -> None:
    """closures.parquet, the ledger with the stamps of both keyframes and each verdict's sentence."""
    _write(path, "closures", _table(CLOSURES, _ledger_columns(closures, keyframes, keyframes)), metadata)


def renumber_references(path: Path, numbers: Ints, library: str) -> None:
    """Write closures.parquet again with its shared references by their numbers in a library of this hash: row r of
    `numbers` (R,) is that of r, and without those that are -1, which it lacks. Raises ResultError."""
    with reading(path), open_table(path) as file:
        _check_name(path, "closures", file.schema_arrow)
        table = read_table(path, file, file.schema_arrow.names)
    found = {name: _lists(table, name) for name in ("shared_references", "shared_overlap")}
    numbers = np.concatenate([numbers, np.full(2**16 - len(numbers), -1)])
    there = [numbers[row] >= 0 for row in found["shared_references"]]
    found["shared_references"] = [numbers[row] for row in found["shared_references"]]
    for name, lists in found.items():
        field = CLOSURES.field(name)
        of_library = [row[known] for row, known in zip(lists, there, strict=True)]
        table = table.set_column(table.schema.names.index(name), field, _array(of_library, field))
    header = {key: value for key, value in (table.schema.metadata or {}).items() if key != VERSION_KEY.encode()}
    header[b"vplog.library"] = library.encode()
    with replacing(path) as stream:
        write_table(stream, table.replace_schema_metadata(header), ROWS_PER_GROUP, compression="zstd")


def write_joins(path: Path, ledgers: Sequence[tuple[Keyframes, Keyframes, Closures]], metadata: TableMetadata) -> None:
    """joins.parquet: the ledgers of pairs of drives, the later one (its keyframes are the queries) and the earlier."""
    _write(path, "joins", _joins(ledgers), metadata)


def joins_as_bytes(
    ledgers: Sequence[tuple[Keyframes, Keyframes, Closures]], metadata: TableMetadata, made_from: str
) -> bytes:
    """The bytes of such a table; `read_metadata` gives the hash of what it was made from as `vplog.made_from`."""
    sink = io.BytesIO()
    table = _with_header(_joins(ledgers), "joins", metadata, {"vplog.made_from": made_from})
    write_table(sink, table, ROWS_PER_GROUP, compression="zstd")
    return sink.getvalue()


def _joins(ledgers: Sequence[tuple[Keyframes, Keyframes, Closures]]) -> pa.Table:
    parts = []
    for later, earlier, closures in ledgers:
        drives = {"query_drive": [later.drive] * len(closures), "match_drive": [earlier.drive] * len(closures)}
        parts.append(_table(JOINS, {**drives, **_ledger_columns(closures, later, earlier)}))
    return pa.concat_tables(parts or [JOINS.empty_table()]).combine_chunks()


def _ledger_columns(closures: Closures, query: Keyframes, match: Keyframes) -> dict[str, Any]:
    return {
        **{name: getattr(closures, name) for name in (*_PLAIN_LEDGER, "shared_references", "shared_overlap", "scale")},
        "query_stamp_ns": query.stamp_ns[closures.query],
        "match_stamp_ns": match.stamp_ns[closures.match],
        **_pose_values("", closures.match_from_query),
        "information": closures.information,
        "covariance": covariance_of(closures.information),
        "verdict": [verdict.value for verdict in closures.verdict],
        "reason": [verdict.sentence for verdict in closures.verdict],
    }


_PLAIN_LEDGER = (
    *("query", "match", "rank", "score", "support", "matches", "landmarks", "inliers", "spread", "reverse_inliers"),
    *("p_false", "residual_before", "residual_after", "weight", "query_camera", "match_camera"),
)
"""Fields of the ledger that are one column as they are."""


def covariance_of(information: Floats) -> Floats:
    """The inverses of matrices (C, 6, 6), NaN where one is not known or leaves a direction open."""
    covariance = np.full(information.shape, np.nan)
    known = np.flatnonzero(np.isfinite(information).all((1, 2)))
    values = np.linalg.eigvalsh(information[known])
    sound = known[values[:, 0] > _OPEN_SHARE * values[:, -1]]
    covariance[sound] = np.linalg.inv(information[sound])
    return covariance


_SCALES = ("odometry", "depth", "stereo", "none")
"""Sources of the metres of a closure."""


EXACT_LEDGER = pa.schema(
    [
        *(CLOSURES.field(name) for name in (*_PLAIN_LEDGER, "shared_references", "shared_overlap", "scale")),
        *(CLOSURES.field(name) for name in ("information", "verdict")),
        column("match_from_query", _POSE, "", "4x4, row by row; NaN where no pose was found."),
    ]
)
"""Columns of a ledger as it is computed: closures.parquet rounds poses to quaternions."""


def exact_ledger(closures: Closures) -> pa.Table:
    """The ledger bit for bit."""
    columns = {name: getattr(closures, name) for name in EXACT_LEDGER.names}
    return _table(EXACT_LEDGER, {**columns, "verdict": [verdict.value for verdict in closures.verdict]})


def ledger_of(table: pa.Table) -> Closures:
    """The ledger of a table with the columns of EXACT_LEDGER. Raises ResultError, ValueError."""
    poses = table["match_from_query"].combine_chunks().flatten().to_numpy().reshape(-1, 4, 4)
    return _ledger_from(table, "A ledger", poses.copy())


def read_closures(path: Path) -> Closures:
    """The ledger."""
    table = _read(path, "closures", CLOSURES)
    return _ledger_from(table, path, read_poses(table, ""))


def read_joins(path: Path) -> dict[tuple[str, str], Closures]:
    """The ledger of each pair of drives (query's, match's) in a table of joins, in order."""
    table = _read(path, "joins", JOINS)
    drives = list(zip(table["query_drive"].to_pylist(), table["match_drive"].to_pylist(), strict=True))
    rows: dict[tuple[str, str], list[int]] = {}
    for row, pair in enumerate(drives):
        rows.setdefault(pair, []).append(row)
    found = {pair: table.take(pa.array(own)) for pair, own in rows.items()}
    return {pair: _ledger_from(own, path, read_poses(own, "")) for pair, own in found.items()}


def _ledger_from(table: pa.Table, path: Path | str, match_from_query: Floats) -> Closures:
    scale = table["scale"].to_pylist()
    if not set(scale) <= set(_SCALES):
        raise ResultError(f"{path}: {sorted(set(scale) - set(_SCALES))[0]!r} is no scale: {', '.join(_SCALES)}.")
    references, overlap = _lists(table, "shared_references"), _lists(table, "shared_overlap")
    if any(len(numbers) != len(shares) for numbers, shares in zip(references, overlap, strict=True)):
        raise ResultError(f"{path} has shared references without their overlap. Run `vplog run` again.")
    return Closures(
        shared_references=references,
        shared_overlap=overlap,
        scale=scale,
        match_from_query=match_from_query,
        information=_matrices(table, "information"),
        verdict=_members(table, "verdict", Verdict, path),
        **{name: _values(table, name) for name in _PLAIN_LEDGER},
    )


def read_closure(path: Path, row: int) -> dict[str, Any]:
    """One row of the ledger by column, None where something is not known. The table is checked as in `read_closures`.

    Raises ResultError where the table has no such row.
    """
    table = _read(path, "closures", CLOSURES)
    if not 0 <= row < len(table):
        known = f"0..{len(table) - 1}" if len(table) else "none: nothing was proposed"
        raise ResultError(f"{path} has no closure {row}. Closures: {known}.")
    [found] = table.slice(row, 1).select(CLOSURES.names).to_pylist()
    return found


def write_edges(path: Path, graph: PoseGraph, solution: Solution, residual: Floats, metadata: TableMetadata) -> None:
    """edges.parquet: the graph, the weights of its solution and the residual (E,) of each edge in sigma."""
    columns = {
        "a": graph.a,
        "b": graph.b,
        "kind": [kind.value for kind in graph.kind],
        **_pose_values("", graph.a_from_b),
        "information": graph.information,
        "weight": solution.weight,
        "residual": residual,
    }
    _write(path, "edges", _table(EDGES, columns), metadata)


def read_edges(path: Path, world_from_body: Floats) -> tuple[PoseGraph, Floats, Floats]:
    """The graph over the nodes given (N, 4, 4), and the weight and residual (E,) of its edges."""
    table = _read(path, "edges", EDGES)
    a, b = _values(table, "a"), _values(table, "b")
    if len(table) and not 0 <= min(a.min(), b.min()) <= max(a.max(), b.max()) < len(world_from_body):
        raise ResultError(f"{path} names a node outside 0..{len(world_from_body) - 1}. Is it of another run?")
    kind = _members(table, "kind", EdgeKind, path)
    graph = PoseGraph(world_from_body, a, b, read_poses(table, ""), _matrices(table, "information"), kind)
    return graph, _values(table, "weight"), _values(table, "residual")


def write_trajectory(path: Path, trajectory: Trajectory, odometry: Odometry, metadata: TableMetadata) -> None:
    """trajectory.parquet: every odometry sample as optimised and, sample for sample, as logged."""
    columns = {
        "stamp_ns": trajectory.stamp_ns,
        **_pose_values("", trajectory.world_from_body),
        **_pose_values("odom_", odometry.odom_from_body),
    }
    _write(path, "trajectory", _table(TRAJECTORY, columns), metadata)


def read_trajectory(path: Path) -> tuple[Trajectory, Odometry]:
    """The optimised trajectory and the odometry it corrects (its covariance is not in the file)."""
    table = _read(path, "trajectory", TRAJECTORY)
    stamp_ns = _values(table, "stamp_ns")
    return Trajectory(stamp_ns, read_poses(table, "")), Odometry(stamp_ns, read_poses(table, "odom_"), None)


def write_descriptors(
    path: Path, keyframes: Keyframes, descriptors: pa.Array, metadata: TableMetadata,
    further: Sequence[tuple[Ints, Ints]] = (),
) -> None:  # fmt: skip
    """descriptors.parquet: the pictures of the first camera in the order of the keyframes, then those of each further
    one by their keyframes' rows and their stamps. Raises ResultError where not each picture has a descriptor."""
    rows = [np.arange(len(keyframes.stamp_ns)), *(row for row, _ in further)]
    stamp_ns = np.concatenate([keyframes.stamp_ns, *(stamps for _, stamps in further)])
    if len(descriptors) != len(stamp_ns):
        each = f"{len(stamp_ns)} {'pictures' if further else 'keyframes'}; each has one"
        raise ResultError(f"{path}: {len(descriptors)} descriptors came for {each}.")
    camera = np.repeat(np.arange(len(rows)), list(map(len, rows)))
    keyframe, cameras = pa.array(np.concatenate(rows), pa.int32()), pa.array(camera, pa.int32())
    columns = [keyframe, pa.array(stamp_ns, pa.int64()), descriptors, cameras]
    table = pa.Table.from_arrays(columns, schema=descriptors_schema(descriptors.type))
    table = table if further else table.drop_columns(["camera"])
    _write(path, "descriptors", table, metadata, DESCRIPTORS_PER_GROUP)


def read_descriptors(path: Path) -> tuple[pa.Array, str]:
    """The descriptors in the order of `read_pictures`, and the hash of the library they belong to."""
    with reading(path), open_table(path) as file:
        _check_name(path, "descriptors", file.schema_arrow)
        table = read_table(path, file, ["descriptor"])
        return table["descriptor"].combine_chunks(), (table.schema.metadata or {}).get(b"vplog.library", b"").decode()


def read_pictures(path: Path) -> tuple[Int32s, Int32s]:
    """(P,) rows of the keyframes of the pictures whose descriptors a table holds, and (P,) their cameras: by camera,
    then keyframe. The first camera has one at each keyframe, unless the table is of a condensed map. Raises
    ResultError."""
    with reading(path), open_table(path) as file:
        named = [name for name in ("keyframe", "camera") if name == "keyframe" or name in file.schema_arrow.names]
        table = read_table(path, file, named)
    sound = all(one.type == pa.int32() and not one.null_count for one in table.columns)
    rows, *known = (one.to_numpy().astype(np.int64) for one in table.columns) if sound else [np.array([-1])]
    camera = known[0] if known else np.zeros_like(rows)
    # the keyframes increase within each camera, and each camera has a picture
    steps = np.where(np.diff(camera, prepend=0) == 0, np.diff(rows, prepend=-1), rows + 1)
    if np.any(steps <= 0) or np.any((np.diff(camera, prepend=0) < 0) | (camera < 0)):
        raise ResultError(f"{path} is damaged: its keyframes do not increase. Run `vplog run` again.")
    return rows.astype(np.int32), camera.astype(np.int32)


def pictures_by_camera(pictures: tuple[Int32s, Int32s]) -> list[tuple[int, slice]]:
    """The cameras of `read_pictures`, each with its rows there."""
    first = np.flatnonzero(np.diff(pictures[1], prepend=-1)).tolist()
    return [(int(pictures[1][a]), slice(a, b)) for a, b in pairwise([*first, len(pictures[1])])]


def read_first_camera(path: Path) -> tuple[pa.Array, str]:
    """The descriptors of the first camera's pictures, and the hash of their library. Raises ResultError."""
    column, library = read_descriptors(path)
    return column.take(pa.array(np.flatnonzero(read_pictures(path)[1] == 0))), library


def on_keyframes(keyframe: Int32s) -> Ints | None:
    """(N,) row of the place nearest to each keyframe, of places (P,) at the keyframes `keyframe`, up to the last of
    these; None where every keyframe has a place."""
    if not len(keyframe) or keyframe[-1] == len(keyframe) - 1:
        return None
    middle = (keyframe[1:].astype(np.int64) + keyframe[:-1]) // 2
    return np.searchsorted(middle, np.arange(keyframe[-1] + 1), side="left")


def write_some_descriptors(source: Path, path: Path, rows: Ints, descriptors: pa.Array, library: str) -> None:
    """Write some rows of the table `source` with their descriptors (N,) replaced by those of a library of this hash.
    Raises ResultError."""
    with reading(source), open_table(source) as file:
        _check_name(source, "descriptors", file.schema_arrow)
        known = ("keyframe", "stamp_ns", "descriptor", "camera")
        table = read_table(source, file, [name for name in known if name in file.schema_arrow.names])
    field = table.schema.field("descriptor")
    table = table.set_column(2, field, descriptors.cast(field.type)).take(pa.array(rows))
    header = {key: value for key, value in (table.schema.metadata or {}).items() if key != VERSION_KEY.encode()}
    header[b"vplog.library"] = library.encode()
    with replacing(path) as stream:
        write_table(stream, table.replace_schema_metadata(header), DESCRIPTORS_PER_GROUP, compression="zstd")


def read_arrow(path: Path) -> pa.Table:
    """A table of a run as Arrow, by the name of its file, its columns checked. Raises ResultError."""
    name = path.stem.removeprefix("joint_")
    if name != "descriptors" and name not in _SCHEMAS:
        raise ResultError(
            f"No table {path.stem!r}.{nearest(name, _SCHEMAS)} Tables: {', '.join(_SCHEMAS)}, descriptors."
        )
    schema = descriptors_schema(descriptors_type(path)) if name == "descriptors" else _SCHEMAS[name]
    return _read(path, name, schema)


def read_stamps(path: Path) -> Ints:
    """Stamps (N,) of the rows of a table of descriptors, in ns. Raises ResultError."""
    with reading(path), open_table(path) as file:
        stamp_ns = read_table(path, file, ["stamp_ns"])["stamp_ns"]
    if stamp_ns.type != pa.int64() or stamp_ns.null_count:
        raise ResultError(f"{path} is damaged: its stamps are no whole numbers of ns. Run `vplog run` again.")
    return np.asarray(stamp_ns.to_numpy(), np.int64)


def descriptors_type(path: Path) -> pa.DataType:
    """The recogniser's own type of a table of descriptors, of which the footer alone is read. Raises ResultError."""
    with reading(path):
        return read_schema(path).field("descriptor").type


def read_metadata(path: Path) -> dict[str, str]:
    """The header of a table: `vplog.settings`, `vplog.library`, `vplog.version`, `vplog.table`."""
    with reading(path):
        header = read_schema(path).metadata or {}
        return {key.decode(): value.decode() for key, value in sorted(header.items()) if key.startswith(b"vplog.")}


def read_table_metadata(path: Path) -> TableMetadata:
    """Settings and library of a table, from its header. Raises ResultError where that lacks the settings."""
    header = read_metadata(path)
    try:
        settings = json.loads(header.get("vplog.settings", "null"))
    except (ValueError, RecursionError):
        settings = None
    if not isinstance(settings, dict):
        raise ResultError(f"{path} lacks its settings. Compute it again from its log.")
    return TableMetadata(settings, header.get("vplog.library", ""))


def placed_table(columns: Sequence[Any]) -> pa.Table:
    """The table PLACED of values (R,) for each column in order, NaN for null."""
    arrays = [pa.array(values, field.type, from_pandas=True) for values, field in zip(columns, PLACED, strict=True)]
    return pa.Table.from_arrays(arrays, schema=PLACED)


def write_placed(path: Path, table: pa.Table, metadata: TableMetadata) -> None:
    """Write the places of a log's views in a map; `metadata` is that of the map."""
    _write(path, "placed", table, metadata, None)


def write_localized(path: Path, records: Sequence[dict[str, Any]], metadata: TableMetadata) -> None:
    """Write the records of pictures, in order; `metadata` is that of the map."""
    rows = [{**one, "covariance": np.ravel(one["covariance"])} if "covariance" in one else one for one in records]
    _write(path, "localized", pa.Table.from_pylist(rows, LOCALIZED), metadata, None)


def _table(schema: pa.Schema, columns: dict[str, Any]) -> pa.Table:
    return pa.Table.from_arrays([_array(columns[column.name], column) for column in schema], schema=schema)


def _write(
    path: Path, name: str, table: pa.Table, metadata: TableMetadata, rows_per_group: int | None = ROWS_PER_GROUP
) -> None:
    with replacing(path) as stream:
        write_table(stream, _with_header(table, name, metadata, {}), rows_per_group, compression="zstd")


def _with_header(table: pa.Table, name: str, metadata: TableMetadata, more: dict[str, str]) -> pa.Table:
    return table.replace_schema_metadata({**metadata.record(), "vplog.table": name, **more})


def _array(values: Any, column: pa.Field) -> pa.Array:
    """The values of a column; NaN is null where the column may be null."""
    if column.type in (_NUMBERS, FLOAT32_LIST):
        offsets = np.cumsum([0, *map(len, values)], dtype=np.int32)
        flat = pa.array(np.concatenate([*values, np.empty(0)]), column.type.value_type)
        return pa.ListArray.from_arrays(offsets, flat, type=column.type)
    if column.type not in (MATRIX, _POSE):
        return pa.array(values, column.type, mask=np.isnan(values) if column.nullable else None)
    rows = np.ascontiguousarray(values, np.float64).reshape(-1, column.type.list_size)
    unknown = pa.array(np.isnan(rows).all(1)) if column.nullable else None
    return pa.FixedSizeListArray.from_arrays(pa.array(rows.reshape(-1)), type=column.type, mask=unknown)


def _read(path: Path, name: str, schema: pa.Schema) -> pa.Table:
    """The table with the columns of the schema, checked; null where an older vplog wrote none. Raises ResultError."""
    with reading(path), open_table(path) as file:
        _check_name(path, name, file.schema_arrow)
        check_columns(file.schema_arrow, schema)
        table = filled(read_table(path, file, schema.names), schema)
    for field in schema:
        if not field.nullable and table[field.name].null_count:
            raise ResultError(f"{path} holds nulls in column {field.name}. Run `vplog run` again.")
    return table


def _check_name(path: Path, name: str, schema: pa.Schema) -> None:
    found = (schema.metadata or {}).get(b"vplog.table", b"").decode()
    if found != name:
        raise ResultError(f"{path} is not a {name} table of vplog (its name is {found!r}). Give the folder of a run.")


@contextmanager
def reading(
    what: Path | str,
    again: str = "Run `vplog run` again.",
    missing: str = "Give the folder that `vplog run -o` wrote.",
    more: tuple[type[Exception], ...] = (),
) -> Iterator[None]:
    """Raises ResultError in place of the errors of a file that is missing or damaged, and of `more`, with a remedy."""
    try:
        yield
    except FileNotFoundError:
        raise ResultError(f"{what} does not exist. {missing}".rstrip()) from None
    except (OSError, LookupError, ValueError, RecursionError, pa.ArrowException, *more) as error:
        raise unreadable(what, error, again) from None


def unreadable(what: Path | str, error: Exception, again: str = "") -> ResultError:
    """The error of a damaged file in one line, with a remedy."""
    why = next(iter(str(error).splitlines()), type(error).__name__)
    return ResultError(f"{what} cannot be read: {why.rstrip('.')}. {again}".rstrip())


def _pose_values(prefix: str, poses: Floats) -> dict[str, Floats]:
    names = [f"{prefix}{name}" for name in POSE_COLUMNS]
    return dict(zip(names, np.ascontiguousarray(se3.vectors(poses).T), strict=True))


def read_poses(table: pa.Table, prefix: str) -> Floats:
    """(R, 4, 4), all NaN where the row holds none."""
    values = np.stack([_values(table, f"{prefix}{name}") for name in POSE_COLUMNS], 1)
    poses = se3.from_vectors(values)
    poses[~np.isfinite(poses).all((1, 2))] = np.nan
    return poses


def _values(table: pa.Table, name: str) -> np.ndarray:
    """A column as an array of its own, which may be written to; whole numbers that are null, as cameras, are 0."""
    column = table[name]
    whole = column.null_count and pa.types.is_integer(column.type)
    return np.array((column.fill_null(0) if whole else column).to_numpy())


def _members(table: pa.Table, name: str, kind: type[T], path: Path | str) -> list[T]:
    """A column of the values of an enumeration. Raises ResultError where one is none of them."""
    try:
        return [kind(text) for text in table[name].to_pylist()]
    except ValueError as error:
        raise ResultError(f"{path}: {error}. {name.capitalize()}s: {', '.join(kind)}.") from None


def _lists(table: pa.Table, name: str) -> list[np.ndarray]:
    """A column of lists, each an array of its own."""
    column = table[name].combine_chunks()
    values, ends = column.flatten().to_numpy(), np.cumsum(column.value_lengths().to_numpy())
    return [part.copy() for part in np.split(values, ends[:-1])] if len(column) else []


def _matrices(table: pa.Table, name: str) -> Floats:
    """(R, 6, 6), NaN where the row holds none."""
    column = table[name].combine_chunks()
    matrices = np.full((len(column), 6, 6), np.nan)
    matrices[column.is_valid().to_numpy(zero_copy_only=False)] = column.flatten().to_numpy().reshape(-1, 6, 6)
    return matrices
