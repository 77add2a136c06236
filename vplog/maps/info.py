"""Drives, places and damage of a map."""

from __future__ import annotations

from collections.abc import Mapping
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from vplog.errors import LibraryError, ResultError
from vplog.maps.geo_bounds import bounds_of, is_finite
from vplog.maps.import_places import PLACES_ONLY
from vplog.maps.joining.joint_record import between_by_drive, components_in, replaced_since
from vplog.maps.storage import layout, map_store
from vplog.maps.storage.contents import damage_warnings, library_mismatch, skip_damaged
from vplog.maps.storage.damage import damaged_files, damaged_table
from vplog.maps.storage.map_store import Store
from vplog.places.library_files import read_library_record
from vplog.storage.folders import regular_files

_READ_AT_ONCE = 16
"""Drives: on an object store each is a request that takes some 20 to 50 ms."""


def describe_map(root: Path, check: bool = False) -> dict[str, Any]:
    """Drives, places, library, what joins the drives, and failures of a map, without reading a descriptor. `bytes` is
    the size on disk as `du` reports it, or the size of the objects in a bucket. With `check` every file of the drives
    is read, and `damaged_files` are those that are not as they were written.

    Raises ResultError.
    """
    with map_store.reading(root) as store:
        found = skip_damaged(store, lambda: _describe(store))
        return {**found, "damaged_files": _damaged_files(store) if check else []}


def _damaged_files(store: Store) -> list[str]:
    """A line for each damaged file; on an object store every file is checked against its manifest as it is fetched."""
    folders = sorted(path.parent for path in store.root.glob("runs/drive=*/drive.json"))
    if store.mirror is None:
        lines = [line for folder in folders for line in damaged_files(folder)]
        names = (name for name in regular_files(store.root) if name.endswith(".parquet") and name[:5] != "runs/")
        return [*lines, *filter(None, (damaged_table(store.root / name) for name in names))]
    wrong: list[str] = []
    for drive in list(store.mirror.drives):
        try:
            store.full_run(drive)
        except ResultError as error:
            wrong.append(str(error))
        store.evict(drive)
    return wrong


def _describe(store: Store) -> dict[str, Any]:
    head, problems, abouts = store.head(), list[str](), store.drives()
    now, other = (layout.key_of(head.settings), layout.code_hash()), []
    for drive, about in abouts.items():
        if about["library"] != head.library:
            problems.append(library_mismatch(store, drive, about["library"], head.library))
        if (about.get("settings"), about.get("code")) != now and PLACES_ONLY not in about:
            other.append(about["log"])
    with ThreadPoolExecutor(_READ_AT_ONCE if store.mirror else 1) as pool:
        drives = list(pool.map(lambda drive: _drive(store, drive, abouts[drive]), abouts))
    components = _components(store, abouts, problems)
    between = between_by_drive(components or [], abouts)
    for one in drives:
        one["between"] = between[one["drive"]]
    if other:
        problems.append(
            f"{len(other)} of {len(drives)} drives were made with other settings than the last batch had, or by "
            f"another version of vplog. `vplog batch` with their logs computes them again; the first is {other[0]}."
        )
    if damage := store.failures_or_damage()[1]:
        problems.append(damage)
    problems += damage_warnings(store) + _unused_folders(store, [*abouts, *store.damaged])
    places = sum(one["places"] for one in drives)
    stored = sum(one["descriptor_bytes"] for one in drives)
    library = {}
    try:
        library = read_library_record(store.library(head.library, ["library.json"])) if head.library else {}
    except LibraryError as error:
        problems.append(f"{store} has lost its library {str(head.library)[:12]}: {error}")
    return {
        "map": str(store),
        "library": {"hash": head.library, **{name: library.get(name) for name in ("references", "features")}},
        "places": places,
        "descriptor_bytes": stored,
        "bytes_per_place": round(stored / places, 1) if places else None,
        "bytes": store.bytes_stored(),
        "on_earth": sum(one["on_earth"] for one in drives),
        "components": components,
        "drives": drives,
        "failures": store.failures(),
        "damaged": dict(sorted(store.damaged.items())),
        "problems": problems,
    }


def _drive(store: Store, drive: str, about: dict[str, Any]) -> dict[str, Any]:
    def read(_: Path) -> dict[str, Any]:
        record = store.figures(drive)
        sizes = store.sizes(drive)
        return {
            "drive": drive,
            "log": about["log"],
            "tags": about.get("tags", {}),
            "keyframes": store.rows("keyframes", drive),
            "places": store.rows("descriptors", drive),
            "candidates": store.rows("closures", drive),
            "accepted": _figure(record, "counts", "verdicts", "accepted") or 0,
            "on_earth": store.earth(drive) is not None,
            "bounds": bounds_of(about.get("earth")),
            "descriptor_bytes": sizes.get("descriptors.parquet", 0),
            "descriptor_bits": record.get("descriptor_bits"),
            "bytes": sum(sizes.values()),
            "seconds": _figure(record, "totals", "seconds"),
            "peak_memory_mb": _figure(record, "totals", "peak_memory_mb"),
            "warnings": record.get("warnings", []),
        }

    return store.read(drive, read, ()) if store.mirror is None else read(Path())  # by the manifest


def _figure(record: Any, *names: str) -> float | None:
    for name in names:
        record = record.get(name) if isinstance(record, dict) else None
    return record if is_finite(record) else None


def _components(store: Store, known: Mapping[str, Any], problems: list[str]) -> list[dict[str, Any]] | None:
    """The drives that closures join in one frame, as joint.json has them; None where nothing was joined yet."""
    try:
        found = components_in(store)
    except ResultError as error:
        problems.append(str(error))
        return None
    if replaced := replaced_since(store.root, known):
        problems.append(
            f"{', '.join(replaced)} was replaced after the joint graphs were solved. Solve them again: vplog map "
            f"join {store}"
        )
    if gone := sorted({drive for one in found or [] for drive in one["drives"]} - known.keys()):
        problems.append(
            f"{', '.join(gone)} was removed and is still in the joint graphs. Solve them without it: vplog map join "
            f"{store}"
        )
    return found


def _unused_folders(store: Store, drives: list[str]) -> list[str]:
    if store.mirror is not None:
        return []  # a writer there removes them
    known, root = {map_store.folder_name(drive) for drive in drives}, store.root
    left = [
        f"{name}/{path.name}"
        for name in ("runs", *map_store.TABLES)
        for path in sorted(root.glob(f"{name}/drive=*"))
        if path.name not in known
    ]
    return [f"{root}/{name} belongs to no drive of the map and is not read. Move it out of the map." for name in left]
