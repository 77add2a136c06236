"""A map on an object store, through a local folder that has the names of a map and of its files those asked for.

    MAP/map.json, snapshots/...                       the manifest, which names all below with length and sha256
    MAP/libraries/HASH/...                            as in a folder
    MAP/runs/drive=ID/GENERATION/...                  the run folder; its generation is a random name, never used twice
    MAP/packs/TOKEN                                   small files of drives together, after `map compact` (packs.py)
    MAP/rest/GENERATION/...                           all else that a map's folder has: what joins its drives, the index
    MAP/keyframes/drive=ID/keyframes.parquet          tables as data sets, and what joins drives by its own name; copied
                                                      within the store, after the manifest

An object store has no rename and no links, but an object appears whole or not at all. So the manifest is the one thing
that changes (snapshot.py), and what it names never does. What a snapshot replaced, and what a killed writer sent for
none, is removed by `map vacuum` a day later.
"""

from __future__ import annotations

import os
import secrets
import shutil
import threading
from collections import defaultdict
from collections.abc import Callable, Collection, Iterable
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import dataclass
from functools import lru_cache
from hashlib import sha256
from pathlib import Path, PurePosixPath
from typing import Any, cast

import zstandard

from vplog.errors import ResultError
from vplog.maps.storage import objects
from vplog.maps.storage.damage import DamagedDriveError, UnreachableError
from vplog.maps.storage.download_cache import Cache
from vplog.maps.storage.layout import ADD_AGAIN, RUN_TABLES, TABLES, folder_name
from vplog.maps.storage.snapshot import Manifest, Snapshot, store_errors
from vplog.results import run_record
from vplog.storage.object_store import plain_errors
from vplog.storage.remote_path import RemotePath, located, objects_below, reason
from vplog.storage.scratch import files_in

MOST_SECTION = 1 << 21
"""Bytes of files that are compressed as one, and fetched for any of them: zstd finds what is alike in as much."""
_SECTIONS = 8
"""Sections that a reader holds."""
Copies = dict[str, str | None]
"""Objects to copy within the store, by the new name; None: to remove."""


@dataclass(frozen=True)
class StoredFile:
    """A file on an object store, by name for other machines."""

    url: str
    sha256: str
    bytes: int

    def fetched(self, cache: Cache | None) -> Path:
        """The file in this machine's cache. Raises ResultError where it cannot be had."""
        if cache is None:
            raise ResultError("A worker has no cache for the index of the map. Set VPLOG_CACHE to a folder there.")
        target = cache.root / "objects" / self.sha256
        if target.exists():
            with suppress(OSError):  # of another user, in a cache that they share
                os.utime(target)
            return target
        part, place = target.with_name(f".{secrets.token_hex(16)}.part"), cast("RemotePath", located(self.url))
        cache.trim()  # not afterwards: the file may be longer than its bound
        try:
            with store_errors(place):
                target.parent.mkdir(parents=True, exist_ok=True)
                if objects.fetch(place, part, self.bytes) != self.sha256:
                    raise ResultError(f"{place} is damaged. Move it aside: the next join builds it again.")
                part.replace(target)
        finally:
            part.unlink(missing_ok=True)
        return target


class Mirror:
    """The drives of a map on a store, and the local folder that they are read and made through. A reader has them as of
    one snapshot; so has a writer, with its own changes, until `refresh`."""

    def __init__(
        self, remote: RemotePath, local: Path, cache: Cache | None = None, *, writable: bool = False,
        as_of: str | None = None,
    ) -> None:  # fmt: skip
        """With a cache nothing is fetched that is there; `as_of` as in `Manifest`. Raises ResultError where the store
        cannot be read."""
        self.remote, self.local, self.cache, self.writable = remote, local, cache, writable
        self.manifest = Manifest(remote, as_of)
        self.drives: dict[str, dict[str, Any]] = dict(self.manifest.now["drives"])
        """As the snapshot has them."""
        self.held: dict[str, dict[str, Any]] = {}
        """Files beside drives that were fetched or sent, by name."""
        self.rest_damage = ""
        """Damage of these, where a writer goes on without them."""
        self.copied: Copies = {}
        """Copies within the store that are made, and not noted as such in the manifest."""
        self._locks: defaultdict[str, threading.Lock] = defaultdict(threading.Lock)
        self._section = lru_cache(_SECTIONS)(self._fetch_section)

    @property
    def exists(self) -> bool:
        return self.manifest.version is not None

    def commit(self, what: str, change: Callable[[Snapshot], object]) -> None:
        """Make a change to a map that is open for writing. Raises ResultError where the change does."""

        def changed(snapshot: Snapshot) -> None:
            snapshot["copies"] = {
                name: source for name, source in snapshot["copies"].items() if self.copied.get(name, "") != source
            }
            change(snapshot)

        self.manifest.commit(what, changed)
        self.copied.clear()

    def refresh(self) -> None:
        """Take the map as the newest snapshot that is known has it, with what joins its drives."""
        newest = self.manifest.now["drives"]
        for drive, entry in self.drives.items():
            if newest.get(drive, {}).get("generation") != entry["generation"]:
                shutil.rmtree(self.run(drive), ignore_errors=True)
        self.drives = dict(newest)
        rest, before = self.manifest.now["rest"], self.held
        same = {name: about for name, about in before.items() if rest.get(name) == about}
        self.held = {name: about for name, about in same.items() if not is_join_state(name)}
        for name in self.local_rest():
            verified = name.startswith("joins/") and name.endswith(".parquet")  # which counts
            if name not in self.held and (name in before or name in rest or not (verified or _of_index(name))):
                (self.local / name).unlink()

    def local_rest(self) -> list[str]:
        """Names of the files beside drives and libraries in the local folder."""
        return [name for name in files_in(self.local) if name.split("/")[0] not in ("runs", "libraries", *TABLES)]

    def fetch(self, drive: str, names: Iterable[str]) -> None:
        """Download these files of a drive into the local folder. Raises DamagedDriveError where one is gone or damaged,
        and ResultError."""
        with self._locks[drive]:
            if (about := self.drives.get(drive)) is None:
                return
            folder, place = self.run(drive), self.place(drive)
            if not folder.exists():
                folder.mkdir(parents=True)
                run_record.write_run_json(folder / "drive.json", about["record"])
            for name in names:
                try:
                    why = self._fetch_file(place / name, folder / name, about["files"].get(name))
                except FileNotFoundError:
                    self._check_current(drive)
                    why = f"{place / name} is not there"
                if why:
                    raise DamagedDriveError(f"{why}. Copy it back, or {ADD_AGAIN}", drive)

    def _check_current(self, drive: str) -> None:
        """Raises ResultError where the files of a drive are gone because another snapshot has replaced it."""
        newest = Manifest(self.remote).now["drives"].get(drive)
        if newest is None or newest["generation"] != self.drives[drive]["generation"]:
            then = "Run again." if self.manifest.as_of is None else "Name a newer version."
            raise ResultError(
                f"{drive} was {'removed from' if newest is None else 'replaced in'} {self.remote} while it was read, "
                f"and what it was is removed. {then}"
            )

    def place(self, drive: str) -> RemotePath:
        """Where the files of a drive are."""
        return self.remote / "runs" / folder_name(drive) / self.drives[drive]["generation"]

    def damaged_files(self, drive: str) -> list[str]:
        """A line for each file of a drive that is gone, and for the first that is damaged: read are those that are not
        as the store had them after they were sent. Raises UnreachableError."""
        place, files = self.place(drive), self.drives[drive]["files"]
        with store_errors(self.remote):
            there = {name: (meta["size"], tag_of(meta)) for name, meta in objects_below(place).items()}
            packs = {name: (meta["size"], tag_of(meta)) for name, meta in objects_below(self.remote / "packs").items()}
        packed = {name: about["pack"]["token"] for name, about in files.items() if "pack" in about}
        gone = [f"{place / name} is not there." for name in files.keys() - there.keys() - packed.keys()]
        known = self.manifest.now.get("packs", {})
        sound = {token for token, about in known.items() if packs.get(token) == (about["bytes"], about["tag"])}
        doubtful = [name for name, token in packed.items() if token not in sound]
        doubtful += [
            name for name, about in files.items()
            if name not in packed and there.get(name, "") not in ("", (about["bytes"], about["tag"]))
            and (name in RUN_TABLES or about["bytes"] != there[name][0])
        ]  # fmt: skip
        try:
            self.fetch(drive, doubtful)
        except DamagedDriveError as error:
            gone.append(str(error))
        return sorted(gone)

    def evict(self, drive: str) -> None:
        """Delete the local copies of a drive's files; they are fetched again when they are needed."""
        with self._locks[drive]:
            shutil.rmtree(self.run(drive), ignore_errors=True)

    def library(self, digest: str, names: Collection[str] = ()) -> None:
        """Download a library into the local folder, if the map has it, or these files of it. Raises ResultError."""
        with self._locks[digest], store_errors(self.remote):
            for name, about in self.manifest.now["libraries"].get(digest, {}).items():
                if not names or name in names:
                    file = f"libraries/{digest}/{name}"
                    if why := self._fetch_file(self.remote / file, self.local / file, about):
                        raise ResultError(f"{why}. Copy it back.")

    def names_below(self, folder: str) -> set[str]:
        """Names in a folder beside drives."""
        start = f"{folder}/"
        return {name.split("/")[start.count("/")] for name in self.manifest.now["rest"] if name.startswith(start)}

    def drop(self, name: str) -> None:
        """Let a file beside drives, or a folder of such, be removed with what is sent next."""
        rest, start = self.manifest.now["rest"], f"{name}/"
        self.held |= {
            one: rest[one] for one in ([name] if name in rest else rest) if one == name or one.startswith(start)
        }

    def fetch_index(self, folder: Path) -> None:
        """Download what the map has of its index into a folder. What cannot be had is built."""
        for name, about in self.manifest.now["rest"].items():
            target = folder / PurePosixPath(name).name
            if _of_index(name) and not target.exists():
                with suppress(OSError, ResultError):
                    if not self._fetch_file(self.remote / "rest" / about["generation"] / name, target, about):
                        self.held |= {name: about} if folder.parent == self.local else {}

    def stored_index(self, path: Path | None) -> StoredFile | None:
        """Where the map has a file of the index that is here; None where no writer has put it there."""
        name = f"index/{'' if path is None else path.name}"
        if (about := self.manifest.now["rest"].get(name)) is None:
            return None
        place = self.remote / "rest" / about["generation"] / name
        return StoredFile(place.url, about["sha256"], about["bytes"])

    def rest(self, names: Collection[str] = ()) -> None:
        """Download all other files of the map into the local folder, or those of these names.

        Raises ResultError where some of it is damaged. A writer goes on without that and without the joint graphs,
        which `map join` makes again; `rest_damage` says why.
        """
        files = self.manifest.now["rest"]
        if not names:
            known = {folder_name(drive) for drive in self.drives}  # files of other drives are not wanted
            names = [name for name in files if not drives_in(name) - known and not _of_index(name)]
        wanted = [name for name in dict.fromkeys(names) if name in files and name not in self.held]

        def fetched(name: str) -> str:
            place = self.remote / "rest" / files[name]["generation"] / name
            try:
                return self._fetch_file(place, self.local / name, files[name])
            except FileNotFoundError:
                return f"{place} is not there"

        with ThreadPoolExecutor(objects.AT_ONCE) as pool:
            damaged = [why for why in pool.map(fetched, wanted) if why]
        if damaged and not self.writable:
            raise ResultError(f"{damaged[0]}. Join the drives again: vplog map join {self.remote}")
        self.held |= {name: files[name] for name in wanted}
        if damaged:
            self.rest_damage = damaged[0]
            self.drop("joint.json")
            self.drop("joint")
            (self.local / "joint.json").unlink(missing_ok=True)
            shutil.rmtree(self.local / "joint", ignore_errors=True)

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
            if "pack" in about:
                data = self._packed(about)
                part.write_bytes(data)
                digest = sha256(data).hexdigest()
            else:
                digest = objects.fetch(place, part, about["bytes"])
        except FileNotFoundError:
            raise
        except OSError as error:
            raise UnreachableError(f"Cannot read {place}: {reason(error)}. Try again later.") from None
        if (about["sha256"], about["bytes"]) != (digest, part.stat().st_size):
            part.unlink()
            return f"{place} does not have the length and sha256 that its manifest names"
        part.replace(target)
        if self.cache is not None:
            self.cache.keep(digest, target)
        return ""

    def _packed(self, about: dict[str, Any]) -> bytes:
        """A file that is in a pack, if that is sound. Raises OSError."""
        token, section, at = about["pack"]["token"], about["pack"]["section"], about["pack"]["at"]
        with self._locks[token]:  # files of one section come together
            return self._section(token, *section)[at : at + about["bytes"]]

    def _fetch_section(self, token: str, start: int, stop: int) -> bytes:
        """The content of a section of a pack; nothing of a damaged one. Raises OSError."""
        if not 0 <= start < stop <= start + 2 * MOST_SECTION:
            return b""
        try:
            with plain_errors():
                data = bytes((self.remote / "packs" / token).ask("get", options={"range": (start, stop)}).bytes())
        except OSError as error:
            if "range" in str(error).lower():  # InvalidRange: it is too short
                return b""
            raise
        try:
            sound = 0 < zstandard.frame_content_size(data) <= MOST_SECTION
            return zstandard.ZstdDecompressor().decompress(data) if sound else b""
        except zstandard.ZstdError:
            return b""

    def adopt(self, drive: str, entry: dict[str, Any], made: Path) -> None:
        """Take a drive that was just uploaded; its folder, if it is on this machine, into the local folder."""
        folder = self.run(drive)
        shutil.rmtree(folder, ignore_errors=True)
        if made.exists():
            folder.parent.mkdir(parents=True, exist_ok=True)
            made.rename(folder)
        self.drives[drive] = entry

    def run(self, drive: str) -> Path:
        """The drive's local folder."""
        return self.local / "runs" / folder_name(drive)


def is_join_state(name: str) -> bool:
    """Whether a file records how far joins have come: joint.json and joins/states-*."""
    return name == "joint.json" or name.startswith("joins/states-")


def _of_index(name: str) -> bool:
    return name.startswith("index/")


def tag_of(meta: Any) -> str:
    """ETag of an object; some stores quote it."""
    return (meta["e_tag"] or "").strip('"')


def drives_in(name: str) -> set[str]:
    """Folders of drives that a file is in."""
    return {part for part in PurePosixPath(name).parts if part.startswith("drive=")}
