"""`vplog map serve` over a made-up city: places described elsewhere are looked for near where they are said to be.

Clients keep connections open and ask for the places of one view each, near a point, while a writer puts drives into the
map. Server, clients and writer share the cores.
"""

from __future__ import annotations

import json
import math
import re
import signal
import subprocess
import sys
import threading
import time
from http.client import HTTPConnection
from typing import TYPE_CHECKING, Any

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
    from pathlib import Path

BARS = (50.0, 1.0)
"""Queries a second, and s within which 99 % are answered."""
CLIENTS, LASTS_S, RADIUS_M = 8, 30.0, 500.0
_CELL_DEG = 0.02
"""Side of the square that a drive of two kilometres lies in."""


def serve(count: int, folder: Path) -> Iterator[Figure]:
    """Throughput and latency with pruning by place and without, of a map of `count` places made in `folder`."""
    settings = BobbSettings()
    state, store = made_up_library(settings), Store(folder / f"map-{count}")
    sample = write_map(store, count, state)
    _finish(store, state, -(-count // DRIVE))
    bodies = _bodies(folder, state, make_queries(sample, 32, settings))
    command = [sys.executable, "-m", "vplog", "map", "serve", store.root, "--port", "0"]
    server = subprocess.Popen(list(map(str, command)), stderr=subprocess.PIPE, text=True)
    try:
        assert server.stderr is not None
        told, began = "", time.monotonic()
        while not (found := re.search(r"http://([0-9.:]+)", told)):
            told = server.stderr.readline()
            assert told, "the server ended"
        threading.Thread(target=server.stderr.read, daemon=True).start()
        opened_s = time.monotonic() - began
        for near in (True, False):
            rate, latency, facts = _load(found[1], bodies, store, state, near)
            facts |= {"places": count, "opened_s": round(opened_s, 1), "clients": CLIENTS}
            how = f"within {RADIUS_M:g} m" if near else "in all"
            yield Figure(f"map serve, {count:,} places, {how}: queries a second", rate, BARS[0] * near, False, facts)
            bar = BARS[1] if near else None
            yield Figure(f"map serve, {count:,} places, {how}: s of 99 % of the answers", latency, bar, True, facts)
    finally:
        server.send_signal(signal.SIGINT)
        server.wait(60)


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
