from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
import pytest

from tests.evaluate.data import data
from vplog.errors import TruthError
from vplog.evaluate.truth import read_truth

if TYPE_CHECKING:
    from pathlib import Path


def read(tmp_path: Path, text: str | bytes) -> object:
    (tmp_path / "truth.tum").write_bytes(text if isinstance(text, bytes) else text.encode())
    return read_truth(tmp_path / "truth.tum")


def test_comments_blank_lines_order_and_notation_do_not_matter(tmp_path: Path) -> None:
    (tmp_path / "truth.tum").write_text(
        "\ufeff# a comment\r\n\n"
        "1700000000.123456789 1 2 3 0 0 0 1 # the later one\r\n"
        "\t1.700000000023456789e+09   4 5 6 0 0 1 0\n"
        "1700000000.123456789 9 9 9 0 0 0 1\n"
        "   \n"
    )
    truth = read_truth(tmp_path / "truth.tum")
    assert truth.stamp_ns.tolist() == [1_700_000_000_023_456_789, 1_700_000_000_123_456_789]
    assert truth.world_from_body[:, :3, 3].tolist() == [[4, 5, 6], [1, 2, 3]]
    np.testing.assert_allclose(truth.world_from_body[0, :3, :3], np.diag([-1.0, -1.0, 1.0]))


@pytest.mark.parametrize(
    ("line", "says"),
    [
        ("1 2 3 4 5 6 7", "7 values"),
        ("1,0,0,0,0,0,0,1", "1 values"),
        ("1 0 0 0 0 0 0 1 9", "9 values"),
        ("1 0 0 x 0 0 0 1", "not a number"),
        ("x 0 0 0 0 0 0 1", "not a number"),
        ("1 0 0 nan 0 0 0 1", "not finite"),
        ("inf 0 0 0 0 0 0 1", "not finite"),
        ("1 0 0 1e999 0 0 0 1", "not finite"),
        ("1e999999999 0 0 0 0 0 0 1", "not in seconds"),
        ("1700000000123456789 0 0 0 0 0 0 1", "not in seconds"),
        ("1 0 0 0 0 0 0 0", "length 0"),
        ("1 0 0 0 3 4 0 0", "length 5"),
        ("1 " + "0" * 10_000, "longer than"),
    ],
)
def test_what_does_not_fit_is_named_by_its_line(tmp_path: Path, line: str, says: str) -> None:
    with pytest.raises(TruthError, match=says) as caught:
        read(tmp_path, f"# header\n1 0 0 0 0 0 0 1\n{line}\n")
    assert ":3" in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize("text", ["", "# nothing\n", b"\x89MCAP0\r\n\xff\xfe"])
def test_file_without_poses(tmp_path: Path, text: str | bytes) -> None:
    with pytest.raises(TruthError, match="TUM"):
        read(tmp_path, text)


def test_missing_file_and_folder(tmp_path: Path) -> None:
    for path in (tmp_path / "missing", tmp_path):
        with pytest.raises(TruthError, match="Cannot read"):
            read_truth(path)


@pytest.mark.parametrize("name", ["freiburg1_xyz-groundtruth", "freiburg1_xyz-rgbdslam", "fr2_desk_ORB_kf_mono"])
def test_evo_reads_the_same_poses(name: str) -> None:
    file_interface = pytest.importorskip("evo.tools.file_interface")
    path = data(f"trajectories/evo/{name}.txt")
    ours, theirs = read_truth(path), file_interface.read_tum_trajectory_file(path)
    assert [stamp / 10**9 for stamp in ours.stamp_ns.tolist()] == theirs.timestamps.tolist()
    np.testing.assert_array_equal(ours.world_from_body[:, :3, 3], theirs.positions_xyz)
