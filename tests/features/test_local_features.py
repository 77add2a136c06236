"""Local features of a network: where its points are, how its descriptors compare, and BoBB mined over them."""

from __future__ import annotations

import time
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.features.small_networks import LOCAL_YAML, corners
from tests.places.pictures import texture
from vplog.data import Camera, Frame, Reference, Verdict
from vplog.errors import LibraryError, VplogError
from vplog.execution.execution import Execution
from vplog.features import onnx_model
from vplog.features.learned import LocalNetwork, OnnxFeatureSettings, as_bytes
from vplog.features.matching import MatchSettings, match_features
from vplog.features.store import FeatureStore
from vplog.loops import false_rate
from vplog.maps.localization.localize import described
from vplog.pipeline import Pipeline, pipeline_from, run
from vplog.places.bobb import BobbSettings
from vplog.places.hybrid import HybridSettings
from vplog.places.library_files import name_extractor, read_library_record
from vplog.places.vlad import VladSettings
from vplog.results import tables
from vplog.run.reference_library import build_library, check_library

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.verbs.demo.record import Demo


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return corners(tmp_path_factory.mktemp("corners"))


@pytest.fixture(scope="module")
def settings(network: Path) -> OnnxFeatureSettings:
    return OnnxFeatureSettings(model=str(network))


@pytest.fixture(scope="module")
def references(settings: OnnxFeatureSettings) -> list[Reference]:
    images = [texture(seed) for seed in range(12)]
    return [Reference(image, settings(image), "drive", 10**18 + row) for row, image in enumerate(images)]


def test_neighbouring_views_share_points_where_they_moved(references: list[Reference]) -> None:
    a, b = (reference.features for reference in references[:2])
    assert len(a) == 300
    assert a.descriptors.shape == (300, 64)
    rows = match_features(a, b, MatchSettings())
    moved = a.points[rows[0]] - b.points[rows[1]]
    assert len(moved) > 80
    assert (np.abs(moved - [80, 0]).max(axis=1) < 0.01).mean() > 0.95


def test_points_are_in_px_of_the_image_whatever_the_network_gets(network: Path, tmp_path: Path) -> None:
    image = np.full((200, 320), 40, np.uint8)
    image[60:120, 80:200] = 220  # corners at the edges between px
    expected = np.array([[79.5, 59.5], [199.5, 59.5], [79.5, 119.5], [199.5, 119.5]])
    for size in ("null", "[100, 160]", "[100, 320]"):
        path = corners(tmp_path, f"net{size[1:4]}", f"{LOCAL_YAML}size: {size}\n", count=8)
        found = OnnxFeatureSettings(model=str(path))(image)
        assert (found.width, found.height) == (320, 200)
        nearest = np.linalg.norm(found.points[:, None] - expected, axis=2).min(axis=0)
        assert nearest.max() < 4
        assert found.thumbnail is not None
        scale = 1 if size == "null" else 2 if size == "[100, 160]" else np.sqrt(2)
        np.testing.assert_allclose(found.sizes, 16 * scale, rtol=1e-6)
    few = OnnxFeatureSettings(model=str(network), max_features=20)(texture(0))
    all_of_them = OnnxFeatureSettings(model=str(network))(texture(0))
    np.testing.assert_array_equal(few.points, all_of_them.points[:20])
    depth = np.tile(np.arange(320, dtype=np.float32), (200, 1))
    deep = OnnxFeatureSettings(model=str(network))(texture(0), depth)
    np.testing.assert_array_equal(deep.depth_m, np.rint(deep.points[:, 0]))


def test_a_network_is_loaded_once_for_all_threads(
    settings: OnnxFeatureSettings, monkeypatch: pytest.MonkeyPatch
) -> None:
    onnx_model._session.cache_clear()
    content, loaded = onnx_model._content, []

    def slow(path: Path) -> bytes:
        loaded.append(path)
        time.sleep(0.1)
        return content(path)

    monkeypatch.setattr(onnx_model, "_content", slow)
    with ThreadPoolExecutor(4) as pool:
        assert len({len(found) for found in pool.map(settings, [texture(0)] * 4)}) == 1
    assert len(loaded) == 1


def test_bytes_keep_the_distances_of_like_descriptors() -> None:
    rng = np.random.default_rng(0)
    a = rng.standard_normal((50, 64)) * rng.uniform(0.1, 10, (50, 1))
    a /= np.linalg.norm(a, axis=1, keepdims=True)
    near = a + rng.normal(0, 0.02, a.shape)
    near /= np.linalg.norm(near, axis=1, keepdims=True)
    there, others = (as_bytes(one).astype(float) / 512 for one in (a, near))
    np.testing.assert_allclose(np.linalg.norm(there, axis=1), 1, atol=0.01)
    true = np.linalg.norm(a - near, axis=1)
    np.testing.assert_allclose(np.linalg.norm(there - others, axis=1), true, atol=0.02)
    unlike = np.linalg.norm(there[:, None] - there, axis=2)[~np.eye(50, dtype=bool)]
    assert unlike.min() > 3 * true.max()
    assert as_bytes(np.zeros((2, 8))).tolist() == [[0] * 16] * 2


@pytest.mark.parametrize(
    "places", [BobbSettings(references=4, features=150), HybridSettings(words=4), VladSettings(centres=8)]
)
def test_recognisers_of_features_take_them(places: Any, references: list[Reference], tmp_path: Path) -> None:
    state = places.learn(references, Execution())
    state.save(tmp_path)
    again = places.load(tmp_path, Execution())
    assert again.hash == state.hash
    described = [state.describe(reference.features) for reference in references]
    index = state.index([again.describe(reference.features) for reference in references])
    for row, place in enumerate(described):
        ranked = index.query(place, 3).rows.tolist()
        assert ranked[0] == row
        assert abs(ranked[1] - row) <= 2  # the neighbours share most of the view


def test_stores_keep_descriptors_of_any_length(references: list[Reference], tmp_path: Path) -> None:
    with FeatureStore(tmp_path / "features") as store:
        for reference in references[:3]:
            store.append(reference.features)
        for row, reference in enumerate(references[:3]):
            for name in ("points", "descriptors", "sizes", "thumbnail"):
                np.testing.assert_array_equal(getattr(store[row], name), getattr(reference.features, name))


def test_a_drive_with_features_of_a_network(
    drive: Demo, network: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Boxes are mined over them, and geometry verifies closures by them, without mirrored ones."""
    monkeypatch.setattr(false_rate, "mirrored", lambda _: pytest.fail("a network's descriptors are mirrored"))
    tree = {"features": {"kind": "onnx", "model": str(network)}, "places": {"references": 4}, "library": {"size": 8}}
    pipeline = pipeline_from(tree, "mine.yaml")
    assert Pipeline.read(pipeline.model_dump(mode="json"), "run.json") == pipeline
    done = run(drive.log, tmp_path / "out", pipeline)
    assert done.features[0].descriptors.shape[1] == 64
    closures = tables.read_closures(tmp_path / "out" / "closures.parquet")
    assert closures.of(Verdict.ACCEPTED).sum() > 0
    assert any(len(references) for references in closures.shared_references)
    library = tmp_path / "library"
    build_library([drive.log], library, Pipeline.model_validate({"library": {"size": 4}, "places": {"references": 4}}))
    with pytest.raises(LibraryError, match=r"made with features.kind=sift, and this run has onnx.*vplog library"):
        run(drive.log, tmp_path / "other", pipeline, library)
    assert read_library_record(tmp_path / "out" / "library")["extractor"] == pipeline.features.identity()


def test_a_library_of_other_features_is_refused(references: list[Reference], network: Path, tmp_path: Path) -> None:
    """By their name, as those of SIFT and of a network of 64 values are as long; by length where it has no name."""
    wide = Pipeline(features=OnnxFeatureSettings(model=str(corners(tmp_path, "wide", values=64))))
    own, sift = Pipeline(features=OnnxFeatureSettings(model=str(network))), Pipeline()
    library, state = tmp_path / "library", sift.places.learn(references, Execution())
    state.save(library)
    check_library(library, own)
    for other in (wide, sift):
        with pytest.raises(LibraryError, match="64 bytes and this drive's 128"):
            check_library(library, other)
    name_extractor(library, own.features.identity())
    assert sift.places.load(library, Execution()).hash == state.hash
    check_library(library, own.model_copy(update={"features": own.features.model_copy(update={"max_features": 9})}))
    for name, other in (("sha256", wide), ("kind", sift)):
        with pytest.raises(LibraryError, match=rf"made with features\.{name}="):
            check_library(library, other)
    frame = Frame(0, Camera("a", np.eye(3), "", np.zeros(0), 320, 200, np.eye(4)), texture(0))
    with pytest.raises(LibraryError, match="64 bytes and this drive's 128"):
        described(state, sift.features, frame, "a map")


@pytest.mark.parametrize("batch", [True, False])
@pytest.mark.parametrize("count", [0, 1, 2, 5, 8])
def test_outputs_come_with_or_without_a_batch_and_either_way_round(
    count: int, batch: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Also of one point, and of as many as a descriptor has values."""
    rng, values = np.random.default_rng(count), 5
    points = rng.uniform(10, 90, (count, 2)).astype(np.float32)
    descriptors, scores = rng.standard_normal((count, values)).astype(np.float32), np.arange(count, 0, -1.0)
    descriptors /= np.maximum(np.linalg.norm(descriptors, axis=1, keepdims=True), 1e-9)
    settings = OnnxFeatureSettings(network=LocalNetwork(scores="scores"))
    for table in (descriptors, descriptors.T):
        given = [points, table, scores]
        monkeypatch.setattr(
            OnnxFeatureSettings, "run", lambda *_, given=given: [one[None] if batch else one for one in given]
        )
        found = settings(np.zeros((100, 100), np.uint8))
        np.testing.assert_allclose(found.points, points, atol=1e-4)
        np.testing.assert_array_equal(found.descriptors, as_bytes(descriptors))


@pytest.mark.parametrize(
    ("yaml", "message"),
    [
        ("points: descriptors\n", "output descriptors has 32 x 300 values of float32.* for points"),
        ("descriptors: scores\n", "output scores has 300 values .* for descriptors"),
        ("scores: keypoints\n", "output keypoints has 1 x 300 x 2 .* for scores"),
        ("points: nowhere\n", "output nowhere is not there. There are: keypoints, scores, descriptors"),
        ("diameter_px: 0\n", "diameter_px must be a number"),
        ("colour: rgb\nmean: [0, 0, 0]\nstd: [1, 1, 1]\n", "cannot be run on an image"),
    ],
)
def test_outputs_that_do_not_fit_are_one_line(yaml: str, message: str, tmp_path: Path) -> None:
    names = {line.split(":")[0] for line in yaml.splitlines()}
    kept = "".join(f"{line}\n" for line in LOCAL_YAML.splitlines() if line.split(":")[0] not in names)
    path = corners(tmp_path, yaml=kept + yaml)
    with pytest.raises(VplogError, match=message) as caught:
        pipeline_from({"features": {"kind": "onnx", "model": str(path)}}, "my.yaml").features(texture(0))
    assert "\n" not in str(caught.value)
