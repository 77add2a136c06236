"""Cache of a run's stages: each result is a file, found again by the hash of all that it was made from.

A file is named by its stage and the sha256 over what it depends on: the results and settings that went in, the code
that made it and the packages which that uses. It is written beside and renamed, and holds length and checksum of its
content: what is found is whole, or is computed again with a warning. One folder is for one drive.
"""

from __future__ import annotations

import hashlib
import io
import json
import struct
import zlib
from collections.abc import Sequence
from concurrent.futures import CancelledError, ThreadPoolExecutor
from dataclasses import dataclass, fields, is_dataclass
from pathlib import Path
from threading import Event
from typing import TYPE_CHECKING, Any, BinaryIO, Self, TypeVar

import numpy as np

from vplog.errors import ResultError
from vplog.execution.run_warnings import warn
from vplog.results.run_record import read_run_json, write_run_json
from vplog.settings import Settings
from vplog.storage.input_hashes import hash_inputs, stat_signature
from vplog.storage.json_records import canonical_json, key_of
from vplog.storage.scratch import replacing

if TYPE_CHECKING:
    from vplog.run.cache.codecs import Codec

T = TypeVar("T")

_MAGIC = b"VPLOGST1"
_HEAD = struct.Struct("<8s32sQI")
"""Magic with the version of the format, key, bytes that follow, their CRC-32: it is there against damage, and is summed
up at 2.8 GB/s where sha256 takes eight times as long."""
ENDING = ".stage"
"""Suffix of the files of a cache: what else is in its folder is not touched."""
INPUTS = "inputs.json"
"""Name of the file with the identity and hashes of the log that a cache is of."""
CACHE_FILES = (f"*{ENDING}", ".*.part", INPUTS)
"""Glob patterns of all files of a cache; the parts are what a killed run was writing."""
_BLOCK_BYTES = 2**20
"""Read at once of a file that is only checked."""
CONTENT_AT = _HEAD.size
"""Offset of the content of a file."""
_INPUTS_BYTES = 2**26
"""Longest inputs.json that is read: a folder of 400,000 images has one of 60 MB."""


class DamagedError(Exception):
    """A file of the cache does not have the content that its name stands for. Never leaves the cache."""


class AbsentError(Exception):
    """There is no such file in the cache."""


def file_name(stage: str, key: str) -> str:
    """Name of a file of the cache: the first 128 bits of the key are unique; the whole key is in the file."""
    return f"{stage}-{key[:32]}{ENDING}"


def sealed(key: str, content: bytes) -> bytes:
    """A file of the cache: header with key, length and checksum, then the content."""
    return _HEAD.pack(_MAGIC, bytes.fromhex(key), len(content), zlib.crc32(content)) + content


def content_of(data: bytes, key: str) -> memoryview:
    """The content of a file of the cache. Raises DamagedError where that is not what is there."""
    _check(io.BytesIO(data), len(data), key)
    return memoryview(data)[CONTENT_AT:]


def check_file(path: Path, key: str | None = None) -> None:
    """Read a file through, of any key where None is given, a block at a time.

    Raises DamagedError where it is not whole, and AbsentError where there is none.
    """
    try:
        with path.open("rb") as stream:
            _check(stream, path.stat().st_size, key)
    except FileNotFoundError:
        raise AbsentError from None
    except OSError as error:
        raise DamagedError(error.strerror or str(error)) from None


def _check(stream: BinaryIO, length: int, key: str | None) -> None:
    head, total = stream.read(_HEAD.size), 0
    if len(head) < _HEAD.size or not head.startswith(_MAGIC):
        raise DamagedError("another version wrote it")
    _, own, held, checksum = _HEAD.unpack(head)
    if key is not None and own != bytes.fromhex(key):
        raise DamagedError("it belongs to another result")
    if held != length - _HEAD.size:
        raise DamagedError(f"it holds {length - _HEAD.size} bytes instead of {held}")
    while block := stream.read(_BLOCK_BYTES):
        total = zlib.crc32(block, total)
    if total != checksum:
        raise DamagedError("its checksum does not match")


@dataclass(frozen=True)
class Inputs:
    """Identity of the files of a drive."""

    signature: dict[str, str]
    """Lengths and times, by full path."""
    token: str
    """Stands for the content in the keys of all that is made from it."""
    hashes: dict[str, str] | None
    """sha256 by name, where known."""

    @property
    def lengths(self) -> str:
        """sha256 over the lengths of the files: copies on other machines have other times."""
        return key_of(_lengths(self.signature))


def digest_of(value: Any) -> str:
    """sha256 over a value: of settings and dataclasses all fields, of arrays type, shape and bytes, of a recogniser's
    state its hash, of stored features their token."""
    digest = hashlib.sha256()
    if isinstance(stands_for := getattr(value, "token", getattr(value, "hash", None)), str):
        digest.update(stands_for.encode())
    elif is_dataclass(value):
        for field in fields(value):
            digest.update(f"{field.name} {digest_of(getattr(value, field.name))}\n".encode())
    elif isinstance(value, np.ndarray):
        digest.update(f"{value.dtype.str} {value.shape}\n".encode() + np.ascontiguousarray(value).tobytes())
    elif isinstance(value, list | tuple):
        digest.update("".join(map(digest_of, value)).encode())
    else:
        digest.update(canonical_json(value.model_dump(mode="json") if isinstance(value, Settings) else value).encode())
    return digest.hexdigest()


def inputs_of(drive: Path | Sequence[Path], cache: Path | None) -> Inputs:
    """The files of a drive; their content has the name that the cache knows it by, if it does.

    It does where length and times are the same, and where they are not but the sha256 is: then the files are read.
    """
    signature = stat_signature(drive)
    known = {} if cache is None else _read_inputs(cache)
    hashes = known.get("hashes")
    if known.get("look") == signature:
        return Inputs(signature, known["token"], hashes)
    if hashes and _lengths(known["look"]) == _lengths(signature):
        found = hash_inputs(drive)
        return Inputs(signature, known["token"] if found == hashes else key_of(signature), found)
    return Inputs(signature, key_of(signature), None)


def _lengths(signature: dict[str, str]) -> list[str]:
    return sorted(text.partition(",")[0] for text in signature.values())


def _read_inputs(cache: Path) -> dict[str, Any]:
    """inputs.json of a cache; empty where there is none, or another thing."""
    path = cache / INPUTS
    try:
        known = read_run_json(path) if path.stat().st_size <= _INPUTS_BYTES else {}
    except (OSError, ResultError):
        return {}

    def texts(value: Any) -> bool:
        return isinstance(value, dict) and all(isinstance(text, str) for text in value.values())

    sound = texts(known.get("look")) and isinstance(known.get("token"), str)
    return known if sound and (known.get("hashes") is None or texts(known["hashes"])) else {}


class StageCache:
    """The results of one drive's stages, those of this run and those found."""

    def __init__(self, folder: Path, drive: Path | Sequence[Path], keep: bool = True) -> None:
        """Without `keep` nothing is found, and what has to be written is gone when the block ends. Raises ResultError
        if the folder cannot be made."""
        self.folder, self.keep, self.drive = folder, keep, drive
        self.problems: list[str] = []
        """Warnings about the cache itself. They are not cached with the result of a stage."""
        self._used, self._disk_full = set[str](), False
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ResultError(f"Cannot make the folder {folder}: {error.strerror}. Choose another with -o.") from None
        if not keep:
            self._remove(set())

    def __enter__(self) -> Self:
        """Begin to read the drive's files for their hashes, beside the stages."""
        self.inputs = inputs_of(self.drive, self.folder)
        self._aside, self._stop = ThreadPoolExecutor(1), Event()
        self._hashes = self._aside.submit(self._hash_inputs)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        if kind is not None:  # a log of hundreds of GB is not read to its end for a run that has failed
            self._stop.set()
        self._aside.shutdown()
        if not self.keep or not any(self.folder.glob(f"*{ENDING}")):  # nothing came of the run: no log, no odometry
            self.drop()

    def hashes(self) -> dict[str, str]:
        """sha256 of the files of the drive, by name."""
        return self._hashes.result()

    def find(self, name: str, key: str, codec: Codec[T]) -> T:
        """Return a result that an earlier run stored, and repeat its warnings. Raises AbsentError if there is none that
        is whole."""
        if not self.keep:
            raise AbsentError
        path = self.folder / file_name(name, key)
        try:
            head, _, content = content_of(path.read_bytes(), key).tobytes().partition(b"\n")
            warnings, value = json.loads(head), codec.from_bytes(content)
            if not isinstance(warnings, list):
                raise DamagedError("it holds something else")
        except FileNotFoundError:
            raise AbsentError from None
        except Exception as error:  # whatever bytes do to a reader
            self.damaged(path, error)
            raise AbsentError from None
        for warning in warnings:
            warn(str(warning))
        self._used.add(path.name)
        return value

    def store(self, name: str, key: str, warnings: list[str], content: bytes) -> None:
        """Write a result with the warnings that came with it, as long as the disk takes it."""
        if not self.keep or self._disk_full:
            return
        try:
            self.put(file_name(name, key), sealed(key, json.dumps(warnings).encode() + b"\n" + content))
        except ResultError as error:
            self._disk_full = True
            self.problems.append(f"The results of the stages are not cached for another run. {error}")

    def put(self, name: str, data: bytes) -> Path:
        """Write a file as a whole. Raises ResultError."""
        with replacing(self.folder / name) as stream:
            stream.write(data)
        self._used.add(name)
        return self.folder / name

    def use(self, name: str) -> None:
        """This run needs the file, which was there."""
        self._used.add(name)

    def damaged(self, path: Path, error: Exception) -> None:
        """Say that a file was found damaged and is not used."""
        reason = " ".join(str(error).split())[:200] or type(error).__name__
        self.problems.append(f"{path.name} in {self.folder} is not used, its stage runs again: {reason}.")

    def _hash_inputs(self) -> dict[str, str]:
        """sha256 of the files of the drive, which are read unless it is known; a later run then knows it.

        Not if they change meanwhile: what is made from them may be of what they were before.
        """

        def check(_: int) -> None:
            if self._stop.is_set():
                raise CancelledError

        inputs = self.inputs
        hashes = hash_inputs(self.drive, check) if inputs.hashes is None else inputs.hashes
        if self.keep and stat_signature(self.drive) == inputs.signature:
            known = _read_inputs(self.folder)
            known = known if known.get("token") == inputs.token else {}
            self._write_inputs({**known, "look": inputs.signature, "token": inputs.token, "hashes": hashes})
        return hashes

    def finish(self, parts: Sequence[Sequence[str]]) -> None:
        """The run is done: remove what it did not use. `parts` are the files of the features of each camera, in
        order."""
        self.hashes()
        inputs, changed = self.inputs, stat_signature(self.drive) != self.inputs.signature
        if changed:
            self.problems.append("The log changed while it was read, so nothing is cached for another run.")
            self.keep = False
        if self.keep:
            known = {
                "look": inputs.signature,
                "token": inputs.token,
                "hashes": inputs.hashes,
                **_read_inputs(self.folder),
            }
            self._write_inputs({**known, "parts": list(map(list, parts))})
            self._remove({*self._used, INPUTS})

    def drop(self) -> None:
        """Remove all of the cache, and its folder if nothing else is in it."""
        self._remove(set())
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()

    def _write_inputs(self, known: dict[str, Any]) -> None:
        try:
            write_run_json(self.folder / INPUTS, known)
        except ResultError:  # it only spares work; that the disk is full is raised with the result's own files
            self._disk_full = True

    def _remove(self, retained: set[str]) -> None:
        for file in [file for pattern in CACHE_FILES for file in self.folder.glob(pattern)]:
            if file.name not in retained:
                file.unlink(missing_ok=True)


def finished_parts(cache: Path, camera: int) -> list[str]:
    """Names of the files of the features of a finished run's camera, in order; none where no run was finished."""
    parts = _read_inputs(cache).get("parts")
    own = parts[camera] if isinstance(parts, list) and camera < len(parts) else []
    return [str(name) for name in own if "/" not in str(name)] if isinstance(own, list) else []
