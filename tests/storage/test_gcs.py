"""Logs, results and maps at gs://, against a server that speaks Google Cloud Storage on loopback."""

from __future__ import annotations

import json
from typing import TYPE_CHECKING, Any

import pytest

from tests.maps.runs import make_map, put, seeds
from tests.storage.google_server import serving
from vplog.maps.storage import map_store, objects
from vplog.storage import object_store
from vplog.storage.remote_path import local_copy, local_output, located, names_below, objects_below

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from conftest import Said

    from vplog.verbs.demo.record import Demo

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
def log(server: str, tiny: Demo) -> str:
    with local_output(located("gs://bucket/in")) as folder:
        folder.mkdir()
        (folder / "drive.mcap").write_bytes(tiny.log.read_bytes())
    return "gs://bucket/in/drive.mcap"


def test_a_log_is_known_by_length_and_time(tiny: Demo, log: str) -> None:
    known: Any = located(log)
    assert known.version().startswith(f"length {tiny.log.stat().st_size}, time 1")


def test_a_run_goes_from_gs_to_gs_and_is_evaluated_there(tiny: Demo, log: str, verb: Callable[..., Said]) -> None:
    found = verb("run", log, "-o", "gs://bucket/runs/a", "--threads", 2, "--json", *QUICK).json
    assert (found["run"], found["log"], list(found["inputs"])) == ("gs://bucket/runs/a", log, ["drive.mcap"])
    names = {path.name for path in located("gs://bucket/runs/a").iterdir()}
    assert {"run.json", "result.mcap", "closures.parquet", "trajectory.tum", "library"} <= names
    assert json.loads((located("gs://bucket/runs/a") / "run.json").read_text())["finished"] is True
    assert verb("evaluate", "gs://bucket/runs/a", "--truth", tiny.truth, "--json").json["ate_after"]["count"] > 300


def test_a_folder_comes_back_as_it_went(server: str, tmp_path: Path) -> None:
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
    root: Any = located("gs://bucket/grows")
    make_map(root, {"one": 1, "two/3 %": 2})
    with map_store.writing(root) as store:
        map_store.remove(store, ["one"])
        put(store, "three", 3)
    with map_store.reading(root) as store:
        assert {drive: seeds(store.run(drive)) for drive in store.drives()} == {"two/3 %": {2}, "three": {3}}
    assert not any("one" in name for name in objects_below(root) if not name.startswith("runs/"))


def test_the_store_decides_who_writes(server: str) -> None:
    place: Any = located("gs://bucket/decided")
    first = objects.put_if(place, b"1", None)
    assert first is not None
    assert objects.put_if(place, b"2", None) is None
    assert objects.put_if(place, b"3", first) is not None
    assert objects.put_if(place, b"4", first) is None, "which is another state"
    assert objects.get(place) == b"3"
    objects.remove(place)
    assert objects.put_if(place, b"5", first) is None
    objects.remove(place)


def test_what_is_not_there_is_one_line(server: str, drive: Demo, verb: Callable[..., Said]) -> None:
    assert "no such file" in verb("info", "gs://bucket/none.mcap").error
    assert "there is no bucket of this name" in verb("info", "gs://no-such-bucket/a.mcap").error
    assert "there is no bucket no-such-bucket" in verb("run", drive.log, "-o", "gs://no-such-bucket/a").error


def test_a_server_that_is_away_is_one_line(
    monkeypatch: pytest.MonkeyPatch, drive: Demo, verb: Callable[..., Said]
) -> None:
    monkeypatch.setenv("STORAGE_EMULATOR_HOST", "127.0.0.1:1")
    assert "does not answer (Connection refused)" in verb("info", "gs://bucket/a.mcap").error
    assert "does not answer" in verb("run", drive.log, "-o", "gs://bucket/a").error, "before the work, not after it"
    assert "does not answer" in verb("batch", drive.log, "-o", "gs://bucket/map").error


def test_credentials_of_no_use_are_one_line(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    monkeypatch.delenv("STORAGE_EMULATOR_HOST", raising=False)
    (tmp_path / "key.json").write_text("{}")
    monkeypatch.setenv("GOOGLE_APPLICATION_CREDENTIALS", str(tmp_path / "key.json"))
    with pytest.raises(OSError, match=r"no credentials .* .gcloud auth application-default login") as found:
        located("gs://bucket/a").exists()
    assert "\n" not in str(found.value)
    assert len(str(found.value)) < 500


def test_public_data_need_no_credentials(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("STORAGE_EMULATOR_HOST", "GOOGLE_APPLICATION_CREDENTIALS"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("HOME", str(tmp_path))
    monkeypatch.setattr(object_store, "_METADATA", "http://127.0.0.1:1")
    assert object_store._google_config() == {"skip_signature": True}
    (tmp_path / ".config/gcloud").mkdir(parents=True)
    (tmp_path / ".config/gcloud/application_default_credentials.json").touch()
    assert object_store._google_config() == {}


def test_keys_of_an_aws_profile_are_used(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    for name in ("AWS_ACCESS_KEY_ID", "AWS_REGION", "AWS_DEFAULT_REGION", "AWS_SKIP_SIGNATURE"):
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setenv("AWS_SHARED_CREDENTIALS_FILE", str(tmp_path / "credentials"))
    monkeypatch.setenv("AWS_CONFIG_FILE", str(tmp_path / "config"))
    monkeypatch.setenv("AWS_PROFILE", "other")
    assert object_store._aws_profile() == {}
    (tmp_path / "credentials").write_text("[other]\naws_access_key_id = a%b\naws_secret_access_key = c\nx = y\n")
    (tmp_path / "config").write_text("[default]\nregion = us-west-1\n[profile other]\nregion = eu-central-1\n")
    found = {"aws_access_key_id": "a%b", "aws_secret_access_key": "c", "region": "eu-central-1"}
    assert object_store._aws_profile() == found
    monkeypatch.setenv("AWS_ACCESS_KEY_ID", "d")
    assert object_store._aws_profile() == {"region": "eu-central-1"}
    (tmp_path / "config").write_text("a line that is none\n")
    with pytest.raises(OSError, match="no section headers") as error:
        located("s3://bucket/a").exists()
    assert "\n" not in str(error.value)
