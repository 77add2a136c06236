"""joint.json of a map: which joint graphs count."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vplog.errors import ResultError
from vplog.maps.storage.layout import write_changed
from vplog.results import run_record
from vplog.storage.folders import is_below
from vplog.storage.parquet_limits import check_version

if TYPE_CHECKING:
    from vplog.maps.storage.map_store import Store

FORMAT = run_record.FORMAT
"""Version of this record. A reader refuses a newer one."""


def read_joint(root: Path) -> dict[str, Any]:
    """joint.json as plain values; empty where nothing was joined yet. Raises ResultError where it is damaged.

    `groups` are the drives that verified closures join, each with the `components` that came of it (`folder` in
    MAP/joint, `drives`) and the pairs kept `apart`; `alone` are the drives in no component, `apart` says of some why;
    `keys` are those that the drives of components had in their drive.json.
    """
    path = root / "joint.json"
    if not path.is_file():
        return {}
    record = run_record.read_run_json(path)
    groups = record.get("groups")
    sound = isinstance(groups, list) and all(
        isinstance(group, dict)
        and isinstance(group.get("key"), str)
        and isinstance(group.get("components"), list)
        and all(map(_is_component, group["components"]))
        for group in groups
    )
    check_version(path, record.get("format"), FORMAT)
    if not sound:
        raise ResultError(f"{path} is damaged. Write it again: vplog map join {root}")
    return record


def _is_component(record: Any) -> bool:
    drives = record.get("drives") if isinstance(record, dict) else None
    return isinstance(drives, list) and is_below(record.get("folder")) and all(isinstance(one, str) for one in drives)


def components_in(store: Store) -> list[dict[str, Any]] | None:
    """The components that count: `folder` in MAP/joint and `drives`, in order of their first drives; None where nothing
    was joined yet. Raises ResultError where the record is damaged."""
    if store.mirror is not None:
        store.mirror.rest(["joint.json"])
    groups = read_joint(store.root).get("groups")
    return groups and [component for group in groups for component in group["components"]]


def replaced_since(root: Path, drives: Mapping[str, Mapping[str, Any]]) -> list[str]:
    """Drives of components in whose place others of that name came, by the records of those that are there."""
    keys = read_joint(root).get("keys")
    keys = keys if isinstance(keys, dict) else {}
    return sorted(drive for drive, about in drives.items() if drive in keys and about.get("key") != keys[drive])


def write_joint(root: Path, record: dict[str, Any]) -> None:
    """Write joint.json, unless it holds the record already. Raises ResultError."""
    write_changed(root / "joint.json", {"format": FORMAT, **record})
