"""A bit that flips in a file is an error in one line, or changes nothing that is read."""

from __future__ import annotations

import random
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import cv2
import duckdb
import numpy as np
import pandas as pd
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.benchmarks.scale import made_up_library, write_drive
from tests.benchmarks.search import make_places
from tests.results.example import COUNT, METADATA, make_run, write_map
from tests.results.test_tables import write_all
from vplog.data import Features, Gps, Reference
from vplog.errors import ResultError, VplogError
from vplog.maps.search.index import update_index
from vplog.maps.search.segment import open_segment
from vplog.maps.storage.map_store import Store
from vplog.places.bobb import BobbSettings
from vplog.places.library_files import load_references, save_references
from vplog.results import feature_table, geo, mcap_read, places_map, tables
from vplog.results.geo import Earth
from vplog.results.landmark_table import LandmarkTable, write_landmarks
from vplog.results.mcap import McapExtras, write_mcap
from vplog.run.cache.codecs import closures_codec
from vplog.run.cache.stage_cache import DamagedError, content_of, digest_of, sealed

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    Read = Callable[[Path], Any]

FLIPS = 200
RUN = make_run()
KIND = pa.struct([("references", pa.list_(pa.uint16(), 3)), ("boxes", pa.list_(pa.uint8(), 6))])


def features(row: int) -> Features:
    rng = np.random.default_rng(row)
    floats = rng.random((4, 20), np.float32)
    described = rng.integers(256, size=(20, 128)).astype(np.uint8)
    return Features(floats[:2].T.copy(), floats[2], described, floats[3], 64, 48)


def read_kept(path: Path) -> Any:
    kept = feature_table.FeatureTable(path, "state", 20)
    try:
        return [plain(kept[row]) for row in range(len(kept))]
    finally:
        kept.close()


def read_landmarks(path: Path) -> Any:
    table = LandmarkTable(path, "state")
    try:
        return table.scale, plain(table.camera), [plain(table[row]) for row in range(len(table))]
    finally:
        table.close()


def write_tables(folder: Path) -> dict[Path, list[Read]]:
    """Every table that vplog writes, with all that reads it."""
    keyframes, closures, edges, trajectory, descriptors = write_all(folder)
    rng = np.random.default_rng(0)
    column = pa.array(
        [{"references": rng.integers(100, size=3), "boxes": rng.integers(256, size=6)} for _ in range(COUNT)], KIND
    )
    (folder / "run").mkdir()
    tables.write_keyframes(folder / "run" / "keyframes.parquet", RUN.keyframes, RUN.solution.world_from_body, METADATA)
    tables.write_descriptors(folder / "run" / "descriptors.parquet", RUN.keyframes, column, METADATA)
    exported = folder / "map.parquet"
    write_map(exported, [folder / "run"])
    kept, joins, answers = folder / "features.parquet", folder / "joins.parquet", folder / "placed.parquet"
    feature_table.write_features(kept, 5, features, 20, "state")
    landmarks, own = folder / "landmarks.parquet", replace(features(0), depth_m=np.linspace(1, 9, 20, dtype=np.float32))
    write_landmarks(landmarks, [(own, np.full(20, 0.1))], RUN.camera, "depth", "state")
    tables.write_joins(joins, [(RUN.keyframes, RUN.keyframes, RUN.closures)], METADATA)
    rows = np.arange(9, dtype=np.int32)
    share = rows.astype(np.float32) / 9
    values = [rows, rows.astype(np.int64), rows, ["a"] * 9, rows, rows.astype(np.int64), share, rows, share, rows]
    tables.write_placed(answers, tables.placed_table(values), METADATA)
    geo.write_geoparquet(folder / "geo.parquet", RUN.trajectory, Earth((48.0, 11.0, 500.0), np.eye(4)), {})
    world = RUN.solution.world_from_body
    return {
        keyframes: [tables.read_keyframes, tables.read_metadata],
        closures: [tables.read_closures, lambda path: tables.read_closure(path, 1)],
        edges: [lambda path: tables.read_edges(path, world)],
        trajectory: [tables.read_trajectory],
        descriptors: [tables.read_descriptors, tables.read_stamps, tables.descriptors_type],
        joins: [tables.read_joins, tables.read_metadata],
        kept: [read_kept],
        landmarks: [read_landmarks],
        exported: [
            lambda path: list(places_map.read_drives(path, KIND)),
            places_map.read_places_header,
            places_map.places_by_drive,
        ],
        answers: [],
        folder / "geo.parquet": [],
    }


def plain(value: Any) -> Any:
    """As what can be compared, NaN too."""
    if hasattr(value, "__dict__") and not isinstance(value, type):
        return {name: plain(one) for name, one in vars(value).items() if name != "source"}
    if isinstance(value, dict):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, np.ndarray):
        return digest_of(value)
    if isinstance(value, pa.Array | pa.Table | pa.ChunkedArray):
        return value.to_pylist()
    return str(value)


def silent(path: Path, read: Read, seed: int, flips: int = FLIPS, among: range | None = None) -> list[int]:
    """The bits whose flip changes what is read without a word."""
    data, wanted = path.read_bytes(), plain(read(path))
    bits = among or range(8 * len(data))
    changed = []
    for bit in random.Random(seed).sample(bits, min(flips, len(bits))):
        damaged = bytearray(data)
        damaged[bit // 8] ^= 1 << bit % 8
        path.write_bytes(damaged)
        try:
            found = plain(read(path))
        except VplogError as error:
            assert "\n" not in str(error)
            assert path.name in str(error) or path.parent.name in str(error)
            continue
        if found != wanted:
            changed.append(bit)
    path.write_bytes(data)
    return changed


def test_no_flip_in_a_table_is_silent(tmp_path: Path) -> None:
    """Anywhere: in pages, in their headers, in the footer and in what sums them up."""
    for number, (path, readers) in enumerate(write_tables(tmp_path).items()):
        for read in readers:
            assert silent(path, read, number) == [], path.name


def test_no_flip_at_the_end_of_a_table_is_silent(tmp_path: Path) -> None:
    """Every bit of the seal, of the footer's length and of the magic."""
    path = write_all(tmp_path)[0]
    size = path.stat().st_size
    footer = int.from_bytes(path.read_bytes()[-8:-4], "little")
    seal = range(8 * (size - 8 - footer - 16), 8 * (size - 8 - footer))
    for among in (range(8 * (size - 8), 8 * size), seal):
        assert silent(path, tables.read_keyframes, 0, len(among), among) == []


def test_other_programs_read_the_tables(tmp_path: Path) -> None:
    for path in write_tables(tmp_path):
        read = pq.read_table(path)
        assert pq.ParquetFile(path, page_checksum_verification=True).read().equals(read)
        assert len(pd.read_parquet(path)) == len(read) > 0
        assert duckdb.read_parquet(str(path)).to_arrow_table().num_rows == len(read)
        assert pq.ParquetFile(path).metadata.row_group(0).column(0).physical_type


def test_a_table_that_another_program_wrote_again_is_read(tmp_path: Path) -> None:
    path = write_all(tmp_path)[1]
    before = plain(tables.read_closures(path))
    pq.write_table(pq.read_table(path), path)
    assert plain(tables.read_closures(path)) == before


def test_no_flip_in_a_library_is_silent(tmp_path: Path) -> None:
    rng = np.random.default_rng(0)
    images = [rng.integers(256, size=(48, 64)).astype(np.uint8) for _ in range(3)]
    references = [
        Reference(cv2.GaussianBlur(image, (5, 5), 2).astype(np.uint8), features(row), "walk", row)
        for row, image in enumerate(images)
    ]
    save_references(references, BobbSettings(), tmp_path / "lib")
    for number, name in enumerate(("features.parquet", "references.parquet")):
        assert silent(tmp_path / "lib" / name, lambda path: load_references(path.parent), number) == [], name


@pytest.mark.parametrize("name", ["keyframes", "closures", "edges", "trajectory", "descriptors"])
def test_the_checksums_take_little(tmp_path: Path, name: str) -> None:
    """Six bytes a page and 16 a file."""
    [path] = [one for one in write_all(tmp_path) if one.stem == name]
    size = path.stat().st_size
    pq.write_table(pq.read_table(path), tmp_path / "bare", compression="zstd", row_group_size=tables.ROWS_PER_GROUP)
    pages = 2 * pq.ParquetFile(path).metadata.num_columns
    assert size - (tmp_path / "bare").stat().st_size <= 6 * pages + 16


def test_no_flip_in_what_is_read_of_an_mcap_is_silent(tmp_path: Path) -> None:
    """In names of topics and in indexes too, which no checksum of a chunk covers."""
    path, stamp_ns = tmp_path / "result.mcap", RUN.keyframes.stamp_ns
    degrees = np.full(len(stamp_ns), 48.0)
    gps = Gps(stamp_ns, degrees, degrees, degrees, np.full((len(stamp_ns), 3, 3), np.nan))
    extras = McapExtras(
        camera=RUN.camera, image=lambda row: bytes([row]) * 50, image_size=(64, 48), references={3: b"reference" * 9},
        pictures={0: b"closure" * 20}, gps=gps,
    )  # fmt: skip
    write_mcap(path, RUN.keyframes, RUN.solution.world_from_body, RUN.graph, RUN.closures, METADATA, extras)
    readers = (mcap_read.read_pictures, mcap_read.read_fixes, mcap_read.read_camera_poses)
    for number, read in enumerate((*readers, lambda path: list(mcap_read.read_images(path)))):
        assert silent(path, read, number) == []


def test_no_flip_in_a_part_of_an_index_is_silent(tmp_path: Path) -> None:
    settings = BobbSettings(references=4, windows_along=2)
    state, store = made_up_library(settings, 30), Store(tmp_path)
    write_drive(store, 0, make_places(40, settings, 0, 30, 40), state)
    [part], _ = update_index(store, store.drives(), state)
    assert part.path is not None
    assert silent(part.path, open_segment, 0) == []


def test_no_flip_in_the_stage_cache_is_silent(tmp_path: Path) -> None:
    """Of what a stage came to, and of its key, which is in the file."""
    path, key, codec = tmp_path / "stage", "ab" * 32, closures_codec()
    path.write_bytes(sealed(key, codec.to_bytes(RUN.closures)))

    def read(path: Path) -> Any:
        try:
            return codec.from_bytes(content_of(path.read_bytes(), key).tobytes())
        except DamagedError as error:
            raise ResultError(f"{path}: {error}") from None

    assert silent(path, read, 0) == []
