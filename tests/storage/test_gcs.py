"""Logs, results and maps at gs://, against a server that speaks Google Cloud Storage on loopback."""

from __future__ import annotations

import json
import socket
from typing import TYPE_CHECKING, Any

import pytest

from tests.maps.runs import make_map, put, seeds
from tests.storage.google_server import serving
from vplog import logs
from vplog.errors import ResultError
from vplog.maps.storage import map_store, objects
from vplog.storage import gcs
from vplog.storage.gcs import google_file_system, plain
from vplog.storage.remote_path import google_system, local_copy, local_output, located, names_below

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from conftest import Said

    from vplog.demo.record import Drive

QUICK = [
    f"--set={one}"
    for one in (
        "features.max_features=400",
        "features.max_megapixels=0.05",
        "keyframes.distance_m=15",
        "library.size=5",
    )
]
"""A dozen keyframes."""


@pytest.fixture(scope="module")
def server() -> Iterator[str]:
    with serving() as address:
        yield address


@pytest.fixture(scope="module")
def log(server: str, drive: Drive) -> str:
    with local_output(located("gs://bucket/in")) as folder:
        folder.mkdir()
        (folder / "drive.mcap").write_bytes(drive.log.read_bytes())
    return "gs://bucket/in/drive.mcap"


def test_a_log_reads_as_the_file_does(drive: Drive, log: str) -> None:
    there, here = logs.open(located(log)), logs.open(drive.log)
    assert there.name == "drive"
    assert (there.stamps() == here.stamps()).all()
    stamps = here.stamps()[[3, 20]]
    for one, other in zip(there.frames(stamps), here.frames(stamps), strict=True):
        assert (one.decode().image == other.decode().image).all()
    known: Any = located(log)
    assert known.version().startswith(f"length {drive.log.stat().st_size}, time 1")


def test_a_run_goes_from_gs_to_gs_and_is_evaluated_there(drive: Drive, log: str, verb: Callable[..., Said]) -> None:
    found = verb("run", log, "-o", "gs://bucket/runs/a", "--threads", 2, "--json", *QUICK).json
    assert (found["run"], found["log"], list(found["inputs"])) == ("gs://bucket/runs/a", log, ["drive.mcap"])
    names = {path.name for path in located("gs://bucket/runs/a").iterdir()}
    assert {"run.json", "result.mcap", "closures.parquet", "trajectory.tum", "library"} <= names
    assert json.loads((located("gs://bucket/runs/a") / "run.json").read_text())["finished"] is True
    assert verb("evaluate", "gs://bucket/runs/a", "--truth", drive.truth, "--json").json["ate_after"]["count"] > 300


def test_a_folder_comes_back_as_it_went(server: str, tmp_path: Path) -> None:
    """pyarrow lists no folder of gs:// that is not an object itself."""
    files = {"a": b"1", "deep/er/b.bin": bytes(3_000_000), "deep/c %2F": b"", "run.json": b"{}"}
    place: Any = located("gs://bucket/folder/out")
    with local_output(place) as folder:
        for name, data in files.items():
            (folder / name).parent.mkdir(parents=True, exist_ok=True)
            (folder / name).write_bytes(data)
    with local_copy(place) as copy:
        assert {str(file.relative_to(copy)): file.read_bytes() for file in copy.rglob("*") if file.is_file()} == files
    assert [path.name for path in place.iterdir()] == ["a", "deep", "run.json"]
    assert [name for name, below in names_below(place).items() if below] == ["deep"]
    objects.remove(place / "deep")
    assert sorted(names_below(place)) == ["a", "run.json"]
    assert not names_below(place / "none")


def test_a_map_grows_and_shrinks(server: str) -> None:
    root: Any = located("gs://bucket/map")
    make_map(root, {"one": 1, "two/3 %": 2})
    with map_store.writing(root) as store:
        map_store.remove(store, ["one"])
        put(store, "three", 3)
    with map_store.reading(root) as store:
        assert {drive: seeds(store.run(drive)) for drive in store.drives()} == {"two/3 %": {2}, "three": {3}}
    assert not any("one" in name for name in objects.files_below(root))


def test_what_is_not_there_is_one_line(server: str, drive: Drive, verb: Callable[..., Said]) -> None:
    for place in ("gs://bucket/none.mcap", "gs://no-such-bucket/a.mcap"):
        assert "no such file" in verb("info", place).error
    assert "there is no bucket no-such-bucket" in verb("run", drive.log, "-o", "gs://no-such-bucket/a").error


def test_a_server_that_is_silent_or_away_is_one_line(
    monkeypatch: pytest.MonkeyPatch, drive: Drive, verb: Callable[..., Said]
) -> None:
    with socket.create_server(("127.0.0.1", 0)) as silent:
        address = f"127.0.0.1:{silent.getsockname()[1]}"
        with pytest.raises(OSError, match=f"{address} does not answer .timed out"):
            google_file_system(f"http://{address}", "bucket", wait_s=0.2)
    monkeypatch.setenv("STORAGE_EMULATOR_HOST", address)
    google_system.cache_clear()
    assert "does not answer" in verb("info", "gs://bucket/a.mcap").error
    assert "does not answer" in verb("run", drive.log, "-o", "gs://bucket/a").error, "before the work, not after it"
    assert "does not answer" in verb("batch", drive.log, "-o", "gs://bucket/map").error


def test_credentials_of_no_use_are_one_line(server: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """Were the server Google's own, credentials would be looked for."""
    monkeypatch.setattr(gcs, "_PUBLIC", server)
    (tmp_path / "key.json").write_text("{}")
    monkeypatch.setenv("GOOGLE_APPLICATION_CREDENTIALS", str(tmp_path / "key.json"))
    with pytest.raises(
        OSError, match=r"Unsupported credential type .* .gcloud auth application-default login"
    ) as found:
        google_file_system(server, "bucket")
    assert "\n" not in str(found.value)
    assert len(str(found.value)) < 500


def test_what_the_client_says_is_told_by_its_innermost_message() -> None:
    status = (
        "google::cloud::Status(UNAVAILABLE: Retry policy exhausted, with a last message of PerformWork() - CURL error "
        "[6]=Could not resolve hostname error_info={reason=, domain=, metadata={gcloud-cpp.retry.on-entry=false}})"
    )
    assert plain(status) == "PerformWork() - CURL error [6]=Could not resolve hostname"
    assert "GOOGLE_APPLICATION_CREDENTIALS" in plain(status.replace("UNAVAILABLE", "UNAUTHENTICATED"))
    assert plain("disk full") == "disk full"
    with pytest.raises(KeyError), gcs.plain_errors():
        raise KeyError("a")


def test_nothing_is_sent_of_what_failed(server: str) -> None:
    with pytest.raises(ResultError, match="stop"), local_output(located("gs://bucket/failed")) as folder:
        folder.mkdir()
        (folder / "a").write_text("a")
        raise ResultError("stop")
    assert not located("gs://bucket/failed").exists()
