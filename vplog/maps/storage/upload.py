"""Writes to a map on an object store: first the files, then the manifest that names them."""

from __future__ import annotations

import json
import secrets
import shutil
from collections.abc import Iterable
from concurrent.futures import ThreadPoolExecutor
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from vplog.errors import SettingsError
from vplog.maps.storage import objects
from vplog.maps.storage.damage import rows_of
from vplog.maps.storage.layout import RUN_TABLES, TABLES, folder_name, sha256_of
from vplog.maps.storage.remote_map import Mirror, store_errors
from vplog.results import run_record
from vplog.storage.json_records import with_checksum
from vplog.storage.remote_path import RemotePath, names_below
from vplog.storage.scratch import files_in

_LEFT_OVER = timedelta(days=1)
"""Age from which an object that no manifest names is removed: far beyond any upload."""
_SENT_AT_ONCE = 4
"""Files: each holds a part of some MB in memory, and more do not fill the line any better."""
_KNOWN = ("runs", "libraries", "map.json", "failures.json", "removed.json", *TABLES)
"""Names in a map's folder that have a place of their own on a store; the rest goes together."""


def begin(mirror: Mirror) -> None:
    """Finish what a killed writer began. Raises SettingsError where other things than a map are there."""
    remote = mirror.remote
    with store_errors(remote):
        known = (mirror.local / "map.json").exists()
        if others := [] if known else sorted(name for name in names_below(remote) if not name.startswith(".")):
            raise SettingsError(f"{remote} holds other things ({others[0]}), not a map. Choose another place with -o.")
        there = {name: objects.files_below(remote / name) for name in ("runs", "rest", *TABLES)}
        for drive, manifest in mirror.manifests.items():
            named = folder_name(drive)
            copied = all(f"{named}/{name}.parquet" in there[name] for name in TABLES)
            if not copied or any(name.startswith(f"{named}/{manifest['replaces']}/") for name in there["runs"]):
                _finish_publish(mirror, drive, manifest)
        rest = mirror.rest_manifest
        before = f"{rest.get('replaces')}/"
        if known := [name.removeprefix(before) for name in there["rest"] if name.startswith(before)]:
            _finish_rest(remote, rest, rest["files"], known)
        damaged = {folder_name(drive) for drive in mirror.damaged}  # what their manifests name is not known
        drives = {folder_name(drive): one["generation"] for drive, one in mirror.manifests.items()}
        current = {"runs": {f"{drive}/{one}" for drive, one in drives.items()}, "rest": {rest.get("generation")}}
        for top, files in there.items():
            for left in _abandoned(files, 2 if top == "runs" else 1, current.get(top, set(drives))):
                if left.split("/")[0] not in damaged:
                    objects.remove(remote / top / left)


def _abandoned(files: dict[str, datetime], depth: int, named: set[Any]) -> list[str]:
    """Folders, `depth` names deep, that no manifest names and that were not written to for a day."""
    newest: dict[str, datetime] = {}
    for name, written in files.items():
        parts = name.split("/")
        if len(parts) > depth:
            folder = "/".join(parts[:depth])
            newest[folder] = max(written, newest.get(folder, written))
    now = datetime.now(UTC)
    return sorted(one for one, written in newest.items() if one not in named and now - written > _LEFT_OVER)


def publish(mirror: Mirror, drive: str, made: Path) -> None:
    """Send a finished run folder and then its manifest. Raises ResultError; then the store has the drive as before."""
    mirror.check_lock()
    place, generation = mirror.remote / "runs" / folder_name(drive), secrets.token_hex(8)
    rows = {f"{name}.parquet": {"rows": rows_of(made / f"{name}.parquet")} for name in TABLES}
    with store_errors(mirror.remote):
        sent = _send_all(files_in(made), made, place / generation)
        manifest = {
            **run_record.read_run_json(made / "drive.json"),
            "generation": generation,
            "replaces": mirror.manifests.get(drive, {}).get("generation"),
            "files": {name: {**about, **rows.get(name, {})} for name, about in sent.items()},
        }
        mirror.write(f"runs/{place.name}/drive.json", _json_of(manifest))
    for name in sent:
        if name not in (*RUN_TABLES, "drive.json"):  # a batch would fill the disk
            (made / name).unlink()
    mirror.adopt(manifest, made)
    _finish_publish(mirror, drive, manifest)


def relocate(mirror: Mirror, drive: str, log: str) -> None:
    """Write the manifest with another place of the drive's log. Raises ResultError."""
    manifest = {**mirror.manifests[drive], "log": log}
    with store_errors(mirror.remote):
        mirror.write(f"runs/{folder_name(drive)}/drive.json", _json_of(manifest))
    mirror.write_drive_record(manifest)


def _send_all(names: list[str], folder: Path, place: RemotePath) -> dict[str, dict[str, Any]]:
    """Send files of a folder: length and sha256, by name."""

    def send(name: str) -> dict[str, Any]:
        file = folder / name
        return {"bytes": file.stat().st_size, "sha256": objects.send(place / name, file)}

    with ThreadPoolExecutor(_SENT_AT_ONCE) as pool:
        return dict(zip(names, pool.map(send, names), strict=True))


def _finish_publish(mirror: Mirror, drive: str, manifest: dict[str, Any]) -> None:
    """Copy the tables to their data sets, then remove the generation that was replaced. Idempotent."""
    named, remote = folder_name(drive), mirror.remote
    place, old = remote / "runs" / named, manifest["replaces"]
    with store_errors(remote):
        for name in TABLES:
            file = f"{name}.parquet"
            objects.copy(place / manifest["generation"] / file, remote / name / named / file)
        if old:
            objects.remove(place / str(old))


def write_json(mirror: Mirror, name: str) -> None:
    """Send map.json or failures.json of the local folder. Raises ResultError where another writer has changed it."""
    with store_errors(mirror.remote):
        mirror.write(name, (mirror.local / name).read_bytes())


def _json_of(record: dict[str, Any]) -> bytes:
    """A record with its checksum."""
    return (json.dumps(with_checksum(record), ensure_ascii=False, allow_nan=False) + "\n").encode()


def send_library(mirror: Mirror, digest: str) -> None:
    """Send a library, library.json last. It is named by its content, so what is there stays."""
    folder, place = mirror.local / "libraries" / digest, mirror.remote / "libraries" / digest
    with store_errors(mirror.remote):
        if objects.get(place / "library.json") is not None:
            return
        for name in sorted(files_in(folder), key=lambda name: name == "library.json"):
            objects.send(place / name, folder / name)


def remove(mirror: Mirror, drive: str) -> None:
    """Take a drive out: its manifest first, then all that bears its name. Raises ResultError."""
    named, remote = folder_name(drive), mirror.remote
    mirror.check_lock()
    with store_errors(remote):
        objects.remove(remote / "runs" / named / "drive.json")
        mirror.versions.pop(f"runs/{named}/drive.json", None)
        mirror.manifests.pop(drive, None)
        objects.remove(remote / "runs" / named)
        for name, has_below in sorted(names_below(remote).items()):
            if has_below:
                objects.remove(remote / name / named)
    for folder in mirror.local.glob(f"*/{named}"):
        shutil.rmtree(folder)


def send_rest(mirror: Mirror) -> None:
    """Send all that the local folder has beside drives and libraries, if it changed; tables and records also by their
    own names, for those who read them as data sets."""
    old = mirror.rest_manifest
    known: dict[str, dict[str, Any]] = old.get("files", {})
    now = {name: sha256_of(mirror.local / name) for name in files_in(mirror.local) if name.split("/")[0] not in _KNOWN}
    if now == {name: one["sha256"] for name, one in known.items()}:
        return
    mirror.check_lock()
    remote, generation = mirror.remote, secrets.token_hex(8)
    place = remote / "rest" / generation
    with store_errors(remote):
        same = {name: known[name] for name in now if name in known and known[name]["sha256"] == now[name]}
        for name in same:
            objects.copy(remote / "rest" / old["generation"] / name, place / name)
        files = {**same, **_send_all([name for name in now if name not in same], mirror.local, place)}
        manifest = {"generation": generation, "replaces": old.get("generation"), "files": dict(sorted(files.items()))}
        mirror.write("rest.json", _json_of(manifest))
        mirror.rest_manifest = manifest
        _finish_rest(remote, manifest, [name for name in files if name not in same], known)


def _finish_rest(remote: RemotePath, manifest: dict[str, Any], new: Iterable[str], known: Iterable[str]) -> None:
    """Copy what is `new` to its own name, remove what was `known` before and is gone, and last the generation that was
    replaced: while it exists, a later writer repeats this."""
    place = remote / "rest" / manifest["generation"]
    for name in new:
        if name.endswith((".parquet", ".json")):
            objects.copy(place / name, remote / name)
    for name in known:
        if name not in manifest["files"]:
            objects.remove(remote / name)
    if manifest["replaces"]:
        objects.remove(remote / "rest" / manifest["replaces"])
