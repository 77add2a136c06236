"""Every length and offset of every format, damaged in turn: what is read and what is said lost are what was written.

Seeded bits anywhere in the files too. Nothing is made up, and nothing is lost without a word.
"""

from __future__ import annotations

import random
import sqlite3
import struct
from collections import Counter
from itertools import pairwise
from typing import TYPE_CHECKING, NamedTuple

import pytest
from mcap.writer import CompressionType, IndexType, Writer
from rosbags import rosbag1, rosbag2

from tests.logs.drives import START_NS, store
from tests.logs.log_fields import FIELDS
from vplog.errors import LogError
from vplog.logs.detect import open_container
from vplog.logs.formats.container import Notes
from vplog.logs.formats.ros2_folder import Chain, read_metadata

if TYPE_CHECKING:
    from collections.abc import Callable
    from pathlib import Path

    from tests.logs.log_fields import Field
    from vplog.logs.formats.container import Message

Messages = Counter[tuple[str, int, bytes]]
"""Topic, log time and bytes of each message."""
TOPICS = ("/a", "/bb", "/ccc")
_FARTHEST_NS = 86_400 * 10**9
"""ns from a log in which it may have lost messages: a day."""
KIND = "std_msgs/msg/String"


def messages() -> list[tuple[str, int, bytes]]:
    """24 messages of three topics at different rates, in no size twice."""
    rng = random.Random(1)
    topics = [TOPICS[(0, 1, 0, 2)[number % 4]] for number in range(24)]
    return [(topic, START_NS + 10**7 * i, rng.randbytes(20 + 3 * i)) for i, topic in enumerate(topics)]


WRITTEN = Counter(messages())


def write_mcap(path: Path, beside: bool = False, **options: object) -> Path:
    """With small chunks; `beside`: with attachments and metadata among them."""
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=350, **options)  # type: ignore[arg-type]
        writer.start("ros2", "test")
        channels = {}
        for number, (topic, log_ns, data) in enumerate(messages()):
            if topic not in channels:
                schema = writer.register_schema(KIND, "ros2msg", b"string data")
                channels[topic] = writer.register_channel(topic, "cdr", schema, {"qos": "reliable"})
            writer.add_message(channels[topic], log_ns, data, log_ns)
            if beside and number % 10 == 5:
                writer.add_attachment(log_ns, log_ns, f"map{number}", "text/plain", bytes(range(40)))
                writer.add_metadata(f"notes{number}", {"weather": "rain", "driver": "none"})
        writer.finish()
    return path


def write_bag(path: Path, compression: str) -> Path:
    writer = rosbag1.Writer(path)
    writer.chunk_threshold = 350
    if compression:
        writer.set_compression(rosbag1.Writer.CompressionFormat[compression])
    with writer:
        connections = {topic: writer.add_connection(topic, KIND, typestore=store(1)) for topic in TOPICS}
        for topic, log_ns, data in messages():
            writer.write(connections[topic], log_ns, data)
    return path


def write_db3(path: Path) -> Path:
    folder = path.with_suffix("")
    with rosbag2.Writer(folder, version=9, storage_plugin=rosbag2.StoragePlugin.SQLITE3) as writer:
        connections = {topic: writer.add_connection(topic, KIND, typestore=store(2)) for topic in TOPICS}
        for topic, log_ns, data in messages():
            writer.write(connections[topic], log_ns, data)
    return folder / path.name


def unindexed(path: Path) -> Path:
    """A bag as a recorder that crashed leaves it: without the index at its end."""
    data = path.read_bytes()
    at = data.index(b"index_pos=") + len(b"index_pos=")
    end = int.from_bytes(data[at : at + 8], "little")
    path.write_bytes(data[:at] + bytes(8) + data[at + 8 : end])
    return path


def cut_off(path: Path) -> Path:
    """An MCAP file as a recorder that crashed leaves it: up to the end of the last message index."""
    data = path.read_bytes()
    path.write_bytes(data[: data.rindex(b"\x0f\x04\0\0\0\0\0\0\0")])
    return path


class Format(NamedTuple):
    write: Callable[[Path], Path]
    counted: bool = True
    """Something in the file besides the messages themselves tells how many there are."""
    checked: bool = True
    """Checksums cover the messages, and their channels are defined at more than one place."""
    cut: bool = False
    """The end is missing, so that some of unknown number may be."""
    rows: bool = False
    """Rows of SQLite. They are looked up by halves, so that a damaged one may hide sound ones when they are counted;
    and without its first page, the list of tables, nothing is read."""
    bag: bool = False
    """A ROS 1 bag: where its index is damaged too, bytes that hold no record may have been a chunk."""
    folder: bool = False
    """With metadata.yaml beside it."""


BARE = {"use_statistics": False, "repeat_channels": False, "repeat_schemas": False}
FORMATS = {
    **{
        f"mcap-{kind.name.lower()}": Format(lambda p, kind=kind: write_mcap(p / "log.mcap", compression=kind))
        for kind in CompressionType
    },
    "mcap-beside": Format(lambda p: write_mcap(p / "log.mcap", beside=True)),
    "mcap-no-crc": Format(
        lambda p: write_mcap(p / "log.mcap", enable_crcs=False, compression=CompressionType.NONE), checked=False
    ),
    "mcap-no-summary": Format(
        lambda p: write_mcap(p / "log.mcap", use_summary_offsets=False, index_types=IndexType.MESSAGE, **BARE),
        checked=False,
    ),
    "mcap-no-index": Format(
        lambda p: write_mcap(p / "log.mcap", use_summary_offsets=False, index_types=IndexType.NONE, **BARE),
        False,
        False,
    ),
    "mcap-cut-off": Format(
        lambda p: cut_off(write_mcap(p / "log.mcap", compression=CompressionType.LZ4)), checked=False, cut=True
    ),
    "mcap-unchunked": Format(lambda p: write_mcap(p / "log.mcap", use_chunking=False), checked=False),
    "mcap-unchunked-no-summary": Format(
        lambda p: write_mcap(p / "log.mcap", use_chunking=False, use_summary_offsets=False, **BARE), False, False
    ),
    **{
        f"bag-{kind.lower() or 'none'}": Format(
            lambda p, kind=kind: write_bag(p / "log.bag", kind), checked=kind == "BZ2", bag=True
        )
        for kind in ("", "BZ2", "LZ4")
    },
    "bag-unindexed": Format(lambda p: unindexed(write_bag(p / "log.bag", "LZ4")), False, False, cut=True),
    "bag-none-unindexed": Format(lambda p: unindexed(write_bag(p / "log.bag", "")), False, False, cut=True),
    "db3": Format(lambda p: write_db3(p / "log.db3"), counted=False, checked=False, rows=True),
    "db3-folder": Format(lambda p: write_db3(p / "log.db3"), checked=False, rows=True, folder=True),
}


def values(field: Field, data: bytes, rng: random.Random) -> list[int]:
    """Wrong values: off by one, twice, of the limits of signed and unsigned numbers, and by chance."""
    true = field.read(data)
    limits = (2**31 - 1, 2**31, 2**32 - 1, 2**63, 2**64 - 1)
    wrong = [0, true - 1, true + 1, 2 * true, *(limit for limit in limits if limit < 1 << 8 * field.width)]
    wrong += [rng.randrange(1 << 8 * field.width), rng.randrange(max(2 * true, 2)), rng.randrange(len(data))]
    return list(dict.fromkeys(value % (1 << 8 * field.width) for value in wrong if value != true))


def by_topic(found: Messages) -> Counter[str]:
    result: Counter[str] = Counter()
    for (topic, _, _), count in found.items():
        result[topic] += count
    return result


def problem(path: Path, written: Messages, form: Format, content: bool = True) -> str:
    """What is wrong with the account of what is read and lost; empty where nothing is. `content`: whether the bytes of
    messages must be those that were written."""
    notes = Notes()
    try:
        container, _ = open_container(path, notes)
        if form.folder:
            container = Chain([container], notes, read_metadata(path.parent))
        contents = container.contents()
        read = Counter((m.channel.topic, m.log_ns, bytes(m.data)) for m in container.messages(contents.counts))
    except LogError as error:
        # The first bytes tell what a log is.
        known = "which no log does" in str(error) or (form.rows and "ROS 2 bag" in str(error))
        return "" if known and "\n" not in str(error) else f"refused: {error}"
    found: Counter[str] = Counter()
    for channel, count in contents.counts.items():
        found[channel.topic] += count
    made_up = read - written if content else Counter()
    if not content:  # nor need their topics be
        read, written, found = untold(read), untold(written), Counter({"": found.total()})
    return compared(by_topic(read), made_up, by_topic(written), found, notes, form)


def untold(found: Messages) -> Messages:
    """As many messages of no topic."""
    return Counter({("", 0, b""): found.total()})


def compared(
    read: Counter[str], made_up: Messages, written: Counter[str], found: Counter[str], notes: Notes, form: Format
) -> str:
    spans = [span for loss in notes.account.losses for span in loss.spans_ns]
    if any(abs(ns - START_NS) > 2 * _FARTHEST_NS for span in spans for ns in span):
        return f"wrong time: {[(ns - START_NS) / 1e9 for span in spans for ns in span]}"
    if made_up:
        return f"made up: {[(topic, len(data)) for topic, _, data in made_up]}"
    missed = written - read
    losses = [loss for loss in notes.account.losses if not form.cut or loss.reason != "cut" or loss.messages]
    said: Counter[str] = Counter()
    for loss in losses:
        said[loss.topic] += loss.messages or 0
    said = +said
    unknown = [loss.reason for loss in losses if loss.messages is None]
    state = f"missed {dict(missed)}, said {dict(said)} {unknown}, contents {dict(found)}: {notes.lines}"
    open_number = form.cut or (form.bag and not form.counted)
    if not missed and (said or (unknown and not open_number)):
        return f"invented loss: {state}"
    if missed and not (said or unknown):
        return f"silent loss: {state}"
    if unknown and form.counted:
        return f"unknown number: {state}"
    more = said.total() > missed.total() and not form.rows
    if more or (not unknown and said.total() < missed.total()):
        return f"wrong number: {state}"
    if (
        set(said) - {""}
        and set(written) != {""}
        and not form.rows
        and any(said[topic] > missed[topic] for topic in said if topic)
    ):
        return f"wrong topic: {state}"
    if not form.rows and (not read <= found or not found <= written):
        return f"wrong contents: read {dict(read)} {state}"
    return ""


@pytest.mark.parametrize("name", FORMATS)
def test_every_damaged_field_is_accounted_for(name: str, tmp_path: Path) -> None:
    form = FORMATS[name]
    path = form.write(tmp_path)
    whole = path.read_bytes()
    assert problem(path, WRITTEN, form) == ""
    rng, problems = random.Random(7), []
    for field in FIELDS[path.suffix](whole):
        for value in rng.sample(found := values(field, whole, rng), min(2, len(found))):
            path.write_bytes(field.set(whole, value))
            if wrong := problem(path, WRITTEN, form):
                problems.append(f"{field.name} at {field.offset}: {field.read(whole)} -> {value}: {wrong}")
    assert not problems, f"{len(problems)}\n" + "\n".join(problems)


@pytest.mark.parametrize("name", FORMATS)
def test_every_damaged_bit_is_accounted_for(name: str, tmp_path: Path) -> None:
    form = FORMATS[name]
    path = form.write(tmp_path)
    whole = path.read_bytes()
    rng, problems = random.Random(9), []
    for _ in range(100):
        bit = rng.randrange(8 * len(whole))
        data = bytearray(whole)
        data[bit // 8] ^= 1 << bit % 8
        path.write_bytes(data)
        if found := problem(path, WRITTEN, form, form.checked):
            problems.append(f"bit {bit % 8} of byte {bit // 8}: {found}")
    assert not problems, f"{len(problems)}\n" + "\n".join(problems)


@pytest.mark.parametrize("name", ["mcap-lz4", "mcap-zstd", "mcap-beside", "mcap-unchunked", "bag-bz2"])
def test_damage_in_several_places_is_accounted_for(name: str, tmp_path: Path) -> None:
    """Three bits, or a hole of 150 bytes; what lies twice in the file, both damaged, leaves the number open at most."""
    form = FORMATS[name]
    path = form.write(tmp_path)
    whole = path.read_bytes()
    rng, problems = random.Random(11), []
    for number in range(60):
        data = bytearray(whole)
        for bit in rng.sample(range(8 * len(whole)), 3):
            data[bit // 8] ^= 1 << bit % 8
        if number % 2:
            at = rng.randrange(len(whole) - 150)
            data = bytearray(whole[:at] + bytes(150) + whole[at + 150 :])
        path.write_bytes(data)
        if found := problem(path, WRITTEN, form._replace(counted=False), form.checked):
            problems.append(f"{number}: {found}")
    assert not problems, f"{len(problems)}\n" + "\n".join(problems)


def test_a_bag_that_is_cut_between_two_records_is_cut(tmp_path: Path) -> None:
    path = write_bag(tmp_path / "log.bag", "LZ4")
    whole = path.read_bytes()
    at = whole.index(b"index_pos=") + len(b"index_pos=")
    index_at = int.from_bytes(whole[at : at + 8], "little")
    ends = [field.offset for field in FIELDS[".bag"](whole) if field.name.endswith("header_length")]
    assert len(ends) > 10
    for end in (end for end in ends if end < index_at):
        path.write_bytes(whole[:end])
        notes = Notes()
        container, _ = open_container(path, notes)
        container.contents()
        assert [loss.reason for loss in notes.account.losses] == ["cut"], end


SEVERAL = (
    "mcap-lz4",
    "mcap-zstd",
    "mcap-no-summary",
    "mcap-unchunked",
    "bag-none",
    "bag-bz2",
    "bag-lz4",
    "db3",
    "db3-folder",
)
"""Formats of all kinds; in a chunk that is neither packed nor has a checksum, several damages can pass for messages."""


def damaged(whole: bytes, fields: list[Field], rng: random.Random) -> bytes:
    """Two to four damages: wrong lengths, zeroed blocks, bytes by chance; and now and then a cut tail."""
    data = whole
    for _ in range(rng.randrange(2, 5)):
        kind, at = rng.randrange(4), rng.randrange(len(whole))
        if kind == 0:
            field = rng.choice(fields)
            data = field.set(data, rng.choice((0, field.read(whole) + 1, 2 * field.read(whole), 2**31, 2**32 - 1)))
        else:
            width = (1, 4, 20, 100)[rng.randrange(4)]
            bytes_there = data[at : at + width]
            wrong = bytes(len(bytes_there)) if kind == 1 else rng.randbytes(len(bytes_there))
            data = data[:at] + wrong + data[at + width :]
    return data[: rng.randrange(len(data) // 3, len(data))] if rng.random() < 0.2 else data


@pytest.mark.parametrize("name", SEVERAL)
def test_several_damages_are_never_silent_nor_exaggerated(name: str, tmp_path: Path) -> None:
    """What is said lost is at most what is missing; where it is less, or nothing, more of unknown number is said."""
    form = FORMATS[name]
    path = form.write(tmp_path)
    whole = path.read_bytes()
    fields, rng, problems = list(FIELDS[path.suffix](whole)), random.Random(13), []
    for number in range(25):
        path.write_bytes(damaged(whole, fields, rng))
        if found := problem(path, WRITTEN, form._replace(counted=False), content=False):
            problems.append(f"{number}: {found}")
    assert not problems, f"{len(problems)}\n" + "\n".join(problems)


@pytest.mark.parametrize("name", FORMATS)
def test_several_damaged_fields_are_accounted_for(name: str, tmp_path: Path) -> None:
    """Two to four fields at once: a number that is said is right, and where none is known, that is said."""
    form = FORMATS[name]._replace(counted=False)
    path = form.write(tmp_path)
    whole = path.read_bytes()
    fields, problems = list(FIELDS[path.suffix](whole)), []
    for seed in range(64):
        rng, data, wounds = random.Random(f"{name} {seed}"), whole, []
        for field in rng.sample(fields, rng.randrange(2, 5)):
            value = rng.choice(values(field, whole, rng))
            data = field.set(data, value)
            wounds.append(f"{field.name} at {field.offset}: {field.read(whole)} -> {value}")
        path.write_bytes(data)
        if found := problem(path, WRITTEN, form, form.checked):
            problems.append(f"{seed}: {', '.join(wounds)}: {found}")
    assert not problems, f"{len(problems)}\n" + "\n".join(problems)


@pytest.mark.parametrize(
    "name", [name for name in FORMATS if name not in ("mcap-cut-off", "bag-unindexed", "bag-none-unindexed")]
)
def test_what_is_behind_the_end_of_a_recording_is_said(name: str, tmp_path: Path) -> None:
    """Two recordings in one file: the first is read whole, the second is not passed over without a word."""
    form = FORMATS[name]
    path = form.write(tmp_path)
    whole = path.read_bytes()
    path.write_bytes(whole + whole)
    notes = Notes()
    container, _ = open_container(path, notes)
    contents = container.contents()
    assert Counter((m.channel.topic, m.log_ns, bytes(m.data)) for m in container.messages(contents.counts)) == WRITTEN
    (loss,) = notes.account.losses
    assert (loss.reason, loss.messages) == ("appended", None)
    assert f"ends at byte {len(whole)} of {2 * len(whole)}" in loss.detail


@pytest.mark.parametrize("kind", ["", "BZ2", "LZ4"])
def test_the_index_of_a_bag_counts_what_damage_to_a_chunk_and_its_own_index_took(kind: str, tmp_path: Path) -> None:
    path = write_bag(tmp_path / "log.bag", kind)
    whole = path.read_bytes()
    index = [field for field in FIELDS[".bag"](whole) if field.name == "op4.header_length"]
    for field in index[:6]:
        chunk = max(
            f.offset for f in FIELDS[".bag"](whole) if f.name == "op5.header_length" and f.offset < field.offset
        )
        data = bytearray(field.set(whole, 0))
        data[chunk + 120 : chunk + 140] = bytes(20)
        path.write_bytes(data)
        assert problem(path, WRITTEN, Format(write_bag), content=False) == ""  # type: ignore[arg-type]


def chunk_starts(whole: bytes, suffix: str) -> list[int]:
    """Offsets of the chunk records."""
    name, before = ("op5.header_length", 0) if suffix == ".bag" else ("chunk.record_length", 1)
    return [field.offset - before for field in FIELDS[suffix](whole) if field.name == name]


CHUNKED = ["mcap-none", "mcap-lz4", "mcap-zstd", "bag-none", "bag-bz2", "bag-lz4"]


@pytest.mark.parametrize("name", CHUNKED)
def test_chunks_that_are_gone_or_in_each_others_place_are_accounted_for(name: str, tmp_path: Path) -> None:
    """With their indexes: a file system lost blocks, or put them together in another order."""
    form = FORMATS[name]._replace(counted=False)
    path = form.write(tmp_path)
    whole, problems = path.read_bytes(), []
    starts = chunk_starts(whole, path.suffix)
    for (a, b), (c, d) in zip(pairwise(starts), pairwise(starts[1:]), strict=False):
        gone, swapped = whole[:a] + whole[b:], whole[:a] + whole[c:d] + whole[a:b] + whole[d:]
        for data in (gone, swapped):
            path.write_bytes(data)
            if found := problem(path, WRITTEN, form, content=False):
                problems.append(f"{a}: {len(data)}: {found}")
    assert not problems, "\n".join(problems)


@pytest.mark.parametrize("name", ["mcap-lz4", "mcap-no-crc", "bag-lz4"])
def test_what_is_gone_up_to_the_index_at_the_end_is_accounted_for(name: str, tmp_path: Path) -> None:
    """From the index of a chunk on: the chunks that are still listed lie behind the end of the file."""
    form = FORMATS[name]._replace(counted=False)
    path = form.write(tmp_path)
    whole = path.read_bytes()
    kind = "op6.header_length" if path.suffix == ".bag" else "chunk_index.record_length"
    ends = [field.offset for field in FIELDS[path.suffix](whole) if field.name == kind]
    for start in chunk_starts(whole, path.suffix)[1:4]:
        path.write_bytes(whole[: start - 30] + whole[ends[-2] + 20 :])
        assert problem(path, WRITTEN, form, content=False) == ""


@pytest.mark.parametrize("name", [*CHUNKED, "bag-unindexed", "bag-none-unindexed", "mcap-no-summary", "mcap-cut-off"])
def test_bytes_that_are_zero_or_gone_or_new_are_accounted_for(name: str, tmp_path: Path) -> None:
    """Over the end of one chunk and the head of the next, up to all of two; nothing tells what two chunks held."""
    form = FORMATS[name]._replace(counted=False)
    path = form.write(tmp_path)
    whole, problems, rng = path.read_bytes(), [], random.Random(17)
    for start in chunk_starts(whole, path.suffix):
        for before, width in ((100, 150), (200, 900), (10, 1500), (3, 4)):
            at = max(start - before, 13)
            zeros = whole[:at] + bytes(min(width, len(whole) - at)) + whole[at + width :]
            more = whole[:at] + rng.randbytes(width) + whole[at:]
            for data in (zeros, more):
                path.write_bytes(data)
                found = problem(path, WRITTEN, form, content=False)
                if (
                    found
                    and not ("cut" in found and form.cut)
                    and not found.startswith("invented loss: missed {}, said {} [")
                ):
                    problems.append(f"{at} {width} {len(data)}: {found}")
    assert not problems, f"{len(problems)}\n" + "\n".join(problems)


def test_pages_of_a_database_in_each_others_place_are_accounted_for(tmp_path: Path) -> None:
    """SQLite finds no row that is not where its tree says, and goes on without a word."""
    form = FORMATS["db3"]
    path = form.write(tmp_path)
    with sqlite3.connect(path) as db:
        topics = [row[0] for row in db.execute("SELECT DISTINCT topic_id FROM messages ORDER BY topic_id")]
        for number in range(300):
            row = topics[number % 3], START_NS + number, bytes(80)
            db.execute("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", row)
    db.close()
    whole = path.read_bytes()
    page = int.from_bytes(whole[16:18], "big")
    leaves = [
        at
        for at in range(page, len(whole), page)
        if whole[at] == 13 and int.from_bytes(whole[at + 3 : at + 5], "big") > 9
    ]
    notes = Notes()
    before = Counter((m.log_ns, bytes(m.data)) for m in every_message(path, notes))
    assert len(leaves) > 4
    assert not notes.lines
    for a, b in pairwise(leaves):
        path.write_bytes(
            whole[:a] + whole[b : b + page] + whole[a + page : b] + whole[a : a + page] + whole[b + page :]
        )
        notes = Notes()
        read = Counter((m.log_ns, bytes(m.data)) for m in every_message(path, notes))
        lost = [loss.messages for loss in notes.account.losses]
        assert not read - before
        assert before.total() - read.total() <= sum(count or 0 for count in lost) or None in lost, notes.lines


def every_message(path: Path, notes: Notes) -> list[Message]:
    container, _ = open_container(path, notes)
    return list(container.messages(container.contents().counts))


def test_messages_after_a_false_end_of_the_data_are_read(tmp_path: Path) -> None:
    """Damage in a file without chunks looks like the end of its data."""
    form = FORMATS["mcap-unchunked-no-summary"]
    path = form.write(tmp_path)
    whole = path.read_bytes()
    for field in [field for field in FIELDS[".mcap"](whole) if field.name == "message.record_length"][5:15]:
        start, data_end = field.offset - 1, struct.pack("<BQI", 15, 4, 0)
        path.write_bytes(whole[:start] + data_end + b"\xff" * 10 + whole[start + len(data_end) + 10 :])
        notes = Notes()
        read = Counter((m.channel.topic, m.log_ns, bytes(m.data)) for m in every_message(path, notes))
        assert not read - WRITTEN
        assert (WRITTEN - read).total() <= 2  # the damaged message and the one before, whose length may be damaged
        assert [loss.messages for loss in notes.account.losses] == [None]


def test_chunks_in_each_others_place_lose_nothing(tmp_path: Path) -> None:
    """The index of the file is sound, and its chunks are not where it says."""
    path = write_mcap(tmp_path / "log.mcap", compression=CompressionType.LZ4)
    whole = path.read_bytes()
    a, b, c = chunk_starts(whole, ".mcap")[1:4]
    path.write_bytes(whole[:a] + whole[b:c] + whole[a:b] + whole[c:])
    notes = Notes()
    read = Counter((m.channel.topic, m.log_ns, bytes(m.data)) for m in every_message(path, notes))
    assert (read, notes.account.losses) == (WRITTEN, [])


def test_rows_that_a_damaged_page_lost_are_counted_by_the_index(tmp_path: Path) -> None:
    path = write_db3(tmp_path / "log.db3")
    with sqlite3.connect(path) as db:
        db.execute("CREATE INDEX IF NOT EXISTS timestamp_idx ON messages (timestamp)")
        (topic,) = db.execute("SELECT min(topic_id) FROM messages").fetchone()
        rows = [(topic, START_NS + number, bytes(200)) for number in range(300)]
        db.executemany("INSERT INTO messages (topic_id, timestamp, data) VALUES (?, ?, ?)", rows)
    db.close()
    written = WRITTEN.total() + len(rows)
    whole, page = path.read_bytes(), int.from_bytes(path.read_bytes()[16:18], "big")
    leaves = [at for at in range(page, len(whole), page) if whole[at] == 13 and whole[at + 4] > 9]  # of several rows
    for at in leaves[1:4]:
        path.write_bytes(whole[:at] + b"\xff" * page + whole[at + page :])
        notes = Notes()
        read = len(every_message(path, notes))
        (loss,) = notes.account.losses
        assert read < read + (loss.messages or 0) == written


def test_an_index_that_is_cut_off_ends_with_the_file(tmp_path: Path) -> None:
    """Of a chunk that begins at time 0, as which bytes behind the end of the file could be taken."""
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = Writer(file)
        writer.start("ros2", "test")
        channel = writer.register_channel("/a", "cdr", writer.register_schema(KIND, "ros2msg", b"string data"))
        for number in range(10):
            writer.add_message(channel, number, bytes(20), number)
        writer.finish()
    whole = path.read_bytes()
    index = next(field for field in FIELDS[".mcap"](whole) if field.name == "message_index.record_length")
    path.write_bytes(whole[: index.offset + 60])
    notes = Notes()
    assert len(every_message(path, notes)) == 10
    assert [loss.reason for loss in notes.account.losses] == ["cut"]


def test_where_nothing_is_left_the_times_are_those_of_most_chunks(tmp_path: Path) -> None:
    path = write_mcap(tmp_path / "log.mcap", compression=CompressionType.LZ4)
    data = bytearray(path.read_bytes())
    starts = chunk_starts(bytes(data), ".mcap")
    for start in starts:
        data[start + 80] ^= 255
    data[starts[2] + 9 + 15] ^= 64  # the high byte of its last time
    path.write_bytes(data)
    notes = Notes()
    assert not every_message(path, notes)
    spans = [span for loss in notes.account.losses for span in loss.spans_ns]
    assert spans
    assert all(abs(ns - START_NS) < _FARTHEST_NS for span in spans for ns in span)


def test_a_message_that_became_another_record_is_no_silent_loss(tmp_path: Path) -> None:
    form = FORMATS["mcap-unchunked-no-summary"]
    path = form.write(tmp_path)
    whole = path.read_bytes()
    for field in (field for field in FIELDS[".mcap"](whole) if field.name == "message.record_length"):
        for opcode in range(16):
            path.write_bytes(whole[: field.offset - 1] + bytes([opcode]) + whole[field.offset :])
            assert problem(path, WRITTEN, form, content=False) == "", (field.offset, opcode)


def test_index_entries_behind_bytes_that_are_gone_are_not_all(tmp_path: Path) -> None:
    """With a chunk, its first message index went too."""
    form = FORMATS["mcap-no-summary"]._replace(counted=False)
    path = form.write(tmp_path)
    whole = path.read_bytes()
    indexes = [field.offset - 1 for field in FIELDS[".mcap"](whole) if field.name == "message_index.record_length"]
    for start in chunk_starts(whole, ".mcap")[:-1]:
        second = next(at for at in indexes if at > next(at for at in indexes if at > start))
        path.write_bytes(whole[: start + 20] + whole[second:])
        assert problem(path, WRITTEN, form, content=False) == ""


@pytest.mark.parametrize("name", ["bag-none", "bag-lz4", "bag-bz2", "bag-none-unindexed", "bag-unindexed"])
def test_a_chunk_that_ends_at_the_index_of_a_later_one_swallows_nothing(name: str, tmp_path: Path) -> None:
    form = FORMATS[name]
    path = form.write(tmp_path)
    whole = path.read_bytes()
    fields = list(FIELDS[".bag"](whole))
    indexes = [field.offset for field in fields if field.name == "op4.header_length"]
    lengths = [field for field in fields if field.name == "op5.data_length"]
    for length, later in zip(lengths, lengths[2:], strict=False):
        for end in [at for at in indexes if at > later.offset][:3]:
            path.write_bytes(length.set(whole, end - length.offset - 4))
            assert problem(path, WRITTEN, form) == "", (length.offset, end)


@pytest.mark.parametrize("name", ["mcap-lz4", "mcap-no-summary", "mcap-unchunked", "bag-none", "bag-lz4", "db3"])
def test_a_log_begins_and_ends_with_times_that_another_confirms(name: str, tmp_path: Path) -> None:
    """A damaged time of a chunk or message, by years, is not that of the log."""
    path = FORMATS[name].write(tmp_path)
    whole = path.read_bytes()
    log_ns = [time_ns for _, time_ns, _ in messages()]
    order = "big" if path.suffix == ".db3" else "little"
    forms = [time_ns.to_bytes(8, order) for time_ns in log_ns]
    if path.suffix == ".bag":
        forms = [b"".join((part.to_bytes(4, "little")) for part in divmod(time_ns, 10**9)) for time_ns in log_ns]
    places = [at for at in range(len(whole) - 8) if whole[at : at + 8] in forms]
    assert places
    for at in places:
        high = at if order == "big" else at + (3 if path.suffix == ".bag" else 7)
        path.write_bytes(whole[:high] + bytes([whole[high] ^ 32]) + whole[high + 1 :])
        container, _ = open_container(path, Notes())
        contents = container.contents()
        assert abs(contents.start_ns - START_NS) < _FARTHEST_NS > abs(contents.end_ns - START_NS), at


def test_a_channel_may_be_defined_chunks_before_its_first_message(tmp_path: Path) -> None:
    """Of a file that repeats no channel in a summary, as a recorder that crashed leaves it."""
    path = tmp_path / "log.mcap"
    with path.open("wb") as file:
        writer = Writer(file, chunk_size=100, use_summary_offsets=False, index_types=IndexType.MESSAGE, **BARE)  # type: ignore[arg-type]
        writer.start("ros2", "test")
        schema = writer.register_schema(KIND, "ros2msg", b"string data")
        channels = [writer.register_channel(TOPICS[0], "cdr", schema)]
        for number in range(12):
            if number == 5:  # into a chunk of the first alone
                channels.append(writer.register_channel(TOPICS[1], "cdr", schema))
            writer.add_message(channels[number // 10], START_NS + number, bytes(40), START_NS + number)
        writer.finish()
    notes = Notes()
    assert len(every_message(path, notes)) == 12
    assert not notes.lines
