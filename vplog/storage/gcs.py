"""gs:// through pyarrow: endpoint, credentials, and a bound on every wait.

pyarrow's client goes on for 15 minutes with what cannot succeed, and looks for credentials as long. So it is given less
time, the server is probed first, and access without credentials is anonymous, as public data allow.
"""

from __future__ import annotations

import http.client
import os
import re
import ssl
import urllib.error
import urllib.parse
import urllib.request
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import timedelta
from pathlib import Path
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from pyarrow.fs import FileSystem

_PUBLIC = "https://storage.googleapis.com"
_METADATA = "http://metadata.google.internal"
"""Gives credentials on Google's own machines, and is nowhere else."""
_PROBE_S = 10.0
"""For one request of some hundred bytes."""
_METADATA_S = 2.0
"""s; the metadata server is on the machine itself: google-auth waits 3 s."""
_RETRY_S = 20
"""Retries end after this; a request without an answer is ended by the client after 120 s."""
_REASON = re.compile(
    r"(?:.*underlying error message was: |.*?last message of )(.*?)(?: error_info=|,? gcloud-cpp|}}|$)", re.S
)
"""The innermost message of a google::cloud::Status."""


def gcs_endpoint() -> str:
    """The endpoint, by the variable of Google's own tools."""
    given = os.environ.get("STORAGE_EMULATOR_HOST") or _PUBLIC
    return given if "://" in given else f"http://{given}"


def google_file_system(endpoint: str, bucket: str, wait_s: float = _PROBE_S) -> FileSystem:
    """Raises OSError in one line where the server does not answer within `wait_s`, or credentials are of no use."""
    from pyarrow import fs

    _probe(endpoint, bucket, wait_s)
    parts = urllib.parse.urlsplit(endpoint)
    anonymous = endpoint != _PUBLIC or not _has_credentials()
    system = fs.GcsFileSystem(
        anonymous=anonymous, scheme=parts.scheme, endpoint_override=parts.netloc,
        retry_time_limit=timedelta(seconds=_RETRY_S),
    )  # fmt: skip
    if not anonymous:
        with plain_errors():
            try:  # a first request reads the credentials, which need not permit it
                system.get_file_info(f"{bucket}/vplog")
            except OSError as error:
                if "access token" in str(error):
                    raise
    return system


def _probe(endpoint: str, bucket: str, wait_s: float) -> None:
    """Raises OSError where nothing answers. A proxy would answer for the server, so behind one nothing is probed."""
    if urllib.request.getproxies().get(urllib.parse.urlsplit(endpoint).scheme) and endpoint == _PUBLIC:
        return
    url = f"{endpoint}/storage/v1/b/{urllib.parse.quote(bucket, safe='')}/o?maxResults=1&fields=kind"
    try:
        urllib.request.urlopen(url, timeout=wait_s).close()  # noqa: S310 (http or https)
    except (urllib.error.HTTPError, ssl.SSLError):
        return
    except (OSError, ValueError, http.client.HTTPException) as error:
        why = getattr(error, "reason", error)
        if not isinstance(why, ssl.SSLError):  # it is there; the client has certificates of its own
            raise OSError(f"{endpoint} does not answer ({why}); check the network") from None


def _has_credentials() -> bool:
    """Whether the client would find any: cloud.google.com/docs/authentication/application-default-credentials."""
    if os.environ.get("GOOGLE_APPLICATION_CREDENTIALS"):
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
    """Errors of Google's client as an OSError of one line; others are not changed."""
    try:
        yield
    except (OSError, ValueError) as error:
        if "google::cloud::Status" not in str(error):
            raise
        kind = type(error) if isinstance(error, OSError) else OSError
        raise kind(plain(str(error))) from None


def plain(text: str) -> str:
    """One line of a google::cloud::Status, with a remedy where credentials are at fault."""
    if "google::cloud::Status" not in text:
        return text
    found = _REASON.search(text)
    why = " ".join((found[1] if found else text).split())[:200].rstrip(". ")
    if "access token" in text or re.search(r"UNAUTHENTICATED|PERMISSION_DENIED", text):
        return (
            f"Google Cloud answers: {why}. Log in with `gcloud auth application-default login`, or set "
            "GOOGLE_APPLICATION_CREDENTIALS to the key of an account that may"
        )
    return why
