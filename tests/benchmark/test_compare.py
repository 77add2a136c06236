"""`vplog compare`: what it finds on pictures whose truth is known, what it counts, what it writes, what it refuses."""

from __future__ import annotations

import csv
import os
import shutil
from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pyarrow as pa
import pytest

from tests.pictures import day_and_dusk
from tests.places.sequence_matrix import match_sequences
from vplog import logs
from vplog.benchmark import compare
from vplog.benchmark.compare_figures import queries_shown
from vplog.benchmark.feature_cache import CacheChoice, FeatureFolder
from vplog.benchmark.method_scores import MethodInputs, evaluate_method, stored_bytes
from vplog.benchmark.recogniser_specs import read_method, read_methods, split_methods
from vplog.benchmark.sequence_fit import sequence_warning
from vplog.benchmark.traversals import candidate_stops, extract_traversal, references_of
from vplog.cli.printing import print_comparison
from vplog.errors import LogError, SettingsError
from vplog.evaluate.open_set import score_open_set
from vplog.evaluate.pairs import index_pairs, listed_pairs
from vplog.evaluate.place_truth import TruthChoice
from vplog.evaluate.retrieval import rank_queries, score_retrieval
from vplog.execution.execution import Execution
from vplog.features.sift import SiftSettings
from vplog.geometry import se3
from vplog.pipeline import Pipeline, load_pipeline
from vplog.places import KINDS
from vplog.places.bobb import BobbSettings
from vplog.places.bobb_paper import PaperBobbSettings
from vplog.places.library_files import load_references, name_extractor
from vplog.places.sequence import SequenceSettings
from vplog.places.vectors import VectorsSettings
from vplog.results.run_record import read_run_json

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from conftest import Said

    from vplog.benchmark.traversals import Traversal
    from vplog.data import Ints
    from vplog.evaluate.pairs import Pairs
    from vplog.verbs.demo.record import Demo

    Verb = Callable[..., Said]

SIFT = SiftSettings(max_features=250, max_megapixels=0.06)
BOBB = BobbSettings(features=250, references=4)
SMALL = Pipeline(features=SIFT, places=BOBB)
QUICK = (
    *("--set", "features.max_features=250"),
    *("--set", "features.max_megapixels=0.06"),
    *("--set", "places.references=4"),
)
FRAMES = 16
TIMES = {"encode_ms", "feature_ms", "mining_ms", "query_ms", "learn_s"}


@pytest.fixture(scope="module")
def traversals(compiled: None, drive: Demo, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    folders = tmp_path_factory.mktemp("traversals") / "day", tmp_path_factory.mktemp("traversals") / "dusk"
    for folder in folders:
        folder.mkdir()
    for number, images in enumerate(day_and_dusk(drive.log, FRAMES)):
        for folder, image in zip(folders, images, strict=True):
            cv2.imwrite(str(folder / f"{number}.png"), image)
    return folders


@pytest.fixture
def store(tmp_path: Path) -> FeatureFolder:
    (tmp_path / "features").mkdir()
    return FeatureFolder(tmp_path / "features", tmp_path / "features")


@pytest.fixture(scope="module")
def day(traversals: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Traversal:
    folder = FeatureFolder(place := tmp_path_factory.mktemp("day"), place)
    return extract_traversal(logs.open(traversals[0]), SIFT, folder, execution=Execution(2))


def inputs_of(walk: Traversal, truth: Pairs, stops: Ints, *more: Any, **others: Any) -> MethodInputs:
    """A drive against itself."""
    references = references_of(walk, np.array([1, 5, 9, 13]))
    return MethodInputs(references, walk, walk, truth, stops, *more, **others)


def without_times(record: dict[str, Any]) -> dict[str, Any]:
    methods = {
        name: {key: value for key, value in method.items() if key not in TIMES}
        for name, method in record["methods"].items()
    }
    return {**record, "methods": methods}


# One walk, one method


def test_a_walk_holds_the_chosen_frames(traversals: tuple[Path, Path], store: FeatureFolder) -> None:
    log = logs.open(traversals[0])
    seen = []
    walk = extract_traversal(log, SIFT, store, np.array([2, 3, 7]), Execution(2, lambda *at: seen.append(at)))
    assert walk.frames.tolist() == [2, 3, 7]
    assert walk.stamp_ns.tolist() == log.stamps()[[2, 3, 7]].tolist()
    assert [reference.stamp_ns for reference in references_of(walk, np.array([3]))] == [int(log.stamps()[3])]
    assert len(walk.feature_ms) == len(walk.store) == 3
    assert (walk.feature_ms > 0).all()
    assert seen == [("extract day", done, 3) for done in (1, 2, 3)]
    frame = next(iter(log.frames(log.stamps()[[7]]))).decode()
    np.testing.assert_array_equal(walk.features(2).descriptors, SIFT(frame.image).descriptors)


def test_features_stay_what_they_are_when_another_process_writes_them_again(
    traversals: tuple[Path, Path], store: FeatureFolder
) -> None:
    """Its times have other lengths as text, and its threads are ahead by another number of frames."""
    log, stamps = logs.open(traversals[0]), np.arange(5)
    first = extract_traversal(log, SIFT, store, stamps)
    before = [first.store[row].descriptors for row in range(5)]
    for file in store.folder.iterdir():
        file.unlink()
    with pytest.MonkeyPatch.context() as clock:
        clock.setattr("vplog.benchmark.feature_cache.time.thread_time", iter(np.arange(20.0) ** 9 / 7).__next__)
        again = extract_traversal(log, SIFT, store, stamps)
    assert (again.feature_ms != first.feature_ms).all()
    for row in range(5):
        np.testing.assert_array_equal(first.store[row].descriptors, before[row])


def test_frames_keep_their_numbers_where_others_are_damaged(
    traversals: tuple[Path, Path], store: FeatureFolder, tmp_path: Path
) -> None:
    folder = tmp_path / "damaged"
    folder.mkdir()
    for number in range(4):
        data = (traversals[0] / f"{number}.png").read_bytes()
        (folder / f"{number}.png").write_bytes(data[:100] if number == 1 else data)
    walk = extract_traversal(logs.open(folder), SIFT, store)
    assert walk.frames.tolist() == [0, 1, 2, 3]
    assert walk.decoded.tolist() == [0, 2, 3]
    assert walk.picture(1) is None
    np.testing.assert_array_equal(walk.features(2).points, walk.store[1].points)
    assert len(references_of(walk, np.array([1, 2]))) == 1
    assert "1 of 4 frames could not be decoded" in walk.warnings[0]
    with pytest.raises(LogError, match="none of 1 frames could be decoded"):
        extract_traversal(logs.open(folder), SIFT, store, np.array([1]))


@pytest.mark.usefixtures("computed_anew")
def test_threads_and_scratch_change_nothing(day: Traversal, tmp_path: Path) -> None:
    """A drive against itself: frames 4 older or more, of which those 4 to 6 older are called true."""
    stops = candidate_stops(day.frames, day.frames, 4)
    truth = index_pairs(day.frames - 5, day.frames, 1)
    results = [
        evaluate_method(BOBB, inputs_of(day, truth, stops, scratch=scratch), Execution(threads))
        for threads, scratch in ((1, None), (3, tmp_path))
    ]
    a, b = results
    np.testing.assert_array_equal(a.scores, b.scores)
    assert without_times({"methods": {"m": a.figures}}) == without_times({"methods": {"m": b.figures}})
    for q in range(FRAMES):
        assert np.isfinite(a.scores[q, : max(q - 3, 0)]).all()
        assert np.isnan(a.scores[q, max(q - 3, 0) :]).all()


def test_figures_of_a_method(day: Traversal) -> None:
    """Every frame finds itself first: each has some feature in the library and no twin."""
    truth = index_pairs(day.frames, day.frames, 0)
    seen: list[tuple[str, int, int]] = []
    inputs = inputs_of(day, truth, np.full(FRAMES, FRAMES))
    result = evaluate_method(BOBB, inputs, Execution(1, lambda name, done, total: seen.append((name, done, total))))
    assert result.ranks.top_row.tolist() == list(range(FRAMES))
    assert (result.figures["r_at_1"], result.figures["ap"], result.figures["anr"]) == (1.0, 1.0, 0.0)
    assert result.figures["bytes_per_image"] == 4 * (2 + 1 + 9)  # J references with a weight and I boxes each
    assert result.figures["settings"] == BOBB.model_dump(mode="json")
    assert all(result.figures[name] > 0 for name in TIMES)
    parts = result.figures["feature_ms"] + result.figures["mining_ms"]
    assert result.figures["encode_ms"] == pytest.approx(parts, abs=0.002)  # each is rounded to a microsecond
    assert ("search", FRAMES, FRAMES) in seen
    assert "sequence" not in result.figures
    assert result.sequence_ranks is None


def test_figures_of_sequences(day: Traversal, tmp_path: Path) -> None:
    """Beside those of single views, and the same as by the whole matrix at once."""
    truth, stops = index_pairs(day.frames - 5, day.frames, 1), candidate_stops(day.frames, day.frames, 4)
    sequence = SequenceSettings(length=5)
    single = evaluate_method(BOBB, inputs_of(day, truth, stops))
    for scratch, threads in ((None, 1), (tmp_path, 3)):
        both = evaluate_method(BOBB, inputs_of(day, truth, stops, sequence, scratch), Execution(threads))
        lines = rank_queries(match_sequences(single.scores, sequence, stops), truth, stops)
        found = both.figures.pop("sequence")
        assert without_times({"methods": {"m": both.figures}}) == without_times({"methods": {"m": single.figures}})
        scored = {**asdict(score_retrieval(lines)), "open_set": score_open_set(lines)}
        assert found == sequence.model_dump() | scored
        assert both.sequence_ranks is not None
        np.testing.assert_array_equal(both.sequence_ranks.top_row, lines.top_row)


def test_candidates_are_older_by_the_gap() -> None:
    assert candidate_stops(np.arange(6), np.arange(4), None).tolist() == [4] * 6
    assert candidate_stops(np.arange(6), np.arange(6), 2).tolist() == [0, 0, 1, 2, 3, 4]
    lost = np.array([0, 1, 4, 5])  # 2 and 3 could not be decoded
    assert candidate_stops(lost, lost, 2).tolist() == [0, 0, 2, 2]


def test_bytes_of_a_column() -> None:
    lists = pa.array([[1, 2, 3], [], [4]], pa.list_(pa.int16()))
    fixed = pa.array([[1, 2], [3, 4], [5, 6]], pa.list_(pa.uint8(), 2))
    both = pa.StructArray.from_arrays([lists, fixed], names=["lists", "fixed"])
    assert stored_bytes(fixed) == 6
    assert stored_bytes(lists) == 4 * 2 + 3 * 4  # values, offsets
    assert stored_bytes(both) == 6 + 20
    assert stored_bytes(pa.array([b"abc", b"d"], pa.binary())) == 4 + 2 * 4
    assert stored_bytes(pa.array([1.0, None, 2.0], pa.float32())) == 12
    assert stored_bytes(fixed.slice(1, 1)) == 2


# Names of methods


def test_methods_by_kind_pipeline_and_setting(tmp_path: Path) -> None:
    file = tmp_path / "mine.yaml"
    file.write_text("places:\n  kind: bobb_paper\n  boxes: 2\n")
    assert read_method("bobb", Pipeline()) == BobbSettings()
    assert read_method("bobb", SMALL) == BOBB
    assert read_method("bobb_paper:boxes=9:aspects=[1, 2]", SMALL).aspects == (1.0, 2.0)
    assert read_method("paper", SMALL) == load_pipeline("paper").places
    assert read_method(f"{file}:seed=3", SMALL) == PaperBobbSettings(boxes=2, seed=3)
    for kind, settings in KINDS.items():
        assert read_method(kind, Pipeline()).kind == kind == settings().kind


def test_files_in_folders_with_an_equals_sign(tmp_path: Path) -> None:
    path = tmp_path / "lr=0.1" / "a:b.npy"
    assert read_method(f"vectors:{path}:order=frames", Pipeline()) == VectorsSettings(file=str(path), order="frames")


def test_commas_inside_brackets_belong_to_a_value() -> None:
    assert split_methods("a, b:c=[1,2]:d=2,e") == ["a", "b:c=[1,2]:d=2", "e"]
    assert split_methods("a") == ["a"]


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("sift", "No method 'sift'. Methods: bobb"),
        ("", "No method ''"),
        ("bobb:rows", "'rows' is not a setting with a value"),
        ("bobb:rows=[", "is not a setting with a value"),
        ("bobb:rows=0", "rows"),
        ("bobb:box=2", "box"),
        ("bobb:kind=other", "kind"),
        ("missing.yaml", "missing.yaml"),
    ],
)
def test_methods_that_do_not_exist(name: str, said: str) -> None:
    with pytest.raises(SettingsError) as error:
        read_method(name, Pipeline())
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_answers_are_a_method_where_they_are_taken() -> None:
    for answers in (True, False):
        with pytest.raises(SettingsError) as error:
            read_methods(["answer:paper.csv"], Pipeline(), answers=answers)
        assert ("Did you mean answers?" in str(error.value)) == answers


# Two drives, or one


def test_the_same_frames_at_dusk(traversals: tuple[Path, Path]) -> None:
    day, dusk = traversals
    methods = ["bobb", "bobb:windows_along=2", "bovf:words=300"]
    options = compare.CompareOptions(library_size=8)
    done = compare.compare(dusk, day, methods, TruthChoice("index"), SMALL, options, Execution(2))
    assert done.record["queries"] == done.record["map_frames"] == done.record["positives"] == FRAMES
    truth = {"source": "index", "tolerance": 0, "by": "names", "same_place": "the same number in the file name"}
    assert done.record["truth"] == {**truth, "pairs": FRAMES}
    assert done.record["library"]["size"] == 8
    assert list(done.record["methods"]) == list(done.ranks) == methods
    assert done.record["methods"]["bovf:words=300"]["r_at_1"] > 0.9
    # half the frames of the map are references: each explains itself, and its twin at dusk
    assert done.record["methods"]["bobb"]["r_at_1"] > 0.7
    assert done.record["methods"]["bobb"]["settings"]["windows_along"] == 3


def test_names_without_numbers_are_paired_in_order_and_it_is_said(
    verb: Verb, traversals: tuple[Path, Path], tmp_path: Path
) -> None:
    (tmp_path / "names").mkdir()
    for number in range(FRAMES):
        name = tmp_path / "names" / f"{chr(ord('a') + number)}.png"
        name.symlink_to(traversals[0] / f"{number}.png")
    for folder in (tmp_path / "names", traversals[1]):
        arguments = ("compare", folder, traversals[0], "--truth", "index", "--methods", "thumbnail", "--json", *QUICK)
        said = [warning for warning in verb(*arguments).json["warnings"] if "pairs frames in order" in warning]
        assert len(said) == (folder.name == "names")


def test_a_drive_against_itself(verb: Verb, drive: Demo) -> None:
    """The positives are those that the truth has, counted pair by pair."""
    found = verb(
        "compare", drive.log, "--min-gap", 20, "--truth", drive.truth, "--methods", "bobb", "--json", *QUICK
    ).json
    relative = se3.between(drive.world_from_body[:, None], drive.world_from_body[None])
    near = np.linalg.norm(relative[..., :3, 3], axis=-1) <= 6.0
    same = near & (np.degrees(se3.angle(relative)) <= 45.0) & np.tri(len(near), k=-20, dtype=bool)
    assert found["truth"]["pairs"] == same.sum()
    assert found["positives"] == same.any(1).sum() > 5
    assert found["query"] == found["map"] == str(drive.log)
    assert found["library"]["size"] == 8  # as `run` takes of so few keyframes
    assert found["methods"]["bobb"]["r_at_1"] > 0.5
    assert {*TIMES, "r_at_5", "r_at_10", "anr", "ap", "recall_at_p100", "f1", "bytes_per_image"} < {
        *found["methods"]["bobb"]
    }


def test_the_log_tells_its_own_truth(verb: Verb, drive: Demo) -> None:
    """By GPS and by odometry, with the drive given twice."""
    for source in ("gps", "poses"):
        arguments = ("compare", drive.log, drive.log, "--min-gap", 20, "--truth", source, "--methods", "thumbnail")
        found = verb(*arguments, "--distance-m", 10, "--json", *QUICK).json
        assert found["truth"]["source"] == source
        assert found["truth"]["distance_m"] == 10
        assert 5 < found["positives"] < found["queries"]


@pytest.mark.usefixtures("computed_anew")
def test_files_are_the_same_every_time(verb: Verb, traversals: tuple[Path, Path], tmp_path: Path) -> None:
    day, dusk = traversals
    (tmp_path / "truth.csv").write_text("query,match\n" + "".join(f"{i},{i}\n" for i in range(FRAMES)))
    outs = [tmp_path / "a", tmp_path / "b"]
    for out, threads in zip(outs, (1, 3), strict=True):
        said = verb(
            "compare", dusk, day, "--truth", tmp_path / "truth.csv", "--methods", "bobb,paper:partitions=5",
            "--library-size", 6, "--sequence", 3, "-o", out, "--threads", threads, *QUICK,
        )  # fmt: skip
        assert said.code == 0, said.err
        assert "bobb" in said.out
        assert "paper:partitions=5" in said.out
    names = sorted(file.name for file in outs[0].iterdir())
    assert [name for name in names if not name.startswith("misses-")] == [
        "answers.csv",
        "compare.json",
        "curves.png",
        "curves.svg",
        "scores-01-bobb.npz",
        "scores-02-paper_partitions=5.npz",
        "similarity.png",
    ]
    rows = csv.DictReader((outs[0] / "answers.csv").open())
    assert {row["evidence"] for row in rows if row["method"] == "bobb" and row["match"]} <= {
        "keypoints", "keypoints and patches",
    }  # fmt: skip
    for name in set(names) - {"compare.json"}:
        assert (outs[0] / name).read_bytes() == (outs[1] / name).read_bytes()
    records = [read_run_json(out / "compare.json") for out in outs]
    assert without_times(records[0]) == without_times(records[1])
    assert all(record["methods"]["bobb"]["sequence"]["length"] == 3 for record in records)
    with np.load(outs[0] / records[0]["methods"]["bobb"]["scores"]) as scores:
        assert scores["scores"].shape == (FRAMES, FRAMES)
        assert scores["scores"].dtype == np.float32
        assert scores["query_frame"].tolist() == scores["map_frame"].tolist() == list(range(FRAMES))
        assert scores["query_name"].tolist() == scores["map_name"].tolist() == [f"{i}.png" for i in range(FRAMES)]
    assert b"paper:partitions=5" in (outs[0] / "curves.svg").read_bytes()


def test_a_row_for_every_query(verb: Verb, traversals: tuple[Path, Path], tmp_path: Path) -> None:
    """By file names; a table by names leaves queries without a match, and the protocol says how many have one."""
    day, dusk = traversals
    truth = tmp_path / "truth.csv"
    truth.write_text("query,match\n" + "".join(f"dusk/{i}.png,{i}.png\n" for i in range(0, FRAMES, 2)))
    arguments = ("compare", dusk, day, "--methods", "thumbnail,gist", "--sequence", 3, "--truth", truth, *QUICK)
    found = verb(*arguments, "--json", "-o", tmp_path / "out").json
    assert found["protocol"]["with_match"] == found["positives"] == FRAMES // 2
    assert found["protocol"]["text"] in verb(*arguments).out
    assert f"{FRAMES // 2} of {FRAMES} queries have a match, {FRAMES // 2} pairs" in found["protocol"]["text"]
    rows = list(csv.DictReader((tmp_path / "out" / "answers.csv").open()))
    assert len(rows) == 4 * FRAMES
    single = [row for row in rows if row["method"] == "thumbnail"]
    assert [row["query_name"] for row in single] == [f"{i}.png" for i in range(FRAMES)]
    assert [row["true_name"] for row in single] == [f"{i}.png" if i % 2 == 0 else "" for i in range(FRAMES)]
    right = [row["match_name"] == row["true_name"] for row in single if row["true_name"]]
    assert np.mean(right) == pytest.approx(found["methods"]["thumbnail"]["r_at_1"])
    assert [row["right"] for row in single if row["true_name"]] == ["true" if one else "false" for one in right]
    assert all((row["rank"] == "1") == (row["right"] == "true") for row in single)
    assert not any(row["evidence"] for row in rows), "there is one kind"


def test_without_a_truth_there_are_answers(verb: Verb, traversals: tuple[Path, Path], tmp_path: Path) -> None:
    day, dusk = traversals
    arguments = ("compare", dusk, day, "--methods", "thumbnail,gist", *QUICK)
    found = verb(*arguments, "-o", tmp_path / "out", "--json")
    assert found.err == ""  # nothing about times, odometry or truth
    assert "r_at_1" not in found.json["methods"]["gist"]
    names = {file.name for file in (tmp_path / "out").iterdir()}
    assert {"answers.csv", "answers-01-thumbnail.png", "answers-02-gist.png", "similarity.png"} <= names
    assert not names & {"curves.png", "misses-01-thumbnail.png"}
    said = verb(*arguments).out
    assert "7.png" in said
    assert "no truth was given, so nothing is scored" in said
    assert "--truth" in verb(*arguments, "--tolerance", 1).error


def test_features_are_kept_between_calls(
    verb: Verb, traversals: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    day, dusk = traversals
    arguments = ("compare", dusk, day, "--methods", "bovf:words=50", "--truth", "index", "--json", *QUICK)
    cache = ("--cache", tmp_path / "cache")
    before = verb(*arguments, *cache).json
    with monkeypatch.context() as patch:
        patch.setattr(SiftSettings, "__call__", None)  # no image is described again
        assert without_times(verb(*arguments, *cache).json) == without_times(before)
        assert verb(*arguments, *cache, "--set", "features.max_features=249").code == 1
    files = sorted((tmp_path / "cache" / "features").iterdir())
    files[0].write_bytes(files[0].read_bytes()[:-1])  # damaged: made again
    assert without_times(verb(*arguments, *cache).json) == without_times(before)
    own = tmp_path / "cache" / "features" / "drive" / "own.bin"
    own.parent.mkdir()
    own.write_bytes(bytes(100_000))
    assert verb(*arguments, *cache, "--cache-gb", 0.00001).code == 0
    assert list((tmp_path / "cache" / "features").rglob("*.*")) == [own], "the user's, in a folder named by the user"
    assert verb(*arguments, "--cache", tmp_path / "none", "--cache-gb", 0).code == 0
    assert not (tmp_path / "none").exists()


def test_misses_are_those_given_another_row() -> None:
    """The most certain first; queries without a match after those with one; no row that is right among equals."""
    scores = np.array([[9, 0, 0], [5, 7, 0], [0, 8, 0], [6, 6, 6], [0, 0, 4]], np.float32)
    truth = listed_pairs(np.array([[0, 0], [1, 0], [2, 0], [3, 0]]), np.arange(5), np.arange(3))
    ranks = rank_queries(scores, truth, np.full(5, 3))
    assert queries_shown(ranks).tolist() == [2, 1, 4]
    unscored = rank_queries(scores, listed_pairs(np.zeros((0, 2), int), np.arange(5), np.arange(3)), np.full(5, 3))
    assert queries_shown(unscored).tolist() == [0, 1, 2, 3, 4]


def test_misses_are_drawn(verb: Verb, traversals: tuple[Path, Path], tmp_path: Path) -> None:
    """Beside the given and the right answer; where the truth is wrong all but one are."""
    day, dusk = traversals
    truth = tmp_path / "truth.csv"
    truth.write_text("query,match\n" + "".join(f"{i},{(i + 7) % FRAMES}\n" for i in range(FRAMES - 2)))
    out = tmp_path / "out"
    arguments = ("compare", dusk, day, "--methods", "thumbnail", "--truth", truth, "-o", out, *QUICK)
    assert verb(*arguments).code == 0
    image = np.asarray(cv2.imread(str(out / "misses-01-thumbnail.png")))
    assert image.shape[0] > image.shape[1]
    assert image.std() > 20


@pytest.mark.parametrize(("step", "said"), [(1, ""), (3, "advance by 3 frames"), (-1, "run back or jump")])
def test_sequences_that_do_not_fit_are_warned_of(step: int, said: str) -> None:
    """The map advances by `step` frames a view of the query, and lines of about 1 are tried."""
    listed = np.column_stack([np.arange(30), (step * np.arange(30)) % 90])
    pairs = listed_pairs(listed, np.arange(30), np.arange(90))
    found = sequence_warning(pairs, SequenceSettings(length=11), has_truth=True)
    assert [said in one and "harms" in one for one in found] == ([True] if said else [])
    fitting = SequenceSettings(length=11, slowest=2.7, fastest=3.3)
    assert bool(sequence_warning(pairs, fitting, has_truth=True)) == (step != 3)


@pytest.mark.parametrize(("tolerance", "warned"), [(0, True), (2, False)])
def test_a_short_sequence_that_ends_off_its_line_is_warned_of(tolerance: int, warned: bool) -> None:
    """Of five views the two beside the middle are a row off a line of 1, and the outer ones two."""
    pairs = index_pairs(2 * np.arange(20), np.arange(40), tolerance)
    assert bool(sequence_warning(pairs, SequenceSettings(length=5), has_truth=True)) == warned


def test_folders_are_labels(verb: Verb, traversals: tuple[Path, Path], tmp_path: Path) -> None:
    """Four views a place, in folders; `study` takes them too, and a table of pairs of two drives both ways."""
    sets = [tmp_path / name for name in ("one", "two")]
    for source, target in zip(traversals, sets, strict=True):
        for number in range(FRAMES):
            (target / f"place {number // 4}").mkdir(parents=True, exist_ok=True)
            shutil.copy(source / f"{number}.png", target / f"place {number // 4}" / f"{number % 4}.png")
    found = verb("compare", sets[1], sets[0], "--methods", "thumbnail", "--truth", "labels", "--json", *QUICK).json
    assert (found["queries"], found["truth"]["labels"], found["truth"]["pairs"]) == (FRAMES, 4, 4 * FRAMES)
    assert found["answers"][5]["query_name"] == "place 1/1.png"
    table = tmp_path / "labels.csv"
    rows = [f"place {number // 4}/{number % 4}.png,{number // 4}\n" for number in range(FRAMES)]
    table.write_text("".join(["image,label\n", *rows]))
    listed = verb("compare", sets[1], sets[0], "--methods", "thumbnail", "--truth", table, "--json", *QUICK).json
    assert listed["truth"]["pairs"] == 4 * FRAMES
    truth = tmp_path / "truth.csv"
    truth.write_text("query,match\nplace 1/0.png,place 3/1.png\nplace 2/0.png,place 3/1.png\n")
    study = ("study", *sets, "--methods", "thumbnail", "--only", "pairs", "--seeds", 1, "--json", *QUICK)
    labels = verb(*study, "--truth", "labels", "-o", tmp_path / "a").json
    assert [one["pairs"] for one in labels["protocol"]] == [4 * FRAMES] * 2
    topics = ("--image-topic", "*")
    pairs = verb(*study, "--truth", truth, "-o", tmp_path / "b", *topics).json
    assert [(one["query"], one["with_match"]) for one in pairs["protocol"]] == [("two", 1), ("one", 2)]


def test_probabilities_are_held_against_the_truth(verb: Verb, traversals: tuple[Path, Path], tmp_path: Path) -> None:
    """Only FAB-MAP states any; a comparison without it has no diagram, not even one of an earlier comparison."""
    day, dusk = traversals
    out = tmp_path / "out"
    arguments = ("compare", dusk, day, "--truth", "index", "--library-size", 12, "-o", out, "--json", *QUICK)
    found = verb(*arguments, "--methods", "fabmap,thumbnail").json["methods"]
    assert "calibration" not in found["thumbnail"]
    said = found["fabmap"]["calibration"]
    assert sum(said["count"]) == FRAMES
    right = sum(n * share for n, share in zip(said["count"], said["accuracy"], strict=True) if n)
    assert right / FRAMES == pytest.approx(found["fabmap"]["r_at_1"])
    assert 0 <= said["expected_calibration_error"] <= 1
    assert (out / "reliability.png").read_bytes()[1:4] == b"PNG"
    assert "calibration" not in verb(*arguments, "--methods", "thumbnail").json["methods"]["thumbnail"]
    assert not (out / "reliability.png").exists()


def test_an_interrupted_comparison_leaves_the_one_before(
    verb: Verb, traversals: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    day, dusk = traversals
    out = tmp_path / "out"
    arguments = ("compare", dusk, day, "--truth", "index", "--methods", "thumbnail", "-o", out, "--json", *QUICK)
    assert verb(*arguments).code == 0
    before = {file.name: file.read_bytes() for file in out.iterdir()}

    def interrupted(*_: object) -> None:
        raise KeyboardInterrupt

    for last in ("vplog.benchmark.compare._write_scores", "vplog.benchmark.compare_figures.draw_curves"):
        with monkeypatch.context() as patch:
            patch.setattr(last, interrupted)
            assert verb(*arguments, "--library-size", 5).code == 130
        assert {file.name: file.read_bytes() for file in out.iterdir()} == before


def test_libraries_of_every_origin(
    verb: Verb, traversals: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The map's own frames are the default; a drive is drawn from in the same way; a saved library is taken whole."""
    day, dusk = traversals
    saved = tmp_path / "library"
    assert verb("library", day, "-o", saved, "--set", "library.size=6", *QUICK).code == 0
    arguments = ("compare", dusk, day, "--truth", "index", "--methods", "vlad:centres=8", "--json", *QUICK)
    arguments += ("--library-size", 6)
    found = [verb(*arguments, *more).json for more in ((), ("--library", day), ("--library", dusk))]
    found.append(verb(*arguments[:-2], "--library", saved).json)
    default, named, other, stored = (record["library"] for record in found)
    assert default == named
    assert other["from"] == str(dusk)
    assert other["hash"] != default["hash"]
    assert (stored["size"], stored["seed"], stored["hash"]) == (6, None, default["hash"])
    assert without_times(found[0])["methods"] == without_times(found[3])["methods"]
    assert not any("strongest features" in warning for warning in found[3]["warnings"])
    cut = tmp_path / "cut"
    assert verb("library", day, "-o", cut, "--set", "library.size=6", *QUICK, "--set", "places.features=20").code == 0
    warned = verb(*arguments[:-2], "--library", cut).json["warnings"]
    assert any("20 strongest features of an image" in one and "vlad:centres=8" in one for one in warned)
    few = verb(*arguments, "--library-size", 50).json
    assert few["library"]["size"] == FRAMES
    assert any("16 images instead of 50" in warning for warning in few["warnings"])
    name_extractor(saved, {"kind": "onnx", "sha256": "0"})
    assert "was made with features.kind=onnx" in verb(*arguments[:-2], "--library", saved).error
    name_extractor(saved, SIFT.identity())
    (saved / "features.parquet").write_bytes(b"damaged")
    monkeypatch.setattr(compare, "extract_traversal", None)  # which takes minutes, so a library is read before
    assert str(saved) in verb(*arguments, "--library", saved).error


def test_a_drives_own_past_with_the_library_of_a_log(traversals: tuple[Path, Path]) -> None:
    options = compare.CompareOptions(library=traversals[1], min_gap=5)
    found = compare.compare(traversals[0], None, ["thumbnail"], None, SMALL, options).record["library"]
    assert (found["from"], found["size"]) == (str(traversals[1]), FRAMES)


def test_the_only_query_with_a_match_does_not_decode(verb: Verb, traversals: tuple[Path, Path], tmp_path: Path) -> None:
    shutil.copytree(traversals[1], tmp_path / "dusk")
    os.truncate(tmp_path / "dusk" / "3.png", 200)
    (tmp_path / "truth.csv").write_text("query,match\n3.png,3.png\n")
    arguments = ("compare", tmp_path / "dusk", traversals[0], "--truth", tmp_path / "truth.csv", *QUICK)
    said = verb(*arguments, "--methods", "thumbnail", "-o", tmp_path / "out", "--json")
    assert said.code == 0, said.err
    assert said.json["positives"] == 1
    assert [said.json["methods"]["thumbnail"][name] for name in ("r_at_1", "ap", "anr")] == [0, 0, 100 * 15 / 16]


def test_frames_without_truth_are_left_out(verb: Verb, drive: Demo, tmp_path: Path) -> None:
    part = tmp_path / "part.tum"
    lines = drive.truth.read_text().splitlines()
    kept = [line for line in lines if not line.startswith("#") and float(line.split()[0]) * 1e9 >= drive.stamp_ns[3]]
    part.write_text("\n".join(kept) + "\n")
    found = verb(
        "compare", drive.log, "--min-gap", 20, "--truth", part, "--methods", "thumbnail", "--json", *QUICK
    ).json
    assert found["queries"] == len(drive.stamp_ns) - 3
    assert any(f"3 of {len(drive.stamp_ns)} frames have no truth" in warning for warning in found["warnings"])


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("DAY", "--truth", "index"), "compared with itself, where every frame finds itself"),
        (("DAY", "DAY", "--truth", "index"), "--min-gap 50"),
        (("DUSK", "DAY", "--truth", "index", "--min-gap", "5"), "--min-gap is for a drive compared with itself"),
        (("DAY", "--truth", "index", "--min-gap", "5"), "none of the 16 frames of day shows a place of a frame of day"),
        (("DUSK", "DAY", "--truth", "index", "--methods", "bobb,bobb"), "name each method once"),
        (("DUSK", "DAY", "--truth", "index", "--methods", "bobb,surf"), "No method 'surf'. Methods: answers, bobb"),
        (
            ("DUSK", "DAY", "--truth", "index", "--distance-m", "3"),
            "takes no --distance-m: it is for utm, poses, a TUM",
        ),
        (("DUSK", "DAY", "--truth", "gps", "--heading-deg", "3"), "takes no --heading-deg"),
        (("DUSK", "DAY", "--truth", "index", "--sequence", "4"), "length 4 is even"),
        (("DUSK", "DAY", "--truth", "poses"), "has no odometry"),
        (("DUSK", "DAY", "--truth", "gps"), "has no GPS fixes"),
        (("DUSK", "DAY", "--truth", "missing.csv"), "Cannot read missing.csv"),
        (("DUSK", "DAY", "--truth", "missing.tum"), "Cannot read missing.tum"),
        (
            ("DUSK", "DAY", "--truth", "index", "--methods", "vlad", "--library-size", "1"),
            "at least two; one was given",
        ),
        (("DUSK", "DAY", "--truth", "index", "--library", "nowhere"), "nowhere"),
        (("DUSK", "NOWHERE", "--truth", "index"), "nowhere"),
        (("DUSK", "DAY", "--truth", "index", "-o", "DAY"), "a folder with other things in it, not a comparison"),
    ],
)
def test_what_cannot_be_compared_is_said_in_one_line(
    verb: Verb, traversals: tuple[Path, Path], tmp_path: Path, arguments: tuple[str, ...], said: str
) -> None:
    folders = {"DAY": traversals[0], "DUSK": traversals[1], "NOWHERE": tmp_path / "nowhere"}
    named = [folders.get(argument, argument) for argument in arguments]
    methods = () if "--methods" in arguments else ("--methods", "bobb")
    assert said in verb("compare", *named, *methods, *QUICK).error


def test_what_a_comparison_would_ignore_is_refused(verb: Verb, traversals: tuple[Path, Path], tmp_path: Path) -> None:
    options = (*traversals, "--truth", "index", "--methods", "bobb", *QUICK)
    assert "see --library-size" in verb("compare", *options, "--set", "library.size=5").error
    assert "with --sequence" in verb("compare", *options, "--set", "sequence.length=5").error
    library = tmp_path / "library"
    assert verb("library", traversals[1], "-o", library, *QUICK, "--set", "library.size=4").code == 0
    assert "leave out --library-size" in verb("compare", *options, "--library", library, "--library-size", 4).error


def test_another_programs_comparison_is_not_replaced(verb: Verb, traversals: tuple[Path, Path], tmp_path: Path) -> None:
    own = {"compare.json": '{"mine": 1}', "answers.csv": "mine", "curves.png": "mine"}
    for name, text in own.items():
        (tmp_path / name).write_text(text)
    said = verb("compare", *traversals, "--truth", "index", "--methods", "thumbnail", "-o", tmp_path, *QUICK)
    assert "a folder with other things in it, not a comparison" in said.error
    assert {path.name: path.read_text() for path in tmp_path.iterdir()} == own


def test_truth_of_another_drive(verb: Verb, traversals: tuple[Path, Path], drive: Demo) -> None:
    said = verb("compare", traversals[1], traversals[0], "--truth", drive.truth, "--methods", "bobb", *QUICK).error
    assert "covers none of the 16 frames of the query dusk" in said


@pytest.mark.parametrize(
    "wrong",
    [("--distance-m", "0"), ("--distance-m", "nan"), ("--tolerance", "-1"), ("--min-gap", "0"), ("--sequence", "x")],
)
def test_wrong_usage(verb: Verb, wrong: tuple[str, str]) -> None:
    assert verb("compare", "a", "b", "--truth", "index", "--methods", "bobb", *wrong).code == 2


def test_the_time_of_shared_features_is_not_a_methods_own(
    traversals: tuple[Path, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The table has both times side by side; answers from a file have neither."""
    file = tmp_path / "answers.csv"
    file.write_text("query,match\n0,0\n")
    methods = ["gist", f"answers:{file}"]
    record = compare.compare(*traversals, methods, TruthChoice("index"), SMALL).record
    gist = record["methods"]["gist"]
    assert gist["mining_ms"] > 0
    assert gist["feature_ms"] > 0
    gist |= {"mining_ms": 0.2, "feature_ms": 46.0, "query_ms": 0.03, "encode_ms": 46.2}
    print_comparison(record)
    lines = capsys.readouterr().out.splitlines()
    rows = {line.split()[0]: line.split()[1:] for line in lines if line.startswith(("gist", "answers:"))}
    assert rows["gist"][-3:] == ["0.20", "46.00", "0.03"]
    assert len(rows["gist"]) == len(rows[methods[1]]) + 4


@pytest.mark.usefixtures("compiled")
def test_images_of_several_sizes_are_all_used(verb: Verb, traversals: tuple[Path, Path], tmp_path: Path) -> None:
    """By `compare` and `library`, chosen or not, each at its own size: every second image is cropped."""
    folders = tmp_path / "day", tmp_path / "dusk"
    for traversal, folder in zip(traversals, folders, strict=True):
        folder.mkdir()
        for file in traversal.iterdir():
            image = cv2.imread(str(file), cv2.IMREAD_GRAYSCALE)
            assert image is not None
            assert cv2.imwrite(str(folder / file.name), image[:, : -16 * (int(file.stem) % 3) or None])
    for choice in ((), ("--image-topic", "*")):
        given = ("compare", *folders, "--truth", "index", "--methods", "thumbnail,bovf:words=300", *choice, *QUICK[:4])
        record = verb(*given, "--json").json
        assert record["queries"] == record["map_frames"] == record["positives"] == FRAMES
        assert record["library"]["size"] == FRAMES
        assert not record["warnings"]
        assert record["methods"]["thumbnail"]["r_at_1"] > 0.9
    assert verb("library", folders[1], "-o", tmp_path / "library", *QUICK).code == 0
    sizes = {one.features.width for one in load_references(tmp_path / "library")}
    assert len(sizes) > 1


def test_the_mixed_sizes_of_the_shared_data(shared_data: Path) -> None:
    """All 40 queries count, and most are found."""
    folder = shared_data / "mixed_sizes"
    done = compare.compare(folder / "query", folder / "map", ["thumbnail"], TruthChoice("index"), Pipeline())
    assert done.record["queries"] == done.record["positives"] == done.record["map_frames"] == 40
    assert done.record["methods"]["thumbnail"]["r_at_1"] > 0.5


def damaged_copies(traversals: tuple[Path, Path], folder: Path, query: int, other: int) -> tuple[Path, Path]:
    """Copies of the drives with one image of each cut short."""
    found = folder / "dusk", folder / "day"
    for source, target, number in zip(reversed(traversals), found, (query, other), strict=True):
        shutil.copytree(source, target)
        file = target / f"{number}.png"
        file.write_bytes(file.read_bytes()[:100])
    return found


@pytest.mark.usefixtures("compiled")
def test_an_image_that_cannot_be_used_keeps_its_query(
    verb: Verb, traversals: tuple[Path, Path], tmp_path: Path
) -> None:
    """Query 3 does not decode, nor does the true match of query 7. Both count, as not found; answers need no pixels."""
    query, other = damaged_copies(traversals, tmp_path, 3, 7)
    file = tmp_path / "answers.csv"
    file.write_text("query,match\n" + "".join(f"{row},{row}\n" for row in range(FRAMES)))
    given = ("compare", query, other, "--truth", "index", "--methods", f"thumbnail,bobb,answers:{file}")
    out = tmp_path / "out"
    record = verb(*given, *QUICK, "-o", out, "--json").json
    assert record["queries"] == record["map_frames"] == record["positives"] == record["truth"]["pairs"] == FRAMES
    assert record["undecodable"] == {"queries": 1, "map_frames": 1}
    assert record["library"]["size"] == FRAMES - 1
    found = [figures["r_at_10"] for figures in record["methods"].values()]
    assert found == pytest.approx([(FRAMES - 2) / FRAMES, (FRAMES - 2) / FRAMES, 1.0])
    with (out / "answers.csv").open() as stream:
        rows = [row for row in csv.DictReader(stream) if row["method"] == "thumbnail"]
    assert [row["query"] for row in rows] == [str(number) for number in range(FRAMES)]
    assert (rows[3]["match"], rows[3]["true"], rows[3]["rank"]) == ("", "3", "")
    assert rows[7]["match"] not in ("", "7")
    assert (rows[7]["true"], rows[7]["rank"]) == ("7", "")
    scores = np.load(out / record["methods"]["thumbnail"]["scores"])["scores"]
    assert scores.shape == (FRAMES, FRAMES)
    assert np.isnan(scores[3]).all()
    assert np.isnan(scores[:, 7]).all()
    said = verb(*given, *QUICK)
    lines = said.out.splitlines()
    above = lines[: next(number for number, line in enumerate(lines) if line.startswith("method"))]
    assert any("1 of the queries and 1 of the frames" in line for line in above)


def test_vectors_and_answers_need_no_pixels(
    traversals: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """No image is decoded for them, so that damaged ones count like all others."""
    folders = damaged_copies(traversals, tmp_path, 3, 7)
    file, vectors = tmp_path / "answers.csv", tmp_path / "vectors"
    file.write_text("query,match\n" + "".join(f"{row},{row}\n" for row in range(FRAMES)))
    vectors.mkdir()
    for name in ("queries", "database"):
        np.save(vectors / f"{name}_descriptors.npy", np.eye(FRAMES, dtype=np.float32))
    decoded: list[int] = []
    monkeypatch.setattr("vplog.logs.frames.RecordedFrame.decode", lambda frame, _=False: decoded.append(frame.stamp_ns))
    methods = [f"vectors:{vectors}:order=frames", f"answers:{file}"]
    done = compare.compare(*folders, methods, TruthChoice("index"), SMALL)
    assert not decoded
    assert done.record["positives"] == FRAMES
    for figures in done.record["methods"].values():
        assert figures["r_at_1"] == 1.0
    assert done.record["methods"][methods[0]]["feature_ms"] == 0


# Answers from a file


def test_answers_of_a_file_stand_beside_the_methods(traversals: tuple[Path, Path], tmp_path: Path, verb: Verb) -> None:
    numbers = tmp_path / "numbers.csv"
    wrong = {3: 4, 8: 12}
    lines = [f"{query},{wrong.get(query, query)},{0.5 if query in wrong else 0.9}" for query in range(FRAMES - 1)]
    numbers.write_text("\n".join(["query,match,score", *lines, "3,3,0.4", ""]))
    names = tmp_path / "names.csv"
    named = [f"{query}.png,{wrong.get(query, query)}.png" for query in range(FRAMES - 1)]
    names.write_text("\n".join(["query,match", *named, "3.png,3.png"]))
    methods = ["gist", f"answers:{numbers}", f"answers:{names}"]
    options = compare.CompareOptions(library_size=4, out=tmp_path / "out")
    done = compare.compare(*traversals, methods, TruthChoice("index"), SMALL, options)
    of_gist, by_number, by_name = done.record["methods"].values()
    for found in (by_number, by_name):
        assert found["answers"] == FRAMES
        assert found["r_at_1"] == pytest.approx((FRAMES - 3) / FRAMES, abs=0.005)
        assert found["r_at_5"] >= (FRAMES - 2) / FRAMES
        assert "bytes_per_image" in of_gist.keys() - found.keys()
    assert by_number["recall_at_p100"] == pytest.approx((FRAMES - 3) / FRAMES, abs=0.005)
    said = verb(
        "compare", *map(str, traversals), "--methods", f"gist,answers:{names}", "--truth", "index", "--library-size",
        "4", *QUICK[:4],
    )  # fmt: skip
    assert said.code == 0
    assert f"answers:{names}" in said.out


def test_answers_that_were_not_given_are_not_counted(traversals: tuple[Path, Path], tmp_path: Path) -> None:
    """One answer a query, every fourth of them right: looking at five finds no more, and the rest has no rank."""
    file = tmp_path / "answers.csv"
    file.write_text("query,match\n" + "".join(f"{row},{row if row % 4 == 0 else 1}\n" for row in range(FRAMES)))
    done = compare.compare(*traversals, [f"answers:{file}"], TruthChoice("index"), SMALL)
    (found,) = done.record["methods"].values()
    right = FRAMES // 4 + 1  # and query 1
    assert [found[name] for name in ("r_at_1", "r_at_5", "r_at_10")] == pytest.approx([right / FRAMES] * 3)
    assert found["anr"] == pytest.approx(100 * (FRAMES - right) / FRAMES * (FRAMES - 1) / FRAMES)
    rank = done.answers["rank"].to_pylist()
    assert [one for one in rank if one is not None] == [1] * right


def test_a_number_is_a_frame_also_where_images_are_named_by_numbers(
    traversals: tuple[Path, Path], tmp_path: Path
) -> None:
    """As in a table of the truth: images 1.png, 2.png, ... are frames 0, 1, ..."""
    folders = [tmp_path / traversal.name for traversal in traversals]
    for traversal, folder in zip(traversals, folders, strict=True):
        folder.mkdir()
        for number, image in enumerate(sorted(traversal.glob("*.png"), key=lambda path: int(path.stem))):
            (folder / f"{number + 1}.png").symlink_to(image)
    answers = tmp_path / "answers.csv"
    answers.write_text("query,match\n" + "".join(f"{row},{row}\n" for row in range(FRAMES)))
    query, other = folders
    done = compare.compare(query, other, [f"answers:{answers}"], TruthChoice("index", tolerance=0), SMALL)
    (found,) = done.record["methods"].values()
    assert found["r_at_1"] == 1.0


@pytest.mark.parametrize(
    ("text", "message"),
    [
        (None, "No such file"),
        ("", "answers none of 16 frames"),
        ("a,b\n1,2\n", r":1 is not the header"),
        ("query,match\n1\n", r":2 does not hold 2 fields"),
        ("query,match\n1,16\n", r":2: '16' is no frame of dusk, which has 16"),
        ("query,match\n-1,2\n", r"'-1' is no frame of day"),
        ("query,match\nx.png,2\n", r"'x.png' is no frame of day"),
        ("query,match,score\n1,1,nan\n", r"'nan' is not a score"),
        ("query,match\n" + "1" * 5000, "longer than 4096"),
        ("query,match\n\xff", "not a CSV file"),
    ],
)
def test_answers_that_do_not_fit_are_one_line(
    text: str | None, message: str, traversals: tuple[Path, Path], tmp_path: Path
) -> None:
    file = tmp_path / "answers.csv"
    if text is not None:
        file.write_bytes(text.encode("latin-1"))
    pipeline = Pipeline(features=SiftSettings(max_features=20, max_megapixels=0.01))
    options = compare.CompareOptions(library_size=2)
    with pytest.raises(SettingsError, match=message) as caught:
        compare.compare(*traversals, [f"answers:{file}"], TruthChoice("index"), pipeline, options)
    assert "\n" not in str(caught.value)


def test_another_comparison_is_not_replaced(
    verb: Verb, traversals: tuple[Path, Path], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A mistyped -o costs nothing; the same drives are compared again in the same folder, from wherever."""
    options = ("--truth", "index", "--methods", "thumbnail", "-o", tmp_path / "out", *QUICK)
    for folder in (traversals[0].parent, tmp_path):
        monkeypatch.chdir(folder)
        assert verb("compare", *(os.path.relpath(one) for one in traversals), *options).code == 0
    before = (tmp_path / "out" / "compare.json").read_bytes()
    said = verb("compare", *reversed(traversals), *options)
    assert f"holds a comparison of {traversals[0]} in {traversals[1]}" in said.error
    assert (tmp_path / "out" / "compare.json").read_bytes() == before


def test_features_in_use_outlast_the_trimming_of_their_cache(traversals: tuple[Path, Path], tmp_path: Path) -> None:
    """Another comparison with a smaller bound ends while this one reads."""
    log, extractor = logs.open(traversals[0], None), SMALL.features
    with CacheChoice(tmp_path).opened(tmp_path) as cached:
        folder = FeatureFolder.of(*cached, traversals[0], None, log, extractor)
        found = folder.extract(log, log.stamps(), extractor, Execution())
        with CacheChoice(tmp_path, 1e-9).opened(tmp_path):
            pass
        assert not list(cached[0].glob("frames-*"))
        assert len(found[FRAMES - 1].points) > 0
        again = folder.extract(log, log.stamps(), extractor, Execution())
        assert (again[3].points == found[3].points).all()
    assert {path.name.partition("-")[0] for path in cached[0].iterdir()} == {"frames"}
