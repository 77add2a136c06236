"""Stores of objects (S3, Google Cloud Storage, Azure) and web servers through obstore: bounded waits, plain errors.

Endpoints and credentials come from where each service's own tools look for them: AWS_* and ~/.aws,
STORAGE_EMULATOR_HOST and GOOGLE_APPLICATION_CREDENTIALS, AZURE_STORAGE_*. Here is what obstore does not do itself: to
read the files in ~/.aws, to read public data of Google without credentials, and to say in one line what went wrong.
"""

from __future__ import annotations

import configparser
import os
import re
import threading
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from vplog.storage.urls import without_secrets

if TYPE_CHECKING:
    from obstore.store import ObjectStore

STORES = ("s3", "gs", "az")
"""Schemes of what is read and written; http and https are read."""
_SILENCE_S = 30
"""Timeout of a server without an answer."""
_REQUEST_S = {True: 3600, False: 600}
"""Longest request, of a store and of a web server: the latter sends blocks of 1 MB, in that time over a modem too."""
_RETRIES = {"max_retries": 3, "retry_timeout": timedelta(seconds=20)}
"""None begins later than 20 s after the request."""
_OPEN = 64
"""Stores that are kept with their connections."""
_METADATA = "http://metadata.google.internal"
"""Gives credentials on Google's own machines, and is nowhere else."""
_METADATA_S = 2.0
"""s; the metadata server is on the machine itself: google-auth waits 3 s."""
_WHY = (
    (r"169\.254\.169\.254|metadata\.google|token request|service account file|Account must be",
     "no credentials are found that are of use (AWS_ACCESS_KEY_ID and AWS_SECRET_ACCESS_KEY, `gcloud auth "
     "application-default login` or GOOGLE_APPLICATION_CREDENTIALS, AZURE_STORAGE_ACCOUNT_KEY); for a public bucket "
     "of S3 set AWS_SKIP_SIGNATURE=true"),
    (r"<Code>(\w+)</Code>\s*<Message>([^<]*)", "the server answers {0}: {1}"),
    (r"status code: (\d{3} [^:\n]*)", "the server answers {0}"),
    (r"TooManyRedirects|BadScheme", "the server redirects without end, or to what is not HTTP"),
    (r"IncompleteMessage|Parse\(", "the server's answer is not HTTP"),
    (r"TimedOut", "the server does not answer in time"),
    (r"IncompleteBody|UnexpectedEof|ChunkedSize|InvalidChunk", "the server's answer ends too early"),
    (r"(?:message|error): \"([^\"]*)\"", "the server does not answer ({0}); check the network"),
    (r"[Cc]ontent.[Ll]ength", "the server does not say how long the file is"),
    (r"Range request not supported|Content-Range", "the server does not answer range requests; download the file"),
    (r"Requested (\d+)\.\.\d+, got (\d+)", "the server sent from byte {1} on, not from byte {0}"),
    (r"(?:Generic \w+ error: )?(.*)", "{0}"),
)  # fmt: skip
"""Patterns of errors of obstore, whose innermost one is in their last lines, and the message; the first that matches
counts."""
_IMPORTING = threading.Lock()
"""Modules of obstore import each other, of which threads that begin at the same time see parts."""
_NO_BUCKET = re.compile("NoSuchBucket|ContainerNotFound|bucket does not exist")


def opened(scheme: str, where: str, upload: bool = False) -> ObjectStore:
    """A bucket or container, for http and https all of a URL, for file this machine. For an `upload` a server may be
    silent while it takes what is sent. Raises OSError."""
    names = ("AWS_", "GOOGLE_", "AZURE_", "STORAGE_EMULATOR_HOST", "HOME")
    environment = tuple(sorted(one for one in os.environ.items() if one[0].startswith(names)))
    with plain_errors():
        return _opened(scheme, where, upload, environment)


@lru_cache(_OPEN)
def _opened(scheme: str, where: str, upload: bool, _: tuple[Any, ...]) -> ObjectStore:
    with _IMPORTING:
        from obstore.store import AzureStore, GCSStore, HTTPStore, LocalStore, S3Store

    longest = _REQUEST_S[scheme in STORES]
    client: Any = {
        "allow_http": True, "connect_timeout": timedelta(seconds=10), "timeout": timedelta(seconds=longest),
        "read_timeout": timedelta(seconds=longest if upload else _SILENCE_S),
    }  # fmt: skip
    how: Any = {"client_options": client, "retry_config": _RETRIES}
    match scheme:
        case "s3":
            return S3Store(where, config=_aws_profile(), **how)
        case "gs":
            return GCSStore(where, config=_google_config(), **how)
        case "az":
            return AzureStore(where, **how)
        case "file":
            return LocalStore()
    return HTTPStore(where, **how)


def _aws_profile() -> Any:
    """Keys and region of the user's profile, where the environment has none."""
    files, profile = configparser.RawConfigParser(), os.environ.get("AWS_PROFILE") or "default"
    files.read(
        Path(os.environ.get(f"AWS_{variable}_FILE") or f"~/.aws/{name}").expanduser()
        for variable, name in (("CONFIG", "config"), ("SHARED_CREDENTIALS", "credentials"))
    )
    found: dict[str, str] = {}
    for section in (f"profile {profile}", profile):
        found |= dict(files[section]) if section in files else {}
    keys = ("aws_access_key_id", "aws_secret_access_key", "aws_session_token")
    wanted = () if {"AWS_ACCESS_KEY_ID", "AWS_SKIP_SIGNATURE"} & {*os.environ} else keys
    wanted += () if {"AWS_REGION", "AWS_DEFAULT_REGION"} & {*os.environ} else ("region",)
    return {name: found[name] for name in wanted if name in found}


def _google_config() -> Any:
    """A server of the user's own, or without credentials public data."""
    if host := os.environ.get("STORAGE_EMULATOR_HOST"):
        return {"base_url": host if "://" in host else f"http://{host}", "bearer_token": "none"}
    return {} if _has_google_credentials() else {"skip_signature": True}


def _has_google_credentials() -> bool:
    """Whether any would be found: cloud.google.com/docs/authentication/application-default-credentials."""
    if any(name.startswith(("GOOGLE_APPLICATION", "GOOGLE_SERVICE", "GOOGLE_BEARER")) for name in os.environ):
        return True
    if Path("~/.config/gcloud/application_default_credentials.json").expanduser().is_file():
        return True
    try:
        urllib.request.build_opener(urllib.request.ProxyHandler({})).open(_METADATA, timeout=_METADATA_S).close()
    except OSError:
        return False
    return True


@contextmanager
def plain_errors() -> Iterator[None]:
    """Errors of obstore as an OSError of one line: FileNotFoundError where an object is not there, PermissionError
    where it may not be read or written."""
    from obstore.exceptions import BaseError, PermissionDeniedError, UnauthenticatedError

    try:
        yield
    except (BaseError, ValueError, RuntimeError, configparser.Error, FileNotFoundError) as error:
        text = str(error)
        if isinstance(error, FileNotFoundError) and error.errno is not None:  # of this machine
            raise
        if _NO_BUCKET.search(text):
            raise OSError("there is no bucket of this name") from None
        kind = PermissionError if isinstance(error, PermissionDeniedError | UnauthenticatedError) else OSError
        kind = FileNotFoundError if isinstance(error, FileNotFoundError) or "code: 410 " in text else kind
        raise kind(_why(text)) from None


def _why(text: str) -> str:
    for pattern, message in _WHY:
        if found := re.search(pattern, text):
            line = message.format(*(one or "" for one in found.groups()))
            printable = "".join(one if one.isprintable() else " " for one in without_secrets(line))
            return printable[:400].rstrip(". ") or "it is refused"
    return text
