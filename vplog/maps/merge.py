"""Drives of maps, taken into another map that has the same library."""

from __future__ import annotations

import os
import re
import shutil
from typing import TYPE_CHECKING, Any

from vplog.errors import LibraryError, ResultError, SettingsError
from vplog.maps import keys
from vplog.maps import store as map_store
from vplog.maps.imports import drives_of_file, library_of_file, take_places
from vplog.results import run_record

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from vplog.maps.store import Store

    Progress = Callable[[str, int, int], None]


def merge_maps(
    sources: Sequence[Path], target: Path, progress: Progress = lambda *_: None, chosen: Sequence[str] = ()
) -> dict[str, Any]:
    """Take the drives of maps, or those `chosen`, into `target`, which is made where it is not there; what became of
    each. Of a file that `vplog map export` wrote it takes the places, if the target has their library or gets it.

    Maps in the order given, the drives of each in order of their IDs. One whose log is in the map already, by its
    content, is left out; one whose ID is taken gets a number. Each is in whole or not at all, so a merge that was
    stopped goes on. Nothing is written where the libraries differ. Raises VplogError.
    """
    if any(str(source.resolve()) == str(target.resolve()) for source in sources):
        raise SettingsError(f"{target} is given as a source and as the target. Choose another map with -o.")
    if len({str(source.resolve()) for source in sources}) < len(sources):
        raise SettingsError("A map is given twice. Give each once.")
    library = _check_libraries(sources, target)
    _check_chosen(sources, chosen)
    fate: list[dict[str, Any]] = []
    with map_store.writing(target) as store:
        there = store.drives()
        known, names = {_content(record): drive for drive, record in there.items()}, set(there)
        for number, source in enumerate(sources):
            if source.is_file():
                fate += _take_file(store, source, known, names, chosen)
                continue
            with map_store.reading(source) as other:
                _, drives = map_store.one_library(other)
                _take_library(store, other, library)
                for drive in in_order(drives.keys() & set(chosen) if chosen else drives):
                    fate.append(_take(store, other, drives[drive], known, names, f"{os.getpid()}-{len(fate)}"))
                    progress(f"merge {number + 1} of {len(sources)}", len(fate), len(fate))
        return {"map": str(store), "library": library, "drives": fate}


def _check_libraries(sources: Sequence[Path], target: Path) -> str:
    """The one library of the maps. Raises LibraryError where their places do not compare."""
    wanted, whose = None, str(target)
    if (target / "map.json").exists():
        with map_store.reading(target) as store:
            wanted = map_store.one_library(store)[0] if store.drives() else store.head().library
    for source in sources:
        if source.is_file():
            found = library_of_file(source)
        else:
            with map_store.reading(source) as other:
                found, _ = map_store.one_library(other)
        if wanted is None and source.is_file():
            raise LibraryError(
                f"{source} holds places without their library {found[:12]}. Name a map that has it first, or as -o."
            )
        if wanted is None:
            wanted, whose = found, str(source)
        if found != wanted:
            raise LibraryError(
                f"{source} is described with library {found[:12]}, and {whose} with {wanted[:12]}: their places do not "
                f"compare. Describe it anew: vplog map redescribe {source} --library {whose}/libraries/{wanted} -o MAP."
            )
    return str(wanted)


def _check_chosen(sources: Sequence[Path], chosen: Sequence[str]) -> None:
    """Raises SettingsError where no map has a drive that is asked for."""
    known: set[str] = set()
    for source in sources if chosen else ():
        if source.is_file():
            known |= drives_of_file(source).keys()
            continue
        with map_store.reading(source) as other:
            known |= other.drives().keys()
    unknown = [drive for drive in chosen if drive not in known]
    if unknown:
        raise SettingsError(f"No map given has a drive {unknown[0]!r}. Drives: {', '.join(in_order(known))}.")


def _take_library(store: Store, other: Store, library: str) -> None:
    """The library and the settings of the first map are those of a new one."""
    if (store.root / "map.json").exists() and store.head().library is not None:
        return
    made = store.staging / "library"
    shutil.rmtree(made, ignore_errors=True)
    shutil.copytree(other.library(library), made)
    map_store.add_library(store, made, library)
    store.write_head(map_store.Head(library, other.head().settings))


def _take(
    store: Store, other: Store, record: dict[str, Any], known: dict[str, str], names: set[str], staged: str
) -> dict[str, Any]:
    """One drive; what became of it. `known` are IDs in the map by content, `names` all of them; both get this one."""
    drive = record["drive"]
    told = {"from": str(other), "drive": drive, "as": drive, "log": record["log"]}
    if (same := known.get(_content(record))) is not None:
        return {**told, "as": same, "state": "there already"}
    taken, made = keys.free_name(drive, record["log"], names), store.staging / staged

    def copied(_: Path) -> None:
        shutil.rmtree(made, ignore_errors=True)
        try:
            ignored = shutil.ignore_patterns("drive.json")  # it comes last: what has it is whole
            shutil.copytree(other.whole(drive), made, copy_function=_linked, ignore=ignored)
        except (OSError, shutil.Error) as error:
            raise ResultError(f"Cannot copy {drive} of {other}: {str(error).splitlines()[0][:200]}") from None

    other.read(drive, copied, ())
    if taken != drive:
        keys.name_keyframes(made / "keyframes.parquet", taken)
    run_record.write_run_json(made / "drive.json", record if taken == drive else keys.renamed(record, taken))
    map_store.publish(store, taken, made)
    other.forget(drive)
    known[_content(record)] = taken
    names.add(taken)
    return {**told, "as": taken, "state": "taken"}


def _take_file(
    store: Store, source: Path, known: dict[str, str], names: set[str], chosen: Sequence[str]
) -> list[dict[str, Any]]:
    """The places of an exported file; what became of each drive, as `_take` says it."""
    fate, wanted = [], dict[str, str]()
    for drive, record in drives_of_file(source).items():
        if chosen and drive not in chosen:
            continue
        same, taken = known.get(_content(record)), keys.free_name(drive, drive, names)
        fate.append({"from": str(source), "drive": drive, "as": same or taken, "log": record["log"]})
        fate[-1]["state"] = "taken" if same is None else "there already"
        if same is None:
            wanted[drive] = known[_content(record)] = taken
            names.add(taken)
    done = set(take_places(store, source, wanted))
    lost = [drive for drive in wanted if drive not in done]
    if lost:
        raise ResultError(f"{source} has no place of {lost[0]}, which its header names.")
    return fate


def _content(record: dict[str, Any]) -> str:
    """What a drive is of: the content of its log and what of that was used; without that, all that is known of it."""
    if record["inputs"]:
        return run_record.canonical_json([record["inputs"], record.get("topics")])
    return run_record.canonical_json({name: value for name, value in record.items() if name != "earth"})


def in_order(drives: Iterable[str]) -> list[str]:
    """As they were numbered: drive, drive-2, drive-10."""

    def numbered(drive: str) -> tuple[str, int]:
        named = re.fullmatch(r"(.+)-(\d{1,9})", drive)
        return (named[1], int(named[2])) if named else (drive, 1)

    return sorted(drives, key=numbered)


def _linked(source: str, target: str) -> str:
    """The same file under another name, or a copy: no writer of a map changes a file, each replaces it."""
    try:
        os.link(source, target)
    except OSError:
        shutil.copyfile(source, target)
    return target
