"""The identity of a drive by its files."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vplog.storage.input_hashes import bytes_of, hash_inputs, stat_signature

if TYPE_CHECKING:
    from pathlib import Path


def linked(root: Path, name: str, content: bytes) -> Path:
    """A folder whose images lie elsewhere, and which links back to itself and to what holds it."""
    (root / f"{name}-images" / "deep").mkdir(parents=True)
    (root / f"{name}-images" / "deep" / "0.png").write_bytes(content)
    folder = root / name
    folder.mkdir()
    (folder / "calib.txt").write_bytes(b"P0")
    for link, target in (("image_0", root / f"{name}-images"), ("self", folder), ("up", root)):
        (folder / link).symlink_to(target, target_is_directory=True)
    return folder


def test_what_is_behind_links_is_of_the_drive_and_what_holds_it_is_not(tmp_path: Path) -> None:
    a, b = linked(tmp_path, "a", b"one"), linked(tmp_path, "b", b"two")
    assert list(hash_inputs(a)) == ["calib.txt", "image_0/deep/0.png"]
    assert bytes_of(a) == len(b"P0one")
    assert sorted(hash_inputs(a).values()) != sorted(hash_inputs(b).values())
    before = stat_signature(a)
    (tmp_path / "a-images" / "deep" / "0.png").write_bytes(b"changed")
    assert stat_signature(a) != before
