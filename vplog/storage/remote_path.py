"""Files by URL: s3:// and gs:// through pyarrow, http(s):// by range requests; read in parts, written when finished.

Credentials and endpoints come from where each service's own tools look for them (AWS_ACCESS_KEY_ID, AWS_ENDPOINT_URL,
GOOGLE_APPLICATION_CREDENTIALS, STORAGE_EMULATOR_HOST, ...).
"""

from __future__ import annotations

import io
import os
import re
import shutil
import urllib.parse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from functools import cached_property, lru_cache, partial
from pathlib import Path, PurePosixPath
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, BinaryIO, cast

from vplog.errors import LogError, ResultError, SettingsError
from vplog.storage.gcs import gcs_endpoint, google_file_system, plain, plain_errors
from vplog.storage.http import get_range, head
from vplog.storage.scratch import scratch
from vplog.storage.urls import shown, without_secrets

if TYPE_CHECKING:
    from pyarrow.fs import FileInfo, FileSystem

SCHEMES = ("s3", "gs", "http", "https")
_BLOCK_BYTES = 1 << 20
"""Read ahead of small reads: a chunk of a log; a request costs as much as some hundred kB."""
_TIMEOUT_S = 30.0
"""Timeout of a server without an answer."""
_DENIED = re.compile(r"ACCESS_DENIED|AccessDenied|PERMISSION_DENIED|HTTP response code 403")
"""Errors of pyarrow's clients where this account lacks the permission."""


def located(text: str | Path | RemotePath) -> Path:
    """A local path, or where the text is a URL, a RemotePath, which answers like one. Raises SettingsError for a scheme
    that is not known."""
    if isinstance(text, RemotePath):
        return cast("Path", text)
    if "://" not in str(text):
        return Path(text)
    scheme = str(text).split("://", 1)[0]
    if scheme not in SCHEMES:
        known = f"{scheme}:// is not known. Known: {', '.join(SCHEMES)}, or a path."
        raise SettingsError(f"Cannot open {shown(str(text))}: {known}")
    return cast("Path", RemotePath(_checked(str(text), scheme)))


def address(path: Path) -> str:
    """Text that opens a path in another process: a URL with its query, which is not to be stored or shown."""
    return path.url if isinstance(path, RemotePath) else str(path)


def _checked(url: str, scheme: str) -> str:
    """The URL, if credentials are in the query of http alone. Raises SettingsError, which does not show them."""
    host, store = re.split("[/?#]", url.split("://", 1)[1], maxsplit=1)[0], scheme in ("s3", "gs")
    port = host.rpartition(":")[2]
    if not host:
        whose = "BUCKET/NAME" if store else "SERVER/FILE"
        raise SettingsError(f"{shown(url)} names no {'bucket' if store else 'server'}. Write {scheme}://{whose}")
    if "@" in host or (":" in host and (store or not (port.isdigit() or port.endswith("]")))):
        raise SettingsError(
            f"A {scheme}:// URL names a user, a password, or a port that is no number, and vplog sends none. Leave "
            "them out: a store's keys come from the environment, and a web server takes a signed link."
        )
    if store and "?" in url:
        raise SettingsError(f"{shown(url)} has a query, which {scheme}:// does not take. Write ? in a name as %3F.")
    return url.replace("#", "%23") if store else url


@dataclass(frozen=True, order=True, repr=False)
class RemotePath:
    """One object, or what has this prefix, on a server. A URL has % for what it cannot spell; names here have not."""

    url: str
    """With its query, which may hold a token."""

    def __post_init__(self) -> None:
        object.__setattr__(self, "url", self.url if "?" in self.url else self.url.rstrip("/"))

    def __str__(self) -> str:
        """As it is stored and shown: without its query."""
        return shown(self.url)

    def __repr__(self) -> str:
        return f"RemotePath({str(self)!r})"

    def __truediv__(self, name: str) -> RemotePath:
        place, mark, query = self.url.partition("?")
        quoted = str(name).replace("%", "%25").replace("?", "%3F").replace("#", "%23")
        return RemotePath(f"{place}/{quoted}{mark}{query}")

    @property
    def scheme(self) -> str:
        return self.url.split("://", 1)[0]

    @property
    def name(self) -> str:
        return PurePosixPath(urllib.parse.unquote(urllib.parse.urlsplit(self.url).path)).name

    @property
    def stem(self) -> str:
        return PurePosixPath(self.name).stem

    @property
    def suffix(self) -> str:
        return PurePosixPath(self.name).suffix

    def resolve(self) -> RemotePath:
        return self

    def relative_to(self, folder: RemotePath) -> PurePosixPath:
        below = PurePosixPath(str(self)).relative_to(PurePosixPath(str(folder)))
        return PurePosixPath(urllib.parse.unquote(str(below)))

    def exists(self) -> bool:
        return self._kind != "none"

    def is_file(self) -> bool:
        return self._kind == "file"

    def is_dir(self) -> bool:
        return self._kind == "folder"

    def stat(self) -> SimpleNamespace:
        return SimpleNamespace(st_size=self._length)

    def version(self) -> str:
        """A text that changes with the object, without reading it: its length and time, or the server's tag."""
        if self._is_http:
            return f"length {self._length}, {self._head.get('ETag') or self._head.get('Last-Modified') or 'no tag'}"
        return f"length {self._length}, time {self._info.mtime_ns}"

    def open(self, mode: str = "rb") -> BinaryIO:
        """A stream that reads by requests for blocks. Raises OSError."""
        if mode != "rb":
            raise ValueError(f"a remote file is opened with mode rb, not {mode}")
        if self._is_http:
            raw: Any = _Ranges(self._length, partial(get_range, self.url, length=self._length))
        else:
            system, place = self.place
            with plain_errors():
                file = system.open_input_file(place)
            raw = _Ranges(self._length, lambda start, count: file.read_at(count, start), file.close)
        return io.BufferedReader(raw, _BLOCK_BYTES)

    def read_bytes(self) -> bytes:
        with self.open() as stream:
            return stream.read()

    def read_text(self, encoding: str = "utf-8") -> str:
        return self.read_bytes().decode(encoding)

    def iterdir(self) -> Iterator[RemotePath]:
        """Entries right below, in order of names; none of an HTTP server, which does not list."""
        for name in () if self._is_http else sorted(names_below(self)):
            yield self / name

    def rglob(self, _: str = "*") -> Iterator[RemotePath]:
        if self._is_http:
            return
        from pyarrow.fs import FileSelector

        system, place = self.place
        with plain_errors():
            below = system.get_file_info(FileSelector(place, recursive=True))
        for found in sorted(below, key=lambda one: one.path):
            yield self / found.path[len(place) + 1 :]

    @property
    def _is_http(self) -> bool:
        return self.scheme in ("http", "https")

    @cached_property
    def place(self) -> tuple[FileSystem, str]:
        """The file system of an object store, and the path in it."""
        place = urllib.parse.unquote(self.url.split("://", 1)[1])
        if self.scheme == "gs":
            return google_system(gcs_endpoint(), place.partition("/")[0]), place
        return file_system(*s3_place()), place

    @cached_property
    def _info(self) -> FileInfo:
        system, place = self.place
        with plain_errors():
            return system.get_file_info(place)

    @cached_property
    def _head(self) -> dict[str, str]:
        return head(self.url)

    @cached_property
    def _kind(self) -> str:
        if self._is_http:
            return "file" if self._head else "none"
        from pyarrow.fs import FileType

        return {FileType.File: "file", FileType.Directory: "folder"}.get(self._info.type, "none")

    @property
    def _length(self) -> int:
        if not self._is_http:
            return int(self._info.size or 0)
        length = self._head.get("Content-Length", "")
        if not length.isdigit():
            raise OSError(f"the server {'does not say how long the file is' if self._head else 'has no such file'}")
        return int(length)


class _Ranges(io.RawIOBase):
    """Random access to a remote file; every read is a request for just these bytes."""

    def __init__(
        self, length: int, fetch: Callable[[int, int], bytes], close: Callable[[], None] = lambda: None
    ) -> None:
        """`fetch` gives bytes by their start and count, `close` is called at the end."""
        self._at, self._length, self._fetch, self._close = 0, length, fetch, close

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._length}[whence]
        self._at = max(start + offset, 0)
        return self._at

    def tell(self) -> int:
        return self._at

    def readinto(self, buffer: Any) -> int:
        wanted = min(len(buffer), max(self._length - self._at, 0))
        if wanted == 0:
            return 0
        with plain_errors():
            data = self._fetch(self._at, wanted)
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)

    def close(self) -> None:
        if not self.closed:
            self._close()
        super().close()


def names_below(path: RemotePath) -> dict[str, bool]:
    """Names right below a prefix of an object store, and whether each has objects below, by which gs:// alone tells
    folders. Raises OSError."""
    from pyarrow.fs import FileSelector, FileType

    system, place = path.place
    below = dict[str, bool]()
    with plain_errors():
        found = system.get_file_info(FileSelector(place, allow_not_found=True, recursive=path.scheme == "gs"))
    for one in found:
        name, _, rest = one.path[len(place) + 1 :].partition("/")
        below[name] = below.get(name, False) or bool(rest) or one.type == FileType.Directory
    return below


def s3_place() -> tuple[str | None, str | None]:
    """Endpoint and region of S3, by the variables of its own tools; None where they are not set."""
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL")
    return endpoint, os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")


google_system = lru_cache(google_file_system)
"""One for all objects of a bucket."""


@lru_cache
def file_system(endpoint: str | None, region: str | None) -> FileSystem:
    """One for all objects of a server that speaks S3: it keeps its connections."""
    from pyarrow import fs

    return fs.S3FileSystem(  # delayed: a small file is one request, not the three of an upload in parts
        request_timeout=_TIMEOUT_S, connect_timeout=_TIMEOUT_S, allow_delayed_open=True,
        endpoint_override=endpoint or None, region=region or None,
    )  # fmt: skip


_STANDS_FOR: dict[Path, Path | RemotePath] = {}
"""Original places of temporary copies, by local path."""


def original(path: Path) -> Path:
    """The original place of a temporary copy or of a path in one; any other path itself."""
    for folder in (path, *([] if isinstance(path, RemotePath) else path.parents)):
        if folder in _STANDS_FOR:
            place = _STANDS_FOR[folder]
            return original(cast("Path", place if folder == path else place / path.relative_to(folder).as_posix()))
    return path


@contextmanager
def stands_for(path: Path, place: Path | RemotePath) -> Iterator[Path]:
    """For the time of the block, records name `place` for `path`, where its files come from or go to."""
    _STANDS_FOR[path] = place
    try:
        yield path
    finally:
        del _STANDS_FOR[path]


@contextmanager
def local_copy(path: Path | RemotePath) -> Iterator[Path]:
    """A remote folder or file as a local one for the time of the block; a local one as it is. Raises LogError."""
    if not isinstance(path, RemotePath):
        yield path
        return
    with scratch("url") as folder:
        target = folder / (path.name or "remote")
        try:
            if not path.exists():
                raise LogError(f"There is nothing at {path}. Check its name.")
            _download(path, target)
        except OSError as error:
            raise LogError(f"Cannot read {path}: {reason(error)}. Check the URL and its rights.") from None
        with stands_for(target, path):
            yield target


def _download(path: RemotePath, target: Path) -> None:
    files = {path: target} if path.is_file() else {f: target / f.relative_to(path) for f in path.rglob() if f.is_file()}
    for file, place in files.items():
        place.parent.mkdir(parents=True, exist_ok=True)
        with file.open() as source, place.open("wb") as sink:
            shutil.copyfileobj(source, sink, _BLOCK_BYTES)


@contextmanager
def local_output(path: Path | RemotePath) -> Iterator[Path]:
    """Where to write what is to end at `path`: there, or for a remote one a local folder that is sent when all is done,
    run.json last; nothing of what failed. Raises ResultError where the server does not take it, before any work where
    there is none, SettingsError for one that takes nothing."""
    if not isinstance(path, RemotePath):
        yield path
        return
    check_writable(path)
    _check_bucket(path)
    with scratch("url") as folder:
        target = folder / (path.name or "out")
        with stands_for(target, path):
            yield target
        files = [target] if target.is_file() else sorted(file for file in target.rglob("*") if file.is_file())
        files.sort(key=lambda file: file.name == "run.json" and file.parent == target)
        try:
            system, place = path.place
            for file in files:
                with (
                    file.open("rb") as source,
                    system.open_output_stream(str(PurePosixPath(place) / file.relative_to(target))) as sink,
                ):
                    shutil.copyfileobj(source, sink, _BLOCK_BYTES)
        except OSError as error:
            raise ResultError(f"Cannot write {path}: {reason(error)}.") from None


def check_writable(path: RemotePath) -> None:
    """Raises SettingsError for what is only read."""
    if path.scheme not in ("s3", "gs"):
        raise SettingsError(
            f"Cannot write to {path}: {path.scheme}:// is for reading. Write to s3://, gs:// or a path."
        )


def _check_bucket(path: RemotePath) -> None:
    """Raises ResultError where there is no server, or no such bucket on it; what may be written only writing tells."""
    from pyarrow.fs import FileType

    try:
        system, place = path.place
        bucket = place.partition("/")[0]
        there = system.get_file_info(bucket).type != FileType.NotFound
    except OSError as error:
        if _DENIED.search(str(error)):  # a look at the bucket; what writes need not have the right to that
            return
        raise ResultError(f"Cannot write {path}: {reason(error)}.") from None
    if not there:
        raise ResultError(f"Cannot write {path}: there is no bucket {bucket}. Make it, or choose another with -o.")


def reason(error: OSError) -> str:
    """Why something failed, in one line."""
    text = without_secrets(plain(error.strerror or str(error)))
    return (text.splitlines()[0] if text else type(error).__name__)[:300].rstrip(".")
