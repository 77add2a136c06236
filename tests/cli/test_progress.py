"""Progress in events, lines and estimates: every stage begins and ends, an error is the last event."""

from __future__ import annotations

import argparse
import json
import threading
import time
from typing import TYPE_CHECKING, Any

import pytest

from vplog.batch.worker import DriveState
from vplog.cli import progress
from vplog.cli.progress import Events, Progress, _Stage
from vplog.pipeline import STAGES
from vplog.results.run_record import read_run_json, write_run_json

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    Verb = Callable[..., Said]

QUICK = ("features.max_features=200", "features.max_megapixels=0.03", "library.size=5", "places.neighbours=8")


def told(path: Path) -> list[dict[str, Any]]:
    return [json.loads(line) for line in path.read_text().splitlines()]


def namespace(path: Path, **more: Any) -> argparse.Namespace:
    return argparse.Namespace(**{"json": False, "events": Events(path.open("w")), **more})


def test_a_run_tells_every_stage_from_its_start_to_its_end(verb: Verb, tiny_drives: list[Path], tmp_path: Path) -> None:
    settings = [word for one in QUICK for word in ("--set", one)]
    log, out, path = tiny_drives[0] / "drive.mcap", tmp_path / "out", tmp_path / "events.jsonl"
    assert verb("run", log, "-o", out, "--events", path, *settings).code == 0
    first, *events, last = told(path)
    assert (first["event"], first["verb"]) == ("started", "run")
    assert (last["event"], last["state"], last["error"]) == ("finished", "done", None)
    numbered = [one for one in events if one["number"] is not None]
    stages = read_run_json(out / "run.json")["stages"]
    for kind in ("stage_started", "stage_finished"):
        found = [one for one in numbered if one["event"] == kind]
        always = [one for one in STAGES if one not in ("scale", "decide") and "cameras" not in one]
        assert [one["stage"] for one in found] == list(stages) == always
        assert [one["number"] for one in found] == [STAGES.index(name) + 1 for name in stages]
        assert {one["of"] for one in found} == {len(STAGES)}
    counts = {one["stage"]: one["total"] for one in numbered if one["event"] == "stage_finished"}
    assert counts["extract"] == stages["extract"]["items"]
    assert [one["time_s"] for one in events] == sorted(one["time_s"] for one in events)


def test_the_last_event_of_a_verb_that_fails_is_its_error(verb: Verb, tmp_path: Path) -> None:
    path = tmp_path / "events.jsonl"
    said = verb("run", tmp_path / "none.mcap", "-o", tmp_path / "out", "--events", path)
    last = told(path)[-1]
    assert (last["event"], last["state"]) == ("finished", "failed")
    assert last["error"] in said.error
    assert "Choose another with --events" in verb("demo", "-o", tmp_path, "--events", tmp_path / "no" / "e").error


def test_work_of_one_stage_has_its_begin_and_end(verb: Verb, tmp_path: Path) -> None:
    graph, path = tmp_path / "g.g2o", tmp_path / "events.jsonl"
    graph.write_text("VERTEX_SE2 0 0 0 0\nVERTEX_SE2 1 1 0 0\nEDGE_SE2 0 1 1 0 0 1 0 0 1 0 1\n")
    assert verb("optimize", graph, "-o", tmp_path / "out.g2o", "--events", path).code == 0
    events = [(one["event"], one.get("stage")) for one in told(path) if one["event"] != "progress"]  # if it is slow
    assert events == [
        ("started", None), ("stage_started", "solve"), ("stage_finished", "solve"), ("finished", None),
    ]  # fmt: skip


def test_rate_and_time_left_are_those_of_the_items(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(progress, "_EVENT_EVERY_S", 0.0)
    with Progress(namespace(tmp_path / "e")) as shown:
        for done in range(3):
            shown("search", done, 10)
            time.sleep(0.02)
    [begun, *found] = told(tmp_path / "e")
    assert (begun["event"], begun["stage"], begun["total"]) == ("stage_started", "search", 10)
    assert [one["done"] for one in found] == [1, 2]
    for one in found:
        assert one["eta_s"] == pytest.approx((10 - one["done"]) / one["per_second"], abs=0.06)
        assert one["total_eta_s"] is None


def test_the_time_to_the_end_is_learned_from_the_latest_run_beside(tmp_path: Path) -> None:
    """Twice as slow as it was: 5 s of the stage before, 20 s of this one, 10 s of the next."""
    for name, seconds, result in (("old", 9.0, "computed"), ("new", 1.0, "computed"), ("newest", 1.0, "reused")):
        (tmp_path / name).mkdir()
        shares = {"a": 4, "within a": 1, "b": 20, "c": 10}
        stages = {stage: {"result": result, "seconds": seconds * share} for stage, share in shares.items()}
        write_run_json(tmp_path / name / "run.json", {"stages": stages, "finished": True})
        time.sleep(0.01)
    shown = Progress(namespace(tmp_path / "e"), ("a", "b", "c"), tmp_path / "out")
    shown("a", 0, 2)
    shown("a", 2, 2)
    assert [one["event"] for one in told(tmp_path / "e")] == ["stage_started", "progress"]  # its items are done, not it
    shown("b", 0, 1)
    assert shown._stages["a"].seconds is not None
    shown._stages["a"].seconds = 10.0
    assert shown._total_eta_s(shown._stages["b"]) == pytest.approx(40 + 20, abs=0.5)
    assert shown._line(shown._stages["b"]) == "stage 2 of 3, b, for 0 s, 60 s to the end"


def test_a_drive_of_a_batch_has_its_event_and_its_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    shown = Progress(namespace(tmp_path / "e"))
    shown.print_drive(DriveState("a", "a.mcap", "started", 1))
    shown.print_drive(DriveState("a", "a.mcap", "failed", 1, 2.0, error="Damaged.", fault="input"))
    first, second = (one | {"time_s": 0} for one in told(tmp_path / "e"))
    assert first == {"event": "drive_started", "time_s": 0, "drive": "a", "log": "a.mcap", "attempt": 1}
    assert second == first | {
        "event": "drive_finished", "state": "failed", "seconds": 2.0, "peak_memory_mb": 0.0, "error": "Damaged.",
        "fault": "input",
    }  # fmt: skip
    assert capsys.readouterr().err == "vplog: a: failed, 2.0 s: Damaged.\n"


def test_off_a_terminal_a_stage_that_is_silent_has_its_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    lines, said = [], threading.Event()
    monkeypatch.setattr(progress, "LINE_EVERY_S", 0.05)
    monkeypatch.setattr(progress, "_HEARTBEAT_S", 0.05)
    monkeypatch.setattr(progress, "print_status", lambda text: (lines.append(text), said.set()))
    with Progress(namespace(tmp_path / "e"), ("solve",)) as shown:
        shown("solve", 0, 1)
        assert said.wait(60)
        shown("solve", 1, 1)
    assert lines[0].startswith("stage 1 of 1, solve, for ")
    events = [one["event"] for one in told(tmp_path / "e")]
    assert (events[0], events[1], events[-1]) == ("stage_started", "progress", "stage_finished")
    lines.clear()
    with Progress(namespace(tmp_path / "f", json=True)) as shown:
        shown("solve", 0, 1)
        time.sleep(0.2)
    assert not lines


def test_what_was_there_before_makes_no_stage_look_fast() -> None:
    stage = _Stage("extract", 6000, time.monotonic() - 10.0, done=5410, known=5400)
    assert stage.eta_s() == pytest.approx(590.0, rel=0.1)
    assert _Stage("extract", 6000, time.monotonic(), done=5400, known=5400).eta_s() is None


def test_a_second_count_has_a_rate_of_its_own() -> None:
    """As where a stage checks the best candidates, then further ones."""
    stage = _Stage("verify", 60, time.monotonic() - 3600.0)
    stage.count(60, 60)
    stage.count(1, 100)
    stage.counted_s -= 5.0
    stage.count(51, 100)
    assert stage.rate() == pytest.approx(10.0, rel=0.01)
    assert stage.eta_s() == pytest.approx(4.9, rel=0.01)
