"""`vplog study`: what it counts on pictures whose truth is known, what it remembers, what it writes and refuses."""

from __future__ import annotations

import os
import shutil
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pytest

from tests.pictures import day_and_dusk
from vplog.benchmark.recogniser_specs import read_method
from vplog.benchmark.study import study
from vplog.benchmark.study.experiments import ABLATIONS, Ablation
from vplog.benchmark.study.study import EXPERIMENTS, short_names, truth_of_pair
from vplog.errors import TruthError
from vplog.evaluate.place_truth import TruthChoice
from vplog.pipeline import Pipeline
from vplog.places.bobb import BobbSettings
from vplog.results.run_record import read_run_json, write_run_json

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    from vplog.verbs.demo.record import Demo

    Verb = Callable[..., Said]

FRAMES = 9
QUICK = (
    *("--set", "features.max_features=150"),
    *("--set", "features.max_megapixels=0.06"),
    *("--library-size", "6", "--sizes", "4,6,99", "--seeds", "2"),
    *("--methods", "bobb,bobb_paper:partitions=5,vlad:centres=8"),
)


@pytest.fixture(scope="module")
def traversals(drive: Demo, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folders = tmp_path_factory.mktemp("traversals") / "walk_day", tmp_path_factory.mktemp("traversals") / "walk_dusk"
    for folder in folders:
        folder.mkdir()
    for number, images in enumerate(day_and_dusk(drive.log, FRAMES)):
        for folder, image in zip(folders, images, strict=True):
            cv2.imwrite(str(folder / f"{number}.png"), image)
    return folders


def without_seconds(found: dict[str, Any]) -> dict[str, Any]:
    experiments = {
        name: {key: value for key, value in one.items() if key != "seconds"}
        for name, one in found["experiments"].items()
    }
    return {**found, "experiments": experiments}


def test_every_experiment_on_two_drives(
    verb: Verb, traversals: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    two = [ablation for ablation in ABLATIONS if ablation.name in ("no agreement", "own image left out")]
    monkeypatch.setattr("vplog.benchmark.study.experiments.ABLATIONS", two)  # they stand for all: one loop does them
    day, dusk = traversals
    out = tmp_path / "study"
    arguments = ("study", day, dusk, "--truth", "index", "-o", out, *QUICK)
    found = verb(*arguments, "--threads", 2, "--json").json
    done = found["experiments"]
    assert list(done) == list(EXPERIMENTS)
    assert [drive["name"] for drive in found["drives"]] == ["day", "dusk"]
    for one in done.values():
        assert one["figures"]
        assert all((out / file).stat().st_size > 1000 for file in one["figures"])
    assert read_run_json(out / "study.json") == found

    # every ordered pair and method once; the worst seed is never better than the mean
    rows = done["pairs"]["rows"]
    assert len(rows) == 2 * 3
    assert {(row["query"], row["map"], row["library"]) for row in rows} == {
        ("day", "dusk", "dusk"),
        ("dusk", "day", "day"),
    }
    assert all(row["r_at_1_worst"] <= row["r_at_1"] and row["anr_worst"] >= row["anr"] for row in rows)
    # what `compare` says of the same pair, mean of the same two libraries
    for row in rows[:3]:
        query, other = (day, dusk) if row["query"] == "day" else (dusk, day)
        alike = [
            verb(
                "compare", query, other, "--truth", "index", "--methods", row["method"], "--library-size", 6,
                "--library-seed", seed, "--json", *QUICK[:4],
            ).json["methods"][row["method"]]
            for seed in (0, 1)
        ]  # fmt: skip
        for score in ("r_at_1", "anr", "ap"):
            assert row[score] == pytest.approx(np.mean([one[score] for one in alike]), abs=1e-6)
        assert row["bytes_per_image"] == pytest.approx(np.mean([one["bytes_per_image"] for one in alike]), abs=0.1)

    # tables that are views of the same trials agree with them
    table = done["conditions"]["query_by_map"]["bobb"]["anr"]
    assert table == [[None, find(rows, "bobb", "day")["anr"]], [find(rows, "bobb", "dusk")["anr"], None]]
    whole = [row for row in done["sizes"]["rows"] if row["size"] == 6 and row["method"] == "bobb"]
    assert [row["anr"] for row in whole] == [row["anr"] for row in rows if row["method"] == "bobb"]
    assert {row["size"] for row in done["sizes"]["rows"]} == {4, 6}
    assert "[99]" in done["sizes"]["left_out"]
    own = [row for row in done["library"]["rows"] if row["from"] == "map"]
    assert {(row["method"], row["query"]): row["ap"] for row in own} == {
        (row["method"], row["query"]): row["ap"] for row in rows if not row["method"].startswith("vlad")
    }
    assert {row["method"]: row["stored_bits"] for row in done["bits"]["rows"]}["bobb"] == 8 * 120
    assert len(done["ablations"]["rows"]) == 2
    base = done["ablations"]["base"]
    for row in done["ablations"]["rows"]:
        assert row["r_at_1_change"] == pytest.approx(row["r_at_1"] - base["r_at_1"], abs=2e-6)
        assert row["r_at_1_change"] == pytest.approx(np.mean([c["r_at_1"] for c in row["changes"]]), abs=2e-6)

    # J references an image at most, and each image counted
    chosen = done["references"]["chosen"]
    assert done["references"]["images"] == 2 * FRAMES
    assert sum(chosen.values()) <= 2 * FRAMES * 10
    assert list(chosen.values()) == sorted(chosen.values(), reverse=True)
    assert len(done["sequence"]["frames"]) == FRAMES

    # again: nothing is done anew, and the terminal says the same
    before = {file.name: file.stat().st_mtime_ns for file in out.iterdir() if file.name != "study.json"}
    said = verb(*arguments, "--threads", 1)
    assert said.code == 0, said.err
    assert "bobb_paper:partitions=5" in said.out
    assert "agreement_floor=1" in said.out
    assert {file.name: file.stat().st_mtime_ns for file in out.iterdir() if file.name != "study.json"} == before
    assert without_seconds(read_run_json(out / "study.json")) == without_seconds(found)


def find(rows: list[dict[str, Any]], method: str, query: str) -> dict[str, Any]:
    return next(row for row in rows if (row["method"], row["query"]) == (method, query))


@pytest.mark.usefixtures("computed_anew")
def test_bytes_do_not_depend_on_threads_and_the_interrupted_goes_on(
    verb: Verb, traversals: tuple[Path, Path], tmp_path: Path
) -> None:
    outs = [tmp_path / "a", tmp_path / "b"]
    arguments = ("study", *traversals, "--truth", "index", *QUICK, "--seeds", 1, "--json")
    records = [
        verb(*arguments, "-o", out, "--only", "pairs,sequence", "--threads", threads).json
        for out, threads in zip(outs, (1, 3), strict=True)
    ]
    assert without_seconds(records[0]) == without_seconds(records[1])
    for file in outs[0].iterdir():
        if file.name != "study.json":
            assert file.read_bytes() == (outs[1] / file.name).read_bytes(), file.name
    # trials outlive a study that was cut short, and damage to their file costs only time
    trials = read_run_json(outs[0] / "trials.json")
    (outs[0] / "study.json").unlink()
    key = next(iter(trials))
    trials[key]["r_at_1"] = -1.0
    write_run_json(outs[0] / "trials.json", trials)
    again = verb(*arguments, "-o", outs[0], "--only", "pairs").json["experiments"]["pairs"]
    assert min(row["r_at_1"] for row in again["rows"]) == -1.0
    (outs[1] / "study.json").unlink()
    write_run_json(outs[1] / "trials.json", {key: {"r_at_1": "many"}, "b": 3})
    anew = verb(*arguments, "-o", outs[1], "--only", "pairs").json["experiments"]["pairs"]
    assert anew["rows"] == records[1]["experiments"]["pairs"]["rows"]
    # other inputs: what was found by the earlier ones is gone, with its figures
    other = verb(*arguments, "-o", outs[1], "--only", "bits", "--library-size", 5).json
    assert list(other["experiments"]) == ["bits"]
    assert not (outs[1] / "pairs.png").exists()


def test_an_interrupted_study_leaves_the_one_before_and_goes_on(
    verb: Verb, traversals: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """What it had finished is not done again, and nothing of it is in OUT before all is."""
    out = tmp_path / "study"
    arguments = ("study", *traversals, "--truth", "index", "-o", out, *QUICK, "--methods", "thumbnail,gist")
    assert verb(*arguments, "--only", "pairs", "--library-size", 4).code == 0

    def state() -> dict[str, bytes]:
        return {file.name: file.read_bytes() for file in out.iterdir() if file.is_file() and file.stem != "trials"}

    before, done, do = state(), list[str](), study._do

    def failing(name: str, *more: Any) -> dict[str, Any]:
        if name == "conditions" and not done.count("failed"):
            done.append("failed")
            raise KeyboardInterrupt
        done.append(name)
        return do(name, *more)

    monkeypatch.setattr(study, "_do", failing)
    assert verb(*arguments, "--only", "pairs,conditions", "--library-size", 5).code == 130
    assert state() == before
    found = verb(*arguments, "--only", "pairs,conditions", "--library-size", 5, "--json").json
    assert done == ["pairs", "failed", "conditions"]
    assert list(found["experiments"]) == ["pairs", "conditions"]
    figures = {file for one in found["experiments"].values() for file in one["figures"]}
    assert {file.name for file in out.iterdir()} == figures | {"study.json", "trials.json"}


def test_frames_that_do_not_decode_keep_their_queries(
    verb: Verb, traversals: tuple[Path, Path], tmp_path: Path
) -> None:
    """Frame 2 is lost by day and by dusk: its query counts as not found, and figures show other frames."""
    day, dusk = tmp_path / "walk_day", tmp_path / "walk_dusk"
    for source, folder in zip(traversals, (day, dusk), strict=True):
        shutil.copytree(source, folder)
        os.truncate(folder / "2.png", 100)
    arguments = ("study", day, dusk, "--truth", "index", "-o", tmp_path / "study", *QUICK)
    found = verb(*arguments, "--only", "pairs,references,examples,sequence", "--json").json
    assert [one["with_match"] for one in found["protocol"]] == [FRAMES, FRAMES]
    recalls = [row["r_at_10"] for row in found["experiments"]["pairs"]["rows"]]
    assert recalls == pytest.approx(2 * 3 * [(FRAMES - 1) / FRAMES], abs=1e-5)
    assert 2 not in found["experiments"]["sequence"]["frames"]


def test_a_drive_and_its_own_past(verb: Verb, drive: Demo, tmp_path: Path) -> None:
    arguments = ("study", drive.log, "--truth", drive.truth, "-o", tmp_path / "study", *QUICK, "--seeds", 1)
    assert "give two drives or more" in verb(*arguments, "--min-gap", 20, "--only", "library").error
    assert "--min-gap 50" in verb(*arguments).error
    found = verb(*arguments, "--min-gap", 20, "--only", "pairs,examples", "--json").json
    rows = found["experiments"]["pairs"]["rows"]
    assert [row["method"] for row in rows] == ["bobb", "bobb_paper:partitions=5", "vlad:centres=8"]
    assert all(row["query"] == row["map"] == drive.log.stem for row in rows)
    for example in found["experiments"]["examples"]["rows"]:
        assert example["query_frame"] - example["map_frame"] >= 20
        assert (example["answer_frame"] == example["map_frame"]) == (example["kind"] == "found")


@pytest.mark.parametrize(("method", "done"), [("gist", ["bits"]), ("hybrid", ["bits", "sequence"])])
def test_methods_without_boxes_leave_out_what_is_about_them(
    verb: Verb,
    traversals: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    method: str,
    done: list[str],
) -> None:
    monkeypatch.setattr("vplog.benchmark.study.study.EXPERIMENTS", ("bits", "sequence"))
    found = verb("study", *traversals, "--truth", "index", "-o", tmp_path, *QUICK, "--methods", method, "--json").json
    assert list(found["experiments"]) == done


# Departures from the paper


def test_departures_are_settings_that_change_something() -> None:
    base = BobbSettings()
    methods = [read_method(ablation.method, Pipeline()) for ablation in ABLATIONS]
    assert all(method != base for method in methods)
    assert len({method.model_dump_json() for method in methods}) == len(ABLATIONS)
    assert len({ablation.name for ablation in ABLATIONS}) == len(ABLATIONS)


@pytest.mark.parametrize("gone", ["soft_sift=true", "agreement_floor=2", "pairing=worst"])
def test_a_departure_that_is_no_more_is_one_line(
    verb: Verb, traversals: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, gone: str
) -> None:
    stale = Ablation("stale", (gone,), "Once there.")
    monkeypatch.setattr("vplog.benchmark.study.experiments.ABLATIONS", (*ABLATIONS, stale))
    arguments = ("study", *traversals, "--truth", "index", "-o", tmp_path / "out", *QUICK)
    said = verb(*arguments, "--only", "ablations").error
    assert f"bobb:{gone}" in said
    assert "`vplog config --set places.kind=bobb` prints them all" in said


# What is refused


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (
            ("DAY", "DUSK", "--only", "pairs,maps"),
            "--only maps: there is no such experiment. Experiments: pairs",
        ),
        (("DAY", "DAY"), "is given twice"),
        (("DAY", "DUSK", "--min-gap", "3"), "--min-gap is for one drive, matched with its own past"),
        (("DAY", "DUSK", "--methods", "vlad", "--only", "pairs,sizes"), "sizes is about boxes; add bobb or"),
        (("DAY", "DUSK", "--methods", "surf"), "No method 'surf'"),
        (("DAY", "DUSK", "--sizes", "50"), "the shortest drive has only 9 frames"),
        (("DAY", "DUSK", "--truth", "pairs.csv"), "Cannot read pairs.csv"),
        (("DAY", "DUSK", "--truth", "a.tum,b.tum,c.tum"), "3 files for 2 drives"),
        (("DAY", "nowhere"), "nowhere"),
        (("DAY", "DUSK", "-o", "DAY"), "a folder with other things in it, not a study"),
        (("DAY", "DUSK", "-o", "OTHER"), "holds a study of /other.mcap. Choose another folder"),
    ],
)
def test_what_cannot_be_studied_is_said_in_one_line(
    verb: Verb,
    traversals: tuple[Path, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    arguments: tuple[str, ...],
    said: str,
) -> None:
    folders = {"DAY": traversals[0], "DUSK": traversals[1], "OTHER": tmp_path / "other"}
    folders["OTHER"].mkdir()
    (folders["OTHER"] / "study.json").write_text('{"vplog": "0.1.0", "drives": [{"log": "/other.mcap", "hash": "0"}]}')
    named = [folders.get(argument, argument) for argument in arguments]
    with monkeypatch.context() as patched:
        patched.setattr("vplog.benchmark.study.study._do", None)  # all before the experiments, which take hours
        assert said in verb("study", "--truth", "index", "-o", tmp_path / "out", *QUICK, *named).error


def test_wrong_usage(verb: Verb) -> None:
    for wrong in (("--sizes", "0"), ("--sizes", "4,x"), ("--seeds", "0")):
        assert verb("study", "a", "b", "--truth", "index", "-o", "out", *wrong).code == 2


def test_names_without_what_all_share() -> None:
    assert short_names(["walk_day_left", "walk_day_right", "walk_night"]) == ["day_left", "day_right", "night"]
    assert short_names(["day", "dusk"]) == ["day", "dusk"]
    assert short_names(["a_b"]) == ["a_b"]
    assert short_names(["one", "one", "two"]) == ["one", "one (2)", "two"]
    assert short_names(["run_", "run_2"]) == ["run_", "2"]


def test_truth_files_go_to_their_drives(tmp_path: Path) -> None:
    truth = TruthChoice("a.tum,b.tum,c.tum", distance_m=3.0)
    assert truth_of_pair(truth, 2, 0, 3) == TruthChoice("c.tum,a.tum", distance_m=3.0)
    assert truth_of_pair(TruthChoice("index"), 1, 0, 2) == TruthChoice("index")
    (tmp_path / "pairs.CSV").write_text("query,match\n0,1\n")
    pairs = TruthChoice(str(tmp_path / "pairs.CSV"))
    assert [truth_of_pair(pairs, 0, 1, 2).transposed, truth_of_pair(pairs, 1, 0, 2).transposed] == [False, True]
    with pytest.raises(TruthError, match="here are 3 drives"):
        truth_of_pair(pairs, 0, 1, 3)
    (tmp_path / "labels.csv").write_text("image,label\n0.png,a\n")
    assert truth_of_pair(TruthChoice(str(tmp_path / "labels.csv")), 1, 0, 3).transposed is False
