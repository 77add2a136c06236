"""Run folders of a few kB that a map takes for finished drives."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from functools import cache
from pathlib import Path
from tempfile import TemporaryDirectory, mkdtemp
from typing import TYPE_CHECKING, Any

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from tests.results.example import COUNT, make_run
from vplog.geometry import tum
from vplog.maps.storage import layout, map_store
from vplog.pipeline import load_pipeline
from vplog.results import run_record, tables

if TYPE_CHECKING:
    from vplog.data import Floats
    from vplog.maps.storage.map_store import Store

LIBRARY, OTHER_LIBRARY = "a" * 64, "b" * 64
PLACES = COUNT
"""Of every drive."""
_FOLDER = TemporaryDirectory(prefix="runs-")
KIND = pa.struct([("references", pa.list_(pa.uint16(), 3)), ("boxes", pa.list_(pa.uint8(), 6))])


def write_run(
    folder: Path, drive: str, seed: int = 0, library: str = LIBRARY, world_from_enu: Floats | None = None
) -> Path:
    """Every file of a run says `seed` in its own way. On earth where it says how it lies there."""
    if world_from_enu is not None:
        return _written(folder, drive, seed, library, world_from_enu)
    shutil.copytree(_made(drive, seed, library), folder, copy_function=shutil.copyfile)
    return folder


@cache
def _made(drive: str, seed: int, library: str) -> Path:
    """Such a run, written once by each process of the tests."""
    return _written(Path(mkdtemp(dir=_FOLDER.name)) / "run", drive, seed, library, None)


def _written(folder: Path, drive: str, seed: int, library: str, world_from_enu: Floats | None) -> Path:
    run, rng, about = make_run(seed), np.random.default_rng(seed), tables.TableMetadata({"seed": seed}, library)
    folder.mkdir(parents=True)
    keyframes = replace(run.keyframes, drive=drive)
    column = pa.array(
        [{"references": rng.integers(100, size=3), "boxes": rng.integers(256, size=6)} for _ in range(COUNT)], KIND
    )
    tables.write_keyframes(folder / "keyframes.parquet", keyframes, run.solution.world_from_body, about)
    tables.write_descriptors(folder / "descriptors.parquet", keyframes, column, about)
    tables.write_closures(folder / "closures.parquet", run.closures, keyframes, about)
    residual = np.zeros(len(run.graph.a))
    tables.write_edges(folder / "edges.parquet", run.graph, run.solution, residual, about)
    tables.write_trajectory(folder / "trajectory.parquet", run.trajectory, run.odometry, about)
    tum.write_tum(folder / "trajectory.tum", run.trajectory)
    origin = {"latitude_deg": 48.0, "longitude_deg": 11.0, "altitude_m": 500.0}
    gps = None if world_from_enu is None else {"origin": origin, "world_from_enu": world_from_enu.tolist()}
    run_record.write_run_json(folder / "run.json", {"finished": True, "settings": {"seed": seed}, "gps": gps})
    made_from = {"drive": drive, "inputs": {"log": f"sha256 of {seed}"}, "library": library, "topics": {}}
    log = f"/logs/{seed}/{drive.partition('-')[0]}.mcap"
    run_record.write_run_json(folder / "drive.json", {**made_from, "key": layout.key_of(made_from), "log": log})
    return folder


def map_of_run(root: Path, finished: Path) -> Path:
    """A map of three drives: every place of a finished run, its second half backwards, and its first ten."""
    library = json.loads((finished / "library" / "library.json").read_text())["hash"]
    with map_store.writing(root) as store:
        shutil.copytree(finished / "library", store.staging / "library")
        map_store.add_library(store, store.staging / "library", library)
        store.write_head(map_store.Head(library, load_pipeline("default").model_dump(mode="json")))
        for name, rows in (("all", slice(None)), ("back 1/2", slice(None, 20, -1)), ("ten", slice(10))):
            put_rows(store, name, finished, library, rows)
    return root


def make_map(root: Path, drives: dict[str, int], library: str = LIBRARY) -> Path:
    """A map of such drives, by ID and seed."""
    with map_store.writing(root) as store:
        put_library(store, library)
        for drive, seed in drives.items():
            put(store, drive, seed, library)
    return root


def put_library(store: Store, library: str = LIBRARY) -> None:
    made = store.staging / "library"
    shutil.rmtree(made, ignore_errors=True)
    made.mkdir()
    (made / "features").write_bytes(b"features")
    (made / "library.json").write_text(json.dumps({"hash": library, "settings": {}, "references": 3, "features": 9}))
    map_store.add_library(store, made, library)
    store.write_head(map_store.Head(library, {"seed": 0}))


def put(store: Store, drive: str, seed: int, library: str = LIBRARY, **more: Any) -> None:
    folder = store.staging / f"{seed}"
    shutil.rmtree(folder, ignore_errors=True)
    map_store.publish(store, drive, write_run(folder, drive, seed, library, **more))


def put_rows(store: Store, name: str, run: Path, library: str, rows: slice = slice(None)) -> None:
    """A copy of a run as a drive of the map, or some of its places."""
    made = store.staging / name
    shutil.copytree(run, made, ignore=shutil.ignore_patterns("library"))
    path = made / "descriptors.parquet"
    table = pq.read_table(path)
    order = np.arange(len(table))[rows]
    header = {**table.schema.metadata, b"vplog.library": library.encode()}
    table = table.take(pa.array(order))
    column = pa.array(np.arange(len(table), dtype=np.int32))
    table = table.set_column(0, table.schema.field(0), column)  # each is of the keyframe of its row
    pq.write_table(table.replace_schema_metadata(header), path)
    about = {"drive": name, "log": f"/logs/{name}.mcap", "key": "k", "library": library, "inputs": {}}
    run_record.write_run_json(made / "drive.json", about)
    map_store.publish(store, name, made)


def seeds(run: Path) -> set[Any]:
    """What the files of a run folder say."""
    said: set[Any] = {run_record.read_run_json(run / "run.json")["settings"]["seed"]}
    for name in map_store.TABLES:
        said.add(json.loads(tables.read_metadata(run / f"{name}.parquet")["vplog.settings"])["seed"])
    return said
