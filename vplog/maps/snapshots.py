"""Snapshots and Delta tables of a map: what they were made by, and the removal of what none needs."""

from __future__ import annotations

import time
from collections import Counter
from pathlib import Path
from typing import Any

from vplog.errors import ResultError
from vplog.maps.storage import delta, map_store, packs, upload


def snapshots_of(root: Path) -> dict[str, Any]:
    """The last snapshots of a map, newest first: version, time (UTC), number of drives, and change. Raises ResultError
    where the map is a folder."""
    with map_store.reading(root) as store:
        store.head()
        if store.mirror is None:
            raise ResultError(
                f"{root} is a folder, which has no snapshots. Those of a map on an object store are shown."
            )
        names = ("version", "time", "drives", "change")
        rows = [{name: row[name] for name in names} for row in store.mirror.manifest.log]
        return {"map": str(root), "snapshots": rows}


def vacuum_map(root: Path, hours: float) -> dict[str, Any]:
    """Remove what was replaced in a map more than `hours` ago, and what killed writers left then. Raises VplogError."""
    with map_store.writing(root, there=True) as store:
        has_delta = delta.is_present(store)
        if store.mirror is None and not has_delta:
            raise ResultError(f"{root} is a folder without Delta tables, where nothing that is replaced stays.")
        own = Counter() if store.mirror is None else Counter(upload.vacuum(store.mirror, hours))
        own += Counter(delta.vacuum(store, time.time() - hours * 3600) if has_delta else {})
        return {"map": str(root), "hours": hours, "objects": own["objects"], "bytes": own["bytes"]}


def compact_map(root: Path) -> dict[str, Any]:
    """Put small files of a map together in files of up to 100 MB: on an object store those of its drives, and those of
    Delta tables, which there take the place of the tables copied by drive. How many files of drives came into how many,
    and the state of the Delta tables. Raises VplogError."""
    with map_store.writing(root, there=True) as store:
        if store.mirror is None and not delta.is_present(store):
            raise ResultError(
                f"{root} is a folder, where drives stay as they are, and has no Delta tables. To have some: vplog map "
                f"delta {root}"
            )
        packed = {"files": 0, "packs": 0} if store.mirror is None else packs.compact(store.mirror)
        tables = map_store.follow_with_delta(store, compact=True)
        if store.mirror is not None and tables is not None:
            upload.drop_copies(store.mirror)
        return {"map": str(root), **packed, "delta": tables}


def write_delta(root: Path) -> dict[str, Any]:
    """Make the tables of a map Delta Lake tables, too, which later changes keep up. Their place, last version, drives
    and files. Raises VplogError."""
    with map_store.writing(root, there=True) as store:
        found = map_store.follow_with_delta(store, begin=True)
        return {"map": str(root), "tables": [f"{root}/delta/{name}" for name in map_store.TABLES], **found}
