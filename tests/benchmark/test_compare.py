"""`vplog compare`: what it finds on pictures whose truth is known, what it counts, what it writes, what it refuses."""

from __future__ import annotations

from dataclasses import asdict
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pyarrow as pa
import pytest

from tests.places.sequence_matrix import match_sequences
from vplog import logs
from vplog.benchmark import compare
from vplog.benchmark.method_scores import MethodInputs, evaluate_method, stored_bytes
from vplog.benchmark.recogniser_specs import known_methods, read_method, split_methods
from vplog.benchmark.traversals import candidate_stops, extract_traversal
from vplog.errors import LogError, SettingsError
from vplog.evaluate.pairs import index_pairs
from vplog.evaluate.place_truth import TruthChoice
from vplog.evaluate.retrieval import rank_queries, score_retrieval
from vplog.execution.execution import Execution
from vplog.features.sift import SiftSettings
from vplog.features.store import FeatureStore
from vplog.geometry import se3
from vplog.pipeline import Pipeline, load_pipeline
from vplog.places.bobb import BobbSettings
from vplog.places.bobb_paper import PaperBobbSettings
from vplog.places.sequence import SequenceSettings
from vplog.results.run_record import read_run_json

if TYPE_CHECKING:
    from collections.abc import Callable, Iterator
    from pathlib import Path

    from conftest import Said

    from vplog.benchmark.traversals import Traversal
    from vplog.data import Ints
    from vplog.demo.record import Drive
    from vplog.evaluate.pairs import Pairs

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
def traversals(drive: Drive, tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two folders of the same 16 frames: as they are, and darker with other noise."""
    log = logs.open(drive.log)
    folders = tmp_path_factory.mktemp("traversals") / "day", tmp_path_factory.mktemp("traversals") / "dusk"
    for folder in folders:
        folder.mkdir()
    rng = np.random.default_rng(0)
    for number, frame in enumerate(log.frames(log.stamps()[:FRAMES])):
        day = frame.decode().image
        dusk = np.clip(day * 0.8 + rng.normal(0, 2, day.shape), 0, 255).astype(np.uint8)
        for folder, image in zip(folders, (day, dusk), strict=True):
            cv2.imwrite(str(folder / f"{number}.png"), image)
    return folders


@pytest.fixture
def store(tmp_path: Path) -> Iterator[FeatureStore]:
    with FeatureStore(tmp_path / "features") as found:
        yield found


@pytest.fixture(scope="module")
def day(traversals: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Iterator[Traversal]:
    with FeatureStore(tmp_path_factory.mktemp("day") / "features") as found:
        yield extract_traversal(
            logs.open(traversals[0]), SIFT, found, chosen=np.array([1, 5, 9, 13]), execution=Execution(2)
        )


def inputs_of(walk: Traversal, truth: Pairs, stops: Ints, *more: Any, **others: Any) -> MethodInputs:
    """A drive against itself."""
    return MethodInputs(walk.references, walk, walk, truth, stops, *more, **others)


def without_times(record: dict[str, Any]) -> dict[str, Any]:
    methods = {
        name: {key: value for key, value in method.items() if key not in TIMES}
        for name, method in record["methods"].items()
    }
    return {**record, "methods": methods}


# One walk, one method


def test_a_walk_holds_the_chosen_frames(traversals: tuple[Path, Path], store: FeatureStore) -> None:
    log = logs.open(traversals[0])
    seen = []
    walk = extract_traversal(
        log, SIFT, store, np.array([2, 3, 7]), np.array([3]), Execution(2, lambda *at: seen.append(at))
    )
    assert walk.frames.tolist() == [2, 3, 7]
    assert walk.stamp_ns.tolist() == log.stamps()[[2, 3, 7]].tolist()
    assert [reference.stamp_ns for reference in walk.references] == [int(log.stamps()[3])]
    assert len(walk.feature_ms) == len(store) == 3
    assert (walk.feature_ms > 0).all()
    assert seen == [("extract day", done, 3) for done in (1, 2, 3)]
    frame = next(iter(log.frames(log.stamps()[[7]]))).decode()
    np.testing.assert_array_equal(store[2].descriptors, SIFT(frame.image).descriptors)


def test_frames_keep_their_numbers_where_others_are_damaged(
    traversals: tuple[Path, Path], store: FeatureStore, tmp_path: Path
) -> None:
    folder = tmp_path / "damaged"
    folder.mkdir()
    for number in range(4):
        data = (traversals[0] / f"{number}.png").read_bytes()
        (folder / f"{number}.png").write_bytes(data[:100] if number == 1 else data)
    walk = extract_traversal(logs.open(folder), SIFT, store, chosen=np.array([1, 2]))
    assert walk.frames.tolist() == [0, 2, 3]
    assert len(walk.references) == 1
    assert "1 of 4 frames could not be decoded" in walk.warnings[0]
    with pytest.raises(LogError, match="none of 1 frames could be decoded"):
        extract_traversal(logs.open(folder), SIFT, store, np.array([1]))


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
    result = evaluate_method(BOBB, inputs, Execution(1, lambda *at: seen.append(at)))
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
        assert found == sequence.model_dump() | asdict(score_retrieval(lines))
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
    for kind, settings in known_methods().items():
        assert read_method(kind, Pipeline()).kind == kind == settings().kind


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


# Two drives, or one


def test_the_same_frames_at_dusk(traversals: tuple[Path, Path]) -> None:
    day, dusk = traversals
    methods = ["bobb", "bobb:windows_along=2", "bovf:words=300"]
    options = compare.CompareOptions(library_size=8)
    done = compare.compare(dusk, day, methods, TruthChoice("index"), SMALL, options, Execution(2))
    assert done.record["queries"] == done.record["map_frames"] == done.record["positives"] == FRAMES
    assert done.record["truth"] == {"source": "index", "tolerance": 0, "pairs": FRAMES}
    assert done.record["library"]["size"] == 8
    assert list(done.record["methods"]) == list(done.ranks) == methods
    assert done.record["methods"]["bovf:words=300"]["r_at_1"] > 0.9
    # half the frames of the map are references: each explains itself, and its twin at dusk
    assert done.record["methods"]["bobb"]["r_at_1"] > 0.7
    assert done.record["methods"]["bobb"]["settings"]["windows_along"] == 3


def test_a_drive_against_itself(verb: Verb, drive: Drive) -> None:
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
    assert found["methods"]["bobb"]["r_at_1"] > 0.5
    assert {*TIMES, "r_at_5", "r_at_10", "anr", "ap", "recall_at_p100", "f1", "bytes_per_image"} < {
        *found["methods"]["bobb"]
    }


def test_the_log_tells_its_own_truth(verb: Verb, drive: Drive) -> None:
    """By GPS and by odometry, with the drive given twice."""
    for source in ("gps", "poses"):
        arguments = ("compare", drive.log, drive.log, "--min-gap", 20, "--truth", source, "--methods", "thumbnail")
        found = verb(*arguments, "--distance-m", 10, "--json", *QUICK).json
        assert found["truth"]["source"] == source
        assert found["truth"]["distance_m"] == 10
        assert 5 < found["positives"] < found["queries"]


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
    assert names == [
        "compare.json",
        "curves.png",
        "curves.svg",
        "scores-01-bobb.npz",
        "scores-02-paper_partitions=5.npz",
    ]
    for name in names[1:]:
        assert (outs[0] / name).read_bytes() == (outs[1] / name).read_bytes()
    records = [read_run_json(out / "compare.json") for out in outs]
    assert without_times(records[0]) == without_times(records[1])
    assert all(record["methods"]["bobb"]["sequence"]["length"] == 3 for record in records)
    with np.load(outs[0] / records[0]["methods"]["bobb"]["scores"]) as scores:
        assert scores["scores"].shape == (FRAMES, FRAMES)
        assert scores["scores"].dtype == np.float32
        assert scores["query_frame"].tolist() == scores["map_frame"].tolist() == list(range(FRAMES))
    assert b"paper:partitions=5" in (outs[0] / "curves.svg").read_bytes()


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

    for last in ("vplog.benchmark.compare._write_scores", "vplog.benchmark.compare.draw_curves"):
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
    found = [
        verb(*arguments, *more).json for more in ((), ("--library", day), ("--library", dusk), ("--library", saved))
    ]
    default, named, other, stored = (record["library"] for record in found)
    assert default == named
    assert other["from"] == str(dusk)
    assert other["hash"] != default["hash"]
    assert (stored["size"], stored["seed"], stored["hash"]) == (6, None, default["hash"])
    assert without_times(found[0])["methods"] == without_times(found[3])["methods"]
    few = verb(*arguments, "--library-size", 50).json
    assert few["library"]["size"] == FRAMES
    assert any("16 images instead of 50" in warning for warning in few["warnings"])
    (saved / "features.parquet").write_bytes(b"damaged")
    monkeypatch.setattr(compare, "extract_traversal", None)  # which takes minutes, so a library is read before
    assert str(saved) in verb(*arguments, "--library", saved).error


def test_frames_without_truth_are_left_out(verb: Verb, drive: Drive, tmp_path: Path) -> None:
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
        (("DUSK", "DAY", "--truth", "index", "--methods", "bobb,surf"), "No method 'surf'. Methods: bobb"),
        (("DUSK", "DAY", "--truth", "index", "--distance-m", "3"), "takes no --distance-m: it is for poses and a TUM"),
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


def test_truth_of_another_drive(verb: Verb, traversals: tuple[Path, Path], drive: Drive) -> None:
    said = verb("compare", traversals[1], traversals[0], "--truth", drive.truth, "--methods", "bobb", *QUICK).error
    assert "covers none of the 16 frames of the query dusk" in said


@pytest.mark.parametrize(
    "wrong",
    [("--distance-m", "0"), ("--distance-m", "nan"), ("--tolerance", "-1"), ("--min-gap", "0"), ("--sequence", "x")],
)
def test_wrong_usage(verb: Verb, wrong: tuple[str, str]) -> None:
    assert verb("compare", "a", "b", "--truth", "index", "--methods", "bobb", *wrong).code == 2
