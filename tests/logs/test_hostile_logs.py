"""Logs that were made to hurt: each is read or refused in one line, at once and in little memory."""

from __future__ import annotations

import json
import os
from typing import TYPE_CHECKING

import pytest
from mcap.writer import CompressionType, Writer

from vplog import logs
from vplog.errors import LogError
from vplog.logs.formats.container import Channel, Notes
from vplog.logs.formats.mcap_file import McapFile

if TYPE_CHECKING:
    from pathlib import Path


def write(path: Path, topics: int) -> Path:
    with path.open("wb") as stream:
        writer = Writer(stream, compression=CompressionType.NONE)
        writer.start()
        schema = writer.register_schema("foxglove.LocationFix", "jsonschema", b"{}")
        for number in range(topics):
            channel = writer.register_channel(f"/fix/{number}", "json", schema)
            writer.add_message(channel, number, json.dumps({"number": number}).encode(), number)
        writer.finish()
    return path


def test_channels_are_taken_as_they_come_in_a_chunk(tmp_path: Path) -> None:
    """One by one: a log of 20,000 topics took minutes when each made the table of all anew."""
    file = McapFile(write(tmp_path / "a.mcap", 300), Notes())
    found = [(m.channel.topic, json.loads(bytes(m.data))["number"]) for m in file.messages(file.contents().counts)]
    assert found == [(f"/fix/{number}", number) for number in range(300)]
    wanted = {Channel(f"/fix/{number}", "foxglove.LocationFix", "json") for number in (7, 299)}
    assert [m.log_ns for m in file.messages(wanted)] == [7, 299]


@pytest.mark.parametrize("deep", ["[" * 50_000, "- " * 50_000, "{a: " * 20_000, "a: " + "[" * 50_000 + "]" * 50_000])
def test_metadata_that_nests_without_end_is_left_out(tmp_path: Path, deep: str) -> None:
    """libyaml's loader went down with the process."""
    write(tmp_path / "a.mcap", 3)
    (tmp_path / "metadata.yaml").write_text(deep)
    log = logs.open(tmp_path)
    assert any("metadata" in warning for warning in log.info().warnings)


def test_a_pipe_is_not_waited_for(tmp_path: Path) -> None:
    os.mkfifo(tmp_path / "a.mcap")
    with pytest.raises(LogError, match="neither a file nor a folder"):
        logs.open(tmp_path / "a.mcap")
