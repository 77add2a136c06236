"""Maps on object stores of the format before snapshots: each drive had a manifest of its own.

    MAP/map.json, failures.json, removed.json, rest.json    as read here
    MAP/runs/drive=ID/drive.json                            drive.json with `generation` and `files`

The next writer makes a snapshot of what is read here; from then on the manifests above are not read any more.
"""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from functools import partial
from typing import Any

from vplog.maps.storage import objects
from vplog.maps.storage.layout import folder_name
from vplog.storage.json_records import has_checksum
from vplog.storage.remote_path import RemotePath, names_below, objects_below

NAMES = ("failures.json", "removed.json", "rest.json", "joint.json")
"""Objects that such a map has beside folders."""


def read(remote: RemotePath, head: dict[str, Any]) -> tuple[dict[str, Any], dict[str, dict[str, Any]]]:
    """Fields of a snapshot of the map, and the entries of its drives by folder, as they are. Raises OSError."""
    removed = set(map(folder_name, _record(remote / "removed.json").get("drives", [])))
    folders = [name for name in sorted(names_below(remote / "runs")) if name.startswith("drive=")]
    folders = [name for name in folders if name not in removed]
    with ThreadPoolExecutor(objects.AT_ONCE) as pool:
        drives = dict(zip(folders, pool.map(partial(_drive, remote), folders), strict=True))
    libraries = dict[str, dict[str, Any]]()
    for name, meta in objects_below(remote / "libraries").items():
        digest, _, file = name.partition("/")
        libraries.setdefault(digest, {})[file] = {"bytes": meta["size"], "sha256": ""}
    rest = _record(remote / "rest.json")
    files = {name: {**about, "generation": rest["generation"]} for name, about in rest.get("files", {}).items()}
    fields = {"library": head.get("library"), "settings": head.get("settings"), "libraries": libraries}
    return {**fields, "rest": files, "failures": _record(remote / "failures.json")}, drives


def _drive(remote: RemotePath, folder: str) -> dict[str, Any]:
    record = _record(remote / "runs" / folder / "drive.json")
    own = {name: record.pop(name, None) for name in ("generation", "files", "replaces")}
    return {"record": record, "generation": own["generation"], "files": own["files"]}


def _record(place: RemotePath) -> dict[str, Any]:
    """An object's JSON, empty where there is none or a damaged one. Raises OSError."""
    try:
        record = json.loads(objects.get(place) or b"{}")
    except (ValueError, RecursionError):
        return {}
    return record if isinstance(record, dict) and has_checksum(record) else {}
