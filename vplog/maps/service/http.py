"""`vplog map serve`: queries and localisations of a map over HTTP.

    GET  /map         the map: drives, places, recogniser, library
    POST /query       the places most like an image, or like the views of a descriptors.parquet, which is the body
    POST /localize    the pose of an image, which is the body

`GET /openapi.json` describes them. Nothing is written but the map's index and landmarks, which are made once. Bodies
are held to `Limits`, and what comes while all places in the queue are taken is refused with 503.
"""

from __future__ import annotations

import asyncio
import socket
import threading
from collections.abc import AsyncIterator, Callable
from contextlib import asynccontextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Annotated, Any

import anyio.to_thread
import numpy as np
import uvicorn
from fastapi import FastAPI, HTTPException, Query, Request
from fastapi.responses import JSONResponse
from starlette.types import ASGIApp, Receive, Scope, Send

from vplog import logs
from vplog.data import Camera, Frame
from vplog.errors import LibraryError, VplogError
from vplog.execution.execution import Execution
from vplog.logs import TopicChoice
from vplog.maps.geo_bounds import box_around
from vplog.maps.localization.localize import described, localize_frame
from vplog.maps.search.query import MapQuery
from vplog.maps.service.open_state import NewestState, OpenState, UnreadableMapError
from vplog.maps.storage.contents import damage_warnings
from vplog.maps.storage.damage import DamagedDriveError, UnreachableError
from vplog.results import tables
from vplog.stages import FrameState
from vplog.storage.scratch import scratch
from vplog.version import __version__

_PARQUET = b"PAR1"
_CONNECTIONS = 8
"""Connections for each request that may be open: clients leave those that are idle open for later requests."""
_OF_THE_MAP = (UnreadableMapError, DamagedDriveError, UnreachableError)
"""Errors that another query would meet, too: 503, and not 400."""


@dataclass(frozen=True)
class Limits:
    """Limits of the service."""

    threads: int = 1
    """Requests that are worked on at once, beside one localisation."""
    waiting: int = 64
    """Requests that are open at once, those that wait included."""
    megabytes: float = 16.0
    """Longest body; `waiting` of them are in memory at most."""
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
    app = FastAPI(title="vplog map", version=__version__, lifespan=_lifespan(newest, limits), docs_url=None)
    app.router.redirect_slashes = False
    app.add_middleware(_BoundedRequests, most=limits.waiting)

    @app.exception_handler(VplogError)
    async def refused(_: Request, error: VplogError) -> JSONResponse:
        return JSONResponse({"detail": str(error)}, 503 if isinstance(error, _OF_THE_MAP) else 400)

    @app.get("/map")
    def about() -> dict[str, Any]:
        now = newest.now
        warnings = [*now.warnings, *damage_warnings(now.store), *filter(None, [newest.problem])]
        return {
            "map": str(newest.root), "vplog": __version__, "drives": len(now.drives), "places": now.places,
            "recogniser": now.pipeline.places.kind, "library": now.state.hash, "warnings": warnings,
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
        body, chosen = await _body(request, limits), MapQuery(top, drives=drive or ())
        if box is not None:
            south, west, north, east = map(float, box.split(","))
            chosen = replace(chosen, box=(south, west, north, east))
        if near is not None:
            latitude, longitude, radius_m = map(float, near.split(","))
            chosen = replace(chosen, box=box_around(latitude, longitude, latitude, longitude, radius_m))
        return await anyio.to_thread.run_sync(_answered, newest.now, body, chosen, limits)

    @app.post("/localize")
    async def localize(
        request: Request, fx: float | None = None, fy: float | None = None, cx: float | None = None,
        cy: float | None = None,
    ) -> dict[str, Any]:  # fmt: skip
        """The pose of an image, by the intrinsics in px of its undistorted camera, or by the service's calibration."""
        body, intrinsics = await _body(request, limits), (fx, fy, cx, cy)
        one_at_a_time = request.state.one_at_a_time  # those that wait hold none of the threads
        return await anyio.to_thread.run_sync(_localized, newest, body, intrinsics, calibration, limiter=one_at_a_time)

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
    """Look for newer states in a thread, and bound those of the requests."""
    ended = threading.Event()

    def refresh() -> None:
        while not ended.wait(limits.refresh_s):
            newest.refresh()

    @asynccontextmanager
    async def lifespan(_: FastAPI) -> AsyncIterator[dict[str, Any]]:
        anyio.to_thread.current_default_thread_limiter().total_tokens = limits.threads
        thread = threading.Thread(target=refresh, daemon=True)
        thread.start()
        yield {"one_at_a_time": anyio.CapacityLimiter(1)}
        ended.set()

    return lifespan


async def _body(request: Request, limits: Limits) -> bytes:
    """The body of a request. Raises HTTPException where it is longer, or comes more slowly, than the limits say."""
    most, blocks, count = int(limits.megabytes * 1e6), [], 0
    try:
        async with asyncio.timeout(limits.seconds):
            async for block in request.stream():
                count += len(block)
                if count > most:
                    raise HTTPException(413, f"The body has more than {limits.megabytes:g} MB.")
                blocks.append(block)
    except TimeoutError:
        raise HTTPException(408, f"The body took longer than {limits.seconds:g} s.") from None
    if not count:
        raise HTTPException(400, "The body is empty. It is an image, or a descriptors.parquet.")
    return b"".join(blocks)


def _answered(now: OpenState, body: bytes, query: MapQuery, limits: Limits) -> dict[str, Any]:
    with scratch("request") as folder:
        if body.startswith(_PARQUET):
            descriptors = _descriptors(now, folder / "descriptors.parquet", body, limits)
        else:
            frame = _frame(folder / "image", body, None, isinstance(now.state, FrameState) and now.state.colour)
            descriptors = [described(now.state, now.pipeline.features, frame, str(now.store)).descriptor]
    answers, warnings = now.answers(descriptors, query)
    return {"library": now.state.hash, "views": len(descriptors), "answers": answers, "warnings": warnings}


def _descriptors(now: OpenState, path: Path, body: bytes, limits: Limits) -> list[Any]:
    path.write_bytes(body)
    column, made_by = tables.read_descriptors(path)
    if made_by != now.state.hash:
        raise LibraryError(f"The descriptors are of library {made_by[:12]}, the map's is {now.state.hash[:12]}.")
    if len(column) > limits.views:
        raise HTTPException(413, f"{len(column)} views are more than {limits.views}. Ask for fewer at a time.")
    return list(now.state.from_arrow(column))


def _frame(path: Path, body: bytes, calibration: Path | None, colour: bool = False) -> Frame:
    path.write_bytes(body)
    if not logs.is_image_file(path):
        raise HTTPException(400, "The body is neither an image nor a descriptors.parquet.")
    log = logs.open_images([path], TopicChoice(calibration_file=calibration))
    return next(iter(log.frames(log.stamps()))).decode(colour)


def _localized(
    newest: NewestState, body: bytes, intrinsics: tuple[float | None, ...], calibration: Path | None
) -> dict[str, Any]:
    with scratch("request") as folder:
        frame = _frame(folder / "image", body, calibration, colour=True)
    if (own := [one for one in intrinsics if one is not None]) and len(own) == 4:
        K = np.array([[own[0], 0.0, own[2]], [0.0, own[1], own[3]], [0.0, 0.0, 1.0]])
        height, width = frame.image.shape
        frame = replace(frame, camera=Camera("camera", K, "none", np.zeros(0), width, height, np.eye(4)))
    elif own:
        raise HTTPException(400, "Intrinsics are fx, fy, cx and cy together.")
    return localize_frame(newest.localized_in(), frame, Execution()).record()
