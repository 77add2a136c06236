"""Writes to a map on an object store: first the files, then a snapshot that names them."""

from __future__ import annotations

import secrets
import shutil
import time
from collections.abc import Callable, Collection, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime, timedelta
from pathlib import Path
from typing import Any

from vplog.errors import ResultError, SettingsError
from vplog.maps.storage import layout, objects
from vplog.maps.storage.damage import UnreachableError, complete_record, rows_of
from vplog.maps.storage.layout import TABLES, folder_name
from vplog.maps.storage.remote_map import Copies, Mirror, drives_in, is_join_state, tag_of
from vplog.maps.storage.snapshot import LostRaceError, Snapshot, now, store_errors
from vplog.results import run_record
from vplog.storage.remote_path import RemotePath, names_below, objects_below
from vplog.storage.scratch import files_in, scratch

_SENT_AT_ONCE = 4
"""Files: each holds a part of some MB in memory, and more do not fill the line any better."""
VACUUM_S = 86_400
"""Age below which nothing is removed: no upload of a drive takes a day."""
_CLOCKS_S = 7200
"""Most that the clock of who removes may be ahead of the store's."""
_PROBE = ".conditional-writes"
"""An empty object that no write may replace, for the store itself to show that it heeds conditions."""
_OWN = ("runs", "packs", "rest", "libraries", "snapshots", "joins", "joint", *TABLES)
"""Names in a map's folder that are of vplog."""
_FIGURES = ("counts", "totals", "warnings", "descriptor_bits")
"""Fields of run.json that `map info` shows."""


class TakenError(ResultError):
    """Another writer has put another drive of this ID into the map."""


def begin(mirror: Mirror) -> None:
    """Finish what a killed writer began. Raises SettingsError where other things than a map are there, or where the
    store has no conditional writes."""
    remote, never = mirror.remote, {"e_tag": '"0"', "version": "1"}
    with store_errors(remote):
        others = set() if mirror.exists else {name for name in names_below(remote) if not name.startswith(".")}
        if "map.json" in others:  # another writer has just begun it
            mirror.manifest.read()
            mirror.refresh()
        elif others := sorted(others - {"snapshots"}):  # one is about to, or was killed then
            raise SettingsError(f"{remote} holds other things ({others[0]}), not a map. Choose another place with -o.")
        new = objects.put_if(remote / _PROBE, b"", None) is not None
        if objects.put_if(remote / _PROBE, b"", never) or (new and objects.put_if(remote / _PROBE, b"", None)):
            raise SettingsError(
                f"Cannot write to {remote}: its store has no conditional writes, by which no writer undoes what "
                "another does. Write to a folder or another store."
            )
    _copy(mirror, mirror.manifest.now["copies"])


def _copy(mirror: Mirror, copies: Copies) -> None:
    """Copy files to their names in data sets. Idempotent; the next commit notes what is done."""
    for name, source in copies.items():
        with store_errors(mirror.remote):
            if source is None:
                objects.remove(mirror.remote / name)
            else:
                with suppress(FileNotFoundError):  # replaced once more, and vacuumed
                    objects.copy(mirror.remote / source, mirror.remote / name)
        mirror.copied[name] = source


def _copy_committed(mirror: Mirror, is_new: Callable[[str], object]) -> None:
    """`_copy` of those that a commit has named, which stands where the store refuses: the next writer copies."""
    with suppress(UnreachableError):
        _copy(mirror, {name: source for name, source in mirror.manifest.now["copies"].items() if is_new(name)})


def finish(mirror: Mirror) -> None:
    """Send what was written beside drives, and note what copies are made. Raises ResultError."""
    send_rest(mirror)
    if mirror.copied:
        mirror.commit("tables copied", lambda _: None)


@dataclass(frozen=True)
class SentRun:
    """A finished run folder on an object store, which no snapshot names yet."""

    entry: dict[str, Any]
    """Entry of the drive in the manifest."""
    began: float
    """Time before which nothing of it was sent, by the clock of the writer that commits it."""

    @property
    def place(self) -> str:
        """Name of its folder in the map's."""
        return f"runs/{folder_name(self.entry['record']['drive'])}/{self.entry['generation']}"


def send_run(remote: RemotePath, made: Path, began: float) -> SentRun:
    """Send a finished run folder, from any machine, to a map that is written to. Raises ResultError."""
    complete_record(made, hashed=False)
    rows = {f"{name}.parquet": {"rows": rows_of(made / f"{name}.parquet")} for name in TABLES}
    run = run_record.read_run_json(made / "run.json")
    entry = {
        "record": layout.drive_record(made),
        "generation": secrets.token_hex(8),
        "files": {},
        "run": {name: run[name] for name in _FIGURES if name in run},
    }
    names = [name for name in files_in(made) if name != "drive.json"]
    files = _send_all(names, made, remote / SentRun(entry, began).place)
    return SentRun({**entry, "files": {name: {**about, **rows.get(name, {})} for name, about in files.items()}}, began)


def publish(mirror: Mirror, drive: str, sent: SentRun, made: Path) -> str:
    """Write a snapshot with a drive that was sent; the ID under which the map has it: that of the same drive where a
    writer put that in meanwhile, a free one where another has this ID. Its run folder, if it is on this machine, is
    kept for those who read. Raises ResultError; then the map has the drive as before."""
    entry, found = sent.entry, list[str]()
    copies: Copies = {f"{name}/{folder_name(drive)}/{name}.parquet": f"{sent.place}/{name}.parquet" for name in TABLES}

    def change(snapshot: Snapshot) -> None:
        check_recent(sent.began)
        if snapshot["drives"].get(drive, {}).get("generation") == entry["generation"]:
            return  # an attempt whose answer was lost
        found[:] = _same_drive(mirror, snapshot["drives"], entry["record"])
        if not found:
            _check_untouched(mirror, snapshot, drive)
            _replace_drive(snapshot, drive)
            snapshot["drives"][drive] = entry
            snapshot["copies"] |= copies if snapshot.get("by_drive", True) else {}
            snapshot["failures"].pop(drive, None)

    try:
        mirror.commit(f"{drive} {'replaced' if drive in mirror.drives else 'added'}", change)
    except TakenError:
        shutil.rmtree(made, ignore_errors=True)
        free = layout.free_name(drive, entry["record"]["log"], mirror.manifest.now["drives"])
        return publish(mirror, free, _renamed(mirror.remote, sent, free), made)
    except LostRaceError:
        _remove_quietly(mirror.remote / sent.place)
        raise
    if found:  # the other writer's is as good
        _remove_quietly(mirror.remote / sent.place)
        mirror.drives[found[0]] = mirror.manifest.now["drives"][found[0]]
        shutil.rmtree(made, ignore_errors=True)
        return found[0]
    for name in entry["files"]:
        if name not in layout.RUN_TABLES:  # a batch would fill the disk
            (made / name).unlink(missing_ok=True)
    mirror.adopt(drive, entry, made)
    _copy_committed(mirror, copies.__contains__)
    return drive


def _renamed(remote: RemotePath, sent: SentRun, drive: str) -> SentRun:
    """Copy of a run folder under another ID, made within the store. Raises ResultError."""
    files, name, record = sent.entry["files"], "keyframes.parquet", layout.renamed(sent.entry["record"], drive)
    new = SentRun({**sent.entry, "record": record, "generation": secrets.token_hex(8)}, sent.began)
    with scratch("renamed") as folder, store_errors(remote):
        for one in files.keys() - {name}:
            objects.copy(remote / sent.place / one, remote / new.place / one)
        objects.fetch(remote / sent.place / name, folder / name, files[name]["bytes"])
        layout.set_drive_id(folder / name, drive)
        about = {**files[name], **_send_all([name], folder, remote / new.place)[name]}
    _remove_quietly(remote / sent.place)
    return SentRun({**new.entry, "files": {**files, name: about}}, sent.began)


def check_recent(began: float) -> None:
    """Raises ResultError where what was sent may be removed as that of a killed writer."""
    if not 0 <= time.time() - began < VACUUM_S - _CLOCKS_S:
        raise ResultError("This writer was stopped for too long, so what it sent may be gone. Run again.")


def _same_drive(mirror: Mirror, drives: dict[str, Any], record: dict[str, Any]) -> list[str]:
    """The ID of a drive that is made from the same and that another writer has put in since this one looked."""
    known = {drive: entry["generation"] for drive, entry in mirror.drives.items()}
    new = [drive for drive, entry in drives.items() if entry["generation"] != known.get(drive)]
    return [drive for drive in new if layout.renamed(record, drive)["key"] == drives[drive]["record"]["key"]][:1]


def _check_untouched(mirror: Mirror, snapshot: Snapshot, drive: str) -> None:
    """Raises TakenError or LostRaceError where another writer has put a drive in, or replaced it, since this one
    looked."""
    theirs, known = snapshot["drives"].get(drive), mirror.drives.get(drive)
    if theirs is not None and known is None:
        raise TakenError(f"Another writer has put another drive named {drive} into {mirror.remote}. Run again.")
    if theirs is not None and known is not None and theirs["generation"] != known["generation"]:
        raise LostRaceError(f"Another writer has replaced {drive} in {mirror.remote}, which stays so. Run again.")


def _replace_drive(snapshot: Snapshot, drive: str) -> None:
    """Take a drive out, and note when."""
    if (old := snapshot["drives"].pop(drive, None)) is not None:
        tokens = {about["pack"]["token"] for about in old["files"].values() if "pack" in about}
        places = [f"runs/{folder_name(drive)}/{old['generation']}", *(f"packs/{token}" for token in tokens)]
        snapshot["replaced"] |= dict.fromkeys(places, now())


def _remove_quietly(place: RemotePath) -> None:
    """Remove objects that no snapshot names; where that fails `map vacuum` does it."""
    with suppress(OSError):
        objects.remove(place)


def annotate(mirror: Mirror, drive: str, about: dict[str, Any]) -> None:
    """Change fields of drive.json that nothing else depends on. Raises ResultError."""

    def change(snapshot: Snapshot) -> None:
        _check_untouched(mirror, snapshot, drive)
        if entry := snapshot["drives"].get(drive):
            snapshot["drives"][drive] = {**entry, "record": {**entry["record"], **about}}

    mirror.commit(f"{', '.join(about)} of {drive}", change)
    mirror.drives[drive] = mirror.manifest.now["drives"].get(drive, mirror.drives[drive])


def _send_all(names: Collection[str], folder: Path, place: RemotePath) -> dict[str, dict[str, Any]]:
    """Send files of a folder: length, sha256 and ETag, by name. Raises ResultError."""

    def send(name: str) -> dict[str, Any]:
        file = folder / name
        digest, result = objects.send(place / name, file)
        return {"bytes": file.stat().st_size, "sha256": digest, "tag": tag_of(result)}

    with store_errors(place), ThreadPoolExecutor(_SENT_AT_ONCE) as pool:
        return dict(zip(names, pool.map(send, names), strict=True))


def write_head(mirror: Mirror, library: str | None, settings: dict[str, Any]) -> None:
    """Set the settings of the map and, once, its library, if known. Raises ResultError where it has another library."""

    def change(snapshot: Snapshot) -> None:
        if library is not None and snapshot["library"] not in (None, library):
            raise LostRaceError(
                f"Another writer has given {mirror.remote} the library {snapshot['library'][:12]}. Run again."
            )
        snapshot["library"], snapshot["settings"] = library or snapshot["library"], settings

    mirror.commit("settings", change)


def update_failures(mirror: Mirror, changes: dict[str, dict[str, Any] | None]) -> None:
    """Note failures of drives; None: that a drive has not failed. Raises ResultError."""

    def change(snapshot: Snapshot) -> None:
        known = snapshot["failures"] | changes
        snapshot["failures"] = {drive: known[drive] for drive in sorted(known) if known[drive] is not None}

    mirror.commit("failures", change)


def send_library(mirror: Mirror, digest: str) -> None:
    """Send a library. It is named by its content, so what is there stays. Raises ResultError."""
    if digest in mirror.manifest.now["libraries"]:
        return
    folder, place = mirror.local / "libraries" / digest, mirror.remote / "libraries" / digest
    sent = _send_all(files_in(folder), folder, place)
    mirror.commit("library", lambda snapshot: snapshot["libraries"].setdefault(digest, sent))


def remove(mirror: Mirror, drives: Sequence[str]) -> None:
    """Take drives out, with all that bears their names, all in one step. Raises ResultError."""
    named = set(map(folder_name, drives))

    def change(snapshot: Snapshot) -> None:
        for drive in drives:
            _replace_drive(snapshot, drive)
            snapshot["failures"].pop(drive, None)
        gone = [name for name in snapshot["rest"] if drives_in(name) & named]
        _replace_rest(snapshot, dict.fromkeys(gone))
        snapshot["copies"] |= {f"{name}/{folder}/{name}.parquet": None for folder in named for name in TABLES}

    mirror.commit(f"{', '.join(drives)} removed", change)
    for drive in drives:
        mirror.drives.pop(drive, None)
    for name in [name for name in mirror.held if drives_in(name) & named]:
        del mirror.held[name]
    for folder in [folder for name in named for folder in mirror.local.glob(f"*/{name}")]:
        shutil.rmtree(folder)
    _copy_committed(mirror, lambda name: drives_in(name) & named)


def send_rest(mirror: Mirror) -> None:
    """Send what the local folder has beside drives and libraries, if it changed; tables and records also by their own
    names, for those who read them as data sets. Raises LostRaceError where another writer has changed the same."""
    known, hashes = mirror.held, dict[str, str]()
    for name in mirror.local_rest():  # parts of the index are named by what is in them
        same = name in known and name.endswith(".lists")
        hashes[name] = known[name]["sha256"] if same else layout.sha256_of(mirror.local / name)
    new = [name for name in hashes if hashes[name] != known.get(name, {}).get("sha256")]
    gone = [name for name in known if name not in hashes]
    if not new and not gone:
        return
    generation, began = secrets.token_hex(8), time.time()
    sent = _send_all(new, mirror.local, mirror.remote / "rest" / generation)
    changes = {**{name: {**about, "generation": generation} for name, about in sent.items()}, **dict.fromkeys(gone)}

    def change(snapshot: Snapshot) -> None:
        check_recent(began)
        contested = set(changes)
        if any(map(is_join_state, changes)):  # drives are joined one after the other
            contested |= set(filter(is_join_state, snapshot["rest"]))
        for name in contested:
            theirs = snapshot["rest"].get(name)
            if theirs != known.get(name) and (theirs or {}).get("sha256") != hashes.get(name):
                raise LostRaceError(f"Another writer has joined drives of {mirror.remote} at the same time. Run again.")
        there = set(map(folder_name, snapshot["drives"]))
        _replace_rest(snapshot, {name: about for name, about in changes.items() if not drives_in(name) - there})

    try:
        mirror.commit("joins", change)
    except LostRaceError:
        _remove_quietly(mirror.remote / "rest" / generation)
        raise
    mirror.held = {name: mirror.manifest.now["rest"][name] for name in hashes if name in mirror.manifest.now["rest"]}
    _copy_committed(mirror, changes.__contains__)


def _replace_rest(snapshot: Snapshot, changes: dict[str, Any]) -> None:
    """Put files beside drives in, or take them out (None)."""
    for name, about in changes.items():
        if (old := snapshot["rest"].pop(name, None)) is not None:
            snapshot["replaced"][f"rest/{old['generation']}/{name}"] = now()
        if about is not None:
            snapshot["rest"][name] = about
        if name.endswith((".parquet", ".json")):
            snapshot["copies"][name] = None if about is None else f"rest/{about['generation']}/{name}"


def drop_copies(mirror: Mirror) -> None:
    """Remove the tables that are copied by drive, for Delta tables have the same, and make no more. What is left of
    them `vacuum` removes. Raises ResultError."""

    def change(snapshot: Snapshot) -> None:
        snapshot["by_drive"] = False
        left = snapshot["copies"].items()
        snapshot["copies"] = {name: source for name, source in left if name.split("/")[0] not in TABLES}

    if mirror.manifest.now.get("by_drive", True):
        mirror.commit("tables by drive dropped", change)
        for name in TABLES:
            _remove_quietly(mirror.remote / name)


def vacuum(mirror: Mirror, hours: float) -> dict[str, int]:
    """Remove what was replaced more than `hours` ago, and what no snapshot names and is as old; how many objects and
    bytes. Raises ResultError."""
    snapshot, before = mirror.manifest.now, datetime.now(UTC) - timedelta(hours=hours)
    needed = {name for name, when in snapshot["replaced"].items() if datetime.fromisoformat(when) > before}
    for drive, entry in snapshot["drives"].items():
        place = f"runs/{folder_name(drive)}/{entry['generation']}"
        if "packed" in entry and datetime.fromisoformat(entry["packed"]) <= before:
            needed |= {f"{place}/{name}" for name, about in entry["files"].items() if "pack" not in about}
        else:
            needed.add(place)
    needed |= {f"packs/{token}" for token in snapshot.get("packs", {})}
    needed |= {f"rest/{about['generation']}/{name}" for name, about in snapshot["rest"].items()}
    needed |= {f"libraries/{digest}" for digest in snapshot["libraries"]}
    log = mirror.manifest.log
    recent = [row for row, newer in zip(log[1:], log, strict=False) if datetime.fromisoformat(newer["time"]) > before]
    needed |= {row["object"] for row in [*log[:1], *recent, *(row for row, _ in mirror.manifest.layers)]}
    if snapshot.get("by_drive", True):
        needed |= {f"{name}/{folder_name(drive)}/{name}.parquet" for drive in snapshot["drives"] for name in TABLES}
    needed |= snapshot["rest"].keys()
    gone = dict[str, int]()
    with store_errors(mirror.remote):
        for name, meta in objects_below(mirror.remote).items():
            parts = name.split("/")
            above = {"/".join(parts[:count]) for count in range(1, len(parts) + 1)}
            if parts[0] in _OWN and not above & needed and meta["last_modified"] < before:
                gone[name] = meta["size"]
        objects.delete(mirror.remote, gone)

    def change(snapshot: Snapshot) -> None:
        left = snapshot["replaced"].items()
        snapshot["replaced"] = {name: when for name, when in left if datetime.fromisoformat(when) > before}

    mirror.commit("vacuum", change)
    return {"objects": len(gone), "bytes": sum(gone.values())}
