"""Anyone's network as a recogniser: the same answers from its ONNX file and from vectors computed elsewhere."""

from __future__ import annotations

import shutil
from dataclasses import replace
from typing import TYPE_CHECKING, Any

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.features.small_networks import SIZE, YAML, block_means, block_means_of
from tests.places.pictures import reference
from vplog import logs
from vplog.benchmark.compare import CompareOptions, compare
from vplog.benchmark.recogniser_specs import read_method
from vplog.errors import LibraryError, SettingsError, VplogError
from vplog.evaluate.place_truth import TruthChoice
from vplog.execution.execution import Execution
from vplog.features import onnx_model
from vplog.features.sift import SiftSettings
from vplog.maps.joining.joint_run import run_joint
from vplog.pipeline import Pipeline, pipeline_from
from vplog.places.network_vector import OnnxSettings
from vplog.places.vectors import VectorsSettings
from vplog.places.views import views_of
from vplog.results import tables
from vplog.testing.recogniser_contract import COUNT, RecogniserContract

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.conftest import Said
    from vplog.stages import PlaceState
    from vplog.verbs.demo.record import Demo

FRAMES = 12


@pytest.fixture(scope="class")
def onnx_settings(request: Any, tmp_path_factory: pytest.TempPathFactory) -> None:
    request.cls.settings = OnnxSettings(model=str(block_means(tmp_path_factory.mktemp("contract"))))


@pytest.mark.usefixtures("onnx_settings")
class TestOnnx(RecogniserContract):
    pass


@pytest.fixture(scope="class")
def vectors_settings(request: Any, tmp_path_factory: pytest.TempPathFactory) -> None:
    file = tmp_path_factory.mktemp("contract") / "vectors.npy"
    np.save(file, np.random.default_rng(0).standard_normal((COUNT, 16), np.float32))
    request.cls.settings = VectorsSettings(file=str(file))


@pytest.mark.usefixtures("vectors_settings")
class TestVectors(RecogniserContract):
    pass


SMALL = Pipeline(features=SiftSettings(max_features=50, max_megapixels=0.01))


@pytest.fixture(scope="module")
def folders(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Two folders of the same 12 places in colour, the second darker; named 0.png .. 11.png."""
    root, rng = tmp_path_factory.mktemp("pictures"), np.random.default_rng(3)
    found = root / "night", root / "day"
    for folder in found:
        folder.mkdir()
    for number in range(FRAMES):
        coarse = rng.integers(0, 256, (4, 4, 3), np.uint8)
        picture = np.repeat(np.repeat(coarse, SIZE // 4, 0), SIZE // 4, 1)
        night = np.clip(picture * 0.8 + rng.normal(0, 8, picture.shape), 0, 255).astype(np.uint8)
        for folder, image in zip(found, (night, picture), strict=True):
            cv2.imwrite(str(folder / f"{number}.png"), image[..., ::-1])
    return found


def vectors(folder: Path) -> np.ndarray:
    """Computed here, in the order of the names as text: 0, 1, 10, 11, 2, ..."""
    paths = sorted(map(str, folder.glob("*.png")))
    return np.array([block_means_of(np.asarray(cv2.imread(path), np.uint8)[..., ::-1]) for path in paths])


@pytest.fixture(scope="module")
def pair(folders: tuple[Path, Path], tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("pair")
    np.save(folder / "queries_descriptors.npy", vectors(folders[0]))
    np.save(folder / "database_descriptors.npy", vectors(folders[1]))
    return folder


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return block_means(tmp_path_factory.mktemp("network"))


def described(state: PlaceState, folder: Path, query: bool = False) -> np.ndarray:
    log = logs.open(folder)
    return np.array(list(views_of(state, log, log.stamps(), lambda _: None, query).described(Execution(2))), np.float32)


def parquet(folder: Path, folders: tuple[Path, ...], drives: bool = True) -> Path:
    columns: dict[str, list[Any]] = {"stamp_ns": [], "vector": [], "drive": []}
    for drive in folders:
        log = logs.open(drive)
        names = sorted(path.name for path in drive.glob("*.png"))
        rows = dict(zip(names, vectors(drive), strict=True))
        for number, stamp in enumerate(log.stamps().tolist()):
            for name, value in zip(columns, (stamp, rows[f"{number}.png"].tolist(), drive.name), strict=True):
                columns[name].append(value)
    if not drives:
        columns.pop("drive")
    pq.write_table(pa.table(columns), folder / "vectors.parquet")
    return folder / "vectors.parquet"


def test_a_network_and_its_vectors_give_equal_answers(
    folders: tuple[Path, Path], network: Path, pair: Path, tmp_path: Path
) -> None:
    table = parquet(tmp_path, folders)
    methods = [f"onnx:{network}", f"vectors:{pair}", f"vectors:{table}", "gist"]
    done = compare(*folders, methods, TruthChoice("index"), SMALL, CompareOptions(library_size=4, out=tmp_path / "out"))
    scores = [np.load(file)["scores"] for file in sorted((tmp_path / "out").glob("*.npz"))]
    for other in scores[1:3]:
        np.testing.assert_array_equal(other.argmax(1), scores[0].argmax(1))
        np.testing.assert_allclose(other, scores[0], atol=2e-3)  # of a half float
    found = [done.record["methods"][name] for name in methods]
    assert found[0]["r_at_1"] == found[1]["r_at_1"] == found[2]["r_at_1"] == 1.0
    assert found[0]["bytes_per_image"] == found[1]["bytes_per_image"] == 2 * 48
    assert found[0]["feature_ms"] == found[1]["feature_ms"] == 0 < found[3]["feature_ms"]
    assert found[0]["settings"]["network"]["size"] == [SIZE, SIZE]


def test_vectors_are_those_of_the_network(folders: tuple[Path, Path], network: Path) -> None:
    state = OnnxSettings(model=str(network)).learn([reference(0)], Execution())
    raw = vectors(folders[1])[[0, 1, 4, 5, 6, 7, 8, 9, 10, 11, 2, 3]]  # 0, 1, 2, .., 11
    expected = raw / np.linalg.norm(raw, axis=1, keepdims=True)
    np.testing.assert_allclose(described(state, folders[1]), expected, atol=1e-3)


@pytest.mark.parametrize(
    ("yaml", "expected"),
    [
        ("multiple: 14\nsize: [30, 40]\n", (1, 3, 28, 28)),
        ("size: null\n", (1, 3, 20, 30)),
        ("size: [8, 8]\nlayout: nhwc\n", (1, 8, 8, 3)),
        ("size: [8, 8]\ncolour: grey\nmean: [0.5]\nstd: [2]\n", (1, 1, 8, 8)),
    ],
)
def test_pixels_as_the_yaml_has_them(yaml: str, expected: tuple[int, ...], tmp_path: Path) -> None:
    network = OnnxSettings(model=str(block_means(tmp_path, yaml=yaml))).network
    image = np.random.default_rng(0).integers(0, 256, (20, 30, 1 if "grey" in yaml else 3), np.uint8)
    assert network.tensor(image).shape == expected
    grown = network.model_copy(update={"size": None, "multiple": 1, "layout": "nhwc"}).tensor(image)[0]
    np.testing.assert_allclose(grown, (image / 255 - network.mean) / network.std, atol=1e-6)


def test_a_setting_beside_the_yaml_leaves_the_others(tmp_path: Path) -> None:
    path = block_means(tmp_path, yaml=f"{YAML}colour: bgr\ninterpolation: cubic\n")
    found = read_method(f"onnx:{path}:network.interpolation=linear", Pipeline())
    whole = read_method(f"onnx:{path}", Pipeline()).network
    assert found.network == whole.model_copy(update={"interpolation": "linear"})
    path.with_suffix(".yaml").write_text("colour: rgb\n")  # what a run has recorded stays as it was
    assert OnnxSettings.read(found.model_dump(mode="json"), "run.json") == found


def test_channels_come_in_their_order(tmp_path: Path) -> None:
    swapped = OnnxSettings(model=str(block_means(tmp_path, yaml=f"{YAML}colour: bgr\n")))
    plain = OnnxSettings(model=str(block_means(tmp_path)))
    image = np.random.default_rng(1).integers(0, 256, (SIZE, SIZE, 3), np.uint8)
    np.testing.assert_array_equal(swapped.vector(image[..., ::-1])[:16], plain.vector(image[..., ::-1])[:16])
    from vplog.data import Frame

    frame = Frame(0, None, image[..., 0], colour=image)  # type: ignore[arg-type]
    np.testing.assert_array_equal(swapped.network.image_of(frame), image[..., ::-1])
    np.testing.assert_array_equal(plain.network.image_of(frame), image)
    with pytest.raises(LibraryError, match="without it"):
        plain.network.image_of(replace(frame, colour=None))


def test_the_content_of_the_network_decides_the_hash_and_not_its_place(tmp_path: Path) -> None:
    one, two = (block_means(tmp_path, name) for name in "ab")
    other = block_means(tmp_path, "c", yaml=YAML.replace("std: [1", "std: [2"))
    larger = block_means(tmp_path, "d")
    larger.write_bytes(larger.read_bytes() + b"\x3a\x00")  # an empty graph more: another file, the same network
    states = [OnnxSettings(model=str(path)).learn([reference(0)], Execution()) for path in (one, two, other, larger)]
    assert states[0].hash == states[1].hash
    assert len({state.hash for state in states}) == 3
    states[0].save(tmp_path / "library")
    one.unlink()
    onnx_model._session.cache_clear()
    with pytest.raises(VplogError, match=r"a\.onnx is no network"):
        OnnxSettings().load(tmp_path / "library", Execution())
    moved = OnnxSettings(model=str(two)).load(tmp_path / "library", Execution())
    assert moved.hash == states[0].hash
    two.write_bytes(larger.read_bytes())
    onnx_model._session.cache_clear()
    with pytest.raises(LibraryError, match="another network"):
        moved.settings.model_copy(update={"sha256": states[0].settings.sha256}).run(
            np.zeros((SIZE, SIZE, 3), np.uint8), [""]
        )


@pytest.mark.parametrize(
    ("yaml", "message"),
    [
        (None, r"Cannot read .*\.yaml: No such file"),
        ("sise: [1, 2]\n", r"\.yaml: sise is no setting. Did you mean size\?"),
        ("mean: [0]\n", r"\.yaml: mean and std must be of 3 value\(s\) for colour rgb"),
        ("std: [1, 0, 1]\n", "a std is 0"),
        ("size: [5000, 5000]\n", "at most 16777216 px"),
        ("size: [", "is not YAML"),
        ("output: depth\n", "output depth is not there. There are: vector"),
        ("size: [8, 8]\nlayout: nhwc\n", "cannot be run on an image"),
    ],
)
def test_a_yaml_that_does_not_fit_is_one_line(yaml: str | None, message: str, tmp_path: Path) -> None:
    path = block_means(tmp_path, yaml=yaml)
    with pytest.raises(VplogError, match=message) as caught:
        read_method(f"onnx:{path}", Pipeline()).learn([reference(0)], Execution())
    assert "\n" not in str(caught.value)


def test_a_file_that_is_no_network_is_one_line(tmp_path: Path) -> None:
    pytest.importorskip("onnxruntime")
    path = tmp_path / "net.onnx"
    with pytest.raises(SettingsError, match="No such file"):
        read_method(f"onnx:{path}", Pipeline())
    path.write_bytes(b"nothing")
    path.with_suffix(".yaml").write_text(YAML)
    with pytest.raises(LibraryError, match="cannot be loaded by ONNX Runtime") as caught:
        read_method(f"onnx:{path}", Pipeline()).learn([reference(0)], Execution())
    assert "\n" not in str(caught.value)
    with pytest.raises(SettingsError, match="No network is named"):
        read_method("onnx", Pipeline()).learn([reference(0)], Execution())


def test_without_onnx_runtime_the_extra_is_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(__import__("sys").modules, "onnxruntime", None)
    path = tmp_path / "other.onnx"
    path.write_bytes(b"nothing")
    path.with_suffix(".yaml").write_text(YAML)
    with pytest.raises(SettingsError, match="pip install onnxruntime"):
        read_method(f"onnx:{path}", Pipeline()).learn([reference(0)], Execution())


# Vectors


def test_rows_are_in_the_order_of_names_or_of_frames(folders: tuple[Path, Path], pair: Path, tmp_path: Path) -> None:
    own = pair / "database_descriptors.npy"
    by_name = VectorsSettings(file=str(own)).learn([reference(0)], Execution())
    np.save(tmp_path / "frames.npy", vectors(folders[1])[[0, 1, 4, 5, 6, 7, 8, 9, 10, 11, 2, 3]])
    settings = VectorsSettings(file=str(tmp_path / "frames.npy"), order="frames")
    by_frame = settings.learn([reference(0)], Execution())
    np.testing.assert_array_equal(described(by_name, folders[1]), described(by_frame, folders[1]))
    assert by_name.hash != by_frame.hash


def test_vectors_of_a_named_model_compare_between_files(folders: tuple[Path, Path], tmp_path: Path) -> None:
    for folder in folders:
        np.save(tmp_path / f"{folder.name}.npy", vectors(folder))
    files = [str(tmp_path / f"{folder.name}.npy") for folder in folders]
    own = [VectorsSettings(file=file).learn([reference(0)], Execution()) for file in files]
    named = [VectorsSettings(file=file, model="means").learn([reference(0)], Execution()) for file in files]
    assert own[0].hash != own[1].hash
    assert named[0].hash == named[1].hash
    assert named[0].token != named[1].token
    named[0].save(tmp_path / "library")
    loaded = VectorsSettings(file=files[1]).load(tmp_path / "library", Execution())
    np.testing.assert_array_equal(described(loaded, folders[1]), described(named[1], folders[1]))


def test_vectors_of_one_drive_are_not_taken_for_anothers(
    folders: tuple[Path, Path], pair: Path, tmp_path: Path
) -> None:
    """Both folders have as many frames and the same made-up stamps."""
    one = VectorsSettings(file=str(tmp_path / "one.npy"), order="frames")
    np.save(one.file, vectors(folders[0]))
    unnamed = VectorsSettings(file=str(parquet(tmp_path, folders[:1], drives=False)))
    log = logs.open(folders[1])
    for settings in (one, unnamed):
        state = settings.learn([reference(0)], Execution())
        assert len(state.stored(log, log.stamps(), query=False)) == FRAMES
        for query in (True, None):
            with pytest.raises(LibraryError, match="does not say which of several drives"):
                state.stored(log, log.stamps(), query)
    of_pair = VectorsSettings(file=str(pair)).learn([reference(0)], Execution())
    assert len(of_pair.stored(log, log.stamps(), query=True)) == FRAMES
    with pytest.raises(LibraryError, match="does not say which"):
        of_pair.stored(log, log.stamps(), None)


def test_a_file_of_one_drive_is_taken_for_no_other(
    folders: tuple[Path, Path], pair: Path, verb: Callable[..., Said], tmp_path: Path
) -> None:
    """Of a pair of files the map has that of the database, and one drive alone; of a model each drive has its own."""
    night, day = folders
    quick = ("features.max_features=50", "features.max_megapixels=0.01", "library.size=4", "places.kind=vectors")
    root, model = tmp_path / "map", tmp_path / "model"

    def batch(root: Path, *logs: Path, file: Path, model: str = "") -> Said:
        places = [f"places.file={file}", *([f"places.model={model}"] if model else [])]
        options = [word for one in (*quick, *places) for word in ("--set", one)]
        return verb("batch", *logs, "-o", root, "--jobs", "1", *options, "--json")

    assert "which of 2 drives" in batch(root, night, day, file=pair).error
    assert not root.exists()
    assert batch(root, day, file=pair).code == 0
    settings_before = (root / "map.json").read_bytes()
    assert "which of 2 drives" in batch(root, night, file=pair / "queries_descriptors.npy").error
    assert (root / "map.json").read_bytes() == settings_before
    places = tables.read_descriptors(root / "runs" / "drive=day" / "descriptors.parquet")[0]
    settings = VectorsSettings(file=str(pair))
    own = settings.learn([reference(0)], Execution())
    assert places.equals(own.to_arrow(list(described(own, day).astype(np.float16))))
    assert "which of 2 drives" in batch(root, night, file=pair).error
    assert batch(root, day, file=pair).code == 0, "it is there already"
    for folder in folders:
        np.save(tmp_path / f"{folder.name}.npy", vectors(folder))
        assert batch(model, folder, file=tmp_path / f"{folder.name}.npy", model="means").code == 0
    shutil.copytree(day, tmp_path / "other")
    assert "which of 2 drives" in batch(model, tmp_path / "other", file=tmp_path / "day.npy", model="means").error
    for one in (VectorsSettings(file=str(pair)), VectorsSettings(file=str(tmp_path / "day.npy"))):
        with pytest.raises(LibraryError, match="which of 2 drives"):
            run_joint([night, day], tmp_path / "joint", Pipeline(places=one))


def test_distances_rank_as_the_metric_says(tmp_path: Path, folders: tuple[Path, Path]) -> None:
    made = np.zeros((FRAMES, 2), np.float32)
    made[:, 0], made[:, 1] = np.arange(FRAMES), 1
    np.save(tmp_path / "line.npy", made)
    for metric, nearest in (("l2", [5, 4, 6]), ("cosine", [5, 6, 4])):
        settings = VectorsSettings(file=str(tmp_path / "line.npy"), metric=metric, order="frames")  # type: ignore[arg-type]
        state = settings.learn([reference(0)], Execution())
        log = logs.open(folders[0])
        places = state.from_arrow(state.to_arrow(state.stored(log, log.stamps(), query=False)))
        assert state.index(places).query(places[5], 3).rows.tolist() == nearest


@pytest.mark.parametrize(
    ("made", "message"),
    [
        (np.zeros((5, 3), np.float32), "has 5 vectors, and day has 12 frames"),
        (np.zeros(12, np.float32), "an array of 12 float32"),
        (np.zeros((12, 0), np.float32), "12 x 0"),
        (np.zeros((12, 2), np.int64), "int64"),
        (np.array([{"a": 1}] * 12, object), "not a .npy file of numbers"),
        (np.full((12, 2), np.nan, np.float32), "not finite"),
    ],
)
def test_files_that_do_not_fit_are_one_line(
    made: np.ndarray, message: str, folders: tuple[Path, Path], tmp_path: Path
) -> None:
    np.save(tmp_path / "made.npy", made, allow_pickle=True)
    with pytest.raises(LibraryError, match=message) as caught:
        described(VectorsSettings(file=str(tmp_path / "made.npy")).learn([reference(0)], Execution()), folders[1])
    assert "\n" not in str(caught.value)


def test_tables_that_do_not_fit_are_one_line(folders: tuple[Path, Path], tmp_path: Path) -> None:
    state = VectorsSettings(file=str(parquet(tmp_path, folders[:1]))).learn([reference(0)], Execution())
    with pytest.raises(LibraryError, match="lacks 12 of 12 frames of day"):
        described(state, folders[1])
    state = VectorsSettings(file=str(parquet(tmp_path, folders, drives=False))).learn([reference(0)], Execution())
    with pytest.raises(LibraryError, match="two vectors of one stamp"):
        described(state, folders[1])
    pq.write_table(pa.table({"stamp_ns": [1, 2], "vector": [[1.0], [1.0, 2.0]]}), tmp_path / "vectors.parquet")
    with pytest.raises(LibraryError, match="different or no lengths"):
        VectorsSettings(file=str(tmp_path / "vectors.parquet")).learn([reference(0)], Execution())
    pq.write_table(pa.table({"stamp": [1, 2]}), tmp_path / "vectors.parquet")
    with pytest.raises(LibraryError, match="Its columns are stamp_ns"):
        VectorsSettings(file=str(tmp_path / "vectors.parquet")).learn([reference(0)], Execution())
    for name, message in (("", "No file"), ("none.npy", "does not exist"), ("text.txt", "neither")):
        (tmp_path / "text.txt").touch()
        with pytest.raises(LibraryError, match=message):
            VectorsSettings(file=name and str(tmp_path / name)).learn([reference(0)], Execution())
    np.save(tmp_path / "queries_descriptors.npy", np.zeros((1, 2), np.float32))
    with pytest.raises(LibraryError, match=r"database_descriptors\.npy is missing"):
        VectorsSettings(file=str(tmp_path)).learn([reference(0)], Execution())


def test_methods_and_pipelines_name_a_file(network: Path, pair: Path) -> None:
    found = read_method(f"vectors:{pair}:metric=l2", Pipeline())
    assert (found.file, found.metric) == (str(pair), "l2")
    found = read_method("vectors:some:where.npy:model=x", Pipeline())
    assert found.file.endswith("/some:where.npy")
    tree = {"places": {"kind": "onnx", "model": str(network)}}
    places: Any = pipeline_from(tree, "mine.yaml").places
    assert places.network.size == (SIZE, SIZE)
    assert read_method("onnx", pipeline_from(tree, "mine.yaml")) == places
    assert Pipeline.read(pipeline_from(tree, "mine.yaml").model_dump(mode="json"), "run.json").places == places


# Runs and maps


def test_runs_and_maps_by_a_network_and_by_its_vectors(drive: Demo, verb: Callable[..., Said], tmp_path: Path) -> None:
    """The same places, and the same answers of a map, from either."""
    net, log = block_means(tmp_path), logs.open(drive.log)
    state = OnnxSettings(model=str(net)).learn([reference(0)], Execution())
    found = [vector.tolist() for vector in views_of(state, log, log.stamps(), lambda _: None).described(Execution(2))]
    columns: dict[str, Any] = {"stamp_ns": log.stamps(), "vector": found, "drive": [log.name] * len(found)}
    pq.write_table(pa.table(columns), tmp_path / "drive.parquet")
    quick = ("features.max_features=200", "features.max_megapixels=0.05", "keyframes.distance_m=3", "library.size=4")
    answers, places_of = [], []
    for name, places in (
        ("net", ("places.kind=onnx", f"places.model={net}")),
        ("vectors", ("places.kind=vectors", f"places.file={tmp_path / 'drive.parquet'}")),
    ):
        options = [word for one in (*quick, *places, "sequence.length=1") for word in ("--set", one)]
        root = tmp_path / name
        said = verb("batch", drive.log, "-o", root, "--jobs", "1", *options, "--json")
        assert said.code == 0, said.err
        places_of.append(tables.read_descriptors(root / "runs" / "drive=drive" / "descriptors.parquet")[0])
        rows = verb("map", "query", root, drive.log, "--top", "2", "--sequence", "1", "--json").json["answers"]
        answers.append([(one["query"], one["keyframe"]) for one in rows])
    assert places_of[0].equals(places_of[1])
    assert answers[0] == answers[1]
    assert answers[0][::2] == [(row, row) for row in range(len(places_of[0]))]
