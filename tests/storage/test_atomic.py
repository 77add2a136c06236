from __future__ import annotations

import errno
import os
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
import pyarrow as pa
import pytest

from tests.results.example import METADATA, make_run
from vplog.errors import ResultError
from vplog.geometry.tum import write_tum
from vplog.results import tables
from vplog.results.g2o import write_g2o
from vplog.results.mcap import write_mcap
from vplog.results.run_record import read_run_json, write_run_json
from vplog.storage.json_records import canonical_json
from vplog.storage.scratch import replacing

if TYPE_CHECKING:
    from collections.abc import Iterator


def test_old_file_stays_until_the_new_one_is_whole(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")
    with replacing(path) as stream:
        stream.write(b"new")
        assert path.read_bytes() == b"old"
    assert path.read_bytes() == b"new"
    assert list(tmp_path.iterdir()) == [path]


def test_failure_leaves_the_old_file_and_nothing_else(tmp_path: Path) -> None:
    path = tmp_path / "file"
    path.write_bytes(b"old")
    with pytest.raises(ZeroDivisionError), replacing(path) as stream:
        stream.write(b"half")
        raise ZeroDivisionError
    assert [(p.name, p.read_bytes()) for p in tmp_path.iterdir()] == [("file", b"old")]


def test_what_is_no_file_stays_what_it_is(tmp_path: Path) -> None:
    """Renaming would put a file in the place of a device, and of what a link is."""
    (tmp_path / "link").symlink_to("to")
    with replacing(tmp_path / "link") as stream:
        stream.write(b"new")
    assert (tmp_path / "link").is_symlink()
    assert (tmp_path / "to").read_bytes() == b"new"
    (tmp_path / "null").symlink_to(os.devnull)
    with replacing(tmp_path / "null") as stream:
        stream.write(b"new")
    assert not Path(os.devnull).is_file()
    os.mkfifo(tmp_path / "pipe")
    reader = os.open(tmp_path / "pipe", os.O_RDONLY | os.O_NONBLOCK)
    with replacing(tmp_path / "pipe") as stream:
        stream.write(b"new")
    assert os.read(reader, 9) == b"new"
    os.close(reader)
    with pytest.raises(ResultError, match="is empty"), replacing(Path()):
        pass


def test_full_disk_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match=r"No space left.*-o"), replacing(tmp_path / "file"):
        raise OSError(errno.ENOSPC, "No space left on device")
    assert list(tmp_path.iterdir()) == []


@contextmanager
def small_disk() -> Iterator[None]:
    """No file may grow beyond 1 kB: a write fails as on a full disk, in the middle of a file.

    Around the write alone: the runner's own output may go to a file too.
    """
    resource = pytest.importorskip("resource")
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1000, before[1]))
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize("name", ["closures", "descriptors", "tum", "g2o", "mcap", "json"])
def test_every_writer_says_that_the_disk_is_full_and_leaves_nothing(tmp_path: Path, name: str) -> None:
    run, path = make_run(), tmp_path / "file"
    world = run.solution.world_from_body
    column = pa.array([np.random.default_rng(0).bytes(100)] * len(world), pa.binary())
    write = {
        "closures": lambda: tables.write_closures(path, run.closures, run.keyframes, METADATA),
        "descriptors": lambda: tables.write_descriptors(path, run.keyframes, column, METADATA),
        "tum": lambda: write_tum(path, run.trajectory),
        "g2o": lambda: write_g2o(path, run.graph, world),
        "mcap": lambda: write_mcap(path, run.keyframes, world, run.graph, run.closures, METADATA),
        "json": lambda: write_run_json(path, {"values": list(range(1000))}),
    }[name]
    with pytest.raises(ResultError, match="Cannot write") as caught, small_disk():
        write()
    assert "\n" not in str(caught.value)
    assert list(tmp_path.iterdir()) == []


def test_folder_that_does_not_exist_is_one_line(tmp_path: Path) -> None:
    with pytest.raises(ResultError, match="Cannot write"), replacing(tmp_path / "missing" / "file"):
        pass


def test_run_json_comes_back_in_order(tmp_path: Path) -> None:
    record = {"version": "1", "settings": {"b": 1, "a": [1.5, None, True]}, "seconds": {"read": 0.1}}
    write_run_json(tmp_path / "run.json", record)
    read = read_run_json(tmp_path / "run.json")
    assert read == record
    assert list(read) == list(record)
    assert list(read["settings"]) == ["b", "a"]


def test_run_json_takes_numpy_and_paths_and_has_no_nan(tmp_path: Path) -> None:
    record = {"n": np.int64(3), "x": np.array([1.0, float("nan")]), "path": tmp_path, "inf": float("inf")}
    write_run_json(tmp_path / "run.json", record)
    assert read_run_json(tmp_path / "run.json") == {"n": 3, "x": [1.0, None], "path": str(tmp_path), "inf": None}


@pytest.mark.parametrize("text", ["", "[1]", "{", "[" * 100_000, "\xff"])
def test_damaged_run_json_is_one_line(tmp_path: Path, text: str) -> None:
    (tmp_path / "run.json").write_bytes(text.encode("latin-1"))
    with pytest.raises(ResultError, match=r"run\.json"):
        read_run_json(tmp_path / "run.json")
    with pytest.raises(ResultError, match="vplog run"):
        read_run_json(tmp_path / "missing.json")


def test_canonical_json_is_the_same_for_any_order() -> None:
    assert canonical_json({"b": 1, "a": {"d": 2, "c": 3}}) == canonical_json({"a": {"c": 3, "d": 2}, "b": 1})


def test_processes_of_one_number_on_a_shared_disk_do_not_write_into_each_others_file(tmp_path: Path) -> None:
    """As containers have them: each writes a file of its own, and the last one stands."""
    path = tmp_path / "file"
    with replacing(path) as one:
        one.write(b"one")
        with replacing(path) as other:
            other.write(b"the other")
        assert path.read_bytes() == b"the other"
    assert path.read_bytes() == b"one"
    assert list(tmp_path.iterdir()) == [path]
