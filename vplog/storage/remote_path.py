"""Files by URL: s3://, gs:// and az:// in parts and written when finished, http(s):// by range requests.

Endpoints and credentials are those of object_store.py.
"""

from __future__ import annotations

import errno
import io
import os
import re
import shutil
import urllib.parse
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from email.utils import format_datetime
from functools import cached_property, partial
from itertools import pairwise
from pathlib import Path, PurePosixPath
from stat import S_IFREG
from types import SimpleNamespace
from typing import TYPE_CHECKING, Any, BinaryIO, cast

from vplog.errors import LogError, ResultError, SettingsError
from vplog.storage.object_store import STORES, opened, plain_errors
from vplog.storage.scratch import scratch
from vplog.storage.urls import shown, without_secrets

if TYPE_CHECKING:
    from obstore import ObjectMeta, PutResult
    from obstore.store import ObjectStore

SCHEMES = (*STORES, "http", "https")
_NO_HEAD = re.compile("answers (403|405|501)")
_LEFT_FREE = 1 << 28
"""Bytes of a disk that copies leave free, but no more than a tenth of what is."""
_BLOCK_BYTES = 1 << 20
"""Read ahead of small reads: a chunk of a log; a request costs as much as some hundred kB."""
_PART_BYTES = 1 << 24
"""A longer file is uploaded in such parts, of which S3 takes 10 000."""


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


def is_elsewhere(recorded: str, named: str | Path) -> bool:
    """Return True if a record names a URL whose server, or bucket, is not that of the path or URL `named`.

    A record may come from anyone. What it names is opened only if the user named the server in this command.
    """
    servers = [re.match("[a-z][a-z0-9+.-]*://[^/?#]*", text, re.IGNORECASE) for text in (recorded, _origin(named))]
    recorded_on, named_on = (found and found[0].lower() for found in servers)
    return recorded_on is not None and recorded_on != named_on


def _origin(path: str | Path) -> str:
    return path if isinstance(path, str) else str(original(path))


def address(path: Path) -> str:
    """Text that opens a path in another process: a URL with its query, which is not to be stored or shown."""
    return path.url if isinstance(path, RemotePath) else str(path)


def _checked(url: str, scheme: str) -> str:
    """The URL, if credentials are in the query of http alone. Raises SettingsError, which does not show them."""
    host, store = re.split("[/?#]", url.split("://", 1)[1], maxsplit=1)[0], scheme in STORES
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
        return SimpleNamespace(st_size=self._length, st_mode=S_IFREG)

    def version(self) -> str:
        """A text that changes with the object, without reading it: its length and time, or the server's tag."""
        meta = self._there
        if not self._is_http:
            return f"length {meta['size']}, time {int(meta['last_modified'].timestamp()) * 10**9}"
        time = format_datetime(meta["last_modified"], usegmt=True) if meta["last_modified"].timestamp() else "no tag"
        return f"length {meta['size']}, {meta['e_tag'] or time}"

    def open(self, mode: str = "rb") -> BinaryIO:
        """A stream that reads by requests for blocks. Raises OSError."""
        if mode != "rb":
            raise ValueError(f"a remote file is opened with mode rb, not {mode}")
        return io.BufferedReader(_Ranges(self._length, self.read_range), _BLOCK_BYTES)

    def read_range(self, start: int, stop: int) -> bytes:
        """Bytes from `start` to before `stop`, never more, whatever the server sends; a server that knows no ranges
        gives all of a file. Raises OSError."""
        whole = stop - start == self._length
        found = self.ask("get", options={} if whole else {"range": (start, stop)})
        with plain_errors():
            data = next(found.stream(min_chunk_size=stop - start), b"")
        if not data:
            raise OSError(f"the server states a length of {self._length} bytes, and sends none from byte {start} on")
        return bytes(data[: stop - start])

    def read_bytes(self) -> bytes:
        with self.open() as stream:
            return b"".join(iter(partial(stream.read, _BLOCK_BYTES), b""))

    def read_text(self, encoding: str = "utf-8") -> str:
        return self.read_bytes().decode(encoding)

    def iterdir(self) -> Iterator[RemotePath]:
        """Entries right below, in order of names; none of an HTTP server, which does not list."""
        for name in () if self._is_http else sorted(names_below(self)):
            yield self / name

    def rglob(self, _: str = "*") -> Iterator[RemotePath]:
        """All objects below, in order of names; none of an HTTP server."""
        for name, meta in () if self._is_http else sorted(objects_below(self).items()):
            found = self / name
            found.__dict__["_meta"] = meta  # which need not be asked for again
            yield found

    @property
    def _is_http(self) -> bool:
        return self.scheme in ("http", "https")

    @property
    def place(self) -> tuple[ObjectStore, str]:
        """The store, and the name in it; of a web server all is in the former."""
        return self._place()

    def _place(self, upload: bool = False) -> tuple[ObjectStore, str]:
        if self._is_http:
            return opened(self.scheme, self.url), ""
        bucket, _, name = urllib.parse.unquote(self.url.split("://", 1)[1]).partition("/")
        return opened(self.scheme, bucket, upload), name

    @property
    def prefix_length(self) -> int:
        """Length of the prefix of the names in a listing."""
        return len(f"{self.place[1]}/".lstrip("/"))

    def ask(self, verb: str, *given: Any, upload: bool = False, **options: Any) -> Any:
        """Call obstore's method `verb` for this object or prefix. Raises OSError."""
        store, name = self._place(upload)
        with plain_errors():
            return getattr(store, verb)(name, *given, **options)

    @cached_property
    def _meta(self) -> ObjectMeta | None:
        """None where there is no such object. Links that are signed for GET alone allow no HEAD: then one byte is
        read."""
        try:
            return self.ask("head") if self._is_http or self._place()[1] else None
        except FileNotFoundError:
            return None
        except OSError as error:
            if not _NO_HEAD.search(str(error)):
                raise
            return self.ask("get", options={"range": (0, 1)}).meta

    @cached_property
    def _kind(self) -> str:
        if self._meta is not None:
            return "file"
        return "none" if self._is_http or not names_below(self) else "folder"

    @property
    def _there(self) -> ObjectMeta:
        if self._meta is None:
            raise FileNotFoundError("the server has no such file")
        return self._meta

    @property
    def _length(self) -> int:
        return self._there["size"]


class _Ranges(io.RawIOBase):
    """Random access to a remote file; every read is a request for just these bytes."""

    def __init__(self, length: int, fetch: Callable[[int, int], bytes]) -> None:
        self._at, self._length, self._fetch = 0, length, fetch

    def readable(self) -> bool:
        return True

    def seekable(self) -> bool:
        return True

    def seek(self, offset: int, whence: int = io.SEEK_SET) -> int:
        start = {io.SEEK_SET: 0, io.SEEK_CUR: self._at, io.SEEK_END: self._length}[whence]
        self._at = max(start + offset, 0)
        return self._at

    def readinto(self, buffer: Any) -> int:
        wanted = min(len(buffer), max(self._length - self._at, 0))
        if wanted == 0:
            return 0
        data = self._fetch(self._at, self._at + wanted)
        buffer[: len(data)] = data
        self._at += len(data)
        return len(data)


def names_below(path: RemotePath) -> dict[str, bool]:
    """Names right below a prefix of an object store, and whether each has objects below. Raises OSError."""
    found, skip = path.ask("list_with_delimiter"), path.prefix_length
    below = {one["path"][skip:]: False for one in found["objects"]}
    below.pop("", None)  # of the folder itself, as in `objects_below`
    return below | {name[skip:]: True for name in found["common_prefixes"]}


def objects_below(path: RemotePath) -> dict[str, ObjectMeta]:
    """All objects with this prefix, by their names behind it, but for the empty ones named FOLDER/ by which consoles
    show folders, and of which obstore drops the slash. Raises OSError."""
    listed = path.ask("list")
    with plain_errors():
        found = {one["path"][path.prefix_length :]: one for one in listed.collect()}
    found.pop("", None)
    names = sorted(found, key=lambda name: f"{name}/")  # what is below a name comes right after it
    folders = {name for name, after in pairwise(names) if after.startswith(f"{name}/")}
    return {name: about for name, about in found.items() if about["size"] or name not in folders}


def send(path: RemotePath, source: Path) -> PutResult:
    """A local file as an object, which appears when all of it is there. Raises OSError."""
    return path.ask("put", source, upload=True, chunk_size=_PART_BYTES, max_concurrency=1)


def s3_place() -> tuple[str | None, str | None]:
    """Endpoint and region of S3, by the variables of its own tools; None where they are not set."""
    endpoint = os.environ.get("AWS_ENDPOINT_URL_S3") or os.environ.get("AWS_ENDPOINT_URL")
    return endpoint, os.environ.get("AWS_REGION") or os.environ.get("AWS_DEFAULT_REGION")


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
    files = {path: target} if path.is_file() else {file: target / file.relative_to(path) for file in path.rglob()}
    target.parent.mkdir(parents=True, exist_ok=True)
    length = sum(file.stat().st_size for file in files)
    free = shutil.disk_usage(target.parent).free
    if length > free - min(_LEFT_FREE, free // 10):
        raise OSError(errno.ENOSPC, f"{path} has {length / 1e9:.1f} GB, and {target.parent} no room for them")
    for file, place in files.items():
        place.parent.mkdir(parents=True, exist_ok=True)
        with file.open() as source, place.open("wb") as sink:
            shutil.copyfileobj(source, sink, _BLOCK_BYTES)


_RECORDS = ("run.json",), ("library.json", "features.parquet", "references.parquet")
"""Files by which a run or a library is known."""


@contextmanager
def local_output(path: Path | RemotePath) -> Iterator[Path]:
    """Where to write what is to end at `path`: there, or for a remote one a local folder that is sent when all is done,
    run.json last; nothing of what failed. The record of a run or library that is there is in it, so that that of other
    logs is refused as in a folder. Raises ResultError where the server does not take it, before any work where there is
    none, SettingsError for one that takes nothing."""
    if not isinstance(path, RemotePath):
        yield path
        return
    check_writable(path)
    _check_bucket(path)
    with scratch("url") as folder:
        target = folder / (path.name or "out")
        try:
            names = next((names for names in _RECORDS if (path / names[0]).is_file()), ())
            for name in names:
                _download(path / name, target / name)
        except PermissionError:  # of a key that may only write, to which nothing is there
            _check_written(path)
        with stands_for(target, path):
            yield target
        files = [target] if target.is_file() else sorted(file for file in target.rglob("*") if file.is_file())
        files.sort(key=lambda file: file.name == "run.json" and file.parent == target)
        try:
            for file in files:
                send(path if file == target else path / file.relative_to(target).as_posix(), file)
        except OSError as error:
            raise ResultError(f"Cannot write {path}: {reason(error)}.") from None


def _check_written(path: RemotePath) -> None:
    """Raises ResultError where no object can be written below; that of the trial is removed where that may be."""
    probe = path / ".vplog"
    try:
        probe.ask("put", b"", upload=True)
    except OSError as error:
        raise ResultError(f"Cannot write {path}: {reason(error)}.") from None
    with suppress(OSError):
        probe.ask("delete", upload=True)


def check_writable(path: RemotePath) -> None:
    """Raises SettingsError for what is only read."""
    if path.scheme not in STORES:
        known = ", ".join(f"{scheme}://" for scheme in STORES)
        raise SettingsError(f"Cannot write to {path}: {path.scheme}:// is for reading. Write to {known} or a path.")


def _check_bucket(path: RemotePath) -> None:
    """Raises ResultError where there is no server, or no such bucket on it; what may be written only writing tells."""
    try:
        (path if path.place[1] else path / ".vplog").ask("get")
    except (FileNotFoundError, PermissionError):  # what writes need not have the right to read
        return
    except OSError as error:
        bucket = urllib.parse.urlsplit(path.url).netloc
        why = reason(error).replace("no bucket of this name", f"no bucket {bucket}")
        raise ResultError(f"Cannot write {path}: {why}. Choose another place with -o.") from None


def reason(error: OSError) -> str:
    """Why something failed, in one line."""
    text = without_secrets(error.strerror or str(error))
    return (text.splitlines()[0] if text else type(error).__name__)[:400].rstrip(".")
