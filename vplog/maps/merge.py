"""Drives of maps, taken into another map that has the same library."""

from __future__ import annotations

import os
import shutil
from collections.abc import Sequence
from contextlib import AbstractContextManager, ExitStack
from pathlib import Path
from typing import Any

from vplog.errors import LibraryError, ResultError, SettingsError, nearest_path
from vplog.execution.execution import Execution
from vplog.logs.image_folder import natural_order
from vplog.maps.import_places import drives_of_file, import_places_of
from vplog.maps.joining.drive_pairs import DRIVE_FILES
from vplog.maps.storage import layout, map_store
from vplog.maps.storage.contents import damage_warnings
from vplog.maps.storage.damage import DamagedDriveError, damaged_files
from vplog.maps.storage.layout import PLACES_ONLY, folder_name
from vplog.maps.storage.map_store import Store
from vplog.results import run_record
from vplog.results.places_map import places_by_drive, read_places_header
from vplog.storage.json_records import canonical_json
from vplog.storage.remote_path import local_copy, original
from vplog.storage.scratch import copy_folder


def merge_maps(
    sources: Sequence[Path], target: Path, execution: Execution = Execution(), chosen: Sequence[str] = ()
) -> dict[str, Any]:
    """Take the drives of maps, or those `chosen`, into `target`, which is made where it is not there; the outcome for
    each. Of a file that `vplog map export` wrote it takes the places, if the target has their library or gets it.

    Maps in the order given, the drives of each in order of their IDs. One whose log is in the map already, by its
    content, is left out; one whose ID is taken gets a number. Each is in whole or not at all, so a merge that was
    stopped goes on. Nothing is written where the libraries differ. Raises VplogError.
    """
    if any(str(source.resolve()) == str(target.resolve()) for source in sources):
        raise SettingsError(f"{target} is given as a source and as the target. Choose another map with -o.")
    if len({str(source.resolve()) for source in sources}) < len(sources):
        raise SettingsError("A map is given twice. Give each once.")
    outcomes, warnings = list[dict[str, Any]](), list[str]()
    with ExitStack() as stack:
        opened = [stack.enter_context(_opened(source)) for source in sources]
        library = _check_libraries(opened, target)
        _check_chosen(opened, chosen)
        store = stack.enter_context(map_store.writing(target))
        known = store.drives()
        by_content = {_content(record): drive for drive, record in known.items()}
        for number, source in enumerate(opened, start=1):
            if isinstance(source, Path):
                outcomes += _merge_places(store, source, known, by_content, chosen)
                continue
            _, drives = map_store.common_library(source)
            copy_library(store, source, library)
            for drive in sorted(drives.keys() & set(chosen) if chosen else drives, key=natural_order):
                taken = _merge_drive(store, source, drives[drive], known, by_content)
                outcomes += [] if taken is None else [taken]
                execution.progress(f"merge {number} of {len(sources)}", len(outcomes), len(outcomes))
            warnings += damage_warnings(source)
        warnings = damage_warnings(store) + warnings
        return {"map": str(store), "library": library, "drives": outcomes, "warnings": warnings}


def _opened(source: Path) -> AbstractContextManager[Store | Path]:
    """A map, or an exported file."""
    if not source.exists():
        raise ResultError(f"There is neither a map nor an exported file at {source}.{nearest_path(source)}")
    return local_copy(source) if source.is_file() else map_store.reading(source)


def _check_libraries(sources: Sequence[Store | Path], target: Path) -> str:
    """The one library of the maps. Raises LibraryError where their places do not compare."""
    wanted, whose = None, str(target)
    if (target / "map.json").exists():
        with map_store.reading(target) as store:
            wanted = map_store.common_library(store)[0] if store.drives() else store.head().library
    for source in sources:
        if isinstance(source, Path):
            found, name = read_places_header(source).library, original(source)
            again = "Describe its map again (vplog map redescribe), and export that."
        else:
            found, name = map_store.common_library(source)[0], source
            again = f"Write it again: vplog map redescribe {source} --library {whose}/libraries/{wanted} -o MAP."
        if wanted is None and isinstance(source, Path):
            raise LibraryError(
                f"{name} holds places without their library {found[:12]}. Name a map that has it first, or as -o."
            )
        if wanted is None:
            wanted, whose = found, str(source)
        if found != wanted:
            raise LibraryError(
                f"{name} is described with library {found[:12]}, and {whose} with {wanted[:12]}: their places do not "
                f"compare. {again}"
            )
    return str(wanted)


def _check_chosen(sources: Sequence[Store | Path], chosen: Sequence[str]) -> None:
    known: set[str] = set()
    for source in sources if chosen else ():
        if isinstance(source, Path):
            known |= drives_of_file(source).keys()
        else:
            known |= source.drives().keys() | source.damaged.keys()
    if unknown := [drive for drive in chosen if drive not in known]:
        raise SettingsError(
            f"No map given has a drive {unknown[0]!r}. Drives: {', '.join(sorted(known, key=natural_order))}."
        )


def copy_library(store: Store, other: Store, library: str) -> None:
    """The library and the settings of the first map are those of a new one."""
    if store.exists and store.head().library is not None:
        return
    made = store.staging / "library"
    shutil.rmtree(made, ignore_errors=True)
    copy_folder(other.library(library), made, f"the library of {other} to {store}")
    put_library(store, made, library, other.head().settings)


def put_library(store: Store, made: Path, library: str, settings: dict[str, Any]) -> None:
    """Make a folder in staging the library of a new map."""
    store.write_head(map_store.Head(None, settings))  # a folder that holds a library alone is no map
    map_store.add_library(store, made, library)
    store.write_head(map_store.Head(library, settings))


def _merge_drive(
    store: Store, other: Store, record: dict[str, Any], known: dict[str, dict[str, Any]], by_content: dict[str, str]
) -> dict[str, Any] | None:
    """Take one drive; the outcome, None where it is damaged. A whole one replaces its places alone. `known` and
    `by_content` are the drives of the target, and those that come."""
    drive = record["drive"]
    entry = {"from": str(other), "drive": drive, "as": drive, "log": record["log"]}
    same = by_content.get(_content(record))
    if same is not None and (PLACES_ONLY not in known[same] or PLACES_ONLY in record):
        return {**entry, "as": same, "state": "there already"}
    try:
        whole = other.full_run(drive)  # of a store, files that have their sha256
        wrong = damaged_files(whole) if other.mirror is None else []
    except DamagedDriveError as error:
        wrong = [str(error)]
    if wrong:
        other.damaged[drive] = wrong[0]
        return None
    taken, made = same or layout.free_name(drive, record["log"], known), store.staging / f"{os.getpid()}-merge"
    copy_run(other, drive, store, made)
    if taken != drive:
        layout.set_drive_id(made / "keyframes.parquet", taken)
    _link_join_inputs(other, drive, store, taken)  # what has a drive.json is put in by the next writer
    run_record.write_run_json(made / "drive.json", record if taken == drive else layout.renamed(record, taken))
    published = map_store.publish(store, taken, made)
    if published != taken:  # which another writer has taken meanwhile
        shutil.rmtree(store.root / "joins" / folder_name(taken), ignore_errors=True)
        taken = published
    other.evict(drive)
    known[taken], by_content[_content(record)] = record, taken
    return {**entry, "as": taken, "state": "taken"}


def copy_run(store: Store, drive: str, new: Store, made: Path) -> None:
    """Make a copy of a drive's run folder, of links where there may be, in the staging of a new map. Raises
    ResultError."""

    def copied(_: Path) -> None:
        shutil.rmtree(made, ignore_errors=True)
        ignored = shutil.ignore_patterns("drive.json")  # it comes last: what has it is whole
        what = f"{drive} of {store} to {new}"
        copy_folder(store.full_run(drive), made, what, copy_function=layout.link, ignore=ignored)

    store.read(drive, copied, ())


def _link_join_inputs(other: Store, drive: str, store: Store, taken: str) -> None:
    """Link what later closures are verified by, so that these need the logs no more than in the source."""
    source, target = (one.root / "joins" / folder_name(name) for one, name in ((other, drive), (store, taken)))
    other.fetch_beside(f"joins/{folder_name(drive)}/{name}" for name in DRIVE_FILES)
    for name in (*DRIVE_FILES, *(path.name for path in source.glob("features-*.parquet"))):
        if (source / name).is_file():
            try:
                target.mkdir(parents=True, exist_ok=True)
                (target / name).unlink(missing_ok=True)
                layout.link(source / name, target / name)
            except OSError as error:
                raise ResultError(f"Cannot copy {source / name}: {error.strerror or error}.") from None


def _merge_places(
    store: Store, source: Path, known: dict[str, dict[str, Any]], by_content: dict[str, str], chosen: Sequence[str]
) -> list[dict[str, Any]]:
    """Take the places of an exported file; the outcome for each drive. More places of a drive replace fewer."""
    outcomes, wanted, counts = [], dict[str, str](), places_by_drive(source)
    for drive, record in drives_of_file(source).items():
        if chosen and drive not in chosen:
            continue
        same = by_content.get(_content(record))
        alone = same is not None and PLACES_ONLY in known[same]
        more = same is None or (alone and counts.get(drive, 0) > store.rows("descriptors", same))
        taken = same or layout.free_name(drive, drive, known)
        entry = {"from": str(original(source)), "drive": drive, "as": taken, "log": record["log"]}
        outcomes.append({**entry, "state": "places taken" if more else "there already"})
        if more:
            wanted[drive] = taken
            known[taken], by_content[_content(record)] = record, taken
    done = set(import_places_of(store, source, wanted))
    if lost := [drive for drive in wanted if drive not in done]:
        raise ResultError(f"{source} has no place of {lost[0]}, which its header names; export it again.")
    return outcomes


def _content(record: dict[str, Any]) -> str:
    """The content of a drive's log and the topics used; without these, all that is known of it."""
    if record["inputs"]:
        return canonical_json([record["inputs"], record.get("topics")])
    own = ("earth", "key", "drive", "format", "files")
    return canonical_json({name: value for name, value in record.items() if name not in own})
