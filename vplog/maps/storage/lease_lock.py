"""One writer at a time on an object store: a lock object with a lease, which its holder renews.

On S3 the store itself decides who gets it (conditional writes, by boto3), so two can never hold it. Elsewhere, and
without boto3, a writer writes its name, waits and reads whether it is still there: two that start within a round trip
of each other are told apart by that, but not with certainty. Nothing in a map breaks where two do write: see mirror.py.
"""

from __future__ import annotations

import json
import os
import secrets
import socket
import threading
import time
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vplog.errors import ResultError, SettingsError
from vplog.maps.storage import objects
from vplog.storage.remote_path import reason

if TYPE_CHECKING:
    from collections.abc import Iterator

    from vplog.storage.remote_path import RemotePath

NAME = ".lock"
LEASE_S = 120.0
"""A holder that has not renewed for so long is taken as gone. Long enough for a network that fails for a minute, short
enough to wait for after a kill on another machine."""
RENEWALS = 6
"""Renewals within a lease: five may fail in a row."""
_SETTLE_S = 2.0
"""How long a name must stay where the store decides nothing: some round trips."""


@dataclass
class Lock:
    """A lock that is held."""

    place: RemotePath
    name: dict[str, Any]
    """Who holds it, as the object says."""
    renewed: int = 0
    lost: str = ""
    """Why it is not held any more."""
    tag: str | None = None
    """Of the object as it was last written; None where the store decides nothing."""
    over: threading.Event = field(default_factory=threading.Event)

    def check(self) -> None:
        """Raises ResultError where another writer has taken the lock over."""
        if self.lost:
            raise ResultError(f"{self.lost} What was finished is in the map. Run again to go on.")


@contextmanager
def held(root: RemotePath) -> Iterator[Lock]:
    """The lock of a map. Raises SettingsError where another writer holds it, or where nothing can be written."""
    place = root / NAME
    lock = Lock(place, {"token": secrets.token_hex(8), **_here()})
    try:
        _take(lock, root)
    except OSError as error:
        raise SettingsError(f"Cannot write to {root}: {reason(error)}. Choose another place with -o.") from None
    renewing = threading.Thread(target=_renew, args=(lock,), daemon=True)
    renewing.start()
    try:
        yield lock
    finally:
        lock.over.set()
        renewing.join()
        if not lock.lost:
            _release(lock)


def _here() -> dict[str, Any]:
    """This process, so that on its own machine it is known to have ended without waiting for its lease."""
    return {"host": _machine(), "pid": os.getpid(), "started": _started(os.getpid())}


def _machine() -> str:
    """Host, boot and process numbering: processes of another container are not seen from here."""
    boot = Path("/proc/sys/kernel/random/boot_id")
    try:
        return f"{socket.gethostname()} {boot.read_text().strip()} {Path('/proc/self/ns/pid').readlink()}"
    except OSError:
        return f"{socket.gethostname()} {secrets.token_hex(4)}"  # not Linux: every other writer is waited for


def _started(pid: int) -> str | None:
    """When a process of this machine started, in ticks since boot (proc(5), field 22 of stat); None where it ended."""
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[19]
    except (OSError, IndexError):
        return None


def _take(lock: Lock, root: RemotePath) -> None:
    if objects.decides(lock.place):
        found = objects.get_tagged(lock.place)
        if found is not None:
            _refuse_held(found[0], found[2], root)
        _write(lock, None if found is None else found[1])
        if not lock.lost and objects.put_if(lock.place, _said(lock), None) is not None:
            lock.tag = None  # it is there, so a store that decides refuses to make it
    else:
        found, age_s = objects.get(lock.place), objects.age_s(lock.place)
        if found is not None:
            _refuse_held(found, age_s, root)
        objects.put(lock.place, _said(lock))
    if lock.tag is None and not lock.lost:
        time.sleep(_SETTLE_S)
        _still_mine(lock)
    if lock.lost:
        raise SettingsError(f"Another vplog process has just begun to write to {root}. Wait for it to end.")


def _said(lock: Lock) -> bytes:
    """What the object says. The count makes every renewal another object, so that a tag tells one from the other."""
    return json.dumps({**lock.name, "renewed": lock.renewed}).encode()


def _is_mine(lock: Lock, found: bytes | None) -> bool:
    return found is not None and _holder(found).get("token") == lock.name["token"]


def _holder(found: bytes) -> dict[str, Any]:
    """Who a lock object says holds it; empty where nobody does."""
    try:
        holder = json.loads(found)
    except ValueError:
        return {}
    return holder if isinstance(holder, dict) else {}


def _write(lock: Lock, tag: str | None) -> None:
    """Where the lock has this tag. A refusal may be the echo of a write whose answer was lost, so it is read back."""
    lock.tag = objects.put_if(lock.place, _said(lock), tag)
    if lock.tag is None:
        found = objects.get_tagged(lock.place)
        if found is None or not _is_mine(lock, found[0]):
            lock.lost = f"Another writer has taken {lock.place} over."
        else:
            lock.tag = found[1]


def _still_mine(lock: Lock) -> None:
    if not _is_mine(lock, objects.get(lock.place)):
        lock.lost = f"Another writer has taken {lock.place} over."


def _refuse_held(found: bytes, age_s: float, root: RemotePath) -> None:
    """Raises SettingsError where the lock is somebody's who may be alive."""
    holder = _holder(found)
    if not holder.get("token") or age_s > LEASE_S:
        return
    known, pid = holder.get("started"), holder.get("pid")
    if holder.get("host") == _machine() and isinstance(pid, int) and known and _started(pid) != known:
        return
    raise SettingsError(
        f"Another vplog process is writing to {root} (process {pid} on {str(holder.get('host')).split(' ')[0]}). "
        f"Wait for it to end; if it was killed, its lock expires within {LEASE_S - max(age_s, 0.0):.0f} s."
    )


def _renew(lock: Lock) -> None:
    """Write it again, which makes the lock young, until it is over or somebody else's."""
    last = time.monotonic()
    while not lock.lost and not lock.over.wait(LEASE_S / RENEWALS):
        try:
            if lock.tag is None:
                _still_mine(lock)
            if lock.lost:
                break
            lock.renewed += 1
            if lock.tag is None:
                objects.put(lock.place, _said(lock))
            else:
                _write(lock, lock.tag)
            last = time.monotonic()
        except OSError as error:
            if time.monotonic() - last > LEASE_S:
                lock.lost = f"{lock.place} could not be renewed for {LEASE_S:.0f} s: {reason(error)}."


def _release(lock: Lock) -> None:
    """Nobody's. Where that fails the lease ends by itself."""
    with suppress(OSError):
        if lock.tag is not None:
            objects.put_if(lock.place, b"{}", lock.tag)
        elif _is_mine(lock, objects.get(lock.place)):
            objects.put(lock.place, b"{}")
