"""Objects of a store by URL (s3://, gs://): each appears whole or not at all, and none is changed in place.

pyarrow reads and writes, boto3 adds conditional writes: both find credentials in the files of AWS's own tools, which
obstore 0.12 does not read.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from email.utils import parsedate_to_datetime
from functools import lru_cache
from importlib.util import find_spec
from pathlib import Path
from typing import Any

from vplog.storage.remote_path import RemotePath, s3_place

_BLOCK_BYTES = 1 << 20
"""Bytes copied to or from the store at once."""
_TRIES = 5
"""A manifest is replaced once by a writer, and read in some 20 ms."""


def put(path: RemotePath, data: bytes) -> None:
    """Raises OSError."""
    system, place = path.place
    with system.open_output_stream(place) as stream:
        stream.write(data)


def get(path: RemotePath) -> bytes | None:
    """The bytes of an object, None where there is none. Raises OSError."""
    found = get_with_etag(path)
    return None if found is None else found[0]


def send(path: RemotePath, source: Path) -> str:
    """A local file as an object; sha256 of what was sent. Raises OSError."""
    system, place = path.place
    digest = hashlib.sha256()
    with source.open("rb") as whole, system.open_output_stream(place) as stream:
        while block := whole.read(_BLOCK_BYTES):
            digest.update(block)
            stream.write(block)
    return digest.hexdigest()


def fetch(path: RemotePath, target: Path, most: int) -> str:
    """An object as a local file; sha256 of what came, of which no block behind `most` bytes is read. Raises OSError."""
    digest, count = hashlib.sha256(), 0
    with _opened(path) as whole, target.open("wb") as stream:
        while block := whole.read(_BLOCK_BYTES):
            count += len(block)
            digest.update(block)
            stream.write(block)
            if count > most:
                break
    return digest.hexdigest()


@contextmanager
def _opened(path: RemotePath) -> Iterator[Any]:
    """The stream of an object. Raises FileNotFoundError also where it is removed after it was opened."""
    from pyarrow.fs import FileType

    system, place = path.place
    try:
        with system.open_input_stream(place) as stream:
            yield stream
    except FileNotFoundError:
        raise
    except OSError as error:
        if system.get_file_info(place).type != FileType.File:
            raise FileNotFoundError(place) from None
        raise error from None


def copy(source: RemotePath, target: RemotePath) -> None:
    """Copy an object within the store. Raises OSError."""
    system, place = target.place
    system.copy_file(source.place[1], place)


def remove(path: RemotePath) -> None:
    """An object, or all with this prefix; nothing where there is none. Raises OSError."""
    from pyarrow.fs import FileType

    system, place = path.place
    kind = system.get_file_info(place).type
    if kind == FileType.File:
        system.delete_file(place)
    elif kind == FileType.Directory and path.scheme == "gs":  # what is only a prefix has no object of its own
        system.delete_dir_contents(place, missing_dir_ok=True)
    elif kind == FileType.Directory:
        system.delete_dir(place)


def files_below(path: RemotePath) -> dict[str, datetime]:
    """When each object with this prefix was written, by its name behind the prefix. Raises OSError."""
    from pyarrow.fs import FileSelector, FileType

    system, place = path.place
    found = system.get_file_info(FileSelector(place, allow_not_found=True, recursive=True))
    return {one.path[len(place) + 1 :]: one.mtime for one in found if one.type == FileType.File}


def has_conditional_writes(path: RemotePath) -> bool:
    """Whether `put_if` works: on S3 with boto3, as pyarrow has no conditional writes."""
    return path.scheme == "s3" and find_spec("boto3") is not None


def put_if(path: RemotePath, data: bytes, etag: str | None) -> str | None:
    """Write an object where it has this tag, or where there is none yet (tag None); its new tag, or None where that is
    not so. The store decides, so that of several writers one wins. Raises OSError.

    Conditional writes of S3: docs.aws.amazon.com/AmazonS3/latest/userguide/conditional-writes.html. A store that
    knows none writes in any case.
    """
    condition = {"IfNoneMatch": "*"} if etag is None else {"IfMatch": etag}
    answer = _request("put_object", path, Body=data, **condition)
    return None if answer is None else answer["ETag"]


def get_with_etag(path: RemotePath) -> tuple[bytes, str, float] | None:
    """The bytes of an object, its tag (empty where the store has none) and its age in seconds; None where there is
    none. Raises OSError.

    All of one state, also while it is replaced: one request of boto3 has that by itself; pyarrow asks for the length
    before, and what is read by another object's length is read again.
    """
    if not has_conditional_writes(path):
        return _get_whole(path)
    from botocore.exceptions import BotoCoreError

    answer = _request("get_object", path)
    if answer is None:
        return None
    date = answer["ResponseMetadata"]["HTTPHeaders"].get("date")
    now = parsedate_to_datetime(date) if date else datetime.now(UTC)  # by the server's clock, as its LastModified
    try:
        data = answer["Body"].read()
    except BotoCoreError as error:
        raise OSError(str(error)) from None
    return data, answer["ETag"], (now - answer["LastModified"]).total_seconds()


def _get_whole(path: RemotePath) -> tuple[bytes, str, float] | None:
    system, place = path.place
    for _ in range(_TRIES):
        before = system.get_file_info(place)
        try:
            with _opened(path) as stream:
                data = stream.read()
        except FileNotFoundError:
            return None
        after = system.get_file_info(place)
        if (before.size, before.mtime) == (after.size, after.mtime) == (len(data), after.mtime):
            now = datetime.now(UTC)
            return data, "", (now - (after.mtime or now)).total_seconds()
    raise OSError("it is replaced faster than it can be read")


def _request(verb: str, path: RemotePath, **arguments: Any) -> dict[str, Any] | None:
    """S3's answer; None where the condition does not hold or there is no such object. Raises OSError."""
    from botocore.exceptions import BotoCoreError, ClientError

    bucket, _, key = path.place[1].partition("/")
    try:
        return getattr(_client(*s3_place()), verb)(Bucket=bucket, Key=key, **arguments)
    except ClientError as error:
        # 412: the condition does not hold; 409: another write of the object is under way; 404: there is none
        status, code = error.response["ResponseMetadata"]["HTTPStatusCode"], error.response["Error"]["Code"]
        if status in (404, 409, 412) and code != "NoSuchBucket":
            return None
        raise OSError(str(error)) from None
    except BotoCoreError as error:
        raise OSError(str(error)) from None


@lru_cache
def _client(endpoint: str | None, region: str | None) -> Any:
    """boto3 looks for credentials where pyarrow does."""
    import boto3
    from botocore.config import Config

    settings = Config(retries={"max_attempts": 4, "mode": "standard"})
    return boto3.client("s3", endpoint_url=endpoint, region_name=region, config=settings)
