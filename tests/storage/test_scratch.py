"""Folders that travel arrive as they were, and leave nothing behind."""

from __future__ import annotations

import errno
import fcntl
import os
import subprocess
import sys
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from vplog.errors import ResultError
from vplog.storage import scratch as scratch_of
from vplog.storage.scratch import files_in, own_folder, pieces, put_in_place, replacing, scratch, write_pieces

if TYPE_CHECKING:
    from collections.abc import Callable


@pytest.fixture
def machine(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """The temporary folder of a machine."""
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    return tmp_path


def make_folder(place: Path) -> Path:
    (place / "below").mkdir(parents=True)
    (place / "a.bin").write_bytes(bytes(range(256)) * 3)
    (place / "below" / "empty").touch()
    (place / ".features").write_bytes(b"nobody's")
    return place


def test_a_folder_comes_back_from_its_pieces(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(scratch_of, "_PIECE_BYTES", 100)
    source, target = make_folder(tmp_path / "source"), tmp_path / "target"
    assert files_in(source) == ["a.bin", "below/empty"]
    for name in files_in(source):
        parts = list(pieces(source / name))
        assert all(part.size <= 100 for part in parts)
        write_pieces(target, name, iter(parts))
        assert (target / name).read_bytes() == (source / name).read_bytes()
    for name in ("../out", "/out", "below/../../out"):
        with pytest.raises(ResultError, match="not inside"):
            write_pieces(target, name, iter([np.zeros(1, np.uint8)]))


def test_what_a_killed_process_leaves_goes_when_the_next_one_comes(machine: Path) -> None:
    code = f"""
import os, tempfile
tempfile.tempdir = {str(machine)!r}
from vplog.storage.scratch import scratch
with scratch("run") as folder:
    (folder / "large").touch()
    os.kill(os.getpid(), 9)
"""
    subprocess.run([sys.executable, "-c", code], check=False)
    [left] = own_folder().iterdir()
    assert (left / "large").exists()
    with scratch("run") as first, scratch("run") as second:
        assert sorted(own_folder().iterdir()) == sorted([first, second]), "of those that run none is taken"
    assert not list(own_folder().iterdir())


def test_parts_of_a_file_whose_writers_were_killed_go_when_it_is_written_again(tmp_path: Path) -> None:
    """Parts of living writers and files of other names stay."""
    path = tmp_path / "result [1].mcap"
    code = f"""
import os, pathlib
from vplog.storage.scratch import replacing
with replacing(pathlib.Path({str(path)!r})) as stream:
    stream.write(b"half")
    stream.flush()
    %s
"""
    for _ in range(2):
        subprocess.run([sys.executable, "-c", code % "os.kill(os.getpid(), 9)"], check=False)
    assert len(list(tmp_path.iterdir())) == 1
    living = code % "print(flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", living], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as process:
        assert process.stdout is not None
        process.stdout.readline()
        others = [
            tmp_path / name for name in (".result [1].mcap.mine.part", ".result 1.mcap.7.part", "result [1].part")
        ]
        for other in others:
            other.touch()
        [part] = tmp_path.glob(f".result*.{process.pid}-*.part")
        written = [*others, part]
        assert all(one.exists() for one in written)
        with replacing(path) as stream:
            stream.write(b"whole")
        assert sorted(tmp_path.iterdir()) == sorted([path, *written])
        process.communicate(b"\n")
    assert sorted(tmp_path.iterdir()) == sorted([path, *others])
    assert path.read_bytes() == b"half"


def test_a_file_is_written_through_the_descriptor_that_has_its_lock(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On SMB no other may write: its locks are mandatory, see flock(2). What closes the stream does not give it up."""
    locks = list[Any]()
    monkeypatch.setattr("fcntl.flock", lambda file, _: locks.append(file))
    with replacing(tmp_path / "result") as stream:
        stream.write(b"whole")
        stream.close()
        assert os.lseek(locks[-1].fileno(), 0, os.SEEK_CUR) == 5, "each open file has a place of its own"
    assert (tmp_path / "result").read_bytes() == b"whole"


def test_what_is_left_goes_where_only_who_may_write_may_lock(machine: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """As on NFS, where an exclusive lock of a file open for reading is EBADF."""
    flock = fcntl.flock

    def of_nfs(file: Any, how: int) -> None:
        if fcntl.fcntl(file, fcntl.F_GETFL) & os.O_ACCMODE == os.O_RDONLY and how & fcntl.LOCK_EX:
            raise OSError(errno.EBADF, os.strerror(errno.EBADF))
        flock(file, how)

    monkeypatch.setattr("fcntl.flock", of_nfs)
    left, part = machine / "run-1-left", machine / ".result.1-01234567.part"
    left.mkdir()
    (left / ".lock").touch()
    part.touch()
    with scratch("run", machine), replacing(machine / "result"):
        assert not left.exists()
        assert not part.exists()


def test_a_folder_of_somebody_else_is_not_used(tmp_path: Path, machine: Path) -> None:
    (tmp_path / "theirs").mkdir()
    own = own_folder()
    assert own.parent == machine
    own.rmdir()
    own.symlink_to(tmp_path / "theirs")
    with pytest.raises(ResultError, match="TMPDIR"):
        own_folder()


def written_in_pieces(path: Path) -> None:
    write_pieces(path.parent, path.name, iter([np.arange(9, dtype=np.uint8)]))


def written_as_a_whole(path: Path) -> None:
    with replacing(path) as stream:
        stream.write(b"whole")


def moved_folder(path: Path) -> None:
    put_in_place(make_folder(path.parent / "made"), path)


@pytest.mark.parametrize("write", [written_in_pieces, written_as_a_whole, moved_folder])
def test_content_is_on_the_disk_before_its_name_is(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, write: Callable[[Path], None]
) -> None:
    """Every file that is renamed was synced before, and the folder that has its new name after."""
    synced, events, fsync, replace = set[int](), list[str](), os.fsync, Path.replace

    def note_sync(handle: int) -> None:
        synced.add(os.fstat(handle).st_ino)
        events.append("folder" if os.fstat(handle).st_ino == tmp_path.stat().st_ino else "file")
        fsync(handle)

    def note_rename(self: Path, target: Path) -> Path:
        assert {one.stat().st_ino for one in [self, *self.rglob("*")]} <= synced
        events.append("rename")
        return replace(self, target)

    monkeypatch.setattr(os, "fsync", note_sync)
    monkeypatch.setattr(Path, "replace", note_rename)
    write(tmp_path / "result")
    assert (tmp_path / "result").exists()
    assert events[-2:] == ["rename", "folder"]
    assert "file" in events[:-2]


def test_what_a_process_leaves_that_is_killed_meanwhile_goes_with_the_block(tmp_path: Path) -> None:
    with scratch("run", tmp_path) as own:
        left = tmp_path / "run-1-left"
        left.mkdir()
        (left / ".lock").touch()
        (left / "run.json").touch()
    assert not own.exists()
    assert not left.exists()
