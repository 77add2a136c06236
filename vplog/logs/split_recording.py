"""Several files of one drive: put in order of time, and refused where they are not of one drive."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise
from typing import TYPE_CHECKING

from vplog.errors import LogError
from vplog.logs.messages.records import kind_of

if TYPE_CHECKING:
    from pathlib import Path

    from vplog.logs.formats.container import Container, Contents

_OVERLAP_NS = 10**9
"""ns that one file may reach into the next: recorders split between messages that are a little out of order."""
_LONGEST_PAUSE_NS = 3600 * 10**9
"""ns between two files of one drive; who goes on after more than an hour has not kept the odometry running."""


@dataclass(frozen=True)
class Part:
    """One file of a drive."""

    path: Path
    kind: str
    container: Container
    contents: Contents


def in_order_of_time(parts: list[Part]) -> list[Part]:
    """The files with messages by their first log time.

    Raises LogError where they overlap, lie far apart, differ in kind, or have no topic in common that is of use.
    """
    parts = [part for part in parts if part.contents.messages] or parts[:1]
    parts = sorted(parts, key=lambda part: (part.contents.start_ns, part.path))
    for a, b in pairwise(parts):
        if a.kind != b.kind:
            raise LogError(f"{a.path} ({a.kind}) and {b.path} ({b.kind}) are not one drive. Run each by itself.")
        overlap_ns = a.contents.end_ns - b.contents.start_ns
        if overlap_ns > _OVERLAP_NS:
            raise LogError(
                f"{a.path} and {b.path} overlap by {overlap_ns / 1e9:.1f} s, so they are not one drive in parts. "
                "Run each by itself."
            )
        if -overlap_ns > _LONGEST_PAUSE_NS:
            raise LogError(
                f"{-overlap_ns / 3.6e12:.1f} hours lie between {a.path} and {b.path}, so they are two drives. "
                "Run each by itself."
            )
    useful = [{c.topic for c, count in part.contents.counts.items() if count and kind_of(c)} for part in parts]
    if len(parts) > 1 and not set.intersection(*useful):
        raise LogError(
            f"{parts[0].path} and the {len(parts) - 1} files after it have no topic in common that is of use, so they "
            "are not one drive in parts. Run each by itself."
        )
    return parts
