"""ROS 2 bags in SQLite (rosbag2_storage_sqlite3), every schema version."""

from __future__ import annotations

import sqlite3
from pathlib import Path
from typing import TYPE_CHECKING

from vplog.errors import LogError
from vplog.logs.containers import Channel, Contents, Message, Notes, ordered, plural

if TYPE_CHECKING:
    from collections.abc import Collection, Iterator

    from vplog.logs.containers import Place

MAGIC = b"SQLite format 3\x00"


class SqliteBag:
    """A Container over one .db3 file."""

    def __init__(self, path: Path, notes: Notes) -> None:
        self._path, self._notes = path, notes
        log = Path(f"{path}-wal")
        pending = log.is_file() and log.stat().st_size > 0
        try:
            self._db = self._connect("mode=ro" if pending else "immutable=1")  # immutable: no lock, no -shm file
        except (sqlite3.Error, UnicodeDecodeError) as error:
            if not pending:
                raise LogError(f"{path} is not a readable ROS 2 bag: {error}.") from None
            notes.add(f"{log.name} holds messages that were never merged and cannot be read here; they are left out.")
            self._db = self._connect("immutable=1")
        self._topics = self._read_topics()

    def contents(self) -> Contents:
        counts = dict.fromkeys(self._topics.values(), 0)
        start_ns, end_ns, unknown = 2**63, 0, 0
        query = "SELECT topic_id, count(*), min(timestamp), max(timestamp) FROM messages GROUP BY topic_id"
        for topic, count, first, last in self._rows(query):
            if topic not in self._topics:
                unknown += count
                continue
            counts[self._topics[topic]] += count
            start_ns, end_ns = min(start_ns, _integer(first)), max(end_ns, _integer(last))
        if unknown:
            self._notes.add(f"{self._path.name}: {plural(unknown, 'message')} of unknown topics left out.")
        return Contents(ordered(counts), min(start_ns, end_ns), end_ns)

    def messages(self, channels: Collection[Channel]) -> Iterator[Message]:
        ids = [topic for topic, channel in self._topics.items() if channel in channels]
        marks = ",".join("?" * len(ids))
        query = f"SELECT rowid, topic_id, timestamp, data FROM messages WHERE topic_id IN ({marks}) ORDER BY rowid"  # noqa: S608 - marks only
        for row, topic, time_ns, data in self._rows(query, ids):
            if isinstance(data, bytes):
                yield Message(self._topics[topic], _integer(time_ns), data, (row,))

    def read(self, place: Place) -> bytes:
        for (data,) in self._rows("SELECT data FROM messages WHERE rowid = ?", list(place)):
            if isinstance(data, bytes):
                return data
        return b""

    def _connect(self, mode: str) -> sqlite3.Connection:
        db = sqlite3.connect(f"{self._path.resolve().as_uri()}?{mode}", uri=True)
        db.text_factory = lambda text: text.decode("utf-8", "replace")
        db.execute("PRAGMA trusted_schema = OFF")  # a stranger's file runs nothing
        db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, max(self._path.stat().st_size, 2**16))  # no value exceeds its file
        db.execute("SELECT count(*) FROM sqlite_master").fetchone()
        return db

    def _read_topics(self) -> dict[int, Channel]:
        tables = {name for (name,) in self._rows("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise LogError(
                f"{self._path} is an SQLite file, but not a ROS 2 bag: it has no tables topics and messages."
            )
        rows = self._rows("SELECT id, name, type, serialization_format FROM topics ORDER BY id")
        return {number: Channel(str(name), str(kind), str(encoding)) for number, name, kind, encoding in rows}

    def _rows(self, query: str, values: list[int] | None = None) -> Iterator[tuple]:
        """Rows as far as the file is sound; a note where it is not."""
        try:
            yield from self._db.execute(query, values or [])
        except (sqlite3.Error, OverflowError, UnicodeDecodeError) as error:
            self._notes.add(f"{self._path.name} is damaged, read as far as it goes: {error}.")


def _integer(value: object) -> int:
    return value if isinstance(value, int) else 0
