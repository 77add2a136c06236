"""Places of an exported file as drives of a map: they can be found again, and no more than that.

Such a drive has no closures and no edges, its trajectory is that of its keyframes, and it is joined with no other
drive, for which its log would be needed. `vplog batch` with the log makes it a whole one.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa

from vplog.data import EdgeKind, Keyframes, Odometry, PoseGraph, Solution, Trajectory
from vplog.errors import LibraryError, ResultError
from vplog.execution.execution import Execution
from vplog.loops.verify import no_closures
from vplog.maps.geo_bounds import earth_from_record, earth_record
from vplog.maps.storage import layout, map_store
from vplog.maps.storage.layout import PLACES_ONLY
from vplog.maps.storage.map_store import Store
from vplog.pipeline import Pipeline
from vplog.results import run_record, tables
from vplog.results.places_map import DrivePlaces, PlacesHeader, read_drives, read_places_header
from vplog.storage.remote_path import original


def drives_of_file(path: Path) -> dict[str, dict[str, Any]]:
    """drive.json of each drive in an exported file, but for its key, in order. Raises ResultError."""
    about = read_places_header(path)
    return {drive: _record(path, about, drive) for drive in about.drives}


def import_places_of(store: Store, path: Path, wanted: dict[str, str]) -> Iterator[str]:
    """Put the places of the drives that are `wanted`, by their IDs in the file, into the map under the IDs given; each
    by its ID in the file when it is in. Raises ResultError."""
    about, kind = read_places_header(path), _kind(store, path)
    made = store.staging / f"{os.getpid()}-import"
    for places in read_drives(path, kind):
        if places.drive not in wanted:
            continue
        shutil.rmtree(made, ignore_errors=True)
        made.mkdir()
        taken, record = wanted[places.drive], _record(path, about, places.drive)
        _write_run(made, places, taken, about)
        earth = earth_record(earth_from_record(record["earth"]), places.world_from_body)
        record = {**record, "drive": taken, "earth": earth}
        run_record.write_run_json(made / "drive.json", {**record, "key": layout.key_of(record | {"earth": None})})
        map_store.publish(store, taken, made)
        yield places.drive


def _record(path: Path, about: PlacesHeader, drive: str) -> dict[str, Any]:
    entry = about.drives.get(drive, {})
    inputs, topics = entry.get("inputs"), entry.get("topics")
    return {
        "drive": drive,
        "log": f"{_where(path)}#{drive}",
        "inputs": inputs if isinstance(inputs, dict) else {},
        "topics": topics if isinstance(topics, dict) else {},
        "settings": layout.key_of(about.settings),
        "library": about.library,
        "earth": entry.get("earth"),
        PLACES_ONLY: path.name,
    }


def _where(path: Path) -> str:
    """The path of a file, or the URL that it is a copy of."""
    known = original(path)
    return str(known.absolute() if known is path else known)


def _kind(store: Store, path: Path) -> pa.DataType:
    """The Arrow type of the descriptors of a map."""
    library = store.head().library
    for drive in store.drives():
        return tables.descriptors_type(store.file(drive, "descriptors.parquet"))
    if library is None:
        raise LibraryError(f"{store} has no library yet, and {path} holds places alone. Add a drive first: vplog batch")
    pipeline = Pipeline.read(store.head().settings, f"{store}/map.json")
    return pipeline.places.load(store.library(library), Execution()).arrow_type


def _write_run(folder: Path, places: DrivePlaces, drive: str, about: PlacesHeader) -> None:
    stamps, poses = places.stamp_ns, places.world_from_body
    if not np.isfinite(poses).all() or np.any(np.diff(stamps) <= 0):
        raise ResultError(f"{places.source}: {drive} has poses that are not finite, or stamps that do not increase.")
    account = {
        "log": f"{_where(places.source)}#{drive}",
        "library": {"hash": about.library, "from": _where(places.source)},
        "warnings": [f"Places alone, from {places.source.name}."],
    }
    header = tables.TableMetadata(about.settings, about.library)
    write_places_run(folder, Keyframes(drive, stamps, poses), places.descriptors, header, account)


def write_places_run(
    folder: Path, keyframes: Keyframes, descriptors: pa.Array, header: tables.TableMetadata, account: dict[str, Any]
) -> dict[str, Any]:
    """Write the run folder of keyframes and descriptors that can be found again, with neither closures nor edges, and
    its run.json: `account`, and what all runs have."""
    stamps, poses = keyframes.stamp_ns, keyframes.odom_from_body
    none, kinds = np.empty(0), list[EdgeKind]()
    rows = none.astype(np.int32)
    graph = PoseGraph(poses, rows, rows, np.empty((0, 4, 4)), np.empty((0, 6, 6)), kinds)
    solution = Solution(poses, none, 0.0, 0.0, 0, True, "Places alone were taken.")
    tables.write_keyframes(folder / "keyframes.parquet", keyframes, poses, header)
    tables.write_descriptors(folder / "descriptors.parquet", keyframes, descriptors, header)
    tables.write_closures(folder / "closures.parquet", no_closures(), keyframes, header)
    tables.write_edges(folder / "edges.parquet", graph, solution, none, header)
    tables.write_trajectory(
        folder / "trajectory.parquet", Trajectory(stamps, poses), Odometry(stamps, poses, None), header
    )
    counts = {"keyframes": len(stamps), "candidates": 0, "verdicts": {}}
    record = {"finished": True, "settings": header.settings, "counts": counts, **account}
    run_record.write_run_json(folder / "run.json", record)
    return record
