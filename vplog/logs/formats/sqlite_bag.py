"""ROS 2 bags in SQLite (rosbag2_storage_sqlite3), every schema version."""

from __future__ import annotations

import re
import sqlite3
import struct
from collections import Counter
from pathlib import Path
from typing import TYPE_CHECKING

from vplog.errors import LogError
from vplog.logs.formats.container import Channel, Contents, Message, Notes, by_topic, in_blocks
from vplog.logs.formats.layout import ResyncSearch
from vplog.logs.formats.loss_account import confirmed_span, main_span

if TYPE_CHECKING:
    from collections.abc import Collection, Iterable, Iterator

    from vplog.logs.formats.container import Block, Place

MAGIC = b"SQLite format 3\x00"
_DAMAGE = (sqlite3.Error, OverflowError, UnicodeDecodeError)
"""Exceptions that reading a damaged file raises."""
_MOST_TRIED = 20_000
"""Rows that are looked for one by one behind damage: a second's work."""
_MOST_MISSED = 2_000
"""Rows that may be missing in a row where the last one is not known."""
_LONGEST = 2**28
"""Bytes of a message that is read: an image of as many pixels as are decoded, of four bytes each."""


_BACK = (
    "SELECT 1 FROM (SELECT rowid AS row, lag(rowid) OVER () AS before FROM messages NOT INDEXED) WHERE row <= before "
    "LIMIT 1"
)
"""Finds a row behind one of a higher number: pages of the table lie in another order."""


class _OrderError(sqlite3.DatabaseError):
    """Rows come again, or one of them has a wrong number."""


class SqliteBag:
    """A Container over one .db3 file."""

    def __init__(self, path: Path, notes: Notes, name: str = "") -> None:
        """`name` is what the file is called in remarks."""
        self._path, self._name, self._notes = path, name or path.name, notes
        self._damaged = False
        self._holes: dict[int, int] = {}
        """The row behind each hole, by the row before it."""
        self._last_row: int | None = None
        """The last that can be read, once that is known to be less than all."""
        log = Path(f"{path}-wal")
        pending = log.is_file() and log.stat().st_size > 0
        try:
            self._db = self._connect("mode=ro" if pending else "immutable=1")  # immutable: no lock, no -shm file
        except (sqlite3.Error, UnicodeDecodeError) as error:
            if not pending:
                raise LogError(f"{path} is not a readable ROS 2 bag: {error}.") from None
            notes.add(f"{log.name} (write-ahead log) holds messages that cannot be read here; they are left out.")
            self._db = self._connect("immutable=1")
        self._topics = self._read_topics()
        appended_at = _appended_at(path)
        if appended_at is not None:
            notes.account.add_appended(self._name, appended_at, path.stat().st_size)

    def contents(self) -> Contents:
        by_id = Counter(dict.fromkeys(self._topics, 0))
        times: dict[int, list[int]] = {}
        query = "SELECT topic_id, count(*), min(timestamp), max(timestamp), max(rowid) FROM messages GROUP BY topic_id"
        try:
            found = self._db.execute(query).fetchall()
            last = max((row[4] for row in found), default=0)
            if sum(row[1] for row in found) > last:  # rows are numbered from 1: damage made the tree a circle
                raise sqlite3.DatabaseError("rows repeat")
            if self._db.execute(_BACK).fetchone():
                raise _OrderError("its row numbers do not increase")
            rows: Iterable[tuple] = [row[:4] for row in found]
        except _DAMAGE:
            rows = ((topic, 1, time_ns, time_ns) for _, topic, time_ns in self._salvaged("rowid, topic_id, timestamp"))
        for topic, count, first, last in rows:
            by_id[topic] += count
            known = [time_ns for time_ns in (*times.get(topic, []), first, last) if isinstance(time_ns, int)]
            times[topic] = [min(known), max(known)] if known else []
        log_span = main_span([time_ns for known in times.values() for time_ns in known])
        ends = [time_ns for topic in times.keys() & self._topics.keys() for time_ns in times[topic]]
        account, name = self._notes.account, self._name
        if missing := 0 if self._damaged else self._missing_by_index(by_id.total()):
            self._damaged = True
            detail = f"{name} is damaged: an index of its messages lists more of them."
            account.add("damaged_bytes", {"": missing}, (name, 0), [], detail)
        if self._damaged and not by_id.total():  # the list of topics is, and so may be all
            account.add("damaged_bytes", None, (name, 0), [], f"{name} is damaged: no message is found.")
        counts: Counter[Channel] = Counter()
        for topic, channel in self._topics.items():
            counts[channel] += by_id.pop(topic)
        if unknown := by_id.total():
            account.add("unknown_channel", {"": unknown}, (name, 0), [])
        account.set_recorded(name, {} if self._damaged else by_topic(counts), *log_span)
        return Contents(dict(sorted(counts.items())), *confirmed_span(ends))

    def _missing_by_index(self, rows: int) -> int:
        """Messages that an index of the table lists and the table, in which `rows` are found, has not."""
        table = "SELECT rowid FROM messages"
        for name in self._indexes():
            listed = f"{table} INDEXED BY {name}"
            try:
                number = self._db.execute(f"SELECT count(*) FROM ({listed})").fetchone()[0]  # noqa: S608 - quoted
                if number > rows:
                    missing = f"SELECT count(*) FROM ({listed} WHERE rowid <= ? EXCEPT {table} NOT INDEXED)"  # noqa: S608
                    return self._db.execute(missing, [number]).fetchone()[0]
            except _DAMAGE:
                continue  # the index is what is damaged
        return 0

    def blocks(self, channels: Collection[Channel], brief: Collection[Channel] = ()) -> Iterator[Block]:
        return in_blocks(self._messages(channels))

    def _messages(self, channels: Collection[Channel]) -> Iterator[Message]:
        ids = [topic for topic, channel in self._topics.items() if channel in channels]
        for row, topic, time_ns, data in self._salvaged("rowid, topic_id, timestamp, data", ids):
            if isinstance(data, bytes) and isinstance(time_ns, int):
                yield Message(self._topics[topic], time_ns, data, (row, time_ns))
            else:
                detail = f"{self._name} is damaged: row {row} holds no message."
                self._add_damaged_row(row, detail, (row, topic, time_ns))

    def read(self, place: Place) -> bytes:
        found = self._row(place[0], "data", " AND timestamp = ?", place[1])
        return found[0] if found and isinstance(found[0], bytes) else b""

    def _salvaged(self, columns: str, topics: list[int] | None = None) -> Iterator[tuple]:
        """Rows of the table of messages: row id, topic, time, and more columns; over damage, row by row. Recorders
        number them without a gap: a missing number is a lost message, and a row before one of a lower number has a
        wrong one."""
        last, last_ns, tried = 0, 0, 0
        while True:
            waiting = None
            try:
                for row in self._in_order(columns, topics, last):
                    if waiting:
                        self._note_jump(last, last_ns, waiting, topics)
                        last, last_ns = waiting[0], _integer(waiting[2])
                        yield waiting
                    waiting = row
                if waiting:
                    yield waiting
                return
            except _DAMAGE as error:
                again = isinstance(error, _OrderError)
                detail = f"{self._name} is damaged: {error}."
            if waiting and (not again or waiting[0] == last + 1):  # else it may be the one with a wrong number
                last, last_ns = waiting[0], _integer(waiting[2])
                yield waiting
            self._damaged, before, found, missing = True, last, None, 0
            least = last + 2 if again else 0  # the row with a wrong number may have that of the one before it
            end, is_listed = self._end_behind(last)
            while tried < _MOST_TRIED and last < end and (found is None or last < least):
                step = max(last + 1, self._holes.get(last, 0))
                tried, missing, last = tried + 1, missing + step - last - 1, step
                row = self._row(last, columns)
                if row is None:
                    missing += topics is None or not self._add_damaged_row(last, detail)
                    continue
                found = row
                if topics is None or row[1] in topics:
                    yield row
            if found is None:
                if topics is None or self._last_row is None:
                    self._cut(last_ns, missing if is_listed and last >= end else None, detail)
                self._last_row = before
                return
            if topics is None and not again:
                self._holes[before] = last
            before_ns, last_ns = last_ns or _integer(found[2]), _integer(found[2])
            self._add_missing_rows(before, missing, (before_ns, last_ns), detail)

    def _note_jump(self, last: int, last_ns: int, row: tuple, topics: list[int] | None) -> None:
        """Account for rows that are jumped over, where all are asked for, as they are behind damage."""
        if topics is None:
            span = last_ns or _integer(row[2]), _integer(row[2])
            detail = f"{self._name} is damaged: rows {last + 1} to {row[0] - 1} are not in their place."
            self._add_missing_rows(last, row[0] - last - 1, span, detail)

    def _add_missing_rows(self, before: int, missing: int, span: tuple[int, int], detail: str) -> None:
        if missing:
            self._notes.account.add("damaged_bytes", {"": missing}, (self._name, before), [span], detail)

    def _cut(self, last_ns: int, missing: int | None, detail: str) -> None:
        span = [(last_ns, last_ns)] if last_ns else []
        self._notes.account.add("cut", None if missing is None else {"": missing}, (self._name, 0), span, detail)

    def _in_order(self, columns: str, topics: list[int] | None, last: int) -> Iterator[tuple]:
        """Rows behind row `last`. Raises _OrderError where one is not behind the one before it, and _DAMAGE."""
        chosen = "1" if topics is None else f"topic_id IN ({','.join('?' * len(topics))})"
        behind = " AND rowid > ?" if last else ""
        query = f"SELECT {columns} FROM messages WHERE {chosen}{behind} ORDER BY rowid"  # noqa: S608 - names of ours
        for row in self._db.execute(query, [*(topics or []), *([last] if last else [])]):
            if row[0] <= last:
                raise _OrderError("its row numbers do not increase")
            last = row[0]
            yield row

    def _end_behind(self, row: int) -> tuple[int, bool]:
        """The last row to look for, where none is found behind `row`, and whether an index of the table lists it."""
        if self._last_row is not None:
            return self._last_row, False
        for table in (*(f"messages INDEXED BY {name}" for name in self._indexes()), "messages"):
            try:
                last = self._db.execute(f"SELECT max(rowid) FROM (SELECT rowid FROM {table})").fetchone()[0]  # noqa: S608
            except _DAMAGE:
                continue
            if isinstance(last, int):
                return last, table != "messages"
        return row + _MOST_MISSED, False

    def _indexes(self) -> list[str]:
        """Quoted names of the indexes of the table of messages."""
        try:
            found = self._db.execute("PRAGMA index_list(messages)").fetchall()
        except _DAMAGE:
            return []
        return ['"' + name.replace('"', '""') + '"' for _, name, *_ in found]

    def _row(self, row: int, columns: str, also: str = "", *values: int) -> tuple | None:
        """Columns of a row, None where it is not there or damaged; `also` are further conditions on it."""
        query = f"SELECT {columns} FROM messages WHERE rowid = ?{also}"  # noqa: S608 - names of ours
        try:
            return self._db.execute(query, [row, *values]).fetchone()
        except _DAMAGE:
            return None

    def _add_damaged_row(self, row: int, detail: str, found: tuple | None = None) -> bool:
        """A message whose topic and time can be read, but not the rest; others were missed when they were counted.
        `found` are its number, topic and time, where known."""
        found = found or self._row(row, "rowid, topic_id, timestamp")
        if found is not None and found[1] in self._topics:
            span, lost = (_integer(found[2]), _integer(found[2])), {self._topics[found[1]].topic: 1}
            self._notes.account.add("damaged_chunk", lost, (self._name, row), [span], detail)
            return True
        return False

    def _connect(self, mode: str) -> sqlite3.Connection:
        db = sqlite3.connect(f"{self._path.resolve().as_uri()}?{mode}", uri=True)
        db.text_factory = lambda text: text.decode("utf-8", "replace")
        db.execute("PRAGMA trusted_schema = OFF")  # a stranger's file runs nothing
        longest = min(max(self._path.stat().st_size, 2**16), _LONGEST)  # no value exceeds its file
        db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, longest)
        try:
            db.execute("SELECT count(*) FROM sqlite_master").fetchone()
        except sqlite3.DatabaseError:
            db.execute("PRAGMA writable_schema = ON")  # else SQLite reads no file shorter than in its header
            db.execute("SELECT count(*) FROM sqlite_master").fetchone()
        return db

    def _read_topics(self) -> dict[int, Channel]:
        tables = {name for (name,) in self._rows("SELECT name FROM sqlite_master WHERE type = 'table'")}
        if not {"topics", "messages"} <= tables:
            raise LogError(
                f"{self._path} is an SQLite file, but not a ROS 2 bag: it has no tables topics and messages."
            )
        # All columns, as SQLite holds the lengths of a row's against its own only where it reads the last.
        rows = [row[:4] for row in self._rows("SELECT id, name, type, serialization_format, * FROM topics")]
        # damage may have put anything, or nothing, in any column
        rows = [row for row in rows if [type(value) for value in row] == [int, str, str, str]]
        times = Counter(row[0] for row in rows)  # of two topics of one number, none can be distinguished
        return {number: Channel(*about) for number, *about in sorted(rows) if times[number] == 1}

    def _rows(self, query: str) -> Iterator[tuple]:
        """Rows as far as the file is sound; a note where it is not."""
        try:
            yield from self._db.execute(query)
        except _DAMAGE as error:
            self._damaged = True
            self._notes.add(f"{self._name}: the list of topics is damaged, read as far as it goes: {error}.")


def _appended_at(path: Path) -> int | None:
    """Where another database begins in a file of another length than in its header (sqlite.org/fileformat2.html)."""
    with path.open("rb") as file:
        page, pages = struct.unpack(">16xH10xI", file.read(32).ljust(32, b"\0"))
        length = path.stat().st_size
        return None if length == page * pages else ResyncSearch(file, length).first(re.compile(MAGIC), len(MAGIC))


def _integer(value: object) -> int:
    return value if isinstance(value, int) else 0
