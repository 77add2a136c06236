"""Snapshots of a map on an object store: what they were made by, and the removal of what none needs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

from vplog.errors import ResultError
from vplog.maps.storage import map_store, upload


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
        return {
            "map": str(root),
            "snapshots": [{name: row[name] for name in names} for row in store.mirror.manifest.log],
        }


def vacuum_map(root: Path, hours: float) -> dict[str, Any]:
    """Remove what was replaced in a map more than `hours` ago, and what killed writers left then. Raises VplogError."""
    with map_store.reading(root) as store:  # not a map: nothing is made
        store.head()
    with map_store.writing(root) as store:
        if store.mirror is None:
            raise ResultError(f"{root} is a folder, where nothing that is replaced stays.")
        return {"map": str(root), "hours": hours, **upload.vacuum(store.mirror, hours)}
