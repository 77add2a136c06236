"""Files on a web server, by ranges (RFC 9110, section 14); its answers are not trusted, and every wait is bounded."""

from __future__ import annotations

import http.client
import re
import time
import urllib.error
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from functools import lru_cache
from typing import Any

from vplog.storage.urls import without_secrets

_TIMEOUT_S = 30.0
"""Timeout of a server without an answer."""
_SLOWEST = 1000
"""Bytes a second, below which a server is taken as gone; a modem had seven times as many."""
_CONTENT_RANGE = re.compile(r"bytes (\d{1,18})-(\d{1,18})/(\d{1,18}|\*)")


def head(url: str) -> dict[str, str]:
    """The headers of a file, empty where there is none. Links that are signed for reading alone allow no HEAD: then one
    byte is requested. Raises OSError."""
    try:
        with _requested("HEAD", url) as answer:
            return dict(answer.headers)
    except _StatusError as refused:
        if refused.code in (404, 410):
            return {}
        if refused.code not in (403, 405, 501):
            raise
    with _requested("GET", url, {"Range": "bytes=0-0"}) as answer:
        found = _CONTENT_RANGE.fullmatch(answer.headers.get("Content-Range", ""))
        return {**dict(answer.headers), "Content-Length": found[3] if found else ""}


def get_range(url: str, start: int, count: int, length: int) -> bytes:
    """Bytes of a file of this length, from `start`: `count` of them, or fewer, but not none. Raises OSError."""
    data, began = bytearray(), time.monotonic()
    with _requested("GET", url, {"Range": f"bytes={start}-{start + count - 1}"}) as answer:
        if answer.status != 206 and not (start == 0 and count == length):
            raise OSError("the server does not answer range requests; download the file first")
        found = _CONTENT_RANGE.fullmatch(answer.headers.get("Content-Range", ""))
        if found and int(found[1]) != start:
            raise OSError(f"the server sent from byte {found[1]} on, not from byte {start}")
        while len(data) < count and (block := answer.read1(count - len(data))):
            data += block
            if time.monotonic() - began > _TIMEOUT_S + len(data) / _SLOWEST:
                raise OSError(f"the server sends less than {_SLOWEST} bytes a second")
    if not data:
        raise OSError(f"the server states a length of {length} bytes, and sends none from byte {start} on")
    return bytes(data)


class _StatusError(OSError):
    """The server refuses."""

    def __init__(self, code: int, reason: str) -> None:
        super().__init__(f"the server answers {code} {reason}")
        self.code = code


@contextmanager
def _requested(method: str, url: str, headers: dict[str, str] | None = None) -> Iterator[Any]:
    """The answer to a request. Raises OSError of one line without control characters, which a server may send."""
    request = urllib.request.Request(url, method=method, headers=headers or {})  # noqa: S310 (the opener knows http only)
    try:
        with _opener().open(request, timeout=_TIMEOUT_S) as answer:
            yield answer
    except urllib.error.HTTPError as error:
        error.close()
        raise _StatusError(error.code, _printable(str(error.reason))) from None
    except urllib.error.URLError as error:
        raise OSError(_printable(str(error.reason))) from None
    except (http.client.HTTPException, ValueError) as error:
        raise OSError(f"the server's answer is not HTTP ({type(error).__name__})") from None


@lru_cache
def _opener() -> urllib.request.OpenerDirector:
    """http and https, through a proxy where one is set. A redirection to anything else, as ftp, is refused."""
    opener = urllib.request.OpenerDirector()
    for handler in (
        urllib.request.ProxyHandler, urllib.request.UnknownHandler, urllib.request.HTTPHandler,
        urllib.request.HTTPSHandler, urllib.request.HTTPDefaultErrorHandler, urllib.request.HTTPRedirectHandler,
        urllib.request.HTTPErrorProcessor,
    ):  # fmt: skip
        opener.add_handler(handler())
    return opener


def _printable(text: str) -> str:
    return "".join(one if one.isprintable() else " " for one in without_secrets(text))[:200].rstrip(". ")
