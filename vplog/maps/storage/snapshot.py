"""The manifest of a map on an object store: a snapshot names every file of the map, and one write makes it the newest.

    MAP/map.json                           names of the last snapshots, newest first: the one object that is replaced
    MAP/snapshots/VERSION-TOKEN.json.gz    settings, library, failures; drives with their files, lengths and sha256

A writer sends files, then a snapshot that names them, then map.json if it is still as it was read. Where another writer
was first, it reads the new snapshot, makes the same change to that, and tries again. So writers do not exclude each
other, and a reader has the map of one snapshot, whatever comes later.

A snapshot holds the drives that are not in its layers, at most two objects of the same kind that snapshots have in
common. So a change of a large map writes little, and its readers make four requests.
"""

from __future__ import annotations

import gzip
import json
import random
import secrets
import time
import zlib
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime
from hashlib import sha256
from pathlib import Path
from typing import Annotated, Any, NotRequired, cast

from pydantic import ConfigDict, Field, StrictInt, TypeAdapter, with_config
from typing_extensions import TypedDict  # as pydantic needs it below Python 3.12

from vplog.errors import ResultError, SettingsError
from vplog.maps.storage import objects
from vplog.maps.storage.damage import UnreachableError
from vplog.maps.storage.layout import FORMAT, Below
from vplog.storage.folders import is_below
from vplog.storage.json_records import has_checksum, parse_json, with_checksum
from vplog.storage.parquet_limits import check_version
from vplog.storage.remote_path import RemotePath, reason
from vplog.version import __version__

STORE_FORMAT, PACKED_FORMAT = FORMAT + 1, FORMAT + 2
"""Versions of this manifest, before and after `map compact`."""
LISTED = 100
"""Snapshots that map.json names, 200 bytes each."""
_TRIES, _PAUSE_S = 100, 0.02
"""Attempts of a commit, with a random pause of up to 2 s that doubles: each time one of the writers gets in."""
_MOST_BYTES = 1 << 31
"""Longest snapshot or layer, uncompressed: 700,000 drives at 3 kB."""
_LAYERED = ("drives", "rest")
"""Fields of which layers hold the most."""
_MOST_CHANGES = 64
"""Entries of a snapshot above its layers, 60 kB; with more it gets an upper layer of up to the square of that, 4 MB."""

Generation = Annotated[str, Field(pattern="^[0-9a-f]{16}$")]
Snapshot = dict[str, Any]
"""Fields as in `_Snapshot`, as plain values. What is in it is replaced, never changed."""


class LostRaceError(ResultError):
    """Another writer has changed the same part of the map."""


class _Packed(TypedDict):
    token: Annotated[str, Field(pattern="^[0-9a-f]{32}$")]
    """Name of the pack, MAP/packs/TOKEN."""
    section: tuple[StrictInt, StrictInt]
    """First byte of the zstd frame that the file is in, and the one behind it."""
    at: StrictInt
    """Where the file begins in what is in that frame."""


class _Pack(TypedDict):
    bytes: StrictInt
    sha256: str
    tag: str
    unpacked: StrictInt
    """Bytes of the files that it was made of."""


class _File(TypedDict):
    bytes: StrictInt
    sha256: Annotated[str, Field(pattern="^[0-9a-f]{64}$")]
    tag: str
    """ETag."""
    rows: NotRequired[StrictInt]
    pack: NotRequired[_Packed]
    """Where a small file of a drive is, if not in its folder."""


class _RestFile(_File):
    generation: Generation
    """Folder of a file beside drives, MAP/rest/GENERATION/NAME: a random name."""


@with_config(ConfigDict(extra="allow"))
class _Record(TypedDict):
    """The fields of drive.json that are relied on."""

    drive: str
    log: str
    key: str
    library: str
    inputs: dict[str, Any]


class _Drive(TypedDict):
    record: _Record
    generation: Generation
    """Its files are in MAP/runs/drive=ID/GENERATION, a random name that is never used twice."""
    files: dict[Below, _File]
    run: dict[str, Any]
    """Figures of its run.json."""
    packed: NotRequired[str]
    """When files of its folder were put into a pack, in UTC: from then on they are replaced."""


class _Layer(TypedDict):
    """Entries that differ from those of the layers below, by name; None: the entry is removed."""

    drives: dict[str, _Drive | None]
    rest: dict[Below, _RestFile | None]
    """All else that a map's folder has, as what joins its drives."""


class _Row(TypedDict):
    """An object of map.json or a snapshot."""

    object: str
    bytes: StrictInt
    sha256: str
    version: StrictInt
    time: str
    drives: StrictInt
    change: str


class _Snapshot(_Layer):
    library: str | None
    settings: dict[str, Any]
    libraries: dict[Below, dict[Below, _File]]
    failures: dict[str, dict[str, Any]]
    copies: dict[Below, Below | None]
    """Objects that are to be copied within the store, by the new name; None: that are to be removed."""
    replaced: dict[str, str]
    """When folders and files that earlier snapshots name were replaced, in UTC."""
    layers: list[_Row]
    """From the lowest on."""
    by_drive: NotRequired[bool]
    """False where Delta tables alone are the data sets: no table is copied to MAP/NAME/drive=ID any more."""
    packs: NotRequired[dict[str, _Pack]]
    """Those that files of drives are in, by token."""


_ROWS: TypeAdapter[Any] = TypeAdapter(list[_Row])
_LAYER, _SNAPSHOT = TypeAdapter(_Layer), TypeAdapter(_Snapshot)


def empty() -> Snapshot:
    """The snapshot of a map that is not there yet."""
    names = ("libraries", "drives", "failures", "rest", "copies", "replaced")
    return {"library": None, "settings": {}, **{name: {} for name in names}}


class Manifest:
    """The newest snapshot of a map as this process has read or written it last."""

    def __init__(self, remote: RemotePath, as_of: str | None = None) -> None:
        """With `as_of`, a version or a time, the snapshot that was the newest then, for reading. Raises ResultError
        where it is damaged, SettingsError where no snapshot is of then, NewerError, and UnreachableError."""
        self.remote, self.as_of = remote, as_of
        self.version: objects.Version | None = None
        """State of map.json; None where there is none."""
        self.log: list[dict[str, Any]] = []
        """The last snapshots, newest first."""
        self.now: Snapshot
        self.layers: list[tuple[dict[str, Any], dict[str, Any]]] = []
        """Name and content of those of the newest snapshot."""
        self.read()

    def read(self) -> None:
        """Read the newest snapshot. Raises as the constructor."""
        place = self.remote / "map.json"
        with store_errors(self.remote):
            found = objects.get_with_version(place)
            data, self.version = found or (b"", None)
            if found is None:
                self.log, self.now, self.layers = [], empty(), []
                return
            head = _json(data, place)
            check_version(cast("Path", place), head.get("format"), PACKED_FORMAT, head.get("vplog"))
            try:
                rows = _ROWS.validate_python(head.get("snapshots", []))
            except ValueError:
                raise _no_snapshot(place) from None
            if not rows:
                raise ResultError(f"{place} names no snapshot: it is damaged. Copy it back from a backup.")
            if self.as_of is not None:
                rows = rows[_row_as_of(rows, self.as_of, self.remote) :]
            if self.log[:1] != rows[:1]:
                top = self._object(rows[0], _SNAPSHOT)
                known = {row["object"]: layer for row, layer in self.layers}
                self.layers = [
                    (row, known.get(row["object"]) or self._object(row, _LAYER)) for row in top.pop("layers")
                ]
                self.now = top | _merged([*(layer for _, layer in self.layers), top])
            self.log = rows

    def _object(self, row: dict[str, Any], kind: TypeAdapter[Any]) -> dict[str, Any]:
        """A snapshot or a layer. Raises ResultError, and OSError."""
        place = self.remote / row["object"]
        data = objects.get(place) if is_below(row["object"]) else None
        if data is None and self.as_of is not None:
            raise ResultError(
                f"What {self.remote} was at {self.as_of} is removed: {place} is gone. Name a newer version."
            )
        if data is None or (len(data), sha256(data).hexdigest()) != (row["bytes"], row["sha256"]):
            raise ResultError(f"{place} is gone, or damaged. Copy it back from a backup.")
        try:
            found = kind.validate_json(zlib.decompressobj(31).decompress(data, _MOST_BYTES))
        except (ValueError, zlib.error):
            raise _no_snapshot(place) from None
        if any(entry is not None and entry["record"]["drive"] != drive for drive, entry in found["drives"].items()):
            raise _no_snapshot(place)
        return found

    def commit(self, what: str, change: Callable[[Snapshot], object]) -> None:
        """Make `change` to the newest snapshot; it is called again where another writer comes in between, and may raise
        ResultError. `what` is shown by `map log`. What changes nothing in the map as it was read last is not written.
        Raises ResultError."""
        for number in range(_TRIES):
            if number:
                time.sleep(random.uniform(0, min(_PAUSE_S * 2**number, 2)))
            wanted = {name: dict(part) if isinstance(part, dict) else part for name, part in self.now.items()}
            change(wanted)
            with store_errors(self.remote):
                if (wanted == self.now and self.version is not None) or self._write(what, wanted):
                    return
        raise ResultError(f"{self.remote} is written to by others without a pause. Run again.")

    def _write(self, what: str, wanted: Snapshot) -> bool:
        """Write a snapshot if no other writer came first; else read the newest. Returns whether it was written."""
        layers, drives = self.layers, len(wanted["drives"])
        changed = _difference(wanted, layers)
        if _entries(changed) > _MOST_CHANGES:
            layers, changed = layers[:1], _difference(wanted, layers[:1])
            if _entries(changed) > _MOST_CHANGES**2 or not layers:
                layers, changed = [], _difference(wanted, [])
            layers = [*layers, (self._send(changed, drives, "layer"), changed)]
            changed = _difference(wanted, layers)
        left = {row["object"] for row, _ in self.layers} - {row["object"] for row, _ in layers}
        wanted["replaced"] = wanted["replaced"] | dict.fromkeys(left, now())
        row = self._send({**wanted, **changed, "layers": [row for row, _ in layers]}, drives, what)
        rows = [row, *self.log][:LISTED]
        version = STORE_FORMAT if wanted.keys() <= empty().keys() else PACKED_FORMAT
        head = with_checksum({"format": version, "vplog": __version__, "snapshots": rows})
        written = objects.put_if(self.remote / "map.json", json.dumps(head, indent=1).encode(), self.version)
        if written is not None:
            self.version, self.log, self.now, self.layers = written, rows, wanted, layers
            return True
        self.read()
        if row in self.log:  # the response was lost, and this is a repetition
            return True
        (self.remote / row["object"]).ask("delete")
        return False

    def _send(self, content: dict[str, Any], drives: int, what: str) -> dict[str, Any]:
        """Write a snapshot or a layer; its row."""
        number = self.log[0]["version"] + 1 if self.log else 1
        data = gzip.compress(json.dumps(content, ensure_ascii=False, allow_nan=False).encode(), 1, mtime=0)
        row = {
            "version": number, "object": f"snapshots/{number:08d}-{secrets.token_hex(8)}.json.gz", "bytes": len(data),
            "sha256": sha256(data).hexdigest(), "time": now(), "drives": drives, "change": what[:200],
        }  # fmt: skip
        objects.put_if(self.remote / row["object"], data, None)
        return row


def _merged(layers: Sequence[dict[str, Any]]) -> dict[str, dict[str, Any]]:
    """Entries of all layers together, by name; those of later layers replace those of earlier ones."""
    found: dict[str, dict[str, Any]] = {}
    for name in _LAYERED:
        every: dict[str, Any] = {}
        for layer in layers:
            every |= layer[name]
        found[name] = {key: entry for key, entry in every.items() if entry is not None}
    return found


def _difference(wanted: Snapshot, layers: Sequence[tuple[Any, dict[str, Any]]]) -> dict[str, dict[str, Any]]:
    """The layer that is missing above others."""
    below = _merged([layer for _, layer in layers])
    return {
        name: {key: entry for key, entry in wanted[name].items() if below[name].get(key) != entry}
        | dict.fromkeys(below[name].keys() - wanted[name].keys())
        for name in _LAYERED
    }


def _row_as_of(rows: Sequence[dict[str, Any]], as_of: str, remote: RemotePath) -> int:
    """Number of the snapshot of this version, or of the newest that is not younger than a time (UTC, unless it says
    otherwise). Raises SettingsError."""
    try:
        then = None if as_of.isdecimal() else datetime.fromisoformat(as_of)
    except ValueError:
        raise SettingsError(
            f"--as-of {as_of} is no version and no time. Write it as 12, or as 2026-01-31T12:00:00."
        ) from None
    for number, row in enumerate(rows):
        made = datetime.fromisoformat(row["time"])
        if (
            str(row["version"]) == as_of
            if then is None
            else made <= (then if then.tzinfo else then.replace(tzinfo=UTC))
        ):
            return number
    known = f"versions {rows[-1]['version']} of {rows[-1]['time']} to {rows[0]['version']} of {rows[0]['time']}"
    raise SettingsError(f"{remote} has no snapshot as of {as_of}, but {known}: vplog map log {remote}")


def _entries(layer: dict[str, dict[str, Any]]) -> int:
    return sum(len(layer[name]) for name in _LAYERED)


def now() -> str:
    """The time in UTC, to the second."""
    return datetime.now(UTC).isoformat(timespec="seconds")


@contextmanager
def store_errors(remote: RemotePath) -> Iterator[None]:
    """Raises UnreachableError where a store refuses."""
    try:
        yield
    except OSError as error:
        raise UnreachableError(f"Cannot read or write {remote}: {reason(error)}.") from None


def _json(data: bytes, place: RemotePath) -> dict[str, Any]:
    try:
        record = parse_json(data)
        sound = isinstance(record, dict) and has_checksum(record)
    except (ValueError, RecursionError):
        sound, record = False, {}
    if not sound:
        raise ResultError(f"{place} is damaged. Copy it back from a backup.")
    return record


def _no_snapshot(place: RemotePath) -> ResultError:
    return ResultError(f"{place} is no snapshot of vplog. Copy it back from a backup.")
