"""Words of features, and libraries on disk."""

from __future__ import annotations

import json
from concurrent.futures import ThreadPoolExecutor
from contextlib import suppress
from dataclasses import replace
from typing import TYPE_CHECKING

import cv2
import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

from tests.places.pictures import SMALL, noisy, nothing, reference, texture
from vplog.errors import LibraryError, NewerError, SettingsError
from vplog.execution.execution import Execution
from vplog.places import library as lib
from vplog.places import library_files
from vplog.places.bobb import BobbSettings
from vplog.places.bobb_paper import PaperBobbSettings

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.data import Reference
    from vplog.places.bobb_paper import PaperBobbState

pytestmark = pytest.mark.usefixtures("computed_anew")


def _lists(words: lib.Words) -> list[list[int]]:
    return [words.values[a:b].tolist() for a, b in zip(words.start[:-1], words.start[1:], strict=True)]


def _l1(descriptors: np.ndarray, library: np.ndarray) -> np.ndarray:
    """(M, F) distances to every library feature, in float64."""
    a = descriptors / descriptors.sum(1, keepdims=True, dtype=np.float64)
    b = library / library.sum(1, keepdims=True, dtype=np.float64)
    return np.array([np.abs(b - row).sum(1) for row in a])


def test_words_are_near_and_most_of_those_that_exist(state: PaperBobbState, references: list[Reference]) -> None:
    library = state.library
    descriptors = np.concatenate([noisy(r.features, 1, 8.0).descriptors[:25] for r in references[:4]])
    words = _lists(library.translate(descriptors))
    distance = _l1(descriptors, library.descriptors)
    most = SMALL.max_l1 * 2 / SMALL.l1_range  # of descriptors of unit L1 length
    squared = ((descriptors[:, None, :].astype(np.int64) - library.descriptors[None]) ** 2).sum(-1)
    found = true = 0
    for row, each in enumerate(words):
        assert each == sorted(set(each))
        assert len(each) <= SMALL.neighbours
        assert (distance[row, each] < most + 1e-6).all()
        nearest = np.argsort(squared[row], kind="stable")[: SMALL.neighbours]
        expected = set(nearest[distance[row, nearest] < most].tolist())
        found, true = found + len(expected & set(each)), true + len(expected)
    assert true > 100
    assert found / true > 0.9


def test_features_of_another_kind_have_no_words(state: PaperBobbState) -> None:
    spikes = 255 * np.eye(3, 128, dtype=np.uint8)
    assert state.library.translate(spikes).start.tolist() == [0, 0, 0, 0]
    zeros = np.zeros((2, 128), np.uint8)
    assert state.library.translate(zeros).values.size == 0
    assert state.library.translate(nothing().descriptors).start.tolist() == [0]


def test_own_words_hold_the_feature_itself(state: PaperBobbState) -> None:
    for feature, each in enumerate(_lists(state.library.words)):
        assert feature in each
        assert each == sorted(set(each))
        assert each[-1] < state.library.start[-1]


def test_repeated_features_are_words_of_each_other() -> None:
    once = reference(3)
    library = lib.build_library([once, once], lib.WordSettings(features=50), Execution())
    words = _lists(library.words)
    shared = sum(feature + 50 in words[feature] for feature in range(50))
    assert shared > 45
    assert all(feature in words[feature] for feature in range(100))


def test_words_do_not_depend_on_batches_or_threads(state: PaperBobbState, references: list[Reference]) -> None:
    library = state.library
    images = [noisy(r.features, 2).descriptors for r in references]
    whole = _lists(library.translate(np.concatenate(images)))
    one_by_one = [each for image in images[:2] for row in image for each in _lists(library.translate(row[None]))]
    assert whole[: len(one_by_one)] == one_by_one
    with ThreadPoolExecutor(4) as pool:
        batches = list(pool.map(library.translate, images * 3))
    assert [each for batch in batches for each in _lists(batch)] == whole * 3


def test_only_the_strongest_features_are_kept(references: list[Reference]) -> None:
    library = lib.build_library(references[:3], lib.WordSettings(features=20), Execution())
    assert library.start.tolist() == [0, 20, 40, 60]
    np.testing.assert_array_equal(library.descriptors[20:40], references[1].features.descriptors[:20])
    assert library.size(2) == (320, 200)


def test_a_library_needs_features() -> None:
    with pytest.raises(LibraryError, match="at least one reference"):
        lib.build_library([], SMALL, Execution())
    empty = replace(reference(0), features=nothing())
    with pytest.raises(LibraryError, match="None of the 2 reference images"):
        lib.build_library([empty, empty], SMALL, Execution())


@pytest.fixture
def saved(tmp_path: Path, references: list[Reference]) -> Path:
    SMALL.learn([*references[:4], replace(reference(5), features=nothing())], Execution()).save(tmp_path / "library")
    return tmp_path / "library"


def _refused(folder: Path) -> str:
    with pytest.raises((LibraryError, SettingsError)) as error:
        PaperBobbSettings().load(folder, Execution())
    message = str(error.value)
    assert "\n" not in message
    return message


def test_a_reference_without_features_survives_the_disk(saved: Path) -> None:
    loaded = PaperBobbSettings().load(saved, Execution())
    assert len(loaded.library) == 5
    assert loaded.library.start[-1] == loaded.library.start[-2]
    np.testing.assert_array_equal(loaded.library.references[4].image, texture(5))
    assert loaded.library.references[1].drive == "drive 1"
    assert loaded.library.references[1].stamp_ns == 10**18 + 1


def test_folders_that_are_no_library(tmp_path: Path) -> None:
    assert f"{tmp_path} is not a library: it has no library.json" in _refused(tmp_path)
    assert "no library.json" in _refused(tmp_path / "missing")
    (tmp_path / "file").write_text("hello")
    _refused(tmp_path / "file")


@pytest.mark.parametrize("text", ["", "[]", '{"hash": 1}', '{"hash": "x", "settings": []}', "[" * 100_000, "\0"])
def test_damaged_records(saved: Path, text: str) -> None:
    (saved / "library.json").write_text(text)
    _refused(saved)


@pytest.mark.parametrize("change", [{"seed": 9}, {"references": 50}, {"grid": 300}, {"partitions": 0}, {"new": 1}])
def test_changed_settings_are_noticed(saved: Path, change: dict[str, int]) -> None:
    record = json.loads((saved / "library.json").read_text())
    del record["record_sha256"]  # as of an older vplog
    (saved / "library.json").write_text(json.dumps(record))
    PaperBobbSettings().load(saved, Execution())
    (saved / "library.json").write_text(json.dumps({**record, "settings": {**record["settings"], **change}}))
    _refused(saved)


def test_a_flipped_bit_of_the_record_is_noticed(saved: Path) -> None:
    whole, known = (saved / "library.json").read_bytes(), library_files.read_library_record(saved)
    for bit in range(0, 8 * len(whole.rstrip()), 7):
        data = bytearray(whole)
        data[bit // 8] ^= 1 << bit % 8
        (saved / "library.json").write_bytes(data)
        with suppress(LibraryError, NewerError):
            assert known.items() <= library_files.read_library_record(saved).items(), bit


def _replace(path: Path, column: str, values: pa.Array) -> None:
    table = pq.read_table(path)
    at = table.column_names.index(column)
    pq.write_table(table.set_column(at, table.schema.field(at), values), path)


def test_changed_features_are_noticed(saved: Path) -> None:
    path = saved / "features.parquet"
    rows = pq.read_table(path)["descriptor"].to_pylist()
    rows[7] = rows[8]
    _replace(path, "descriptor", pa.array(rows, pa.binary(128)))
    assert "hash" in _refused(saved)


@pytest.mark.parametrize(
    ("table", "column", "value"),
    [
        ("features", "x", 321.0),
        ("features", "y", -5.0),
        ("features", "x", float("nan")),
        ("features", "x", None),
        ("features", "descriptor", None),
        ("features", "reference", 5),
        ("features", "reference", -1),
        ("features", "reference", None),
        ("references", "width", 0),
        ("references", "width", 40_000),
        ("references", "height", 199),
        ("references", "drive", None),
        ("references", "image", None),
        ("references", "image", b""),
        ("references", "image", b"no picture"),
    ],
)
def test_cells_that_make_no_sense(saved: Path, table: str, column: str, value: object) -> None:
    path = saved / f"{table}.parquet"
    old = pq.read_table(path)[column]
    _replace(path, column, pa.array([*old.to_pylist()[:-1], value], old.type))
    _refused(saved)


def test_tables_of_another_kind(saved: Path) -> None:
    pq.write_table(pa.table({"a": [1]}), saved / "features.parquet")
    assert "not those of a library" in _refused(saved)


@pytest.mark.parametrize("name", ["features.parquet", "references.parquet"])
def test_missing_and_cut_tables(saved: Path, name: str) -> None:
    data = (saved / name).read_bytes()
    for part in (data[: len(data) // 2], b"", data[:-1]):
        (saved / name).write_bytes(part)
        _refused(saved)
    (saved / name).unlink()
    _refused(saved)


def test_flipped_bytes_are_refused_or_harmless(saved: Path) -> None:
    """References or one line, whatever byte is hit; what gets through is noticed by the hash."""
    rng = np.random.default_rng(0)
    refused = 0
    for name in ("features.parquet", "references.parquet"):
        data = (saved / name).read_bytes()
        for at in [*rng.integers(0, len(data), 15), *rng.integers(len(data) - 1500, len(data), 25)]:
            (saved / name).write_bytes(data[:at] + bytes([data[at] ^ (1 << int(rng.integers(8)))]) + data[at + 1 :])
            try:
                library_files.load_references(saved)
            except LibraryError as error:
                assert "\n" not in str(error)
                refused += 1
        (saved / name).write_bytes(data)
    assert refused > 25


def test_a_library_that_cannot_be_written(state: PaperBobbState, tmp_path: Path) -> None:
    (tmp_path / "file").write_text("in the way")
    with pytest.raises(LibraryError, match="Cannot write the library"):
        state.save(tmp_path / "file")


def test_a_library_of_thumbnails_describes_as_the_whole_one(references: list[Reference], tmp_path: Path) -> None:
    state = BobbSettings().learn(references, Execution())
    state.save_small(tmp_path)
    small = BobbSettings().load(tmp_path, Execution())
    assert small.hash == state.hash
    seen = noisy(references[3].features, 1, 8.0)
    assert small.to_arrow([small.describe(seen)]) == state.to_arrow([state.describe(seen)])
    image, whole = small.references[3].image, references[3].image
    assert image.size < whole.size
    assert image.shape[1] / image.shape[0] == pytest.approx(whole.shape[1] / whole.shape[0], rel=0.02)
    small.save_small(tmp_path)
    again = BobbSettings().load(tmp_path, Execution())
    assert again.to_arrow([again.describe(seen)]) == state.to_arrow([state.describe(seen)])


def test_thumbnails_claim_their_own_px_alone(references: list[Reference], tmp_path: Path) -> None:
    """Those of a hundred images of 12 Mpx used to be refused."""
    BobbSettings().learn(references, Execution()).save_small(tmp_path)
    table = pq.read_table(tmp_path / "references.parquet")
    rows = [{**one, "width": 32_000, "height": 24_000} for one in table.to_pylist()]
    pq.write_table(pa.Table.from_pylist(rows, table.schema), tmp_path / "references.parquet")
    assert {one.image.shape for one in library_files.load_references(tmp_path)} == {(96, 128)}


def test_images_that_claim_more_px_than_their_bytes_hold_are_refused_before_they_are_decoded(
    saved: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """One PNG of 60 kB and 67 Mpx may stand in a thousand rows."""
    monkeypatch.setattr(library_files, "_MOST_PX", 2**20)
    table = pq.read_table(saved / "references.parquet")
    black = cv2.imencode(".png", np.zeros((1024, 1024), np.uint8))[1].tobytes()
    rows = [{**table.to_pylist()[0], "image": black, "width": 1024, "height": 1024}] * 2
    pq.write_table(pa.Table.from_pylist(rows, table.schema), saved / "references.parquet")
    features = pq.read_table(saved / "features.parquet").slice(0, 0)
    pq.write_table(features, saved / "features.parquet")
    with pytest.raises(LibraryError, match="more px than their bytes hold"):
        library_files.load_references(saved)
