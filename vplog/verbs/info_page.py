"""The preflight as a page: one file, no network, readable on a phone, light or dark as the reader has it."""

from __future__ import annotations

from typing import TYPE_CHECKING

from vplog.errors import ResultError
from vplog.results.html import render
from vplog.results.previews import jpeg
from vplog.storage.scratch import replacing
from vplog.verbs.info import in_words

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.verbs.info import Preflight

_QUALITY = 75
"""JPEG quality: pictures to recognise a place by, of some 20 kB each."""


def write_page(path: Path, found: Preflight) -> None:
    """Raises ResultError where the file cannot be written."""
    try:
        with replacing(path) as stream:
            stream.write(page(found).encode())
    except OSError as error:
        raise ResultError(f"Cannot write {path}: {error.strerror}. Choose another with --html.") from None


def page(found: Preflight) -> str:
    """The whole document; whatever comes from the log is escaped."""
    record = found.record
    start_ns = record["start_ns"]
    pictures = [(f"{(stamp_ns - start_ns) / 1e9:.1f} s", jpeg(image, _QUALITY)) for stamp_ns, image in found.pictures]
    return render(
        "info.html",
        record=record,
        name=record["path"].rstrip("/").rsplit("/", 1)[-1],
        seconds=max(record["end_ns"] - start_ns, 0) / 1e9,
        facts=in_words(record),
        pictures=pictures,
    )
