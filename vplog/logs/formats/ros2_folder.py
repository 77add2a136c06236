"""ROS 2 bag folders: one or more storage files, in the order metadata.yaml gives."""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import yaml
import zstandard

from vplog.errors import LogError
from vplog.logs.formats.budget import max_unpacked
from vplog.logs.formats.compression import BadChunkError, unpack_zstd_message
from vplog.logs.formats.container import Channel, Container, Contents, Message, Notes, Place, RawData, by_topic
from vplog.logs.formats.loss_account import LossRuns

_MAX_METADATA = 4 * 2**20
"""Bytes of metadata.yaml that are parsed; real ones have some 10 kB."""
_MOST_MESSAGES = 2**48
"""Largest plausible count of messages: more than a recorder writes in its life."""
_DEEPEST = 64
"""Levels of lists and maps in metadata.yaml; rosbag2 writes 8."""
_LOADER = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
_PART = re.compile(r"(.*)_(\d{1,9})(\.[a-z0-9.]+)")
"""Name of a part of a bag, NAME_0.mcap."""
_TRIED = 10
"""Messages that are looked at for whether each is packed: a damaged one does not decide it."""


class MetadataError(Exception):
    """metadata.yaml is damaged, or names no file that exists; the message is a sentence."""


@dataclass(frozen=True)
class Metadata:
    """The content of metadata.yaml."""

    files: list[Path]
    """The storage files that are there, in order."""
    missing: list[str]
    """Names of those that are not."""
    recorded: dict[str, int]
    """Messages by topic; empty where it does not say."""
    start_ns: int
    """Start time of the recording; 0 where unknown."""
    end_ns: int
    unlisted: list[str] = field(default_factory=list)
    """Names of the files that are further parts and that metadata.yaml does not list, as after a crash."""


class Chain:
    """A Container over several, one after the other."""

    def __init__(self, parts: Sequence[Container], notes: Notes, metadata: Metadata | None = None) -> None:
        """With `metadata` that count the recorded messages, lost ones are counted."""
        self._parts, self._notes, self._metadata = parts, notes, metadata
        self._contents: Contents | None = None

    def contents(self) -> Contents:
        """Return the contents of all parts, and account once for what the metadata count and no part holds."""
        self._contents = self._contents or self._count()
        return self._contents

    def _count(self) -> Contents:
        found = [part.contents() for part in self._parts]
        counts: Counter[Channel] = Counter()
        for contents in found:
            counts.update(contents.counts)
        spans = [(contents.start_ns, contents.end_ns) for contents in found if contents.messages]
        start_ns = min((start for start, _ in spans), default=0)
        if self._metadata is not None and self._metadata.recorded:
            self._reconcile(self._metadata, by_topic(counts))
        return Contents(dict(sorted(counts.items())), start_ns, max((end for _, end in spans), default=0))

    def messages(self, channels: Collection[Channel], header_only: Collection[Channel] = ()) -> Iterator[Message]:
        for number, part in enumerate(self._parts):
            for message in part.messages(channels, header_only):
                yield message._replace(place=(number, *message.place))

    def read(self, place: Place) -> RawData:
        return self._parts[place[0]].read(place[1:])

    def _reconcile(self, known: Metadata, found: dict[str, int]) -> None:
        """Count what is lost by what the metadata say."""
        account, files = self._notes.account, [*(file.name for file in known.files), *known.missing]
        unexplained = account.reconcile(files, known.recorded, found, known.end_ns or None)
        if unexplained:
            more = sum(unexplained.values())
            self._notes.add(f"metadata.yaml counts {more} messages more than its undamaged storage files hold.")
        elif account.losses:
            for file in files:
                account.set_recorded(file, {}, 0)
            account.set_recorded("metadata.yaml", known.recorded, account.start_ns or known.start_ns)


class ZstdMessages:
    """A Container whose messages are each a zstd frame (rosbag2's compression mode MESSAGE)."""

    def __init__(self, packed: Container, notes: Notes) -> None:
        self._packed, self._account = packed, notes.account

    def contents(self) -> Contents:
        return self._packed.contents()

    def read(self, place: Place) -> bytes:
        try:
            return unpack_zstd_message(self._packed.read(place))
        except BadChunkError:
            return b""

    def messages(self, channels: Collection[Channel], header_only: Collection[Channel] = ()) -> Iterator[Message]:
        lost: defaultdict[str, LossRuns] = defaultdict(LossRuns)
        reason, on_disk, unpacked = "", 0, 0

        def charge(size: int) -> None:
            nonlocal unpacked
            unpacked += size
            if unpacked > max_unpacked(on_disk):
                raise LogError(
                    f"{on_disk} bytes of messages with zstd compression unpack to more than {max_unpacked(on_disk)} "
                    "bytes, so the log is damaged or made to exhaust the computer. Copy or record it again."
                )

        for message in self._packed.messages(channels):
            topic = message.channel.topic
            on_disk += len(message.data)
            try:
                yield message._replace(data=unpack_zstd_message(message.data, charge))
            except BadChunkError as error:
                reason = reason or f"The first does not unpack: {error}."
                lost[topic].add_lost(message.log_ns)
                self._account.add("packed", {topic: lost[topic].messages}, (topic, 0), lost[topic].spans, reason)
            else:
                lost[topic].add_sound()


def messages_unpacked(container: Container, contents: Contents, notes: Notes) -> Container:
    """The container, or one that unpacks its messages where each is a zstd frame, as which no CDR begins: rosbag2's
    compression mode MESSAGE, in a folder whose metadata say so or in a storage file alone."""
    channels = [channel for channel in contents.counts if channel.encoding == "cdr"]
    firsts = islice(container.messages(channels), _TRIED) if channels else ()
    packed = any(bytes(message.data[:4]) == zstandard.FRAME_HEADER for message in firsts)
    return ZstdMessages(container, notes) if packed else container


def read_metadata(folder: Path) -> Metadata:
    """Read metadata.yaml. Raises MetadataError where it is damaged or names no file that exists."""
    tree = _metadata(folder)
    listed = tree.get("relative_file_paths")
    names = [name for name in listed if isinstance(name, str)] if isinstance(listed, list) else []
    # Names only: the first writers put the folder before them, and a stranger's list must not lead elsewhere.
    named = [folder / name.replace("\\", "/").rpartition("/")[2] for name in names]
    files, missing = [file for file in named if file.is_file()], [file.name for file in named if not file.is_file()]
    if not files:
        lacks = ", ".join(missing[:3]) or "no storage file"
        raise MetadataError(f"{folder / 'metadata.yaml'} names {lacks}, and no such file is in the folder.")
    start_ns, length_ns = _nanoseconds(tree.get("starting_time")), _nanoseconds(tree.get("duration"))
    end_ns = start_ns + length_ns if start_ns and length_ns else 0
    kinds = {_PART.sub(r"\1\3", file.name) for file in named if _PART.fullmatch(file.name)}
    unlisted = [file for file in folder.iterdir() if file not in named and _PART.fullmatch(file.name)]
    unlisted = [file for file in unlisted if _PART.sub(r"\1\3", file.name) in kinds and file.is_file()]
    if unlisted:  # the counts do not include them
        unlisted.sort(key=lambda file: int(_PART.sub(r"\2", file.name)))
        return Metadata([*files, *unlisted], missing, {}, start_ns, 0, [file.name for file in unlisted])
    return Metadata(files, missing, _recorded(tree), start_ns, end_ns)


def _recorded(tree: dict) -> dict[str, int]:
    """Messages by topic; empty where the list is not one."""
    result: Counter[str] = Counter()
    topics = tree.get("topics_with_message_count")
    for topic in topics if isinstance(topics, list) else []:
        match topic:
            case {"topic_metadata": {"name": str(name)}, "message_count": int(count)} if 0 <= count < _MOST_MESSAGES:
                result[name] += count
    return dict(result)


def _nanoseconds(tree: Any) -> int:
    values = tree.values() if isinstance(tree, dict) else ()
    return next((value for value in values if isinstance(value, int) and 0 < value < 2**63), 0)


def split_parts(files: list[Path]) -> list[Path] | None:
    """The files in order where they are NAME_0, NAME_1, ... of one bag; else None. One that ROS 1 did not finish is
    NAME_2.bag.active."""
    names = [Path(file.name.removesuffix(".active")) for file in files]
    matches = [re.fullmatch(r"(.*)_(\d+)", name.stem) for name in names]
    numbers = sorted((int(m[2]), file) for m, file in zip(matches, files, strict=True) if m)
    one_name = len({m[1] for m in matches if m}) == 1 and len({name.suffix for name in names}) == 1
    if not one_name or [number for number, _ in numbers] != list(range(len(files))):
        return None
    return [file for _, file in numbers]


def _check_depth(text: str) -> None:
    """Raises ValueError for what nests deeper than any bag's metadata: libyaml's loader would use up the C stack."""
    depth = 0
    for event in yaml.parse(text, Loader=_LOADER):
        depth += isinstance(event, yaml.CollectionStartEvent) - isinstance(event, yaml.CollectionEndEvent)
        if depth > _DEEPEST:
            raise ValueError(f"its YAML has more than {_DEEPEST} nested levels")


def _metadata(folder: Path) -> dict:
    path = folder / "metadata.yaml"
    try:
        if path.stat().st_size > _MAX_METADATA:
            raise MetadataError(f"{path} is larger than {_MAX_METADATA >> 20} MiB, so it is not a bag's metadata.")
        text = path.read_text(encoding="utf-8")
        _check_depth(text)
        tree = yaml.load(text, Loader=_LOADER)  # noqa: S506 - both choices are safe loaders
        tree = tree["rosbag2_bagfile_information"]
    except (OSError, UnicodeDecodeError, RecursionError, TypeError, KeyError, ValueError, yaml.YAMLError):
        tree = None
    if not isinstance(tree, dict):
        raise MetadataError(f"{path} is not the metadata of a ROS 2 bag.")
    return tree
