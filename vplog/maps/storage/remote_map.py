"""A map on an object store, through a local folder that has the names of a map and of its files those asked for.

    MAP/map.json, failures.json, libraries/HASH/...   as in a folder
    MAP/runs/drive=ID/GENERATION/...                  the run folder; its generation is a random name, never used twice
    MAP/runs/drive=ID/drive.json                      the manifest: what a folder's drive.json says, the generation, and
                                                      length and sha256 of each of its files; written when all are there
    MAP/keyframes/drive=ID/keyframes.parquet          its tables as data sets, copied within the store
    MAP/rest/GENERATION/..., MAP/rest.json            all else that a map's folder has, as what joins its drives

An object store has no rename and no links, but an object appears whole or not at all. So a manifest is the one thing
that changes, and what it names never does: a reader has the drive of the old manifest or that of the new one. What the
old one named is removed afterwards, by the writer that replaced it; a reader that comes too late for it reads the new
manifest. No writer removes what it did not itself replace, so nothing breaks even where two write at once: the last
manifest counts. A killed writer leaves objects that no manifest names; a later one removes them after a day.
"""

from __future__ import annotations

import json
import shutil
import threading
from collections import defaultdict
from collections.abc import Collection, Iterable, Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path, PurePosixPath
from typing import TYPE_CHECKING, Annotated, Any, cast
from urllib.parse import unquote

from pydantic import BaseModel, Field, StrictInt

from vplog.errors import NewerError, ResultError
from vplog.maps.storage import objects
from vplog.maps.storage.damage import DamagedDriveError, UnreachableError
from vplog.maps.storage.layout import ADD_AGAIN, HASH, TABLES, checked_record, folder_name
from vplog.storage.folders import is_below
from vplog.storage.json_records import has_checksum
from vplog.storage.remote_path import RemotePath, names_below, reason

if TYPE_CHECKING:
    from vplog.maps.storage.download_cache import Cache
    from vplog.maps.storage.lease_lock import Lock

_REQUESTS = 16
"""At once: a store answers each in some 20 to 50 ms, whatever its size."""
_NOT_IN_FOLDER = ("generation", "replaces", "files")
"""Fields of a manifest that the drive.json of a folder does not have."""
_LIBRARY_FILE_BYTES = 2**34
"""Longest file of a library that is fetched: 16 GB, more than load_references takes."""
Generation = Annotated[str, Field(pattern="^[0-9a-f]{16}$")]


class _File(BaseModel):
    bytes: StrictInt
    sha256: Annotated[str, Field(pattern=f"^{HASH.pattern}$")]
    rows: StrictInt = 0


class _Manifest(BaseModel):
    """The fields of a manifest beside those of drive.json."""

    generation: Generation
    replaces: Generation | None
    files: dict[str, _File]


class Mirror:
    """The drives of a map on a store, and the local folder that they are read and made through."""

    def __init__(
        self, remote: RemotePath, local: Path, lock: Lock | None = None, *, cache: Cache | None = None
    ) -> None:
        """With a lock it may be written to; with a cache nothing is fetched that is there. Raises ResultError where the
        store cannot be read."""
        self.remote, self.local, self.lock, self.cache = remote, local, lock, cache
        self.manifests: dict[str, dict[str, Any]] = {}
        self.versions: dict[str, objects.Version | None] = {}
        """State of each object as it was read or written last, None where there was none: no other one is replaced."""
        self.damaged: dict[str, str] = {}
        """Drives whose manifest is damaged or missing, and why."""
        self.rest_manifest: dict[str, Any] = {}
        self.rest_damage = ""
        """Damage of the files beside drives, where a writer goes on without them."""
        self._fetched: set[str] = set()
        self._locks: defaultdict[str, threading.Lock] = defaultdict(threading.Lock)
        with store_errors(remote):
            for name in ("map.json", "failures.json", "removed.json"):
                if (data := self.read(name)) is not None:
                    (local / name).write_bytes(data)
            runs = names_below(remote / "runs")
            folders = sorted(name for name, has_below in runs.items() if has_below and name.startswith("drive="))
            with ThreadPoolExecutor(_REQUESTS) as pool:
                list(pool.map(self._open, folders))

    def read(self, name: str) -> bytes | None:
        """An object of the map, None where there is none. Raises OSError."""
        found = objects.get_with_version(self.remote / name)
        self.versions[name] = None if found is None else found.version
        return None if found is None else found.data

    def write(self, name: str, data: bytes) -> None:
        """Replace an object as it was read or written last. Raises ResultError where another writer has been there, and
        OSError."""
        self.check_lock()
        place = self.remote / name
        version = objects.put_if(place, data, self.versions.get(name))
        if version is None:
            found = objects.get_with_version(place)
            if found is None or found.data != data:  # else the response was lost, and this is a repetition
                raise ResultError(f"Another writer has replaced {place}, which stays as it is. Run again.")
            version = found.version
        self.versions[name] = version

    def check_lock(self) -> None:
        """Raises ResultError where the map is open for reading, or another writer has taken the lock over."""
        if self.lock is None:
            raise ResultError(f"{self.remote} is open for reading alone.")
        self.lock.check()

    def _open(self, drive_folder: str) -> None:
        """Read the manifest of a drive. One that is missing was there where a table has a copy: that comes after it."""
        drive, place = unquote(drive_folder.removeprefix("drive=")), self.remote / "runs" / drive_folder
        try:
            found = self.read_manifest(drive_folder)
        except NewerError:
            raise
        except ResultError as error:
            self.damaged[drive] = str(error)
            return
        if found is not None:
            self.write_drive_record(found)
        elif any(objects.files_below(self.remote / name / drive_folder) for name in TABLES):
            self.damaged[drive] = f"{place}/drive.json is not there."

    def fetch(self, drive: str, names: Iterable[str]) -> None:
        """Download these files of a drive into the local folder, all of one generation. Raises DamagedDriveError where
        one is gone or damaged, and ResultError."""
        with self._locks[drive]:
            for _ in range(3):
                if (manifest := self.manifests.get(drive)) is None:
                    return
                place = self.remote / "runs" / folder_name(drive) / manifest["generation"]
                try:
                    for name in names:
                        if why := self._fetch_file(place / name, self.run(drive) / name, manifest["files"].get(name)):
                            raise DamagedDriveError(f"{why}. Copy it back, or {ADD_AGAIN}", drive)
                except FileNotFoundError:
                    self._reread_manifest(drive)
                else:
                    self._fetched.add(drive)
                    return
            raise ResultError(f"{self.remote}: {drive} is replaced faster than it can be read. Try again later.")

    def damaged_files(self, drive: str, names: Iterable[str]) -> list[str]:
        """A line for each file of a drive that is gone, and for the first of `names` that is damaged: these are
        fetched. Raises UnreachableError."""
        manifest = self.manifests[drive]
        place = self.remote / "runs" / folder_name(drive) / manifest["generation"]
        with store_errors(self.remote):
            gone = [f"{place / name} is not there." for name in manifest["files"].keys() - objects.files_below(place)]
        try:
            self.fetch(drive, names)
        except DamagedDriveError as error:
            return sorted({*gone, str(error)})
        return sorted(gone)

    def evict(self, drive: str) -> None:
        """Delete the local copies of a drive's files; they are fetched again when they are needed."""
        with self._locks[drive]:
            shutil.rmtree(self.run(drive), ignore_errors=True)
            self._fetched.discard(drive)
            if drive in self.manifests:
                self.write_drive_record(self.manifests[drive])

    def _reread_manifest(self, drive: str) -> None:
        """Read the manifest of a drive whose files are gone. Raises ResultError where some of them were handed out."""
        place = self.remote / "runs" / folder_name(drive)
        with store_errors(self.remote):
            found = self.read_manifest(place.name)
        old = self.manifests[drive]
        if found is not None and found["generation"] == old["generation"]:
            raise DamagedDriveError(
                f"{place} has lost files that its drive.json names. Copy them back, or {ADD_AGAIN}", drive
            )
        del self.manifests[drive]
        shutil.rmtree(self.run(drive), ignore_errors=True)
        if found is None:
            raise ResultError(f"{drive} was removed from {self.remote} while it was read. Run again.")
        if drive in self._fetched:
            raise ResultError(f"{drive} was replaced in {self.remote} while it was read. Run again.")
        self.write_drive_record(found)

    def library(self, digest: str) -> None:
        """Download a library into the local folder, if the map has it. Raises ResultError."""
        target, place = self.local / "libraries" / digest, self.remote / "libraries" / digest
        if target.exists() or not HASH.fullmatch(digest):
            return
        part, files = target.with_name(f".{digest}.part"), dict[str, str]()
        if self.cache is None or not self.cache.take_library(digest, part):
            with store_errors(self.remote):
                names = sorted(objects.files_below(place))
                if "library.json" not in names:  # it is sent last
                    return
                for name in filter(is_below, names):
                    (part / name).parent.mkdir(parents=True, exist_ok=True)
                    files[name] = objects.fetch(place / name, part / name, _LIBRARY_FILE_BYTES)
            if self.cache is not None:
                self.cache.keep_library(digest, files, part)
        part.rename(target)

    def rest(self, names: Collection[str] = ()) -> None:
        """Download all other files of the map into the local folder, or those of these names.

        Raises ResultError where some of it is damaged. A writer goes on without that and without the joint graphs,
        which `map join` makes again; `rest_damage` says why.
        """
        if self.rest_damage:
            return
        damage = self._fetch_rest(names)
        if damage and self.lock is None:
            raise ResultError(f"{damage}. Join the drives again: vplog map join {self.remote}")
        if damage:
            self.rest_damage = damage
            if not self.rest_manifest:  # of the copies that joins have by their own names; their hashes are unknown
                with store_errors(self.remote):
                    below = {top: objects.files_below(self.remote / top) for top in ("joint", "joins")}
                left = ["joint.json", *(f"{top}/{name}" for top in below for name in below[top])]
                self.rest_manifest = {"files": {name: {"sha256": ""} for name in left}}
            (self.local / "joint.json").unlink(missing_ok=True)
            shutil.rmtree(self.local / "joint", ignore_errors=True)

    def _fetch_rest(self, names: Collection[str]) -> str:
        """The first damage of it, if any. Raises ResultError."""
        before = None
        for _ in range(3):
            try:
                with store_errors(self.remote):
                    data = self.read("rest.json")
                if data is None:
                    return ""
                manifest = checked_manifest(data, self.remote / "rest.json")
            except UnreachableError:
                raise
            except ResultError as error:
                return str(error).partition(". ")[0]
            self.rest_manifest, place = manifest, self.remote / "rest" / manifest["generation"]
            known = {folder_name(drive) for drive in self.manifests}  # files of other drives are not wanted
            parts = {name: PurePosixPath(name).parts for name in manifest["files"] if name in names or not names}
            wanted = {one for one in parts if {part for part in parts[one] if part.startswith("drive=")} <= known}
            damaged, gone = list[str](), list[str]()
            for name in sorted(wanted):
                try:
                    if why := self._fetch_file(place / name, self.local / name, manifest["files"][name]):
                        damaged.append(why)
                except FileNotFoundError:
                    gone.append(f"{place / name} is not there")
            if not gone or manifest["generation"] == before:
                return "; ".join((gone + damaged)[:1])
            before = manifest["generation"]
            for name in wanted:
                (self.local / name).unlink(missing_ok=True)
        raise ResultError(f"{self.remote}/rest is replaced faster than it can be read. Try again later.")

    def _fetch_file(self, place: RemotePath, target: Path, about: dict[str, Any] | None) -> str:
        """Fetch an object, if the manifest names it and it is not here yet; what is wrong with it, if anything. Raises
        FileNotFoundError where it is gone, and UnreachableError."""
        if about is None or target.exists():
            return ""
        target.parent.mkdir(parents=True, exist_ok=True)
        if self.cache is not None and self.cache.fetch_to(about["sha256"], target):
            return ""
        part = target.with_name(f".{target.name}.part")
        try:
            digest = objects.fetch(place, part, about["bytes"])
        except FileNotFoundError:
            raise
        except OSError as error:
            raise UnreachableError(f"Cannot read {place}: {reason(error)}. Try again later.") from None
        if (digest, part.stat().st_size) != (about["sha256"], about["bytes"]):
            part.unlink()
            return f"{place} does not have the length and sha256 that its manifest names"
        part.replace(target)
        if self.cache is not None:
            self.cache.keep(digest, target)
        return ""

    def read_manifest(self, drive_folder: str) -> dict[str, Any] | None:
        """The current manifest of a drive, None without one. Raises OSError, and ResultError where it is damaged."""
        place = self.remote / "runs" / drive_folder
        data = self.read(f"runs/{drive_folder}/drive.json")
        return (
            None if data is None else checked_record(checked_manifest(data, place / "drive.json"), cast("Path", place))
        )

    def write_drive_record(self, manifest: dict[str, Any]) -> None:
        """Make the drive's local folder with its drive.json."""
        folder = self.run(manifest["drive"])
        folder.mkdir(parents=True, exist_ok=True)
        own = {key: manifest[key] for key in manifest if key not in _NOT_IN_FOLDER}
        text = json.dumps(own, indent=2, ensure_ascii=False) + "\n"  # as write_run_json has it
        (folder / "drive.json").write_text(text, encoding="utf-8")
        self.manifests[manifest["drive"]] = manifest

    def adopt(self, manifest: dict[str, Any], made: Path) -> None:
        """Move the folder of a drive that was just uploaded into the local folder."""
        folder = self.run(manifest["drive"])
        shutil.rmtree(folder, ignore_errors=True)
        folder.parent.mkdir(parents=True, exist_ok=True)
        made.rename(folder)
        self.manifests[manifest["drive"]] = manifest
        self.damaged.pop(manifest["drive"], None)
        self._fetched.add(manifest["drive"])

    def run(self, drive: str) -> Path:
        """The drive's local folder."""
        return self.local / "runs" / folder_name(drive)


@contextmanager
def store_errors(remote: RemotePath) -> Iterator[None]:
    """Raises UnreachableError where a store refuses."""
    try:
        yield
    except OSError as error:
        raise UnreachableError(f"Cannot read or write {remote}: {reason(error)}.") from None


def checked_manifest(data: bytes, place: RemotePath) -> dict[str, Any]:
    """A manifest whose names stay within the map. Raises ResultError."""
    try:
        manifest = json.loads(data)
        sound = has_checksum(manifest) and all(map(is_below, _Manifest.model_validate(manifest).files))
    except (ValueError, TypeError, AttributeError, RecursionError):
        sound, manifest = False, {}
    if not sound:
        raise ResultError(f"{place} is not a manifest of vplog. Move it out of the map, and {ADD_AGAIN}")
    return manifest
