"""A server that speaks S3, on loopback."""

from __future__ import annotations

import os
import tempfile
import threading
from collections import Counter
from contextlib import closing, contextmanager
from http.client import HTTPConnection
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Iterator


@contextmanager
def serving() -> Iterator[None]:
    """With a bucket named `bucket`, found by all that ask for S3."""
    moto = pytest.importorskip("moto.server", reason="moto speaks S3 on loopback: pip install 'moto[server]'")
    from moto import backends
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication
    from obstore.store import HTTPStore

    answer, one_at_a_time = DomainDispatcherApplication.__call__, threading.Lock()

    def answer_in_turn(self: DomainDispatcherApplication, environ: dict[str, str], start: Any) -> Any:
        if environ["REQUEST_METHOD"] != "PUT":
            return answer(self, environ, start)
        with one_at_a_time:  # moto checks a condition in one step and writes in another: two writers pass at once
            return answer(self, environ, start)

    modules = list(backends.list_of_moto_modules())  # which moto lists by the folders on disk, twice a request
    started = moto.ThreadedMotoServer(ip_address="127.0.0.1", port=0, verbose=False)
    started.start()
    host, port = started.get_host_and_port()
    with pytest.MonkeyPatch.context() as patch, tempfile.TemporaryDirectory() as cache:
        patch.setattr(DomainDispatcherApplication, "__call__", answer_in_turn)
        patch.setattr(backends, "list_of_moto_modules", lambda: modules)
        patch.setenv("VPLOG_CACHE", cache)  # not the user's
        patch.setenv("AWS_ENDPOINT_URL", f"http://{host}:{port}")
        patch.setenv("AWS_ACCESS_KEY_ID", "test")
        patch.setenv("AWS_SECRET_ACCESS_KEY", "test")
        patch.setenv("AWS_REGION", "us-east-1")
        HTTPStore(f"http://{host}:{port}", client_options={"allow_http": True}).put("bucket", b"")
        yield
    started.stop()


def make_folder(name: str) -> None:
    """The empty object by which the console of a store shows a folder: obstore cannot spell its name, as it ends in
    a slash."""
    with closing(HTTPConnection(os.environ["AWS_ENDPOINT_URL"].removeprefix("http://"))) as server:
        server.request("PUT", f"/bucket/{name}/")
        assert server.getresponse().status == 200


@contextmanager
def counting() -> Iterator[Counter[str]]:
    """The requests that the server gets meanwhile, by kind."""
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication

    asked, answer = Counter[str](), DomainDispatcherApplication.__call__

    def counted(self: DomainDispatcherApplication, environ: dict[str, str], start: Any) -> Any:
        kind = environ["REQUEST_METHOD"]
        if "list-type" in environ.get("QUERY_STRING", ""):
            kind = "LIST"
        asked["COPY" if "HTTP_X_AMZ_COPY_SOURCE" in environ else kind] += 1
        return answer(self, environ, start)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(DomainDispatcherApplication, "__call__", counted)
        yield asked
