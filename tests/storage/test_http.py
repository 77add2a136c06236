"""Web servers that lie, stop or lead astray: each is one line, and none is waited for without end."""

from __future__ import annotations

import socket
import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import pytest

from vplog.storage import object_store
from vplog.storage.remote_path import located

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator

    from conftest import Said

DATA = bytes(range(256)) * 40
FOUND = f"HTTP/1.1 200 OK\r\nContent-Length: {len(DATA)}\r\n\r\n".encode()
PART = b"HTTP/1.1 206 Partial Content\r\nContent-Length: 10\r\n"


@contextmanager
def saying(answer: Callable[[str], bytes]) -> Iterator[str]:
    """A server that answers each request, of which it is given the first lines, with these bytes, and hangs up."""

    def serve() -> None:
        while True:
            try:
                connection, _ = server.accept()
            except OSError:
                return
            with connection:
                said = b""
                while b"\r\n\r\n" not in said and (more := connection.recv(65536)):
                    said += more
                connection.sendall(answer(said.decode()))

    with socket.create_server(("127.0.0.1", 0)) as server:
        thread = threading.Thread(target=serve, daemon=True)
        thread.start()
        yield f"http://127.0.0.1:{server.getsockname()[1]}/drive.mcap"
        server.shutdown(socket.SHUT_RDWR)
    thread.join(5)


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (b"\x1b[31m\xff\xfe garbage\r\n\r\n", "is not HTTP"),
        (b"HTTP/1.1 200 OK\r\n" + b"X: y\r\n" * 500 + b"\r\n", "is not HTTP"),
        (b"HTTP/1.1 200 OK\r\nX: " + b"y" * 100_000 + b"\r\n\r\n", "does not say how long"),
        (b"", "is not HTTP"),
        (b"HTTP/1.1 302 Found\r\nConnection: close\r\nLocation: /drive.mcap\r\n\r\n", "redirects without end"),
        (b"HTTP/1.1 302 Found\r\nLocation: file:///etc/passwd\r\n\r\n", "answers 302"),
        (
            b"HTTP/1.1 302 Found\r\nLocation: ftp://127.0.0.1:1/a\r\n\r\n",
            "redirects without end, or to what is not HTTP",
        ),
        (b"HTTP/1.1 500 No \x1b[31m" + b"y" * 900 + b"\r\n\r\n", "is not HTTP"),
        (b"HTTP/1.1 400 No\r\nContent-Length: 5\r\n\r\n", "answers 400"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: -5\r\n\r\n", "does not say how long"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: abc\r\n\r\n", "does not say how long"),
        (b"HTTP/1.1 403 Forbidden\r\n\r\n", "403 Forbidden"),
    ],
)
def test_what_is_no_file_is_one_line(answer: bytes, told: str, verb: Callable[..., Said]) -> None:
    with saying(lambda _: answer) as url:
        assert told in (said := verb("info", url).error)
        assert all(one.isprintable() for one in said)
        assert len(said) < 400


def part(url: str, start: int, stop: int) -> bytes:
    """Of a file that is known to be as long as DATA."""
    path: Any = located(url)
    path.__dict__["_meta"] = {"size": len(DATA)}
    return path.read_range(start, stop)


@pytest.mark.parametrize(
    ("answer", "told"),
    [
        (PART + b"\r\n" + DATA[100:110], "does not answer range requests"),
        (PART + b"Content-Range: bytes 0-9/10240\r\n\r\n" + DATA[:10], "from byte 0 on, not from byte 100"),
        (PART + b"Content-Range: bytes 100-109/10240\r\n\r\n" + DATA[:4], "ends too early"),
        (
            PART.replace(b"10", b"0") + b"Content-Range: bytes 100-109/10240\r\n\r\n", "sends none from byte 100",
        ),
        (FOUND + DATA, "does not answer range requests"),
    ],
)  # fmt: skip
def test_a_part_that_is_not_what_was_asked_for_is_refused(answer: bytes, told: str) -> None:
    with saying(lambda _: answer) as url, pytest.raises(OSError, match=told):
        part(url, 100, 110)


def test_a_part_is_never_longer_than_asked_and_all_of_a_file_needs_no_ranges() -> None:
    long = b"HTTP/1.1 206 P\r\nContent-Length: 10240\r\nContent-Range: bytes 0-9/10240\r\n\r\n"
    with saying(lambda _: long + DATA) as url:
        assert part(url, 0, 10) == DATA[:10]
    with saying(lambda said: b"" if "bytes=" in said else FOUND + DATA) as url:
        assert part(url, 0, len(DATA)) == DATA


def test_a_server_that_is_silent_is_given_up(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(object_store, "_SILENCE_S", 0.2)
    monkeypatch.setitem(object_store._RETRIES, "max_retries", 0)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        url = f"http://127.0.0.1:{silent.getsockname()[1]}/a.mcap"
        with pytest.raises(OSError, match="does not answer in time"):
            located(url).exists()


def test_a_server_that_is_overloaded_is_asked_again_and_not_for_ever() -> None:
    asked: list[str] = []

    def answer(said: str) -> bytes:
        asked.append(said)
        return b"HTTP/1.1 503 Busy\r\nContent-Length: 0\r\n\r\n" if len(asked) != 3 else FOUND

    with saying(answer) as url:
        assert located(url).stat().st_size == len(DATA)
        with pytest.raises(OSError, match="answers 503"):
            located(url).exists()
    assert 4 < len(asked) <= 7  # waits between them grow at random, and end after some seconds


def test_a_link_that_allows_no_head_is_read() -> None:
    """As links to object stores do that are signed for GET."""

    def answer(said: str) -> bytes:
        if said.startswith("HEAD"):
            return b"HTTP/1.1 403 Forbidden\r\n\r\n"
        if "bytes=" not in said:
            return FOUND + DATA
        first, last = (int(part) for part in said.partition("bytes=")[2].split("\r\n")[0].split("-"))
        about = f"Content-Length: {last + 1 - first}\r\nContent-Range: bytes {first}-{last}/{len(DATA)}\r\n\r\n"
        return b"HTTP/1.1 206 Partial Content\r\n" + about.encode() + DATA[first : last + 1]

    with saying(answer) as url:
        path = located(f"{url}?X-Signature=abc")
        assert path.stat().st_size == len(DATA)
        assert path.name == "drive.mcap"
        assert path.read_bytes() == DATA


@pytest.mark.parametrize("status", ["404 Not Found", "410 Gone"])
def test_nothing_there_is_nothing(status: str) -> None:
    with saying(lambda _: f"HTTP/1.1 {status}\r\n\r\n".encode()) as url:
        assert not located(url).exists()
