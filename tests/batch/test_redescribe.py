"""A map on an object store, described anew with another library into another one there."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import TYPE_CHECKING

from tests.maps.bucket import serving
from vplog.batch import redescribe
from vplog.batch.redescribe import redescribe_map
from vplog.maps.storage import map_store
from vplog.pipeline import load_pipeline
from vplog.results import run_record, tables
from vplog.storage.remote_path import located

if TYPE_CHECKING:
    from collections.abc import Callable
    from typing import Any

    import pytest
    from conftest import Said

    from vplog.batch.plan import DriveInput
    from vplog.verbs.demo.record import Demo

QUICK = (
    "features.max_features=200", "features.max_megapixels=0.05", "library.size=6", "pictures.closures=0",
    "pictures.megapixels=0", "propose.per_query=1", "keyframes.distance_m=3",
)  # fmt: skip


def make_map(root: Path, finished: Path, logs: dict[str, tuple[str, dict[str, Any]]]) -> str:
    """The finished run as drives with these logs and topics, and settings that are quick; the library's hash."""
    library = json.loads((finished / "library" / "library.json").read_text())["hash"]
    with map_store.writing(root) as store:
        shutil.copytree(finished / "library", store.staging / "library")
        map_store.add_library(store, store.staging / "library", library)
        store.write_head(map_store.Head(library, load_pipeline("default", QUICK).model_dump(mode="json")))
        for drive, (log, topics) in logs.items():
            made = store.staging / "made"
            shutil.copytree(finished, made, ignore=shutil.ignore_patterns("library"))
            run_record.write_run_json(
                made / "run.json", {**run_record.read_run_json(made / "run.json"), "topics": topics}
            )
            record = {"drive": drive, "log": log, "key": "k", "library": library, "inputs": {}}
            run_record.write_run_json(made / "drive.json", record)
            map_store.publish(store, drive, made)
    return library


def test_a_map_in_a_bucket_is_described_anew(finished: Path, drive: Demo, verb: Callable[..., Said]) -> None:
    with serving():
        old, new = located("s3://bucket/old"), located("s3://bucket/new")
        library = make_map(old, finished, {"drive": (str(drive.log), {}), "lost": ("/no/such.mcap", {})})
        again = ("map", "redescribe", old, "-o", new, "--json", "--library")
        assert "already" in verb(*again, f"{old}/libraries/{library}").error
        said = verb(*again, drive.log)
        assert (said.code, "1 of 2 drives missing in" in said.err) == (1, True)
        told = json.loads(said.out)
        fate = [(one["was"], one["drive"], one["state"]) for one in told["drives"]]
        assert fate == [("drive", "drive", "computed"), ("lost", "lost", "failed")]
        assert "/no/such.mcap no longer exists" in told["drives"][1]["error"]
        with map_store.reading(new) as store:
            made_by = tables.read_metadata(store.file("drive", "descriptors.parquet"))["vplog.library"]
            assert map_store.common_library(store)[0] == told["library"] == made_by != library
            settings = run_record.read_run_json(store.file("drive", "run.json"))["settings"]
            assert settings["features"]["max_features"] == 200, "those of the map"
        assert [one["state"] for one in json.loads(verb(*again, drive.log).out)["drives"]] == ["unchanged", "failed"]
        said = verb("map", "merge", old, new, "-o", "s3://bucket/both")
        assert f"vplog map redescribe {new} --library {old}/libraries/{library}" in said.error
        answers = verb("map", "query", new, drive.log, "--top", 1, "--json").json["answers"]
        assert sum(one["keyframe"] == one["query"] for one in answers) > 0.8 * len(answers)


def test_drives_keep_their_topics_and_names(finished: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """In one batch, in order of their numbers."""
    logs = {drive: tmp_path / drive / "walk.mcap" for drive in ("walk", "walk-2", "walk-10", "ride")}
    for log in logs.values():
        log.parent.mkdir()
        log.touch()
    left = {"image": "/left"}
    make_map(tmp_path / "map", finished, {drive: (str(log), left if drive == "walk-2" else {})
                                          for drive, log in logs.items()})  # fmt: skip
    asked: list[tuple[str, str, str | None]] = []

    def run_batch(inputs: list[DriveInput], *_: Any) -> dict[str, Any]:
        asked.extend((one.name, one.log.parent.name, one.topics.image) for one in inputs)
        fate = [{"drive": one.name, "state": "computed", "error": ""} for one in inputs]
        return {"drives": fate, "joined": None, "join_error": ""}

    monkeypatch.setattr(redescribe, "run_batch", run_batch)
    other = tmp_path / "library"
    shutil.copytree(finished / "library", other)
    record = json.loads((other / "library.json").read_text())
    run_record.write_run_json(other / "library.json", {**record, "hash": "f" * 64})
    told = redescribe_map(tmp_path / "map", other, tmp_path / "new")
    assert asked == [
        (name, name, "/left" if name == "walk-2" else None) for name in ("ride", "walk", "walk-2", "walk-10")
    ]
    assert told["failed"] == 0
    assert told["library"] == "f" * 64


def test_where_every_log_is_gone_the_same_command_goes_on(finished: Path, tmp_path: Path) -> None:
    make_map(tmp_path / "map", finished, {"walk": (str(tmp_path / "walk.mcap"), {})})
    other = Path(shutil.copytree(finished / "library", tmp_path / "library"))
    record = json.loads((other / "library.json").read_text())
    run_record.write_run_json(other / "library.json", {**record, "hash": "f" * 64})
    for _ in range(2):
        told = redescribe_map(tmp_path / "map", other, tmp_path / "new")
        assert [(one["state"], "no longer exists" in one["error"]) for one in told["drives"]] == [("failed", True)]
        assert not (tmp_path / "new").exists()
