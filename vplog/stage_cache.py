"""What the stages of a run came to, kept beside it: each result a file, found again by all that it was made from.

A file is named by its stage and the sha256 over what it depends on: the results and settings that went in, the code
that made it and the packages which that uses. It is written beside and renamed, and holds length and checksum of its
content: what is found is whole, or is made anew with a warning. One folder is for one drive.
"""

from __future__ import annotations

import hashlib
import json
from dataclasses import dataclass, fields, is_dataclass
from typing import TYPE_CHECKING, Any, Self, TypeVar

import numpy as np

from vplog.cache_file import (
    CACHE_FILES,
    CONTENT_AT,
    ENDING,
    INPUTS,
    AbsentError,
    DamagedError,
    content_of,
    file_name,
    sealed,
)
from vplog.code_hash import code_of
from vplog.errors import ResultError
from vplog.inputs import hash_inputs, look_of
from vplog.results.atomic import replacing
from vplog.results.run_record import canonical_json, write_run_json

if TYPE_CHECKING:
    from collections.abc import Callable, Iterable, Sequence
    from pathlib import Path

    from vplog.settings import Settings
    from vplog.stage_codecs import Codec
    from vplog.timing import Watch

T = TypeVar("T")

_INPUTS_BYTES = 2**26
"""Longest inputs.json that is read: a folder of 400,000 images has one of 60 MB."""


@dataclass(frozen=True)
class Inputs:
    """Which files a drive is."""

    look: dict[str, str]
    """Lengths and times, by full path."""
    token: str
    """Stands for the content in the keys of all that is made from it."""
    hashes: dict[str, str] | None
    """sha256 by name, where known."""

    @property
    def lengths(self) -> str:
        """sha256 over the lengths of the files: copies on other machines have other times."""
        return key_of(_lengths(self.look))


def key_of(made_from: Any) -> str:
    """sha256 over all that a result depends on, a tree of plain values."""
    return hashlib.sha256(canonical_json(made_from).encode()).hexdigest()


def digest_of(value: Any) -> str:
    """sha256 over a value: of a dataclass all its fields, of an array type, shape and bytes."""
    digest = hashlib.sha256()
    if is_dataclass(value):
        for field in fields(value):
            digest.update(f"{field.name} {digest_of(getattr(value, field.name))}\n".encode())
    elif isinstance(value, np.ndarray):
        digest.update(f"{value.dtype.str} {value.shape}\n".encode() + np.ascontiguousarray(value).tobytes())
    else:
        digest.update(canonical_json(value).encode())
    return digest.hexdigest()


def inputs_of(drive: Path | Sequence[Path], cache: Path | None) -> Inputs:
    """The files of a drive; their content has the name that the cache knows it by, if it does.

    It does where length and times are the same, and where they are not but the sha256 is: then the files are read.
    """
    look = look_of(drive)
    known = {} if cache is None else _known_inputs(cache)
    hashes = known.get("hashes")
    if known.get("look") == look:
        return Inputs(look, known["token"], hashes)
    if hashes and _lengths(known["look"]) == _lengths(look):
        found = hash_inputs(drive)
        return Inputs(look, known["token"] if found == hashes else key_of(look), found)
    return Inputs(look, key_of(look), None)


def _lengths(look: dict[str, str]) -> list[str]:
    return sorted(text.partition(",")[0] for text in look.values())


def _known_inputs(cache: Path) -> dict[str, Any]:
    """inputs.json of a cache; empty where there is none, or another thing."""
    path = cache / INPUTS
    try:
        if path.stat().st_size > _INPUTS_BYTES:
            return {}
        known = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, ValueError, RecursionError):
        return {}

    def texts(value: Any) -> bool:
        return isinstance(value, dict) and all(isinstance(text, str) for text in value.values())

    sound = isinstance(known, dict) and texts(known.get("look")) and isinstance(known.get("token"), str)
    return known if sound and (known.get("hashes") is None or texts(known["hashes"])) else {}


class StageCache:
    """The results of one drive's stages, those of this run and those found."""

    def __init__(self, folder: Path, watch: Watch, warnings: list[str], keep: bool = True) -> None:
        """`watch` measures the stages; `warnings` are those of the run.

        What a stage adds to the warnings is told again when its result is found. Without `keep` nothing is found, and
        what has to be written is gone when the block ends. Raises ResultError where the folder cannot be made.
        """
        self.folder, self.watch, self.keep = folder, watch, keep
        self.digests: dict[str, str] = {}
        """What stages are made from, by name: sha256 of the results of those before, and of what else was read."""
        self.told: dict[str, dict[str, Any]] = {}
        """Of each stage whether its result was `computed` or `reused`."""
        self._warnings, self._used, self._full = warnings, set[str](), False
        try:
            folder.mkdir(parents=True, exist_ok=True)
        except OSError as error:
            raise ResultError(f"Cannot make the folder {folder}: {error.strerror}. Choose another with -o.") from None
        if not keep:
            self._remove(set())

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        if not self.keep or not any(self.folder.glob(f"*{ENDING}")):  # nothing came of the run: no log, no odometry
            self.drop()

    def saw(self, **made_from: Any) -> None:
        """What stages are made from that no stage has made: plain values, arrays, dataclasses of them."""
        self.digests |= {name: digest_of(value) for name, value in made_from.items()}

    def stage(
        self,
        name: str,
        of: Iterable[str],
        settings: Iterable[Settings],
        code: Iterable[str],
        codec: Codec[T],
        compute: Callable[[], T],
        items: int | None = None,
    ) -> T:
        """`result`, measured as a stage of the run that works off so many `items`."""
        with self.watch.stage(name, items):
            return self.result(name, of, settings, code, codec, compute)

    def result(
        self,
        name: str,
        of: Iterable[str],
        settings: Iterable[Settings],
        code: Iterable[str],
        codec: Codec[T],
        compute: Callable[[], T],
    ) -> T:
        """What a stage comes to: found where it was computed before from the same, computed else.

        `of` names the results it is made from, `settings` are those that it uses, `code` the modules that compute it.
        """
        made_from = {
            "stage": name,
            "of": {one: self.digests[one] for one in of},
            "settings": [one.model_dump(mode="json") for one in settings],
            **code_of("vplog.stage_codecs", *code),
        }
        key = key_of(made_from)
        if self.keep:
            try:
                value = self._found(name, key, codec)
                self.told[name] = {"result": "reused"}
                return value
            except AbsentError:
                pass
        said = len(self._warnings)
        value = compute()
        self.told[name] = {"result": "computed"}
        if self.keep:
            self.digests[name] = self._keep(name, key, self._warnings[said:], codec.to_bytes(value))
        else:
            self.digests[name] = key
        return value

    def tell(self, name: str, parts: int, reused: int) -> None:
        """Of a stage in parts, how many of them were found."""
        result = "computed" if not reused else "reused" if reused == parts else "partly reused"
        self.told[name] = {"result": result, "parts": parts, "parts_reused": reused}

    def _found(self, name: str, key: str, codec: Codec[T]) -> T:
        path = self.folder / file_name(name, key)
        try:
            data = path.read_bytes()
            head, _, content = content_of(data, key).tobytes().partition(b"\n")
            said, value = json.loads(head), codec.from_bytes(content)
            if not isinstance(said, list):
                raise DamagedError("it holds another type of result")
        except FileNotFoundError:
            raise AbsentError from None
        except Exception as error:  # whatever bytes do to a reader
            self.damaged(path, error)
            raise AbsentError from None
        self._warnings += map(str, said)
        self._used.add(path.name)
        self.digests[name] = hashlib.sha256(data[CONTENT_AT:]).hexdigest()
        return value

    def _keep(self, name: str, key: str, said: list[str], content: bytes) -> str:
        """Write a result, as long as the disk takes it; its sha256."""
        content = json.dumps(said).encode() + b"\n" + content
        if not self._full:
            try:
                self.put(file_name(name, key), sealed(key, content))
            except ResultError as error:
                self._full = True
                self._warnings.append(f"Results of stages are not cached for later runs. {error}")
        return hashlib.sha256(content).hexdigest()

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
        self._warnings.append(f"{path.name} in {self.folder} is not used, its stage runs again: {reason}.")

    def know_inputs(self, drive: Path | Sequence[Path], inputs: Inputs) -> dict[str, str]:
        """sha256 of the files of the drive, which are read unless it is known; a later run then knows it.

        Not if they change meanwhile: what is made from them may be of what they were before.
        """
        hashes = hash_inputs(drive) if inputs.hashes is None else inputs.hashes
        if self.keep and look_of(drive) == inputs.look:
            known = _known_inputs(self.folder)
            known = known if known.get("token") == inputs.token else {}
            self._write_inputs({**known, "look": inputs.look, "token": inputs.token, "hashes": hashes})
        return hashes

    def account(self) -> dict[str, Any]:
        """Of every stage so far what it took, and whether its result was `computed` or `reused`."""
        return {name: {"result": "computed", **self.told.get(name, {}), **it} for name, it in self.watch.stages.items()}

    def finish(self, drive: Path | Sequence[Path], inputs: Inputs, parts: Sequence[str]) -> None:
        """The run is done: remove what it did not use. `parts` are the files of its features, in order."""
        if look_of(drive) != inputs.look:
            self._warnings.append("The log changed while it was read, so nothing is cached for later runs.")
            self._remove(set())
        if not self.keep or look_of(drive) != inputs.look:
            return
        known = {"look": inputs.look, "token": inputs.token, "hashes": inputs.hashes, **_known_inputs(self.folder)}
        self._write_inputs({**known, "parts": list(parts)})
        self._remove({*self._used, INPUTS})

    def drop(self) -> None:
        """Remove all of the cache, and its folder if nothing else is in it."""
        self._remove(set())
        if self.folder.is_dir() and not any(self.folder.iterdir()):
            self.folder.rmdir()

    def _write_inputs(self, known: dict[str, Any]) -> None:
        try:
            write_run_json(self.folder / INPUTS, known)
        except ResultError:  # it only spares work; the result's own files say that the disk is full
            self._full = True

    def _remove(self, kept: set[str]) -> None:
        """Remove the cache's own files but these."""
        for file in [file for pattern in CACHE_FILES for file in self.folder.glob(pattern)]:
            if file.name not in kept:
                file.unlink(missing_ok=True)


def finished_parts(cache: Path) -> list[str]:
    """Names of the files of a finished run's features, in order; none where no run was finished."""
    parts = _known_inputs(cache).get("parts")
    return [str(name) for name in parts if "/" not in str(name)] if isinstance(parts, list) else []
