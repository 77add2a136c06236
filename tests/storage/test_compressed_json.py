"""Records in one compressed file: the same bytes for the same values, and no more memory than the file justifies."""

from __future__ import annotations

import gzip
from pathlib import Path

import pytest

from vplog.errors import ResultError
from vplog.storage.compressed_json import read_compressed, write_compressed


def test_values_come_back_and_their_bytes_are_the_same(tmp_path: Path) -> None:
    values = {"drives": [{"name": f"d{number}", "sha256": f"{number:064x}"} for number in range(1000)]}
    for name in ("one", "two"):
        write_compressed(tmp_path / name, values)
    assert read_compressed(tmp_path / "one") == values
    assert (tmp_path / "one").read_bytes() == (tmp_path / "two").read_bytes()


def test_damage_and_text_far_longer_than_its_file_are_refused(tmp_path: Path) -> None:
    write_compressed(tmp_path / "record", list(range(1000)))
    packed = (tmp_path / "record").read_bytes()
    for content in (packed[:-9], packed[:20] + b"\0" + packed[21:], gzip.compress(b'"' + b" " * 10**7 + b'"')):
        (tmp_path / "record").write_bytes(content)
        with pytest.raises(ResultError, match="damaged"):
            read_compressed(tmp_path / "record")
