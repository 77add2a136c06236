"""A closure told in words and shown in a picture: the ledger's numbers, the frames' matches, one line for errors."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pyarrow.parquet as pq
import pytest

from vplog.data import ACCEPTED, Camera, Features, Keyframes, Verdict
from vplog.execution.execution import Execution
from vplog.geometry import se3
from vplog.loops import undistort
from vplog.pipeline import Pipeline, load_pipeline, run
from vplog.results import tables
from vplog.results.run_record import read_run_json
from vplog.run.figures.closure_view import find_agreement, find_boxes
from vplog.verbs.explain_text import describe

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    from vplog.verbs.demo.record import Demo

    Verb = Callable[..., Said]

QUICK = (
    "features.max_features=250", "features.max_megapixels=0.04", "features.min_features=0", "propose.per_query=2",
    "library.size=5", "propose.gap_keyframes=15", "propose.gap_steps=15",
    "verify.calibration.pairs=0",
)  # fmt: skip


def of(folder: Path, verdict: Verdict) -> int:
    """The first closure with this verdict."""
    return tables.read_closures(folder / "closures.parquet").verdict.index(verdict)


@pytest.fixture
def copied(finished: Path, tmp_path: Path) -> Path:
    """A run folder to spoil."""
    shutil.copytree(finished, tmp_path / "run")
    return tmp_path / "run"


def changed(folder: Path, **values: Any) -> None:
    record = read_run_json(folder / "run.json")
    (folder / "run.json").write_text(json.dumps({**record, **values}))


# In words


def a_row(verdict: Verdict, **values: Any) -> dict[str, Any]:
    posed = verdict in (Verdict.ACCEPTED, Verdict.REJECTED_BY_SOLVER)
    pose = {"tx": 3.0, "ty": 4.0, "tz": 0.0, "qx": 0.0, "qy": 0.0, "qz": 0.6, "qw": 0.8}
    return {
        "query": 40, "match": 4, "query_stamp_ns": 40_000_000_000, "match_stamp_ns": 4_000_000_000,
        "rank": 2, "score": 0.5, "support": 3, "shared_references": [7, 1], "shared_overlap": [0.5, 0.25],
        "matches": 83, "landmarks": 61, "inliers": 47, "spread": 0.31, "reverse_inliers": 44,
        "scale": "depth" if posed else "none", **{name: value if posed else None for name, value in pose.items()},
        "covariance": np.diag([1e-4] * 3 + [4e-2] * 3).ravel().tolist() if posed else None,
        "verdict": verdict.value, "reason": verdict.sentence, "p_false": 0.02,
        "residual_before": 7.5 if posed else None,
        "residual_after": 1.5 if posed else None, "weight": float(verdict is Verdict.ACCEPTED) if posed else None,
        **values,
    }  # fmt: skip


def told(row: dict[str, Any]) -> Any:
    poses = se3.pose(np.eye(3), np.arange(50.0)[:, None] * [1.0, 0.0, 0.0])
    keyframes = Keyframes("d", np.arange(50) * 1_000_000_000, poses)
    solved = poses * [[1.0, 1.0, 1.0, 0.5]]
    return describe(row, keyframes, solved, ["accepted", "too_far", "accepted"], Pipeline(), "Good.")


@pytest.mark.parametrize("verdict", Verdict)
def test_every_verdict_is_told_in_whole_sentences_and_says_what_would_change_it(verdict: Verdict) -> None:
    words = told(a_row(verdict))
    became = {**dict.fromkeys(ACCEPTED, "Accepted"), Verdict.DIRECTION_ONLY: "Used"}.get(verdict, "Rejected")
    assert words.verdict.startswith(became)
    assert verdict.sentence in words.verdict
    for text in (words.verdict, words.proposed, words.geometry, words.solver, words.change):
        assert text.endswith(".")
        assert "None" not in text
        assert "nan" not in text
    for number in ("83", "61", "47", "31 %", "44"):
        assert number in words.geometry
    for number in (
        "40",
        "40.0 s",
        "4.0 s",
        "36.0 m",
        "ranks 3 of",
        "3 candidates",
        "2 of them",
        "no. 7 (50 %)",
        "0.500",
    ):
        assert number in words.proposed
    assert "36.00 m apart by the odometry and 18.00 m" in words.solver


def test_a_pose_is_told_in_metres_and_degrees_with_its_deviation() -> None:
    words = told(a_row(Verdict.ACCEPTED))
    assert "5.00 m" in words.geometry
    assert "73.7 degrees" in words.geometry  # 2 arccos 0.8
    assert "0.200 m and 0.57 degrees" in words.geometry
    assert "depth images" in words.geometry
    assert "7.5 sigma" in words.solver
    assert "1.5 sigma" in words.solver
    assert "Good." in words.solver


def test_what_is_missing_is_left_out_or_said() -> None:
    words = told(a_row(Verdict.TOO_FEW_MATCHES, landmarks=0, inliers=0, spread=0.0, reverse_inliers=-1, matches=9,
                       shared_references=[], shared_overlap=[], support=0))  # fmt: skip
    assert "none agree" in words.geometry
    assert "other way" not in words.geometry
    assert "%" not in words.geometry
    assert "reference" not in words.proposed
    assert "sequence" not in words.proposed
    assert "verify.min_matches=9" in words.change
    direction = told(a_row(Verdict.ACCEPTED, covariance=None, scale="none"))
    assert "73.7 degrees" in direction.geometry
    assert "its distance is not" in direction.geometry
    assert " m " not in direction.geometry
    apart = told(a_row(Verdict.ACCEPTED, residual_before=None))
    assert "unknown number of sigma" in apart.solver


def test_the_bound_that_was_missed_is_named() -> None:
    few = told(a_row(Verdict.TOO_FEW_INLIERS, inliers=9))
    assert "20 inliers" in few.change
    by_chance = told(a_row(Verdict.TOO_FEW_INLIERS, inliers=30))
    assert "log10_false_alarms" in by_chance.change
    lines = told(a_row(Verdict.TOO_FEW_INLIERS, inliers=9, landmarks=0))
    assert "verify.epipolar" in lines.change


# A finished run


@pytest.mark.parametrize("verdict", [Verdict.ACCEPTED, Verdict.TOO_FEW_MATCHES])
def test_json_holds_the_row_and_a_picture_is_written(
    verb: Verb, finished: Path, tmp_path: Path, verdict: Verdict
) -> None:
    number = of(finished, verdict)
    found = verb("explain", finished, "--closure", number, "-o", tmp_path / "a.png", "--json").json
    assert found["closure"] == number
    [row] = pq.read_table(finished / "closures.parquet").slice(number, 1).to_pylist()
    assert found["row"].keys() == row.keys()
    for name in ("query", "match", "score", "matches", "verdict", "reason", "tx", "weight", "shared_references"):
        assert found["row"][name] == row[name], name
    image = cv2.imread(str(tmp_path / "a.png"))
    assert image is not None
    assert image.shape[1] == 1800
    about = found["picture"]
    assert about["file"] == str(tmp_path / "a.png")
    assert about["matches"] >= row["matches"]  # too few may have been told by the strongest features alone
    assert set(about["references"]) <= set(row["shared_references"])
    if verdict is Verdict.ACCEPTED:
        assert row["inliers"] <= about["agree"] <= row["matches"]
        assert about["references"]
        assert row["shared_overlap"][0] > 0.3


def test_words_name_the_verdict_and_the_picture(verb: Verb, finished: Path, tmp_path: Path) -> None:
    number = of(finished, Verdict.ACCEPTED)
    said = verb("explain", finished, "--closure", number, "-o", tmp_path / "a.svg")
    assert (said.code, said.err) == (0, "")
    assert Verdict.ACCEPTED.sentence in said.out
    assert str(tmp_path / "a.svg") in said.out
    assert "<svg" in (tmp_path / "a.svg").read_text()
    assert len(said.out.splitlines()) == 7, "a line for each part, where no terminal is too narrow for it"


def test_same_closure_same_bytes(verb: Verb, finished: Path, tmp_path: Path) -> None:
    number = of(finished, Verdict.ACCEPTED)
    for name in ("one", "two"):
        assert verb("explain", finished, "--closure", number, "-o", tmp_path / f"{name}.png").code == 0
    assert (tmp_path / "one.png").read_bytes() == (tmp_path / "two.png").read_bytes()


def test_a_closure_is_named_by_row_by_keyframes_by_stamps_or_as_the_worst(verb: Verb, finished: Path) -> None:
    def ask(*choice: object) -> int:
        return verb("explain", finished, *choice, "--no-picture", "--json").json["closure"]

    ledger = tables.read_closures(finished / "closures.parquet")
    keyframes, _ = tables.read_keyframes(finished / "keyframes.parquet")
    number = len(ledger) // 2
    query, match = int(ledger.query[number]), int(ledger.match[number])
    assert ask("--closure", number) == number
    assert ask("--closure", f"{query}:{match}") == number
    assert ask("--closure", f"{keyframes.stamp_ns[query]}:{keyframes.stamp_ns[match]}") == number
    assert ledger.residual_after[ask("--worst")] == np.nanmax(ledger.residual_after)


def test_a_moved_log_is_named_and_may_be_given(verb: Verb, drive: Demo, copied: Path, tmp_path: Path) -> None:
    number = of(copied, Verdict.ACCEPTED)
    changed(copied, log=str(tmp_path / "gone.mcap"))
    error = verb("explain", copied, "--closure", number).error
    assert "gone.mcap" in error
    assert "--log" in error
    assert verb("explain", copied, "--closure", number, "--no-picture").code == 0
    shutil.copy(drive.log, tmp_path / "moved.mcap")
    found = verb("explain", copied, "--closure", number, "--log", tmp_path / "moved.mcap", "--json").json
    assert found["picture"]["file"] == str(copied / f"closure-{number}.png")
    assert (copied / f"closure-{number}.png").is_file()


def test_errors_are_one_line(verb: Verb, drive: Demo, finished: Path, copied: Path, tmp_path: Path) -> None:
    ledger = tables.read_closures(finished / "closures.parquet")
    count, number = len(ledger), of(finished, Verdict.ACCEPTED)
    for bad in (count, 10**12, -1):
        assert f"0..{count - 1}" in verb("explain", finished, f"--closure={bad}").error
    query = int(ledger.query[number])
    assert str(ledger.match[number]) in verb("explain", finished, "--closure", f"{query}:{query}").error
    assert "row or stamp 999999" in verb("explain", finished, "--closure", f"999999:{query}").error
    assert ".png" in verb("explain", finished, "--closure", number, "-o", tmp_path / "a.jpg").error
    assert "run.json" in verb("explain", tmp_path / "nowhere", "--closure", 0).error
    images = tmp_path / "images"
    images.mkdir()
    cv2.imwrite(str(images / "1.png"), np.zeros((48, 64), np.uint8))
    cv2.imwrite(str(images / "2.png"), np.zeros((48, 64), np.uint8))
    assert "--log" in verb("explain", finished, "--closure", number, "--log", images).error
    missing = tmp_path / "no" / "folder" / "a.png"
    assert "a.png" in verb("explain", finished, "--closure", number, "-o", missing).error
    changed(copied, settings={"verify": {"gone": 1}})
    assert "another version" in verb("explain", copied, "--closure", number).error
    changed(copied, finished=False)
    assert "did not finish" in verb("explain", copied, "--closure", number).error
    for usage in ((), ("--closure", "a"), ("--closure", "1:2:3"), ("--closure", "1", "--worst")):
        assert verb("explain", finished, *usage).code == 2


def test_a_run_without_candidates_has_no_closure_to_tell(verb: Verb, copied: Path) -> None:
    path = copied / "closures.parquet"
    pq.write_table(pq.read_table(path).slice(0, 0), path)
    assert "nothing was proposed" in verb("explain", copied, "--closure", 0).error
    assert "No closure was proposed" in verb("explain", copied, "--worst").error


def test_without_its_library_a_run_is_shown_without_boxes(verb: Verb, copied: Path, tmp_path: Path) -> None:
    shutil.rmtree(copied / "library")
    number = of(copied, Verdict.ACCEPTED)
    about = verb("explain", copied, "--closure", number, "-o", tmp_path / "a.png", "--json").json["picture"]
    assert about["references"] == []
    assert "library" in about["without_boxes"]
    assert about["agree"] > 0


@pytest.mark.parametrize("kind", ["bovf", "bobb_paper"])
def test_other_recognisers_are_shown_with_what_they_have(verb: Verb, tiny: Demo, tmp_path: Path, kind: str) -> None:
    run(tiny.log, tmp_path / "run", load_pipeline("default", [*QUICK, f"places.kind={kind}"]), execution=Execution(2))
    picture = tmp_path / "a.png"
    found = verb("explain", tmp_path / "run", "--closure", 0, "-o", picture, "--json").json
    assert picture.is_file()
    assert bool(found["row"]["shared_references"]) == (kind == "bobb_paper")
    assert bool(found["picture"]["references"]) == (kind == "bobb_paper")
    assert ("no reference" in found["picture"]["without_boxes"]) == (kind == "bovf")


# What is drawn

CAMERA = Camera(
    "c", np.array([[400.0, 0.0, 320.0], [0.0, 400.0, 240.0], [0.0, 0.0, 1.0]]), "plumb_bob",
    np.array([-0.1, 0.02, 0.001, -0.001, 0.0]), 640, 480,
    se3.pose(np.array([[0.0, 0.0, 1.0], [-1.0, 0.0, 0.0], [0.0, -1.0, 0.0]]), np.array([0.5, 0.0, 1.0])),
)  # fmt: skip


def features(points: np.ndarray, descriptors: np.ndarray) -> Features:
    nothing = np.full(len(points), np.nan, np.float32)
    return Features(points.astype(np.float32), nothing, descriptors, nothing, 640, 480)


@pytest.mark.parametrize("shift_m", [0.0, 0.8])
def test_matches_that_the_pose_explains_are_told_from_others(shift_m: float) -> None:
    """A scene of points seen twice; every third feature of the query is moved to where nothing is."""
    rng = np.random.default_rng(4)
    match_from_query = se3.exp(np.array([0.02, -0.03, 0.05, 0.9, 0.4, 0.1]) * ([1.0] * 3 + [shift_m] * 3))
    camera_motion = se3.inverse(CAMERA.body_from_camera) @ match_from_query @ CAMERA.body_from_camera
    seen = np.column_stack([rng.uniform(-3, 3, 300), rng.uniform(-2, 2, 300), rng.uniform(5, 30, 300)])
    pixels = [undistort.project(CAMERA, points) for points in (seen, se3.transform(camera_motion, seen))]
    inside = np.all([np.all((p > 0) & (p < [640, 480]), axis=1) for p in pixels], axis=0)
    query, match = (p[inside] + rng.normal(scale=0.3, size=(int(inside.sum()), 2)) for p in pixels)
    wrong = np.arange(len(query)) % 3 == 0
    query[wrong] = rng.uniform([0, 0], [640, 480], (wrong.sum(), 2))
    descriptors = rng.integers(0, 256, (len(query), 128)).astype(np.uint8)
    ours, theirs = features(query, descriptors), features(match, descriptors)
    settings = Pipeline().verify
    known = find_agreement(ours, theirs, match_from_query, 9, (CAMERA, CAMERA), settings)
    assert len(known.agrees) == len(query) > 100
    assert known.agrees[~wrong].mean() > 0.98
    assert known.agrees[wrong].mean() < 0.1
    unknown = find_agreement(ours, theirs, np.full((4, 4), np.nan), 9, (CAMERA, replace(CAMERA, matrix=None)), settings)
    if shift_m:  # without a shift there is no epipolar geometry, and any that a turn allows will do
        assert unknown.agrees[~wrong].mean() > 0.8
        assert unknown.agrees[wrong].mean() < 0.2


@pytest.mark.parametrize("count", [0, 5, 16])
def test_matches_by_chance_agree_with_nothing(count: int) -> None:
    rng = np.random.default_rng(count)
    descriptors = rng.integers(0, 256, (count, 128)).astype(np.uint8)
    ours, theirs = (features(rng.uniform([0, 0], [640, 480], (count, 2)), descriptors) for _ in range(2))
    found = find_agreement(ours, theirs, np.full((4, 4), np.nan), 0, (CAMERA, CAMERA), Pipeline().verify)
    assert len(found.agrees) == count
    assert not found.agrees.any()
    assert not found.model


def test_the_windows_drawn_are_those_whose_boxes_agree_best(finished: Path) -> None:
    ledger = tables.read_closures(finished / "closures.parquet")
    state: Any = Pipeline().places.load(finished / "library", Execution())
    places = state.from_arrow(tables.read_descriptors(finished / "descriptors.parquet")[0])
    number = of(finished, Verdict.ACCEPTED)
    numbers = ledger.shared_references[number].tolist()
    found = find_boxes(state, places[ledger.query[number]], places[ledger.match[number]], numbers)
    assert [one.reference for one in found] == numbers[: len(found)]
    for one in found:
        i, j = one.best
        low = np.maximum(one.query_boxes[:, None, :2], one.match_boxes[None, :, :2])
        high = np.minimum(one.query_boxes[:, None, 2:], one.match_boxes[None, :, 2:])
        area = np.nan_to_num(np.maximum(high - low, 0.0).prod(axis=2))
        assert area[i, j] == pytest.approx(area.max(), abs=1e-9)
        for window in (one.query_window, one.match_window):
            assert np.all((window >= 0) & (window <= 1 + 1e-9))
            assert np.all(window[2:] > window[:2])
