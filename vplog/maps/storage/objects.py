"""Objects of a store by URL (s3://, gs://, az://): each appears whole or not at all, and none is changed in place."""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import TYPE_CHECKING, cast

from vplog.maps.storage.layout import sha256_of
from vplog.storage import remote_path
from vplog.storage.object_store import plain_errors
from vplog.storage.remote_path import RemotePath

if TYPE_CHECKING:
    from obstore import ObjectMeta, PutResult, UpdateVersion

_BLOCK_BYTES = 1 << 20
"""Bytes copied from the store at once."""
AT_ONCE = 16
"""Requests at once: a store answers each in some 20 to 50 ms, whatever its size."""
Version = dict[str, str]
"""State of an object: its ETag, on gs:// its generation."""


def put_if(path: RemotePath, data: bytes, version: Version | None) -> Version | None:
    """Write an object where it is in this state, or where there is none yet (None); its new version, or None where that
    is not so. The store decides, so that of several writers one wins; one without conditional writes raises, or writes
    in any case. Raises OSError."""
    from obstore.exceptions import AlreadyExistsError, PreconditionError

    store, name = path.place
    with suppress(FileNotFoundError), plain_errors(), suppress(AlreadyExistsError, PreconditionError):
        return _version(store.put(name, data, mode="create" if version is None else cast("UpdateVersion", version)))
    return None


def _version(about: ObjectMeta | PutResult) -> Version:
    return {key: value for key in ("e_tag", "version") if (value := about[key])}


def get(path: RemotePath) -> bytes | None:
    """The bytes of an object, None where there is none. Raises OSError."""
    found = get_with_version(path)
    return found and found[0]


def get_with_version(path: RemotePath) -> tuple[bytes, Version] | None:
    """An object and its state, of one moment also while it is replaced; None where there is none. Raises OSError."""
    with suppress(FileNotFoundError), plain_errors():
        found = path.ask("get")
        return bytes(found.bytes()), _version(found.meta)
    return None


def send(path: RemotePath, source: Path) -> tuple[str, PutResult]:
    """A local file as an object; sha256 of what was sent, and the store's answer. Raises OSError."""
    return sha256_of(source), remote_path.send(path, source)


def fetch(path: RemotePath, target: Path, most: int) -> str:
    """An object as a local file; sha256 of what came, of which no block behind `most` bytes is read. Raises OSError."""
    digest, count = hashlib.sha256(), 0
    with plain_errors(), target.open("wb") as stream:
        for block in path.ask("get").stream(min_chunk_size=_BLOCK_BYTES):
            count += len(block)
            digest.update(block)
            stream.write(block)
            if count > most:
                break
    return digest.hexdigest()


def copy(source: RemotePath, target: RemotePath) -> None:
    """Copy an object within the store. Raises OSError."""
    source.ask("copy", target.place[1])


def remove(path: RemotePath) -> None:
    """An object and all with this prefix; nothing where there is none. Raises OSError."""
    delete(path, remote_path.objects_below(path))
    store, name = path.place
    with suppress(FileNotFoundError), plain_errors():  # S3 says nothing of what is not there
        store.delete([name])


def delete(path: RemotePath, names: Iterable[str]) -> None:
    """Objects with this prefix, which are there, by their names behind it, a thousand a request on S3. Raises
    OSError."""
    store, name = path.place
    with suppress(FileNotFoundError), plain_errors():  # another removes them, too
        store.delete([f"{name}/{below}".lstrip("/") for below in names])
