"""Tables of true pairs and labels: by rows and names, in CSV and NumPy files, and what is wrong with one."""

from __future__ import annotations

import pickle
from dataclasses import dataclass
from typing import TYPE_CHECKING, Any, cast

import numpy as np
import pytest

from vplog.errors import TruthError
from vplog.evaluate import truth_tables
from vplog.evaluate.place_truth import TruthChoice, open_truth
from vplog.evaluate.truth_tables import read_array

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.stages import Log


@dataclass(frozen=True)
class Pictures:
    """What truth needs of a folder of images, or of a recording where they have no names."""

    name: str
    names: list[str] | None
    count: int = 0

    def stamps(self) -> np.ndarray:
        return np.arange(len(self.names) if self.names is not None else self.count, dtype=np.int64)

    def file_names(self) -> list[str] | None:
        return self.names


DAY = Pictures("day", ["68.png", "9.png", "1150.png"])
NIGHT = Pictures("night", ["9.png", "1150.png", "3.png", "68.png"])
LOG = Pictures("log", None, 4)


def found(source: object, query: Pictures = DAY, other: Pictures = NIGHT, **more: Any) -> list[list[int]]:
    truth = open_truth(TruthChoice(str(source), **more), cast("Log", query), cast("Log", other))
    pairs = truth.pairs(truth.query_frames, truth.map_frames)
    return [pairs.rows(q).tolist() for q in range(len(pairs))]


def table(folder: Path, text: str) -> Path:
    path = folder / "truth.csv"
    path.write_text(text, encoding="utf-8")
    return path


def test_numbers_in_names_decide_and_it_is_said() -> None:
    assert found("index") == [[3], [0], [1]]
    assert found("index", tolerance=6) == [[3], [0, 2], [1]]
    about = open_truth(TruthChoice("index"), cast("Log", DAY), cast("Log", NIGHT)).about
    assert (about["by"], about["same_place"]) == ("names", "the same number in the file name")


@pytest.mark.parametrize(
    "names",
    [
        ["a.png", "b.png", "c.png"],
        ["1600000000.5.png", "1600000001.5.png", "1600000002.5.png"],
        ["1600000000000000001.png", "1600000000000000002.png", "1600000000000000003.png"],
        ["x/1.png", "y/1.png", "z/1.png"],
    ],
)
def test_rows_decide_where_names_have_no_numbers_of_their_own(names: list[str]) -> None:
    assert found("index", Pictures("other", names)) == [[0], [1], [2]]
    assert found("index", LOG) == [[0], [1], [2], [3]]


def test_numbers_are_those_that_differ() -> None:
    assert found("index", Pictures("a", ["cam0_07_l2.png", "cam0_03_l2.png"]), Pictures("b", ["3.png", "7.png"])) == [
        [1], [0],
    ]  # fmt: skip


def test_a_table_of_rows(tmp_path: Path) -> None:
    path = table(tmp_path, "\ufeffquery, match\r\n\n0,3\n2,0\n 1 , 3 \n2,0\n")
    assert found(path) == found(path, Pictures("log", None, 3)) == [[3], [3], [0]]


def test_a_table_of_names(tmp_path: Path) -> None:
    """By name, by the set's own name before it, and by stem; a column of whole numbers is of rows."""
    path = table(tmp_path, 'query,match\nday/68.png,night/3.png\n"9.png",1150.png\n1150.png,\n')
    assert found(path) == [[2], [1], []]
    assert found(table(tmp_path, "query,match\n68.png,1\n")) == [[1], [], []]
    nested = Pictures("nested", ["a/left.jpg", "b/right.jpg"])
    assert found(table(tmp_path, "query,match\nleft,68.png\nb/right.jpg,9.png\n"), nested) == [[3], [0]]
    assert found(table(tmp_path, "query,match\n9.png,68.png\n"), NIGHT, DAY, transposed=True) == [[], [], [], [1]]


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("0,1\n", ":1 is not the header"),
        ("query;match\n0;1\n", ":1 is not the header"),
        ("query,match\n0,1\n2\n", ":3 does not hold 2 fields"),
        ('query,match\n0,"1\n2"\n', ":2 has a quoted field of several lines"),
        ("query,match\n0,1\n,2\n", ":3 has an empty first field"),
        ("query,match\n\n0,1.5\n", ":3: '1.5' is neither a frame number nor an image of the map night"),
        ("query,match\n-1,1\n", ":2: '-1' is neither a frame number nor an image of the query day"),
        ("query,match\n²,1\n", ":2: '²' is neither"),
        ("query,match\n1,99999999999999999999\n", ":2: '99999999999999999999' is neither"),
        ("query,match\n68,1\n", ":2: 68 is not a frame of the query, whose 3 frames count from 0. To name images"),
        ("query,match\n1,5\n", ":2: 5 is not a frame of the map, whose 4 frames"),
        ("query,match\nx.png,\n", ":2: 'x.png' is neither"),
        ("query,match\n", "holds no pair"),
        ("", "holds no pair"),
        ("query,match\n" + "0" * 5000, ":2 is longer than"),
        ("image,label\n68.png,a\n9.png,b\n68.png,c\n", ":4: 68.png is at 'c' here, and at 'a' before"),
    ],
)
def test_what_does_not_fit_is_named_with_its_line(tmp_path: Path, text: str, said: str) -> None:
    path = table(tmp_path, text)
    with pytest.raises(TruthError) as error:
        found(path)
    assert said in str(error.value)
    assert str(path) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_table_that_is_no_text_or_is_missing(tmp_path: Path) -> None:
    path = tmp_path / "truth.csv"
    with pytest.raises(TruthError, match="Cannot read"):
        found(path)
    path.write_bytes(b"\xff\xfe\x00\x81" * 10)
    with pytest.raises(TruthError, match="is not text"):
        found(path)


def test_labels_by_folder() -> None:
    query = Pictures("a", ["hall/1.png", "roof/7.png", "nowhere/1.png"])
    other = Pictures("b", ["roof/1.png", "hall/2.png", "hall/3.png"])
    assert found("labels", query, other) == [[1, 2], [0], []]
    with pytest.raises(TruthError, match=r"68\.png is in no folder of its own"):
        found("labels", DAY, other)


def test_labels_by_table(tmp_path: Path) -> None:
    path = table(tmp_path, "image,label\nday/68.png,hall\nday/1150.png,roof\nnight/9.png,roof\nnight/3.png,roof\n")
    assert found(path) == [[], [0, 1]]  # rows of the frames that have a label
    other = tmp_path / "other.csv"
    other.write_text("image,label\n68.png,hall\n")
    path = table(tmp_path, "image,label\n68.png,hall\n")
    assert found(f"{path},{other}") == [[0]]
    with pytest.raises(TruthError, match="covers none of the 3 frames of the query day"):
        found(table(tmp_path, "image,label\nx.png,hall\n"))
    with pytest.raises(TruthError, match=r":3 has an empty label"):
        found(table(tmp_path, "image,label\nday/68.png,hall\nday/1150.png,\n"))


def test_positions_in_names() -> None:
    tail = "@T@45.06@7.65@pano@1@{}@@@@20200101@@.jpg"
    query = Pictures("a", ["@395000.0@4990000.0@32" + tail.format(90), "@395100.5@4990000.0@32" + tail.format("")])
    other = Pictures("b", [f"@{395000 + 20 * i}@4990000@32{tail.format(90 * i)}" for i in range(6)])
    assert found("utm", query, other) == [[0, 1], [4, 5]]  # within 25 m
    assert found("utm", query, other, distance_m=1.0) == [[0], [5]]
    assert found("utm", query, other, heading_deg=10.0) == [[1]]  # the second query has no heading
    elsewhere = Pictures("c", ["@395000.0@4990000.0@33" + tail.format(90)])
    assert found("utm", query, elsewhere) == [[], []]
    with pytest.raises(TruthError, match=r"68\.png gives no position, as --truth utm needs"):
        found("utm", DAY, other)


def ragged(*rows: Any) -> np.ndarray:
    values = np.empty((len(rows), 2), object)
    for at, row in enumerate(rows):
        values[at, 0], values[at, 1] = row
    return values


@pytest.mark.parametrize("protocol", [2, 3, 4])
def test_arrays_of_vpr_bench(tmp_path: Path, protocol: int) -> None:
    """A query and the list of its matches a row: lists, arrays, NumPy's numbers, in each kind of pickle."""
    values = ragged((0, [1, 2]), (np.int64(1), np.array([3])), (2, []), (3, (np.int32(0), 300)))
    path = tmp_path / "truth.npy"
    with path.open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": values.shape})
        pickle.dump(values, stream, protocol)
    assert read_array(path, 4, 400).tolist() == [[0, 1], [0, 2], [1, 3], [3, 0], [3, 300]]


def test_other_arrays(tmp_path: Path) -> None:
    path, matches = tmp_path / "truth.npy", np.empty(3, object)
    matches[:] = [np.array([2, 3]), np.array([], np.int64), np.array([0], ">i8")]
    expected = [[0, 2], [0, 3], [2, 0]]
    matrix = np.zeros((3, 4), np.uint8)
    matrix[tuple(np.transpose(expected))] = 1
    for values in (matches, np.array(expected, np.uint16), matrix, matrix.astype(bool)):
        np.save(path, values)
        assert read_array(path, 3, 4).tolist() == expected
    assert found(path) == [[2, 3], [], [0]]


class _Attack:
    """Would run a command, were it unpickled."""

    def __reduce__(self) -> Any:
        return (open, ("/tmp/never-made-by-vplog", "w"))  # noqa: S108


@pytest.mark.parametrize(
    ("values", "said"),
    [
        (ragged((_Attack(), [1])), "asks for 'open'"),
        (ragged((0, [0.5])), "does not hold whole numbers alone"),
        (ragged((0, ["a"])), "does not hold whole numbers alone"),
        (ragged((0, [4])), "4 is not a frame of the map, whose 4 frames"),
        (ragged((-1, [0])), "-1 is not a frame of the query"),
        (np.zeros((3, 5), int), "has shape (3, 5)"),
        (np.zeros(3), "it holds float64 of shape (3,)"),
    ],
)
def test_arrays_that_are_no_truth(tmp_path: Path, values: Any, said: str) -> None:
    path = tmp_path / "truth.npy"
    np.save(path, values, allow_pickle=True)
    with pytest.raises(TruthError) as error:
        read_array(path, 3, 4)
    assert said in str(error.value)
    assert "\n" not in str(error.value)


def test_damaged_arrays(tmp_path: Path) -> None:
    path = tmp_path / "truth.npy"
    np.save(path, ragged((0, [1, 2]), (2, [1])), allow_pickle=True)
    whole = path.read_bytes()
    for length in range(0, len(whole), 7):
        path.write_bytes(whole[:length])
        with pytest.raises(TruthError, match="is not an array of whole numbers that can be read"):
            read_array(path, 3, 4)
    rng = np.random.default_rng(0)
    for _ in range(200):  # nothing but a TruthError, whatever the bytes
        data = bytearray(whole)
        data[rng.integers(10, len(data))] = rng.integers(256)
        path.write_bytes(data)
        try:
            read_array(path, 3, 4)
        except TruthError as error:
            assert "\n" not in str(error)


def test_a_query_without_its_matches_is_damage(tmp_path: Path) -> None:
    path = tmp_path / "truth.npy"
    values = np.empty(3, object)
    values[:] = [0, [1], 2]
    with path.open("wb") as stream:
        np.lib.format.write_array_header_1_0(stream, {"descr": "|O", "fortran_order": False, "shape": (2, 2)})
        pickle.dump(values, stream, 4)
    with pytest.raises(TruthError, match="is not an array of whole numbers that can be read"):
        read_array(path, 3, 4)


def test_a_file_that_is_far_too_large_is_not_read(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(truth_tables, "_FILE_BYTES", 20)
    path = tmp_path / "pairs.csv"
    path.write_text("query,match\n" + "1,2\n" * 2)
    assert len(truth_tables.read_table(path)[1]) == 2
    path.write_text("query,match\n" + "1,2\n" * 3)
    with pytest.raises(TruthError, match="is larger than 0 MB, so it is no such table"):
        truth_tables.read_table(path)
