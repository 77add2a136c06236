"""A server that speaks Google Cloud Storage, on loopback."""

from __future__ import annotations

import subprocess
import sys
from contextlib import contextmanager
from typing import TYPE_CHECKING

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator

# pyarrow holds Python's lock while it opens a file, so that a server in the same process could not answer; and it asks
# for a range while the answer to another request is under way, so that one thread would not do. What the server keeps
# is made for one thread: one change at a time.
_SERVE = """
import sys, threading
from http import server
server.HTTPServer = server.ThreadingHTTPServer
from gcp_storage_emulator.server import RequestHandler, create_server
lock = threading.Lock()
def alone(method):
    def locked(self):
        with lock:
            method(self)
    return locked
for name in ("do_POST", "do_PUT", "do_PATCH", "do_DELETE"):
    setattr(RequestHandler, name, alone(getattr(RequestHandler, name)))
started = create_server("127.0.0.1", 0, in_memory=True, default_bucket="bucket")
started.start()
print(started._api._httpd.server_address[1], flush=True)
sys.stdin.read()
started.stop()
"""


@contextmanager
def serving() -> Iterator[str]:
    """With a bucket named `bucket`, found by all that ask for gs://; its address."""
    pytest.importorskip("gcp_storage_emulator", reason="speaks gs:// on loopback: pip install gcp-storage-emulator")
    process = subprocess.Popen(
        [sys.executable, "-c", _SERVE], stdin=subprocess.PIPE, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL
    )
    assert process.stdin is not None
    assert process.stdout is not None
    try:
        address = f"http://127.0.0.1:{int(process.stdout.readline())}"
        with pytest.MonkeyPatch.context() as patch:
            patch.setenv("STORAGE_EMULATOR_HOST", address)
            yield address
    finally:
        process.stdin.close()
        process.wait(60)
        process.stdout.close()
