"""Damaged logs, to compare how two versions of vplog read them.

python -m tests.logs.damaged_corpus make FOLDER [SEED]      # write the files, with what their sources hold
python -m tests.logs.damaged_corpus read FOLDER OUT.json    # read them with this version
python -m tests.logs.damaged_corpus compare FOLDER OLD.json NEW.json
"""

from __future__ import annotations

import hashlib
import json
import random
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path
from typing import Any

from tests.logs.drives import Drive, ros_messages, write_ros1, write_ros2
from tests.logs.log_fields import FIELDS
from tests.logs.test_damaged_fields import FORMATS
from vplog.errors import LogError
from vplog.logs.detect import open_container
from vplog.logs.formats.container import Notes

COUNTS = {".mcap": 520, ".bag": 360, ".db3": 240}
"""Damaged files of each kind."""
WIDTHS = (1, 16, 100, 512, 4096)
CONTAINER_LOSSES = ("cut", "damaged_bytes", "damaged_chunk", "unknown_channel", "appended", "missing_file")
"""Reasons of losses of the file itself, and not of the content of its messages."""
MOST_MESSAGES = 20_000


def make(folder: Path, seed: int) -> None:
    """Write files with one kind of damage each, and truth.json with the messages that were written, by topic."""
    rng, written = random.Random(seed), dict[str, dict[str, int]]()
    folder.mkdir(parents=True)
    with tempfile.TemporaryDirectory() as scratch:
        sources = sorted(_sources(Path(scratch)), key=str)
        for suffix, count in COUNTS.items():
            usable = [path for path in sources if path.suffix == suffix]
            for number in range(count):
                path, kind = usable[number % len(usable)], KINDS[number // len(usable) % len(KINDS)]
                name = f"{number:04}-{kind}-{path.stem[:30]}{suffix}"
                (folder / name).write_bytes(damaged(rng, path, kind))
                written[name] = dict(Counter(topic for topic, _ in _messages(path, Notes())))
    (folder / "truth.json").write_text(json.dumps(written))


KINDS = (
    "flip",
    "flips",
    "cut",
    "zero",
    "noise",
    "gone",
    "dup",
    "swap",
    "dup_block",
    "gone_block",
    "zero_block",
    "tail",
)


def damaged(rng: random.Random, path: Path, kind: str) -> bytes:
    """Return the bytes of a file with one kind of damage at a random place."""
    data = bytearray(path.read_bytes())
    at, width = rng.randrange(20, len(data)), min(rng.choice(WIDTHS), len(data) // 3)
    if kind in ("flip", "flips"):
        for _ in range(1 if kind == "flip" else 5):
            data[rng.randrange(20, len(data))] ^= 1 << rng.randrange(8)
    elif kind in ("cut", "tail"):
        del data[at if kind == "cut" else len(data) - rng.randrange(1, min(len(data) // 2, 600)) :]
    elif kind in ("zero", "noise", "gone", "dup"):
        at = rng.randrange(20, len(data) - width + 1)
        old = bytes(data[at : at + width])
        new = {"zero": bytes(width), "noise": rng.randbytes(width), "gone": b"", "dup": 2 * old}[kind]
        data[at : at + width] = new
    elif len(starts := _blocks(path, bytes(data))) < 4:
        return damaged(rng, path, "zero")
    else:
        row = rng.randrange(len(starts) - 2)
        begin, middle, end = starts[row : row + 3]
        first, second = bytes(data[begin:middle]), bytes(data[middle:end])
        data[begin:end] = {
            "swap": second + first, "dup_block": first + first + second, "gone_block": second,
            "zero_block": bytes(len(first)) + second,
        }[kind]  # fmt: skip
    return bytes(data)


def read(folder: Path) -> dict[str, Any]:
    """Return what this version reads of each file: digests of messages, and losses."""
    result = dict[str, Any]()
    for name in json.loads((folder / "truth.json").read_text()):
        began, notes, found = time.process_time(), Notes(), Counter[str]()
        try:
            for topic, digest in _messages(folder / name, notes):
                found[f"{topic} {digest}"] += 1
        except LogError as error:
            result[name] = {"error": str(error), "seen": {}}
            continue
        losses = [(one.reason, one.messages) for one in notes.account.losses if one.reason in CONTAINER_LOSSES]
        result[name] = {"seen": dict(found), "losses": losses, "cpu_s": time.process_time() - began}
    return result


def verdict(row: dict[str, Any], written: dict[str, int]) -> str:
    """Return how the losses that were reported compare with those that there are."""
    if "error" in row:
        return "refused"
    missed = sum(written.values()) - min(sum(row["seen"].values()), sum(written.values()))
    reported, is_open = sum(count or 0 for _, count in row["losses"]), any(count is None for _, count in row["losses"])
    if not missed:
        return "invented" if reported or is_open else "sound"
    if not (reported or is_open):
        return "silent"
    if reported > missed:
        return "too many"
    return "at least n" if is_open else "exact" if reported == missed else "too few"


def compare(folder: Path, old: dict[str, Any], new: dict[str, Any]) -> None:
    """Print verdicts, messages and CPU seconds of both versions, and files of which the new one reads under 98 %."""
    written = json.loads((folder / "truth.json").read_text())
    for suffix in COUNTS:
        names = [name for name in written if name.endswith(suffix)]
        for version, rows in (("old", old), ("new", new)):
            verdicts = Counter(verdict(rows[name], written[name]) for name in names)
            messages = sum(sum(rows[name]["seen"].values()) for name in names)
            cpu_s = sum(rows[name].get("cpu_s", 0.0) for name in names)
            print(suffix, version, dict(sorted(verdicts.items())), f"{messages} messages, {cpu_s:.1f} CPU s")
        for name in names:
            before, after = Counter(old[name]["seen"]), Counter(new[name]["seen"])
            if (before & after).total() < 0.98 * before.total():
                print("  below 98 %:", name, before.total(), "->", (before & after).total())


def _sources(folder: Path) -> list[Path]:
    found = []
    for name, form in FORMATS.items():
        (folder / name).mkdir()
        path = form.write(folder / name)
        found += [path] if path.is_file() else []
    drive = Drive()
    found += [write_ros1(folder / f"drive_{kind}.bag", ros_messages(drive, 1), kind) for kind in ("", "lz4", "bz2")]
    return [*found, next(write_ros2(folder / "drive_db3", ros_messages(drive, 2) * 3, "sqlite3").glob("*.db3"))]


def _messages(path: Path, notes: Notes) -> list[tuple[str, str]]:
    """Topic and digest of each message."""
    container, _ = open_container(path, notes)
    found = []
    for message in container.messages(container.contents().counts):
        content = hashlib.md5(bytes(message.data), usedforsecurity=False).hexdigest()[:8]
        found.append((message.channel.topic, f"{message.log_ns} {content}"))
        if len(found) > MOST_MESSAGES:
            break
    return found


def _blocks(path: Path, data: bytes) -> list[int]:
    """Where the chunks or pages of a file begin."""
    if path.suffix == ".db3":
        return list(range(0, len(data), 4096))
    name = "op5.header_length" if path.suffix == ".bag" else "chunk.record_length"
    return [field.offset - (path.suffix == ".mcap") for field in FIELDS[path.suffix](data) if field.name == name]


if __name__ == "__main__":
    what, where, *more = sys.argv[1:]
    if what == "make":
        make(Path(where), int(more[0]) if more else 54)
    elif what == "read":
        Path(more[0]).write_text(json.dumps(read(Path(where))))
    else:
        compare(Path(where), *(json.loads(Path(one).read_text()) for one in more))
