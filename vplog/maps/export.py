"""The places of a map, or of single runs, in one file for other tools."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from vplog.data import Floats
from vplog.errors import ResultError, SettingsError
from vplog.execution.execution import Execution
from vplog.maps.geo_bounds import Box, earth_of_run, earth_record, in_box
from vplog.maps.storage import map_store
from vplog.maps.storage.contents import damage_warnings, skip_damaged
from vplog.maps.storage.map_store import Store
from vplog.results import tables
from vplog.results.geo import Earth, on_earth
from vplog.results.places_map import DrivePlaces, drive_header, names_of, read_places, write_places
from vplog.results.run_record import read_single_run
from vplog.storage.remote_path import local_copy

_PLACES = ("keyframes.parquet", "descriptors.parquet")
"""Files of a run folder with its places: their poses and their descriptors."""


@dataclass(frozen=True)
class _Source:
    """The drives that may be written, each read alone."""

    drives: dict[str, dict[str, Any]]
    """Entries of the file's header, by ID."""
    earth: Callable[[str], Earth | None]
    read: Callable[[str, Callable[[Path], Any], Sequence[str]], Any]
    """Calls a function with a drive's run folder, which has the files of these names."""
    evict: Callable[[str], None]
    box: Box | None
    kind: str


def export_map(
    sources: Sequence[Path], path: Path, drives: Sequence[str] = (), box: Box | None = None, kind: str = "parquet",
    execution: Execution = Execution(),
) -> dict[str, Any]:  # fmt: skip
    """Write the places of a map (all, those of some drives, those in a box on earth) or of runs; what was written.

    One drive is in memory at a time. With a box or as GeoParquet a drive that has no place on earth is left out, and
    named in the answer. Raises VplogError.
    """
    maps = [source for source in sources if (source / "map.json").exists()]
    if maps and len(sources) > 1:
        raise SettingsError(f"{maps[0]} is a map: export it alone, or put maps together first with `vplog map merge`.")
    if maps:
        with map_store.reading(maps[0]) as store:
            return skip_damaged(store, lambda: _export_drives(store, path, drives, box, kind, execution))
    if drives:
        raise SettingsError("--drive chooses among the drives of a map, and what is given are runs. Leave it out.")
    with ExitStack() as stack:
        folders = [stack.enter_context(local_copy(source)) for source in sources]
        for folder in folders:
            read_single_run(folder)
        run = dict(zip(names_of(folders), folders, strict=True))
        source = _Source(
            {drive: drive_header(folder) for drive, folder in run.items()}, lambda drive: earth_of_run(run[drive]),
            lambda drive, of, _: of(run[drive]), lambda _: None, box, kind,
        )  # fmt: skip
        return _write(path, source, execution)


def _export_drives(
    store: Store, path: Path, drives: Sequence[str], box: Box | None, kind: str, execution: Execution
) -> dict[str, Any]:
    _, known = map_store.common_library(store)
    unknown = [drive for drive in drives if drive not in known and drive not in store.damaged]
    if unknown:
        raise SettingsError(f"{store} has no drive {unknown[0]!r}. Drives: {', '.join(known)}.")
    about = ("inputs", "topics", "earth")
    chosen = {
        drive: {name: record[name] for name in about if record.get(name) is not None}
        for drive, record in known.items()
        if drive in drives or not drives
    }
    source = _Source(chosen, store.earth, store.read, store.evict, box, kind)
    return {**_write(path, source, execution), "warnings": damage_warnings(store)}


def _write(path: Path, source: _Source, execution: Execution) -> dict[str, Any]:
    box, geo = source.box, source.kind == "geoparquet"
    if box is None and not geo:
        return {**write_places(path, source.drives, _places(source, {}, execution)), "left_out": []}
    earths = {drive: source.earth(drive) for drive in source.drives}
    unplaced = [drive for drive in source.drives if earths[drive] is None]
    low, high, written = np.full(3, np.inf), np.full(3, -np.inf), dict[str, Any]()
    for drive, earth in earths.items():  # bounds come first in a file, and take the poses alone
        if earth is None:
            continue

        def points(run: Path, earth: Earth = earth) -> Floats:
            return on_earth(earth, tables.read_keyframes(run / "keyframes.parquet")[1])

        where = source.read(drive, points, _PLACES[:1])
        where = where if box is None else where[in_box(where, box)]
        if len(where):
            written[drive] = earth
            low, high = np.minimum(low, where.min(0)), np.maximum(high, where.max(0))
    if not written:
        nowhere = f" {len(unplaced)} of {len(source.drives)} drives have no place on earth." if unplaced else ""
        wanted = "in the box" if box is not None else "to write"
        raise ResultError(f"There is no place {wanted}, so {path} is not written.{nowhere}")
    nowhere = np.empty((0, 4, 4))
    drives = {drive: {"earth": earth_record(at, nowhere), **source.drives[drive]} for drive, at in written.items()}
    places = _places(source, written, execution)
    return {**write_places(path, drives, places, (low, high) if geo else None), "left_out": unplaced}


def _places(source: _Source, earths: dict[str, Earth], execution: Execution) -> Iterator[DrivePlaces]:
    """The places of drives, one drive after the other; with their points where their place on earth is given."""
    drives = list(earths or source.drives)
    for number, drive in enumerate(drives, start=1):
        places = source.read(drive, lambda run, drive=drive: read_places(run, drive), _PLACES)
        if earths:
            where = on_earth(earths[drive], places.world_from_body)
            places = replace(places, where=where)
            if source.box is not None:
                places = places.of(np.flatnonzero(in_box(where, source.box)))
        yield places
        source.evict(drive)
        execution.progress("export", number, len(drives))
