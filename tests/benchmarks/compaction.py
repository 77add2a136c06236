"""Bytes a place of small drives beside those of a large one, before and after `vplog map compact`, in a map on a server
that speaks S3 on loopback, and in the Delta tables of the map.

Made-up drives with as many rows as real ones have: a keyframe a metre with its place and covariance, eight samples of
odometry and 1.1 candidates a keyframe, and run.json with all settings; no report and no pictures.
"""

from __future__ import annotations

from dataclasses import fields, replace
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from tests.benchmarks.measure import Figure
from tests.benchmarks.scale import made_up_library
from tests.benchmarks.search import make_places
from tests.maps.bucket import serving
from tests.maps.runs import LIBRARY, put_library
from tests.results.example import make_run
from vplog.data import Keyframes, Trajectory
from vplog.geometry import tum
from vplog.maps.snapshots import compact_map, write_delta
from vplog.maps.storage import layout, map_store, snapshot, upload
from vplog.pipeline import load_pipeline
from vplog.places.bobb import BobbSettings, Place
from vplog.results import run_record, tables
from vplog.storage.remote_path import located, objects_below

if TYPE_CHECKING:
    from collections.abc import Iterator
    from pathlib import Path

    from vplog.data import Floats

T = TypeVar("T")
MAPS = {"small": (100, 20), "large": (1, 2000)}
"""Drives, and places of each."""
BAR = 1.2
REFERENCES = 1000


def compaction() -> Iterator[Figure]:
    """Bytes a place of small drives as a share of those of a large one."""
    found = dict[str, dict[str, float]]()
    with serving():
        for name, (count, places) in MAPS.items():
            root = located(f"s3://bucket/{name}")
            with map_store.writing(root) as store:
                put_library(store)
                for number in range(count):
                    made = store.staging / "run"
                    _write_run(made, f"drive{number}", places, number)
                    map_store.publish(store, f"drive{number}", made)
            before = _bytes(root)
            compact_map(root)
            write_delta(root)
            compact_map(root)
            with map_store.writing(root) as store:
                upload.vacuum(store.mirror, -1.0)  # pyrefly: ignore[bad-argument-type]
            after = _bytes(root)
            found[name] = {
                f"{what} {when}": round(size / count / places, 1)
                for when, sizes in (("before", before), ("after", after))
                for what, size in sizes.items()
            }
    for what in ("drives", "delta"):
        facts = {f"{name} {key}": value for name, one in found.items() for key, value in one.items() if what in key}
        ratio = found["small"][f"{what} after"] / found["large"][f"{what} after"]
        yield Figure(f"compaction, {what}: bytes a place, small to large", ratio, BAR, True, facts)


def _bytes(root: Any) -> dict[str, int]:
    """Bytes of drives and what names them, of tables by drive, and of Delta tables; and the number of objects."""
    manifest = snapshot.Manifest(root)
    named = {"map.json", manifest.log[0]["object"], *(row["object"] for row, _ in manifest.layers)}
    kinds = {**dict.fromkeys(("runs", "packs"), "drives"), **dict.fromkeys(layout.TABLES, "tables"), "delta": "delta"}
    sizes = dict.fromkeys(("drives", "tables", "delta"), 0)
    for name, meta in objects_below(root).items():
        kind = "drives" if name in named else kinds.get(name.split("/")[0])
        if kind is not None:
            sizes[kind] += meta["size"]
    return sizes


def _write_run(folder: Path, drive: str, count: int, seed: int) -> None:
    """A run folder of so many places, its values all different."""
    rng, run, settings = np.random.default_rng(seed), make_run(seed), BobbSettings()
    folder.mkdir(parents=True)
    about = tables.TableMetadata(load_pipeline("default").model_dump(mode="json"), LIBRARY)
    stamps = 1_700_000_000_000_000_000 + np.arange(8 * count) * 125 * 10**5
    keyframes = Keyframes(drive, stamps[::8], _poses(rng, count))
    noise = rng.normal(size=(count, 6, 6))
    covariance = noise @ noise.transpose(0, 2, 1)
    tables.write_keyframes(folder / "keyframes.parquet", keyframes, _poses(rng, count), about, covariance)
    places = make_places(count, settings, seed, REFERENCES, count)
    column = made_up_library(settings, REFERENCES).to_arrow(
        [Place(*one) for one in zip(places.references, places.weights, places.boxes, strict=True)]
    )
    tables.write_descriptors(folder / "descriptors.parquet", keyframes, column, about)
    query = np.sort(rng.integers(0, count, count + count // 10)).astype(np.int32)
    closures = _tiled(run.closures, len(query), rng)
    closures = replace(closures, query=query, match=query // 2)
    tables.write_closures(folder / "closures.parquet", closures, keyframes, about)
    edges = count - 1 + count // 10
    graph = _tiled(run.graph, edges, rng, len(run.graph.a))
    first = np.arange(edges, dtype=np.int32) % (count - 1)
    graph = replace(graph, a=first, b=first + 1, a_from_b=_poses(rng, edges))
    solution = replace(run.solution, weight=rng.uniform(size=edges))
    tables.write_edges(folder / "edges.parquet", graph, solution, rng.uniform(size=edges), about)
    trajectory = Trajectory(stamps, _poses(rng, len(stamps)))
    odometry = replace(run.odometry, stamp_ns=stamps, odom_from_body=_poses(rng, len(stamps)), covariance=None)
    tables.write_trajectory(folder / "trajectory.parquet", trajectory, odometry, about)
    tum.write_tum(folder / "trajectory.tum", trajectory)
    run_record.write_run_json(folder / "run.json", {"finished": True, "settings": about.settings, "seed": seed})
    made_from = {"drive": drive, "inputs": {"log": f"{seed}"}, "library": LIBRARY, "topics": {}}
    record = {**made_from, "key": layout.key_of(made_from), "log": f"/logs/{drive}.mcap"}
    run_record.write_run_json(folder / "drive.json", record)


def _poses(rng: np.random.Generator, count: int) -> Floats:
    """(N, 4, 4) of a walk in the plane."""
    found, turn = np.tile(np.eye(4), (count, 1, 1)), np.cumsum(rng.normal(size=count) * 0.02)
    found[:, :3, 3] = np.cumsum(rng.normal(size=(count, 3)), 0)
    found[:, 0, 0] = found[:, 1, 1] = np.cos(turn)
    found[:, 1, 0] = np.sin(turn)
    found[:, 0, 1] = -found[:, 1, 0]
    return found


def _tiled(one: T, count: int, rng: np.random.Generator, length: int | None = None) -> T:
    """A record of arrays of a length, or lists, repeated to so many, with other fractions each time."""
    found = dict[str, Any]()
    for field in fields(one):  # pyrefly: ignore[bad-argument-type]
        values = getattr(one, field.name)
        if values is None or np.isscalar(values) or (length is not None and len(values) != length):
            continue
        rows = np.arange(count) % len(values)
        if isinstance(values, np.ndarray):
            found[field.name] = values[rows]
            if values.dtype.kind == "f":
                found[field.name] = values[rows] * rng.uniform(0.99, 1, (count, *[1] * (values.ndim - 1)))
        else:
            found[field.name] = [values[row] for row in rows]
    return replace(one, **found)  # pyrefly: ignore[bad-specialization]
