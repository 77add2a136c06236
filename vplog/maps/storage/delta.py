"""The data sets of a map as Delta Lake tables, which others read at a version; every drive is in one whole, or not.

    MAP/delta/commits/VERSION.json               the files that a version adds and removes; of every 50th, all it has
    MAP/delta/NAME/FILE.parquet                  a data set in files of up to 100 MB, each drive in one row group
    MAP/delta/NAME/_delta_log/VERSION.json, ...  the log of a data set, which says what the commits say of it

A commit is what is missing to the map as it is read after all commits before, made where nobody was first with its
number. So writers do not exclude each other, and what a killed one left out the next one adds. Logs are written from
commits alone, that of keyframes last: a version of it is there in all others, and is of one state of the map.
"""

from __future__ import annotations

import json
import secrets
import time
import uuid
from collections.abc import Iterable, Mapping, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, cast
from urllib.parse import quote

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from vplog.data import Ints
from vplog.errors import ResultError
from vplog.maps.storage import delta_log, objects
from vplog.maps.storage.contents import Store, skip_damaged
from vplog.maps.storage.damage import files_of, reading_drive
from vplog.maps.storage.layout import TABLES, grouped
from vplog.maps.storage.snapshot import store_errors
from vplog.results import tables
from vplog.storage import remote_path
from vplog.storage.json_records import has_checksum, key_of, with_checksum
from vplog.storage.parquet_limits import check_version
from vplog.storage.remote_path import RemotePath
from vplog.storage.scratch import scratch

_FORMAT = 1
"""Version of the commits."""
_FILE_BYTES = 100_000_000
"""Longest file, unless a single drive has more. What is shorter than half of it is small."""
_ALL_EVERY = 50
"""Commits from one that names all files to the next; there Delta's logs have a checkpoint."""
_GROUP_ROWS = 4096
"""Rows of a row group, unless a single drive has more: pages of a few rows take as much as these do."""
_FIRST = f"commits/{0:020}.json"
"""It stays as long as the tables do."""
_TRIES = 100
PATIENCE_S = 60.0
"""Time from one commit of a batch to the next."""


def _place(store: Store) -> RemotePath:
    """MAP/delta."""
    root = RemotePath(f"file://{quote(str(store.root.resolve()))}") if store.mirror is None else store.mirror.remote
    return root / "delta"


def is_present(store: Store) -> bool:
    """Whether the map has Delta tables."""
    if store.mirror is None:
        return (store.root / "delta" / _FIRST).is_file()
    with store_errors(store.mirror.remote):
        return objects.get(store.mirror.remote / "delta" / _FIRST) is not None


def update(store: Store, patience_s: float = 0.0, *, compact: bool = False) -> dict[str, Any]:
    """Make the Delta tables those of the map as it was opened for this, where that is not so yet and the last commit is
    not younger than `patience_s`; with `compact` small files are put together. Their last version, and the number of
    drives and of files of each table. Raises ResultError."""
    place = _place(store)
    commits: list[delta_log.Commit] = []
    with store_errors(cast("RemotePath", store)):
        for _ in range(_TRIES):
            commits = _commits(place, store)
            if commits and not 0 <= time.time() - commits[-1]["time"] / 1000 < patience_s:
                _write_logs(place, commits)
            elif commits:
                break
            if store.mirror is not None:
                store.mirror.manifest.read()  # never older than what a commit was made from
                store.mirror.refresh()
            commit = skip_damaged(store, lambda commits=commits: _missing(store, place, commits, compact))
            if commit is None:
                break
            data = json.dumps(with_checksum(commit), ensure_ascii=False).encode()
            if objects.put_if(place / f"commits/{commit['version']:020}.json", data, None) is not None:
                _write_logs(place, [*commits, commit])
                commits.append(commit)
                break
            added = commit["added"].items()
            _remove(place, (f"{table}/{name}.parquet" for name, file in added for table in file["tables"]))
        files = _files(commits)
    return {
        "version": commits[-1]["version"] if commits else None,
        "drives": sum(len(file["drives"]) for file in files.values()),
        "files": len(files),
    }


def vacuum(store: Store, before: float) -> dict[str, int]:
    """Remove files that no version after `before` (s since 1970) has, and logs before the last checkpoint by then; how
    many objects, and bytes. Raises ResultError."""
    place = _place(store)
    with store_errors(cast("RemotePath", store)):
        there = remote_path.objects_below(place)
        old = {name for name, meta in there.items() if meta["last_modified"].timestamp() < before}
        versions = [_version(name) for name in old if name.startswith("commits/")]
        commits = _commits(place, store, max(versions, default=0))
        of_then = max(1, sum(one["version"] <= max(versions, default=0) for one in commits))
        needed = {*_files(commits[:of_then]), *(name for one in commits[of_then:] for name in one["added"])}
        first = commits[0]["version"] if commits else 0
        gone = [
            name for name in old - {_FIRST}
            if (0 <= _version(name) < first if _version(name) >= 0 else name.endswith(".parquet"))
            and Path(name).stem not in needed
        ]  # fmt: skip
        _remove(place, gone)
    return {"objects": len(gone), "bytes": sum(there[name]["size"] for name in gone)}


def _version(name: str) -> int:
    """The version of a commit or of an entry of a log, -1 of something else."""
    number = name.rpartition("/")[2].partition(".")[0]
    return int(number) if number.isdecimal() else -1


def _remove(place: RemotePath, names: Iterable[str]) -> None:
    """Remove objects; what is left `map vacuum` removes."""
    with suppress(OSError):
        objects.delete(place, names)


def _commits(place: RemotePath, store: Store, at: int | None = None) -> list[delta_log.Commit]:
    """The commits from the last on that names all files, or from the last by this version. Raises ResultError."""
    versions = [_version(name) for name in remote_path.objects_below(place / "commits")]
    newest = max(versions, default=-1)
    first = (newest if at is None else min(at, newest)) // _ALL_EVERY * _ALL_EVERY
    gap = max({*range(first, newest)}.difference(versions), default=-1)
    whole = (gap // _ALL_EVERY + 1) * _ALL_EVERY
    if gap >= 0 and whole <= newest:  # an earlier `vacuum` removed what was before
        first = whole
    with ThreadPoolExecutor(objects.AT_ONCE) as pool:
        names = [f"commits/{version:020}.json" for version in range(first, newest + 1)]
        found = list(pool.map(lambda name: objects.get(place / name), names if newest >= 0 else []))
    where = f"{store}/delta"
    try:
        records = [json.loads(data or b"") for data in found]
        if not all(isinstance(record, dict) and has_checksum(record) for record in records):
            raise ValueError
        for record in records:
            check_version(Path(where), record.get("format"), _FORMAT)
        return [dict(delta_log.COMMIT.validate_python(record)) for record in records]
    except (ValueError, RecursionError):
        again = f"Move it out of the map, and make it again: vplog map delta {store}"
        raise ResultError(f"{where} is damaged. {again}") from None


def _files(commits: Sequence[delta_log.Commit]) -> dict[str, dict[str, Any]]:
    """The files after these commits, by name."""
    found = dict[str, dict[str, Any]]()
    for commit in commits:
        found = commit.get("files") or {
            **{name: file for name, file in found.items() if name not in commit["removed"]}, **commit["added"]
        }  # fmt: skip
    return found


def _missing(
    store: Store, place: RemotePath, commits: Sequence[delta_log.Commit], compact: bool
) -> delta_log.Commit | None:
    """The next commit, whose files are written; None where nothing is to be changed. A file of which a drive was
    replaced or removed is written again without it."""
    wanted = {drive: _made_from(store, drive, record) for drive, record in store.drives().items()}
    files = _files(commits)
    stale = {name for name, file in files.items() if not file["drives"].items() <= wanted.items()}
    small = {name for name, file in files.items() if all(size < _FILE_BYTES / 2 for size, _ in file["tables"].values())}
    if compact and len(small - stale) > 1:
        stale |= small
    current = {drive for name, file in files.items() if name not in stale for drive in file["drives"]}
    added, schemas = _write_files(store, place, {drive: wanted[drive] for drive in wanted if drive not in current})
    if not added and not stale and commits:
        return None
    before = commits[-1] if commits else {"version": -1, "id": str(uuid.uuid4()), "schemas": {}}
    if (schemas := schemas or before["schemas"]) == {}:
        raise ResultError(f"{store} has no finished drive yet. Add some: vplog batch LOG... -o {store}")
    known = before["schemas"].get("descriptors", schemas["descriptors"])
    if current and not delta_log.extends(schemas["descriptors"], known):
        raise ResultError(f"Descriptors in {store} are of several types, for which Delta Lake has no table.")
    removed = {name: files[name] for name in sorted(stale)}
    commit = {
        "format": _FORMAT, "id": before["id"], "version": before["version"] + 1, "time": time.time_ns() // 10**6,
        "change": _drives(removed) != _drives(added), "schemas": schemas, "replaced": schemas != before["schemas"],
        "added": added, "removed": removed,
    }  # fmt: skip
    every = commit["version"] > 0 and commit["version"] % _ALL_EVERY == 0
    return {**commit, "files": _files([*commits, commit])} if every else commit


def _drives(files: Mapping[str, dict[str, Any]]) -> dict[str, str]:
    return {drive: made_from for file in files.values() for drive, made_from in file["drives"].items()}


def _made_from(store: Store, drive: str, record: dict[str, Any]) -> str:
    """A hash of the tables of a drive."""
    files = files_of(record) if store.mirror is None else store.mirror.drives[drive]["files"]
    return key_of([files.get(f"{name}.parquet", {}).get("sha256") for name in TABLES])[:32]


def _write_files(
    store: Store, place: RemotePath, drives: Mapping[str, str]
) -> tuple[dict[str, dict[str, Any]], dict[str, str]]:
    """Write drives as files: these by name, and the schemas of the tables."""
    found, schemas = dict[str, dict[str, Any]](), dict[str, str]()

    def sizes(drive: str) -> Ints:
        held = store.sizes(drive)
        return np.array([held.get(f"{name}.parquet", 0) for name in TABLES])

    for group in grouped(drives, sizes, _FILE_BYTES):
        name = f"part-{secrets.token_hex(16)}"
        with scratch("delta") as folder:
            counts, plain = _write_drives(store, folder, group)
            schemas = {table: delta_log.schema_string(schema) for table, schema in plain.items()}
            written = {table: ((folder / table).stat().st_size, rows) for table, rows in counts.items() if rows}
            for table in written:
                remote_path.send(place / f"{table}/{name}.parquet", folder / table)
        found[name] = {"drives": {drive: drives[drive] for drive in group}, "tables": written}
    return found, schemas


def _write_drives(store: Store, folder: Path, drives: Sequence[str]) -> tuple[dict[str, int], dict[str, pa.Schema]]:
    """Write drives into a file of each table; rows and columns of these. A row group of each is in memory at a time."""
    counts, writers = dict.fromkeys(TABLES, 0), dict[str, pq.ParquetWriter]()
    held: dict[str, list[pa.Table]] = {name: [] for name in TABLES}
    with ExitStack() as stack:

        def write(name: str) -> None:
            rows = pa.concat_tables(held[name])
            writers[name].write_table(rows, max(len(rows), 1))
            held[name].clear()

        def read_all(run: Path) -> dict[str, pa.Table]:
            return {name: tables.read_arrow(run / f"{name}.parquet") for name in TABLES}

        for drive in drives:
            for name, table in store.read(drive, read_all, [f"{name}.parquet" for name in TABLES]).items():
                schema = delta_log.plain_schema(table.schema)
                if name not in writers:
                    options: Any = {"compression": "zstd", "store_schema": False, "write_page_checksum": True}
                    writers[name] = stack.enter_context(pq.ParquetWriter(folder / name, schema, **options))
                ids = pa.array([drive] * len(table), pa.string())
                with reading_drive(drive):
                    columns = [table[column].cast(schema.field(column).type) for column in schema.names[1:]]
                rows = pa.Table.from_arrays([ids, *columns], schema=schema)
                if rows.schema != writers[name].schema:
                    raise ResultError(f"{name} of {drive} has other columns than those of {drives[0]} in {store}.")
                held[name].append(rows)
                counts[name] += len(rows)
                if sum(map(len, held[name])) >= _GROUP_ROWS:
                    write(name)
            store.evict(drive)
        for name in filter(held.get, TABLES):
            write(name)
    return counts, {name: writer.schema for name, writer in writers.items()}


def _write_logs(place: RemotePath, commits: Sequence[delta_log.Commit]) -> None:
    """Write the entries of commits that the logs lack, that of keyframes last."""
    for table in reversed(TABLES):
        log, lacks = place / table / "_delta_log", list[int]()
        for number in reversed(range(len(commits))):
            if objects.get(log / f"{commits[number]['version']:020}.json") is not None:
                break
            lacks.append(number)
        for number in reversed(lacks):
            commit, name = commits[number], f"{commits[number]['version']:020}"
            objects.put_if(log / f"{name}.json", delta_log.log_entry(commit, table), None)
            if "files" in commit:
                whole, last = delta_log.checkpoint(commit, table, commit["files"])
                objects.put_if(log / f"{name}.checkpoint.parquet", whole, None)
                (log / "_last_checkpoint").ask("put", last)
