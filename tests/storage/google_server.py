"""A server that speaks Google Cloud Storage, on loopback: moto's S3 under the names of Google's XML API."""

from __future__ import annotations

import threading
from contextlib import contextmanager
from typing import TYPE_CHECKING, Any

import pytest

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator


_ANYONE = "AWS4-HMAC-SHA256 Credential=test/20260101/us-east-1/s3/aws4_request, SignedHeaders=host, Signature=0"
"""moto gives private objects to anyone who signs."""


def as_google(serve_s3: Callable[..., Any]) -> Callable[..., Any]:
    """cloud.google.com/storage/docs/xml-api/reference-headers: an object is in a state by its generation, a number."""
    tags: dict[str, str] = {}

    def serve(environ: dict[str, Any], start: Callable[..., Any]) -> Any:
        environ["HTTP_AUTHORIZATION"] = _ANYONE
        generation = environ.pop("HTTP_X_GOOG_IF_GENERATION_MATCH", None)
        if generation == "0":
            environ["HTTP_IF_NONE_MATCH"] = "*"
        elif generation:
            environ["HTTP_IF_MATCH"] = tags.get(generation, '"of no state"')
        if source := environ.pop("HTTP_X_GOOG_COPY_SOURCE", None):
            environ["HTTP_X_AMZ_COPY_SOURCE"] = source

        def answer(status: str, headers: list[tuple[str, str]], *more: Any) -> Any:
            for tag in [value for name, value in headers if name.lower() == "etag"]:
                number = str(int(tag.strip('"')[:12], 16) + 1)
                tags[number] = tag
                headers = [*headers, ("x-goog-generation", number)]
            return start(status, headers, *more)

        return serve_s3(environ, answer)

    return serve


@contextmanager
def serving() -> Iterator[str]:
    """With a bucket named `bucket`, found by all that ask for gs://; its address."""
    pytest.importorskip("moto.server", reason="moto serves objects on loopback: pip install 'moto[server]'")
    from moto.moto_server.werkzeug_app import DomainDispatcherApplication, create_backend_app
    from obstore.store import HTTPStore
    from werkzeug.serving import WSGIRequestHandler, make_server

    class Quiet(WSGIRequestHandler):
        def log(self, type: str, message: str, *args: Any) -> None:
            pass

    app = as_google(DomainDispatcherApplication(create_backend_app))
    server = make_server("127.0.0.1", 0, app, threaded=True, request_handler=Quiet)
    thread = threading.Thread(target=server.serve_forever, daemon=True)
    thread.start()
    address = f"http://127.0.0.1:{server.server_port}"
    HTTPStore(address, client_options={"allow_http": True}).put("bucket", b"")
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("STORAGE_EMULATOR_HOST", address)
        yield address
    server.shutdown()
    server.server_close()
    thread.join()
