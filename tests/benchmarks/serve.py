"""`vplog map serve` over a made-up city: places described elsewhere are looked for near where they are said to be.

Clients keep connections open and ask for the places of one view each, near a point, while a writer puts drives into the
map. Server, clients and writer share the cores. A second benchmark sends images that are small files and large in
memory, twenty at a time, and reads the peak memory of the server.
"""

from __future__ import annotations

import io
import json
import math
import re
import signal
import struct
import subprocess
import sys
import threading
import time
import zlib
from collections import Counter
from contextlib import contextmanager
from http.client import HTTPConnection
from pathlib import Path
from typing import TYPE_CHECKING, Any

import mcap.writer
import numpy as np

from tests.benchmarks.measure import Figure
from tests.benchmarks.scale import made_up_library, write_drive, write_map
from tests.benchmarks.search import DRIVE, make_places, make_queries
from vplog.data import Keyframes
from vplog.maps.storage.map_store import Head, Store
from vplog.pipeline import load_pipeline
from vplog.places.bobb import BobbSettings, BobbState, Place
from vplog.results import run_record, tables

if TYPE_CHECKING:
    from collections.abc import Iterator

BARS = (50.0, 1.0)
"""Queries a second, and s within which 99 % are answered."""
MEMORY_GB, HOSTILE = 1.5, 20
"""Largest resident memory of the server, and hostile requests that are sent at once."""
CLIENTS, LASTS_S, RADIUS_M = 8, 30.0, 500.0
_CELL_DEG = 0.02
"""Side of the square that a drive of two kilometres lies in."""


def serve(count: int, folder: Path) -> Iterator[Figure]:
    """Throughput and latency with pruning by place and without, of a map of `count` places made in `folder`."""
    settings = BobbSettings()
    state, store = made_up_library(settings), Store(folder / f"map-{count}")
    sample = write_map(store, count, state)
    _finish(store, state, -(-count // DRIVE))
    bodies, began = _bodies(folder, state, make_queries(sample, 32, settings)), time.monotonic()
    with _server(store.root) as (_, at):
        opened_s = time.monotonic() - began
        for near in (True, False):
            rate, latency, facts = _load(at, bodies, store, state, near)
            facts |= {"places": count, "opened_s": round(opened_s, 1), "clients": CLIENTS}
            how = f"within {RADIUS_M:g} m" if near else "in all"
            yield Figure(f"map serve, {count:,} places, {how}: queries a second", rate, BARS[0] * near, False, facts)
            bar = BARS[1] if near else None
            yield Figure(f"map serve, {count:,} places, {how}: s of 99 % of the answers", latency, bar, True, facts)


def hostile(folder: Path) -> Iterator[Figure]:
    """Peak memory of the server after HOSTILE requests at once with each kind of hostile body, in GB."""
    state, store = made_up_library(BobbSettings()), Store(folder / "map-hostile")
    write_map(store, DRIVE, state)
    _finish(store, state, 1)
    png = _large_png(16_000, 16_000)
    bodies = {
        "a PNG of 16,000 x 16,000 px": png,
        "an MCAP file with six of them": _mcap(png, 6),
        "a PNG with a forged size of 64 x 64 px": png[:16] + _ihdr(64, 64) + png[33:],
        "a PNG with a forged size of 16,000 x 16,000 px": _large_png(64, 64, _ihdr(16_000, 16_000)),
        "a PNG of 6,000 x 6,000 px": _large_png(6_000, 6_000),
    }
    for name, body in bodies.items():
        with _server(store.root) as (server, at):
            before_gb, statuses, began = _peak_gb(server), Counter[int](), time.monotonic()

            def client(path: str, body: bytes = body, at: str = at, statuses: Counter[int] = statuses) -> None:
                connection = HTTPConnection(at, timeout=600)
                connection.request("POST", path, body)
                statuses[connection.getresponse().status] += 1

            paths = ["/query", "/localize?fx=8000&fy=8000&cx=8000&cy=8000"] * (HOSTILE // 2)
            threads = [threading.Thread(target=client, args=(path,)) for path in paths]
            for one in threads:
                one.start()
            for one in threads:
                one.join()
            facts = {
                "statuses": dict(statuses), "before_gb": before_gb, "body_mb": round(len(body) / 1e6, 1),
                "seconds": round(time.monotonic() - began, 1), "cpu_s": _cpu_s(server),
            }  # fmt: skip
            yield Figure(f"map serve, {HOSTILE} requests with {name}: GB", _peak_gb(server), MEMORY_GB, True, facts)


@contextmanager
def _server(root: Path) -> Iterator[tuple[subprocess.Popen[str], str]]:
    """`vplog map serve` of a map, and its host and port."""
    command = [sys.executable, "-m", "vplog", "map", "serve", str(root), "--port", "0"]
    server = subprocess.Popen(command, stderr=subprocess.PIPE, text=True)
    try:
        assert server.stderr is not None
        told = ""
        while not (found := re.search(r"http://([0-9.:]+)", told)):
            told = server.stderr.readline()
            assert told, "the server ended"
        threading.Thread(target=server.stderr.read, daemon=True).start()
        yield server, found[1]
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(60)


def _peak_gb(server: subprocess.Popen[str]) -> float:
    """Largest resident memory of a process so far."""
    status = Path(f"/proc/{server.pid}/status").read_text()
    return int(status.partition("VmHWM:")[2].split()[0]) * 1024 / 1e9


def _cpu_s(server: subprocess.Popen[str]) -> float:
    """Time that the processors have spent on a process."""
    ticks = Path(f"/proc/{server.pid}/stat").read_text().rpartition(")")[2].split()[11:13]
    return sum(map(int, ticks)) / 100


def _chunk(kind: bytes, data: bytes) -> bytes:
    return struct.pack(">I", len(data)) + kind + data + struct.pack(">I", zlib.crc32(kind + data))


def _ihdr(width: int, height: int) -> bytes:
    """What follows the length and the type of the header of an RGBA image: sizes, coding and checksum."""
    return _chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 6, 0, 0, 0))[8:]


def _large_png(width: int, height: int, header: bytes = b"") -> bytes:
    """A black, transparent RGBA image: a thousandth of the bytes that its pixels take."""
    packer = zlib.compressobj(9)
    rows = [packer.compress(bytes(1 + 4 * width)) for _ in range(height)]
    head = struct.pack(">I", 13) + b"IHDR" + (header or _ihdr(width, height))
    pixels = _chunk(b"IDAT", b"".join(rows) + packer.flush())
    return b"\x89PNG\r\n\x1a\n" + head + pixels + _chunk(b"IEND", b"")


def _mcap(png: bytes, count: int) -> bytes:
    """A recording with this image so many times."""
    stream = io.BytesIO()
    writer = mcap.writer.Writer(stream, compression=mcap.writer.CompressionType.NONE)
    writer.start()
    schema = writer.register_schema("sensor_msgs/msg/CompressedImage", "ros2msg", b"")
    channel = writer.register_channel("/camera/image/compressed", "cdr", schema)
    for number in range(count):
        text = b"png\0"
        message = b"\0\1\0\0" + struct.pack("<iI", number, 0) + struct.pack("<I", 1) + b"\0" + bytes(3)
        message += struct.pack("<I", len(text)) + text + struct.pack("<I", len(png)) + png
        writer.add_message(channel, number * 10**8, message, number * 10**8)
    writer.finish()
    return stream.getvalue()


def _place(number: int, drives: int) -> tuple[float, float]:
    """South-west corner of a drive of a square city at the equator, in degrees."""
    side = math.ceil(math.sqrt(drives))
    return (number // side) * _CELL_DEG, (number % side) * _CELL_DEG


def _finish(store: Store, state: BobbState, drives: int) -> None:
    """The library, map.json, and where each drive is."""
    if (store.root / "map.json").exists():
        return
    state.save(store.library(state.hash))
    for number, (drive, record) in enumerate(store.drives().items()):
        south, west = _place(number, drives)
        bounds = [south, west, south + _CELL_DEG, west + _CELL_DEG]
        run_record.write_run_json(store.run(drive) / "drive.json", {**record, "earth": {"bounds": bounds}})
    store.write_head(Head(state.hash, load_pipeline("default").model_dump(mode="json")))


def _bodies(folder: Path, state: BobbState, views: list[Place]) -> list[bytes]:
    """A descriptors.parquet of each view alone."""
    about, path, bodies = tables.TableMetadata({}, state.hash), folder / "view.parquet", []
    for view in views:
        keyframes = Keyframes("view", np.zeros(1, np.int64), np.eye(4)[None])
        tables.write_descriptors(path, keyframes, state.to_arrow([view]), about)
        bodies.append(path.read_bytes())
    return bodies


def _load(
    at: str, bodies: list[bytes], store: Store, state: BobbState, near: bool
) -> tuple[float, float, dict[str, Any]]:
    """Queries a second, s within which 99 % are answered, and what else was measured."""
    ended, spent, refused = time.monotonic() + LASTS_S, list[float](), [0]
    drives, written = sum("earth" in one for one in store.drives().values()), [0]

    def client(seed: int) -> None:
        random, connection = np.random.default_rng(seed), HTTPConnection(at, timeout=60)
        while time.monotonic() < ended:
            south, west = _place(int(random.integers(drives)), drives)
            where = f"&near={south + _CELL_DEG / 2:.6f},{west + _CELL_DEG / 2:.6f},{RADIUS_M:g}" if near else ""
            began = time.perf_counter()
            connection.request("POST", f"/query?top=10{where}", bodies[int(random.integers(len(bodies)))])
            answer = connection.getresponse()
            found = answer.read()
            spent.append(time.perf_counter() - began)
            refused[0] += answer.status == 503
            assert answer.status in (200, 503), found
            assert answer.status == 503 or json.loads(found)["answers"]

    def writer() -> None:
        while time.monotonic() < ended:
            write_drive(store, 10**8 + written[0], make_places(DRIVE, state.settings, seed=written[0]), state)
            written[0] += 1
            time.sleep(5.0)

    threads = [threading.Thread(target=client, args=(seed,)) for seed in range(CLIENTS)]
    threads.append(threading.Thread(target=writer))
    for one in threads:
        one.start()
    for one in threads:
        one.join()
    answered = np.sort(spent)
    facts = {
        "p50_ms": round(1000 * float(np.median(answered)), 1), "worst_ms": round(1000 * float(answered[-1]), 1),
        "refused": refused[0], "drives_written_meanwhile": written[0],
    }  # fmt: skip
    return len(answered) / LASTS_S, float(np.quantile(answered, 0.99)), facts
