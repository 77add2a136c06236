"""ROS 2 bags in SQLite (rosbag2_storage_sqlite3), every schema version."""

from __future__ import annotations

import re
import sqlite3
import struct
from collections import Counter
from collections.abc import Collection, Iterator
from functools import partial
from pathlib import Path

from vplog.errors import LogError, plural
from vplog.logs.formats.budget import Budget
from vplog.logs.formats.container import Channel, Contents, Message, Notes, Place, by_topic
from vplog.logs.formats.loss_account import confirmed_span
from vplog.logs.formats.salvage import ResyncSearch

MAGIC = b"SQLite format 3\x00"
_DAMAGE = (sqlite3.Error, OverflowError, UnicodeDecodeError)
"""Exceptions that reading a damaged file raises."""
_MOST_TRIED = 20_000
"""Row numbers that are looked for one by one behind damage, and rows that may come again: a second's work."""
_LONGEST = 2**28
"""Bytes of a message that is read: an image of as many pixels as are decoded, of four bytes each."""
_LEAST_ROW = 8
"""Bytes of the smallest row, so that a file of which more are found has a tree that leads to some of them twice."""
_LEAST_FOUND = 64
"""Bytes of a row with the least message of ROS."""
_COUNTS = """
SELECT topic_id, count(*), min(timestamp), max(timestamp), sum(row <= before)
FROM (SELECT *, lag(row) OVER () AS before
      FROM (SELECT rowid AS row, topic_id, timestamp FROM messages NOT INDEXED LIMIT ?))
GROUP BY topic_id"""
"""By topic: rows, times, and how many lie behind one of no lower number, as pages in each other's place have them."""
_TABLES = """
SELECT name FROM sqlite_master WHERE type = 'table' AND sql LIKE 'CREATE TABLE %'
AND NOT EXISTS (SELECT * FROM pragma_table_xinfo(sqlite_master.name) WHERE hidden)"""
"""Names of tables whose rows are in the file. Views, virtual tables and generated columns are computed."""
_STEPS = 2**16
"""Instructions of SQLite between two looks at their number: about a millisecond."""
_ROWS = "SELECT rowid, topic_id, timestamp, data FROM messages"


class SqliteBag:
    """A Container over one .db3 file."""

    def __init__(self, path: Path, notes: Notes, name: str = "", budget: Budget | None = None) -> None:
        """`name` is what the file is called in remarks. `budget` limits the work of its queries, by default by its
        size."""
        self._path, self._name, self._notes = path, name or path.name, notes
        self._budget = budget or Budget(str(path), path.stat().st_size)
        self._steps = 0
        """Instructions of SQLite so far."""
        self._damage = ""
        """The first damage that was met, in a sentence."""
        self._by_id: Counter[int] = Counter()
        """Messages by topic number, once they are counted."""
        self._contents: Contents | None = None
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
        self._contents = self._contents or self._count()
        return self._contents

    def _count(self) -> Contents:
        self._by_id = Counter(dict.fromkeys(self._topics, 0))
        times: dict[int, list[int]] = {}
        for topic, count, *ends in self._counted():
            self._by_id[topic] += count
            times.setdefault(topic, []).extend(time_ns for time_ns in ends if isinstance(time_ns, int))
        counts: Counter[Channel] = Counter()
        for topic, channel in self._topics.items():
            counts[channel] += self._by_id[topic]
        account, name = self._notes.account, self._name
        if not self._damage and (unknown := self._by_id.total() - counts.total()):
            detail = f"{name} has {plural(unknown, 'row')} of topics that it does not list."
            account.add("unknown_channel", None, (name, 0), [], detail)
        log_span = confirmed_span([time_ns for known in times.values() for time_ns in known])
        account.set_recorded(name, {} if self._damage else by_topic(counts), *log_span)
        ends = [time_ns for topic in times.keys() & self._topics.keys() for time_ns in times[topic]]
        return Contents(dict(sorted(counts.items())), *confirmed_span(ends))

    def _counted(self) -> list[tuple]:
        """Return the topic number, messages, first and last time of each topic or, in a damaged file, of each row."""
        try:
            most = self._path.stat().st_size // _LEAST_ROW
            found = [] if self._damage else [*self._execute(_COUNTS, most)]
            count = sum(row[1] for row in found)
            if any(row[4] for row in found) or count == most:
                self._add_damage("its row numbers do not increase")
            elif self._listed("*") > count < self._listed():
                self._add_damage("an index of its messages lists more of them")
            if not self._damage:
                return [row[:4] for row in found]
        except _DAMAGE as error:
            self._add_damage(str(error))
        salvaged = [(topic, 1, time_ns) for _, topic, time_ns, _ in self._salvaged(0)]
        if 0 < len(salvaged) <= (listed := self._listed()):  # else the index is damaged too
            lost = listed - sum(topic in self._topics for topic, *_ in salvaged)
            self._notes.account.add("damaged_bytes", {"": lost}, (self._name, 0), [], self._damage)
        return salvaged

    def _add_damage(self, reason: str) -> None:
        """Note a loss of unknown number: the numbers of the rows may be damaged too."""
        self._damage = self._damage or f"{self._name} is damaged: {reason}."
        self._notes.account.add("damaged_bytes", None, (self._name, 0), [], self._damage)

    def _listed(self, what: str = "DISTINCT rowid") -> int:
        """Return how many messages the longest index of their table lists (`what` is counted); 0 if none is sound."""
        most = 0
        for _, name, *_ in self._rows("PRAGMA index_list(messages)"):
            index = '"' + name.replace('"', '""') + '"'
            query = f"SELECT count({what}) FROM (SELECT rowid FROM messages INDEXED BY {index})"  # noqa: S608 - quoted
            most = max(most, *self._first(query) or [0])
        return most

    def messages(self, channels: Collection[Channel], header_only: Collection[Channel] = ()) -> Iterator[Message]:
        ids = [topic for topic, channel in self._topics.items() if channel in channels]
        found: Counter[int] = Counter()
        for row, topic, time_ns, data in self._rows_of(ids):
            found[topic] += 1
            yield Message(self._topics[topic], time_ns, data, (row, time_ns))
        for topic in ids:
            if (short := self._by_id[topic] - found[topic]) > 0:
                detail = f"{self._name} is damaged: rows of it hold no message."
                lost = {self._topics[topic].topic: short}
                self._notes.account.add("damaged_chunk", lost, (self._name, topic), [], detail)

    def read(self, place: Place) -> bytes:
        found = self._row(place[0])
        return found[3] if found and found[2] == place[1] else b""

    def _rows_of(self, topics: list[int]) -> Iterator[tuple]:
        """Number, topic, time and data of the rows of these topics, by number."""
        last = 0
        try:
            if not self._damage:
                query = f"{_ROWS} WHERE topic_id IN ({','.join('?' * len(topics))}) ORDER BY rowid"
                for row in self._execute(query, *topics):
                    last = row[0]
                    if _is_whole(row):
                        yield row
                return
        except _DAMAGE:
            pass
        yield from (row for row in self._salvaged(last) if row[1] in topics)

    def _salvaged(self, number: int) -> Iterator[tuple]:
        """Whole rows behind this number, each once: as far as the pages of their table are sound, then from the next
        number that is found, as recorders number rows without a gap."""
        yielded: set[int] = set()
        left, last = _MOST_TRIED, self._last_row()
        while left > 0:
            try:
                for row in self._execute(f"{_ROWS} NOT INDEXED WHERE rowid > ?", number):
                    left -= row[0] in yielded
                    if left <= 0:
                        return
                    if row[0] not in yielded and _is_whole(row):
                        yielded.add(row[0])
                        yield row
                return
            except _DAMAGE:
                pass
            found = None
            while found is None and left > 0 and number < last:
                number += 1
                if number not in yielded:
                    left -= 1
                    found = self._row(number)
            if found is None:
                return
            yielded.add(number)
            yield found

    def _last_row(self) -> int:
        """The highest number of a row, by the table or its indexes; where none is sound, the most there can be."""
        (found,) = self._first("SELECT max(rowid) FROM messages") or (None,)
        return found if isinstance(found, int) else self._listed() or self._path.stat().st_size // _LEAST_FOUND

    def _row(self, number: int) -> tuple | None:
        """A row by its number; None where it is not there or not whole."""
        found = self._first(f"{_ROWS} WHERE rowid = ?", number)
        return found if found and _is_whole(found) else None

    def _first(self, query: str, *values: int) -> tuple | None:
        """The first row of a query; None where there is none, or damage keeps it from being read."""
        try:
            return next(self._execute(query, *values), None)
        except _DAMAGE:
            return None

    def _execute(self, query: str, *values: int) -> Iterator[tuple]:
        """Yield the rows of a query. Raises LogError if the file's queries have taken more steps than its budget."""
        try:
            yield from self._db.execute(query, values)
        except sqlite3.OperationalError:
            if self._is_over_budget():
                raise self._budget.error() from None
            raise

    def _is_over_budget(self, steps: int = 0) -> bool:
        self._steps += steps
        return self._steps > self._budget.max_bytes

    def _connect(self, mode: str) -> sqlite3.Connection:
        db = sqlite3.connect(f"{self._path.resolve().as_uri()}?{mode}", uri=True)
        db.text_factory = lambda text: text.decode("utf-8", "replace")
        db.execute("PRAGMA trusted_schema = OFF")  # a stranger's file runs nothing
        longest = min(max(self._path.stat().st_size, 2**16), _LONGEST)  # no value exceeds its file
        db.setlimit(sqlite3.SQLITE_LIMIT_LENGTH, longest)
        db.set_progress_handler(partial(self._is_over_budget, _STEPS), _STEPS)
        try:
            db.execute("SELECT count(*) FROM sqlite_master").fetchone()
        except sqlite3.DatabaseError:
            db.execute("PRAGMA writable_schema = ON")  # else SQLite reads no file shorter than in its header
            db.execute("SELECT count(*) FROM sqlite_master").fetchone()
        return db

    def _read_topics(self) -> dict[int, Channel]:
        if not {("topics",), ("messages",)} <= {*self._rows(_TABLES)}:
            raise LogError(
                f"{self._path} is an SQLite file, but not a ROS 2 bag: it has no tables topics and messages, or they "
                "are views or have generated columns. Give a file that `ros2 bag record` wrote."
            )
        # All columns, as SQLite holds the lengths of a row's against its own only where it reads the last.
        rows = [row[:4] for row in self._rows("SELECT id, name, type, serialization_format, * FROM topics")]
        # damage may have put anything, or nothing, in any column
        rows = [row for row in rows if [type(value) for value in row] == [int, str, str, str]]
        times = Counter(row[0] for row in rows)  # of two topics of one number, none can be distinguished
        return {number: Channel(*about) for number, *about in sorted(rows) if times[number] == 1}

    def _rows(self, query: str) -> Iterator[tuple]:
        """Rows as far as the file is sound."""
        try:
            yield from self._execute(query)
        except _DAMAGE as error:
            self._add_damage(str(error))


def _appended_at(path: Path) -> int | None:
    """Where another database begins in a file of another length than in its header (sqlite.org/fileformat2.html)."""
    with path.open("rb") as file:
        page, pages = struct.unpack(">16xH10xI", file.read(32).ljust(32, b"\0"))
        length = path.stat().st_size
        return None if length == page * pages else ResyncSearch(file, length).first(re.compile(MAGIC), len(MAGIC))


def _is_whole(row: tuple) -> bool:
    """Whether a row holds a message: damage may have put any type in a column."""
    return isinstance(row[1], int) and isinstance(row[2], int) and isinstance(row[3], bytes)
