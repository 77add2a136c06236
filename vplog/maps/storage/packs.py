"""Small files of drives put together in packs of up to 100 MB, in a map on an object store.

    MAP/packs/TOKEN    zstd frames, one behind the other: each is of files of one name, of drives in order of their IDs

Files of one name are much alike, above all their headers and JSON, so a section takes little more than their rows. An
entry of the manifest says where in which section a file is; what is read has the length and sha256 that it had before.
A pack is never changed: a drive that is replaced or removed is not named any more.
"""

from __future__ import annotations

import secrets
import time
from collections import Counter
from collections.abc import Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from itertools import compress
from pathlib import Path
from typing import Any

import zstandard

from vplog.maps.storage import objects
from vplog.maps.storage.damage import DamagedDriveError
from vplog.maps.storage.layout import grouped
from vplog.maps.storage.remote_map import MOST_SECTION, Mirror, tag_of
from vplog.maps.storage.snapshot import Snapshot, now, store_errors
from vplog.maps.storage.upload import check_recent
from vplog.storage.scratch import scratch

_PACK_BYTES = 100_000_000
"""Longest pack. One that holds less than half of it, or of what it held once, is put into a new one."""
_LEVEL = 9
"""zstd level: half a second for 10 MB."""

_Member = tuple[str, str, dict[str, Any]]
"""Drive, name of a file, and its entry in the manifest."""


def compact(mirror: Mirror) -> dict[str, int]:
    """Put small files of drives, and packs that are small or mostly unused, into new packs; how many files and packs.
    Answers are the same. Raises ResultError."""
    done = Counter[str]()
    for members in _plan(mirror):
        began, token, sound = time.time(), secrets.token_hex(16), _sound(mirror, members)
        if not sound:
            continue
        with scratch("pack") as folder, store_errors(mirror.remote):
            places = _write(mirror, folder / token, sound)
            digest, result = objects.send(mirror.remote / "packs" / token, folder / token)
            pack = {"bytes": (folder / token).stat().st_size, "sha256": digest, "tag": tag_of(result)}
        for drive, _, _ in members:
            mirror.evict(drive)

        def change(snapshot: Snapshot) -> None:
            check_recent(began)  # noqa: B023, it is called at once
            _replace(snapshot, sound, places, token, pack)  # noqa: B023

        mirror.commit(f"{len(sound)} files packed", change)
        done += Counter(files=len(sound), packs=1)
    return {"files": done["files"], "packs": done["packs"]}


def _plan(mirror: Mirror) -> list[list[_Member]]:
    """The files of each new pack, by name, then drive."""
    entries = mirror.manifest.now["drives"]
    small = [
        (drive, name, about)
        for drive, entry in sorted(entries.items())
        for name, about in sorted(entry["files"].items())
        if about["bytes"] <= MOST_SECTION // 2
    ]
    used = Counter[str]()
    for _, _, about in small:
        if "pack" in about:
            used[about["pack"]["token"]] += about["bytes"]
    packs = mirror.manifest.now.get("packs", {})
    unused = {token for token in used if used[token] < packs.get(token, {"unpacked": 0})["unpacked"] / 2}
    poor = unused | {token for token in used if used[token] < _PACK_BYTES / 2}
    if len(poor) == 1 and all("pack" in about for _, _, about in small):
        poor = unused
    again = [one for one in small if "pack" not in one[2] or one[2]["pack"]["token"] in poor]
    groups = grouped(again, lambda one: one[2]["bytes"], _PACK_BYTES)
    return [sorted(group, key=lambda member: (member[1], member[0])) for group in groups]


def _sound(mirror: Mirror, members: Sequence[_Member]) -> list[_Member]:
    """Those whose files are there as they were written, which are here then."""

    def fetched(member: _Member) -> bool:
        with suppress(DamagedDriveError):
            mirror.fetch(member[0], [member[1]])
            return True
        return False

    with ThreadPoolExecutor(objects.AT_ONCE) as pool:
        return list(compress(members, pool.map(fetched, members)))


def _write(mirror: Mirror, path: Path, members: Sequence[_Member]) -> list[dict[str, Any]]:
    """Write a pack; the place of each file in it, but for its token."""
    places = list[dict[str, Any]]()
    with path.open("wb") as stream:
        for section in grouped(members, lambda one: one[2]["bytes"], MOST_SECTION, lambda one: one[1]):
            parts = [(mirror.run(drive) / name).read_bytes() for drive, name, _ in section]
            start = stream.tell()
            stop = start + stream.write(zstandard.ZstdCompressor(level=_LEVEL).compress(b"".join(parts)))
            at = 0
            for part in parts:
                places.append({"section": [start, stop], "at": at})
                at += len(part)
    return places


def _replace(
    snapshot: Snapshot, members: Sequence[_Member], places: Sequence[dict[str, Any]], token: str, pack: dict[str, Any]
) -> None:
    """Name the pack for files that are as they were when it was made."""
    unpacked = 0
    for (drive, name, about), place in zip(members, places, strict=True):
        entry = snapshot["drives"].get(drive)
        if entry is not None and entry["files"].get(name) == about:
            if "pack" in about:
                snapshot["replaced"][f"packs/{about['pack']['token']}"] = now()
            else:
                entry = {**entry, "packed": now()}
            files = {**entry["files"], name: {**about, "pack": {"token": token, **place}}}
            snapshot["drives"][drive] = {**entry, "files": files}
            unpacked += about["bytes"]
    named = {
        about["pack"]["token"]
        for one in snapshot["drives"].values()
        for about in one["files"].values()
        if "pack" in about
    }
    packs = {**snapshot.get("packs", {}), token: {**pack, "unpacked": unpacked}}
    snapshot["packs"] = {name: packs[name] for name in sorted(packs) if name in named}
