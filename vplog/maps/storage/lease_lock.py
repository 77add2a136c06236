"""One writer at a time on an object store: a lock object with a lease, which its holder renews.

The store itself decides who gets it, by conditional writes, so two can never hold it; a store that has none is refused.
Ages are by the store's clock alone. Nothing in a map breaks where two do write: see remote_map.py.
"""

from __future__ import annotations

import json
import os
import secrets
import socket
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from vplog.errors import ResultError, SettingsError
from vplog.maps.storage import objects
from vplog.storage.remote_path import RemotePath, reason

NAME = ".lock"
LEASE_S = 120.0
"""A holder that has not renewed for so long is taken as gone. Long enough for a network that fails for a minute, short
enough to wait for after a kill on another machine."""
RENEWALS = 6
"""Renewals within a lease: five may fail in a row."""


@dataclass
class Lock:
    """A lock that is held."""

    place: RemotePath
    name: dict[str, Any]
    """Identity of the holder, as the object has it."""
    renewed: int = 0
    lost: str = ""
    """Why it is not held any more."""
    version: objects.Version | None = None
    """Of the object as it was last written."""
    released: threading.Event = field(default_factory=threading.Event)

    def check(self) -> None:
        """Raises ResultError where another writer has taken the lock over."""
        if self.lost:
            raise ResultError(f"{self.lost} What was finished is in the map. Run again to go on.")


@contextmanager
def held(root: RemotePath) -> Iterator[Lock]:
    """The lock of a map. Raises SettingsError where another writer holds it, or where nothing can be written."""
    place = root / NAME
    # this process, so that on its own machine it is known to have ended without waiting for its lease
    process = {"host": _machine(), "pid": os.getpid(), "started": _started(os.getpid())}
    lock = Lock(place, {"token": secrets.token_hex(8), **process})
    try:
        _acquire(lock, root)
    except OSError as error:
        raise SettingsError(f"Cannot write to {root}: {reason(error)}. Choose another place with -o.") from None
    renewing = threading.Thread(target=_renew, args=(lock,), daemon=True)
    renewing.start()
    try:
        yield lock
    finally:
        lock.released.set()
        renewing.join()
        if not lock.lost:
            _release(lock)


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


def _acquire(lock: Lock, root: RemotePath) -> None:
    found = objects.get_with_version(lock.place)
    if found is not None:
        _check_expired(found, root)
    data = _content(lock)
    lock.version = objects.put_if(lock.place, data, None if found is None else found.version) or _read_back(lock)
    if not lock.lost and objects.put_if(lock.place, data, None) is not None:  # it exists, so this is to be refused
        objects.remove(lock.place)
        raise SettingsError(
            f"Cannot write to {root}: its store has no conditional writes, by which one writer at a time is sure. "
            "Write to a folder or another store."
        )
    if lock.lost:
        raise SettingsError(f"Another vplog process has just begun to write to {root}. Wait for it to end.")


def _content(lock: Lock) -> bytes:
    """Bytes of the lock object. The count gives every renewal another ETag."""
    return json.dumps({**lock.name, "renewed": lock.renewed}).encode()


def _holder(found: bytes) -> dict[str, Any]:
    """The holder that a lock object names; empty where there is none."""
    try:
        holder = json.loads(found)
    except (ValueError, RecursionError):
        return {}
    return holder if isinstance(holder, dict) else {}


def _write(lock: Lock, data: bytes) -> None:
    """Write the lock while it is held. A refusal is read back: it may follow a write whose response was lost."""
    lock.version = objects.put_if(lock.place, data, lock.version) or _read_back(lock)


def _read_back(lock: Lock) -> objects.Version | None:
    """Read the lock back: its version. It is lost where another writer's name is in it."""
    found = objects.get_with_version(lock.place)
    if found is None or _holder(found.data).get("token") != lock.name["token"]:
        lock.lost = f"Another writer has taken {lock.place} over."
        return None
    return found.version


def _check_expired(found: objects.Versioned, root: RemotePath) -> None:
    """Raises SettingsError where the lock is held by a process that may be alive."""
    holder = _holder(found.data)
    known, pid = holder.get("started"), holder.get("pid")
    if not holder.get("token"):
        return
    if holder.get("host") == _machine() and isinstance(pid, int) and known and _started(pid) != known:
        return
    now = objects.server_time(root / f"{NAME}-{secrets.token_hex(8)}")
    if (left_s := LEASE_S - (now - found.written).total_seconds()) < 0:
        return
    raise SettingsError(
        f"Another vplog process is writing to {root} (process {pid} on {str(holder.get('host')).split(' ')[0]}). "
        f"Wait for it to end; if it was killed, its lock expires within {min(left_s, LEASE_S):.0f} s."
    )


def _renew(lock: Lock) -> None:
    last = time.monotonic()
    while not lock.lost and not lock.released.wait(LEASE_S / RENEWALS):
        lock.renewed += 1
        try:
            _write(lock, _content(lock))
            last = time.monotonic()
        except OSError as error:
            if time.monotonic() - last > LEASE_S:
                lock.lost = f"{lock.place} could not be renewed for {LEASE_S:.0f} s: {reason(error)}."


def _release(lock: Lock) -> None:
    """Leave the lock without a holder. Where that fails the lease ends by itself."""
    with suppress(OSError):
        _write(lock, b"{}")
