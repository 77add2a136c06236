"""ROS 2 bag folders: one or more storage files, in the order metadata.yaml gives."""

from __future__ import annotations

import re
from typing import TYPE_CHECKING

import yaml

from vplog.logs.compression import BadChunkError, unpack_zstd_message
from vplog.logs.containers import Contents, Message, Notes, ordered

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator, Sequence
    from pathlib import Path

    from vplog.logs.containers import Channel, Container, Place

_MAX_METADATA = 4 * 2**20
"""Bytes of metadata.yaml that are parsed; real ones have some 10 kB."""


_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)


class MetadataError(Exception):
    """metadata.yaml is damaged, or names no file that exists; the message is a sentence."""


class Chain:
    """A Container over several, one after the other."""

    def __init__(self, parts: Sequence[Container]) -> None:
        self._parts = parts

    def contents(self) -> Contents:
        counts: dict[Channel, int] = {}
        spans: list[tuple[int, int]] = []
        for part in self._parts:
            contents = part.contents()
            for channel, count in contents.counts.items():
                counts[channel] = counts.get(channel, 0) + count
            if contents.messages:
                spans.append((contents.start_ns, contents.end_ns))
        start_ns = min((start for start, _ in spans), default=0)
        return Contents(ordered(counts), start_ns, max((end for _, end in spans), default=0))

    def messages(self, channels: Collection[Channel]) -> Iterator[Message]:
        for number, part in enumerate(self._parts):
            for message in part.messages(channels):
                yield message._replace(place=(number, *message.place))

    def read(self, place: Place) -> bytes:
        return self._parts[place[0]].read(place[1:])


class ZstdMessages:
    """A Container whose messages are each a zstd frame (rosbag2's compression mode MESSAGE)."""

    def __init__(self, packed: Container, notes: Notes) -> None:
        self._packed, self._notes = packed, notes

    def contents(self) -> Contents:
        return self._packed.contents()

    def messages(self, channels: Collection[Channel]) -> Iterator[Message]:
        for message in self._packed.messages(channels):
            if data := self._unpack(message.data):
                yield message._replace(data=data)

    def read(self, place: Place) -> bytes:
        return self._unpack(self._packed.read(place))

    def _unpack(self, data: bytes) -> bytes:
        try:
            return unpack_zstd_message(data)
        except BadChunkError as error:
            self._notes.add(f"Messages that do not unpack are left out; the first: {error}.")
            return b""


def storage_files(folder: Path, notes: Notes) -> tuple[list[Path], str]:
    """The storage files of a bag folder in order, and its compression mode: ``, `file` or `message`.

    Raises MetadataError where metadata.yaml is damaged or names no file that exists.
    """
    tree = _metadata(folder)
    listed = tree.get("relative_file_paths")
    names = [name for name in listed if isinstance(name, str)] if isinstance(listed, list) else []
    # Names only: the first writers put the folder before them, and a stranger's list must not lead elsewhere.
    files = [folder / name.replace("\\", "/").rpartition("/")[2] for name in names]
    missing = [file.name for file in files if not file.is_file()]
    files = [file for file in files if file.is_file()]
    if not files:
        named = ", ".join(missing[:3]) or "no storage file"
        raise MetadataError(f"{folder / 'metadata.yaml'} names {named}, and no such file is in the folder.")
    if missing:
        notes.add(f"{folder.name} lacks {', '.join(missing[:3])} that metadata.yaml names; the other files are read.")
    mode = str(tree.get("compression_mode") or "").lower()
    return files, mode if mode in ("file", "message") else ""


def split_parts(files: list[Path]) -> list[Path] | None:
    """The files in order where they are NAME_0, NAME_1, ... of one bag; else None."""
    matches = [re.fullmatch(r"(.*)_(\d+)", file.stem) for file in files]
    numbers = sorted((int(m[2]), file) for m, file in zip(matches, files, strict=True) if m)
    one_name = len({m[1] for m in matches if m}) == 1 and len({file.suffix for file in files}) == 1
    if not one_name or [number for number, _ in numbers] != list(range(len(files))):
        return None
    return [file for _, file in numbers]


def _metadata(folder: Path) -> dict:
    path = folder / "metadata.yaml"
    try:
        if path.stat().st_size > _MAX_METADATA:
            raise MetadataError(f"{path} is larger than {_MAX_METADATA >> 20} MiB, so it is not a bag's metadata.")
        tree = yaml.load(path.read_text(encoding="utf-8"), Loader=_LOADER)  # noqa: S506 - both choices are safe loaders
        tree = tree["rosbag2_bagfile_information"]
    except (OSError, UnicodeDecodeError, RecursionError, TypeError, KeyError, ValueError, yaml.YAMLError):
        tree = None
    if not isinstance(tree, dict):
        raise MetadataError(f"{path} is not the metadata of a ROS 2 bag.")
    return tree
