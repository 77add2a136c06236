"""A batch over Ray: the bytes of a batch on one machine, on nodes that share nothing, whoever is killed meanwhile."""

from __future__ import annotations

import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import threading
import time
from concurrent.futures import BrokenExecutor
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.batch.test_batch import OPTIONS, QUICK, tables
from tests.conftest import TINY
from vplog.batch import batch, ray_cluster, ray_engine
from vplog.batch.batch import run_batch
from vplog.batch.engine import BatchOptions
from vplog.batch.ray_cluster import ClusterHead
from vplog.batch.ray_engine import translated
from vplog.errors import SettingsError
from vplog.execution.execution import Execution
from vplog.maps.search.exact import Shard
from vplog.maps.storage.remote_map import StoredFile
from vplog.pipeline import load_pipeline
from vplog.results.run_record import read_run_json
from vplog.storage.scratch import scratch
from vplog.verbs.demo import SMALL, make_drive

if TYPE_CHECKING:
    from collections.abc import Iterator

ray = pytest.importorskip("ray", reason="needs Ray: pip install ray")

LONG = TINY.model_copy(update={"frame_rate_hz": 4.5, "width": 160, "height": 90})
"""Three times the frames of the others, which is more than one part, on a quarter of their pixels."""
SETTINGS = (*QUICK, "keyframes.distance_m=0.8")
STORE_BYTES = 80 * 2**20
"""The smallest that Ray takes is 75 MiB."""


@pytest.fixture(scope="module")
def logs(tiny_drives: list[Path], tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two short drives, a file that is none, and a longer drive."""
    folder = tmp_path_factory.mktemp("logs")
    for name, made in zip(("first", "second"), tiny_drives, strict=True):
        shutil.copy(made / "drive.mcap", folder / f"{name}.mcap")
    longer = LONG.model_copy(update={"seed": SMALL.seed + 2})
    make_drive(folder / "made", longer, Execution()).log.rename(folder / "third.mcap")
    (folder / "bad.mcap").write_bytes(b"no log at all")
    return [folder / f"{name}.mcap" for name in ("first", "bad", "second", "third")]


@pytest.fixture(scope="module")
def alone(compiled: None, logs: list[Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The map that four jobs on this machine make."""
    root = tmp_path_factory.mktemp("alone") / "map"
    told = run_batch(logs, root, load_pipeline("default", SETTINGS), None, None, Execution(4), BatchOptions(4))
    assert told["failed"] == 1
    return root


@pytest.fixture(scope="module")
def nodes(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Any, list[Path]]]:
    """A cluster of two nodes with a core each, which wants a token, and the temporary folder of each."""
    from ray.cluster_utils import Cluster

    places = [tmp_path_factory.mktemp("node") for _ in range(2)]
    with (
        # sockets need a short path
        tempfile.TemporaryDirectory(prefix="vray-", dir="/tmp", ignore_cleanup_errors=True) as folder,
        pytest.MonkeyPatch.context() as environment,
    ):
        environment.setenv("RAY_TMPDIR", folder)
        environment.setenv("RAY_AUTH_MODE", "token")
        environment.setenv("RAY_AUTH_TOKEN", "5" * 64)
        ray._raylet.Config.initialize("")  # Ray has read it before
        cluster = Cluster()
        for place in places:
            cluster.add_node(
                num_cpus=1, object_store_memory=STORE_BYTES, include_dashboard=False, env_vars={"TMPDIR": str(place)}
            )
        yield cluster, places
        cluster.shutdown()


def kill_one_at_work(places: list[Path], killed: list[int]) -> None:
    """The first worker that has begun a run folder, with SIGKILL."""
    while not killed:
        for account in (found for place in places for found in place.glob("vplog-*/run-*/run/run.json")):
            killed.append(int(account.parts[-3].split("-")[1]))
            os.kill(killed[0], signal.SIGKILL)
            return
        time.sleep(0.01)


def test_two_nodes_that_share_nothing_make_the_same_map_though_one_worker_is_killed(
    nodes: tuple[Any, list[Path]], logs: list[Path], alone: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Then a drive that is longer is added, its frames split over both nodes."""
    monkeypatch.setattr(ray_engine.RayEngine, "probe_shared_disk", lambda *_: None)  # nobody sees the map but the batch
    monkeypatch.setattr(ray_cluster, "_ANSWER_TIMEOUT_S", 600.0)
    (cluster, places), pipeline, root = nodes, load_pipeline("default", SETTINGS), tmp_path / "map"
    [library], (first_log, bad_log, second_log, long_log) = (alone / "libraries").iterdir(), logs
    killed: list[int] = []
    watch = threading.Thread(target=kill_one_at_work, args=(places, killed), daemon=True)
    watch.start()
    options = BatchOptions(engine="ray", address=cluster.address)
    told = run_batch([first_log, bad_log, second_log], root, pipeline, library, options=options)
    watch.join(300)
    assert killed
    assert [one["state"] for one in told["drives"]] == ["computed", "failed", "computed"], told
    first, bad, second = told["drives"]
    assert sorted([first["attempts"], second["attempts"]]) == [1, 2], "one was killed and tried again"
    assert bad["attempts"] <= 1
    assert "which no log does" in bad["error"]
    assert json.loads((root / "failures.json").read_text())["bad"]["attempts"] == bad["attempts"]
    assert all(one["peak_memory_mb"] > 50 for one in (first, second))

    told = run_batch(
        [first_log, second_log, long_log], root, pipeline, options=BatchOptions(engine="ray", address=cluster.address)
    )
    assert [one["state"] for one in told["drives"]] == ["unchanged", "unchanged", "computed"]
    stages = read_run_json(root / "runs" / "drive=third" / "run.json")["stages"]
    assert stages["extract"]["parts"] == stages["extract"]["parts_reused"] >= 2
    assert tables(root) == tables(alone)
    for folder in [path for place in places for path in place.glob("vplog-*")]:
        with scratch("next", folder):  # which node works next is Ray's choice
            assert not list(folder.glob("run-*"))
    assert not list(root.glob(".cache"))

    monkeypatch.setattr(batch, "made_by", lambda: {"code": "other", "versions": {}})
    told = run_batch([first_log], root, pipeline, options=BatchOptions(engine="ray", address=cluster.address))
    [refused] = told["drives"]
    assert (refused["state"], refused["attempts"]) == ("failed", 1)
    assert "has another vplog, or other packages" in refused["error"]


def test_segments_are_searched_by_the_node_that_has_them(
    nodes: tuple[Any, list[Path]], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray_cluster, "_ANSWER_TIMEOUT_S", 600.0)

    def node(_: Shard) -> str:
        return ray.get_runtime_context().get_node_id()

    files = [StoredFile(f"s3://map/{number}", f"{number:064}", 1) for number in range(32)]
    shards = [Shard([file], [], [], np.zeros((256, 256), np.uint8), "both", 1, Execution()) for file in files]
    with ray_engine.ray_engine(nodes[0].address, 1, None) as engine:
        first, second = list(engine.executor.map(node, shards)), list(engine.executor.map(node, shards[::-1]))
    assert first == second[::-1]
    assert len(set(first)) == 2


def test_a_cluster_that_wants_a_token_or_has_no_cpus_is_said(
    nodes: tuple[Any, list[Path]], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(ray_cluster, "_ANSWER_TIMEOUT_S", 600.0)
    pipeline, address = load_pipeline("default", SETTINGS), nodes[0].address
    with monkeypatch.context() as environment:
        environment.delenv("RAY_AUTH_MODE")
        with pytest.raises(SettingsError, match=r"wants its token\. Set RAY_AUTH_MODE=token, and RAY_AUTH_TOKEN"):
            run_batch([], tmp_path / "map", pipeline, options=BatchOptions(engine="ray", address=address))
    monkeypatch.setattr(ray, "nodes", lambda: [{"Alive": True, "Resources": {"memory": 1e9}}])
    with pytest.raises(SettingsError, match="No machine of the Ray cluster has CPUs"):
        run_batch([], tmp_path / "map", pipeline, options=BatchOptions(engine="ray", address=address))


@pytest.mark.parametrize(
    ("kind", "told"),
    [("OutOfMemoryError", "Give it more, or use fewer --jobs"), ("LocalRayletDiedError", "stopped on this machine")],
)
def test_errors_of_ray_say_what_to_do(kind: str, told: str) -> None:
    error = translated(getattr(ray.exceptions, kind)("what Ray says"))
    assert isinstance(error, BrokenExecutor)
    assert told in str(error)


def test_a_lost_head_fails_what_waits_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    """Before Ray ends the process of the batch."""
    monkeypatch.setattr(ray_cluster, "_LOST_S", 0.3)
    ended = threading.Event()
    with socket.create_server(("127.0.0.1", 0)) as server:
        head = ClusterHead(f"127.0.0.1:{server.getsockname()[1]}")
        watch = threading.Thread(target=head.watch, args=(ended,), daemon=True)
        watch.start()
        early = head.future()
        server.accept()[0].close()
        head.check()
    for future in (early, head.future()):  # what is asked of it later fails too
        assert "has lost its head" in str(future.exception(60))
    with pytest.raises(SettingsError, match="run again"):
        head.check()
    ended.set()
    watch.join(60)


def test_a_killed_batch_leaves_no_workers_behind_and_goes_on(logs: list[Path], alone: Path, tmp_path: Path) -> None:
    """The cluster is the batch's own here; it is killed when a drive is at work."""
    root, [library] = tmp_path / "map", (alone / "libraries").iterdir()
    options = [*OPTIONS, "--set", SETTINGS[-1], "--threads", "2", "--library", str(library), "--engine", "ray"]
    command = [sys.executable, "-m", "vplog", "batch", str(logs[0]), "-o", str(root), *options]
    with tempfile.TemporaryDirectory(prefix="v", dir="/tmp", ignore_cleanup_errors=True) as place:
        environment = {name: value for name, value in os.environ.items() if not name.startswith("RAY_AUTH")}
        with subprocess.Popen(command, env={**environment, "TMPDIR": place, "HOME": str(tmp_path)}) as batch:
            while batch.poll() is None and not list(root.glob(".cache/*/*")):
                time.sleep(0.02)
            batch.kill()
        assert batch.returncode == -signal.SIGKILL
        assert not list(root.glob("runs/*"))
        assert not (tmp_path / ".ray").exists(), "a token of Ray's own stayed"
        ended = time.monotonic() + 60
        while left := workers_of(place):
            assert time.monotonic() < ended, left
            time.sleep(0.1)
    told = run_batch(
        logs[:1], root, load_pipeline("default", SETTINGS), None, None, Execution(2), BatchOptions(2, join=False)
    )
    assert told["failed"] == 0
    assert tables(root) == {
        name: digest
        for name, digest in tables(alone).items()
        if name.startswith("libraries/") or ("drive=first/" in name and not name.startswith("joins/"))
    }


def workers_of(place: str) -> list[str]:
    """Processes of the cluster whose files are here; Ray's agents need a minute to see that it is gone."""
    found = []
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            command, environment = ((folder / name).read_text() for name in ("cmdline", "environ"))
        except (OSError, ValueError):
            continue
        if place in command + environment and "Agent" not in command:
            found.append(command)
    return found


def test_an_address_without_a_cluster_is_said_soon(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ray_cluster, "_ANSWER_TIMEOUT_S", 1.0)
    pipeline = load_pipeline("default", SETTINGS)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        port = silent.getsockname()[1]
        with pytest.raises(SettingsError, match=f"No Ray cluster answers at 127.0.0.1:{port}"):
            run_batch([], tmp_path / "map", pipeline, options=BatchOptions(engine="ray", address=f"127.0.0.1:{port}"))
    for address, why in ((f"127.0.0.1:{port}", "No Ray cluster answers"), ("ray://head:10001", "HOST:PORT")):
        with pytest.raises(SettingsError, match=why):
            run_batch([], tmp_path / "map", pipeline, options=BatchOptions(engine="ray", address=address))
