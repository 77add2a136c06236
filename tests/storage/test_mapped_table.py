"""The room of a mapped table is taken before it is filled."""

from __future__ import annotations

import errno
import os
from typing import TYPE_CHECKING

import pytest

from vplog.errors import ResultError
from vplog.storage.mapped_table import mapped_scores

if TYPE_CHECKING:
    from pathlib import Path


def test_the_room_is_taken_at_once(tmp_path: Path) -> None:
    table = mapped_scores(tmp_path / "scores.npy", (100, 1000))
    assert (table.shape, table.dtype) == ((100, 1000), "<f4")
    assert 512 * (tmp_path / "scores.npy").stat().st_blocks >= table.nbytes


def test_a_full_disk_is_an_error_in_a_line(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    def full(*_: int) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "posix_fallocate", full, raising=False)
    with pytest.raises(ResultError, match=r"need 0.4 GB.*No space left on device. Make room, or set TMPDIR"):
        mapped_scores(tmp_path / "scores.npy", (10_000, 10_000))
