"""`vplog map serve`: queries and localisations of a map over HTTP.

    GET  /map         the map: drives, places, recogniser, library
    POST /query       the places most like an image, or like the views of a descriptors.parquet, which is the body
    POST /localize    the pose of an image, which is the body

`GET /openapi.json` describes them. Nothing is written but the map's index and landmarks, which are made once.

`Limits` bounds the memory of the service. A body goes to a file while it arrives. Its header says how much memory it
takes when it is decoded, and it is decoded only while all decoded bodies together take at most `decoded_mb`. A body
that takes more by itself is refused with 413. A request that comes while `waiting` others are open is refused with 503.
"""

from __future__ import annotations

import asyncio
import logging
import math
import re
import socket
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Annotated, Any

import anyio.to_thread
import numpy as np
import uvicorn
from fastapi import FastAPI, HTTPException, Query, Request, Response
from fastapi.responses import JSONResponse
from starlette.requests import ClientDisconnect
from starlette.types import ASGIApp, Receive, Scope, Send

from vplog.data import Camera, Floats, Frame
from vplog.errors import LibraryError, VplogError
from vplog.execution.execution import Execution
from vplog.logs.calibration_file import camera_for, read_calibrations
from vplog.logs.cameras import camera_of, resized
from vplog.logs.formats.container import Notes
from vplog.logs.messages import pixels
from vplog.logs.messages.records import BadMessageError, ImageMessage
from vplog.maps.geo_bounds import box_around
from vplog.maps.localization.localize import described, localize_frame
from vplog.maps.search.query import MapQuery
from vplog.maps.service.open_state import NewestState, UnreadableMapError
from vplog.maps.storage.contents import damage_warnings
from vplog.maps.storage.damage import DamagedDriveError, UnreachableError
from vplog.results import tables
from vplog.stages import FrameState, PlaceState
from vplog.storage.image_file import decoding_bytes, image_size
from vplog.storage.parquet_limits import open_table, unpacked_bytes
from vplog.storage.scratch import scratch
from vplog.version import __version__

_log = logging.getLogger("uvicorn.error")  # which writes to stderr, as the server's own messages do

_PARQUET = b"PAR1"
_LEAST_PX = 2**21
"""Least px of a JPEG that is decoded at reduced size: four times the 0.52 megapixels that features are found in."""
_COPIES = 4
"""Copies of the descriptors of a body in memory, at most: as read, joined, as arrays, and as they are compared."""
_CONNECTIONS = 8
"""Connections for each request that may be open: clients leave those that are idle open for later requests."""
_OF_THE_MAP = (UnreadableMapError, DamagedDriveError, UnreachableError)
"""Errors that another query would meet, too: 503, and not 400."""


@dataclass(frozen=True)
class Limits:
    """Limits of the service."""

    threads: int = 2
    """Queries that are worked on at once, beside one localisation."""
    waiting: int = 64
    """Requests that are open at once, those that wait included."""
    megabytes: float = 16.0
    """Longest body in MB (10^6 bytes); at most `waiting` of them are on the disk."""
    decoded_mb: float = 768.0
    """Largest memory in MB that the decoded bodies of all requests take together."""
    seconds: float = 30.0
    """Longest time that a body may take to come."""
    views: int = 1000
    """Most views of a descriptors.parquet."""
    refresh_s: float = 10.0
    """Time between looks for a newer state of the map."""


def serve(
    newest: NewestState, host: str, port: int, limits: Limits, calibration: Path | None = None,
    ready: Callable[[str], object] = print,
) -> None:  # fmt: skip
    """Answer until the process is interrupted. Raises OSError where the address is taken."""
    settings = uvicorn.Config(
        application(newest, limits, calibration), host, port, log_level="warning", access_log=False,
        limit_concurrency=_CONNECTIONS * limits.waiting, timeout_graceful_shutdown=10,
    )  # fmt: skip
    with socket.create_server((host, port)) as listening:
        ready("http://{}:{}".format(*listening.getsockname()))
        uvicorn.Server(settings).run([listening])


def application(newest: NewestState, limits: Limits, calibration: Path | None = None) -> FastAPI:
    """The service as an ASGI application. `calibration` is the camera of pictures that tell none."""
    app = FastAPI(
        title="vplog map", version=__version__, lifespan=_lifespan(newest, limits), docs_url=None, redoc_url=None
    )
    app.router.redirect_slashes = False
    app.add_middleware(_BoundedRequests, most=limits.waiting)

    @app.exception_handler(VplogError)
    async def refused(_: Request, error: VplogError) -> JSONResponse:
        status = 503 if isinstance(error, _OF_THE_MAP) else 400
        return JSONResponse({"detail": _without_folders(str(error), newest.root)}, status)

    @app.exception_handler(ClientDisconnect)
    async def gone(*_: object) -> Response:
        return Response()  # nobody reads it

    @app.get("/map")
    def about() -> dict[str, Any]:
        now = newest.now
        warnings = [*now.warnings, *damage_warnings(now.store), *filter(None, [newest.problem])]
        return {
            "map": newest.root.name, "vplog": __version__, "drives": len(now.drives), "places": now.places,
            "recogniser": now.pipeline.places.kind, "library": now.state.hash,
            "warnings": [_without_folders(one, newest.root) for one in warnings],
        }  # fmt: skip

    @app.post("/query")
    async def query(
        request: Request,
        top: Annotated[int, Query(ge=1, le=1000)] = 10,
        drive: Annotated[list[str] | None, Query()] = None,
        box: Annotated[str | None, Query(pattern=_numbers(4), description="LAT0,LON0,LAT1,LON1")] = None,
        near: Annotated[str | None, Query(pattern=_numbers(3), description="LAT,LON,M")] = None,
    ) -> dict[str, Any]:
        """The `top` places most like an image (JPEG, PNG, WebP, BMP, TIFF, PNM), or like each view of a
        descriptors.parquet of the map's library; of some drives, or near a place on earth."""
        chosen = MapQuery(top, drives=drive or ())
        if box is not None:
            south, west, north, east = map(float, box.split(","))
            chosen = replace(chosen, box=(south, west, north, east))
        if near is not None:
            latitude, longitude, radius_m = map(float, near.split(","))
            chosen = replace(chosen, box=box_around(latitude, longitude, latitude, longitude, radius_m))
        return await _worked_on(request, limits, request.state.queries, partial(_answered, newest, chosen))

    @app.post("/localize")
    async def localize(
        request: Request, fx: float | None = None, fy: float | None = None, cx: float | None = None,
        cy: float | None = None,
    ) -> dict[str, Any]:  # fmt: skip
        """The pose of an image, by the intrinsics in px of its undistorted camera, or by the service's calibration."""
        work = partial(_localized, newest, _matrix(fx, fy, cx, cy), calibration)
        return await _worked_on(request, limits, request.state.localisations, work)

    return app


class _BoundedRequests:
    """Middleware that refuses requests while `most` are open, those that wait included."""

    def __init__(self, app: ASGIApp, most: int) -> None:
        self._app, self._most, self._open = app, most, 0

    async def __call__(self, scope: Scope, receive: Receive, send: Send) -> None:
        if scope["type"] != "http":
            await self._app(scope, receive, send)
            return
        if self._open >= self._most:
            why = f"{self._open} requests are open already. Ask again later."
            await JSONResponse({"detail": why}, 503, {"connection": "close"})(scope, receive, send)
            return
        self._open += 1
        try:
            await self._app(scope, receive, send)
        finally:
            self._open -= 1


def _numbers(count: int) -> str:
    """Pattern of numbers with commas between."""
    return "^" + ",".join([r"-?\d{1,8}(\.\d{1,12})?"] * count) + "$"


def _lifespan(newest: NewestState, limits: Limits) -> Any:
    """Look for newer states in a thread, and make what the requests share."""
    ended = threading.Event()

    def refresh() -> None:
        while not ended.wait(limits.refresh_s):
            try:
                newest.refresh()
            except Exception:  # a fault of ours: `newest.problem` says it, and the next look may succeed
                _log.exception("The newest state of the map cannot be opened. Trying again in %g s.", limits.refresh_s)

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[dict[str, Any]]:
        anyio.to_thread.current_default_thread_limiter().total_tokens = limits.threads + 2  # a localisation, and /map
        queries, localisations = asyncio.Semaphore(limits.threads), asyncio.Semaphore(1)
        thread = threading.Thread(target=refresh, daemon=True)
        thread.start()
        yield {"queries": queries, "localisations": localisations, "memory": _SharedMemory(limits.decoded_mb)}
        ended.set()

    return lifespan


class _SharedMemory:
    """Memory that requests reserve for what they decode."""

    def __init__(self, most_mb: float) -> None:
        self._most_mb, self._free_mb, self._changed = most_mb, most_mb, asyncio.Condition()

    @asynccontextmanager
    async def reserved(self, needed_mb: float) -> AsyncIterator[None]:
        """Wait until so much is free, and hold it for the block. Raises HTTPException if that is never so."""
        if needed_mb > self._most_mb:
            text = f"The body takes {needed_mb:.0f} MB of memory when it is decoded. The limit is {self._most_mb:g} MB."
            raise HTTPException(413, f"{text} Send a smaller image, or a JPEG.")
        async with self._changed:
            await self._changed.wait_for(lambda: self._free_mb >= needed_mb)
            self._free_mb -= needed_mb
        try:
            yield
        finally:
            async with self._changed:
                self._free_mb += needed_mb
                self._changed.notify_all()


async def _worked_on(
    request: Request, limits: Limits, slots: asyncio.Semaphore, work: Callable[[Path], dict[str, Any]]
) -> dict[str, Any]:
    """Return the result of `work`, which takes the file of the body, in a thread, while there is memory for it."""
    with scratch("request") as folder:
        body = folder / "body"
        await _receive(request, body, limits)
        async with slots:  # those that wait hold neither a thread nor memory
            needed_mb = await anyio.to_thread.run_sync(_decoded_mb, body, limits)
            async with request.state.memory.reserved(needed_mb):
                return await anyio.to_thread.run_sync(work, body)


async def _receive(request: Request, path: Path, limits: Limits) -> None:
    """Write the body of a request to a file. Raises HTTPException if it is longer, or comes more slowly, than the
    limits say."""
    count = 0
    try:
        async with asyncio.timeout(limits.seconds):
            with path.open("wb") as file:
                async for block in request.stream():
                    count += len(block)
                    if count > limits.megabytes * 1e6:
                        raise HTTPException(413, f"The body has more than {limits.megabytes:g} MB.")
                    file.write(block)
    except TimeoutError:
        raise HTTPException(408, f"The body took longer than {limits.seconds:g} s.") from None
    if not count:
        raise HTTPException(400, "The body is empty. It is an image, or a descriptors.parquet.")


def _decoded_mb(body: Path, limits: Limits) -> float:
    """Return the memory that a body takes when it is decoded, by its header."""
    data = body.read_bytes()
    if not data.startswith(_PARQUET):
        return decoding_bytes(data, _LEAST_PX) / 1e6
    with tables.reading("The descriptors.parquet", ""), open_table(body) as file:
        if (views := file.metadata.num_rows) > limits.views:
            raise HTTPException(413, f"{views} views are more than {limits.views}. Ask for fewer at a time.")
        return _COPIES * unpacked_bytes(file, ["descriptor"]) / 1e6


def _answered(newest: NewestState, query: MapQuery, body: Path) -> dict[str, Any]:
    now, data = newest.now, body.read_bytes()
    if data.startswith(_PARQUET):
        descriptors = _descriptors(now.state, body)
    else:
        frame = _frame(data, _camera(data, None, None), now.state)
        descriptors = [described(now.state, now.pipeline.features, frame, newest.root.name).descriptor]
    answers, warnings = now.answers(descriptors, query)
    warnings = [_without_folders(one, newest.root) for one in warnings]
    return {"library": now.state.hash, "views": len(descriptors), "answers": answers, "warnings": warnings}


def _descriptors(state: PlaceState, body: Path) -> list[Any]:
    column, made_by = tables.read_descriptors(body)
    if made_by != state.hash:
        raise LibraryError(f"The descriptors are of library {made_by[:12]}, the map's is {state.hash[:12]}.")
    return list(state.from_arrow(column))


def _localized(newest: NewestState, matrix: Floats | None, calibration: Path | None, body: Path) -> dict[str, Any]:
    data = body.read_bytes()
    frame = _frame(data, _camera(data, matrix, calibration), newest.now.state)
    found = localize_frame(newest.localized_in(), frame, Execution()).record()
    return {**found, "sentence": _without_folders(found["sentence"], newest.root)}


def _matrix(*intrinsics: float | None) -> Floats | None:
    """Return the matrix of fx, fy, cx and cy; None without any of them. Raises HTTPException."""
    given = [one for one in intrinsics if one is not None]
    if not given:
        return None
    if len(given) < len(intrinsics) or not all(map(math.isfinite, given)) or min(given[:2]) <= 0:
        raise HTTPException(400, "Intrinsics are fx, fy, cx and cy together, in px, with fx and fy above 0.")
    fx, fy, cx, cy = given
    return np.array([[fx, 0.0, cx], [0.0, fy, cy], [0.0, 0.0, 1.0]])


def _camera(data: bytes, matrix: Floats | None, calibration: Path | None) -> Camera:
    """Return the camera of an image file: by its matrix, else by the calibration file, else uncalibrated. Raises
    HTTPException if the bytes are no image."""
    if (size := image_size(data)) is None:
        raise HTTPException(400, "The body is neither an image nor a descriptors.parquet.")
    if matrix is not None or calibration is None:
        return Camera("camera", matrix, "none", np.zeros(0), *size, np.eye(4))
    known = camera_for(read_calibrations(calibration), "camera", calibration)
    return camera_of("camera", known.calibration, size, Notes())


def _frame(data: bytes, camera: Camera, state: PlaceState) -> Frame:
    """Decode an image file, a large JPEG at reduced size, with its camera scaled along. Raises HTTPException."""
    message, colour = ImageMessage(0, "", "", data, compressed=True), isinstance(state, FrameState) and state.colour
    try:
        image = pixels.grey(message, least_px=_LEAST_PX)
        rgb = pixels.rgb(message, least_px=_LEAST_PX) if colour else None
    except BadMessageError as error:
        raise HTTPException(400, f"The image cannot be decoded: {error}.") from None
    eighths = round(8 * max(image.shape) / max(camera.width, camera.height))  # libjpeg reduces to M/8
    matrix = None if camera.matrix is None else resized(eighths / 8, eighths / 8) @ camera.matrix
    height, width = image.shape
    return Frame(0, replace(camera, matrix=matrix, width=width, height=height), image, colour=rgb)


def _without_folders(text: str, root: Path) -> str:
    """Return a sentence with the names of files alone: where they lie on the server is no client's business."""
    return re.sub(r"(?<![\w.])(?:[a-z][a-z0-9+.-]*:/)?/(?:[^\s/]+/)+", "", text.replace(str(root), root.name))
